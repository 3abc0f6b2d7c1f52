"""`ou-monitor coupling RECORDING --signal NAME`: supply noise in a signal."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import math
from pathlib import Path
import shlex
from typing import Any, TYPE_CHECKING

from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, columns_given, part_of_recording, read_given, repeated)
from ou_monitor.cli.output import Progress
from ou_monitor.coupling.coupling import (
    Coupling, estimate_coupling, facts, headline, parts, remarks)
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.records import FloatArray, Recording


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    band, level, limit = _band(args.band), _level(args.level), brownout_limit(args)
    start, end = part_of_recording(args.start, args.end)

    from ou_monitor.analysis.overview import answers, known_lines, overview
    from ou_monitor.recordings.importers.formats import is_log

    if is_log(Path(args.recording)):
        recording, t, values, unit = _of_log(args, start, end)
    else:
        recording, t, values, unit = _of_bag(args, start, end)
    if start is not None or end is not None:
        # What lies outside the part has no voltage beside it, and is not counted as dropped.
        part = (t >= recording.t[0]) & (t <= recording.t[-1])
        t, values = t[part], values[part]
    try:
        found = estimate_coupling(recording.t, recording.voltage, t, values,
                                  throttle=recording.throttle, band=band, level=level)
    except InputError as error:
        raise InputError(f"'{args.recording}', signal '{args.signal}': {error}") from error
    seen = overview(recording, math.nan if limit is None else limit, cells=args.cells or 0)
    known = known_lines(seen)
    if args.report is not None:
        from ou_monitor.report.coupling_page import coupling_page
        output.write_text(coupling_page(found, recording, (t, values), args.signal, unit, known,
                                        seen, command_line(args)), args.report)
    if args.json is not None:
        output.write_json(as_data(found, recording.name, args.signal, unit, recording.notes),
                          args.json)
    if args.json != output.STDOUT:
        output.say(render(found, recording.name, args.signal, unit, recording.notes, known))
        output.summary(headline(found, args.signal, unit),
                       f'{answers(seen)[0]}.', report=args.report, json=args.json)
    return 0


def _of_log(args: argparse.Namespace, start: float | None, end: float | None,
            ) -> tuple[Recording, FloatArray, FloatArray, str]:
    """Return supply, stamps and values of the signal, and its unit, of a log."""
    from ou_monitor.recordings.log_signal import read_log_signal

    for option, value in (('--msg-config', args.msg_config),
                          ('--voltage-topic', args.voltage_topic),
                          ('--throttle-topic', args.throttle_topic)):
        if value is not None:
            raise InputError(f'{args.recording} is a log: {option} is for bags')
    if any(value is not None for value in (args.time_column, args.unit, args.time_unit)):
        raise InputError(f'{args.recording} is a log: its time and units are known')
    with Progress('reading', args.json == output.STDOUT) as progress:
        recording, series = read_log_signal(
            Path(args.recording), args.signal, voltage=args.voltage_column,
            throttle=args.throttle_column, flight=args.flight, start=start, end=end,
            progress=progress)
    return recording, series.t, series.values, '' if series.unit == '?' else series.unit


def _of_bag(args: argparse.Namespace, start: float | None, end: float | None,
            ) -> tuple[Recording, FloatArray, FloatArray, str]:
    """Return supply, stamps and values of the signal, and its unit, of a bag or a CSV."""
    from ou_monitor.recordings.read import read_signal, signal_unit

    recording = read_given(args, start, end)
    t, values = read_signal(args.recording, args.signal, partial=args.partial,
                            columns=columns_given(args))
    return recording, t, values, signal_unit(args.recording, args.signal, partial=args.partial)


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


def render(found: Coupling, name: str, signal: str, unit: str, notes: tuple[str, ...],
           known: Sequence[tuple[str, str]] = ()) -> str:
    """Return the finding for a terminal; known: what is known of the voltage anyway."""
    lines = [f'{name}, {signal}: {parts(found)}', '',
             output.paragraph(headline(found, signal, unit)), '',
             output.facts_table([*known, *facts(found, unit)])]
    said = remarks(found, notes)
    if said:
        lines += ['', *[output.item(text) for text in said]]
    return '\n'.join(lines)


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
