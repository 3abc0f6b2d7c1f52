"""`ou-monitor coupling`: columns and topics in; table and JSON out; one line for bad input."""

from command_line import answer, failure
from made_bags import encode
from made_logs import blackbox
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.model.ou import simulate
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.standard_types import FLOAT32
from pages import self_contained
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
            writer.write('/voltage', at, encode(FLOAT32, {'data': voltage[k]}))
            writer.write('/throttle', at, encode(FLOAT32, {'data': throttle[k]}))
            # Logged 3 ms late: the stamp in the message counts.
            writer.write('/imu', at + 3_000_000, encode('some_msgs/msg/Gyro', {
                'header': {'stamp': time, 'frame_id': ''},
                'angular_velocity': {'x': x[k], 'y': y[k], 'z': 0.0}}, IMU))
    return path


def found(capsys, *argv):
    return answer(capsys, 'coupling', *argv)


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


def test_a_csv_with_other_names_and_units_is_read(series, tmp_path, capsys):
    path = tmp_path / 'other.csv'
    t, voltage, throttle, x, _ = series
    np.savetxt(path, np.column_stack([1e3 * t, 1e3 * voltage, throttle, x]), '%.9g', ',',
               comments='', header='ms,mv,duty,gyro')
    data = found(capsys, path, '--signal', 'gyro', '--time-column', 'ms', '--time-unit', 'ms',
                 '--voltage-column', 'mv', '--unit', 'mV', '--throttle-column', 'duty')
    assert data['seen'] and data['gain_ci95'][0] <= GAIN <= data['gain_ci95'][1]
    assert 'not a signal' in failure(capsys, 'coupling', path, '--signal', 'ms',
                                     '--time-column', 'ms', '--voltage-column', 'mv')


def test_only_the_part_asked_for_counts(table, bag, capsys):
    """--from and --to: only that part of both series counts, whatever the file."""
    for path, signal in ((table, 'gyro_x'), (bag, '/imu/angular_velocity.x')):
        data = found(capsys, path, '--signal', signal, '--from', '4', '--to', '16')
        low, high = data['gain_ci95']
        assert data['duration_s'] == pytest.approx(12.0, abs=0.1) and low <= GAIN <= high
        assert data['dropped'] == {'voltage': 0, 'signal': 0}
        assert any('from 4 s to 16 s' in note for note in data['notes'])
    assert "--to: '-1'" in failure(capsys, 'coupling', table, '--signal', 'gyro_x', '--to', '-1')


def test_no_coupling_is_reported_with_the_detectable_gain(table, capsys):
    data = found(capsys, table, '--signal', 'gyro_y')
    assert not data['seen'] and data['gain_per_v'] is None
    assert 0.0 < data['gain_limit_per_v'] < GAIN
    assert main(['coupling', str(table), '--signal', 'gyro_y']) == 0
    text = capsys.readouterr().out
    assert 'No supply noise is detected in gyro_y' in text
    assert 'would have been' in ' '.join(text.split())
    assert text.index('No supply noise') < text.index('Chance') < text.index('Lowest voltage')
    assert max(map(len, text.splitlines())) <= 100


def test_the_page_says_what_the_text_says(table, tmp_path, capsys):
    target = tmp_path / 'coupling.html'
    assert main(['coupling', str(table), '--signal', 'gyro_x', '--brownout-voltage', '4.9',
                 '--report', str(target)]) == 0
    said = capsys.readouterr().out
    assert said.splitlines()[-1] == f'Report: {target}'
    html = target.read_text(encoding='utf-8')
    text = ' '.join(' '.join(self_contained(html).itertext()).split())
    answer = said.split('\n\n')[1].replace('\n', ' ')
    assert answer in text and 'limit 4.9 V' in text
    assert html.index(answer) < html.index('>Voltage<') < html.index('Below 4.9 V') < (
        html.index('Coherence of voltage and signal'))
    # Not again without being asked to.
    assert 'exists already: --force' in failure(
        capsys, 'coupling', table, '--signal', 'gyro_x', '--report', target)


@pytest.mark.parametrize('options, words', [
    (['--signal', 'gyro_q'], 'gyro_'), (['--signal', 'time_s'], 'not a signal'),
    (['--signal', ''], 'empty'), (['--signal', 'gyro_x', '--band', '5'], 'LOW,HIGH'),
    (['--signal', 'gyro_x', '--band', '9,5'], 'LOW < HIGH'),
    (['--signal', 'gyro_x', '--band', '5,90'], 'usable up to'),
    (['--signal', 'gyro_x', '--level', '2'], '--level'), ([], '--signal'),
    (['--signal', 'gyro_x', '--json', '/nowhere/x.json'], '/nowhere'),
])
def test_bad_input_is_one_line(table, options, words, capsys):
    assert words in failure(capsys, 'coupling', table, *options)


@pytest.mark.parametrize('signal, words', [
    ('/imu', 'name the field'), ('/im/x', "did you mean '/imu'"),
    ('/imu/angular_velocity.w', 'angular_velocity'), ('/imu/angular_velocity', 'not a number'),
    ('/imu/header..x', 'form'),
])
def test_a_signal_that_a_bag_lacks_is_one_line(bag, signal, words, capsys):
    assert words in failure(capsys, 'coupling', bag, '--signal', signal)


def test_a_log_is_taken_as_it_is(tmp_path, capsys):
    """A series of a blackbox, its refresh of the voltage, its part; what is missing."""
    rng = np.random.default_rng(4)
    n, held = 10_000, 4
    t = 0.002 * np.arange(n)
    supply = 100 * simulate(t, 20.0, 1.5, rng)
    volts = np.repeat(np.rint(1600 + supply[::held]), held)[:n]
    gyro = np.rint(1000 + 0.2 * supply + 2 * rng.standard_normal((3, n)))
    fields = ('loopIteration', 'time', 'vbatLatest', 'motor[0]',
              *(f'gyroADC[{k}]' for k in range(3)))
    rows = np.column_stack([np.arange(n), 10**6 + 2000 * np.arange(n), volts,
                            rng.integers(100, 2100, n), gyro.T])
    path = tmp_path / 'a.bbl'
    path.write_bytes(b''.join(blackbox(rows, fields, {'gyro_scale': '0x3f800000'})))
    expected = 20.0 * np.pi / 180.0
    data = found(capsys, path, '--signal', 'gyroADC[1]', '--from', '2')
    # Against the steps of the held voltage the gain were less, and the signal 3 ms ahead.
    assert data['seen'] and data['gain_per_v'] == pytest.approx(expected, rel=0.03)
    assert abs(data['lag_s']) < 0.5e-3 and data['signal_unit'] == 'rad/s'
    assert data['voltage_rate_hz'] == pytest.approx(125.0, rel=0.01)
    assert data['duration_s'] < 18.1
    for arguments, words in (
            (['--signal', 'gyroADC[9]'], "did you mean 'gyroADC["),
            (['--signal', '/imu/linear_acceleration.x'], 'see convert LOG --list'),
            (['--signal', 'motor[0]', '--msg-config', 'x'], 'is for bags'),
            (['--signal', 'motor[0]', '--flight', '2'], 'no flight 2'),
            (['--signal', 'motor[0]', '--from', '90'], 'holds no sample')):
        assert words in failure(capsys, 'coupling', path, *arguments)
