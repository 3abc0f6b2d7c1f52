"""Effects hidden in a recorded flight are found, and its own effects are not mistaken for them."""

from functools import cache

from injected import EFFECTS, noise_of
import numpy as np
from ou_monitor import discover, read_recording, Recording
from ou_monitor.criticism.integrity import examine
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.regime_switching import SwitchingLevels
from ou_monitor.model.terms.shocks import Glitches, Jumps, Volatility
from project import ROOT
import pytest

# Seconds of the flight: throttle moves all the time; 200 Hz, codes of 10 mV.
FIRST, LAST = 30.0, 50.0


@cache
def flown():
    """Return stamps, voltage and throttle of the stretch."""
    whole = read_recording(ROOT / 'bags' / 'recorded' / 'gecko.csv')
    part = (whole.t >= FIRST) & (whole.t < LAST)
    return whole.t[part], whole.voltage[part], whole.throttle[part]


def test_ties_by_chance_of_the_codes_are_no_holds():
    """A ninth of the values of that ADC is alike."""
    t, voltage, throttle = flown()
    assert np.mean(np.diff(voltage) == 0.0) > 0.05
    exact = examine(Recording(t, voltage, throttle)).exact
    assert 'held_samples' not in [term.NAME for term in exact]


@pytest.mark.parametrize('dither, share, found', [
    (1.0, 0.0, False), (1.0, 0.02, True),
    # In its own codes of 10 mV.
    (0.0, 0.0, False), (0.0, 0.3, True), (0.0, 0.5, True), (0.0, 0.7, True)])
def test_held_values_are_told_from_chance(dither, share, found):
    """Of an ADC without steps 80 of 4000 values that are held are no chance."""
    t, voltage, throttle = flown()
    rng = np.random.default_rng(4)
    held = voltage + 0.01 * dither * (rng.random(t.size) - 0.5)
    for k in np.flatnonzero(rng.random(t.size) < share)[1:]:
        held[k] = held[k - 1]
    exact = examine(Recording(t, held, throttle)).exact
    assert ('held_samples' in [term.NAME for term in exact]) is found


@pytest.mark.parametrize('effect', sorted(EFFECTS))
def test_holds_steps_and_clipping_are_named_without_a_model(effect):
    t, voltage, throttle = flown()
    flight = Recording(t, voltage, throttle)
    inject, names = EFFECTS[effect]
    hidden = inject(flight, noise_of(voltage), np.random.default_rng(7))
    exact = {term.NAME for term in examine(hidden).exact}
    assert exact == (names if effect in ('held', 'steps', 'rail') else set())


@pytest.mark.parametrize('height', [0.0151, 0.3333])
def test_codes_moved_by_what_is_no_code_are_no_holds(height):
    """Ties stay those of the ADC where something else than codes was added now and then."""
    t, voltage, throttle = flown()
    rng = np.random.default_rng(8)
    moved = voltage + height * (np.cumsum(rng.random(t.size) < 0.005) % 2)
    assert examine(Recording(t, moved, throttle)).exact == ()


@cache
def piece():
    """Return ten seconds of the flight, and the causes that they have by themselves."""
    found = Recording(*(values[:2000] for values in flown()))
    return found, [cause.name for cause in discover(found).causes]


@pytest.mark.parametrize('effect', ['jumps', 'tone'])
def test_an_effect_hidden_in_a_flight_is_named_beside_its_sag(effect):
    """At strength 2, the middle of the table in doc/discovery.md; the flight alone has none."""
    flight, own = piece()
    inject, right = EFFECTS[effect]
    hidden = inject(flight, 2.0 * noise_of(flight.voltage), np.random.default_rng(7))
    found = [cause.name for cause in discover(hidden).causes]
    assert right & set(found) and not right & set(own)
    assert 'load_sag' in own and 'load_sag' in found


@pytest.mark.parametrize('event', [
    Jumps(1.0, -0.3, 0.1), Glitches(0.01, 0.3),
    SwitchingLevels(1.0, 1.0, 0.07, 1.0, 1.0, 2.0), None])
def test_events_are_found_beside_a_wandering_sigma(event):
    """In eight of ten such rails, and no events where there are none."""
    # Two of three are right with 90 % at that rate, and with 3 % where one in ten is.
    t = 0.005 * np.arange(3000)
    events = () if event is None else (event,)
    rail = SupplyModel((
        OU(20.0, 0.06, 12.0), MeasurementNoise(0.01), Volatility(0.4, 4.0), *events))
    right = {term.NAME for term in rail.terms[1:]}
    found = []
    for seed in range(3):
        voltage = rail.simulate(t, np.random.default_rng(seed))
        found.append({cause.name for cause in discover(Recording(t, voltage)).causes})
        if found.count(right) == 2:
            return
    pytest.fail(str(found))
