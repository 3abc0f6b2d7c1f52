"""
The table of file formats, identified by their first bytes, and the entry point to importers.

To add a format, add a module here with ``read(path, request) -> Log``, and a line in the table.
"""

from __future__ import annotations

import codecs
from collections.abc import Callable
from contextlib import redirect_stderr, suppress
from dataclasses import replace
import enum
from importlib import import_module
from pathlib import Path
import shlex
import sys
from typing import NamedTuple

import numpy as np
from ou_monitor.errors import how_to_install, InputError
from ou_monitor.recordings.importers.log import Log, Progress, quiet, Request
from ou_monitor.records import defect_of, Note
from ou_monitor.stream.files import opened, plain_texts
from ou_monitor.text import printable

# Number of first bytes that identify a format; a dataflash text log starts with FMT messages.
HEAD = 8192

MAGIC = b'\x89MCAP0\r\n'
ULOG = b'ULog\x01\x12\x35'
DATAFLASH = b'\xa3\x95\x80'
BLACKBOX = b'H Product:Blackbox flight data recorder'
# Maximum share of NUL bytes in damaged text; tables of binary numbers have more.
_NULS = 0.05


class Format(NamedTuple):
    """One format."""

    name: str  # Short name
    words: str  # What it is, with its usual ending
    fits: Callable[[bytes], bool]  # Whether a file with these first bytes has this format
    module: str  # Name of the module that reads it, beside this one; empty: not a log
    package: str = ''  # Package needed beyond the core; an extra of the module's name installs it
    several: bool = False  # Whether a file may hold several flights


def is_text(head: bytes) -> bool:
    mark = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    if mark or head[1:2] == b'\0' != head[:1] and head[3:4] == b'\0':
        # "Unicode text" of spreadsheets, whose cells use only the first 256 characters.
        head = head[2 * mark:].replace(b'\0', b'')
    # Damaged cells, and text that is not UTF-8, pass: the reader can then name their line.
    return bool(head) and (head[0] < 0x80 or b'\n' in head) and head.count(
        b'\0') <= _NULS * len(head) and all(
            byte >= 0x20 or byte in b'\0\t\n\r\f' for byte in head)


def _is_crazyflie(head: bytes) -> bool:
    # 0xBC, version 1 or 2, and the number of events: at most 20 in the firmware, 255 here.
    return len(head) > 5 and head[0] == 0xBC and head[1:3] in (b'\1\0', b'\2\0') and (
        0 < int.from_bytes(head[3:5], 'little') <= 255)


BAG, CSV = 'mcap', 'csv'
# The first that fits is taken.
FORMATS = (
    Format(BAG, 'MCAP bag (.mcap)', lambda head: head.startswith(MAGIC), ''),
    Format('ulog', 'PX4 ULog (.ulg)', lambda head: head.startswith(ULOG), 'ulog', 'pyulog'),
    Format('dataflash', 'ArduPilot dataflash (.bin)', lambda head: head.startswith(DATAFLASH),
           'dataflash', 'pymavlink'),
    Format('dataflash_text', 'ArduPilot dataflash as text (.log)',
           lambda head: is_text(head) and (head.startswith(b'FMT,') or b'\nFMT,' in head),
           'dataflash', 'pymavlink'),
    Format('blackbox', 'Betaflight or INAV blackbox (.bbl, .bfl)',
           lambda head: head.startswith(BLACKBOX), 'blackbox', 'orangebox', True),
    Format('crazyflie', 'Crazyflie micro-SD log', _is_crazyflie, 'crazyflie'),
    Format(CSV, 'CSV (.csv, .txt, .tsv)', is_text, 'csv_table'),
)


def format_of(head: bytes) -> Format | None:
    """Return the format of a file by its first bytes."""
    return next((one for one in FORMATS if head and one.fits(head)), None)


class Foreign(enum.Enum):
    """What is known of a file that is not MCAP."""

    NAMED = enum.auto()
    TEXT = enum.auto()
    UNKNOWN = enum.auto()


