"""Cut at every record and at random bytes, bits flipped: all that is gone is accounted for."""

import re
import shutil
import struct

from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.mcap_records import MAGIC
from ou_monitor.recordings.read import read_pieces, read_recording
from ou_monitor.recordings.standard_types import encode_scalars, FLOAT32, FLOAT64, SCHEMAS
import pytest

START = 1_704_067_200_000_000_000
MS = 1_000_000
COUNT = 500
WAYS = {
    'zstd': {'compression': CompressionType.ZSTD},
    'lz4': {'compression': CompressionType.LZ4},
    'plain': {'compression': CompressionType.NONE},
    'unindexed': {'index_types': IndexType.NONE, 'use_statistics': False},
    'unchunked': {'use_chunking': False, 'enable_data_crcs': True},
}


def write(path, **options):
    """Write a voltage and a throttle; return every message in the order of the file."""
    rng = np.random.default_rng(1)
    rows = []
    with path.open('wb') as file:
        writer = Writer(file, **{'chunk_size': 4000, **options})
        writer.start(profile='ros2', library='test')
        channels = {}
        for topic, kind in (('/voltage', FLOAT64), ('/throttle', FLOAT32)):
            schema = writer.register_schema(kind, 'ros2msg', SCHEMAS[kind].encode())
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        writer.add_metadata('m', {'a': 'b'})
        writer.add_attachment(0, 0, 'note', 'text/plain', b'hello')
        for k, data in enumerate(encode_scalars(FLOAT64, rng.normal(5.0, 0.1, COUNT))):
            rows.append(('/voltage', START + k * MS, data))
            if k % 10 == 0:
                rows.append(('/throttle', START + k * MS + 1, encode_scalars(FLOAT32, [0.5])[0]))
        for topic, t, data in rows:
            writer.add_message(channels[topic], t, data, t)
        writer.finish()
    return rows


@pytest.fixture(scope='module', params=list(WAYS))
def sound(request, tmp_path_factory):
    """Return way, bytes, messages."""
    path = tmp_path_factory.mktemp('sound') / 'bag.mcap'
    rows = write(path, **WAYS[request.param])
    return request.param, path.read_bytes(), rows


