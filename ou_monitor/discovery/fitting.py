"""
A candidate beside what was accepted before: its starting points, tried and fitted.

Most starts are told from each other on some thousand samples.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.load_sag import LoadSag
from ou_monitor.model.terms.load_transient import LoadTransient
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray

# Starting points that are fitted in full, and samples that tell which.
_FULL, _GLANCE = 2, 8000
# Lags of a sag that are fitted in full.
_LAGS = 4


def best_start(samples: Samples, composite: Composite, kind: type[Term], view: View
               ) -> Composite | None:
    """Return the best fit with one more term of a kind."""
    if kind.ROLE is Role.LAW:
        # A law that has no parameters yet.
        made = fitted(samples, [*composite.terms, object.__new__(kind)], composite)
        return made if made is not None and made.terms[-1].holds(view) else None
    starts = list(kind.candidates(view))
    known = [term for term in starts if term.ROLE is Role.MEAN]
    hidden = [term for term in starts if term.ROLE is not Role.MEAN]
    if len(known) > _FULL:
        known = _screened(samples, known, view)
    if len(hidden) > _FULL:
        hidden = _likely(samples, composite, hidden)
    best: Composite | None = None
    for start in (*known[:_FULL], *hidden[:_FULL]):
        made = joined(samples, composite, [start], rough=True)
        if made is not None and made.terms[_place(made)].holds(view) and (
                best is None or made.score(samples) > best.score(samples)):
            best = made
    return best


def sag_with_lag(samples: Samples, composite: Composite, view: View) -> Composite | None:
    """
    Return the best fit with a sag that comes at its own rate, or later.

    Neither the sag nor its lag may be worth anything alone: a rail that relaxes to where
    throttle puts it does not jump.
    """
    sag = LoadSag.candidates(view)[0]
    lags = _screened(samples, list(LoadTransient.candidates(view)), view, beside=[sag])
    # The rate of the rail is not what it seemed to be, and with it goes the lag that fits best.
    made = [joined(samples, composite, [sag, lag], rough=True) for lag in lags[:_LAGS]]
    return max((fit for fit in made if fit is not None), default=None,
               key=lambda fit: fit.score(samples))


def joined(samples: Samples, composite: Composite, starts: Sequence[Term], rough: bool
           ) -> Composite | None:
    """Return the fit with more terms, the last before the laws."""
    structural = [term for term in composite.terms if term.ROLE is not Role.LAW]
    laws = [term for term in composite.terms if term.ROLE is Role.LAW]
    structural[0] = starts[-1].beside(structural[0])
    return fitted(samples, [*structural, *starts, *laws], composite, rough)


def _place(composite: Composite) -> int:
    """Return where the term is that was joined last."""
    return sum(term.ROLE is not Role.LAW for term in composite.terms) - 1


def fitted(samples: Samples, terms: Sequence[Term], known: Composite | None,
           rough: bool = False) -> Composite | None:
    """Return a fit to the first part, its mean to everything; None where it cannot be fitted."""
    try:
        return fit_composite(samples, terms, samples.train, known, whole_mean=True,
                             rough=rough)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Parameters have left what a term allows, or numbers can hold.
        return None


def _likely(samples: Samples, composite: Composite, starts: list[Term]) -> list[Term]:
    """Return starts in the order of their likelihood as they are, on a part."""
    part = slice(0, min(samples.train.stop, _GLANCE))
    few = samples.part(part)
    structural = [term for term in composite.terms if term.ROLE is not Role.LAW]

    def value(start: Term) -> float:
        terms = [start.beside(structural[0]), *structural[1:], start]
        try:
            return float(evaluate(few, terms).density.sum())
        except (ValueError, ArithmeticError):
            return -math.inf

    return sorted(starts, key=lambda start: -value(start))


def _screened(samples: Samples, starts: list[Term], view: View, beside: Sequence[Term] = ()
              ) -> list[Term]:
    """Return starts in the order of how much of the scores they explain with those beside them."""
    s = samples.stretch(1.0, 0.0)
    known = [term.columns(s) for term in beside]
    scale = np.sqrt(view.variance)

    def explained(term: Term) -> float:
        columns = np.concatenate([*known, term.columns(s)], axis=1)
        through = columns.copy()
        through[1:] -= view.phi[1:, None] * columns[:-1]
        through = (through / scale[:, None])[view.train]
        through = through - through.mean(axis=0)
        z = view.z[view.train]
        beta = np.linalg.lstsq(through, z, rcond=1e-10)[0]
        rest: FloatArray = z - through @ beta
        return float(z @ z - rest @ rest)

    return sorted(starts, key=lambda term: -explained(term))
