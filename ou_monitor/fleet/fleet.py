"""
Analyse many recordings, and resume a stopped run.

Each result is saved at once, in its own file.  A saved result is used again if path, size and time
of change of the recording, the options, and the version of the package are the same.  Failures are
not saved, so the next run tries these recordings again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
import hashlib
import json
from pathlib import Path
import re
from tempfile import TemporaryFile
from typing import Any

from ou_monitor.analysis.crafts import cells_among
from ou_monitor.errors import InputError
from ou_monitor.fleet.analysis import Options, work
from ou_monitor.fleet.find import duplicates, FoundRecording, SearchResult
from ou_monitor.fleet.judgement import judge, Judgement
from ou_monitor.fleet.table import Row, rows_of
from ou_monitor.fleet.vehicles import assign, number_flights
from ou_monitor.fleet.workers import ClusterWorkers, LocalWorkers, Workers
from ou_monitor.records import NAN
from ou_monitor.stream.files import open_regular, write_whole
from ou_monitor.text import printable

FOLDER = 'parts'
# Name and text of the file that marks `FOLDER` as written by fleet.
_MARK, _MARK_TEXT = 'ou_monitor_fleet.txt', b'Results of ou-monitor fleet, one a recording.\n'
# How the file of each result begins.
_BEGIN = b'{"error": ""'
# Maximum size of a result file, bytes; typical: 10 kB.
_MOST = 50_000_000


def is_own(folder: Path) -> bool:
    """Return whether an earlier run of fleet wrote into a folder."""
    try:
        with open_regular(folder / FOLDER / _MARK) as file:
            return file.read(len(_MARK_TEXT) + 1) == _MARK_TEXT
    except OSError:
        return False


class SavedResults:
    """The saved results in a folder, which is created; raises InputError if that fails."""

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        self._folder = folder / FOLDER
        # Everything that the results depend on, the package version included.
        self._options = json.dumps(dict(options), sort_keys=True)
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            # Fail on an unwritable folder before the work, not after it.
            with TemporaryFile(dir=self._folder) as probe:
                probe.write(b' ' * 4096)
        except OSError as error:
            raise InputError(f"cannot write into '{folder}': {error.strerror or error}") from error
        if not is_own(folder):
            write_whole(self._folder / _MARK, _MARK_TEXT, over=False)

    def _path(self, source: FoundRecording) -> Path:
        text = json.dumps([str(source.path), source.size, source.stamp, self._options])
        return self._folder / (hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
                               + '.json')

    def load(self, source: FoundRecording) -> dict[str, Any] | None:
        """Return the saved result of a recording or None; refuse a file not written by fleet."""
        path = self._path(source)
        try:
            with open_regular(path) as file:
                content = file.read(_MOST).rstrip(b'\0')
            if content[:len(_BEGIN)] != _BEGIN[:len(content)]:
                raise InputError(f"'{path}' was not written by fleet: move it elsewhere")
            found: dict[str, Any] = json.loads(content)
        except (OSError, ValueError, RecursionError):
            # Missing, or truncated by a power loss: compute it again.
            return None
        return found

    def save(self, source: FoundRecording, result: Mapping[str, Any]) -> None:
        """Save the result of a recording."""
        write_whole(self._path(source), json.dumps(result).encode())


Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Fleet:
    """Result of analysing a fleet."""

    rows: list[Row]  # The table, in order of vehicle, flight, path and level
    judgement: Judgement
    notes: tuple[str, ...]  # How vehicles were named, skipped files, and the like
    recordings: int  # Recordings found
    limit: float = NAN  # Voltage below which dips are counted, V; NaN: dips are not counted

    @property
    def vehicles(self) -> list[str]:
        """Return the vehicles with a name, in order."""
        return sorted({row['vehicle'] for row in self.rows if row['vehicle'] is not None})

    def recordings_of(self, vehicle: str) -> list[Row]:
        """Return one row for each recording of a vehicle."""
        return [row for row in self._each if row['vehicle'] == vehicle]

    @property
    def _each(self) -> list[Row]:
        return list({row['path']: row for row in self.rows}.values())

    @property
    def failed(self) -> list[Row]:
        """Return the rows that have an error."""
        return [row for row in self.rows if row['error'] is not None]

    @property
    def duplicates(self) -> list[Row]:
        """Return the rows of duplicate recordings."""
        return [row for row in self.rows if row['duplicate_of'] is not None]

    @property
    def analysed(self) -> list[Row]:
        """Return one row for each recording that has results of its own."""
        return [row for row in self._each if row['error'] is None and row['duplicate_of'] is None]


def run_fleet(found: SearchResult, folder: Path, options: Options, version: Callable[[], str], *,
              workers: int, scheduler: str | None = None, insecure: bool = False,
              pattern: re.Pattern[str] | None = None, comparing: Progress | None = None,
              progress: Progress | None = None) -> Fleet:
    """Analyse all unfinished recordings, and judge the fleet."""
    saved = SavedResults(folder, {**asdict(options), 'version': version()})
    twice = duplicates(found.sources, comparing)
    known = {source: saved.load(source) for source in found.sources if source.path not in twice}
    missing = [source for source, result in known.items() if result is None]
    results = {source.path: result for source, result in known.items() if result is not None}
    if missing:
        with (LocalWorkers(min(workers, len(missing))) if scheduler is None else
              ClusterWorkers(scheduler, version, insecure)) as pool:
            _work(missing, results, saved, options, pool, progress)
    rows, notes = _table(found.sources, results, twice, pattern)
    notes = list(map(printable, (*found.notes, *notes)))
    return Fleet(rows, judge(rows), tuple(notes), len(found.sources), options.brownout_voltage)


def _work(missing: Sequence[FoundRecording], results: dict[Path, dict[str, Any]],
          saved: SavedResults, options: Options, pool: Workers, progress: Progress | None) -> None:
    kept = len(results)
    # The largest first, so that no long one is left at the end.
    order = sorted(missing, key=lambda source: (-source.size, source.path))
    tell = progress or (lambda share: None)
    tell(kept / (kept + len(order)))
    tasks = [(str(source.path), options) for source in order]
    for done, (k, result, why) in enumerate(pool.each(work, tasks)):
        if result is None:
            result = {'error': why, 'levels': []}
        if not result['error']:
            saved.save(order[k], result)
        results[order[k].path] = result
        tell((kept + done + 1) / (kept + len(order)))


def _table(sources: Sequence[FoundRecording], results: dict[Path, dict[str, Any]],
           twice: dict[Path, Path], pattern: re.Pattern[str] | None
           ) -> tuple[list[Row], list[str]]:
    """Return all rows of the table, and notes on vehicles, flights and damage."""
    # A duplicate's vehicle is named by its metadata, else by its own path.
    whole = {s.path: results[twice.get(s.path, s.path)] for s in sources}
    vehicles, notes = assign({path: r.get('vehicle', '') for path, r in whole.items()}, pattern)
    starts = {path: r.get('start', NAN) for path, r in results.items() if not r['error']}
    flights, more = number_flights(vehicles, starts)
    for path, first in twice.items():
        if vehicles[path].name != vehicles[first].name:
            here, there = (vehicles[p].name or 'none' for p in (path, first))
            notes.append(f"'{path}' has the same content as '{first}', but its path names "
                         f'another vehicle ({here} instead of {there}): one of the two is in the '
                         'wrong place.')
    more += [f'{vehicles[path].name or "unknown vehicle"}: {path.name}: {note}' for path in starts
             for note in results[path]['damage']]
    for group in {v.name for v in vehicles.values()} - {''}:
        _guess_together([results[path] for path in starts if vehicles[path].name == group])
    rows = [row for source in sources for row in rows_of(
        source, whole[source.path], vehicles[source.path], flights.get(source.path),
        twice.get(source.path))]
    rows.sort(key=lambda row: (row['vehicle'] is None, row['vehicle'] or '',
                               row['flight'] is None, row['flight'] or 0, row['path']))
    return rows, [*notes, *more]


def _guess_together(flights: Sequence[dict[str, Any]]) -> None:
    """Replace guessed or unknown cells by those that a vehicle's flights allow."""
    known = {one['cells'] for one in flights if one['cells']}
    for one in flights:
        if one['cells_from'] in ('guessed', 'unknown'):
            cells = cells_among(one['full_v'], known)
            one.update(cells=cells or None, cells_from='guessed' if cells else 'unknown')
