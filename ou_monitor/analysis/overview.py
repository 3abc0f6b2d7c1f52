"""
The facts of a supply in words, which every command reports first.

The numbers come from `supply_facts`, except the strongest spectral line and the fit of a whole
recording, which come from the load levels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from ou_monitor.analysis.level_result import LevelResult, ProcessType
from ou_monitor.analysis.noise import BAND, flown_near, Noise, Remainder, THROTTLES
from ou_monitor.analysis.quality import beware
from ou_monitor.analysis.supply import facts_and_end, SupplyFacts
from ou_monitor.criticism.adc import EXAMINED, find_step
from ou_monitor.criticism.readings import on_time
from ou_monitor.model.spectral_lines import fundamental_of
from ou_monitor.online.load.supply_load import AT_ONCE, hold, SupplyLoad
from ou_monitor.online.monitor import MonitorReport, SupplyMonitor
from ou_monitor.records import NAN, OuFacts, Recording
from ou_monitor.text import counted, number, percent, volts
from ou_monitor.timeline import pause_words, supplied

# Largest extrapolated sag that is given, relative to the level: a source with a resistance gives
# the most power at half its voltage.
FARTHEST = 0.5
# Minimum ratio of the fitted noise at the ends of the throttle range that is reported as a trend.
_GROWS = 1.25
# Minimum share of a recording that its only level must cover to stand for the whole (our choice).
_WHOLE = 0.9
# Minimum noise, V; less is rounding.
_NOTHING = 1e-9
# Minimum share of the noise of a level that lines must make up to be mentioned in the answer.
_LOUD = 0.25


@dataclass(frozen=True)
class LoudestLine:
    """The strongest spectral line of all load levels."""

    frequency: float  # Hz
    rms: float  # V
    share: float  # Share of the variance of its level, 0..1
    level: str  # Throttle of that level, in words
    # Number of lines of that level, and their total share of its variance.
    lines: int
    all_share: float
    fundamental: float  # Frequency of which most lines are multiples, Hz; NaN if there is none


@dataclass(frozen=True)
class Overview:
    """The facts that every command reports first."""

    facts: SupplyFacts
    duration: float  # Duration of the recording, s
    load: SupplyLoad  # Load model at the end; `facts` has its values at eleven throttles
    highest: float  # Highest throttle; NaN without throttle
    # Lowest and highest index of THROTTLES near which there are enough readings.
    flown: tuple[int, int]
    # Largest current, A, after a median of three readings; positive lowers the voltage; NaN: none.
    drawn: float = NAN
    # Ratio of the noise at the highest throttle flown to the noise at the lowest, from a fit; 1 if
    # it is within its error.
    growth: float = 1.0
    step: float = 0.0  # Median time between readings, s
    line: LoudestLine | None = None
    cells: int = 0  # Number of cells in series, for the limit per cell; 0: not given
    end: MonitorReport | None = None  # Report of the node at the end; None without a limit
    # Fit of the whole recording, if that is one stationary level, and if the fit is more precise
    # than `facts.ou` and agrees with it.
    whole: OuFacts | None = None
    beware: tuple[str, ...] = ()  # Warnings that change the meaning of every number
    pauses: str = ''  # Pauses, and samples left out, as the end of a sentence
    readings: int = 0  # Number of readings, with those that are left out
    # Whether the relaxation is no larger than the rounding error of the ADC, which looks like one
    # under slow changes: of 12 simulated packs with white noise, 8 to 12 then have a relaxation.
    rounding: bool = False

    @property
    def limit(self) -> float:
        """Return the voltage limit of dips, V; NaN without one."""
        return NAN if self.facts.dips is None else self.facts.dips.limit_v

    @property
    def sag(self) -> tuple[float, float, float]:
        """Return throttle, sag and its error, V, near the highest throttle flown."""
        sag, k = self.facts.sag, self.flown[1]
        return THROTTLES[k], sag.sag_v[k], sag.se_v[k]

    @property
    def noise(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return throttle and noise, V, near the lowest and the highest throttle flown."""
        low, high = self.flown
        rms = self.facts.noise.rms_v
        return (THROTTLES[low], rms[low]), (THROTTLES[high], rms[high])


