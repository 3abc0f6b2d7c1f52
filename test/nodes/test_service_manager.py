"""Notifications to systemd, on a socket like its own."""

import os
import re
import shlex
import socket
import subprocess
import sys

from live import ROOT, wait_until
from ou_monitor.nodes.run import ServiceManager
import pytest


@pytest.fixture
def manager(tmp_path, monkeypatch):
    """Give a socket as systemd's, which the environment names."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as found:
        found.bind(str(tmp_path / 'notify'))
        found.settimeout(120.0)
        monkeypatch.setenv('NOTIFY_SOCKET', str(tmp_path / 'notify'))
        yield found


def test_the_watchdog_is_fed_twice_per_period(manager, monkeypatch):
    assert ServiceManager().interval == 0.0
    monkeypatch.setenv('WATCHDOG_USEC', '3000000')
    assert ServiceManager().interval == 1.5
    monkeypatch.setenv('WATCHDOG_PID', str(os.getpid() + 1))
    assert ServiceManager().interval == 0.0
    ServiceManager().tell('READY=1')
    assert manager.recv(100) == b'READY=1'


def test_an_abstract_socket_is_notified(monkeypatch):
    """Its name begins with @ in the variable, and with a zero byte in the kernel."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as found:
        found.bind(f'\0ou_monitor_{os.getpid()}')
        found.settimeout(10.0)
        monkeypatch.setenv('NOTIFY_SOCKET', f'@ou_monitor_{os.getpid()}')
        ServiceManager().tell('STOPPING=1')
        assert found.recv(100) == b'STOPPING=1'


def test_no_listener_is_no_error(monkeypatch, tmp_path):
    monkeypatch.delenv('NOTIFY_SOCKET', raising=False)
    ServiceManager().tell('READY=1')
    monkeypatch.setenv('NOTIFY_SOCKET', str(tmp_path / 'gone'))
    ServiceManager().tell('READY=1')


def test_a_node_is_ready_feeds_the_watchdog_and_stops(world, manager, monkeypatch):
    """READY once, WATCHDOG while its executor works, STOPPING at the end."""
    monkeypatch.setenv('WATCHDOG_USEC', '400000')
    process = world.start('adaptive_filter')
    got = [manager.recv(100) for _ in range(4)]
    assert got == [b'READY=1', *3 * [b'WATCHDOG=1']]
    assert process.stop() == 0
    wait_until(lambda: manager.recv(100) == b'STOPPING=1')


def test_the_unit_is_accepted(tmp_path):
    """By systemd itself, where it is installed; and every file that it needs is named once."""
    unit = tmp_path / 'ou_monitor@estimator.service'
    unit.write_text((ROOT / 'deploy/ou_monitor@.service').read_text())
    try:
        done = subprocess.run(['systemd-analyze', 'verify', unit], capture_output=True, text=True,
                              timeout=120)
    except FileNotFoundError:
        pytest.skip('systemd-analyze is not installed')
    assert (done.returncode, done.stderr) == (0, ''), done.stderr
    done = subprocess.run(['systemd-analyze', 'security', '--offline=true', '--threshold=25',
                           unit], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout[-200:]


def test_the_unit_has_the_scheduling_that_was_measured():
    """A real-time priority that is bounded, and no quota, which would stretch each report."""
    lines = (ROOT / 'deploy/ou_monitor@.service').read_text().splitlines()
    said = dict(line.split('=', 1) for line in lines if re.match(r'\w+=', line))
    assert (said['CPUSchedulingPolicy'], said['CPUSchedulingPriority']) == ('rr', '1')
    assert said['LimitRTTIME'] == '10s' and int(said['WatchdogSec']) > 10
    assert 'CPUQuota' not in said and int(said['CPUWeight']) > 100
    (share,) = re.findall(r'--cpus ([\d.]+) ', (ROOT / 'deploy/Containerfile').read_text())
    assert float(share) >= 1.0


@pytest.mark.parametrize('name, names', [
    ('estimator', []), ('adaptive_filter', ['sigma:=ou_estimator/sigma',
                                            'state:=ou_estimator/state', 'input:=imu'])])
def test_the_units_command_sources_ros_and_the_package(tmp_path, name, names):
    install = tmp_path / 'opt/ou_monitor/install'
    ros = tmp_path / 'opt/ros/jazzy'
    node = install / 'ou_monitor/lib/ou_monitor' / name
    for folder in (ros, node.parent):
        folder.mkdir(parents=True)
    (ros / 'setup.bash').write_text('export FIRST=1\n')
    (install / 'local_setup.bash').write_text('export SECOND=$FIRST\n')
    node.write_text('#!/bin/sh\necho "$SECOND" "$@"\nexit 3\n')
    node.chmod(0o755)
    unit = (ROOT / 'deploy/ou_monitor@.service').read_text()
    (line,) = re.findall('^ExecStart=(.*)$', unit, re.M)
    line = line.replace('/opt/', f'{tmp_path}/opt/').replace('%i', name).replace('$$', '$')
    given = ROOT / 'deploy' / f'{name}.env'
    env = dict(re.findall('^(REMAP)=(.*)$', given.read_text(), re.M)) if given.exists() else {}
    done = subprocess.run(shlex.split(line), env=env, capture_output=True, text=True, timeout=60)
    assert done.returncode == 3
    assert done.stdout.split() == [
        '1', '--ros-args', '--params-file', f'/etc/ou_monitor/{name}.yaml',
        *(word for one in names for word in ('-r', one))]


def test_the_nodes_need_no_reader_of_bags_and_no_scipy():
    """An apt-only Jazzy has no mcap; SciPy would cost the estimator 50 MB."""
    code = ("import sys; sys.modules['mcap'] = sys.modules['mcap_ros2'] = None; "
            'import ou_monitor.nodes.estimator_node, ou_monitor.nodes.adaptive_filter_node, '
            'ou_monitor.nodes.adc_node; '
            'from ou_monitor import MonitorSettings, SupplyMonitor; '
            'm = SupplyMonitor(MonitorSettings(brownout_voltage=4.5)); '
            'm.push([0.001 * k + 4e-7 * (k * k % 997) for k in range(500)], '
            '[5.0 + 0.01 * (k % 7) for k in range(500)], '
            '[0.3 + 0.001 * (k % 100) for k in range(500)]); m.report(0.0); '
            "sys.exit('scipy' in sys.modules)")
    done = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                          timeout=120)
    assert done.returncode == 0, done.stderr
