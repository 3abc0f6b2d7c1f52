"""`ou-monitor design`: options in; table, sentence and JSON out; one line for bad input."""

from argparse import ArgumentTypeError
import json
import math
import re

from command_line import answer, failure, write_csv
import numpy as np
from ou_monitor import bench
from ou_monitor.cli.commands import quantity
from ou_monitor.cli.main import main
from ou_monitor.paper.design import row_of
from ou_monitor.paper.network import PowerNetwork, rail_at
from ou_monitor.recordings.read import read_recording
import pytest
from scipy import stats

QUESTION = ['design', '--risk', '1e-3', '--throttle', '0.4']


def told(capsys, *more):
    """Return the JSON of the question, with more options."""
    return answer(capsys, *QUESTION, *more)


def asked(capsys, *words):
    """Return the JSON of `design`."""
    return answer(capsys, 'design', *words)


def test_json_and_table_agree(capsys, tmp_path):
    """JSON alone on standard output; the same in a file, beside the table."""
    data = told(capsys)
    assert data['verdict'] == 'found' and data['brownout_voltage'] == pytest.approx(19.8)
    assert data['least']['risk'] == pytest.approx(1e-3, rel=1e-6)
    assert data['least']['alpha'] < data['present']['alpha']
    assert data['network']['bulk_capacitance'] == 470e-6
    file = tmp_path / 'design.json'
    assert main([*QUESTION, '--json', str(file)]) == 0
    assert data['answer'] in capsys.readouterr().out
    assert json.loads(file.read_text(encoding='utf-8')) == data


def test_an_option_overrides_the_file(capsys, tmp_path):
    """An option goes before the file, the file before the default."""
    file = tmp_path / 'frame.yaml'
    file.write_text('cells: 4\nbattery_voltage: 14.8\nbulk_capacitance: 1000uF\nbulk_esr: 2e-2\n',
                    encoding='utf-8')
    network = told(capsys, '--network', str(file), '--set', 'bulk_esr=15mOhm')['network']
    assert (network['cells'], network['battery_voltage']) == (4, 14.8)
    assert network['bulk_capacitance'] == pytest.approx(1e-3)
    assert network['bulk_esr'] == pytest.approx(0.015)
    assert network['current_max'] == PowerNetwork().current_max


def test_each_rail_has_its_own_level(capsys):
    assert told(capsys, '--rail', 'regulated')['brownout_voltage'] == 4.5
    given = told(capsys, '--voltage', '18.5', '--horizon', '60s', '--esr-fixed')
    assert (given['brownout_voltage'], given['horizon_s']) == (18.5, 60.0)
    assert {row['esr'] for row in given['rows']} == {0.03}
    narrow = told(capsys, '--capacitance-min', '100uF', '--capacitance-max', '1mF')
    assert narrow['verdict'] == 'out_of_range' and narrow['least'] is None
    assert [narrow['rows'][k]['capacitance'] for k in (0, -1)] == pytest.approx([1e-4, 1e-3])


def test_list_shows_every_component_with_its_unit(capsys):
    assert main(['design', '--list']) == 0
    out = capsys.readouterr().out
    assert re.search(r'^bulk_capacitance +0.00047  F$', out, re.MULTILINE)
    assert re.search(r'^line_gain +0.225225$', out, re.MULTILINE)
    assert len(out.splitlines()) == 2 + len(PowerNetwork.__dataclass_fields__)
    values = asked(capsys, '--list')
    assert values['bulk_capacitance'] == {'default': 470e-6, 'unit': 'F'}
    assert values.keys() == PowerNetwork.__dataclass_fields__.keys()


def test_a_missing_throttle_is_named(capsys):
    assert '--throttle is missing' in failure(capsys, 'design', '--risk=1e-3')


