"""Fields out of messages: paths, units, stamps, numbers that are not there."""

from array import array
from types import SimpleNamespace as Message

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.stream.config import Extractor, FieldSpec, ManyExtractor, parse_field_path
import pytest


def extractor(field='data', **rest):
    """Return an extractor for a made-up type."""
    return Extractor(FieldSpec('voltage', 'my_msgs/msg/Rail', field, **rest))


@pytest.mark.parametrize('path, steps', [
    ('data', ('data',)), ('header.stamp', ('header', 'stamp')),
    ('channels[0].value', ('channels', 0, 'value')), ('a[1][20]', ('a', 1, 20))])
def test_paths(path, steps):
    """Names and indices, outermost first."""
    assert parse_field_path(path) == steps


@pytest.mark.parametrize('path', ['', '.', 'a.', 'a[', 'a[-1]', 'a[0', '[0]', 'a b', '1a', 'a..b'])
def test_malformed_paths(path):
    """Said at once, not at the first message."""
    with pytest.raises(InputError, match='field path'):
        parse_field_path(path)


def test_units_and_stamp():
    """The value is sign * unit_factor * raw + offset; the stamp is sec + nanosec."""
    spec = extractor('channels[1].mv', sign=-1, unit_factor=1e-3, offset=0.5,
                     stamp_field='header.stamp')
    msg = Message(header=Message(stamp=Message(sec=12, nanosec=250_000_000)),
                  channels=[Message(mv=1), Message(mv=4200)])
    found = spec.extract(msg)
    assert found.stamp == 12.25
    assert found.values.tolist() == [-4.2 + 0.5]
    assert found.values.dtype == np.float64
    assert found.missing == 0


@pytest.mark.parametrize('stamp, expected', [
    (1_500_000, 1.5), (0, None), (float('nan'), None), (Message(sec=0, nanosec=0), None),
    (Message(sec=0, nanosec=1), 1e-9)])
def test_zero_stamp_means_no_stamp(stamp, expected):
    """A stamp that nobody filled in is not 1970."""
    found = extractor(stamp_field='timestamp', stamp_factor=1e-6).extract(
        Message(data=1.0, timestamp=stamp))
    assert found.stamp == (None if expected is None else pytest.approx(expected, rel=1e-12))


def test_no_stamp_field():
    """The middleware's stamp is to be used."""
    assert extractor().extract(Message(data=1.0)).stamp is None


@pytest.mark.parametrize('bad', [float('nan'), float('inf'), -float('inf')])
def test_nan_rules(bad):
    """Dropped noise leaves nothing; "not measured" stays, as NaN; both are counted."""
    dropped = extractor(nan='drop').extract(Message(data=bad))
    assert (dropped.values.size, dropped.missing) == (0, 1)
    unknown = extractor(nan='unknown').extract(Message(data=bad))
    assert unknown.missing == 1
    assert unknown.values.shape == (1,) and np.isnan(unknown.values[0])


@pytest.mark.parametrize('data', [
    array('f', [1.0, float('nan'), 3.0]), [1.0, float('nan'), 3.0],
    np.array([1.0, np.nan, 3.0], dtype=np.float32)])
def test_blocks_keep_their_places(data):
    """A sample that is NaN keeps its place on the time line, whatever the rule."""
    found = extractor(sample_rate=1e4, nan='drop').extract(Message(data=data))
    np.testing.assert_array_equal(found.values, [1.0, np.nan, 3.0])
    assert found.missing == 1


def test_a_block_is_a_copy():
    """The message may be reused by its owner."""
    data = np.array([1.0, 2.0])
    found = extractor(sample_rate=1e4).extract(Message(data=data))
    data[:] = 9.0
    assert found.values.tolist() == [1.0, 2.0]


def test_missing_element_gives_no_value():
    """A message with too few channels is a missing value, not an error."""
    found = extractor('channels[3].value').extract(Message(channels=[Message(value=1.0)]))
    assert (found.values.size, found.missing) == (0, 1)


@pytest.mark.parametrize('field, msg, words', [
    ('volt', Message(voltage=1.0), ["'volt'", 'my_msgs/msg/Rail', "'voltage'"]),
    ('header.stam', Message(header=Message(stamp=1)), ["'stam'", "'stamp'"]),
    ('data', Message(data='5 V'), ['str', 'not a number']),
    ('data', Message(data=Message(x=1)), ['not a number']),
    ('data', Message(data=[1.0, 2.0]), ['array', "'data[0]'", 'sample_rate']),
    ('data[0]', Message(data=1.0), ['not an array']),
])
def test_field_of_the_wrong_type_is_refused(field, msg, words):
    """One line with the path, the type and the way out."""
    with pytest.raises(InputError) as caught:
        extractor(field).extract(msg)
    for word in words:
        assert word in str(caught.value)


def test_wrong_stamp_field_is_refused():
    """Text is no stamp."""
    with pytest.raises(InputError, match="stamp_field 'frame'"):
        extractor(stamp_field='frame').extract(Message(data=1.0, frame='base'))


class Described:
    """Looks like an rclpy message: fields behind underscores."""

    __slots__ = ['_voltage', '_check_fields']

    def __init__(self):
        self._voltage = 1.0

    @classmethod
    def get_fields_and_field_types(cls):
        """Return what rclpy would."""
        return {'voltage': 'float', 'percentage': 'float'}


def test_hints_for_rclpy_messages():
    """The fields are those of the message, not its private slots."""
    with pytest.raises(InputError, match="'percentage'"):
        extractor('percentag').extract(Described())


@pytest.mark.parametrize('rule, expected', [
    ('value', [0.0, 5.0, 0.0]), ('unknown', [np.nan, 5.0, np.nan]),
    ('unknown_at_first', [np.nan, 5.0, 0.0])])
def test_what_a_zero_means(rule, expected):
    """A value, never one, or none as long as there was nothing else."""
    one = extractor(zero=rule, nan='unknown')
    np.testing.assert_array_equal(
        [one.extract(Message(data=value)).values[0] for value in (0.0, 5.0, 0.0)], expected)
    block = extractor(zero=rule, nan='unknown', sample_rate=10.0)
    np.testing.assert_array_equal(
        block.extract(Message(data=[0.0, 5.0, 0.0])).values, expected)


class Esc:
    """An element of an array."""

    def __init__(self, rpm):
        self.rpm = rpm


class Escs:
    """Speeds in an array of elements, in an array of numbers, and alone."""

    def __init__(self):
        self.esc = [Esc(1000), Esc(2000.5)]
        self.all = [1.0, 2.0, 3.0]
        self.one = 4
        self.name = 'x'


@pytest.mark.parametrize('field, values', [
    ('esc[].rpm', [100.0, 200.05]), ('all', [0.1, 0.2, 0.3]), ('all[]', [0.1, 0.2, 0.3]),
    ('esc[1].rpm', [200.05]), ('one', [0.4]), ('esc[7].rpm', [])])
def test_several_numbers(field, values):
    """A field of each element, an array, an element, a number; none where there is none."""
    extractor = ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field, unit_factor=0.1))
    assert extractor.extract(Escs()).tolist() == pytest.approx(values)


@pytest.mark.parametrize('field, words', [
    ('esc[].rp', "did you mean 'rpm'"), ('name', 'holds no numbers'), ('esc', 'holds no numbers'),
    ('esc[]]', 'not of the form'), ('one[]', 'holds no numbers')])
def test_lists_without_numbers_are_refused(field, words):
    """Refused in one line."""
    with pytest.raises(InputError, match=words):
        ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field)).extract(Escs())
