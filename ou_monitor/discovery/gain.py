"""
Gain of a model on samples that were not used for its fit.

Blocked cross-validation (Bergmeir & Benitez, Inf. Sci. 191 (2012) 192): each block in turn is
predicted, one step ahead, with parameters from the other blocks.  One fit to everything is enough:
for each block, one scoring step removes its contribution, and the mean is fitted again.  Scores
are log densities; neighbouring scores are correlated, so their error comes from means of blocks.
Only samples at a throttle that the other blocks cover are scored; elsewhere models extrapolate.

Limits: laws of the innovations (jumps, tails, switching) and searched values (frequencies, time
constants) are not fitted again without the block.  Instead one nat is subtracted for each of their
parameters, which is the expected optimism of a fit (Akaike 1973).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import (
    evaluate, Events, GaussianFit, gradients, slopes_of, solved, whitened, with_mean, within_range)
from ou_monitor.discovery.words import unmeasured_words
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN
from scipy.special import ndtr
from scipy.stats import chi2

# Number of blocks of the held-out samples: the minimum for a good estimate of their spread.
BLOCKS = 24
# A gain is unknown if its error exceeds both _VAGUE times the gain and _WIDE nats per sample.
_VAGUE, _WIDE = 10.0, 0.1


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
    # Covariance of neighbouring blocks (Bartlett weight 1/2, for both sides); ignored if negative.
    shared = max(float(c[1:] @ c[:-1]) / (BLOCKS - 1), 0.0)
    return mean, math.sqrt((own + shared) / BLOCKS)


def without(samples: Samples, model: Composite, *indices: int, plain: Composite | None = None
            ) -> Composite | None:
    """Return the model fitted to everything without some of its terms; None if that fails."""
    # A fit worse than `plain` has not converged, and is repeated from another start.
    kept = complete(term for k, term in enumerate(model.terms) if k not in indices)
    laws = any(model.terms[k].ROLE is Role.LAW for k in indices)
    known = None if laws else model
    found = [_fitted(samples, kept, known)]
    # A model with further states may be fitted to only a part of the samples, and effects that the
    # `ou` must now explain may be missing in that part.  So also fit all samples, without states.
    light = complete(term for term in kept if term.ROLE is not Role.BLOCK)
    if len(light) < len(kept):
        found.append(_fitted(samples, light, known))
    if plain is None or not any(fit is not None and float(fit.density.sum()) >= float(
            plain.density.sum()) for fit in found):
        # Without white noise or a response to throttle, the `ou` has to explain their effects.
        found.append(_fitted(samples, (guess(samples), *kept[1:]), known))
    return max((fit for fit in found if fit is not None), default=None,
               key=lambda fit: float(fit.density.sum()))


def complete(terms: Iterable[Term]) -> list[Term]:
    """Return terms without the modifiers of terms that are missing."""
    kept = list(terms)
    names = {term.NAME for term in kept}
    return [term for term in kept if term.CHANGES is None or term.CHANGES.NAME in names]


def _fitted(samples: Samples, terms: Sequence[Term], known: Composite | None
            ) -> Composite | None:
    try:
        found = fit_composite(samples, terms, slice(0, samples.n), known, rough=True)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Parameters out of range, or an overflow.
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
    """Return the gain of one model over another and its error, nats; NaN if unknown."""
    both = scored & new.known & old.known
    if int(both.sum()) < BLOCKS:
        return NAN, NAN
    gain, error = mean_difference(new.density[both], old.density[both])
    return (NAN, NAN) if error > max(_VAGUE * abs(gain), _WIDE) else (gain, error)


def shrink_of(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_]) -> float:
    """Return the relative reduction of the rms of one-step errors; NaN if unknown."""
    both = scored & new.known & old.known
    if int(both.sum()) < BLOCKS or not old.error[both].any():
        return NAN
    return 1.0 - math.sqrt(float(np.mean(new.error[both] ** 2) / np.mean(old.error[both] ** 2)))


def growth_of(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_]) -> float:
    """Return by how many standard errors the squares of one-step errors grew."""
    # If the new model is right, its errors are independent of the differences from the old ones;
    # their variances, V^2, then give the standard error of the increase.  Errors may grow although
    # the likelihood rises: a model may treat a few bursts as noise and gain elsewhere.
    both = scored & new.known & old.known
    now, before = new.error[both], old.error[both]
    variance = new.model.gaussian.variance[both]
    error = 2.0 * math.sqrt(float(np.sum(variance * (before - now)**2)))
    return float(np.sum(now**2 - before**2)) / max(error, 1e-300)


def why_unknown(new: HeldOut, old: HeldOut, scored: npt.NDArray[np.bool_],
                load: str | None) -> str:
    """Return why a gain cannot be measured, in words; empty if it can."""
    count = int((scored & new.known & old.known).sum())
    return unmeasured_words(BLOCKS, count, load) if count < BLOCKS else ''


def cause_gain(full: HeldOut, less: HeldOut, scored: npt.NDArray[np.bool_]
               ) -> tuple[float, float, float]:
    """Return the gain of the larger of two models, its error, nats per sample, and a p-value."""
    # The p-value is twice the smaller of two p-values: of the likelihood ratio on everything,
    # corrected for the search, and of the gain on held-out samples.
    gain, error = gain_of(full, less, scored)
    ratio = 2.0 * float((full.model.density - less.model.density).sum())
    tail = float(chi2.logsf(max(ratio, 0.0), max(full.model.free - less.model.free, 1)))
    fitted = math.exp(min(tail + full.model.search - less.model.search, 0.0))
    kept = float(ndtr(-gain / error)) if error > 0.0 else 1.0
    return gain, error, min(1.0, 2.0 * min(fitted, kept))


# Number of blocks of the cross-validation.
FOLDS = 6
# Maximum change of a parameter, in its logarithm, as in a fit.
_FAR = 1.5
# Maximum mean loss from errors of the parameters, nats per sample; at the limit, their effect is
# as large as the noise.
_UNKNOWN = 0.5
# Maximum number of times that a step is halved; then only the mean is fitted again.
_HALVINGS = 5
# Maximum loss of likelihood of the other blocks for a step to be accepted, nats.
_ROUGH = 0.1
# Margin by which throttle may exceed the range of the other blocks: share of that range, and its
# minimum.
_BEYOND, _STILL = 0.05, 0.01
# After throttle that no other block contains, samples are not scored for this time, s; most lags
# of recorded flights are shorter.
_AFTER = 0.2


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model, scored on held-out samples."""

    model: Composite  # Fitted on everything
    # Log predictive density of each sample with its block held out, nats; shape (n,).
    density: FloatArray
    known: npt.NDArray[np.bool_]  # Whether other blocks determine the parameters; shape (n,)
    error: FloatArray  # Error of each prediction with its block held out, V; shape (n,)


