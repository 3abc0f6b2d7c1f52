"""The launch files with the real `ros2 launch`, where ROS 2 is sourced and this package built."""

import os
import shutil
import signal
import subprocess

from live import wait_until
import pytest

pytestmark = pytest.mark.skipif(
    shutil.which('ros2') is None or subprocess.run(
        ['ros2', 'pkg', 'prefix', 'ou_monitor'], capture_output=True, check=False).returncode != 0,
    reason='needs a sourced ROS 2 with `ros2 launch`, and the workspace of this package')

FILES = {'ou_monitor_launch.py': ['/ou_estimator', '/ou_adaptive_filter'],
         'ou_monitor_two_batteries_launch.py': [
             '/battery_1/ou_estimator', '/battery_2/ou_estimator'],
         'ou_monitor_simulated_launch.py': [
             '/supply_simulator', '/ou_estimator', '/ou_adaptive_filter']}


@pytest.mark.parametrize('file', FILES)
def test_nodes_come_up_and_end(world, file):
    """Those that are described are seen, and SIGINT ends all of them with status 0."""
    probe = world.probe()
    launched = subprocess.Popen(
        # -n: at a terminal `ros2 launch` leaves the signal of its nodes to the terminal.
        ['ros2', 'launch', '-n', 'ou_monitor', file], start_new_session=True,
        env={**os.environ, 'ROS_DOMAIN_ID': str(world.domain)})
    try:
        wait_until(lambda: set(FILES[file]) <= set(probe.node.get_fully_qualified_node_names()),
                   what=f'{FILES[file]}')
        launched.send_signal(signal.SIGINT)
        assert launched.wait(60) == 0
    finally:
        if launched.poll() is None:
            os.killpg(launched.pid, signal.SIGKILL)
            launched.wait()


def test_a_missing_parameter_file_starts_no_node(tmp_path):
    done = subprocess.run(
        ['ros2', 'launch', 'ou_monitor', 'ou_monitor_launch.py',
         f'params_file:={tmp_path}/none.yaml'], capture_output=True, text=True, timeout=120,
        check=False)
    assert done.returncode != 0 and 'there is no file' in done.stdout + done.stderr
