"""The reports of `analyze` (facts, cautions, the paper's tables, evidence) and of `simulate`."""

from __future__ import annotations

from collections import Counter
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from ou_monitor.analysis.analyze import Analysis
from ou_monitor.analysis.crafts import CELL_LIMIT, craft_advice, craft_line, LOWEST_CELL
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.level_tests import NARROW, sigma_change
from ou_monitor.analysis.noise import BAND
from ou_monitor.analysis.overview import answers, determined, FARTHEST, known_lines
from ou_monitor.analysis.quality import faults, QualityItem
from ou_monitor.online.risk.courses import KEPT
from ou_monitor.online.settings import DEFAULT_LIMIT
from ou_monitor.records import FloatArray, NAN, Recording, Severity
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Part, Section, Table, Text, UNKNOWN, worst_first)
from ou_monitor.report.svg import Plot, span
from ou_monitor.text import chance, counted, listed, number, percent

if TYPE_CHECKING:
    from ou_monitor.simulation import Run

# Maximum lines of a table on a terminal.
_MOST_LINES = 12
# Lower limit of the drawn risk.
_LEAST_RISK = 1e-4
# Maximum levels drawn (more would repeat colours), and lines marked in the spectrum of a level.
_MAX_DRAWN, _MAX_MARKED = 6, 3
_TESTS = {'mean_drift': 'mean moves', 'variance_drift': 'intensity moves',
          'gaussian': 'not Gaussian', 'impulses': 'impulses', 'correlated': 'correlated',
          'one_relaxation': 'not one relaxation', 'second_relaxation': 'second relaxation'}


def analysis_document(analysis: Analysis) -> Document:
    recording = analysis.recording
    seen = analysis.overview
    rate = (seen.readings - 1) / seen.duration if seen.duration > 0.0 else NAN
    subject = (f'{recording.name}: {counted(seen.readings)} in {seen.duration:.4g} s '
               f'({number(rate)} Hz){seen.pauses}')
    parts: list[Part] = [
        lambda: [Figure(_with_segments(voltage_plot(recording, seen.limit),
                                       analysis))],
        Facts([*facts(analysis), *_origin(analysis)]),
        Section('What to know before using these numbers', [notes(analysis)]),
        lambda: _over_time(analysis),
        *_deepest(analysis),
        *_alarms(analysis),
        Section('Over throttle', [_by_throttle(analysis), lambda: _curves(analysis)]),
        Section('Load levels', _levels(analysis)),
        lambda: [Section('Sigma and alpha over time', _sliding(analysis), folded=True)],
        Section('Spectrum and distribution', [lambda: _shape(analysis), *_lines(analysis)],
                folded=True),
        Section('Type of process', _process(analysis), folded=True)]
    if recording.source:
        parts.append(lambda: [Section('Source of the recording', [Facts(list(
            recording.source.items()))], folded=True)])
    return Document('Supply noise', subject, answer(analysis), parts)


def answer(analysis: Analysis) -> list[str]:
    """Return the answer: doubts, lowest voltage, safe throttle, and sigma and tau if known."""
    curves = analysis.by_throttle
    first, *others = answers(analysis.overview) or ['The recording holds no samples.']
    safe = [] if math.isnan(curves.budget) else [
        f'At the end of the recording, {100.0 * curves.budget:.0f} % throttle is safe for '
        f'{curves.horizon:g} s{_fall_within_budget(analysis)}.'
        if curves.safe else
        f'No throttle keeps the risk below {100.0 * curves.limit:g} % '
        f'{_why_no_throttle(analysis)}.']
    supply = [first, *safe, *others, *craft_advice(analysis.craft)]
    # If the voltage has the wrong sign, only its noise is meaningful; if it is stuck, nothing is.
    meaningless = {item.name for item in faults(analysis.recording)} & {'VOLTAGE_SIGN', 'STUCK'}
    return [*analysis.overview.beware, *_low_limit(analysis), *([] if meaningless else supply),
            *_numbers(analysis), *_change(analysis)]