def overview(recording: Recording, limit: float | None = None,
             levels: Sequence[LevelResult] = (), cells: int = 0,
             left: Remainder | None = None, monitor: SupplyMonitor | None = None) -> Overview:
    """Return the facts (limit of the pack in V; left, monitor: see `facts_and_end`)."""
    # levels: for spectral lines, and for the fit of the whole recording.
    facts, load, end = facts_and_end(recording, limit, left, monitor)
    known = recording.throttle[np.isfinite(recording.throttle)]
    near = np.flatnonzero(flown_near(recording, THROTTLES)).tolist() or [0]
    left_out = recording.n - supplied(recording).n
    pauses = pause_words(recording.t) + f'; {left_out} left out' * (left_out > 0)
    return Overview(facts, recording.duration if recording.n else 0.0, load,
                    float(known.max()) if known.size else NAN, (near[0], near[-1]),
                    _largest(recording), _growth(recording, facts.noise, near),
                    float(np.median(np.diff(recording.t))) if recording.n > 1 else 0.0,
                    _strongest(levels), cells, end, _whole(levels, recording, facts.ou),
                    beware(recording, cells), pauses, recording.n,
                    find_step(recording.voltage[:EXAMINED]) ** 2 / 12.0 > facts.ou.var_inf)


def _growth(recording: Recording, noise: Noise, near: Sequence[int]) -> float:
    """Return the ratio of noise at the highest and lowest throttle flown, by a fit."""
    # At steady throttle, if that is known, so that responses to its changes do not count.
    steady = [k for k in near if math.isfinite(noise.steady_rms_v[k])]
    rms, near = (noise.steady_rms_v, steady) if len(steady) > 2 else (noise.rms_v, near)
    if len(near) < 2 or not min(rms[k] for k in near) > 0.0:
        return 1.0
    u = np.array(THROTTLES)[near]
    weight = np.sqrt([np.count_nonzero(np.abs(recording.throttle - at) <= BAND) for at in u])
    (slope, _), error = np.polyfit(u, np.log(np.array(rms)[near]), 1, w=weight,
                                   cov=True if len(near) > 2 else 'unscaled')
    # The scatter about the line shows whether it is a trend; two points have none.
    seen = len(near) == 2 or abs(slope) > 2.0 * math.sqrt(error[0, 0])
    return math.exp(float(slope) * float(u[-1] - u[0])) if seen else 1.0


def _largest(recording: Recording) -> float:
    if recording.current is None or (known := np.isfinite(recording.current)).sum() < 3:
        return NAN
    current = recording.current[known]
    _, sign = on_time(recording.t[known], recording.voltage[known], current, 'current', [])
    return float(np.median(sliding_window_view(sign * current, 3), axis=1).max())


def _whole(levels: Sequence[LevelResult], recording: Recording, ou: OuFacts) -> OuFacts | None:
    if len(levels) != 1 or levels[0].kind is not ProcessType.DIFFUSION or (
            levels[0].time < _WHOLE * recording.duration):
        return None
    e, (least, most) = levels[0].estimate, ou.alpha_95
    low, high = e.interval('alpha')
    if not (low <= most and least <= high and high / low < most / least):
        return None
    return OuFacts('ok', levels[0].time, e.alpha, (low, high), e.sigma, e.interval('sigma'),
                   e.var_inf, e.interval('var_inf'))


def _strongest(levels: Sequence[LevelResult]) -> LoudestLine | None:
    found = [(line, level) for level in levels for line in level.lines.lines]
    if not found:
        return None
    line, level = max(found, key=lambda pair: pair[0].rms)
    lines = level.lines.lines
    return LoudestLine(line.frequency, line.rms, line.share, level.label, len(lines),
                       min(1.0, sum(each.share for each in lines)),
                       fundamental_of([each.frequency for each in lines]))


