"""`ou-monitor analyze RECORDING`: the paper's Tables 1 and 2 for a recording."""

from __future__ import annotations

import argparse
from dataclasses import replace
import math
import shlex

import numpy as np
from ou_monitor.analysis.analyze import Analysis, analyze
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.relaxation import Relaxation
from ou_monitor.analysis.words import (
    as_data, brownout_sentence, caution, facts, headline, in_short, relaxation_sentence)
from ou_monitor.cli import output
from ou_monitor.cli.arguments import (
    brownout_limit, check_outputs, limit_of, part_of_recording, positive_number, read_given,
    repeated, throttle_levels)
from ou_monitor.cli.output import facts_table, item, paragraph, Progress, table
from ou_monitor.errors import InputError
from ou_monitor.records import Recording
from ou_monitor.text import chance, number

_UNKNOWN = '-'
# Rows of a table for people; the JSON has them all.
_MOST_LINES, _MOST_CHANGES = 12, 8


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    check_outputs(args, 'report', RECORDING=args.recording, **{'--msg-config': args.msg_config})
    levels = throttle_levels(args.levels)
    window = positive_number('--window', args.window)
    horizon = positive_number('--brownout-horizon', args.brownout_horizon)
    voltage = brownout_limit(args)
    _in_range(voltage, horizon)
    start, end = part_of_recording(args.start, args.end)
    recording = read_given(args, start, end)
    voltage = limit_of(args, recording, voltage)
    if recording.n < 2:
        raise InputError(f"'{args.recording}' holds {recording.n} usable sample"
                         f"{'' if recording.n == 1 else 's'}: nothing can be estimated from it")
    if levels is not None and not recording.has_throttle:
        raise InputError(f"--levels: '{args.recording}' has no throttle; leave --levels out, or "
                         'name the topic with --throttle-topic')
    with Progress('analyzing', args.json == output.STDOUT) as progress:
        analysis = analyze(recording, levels=levels, window=window, brownout_voltage=voltage,
                           brownout_horizon=horizon, cells=args.cells or 0, progress=progress)
    if args.report is not None:
        from ou_monitor.report.analysis_page import analysis_page
        output.write_text(analysis_page(analysis, command_line(args)), args.report)
    if args.json is not None:
        found = analysis.overview.facts
        if analysis.brownout_default:
            # As other commands without a limit.
            found = replace(found, dips=None, budget=None)
        output.write_json({**as_data(analysis), 'supply': found.to_dict()}, args.json)
    if args.json != output.STDOUT:
        output.say(render(analysis))
        output.summary(*in_short(analysis), report=args.report, json=args.json)
    return 0


def command_line(args: argparse.Namespace) -> str:
    """Return the command that repeats this analysis."""
    return shlex.join(['ou-monitor', 'analyze', args.recording, *repeated(
        args, 'levels', 'window', 'brownout_voltage', 'cells', 'brownout_horizon')])


def _in_range(voltage: float | None, horizon: float) -> None:
    """Refuse what the node would refuse."""
    from ou_monitor.online.settings import ESTIMATOR_PARAMETERS

    for parameter in ESTIMATOR_PARAMETERS:
        name = parameter.name.removeprefix('brownout.')
        value = {'voltage': voltage, 'horizon': horizon}.get(name)
        if value is None or parameter.low is None or parameter.high is None:
            continue
        if not parameter.low <= value <= parameter.high:
            raise InputError(f'--brownout-{name}: {value:g} is not within {parameter.low:g} to '
                             f'{parameter.high:g}')


def render(analysis: Analysis) -> str:
    """Return the tables and notes for a terminal 100 columns wide."""
    recording = analysis.recording
    rate = (recording.n - 1) / recording.duration if recording.duration > 0.0 else math.nan
    parts = [
        f'{recording.name}: {recording.n} samples in {recording.duration:.4g} s '
        f'({number(rate)} Hz)\n{_origin(recording)}', paragraph(headline(analysis)),
        facts_table(facts(analysis)), _levels(analysis),
        _parameters(analysis), _kinds(analysis), _lines(analysis), _transients(analysis),
        paragraph(analysis.alpha_test.sentence), _by_throttle(analysis), _remarks(analysis)]
    return '\n\n'.join(part for part in parts if part)


def _origin(recording: Recording) -> str:
    """Say which topics or columns voltage and throttle came from."""
    source, origins = recording.source, []
    if 'voltage' in source:
        return f"voltage: {source['voltage']}; throttle: {source.get('throttle', 'none')}"
    if 'voltage_topic' not in source:
        throttle = 'column throttle' if recording.has_throttle else 'none'
        return f'voltage: column voltage_v; throttle: {throttle}'
    for name in ('voltage', 'throttle'):
        kind = source.get(f'{name}_type', '').split('/')[-1]
        origins.append(f'{name}: ' + (
            f'{source[f"{name}_topic"]} ({kind}.{source.get(f"{name}_field", "")})'
            if f'{name}_topic' in source else 'none'))
    return paragraph('; '.join([*origins, f'config: {source["msg_config"]}']))


def _levels(analysis: Analysis) -> str:
    rows = [[level.label, number(level.time), str(level.n), number(level.mean, 4),
             *[number(1e3 * v) for v in (level.vpp, level.peak, level.vrms)],
             number(1e3 * level.estimate.noise_std), level.kind.value]
            for level in analysis.levels]
    return table(['throttle', 'time s', 'n', 'mean V', 'Vpp mV', 'peak mV', 'Vrms mV', 'noise mV',
                  'process'], rows, left=[8])


