"""Arguments that several commands share: how they are checked, read, and repeated."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import shlex
from typing import Any, TYPE_CHECKING, TypeVar

from ou_monitor.analysis.crafts import CELL_LIMIT
from ou_monitor.cli import output
from ou_monitor.cli.options import number, POSITIVE, TIME
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.recordings.importers.log import CsvColumns, Series
    from ou_monitor.records import Recording

Number = TypeVar('Number', int, float)
# Above the voltage of any charged lithium cell, V.
_CELL_MOST = 5.0
# Fields of `CsvColumns`, and the options that give them.
_COLUMNS = {'time': 'time_column', 'voltage': 'voltage_column', 'throttle': 'throttle_column',
            'current': 'current_column', **{name: name for name in (
                'unit', 'time_unit', 'throttle_unit', 'sample_interval', 'delimiter', 'decimal',
                'skip_rows')}}
# Options that choose topics and columns, by their names in the parser.
_TOPICS = ('msg_config', 'voltage_topic', 'throttle_topic', 'flight', *_COLUMNS.values())


def check_outputs(args: argparse.Namespace, *names: str, **inputs: Any) -> None:
    """Refuse outputs that overwrite an input, cannot be written, or (but for JSON) are '-'."""
    targets = {f"--{name.replace('_', '-')}": getattr(args, name) for name in names}
    for option, target in targets.items():
        if target == output.STDOUT:
            raise InputError(f"{option} needs a file: '-' is not supported")
    output.check_paths(inputs, {'--json': args.json, **targets}, args.force)
    for target in (args.json, *targets.values()):
        output.check_writable(target)


def read_given(args: argparse.Namespace, start: float | None, end: float | None) -> Recording:
    """Read RECORDING as the arguments say, with a progress bar (start, end in s)."""
    from ou_monitor.recordings.read import read_recording

    with Progress('reading', args.json == output.STDOUT) as progress:
        return read_recording(args.recording, **_as_given(args, start, end, progress))


def read_given_beside(args: argparse.Namespace, start: float | None, end: float | None,
                      ) -> tuple[Recording, Series]:
    """Read RECORDING and the signal of the arguments, likewise (start, end in s)."""
    from ou_monitor.recordings.read import read_beside

    with Progress('reading', args.json == output.STDOUT) as progress:
        return read_beside(args.recording, args.signal, **_as_given(args, start, end, progress))


def _as_given(args: argparse.Namespace, start: float | None, end: float | None,
              progress: Progress) -> dict[str, Any]:
    return {'msg_config': args.msg_config, 'voltage_topic': args.voltage_topic,
            'throttle_topic': args.throttle_topic, 'partial': args.partial, 'start': start,
            'end': end, 'flight': args.flight, 'columns': columns_given(args),
            'progress': progress}


def columns_given(args: argparse.Namespace) -> CsvColumns | None:
    """Return the columns of a CSV that were named; None when nothing was."""
    from ou_monitor.recordings.importers.log import CsvColumns

    given = {name: getattr(args, option) for name, option in _COLUMNS.items()
             if getattr(args, option, None) is not None}
    return CsvColumns(**given) if given else None


def repeated(args: argparse.Namespace, *names: str) -> list[str]:
    """Return the words of a command line that repeat how a recording is read."""
    words: list[str] = []
    given: list[tuple[str, Any]] = [
        ('--from', getattr(args, 'start', None)), ('--to', getattr(args, 'end', None))]
    given += [('--' + name.replace('_', '-'), getattr(args, name, None))
              for name in (*names, *_TOPICS)]
    for option, value in given:
        if value is not None:
            words += [option, str(value)]
    return words + (['--partial'] if args.partial else [])


def command_line(args: argparse.Namespace, command: str, *names: str) -> str:
    """Return the command that repeats this one, with some of its options."""
    return shlex.join(['ou-monitor', command, args.recording, *repeated(args, *names)])


def given(option: str, text: str, read: Callable[[str], Number]) -> Number:
    """Return the number of an option, as one of `options` reads it."""
    try:
        return read(text)
    except argparse.ArgumentTypeError as error:
        raise InputError(f'{option}: {error}') from None


def brownout_limit(args: argparse.Namespace) -> float | None:
    """Return the limit of ``--brownout-voltage`` and ``--cells``, V; None when there is none."""
    if args.brownout_voltage is None:
        return None if args.cells is None else args.cells * CELL_LIMIT
    voltage = given('--brownout-voltage', args.brownout_voltage, POSITIVE)
    if args.cells is None:
        return voltage
    if voltage > _CELL_MOST:
        raise InputError(
            f'--brownout-voltage: with --cells {args.cells} it is volts a cell, and no cell has '
            f'{voltage:g} V: write {voltage / args.cells:.3g}, or leave --cells out')
    return float(args.cells * voltage)


def limit_given(args: argparse.Namespace) -> dict[str, Any]:
    """Return the limit and the cells as the functions of `ou_monitor.bench` take them."""
    return {'brownout_voltage': brownout_limit(args), 'cells': args.cells or 0}


def throttle_levels(text: str | None) -> tuple[float, ...] | None:
    """Return the levels of ``--levels 0,0.05,...``, in order; None when not given."""
    if text is None:
        return None
    throttle = number('a throttle between 0 and 1; write 5 % as 0.05 and separate levels by '
                      'commas', lambda value: 0.0 <= value <= 1.0)
    ordered = sorted(given('--levels', word.strip(), throttle) for word in text.split(','))
    if any(high - low < 1e-6 for low, high in zip(ordered, ordered[1:])):
        raise InputError(f"--levels: a level is given twice in '{text}'")
    return tuple(ordered)


def part_of_recording(start: str | None, end: str | None) -> tuple[float | None, float | None]:
    """Return the ends of ``--from`` and ``--to``, s; None where there is none."""
    first, last = (None if text is None else given(option, text, TIME)
                   for option, text in (('--from', start), ('--to', end)))
    if first is not None and last is not None and not first < last:
        raise InputError(f'--from {start} is not before --to {end}')
    return first, last
