"""Options that several commands share; imports none of them."""

from __future__ import annotations

import argparse
from collections.abc import Callable
import math
from typing import Any


class Option:
    """Names of an option or of an argument, and what argparse knows of it."""

    def __init__(self, *names: str, **keywords: Any) -> None:
        self.names = names
        self.keywords = keywords


class WithoutOut(argparse.Action):
    """A flag that needs no OUT; an optional positional could not follow an option."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        """Set the flag."""
        setattr(namespace, self.dest, True)
        for action in parser._actions:
            if action.dest == 'out':
                action.required = False


def whole(what: str, low: int, high: float = math.inf, step: int = 1) -> Callable[[str], int]:
    """Return what reads a whole number within a range, a multiple of a step; what: in words."""
    def read(text: str) -> int:
        if not (text.isascii() and text.isdigit() and low <= int(text) <= high
                and int(text) % step == 0):
            raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
        return int(text)
    return read


def number(what: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """Return what reads a number that fits; what: in words."""
    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f"'{text}' is not {what}")
        return value
    return read


FLIGHT = whole('a number from 1 on', 1)
POSITIVE = number('a positive number', lambda value: 0.0 < value < math.inf)
TIME = number('a time in seconds, 0 or more', lambda value: 0.0 <= value < math.inf)

RECORDING = Option(
    'recording', metavar='RECORDING',
    help='.mcap file, rosbag2 folder, CSV of any logger, or a log that convert reads (.bbl, .bin, '
    '.ulg)')
# Which part of a recording is read.
PART = (
    Option('--from', metavar='S', dest='start',
           help='leave out what comes before, s after the first message'),
    Option('--to', metavar='S', dest='end',
           help='leave out what comes from here on, s after the first message'))
# How a bag is read.
TOPICS = (
    Option('--msg-config', metavar='NAME',
           help='msg_config that says which topic and field is the voltage'),
    Option('--voltage-topic', metavar='TOPIC', help='topic of the voltage'),
    Option('--throttle-topic', metavar='TOPIC', help='topic of the throttle'),
    Option('--partial', action='store_true', help='use what a truncated file still holds'))


# How a CSV is written, where it is not read as it should be.
CSV = (
    Option('--time-column', metavar='NAME', help='column of a CSV (default: found by its name)'),
    Option('--unit', choices=('V', 'mV'), help='of the voltage in a CSV (default: found)'),
    Option('--time-unit', choices=('s', 'ms', 'us', 'ns'),
           help='of the time in a CSV (default: found)'),
    Option('--throttle-unit', choices=('1', '%', 'us'),
           help='of the throttle in a CSV: 0..1, percent, or a pulse of 1000 to 2000 us (default: '
           'found)'),
    Option('--sample-interval', metavar='S', type=POSITIVE,
           help='time from row to row of a CSV, s, in place of a column'),
    Option('--delimiter', metavar='C',
           help="what separates the cells of a CSV: a character, 'tab' or 'space' (default: "
           'found)'),
    Option('--decimal', choices=('.', ','), help='decimal mark of a CSV (default: found)'),
    Option('--skip-rows', metavar='N', type=whole('a number of lines, 0 or more', 0),
           help='lines above the header of a CSV (default: found)'))
# How a log or a CSV is read.
FILES = (
    Option('--flight', metavar='N', type=FLIGHT,
           help='which flight of a log with several, from 1 (default: the largest)'),
    Option('--voltage-column', metavar='NAME',
           help='column of a CSV (default: found by its name), or series of a log (default: the '
           'battery)'),
    Option('--throttle-column', metavar='NAME',
           help="column of a CSV or series of a log, or 'none' (default: found)"),
    Option('--current-column', metavar='NAME',
           help="column of a CSV or series of a log, or 'none' (default: found)"),
    *CSV)
JSON = Option(
    '--json', metavar='FILE',
    help="write the result as JSON ('-': to standard output, alone)")
FORCE = Option('--force', action='store_true', help='overwrite files that exist already')
REPORT = Option('--report', metavar='FILE.html', help='write a self-contained HTML page')
# Cells of the largest packs that fly, with room.
_CELLS = whole('a number of cells, 1 to 28', 1, 28)
TYPES = ('battery_state', 'float32', 'float64', 'adc_block')


def seed(default: int, text: str = 'same seed, same result') -> Option:
    """Return the option of a seed."""
    return Option('--seed', metavar='N', type=whole('a whole number, 0 or more', 0),
                  default=default, help=f'{text} (default: %(default)s)')


def levels(found: str) -> Option:
    """Return the option of the load levels; found: what they are without it."""
    return Option('--levels', metavar='0,0.05,...',
                  help=f'throttles 0..1 of the load levels (default: {found})')


def limit(meaning: str) -> tuple[Option, ...]:
    """Return the options of the limit; meaning: what --brownout-voltage does, and its default."""
    return (Option('--brownout-voltage', metavar='V', help=meaning),
            Option('--cells', metavar='N', type=_CELLS,
                   help='cells in series: --brownout-voltage is then volts a cell (default with '
                   '--cells: 3.3)'))


def estimate(voltage: str) -> tuple[Option, ...]:
    """Return the options of the sliding estimate and of the risk."""
    return (
        Option('--window', metavar='S', default='2.0',
               help='window of the sliding estimate, s (default: %(default)s)'),
        *limit(voltage),
        Option('--brownout-horizon', metavar='S', default='5.0',
               help='horizon of that risk, s (default: %(default)s)'))
