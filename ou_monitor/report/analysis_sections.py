"""Sections of the report of `analyze` that show tests, lines, transients and curves."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.analysis.analyze import Analysis
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.relaxation import Relaxation
from ou_monitor.analysis.words import brownout_sentence, caution, relaxation_sentence
from ou_monitor.records import FloatArray
from ou_monitor.report import page
from ou_monitor.report.page import probability, rounded, UNKNOWN
from ou_monitor.report.svg import Plot
from ou_monitor.text import Z95

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
            answer, error = (np.where(flown, 1e3 * values, np.nan) for values in (
                load.sag(learned.throttle), load.sag_se(learned.throttle)))
            sag.band(x, np.maximum(answer - Z95 * error, 0.0), answer + Z95 * error, '95 %', 0)
            sag.line(x, answer, 'load filter', 0, 'thick')
        sigma.band(x, learned.sigma_low, learned.sigma_high, '95 %', 0)
        sigma.line(x, learned.sigma, 'learned as by the node', 0, 'thick')
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
            (sigma, [*learned.sigma, *(level.estimate.sigma for level in levels)]),
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
