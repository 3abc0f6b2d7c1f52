"""Betaflight and INAV blackbox: scales, flights, the clock, and truncated or damaged logs."""

import re

from made_logs import blackbox, END, load, named, quad
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Defect, defect_of
import pytest

TIME, STICK, VOLTS, AMPERES = 1, 2, 3, 4


def test_a_stick_below_its_lowest_pulse_is_zero_throttle(tmp_path):
    """Logged without its sign it is 4e9; it means zero throttle, not full throttle."""
    rows = quad()
    rows[:8, STICK] = (988, 2 ** 32 - 12, 2 ** 16 - 12, 1000, 2000, 2012, 1500, 1250)
    path, log = load(tmp_path, blackbox(rows))
    stick = choose(path, log, throttle='rcCommand[3]').throttle
    assert stick.values[:8].tolist() == [0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 0.5, 0.25]


@pytest.mark.parametrize('firmware, headers, volts, amperes', [
    ('Betaflight 4.0.0', {}, 0.01, 0.01),
    ('Betaflight 3.5.7 (x)', {}, 0.1, 0.01),
    ('Betaflight 3.1.6', {}, 0.1, None),
    ('Betaflight 2.9.1', {'vbat_scale': '110'}, 3.3 / 4095 * 11, None),
    ('INAV 6.1.1 (x) KAKUTEF7', {}, 0.01, 0.01),
    ('EmuFlight 0.4.1 (x)', {'vbatcellvoltage': '330,350,430'}, 0.01, None),
    ('EmuFlight 0.3.4 (x)', {'vbatcellvoltage': '33,35,43'}, 0.1, None),
    ('', {'vbatcellvoltage': '33,35,43'}, 0.1, None),
])
def test_the_firmware_determines_the_voltage_unit(tmp_path, firmware, headers, volts, amperes):
    rows = quad(64)
    path, log = load(tmp_path, blackbox(rows, headers={'Firmware revision': firmware, **headers}))
    found = named(log)
    np.testing.assert_allclose(found['vbatLatest'].values, rows[:, VOLTS] * volts, rtol=1e-12)
    if amperes is None:
        # What cannot be scaled is told, not guessed: by name it can be had as logged.
        assert (found['amperageLatest'].quantity, found['amperageLatest'].unit) == ('signal', '?')
        assert choose(path, log).current is None
        assert any('amperageLatest was left out' in note for note in log.notes)
    else:
        np.testing.assert_allclose(
            found['amperageLatest'].values, rows[:, AMPERES] * amperes, rtol=1e-12)


def test_a_current_of_zero_is_not_a_measurement(tmp_path):
    """A current that is always zero means that there is no sensor."""
    rows = quad(64)
    rows[:, AMPERES] = 0
    path, log = load(tmp_path, blackbox(rows))
    assert choose(path, log).current is None


def test_the_largest_flight_is_the_default(tmp_path):
    """A note says that the largest flight was read; each one can be chosen."""
    first, second = quad(100), quad(160, start_us=1000)
    second[:, VOLTS] += 50
    content = b''.join(blackbox(first)) + b''.join(blackbox(second))
    path, log = load(tmp_path, content)
    assert log.facts['flight'] == '2 of 2'
    assert re.match(r'The file holds 2 flights \(1: about \d+ s; 2: about \d+ s\); this is ',
                    log.notes[0]) and '--flight N' in log.notes[0]
    for number, rows in ((1, first), (2, second)):
        path, log = load(tmp_path, content, flight=number)
        np.testing.assert_allclose(choose(path, log).voltage.values, rows[:, VOLTS] / 100)
        assert log.facts['flight'] == f'{number} of 2' and log.notes == ()
    listed = import_log(path, Request(everything=True))
    assert listed.series[0].n == 160 and 'holds 2 flights' in listed.notes[0]
    with pytest.raises(InputError, match='no flight 3'):
        load(tmp_path, content, flight=3)


@pytest.mark.parametrize('before_wrap', [1, 31, 32, 33, 100, 299])
def test_the_clock_wraps(tmp_path, before_wrap):
    """The 32-bit clock wraps after 71.6 minutes; the stamps continue."""
    rows = quad(300)
    rows[:, TIME] = (2**32 - 2000 * before_wrap + 2000 * np.arange(300)) % 2**32
    path, log = load(tmp_path, blackbox(rows))
    voltage = choose(path, log).voltage
    assert log.notes == ()
    np.testing.assert_allclose(voltage.t, 2e-3 * np.arange(300), rtol=0, atol=1e-9)
    np.testing.assert_allclose(voltage.values, rows[:, VOLTS] / 100)


