"""`ou-monitor discover RECORDING`: what the simulation gets wrong, why, and the gain."""

from __future__ import annotations

import argparse
from dataclasses import replace
from datetime import datetime, timezone
import math
from typing import TYPE_CHECKING

from ou_monitor import __version__
from ou_monitor.bench import discover
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    check_outputs, command_line, limit_given, part_of_recording, read_given)
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.discovery.finding import Finding
    from ou_monitor.records import Recording


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    start, end = part_of_recording(args.start, args.end)
    limit = limit_given(args)
    check_outputs(args, 'save_model', 'report', RECORDING=args.recording,
                  **{'--msg-config': args.msg_config})

    recording = read_given(args, start, end)
    with Progress('discovering', args.json == output.STDOUT) as progress:
        finding = discover(recording, seed=args.seed, progress=progress, **limit)
    output.deliver(args, finding, command_line(
        args, 'discover', 'seed', 'brownout_voltage', 'cells'),
                   model=args.save_model if args.force or not finding.refused else None)
    if args.save_model is not None:
        # Last: that there is none must not keep the others from being written.
        if finding.refused and not args.force:
            raise InputError(f'no model saved: {finding.refused[0].lower()}{finding.refused[1:]}; '
                             '--force saves it all the same')
        output.write_text(model_text(finding.record, recording), args.save_model)
    return 0


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
