"""Bags: written and read by this package and by the independent rosbags library."""

import shutil

from made_bags import decode, START
from mcap.writer import Writer
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings import bag as bag_module
from ou_monitor.recordings.bag import BagReader, BagWriter
from ou_monitor.recordings.mcap_file import McapFile
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import encode_scalars, FLOAT32, SCHEMAS
from ou_monitor.recordings.write import TYPES, write_recording
from ou_monitor.records import Recording
import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosReliability
import yaml


def rows(reader, topics=None):
    return [(m.topic, m.type, m.log_time_ns, m.data) for m in reader.raw_messages(topics)]


def write_two(path, n=2000):
    """Write a fast and a slow topic; return the messages in time order."""
    expected = []
    with BagWriter(path) as bag:
        bag.add_topic('voltage', FLOAT32)
        bag.add_topic('/throttle', FLOAT32)
        for k, data in enumerate(encode_scalars(FLOAT32, np.linspace(4.0, 5.0, n))):
            t = START + k * 1_000_000
            bag.write('/voltage', t, data)
            expected.append(('/voltage', FLOAT32, t, data))
            if k % 100 == 0:
                # Written late: the order in the file is not that of time.
                early = encode_scalars(FLOAT32, [k / n])[0]
                bag.write('throttle', t - 500_000 + 1_000_000 * (k == 0), early)
                expected.append(('/throttle', FLOAT32, t - 500_000 + 1_000_000 * (k == 0), early))
    return sorted(expected, key=lambda row: row[2])


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_a_written_bag_reads_back(tmp_path, name):
    """Every message is read back, in the order of log times, by topic on request."""
    expected = write_two(tmp_path / name)
    reader = BagReader(tmp_path / name)
    assert reader.topics == {'/voltage': FLOAT32, '/throttle': FLOAT32}
    assert reader.counts == {'/voltage': 2000, '/throttle': 20}
    assert (reader.start_ns, reader.end_ns) == (expected[0][2], expected[-1][2])
    assert (reader.message_count, reader.damage, reader.notes) == (2020, None, ())
    assert rows(reader) == expected
    # A second pass, one topic, and the scanning reader see the same.
    throttle = [row for row in expected if row[0] == '/throttle']
    assert rows(reader, ['/throttle']) == throttle
    assert rows(BagReader(tmp_path / name, partial=True)) == expected


def test_rosbags_reads_a_written_bag(tmp_path):
    """The independent library reads the same messages, types, times and QoS."""
    expected = write_two(tmp_path / 'bag')
    with AnyReader([tmp_path / 'bag']) as reader:
        found = [(c.topic, c.msgtype, t, bytes(data)) for c, t, data in reader.messages()]
        qos = {c.topic: c.ext.offered_qos_profiles[0].reliability for c in reader.connections}
    assert sorted(found, key=lambda row: (row[2], row[0])) == sorted(
        expected, key=lambda row: (row[2], row[0]))
    assert set(qos.values()) == {QosReliability.RELIABLE}


def test_metadata_is_version_9(tmp_path):
    """The keys and kinds that rosbag2 of Jazzy asks for."""
    write_two(tmp_path / 'bag')
    with (tmp_path / 'bag/metadata.yaml').open() as file:
        info = yaml.safe_load(file)['rosbag2_bagfile_information']
    assert info['version'] == 9
    assert (info['storage_identifier'], info['ros_distro']) == ('mcap', 'jazzy')
    assert info['relative_file_paths'] == ['bag_0.mcap'] == [f['path'] for f in info['files']]
    assert info['message_count'] == 2020 == info['files'][0]['message_count']
    assert info['starting_time']['nanoseconds_since_epoch'] == START
    assert info['duration']['nanoseconds'] == 1999 * 1_000_000
    assert (info['compression_format'], info['compression_mode']) == ('', '')
    assert info['custom_data'] is None
    for entry in info['topics_with_message_count']:
        topic = entry['topic_metadata']
        assert topic['serialization_format'] == 'cdr'
        assert isinstance(topic['offered_qos_profiles'], list)
        assert topic['type_description_hash'].startswith('RIHS01_')


def test_memory_holds_overlapping_chunks_only(tmp_path, monkeypatch):
    write_two(tmp_path / 'bag.mcap', n=30_000)
    read = []
    original = McapFile.tables
    monkeypatch.setattr(bag_module, '_TOGETHER', 1)
    monkeypatch.setattr(McapFile, 'tables', lambda self, spans, wanted: read.extend(spans)
                        or original(self, spans, wanted))
    messages = BagReader(tmp_path / 'bag.mcap').raw_messages()
    for _ in range(100):
        next(messages)
    early = len(read)
    assert early <= 2 and len(list(messages)) > 20_000 and len(read) > 5


