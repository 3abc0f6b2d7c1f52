"""The throttle in force when a sample was taken: the rule, in the node and offline."""

import math
from types import SimpleNamespace

from hypothesis import example, given, HealthCheck, settings, strategies as st
from made_bags import encode
import numpy as np
from one_by_one import OneByOne
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_recording
from ou_monitor.stream.config import load_msg_config
from ou_monitor.stream.samples import APART, APART_MIXED, ThrottleHold
from ou_monitor.timeline import BATCH
import pytest

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


class Sink:
    """Stands where the monitor stands; notes pairs, and how many messages had come by then."""

    def __init__(self):
        self.pairs, self.resets = [], 0
        self.come = 0

    def push(self, t, voltage, throttle, arrival=None, *, current=None, thin=1):
        self.pairs += [(self.come, *row) for row in zip(
            t.tolist(), voltage.tolist(), throttle.tolist(), strict=True)]

    def reset(self, reason):
        self.resets += 1


def node(config, messages, flushes):
    """Return (messages come, t, voltage, throttle) of what the node hands to its monitor."""
    config = load_msg_config(config)
    sink = Sink()
    stream = OneByOne(sink)
    stream.open_voltage(config.voltage)
    stream.open_throttle(config.throttle)
    for sink.come, (name, logged, stamp, data) in enumerate(messages, 1):
        take = stream.take_voltage if name == 'voltage' else stream.take_throttle
        # As `recordings` turns ns into s.
        take(SimpleNamespace(stamp=stamp, data=data),
             lambda at=logged: at // 10**9 + at % 10**9 * 1e-9)
        if sink.come in flushes:
            stream.flush()
    stream.flush()
    assert not sink.resets
    return sink.pairs


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
