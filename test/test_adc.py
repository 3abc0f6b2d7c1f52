"""IIO and hwmon devices in a simulated sysfs, and the samples read from them."""

import os
import threading
import time

from made_devices import attributes, iio_device, scans, volts
import numpy as np
from ou_monitor.adc import (
    BLOCKS, find_device, IioBuffer, parse_element, PolledChannel, Scan, USUAL_RATE)
from ou_monitor.errors import InputError
import pytest


T0 = 1_700_000_000_000_000_000


def take(buffer, n):
    """Return the first n blocks."""
    found = []
    for block in buffer.blocks():
        if block is not None:
            found.append(block)
        if len(found) == n:
            return found


def feed(character, data, pieces=7):
    """Write to the FIFO from a thread, in pieces that end anywhere."""
    def write():
        with character.open('wb', buffering=0) as file:
            for part in np.array_split(np.frombuffer(data, np.uint8), pieces):
                file.write(part.tobytes())
            done.wait(60.0)
    done = threading.Event()
    threading.Thread(target=write, daemon=True).start()
    return done


def test_a_buffer_is_set_up_and_gives_blocks(tmp_path):
    folder, character = iio_device(tmp_path)
    counts = np.arange(-300, 300)
    done = feed(character, scans(counts, T0 + 100_000 * np.arange(600)))
    buffer = IioBuffer(folder, character, 'in_voltage1', rate=5000.0, trigger='hr', block=200)
    first = {name: (folder / name).read_text().strip() for name in (
        'scan_elements/in_voltage0_en', 'scan_elements/in_voltage1_en',
        'scan_elements/in_timestamp_en', 'buffer/enable', 'trigger/current_trigger',
        'buffer/length', 'buffer/watermark')}
    assert list(first.values()) == ['0', '1', '1', '1', 'hr', str(200 * BLOCKS), '200']
    found = take(buffer, 3)
    done.set()
    np.testing.assert_allclose(np.concatenate([b.volts for b in found]), volts(counts))
    assert [b.stamp for b in found] == pytest.approx(
        [T0 * 1e-9 + 1e-4 * k for k in (199, 399, 599)], abs=1e-6)
    assert found[0].interval == pytest.approx(1e-4) and buffer.holes == 0
    buffer.close()
    assert (folder / 'buffer/enable').read_text().startswith('0')


def test_a_hole_splits_a_block(tmp_path):
    folder, character = iio_device(tmp_path)
    stamps = T0 + 100_000 * np.concatenate([np.arange(50), np.arange(80, 130)])
    done = feed(character, scans(np.arange(100), stamps))
    buffer = IioBuffer(folder, character, 'in_voltage1')
    assert buffer.rate == 10_000.0 and buffer.block == 100
    first, second = take(buffer, 2)
    done.set()
    assert (first.volts.size, second.volts.size, buffer.holes) == (50, 50, 1)
    assert second.stamp - first.stamp == pytest.approx(80e-4, abs=1e-6)
    buffer.close()


