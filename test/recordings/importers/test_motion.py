"""Gyros, accelerometers, motor speeds and named series of logs, also converted to a bag."""

import json

from made_logs import blackbox, Dataflash, load, named, px4_flight, quad, ulog
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import (
    choose_extras, gap_notes, topic_of)
from ou_monitor.recordings.importers.log import clean, gyro_of, IMU, Log, Series, SPEEDS
from ou_monitor.recordings.read import read_signal
import pytest

FIELDS = ('loopIteration', 'time', 'rcCommand[3]', 'vbatLatest', 'amperageLatest', 'motor[0]',
          'motor[1]', *(f'gyroADC[{k}]' for k in range(3)), *(f'accSmooth[{k}]' for k in range(3)),
          *(f'debug[{k}]' for k in range(4)), 'eRPM[0]', 'eRPM[1]')
HEADERS = {'gyro_scale': '0x3f800000', 'acc_1G': '2048', 'motor_poles': '12',
           'debug_mode': '6'}
DEGREE = np.pi / 180.0


def frames(n=400):
    """Return rows of a flight with whole numbers from 0 on, and its moving part."""
    rng = np.random.default_rng(6)
    moving = rng.integers(0, 2000, (n, 12))
    return np.column_stack([quad(n), moving]), moving


@pytest.mark.parametrize('headers, gyro, force', [
    ({}, DEGREE, 9.80665 / 2048),
    ({'blackbox_high_resolution': '1'}, DEGREE / 10.0, 9.80665 / 2048),
    ({'acc_1G': '512'}, DEGREE, 9.80665 / 512),
    ({'gyro_scale': '0x3d79c190'}, DEGREE / 16.4, 9.80665 / 2048),
    # Baseflight: rad/us, here of 16.4 LSB to a degree a second.
    ({'gyro_scale': '0x30924418'}, DEGREE / 16.4, 9.80665 / 2048),
    ({'acc_1G': None}, DEGREE, None),
])
def test_blackbox_is_scaled_by_its_header(tmp_path, headers, gyro, force):
    """Gyro in rad/s and acceleration in m/s^2; series without a scale are left out with a note."""
    rows, moving = frames()
    path, log = load(tmp_path, blackbox(rows, FIELDS, {**HEADERS, **headers}))
    one = choose_extras(path, log)[0]['imu']
    np.testing.assert_allclose(one.values[:, :3], moving[:, :3] * gyro, rtol=1e-4)
    if force is None:
        assert one.values.shape[1] == 3 and any('acc_1G' in note for note in log.notes)
    else:
        np.testing.assert_allclose(one.values[:, 3:], moving[:, 3:6] * force, rtol=1e-12)


def test_a_gyro_without_scale_is_left_out(tmp_path):
    rows, _ = frames()
    path, log = load(tmp_path, blackbox(rows, FIELDS, {**HEADERS, 'gyro_scale': None,
                                                       'debug_mode': '3'}))
    assert log.of(IMU) == [] and any('gyro_scale' in note for note in log.notes)
    assert any('no topic /imu' in note for note in choose_extras(path, log)[1])
    found = named(log)
    assert found['gyroADC[0]'].unit == '?'


@pytest.mark.parametrize('firmware, mode, shown', [
    ('Betaflight 4.3.1 (x)', '6', True), ('Betaflight 4.3.1 (x)', '5', False),
    ('Betaflight 4.6.0 (x)', '6', False), ('INAV 6.1.1 (x)', '6', False)])
def test_debug_fields_are_a_gyro_only_where_they_are(tmp_path, firmware, mode, shown):
    """By firmware and mode; in deg/s whatever gyro_scale says."""
    rows, moving = frames(100)
    headers = {**HEADERS, 'Firmware revision': firmware, 'debug_mode': mode}
    path, log = load(tmp_path, blackbox(rows, FIELDS, headers))
    assert ('debug' in [one.name for one in log.of(IMU)]) == shown
    if shown:
        one = choose_extras(path, log, imu='debug')[0]['imu']
        np.testing.assert_allclose(one.values[:, :3], moving[:, 6:9] * DEGREE, rtol=1e-12)


