"""`convert`, and logs read directly: a log, its bag and a CSV of it give the same numbers."""

import json
import os
from pathlib import Path
import resource
import signal
import subprocess
import sys

from made_logs import blackbox, copter, px4_flight, quad, ulog
from mcap.reader import make_reader
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose, columns_of
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.read import read_beside, read_recording, read_signal
from ou_monitor.timeline import readings_of
from project import needs_recordings, REAL, ROOT
import pytest
import yaml

GOOD = 'time_s,voltage_v,throttle\n0.5,5.0,0.1\n0.6,5.1,0.1\n0.6,5.2,0.2\n0.7,5.3,0.3\n'


@pytest.fixture
def log(tmp_path):
    path = tmp_path / 'log.csv'
    path.write_text(GOOD)
    return path


@pytest.mark.parametrize('name', ['out', 'out.mcap'])
def test_a_converted_log_reads_back(log, tmp_path, capsys, name):
    """The bag reads back, and repairs are reported."""
    out = tmp_path / name
    assert main(['convert', str(log), str(out)]) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert '3 samples' in text and '- voltage_v, throttle: 1 sample dropped' in text
    back = read_recording(out)
    np.testing.assert_allclose(back.t, [0.5, 0.6, 0.7], rtol=0, atol=1e-9)
    np.testing.assert_allclose(back.voltage, [5.0, 5.1, 5.3], rtol=1e-7)
    np.testing.assert_allclose(back.throttle, [0.1, 0.1, 0.3], rtol=1e-7)


def test_json_goes_to_standard_output_or_a_file(log, tmp_path, capsys):
    assert main(['convert', str(log), str(tmp_path / 'a'), '--json', '-']) == 0
    content = json.loads(capsys.readouterr().out)
    assert content['n'] == 3
    assert content['topics'] == {'/voltage': 'sensor_msgs/msg/BatteryState',
                                 '/throttle': 'std_msgs/msg/Float32'}
    assert content['duration_s'] == pytest.approx(0.2)
    assert len(content['notes']) == 1
    target = tmp_path / 'b.json'
    assert main(['convert', str(log), str(tmp_path / 'b'), '--json', str(target)]) == 0
    assert json.loads(target.read_text())['out'] == str(tmp_path / 'b')


