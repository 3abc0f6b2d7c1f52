"""Bags that are missing, foreign, cut off or damaged: the reason, and what is left."""

import shutil
import struct

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader, BagWriter
from ou_monitor.recordings.mcap_records import MAGIC, RECORD_HEAD
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import encode_scalars, FLOAT64
import pytest
import yaml

COUNT = 20_000


@pytest.fixture(scope='module')
def whole(tmp_path_factory):
    """Return a sound bag of several chunks, as a folder."""
    folder = tmp_path_factory.mktemp('whole') / 'bag'
    values = np.random.default_rng(5).normal(5.0, 0.1, COUNT)
    with BagWriter(folder) as bag:
        bag.add_topic('voltage', FLOAT64)
        for k, data in enumerate(encode_scalars(FLOAT64, values)):
            bag.write('voltage', 1_000_000 * (k + 1), data)
    return folder


@pytest.fixture
def mcap(whole, tmp_path):
    """Return a copy of its file, to be damaged."""
    return shutil.copy(whole / 'bag_0.mcap', tmp_path / 'bag.mcap')


def chunks(data):
    """Return (begin, end) of the records that are chunks, walked independently."""
    at, found = len(MAGIC), []
    while data[at] != 0x02:
        _, length = RECORD_HEAD.unpack_from(data, at)
        if data[at] == 0x06:
            found.append((at, at + 9 + length))
        at += 9 + length
    return found


def complaint(path, **options):
    """Return the one line with which a bag is refused."""
    with pytest.raises(InputError) as caught:
        BagReader(path, **options)
    text = str(caught.value)
    assert '\n' not in text and str(path) in text
    return text


def times(path, **options):
    """Return the log times of all messages."""
    return [m.log_time_ns for m in BagReader(path, **options).raw_messages()]


def test_nothing_there(tmp_path):
    """A missing file, an empty file and an empty folder."""
    assert 'there is no bag' in complaint(tmp_path / 'no.mcap')
    (tmp_path / 'empty.mcap').touch()
    assert 'empty (0 bytes)' in complaint(tmp_path / 'empty.mcap')
    (tmp_path / 'folder').mkdir()
    assert 'neither metadata.yaml nor an .mcap' in complaint(tmp_path / 'folder')
    (tmp_path / 'folder' / 'bag').mkdir()
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
def test_foreign_files(tmp_path, content, words):
    """What it seems to be, and what to do; --partial makes no difference."""
    path = tmp_path / 'foreign.mcap'
    path.write_bytes(content)
    for partial in (False, True):
        text = complaint(path, partial=partial)
        assert 'not an MCAP file' in text and words in text


