"""The commands as functions: JSON, tables, plots and HTML, and missing packages."""

import copy
from dataclasses import replace
import json
import pickle
import re
import sys
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
from ou_monitor import (
    analyze, compare, coupling, design, discover, InputError, read_recording, Recording,
    reproduce, Result, simulate, supply_facts)
from ou_monitor.cli.main import main
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.paper import reproduce as reproduction
from ou_monitor.report.terminal import terminal
from project import ROOT
import pytest

FLIGHT, GECKO, SMALL = (str(ROOT / 'bags' / name) for name in (
    'flight', 'recorded/gecko_gyro.csv', 'recorded/micromouse_3.csv'))
PART = {'start': 0.0, 'end': 4.0}
# Arguments of the command, and the same of the function.
CALLS = {
    'analyze': ((FLIGHT, '--to', '4', '--brownout-voltage', '4.7'),
                lambda: analyze(read_recording(FLIGHT, **PART), brownout_voltage=4.7)),
    'compare': ((FLIGHT, '--to', '4', '--seeds', '20', '--cells', '2', '--brownout-voltage',
                 '2.3'),
                lambda: compare(read_recording(FLIGHT, **PART), seeds=20, brownout_voltage=2.3,
                                cells=2)),
    'coupling': ((GECKO, '--signal', 'gyro_x_deg_s', '--band', '10,45'),
                 lambda: coupling(GECKO, 'gyro_x_deg_s', band=(10.0, 45.0))),
    'discover': ((FLIGHT, '--to', '4'), lambda: discover(read_recording(FLIGHT, **PART))),
    'design': (('--throttle', '0.3', '--cells', '4', '--brownout-voltage', '3.2', '--set',
                'bulk_capacitance=220uF'),
               lambda: design(0.3, network={'bulk_capacitance': 220e-6}, cells=4,
                              voltage=3.2)),
    'reproduce': (('--seed', '2'), lambda: reproduce(seed=2))}


