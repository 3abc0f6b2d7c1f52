"""
First passage of the OU to a level: mean time, and probability within a time span.

A continuous OU path has no finite crossing rate, so risk is stated as first passage.

The unit OU is dX = -X ds + sqrt(2) dW: levels are in stationary standard deviations, positive
towards the barrier, and times in tau = 1/alpha.  All results are for the continuous path, not
for its samples.

Numerical method.  With T = 1 - exp(-2 s) and w = (b - x) / sqrt(T) the
probability is written as P = 2 Phi(-w exp(-s)) exp(R).  The first factor is
exact for the barrier b = 0; R is smooth and vanishes at w = 0, at b = 0 and
for s -> 0.  With lambda = ln(exp(2 s) - 1) / 2, y = w exp(-s) and
g = exp(-s) phi(y) / Phi(-y), the backward equation P_s = P_xx - x P_x becomes

    R_lambda = R_ww + R_w^2 + (w (1 - 2 T) + b sqrt(T) - 2 g) R_w - b sqrt(T) g.

It is solved once for all barriers by linearly implicit steps (BDF2), and R is
interpolated in a table by cubic splines.  Because R is a logarithm, the relative
error of small probabilities is small too.

Limits: the error is at most 0.15 % of P for barriers -3..30, starts above -10 and
P down to 1e-12 (compared with finer grids).  Outside the table, values are
approximate: the problem is scaled into the table, as if the pull towards the mean
were constant near the barrier.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
import threading

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# The table over barrier, w and lambda; each axis is evenly spaced in a transformed coordinate,
# b = 4 sinh(u), w = 2 sinh(v).
_B_SCALE, _W_SCALE = 4.0, 2.0
_B_LOW, _B_HIGH, _B_NODES = -6.0, 30.0, 58
_W_HIGH, _W_NODES = 30.0, 55
_S_LOW, _S_HIGH, _S_NODES = 1e-5, 9.0, 88
# Steps of the solver per step of the table, in w and in lambda.
_FINE_W, _FINE_S = 2, 4
# The solver starts this far below the table in lambda.
_LEAD = 1.0
# Nodes added at each end of each axis, so that the ends do not affect the splines.
_PAD = 5

_LOG_TWO_PI = math.log(2.0 * math.pi)
# Long-run rate, 1/tau, for barriers from -6 to 0, as a polynomial of the barrier: within 0.04 % of
# the smallest eigenvalue; less than 2e-4 of such paths outlast the table.
_LOW_RATE = (-1.98242460e-04, -4.29510921e-03, 2.01687905e-01, -7.93135812e-01, 1.00086922)
# Barrier above which the mean time, more than 1e145 tau, counts as infinite.
_NEVER = 26.0


# Below _FAR, ln Phi comes from the asymptotic series, with errors up to 1e-12 (Abramowitz & Stegun
# 26.2.12, last term first), because erfc loses digits below -37.
_FAR = -20.0
_SERIES = (10395.0, -945.0, 105.0, -15.0, 3.0, -1.0, 1.0)


def normal_below(x: npt.ArrayLike) -> FloatArray:
    """Return Phi(x), elementwise, without `scipy.special`, which takes 35 MB in a node."""
    z = np.asarray(x, dtype=np.float64) * -math.sqrt(0.5)
    values = np.array([math.erfc(each) for each in z.ravel().tolist()])
    return np.asarray(0.5 * values.reshape(z.shape))


def log_normal_below(x: npt.ArrayLike) -> FloatArray:
    """Return ln Phi(x), elementwise."""
    z = np.asarray(x, dtype=np.float64)
    least = normal_below(np.maximum(-np.abs(z), _FAR))
    near = np.where(z > 0.0, np.log1p(-least), np.log(least))
    if not (z < _FAR).any():
        return near
    with np.errstate(over='ignore'):
        far = np.minimum(z, _FAR)
        square = far * far
    series = np.polyval(_SERIES, 1.0 / square)
    return np.where(z < _FAR, np.log(series) - np.log(-far) - 0.5 * square - 0.5 * _LOG_TWO_PI,
                    near)


def mean_first_passage(start: float, barrier: float) -> float:
    """Return a unit OU's mean time to a barrier (Siegert, Phys. Rev. 81 (1951) 617)."""
    if start >= barrier:
        return 0.0
    if barrier > _NEVER:
        return math.inf
    # Imported here, because the nodes do not need these modules, which take 60 MB.
    from scipy.integrate import quad
    from scipy.special import erfcx
    total, _ = quad(lambda z: float(erfcx(-z / math.sqrt(2.0))), start, barrier,
                    epsabs=0.0, epsrel=1e-10, limit=200)
    return math.sqrt(math.pi / 2.0) * float(total)


