"""
Recompute the paper: each printed number, eight points to consider when reading it, figures, JSON.

One seed determines all random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby
import math
from typing import Any

import numpy as np
from ou_monitor.model.ou import simulate
from ou_monitor.model.spectral_lines import even_on_log
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import ACCoupling
from ou_monitor.paper import published, tables
from ou_monitor.paper.oscilloscope import (
    CORNER_HZ, crest_rows, Crests, decay_rows, jump_rows, simulate_crests, simulate_jumps,
    slowest_rail)
from ou_monitor.paper.published import mean_and_error, Row, RowVerdict
from ou_monitor.records import FloatArray
from ou_monitor.text import number
from scipy.signal import welch

Progress = Callable[[float], None]
# Number of simulated segments of 0.5 s, which gives the 95 % quantile to within 0.03; simulated
# time with jumps, s.
CREST_PATHS, JUMP_SECONDS = 4000, 100.0
# Sections in the order of the paper.
_ORDER = ('Section 3.1', 'Section 3.3', 'Section 4.1', 'Section 4.2', 'Section 4.4',
          'Section 4.5', 'Table 1', 'Fig. 5', 'Section 5', 'Table 2', 'Section 6', 'Section 8')


@dataclass(frozen=True)
class Point:
    """One of the eight points to consider when reading the paper."""

    number: int  # 1 to 8
    title: str
    text: str  # Finding, with numbers
    rows: tuple[Row, ...]  # Rows it is based on


def count(rows: Sequence[Row]) -> dict[RowVerdict, int]:
    """Return the number of rows by verdict."""
    return {verdict: sum(row.verdict is verdict for row in rows) for verdict in RowVerdict}


def tally(rows: Sequence[Row]) -> str:
    """Return the counts in words, without zeros."""
    words = {RowVerdict.AGREES: ('agrees', 'agree'),
             RowVerdict.ROUNDING: ('within rounding', 'within rounding'),
             RowVerdict.DOES_NOT_HOLD: ('does not hold', 'do not hold')}
    return ', '.join(f'{n} {words[verdict][n > 1]}' for verdict, n in count(rows).items() if n)


def eight_points(rows: Sequence[Row], crests: Crests) -> tuple[Point, ...]:
    """Return what the rows of each point show together; their numbers are in the rows."""
    alpha = published.ALPHA.text
    means = ', '.join(f'{crests.mean(ms)[0]:.2f} on {ms} ms' for ms in sorted(crests.by_screen))
    texts = (
        ('Factor 2 in formula (6)',
         'With the generator as printed in (4), the variance of a switching system grows twice as '
         'fast as (6) says, whether or not its chain is reversible. So B = 2 sum pi C R0 C. A '
         'second check: under multiplicative noise ln U must not grow, but it does by (4) to (6) '
         'as printed. A sigma computed from a chain by (6) is too small by sqrt(2); a sigma '
         'measured from Vrms is not affected.'),
        ('alpha and the AC coupling of the oscilloscope',
         f'{alpha} 1/s is 2 pi x {published.ALPHA.value / (2.0 * math.pi):.2f} Hz, and AC '
         'coupling is a first-order high-pass, of 10 Hz on many oscilloscopes. Behind it, the '
         'rate read is at most the corner, and hardly changes with the rail: Fig. 5 shows that '
         f'the rail is faster than about {slowest_rail():.0f} 1/s, not that it is '
         f'{alpha}. Vrms would be too low as well. DC coupling, or a measured corner of the '
         'instrument, would decide.'),
        ('Fig. 5 and one exponential',
         'The rates between the points rise all the way. An exponential plus a constant fits all '
         'five points better; AC coupling, which shifts the baseline, or a second pole would '
         'explain it. The voltages of five points do not exclude one exponential at 95 % (F test '
         'of the constant). If the points scatter in proportion to their size, as a fit of ln|U| '
         'assumes, the last rate excludes it.'),
        ('Steps of the readings',
         'Every Vpp and every Vrms is a multiple of one step; by chance that would happen once in '
         f'{1 / published.VPP_STEP.chance:.0f} and {1 / published.VRMS_STEP.chance:.0f} cases. '
         'Half a step of Vrms is up to half of the reading, so sigma does not have four digits. '
         f'With motors off, "{published.IDLE.vrms.text}" beside Vpp = {published.IDLE.vpp.text} '
         'mV is a reading below one step.'),
        ('Crest factors and one OU',
         f'One OU with tau = {published.TAU_MS.text} ms, sampled at 1 MHz, shows a mean Vpp/Vrms '
         f'of {means} screens; the paper does not give the length of its screens. A larger crest '
         'factor shows something faster beside the OU: impulses, ripple, or white noise.'),
        ('Nonlinear growth above 40 %',
         'sigma grows faster than the load from 5 to 10 %, and more slowly from 10 to 40 %: '
         'saturation. Nothing above 40 % was measured.'),
        ('More capacitance and alpha',
         'For an RC rail alpha = 1/(R C) and Var_inf = S R/(2 C) under white current noise: both '
         'are halved by a second capacitor, sigma = sqrt(S)/C too. The advice to add low-ESR '
         'capacitance is right, because Var_inf falls; the reason given, that alpha rises, is '
         'not.'),
        ('Diffusion and jumps',
         'The paper says that its data justify diffusion and jump components, but fits no jumps. '
         'Jumps that relax at alpha would explain the readings at 5 and 10 % on long screens, and '
         'impulses too short to change Vrms would on any. The crest factor falls with load: the '
         'readings do not show impulses that come with load. Two readings at each load cannot '
         'tell jumps from impulses; a recording can (ou-monitor discover).'))
    return tuple(Point(k, title, text, tuple(row for row in rows if row.point == k))
                 for k, (title, text) in enumerate(texts, start=1))


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Result of `reproduce`."""

    seed: int  # Seed of all random numbers
    rows: tuple[Row, ...]  # In the order of the paper
    points: tuple[Point, ...]  # The eight points
    crests: Crests  # Simulated crest factors

    def parts(self) -> list[tuple[str, list[Row]]]:
        """Return the rows by table, figure and main section of the paper."""
        # 'Section 4.5' belongs to 'Section 4'; 'Fig. 5' stays.
        return [(part, list(rows)) for part, rows in groupby(self.rows, lambda row: (
            row.where.partition('.')[0] if row.where.startswith('Section') else row.where))]