@pytest.fixture(scope='module')
def found():
    """Return every result once; `reproduce` and its command with fewer simulations."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproduction, 'CREST_PATHS', 200)
        patch.setattr(reproduction, 'JUMP_SECONDS', 10.0)
        yield {name: call() for name, (_, call) in CALLS.items()}


@pytest.mark.parametrize('name', CALLS)
def test_to_dict_is_the_json_of_the_command(name, found, tmp_path):
    """To the last digit; and where it has facts of a supply, they are those of the result."""
    target = tmp_path / 'x.json'
    assert main([name, *CALLS[name][0], '--json', str(target)]) == 0
    data = json.loads(target.read_text())
    assert found[name].to_dict() == data
    supply = found[name].supply
    assert data.get('supply') == (None if supply is None else supply.to_dict())
    assert (supply is None) == (name in ('design', 'reproduce'))


def test_a_design_of_a_flight_has_its_facts(tmp_path):
    assert main(['design', '--from', SMALL, '--throttle', '0.5', '--cells', '1', '--json',
                 str(tmp_path / 'x.json')]) == 0
    result = design(0.5, recording=SMALL, network={'cells': 1})
    assert result.to_dict() == json.loads((tmp_path / 'x.json').read_text())
    # The default risk is that of the budget.
    assert result.supply.to_dict() == supply_facts(read_recording(SMALL), limit=3.3).to_dict()


@pytest.mark.parametrize('limit', [15.0, 19.5, 21.5])
def test_the_axis_of_the_plot_follows_the_risk(limit):
    """Risks from 0 to 1: at most a third of the axis is neither risk nor allowed risk."""
    found = design(0.4, voltage=limit)
    (plot,) = found.plots().values()
    low, high = np.log10(plot.y_range)
    drawn = np.log10(np.concatenate([curve.y for curve in plot.curves]))
    assert low < drawn.min() and drawn.max() < high
    assert np.ptp(drawn) > (high - low) * 2.0 / 3.0
    assert ('at 1e-09' in plot.curves[0].label) == (min(row.risk for row in found.rows) < 1e-9)


def test_simulate_equals_the_command(tmp_path):
    bag, other = tmp_path / 'a.mcap', tmp_path / 'b.mcap'
    assert main(['simulate', '--preset', 'flight_full', '--duration', '3', '--seed', '4',
                 '--output', str(bag), '--type', 'float64', '--json', str(tmp_path / 'a.json')
                 ]) == 0
    drawn = simulate(preset='flight_full', duration=3.0, seed=4)
    shares = []
    written = simulate(preset='flight_full', duration=3.0, seed=4, output=other,
                       message='float64', progress=shares.append)
    assert bag.read_bytes() == other.read_bytes() and shares[-1] == 1.0
    data = json.loads((tmp_path / 'a.json').read_text())
    assert written.to_dict() == {**data, 'output': str(other)}
    assert {'topics': data['topics'], **drawn.to_dict()} == {**data, 'output': None}
    np.testing.assert_array_equal(read_recording(bag).voltage, drawn.recording.voltage)
    # Over the throttle of another, of a function, and as a model.
    again = simulate(drawn.file.model, throttle=drawn.recording, rate=1000.0, duration=3.0, seed=4)
    np.testing.assert_array_equal(again.recording.voltage, drawn.recording.voltage)
    full = simulate(throttle=np.ones_like, duration=1.0)
    assert set(full.recording.throttle) == {1.0} and full.supply.ou.status != 'no_data'


def test_a_result_is_pickled_and_copied(found):
    """With all it says, of every function; the throttle of a simulation may be from anywhere."""
    flown = read_recording(FLIGHT, **PART)
    drawn = [simulate(throttle=throttle, duration=1.0, rate=100.0)
             for throttle in ('hover', 'flight', 0.3, '0:0,1:0.5', flown, np.zeros_like)]
    for result in (*found.values(), *drawn):
        # The copies of the standard library take the way of pickle: one result shows it.
        copies = (copy.copy, copy.deepcopy) if result is drawn[0] else ()
        for again in (pickle.loads(pickle.dumps(result)), *(one(result) for one in copies)):
            assert type(again) is Result and repr(again) == repr(result)
            assert again.to_dict() == result.to_dict() and str(again) == str(result)
            assert list(again.plots()) == list(result.plots())
            assert repr(again.supply) == repr(result.supply)


def test_a_result_has_the_attributes_of_its_record(found):
    finding = found['discover']
    assert finding.causes is finding.record.causes and not hasattr(finding, 'nonsense')
    assert str(finding) == terminal(finding.document())
    assert repr(finding).startswith('<Finding: A plain simulation lacks')
    assert 'levels' in dir(found['analyze'])
    assert found['analyze'].headline == found['analyze'].to_dict()['headline']


def frame(monkeypatch, result):
    monkeypatch.setitem(sys.modules, 'pandas', SimpleNamespace(DataFrame=lambda rows: rows))
    return result.to_dataframe()


def test_the_main_table_becomes_a_dataframe(found, monkeypatch):
    rows = {name: frame(monkeypatch, result) for name, result in found.items()}
    lowest = found['compare'].lowest
    assert [row['throttle'] for row in rows['analyze']] == [
        level.throttle for level in found['analyze'].levels]
    assert {'alpha', 'alpha_ci95_low', 'alpha_ci95_high'} <= set(rows['analyze'][0])
    assert rows['compare'][0] == {'measure': 'lowest voltage, V', 'inside': lowest.inside,
                                  **lowest.as_data()}
    assert set(rows['coupling']) == {'frequency_hz', 'coherence', 'gain_per_v'}
    assert rows['discover'][0]['name'] == found['discover'].causes[0].name
    assert len(rows['design']) == 81 and rows['reproduce'][0]['printed']
    for row in (row for table in rows.values() if isinstance(table, list) for row in table):
        assert all(value is None or np.isscalar(value) for value in row.values())


class Axes:
    """What `plot` asks of axes, kept."""

    def __init__(self):
        self.calls = []

    def __getattr__(self, name):
        return lambda *args, **more: self.calls.append((name, args, more))


@pytest.mark.parametrize('name', CALLS)
def test_every_plot_is_drawn_on_axes(name, found):
    calls = {'line': 'plot', 'steps': 'plot', 'markers': 'plot', 'band': 'fill_between',
             'bars': 'errorbar'}
    plots = found[name].plots()
    assert plots
    for title, plot in plots.items():
        ax = Axes()
        assert found[name].plot(ax, title) is ax
        drawn = [call for call in ax.calls if call[0] in calls.values()]
        assert [call for call, _, _ in drawn] == [calls[curve.kind] for curve in plot.curves]
        for (_, args, more), curve in zip(drawn, plot.curves):
            np.testing.assert_array_equal(args[0], curve.x)
            assert more['label'] == (curve.label or None)
        (put,) = (more for call, _, more in ax.calls if call == 'set')
        assert (put['xlabel'], put['ylim']) == (plot.x_label, plot.y_range)
    with pytest.raises(InputError, match="no plot 'Voltages': did you mean|no plot 'Voltages'"):
        found[name].plot(Axes(), 'Voltages')


def test_without_the_extras_one_line_says_so(found, monkeypatch):
    """For a table, and for a figure of its own; axes of the user's need no import here."""
    for name in ('pandas', 'matplotlib'):
        monkeypatch.setitem(sys.modules, name, None)
    for call, words in ((found['analyze'].to_dataframe, 'pandas'),
                        (found['analyze'].plot, 'matplotlib')):
        with pytest.raises(InputError, match=rf'needs {words}: run pip install .*\[python\]'):
            call()


