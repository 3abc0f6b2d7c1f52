"""`ou-monitor analyze RECORDING`: the paper's Tables 1 and 2 for a recording."""

from __future__ import annotations

import argparse
import math
import shlex
from textwrap import fill
from typing import Any, TYPE_CHECKING

from ou_monitor.errors import InputError

if TYPE_CHECKING:
    from ou_monitor.offline.analyze import Analysis, LevelResult

_NAN = float('nan')
# Lines are broken to be read at this width.
_COLUMNS = 100


def add_parser(subparsers: Any) -> None:
    """
    Add the command.

    Parameters
    ----------
    subparsers : argparse action
        From ``ArgumentParser.add_subparsers``.

    """
    parser = subparsers.add_parser(
        'analyze', allow_abbrev=False,
        help='Vpp, Vrms, alpha, tau, sigma, Var_inf with 95 %% intervals per load level',
        description='Analyze the noise of a supply: per load level Vpp, Vrms, alpha, tau, '
                    'sigma and Var_inf with 95 % intervals, and the type of process.')
    parser.add_argument(
        'recording', metavar='RECORDING',
        help='.mcap file, rosbag2 folder, or CSV with columns time_s, voltage_v[, throttle]')
    parser.add_argument('--levels', metavar='0,0.05,...',
                        help='throttles 0..1 of the load levels (default: found)')
    parser.add_argument('--window', metavar='S', default='2.0',
                        help='window of the sliding estimate, s (default: 2.0)')
    parser.add_argument('--brownout-voltage', metavar='V',
                        help='also give the sliding risk of going below this voltage, V')
    parser.add_argument('--brownout-horizon', metavar='S', default='5.0',
                        help='horizon of that risk, s (default: 5.0)')
    parser.add_argument('--msg-config', metavar='NAME',
                        help='msg_config that says which topic and field is the voltage')
    parser.add_argument('--voltage-topic', metavar='TOPIC', help='topic of the voltage')
    parser.add_argument('--throttle-topic', metavar='TOPIC', help='topic of the throttle')
    parser.add_argument('--partial', action='store_true',
                        help='use what a truncated file still holds')
    parser.add_argument('--json', metavar='FILE',
                        help="write the result as JSON ('-': to standard output, alone)")
    parser.add_argument('--report', metavar='FILE.html',
                        help='write a self-contained HTML page')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    Run the command.

    Parameters
    ----------
    args : argparse.Namespace
        Parsed arguments.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    InputError
        When an argument or the recording cannot be used.

    """
    from ou_monitor.cli import output

    output.check_paths(
        {'RECORDING': args.recording, '--msg-config': args.msg_config},
        {'--json': args.json, '--report': args.report})
    levels = _levels(args.levels)
    window = _number('--window', args.window)
    horizon = _number('--brownout-horizon', args.brownout_horizon)
    voltage = _NAN if args.brownout_voltage is None else _number(
        '--brownout-voltage', args.brownout_voltage)
    if args.report == output.STDOUT:
        raise InputError("--report needs a file: '-' is not supported")
    output.check_writable(args.json)
    output.check_writable(args.report)

    from ou_monitor.offline.analyze import analyze
    from ou_monitor.offline.words import as_data
    from ou_monitor.recordings.read import read_recording

    recording = read_recording(
        args.recording, msg_config=args.msg_config, voltage_topic=args.voltage_topic,
        throttle_topic=args.throttle_topic, partial=args.partial)
    if recording.n < 2:
        raise InputError(f"'{args.recording}' holds {recording.n} usable sample"
                         f"{'' if recording.n == 1 else 's'}: nothing can be estimated from it")
    if levels is not None and not recording.has_throttle:
        raise InputError(f"--levels: '{args.recording}' has no throttle; leave --levels out, or "
                         'name the topic with --throttle-topic')
    with output.Progress('analyzing') as progress:
        analysis = analyze(recording, levels=levels, window=window, brownout_voltage=voltage,
                           brownout_horizon=horizon, progress=progress)
    if args.report is not None:
        from ou_monitor.offline.report.analysis_page import analysis_page
        output.write_text(analysis_page(analysis, command_line(args)), args.report)
    if args.json is not None:
        output.write_json(as_data(analysis), args.json)
    if args.json != output.STDOUT:
        output.say(render(analysis))
        if args.report is not None:
            output.say(f'\nReport: {args.report}')
    return 0


def command_line(args: argparse.Namespace) -> str:
    """
    Return the command that repeats this analysis.

    Parameters
    ----------
    args : argparse.Namespace
        Parsed arguments.

    Returns
    -------
    str
        Quoted for a shell; without the outputs.

    """
    words = ['ou-monitor', 'analyze', args.recording]
    for name in ('levels', 'window', 'brownout_voltage', 'brownout_horizon', 'msg_config',
                 'voltage_topic', 'throttle_topic'):
        value = getattr(args, name)
        if value is not None:
            words += ['--' + name.replace('_', '-'), str(value)]
    return shlex.join(words + (['--partial'] if args.partial else []))


def render(analysis: Analysis) -> str:
    """
    Return the tables and notes for a terminal 100 columns wide.

    Parameters
    ----------
    analysis : Analysis
        Result.

    Returns
    -------
    str
        Plain text.

    """
    from ou_monitor.cli.output import table
    from ou_monitor.offline.words import cautions, headline, number

    recording = analysis.recording
    first = [[level.label, number(level.time), str(level.n), number(level.mean, 4),
              *[number(1e3 * v) for v in (level.vpp, level.peak, level.vrms)],
              number(1e3 * level.estimate.noise_std), level.kind.value]
             for level in analysis.levels]
    second = [[level.label, *[_interval(level, name) for name in ('alpha', 'sigma', 'var_inf')],
               number(1e3 * level.estimate.tau)] for level in analysis.levels]
    rate = (recording.n - 1) / recording.duration if recording.duration > 0.0 else _NAN
    lines = [
        f'{recording.name}: {recording.n} samples in {recording.duration:.4g} s '
        f'({number(rate)} Hz)', '', fill(headline(analysis), _COLUMNS), '',
        table(['throttle', 'time s', 'n', 'mean V', 'Vpp mV', 'peak mV', 'Vrms mV', 'noise mV',
               'process'], first, left=[8]), '',
        table(['throttle', 'alpha 1/s [95 %]', 'sigma V/sqrt(s) [95 %]', 'Var_inf V^2 [95 %]',
               'tau ms'], second)]
    remarks = [*cautions(analysis), *analysis.notes]
    if remarks:
        lines += ['', *[fill(text, _COLUMNS, initial_indent='- ', subsequent_indent='  ')
                        for text in remarks]]
    return '\n'.join(lines)


def _interval(level: LevelResult, name: str) -> str:
    from ou_monitor.offline.words import number

    value = getattr(level.estimate, name)
    if not math.isfinite(value):
        return '-'
    low, high = level.estimate.interval(name)
    return f'{number(value)} [{number(low)}, {number(high)}]'


def _levels(text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    levels = []
    for word in text.split(','):
        try:
            value = float(word)
        except ValueError:
            value = _NAN
        if not 0.0 <= value <= 1.0:
            raise InputError(f"--levels: '{word.strip()}' is not a throttle between 0 and 1; "
                             'write 5 % as 0.05 and separate levels by commas')
        levels.append(value)
    ordered = sorted(levels)
    if any(high - low < 1e-6 for low, high in zip(ordered, ordered[1:])):
        raise InputError(f"--levels: a level is given twice in '{text}'")
    return tuple(ordered)


def _number(option: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = _NAN
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f"{option}: '{text}' is not a positive number")
    return value