def _parameters(analysis: Analysis) -> str:
    rows = [[level.label, *[_interval(level, name) for name in ('alpha', 'sigma', 'var_inf')],
             number(1e3 * level.estimate.tau)] for level in analysis.levels
            if level.estimate.usable]
    return '' if not rows else table(
        ['throttle', 'alpha 1/s [95 %]', 'sigma V/sqrt(s) [95 %]', 'Var_inf V^2 [95 %]', 'tau ms'],
        rows)


def _interval(level: LevelResult, name: str) -> str:
    value = getattr(level.estimate, name)
    if not math.isfinite(value):
        return _UNKNOWN
    low, high = level.estimate.interval(name)
    return f'{number(value)} [{number(low)}, {number(high)}]'


def _kinds(analysis: Analysis) -> str:
    """Return why each level is called what it is called; levels of one reason together."""
    groups: dict[tuple[str, str], list[LevelResult]] = {}
    for level in analysis.levels:
        groups.setdefault((level.kind.value, level.verdict.why), []).append(level)
    items = []
    for (kind, why), levels in groups.items():
        if len(levels) == 1:
            items.append(item(f'{levels[0].label}, {kind}: {levels[0].verdict.sentence}'))
            continue
        names = ', '.join(level.label for level in levels)
        items.append(item(f'{names}, {kind}: {why[0].upper()}{why[1:].rstrip(".")}.'))
    return '\n'.join(items)


def _lines(analysis: Analysis) -> str:
    searched = [level for level in analysis.levels if not level.lines.why_not]
    if not searched:
        return ''
    rows = [[level.label, number(line.frequency, 4), number(1e3 * line.rms),
             f'{number(1e3 * line.rms_low)} to {number(1e3 * line.rms_high)}',
             f'{100.0 * line.share:.2g} %', chance(line.p_value)]
            for level in searched for line in level.lines.lines]
    if not rows:
        least = max(level.lines.detectable for level in searched)
        none = 'No spectral line at any level (1 % false alarms); '
        return paragraph(none + (
            f'one of {number(1e3 * least)} mV rms would have been detected at each of those '
            'searched (90 %).' if math.isfinite(least) else
            'how large one would have to be is not known with so few samples.'))
    text = table(['throttle', 'line Hz', 'rms mV', '95 %', 'of variance', 'p'],
                 rows[:_MOST_LINES])
    more = len(rows) - _MOST_LINES
    return text + (f'\n{more} more lines are in the JSON.' if more > 0 else '')


def _transients(analysis: Analysis) -> str:
    if not analysis.recording.has_throttle:
        return ''
    parts = []
    for k, fit in enumerate(analysis.relaxations):
        if fit.releases:
            parts.append(paragraph(relaxation_sentence(analysis, k)))
        if fit.detected:
            parts.append(_changes(fit, float(analysis.recording.t[0])))
    return '\n\n'.join(parts)


def _changes(fit: Relaxation, start: float) -> str:
    side = 'overshoot mV' if fit.kind == 'release' else 'undershoot mV'
    rows = [[number(change.t - start, 4),
             f'{100.0 * change.throttle_before:.3g} to {100.0 * change.throttle_after:.3g} %',
             _with_se(change.level_before, change.level_before_se),
             _with_se(change.level, change.level_se),
             _millivolts(change.amplitude, change.amplitude_se),
             number(1e3 * change.beyond), chance(change.beyond_p)]
            for change in fit.clear[:_MOST_CHANGES]]
    more = len(fit.releases) - len(rows)
    rest = f'{more} more changes are in the JSON.' if more else ''
    return '\n'.join(part for part in (table(
        ['at s', 'throttle', 'level before V', 'level after V', 'A mV', side, 'p of noise'],
        rows) if rows else '', rest) if part)


def _by_throttle(analysis: Analysis) -> str:
    """Return the sag, sigma of the levels or noise where there are none, and the risk."""
    curves = analysis.by_throttle
    sentence = paragraph(brownout_sentence(analysis))
    levels = [level for level in analysis.levels if math.isfinite(level.throttle) and level.n]
    heads = ['throttle', 'sag mV [95 %]', 'sigma V/sqrt(s) [95 %]', 'brown-out risk']
    if levels:
        rows = [[level.label, _mv_interval(level.sag.sag, *level.sag.interval),
                 _interval(level, 'sigma'), chance(curves.at(level.throttle, 'risk'))]
                for level in levels]
    else:
        heads[2] = 'noise mV rms'
        rows = [[f'{100.0 * curves.throttle[k]:.0f} %',
                 _mv_interval(curves.sag[k], curves.sag_low[k], curves.sag_high[k]),
                 number(1e3 * curves.noise[k]), chance(curves.risk[k])]
                for k in np.flatnonzero(curves.known)]
    if not rows or not analysis.recording.has_throttle:
        return sentence
    text = table(heads, rows)
    return f'{text}\n\n{sentence}'


def _mv_interval(value: float, low: float, high: float) -> str:
    if not math.isfinite(value):
        return _UNKNOWN
    return f'{_mv(value)} [{_mv(low)}, {_mv(high)}]' if high > low else _mv(value)


def _remarks(analysis: Analysis) -> str:
    """Return quality and notes, worst first; what the reader noted stands among the quality."""
    items = [item(f'{one.severity.name.lower()}: {caution(one)}') for one in analysis.quality]
    said = {one.text for one in analysis.quality}
    items += [item(note) for note in analysis.notes if note not in said]
    return '\n'.join(items)


def _mv(value: float) -> str:
    return number(1e3 * value) if abs(value) >= 5e-7 else '0'


def _with_se(value: float, se: float) -> str:
    return f'{number(value, 4)} +- {number(se, 2)}' if math.isfinite(value) else _UNKNOWN


def _millivolts(value: float, se: float) -> str:
    return f'{number(1e3 * value)} +- {number(1e3 * se, 2)}' if math.isfinite(value) else _UNKNOWN