def records(data):
    """Return (begin, end, messages in it) of every record, walked independently of the package."""
    at, found, done = len(MAGIC), [], 0
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', data, at)
        end = at + 9 + length
        inside = 0
        if opcode == 0x05:
            inside = 1
        elif opcode == 0x06:
            # Chunks are in the order of time here: their last log time tells how many.
            last = struct.unpack_from('<Q', data, at + 17)[0] - START
            k = last // MS
            inside = (k + 1) + (k // 10 + (last % MS == 1 or k % 10 != 0)) - done
        found.append((at, end, inside))
        done += inside
        at = end
    return found


def taken(path, **options):
    """Return (topic, time, bytes) of all messages, and the reader."""
    reader = BagReader(path, **options)
    return [(m.topic, m.log_time_ns, m.data) for m in reader.raw_messages()], reader


def refusal(call):
    """Return the one line with which something is refused."""
    with pytest.raises(InputError) as caught:
        call()
    assert '\n' not in str(caught.value)
    return str(caught.value)


def check_cut(path, data, rows, cut, walked):
    """Cut a file; check what is returned and what is said."""
    path.write_bytes(data[:cut])
    whole = [r for r in walked if r[1] <= cut]
    left = sum(r[2] for r in whole)
    byte = max([r[1] for r in whole], default=len(MAGIC))
    text = refusal(lambda: BagReader(path))
    assert f'is damaged at byte {byte}:' in text and '--partial' in text
    if not left:
        assert 'before the first message' in text
        assert 'holds no messages' in refusal(lambda: BagReader(path, partial=True))
        return
    last = rows[left - 1][1]
    seconds = f'({(last - START) / 1e9:.3f} s into the recording, log time ' \
        f'{last // 10**9}.{last % 10**9:09d} s)'
    assert seconds in text
    found, reader = taken(path, partial=True)
    assert found == rows[:left]
    assert f'at byte {byte}:' in reader.damage and seconds in reader.damage
    recording = read_recording(path, partial=True, msg_config='std_float64')
    assert recording.n == sum(row[0] == '/voltage' for row in rows[:left])
    assert any(f'at byte {byte}:' in note and seconds in note for note in recording.notes)


def test_cut_at_every_record(sound, tmp_path):
    """At each boundary, and a byte after it."""
    way, data, rows = sound
    walked = records(data)
    assert sum(r[2] for r in walked) == len(rows)
    edges = sorted({r[0] for r in walked} | {len(data) - len(MAGIC)})
    if way == 'unchunked':
        edges = edges[:8] + edges[8:-8:40] + edges[-8:]
    for edge in edges:
        for cut in (edge, edge + 1):
            if cut >= len(MAGIC):
                check_cut(tmp_path / 'cut.mcap', data, rows, cut, walked)


def test_what_follows_the_end_is_told(sound, tmp_path):
    """Another file behind the first would be lost without a word."""
    _, data, rows = sound
    for more in (data, b'\0', bytes(100)):
        path = tmp_path / 'bag.mcap'
        path.write_bytes(data + more)
        assert f'at byte {len(data)}: {len(more)} bytes follow' in refusal(lambda: BagReader(path))
        found, reader = taken(path, partial=True)
        assert found == rows
        assert f'at byte {len(data)}:' in reader.damage


def test_cut_at_random_bytes(sound, tmp_path):
    """Anywhere, down to the first byte."""
    _, data, rows = sound
    walked = records(data)
    for cut in np.random.default_rng(2).integers(len(MAGIC), len(data), 25).tolist():
        check_cut(tmp_path / 'cut.mcap', data, rows, cut, walked)
    path = tmp_path / 'head.mcap'
    for cut in range(len(MAGIC)):
        path.write_bytes(data[:cut])
        refusal(lambda: BagReader(path, partial=True))


def test_a_flipped_byte(sound, tmp_path):
    """What comes back is right, or the damage is reported; read whole, it is right or refused."""
    way, data, rows = sound
    rng = np.random.default_rng(3)
    path = tmp_path / 'flip.mcap'
    told = 0
    places = [len(MAGIC) + k for k in range(0, 60, 4)] + rng.integers(0, len(data), 60).tolist()
    for place in places:
        broken = bytearray(data)
        broken[place] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        try:
            found, reader = taken(path, partial=True)
        except InputError as error:
            assert '\n' not in str(error)
            told += 1
        else:
            told += reader.damage is not None
            if found != rows:
                assert reader.damage is not None, place
                assert re.search(r'at byte \d+: ', reader.damage)
                assert 'into the recording, log time' in reader.damage \
                    or 'before the first message' in reader.damage
                if way != 'unchunked':
                    # Each chunk has its own checksum: what is left of a bag is right.
                    assert set(found) <= set(rows)
        try:
            read_recording(path, partial=True, msg_config='std_float64')
        except InputError as error:
            assert '\n' not in str(error)
        try:
            whole = read_recording(path, msg_config='std_float64')
        except InputError as error:
            assert '\n' not in str(error)
        else:
            np.testing.assert_array_equal(
                whole.voltage, [np.frombuffer(r[2], '<f8', 1, 4)[0] for r in rows
                                if r[0] == '/voltage'])
    # Bytes of an index or of the summary can be wrong without harm.
    assert told > 30


def test_flipped_heads_without_any_checksum(tmp_path):
    """A message lost behind a wrong opcode, length or channel is missed by the count."""
    path = tmp_path / 'bag.mcap'
    rows = write(path, use_chunking=False, enable_crcs=False)
    data = path.read_bytes()
    messages = [r for r in records(data) if r[2]]
    rng = np.random.default_rng(4)
    for k in rng.integers(len(messages), size=100).tolist():
        broken = bytearray(data)
        # Opcode, length (8), channel (2).
        broken[messages[k][0] + int(rng.integers(11))] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        assert 'is damaged at byte' in refusal(lambda: BagReader(path))
        try:
            found, reader = taken(path, partial=True)
        except InputError as error:
            assert k == 0 and 'holds no messages' in str(error)
            continue
        assert found != rows and found[:k] == rows[:k] and reader.damage is not None


@pytest.mark.parametrize('way', ['zstd', 'lz4', 'plain'])
def test_a_broken_chunk_is_told_with_its_time(tmp_path, way):
    """Met while reading, or while scanning: byte and time; the others are read."""
    path = tmp_path / 'bag.mcap'
    rows = write(path, chunk_size=2000, **WAYS[way])
    data = bytearray(path.read_bytes())
    chunks = [r for r in records(bytes(data)) if r[2]]
    for k in (4, 7):
        begin, end, _ = chunks[k]
        data[(begin + 60 + end) // 2] ^= 0x40
    path.write_bytes(data)
    begin = chunks[4][0]
    before = sum(c[2] for c in chunks[:4])
    for read in (read_recording, lambda p: list(read_pieces(p, samples=50)),
                 lambda p: list(BagReader(p).raw_messages())):
        text = refusal(lambda read=read: read(path))
        first = rows[before][1]
        assert f'at byte {begin + 9}:' in text
        assert f'({(first - START) / 1e9:.3f} s into the recording, log time {first // 10**9}.' \
            in text
    found, reader = taken(path, partial=True)
    lost = chunks[4][2], chunks[7][2]
    assert len(found) == len(rows) - sum(lost)
    last = rows[before - 1][1]
    assert f'at byte {begin + 9}:' in reader.damage
    assert f'({(last - START) / 1e9:.3f} s into the recording' in reader.damage
    assert f'at 1 more place, the last at byte {chunks[7][0] + 9}' in reader.damage
    # A part that does not touch the broken chunks is read without --partial.
    assert read_recording(path, start=0.0, end=(last - START) / 1e9).n > 50


def test_a_message_that_is_cut_short(tmp_path):
    """Whole in its chunk and no message of its type: told with its time, or left out alone."""
    path = tmp_path / 'bag.mcap'
    with path.open('wb') as file:
        writer = Writer(file)
        writer.start(profile='ros2', library='test')
        schema = writer.register_schema(FLOAT64, 'ros2msg', SCHEMAS[FLOAT64].encode())
        channel = writer.register_channel('/voltage', 'cdr', schema)
        for k, data in enumerate(encode_scalars(FLOAT64, 5.0 + np.arange(COUNT))):
            short = data[:7] if k in (100, 200) else b'' if k == 300 else data
            writer.add_message(channel, START + k * MS, short, START + k * MS)
        writer.finish()
    where = '(0.100 s into the recording, log time 1704067200.100000000 s)'
    for read in (read_recording, lambda path: list(read_pieces(path))):
        text = refusal(lambda read=read: read(path))
        assert 'cannot be decoded' in text and where in text and '--partial' in text
    whole = read_recording(path, partial=True)
    pieces = list(read_pieces(path, samples=50, partial=True))
    kept = np.delete(5.0 + np.arange(COUNT), [100, 200, 300])
    for voltage, notes in ((whole.voltage, whole.notes), (
            np.concatenate([piece.voltage for piece in pieces]), pieces[-1].notes)):
        np.testing.assert_array_equal(voltage, kept)
        assert any('3 messages dropped' in note and where in note for note in notes)


def test_definitions_from_the_summary(tmp_path):
    """Broken ones at the start of a file do not take all messages with them."""
    path = tmp_path / 'bag.mcap'
    rows = write(path)
    data = bytearray(path.read_bytes())
    first = next(r for r in records(bytes(data)) if r[2])
    data[(first[0] + first[1]) // 2] ^= 0x55
    path.write_bytes(data)
    found, reader = taken(path, partial=True)
    assert found == rows[first[2]:] and f'at byte {first[0] + 9}:' in reader.damage
    rows = write(path, use_chunking=False)
    data = bytearray(path.read_bytes())
    for opcode, far in ((0x04, 9 + 4 + 3), (0x03, 9 + 2 + 3)):
        broken = bytearray(data)
        at = next(r[0] for r in records(bytes(data)) if data[r[0]] == opcode)
        # The length of a text, made far too large.
        broken[at + far] = 0x7f
        path.write_bytes(broken)
        found, reader = taken(path, partial=True)
        assert found == rows and f'at byte {at}: a schema or channel' in reader.damage


def test_the_frame_is_found_again(tmp_path):
    """A wrong length hides one chunk, not all after it, where the summary is whole."""
    path = tmp_path / 'bag.mcap'
    rows = write(path)
    data = bytearray(path.read_bytes())
    chunks = [r for r in records(bytes(data)) if r[2]]
    data[chunks[3][0] + 4] ^= 0x10
    path.write_bytes(data)
    found, reader = taken(path, partial=True)
    assert len(found) == len(rows) - chunks[3][2]
    assert f'at byte {chunks[3][0]}:' in reader.damage
    # The summary knows better than the frame: nothing is lost.
    assert taken(path)[0] == rows


def test_one_of_several_files(tmp_path):
    """The damaged file is named; its time counts from the start of the whole bag."""
    folder = tmp_path / 'bag'
    folder.mkdir()
    write(folder / 'bag_0.mcap')
    shutil.copy(folder / 'bag_0.mcap', folder / 'bag_1.mcap')
    data = (folder / 'bag_1.mcap').read_bytes()
    (folder / 'bag_1.mcap').write_bytes(data[:len(data) // 2])
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        '  relative_file_paths: [bag_0.mcap, bag_1.mcap]\n')
    text = refusal(lambda: BagReader(folder))
    assert 'bag_1.mcap is damaged at byte' in text and 'into the recording' in text
    reader = BagReader(folder, partial=True)
    assert reader.damage.startswith('bag_1.mcap is damaged at byte')
    assert 550 < reader.message_count < 1100


def test_a_private_record(tmp_path):
    """Passed over with a note where the messages are counted, else it may have been one."""
    path = tmp_path / 'bag.mcap'
    rows = write(path, use_chunking=False)
    data = bytearray(path.read_bytes())
    at = next(r[0] for r in records(bytes(data)) if data[r[0]] == 0x0C)
    data[at] = 0x9C
    path.write_bytes(data)
    found, reader = taken(path, partial=True)
    assert found == rows and reader.damage is None
    assert any('0x9c' in note and f'at byte {at}' in note for note in reader.notes)
    for way in ({}, {'use_chunking': False}):
        rows = write(path, use_statistics=False, **way)
        data = bytearray(path.read_bytes())
        at = [r[0] for r in records(bytes(data)) if r[2]][3]
        data[at] |= 0x80
        path.write_bytes(data)
        found, reader = taken(path, partial=True)
        assert len(found) < len(rows) and f'at byte {at}: a record of a private' in reader.damage


def test_an_unknown_compression(tmp_path):
    """It is named, not taken for plain bytes."""
    path = tmp_path / 'bag.mcap'
    write(path, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b'zstd', b'zsTd'))
    assert "unknown compression 'zsTd'" in refusal(lambda: read_recording(path))
    assert 'holds no messages' in refusal(lambda: read_recording(path, partial=True))
