"""Windows with known truth, for the tests of the estimator."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
from scipy.signal import lfilter

ALPHA, SIGMA, LEVEL = 63.0, 0.632, 5.0
VAR_INF = SIGMA ** 2 / (2.0 * ALPHA)
DT = 1e-3
NAMES = ('alpha', 'sigma', 'var_inf')
TRUTH = np.array([ALPHA, SIGMA, VAR_INF])


def paths(rng, count, n, dt=DT, alpha=ALPHA, sigma=SIGMA):
    """Return stationary OU paths about LEVEL, shape (count, n), V."""
    kicks = rng.standard_normal((count, n)) * sigma / math.sqrt(2.0 * alpha)
    kicks[:, 1:] *= math.sqrt(-math.expm1(-2.0 * alpha * dt))
    return LEVEL + lfilter([1.0], [1.0, -math.exp(-alpha * dt)], kicks, axis=1)


def stamps(n, dt=DT):
    """Return n stamps from 0 on."""
    return np.arange(n) * dt


def estimate(t, y, throttle=None, window=None, **more):
    """Return the estimate of one window with all samples."""
    estimator = SlidingEstimator(window or 1.03 * float(t[-1] - t[0]), **more)
    estimator.push(t, y, throttle)
    return estimator.estimate()


def errors(estimates, truth=TRUTH):
    """Return relative errors of alpha, sigma and Var_inf, shape (count, 3)."""
    return np.array([[getattr(e, name) for name in NAMES] for e in estimates]) / truth - 1.0


def covered(estimates, truth=TRUTH):
    """Return the share of 95 % intervals that contain the truth, for each parameter."""
    inside = [[e.interval(name)[0] <= value <= e.interval(name)[1]
               for name, value in zip(NAMES, truth)] for e in estimates]
    return np.mean(inside, axis=0)
