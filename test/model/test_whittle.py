"""The cosine ordinates of a window against dense matrices."""

import math

from dense import block_autocovariances, ou_covariance, restricted
import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.model.whittle import cosines, CrossSpectrum
from ou_monitor.online.estimator.fit import noise_scale, SpectralLikelihood
import pytest
from scipy.fft import dct
from scipy.linalg import toeplitz


@pytest.mark.parametrize('n', [1, 2, 3, 8, 41])
def test_the_transform_is_the_cosine_transform(n):
    x = np.random.default_rng(n).standard_normal((3, n))
    np.testing.assert_allclose(cosines(x), dct(x, axis=1, norm='ortho'), atol=1e-14)


@pytest.mark.parametrize('n, a', [(24, 1e-3), (23, 0.1), (24, 3.0)])
def test_ordinates_expected_of_an_ou_are_exact(n, a):
    """Up to 24 they are taken one by one: the diagonal of the transformed covariance."""
    D = dct(np.eye(n), axis=0, norm='ortho')
    spectrum = CrossSpectrum(np.ones((2, n)), [n])
    np.testing.assert_allclose(
        spectrum.ou(np.array([[a]]))[0],
        np.diagonal(D @ toeplitz(np.exp(-a * np.arange(n))) @ D.T), rtol=1e-10)


def test_ordinates_of_a_walk():
    """Its level is a regressor: of the others the covariance is diagonal."""
    n = 20
    D = dct(np.eye(n), axis=0, norm='ortho')
    K = D @ np.minimum(*np.indices((n, n))) @ D.T
    np.testing.assert_allclose(
        1.0 / CrossSpectrum(np.ones((2, n)), [n]).walk[1:], np.diagonal(K)[1:], rtol=1e-9)


@pytest.mark.parametrize('m', [1, 4])
@pytest.mark.parametrize('a, share', [(0.02, 0.0), (0.06, 0.1), (0.3, 1.0)])
def test_the_likelihood_is_nearly_that_of_dense_matrices(m, a, share):
    """
    Between two points it rises by as many nats, to 0.2.

    A Fourier transform of the same window misses by several: it leaks.
    """
    rng = np.random.default_rng(1)
    n, step = 400, 0.01
    t = np.arange(m * n) * step / m
    y = simulate(t, a / step, 1.0, rng).reshape(n, m).mean(axis=1)
    y += math.sqrt(share * step) * rng.standard_normal(n)
    x = np.column_stack([np.ones(n), np.sin(np.arange(n) / 7.0)])
    ours = SpectralLikelihood(np.concatenate([x.T, [y]]), [n], step, m)

    def both(factor):
        K = (ou_covariance(t[::m], factor * a / step, 1.0, share * step) if m == 1 else step * (
            toeplitz(block_autocovariances(factor * a, m, n)) + share * np.eye(n)))
        at = ours.at(math.log(factor * a), noise_scale(share), 2)
        dense = restricted(K, y, x)
        assert at.scale == pytest.approx(dense[1], rel=0.02)
        return -at.value, dense[0]

    here, there = both(1.0), both(1.5)
    assert here[0] - there[0] == pytest.approx(here[1] - there[1], abs=0.2)
