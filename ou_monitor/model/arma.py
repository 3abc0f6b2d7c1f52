"""
The ARMA(1,1) that a sampled or block-averaged OU with white noise is, and its fit.

Samples of an OU are AR(1); white noise on top, or averaging over blocks, makes
them ARMA(1,1): z_j - phi z_{j-1} = e_j - theta e_{j-1}, with phi = exp(-alpha D)
for the step D.  Averages over blocks *without* noise have theta < 0; noise
raises theta towards phi.  In units of sigma^2 D the shape depends on a = alpha D,
on the samples per block m and on the noise share lam = noise variance of one
z / (sigma^2 D) alone.

The fit is a restricted quasi-likelihood from the sample autocovariances c_0..c_K:
the inverse of the covariance of an ARMA(1,1) is, away from the ends, the Toeplitz
matrix of its inverse autocovariances, which fall as theta^k (so K lags do when
theta^K is small).  The level, and other regressors of the mean through `tilt`, are
integrated out.  No data is touched.

Source of the block autocovariances: the double sums of phi^(|i-j|/m), closed
by the geometric series; Hamilton, Time Series Analysis (1994), ch. 3, for the
ARMA identities.
"""

from __future__ import annotations

from collections.abc import Sequence
import math


def block_autocovariance(a: float, m: int) -> tuple[float, float]:
    """Return the autocovariances of noise-free block means at lags 0 and 1."""
    variance = 0.5 / a
    if m == 1:
        return variance, variance * math.exp(-a)
    r = math.exp(-a / m)
    short, long = -math.expm1(-a / m), -math.expm1(-a)
    if a < 1e-3:
        # The two terms of gamma0 cancel to order a; the series keeps 1e-9 here:
        # 1 - mean |i-j|/m a + mean (|i-j|/m)^2 a^2/2 - mean (|i-j|/m)^3 a^3/6.
        k = float(m)
        one = (k * k - 1.0) / (3.0 * k * k)
        two = (k * k - 1.0) / (6.0 * k * k)
        three = (k * k - 1.0) * (3.0 * k * k - 2.0) / (30.0 * k ** 4)
        gamma0 = variance * (1.0 - a * one + a * a * two / 2.0 - a ** 3 * three / 6.0)
    else:
        gamma0 = variance * (m * short * (1.0 + r) - 2.0 * r * long) / (m * short) ** 2
    gamma1 = variance * r * (long / (m * short)) ** 2
    return gamma0, gamma1


def noise_free_theta(a: float, m: int) -> float:
    """Return theta without measurement noise: 0 for samples, negative for block means."""
    return 0.0 if m == 1 else theta_at(a, m, 0.0)


def theta_at(a: float, m: int, share: float) -> float:
    """Return the moving-average coefficient at a noise share."""
    phi = math.exp(-a)
    gamma0, gamma1 = block_autocovariance(a, m)
    gamma0 += share
    ratio = 2.0 * (phi * gamma0 - gamma1) / (gamma0 * (1.0 + phi * phi) - 2.0 * phi * gamma1)
    return ratio / (1.0 + math.sqrt(max(1.0 - ratio * ratio, 0.0)))


def noise_share(a: float, theta: float, m: int) -> float:
    """Return lam, the noise variance of one z in units of sigma^2 D."""
    phi = math.exp(-a)
    gamma0, gamma1 = block_autocovariance(a, m)
    total = gamma1 * (1.0 + theta * theta - 2.0 * phi * theta) / (
        (phi - theta) * (1.0 - phi * theta))
    return total - gamma0


def innovation_variance(a: float, theta: float, m: int) -> float:
    """Return the one-step innovation variance in units of sigma^2 D; arguments as above."""
    phi = math.exp(-a)
    _, gamma1 = block_autocovariance(a, m)
    return gamma1 * -math.expm1(-2.0 * a) / ((phi - theta) * (1.0 - phi * theta))


