"""The same messages through the node in pieces and from a recording give equal readings."""

import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_scalars, FLOAT32)
from ou_monitor.stream.config import load_msg_config
from ou_monitor.stream.samples import SampleStream
from ou_monitor.timeline import held_words
import pytest

START = 1_704_067_200_000_000_000
MS = 1_000_000
COUNT = 2000
# What may be wrong with a source.
KINDS = ('throttle of 2.5', 'throttle unknown', '1e9 V', 'NaN', 'infinite', 'late', 'twice',
         'current unknown', 'current of 1e9', 'coarse')


def messages(rng, period, kinds):
    """Return messages at 1 kHz: log time, stamp (ns), V, A; and throttles: log time, value."""
    k = np.arange(COUNT)
    readings = 15.0 + 0.01 * np.cumsum(rng.normal(size=COUNT)) + rng.normal(0.0, 0.05, COUNT)
    if 'coarse' in kinds:
        readings = np.round(readings, 2)
    volts = readings[np.floor(k / period).astype(int)].astype(np.float32)
    drawn = rng.normal(10.0, 3.0, COUNT).astype(np.float32)
    throttle = rng.random(COUNT // 20).astype(np.float32)
    stamp = START + k * MS
    for column, value, name, share in (
            (volts, 1e9, '1e9 V', 0.003), (volts, np.nan, 'NaN', 0.005),
            (volts, np.inf, 'infinite', 0.003), (drawn, np.nan, 'current unknown', 0.05),
            (drawn, 1e9, 'current of 1e9', 0.01), (throttle, np.nan, 'throttle unknown', 0.1)):
        if name in kinds:
            column[rng.random(column.size) < share] = value
    if 'throttle of 2.5' in kinds:
        throttle[[17, 60]] = 2.5
    if 'twice' in kinds:
        again = np.flatnonzero(rng.random(COUNT) < 0.01)
        again = again[again > 0]
        stamp[again] = stamp[again - 1]
    if 'late' in kinds:
        for at in np.flatnonzero(rng.random(COUNT - 1) < 0.01):
            pair = [at + 1, at]
            for column in (stamp, volts, drawn):
                column[[at, at + 1]] = column[pair]
    logged = START + k * MS + 100_000
    return logged, stamp, volts, drawn, logged[::20] - 50_000, throttle


def seconds(ns):
    """Return ns as s, as a message holds them."""
    return ns // 10**9 + ns % 10**9 * 1e-9


def of_the_node(rng, sent, monkeypatch):
    """Return the readings that the estimator gets, shape (4, n), and the counters."""
    logged, stamp, volts, drawn, moved, throttle = sent
    taken = []

    def take(self, batch, through=SlidingEstimator.take):
        if batch.again:
            taken.clear()
        taken.append(batch.columns)
        through(self, batch)

    monkeypatch.setattr(SlidingEstimator, 'take', take)
    config = load_msg_config('battery_state')
    monitor = SupplyMonitor()
    stream = SampleStream(monitor)
    stream.open_voltage(config.voltage)
    stream.open_throttle(config.throttle)
    at = 0
    # A pair that is late together is handed over together.
    cuts = np.flatnonzero(np.diff(stamp, prepend=stamp[0], append=stamp[-1] + 1) > 0)
    while at < COUNT:
        end = min(at + int(rng.integers(1, 200)), COUNT)
        end = COUNT if end > cuts[-1] else int(cuts[cuts >= end][0])
        for first in range(at, end):
            if first % 20 == 0:
                stream.add_throttle(seconds(moved[first // 20]), False,
                                    float(throttle[first // 20]))
            one = slice(first, first + 1)
            stream.take_voltages(
                seconds(stamp[one]), np.ones(1, bool), np.ones(1, int), volts[one].astype(float),
                seconds(logged[one]), drawn[one].astype(float))
        stream.flush()
        at = end
    report = monitor.report(0.0)
    assert report.restarts == 0, report.fault
    return np.concatenate(taken, axis=1), report.estimate.counters


def of_the_bench(path, sent):
    """Return the readings that a bag of the messages gives."""
    logged, stamp, volts, drawn, moved, throttle = sent
    with BagWriter(path) as writer:
        writer.add_topic('voltage', BATTERY_STATE)
        writer.add_topic('throttle', FLOAT32)
        place = encode_battery(stamp[:1], [16.0])[0].find(np.float32(16.0).tobytes()) + 8
        for k, message in enumerate(encode_battery(stamp, volts)):
            if k % 20 == 0:
                writer.write('throttle', int(moved[k // 20]),
                             encode_scalars(FLOAT32, throttle[k // 20:k // 20 + 1])[0])
            writer.write('voltage', int(logged[k]), message[:place] + (-drawn[k]).tobytes()
                         + message[place + 4:])
    return read_recording(path)


def of_a_csv(path, sent):
    """Return the readings that a CSV gives; throttle where it came, current in each line."""
    _, stamp, volts, drawn, _, throttle = sent
    path.write_text('time_s,voltage_v,throttle,current_a\n' + ''.join(
        # The throttle comes behind the stamp of the voltage before it.
        f'{t!r},{v!r},{throttle[k // 20].item() if k % 20 == 1 else ""},{i!r}\n'
        for k, (t, v, i) in enumerate(zip(
            seconds(stamp).tolist(), volts.tolist(), drawn.tolist()))), encoding='utf-8')
    return read_recording(path)


# A reading that equals the one before is placed by the period alone, which the node knows less
# exactly than the bench does: not together with lost samples, which blur it.
TOGETHER = KINDS[:-1]
# Each kind alone says which one a failure is of.
CASES = [*((period, kinds) for period in (1.0, 5.0, 2.5, 20.05)
           for kinds in ((), KINDS[-1:], TOGETHER)),
         *((period, (kind,)) for period in (1.0, 2.5) for kind in TOGETHER)]


@pytest.mark.filterwarnings('ignore::RuntimeWarning')
@pytest.mark.parametrize('period, kinds', CASES, ids=[
    f'{period}-' + (', '.join(kinds) if len(kinds) < 2 else 'together')
    for period, kinds in CASES])
def test_node_and_bench_take_the_same_readings(tmp_path, monkeypatch, period, kinds):
    # Where the period is no whole number the bench puts the stamps on the grid of the source,
    # which takes the whole recording: by less than 1.5 logged steps.
    rng = np.random.default_rng([int(100 * period), *(KINDS.index(kind) for kind in kinds)])
    sent = messages(rng, period, kinds)
    node, counters = of_the_node(rng, sent, monkeypatch)
    assert counters.pushed == COUNT
    assert counters.pushed == counters.used + counters.non_finite + counters.late + counters.held
    assert (counters.held > 0) == (period > 1.0)
    for bench in (of_the_bench(tmp_path / 'flight.mcap', sent),
                  of_a_csv(tmp_path / 'flight.csv', sent)):
        assert counters.used == node.shape[1] == bench.n
        assert counters.held == bench.held
        dropped = sum(int(note.split()[0]) for note in bench.notes
                      if 'samples dropped' in note or '1 sample dropped' in note)
        assert dropped == counters.non_finite + counters.late
        if 'late' not in kinds or bench.name.endswith('mcap'):
            # In a CSV a line that comes late holds the throttle of the line before it.
            np.testing.assert_array_equal(node[2], bench.throttle)
        np.testing.assert_array_equal(node[[1, 3]], [bench.voltage, bench.current])
        if period == 1.0:
            np.testing.assert_array_equal(node[0], bench.t)
        else:
            assert np.abs(node[0] - bench.t).max() < 1.5e-3


def test_a_throttle_without_new_values_is_told(tmp_path):
    """Blank cells and messages that stop: its last value is held, and a note says for how long."""
    t = np.arange(0.0, 20.0, 0.02)
    gone = (t > 5.0) & (t < 12.0)
    path = tmp_path / 'flight.csv'
    path.write_text('time_s,voltage_v,throttle\n' + ''.join(
        f'{at:.2f},{15.0 + 0.01 * (k % 7):.2f},{"" if out else 0.3}\n'
        for k, (at, out) in enumerate(zip(t.tolist(), gone.tolist()))))
    (note,) = [note for note in read_recording(path).notes if 'no new value' in note]
    assert 'for 7 s in all, the longest time from 5 s' in note
    # Changes alone, at most ten usual intervals apart, are no gap.
    assert not held_words(t, t[::40]) and not held_words(t, np.array([1.0]))
    assert 'for 15 s in all' in held_words(t, t[t < 5.0])
