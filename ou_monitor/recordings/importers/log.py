"""
Result of an importer: a `Log` with candidate `Series` and motion, each with its origin.

Limits: the wanted fields of a log are read into memory at once.  Stamps are seconds from the
start of the log, or of the flight in it; only the date of the start is kept, as the fact
``started``.  Importers do not depend on the bag format.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass, field, replace
from datetime import datetime, timezone
import io
import logging
import math
import os
from pathlib import Path
import sys

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import clock_unit, Defect, defect_of, FloatArray, Note
from ou_monitor.text import counted, printable
from ou_monitor.timeline import in_order, Picked

# Front, right, down -> front, left, up; in words.
FRD_TO_FLU = np.array([1.0, -1.0, -1.0])
TURNED = 'front, right, down turned to front, left, up'
DEGREE = math.pi / 180.0
GRAVITY = 9.80665  # m/s^2, the scale of accelerometers
RPM = 2.0 * math.pi / 60.0


VOLTAGE, THROTTLE, CURRENT = 'voltage', 'throttle', 'current'
# A column of unknown kind.
ANY = 'any'
# Any other series, such as a gyro axis: used only if the user names it.
SIGNAL = 'signal'
# A gyro with its accelerometer, along the axes of `base_link`, the acceleration as specific force
# (gravity included); the speeds of all motors.
IMU, SPEEDS = 'imu', 'motor_speed'
UNITS = {VOLTAGE: 'V', THROTTLE: '0..1', CURRENT: 'A', IMU: 'rad/s, m/s^2', SPEEDS: 'rad/s'}
UNKNOWN = '?'

# Maximum magnitude of a value; larger ones come from corrupt bytes.
LARGEST = 1e9
# A group of fewer than _FEW stamps that is more than _FAR from all others comes from corrupt
# bytes.
_FAR = 3600.0  # s
_FEW = 16
Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Series:
    """One quantity over time, in SI units."""

    # Name for the user, unique in the log: ``BAT[0].Volt``; for SPEEDS, the names of the motors.
    name: str
    quantity: str  # VOLTAGE, THROTTLE, CURRENT, SIGNAL, ANY, IMU or SPEEDS
    t: FloatArray  # Stamps, s from the start of the log; shape (n,)
    # V, 0..1, or A (positive when the battery is drained); NaN where the log says "unknown"; shape
    # (n,). For IMU (n, 3), or (n, 6) with accelerometer; for SPEEDS (n, motors).
    values: FloatArray
    scale: str  # Conversion from the logged value
    words: str = ''  # Description
    rank: int | None = None  # The smallest is the default; None: used only if the user names it
    group: str = ''  # The sensor; a voltage and a current of one sensor share it
    own_unit: str = UNKNOWN  # Unit of a signal, ``?`` when the log does not state it

    @property
    def unit(self) -> str:
        """Return the unit of the values, ``?`` when unknown."""
        return UNITS.get(self.quantity, self.own_unit)

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return int(self.t.size)

    @property
    def rate(self) -> float:
        """Return the mean rate of the samples, Hz; NaN when unknown."""
        span = float(self.t[-1] - self.t[0]) if self.n > 1 else 0.0
        return (self.n - 1) / span if span > 0.0 else math.nan

    @property
    def repeats(self) -> float:
        """Return the share of increments that are exactly zero; NaN when unknown."""
        if self.n < 2:
            return math.nan
        return float((self.values[1:] == self.values[:-1]).mean())

    @property
    def silent(self) -> bool:
        """Whether all values are zero or "unknown"."""
        return not bool((np.isfinite(self.values) & (self.values != 0.0)).any())


@dataclass(frozen=True, eq=False)
class Log:
    """The content of a log file."""

    # Name of the format.
    format: str  # noqa: A003
    # Candidates; gyros with accelerometers, and the speeds of the motors.
    series: tuple[Series, ...]
    # Vehicle, firmware, number of the flight, as far as known.
    facts: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()  # Dropped or unreadable parts, one sentence each
    names: tuple[str, ...] = ()  # Names of all series of the file, unread ones included

    def of(self, *quantities: str) -> list[Series]:
        """Return the series of some quantities."""
        return [one for one in self.series if one.quantity in quantities]

    @property
    def scalars(self) -> list[Series]:
        """Return the series of one number over time."""
        return [one for one in self.series if one.values.ndim == 1]


def unusable_words(name: str, notes: Iterable[str]) -> str:
    """Return the text of the error for a file without usable samples, with what was dropped."""
    why = ' '.join(note for note in notes if defect_of(note).drops)
    return f'{name} holds no usable sample' + (f': {why}' if why else '')


@dataclass(frozen=True)
class CsvColumns:
    """
    How to read a CSV; None: detected.

    Examples
    --------
    >>> from ou_monitor import CsvColumns
    >>> CsvColumns(voltage='Vbat', unit='mV', sample_interval=0.01).unit
    'mV'

    """

    # Names of columns; 'none' leaves the throttle or the current out.
    time: str | None = None
    voltage: str | None = None
    throttle: str | None = None
    # Units: V, dV, cV, mV or uV; s, ms, us or ns; 1, %, us or the ends LOW:HIGH.
    unit: str | None = None
    time_unit: str | None = None
    throttle_unit: str | None = None
    current: str | None = None  # Name of a column, or 'none'
    # What separates cells: a character, 'tab' or 'space'; the decimal mark: '.' or ','.
    delimiter: str | None = None
    decimal: str | None = None
    skip_rows: int | None = None  # Lines above the header
    sample_interval: float | None = None  # Time from row to row, s, in place of a column of time


@dataclass(frozen=True)
class Request:
    """The request to an importer."""

    flight: int | None = None  # Flight of a file with several
    # Series named by the user, for formats that read only wanted ones.
    names: frozenset[str] = frozenset()
    # Magnets of a motor's rotor, if the log does not state them; needed for eRPM.
    poles: int | None = None
    everything: bool = False  # Whether all candidates are wanted (``--list``)
    progress: Progress | None = None  # Called with the share done, 0..1
    columns: CsvColumns | None = None  # How a CSV is to be read


def sound(t: FloatArray, rows: FloatArray) -> tuple[Picked, list[str]]:
    """Select samples as `in_order` does, but leave out stamps from corrupt bytes."""
    notes: list[str] = []
    places = np.flatnonzero(np.isfinite(t) & np.isfinite(rows).all(axis=1))
    if places.size < t.size:
        notes.append(Note(f'{counted(t.size - places.size)} dropped: not a finite number.',
                          Defect.NON_FINITE))
    for good_of, why in ((near, f'the stamp is over {_FAR:g} s away from all others'),
                         (rising, 'the stamp goes back')):
        good = good_of(t[places])
        if not good.all():
            notes.append(Note(f'{counted(int((~good).sum()))} dropped: {why}.', Defect.DROPPED))
            places = places[good]
    which, said = in_order(t[places], rows[places], LARGEST)
    return places[which], notes + said


def clean(series: Series) -> tuple[Series, tuple[str, ...]]:
    """Return a series with finite values and rising stamps, and notes on changes."""
    which, notes = sound(series.t, series.values.reshape(series.n, -1))
    values = series.values[which]
    if series.quantity == THROTTLE:
        outside = int(((values < -0.01) | (values > 1.01)).sum())
        if outside:
            notes.append(f'{counted(outside, "value")} outside 0..1 set to 0 or 1.')
        values = np.clip(values, 0.0, 1.0)
    return replace(series, t=series.t[which], values=values), tuple(notes)


def near(t: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which stamps are in a large group with no pause of an hour; all if none is large."""
    order = np.argsort(t, kind='stable')
    good = np.ones(t.size, dtype=bool)
    pauses = np.flatnonzero(np.diff(t[order]) > _FAR) + 1
    parts = np.split(order, pauses)
    if max(part.size for part in parts) < _FEW:
        # A log with a sample every few hours has no large group to compare with.
        return good
    for part in parts:
        good[part] = part.size >= _FEW
    return good