def test_erpm_needs_the_poles(tmp_path):
    """Of the header, or of the user; else it is left out with the remedy."""
    rows, moving = frames(100)
    speed = moving[:, 10:12] * 100.0 / 60.0 * 2.0 * np.pi
    _, log = load(tmp_path, blackbox(rows, FIELDS, HEADERS))
    np.testing.assert_allclose(log.of(SPEEDS)[0].values, speed / 6.0, rtol=1e-12)
    assert log.of(SPEEDS)[0].name == 'motor_0, motor_1' and '12 poles' in log.of(SPEEDS)[0].words
    content = blackbox(rows, FIELDS, {**HEADERS, 'motor_poles': None})
    _, log = load(tmp_path, content)
    assert log.of(SPEEDS) == [] and any('--poles' in note for note in log.notes)
    _, log = load(tmp_path, content, poles=14)
    np.testing.assert_allclose(log.of(SPEEDS)[0].values, speed / 7.0, rtol=1e-12)


COMBINED = [('uint64_t', 'timestamp'), ('float[3]', 'gyro_rad'),
            ('float[3]', 'accelerometer_m_s2')]


def test_ulog_is_turned_to_base_link(tmp_path):
    """Front, right, down becomes front, left, up; rotors by the ESCs' rpm."""
    topics, t, *_ = px4_flight(100)
    rng = np.random.default_rng(7)
    values = np.float32(rng.standard_normal((100, 6)))
    topics += [('sensor_combined', 0, COMBINED, [(int(a), *b) for a, b in zip(t, values)]),
               ('sensor_gyro', 1, [('uint64_t', 'timestamp'), ('float', 'x'), ('float', 'y'),
                                   ('float', 'z')],
                [(int(a), *b[:3]) for a, b in zip(t, values)])]
    path, log = load(tmp_path, ulog(topics), 'a.ulg')
    chosen, notes = choose_extras(path, log)
    one = chosen['imu']
    np.testing.assert_allclose(one.values[:, :3], values[:, :3] * [1, -1, -1], rtol=1e-6)
    np.testing.assert_allclose(one.values[:, 3:], values[:, 3:] * [1, -1, -1], rtol=1e-6)
    assert any('sensor_gyro[1]' in note for note in notes)
    other = choose_extras(path, log, imu='sensor_gyro[1]')[0]['imu']
    assert other.values.shape[1] == 3
    found = named(log)
    assert found['sensor_combined[0].gyro_rad[1]'].unit == 'rad/s'
    assert found['sensor_combined[0].accelerometer_m_s2[2]'].unit == 'm/s^2'


def test_dataflash_states_units_and_holds_escs(tmp_path):
    log_file = Dataflash()
    log_file.form(3, 'BAT', 'QBf', 'TimeUS,Inst,Volt')
    log_file.form(4, 'IMU', 'QBffffff', 'TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ')
    log_file.form(5, 'ESC', 'QBf', 'TimeUS,Instance,RPM')
    rng = np.random.default_rng(8)
    values = np.float32(rng.standard_normal((2, 100, 6)))
    for k in range(100):
        at = 1_000_000 + 10_000 * k
        log_file.put('BAT', at, 0, 12.0 + k % 3)
        for instance in range(2):
            log_file.put('IMU', at, instance, *values[instance, k])
            log_file.put('ESC', at + 3_000 * instance, instance, 600.0 * (1 + instance) + k)
    path, log = load(tmp_path, log_file.binary, 'a.bin')
    extras, _ = choose_extras(path, log, imu='IMU[1]', signals=['IMU[1].GyrZ'])
    np.testing.assert_allclose(choose_extras(path, log)[0]['imu'].values[:, 3:],
                               values[0, :, 3:] * [1, -1, -1], rtol=1e-6)
    np.testing.assert_allclose(extras['imu'].values[:, :3],
                               values[1, :, :3] * [1, -1, -1], rtol=1e-6)
    series = extras['IMU_1/GyrZ']
    np.testing.assert_allclose(series.values, values[1, :, 2], rtol=1e-6)
    assert series.unit == 'rad/s'
    # The second reports 3 ms later: its last report holds.
    rpm = log.of(SPEEDS)[0].values * 30.0 / np.pi
    np.testing.assert_allclose(rpm[5], [605.0, 1204.0], rtol=1e-6)


