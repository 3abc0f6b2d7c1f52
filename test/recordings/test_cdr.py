"""CDR in bulk: decoded bit for bit as by the MCAP library, encoded as by rosbags."""

import itertools
import re

from hypothesis import given, settings, strategies as st
from made_bags import decode, encode, encode_block
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings import standard_types as cdr
from ou_monitor.recordings.cdr import ColumnBuffer, FieldReader, MessageTable, seconds
from ou_monitor.recordings.standard_types import parse_definition, SCHEMAS, TYPE_HASHES
from ou_monitor.stream.config import FieldSpec, parse_field_path, walk
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)
KIND = 'p/msg/Top'
INTS = ('int8', 'uint8', 'byte', 'char', 'int16', 'uint16', 'int32', 'uint32', 'int64', 'uint64')
WIDTH = {'byte': (0, 255), 'char': (-128, 127)}
TEXTS = ('', 'a', 'base_link', 'été', '\u4e2d' * 3, 'x' * 9)


def table_of(messages, times=None):
    """Return serialized messages as they lie in a chunk, at odd places."""
    gaps = [b'\xff' * (3 + k % 5) for k in range(len(messages))]
    data = b''.join(itertools.chain.from_iterable(zip(gaps, messages)))
    lengths = np.array([len(m) for m in messages], dtype=np.int64)
    steps = np.array([len(g) for g in gaps], dtype=np.int64)
    end = np.cumsum(steps + lengths)
    times = np.arange(len(messages)) * 10**7 + 5 if times is None else times
    return MessageTable(data, np.zeros(len(messages), np.uint16), np.array(times, np.uint64),
                        end - lengths, end)


def numbers(raw):
    """Return a field of an object as numbers; None: it holds none."""
    raw = list(raw) if isinstance(raw, bytes) else raw
    try:
        return None if isinstance(raw, str) else np.array(raw, dtype=float)
    except (TypeError, ValueError):
        return None


def one_by_one(spec, text, messages, table):
    """Return stamps, counts and values as the library decodes them; None or TEXTS: it refuses."""
    stamps, counts, values = [], [], [np.empty(0)]
    for message, logged in zip(messages, seconds(table.log_time)):
        try:
            decoded = decode(spec.type, message, text)
        except UnicodeDecodeError:
            return TEXTS
        except Exception:
            return None
        raw = walk(decoded, parse_field_path(spec.field), spec.field, spec.type)
        held = np.empty(0) if raw is None else numbers(raw)
        if held is None or (raw is not None and held.ndim and spec.sample_rate is None):
            return None
        # Random bytes may be a signalling NaN.
        with np.errstate(invalid='ignore'):
            held = np.atleast_1d(held) * (spec.sign * spec.unit_factor) + spec.offset
        held[~np.isfinite(held)] = np.nan
        if raw is None and spec.sample_rate is None:
            held = np.array([np.nan])
        stamp = spec.stamp_field and walk(decoded, parse_field_path(spec.stamp_field), '', '')
        if stamp is None:
            stamp = 0.0
        elif hasattr(stamp, 'nanosec'):
            stamp = float(stamp.sec) + 1e-9 * float(stamp.nanosec)
        elif isinstance(stamp, (int, float)):
            stamp = float(stamp) * spec.stamp_factor
        else:
            return None
        stamps.append(stamp if np.isfinite(stamp) and stamp != 0.0 else logged)
        counts.append(held.size)
        values.append(held)
    return np.array(stamps), np.array(counts), np.concatenate(values)


def refuse(log_time, why):
    """Raise for a message that does not fit its type."""
    raise InputError(why)


def reader_of(spec, text, broken=refuse):
    return FieldReader(spec, parse_definition(spec.type, text), broken)


def in_bulk(spec, text, table):
    try:
        column = reader_of(spec, text).read(table)
    except InputError:
        return None
    return column.stamp, column.counts, column.values


def assert_same(found, expected):
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one.astype(np.float64).view(np.uint64),
                                      other.astype(np.float64).view(np.uint64))


def assert_both_ways(spec, text, messages, broken=False):
    """Compare the two ways."""
    # Of a broken message the library takes texts that go on beyond it, and of a type without a
    # number there an empty array: both are refused here.
    table = table_of(messages)
    found = in_bulk(spec, text, table)
    expected = one_by_one(spec, text, messages, table)
    if expected is TEXTS:
        # Its text is no UTF-8: skipped here.
        return
    if found is not None:
        assert_same(found, expected)
    elif expected is not None and not broken:
        assert re.search(r'holds a|is an array|is a', str(pytest.raises(
            InputError, reader_of, spec, text).value))
        assert not np.isfinite(expected[2]).any() or spec.stamp_field is not None


