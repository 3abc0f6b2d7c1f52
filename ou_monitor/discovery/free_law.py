"""
A free law of the noise's intensity over throttle.

Each law of the catalogue has one form, and a latent cause may owe its evidence to the misfit of
that form. So it is tested beside a free law: the logarithm of the variance is a sum of curves over
throttle, its rises, falls and changes, over several spans of time. Held-out blocks of the
recording choose the stiffness.
"""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision
from ou_monitor.discovery.gain import blocks_of
from ou_monitor.records import FloatArray
from scipy.signal import lfilter

# Memory spans of throttle, s: as the clustering statistics of `battery`, up to a few relaxations
# of a load.
_SPANS = (0.02, 0.1, 0.5, 2.5)
# Knots of the curve over throttle, and of the others.
_KNOTS, _FEW_KNOTS = 8, 5
# Segments that a recording is cut into: throttle is the same in all samples of one.
_SEGMENTS = 8000
# Largest square that counts, as in `battery`, so that bad samples shape no law.
_LARGEST = 25.0
# Prior precisions of a coefficient (ln variance): from almost free to hardly moved by 1000
# squares.
_STIFFNESS = tuple(4.0 ** k for k in range(6))
# Number of time shifts to compare with: by chance the unshifted throttle is best once in 20.
_SHIFTS = 19
# Maximum steps of a fit; gain below which it stops, nats.
_STEPS, _SETTLED = 30, 0.05


def free_law(samples: Samples, z: FloatArray) -> FloatArray | None:
    """
    Return the logarithm of the variance of scores that throttle predicts.

    Parameters
    ----------
    samples : Samples
        With throttle, or without.
    z : ndarray, shape (n,)
        Normal scores of a model.

    Returns
    -------
    ndarray, shape (n,), or None
        None where throttle does not predict the variance of held-out blocks, or where shifted
        throttle gains over half as much.

    """
    u = samples.throttle
    if u is None or not float(np.ptp(u)) > 0.0:
        return None
    size = max(1, samples.n // _SEGMENTS)
    begin = np.arange(0, samples.n, size)
    count = np.diff(np.append(begin, samples.n)).astype(np.float64)
    square = np.add.reduceat(np.minimum(z * z, _LARGEST), begin)
    means = [np.add.reduceat(one, begin) / count
             for one in _paths(u, 1.0 / float(np.median(samples.step[1:])))]
    columns = np.column_stack([np.ones(begin.size), _hats(means[0], _KNOTS),
                               *(_hats(one, _FEW_KNOTS) for one in means[1:])])
    columns[:, 1:] -= count @ columns[:, 1:] / count.sum()
    blocks = blocks_of(begin.size)
    # Fisher information of m normal scores on the logarithm of their variance: m/2.
    known = np.array([0.5 * (columns[b].T * count[b]) @ columns[b] for b in blocks])
    worth = [sum(_kept_back(columns, square, count, b, known.sum(axis=0) - own, stiff)
                 for b, own in zip(blocks, known, strict=True)) for stiff in _STIFFNESS]
    best = int(np.argmax(worth))
    if not worth[best] > decision.ACCEPT:
        return None

    def fitted(columns: FloatArray) -> FloatArray:
        return columns @ _fitted(columns, square, count, known.sum(axis=0), _STIFFNESS[best])

    log = fitted(columns)
    # A wandering intensity follows any throttle for a while.
    others = [_gain(fitted(np.roll(columns, k * begin.size // (_SHIFTS + 1), axis=0)), square,
                    count) for k in range(1, _SHIFTS + 1)]
    if max(others) > decision.OWN * _gain(log, square, count):
        return None
    return np.asarray(np.repeat(log, size)[:samples.n])


def _paths(u: FloatArray, rate: float) -> Iterator[FloatArray]:
    """Yield throttle, and its rises, falls and changes as each span remembers them."""
    yield u
    change = np.diff(u, prepend=u[0])
    rise, fall = np.maximum(change, 0.0), np.maximum(-change, 0.0)
    for span in _SPANS:
        # Of a slower recording, the last sample.
        keep = math.exp(-1.0 / (span * rate))
        for one in (rise, fall, change):
            yield np.asarray(lfilter([1.0], [1.0, -keep], one))


def _hats(x: FloatArray, knots: int) -> FloatArray:
    """Return hat functions over the quantiles of a series, less the first."""
    at = np.unique(np.quantile(x, np.linspace(0.0, 1.0, knots)))
    rows = [np.interp(x, at, row) for row in np.eye(at.size)[1:]]
    return np.stack(rows, axis=1) if rows else np.empty((x.size, 0))


def _fitted(columns: FloatArray, square: FloatArray, count: FloatArray, known: FloatArray,
            stiff: float) -> FloatArray:
    """Return the coefficients of the logarithm of the variance (Fisher's scoring)."""
    prior = stiff * np.eye(columns.shape[1])
    prior[0, 0] = 0.0
    inverse = np.linalg.inv(known + prior)
    beta = np.zeros(columns.shape[1])
    beta[0] = math.log(max(float(square.sum() / count.sum()), 1e-300))

    def value(b: FloatArray) -> float:
        return _density(columns @ b, square, count) - 0.5 * float(b @ prior @ b)

    top = value(beta)
    for _ in range(_STEPS):
        slope = 0.5 * columns.T @ (square * np.exp(-(columns @ beta)) - count) - prior @ beta
        step = inverse @ slope
        found = max((beta + share * step for share in (1.0, 0.5, 0.1)), key=value)
        gain = value(found) - top
        if gain < _SETTLED:
            break
        beta, top = found, top + gain
    return beta


def _kept_back(columns: FloatArray, square: FloatArray, count: FloatArray, block: slice,
               known: FloatArray, stiff: float) -> float:
    """Return the gain on a block, nats, of the law fitted to the other blocks, over no law."""
    rest = np.ones(count.size, dtype=np.bool_)
    rest[block] = False
    beta = _fitted(columns[rest], square[rest], count[rest], known, stiff)
    return _gain(columns[block] @ beta, square[block], count[block],
                 float(square[rest].sum() / count[rest].sum()))


def _gain(log: FloatArray, square: FloatArray, count: FloatArray, level: float = 0.0) -> float:
    """Return the gain of a law over a constant variance (by default the mean), nats."""
    level = math.log(max(level or float(square.sum() / count.sum()), 1e-300))
    return _density(log, square, count) - _density(np.full(log.size, level), square, count)


def _density(log: FloatArray, square: FloatArray, count: FloatArray) -> float:
    """Return the log density of sums of squares up to a constant, nats."""
    return -0.5 * float(count @ log + square @ np.exp(-log))