@pytest.mark.parametrize('more, words', [
    (['--throttle', '40'], 'write 40 % as 0.4'), (['--throttle', '40%'], 'write 40 % as 0.4'),
    (['--throttle', '-0.1'], 'throttle'), (['--throttle', 'nan'], 'between 0 and 1'),
    (['--risk', '1'], 'between 0 and 1'), (['--risk', '-1'], 'between 0 and 1'),
    (['--risk', '1e999'], 'between 0 and 1'), (['--voltage', '1e300'], 'not a number'),
    (['--set', 'cells=1e300'], 'not a number'), (['--horizon', '0'], 'horizon must be positive'),
    (['--horizon', '5V'], 'must be in s'), (['--voltage', 'low'], 'not a number'),
    (['--capacitance-min', '1F'], 'must be below the maximum'),
    (['--set', 'bulk_capacitance=470'], 'such as 470uF'), (['--set', 'bulk_esr=470'], '470mOhm'),
    (['--set', 'bulk_esr'], 'NAME=VALUE'), (['--set', 'bulk_capacitence=1'], 'bulk_capacitance'),
    (['--set', 'bulk_capacitance=0'], 'bulk_capacitance must be positive and finite, got 0.0 F'),
    (['--set', 'bulk_esr=-1mOhm'], 'bulk_esr must be zero or positive'),
    (['--set', 'bulk_esr=20mV'], 'must be in Ohm'), (['--set', 'cells=6V'], 'no unit'),
    (['--set', 'cells=5.5'], 'whole number'),
    (['--set', 'current_max=5000'], 'battery cannot supply the load'),
    (['--set', 'regulator_voltage=9', '--rail', 'regulated'], 'no default brown-out voltage'),
    (['--rail', 'motor'], 'invalid choice'), (['--network', 'none.yaml'], 'no file'),
    (['--json', 'no/such/folder.json'], 'does not exist'),
])
def test_bad_input_is_one_line(more, words, capsys):
    """Status 2, one line that names what to mend, nothing on standard output."""
    assert words in failure(capsys, *QUESTION, *more)


@pytest.mark.parametrize('text, words', [
    (b'[1, 2]', 'mapping'), (b'', 'mapping'), (b'cells: [', 'not readable YAML'),
    (b'\xff\xfe\x00', 'not readable YAML'), (b'celles: 4', "did you mean 'cells'"),
    (b'cells: [4]', 'not a number'), (b'cells: true', 'not a number'), (b'1: 2', 'unknown'),
    (b'line_gain: null', 'not a number'), (b'cells: .inf', 'not a number'),
    (b'bulk_esr: 2 V', 'must be in Ohm'), (b'[' * 5000, 'not readable YAML')])
def test_bad_network_files_are_one_line(text, words, capsys, tmp_path):
    file = tmp_path / 'frame.yaml'
    file.write_bytes(text)
    said = failure(capsys, *QUESTION, '--network', file)
    assert words in said and 'frame.yaml' in said


@pytest.mark.parametrize('text, unit, value', [
    ('470uF', 'F', 470e-6), ('470 µF', 'F', 470e-6), ('470u', 'F', 470e-6), ('1e-3', 'F', 1e-3),
    ('24kHz', 'Hz', 24e3), ('40mOhm', 'Ohm', 0.04), ('40 mohm', 'Ohm', 0.04), ('2Ω', 'Ohm', 2.0),
    ('33 1/s', '1/s', 33.0), ('.5', '', 0.5), (7, 'V', 7.0), ('-3V', 'V', -3.0)])
def test_quantities_are_read_with_prefix_and_unit(text, unit, value):
    assert quantity(unit)(text) == pytest.approx(value, rel=1e-14)


@pytest.mark.parametrize('text', [
    '', 'uF', '1e', '1..2', 'inf', 'nan', '1xF', '1 2', '\u0663', '9' * 100_000 + 'x', True, None])
def test_invalid_quantities_are_refused(text):
    with pytest.raises(ArgumentTypeError, match='is not a number|must'):
        quantity('F')(text)


