"""Effects of a model in a pilot's units."""

import math

import numpy as np
from ou_monitor.analysis.noise import rise_at
from ou_monitor.analysis.supply import supply_facts
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.load_effects import dip_level, load_fall, low_dips
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.records import Recording
import pytest

N, RATE = 6000, 100.0
T = np.arange(N) / RATE
# 0.5 s of full throttle each 5 s.
U = np.where(T % 5.0 < 0.5, 1.0, 0.0)
INRUSH = (LoadSag(1.0, 0.0), LoadTransient(-0.5, 0.1, 0.0))
REST = OU(1.0, 0.01, 15.0)


def flown(*terms):
    """Return samples of the mean of some terms, 15 V at rest, with one dip of another making."""
    samples = Samples(T, np.zeros(N), U)
    path = np.full(N, 15.0)
    for term in terms:
        path += term.columns(samples.segment(1.0, 0.0)) @ np.array(term.linear_values())
    path[(T > 22.0) & (T < 22.1)] -= 1.0
    return Samples(T, path, U)


def dips_of(samples, baseline, extended, seed=0):
    """Return the dips of samples, with the hysteresis of the facts."""
    u = np.full(samples.n, np.nan) if samples.throttle is None else samples.throttle
    rise = rise_at(Recording(samples.t, samples.voltage, u), samples.t)
    return low_dips(samples, rise, baseline, extended, np.random.default_rng(seed))


def test_the_fall_is_measured_and_dips_are_counted():
    """1 V of sag and 0.5 V of inrush, 0.05 V of it in the median of half a second."""
    found = load_fall(flown(*INRUSH), (REST, *INRUSH))
    assert (found.measured, found.explained) == pytest.approx((1.05, 1.05), abs=0.05)
    assert (found.low, found.high) == (0.0, 1.0) and found.fits
    dips = dips_of(flown(*INRUSH), (REST,), (REST, *INRUSH))
    assert (dips.count, dips.made) == (13, 12)
    assert dips.observed == pytest.approx(13.0 * 60.0 / (T[-1] - T[0]))
    assert dips.observed_se == pytest.approx(dips.observed / math.sqrt(13.0))


def test_dips_that_the_lowest_load_avoids_are_made_by_load():
    """A sag of 0.4 V below noise of 0.6 V: the smaller part, without which none is a dip."""
    samples, sag = flown(LoadSag(0.4, 0.0)), LoadSag(0.4, 0.0)
    voltage = samples.voltage.copy()
    voltage[(U > 0.0) & (T % 5.0 > 0.2) & (T % 5.0 < 0.3)] -= 0.6
    dips = dips_of(Samples(T, voltage, U), (REST,), (REST, sag))
    assert 14.0 < dips.level < 14.4 and (dips.count, dips.made) == (13, 12)


def test_without_a_response_to_load_there_is_no_effect():
    """Neither of a model without one, nor of a recording without load."""
    for samples, terms in ((flown(), (REST,)), (Samples(T, flown().voltage, None), (REST,))):
        assert math.isnan(load_fall(samples, terms).measured)
        assert dips_of(samples, terms, terms).made is None


def test_a_model_with_another_fall_than_the_readings_is_not_trusted():
    noise = 1e-3 * np.random.default_rng(1).standard_normal(N)
    samples, third = Samples(T, flown(INRUSH[0]).voltage + noise, U), (REST, LoadSag(0.3, 0.0))
    found = load_fall(samples, third)
    assert (found.measured, found.explained) == pytest.approx((1.0, 0.3), abs=1e-3)
    assert not found.fits
    assert load_fall(samples, (REST, LoadSag(0.8, 0.0))).fits
    wandering = Samples(T, samples.voltage + np.sin(T / 5.0), np.where(T > 55.0, 1.0, 0.0))
    assert load_fall(wandering, third).fits


@pytest.mark.parametrize('offset', [0.0, 0.25, 0.5, 0.75])
def test_dips_do_not_depend_on_the_offset_of_the_codes(offset):
    rng, rail, step = np.random.default_rng(5), OU(20.0, 0.2, 15.0), 0.04
    t = np.arange(20 * N) / RATE
    v = SupplyModel((rail,)).simulate(t, rng)
    codes = step * (np.rint(v / step - offset) + offset)
    dips = dips_of(Samples(t, codes, None), (rail,), (rail, Quantization(step)))
    # 52 to 740 dips; codes counted from 0 gave 0.2 to 2 times as many.
    assert dips.count > 50 and abs(dips.extended - dips.observed) < 4.0 * math.hypot(
        dips.observed_se, dips.extended_se)


def test_medians_of_codes_may_differ_by_a_code():
    rng = np.random.default_rng(1)
    v = 15.003 - 0.0015 * U + 0.0018 * rng.standard_normal(N)
    found = load_fall(Samples(T, 0.005 * np.rint(v / 0.005), U), (REST, LoadSag(0.0015, 0.0)))
    assert found.measured == pytest.approx(0.005) and found.fits


def test_dips_are_those_of_the_facts():
    """With readings in codes, and noise that crosses the level within a dip."""
    model = SupplyModel((OU(2.0, 0.3, 15.0), LoadSag(1.0, 0.0), Quantization(0.01)))
    v = model.simulate(T, np.random.default_rng(3), U) + 0.02 * (np.arange(N) % 2)
    dips = dips_of(Samples(T, v, U), (REST,), model.terms[:2])
    facts = supply_facts(Recording(T, v, U), dips.level)
    assert dips.count == facts.dips.count > 5
    assert float(f'{dips.level:g}') == dips.level


def test_dips_tell_a_wrong_sigma_from_the_true_one():
    """The truth within 4 joint errors of its own expectation; half of sigma far below."""
    true = SupplyModel((OU(63.0, 0.3, 5.0), Quantization(0.005)))
    t = np.arange(30_000) / 1000.0
    samples = Samples(t, true.simulate(t, np.random.default_rng(4)), None)
    rates = dips_of(samples, (OU(63.0, 0.15, 5.0),), true.terms)
    assert abs(rates.observed - rates.extended) < 4.0 * math.hypot(
        1.3 * rates.observed_se, rates.extended_se)
    assert rates.baseline < 0.5 * rates.observed


def test_a_model_that_cannot_be_simulated_has_no_rate():
    """Sag without throttle: NaN, no exception."""
    samples = Samples(T, flown().voltage, None)
    rates = dips_of(samples, (REST,), (REST, LoadSag(0.5, 0.0)))
    assert math.isnan(rates.extended) and math.isfinite(rates.baseline)


def test_the_level_is_raised_until_there_are_ten_dips():
    """From 2.5 deviations in quarters; half-way between the samples beside it."""
    v = 0.05 * np.sin(np.arange(4000) * 1.7) + 5.0
    v[100:4000:400] = 4.0
    level = dip_level(v, np.zeros(4000))
    assert level == pytest.approx(0.5 * (v[v < 4.5].max() + v[v >= 4.5].min()), abs=0.001)
    # One dip fewer: the level lies within the sine, at a half or above.
    v[100] = 5.0
    assert 4.94 < dip_level(v, np.zeros(4000)) < v.mean() - 0.4 * v.std()
