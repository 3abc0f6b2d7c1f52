"""The real adaptive filter: IMU, bad values, stale sigma, parameters."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from live import diagnosis, seconds, values_of, wait_until
import pytest
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64

NODE = '/ou_adaptive_filter'
NAME = 'ou_adaptive_filter: adaptive low-pass'


class Rig:
    """The filter, with a sigma and an IMU."""

    def __init__(self, world):
        self.probe = world.probe()
        self.output = self.probe.listen(f'{NODE}/output', Imu)
        self.cutoff = self.probe.listen(f'{NODE}/cutoff', Float64)
        self.diagnostics = self.probe.listen('/diagnostics', DiagnosticArray)
        self.sigma = self.probe.publisher('/sigma', Float64)
        self.input = self.probe.publisher('/input', Imu)
        self.process = world.start('adaptive_filter', '--ros-args', '-p', 'smoothing:=0.0')
        wait_until(lambda: self.sigma.get_subscription_count()
                   and self.input.get_subscription_count(), what='subscriptions')
        # Both ends must know of each other before the first message.
        wait_until(lambda: self.probe.node.count_publishers(f'{NODE}/output'))
        time.sleep(0.3)
        self.stamp = 100.0

    def send(self, rate, dt=0.001):
        """Send one stamped IMU message."""
        self.stamp += dt
        message = Imu()
        message.header.frame_id = 'imu'
        message.header.stamp.sec = int(self.stamp)
        message.header.stamp.nanosec = round(self.stamp % 1.0 * 1e9) % 10**9
        message.linear_acceleration.z = 9.81
        gyro = message.angular_velocity
        gyro.x, gyro.y, gyro.z = rate
        self.input.publish(message)
        return message

    @property
    def status(self):
        """Return what it said last on /diagnostics."""
        return diagnosis(self.diagnostics, NAME)


@pytest.fixture(scope='module')
def rig(shared_world):
    """Give the filter."""
    return Rig(shared_world)


def drive(rig, sigma, seconds=0.5):
    """Keep sigma and the input alive for a while."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        rig.sigma.publish(Float64(data=sigma))
        rig.send((0.0, 0.0, 0.0))
        time.sleep(0.01)


def cutoff_becomes(rig, wanted, sigma):
    """Drive until the cutoff is the one wanted."""
    def there():
        drive(rig, sigma, 0.1)
        return rig.cutoff and rig.cutoff[-1].data == pytest.approx(wanted, rel=1e-6)
    wait_until(there, what=f'{wanted} Hz; is {rig.cutoff[-1:]}')


def test_imu_keeps_type_stamp_and_the_rest(rig):
    """Angular velocity is filtered, acceleration and header pass through."""
    before = len(rig.output)
    sent = rig.send((1.0, -2.0, 3.0))
    wait_until(lambda: len(rig.output) > before)
    first = rig.output[-1]
    assert first.header == sent.header and first.linear_acceleration.z == 9.81
    # The first sample sets the state: it comes out as it went in.
    assert (first.angular_velocity.x, first.angular_velocity.y, first.angular_velocity.z) == (
        1.0, -2.0, 3.0)


def test_a_step_is_answered_like_a_butterworth(rig):
    """Without sigma the cutoff is the fallback, 75 Hz: the exact step response of order 2."""
    for _ in range(400):
        rig.send((0.0, 0.0, 0.0))
        time.sleep(0.0005)
    step = rig.stamp
    for _ in range(30):
        rig.send((1.0, 0.0, 0.0))
        time.sleep(0.002)
    wait_until(lambda: seconds(rig.output[-1].header.stamp) > rig.stamp - 0.003, what='the end')
    # The input is held over the interval before its stamp, so the step begins at the last zero
    # that arrived; times are told from stamps, for best effort may lose a message.
    stamps = [seconds(m.header.stamp) for m in rig.output]
    begin = max(stamp for stamp in stamps if stamp < step + 1e-6)
    answers = [(stamp - begin, m.angular_velocity) for stamp, m in zip(stamps, rig.output)
               if stamp > begin + 1e-6]
    assert len(answers) > 20
    a = 2.0 * math.pi * 75.0 / math.sqrt(2.0)
    for t, rate in answers:
        wanted = 1.0 - math.exp(-a * t) * (math.cos(a * t) + math.sin(a * t))
        # Stamps are rounded to ns and the slope is below 300 1/s.
        assert rate.x == pytest.approx(wanted, abs=1e-4)
        assert rate.y == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize('sigma, cutoff', [
    (0.1, 150.0), (0.3, 150.0), (0.6, 37.5), (10.0, 20.0), (math.nan, 75.0), (-1.0, 75.0)])
def test_cutoff_law(rig, sigma, cutoff):
    """The law fmax (sigma_ref / sigma)^2 within fmin..fmax; unknown: the fallback."""
    cutoff_becomes(rig, cutoff, sigma)


def test_stale_sigma_falls_back_and_warns(rig):
    """An old sigma is no sigma."""
    cutoff_becomes(rig, 37.5, 0.6)

    def fallen_back():
        rig.send((0.0, 0.0, 0.0))
        return rig.cutoff[-1].data == pytest.approx(75.0)
    wait_until(fallen_back, what='fallback')

    def warned():
        rig.send((0.0, 0.0, 0.0))
        return rig.status and rig.status.level == b'\x01'
    wait_until(warned, what='warning')
    assert 'Sigma on /sigma is missing' in rig.status.message


def test_bad_samples_are_counted_and_not_passed_on(rig):
    """A bad value in any axis; the output after it is finite."""
    rig.send((0.0, 0.0, 0.0))
    for bad in (math.nan, math.inf):
        rig.send((0.0, bad, 0.0))
    rig.send((0.0, 0.0, 0.0))

    def counted():
        rig.send((0.0, 0.0, 0.0))
        return values_of(rig.status)['dropped'] == '2'
    wait_until(counted, what='2 dropped')
    assert all(math.isfinite(m.angular_velocity.y) for m in rig.output)


def test_parameter_change_does_not_move_the_output(rig):
    """With a constant input the output stays where it is, to the last bit that matters."""
    for _ in range(300):
        rig.send((0.7, 0.0, 0.0))
        time.sleep(0.0005)
    settled = rig.stamp
    for name, value in (('fmax', 200.0), ('fmin', 10.0), ('fallback', 50.0), ('order', 1)):
        result = rig.probe.set_parameter(NODE, name, value)
        assert result.successful, result.reason
        rig.send((0.7, 0.0, 0.0))
    rig.send((0.7, 0.0, 0.0))
    wait_until(lambda: seconds(rig.output[-1].header.stamp) > settled + 0.003)
    after = [m.angular_velocity.x for m in rig.output
             if seconds(m.header.stamp) > settled + 1e-6]
    assert len(after) >= 3 and after == pytest.approx([0.7] * len(after), abs=1e-9)
    refused = rig.probe.set_parameter(NODE, 'fmin', 300.0)
    assert not refused.successful and 'fmin' in refused.reason
    refused = rig.probe.set_parameter(NODE, 'order', 3)
    assert not refused.successful


def test_silence_is_stale(rig):
    """Without input there is nothing to say."""
    wait_until(lambda: rig.status.level == b'\x03', what='STALE')
    assert 'No message on /input for' in rig.status.message


def test_ends_with_status_0(rig):
    """On SIGINT."""
    assert rig.process.stop() == 0, rig.process.err
    assert 'Traceback' not in rig.process.err
