"""Generators, their laws and their paths against closed forms and independent calculations."""

import math

import numpy as np
from ou_monitor.paper.theory.switching import Generator
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
    ([[-1.0, 1.0], [0.0, 0.0]], 'state 1 absorbing'),
    ([[0.0, 0.0], [0.0, 0.0]], 'states 0, 1 absorbing'),
    ([[-1.0, 1.0, 0.0, 0.0], [1.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0],
      [0.0, 0.0, 1.0, -1.0]], r'2 closed classes \(states 0, 1; states 2, 3\)'),
    ([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [0.0, 1.0, -1.0]], 'state 0 transient'),
])
def test_what_is_no_ergodic_generator_is_refused(q, message):
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


def test_stationary_law_keeps_its_digits_over_forty_decades():
    """Detailed balance of a birth-death chain, pi[k + 1] / pi[k] = up / down."""
    up, down = np.array([1e-12, 1e6, 1e-9]), np.array([1e9, 1e-3, 1e10])
    law = np.concatenate([[1.0], np.cumprod(up / down)])
    assert Generator.birth_death(up, down).stationary == pytest.approx(
        law / law.sum(), rel=1e-13)


def test_constructors_give_their_stationary_laws():
    assert Generator.telegraph(1.0, 3.0).stationary == pytest.approx([0.75, 0.25])
    assert Generator.cycle([1.0, 2.0, 4.0]).stationary == pytest.approx(np.array([4, 2, 1]) / 7)
    assert Generator.cycle([1.0, 2.0, 4.0]).jump_rate == pytest.approx(3.0 / 1.75)


def test_embedded_chain_is_related_as_the_paper_says():
    """Section 3.2: pi(x) q(x) = q rho(x) with q = sum pi q; and rho P = rho."""
    rate = FIVE.stationary @ FIVE.leaving
    assert FIVE.stationary * FIVE.leaving == pytest.approx(rate * FIVE.embedded, rel=1e-13)
    assert FIVE.embedded @ FIVE.jump_probabilities == pytest.approx(FIVE.embedded, rel=1e-12)


@pytest.mark.parametrize('speed', [1.0, 1e5])
def test_potential_is_the_integral(speed):
    """The defining integral, by quadrature, at rates of 1/s and of 100 kHz."""
    chain = FIVE.sped_up(speed)
    integral, _ = quad_vec(
        lambda t: expm(FIVE.q * t) - FIVE.projector, 0.0, 60.0, epsabs=1e-12)
    assert chain.potential == pytest.approx(integral / speed, abs=1e-9 / speed)
    assert chain.q @ chain.potential == pytest.approx(chain.projector - np.eye(5), abs=1e-12)
    assert chain.potential @ chain.projector == pytest.approx(0.0, abs=1e-13 / speed)


def test_alias_table_holds_the_law_of_the_jumps():
    """Summed over the cells, the table gives back every probability, zeros exactly."""
    rng = np.random.default_rng(0)
    rates = rng.random((40, 40)) ** 8 * (rng.random((40, 40)) < 0.3)
    rates[np.arange(40), (np.arange(40) + 1) % 40] += 1e-6
    np.fill_diagonal(rates, 0.0)
    chain = Generator(rates - np.diag(rates.sum(axis=1)))
    table = chain._table
    law = table.keep / 40
    for row in range(40):
        np.add.at(law[row], table.other[row], (1.0 - table.keep[row]) / 40)
    assert law == pytest.approx(chain.jump_probabilities, abs=1e-15)
    assert (law[chain.jump_probabilities == 0.0] == 0.0).all()


def test_paths_jump_by_the_kernel_and_hold_exponentially():
    """Chi-square of the jumps of each state and KS of the holding times, level 1e-4 each."""
    path = FIVE.sample_path(20_000.0, np.random.default_rng(3))
    assert path.times[0] == 0.0 and path.end == 20_000.0 and (np.diff(path.times) > 0.0).all()
    held = np.diff(path.times) * FIVE.leaving[path.states[:-1]]
    assert kstest(held, 'expon').pvalue > 1e-4
    counts = np.zeros((5, 5))
    np.add.at(counts, (path.states[:-1], path.states[1:]), 1.0)
    expected = FIVE.jump_probabilities * counts.sum(axis=1, keepdims=True)
    assert (counts[expected == 0.0] == 0.0).all()
    possible = expected > 0.0
    statistic = ((counts - expected)[possible] ** 2 / expected[possible]).sum()
    assert statistic < chi2.ppf(1.0 - 1e-4, possible.sum() - 5)


def test_state_and_occupation_of_a_path_agree_with_counting():
    """Occupation by a fine grid of midpoints differs by at most a cell for each jump."""
    rng = np.random.default_rng(4)
    path = FIVE.sample_path(10.0, rng, start=2)
    edges = np.array([0.0, 0.3, 4.0, 10.0])
    spent = path.occupation(edges, 5)
    assert spent.sum(axis=1) == pytest.approx(np.diff(edges), rel=1e-12)
    cell = 1e-4
    middles = np.arange(0.0, 10.0, cell) + cell / 2
    counted = np.zeros((3, 5))
    np.add.at(counted, (np.searchsorted(edges, middles) - 1, path.state_at(middles)), cell)
    assert np.abs(counted - spent).max() < cell * path.times.size
    assert path.state_at(0.0) == 2 and (path.state_at(path.times) == path.states).all()
    with pytest.raises(ValueError, match='outside the path, which covers 0..10 s'):
        path.state_at(10.1)


