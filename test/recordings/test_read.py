"""Bags -> Recording: topics, stamps, currents and repairs."""

import subprocess
import sys

from made_bags import encode, encode_block
from mcap.writer import Writer
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_scalars, FLOAT32, FLOAT32_ARRAY, FLOAT64,
    SCHEMAS)
from project import ROOT
import pytest

MS = 1_000_000
STRING = 'std_msgs/msg/String'
PX4_BATTERY, PX4_STICK = 'px4_msgs/msg/BatteryStatus', 'px4_msgs/msg/ManualControlSetpoint'
TEXT = {
    STRING: 'string data\n',
    PX4_BATTERY: 'uint64 timestamp\nbool connected\nfloat32 voltage_v\n',
    PX4_STICK: 'uint64 timestamp\nfloat32 roll\nfloat32 throttle\n',
}


def make(path, *topics):
    """Write (name, type, [(t_ns, message), ...]) each."""
    with BagWriter(path) as bag:
        for name, kind, messages in topics:
            bag.add_topic(name, kind, schema=TEXT.get(kind))
            for t, message in messages:
                bag.write(name, t, encode(kind, message, TEXT.get(kind)) if isinstance(
                    message, dict) else message)
    return path


def scalars(values, kind=FLOAT32, start=MS, step=MS):
    return [(start + k * step, data) for k, data in enumerate(encode_scalars(kind, values))]


def battery(stamps, values, late=5 * MS):
    """Return BatteryStates logged later than their stamps."""
    stamps = np.array(stamps, dtype=np.int64)
    return [(int(t) + late, data) for t, data in zip(stamps, encode_battery(stamps, values))]


def complaint(path, **options):
    """Return the one line with which a bag is refused."""
    with pytest.raises(InputError) as caught:
        read_recording(path, **options)
    assert '\n' not in str(caught.value)
    return str(caught.value)