def log_covariance(a: float, theta: float, m: int, n: int) -> tuple[float, float, float]:
    """
    Return the variances of ln(alpha), ln(sigma) and ln(Var_inf) from n blocks.

    The covariance of (phi, theta) is (1 - phi theta)/(phi - theta)^2 / n times
    [[(1-phi^2)(1-phi theta), (1-phi^2)(1-theta^2)], [., (1-theta^2)(1-phi
    theta)]], and that of ln q is 2/n (Box & Jenkins, Time Series Analysis,
    7.2.6); the delta method carries it to the logarithms.
    """
    phi = math.exp(-a)
    one, other = -math.expm1(-2.0 * a), 1.0 - theta * theta
    cross, apart = 1.0 - phi * theta, phi - theta
    common = cross / (apart * apart * n)
    v_phi, v_theta, v_cross = (common * one * cross, common * other * cross,
                               common * one * other)
    # ln sigma^2 = ln q - ln q~(a, theta): derivatives of ln q~.
    d_t = 1.0 / apart + phi / cross
    d_a = 2.0 * phi * phi / one + phi / apart - phi * theta / cross - 1.0 / a - 1.0 / m
    if m > 1:
        r = math.exp(-a / m)
        d_a += 2.0 * phi / -math.expm1(-a) - 2.0 * r / (m * -math.expm1(-a / m))
    # a = -ln phi.
    s_phi, s_theta = d_a / phi, -d_t
    a_phi = -1.0 / (phi * a)
    v_part = s_phi - a_phi
    last = 2.0 / n + s_theta * s_theta * v_theta
    return (a_phi * a_phi * v_phi,
            (last + s_phi * s_phi * v_phi + 2.0 * s_phi * s_theta * v_cross) / 4.0,
            last + v_part * v_part * v_phi + 2.0 * v_part * s_theta * v_cross)


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


# Neighbouring samples correlated by less than this many standard errors are
# not correlated.
CORRELATED = 4.0
# ln(a) settles to this when something else is fitted along with it; the error
# left in it is the square.
STEADY = 1e-3
# alpha D beyond which neighbouring samples say nothing of relaxation, and the
# range of the search in ln(alpha D).
FASTEST = 4.6
LOW = math.log(1e-9)
HIGH = math.log(2.0 * FASTEST)
# Relaxations in the window below which a minimum is not trusted before others
# have been looked for.
DOUBTFUL = 25.0
# Pull of theta towards "no measurement noise" where the data cannot tell, in
# standard errors, fading within two of them: a clamped estimate is high by 0.4
# on average when there is no noise.  A larger pull costs more at 5 mV than it
# gains when clean (doc/estimation.md).
PULL = 0.1


def guess(c0: float, c: Sequence[float]) -> tuple[float, float]:
    """Return a first ln(a) and theta: noise by extrapolating the variogram to lag zero."""
    noise = min(max(0.0, 2.0 * (c0 - c[0]) - (c0 - c[1])), 0.9 * c0)
    phi = min(max(c[0] / (c0 - noise), 0.02), 1.0 - 1e-6)
    return math.log(-math.log(phi)), 0.1 * phi


def descend(c0: float, c: Sequence[float], free: float, log_a: float, theta: float, m: int,
            tilt_a: float, tilt_t: float) -> tuple[float, float, bool, float]:
    """Minimise from one start, the bound on theta following ln a; return the value, too."""
    floor = 0.0
    slope = 0.0
    on_bound = False
    value = math.inf
    for _ in range(4):
        if m > 1:
            a = math.exp(log_a)
            floor = noise_free_theta(a, m)
            slope = (noise_free_theta(1.001 * a, m) - floor) / math.log(1.001)
        before = log_a
        log_a, theta, value, on_bound, _ = minimise(
            c0, c, free, log_a, theta, floor, slope, LOW, HIGH, tilt_a, tilt_t)
        if m == 1 or not on_bound or abs(log_a - before) < STEADY:
            break
    return log_a, theta, on_bound, value


def search(c0: float, c: Sequence[float], free: float, log_a: float, theta: float, m: int,
           tilt_a: float, tilt_t: float) -> tuple[float, float, bool]:
    """Minimise `arma.objective` with the bound on theta, which bends with ln a."""
    theta = min(theta, 0.9 * math.exp(-math.exp(log_a)))
    log_a, theta, on_bound, value = descend(c0, c, free, log_a, theta, m, tilt_a, tilt_t)
    if not value < math.inf:
        # Sums over a few pairs need not be a covariance: start where they are one.
        best = math.inf
        for i in range(6):
            for k in range(4):
                a = 0.01 * 4.0 ** i
                value = objective(c0, c, free, math.log(a), 0.3 * k * math.exp(-a), 0.0, 0.0)[0]
                if value < best:
                    best, log_a, theta = value, math.log(a), 0.3 * k * math.exp(-a)
        log_a, theta, on_bound, value = descend(c0, c, free, log_a, theta, m, tilt_a, tilt_t)
    if math.exp(log_a) * free < DOUBTFUL:
        # A valley at alpha -> 0 catches searches that start badly in strong noise.
        for i in range(4):
            a = DOUBTFUL / free * (0.5 * free / DOUBTFUL) ** (0.2 + 0.2 * i)
            for k in range(2):
                other = descend(c0, c, free, math.log(a), (0.5 + 0.4 * k) * math.exp(-a), m,
                                tilt_a, tilt_t)
                # Sums over lags say little of the slow end: never leave for there.
                if other[3] < value and other[0] > log_a:
                    log_a, theta, on_bound, value = other
    return log_a, theta, on_bound


