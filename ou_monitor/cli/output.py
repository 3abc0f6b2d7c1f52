"""Output of commands: text and progress on the terminal, JSON and other files."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import json
import os
from pathlib import Path
import shlex
import shutil
import sys
import time
from typing import Any, TYPE_CHECKING

from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.report.document import Document
    from ou_monitor.report.result import Result

# Seconds, and share of the work, after which the remaining time is estimated.
_FIRST, _LEAST = 2.0, 0.02


class Progress:
    """Progress bar of a command on standard error, if that is a terminal."""

    def __init__(self, label: str) -> None:
        self._label = label
        self._live = sys.stderr.isatty()
        self._drawn_at = 0.0
        # Time and value of the first share, which may include results of an earlier run.
        self._first: tuple[float, float] | None = None

    def __call__(self, share: float) -> None:
        """Show that `share`, 0..1, is done."""
        now = time.monotonic()
        self._first = self._first or (now, share)
        if not self._live or (now - self._drawn_at < 0.1 and share < 1.0):
            return
        self._drawn_at = now
        left = self._remaining_time(share, now)
        width = min(40, shutil.get_terminal_size().columns - len(self._label) - 12 - len(left))
        full = int(width * min(max(share, 0.0), 1.0))
        bar = f"[{'#' * full}{'.' * (width - full)}] " if width >= 5 else ''
        self._write(f'\r{self._label} {bar}{share:4.0%}{left}\x1b[K')

    def _remaining_time(self, share: float, now: float) -> str:
        """Return the remaining time, estimated from the share done; '' if it is too early."""
        began, first = self._first or (now, share)
        passed, done = now - began, share - first
        if done < _LEAST or share >= 1.0 or passed < _FIRST:
            return ''
        return f', {duration(passed * (1.0 - share) / done)} left'

    @staticmethod
    def _write(text: str) -> None:
        # A closed stream must not stop the work.
        with suppress(OSError, ValueError):
            sys.stderr.write(text)
            sys.stderr.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        """Erase the bar."""
        if self._drawn_at:
            self._write('\r\x1b[K')
        self._live, self._drawn_at = False, 0.0


def duration(seconds: float) -> str:
    """Return an estimated time in words."""
    if seconds < 90.0:
        return f'{max(1, round(seconds))} s'
    return f'{round(seconds / 60.0)} min' if seconds < 5400.0 else f'{seconds / 3600.0:.1f} h'


STDOUT = '-'
_NO_FILE = 'No file was written: --report FILE.html saves a report, --json FILE the numbers.'
# Files of a rosbag2 folder, beside its metadata.yaml: storage files, compressed or not.
_STORAGE = ('.mcap', '.db3', '.zst', '.zstd', '.lz4')


# Endings that the name of a bag must not have, because they promise another format.
_NO_BAG = ('.bag', '.bbl', '.bfl', '.bin', '.csv', '.db3', '.json', '.log', '.txt', '.ulg',
           '.yaml', '.yml')


def write_json(data: Mapping[str, Any], target: str, force: bool = False) -> None:
    """Write strict JSON; `force` overwrites."""
    # Imported here, so that `--help` needs no NumPy.
    from ou_monitor.records import plain_data

    # ASCII, because it fits every encoding of standard output, and escapes invalid file names.
    text = json.dumps(plain_data(data), indent=2, allow_nan=False)
    if target == STDOUT:
        say(text)
    else:
        write_text(text + '\n', target, force)


def say(text: str, end: str = '\n') -> None:
    """Write to standard output, at once."""
    try:
        sys.stdout.write(text + end)
        sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        abandon_stdout()
        raise InputError(
            f'cannot write to standard output: {error.strerror or error}') from error


def abandon_stdout() -> None:
    """Discard what is left in the buffer, so that the flush at exit cannot fail."""
    # Standard output without a file descriptor, as in a test, needs nothing.
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def write_text(text: str, target: str | Path, force: bool = False) -> None:
    """Write a text file in UTF-8; `force` overwrites."""
    from ou_monitor.stream.files import write_whole

    # A file name may hold bytes that are not valid text.
    path, content = Path(target), text.encode('utf-8', 'backslashreplace')
    if not _is_device(path):
        write_whole(path, content, over=force)
        return
    try:
        # Without blocking, so that a FIFO without a reader fails instead of waiting for one.
        with open(path, 'wb', opener=lambda name, flags: os.open(
                name, os.O_WRONLY | os.O_NONBLOCK)) as file:
            os.set_blocking(file.fileno(), True)
            file.write(content)
    except OSError as error:
        raise InputError(f"cannot write '{target}': {error.strerror or error}") from error


def given(text: str) -> str:
    """Return a path as given; refuse an empty one (it means the current folder)."""
    if not text:
        raise argparse.ArgumentTypeError('the path is empty')
    return text


def path_argument(text: str) -> Path:
    return Path(given(text))


def check_paths(inputs: Mapping[str, str | Path | None],
                outputs: Mapping[str, str | Path | None], force: bool = False) -> None:
    """Refuse outputs that would overwrite an input, each other, or (without force) any file."""
    written = [(name, Path(target)) for name, target in outputs.items()
               if target is not None and str(target) != STDOUT and not _is_device(Path(target))]
    for k, (name, target) in enumerate(written):
        for source, path in inputs.items():
            if path is not None and _overwrites(target, Path(path)):
                raise InputError(f"{name} '{target}' would overwrite {source} '{path}', which "
                                 'is read: give another name')
        for other, earlier in written[:k]:
            if _is_same_file(target, earlier):
                raise InputError(f"{other} and {name} are both '{target}': give each its own "
                                 'name')
            inner, outer = sorted((_real(target), _real(earlier)),
                                  key=lambda path: -len(path.parts))
            if outer in inner.parents and (
                    not outer.is_dir() or (outer / 'metadata.yaml').exists()):
                raise InputError(f"{other} and {name}: '{inner.name}' would lie in the bag "
                                 f"'{outer.name}': give it a name elsewhere")
    for name, target in written:
        # `check_writable` reports a folder in place of a file.
        if os.path.lexists(target) and not target.is_dir() and not force:
            raise _existing(f"{name} '{target}'")


def _existing(what: str) -> InputError:
    return InputError(f'{what} exists already: --force overwrites it, or give another name')


def check_bag(name: str, bag: Path, force: bool) -> None:
    """Refuse a bag that cannot be written, before the work starts (`replacing` checks again)."""
    if bag.suffix.lower() in _NO_BAG:
        raise InputError(f"{name} '{bag}': {bag.suffix} is not written; give NAME.mcap for one "
                         'file, or NAME for a rosbag2 folder')
    if not force and (bag.exists() or bag.is_symlink()):
        raise _existing(f"{name} '{bag}'")
    check_folder(bag)


@contextmanager
def replacing(bag: Path | None, force: bool) -> Iterator[None]:
    """Move an existing bag aside while a new one is written; restore it after an error."""
    if bag is None or not (bag.exists() or bag.is_symlink()):
        yield
        return
    if not force:
        raise _existing(f"'{bag}'")
    from ou_monitor.recordings.bag import read_metadata, remove_bag

    if bag.is_dir() and not bag.is_symlink():
        files: list[Path] = []
        with suppress(InputError):
            files, _ = read_metadata(bag)
        if not files or {*bag.iterdir()} != {bag / 'metadata.yaml', *files}:
            raise InputError(f"'{bag}' is a folder that holds no bag, or more than a bag: it is "
                             'not overwritten')
    elif not bag.is_symlink() and not bag.is_file():
        raise InputError(f"'{bag}' is neither a file nor a folder: it is not overwritten")
    aside = bag.with_name(f'.{bag.name}.{os.getpid()}.old')
    os.rename(bag, aside)
    try:
        yield
    except BaseException:
        os.rename(aside, bag)
        raise
    if aside.is_dir() and not aside.is_symlink():
        remove_bag([aside / file.name for file in files], aside)
    else:
        aside.unlink()


def _is_device(path: Path) -> bool:
    """Return whether a path is a device, such as /dev/null, where nothing is overwritten."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _real(path: Path) -> Path:
    """Return a path with links resolved; a loop of links, which `resolve` refuses, is kept."""
    return Path(os.path.realpath(path))