@pytest.mark.parametrize('block', [1, 2, 25, 100])
def test_samples_lost_between_two_blocks_are_a_hole(tmp_path, block):
    """50 samples, at every length of a block; a clock that is set back is not a hole."""
    folder, character = iio_device(tmp_path)
    places = np.concatenate([np.arange(100), np.arange(150, 250), np.arange(-1000, -900)])
    done = feed(character, scans(np.arange(300), T0 + 100_000 * places))
    buffer = IioBuffer(folder, character, 'in_voltage1', block=block)
    found = take(buffer, 300 // block)
    done.set()
    assert buffer.holes == 1 and {b.volts.size for b in found} == {block}
    assert found[-1].interval == pytest.approx(1e-4)
    buffer.close()


def test_the_device_stamps_by_the_time_since_1970(tmp_path):
    folder, character = iio_device(tmp_path, clock='monotonic')
    done = feed(character, scans(np.arange(10), T0 + 100_000 * np.arange(10)))
    buffer = IioBuffer(folder, character, 'in_voltage1', block=10)
    assert (folder / 'current_timestamp_clock').read_text() == 'realtime\n'
    (block,) = take(buffer, 1)
    done.set()
    assert block.stamp == pytest.approx(1e-9 * (T0 + 900_000), abs=1e-6)
    buffer.close()


def test_without_a_timestamp_blocks_have_the_time_of_reading(tmp_path):
    folder, character = iio_device(tmp_path)
    for name in ('en', 'index', 'type'):
        (folder / f'scan_elements/in_timestamp_{name}').unlink()
    done = feed(character, (np.arange(100) << 4).astype('>i2').tobytes())
    buffer = IioBuffer(folder, character, 'in_voltage1')
    before = time.time()
    (block,) = take(buffer, 1)
    done.set()
    assert before - 60.0 < block.stamp <= time.time() and np.isnan(block.interval)
    np.testing.assert_allclose(block.volts, volts(np.arange(100)))
    buffer.close()


def test_a_device_is_found_by_each_of_its_names(tmp_path):
    folder, _ = iio_device(tmp_path)
    sysfs = tmp_path / 'sys'
    attributes(sysfs / 'class/hwmon/hwmon2', name='ina226', in1_input=5012)
    for name in ('iio:device0', 'ads1015', str(folder)):
        assert find_device(name, sysfs) == folder
    for name in ('', 'ads1115', str(tmp_path / 'none')):
        with pytest.raises(InputError, match=r'iio:device0 \(ads1015\), hwmon2 \(ina226\)'):
            find_device(name, sysfs)
    attributes(sysfs / 'class/hwmon/hwmon3', name='ina226')
    with pytest.raises(InputError, match='hwmon2, hwmon3'):
        find_device('ina226', sysfs)


@pytest.mark.parametrize('spoil, words', [
    (lambda f, c: (f / 'buffer/enable').unlink(), 'cannot set .*buffer/enable'),
    (lambda f, c: (f / 'in_voltage_scale').unlink(), 'does not state the scale of in_voltage1'),
    (lambda f, c: (f / 'in_voltage_scale').write_text('much\n'), "holds 'much', not a number"),
    (lambda f, c: ((f / 'current_timestamp_clock').unlink(),
                   (f / 'current_timestamp_clock').mkdir()), 'cannot read .*timestamp_clock'),
    (lambda f, c: c.unlink(), 'cannot open .*No such file'),
    (lambda f, c: os.rename(f / 'scan_elements', f / 'x'), 'has no buffer')])
def test_device_errors_name_the_cause(tmp_path, spoil, words):
    folder, character = iio_device(tmp_path)
    spoil(folder, character)
    with pytest.raises(InputError, match=words):
        IioBuffer(folder, character, 'in_voltage1')


@pytest.mark.parametrize('channel, words', [
    ('', 'has 2 voltage channels'), ('in_voltage7', "no channel 'in_voltage7'")])
def test_the_channel_must_be_known(tmp_path, channel, words):
    folder, character = iio_device(tmp_path)
    with pytest.raises(InputError, match=words):
        IioBuffer(folder, character, channel)
    with pytest.raises(InputError, match=words):
        PolledChannel(folder, channel)


def test_missing_permission_is_reported(tmp_path, monkeypatch):
    """Simulated, because root may write any file."""
    folder, character = iio_device(tmp_path)

    def refuse(*args, **kwargs):
        raise PermissionError(13, 'Permission denied')
    with monkeypatch.context() as patch, pytest.raises(
            InputError, match='not permitted; give the user of this node access'):
        patch.setattr(os, 'open', refuse)
        IioBuffer(folder, character, 'in_voltage1')


def test_polled_channels_are_in_volts(tmp_path):
    """Hwmon counts in mV; a raw IIO channel in counts of a scale."""
    folder, _ = iio_device(tmp_path)
    assert PolledChannel(folder, 'in_voltage1').read() == pytest.approx((2 + 0.0) * 2.5e-3 + 0.025)
    attributes(tmp_path / 'hwmon2', name='ina226', in1_input=5012, update_interval=20)
    channel = PolledChannel(tmp_path / 'hwmon2')
    assert channel.read() == pytest.approx(5.012) and channel.rate == 50.0
    attributes(tmp_path / 'hwmon2', in1_input=4988)
    assert channel.read() == pytest.approx(4.988)
    (tmp_path / 'hwmon2/update_interval').unlink()
    assert PolledChannel(tmp_path / 'hwmon2').rate == USUAL_RATE


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


@pytest.mark.parametrize('kind, words', [
    ('le:s12', 'not of the form'), ('xx:s12/16', 'not of the form'),
    ('le:s24/24', 'bits of storage'), ('le:s16/16X2', 'without repetition'),
    ('le:s13/16>>4', 'do not fit'), ('le:s0/16', 'do not fit')])
def test_unsupported_elements_are_refused(kind, words):
    with pytest.raises(InputError, match=words):
        parse_element('in_voltage0', 0, kind)
