"""Messages to samples: pairing, jumps, blocks, missing values."""

import math
from types import SimpleNamespace

import numpy as np
from one_by_one import OneByOne
from ou_monitor.stream.config import FieldSpec
import pytest


class Sink:
    """Stands where the monitor stands; notes what it gets."""

    def __init__(self):
        self.t, self.v, self.u, self.resets = [], [], [], []
        self.current = []
        self.watched = []

    def push(self, t, voltage, throttle, arrival=None, *, current=None, thin=1):
        self.t += t.tolist()
        self.v += voltage.tolist()
        self.u += throttle.tolist()
        self.current += [] if current is None else current.tolist()

    def watch(self, voltage, arrival):
        self.watched += list(zip(voltage.tolist(), arrival.tolist()))

    def reset(self, reason):
        self.resets.append(reason)


def plain(value):
    """Return a message without a stamp."""
    return SimpleNamespace(data=value)


def stamped(stamp, value):
    whole = math.floor(stamp)
    time = SimpleNamespace(sec=whole, nanosec=round((stamp - whole) * 1e9))
    return SimpleNamespace(data=value, stamp=time)


def stream_of(voltage_stamp=None, throttle_stamp=None, **voltage):
    """Return a stream of field `data` and its sink."""
    sink = Sink()
    stream = OneByOne(sink)
    stream.open_voltage(FieldSpec(
        'voltage', 'x/msg/X', 'data', stamp_field=voltage_stamp, **voltage))
    stream.open_throttle(FieldSpec('throttle', 'x/msg/X', 'data', stamp_field=throttle_stamp))
    return stream, sink


@pytest.mark.parametrize('throttle_stamp, messages, expected', [
    # On one clock: the throttle that held at the voltage's stamp, though it came after it.
    ('stamp', [('u', 0.5, 0.1), *(('v', 1.0 + k, 5.0) for k in range(4)), ('u', 2.5, 0.7)],
     [0.1, 0.1, 0.7, 0.7]),
    # A source time may lie off a driver's stamps by less than two clocks usually do.
    (None, [('v', 1.0, 5.0), ('u', 0.5, 0.3), ('v', 2.0, 5.0), ('u', 1.5, 0.4)], [math.nan, 0.3]),
    (None, [*(('v', 1.0 + 0.01 * k, 5.0) for k in range(4)), ('u', 1.015, 0.3)],
     [math.nan, math.nan, 0.3, 0.3]),
    # The clocks differ: by arrival.
    ('stamp', [('u', 12.0, 0.2), ('v', 1.7e9, 5.0)], [0.2])])
def test_throttle_is_paired_by_stamp_or_by_arrival(throttle_stamp, messages, expected):
    stream, sink = stream_of('stamp', throttle_stamp)
    for which, stamp, value in messages:
        take = stream.take_throttle if which == 'u' else stream.take_voltage
        take(stamped(stamp, value), lambda at=stamp: at)
    stream.flush()
    np.testing.assert_array_equal(sink.u, expected)


def test_memory_for_throttle_without_voltage_is_bounded():
    """The newest are kept, and hold when the voltage comes."""
    stream, sink = stream_of()
    for k in range(5000):
        stream.take_throttle(plain(k / 5000.0), lambda at=k: 0.001 * at)
    stream.flush()
    stream.take_voltage(plain(5.0), lambda: 4.9985)
    stream.take_voltage(plain(5.0), lambda: 3.5)
    stream.flush()
    assert sink.u[0] == 4998 / 5000.0


def test_backward_throttle_restarts_the_pairing():
    """As in a bag replayed in a loop: earlier throttle does not hold after the step."""
    stream, sink = stream_of('stamp', 'stamp')
    stream.take_throttle(stamped(4.0, 0.9), None)
    stream.take_voltage(stamped(4.01, 5.0), None)
    stream.take_throttle(stamped(1.0, 0.1), None)
    stream.take_voltage(stamped(1.01, 5.0), None)
    stream.take_throttle(stamped(1.02, 0.2), None)
    stream.take_voltage(stamped(4.03, 5.0), None)
    stream.flush()
    assert sink.u == [0.9, 0.1, 0.2] and len(sink.resets) == 1


def test_missing_values_go_on_as_nan():
    """So that the monitor counts them; the message is not a usable one."""
    stream, sink = stream_of()
    assert stream.take_voltage(plain(5.0), lambda: 1.0)
    assert not stream.take_voltage(plain(math.nan), lambda: 2.0)
    assert not stream.take_voltage(plain(math.inf), lambda: 3.0)
    stream.flush()
    assert sink.v[0] == 5.0 and all(map(math.isnan, sink.v[1:])) and len(sink.v) == 3


