"""Generators, their laws and their paths against closed forms and independent calculations."""

import math

import numpy as np
from ou_monitor.paper.theory import Generator
import pytest
from scipy.integrate import quad_vec
from scipy.linalg import expm, null_space
from scipy.stats import chi2, kstest

# A chain without symmetry: neither reversible nor uniform.
FIVE = Generator(np.array([
    [-3.0, 2.0, 0.0, 1.0, 0.0],
    [0.5, -2.5, 2.0, 0.0, 0.0],
    [0.0, 0.0, -1.0, 1.0, 0.0],
    [0.0, 0.0, 0.0, -4.0, 4.0],
    [5.0, 0.0, 1.0, 0.0, -6.0]]))


@pytest.mark.parametrize('q, message', [
    ([[1.0, 2.0, 3.0]], r'must be square, got shape \(1, 3\)'),
    ([[0.0]], 'two states or more'),
    ([[-1.0, 1.0], [math.nan, -1.0]], r'Q\[1, 0\] is nan'),
    ([[-1.0, 1.0], [-2.0, 2.0]], r'Q\[1, 0\] = -2 1/s is negative'),
    ([[-1.0, 1.0], [2.0, -1.5]], r'row 1 of Q sums to 0.5 1/s.*should be -2'),
    ([[-1.0, 1.0], [0.0, 0.0]], 'no single stationary law'),
    ([[-1.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0],
      [0.0, 0.0, 1.0, -1.0]], r'one another: \[0, 1\], \[2, 3\]'),
])
def test_non_ergodic_generators_are_refused(q, message):
    with pytest.raises(ValueError, match=message):
        Generator(np.array(q))


def test_row_tolerance_is_relative_to_the_largest_rate():
    """1e-10 of the largest rate is rounding, 1e-8 of it is not."""
    for scale in (1e-6, 1.0, 1e6):
        rounded = Generator(scale * np.array([[-1.0, 1.0 + 1e-10], [1.0, -1.0]]))
        assert (rounded.q.sum(axis=1) == 0.0).all()
        with pytest.raises(ValueError, match='row 0'):
            Generator(scale * np.array([[-1.0, 1.0 + 1e-8], [1.0, -1.0]]))


def test_stationary_law_is_the_null_space():
    law = null_space(FIVE.q.T)[:, 0]
    assert FIVE.stationary == pytest.approx(law / law.sum(), rel=1e-12)


@pytest.mark.parametrize('speed', [1.0, 1e5])
def test_potential_is_the_integral(speed):
    """The defining integral, by quadrature, at rates of 1/s and of 100 kHz."""
    chain = Generator(speed * FIVE.q)
    projector = np.tile(FIVE.stationary, (5, 1))
    integral, _ = quad_vec(lambda t: expm(FIVE.q * t) - projector, 0.0, 60.0, epsabs=1e-12)
    assert chain.potential == pytest.approx(integral / speed, abs=1e-9 / speed)
    assert chain.q @ chain.potential == pytest.approx(projector - np.eye(5), abs=1e-12)
    assert chain.potential @ projector == pytest.approx(0.0, abs=1e-13 / speed)


def test_paths_jump_by_the_kernel_and_hold_exponentially():
    """Chi-square of the jumps of each state and KS of the holding times, level 1e-4 each."""
    rng = np.random.default_rng(3)
    steps = list(FIVE.segments(np.array([0.0, 20_000.0]), FIVE.starts(1, rng), rng))
    states = np.array([int(at[0]) for _, _, at, _ in steps])
    times = np.array([float(spent[0]) for _, _, _, spent in steps])
    assert times.sum() == pytest.approx(20_000.0, rel=1e-12) and (times > 0.0).all()
    held = times[:-1] * FIVE.leaving[states[:-1]]
    assert kstest(held, 'expon').pvalue > 1e-4
    counts = np.zeros((5, 5))
    np.add.at(counts, (states[:-1], states[1:]), 1.0)
    expected = FIVE.jump_probabilities * counts.sum(axis=1, keepdims=True)
    assert (counts[expected == 0.0] == 0.0).all()
    possible = expected > 0.0
    statistic = ((counts - expected)[possible] ** 2 / expected[possible]).sum()
    assert statistic < chi2.ppf(1.0 - 1e-4, possible.sum() - 5)


@pytest.mark.parametrize('call, message', [
    (lambda rng: Generator(np.array([[-1j, 1j], [1j, -1j]])), 'rates must be real'),
    (lambda rng: FIVE.starts(0, rng), 'paths must be 1 or more'),
    (lambda rng: FIVE.transition(-1.0), 't must be zero or positive'),
])
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.random.default_rng(0))
