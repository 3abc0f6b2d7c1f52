"""Messages to samples: time lines of blocks, throttle of a sample, pairing, publishers."""

import math
from types import SimpleNamespace

from hypothesis import example, given, HealthCheck, settings, strategies as st
from made_bags import encode
import numpy as np
from one_by_one import OneByOne
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_recording
from ou_monitor.stream.config import FieldSpec, load_msg_config
from ou_monitor.stream.samples import (
    APART, APART_MIXED, BlockClock, FOLLOW, Publishers, SourceClock, ThrottleHold)
from ou_monitor.timeline import BATCH
import pytest


# -- pairing, jumps, blocks, missing values

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


# -- the throttle in force when a sample was taken: node and bench

STAMPS = st.floats(0.0, 4.0).map(lambda x: round(x, 2))


def hold_of(pushed, newest=2.0, own=True, voltage_own=True):
    """Return a hold with throttle (stamp, value) that came after one voltage message."""
    hold = ThrottleHold()
    stamps, values = np.array(pushed, dtype=float).reshape(-1, 2).T
    hold.take(stamps, values, np.full(stamps.size, own), np.array([newest]),
              np.array([voltage_own]), np.ones(stamps.size, int))
    return hold


@given(
    st.lists(st.tuples(STAMPS, st.floats(0.0, 1.0) | st.just(math.nan)), max_size=30),
    st.lists(STAMPS, min_size=1, max_size=60))
def test_agrees_with_its_definition(pushed, asked):
    hold = hold_of(pushed)
    expected = []
    for at in asked:
        before = [(stamp, place) for place, (stamp, _) in enumerate(pushed) if stamp <= at]
        expected.append(pushed[max(before)[1]][1] if before else np.nan)
    np.testing.assert_array_equal(hold.at(np.array(asked)), expected)


def test_more_samples_than_a_batch_are_placed():
    hold = hold_of([(1.0, 0.3), (2.0, 0.4)])
    at = np.linspace(0.0, 4.0, 2 * BATCH + 1)
    np.testing.assert_array_equal(
        hold.at(at), np.where(at < 1.0, np.nan, np.where(at < 2.0, 0.3, 0.4)))


def test_unneeded_throttles_are_dropped():
    """Only the value that holds at the stamp and those after it are kept."""
    hold = hold_of([(k / 1000.0, k / 1000.0) for k in range(1000)])
    hold.forget_before(0.9895)
    assert hold.held()[0].size == 11
    np.testing.assert_array_equal(hold.at(np.array([0.9885, 0.9895, 0.99, 2000.0])),
                                  [np.nan, 0.989, 0.99, 0.999])


def test_an_empty_hold_gives_unknown_throttle():
    """A new time line starts with the value given."""
    hold = ThrottleHold()
    assert np.isnan(hold.at(np.array([1.0]))).all() and hold.at(np.empty(0)).shape == (0,)
    hold = hold_of([(1.0, 0.3)])
    hold.restart()
    assert np.isnan(hold.at(np.array([1.0]))).all()
    hold.restart(0.4)
    assert hold.at(np.array([-5.0])).tolist() == [0.4]


@pytest.mark.parametrize('own, voltage_own, apart', [
    (True, True, APART), (False, False, APART), (True, False, APART_MIXED),
    (False, True, APART_MIXED)])
@pytest.mark.parametrize('side', [-1.0, 1.0])
def test_throttle_of_another_clock_counts_from_its_arrival(own, voltage_own, apart, side):
    """Beyond what two messages of one clock can differ by, a throttle holds from its arrival."""
    at = np.array([9.0, 10.0, 10.001, 20.0])
    near = hold_of([(10.0 + side * 0.99 * apart, 0.5)], 10.0, own, voltage_own)
    far = hold_of([(10.0 + side * 1.01 * apart, 0.5)], 10.0, own, voltage_own)
    np.testing.assert_array_equal(near.at(at), np.where(at >= 10.0 + side * 0.99 * apart, 0.5,
                                                        np.nan))
    np.testing.assert_array_equal(far.at(at), [np.nan, np.nan, 0.5, 0.5])


