"""The real adaptive filter: IMU, bad values, stale sigma, state, parameters."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from live import LowPass, to_stamp, values_of, wait_until
from ou_monitor.online.filter.cutoff import relative_cutoff
from ou_monitor.online.filter.filter_state import phase_lag
import pytest
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64

# What constant_noise asks for at twice sigma_ref and 1 kHz; it looks at the rate to 5 %.
HELD, CLOSE = relative_cutoff('lowpass', 2, 150.0, 2.0, 1e-3), 0.02


class Rig(LowPass):
    """The filter, with a sigma and an IMU."""

    def __init__(self, world):
        super().__init__(world, {'sigma': Float64, 'state': DiagnosticArray},
                         '-p', 'smoothing:=0.0', '-p', 'slew:=0.0')
        self.stamp = 100.0

    def send(self, rate, dt=0.001):
        """Send one stamped IMU message."""
        self.stamp += dt
        message = Imu()
        message.header.frame_id, message.header.stamp = 'imu', to_stamp(self.stamp)
        message.linear_acceleration.z = 9.81
        gyro = message.angular_velocity
        gyro.x, gyro.y, gyro.z = rate
        self.inputs['input'].publish(message)
        return message

    def send_sigma(self, sigma):
        self.inputs['sigma'].publish(Float64(data=sigma))


@pytest.fixture(scope='module')
def rig(shared_world):
    return Rig(shared_world)


def drive(rig, sigma, seconds=0.5):
    """Keep sigma and the input alive for a while."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        rig.send_sigma(sigma)
        rig.send((0.0, 0.0, 0.0))
        time.sleep(0.01)


def cutoff_becomes(rig, wanted, sigma):
    """Drive until the cutoff is the one wanted."""
    def there():
        drive(rig, sigma, 0.1)
        return rig.cutoff and rig.cutoff[-1].data == pytest.approx(wanted, rel=CLOSE)
    wait_until(there, what=f'{wanted} Hz; is {rig.cutoff[-1:]}')


def test_imu_keeps_type_stamp_and_the_rest(rig):
    before = len(rig.output)
    sent = rig.send((1.0, -2.0, 3.0))
    wait_until(lambda: len(rig.output) > before)
    first = rig.output[-1]
    assert first.header == sent.header and first.linear_acceleration.z == 9.81
    # The first sample sets the state: it comes out as it went in.
    assert (first.angular_velocity.x, first.angular_velocity.y, first.angular_velocity.z) == (
        1.0, -2.0, 3.0)


@pytest.mark.parametrize('sigma, cutoff', [
    (0.1, 150.0), (0.6, HELD), (10.0, 20.0), (math.nan, 75.0)])
def test_the_cutoff_follows_sigma_and_falls_back(rig, sigma, cutoff):
    """The law fmax (sigma_ref / sigma)^2 within fmin..fmax; unknown: the fallback."""
    cutoff_becomes(rig, cutoff, sigma)


def test_the_lag_is_published(rig):
    """That of the cutoff in force at 10 Hz, as phase delay in ms."""
    cutoff_becomes(rig, HELD, 0.6)
    lag = phase_lag(2, rig.cutoff[-1].data, 10.0)
    wait_until(lambda: rig.lag[-1].data == pytest.approx(lag / 3.6), what=f'{rig.lag[-1:]}')

    def told():
        drive(rig, 0.6, 0.1)
        return float(values_of(rig.status)['lag']) == pytest.approx(lag)
    wait_until(told, what='lag on /diagnostics')
    assert 'by law constant_noise at sigma 0.6' in rig.status.message
    assert f'{lag:.3g} degrees ({lag / 3.6:.3g} ms) at 10 Hz' in rig.status.message


def test_shadow_lets_the_signal_pass(rig):
    assert rig.set('shadow', True).successful
    drive(rig, 0.6, 0.5)
    before = len(rig.output)
    rig.send((2.0, 0.0, 0.0))
    wait_until(lambda: len(rig.output) > before)
    assert rig.output[-1].angular_velocity.x == pytest.approx(2.0, abs=1e-6)
    cutoff_becomes(rig, 150.0, 0.1)

    def told():
        drive(rig, 0.1, 0.1)
        return rig.status.message.startswith('Shadow, the signal passes unfiltered: Cutoff')
    wait_until(told, what='shadow in the diagnostics')
    assert rig.set('shadow', False).successful


def test_a_slow_input_warns(rig):
    """At 10 Hz 0.45 of the rate is below fmin."""
    def told():
        for _ in range(50):
            rig.send((0.0, 0.0, 0.0), dt=0.1)
            time.sleep(0.001)
        rig.send_sigma(0.6)
        return 'are too slow: 0.45 of their rate is 4.5 Hz' in rig.status.message
    wait_until(told, what='WARN')
    assert rig.status.level == b'\x01'
    # The sample rate is averaged over 100 samples: back to what the other tests use.
    for _ in range(2000):
        rig.send((0.0, 0.0, 0.0))
        time.sleep(0.0005)


def test_stale_sigma_falls_back_and_warns(rig):
    cutoff_becomes(rig, HELD, 0.6)

    def fallen_back():
        rig.send((0.0, 0.0, 0.0))
        return rig.cutoff[-1].data == pytest.approx(75.0)
    wait_until(fallen_back, what='fallback')

    def warned():
        rig.send((0.0, 0.0, 0.0))
        return rig.status and rig.status.level == b'\x01'
    wait_until(warned, what='warning')
    assert 'goes to the fallback, 75 Hz, because sigma on /sigma is stale' in rig.status.message


def test_bad_samples_are_counted_and_not_passed_on(rig):
    rig.send((0.0, 0.0, 0.0))
    for bad in (math.nan, math.inf):
        rig.send((0.0, bad, 0.0))
    rig.send((0.0, 0.0, 0.0))

    def counted():
        rig.send((0.0, 0.0, 0.0))
        return values_of(rig.status)['dropped'] == '2'
    wait_until(counted, what='2 dropped')
    assert all(math.isfinite(m.angular_velocity.y) for m in rig.output)


def test_parameters_change_at_run_time_or_are_refused(rig):
    for name, value in (('fmax', 200.0), ('fmin', 10.0), ('fallback', 50.0), ('order', 1)):
        result = rig.set(name, value)
        assert result.successful, result.reason
    for name, value, words in (('fmin', 300.0, 'fmin'), ('order', 3, ''), (
            'law', 'treshold', 'threshold'), ('mode', 'derivative', 'read-only')):
        refused = rig.set(name, value)
        assert not refused.successful and words in refused.reason


def test_stamps_that_are_no_time_do_not_hold_the_output(rig):
    """Steadily backward: the output follows the input by arrival, and that is said."""
    aim = 5.0

    def there():
        for _ in range(20):
            rig.send((aim, 0.0, 0.0), dt=-0.002)
            time.sleep(0.002)
        return rig.output[-1].angular_velocity.x == pytest.approx(aim, abs=1e-3)
    wait_until(lambda: there() and values_of(rig.status)['stamps'] != 'GOOD', what='by arrival')
    assert rig.status.level == b'\x01' and int(values_of(rig.status)['placed_by_arrival']) > 0

    def good():
        drive(rig, 0.6, 0.2)
        return values_of(rig.status)['stamps'] == 'GOOD'
    wait_until(good, what='good stamps again')


def test_silence_is_stale(rig):
    wait_until(lambda: rig.status.level == b'\x03', what='STALE')
    assert 'No message on /input for' in rig.status.message


def test_ends_with_status_0(rig):
    assert rig.process.stop() == 0, rig.process.err
    assert 'Traceback' not in rig.process.err
