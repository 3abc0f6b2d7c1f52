"""The fleet table: columns, rows, Parquet file; the only module that imports pyarrow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
import io
import json
import math
from pathlib import Path
from typing import Any

from ou_monitor.fleet.find import FoundRecording
from ou_monitor.fleet.vehicles import Vehicle
from ou_monitor.stream.files import open_regular, write_whole
from ou_monitor.text import printable

Row = dict[str, Any]


@dataclass(frozen=True)
class Column:
    """One column."""

    name: str
    # ``text``, ``texts`` (a list), ``json``, ``number`` (unknown: null), ``count`` or
    # ``time`` (UTC).
    kind: str
    unit: str  # SI unit; empty if none
    meaning: str  # One line


_LOG = 'standard error of its logarithm'

COLUMNS = (
    Column('vehicle', 'text', '', 'vehicle; null if unknown'),
    Column('vehicle_from', 'text', '', 'origin of that name: metadata, pattern, folder'),
    Column('flight', 'count', '', 'number of the flight of this vehicle, from 1'),
    Column('start', 'time', '', 'time of the first sample; null if unknown'),
    Column('start_from', 'text', '', 'origin of that time: stamps, log (its header or GPS), name '
           '(of the file)'),
    Column('recording', 'text', '', 'name of the recording'),
    Column('path', 'text', '', 'file or folder'),
    Column('level', 'text', '', "load level, such as '40 %', or 'all' for the whole recording"),
    Column('throttle', 'number', '1', 'throttle of the level, 0..1'),
    Column('time_s', 'number', 's', 'time spent at the level'),
    Column('n', 'count', '', 'samples at the level'),
    Column('mean', 'number', 'V', 'mean voltage at the level'),
    Column('vpp', 'number', 'V', 'peak to peak of the deviation from the mean'),
    Column('vrms', 'number', 'V', 'rms of the deviation from the mean'),
    Column('alpha', 'number', '1/s', 'relaxation rate'),
    Column('alpha_se', 'number', '1', _LOG),
    Column('sigma', 'number', 'V/sqrt(s)', 'noise intensity'),
    Column('sigma_se', 'number', '1', _LOG),
    Column('var_inf', 'number', 'V^2', 'stationary variance'),
    Column('var_inf_se', 'number', '1', _LOG),
    Column('u0', 'number', 'V', 'mean level of the fit'),
    Column('u0_se', 'number', 'V', 'standard error of u0'),
    Column('noise_std', 'number', 'V', 'rms of the white noise of the sensor'),
    Column('excess_kurtosis', 'number', '1', 'excess kurtosis of the innovations; 0 for a '
           'Gaussian'),
    Column('impulses', 'count', '', 'number of innovations larger than normal noise would give'),
    Column('line_hz', 'number', 'Hz', 'frequency of the strongest spectral line; null: none '
           'found'),
    Column('line_rms', 'number', 'V', 'rms of that line'),
    Column('process', 'text', '', 'type of process'),
    Column('risk', 'number', '1', 'probability of a brown-out within the horizon at this level; '
           'needs --brownout-voltage or --cells'),
    Column('status', 'text', '', 'result of the fit: OK, SHORT_WINDOW, or why it failed'),
    Column('flags', 'texts', '', 'cautions about the input'),
    Column('duration_s', 'number', 's', 'length of the recording'),
    Column('samples', 'count', '', 'number of samples in the recording'),
    Column('rate_hz', 'number', 'Hz', 'mean rate of the recording'),
    Column('lowest', 'number', 'V', 'lowest voltage of the recording'),
    Column('lowest_at', 'number', 's', 'time of the lowest voltage, from the first sample'),
    Column('lowest_throttle', 'number', '1', 'throttle at that time, 0..1'),
    Column('dips', 'count', '', 'number of dips below the limit; a dip ends when a reading is '
           'clearly above it; needs --brownout-voltage or --cells'),
    Column('below_s', 'number', 's', 'time below the limit; needs --brownout-voltage or --cells'),
    Column('sag_throttle', 'number', '1', 'highest throttle flown, to a tenth; null where the sag '
           'is unknown'),
    Column('sag', 'number', 'V', 'sag at that throttle, positive, as in analyze'),
    Column('sag_se', 'number', 'V', 'standard error of sag'),
    Column('sag_full', 'number', 'V', 'sag extrapolated to full throttle; recordings are compared '
           'by it'),
    Column('sag_full_se', 'number', 'V', 'standard error of sag_full'),
    Column('cells', 'count', '', "cells in series; if guessed, by the voltages of the vehicle's "
           'flights; null if several numbers are possible'),
    Column('cells_from', 'text', '', 'origin of the cells: given, log, guessed (by the voltage), '
           'unknown'),
    Column('resistance', 'number', 'Ohm', 'resistance of the whole pack after a second, as in '
           'analyze; null without a current that moves the voltage'),
    Column('resistance_se', 'number', 'Ohm', 'standard error of resistance'),
    Column('supply', 'json', '', 'the supply facts that all commands share, as JSON'),
    Column('alpha_p', 'number', '1', 'p-value of the test that alpha is the same at all levels'),
    Column('quality', 'texts', '', 'defects of the recording, worst first'),
    Column('risk_max', 'number', '1', 'highest risk that the node would have published during '
           'the recording; needs --brownout-voltage or --cells'),
    Column('verdict', 'text', '', 'verdict of discover; null without --discover'),
    Column('causes', 'texts', '', 'causes that discover names; null without --discover'),
    Column('gain', 'number', 'nat', 'gain of the extended model, per held-out sample'),
    Column('gain_se', 'number', 'nat', 'standard error of gain'),
    Column('notes', 'texts', '', 'samples that were dropped or repaired, and other notes'),
    Column('duplicate_of', 'text', '', 'path of the recording with the same content, which was '
           'analysed instead'),
    Column('error', 'text', '', 'reason why there are no numbers; otherwise null'),
    Column('size_bytes', 'count', 'byte', 'size of the recording on disk'),
)
NAMES = tuple(column.name for column in COLUMNS)


def rows_of(source: FoundRecording, result: Mapping[str, Any], vehicle: Vehicle,
            flight: int | None, duplicate_of: Path | None = None) -> list[Row]:
    """Return the rows of one recording: one per level, or one with the error."""
    base: Row = {**dict.fromkeys(NAMES), 'recording': printable(source.path.name)}
    levels: list[dict[str, Any]] = [{}]
    if duplicate_of is None and not result['error']:
        start = result['start']
        base.update({name: value for name, value in result.items() if name in base})
        base['start'] = (datetime.fromtimestamp(start, timezone.utc)
                         if math.isfinite(start) else None)
        levels = result['levels'] or levels
    base.update(
        vehicle=vehicle.name or None, vehicle_from=vehicle.named_by if vehicle.name else None,
        flight=flight, path=printable(source.path), start_from=base['start_from'] or None,
        size_bytes=source.size, error=result['error'] or None,
        duplicate_of=None if duplicate_of is None else printable(duplicate_of))
    return [{name: None if isinstance(value, float) and math.isnan(value) else value
             for name, value in {**base, **level}.items()} for level in levels]


def _as_text(value: Any) -> Any:
    """Return a value with valid UTF-8 text (invalid bytes escaped), and objects as JSON."""
    if isinstance(value, str):
        return value.encode('utf-8', 'backslashreplace').decode()
    if isinstance(value, dict):
        return json.dumps(value, allow_nan=False)
    return [_as_text(item) for item in value] if isinstance(value, list) else value


def is_table(path: Path) -> bool:
    """Return whether `write_table` wrote a file, in this version or an earlier one."""
    import pyarrow
    from pyarrow import parquet

    try:
        with open_regular(path) as file:
            fields = parquet.read_schema(file)
    except (OSError, pyarrow.ArrowException):
        return False
    return fields.names[:2] == [*NAMES[:2]] and all(
        b'meaning' in (field.metadata or {}) for field in fields)


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as Parquet, with units and meanings in the fields' metadata."""
    import pyarrow
    from pyarrow import parquet

    kinds = {'text': pyarrow.string(), 'json': pyarrow.string(),
             'texts': pyarrow.list_(pyarrow.string()), 'number': pyarrow.float64(),
             'count': pyarrow.int64(), 'time': pyarrow.timestamp('us', tz='UTC')}
    schema = pyarrow.schema([
        pyarrow.field(column.name, kinds[column.kind],
                      metadata={'unit': column.unit, 'meaning': column.meaning})
        for column in COLUMNS])
    content = io.BytesIO()
    plain = [{name: _as_text(value) for name, value in row.items()} for row in rows]
    parquet.write_table(pyarrow.Table.from_pylist(plain, schema=schema), content,
                        compression='zstd')
    write_whole(path, content.getvalue())
