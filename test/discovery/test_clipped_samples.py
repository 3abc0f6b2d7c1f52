"""Clipped readings are drawn given the others: throttle, and white noise of the sensor."""

import math

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.discover import _start, _without_clipping
from ou_monitor.discovery.redraw import redraw_clipped
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise, Saturation
import pytest

RATE, N = 200.0, 8000
TERMS = (OU(20.0, 0.25, 16.0), LoadSag(1.0, 0.0), LoadDependentSigma((0.0, 1.0), (0.0, 1.0)),
         MeasurementNoise(0.02))


def flown(seed, share):
    """Return stamps, voltage, throttle and the reading that a share is below."""
    t = np.arange(N) / RATE
    u = 0.5 + 0.3 * np.sin(0.9 * t) + 0.15 * np.sin(5.1 * t)
    v = SupplyModel(TERMS).simulate(t, np.random.default_rng(seed), u)
    return t, v, u, float(np.quantile(v, share))


@pytest.mark.parametrize('seed', range(3))
def test_drawn_readings_have_the_mean_of_the_clipped_ones(seed):
    """In the mean to four errors, given the parameters: neighbours in time share a part of it."""
    t, v, u, low = flown(seed, 0.08)
    clipped = v <= low
    seen = Samples(t, np.maximum(v, low), u)
    model = fit_composite(Samples(t, v, u), TERMS, slice(0, N))
    ends = Saturation(low, 100.0)
    drawn = redraw_clipped(seen, model, ends, clipped, np.random.default_rng(seed))
    assert (drawn.voltage[~clipped] == v[~clipped]).all()
    assert (drawn.voltage[clipped] <= low).all()
    off = drawn.voltage[clipped] - v[clipped]
    # A run of clipped readings counts once.
    runs = int((clipped[1:] & ~clipped[:-1]).sum())
    assert abs(float(off.mean())) < 4.0 * float(off.std()) / math.sqrt(runs)


@pytest.mark.parametrize('step', [0.0, 0.003])
@pytest.mark.parametrize('sides', ['low', 'both'])
def test_what_is_drawn_has_the_variance_of_the_rail(step, sides):
    """Within 3 standard errors, sqrt(2 / (alpha T)) = 4 % for 20 s; clipping takes 5 to 10 %."""
    t = np.arange(20_000) / 1000.0
    v = SupplyModel((OU(63.0, 0.3156, 5.0),)).simulate(t, np.random.default_rng(5))
    v = step * np.rint(v / step) if step else v
    low, high = np.quantile(v, [0.04, 0.96])
    clipped = np.clip(v, low, high if sides == 'both' else np.inf)
    state = examine(Recording(t, clipped, np.full(t.size, np.nan)))
    samples, _ = _without_clipping(state.samples, state, _start(state.samples, state))
    assert abs(samples.voltage.var() / v.var() - 1.0) < 0.03 < 1.0 - clipped.var() / v.var()


def test_codes_stay_codes():
    """Each drawn reading has the code of the cell that it lies in."""
    t, v, u, _ = flown(4, 0.08)
    cell = 0.05
    codes = cell * np.rint(np.maximum(v, 15.2) / cell)
    samples = Samples(t, v, u).spread(codes, cell, np.random.default_rng(0))
    clipped = codes <= codes.min()
    model = fit_composite(samples, TERMS, slice(0, N))
    drawn = redraw_clipped(samples, model, Saturation(float(codes.min()), 100.0), clipped,
                           np.random.default_rng(0))
    assert (np.abs(drawn.voltage - drawn.logged) < 0.5001 * cell).all()
    assert np.abs(drawn.logged / cell - np.rint(drawn.logged / cell)).max() < 1e-6
    assert (drawn.logged[clipped] < 15.2 + 0.5 * cell).all()


def test_a_rail_at_the_bottom_gives_no_cause_that_is_not_there():
    """What an OU that knows no throttle puts there was alpha(throttle), or wandering noise."""
    t, v, u, low = flown(5, 0.06)
    found = discover(Recording(t, np.maximum(v, low), u))
    assert {cause.name for cause in found.causes} == {
        'saturation', 'load_sag', 'load_dependent_sigma', 'measurement_noise'}
    # The end that no reading met is not told as if it were known, nor saved as a voltage.
    (said,) = [cause.explanation for cause in found.causes if cause.name == 'saturation']
    assert 'low = ' in said and 'high = ' not in said
    # Errors of one step, and how well their size is known, are the two parts of the gain.
    extended = found.as_data()['extended']
    assert 0.0 < extended['errors_shrink'] < 1.0
    assert extended['size_gain'] - math.log1p(-extended['errors_shrink']) == pytest.approx(
        extended['gain'])
