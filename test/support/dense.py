"""References for the fast likelihoods: dense linear algebra and a plain Kalman filter."""

import math

import numpy as np
from scipy.linalg import cho_factor, cho_solve


def block_autocovariances(a, m, count):
    """Return autocovariances of OU block means at lags 0..count-1, by double sums."""
    # The double sum runs over the distance of both samples; result in units of sigma^2 D.
    distance = np.arange(1 - m, m)
    weight = (m - np.abs(distance)) / m ** 2
    lags = np.arange(count)[:, None]
    return 0.5 / a * (weight * np.exp(-a * np.abs(lags + distance / m))).sum(axis=1)


def ou_covariance(t, alpha, sigma, noise_var):
    """Return the covariance matrix of an OU in white noise at stamps t."""
    distance = np.abs(np.subtract.outer(t, t))
    return sigma ** 2 / (2.0 * alpha) * np.exp(-alpha * distance) + noise_var * np.eye(t.size)


def restricted(cov, y, x):
    """
    Return restricted log-likelihood, nats, profiled over scale; scale; beta and its covariance.

    `cov` is the covariance up to that scale, `x` the regressors.
    """
    factor = cho_factor(cov, lower=True)
    log_det = 2.0 * np.log(factor[0].diagonal()).sum()
    gram = x.T @ cho_solve(factor, x)
    beta = np.linalg.solve(gram, x.T @ cho_solve(factor, y))
    rest = y - x @ beta
    free = y.size - x.shape[1]
    scale = float(rest @ cho_solve(factor, rest)) / free
    value = -0.5 * (free * math.log(2.0 * math.pi * scale) + free + log_det
                    + np.linalg.slogdet(gram)[1])
    return value, scale, beta, np.linalg.inv(gram) * scale


def fisher(covariance, at, steps):
    """Return tr(K^-1 dK_i K^-1 dK_j) / 2 for covariance(p), by central differences."""
    inverse = np.linalg.inv(covariance(at))
    parts = []
    for i, step in enumerate(steps):
        shift = np.zeros(len(at))
        shift[i] = step
        parts.append(inverse @ (covariance(at + shift) - covariance(at - shift)) / (2.0 * step))
    return np.array([[0.5 * np.sum(p * q.T) for q in parts] for p in parts])
