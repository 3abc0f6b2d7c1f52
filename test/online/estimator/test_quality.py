"""Findings about raw samples: lattices, repeats, clipping at an extreme, ramps."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.online.estimator.quality import examine, lattice, Quality
from ou_monitor.records import Flag, Status
from pushed import pushed
import pytest
from simulated_windows import DT, estimate, LEVEL, paths, stamps


def path(seed=1, n=1024, dt=DT):
    return paths(np.random.default_rng(seed), 1, n, dt)[0]


@pytest.mark.parametrize('kind', [np.float64, np.float32])
@pytest.mark.parametrize('step', [1e-3, 5e-3, 12.5e-3, 0.03, 0.05, 0.1])
def test_step_of_the_adc(step, kind):
    """From a twentieth to five times the increment (20 mV), in either precision."""
    # Float32 rounds a 5 V value to 0.2 uV, 2e-4 of the finest step here.
    y = (step * np.round(path() / step)).astype(kind).astype(np.float64)
    assert examine(y).step == pytest.approx(step, rel=2e-3)


@pytest.mark.parametrize('seed', range(5))
def test_no_lattice_no_finding(seed):
    """Neither in doubles nor in float32, whose own lattice is finer than a thousandth."""
    for kind in (np.float64, np.float32):
        quality = examine(path(seed).astype(kind).astype(np.float64))
        assert (quality.step, quality.held, quality.saturated) == (0.0, 1, False)


@pytest.mark.parametrize('side', [-1, 1])
def test_clipped_samples_are_counted_at_their_end(side):
    """Clipped at one standard deviation, or at 1.7: 16 or 4 % of samples at the end."""
    for level in (0.056, 0.095):
        assert examine(5.0 + side * np.minimum(side * (path(4) - 5.0), level)).saturated
    assert not examine(5.0 + side * np.minimum(side * (path(4) - 5.0), 0.4)).saturated


@pytest.mark.parametrize('multiples, told', [((1, 2), False), ((1, 2, 5), True)])
def test_lattice_needs_three_different_steps(multiples, told):
    assert (lattice(0.01 * np.array(multiples)) > 0.0) == told


def test_the_extreme_code_of_a_coarse_adc_is_not_saturation():
    for seed in range(20):
        assert not examine(0.03 * np.round(path(seed) / 0.03)).saturated


@pytest.mark.parametrize('y', [
    np.empty(0), np.ones(5), path(1, 63), np.full(1024, 5.0), np.r_[np.zeros(500), np.ones(500)]])
def test_too_little_to_tell(y):
    """Below 64 samples, or without changes, nothing is said."""
    assert repr(examine(y)) == repr(Quality())


N = 2000
T = stamps(N)


@pytest.mark.parametrize('n', [100, 200, 500, 1000, 2000, 6000])
@pytest.mark.parametrize('kind', [np.float64, np.float32])
@pytest.mark.parametrize('noise', [0.0, 1e-5])
def test_a_ramp_is_a_trend(n, kind, noise):
    """From the first hundred samples on; noiseless increments are all equal, not smooth."""
    y = LEVEL - 0.1 * stamps(n) + noise * np.random.default_rng(1).standard_normal(n)
    e = estimate(stamps(n), y.astype(kind).astype(np.float64))
    assert Flag.TREND in e.flags and Flag.LOWPASS_UPSTREAM not in e.flags
    assert not e.usable and math.isnan(e.alpha) and math.isnan(e.var_inf)


def test_a_random_walk_does_not_drift():
    """Its net change is chance: more than four standard deviations in 1 of 16 000."""
    # Two of 100 would be a chance of 2e-5; a limit of two deviations would make it five, and none
    # or one with a chance of 4 %. Where a trend and a restoring force are found together, that is
    # the fit's doing, and looked at in test_estimator_slides.
    rng = np.random.default_rng(2)
    for n in (60, 200, 2000):
        walks = LEVEL + np.cumsum(0.01 * rng.standard_normal((100, n)), axis=1)
        found = [estimate(stamps(n), y) for y in walks]
        told = [e for e in found if e.status is Status.UNBOUND and Flag.TREND in e.flags]
        assert len(told) <= 1
        # The same with a drift of six standard deviations of the walk.
        drift = 6.0 * 0.01 / math.sqrt(n) * np.arange(n)
        found = [estimate(stamps(n), y + drift) for y in walks]
        # 6 - 4 = 2 standard deviations: 97 %, less what is judged by other means.
        assert sum(Flag.TREND in e.flags for e in found) >= 80


@pytest.mark.parametrize('load', [lambda t: 0.2 + 0.05 * t, lambda t: 0.2 + 0.4 * (t > 1.0)])
def test_what_throttle_explains_to_the_last_digit(load):
    """Nothing is left that relaxes: no alpha of rounding errors, and no trend either."""
    e = estimate(T, LEVEL - 0.6 * load(T), load(T))
    assert not e.usable and math.isnan(e.alpha) and math.isnan(e.var_inf)
    assert e.status in (Status.NO_RELAXATION, Status.UNBOUND)
    assert Flag.TREND not in e.flags


def test_tiny_noise_on_a_large_voltage_is_measured():
    """An OU of 1 uV on 5 V is one: a million times less than usual is not rounding."""
    y = LEVEL + 1e-6 * (paths(np.random.default_rng(4), 1, N)[0] - LEVEL)
    e = estimate(T, y)
    assert e.status is Status.OK and e.sigma == pytest.approx(0.632e-6, rel=0.1)


def test_what_is_dropped_is_said_though_the_numbers_stand():
    estimator = pushed(SlidingEstimator(2.1), T, paths(np.random.default_rng(5), 1, N)[0])
    before = estimator.estimate()
    estimator.push(1.0, 5.0)
    after = estimator.estimate()
    assert before.flags == () and after.flags == (Flag.IRREGULAR,)
    assert (after.counters.late, after.alpha) == (1, before.alpha)
    # Samples that wait for the rate are said to wait, with what was dropped.
    waits = pushed(SlidingEstimator(2.0), T[:4], [5.0, math.nan, 5.1, 5.2])
    assert waits.estimate().status is Status.TOO_FEW_SAMPLES
    assert waits.estimate().flags == (Flag.IRREGULAR,)
