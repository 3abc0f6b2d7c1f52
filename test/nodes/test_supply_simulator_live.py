"""The supply simulator as a process: equal to a batch, rules for throttle, bad input."""

import math

from diagnostic_msgs.msg import DiagnosticArray
from live import diagnosis, refusal, seconds, to_stamp, values_of, wait_until
import numpy as np
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.nodes.supply_simulator_node import SupplySimulatorNode
from ou_monitor.recordings.model_file import as_yaml, ModelFile
from ou_monitor.simulation import PRESETS, read_profile, simulated
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState
from std_msgs.msg import Float32
from std_srvs.srv import Trigger

STEPS = '0:0.1,1:0.1,1:0.7,2:0.7'
# 5 V less the throttle.
EXACT = SupplyModel((OU(10.0, 0.0, 5.0), LoadSag(1.0, 0.0)))


def saved(folder, model):
    path = folder / 'model.yaml'
    path.write_text(as_yaml(ModelFile(model)))
    return path


def test_simulated_time_repeats_the_path_after_a_reset(world):
    model = PRESETS['flight_full'].model
    probe = world.probe()
    got = probe.listen('/voltage', BatteryState, 1000)
    throttle = probe.listen('/throttle', Float32, 1000)
    ticks = probe.publisher('/clock', Clock)
    node = world.start(
        'supply_simulator', '--ros-args', '-p', f'model_file:={saved(world.folder, model)}',
        '-p', 'rate:=200.0', '-p', 'seed:=4', '-p', f'throttle.play:="{STEPS}"', '-p',
        'use_sim_time:=true')
    wait_until(lambda: probe.node.count_publishers('/voltage') and ticks.get_subscription_count())
    expected = np.concatenate([piece.voltage for piece in simulated(
        model, read_profile(STEPS), duration=2.5, rate=200.0, seed=4)])
    clock = 0

    def tick(steps):
        nonlocal clock
        clock += steps
        ticks.publish(Clock(clock=to_stamp(1000.0 + 0.05 * clock)))

    def path(first, last):
        # A clock that did not reach the node goes on.
        wait_until(lambda: tick(1) or len(got) >= last, what='samples')
        return np.array([m.voltage for m in got[first:last]])
    # The first ones may leave before this subscription is known to the node.
    path(0, 20)
    answer = probe.call(Trigger, '/supply_simulator/reset', Trigger.Request())
    assert answer.success and 'seed 4' in answer.message
    # The answer may come a few samples before or after the first of the new path.
    before = len(got) - 5
    path(before, before + 40)
    begin = before + int(np.argmin([np.abs(path(k, k + 20) - expected[:20]).max()
                                    for k in range(before, before + 10)]))
    np.testing.assert_allclose(path(begin, begin + 400), expected[:400], rtol=0.0, atol=1e-6)
    # A clock that is set: the supply goes on from where it was.
    tick(2000)
    np.testing.assert_allclose(path(begin, begin + 500), expected, rtol=0.0, atol=1e-6)
    stamps = np.array([seconds(m.header.stamp) for m in got[begin:]])
    steps = np.sort(np.diff(stamps))
    np.testing.assert_allclose(steps[:-1], 0.005, rtol=0.0, atol=1e-6)
    assert 95.0 < steps[-1] < 101.0
    assert {round(m.data, 3) for m in throttle} == {0.1, 0.7}
    assert node.stop() == 0


def test_failed_throttle_is_held_and_then_idles(world):
    """Not a number is silence, held for 1 s, then idle; it says so, and of a second publisher."""
    probe = world.probe()
    got = probe.listen('/voltage', BatteryState)
    said = probe.listen('/diagnostics', DiagnosticArray)
    throttle = probe.publisher('/throttle', Float32)
    node = world.start('supply_simulator', '--ros-args', '-p',
                       f'model_file:={saved(world.folder, EXACT)}', '-p', 'rate:=50.0')

    def send(value, until):
        def done():
            throttle.publish(Float32(data=value))
            return got and until(got[-1].voltage)
        return wait_until(done, what=f'the answer to {value}')

    def words(part):
        return wait_until(lambda: [m for m in said if part in m.status[0].message], what=part)
    words('No throttle on /throttle: the craft idles.')
    assert 'no charge (load) and no drift' in node.err
    assert got[-1].voltage == pytest.approx(5.0) and math.isnan(got[-1].percentage)
    send(0.5, lambda v: v == pytest.approx(4.5))
    assert probe.set_parameter('/supply_simulator', 'scale_resistance', 2.0).successful
    send(0.5, lambda v: v == pytest.approx(4.0))
    # Beyond 1 is full throttle, as the estimator has it.
    send(1.5, lambda v: v == pytest.approx(3.0))
    last = len(got)
    send(math.nan, lambda v: v == pytest.approx(5.0))
    # It held at first.
    assert any(m.voltage == pytest.approx(3.0) for m in got[last:])
    words('No throttle on /throttle for 1.')
    other = world.probe().publisher('/throttle', Float32)
    wait_until(lambda: probe.node.count_publishers('/throttle') == 2)
    other.publish(Float32(data=0.1))
    words('2 publishers on /throttle')
    fields = values_of(diagnosis(said, 'supply_simulator: supply'))
    assert int(fields['samples']) >= 50 and float(fields['scale_resistance']) == 2.0
    assert node.stop() == 0


@pytest.mark.parametrize('options, words', [
    ((), 'model_file is needed'),
    (('model_file:=none.yaml',), 'none.yaml'),
    (('msg_config:=adc_block',), 'blocks of samples'),
    (('capacity_left:=0.5',), "no entry 'load'"),
    (('throttle.play:=hoover',), 'hover'),
    (('rate:=5000.0',), 'rate'),
])
def test_bad_input_is_named(tmp_path, options, words):
    if options and not options[0].startswith('model_file'):
        options = (*options, f'model_file:={saved(tmp_path, EXACT)}')
    assert words in refusal(lambda: SupplySimulatorNode('supply_simulator'),
                            *(word for option in options for word in ('-p', option)))