def reproduce(seed: int = 1, progress: Progress | None = None) -> Reproduction:
    """Recompute the paper (progress 0..1)."""
    report: Progress = progress or (lambda share: None)
    # Each part has its own generator, so that none depends on the draws of another.
    rngs = np.random.default_rng(seed).spawn(6)
    crests = simulate_crests(rngs[0], CREST_PATHS)
    report(0.35)
    found = simulate_jumps(rngs[1], JUMP_SECONDS)
    report(0.6)
    rows = [*tables.table_1(*mean_and_error(crests.white)), *crest_rows(crests),
            *tables.table_2(), *tables.hardware_and_growth(), *jump_rows(found, crests)]
    rows += decay_rows(rngs[2])
    report(0.76)
    rows += tables.probabilities(rngs[3])
    report(0.8)
    rows += tables.switching_rows(rngs[4])
    report(0.86)
    rows += tables.averaging_rows(rngs[5])
    report(1.0)
    ordered = tuple(sorted(rows, key=lambda row: _ORDER.index(row.where)))
    return Reproduction(seed, ordered, eight_points(ordered, crests), crests)


def headline(result: Reproduction) -> str:
    """Return the result in one sentence."""
    counts = count(result.rows)
    return (f'Of {len(result.rows)} numbers and claims of the paper, '
            f'{counts[RowVerdict.AGREES]} agree with their recomputation, '
            f'{counts[RowVerdict.ROUNDING]} differ from it by no more than rounding, and '
            f'{counts[RowVerdict.DOES_NOT_HOLD]} do not hold.')


def recomputed(row: Row) -> str:
    """Return the recomputed number with its standard error."""
    digits = max(4, 1 + sum(c.isdigit() for c in row.printed.text.split('e')[0].lstrip('0.')))
    if not row.error:
        return number(row.recomputed, digits)
    # Decimals for two digits of the error.
    decimals = max(0, 1 - math.floor(math.log10(row.error)))
    return f'{row.recomputed:.{decimals}f} +- {row.error:.{decimals}f}'


def as_data(result: Reproduction) -> dict[str, Any]:
    return {
        'headline': headline(result),
        'seed': result.seed,
        'counts': {verdict.name: n for verdict, n in count(result.rows).items()},
        'rows': [_row_data(row) for row in result.rows],
        'points': [{'number': point.number, 'title': point.title, 'text': point.text,
                    'counts': {v.name: n for v, n in count(point.rows).items()}}
                   for point in result.points],
    }


def _row_data(row: Row) -> dict[str, Any]:
    return {
        'where': row.where, 'quantity': row.quantity, 'unit': row.unit,
        'printed': row.printed.text, 'printed_value': row.printed.value,
        'printed_half_unit': row.printed.half_unit, 'printed_inputs': row.printed_inputs,
        'recomputed': row.recomputed, 'error': row.error, 'interval': row.interval,
        'inputs': row.inputs, 'how': row.how, 'verdict': row.verdict.name,
        'sentence': row.sentence, 'point': row.point or None,
    }


# Length of a drawn screen, s.
_SCREEN = 0.1
# Spectrum: length of the simulated recording, s, and points per decade.
_SPECTRUM, _PER_DECADE = 2.0, 12


def lorentzian(frequency: FloatArray, alpha: float, sigma: float) -> FloatArray:
    """Return the one-sided density of an OU (frequency in Hz)."""
    return np.asarray(2.0 * sigma ** 2 / (alpha ** 2 + (2.0 * math.pi * frequency) ** 2))


def screen(state: published.PrintedLoad, rng: np.random.Generator
           ) -> tuple[FloatArray, FloatArray]:
    """Return times, s, and voltages, V, of a drawing (motors off: a Vrms of half a step)."""
    t = np.arange(round(_SCREEN * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    step = 1e-3 * published.VPP_STEP.size
    sigma = state.sigma or 0.5e-3 * published.VRMS_STEP.size * math.sqrt(
        2.0 * published.ALPHA.value)
    return t, step * np.round(simulate(t, published.ALPHA.value, sigma, rng) / step)


def spectrum(state: published.PrintedLoad, rng: np.random.Generator
             ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return frequencies, Hz, and densities, V^2/Hz: of the OU, and behind an AC coupling."""
    t = np.arange(round(_SPECTRUM * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    ou = OU(published.ALPHA.value, state.sigma, 0.0)
    frequency, plain = _density(simulate(t, ou.alpha, ou.sigma, rng))
    _, coupled = _density(SupplyModel((ou, ACCoupling(CORNER_HZ, 0.0))).simulate(t, rng))
    return frequency, plain, coupled


def _density(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    frequency, density = welch(u, published.SAMPLING_HZ, nperseg=u.size // 4)
    return even_on_log(frequency[2:-1], density[2:-1], _PER_DECADE)
