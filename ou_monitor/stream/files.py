"""
Read and write files that users name: regular ones only, and YAML of bounded size and shape.

A FIFO or a device is refused before a byte is read.  Errors about YAML are one line of at most
300 characters and quote nothing of the file, which may have been named by mistake.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BufferedReader
import os
from pathlib import Path
import re
import stat
from typing import Any, BinaryIO

from ou_monitor.errors import InputError
from ou_monitor.text import printable
import yaml

# Maximum length of an error line, and of the path in it.
MOST_CHARACTERS = 300
_MOST_OF_PATH = 150

# Maximum size of a YAML file: a model file has some kB.  PyYAML takes 2 to 5 s for 1 MB.
MOST_BYTES = 1_000_000
# Maximum number of values, and depth.
MOST_NODES = 20_000
MOST_DEPTH = 64
# Maximum digits of a number: the largest float64 has 309, and conversion takes quadratic time.
MOST_DIGITS = 400


def path_words(path: str | Path) -> str:
    """Return a path for a message, shortened in its middle."""
    return printable(path, _MOST_OF_PATH)


def plain_texts(found: Any) -> dict[str, str]:
    """Return the metadata of a recording as names and texts of one line each."""
    return {printable(key, 100): printable(value, 1000)
            for key, value in list(found.items())[:1000]}


def open_regular(path: str | Path) -> BufferedReader:
    """Open a file to read, never waiting for a FIFO; OSError if it is not a regular file."""
    file = open(path, 'rb', opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
    if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
        file.close()
        raise OSError(0, 'it is not a regular file', str(path))
    return file


@contextmanager
def opened(path: Path) -> Iterator[BinaryIO]:
    """Open as `open_regular`; errors of opening and reading become InputErrors."""
    try:
        with open_regular(path) as file:
            yield file
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror}') from error


def write_whole(path: Path, content: bytes, *, over: bool = True) -> None:
    """Write a file completely or not at all; replace an existing one only with `over`."""
    draft = path.with_name(f'.{path.name}.{os.getpid()}.draft')
    try:
        # The draft's name may be taken by a FIFO, which would block, or by a link.
        draft.unlink(missing_ok=True)
        draft.write_bytes(content)
        if not over:
            # Reserve the name: this fails if a file has appeared since the output was checked.
            os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL))
        os.replace(draft, path)
    except OSError as error:
        # Removing the draft may fail for the same reason.
        with suppress(OSError):
            draft.unlink(missing_ok=True)
        raise InputError(f"cannot write '{path}': {error.strerror or error}") from error


def read_yaml(path: str | Path, what: str, *, most_bytes: int = MOST_BYTES,
              most_nodes: int = MOST_NODES) -> Any:
    """Return the content of a YAML file; `what` names its kind in one-line errors."""
    where = path_words(path)
    try:
        with open_regular(path) as file:
            data = file.read(most_bytes + 1)
    except (OSError, ValueError) as error:
        why = (error.strerror if isinstance(error, OSError) else None) or 'it is not a path'
        raise InputError(f'cannot read {what} {where}: {why}') from error
    if len(data) > most_bytes:
        raise InputError(f'cannot read {what} {where}: it holds more than '
                         f'{most_bytes / 1e6:g} MB')
    try:
        text = data.decode('utf-8-sig')
    except UnicodeDecodeError as error:
        raise InputError(f'{where} is not YAML that can be read: byte {error.start} is not '
                         'UTF-8') from error
    try:
        loader = _BoundedLoader(text, most_nodes)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except yaml.reader.ReaderError as error:
        why = f'character {error.position} is not allowed in YAML'
    except yaml.MarkedYAMLError as error:
        why = _without_content(error)
    raise InputError(f'{where} is not YAML that can be read: {why}') from None


@contextmanager
def one_line() -> Iterator[None]:
    """Limit the length of an InputError about the content of a YAML file."""
    try:
        yield
    except InputError as error:
        raise InputError(printable(error, MOST_CHARACTERS)) from error


def _without_content(error: yaml.MarkedYAMLError) -> str:
    """Return the place and reason of a YAML error, without PyYAML's quotes of the file."""
    why = re.split(r'[\'":<]|,? but found', error.problem or '')[0].strip()
    if why in ('', 'found character', 'expected'):
        why = 'unexpected content'
    mark = error.problem_mark or error.context_mark
    return why if mark is None else f'{why} (line {mark.line + 1}, column {mark.column + 1})'


class _BoundedLoader(yaml.SafeLoader):
    """PyYAML's safe loader: each key once, no aliases, limits on depth, nodes and digits."""

    def __init__(self, text: str, most_nodes: int) -> None:
        super().__init__(text)
        self._most_nodes = most_nodes
        self._nodes = self._depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Compose a node and count it; refuse an alias, of which a few stand for 10^12 values."""
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            self._refuse('it has an alias: write the value in its place', event)
        self._nodes += 1
        if self._nodes > self._most_nodes:
            self._refuse(f'it holds more than {self._most_nodes} values', event)
        self._depth += 1
        if self._depth > MOST_DEPTH:
            self._refuse(f'it is nested more than {MOST_DEPTH} deep', event)
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def compose_mapping_node(self, anchor: Any) -> Any:
        """Compose a mapping; refuse a repeated key, of which YAML would take the last."""
        node = super().compose_mapping_node(anchor)
        known = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in known:
                    self._refuse('a key occurs twice', key)
                known.add((key.tag, key.value))
        return node

    def construct_object(self, node: Any, deep: bool = False) -> Any:
        """Construct a node; refuse numbers with too many digits, and impossible values."""
        if isinstance(node, yaml.ScalarNode) and len(node.value) > MOST_DIGITS and (
                node.tag in ('tag:yaml.org,2002:int', 'tag:yaml.org,2002:float')):
            self._refuse(f'a number has more than {MOST_DIGITS} digits', node)
        try:
            return super().construct_object(node, deep)
        except (ValueError, OverflowError, TypeError, LookupError, AttributeError):
            # PyYAML passes on Python's errors for a value that does not fit its tag.
            self._refuse('a value is impossible or does not fit its tag', node)

    def _refuse(self, why: str, at: Any) -> None:
        raise yaml.composer.ComposerError(None, None, why, at.start_mark)
