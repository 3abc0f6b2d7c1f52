"""Standard errors of all parameters of a fitted model, and what those errors cost it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import coefficients, evaluate
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN

# Step of the numerical derivatives, in the logarithm of a parameter.
_STEP = 1e-4
# Information below this share of its scale is none.
_NONE = 1e-10


def standard_errors(samples: Samples, model: Composite, part: slice) -> tuple[dict[str, Any], ...]:
    """Return standard errors by parameter, a dict a term."""
    found = [_gathered(term, se) for term, se in zip(model.terms, model.se)]
    for k, more in _of_mean(samples, model, part).items():
        found[k] = {**more, **found[k]}
    return tuple(found)


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


@dataclass(frozen=True, eq=False)
class Estimation:
    """
    What a model knows of its parameters, and what it needs to know of them.

    With parameters theta fitted on one part, the log density of another is
    below that of the true ones by d'Md / 2 + e'd, d being the error of theta,
    of covariance C (the inverse of the Fisher information of the part
    fitted), M the information per sample of the part scored, and e of
    covariance M / m for its m samples.

    Attributes
    ----------
    known : ndarray, shape (k, k)
        Fisher information of the part fitted, parameters scaled.
    asked : ndarray, shape (k, k)
        Of the samples scored, per sample.
    owner : tuple of int, length k
        Which term each parameter belongs to.
    scored : int
        m.
    laws : dict of int to float
        By position of a term: parameters that are not in `known`, over the
        samples fitted.

    """

    known: FloatArray
    asked: FloatArray
    owner: tuple[int, ...]
    scored: int
    laws: dict[int, float]

    def loss(self, terms: Collection[int] | None = None) -> tuple[float, float]:
        """Return what errors of parameters cost, nats per sample."""
        mean, square = self._moments(())
        if terms is not None:
            less = self._moments(terms)
            mean, square = max(mean - less[0], 0.0), max(square - less[1], 0.0)
        return mean, math.sqrt(mean * mean + square)

    def _moments(self, left_out: Collection[int]) -> tuple[float, float]:
        """Return mean and variance of the loss of the model without some terms."""
        if not (np.isfinite(self.known).all() and np.isfinite(self.asked).all()):
            return math.inf, math.inf
        at = [j for j, owner in enumerate(self.owner) if owner not in left_out]
        laws = sum(share for k, share in self.laws.items() if k not in left_out)
        value, basis = np.linalg.eigh(self.known[np.ix_(at, at)])
        turned = basis / np.sqrt(np.maximum(value, _NONE))
        lost = turned.T @ self.asked[np.ix_(at, at)] @ turned
        trace = float(lost.trace()) + laws
        return 0.5 * trace, 0.5 * float((lost * lost).sum()) + trace / max(self.scored, 1)


def estimations(samples: Samples, model: Composite, *parts: npt.NDArray[np.bool_]
                ) -> list[Estimation]:
    """Return the information of the first part on the parameters, and what other parts need."""
    terms = model.gaussian.terms
    base = evaluate(samples, terms, model.events)
    owner, through = [], []
    for k, term in enumerate(terms):
        moved: list[tuple[Term, float]] = []
        for j in range(len(coefficients(term))):
            beta = coefficients(term)
            beta[j] += 1.0
            moved.append((_with(term, beta), 1.0))
        moved += [_stepped(term, name) for name in term.free()]
        for other, step in moved:
            there = evaluate(samples, (*terms[:k], other, *terms[k + 1:]), model.events)
            owner.append(k)
            through.append(np.stack([
                (there.innovation - base.innovation) / (step * np.sqrt(base.variance)),
                (there.variance - base.variance) / (step * math.sqrt(2.0) * base.variance)]))
    slopes = np.stack(through)
    size = samples.train.stop
    laws = {k: (len(vars(term)) if term.ROLE is Role.LAW else 1) / size
            for k, term in enumerate(model.terms) if term.ROLE is Role.LAW or term.SEARCH > 0.0}
    known = _products(slopes[:, :, samples.train])
    found = []
    for scored in parts:
        asked, count = _products(slopes[:, :, scored]), int(scored.sum())
        scale = np.sqrt(known.diagonal() + asked.diagonal())
        scale = np.where(scale > 0.0, scale, 1.0)
        both = np.outer(scale, scale)
        found.append(Estimation(known / both, asked / both / max(count, 1), tuple(owner), count,
                                laws))
    return found


def _stepped(term: Term, name: str) -> tuple[Term, float]:
    """Return a term with a parameter moved a little, inwards at the end of its range."""
    try:
        return term.moved(name, _STEP), _STEP
    except ValueError:
        return term.moved(name, -_STEP), -_STEP


def _products(slopes: FloatArray) -> FloatArray:
    """Return the sums of products of rows, from shape (k, 2, m) to (k, k)."""
    flat = slopes.reshape(slopes.shape[0], -1)
    found: FloatArray = flat @ flat.T
    return found
