"""Flights of a supply whose level and intensity depend on throttle, and a risk to judge by."""

import math

import numpy as np
from ou_monitor.records import Estimate, Status
from scipy.signal import lfilter

ALPHA = 63.0
DT = 1e-3
BLOCK = 50


def level(u):
    """Return the level of a 5 V rail that sags, V."""
    return 5.0 - 0.2 * u - 0.15 * u * u


def log_sigma(u):
    """Return ln(sigma) of a rail four times as noisy at full throttle."""
    return math.log(0.3) + 2.0 * u - 0.6 * u * u


def fly(rng, throttle, dt=DT, *, level=level, log_sigma=log_sigma, drift=0.0, noise=0.0):
    """
    Return stamps and voltages: exact OU steps with throttle held over each.

    `level` and `log_sigma` take throttles of shape (n,), or (throttle, t) where they change.
    """
    n = throttle.size
    t = np.arange(n) * dt
    phi = math.exp(-ALPHA * dt)
    mean = level(throttle)
    kicks = np.exp(log_sigma(throttle)) * rng.standard_normal(n)
    kicks *= math.sqrt(-math.expm1(-2.0 * ALPHA * dt) / (2.0 * ALPHA))
    path, _ = lfilter([1.0], [1.0, -phi], (1.0 - phi) * mean + kicks, zi=[phi * mean[0]])
    return t, path - drift * t + noise * rng.standard_normal(n)


def holds(rng, duration, low=0.1, high=0.8, dt=DT):
    """Return throttle that is held for 0.3..3 s at a time."""
    n = round(duration / dt)
    parts, size = [], 0
    while size < n:
        part = np.full(round(rng.uniform(0.3, 3.0) / dt), rng.uniform(low, high))
        parts.append(part)
        size += part.size
    return np.concatenate(parts)[:n]


def wandering(rng, duration, low=0.1, high=0.8, dt=DT):
    """Return throttle that is held, ramps, and is worked by a controller all the while."""
    n = round(duration / dt)
    base = holds(rng, duration, low, high, dt)
    # Half of the steps become ramps of 1 s.
    smooth = lfilter(np.full(round(1.0 / dt), dt), [1.0],
                     np.concatenate([np.full(round(1.0 / dt), base[0]), base]))[-n:]
    base = np.where(np.arange(n) < n // 2, base, smooth)
    keep = math.exp(-dt / 0.3)
    work = lfilter([0.02 * math.sqrt(1.0 - keep * keep)], [1.0, -keep], rng.standard_normal(n))
    return np.clip(base + work, 0.0, 1.0)


class DrawnSupply:
    """A supply drawn from what the curves believe before a flight; it wanders as they expect."""

    def __init__(self, rng, n):
        nodes = np.linspace(0.0, 1.0, 9)
        alike = np.linalg.cholesky(np.exp(-np.abs(np.subtract.outer(nodes, nodes)) / 0.5))
        steps, t = 200, np.linspace(0.0, n * DT, 201)
        self.t, self.every, self.nodes = t, np.arange(n) * DT, nodes

        def shape(slope, bend, change, forgetting):
            walk = np.concatenate([[0.0], rng.standard_normal(8).cumsum() * bend / math.sqrt(8.0)])
            kicks = (rng.standard_normal((steps, 9)) @ alike.T) * change * math.sqrt(
                t[1] / forgetting)
            path = np.vstack([np.zeros(9), kicks.cumsum(axis=0)])
            return slope * rng.standard_normal() * (nodes - 0.5) + walk + path

        self.level = 5.0 + shape(0.75, 0.25, 0.05, 1800.0)
        drift, keep = 0.01 * rng.standard_normal(), math.exp(-t[1] / 30.0)
        for k in range(steps):
            step = drift * t[1] + 0.002 * math.sqrt(t[1]) * rng.standard_normal()
            self.level[k + 1:] += step
            drift = keep * drift + 0.01 * math.sqrt(1.0 - keep * keep) * rng.standard_normal()
        self.log_sigma = math.log(0.5) + shape(2.0, 1.0, 0.2, 300.0)

    def along(self, table, throttle):
        """Return a curve at the throttle and the time of each sample."""
        k = np.minimum((self.every / self.t[1]).astype(int), self.t.size - 2)
        early = self.every / self.t[1] - k
        i = np.minimum((throttle * 8).astype(int), 7)
        right = throttle * 8 - i
        return sum(w_t * (table[k_t, i] * (1.0 - right) + table[k_t, i + 1] * right)
                   for k_t, w_t in ((k, 1.0 - early), (k + 1, early)))

    def last(self, table, throttle):
        """Return a curve at the end, at throttles of shape (k,)."""
        return np.interp(throttle, self.nodes, table[-1])


def truth(u=0.4, **more):
    """Return the estimate that a perfect estimator would give at throttle u, 2 s at 1 kHz."""
    sigma = math.exp(log_sigma(u))
    values = {
        'alpha': ALPHA, 'sigma': sigma, 'var_inf': sigma ** 2 / (2.0 * ALPHA), 'u0': level(u),
        'noise_std': 0.0, 'alpha_se': 0.13, 'sigma_se': 0.016, 'var_inf_se': 0.13, 'u0_se': 0.01,
        'throttle': u, 'status': Status.OK, 'n': 2000, 'duration': 2.0, 'rate': 1000.0}
    return Estimate(**{**values, **more})


def learn(curves, t, y, throttle, estimate, block=BLOCK):
    """Give a flight to the curves, block by block."""
    for begin in range(0, t.size, block):
        part = slice(begin, begin + block)
        curves.update(t[part], y[part], throttle if throttle is None else throttle[part],
                      estimate)


def passage_risk(voltage, horizon):
    """
    Return a stand-in for the risk: Poisson passages, the errors by quadrature.

    For d standard deviations to the barrier passages come at the rate
    alpha d exp(-d^2/2) / sqrt(2 pi) once d > 1; from there down the rate stays, and below the
    barrier the risk is 1.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()

    def given(u0, ln_sigma, ln_alpha):
        alpha = np.exp(ln_alpha)
        d = (u0 - voltage) * np.sqrt(2.0 * alpha) / np.exp(ln_sigma)
        far = np.clip(d, 1.0, 37.0)
        rate = alpha * far * np.exp(-0.5 * far * far) / math.sqrt(2.0 * math.pi)
        return np.where(d <= 0.0, 1.0, -np.expm1(-rate * horizon))

    def probability(u0, u0_se, ln_sigma, ln_sigma_se, ln_alpha, ln_alpha_se):
        total = np.zeros(np.shape(u0))
        for z, w in zip(nodes, weights):
            for z2, w2 in zip(nodes, weights):
                total += w * w2 * given(u0 + z * u0_se, ln_sigma + z2 * np.hypot(
                    ln_sigma_se, 0.5 * ln_alpha_se), ln_alpha)
        return total

    return probability
