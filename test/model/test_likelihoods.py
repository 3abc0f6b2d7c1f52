"""Likelihoods (chains, innovations, Whittle, ARMA) against recursions and dense matrices."""

import math
import warnings

from dense import block_autocovariances, fisher, ou_covariance, restricted
import numpy as np
from ou_monitor.model import arma, innovations
from ou_monitor.model.hidden_chain import forward, log_likelihood
from ou_monitor.model.innovations import Filter, StateSpace
from ou_monitor.model.ou import simulate
from ou_monitor.model.whittle import cosines, CrossSpectrum
from ou_monitor.online.estimator.fit import noise_scale, SpectralLikelihood
import pytest
from scipy.fft import dct
from scipy.linalg import toeplitz


@pytest.mark.parametrize('states', [1, 2, 3, 7])
@pytest.mark.parametrize('n', [1, 2, 24, 25, 1000])
def test_blocks_give_the_laws_and_evidence_of_the_recursion(states, n):
    rng = np.random.default_rng(states * 1000 + n)
    density = 3.0 * rng.standard_normal((n, states, states))
    transition = rng.dirichlet(np.ones(states), states)
    start = rng.dirichlet(np.ones(states))
    before, evidence = forward(density, transition, start)
    law = start
    for k in range(n):
        np.testing.assert_allclose(before[k], law, atol=1e-12)
        law = law @ (transition * np.exp(density[k]))
        assert evidence[k] == pytest.approx(np.log(law.sum()), abs=1e-10)
        law = law / law.sum()
    assert log_likelihood(density, transition, start) == pytest.approx(evidence.sum(), abs=1e-9)


def test_densities_far_apart_give_no_zeros_and_no_nan():
    """Hundreds of nats between the states of one sample leave no zeros and no NaN."""
    density = np.zeros((5000, 2, 2))
    density[::2, :, 0] = -600.0
    density[1::2, :, 1] = -600.0
    transition = np.array([[0.9, 0.1], [0.1, 0.9]])
    before, evidence = forward(density, transition, np.array([0.5, 0.5]))
    assert np.isfinite(before).all() and np.isfinite(evidence).all()
    # Every step must change the state.
    np.testing.assert_allclose(evidence[1:], np.log(0.1), atol=1e-9)
    total = log_likelihood(density, transition, np.array([0.5, 0.5]))
    assert total == pytest.approx(evidence.sum(), rel=1e-12)


@pytest.mark.parametrize('at', [0, 30, 999])
def test_a_sample_out_of_reach_of_all_states_is_finite(at):
    """One that only a state explains which cannot be: no warning, and laws after it."""
    density = np.zeros((1000, 2, 2))
    density[at] = [[-1e18, -1e18], [0.0, 0.0]]
    transition = np.array([[1.0, 0.0], [0.0, 1.0]])
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        before, evidence = forward(density, transition, np.array([1.0, 0.0]))
    assert np.isfinite(before).all() and np.isfinite(evidence).all()
    np.testing.assert_allclose(before.sum(axis=1), 1.0)
    assert evidence[at] < -600.0 and np.delete(evidence, at) == pytest.approx(0.0)


def kalman(model, y):
    """Return innovations and their variances by the textbook recursion."""
    x, e, variance = np.zeros(model.h.size), np.empty(y.size), np.empty(y.size)
    p = np.zeros_like(model.q[0])
    for k in range(y.size):
        x = model.f[k] @ x
        p = model.f[k] @ p @ model.f[k].T + model.q[k]
        e[k] = y[k] - model.h @ x
        variance[k] = model.h @ p @ model.h + model.r[k]
        gain = p @ model.h / variance[k]
        x, p = x + gain * e[k], p - np.outer(gain, model.h @ p)
    return e, variance


def relaxations(n, rates, noise, *, uneven=False, seed=1):
    """Return independent OUs of unit variance, seen together."""
    rng = np.random.default_rng(seed)
    step = rng.exponential(1e-3, n) if uneven else np.full(n, 1e-3)
    rates = np.asarray(rates, dtype=float)
    phi = np.exp(-rates * step[:, None])
    f, q = np.zeros((2, n, rates.size, rates.size))
    for j in range(rates.size):
        f[:, j, j], q[:, j, j] = phi[:, j], 1.0 - phi[:, j] ** 2
    q[0] = np.eye(rates.size)
    return StateSpace(f, q, np.ones(rates.size), np.full(n, noise))