def answers(found: Overview) -> list[str]:
    """Return the answer as a list of sentences: the lowest voltage, then sag and lines."""
    parts, least = [], found.facts.lowest
    if math.isfinite(found.limit) and math.isfinite(least.voltage_v):
        lowest = f'the lowest was {number(least.voltage_v, 4)} V at {number(least.time_s)} s'
        parts.append(f'{dips}: {lowest}.' if (dips := _dips(found, found.limit)) else
                     f'The voltage stayed above {found.limit:g} V: {lowest}.')
    elif math.isfinite(least.voltage_v):
        parts.append(f'The voltage fell to {number(least.voltage_v, 4)} V at '
                     f'{number(least.time_s)} s.')
    at, sag, se = found.sag
    seen = determined(found, found.flown[1])
    if seen and found.facts.sag.known:
        parts.append(f'The rail sags by {volts(sag)} at {100.0 * at:.0f} % throttle.')
    elif fall := _fall_words(found):
        without = '' if seen or math.isnan(found.highest) else (
            '; no sag over throttle is measurable')
        parts.append(f'The resistance lowers the rail by {fall} (computed){without}.')
    elif not seen and sag + se > 0.0:
        parts.append(f'The sag at {100.0 * at:.0f} % throttle is below {volts(sag + 2.0 * se)}.')
    if found.line is not None and found.line.all_share > _LOUD:
        line = found.line
        what = (f'A line at {number(line.frequency, 4)} Hz makes' if line.lines == 1 else
                f'{line.lines} lines, the strongest at {number(line.frequency, 4)} Hz, make'
                if math.isnan(line.fundamental) else
                f'{line.lines} lines, most at multiples of {number(line.fundamental, 4)} Hz, make')
        where = '' if line.level == 'all' else f' at {line.level} throttle'
        parts.append(f'{what} {100.0 * line.all_share:.0f} % of the noise{where}.')
    return parts


def known_lines(found: Overview) -> list[tuple[str, str]]:
    """Return the facts as pairs of name and words."""
    least, resistance = found.facts.lowest, found.facts.resistance
    if not math.isfinite(least.voltage_v):
        return []
    where = (f', at {100.0 * least.throttle:.0f} % throttle'
             if math.isfinite(least.throttle) else '')
    lines = [('Lowest voltage',
              f'{number(least.voltage_v, 4)} V at {number(least.time_s)} s{where}')]
    if math.isfinite(found.limit):
        cells = f'; {found.limit / found.cells:.3g} V per cell' if found.cells else ''
        lines.append((f'Below {found.limit:g} V',
                      (_dips(found) or 'never') + cells))
    lines += [('Sag', _sag_words(found)), ('Noise', _noise_words(found))]
    if math.isfinite(resistance.ohm):
        held = max(hold(found.duration), found.step)
        lines.append(('Resistance', f'{number(1e3 * resistance.ohm)} mOhm (+- '
                      f'{number(2e3 * resistance.se_ohm, 2)}) after {held:.2g} s'
                      + (f', {number(1e3 * resistance.at_once_ohm)} after {AT_ONCE:g} s'
                         if resistance.at_once_ohm > 0.0 else '')
                      + (f'; times the largest current: {fall}'
                         if (fall := _fall_words(found)) else '')))
    elif abs(found.drawn) > 0.0:
        lines.append(('Resistance', 'unknown: the current changes too little or too seldom, or a '
                      'load seems to bypass the current sensor'))
    lines.append(('Relaxation', _ou_words(found.facts.ou, found.whole) + (
        '; no larger than the rounding error of the ADC, which can look like a relaxation'
        if found.rounding else '')))
    if found.line is not None:
        line = found.line
        where = '' if line.level == 'all' else f' at {line.level} throttle'
        lines.append(('Strongest line', f'{number(line.frequency, 4)} Hz, '
                      f'{number(1e3 * line.rms)} mV rms{where} ({percent(line.share)} of the '
                      'noise there)'))
    return lines


def _fall_words(found: Overview) -> str:
    """Return resistance times largest current, in words; empty if unknown."""
    drop = found.facts.resistance.ohm * found.drawn
    return f'{volts(drop)} at {number(found.drawn)} A' if drop > 0.0 else ''


