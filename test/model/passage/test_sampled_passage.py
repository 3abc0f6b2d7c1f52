"""What samples see of first passage, against limits, plain iteration and simulation."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model.passage import sampled
from ou_monitor.model.passage.law import mean_first_passage, passage_probability
from ou_monitor.model.passage.sampled import sampled_passage_probability
import pytest
from scipy.special import ndtr


@pytest.mark.parametrize('noise', [0.0, 0.4])
def test_one_sample(noise):
    """The normal law after one step, seen with its noise."""
    for start, barrier, step in ((0.0, 3.0, 0.01), (2.0, 1.0, 0.3), (-1.0, 4.0, 2.0)):
        sd = math.hypot(math.sqrt(-math.expm1(-2.0 * step)), noise)
        expected = ndtr((start * math.exp(-step) - barrier) / sd)
        assert sampled_passage_probability(start, barrier, step, 1, noise) == pytest.approx(
            expected, rel=1e-10)


@pytest.mark.parametrize('barrier', [-1.0, 2.0, 6.0])
@pytest.mark.parametrize('noise', [0.0, 0.05, 1.5])
@pytest.mark.parametrize('count', [1, 7, 1000, 10_000_000])
def test_samples_far_apart_are_independent(barrier, noise, count):
    """1 - (1 - tail)^n."""
    tail = ndtr(-barrier / math.hypot(1.0, noise))
    expected = -math.expm1(count * math.log1p(-tail))
    for step in (40.0, 1000.0):
        assert sampled_passage_probability(0.5, barrier, step, count, noise) == pytest.approx(
            expected, rel=1e-6)


def test_published_mean_time():
    """A step of 0.063 and b = 3: 153 (simulated) and 151 (moved barrier), continuous 86."""
    p = [sampled_passage_probability(0.0, 3.0, 0.063, n) for n in (2000, 4000)]
    mean = 2000 * 0.063 / math.log((1.0 - p[0]) / (1.0 - p[1]))
    assert mean == pytest.approx(152.0, rel=0.02)
    assert mean_first_passage(0.0, 3.0) == pytest.approx(86.5, abs=0.5)


def iterated(start, barrier, step, count, noise, h):
    """Return the chance by stepping a density through all samples on an even grid."""
    top = barrier + (6.0 * noise if noise else 0.0)
    low = min(start, 0.0) - 6.5
    m = round((top - low) / h)
    h = (top - low) / m
    x = low + h * (np.arange(m) + 0.5)
    phi, q = math.exp(-step), math.sqrt(-math.expm1(-2.0 * step))
    law = np.exp(-0.5 * ((x - phi * start) / q) ** 2) * h / (q * math.sqrt(2.0 * math.pi))
    kernel = np.exp(-0.5 * ((x - phi * x[:, None]) / q) ** 2) * h / (q * math.sqrt(2.0 * math.pi))
    beyond = ndtr((phi * x - top) / q)
    seen = ndtr((x - barrier) / noise) if noise else np.zeros(m)
    total = float(ndtr((phi * start - top) / q))
    for k in range(count):
        total += float(law @ seen)
        law = law * (1.0 - seen)
        if k < count - 1:
            total += float(law @ beyond)
            law = law @ kernel
    return total


@pytest.mark.parametrize('start, barrier, step, count, noise, rel', [
    (0.0, 3.0, 0.063, 40, 0.0, 2e-4), (1.0, 2.0, 0.05, 100, 0.0, 2e-4),
    (-3.0, 5.0, 0.2, 60, 0.0, 2e-4), (-1.0, -0.5, 0.02, 30, 0.0, 2e-4),
    (0.0, 3.0, 0.05, 60, 0.03, 2e-4), (1.0, 2.5, 0.05, 60, 0.3, 2e-4),
    (0.0, 4.0, 0.3, 50, 1.0, 2e-4),
    # Steps so fine that the path is looked at as continuous, in the end.
    (0.5, 2.0, 0.002, 300, 0.0, 5e-3), (2.9, 3.0, 0.001, 100, 0.0, 5e-3),
    (1.0, 2.0, 0.001, 300, 0.3, 2e-2), (1.5, 2.0, 0.001, 200, 0.05, 2e-2)])
def test_against_plain_iteration(start, barrier, step, count, noise, rel):
    """Another grid, no doubling: the midpoint rule, made exact to h^2 by two grids."""
    h = 0.12 * math.sqrt(2.0 * step)
    rough = iterated(start, barrier, step, count, noise, 2.0 * h)
    fine = iterated(start, barrier, step, count, noise, h)
    expected = (4.0 * fine - rough) / 3.0
    assert sampled_passage_probability(start, barrier, step, count, noise) == pytest.approx(
        expected, rel=rel)


@pytest.mark.parametrize('start, barrier, step, count, noise', [
    (0.0, 1.5, 0.1, 30, 0.0), (0.0, 2.0, 0.02, 100, 0.5), (1.0, 2.0, 0.002, 200, 0.2),
    (-1.0, 0.8, 0.001, 500, 0.0)])
def test_simulated_samples(start, barrier, step, count, noise):
    """40 000 paths; four standard errors and 0.5 % of what fine steps are off by."""
    rng = np.random.default_rng(11)
    phi, q = math.exp(-step), math.sqrt(-math.expm1(-2.0 * step))
    x, seen = np.full(40_000, start), np.zeros(40_000, dtype=bool)
    for _ in range(count):
        x = phi * x + q * rng.standard_normal(x.size)
        seen |= x + noise * rng.standard_normal(x.size) > barrier
    p = sampled_passage_probability(start, barrier, step, count, noise)
    error = math.sqrt(p * (1.0 - p) / x.size)
    assert 0.05 < p < 0.95
    assert abs(seen.mean() - p) < 4.0 * error + 0.005 * p


@pytest.mark.parametrize('start, barrier', [(0.0, 1.0), (0.0, 4.0), (3.5, 4.0), (-2.0, -1.0)])
def test_many_samples_see_the_path(start, barrier):
    """The continuous law as the step goes to 0, from below, by 0.58 sqrt(2 step) b at most."""
    path = passage_probability(start, barrier, 1.0)
    before = 0.0
    for step in (0.1, 0.01, 1e-3, 1e-4, 1e-5):
        p = sampled_passage_probability(start, barrier, step, round(1.0 / step))
        assert before < p < path * 1.003
        before = p
    assert before == pytest.approx(path, rel=0.02)


def test_small_chances_are_kept():
    """A level of 8: 1e-15 in a sample, and in proportion to their number."""
    p = [sampled_passage_probability(0.0, 8.0, 1.0, n) for n in (1000, 2000, 10_000_000)]
    assert 1e-14 < p[0] < 1000.0 * ndtr(-8.0) * 1.001
    assert (p[1] - p[0]) / p[0] == pytest.approx(1.0, rel=5e-3)
    assert p[2] / p[0] == pytest.approx(1e4, rel=5e-3)


@settings(max_examples=60, deadline=None)
@given(st.floats(-3.0, 5.0), st.floats(-2.0, 6.0), st.floats(math.log(1e-5), math.log(1e3)),
       st.integers(1, 10_000_000), st.floats(0.0, 1.0))
def test_a_probability_that_grows_with_samples_and_start(start, barrier, log_step, count, noise):
    """To 5 %, where one method hands over to the other."""
    step = math.exp(log_step)
    p = sampled_passage_probability(start, barrier, step, count, noise)
    assert 0.0 <= p <= 1.0
    assert sampled_passage_probability(start, barrier, step, 2 * count, noise) >= 0.95 * p
    assert sampled_passage_probability(start + 0.5, barrier, step, count, noise) >= 0.95 * p
    assert sampled_passage_probability(start, barrier + 0.5, step, count, noise) <= p / 0.95


def test_ends():
    """No sample sees nothing; NaN where something is unknown; a barrier out of this world."""
    assert sampled_passage_probability(5.0, 1.0, 0.1, 0) == 0.0
    assert sampled_passage_probability(0.0, math.inf, 0.1, 5) == 0.0
    assert sampled_passage_probability(0.0, -math.inf, 0.1, 5) == 1.0
    assert sampled_passage_probability(0.0, 60.0, 0.1, 100) < 1e-100
    assert sampled_passage_probability(60.0, 1.0, 0.1, 100) == pytest.approx(1.0)
    for k in range(5):
        values = [0.0, 1.0, 0.1, 5, 0.1]
        values[k] = math.nan
        assert math.isnan(sampled_passage_probability(*values))


@pytest.mark.parametrize('step, count, noise, words', [
    (0.0, 5, 0.0, 'step must be positive'), (-1.0, 5, 0.0, 'step must be positive'),
    (0.1, -1, 0.0, 'count must be a whole number'), (0.1, 1.5, 0.0, 'count must be'),
    (0.1, math.inf, 0.0, 'count must be'), (0.1, 5, -0.1, 'noise must be zero or positive')])
def test_bad_input(step, count, noise, words):
    """Refused with what was wrong."""
    with pytest.raises(ValueError, match=words):
        sampled_passage_probability(0.0, 1.0, step, count, noise)


def test_little_noise_on_fine_steps_costs_no_thousands_of_nodes(monkeypatch):
    """It moves the barrier by less than 5e-4 of a step from none, and takes few nodes."""
    orders = []
    legendre = sampled._legendre
    monkeypatch.setattr(sampled, '_legendre', lambda n: orders.append(n) or legendre(n))
    sampled._straight.cache_clear()
    found = [sampled.sampled_passage_probability(0.3, 0.5, 1e-5, 1000, part * math.sqrt(2e-5))
             for part in (0.0, 2e-4, 1e-3, 0.0199, 0.0201)]
    assert max(orders) < 300
    assert found == sorted(found) and found[-1] - found[0] < 5e-4 * math.sqrt(2e-5) * 10.0
