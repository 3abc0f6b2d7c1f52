"""Bags that are damaged, truncated, foreign or hostile: one line gives the reason, in time."""

import os
import re
import resource
import struct
import time

import lz4.frame
from made_bags import (
    by_hand, channel, chunk, COUNT, folder_of, HEAD, message, messages, MS, Op, record, records,
    schema, START, supply, text, WAYS, write)
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings import mcap_file
from ou_monitor.recordings.bag import BagReader, BagWriter
from ou_monitor.recordings.importers.csv_table import MOST_COLUMNS
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.mcap_file import MAGIC
from ou_monitor.recordings.read import read_recording, read_signal
from ou_monitor.recordings.standard_types import encode_scalars, FLOAT64
import pytest
import yaml
import zstandard


def complaint(call, *given, within=10.0, **options):
    """Return the one line with which something is refused before long."""
    began = time.process_time()
    with pytest.raises(InputError) as caught:
        call(*given, **options)
    assert time.process_time() - began < within
    line = str(caught.value)
    assert line.isprintable()
    return line


ROWS = supply()


@pytest.fixture(scope='module', params=list(WAYS))
def sound(request, tmp_path_factory):
    """Return the way of writing, and the bytes."""
    path = write(tmp_path_factory.mktemp('sound') / 'bag.mcap', ROWS, **WAYS[request.param])
    return request.param, path.read_bytes()


def read(path, **options):
    """Read voltages; the msg config is named, for the throttle may be lost."""
    return read_recording(path, msg_config='std_float64', **options)


def volts(rows=ROWS):
    return [float(np.frombuffer(row[3], '<f8', 1, 4)[0]) for row in rows if row[0] == '/voltage']


def at_time(ns):
    """Return how a time of the recording is reported."""
    return (f'({(ns - START) / 1e9:.3f} s into the recording, log time '
            f'{ns // 10**9}.{ns % 10**9:09d} s)')


def check_cut(path, data, cut):
    """Cut a file: everything complete before the cut is read, and byte and time are reported."""
    path.write_bytes(data[:cut])
    whole = [r for r in records(data) if r[1] <= cut]
    left = sum(r[2] for r in whole)
    byte = max([r[1] for r in whole], default=len(MAGIC))
    line = complaint(BagReader, path)
    assert f'is damaged at byte {byte}:' in line and '--partial' in line
    if not left:
        assert 'before the first message' in line
        assert 'holds no messages' in complaint(read, path, partial=True)
        return
    seconds = at_time(ROWS[left - 1][2])
    assert seconds in line
    found = read(path, partial=True)
    assert found.voltage.tolist() == volts(ROWS[:left])
    assert any(f'at byte {byte}:' in note and seconds in note for note in found.notes)


def test_cut_at_records_and_anywhere(sound, tmp_path):
    """At each boundary, a byte after it, and at random; down to the first byte."""
    way, data = sound
    walked = records(data)
    assert sum(r[2] for r in walked) == len(ROWS)
    edges = sorted({r[0] for r in walked} | {len(data) - len(MAGIC)})
    edges = edges[:8] + edges[8:-8:80 if way == 'unchunked' else 5] + edges[-8:]
    cuts = {edge + more for edge in edges for more in (0, 1) if edge >= len(MAGIC)}
    cuts |= set(np.random.default_rng(2).integers(len(MAGIC), len(data), 10).tolist())
    for cut in sorted(cuts):
        check_cut(tmp_path / 'cut.mcap', data, cut)
    for cut in range(len(MAGIC)):
        (tmp_path / 'head.mcap').write_bytes(data[:cut])
        complaint(BagReader, tmp_path / 'head.mcap', partial=True)


def test_bytes_after_the_end_are_reported(sound, tmp_path):
    """Another file behind the first would be lost without a word."""
    _, data = sound
    for more in (data, b'\0', bytes(100)):
        path = tmp_path / 'bag.mcap'
        path.write_bytes(data + more)
        assert f'at byte {len(data)}: {len(more)} bytes follow' in complaint(BagReader, path)
        found = read(path, partial=True)
        assert found.voltage.tolist() == volts()
        assert any('bytes follow' in note for note in found.notes)


