"""
Vehicle and flight number of a recording.

The vehicle is named by the metadata of the recording, else by a pattern in its path, or, if no
pattern is given, by its folder.  Recordings are compared within a vehicle only.  Flights are
ordered by date; the date comes from the stamps, the log's header or the file's name.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime, timezone
import math
from pathlib import Path
import re

from ou_monitor.errors import InputError
from ou_monitor.records import clock_unit, NAN, Recording
from ou_monitor.text import counted, printable, some

METADATA, PATTERN, FOLDER = 'metadata', 'pattern', 'folder'
# A date in a name, with the time if it follows: 2024-05-03_14-07-12, 20240503T140712.
_DATE = re.compile(r'(?<!\d)(20\d\d)(?:([-_.])(\d\d?)\2(\d\d?)|(\d\d)(\d\d))(?:[T _-]+(\d\d)'
                   r'[-_:.h]?(\d\d)(?:[-_:.m]?(\d\d))?)?(?!\d)')
_SHOWN = 3  # Maximum paths or vehicles named in a note
# Notes on paths.
_DIFFERING = 'metadata and --vehicle-from name different vehicles; the metadata are used.'
_UNMATCHED = '--vehicle-from finds no vehicle in the path; these recordings are not compared.'
_MIXED = ('the metadata lack the vehicle, which other recordings in the folder state; these '
          'recordings are not compared. --vehicle-from can take the vehicle from the path.')


@dataclass(frozen=True)
class Vehicle:
    """Name of a vehicle (empty: unknown), and where the name is from."""

    name: str
    named_by: str


def read_pattern(text: str) -> re.Pattern[str]:
    """Return the pattern of ``--vehicle-from``."""
    try:
        return re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise InputError(f"--vehicle-from: '{text}' is not a regular expression: {error}"
                         ) from error


def assign(stated: Mapping[Path, str], pattern: re.Pattern[str] | None = None
           ) -> tuple[dict[Path, Vehicle], list[str]]:
    """Return the vehicle of each recording (stated: by its metadata), and notes."""
    found: dict[Path, Vehicle] = {}
    folders = _folder_names({path.parent for path, name in stated.items() if not name})
    named = {path.parent for path, name in stated.items() if name}
    odd: dict[str, list[Path]] = {}
    for path, name in stated.items():
        by_pattern, why = _match(pattern, path), ''
        if name:
            found[path] = Vehicle(name, METADATA)
            why = _DIFFERING if by_pattern not in ('', name) else ''
        elif pattern is not None:
            found[path] = Vehicle(by_pattern, PATTERN)
            why = '' if by_pattern else _UNMATCHED
        else:
            # If other recordings in the folder name their vehicles, the folder is not a vehicle.
            why = _MIXED if path.parent in named else ''
            found[path] = Vehicle('' if why else folders[path.parent], FOLDER)
        if why:
            odd.setdefault(why, []).append(path)
    notes = [_rule_counts(found), *(
        some((f"'{path}'" for path in paths), _SHOWN) + f': {why}' for why, paths in odd.items())]
    both = {v.name for v in found.values() if v.named_by == METADATA} & {
        v.name for v in found.values() if v.named_by != METADATA and v.name}
    if both:
        notes.append(f'{", ".join(sorted(both))}: some recordings name this vehicle themselves, '
                     'others were assigned to it by their path; check that it is one vehicle.')
    return found, notes


def _match(pattern: re.Pattern[str] | None, path: Path) -> str:
    """Return the vehicle that a pattern finds in a path; empty if none."""
    found = None if pattern is None else pattern.search(str(path))
    if found is None:
        return ''
    key = 'vehicle' if 'vehicle' in found.re.groupindex else 1 if found.re.groups else 0
    return printable(found[key] or '', 200)


def _folder_names(folders: set[Path]) -> dict[Path, str]:
    """Return a name for each folder: its last part, with more parts if they are not unique."""
    names = {}
    for folder in folders:
        for depth in range(1, len(folder.parts) + 1):
            tail = folder.parts[-depth:]
            if sum(other.parts[-depth:] == tail for other in folders) == 1:
                break
        names[folder] = printable('/'.join(part.strip('/') for part in tail) or '/')
    return names


def _rule_counts(found: Mapping[Path, Vehicle]) -> str:
    """Return how many vehicles were named by which rule."""
    words = {METADATA: 'by their metadata', PATTERN: 'by --vehicle-from',
             FOLDER: 'by their folder'}
    parts = []
    for kind, text in words.items():
        of_kind = [v for v in found.values() if v.named_by == kind and v.name]
        if of_kind:
            count = len({v.name for v in of_kind})
            parts.append(f'{counted(len(of_kind), "recording")} assigned to '
                         f'{counted(count, "vehicle")} {text}')
    return 'Vehicles: ' + ('; '.join(parts) if parts else 'none identified') + '.'


def start_of(recording: Recording) -> tuple[float, str]:
    """Return the time of the first sample, s since 1970 or NaN, and where it is from."""
    if clock_unit(float(recording.t[0])) == 's':
        return float(recording.t[0]), 'stamps'
    stated = recording.source.get('started', recording.source.get('log_started', ''))
    with suppress(ValueError):
        found = datetime.fromisoformat(stated)
        return found.replace(tzinfo=found.tzinfo or timezone.utc).timestamp(), 'log'
    named = _DATE.search(recording.name)
    with suppress(ValueError):
        if named:
            year, _, *parts = named.groups()
            month, day = [int(part) for part in parts[:4] if part]
            hour, minute, second = (int(part or 0) for part in parts[4:])
            return datetime(int(year), month, day, hour, minute, second,
                            tzinfo=timezone.utc).timestamp(), 'name'
    return NAN, ''


def number_flights(vehicles: Mapping[Path, Vehicle], starts: Mapping[Path, float]
                   ) -> tuple[dict[Path, int], list[str]]:
    """Return the flight number of each recording within its vehicle, from 1 (starts in s)."""
    flights: dict[Path, int] = {}
    by_name = []
    groups: dict[str, list[Path]] = {}
    for path in starts:
        if vehicles[path].name:
            groups.setdefault(vehicles[path].name, []).append(path)
    for name, paths in groups.items():
        dates = [starts[path] for path in paths]
        dated = all(map(math.isfinite, dates))
        if len(paths) > 1 and not (dated and len(set(dates)) == len(dates)):
            by_name.append(name)
        order = sorted(paths, key=lambda path: (
            starts[path] if dated else 0.0, natural(str(path))))
        flights.update({path: number for number, path in enumerate(order, 1)})
    return flights, [f'{some(sorted(by_name), _SHOWN)}: some dates of flights are unknown or '
                     'equal, so the order of names decides.'] if by_name else []


def natural(text: str) -> tuple[object, ...]:
    """Return a key that sorts flight_2 before flight_10."""
    return tuple((1, int(word), '') if word.isdigit() else (0, 0, word)
                 for word in re.split(r'(\d+)', text) if word)
