"""The report of `discover`: what the simulation gets wrong, why, and the gain."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from html import escape
import math

import numpy as np
from ou_monitor.criticism.curves import compare_curves, Comparison
from ou_monitor.discovery.finding import Criticism, Finding
from ou_monitor.discovery.plain_names import headline, PLAIN_NAMES
from ou_monitor.discovery.words import (
    cause_rows, crossing_words, gain_remark, MNAT, NOT_KNOWN, overlap_words, plain_model_words,
    plain_words, with_error)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.report import page
from ou_monitor.report.page import rounded, UNKNOWN
from ou_monitor.report.scale import span
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, number

# Rows of statistics drawn at most.
_ROWS = 18
# Rows of dots: sizes, in pixels.
_WIDTH, _LEFT, _RIGHT, _ROW, _TOP, _BOTTOM = 860, 250, 20, 22, 34, 40
# Simulations behind the voltage.
_DRAWS = 20
# Scores up to about this are drawn on a straight scale, larger ones on a logarithmic.
_STRAIGHT = 4.0
_TICKS = (0.0, 4.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 10000.0)


def discovery_page(finding: Finding, command: str = '',
                   progress: Callable[[float], None] | None = None,
                   facts: Sequence[tuple[str, str]] = ()) -> str:
    """Return the report of a discovery; facts: what is known of the recording anyway."""
    subtitle = f'{finding.n} samples in {number(finding.duration, 4)} s'
    if finding.samples is not None and finding.samples.n != finding.n:
        subtitle += f', of which {finding.samples.n} were used'
    sections = [page.headline(_typeset(headline(finding)))]
    if finding.samples is not None:
        sections.append(page.figure(_voltage(finding), _VOLTAGE.format(_model_name(finding))
                                    if finding.simulated else ''))
    if facts:
        sections.append(page.facts([(name, _typeset(words)) for name, words in facts]))
    if finding.baseline is not None:
        sections += [page.section('Causes', *_causes(finding)),
                     page.section('Gain' if finding.causes else 'What it predicts',
                                  *_gain(finding)),
                     page.section(
                         'Statistics before and after' if finding.causes else 'Statistics',
                         *_statistics(finding), folded=True),
                     page.section('Data beside simulations', *_comparisons(finding), folded=True),
                     page.section('What is left', *_left(finding), folded=True),
                     page.section('Parameters', *_parameters(finding), folded=True)]
    if progress is not None:
        progress(1.0)
    sections.append(page.section('Where it comes from', *_origin(finding, command), folded=True))
    return page.page(f'What the simulation gets wrong: {finding.recording or "recording"}',
                     subtitle, sections)


_VOLTAGE = ('Band: range of 20 simulations of the {} at each moment, with the throttle of the '
            'recording.')


def _model_name(finding: Finding) -> str:
    """Return what the model that is simulated is called."""
    return 'extended model' if finding.causes else 'plain OU'


def _voltage(finding: Finding) -> Plot:
    """Return the voltage over the band of simulations of the model."""
    samples = finding.samples
    assert samples is not None
    t = samples.t - samples.t[0]
    plot = Plot('Voltage', 'time, s', 'V', height=230, legend_row=True)
    if finding.simulated is not None:
        rng = np.random.default_rng(finding.seed)
        low, high = np.full(samples.n, np.inf), np.full(samples.n, -np.inf)
        for _ in range(_DRAWS):
            try:
                drawn = finding.simulated.simulate(samples.t, rng, samples.throttle)
            except ValueError:
                # A force that runs away has no simulation.
                break
            low, high = np.fmin(low, drawn), np.fmax(high, drawn)
        if np.isfinite(low).all():
            plot.band(t, low, high, 'simulated', 1)
    return plot.line(t, samples.logged, 'measured', 0)


def _typeset(text: str) -> str:
    return text.replace('+-', '\u00b1')


def _value(value: float, digits: int = 3) -> str:
    return rounded(value, digits) if math.isfinite(value) else NOT_KNOWN


def _with_error(value: float, error: float) -> str:
    if not math.isfinite(value):
        return NOT_KNOWN
    return _value(value) + (f' \u00b1 {_value(error, 2)}' if math.isfinite(error) else '')


def _minus(text: str) -> str:
    """Return a number that stands at the front with a true minus."""
    return '\u2212' + text[1:] if text.startswith('-') else text


def _total_gain(finding: Finding) -> str:
    remark = gain_remark(finding.gain, finding.gain_se) if finding.causes else ''
    return (f'gain {_with_error(finding.gain, finding.gain_se)}'
            + (f'\n{remark}' if remark else ''))


def _causes(finding: Finding) -> list[str]:
    if not finding.causes:
        return [page.paragraph('No cause was named.')]
    found = cause_rows(finding.causes)
    overlap = overlap_words(finding.causes, finding.gain)
    rows = [[f'{PLAIN_NAMES.get(row.name, row.name)}\n{row.label}', row.family,
             _minus(_typeset(row.gain)) + (f'\n{row.remark}' if row.remark else ''),
             row.chance, ', '.join(row.alternatives) or UNKNOWN] for row in found]
    return [
        page.table(['Cause', 'Family', 'Gain, mnat per sample', 'p', 'Alternatives'], rows,
                   left=[0, 1, 4]),
        *([page.paragraph(overlap)] if overlap else []),
        page.bullets([_typeset(
            f'{PLAIN_NAMES.get(row.name, row.name)} ({row.label}): {row.explanation}')
            for row in found]),
        page.paragraph(
            'Gain: the loss of held-out score when the cause is left out and the rest is fitted '
            'again; its standard error comes from means of blocks and from the errors of the '
            'parameters. p: twice the smaller of two chances, that of the likelihood ratio on the '
            'part fitted (its search counted) and that of the gain. The samples themselves show '
            'exact findings; those undone in the samples share one gain. Terms of one kind that '
            'share a gain are one row.',
            soft=True),
        page.paragraph(MNAT, soft=True)]


def _gain(finding: Finding) -> list[str]:
    c = finding.crossing
    rows = [['Score on blocks kept back, nats per sample', _value(finding.baseline_score, 4),
             _value(finding.score, 4), _total_gain(finding)]]
    if math.isfinite(c.level):
        rows.append([
            f'Falls through {_value(c.level, 4)} V per minute',
            _with_error(c.baseline, c.baseline_se), _with_error(c.extended, c.extended_se),
            f'{_with_error(c.observed, c.observed_se)}, observed'])
    head = ['', 'Plain OU', 'Extended', '']
    if not finding.causes:
        # Nothing was added to the plain OU: there is nothing to compare it with.
        head, rows = ['', 'Plain OU', ''], [
            [row[0], row[1], row[3] if 'observed' in row[3] else ''] for row in rows]
    assert finding.baseline is not None
    return [page.table(head, rows, left=[0]),
            page.paragraph(_typeset(crossing_words(finding))),
            page.paragraph(f'Plain OU, with nothing else in the model: '
                           f'{plain_model_words(finding.baseline)}.', soft=True)]


def _shown(finding: Finding) -> list[Criticism]:
    """Return the statistics of the rows: the largest, before or after."""
    worst = sorted(finding.criticism, key=lambda c: -max(abs(c.before), abs(c.after)))
    return worst[:_ROWS]


def _statistics(finding: Finding) -> list[str]:
    rows = [(c.statistic, c.low, c.high, c.before, c.after) for c in _shown(finding)]
    text = (f'{len(finding.discrepancies)} of {len(finding.criticism)} statistics of the '
            'one-step errors lie outside the band for the plain OU'
            + (f', {len(finding.remaining)} for the extended model. ' if finding.causes else '. '))
    dots = 'Hollow: plain OU. Full: extended model' if finding.causes else 'Dot: plain OU'
    return [page.figure(
        _dot_rows(f'{dots}. Band: what simulations produce', 'standard scores', rows),
        text + 'The band comes from simulations that pass through the same fit: under a right '
        'model one recording in a hundred has a statistic outside it.')]


def _comparisons(finding: Finding) -> list[str]:
    samples, baseline, extended = finding.samples, finding.baseline, finding.simulated
    assert samples is not None and baseline is not None and extended is not None
    plain = SupplyModel((baseline,))
    named = ('plain OU', 'extended model') if finding.causes else ('plain OU',)
    compared = compare_curves(samples, [plain, extended] if finding.causes else [plain],
                              np.random.default_rng(finding.seed))
    drawn = [page.figure(_plot(curve, k, name))
             for curve in compared for k, name in enumerate(named)]
    return [*[page.pair(*drawn[k:k + 2]) for k in range(0, len(drawn), 2)], page.paragraph(
        'Line or dots: the data. Band or bars: the range of 40 simulations with the stamps and '
        'the throttle of the data; about one point in twenty of a right model lies outside.',
        soft=True)]


def _plot(curve: Comparison, k: int, name: str) -> Plot:
    low, high = curve.bands[k]
    plot = Plot(f'{curve.title}: {name}', curve.x_label, curve.y_label, width=450,
                height=250, log_x=curve.log_x, log_y=curve.log_y, legend_row=True)
    data = curve.data
    if curve.log_y:
        # A bin without samples has no place on a logarithmic axis.
        floor = 0.3 * float(np.nanmin(np.where(data > 0.0, data, np.nan)))
        low, high = np.where(high > 0.0, np.maximum(low, floor), np.nan), np.maximum(high, floor)
        data = np.where(data > 0.0, data, np.nan)
    ends = [data, *[edge for pair in curve.bands for edge in pair]]
    # Both plots of a pair have one axis.
    ends = [np.where(e > 0.0, np.maximum(e, floor), np.nan) for e in ends] if curve.log_y \
        else ends
    bottom, top = span(ends, curve.log_y)
    plot.limits(y=(bottom, top))
    if curve.points:
        # Room for the markers at both ends.
        plot.limits(span([curve.x], pad=0.12), (bottom, top))
        plot.bars(curve.x, low, high, 'simulated', k)
        return plot.markers(curve.x, data, 'data', 7)
    plot.band(curve.x, low, high, 'simulated', k)
    return plot.line(curve.x, data, 'data', 7, 'thick')


def _left(finding: Finding) -> list[str]:
    if not finding.remaining:
        return [page.paragraph(f'Nothing: no statistic of the {_model_name(finding)} lies outside '
                               'the band.')]
    rows = [[c.statistic, _value(c.before), *([_value(c.after)] if finding.causes else []),
             chance(c.p_after) if math.isfinite(c.p_after) else NOT_KNOWN,
             plain_words(c.statistic)] for c in finding.remaining]
    head = ['Statistic', 'Plain OU', *(['Extended'] if finding.causes else []), 'p', 'In words']
    return [page.table(head, rows, left=[0, len(head) - 1])]


def _parameters(finding: Finding) -> list[str]:
    rows = []
    assert finding.model is not None
    for term, se in zip(finding.model.terms, finding.se):
        for spec in fields(term):
            value = getattr(term, spec.name)
            value = list(value) if isinstance(value, tuple) else value
            rows.append([term.NAME, spec.name,
                         _typeset(with_error(value, se.get(spec.name),
                                             positive=term.positive(spec.name))),
                         spec.metadata['unit'] or UNKNOWN, spec.metadata['text']])
    about = ('Extended model: all terms fitted together on the whole recording. Its alpha and '
             'sigma describe what remains of relaxation and noise beside all causes; those of the '
             'plain OU above include the causes.'
             if finding.causes else
             'The plain OU is kept, as no cause was named: the model above.')
    return [page.paragraph(about),
            page.table(['Term', 'Parameter', 'Estimate \u00b1 standard error', 'Unit',
                        'What it is'], rows, left=[0, 1, 4])]


def _origin(finding: Finding, command: str) -> list[str]:
    parts = [page.bullets(list(finding.notes))]
    if command:
        parts += [page.paragraph('To repeat this:'), page.code(command)]
    return parts


def _dot_rows(title: str, x_label: str,
              rows: Sequence[tuple[str, float, float, float, float]]) -> str:
    """Return a row for each statistic: a band, a hollow dot before, a full one after."""
    reach = max([1.5 * _STRAIGHT, *(abs(v) for row in rows for v in row[1:] if math.isfinite(v))])
    end = math.asinh(1.1 * reach / _STRAIGHT)
    middle, half = 0.5 * (_LEFT + _WIDTH - _RIGHT), 0.5 * (_WIDTH - _RIGHT - _LEFT)

    def at(value: float) -> float:
        return middle + half * math.asinh(value / _STRAIGHT) / end

    height = _TOP + _ROW * len(rows) + _BOTTOM
    bottom = height - _BOTTOM
    parts = [f'<svg viewBox="0 0 {_WIDTH} {height}" role="img" '
             f'aria-label="{escape(title, quote=True)}">',
             f'<text class="title" x="14" y="16">{escape(title)}</text>']
    for size in _TICKS:
        for value in sorted({-size, size}):
            value += 0.0
            if abs(value) <= 1.1 * reach:
                x = at(value)
                parts.append(
                    f'<line class="grid" x1="{x:.1f}" y1="{_TOP}" x2="{x:.1f}" y2="{bottom}"/>'
                    f'<text class="tick" text-anchor="middle" x="{x:.1f}" y="{bottom + 16}">'
                    f'{f"{value:g}".replace("-", chr(0x2212))}</text>')
    for k, (name, low, high, before, after) in enumerate(rows):
        y = _TOP + _ROW * (k + 0.5)
        # Browsers show the title of a group where one points at it.
        parts.append(f'<g><title>{escape(_dot_title(name, low, high, before, after))}</title>'
                     f'<text class="legend" text-anchor="end" x="{_LEFT - 10}" '
                     f'y="{y + 4:.1f}">{escape(name)}</text>'
                     f'<rect class="band s0" x="{at(low):.1f}" y="{y - 8:.1f}" '
                     f'width="{at(high) - at(low):.1f}" height="16"/>')
        drawn = [v for v in (before, after) if math.isfinite(v)]
        if len(drawn) == 2:
            parts.append(f'<line class="grid" x1="{at(before):.1f}" y1="{y:.1f}" '
                         f'x2="{at(after):.1f}" y2="{y:.1f}"/>')
        for value, fill in ((before, 'var(--paper)'), (after, 'var(--c1)')):
            if math.isfinite(value):
                parts.append(f'<circle cx="{at(value):.1f}" cy="{y:.1f}" r="5" '
                             f'style="fill: {fill}; stroke: var(--c1); stroke-width: 2"/>')
        parts.append('</g>')
    parts.append(f'<text class="label" text-anchor="middle" x="{middle:.0f}" '
                 f'y="{height - 6}">{escape(x_label)}</text></svg>')
    return '\n'.join(parts)


def _dot_title(name: str, low: float, high: float, before: float, after: float) -> str:
    """Return the numbers of a row; what is not known is left out."""
    def text(value: float) -> str:
        return f'{value:.3g}'.replace('-', '\u2212')

    known = [(word, value) for word, value in (('before', before), ('after', after))
             if math.isfinite(value)]
    # A single dot has no before and after.
    said = [f'{word} {text(value)}' if len(known) == 2 else text(value) for word, value in known]
    return f'{name}: {", ".join([*said, f"simulations {text(low)} to {text(high)}"])}'