def test_arrivals_keep_their_order():
    """A throttle placed by its arrival does not come before one that was there already."""
    hold = hold_of([(14.0, 0.1), (15.5, 0.2), (16.0, 0.3)], newest=10.0)
    np.testing.assert_array_equal(hold.at(np.array([10.5, 13.9, 14.0, 20.0])),
                                  [np.nan, np.nan, 0.3, 0.3])


# -- node and bench

TYPES = {'x_msgs/msg/Sample': 'float64 stamp\nfloat64 data\n',
         'x_msgs/msg/Block': 'float64 stamp\nfloat64[] data\n'}
RATE = 200.0
EPOCH = 1_700_000_000


def config_of(folder, block, nan):
    """Return the path of a msg config, with blocks of the voltage or not."""
    path = folder / f'x{block:d}{nan}.yaml'
    text = ('description: test\npackage: x_msgs\ninstall: nothing\ngeneric: false\n')
    for name, block in (('voltage', block), ('throttle', False)):
        kind = 'x_msgs/msg/Block' if block else 'x_msgs/msg/Sample'
        text += (f'{name}:\n  topic: /{name}\n  type: {kind}\n  field: data\n  nan: {nan}\n'
                 '  stamp_field: stamp\n')
        text += f'  sample_rate: {RATE}\n' if block else ''
    path.write_text(text)
    return path


def bench(folder, config, messages, block):
    """Return {(t, voltage): throttle} as a bag of the messages is read."""
    path = folder / 'bag.mcap'
    path.unlink(missing_ok=True)
    with BagWriter(path) as bag:
        kinds = {'voltage': 'x_msgs/msg/Block' if block else 'x_msgs/msg/Sample',
                 'throttle': 'x_msgs/msg/Sample'}
        for name, kind in kinds.items():
            bag.add_topic('/' + name, kind, schema=TYPES[kind])
        for name, logged, stamp, data in messages:
            bag.write('/' + name, logged, encode(
                kinds[name], {'stamp': stamp, 'data': data}, TYPES[kinds[name]]))
    recording = read_recording(path, msg_config=config)
    return dict(zip(zip(recording.t.tolist(), recording.voltage.tolist(), strict=True),
                    recording.throttle.tolist(), strict=True))


