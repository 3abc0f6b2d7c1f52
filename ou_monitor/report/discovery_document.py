"""The report of `discover`: errors of the simulation, their causes, and the gain."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields
import math

import numpy as np
from ou_monitor.analysis.overview import known_lines, Overview
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.finding import Criticism, Finding
from ou_monitor.discovery.words import (
    cause_rows, curve_text, GAIN, gain_text, input_words, parameters, plain_words, with_error)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Part, Section, Table, Text)
from ou_monitor.report.svg import Plot
from ou_monitor.text import filled, number
from scipy.signal import welch

# Maximum remaining discrepancies on a terminal.
_SHOWN = 8
# Maximum rows of the table of statistics.
_ROWS = 18
# Number of simulations for a band; bins of load; length of a segment of the spectrum, samples, and
# points of its curve.
_DRAWS, _BINS, _SEGMENT, _POINTS = 20, 12, 4096, 60


def discovery_document(finding: Finding, seen: Overview | None = None) -> Document:
    """Return the report of a discovery; `seen` holds the facts of the recording."""
    samples, baseline = finding.samples, finding.baseline
    used = '' if samples is None or samples.n == finding.n else f', {samples.n} used'
    load = (f'; load: the measured current, 1 = {number(finding.full)} A'
            if finding.load == 'current' else '')
    subject = (f'{finding.recording or "recording"}: {finding.n} samples in '
               f'{number(finding.duration, 4)} s{used}{load}{"" if seen is None else seen.pauses}')
    known = [] if seen is None else known_lines(seen)
    parts: list[Part] = [
        lambda: [] if samples is None else [Figure(_voltage(finding), (
            f'Band: range of {_DRAWS} simulations of the {_model_name(finding)} at each moment, '
            f'with the {_inputs(finding)} of the recording.') if finding.simulated else '')],
        Facts(known)]
    if baseline is not None:
        after = ' before and after' if finding.causes else ''
        parts += [Section('Causes', _causes(finding)),
                  lambda: [Section('Recording beside simulations', _beside(finding))],
                  Section('Gain' if finding.causes else 'What it predicts',
                          _gain(finding)),
                  lambda: [Section(f'Statistics{after}', _statistics(finding), folded=True)],
                  Section('What is left', [
                      _scores(finding, finding.remaining) if finding.remaining else
                      Text(f'Nothing: no statistic of the {_model_name(finding)} lies outside the '
                           'band.')], folded=True),
                  lambda: [Section('Parameters', _parameters(finding), folded=True)]]
    parts.append(Section('What to know before using these numbers', [Notes.of(finding.notes)]))
    beware = () if seen is None else seen.beware
    return Document('What the simulation gets wrong', subject, [*beware, *finding.words], parts)


def _inputs(finding: Finding) -> str:
    return 'stamps' if finding.load == 'none' else f'stamps and {finding.load}'


def _model_name(finding: Finding) -> str:
    return 'extended model' if finding.causes else 'plain OU'


def _voltage(finding: Finding) -> Plot:
    samples = finding.samples
    assert samples is not None
    t = samples.t - samples.t[0]
    plot = Plot('Voltage', 'time, s', 'V', height=230)
    low, high = np.full(samples.n, np.inf), np.full(samples.n, -np.inf)
    for drawn in _draws(finding, finding.simulated):
        low, high = np.fmin(low, drawn), np.fmax(high, drawn)
    if np.isfinite(low).all():
        plot.band(t, low, high, 'simulated', 1)
    return plot.line(t, samples.logged, 'measured', 0)


def _draws(finding: Finding, model: SupplyModel | None) -> Iterator[FloatArray]:
    """Yield simulated voltages, V, of the samples."""
    samples, rng = finding.samples, np.random.default_rng(finding.seed)
    if samples is None or model is None:
        return
    # A model with a diverging force cannot be simulated.
    with suppress(ValueError):
        for _ in range(_DRAWS):
            yield model.simulate(samples.t, rng, samples.throttle)


def _beside(finding: Finding) -> list[Part]:
    """Return plots of recording and simulations over load and frequency, and free curves."""
    samples, ou = finding.samples, finding.baseline
    if samples is None or ou is None:
        return []
    # A model that was not extended is the plain OU.
    models = {'plain OU': SupplyModel((ou,)), 'extended model': finding.simulated}
    drawn = {name: [_measures(samples, voltage) for voltage in _draws(finding, model)]
             for name, model in models.items() if finding.causes or name == 'plain OU'}
    real = _measures(samples, samples.logged)
    small: list[Figure] = []
    load = 'current, A' if finding.load == 'current' else finding.load
    for k, title, label, unit in ((0, 'Voltage over load', load, 'V'),
                                  (1, 'Changes between samples', load, 'rms, V'),
                                  (2, 'Spectrum', 'frequency, Hz', 'V\u00b2/Hz')):
        x, y = real[k]
        if x.size < 2:
            continue
        x = x * finding.full if label == 'current, A' else x
        plot = Plot(title, label, unit, width=450, height=250, log_x=k == 2, log_y=k > 0)
        for colour, (name, found) in enumerate(drawn.items(), 1):
            if found:
                many = np.array([one[k][1] for one in found])
                plot.band(x, many.min(axis=0), many.max(axis=0), name, colour)
        small.append(Figure(plot.line(x, y, 'measured', 0, 'thick')))
    for cause in finding.causes:
        for name, (at, factor) in cause.term.factors().items():
            plot = Plot(f'{cause.name}: factor on the noise',
                        input_words(name, finding.load), 'factor', width=450, height=250)
            small.append(Figure(plot.line(np.array(at), np.array(factor), '', 0, 'thick')))
    return [Text(f'Bands: range of {_DRAWS} simulations. Over load, in bins with similar numbers '
                 'of samples: median of the voltage, and rms of its change to the next sample.',
                 legend=True), *Pair.two_by_two(small)]


def _measures(samples: Samples, voltage: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """Return median and rms of changes over load, and the spectrum; each (x, y), shapes (k,)."""
    u, none, found = samples.throttle, np.empty(0), []
    if u is None or not np.ptp(u) > 0.0:
        found = [(none, none)] * 2
    else:
        which = np.searchsorted(np.unique(np.quantile(u, np.arange(1, _BINS) / _BINS)), u[:-1],
                                'right')
        parts = [np.flatnonzero(which == k) for k in np.unique(which)]
        middle = np.array([np.median(u[part]) for part in parts])
        change = np.diff(voltage)
        found = [(middle, np.array([np.median(voltage[part]) for part in parts])),
                 (middle, np.array([math.sqrt(float(np.mean(change[part] ** 2)))
                                    for part in parts]))]
    frequency, power = welch(voltage, 1.0 / float(np.median(np.diff(samples.t))),
                             nperseg=min(voltage.size, _SEGMENT))
    # Average over bins of equal width on the logarithmic axis.
    edges = np.unique(np.geomspace(1, frequency.size, _POINTS).astype(int))
    frequency, power = (np.add.reduceat(one[:edges[-1]], edges[:-1]) / np.diff(edges)
                        for one in (frequency, power))
    return [*found, (frequency, power)]


def _causes(finding: Finding) -> list[Part]:
    if not finding.causes:
        return [Text('No cause was named.')]
    found = cause_rows(finding.causes, finding.load)
    return [
        Table(['cause', 'what it is', 'family', 'gain, mnat/sample',
               'p (fit or gain)', 'alternatives'],
              [[row.label, row.what, row.family, row.gain, row.chance,
                ', '.join(row.alternatives) or '-']
               for row in found], left=[0, 1, 2, 5]),
        Text(GAIN),
        Notes.of([f'{row.label}: {row.explanation}' for row in found]),
        Text('The gain of a cause is the loss of held-out score when it is left out and the rest '
             'is fitted again; its error comes from the scatter of block means. p: twice the '
             'smaller p-value of the likelihood ratio on the whole recording (corrected for the '
             'search) and of the gain. "Exact" causes are visible in the samples themselves; '
             'those whose effect was removed from the samples have no gain. Terms of one kind '
             'that share a gain are one row.',
             legend=True)]


def _gain(finding: Finding) -> list[Part]:
    dips, baseline = finding.dips, finding.baseline
    assert baseline is not None and finding.model is not None
    ou = finding.model.terms[0]
    rows = [['held-out score, mnat/sample', '-', number(1e3 * finding.baseline_score, 4),
             number(1e3 * finding.score, 4), gain_text(finding.gain, finding.gain_se)]]
    rows.append([f'dips below {dips.level:g} V, 1/min', *(with_error(*pair) for pair in (
        (dips.observed, dips.observed_se), (dips.baseline, dips.baseline_se),
        (dips.extended, dips.extended_se))), '-'])
    # If nothing was added to the plain OU, there is nothing to compare.
    kept = 5 if finding.causes else 3
    return [Table(['', 'observed', 'plain OU', 'extended', 'gain'][:kept],
                  [row[:kept] for row in rows], left=[0]), Text(
                      '' if finding.refused else _under_load(finding)),
            Text('The plain OU, whose noise includes changes of level and load, has '
                 f'{parameters(baseline, {})}.' + (
                     f' The extended model has {parameters(ou, finding.se[0])}. The alpha under '
                     'Relaxation is from the end of the recording, includes causes other than '
                     'load, drift and lines, and counts slow changes as changes of the level.'
                     if finding.causes else ''))]


def _under_load(finding: Finding) -> str:
    """Return the effects of the load in words; empty if they are unknown."""
    fall, dips, load = finding.fall, finding.dips, finding.load
    if math.isnan(fall.measured):
        return ''
    factor, unit = (finding.full, ' A') if load == 'current' else (1.0, '')
    low, high = (number(factor * end, 2) + unit for end in (fall.low, fall.high))
    sign, way = (1.0, 'lower') if fall.measured >= 0.0 else (-1.0, 'higher')
    # A current that is negative while it discharges has a negative factor.
    above, below = ('more', 'less') if factor > 0.0 else ('less', 'more')
    found = (f'Where {load} is {high} or {above}, the median voltage is '
             f'{number(sign * fall.measured, 2)} V {way} than where it is {low} or {below} (drift '
             f'included); the model gives {number(sign * fall.explained, 2)} V'
             + ('.' if fall.fits else '; trust the readings.'))
    if dips.count and dips.made is not None:
        made = (f'caused {dips.made} of the {dips.count} dips' if dips.count > 1 else
                f'{"caused" if dips.made else "did not cause"} the only dip')
        used = '' if finding.samples is None or finding.samples.n == finding.n else (
            ' in the samples used')
        found += (f' {load.capitalize()} {made} below {dips.level:g} V{used}. A dip lasts until a '
                  'reading is clearly above that voltage, as in every command.')
    return found


def _statistics(finding: Finding) -> list[Part]:
    worst = sorted(finding.criticism, key=lambda c: -max(abs(c.before), abs(c.after)))
    text = (f'{len(finding.discrepancies)} of {len(finding.criticism)} statistics of the '
            'one-step errors lie outside the band for the plain OU'
            + (f', {len(finding.remaining)} for the extended model. ' if finding.causes else '. '))
    return [_scores(finding, worst[:_ROWS]), Text(
        f'{text}The scores are in standard deviations. The band comes from simulations that are '
        'fitted in the same way: with a correct model, one recording in a hundred has a statistic '
        'outside it.', legend=True)]


def _scores(finding: Finding, found: Sequence[Criticism]) -> Table:
    rows = [[c.statistic,
             *([number(c.before)] if finding.causes else []), number(c.after),
             f'[{number(c.low)}, {number(c.high)}]',
             plain_words(c.statistic, finding.load)]
            for c in found]
    return Table(['statistic', *(['plain OU'] if finding.causes else []), 'score',
                  'band', 'in words'], rows, left=[0, len(rows[0]) - 1], most=_SHOWN)


def _parameters(finding: Finding) -> list[Part]:
    rows = []
    assert finding.model is not None
    for term, se in zip(finding.model.terms, finding.se):
        curves = term.factors()
        rows += [[term.NAME, f'factor over {name}', curve_text(*curve), '-',
                  f'factor on the noise over {input_words(name, finding.load)}']
                 for name, curve in curves.items()]
        for spec in fields(term):
            value = getattr(term, spec.name)
            if isinstance(value, tuple):
                if curves:
                    continue
                value = list(value)
            rows.append([term.NAME, spec.name,
                         with_error(value, se.get(spec.name), positive=term.positive(spec.name)),
                         spec.metadata['unit'] or '-',
                         filled(spec.metadata['text'], finding.load)])
    about = ('Extended model: all terms fitted together on the whole recording. Its alpha and '
             'sigma describe the relaxation and noise not explained by the causes; alpha and '
             'sigma of the plain OU above include the causes.'
             if finding.causes else 'No cause was named: this is the plain OU above.')
    return [Text(about), Table(['term', 'parameter', 'estimate +- 95 %', 'unit',
                                'what it is'], rows, left=[0, 1, 4])]
