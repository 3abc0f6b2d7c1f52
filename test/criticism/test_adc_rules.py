"""Steps and clipping of an ADC, each rule at its edge."""

import math

import numpy as np
from ou_monitor.criticism.adc import find_rails, find_step, usual_change
import pytest
from scipy.signal import lfilter


def noise(n=20_000, seed=1, keep=0.9):
    """Return an AR(1) of unit variance."""
    rng = np.random.default_rng(seed)
    return lfilter([math.sqrt(1.0 - keep * keep)], [1.0, -keep], rng.standard_normal(n))


@pytest.mark.parametrize('step, offset', [(0.3, 0.0), (0.3, 50.0), (0.003, 5.0), (2.0, 0.1)])
def test_the_step_is_that_of_the_lattice(step, offset):
    """Whatever zero is; in doubles to a millionth, though codes are missing."""
    v = offset + step * np.round(noise() / step)
    assert find_step(v) == pytest.approx(step, rel=1e-6)
    codes = np.unique(v)
    some = v[~np.isin(v, codes[1::3])]
    if np.unique(some).size > 4:
        assert find_step(some) == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize('off, found', [(150, True), (300, False)])
def test_a_hundredth_of_the_samples_may_lie_beside_the_lattice(off, found):
    """By three tenths of a step: more than the tenth that is allowed."""
    v = 0.25 * np.round(noise() / 0.25)
    v[np.random.default_rng(2).choice(v.size, off, replace=False)] += 0.0732
    # The smallest gap makes it a lattice of a third of the step.
    assert find_step(v) == pytest.approx(0.25 / 3.0 if found else 0.0, rel=1e-3)


def test_a_step_is_eight_roundings_of_single_precision():
    """Of values near 100 V: 0.25 ppm, so 0.2 mV; a finer lattice may be that of the numbers."""
    for step, found in ((1.7123456e-4, False), (2.5123456e-4, True)):
        v = 100.0 + step * np.round(noise(4000) * 20.0)
        assert (find_step(v) > 0.0) == found


def test_values_of_which_most_come_once_have_no_step():
    v = np.arange(1000.0)
    # Without the lowest and the highest value, which may be rails.
    assert find_step(np.append(np.repeat(v, 2), [1000.0])) == pytest.approx(1.0)
    assert find_step(np.append(np.repeat(v, 2), [1000.0, 1001.0, 1002.0])) == 0.0
    assert find_step(np.full(50, 5.0)) == 0.0


@pytest.mark.parametrize('step, decimals, found', [
    (0.00805, 3, True), (0.0161, 3, True), (0.00123, 3, False), (0.0322, 2, True)])
def test_a_step_that_print_has_rounded_is_found_from_two_decimals_on(step, decimals, found):
    """3.3 V in 12 bits behind a divider is no whole number of millivolts."""
    v = np.round(5.0 + step * np.round(12.0 * noise()), decimals)
    step_found = find_step(v)
    if found:
        assert step_found == pytest.approx(step, rel=2e-3)
    else:
        assert step_found == pytest.approx(0.001, rel=1e-6)


def clipped(side, share, seed=3, **more):
    x = noise(seed=seed, **more)
    return np.minimum(x, np.quantile(x, 1.0 - share)) if side > 0 else np.maximum(
        x, np.quantile(x, share))


@pytest.mark.parametrize('side', (1.0, -1.0))
@pytest.mark.parametrize('step', (0.0, 0.1))
def test_rails_are_where_samples_pile_up(side, step):
    v = clipped(side, 0.02)
    v = step * np.round(v / step) if step else v
    low, high = find_rails(v, step, 1.0)
    assert (low, high) == ((-math.inf, v.max()) if side > 0 else (v.min(), math.inf))
    # Coarser than two deviations of the noise a code says nothing.
    assert find_rails(v, 2.01, 1.0) == (-math.inf, math.inf)


@pytest.mark.parametrize('count, visits, found', [(27, 3, True), (25, 3, False), (40, 2, False),
                                                  (40, 3, True)])
