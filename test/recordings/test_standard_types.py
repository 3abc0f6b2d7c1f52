"""Encoded CDR against two independent decoders."""

from made_bags import decode, encode_block
import numpy as np
from ou_monitor.recordings import standard_types as cdr
from ou_monitor.recordings.standard_types import SCHEMAS, TYPE_HASHES
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)
STAMPS = np.array([1_704_067_200_123_456_789, 1, 0], dtype=np.int64)
VOLTS = [5.0, 4.875, -0.5]


@pytest.mark.parametrize('kind', sorted(SCHEMAS))
def test_schemas_are_those_of_jazzy(kind):
    """The definition hashes to what the independent library computes from its own."""
    mine = get_typestore(Stores.EMPTY)
    mine.register(get_types_from_msg(SCHEMAS[kind], kind))
    assert mine.hash_rihs01(kind) == STORE.hash_rihs01(kind) == TYPE_HASHES[kind]


@pytest.mark.parametrize('kind', [cdr.FLOAT32, cdr.FLOAT64])
def test_scalars_equal_an_independent_encoder(kind):
    messages = cdr.encode_scalars(kind, VOLTS)
    for data, volts in zip(messages, VOLTS, strict=True):
        theirs = STORE.deserialize_cdr(data, kind)
        assert theirs.data == volts
        assert bytes(STORE.serialize_cdr(theirs, kind)) == data
        assert decode(kind, data).data == volts


def test_unmeasured_battery_fields_are_unknown():
    messages = cdr.encode_battery(STAMPS, VOLTS)
    for data, ns, volts in zip(messages, STAMPS.tolist(), VOLTS, strict=True):
        theirs = STORE.deserialize_cdr(data, cdr.BATTERY_STATE)
        assert bytes(STORE.serialize_cdr(theirs, cdr.BATTERY_STATE)) == data
        stamp = theirs.header.stamp
        assert stamp.sec * 1_000_000_000 + stamp.nanosec == ns
        assert (theirs.voltage, theirs.present, theirs.location) == (volts, True, '')
        assert (theirs.power_supply_status, theirs.serial_number) == (0, '')
        for name in ('current', 'charge', 'capacity', 'design_capacity', 'percentage',
                     'temperature'):
            assert np.isnan(getattr(theirs, name))
        assert decode(cdr.BATTERY_STATE, data).voltage == volts


@pytest.mark.parametrize('n', [0, 1, 100])
def test_an_independent_decoder_reads_blocks(n):
    samples = np.linspace(4.0, 5.0, n).astype(np.float32)
    data = encode_block(samples)
    theirs = STORE.deserialize_cdr(data, cdr.FLOAT32_ARRAY)
    assert bytes(STORE.serialize_cdr(theirs, cdr.FLOAT32_ARRAY)) == data
    np.testing.assert_array_equal(theirs.data, samples)
    assert [(d.label, d.size) for d in theirs.layout.dim] == [('samples', n)]


@pytest.mark.parametrize('width', [3, 6])
def test_imu_covariances_say_unmeasured_or_unknown(width):
    """In base_link; -1 means not measured, 0 an unknown covariance."""
    rows = np.arange(18.0).reshape(3, 6)
    messages = cdr.encode_imu(STAMPS, rows[:, :width])
    rows[:, width:] = 0.0
    for k, (data, ns) in enumerate(zip(messages, STAMPS.tolist(), strict=True)):
        theirs = STORE.deserialize_cdr(data, cdr.IMU)
        assert bytes(STORE.serialize_cdr(theirs, cdr.IMU)) == data
        assert theirs.header.frame_id == 'base_link'
        assert theirs.header.stamp.sec * 1_000_000_000 + theirs.header.stamp.nanosec == ns
        assert (theirs.orientation.w, theirs.orientation_covariance[0]) == (1.0, -1.0)
        for first, name in ((0, 'angular_velocity'), (3, 'linear_acceleration')):
            held = getattr(theirs, name)
            assert [held.x, held.y, held.z] == rows[k, first:first + 3].tolist()
            covariance = getattr(theirs, f'{name}_covariance')
            assert covariance[0] == (-1.0 if first == width else 0.0)
            assert not covariance[1:].any()


@pytest.mark.parametrize('names', [('motor_0',), ('motor_0', 'b', 'motor_10'), ('',)])
def test_joint_names_of_any_length_precede_velocities(names):
    speeds = np.arange(3.0 * len(names)).reshape(3, -1)
    for data, ns, row in zip(cdr.encode_joints(STAMPS, names, speeds), STAMPS.tolist(), speeds,
                             strict=True):
        theirs = STORE.deserialize_cdr(data, cdr.JOINT_STATE)
        assert bytes(STORE.serialize_cdr(theirs, cdr.JOINT_STATE)) == data
        assert theirs.name == list(names) and theirs.velocity.tolist() == row.tolist()
        assert (len(theirs.position), len(theirs.effort)) == (0, 0)
        assert theirs.header.stamp.sec * 1_000_000_000 + theirs.header.stamp.nanosec == ns
