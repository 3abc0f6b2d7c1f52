"""
Vehicle and flight number of a recording.

The vehicle is the one that the recording names itself (its metadata), else the match of a
pattern in its path, else its folder.  Recordings are compared within
a vehicle only; a recording of an unknown vehicle is compared with nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
import re

from ou_monitor.errors import InputError
from ou_monitor.text import counted, printable

METADATA, PATTERN, FOLDER = 'metadata', 'pattern', 'folder'
_SHOWN = 3


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
    """Return the vehicle of each recording."""
    found: dict[Path, Vehicle] = {}
    differing, unmatched = [], []
    folders = _folder_names({path.parent for path, name in stated.items() if not name})
    named = {path.parent for path, name in stated.items() if name}
    mixed = []
    for path, name in stated.items():
        by_pattern = _match(pattern, path)
        if name:
            found[path] = Vehicle(name, METADATA)
            if by_pattern and by_pattern != name:
                differing.append(path)
        elif pattern is not None:
            found[path] = Vehicle(by_pattern, PATTERN)
            if not by_pattern:
                unmatched.append(path)
        elif path.parent in named:
            # Its neighbours name their vehicle, so the folder is not a vehicle.
            found[path] = Vehicle('', FOLDER)
            mixed.append(path)
        else:
            found[path] = Vehicle(folders[path.parent], FOLDER)
    notes = [_rule(found)]
    if differing:
        notes.append(f'{_these(differing)}: the metadata name another vehicle than '
                     '--vehicle-from finds; the metadata are used.')
    if unmatched:
        notes.append(f'{_these(unmatched)}: --vehicle-from finds no vehicle in the path; they '
                     'are compared with nothing.')
    if mixed:
        notes.append(f'{_these(mixed)}: no vehicle in the metadata, while others in the same '
                     'folder name theirs; they are compared with nothing. --vehicle-from names '
                     'them by their path.')
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
    """Return a name for each folder: its last part, with more parts where others share it."""
    names = {}
    for folder in folders:
        for depth in range(1, len(folder.parts) + 1):
            tail = folder.parts[-depth:]
            if sum(other.parts[-depth:] == tail for other in folders) == 1:
                break
        names[folder] = printable('/'.join(part.strip('/') for part in tail) or '/')
    return names


def _rule(found: Mapping[Path, Vehicle]) -> str:
    """Say where the vehicles' names come from."""
    words = {METADATA: 'by their metadata', PATTERN: 'by --vehicle-from',
             FOLDER: 'by the folder they lie in'}
    parts = []
    for kind, text in words.items():
        of_kind = [v for v in found.values() if v.named_by == kind and v.name]
        if of_kind:
            count = len({v.name for v in of_kind})
            parts.append(f'{counted(len(of_kind), "recording")} to {counted(count, "vehicle")} '
                         f'{text}')
    return 'Vehicles: ' + ('; '.join(parts) if parts else 'none identified') + '.'


def _these(paths: Sequence[Path]) -> str:
    names = ', '.join(f"'{path}'" for path in paths[:_SHOWN])
    more = len(paths) - _SHOWN
    return names + (f' and {more} more' if more > 0 else '')


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
        dated = all(map(math.isfinite, dates)) and len(set(dates)) == len(dates)
        if len(paths) > 1 and not dated:
            by_name.append(name)
        order = sorted(paths, key=lambda path: (starts[path],) if dated else natural(str(path)))
        for k, path in enumerate(order):
            flights[path] = k + 1
    notes = []
    if by_name:
        some = ', '.join(sorted(by_name)[:_SHOWN])
        more = len(by_name) - _SHOWN
        some += f' and {more} more' if more > 0 else ''
        notes.append(f'{some}: the flights are in the order of their names, because their '
                     'dates are unknown or not distinct.')
    return flights, notes


def natural(text: str) -> tuple[object, ...]:
    """Return a key that sorts flight_2 before flight_10."""
    return tuple((1, int(word), '') if word.isdigit() else (0, 0, word)
                 for word in re.split(r'(\d+)', text) if word)
