"""Simulated devices of IIO and hwmon: a sysfs tree of files, and a FIFO as character device."""

import os
from pathlib import Path

import numpy as np

# Signed counts of 12 bits in the upper bits of 16, as from the MCP3xxx and ADS1015 drivers.
KIND, SHIFT = 'be:s12/16>>4', 4
SCALE, OFFSET = 2.5, 10.0


def attributes(folder: Path, **values: object) -> None:
    """Write attributes; a double underscore stands for a folder."""
    for name, value in values.items():
        path = folder / name.replace('__', '/')
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f'{value}\n')


def iio_device(root: Path, rate: float = 10_000.0, clock: str = 'realtime') -> tuple[Path, Path]:
    """Make an IIO device of two channels and a timestamp; return its sysfs folder and its FIFO."""
    # Only channel 0 is enabled, as if another program had done so.
    folder = root / 'sys/bus/iio/devices/iio:device0'
    attributes(
        folder, name='ads1015', sampling_frequency=rate, in_voltage_scale=SCALE,
        in_voltage1_offset=OFFSET, in_voltage0_raw=1, in_voltage1_raw=2,
        current_timestamp_clock=clock, trigger__current_trigger='', buffer__enable=0,
        buffer__length=2, buffer__watermark=1,
        scan_elements__in_voltage0_en=1, scan_elements__in_voltage0_index=0,
        scan_elements__in_voltage0_type='le:u8/8',
        scan_elements__in_voltage1_en=0, scan_elements__in_voltage1_index=1,
        scan_elements__in_voltage1_type=KIND,
        scan_elements__in_timestamp_en=0, scan_elements__in_timestamp_index=2,
        scan_elements__in_timestamp_type='le:s64/64')
    character = root / 'dev/iio:device0'
    character.parent.mkdir()
    os.mkfifo(character)
    return folder, character


def scans(counts: np.ndarray, stamps: np.ndarray) -> bytes:
    """Return scans of channel 1 (counts of 12 bits) and the timestamp (ns)."""
    made = np.zeros(counts.size, np.dtype({
        'names': ['v', 't'], 'formats': ['>i2', '<i8'], 'offsets': [0, 8], 'itemsize': 16}))
    made['v'] = (counts << SHIFT).astype(np.int16) + 5
    made['t'] = stamps
    return made.tobytes()


def volts(counts: np.ndarray) -> np.ndarray:
    """Return the voltages of counts by the kernel's ABI, V."""
    return (counts + OFFSET) * SCALE * 1e-3
