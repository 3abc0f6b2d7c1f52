"""Where terms start a fit: closed forms of their candidates from what is left over."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.lines import order_power
from ou_monitor.model.terms.regime_switching import relaxing
from ou_monitor.model.terms.slow import FlickerNoise, SecondRelaxation
import pytest
from scipy.linalg import dft
from scipy.stats import median_abs_deviation
from term_examples import still, term


def view_of(n, rate, decay=63.0):
    """Return even samples of residuals whose standard deviation is 0.2 V."""
    flat = np.ones(n)
    residual = 0.2 * np.where(np.arange(n) % 2, 1.0, -1.0)
    return View(z=flat, variance=flat, phi=np.full(n, math.exp(-decay / rate)), state=flat,
                residual=residual, at=np.arange(n) / rate, step=flat / rate, throttle=None,
                train=slice(0, n))


@pytest.mark.parametrize('n, rate', [(152, 100.0), (152, 8000.0), (1000, 50.0)])
def test_flicker_noise_begins_with_a_third_of_the_variance(n, rate):
    """
    From one over the duration to a corner at a fifth of the sampling rate.

    The integral of amplitude^2 / f over that range is 0.3 of the variance; the corner is 8
    times the upper end.
    """
    (found,) = FlickerNoise.candidates(view_of(n, rate))
    assert found.low == pytest.approx(rate / (n - 1), rel=1e-9)
    assert found.high == pytest.approx(rate / 40.0, rel=1e-9)
    assert found.corner == pytest.approx(2.0 * math.pi * rate / 5.0, rel=1e-9)
    assert found.amplitude ** 2 * math.log((n - 1) / 5.0) == pytest.approx(0.3 * 0.04, rel=1e-9)


def test_flicker_noise_takes_thirty_times_of_frequency():
    """0.2 rate / (rate / (n - 1)) is 29.8 at 150 samples, and 30.2 at 152."""
    assert not FlickerNoise.candidates(view_of(150, 100.0))
    assert len(FlickerNoise.candidates(view_of(152, 100.0))) == 1
    narrow, wide = (FlickerNoise(0.1, 1.0, 30.0 / 8.0 * f) for f in (0.999, 1.001))
    assert not narrow.holds(view_of(152, 100.0)) and wide.holds(view_of(152, 100.0))


@pytest.mark.parametrize('seconds, slower', [(100.0, 3), (10.0, 2), (1.0, 2), (0.15, 0)])
def test_second_relaxations_begin_on_either_side_of_the_first(seconds, slower):
    """
    At 60 1/s: 1, 4 and 15 1/s of half the deviation, 360 1/s of 0.3 of it.

    One slower than three over the duration is not looked for.
    """
    rate = 1000.0
    found = SecondRelaxation.candidates(view_of(2 * round(seconds * rate / 2) + 1, rate, 60.0))
    expected = [(a, 0.1) for a in (1.0, 4.0, 15.0) if a * seconds > 3.0] + [(360.0, 0.06)]
    assert [one.alpha for one in found] == pytest.approx([a for a, _ in expected], rel=1e-6)
    assert [one.sigma / math.sqrt(2.0 * one.alpha) for one in found] == pytest.approx(
        [std for _, std in expected], rel=1e-3)


@pytest.mark.parametrize('rate, lengths', [(200.0, (64, 32)), (1500.0, (512, 64))])
def test_power_along_throttle_is_that_of_every_line(rate, lengths):
    """
    Power of white noise along each line frequency = idle + slope throttle, by plain transforms.

    A line of n segments has a mean of n exponentials for its power; the chance of a mean m
    is bounded by exp(-n (m - 1 - ln m)) (Cramer).  Two in a hundred lines count as
    independent, two bins a sample.
    """
    rng = np.random.default_rng(4)
    n = 40 * lengths[0]
    z, u = rng.standard_normal(n), np.repeat(rng.random(n // 16), 16)
    top, trials, largest = 0.0, 0.0, 0.0
    for length in lengths:
        count, width = n // length, rate / (2.0 * length)
        pieces = z.reshape(count, length) * np.hanning(length)
        power = np.abs(pieces @ dft(2 * length)[:length]) ** 2
        power /= power.mean(axis=0)
        load = u.reshape(count, length).mean(axis=1)
        slopes = np.arange(-rate, rate, 2.0 * width / np.ptp(load))
        for slope in slopes:
            shift = np.rint(slope * load / width).astype(int)
            places = (np.arange(length) + shift[:, None]) % (2 * length)
            mean = float(np.take_along_axis(power, places, 1).mean(axis=0).max())
            top = max(top, count * (mean - 1.0 - math.log(mean)))
            largest = max(largest, mean)
        trials += 0.02 * 2.0 * length * slopes.size
    # So that a mean below 2 counts as well.
    assert 1.0 < largest
    found = order_power(z, u, rate)
    assert found == pytest.approx((top, trials), rel=1e-4)


def test_the_phase_of_a_line_with_a_width_is_a_random_walk():
    """
    Idle 0 and slope 0 leave sin of the walk: its steps have the variance 2 pi width step.

    The sum of 20 000 squares has a relative standard error of 1 %; the walk stays below
    pi/2, six of its standard deviations.
    """
    n, width, rate = 20_000, 0.01, 20_000.0
    line = term('throttle_tone', amplitude=0.1, idle=0.0, slope=0.0, phase=0.0, linewidth=width)
    found = still(line).simulate(np.arange(n) / rate, np.random.default_rng(6), 0.25)
    steps = np.diff(np.arcsin(found / 0.1))
    assert np.mean(steps ** 2) * rate / (2.0 * math.pi * width) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize('width, expected', [(0.999, True), (1.001, False)])
def test_a_line_follows_throttle_that_moves_it_by_more_than_its_width(width, expected):
    """Throttle of 0.1 about 0.5 moves a line of slope -300 Hz by 30 Hz."""
    view = view_of(1000, 500.0)
    line = term('throttle_tone', amplitude=0.1, idle=20.0, slope=-300.0, phase=0.0,
                linewidth=30.0 * width)
    assert line.holds(view) is False
    throttle = 0.5 + 0.1 * np.where(np.arange(1000) % 2, 1.0, -1.0)
    assert line.holds(replace(view, throttle=throttle)) is expected


def test_what_a_faster_rail_leaves_over():
    """
    Residuals less phi^2 times the state before, over what noise of that phi makes of a step.

    Its spread is that of the middle half of the errors, at a usual step.
    """
    rng = np.random.default_rng(9)
    phi = np.tile([0.9, 0.8, 0.9], 400)
    state, z, variance = rng.standard_normal(1200), rng.standard_normal(1200), np.tile(
        [0.3, 0.4, 0.3], 400)
    view = replace(view_of(1200, 100.0), phi=phi, state=state, z=z, variance=variance)
    assert relaxing(view, 1.0) is view
    found = relaxing(view, 2.0)
    error = z * np.sqrt(variance) + phi * state - phi ** 2 * state
    middle = np.median(error)
    # The usual step is that of phi 0.9; the middle half of a normal reaches to 0.6745.
    std = median_abs_deviation(error) / 0.6745
    expected = std ** 2 * (1.0 - phi ** 4) / (1.0 - 0.9 ** 4)
    assert found.phi == pytest.approx(phi ** 2, rel=1e-12)
    assert found.variance == pytest.approx(expected, rel=1e-4)
    assert found.z == pytest.approx((error - middle) / np.sqrt(expected), rel=1e-4, abs=1e-9)