def test_results_convert_to_pandas_and_matplotlib(found):
    pandas, matplotlib = pytest.importorskip('pandas'), pytest.importorskip('matplotlib')
    matplotlib.use('Agg')
    for result in found.values():
        table = result.to_dataframe()
        assert isinstance(table, pandas.DataFrame) and len(table)
        for title in result.plots():
            assert result.plot(title=title).get_title() == title
            matplotlib.pyplot.close('all')


@pytest.mark.parametrize('name', CALLS)
def test_html_is_a_section_with_rules_of_its_own(name, found):
    """Well formed, without script; every rule of its style is nested in its class."""
    html = found[name]._repr_html_()
    root = ElementTree.fromstring(html.replace('<br>', '<br/>'))
    assert root.tag == 'div' and root.get('class') == 'ou-monitor'
    assert next(root.iter('svg')) is not None and not list(root.iter('script'))
    (style,) = root.iter('style')
    depth, outside = 0, ''
    for sign in style.text:
        depth += (sign == '{') - (sign == '}')
        outside += sign if not depth else ''
    assert re.sub(r'[\s}]', '', outside) == '.ou-monitor' and depth == 0
    assert not re.search(r'(^|[\s,}])(html|body|:root)\b', style.text)


def test_the_limit_of_a_log_holds_in_python_too(monkeypatch):
    """Its cells and lowest voltage, where no limit is given; a given one goes first."""
    t = np.arange(600) * 0.01
    log = Recording(t, 15.5 + 0.01 * np.sin(9.0 * t), np.full(t.size, 0.4), 'log',
                    {'log_cells': '4', 'log_cell_minimum': '3.5'})
    assert coupling(log, (t, np.cos(t * 40.0))).supply.dips.limit_v == 14.0
    for bare in (t, t[:2], t.tolist()):
        with pytest.raises(InputError, match=r'\(t, values\)'):
            coupling(log, bare)
    assert analyze(log).supply.dips.limit_v == 14.0
    assert analyze(log, cells=4).supply.dips.limit_v == pytest.approx(13.2)
    assert analyze(log, brownout_voltage=15.0).supply.dips.limit_v == 15.0
    with pytest.raises(InputError, match='likely 4 cells'):
        discover(log, cells=9)


