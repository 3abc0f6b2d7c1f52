"""The report of `coupling`: share of supply noise in a signal, its coherence with the voltage."""

from __future__ import annotations

import numpy as np
from ou_monitor.analysis.coupling import Coupling, POWER
from ou_monitor.analysis.overview import answers, known_lines, Overview
from ou_monitor.records import FloatArray, Recording
from ou_monitor.report.analysis_document import voltage_plot
from ou_monitor.report.document import Document, Facts, Figure, Notes, Part, Section
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, counted, number, p_words


def coupling_document(found: Coupling, recording: Recording, signal: tuple[FloatArray, FloatArray],
                      name: str, unit: str, seen: Overview) -> Document:
    """Return the report of a coupling; `signal` holds stamps, s, and values."""
    grid, per = found.grid, f'{unit or "signal units"} per V'
    subject = (f'{recording.name}, {name}: {grid.duration:.4g} s covered by both, '
               f'{found.segments:.0f} segments'
               + (', throttle removed' if found.partial else ''))
    lost = [f'{counted(n)} of the {what} dropped.' for n, what in
            zip(grid.lost, ('voltage', 'signal')) if n]
    gaps = [f'{counted(grid.gaps, "gap")} left out.'] if grid.gaps else []
    parts: list[Part] = [
        lambda: [Figure(voltage_plot(recording, seen.limit))],
        Facts([*_facts(found, per), *known_lines(seen)]),
        lambda: [Figure(_coherence(found), 'Squared coherence: 1 where the signal follows the '
                        'voltage exactly, 0 where they are unrelated.'),
                 Section('Signal and gain', [
                     Figure(_signal(recording, signal, name, unit)),
                     Figure(_gain(found, per),
                            'Where the coherence is below its limit, the gain is noise.')],
                         folded=True)],
        Section('What to know before using these numbers',
                [Notes.of(dict.fromkeys([*recording.notes, *lost, *gaps, *found.notes]))])]
    return Document(f'Supply noise in {name}', subject,
                    [*seen.beware, _answer(found, name, per), answers(seen)[0]], parts)


def _answer(found: Coupling, name: str, per: str) -> str:
    band = f'{number(found.frequency[0], 2)} to {number(found.frequency[-1], 2)} Hz'
    if found.signal_leads:
        return (f'{name} leads the voltage by {number(-1e3 * found.lag)} ms from {band}: it '
                'drives the load, so what they share is not supply noise.')
    if found.narrow:
        return (f'{name} and the voltage share only a few frequencies from {band}: a common line, '
                'such as motor rotation, not supply noise.')
    if found.seen:
        return (f'{number(100.0 * found.noise_share, 2)} % of {name} from {band} is supply '
                f'noise: {number(found.gain)} {per}.')
    return (f'No supply noise is detected in {name} from {band}; a gain of '
            f'{number(found.limit)} {per} would have been detected.')


def _facts(found: Coupling, per: str) -> list[tuple[str, str]]:
    peak = int(found.coherence.argmax())
    if found.seen:
        low, high = found.gain_ci95
        lines = [('Gain', f'{number(found.gain, 4)} {per} (95 %: {number(low, 4)} to '
                  f'{number(high, 4)})'),
                 ('Lag', f'the signal is {number(1e3 * abs(found.lag))} ms (+- '
                  f'{number(2e3 * found.lag_se, 2)} ms) '
                  f"{'ahead of' if found.lag < 0.0 else 'behind'} the voltage")]
    else:
        lines = [('Detectable', f'a gain of {number(found.limit, 4)} {per}, in '
                  f'{100.0 * POWER:.0f} % of such recordings')]
    of_supply = found.seen and not (found.signal_leads or found.narrow)
    advice = f'coupling: {number(abs(found.gain))}' if of_supply else (
        'adapting the cutoff to sigma does not help this signal')
    random = ('; this peak is larger, but random sign changes of the signal often give as much'
              if not found.seen and found.coherence[peak] > found.threshold else '')
    return [*lines, ('For the filter', advice),
            ('Chance', f'{p_words(found.p_value)}; detected if below {chance(found.level)}'),
            ('Largest coherence', f'{number(found.coherence[peak])} (squared) at '
             f'{number(found.frequency[peak])} Hz; in Gaussian noise by chance up to '
             f'{number(found.threshold)}{random}')]


def _signal(recording: Recording, signal: tuple[FloatArray, FloatArray], name: str, unit: str
            ) -> Plot:
    plot = Plot(name, 'time, s', unit or 'as recorded', height=180)
    plot.limits(x=(0.0, max(recording.duration, 1e-9)))
    return plot.line(signal[0] - recording.t[0], signal[1], colour=2)


def _coherence(found: Coupling) -> Plot:
    ends = float(found.frequency[0]), float(found.frequency[-1])
    plot = Plot('Coherence of voltage and signal', 'frequency, Hz', 'coherence', height=220)
    plot.limits(ends, (0.0, 1.05 * max(found.threshold, float(found.coherence.max()))))
    plot.line(found.frequency, found.coherence, 'measured', 0)
    return plot.level(found.frequency, found.threshold,
                      f'in Gaussian noise by chance up to {found.threshold:.2g}')


def _gain(found: Coupling, per: str) -> Plot:
    plot = Plot('Gain by frequency', 'frequency, Hz', per, height=200)
    plot.line(found.frequency, np.abs(found.response), 'measured', 0)
    if found.seen:
        low, high = found.gain_ci95
        ends = np.array([found.frequency[0], found.frequency[-1]])
        plot.band(ends, np.full(2, low), np.full(2, high), 'whole band, 95 %', 1)
    return plot
