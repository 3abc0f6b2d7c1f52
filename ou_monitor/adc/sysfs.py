"""
Devices of IIO and hwmon in sysfs: found by name, read and written with errors that say what to do.

Limits: Linux only; what may be read and written is decided by the rights on the files.  A voltage
that is asked for (hwmon `inN_input`, or an IIO channel without a buffer, `_raw`) is as old as the
driver's last conversion, which many drivers keep for `update_interval`; asking more often gives
the same number again.
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


# Asked so often where the driver does not say how often it converts, Hz.
USUAL_RATE = 10.0


class PolledChannel:
    """
    One channel ('in1', 'in_voltage0'; empty: the only one) of a hwmon or IIO device.

    `rate` is how often the driver converts, Hz, or 10 where it does not say.
    """

    def __init__(self, folder: Path, channel: str = '') -> None:
        ends = {'_input': 'in[0-9]*_input', '_raw': 'in_voltage*_raw'}
        known = {path.name.removesuffix(end): path for end, pattern in ends.items()
                 for path in sorted(folder.glob(pattern))}
        if channel and channel not in known or not channel and len(known) != 1:
            asked = f"no channel '{channel}'" if channel else f'{len(known)} voltage channels'
            names = ', '.join(known) or 'none'
            raise InputError(f'{folder.name} has {asked}: give channel:= one of {names}')
        self.channel = channel or next(iter(known))
        self._path = known[self.channel]
        self._scale, self._offset = 1.0, 0.0
        if self._path.name.endswith('_raw'):
            self._scale = self._attribute(folder, 'scale', 1.0)
            self._offset = self._attribute(folder, 'offset', 0.0)
        interval = folder / 'update_interval'
        spacing = number(interval) if interval.exists() else 0.0
        self.rate = 1e3 / spacing if spacing > 0.0 else USUAL_RATE
        self.read()

    def _attribute(self, folder: Path, what: str, default: float) -> float:
        for name in (f'{self.channel}_{what}', f'in_voltage_{what}'):
            if (folder / name).exists():
                return number(folder / name)
        return default

    def read(self) -> float:
        """Return the voltage now, V (both kinds count in mV)."""
        return (number(self._path) + self._offset) * self._scale * 1e-3