@pytest.fixture(scope='module', autouse=True)
def flown_once():
    """Take the facts of a recording, nearly all of the time, once for all that is asked of it."""
    known = {}

    def once(recording, *limits):
        key = (recording.voltage.tobytes(), recording.throttle.tobytes(),
               recording.current is None, *limits)
        if key not in known:
            known[key] = take(recording, *limits)
        return known[key]

    take = bench._flight
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, '_flight', once)
        yield


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Return a flight of a 4S craft of 25 mOhm that draws 80 A at full throttle, noise 30 mV."""
    rng = np.random.default_rng(5)
    t = np.arange(2500) / 50.0
    u = 0.45 + 0.35 * np.sin(t / 1.3) * np.sin(t / 7.1)
    amps = 80.0 * u ** 1.5
    volts = 16.2 - 0.025 * amps + 0.03 * rng.standard_normal(t.size)
    return write_csv(tmp_path_factory.mktemp('flown') / 'flight.csv', t, volts, u, amps)


@pytest.fixture(scope='module')
def sagging(flight):
    """Return the JSON for that flight and a level that it reaches."""
    return bench.design(recording=flight, voltage=14.9).to_dict()


def test_a_flight_gives_the_network(flight, capsys):
    """Level, cells, resistance, current over throttle and noise are those that were flown."""
    found = asked(capsys, '--from', flight)
    network, present = found['network'], found['present']
    assert network['cells'] == 4 and network['battery_voltage'] == pytest.approx(16.2, abs=0.1)
    assert network['battery_resistance'] == pytest.approx(0.025, rel=0.1)
    assert network['current_max'] == pytest.approx(80.0, rel=0.15)
    assert network['current_exponent'] == pytest.approx(1.5, abs=0.2)
    assert found['throttle'] == pytest.approx(0.8, abs=0.02)
    assert present['var_inf'] == pytest.approx(0.03 ** 2, rel=0.2)
    assert present['mean'] == pytest.approx(16.2 - 0.025 * 80.0 * 0.8 ** 1.5, abs=0.15)
    assert found['brownout_voltage'] == pytest.approx(13.2) and '4 cells' in found['measured']


def test_an_unknown_sag_is_not_designed_with(tmp_path, capsys):
    """As of a stand whose inrush hides the sag: `analyze` calls it unknown too."""
    rng = np.random.default_rng(1)
    k = np.arange(200)
    path = write_csv(tmp_path / 'a.csv', k / 100.0, 16.0 + 0.3 * rng.standard_normal(k.size),
                     0.4 + 0.01 * (k > 150))
    assert 'the sag of a.csv is unknown' in failure(
        capsys, 'design', '--from', path, '--set', 'cells=4', '--throttle', '0.4')


def test_set_values_override_the_flight(flight, capsys):
    """Resistance and throttle; a number of cells that the voltage cannot have is refused."""
    found = asked(capsys, '--from', flight, '--set', 'battery_resistance=50mOhm', '--throttle',
                  '0.5', '--cells', '4', '--brownout-voltage', '3.2')
    assert found['brownout_voltage'] == pytest.approx(12.8)
    assert found['network']['battery_resistance'] == 0.05
    assert found['present']['sag'] == pytest.approx(0.05 * 80.0 * 0.5 ** 1.5, rel=0.15)
    assert 'it is likely 4' in failure(capsys, 'design', '--from', flight, '--set', 'cells=3')


def rail(tmp_path, volts, sag, rms, amperes=None):
    """Write 40 s of a rail, V, that falls by `sag` at full throttle, with a current if given."""
    rng = np.random.default_rng(2)
    u = np.repeat(rng.uniform(0.0, 1.0, 80), 50)
    v = volts - sag * u + rms * rng.standard_normal(u.size)
    return write_csv(tmp_path / 'rail.csv', np.arange(u.size) / 100.0, v, u,
                     None if amperes is None else amperes * u)


def test_a_voltage_that_fits_no_pack_is_a_rail(tmp_path, capsys):
    """Of 5 V, which falls by 60 mV at full throttle; a number of cells is refused."""
    path = rail(tmp_path, 5.02, 0.06, 0.009)
    assert asked(capsys, '--from', path)['brownout_voltage'] == 4.5
    found = asked(capsys, '--from', path, '--rail', 'regulated', '--brownout-voltage', '4.9')
    assert found['present']['mean'] == pytest.approx(5.02 - 0.06 * found['throttle'], abs=0.005)
    assert math.sqrt(found['present']['var_inf']) == pytest.approx(0.009, rel=0.2)
    assert found['network']['cells'] == 0 and 'packs' not in str(found)
    assert 'no number of charged lithium cells fits; for lead-acid, or a rail' in failure(
        capsys, 'design', '--from', path, '--cells', '1')


@pytest.mark.parametrize('volts, level, said', [
    (5.08, 4.5, '5 V rail in PX4'), (3.31, 2.88, 'STM32F405'), (6.0, 4.5, '5 V rail in PX4'),
    (12.0, 9.9, '3 cells guessed from the voltage: --cells N overrides it; for a rail')])
def test_a_recorded_rail_is_the_source(volts, level, said, tmp_path, capsys):
    """A regulator of 0.1 Ohm, up to 2 A: mean = level - R I, and one pole, 1 / ((R + ESR) C)."""
    path = rail(tmp_path, volts, 0.2, 0.003, amperes=2.0)
    found = asked(capsys, '--from', path)
    assert found['brownout_voltage'] == pytest.approx(level)
    assert said in found['brownout_voltage_source']
    if volts == 12.0:
        # It may as well be a pack, so only the user knows.
        assert 'guessed' not in asked(capsys, '--from', path, '--cells', '3')[
            'brownout_voltage_source']
        assert 'for a rail of 12 V' in failure(
            capsys, 'design', '--from', path, '--set', 'cells=0')
        found = asked(capsys, '--from', path, '--set', 'cells=0', '--voltage', '11.5')
    network, present = found['network'], found['present']
    assert (network['cells'], network['regulator_voltage']) == (0, 0.0)
    ohm = network['battery_resistance']
    assert ohm == pytest.approx(0.1, rel=0.1)
    assert present['sag'] == pytest.approx(0.2 * found['throttle'], rel=0.05)
    assert present['mean'] == pytest.approx(network['battery_voltage'] - present['sag'])
    assert present['mean'] == pytest.approx(volts - 0.2 * found['throttle'], abs=0.01)
    assert present['alpha'] == pytest.approx(1.0 / ((ohm + 0.03) * 470e-6), rel=1e-6)
    assert 'taken as a rail' in found['measured'] and 'packs' not in str(found)


def test_a_measured_current_is_the_load(tmp_path, capsys):
    """A rail of 0.1 Ohm, without throttle or with a flag that explains nothing."""
    rng = np.random.default_rng(2)
    amps = np.repeat(2.0 * rng.uniform(0.0, 1.0, 80), 50)
    path = write_csv(tmp_path / 'rail.csv', np.arange(amps.size) / 50.0, 5.0 - 0.1 * amps
                     + 0.003 * rng.standard_normal(amps.size), current=amps)
    found = asked(capsys, '--from', path)
    assert f'current divided by its maximum, {amps.max():.3g} A' in found['measured']
    assert found['network']['battery_resistance'] == pytest.approx(0.1, rel=0.1)
    assert found['present']['sag'] == pytest.approx(
        0.1 * amps.max() * found['throttle'], rel=0.1)
    assert 'no throttle and no current' in failure(
        capsys, 'design', '--from', path, '--current-column', 'none')
    flag = write_csv(tmp_path / 'flag.csv', *np.loadtxt(
        path, delimiter=',', skiprows=1, unpack=True)[:2], np.repeat(
            rng.uniform(size=20) > 0.5, 200).astype(float), current=amps)
    other = asked(capsys, '--from', flag)
    assert other['measured'][-80:] == found['measured'][-80:]
    assert other['present']['sag'] == pytest.approx(found['present']['sag'], rel=0.01)


def test_the_sag_of_a_small_pack_is_the_recorded_one(tmp_path, capsys):
    """The current of its regulator is in the recording, and full throttle has noise too."""
    rng = np.random.default_rng(4)
    u = np.tile(np.repeat([0.2, 0.6, 1.0, 0.4, 0.8], 100), 8)
    volts = 4.0 - 0.4 * u + 0.006 * rng.standard_normal(u.size)
    found = asked(capsys, '--from', write_csv(
        tmp_path / 'micro.csv', np.arange(u.size) / 100.0, volts, u))
    sag = dict(zip(found['supply']['sag']['throttle'], found['supply']['sag']['sag_v']))
    assert found['throttle'] == 1.0
    assert found['present']['sag'] == pytest.approx(sag[1.0], rel=1e-9)
    assert math.sqrt(found['present']['var_inf']) == pytest.approx(0.006, rel=0.2)


def test_cells_set_the_voltage(capsys):
    """3.7 V a cell, unless the voltage is given; a rail below that of one cell."""
    assert asked(capsys, '--throttle', '0.4', '--set', 'cells=4')['network'][
        'battery_voltage'] == pytest.approx(14.8)
    one = asked(capsys, '--throttle', '0.4', '--set', 'cells=1', '--set', 'current_max=5')
    assert one['network']['regulator_voltage'] == 3.0
    both = asked(capsys, '--throttle', '0.4', '--set', 'cells=4', '--set', 'battery_voltage=16')
    assert both['network']['battery_voltage'] == 16.0


def test_each_lever_shows_its_effect(flight, sagging, capsys):
    found = sagging
    levers = {one['name']: one for one in found['levers']}
    assert found['verdict'] == 'level' and levers['bulk capacitance']['least'] is None
    # 16.2 - 14.9 V of a sag of 1.43 V, less the errors and what throttle did not explain.
    assert levers['packs in parallel']['least'] == 2
    assert 0.5 < levers['battery and lead resistance']['least'] / 25.0 < 1.3 / 1.43
    assert levers['packs in parallel']['risk'] < 0.01 < found['present']['risk']
    risks = [found['present']['risk'], levers['battery and lead resistance']['risk'],
             levers['packs in parallel']['risk']]
    assert risks == sorted(risks, reverse=True)
    assert levers['throttle limit']['risk'] < found['present']['risk']
    limit = levers['throttle limit']['least'] / 100.0
    less = asked(capsys, '--from', flight, '--voltage', '14.9', '--throttle', f'{limit:.3f}')
    assert less['present']['mean'] > 14.9
    # Without a current the resistance is unknown, and shown as shares of the present one.
    shares = asked(capsys, '--from', flight, '--voltage', '14.9', '--current-column', 'none')
    ohm = shares['levers'][2]
    assert (ohm['unit'], ohm['present'], ohm['tried']) == ('%', 100.0, 75.0)
    none = asked(capsys, '--from', flight, '--voltage', '16.15')
    assert 'would be enough' in none['answer']
    assert all(one['least'] is None for one in none['levers'])


def test_a_row_of_the_table_is_the_run_with_that_value(flight, sagging, capsys):
    """Resistance, packs and throttle: each value and its risk, there and back."""
    def run(*more):
        return asked(capsys, '--from', flight, '--voltage', '14.9', *more)

    def ohms(value):
        return '--set', f'battery_resistance={value!r}'

    def lever(found, name):
        return next(one for one in found['levers'] if one['name'] == name)

    recorded = sagging
    ohm, risk = recorded['network']['battery_resistance'], recorded['present']['risk']
    for name, share in (('battery and lead resistance', 0.75), ('packs in parallel', 0.5)):
        there, back = run(*ohms(share * ohm)), run(*ohms(ohm / share))
        assert there['present']['risk'] == pytest.approx(lever(recorded, name)['risk'], rel=1e-6)
        assert there['present']['risk'] < risk < back['present']['risk']
        assert lever(back, name)['risk'] == pytest.approx(risk, rel=1e-6)
        assert there['present']['sag'] == pytest.approx(share * recorded['present']['sag'])
    needed = lever(recorded, 'battery and lead resistance')['least'] / 1e3
    assert run(*ohms(needed))['present']['risk'] == pytest.approx(0.01, rel=1e-3)
    u, limit = recorded['throttle'], lever(recorded, 'throttle limit')['risk']
    assert run('--throttle', repr(0.8 * u))['present']['risk'] == pytest.approx(limit, rel=1e-6)
    back = run('--throttle', repr(u / 0.8))
    assert lever(back, 'throttle limit')['risk'] == pytest.approx(risk, rel=1e-6)
    # A higher level is a lower limit.
    level = recorded['network']['battery_voltage']
    full = run('--set', f'battery_voltage={level + 0.3!r}')
    lower = asked(capsys, '--from', flight, '--voltage', '14.6')
    assert full['present']['risk'] == pytest.approx(lower['present']['risk'], rel=0.02)


def test_a_capacitor_of_the_recorded_craft_is_stated(flight, sagging, capsys):
    """It was there: the risk of the flight stays, and the table begins at it."""
    plain = sagging
    stated = asked(
        capsys, '--from', flight, '--voltage', '14.9', '--set', 'bulk_capacitance=940uF')
    assert stated['present']['capacitance'] == pytest.approx(940e-6)
    assert stated['present']['risk'] == pytest.approx(plain['present']['risk'], rel=1e-9)
    # Without a current, so is the resistance.
    plain, stated = (asked(capsys, '--from', flight, '--voltage', '14.9', '--current-column',
                           'none', *more)
                     for more in ((), ('--set', 'battery_resistance=20mOhm')))
    assert [one['risk'] for one in stated['levers'][1:]] == pytest.approx(
        [one['risk'] for one in plain['levers'][1:]], rel=1e-9)


@pytest.mark.parametrize('resistance', ['20mOhm', '40mOhm'])
def test_a_row_of_a_network_is_the_run_with_that_value(resistance, capsys):
    """Without a recording, also the capacitance: the same network, so the same risk."""
    def run(throttle, **values):
        return asked(capsys, '--throttle', throttle, '--set', f'battery_resistance={resistance}',
                     *(word for name, value in values.items()
                       for word in ('--set', f'{name}={value!r}')))

    first = run(0.3)
    levers = {one['name']: one for one in first['levers']}
    ohm = first['network']['battery_resistance']
    for name, other in (
            ('bulk capacitance', run(0.3, bulk_capacitance=940e-6, bulk_esr=0.015)),
            ('packs in parallel', run(0.3, battery_resistance=0.5 * ohm)),
            ('battery and lead resistance', run(0.3, battery_resistance=0.75 * ohm)),
            ('throttle limit', run(0.24))):
        assert levers[name]['risk'] == pytest.approx(other['present']['risk'], rel=1e-6), name
    back = run(0.3, bulk_capacitance=235e-6, bulk_esr=0.06)
    assert back['levers'][0]['risk'] == pytest.approx(first['present']['risk'], rel=1e-6)


@pytest.mark.parametrize('limit, risk', [(14.9, 0.01), (14.9, 0.05), (16.15, 0.01)])
def test_the_throttle_limit_is_the_budget_of_analyze(limit, risk, flight, capsys):
    """One answer of both commands, and the one facts of a supply."""
    found = asked(capsys, '--from', flight, '--voltage', limit, '--risk', risk)
    supply = answer(capsys, 'analyze', flight, '--brownout-voltage', limit)['supply']
    budget = found['supply']['budget']
    if risk == budget['risk'] == supply['budget']['risk']:
        assert found['supply'] == supply
    least = next(one for one in found['levers'] if one['name'] == 'throttle limit')['least']
    assert (least is None) == (budget['throttle'] == 0.0) == (limit > 16.0)
    if least is not None:
        assert least == pytest.approx(100.0 * budget['throttle'])
        # At the other risk it lies beyond.
        assert (budget['throttle'] > supply['budget']['throttle']) == (risk > 0.01)


def test_outliers_are_left_out_as_in_analyze(flight, tmp_path, capsys):
    """Three dips by a loose connector had doubled the risk of `design` only."""
    read = read_recording(flight)
    volts = read.voltage.copy()
    for begin in (700, 1300, 2100):
        volts[begin:begin + 3] -= 4.0
    path = write_csv(tmp_path / 'loose.csv', read.t, volts, read.throttle, read.current)
    found = asked(capsys, '--from', path, '--voltage', 14.9, '--risk', 0.01)
    supply = answer(capsys, 'analyze', path, '--brownout-voltage', 14.9)['supply']
    assert supply['dips']['count'] > 3 and found['supply'] == supply


def test_the_error_of_the_sag_counts():
    network = PowerNetwork(switching_scale=0.0, flutter=0.0)
    sag = row_of(rail_at(network, 0.4), 1.0, 5.0).sag
    mean = row_of(rail_at(network, 0.4), 1.0, 5.0).mean
    for share, errors in ((0.1, 3.0), (0.2, 1.0), (0.05, -1.0)):
        row = row_of(rail_at(network, 0.4), mean - errors * share * sag, 5.0, share)
        quiet = rail_at(network, 0.4).var_inf
        # Its noise, if any, is small beside the error.
        assert quiet < (0.05 * share * sag) ** 2
        assert row.risk == pytest.approx(stats.norm.sf(errors), rel=0.05)
    # Without noise the integral is empty, and with it the risks agree where the error is small.
    noisy = PowerNetwork()
    plain, near = (row_of(rail_at(noisy, 0.3), 19.8, 5.0, error) for error in (0.0, 1e-4))
    assert near.risk == pytest.approx(plain.risk, rel=0.02)
    assert near.mean_time == pytest.approx(plain.mean_time, rel=0.02)
