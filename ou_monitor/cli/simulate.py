"""`ou-monitor simulate`: a recording from a model."""

from __future__ import annotations

import argparse
import math
import sys
from typing import Any

from ou_monitor.cli import output
from ou_monitor.cli.arguments import part_of_recording
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError, nearest
from ou_monitor.report import terminal

# From this rate on samples travel in blocks by default, Hz.
_BLOCKS_FROM = 5000.0
# Endings of files that are no bag: a folder of such a name would surprise.
_NO_BAG = ('.bag', '.bin', '.csv', '.db3', '.json', '.txt', '.ulg', '.yaml', '.yml')
# Above it stamps would fall together, Hz.
_RATE_MOST = 1e9
# Samples at most over which the cost of an export is measured.
_EXPORT_MOST = 200_000
# After it stamps would not fit into a bag, s.
_DURATION_MOST = 9e9


def run(args: argparse.Namespace) -> int:
    """Simulate."""
    from ou_monitor.recordings.model_file import as_yaml, ModelFile, read_model
    from ou_monitor.simulation import is_recording, PRESETS, PROFILES, read_profile, read_throttle

    if args.list:
        output.check_paths({}, {'--json': args.json}, args.force)
        if args.json is not None:
            output.write_json({
                'presets': {name: {'throttle': p.throttle, 'rate_hz': p.rate,
                                   'duration_s': p.duration, 'text': p.text}
                            for name, p in PRESETS.items()},
                'profiles': {name: text for name, (_, text) in PROFILES.items()}}, args.json)
            if args.json == output.STDOUT:
                return 0
        output.say(terminal.table(['Preset', 'Throttle', 'Rate, Hz', 'Length, s', 'What it is'], [
            [name, p.throttle, f'{p.rate:g}', f'{p.duration:g}', p.text]
            for name, p in PRESETS.items()], left=[0, 1, 4]))
        output.say(terminal.table(
            ['Throttle profile', 'What it is'],
            [[name, text] for name, (_, text) in PROFILES.items()], left=[0, 1]))
        return 0
    # A profile by name or number is no file, and no output is taken for one.
    start, end = part_of_recording(args.start, args.end)
    recorded = args.throttle is not None and is_recording(args.throttle)
    if not recorded and (start is not None or end is not None):
        raise InputError('--from and --to take a part of a recorded throttle: give --throttle '
                         'RECORDING')
    table = args.throttle if recorded or str(args.throttle).lower().endswith('.csv') else None
    output.check_paths(
        {'--model': args.model, '--throttle': table},
        {'--output': args.output, '--save-model': args.save_model, '--json': args.json},
        args.force)
    if args.output is not None and args.output.suffix.lower() in _NO_BAG:
        raise InputError(f"--output '{args.output}': {args.output.suffix} is not written; give "
                         'NAME.mcap for one file, or NAME for a rosbag2 folder')
    output.check_writable(args.json)
    output.check_writable(None if args.save_model is None else str(args.save_model))
    name = 'flight' if args.preset is None else args.preset
    if name not in PRESETS:
        raise InputError(f"no preset '{name}': {nearest(name, PRESETS)}")
    preset = PRESETS[name]
    if args.model is not None:
        file, name = read_model(args.model), args.model.stem
    else:
        file = ModelFile(preset.model, provenance={'preset': name})
    throttle = preset.throttle if args.throttle is None else args.throttle
    length = preset.duration
    if recorded:
        found = read_throttle(throttle, start, end)
        profile, length = found.profile, found.duration
    else:
        profile = read_profile(throttle)
    rate = _positive('--rate', preset.rate if args.rate is None else args.rate, 'Hz')
    duration = _positive('--duration', length if args.duration is None else args.duration,
                         's')
    if not 1.0 <= duration * rate <= 1e12:
        raise InputError(f'{duration:g} s at {rate:g} Hz are {duration * rate:.3g} samples, '
                         'outside 1 to 1e12')
    if duration > _DURATION_MOST:
        raise InputError(f'--duration must be at most {_DURATION_MOST:g} s, as bags count in ns; '
                         f'got {duration:g}')
    if rate > _RATE_MOST:
        raise InputError(f'--rate must be at most {_RATE_MOST:g} Hz, as bags count in ns; got '
                         f'{rate:g}')
    if args.export is not None:
        _export(args, file.model, profile, rate, duration, start, end, recorded)
        return 0
    kind = args.type or ('adc_block' if rate >= _BLOCKS_FROM else 'battery_state')
    if args.output is None:
        if args.save_model is None:
            raise InputError('--output PATH.mcap is needed: where the recording goes')
        if args.json is not None:
            raise InputError('--json says what was simulated: it needs --output PATH.mcap')
        output.write_text(as_yaml(file), args.save_model)
        return 0
    written = _write(args, file.model, profile, duration, rate, kind, name)
    if args.save_model is not None:
        output.write_text(as_yaml(file), args.save_model)
    if args.json is not None:
        output.write_json({
            'output': str(args.output), 'duration_s': duration, 'rate_hz': rate,
            'seed': args.seed, 'throttle': throttle, **written,
            'model': [{'term': term.NAME, 'params': term.values()}
                      for term in file.model.terms]}, args.json)
    if args.json != output.STDOUT:
        output.say(
            f"{args.output}: {written['n']} samples of '{name}', {duration:g} s at {rate:g} Hz, "
            f"{', '.join(term.NAME for term in file.model.terms)}; seed {args.seed}")
    return 0


def _write(args: argparse.Namespace, model: Any, profile: Any, duration: float, rate: float,
           kind: str, name: str) -> dict[str, Any]:
    from ou_monitor.recordings.write import RecordingWriter
    from ou_monitor.simulation import simulated

    total, done = round(duration * rate), 0
    with output.replacing(args.output, args.force), \
            RecordingWriter(args.output, type=kind, sample_rate=rate) as writer, \
            Progress('simulating', args.json == output.STDOUT) as progress:
        for piece in simulated(model, profile, duration=duration, rate=rate, seed=args.seed,
                               name=name, charge=_charge(args.capacity_left),
                               resistance=args.scale_resistance):
            writer.write(piece)
            done += piece.n
            progress(done / total)
    return {'n': done, 'topics': writer.topics}


def _export(args: argparse.Namespace, model: Any, profile: Any, rate: float, duration: float,
            start: float | None, end: float | None, recorded: bool) -> None:
    """Print the model for another simulator; what is lost goes to stderr."""
    import numpy as np
    from ou_monitor.comparison.export import export
    from ou_monitor.recordings.read import read_recording

    count = min(round(duration * rate), _EXPORT_MOST)
    recording = read_recording(args.throttle, start=start, end=end) if recorded else None
    found = export(model, args.export, throttle=profile(np.arange(count) / rate), rate=rate,
                   full_current=args.full_current, recording=recording)
    output.say(found.text)
    for note in found.notes:
        print(note, file=sys.stderr)


def _charge(left: float | None) -> float | None:
    """Return the charge at the begin, as `RunningSupply` takes it."""
    if left is None:
        return None
    if left != -1.0 and not 0.0 <= left <= 1.0:
        raise InputError(f'--capacity-left must lie within 0..1, or be -1, got {left:g}')
    return math.nan if left == -1.0 else left


def _positive(name: str, value: float, unit: str) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f'{name} must be a positive number of {unit}, got {value:g}')
    return value
