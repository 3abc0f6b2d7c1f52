"""
The voltage of a Linux IIO or hwmon device: polled, or in blocks from the kernel's buffer.

Limits: the user needs file permissions; errors say how to get them.  A polled voltage (hwmon
`inN_input`, or IIO `_raw` without a buffer) is as old as the driver's last conversion; polling
faster than `update_interval` repeats readings.  Only one program can read a buffer, and this
module reads only one of its channels.  Without a timestamp channel, a block is stamped when it is
read: later than its last sample, by the scheduler's delay.

The kernel's ABI (Documentation/ABI/testing/sysfs-bus-iio, iio_devbuf): a scan holds its elements
in the order of their indices, each at a multiple of its own size, and is padded to a multiple of
the largest one.  An element's type is `[be|le]:[s|u]bits/storagebits[>>shift]`.  Volts are
(raw + offset) * scale / 1000.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import errno
import math
import os
from pathlib import Path
import re
import select
import time

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray

IIO, HWMON = 'bus/iio/devices', 'class/hwmon'


def read_attribute(path: Path) -> str:
    """Return the content of an attribute, without surrounding white space."""
    try:
        return path.read_text(encoding='ascii', errors='replace').strip()
    except OSError as error:
        raise InputError(f'cannot read {path}: {reason_of(error)}') from error


def number_of(path: Path) -> float:
    """Return the number in an attribute."""
    text = read_attribute(path)
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{path} holds '{text[:40]}', not a number") from error


def write_attribute(path: Path, value: object) -> None:
    """Set an attribute."""
    try:
        # Without O_CREAT, a missing attribute is an error even in a test's ordinary folder.
        handle = os.open(path, os.O_WRONLY | os.O_TRUNC)
        try:
            os.write(handle, f'{value}\n'.encode('ascii', 'replace'))
        finally:
            os.close(handle)
    except OSError as error:
        raise InputError(f"cannot set {path} to '{value}': {reason_of(error)}") from error


def reason_of(error: OSError) -> str:
    """Return the reason for a file error, and the remedy."""
    if error.errno in (errno.EACCES, errno.EPERM):
        return ('not permitted; give the user of this node access by a udev rule or a group '
                '(doc/deploy.md)')
    if error.errno == errno.EBUSY:
        return 'the device is in use by another program'
    return error.strerror or str(error)


def find_device(device: str, sysfs: Path) -> Path:
    """Return a device's folder: by path, folder name ('hwmon2') or driver name ('ads1015')."""
    if not device:
        raise InputError(f'no device given; available: {_names(sysfs)}')
    if '/' in device:
        path = Path(device)
        if not path.is_dir():
            raise InputError(f'no such device: {path} is not a folder; available: {_names(sysfs)}')
        return path
    found = [path for path in _all(sysfs) if device in (path.name, _name(path))]
    if not found:
        raise InputError(f"no such device: '{device}'; available: {_names(sysfs)}")
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


def _names(sysfs: Path) -> str:
    return ', '.join(f'{path.name} ({_name(path)})' for path in _all(sysfs)) or 'none'


def choose_channel(folder: Path, known: Sequence[str], channel: str) -> str:
    """Return the given channel, or the only one."""
    if channel in known:
        return channel
    if not channel and len(known) == 1:
        return known[0]
    wanted = f"no channel '{channel}'" if channel else f'{len(known)} voltage channels'
    names = ', '.join(known) or 'none'
    raise InputError(f'{folder.name} has {wanted}: give channel:= one of {names}')


def find_attribute(folder: Path, channel: str, what: str) -> Path | None:
    """Return the file of an attribute: the channel's, else the one for all channels, else None."""
    return next((folder / name for name in (f'{channel}_{what}', f'in_voltage_{what}', what)
                 if (folder / name).exists()), None)


def channel_number(folder: Path, channel: str, what: str, missing: float) -> float:
    """Return the number in an attribute of a channel, or `missing` if there is no such file."""
    path = find_attribute(folder, channel, what)
    return missing if path is None else number_of(path)


# Polling rate if the driver does not state its own, Hz.
USUAL_RATE = 10.0


