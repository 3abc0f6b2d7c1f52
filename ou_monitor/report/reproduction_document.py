"""The report of `reproduce`: every printed number beside its recomputation."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
import math

import numpy as np
from ou_monitor.paper import oscilloscope, published
from ou_monitor.paper.published import Row
from ou_monitor.paper.reproduce import (
    headline, lorentzian, recomputed, Reproduction, screen, spectrum, tally)
from ou_monitor.paper.tables import share_above
from ou_monitor.report.document import (
    Document, Figure, Notes, Pair, Part, Section, Table, Text)
from ou_monitor.report.svg import Plot, span
from ou_monitor.text import percent

_BINS = 40  # Of the histogram of crest factors


def reproduction_document(result: Reproduction) -> Document:
    parts: list[Part] = [
        partial(_figures, result),
        Section('Eight points to know when reading the paper', [
            Text(f'{point.number}. {point.title} ({tally(point.rows)}): {point.text}')
            for point in result.points]),
        Section('Every number', [Text(
            'Agrees: the recomputed number rounds to the printed one, or its interval (3 standard '
            'errors, or the range given) includes it. Rounding: it agrees if the underlying '
            'readings are varied within their own rounding. Claims are written as bounds: "> 0" '
            'means that something rises.', legend=True)]),
        *[Section(f'{where}, {tally(rows)}', [_table(rows), partial(_explanations, rows)],
                  folded=True) for where, rows in result.parts()],
        Text(f'Random numbers from seed {result.seed}; another seed changes the simulated numbers '
             'within their standard errors.', legend=True)]
    return Document('The paper, recomputed', 'Deterministic and stochastic matrix modeling of '
                    'radiophysical processes in UAV microcontroller systems',
                    [headline(result)], parts)


def _table(rows: Sequence[Row]) -> Table:
    return Table(
        ['where', 'quantity', 'printed', 'recomputed', 'verdict'],
        [[row.where, row.quantity + (f', {row.unit}' if row.unit else ''), row.printed.text,
          recomputed(row), row.verdict.value] for row in rows], left=[0, 1, 4])


def _explanations(rows: Sequence[Row]) -> list[Part]:
    return [Notes.of(f'{row.quantity}: {row.sentence} How: {row.how}.' for row in rows)]


def _figures(result: Reproduction) -> list[Part]:
    # The eighth, after those of the rows.
    rng = np.random.default_rng(result.seed).spawn(8)[-1]
    return [Section('Figures, simulated from the numbers printed', [
        *_screens(rng), *_transient(), *_spectrum(rng), *_crests(result)])]


def _screens(rng: np.random.Generator) -> list[Part]:
    drawn = []
    for k, state in enumerate(published.TABLE_1):
        t, u = screen(state, rng)
        plot = Plot(f'{state.label}: one OU', 'time, ms', 'mV', width=450, height=230)
        half = 0.5 * state.vpp.value
        plot.limits(x=(0.0, 1e3 * float(t[-1])), y=(-1.3 * half, 1.3 * half))
        plot.line(1e3 * t, 1e3 * u, colour=k)
        for sign, label in ((1.0, 'Vpp as printed'), (-1.0, '')):
            plot.level((0.0, 1e3 * float(t[-1])), sign * half, label, 7)
        drawn.append(Figure(
            plot, f'Vpp {1e3 * float(np.ptp(u)):.4g} mV here, '
            f'{state.vpp.text} mV printed.'))
    return [Pair(drawn), Text(
        'As Figs. 1 to 4: an OU with the printed alpha and Vrms (motors off: half a step of the '
        'oscilloscope), at 1 MHz, rounded to such steps. Where the printed Vpp is much wider than '
        'the trace, the rail also carries something faster.', legend=True)]


def _transient() -> list[Part]:
    line = oscilloscope.PAPER_FIT
    plain, shifted = oscilloscope.decay_fits()
    t = np.linspace(0.0, 0.055, 221)
    rail = oscilloscope.TYPICAL_RAIL
    behind, worst = oscilloscope.fitted_through_coupling(t)
    curves = (
        (line.start * np.exp(-line.alpha * t), f'ln fit to 35 ms, {line.alpha:.1f} 1/s', 'thick'),
        (plain(t), f'exponential, {plain.parameters[1]:.1f} 1/s', ''),
        (shifted(t), f'with offset, {shifted.parameters[1]:.1f} 1/s', 'thick'),
        (behind, f'rail of {rail:g} 1/s behind {oscilloscope.CORNER_HZ:g} Hz', 'dash'))
    drawn = []
    for log in (False, True):
        plot = Plot('Fig. 5: decay after 20 %' + (', log scale' if log else ''), 'time, ms',
                    '|U|, mV', width=450, height=330, log_y=log)
        plot.limits(x=(-1.5, 55.0), y=(3.0, 600.0) if log else (-10.0, 420.0))
        for k, (y, label, style) in enumerate(curves):
            plot.line(1e3 * t, np.where(y > 0.0, y, math.nan) if log else y, label, k, style)
        plot.markers(1e3 * oscilloscope.TIME, oscilloscope.VALUE, 'points of Fig. 5', 7)
        drawn.append(Figure(plot))
    return [Pair(drawn), Text(
        f'Dashed: a rail {rail / published.ALPHA.value:.0f} times faster, behind an AC '
        f'coupling of {oscilloscope.CORNER_HZ:g} Hz, comes within {100 * worst:.0f} % of the four '
        'points of the fit. The last point lies below it and below both exponentials.',
        legend=True)]


def _spectrum(rng: np.random.Generator) -> list[Part]:
    plot = Plot('Spectrum of the OU', 'frequency, Hz', 'PSD, V\u00b2/Hz', height=320, log_x=True,
                log_y=True)
    wide = np.geomspace(1.0, 5e5, 200)
    lines = []
    for k, state in enumerate((published.MEDIUM, published.HIGH)):
        frequency, density, coupled = spectrum(state, rng)
        curve = lorentzian(wide, published.ALPHA.value, state.sigma)
        lines += [curve, density]
        plot.line(frequency, density, f'{state.label}, simulated', k, 'faint')
        plot.line(wide, curve, f'{state.label}, Lorentzian', k, 'dash thick')
    plot.line(frequency, coupled,
              f'{state.label}, behind {oscilloscope.CORNER_HZ:g} Hz coupling', 2)
    plot.limits(x=(1.0, 5e5), y=span(lines, log=True))
    plot.mark(published.ALPHA.value / (2.0 * math.pi), 'alpha/2\u03c0 = 10.03 Hz')
    low, high = published.ESC_HZ
    plot.shade(low, high, 4)
    plot.mark(low, '').mark(high, 'ESC 24..48 kHz')
    return [Figure(plot, (
        f'The ESC lines that section 4.5 expects would lie at {1e-3 * low:g} to '
        f'{1e-3 * high:g} kHz, where the OU has {percent(share_above(low))} of its variance; '
        'an OU alone has no peak there. The corners of the AC coupling and of the Lorentzian '
        'coincide.'))]


def _crests(result: Reproduction) -> list[Part]:
    crests = Plot('Vpp/Vrms of one OU', 'Vpp/Vrms', 'density', height=300)
    edges = np.linspace(2.5, 10.0, 1 + _BINS)
    for k, (ms, values) in enumerate(sorted(result.crests.by_screen.items())):
        share, _ = np.histogram(values, edges, density=True)
        crests.steps(edges, np.append(share, share[-1]), f'{ms} ms', k)
    crests.limits(x=(2.5, 10.0), y=(0.0, 1.15))
    for state in published.LOADED:
        crests.mark(state.crest, state.label)
    return [Figure(
        crests, 'Vertical lines: Table 1. Screens of 10, 100 and 500 ms at 1 MHz.')]