def test_several_files_are_one_bag(tmp_path):
    """A split rosbag2 is played through; its files may overlap in time."""
    folder = tmp_path / 'bag'
    write_two(folder)
    with BagWriter(tmp_path / 'more.mcap') as bag:
        bag.add_topic('voltage', FLOAT32)
        for k in range(10):
            bag.write('voltage', START + 1_990_000_000 + 2_000_000 * k,
                      encode_scalars(FLOAT32, [k])[0])
    shutil.move(tmp_path / 'more.mcap', folder / 'bag_1.mcap')
    text = (folder / 'metadata.yaml').read_text()
    (folder / 'metadata.yaml').write_text(
        text.replace('  - bag_0.mcap\n', '  - bag_0.mcap\n  - bag_1.mcap\n').replace(
            'custom_data: null', 'custom_data: {a: [1], b: 2}'))
    reader = BagReader(folder)
    # Of the custom data, texts and numbers are taken.
    assert reader.counts['/voltage'] == 2010 and reader.about == {'b': '2'}
    times = [m.log_time_ns for m in reader.raw_messages()]
    assert len(times) == 2030 and times == sorted(times)
    assert reader.end_ns == START + 2_008_000_000


def other_encoding(path, with_ros2):
    """Write a JSON topic, and a ROS 2 one if asked."""
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='', library='test')
        schema = writer.register_schema('Thing', 'jsonschema', b'{}')
        writer.add_message(writer.register_channel('/json', 'json', schema), 1, b'{}', 1)
        if with_ros2:
            schema = writer.register_schema(FLOAT32, 'ros2msg', SCHEMAS[FLOAT32].encode())
            writer.add_message(writer.register_channel('/u', 'cdr', schema), 2,
                               encode_scalars(FLOAT32, [1.0])[0], 2)
        writer.finish()


def test_topics_that_are_not_ros2(tmp_path):
    """They are left out with a note; a bag of nothing else is refused."""
    other_encoding(tmp_path / 'mixed.mcap', True)
    reader = BagReader(tmp_path / 'mixed.mcap')
    assert list(reader.topics) == ['/u']
    assert [m.topic for m in reader.raw_messages()] == ['/u']
    assert "'/json'" in reader.notes[0] and 'not ROS 2' in reader.notes[0]
    other_encoding(tmp_path / 'json.mcap', False)
    with pytest.raises(InputError, match="'/json' was left out.*not ROS 2"):
        BagReader(tmp_path / 'json.mcap')


def test_the_writer_refuses(tmp_path):
    """Existing files are not touched; an error is one line."""
    existing = tmp_path / 'there.mcap'
    existing.write_text('mine')
    with pytest.raises(InputError, match='exists already'):
        BagWriter(existing)
    assert existing.read_text() == 'mine'
    with pytest.raises(InputError, match='exists already'):
        BagWriter(tmp_path)
    with pytest.raises(InputError, match='no folder'):
        BagWriter(tmp_path / 'no' / 'bag.mcap')
    # Nobody, not even root, may make files there.
    for name in ('bag', 'bag.mcap'):
        with pytest.raises(InputError, match='cannot write /sys/'):
            BagWriter(f'/sys/{name}')


@pytest.mark.parametrize('name', ['bag', 'bag.mcap'])
def test_a_failed_write_removes_the_bag(tmp_path, name):
    """The next reader would take half a bag for a whole one."""
    with pytest.raises(RuntimeError, match='power'):
        with BagWriter(tmp_path / name) as bag:
            bag.add_topic('u', FLOAT32)
            bag.write('u', 1, encode_scalars(FLOAT32, [1.0])[0])
            raise RuntimeError('power cut')
    assert list(tmp_path.iterdir()) == []


def test_an_error_in_the_block_removes_the_bag(tmp_path):
    """Bugs of the caller are not the user's."""
    with BagWriter(tmp_path / 'bag.mcap') as bag:
        bag.add_topic('u', FLOAT32)
        with pytest.raises(ValueError, match='added before'):
            bag.add_topic('/u', FLOAT32)
        with pytest.raises(ValueError, match='schema'):
            bag.add_topic('v', 'my_msgs/msg/Rail')
        with pytest.raises(ValueError, match='not added'):
            bag.write('w', 1, b'')
        with pytest.raises(ValueError, match='negative'):
            bag.write('u', -1, b'')
        bag.write('u', 1, encode_scalars(FLOAT32, [1.0])[0])
    assert BagReader(tmp_path / 'bag.mcap').message_count == 1