class PolledChannel:
    """One channel ('in1', 'in_voltage0'; empty: the only one) of a hwmon or IIO device."""

    def __init__(self, folder: Path, channel: str = '') -> None:
        ends = {'_input': 'in[0-9]*_input', '_raw': 'in_voltage*_raw'}
        known = {path.name.removesuffix(end): path for end, pattern in ends.items()
                 for path in sorted(folder.glob(pattern))}
        self.channel = choose_channel(folder, list(known), channel)
        self._path = known[self.channel]
        self._scale, self._offset = 1.0, 0.0
        if self._path.name.endswith('_raw'):
            self._scale = channel_number(folder, self.channel, 'scale', 1.0)
            self._offset = channel_number(folder, self.channel, 'offset', 0.0)
        interval = folder / 'update_interval'
        spacing = number_of(interval) if interval.exists() else 0.0
        # The driver's conversion rate, Hz.
        self.rate = 1e3 / spacing if spacing > 0.0 else USUAL_RATE
        self.read()

    def read(self) -> float:
        """Return the present voltage, V (hwmon and IIO both report mV)."""
        return (number_of(self._path) + self._offset) * self._scale * 1e-3


_TYPE = re.compile(r'(be|le):([su])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?')


@dataclass(frozen=True)
class Element:
    """One element of a scan."""

    name: str  # 'in_voltage0', 'in_timestamp'
    index: int  # Position in the order of the elements
    order: str  # '<' or '>'
    signed: bool  # Whether two's complement
    # Valid bits, bits in memory, and bits below the valid ones.
    bits: int
    storage: int
    shift: int


def parse_element(name: str, index: int, kind: str) -> Element:
    """Return an element, given the contents of its files `_index` and `_type` (kind)."""
    match = _TYPE.fullmatch(kind)
    if match is None:
        raise InputError(f"{name}_type is '{kind[:40]}', not of the form le:s12/16>>4")
    order, sign, bits, storage, repeat, shift = match.groups(default='0')
    found = Element(name, index, '<' if order == 'le' else '>', sign == 's', int(bits),
                    int(storage), int(shift))
    if found.storage not in (8, 16, 32, 64) or int(repeat) > 1:
        raise InputError(f"{name}_type is '{kind}': only 8, 16, 32 or 64 bits of storage, without "
                         'repetition, can be read')
    if not 0 < found.bits <= found.storage - found.shift:
        raise InputError(f"{name}_type is '{kind}': {found.bits} bits do not fit")
    return found


class Scan:
    """Layout of a buffer's scans with the enabled elements; `size` in bytes."""

    def __init__(self, elements: Sequence[Element]) -> None:
        self._elements = {element.name: element for element in elements}
        # On 64-bit machines NumPy aligns as the kernel does, each element to its own size.
        self._dtype = np.dtype([
            (element.name, f'{element.order}u{element.storage // 8}')
            for element in sorted(elements, key=lambda element: element.index)], align=True)
        self.size = self._dtype.itemsize

    def integers(self, data: bytes, name: str) -> npt.NDArray[np.int64]:
        """Return the integers of one element, one for each scan."""
        element = self._elements[name]
        stored = np.frombuffer(data, self._dtype)[name].astype(np.uint64)
        unused = np.uint64(64 - element.bits)
        # Shifting to the top and back extends the sign, or masks the bits above.
        top = (stored >> np.uint64(element.shift)) << unused
        if element.signed:
            return top.view(np.int64) >> np.int64(unused)
        return (top >> unused).astype(np.int64)

    def volts(self, data: bytes, name: str, scale: float, offset: float) -> FloatArray:
        """Return one element of each scan, V (scale in mV, as the kernel gives it)."""
        return (self.integers(data, name).astype(np.float64) + offset) * (1e-3 * scale)


STAMP = 'in_timestamp'
# Multiple of the typical interval above which an interval means that a full buffer lost samples.
HOLE = 1.5
# Number of newest intervals whose median is the typical interval.
INTERVALS = 64
# Size of the kernel's buffer, blocks: the longest delay in reading that loses no samples.
BLOCKS = 64
# Maximum wait for samples, s; also the maximum delay at shutdown.
NAP = 0.1


@dataclass(frozen=True, eq=False)
class Block:
    """Evenly spaced samples."""

    stamp: float  # Time of the last sample, s since 1970
    volts: FloatArray  # Voltages, V; shape (n,)
    interval: float  # Spacing by the kernel's stamps, s; NaN without stamps