def node(config, messages, flushes):
    """Return (messages come, t, voltage, throttle) of what the node hands to its monitor."""
    config = load_msg_config(config)
    sink, pairs = Sink(), []
    stream = OneByOne(sink)
    stream.open_voltage(config.voltage)
    stream.open_throttle(config.throttle)
    for come, (name, logged, stamp, data) in enumerate([*messages, (None, 0, 0, 0)], 1):
        if name is not None:
            take = stream.take_voltage if name == 'voltage' else stream.take_throttle
            # As `recordings` turns ns into s.
            take(SimpleNamespace(stamp=stamp, data=data),
                 lambda at=logged: at // 10**9 + at % 10**9 * 1e-9)
        if come in flushes or name is None:
            stream.flush()
        rows = zip(sink.t, sink.v, sink.u, strict=True)
        pairs += [(min(come, len(messages)), *row) for row in rows][len(pairs):]
    assert not sink.resets
    return pairs


@st.composite
def recordings(draw):
    """Draw messages in order of arrival, of any rates and delays without a backward step."""
    block = draw(st.booleans())
    stamped = {'voltage': draw(st.booleans()), 'throttle': draw(st.booleans())}
    # Seconds between the throttle's own clock and the voltage's.
    offset = draw(st.sampled_from([0.0, 0.0, 0.1, -2.0, 3600.0, -1.69e9]))
    steps = {'voltage': draw(st.sampled_from([0.01, 0.3, 7.0])),
             'throttle': draw(st.sampled_from([0.01, 0.3, 7.0]))}
    messages = []
    logged = EPOCH * 10**9
    for k in range(draw(st.integers(2, 25))):
        name = draw(st.sampled_from(['voltage', 'voltage', 'throttle']))
        logged += 1 + draw(st.integers(0, 1000)) * round(steps[name] * 1e6)
        late = draw(st.floats(0.0, 0.09))
        # A stamp now and then left out is a step of the clock, unless the clocks agree.
        own = stamped[name] and (offset != 0.0 or draw(st.integers(0, 9)) > 0)
        stamp = logged * 1e-9 - late + (offset if name == 'throttle' else 0.0)
        value = 1.0 + k if name == 'voltage' else round(draw(st.floats(0.0, 1.0)), 3)
        if name == 'throttle' and draw(st.integers(0, 7)) == 0:
            value = math.nan
        messages.append((name, logged, stamp if own else 0.0,
                         [value + j * 1e-3 for j in range(draw(st.integers(0, 4)))]
                         if block and name == 'voltage' else value))
    return messages, block, draw(st.sampled_from(['drop', 'unknown'])), draw(
        st.sets(st.integers(1, 25), max_size=3))


ONE = [('voltage', EPOCH * 10**9, EPOCH + 0.1, 1.0)]


@settings(max_examples=60, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(recordings())
@example((ONE + [('throttle', EPOCH * 10**9 + 1, EPOCH + 0.05, 0.5)], False, 'drop',
          set()))
@example((ONE + [('throttle', EPOCH * 10**9 + 1, EPOCH + 0.05, 0.5)], False, 'drop',
          {1}))
@example(([('voltage', EPOCH * 10**9 + k, EPOCH + 0.1 - 0.09 * k, [4.0 * k + j for j in range(4)])
           for k in range(2)], True, 'drop', set()))
def test_node_and_bench_pair_alike(tmp_path, drawn):
    messages, block, nan, flushes = drawn
    config = config_of(tmp_path, block, nan)
    if block and not any(name == 'voltage' and data for name, _, _, data in messages) or (
            not any(name == 'voltage' for name, *_ in messages)):
        return
    pairs = node(config, messages, flushes)
    for come in {pair[0] for pair in pairs}:
        read = bench(tmp_path, config, messages[:come], block)
        mine = {(t, v): u for at, t, v, u in pairs if at == come}
        # Of samples with one stamp the bench keeps the first.
        assert {t for t, _ in mine} <= {t for t, _ in read}
        alike = [(mine[key], read[key]) for key in mine.keys() & read.keys()]
        if alike:
            np.testing.assert_array_equal(*zip(*alike, strict=True))


def test_late_throttle_changes_only_samples_not_yet_handed_on(tmp_path):
    messages = [('throttle', EPOCH * 10**9, EPOCH + 0.0, 0.1)]
    messages += [('voltage', EPOCH * 10**9 + k, EPOCH + 0.01 * k, float(k)) for k in range(1, 7)]
    messages += [('throttle', EPOCH * 10**9 + 9, EPOCH + 0.025, 0.7)]
    config = config_of(tmp_path, False, 'drop')
    assert list(bench(tmp_path, config, messages, False).values()) == [
        0.1, 0.1, 0.7, 0.7, 0.7, 0.7]
    assert [u for *_, u in node(config, messages, ())] == [0.1, 0.1, 0.7, 0.7, 0.7, 0.7]
    # Handed on after the fourth sample: only what is paired later knows.
    assert [u for *_, u in node(config, messages, {5})] == [0.1, 0.1, 0.1, 0.1, 0.7, 0.7]


# -- the time line of blocks

BLOCK_RATE = 10_000.0
BLOCK = 100
LENGTH = BLOCK / BLOCK_RATE


def stamps_of(ends, clock=None, n=BLOCK):
    """Return the stamps of all blocks, one after another."""
    clock = clock or BlockClock(BLOCK_RATE)
    return clock.stamps(np.array(ends), np.broadcast_to(n, len(ends)))


def test_jitter_of_stamps_does_not_reach_the_samples():
    """Arrival 0..8 ms late leaves an even spacing, within the lean of 8 ms over FOLLOW."""
    rng = np.random.default_rng(3)
    ends = LENGTH * np.arange(1, 3001) + rng.uniform(0.0, 8e-3, 3000)
    clock = BlockClock(BLOCK_RATE)
    t = stamps_of(ends, clock)
    step = np.diff(t) * BLOCK_RATE
    # The correction of one block is at most error * length / FOLLOW, spread
    # over the block: relative 8 ms / FOLLOW; rounding of t at 30 s adds 4e-11.
    assert np.abs(step - 1.0).max() < 8e-3 / FOLLOW * 1.01 + 1e-10
    assert clock.gaps == 0
    # It does lean on the stamps: the mean delay is 4 ms, reached within 3 FOLLOW.
    assert t[-1] - 3000 * LENGTH == pytest.approx(4e-3, abs=1e-3)


@pytest.mark.parametrize('drift', [1e-4, -1e-4])
def test_drift_is_followed(drift):
    """A clock wrong by 100 ppm is followed at a lag of drift * FOLLOW, not left behind."""
    blocks = round(100.0 / LENGTH)
    ends = LENGTH * (1.0 + drift) * np.arange(1, blocks + 1)
    clock = BlockClock(BLOCK_RATE)
    t = stamps_of(ends, clock)
    assert clock.gaps == 0
    # After 10 FOLLOW the lag is settled to exp(-10); unfollowed it would be 10 ms.
    assert ends[-1] - t[-1] == pytest.approx(drift * FOLLOW, rel=1e-2)
    settled = np.diff(t[-1000:]) * BLOCK_RATE - 1.0
    np.testing.assert_allclose(settled, drift, rtol=1e-2)


@pytest.mark.parametrize('gap', [0.255, 0.5, -0.3])
def test_a_gap_is_kept(gap):
    """Beyond max(2 blocks, 0.25 s) the time line restarts at the stamp."""
    ends = LENGTH * np.arange(1, 21)
    ends[10:] += gap
    clock = BlockClock(BLOCK_RATE)
    t = stamps_of(ends, clock).reshape(20, BLOCK)
    assert clock.gaps == 1
    assert t[10, 0] - t[9, -1] == pytest.approx(gap + 1 / BLOCK_RATE, abs=1e-9)
    np.testing.assert_allclose(t[:, -1], ends, rtol=0, atol=1e-9)


def test_two_long_blocks_are_not_a_gap():
    """With blocks of 200 ms a difference of 350 ms is jitter, 450 ms is not."""
    for late, gaps in ((0.35, 0), (0.45, 1)):
        clock = BlockClock(1000.0)
        stamps_of([0.2, 0.4 + late], clock, n=200)
        assert clock.gaps == gaps


def test_blocks_of_any_length():
    clock = BlockClock(1000.0)
    t = stamps_of([0.010, 0.010, 0.013], clock, n=[10, 0, 3])
    np.testing.assert_allclose(t, np.arange(1, 14) / 1000.0, rtol=0, atol=1e-12)


def test_a_clock_since_1970_is_as_accurate():
    """Adding up must not collect the rounding of large stamps: one of 2^-22 s remains."""
    ends = 1_704_067_200.0 + LENGTH * np.arange(1, 2001)
    t = stamps_of(ends)
    exact = np.arange(1, 2000 * BLOCK + 1) / BLOCK_RATE
    assert np.abs(t - 1_704_067_200.0 - exact).max() <= 1.02 * 2.0**-22


def test_a_reset_starts_a_new_time_line():
    clock = BlockClock(BLOCK_RATE)
    stamps_of([100.0], clock)
    clock.reset()
    assert stamps_of([1.0], clock)[-1] == 1.0
    assert clock.gaps == 0


@pytest.mark.parametrize('rate', [0.0, -1.0, float('nan'), float('inf')])
def test_wrong_rates_are_refused(rate):
    with pytest.raises(ValueError, match='Hz'):
        BlockClock(rate)


def test_wrong_stamps_are_refused():
    with pytest.raises(ValueError, match='finite'):
        stamps_of([float('nan')], n=1)
    with pytest.raises(ValueError, match='-1'):
        stamps_of([1.0], n=-1)


@pytest.mark.parametrize('lengths', [[100], [100, 100, 7, 0, 1, 250]])
def test_many_blocks_at_once_equal_single_ones(lengths):
    """The same bits as one by one, over gaps and batches, and the same gaps counted."""
    rng = np.random.default_rng(5)
    n = np.array(lengths * 12, dtype=np.int64)
    ends = 1.7e9 + np.cumsum(n) / BLOCK_RATE + rng.uniform(0.0, 8e-3, n.size)
    ends[30:] += 4.0
    ends[7:] += 1.0
    one, many = BlockClock(BLOCK_RATE), BlockClock(BLOCK_RATE)
    expected = np.concatenate([stamps_of([end], one, k) for end, k in zip(ends, n.tolist())])
    found = np.concatenate([many.stamps(ends[part], n[part])
                            for part in (slice(0, 5), slice(5, 5), slice(5, None))])
    np.testing.assert_array_equal(found.view(np.uint64), expected.view(np.uint64))
    assert one.gaps == many.gaps >= 1


# -- publishers, losses, and the age of the newest sample

def sent(first, n, rate, start, lost=()):
    """Return (number, time) of a publisher's messages, less those that are lost."""
    return [(first + k, start + k / rate) for k in range(n) if k not in lost]


def follow(publishers, *streams, count, batch=20):
    """Feed messages of publishers as they arrive; return whose were kept: {stream: number}."""
    merged = sorted((time, number, who) for who, stream in enumerate(streams)
                    for number, time in stream)
    kept = dict.fromkeys(range(len(streams)), 0)
    for k in range(0, len(merged), batch):
        part = merged[k:k + batch]
        times = np.array([time for time, _, _ in part])
        mask = publishers.follow([number for _, number, _ in part], times, times, count)
        for (_, _, who), keep in zip(part, mask.tolist()):
            kept[who] += keep
    return kept


def test_losses_of_one_publisher_are_counted():
    """Every tenth message is lost; a restart is not a loss."""
    publishers = Publishers()
    assert follow(publishers, sent(1, 1000, 1e3, 0.0, set(range(5, 1000, 10))),
                  count=1) == {0: 900}
    assert publishers.lost == 100 and publishers.foreign == 0
    follow(publishers, sent(1, 100, 1e3, 5.0), count=1)
    assert publishers.lost == 100 and publishers.numbered


@pytest.mark.parametrize('offset', [0, 3, 700])
@pytest.mark.parametrize('rate', [1000.0, 137.0])
def test_the_first_of_two_publishers_is_followed(offset, rate):
    """Whatever their numbers, with a pause that loses the messages of both."""
    publishers = Publishers()
    gap = set(range(1000, 1030))
    first = sent(1 + offset, 3000, 1000.0, 0.0, gap)
    other = sent(1, int(3 * rate), rate, 0.0004, {k for k in range(int(3 * rate))
                                                  if 1.0 <= k / rate < 1.03})
    kept = follow(publishers, first, other, count=2)
    assert kept[0] >= 2960 and kept[1] <= 10
    assert publishers.foreign >= len(other) - 10 and abs(publishers.lost - 30) <= 10


def test_a_later_publisher_is_ignored():
    publishers = Publishers()
    kept = follow(publishers, sent(1, 1000, 1e3, 0.0), count=1)
    kept = follow(publishers, sent(1001, 1000, 1e3, 1.0), sent(1, 900, 1e3, 1.1003), count=2)
    assert kept == {0: 1000, 1: 0} and publishers.foreign == 900


def test_if_the_first_publisher_ends_the_other_is_followed():
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 100, 100.0, 0.0004), count=2)
    kept = follow(publishers, sent(101, 500, 100.0, 1.0004), count=2)
    assert 380 <= kept[0] <= 420