def blocks_of(n: int) -> list[slice]:
    """Return the blocks of `n` samples."""
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int).tolist()
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]


def held_out(samples: Samples, model: Composite) -> HeldOut:
    """Score a model fitted to everything on each block, as if the block had been held out."""
    data = samples if model.offset is None else samples.part(
        slice(None), samples.voltage - model.offset)
    terms, events = model.gaussian.terms, model.events
    base = evaluate(data, terms, events, inside=True)
    free = [(k, name) for k, term in enumerate(terms) for name in term.free()]
    means, spreads, _ = slopes_of(data, terms, events, base, free)
    score = gradients(base, means, spreads)
    columns = whitened(data, terms, [], events, own=True)
    blocks = blocks_of(samples.n)
    info = np.array([means[b].T @ means[b] + 0.5 * spreads[b].T @ spreads[b] for b in blocks])
    gram = np.array([columns[b].T @ columns[b] for b in blocks])
    density, known = model.density.copy(), np.ones(samples.n, dtype=np.bool_)
    # A law estimates its offset from later samples too, so the errors are computed without it; its
    # errors of readings are those of the samples before.
    biased = events is not None and bool(events.bias.any())
    plain = evaluate(samples, terms, events) if biased or model.offset is not None else base
    error = plain.innovation.copy()
    for b, own, mean in zip(blocks, info, gram, strict=True):
        others, rest = info.sum(axis=0) - own, gram.sum(axis=0) - mean
        inverse = np.linalg.pinv(others, rcond=1e-12, hermitian=True)
        beta, spread = solved(rest)
        loss = 0.5 * (float(np.sum(inverse * own)) + float(np.sum(spread * mean[1:, 1:])))
        if not loss < _UNKNOWN * (b.stop - b.start):
            known[b] = False
            continue
        step = np.clip(-inverse @ score[b].sum(axis=0), -_FAR, _FAR)
        there = _refitted(data, terms, events, free, step, beta, base.density, b)
        if there is None:
            # No valid model without the block.
            known[b] = False
            continue
        density[b] += there.density[b] - base.density[b]
        if model.offset is None:
            there = evaluate(data, there.terms, events) if biased else there
            error[b] = there.innovation[b]
    laws = model.free - sum(len(term.free()) + len(term.LINEAR) for term in terms) - 1
    density -= (laws + model.search) / samples.n
    return HeldOut(model, density, known & np.isfinite(density), error)


def _refitted(data: Samples, terms: Sequence[Term], events: Events | None,
              free: Sequence[tuple[int, str]], step: FloatArray, beta: FloatArray,
              density: FloatArray, block: slice) -> GaussianFit | None:
    """Return the model without a block: after a scoring step, halved until it suits the rest."""
    # If the likelihood hardly distinguishes parameters, a step in them can be far too long.
    others = np.ones(density.size, dtype=np.bool_)
    others[block] = False
    for turn in range(_HALVINGS + 1):
        moved = all_moved(terms, free, step * 0.5 ** turn if turn < _HALVINGS else 0.0 * step)
        try:
            there = evaluate(data, with_mean(moved, beta), events, inside=True)
        except ValueError:
            continue
        if turn == _HALVINGS or float((there.density - density)[others].sum()) > -_ROUGH:
            return there
    return None


def all_moved(terms: Sequence[Term], free: Sequence[tuple[int, str]], step: FloatArray
              ) -> tuple[Term, ...]:
    """Return terms with parameters moved, but not beyond their ranges."""
    found = list(terms)
    for (k, name), by in zip(free, step.tolist(), strict=True):
        found[k] = within_range(found[k], name, by)
    return tuple(found)


def covered(samples: Samples) -> npt.NDArray[np.bool_]:
    """Return where throttle, now and for `_AFTER` before, is in the range of other blocks."""
    found = np.ones(samples.n, dtype=np.bool_)
    u = samples.throttle
    if u is None:
        return found
    for b in blocks_of(samples.n):
        rest = np.concatenate((u[:b.start], u[b.stop:]))
        low, high = float(rest.min()), float(rest.max())
        margin = max(_BEYOND * (high - low), _STILL)
        found[b] = (u[b] >= low - margin) & (u[b] <= high + margin)
    last = np.maximum.accumulate(np.where(found, -np.inf, samples.t))
    return found & (samples.t - last > _AFTER)
