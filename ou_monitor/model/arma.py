"""
ARMA(1,1) form of a sampled or block-averaged OU with white noise, and errors of the OU parameters.

Samples of an OU are AR(1); white noise on top, or averaging over blocks, makes
them ARMA(1,1): z_j - phi z_{j-1} = e_j - theta e_{j-1}, with phi = exp(-alpha D)
for the step D.  Averages over blocks *without* noise have theta < 0; noise
raises theta towards phi.  In units of sigma^2 D the shape depends only on
a = alpha D, the samples per block m, and the noise share
lam = (noise variance of one z) / (sigma^2 D).

The block autocovariances are double sums of phi^(|i-j|/m), evaluated by the
geometric series; the ARMA identities are from Hamilton, Time Series Analysis
(1994), ch. 3.
"""

from __future__ import annotations

import math


def block_autocovariance(a: float, m: int) -> tuple[float, float]:
    """Return the autocovariances of noise-free block means at lags 0 and 1."""
    variance = 0.5 / a
    if m == 1:
        return variance, variance * math.exp(-a)
    r = math.exp(-a / m)
    short, long = -math.expm1(-a / m), -math.expm1(-a)
    if a < 1e-3:
        # The two terms of gamma0 cancel to order a; this series is accurate to 1e-9, with
        # x = |i-j|/m: 1 - a mean(x) + a^2 mean(x^2)/2 - a^3 mean(x^3)/6.
        k = float(m)
        one = (k * k - 1.0) / (3.0 * k * k)
        two = (k * k - 1.0) / (6.0 * k * k)
        three = (k * k - 1.0) * (3.0 * k * k - 2.0) / (30.0 * k ** 4)
        gamma0 = variance * (1.0 - a * one + a * a * two / 2.0 - a ** 3 * three / 6.0)
    else:
        gamma0 = variance * (m * short * (1.0 + r) - 2.0 * r * long) / (m * short) ** 2
    gamma1 = variance * r * (long / (m * short)) ** 2
    return gamma0, gamma1


def theta_at(a: float, m: int, share: float) -> float:
    """Return the moving-average coefficient theta at a noise share lam."""
    phi = math.exp(-a)
    gamma0, gamma1 = block_autocovariance(a, m)
    gamma0 += share
    ratio = 2.0 * (phi * gamma0 - gamma1) / (gamma0 * (1.0 + phi * phi) - 2.0 * phi * gamma1)
    return ratio / (1.0 + math.sqrt(max(1.0 - ratio * ratio, 0.0)))


def log_covariance(a: float, theta: float, m: int, n: int) -> tuple[float, float, float]:
    """Return the variances of ln(alpha), ln(sigma) and ln(Var_inf) from n blocks."""
    # The covariance of (phi, theta) is (1 - phi theta)/(phi - theta)^2 / n times [[(1-phi^2)(1-phi
    # theta), (1-phi^2)(1-theta^2)], [., (1-theta^2)(1-phi theta)]], and the variance of ln q, with
    # q = Var e, is 2/n (Box & Jenkins, Time Series Analysis, 7.2.6); the delta method gives the
    # variances of the other logarithms.
    phi = math.exp(-a)
    one, other = -math.expm1(-2.0 * a), 1.0 - theta * theta
    cross, apart = 1.0 - phi * theta, phi - theta
    common = cross / (apart * apart * n)
    v_phi, v_theta, v_cross = (common * one * cross, common * other * cross,
                               common * one * other)
    # Derivatives of ln q~(a, theta), with ln sigma^2 = ln q - ln q~: q~ is q at sigma = 1.
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