def _low_limit(analysis: Analysis) -> list[str]:
    """Return a warning if the limit is too low for the pack: it may be meant per cell."""
    limit, craft = analysis.by_throttle.voltage, analysis.craft
    if not (craft.measures and limit < LOWEST_CELL * craft.cells) or analysis.brownout_default:
        return []
    return [f'Check the limit: {limit:g} V is {number(limit / craft.cells, 2)} V per cell if this '
            f'is a pack of {counted(craft.cells, "cell")}. For a limit per cell, '
            f'add --cells {craft.cells}.']


def facts(analysis: Analysis) -> list[tuple[str, str]]:
    found = known_lines(analysis.overview)
    if not found:
        return []
    craft = craft_line(analysis.craft)
    return [*found[:-1], *([('Known craft', craft)] if craft else []),
            ('Safe up to', _budget(analysis)), *found[-1:]]


def _budget(analysis: Analysis) -> str:
    """Return the throttle budget, and the risk of a throttle beyond it."""
    curves = analysis.by_throttle
    if math.isnan(curves.voltage):
        middle, craft = float(np.median(analysis.recording.voltage)), analysis.craft
        if craft.measures:
            # The user has to confirm that the supply is a lithium pack.
            source = 'from the log' if craft.cells_from == 'log' else 'a guess from the voltage'
            return (f'unknown: no limit; --cells {craft.cells} ({source}) sets it to '
                    f'{CELL_LIMIT * craft.cells:g} V (empty under load), --brownout-voltage to '
                    'any other')
        return ('unknown: no limit; --brownout-voltage or --cells sets one (the default of '
                f'{DEFAULT_LIMIT:g} V is for a 5 V rail, and this supply is '
                f'at {number(middle)} V)')
    what = (f'of falling below {curves.voltage:g} V '
            + ('(the default for a 5 V rail) ' if analysis.brownout_default else '')
            + f'within {curves.horizon:g} s')
    if math.isnan(curves.budget):
        reason = (curves.budget_reason if analysis.recording.has_throttle else
                  'the recording has no throttle' + (
                      '; ou-monitor design --from RECORDING takes the current as the load'
                      if math.isfinite(analysis.overview.facts.resistance.ohm) else ''))
        return f'unknown: {reason}'
    if not curves.safe:
        return (f'no throttle, {_why_no_throttle(analysis)}: the risk {what} is '
                f'{curves.risk[0]:.2g}')
    words = (f'{100.0 * curves.budget:.0f} % throttle if held at the end of the recording: the '
             f'risk {what} stays under {100.0 * curves.limit:g} %')
    beyond = [(u, p) for u, p in zip(curves.throttle, curves.risk)
              if u > curves.budget and p > curves.limit]
    if beyond:
        u, p = next((one for one in beyond if one[1] >= 2.0 * curves.limit), beyond[-1])
        words += f'; at {100.0 * u:.0f} % it is {percent(p)}'
    elif curves.budget < 1.0:
        words += '; higher throttle was not flown' + (
            f' in the last {KEPT / 60.0:g} minutes' if analysis.recording.duration > KEPT else '')
    return words + _fall_within_budget(analysis)


def _fall_within_budget(analysis: Analysis) -> str:
    """Return in words a fall below the limit at a throttle within the budget, or ''."""
    recording, dips = analysis.recording, analysis.overview.facts.dips
    if dips is None:
        return ''
    for dip in dips.deepest:
        # The voltage may lag behind throttle.
        begin = float(recording.t[0]) + dip.begin_s
        first, last = np.searchsorted(recording.t, [begin - 1.0, begin + dip.seconds])
        top = float(np.fmax.reduce(recording.throttle[first:last + 1], initial=0.0))
        if top <= analysis.by_throttle.budget + 0.01:
            return (f'; but at {number(dip.begin_s, 4)} s the voltage was below '
                    f'{dips.limit_v:g} V, with at most {100.0 * top:.0f} % throttle in the second '
                    'before')
    return ''


def _why_no_throttle(analysis: Analysis) -> str:
    """Return the voltages from which no throttle is safe, in words."""
    return (f'at the end of this recording, where the voltage is '
            f'{number(float(analysis.recording.voltage[-1]), 4)} V, and '
            f'{number(analysis.overview.load.level, 4)} V at rest')