@pytest.mark.parametrize('log_text, arguments, words', [
    (None, ['no.csv', 'out'], ["no log 'no.csv'"]),
    (GOOD, ['log.csv', 'log.csv'], ['.mcap', 'folder']),
    (GOOD, ['log.csv', 'there'], ['exists already']),
    (GOOD, ['log.csv', 'no/out'], ['does not exist']),
    (GOOD, ['log.csv', '/sys/out.mcap'], ['cannot write']),
    (GOOD, ['log.csv', 'out', '--json', 'no/x.json'], ['no/x.json']),
    ('when,voltage_v\n0,5\n', ['log.csv', 'out'], ["'time_s'"]),
    ('', ['log.csv', 'out'], ['empty']),
    ('', ['log.ulg', 'out'], ["'log.ulg' is empty"]),
    ('\0\1\2', ['log', 'out'], ['ULog', 'dataflash', 'blackbox', 'CSV', 'can be read']),
    (GOOD, ['log.csv'], ['required: OUT']),
    (GOOD, ['log.csv', 'out', '--list'], ['--list writes no bag']),
    (GOOD, ['log.csv', '--list', 'out'], ['--list writes no bag']),
    (GOOD, ['log.csv', 'out', '--flight', '2'], ['holds one flight']),
    (GOOD, ['log.csv', 'out', '--flight', '0'], ["'0'"]),
    (GOOD, ['log.csv', 'out', '--voltage', 'volts'], ["no voltage 'volts'", 'voltage_v']),
    (GOOD, ['log.csv', 'out', '--voltage', 'throttle'], ['is a throttle']),
    ('time_s,volts\n0,5\n1,5\n', ['log.csv', 'out', '--list', 'x'], ['further argument']),
    ('time_s,voltage_v\n', ['log.csv', 'out'], ['no line below']),
    ('time_s,voltage_v\n1.7e12,5\n1.8e12,5\n', ['log.csv', 'out'],
     ["1e+11 s apart by 'time_s'", 'in ms']),
    ('time_s,voltage_v,throttle\n0,5,400\n1,5,500\n', ['log.csv', 'out'],
     ['throttle runs from 400 to 500', '--throttle-unit LOW:HIGH']),
    ('time_s,bus\n0,5\n1,5\n', ['log.csv', 'out'], ["no column 'voltage_v'", '--voltage']),
])
def test_bad_input_exits_with_2(tmp_path, monkeypatch, capsys, log_text, arguments, words):
    """Exit status 2, one line on standard error, no bag."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'there').mkdir()
    if log_text is not None:
        (tmp_path / arguments[0]).write_text(log_text)
    try:
        status = main(['convert', *arguments])
    except SystemExit as end:
        status = end.code
    captured = capsys.readouterr()
    assert status == 2
    assert captured.out == ''
    assert captured.err.count('\n') == 1
    for word in words:
        assert word in captured.err
    assert not (tmp_path / 'out').exists()


def test_file_name_of_invalid_text(tmp_path, capsys):
    path = os.path.join(os.fsencode(tmp_path), b'\xff.csv')
    Path(os.fsdecode(path)).write_text(GOOD)
    for out in ('out', 'out.mcap', os.fsdecode(b'\xfe'), os.fsdecode(b'\xfe.mcap')):
        assert main(['convert', os.fsdecode(path), str(tmp_path / out), '--json', '-']) == 0
        assert json.loads(capsys.readouterr().out)['log'] == os.fsdecode(path)
        source = read_recording(tmp_path / out).source
        assert source['log_file'] == '\\udcff.csv'


def test_columns_of_a_csv(tmp_path, capsys):
    path = tmp_path / 'a.csv'
    path.write_text('time_s,bus,duty,amps,word\n0,5.0,0.1,2,x\n1,5.1,0.2,3,y\n2,5.2,0.3,4,z\n')
    assert main(['convert', str(path), '--list']) == 0
    text = ' '.join(capsys.readouterr().out.split())
    assert all(word in text for word in ('bus', 'duty', 'amps', "'word' does not hold numbers"))
    assert main(['convert', str(path), '--voltage', 'bus', str(tmp_path / 'b'), '--throttle',
                 'duty', '--current', 'amps']) == 0
    back = read_recording(tmp_path / 'b')
    np.testing.assert_allclose(back.voltage, [5.0, 5.1, 5.2], rtol=1e-7)
    np.testing.assert_allclose(back.throttle, [0.1, 0.2, 0.3], rtol=1e-7)
    assert back.source['voltage_field'] == 'bus'
    np.testing.assert_allclose(read_signal(tmp_path / 'b', '/current/data').values, [2, 3, 4])


# -- logs read directly

@needs_recordings
@pytest.mark.parametrize('file,rate', [('in_xr_141340.TXT', 49.47), ('ie_btfl_002.bbl', 199.1)])
def test_one_flight_as_log_csv_and_bag_is_one_recording(file, rate, tmp_path):
    pytest.importorskip('orangebox')
    path = tmp_path / file
    # Seconds are enough: the reader of blackbox logs takes one for each 300 kB.
    path.write_bytes((REAL / 'raw' / file).read_bytes()[:500_000])
    log = import_log(path, Request())
    raw = columns_of(path, log, choose(path, log))
    sheet, bag = tmp_path / 'flight.csv', tmp_path / 'flight.mcap'
    sheet.write_text('time_s,voltage_v,throttle,current_a\n' + ''.join(
        '{!r},{!r},{!r},{!r}\n'.format(*line) for line in np.stack(
            [raw.t, raw.voltage, raw.throttle, raw.current], axis=1).tolist()))
    assert main(['convert', str(path), str(bag)]) == 0
    wanted = read_recording(path)
    assert wanted.held > 0 and wanted.n + wanted.held == raw.t.size
    for one in (sheet, bag):
        found = read_recording(one)
        assert found.held == wanted.held
        # One reading more or less of 315.
        assert (found.n - 1) / found.duration == pytest.approx(rate, rel=1.0 / 315)
        for name in ('t', 'voltage', 'throttle', 'current'):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    if wanted.n > 5000:
        return
    answers = []
    for one in (path, sheet, bag):
        # Only a log states cells and a limit of its own.
        assert main(['analyze', str(one), '--cells', '4', '--brownout-voltage', '2.5', '--json',
                     str(tmp_path / 'out.json'), '--force']) == 0
        answers.append(json.loads((tmp_path / 'out.json').read_text()))
        # How the file was read differs (`quality` holds the notes on that too), nothing else.
        for name in ('recording', 'source', 'notes', 'quality'):
            del answers[-1][name]
    assert answers[0] == answers[1] == answers[2]
    assert 'sag' in json.dumps(answers[0])


@pytest.mark.parametrize('options,words', [
    (['--flight', '2'], 'is a CSV: --flight is for logs'),
    (['--unit', 'kV'], 'invalid choice'),
    (['--voltage-column', 'volts'], "no column 'volts'")])
def test_options_that_do_not_fit_are_refused(options, words, tmp_path, capsys):
    path = tmp_path / 'a.csv'
    path.write_text('time_s,voltage_v\n0,5\n1,5\n')
    try:
        status = main(['analyze', str(path), *options])
    except SystemExit as stop:
        status = stop.code
    assert status == 2 and words in capsys.readouterr().err


def test_suspicious_units_and_columns_are_noted(tmp_path):
    path = tmp_path / 'odd.csv'
    path.write_text('time_s,voltage_v,throttle\n0,0.1,16.1\n1,0.2,16.0\n2,0.2,15.9\n')
    with pytest.raises(InputError, match='are the two columns swapped'):
        read_recording(path)
    path.write_text('time_s,voltage_v\n0,16.1\n20,16.0\n40,15.9\n')
    assert any('20 s apart' in note and '--time-unit' in note
               for note in read_recording(path).notes)
    with pytest.raises(InputError, match="fleet' takes folders"):
        read_recording(tmp_path)


# -- logs that are made here

ROWS = quad(400, refresh=1)


def px4():
    """Return a ULog, and (stamps, values) of voltage, throttle, current."""
    topics, t, volts, motors, amperes = px4_flight()
    zero = t[0] - 500_000
    return (b''.join(ulog(topics, start_us=int(zero), info={'sys_name': 'PX4'})),
            ((t - zero) * 1e-6, volts), ((t + 1000 - zero) * 1e-6, motors),
            ((t - zero) * 1e-6, amperes),
            ('battery_status[0].voltage_v', 'actuator_motors[0]', 'battery_status[0].current_a'),
            'PX4')


def ardupilot():
    """Return a dataflash log, and its content."""
    made, t, volts, share, amperes, _ = copter()
    return (made.binary, (t, volts[0]), (t + 5e-4, share), (t, amperes),
            ('BAT[0].Volt', 'CTUN.ThO', 'BAT[0].Curr'), 'ArduCopter V4.5.1 (abcd1234)')


def betaflight():
    """Return a blackbox log, and its content."""
    t = (ROWS[:, 1] - ROWS[0, 1]) * 1e-6
    return (b''.join(blackbox(ROWS)), (t, ROWS[:, 3] / 100),
            (t, (ROWS[:, 5:7].mean(axis=1) - 100) / 2000), (t, ROWS[:, 4] / 100),
            ('vbatLatest', 'motors', 'amperageLatest'), 'Betaflight 4.3.0 (abc) STM32F405')


@pytest.mark.parametrize('log', [px4, ardupilot, betaflight])
@pytest.mark.parametrize('name', ['out', 'out.mcap'])
def test_log_to_bag_and_back(tmp_path, log, name):
    content, volts, throttle, amperes, fields, firmware = log()
    path, out = tmp_path / 'a.log', tmp_path / name
    path.write_bytes(content)
    assert main(['convert', str(path), str(out)]) == 0
    back = read_recording(out)
    np.testing.assert_allclose(back.t, volts[0], rtol=0, atol=2e-9)
    np.testing.assert_array_equal(back.voltage, volts[1].astype(np.float32))
    # The throttle holds from its own stamp on.
    last = np.searchsorted(np.rint(throttle[0] * 1e6), np.rint(volts[0] * 1e6), 'right') - 1
    held = np.where(last >= 0, throttle[1][last].astype(np.float32), np.nan)
    np.testing.assert_array_equal(back.throttle, held)
    current = read_signal(out, '/current/data')
    np.testing.assert_allclose(current.t, amperes[0], rtol=0, atol=2e-9)
    np.testing.assert_array_equal(current.values, amperes[1].astype(np.float32))
    assert tuple(back.source[f'{name}_field'] for name in (
        'voltage', 'throttle', 'current')) == fields
    # Read directly, whole and in part, the log holds the same samples.
    own = read_recording(path)
    for key in ('t', 'voltage', 'throttle', 'current'):
        np.testing.assert_array_equal(getattr(own, key), getattr(back, key))
    assert 0 < read_recording(path, start=0.1, end=0.3).duration <= 0.2
    assert not any('cut off' in note or 'damaged' in note for note in back.notes)
    assert back.source['voltage_unit'] == 'V' and back.source['throttle_unit'] == '0..1'
    assert back.source['log_firmware'] == firmware
    assert back.source['log_file'] == 'a.log'
    assert back.source['log_time'] == 's from the start of the log'


def analyzed(path, json_file):
    """Return the JSON of `analyze`, without what names the file and what else it holds."""
    assert main(['analyze', str(path), '--json', str(json_file), '--force']) == 0
    data = json.loads(json_file.read_text())
    for name in ('recording', 'source'):
        del data[name]
    data['notes'] = [note for note in data['notes'] if not note.startswith('Also in the log')]
    data['quality'] = [one for one in data['quality']
                       if not one['text'].startswith('Also in the log')]
    return data


def test_a_log_and_its_bag_give_one_json(tmp_path):
    """One reading of 10 frames is one sample, whichever way the log is read, and to the digit."""
    path, out = tmp_path / 'a.bbl', tmp_path / 'bag'
    rows = quad(6000, refresh=10)
    path.write_bytes(b''.join(blackbox(rows)))
    assert main(['convert', str(path), str(out)]) == 0
    found = analyzed(path, tmp_path / 'a.json')
    assert found == analyzed(out, tmp_path / 'a.json')
    assert found['n'] == 599 and found['rate_hz'] == pytest.approx(50.0)
    log, bag = read_recording(path), read_recording(out)
    for one, other in ((log.t, bag.t), (log.voltage, bag.voltage),
                       (log.throttle, bag.throttle), (log.current, bag.current)):
        np.testing.assert_array_equal(one, other)
    # Of those between, the throttle at the reading; since when the first one held is not known.
    share = (rows[:, 5:7].mean(axis=1) - 100) / 2000
    np.testing.assert_array_equal(log.throttle, share.astype(np.float32)[10::10])


def test_a_signal_of_a_log_and_of_its_bag_is_one(tmp_path):
    path, out = tmp_path / 'a.bbl', tmp_path / 'bag'
    fields = ('loopIteration', 'time', 'rcCommand[3]', 'vbatLatest', 'amperageLatest',
              'motor[0]', 'motor[1]', *(f'gyroADC[{k}]' for k in range(3)))
    rows = np.column_stack([quad(3000, refresh=10),
                            np.random.default_rng(2).integers(0, 900, (3000, 3))])
    path.write_bytes(b''.join(blackbox(rows, fields, {'gyro_scale': '0x3f800000'})))
    assert main(['convert', str(path), str(out)]) == 0
    (log, own), (bag, converted) = (
        read_beside(one, name) for one, name in (
            (path, 'gyroADC[1]'), (out, '/imu/angular_velocity.y')))
    assert log.n == bag.n == 3000
    np.testing.assert_array_equal(readings_of(log).t, read_recording(path).t)
    share = (rows[:, 5:7].mean(axis=1) - 100) / 2000
    np.testing.assert_array_equal(log.throttle, share.astype(np.float32))
    np.testing.assert_array_equal(log.throttle, bag.throttle)
    np.testing.assert_array_equal(log.voltage, bag.voltage)
    np.testing.assert_array_equal(log.current, bag.current)
    assert own.n == 3000 and own.unit == converted.unit == 'rad/s'
    np.testing.assert_allclose(own.t, converted.t, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(own.values, converted.values)


def test_a_fleet_is_grouped_by_the_vehicle_of_its_logs(tmp_path, one_process):
    path, logs = tmp_path / 'a.log', tmp_path / 'logs'
    logs.mkdir()
    for k, name in enumerate(('one', 'two.mcap', 'three.mcap', 'four', 'five')):
        # None the copy of another.
        path.write_bytes(b''.join(blackbox(ROWS[:400 - 20 * k])))
        assert main(['convert', str(path), str(logs / name)]) == 0
    cut = (logs / 'three.mcap').read_bytes()
    (logs / 'three.mcap').write_bytes(cut[:len(cut) * 9 // 10])
    for folder, before, after in (
            # What a person writes into the table holds; without one the file still tells.
            ('four', 'log_vehicle: Maker', 'vehicle: my own'),
            ('five', 'log_vehicle: Maker', 'other: thing')):
        table = logs / folder / 'metadata.yaml'
        assert before in table.read_text()
        table.write_text(table.read_text().replace(before, after))
    assert main(['fleet', str(logs), '--output', str(tmp_path / 'out'), '--partial', '--json',
                 str(tmp_path / 'a.json')]) == 0
    rows = json.loads((tmp_path / 'a.json').read_text())['rows']
    assert {Path(row['path']).name: row['vehicle'] for row in rows} == {
        'one': 'Maker', 'two.mcap': 'Maker', 'three.mcap': 'Maker', 'four': 'my own',
        'five': 'Maker'}


def test_the_bag_of_a_log_says_where_it_is_from(tmp_path):
    """In its custom data, as rosbag2 reads them, a map from text to text; and in the file."""
    path, out = tmp_path / 'a.log', tmp_path / 'bag'
    path.write_bytes(betaflight()[0])
    assert main(['convert', str(path), str(out)]) == 0
    info = yaml.safe_load((out / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    custom = info['custom_data']
    assert custom and all(isinstance(k, str) and isinstance(v, str) for k, v in custom.items())
    assert custom['voltage_field'] == 'vbatLatest' and custom['current_unit'] == 'A'
    with (out / 'bag_0.mcap').open('rb') as file:
        records = [one for one in make_reader(file).iter_metadata() if one.name == 'ou_monitor']
    assert [one.metadata for one in records] == [custom]


LIMIT = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({size}, {size}))
from ou_monitor.cli.main import main
sys.exit(main(['convert', {log!r}, {out!r}]))
"""


@pytest.mark.parametrize('size', [0, 12_000])
@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_a_full_disk_gives_one_line_and_no_bag(tmp_path, name, size):
    """Whichever byte the disk refuses, one line reports it and no file stays behind."""
    assert hasattr(resource, 'RLIMIT_FSIZE') and hasattr(signal, 'SIGXFSZ')
    path, out = tmp_path / 'a.log', tmp_path / name
    path.write_bytes(b''.join(blackbox(quad(3000))))
    done = subprocess.run(
        [sys.executable, '-c', LIMIT.format(size=size, log=str(path), out=str(out))],
        cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count('\n') == 1 and 'cannot write' in done.stderr
    assert not out.exists()