class IioBuffer:
    """The buffer of one IIO device: its folder in sysfs, and its character device."""

    # block: samples per block (0: 10 ms of samples); rate, Hz, and trigger: 0 or empty keeps the
    # device's own setting.

    def __init__(self, folder: Path, character: Path, channel: str = '', block: int = 0,
                 rate: float = 0.0, trigger: str = '') -> None:
        self._folder, self._character = folder, character
        if not (folder / 'scan_elements').is_dir() or not (folder / 'buffer').is_dir():
            raise InputError(f'{folder.name} has no buffer (no scan_elements): it can only be '
                             'polled, give polled:=true')
        self.channel = choose_channel(folder, sorted(
            path.name.removesuffix('_en')
            for path in (folder / 'scan_elements').glob('in_voltage*_en')), channel)
        self.holes = 0
        # Newest stamp of the kernel, and newest intervals, ns.
        self._newest: int | None = None
        self._intervals: deque[int] = deque(maxlen=INTERVALS)
        write_attribute(folder / 'buffer/enable', 0)
        if trigger:
            write_attribute(folder / 'trigger/current_trigger', trigger)
        if rate > 0.0:
            own = find_attribute(folder, self.channel, 'sampling_frequency')
            write_attribute(own or folder / 'in_voltage_sampling_frequency', f'{rate:g}')
        self.rate = channel_number(folder, self.channel, 'sampling_frequency', math.nan)
        self.block = block or (max(round(0.01 * self.rate), 1) if self.rate > 0.0 else 1)
        if find_attribute(folder, self.channel, 'scale') is None:
            raise InputError(f'{folder.name} does not state the scale of {self.channel} '
                             f'(no {self.channel}_scale)')
        self._scale = channel_number(folder, self.channel, 'scale', math.nan)
        self._offset = channel_number(folder, self.channel, 'offset', 0.0)
        elements = self._enable()
        self._scan = Scan(elements)
        self._stamped = any(element.name == STAMP for element in elements)
        clock = folder / 'current_timestamp_clock'
        if clock.exists() and read_attribute(clock) != 'realtime':
            write_attribute(clock, 'realtime')
        write_attribute(folder / 'buffer/length', self.block * BLOCKS)
        if (folder / 'buffer/watermark').exists():
            write_attribute(folder / 'buffer/watermark', self.block)
        self._handle = self._open()

    def _enable(self) -> list[Element]:
        """Enable only the channel and the timestamp; return the elements."""
        scan = self._folder / 'scan_elements'
        wanted = []
        for path in sorted(scan.glob('*_en')):
            name = path.name.removesuffix('_en')
            chosen = name in (self.channel, STAMP)
            write_attribute(path, int(chosen))
            if chosen:
                wanted.append(parse_element(name, int(number_of(scan / f'{name}_index')),
                                            read_attribute(scan / f'{name}_type')))
        return wanted

    def _open(self) -> int:
        try:
            handle = os.open(self._character, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise InputError(f'cannot open {self._character}: {reason_of(error)}') from error
        try:
            write_attribute(self._folder / 'buffer/enable', 1)
        except InputError:
            os.close(handle)
            raise
        return handle

    def blocks(self) -> Iterator[Block | None]:
        """Yield blocks as they arrive; None after a tenth of a second without one."""
        kept = b''
        whole = self.block * self._scan.size
        poll = select.poll()
        poll.register(self._handle, select.POLLIN)
        while True:
            if not poll.poll(1e3 * NAP):
                # An incomplete block: the device is slower than its stated rate.
                ready = len(kept) // self._scan.size * self._scan.size
                if ready:
                    yield from self._decode(kept[:ready])
                    kept = kept[ready:]
                yield None
                continue
            try:
                data = os.read(self._handle, whole - len(kept))
            except BlockingIOError:
                continue
            except OSError as error:
                raise InputError(f'cannot read {self._character}: {reason_of(error)}') from error
            if not data:
                # The device was removed, or the writer has closed its end.
                time.sleep(NAP)
                yield None
                continue
            kept += data
            if len(kept) >= whole:
                yield from self._decode(kept)
                kept = b''

    def _decode(self, data: bytes) -> Iterator[Block]:
        now = time.time()
        volts = self._scan.volts(data, self.channel, self._scale, self._offset)
        if not self._stamped:
            yield Block(now, volts, math.nan)
            return
        # Integers: nanoseconds since 1970 exceed the precision of a float.
        stamps = self._scan.integers(data, STAMP)
        # There is no step before the very first sample.
        before = int(stamps[0]) if self._newest is None else self._newest
        steps = np.diff(stamps, prepend=before)
        self._intervals += steps[1 if self._newest is None else 0:].tolist()
        self._newest = int(stamps[-1])
        typical = float(np.median(self._intervals)) if self._intervals else math.nan
        holes = np.flatnonzero(steps > HOLE * typical)
        self.holes += holes.size
        # A hole before the first sample does not split the block.
        cuts = holes[holes > 0].tolist()
        for first, last in zip([0, *cuts], [*cuts, volts.size], strict=True):
            yield Block(float(stamps[last - 1]) * 1e-9, volts[first:last], 1e-9 * typical)

    def close(self) -> None:
        """Stop the buffer."""
        os.close(self._handle)
        write_attribute(self._folder / 'buffer/enable', 0)