def _origin(analysis: Analysis) -> list[tuple[str, str]]:
    """Return the topics or columns of voltage and throttle."""
    recording = analysis.recording
    source, found = recording.source, []
    if source and 'voltage_topic' not in source:
        names = {**dict.fromkeys(('voltage', 'throttle'), 'none'), **source}
        return [('Read from', '; '.join(f'{name}: {names[name]}' for name in (
            'voltage', 'throttle', 'current') if name in names))]
    for name in ('voltage', 'throttle'):
        kind = source.get(f'{name}_type', '').split('/')[-1]
        if f'{name}_topic' in source:
            found.append(f"{name}: {source[f'{name}_topic']} ({kind}."
                         f"{source.get(f'{name}_field', '')})")
    return [('Read from', '; '.join([*found, f"config: {source['msg_config']}"]))] if found else []


def _numbers(analysis: Analysis) -> list[str]:
    whole, recording = analysis.overview.whole, analysis.recording
    ou = whole or analysis.overview.facts.ou
    if ou.status != 'ok' or analysis.overview.rounding:
        return []
    low, high = ou.alpha_95
    held = recording.throttle[recording.t >= recording.t[-1] - ou.window_s]
    held = 100.0 * held[np.isfinite(held)]
    # 5 % to 95 %, so that a few unusual readings do not count.
    flown = dict.fromkeys(f'{x:.0f}' for x in np.quantile(held, (0.05, 0.95))) if held.size else ()
    at = f' at {" to ".join(flown)} % throttle' if flown else ''
    return [f'The noise of {"all" if whole else "the last"} {number(ou.window_s)} s{at} (level '
            'and response to load removed; transients after load changes, and lines, included) '
            f'has sigma = {number(ou.sigma)} (95 % {number(ou.sigma_95[0])} to '
            f'{number(ou.sigma_95[1])}) V/sqrt(s), relaxes in tau = {number(1e3 / ou.alpha)} '
            f'(95 % {number(1e3 / high)} to {number(1e3 / low)}) ms, and has a standard deviation '
            f'of {number(1e3 * math.sqrt(ou.var_inf))} mV.']


def _change(analysis: Analysis) -> list[str]:
    good = [level for level in analysis.levels if level.estimate.usable]
    if len(good) < 2:
        return []
    low, high = good[0], good[-1]
    found = sigma_change(low.estimate, high.estimate, [level.estimate for level in good[1:-1]])
    if math.isnan(found.ratio):
        return []
    where = f'from {low.label} to {high.label} throttle'
    start = f'Whether sigma changes {where} is unknown' if found.differs is None else (
        f'Sigma grows {where}' if found.ratio_low > 1.0 else f'Sigma falls {where}'
        if found.differs else f'Sigma is the same {where} within a factor of {NARROW:g}')
    return [f'{start} (factor {number(found.ratio)}, 95 % {number(found.ratio_low)} to '
            f'{number(found.ratio_high)}).']


def notes(analysis: Analysis) -> Notes:
    """Return cautions about the numbers, worst first."""
    return worst_first([*((item.severity, _caution(item)) for item in analysis.quality),
                        *((Severity.INFO, note) for note in analysis.notes
                          if note not in {item.text for item in analysis.quality})])


def _caution(item: QualityItem) -> str:
    """Return one sentence, preceded by the throttles to which it applies."""
    at = [f'{100.0 * x:.3g}' for x in item.throttles if math.isfinite(x)]
    return f'At {listed(at)} % throttle: {item.text}' if at else item.text


