"""`ou-monitor coupling`: columns and topics in, table and JSON out, bad input one line."""

import json
import re

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.model.ou import simulate
from ou_monitor.recordings.bag import BagWriter
import pytest

RATE, GAIN = 250.0, 25.0
IMU = """\
std_msgs/Header header
geometry_msgs/Vector3 angular_velocity
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
================================================================================
MSG: geometry_msgs/Vector3
float64 x
float64 y
float64 z
"""


@pytest.fixture(scope='module')
def series():
    """Return stamps, voltage, throttle, a coupled gyro axis and one that is not."""
    rng = np.random.default_rng(1)
    t = np.arange(int(20 * RATE)) / RATE
    throttle = np.where(t < 10.0, 0.1, 0.4)
    supply = simulate(t, 63.0, 0.6, rng)
    return (t, 5.0 - 0.3 * throttle + supply, throttle,
            GAIN * supply + 0.5 * rng.standard_normal(t.size), rng.standard_normal(t.size))


@pytest.fixture(scope='module')
def table(series, tmp_path_factory):
    """Return a CSV with extra columns."""
    path = tmp_path_factory.mktemp('csv') / 'gyro.csv'
    np.savetxt(path, np.column_stack(series), '%.9g', ',', comments='',
               header='time_s,voltage_v,throttle,gyro_x,gyro_y')
    return path


@pytest.fixture(scope='module')
def bag(series, tmp_path_factory):
    """Return a bag with a gyro of a type that the package does not know."""
    t, voltage, throttle, x, y = (column.tolist() for column in series)
    path = tmp_path_factory.mktemp('bag') / 'gyro.mcap'
    with BagWriter(path) as writer:
        writer.add_topic('/voltage', 'std_msgs/msg/Float32')
        writer.add_topic('/throttle', 'std_msgs/msg/Float32')
        writer.add_topic('/imu', 'some_msgs/msg/Gyro', schema=IMU)
        for k, stamp in enumerate(t):
            at = round(1e9 * stamp) + 10**9
            time = {'sec': at // 10**9, 'nanosec': at % 10**9}
            writer.write('/voltage', at, {'data': voltage[k]})
            writer.write('/throttle', at, {'data': throttle[k]})
            # Logged 3 ms late: the stamp in the message counts.
            writer.write('/imu', at + 3_000_000, {
                'header': {'stamp': time, 'frame_id': ''},
                'angular_velocity': {'x': x[k], 'y': y[k], 'z': 0.0}})
    return path


def found(capsys, *argv):
    """Run; return the JSON."""
    assert main(['coupling', *map(str, argv), '--json', '-']) == 0
    out, err = capsys.readouterr()
    assert err == ''
    return json.loads(out)


def failure(capsys, *argv):
    """Run a command that must fail; return its one line."""
    assert main(['coupling', *map(str, argv)]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert re.fullmatch(r'ou-monitor( coupling)?: [^\n]+\n', err)
    return err


def test_column_and_field_path_say_the_same(table, bag, capsys):
    """The gain is within its interval from either file."""
    one = found(capsys, table, '--signal', 'gyro_x')
    other = found(capsys, bag, '--signal', '/imu/angular_velocity.x')
    for data in (one, other):
        low, high = data['gain_ci95']
        assert data['seen'] and low <= GAIN <= high and high - low < 0.2 * GAIN
        assert abs(data['lag_s']) < 0.5e-3 and data['throttle_taken_out']
    # Voltage of the bag is float32.
    assert other['gain_per_v'] == pytest.approx(one['gain_per_v'], rel=1e-3)


def test_a_part(table, bag, capsys):
    """--from and --to: only that part of both series counts, whatever the file."""
    for path, signal in ((table, 'gyro_x'), (bag, '/imu/angular_velocity.x')):
        data = found(capsys, path, '--signal', signal, '--from', '4', '--to', '16')
        low, high = data['gain_ci95']
        assert data['duration_s'] == pytest.approx(12.0, abs=0.1) and low <= GAIN <= high
        assert data['dropped'] == {'voltage': 0, 'signal': 0}
        assert any('from 4 s to 16 s' in note for note in data['notes'])
    assert "--to: '-1'" in failure(capsys, table, '--signal', 'gyro_x', '--to', '-1')


def test_none_is_said_with_the_limit(table, capsys):
    """In words and as null."""
    data = found(capsys, table, '--signal', 'gyro_y')
    assert not data['seen'] and data['gain_per_v'] is None
    assert 0.0 < data['gain_limit_per_v'] < GAIN
    assert main(['coupling', str(table), '--signal', 'gyro_y']) == 0
    text = capsys.readouterr().out
    assert 'No coupling detected' in text and 'would have been detected' in text
    assert max(map(len, text.splitlines())) <= 100


def test_seen_is_said_in_words(table, capsys):
    """Gain, interval, lag."""
    assert main(['coupling', str(table), '--signal', 'gyro_x', '--band', '10,60']) == 0
    text = capsys.readouterr().out
    assert 'Coupling detected' in text and 'per V' in text and '10..60 Hz' in text


@pytest.mark.parametrize('options, words', [
    (['--signal', 'gyro_q'], 'gyro_'), (['--signal', 'time_s'], 'not a signal'),
    (['--signal', ''], 'empty'), (['--signal', 'gyro_x', '--band', '5'], 'LOW,HIGH'),
    (['--signal', 'gyro_x', '--band', '9,5'], 'LOW < HIGH'),
    (['--signal', 'gyro_x', '--band', '5,90'], 'good up to'),
    (['--signal', 'gyro_x', '--level', '2'], '--level'), ([], '--signal'),
    (['--signal', 'gyro_x', '--json', '/nowhere/x.json'], '/nowhere'),
])
def test_bad_input_is_one_line(table, options, words, capsys):
    """With the option or the nearest name."""
    if not options:
        assert main(['coupling', str(table)]) == 2
        assert words in capsys.readouterr().err
        return
    assert words in failure(capsys, table, *options)


@pytest.mark.parametrize('signal, words', [
    ('/imu', 'name the field'), ('/im/x', "did you mean '/imu'"),
    ('/imu/angular_velocity.w', 'angular_velocity'), ('/imu/angular_velocity', 'not a number'),
    ('/imu/header..x', 'form'),
])
def test_a_signal_that_a_bag_lacks_is_one_line(bag, signal, words, capsys):
    """Topic, field and path."""
    assert words in failure(capsys, bag, '--signal', signal)
