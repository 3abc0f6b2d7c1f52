"""Effects of a model in a pilot's units."""

import math

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import throttle_effects
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
import pytest

N, RATE = 6000, 100.0
T = np.arange(N) / RATE
# 0.5 s of full throttle each 5 s.
U = np.where(T % 5.0 < 0.5, 1.0, 0.0)
INRUSH = (LoadSag(1.0, 0.0), LoadTransient(-0.5, 0.1, 0.0))


def flown(*terms):
    """Return samples of the mean of some terms, 15 V at rest, with one dip of another making."""
    samples = Samples(T, np.zeros(N), U)
    path = np.full(N, 15.0)
    for term in terms:
        path += term.columns(samples.segment(1.0, 0.0)) @ np.array(term.linear_values())
    path[(T > 22.0) & (T < 22.1)] -= 1.0
    return Samples(T, path, U)


def test_a_punch_out_dips_and_comes_back():
    """1 V of sag and 0.5 V of inrush, of which 90 % are gone after 0.1 s ln 10."""
    found = throttle_effects(flown(*INRUSH), (OU(1.0, 0.01, 15.0), *INRUSH), 14.5)

    assert found.dip == pytest.approx(1.0 + 0.5 * math.exp(-0.1), rel=1e-6)
    assert found.after == pytest.approx(0.01)
    assert found.recovered == pytest.approx(0.5 * math.exp(-0.1), rel=1e-6)
    assert found.within == pytest.approx(0.1 * math.log(10.0), abs=0.011)
    assert (found.dips, found.made) == (13, 12)
    assert (found.measured, found.explained) == pytest.approx((1.05, 1.05), abs=0.1)
    assert ('lowers it by 1.5 V after 10 ms, of which 0.45 V recover within 0.24 s'
            in found.words)
    assert 'Throttle caused 12 of the 13 dips below 14.50 V.' in found.words
    assert found.as_data()['dips'] == {'level_v': 14.5, 'count': 13, 'made_by_throttle': 12}


def test_a_sag_stays():
    """Nothing comes back, and nothing is said of it."""
    found = throttle_effects(flown(INRUSH[0]), (OU(1.0, 0.01, 15.0), INRUSH[0]), 14.5)
    assert found.recovered == 0.0 and math.isnan(found.within)
    assert 'recover' not in found.words and 'lowers it by 1.0 V' in found.words
    # One that grows is that of half time, 30 s.
    grown = throttle_effects(flown(INRUSH[0]), (OU(1.0, 0.01, 15.0), LoadSag(1.0, 0.0, 0.02)),
                             14.5)
    assert grown.dip == pytest.approx(1.6, rel=1e-3) and grown.recovered == 0.0


def test_without_a_response_to_throttle_there_is_no_effect():
    """Neither of a model without one, nor of a recording without throttle."""
    assert throttle_effects(flown(), (OU(1.0, 0.01, 15.0),), 14.5).words == ''
    assert throttle_effects(Samples(T, T, None), INRUSH, 14.5).words == ''


def test_a_model_with_another_fall_than_the_readings_is_not_trusted():
    """A third of the fall; not so where the voltage wanders by more between two stays."""
    samples, third = flown(INRUSH[0]), (OU(1.0, 0.01, 15.0), LoadSag(0.3, 0.0))
    found = throttle_effects(samples, third, 14.5, 40.0)
    assert (found.measured, found.explained) == pytest.approx((1.0, 0.3))
    assert not found.fits and 'at current 40 A is 1.0 V below that at 0 A, but 0.30' in found.words
    assert throttle_effects(samples, (third[0], LoadSag(0.8, 0.0)), 14.5).fits
    wandering = Samples(T, samples.voltage + np.sin(T / 5.0), np.where(T > 55.0, 1.0, 0.0))
    assert throttle_effects(wandering, third, 14.5).fits
