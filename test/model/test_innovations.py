"""Innovations in library code, against a Kalman filter that goes sample by sample."""

import math

import numpy as np
from ou_monitor.model import innovations
from ou_monitor.model.innovations import Filter, StateSpace
import pytest


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
def test_as_the_recursion(rates, noise, uneven):
    """
    Same innovations and variances, whatever the steps.

    Almost no noise costs digits: the precision of a sample is then some 1e6
    of that of a step, and of 16 digits ten are left.
    """
    model = relaxations(400, rates, noise, uneven=uneven)
    y = np.random.default_rng(2).standard_normal(400)
    run = Filter(model)
    e, variance = kalman(model, y)
    np.testing.assert_allclose(run.innovations(y), e, rtol=0.0, atol=1e-5)
    np.testing.assert_allclose(run.variance, variance, rtol=1e-8)


def test_states_that_turn_and_what_is_seen_of_them():
    """A transition that is not symmetric, and two series at once."""
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
    """A covariance that is none, and one that is not finite."""
    good = relaxations(50, [63.0, 2.0], 0.1)
    for bad in (-1e-3, math.nan):
        q = good.q.copy()
        q[20] *= bad
        with pytest.raises(ValueError, match='singular or not finite'):
            Filter(StateSpace(good.f, q, good.h, good.r))


@pytest.mark.parametrize('pieces', [2, 7, 200])
def test_in_pieces_as_at_once(monkeypatch, pieces):
    """Many states are worked on stretch by stretch; what is known is carried on."""
    model = relaxations(400, [63.0, 8.0, 0.5], 0.1, uneven=True)
    y = np.random.default_rng(4).standard_normal(400)
    monkeypatch.setattr(innovations, '_ELEMENTS', 400 * 9 / pieces)
    run = Filter(model)
    e, variance = kalman(model, y)
    np.testing.assert_allclose(run.innovations(y), e, rtol=0.0, atol=1e-7)
    np.testing.assert_allclose(run.variance, variance, rtol=1e-8)
