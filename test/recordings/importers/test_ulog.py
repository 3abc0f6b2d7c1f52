"""PX4 ULog: series, scales, and truncated or damaged logs."""

import signal

from made_logs import (
    BATTERY, load, named, outcomes_of_flipped_bytes, px4_flight, ulog, ulog_message)
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
import pytest


@pytest.mark.parametrize('uuid, fact', [
    ('00060038', {'vehicle': 'BOARD_7 00060038'}), ('00000000', {'board': 'BOARD_7'})])
def test_a_vehicle_has_a_number_of_its_own(tmp_path, uuid, fact):
    """Neither the kind of board nor the number 0 of a simulator identifies a vehicle."""
    _, log = load(tmp_path, ulog(px4_flight()[0], info={
        'sys_name': 'PX4', 'ver_sw_branch': 'main', 'ver_hw': 'BOARD_7', 'sys_uuid': uuid}))
    assert log.facts == {'firmware': 'PX4 main', **fact}


def test_a_sample_before_the_start_is_the_start(tmp_path):
    topics, t, *_ = px4_flight()
    _, log = load(tmp_path, ulog(topics, start_us=int(t[0]) + 70_000))
    assert min(one.t[0] for one in log.series) == 0.0


def test_two_connected_batteries_need_a_choice(tmp_path):
    topics, t, volts, *_ = px4_flight()
    second = ('battery_status', 1, BATTERY,
              [(int(a), b + 1, -1.0, True) for a, b in zip(t, volts)])
    empty = ('battery_status', 2, BATTERY, [(int(a), 0.0, -1.0, False) for a in t])
    path, log = load(tmp_path, ulog([*topics, second, empty]))
    with pytest.raises(InputError, match=r'battery_status\[0\].*battery_status\[1\].*--list'):
        choose(path, log)
    chosen = choose(path, log, voltage='battery_status[1].voltage_v')
    np.testing.assert_array_equal(chosen.voltage.values, (volts + 1).astype(float))
    # -1 means "unknown": the current of the other battery is not this one's.
    assert chosen.current is None
    assert 'not connected' in named(log)['battery_status[2].voltage_v'].words
    path, log = load(tmp_path, ulog([*topics, empty]))
    assert choose(path, log).voltage.name == 'battery_status[0].voltage_v'


@pytest.mark.parametrize('fields, row, name, value', [
    ([('float[3]', 'xyz')], (0.1, 0.2, -0.7), 'vehicle_thrust_setpoint[0].xyz[2]', 0.7),
    ([('float[8]', 'control')], (0, 0, 0, 0.6, 0, 0, 0, 0), 'actuator_controls_0[0].control[3]',
     0.6),
    ([('float', 'throttle')], (-0.5,), 'manual_control_setpoint[0].throttle', 0.25),
    ([('float', 'z')], (0.3,), 'manual_control_setpoint[0].z', 0.3),
    ([('uint32_t', 'noutputs'), ('float[2]', 'output')], (1, 1250.0, 0.0),
     'actuator_outputs[0].output[0]', 0.25),
])
def test_every_source_of_throttle_becomes_0_to_1(tmp_path, fields, row, name, value):
    topics, *_ = px4_flight(20)
    topic = name.split('[')[0]
    fields = [('uint64_t', 'timestamp'), *fields]
    rows = [(5_000_000 + 1000 * k, *row) for k in range(20)]
    path, log = load(tmp_path, ulog([topics[0], (topic, 0, fields, rows)]))
    np.testing.assert_allclose(named(log)[name].values, value, rtol=1e-6)
    # Outputs may be servos: they are taken by name only.
    taken = choose(path, log).throttle
    assert taken is None if topic == 'actuator_outputs' else taken.name == name


def test_a_log_without_a_battery_is_refused(tmp_path):
    """The error differs for a log with only the rail and for one with no voltage."""
    topics, *_ = px4_flight()
    path, log = load(tmp_path, ulog(topics[1:]))
    with pytest.raises(InputError, match='no battery voltage.*voltage5v_v'):
        choose(path, log)
    path, log = load(tmp_path, ulog(topics[2:]))
    with pytest.raises(InputError, match='holds no voltage'):
        choose(path, log)


def test_dropouts_are_reported(tmp_path):
    topics, *_ = px4_flight()
    _, log = load(tmp_path, ulog(topics, extra=ulog_message('O', b'\x2c\x01')))
    assert log.notes == ('The logger lost data 1 time, 0.300 s in all.',)


def test_a_truncated_log_is_read_up_to_its_end(tmp_path):
    """A cut inside a message is reported with its byte; everything before is read."""
    topics, _, volts, *_ = px4_flight(40)
    pieces = ulog(topics)
    ends = np.cumsum([len(piece) for piece in pieces])
    whole = b''.join(pieces)
    first = int(ends[len(pieces) - 120])
    rng = np.random.default_rng(6)
    for at in rng.integers(first, len(whole), 60).tolist():
        _, log = load(tmp_path, whole[:at])
        if at in ends:
            # No mark at the end: such a cut cannot be seen.
            assert log.notes == ()
            continue
        assert len(log.notes) == 1 and f'of {at}' in log.notes[0], at
        held = int(ends[np.searchsorted(ends, at) - 1])
        assert f'at byte {held + 3} ' in log.notes[0] or f'at byte {held} ' in log.notes[0]
        found = named(log).get('battery_status[0].voltage_v')
        if found is not None:
            np.testing.assert_array_equal(found.values, volts[:found.n].astype(float))


def test_flipped_bytes_give_an_error_or_a_note(tmp_path):
    topics, *_ = px4_flight(60)
    assert all(outcomes_of_flipped_bytes(tmp_path, b''.join(ulog(topics)), 16, 7, 120))


def test_only_a_header(tmp_path):
    """A ULog that ends after its first bytes is one line."""
    path = tmp_path / 'a.ulg'
    for size in (7, 8, 15, 16, 20):
        path.write_bytes(b''.join(ulog(px4_flight(2)[0]))[:size])
        with pytest.raises(InputError) as caught:
            choose(path, import_log(path, Request()))
        assert str(path) in str(caught.value)


@pytest.mark.parametrize('tail', [b'\xff\xff\x00' + b'x' * 50, b'\xff' * 3000,
                                  b'\x40\x9c\xff' + b'\xff' * 500])
def test_a_message_longer_than_the_file_ends(tmp_path, tail):
    """A step back by the length that is claimed: once pyulog read the same bytes for ever."""
    def late(number, frame):
        raise TimeoutError
    before = signal.signal(signal.SIGVTALRM, late)
    signal.setitimer(signal.ITIMER_VIRTUAL, 20.0)
    try:
        topics, _, volts, *_ = px4_flight(40)
        whole = b''.join(ulog(topics))
        with pytest.raises(InputError, match='holds no|voltage'):
            choose(*load(tmp_path, whole[:16] + tail))
        _, log = load(tmp_path, whole + tail)
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)
    np.testing.assert_array_equal(named(log)['battery_status[0].voltage_v'].values, volts)
    assert any('damaged' in note and f'byte {len(whole)} ' in note for note in log.notes)