def test_a_pause_of_the_log(tmp_path):
    """A log that is switched off and on again keeps both parts and the time between."""
    rows = quad(320)
    rows[160:, TIME] += 100_000_000
    path, log = load(tmp_path, blackbox(rows))
    voltage = choose(path, log).voltage
    assert voltage.n == 320 and log.notes == ()
    assert np.diff(voltage.t).max() == pytest.approx(100.002)


def test_frames_before_the_first_key_frame_are_dropped(tmp_path):
    pieces = blackbox(quad(128))
    path, log = load(tmp_path, [pieces[0], *pieces[5:]])
    assert choose(path, log).voltage.n == 96
    assert 'dropped: no intact key frame before them' in log.notes[0]


def test_a_truncated_log_is_read_up_to_its_end(tmp_path):
    rows = quad(200)
    pieces = blackbox(rows)
    whole = b''.join(pieces)
    rng = np.random.default_rng(10)
    for at in rng.integers(len(pieces[0]) + 100, len(whole) - 1, 40).tolist():
        path, log = load(tmp_path, whole[:at])
        voltage = choose(path, log).voltage
        held = int(np.searchsorted(np.cumsum([len(p) for p in pieces]), at, side='right')) - 1
        # Of the frame that was cut nothing is taken; the one before it cannot be checked.
        assert held - 1 <= voltage.n <= held
        np.testing.assert_allclose(voltage.values, rows[:voltage.n, VOLTS] / 100)
        assert any('no end mark' in note for note in log.notes)
    notes = read_recording(path).notes
    assert 'no end mark' in next(n for n in notes if defect_of(n) is Defect.DAMAGED_FILE)


def test_cut_within_the_header(tmp_path):
    head = blackbox(quad(10))[0]
    for at in range(60, len(head), 17):
        with pytest.raises(InputError) as caught:
            choose(*load(tmp_path, head[:at]))
        assert '\n' not in str(caught.value)


def test_flipped_bytes_give_an_error_or_sound_frames(tmp_path):
    rows = quad(600)
    truth = dict(zip(((rows[:, TIME] - rows[0, TIME]) * 1e-6).round(6), rows[:, VOLTS] / 100))
    pieces = blackbox(rows)
    whole, head = b''.join(pieces), len(pieces[0])
    rng = np.random.default_rng(11)
    right = total = 0
    for _ in range(40):
        broken = bytearray(whole)
        for at in rng.integers(head + 60, len(whole) - len(END), 2):
            broken[at] = rng.integers(0, 256)
        path, log = load(tmp_path, bytes(broken))
        voltage = choose(path, log).voltage
        assert (np.diff(voltage.t) > 0).all()
        assert log.notes or voltage.n >= 595
        total += voltage.n
        right += sum(truth.get(round(t, 6)) == pytest.approx(v)
                     for t, v in zip(voltage.t.tolist(), voltage.values.tolist()))
    # A flip that leaves a frame well formed cannot be seen until the next key frame: at most
    # 32 frames each, so of two flips 64 in 600, were every one of this kind.
    assert total > 0.8 * 40 * 600
    assert right > (1 - 64 / 600) * total


def test_leftovers_after_the_end(tmp_path):
    """Bytes after the end mark are reported, unless they are erased flash."""
    _, log = load(tmp_path, b''.join(blackbox(quad(64))) + b'\xff' * 9000)
    assert log.notes == ()
    _, log = load(tmp_path, b''.join(blackbox(quad(64))) + b'I\x01' * 45)
    assert any('after the end mark' in note for note in log.notes)


@pytest.mark.parametrize('cell, reference, cells, low', [
    ('330,350,430', '2487', '6', '3.3'), ('330,350,430', '1653', '4', '3.3'),
    ('33,35,43', '150', '4', '3.3'), ('33,35,42', '1513', '4', '3.3'),
    ('330,350,430', '420', '1', '3.3'), ('330,350,430', '', None, None),
    ('0,0,0', '1653', None, None)])
def test_cells_of_the_header(cell, reference, cells, low):
    """As the firmware counts them, in the units of Betaflight before and from 4.0, and INAV."""
    from ou_monitor.recordings.importers.blackbox import _facts
    found = _facts({'vbatcellvoltage': cell, 'vbatref': reference})
    assert (found.get('cells'), found.get('cell_minimum')) == (cells, low)
