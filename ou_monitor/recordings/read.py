"""
Read any recording (bag, CSV or autopilot log) as a `Recording`, and any scalar beside it.

Limits: stamps of a bag are float64 seconds of its own clock, with a resolution of 0.24 us for a
clock from 1970.  A signal has the stamps of its messages' headers or, without headers, log times
of the bag; if the voltage has the other kind, the signal is shifted by the transmission delay.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import math
from pathlib import Path
from typing import Any

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import (
    choose as choose_series, columns_of, NONE, signal_of)
from ou_monitor.recordings.importers.csv_table import read_column, read_csv
from ou_monitor.recordings.importers.formats import BAG, CSV, import_log, kind_of
from ou_monitor.recordings.importers.log import (
    CsvColumns, Log, Request, Series, SIGNAL, unusable_words)
from ou_monitor.records import clock_unit, Recording
from ou_monitor.text import outside_words, part_words
from ou_monitor.timeline import (
    check_stamps, check_throttle, in_order, MOST_CURRENT, MOST_THROTTLE, MOST_VOLTAGE, part_of,
    plausible, readings_of)

# Spacing, s, above which another unit of time is more likely than a slow logger.
_SPARSE = 5.0


def read_recording(
    path: str | Path, *, msg_config: str | Path | None = None, voltage_topic: str | None = None,
    throttle_topic: str | None = None, partial: bool = False, start: float | None = None,
    end: float | None = None, flight: int | None = None, columns: CsvColumns | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """
    Read a recording of a supply.

    Parameters
    ----------
    path : str or path
        An .mcap file, a rosbag2 directory, a CSV, or an autopilot log (with its extra installed).
    msg_config : str or path, optional
        Name of a msg config, or a YAML file; needed if several fit the bag.
    voltage_topic, throttle_topic : str, optional
        Topics other than the config's.
    partial : bool
        Whether to read the intact part of a damaged bag, or a CSV without its bad lines, with a
        note.
    start, end : float, optional
        Part to read, s after the first message of the bag (by log time) or the first sample of the
        CSV or log: start <= t < end. The last throttle before the part is held into it.
    flight : int, optional
        Flight of a log with several, from 1; default: the largest.
    columns : CsvColumns, optional
        Names and units of the columns of a CSV; names of the series of a log.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Recording
        Stamps (s), voltage (V), throttle (0..1) and, if there is one, current (A), each of shape
        (n,), n >= 1; `notes` say what was dropped or repaired.

    Raises
    ------
    InputError
        When the file cannot be read, several topics fit, or no sample is left.

    Examples
    --------
    >>> from ou_monitor import read_recording
    >>> recording = read_recording('bags/flight', start=10.0, end=20.0)
    >>> recording.n, round(float(recording.t[-1] - recording.t[0]))
    (10000, 10)

    """
    return readings_of(_read(
        Path(path), msg_config=msg_config, voltage_topic=voltage_topic,
        throttle_topic=throttle_topic, partial=partial, start=start, end=end, flight=flight,
        columns=columns, progress=progress)[0])


def _read(
    path: Path, signal: str | None = None, *, partial: bool = False,
    start: float | None = None, end: float | None = None, flight: int | None = None,
    columns: CsvColumns | None = None, progress: Callable[[float], None] | None = None,
    **of_bags: Any,
) -> tuple[Recording, Log | None]:
    """Read a recording with its repeats; for a log, also return the `Log` with `signal`."""
    _check_part(start, end)
    kind = kind_of(path)
    csv, log = kind == CSV, kind not in (CSV, BAG)
    for option, value in of_bags.items():
        if (csv or log) and value is not None:
            raise InputError(f"{path} is a {'CSV' if csv else 'log'}: "
                             f"--{option.replace('_', '-')} is for bags")
    if csv:
        if flight is not None:
            raise InputError(f'{path} is a CSV: --flight is for logs')
        return _part(tidy(read_csv(path, columns, partial=partial)), start, end), None
    if log:
        recording, whole = _read_log(path, signal, columns, flight, progress)
        return _part(recording, start, end), whole
    if flight is not None or columns is not None:
        raise InputError(f'{path} is a bag: --flight is for logs, names and units of columns are '
                         'for logs and CSVs')
    # Imported here, because a CSV or a log needs none of the modules that read bags.
    from ou_monitor.recordings.bag_samples import read_bag

    return tidy(read_bag(path, partial=partial, start=start, end=end, progress=progress,
                         **of_bags)), None


def _read_log(path: Path, signal: str | None, columns: CsvColumns | None, flight: int | None,
              progress: Callable[[float], None] | None) -> tuple[Recording, Log]:
    """Read the supply of a log; return also the log, which includes `signal`."""
    named = columns or CsvColumns()
    if named != CsvColumns(voltage=named.voltage, throttle=named.throttle,
                           current=named.current):
        raise InputError(f'{path} is a log: its time and units are known')
    wanted = (name for name in (named.voltage, named.throttle, named.current, signal)
              if name is not None)
    log = import_log(path, Request(flight, frozenset(wanted), progress=progress))
    chosen = choose_series(path, log, voltage=named.voltage, throttle=named.throttle,
                           current=named.current, option='--{}-column')
    whole = tidy(columns_of(path, log, chosen))
    if chosen.throttle is None and named.throttle != NONE:
        whole = replace(whole, notes=(*whole.notes, 'The throttle is unknown: the log holds '
                                                    'none (--throttle-column NAME).'))
    return whole, log


def tidy(raw: Recording) -> Recording:
    """Return a `Recording` in order, each stamp once, with notes on dropped samples."""
    check_throttle(raw.name, raw.throttle, raw.voltage)
    which, said = in_order(raw.t, raw.voltage[:, None], MOST_VOLTAGE, ' V')
    found = part_of(raw, which, *said)
    if not found.n:
        raise InputError(unusable_words(raw.name, found.notes))
    if said:
        check_stamps(raw.name, raw.t, raw.voltage)
    t, notes, current = found.t, found.notes, found.current
    # The unit is certain if the stamps are dates or the source states it.
    stated = clock_unit(t[0]) or 'time_unit' in raw.source
    # Cheap test first: with this median spacing, the mean is at least half of it.
    if (t.size > 2 and t[-1] - t[0] >= 0.5 * _SPARSE * (t.size - 1) - 1.0 and not stated
            and (spacing := float(np.median(np.diff(t)))) >= _SPARSE):
        notes = (*notes, f'The samples are {spacing:.4g} s apart: is the time in ms, us or ns? '
                         'Give --time-unit for a CSV.')
    if current is not None:
        current = plausible(current, MOST_CURRENT)
    return replace(found, throttle=plausible(found.throttle, MOST_THROTTLE), notes=notes,
                   current=None if current is None or np.isnan(current).all() else current)


def _check_part(start: float | None, end: float | None) -> None:
    for name, value in (('start', start), ('end', end)):
        if value is not None and not (math.isfinite(value) and value >= 0.0):
            raise InputError(f'the {name} of the part to read must be 0 s or later, got {value} s')
    if end is not None and end <= (start or 0.0):
        raise InputError(f'the part to read ends at {end:g} s, not after its start at '
                         f'{start or 0.0:g} s')


def _part(recording: Recording, start: float | None, end: float | None) -> Recording:
    """Return the samples in a part, s after the first one."""
    if start is None and end is None:
        return recording
    t = recording.t - recording.t[0]
    part = (t >= (start or 0.0)) & (t < (math.inf if end is None else end))
    if not part.any():
        raise InputError(outside_words(recording.name, start, end, float(t[-1])))
    return part_of(recording, part, part_words(start, end))


def read_beside(path: str | Path, signal: str, *, partial: bool = False,
                columns: CsvColumns | None = None, **options: Any) -> tuple[Recording, Series]:
    """Read as `read_recording`, but keep repeats, and read a scalar over the whole file."""
    path = Path(path)
    recording, log = _read(path, signal, partial=partial, columns=columns, **options)
    if log is None:
        return recording, read_signal(path, signal, partial=partial, columns=columns)
    series, said = signal_of(path, log, signal)
    return replace(recording, notes=(*recording.notes, *said)), series


def read_signal(path: str | Path, signal: str, *, partial: bool = False,
                columns: CsvColumns | None = None) -> Series:
    """Read one scalar over time; `columns` names the time column of a CSV."""
    path = Path(path)
    if not signal:
        raise InputError('the name of the signal is empty: TOPIC/FIELD or a column')
    if kind_of(path) == CSV:
        return Series(signal, SIGNAL, *read_column(path, signal, columns), '1')
    from ou_monitor.recordings.bag_samples import read_bag_signal

    return read_bag_signal(path, signal, partial)