def with_metadata(path, name, content):
    """Write a bag with a metadata record of another program."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2', library='test')
        writer.add_metadata(name, content)
        schema = writer.register_schema(FLOAT32, 'ros2msg', b'float32 data')
        channel = writer.register_channel('/voltage', 'cdr', schema)
        throttle = writer.register_channel('/throttle', 'cdr', schema)
        for t, data in scalars([0.5, 0.5]):
            writer.add_message(throttle, t, data, t)
            writer.add_message(channel, t, data, t)
        writer.finish()
    return path


@pytest.mark.parametrize('partial', [False, True])
@pytest.mark.parametrize('name, content, vehicle', [
    ('ou_monitor', {'vehicle': 'uav7', 'file': 'x'}, 'uav7'),
    ('ou_monitor', {'log_vehicle': 'uav7'}, 'uav7'),
    ('ou_monitor', {'log_vehicle': 'uav7', 'vehicle': 'uav8'}, 'uav8'),
    ('other', {'vehicle': 'uav7'}, None)])
def test_the_vehicle_of_a_bag(tmp_path, name, content, vehicle, partial):
    """It comes from the metadata of the bag, unless an unknown program wrote them."""
    found = read_recording(with_metadata(tmp_path / 'a.mcap', name, content), partial=partial)
    assert found.source.get('vehicle') == vehicle and found.notes == ()
    assert found.source['file'] == 'a.mcap'


def test_unreadable_metadata_is_ignored_or_refused(tmp_path):
    """The messages are still read, and a note says what is unknown."""
    path = with_metadata(tmp_path / 'a.mcap', 'ou_monitor', {'vehicle': 'uav7'})
    content = path.read_bytes()
    path.write_bytes(content.replace(b'uav7', b'uav\xff', 1))
    found = read_recording(path)
    assert found.n == 2 and 'vehicle' not in found.source
    assert len(found.notes) == 1 and 'Metadata of a.mcap cannot be read' in found.notes[0]
    found = read_recording(path, partial=True)
    assert 'vehicle' not in found.source and 'metadata record' in ' '.join(found.notes)


@pytest.mark.parametrize('kind, config', [(FLOAT32, 'std_float32'), (FLOAT64, 'std_float64')])
def test_scalar_topics_are_stamped_by_log_time(tmp_path, kind, config):
    path = make(tmp_path / 'bag.mcap', ('voltage', kind, scalars([5.0, 5.5, 4.5], kind)),
                ('throttle', FLOAT32, scalars([0.25, 0.75], start=2 * MS)))
    recording = read_recording(path)
    np.testing.assert_allclose(recording.t, [1e-3, 2e-3, 3e-3], rtol=0, atol=1e-12)
    assert recording.voltage.tolist() == [5.0, 5.5, 4.5]
    np.testing.assert_array_equal(recording.throttle, [np.nan, 0.25, 0.75])
    assert recording.source['msg_config'] == config
    assert recording.source['voltage_topic'] == '/voltage'
    assert recording.source['throttle_topic'] == '/throttle'
    assert recording.notes == ()


def test_samples_of_a_block_end_at_its_stamp(tmp_path):
    """Samples are spread over the time before the stamp of their block; NaN keeps its place."""
    blocks = [[5.0] * 100, [5.0] * 99 + [np.nan], [4.0] * 100]
    path = make(tmp_path / 'bag.mcap', ('voltage', FLOAT32_ARRAY, [
        (10 * MS * (k + 1), encode_block(block)) for k, block in enumerate(blocks)]))
    recording = read_recording(path)
    assert recording.n == 299
    expected = np.delete(np.arange(1, 301) * 1e-4, 199)
    np.testing.assert_allclose(recording.t, expected, rtol=0, atol=1e-9)
    assert recording.voltage[-100:].tolist() == [4.0] * 100
    assert any(note.startswith('1 sample dropped') for note in recording.notes)


def test_a_gap_between_blocks_is_noted(tmp_path):
    path = make(tmp_path / 'bag.mcap', ('voltage', FLOAT32_ARRAY, [
        (t * MS, encode_block([5.0] * 100)) for t in (10, 20, 1020)]))
    recording = read_recording(path)
    assert any('1 gap' in note for note in recording.notes)
    assert np.diff(recording.t).max() == pytest.approx(0.9901, abs=1e-6)


def px4(tmp_path, version=''):
    """Write a bag as PX4 gives it: stamps in microseconds, the stick -1..1."""
    return make(
        tmp_path / 'px4.mcap',
        ('/fmu/out/battery_status' + version, PX4_BATTERY, [
            (k * MS, {'timestamp': 1000 * k, 'connected': True, 'voltage_v': 16.0 + k})
            for k in range(1, 4)]),
        ('/fmu/out/manual_control_setpoint', PX4_STICK, [
            (k * MS, {'timestamp': 1000 * k, 'roll': 0.3, 'throttle': k - 2.0})
            for k in range(1, 4)]))


@pytest.mark.parametrize('version, config', [('_v1', 'px4'), ('', 'px4_1_16')])
def test_a_type_that_is_not_installed_is_read(tmp_path, version, config):
    recording = read_recording(px4(tmp_path, version))
    assert recording.source['msg_config'] == config
    np.testing.assert_allclose(recording.t, [1e-3, 2e-3, 3e-3], rtol=0, atol=1e-12)
    assert recording.voltage.tolist() == [17.0, 18.0, 19.0]
    assert recording.throttle.tolist() == [0.0, 0.5, 1.0]


def test_in_a_namespace(tmp_path):
    """A topic that ends with the config's is meant; the throttle is the one beside it."""
    path = make(tmp_path / 'bag.mcap', ('/uav1/voltage', FLOAT32, scalars([5.0, 5.1])),
                ('/uav1/throttle', FLOAT32, scalars([0.5])),
                ('/uav2/throttle', FLOAT32, scalars([0.9])))
    recording = read_recording(path)
    assert recording.source['voltage_topic'] == '/uav1/voltage'
    assert recording.throttle.tolist() == [0.5, 0.5]
    path = make(tmp_path / 'two.mcap', ('/uav1/voltage', FLOAT32, scalars([5.0])),
                ('/uav2/voltage', FLOAT32, scalars([6.0])))
    text = complaint(path)
    assert '/uav1/voltage, /uav2/voltage' in text and '--voltage-topic' in text
    assert read_recording(path, voltage_topic='uav2/voltage').voltage.tolist() == [6.0]


def test_by_type_alone(tmp_path):
    path = make(tmp_path / 'bag.mcap', ('/power/state', BATTERY_STATE, battery([MS], [12.0])),
                ('/throttle', FLOAT32, scalars([0.5])))
    assert read_recording(path).voltage.tolist() == [12.0]
    path = make(tmp_path / 'throttle.mcap', ('/throttle', FLOAT32, scalars([0.5])))
    assert 'no topic looks like a supply voltage' in complaint(path)


