"""
What a model gains on samples that it was not fitted on.

Scores are log densities of one-step predictions, each block of the recording kept back in turn
(`validation`).  Neighbours share a part of theirs, so errors come from means of blocks.  Only
samples at throttle that the other blocks cover are scored: elsewhere a model extrapolates, and
its score says nothing of it.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import CrossingRate
from ou_monitor.discovery.validation import errors_grow, HeldOut
from ou_monitor.discovery.words import unmeasured_words
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN
from scipy.special import ndtr
from scipy.stats import chi2

# Blocks of the samples kept; the fewest with which a spread is estimated well.
BLOCKS = 24
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


def without(samples: Samples, model: Composite, *indices: int, plain: Composite | None = None
            ) -> Composite | None:
    """
    Return the model fitted again to everything without some of its terms; None for none.

    A fit that is worse than the plain one has gone astray, and is tried from elsewhere.
    """
    kept = [term for k, term in enumerate(model.terms) if k not in indices]
    # What changes a term that is gone has gone with it.
    names = {term.NAME for term in kept}
    kept = [term for term in kept if term.CHANGES is None or term.CHANGES.NAME in names]
    laws = any(model.terms[k].ROLE is Role.LAW for k in indices)
    known = None if laws else model
    first = _fitted(samples, kept, known)
    if first is not None and plain is not None and (
            float(first.density.sum()) >= float(plain.density.sum())):
        return first
    # Without white noise or an answer to throttle the rail itself has to be what they were.
    second = _fitted(samples, (guess(samples), *kept[1:]), known)
    return max((fit for fit in (first, second) if fit is not None), default=None,
               key=lambda fit: float(fit.density.sum()))


def _fitted(samples: Samples, terms: Sequence[Term], known: Composite | None
            ) -> Composite | None:
    """Return a fit to everything; None where there is none."""
    try:
        found = fit_composite(samples, terms, slice(0, samples.n), known, rough=True)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Parameters have left what a term allows, or numbers can hold.
        return None
    return found if found is not None and math.isfinite(float(found.density.sum())) else None


def guess(samples: Samples) -> OU:
    """Return a start for the fit of an OU: from the correlation of neighbours."""
    v = samples.voltage
    c = v - v.mean()
    power = float(c @ c)
    keep = min(max(float(c[1:] @ c[:-1]) / power, 0.05), 0.9999)
    alpha = -math.log(keep) / float(np.median(samples.step[1:]))
    return OU(alpha, math.sqrt(power / c.size * 2.0 * alpha), float(v.mean()))


def gain_of(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_]) -> tuple[float, float]:
    """Return the gain of one model over another and its error, nats; NaN where it is not known."""
    both = scored & new.known & old.known
    if int(both.sum()) < BLOCKS:
        return NAN, NAN
    return if_known(*mean_difference(new.density[both], old.density[both]))


def shrink_of(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_]) -> float:
    """Return the share by which the rms of one-step errors shrinks; NaN where it is not known."""
    both = scored & new.known & old.known
    if int(both.sum()) < BLOCKS or not old.error[both].any():
        return NAN
    return 1.0 - math.sqrt(float(np.mean(new.error[both] ** 2) / np.mean(old.error[both] ** 2)))


def grown(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_], errors: float) -> bool:
    """Return whether one-step errors are larger than before by so many errors of that."""
    both = scored & new.known & old.known
    return errors_grow(new.error[both], old.error[both], new.model.gaussian.variance[both], errors)


def why_unknown(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_],
                throttle: bool) -> str:
    """Return why a gain cannot be measured, for people; empty where it can."""
    count = int((scored & new.known & old.known).sum())
    return unmeasured_words(BLOCKS, count, throttle) if count < BLOCKS else ''


def cause_gain(full: HeldOut, less: HeldOut, scored: npt.NDArray[np.bool_]
               ) -> tuple[float, float, float]:
    """
    Return the gain of the larger of two models, its error, nats per sample, and its chance.

    The chance is twice the smaller of two: that of the likelihood ratio on everything, with the
    price of what was searched, and that of the gain on what was kept back.
    """
    gain, error = gain_of(full, less, scored)
    ratio = 2.0 * float((full.model.density - less.model.density).sum())
    tail = float(chi2.logsf(max(ratio, 0.0), max(full.model.free - less.model.free, 1)))
    fitted = math.exp(min(tail + full.model.search - less.model.search, 0.0))
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
    v = samples.logged
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
    scored = np.ones(samples.n, dtype=np.bool_) if scored is None else scored
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
    observed = crossings(t, samples.logged, level, scored)
    # As if crossings came independently of each other; none at all is as uncertain as one.
    minutes = float(np.diff(t)[scored[1:] & scored[:-1]].sum()) / 60.0
    error = math.sqrt(max(observed * minutes, 1.0)) / minutes if minutes > 0.0 else NAN
    return CrossingRate(level, observed, rates[0][0], rates[1][0], error, rates[0][1],
                        rates[1][1])
