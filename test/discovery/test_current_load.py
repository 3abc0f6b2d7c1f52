"""The load of a recording: throttle, or the measured current if it explains more."""

import math
import re

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.cli.recorded import model_text
from ou_monitor.criticism.readings import load_of
from ou_monitor.model.load import lowpass
from ou_monitor.criticism.readings import timing
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.recordings.model_file import parse_model
from ou_monitor.report.discovery_document import discovery_document
from ou_monitor.report.terminal import terminal
import pytest
from scipy.signal import lfilter
import yaml

RATE, N = 100.0, 3000
T = np.arange(N) / RATE
RAIL = OU(8.0, 0.1, 15.0)


def flown(seed):
    """Return throttle that a pilot moves within tenths of a second."""
    rng = np.random.default_rng([seed, 77])
    held = np.repeat(rng.uniform(0.1, 0.9, N), rng.integers(20, 120, N))[:N]
    return lfilter([0.3], [1.0, -0.7], held)


def sagged(load, seed=4):
    """Return the voltage of a rail that sags by half a volt under full load."""
    return SupplyModel((RAIL, LoadSag(0.5, 0.0))).simulate(T, np.random.default_rng(seed), load)


def test_the_measured_current_is_the_load_where_it_says_more():
    """Throttle that moves on its own explains nothing; the model is for the current."""
    u, current = flown(4), 30.0 * flown(5)
    v = sagged(current / 30.0)
    recording = Recording(T, v, u, 'made', current=current)
    found = discover(recording)
    assert found.as_data()['load'] == 'current'
    assert [cause.name for cause in found.causes] == ['load_sag']
    assert found.full == pytest.approx(np.quantile(current, 0.99), rel=0.01)
    assert any('load is the measured current' in note for note in found.notes)
    shown = ' '.join(terminal(discovery_document(found)).split())
    assert 'throttle' not in shown.replace('better than throttle', '')
    assert re.search(r'Where current is [0-9.]+ A or more, .* it is [0-9.]+ A or less', shown)
    saved = parse_model(yaml.safe_load(model_text(found, recording)), 'm.yaml')
    assert saved.model.full_current == pytest.approx(found.full)
    alone = discover(Recording(T, v, u, 'made'))
    assert alone.load == 'throttle' and found.gain > alone.gain + 4.0 * found.gain_se > 0.0


@pytest.mark.parametrize('sign', [1.0, -1.0])
@pytest.mark.parametrize('late', [0, 5])
def test_a_current_is_taken_with_its_sign_and_its_delay(sign, late):
    """Negative where discharge is, and read 50 ms after the voltage has answered."""
    load = flown(5)
    read = sign * 30.0 * np.roll(load, late)
    notes = []
    found, full = load_of(Recording(T, sagged(load), flown(4), '', current=read), T, sagged(load),
                          flown(4), notes)
    assert full == pytest.approx(sign * 30.0 * np.quantile(load, 0.99))
    assert np.corrcoef(found[10:-10], load[10:-10])[0, 1] > 0.99
    assert len(notes) == 1 + bool(late) and (not late or 'responds 50.0 ms before' in notes[1])


def test_throttle_stays_the_load_where_current_is_noise_or_unknown():
    """A current that says no more, or is not there throughout, changes nothing."""
    u = flown(6)
    v = sagged(u)
    noise = 30.0 * np.random.default_rng(1).random(N)
    gap = np.where((T > 10.0) & (T < 20.0), np.nan, 30.0 * u)
    for current in (None, noise, gap, np.full(N, 3.0), np.full(N, np.nan)):
        load, full = load_of(Recording(T, v, u, '', current=current), T, v, u, [])
        assert load is u and math.isnan(full)


def test_one_step_of_the_current_on_a_rail_is_its_load():
    """Differences of samples hid a step over 4 ms; an unrelated step is no load."""
    t = np.arange(20_000) / 1000.0
    rng = np.random.default_rng(2)
    noise = SupplyModel((OU(40.0, 0.125, 5.0), MeasurementNoise(0.004))).simulate(t, rng)
    current = 0.6 + 1.5 * (t > 9.0) + 0.004 * rng.standard_normal(t.size)
    wander = SupplyModel((OU(2.0, 0.028, 0.0),)).simulate(t, rng)
    nothing, fall = np.full(t.size, np.nan), 0.055 * lowpass(current, t, 0.004)
    for v, used in ((noise - fall, True), (noise, False),
                    (noise + wander - fall, True), (noise + wander, False),
                    (noise - 0.08 * (t > 13.0), False)):
        _, full = load_of(Recording(t, v, nothing, '', current=current), t, v, None, [])
        assert math.isfinite(full) == used


@pytest.mark.parametrize('late', [2, 6])
def test_a_throttle_that_was_stamped_late_is_taken_earlier(late):
    """Voltage cannot precede its load: alpha would be a fraction of the true one."""
    load = flown(5)
    v = sagged(load)
    notes = []
    found, _ = load_of(Recording(T, v, np.roll(load, late), ''), T, v, np.roll(load, late), notes)
    np.testing.assert_allclose(found[10:-10], load[10:-10], rtol=0, atol=1e-9)
    assert f'responds {late * 10:.1f} ms before the throttle' in notes[0]


def test_a_delay_between_samples_is_found():
    """Half a sample of 10 ms beside a steep change would look like glitches."""
    fine = np.arange(10 * N) / (10.0 * RATE)
    load = np.interp(fine, T, flown(5))
    read = np.interp(T - 0.055, fine, load)
    v = sagged(np.interp(T, fine, load))
    assert timing(T, v, read)[0] == pytest.approx(0.055, abs=0.0015)
    # Interpolation averages a noisy load, which is no delay.
    assert timing(T, v, flown(5) + 0.03 * np.random.default_rng(3).standard_normal(N))[0] == 0.0


def test_a_response_that_comes_late_is_no_error_of_the_stamps():
    load = flown(5)
    notes = []
    v = sagged(np.roll(load, 6))
    found, _ = load_of(Recording(T, v, load, ''), T, v, load, notes)
    assert found is load and not notes


def test_discharge_by_charge_is_no_second_relaxation():
    """The level follows the sum of the load, which wanders like a slow relaxation."""
    rng = np.random.default_rng(3)
    load = flown(5) * np.interp(T, np.arange(0.0, 40.0, 5.0), rng.uniform(0.3, 1.3, 8))
    v = sagged(load) - 0.05 * np.cumsum(load) / RATE
    found = discover(Recording(T, v, load, 'made'))
    assert {cause.name for cause in found.causes} == {'load_sag', 'drift'}
    drift = next(cause.term for cause in found.causes if cause.name == 'drift')
    assert drift.charge == pytest.approx(-0.05, abs=0.02)
    assert 5.0 < found.model.terms[0].alpha < 12.0
