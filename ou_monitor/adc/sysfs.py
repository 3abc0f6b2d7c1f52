"""
Devices of IIO and hwmon in sysfs: found by name, read and written with errors that say what to do.

Limits: Linux only; what may be read and written is decided by the rights on the files.
"""

from __future__ import annotations

import errno
import os
from pathlib import Path

from ou_monitor.errors import InputError

IIO, HWMON = 'bus/iio/devices', 'class/hwmon'


def read(path: Path) -> str:
    """Return the content of an attribute, without blanks around it."""
    try:
        return path.read_text(encoding='ascii', errors='replace').strip()
    except OSError as error:
        raise InputError(f'cannot read {path}: {why(error)}') from error


def number(path: Path) -> float:
    """Return the number in an attribute."""
    text = read(path)
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{path} holds '{text[:40]}', not a number") from error


def write(path: Path, value: object) -> None:
    """Set an attribute."""
    try:
        # Not created where it is missing: sysfs would refuse, and a plain folder would not.
        handle = os.open(path, os.O_WRONLY | os.O_TRUNC)
        try:
            os.write(handle, f'{value}\n'.encode('ascii', 'replace'))
        finally:
            os.close(handle)
    except OSError as error:
        raise InputError(f"cannot set {path} to '{value}': {why(error)}") from error


def why(error: OSError) -> str:
    """Return what went wrong with a file, and what to do, in words."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return ('not permitted; give the user of this node the right by a udev rule or a group '
                '(doc/deploy.md)')
    if error.errno == errno.EBUSY:
        return 'the device is in use by another program'
    return error.strerror or str(error)


def find_device(device: str, sysfs: Path) -> Path:
    """
    Return the folder of a device.

    device: a path, or under `sysfs` the name of a folder ('iio:device0', 'hwmon2') or what the
    driver calls it ('ads1015').
    """
    if not device:
        raise InputError(f'device is not given; there are: {_known(sysfs)}')
    if '/' in device:
        path = Path(device)
        if not path.is_dir():
            raise InputError(f'no such device: {path} is no folder; there are: {_known(sysfs)}')
        return path
    found = [path for path in _all(sysfs) if device in (path.name, _name(path))]
    if not found:
        raise InputError(f"no such device: '{device}'; there are: {_known(sysfs)}")
    if len(found) > 1:
        raise InputError(f"several devices are called '{device}': give one of "
                         f"{', '.join(path.name for path in found)}")
    return found[0]


def _all(sysfs: Path) -> list[Path]:
    return [path for folder, pattern in ((IIO, 'iio:device*'), (HWMON, 'hwmon*'))
            for path in sorted((sysfs / folder).glob(pattern))]


def _name(path: Path) -> str:
    try:
        return (path / 'name').read_text(encoding='ascii', errors='replace').strip()
    except OSError:
        return ''


def _known(sysfs: Path) -> str:
    return ', '.join(f'{path.name} ({_name(path)})' for path in _all(sysfs)) or 'none'
