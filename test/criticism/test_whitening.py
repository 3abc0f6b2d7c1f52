"""A second relaxation or an AC coupling: found in the innovations if it is there, only then."""

import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import ProcessType
from ou_monitor.analysis.quality import noise_items
from ou_monitor.criticism.innovations import FAMILY_WISE, other_pole
from ou_monitor.model.ou import simulate
from ou_monitor.records import Recording
import pytest
from scipy.signal import lfilter
from simulated_recordings import as_one_level

RATE, ALPHA = 1000.0, 63.0


def ou(n, alpha, spread, rng):
    """Return an OU of that standard deviation, V."""
    phi = np.exp(-alpha / RATE)
    steps = spread * np.sqrt(1.0 - phi ** 2) * rng.standard_normal(n)
    steps[0] /= np.sqrt(1.0 - phi ** 2)
    return lfilter([1.0], [1.0, -phi], steps)


def recording(seed, seconds=10.0, second=None):
    """Return an OU of 20 mV, 3 mV of white noise, and a second OU of (alpha, V)."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    voltage = 5.0 + ou(n, ALPHA, 0.02, rng) + rng.normal(0.0, 0.003, n)
    if second is not None:
        voltage += ou(n, *second, rng)
    return Recording(np.arange(n) / RATE, voltage, np.full(n, np.nan), 'made')


def test_one_relaxation_is_left_alone():
    """200 parts of white innovations: at most 7 below 1 % (binomial: 4e-3 beyond)."""
    found = [other_pole([np.random.default_rng(seed).standard_normal(3000)], RATE, ALPHA, 4e-4,
                        9e-6) for seed in range(200)]
    assert sum(pole.second_p < 0.01 for pole in found) <= 7
    assert sum(pole.coupling_p < 0.01 for pole in found) <= 7


@pytest.mark.parametrize('sizes', [[355], [600] * 10])
def test_few_slow_ordinates_are_no_high_pass(sizes):
    """400 levels of short parts of white innovations: at most 11 below 1 % (chance 1e-3)."""
    rng = np.random.default_rng(1)
    found = [other_pole([rng.standard_normal(n) for n in sizes], 50.0, 10.0, 2e-4, 1.6e-5)
             for _ in range(400)]
    assert sum(pole.coupling_p < 0.01 for pole in found) <= 11


def detected(level):
    """Whether one of the tests of a level sees more than one relaxation."""
    return (level.wanders or level.shape['mean_drift'].rejects
            or level.shape['one_relaxation'].rejects)


@pytest.mark.parametrize('second', [(1.0, 0.02), (400.0, 0.02)])
def test_a_second_one_is_found(second):
    """As strong as the first, sixty times slower or six times faster: 8 of 10 at least."""
    assert sum(detected(as_one_level(recording(seed, second=second))) for seed in range(10)) >= 8


def test_a_second_one_is_found_beside_the_wandering_level_and_said():
    """As strong as the first and ten times slower: 8 of 10 at least."""
    found = 0
    for seed in range(10):
        analysis = analyze(recording(seed, second=(6.0, 0.02)))
        (level,) = analysis.levels
        named = [item for item in analysis.quality if item.name == 'SECOND_RELAXATION']
        assert bool(named) == level.wanders
        found += detected(level)
        assert not level.wanders or level.verdict.within is ProcessType.STATIONARY
    assert found >= 8


def test_a_single_relaxation_is_called_a_diffusion():
    """Ten recordings, with a chance of 1 % each for either finding: at most one."""
    levels = [as_one_level(recording(seed)) for seed in range(10)]
    assert sum(level.wanders for level in levels) <= 1
    assert sum(level.coupled for level in levels) <= 1


def test_too_few_samples_are_not_tested():
    pole = other_pole([np.ones(40)], RATE, ALPHA, 4e-4, 0.0)
    assert np.isnan([pole.second_p, pole.second_share, pole.coupling_p]).all()


def test_without_an_ac_coupling_there_is_no_note():
    assert noise_items('AC_COUPLING', []) == [] and FAMILY_WISE == 0.01


@pytest.mark.parametrize('corner', [6.0, 15.0])
def test_an_ac_coupled_instrument_is_found_and_said(corner):
    """High-passes of 6 and 15 1/s before the noise of the sensor: 8 of 10 at least."""
    keep, found = np.exp(-corner / RATE), []
    for seed in range(10):
        rail = recording(seed, seconds=20.0)
        slow = lfilter([1.0 - keep], [1.0, -keep], rail.voltage - 5.0)
        coupled = Recording(rail.t, rail.voltage - slow, rail.throttle, 'coupled')
        found.append(as_one_level(coupled).coupled)
    assert sum(found) >= 8
    analysis = analyze(coupled)
    named = [item for item in analysis.quality if item.name == 'AC_COUPLING']
    assert bool(named) == analysis.levels[0].coupled == found[-1]


@pytest.mark.parametrize('slow, coupled', [(0.2, True), (5.0, False)])
def test_power_that_is_missing_is_a_high_pass_where_it_is_slow(slow, coupled):
    """Innovations without a band below, or above, the rate of the OU."""
    rng = np.random.default_rng(3)
    n = 20000
    spectrum = np.fft.rfft(rng.standard_normal(n))
    omega = 2.0 * np.pi * np.fft.rfftfreq(n, 1.0 / RATE) / ALPHA
    spectrum *= np.where(np.abs(np.log(np.maximum(omega, 1e-9) / slow)) < 0.7, 0.3, 1.0)
    pole = other_pole([np.fft.irfft(spectrum, n)], RATE, ALPHA, 4e-4, 0.0)
    assert (pole.coupling_p < FAMILY_WISE) is coupled


def test_impulses_are_said_beside_the_fit_that_includes_them():
    """Spikes of 0.5 V every two seconds on a rail of 10 mV; not without them."""
    rng = np.random.default_rng(8)
    t = np.arange(20_000) * 1e-3
    v = simulate(t, 90.0, 0.13, rng, u0=5.0)
    for spikes in (False, True):
        w = v - 0.5 * spikes * (np.arange(t.size) % 2000 < 4)
        names = {item.name for item in analyze(Recording(t, w)).quality}
        assert ('IMPULSES' in names) == spikes


def test_slow_relaxations_are_fitted_beside_the_level_that_takes_a_part_of_them():
    """Of 12 intervals of 95 %, more than 3 miss with probability 0.002."""
    outside = 0
    for k in range(12):
        rng = np.random.default_rng(k)
        alpha = (1.0, 2.0, 3.0, 5.0)[k % 4]
        t = np.arange(6000) * 0.1
        v = simulate(t, alpha, 0.03 * math.sqrt(2.0 * alpha), rng, u0=12.0)
        level, = analyze(Recording(t, v + 0.005 * rng.standard_normal(t.size))).levels
        low, high = level.estimate.interval('alpha')
        outside += not low <= alpha <= high
    assert outside <= 3


def test_pieces_shorter_than_the_relaxation_give_no_value():
    """A stick that never rests leaves pieces of about 0.2 s, for a relaxation of 0.17 s."""
    rng = np.random.default_rng(3)
    t = np.arange(12_000) * 0.01
    u = np.clip(0.5 + simulate(t, 2.0, 0.12, rng), 0.0, 1.0)
    v = 12.0 - u + simulate(t, 6.0, 0.07, rng)
    levels = analyze(Recording(t, v, u)).levels
    assert levels
    assert all(level.estimate.interval('alpha')[0] <= 6.0 for level in levels
               if level.estimate.usable)
