"""
What a model is worth on samples that it has not seen.

Scores are log densities of one-step predictions.  They differ from sample to
sample by what neighbours share, so errors come from means of blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.term import Term
from ou_monitor.offline.discover.composite import Composite, fit_composite
from ou_monitor.offline.discover.data import Samples
from ou_monitor.offline.discover.finding import CrossingRate
from ou_monitor.records import FloatArray, NAN
from scipy.special import ndtr
from scipy.stats import chi2

# Blocks of the samples kept; the fewest with which a spread is estimated well.
BLOCKS = 24
# Level of the crossings: standard deviations below the mean, lowered in steps
# until both the part fitted and the part kept cross it so often.
_DEEP, _STEP, _SHALLOW, _OFTEN = 2.5, 0.25, 0.5, 5
# Simulations of each model.
_DRAWS = 8


def mean_difference(new: FloatArray, old: FloatArray) -> tuple[float, float]:
    """
    Return the mean of a paired difference and its standard error.

    Parameters
    ----------
    new, old : ndarray, shape (n,)
        Log densities of the same samples, nats.

    Returns
    -------
    mean, se : float
        nats per sample.  The error is that of means of `BLOCKS` blocks, one
        lag of their correlation included (Newey & West, Econometrica 55
        (1987) 703); NaN with fewer samples than blocks.

    """
    difference = np.asarray(new, dtype=np.float64) - np.asarray(old, dtype=np.float64)
    mean = float(difference.mean()) if difference.size else NAN
    size = difference.size // BLOCKS
    if size < 1:
        return mean, NAN
    blocks = difference[:size * BLOCKS].reshape(BLOCKS, size).mean(axis=1)
    c = blocks - blocks.mean()
    own = float(c @ c) / (BLOCKS - 1)
    # Half the weight of a full lag; negative correlation is not trusted.
    shared = max(float(c[1:] @ c[:-1]) / (BLOCKS - 1), 0.0)
    return mean, math.sqrt((own + shared) / BLOCKS)


def without(samples: Samples, model: Composite, index: int) -> Composite | None:
    """Return the model fitted again without one of its terms."""
    kept = [term for k, term in enumerate(model.terms) if k != index]
    return fit_composite(samples, kept, samples.train)


def worth(samples: Samples, full: Composite, less: Composite) -> tuple[float, float, float]:
    """
    Return what the larger of two models gains.

    Parameters
    ----------
    samples : Samples
        What both were fitted on the first part of.
    full, less : Composite
        With and without a cause.

    Returns
    -------
    gain, gain_se : float
        On the part kept, nats per sample.
    p_value : float
        The smaller of two, doubled: of the likelihood ratio on the part fitted
        (chi-squared with as many degrees of freedom as there are more
        parameters, times what was searched) and of gain / gain_se (normal).

    """
    test, train = samples.test, samples.train
    gain, error = mean_difference(full.density[test], less.density[test])
    ratio = 2.0 * float((full.density[train] - less.density[train]).sum())
    tail = float(chi2.logsf(max(ratio, 0.0), max(full.free - less.free, 1)))
    fitted = math.exp(min(tail + full.search - less.search, 0.0))
    kept = float(ndtr(-gain / error)) if error > 0.0 else 1.0
    return gain, error, min(1.0, 2.0 * min(fitted, kept))


def crossings(t: FloatArray, voltage: FloatArray, level: float) -> float:
    """Return downward crossings of a level per minute."""
    span = float(t[-1] - t[0])
    return 60.0 * _falls(voltage, level) / span if span > 0.0 else NAN


def crossing_level(samples: Samples) -> float:
    """Return a level that is crossed now and then in both parts, V."""
    v = samples.voltage
    mean, spread = float(v.mean()), float(v.std())
    depth = _DEEP
    while depth > _SHALLOW and min(
            _falls(v[part], mean - depth * spread)
            for part in (samples.train, samples.test)) < _OFTEN:
        depth -= _STEP
    level = mean - depth * spread
    below, above = v[v < level], v[v >= level]
    # Half-way between codes of an ADC: there rounding changes no crossing.
    return 0.5 * float(below.max() + above.min()) if below.size and above.size else level


def _falls(v: FloatArray, level: float) -> int:
    return int(((v[:-1] >= level) & (v[1:] < level)).sum())


def crossing_rates(samples: Samples, baseline: Sequence[Term], extended: Sequence[Term],
                   rng: np.random.Generator) -> CrossingRate:
    """
    Compare how often a level is crossed, in the data and in simulations.

    Parameters
    ----------
    samples : Samples
        The recording; its last part is compared.
    baseline, extended : sequence of Term
        Models fitted on its first part.
    rng : numpy.random.Generator
        Source of randomness.

    Returns
    -------
    CrossingRate
        NaN for a model that cannot be simulated.

    """
    level, part = crossing_level(samples), samples.test
    t = samples.t[part]
    rates = []
    for terms in (baseline, extended):
        try:
            model = SupplyModel(tuple(terms))
            # Drift and tones count from the first sample of all.
            found = [crossings(t, model.simulate(samples.t, rng, samples.throttle)[part], level)
                     for _ in range(_DRAWS)]
        except ValueError:
            found = [NAN, NAN]
        rates.append((float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(len(found))))
    v, span = samples.voltage[part], float(t[-1] - t[0])
    # As if crossings came independently of each other.
    error = 60.0 * math.sqrt(_falls(v, level)) / span if span > 0.0 else NAN
    return CrossingRate(level, crossings(t, v, level), rates[0][0], rates[1][0], error,
                        rates[0][1], rates[1][1])
