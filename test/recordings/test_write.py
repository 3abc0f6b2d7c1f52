"""Recording -> bag -> Recording, and recordings that cannot be written."""

from made_bags import decode
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.bag import BagReader
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.write import TYPES, write_recording
from ou_monitor.records import Recording
import pytest

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
