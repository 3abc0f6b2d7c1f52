"""The commands on one recording, and `reproduce`: they pass their arguments to `bench`."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timezone
import math
from typing import Any, TYPE_CHECKING

from ou_monitor import __version__, bench
from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, check_ranges, read_given
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError
from ou_monitor.timeline import check_size

if TYPE_CHECKING:
    from ou_monitor.discovery.finding import Finding
    from ou_monitor.records import Recording
    from ou_monitor.report.result import Result


def analyze(args: argparse.Namespace) -> int:
    given = _bench_arguments(args, 'levels', 'window', 'brownout_horizon')
    output.deliver(args, _read_and_run(args, 'analyzing', bench.analyze, given)[1])
    return 0


def compare(args: argparse.Namespace) -> int:
    from ou_monitor.recordings.model_file import read_model

    given = _bench_arguments(args, 'fit_until', 'seeds', 'seed')
    model = None if args.model is None else read_model(args.model).model
    output.deliver(args, _read_and_run(
        args, 'comparing', bench.compare, {**given, 'model': model})[1])
    return 0


def coupling(args: argparse.Namespace) -> int:
    given = _bench_arguments(args, 'band', 'level')
    recording, series = read_given(args, args.signal)
    assert series is not None
    t, values = series.t, series.values
    if args.start is not None or args.end is not None:
        # Samples outside the part have no voltage; do not count them as dropped.
        part = (t >= recording.t[0]) & (t <= recording.t[-1])
        t, values = t[part], values[part]
    output.deliver(args, bench.coupling(
        recording, replace(series, name=args.signal, t=t, values=values), **given))
    return 0


def discover(args: argparse.Namespace) -> int:
    given = _bench_arguments(args, 'seed')
    recording, finding = _read_and_run(args, 'discovering', bench.discover, given)
    why = finding.unsaved
    if finding.refused and not (why or args.force):
        why = f'{finding.refused}; --force saves it anyway'
    if args.save_model is not None and not why:
        output.write_text(model_text(finding.record, recording), args.save_model, args.force)
    output.deliver(args, finding, model=None if why else args.save_model)
    if args.save_model is not None and why:
        # Last, so that a refused model does not stop the other files from being written.
        raise InputError(_unsaved(why))
    return 0


def reproduce(args: argparse.Namespace) -> int:
    check_outputs(args)
    with Progress('recomputing') as progress:
        found = bench.reproduce(seed=args.seed, progress=progress)
    output.deliver(args, found)
    return 0


def _bench_arguments(args: argparse.Namespace, *names: str) -> dict[str, Any]:
    """Return the named arguments and the limit for a function of `bench`, after checking them."""
    check_outputs(args, RECORDING=args.recording, **{
        '--msg-config': args.msg_config, '--model': getattr(args, 'model', None)})
    given = {name: getattr(args, name) for name in names}
    # Imported here, because it imports SciPy, which not every command needs.
    from ou_monitor.analysis.crafts import pack_limit

    check_ranges({**given, 'brownout_voltage': pack_limit(args.brownout_voltage, args.cells)})
    return {**given, 'brownout_voltage': args.brownout_voltage, 'cells': args.cells or 0}


def _read_and_run(args: argparse.Namespace, label: str, function: Callable[..., Result],
                  given: dict[str, Any]) -> tuple[Recording, Result]:
    """Return the recording, and the result of a function of `bench`, with progress bars."""
    recording, _ = read_given(args)
    check_size(recording)
    with Progress(label) as progress:
        return recording, function(recording, progress=progress, **given)


def _unsaved(why: str) -> str:
    return f'no model saved: {why[0].lower()}{why[1:]}'


def model_text(finding: Finding, recording: Recording | None = None) -> str:
    """Return a model file's text: the extended model, and start values for the next flight."""
    from ou_monitor.online.load.load_filter import LoadFilter
    from ou_monitor.recordings.model_file import as_yaml, ModelFile
    from ou_monitor.records import plain_data

    if finding.unsaved:
        raise InputError(_unsaved(finding.unsaved))
    assert finding.model is not None

    provenance = plain_data({
        'recording': finding.recording, 'date': datetime.now(timezone.utc).date().isoformat(),
        'ou_monitor': __version__, 'verdict': finding.verdict.value,
        'heldout_score': finding.score, 'gain': finding.gain,
        'gain_se': finding.gain_se, 'seed': finding.seed,
        # Default rate of `simulate --model`.
        'rate_hz': float(f'{(finding.n - 1) / finding.duration:.6g}')})
    loads = LoadFilter()
    if recording is not None:
        loads.push(recording.t, recording.voltage, recording.throttle, recording.current)
    model = replace(finding.model, load=loads.learned(),
                    full_current=finding.full if finding.load == 'current' else 0.0)
    return as_yaml(ModelFile(model, tuple(
        {name: error for name, error in se.items() if error != math.inf}
        for se in finding.se), provenance))
