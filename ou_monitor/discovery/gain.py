"""
What a model gains on samples that it was not fitted on.

Scores are log densities of one-step predictions.  Neighbours share a part of
theirs, so errors come from means of blocks.  Only samples at throttle that the
part fitted covers are scored: elsewhere a model extrapolates, and its score says
nothing of it.

The gain stated is that of the true model, of which the fitted one loses what
its parameters are off.  Its error covers both: which samples happen to be
scored, and that loss.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.errors import Estimation, estimations
from ou_monitor.discovery.finding import CrossingRate
from ou_monitor.discovery.words import unmeasured_words
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.term import Term
from ou_monitor.records import FloatArray, NAN
from scipy.special import ndtr
from scipy.stats import chi2

# Blocks of the samples kept; the fewest with which a spread is estimated well.
BLOCKS = 24
# Mean loss by errors of parameters, nats per sample, from which the part fitted does not
# determine them: predictions are then as far off by them as by the noise.
_UNKNOWN = 0.5
# A gain whose error is so many times as large, and so many nats per sample, is not measured.
_VAGUE, _WIDE = 10.0, 0.1
# Level of the crossings: standard deviations below the mean, lowered in steps
# until both the part fitted and the part kept cross it so often.
_DEEP, _STEP, _SHALLOW, _OFTEN = 2.5, 0.25, 0.5, 5
# Simulations of each model.
_DRAWS = 8


def mean_score(density: FloatArray, scored: npt.NDArray[np.bool_]) -> float:
    """Return the mean log density of the samples scored, nats; NaN for fewer than `BLOCKS`."""
    return float(density[scored].mean()) if int(scored.sum()) >= BLOCKS else NAN


def mean_difference(new: FloatArray, old: FloatArray) -> tuple[float, float]:
    """Return the mean of a paired difference and its standard error (new, old in nats)."""
    difference = np.asarray(new, dtype=np.float64) - np.asarray(old, dtype=np.float64)
    size = difference.size // BLOCKS
    if size < 1:
        return NAN, NAN
    mean = float(difference.mean())
    blocks = difference[:size * BLOCKS].reshape(BLOCKS, size).mean(axis=1)
    c = blocks - blocks.mean()
    own = float(c @ c) / (BLOCKS - 1)
    # Half the weight of a full lag; negative correlation is not trusted.
    shared = max(float(c[1:] @ c[:-1]) / (BLOCKS - 1), 0.0)
    return mean, math.sqrt((own + shared) / BLOCKS)


def if_known(gain: float, error: float) -> tuple[float, float]:
    """Return a gain and its error; NaN for both where the error says that nothing is known."""
    return (NAN, NAN) if error > max(_VAGUE * abs(gain), _WIDE) else (gain, error)


def without(samples: Samples, model: Composite, *indices: int) -> Composite | None:
    """Return the model fitted again without some of its terms; None where it cannot be."""
    kept = [term for k, term in enumerate(model.terms) if k not in indices]
    try:
        return fit_composite(samples, kept, samples.train)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Parameters have left what a term allows, or numbers can hold.
        return None


class Scale:
    """
    What the gain of a model and of its terms is measured on.

    Parameters
    ----------
    samples : Samples
        The recording.
    model : Composite
        Fitted on its first part.
    scored : ndarray of bool, shape (n,), optional
        Samples that count; those of `covered` where not given.

    """

    def __init__(self, samples: Samples, model: Composite,
                 scored: npt.NDArray[np.bool_] | None = None) -> None:
        self._samples, self._model = samples, model
        self.scored = samples.covered if scored is None else scored

    @property
    def estimation(self) -> Estimation:
        """Return what the samples scored ask of the parameters."""
        return self._estimations[0]

    @cached_property
    def _estimations(self) -> list[Estimation]:
        """Return what errors of parameters cost on the samples scored, and on all kept."""
        kept = np.zeros(self._samples.n, dtype=np.bool_)
        kept[self._samples.test] = True
        return estimations(self._samples, self._model, self.scored, kept)

    def why_unknown(self, terms: Collection[int] | None = None) -> str:
        """Return why a gain cannot be measured, for people; empty where it can."""
        model, count = self._model, int(self.scored.sum())
        if count < BLOCKS:
            kept = self._samples.n - self._samples.test.start
            uncovered = int(self._samples.covered.sum()) < BLOCKS <= kept
            return unmeasured_words(BLOCKS, count, uncovered)
        if self._estimations[1].loss(terms)[0] <= _UNKNOWN:
            return ''
        owners = range(len(model.terms)) if terms is None else terms
        return unmeasured_words(BLOCKS, count, any(
            model.terms[k].NEEDS_THROTTLE for k in owners))

    def gain(self, new: FloatArray, old: FloatArray, terms: Collection[int] | None = None
             ) -> tuple[float, float]:
        """
        Return a gain and its standard error, nats per sample; NaN where it cannot be measured.

        That is where `why_unknown` says why, and where the error is both ten
        times as large as the gain and large beside any gain there is.
        """
        if self.why_unknown(terms):
            return NAN, NAN
        gain, error = mean_difference(new[self.scored], old[self.scored])
        return if_known(gain, math.hypot(error, self.estimation.loss(terms)[1]))


def cause_gain(samples: Samples, full: Composite, less: Composite, scale: Scale | None = None,
               terms: Collection[int] | None = None) -> tuple[float, float, float]:
    """Return the gain of the larger of two models, its error, nats per sample, and its chance."""
    scale = Scale(samples, full) if scale is None else scale
    gain, error = scale.gain(full.density, less.density, terms)
    train = samples.train
    ratio = 2.0 * float((full.density[train] - less.density[train]).sum())
    tail = float(chi2.logsf(max(ratio, 0.0), max(full.free - less.free, 1)))
    fitted = math.exp(min(tail + full.search - less.search, 0.0))
    kept = float(ndtr(-gain / error)) if error > 0.0 else 1.0
    return gain, error, min(1.0, 2.0 * min(fitted, kept))


def crossings(t: FloatArray, voltage: FloatArray, level: float,
              scored: npt.NDArray[np.bool_] | None = None) -> float:
    """Return downward crossings of a level per minute, between neighbours that are scored."""
    pairs = np.ones(t.size - 1, dtype=np.bool_) if scored is None else scored[1:] & scored[:-1]
    span = float(np.diff(t)[pairs].sum())
    return 60.0 * _falls(voltage, level, pairs) / span if span > 0.0 else NAN


def crossing_level(samples: Samples, scored: npt.NDArray[np.bool_] | None = None) -> float:
    """Return a level that is crossed now and then in both parts, V."""
    v = samples.voltage
    fitted, kept = np.zeros((2, samples.n), dtype=np.bool_)
    fitted[samples.train] = True
    kept[samples.test] = True
    parts = [part[1:] & part[:-1] for part in (fitted, kept if scored is None else scored)]
    mean, spread = float(v.mean()), float(v.std())
    depth = _DEEP
    while depth > _SHALLOW and min(
            _falls(v, mean - depth * spread, pairs) for pairs in parts) < _OFTEN:
        depth -= _STEP
    level = mean - depth * spread
    below, above = v[v < level], v[v >= level]
    # Half-way between codes of an ADC: there rounding changes no crossing.
    return 0.5 * float(below.max() + above.min()) if below.size and above.size else level


def _falls(v: FloatArray, level: float, pairs: npt.NDArray[np.bool_]) -> int:
    return int(((v[:-1] >= level) & (v[1:] < level) & pairs).sum())


def crossing_rates(samples: Samples, baseline: Sequence[Term], extended: Sequence[Term],
                   rng: np.random.Generator, scored: npt.NDArray[np.bool_] | None = None
                   ) -> CrossingRate:
    """Compare how often a level is crossed, in the data and in simulations."""
    scored = samples.covered if scored is None else scored
    if int(scored.sum()) < BLOCKS:
        return CrossingRate()
    level, t = crossing_level(samples, scored), samples.t
    rates = []
    for terms in (baseline, extended):
        try:
            model = SupplyModel(tuple(terms))
            # Drift and tones count from the first sample of all.
            found = [crossings(t, model.simulate(t, rng, samples.throttle), level, scored)
                     for _ in range(_DRAWS)]
        except ValueError:
            found = [NAN, NAN]
        rates.append((float(np.mean(found)), float(np.std(found, ddof=1)) / math.sqrt(len(found))))
    observed = crossings(t, samples.voltage, level, scored)
    # As if crossings came independently of each other; none at all is as uncertain as one.
    minutes = float(np.diff(t)[scored[1:] & scored[:-1]].sum()) / 60.0
    error = math.sqrt(max(observed * minutes, 1.0)) / minutes if minutes > 0.0 else NAN
    return CrossingRate(level, observed, rates[0][0], rates[1][0], error, rates[0][1],
                        rates[1][1])
