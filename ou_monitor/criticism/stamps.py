"""
Stamps: true where the voltage follows them, wrong where it does not.

Stamps that scatter about an even grid are either true, and then the increments follow the steps,
or wrong, and then they do not.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray
from ou_monitor.text import counted
from ou_monitor.timeline.line import on_grid

# Scatter below this share of a step is put onto the grid: it changes nothing else.
_SMALL = 0.02
# Scatter above this share of a step is no scatter about a grid.
_LARGE = 0.45
# Correlation of neighbouring errors up to which they count as independent.
_WHITE = 0.3
_TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Stamps:
    """What became of the stamps."""

    t: FloatArray  # Stamps to use, s; shape (n,)
    error: float  # Standard deviation of stamps that are wrong, s; 0: none are
    notes: tuple[str, ...]  # Sentences


def judge_stamps(t: FloatArray, voltage: FloatArray) -> Stamps:
    """
    Judge stamps, and put them onto the grid where that is where they belong.

    t in s, voltage in V.
    """
    step = np.diff(t)
    usual = float(np.median(step))
    # Without gaps first: steps that scatter by half of their length look like gaps.
    number = np.ones(step.size)
    grid = on_grid(t, number)
    if float((t - grid).std()) > _LARGE * usual:
        number = np.maximum(1.0, np.rint(step / usual))
        grid = on_grid(t, number)
    gaps = int((number > 1.0).sum())
    notes = []
    if gaps:
        notes.append(f'{counted(gaps, "gap")} in the stamps, the longest '
                     f'{float(step.max()):.3g} s: kept as they are.')
    off = t - grid
    scatter = float(off.std()) / usual
    if scatter < _TINY:
        return Stamps(t if gaps else grid, 0.0, tuple(notes))
    white = abs(_correlation(off[1:], off[:-1])) < _WHITE
    if scatter < _SMALL:
        notes.append(f'Stamps scatter by {100.0 * scatter:.2g} % of a step about an even grid: '
                     'taken as even.')
        return Stamps(grid, 0.0, tuple(notes))
    if white and scatter < _LARGE and _wrong(step / usual, number, voltage):
        error = float(off.std())
        notes.append(f'Stamps scatter by {1e3 * error:.3g} ms about an even grid while the '
                     'voltage does not follow: the stamps are wrong, the grid was used.')
        return Stamps(grid, error, tuple(notes))
    uneven = float(step[number == 1.0].std()) / usual
    if uneven > _SMALL:
        notes.append(f'Steps between stamps scatter by {100.0 * uneven:.2g} %: taken as they '
                     'are.')
    return Stamps(t, 0.0, tuple(notes))


def _wrong(step: FloatArray, number: FloatArray, voltage: FloatArray) -> bool:
    """
    Return whether increments are likelier not to follow the steps than to follow them.

    By a likelihood ratio above the price of a parameter, as causes are; white noise of the sensor
    follows no step.
    """
    change = np.diff(voltage)
    change = change - np.median(change)
    limit = 4.0 * float(np.median(np.abs(change))) / 0.6745
    use = (number == 1.0) & (np.abs(change) < limit)
    both = use[1:] & use[:-1]
    if not both.any():
        return False
    # It makes neighbouring increments undo each other.
    power = float(np.mean(change[use] ** 2))
    noise = -2.0 * float(np.mean((change[1:] * change[:-1])[both])) / power
    rail = min(max(1.0 - noise, 0.0), 1.0)
    square = change[use] ** 2 / power - 1.0
    x = step[use] - step[use].mean()
    follow, weight = float(x @ square), float(x @ x)
    # Of normal errors, with the spread of the squares.
    ratio = 0.5 * ((follow - rail * weight) ** 2 - follow**2) / (
        weight * float(square @ square) / square.size)
    return bool(ratio > 0.5 * math.log(square.size))


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / norm if norm > 0.0 else 0.0