class Maker:
    """Random definitions, messages and field paths."""

    def __init__(self, rnd):
        self.rnd = rnd
        self.types = {}
        self.make_type('Top', 2)

    def make_type(self, name, depth):
        fields = []
        for k in range(self.rnd.randint(0 if depth < 2 else 1, 5)):
            kind = self.rnd.choice((*INTS, 'bool', 'float32', 'float64', 'string', 'nested'))
            if kind == 'nested':
                kind = f'T{len(self.types)}{k}{depth}' if depth else 'float32'
                if depth:
                    self.make_type(kind, depth - 1)
            array = self.rnd.choice(('', '', '', '[]', '[2]', '[<=3]', '[3]'))
            fields.append((f'f{k}', kind, array))
        self.types[name] = fields

    def text(self):
        """Return the definition as rosidl writes it."""
        def one(name):
            lines = ['# a comment', 'uint8 LIMIT=3']
            lines += [f'{"p/" if k[0] == "T" else ""}{k}{a} {f}  # {f}'
                      for f, k, a in self.types[name]]
            return '\n'.join(lines) + '\n'
        rest = [f'{80 * "="}\nMSG: p/{name}\n{one(name)}' for name in self.types if name != 'Top']
        return one('Top') + ''.join(rest)

    def value(self, kind):
        if kind == 'string':
            return self.rnd.choice(TEXTS)
        if kind == 'bool':
            return self.rnd.random() < 0.5
        if kind in ('float32', 'float64'):
            return self.rnd.choice((float('nan'), float('inf'), 0.0, -0.0, 0.1, 1e30, -5.0))
        if kind in INTS:
            low, high = WIDTH.get(kind, (0, 0)) if kind in WIDTH else (
                (0, 2**int(kind[4:]) - 1) if kind[0] == 'u' else
                (-2**(int(kind[3:]) - 1), 2**(int(kind[3:]) - 1) - 1))
            return self.rnd.choice((low, high, self.rnd.randint(low, high)))
        return self.message(kind)

    def message(self, name='Top'):
        out = {}
        for field, kind, array in self.types[name]:
            size = {'': None, '[2]': 2, '[3]': 3}.get(array, self.rnd.randint(0, 3))
            out[field] = (self.value(kind) if size is None
                          else [self.value(kind) for _ in range(size)])
        return out

    def alike(self, content, name='Top'):
        """Return a message of the same shape with other numbers."""
        out = {}
        for field, kind, _ in self.types[name]:
            def other(old, kind=kind):
                if kind == 'string':
                    return old
                return self.alike(old, kind) if kind in self.types else self.value(kind)
            held = content[field]
            out[field] = [other(x) for x in held] if isinstance(held, list) else other(held)
        return out

    def paths(self, name='Top', head=''):
        """Return every path to a field or element."""
        found = []
        for field, kind, array in self.types[name]:
            here = head + field
            for path in ([here] if not array else [here, *(f'{here}[{k}]' for k in (0, 2))]):
                found.append(path)
                if kind in self.types and (not array or path.endswith(']')):
                    found += self.paths(kind, path + '.')
        return found


@settings(max_examples=150, deadline=None)
@given(st.randoms(use_true_random=False), st.data())
def test_any_schema_any_message(rnd, data):
    maker = Maker(rnd)
    text = maker.text()
    base = maker.message()
    messages = []
    for _ in range(rnd.randint(1, 8)):
        content = maker.alike(base) if rnd.random() < 0.8 else maker.message()
        messages.append(encode(KIND, content, text))
    paths = maker.paths()
    spec = FieldSpec(
        'x', KIND, rnd.choice(paths), unit_factor=0.1, sign=rnd.choice((1, -1)), offset=0.3,
        stamp_field=rnd.choice((None, *paths)), stamp_factor=1e-6,
        sample_rate=rnd.choice((None, 10.0)))
    assert_both_ways(spec, text, messages)
    # A wrong byte, most often in a word that states a length, and a lost end.
    for _ in range(3):
        broken = bytearray(messages[0])
        small = [k for k, byte in enumerate(broken) if 0 < byte < 12] or [0]
        broken[rnd.choice((rnd.choice(small), rnd.randrange(len(broken))))] = rnd.choice(
            (0, 1, 2, 3, 4, 7, 0x80, 0xc3, 0xff))
        assert_both_ways(spec, text, [*messages, bytes(broken)], broken=True)
    assert_both_ways(spec, text, [*messages, messages[0][:rnd.randint(1, len(messages[0]))]],
                     broken=True)


