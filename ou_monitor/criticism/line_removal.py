"""
The voltage of a level without its spectral lines, for the fit of what is left.

A line of 4 mV beside an OU of 18 mV moves alpha by 30 % and sigma by 15 % (1 kHz, 120 Hz): the fit
takes it for a part of the relaxation.  Each line is a sinusoid of its own amplitude, phase and
frequency in each piece of the length that the search used, by least squares; a little noise of
that bin goes with it.  Limits: a tone that moves by more than a bin within a piece, or is
modulated, leaves its sidebands.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.criticism.lines import Line
from ou_monitor.criticism.quality_item import QualityItem, Severity
from ou_monitor.records import Estimate, FloatArray
from ou_monitor.text import Z95

# Frequencies tried either side of the line's, in bins, and how many.
_REACH, _TRIED = 1.0, 33


def without_lines(voltage: FloatArray, rate: float, lines: Sequence[Line]) -> FloatArray:
    """Return one stretch without lines (voltage in V, rate in Hz, result in V)."""
    if not lines or not voltage.size:
        return voltage
    pieces = max(1, round(voltage.size * lines[0].resolution / rate))
    return np.concatenate([_cleaned(piece, rate, lines)
                           for piece in np.array_split(voltage, pieces)])


def _cleaned(piece: FloatArray, rate: float, lines: Sequence[Line]) -> FloatArray:
    """Return a piece less one sinusoid a line."""
    mean = float(piece.mean())
    left: FloatArray = piece - mean
    angle = 2.0 * np.pi / rate * np.arange(piece.size)
    window = np.hanning(piece.size + 2)[1:-1]
    for line in lines:
        tried = line.frequency + line.resolution * np.linspace(-_REACH, _REACH, _TRIED)
        tried = tried[(tried > 0.0) & (tried < 0.5 * rate)]
        power = [abs(np.exp(-1j * f * angle) @ (window * left)) for f in tried]
        best = float(tried[int(np.argmax(power))])
        waves = np.column_stack((np.cos(best * angle), np.sin(best * angle)))
        left = left - waves @ np.linalg.lstsq(waves, left, rcond=None)[0]
    return left + mean


def line_item(throttle: float, without: Estimate, with_lines: Estimate | None) -> QualityItem:
    """Say what the lines of a level do to its fit, or would have done (throttle 0..1)."""
    if with_lines is None:
        worry = Severity.WARNING if without.usable else Severity.INFO
        return QualityItem('LINES_LEFT_IN', worry, (
            'Impulses stand beside spectral lines, which may be theirs and were left in: alpha '
            'and sigma hold both.'), (throttle,))
    taken = 'Spectral lines were taken out before the fit'
    if without.usable and with_lines.usable:
        moved = any(abs(math.log(getattr(with_lines, name) / getattr(without, name)))
                    > Z95 * getattr(without, name + '_se') for name in ('alpha', 'sigma'))
        text = (f'{taken}; with them, as the node sees it, alpha would be {with_lines.alpha:.3g} '
                f'1/s and sigma {with_lines.sigma:.3g} V/sqrt(s).')
    else:
        moved = without.usable or with_lines.usable
        left = ' and nothing that can be fitted is left' if not without.usable else (
            ', and only then can it be fitted: the node, which sees them, gives no numbers')
        text = f'{taken}{left}.'
    return QualityItem('LINES_TAKEN_OUT', Severity.WARNING if moved else Severity.INFO, text,
                       (throttle,))
