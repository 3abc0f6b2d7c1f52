"""The report of `analyze`: one page, read in two minutes."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.analysis.analyze import Analysis
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.relaxation import Relaxation
from ou_monitor.analysis.words import (
    brownout_sentence, caution, facts, headline, relaxation_sentence)
from ou_monitor.criticism.curves import outline
from ou_monitor.records import FloatArray
from ou_monitor.report import page
from ou_monitor.report.page import probability, rounded, UNKNOWN
from ou_monitor.report.scale import span
from ou_monitor.report.svg import Plot

# Changes drawn in one plot, and relaxation times of them.
_MOST_DRAWN, _DRAWN_TAUS = 6, 8.0
# Smaller risks are drawn as this.
_LEAST_RISK = 1e-4
_TESTS = {'mean_drift': 'Mean moves', 'variance_drift': 'Intensity moves',
          'gaussian': 'Not Gaussian', 'impulses': 'Impulses', 'correlated': 'Correlated',
          'one_relaxation': 'Not one relaxation', 'second_relaxation': 'Second relaxation'}


def quality(analysis: Analysis) -> str:
    """Return the list of what is doubtful, and why each level is called what it is called."""
    rows = [[item.severity.name.lower(), caution(item)] for item in analysis.quality]
    if not rows:
        return page.paragraph('No quality flag was raised.')
    return (page.bullets([f'{severity}: {text}' for severity, text in rows
                          if severity != 'info'], warn=True)
            + page.bullets([text for severity, text in rows if severity == 'info']))


def process(analysis: Analysis) -> list[str]:
    """Return the tests behind the kind of process of each level."""
    rows = []
    for level in analysis.levels:
        cells = []
        for test in level.shape.tests:
            strength = f'\n{rounded(test.effect, 2)}' if math.isfinite(test.effect) else ''
            mark = ' *' if test.rejects else ''
            cells.append(probability(test.p_adjusted) + mark + strength)
        rows.append([level.label, level.kind.value, *cells])
    reasons = [f'{level.label}, {level.kind.value}: {level.verdict.sentence}'
               for level in analysis.levels if level.n]
    return [
        page.table(['Throttle', 'Process', *_TESTS.values()], rows, left=[0, 1]),
        page.paragraph(
            'p-values, adjusted by Holm over all tests of all levels, and below each the effect; '
            '* rejects: p below 0.01 and an effect of consequence. In one of a hundred recordings '
            'of stationary OU levels any test but "Correlated" rejects; "Correlated" rejects '
            'wherever the supply relaxes.', soft=True),
        page.bullets(reasons)]


def lines(analysis: Analysis) -> list[str]:
    """Return the spectral lines, and the least that would have been detected."""
    rows = [[level.label, f'{rounded(line.frequency, 4)}\n\u00b1 {rounded(line.resolution, 2)}',
             f'{rounded(1e3 * line.rms)}\n{rounded(1e3 * line.rms_low)} to '
             f'{rounded(1e3 * line.rms_high)}', f'{100.0 * line.share:.2g} %',
             probability(line.p_value)]
            for level in analysis.levels for line in level.lines.lines]
    searched = [level for level in analysis.levels if not level.lines.why_not]
    if not searched:
        return []
    detail = ', '.join(f'{level.label}: {rounded(1e3 * level.lines.detectable)} mV'
                       for level in searched)
    text = (f'One in a hundred recordings without lines has one reported. RMS of a line '
            f'that would have been detected with 90 %: {detail}.')
    if not rows:
        return [page.paragraph('No spectral line stands out of the noise at any level.'),
                page.paragraph(text, soft=True)]
    return [page.table(['Throttle', 'Line, Hz', 'RMS, mV', 'Of the variance', 'p'], rows,
                       left=[0]), page.paragraph(text, soft=True)]


def transients(analysis: Analysis) -> list[str]:
    """Return what follows changes of load."""
    if not analysis.recording.has_throttle:
        return []
    parts = []
    for k, fit in enumerate(analysis.relaxations):
        if fit.releases or k == 0:
            parts.append(page.paragraph(relaxation_sentence(analysis, k)))
        if fit.detected:
            parts += [page.figure(_relaxing(analysis, fit)), _changes(analysis, fit)]
    return parts


def _relaxing(analysis: Analysis, fit: Relaxation) -> Plot:
    """Return voltages less the level that they settle at, and the fit."""
    recording = analysis.recording
    what = 'falls' if fit.kind == 'release' else 'rises'
    plot = Plot(f'After throttle {what} (dashed: fit)', 'time since throttle arrived, ms', 'mV',
                height=240)
    for k, change in enumerate(fit.releases[:_MOST_DRAWN]):
        if not math.isfinite(change.amplitude):
            continue
        stop = change.t + min(change.duration, _DRAWN_TAUS * fit.tau)
        here = slice(int(np.searchsorted(recording.t, change.t)),
                     int(np.searchsorted(recording.t, stop, side='right')))
        since = recording.t[here] - change.t
        plot.line(1e3 * since, 1e3 * (recording.voltage[here] - change.level),
                  f'{100.0 * change.throttle_before:.3g} to '
                  f'{100.0 * change.throttle_after:.3g} %', k, 'faint')
        plot.line(1e3 * since, 1e3 * fit.decay(change, since), '', k, 'dash thick')
    return plot


def _changes(analysis: Analysis, fit: Relaxation) -> str:
    start = float(analysis.recording.t[0])
    side = 'Overshoot, mV' if fit.kind == 'release' else 'Undershoot, mV'
    rows = [[rounded(change.t - start, 4),
             f'{100.0 * change.throttle_before:.3g} to {100.0 * change.throttle_after:.3g} %',
             _with_error(change.level_before, change.level_before_se, 4, 1.0),
             _with_error(change.level, change.level_se, 4, 1.0),
             _with_error(change.amplitude, change.amplitude_se, 3, 1e3),
             rounded(1e3 * change.beyond), probability(change.beyond_p)]
            for change in fit.clear]
    return '' if not rows else page.table(
        ['At, s', 'Throttle', 'Level before, V', 'Level after, V', 'A, mV', side, 'p of noise'],
        rows, left=[1])


def _with_error(value: float, se: float, digits: int, scale: float) -> str:
    if not math.isfinite(value):
        return UNKNOWN
    return f'{rounded(scale * value, digits)} \u00b1 {rounded(scale * se, 2)}'


def curves(analysis: Analysis) -> list[str]:
    """Return level, sag, intensity, alpha and risk over throttle."""
    learned = analysis.by_throttle
    levels = [level for level in analysis.levels
              if math.isfinite(level.throttle) and level.n]
    load, highest = analysis.overview.load, analysis.overview.highest
    parts = []
    if levels or learned.known.any() or load.known:
        x = 100.0 * learned.throttle
        sag, sigma = _empty('Sag', 'mV'), _empty('Noise intensity \u03c3', 'V/\u221as')
        answer = np.full(x.size, np.nan)
        if load.known:
            flown = learned.throttle <= highest
            answer, least, most = (np.where(flown, 1e3 * values, np.nan) for values in (
                learned.sag, learned.sag_low, learned.sag_high))
            sag.band(x, np.maximum(least, 0.0), most, '95 %', 0)
            sag.line(x, answer, 'load filter', 0, 'thick')
        at = _column([100.0 * level.throttle for level in levels])
        _with_levels(sag, at, 1e3 * _column([level.sag.sag for level in levels]),
                     1e3 * _column([level.sag.interval for level in levels]))
        _with_estimates(sigma, at, levels, 'sigma')
        risk, alpha = _empty(f'Risk of going below {learned.voltage:g} V within '
                             f'{learned.horizon:g} s', 'probability', log=True), _empty(
                                 'Relaxation rate \u03b1', '1/s')
        risk.line(x, np.where(np.isfinite(learned.risk), np.maximum(learned.risk, _LEAST_RISK),
                              np.nan), '', 1, 'thick')
        risk.limits(y=(_LEAST_RISK, 2.0))
        if math.isfinite(learned.budget):
            risk.mark(100.0 * learned.budget, f'budget {100.0 * learned.budget:.0f} %')
        test = analysis.alpha_test
        low, high = test.interval
        alpha.band(np.array([0.0, 100.0]), np.full(2, low), np.full(2, high), 'common, 95 %', 2)
        _with_estimates(alpha, at, levels, 'alpha')
        drawn = [plot for plot, values in (
            (sag, [*answer, *(level.sag.sag for level in levels)]),
            (sigma, [level.estimate.sigma for level in levels]),
            (risk, list(learned.risk)),
            (alpha, [level.estimate.alpha for level in levels])) if np.isfinite(values).any()]
        parts += [page.pair(*(page.figure(plot) for plot in drawn[k:k + 2]))
                  for k in range(0, len(drawn), 2)]
    return [*parts, page.paragraph(brownout_sentence(analysis)),
            page.paragraph(analysis.alpha_test.sentence)]


def _empty(title: str, unit: str, log: bool = False) -> Plot:
    return Plot(title, 'throttle, %', unit, width=450, height=270, log_y=log,
                legend_row=not log).limits(x=(-2.0, 102.0))


def _column(values: Sequence[float] | Sequence[tuple[float, float]]) -> FloatArray:
    return np.array(values, dtype=np.float64)


def _with_levels(plot: Plot, x: FloatArray, y: FloatArray, ends: FloatArray) -> None:
    """Add the load levels with their intervals, shape (n, 2)."""
    low, high = ends.reshape(-1, 2).T
    plot.bars(x, low, high, '', 7).markers(x, y, 'load levels', 7)


def _with_estimates(plot: Plot, x: FloatArray, levels: Sequence[LevelResult], name: str) -> None:
    _with_levels(plot, x, _column([getattr(level.estimate, name) for level in levels]),
                 _column([level.estimate.interval(name) for level in levels]))


# More levels than colours would repeat colours.
_MAX_DRAWN = 6
# Lines marked in the spectrum of one level.
_MAX_MARKED = 3


def analysis_page(analysis: Analysis, command: str = '') -> str:
    """Return the report of an analysis."""
    recording = analysis.recording
    rate = (recording.n - 1) / recording.duration if recording.duration > 0.0 else math.nan
    subtitle = (f'{recording.n} samples in {recording.duration:.4g} s, '
                f'{rounded(rate)} Hz on average')
    after = transients(analysis)
    first, *others = _over_time(analysis)
    sliding = _sliding(analysis)
    sections = [
        page.headline(headline(analysis)), first, page.facts(typeset_facts(analysis)), *others,
        page.section('Load levels', _levels_table(analysis.levels), _ou_table(analysis.levels)),
        page.section('What to know before using these numbers', quality(analysis)),
        page.section('Over throttle', *curves(analysis)),
        page.section('Sigma and alpha over time', *sliding, folded=True),
        *([page.section('After changes of throttle', *after, folded=True)] if after else []),
        page.section('Shape', *_shape(analysis), *lines(analysis), folded=True),
        page.section('Type of process', *process(analysis), folded=True),
        page.section('Where it comes from', _origin(analysis, command), folded=True),
    ]
    return page.page(f'Supply noise: {recording.name or "recording"}', subtitle, sections)


def _interval(level: LevelResult, name: str, scale: float = 1.0, invert: bool = False) -> str:
    """Return an estimate with its interval on a second line."""
    e = level.estimate
    value = getattr(e, name)
    if not math.isfinite(value):
        return UNKNOWN
    low, high = e.interval(name)
    if invert:
        value, low, high = 1.0 / value, 1.0 / high, 1.0 / low
    return (f'{rounded(scale * value)}\n{rounded(scale * low)} to {rounded(scale * high)}')


def _levels_table(levels: Sequence[LevelResult]) -> str:
    rows = [[level.label, rounded(level.time), str(level.n), rounded(level.mean, 4),
             *[rounded(1e3 * v) for v in (level.vpp, level.peak, level.vrms)],
             rounded(level.crest), level.kind.value] for level in levels]
    return page.table(['Throttle', 'Time, s', 'Samples', 'Mean, V', 'Vpp, mV', 'Peak, mV',
                       'Vrms, mV', 'Vpp/Vrms', 'Process'], rows, left=[0, 8])


def _ou_table(levels: Sequence[LevelResult]) -> str:
    rows = [[level.label, _interval(level, 'alpha'), _interval(level, 'alpha', 1e3, invert=True),
             _interval(level, 'sigma'), _interval(level, 'var_inf'),
             rounded(1e3 * level.estimate.noise_std), level.estimate.status.name]
            for level in levels]
    heads = ['Throttle', '\u03b1, 1/s', '\u03c4, ms', '\u03c3, V/\u221as', 'Var\u221e, V\u00b2',
             'White noise, mV', 'Status']
    return page.table(heads, rows, left=[0, 6]) + page.paragraph(
        'dU = \u2212\u03b1 (U \u2212 U\u2080) dt + \u03c3 dW; \u03c4 = 1/\u03b1; Var\u221e = '
        '\u03c3\u00b2/(2\u03b1). Small: 95 % interval. Vpp, peak and Vrms are of the deviation '
        'from the mean of each segment.', soft=True)


def typeset_facts(analysis: Analysis) -> list[tuple[str, str]]:
    """Return what is known, set for a page."""
    return [(name, words.replace('+-', '\u00b1')) for name, words in facts(analysis)]


def _over_time(analysis: Analysis) -> list[str]:
    """Return the plots over time; the voltage, with the limit, is the first."""
    recording, sliding = analysis.recording, analysis.sliding
    start = float(recording.t[0]) if recording.n else 0.0
    t = recording.t - start
    limits = (0.0, max(recording.duration, 1e-9))
    voltage = Plot('Voltage', 'time, s', 'V', height=230).limits(x=limits)
    voltage.line(t, recording.voltage, colour=0)
    limit = analysis.overview.limit
    if math.isfinite(limit):
        ends = np.array(limits)
        voltage.line(ends, np.full(2, limit), f'limit {limit:g} V', 1, 'dash thick')
    drawn = [page.figure(voltage, _levels_caption(analysis))]
    if recording.has_throttle:
        throttle = Plot('Throttle, and the load levels found in it', 'time, s', '%', height=150)
        throttle.limits(x=limits, y=(-5.0, 105.0)).steps(t, 100.0 * recording.throttle, colour=7)
        for k, level in enumerate(_drawn(analysis)):
            for s in level.segments:
                throttle.shade(float(t[s.start]), float(t[s.stop - 1]), k)
                voltage.shade(float(t[s.start]), float(t[s.stop - 1]), k, level.label)
        drawn = [page.figure(voltage),
                 page.figure(throttle, _levels_caption(analysis))]
    if np.isfinite(sliding.risk).any():
        plot = Plot(f'Risk of going below {sliding.brownout_voltage:g} V within '
                    f'{sliding.brownout_horizon:g} s', 'time, s', 'probability', height=170)
        plot.limits(x=limits, y=(-0.02, 1.02))
        plot.line(sliding.t - start, sliding.risk, colour=1, style='thick')
        drawn.append(page.figure(plot))
    return drawn


def _sliding(analysis: Analysis) -> list[str]:
    """Return the plots of the sliding estimate, and why some windows have none."""
    recording, sliding = analysis.recording, analysis.sliding
    if not sliding.t.size:
        return [page.paragraph(
            f'No sliding estimate: the recording is shorter than half a window of '
            f'{sliding.window:g} s.', soft=True)]
    start = float(recording.t[0])
    limits = (0.0, max(recording.duration, 1e-9))
    drawn = []
    known = np.array([e.usable for e in sliding.estimates])
    for name, title, unit in (('sigma', 'Noise intensity \u03c3', 'V/\u221as'),
                              ('alpha', 'Relaxation rate \u03b1', '1/s')):
        value = sliding.series(name)
        if not np.isfinite(value).any():
            continue
        low, high = sliding.interval(name)
        plot = Plot(f'{title} in a sliding window of {sliding.window:g} s', 'time, s', unit,
                    height=200, log_y=True).limits(x=limits)
        # One window without information must not flatten all the others.
        plot.limits(y=span([value, low, high], log=True, trim=0.01))
        plot.band(sliding.t - start, low, high, '95 % interval')
        plot.line(sliding.t - start, value, 'estimate', style='thick')
        drawn.append(page.figure(plot))
    lost = int((~known).sum())
    if lost:
        counts: dict[str, int] = {}
        for e in sliding.estimates:
            if not e.usable:
                counts[e.status.value] = counts.get(e.status.value, 0) + 1
        drawn.append(page.paragraph(f'{lost} of {known.size} windows carry no estimate:'))
        drawn.append(page.bullets([f'{n} windows: {text}' for text, n in counts.items()],
                                  warn=True))
    return drawn


def _drawn(analysis: Analysis) -> list[LevelResult]:
    """Return the levels that get a colour: those with most time, in order of throttle."""
    longest = sorted(analysis.levels, key=lambda level: -level.time)[:_MAX_DRAWN]
    return [level for level in analysis.levels if level in longest]


def _levels_caption(analysis: Analysis) -> str:
    if not analysis.recording.has_throttle:
        return 'Every peak is shown: each column of pixels holds its lowest and highest sample.'
    return ('Shaded: the segments used for the load levels, in the colours of the plots of the '
            'shape. Every peak is shown.')


def _shape(analysis: Analysis) -> list[str]:
    spectrum = Plot('Spectrum (dashed: fitted OU and white noise)', 'frequency, Hz',
                    'PSD, V\u00b2/Hz', width=450, height=330, log_x=True, log_y=True,
                    legend_low=True)
    histogram = Plot('Deviation and the normal law',
                     'deviation / standard deviation', 'density', width=450, height=330,
                     log_y=True)
    drawn = _drawn(analysis)
    fitted, counted = 0, 0
    for k, level in enumerate(drawn):
        measured = level.spectrum
        if measured.frequency.size:
            fitted += 1
            spectrum.line(measured.frequency, measured.density, level.label, k, 'faint')
            spectrum.line(measured.frequency, measured.fitted, '', k, 'dash thick')
            for line in level.lines.lines[:_MAX_MARKED]:
                spectrum.mark(line.frequency, f'{line.frequency:.4g} Hz')
        edges, density = level.density()
        if density.size:
            counted += 1
            # An empty bin has no place on a logarithmic axis.
            histogram.line(*outline(edges, np.where(density > 0.0, density, np.nan)),
                           level.label, k)
    z = np.linspace(-5.0, 5.0, 201)
    histogram.line(z, np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi), 'normal', 7, 'dash thick')
    histogram.limits(x=(-6.0, 6.0), y=(1e-5, 1.0))
    figures = []
    if fitted:
        figures.append(page.figure(spectrum))
    if counted:
        figures.append(page.figure(histogram))
    if not figures:
        return [page.paragraph('No level holds enough samples for a spectrum.', soft=True)]
    text = ('An OU is flat below its corner \u03b1/(2\u03c0) and falls with the square of '
            'frequency above it; a line that stands out is a tone, a flat floor at high '
            'frequency is white noise of the sensor.')
    extra = len(analysis.levels) - len(drawn)
    if extra > 0:
        text += f' The {extra} shortest levels are in the tables only.'
    return [page.pair(*figures), page.paragraph(text, soft=True)]


def _origin(analysis: Analysis, command: str) -> str:
    recording = analysis.recording
    rows = [[name, value] for name, value in recording.source.items()]
    parts = [page.table(['Source', ''], rows, left=[0, 1]) if rows else '']
    notes = [note for note in analysis.notes if note]
    parts.append(page.bullets(notes) if notes else page.paragraph('Nothing was dropped.'))
    if command:
        parts += [page.paragraph('To repeat this analysis:'), page.code(command)]
    return '\n'.join(parts)
