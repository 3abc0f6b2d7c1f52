"""Arguments that several commands share: how they are announced, read, and said again."""

from __future__ import annotations

import argparse
import math
from typing import Any, TYPE_CHECKING

from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.records import Recording

_NAN = float('nan')


# Options of the topics, by the names that the parser gives them.
_TOPICS = ('msg_config', 'voltage_topic', 'throttle_topic')


def add_recording(parser: argparse.ArgumentParser) -> None:
    """Announce RECORDING."""
    parser.add_argument(
        'recording', metavar='RECORDING',
        help='.mcap file, rosbag2 folder, or CSV with columns time_s, voltage_v[, throttle]')


def add_part(parser: argparse.ArgumentParser) -> None:
    """Announce ``--from`` and ``--to``."""
    parser.add_argument('--from', metavar='S', dest='start',
                        help='leave out what comes before, s after the first message')
    parser.add_argument('--to', metavar='S', dest='end',
                        help='leave out what comes from here on, s after the first message')


def add_topics(parser: argparse.ArgumentParser) -> None:
    """Announce what says how bags are read: the topics, and ``--partial``."""
    parser.add_argument('--msg-config', metavar='NAME',
                        help='msg_config that says which topic and field is the voltage')
    parser.add_argument('--voltage-topic', metavar='TOPIC', help='topic of the voltage')
    parser.add_argument('--throttle-topic', metavar='TOPIC', help='topic of the throttle')
    parser.add_argument('--partial', action='store_true',
                        help='use what a truncated file still holds')


def add_estimate(parser: argparse.ArgumentParser, voltage: str) -> None:
    """Announce ``--window``, ``--brownout-voltage`` and ``--brownout-horizon``."""
    parser.add_argument('--window', metavar='S', default='2.0',
                        help='window of the sliding estimate, s (default: 2.0)')
    parser.add_argument('--brownout-voltage', metavar='V', help=voltage)
    parser.add_argument('--brownout-horizon', metavar='S', default='5.0',
                        help='horizon of that risk, s (default: 5.0)')


def add_json(parser: argparse.ArgumentParser) -> None:
    """Announce ``--json``."""
    parser.add_argument('--json', metavar='FILE',
                        help="write the result as JSON ('-': to standard output, alone)")


def read_given(args: argparse.Namespace, start: float | None, end: float | None) -> Recording:
    """Read RECORDING as the arguments say, with a progress bar (start, end in s)."""
    from ou_monitor.cli import output
    from ou_monitor.recordings.read import read_recording

    with output.Progress('reading') as progress:
        return read_recording(
            args.recording, msg_config=args.msg_config, voltage_topic=args.voltage_topic,
            throttle_topic=args.throttle_topic, partial=args.partial, start=start, end=end,
            progress=progress)


def said_again(args: argparse.Namespace, *names: str) -> list[str]:
    """Return the words of a command line that repeat how a recording is read."""
    words: list[str] = []
    given: list[tuple[str, Any]] = [
        ('--from', getattr(args, 'start', None)), ('--to', getattr(args, 'end', None))]
    given += [('--' + name.replace('_', '-'), getattr(args, name)) for name in (*names, *_TOPICS)]
    for option, value in given:
        if value is not None:
            words += [option, str(value)]
    return words + (['--partial'] if args.partial else [])


def positive_number(option: str, text: str) -> float:
    """Return the number of an option."""
    try:
        value = float(text)
    except ValueError:
        value = _NAN
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{option}: '{text}' is not a positive number")
    return value


def throttle_levels(text: str | None) -> tuple[float, ...] | None:
    """Return the levels of ``--levels 0,0.05,...``, in order; None when not given."""
    if text is None:
        return None
    levels = []
    for word in text.split(','):
        try:
            value = float(word)
        except ValueError:
            value = _NAN
        if not 0.0 <= value <= 1.0:
            raise InputError(f"--levels: '{word.strip()}' is not a throttle between 0 and 1; "
                             'write 5 % as 0.05 and separate levels by commas')
        levels.append(value)
    ordered = sorted(levels)
    if any(high - low < 1e-6 for low, high in zip(ordered, ordered[1:])):
        raise InputError(f"--levels: a level is given twice in '{text}'")
    return tuple(ordered)


def part_of_recording(start: str | None, end: str | None) -> tuple[float | None, float | None]:
    """Return the ends of ``--from`` and ``--to``, s; None where there is none."""
    found: list[float | None] = []
    for option, text in (('--from', start), ('--to', end)):
        try:
            value = None if text is None else float(text)
        except ValueError:
            value = _NAN
        if value is not None and not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{option}: '{text}' is not a time in seconds, 0 or more")
        found.append(value)
    first, last = found
    if first is not None and last is not None and not first < last:
        raise InputError(f'--from {start} is not before --to {end}')
    return first, last
