"""A second relaxation: found in the innovations if it is there, only then."""

import math

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import ProcessType
from ou_monitor.criticism.innovations import second_relaxation
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
    found = [second_relaxation([np.random.default_rng(seed).standard_normal(3000)], RATE, ALPHA,
                               4e-4, 9e-6)[0] for seed in range(200)]
    assert sum(p < 0.01 for p in found) <= 7


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
    """Ten recordings, with a chance of 1 % each: at most one."""
    assert sum(as_one_level(recording(seed)).wanders for seed in range(10)) <= 1


def test_too_few_samples_are_not_tested():
    assert np.isnan(second_relaxation([np.ones(40)], RATE, ALPHA, 4e-4, 0.0)).all()


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
