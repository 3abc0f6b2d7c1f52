"""`ou-monitor fleet RECORDING...`: many recordings -> one table and one report."""

from __future__ import annotations

import argparse
import hashlib
import math
import os
from pathlib import Path
import sys
from typing import TYPE_CHECKING

from ou_monitor import __version__
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_ranges, columns_given
from ou_monitor.cli.output import Progress
from ou_monitor.errors import how_to_install, InputError
from ou_monitor.text import counted

if TYPE_CHECKING:
    from ou_monitor.fleet.analysis import Options
    from ou_monitor.fleet.fleet import Fleet

TABLE, REPORT = 'fleet.parquet', 'fleet.html'


def run(args: argparse.Namespace) -> int:
    from ou_monitor.fleet.workers import usable_cores

    if args.scheduler is not None and args.workers is not None:
        raise InputError('--workers is for local processes, --scheduler for a cluster: give one')
    _check_installed(args)
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--output '{folder}' is a file: name a folder")
    from ou_monitor.fleet.find import find_recordings
    from ou_monitor.fleet.fleet import run_fleet
    from ou_monitor.fleet.vehicles import read_pattern

    made = {f'--output ({name})': folder / name for name in (REPORT, TABLE)}
    for path in made.values():
        if os.path.lexists(path) and not path.is_file():
            raise InputError(f"'{path}' is not a file: remove it, or name another folder")
    output.check_paths({}, {**made, '--json': args.json}, force=True)
    output.check_paths({}, {'--json': args.json}, args.force)
    _check_own(folder, args.force)
    output.check_writable(args.json)

    options = _options(args)
    pattern = None if args.vehicle_from is None else read_pattern(args.vehicle_from)
    found = find_recordings(args.recordings, leave_out=folder)
    output.check_paths({f'recording {k}': source.path for k, source in enumerate(
        found.sources, 1)}, {'--json': args.json}, force=True)
    try:
        with Progress('comparing') as comparing, Progress('analyzing') as progress:
            fleet = run_fleet(
                found, folder, options, version, workers=args.workers or usable_cores(),
                scheduler=args.scheduler, insecure=args.insecure, pattern=pattern,
                comparing=comparing, progress=progress)
    except KeyboardInterrupt:
        print(f"stopped; finished recordings are kept in '{folder}', and the same command "
              'resumes', file=sys.stderr)
        raise
    _write(fleet, folder, args)
    if fleet.failed:
        raise InputError(f'{len(fleet.failed)} of {counted(fleet.recordings, "recording")} could '
                         f"not be analysed; the reasons are in '{folder}' and in the column error "
                         'of the table')
    return 0


def _check_own(folder: Path, force: bool) -> None:
    """Refuse to replace a table or report that no earlier run wrote, except with --force."""
    from ou_monitor.fleet.fleet import is_own
    from ou_monitor.fleet.table import is_table
    from ou_monitor.report.fleet_document import TITLE
    from ou_monitor.report.page import is_page

    for path in (folder / REPORT, folder / TABLE):
        if not force and os.path.lexists(path) and not (is_own(folder) and (
                is_table(path) if path.name == TABLE else is_page(path, TITLE))):
            raise InputError(f"'{path}' was not written by fleet, or was changed since: --force "
                             'overwrites it, or name another folder')


def _check_installed(args: argparse.Namespace) -> None:
    """Refuse to start if a package is missing or the scheduler is unsafe."""
    from importlib.util import find_spec

    needed = ['pyarrow'] + ([] if args.scheduler is None else ['dask', 'distributed'])
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise InputError(f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} not "
                         f"installed: {how_to_install('fleet')}")
    if args.scheduler is not None:
        from ou_monitor.fleet.workers import check_address
        check_address(args.scheduler, args.insecure)
    elif args.insecure:
        raise InputError('--insecure is for --scheduler: local processes open no connection')


def version() -> str:
    """Return the version of this package (also called on the workers of a scheduler)."""
    return __version__


def _write(fleet: Fleet, folder: Path, args: argparse.Namespace) -> None:
    from ou_monitor.fleet.table import write_table
    from ou_monitor.report.fleet_document import as_data, fleet_document
    from ou_monitor.report.result import Result

    # Again, because the run may have taken hours.
    _check_own(folder, args.force)
    write_table(fleet.rows, folder / TABLE)
    found = Result(fleet, lambda: fleet_document(fleet), lambda: as_data(fleet), 'rows')
    output.deliver(args, found, table=folder / TABLE, report=folder / REPORT)


def _options(args: argparse.Namespace) -> Options:
    from ou_monitor.analysis.crafts import pack_limit
    from ou_monitor.fleet.analysis import Options

    config, content = args.msg_config, ''
    if config is not None:
        if Path(config).is_file():
            config = str(Path(config).resolve())
            try:
                content = hashlib.blake2b(Path(config).read_bytes()).hexdigest()
            except OSError as error:
                raise InputError(f"--msg-config: cannot read '{config}': {error.strerror}"
                                 ) from error
        from ou_monitor.stream.config import load_msg_config
        load_msg_config(config)
    limit = pack_limit(args.brownout_voltage, args.cells)
    check_ranges({'window': args.window, 'brownout_voltage': limit,
                  'brownout_horizon': args.brownout_horizon})
    return Options(
        levels=args.levels, window=args.window,
        brownout_voltage=math.nan if limit is None else limit,
        brownout_horizon=args.brownout_horizon, cells=args.cells or 0,
        msg_config=config, msg_config_hash=content, voltage_topic=args.voltage_topic,
        throttle_topic=args.throttle_topic, columns=columns_given(args), partial=args.partial,
        discover=args.discover, seed=args.seed)