def _by_throttle(analysis: Analysis) -> Part:
    curves, sag, noise = (analysis.by_throttle, analysis.overview.facts.sag,
                          analysis.overview.facts.noise)
    if math.isnan(noise.flown[0]):
        return Text('The recording has no throttle: sag and risk over throttle are unknown.')

    def millivolts(value: float) -> str:
        return number(1e3 * value) if not abs(value) < 5e-7 else '0'

    rows, throttle = [], analysis.recording.throttle
    for k, (u, flown, fall, se, rms, still, risk) in enumerate(zip(
            sag.throttle, curves.known, sag.sag_v, sag.se_v, noise.rms_v, noise.steady_rms_v,
            curves.risk)):
        if fall > FARTHEST * analysis.overview.load.level:
            break
        briefly = analysis.recording.duration * float(np.mean(np.abs(throttle - u) <= BAND))
        rows.append([
            f'{100.0 * u:.0f} %' + ('' if flown else f'\nonly {number(briefly, 2)} s' if briefly
                                    else '\nnot flown'),
            '0' if not u and fall == 0.0 else f'{millivolts(fall)} +- {millivolts(2.0 * se)}'
            if determined(analysis.overview, k, bool(flown)) else
            f'below {millivolts(fall + 2.0 * se)}' if flown and math.isfinite(fall) else UNKNOWN,
            millivolts(rms) if flown else UNKNOWN, millivolts(still) if flown else UNKNOWN,
            chance(risk)])
    heads = ['throttle', 'sag, mV', 'noise, mV rms', 'at steady throttle, mV rms',
             'brown-out risk']
    # A load that is only on or off leaves most throttles unknown.
    return Table.of_known(heads, [row for row in rows if set(row[1:]) != {UNKNOWN}], left=[0])


def _deepest(analysis: Analysis) -> list[Part]:
    dips = analysis.overview.facts.dips
    if dips is None or not dips.count:
        return []
    rows = [[number(one.begin_s, 4), number(one.lowest_v, 4), number(one.seconds, 2),
             f'{100.0 * one.throttle:.0f}' if math.isfinite(one.throttle) else UNKNOWN]
            for one in dips.deepest]
    return [Section(f'Deepest dips below {dips.limit_v:g} V', [Table.of_known(
        ['begin, s', 'lowest, V', 'below, s', 'throttle, %'], rows)], folded=True)]


def _alarms(analysis: Analysis) -> list[Part]:
    """Return when usual voltage alarms would have sounded, and for how long."""
    craft, end = analysis.craft, analysis.recording.duration
    lowest = analysis.overview.facts.lowest.time_s
    rows = [[f'{one.limit_v / craft.cells:.1f}', *(
        number(x) if one.count else UNKNOWN for x in (
            one.first_s, lowest - one.first_s, end - one.first_s)), str(one.count),
        str(one.brief), *(number(x, 2) for x in (one.longest_s, one.seconds))]
        for one in analysis.alarms]
    guess = ', a guess' * (craft.cells_from == 'guessed')
    title = f'Alarms ({counted(craft.cells, "cell")}{guess})'
    if rows and not any(one.count for one in analysis.alarms):
        highest = max(one.limit_v for one in analysis.alarms) / craft.cells
        return [Text(f'{title}: none at {highest:.1f} V per cell or below would have sounded.')]
    return [Section(title, [Table(
        ['alarm, V\nper cell', 'first at, s', 'before the lowest, s',
         'before the end, s', 'dips', 'under 1 s', 'longest, s', 'below, s'], rows),
        Text('Dips merge at a higher alarm: their number may fall while the time below '
             'grows.')])] if rows else []


def _curves(analysis: Analysis) -> list[Part]:
    learned, found = analysis.by_throttle, analysis.overview.facts
    if math.isnan(found.noise.flown[0]):
        return []
    x = 100.0 * np.array(found.sag.throttle)
    answer, error = 1e3 * np.array(found.sag.sag_v), 2e3 * np.array(found.sag.se_v)
    sag = _empty('Sag', 'mV').band(x, np.maximum(answer - error, 0.0), answer + error, '95 %', 0)
    sag.line(x, answer, 'estimate', 0, 'thick')
    noise = _empty('Noise', 'mV rms')
    for values, label, colour in ((found.noise.rms_v, 'all samples', 0),
                                  (found.noise.steady_rms_v, 'steady throttle', 2)):
        rms = np.where(learned.known, 1e3 * np.array(values), NAN)
        noise.line(x, rms, label, colour, 'thick').markers(x, rms, '', colour)
    highest = np.nanmax(np.concatenate([[1e-6], *(curve.y for curve in noise.curves)]))
    noise.limits(y=(0.0, 1.1 * float(highest)))
    risk = _empty(f'Risk of going below {learned.voltage:g} V within {learned.horizon:g} s',
                  'probability', log=True).limits(y=(_LEAST_RISK, 2.0))
    risk.line(100.0 * learned.throttle, np.where(
        np.isfinite(learned.risk), np.maximum(learned.risk, _LEAST_RISK), np.nan), '', 1, 'thick')
    if math.isfinite(learned.budget):
        risk.mark(100.0 * learned.budget, f'budget {100.0 * learned.budget:.0f} %')
    drawn = [Figure(plot) for plot, values in (
        (sag, answer), (noise, noise.curves[0].y), (risk, learned.risk))
        if np.isfinite(values).any()]
    return list(Pair.two_by_two(drawn))


