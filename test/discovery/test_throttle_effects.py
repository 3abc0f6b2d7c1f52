"""Effects of a model in a pilot's units."""

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


def test_the_fall_is_measured_and_dips_are_counted():
    """1 V of sag and 0.5 V of inrush, 0.05 V of it in the median of half a second."""
    found = throttle_effects(flown(*INRUSH), (OU(1.0, 0.01, 15.0), *INRUSH), 14.5)

    assert (found.measured, found.explained) == pytest.approx((1.05, 1.05), abs=0.05)
    assert (found.dips, found.made) == (13, 12)
    assert 'Throttle caused 12 of the 13 dips below 14.50 V.' in found.words
    data = found.as_data()
    assert data['dips'] == {'level_v': 14.5, 'count': 13, 'made_by_throttle': 12}
    assert (data['fall']['from'], data['fall']['to']) == (0.0, 1.0)


def test_without_a_response_to_throttle_there_is_no_effect():
    """Neither of a model without one, nor of a recording without throttle."""
    assert throttle_effects(flown(), (OU(1.0, 0.01, 15.0),), 14.5).words == ''
    assert throttle_effects(Samples(T, T, None), INRUSH, 14.5).words == ''


def test_a_model_with_another_fall_than_the_readings_is_not_trusted():
    """A third of the fall; not so where the voltage wanders by more between two stays."""
    samples, third = flown(INRUSH[0]), (OU(1.0, 0.01, 15.0), LoadSag(0.3, 0.0))
    found = throttle_effects(samples, third, 14.5, 40.0)
    assert (found.measured, found.explained) == pytest.approx((1.0, 0.3))
    assert not found.fits and 'falls by 1.0 V from current 0 A to 40 A, 0.30 V by' in found.words
    assert throttle_effects(samples, (third[0], LoadSag(0.8, 0.0)), 14.5).fits
    wandering = Samples(T, samples.voltage + np.sin(T / 5.0), np.where(T > 55.0, 1.0, 0.0))
    assert throttle_effects(wandering, third, 14.5).fits
