"""Isolated bad samples that do not enter the dynamics."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.terms.laws import LawFit, log_normal, normal_scores, View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import parameter, Role, Term
from ou_monitor.records import FloatArray
from scipy.special import ndtr


@dataclass(frozen=True)
class Glitches(Term):
    """Add a normal error to a sample now and then."""

    NAME: ClassVar[str] = 'glitches'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.SENSOR
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis', 'tails', 'pairs', 'autocorrelation')
    IMITATES: ClassVar[tuple[str, ...]] = ('clock_jitter', 'heavy_tails', 'jumps')
    SEVERAL: ClassVar[bool] = True
    MEANING: ClassVar[str] = (
        'Single bad samples that do not enter the dynamics: bus errors or pick-up of the ADC.')
    REMEDY: ClassVar[str] = (
        'Reject single outliers before the estimator; check cables and ground of the ADC.')
    SEPARATED_BY: ClassVar[str] = 'two ADCs on one rail: a glitch is in one only'

    probability: float = parameter('', 'share of samples that are bad', 0.0, 1.0)
    std: float = parameter('V', 'standard deviation of the error', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns, sizes = rng.spawn(2)

        def effect(s: Segment) -> None:
            bad = turns.random(s.t.size) < self.probability
            s.voltage[bad] += self.std * sizes.standard_normal(int(bad.sum()))

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """
        Find samples that their neighbours on both sides contradict.

        A bad sample makes two large innovations, z and -phi z; leaving it out
        removes both.  Runs of up to three samples are looked at.
        """
        # The bad ones widen what the fit so far takes for noise: a scale that
        # does not see them.
        # Judged by what a filter sees that knows of no error: a sample once left
        # out no longer disturbs the next.
        plain = (view.residual - view.phi * view.state) / np.sqrt(view.variance)
        unit = float(np.median(np.abs(plain))) / 0.6745
        scaled = replace(view, z=plain / unit, variance=view.variance * unit * unit)
        floor = float(np.median(scaled.variance))
        share, spread = 1e-3, 6.0 * math.sqrt(floor)
        lengths = np.array([1.0, share, share * share])
        for _ in range(3):
            bad = bad_samples(scaled, share, spread, lengths)
            count = int(bad[view.train].sum())
            if count < 3:
                return None
            error = view.z[bad] * np.sqrt(view.variance[bad])
            spread = math.sqrt(max(float(np.mean(error**2)) - floor, floor))
            found = _lengths(bad[view.train])
            runs = int(found.sum())
            share = runs / view.z[view.train].size
            lengths = (found + 0.1) / (runs + 0.3)
        term = cls(min(count / view.z[view.train].size, 1.0), spread)
        scores, gain, free = _scored(view, bad, share, spread, lengths)
        se = {'probability': term.probability / math.sqrt(count),
              'std': spread / math.sqrt(2.0 * count)}
        # Once an error is taken out, the samples after it are scored anew.
        return LawFit(term, se, scores, gain, free,
                      error=np.where(bad, spread * spread, 0.0))


def _scored(view: View, bad: npt.NDArray[np.bool_], share: float, spread: float,
            lengths: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return normal scores, gains in log density, and how many parameters they took."""
    # Good, and the first, second and third sample of a run, whose errors are alike.
    e = view.z * np.sqrt(view.variance)
    keep, rest = _alike(e, bad, view.train, spread)
    wide = np.sqrt(1.0 + spread * spread / view.variance)
    again = np.sqrt(1.0 + rest * rest / view.variance)
    mean = keep * np.concatenate(([0.0], e[:-1])) / np.sqrt(view.variance)
    calm, hit = log_normal(view.z), log_normal(view.z, 0.0, wide * wide)
    more = log_normal(view.z, mean, again * again)
    # What each step of the chain expects: nothing, an error, the same error again.
    which = np.array([[0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 2], [0, 0, 0, 0]])
    go = 1.0 - lengths[0], lengths[2] / (lengths[1] + lengths[2])
    transition = np.array([[1.0 - share, share, 0.0, 0.0], [1.0 - go[0], 0.0, go[0], 0.0],
                           [1.0 - go[1], 0.0, 0.0, go[1]], [1.0, 0.0, 0.0, 0.0]])
    before, both = forward(np.stack((calm, hit, more))[which].transpose(2, 0, 1), transition,
                           np.array([1.0, 0.0, 0.0, 0.0]))
    chance = np.stack([before @ (transition * (which == k)).sum(axis=1) for k in range(3)])
    scores = normal_scores(chance[0] * ndtr(view.z) + chance[1] * ndtr(view.z / wide)
                           + chance[2] * ndtr((view.z - mean) / again))
    return scores, both - calm, 2 if keep == 0.0 else 6


