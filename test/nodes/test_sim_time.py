"""Replay in a loop, three times as fast, without header stamps: all time comes from /clock."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from live import ou_path, to_stamp, values_of, wait_until
from made_bags import encode
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.standard_types import FLOAT32
import pytest
from rosgraph_msgs.msg import Clock

T0 = 1_700_000_000_000_000_000
SECONDS, RATE = 4, 3
SIGMA = 0.3


def test_a_loop_on_simulated_time_clears_the_window_once(world):
    path = world.folder / 'plain.mcap'
    with BagWriter(path) as bag:
        topic = bag.add_topic('/voltage', 'std_msgs/msg/Float32')
        for k, voltage in enumerate(ou_path(1000 * SECONDS, 0.001, seed=11, sigma=SIGMA)):
            bag.write(topic, T0 + k * 1_000_000, encode(FLOAT32, {'data': voltage}))
    probe = world.probe()
    states = probe.listen('/ou_estimator/state', DiagnosticArray)
    estimator = world.start('estimator', '--ros-args', '-p', 'use_sim_time:=true')
    wait_until(lambda: states)
    replay = world.start('replay', path, '--loop', '--rate', RATE, '--wait', '15')

    def stamps():
        found = [float(values_of(message.status[0])['t']) for message in states]
        return [t for t in found if math.isfinite(t)]

    def passes():
        return sum(b < a for a, b in zip(stamps(), stamps()[1:]))
    wait_until(lambda: passes() >= 3, what='three passes')
    assert [replay.stop(), estimator.stop()] == [0, 0]
    seen = [values_of(message.status[0]) for message in states]
    assert passes() <= int(seen[-1]['resets']) <= 2 * (passes() + 1)
    # The line through /clock may run on by some ticks where a pass ends.
    assert T0 * 1e-9 - 0.1 < min(stamps()) and max(stamps()) < T0 * 1e-9 + SECONDS + 0.3
    full = [float(f['sigma']) for f in seen if int(f['n']) > 1500 and f['status'] == 'OK']
    # By source time alone sigma would come out sqrt(3) times as large.
    assert sorted(full)[len(full) // 2] == pytest.approx(SIGMA, rel=0.15)
    rates = [float(f['rate']) for f in seen if int(f['n']) > 1500]
    assert sorted(rates)[len(rates) // 2] == pytest.approx(1000.0, rel=0.05)


def test_without_a_clock_it_says_so(world):
    from std_msgs.msg import Float32
    probe = world.probe()
    states = probe.listen('/ou_estimator/state', DiagnosticArray)
    output = probe.publisher('/voltage', Float32)
    estimator = world.start('estimator', '--ros-args', '-p', 'use_sim_time:=true')

    def said():
        output.publish(Float32(data=5.0))
        return states and 'no message arrives on /clock' in states[-1].status[0].message
    wait_until(said, what='complaint')
    assert states[-1].status[0].level == b'\x03'
    # A clock that runs, and then stops.
    ticks = probe.publisher('/clock', Clock)
    begin = time.monotonic()

    def heard():
        now = time.monotonic() - begin
        ticks.publish(Clock(clock=to_stamp(now)))
        said()
        return float(values_of(states[-1].status[0])['t']) > 0.0
    wait_until(heard, what='samples on simulated time')
    wait_until(said, what='complaint of the clock that stopped')
    assert states[-1].status[0].level == b'\x03'
    assert estimator.stop() == 0
