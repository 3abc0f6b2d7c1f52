"""
One-step innovations of a linear Gaussian state-space model, without a Python loop over samples.

x_k = F_k x_{k-1} + w_k, y_k = H x_k + v_k with F_k, Var w_k = Q_k and Var v_k =
R_k changing from step to step.  The joint precision of all states is block
tridiagonal; its banded Cholesky factor, in the order of time, is the
information form of the Kalman filter (Rue & Held, Gaussian Markov Random
Fields, 2005).

If the model is constant, the gain converges: it is computed for the first samples only, and a
filter with constant gain processes the rest.

Limits: Q_k must be invertible and R_k above 0 (without measurement noise, set R_k to a millionth
of Q_k); the cost grows with the square of the number of states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.linalg.lapack import dpbtrf, dpttrf, dtbtrs
from scipy.signal import lfilter


@dataclass(frozen=True)
class StateSpace:
    """A model over n samples with d states."""

    # Transition matrices into each sample; the first is not used; shape (n, d, d).
    f: FloatArray
    # Covariance of the noise added in each transition, V^2; the first is the covariance of the
    # initial state; shape (n, d, d).
    q: FloatArray
    h: FloatArray  # Observation vector; shape (d,)
    r: FloatArray  # Variance of the measurement noise, V^2, > 0; shape (n,)


class Filter:
    """Kalman filter of a model.  Raises ValueError if a covariance is singular or not finite."""

    def __init__(self, model: StateSpace, n: int | None = None) -> None:
        # Number of samples to filter; beyond the model's samples, matrices and gain are constant.
        self._n = model.f.shape[0] if n is None else n
        # Number of samples with their own gain, and number of states.
        self.shape = (model.f.shape[0], model.f.shape[1])
        self.variance: FloatArray = self._solve(model)  # Of the innovations, V^2, shape (n,)
        if self._n > model.f.shape[0]:
            self._steady = _SteadyFilter(self._last_loop, self._gain[-2], self._look[-2])
            more = np.full(self._n - model.f.shape[0] + 1, self.variance[-2])
            self.variance = np.concatenate((self.variance[:-1], more))

    def _solve(self, model: StateSpace) -> FloatArray:
        """Compute the gains, segment by segment; return the variances of the innovations."""
        h = model.h
        n, d = model.f.shape[0], model.f.shape[1]
        self._gain, self._look = np.empty((n, d)), np.empty((n, d))
        self._last_loop = np.zeros((d, d))
        band = np.zeros((n, d, 2 * d))
        band[:, :, 0] = 1.0
        variance: FloatArray = model.r.copy()
        known: FloatArray | None = None
        count = max(1, round(n * d * d / _ELEMENTS))
        edges = [n * k // count for k in range(count + 1)]
        for begin, end in zip(edges[:-1], edges[1:]):
            # One array along the samples for each matrix element; most elements are zero, because
            # the matrices are made of blocks.
            f, q = _elements(model.f[begin:end]), _elements(model.q[begin:end])
            r = model.r[begin:end]
            variance[begin:end] += h @ _row_sum(h, q)
            look = _row_sum(h, f)
            if known is None:
                look[:, 0] = f[..., 0] = 0.0
            else:
                variance[begin] += look[:, 0] @ known @ look[:, 0]
                # Covariance of the previous segment's last sample, propagated by one step.
                q[..., 0] += f[..., 0] @ known @ f[..., 0].T
            p = _filtered(f, q, h, r)
            for i in range(d):
                for j in range(i + 1):
                    variance[begin + 1:end] += (1.0 + (i > j)) * p[i, j, :-1] * (
                        look[i, 1:] * look[j, 1:])
            known = p[..., -1].copy()
            gain = _row_sum(h, p) / r
            loop = f - gain[:, None] * look[None]
            self._gain[begin:end], self._look[begin:end] = gain.T, look.T
            first = max(begin, 1)
            for i, j in np.argwhere(_pattern(loop)).tolist():
                band[first - 1:end - 1, j, d + i - j] = -loop[i, j, first - begin:]
            if end - begin > 1:
                # Take the last sample but one, whose gain `__init__` uses as the constant gain.
                self._last_loop = loop[..., -2].copy()
        self._band_of_loop = band.reshape(n * d, 2 * d).T
        return variance

    def innovations(self, y: FloatArray) -> FloatArray:
        """Return the one-step innovations of a series, (n,), or of p series, (n, p)."""
        columns = y[:, None] if y.ndim == 1 else y
        length = self._gain.shape[0]
        if length == self._n:
            e, _ = self._states(columns)
        else:
            e = np.empty_like(columns, dtype=np.float64)
            e[:length], state = self._states(columns[:length])
            # Start with the state of the last sample but one, whose gain is the constant gain.
            e[length - 1:] = self._steady.innovations(columns[length - 1:], state[-2])
        return e[:, 0] if y.ndim == 1 else e

    def _states(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return innovations and filtered states of samples with their own gain."""
        n, p = columns.shape
        d = self._gain.shape[1]
        # Series by series, as LAPACK stores them.
        rows = np.ascontiguousarray(columns.T, dtype=np.float64)
        right = (rows[:, :, None] * self._gain).reshape(p, n * d).T
        state = dtbtrs(self._band_of_loop, right, uplo='L', diag='U', overwrite_b=1)[0]
        state = state.T.reshape(p, n, d)
        e = rows.copy()
        e[:, 1:] -= np.einsum('pnd,nd->pn', state[:, :-1], self._look[1:])
        return e.T, state.transpose(1, 2, 0)


