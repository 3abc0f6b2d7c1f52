"""Effects hidden in a recorded flight: found, and what the flight itself shows stays as it was."""

from functools import cache

import numpy as np
from ou_monitor import discover, read_recording, Recording
from ou_monitor.criticism.integrity import examine
from project import ROOT
import pytest
from scipy.signal import lfilter

# Seconds of the flight: throttle moves all the time; 200 Hz, codes of 10 mV.
FIRST, LAST, CODE = 30.0, 50.0, 0.01
# What that stretch shows by itself, and whatever has to stay beside an injected effect.
LOAD = {'load_sag', 'load_transient'}


@cache
def flown():
    """Return stamps, voltage and throttle of the stretch."""
    whole = read_recording(ROOT / 'bags' / 'recorded' / 'gecko.csv')
    part = (whole.t >= FIRST) & (whole.t < LAST)
    return whole.t[part], whole.voltage[part], whole.throttle[part]


def coded(voltage):
    """Return a voltage as that ADC codes it."""
    return CODE * np.rint(voltage / CODE)


def tone(t, rng):
    """Return a line of 30 mV at 31.7 Hz, in noise of 20 to 60 mV."""
    return 0.03 * np.sin(2.0 * np.pi * 31.7 * t)


def jumps(t, rng):
    """Return steps of -0.4 V, once a second, that relax in 0.2 s."""
    step = float(np.median(np.diff(t)))
    kicks = (rng.random(t.size) < step) * rng.normal(-0.4, 0.1, t.size)
    return lfilter([1.0], [1.0, -np.exp(-5.0 * step)], kicks)


@cache
def names(effect=None):
    """Return what is named in the stretch with an effect in it."""
    t, voltage, throttle = flown()
    if effect is not None:
        voltage = coded(voltage + effect(t, np.random.default_rng(3)))
    found = discover(Recording(t, voltage, throttle, 'gecko'))
    assert found.gain > 0.0
    return {cause.name for cause in found.causes}


@pytest.mark.parametrize('effect', [tone, jumps], ids=lambda effect: effect.__name__)
def test_what_was_hidden_is_named_beside_the_load(effect):
    """Of each the name, which the flight alone does not have."""
    assert effect.__name__ not in names()
    assert {effect.__name__, *LOAD} <= names(effect)


def test_the_flight_alone_shows_its_load():
    """Sag, its inrush, and white noise that follows throttle."""
    assert {*LOAD, 'measurement_noise'} <= names()
    assert names() & {'load_dependent_noise', 'load_dependent_sigma'}


@pytest.mark.parametrize('share, found', [(0.0, False), (0.3, True), (0.5, True)])
def test_values_that_were_held_beside_ties_by_chance(share, found):
    """A ninth of the values is alike by chance of the codes; three tenths more are not."""
    t, voltage, throttle = flown()
    held = voltage.copy()
    for k in np.flatnonzero(np.random.default_rng(4).random(t.size) < share)[1:]:
        held[k] = held[k - 1]
    exact = examine(Recording(t, held, throttle)).exact
    assert ('held_samples' in [term.NAME for term in exact]) is found
    assert np.mean(np.diff(voltage) == 0.0) > 0.05
