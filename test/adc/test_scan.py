"""Layouts of IIO scans: types, alignment, signs and bytes."""

import numpy as np
from ou_monitor.adc.devices import parse_element, Scan
from ou_monitor.errors import InputError
import pytest


@pytest.mark.parametrize('kind, stored, expected', [
    ('le:u12/16>>4', b'\xf5\xff', 4095), ('le:s12/16>>4', b'\xf5\xff', -1),
    ('be:s12/16>>4', b'\x80\x0f', -2048), ('be:u24/32>>8', b'\x01\x02\x03\xff', 0x010203),
    ('le:s24/32', b'\xff\xff\xff\x00', -1), ('le:s64/64', b'\xff' * 8, -1),
    ('le:s16/16', b'\x00\x80', -32768), ('le:u8/8', b'\xff', 255), ('le:s7/8>>1', b'\x81', -64)])
def test_stored_bits_become_numbers(kind, stored, expected):
    """Shift first, then mask or sign, in either order of bytes."""
    scan = Scan([parse_element('in_voltage0', 0, kind)])
    assert scan.size == len(stored)
    assert scan.integers(stored * 3, 'in_voltage0').tolist() == [expected] * 3


def test_elements_lie_at_multiples_of_their_size():
    """By their index; the scan is padded to its largest element."""
    scan = Scan([parse_element('in_timestamp', 5, 'le:s64/64'),
                 parse_element('in_voltage1', 2, 'le:u16/16'),
                 parse_element('in_voltage0', 1, 'le:u8/8')])
    # 8 bits, a gap, 16 bits, a gap of 4 bytes, 64 bits.
    assert scan.size == 16
    data = b'\x07\x00\x02\x01\x00\x00\x00\x00' + (123).to_bytes(8, 'little')
    assert [scan.integers(data, name)[0] for name in (
        'in_voltage0', 'in_voltage1', 'in_timestamp')] == [7, 0x102, 123]
    # The other way round the last two bytes are padding.
    assert Scan([parse_element('a', 0, 'le:s64/64'), parse_element('b', 1, 'le:u8/8')]).size == 16
    assert Scan([parse_element('a', 0, 'le:u16/16')]).size == 2


def test_raw_counts_become_volts():
    """(raw + offset) * scale is in mV."""
    scan = Scan([parse_element('in_voltage0', 0, 'le:s16/16')])
    data = np.array([-100, 1000], '<i2').tobytes()
    assert scan.volts(data, 'in_voltage0', 2.5, 100.0) == pytest.approx([0.0, 2.75])


@pytest.mark.parametrize('kind, words', [
    ('le:s12', 'not of the form'), ('xx:s12/16', 'not of the form'),
    ('le:s24/24', 'bits of storage'), ('le:s16/16X2', 'without repetition'),
    ('le:s13/16>>4', 'do not fit'), ('le:s0/16', 'do not fit')])
def test_unsupported_elements_are_refused(kind, words):
    with pytest.raises(InputError, match=words):
        parse_element('in_voltage0', 0, kind)
