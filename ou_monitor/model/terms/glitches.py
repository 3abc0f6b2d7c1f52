"""Isolated bad samples that do not enter the dynamics."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np

from ou_monitor.model.terms.laws import log_normal, normal_scores
from ou_monitor.model.terms.term import (
    Effect, LawFit, parameter, Role, Stage, Stretch, Term, View)
from scipy.special import ndtr


@dataclass(frozen=True)
class Glitches(Term):
    """Add a normal error to a sample now and then."""

    NAME: ClassVar[str] = 'glitches'
    FAMILY: ClassVar[str] = 'events'
    STAGE: ClassVar[Stage] = Stage.SENSOR
    ROLE: ClassVar[Role] = Role.LAW
    SIGNS: ClassVar[tuple[str, ...]] = ('kurtosis', 'tails', 'pairs', 'autocorrelation')

    probability: float = parameter('', 'share of samples that are bad', 0.0, 1.0)
    std: float = parameter('V', 'standard deviation of the error', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        turns, sizes = rng.spawn(2)

        def effect(s: Stretch) -> None:
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
        seen = replace(view, z=plain / unit, variance=view.variance * unit * unit)
        share, spread = 1e-3, 6.0 * math.sqrt(float(np.median(seen.variance)))
        for _ in range(3):
            bad = bad_samples(seen, share, spread)
            count = int(bad[view.train].sum())
            if count < 3:
                return None
            error = view.z[bad] * np.sqrt(view.variance[bad])
            floor = float(np.median(seen.variance))
            spread = math.sqrt(max(float(np.mean(error**2)) - floor, floor))
            share = float(bad.mean())
        term = cls(min(share, 1.0), spread)
        wide = np.sqrt(1.0 + spread * spread / view.variance)
        calm = math.log1p(-share) + log_normal(view.z)
        hit = math.log(share) + log_normal(view.z, 0.0, wide * wide)
        both = np.logaddexp(calm, hit)
        scores = normal_scores((1.0 - share) * ndtr(view.z) + share * ndtr(view.z / wide))
        se = {'probability': share / math.sqrt(count), 'std': spread / math.sqrt(2.0 * count)}
        # Once an error is taken out, the samples after it are scored anew.
        return LawFit(term, se, scores, both - log_normal(view.z), 2,
                      error=np.where(bad, 1e4 * spread * spread, 0.0))


def bad_samples(view: View, share: float, spread: float) -> np.ndarray:
    """
    Return which samples are off while the rail went on.

    Parameters
    ----------
    view : View
        Scores and coefficients.
    share, spread : float
        Share of samples that are bad, and the standard deviation of their
        errors, V.

    Returns
    -------
    ndarray of bool, shape (n,)
        Where taking samples out explains two innovations or more.

    """
    z, phi, n = view.z, view.phi, view.z.size
    bad = np.zeros(n, dtype=bool)
    each = -math.log(share) + 0.5 * math.log1p(spread * spread / float(np.median(view.variance)))
    for k in np.flatnonzero(np.abs(z) > 2.5).tolist():
        if k == 0 or bad[k] or (k > 1 and bad[k - 1]):
            continue
        best, chosen = 0.0, 0
        for width in (1, 2, 3):
            end = k + width
            if end >= n:
                break
            # Innovations k..end with the samples k..end-1 out: one remains, the
            # way from k-1 to end in width + 1 steps.
            run, weight = 0.0, 0.0
            for j in range(width + 1):
                power = float(np.prod(phi[k + j + 1:end + 1]))
                run += power * float(z[k + j])
                weight += power * power
            before = float((z[k:end + 1] ** 2).sum())
            # Each sample taken out has cost its own share of prior and size.
            gain = 0.5 * (before - run * run / weight) - each * width
            if gain > best:
                best, chosen = gain, width
        bad[k:k + chosen] = True
    return bad
