"""Noise with falls deeper than its rises: its simulation, and where `discover` names it."""

import numpy as np
from ou_monitor import discover
from ou_monitor.discovery.decision import kinds_to_try
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import LopsidedNoise, MeasurementNoise, Quantization
from ou_monitor.records import Recording
import pytest
from scipy.signal import lfilter
from scipy.stats import skew

RAIL, STD = OU(1.0, 0.01, 12.0), 0.05
N, RATE = 6000, 50.0
# Enough to name noise that is there.
FEW = 4000
T = np.arange(N) / RATE


@pytest.mark.parametrize('shape, sign', [((-0.4, 0.9), -1), ((0.3, 0.7), 1), ((0.0, 0.8), 0)])
def test_its_mean_and_deviation_are_those_of_white_noise(shape, sign):
    terms = OU(1.0, 0.0, 0.0), MeasurementNoise(STD), LopsidedNoise(*shape)
    v = SupplyModel(terms).simulate(np.arange(10**5) / RATE, np.random.default_rng(1))
    assert v.mean() == pytest.approx(0.0, abs=4.0 * STD / 300.0)
    assert v.std() == pytest.approx(STD, rel=0.03)
    assert np.sign(np.round(skew(v), 0 if not sign else 2)) == sign


def test_bursts_of_load_are_named_and_explain_the_recording():
    """Beside a sag under throttle in steps."""
    rng = np.random.default_rng(3)
    u = np.repeat(rng.random(N // 50), 50)
    rail = SupplyModel((RAIL,)).simulate(T, rng)
    bursts = -STD * (rng.gamma(2.0, size=N) - 2.0) / np.sqrt(2.0)
    found = discover(Recording(T, rail - 0.8 * u + bursts, u, 'bursts'))
    assert {'load_sag', 'measurement_noise', 'lopsided_noise'} == {c.name for c in found.causes}
    law = next(c.term for c in found.causes if c.name == 'lopsided_noise')
    assert law.skew < -0.2 and abs(next(
        one.after for one in found.criticism if one.statistic == 'skewness')) < 4.0


def test_noise_of_another_asymmetric_law_is_named_and_something_left():
    """Gamma noise: the law is not its own, and takes up seven tenths of its skewness at least."""
    rng = np.random.default_rng(0)
    rail = SupplyModel((OU(5.0, 0.15, 12.0),)).simulate(T, rng)
    noisy = rail + 0.08 * (1.0 - rng.gamma(1.5, 1.0, N) / 1.5)
    found = discover(Recording(T[:FEW], noisy[:FEW]))
    assert 'lopsided_noise' in [cause.name for cause in found.causes]
    (skewness,) = (c for c in found.record.criticism if c.statistic == 'skewness')
    assert abs(skewness.after) < 0.3 * abs(skewness.before)


@pytest.mark.parametrize('of_rail', [False, True])
def test_less_than_half_of_the_noise_is_named_and_an_asymmetric_drive_is_not(of_rail):
    """White noise is two fifths of the one-step variance; or else the drive is asymmetric."""
    named, n = [], N if of_rail else FEW
    for seed in range(3):
        rng = np.random.default_rng(seed)
        falls = (2.0 - rng.gamma(2.0, size=N)) / np.sqrt(2.0)
        even = rng.standard_normal(N)
        kicks, white = (falls, even) if of_rail else (even, falls)
        rail = lfilter([0.05], [1.0, -0.9], kicks)
        found = discover(Recording(T[:n], (12.0 + rail + 0.05 * white)[:n]))
        named.append('lopsided_noise' in {c.name for c in found.causes})
    assert sum(named) == (0 if of_rail else 3)


def test_even_tails_are_not_called_lopsided():
    rng = np.random.default_rng(4)
    noise = STD * rng.laplace(size=N) / np.sqrt(2.0)
    found = discover(Recording(T, SupplyModel((RAIL,)).simulate(T, rng) + noise))
    assert 'lopsided_noise' not in {c.name for c in found.causes}


def test_steps_of_the_adc_alone_are_not_shaped():
    """It is tried beside white noise only: it has none to shape in a rail read in coarse steps."""
    kinds = kinds_to_try(catalogue().values(), [OU, Quantization], (), True, False)
    assert LopsidedNoise not in kinds
    assert LopsidedNoise in kinds_to_try(
        catalogue().values(), [OU, MeasurementNoise], (), True, False)