def test_topics_and_units_of_a_converted_log(tmp_path, capsys):
    rows, moving = frames()
    path, _ = load(tmp_path, blackbox(rows, FIELDS, HEADERS))
    assert main(['convert', str(path), '--list', '--json', '-']) == 0
    listed = json.loads(capsys.readouterr().out)
    units = {one['name']: one['unit'] for one in listed['series']}
    assert (units['gyroADC[1]'], units['accSmooth[0]'], units['loopIteration']) == (
        'rad/s', 'm/s^2', '?')
    assert [(one['name'], one['default']) for one in listed['imu']] == [
        ('gyroADC', True), ('debug', False)]
    out = str(tmp_path / 'bag')
    assert main(['convert', str(path), out, '--signal', 'debug[3]', '--signal', 'gyroADC[2]',
                 '--json', '-']) == 0
    said = json.loads(capsys.readouterr().out)
    assert said['topics'] == {
        '/voltage': 'sensor_msgs/msg/BatteryState', '/throttle': 'std_msgs/msg/Float32',
        '/current': 'std_msgs/msg/Float32', '/imu': 'sensor_msgs/msg/Imu',
        '/motor_speed': 'sensor_msgs/msg/JointState', '/debug_3': 'std_msgs/msg/Float64',
        '/gyroADC_2': 'std_msgs/msg/Float64'}
    assert any('debug[3]: the log does not state its unit' in note for note in said['notes'])
    found = read_signal(out, '/imu/angular_velocity.z')
    np.testing.assert_allclose(found.values, moving[:, 2] * DEGREE, rtol=1e-12)
    np.testing.assert_allclose(found.t, 0.002 * np.arange(len(rows)), atol=1e-8)
    np.testing.assert_allclose(read_signal(out, '/gyroADC_2').values, found.values,
                               rtol=1e-12)
    np.testing.assert_allclose(read_signal(out, '/motor_speed/velocity[1]').values,
                               moving[:, 11] * 100 / 60 * 2 * np.pi / 6, rtol=1e-12)
    assert [read_signal(out, name).own_unit for name in (
        '/imu/linear_acceleration.x', '/gyroADC_2', '/debug_3', '/motor_speed/velocity[0]')] == [
            'm/s^2', 'rad/s', '?', 'rad/s']


@pytest.mark.parametrize('arguments, words', [
    (['--signal', 'gyroADC[7]'], "did you mean 'gyroADC["),
    (['--signal', 'what'], '--list'),
    (['--imu', 'gyro'], "did you mean 'gyroADC'"),
    (['--poles', '7'], 'even number'),
])
def test_missing_series_are_refused_in_one_line(tmp_path, capsys, arguments, words):
    rows, _ = frames(100)
    path, _ = load(tmp_path, blackbox(rows, FIELDS, HEADERS))
    try:
        status = main(['convert', str(path), str(tmp_path / 'bag'), *arguments])
    except SystemExit as end:
        status = end.code
    said = capsys.readouterr()
    assert status == 2 and words in said.err and said.err.count('\n') == 1
    assert not (tmp_path / 'bag').exists()


def test_bad_rows_and_gaps():
    """Rows with NaN or backward stamps are dropped; pauses are reported."""
    t = np.concatenate([np.arange(100) * 0.001, 0.5 + np.arange(100) * 0.004])
    gyro = np.ones((200, 3))
    gyro[5, 1], t[50] = np.nan, 0.02
    one, notes = clean(next(gyro_of('g', t, gyro, None, '1', '')))
    assert one.values.shape == (198, 3) and (np.diff(one.t) > 0.0).all()
    assert any('1 sample dropped: not a finite' in note for note in notes)
    assert gap_notes(one.t) == ('1 gap of up to 0.401 s.',)
    assert gap_notes(np.arange(100) * 0.01) == ()


@pytest.mark.parametrize('name, topic', [
    ('gyroADC[0]', 'gyroADC_0'), ('IMU[1].GyrX', 'IMU_1/GyrX'), ('5 V rail', 'n5_V_rail'),
    ('..', 'unnamed'), ('a--b', 'a_b')])
def test_topics_are_names_that_ros_takes(name, topic):
    assert topic_of(name) == topic


def test_a_signal_never_takes_an_existing_topic(tmp_path):
    """A column called throttle is written beside the throttle."""
    t = np.arange(3.0)
    log = Log('csv', tuple(Series(name, 'any', t, t, '1') for name in ('throttle', 'a.b', 'a/b')))
    found, _ = choose_extras(tmp_path, log, signals=['throttle', 'a.b', 'a/b'])
    assert [*found] == ['signal/throttle', 'a/b', 'a_b']
    with pytest.raises(InputError, match='has no series'):
        choose_extras(tmp_path, log, signals=['c'])
