"""
Which vehicle a recording is of, and which of its flights.

The rule: what the recording names itself (its metadata), else what a pattern
finds in its path, else the folder it lies in.  Recordings are compared within
a vehicle only; where the vehicle is unknown there is none, and the
recording is compared with nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import json
import math
from pathlib import Path
import re
import subprocess
import sys

from ou_monitor.errors import InputError
from ou_monitor.text import counted, printable

METADATA, PATTERN, FOLDER = 'metadata', 'pattern', 'folder'
_SHOWN = 3

_MOST_OF_PATTERN = 1000
# Seconds for the pattern and all paths; a million paths take 2.
_PATIENCE = 10.0
# Run in a process of its own.
_MATCH = """
import json, re, resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2 ** 31, 2 ** 31))
text, paths = json.load(sys.stdin)
pattern = re.compile(text)
key = 'vehicle' if 'vehicle' in pattern.groupindex else 1 if pattern.groups else 0
found = map(pattern.search, paths)
json.dump([(match and match[key]) or '' for match in found], sys.stdout)
"""


@dataclass(frozen=True)
class Vehicle:
    """Name of a vehicle (empty: unknown), and where the name is from."""

    name: str
    named_by: str


def read_pattern(text: str) -> re.Pattern[str]:
    """Return the pattern of ``--vehicle-from``."""
    if len(text) > _MOST_OF_PATTERN:
        raise InputError(f'--vehicle-from has {len(text)} characters, and {_MOST_OF_PATTERN} is '
                         'the limit')
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
    matched = match_paths(pattern, tuple(stated))
    for path, name in stated.items():
        by_pattern = matched[path]
        if name:
            found[path] = Vehicle(name, METADATA)
            if by_pattern and by_pattern != name:
                differing.append(path)
        elif pattern is not None:
            found[path] = Vehicle(by_pattern, PATTERN)
            if not by_pattern:
                unmatched.append(path)
        elif path.parent in named:
            # Its neighbours name their vehicle: the folder is no vehicle of its own.
            found[path] = Vehicle('', FOLDER)
            mixed.append(path)
        else:
            found[path] = Vehicle(folders[path.parent], FOLDER)
    notes = [_rule(found)]
    if differing:
        notes.append(f'{_these(differing)}: the metadata name another vehicle than '
                     '--vehicle-from finds; the metadata hold.')
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
                     'others were counted to it by their path; check that it is one vehicle.')
    return found, notes


def match_paths(pattern: re.Pattern[str] | None, paths: tuple[Path, ...]) -> dict[Path, str]:
    """
    Return what a pattern finds in each path; InputError when it takes longer than it may.

    Such as ``(a+)+$`` takes years, and nothing ends it but the end of its process.
    """
    if pattern is None or not paths:
        return dict.fromkeys(paths, '')
    given = json.dumps([pattern.pattern, [str(path) for path in paths]])
    try:
        done = subprocess.run([sys.executable, '-I', '-S', '-c', _MATCH], input=given, text=True,
                              capture_output=True, timeout=_PATIENCE, check=True)
    except subprocess.CalledProcessError as error:
        why = (error.stderr.splitlines() or ['no reason'])[-1]
        raise InputError(f"--vehicle-from: '{pattern.pattern}' cannot be used "
                         f'({printable(why, 100)})') from None
    except subprocess.TimeoutExpired:
        raise InputError(f"--vehicle-from: '{pattern.pattern}' takes more than "
                         f'{_PATIENCE:g} s for {counted(len(paths), "path")}: avoid repeats of '
                         'repeats, such as (a+)+') from None
    return {path: printable(name, 200)
            for path, name in zip(paths, json.loads(done.stdout), strict=True)}


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
    """Say where the names of the vehicles are from."""
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
    """Return which flight of its vehicle each recording is, from 1 (starts in s)."""
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
                     'dates are not known or not distinct.')
    return flights, notes


def natural(text: str) -> tuple[object, ...]:
    """Return a key that sorts flight_2 before flight_10."""
    return tuple((1, int(word), '') if word.isdigit() else (0, 0, word)
                 for word in re.split(r'(\d+)', text) if word)