@pytest.mark.parametrize('field', ['s', 'd', 'e', 'u', 'u[1]', 'n.x', 'n', 'a', 'a[0].x', 'a[1].x',
                                   'f', 'f[1]', 'f[2]'])
@pytest.mark.parametrize('rate', [None, 10.0])
def test_empty_arrays_and_unequal_shapes_are_read(field, rate):
    """Empty arrays are not aligned; equal sizes can hide unequal shapes."""
    text = ('string s\nstring t\nfloat64[] d\nuint8 e\nuint8[] u\nN n\nN[] a\nfloat32[] f\n'
            + 80 * '=' + '\nMSG: p/N\nfloat64 x\n')
    messages = [encode(KIND, {'s': s, 't': t, 'd': d, 'e': 4, 'u': u, 'n': {'x': 2.5},
                              'a': [{'x': float(k)} for k in range(m)], 'f': [0.5, 1.5][:m]}, text)
                for s, t in (('a', 'abcdefghi'), ('abcdefghi', 'a'), ('', ''), ('', 'abcdefghij'))
                for d in ([], [1.0]) for u in ([], [7, 8]) for m in (0, 1, 2)]
    spec = FieldSpec('x', KIND, field, sample_rate=rate)
    for some in (messages, messages[::-1], messages[:1], messages[5:7], messages[3:40:6]):
        assert_both_ways(spec, text, some)


def battery(frame, volts, cells=(), stamp=(5, 7)):
    """Return a BatteryState as an independent library writes it."""
    message = STORE.deserialize_cdr(
        cdr.encode_battery(np.array([1]), [volts])[0], cdr.BATTERY_STATE)
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    message.cell_voltage = np.array(cells, dtype=np.float32)
    return bytes(STORE.serialize_cdr(message, cdr.BATTERY_STATE))


BATTERY = FieldSpec('/v', cdr.BATTERY_STATE, 'voltage', stamp_field='header.stamp')


def read_all(spec, messages, times=None, text=None):
    """Return the column, and log times and reasons of the messages left out."""
    broken = []
    reader = reader_of(spec, text or SCHEMAS[spec.type], lambda *why: broken.append(why))
    return reader.read(table_of(messages, times)), broken


@pytest.mark.parametrize('stamp, counts', [((5, 7), True), ((0, 0), False), ((0, 1), True),
                                           ((-1, 10**9), False)])
def test_stamps_and_their_absence(stamp, counts):
    """A zero stamp is missing: the log time is used."""
    column, _ = read_all(BATTERY, [battery('', 5.0, stamp=stamp)], [3 * 10**9])
    assert column.stamp[0] == (stamp[0] + 1e-9 * stamp[1] if counts else 3.0)
    assert column.stamped.tolist() == [counts]


def test_big_endian_is_read_and_bad_messages_are_left_out():
    """XCDR2 and truncated messages are left out with a reason, in order; texts are skipped."""
    good = cdr.encode_scalars(cdr.FLOAT32, [1.0, 2.0, 4.0])
    big = b'\0\0\0\0' + np.array([8.0], '>f4').tobytes()
    xcdr2 = b'\0\x07' + good[0][2:]
    spec = FieldSpec('/v', cdr.FLOAT32, 'data')
    column, broken = read_all(spec, [good[0], big, xcdr2, good[1], good[1][:6], b'', good[2]],
                              range(7))
    assert column.values.tolist() == [1.0, 8.0, 2.0, 4.0]
    assert column.log_time.tolist() == [0, 1, 3, 6]
    assert broken == [(2, 'it is not plain CDR'),
                      (4, 'it is shorter than its own lengths state'), (5, 'it is not plain CDR')]
    odd = battery('base', 5.0).replace(b'base', b'\xffase')
    assert read_all(BATTERY, [odd])[0].values.tolist() == [5.0]


