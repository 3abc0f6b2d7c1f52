"""The report of `coupling`: voltage and signal over time, and how they go together."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.analysis.overview import Overview
from ou_monitor.coupling.coupling import Coupling, facts, headline, parts, remarks
from ou_monitor.records import FloatArray, Recording
from ou_monitor.report import page
from ou_monitor.report.svg import Plot


def coupling_page(found: Coupling, recording: Recording, signal: tuple[FloatArray, FloatArray],
                  name: str, unit: str, known: Sequence[tuple[str, str]], seen: Overview,
                  command: str = '') -> str:
    """Return the report of a coupling; signal: stamps, s, and values; known: of the voltage."""
    sections = [
        page.headline(_set(headline(found, name, unit))),
        page.figure(_voltage(recording, seen)),
        page.facts([(what, _set(words)) for what, words in (*facts(found, unit), *known)]),
        page.figure(_coherence(found),
                    'Squared coherence of the two, throttle taken out: 1 where the signal is the '
                    'voltage, 0 where they have nothing to do with each other.'
                    if found.partial else
                    'Squared coherence of the two: 1 where the signal is the voltage, 0 where '
                    'they have nothing to do with each other.'),
        page.section('Signal and gain', page.figure(_signal(recording, signal, name, unit)),
                     page.figure(_gain(found, unit),
                                 'Where the coherence is below its limit the gain is noise.'),
                     folded=True)]
    said = remarks(found, recording.notes)
    if said:
        sections.append(page.section('What to know before using these numbers',
                                     page.bullets(said)))
    if command:
        sections.append(page.section('Where it comes from', page.code(command), folded=True))
    return page.page(f'Supply noise in {name}: {recording.name or "recording"}', parts(found),
                     sections)


def _set(text: str) -> str:
    return text.replace('+-', '\u00b1')


def _voltage(recording: Recording, seen: Overview) -> Plot:
    t = recording.t - recording.t[0]
    limits = (0.0, max(recording.duration, 1e-9))
    plot = Plot('Voltage', 'time, s', 'V', height=210).limits(x=limits)
    plot.line(t, recording.voltage, colour=0)
    if math.isfinite(seen.limit):
        plot.line(np.array(limits), np.full(2, seen.limit), f'limit {seen.limit:g} V', 1,
                  'dash thick')
    return plot


def _signal(recording: Recording, signal: tuple[FloatArray, FloatArray], name: str, unit: str
            ) -> Plot:
    plot = Plot(name, 'time, s', unit or 'as recorded', height=180)
    plot.limits(x=(0.0, max(recording.duration, 1e-9)))
    return plot.line(signal[0] - recording.t[0], signal[1], colour=2)


def _coherence(found: Coupling) -> Plot:
    low, high = float(found.frequency[0]), float(found.frequency[-1])
    plot = Plot('What the voltage and the signal share', 'frequency, Hz', 'coherence', height=220)
    plot.limits((low, high), (0.0, 1.05 * max(found.threshold, float(found.coherence.max()))))
    plot.line(found.frequency, found.coherence, 'measured', 0)
    return plot.line(np.array([low, high]), np.full(2, found.threshold),
                     f'by chance up to {found.threshold:.2g}', 1, 'dash')


def _gain(found: Coupling, unit: str) -> Plot:
    plot = Plot('Gain by frequency', 'frequency, Hz', f'{unit} per V'.lstrip(), height=200)
    plot.line(found.frequency, np.abs(found.response), 'measured', 0)
    if found.seen:
        low, high = found.gain_ci95
        ends = np.array([found.frequency[0], found.frequency[-1]])
        plot.band(ends, np.full(2, low), np.full(2, high), 'of the band, 95 %', 1)
    return plot