def test_a_rail_holds_more_than_25_samples_in_three_visits(count, visits, found):
    x = np.random.default_rng(4).uniform(0.0, 1.0, 3000)
    parts = np.array_split(np.arange(count), visits)
    for k, part in enumerate(parts):
        x[500 + 700 * k:500 + 700 * k + part.size] = 1.001
    assert (find_rails(x, 0.0, 0.3)[1] == 1.001) == found


def test_a_rail_is_five_errors_above_its_neighbours():
    """With codes: n at the end, m at each of the next: n - m > 5 sqrt(n + m)."""
    rng = np.random.default_rng(5)
    for count, found in ((185, True), (165, False)):
        x = np.repeat([0.0, -1.0, -2.0, -3.0, -4.0], [count, 100, 100, 100, 400])
        x = rng.permutation(x)
        assert (find_rails(x, 1.0, 2.0)[1] == 0.0) == found
    # The fullest of three codes beside it counts.
    x = rng.permutation(np.repeat([0.0, -1.0, -2.0, -3.0, -4.0], [185, 10, 10, 185, 400]))
    assert find_rails(x, 1.0, 2.0)[1] == math.inf


@pytest.mark.parametrize('side', (1.0, -1.0))
@pytest.mark.parametrize('later', [0.0, 0.015, 0.03])
def test_the_limit_of_an_earlier_stage_is_the_code_where_readings_pile_up(side, later):
    rng = np.random.default_rng(7)
    v = np.minimum(noise(), 1.5) + later * rng.standard_normal(noise().size)
    v = side * 0.1 * np.round(v / 0.1)
    assert find_rails(v, 0.1, 1.0) == pytest.approx(
        (-math.inf, 1.5) if side > 0 else (-1.5, math.inf))


def test_a_bell_of_few_codes_is_no_rail():
    rng = np.random.default_rng(8)
    rest = np.rint(0.7 * rng.standard_normal(4000))
    v = np.concatenate((rest, -3.0 - rng.integers(0, 60, 6000)))
    v = np.concatenate([part for pair in zip(np.array_split(rest, 9), np.array_split(
        v[4000:], 9), strict=True) for part in pair])
    assert find_rails(v, 1.0, 2.0) == (-math.inf, math.inf)


def test_a_code_in_which_the_rail_idles_is_no_rail():
    """A third of the time idle, in the top code; clipped there, other throttles say so."""
    rng, n = np.random.default_rng(6), 24000
    throttle = np.repeat(np.where(np.arange(240) % 3 == 0, 0.0, rng.uniform(0.4, 1.0, 240)), 100)
    noise = np.where(throttle > 0.0, 1.0, 0.05) * rng.standard_normal(n)
    v = np.rint(2.0 - 8.0 * throttle + noise)
    v = np.minimum(v, 2.0)
    assert find_rails(v, 1.0, 1.0) == (-math.inf, 2.0)
    assert find_rails(v, 1.0, 1.0, throttle) == (-math.inf, math.inf)
    assert find_rails(np.minimum(v, -2.0), 1.0, 1.0, throttle) == (-math.inf, -2.0)


def test_a_value_far_from_all_others_is_no_rail():
    """Beyond 3.5 steps, and a fifth of the deviation of the others."""
    rng = np.random.default_rng(6)
    others = rng.normal(0.0, 1.0, 3000)
    others -= others.max()
    for gap, found in ((0.15, True), (0.25, False)):
        v = np.concatenate((others, np.full(60, gap)))
        assert (find_rails(rng.permutation(v), 0.0, 1.0)[1] == gap) == found


@pytest.mark.parametrize('seed', range(3))
def test_changes_of_a_fast_line_that_crowd_are_no_codes(seed):
    """The changes of a sine crowd at its steepest; those of codes with an offset are equal."""
    rng = np.random.default_rng(seed)
    t = np.arange(25000) / 504.0
    v = 21.25 + 0.5 * np.sin(2.0 * np.pi * 24.3 * t) + 0.02 * rng.standard_normal(t.size)
    assert usual_change(v) == 0.0
    codes = 0.01 * np.rint(v / 0.01) + 0.0037 * (np.arange(t.size) // 5000)
    steps = usual_change(codes) / 0.01
    assert steps > 0.5 and steps == pytest.approx(round(steps))
