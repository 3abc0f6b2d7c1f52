"""Start and end of every executable: signals, bad input, misspelt parameters."""

import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import time

from live import DEADLINE, refusal, ROOT, wait_until
from ou_monitor.nodes.adaptive_filter_node import AdaptiveFilterNode
from ou_monitor.nodes.estimator_node import EstimatorNode
import pytest

NODES = {'estimator': 'ou_estimator', 'adaptive_filter': 'ou_adaptive_filter'}
KINDS = {'estimator': EstimatorNode, 'adaptive_filter': AdaptiveFilterNode}


def names(probe):
    return probe.node.get_fully_qualified_node_names()


def run_code(code, **environment):
    """Run Python in a process of its own; variables that are None are not set."""
    env = {**os.environ, 'PYTHONPATH': str(ROOT), **environment}
    return subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=DEADLINE,
        env={name: value for name, value in env.items() if value is not None})


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM], ids=['SIGINT', 'SIGTERM'])
def test_signals_end_the_nodes(world, number):
    """Status 0, no traceback, and the nodes are gone from the graph."""
    probe = world.probe()
    processes = [world.start(name, '--ros-args', '-r', '__ns:=/x/y') for name in NODES]
    expected = {f'/x/y/{node}' for node in NODES.values()}
    wait_until(lambda: expected <= set(names(probe)), what='nodes')
    for process in processes:
        process.popen.send_signal(number)
    assert [process.wait() for process in processes] == [0, 0]
    assert all('Traceback' not in p.err and 'rror' not in p.err for p in processes)
    # A node that was destroyed says goodbye; that is one datagram, which a busy machine may lose,
    # and then it is missed after 20 s.
    wait_until(lambda: not expected & set(names(probe)), what='the nodes to be gone')


@pytest.mark.parametrize('name', NODES)
def test_arguments_that_rclpy_ignores_are_refused(world, name):
    process = world.start(name, 'fmin:=30.0', '--ros-args', '-p', 'publish_rate:=5.0')
    assert process.wait() == 2
    assert "'fmin:=30.0' is not an option" in process.err and '--ros-args -p' in process.err
    process = world.start(name, '--help')
    assert process.wait() == 0
    assert not process.err


def test_a_signal_during_the_start_ends_with_status_0(world):
    """While it imports, while it makes its node: status 0 all the same."""
    for delay, number in zip((0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8),
                             4 * (signal.SIGINT, signal.SIGTERM)):
        process = world.start('estimator')
        # Before `main` Python's own handlers are in force; then SIGTERM, number 15, is caught.
        state = Path(f'/proc/{process.popen.pid}/status')
        wait_until(lambda state=state: int(
            re.search(r'SigCgt:\s*(\w+)', state.read_text())[1], 16) >> 14 & 1)
        time.sleep(delay)
        assert process.stop(number) == 0, process.err


@pytest.mark.parametrize('name, spacings', zip(NODES, ((0.001, 0.02), (0.005, 0.04))))
def test_ctrl_c_of_a_launch_is_two_signals(world, name, spacings):
    """The second comes while the first is being answered, in one loop of all nodes."""
    for spacing in spacings:
        process = world.start(name)
        wait_until(lambda process=process: 'Waiting for' in process.err, what='the node at work')
        process.popen.send_signal(signal.SIGINT)
        # Not a wait for something: this is what is tried.
        time.sleep(spacing)
        assert process.stop() == 0, process.err


def test_a_signal_while_it_ends_is_only_noted(tmp_path):
    """In a destructor of the middleware Python's own handler would raise, which aborts."""
    code = ('import atexit, os, signal\n'
            'from ou_monitor.nodes.run import run_node\n'
            'class Loop:\n'
            '    def __init__(self):\n'
            '        self.me = self\n'
            '    def __del__(self):\n'
            '        os.kill(os.getpid(), signal.SIGINT)\n'
            '        print("destroyed", end=" ")\n'
            'def work():\n'
            '    Loop()\n'
            '    atexit.register(os.kill, os.getpid(), signal.SIGINT)\n'
            '    return 3\n'
            'run_node("one", "about", work)\n')
    done = run_code(code, ROS_LOG_DIR=str(tmp_path), ROS_AUTOMATIC_DISCOVERY_RANGE='OFF')
    assert (done.returncode, done.stdout, done.stderr) == (3, 'destroyed ', '')


@pytest.mark.parametrize('name, arguments, words', [
    ('estimator', ['-p', 'window:=long'], "window: unknown 'long'"),
    ('estimator', ['-p', 'window:=.nan'], 'window must be a finite number or auto'),
    ('estimator', ['-p', 'model_file:=/no/such/model.yaml'], 'cannot read the model file'),
    ('estimator', ['-p', 'brownout.warn:=0.5'], 'must be less than brownout.critical'),
    ('estimator', ['-p', 'msg_config:=std_flaot64'], "did you mean 'std_float64'?"),
    ('estimator', ['-p', 'msg_config:=px4'], 'clone https://github.com/PX4/px4_msgs'),
    ('estimator', ['-p', 'msg_config:=std_float32', '-p', 'voltage.field:=daat'],
     "did you mean 'data'?"),
    ('adaptive_filter', ['-p', 'law:=constant_nose'], "did you mean 'constant_noise'?"),
    ('adaptive_filter', ['-p', 'fmin:=200.0'], 'fmin'),
    ('adaptive_filter', ['-p', 'input.type:=std_msgs/msg/String'], 'cannot filter'),
    ('adaptive_filter', ['-p', 'input.type:=sensor_msgs/msg/Temperature', '-p',
                         'input.field:=temprature'], "did you mean 'temperature'?"),
    ('adaptive_filter', ['-p', 'input.type:=std_msgs/msg/Int32', '-p', 'input.field:=data'],
     'name a float field'),
    ('adaptive_filter', ['-p', 'law:=kalman'], 'law kalman needs the noise'),
    ('adaptive_filter', ['-p', 'max_lag:=5.0'], 'allow more lag or raise fmax'),
], ids=lambda value: '' if isinstance(value, list) else value[:24])
def test_bad_arguments_are_refused_with_the_reason(name, arguments, words):
    assert words in refusal(lambda: KINDS[name](NODES[name]), *arguments)