def test_two_fitting_configs_need_a_choice(tmp_path):
    path = make(tmp_path / 'bag.mcap', ('/voltage', FLOAT32, scalars([5.0])),
                ('/mavros/battery', BATTERY_STATE, battery([MS], [12.0])))
    text = complaint(path)
    for word in ('std_float32', 'mavros', '--msg-config', '/mavros/battery', BATTERY_STATE):
        assert word in text
    assert read_recording(path, msg_config='mavros').voltage.tolist() == [12.0]
    assert read_recording(path, voltage_topic='/voltage').voltage.tolist() == [5.0]


def test_missing_topics_are_refused(tmp_path):
    """The existing topics are listed; for a misspelt topic the nearest is suggested."""
    path = make(tmp_path / 'bag.mcap', ('/camera', STRING, [(MS, {'data': 'x'})]))
    text = complaint(path)
    assert 'no topic looks like' in text and '/camera (std_msgs/msg/String)' in text
    text = complaint(path, msg_config='px4')
    assert "'/fmu/out/battery_status_v1'" in text and '/camera (std_msgs/msg/String)' in text
    assert "did you mean '/camera'" in complaint(path, voltage_topic='camer')
    assert "did you mean '/camera'" in complaint(path, throttle_topic='camer')
    assert "no msg config 'px5'" in complaint(path, msg_config='px5')


def test_an_unexpected_type_is_refused(tmp_path):
    """The error names the type in the bag and the expected one."""
    path = make(tmp_path / 'bag.mcap', ('/voltage', STRING, [(MS, {'data': '5 V'})]))
    assert '/voltage (std_msgs/msg/String)' in complaint(path)
    text = complaint(path, msg_config='std_float32')
    assert STRING in text and FLOAT32 in text and '--msg-config' in text
    assert STRING in complaint(path, msg_config='std_float32', voltage_topic='/voltage')


def test_throttle_by_name(tmp_path):
    """A throttle topic may be named; a Float64 one is read too; a foreign type is refused."""
    path = make(tmp_path / 'bag.mcap', ('/voltage', FLOAT32, scalars([5.0])),
                ('/rc/thr', FLOAT64, scalars([0.5], FLOAT64)),
                ('/name', STRING, [(MS, {'data': 'x'})]))
    recording = read_recording(path)
    assert not recording.has_throttle and '--throttle-topic' in recording.notes[0]
    assert read_recording(path, throttle_topic='/rc/thr').throttle.tolist() == [0.5]
    assert STRING in complaint(path, throttle_topic='/name')


def test_an_own_config_is_read(tmp_path):
    kind = 'my_msgs/msg/Pack'
    TEXT[kind] = 'Cell[] cells\n' + 80 * '=' + '\nMSG: my_msgs/Cell\nint32 mv\n'
    path = make(tmp_path / 'bag.mcap', ('/pack', kind, [
        (MS, {'cells': [{'mv': 0}, {'mv': -4200}]}), (2 * MS, {'cells': []}),
        (3 * MS, {'cells': [{'mv': 0}, {'mv': -4000}]})]))
    (tmp_path / 'pack.yaml').write_text(
        'description: a pack\npackage: my_msgs\ninstall: my_msgs\ngeneric: false\n'
        f'voltage:\n  topic: /pack\n  type: {kind}\n  field: cells[1].mv\n'
        '  unit_factor: 0.001\n  sign: -1\n  offset: 0.5\n')
    recording = read_recording(path, msg_config=tmp_path / 'pack.yaml')
    np.testing.assert_allclose(recording.voltage, [4.7, 4.5], rtol=1e-12)
    assert any(note.startswith('1 sample dropped') for note in recording.notes)
    text = (tmp_path / 'pack.yaml').read_text().replace('cells[1].mv', 'cells[1].volts')
    (tmp_path / 'pack.yaml').write_text(text)
    assert "no 'volts'" in complaint(path, msg_config=tmp_path / 'pack.yaml')