def _is_same_file(first: Path, second: Path) -> bool:
    if _real(first) == _real(second):
        return True
    return first.exists() and second.exists() and first.samefile(second)


def _overwrites(target: Path, source: Path) -> bool:
    """Return whether writing the target would harm the source (a file, or a bag's folder)."""
    if _is_same_file(target, source) or target.is_dir() and _real(target) in _real(source).parents:
        return True
    if not source.is_dir() or _real(source) not in _real(target).parents:
        return False
    name = _real(target).name.lower()
    return name == 'metadata.yaml' or name.endswith(_STORAGE)


def check_writable(target: str | Path | None) -> None:
    """Refuse an output that cannot be written, before the work starts."""
    if target is None or str(target) == STDOUT:
        return
    path = Path(target)
    if path.is_dir():
        raise InputError(f"cannot write '{target}': it is a folder; name a file in it")
    check_folder(path)


def check_folder(path: Path) -> None:
    """Refuse an output in a folder that does not exist."""
    if not path.parent.is_dir():
        raise InputError(f"cannot write '{path}': the folder '{path.parent}' does not exist")


def deliver(args: argparse.Namespace, found: Result, report: str | Path | None = None,
            **files: object) -> None:
    """Write a result to the page, JSON file and terminal that the arguments name."""
    # The caller has checked the path of a `report`, so an existing page is overwritten.
    force = args.force or report is not None
    report = report or getattr(args, 'report', None)
    document = found.document()
    if report is not None:
        from ou_monitor.report.page import html
        write_text(html(document, shlex.join(['ou-monitor', *args.words])), report, force)
    tell(args, document, found.to_dict)
    if args.json != STDOUT:
        summary(document.answer, **files, report=report, json=args.json)


def tell(args: argparse.Namespace, document: Document,
         data: Callable[[], Mapping[str, Any]]) -> None:
    """Write a command's result to the terminal, and its data to the file of --json."""
    from ou_monitor.report.terminal import terminal

    if args.json is not None:
        write_json(data(), args.json, args.force)
    if args.json != STDOUT:
        say(terminal(document))


def summary(answer: Sequence[str], **files: object) -> None:
    """Print the last lines: two sentences of the answer, and the files written."""
    from ou_monitor.report.terminal import paragraph

    made = {name: path for name, path in files.items()
            if path is not None and str(path) != STDOUT}
    if len(made) > 1:
        made.pop('json', None)
    last = '; '.join(f'{name.capitalize()}: {path}' for name, path in made.items())
    say('\n' + '\n'.join([*map(paragraph, answer[:2]), last or paragraph(_NO_FILE)]))