def passage_probability(start: npt.ArrayLike, barrier: npt.ArrayLike, span: npt.ArrayLike
                        ) -> FloatArray:
    """Return the probability that a unit OU reaches a barrier within a span, elementwise."""
    x, b, s = np.broadcast_arrays(np.asarray(start, np.float64), np.asarray(barrier, np.float64),
                                  np.asarray(span, np.float64))
    if (s < 0.0).any():
        raise ValueError('span must be zero or positive, in relaxation times')
    shape = x.shape
    x, b, s = x.ravel(), b.ravel(), s.ravel()
    # False where a value is NaN.
    inside = (x < b) & (s > 0.0) & (x > -np.inf) & (b < np.inf)
    if inside.all():
        return prepare().probability(x, b, s).reshape(shape)
    result = np.where(x >= b, 1.0, 0.0)
    if inside.any():
        result[inside] = prepare().probability(x[inside], b[inside], s[inside])
    result[np.isnan(x) | np.isnan(b) | np.isnan(s)] = math.nan
    return result.reshape(shape)


@dataclass(frozen=True, eq=False)
class PassageTable:
    """Spline table of R."""

    coefficients: FloatArray  # Spline coefficients of R; shape (barriers, w, lambda)
    # Spline coefficients of ln of the long-run rate of passages, 1/tau; shape (barriers,).
    log_rate: FloatArray

    def probability(self, x: FloatArray, b: FloatArray, s: FloatArray) -> FloatArray:
        """Return probabilities for start < barrier and span > 0; only the span may be infinite."""
        with np.errstate(under='ignore', over='ignore'):
            # Near a far barrier, or within a short span, the pull is nearly constant: then the
            # probability depends only on b sqrt(s) and (b - x) / sqrt(s).
            scale = np.maximum(np.maximum(b / _B_HIGH, b / _B_LOW), 1.0)
            gap, b, s = (b - x) * scale, b / scale, s * (scale * scale)
            short = np.sqrt(np.minimum(s / _S_LOW, 1.0))
            gap, b, table_s = gap / short, b * short, np.minimum(np.maximum(s, _S_LOW), _S_HIGH)
            grown = np.expm1(2.0 * table_s)
            y = gap / np.sqrt(grown)
            v = np.arcsinh(y * np.sqrt(grown + 1.0) / _W_SCALE)
            at = np.empty((3, x.size))
            at[0] = (np.arcsinh(b / _B_SCALE) - _U[0]) / _DU
            at[1] = np.minimum(v / _DV, _W_NODES - 1.0)
            at[2] = (0.5 * np.log(grown) - _LAMBDA[0]) / _DL
            at += _PAD
            r = spline_at(self.coefficients, at)
            chance: FloatArray = np.minimum(2.0 * np.exp(log_normal_below(-y) + r), 1.0)
            long = s > _S_HIGH
            if not long.any():
                return chance
            rate = np.exp(spline_at(self.log_rate, at[:1, long]))
            with np.errstate(divide='ignore'):
                chance[long] = -np.expm1(np.log1p(-chance[long]) - rate * (s[long] - _S_HIGH))
            return chance


def prepare() -> PassageTable:
    """Return the table, from any thread; the first call takes tenths of a second."""
    global _table
    if _table is None:
        with _lock:
            if _table is None:
                _table = _build()
    return _table


_table: PassageTable | None = None
_lock = threading.Lock()

_U = np.linspace(math.asinh(_B_LOW / _B_SCALE), math.asinh(_B_HIGH / _B_SCALE), _B_NODES)
_DU = float(_U[1] - _U[0])
_DV = math.asinh(_W_HIGH / _W_SCALE) / (_W_NODES - 1)
_LAMBDA = np.linspace(0.5 * math.log(math.expm1(2.0 * _S_LOW)),
                      0.5 * math.log(math.expm1(2.0 * _S_HIGH)), _S_NODES)
_DL = float(_LAMBDA[1] - _LAMBDA[0])