def _empty(title: str, unit: str, log: bool = False) -> Plot:
    return Plot(title, 'throttle, %', unit, width=450, height=270, log_y=log).limits(
        x=(-2.0, 102.0))


def _fits(analysis: Analysis) -> list[Part]:
    levels = [level for level in analysis.levels
              if math.isfinite(level.throttle) and level.estimate.usable]
    if len(levels) < 2:
        return []
    x = np.array([100.0 * level.throttle for level in levels])
    sigma = _empty('Noise intensity \u03c3', 'V/\u221as')
    alpha = _empty('Relaxation rate \u03b1', '1/s')
    least, most = analysis.alpha_test.interval
    alpha.band(np.array([0.0, 100.0]), np.full(2, least), np.full(2, most), 'all levels, 95 %', 2)
    for plot, name in ((sigma, 'sigma'), (alpha, 'alpha')):
        low, high = np.array([level.estimate.interval(name) for level in levels]).T
        plot.bars(x, low, high, '', 7).markers(
            x, np.array([getattr(level.estimate, name) for level in levels]), 'load levels', 7)
    return [Pair([Figure(sigma), Figure(alpha)])]


def _levels(analysis: Analysis) -> list[Part]:
    levels = analysis.levels
    rows = [[level.label, number(level.time), str(level.n), number(level.mean, 4),
             *[number(1e3 * v) for v in (level.vpp, level.peak, level.vrms)],
             number(level.crest), number(1e3 * level.estimate.noise_std), level.kind.value]
            for level in levels]
    fits = [[level.label, *[_interval(level, name) for name in ('alpha', 'sigma', 'var_inf')],
             number(1e3 * level.estimate.tau)] for level in levels
            if level.estimate.usable]
    return [
        Table(['throttle', 'time, s', 'samples', 'mean, V', 'Vpp, mV', 'peak, mV', 'Vrms, mV',
               'Vpp/Vrms', 'white, mV', 'process'], rows, left=[0, 9]),
        Table(['throttle', 'alpha, 1/s\n[95 %]', 'sigma, V/sqrt(s)\n[95 %]',
               'Var_inf, V^2\n[95 %]', 'tau, ms'], fits, left=[0]),
        lambda: _fits(analysis),
        Text(analysis.alpha_test.sentence),
        Text('dU = \u2212\u03b1 (U \u2212 U\u2080) dt + \u03c3 dW; \u03c4 = 1/\u03b1; '
             'Var\u221e = \u03c3\u00b2/(2\u03b1). Vpp, peak and Vrms describe the deviation from '
             'the mean of each segment.', legend=True)]


def _interval(level: LevelResult, name: str) -> str:
    value = getattr(level.estimate, name)
    if not math.isfinite(value):
        return UNKNOWN
    low, high = level.estimate.interval(name)
    return f'{number(value)}\n[{number(low)}, {number(high)}]'


def _process(analysis: Analysis) -> list[Part]:
    rows = [[level.label, *(
        chance(test.p_adjusted) + ' *' * test.rejects
        + (f'\n{number(test.effect, 2)}' if math.isfinite(test.effect) else '')
        for test in level.shape.tests)] for level in analysis.levels]
    groups: dict[tuple[str, str], list[LevelResult]] = {}
    for level in analysis.levels:
        if level.n:
            groups.setdefault((level.kind.value, level.verdict.why), []).append(level)
    reasons = []
    for (kind, why), levels in groups.items():
        said = levels[0].verdict.sentence if len(levels) == 1 else (
            f'{why[0].upper()}{why[1:].rstrip(".")}.')
        reasons.append(f'{", ".join(level.label for level in levels)}, {kind}: {said}')
    return [
        lambda: [Table(['throttle', *_TESTS.values()], rows, left=[0]), Text(
            'p-values, Holm-adjusted over all tests of all levels; below each, the effect size. '
            '* marks a rejection: p below 0.01 and an effect large enough to matter. Every supply '
            'that relaxes is "correlated"; in the other columns, one in a hundred recordings with '
            'stationary OU levels has a rejection.')],
        Notes.of(reasons)]


