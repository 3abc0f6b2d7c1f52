"""ARMA(1,1) of samples and block means: double sums, spectra, dense information."""

import math

from dense import block_autocovariances, fisher
import numpy as np
from ou_monitor.model import arma
import pytest
from scipy.linalg import toeplitz

BLOCKS = (1, 2, 3, 7, 100, 1000)
RATES = (1e-7, 1e-4, 9.9e-4, 1.01e-3, 0.02, 0.3, 4.0)


@pytest.mark.parametrize('m', BLOCKS)
@pytest.mark.parametrize('a', RATES)
def test_block_autocovariances_are_the_double_sums(a, m):
    # gamma0 and gamma1 agree to a few roundings; their difference is a times smaller, and where
    # the closed form is used (a >= 1e-3) it loses eps/a^2. Below, the reference itself loses eps/a
    # in the difference.
    expected = block_autocovariances(a, m, 2)
    got = arma.block_autocovariance(a, m)
    assert got == pytest.approx(expected, rel=1e-9)
    assert 2.0 * (got[0] - got[1]) == pytest.approx(
        2.0 * (expected[0] - expected[1]), rel=2e-9 + 1e-14 / a)


def spectral(a, m, share):
    """Return theta from the spectrum (Kolmogorov's formula)."""
    gamma = block_autocovariances(a, m, 2)
    gamma[0] += share
    phi = math.exp(-a)
    g0 = gamma[0] * (1.0 + phi * phi) - 2.0 * phi * gamma[1]
    g1 = gamma[1] * (1.0 + phi * phi) - phi * (gamma[0] + phi * gamma[1])
    w = (np.arange(4096) + 0.5) * math.pi / 4096
    q = math.exp(np.log(g0 + 2.0 * g1 * np.cos(w)).mean())
    return -g1 / q


@pytest.mark.parametrize('m', BLOCKS)
@pytest.mark.parametrize('a, share', [
    (0.01, 0.0), (0.01, 0.3), (0.063, 0.1), (0.3, 0.0), (0.3, 2.0), (2.0, 0.5), (0.02, 20.0)])
def test_theta_is_that_of_the_spectrum(a, share, m):
    """The geometric mean of the spectrum is the innovation variance; 4096 points give 1e-9."""
    assert arma.theta_at(a, m, share) == pytest.approx(spectral(a, m, share), abs=1e-8)


@pytest.mark.parametrize('m', [1, 4])
@pytest.mark.parametrize('a, share', [(0.2, 0.15), (0.6, 0.6), (0.1, 0.02)])
def test_log_covariance_is_the_dense_expected_information(a, share, m):
    """The information of 2n samples less that of n, over n, is free of the ends."""
    # Parameters of the dense matrix are ln(alpha), ln(sigma^2) and the noise; with steps of 1e-4
    # the differences are exact to 1e-7, and the ends have fallen to exp(-2 n a) = 1e-13 or less.
    n = 150
    gammas = {}

    def covariance(p, count):
        key = (p[0], count)
        if key not in gammas:
            gammas[key] = block_autocovariances(a * math.exp(p[0]), m, count)
        # In units of sigma^2 times a fixed step, whatever alpha.
        column = math.exp(p[1]) * gammas[key]
        return toeplitz(column) + p[2] * np.eye(count)

    at, steps = np.array([0.0, 0.0, share]), (1e-4, 1e-4, 1e-4 * share)
    per_sample = (fisher(lambda p: covariance(p, 2 * n), at, steps)
                  - fisher(lambda p: covariance(p, n), at, steps)) / n
    cov = np.linalg.inv(per_sample) / 1000.0
    expected = (cov[0, 0], cov[1, 1] / 4.0, cov[0, 0] + cov[1, 1] - 2.0 * cov[0, 1])
    assert arma.log_covariance(a, arma.theta_at(a, m, share), m, 1000) == pytest.approx(
        expected, rel=1e-5)
