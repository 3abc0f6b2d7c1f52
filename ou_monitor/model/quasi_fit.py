"""
Restricted quasi-likelihood of an ARMA(1,1) from its sample autocovariances.

The Gaussian likelihood needs the data only through c_0..c_K: the inverse of
the covariance of an ARMA(1,1) is, away from the ends, the Toeplitz matrix of
its inverse autocovariances, which fall as theta^k (so K lags do when theta^K
is small).  Restricted form: the level, and other regressors of the mean
through `tilt`, are integrated out.  One evaluation costs K multiplications; no data is touched.

The same text runs in plain Python and, where Numba is installed, compiled
(`ou_monitor.online.estimator.compiled`): scalars and loops only, hence no classes here.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

# Newton-like steps settle in 5 to 12; this many means they did not.
MAX_STEPS = 60
# No step moves alpha by more than a factor exp(1.5).
_LONGEST = 1.5
# Settled: ln(alpha) and theta (relative to its distance from 1) move less, and
# `polish` takes over: values tell no finer steps apart than some 1e-7, gradients do.
_SETTLED = 1e-3
# Steps of the differences that give the curvature there.
_NEAR = 1e-5


def objective(c0: float, c: Sequence[float], free: float, log_a: float, theta: float,
              tilt_a: float, tilt_t: float) -> tuple[float, float, float]:
    """Return minus the log-likelihood and its gradient in (ln a, theta) (c0 in V^2, c in V^2)."""
    a = math.exp(log_a)
    phi = math.exp(-a)
    g = 0.0
    dg = 0.0
    for k in range(len(c) - 1, -1, -1):
        dg = dg * theta + g
        g = g * theta + c[k]
    one = 1.0 - theta * theta
    cross = 1.0 - phi * theta
    lead = 1.0 + phi * phi - 2.0 * phi * theta
    tail = cross * (theta - phi)
    s = (lead * c0 + 2.0 * tail * g) / one
    if s <= 0.0:
        return math.inf, 0.0, 0.0
    s_phi = (2.0 * (phi - theta) * c0 - 2.0 * (theta * (theta - phi) + cross) * g) / one
    s_theta = (-2.0 * phi * c0 + 2.0 * (cross - phi * (theta - phi)) * g
               + 2.0 * tail * dg + 2.0 * theta * s) / one
    rest = -math.expm1(-a)
    rest2 = -math.expm1(-2.0 * a)
    half = 0.5 * free
    value = (half * math.log(s) + math.log(rest / (1.0 - theta)) + math.log(cross)
             - 0.5 * math.log(rest2 * one) + tilt_a * log_a + tilt_t * theta)
    by_phi = half * s_phi / s - 1.0 / rest - theta / cross + phi / rest2
    by_theta = half * s_theta / s + 1.0 / (1.0 - theta) - phi / cross + theta / one
    return value, tilt_a - a * phi * by_phi, tilt_t + by_theta


def innovation(c0: float, c: Sequence[float], log_a: float, theta: float) -> float:
    """Return the mean square one-step innovation, V^2, at given parameters."""
    phi = math.exp(-math.exp(log_a))
    g = 0.0
    for k in range(len(c) - 1, -1, -1):
        g = g * theta + c[k]
    lead = 1.0 + phi * phi - 2.0 * phi * theta
    tail = (1.0 - phi * theta) * (theta - phi)
    return (lead * c0 + 2.0 * tail * g) / (1.0 - theta * theta)


def information(log_a: float, theta: float) -> tuple[float, float, float]:
    """Return the information per sample in (ln a, theta): aa, at, tt."""
    a = math.exp(log_a)
    weight = a * math.exp(-a)
    return (weight * weight / -math.expm1(-2.0 * a),
            weight / (1.0 - math.exp(-a) * theta),
            1.0 / (1.0 - theta * theta))


def polish(c0: float, c: Sequence[float], free: float, log_a: float, theta: float,
           value: float, g_a: float, g_t: float, on_bound: bool, floor: float, slope: float,
           low: float, high: float, tilt_a: float, tilt_t: float) -> tuple[float, float, float]:
    """
    Bring a point beside the minimum to it, by the gradient alone.

    Two steps of Newton with one curvature, from differences of the gradient; a
    step counts if the gradient falls in the metric of the curvature.
    """
    turn = slope if on_bound else 0.0
    step = _NEAR * (1.0 - theta)
    _, n_a, n_t = objective(c0, c, free, log_a + _NEAR, theta + turn * _NEAR, tilt_a, tilt_t)
    aa, at, tt = (n_a - g_a) / _NEAR, (n_t - g_t) / _NEAR, 0.0
    if on_bound:
        along = aa + slope * at
        h_aa = 1.0 / along if along > 0.0 else 0.0
        h_at, h_tt = slope * h_aa, slope * slope * h_aa
    else:
        _, n_a, n_t = objective(c0, c, free, log_a, theta - step, tilt_a, tilt_t)
        at, tt = 0.5 * (at + (g_a - n_a) / step), (g_t - n_t) / step
        det = aa * tt - at * at
        convex = aa > 0.0 and det > 0.0
        h_aa, h_at, h_tt = (tt / det, -at / det, aa / det) if convex else (0.0, 0.0, 0.0)
    for _ in range(2):
        d_a, d_t = -(h_aa * g_a + h_at * g_t), -(h_at * g_a + h_tt * g_t)
        new_a, new_t = log_a + d_a, theta + d_t
        far = -(d_a * g_a + d_t * g_t)
        if not (far > 0.0 and low <= new_a <= high and new_t < math.exp(-math.exp(new_a))
                and (on_bound or new_t >= floor + slope * new_a)):
            break
        new_value, n_a, n_t = objective(c0, c, free, new_a, new_t, tilt_a, tilt_t)
        if not (new_value < math.inf and h_aa * n_a * n_a + 2.0 * h_at * n_a * n_t
                + h_tt * n_t * n_t < far):
            break
        log_a, theta, value, g_a, g_t = new_a, new_t, new_value, n_a, n_t
    return log_a, theta, value


def minimise(c0: float, c: Sequence[float], free: float, log_a: float, theta: float,
             floor: float, slope: float, low: float, high: float, tilt_a: float, tilt_t: float,
             ) -> tuple[float, float, float, bool, int]:
    """
    Minimise `objective` over ln a and theta >= floor + slope (ln a - start).

    Quasi-Newton (BFGS) from the expected information, with step halving, then
    `polish`; on the bound (no measurement noise) the search goes along it.
    """
    start = log_a
    theta = max(theta, floor)
    on_bound = theta <= floor
    value, g_a, g_t = objective(c0, c, free, log_a, theta, tilt_a, tilt_t)
    fresh = True
    h_aa = h_at = h_tt = 0.0
    steps = 0
    while steps < MAX_STEPS:
        steps += 1
        if on_bound and g_t < 0.0:
            on_bound = False
            fresh = True
        newly = fresh
        if fresh:
            i_aa, i_at, i_tt = information(log_a, theta)
            det = i_aa * i_tt - i_at * i_at
            if on_bound:
                h_aa = 1.0 / (free * (i_aa + 2.0 * slope * i_at + slope * slope * i_tt))
            else:
                h_aa, h_at, h_tt = (i_tt / det / free, -i_at / det / free,
                                    i_aa / det / free)
            fresh = False
        if on_bound:
            d_a = -h_aa * (g_a + slope * g_t)
            d_t = slope * d_a
        else:
            d_a = -(h_aa * g_a + h_at * g_t)
            d_t = -(h_at * g_a + h_tt * g_t)
        size = min(1.0, _LONGEST / max(abs(d_a), 1e-300))
        moved = False
        landed = on_bound
        new_value, new_a, new_t, n_a, n_t = value, log_a, theta, g_a, g_t
        for _ in range(40):
            new_a = min(max(log_a + size * d_a, low), high)
            least = floor + slope * (new_a - start)
            new_t = least if on_bound else theta + size * d_t
            landed = on_bound or new_t <= least
            if landed and not on_bound:
                # The best point *on* the bound, not the one the bound cuts off.
                over = least - theta - size * d_t
                new_a = min(max(new_a + h_at / h_tt * over, low), high)
                least = floor + slope * (new_a - start)
            new_t = max(new_t, least)
            if new_t < math.exp(-math.exp(new_a)) * (1.0 - 1e-9):
                new_value, n_a, n_t = objective(c0, c, free, new_a, new_t,
                                                tilt_a, tilt_t)
                if new_value <= value:
                    moved = True
                    break
            size *= 0.5
        if not moved:
            if newly:
                break
            fresh = True
            continue
        s_a, s_t = new_a - log_a, new_t - theta
        y_a, y_t = n_a - g_a, n_t - g_t
        if landed != on_bound:
            fresh = True
        elif on_bound:
            y = y_a + slope * y_t
            if y * s_a > 0.0:
                h_aa = s_a / y
        else:
            sy = s_a * y_a + s_t * y_t
            if sy > 1e-300:
                hy_a = h_aa * y_a + h_at * y_t
                hy_t = h_at * y_a + h_tt * y_t
                f = (1.0 + (y_a * hy_a + y_t * hy_t) / sy) / sy
                h_aa += f * s_a * s_a - 2.0 * s_a * hy_a / sy
                h_at += f * s_a * s_t - (s_a * hy_t + hy_a * s_t) / sy
                h_tt += f * s_t * s_t - 2.0 * s_t * hy_t / sy
        log_a, theta, on_bound = new_a, new_t, landed
        value, g_a, g_t = new_value, n_a, n_t
        if not fresh and abs(s_a) < _SETTLED and abs(s_t) < _SETTLED * (1.0 - theta):
            break
    log_a, theta, value = polish(c0, c, free, log_a, theta, value, g_a, g_t, on_bound,
                                 floor - slope * start, slope, low, high, tilt_a, tilt_t)
    return log_a, theta, value, on_bound, steps
