"""
A log as a bag of the time being: so `analyze LOG` says what `convert` and `analyze BAG` say.

Limits first: the log is read whole; the battery's voltage, the throttle and the current are those
that `convert` takes unasked, and what the logger repeats is dropped as by its --drop-held.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
import tempfile

from ou_monitor.recordings.importers.choose import choose, drop_held
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request
from ou_monitor.recordings.write_log import write_log
from ou_monitor.records import Recording


@contextmanager
def log_as_bag(path: Path, *, flight: int | None = None, voltage: str | None = None,
               throttle: str | None = None,
               progress: Callable[[float], None] | None = None,
               ) -> Iterator[tuple[Path, Callable[[Recording], Recording]]]:
    """Yield the bag of a log, and what gives a recording of it the name and notes of the log."""
    log = import_log(path, Request(
        flight, frozenset(one for one in (voltage, throttle) if one), progress=progress))
    chosen = choose(path, log, voltage=voltage, throttle=throttle, option='--{}-column')
    volts, held = drop_held(chosen.voltage)
    chosen = replace(chosen, voltage=volts)

    def named(recording: Recording) -> Recording:
        source = {'file': path.name, 'format': log.format, 'voltage': volts.name}
        if chosen.throttle is not None:
            source['throttle'] = chosen.throttle.name
        return replace(recording, name=path.name, source={**source, **log.facts},
                       notes=(*log.notes, *chosen.notes, held, *recording.notes))

    with tempfile.TemporaryDirectory(prefix='ou_monitor_') as folder:
        bag = Path(folder) / 'log.mcap'
        write_log(chosen, bag, {})
        yield bag, named
