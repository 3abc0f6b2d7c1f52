"""The report of `compare`: a recording, overlaid with simulations of it."""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.analysis.overview import known_lines, Overview
from ou_monitor.comparison.compare import Agreement, BAND, LEVEL, Likeness
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Part, Section, Table, Text)
from ou_monitor.report.svg import Plot
from ou_monitor.text import listed, number

# Colours: measured, simulated.
_MEASURED, _SIMULATED = 7, 1
_VOLTAGE = ('Line: measured. Band: 95 % of the simulations at each moment. Pale line: one '
            'simulation. Dashed lines: levels below which dips are counted.')
# Value of `Agreement.fitted` if the model was given, not fitted.
_NOTHING = (0.0, 0.0)


def comparison_document(found: Agreement, seen: Overview) -> Document:
    """Return the report of a comparison; `seen` holds the facts of the recording."""
    first, last = found.simulated
    subject = (f'{found.recording or "recording"}: '
               + ('' if found.fitted == _NOTHING else
                  f'fitted 0 to {number(found.fitted[1], 4)} s, ')
               + f'simulated {number(first, 4)} to {number(last, 4)} s'
               + (' with the model given' if found.fitted == _NOTHING else '')
               + f'; model: {", ".join(found.model)}{seen.pauses}')
    parts: list[Part] = [
        lambda: [Figure(_voltage(found), _VOLTAGE)],
        Table(['', 'measured', 'simulated\n[95 %]', ''], _rows(found), left=[0, 3]),
        Facts(_path(found)), Section('The whole recording', [Facts(known_lines(seen))]),
        lambda: [Section('Throttle, response to rises, distribution, spectrum', _others(found),
                         folded=True)],
        Notes.of(found.notes),
        Text(f'{found.seeds} simulations with the stamps, throttle and ADC steps of the '
             f'recording. Of these and the recording, {100.0 * found.p_value:.0f} % deviate at '
             f'least as much as the recording; at {100.0 * LEVEL:g} % or less the recording is '
             'reported to differ.',
             legend=True)]
    return Document('Compared with its simulation', subject, [*seen.beware, *_answer(found)],
                    parts)


def _answer(found: Agreement) -> list[str]:
    if found.verdict is Likeness.DIFFERS:
        more = [] if found.farthest == 'lowest' else [f'Beside it: {found.lowest.words}.']
        return [f'{found.verdict.value}: {found.words}.', *more]
    # Without load changes the mean path is at most a drift, and not worth a sentence.
    path = [] if not (found.of('answer') and found.explained > 0.0) else [
        f'Its mean path explains {100.0 * found.explained:.0f} % of the variance.']
    outside = [row.name for row in found.rows if not row.inside]
    if outside:
        chance = 'more than chance explains' if found.in_part else 'chance allows this'
        path.append(f'Outside their own bands ({chance} with {len(found.rows)} numbers): '
                    f'{listed(outside)}.')
    return [f"{found.verdict.value}{' only in part' * found.in_part}: {found.lowest.words}.",
            *path]


def _rows(found: Agreement) -> list[tuple[str, str, str, str]]:
    """Return quantity, measured, simulated with its 95 % band, and a remark."""
    out = []
    for row in found.rows:
        unit, measured, low, median, high = row.texts
        out.append((f'{row.name}, {unit}' if unit else row.name, measured,
                    f'{median}\n[{low}, {high}]', '' if row.inside else 'outside'))
    return out


def _path(found: Agreement) -> list[tuple[str, str]]:
    thirds = ', '.join(number(1e3 * b, 2) for b in found.bias_by_third)
    chance = '' if found.in_part else 'within chance: '
    worst = [('Largest difference', f'{chance}{found.words}')] * (
        found.verdict is Likeness.LOOKS_LIKE_IT)
    share = f'{number(100.0 * found.explained, 3)} %' if found.explained > 0.0 else 'none'
    return [('Mean path', f'explains {share} of the variance; rms '
             f'error {number(1e3 * found.rmse, 3)} mV, bias {number(1e3 * found.bias, 2)} mV (in '
             f'each third: {thirds})'),
            *worst]


def _voltage(found: Agreement) -> Plot:
    t = found.part.t
    plot = Plot('Voltage, measured and simulated', 'time, s', 'voltage, V', height=300)
    low, high = np.percentile(found.drawn, BAND, axis=0)
    plot.band(t[::found.stride], low, high, 'simulated, 95 %', _SIMULATED)
    plot.line(t, found.one, 'one simulation', _SIMULATED, 'faint')
    plot.line(t, found.part.voltage, 'measured', 0)
    for row in found.of('dips'):
        plot.level(t, row.at[0], '', _MEASURED)
    return plot


def _others(found: Agreement) -> list[Part]:
    own, *others = found.measured
    ruler = found.yardstick
    drawn: list[Part] = []
    if found.part.has_throttle:
        drawn.append(Figure(Plot('Throttle', 'time, s', 'throttle', height=160).line(
            found.part.t, found.part.throttle, '', 2)))
    beside = []
    if own.response.size:
        plot = Plot(f'Mean response to {ruler.rises.size} rises of throttle',
                    'time since the rise, s', 'change, V', width=450, height=250)
        low, high = np.percentile([one.response for one in others], BAND, axis=0)
        plot.band(ruler.after, low, high, 'simulated, 95 %', _SIMULATED)
        beside.append(Figure(plot.line(ruler.after, own.response, 'measured', 0, 'thick')))
    plot = Plot('Distribution', 'voltage, V', 'share of time below', width=450, height=250)
    plot.line(ruler.edges, np.mean([one.distribution for one in others], axis=0), 'simulated',
              _SIMULATED, 'thick')
    beside.append(Figure(plot.line(ruler.edges, own.distribution, 'measured', 0, 'thick')))
    return [*drawn, Pair(beside), Figure(_spectrum(found))]


def _spectrum(found: Agreement) -> Plot:
    power = found.of('spectrum')
    middle = np.array([math.sqrt(row.at[0] * row.at[1]) for row in power])
    plot = Plot('Rms by frequency band', 'frequency, Hz', 'rms, V', height=220,
                log_x=True, log_y=True)
    plot.bars(middle, np.array([one.low for one in power]), np.array([one.high for one in power]),
              'simulated, 95 %', _SIMULATED)
    plot.markers(middle, np.array([one.measured for one in power]), 'measured', 0)
    return plot.limits((power[0].at[0], power[-1].at[1]))
