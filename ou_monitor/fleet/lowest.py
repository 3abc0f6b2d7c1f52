"""What a pilot asks of a fleet first: the lowest voltage, the dips and the sag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
import math

from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.table import Row
from ou_monitor.text import counted, number, volts

# Characters of the name of a vehicle in a table.
_NAME = 30
# Heads of the table of recordings.
HEADS = ('vehicle', 'recording', 'lowest, V', 'at, s', 'dips', 'below, s', 'sag, V', 'at throttle')
UNKNOWN = '-'


@dataclass(frozen=True)
class DipCount:
    """Dips of a vehicle or of the whole fleet."""

    count: int = 0  # Dips below the limit
    below: float = 0.0  # Time below it, s
    recordings: int = 0  # Recordings with dips


def once(fleet: Fleet) -> list[Row]:
    """Return one row of each recording that was analysed, lowest voltage known."""
    rows = {row['path']: row for row in fleet.rows if row['lowest'] is not None}
    return list(rows.values())


def dips_of(rows: Sequence[Row]) -> DipCount | None:
    """Return the dips of recordings; None where no limit was given."""
    known = [row for row in rows if row['dips'] is not None]
    if not known:
        return None
    return DipCount(sum(int(row['dips']) for row in known), sum(row['below_s'] for row in known),
                    sum(row['dips'] > 0 for row in known))


def worst(fleet: Fleet) -> list[Row]:
    """Return the recordings: those with most dips first, then by their lowest voltage."""
    return sorted(once(fleet), key=lambda row: (-(row['dips'] or 0), row['lowest'], row['path']))


def sentences(fleet: Fleet) -> list[str]:
    """Return what a pilot wants to know; nothing where no recording has a voltage."""
    rows = once(fleet)
    if not rows:
        return []
    low = min(rows, key=lambda row: row['lowest'])
    lowest = (f'{number(low["lowest"], 4)} V at {number(low["lowest_at"])} s of '
              f'{_name(low)}')
    found = dips_of(rows)
    if found is None:
        text = f'The lowest voltage was {lowest}'
    elif not found.count:
        text = f'No recording fell below {fleet.limit:g} V: the lowest was {lowest}'
    else:
        most = worst(fleet)[0]
        where = f'in {found.recordings} of {counted(len(rows), "recording")}'
        if found.recordings > 1 and most['dips'] > 1:
            where += f', most in {_name(most)}, {most["dips"]}'
        text = (f'{counted(found.count, "dip")} below {fleet.limit:g} V {where}: the lowest was '
                f'{lowest}')
    sags = [row for row in rows if row['sag'] is not None]
    if not sags:
        return [f'{text}.']
    row = max(sags, key=lambda row: row['sag'])
    return [f'{text}.', f'The rail sags by up to {volts(row["sag"])}, at '
            f'{100.0 * row["sag_throttle"]:.0f} % throttle.']


def facts(fleet: Fleet) -> list[tuple[str, str]]:
    """Return what is always known of a fleet: pairs of name and words."""
    rows = once(fleet)
    if not rows:
        return []
    low = min(rows, key=lambda row: row['lowest'])
    lines = [('Lowest voltage', f'{number(low["lowest"], 4)} V at {number(low["lowest_at"])} s of '
              f'{_name(low)}' + _throttle(low['lowest_throttle']))]
    found = dips_of(rows)
    if found is not None:
        lines.append((f'Below {fleet.limit:g} V', (
            f'{counted(found.count, "dip")}, {number(found.below, 2)} s in all, in '
            f'{found.recordings} of {counted(len(rows), "recording")}') if found.count
            else 'never'))
    sags = [row for row in rows if row['sag'] is not None]
    if sags:
        least, most = (choose(sags, key=lambda row: row['sag']) for choose in (min, max))
        lines.append(('Sag', (f'{volts(least["sag"])} to ' if len(sags) > 1 else '')
                      + f'{volts(most["sag"])} (+- {volts(2.0 * most["sag_se"])}) at the highest '
                      f'throttle flown; known in {len(sags)} of '
                      f'{counted(len(rows), "recording")}'))
    else:
        lines.append(('Sag', 'unknown in all: throttle is not known, or did not move enough'))
    return lines


def _name(row: Row) -> str:
    """Return what a recording is called, with its vehicle."""
    vehicle = '' if row['vehicle'] is None else f' ({row["vehicle"]})'
    return f'{row["recording"]}{vehicle}'


def _throttle(value: float | None) -> str:
    return '' if value is None else f', at {100.0 * value:.0f} % throttle'


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return names as tables show them: long ones without their middle."""
    short = {name: name if len(name) <= _NAME else f'{name[:13]}\u2026{name[13 - _NAME + 1:]}'
             for name in names}
    uses = Counter(short.values())
    return {name: text if uses[text] == 1 else name for name, text in short.items()}


def table(fleet: Fleet, most: int) -> tuple[list[str], list[list[str]]]:
    """Return the recordings with the lowest voltages: heads and cells, no column empty."""
    names = short_names(fleet.vehicles)
    return without_empty(HEADS, [_cells(row, names) for row in worst(fleet)[:most]])


def without_empty(heads: Sequence[str], rows: list[list[str]],
                  ) -> tuple[list[str], list[list[str]]]:
    """Return a table without the columns in which no row knows anything."""
    kept = [k for k in range(len(heads)) if any(row[k] != UNKNOWN for row in rows)]
    return [heads[k] for k in kept], [[row[k] for k in kept] for row in rows]


def _cells(row: Row, names: dict[str, str]) -> list[str]:
    def shown(value: float | None, digits: int = 3) -> str:
        return UNKNOWN if value is None or math.isnan(value) else number(value, digits)

    return [names.get(row['vehicle'], UNKNOWN), row['recording'], shown(row['lowest'], 4),
            shown(row['lowest_at']), UNKNOWN if row['dips'] is None else f'{row["dips"]:g}',
            shown(row['below_s'], 2), shown(row['sag']),
            UNKNOWN if row['sag_throttle'] is None else f'{100.0 * row["sag_throttle"]:.0f} %']