def finish(c0: float, c: Sequence[float], n: int, free: float, log_a: float, theta: float,
           on_bound: bool, m: int
           ) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return scale, noise and errors at the minimiser."""
    floor = noise_free_theta(math.exp(log_a), m)
    phi = math.exp(-math.exp(log_a))
    i_aa, i_at, _ = information(log_a, theta)
    # Standard error of theta, alpha being free (see `arma.log_covariance`).
    spread = (1.0 - phi * theta) / (phi - theta) * math.sqrt((1.0 - theta * theta) / n)
    score = 0.0
    if not on_bound:
        score = max(theta - floor, 0.0) / spread
    if score > 0.0 and innovation(c0, c, log_a, theta) > 0.0:
        pull = min(PULL * math.exp(-score * score / 8.0), score) * spread
        theta -= pull
        log_a += i_at / i_aa * pull
    a = math.exp(log_a)
    q = innovation(c0, c, log_a, theta) * n / free
    scale = q / innovation_variance(a, theta, m)
    share = 0.0
    if score > 0.0:
        share = max(noise_share(a, theta, m), 0.0)
    errors = log_covariance(a, theta, m, n)
    return a, theta, q, scale, share, score, errors[0], errors[1], errors[2]


def trend_score(c0: float, c: Sequence[float], n: int, place: float, change: Sequence[float],
                pairs: Sequence[float], log_a: float, theta: float) -> float:
    """Return a trend over its standard error (place in V)."""
    phi = math.exp(-math.exp(log_a))
    lead = 1.0 + phi * phi - 2.0 * phi * theta
    tail = 2.0 * (1.0 - phi * theta) * (theta - phi)
    own = (1.0 - 1.0 / (float(n) * n)) / 12.0
    xx = lead * own
    xy = lead * place
    yy = lead * c0
    power = tail
    for i in range(len(c)):
        k = (i + 1.0) / n
        xx += power * (own - 0.5 * k * k)
        xy += power * (place - change[i] * k / (2.0 * max(pairs[i], 1.0)))
        yy += power * c[i]
        power *= theta
    if xx <= 0.0:
        return 0.0
    rest = (yy - xy * xy / xx) * xx / n
    return xy / math.sqrt(rest) if rest > 0.0 else 0.0


def fit_still(c0: float, c: Sequence[float], n: int, place: float, change: Sequence[float],
              pairs: Sequence[float], log_a: float, theta: float, m: int
              ) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Fit a window whose mean is a constant."""
    if math.isnan(log_a):
        log_a, theta = guess(c0, c)
    log_a, theta, on_bound = search(c0, c, n - 1.0, log_a, theta, m, 0.0, 0.0)
    score = trend_score(c0, c, n, place, change, pairs, log_a, theta)
    end = finish(c0, c, n, n - 1.0, log_a, theta, on_bound, m)
    return (end[0], end[1], end[2], end[3], end[4], end[5], end[6], end[7], end[8], score)


def fit_sums(sums: Sequence[float], lags: int, log_a: float, theta: float, m: int
             ) -> tuple[float, float, float, float, float, float, float, float, float, float,
                        float, float]:
    """Fit a window whose mean is a constant, from its sums over lags (sums in V)."""
    n = int(sums[0])
    mean = sums[1] / n
    c0 = sums[3] / n - mean * mean
    # Lags without pairs count as uncorrelated.
    pairs = [max(sums[4 + k], 1.0) for k in range(lags)]
    change = [sums[4 + lags + k] for k in range(lags)]
    c = [c0 - 0.5 * sums[4 + 2 * lags + k] / pairs[k] for k in range(lags)]
    if not (c0 > 0.0 and c[0] > CORRELATED * c0 / math.sqrt(n)):
        none = math.nan
        return mean, c0, none, none, none, none, none, none, none, none, none, none
    place = (sums[2] - 0.5 * (n - 1) * sums[1]) / n / n
    end = fit_still(c0, c, n, place, change, pairs, log_a, theta, m)
    return (mean, c0, end[0], end[1], end[2], end[3], end[4], end[5], end[6], end[7], end[8],
            end[9])
