"""
What is always known of a recording: its lowest voltage, its dips, its sag and its noise.

Limits first: sag and noise are those of `LoadFilter` at the end of the recording, with its limits
(doc/load.md); a sag beyond the throttles flown is a guess and is called so; dips are counted in
the samples as they were recorded, so that one bad sample counts as a dip.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import LoadStatus, SupplyLoad
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import number, volts

# Undershoots that are closer than that, s, are one dip: an ESC answers within some 100 ms.
_APART = 0.2
# The noise follows throttle when it differs by more than that factor between its ends.
_GROWS = 1.25
# Lines are part of the answer when they make more than that share of the noise at their level.
_LOUD = 0.25


@dataclass(frozen=True)
class Line:
    """
    The strongest spectral line of all load levels.

    Attributes
    ----------
    frequency, rms : float
        Hz and V.
    share : float
        Of the variance of its level, 0..1.
    level : str
        Throttle of that level, in words.
    lines, all_share : int, float
        How many lines that level has, and their share together.

    """

    frequency: float
    rms: float
    share: float
    level: str
    lines: int
    all_share: float


@dataclass(frozen=True)
class Overview:
    """
    What is always known of a recording.

    Attributes
    ----------
    lowest, lowest_at, lowest_throttle : float
        Lowest voltage, V; when, s from the first sample; at which throttle, NaN if unknown.
    limit : float
        Voltage that dips are counted below, V; NaN when none was given.
    dips : int
        Undershoots of the limit; those less than 0.2 s apart are one.
    below : float
        Time below the limit, s.
    duration : float
        Of the recording, s.
    load : SupplyLoad
        Sag, noise and level at the end of the recording.
    flown : tuple of float
        Throttles between which 98 % of the samples lie; NaN without throttle.
    highest : float
        Highest throttle; NaN without throttle.
    line : Line or None
        Strongest spectral line; None when there is none.
    cells : int
        Cells in series that the limit is of; 0 when it is of the whole.

    """

    lowest: float
    lowest_at: float
    lowest_throttle: float
    limit: float
    dips: int
    below: float
    duration: float
    load: SupplyLoad
    flown: tuple[float, float]
    highest: float
    line: Line | None = None
    cells: int = 0

    @property
    def sag(self) -> tuple[float, float, float]:
        """Return throttle, sag there and its standard error, V, at the highest throttle flown."""
        at = self.highest
        return at, float(self.load.sag(at)), float(self.load.sag_se(at))

    @property
    def noise(self) -> tuple[float, float]:
        """Return the noise of one sample, V, at the lowest and the highest throttle flown."""
        low, high = self.flown if math.isfinite(self.flown[0]) else (0.0, 0.0)
        return float(self.load.noise(low)), float(self.load.noise(high))


def overview(recording: Recording, limit: float = NAN, levels: Sequence[LevelResult] = (),
             load: SupplyLoad | None = None, cells: int = 0) -> Overview:
    """
    Return what is always known of a recording.

    limit in V, of so many cells; levels: where lines were found; load: that of the end, found
    when left out.
    """
    t, v, u = recording.t, recording.voltage, recording.throttle
    if not recording.n:
        return Overview(NAN, NAN, NAN, limit, 0, 0.0, 0.0, SupplyLoad(), (NAN, NAN), NAN)
    k = int(np.argmin(v))
    dips, below = count_dips(t, v, limit)
    known = u[np.isfinite(u)]
    flown = (NAN, NAN)
    if known.size:
        flown = float(np.quantile(known, 0.01)), float(np.quantile(known, 0.99))
    return Overview(
        float(v[k]), float(t[k] - t[0]), float(u[k]), limit, dips, below, recording.duration,
        load or _load(recording), flown, float(known.max()) if known.size else NAN,
        _strongest(levels), cells)


def count_dips(t: FloatArray, voltage: FloatArray, limit: float) -> tuple[int, float]:
    """Return the dips below a limit, V, and the time below it, s; stamps in s."""
    under = np.flatnonzero(voltage < limit)
    if not under.size:
        return 0, 0.0
    # Each sample stands for the time to the next, but not for a gap.
    spacing = np.diff(t)
    usual = float(np.median(spacing)) if spacing.size else 0.0
    held = np.append(np.minimum(spacing, 10.0 * usual), usual)
    return 1 + int((np.diff(t[under]) > _APART).sum()), float(held[under].sum())


def _strongest(levels: Sequence[LevelResult]) -> Line | None:
    found = [(line, level) for level in levels for line in level.lines.lines]
    if not found:
        return None
    line, level = max(found, key=lambda pair: pair[0].rms)
    lines = level.lines.lines
    return Line(line.frequency, line.rms, line.share, level.label, len(lines),
                sum(each.share for each in lines))


def headline(found: Overview) -> str:
    """Return the answer in one sentence."""
    parts = answers(found)
    return '; '.join(parts) + '.' if parts else 'The recording holds no samples.'


def answers(found: Overview) -> list[str]:
    """Return the parts of the answer: the lowest voltage, then sag and lines."""
    parts = []
    if math.isfinite(found.limit):
        lowest = f'the lowest was {number(found.lowest, 4)} V at {number(found.lowest_at)} s'
        parts.append(f'The voltage stayed above {found.limit:g} V: {lowest}' if not found.dips else
                     f'{_dips(found)}: {lowest}')
    elif math.isfinite(found.lowest):
        parts.append(f'The voltage fell to {number(found.lowest, 4)} V at '
                     f'{number(found.lowest_at)} s')
    if found.load.known:
        at, sag, _ = found.sag
        parts.append(f'the rail sags by {volts(sag)} at {100.0 * at:.0f} % throttle')
    if found.line is not None and found.line.all_share > _LOUD:
        line = found.line
        what = (f'a line at {number(line.frequency, 4)} Hz makes' if line.lines == 1 else
                f'{line.lines} lines, the strongest at {number(line.frequency, 4)} Hz, make')
        where = '' if line.level == 'all' else f' at {line.level} throttle'
        parts.append(f'{what} {100.0 * line.all_share:.0f} % of the noise{where}')
    return parts


def known_lines(found: Overview) -> list[tuple[str, str]]:
    """Return what is known: pairs of name and words."""
    if not math.isfinite(found.lowest):
        return []
    where = (f', at {100.0 * found.lowest_throttle:.0f} % throttle'
             if math.isfinite(found.lowest_throttle) else '')
    lines = [('Lowest voltage',
              f'{number(found.lowest, 4)} V at {number(found.lowest_at)} s{where}')]
    if math.isfinite(found.limit):
        cells = f'; {found.limit / found.cells:.3g} V a cell' if found.cells else ''
        lines.append((f'Below {found.limit:g} V',
                      (_dips(found) if found.dips else 'never') + cells))
    lines += [('Sag', _sag_words(found)), ('Noise', _noise_words(found))]
    if math.isfinite(found.load.resistance):
        lines.append(('Resistance', f'{number(1e3 * found.load.resistance)} mOhm (+- '
                      f'{number(2e3 * found.load.resistance_se, 2)})'))
    if found.line is not None:
        line = found.line
        where = '' if line.level == 'all' else f' at {line.level} throttle'
        lines.append(('Strongest line', f'{number(line.frequency, 4)} Hz, '
                      f'{number(1e3 * line.rms)} mV rms{where} ({100.0 * line.share:.2g} % of the '
                      'noise there)'))
    return lines


def _dips(found: Overview) -> str:
    share = 100.0 * found.below / found.duration if found.duration > 0.0 else 100.0
    return (f'{found.dips} dip{"" if found.dips == 1 else "s"} below {found.limit:g} V, '
            f'{number(found.below, 2)} s in all ({share:.2g} % of the time)')


def _sag_words(found: Overview) -> str:
    load = found.load
    if math.isnan(found.flown[0]):
        return 'unknown: the recording has no throttle'
    if not load.known:
        return f'unknown. {load.status.value}'
    at, sag, se = found.sag
    words = f'{volts(sag)} (+- {volts(2.0 * se)}) at {100.0 * at:.0f} % throttle'
    if at < 0.95:
        full = float(load.sag(1.0))
        words += (f', the highest flown; some {volts(full)} (+- '
                  f'{volts(2.0 * float(load.sag_se(1.0)))}) at full throttle, if its form holds')
    return words


def _noise_words(found: Overview) -> str:
    low, high = found.noise
    if not math.isfinite(low):
        return 'unknown'
    first, last = (f'{100.0 * u:.0f} %' for u in (
        found.flown if math.isfinite(found.flown[0]) else (0.0, 0.0)))
    if found.load.status in (LoadStatus.STILL, LoadStatus.NO_THROTTLE) or (
            first == last):
        return f'{number(1e3 * low)} mV rms from sample to sample'
    pair = f'{number(1e3 * low)} mV rms at {first} throttle, {number(1e3 * high)} mV at {last}'
    if high > _GROWS * low:
        return f'{pair}: it grows with throttle'
    if low > _GROWS * high:
        return f'{pair}: it falls with throttle'
    return f'{pair}: throttle hardly matters'


def _load(recording: Recording) -> SupplyLoad:
    load = LoadFilter()
    load.push(recording.t, recording.voltage, recording.throttle, recording.current)
    return load.load()