# First bytes -> what it is, and what to do.
_FOREIGN = {
    b'SQLite format 3': "an SQLite rosbag2 (.db3): convert it with 'ros2 bag convert' to the "
                        'storage mcap',
    b'#ROSBAG': "a ROS 1 bag: convert it with 'rosbags-convert'",
    b'\x28\xb5\x2f\xfd': "compressed as a whole: unpack it with 'zstd -d' first",
    b'PK\x03\x04': 'a ZIP archive, or a workbook of Excel (.xlsx): unpack it, or save it as CSV',
    b'\xd0\xcf\x11\xe0': 'a workbook of Excel (.xls): save it as CSV',
    b'\x1f\x8b': "compressed: unpack it with 'gunzip' first",
    b'<SALEAE>': 'a binary export of Saleae Logic: export it as CSV',
    b'AG10': 'a binary export of a Keysight oscilloscope: save it as CSV',
    b'RG01': 'a binary export of a Rigol oscilloscope: save it as CSV',
    b'PAR1': 'Parquet: save it as CSV', b'\x89HDF': 'HDF5: save it as CSV',
    b'MATLAB 5.0': 'a MAT file of MATLAB: save it as CSV', b'{"': 'JSON: export a CSV',
    b'<?xml': 'XML: export a CSV', b'%PDF': 'a PDF', b'\x89PNG': 'a picture',
    b'\xff\xd8\xff': 'a picture', b'<!DOCTYPE': 'a web page, not the file behind it',
    b'<!doctype': 'a web page, not the file behind it',
    b'<html': 'a web page, not the file behind it'}


def kind_of_foreign(head: bytes, path: Path = Path('LOG')) -> tuple[Foreign, str]:
    """Return the likely kind of a file that is not MCAP, and in words what to do with it."""
    for begin, words in _FOREIGN.items():
        if head.lstrip(b'\xef\xbb\xbf \t\r\n').startswith(begin):
            return Foreign.NAMED, f'it is {words}'
    log = format_of(head)
    if log is not None and log.name not in (BAG, CSV):
        command = shlex.join(['ou-monitor', 'convert', str(path), path.stem])
        return Foreign.NAMED, (f'it is a log, {log.words}, not a bag: convert it first, with '
                               f'{command}')
    if head[:1] and all(byte in b'\t\n\r' or 32 <= byte < 127 for byte in head):
        return Foreign.TEXT, ('it is text; if it is a table of time and voltage, name it '
                              'NAME.csv')
    return Foreign.UNKNOWN, 'its first bytes are ' + (head[:8].hex(' ') or 'missing')


def detect(path: Path) -> Format:
    """Return the format of a file, whatever its name ends in."""
    if path.is_dir():
        raise InputError(f"'{path}' is a folder: name a log file")
    if not path.exists():
        raise InputError(f"there is no log '{path}': check the path")
    with opened(path) as file:
        head = file.read(HEAD)
    if not head:
        raise InputError(f"'{path}' is empty: there is nothing to convert")
    found = format_of(head)
    if found is not None:
        return found
    raise InputError(f"'{path}' cannot be converted: it has none of the formats that can be "
                     'read: ' + '; '.join(one.words for one in FORMATS if one.module))


# Endings of bags and their metadata; text with any other ending is read as a table.
_OF_BAGS = ('.mcap', '.db3', '.bag', '.yaml', '.yml')


def kind_of(path: Path) -> str:
    """Return the name of the format in which a recording is read: CSV, a log's, or BAG."""
    found, ending = None, path.suffix.lower()
    # If the file cannot be read, the reader reports why.
    with suppress(InputError):
        found = detect(path) if path.is_file() else None
    if found is None:
        return CSV if ending == '.csv' and not path.is_dir() else BAG
    return BAG if found.name == CSV and ending in _OF_BAGS else found.name


def import_log(path: Path, request: Request) -> Log:
    """Read a log."""
    form = detect(path)
    if form.name == BAG:
        raise InputError(f"'{path}' is an MCAP bag already: analyze, discover and replay take it")
    if not form.several and request.flight not in (None, 1):
        raise InputError(f'{path} holds one flight, so --flight {request.flight} does not exist')
    try:
        module = import_module(f'{__package__}.{form.module}')
    except ImportError as error:
        # Explain only a missing extra; do not hide errors of this package.
        if not form.package or (error.name or '').split('.')[0] != form.package:
            raise
        raise InputError(
            f"'{path}' is {form.words}: reading it needs {form.package}: "
            f'{how_to_install(form.module)}') from error
    if request.progress is not None:
        request = replace(request, progress=_terminal_progress(request.progress))
    # Damaged bytes may give numbers that overflow (ignored) and any exception (caught by `quiet`).
    with np.errstate(all='ignore'), quiet(path, form.package or 'ou_monitor'):
        log: Log = module.read(path, request)
    # Make names printable: they reach messages, tables and bags.
    return replace(
        log, series=tuple(replace(one, name=printable(one.name, 200), words=printable(one.words),
                                  scale=printable(one.scale), own_unit=printable(one.own_unit))
                          for one in log.series),
        facts=plain_texts(log.facts), notes=tuple(
            Note(printable(note), defect_of(note)) for note in log.notes),
        names=tuple(printable(name, 200) for name in log.names))


def _terminal_progress(progress: Progress) -> Progress:
    """Return a function that shows progress while the output of parsers is suppressed."""
    terminal = sys.stderr

    def show(share: float) -> None:
        with redirect_stderr(terminal):
            progress(share)
    return show
