"""
How well a model predicts blocks of a recording that it was not fitted on.

Blocked cross-validation (Bergmeir & Benitez, Inf. Sci. 191 (2012) 192): each block in turn is
predicted, one step ahead, by parameters found on the others.  These are one step of scoring from
the fit to everything, which moves them by what the block itself contributed; the mean is solved
again.  So a recording that is fitted once can be scored several times.

Limits: what a law of the innovations found (jumps, tails, switching) and what was searched for
(frequencies, time constants) is that of the whole recording; their number is subtracted, as the
likelihood of a fit exceeds that of the next recording by one nat a parameter (Akaike 1973).
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.mean_columns import with_mean
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate, whitened
from ou_monitor.model.terms.term import Term
from ou_monitor.records import FloatArray
from ou_monitor.text import Z95

# Blocks: with more, each is predicted from more of the recording, at more cost.
FOLDS = 6
# Step of the numerical derivatives, in the logarithm of a parameter.
_STEP = 1e-4
# A parameter moves by this at most, in its logarithm, as in a fit.
_FAR = 1.5
# Mean loss by errors of parameters, nats per sample, from which the other blocks do not
# determine them: predictions are then as far off by them as by the noise.
_UNKNOWN = 0.5
# Samples count up to this far outside of the throttle that the other blocks have been through: a
# share of its range, and what is no change of throttle at all.
_BEYOND, _STILL = 0.05, 0.01
# The rail answers for so long, s, to throttle that no other block has been through: most lags of
# recorded flights are shorter.
_AFTER = 0.2


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model, scored on what it was not fitted on."""

    model: Composite  # Fitted on everything
    # Log predictive density of each sample, its block kept back, nats; shape (n,).
    density: FloatArray
    known: npt.NDArray[np.bool_]  # Where the other blocks determine the parameters; shape (n,)
    error: FloatArray  # Error of each prediction, its block kept back, V; shape (n,)


def blocks_of(n: int) -> list[slice]:
    """Return the blocks of so many samples."""
    edges = np.linspace(0, n, FOLDS + 1).round().astype(int).tolist()
    return [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]


def held_out(samples: Samples, model: Composite) -> HeldOut:
    """Score a model that was fitted on everything on each block as if it had been kept back."""
    data = samples if model.offset is None else samples.part(
        slice(None), samples.voltage - model.offset)
    terms, events = model.gaussian.terms, model.events
    base = evaluate(data, terms, events, inside=True)
    e, v = base.innovation, base.variance
    free = [(k, name) for k, term in enumerate(terms) for name in term.free()]
    slopes = np.empty((2, samples.n, len(free)))
    for j, (k, name) in enumerate(free):
        moved, step = _stepped(terms[k], name)
        there = evaluate(data, (*terms[:k], moved, *terms[k + 1:]), events, inside=True)
        slopes[0, :, j] = (there.innovation - e) / (step * np.sqrt(v))
        slopes[1, :, j] = (there.variance - v) / (step * v)
    score = (-slopes[0] * (e / np.sqrt(v))[:, None]
             + 0.5 * slopes[1] * (e * e / v - 1.0)[:, None])
    columns = whitened(data, terms, [], events, own=True)
    blocks = blocks_of(samples.n)
    info = np.array([slopes[0, b].T @ slopes[0, b] + 0.5 * slopes[1, b].T @ slopes[1, b]
                     for b in blocks])
    gram = np.array([columns[b].T @ columns[b] for b in blocks])
    density, known = model.density.copy(), np.ones(samples.n, dtype=np.bool_)
    # What a law believes of the level it has from what comes after, too.
    error = e.copy() if model.offset is None else evaluate(samples, terms, events).innovation
    for b, own, mean in zip(blocks, info, gram, strict=True):
        others, rest = info.sum(axis=0) - own, gram.sum(axis=0) - mean
        inverse = np.linalg.pinv(others, rcond=1e-12, hermitian=True)
        beta, spread = _solved(rest)
        loss = 0.5 * (float(np.sum(inverse * own)) + float(np.sum(spread * mean[1:, 1:])))
        if not loss < _UNKNOWN * (b.stop - b.start):
            known[b] = False
            continue
        step = np.clip(-inverse @ score[b].sum(axis=0), -_FAR, _FAR)
        try:
            there = evaluate(data, with_mean(_moved(terms, free, step), beta), events, inside=True)
        except ValueError:
            # The rest leads to a model whose covariance cannot be computed.
            known[b] = False
            continue
        density[b] += there.density[b] - base.density[b]
        if model.offset is None:
            error[b] = there.innovation[b]
    laws = model.free - sum(len(term.free()) + len(term.LINEAR) for term in terms) - 1
    density -= (laws + model.search) / samples.n
    return HeldOut(model, density, known & np.isfinite(density), error)


def errors_grow(new: FloatArray, old: FloatArray, variance: FloatArray, errors: float = Z95
                ) -> bool:
    """
    Return whether one-step errors of a model are larger (rms) than those of another one.

    Under a right model its errors, of these variances (V^2), are independent of the difference,
    which is known beforehand; a sum of their products has a standard error, and the squares have
    to grow by so many of these.  A likelihood does not see it: calling a few bursts noise costs
    less there than it gains elsewhere.
    """
    difference = old - new
    error = 2.0 * math.sqrt(float(np.sum(variance * difference**2)))
    return float(np.sum(new**2 - old**2)) > errors * error


def _stepped(term: Term, name: str) -> tuple[Term, float]:
    """Return a term with a parameter moved a little, inwards at the end of its range."""
    for step in (_STEP, -_STEP):
        try:
            moved = term.moved(name, step)
        except ValueError:
            continue
        if moved != term:
            return moved, step
    return term, _STEP


def _moved(terms: tuple[Term, ...], free: list[tuple[int, str]], step: FloatArray
           ) -> tuple[Term, ...]:
    """Return terms with parameters moved, as far as their ranges go."""
    found = list(terms)
    for (k, name), by in zip(free, step.tolist(), strict=True):
        try:
            found[k] = found[k].moved(name, by)
        except ValueError:
            continue
    return tuple(found)


def _solved(gram: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the coefficients of the mean and their covariance, from sums of products."""
    inside = gram[1:, 1:]
    scale = np.sqrt(inside.diagonal())
    scale = np.where(scale > 0.0, scale, 1.0)
    inverse = np.linalg.pinv(inside / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    covariance: FloatArray = inverse / np.outer(scale, scale)
    return covariance @ gram[1:, 0], covariance


def covered(samples: Samples) -> npt.NDArray[np.bool_]:
    """Return which samples are at, or soon after, throttle that other blocks have been through."""
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
