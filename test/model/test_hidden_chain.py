"""Hidden chains in blocks, against the recursion sample by sample."""

import warnings

import numpy as np
from ou_monitor.model.hidden_chain import forward, log_likelihood
import pytest


@pytest.mark.parametrize('states', [1, 2, 3, 7])
@pytest.mark.parametrize('n', [1, 2, 24, 25, 1000])
def test_as_the_recursion(states, n):
    """Laws and evidence, whether or not the blocks come out even."""
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


def test_densities_far_apart():
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