RATE = 10_000.0


def recording(n=2500, start=0.0, throttle=True):
    """Return noise at 10 kHz with a throttle that steps once."""
    t = start + np.arange(n) / RATE
    voltage = 5.0 + 0.1 * np.random.default_rng(2).standard_normal(n)
    held = np.where(np.arange(n) < n // 2, 0.25, 0.75) if throttle else np.full(n, np.nan)
    return Recording(t, voltage, held, 'made')


@pytest.mark.parametrize('type', sorted(TYPES))
@pytest.mark.parametrize('start', [0.0, 100.0])
def test_a_written_recording_reads_back(tmp_path, type, start):  # noqa: A002
    rec = recording(start=start)
    assert write_recording(rec, tmp_path / 'bag', type=type)[1] == ()
    back = read_recording(tmp_path / 'bag')
    # 0.5 ns of rounding to whole ns; in blocks, a stamp is rounded once a block.
    np.testing.assert_allclose(back.t, rec.t, rtol=0, atol=1.1e-9)
    exact = rec.voltage if type == 'float64' else rec.voltage.astype(np.float32)
    np.testing.assert_array_equal(back.voltage, exact)
    np.testing.assert_array_equal(back.throttle, rec.throttle)
    assert back.notes == ()


def test_start_is_added(tmp_path):
    """Log times are exact in ns, whatever the epoch."""
    write_recording(recording(100), tmp_path / 'bag', type='float32', start_ns=START)
    messages = BagReader(tmp_path / 'bag').raw_messages(['/voltage'])
    assert [m.log_time_ns for m in messages] == [START + 100_000 * k for k in range(100)]


def test_throttle_is_sent_when_it_changes_and_once_a_second(tmp_path):
    t = np.arange(400) / 100.0
    throttle = np.where(t < 2.505, 0.25, 0.75)
    write_recording(Recording(t, np.full(400, 5.0), throttle), tmp_path / 'bag')
    messages = list(BagReader(tmp_path / 'bag').raw_messages())
    sent = [(m.log_time_ns // 10_000_000, decode(m.type, m.data).data)
            for m in messages if m.topic == '/throttle']
    assert sent == [(0, 0.25), (100, 0.25), (200, 0.25), (251, 0.75), (300, 0.75)]
    # At one instant the throttle comes first.
    assert [m.topic for m in messages[:2]] == ['/throttle', '/voltage']


def test_unknown_throttle_is_not_written(tmp_path):
    """Throughout, or until it is known."""
    write_recording(recording(throttle=False), tmp_path / 'bag')
    assert list(BagReader(tmp_path / 'bag').topics) == ['/voltage']
    rec = recording(100)
    rec.throttle[:10] = np.nan
    write_recording(rec, tmp_path / 'later')
    np.testing.assert_array_equal(read_recording(tmp_path / 'later').throttle, rec.throttle)


def test_negative_stamps_are_moved(tmp_path):
    """A bag holds none; spacing is kept and a note says by how much."""
    rec = recording(100, start=-2.0)
    _, notes = write_recording(rec, tmp_path / 'bag')
    assert len(notes) == 1 and '2.0' in notes[0]
    back = read_recording(tmp_path / 'bag')
    np.testing.assert_allclose(back.t, rec.t + 2.0, rtol=0, atol=1.1e-9)


def test_samples_that_a_bag_cannot_hold_are_refused(tmp_path):
    """One line, and nothing is left behind."""
    uneven = recording(100)
    uneven.t[50:] += 1e-3
    for rec, options, words in [
            (recording(100), {'type': 'battery'}, "'battery_state'"),
            (recording(0), {}, 'no sample'),
            (recording(100, start=2.0**31), {}, '2\\^31'),
            (uneven, {'type': 'adc_block'}, 'steady 10000 Hz'),
            (recording(100), {'type': 'adc_block', 'sample_rate': 5000.0}, 'steady 5000 Hz'),
            (recording(100), {'type': 'adc_block', 'sample_rate': 0.0}, 'above 0 Hz')]:
        with pytest.raises(InputError, match=words):
            write_recording(rec, tmp_path / 'bag', **options)
    assert list(tmp_path.iterdir()) == []
    write_recording(recording(100, start=2.0**31), tmp_path / 'late', type='float32')
