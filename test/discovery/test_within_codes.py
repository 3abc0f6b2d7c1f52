"""Readings within coarse codes are drawn from the model, so that rounding names no cause."""

import math

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery.redraw import redraw_within_codes
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.shocks import Jumps
import pytest

RATE, N = 100.0, 6000
# The rail moves by 0.63 mV from one reading to the next, an eighth of a code.
RAIL, STEP = OU(2.0, 6.4e-3, 3.9), 5e-3
T = np.arange(N) / RATE
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
    assert abs(float(np.mean(z * z)) - 1.0) < 4.0 * math.sqrt(2.0 / N) + 2.0 / 48.0
    assert abs(float(np.mean(z[1:] * z[:-1]))) < 4.0 / math.sqrt(N) + 1.0 / 48.0
    assert abs(float(np.mean(z**4)) - 3.0) < 4.0 * math.sqrt(96.0 / N) + 12.0 / 48.0


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