@pytest.mark.parametrize('kind', [FLOAT32, BATTERY_STATE])
def test_repairs_are_noted(tmp_path, kind):
    values = [5.0, np.nan, 5.2, np.inf, 5.1, 9.0, 5.5, 2e6]
    stamps = np.array([1, 2, 4, 5, 3, 3, 6, 7]) * MS
    if kind == FLOAT32:
        # By log time a bag is always in order: only repeats can be.
        stamps = np.array([1, 2, 3, 4, 5, 5, 6, 7]) * MS
        messages = list(zip(stamps.tolist(), encode_scalars(kind, values)))
    else:
        messages = [(int(k + 1) * MS, data)
                    for k, data in enumerate(encode_battery(stamps, values))]
    recording = read_recording(make(tmp_path / 'bag.mcap', ('voltage', kind, messages)))
    notes = ' '.join(recording.notes)
    assert '3 samples dropped: not a finite number, or beyond 1e+06 V' in notes
    assert '1 sample dropped: repeated stamp' in notes
    assert ('came after' in notes) == (kind == BATTERY_STATE)
    expected = [5.0, 5.2, 5.1, 5.5] if kind == FLOAT32 else [5.0, 5.1, 5.2, 5.5]
    np.testing.assert_allclose(recording.voltage, expected, rtol=1e-7)
    assert (np.diff(recording.t) > 0).all()


def test_a_bag_with_no_sample_is_refused_and_one_is_enough(tmp_path):
    path = make(tmp_path / 'nan.mcap', ('voltage', FLOAT32, scalars([np.nan, np.inf])))
    assert 'no usable sample: 2 samples dropped' in complaint(path)
    path = make(tmp_path / 'nan2.mcap', ('voltage', BATTERY_STATE, battery([MS], [np.nan])))
    assert 'no usable sample: 1 sample dropped' in complaint(path)
    path = make(tmp_path / 'one.mcap', ('voltage', FLOAT32, scalars([5.0])))
    assert read_recording(path).n == 1


def test_throttle_of_nan_is_unknown(tmp_path):
    path = make(tmp_path / 'bag.mcap', ('voltage', FLOAT32, scalars([5.0, 5.1, 5.2])),
                ('throttle', FLOAT32, scalars([0.5, np.nan])))
    recording = read_recording(path)
    assert recording.throttle.tolist() == [0.5, 0.5, 0.5]
    assert '1 throttle value dropped' in recording.notes[0]


@pytest.mark.parametrize('throttle', [[0.0, 40.0], [1000.0, 1400.0]])
def test_throttle_in_other_units_is_refused(tmp_path, throttle):
    path = tmp_path / 'a.mcap'
    make(path, ('/voltage', FLOAT32, scalars([5.0, 5.0])),
         ('/throttle', FLOAT32, scalars(throttle, start=0)))
    said = complaint(path)
    assert f'throttle runs from {throttle[0]:g} to {throttle[1]:g}' in said
    assert 'unit_factor' in said


@pytest.mark.parametrize('kind', ['csv', 'mcap'])
def test_backward_clock_is_noted_with_its_step(tmp_path, kind):
    t = np.concatenate((np.arange(100), 60.5 + np.arange(100))) * 1e-3 + 1.0
    path = tmp_path / f'a.{kind}'
    if kind == 'csv':
        path.write_text('\n'.join(['time_s,voltage_v', *(f'{one:.6f},5.0' for one in t)]))
    else:
        stamps = [round(one * 1e9) for one in t]
        make(path, ('/voltage', BATTERY_STATE, [
            (10_000_000_000 + k * MS, message) for k, message in enumerate(
                encode_battery(np.array(stamps), np.full(200, 5.0)))]))
    recording = read_recording(path)
    # From 1.0605 to 1.099 s: 39 of the second stretch lie before the end of the first.
    note = next(note for note in recording.notes if 'clock' in note)
    assert 'went back once, by 0.0385 s at most: 39 samples' in note and recording.n == 200


def test_a_second_fitting_topic_is_noted(tmp_path):
    path = make(tmp_path / 'a.mcap', ('/voltage', FLOAT32, scalars([5.0])),
                ('/bec/voltage', FLOAT32, scalars([6.0])))
    recording = read_recording(path)
    assert recording.voltage.tolist() == [5.0]
    assert any('/bec/voltage would fit too' in note for note in recording.notes)
    assert 'fit too' not in ''.join(read_recording(path, voltage_topic='/bec/voltage').notes)


PEAK = """
import re, sys
from ou_monitor import read_recording
for end in (1.0, None):
    n = read_recording(sys.argv[1], end=end).n
    print(n, re.search('VmHWM:[^0-9]*([0-9]+)', open('/proc/self/status').read())[1])
"""