def _lines(analysis: Analysis) -> list[Part]:
    """Return the spectral lines, and the smallest that would have been detected."""
    searched = [level for level in analysis.levels if not level.lines.why_not]
    if not searched:
        return []
    rows = [[level.label, f'{number(line.frequency, 4)} +- {number(line.resolution, 2)}',
             f'{number(1e3 * line.rms)}\n[{number(1e3 * line.rms_low)}, '
             f'{number(1e3 * line.rms_high)}]', percent(line.share),
             chance(line.p_value)]
            for level in searched for line in level.lines.lines]
    least = max(level.lines.detectable for level in searched)
    detectable = ('there are too few samples to know the smallest detectable line'
                  if not math.isfinite(least) else
                  f'a line of {number(1e3 * least)} mV rms would have been detected at every '
                  'level searched (90 %)')
    return [Table(['throttle', 'line, Hz', 'rms, mV\n[95 %]', 'of variance', 'p'], rows,
                  left=[0], most=_MOST_LINES) if rows else
            Text(f'No spectral line at any level (1 % false alarms); {detectable}.')]


def voltage_plot(recording: Recording, limit: float) -> Plot:
    """Return the plot of the voltage, with its limit, V."""
    plot = _over(recording, 'Voltage', 'V', 230)
    plot.line(_since_start(recording, recording.t), recording.voltage, colour=0)
    if math.isfinite(limit):
        plot.level(plot.x_range, limit, f'limit {limit:g} V', style='dash thick')
    return plot


def _over(recording: Recording, title: str, unit: str, height: int, log: bool = False) -> Plot:
    return Plot(title, 'time, s', unit, height=height, log_y=log).limits(
        x=(0.0, max(recording.duration, 1e-9)))


def _since_start(recording: Recording, t: FloatArray) -> FloatArray:
    return t - (float(recording.t[0]) if recording.n else 0.0)


def _with_segments(plot: Plot, analysis: Analysis) -> Plot:
    recording = analysis.recording
    t = _since_start(recording, recording.t)
    for k, level in enumerate(_drawn(analysis) if recording.has_throttle else ()):
        for s in level.segments:
            plot.shade(float(t[s.start]), float(t[s.stop - 1]), k, level.label)
    return plot


def _over_time(analysis: Analysis) -> list[Part]:
    recording, sliding = analysis.recording, analysis.sliding
    drawn: list[Part] = []
    if recording.has_throttle:
        plot = _over(recording, 'Throttle and load levels', '%', 150)
        plot.limits(y=(-5.0, 105.0)).steps(
            _since_start(recording, recording.t), 100.0 * recording.throttle, colour=7)
        drawn.append(Figure(_with_segments(plot, analysis), (
            'Shaded: segments used for the load levels, in the colours of the plots under '
            '"Spectrum and distribution".')))
    if np.isfinite(sliding.risk).any():
        plot = _over(recording, f'Risk of going below {sliding.brownout_voltage:g} V within '
                     f'{sliding.brownout_horizon:g} s', 'probability', 170)
        drawn.append(Figure(plot.limits(y=(-0.02, 1.02)).line(
            _since_start(recording, sliding.t), sliding.risk, colour=1, style='thick')))
    return drawn


