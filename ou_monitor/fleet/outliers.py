"""
Robust outliers, with a false-alarm rate for the whole fleet.

A value deviates by its distance from the median of its group (or from the
line that its group drifts along), over sqrt(s^2 + se^2): se is its standard
error, and s the scatter between recordings that makes the median of these
ratios that of a normal law (as a median absolute deviation).  The bound is
where the largest ratio of the whole fleet lies when nothing is wrong, by
simulation of fleets of the same groups and errors, estimated in the same way
(with s at its upper 90 % bound, so that the rate is rather below than above).

Limits: the scatter between good recordings is taken to be normal and of one
size on every vehicle.  Where its tails are heavier there are more alarms than
stated; where a large part of a group is off, its median follows.  A median of
few deviations is vague, so the bound of few is wide: doc/fleet.md has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# The median of |z| of a normal law.
_MEDIAN = 0.6744897501960817
# A group of fewer says nothing about which of its members is off.
LEAST = 4
SIMULATIONS = 4000
# Cells of the arrays that are simulated at once; bounds memory.
_CELLS = 2_000_000
# One-sided bound of 90 % in standard deviations of a normal law.
_UPPER = 1.2815515655446004


@dataclass(frozen=True, eq=False)
class Outliers:
    """
    How far each value is off.

    Attributes
    ----------
    score : ndarray, shape (n,)
        Distance from the group in standard deviations; NaN where the group is
        too small.
    chance : ndarray, shape (n,)
        Chance that any value of a fleet with nothing wrong is as far off; NaN
        where there is no score.
    centre : ndarray, shape (n,)
        What each was compared with.
    scatter : float
        Standard deviation between recordings of one group, beside their
        errors; NaN when unknown.
    bound : float
        Score that is reached with chance `rate` in a fleet with nothing wrong.
    rate : float
        That chance.

    """

    score: FloatArray
    chance: FloatArray
    centre: FloatArray
    scatter: float
    bound: float
    rate: float

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which values are outliers; shape (n,)."""
        beyond: npt.NDArray[np.bool_] = np.abs(np.nan_to_num(self.score)) > self.bound
        return beyond


def outliers(value: FloatArray, error: FloatArray, groups: Sequence[str], rate: float,
             trend: FloatArray | None = None, *, least: int = LEAST, seed: int = 0,
             simulations: int = SIMULATIONS) -> Outliers:
    """Find the values that are off (rate 0..1)."""
    n = value.size
    names, of = np.unique(np.asarray(groups, dtype=str), return_inverse=True)
    count = np.bincount(of, minlength=names.size)
    good = (count[of] >= least) & (np.asarray(groups, dtype=str) != '') if n else np.zeros(0, bool)
    flat = value if trend is None else value - trend
    score, chance, centre = (np.full(n, np.nan) for _ in range(3))
    if not good.any():
        return Outliers(score, chance, centre, float('nan'), float('inf'), rate)
    members = [np.flatnonzero(of[good] == g) for g in np.unique(of[good])]
    se = error[good]
    rest, middle = _centred(flat[good][None, :], members)
    scatter = _scatter(rest, se)
    score[good] = (rest / _spread(scatter, se))[0]
    centre[good] = middle[0] + (0.0 if trend is None else trend[good])
    rng = np.random.default_rng(seed)
    size = max(1, min(simulations, _CELLS // se.size))
    # Where errors are as large as s, s may come out as zero, and the scores of the best recordings
    # too large: fleets are simulated with the largest s that the data allow.
    share = min(0.5 + 0.5 * _UPPER / math.sqrt(se.size), 0.95)
    most = float(_scatter(rest, se, share)[0, 0])
    largest: list[FloatArray] = []
    while sum(part.size for part in largest) < simulations:
        drawn = rng.standard_normal((size, se.size)) * np.hypot(most, se)
        inner, _ = _centred(drawn, members)
        largest.append(np.abs(inner / _spread(_scatter(inner, se), se)).max(axis=1))
    worst = np.sort(np.concatenate(largest)[:simulations])
    over = simulations - np.searchsorted(worst, np.abs(score[good]), side='left')
    chance[good] = (1.0 + over) / (1.0 + simulations)
    bound = float(np.quantile(worst, 1.0 - rate))
    return Outliers(score, chance, centre, float(scatter[0, 0]), bound, rate)


def _centred(value: FloatArray, members: Sequence[npt.NDArray[np.intp]]
             ) -> tuple[FloatArray, FloatArray]:
    """Return rows without the medians of their groups, and the medians; shape (k, n)."""
    middle = np.empty_like(value)
    wide = np.empty(value.shape[1])
    for index in members:
        middle[:, index] = np.median(value[:, index], axis=1, keepdims=True)
        # A value pulls its own median towards it; of a mean it would be exactly this much.
        wide[index] = np.sqrt(1.0 - 1.0 / index.size)
    return (value - middle) / wide, middle


def _spread(scatter: FloatArray, error: FloatArray) -> FloatArray:
    """Return sqrt(s^2 + se^2), above zero; shape (k, n)."""
    return np.maximum(np.hypot(scatter, error[None, :]), 1e-300)


def _scatter(rest: FloatArray, error: FloatArray, share: float = 0.5) -> FloatArray:
    """
    Return s of each row; shape (k, 1).

    The median of |rest| / sqrt(s^2 + se^2) is that of a normal law, `_MEDIAN`,
    where s^2 is the median of rest^2 / `_MEDIAN`^2 - se^2.  A `share` above one
    half gives an upper bound: the median of n values lies below their quantile
    of share 0.5 + z / (2 sqrt(n)) as often as a normal value below z.
    """
    excess = (rest / _MEDIAN) ** 2 - error[None, :] ** 2
    return np.sqrt(np.maximum(np.quantile(excess, share, axis=1)[:, None], 0.0))
