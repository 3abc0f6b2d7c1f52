"""Findings about raw samples: lattices, repeats, piles at an extreme."""

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.online.estimator.quality import examine, lattice, Quality
from ou_monitor.timeline.line import refresh_period
import pytest
from simulated_windows import DT, paths


def path(seed=1, n=1024, dt=DT):
    return paths(np.random.default_rng(seed), 1, n, dt)[0]


@pytest.mark.parametrize('kind', [np.float64, np.float32])
@pytest.mark.parametrize('step', [1e-3, 5e-3, 12.5e-3, 0.03, 0.05, 0.1])
def test_step_of_the_adc(step, kind):
    """
    From a twentieth to five times the increment (20 mV), in either precision.

    Float32 rounds a 5 V value to 0.2 uV, 2e-4 of the finest step here.
    """
    y = (step * np.round(path() / step)).astype(kind).astype(np.float64)
    assert examine(y).step == pytest.approx(step, rel=2e-3)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1000), st.floats(1e-3, 0.08))
def test_step_scales(seed, step):
    """Any step, any path."""
    y = step * np.round(path(seed) / step)
    assert examine(y).step == pytest.approx(step, rel=1e-6)


@pytest.mark.parametrize('seed', range(5))
def test_no_lattice_no_finding(seed):
    """Neither in doubles nor in float32, whose own lattice is finer than a thousandth."""
    for kind in (np.float64, np.float32):
        quality = examine(path(seed).astype(kind).astype(np.float64))
        assert (quality.step, quality.held, quality.saturated) == (0.0, 1, False)


def test_rms_increment():
    """Of an OU: sigma sqrt(dt) (1 - alpha dt / 4) = 19.7 mV; 1023 increments give 2 %."""
    assert examine(path()).rms_increment == pytest.approx(0.0197, rel=0.07)


def test_samples_a_reading_are_passed_on():
    assert examine(path(1, 20), 8.0).held == examine(path(1), 8.0).held == 8.0


@pytest.mark.parametrize('side', [-1, 1])
def test_saturation(side):
    """Clipped at one standard deviation, or at 1.7: 16 or 4 % of samples at the end."""
    for level in (0.056, 0.095):
        assert examine(5.0 + side * np.minimum(side * (path(4) - 5.0), level)).saturated
    assert not examine(5.0 + side * np.minimum(side * (path(4) - 5.0), 0.4)).saturated


def test_saturation_needs_a_hundredth_of_the_samples():
    """Of 2048 samples 20 is one in a hundred; and three times as many as the next value."""
    y = path(5, 2048)
    order = np.argsort(y)
    for many, expected in ((15, False), (25, True)):
        z = y.copy()
        z[order[-many:]] = y[order[-many]]
        assert examine(z).saturated == expected


@pytest.mark.parametrize('top, beside, expected', [(50, 20, False), (50, 14, True)])
def test_saturation_is_three_times_the_next_value(top, beside, expected):
    """The outermost codes of an ADC are rarer than those beside them, never so common."""
    y = np.sort(path(5))
    y[-top:] = 6.0
    y[-top - beside:-top] = 5.9
    assert examine(np.random.default_rng(1).permutation(y)).saturated == expected


@pytest.mark.parametrize('multiples, told', [((1, 2), False), ((1, 2, 5), True)])
def test_lattice_needs_three_different_steps(multiples, told):
    """Two sizes of step may be chance, three multiples of one are not."""
    assert (lattice(0.01 * np.array(multiples)) > 0.0) == told


def test_the_extreme_code_of_a_coarse_adc_is_not_saturation():
    for seed in range(20):
        assert not examine(0.03 * np.round(path(seed) / 0.03)).saturated


@pytest.mark.parametrize('y', [
    np.empty(0), np.ones(5), path(1, 63), np.full(1024, 5.0), np.r_[np.zeros(500), np.ones(500)]])
def test_too_little_to_tell(y):
    """Below 64 samples, or without changes, nothing is said."""
    assert repr(examine(y)) == repr(Quality())


def test_from_sixty_four_samples_on():
    y = 0.0125 * np.round(path(6) / 0.0125)
    assert examine(y[:64]).step == pytest.approx(0.0125) and examine(y[:63]).step == 0.0


@pytest.mark.parametrize('gaps, kept', [(0, True), (7, True), (8, False), (20, False)])
def test_eight_gaps_are_needed_to_give_up_a_known_period(gaps, kept):
    """Every third sample changes where every 40th was known to."""
    y = np.repeat(np.random.default_rng(1).permutation(np.arange(gaps + 2.0)), 3)
    assert (refresh_period(y, 40.0) == 40.0) is kept