@pytest.mark.parametrize('chain', [FIVE, Generator.cycle([2.0, 3.0, 4.0])])
def test_streams_join_and_are_bounded(chain):
    """Pieces meet at their ends, hold no more than a block, and never repeat a state."""
    drawn = list(chain.stream(50.0, np.random.default_rng(5), block=16))
    assert len(drawn) > 3 and all(piece.times.size <= 16 for piece in drawn)
    assert drawn[0].times[0] == 0.0 and drawn[-1].end == 50.0
    for before, after in zip(drawn[:-1], drawn[1:], strict=True):
        assert before.end == after.times[0]
    states = np.concatenate([piece.states for piece in drawn])
    assert (chain.jump_probabilities[states[:-1], states[1:]] > 0.0).all()


def test_no_time_is_lost_between_the_pieces():
    """Jumps of equal phases are Poisson; a hold lost in each block of four adds a third."""
    drawn = Generator.cycle([3.0, 3.0]).stream(5000.0, np.random.default_rng(5), block=4)
    jumps = sum(piece.times.size for piece in drawn) - 1
    assert abs(jumps - 15_000) < 5.0 * math.sqrt(15_000)


def test_ensembles_have_the_transition_law():
    """P(x(t) = y) is the row of exp(Q t): within five standard errors of 20 000 paths."""
    states, spent = FIVE.sample_many([0.0, 0.2, 1.0], 20_000, np.random.default_rng(6), start=3)
    for k, t in enumerate((0.0, 0.2, 1.0)):
        law = FIVE.transition(t)[3]
        found = np.bincount(states[:, k], minlength=5) / 20_000
        assert (np.abs(found - law) <= 5.0 * np.sqrt(law * (1.0 - law) / 20_000)).all()
    integral, _ = quad_vec(lambda t: expm(FIVE.q * t)[3], 0.0, 1.0)
    total = spent.sum(axis=1)
    error = total.std(axis=0) / math.sqrt(20_000)
    assert (np.abs(total.mean(axis=0) - integral) < 5.0 * error).all()


@pytest.mark.parametrize('method', ['ensemble', 'stream'])
def test_monte_carlo_decides_for_the_factor_two(method):
    """
    Var of the integral of +-1 telegraph noise over its length is 1/q, not 1/(2q).

    Exact: (1/q) (1 - (1 - exp(-2 q T)) / (2 q T)). A variance from n nearly
    Gaussian samples has the relative error sqrt(2 / n): 2.2 % for n = 4000.
    Five of these are allowed, a false alarm in 2 million. Without the factor 2
    the ratio would be 2, forty errors away: power 1 to any digit.
    """
    q, horizon, n = 1.5, 30.0, 4000
    chain, rng = Generator.telegraph(q, q), np.random.default_rng(7)
    value = np.array([-1.0, 1.0])
    if method == 'ensemble':
        _, spent = chain.sample_many([0.0, horizon], n, rng)
        total = spent[:, 0] @ value
        correlation = 0.0
    else:
        # Windows of one long path: neighbours share a memory of 1/(2q), 1 % of a window.
        path = chain.sample_path(n * horizon, rng)
        total = path.occupation(np.arange(n + 1) * horizon, 2) @ value
        correlation = 1.0 / (2.0 * q * horizon)
    memory = (1.0 - math.exp(-2.0 * q * horizon)) / (2.0 * q * horizon)
    exact = horizon / q * (1.0 - memory)
    ratio = np.mean(total**2) / exact
    assert abs(ratio - 1.0) < 5.0 * math.sqrt(2.0 / n) * (1.0 + correlation)
    potential = chain.stationary * value @ chain.potential @ value
    assert 2.0 * potential * horizon * (1.0 - memory) == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize('call, message', [
    (lambda rng: FIVE.sample_path(0.0, rng), 'duration must be positive'),
    (lambda rng: FIVE.sample_path(1.0, rng, start=5), 'start must be a state 0..4, got 5'),
    (lambda rng: FIVE.sample_path(1.0, rng, start=1.5), 'start must be a state 0..4, got 1.5'),
    (lambda rng: Generator(np.array([[-1j, 1j], [1j, -1j]])), 'rates must be real'),
    (lambda rng: FIVE.stream(1.0, rng, block=0), 'block must be 1 or more'),
    (lambda rng: FIVE.sample_many([1.0, 0.0], 3, rng), 'must not decrease'),
    (lambda rng: FIVE.sample_many([0.0, 1.0], 0, rng), 'paths must be 1 or more'),
    (lambda rng: FIVE.sped_up(0.0), 'factor must be positive'),
    (lambda rng: FIVE.transition(-1.0), 't must be zero or positive'),
    (lambda rng: Generator.cycle([1.0]), 'two or more'),
    (lambda rng: Generator.birth_death([1.0], [1.0, 2.0]), 'same shape'),
])
def test_wrong_arguments_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(np.random.default_rng(0))
