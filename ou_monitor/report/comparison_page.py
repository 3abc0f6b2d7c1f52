"""The report of `compare`: a recording and its simulations over each other."""

from __future__ import annotations

import numpy as np
from ou_monitor.comparison.agreement import Agreement
from ou_monitor.comparison.judgement import headline, parts, path_rows, rows
from ou_monitor.report import page
from ou_monitor.report.page import typeset
from ou_monitor.report.svg import Plot

# Colours: measured, simulated.
_MEASURED, _SIMULATED = 7, 1


def comparison_page(found: Agreement, command: str = '') -> str:
    """Return the report of a comparison."""
    sections = [
        page.headline(headline(found)), page.figure(_voltage(found), _VOLTAGE),
        page.section('Side by side', page.table(
            ['', 'Measured', 'Simulated\n[95 %]'], [_row(*row) for row in rows(found)], left=[0])),
        page.section('Mean path and distribution', page.facts(
            [(name, typeset(value)) for name, value in path_rows(found)])),
        page.section('Throttle, answer to its rises, distribution, spectrum', *_others(found),
                     folded=True),
        page.section('Where it comes from', *_origin(found, command), folded=True)]
    return page.page(f'Beside its simulation: {found.recording or "recording"}', parts(found),
                     sections)


def _row(name: str, measured: str, simulated: str, remark: str) -> list[str]:
    """Return cells that are narrow enough for a phone: units and bands below."""
    what, _, unit = name.rpartition(', ')
    value, _, band = simulated.partition(' ')
    return [f'{what}\n{unit}', typeset(measured),
            f'{typeset(value)}\n{typeset(band)}' + (f', {remark}' if remark else '')]


_VOLTAGE = ('Line: measured. Band: 95 % of the simulations at each moment. Pale line: one of '
            'them. Broken lines: the levels whose falls are counted.')


def _voltage(found: Agreement) -> Plot:
    at = found.traces
    plot = Plot('Voltage, measured and simulated', 'time, s', 'voltage, V', height=300,
                legend_row=True)
    plot.band(at.at, at.low, at.high, 'simulated, 95 %', _SIMULATED)
    plot.line(at.t, at.simulated, 'one simulation', _SIMULATED, 'faint')
    plot.line(at.t, at.voltage, 'measured', 0)
    for level in found.levels:
        plot.line(np.array([at.t[0], at.t[-1]]), np.full(2, level), '', _MEASURED, 'dash')
    return plot


def _others(found: Agreement) -> list[str]:
    at = found.traces
    drawn = []
    if np.isfinite(at.throttle).any():
        drawn.append(page.figure(Plot('Throttle', 'time, s', 'throttle', height=160).line(
            at.t, at.throttle, '', 2)))
    beside = []
    if at.answer.size:
        plot = Plot('Mean answer to rises of throttle', 'time after, s', 'change, V', width=450,
                    height=250, legend_row=True)
        plot.band(at.after, at.answer_low, at.answer_high, 'simulated, 95 %', _SIMULATED)
        beside.append(page.figure(plot.line(at.after, at.answer, 'measured', 0, 'thick')))
    plot = Plot('Distribution', 'voltage, V', 'share of time below', width=450, height=250,
                legend_row=True)
    plot.line(at.edges, at.simulated_distribution, 'simulated', _SIMULATED, 'thick')
    beside.append(page.figure(plot.line(at.edges, at.distribution, 'measured', 0, 'thick')))
    return [*drawn, page.pair(*beside), page.figure(_spectrum(found))]


def _spectrum(found: Agreement) -> Plot:
    middle = np.array([np.sqrt(one.low_hz * one.high_hz) for one in found.spectrum])
    power = [one.power for one in found.spectrum]
    plot = Plot('Power by band of frequency', 'frequency, Hz', 'power, V\u00b2', height=220,
                log_x=True, log_y=True, legend_row=True)
    plot.bars(middle, np.array([one.low for one in power]), np.array([one.high for one in power]),
              'simulated, 95 %', _SIMULATED)
    plot.markers(middle, np.array([one.measured for one in power]), 'measured', 0)
    return plot.limits((found.spectrum[0].low_hz, found.spectrum[-1].high_hz))


def _origin(found: Agreement, command: str) -> list[str]:
    return [*([page.code(command)] if command else []),
            page.paragraph(f'Terms of the model: {", ".join(found.model)}.'),
            page.paragraph(
                f'{found.seeds} simulations with the stamps, the throttle and the steps of the '
                f'ADC of the recording. {100.0 * found.p_value:.0f} % of them, the recording '
                'counted with them, are as far off as the recording is; below 5 % it is said to '
                'differ.',
                soft=True),
            page.bullets(list(found.notes))]
