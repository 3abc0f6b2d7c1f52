"""`ou-monitor simulate`: a recording from a model."""

from __future__ import annotations

import argparse
import sys

from ou_monitor.bench import simulate
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, columns_given, part_of_recording
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError
from ou_monitor.recordings.model_file import as_yaml
from ou_monitor.report.document import Document, Table
from ou_monitor.simulation import is_recording, PRESETS, PROFILES, Run

# Maximum number of samples used to measure the loss of an export.
_EXPORT_MOST = 200_000


def run(args: argparse.Namespace) -> int:
    if args.list:
        check_outputs(args)
        output.tell(args, Document('Presets', '', (), [
            Table(['Preset', 'Throttle', 'Rate, Hz', 'Length, s', 'What it is'], [
                [name, p.throttle, f'{p.rate:g}', f'{p.duration:g}', p.text]
                for name, p in PRESETS.items()], left=[0, 1, 4]),
            Table(['Throttle profile', 'What it is'],
                  [[name, text] for name, (_, text) in PROFILES.items()], left=[0, 1])]),
                    lambda: {
            'presets': {name: {'throttle': p.throttle, 'rate_hz': p.rate,
                               'duration_s': p.duration, 'text': p.text}
                        for name, p in PRESETS.items()},
            'profiles': {name: text for name, (_, text) in PROFILES.items()}})
        return 0
    # A profile's name or number is not an input file, so no output can overwrite it.
    start, end = part_of_recording(args)
    columns = columns_given(args)
    recorded = args.throttle is not None and is_recording(args.throttle, columns)
    table = args.throttle if recorded or str(args.throttle).lower().endswith('.csv') else None
    check_outputs(args, ('--output', args.output), **{
        '--model': args.model, '--throttle': table})
    target = None if args.export is not None else args.output
    with output.replacing(target, args.force), Progress('simulating') as progress:
        found = simulate(
            args.model, preset=args.preset, throttle=args.throttle, start=start, end=end,
            duration=args.duration, rate=args.rate, seed=args.seed,
            capacity_left=args.capacity_left, scale_resistance=args.scale_resistance,
            output=target, message=args.type, columns=columns, progress=progress)
    if args.export is not None:
        _export(args, found.record)
        return 0
    if args.output is None:
        if args.save_model is None:
            raise InputError('--output is missing: name the bag to write, such as flight.mcap')
        if args.json is not None:
            raise InputError('--json describes the simulated bag: it needs --output PATH.mcap')
    if args.save_model is not None:
        output.write_text(as_yaml(found.file), args.save_model, args.force)
    if args.output is None:
        return 0
    said = found.document()
    output.tell(args, Document(said.title, said.subject, (), ()), found.to_dict)
    return 0


def _export(args: argparse.Namespace, run: Run) -> None:
    """Print the model for another simulator; report on stderr what it cannot express."""
    import numpy as np
    from ou_monitor.comparison.export import export

    throttle = run.profile(np.arange(min(run.n, _EXPORT_MOST)) / run.rate)
    found = export(run.file.model, args.export, throttle=throttle, rate=run.rate,
                   full_current=args.full_current, recording=run.flown)
    output.say(found.text)
    for note in found.notes:
        print(note, file=sys.stderr)