def rising(t: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which stamps form a longest subsequence that does not go back."""
    good = np.ones(t.size, dtype=bool)
    if (t[1:] >= t[:-1]).all():
        return good
    # For each length, the place where such a sequence ends with the least stamp.
    stamps, places, before = t.tolist(), list[int](), list[int]()
    for k, stamp in enumerate(stamps):
        length = bisect_right(places, stamp, key=stamps.__getitem__)
        before.append(places[length - 1] if length else -1)
        places[length:length + 1] = [k]
    good[:] = False
    at = places[-1]
    while at >= 0:
        good[at] = True
        at = before[at]
    return good


def log_of(form: str, series: Sequence[Series], facts: dict[str, str], notes: Iterable[str],
           names: Iterable[str], start: float = math.inf) -> Log:
    """Return a log, its stamps counted from the first of its series, or `start` (s) if earlier."""
    # Corrupt bytes may give an early stamp: it counts only if others are near it.
    start = min([start, *(float(one.t[near(one.t)].min()) for one in series if one.t.size)])
    return Log(form, tuple(
        replace(one, t=one.t - start) if math.isfinite(start) else one for one in series),
        facts, tuple(notes), tuple(dict.fromkeys(names)))


def gyro_of(name: str, t: FloatArray, rates: FloatArray | None, forces: FloatArray | None,
            scale: str, words: str, rank: int | None = None) -> Iterator[Series]:
    """Yield a gyro with its accelerometer (None: there is none)."""
    if rates is not None:
        values = rates if forces is None else np.hstack([rates, forces])
        yield Series(name, IMU, t, values, scale, words, rank)


def speeds_of(t: FloatArray, rpm: Sequence[FloatArray], factor: float, scale: str, words: str,
              numbers: Iterable[object]) -> Iterator[Series]:
    """Yield the speeds of motors by their numbers (factor to rad/s)."""
    yield Series(', '.join(f'motor_{number}' for number in numbers), SPEEDS, t,
                 np.column_stack(rpm) * factor, f'{scale} {factor:.6g}', words)


def started(unix: float) -> dict[str, str]:
    """Return the fact `started` for a Unix time, s; empty if it is not a date."""
    return {'started': datetime.fromtimestamp(unix, timezone.utc).isoformat(
        timespec='seconds')} if clock_unit(unix) == 's' else {}


def three_axes(columns: Mapping[str, FloatArray], names: Sequence[str],
               factor: FloatArray | float) -> FloatArray | None:
    """Return columns times a factor side by side, shape (n, 3); None if any is missing."""
    if not names or not all(name in columns for name in names):
        return None
    return np.column_stack([columns[name] for name in names]) * factor


@contextmanager
def quiet(path: Path, parser: str) -> Iterator[io.StringIO]:
    """Catch what a parser prints, and turn any failure of it into an `InputError`."""
    said = io.StringIO()
    logger = logging.getLogger(parser)
    before, logger.propagate = logger.propagate, False
    handler = logging.NullHandler()
    logger.addHandler(handler)
    try:
        with redirect_stdout(said), redirect_stderr(said):
            yield said
    except InputError:
        raise
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except Exception as error:
        raise InputError(f'{path} is damaged: it cannot be read with {parser} '
                         f'({type(error).__name__}: {printable(error, 200)})') from error
    finally:
        logger.removeHandler(handler)
        logger.propagate = before


@contextmanager
def quiet_process() -> Iterator[None]:
    """Discard standard error by its file descriptor, to which parsers in C write directly."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