# Maximum condition number of the eigenvectors; beyond it, the loop is disturbed by this share.
_DISTINCT, _NUDGE = 1e10, 1e-9


class _SteadyFilter:
    """A filter with constant gain, run mode by mode."""

    def __init__(self, loop: FloatArray, gain: FloatArray, look: FloatArray) -> None:
        self._roots, vectors = np.linalg.eig(loop)
        if np.linalg.cond(vectors) > _DISTINCT:
            # Equal modes have no complete set of eigenvectors.
            self._roots, vectors = np.linalg.eig(loop * (1.0 - _NUDGE * np.arange(gain.size)))
        self._into = np.linalg.inv(vectors)
        self._drive = self._into @ gain
        self._seen = look @ vectors

    def innovations(self, columns: FloatArray, state: FloatArray) -> FloatArray:
        """Return the innovations after a filtered state of shape (d, p)."""
        e = columns.astype(np.float64)
        modes = self._into @ state
        for root, drive, seen, before in zip(self._roots, self._drive, self._seen, modes):
            if abs(seen * drive) == 0.0 or root.imag < 0.0:
                continue
            if root.imag == 0.0:
                root, drive, before = root.real, drive.real, before.real
            # The conjugate mode contributes the complex conjugate.
            seen = 2.0 * seen if root.imag > 0.0 else seen.real
            kept, _ = lfilter([drive], [1.0, -root], columns, axis=0, zi=root * before[None, :])
            e[0] -= (seen * before).real
            e[1:] -= (seen * kept[:-1]).real
        return e


def _elements(a: FloatArray) -> FloatArray:
    """Return a stack of matrices, shape (n, d, d), as shape (d, d, n)."""
    return np.ascontiguousarray(a.transpose(1, 2, 0))


Pattern = npt.NDArray[np.bool_]


def _pattern(a: FloatArray) -> Pattern:
    """Return which elements of matrices, shape (d, d, n), are nonzero for some n."""
    return np.asarray(a.any(axis=2))


def _row_sum(h: FloatArray, a: FloatArray) -> FloatArray:
    """Return the weighted sum of the rows of matrices, shape (d, d, n)."""
    total = np.zeros(a.shape[1:])
    for k in np.flatnonzero(h).tolist():
        total += a[k] if h[k] == 1.0 else h[k] * a[k]
    return total


def _multiply(a: FloatArray, b: FloatArray, left: Pattern, right: Pattern) -> FloatArray:
    """Multiply matrices of shape (d, d, n), skipping elements that are zero."""
    product = np.zeros_like(a)
    for i, k in np.argwhere(left).tolist():
        for j in np.flatnonzero(right[k]).tolist():
            product[i, j] += a[i, k] * b[k, j]
    return product


def _symmetric(a: FloatArray, b: FloatArray, left: Pattern, right: Pattern, out: FloatArray
               ) -> None:
    """Write the symmetric product a^T b into `out`, which must be zero."""
    for k, i in np.argwhere(left).tolist():
        for j in np.flatnonzero(right[k, :i + 1]).tolist():
            out[i, j] += a[k, i] * b[k, j]
    for i, j in np.argwhere(np.tri(out.shape[0], k=-1)).tolist():
        out[j, i] = out[i, j]


