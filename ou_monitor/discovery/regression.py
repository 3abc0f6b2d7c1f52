"""
Response of the mean to throttle, its lags, and time, by regression on whitened samples.

The recording and the columns of all candidates are whitened by the noise found so far; then any
set of terms is a small linear system.  Its evidence is the smaller of two: the likelihood less its
penalty (BIC), and the gain in cross-validation over blocks.  The first guards against noise, the
second against a form that improves only one part of the recording.  Starting from the load model,
terms are added and removed one at a time.

Limits: delays and time constants come from a list before they are refined; the noise is not
fitted again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import whitened
from ou_monitor.discovery import decision
from ou_monitor.model.load import INRUSH_TIME, LAGS
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient, LONGEST, SHORTEST
from ou_monitor.model.terms.slow import Drift
from ou_monitor.model.terms.term import NEXT_TO_ZERO, Term, View
from ou_monitor.records import FloatArray

# Number of blocks that are held out in turn.
FOLDS = 10
# Time constants, s, from which searches start: those of the node's load model; inrush, and two of
# polarisation.
STARTS = (LAGS, (INRUSH_TIME, 1.0, 20.0))
# Ratio below which two time constants count as equal: half an octave, the spacing of the list.
_ALIKE = 1.5
# Steps by which time constants are refined, octaves.
_FINER = (0.25, 0.125, 0.0625)
# Maximum number of terms added, removed or exchanged.
_ROUNDS = 40
# Prior standard deviation of what one coefficient moves, in ranges of the voltage.  Without it,
# large terms that nearly cancel describe a delay that is not in the list.
_LARGEST = 3.0


def load_terms(samples: Samples, lags: Sequence[float] = LAGS) -> tuple[Term, ...]:
    """Return a response with time constants, s, as terms; none without throttle."""
    if samples.throttle is None:
        return ()
    duration = float(samples.t[-1] - samples.t[0])
    shortest = float(np.median(samples.step[1:]))
    terms = (LoadSag(0.0, NEXT_TO_ZERO),
             *(LoadTransient(0.0, tau, 0.0) for tau in lags
               if SHORTEST * shortest <= tau <= LONGEST * duration),
             Drift(0.0, NEXT_TO_ZERO))
    return tuple(term for term in terms if term.NAME in catalogue())


@dataclass(frozen=True)
class MeanResponse:
    """Terms of the mean, and their rivals."""

    terms: tuple[Term, ...]  # In the order of their evidence, the largest first
    rivals: tuple[tuple[str, ...], ...]  # For each, other causes that fit about as well


def mean_response(samples: Samples, composite: Composite, view: View,
                  start: Sequence[Term] = ()) -> MeanResponse:
    """Choose the terms of the mean; the other terms of the model stay as they are."""
    own = [term for term in composite.terms if decision.is_response(type(term))]
    pool = [*(term for term in start if not _contains(term, own)), *own]
    # At the start the noise model is rough, and a growing sag would take the place of other terms.
    forms = [form for term in pool if isinstance(term, LoadTransient)
             for form in term.forms(view.by_current)]
    pool += [term for term in (*forms, *_candidates(view)) if not _contains(term, pool)
             and not (start and isinstance(term, LoadSag) and term.growth)]
    if not pool:
        return MeanResponse((), ())
    found = _Regression(samples, composite, pool).search([
        k for k, term in enumerate(pool) if term in own or term in start])
    return _refined(samples, composite, found)


def _refined(samples: Samples, composite: Composite, found: MeanResponse) -> MeanResponse:
    """Return a response whose time constants and delays, chosen from a list, are refined."""
    # With a time constant wrong by half an octave, a response of 0.6 V leaves an error of 40 mV,
    # which would be mistaken for a slow OU.
    terms = found.terms
    step = float(np.median(samples.step[1:]))
    for octaves in _FINER:
        nearby = [(k, near) for k, term in enumerate(terms) if isinstance(term, LoadTransient)
                  for near in _nearby(term, octaves, step)]
        if not nearby:
            break
        pool = [*terms, *(term for _, term in nearby)]
        chosen = _Regression(samples, composite, pool).exchanged(
            len(terms), [k for k, _ in nearby])
        terms = tuple(pool[k] for k in chosen)
    return MeanResponse(terms, found.rivals)


def _nearby(term: LoadTransient, octaves: float, step: float) -> list[Term]:
    """Return responses that are slower and faster by some octaves (step: of the samples, s)."""
    if not term.delay:
        return [replace(term, tau=term.tau * 2.0 ** by) for by in (-octaves, octaves)]
    by = max(1, round(octaves * term.delay / step)) * step
    return [replace(term, delay=delay) for delay in (term.delay - by, term.delay + by)
            if delay > 0.5 * step]


def _contains(term: Term, others: Sequence[Term]) -> bool:
    """Return whether a term, or one that is nearly the same, is among others."""
    for other in others:
        if type(other) is not type(term) or other.LINEAR != term.LINEAR:
            continue
        if not isinstance(term, LoadTransient) or not isinstance(other, LoadTransient):
            return True
        ratio = term.tau / other.tau
        if term.delay == other.delay and 1.0 / _ALIKE < ratio < _ALIKE:
            return True
    return False


def _is_near(one: Term, other: Term) -> bool:
    """Return whether two terms differ only by a small step of the time constant or delay."""
    if not isinstance(one, LoadTransient) or not isinstance(other, LoadTransient) or (
            bool(one.delay) is not bool(other.delay)):
        return False
    ratio = one.delay / other.delay if one.delay else one.tau / other.tau
    return 0.5 < ratio < 2.0


def _candidates(view: View) -> Iterator[Term]:
    """Yield the candidates of all measured causes of the mean."""
    for kind in catalogue().values():
        if decision.is_response(kind) and (
                view.throttle is not None or not kind.NEEDS_THROTTLE):
            yield from kind.candidates(view)


class _Regression:
    """Sums of products of whitened columns, block by block."""

    def __init__(self, samples: Samples, composite: Composite, pool: Sequence[Term]) -> None:
        self._pool = list(pool)
        through = whitened(samples, composite.terms, self._pool, composite.events,
                           composite.offset)
        sizes = [len(term.LINEAR) for term in self._pool]
        ends = np.cumsum([2, *sizes])
        self._at = [np.arange(a, b) for a, b in zip(ends[:-1], ends[1:])]
        norm = np.maximum(np.sqrt(np.mean(through[:, 1:]**2, axis=0)), 1e-300)
        through[:, 1:] /= norm
        usual = [_usual_size(samples, term, name) for term in self._pool for name in term.LINEAR]
        self._prior = np.array([0.0, 0.0, *(1.0 / (norm[1:] * usual) ** 2)])
        self._blocks = np.array([part.T @ part for part in np.array_split(through, FOLDS)])
        # All samples, then all but one block each.
        whole = self._blocks.sum(axis=0)
        self._fitted = np.concatenate((whole[None], whole - self._blocks))
        self._scored = np.concatenate((whole[None], self._blocks))
        self._n, self._penalty = samples.n, 0.5 * math.log(samples.n)
        self._known: dict[tuple[int, ...], tuple[float, FloatArray]] = {}
        # Whether to refuse sets that contain nearly equal time constants.
        self._apart = False

    def search(self, start: Sequence[int]) -> MeanResponse:
        """Add and remove terms until no change improves the evidence."""
        chosen: tuple[int, ...] = ()
        for k in start:
            chosen = self._with_term(chosen, k)
        chosen = self._moved(chosen)
        # So far, the set may contain a time constant together with its replacement.
        self._apart = True
        while self._has_twins(chosen):
            chosen = max((self._less(chosen, k) for k in chosen),
                         key=lambda less: self._evaluate(less)[0])
        chosen = self._moved(chosen)
        found = sorted(chosen, key=lambda k: self._evidence(self._less(chosen, k)))
        return MeanResponse(tuple(self._pool[k] for k in found),
                            tuple(self._rivals(chosen, k) for k in found))

    def _moved(self, chosen: tuple[int, ...]) -> tuple[int, ...]:
        """Return the set after the best moves, one at a time, until none helps."""
        for _ in range(_ROUNDS):
            better = self._best_move(chosen)
            if better is None:
                break
            chosen = better
        return chosen

    def _has_twins(self, chosen: tuple[int, ...]) -> bool:
        """Return whether two time constants are too close to be distinguished."""
        return any(_is_near(one, other)
                   for one, other in combinations([self._pool[k] for k in chosen], 2))

    def exchanged(self, own: int, places: Sequence[int]) -> list[int]:
        """Replace any of the first `own` terms by a better later one."""
        # places: for each later term, the index of the term that it may replace.
        self._apart = True
        chosen = list(range(own))
        for k, place in enumerate(places, own):
            other = [*chosen[:place], k, *chosen[place + 1:]]
            if self._evidence(tuple(other)) > self._evidence(tuple(chosen)) + decision.TIE:
                chosen = other
        return chosen

    def _best_move(self, chosen: tuple[int, ...]) -> tuple[int, ...] | None:
        """Return the set after the most useful change; None if no change helps."""
        value = self._evidence(chosen)
        largest = value - self._evidence(())
        best, most = None, 0.0
        for k in chosen:
            less = self._less(chosen, k)
            # Removing a term saves its penalty.
            gain = self._needed_evidence(less, k, largest) - (value - self._evidence(less))
            if not self._steady(less, chosen):
                gain = max(gain, 1e-6)
            if gain > most:
                best, most = less, gain
        if best is not None:
            return best
        for k in range(len(self._pool)):
            if k in chosen:
                continue
            more = self._with_term(chosen, k)
            swapped = len(more) == len(chosen)
            gain = self._evidence(more) - value - (
                0.0 if swapped else self._needed_evidence(chosen, k, largest))
            if gain > max(most, 0.1) and (swapped or self._steady(chosen, more)):
                best, most = more, gain
        return best or self._best_exchange(chosen, value)

    def _best_exchange(self, chosen: tuple[int, ...], value: float) -> tuple[int, ...] | None:
        """Return the set with one time constant replaced by a better nearby one."""
        others = [tuple(sorted((*self._less(chosen, j), k))) for j in chosen
                  for k in range(len(self._pool))
                  if k not in chosen and _is_near(self._pool[j], self._pool[k])]
        best = max(others, key=self._evidence, default=None)
        return best if best is not None and self._evidence(best) > value + 0.1 else None

    def _needed_evidence(self, beside: tuple[int, ...], k: int, largest: float) -> float:
        """Return the minimum evidence of a term in addition to others, nats."""
        kind = type(self._pool[k])
        again = any(type(self._pool[j]) is kind for j in beside)
        return decision.least_evidence(kind, max(largest, 0.0), self._n if again else 0)

    def _less(self, chosen: tuple[int, ...], k: int) -> tuple[int, ...]:
        return tuple(j for j in chosen if j != k)

    def _with_term(self, chosen: tuple[int, ...], k: int) -> tuple[int, ...]:
        """Return a set with one more term; it replaces one of its kind if only one may occur."""
        kind = type(self._pool[k])
        kept = chosen if kind.SEVERAL else tuple(
            j for j in chosen if type(self._pool[j]) is not kind)
        return tuple(sorted((*kept, k)))

    def _evidence(self, chosen: tuple[int, ...]) -> float:
        if self._apart and self._has_twins(chosen):
            return -math.inf
        return self._evaluate(chosen)[0]

    def _evaluate(self, chosen: tuple[int, ...]) -> tuple[float, FloatArray]:
        """Return the evidence, and the cost of each held-out block, nats."""
        if chosen not in self._known:
            at = np.concatenate([[1], *(self._at[k] for k in chosen)]).astype(int)
            inside, *lost = _losses(self._fitted, self._scored, at, self._prior[at]).tolist()
            price = sum(self._pool[k].SEARCH + self._pool[k].FORM_COST * self._n for k in chosen)
            value = -max(inside + self._penalty * at.size, sum(lost)) - price
            self._known[chosen] = value, np.array(lost)
        return self._known[chosen]

    def _steady(self, less: tuple[int, ...], more: tuple[int, ...]) -> bool:
        """Return whether the larger set gains in more than one block."""
        return decision.is_shared(self._evaluate(less)[1] - self._evaluate(more)[1])

    def _rivals(self, chosen: tuple[int, ...], k: int) -> tuple[str, ...]:
        """Return the other causes that fit about as well in the place of a term."""
        value, less = self._evidence(chosen), self._less(chosen, k)
        return tuple(dict.fromkeys(
            term.NAME for j, term in enumerate(self._pool)
            if type(term) is not type(self._pool[k]) and j not in chosen
            and len(self._with_term(less, j)) == len(chosen)
            and self._evidence(self._with_term(less, j)) > value - decision.TIE))


def _usual_size(samples: Samples, term: Term, name: str) -> float:
    """Return the prior standard deviation of a coefficient, in its unit."""
    seconds = float(samples.t[-1] - samples.t[0])
    # What the coefficient multiplies: the load, time or its square.
    load = 1.0 if samples.throttle is None else float(np.ptp(samples.throttle))
    of = {'V': load, 'V/s': seconds, 'V/s^2': seconds ** 2}.get(term.unit(name), 0.0)
    return _LARGEST * float(np.ptp(samples.voltage)) / of if of > 0.0 else math.inf


def _losses(fitted: FloatArray, scored: FloatArray, at: npt.NDArray[np.int64], prior: FloatArray
            ) -> FloatArray:
    """Fit columns by each product in `fitted`; return half the squared residuals in `scored`."""
    gram, seen = fitted[:, at[:, None], at], fitted[:, at, 0]
    # The columns are scaled; the ridge keeps equal columns from a division by zero.
    ridge = 1e-10 * np.trace(gram, axis1=1, axis2=2)[:, None, None] * np.eye(
        at.size) + np.diag(prior)
    beta = np.linalg.solve(gram + ridge, seen[:, :, None])
    inside = (scored[:, at[:, None], at] @ beta)[:, :, 0]
    rest: FloatArray = scored[:, 0, 0] + np.einsum(
        'bk,bk->b', beta[:, :, 0], inside - 2.0 * scored[:, at, 0])
    return 0.5 * rest
