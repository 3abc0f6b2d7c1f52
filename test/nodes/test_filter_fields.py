"""Any field of any installed type through the real filter, and through its two modules."""

import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import Point, PoseWithCovariance, Vector3Stamped
from live import values_of, wait_until
from ou_monitor.errors import InputError
from ou_monitor.nodes.adaptive_filter_node import SupplyInput
from ou_monitor.nodes.filter_channels import channels_of
from ou_monitor.nodes.inputs import decode
import pytest
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from std_msgs.msg import Header


@pytest.mark.parametrize('message, field', [
    (Temperature(), 'variance'), (Imu(), 'linear_acceleration.z'),
    (JointState(velocity=[1.0, 2.0]), 'velocity[1]'), (PoseWithCovariance(), 'covariance[7]')])
def test_one_field_is_taken_and_put_back(message, field):
    """Scalars, nested ones, elements of arrays of any and of fixed length; nothing else moves."""
    package = type(message).__module__.split('.')[0]
    channel = channels_of(f'{package}/msg/{type(message).__name__}', field)
    assert channel.names == (field,)
    before = str(message)
    assert channel.put(message, (3.25,)) is message
    assert list(channel.take(message)) == [3.25]
    assert str(message) != before


def test_an_array_that_is_too_short_gives_nothing():
    channel = channels_of('sensor_msgs/msg/JointState', 'velocity[1]')
    assert len(channel.take(JointState(velocity=[1.0]))) == 0


@pytest.mark.parametrize('kind, field, words', [
    ('std_msgs/msg/String', '', 'without input.field'),
    ('std_msgs/msg/String', 'data', 'not a number'),
    ('std_msgs/msg/Int32', 'data', 'name a float field'),
    ('std_msgs/msg/Float64', 'dat', "did you mean 'data'"),
    ('std_msgs/msg/Float32MultiArray', 'data', 'is an array'),
    ('std_msgs/msg/Float64', 'da ta', 'not of the form'),
    ('no_such_msgs/msg/Rail', 'data', 'not installed')])
def test_types_that_cannot_be_filtered_are_one_line(kind, field, words):
    with pytest.raises(InputError, match=words) as caught:
        channels_of(kind, field)
    assert '\n' not in str(caught.value)


class Clock:
    """A clock set by hand."""

    now = 0.0

    def __call__(self):
        """Return the time, s."""
        return self.now


def state_of(**values):
    """Return a state as the estimator publishes it."""
    return DiagnosticArray(status=[DiagnosticStatus(values=[
        KeyValue(key=key, value=str(value)) for key, value in values.items()])])


def test_sigma_falls_back_along_a_time_line():
    clock = Clock()
    supply = SupplyInput(clock, '/sigma')
    assert supply.now(1.0).why == 'no message on /sigma' and math.isnan(supply.now(1.0).sigma)
    supply.take_sigma(0.5)
    assert supply.now(1.0).sigma == 0.5 and math.isnan(supply.now(1.0).alpha)
    # The error is that of ln sigma, in the estimator and in the filter.
    supply.take_state(state_of(sigma=0.4, sigma_se=0.04, alpha=63.0, throttle=0.3, status='OK'))
    known = supply.now(1.0)
    assert known.sigma_se == 0.04
    assert (known.alpha, known.throttle, known.why) == (63.0, 0.3, '')
    supply.take_state(state_of(other=1.0))
    assert supply.now(1.0) == known
    clock.now = 0.9
    supply.take_sigma(0.5)
    clock.now = 1.5
    assert math.isnan(supply.now(1.0).alpha) and supply.now(1.0).sigma == 0.5
    supply.take_state(state_of(sigma='nan', sigma_se='x', status='NO_DATA', throttle=0.2))
    known = supply.now(1.0)
    assert math.isnan(known.sigma) and known.why == 'the estimator reports NO_DATA'
    assert known.throttle == 0.2 and known.source == 'none'
    # The noise beside the load, 20 mV, is that of an OU of 63 1/s and 0.2245 V/sqrt(s).
    supply.take_state(state_of(sigma='nan', sigma_se='x', status='NO_RELAXATION', throttle=0.2,
                               load_noise=0.02))
    known = supply.now(1.0, 63.0)
    assert (known.sigma, known.source, known.why) == (
        pytest.approx(0.02 * math.sqrt(126.0)), 'load', '')
    assert supply.now(1.0).source == 'none'
    supply.take_state(state_of(sigma=0.5, sigma_se=0.01, status='SHORT_WINDOW'))
    assert supply.now(1.0).sigma == 0.5
    # Of a minute: not for the filter, beside a sliding window of 2 s; of 60 s by a parameter, yes.
    state = {'sigma': 0.5, 'sigma_se': 0.01, 'status': 'OK', 'window_s': 60.0, 'load_noise': 0.02}
    supply.take_state(state_of(**state, duration=2.0))
    assert 'the last 60 s' in supply.now(1.0).why and math.isnan(supply.now(1.0).sigma)
    assert supply.now(1.0, 63.0).source == 'load'
    supply.take_state(state_of(**state, duration=59.9))
    assert supply.now(1.0).sigma == 0.5
    clock.now = 2.0
    assert supply.now(1.0).why == 'sigma on /sigma is stale, 1.1 s old'
    supply.take_sigma(math.nan)
    assert 'not a number' in supply.now(1.0).why


