"""Parsers that print: their words are caught, and their failures become one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
import io
import logging
import os
from pathlib import Path
import sys

from ou_monitor.errors import InputError


@contextmanager
def quiet(path: Path, parser: str) -> Iterator[io.StringIO]:
    """Catch what a parser prints, and turn any failure of it into an `InputError`."""
    said = io.StringIO()
    logger = logging.getLogger(parser)
    before = logger.disabled, logger.propagate
    logger.propagate = False
    handler = logging.NullHandler()
    logger.addHandler(handler)
    try:
        with redirect_stdout(said), redirect_stderr(said):
            yield said
    except InputError:
        raise
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except Exception as error:
        raise InputError(f'{path} is damaged: it cannot be read with {parser} '
                         f'({type(error).__name__}: {error})') from error
    finally:
        logger.removeHandler(handler)
        logger.disabled, logger.propagate = before


@contextmanager
def quiet_process() -> Iterator[None]:
    """Send standard error nowhere, also for parsers in C, which do not know Python's."""
    sys.stderr.flush()
    kept = os.dup(2)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
