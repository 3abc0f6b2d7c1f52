"""Results -> rows of the fleet table -> Parquet; the only module that imports pyarrow."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
import io
import math
from pathlib import Path
from typing import Any

from ou_monitor.fleet.columns import COLUMNS, NAMES, OF_LEVEL
from ou_monitor.fleet.find import Source
from ou_monitor.fleet.parts import write_whole
from ou_monitor.fleet.vehicles import Vehicle

Row = dict[str, Any]
_OF_RECORDING = ('recording', 'duration_s', 'samples', 'rate_hz', 'sag', 'sag_se', 'risk_max',
                 'verdict', 'causes', 'gain', 'gain_se', 'notes')


def rows_of(source: Source, result: Mapping[str, Any], vehicle: Vehicle, flight: int | None,
            duplicate_of: Path | None = None) -> list[Row]:
    """Return the rows of one recording: one a level, or one that says why there is none."""
    base: Row = dict.fromkeys(NAMES)
    base.update(
        vehicle=vehicle.name or None, vehicle_from=vehicle.told_by if vehicle.name else None,
        flight=flight, path=str(source.path), recording=source.path.name,
        size_bytes=source.size, error=result['error'] or None,
        duplicate_of=None if duplicate_of is None else str(duplicate_of))
    if duplicate_of is not None or result['error']:
        return [base]
    base.update({name: _known(result[name]) for name in _OF_RECORDING})
    start = result['start']
    base['start'] = (datetime.fromtimestamp(start, timezone.utc)
                     if math.isfinite(start) else None)
    levels = result['levels'] or [{}]
    return [{**base, **{name: _known(level.get(name)) for name in OF_LEVEL}} for level in levels]


def _known(value: Any) -> Any:
    """Return a value, None for a number that is not known."""
    return None if isinstance(value, float) and math.isnan(value) else value


def _as_text(value: Any) -> Any:
    """Return texts without what is no text, such as bytes in a file name."""
    if isinstance(value, str):
        return value.encode('utf-8', 'backslashreplace').decode()
    return [_as_text(item) for item in value] if isinstance(value, list) else value


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write the rows as Parquet, with units and meanings in the fields' metadata."""
    import pyarrow
    from pyarrow import parquet

    kinds = {'text': pyarrow.string(), 'texts': pyarrow.list_(pyarrow.string()),
             'number': pyarrow.float64(), 'count': pyarrow.int64(),
             'time': pyarrow.timestamp('us', tz='UTC')}
    schema = pyarrow.schema([
        pyarrow.field(column.name, kinds[column.kind],
                      metadata={'unit': column.unit, 'meaning': column.meaning})
        for column in COLUMNS])
    content = io.BytesIO()
    plain = [{name: _as_text(value) for name, value in row.items()} for row in rows]
    parquet.write_table(pyarrow.Table.from_pylist(plain, schema=schema), content,
                        compression='zstd')
    write_whole(path, content.getvalue())
