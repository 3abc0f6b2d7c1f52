"""`ou-monitor discover RECORDING`: what the simulation gets wrong, why, and the gain."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, timezone
import math
import shlex
from typing import TYPE_CHECKING

from ou_monitor import __version__
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, read_given, repeated)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.discovery.finding import Finding
    from ou_monitor.records import Recording

# Statistics and notes shown at most; all of them are in the report.
_SHOWN = 8


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    limit = brownout_limit(args)
    check_outputs(args, 'save_model', 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config})

    import numpy as np
    from ou_monitor.analysis.overview import known_lines, other_scale, overview
    from ou_monitor.discovery.discover import discover
    from ou_monitor.discovery.plain_names import in_short

    recording = read_given(args, start, end)
    limit = limit_of(args, recording, limit)
    # What overflows on the way ends as not finite, which the search refuses: a user has no
    # use for the source line of it.
    with Progress('discovering', args.json == output.STDOUT) as progress, \
            np.errstate(all='ignore'):
        finding = discover(recording, seed=args.seed, progress=progress)
    seen = overview(recording, limit, cells=args.cells or 0)
    known = known_lines(seen)
    plain = finding.baseline
    if plain is not None and other_scale(seen.facts.ou, plain.alpha, 0.0, plain.sigma, 0.0):
        known.append(('Plain OU', 'describes another time scale than this relaxation: level and '
                      'load are in it'))
    if args.report is not None:
        from ou_monitor.report.discovery_page import discovery_page
        with Progress('drawing', args.json == output.STDOUT) as progress:
            text = discovery_page(finding, command_line(args), progress, known)
        output.write_text(text, args.report)
    if args.json is not None:
        output.write_json({**finding.as_data(), 'supply': seen.facts.to_dict()}, args.json)
    if args.json != output.STDOUT:
        output.say(render(finding, known))
        saved = args.save_model if args.force or not finding.refused else None
        output.summary(*in_short(finding), report=args.report, json=args.json, model=saved)
    if args.save_model is not None:
        # Last: that there is none must not keep the others from being written.
        if finding.refused and not args.force:
            raise InputError(f'no model saved: {finding.refused[0].lower()}{finding.refused[1:]}; '
                             '--force saves it all the same')
        output.write_text(model_text(finding, recording), args.save_model)
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this discovery."""
    return shlex.join(['ou-monitor', 'discover', args.recording, *repeated(
        args, 'seed', 'brownout_voltage', 'cells')])


def model_text(finding: Finding, recording: Recording | None = None) -> str:
    """Return the extended model, and what is known at take-off, as the text of a model file."""
    from ou_monitor.online.load.load_filter import LoadFilter
    from ou_monitor.recordings.model_file import as_yaml, ModelFile

    if finding.model is None:
        raise InputError(f"no model to save: '{finding.recording}' was not fitted. "
                         f'{finding.sentence}')
    if finding.load == 'current':
        raise InputError('no model saved: its load is the measured current, and a model file is '
                         'for throttle')

    def known(value: float) -> float | None:
        return value if math.isfinite(value) else None

    provenance = {
        'recording': finding.recording, 'date': datetime.now(timezone.utc).date().isoformat(),
        'ou_monitor': __version__, 'verdict': finding.verdict.value,
        'heldout_score': known(finding.score), 'gain': known(finding.gain),
        'gain_se': known(finding.gain_se), 'seed': finding.seed}
    loads = LoadFilter()
    if recording is not None:
        loads.push(recording.t, recording.voltage, recording.throttle, recording.current)
    model = replace(finding.model, load=loads.learned())
    return as_yaml(ModelFile(model, tuple(
        {name: error for name, error in se.items() if error != math.inf}
        for se in finding.se), provenance))


def render(finding: Finding, known: Sequence[tuple[str, str]] = ()) -> str:
    """Return the finding for a terminal; known: what is known of the recording anyway."""
    from ou_monitor.discovery.plain_names import headline, PLAIN_NAMES
    from ou_monitor.discovery.words import (
        cause_rows, crossing_words, MNAT, overlap_words, plain_model_words, plain_words)
    from ou_monitor.text import number

    used = '' if finding.samples is None or finding.samples.n == finding.n else (
        f', {finding.samples.n} used')
    lines = [f'{finding.recording}: {finding.n} samples in {number(finding.duration, 4)} s{used}',
             '', output.paragraph(headline(finding))]
    lines += ['', output.facts_table(known)] if known else []
    if finding.causes:
        found = cause_rows(finding.causes)
        rows = [[row.label, PLAIN_NAMES.get(row.name, row.name), row.family, row.gain,
                 row.chance, ', '.join(row.alternatives) or '-']
                for row in found]
        lines += ['', output.table(['cause', 'what it is', 'family', 'gain mnat/sample', 'p',
                                    'alternatives'], rows, left=[0, 1, 2, 5]), '']
        for row in found:
            lines += [output.item(f'{row.name}: {estimate}') for estimate in row.estimates]
        overlap = overlap_words(finding.causes, finding.gain)
        lines += [output.item(MNAT), *([output.item(overlap)] if overlap else [])]
        for remark in dict.fromkeys(row.remark for row in found if row.remark):
            lines.append(output.item(f'Gain {remark}: ' + ', '.join(
                f'{row.label} ({row.gain})' for row in found if row.remark == remark)))
    if finding.baseline is not None:
        lines += ['', output.paragraph(
            f'Plain OU: {plain_model_words(finding.baseline)}.')]
        felt = crossing_words(finding)
        lines += [output.paragraph(felt)] if felt else []
    left = finding.remaining
    if left:
        lines += ['', 'What is left:', *[
            output.item(f'{c.statistic}: {number(c.after)} (band {number(c.low)} to '
                        f'{number(c.high)}), {plain_words(c.statistic)}') for c in left[:_SHOWN]]]
        if len(left) > _SHOWN:
            lines.append(output.item(f'and {len(left) - _SHOWN} more'))
    if finding.notes:
        lines += ['', *[output.item(note) for note in finding.notes]]
    return '\n'.join(lines)