def _dips(found: Overview, below: float = NAN) -> str:
    """Return the dips in words, with a limit if given; empty without dips."""
    dips = found.facts.dips
    if dips is None or not dips.count:
        return ''
    share = dips.seconds / found.duration if found.duration > 0.0 else 1.0
    limit = '' if math.isnan(below) else f' below {below:g} V'
    return (f'{counted(dips.count, "dip")}{limit}, '
            f'{number(dips.seconds, 2)} s in all ({percent(share)} of the time)')


def determined(found: Overview, k: int, flown: bool = True) -> bool:
    """Return whether the sag at a throttle of THROTTLES is larger than its 95 % error."""
    # At a throttle that was not flown, require this at the highest throttle flown, too.
    sag, se = found.facts.sag.sag_v, found.facts.sag.se_v
    return all(sag[i] > 2.0 * se[i] for i in (k, k if flown else found.flown[1]))


def _sag_words(found: Overview) -> str:
    sag = found.facts.sag
    if math.isnan(sag.flown[0]):
        return 'unknown: the recording has no throttle'
    at, there, se = found.sag
    why = '' if sag.known else f'. {found.load.status.value}'
    if not there + se > 0.0:
        return f'unknown{why}'
    if not determined(found, found.flown[1]):
        return f'below {volts(there + 2.0 * se)} at {100.0 * at:.0f} % throttle (95 %){why}'
    words = f'{volts(there)} (+- {volts(2.0 * se)}) at {100.0 * at:.0f} % throttle'
    if at < 1.0 and sag.sag_v[-1] > FARTHEST * found.load.level:
        words += '; the law cannot be extrapolated to full throttle'
    elif at < 1.0 and determined(found, -1, flown=False):
        words += (f'; about {volts(sag.sag_v[-1])} (+- {volts(2.0 * sag.se_v[-1])}) extrapolated '
                  'to full throttle')
    return words + why


def _noise_words(found: Overview) -> str:
    (first, low), (last, high) = found.noise
    if not (math.isfinite(low) and math.isfinite(high)):
        return 'unknown'
    if low < _NOTHING and high < _NOTHING:
        return 'none'
    if first == last:
        return f'{number(1e3 * low)} mV rms'
    ratios = found.growth, high / max(low, _NOTHING)
    if _GROWS * max(ratios) > 1.0 and min(ratios) < _GROWS:
        rms = found.facts.noise.rms_v[slice(found.flown[0], found.flown[1] + 1)]
        return (f'{number(1e3 * min(rms))} to {number(1e3 * max(rms))} mV rms, without a trend '
                'over throttle')
    return (f'{number(1e3 * low)} mV rms at {100.0 * first:.0f} % throttle, '
            f'{number(1e3 * high)} mV at {100.0 * last:.0f} %: it '
            f'{"grows" if found.growth > 1.0 else "falls"} with throttle')


def _ou_words(ou: OuFacts, whole: OuFacts | None = None) -> str:
    window = f'the last {number(ou.window_s)} s'
    if whole is not None:
        low, high = ou.alpha_95
        window = (f'all {number(whole.window_s)} s (in {window}, as in the JSON: alpha '
                  f'{number(ou.alpha)}, {number(low)} to {number(high)})')
        ou = whole
    if ou.status == 'ok':
        alpha, sigma = (f'{number(x)} (95 % {number(low)} to {number(high)})'
                        for x, (low, high) in ((ou.alpha, ou.alpha_95), (ou.sigma, ou.sigma_95)))
        return (f'alpha {alpha} 1/s, sigma {sigma} V/sqrt(s), '
                f'{number(1e3 * math.sqrt(ou.var_inf))} mV rms (level and load removed); '
                f'from {window}')
    if ou.status == 'not_visible':
        if not ou.var_inf_below:
            return f'none: no noise in {window}'
        return (f'not visible in {window}: faster than '
                f'{number(1e3 * ou.tau_below_s)} ms, or below '
                f'{number(1e3 * math.sqrt(ou.var_inf_below))} mV rms')
    return 'unknown: too few readings, too low a rate, or changes of level that hide it'
