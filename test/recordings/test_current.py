"""Current with voltage: from a CSV, from its own topic, from the battery's message."""

import numpy as np
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_scalars, FLOAT32)
import pytest

STAMPS = np.arange(5) * 100_000_000


def bag(path, battery_current, currents=None):
    """Write a bag of 5 voltages with a current in each, and a topic of currents beside."""
    with BagWriter(path) as writer:
        writer.add_topic('voltage', BATTERY_STATE)
        if currents is not None:
            writer.add_topic('current', FLOAT32)
        messages = list(encode_battery(STAMPS, np.full(5, 16.0)))
        for k, t in enumerate(STAMPS.tolist()):
            if currents is not None and k in currents:
                writer.write('/current', t, next(iter(encode_scalars(
                    FLOAT32, np.array([currents[k]])))))
            # voltage, temperature and current are three float32 after the header.
            message = bytearray(messages[k])
            at = message.find(np.float32(16.0).tobytes())
            message[at + 8:at + 12] = np.float32(battery_current[k]).tobytes()
            writer.write('/voltage', t, bytes(message))
    return path


def test_the_current_of_a_battery_is_drawn_when_negative(tmp_path):
    path = bag(tmp_path / 'a.mcap', [-1.0, np.nan, -3.0, -4.0, 5.0])
    np.testing.assert_array_equal(read_recording(path).current, [1.0, np.nan, 3.0, 4.0, -5.0])
    np.testing.assert_array_equal(read_recording(path, start=0.15).current, [3.0, 4.0, -5.0])


def test_a_topic_of_its_own_goes_first_and_holds(tmp_path):
    path = bag(tmp_path / 'a.mcap', [9.0] * 5, {1: 20.0, 3: 30.0})
    np.testing.assert_array_equal(read_recording(path).current, [np.nan, 20.0, 20.0, 30.0, 30.0])


def test_missing_current_is_none(tmp_path):
    assert read_recording(bag(tmp_path / 'a.mcap', [np.nan] * 5)).current is None
    path = tmp_path / 'a.csv'
    path.write_text('time_s,voltage_v\n0,5\n1,5\n')
    assert read_recording(path).current is None


@pytest.mark.parametrize('header, row', [
    ('time_s,voltage_v,current_a', '{},5,{}'), ('current_a,time_s,throttle,voltage_v',
                                                '{1},{0},0.5,5')])
def test_a_column_of_a_csv(tmp_path, header, row):
    path = tmp_path / 'a.csv'
    path.write_text('\n'.join([header, *(row.format(t, t * 10) for t in (0, 2, 1))]) + '\n')
    recording = read_recording(path)
    np.testing.assert_array_equal(recording.current, [0.0, 10.0, 20.0])
    assert recording.has_throttle is ('throttle' in header)


def test_each_message_of_a_battery_has_a_current_of_its_own(tmp_path, monkeypatch):
    """Of two with one stamp the first is kept, and its current, as the node pairs them."""
    monkeypatch.setattr('test_current.STAMPS', STAMPS // 2 * 2 // 200_000_000 * 200_000_000)
    recording = read_recording(bag(tmp_path / 'a.mcap', [-1.0, -2.0, -3.0, -4.0, -5.0]))
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
