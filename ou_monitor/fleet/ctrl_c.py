"""
Loaded by each local worker first: Ctrl-C is for the main process.

A terminal sends it to the whole group; the main process ends its workers
itself, and their words about it would only hide its own.
"""

from __future__ import annotations

from contextlib import suppress
import signal
from typing import Any


def dask_setup(worker: Any) -> None:
    """Ignore Ctrl-C; Dask calls this when the worker starts, in its main thread."""
    with suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
