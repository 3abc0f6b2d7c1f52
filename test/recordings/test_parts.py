"""Bags with all options of writing, read whole and in part: always the same samples."""

from made_bags import folder_of, MS, START, write
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings import bag as bag_module
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_scalars, FLOAT32, SCHEMAS)
import pytest

COUNT = 3000


def flight(seed=3, stamped=True):
    """Return (topic, type, log time, bytes) as a driver sends them: late, and not in order."""
    rng = np.random.default_rng(seed)
    stamps = START + np.arange(COUNT) * MS
    logged = stamps + (rng.exponential(3.0, COUNT) * MS).astype(np.int64)
    values = rng.normal(5.0, 0.1, COUNT)
    values[::97] = np.nan
    # Some stamps are repeated, as by a driver that sends its last value again.
    stamps[50::170] = stamps[49::170][:stamps[50::170].size]
    kind = BATTERY_STATE if stamped else FLOAT32
    data = encode_battery(stamps, values) if stamped else encode_scalars(FLOAT32, values)
    out = [('/voltage', kind, int(t), d) for t, d in zip(logged, data)]
    for k, d in enumerate(encode_scalars(FLOAT32, rng.random(COUNT // 50))):
        out.append(('/throttle', FLOAT32, START + (k * 50 + 20) * MS, d))
    out += [('/other', FLOAT32, START + k * 30 * MS, d)
            for k, d in enumerate(encode_scalars(FLOAT32, np.arange(COUNT // 30)))]
    # Neither the order of log times nor that of stamps, but nearly.
    place = rng.normal(0.0, 4.0 * MS, len(out)) + np.array([row[2] for row in out])
    return [out[k] for k in np.argsort(place, kind='stable')]


def same(one, other):
    for name in ('t', 'voltage', 'throttle'):
        np.testing.assert_array_equal(getattr(one, name).view(np.uint64),
                                      getattr(other, name).view(np.uint64))


@pytest.fixture(scope='module')
def rows():
    return flight()


@pytest.fixture(scope='module')
def bag(rows, tmp_path_factory):
    """Return them in a bag of many chunks."""
    return write(tmp_path_factory.mktemp('bag') / 'bag.mcap', rows, chunk_size=20_000)


def expected(rows):
    """Return t, voltage and throttle by other means: sorting and looking up in plain Python."""
    samples, throttle = {}, []
    for k, (topic, _, t, data) in sorted(enumerate(rows), key=lambda item: (item[1][2], item[0])):
        if topic == '/throttle':
            throttle.append((t * 1e-9 - START * 1e-9, np.frombuffer(data, '<f4', 1, 4)[0]))
        elif topic == '/voltage':
            sec, nanosec = np.frombuffer(data, '<u4', 2, 4).tolist()
            value = float(np.frombuffer(data, '<f4', 1, 20)[0])
            if np.isfinite(value):
                samples.setdefault(sec * 10**9 + nanosec, value)
    stamps = sorted(samples)
    held = []
    for t in stamps:
        before = [v for at, v in throttle if at <= t * 1e-9 - START * 1e-9 + 1e-7]
        held.append(before[-1] if before else np.nan)
    return stamps, [samples[t] for t in stamps], held


def test_a_whole_bag_is_sorted_with_throttle_held(bag, rows):
    recording = read_recording(bag)
    stamps, voltage, throttle = expected(rows)
    np.testing.assert_allclose(recording.t - START * 1e-9, (np.array(stamps) - START) * 1e-9,
                               rtol=0, atol=3e-7)
    assert recording.voltage.tolist() == voltage
    np.testing.assert_array_equal(recording.throttle, throttle)
    notes = ' '.join(recording.notes)
    assert '31 samples dropped: not a finite' in notes
    assert 'sorted by stamp' in notes and 'repeated stamp' in notes


@pytest.mark.parametrize('compression', list(CompressionType))
@pytest.mark.parametrize('options', [
    {}, {'use_chunking': False}, {'index_types': IndexType.CHUNK}, {'index_types': IndexType.NONE},
    {'use_statistics': False}, {'enable_crcs': False}, {'enable_data_crcs': True},
    {'chunk_size': 100},
    {'use_chunking': False, 'use_statistics': False, 'index_types': IndexType.NONE,
     'use_summary_offsets': False, 'repeat_channels': False, 'repeat_schemas': False}])
def test_every_way_of_writing(bag, rows, tmp_path, compression, options):
    path = write(tmp_path / 'bag.mcap', rows, compression=compression, **options)
    whole = read_recording(bag)
    for partial in (False, True):
        other = read_recording(path, partial=partial)
        same(other, whole)
        assert other.notes == whole.notes


def test_overlapping_files_of_a_bag_are_one_recording(bag, rows, tmp_path):
    """A rosbag2 directory with files that overlap in time."""
    folder = folder_of(tmp_path / 'bag', 'bag_0.mcap', 'bag_1.mcap', 'bag_2.mcap')
    for k, part in enumerate((rows[:1000], rows[1000:2500], rows[2500:])):
        write(folder / f'bag_{k}.mcap', part)
    same(read_recording(folder), read_recording(bag))


@pytest.mark.parametrize('stamped', [True, False])
@pytest.mark.parametrize('start, end', [(0.0, 0.5), (0.5, 1.0), (1.0, None), (2.9, 99.0),
                                        (0.001, 0.004)])
def test_a_part_equals_that_part_of_the_whole(tmp_path, start, end, stamped):
    """By log time; the throttle of before is held."""
    rows = flight(stamped=stamped)
    path = write(tmp_path / 'bag.mcap', rows)
    first = min(row[2] for row in rows if row[0] in ('/voltage', '/throttle', '/other'))
    low = first + round(start * 1e9)
    high = 2**62 if end is None else first + round(end * 1e9)
    inside = [row for row in rows if row[0] == '/throttle' or low <= row[2] < high]
    expect = read_recording(write(tmp_path / 'cut.mcap', inside))
    part = read_recording(path, start=start, end=end)
    # A throttle from after the part has no say.
    same(part, expect)
    assert any('Only the part from' in note for note in part.notes)


@pytest.mark.parametrize('start, end, words', [
    (-1.0, None, '0 s or later'), (float('nan'), None, '0 s or later'), (2.0, 2.0, 'not after'),
    (None, 0.0, 'not after'), (50.0, None, 'no sample from 50 s to the end: it lasts 3.0'),
    (50.0, 60.0, 'no sample from 50 s to 60 s')])
def test_empty_parts_are_refused(bag, start, end, words):
    with pytest.raises(InputError, match=words):
        read_recording(bag, start=start, end=end)


def test_a_part_of_a_csv_is_read(tmp_path):
    path = tmp_path / 'log.csv'
    path.write_text('time_s,voltage_v\n' + ''.join(f'{5 + k},{k}\n' for k in range(10)))
    part = read_recording(path, start=2.0, end=5.0)
    assert part.voltage.tolist() == [2.0, 3.0, 4.0]
    assert 'from 2 s to 5 s' in part.notes[-1]
    with pytest.raises(InputError, match='no sample from 20 s'):
        read_recording(path, start=20.0)


def test_progress_ends_at_one(bag, monkeypatch):
    monkeypatch.setattr(bag_module, '_TOGETHER', 1)
    shares = []
    read_recording(bag, progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 5


def test_fewer_messages_than_stated(bag, tmp_path):
    path = tmp_path / 'bag.mcap'
    data = bytearray(bag.read_bytes())
    start = int.from_bytes(data[-28:-20], 'little')
    # Statistics: 4 counts of 4 bytes, 2 times, and a count of 8 bytes for each of 3 channels.
    at = start
    while data[at] != 0x0B:
        at += 9 + int.from_bytes(data[at + 1:at + 9], 'little')
    for place in (at + 9, at + 9 + 46 + 2):
        data[place] += 1
    data[-12:-8] = bytes(4)
    path.write_bytes(data)
    with pytest.raises(InputError, match='states 3001 messages'):
        read_recording(path)
    assert any('the summary counts 3001' in note for note in read_recording(
        path, partial=True).notes)


def test_two_publishers_of_one_topic(tmp_path):
    path = tmp_path / 'bag.mcap'
    data = encode_scalars(FLOAT32, np.arange(300.0))
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=3000)
        writer.start(profile='ros2', library='test')
        schema = writer.register_schema(FLOAT32, 'ros2msg', SCHEMAS[FLOAT32].encode())
        channels = [writer.register_channel('/voltage', 'cdr', schema, {'k': str(k)})
                    for k in range(2)]
        for k in range(300):
            writer.add_message(channels[k % 3 == 0], (k + 1) * MS, data[k], 0)
        writer.finish()
    for partial in (False, True):
        assert read_recording(path, partial=partial).voltage.tolist() == list(range(300))