def test_a_field_of_any_type_is_differentiated_by_the_node(world):
    """The type is the publisher's; a ramp of 2 per s comes out as 2, and not as a temperature."""
    probe = world.probe()
    output = probe.listen('/ou_adaptive_filter/output', Vector3Stamped)
    sender = probe.publisher('/input', Temperature)
    process = world.start('adaptive_filter', '--ros-args', '-p', 'input.field:=temperature',
                          '-p', 'mode:=derivative')
    wait_until(sender.get_subscription_count, what='subscription')
    wait_until(lambda: probe.node.count_publishers('/ou_adaptive_filter/output'))
    stamps = iter(range(1, 100_000))

    def settled():
        for _ in range(20):
            k = next(stamps)
            message = Temperature(temperature=0.002 * k, variance=7.0)
            message.header.frame_id = 'probe'
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(k * 10**6, 10**9)
            sender.publish(message)
        return output and output[-1].vector.x == pytest.approx(2.0, abs=1e-6)
    wait_until(settled, what='a slope of 2 1/s')
    last = output[-1]
    assert math.isnan(last.vector.y) and last.header.frame_id == 'probe'
    assert (last.header.stamp.sec, last.header.stamp.nanosec) < divmod(next(stamps) * 10**6, 10**9)
    assert process.stop() == 0


def imu(**covariances):
    """Return an Imu with a stamp, a frame and different numbers in all vectors."""
    message = Imu()
    message.header.frame_id, message.header.stamp.sec = 'base_link', 7
    for k, name in enumerate(('angular_velocity', 'linear_acceleration')):
        vector = getattr(message, name)
        vector.x, vector.y, vector.z = (10.0 * k + axis for axis in (1.0, 2.0, 3.0))
        getattr(message, f'{name}_covariance')[:] = covariances.get(name, [0.0] * 9)
    return message


KNOWN = [4.0, 1.0, 0.0, 1.0, 9.0, 0.0, 0.0, 0.0, 1.0]
ABSENT = [-1.0, *[0.0] * 8]
IMU = 'sensor_msgs/msg/Imu'


def test_an_imu_keeps_what_is_not_filtered():
    channels = channels_of(IMU, '')
    message = imu(angular_velocity=KNOWN, linear_acceleration=KNOWN)
    values = channels.take(message)
    assert values == (1.0, 2.0, 3.0)
    out = channels.put(message, [-x for x in values])
    assert (out.header.frame_id, out.header.stamp.sec) == ('base_link', 7)
    assert (out.angular_velocity.x, out.angular_velocity.z) == (-1.0, -3.0)
    assert out.linear_acceleration.y == 12.0
    assert list(out.angular_velocity_covariance) == KNOWN
    assert channels.output == ''


def test_an_imu_without_a_gyro_gives_nothing():
    assert channels_of(IMU, '').take(imu(angular_velocity=ABSENT)) == ()


@pytest.mark.parametrize('kind, field, message, output', [
    (IMU, '', imu(), 'geometry_msgs/msg/AccelStamped'),
    (IMU, 'angular_velocity.x', imu(), 'geometry_msgs/msg/Vector3Stamped'),
    ('sensor_msgs/msg/BatteryState', '', BatteryState(), 'geometry_msgs/msg/Vector3Stamped'),
    ('geometry_msgs/msg/Point', 'x', Point(x=1.0), 'std_msgs/msg/Float64'),
])
def test_a_derivative_has_a_message_of_its_own(kind, field, message, output):
    channels = channels_of(kind, field, mode='derivative')
    before = str(message)
    values = channels.take(message)
    out = channels.put(message, [float(k) for k in range(5, 5 + len(values))])
    assert channels.output == output and type(out).__name__ == output.rsplit('/', 1)[1]
    assert str(message) == before
    if kind == IMU:
        assert (out.header.frame_id, out.header.stamp.sec) == ('base_link', 7)
    if output.endswith('AccelStamped'):
        assert (out.accel.angular.x, out.accel.angular.z) == (5.0, 7.0)
        assert math.isnan(out.accel.linear.x)
    else:
        assert (out.data if hasattr(out, 'data') else out.vector.x) == 5.0


def test_a_derivative_without_unit_stays_a_number():
    assert channels_of('std_msgs/msg/Float64', '', mode='derivative').output == ''


@pytest.mark.parametrize('length', [0, 3, 4, 11, 60, 200])
def test_a_message_cut_short_is_refused(length):
    with pytest.raises(InputError, match='a message on /input cannot be read'):
        decode(serialize_message(Imu())[:length], Imu, '/input')


def test_the_node_counts_what_cannot_be_read(world):
    """A message cut short is dropped, which is no failure of a callback; the next goes through."""
    probe = world.probe()
    output = probe.listen('/ou_adaptive_filter/output', Imu)
    told = probe.listen('/diagnostics', DiagnosticArray)
    sender = probe.publisher('/input', Imu)
    process = world.start('adaptive_filter')
    wait_until(sender.get_subscription_count, what='subscription')
    wait_until(lambda: probe.node.count_publishers('/ou_adaptive_filter/output'))
    whole = serialize_message(Imu(header=Header(stamp=Time(sec=3), frame_id='base')))

    def sent():
        sender.publish(whole[:100])
        sender.publish(whole)
        return output
    wait_until(sent, what='an output')
    assert output[-1].header == Header(stamp=Time(sec=3), frame_id='base')
    fields = wait_until(lambda: next(
        (f for f in map(values_of, (m.status[0] for m in told)) if f['passed'] != '0'), None))
    assert int(fields['dropped']) > 0 and fields['callback_errors'] == '0'
    assert process.stop() == 0