@pytest.mark.parametrize('name, arguments, words', [
    ('estimator', ['-p', 'window:=-1.0'], 'window must lie within 0.05..3600'),
    ('estimator', ['--params-file', 'no_such.yaml'], 'cannot read the ROS arguments'),
    ('adaptive_filter', ['-r', '__node:=9 lives'], 'cannot read the ROS arguments'),
    ('replay', [], 'no recording missing.mcap'),
    ('replay', ['-p', 'x'], 'cannot read the ROS arguments'),
], ids=lambda value: '' if isinstance(value, list) else value[:24])
def test_a_refusal_is_one_line(world, name, arguments, words):
    """Exit status 2 and one line that says why, no traceback."""
    bag = ['missing.mcap'] if name == 'replay' else []
    process = world.start(name, *bag, '--ros-args', *arguments)
    assert process.wait() == 2
    # The C library of ROS may add a line of its own before.
    lines = [line for line in process.err.strip().splitlines() if '[rcl]' not in line]
    assert len(lines) == 1 and words in lines[0], process.err


def test_a_misspelt_parameter_is_named(world, tmp_path):
    path = tmp_path / 'params.yaml'
    path.write_text('/**:\n  ros__parameters:\n    brownout:\n      horizn: 2.0\n')
    process = world.start('estimator', '--ros-args', '-p', 'windw:=3.0', '-p', 'window:=3',
                          '--params-file', str(path))
    wait_until(lambda: process.err.count('[WARN]') == 2, what='two warnings')
    assert "'windw' does not exist and is ignored: did you mean 'window'?" in process.err
    assert "'brownout.horizn' does not exist" in process.err
    assert "did you mean 'brownout.horizon'?" in process.err
    assert process.stop() == 0


def test_the_throttles_package_is_not_needed(world):
    probe = world.probe()
    process = world.start('estimator', '--ros-args', '-p', 'msg_config:=mavros')
    wait_until(lambda: probe.node.get_subscriptions_info_by_topic('/mavros/battery'))
    wait_until(lambda: 'mavros_msgs' in process.err, what='warning')
    assert process.err.count('[WARN]') == 1
    assert process.stop() == 0


def test_the_nodes_have_one_thread_of_blas():
    """More of them on one core wait for one another; what the user says stands."""
    code = ('import ou_monitor.nodes.run, os, sys; assert "numpy" not in sys.modules; '
            'print(os.environ["OPENBLAS_NUM_THREADS"])')
    for given, threads in ((None, '1'), ('2', '2')):
        assert run_code(code, OPENBLAS_NUM_THREADS=given).stdout == f'{threads}\n'


def test_no_thread_holds_up_the_end(tmp_path):
    """One that never ends, as one that makes a table may for a while; what was said is told."""
    code = ('import atexit, threading, time\n'
            'from ou_monitor.nodes.run import run_node\n'
            'def work():\n'
            '    threading.Thread(target=time.sleep, args=(1e6,)).start()\n'
            '    atexit.register(print, "at exit")\n'
            '    print("done", end=" ")\n'
            '    return 3\n'
            'run_node("one", "about", work)\n')
    done = run_code(code, ROS_LOG_DIR=str(tmp_path), ROS_AUTOMATIC_DISCOVERY_RANGE='OFF')
    assert (done.returncode, done.stdout, done.stderr) == (3, 'done at exit\n', '')


def test_the_node_exits_although_the_middleware_hangs(tmp_path):
    """Nothing of Python runs while it waits, as for a lock that a stopped process holds."""
    code = ('import ctypes\n'
            'from ou_monitor.nodes import run\n'
            'from rclpy.node import Node\n'
            'run.END = 0.2\n'
            'class Stuck(Node):\n'
            '    def destroy_node(self):\n'
            '        print("ending", flush=True)\n'
            # Unlike CDLL it keeps the interpreter's lock.
            '        ctypes.PyDLL(None).sleep(1000)\n'
            'def work():\n'
            '    def make():\n'
            '        node = Stuck("stuck")\n'
            '        node.context.try_shutdown()\n'
            '        return node\n'
            '    return run.spin(make)\n'
            'run.run_node("stuck", "about", work)\n')
    done = run_code(code, ROS_LOG_DIR=str(tmp_path), ROS_AUTOMATIC_DISCOVERY_RANGE='OFF')
    assert (done.returncode, done.stdout) == (-signal.SIGALRM, 'ending\n')


def test_the_log_file_has_the_last_lines(world, tmp_path):
    """What was said just before a signal is in the file too."""
    process = world.start('estimator', '--ros-args', '-p', 'no_such.parameter:=3')
    wait_until(lambda: 'no_such.parameter' in process.err, what='the warning')
    wait_until(lambda: 'Waiting for a publisher' in process.err, what='the node at work')
    assert process.stop() == 0
    logged = ''.join(path.read_text() for path in world.folder.rglob(
        f'*_{process.popen.pid}_*.log'))
    for line in process.err.splitlines():
        assert line.partition(']: ')[2] in logged
    assert 'Waiting for a publisher' in logged
