"""Clipped readings are drawn given the others: throttle, and white noise of the sensor."""

import math

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.discover import _start, _without_clipping
from ou_monitor.discovery.redraw import redraw_clipped, redraw_within_codes
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise, Saturation
from ou_monitor.model.terms.shocks import Jumps
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
    (said,) = [cause.explanation.text for cause in found.causes if cause.name == 'saturation']
    assert 'low = ' in said and 'high = ' not in said
    # Errors of one step, and how well their size is known, are the two parts of the gain.
    extended = found.as_data()['extended']
    assert 0.0 < extended['errors_shrink'] < 1.0
    assert extended['size_gain'] - math.log1p(-extended['errors_shrink']) == pytest.approx(
        extended['gain'])


HERTZ, LENGTH = 100.0, 6000
# The rail moves by 0.63 mV from one reading to the next, an eighth of a code.
RAIL, STEP = OU(2.0, 6.4e-3, 3.9), 5e-3
T = np.arange(LENGTH) / HERTZ
U = 0.6 + 0.05 * np.sin(2.0 * T) + 0.03 * np.sin(31.0 * T)


def rounded(seed, *terms):
    """Return samples of a rail in coarse codes, and its true model."""
    terms = (RAIL, LoadSag(0.4, 0.0), *terms)
    v = SupplyModel(terms).simulate(T, np.random.default_rng(seed), U)
    samples = Samples(T, v, U).spread(
        STEP * np.rint(v / STEP), STEP, np.random.default_rng(seed))
    gaussian = evaluate(samples, terms)
    return samples, Composite(terms, ({}, {}), gaussian, gaussian.z, gaussian.density, 0, 0.0)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('noise', [(), (MeasurementNoise(4e-4),)])
def test_scores_of_what_is_drawn_are_normal_and_white(seed, noise):
    """Within 4 errors of normal scores; places half a move apart add 1/48 of its variance."""
    samples, model = rounded(seed, *noise)
    drawn = redraw_within_codes(samples, model, np.random.default_rng(seed))
    assert (np.abs(drawn.voltage - drawn.logged) <= 0.5001 * STEP).all() and drawn.cell == 0.0
    z = evaluate(drawn, model.terms).z
    assert abs(float(np.mean(z * z)) - 1.0) < 4.0 * math.sqrt(2.0 / LENGTH) + 2.0 / 48.0
    assert abs(float(np.mean(z[1:] * z[:-1]))) < 4.0 / math.sqrt(LENGTH) + 1.0 / 48.0
    assert abs(float(np.mean(z**4)) - 3.0) < 4.0 * math.sqrt(96.0 / LENGTH) + 12.0 / 48.0


def test_fine_codes_are_left_as_they_are():
    """A code of three moves is rounded to white noise."""
    samples, model = rounded(0, MeasurementNoise(2.5 * STEP / 6.0))
    assert redraw_within_codes(samples, model, np.random.default_rng(0)) is samples


def test_rounding_names_no_cause_and_keeps_the_sag():
    """Of a rail under codes of eight moves; the sag is within 4 errors as stated."""
    samples, _ = rounded(1)
    found = discover(Recording(T, samples.logged, U, 'made'))
    assert {cause.name for cause in found.causes} == {'quantization', 'load_sag'}
    at = next(k for k, term in enumerate(found.model.terms) if term.NAME == 'load_sag')
    assert abs(found.model.terms[at].linear - 0.4) < 4.0 * found.se[at]['linear']


def test_jumps_of_several_codes_are_found():
    """Once a second, of four codes: wider than the rail moves by itself in a second."""
    samples, _ = rounded(4, Jumps(1.0, -4.0 * STEP, STEP))
    found = discover(Recording(T, samples.logged, U, 'made'))
    assert {cause.name for cause in found.causes} == {'quantization', 'load_sag', 'jumps'}
