"""Managed nodes over DDS: transitions, failing transitions, and a restart during a dip."""

import contextlib
import threading
import time

from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from live import wait_until
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy._rclpy_pybind11 import RCLError
from std_msgs.msg import Bool, Float64

NODES = {'estimator': 'ou_estimator', 'adaptive_filter': 'ou_adaptive_filter'}


class Manager:
    """What `ros2 lifecycle set` does."""

    def __init__(self, probe, node):
        self.probe, self.node = probe, node

    def change(self, transition):
        """Ask for a transition; return whether it succeeded."""
        return self.probe.call(ChangeState, f'/{self.node}/change_state', ChangeState.Request(
            transition=Transition(id=transition))).success

    @property
    def state(self):
        return self.probe.call(GetState, f'/{self.node}/get_state',
                               GetState.Request()).current_state.id


def topics_of(probe, node):
    """Return what a node publishes under its own name, once that has been discovered."""
    # The services of a node may answer before its name is in the graph, and that may be there
    # before its publishers; this one it has in every state.
    always = f'/{node}/transition_event'
    wait_until(lambda: (node, '/') in probe.node.get_node_names_and_namespaces(), what=node)
    found = set()

    def look():
        found.clear()
        found.update(name for name, _ in probe.node.get_publisher_names_and_types_by_node(
            node, '/'))
        return always in found
    wait_until(look, what=always)
    return {name for name in found if name.startswith(f'/{node}/')} - {always}


@pytest.mark.parametrize('name', NODES)
def test_only_an_active_node_has_anything_open(world, name):
    node = NODES[name]
    probe = world.probe()
    process = world.start(name, '--lifecycle')
    manager = Manager(probe, node)
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    assert not topics_of(probe, node)
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.state == State.PRIMARY_STATE_INACTIVE
    wait_until(lambda: not topics_of(probe, node))
    for _ in range(2):
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        assert manager.state == State.PRIMARY_STATE_ACTIVE
        wait_until(lambda: len(topics_of(probe, node)) >= 2, what='outputs')
        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        wait_until(lambda: not topics_of(probe, node), what='outputs to be closed')
    assert manager.change(Transition.TRANSITION_CLEANUP)
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    # What is not a transition of the state is refused, and changes nothing.
    assert not manager.change(Transition.TRANSITION_ACTIVATE)
    assert manager.change(Transition.TRANSITION_UNCONFIGURED_SHUTDOWN)
    assert manager.state == State.PRIMARY_STATE_FINALIZED
    assert process.stop() == 0


def test_a_configuration_that_fails_can_be_mended(world):
    """One line says why; the node stays unconfigured until the parameter is right."""
    probe = world.probe()
    process = world.start('estimator', '--lifecycle', '--ros-args', '-p', 'msg_config:=px4')
    manager = Manager(probe, 'ou_estimator')
    assert not manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.state == State.PRIMARY_STATE_UNCONFIGURED
    wait_until(lambda: 'cannot be configured' in process.err and 'px4_msgs' in process.err)
    assert probe.set_parameter('/ou_estimator', 'msg_config', 'std_float64').successful
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    # While it is active what is read at its beginning cannot be changed; the rest can.
    answer = probe.set_parameter('/ou_estimator', 'msg_config', 'auto')
    assert not answer.successful and 'deactivate the node first' in answer.reason
    assert probe.set_parameter('/ou_estimator', 'window', 3.0).successful
    assert manager.change(Transition.TRANSITION_DEACTIVATE)
    assert probe.set_parameter('/ou_estimator', 'window', 4.0).successful
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    got = probe.call(GetParameters, '/ou_estimator/get_parameters',
                     GetParameters.Request(names=['window']))
    assert got.values[0].double_value == 4.0
    assert process.stop() == 0


def test_a_restart_during_a_dip_sets_the_flag_again(world):
    """Silent while inactive; the flag is back with the first samples, and never false."""
    probe = world.probe()
    flags = probe.listen('/ou_estimator/brownout', Bool)
    output = probe.publisher('/voltage', Float64)
    process = world.start('estimator', '--lifecycle', '--ros-args', '-p',
                          'msg_config:=std_float64')
    manager = Manager(probe, 'ou_estimator')
    assert manager.change(Transition.TRANSITION_CONFIGURE)
    assert manager.change(Transition.TRANSITION_ACTIVATE)
    end = threading.Event()

    def send():
        while not end.wait(0.002):
            # One sample of many: where the middleware of a busy machine refuses it, the next.
            with contextlib.suppress(RCLError):
                output.publish(Float64(data=4.0))
    thread = threading.Thread(target=send)
    thread.start()
    try:
        wait_until(lambda: flags and flags[-1].data, what='the flag')
        assert manager.change(Transition.TRANSITION_DEACTIVATE)
        # What was on its way has come.
        time.sleep(0.5)
        before = len(flags)
        time.sleep(0.5)
        assert len(flags) == before
        assert manager.change(Transition.TRANSITION_ACTIVATE)
        wait_until(lambda: len(flags) > before + 3, what='the flag again')
    finally:
        end.set()
        thread.join()
    assert all(flag.data for flag in flags)
    assert process.stop() == 0
