"""
Recompute the paper: each printed number, eight points to consider when reading it, figures, JSON.

One seed determines all random numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from ou_monitor.criticism.curves import even_on_log
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import ACCoupling
from ou_monitor.paper import published, switching, tables, transient
from ou_monitor.paper.crest import (
    Crests, impulse_height, jump_rows, JUMP_SCREENS_MS, JumpCrest, largest, mean_and_error,
    rows as crest_rows, simulate_crests, simulate_jumps)
from ou_monitor.paper.network import PowerNetwork
from ou_monitor.paper.published import over, Row, RowVerdict
from ou_monitor.paper.switching import IntegralVariance
from ou_monitor.paper.tables import exponent, sigma_half_width
from ou_monitor.paper.transient import CORNER, CORNER_HZ, PAPER_FIT
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

    @property
    def outcome(self) -> str:
        """Return the number of rows by verdict, in words."""
        return tally(self.rows)


def count(rows: Sequence[Row]) -> dict[RowVerdict, int]:
    """Return the number of rows by verdict."""
    return {verdict: sum(row.verdict is verdict for row in rows) for verdict in RowVerdict}


def tally(rows: Sequence[Row]) -> str:
    """Return the counts in words, without zeros."""
    words = {RowVerdict.AGREES: ('agrees', 'agree'),
             RowVerdict.ROUNDING: ('within rounding', 'within rounding'),
             RowVerdict.DOES_NOT_HOLD: ('does not hold', 'do not hold')}
    return ', '.join(f'{n} {words[verdict][n > 1]}' for verdict, n in count(rows).items() if n)


def eight_points(rows: Sequence[Row], crests: Crests,
                 found: list[JumpCrest]) -> tuple[Point, ...]:
    texts = (
        ('Factor 2 in formula (6)', _factor(rows)),
        ('alpha and the AC coupling of the oscilloscope', _coupling(rows)),
        ('Fig. 5 and one exponential', _exponential(rows)),
        ('Steps of the readings', _steps()),
        ('Crest factors and one OU', _crests(crests)),
        ('Nonlinear growth above 40 %', _growth()),
        ('More capacitance and alpha', _capacitance()),
        ('Diffusion and jumps', _jumps(crests, found)))
    return tuple(Point(k, title, text, tuple(row for row in rows if row.point == k))
                 for k, (title, text) in enumerate(texts, start=1))


def _row(rows: Sequence[Row], start: str) -> Row:
    return next(row for row in rows if row.quantity.startswith(start))


def _factor(rows: Sequence[Row]) -> str:
    two, three = _row(rows, 'B of (6), telegraph'), _row(rows, 'B of (6), three')
    log = _row(rows, 'growth of ln U')

    def ratio(row: Row) -> str:
        return (f'{row.recomputed / row.printed.value:.3f} +- '
                f'{(row.error or 0.0) / row.printed.value:.3f}')

    away = abs(two.recomputed - two.printed.value) / (two.error or math.nan)
    return (f'With the generator as printed in (4), the variance of a switching system grows '
            f'{ratio(two)} times as fast as (6) says for telegraph noise ({away:.0f} standard '
            f'errors from 1), and {ratio(three)} times for a chain of three states that is not '
            f'reversible. So B = 2 sum pi C R0 C. A second check: under multiplicative noise ln U '
            f'must not grow; (4) to (6) as printed say {log.printed.value:g} 1/s, the simulation '
            f'{log.recomputed:.2f} +- {log.error or 0.0:.2f} 1/s. A sigma computed from a chain '
            'by (6) is too small by sqrt(2); a sigma measured from Vrms is not affected.')


def _coupling(rows: Sequence[Row]) -> str:
    line = PAPER_FIT
    fitted = _row(rows, f'alpha fitted, rail of {transient.TYPICAL_RAIL:g}')
    slope = _row(rows, 'd ln(alpha fitted)')
    # A high-pass leaves alpha / (alpha + corner) of the variance of an OU.
    kept = math.sqrt(published.ALPHA.value / (published.ALPHA.value + CORNER))
    alpha = published.ALPHA.text
    return (f'{alpha} 1/s is 2 pi x {published.ALPHA.value / (2.0 * math.pi):.2f} Hz, and '
            f'AC coupling is a first-order high-pass, of 10 Hz on many oscilloscopes. Behind '
            f'it, a rail of {transient.TYPICAL_RAIL:g} 1/s is read as {fitted.recomputed:.1f} '
            f'1/s, and the reading shows only {100 * slope.recomputed:.1f} '
            f'+- {100 * (slope.error or 0.0):.1f} % of a change of its rate. The reading never '
            f'exceeds the corner, and a rail slower than the corner is read as slower: with that '
            f'coupling, Fig. 5 ({line.alpha:.1f} +- {line.half_width:.1f} 1/s) shows that the '
            f'rail is faster than about {transient.slowest_rail():.0f} 1/s, not that it is '
            f'{alpha}. Behind the coupling, an OU of {alpha} 1/s would keep {100 * kept:.0f} % of '
            'its standard deviation, so Vrms would be too low as well. DC coupling, or a measured '
            'corner of the instrument, would decide.')


def _exponential(rows: Sequence[Row]) -> str:
    rates = transient.local_rates()
    plain, shifted = transient.decay_fits()
    test, p = transient.offset_test()
    low, high = shifted.band(1)
    outside = [row.quantity.partition(', ')[2] for row in rows
               if row.quantity.startswith('rate, ') and row.verdict is RowVerdict.DOES_NOT_HOLD]
    return (f'The rates between the points are {", ".join(f"{r:.1f}" for r in rates)} 1/s, rising '
            'all the way. An exponential plus a constant fits all five '
            f'{plain.rss / shifted.rss:.1f} times better in residual sum of squares: alpha '
            f'{shifted.parameters[1]:.1f} 1/s (95 % {low:.0f} to {high:.0f}), offset '
            f'{shifted.parameters[2]:.1f} mV. AC coupling, which shifts the baseline, or a second '
            f'pole would explain it. The F test of the offset gives p = {p:.2f}, so the voltages '
            'of five points do not exclude one exponential at 95 %. If the points scatter in '
            'proportion to their size, as a fit of ln|U| assumes, one exponential is excluded by '
            f'the rates at: {", ".join(outside)}.')


def _steps() -> str:
    vpp, vrms = published.VPP_STEP, published.VRMS_STEP
    halves = ', '.join(f'{50.0 * vrms.size / s.vrms.value:.0f} % at {s.label}'
                       for s in published.LOADED)
    sigmas = ', '.join(
        f'{s.sigma:.2f} +- {sigma_half_width(s):.2f} at {s.label}'
        for s in published.LOADED)
    return (f'Every Vpp is a multiple ({", ".join(map(str, vpp.multiples))}) of {vpp.low:.4g} to '
            f'{vpp.high:.4g} mV, and every Vrms ({", ".join(map(str, vrms.multiples))}) of '
            f'{vrms.low:.4g} to {vrms.high:.4g} mV; by chance that would happen once in '
            f'{1 / vpp.chance:.0f} and {1 / vrms.chance:.0f} cases. Half a step of Vrms is '
            f'{halves}. With this and the interval of alpha, sigma is {sigmas} V/sqrt(s). With '
            f'motors off, "{published.IDLE.vrms.text}" beside Vpp = {published.IDLE.vpp.text} mV '
            'is a reading below one step.')


def _crests(crests: Crests) -> str:
    means = ', '.join(f'{crests.mean(ms)[0]:.2f} +- {number(crests.mean(ms)[1], 1)} on {ms} ms'
                      for ms in sorted(crests.by_screen))
    longest = max(crests.by_screen)
    limit = crests.quantile(longest, 0.95)
    parts = []
    for state in published.LOADED:
        value, (low, high) = state.crest, state.crest_range
        if low > limit:
            said = f'above that, and at least {low:.2f} within half a step of each reading'
        elif value > limit:
            said = f'below that only at the edge of its rounding ({low:.1f} to {high:.1f})'
        else:
            said = 'below that'
        parts.append(f'{state.label} has {value:.1f}: {said}')
    return (f'One OU with tau = {published.TAU_MS.text} ms, sampled at 1 MHz, shows a Vpp/Vrms of '
            f'{means} screens; 95 % of the {longest} ms screens lie below {limit:.2f}. '
            f'{"; ".join(parts)}. A larger crest factor shows something faster beside the OU: '
            'impulses, ripple, or white noise. The paper does not give the length of its '
            'screens; on longer ones the crest factor is larger.')


def _growth() -> str:
    (first, first_in), (second, second_in) = (
        exponent(published.LOW, published.MEDIUM), exponent(published.MEDIUM, published.HIGH))
    above = sum(state.load > published.HIGH.load for state in published.TABLE_1)
    return (f'sigma goes as load to the power {first:.2f} ({first_in[0]:.2f} to {first_in[1]:.2f} '
            f'within half a step of Vrms) from 5 to 10 %, then {second:.2f} ({second_in[0]:.2f} '
            f'to {second_in[1]:.2f}) from 10 to 40 %: saturation. Load states measured above '
            f'40 %: {above}.')


def _capacitance() -> str:
    before, after = tables.doubled(PowerNetwork())
    return (f'For an RC rail alpha = 1/(R C) and Var_inf = S R/(2 C) under white current noise: '
            f'both are halved by a second capacitor, sigma = sqrt(S)/C too. In a 6S network of '
            f'typical parts at 40 %, a second {1e6 * before.network.bulk_capacitance:.0f} uF in '
            f'parallel lowers alpha from {number(before.alpha)} to {number(after.alpha)} 1/s and '
            f'the standard deviation from {1e3 * math.sqrt(before.var_inf):.0f} to '
            f'{1e3 * math.sqrt(after.var_inf):.0f} mV. The advice to add low-ESR '
            'capacitance is right, because Var_inf falls; the reason given, that alpha rises, is '
            'not.')


def _jumps(crests: Crests, found: list[JumpCrest]) -> str:
    parts = []
    for ms in JUMP_SCREENS_MS:
        best = largest(found, ms)
        parts.append(
            f'{best.mean:.1f} on {ms} ms screens ({best.rate:g} a second, '
            f'{100 * best.share:.0f} % of the variance, '
            f'{best.size(published.LOW.vrms.value):.0f} mV rms at 5 % and '
            f'{best.size(published.MEDIUM.vrms.value):.0f} mV at 10 %, excess kurtosis '
            f'{best.kurtosis:.0f})')
    heights = ', '.join(f'{impulse_height(s, crests):.0f} mV at {s.label}'
                        for s in published.LOADED)
    low, medium, high = (state.crest for state in published.LOADED)
    quotient = over(published.HIGH.crest_range, published.LOW.crest_range)
    return ('The paper says that its data justify diffusion and jump components, but fits no '
            'jumps. Of the compound Poisson jumps tried, relaxing at alpha, the best show '
            f'a mean crest factor of {" and ".join(parts)}; the readings require {low:.1f} (5 %) '
            f'and {medium:.1f} (10 %). Impulses '
            f'too short to change Vrms would have to add {heights} to the Vpp of the OU. '
            f'From 5 to 40 % the crest factor goes from {low:.1f} to {high:.1f} (quotient '
            f'{quotient[0]:.2f} to {quotient[1]:.2f} within half a step): '
            'the readings do not show impulses that come with load. '
            'Two readings at each load cannot tell jumps from impulses; a recording can '
            '(ou-monitor discover).')


@dataclass(frozen=True, eq=False)
class Reproduction:
    """Result of `reproduce`."""

    seed: int  # Seed of all random numbers
    rows: tuple[Row, ...]  # In the order of the paper
    points: tuple[Point, ...]  # The eight points
    crests: Crests  # Simulated crest factors
    spreading: IntegralVariance  # Variance of the integral of telegraph noise
    screens: tuple[Screen, ...]  # One per load state
    spectra: tuple[SimulatedSpectrum, ...]  # Of 10 and 40 %

    def parts(self) -> list[tuple[str, list[Row]]]:
        """Return the rows by table, figure and main section of the paper."""
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            # 'Section 4.5' belongs to 'Section 4'; 'Fig. 5' stays.
            found.setdefault(row.where.rsplit('.', 1)[0] if row.where.startswith('Section')
                             else row.where, []).append(row)
        return list(found.items())


def reproduce(seed: int = 1, progress: Progress | None = None) -> Reproduction:
    """Recompute the paper (progress 0..1)."""
    report: Progress = progress or (lambda share: None)

    def within(start: float, stop: float) -> Progress:
        return lambda share: report(start + share * (stop - start))

    # Each part has its own generator, so that none depends on the draws of another.
    rngs = np.random.default_rng(seed).spawn(8)
    crests = simulate_crests(rngs[0], CREST_PATHS, within(0.0, 0.35))
    found = simulate_jumps(rngs[1], JUMP_SECONDS, within(0.35, 0.6))
    rows = [*tables.table_1(*mean_and_error(crests.white)), *crest_rows(crests),
            *tables.table_2(), *tables.hardware_and_growth(), *jump_rows(found, crests)]
    rows += transient.rows(rngs[2])
    report(0.76)
    rows += tables.probabilities(rngs[3])
    report(0.8)
    rows += switching.rows(rngs[4])
    report(0.86)
    rows += switching.averaging_rows(rngs[5])
    spreading = switching.spreading(rngs[6], 20_000)
    report(0.92)
    screens = tuple(_screen(state, rngs[7]) for state in published.TABLE_1)
    spectra = tuple(_spectrum(state, rngs[7]) for state in (published.MEDIUM, published.HIGH))
    report(1.0)
    ordered = tuple(sorted(rows, key=lambda row: _ORDER.index(row.where)))
    return Reproduction(seed, ordered, eight_points(ordered, crests, found), crests, spreading,
                        screens, spectra)


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
SCREEN = 0.1
# Spectrum: length of the simulated recording, s, and points per decade.
_SPECTRUM, _PER_DECADE = 2.0, 12


@dataclass(frozen=True, eq=False)
class Screen:
    """One simulated oscilloscope screen."""

    state: published.PrintedLoad  # Its row of Table 1
    # Time, s, and voltage, V, in steps of the oscilloscope; shape (n,).
    t: FloatArray
    u: FloatArray


@dataclass(frozen=True, eq=False)
class SimulatedSpectrum:
    """One-sided density of a load state."""

    state: published.PrintedLoad  # Its row of Table 1
    # Frequency, Hz, and density, V^2/Hz, of a simulated recording at 1 MHz; shape (k,).
    frequency: FloatArray
    density: FloatArray
    coupled: FloatArray  # Density of the same OU behind an AC coupling of 10 Hz


def lorentzian(frequency: FloatArray, alpha: float, sigma: float) -> FloatArray:
    """Return the one-sided density of an OU (frequency in Hz)."""
    return np.asarray(2.0 * sigma ** 2 / (alpha ** 2 + (2.0 * math.pi * frequency) ** 2))


def _screen(state: published.PrintedLoad, rng: np.random.Generator) -> Screen:
    """Return a screen of a load state (motors off: with a Vrms of half a step)."""
    t = np.arange(round(SCREEN * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    step = 1e-3 * published.VPP_STEP.size
    sigma = state.sigma or 0.5e-3 * published.VRMS_STEP.size * math.sqrt(
        2.0 * published.ALPHA.value)
    return Screen(state, t, step * np.round(
        simulate(t, published.ALPHA.value, sigma, rng) / step))


def _spectrum(state: published.PrintedLoad, rng: np.random.Generator) -> SimulatedSpectrum:
    """Return the spectrum of a simulation at 1 MHz, evenly spaced on a log axis."""
    t = np.arange(round(_SPECTRUM * published.SAMPLING_HZ)) / published.SAMPLING_HZ
    ou = OU(published.ALPHA.value, state.sigma, 0.0)
    plain = _density(simulate(t, ou.alpha, ou.sigma, rng))
    coupled = _density(SupplyModel((ou, ACCoupling(CORNER_HZ, 0.0))).simulate(t, rng))
    return SimulatedSpectrum(state, plain[0], plain[1], coupled[1])


def _density(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    frequency, density = welch(u, published.SAMPLING_HZ, nperseg=u.size // 4)
    return even_on_log(frequency[2:-1], density[2:-1], _PER_DECADE)
