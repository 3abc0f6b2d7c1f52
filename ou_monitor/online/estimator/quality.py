"""
What is wrong with the input, told from the samples before any model.

In a diffusion equal neighbours have probability zero, so repeats, lattices
and mass at the extremes are exact findings.  Done on the newest samples, and
not at every estimate.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.online.estimator.repeats import refresh_period
from ou_monitor.records import FloatArray

# Raw samples looked at.
TAIL = 1024
# Fewest samples from which anything is told.
_ENOUGH = 64
# A lattice needs this many different steps, all whole multiples of one, and
# at most this many codes: fewer distinct steps are chance, more are a fine ADC.
_FEWEST_STEPS = 3
# Share of samples that change, of those next to each other, below which the
# ADC is coarse.
_TIED = 0.9
# Share of samples at the extreme from which the ADC range counts as left, and
# how many times more often than the code beside it.
_CLIPPED_SHARE = 0.01
_CLIPPED_EXCESS = 3.0


@dataclass(frozen=True)
class Quality:
    """
    Findings about raw samples.

    Attributes
    ----------
    step : float
        ADC step, V; 0 when the values lie on no lattice.
    held : float
        Samples per refresh of a source that repeats its last value; 1: none.
    saturated : bool
        Whether samples pile up at an extreme.
    rms_increment : float
        Root mean square of the steps between fresh samples, V.

    """

    step: float = 0.0
    held: float = 1.0
    saturated: bool = False
    rms_increment: float = math.nan


def examine(y: FloatArray, known: float = 1.0) -> Quality:
    """Return what the raw samples show (y in V)."""
    if y.size < _ENOUGH:
        return Quality(held=known)
    steps = np.diff(y)
    changes = np.flatnonzero(steps)
    if changes.size < _FEWEST_STEPS:
        return Quality(held=known)
    sizes = np.abs(steps[changes])
    held = refresh_period(y, known)
    fresh = sizes if held > 1.0 else steps
    # Where many neighbours are equal, a few different steps are a lattice, too.
    tied = held == 1.0 and changes.size < _TIED * steps.size
    return Quality(lattice(sizes, 1 if tied else _FEWEST_STEPS), held, _piles_up(y, held),
                   float(np.sqrt(np.mean(fresh * fresh))))


def lattice(sizes: FloatArray, fewest: int = _FEWEST_STEPS) -> float:
    """
    Return the common step of increments, V; 0 when there is none.

    Float32 values of a lattice miss it by their rounding, which is allowed
    for; a lattice finer than a thousandth of the largest step is not told.
    """
    ordered = np.unique(sizes)
    least = float(ordered[0])
    # Rounding splits one step into several: join what is within 1e-3 of the least.
    near = ordered[ordered < 1.001 * least]
    unit = float(near.mean())
    multiples = np.rint(ordered / unit)
    if multiples[-1] > 1000.0 or np.unique(multiples).size < fewest:
        return 0.0
    unit = float((ordered @ multiples) / (multiples @ multiples))
    return unit if bool((np.abs(ordered - multiples * unit) < 0.02 * unit).all()) else 0.0


def _piles_up(y: FloatArray, held: float) -> bool:
    """Whether one extreme is far more common than the value next to it."""
    values, counts = np.unique(y, return_counts=True)
    if values.size < _FEWEST_STEPS:
        return False
    least = max(10.0 * held, _CLIPPED_SHARE * y.size)
    for edge, beside in ((0, 1), (-1, -2)):
        if counts[edge] >= least and counts[edge] > _CLIPPED_EXCESS * counts[beside]:
            return True
    return False
