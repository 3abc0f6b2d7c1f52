"""`ou-monitor coupling RECORDING --signal NAME`: supply noise in a signal."""

from __future__ import annotations

import argparse
from dataclasses import replace
import math

from ou_monitor.bench import coupling
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    check_outputs, command_line, given, limit_given, part_of_recording, read_given_beside)
from ou_monitor.cli.options import number
from ou_monitor.errors import InputError

_LEVEL = number('a probability between 0 and 1', lambda value: 0.0 < value < 1.0)


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    band, level, limit = _band(args.band), given('--level', args.level, _LEVEL), limit_given(args)
    start, end = part_of_recording(args.start, args.end)
    recording, series = read_given_beside(args, start, end)
    t, values = series.t, series.values
    if start is not None or end is not None:
        # Samples outside the part have no voltage; do not count them as dropped.
        part = (t >= recording.t[0]) & (t <= recording.t[-1])
        t, values = t[part], values[part]
    found = coupling(recording, replace(series, name=args.signal, t=t, values=values), band=band,
                     level=level, **limit)
    output.deliver(args, found, command_line(
        args, 'coupling', 'signal', 'band', 'level', 'brownout_voltage', 'cells'))
    return 0


def _band(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        low, high = (float(word) for word in text.split(','))
    except ValueError:
        raise InputError(f"--band: '{text}' is not LOW,HIGH in Hz, such as 10,100") from None
    if not (0.0 < low < high and math.isfinite(high)):
        raise InputError(f"--band: '{text}' must be two frequencies, 0 < LOW < HIGH")
    return low, high
