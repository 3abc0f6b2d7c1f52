"""Findings about raw samples: lattices, repeats, piles at an extreme."""

import numpy as np
from ou_monitor.online.estimator.quality import examine, lattice, Quality
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


@pytest.mark.parametrize('seed', range(5))
def test_no_lattice_no_finding(seed):
    """Neither in doubles nor in float32, whose own lattice is finer than a thousandth."""
    for kind in (np.float64, np.float32):
        quality = examine(path(seed).astype(kind).astype(np.float64))
        assert (quality.step, quality.held, quality.saturated) == (0.0, 1, False)


def test_rms_increment():
    """Of an OU: sigma sqrt(dt) (1 - alpha dt / 4) = 19.7 mV; 1023 increments give 2 %."""
    assert examine(path()).rms_increment == pytest.approx(0.0197, rel=0.07)


@pytest.mark.parametrize('side', [-1, 1])
def test_saturation(side):
    """Clipped at one standard deviation, or at 1.7: 16 or 4 % of samples at the end."""
    for level in (0.056, 0.095):
        assert examine(5.0 + side * np.minimum(side * (path(4) - 5.0), level)).saturated
    assert not examine(5.0 + side * np.minimum(side * (path(4) - 5.0), 0.4)).saturated


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
