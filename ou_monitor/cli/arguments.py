"""Check and use the arguments that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TYPE_CHECKING

from ou_monitor.cli import output
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.recordings.importers.log import CsvColumns, Series
    from ou_monitor.records import Recording

# Fields of `CsvColumns`, and the options that give them.
_COLUMNS = {'time': 'time_column', 'voltage': 'voltage_column', 'throttle': 'throttle_column',
            'current': 'current_column', **{name: name for name in (
                'unit', 'time_unit', 'throttle_unit', 'sample_interval', 'delimiter', 'decimal',
                'skip_rows')}}


def check_outputs(args: argparse.Namespace, bag: tuple[str, Path | None] = ('', None),
                  **inputs: Any) -> None:
    """Refuse outputs that overwrite an input, cannot be written, or (except for JSON) are '-'."""
    # bag: option and path of a bag to be written.
    option, path = bag
    files = {'--save-model': getattr(args, 'save_model', None),
             '--report': getattr(args, 'report', None)}
    for name, target in files.items():
        if str(target) == output.STDOUT:
            raise InputError(f"{name} needs a file: '-' is not supported")
    for target in (args.json, *files.values()):
        output.check_writable(target)
    if path is not None:
        output.check_bag(option, path, args.force)
    output.check_paths(inputs, {'--json': args.json, **files, option: path}, args.force)


def read_given(args: argparse.Namespace, signal: str | None = None
               ) -> tuple[Recording, Series | None]:
    """Read RECORDING, and a signal in it, as the arguments say, with a progress bar."""
    from ou_monitor.recordings.read import read_beside, read_recording

    start, end = part_of_recording(args)
    with Progress('reading') as progress:
        options = {
            'msg_config': args.msg_config, 'voltage_topic': args.voltage_topic,
            'throttle_topic': args.throttle_topic, 'partial': args.partial, 'start': start,
            'end': end, 'flight': args.flight, 'columns': columns_given(args),
            'progress': progress}
        if signal is None:
            return read_recording(args.recording, **options), None
        return read_beside(args.recording, signal, **options)


def columns_given(args: argparse.Namespace) -> CsvColumns | None:
    """Return the columns of a CSV that the options name; None without such an option."""
    from ou_monitor.recordings.importers.log import CsvColumns

    given = {name: getattr(args, option) for name, option in _COLUMNS.items()
             if getattr(args, option, None) is not None}
    return CsvColumns(**given) if given else None


def check_ranges(given: Mapping[str, Any]) -> None:
    """Refuse values that the node would refuse for its parameters of the same names."""
    from ou_monitor.online.settings import ESTIMATOR_PARAMETERS

    for parameter in ESTIMATOR_PARAMETERS:
        value = given.get(parameter.name.replace('.', '_'))
        if (value is not None and parameter.low is not None and parameter.high is not None
                and not parameter.low <= value <= parameter.high):
            raise InputError(f"--{parameter.name.replace('.', '-')}: {value:g} is not within "
                             f'{parameter.low:g} to {parameter.high:g}')


def part_of_recording(args: argparse.Namespace) -> tuple[float | None, float | None]:
    """Return the times of ``--from`` and ``--to``, s; None where not given."""
    start, end = getattr(args, 'start', None), getattr(args, 'end', None)
    if start is not None and end is not None and not start < end:
        raise InputError(f'--from {start:g} is not before --to {end:g}')
    return start, end