def test_samples_without_a_time_are_not_placed():
    """Under use_sim_time before the first /clock."""
    stream, sink = stream_of()
    assert not stream.take_voltage(plain(5.0), lambda: math.nan)
    stream.flush()
    assert sink.v == [] and stream.unplaced == 1


def test_samples_without_a_time_are_checked_against_the_floor():
    """After the earlier samples, each with its arrival; blocks value by value."""
    for rate, counts in ((None, [1, 1, 1]), (1000.0, [2, 0, 3])):
        stream, sink = stream_of(sample_rate=rate)
        stream.take_voltage(plain(5.0), lambda: 1.0)
        n = sum(counts)
        held = stream.take_voltages(
            np.full(3, math.nan), np.zeros(3, bool), np.array(counts), 4.0 + np.arange(n),
            np.array([7.0, 8.0, 9.0]))
        assert not held.any() and sink.v == [5.0] and stream.unplaced == 3
        assert sink.watched == list(zip(
            (4.0 + np.arange(n)).tolist(), np.repeat([7.0, 8.0, 9.0], counts).tolist()))


def test_stamps_that_go_back_clear_the_window_once():
    """Samples before the step are handed over first; then the window is cleared."""
    stream, sink = stream_of('stamp')
    for stamp in (10.0, 10.1, 10.05, 3.0, 3.1):
        stream.take_voltage(stamped(stamp, 5.0), None)
    stream.flush()
    assert sink.t == [10.0, 10.1, 10.05, 3.0, 3.1]
    assert len(sink.resets) == 1 and '7.1 s' in sink.resets[0]
    stream.reset('twice')
    stream.reset('the window is empty already')
    assert sink.resets[1:] == ['twice']


def test_a_step_back_within_one_call_clears_the_window_once():
    stream, sink = stream_of()
    t = np.concatenate([10.0 + 0.001 * np.arange(50), 3.0 + 0.001 * np.arange(300)])
    held = stream.take_voltages(t, np.ones(350, bool), np.ones(350, int), np.full(350, 5.0))
    assert held.all() and len(sink.resets) == 1 and sink.t == t[:50].tolist()
    stream.flush()
    assert sink.t == t.tolist() and len(sink.resets) == 1


def test_blocks_are_spread_over_the_time_line():
    stream, sink = stream_of(sample_rate=100.0)
    stream.take_voltage(plain([1.0, 2.0, math.nan, 4.0]), lambda: 10.0)
    assert stream.take_voltage(plain([]), lambda: 10.0) is False
    stream.flush()
    assert sink.t == pytest.approx([9.97, 9.98, 9.99, 10.0])
    assert sink.v[:2] == [1.0, 2.0] and math.isnan(sink.v[2]) and sink.v[3] == 4.0


def test_a_block_of_nan_is_not_usable():
    stream, sink = stream_of(sample_rate=100.0)
    assert not stream.take_voltage(plain([math.nan, math.nan]), lambda: 10.0)
    assert stream.take_voltage(plain([math.nan, 5.0]), lambda: 10.02)


@pytest.mark.parametrize('stamps', [(None, None), ('stamp', None)])
def test_a_lost_throttle_is_unknown(stamps):
    """From then on, whether paired by stamp or by arrival; until it speaks again."""
    stream, sink = stream_of(*stamps)
    stream.take_throttle(plain(0.5), lambda: 0.0)
    for k in range(3):
        stream.take_voltage(stamped(1.0 + k, 5.0), lambda: 1.0 + k)
    stream.lose_throttle()
    stream.take_voltage(stamped(4.0, 5.0), lambda: 4.0)
    stream.take_throttle(plain(0.6), lambda: 4.5)
    stream.take_voltage(stamped(5.0, 5.0), lambda: 5.0)
    stream.flush()
    assert sink.u[:2] == [0.5, 0.5] and math.isnan(sink.u[3]) and sink.u[4] == 0.6


def test_current_goes_with_its_message():
    for rate, counts in ((None, [1, 1, 1, 1]), (100.0, [2, 1, 2, 2])):
        stream, sink = stream_of('stamp', sample_rate=rate)
        n = sum(counts)
        held = stream.take_voltages(
            np.array([10.0, math.nan, 1.0, 2.0]), np.ones(4, dtype=bool), np.array(counts),
            np.arange(float(n)), None, np.array([5.0, 6.0, math.nan, 8.0]))
        stream.flush()
        assert held.tolist() == [True, False, True, True]
        expected = np.repeat([5.0, math.nan, 8.0], [counts[0], *counts[2:]])
        # All that was sent before the step back carries 5 A; NaN alone is no current.
        np.testing.assert_array_equal(sink.current, expected)
        assert len(sink.t) == expected.size and len(sink.resets) == 1