def _sliding(analysis: Analysis) -> list[Part]:
    """Return the plots of the sliding estimate, and how many windows failed for which reason."""
    recording, sliding = analysis.recording, analysis.sliding
    if not sliding.t.size:
        return [Text(
            f'No sliding estimate: the recording is shorter than half a window of '
            f'{sliding.window:g} s.', legend=True)]
    t = _since_start(recording, sliding.t)
    drawn: list[Part] = []
    for name, title, unit in (('sigma', 'Noise intensity \u03c3', 'V/\u221as'),
                              ('alpha', 'Relaxation rate \u03b1', '1/s')):
        value = sliding.series(name)
        if not np.isfinite(value).any():
            continue
        low, high = sliding.interval(name)
        plot = _over(recording, f'{title} in a sliding window of {sliding.window:g} s', unit,
                     200, log=True)
        # Keep one very uncertain window from compressing the scale.
        plot.limits(y=span([value, low, high], log=True, trim=0.01))
        plot.band(t, low, high, '95 % interval').line(t, value, 'estimate', style='thick')
        drawn.append(Figure(plot))
    lost = Counter(e.status.value for e in sliding.estimates if not e.usable)
    if lost:
        drawn += [
            Text(f'{lost.total()} of {len(sliding.estimates)} windows have no estimate:'),
            Notes.of((f'{n} windows: {text}' for text, n in lost.items()), Severity.WARNING)]
    return drawn


def _drawn(analysis: Analysis) -> list[LevelResult]:
    """Return the levels that are drawn: the longest ones, in order of throttle."""
    longest = sorted(analysis.levels, key=lambda level: -level.time)[:_MAX_DRAWN]
    return [level for level in analysis.levels if level in longest]


def _shape(analysis: Analysis) -> list[Part]:
    spectrum = Plot('Spectrum (dashed: fitted OU and white noise)', 'frequency, Hz',
                    'PSD, V\u00b2/Hz', width=450, height=330, log_x=True, log_y=True)
    histogram = Plot('Deviation and the normal distribution',
                     'deviation / standard deviation', 'density', width=450, height=330,
                     log_y=True)
    drawn = _drawn(analysis)
    for k, level in enumerate(drawn):
        measured = level.spectrum
        if measured.frequency.size:
            spectrum.line(measured.frequency, measured.density, level.label, k, 'faint')
            spectrum.line(measured.frequency, measured.fitted, '', k, 'dash thick')
            for line in level.lines.lines[:_MAX_MARKED]:
                spectrum.mark(line.frequency, f'{line.frequency:.4g} Hz')
        edges, density = level.density()
        if density.size:
            # An empty bin cannot be drawn on a logarithmic axis.
            shown = np.where(density > 0.0, density, np.nan)
            histogram.steps(edges, np.append(shown, shown[-1]), level.label, k)
    figures = [Figure(plot) for plot in (spectrum, histogram) if plot.curves]
    if not figures:
        return [Text('No level holds enough samples for a spectrum.', legend=True)]
    z = np.linspace(-5.0, 5.0, 201)
    histogram.line(z, np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi), 'normal', 7, 'dash thick')
    histogram.limits(x=(-6.0, 6.0), y=(1e-5, 1.0))
    text = ('The spectrum of an OU is flat below the corner \u03b1/(2\u03c0) and falls with the '
            'square of frequency above it. A narrow peak is a tone; a flat floor at high '
            'frequency is white noise of the sensor.')
    extra = len(analysis.levels) - len(drawn)
    if extra > 0:
        text += f' The {extra} shortest levels are in the tables only.'
    return [Pair(figures), Text(text, legend=True)]


def simulation_document(run: Run, output: str | Path | None = None) -> Document:
    """Return the report of a simulation; `output` is the bag, if one was written."""
    terms = run.file.model.terms
    said = (f"{run.n} samples of '{run.name}', {run.duration:g} s at {run.rate:g} Hz, "
            f"{', '.join(term.NAME for term in terms)}; seed {run.seed}")
    return Document(
        'Simulation', f'{output or run.name}: {said}', [said], [
            lambda: [Figure(voltage_plot(run.recording, NAN)),
                     Figure(Plot(*(('Current', 'time, s', 'A') if run.file.model.full_current else
                                   ('Throttle', 'time, s', 'throttle')), height=160).line(
                         run.recording.t, run.load, '', 2))],
            Facts([(term.NAME, ', '.join(f'{name} {_words(value)}' for name, value in
                                         term.values().items())) for term in terms])])


def _words(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_words, value))}]"
    return f'{value:.4g}' if isinstance(value, float) else str(value)
