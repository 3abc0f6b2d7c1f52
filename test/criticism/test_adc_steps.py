"""Steps and clipping of an ADC, each rule at its edge."""

import math

import numpy as np
from ou_monitor.criticism.adc import find_rails, find_step, usual_change, without_repeats
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


@pytest.mark.parametrize('count, visits, found', [(8, 3, True), (7, 3, False), (40, 2, False),
                                                  (40, 3, True)])
def test_a_rail_holds_eight_samples_in_three_visits(count, visits, found):
    x = np.random.default_rng(4).uniform(0.0, 1.0, 3000)
    parts = np.array_split(np.arange(count), visits)
    for k, part in enumerate(parts):
        x[500 + 700 * k:500 + 700 * k + part.size] = 1.001
    assert (find_rails(x, 0.0, 0.3)[1] == 1.001) == found


def test_a_rail_is_four_errors_above_its_neighbours():
    """With codes: n at the end, m at each of the next; the gain in likelihood exceeds 8 nats."""
    rng = np.random.default_rng(5)
    for count, beside, found in ((175, 100, True), (155, 100, False), (18, 1, True),
                                 (15, 1, False)):
        x = np.repeat([0.0, -1.0, -2.0, -3.0, -4.0], [count, beside, beside, beside, 400])
        x = rng.permutation(x)
        assert (find_rails(x, 1.0, 2.0)[1] == 0.0) == found
    # The fullest of three codes beside it counts.
    x = rng.permutation(np.repeat([0.0, -1.0, -2.0, -3.0, -4.0], [185, 10, 10, 185, 400]))
    assert find_rails(x, 1.0, 2.0)[1] == math.inf


@pytest.mark.parametrize('offset', (50.0, -50.0))
@pytest.mark.parametrize('side', (1.0, -1.0))
def test_a_limit_is_found_in_single_precision(offset, side):
    """Continuous readings that float32 rounds, clipped on one side only."""
    rng = np.random.default_rng(6)
    x = side * np.minimum(rng.standard_normal(20_000), 1.0)
    v = (offset + 0.1 * x).astype(np.float32).astype(np.float64)
    low, high = find_rails(v, 0.0, 0.1)
    assert (low == v.min()) == (side < 0.0) and (high == v.max()) == (side > 0.0)
    # The same where later arithmetic has spread the limit over a part of a rounding.
    v = (offset + 0.1 * x) * (1.0 + rng.uniform(-3e-8, 3e-8, x.size))
    low, high = find_rails(v, 0.0, 0.1)
    assert (low == v.min()) == (side < 0.0) and (high == v.max()) == (side > 0.0)


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


N, RATE, CODE = 12_000, 200.0, 0.5
T = np.arange(N) / RATE


def wander(seed, sd=1.0, phi=0.9):
    """Return an AR(1) of some deviation, in standard deviations of its own innovations at 1."""
    steps = np.random.default_rng(seed).standard_normal(N) * np.sqrt(1.0 - phi * phi)
    return sd * lfilter([1.0], [1.0, -phi], steps)


def coded(x, code=CODE):
    return code * np.round(x / code)


def left(v):
    return without_repeats(T, v, None)[1].size


def triangle(period, rise=0.15):
    """Return a wave of a fast and a slow flank, with values alike a period apart."""
    p = np.mod(np.arange(N) / period, 1.0)
    return np.where(p < rise, 1.0 - 2.0 * p / rise, 2.0 * (p - rise) / (1.0 - rise) - 1.0)


SIGNALS = {
    'a triangle': lambda s: wander(s) + 4.0 * triangle(14.9),
    'a square': lambda s: wander(s) + 3.0 * np.sign(np.sin(2.0 * np.pi * T * 13.4 + s)),
    'a sine': lambda s: wander(s) + 3.0 * np.sin(2.0 * np.pi * T * 13.4 + s),
    'values held under noise': lambda s: np.repeat(wander(s)[::5], 5)
    + 0.4 * np.random.default_rng(s + 100).standard_normal(N),
    'calm phases': lambda s: wander(s) * np.exp(wander(s + 100, phi=0.999)),
}


@pytest.mark.parametrize('signal', SIGNALS)
def test_codes_of_any_signal_hold_nothing(signal):
    """Whatever line, slope or change of intensity makes values alike."""
    for seed in range(6):
        v = coded(SIGNALS[signal](seed))
        assert np.mean(v[1:] == v[:-1]) > 0.05 and left(v) == N


@pytest.mark.parametrize('line', [0.0, 2.0])
def test_values_held_are_found_beside_a_line(line):
    """Three of ten, at random: all ties go, as always."""
    keep = np.random.default_rng(5).random(N) > 0.3
    keep[0] = True
    x = wander(3) + line * np.sin(2.0 * np.pi * T * 13.4)
    v = coded(x, 0.2)[np.maximum.accumulate(np.where(keep, np.arange(N), 0))]
    assert left(v) == 1 + np.count_nonzero(np.diff(v))


def test_a_rail_at_rest_is_not_held():
    """Less than a code of noise for a second, 20 times: it comes to rest by steps of a code."""
    rest = np.mod(T, 3.0) < 1.0
    still = lfilter([0.05], [1.0, -0.95], np.where(rest, 0.0, wander(7)))
    assert left(coded(still + 0.02 * wander(8), 0.05)) == N