@pytest.mark.parametrize('rates', [[63.0], [63.0, 2.0], [63.0, 8.0, 0.5], [300.0, 63.0, 8.0, 0.5]])
@pytest.mark.parametrize('noise', [0.1, 1e-6])
@pytest.mark.parametrize('uneven', [False, True])
def test_the_filter_equals_the_kalman_recursion(rates, noise, uneven):
    # Almost no noise costs digits: the precision of a sample is then some 1e6 of that of a step,
    # and of 16 digits ten are left.
    model = relaxations(400, rates, noise, uneven=uneven)
    y = np.random.default_rng(2).standard_normal(400)
    run = Filter(model)
    e, variance = kalman(model, y)
    np.testing.assert_allclose(run.innovations(y), e, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(run.variance, variance, rtol=1e-8)


def test_rotating_states_are_filtered_as_by_the_recursion():
    n, turn = 300, 0.7
    rotation = 0.99 * np.array([[math.cos(turn), -math.sin(turn)],
                                [math.sin(turn), math.cos(turn)]])
    model = StateSpace(np.tile(rotation, (n, 1, 1)),
                       np.tile(0.02 * np.array([[1.0, 0.3], [0.3, 0.5]]), (n, 1, 1)),
                       np.array([1.0, -0.4]), np.full(n, 0.05))
    y = np.random.default_rng(3).standard_normal((n, 2))
    found = Filter(model).innovations(y)
    for k in range(2):
        np.testing.assert_allclose(found[:, k], kalman(model, y[:, k])[0], atol=1e-11)


@pytest.mark.parametrize('rates', [[63.0], [63.0, 2.0], [63.0, 63.0, 8.0]])
def test_a_settled_gain_goes_on(rates):
    """The first samples stand for a model that does not change; equal poles, too."""
    whole = relaxations(9000, rates, 0.1)
    first = StateSpace(whole.f[:2048], whole.q[:2048], whole.h, whole.r[:2048])
    y = np.random.default_rng(4).standard_normal((9000, 2))
    one, two = Filter(whole), Filter(first, 9000)
    np.testing.assert_allclose(two.innovations(y), one.innovations(y), atol=1e-5)
    np.testing.assert_allclose(two.variance, one.variance, rtol=2e-5)


def test_singular_is_refused():
    good = relaxations(50, [63.0, 2.0], 0.1)
    for bad in (-1e-3, math.nan):
        q = good.q.copy()
        q[20] *= bad
        with pytest.raises(ValueError, match='singular or not finite'):
            Filter(StateSpace(good.f, q, good.h, good.r))


@pytest.mark.parametrize('pieces', [2, 7, 200])
def test_a_filter_in_pieces_equals_one_at_once(monkeypatch, pieces):
    """Many states are worked on stretch by stretch; what is known is carried on."""
    model = relaxations(400, [63.0, 8.0, 0.5], 0.1, uneven=True)
    y = np.random.default_rng(4).standard_normal(400)
    monkeypatch.setattr(innovations, '_ELEMENTS', 400 * 9 / pieces)
    run = Filter(model)
    e, variance = kalman(model, y)
    np.testing.assert_allclose(run.innovations(y), e, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(run.variance, variance, rtol=1e-8)


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
        spectrum.bins.ou(np.array([[a]]))[0],
        np.diagonal(D @ toeplitz(np.exp(-a * np.arange(n))) @ D.T), rtol=1e-10)


def test_ordinates_of_a_random_walk_are_exact():
    """Its level is a regressor: of the others the covariance is diagonal."""
    n = 20
    D = dct(np.eye(n), axis=0, norm='ortho')
    K = D @ np.minimum(*np.indices((n, n))) @ D.T
    np.testing.assert_allclose(
        1.0 / CrossSpectrum(np.ones((2, n)), [n]).bins.walk[1:], np.diagonal(K)[1:], rtol=1e-9)


@pytest.mark.parametrize('m', [1, 4])
@pytest.mark.parametrize('a, share', [(0.02, 0.0), (0.06, 0.1), (0.3, 1.0)])
def test_the_likelihood_is_nearly_that_of_dense_matrices(m, a, share):
    """Between two points it rises by as many nats, to 0.2."""
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
