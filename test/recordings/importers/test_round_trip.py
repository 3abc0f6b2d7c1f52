"""A log converted to a bag gives the same numbers, and the bag states their origin."""

import json
from pathlib import Path
import resource
import signal
import subprocess
import sys

from made_logs import blackbox, copter, px4_flight, quad, ulog
from mcap.reader import make_reader
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.recordings.read import (
    read_beside, read_recording, read_signal)
from ou_monitor.timeline import readings_of
from project import ROOT
import pytest
import yaml

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