@pytest.mark.parametrize('labels', [[], ['a'], ['rows', 'columns'], ['x' * 7, 'y' * 8]])
def test_blocks_of_any_layout_and_length(labels):
    """Dimensions are passed over; blocks of unequal length stay in order."""
    messages = []
    for n in (3, 0, 3, 5, 5, 1):
        message = STORE.deserialize_cdr(encode_block(np.arange(n) + len(messages)),
                                        cdr.FLOAT32_ARRAY)
        dim = message.layout.dim[0]
        message.layout.dim = [type(dim)(label, 2, 2) for label in labels]
        messages.append(bytes(STORE.serialize_cdr(message, cdr.FLOAT32_ARRAY)))
    column, _ = read_all(FieldSpec('/v', cdr.FLOAT32_ARRAY, 'data', sample_rate=10.0), messages)
    assert column.counts.tolist() == [3, 0, 3, 5, 5, 1]
    assert column.values.tolist() == [0, 1, 2, 2, 3, 4, 3, 4, 5, 6, 7, 4, 5, 6, 7, 8, 5]


def test_time_order_keeps_the_fields_of_a_message_together():
    messages = [encode_block([float(k)] * n) for k, n in enumerate((2, 1, 3, 0, 2))]
    spec = FieldSpec('/v', cdr.FLOAT32_ARRAY, 'data', sample_rate=10.0)
    column = read_all(spec, messages, [30, 10, 10, 5, 20])[0].in_time_order()
    assert column.counts.tolist() == [0, 1, 3, 2, 2]
    assert column.values.tolist() == [1, 2, 2, 2, 4, 4, 0, 0]
    first, rest = column.split(3)
    assert (first.values.tolist(), rest.log_time.tolist()) == ([1, 2, 2, 2], [20, 30])
    buffer = ColumnBuffer()
    for part in (first, rest, first._replace(beside=np.arange(3.0))):
        buffer.add(part)
    whole = buffer.whole()
    for name in column._fields:
        np.testing.assert_array_equal(getattr(whole.split(5)[0], name), getattr(column, name))
    assert whole.counts.tolist()[5:] == [0, 1, 3] and whole.beside.tolist()[5:] == [0, 1, 2]
    buffer = ColumnBuffer()
    for stamped in (True, True, False):
        buffer.add(first._replace(stamped=np.broadcast_to(stamped, 3)))
    assert buffer.whole().stamped.tolist() == [True] * 6 + [False] * 3


def test_log_times_of_any_size():
    """The largest log time that a bag can hold does not overflow."""
    assert seconds(np.array([0, 1, 2**64 - 1], np.uint64)).tolist() == [
        0.0, 1e-9, 18446744073 + 0.709551615]


@pytest.mark.parametrize('rule, expected', [
    ('value', [0.0, 5.0, 0.0]), ('unknown', [np.nan, 5.0, np.nan]),
    ('unknown_at_first', [np.nan, 5.0, 0.0])])
def test_what_a_zero_means(rule, expected):
    """A value, never one, or none as long as there was nothing else."""
    spec = FieldSpec('/v', cdr.FLOAT32, 'data', zero=rule)
    found = read_all(spec, cdr.encode_scalars(cdr.FLOAT32, [0.0, 5.0, 0.0]))[0].values
    np.testing.assert_array_equal(found, expected)


TREE = ('string s\nN[] n\nfloat64[] d\nfloat64 x\nT t\n' + 80 * '=' + '\nMSG: p/N\nint32 mv\n'
        + 80 * '=' + '\nMSG: p/T\nint32 sec\nuint32 nanosec\n')


@pytest.mark.parametrize('options, words', [
    ({'field': 'xx'}, "no 'xx' there; did you mean 'x'"),
    ({'field': 'n[0].m'}, "did you mean 'mv'"), ({'field': 'n.mv'}, "no 'mv' there"),
    ({'field': 's'}, 'holds a string, not a number'), ({'field': 'n[0]'}, 'holds a p/N'),
    ({'field': 'd'}, r"is an array: name one element, 'd\[0\]', or give sample_rate"),
    ({'field': 'x[0]'}, 'something that is not an array'),
    ({'stamp_field': 's'}, "stamp_field 's' of p/msg/Top is a string"),
    ({'stamp_field': 'd'}, r'is a float64\[\]'), ({'stamp_field': 'n[0]'}, 'is a p/N')])
def test_paths_that_the_type_does_not_have(options, words):
    """Refused before a message is read, with the way out."""
    with pytest.raises(InputError, match=words):
        reader_of(FieldSpec('/v', KIND, **{'field': 'x', **options}), TREE)


def test_a_signalling_nan_gives_no_warning():
    """Of which NumPy warns where it is scaled or widened, and a warning is an error here."""
    spec = FieldSpec('x', KIND, 'x', unit_factor=0.1)
    column, _ = read_all(spec, [bytes.fromhex('000100000100807f')], text='float32 x\n')
    assert np.isnan(column.values).all()


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
