"""`ou-monitor coupling RECORDING --signal NAME`: supply noise in a signal."""

from __future__ import annotations

import argparse
import math
import shlex
from typing import Any

from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, read_given_beside, repeated)
from ou_monitor.coupling.coupling import Coupling, estimate_coupling
from ou_monitor.errors import InputError


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    band, level, limit = _band(args.band), _level(args.level), brownout_limit(args)
    start, end = part_of_recording(args.start, args.end)

    from ou_monitor.analysis.overview import overview
    from ou_monitor.recordings.importers.log import UNKNOWN
    from ou_monitor.report.coupling_document import coupling_document
    from ou_monitor.timeline.line import readings_of

    recording, series = read_given_beside(args, start, end)
    limit = limit_of(args, recording, limit)
    t, values = series.t, series.values
    unit = '' if series.unit == UNKNOWN else series.unit
    if start is not None or end is not None:
        # What lies outside the part has no voltage beside it, and is not counted as dropped.
        part = (t >= recording.t[0]) & (t <= recording.t[-1])
        t, values = t[part], values[part]
    try:
        found = estimate_coupling(recording.t, recording.voltage, t, values,
                                  throttle=recording.throttle, band=band, level=level)
    except InputError as error:
        raise InputError(f"'{args.recording}', signal '{args.signal}': {error}") from error
    # From here on as `analyze` reads it.
    recording = readings_of(recording)
    seen = overview(recording, limit, cells=args.cells or 0)
    output.deliver(
        args, coupling_document(found, recording, (t, values), args.signal, unit, seen,
                                command_line(args)),
        {**as_data(found, recording.name, args.signal, unit, recording.notes),
         'supply': seen.facts.to_dict()})
    return 0


def as_data(found: Coupling, name: str, signal: str, unit: str, notes: tuple[str, ...],
            ) -> dict[str, Any]:
    """Return the result for JSON."""
    return {
        'recording': name, 'signal': signal, 'signal_unit': unit or None, 'seen': found.seen,
        'p_value': found.p_value, 'level': found.level,
        'gain_per_v': found.gain, 'gain_ci95': found.gain_ci95,
        'gain_limit_per_v': found.limit, 'lag_s': found.lag, 'lag_se_s': found.lag_se,
        'share_of_signal': found.noise_share, 'narrow': found.narrow,
        'signal_leads': found.signal_leads, 'throttle_taken_out': found.partial,
        'segments': found.segments, 'duration_s': found.grid.duration,
        'rate_hz': found.grid.rate, 'voltage_rate_hz': found.grid.rates[0],
        'signal_rate_hz': found.grid.rates[1], 'gaps': found.grid.gaps,
        'dropped': {'voltage': found.grid.lost[0], 'signal': found.grid.lost[1]},
        'frequency_hz': found.frequency, 'coherence': found.coherence,
        'coherence_threshold': found.threshold, 'gain_by_frequency': abs(found.response),
        'notes': [*notes, *found.notes]}


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this."""
    return shlex.join(['ou-monitor', 'coupling', args.recording, *repeated(
        args, 'signal', 'band', 'level', 'brownout_voltage', 'cells')])


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


def _level(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0.0 < value < 1.0:
        raise InputError(f"--level: '{text}' is not a probability between 0 and 1")
    return value
