"""Standard errors of all parameters of a fitted model."""

from __future__ import annotations

from dataclasses import replace
import math
from typing import Any

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.mean_columns import coefficients
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.term import Term
from ou_monitor.records import FloatArray, NAN


def standard_errors(samples: Samples, model: Composite, part: slice) -> tuple[dict[str, Any], ...]:
    """Return standard errors by parameter, a dict a term."""
    found = [_gathered(term, se) for term, se in zip(model.terms, model.se)]
    for k, more in _of_mean(samples, model, part).items():
        found[k] = {**more, **found[k]}
    return tuple(found)


def with_reach(term: Term, se: dict[str, Any], samples: Samples) -> dict[str, Any]:
    """Return errors with an infinite one for each parameter that no such recording can show."""
    duration = float(samples.t[-1] - samples.t[0])
    values = term.values()
    far = [name for name, value in values.items() if isinstance(value, float) and (
        (term.unit(name) == 's' and value > duration)
        or (term.unit(name) == '1/s' and 0.0 < value * duration < 1.0))]
    if isinstance(term, Saturation):
        far += [name for name, met in (('low', term.low >= float(samples.logged.min())),
                                       ('high', term.high <= float(samples.logged.max())))
                if not met]
    return {**se, **dict.fromkeys(far, math.inf)}


def _gathered(term: Term, se: dict[str, float]) -> dict[str, Any]:
    """Return errors of single knots, named `parameter 2`, as a list."""
    gathered: dict[str, Any] = {}
    for name, value in se.items():
        base, _, at = name.partition(' ')
        if at:
            values = gathered.setdefault(base, [NAN] * len(getattr(term, base)))
            values[int(at)] = float(value)
        else:
            gathered[name] = float(value)
    return gathered


def _of_mean(samples: Samples, model: Composite, part: slice) -> dict[int, dict[str, Any]]:
    """Return errors of the level and of what multiplies known columns."""
    terms = model.gaussian.terms
    where = [(k, j) for k, term in enumerate(terms) for j in range(len(coefficients(term)))]
    base = evaluate(samples, terms)
    weight = 1.0 / np.sqrt(base.variance[part])
    through = np.empty((weight.size, len(where)))
    for column, (k, j) in enumerate(where):
        beta = coefficients(terms[k])
        # Innovations are linear in these, so any step will do.
        beta[j] += 1.0
        moved = evaluate(samples, (*terms[:k], _with(terms[k], beta), *terms[k + 1:]))
        through[:, column] = weight * (base.innovation - moved.innovation)[part]
    norm = np.sqrt((through * through).sum(axis=0))
    # What the instrument does not show (the level behind a high-pass) has no error.
    norm = np.where(norm > 1e-9 * norm.max(), norm, np.inf)
    through /= norm
    covariance = np.linalg.pinv(through.T @ through) / np.outer(norm, norm)
    found: dict[int, dict[str, Any]] = {}
    for k, term in enumerate(terms):
        at = [column for column, (owner, _) in enumerate(where) if owner == k]
        if at:
            found[k] = _by_parameter(term, covariance[np.ix_(at, at)])
    return found


def _with(term: Term, beta: list[float]) -> Term:
    return replace(term, u0=beta[0]) if isinstance(term, OU) else term.with_linear(beta)


def _by_parameter(term: Term, covariance: FloatArray) -> dict[str, Any]:
    """Return errors of parameters from the covariance of the coefficients."""
    beta = coefficients(term)
    names = ('u0',) if isinstance(term, OU) else term.LINEAR
    spread = np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    slopes = np.zeros((len(names), len(beta)))
    for j, error in enumerate(spread.tolist()):
        step = 1e-3 * error
        if step <= 0.0:
            continue
        up, down = list(beta), list(beta)
        up[j], down[j] = beta[j] + step, beta[j] - step
        high, low = _with(term, up), _with(term, down)
        for i, name in enumerate(names):
            a, b = getattr(high, name), getattr(low, name)
            if not isinstance(a, tuple):
                slopes[i, j] = (a - b) / (2.0 * step)
    variance = np.einsum('ij,jk,ik->i', slopes, covariance, slopes)
    return {name: math.sqrt(max(float(value), 0.0)) for name, value in zip(names, variance)
            if value > 0.0}