def _build() -> PassageTable:
    b = _B_SCALE * np.sinh(_U)
    # Richardson extrapolation: errors are proportional to squared steps.
    table = (4.0 * _solve(b, _FINE_W, _FINE_S) - _solve(b, _FINE_W // 2, _FINE_S // 2)) / 3.0
    return PassageTable(spline(table), spline(_log_rate(b)))


def spline(table: FloatArray) -> FloatArray:
    """Return the coefficients of cubic splines along all axes, with nodes added at the ends."""
    for axis in range(table.ndim):
        for _ in range(_PAD):
            a, b, c, d = (np.take(table, [k], axis) for k in range(4))
            first = 4.0 * a - 6.0 * b + 4.0 * c - d
            a, b, c, d = (np.take(table, [-k], axis) for k in range(1, 5))
            table = np.concatenate((first, table, 4.0 * a - 6.0 * b + 4.0 * c - d), axis)
        # The basis is 1/6, 2/3, 1/6 at the nodes; the table is reflected at its ends.
        nodes = table.shape[axis]
        basis = 2.0 / 3.0 * np.eye(nodes) + (np.eye(nodes, k=1) + np.eye(nodes, k=-1)) / 6.0
        basis[0, 1] = basis[-1, -2] = 1.0 / 3.0
        table = np.moveaxis(np.tensordot(np.linalg.inv(basis), table, (1, axis)), 0, axis)
    return np.ascontiguousarray(table)


def spline_at(coefficients: FloatArray, at: FloatArray) -> FloatArray:
    """Return the spline at points, shape (axes, n), at least one node from the ends."""
    first = np.floor(at).astype(np.intp)
    x = at - first
    left = 1.0 - x
    weights = np.stack((left * left * left, 4.0 - 3.0 * x * x * (2.0 - x),
                        4.0 - 3.0 * left * left * (2.0 - left), x * x * x)) / 6.0
    # Flat indices of the four neighbours along each axis; the points are the last dimension, where
    # NumPy is fastest.
    corner, offsets, size = np.zeros(x.shape[1], np.intp), np.zeros(1, np.intp), 1
    for axis in reversed(range(coefficients.ndim)):
        corner += size * (first[axis] - 1)
        offsets = (size * np.arange(4)[:, None] + offsets).ravel()
        size *= coefficients.shape[axis]
    value = coefficients.ravel()[offsets[:, None] + corner]
    for axis in reversed(range(coefficients.ndim)):
        value = (value.reshape(4**axis, 4, -1) * weights[:, axis]).sum(axis=1)
    return np.asarray(value.ravel())


def _solve(b: FloatArray, fine_w: int, fine_s: int) -> FloatArray:
    """Return R by linearly implicit BDF2 steps, shape (barriers, w, lambda)."""
    # For large w, R is a parabola: differences over three uneven nodes are exact for it, and the
    # last node is extrapolated from the three before it.
    w = _W_SCALE * np.sinh(_DV / fine_w * np.arange((_W_NODES - 1) * fine_w + 1))
    first, second = (weights[..., None] for weights in _differences(w))
    step = _DL / fine_s
    lead = math.ceil(_LEAD / step)
    inner = w[1:-1, None]
    far = _parabola(w[-4:-1], w[-1])
    # Start from the limit of short spans, R = -b sqrt(T) w / 2.
    r = -0.5 * b * math.exp(_LAMBDA[0] - lead * step) * w[:, None]
    before = math.exp(-step) * r
    table = np.empty((_S_NODES, _W_NODES, b.size))
    for k in range(1, lead + (_S_NODES - 1) * fine_s + 1):
        at = _LAMBDA[0] + (k - lead) * step
        c = 1.0 / math.sqrt(1.0 + math.exp(2.0 * at))
        t = 1.0 - c * c
        beta = b * math.sqrt(t)
        y = c * inner
        g = c * np.exp(-0.5 * y * y - 0.5 * _LOG_TWO_PI - log_normal_below(-y))
        guess = 2.0 * r - before
        slope = first[0] * guess[:-2] + first[1] * guess[1:-1] + first[2] * guess[2:]
        drift = beta + (inner * (1.0 - 2.0 * t) - 2.0 * g) + 2.0 * slope
        right = (2.0 * r - 0.5 * before)[1:-1] / step - slope * slope - beta * g
        bands = -(second + drift * first)
        bands[1] += 1.5 / step
        r, before = tridiagonal(bands, right, far), r
        if k >= lead and (k - lead) % fine_s == 0:
            table[(k - lead) // fine_s] = r[::fine_w]
    return np.ascontiguousarray(table.T)


def tridiagonal(bands: FloatArray, right: FloatArray, far: FloatArray) -> FloatArray:
    """Solve for x at the inner nodes, with x[0] = 0 and x[-1] = far . x[-4:-1]."""
    # bands: below, on and above the diagonal, shape (3, n, systems); right: (n, systems).
    low, main, high = bands
    p, q = np.empty_like(right), np.empty_like(right)
    # In the last row, replace x[-1] by the three x before it; eliminate the farthest first.
    last = high[-1] * far[:, None]
    main[-1] += last[2]
    low[-1] += last[1]
    p[0], q[0] = high[0] / main[0], right[0] / main[0]
    for j in range(1, len(right)):
        if j == len(right) - 1:
            low[j] -= last[0] * p[j - 2]
            right[j] -= last[0] * q[j - 2]
        pivot = main[j] - low[j] * p[j - 1]
        p[j] = high[j] / pivot
        q[j] = (right[j] - low[j] * q[j - 1]) / pivot
    x = np.zeros((len(right) + 2, right.shape[1]))
    x[-2] = q[-1]
    for j in range(len(right) - 2, -1, -1):
        x[j + 1] = q[j] - p[j] * x[j + 2]
    x[-1] = far @ x[-4:-1]
    return x


def _differences(w: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return weights of first and second differences at inner nodes, each (3, n - 2)."""
    a, c = np.diff(w)[:-1], np.diff(w)[1:]
    first = np.stack((-c / (a * (a + c)), (c - a) / (a * c), a / (c * (a + c))))
    second = 2.0 * np.stack((1.0 / (a * (a + c)), -1.0 / (a * c), 1.0 / (c * (a + c))))
    return first, second


def _parabola(w: FloatArray, at: float) -> FloatArray:
    return np.array([(at - w[(k + 1) % 3]) * (at - w[(k + 2) % 3])
                     / ((w[k] - w[(k + 1) % 3]) * (w[k] - w[(k + 2) % 3])) for k in range(3)])


def _log_rate(b: FloatArray) -> FloatArray:
    """Return ln of the long-run passage rate, 1/tau: the smallest nu with D_nu(-b) = 0."""
    # D is the parabolic cylinder function.  For 0 < b <= 8, nu comes from the power series of the
    # Hermite function, in which only the first term is negative: nu = 2 Gamma(1 - nu/2) / sum over
    # n >= 1 of Gamma((n - nu)/2) (sqrt(2) b)^n / n!.  For larger b, nu comes from the asymptotic
    # series of the mean time, 1/nu.
    result = np.empty(b.size)
    n = range(1, 260)

    def excess(log_nu: float) -> float:
        nu = math.exp(log_nu)
        logs = [term + math.lgamma(0.5 * (k - nu)) for k, term in zip(n, log_terms, strict=True)]
        top = max(logs)
        total = top + math.log(math.fsum(math.exp(each - top) for each in logs))
        return math.log(2.0) + math.lgamma(1.0 - 0.5 * nu) - total - log_nu

    for k, barrier in enumerate(b.tolist()):
        if barrier <= 0.0:
            result[k] = math.log(np.polyval(_LOW_RATE, barrier))
        elif barrier <= 8.0:
            log_terms = [j * math.log(math.sqrt(2.0) * barrier) - math.lgamma(j + 1.0) for j in n]
            result[k] = _root(excess, -40.0, -1e-12)
        else:
            z = 1.0 / (barrier * barrier)
            result[k] = (math.log(barrier) - 0.5 * barrier * barrier - 0.5 * _LOG_TWO_PI
                         - math.log1p(z * (1.0 + z * (3.0 + z * (15.0 + z * 105.0)))))
    return result


def _root(f: Callable[[float], float], low: float, high: float) -> float:
    """Return the zero between two ends, to 1e-12, by the Illinois method (without SciPy)."""
    f_low, f_high = f(low), f(high)
    side = 0
    while True:
        middle = (f_high * low - f_low * high) / (f_high - f_low)
        value = f(middle)
        if value * f_high > 0.0:
            moved, high, f_high = high - middle, middle, value
            f_low *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            moved, low, f_low = middle - low, middle, value
            f_high *= 0.5 if side == -1 else 1.0
            side = -1
        if moved <= 1e-12 or value == 0.0:
            return middle
