"""Missing, foreign, truncated or damaged bags: one line gives the reason, the rest is read."""

import re
import shutil

from made_bags import COUNT, MS, records, START, supply, WAYS, write
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader, BagWriter
from ou_monitor.recordings.mcap_file import MAGIC
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import encode_scalars, FLOAT64
import pytest
import yaml

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


def refusal(call):
    """Return the one line with which something is refused."""
    with pytest.raises(InputError) as caught:
        call()
    assert '\n' not in str(caught.value)
    return str(caught.value)


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
    line = refusal(lambda: BagReader(path))
    assert f'is damaged at byte {byte}:' in line and '--partial' in line
    if not left:
        assert 'before the first message' in line
        assert 'holds no messages' in refusal(lambda: read(path, partial=True))
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
        refusal(lambda: BagReader(tmp_path / 'head.mcap', partial=True))


def test_bytes_after_the_end_are_reported(sound, tmp_path):
    """Another file behind the first would be lost without a word."""
    _, data = sound
    for more in (data, b'\0', bytes(100)):
        path = tmp_path / 'bag.mcap'
        path.write_bytes(data + more)
        assert f'at byte {len(data)}: {len(more)} bytes follow' in refusal(lambda: BagReader(path))
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
    refusal(lambda: read(path))
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
        line = refusal(lambda call=call: call(path))
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
        assert 'is damaged at byte' in refusal(lambda: BagReader(path))
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
    line = refusal(lambda: read(path))
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
    assert "unknown compression 'zsTd'" in refusal(lambda: read(path))
    assert 'holds no messages' in refusal(lambda: read(path, partial=True))


def test_zeros_in_the_file(tmp_path):
    """A hole, as a file system leaves it after a power cut."""
    path = write(tmp_path / 'bag.mcap', ROWS)
    data = path.read_bytes()
    chunks = [r for r in records(data) if r[2]]
    path.write_bytes(data[:chunks[2][0]] + bytes(len(data) - chunks[2][0]))
    assert '0x00' in refusal(lambda: BagReader(path))
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
    folder = tmp_path / 'bag'
    folder.mkdir()
    write(folder / 'bag_0.mcap', ROWS)
    data = (folder / 'bag_0.mcap').read_bytes()
    (folder / 'bag_1.mcap').write_bytes(data[:len(data) // 2])
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        '  relative_file_paths: [bag_0.mcap, bag_1.mcap]\n')
    line = refusal(lambda: BagReader(folder))
    assert 'bag_1.mcap is damaged at byte' in line and 'into the recording' in line
    reader = BagReader(folder, partial=True)
    assert reader.damage.startswith('bag_1.mcap is damaged at byte')
    assert COUNT < reader.message_count < 2 * len(ROWS)


def complaint(path, **options):
    """Return the one line with which a bag is refused, which names it."""
    line = refusal(lambda: BagReader(path, **options))
    assert str(path) in line
    return line


def test_missing_and_empty_paths_are_refused(tmp_path):
    assert 'there is no recording' in complaint(tmp_path / 'no.mcap')
    (tmp_path / 'empty.mcap').touch()
    assert 'empty (0 bytes)' in complaint(tmp_path / 'empty.mcap')
    (tmp_path / 'folder' / 'bag').mkdir(parents=True)
    assert 'neither metadata.yaml nor an .mcap' in complaint(tmp_path / 'folder')
    (tmp_path / 'folder' / 'bag' / 'metadata.yaml').touch()
    assert "name one of the bags in it, or give all to 'ou-monitor fleet'" in complaint(
        tmp_path / 'folder')
    (tmp_path / 'logs').mkdir()
    (tmp_path / 'logs' / 'a.mcap').touch()
    assert 'name one of the .mcap files in it' in complaint(tmp_path / 'logs')
    (tmp_path / 'logs' / 'a.mcap').rename(tmp_path / 'logs' / 'logs_0.mcap')
    assert 'was cut off; use --partial' in complaint(tmp_path / 'logs')


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
        line = complaint(path, partial=partial)
        assert 'not an MCAP file' in line and words in line


def test_a_bag_without_messages(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('voltage', FLOAT64)
    assert 'holds no messages (topics: /voltage)' in complaint(tmp_path / 'bag')
    with BagWriter(tmp_path / 'none.mcap'):
        pass
    assert 'holds no messages (topics: none)' in complaint(tmp_path / 'none.mcap')


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
    line = complaint(folder)
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
    assert words in complaint(folder)


@pytest.mark.parametrize('text', ['', 'a: [', 'a: 1', '- 1', '\x00'])
def test_wrong_metadata_is_refused(folder, text):
    (folder / 'metadata.yaml').write_text(text)
    assert 'metadata.yaml' in complaint(folder)


def test_file_without_permission_is_refused(tmp_path, monkeypatch):
    """The error is the operating system's reason, in one line."""
    path = write(tmp_path / 'bag.mcap', ROWS)

    def refuse(*_, **__):
        raise PermissionError(13, 'Permission denied')
    monkeypatch.setattr('os.open', refuse)
    assert 'Permission denied' in complaint(path)


def test_two_definitions_of_one_type(tmp_path):
    folder = shutil.copytree(tmp_path, tmp_path / 'bag')
    for k, text in enumerate(('float64 data\n', 'float32 other\nfloat32 data\n')):
        with BagWriter(folder / f'bag_{k}.mcap') as bag:
            bag.add_topic('voltage', FLOAT64, schema=text)
            bag.write('voltage', k + 1, encode_scalars(FLOAT64, [5.0])[0])
    (folder / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        '  relative_file_paths: [bag_0.mcap, bag_1.mcap]\n')
    assert 'two definitions' in refusal(lambda: read(folder))
