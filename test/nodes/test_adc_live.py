"""A simulated 10 kHz device, through the node into the estimator."""

import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from live import diagnosis, ou_path, seconds, values_of, wait_until
from made_devices import attributes, iio_device, OFFSET, SCALE, scans
import numpy as np
import pytest
from sensor_msgs.msg import BatteryState

RATE = 10_000


def test_ten_kilohertz_reach_the_estimator_without_loss(world, tmp_path):
    folder, character = iio_device(tmp_path, RATE)
    probe = world.probe()
    states = probe.listen('/ou_estimator/state', DiagnosticArray)
    said = probe.listen('/diagnostics', DiagnosticArray)
    estimator = world.start('estimator', '--ros-args', '-p', 'msg_config:=adc',
                            '-p', f'adc.sample_rate:={RATE}.0')
    adc = world.start(
        'adc', '--ros-args', '-p', 'device:=ads1015', '-p', 'channel:=in_voltage1', '-p',
        'gain:=4.0', '-p', f'sysfs:={tmp_path}/sys', '-p', f'dev:={tmp_path}/dev')
    wait_until(lambda: 'at 10000 Hz on /voltage' in adc.err, what='device')
    wait_until(lambda: 'voltage from /voltage' in estimator.err, what='subscription')
    wait_until(lambda: probe.node.count_publishers('/voltage') and (
        probe.node.count_subscribers('/voltage')))
    time.sleep(1.0)  # for the two to have found each other, which neither says
    path = np.array(ou_path(4 * RATE, 1.0 / RATE, seed=2))
    # Counts of 10 mV: far below the sensor's noise of an OU of 27 mV, but not of its steps; so a
    # little more is added, as every ADC does.
    counts = np.round((path + np.random.default_rng(1).normal(0.0, 0.01, path.size))
                      / (4e-3 * SCALE) - OFFSET).astype(int)
    stamps = time.time_ns() + np.arange(path.size) * (10**9 // RATE)

    def feed():
        begin = time.monotonic()
        with character.open('wb', buffering=0) as file:
            for k in range(0, path.size, 100):
                time.sleep(max(begin + (k + 100) / RATE - time.monotonic(), 0.0))
                file.write(scans(counts[k:k + 100], stamps[k:k + 100]))
            done.wait(60.0)
    done = threading.Event()
    thread = threading.Thread(target=feed)
    thread.start()

    def fields():
        return values_of(states[-1].status[0]) if states else {}
    try:
        wait_until(lambda: int(fields().get('pushed', 0)) == path.size, what='every sample')
    finally:
        done.set()
        thread.join()
    full = [f for f in (values_of(s.status[0]) for s in states) if float(f['duration']) > 1.9]
    assert float(full[-1]['rate']) == pytest.approx(RATE, rel=1e-3)
    assert full[-1]['messages_lost'] == '0' and full[-1]['stamps'] == 'GOOD'
    # 2 s of a relaxation of 16 ms: 12 % of alpha, 6 % of sigma; five times that.
    assert float(full[-1]['alpha']) == pytest.approx(63.0, rel=0.6)
    assert float(full[-1]['sigma']) == pytest.approx(0.3, rel=0.3)
    found = wait_until(lambda: diagnosis(said, 'ou_adc: adc'))
    assert values_of(found)['stamps'] == 'kernel' and values_of(found)['holes'] == '0'
    assert [adc.stop(), estimator.stop()] == [0, 0]
    assert (folder / 'buffer/enable').read_text().startswith('0')


def test_hwmon_publishes_battery_states(world, tmp_path):
    """Asked at its rate, with the divider's gain; the estimator takes it without being told."""
    attributes(tmp_path / 'sys/class/hwmon/hwmon0', name='ina226', in1_input=5000,
               update_interval=10)
    probe = world.probe()
    got = probe.listen('/voltage', BatteryState)
    adc = world.start('adc', '--ros-args', '-p', 'device:=ina226', '-p', 'gain:=3.0', '-p',
                      'offset:=0.5', '-p', f'sysfs:={tmp_path}/sys')
    wait_until(lambda: len(got) >= 50)
    assert got[-1].voltage == pytest.approx(15.5) and np.isnan(got[-1].percentage)
    stamps = [seconds(m.header.stamp) for m in got]
    # A busy machine asks late; what was late does not make the next one early by more.
    assert (stamps[-1] - stamps[0]) / (len(stamps) - 1) > 0.0095
    assert abs(stamps[-1] - time.time()) < 60.0
    (tmp_path / 'sys/class/hwmon/hwmon0/in1_input').unlink()
    said = probe.listen('/diagnostics', DiagnosticArray)
    found = wait_until(lambda: diagnosis(said, 'ou_adc: adc'))
    assert found.level == b'\x02' and 'No such file' in found.message
    assert adc.stop() == 0


def test_an_unknown_device_is_one_line(world, tmp_path):
    iio_device(tmp_path)
    adc = world.start('adc', '--ros-args', '-p', 'device:=ads1115', '-p', f'sysfs:={tmp_path}/sys')
    assert adc.wait() == 2
    (line,) = [line for line in adc.err.splitlines() if 'FATAL' in line]
    assert "no such device: 'ads1115'; available: iio:device0 (ads1015)" in line