@pytest.mark.parametrize('command', [analyze, compare, discover])
def test_arrays_beyond_any_supply_are_dropped_as_from_a_file(command):
    """With all of them gone, one line says so, or the verdict does; NumPy does not overflow."""
    t = np.arange(6000) / 100.0
    v = 1e200 * (5.0 + np.random.default_rng(0).normal(0.0, 0.1, t.size))
    try:
        said = str(command(Recording(t, v, np.full(t.size, np.nan), 'huge')).to_dict())
    except InputError as error:
        said = str(error)
    assert 'usable samples' in said or 'dropped' in said


@pytest.mark.parametrize('call, words', [
    (lambda: design(FLIGHT), 'got a str: pass a Recording or a path as recording='),
    (lambda: design(Recording([0.0, 1.0], [5.0, 5.1])), 'got a Recording: pass'),
    (lambda: analyze({'voltage': [5.0]}), 'a Recording or a path is needed, got a dict'),
    (lambda: analyze(FLIGHT, brownout_voltage='14 V'), "brownout_voltage must be .*'14 V'"),
    (lambda: analyze(FLIGHT, cells='4'), "cells must be a number, got '4'")])
def test_an_argument_of_a_wrong_type_is_named(call, words):
    with pytest.raises(TypeError, match=words):
        call()


def test_a_design_starts_from_the_voltage_without_throttle():
    """A robot draws 40 A at rest: 13 V less 0.8 V, and 1.2 V more at full throttle."""
    rng, t = np.random.default_rng(3), np.arange(6000) / 50.0
    throttle = np.clip(0.5 + 0.5 * np.sin(0.9 * t) + 0.1 * np.sin(5.1 * t), 0.0, 1.0)
    current = 40.0 + 60.0 * throttle + 0.5 * rng.standard_normal(t.size)
    voltage = 13.0 - 0.02 * current + 0.01 * rng.standard_normal(t.size)
    found = design(1.0, recording=Recording(t, voltage, throttle, current=current),
                   voltage=10.0, network={'cells': 0})
    assert found.rows[0].mean == pytest.approx(11.0, abs=0.15)


def test_two_numbers_of_cells_are_refused():
    with pytest.raises(InputError, match='4 and 5 are both given'):
        design(0.5, cells=4, network={'cells': 5})


@pytest.mark.parametrize('scale', [100.0, 2000.0])
def test_a_throttle_in_another_unit_is_refused(scale):
    """Percent and us, as the readers do; a single wild value is an error of its own."""
    t = np.arange(100) / 10.0
    throttle = 0.5 + 0.01 * (t % 3.0)
    supply_facts(Recording(t, 12.0 - throttle, np.where(t == 5.0, 50.0, throttle)))
    for function in (analyze, supply_facts):
        with pytest.raises(InputError, match='0 to 1 is expected.*percent'):
            function(Recording(t, 12.0 - throttle, scale * throttle))


def test_a_model_without_throttle_writes_none(tmp_path):
    """Unless one is named; a preset keeps its own."""
    model = SupplyModel((OU(63.0, 0.3, 5.0),))
    drawn = simulate(model, duration=2.0, rate=100.0, output=tmp_path / 'a.mcap')
    assert list(drawn.to_dict()['topics']) == ['/voltage'] and not drawn.recording.has_throttle
    assert simulate(model, duration=2.0, rate=100.0, throttle=0.4).recording.has_throttle
    assert simulate(preset='idle', duration=2.0).recording.has_throttle


def test_times_of_compare_count_from_the_first_sample():
    """Stamps are dates; the second half is simulated."""
    supply = read_recording(FLIGHT, **PART)
    dated = replace(supply, t=supply.t + 1.7e9)
    plot = compare(dated, seeds=20).plots()['Voltage, measured and simulated']
    low, high = (end(np.concatenate([curve.x for curve in plot.curves])) for end in (
        np.min, np.max))
    assert (low, high) == pytest.approx((2.0, 4.0), abs=0.1)
