"""Export of a model to other simulators: parameters, losses, costs."""

from dataclasses import replace
import json
import re
import xml.etree.ElementTree as ElementTree

from live import ROOT
import numpy as np
from ou_monitor.comparison.export import export, SOURCES
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.records import Recording
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
import pytest

GECKO = read_model(ROOT / 'models' / 'gecko.yaml').model
HOVER = np.full(2000, 0.4)


def parameters(text):
    lines = [line.replace('param set ', '').split() for line in text.splitlines()
             if not line.startswith('#')]
    return {name: float(value) for name, value in lines}


def test_px4_falls_from_full_to_empty_in_the_time_that_throttle_takes():
    found = export(GECKO, 'px4', throttle=HOVER, rate=100.0)
    values = parameters(found.text)
    assert set(values) == {'BAT1_N_CELLS', 'BAT1_V_CHARGED', 'BAT1_V_EMPTY', 'SIM_BAT_DRAIN',
                           'SIM_BAT_MIN_PCT'}
    assert values['BAT1_N_CELLS'] == 4.0
    assert values['BAT1_V_CHARGED'] == pytest.approx(GECKO.ou.u0 / 4.0, abs=1e-3)
    drained = values['SIM_BAT_DRAIN'] * GECKO.load.discharge * 0.4 ** 1.8
    assert 0.8 < drained < 1.0
    assert SOURCES['px4'] in found.text


def test_gazebo_is_a_line_and_a_constant_sag():
    """Its own equation, with those numbers, gives the model's level under that load."""
    found = export(GECKO, 'gazebo', throttle=HOVER, rate=100.0, full_current=60.0)
    plugin = ElementTree.fromstring(found.text)
    value = {one.tag: one.text for one in plugin}
    e0, e1, r, c, power = (float(value[name]) for name in (
        'open_circuit_voltage_constant_coef', 'open_circuit_voltage_linear_coef', 'resistance',
        'capacity', 'power_load'))
    voltage = GECKO.ou.u0 - sum(t.linear * 0.4 + t.square * 0.16 for t in GECKO.terms
                                if t.NAME == 'load_sag')
    assert e0 - r * power / voltage == pytest.approx(voltage, abs=0.01)
    # A full pack drawn by that current for the time that the model takes: to 3.5 V a cell.
    seconds = 3600.0 * c / (power / voltage)
    assert seconds == pytest.approx(1.0 / (GECKO.load.discharge * 0.4 ** 1.8), rel=0.02)
    assert e1 < 0.0 and any('load_sag is the sag under' in note for note in found.notes)


def test_ardupilot_has_charge_and_resistance():
    found = export(GECKO, 'ardupilot', throttle=HOVER, rate=100.0, full_current=60.0)
    assert set(parameters(found.text)) == {
        'SIM_BATT_VOLTAGE', 'SIM_BATT_CAP_AH', 'BATT_CAPACITY', 'BATT_LOW_VOLT', 'BATT_CRT_VOLT'}
    resistance = float(found.text.rsplit('"refBatRes": ', 1)[1])
    (sag,) = (t for t in GECKO.terms if t.NAME == 'load_sag')
    assert 60.0 * resistance == pytest.approx(sag.linear + sag.square, rel=1e-3)
    with pytest.raises(InputError, match='--full-current'):
        export(GECKO, 'ardupilot', throttle=HOVER, rate=100.0)


@pytest.mark.parametrize('source, stated', [
    ({'capacity_mah': '3700'}, True), ({'log_capacity_mah': '3700'}, True),
    ({'capacity_mah': 'much'}, False), ({}, False)])
def test_a_stated_capacity_is_kept(source, stated):
    """Otherwise a note says that it is an estimate."""
    t = np.arange(2000) / 100.0
    flown = Recording(t, GECKO.simulate(t, np.random.default_rng(1), HOVER), HOVER, 'x',
                      source=source)
    found = export(GECKO, 'ardupilot', throttle=HOVER, rate=100.0, full_current=60.0,
                   recording=flown)
    assert (parameters(found.text)['BATT_CAPACITY'] == 3700.0) is stated
    assert any('capacity' in note for note in found.notes) is not stated


@pytest.mark.parametrize('target', ['gazebo', 'ardupilot'])
def test_a_sag_that_grows_is_exported_as_it_begins(target):
    """The resistance is one number: the note says what it leaves out."""
    steady, grows = (replace(GECKO, terms=tuple(
        replace(term, growth=growth) if isinstance(term, LoadSag) else term
        for term in GECKO.terms)) for growth in (0.0, -0.004))
    found = export(grows, target, throttle=HOVER, rate=100.0, full_current=60.0)
    other = export(steady, target, throttle=HOVER, rate=100.0, full_current=60.0)
    assert (found.text, found.model.terms) == (other.text, other.model.terms)
    assert set(found.notes) - set(other.notes) == {
        'load_sag keeps its initial value: in the model, it grows by -0.004 V/s at full throttle'}


def test_each_term_left_out_is_named_with_its_size():
    recording = read_recording(ROOT / 'bags' / 'recorded' / 'gecko.csv', start=20.0, end=50.0)
    found = export(GECKO, 'px4', throttle=np.nan_to_num(recording.throttle), rate=200.0,
                   recording=recording)
    named = [note.split()[0] for note in found.notes if 'is left out' in note]
    assert named == [term.NAME for term in GECKO.terms if term.NAME != 'drift']
    assert 'load_sag' in named and 'measurement_noise' in named
    whole, left = found.notes[-2:]
    shares = [float(re.search(r'explains (\d+) %', note)[1]) for note in (whole, left)]
    assert shares[0] > 70.0 and shares[1] < 40.0


def test_json_is_the_model():
    found = export(SupplyModel((OU(5.0, 0.1, 5.0), LoadSag(1.0, 0.0))), 'json', throttle=HOVER,
                   rate=100.0)
    assert json.loads(found.text)['model'][1] == {
        'term': 'load_sag', 'params': {'linear': 1.0, 'square': 0.0, 'growth': 0.0}}
    assert not found.notes