@pytest.mark.parametrize('way', ['zstd', 'unindexed', 'unchunked'])
@pytest.mark.parametrize('back', [125, 250, 10**6])
def test_a_clock_that_went_back(tmp_path, way, back):
    """Log times start again in the middle: reported of a whole bag, and of one cut off."""
    half = len(ROWS) // 2
    rows = [*ROWS[:half], *((*r[:2], r[2] - back * MS, r[3]) for r in ROWS[half:])]
    path = write(tmp_path / 'bag.mcap', rows, chunk_size=2000, **WAYS[way])
    words = 'The clock went back once, by '
    assert [note.startswith(words) for note in read(path).notes].count(True) == 1
    if back != 250:
        # One run alone.
        assert not any(note.startswith(words) for note in read(path, end=0.1).notes)
    assert not any('went back' in note for note in read(write(tmp_path / 'x.mcap', ROWS)).notes)
    path.write_bytes(path.read_bytes()[:-len(MAGIC)])
    complaint(read, path)
    assert [note.startswith(words) for note in read(path, partial=True).notes].count(True) == 1


@pytest.mark.parametrize('way', ['zstd', 'lz4', 'plain'])
@pytest.mark.parametrize('spot', ['content', 'checksum'])
def test_a_broken_chunk(tmp_path, way, spot):
    path = write(tmp_path / 'bag.mcap', ROWS, chunk_size=2000, **WAYS[way])
    data = bytearray(path.read_bytes())
    chunks = [r for r in records(bytes(data)) if r[2]]
    for k in (4, 7):
        begin, end, _ = chunks[k]
        data[(begin + 60 + end) // 2 if spot == 'content' else begin + 9 + 24] ^= 0x40
    path.write_bytes(data)
    before, lost = sum(c[2] for c in chunks[:4]), chunks[4][2]
    for call in (read, lambda p: list(BagReader(p).raw_messages())):
        line = complaint(lambda call=call: call(path))
        assert f'at byte {chunks[4][0]}:' in line and at_time(ROWS[before][2]) in line
    found = read(path, partial=True)
    again = before + lost + sum(c[2] for c in chunks[5:7])
    assert found.voltage.tolist() == volts(
        [*ROWS[:before], *ROWS[before + lost:again], *ROWS[again + chunks[7][2]:]])
    (note,) = [note for note in found.notes if 'damaged' in note]
    assert f'at byte {chunks[4][0]}:' in note and at_time(ROWS[before - 1][2]) in note
    assert f'at 1 more place, the last at byte {chunks[7][0]}' in note
    # A part that does not touch the broken chunks is read without `partial`.
    assert read(path, start=0.0, end=(ROWS[before - 1][2] - START) / 1e9).n > 50


def test_the_command_line(tmp_path, capsys):
    """One line and status 2; with --partial the note is in the output."""
    path = write(tmp_path / 'bag.mcap', supply(1500))
    path.write_bytes(path.read_bytes()[:-10_000])
    assert main(['analyze', str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == '' and re.fullmatch(r'ou-monitor[^\n]+is damaged at byte[^\n]+\n', err)
    assert main(['analyze', str(path), '--partial']) == 0
    assert 'is damaged at byte' in ' '.join(capsys.readouterr().out.split())


def test_heads_without_any_checksum(tmp_path):
    """A message lost behind a wrong opcode, length or channel is missed by the count."""
    path = write(tmp_path / 'bag.mcap', ROWS, use_chunking=False, enable_crcs=False)
    data = path.read_bytes()
    found = [r for r in records(data) if r[2]]
    rng = np.random.default_rng(4)
    for k in rng.integers(len(found), size=60).tolist():
        broken = bytearray(data)
        # Opcode, length (8), channel (2).
        broken[found[k][0] + int(rng.integers(11))] ^= int(rng.integers(1, 256))
        path.write_bytes(broken)
        assert 'is damaged at byte' in complaint(BagReader, path)
        if k:
            recording = read(path, partial=True)
            assert recording.voltage.tolist()[:k // 2] == volts(ROWS)[:k // 2]
            assert any('damaged' in note for note in recording.notes)


def test_messages_that_do_not_fit_their_type(tmp_path):
    """Whole in their chunk, but cut short: refused with the time, or left out alone."""
    rows = [(topic, kind, t, data[:7] if k in (100, 200) else b'' if k == 300 else data)
            for k, (topic, kind, t, data) in enumerate(
                row for row in ROWS if row[0] == '/voltage')]
    path = write(tmp_path / 'bag.mcap', rows)
    line = complaint(read, path)
    assert 'cannot be decoded' in line and at_time(START + 100 * MS) in line
    whole = read(path, partial=True)
    np.testing.assert_array_equal(whole.voltage, np.delete(volts(), [100, 200, 300]))
    assert any('3 messages dropped' in note and at_time(START + 100 * MS) in note
               for note in whole.notes)


def test_definitions_from_the_summary(tmp_path):
    """Broken ones at the start of a file do not take all messages with them."""
    path = write(tmp_path / 'bag.mcap', ROWS)
    data = bytearray(path.read_bytes())
    first = next(r for r in records(bytes(data)) if r[2])
    data[(first[0] + first[1]) // 2] ^= 0x55
    path.write_bytes(data)
    assert read(path, partial=True).voltage.tolist() == volts(ROWS[first[2]:])
    data = write(path, ROWS, use_chunking=False).read_bytes()
    for opcode, far in ((0x04, 9 + 4 + 3), (0x03, 9 + 2 + 3)):
        broken = bytearray(data)
        at = next(r[0] for r in records(data) if data[r[0]] == opcode)
        # The length of a text, made far too large.
        broken[at + far] = 0x7f
        path.write_bytes(broken)
        found = read(path, partial=True)
        assert found.voltage.tolist() == volts()
        assert any(f'at byte {at}: a ' in note for note in found.notes)


def test_the_frame_is_found_again(tmp_path):
    """A wrong length hides nothing where the summary is whole."""
    path = write(tmp_path / 'bag.mcap', ROWS)
    data = bytearray(path.read_bytes())
    chunks = [r for r in records(bytes(data)) if r[2]]
    data[chunks[3][0] + 4] ^= 0x10
    path.write_bytes(data)
    for partial in (False, True):
        assert read(path, partial=partial).voltage.tolist() == volts()


@pytest.mark.parametrize('counted', [True, False])
def test_a_private_record(tmp_path, counted):
    """Passed over where the messages are counted, else it may have been one."""
    path = write(tmp_path / 'bag.mcap', ROWS, use_chunking=False, use_statistics=counted)
    data = bytearray(path.read_bytes())
    at = next(r[0] for r in records(bytes(data)) if data[r[0]] == 0x0C)
    data[at] = 0x9C
    path.write_bytes(data)
    found = read(path, partial=True)
    assert found.voltage.tolist() == volts()
    notes = [note for note in found.notes if 'private kind' in note]
    assert len(notes) == (not counted) and all(f'at byte {at}:' in note for note in notes)


def test_an_unknown_compression(tmp_path):
    path = write(tmp_path / 'bag.mcap', ROWS, enable_crcs=False)
    path.write_bytes(path.read_bytes().replace(b'zstd', b'zsTd'))
    assert "unknown compression 'zsTd'" in complaint(read, path)
    assert 'holds no messages' in complaint(read, path, partial=True)


def test_zeros_in_the_file(tmp_path):
    """A hole, as a file system leaves it after a power cut."""
    path = write(tmp_path / 'bag.mcap', ROWS)
    data = path.read_bytes()
    chunks = [r for r in records(data) if r[2]]
    path.write_bytes(data[:chunks[2][0]] + bytes(len(data) - chunks[2][0]))
    assert '0x00' in complaint(BagReader, path)
    assert read(path, partial=True).voltage.tolist() == volts(ROWS[:sum(
        r[2] for r in chunks[:2])])


@pytest.mark.parametrize('shift', [0, 10**6])
def test_a_damaged_summary(tmp_path, shift):
    """The messages are whole: the file is scanned, and a note says that nothing counts them."""
    path = write(tmp_path / 'bag.mcap', ROWS)
    data = bytearray(path.read_bytes())
    start = int.from_bytes(data[-28:-20], 'little')
    data[start + 40] ^= 0xff
    data[-28:-20] = (start + shift).to_bytes(8, 'little')
    path.write_bytes(data)
    found = read(path)
    assert found.voltage.tolist() == volts()
    assert any('The summary of bag.mcap is damaged' in note for note in found.notes)


def test_one_of_several_files(tmp_path):
    folder = folder_of(tmp_path / 'bag', 'bag_0.mcap', 'bag_1.mcap')
    write(folder / 'bag_0.mcap', ROWS)
    data = (folder / 'bag_0.mcap').read_bytes()
    (folder / 'bag_1.mcap').write_bytes(data[:len(data) // 2])
    line = complaint(BagReader, folder)
    assert 'bag_1.mcap is damaged at byte' in line and 'into the recording' in line
    reader = BagReader(folder, partial=True)
    assert reader.damage.startswith('bag_1.mcap is damaged at byte')
    assert COUNT < reader.message_count < 2 * len(ROWS)


def refused_bag(path, **options):
    """Return the one line with which a bag is refused, which names it."""
    line = complaint(BagReader, path, **options)
    assert str(path) in line
    return line


def test_missing_and_empty_paths_are_refused(tmp_path):
    assert 'there is no recording' in refused_bag(tmp_path / 'no.mcap')
    (tmp_path / 'empty.mcap').touch()
    assert 'empty (0 bytes)' in refused_bag(tmp_path / 'empty.mcap')
    (tmp_path / 'folder' / 'bag').mkdir(parents=True)
    assert 'neither metadata.yaml nor an .mcap' in refused_bag(tmp_path / 'folder')
    (tmp_path / 'folder' / 'bag' / 'metadata.yaml').touch()
    assert "name one of the bags in it, or give all to 'ou-monitor fleet'" in refused_bag(
        tmp_path / 'folder')
    (tmp_path / 'logs').mkdir()
    (tmp_path / 'logs' / 'a.mcap').touch()
    assert 'name one of the .mcap files in it' in refused_bag(tmp_path / 'logs')
    (tmp_path / 'logs' / 'a.mcap').rename(tmp_path / 'logs' / 'logs_0.mcap')
    assert 'was cut off; use --partial' in refused_bag(tmp_path / 'logs')


@pytest.mark.parametrize('content, words', [
    (b'SQLite format 3\0' + bytes(100), 'ros2 bag convert'),
    (b'#ROSBAG V2.0\n', 'ROS 1'),
    (b'time_s,voltage_v\n0,5\n', 'text'),
    (b'ULog\x01\x12\x35', 'ULog'),
    (b'\x28\xb5\x2f\xfd\x00\x00', 'zstd -d'),
    (bytes(range(128, 192)), '80 81 82'),
    (MAGIC[:5], 'not an MCAP file'),
])
def test_foreign_files_are_refused_with_their_likely_kind(tmp_path, content, words):
    """The error says what to do; --partial makes no difference."""
    path = tmp_path / 'foreign.mcap'
    path.write_bytes(content)
    for partial in (False, True):
        line = refused_bag(path, partial=partial)
        assert 'not an MCAP file' in line and words in line


def test_a_bag_without_messages(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('voltage', FLOAT64)
    assert 'holds no messages (topics: /voltage)' in refused_bag(tmp_path / 'bag')
    with BagWriter(tmp_path / 'none.mcap'):
        pass
    assert 'holds no messages (topics: none)' in refused_bag(tmp_path / 'none.mcap')


@pytest.fixture
def folder(tmp_path):
    """Return a rosbag2 directory of 20 messages."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('voltage', FLOAT64)
        for k, data in enumerate(encode_scalars(FLOAT64, np.arange(20.0))):
            bag.write('voltage', k + 1, data)
    return tmp_path / 'bag'


def test_a_recording_that_was_cut_off_has_no_metadata(folder):
    """Rosbag2 writes metadata.yaml last."""
    (folder / 'metadata.yaml').unlink()
    line = refused_bag(folder)
    assert 'metadata.yaml is missing' in line and '--partial' in line
    found = read(folder, partial=True)
    assert found.n == 20 and any('metadata.yaml' in note for note in found.notes)


@pytest.mark.parametrize('change, words', [
    ({'storage_identifier': 'sqlite3'}, 'ros2 bag convert'),
    ({'relative_file_paths': ['gone.mcap']}, "'gone.mcap'"),
    ({'relative_file_paths': []}, 'relative_file_paths'),
    ({'relative_file_paths': 'x'}, 'relative_file_paths')])
def test_mismatched_metadata_is_refused(folder, change, words):
    """The error names the defect in metadata.yaml."""
    content = yaml.safe_load((folder / 'metadata.yaml').read_text())
    content['rosbag2_bagfile_information'] |= change
    (folder / 'metadata.yaml').write_text(yaml.safe_dump(content))
    assert words in refused_bag(folder)


@pytest.mark.parametrize('text', ['', 'a: [', 'a: 1', '- 1', '\x00'])
def test_wrong_metadata_is_refused(folder, text):
    (folder / 'metadata.yaml').write_text(text)
    assert 'metadata.yaml' in refused_bag(folder)


def test_file_without_permission_is_refused(tmp_path, monkeypatch):
    """The error is the operating system's reason, in one line."""
    path = write(tmp_path / 'bag.mcap', ROWS)

    def refuse(*_, **__):
        raise PermissionError(13, 'Permission denied')
    monkeypatch.setattr('os.open', refuse)
    assert 'Permission denied' in refused_bag(path)


def test_two_definitions_of_one_type(tmp_path):
    folder = folder_of(tmp_path / 'bag', 'bag_0.mcap', 'bag_1.mcap')
    for k, fields in enumerate(('float64 data\n', 'float32 other\nfloat32 data\n')):
        with BagWriter(folder / f'bag_{k}.mcap') as bag:
            bag.add_topic('voltage', FLOAT64, schema=fields)
            bag.write('voltage', k + 1, encode_scalars(FLOAT64, [5.0])[0])
    assert 'two definitions' in complaint(read, folder)


# -- every stated size is checked before it is used

N = 100
GB = 2**30
SOUND = schema() + channel() + messages(N)


def zeros(compressor):
    """Return 2 GB of zeros, compressed block by block."""
    block = bytes(2**24)
    return b''.join(compressor.compress(block) for _ in range(128)) + compressor.flush()


def zstd(**options):
    return zstandard.ZstdCompressor(level=1).compressobj(**options)


def lz4_bomb():
    """Return 2 GB as lz4."""
    frame = lz4.frame.LZ4FrameCompressor()
    return frame.begin() + zeros(frame)


@pytest.mark.parametrize('compression, packed', [
    ('zstd', lambda: zeros(zstd())), ('zstd', lambda: zeros(zstd(size=2 * GB))),
    ('lz4', lz4_bomb), ('lz4', lambda: lz4.frame.LZ4FrameCompressor().begin()),
], ids=['zstd', 'zstd, size stated', 'lz4', 'lz4 without end'])
@pytest.mark.parametrize('stated', [N, 2 * GB])
def test_a_chunk_that_unpacks_to_more(tmp_path, monkeypatch, compression, packed, stated):
    """Neither a stated nor an actual size beyond the limit is unpacked; memory does not grow."""
    path = by_hand(tmp_path / 'a.mcap', SOUND, chunk(
        b'', compression=compression, packed=packed(), stated=stated))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    if stated != N:
        monkeypatch.setattr(mcap_file, '_MOST_OF_CHUNK', 64_000_000)
    line = complaint(BagReader, path)
    assert ('is the limit' in line) == (stated != N) and 'the chunk there is broken' in line
    bag = BagReader(path, partial=True)
    assert len(list(bag.raw_messages())) == N
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_the_limit_of_a_chunk(tmp_path, monkeypatch):
    path = by_hand(tmp_path / 'a.mcap', chunk(SOUND))
    assert BagReader(path).message_count == N
    monkeypatch.setattr(mcap_file, '_MOST_OF_CHUNK', 1000)
    assert '0.001 MB is the limit' in complaint(BagReader, path)


def index_of(chunk_at=len(HEAD), *, chunk_length, unpacked, index_length=0, offset=None):
    behind = (chunk_at + chunk_length) % 2**64
    offsets = struct.pack('<HQ', 1, behind if offset is None else offset)
    return record(Op.CHUNK_INDEX, struct.pack('<QQQQ', 1000, 1000 * N, chunk_at, chunk_length),
                  text(offsets), struct.pack('<Q', index_length), text(''),
                  struct.pack('<QQ', unpacked, unpacked))


def statistics():
    return record(Op.STATISTICS, struct.pack('<QHIIIIQQ', N, 1, 1, 0, 0, 1, 1000, 1000 * N),
                  text(struct.pack('<HQ', 1, N)))


def indexed(path, content, *parts, index=b'', definitions=None, times=1, n=N, **lies):
    """Write a chunk, its message index, and a summary, in which anything may be wrong."""
    one = chunk(content, n=n)
    place = {'chunk_length': len(one), 'unpacked': len(content), 'index_length': len(index),
             **lies}
    return by_hand(path, one, index, *parts, summary=b''.join([
        definitions or schema() + channel(), index_of(**place) * times, statistics()]))


LIES = {
    'sound': {}, 'short': {'chunk_length': 3}, 'none': {'chunk_length': 0},
    'far': {'chunk_at': 2**63}, 'huge': {'chunk_length': 2**63}, 'wrap': {'chunk_at': 2**64 - 8},
    'index': {'index_length': 2**63}, 'index_far': {'offset': 2**63},
    'unpacked': {'unpacked': 7}, 'unpacked_huge': {'unpacked': 2**62}, 'head': {'chunk_at': 0},
}


@pytest.mark.parametrize('lie', LIES)
@pytest.mark.parametrize('times', [1, 50])
def test_false_index_is_refused(tmp_path, lie, times):
    path = indexed(tmp_path / 'a.mcap', SOUND, times=times, **LIES[lie])
    began = time.process_time()
    try:
        assert read_recording(path).n == N
    except InputError as error:
        assert lie.startswith('unpacked') and str(error).isprintable()
    else:
        # A chunk that is listed more than once is found by the walk.
        assert times > 1 or not lie.startswith('unpacked')
    assert time.process_time() - began < 10.0


def test_much_metadata_is_read_in_part(tmp_path):
    big = record(Op.METADATA, text('ou_monitor'), text(text('vehicle') + text('#' * 900_000)))
    path = by_hand(tmp_path / 'a.mcap', *[big] * 50, chunk(SOUND))
    began = time.process_time()
    bag = BagReader(path)
    assert time.process_time() - began < 15.0
    assert bag.message_count == N and len(bag.about['vehicle']) == 1000 and len(bag.notes) == 1


def pairs(*places):
    """Return a message index of channel 1."""
    content = b''.join(struct.pack('<QQ', 0, place) for place in places)
    return record(Op.MESSAGE_INDEX, struct.pack('<H', 1), text(content))


# Where the messages are in a chunk behind a schema and a channel, and what a message takes.
FIRST, STEP = len(schema() + channel()), len(message(0, bytes(12)))
PLACES = [FIRST + STEP * k for k in range(N)]


@pytest.mark.parametrize('index', [
    pairs(*PLACES), pairs(*PLACES[::-1]), b'', b'\x07', pairs(), pairs(2**63), pairs(2**64 - 1),
    pairs(*PLACES[1:]), pairs(*PLACES[:-1]), pairs(*PLACES, PLACES[3]), pairs(0, *PLACES),
    pairs(*PLACES[:5], PLACES[5] + 1, *PLACES[6:]), pairs(*PLACES[:-1], 2**63 + 5),
    pairs(*PLACES)[:-1], record(Op.MESSAGE_INDEX, bytes(5)), record(Op.MESSAGE_INDEX, bytes(6)),
    record(Op.MESSAGE_INDEX, bytes(6), length=2**63), record(Op.MESSAGE, bytes(22)),
    pairs(*PLACES) + b'\x00' * 9])
def test_a_message_index_is_verified_or_left(tmp_path, index):
    """Places outside, twice, beside messages or incomplete: the chunk itself is asked instead."""
    path = indexed(tmp_path / 'a.mcap', SOUND, index=index)
    assert read_recording(path).voltage.tolist() == (5.0 + np.arange(N)).tolist()


@pytest.mark.parametrize('length', [2**63 - 1, 2**63, 2**64 - 1, 2**64 - 9, 2**31, 21, 0])
def test_a_length_within_a_chunk(tmp_path, length):
    content, index = bytearray(SOUND), pairs(*PLACES)
    struct.pack_into('<Q', content, PLACES[2] + 1, length)
    for path in (indexed(tmp_path / 'a.mcap', bytes(content), index=index),
                 by_hand(tmp_path / 'b.mcap', chunk(bytes(content)), index)):
        assert 'cut off' in (line := complaint(read_recording, path)) or 'shorter' in line


OTHER = schema(definition='float32 more\nfloat32 data\n')
BOMB = message(0, bytes(2**20 - 100), 1)


@pytest.mark.parametrize('parts, words', [
    # Each chunk is within its limit; together they are out of proportion to the file.
    ([SOUND, chunk(BOMB, n=1, compression='zstd', packed=zstandard.compress(BOMB)) * 40],
     'and the chunks before it hold'),
    ([SOUND, chunk(bytes(9 * 1_000_000), n=1)], 'in it are not messages'),
    ([chunk(SOUND), chunk(OTHER + messages(N))], 'defined a second time'),
    ([chunk(SOUND), OTHER], 'defined a second time'),
    # XCDR2 aligns otherwise: its numbers are never read as plain CDR.
    *(([schema(definition='uint32 n\nfloat64 data\n'), channel(),
        message(0, encoding + struct.pack('<HId', 0, 0, 5.0))], 'not plain CDR')
      for encoding in (b'\x00\x07', b'\x00\x09', b'\x00\x02', b'\x01\x01')),
], ids=lambda value: value.replace(' ', '-') if isinstance(value, str) else '')
def test_what_is_refused(tmp_path, monkeypatch, parts, words):
    limit = 2**20 if words.startswith('and the chunks') else 10_000_000
    monkeypatch.setattr(mcap_file, '_MOST_OF_CHUNK', limit)
    assert words in complaint(read_recording, by_hand(tmp_path / 'a.mcap', *parts), within=5.0)


def test_a_second_definition_in_the_summary(tmp_path):
    """A schema that becomes another one is never taken for the first."""
    path = indexed(tmp_path / 'a.mcap', SOUND, definitions=OTHER + channel())
    assert 'defined a second time' in complaint(read_recording, path)


@pytest.mark.parametrize('parts, notes', [
    *(([schema(), channel(offered_qos_profiles=qos), messages(N)], 0)
      for qos in ('- {reliability: [1]}', '[' * 9000, '&a [*a]', 'x' * 10**6, '\x00')),
    # ROS has no names of more than 256 characters, and no definition of megabytes.
    ([chunk(SOUND + b''.join(channel('/' + 'x' * 300 + str(k), k + 2) for k in range(1000)))], 20),
    ([chunk(schema('a/msg/B', 'float64 data\n' * 100_000, 2) + channel('/b', 2, 2) + SOUND)], 1)])
def test_what_is_left_out(tmp_path, parts, notes):
    bag = BagReader(by_hand(tmp_path / 'a.mcap', *parts))
    assert (bag.counts, len(bag.notes)) == ({'/voltage': N}, notes)
    assert all(len(note) < 400 for note in bag.notes)


def test_messages_outside_of_chunks(tmp_path):
    end = PLACES[60]
    path = indexed(tmp_path / 'a.mcap', SOUND[:end], SOUND[end:], n=60)
    assert read_recording(path).n == N


NASTY = '/volt\x1b]0;title\x07\x1b[2Jage\r\n\u202e'


def test_names_do_not_reach_the_terminal(tmp_path):
    """Topics, types, what a bag says of itself, file names: in errors and in notes."""
    folder = tmp_path / 'nasty\x1b[31m\n'
    folder.mkdir()
    path = by_hand(folder / 'x\x1b[2J.mcap', chunk(
        schema() + channel(NASTY) + schema('a/msg/\x1b[3m', key=2) + channel('/b\x9b', 2, 2)
        + record(Op.SCHEMA, struct.pack('<H', 3), text('x'), text('json\x1b[1m'), text(''))
        + channel('/c\x1b[0m', 3, 3) + messages(N)),
        record(Op.METADATA, text('ou_monitor'), text(text('vehicle\x1b') + text('UAV\x1b[5m\n'))))
    bag = BagReader(path)
    for name in (*bag.topics, *bag.topics.values(), *bag.notes, *bag.about, *bag.about.values()):
        assert name.isprintable(), name
    whole = read_recording(path)
    assert whole.n == N and whole.name.isprintable()
    for word in (*whole.notes, *whole.source.values()):
        assert word.isprintable()
    line = complaint(read_recording, path, voltage_topic='/none')
    assert 'volt' in line and '\x1b' not in line
    complaint(BagReader, folder / 'gone\x1b[2J.mcap')


def test_topics_of_any_number(tmp_path):
    many = b''.join(channel(f'/x{k}', k + 2) for k in range(3000))
    path = by_hand(tmp_path / 'a.mcap', chunk(
        schema() + many + b''.join(message(k, bytes(12), 2 + k) for k in range(3000))))
    line = complaint(read_recording, path, within=10.0)
    assert len(line) < 5000 and 'more' in line
    assert len(complaint(read_recording, path, voltage_topic='/none', within=10.0)) < 5000


LONG = '=' * 80 + '\nMSG: a/T\n'


@pytest.mark.parametrize('definition, data', [
    (f'float64 data\na/T[] many\n{LONG}uint8[1] x\n', struct.pack('<dI', 5.0, 2**32 - 1)),
    (f'float64 data\na/T[] many\n{LONG}uint8[0] x\n', struct.pack('<dI', 5.0, 2**32 - 1)),
    (f'float64 data\na/T[4000000000] many\n{LONG}byte[2] x\n', struct.pack('<d', 5.0)),
    ('float64 data\na/T0 x\n' + ''.join(
        f'{"=" * 80}\nMSG: a/T{k}\na/T{k + 1} p\na/T{k + 1} q\n' for k in range(60))
     + f'{"=" * 80}\nMSG: a/T60\nuint8[0] x\n', struct.pack('<d', 5.0)),
], ids=['array', 'nothing', 'fixed', 'tree'])
def test_endless_message_is_refused(tmp_path, definition, data):
    """A few bytes that state 2^32 elements of no bytes: no decoder is busy with them for ever."""
    path = by_hand(tmp_path / 'a.mcap', chunk(
        schema('a/msg/M', definition) + channel() + message(0, b'\x00\x01\x00\x00' + data)))
    line = complaint(read_signal, path, '/voltage/data')
    assert 'more elements than it has bytes' in line or 'nested too deep' in line or (
        'definition cannot be read' in line)


@pytest.mark.parametrize('junk', [
    record(0x80), record(Op.CHUNK), record(Op.METADATA, text('a'), text('')) + message(0, b'x', 9),
    message(0, bytes(12)) + record(0x80)], ids=['private', 'broken', 'undefined', 'runs'])
def test_much_of_it_takes_no_time(tmp_path, junk):
    """Time and notes grow no faster than the file, whatever it is full of."""
    path = by_hand(tmp_path / 'a.mcap', SOUND, junk * 30_000)
    began = time.process_time()
    bag = BagReader(path, partial=True)
    assert time.process_time() - began < 20.0
    assert len(bag.notes) < 50 and bag.damage and len(bag.damage) < 500


def test_a_channel_many_times(tmp_path):
    """All 65 535 numbers are of one topic: reading a chunk costs no more than its content."""
    many = b''.join(channel('/voltage', k) for k in range(1, 65536))
    path = by_hand(tmp_path / 'a.mcap', chunk(schema() + many), *[chunk(messages(N))] * 50)
    began = time.process_time()
    assert read_recording(path).n == N
    assert time.process_time() - began < 15.0


@pytest.mark.parametrize('name', ['a.mcap', 'a.csv', 'a'])
def test_endless_recordings_are_refused(tmp_path, name):
    """FIFO, device, loop and dangling link: one line at once."""
    path = tmp_path / name
    os.mkfifo(path)
    assert 'not a regular file' in complaint(read_recording, path)
    path.unlink()
    path.symlink_to('/dev/zero')
    assert 'not a regular file' in complaint(read_recording, path)
    path.unlink()
    path.symlink_to(path)
    assert name in complaint(read_recording, path)


def test_wrong_metadata_and_parts_are_refused(tmp_path):
    folder = tmp_path / 'bag'
    with BagWriter(folder) as bag:
        bag.add_topic('voltage', FLOAT64)
        bag.write('voltage', 1, encode_scalars(FLOAT64, [5.0])[0])
    (folder / 'bag_0.mcap').unlink()
    os.mkfifo(folder / 'bag_0.mcap')
    assert 'bag_0.mcap' in complaint(read_recording, folder)
    (folder / 'metadata.yaml').unlink()
    os.mkfifo(folder / 'metadata.yaml')
    assert 'not a regular file' in complaint(read_recording, folder)


def test_csv_lines_have_an_end(tmp_path):
    """A line of megabytes is refused when it is met, in the header and below it."""
    for k, content in enumerate([b'x' * 10**7, b'time_s,voltage_v\n0,5\n' + b'1' * 10**7,
                                 b'time_s,voltage_v\n0,5\n"' + b'1\n' * 10**6]):
        path = tmp_path / f'{k}.csv'
        path.write_bytes(content)
        line = complaint(read_recording, path)
        assert len(line) < len(str(path)) + 200, line


def test_columns_without_end_are_listed_in_part(tmp_path):
    names = [f'c{k}' for k in range(1500)]
    path = tmp_path / 'a.csv'
    path.write_text(','.join(['time_s', *names]) + '\n' + ','.join(['1'] * 1501) + '\n')
    log = import_log(path, Request(everything=True))
    assert len(log.series) == MOST_COLUMNS
    assert f'{1500 - MOST_COLUMNS} more columns' in log.notes[-1]


def test_names_in_a_csv_do_not_reach_the_terminal(tmp_path):
    """In errors, in the list of columns, and in the error about a column of text."""
    path = tmp_path / 'a.csv'
    path.write_text('time_s,voltage_v,a\x9b2J,b\u202e\n0,5,1,x\n1,5,1,x\n')
    log = import_log(path, Request(everything=True))
    assert all(word.isprintable() for word in (*log.notes, *(one.name for one in log.series)))
    path.write_text('time_s,bus\x1b[2J\n0,5\n')
    assert 'bus' in complaint(read_recording, path)