def test_without_sequence_numbers_losses_are_unknown():
    publishers = Publishers()
    assert publishers.follow([None] * 3, np.arange(3.0), np.arange(3.0), 2).all()
    assert not publishers.numbered


def test_age_counts_from_the_stamp_of_the_nodes_clock():
    clock = SourceClock()
    assert clock.name == 'unknown' and clock.age(5.0) is None
    clock.take(np.array([100.0, 100.1]), np.array([100.11, 100.11]), 5.0)
    assert clock.name == 'ros' and clock.age(5.0) == pytest.approx(0.01)
    assert clock.age(6.0) == pytest.approx(1.01)
    # A backlog: data 8 s old that have just arrived.
    clock.take(np.array([103.0]), np.array([111.0]), 16.0)
    assert clock.name == 'ros' and clock.age(16.0) == pytest.approx(8.0)


@pytest.mark.parametrize('stamp', [12.0, 1.7e9 + 3.0, 1.7e9 - 20.0])
def test_age_counts_from_arrival_for_a_foreign_clock(stamp):
    clock = SourceClock()
    clock.take(np.array([stamp]), np.array([1.7e9]), 5.0)
    assert clock.name == 'foreign' and clock.age(5.5) == pytest.approx(0.5)


def test_a_clock_set_during_the_run_is_the_nodes():
    clock = SourceClock()
    clock.take(np.array([12.0]), np.array([1.7e9]), 5.0)
    clock.take(np.array([1.7e9]), np.array([1.7e9 + 0.01]), 6.0)
    assert clock.name == 'ros'


