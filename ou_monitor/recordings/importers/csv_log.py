"""
CSV: any column can be the voltage, the throttle or the current.

Limits first: the stamps are the column `time_s`, as they stand; values are
taken as V, 0..1 and A.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.csv_table import column_names, read_columns, THROTTLE, TIME, VOLTAGE
from ou_monitor.recordings.importers import log as logs
from ou_monitor.recordings.importers.log import ANY, Log, one_flight, Request, Series

# Column -> what it is, when nothing is said.
KNOWN = {VOLTAGE: logs.VOLTAGE, THROTTLE: logs.THROTTLE, 'current_a': logs.CURRENT}

# Columns that are looked at for a list of all; autopilots write up to some hundred.
MOST_COLUMNS = 300


def read(path: Path, request: Request) -> Log:
    """Read the columns that are known by name, and those asked for."""
    one_flight(path, request)
    header = [name for name in column_names(path, TIME) if name and name != TIME]
    wanted = [name for name in dict.fromkeys(header) if name in KNOWN or name in request.names]
    columns = read_columns(path, [TIME, *wanted])
    t = columns[0]
    if not t.size:
        raise InputError(f'{path} holds a header and no line below it')
    series = [Series(name, KNOWN.get(name, ANY), t, values, '1', 'column',
                     0 if name in KNOWN else None)
              for name, values in zip(wanted, columns[1:])]
    notes = []
    late = int(np.count_nonzero(np.diff(t) < 0.0))
    if late:
        notes.append(f'{late} line{"s" * (late != 1)} came before the stamp ahead of them: '
                     'sorted by stamp.')
        order = np.argsort(t, kind='stable')
        series = [replace(one, t=t[order], values=one.values[order]) for one in series]
    if request.everything:
        others = [name for name in dict.fromkeys(header) if name not in wanted]
        if len(others) > MOST_COLUMNS:
            notes.append(f'{len(others) - MOST_COLUMNS} more columns are not listed.')
        # The file is read once for each, as a column of text ends its reading.
        for name in others[:MOST_COLUMNS]:
            try:
                values = read_columns(path, [TIME, name])[1]
            except InputError:
                notes.append(f"Column '{name}' does not hold numbers.")
                continue
            series.append(Series(name, ANY, t, values, '1', 'column'))
    return Log('csv', tuple(series), {}, tuple(notes), names=tuple(header))
