"""Paths to fields, and several numbers out of one message."""

from ou_monitor.errors import InputError
from ou_monitor.stream.config import FieldSpec, ManyExtractor, parse_field_path
import pytest


@pytest.mark.parametrize('path, steps', [
    ('data', ('data',)), ('header.stamp', ('header', 'stamp')),
    ('channels[0].value', ('channels', 0, 'value')), ('a[1][20]', ('a', 1, 20))])
def test_a_field_path_has_names_and_indices(path, steps):
    """Outermost first."""
    assert parse_field_path(path) == steps


@pytest.mark.parametrize('path', ['', '.', 'a.', 'a[', 'a[-1]', 'a[0', '[0]', 'a b', '1a', 'a..b'])
def test_a_malformed_path_is_refused_at_once(path):
    """Not only at the first message."""
    with pytest.raises(InputError, match='field path'):
        parse_field_path(path)


class Message:
    """Looks like an rclpy message."""

    def __init__(self, **fields):
        self.__dict__ |= fields

    def get_fields_and_field_types(self):
        """Return what rclpy would, by instance here."""
        return dict.fromkeys(self.__dict__, 'float')


ESCS = Message(esc=[Message(rpm=1000), Message(rpm=2000.5)], all=[1.0, 2.0, 3.0], one=4, name='x')


@pytest.mark.parametrize('field, values', [
    ('esc[].rpm', [100.0, 200.05]), ('all', [0.1, 0.2, 0.3]), ('all[]', [0.1, 0.2, 0.3]),
    ('esc[1].rpm', [200.05]), ('one', [0.4]), ('esc[7].rpm', [])])
def test_several_numbers_are_extracted(field, values):
    """A field of each element, an array, an element, a number; empty if there is none."""
    extractor = ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field, unit_factor=0.1))
    assert extractor.extract(ESCS).tolist() == pytest.approx(values)


@pytest.mark.parametrize('field, words', [
    ('esc[].rp', "did you mean 'rpm'"), ('name', 'holds no numbers'), ('esc', 'holds no numbers'),
    ('esc[]]', 'not of the form'), ('one[]', 'holds no numbers'), ('one[0]', 'not an array')])
def test_lists_without_numbers_are_refused(field, words):
    """Refused in one line."""
    with pytest.raises(InputError, match=words):
        ManyExtractor(FieldSpec('rpm', 'my_msgs/msg/Escs', field)).extract(ESCS)