@pytest.mark.parametrize('first', [0, 1])
def test_after_a_stall_the_first_publisher_is_still_followed(first):
    """Both were silent for 1.5 s, as everything was; whose message comes first decides nothing."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 200, 200.0, 0.0004), count=2)
    kept = follow(publishers, sent(2500 + first, 1000, 1e3, 2.5 + 1e-3 * first),
                  sent(500, 200, 200.0, 2.4994 + 1e-3), count=2, batch=50)
    assert kept[0] >= 990 and kept[1] <= 10


@pytest.mark.parametrize('pause', [0.2, 0.6, 3.0])
def test_first_publisher_is_followed_after_a_pause(pause):
    """Its numbers go on where they were; the other begins meanwhile, or after."""
    publishers = Publishers()
    follow(publishers, sent(1, 400, 500.0, 0.0), count=2)
    start = 0.8 + pause
    kept = follow(publishers, sent(401, 500, 500.0, start), sent(1, 100, 100.0, start + 0.0005),
                  count=2, batch=6)
    assert kept == {0: 500, 1: 0} and publishers.foreign == 100


def test_two_restarted_publishers_are_told_apart():
    """The first ends and restarts beside another: it is followed within a batch."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 100, 100.0, 0.0004), count=2)
    kept = follow(publishers, sent(1, 1000, 1e3, 1.5), sent(101, 150, 100.0, 1.0004), count=2)
    assert kept[0] + kept[1] >= 900


def test_restart_of_the_only_publisher_counts_no_loss():
    """Another was there before; behind a silence its first messages, many at once, are kept."""
    publishers = Publishers()
    follow(publishers, sent(1, 1000, 1e3, 0.0), sent(1, 200, 200.0, 0.0004), count=2)
    follow(publishers, sent(1001, 1000, 1e3, 1.0), count=1)
    foreign = publishers.foreign
    kept = follow(publishers, sent(1, 2000, 1e3, 4.0), count=1, batch=2000)
    assert kept[0] == 2000 and publishers.foreign == foreign


def test_sequence_numbers_in_any_order_are_handled_fast():
    """Each smaller than the one before, as of publishers without end: no more tracks than that."""
    publishers = Publishers()
    times = np.arange(2000) * 1e-3
    publishers.follow(list(range(4000, 2000, -1)), times, times, 2)
    assert publishers.foreign >= 1990