def test_memory_holds_little_beside_the_result(tmp_path):
    """Every array grows in place: neither parts nor copies of the whole lie beside it."""
    n = 800_000
    path = tmp_path / 'long.mcap'
    data = encode_battery(np.arange(n, dtype=np.int64) * MS, 12.0 + np.arange(n) % 997 / 997)
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2', library='test')
        channels = [writer.register_channel('/' + name, 'cdr', writer.register_schema(
            kind, 'ros2msg', SCHEMAS[kind].encode())) for name, kind in (
                ('voltage', BATTERY_STATE), ('throttle', FLOAT32))]
        half = encode_scalars(FLOAT32, [0.5])[0]
        for k, message in enumerate(data):
            if k % 20 == 0:
                writer.add_message(channels[1], k * MS, half, k * MS)
            writer.add_message(channels[0], k * MS, message, k * MS)
        writer.finish()
    # Resident memory, kB, of a process of its own: tracemalloc does not count maps.
    done = subprocess.run([sys.executable, '-c', PEAK, str(path)], cwd=ROOT, capture_output=True,
                          text=True, check=True)
    (_, before), (count, peak) = (map(int, line.split()) for line in done.stdout.splitlines())
    assert count == n
    # Three columns of the result and the log times, and a large page for each of them, where the
    # kernel has such pages; a copy of all would take as much again as the columns.
    assert 1000 * (peak - before) < 4 * (8 * n + 2_097_152) + 6_000_000


STAMPS = np.arange(5) * 100 * MS


def bag_with_currents(path, battery_current, *beside, stamps=STAMPS):
    """Write a bag of 5 voltages with a current in each, and other topics beside."""
    return make(path, ('voltage', BATTERY_STATE, [
        (t, {'header': {'stamp': {'sec': 0, 'nanosec': t}, 'frame_id': ''}, 'voltage': 16.0,
             'current': current}) for t, current in zip(stamps.tolist(), battery_current)]),
        *beside)


def test_the_current_of_a_battery_is_drawn_when_negative(tmp_path):
    path = bag_with_currents(tmp_path / 'a.mcap', [-1.0, np.nan, -3.0, -4.0, 5.0])
    np.testing.assert_array_equal(read_recording(path).current, [1.0, np.nan, 3.0, 4.0, -5.0])
    np.testing.assert_array_equal(read_recording(path, start=0.15).current, [3.0, 4.0, -5.0])


def test_a_topic_of_its_own_goes_first_and_holds(tmp_path):
    path = bag_with_currents(tmp_path / 'a.mcap', [9.0] * 5, (
        'current', FLOAT32, scalars([20.0, 30.0], start=100 * MS, step=200 * MS)))
    np.testing.assert_array_equal(read_recording(path).current, [np.nan, 20.0, 20.0, 30.0, 30.0])


def test_missing_current_is_none(tmp_path):
    assert read_recording(bag_with_currents(tmp_path / 'a.mcap', [np.nan] * 5)).current is None


@pytest.mark.parametrize('header, row', [
    ('time_s,voltage_v,current_a', '{},5,{}'), ('current_a,time_s,throttle,voltage_v',
                                                '{1},{0},0.5,5')])
def test_the_current_in_a_csv(tmp_path, header, row):
    path = tmp_path / 'a.csv'
    path.write_text('\n'.join([header, *(row.format(t, t * 10) for t in (0, 2, 1))]) + '\n')
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.current, [0.0, 10.0, 20.0])
    assert recording.has_throttle is ('throttle' in header)


def test_each_message_of_a_battery_has_a_current_of_its_own(tmp_path):
    """Of two with one stamp the first is kept, and its current, as the node pairs them."""
    path = bag_with_currents(tmp_path / 'a.mcap', [-1.0, -2.0, -3.0, -4.0, -5.0],
                             stamps=STAMPS // (200 * MS) * (200 * MS))
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.current, [1.0, 3.0, 5.0])


def test_a_broken_message_counts_once(tmp_path):
    path, message = tmp_path / 'a.mcap', encode_battery(STAMPS, np.full(5, 16.0))
    with BagWriter(path) as writer:
        writer.add_topic('voltage', BATTERY_STATE)
        for k, t in enumerate(STAMPS.tolist()):
            writer.write('/voltage', t, message[k][:20] if k in (1, 3) else message[k])
    recording = read_recording(path, partial=True)
    assert recording.n == 3
    assert [note for note in recording.notes if note.startswith('2 messages dropped')]
