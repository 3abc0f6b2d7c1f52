"""Serialised messages of the filter: what goes out is what decoding and encoding would give."""

import math

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovariance, Vector3
from hypothesis import given, settings, strategies as st
from live import values_of, wait_until
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.nodes.filter_channels import CHANNELS, channels_of
from ou_monitor.nodes.filter_frames import Frames
from ou_monitor.recordings.cdr import MOST_LAYOUTS
import pytest
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature
from std_msgs.msg import Float32, Float64, Header

NUMBERS = st.floats(-1e9, 1e9, width=32)
TEXTS = st.text(st.characters(codec='utf-8', exclude_characters='\0'), max_size=9)
HEADERS = st.builds(lambda sec, nanosec, frame: Header(
    stamp=Time(sec=sec, nanosec=nanosec), frame_id=frame),
    st.integers(-2**31, 2**31 - 1), st.integers(0, 10**9 - 1), TEXTS)
VECTORS = st.builds(lambda x, y, z: Vector3(x=x, y=y, z=z), NUMBERS, NUMBERS, NUMBERS)
MATRICES = st.one_of(
    st.lists(NUMBERS, min_size=9, max_size=9), st.just([0.0] * 9), st.just([-1.0, *[0.0] * 8]))
IMUS = st.builds(
    lambda header, rates, about, forces, near: Imu(
        header=header, angular_velocity=rates, angular_velocity_covariance=about,
        linear_acceleration=forces, linear_acceleration_covariance=near),
    HEADERS, VECTORS, MATRICES, VECTORS, MATRICES)
JOINTS = st.builds(lambda header, names, speeds: JointState(
    header=header, name=names, velocity=speeds), HEADERS, st.lists(TEXTS, max_size=3), st.lists(
        NUMBERS, max_size=3))
# Type, field, whether acceleration too, messages.
CASES = [
    (Imu, '', False, IMUS), (Imu, '', True, IMUS), (Imu, 'linear_acceleration.y', False, IMUS),
    (JointState, 'velocity[1]', False, JOINTS),
    (PoseWithCovariance, 'covariance[7]', False, st.builds(
        lambda one: PoseWithCovariance(covariance=[one] * 36), NUMBERS)),
    (Float32, '', False, st.builds(lambda one: Float32(data=one), NUMBERS)),
    (Float64, '', False, st.builds(lambda one: Float64(data=one), NUMBERS)),
    (Temperature, 'variance', False, st.builds(
        lambda header, one: Temperature(header=header, variance=one), HEADERS, NUMBERS)),
    (BatteryState, '', False, st.builds(
        lambda header, one, cells, text: BatteryState(
            header=header, voltage=one, cell_voltage=cells, serial_number=text),
        HEADERS, NUMBERS, st.lists(NUMBERS, max_size=3), TEXTS))]


def name_of(kind):
    """Return 'package/msg/Type'."""
    return f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}"


@pytest.mark.parametrize('kind, field, acceleration, messages', CASES)
@settings(max_examples=25)
@given(data=st.data())
def test_as_decoded_and_encoded(kind, field, acceleration, messages, data):
    """Messages of one topic, their lengths and texts changing as they like."""
    channels = channels_of(name_of(kind), field, acceleration=acceleration)
    frames = Frames(name_of(kind), channels, '/input')
    for message in data.draw(st.lists(messages, min_size=1, max_size=5)):
        raw = serialize_message(message)
        frame = frames.open(raw)
        assert tuple(frame.values) == tuple(channels.take(message))
        stamp = message.header.stamp if hasattr(message, 'header') else Time()
        assert frame.stamp == stamp.sec + stamp.nanosec * 1e-9
        if not frame.values:
            continue
        wanted = [0.25 * one + 3.0 for one in frame.values]
        out = frame.put(wanted, 0.25)
        if isinstance(out, bytes):
            assert len(out) == len(raw)
            out = deserialize_message(out, kind)
        assert out == deserialize_message(
            serialize_message(channels.put(message, wanted, 0.25)), kind)


@pytest.mark.parametrize('kind', CHANNELS)
def test_no_message_of_a_known_type_is_decoded(kind):
    """Neither is one whose frame has another name, nor one that holds no gyro."""
    channels = channels_of(kind, '')
    frames = Frames(kind, channels, '/input')
    message = next(one for one, *_ in CASES if name_of(one) == kind)()
    for frame_id in ('', 'base', 'imu_link'):
        if hasattr(message, 'header'):
            message.header.frame_id = frame_id
        for _ in range(2):
            assert isinstance(
                frames.open(serialize_message(message)).put([1.0] * len(channels.names), 1.0),
                bytes)
    assert not frames.decoded


def test_what_has_no_layout_is_decoded():
    """Big endian, an array that is too short, and more layouts than are kept."""
    frames = Frames('std_msgs/msg/Float64', channels_of('std_msgs/msg/Float64', ''), '/input')
    big = b'\x00\x00\x00\x00' + np.array([2.5], '>f8').tobytes()
    assert frames.open(big).values == (2.5,) and frames.decoded == 1
    assert frames.open(big).put([3.5], 1.0) == Float64(data=3.5)
    joints = Frames('sensor_msgs/msg/JointState', channels_of(
        'sensor_msgs/msg/JointState', 'velocity[1]'), '/input')
    assert joints.open(serialize_message(JointState(velocity=[1.0]))).values == ()
    assert joints.open(serialize_message(JointState(velocity=[1.0, 2.0]))).values == (2.0,)
    assert joints.decoded == 1
    for k in range(2 * MOST_LAYOUTS):
        message = JointState(name=['x' * 8 * k], velocity=[1.0, 2.0])
        assert joints.open(serialize_message(message)).values == (2.0,)
    assert joints.decoded == 1 + 2 * MOST_LAYOUTS - (MOST_LAYOUTS - 1)


def test_a_derivative_is_decoded():
    """It goes out as another message."""
    channels = channels_of('sensor_msgs/msg/Imu', '', mode='derivative')
    frames = Frames('sensor_msgs/msg/Imu', channels, '/input')
    out = frames.open(serialize_message(Imu(angular_velocity=Vector3(x=1.0)))).put(
        [5.0, 6.0, 7.0], 1.0)
    assert out.accel.angular == Vector3(x=5.0, y=6.0, z=7.0) and math.isnan(out.accel.linear.x)


@pytest.mark.parametrize('length', [0, 3, 4, 11, 60, 200])
def test_a_message_cut_short_is_refused(length):
    """An error of the input, whatever was learned before."""
    frames = Frames('sensor_msgs/msg/Imu', CHANNELS['sensor_msgs/msg/Imu'], '/input')
    whole = serialize_message(Imu())
    frames.open(whole)
    with pytest.raises(InputError, match='a message on /input cannot be read'):
        frames.open(whole[:length])


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