def _inverse(a: FloatArray) -> FloatArray:
    """Invert matrices, shape (d, d, n), by Cholesky factors; NaN if not positive definite."""
    d = a.shape[0]
    some = _pattern(a)
    # Lower factor, and its inverse by forward substitution.
    low: dict[tuple[int, int], FloatArray] = {}
    up: dict[tuple[int, int], FloatArray] = {}
    with np.errstate(invalid='ignore', divide='ignore'):
        for j in range(d):
            pivot = a[j, j].copy()
            for k in range(j):
                if (j, k) in low:
                    pivot -= low[j, k] ** 2
            up[j, j] = 1.0 / np.sqrt(pivot)
            low[j, j] = pivot * up[j, j]
            for i in range(j + 1, d):
                both = [k for k in range(j) if (i, k) in low and (j, k) in low]
                if some[i, j] or both:
                    rest = a[i, j].copy()
                    for k in both:
                        rest -= low[i, k] * low[j, k]
                    rest *= up[j, j]
                    low[i, j] = rest
            for i in range(j):
                terms = [low[j, k] * up[k, i] for k in range(i, j)
                         if (j, k) in low and (k, i) in up]
                if terms:
                    up[j, i] = -sum(terms[1:], start=terms[0]) * up[j, j]
    result = np.zeros_like(a)
    for (k, i), value in up.items():
        for j in range(i + 1):
            if (k, j) in up:
                result[i, j] += value * up[k, j]
    for i, j in np.argwhere(np.tri(d, k=-1)).tolist():
        result[j, i] = result[i, j]
    return result


# Approximate number of matrix elements processed at once; limits memory.
_ELEMENTS = 2e6
_SINGULAR = 'the covariance of the model is singular or not finite'


def _filtered(f: FloatArray, q: FloatArray, h: FloatArray, r: FloatArray) -> FloatArray:
    """Return filtered covariances, shape (d, d, n); the first q is the prior covariance."""
    d, n = f.shape[0], f.shape[2]
    if d == 1:
        # For a single state the matrix is tridiagonal, which takes a quarter of the time.
        with np.errstate(over='ignore', invalid='ignore'):
            precision = 1.0 / q[0, 0]
            back = np.append((f[0, 0] * f[0, 0] * precision)[1:], 0.0)
            pivots, _, info = dpttrf(
                precision + h[0] * h[0] / r + back, -(precision * f[0, 0])[1:])
        if info != 0 or not np.isfinite(pivots).all():
            raise ValueError(_SINGULAR)
        return np.asarray(1.0 / (pivots - back))[None, None]
    turns = _pattern(f)
    weight = _inverse(q)
    known = _pattern(weight)
    # Values that are not finite are rejected below.
    with np.errstate(over='ignore', invalid='ignore'):
        forward = _multiply(weight, f, known, turns)
    # Information on each sample from the step into the next one.
    back = np.zeros_like(f)
    _symmetric(f[..., 1:], forward[..., 1:], turns, known @ turns, back[..., :-1])
    diagonal = weight + back
    for i, j in np.argwhere(np.outer(h, h) != 0.0).tolist():
        diagonal[i, j] += h[i] * h[j] / r
    band = _band(diagonal, -forward[..., 1:])
    del weight, forward, diagonal
    factor, info = dpbtrf(band, lower=1, overwrite_ab=1)
    del band
    if info != 0 or not np.isfinite(factor[0]).all():
        raise ValueError(_SINGULAR)
    p = _pivots(factor, n, d)
    p -= back
    del factor, back
    return _inverse(p)


def _band(diagonal: FloatArray, below: FloatArray) -> FloatArray:
    """Return a block bidiagonal or symmetric block tridiagonal matrix, lower band storage."""
    d, n = diagonal.shape[0], diagonal.shape[2]
    # Stored in LAPACK's order, column by column.
    band = np.zeros((n, d, 2 * d))
    for i, j in np.argwhere(np.tri(d)).tolist():
        band[:, j, i - j] = diagonal[i, j]
    for i, j in np.argwhere(_pattern(below)).tolist():
        band[:-1, j, d + i - j] = below[i, j]
    return band.reshape(n * d, 2 * d).T


def _pivots(factor: FloatArray, n: int, d: int) -> FloatArray:
    """Return the pivot blocks L_kk L_kk' of a banded Cholesky factor, shape (d, d, n)."""
    rows = factor.T.reshape(n, d, -1)
    lower = {(i, j): np.ascontiguousarray(rows[:, j, i - j])
             for i in range(d) for j in range(i + 1)}
    pivots = np.empty((d, d, n))
    for i, j in lower:
        pivots[i, j] = lower[i, 0] * lower[j, 0]
        for k in range(1, j + 1):
            pivots[i, j] += lower[i, k] * lower[j, k]
        pivots[j, i] = pivots[i, j]
    return pivots