def test_a_bag_without_messages(tmp_path):
    """A topic alone is nothing to work on."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add_topic('voltage', FLOAT64)
    assert 'holds no messages (topics: /voltage)' in complaint(tmp_path / 'bag')
    with BagWriter(tmp_path / 'none.mcap'):
        pass
    assert 'holds no messages (topics: none)' in complaint(tmp_path / 'none.mcap')


@pytest.mark.parametrize('where', [
    'inside the first record', 'before the second chunk', 'in the head of the second chunk',
    'in the middle', 'inside the last chunk', 'in the summary', 'in the footer',
    'one byte short'])
def test_cut_off(mcap, where):
    """Refused with the byte of the damage; --partial plays every whole chunk before it."""
    data = mcap.read_bytes()
    found = chunks(data)
    assert len(found) >= 4
    cut = {
        'inside the first record': 20, 'before the second chunk': found[1][0],
        'in the head of the second chunk': found[1][0] + 5, 'in the middle': len(data) // 2,
        'inside the last chunk': found[-1][1] - 1, 'in the summary': found[-1][1] + 3000,
        'in the footer': len(data) - 20, 'one byte short': len(data) - 1}[where]
    mcap.write_bytes(data[:cut])
    text = complaint(mcap)
    assert '--partial' in text
    # The damage is named where the last whole record ends: at most one record
    # before the cut.
    damaged = int(text.split('at byte ')[1].split(':')[0])
    assert damaged <= cut
    kept = [pair for pair in found if pair[1] <= cut]
    if not kept:
        assert 'holds no messages' in complaint(mcap, partial=True)
        return
    assert damaged >= kept[-1][1]
    reader = BagReader(mcap, partial=True)
    assert reader.damage is not None and f'at byte {damaged}' in reader.damage
    left = times(mcap, partial=True)
    # The independent count: the end time that the last kept chunk states.
    end_ns = struct.unpack_from('<Q', data, kept[-1][0] + 9 + 8)[0]
    assert left == [1_000_000 * (k + 1) for k in range(end_ns // 1_000_000)]
    assert (len(left) == COUNT) == (len(kept) == len(found))


@pytest.mark.parametrize('cut', [8, 9, 16, 17, 40, 100])
def test_cut_off_before_any_message(mcap, cut):
    """Nothing is left, and that is said."""
    mcap.write_bytes(mcap.read_bytes()[:cut])
    assert 'damaged at byte' in complaint(mcap)
    assert 'holds no messages' in complaint(mcap, partial=True)


@pytest.mark.parametrize('spot', ['zstd', 'checksum'])
def test_a_broken_chunk(mcap, spot):
    """Refused where it is met, with its byte; --partial skips that chunk alone."""
    data = bytearray(mcap.read_bytes())
    found = chunks(data)
    begin, end = found[2]
    place = {'zstd': (begin + end) // 2, 'checksum': begin + 9 + 24}[spot]
    data[place] ^= 0x55
    mcap.write_bytes(data)
    reader = BagReader(mcap)
    played = []
    with pytest.raises(InputError, match=f'at byte {begin + 9}.*--partial'):
        for message in reader.raw_messages():
            played.append(message.log_time_ns)
    limits = [struct.unpack_from('<QQ', data, pair[0] + 9) for pair in found]
    assert played[-1] == limits[1][1]
    with pytest.raises(InputError, match='damaged at byte'):
        read_recording(mcap)
    left = times(mcap, partial=True)
    lost = (limits[2][1] - limits[2][0]) // 1_000_000 + 1
    assert len(left) == COUNT - lost
    assert not [t for t in left if limits[2][0] <= t <= limits[2][1]]
    recording = read_recording(mcap, partial=True)
    assert recording.n == COUNT - lost
    assert any('damaged' in note for note in recording.notes)


def test_zeros_in_the_file(mcap):
    """A hole, as a file system leaves it after a power cut."""
    data = bytearray(mcap.read_bytes())
    found = chunks(data)
    data[found[2][0]:] = bytes(len(data) - found[2][0])
    mcap.write_bytes(data)
    assert '0x00' in complaint(mcap)
    end_ns = struct.unpack_from('<Q', data, found[1][0] + 9 + 8)[0]
    assert times(mcap, partial=True)[-1] == end_ns


def test_a_damaged_summary_costs_nothing(mcap):
    """The messages are whole: the file is scanned instead, and a note says so."""
    data = bytearray(mcap.read_bytes())
    start = struct.unpack_from('<Q', data, len(data) - 28)[0]
    data[start + 40] ^= 0xff
    mcap.write_bytes(data)
    reader = BagReader(mcap)
    assert len(list(reader.raw_messages())) == COUNT
    assert any('summary' in note for note in reader.notes)


def test_random_damage_never_shows_a_traceback(mcap):
    """Whatever is broken, the outcome is a recording or one line."""
    sound = mcap.read_bytes()
    rng = np.random.default_rng(9)
    refused = 0
    for _ in range(40):
        data = bytearray(sound)
        for place in rng.integers(len(MAGIC), len(data), 20):
            data[place] = rng.integers(256)
        mcap.write_bytes(data[:rng.integers(len(data) // 2, len(data) + 1)])
        for partial in (False, True):
            try:
                for _ in BagReader(mcap, partial=partial).raw_messages():
                    pass
            except InputError as error:
                refused += not partial
                assert '\n' not in str(error)
    assert refused == 40


def test_a_recording_that_was_cut_off_has_no_metadata(whole, tmp_path):
    """Rosbag2 writes metadata.yaml last."""
    folder = shutil.copytree(whole, tmp_path / 'bag')
    (folder / 'metadata.yaml').unlink()
    text = complaint(folder)
    assert 'metadata.yaml is missing' in text and '--partial' in text
    reader = BagReader(folder, partial=True)
    assert len(list(reader.raw_messages())) == COUNT
    assert 'metadata.yaml' in reader.damage


@pytest.mark.parametrize('change, words', [
    (lambda info: info.update(storage_identifier='sqlite3'), 'ros2 bag convert'),
    (lambda info: info.update(relative_file_paths=['gone.mcap']), "'gone.mcap'"),
    (lambda info: info.update(relative_file_paths=[]), 'relative_file_paths'),
    (lambda info: info.update(relative_file_paths='x'), 'relative_file_paths')])
def test_metadata_that_does_not_fit(whole, tmp_path, change, words):
    """What is wrong in metadata.yaml is named."""
    folder = shutil.copytree(whole, tmp_path / 'bag')
    content = yaml.safe_load((folder / 'metadata.yaml').read_text())
    change(content['rosbag2_bagfile_information'])
    (folder / 'metadata.yaml').write_text(yaml.safe_dump(content))
    assert words in complaint(folder)


@pytest.mark.parametrize('text', ['', 'a: [', 'a: 1', '- 1', '\x00'])
def test_metadata_that_is_none(whole, tmp_path, text):
    """Empty or broken YAML is one line."""
    folder = shutil.copytree(whole, tmp_path / 'bag')
    (folder / 'metadata.yaml').write_text(text)
    assert 'metadata.yaml' in complaint(folder)


def test_a_file_that_may_not_be_read(mcap, monkeypatch):
    """The reason is that of the system, in one line."""
    def refuse(*_, **__):
        raise PermissionError(13, 'Permission denied')
    monkeypatch.setattr('os.open', refuse)
    assert 'Permission denied' in complaint(mcap)


def test_unknown_topics(mcap):
    """A topic that is not in the bag is named, with the nearest."""
    with pytest.raises(InputError, match="no topic '/volt'.*'/voltage'"):
        list(BagReader(mcap).raw_messages(['/volt']))