def _alike(e: FloatArray, bad: npt.NDArray[np.bool_], train: slice, spread: float
           ) -> tuple[float, float]:
    """Return how much of an error the next one of its run keeps, and what it adds, V."""
    e, bad = e[train], bad[train]
    second = np.flatnonzero(bad[1:] & bad[:-1]) + 1
    if second.size < _PAIRS:
        return 0.0, spread
    keep = float(e[second] @ e[second - 1]) / float(e[second - 1] @ e[second - 1])
    return keep, float(np.std(e[second] - keep * e[second - 1]))


# Pairs of bad samples from which it can be said whether errors repeat.
_PAIRS = 8


def _lengths(bad: npt.NDArray[np.bool_]) -> FloatArray:
    """Return how many runs there are of one, of two, and of three or more."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], bad, [False]))))
    widths = np.minimum(edges[1::2] - edges[::2], 3)
    return np.bincount(widths, minlength=4)[1:].astype(np.float64)


def bad_samples(view: View, share: float, spread: float, lengths: FloatArray
                ) -> npt.NDArray[np.bool_]:
    """
    Return which samples are off while the rail went on.

    Of all sets of runs of up to three samples, with a good sample between any
    two, that which explains most.
    """
    z, phi, n = view.z, view.phi, view.z.size
    size = 0.5 * math.log1p(spread * spread / float(np.median(view.variance)))
    begins, ends, gains = [], [], []
    for width in (1, 2, 3):
        first = np.arange(1, n - width)
        # Innovations k..k+width with the samples k..k+width-1 out: one remains,
        # the way from k-1 to k+width in width + 1 steps.
        run, weight, power = z[first + width].copy(), np.ones(first.size), np.ones(first.size)
        before = run**2
        for j in range(width - 1, -1, -1):
            power = power * phi[first + j + 1]
            run += power * z[first + j]
            weight += power * power
            before += z[first + j] ** 2
        price = width * size - math.log(share * lengths[width - 1])
        gain = 0.5 * (before - run * run / weight) - price
        good = np.flatnonzero(gain > 0.0)
        begins.append(first[good])
        ends.append(first[good] + width)
        gains.append(gain[good])
    return _best_runs(np.concatenate(begins), np.concatenate(ends), np.concatenate(gains), n)


def _best_runs(begin: npt.NDArray[np.int64], end: npt.NDArray[np.int64], gain: FloatArray, n: int
               ) -> npt.NDArray[np.bool_]:
    """Return the samples of the runs that gain most together (weighted interval scheduling)."""
    order = np.argsort(end, kind='stable')
    begin, end = begin[order], end[order]
    # A run needs the innovations up to its end; how many runs end before each begins.
    clear = np.searchsorted(end, begin, side='left').tolist()
    best, taken = [0.0], []
    for value, k in zip(gain[order].tolist(), clear, strict=True):
        taken.append(best[k] + value > best[-1])
        best.append(max(best[k] + value, best[-1]))
    bad = np.zeros(n, dtype=np.bool_)
    at = len(taken)
    while at > 0:
        if taken[at - 1]:
            bad[begin[at - 1]:end[at - 1]] = True
            at = clear[at - 1]
        else:
            at -= 1
    return bad
