"""Tables 1 and 2, and the sections computed from them: 4, 5, 6 and 8."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.model.ou import simulate, stationary_variance
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.paper.design import with_capacitance
from ou_monitor.paper.network import PowerNetwork, Rail, rail_at
from ou_monitor.paper.published import (
    ALPHA, BATTERY_CELLS, BATTERY_V, ESC_HZ, HIGH, IDLE, LOADED, LOW, MEDIUM, over, Printed,
    PrintedLoad, Range, ReadingStep, RESTATED, ROOT_2_ALPHA, Row, SAMPLING_HZ, SIGMA, TABLE_1,
    TAU_MS, VAR_INF, VPP_STEP, VRMS_STEP)
from ou_monitor.paper.transient import PAPER_FIT
from ou_monitor.text import counted, percent
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov
from scipy.special import erfc

# Threshold of section 4.4, V: the paper gives none.
DELTA = 0.1
# Spacing of nearly independent samples, in tau: their correlation is exp(-_SPACING).
_SPACING = 8.0
# An RC rail, Ohm, F, A^2/Hz (two-sided); its elasticities do not depend on these values.
_R, _C, _S = 0.07, 470e-6, 1e-6


def table_1(white_crest: float, white_crest_se: float) -> list[Row]:
    """Return the rows of Table 1 without the crest factors."""
    return [*_multiples('Vpp', 'it is', VPP_STEP, [state.vpp for state in TABLE_1], TABLE_1),
            _idle(white_crest, white_crest_se),
            *_multiples('Vrms', 'Vrms and sigma are', VRMS_STEP, [s.vrms for s in LOADED], LOADED),
            *_amp(), *_grades()]


def _multiples(name: str, known: str, step: ReadingStep, readings: Sequence[Printed],
               states: Sequence[PrintedLoad]) -> list[Row]:
    """Return the rows of readings as multiples of the step of the oscilloscope."""
    return [Row(
        'Table 1', f'{name}, {state.label}', 'mV', reading, k * step.size,
        f'multiple of a common step of {step.low:.4g} to {step.high:.4g} mV',
        f'{counted(k, "step")}, so {known} known to half a step, '
        f'{percent(0.5 * step.size / reading.value)}.',
        point=4) for state, reading, k in zip(states, readings, step.multiples)]


def _idle(crest: float, crest_se: float) -> Row:
    step = VRMS_STEP.size
    lowest = IDLE.vpp.value / crest
    return Row(
        'Table 1', 'Vrms, motors off', 'mV', Printed(IDLE.vrms.text, 0.5 * step), lowest,
        'Vpp over the crest factor of white Gaussian noise, 100 ms at 1 MHz, Monte Carlo',
        f'Gaussian noise of any colour with this Vpp on 100 ms has {lowest:.1f} mV rms or more; '
        f'one step is {step:.2f} mV, so "~0" is a reading, not the absence of noise.',
        error=lowest * crest_se / crest, printed_inputs=(0.0, step), point=4)


def _amp() -> list[Row]:
    half = 0.5 * VPP_STEP.size
    found = []
    for state in TABLE_1:
        vpp = state.vpp.value
        found.append(Row(
            'Table 1', f'Amp, {state.label}', 'mV', state.amp, 0.5 * vpp,
            'max |u| of a trace through zero lies between Vpp/2 and Vpp',
            f'A peak of {state.amp.value:g} mV beside Vpp/2 = {0.5 * vpp:g} mV: '
            + ('possible.' if state.amp.value >= 0.5 * vpp else
               'a trace cannot be wider than twice its peak, so Amp is something else (such as '
               'top minus base).'),
            band=(0.5 * vpp, vpp), inputs=(0.5 * (vpp - half), vpp + half)))
    return found


def _grades() -> list[Row]:
    step = VRMS_STEP.size
    below = 0.5 * step
    ratio = HIGH.vrms.value / MEDIUM.vrms.value
    low, high = over(HIGH.vrms_range, MEDIUM.vrms_range)
    found = [Row(
        'Table 1', f'{name}: {state.label} over motors off', '', Printed('> 1'),
        state.vrms.value / below, 'Vrms over half a step, the largest that reads as zero',
        'The order holds; the factor is a lower bound, because V0 reads as zero.',
        inputs=over(state.vrms_range, (below, step)))
        for name, state in (('V1 > V0', LOW), ('V2 >> V0', MEDIUM))]
    found.append(Row(
        'Table 1', 'V3 >> V2: 40 % over 10 %', '', Printed('> 1'), ratio, 'quotient of the Vrms',
        f'The order holds; the factor is {ratio:.1f} ({low:.1f} to {high:.1f} within half a '
        'step), which is hardly ">>".', inputs=(low, high)))
    return found


def exponent(low: PrintedLoad, high: PrintedLoad) -> tuple[float, Range]:
    """Return the growth of sigma with load: d ln sigma / d ln load between two states."""
    span = math.log(high.load / low.load)
    ends = over(high.vrms_range, low.vrms_range)
    return (math.log(high.vrms.value / low.vrms.value) / span,
            (math.log(ends[0]) / span, math.log(ends[1]) / span))


def sigma_half_width(state: PrintedLoad) -> float:
    """Return the uncertainty of sigma, V/sqrt(s)."""
    # Half a step of Vrms and half of the 95 % interval of alpha, in quadrature.
    reading = 0.5 * VRMS_STEP.size / state.vrms.value
    rate = 0.5 * PAPER_FIT.half_width / PAPER_FIT.alpha
    return state.sigma * math.hypot(reading, rate)


def table_2() -> list[Row]:
    """Return the rows of Table 2 and of the sections that repeat it."""
    alpha = ALPHA.value
    root = math.sqrt(2.0 * alpha)
    found = [
        Row('Section 5', 'sqrt(2 alpha)', '1/sqrt(s)', ROOT_2_ALPHA, root,
            f'sqrt(2 x {ALPHA.text})', 'The arithmetic is right.'),
        Row('Table 2', 'tau', 'ms', TAU_MS, 1e3 / alpha, f'1 / {ALPHA.text}',
            'The arithmetic is right; the five digits come from the division, alpha has three.')]
    for state in (MEDIUM, HIGH):
        found += _load_rows(state)
    return found + _repetitions()


def _load_rows(state: PrintedLoad) -> list[Row]:
    sigma, printed = state.sigma, SIGMA[state.label]
    half = 1e-3 * state.vrms.half_unit * math.sqrt(2.0 * ALPHA.value)
    step = VRMS_STEP
    whole = 1e-3 * round(state.vrms.value / step.size) * step.low * ROOT_2_ALPHA.value
    width = sigma_half_width(state)
    low, high = state.vrms_range
    var = stationary_variance(ALPHA.value, printed.value)
    return [
        Row('Table 2', f'sigma, {state.label}', 'V/sqrt(s)', printed, sigma,
            f'Vrms sqrt(2 alpha) with {state.vrms.text} mV',
            f'{sigma:.5f} from the rounded Vrms; whole steps of {step.low:.3f} mV times '
            f'{ROOT_2_ALPHA.text} give {whole:.5f}.',
            inputs=(sigma - half, sigma + half)),
        Row('Table 2', f'implied error, {state.label}', 'V/sqrt(s)',
            Printed(f'{printed.half_unit:.2g}', 0.0), width,
            'half a step of Vrms and the 95 % interval of alpha, in quadrature',
            f'sigma is {sigma:.2f} +- {width:.2f} V/sqrt(s), {100.0 * width / sigma:.0f} %, but '
            'is printed with four digits.', point=4),
        Row('Table 2', f'Var_inf, {state.label}', 'V^2', VAR_INF[state.label], var,
            'sigma^2 / (2 alpha) with the printed numbers',
            f'The arithmetic is right; the resolution of Vrms allows {1e-6 * low ** 2:.2g} to '
            f'{1e-6 * high ** 2:.2g} V^2.')]


def _repetitions() -> list[Row]:
    said = {
        'Section 4.5': 'The paper infers that filtration is at its limit; the number, from Fig. '
                       '5, shows that only if it comes from the network and not from the '
                       'oscilloscope.',
        'Section 8': 'The number is from Fig. 5. A rate alone does not confirm an OU: every '
                     'first-order system has one, AC coupling included.'}
    return [Row(
        where, quantity, unit, printed,
        PAPER_FIT.alpha if quantity == 'alpha' else HIGH.sigma,
        'least squares, as for Fig. 5' if quantity == 'alpha' else 'Vrms sqrt(2 alpha)',
        said.get(where, 'The same number as in Table 2.'))
        for where, quantity, printed, unit in RESTATED]


def beyond(delta: float, var_inf: float) -> float:
    """Return P(|U| > delta) in closed form, erfc(delta / sqrt(2 Var_inf))."""
    return float(erfc(delta / math.sqrt(2.0 * var_inf)))


def beyond_by_quadrature(delta: float, var_inf: float) -> float:
    """Return the integral of section 4.4 as printed, by quadrature."""
    scale = 1.0 / math.sqrt(2.0 * math.pi * var_inf)
    # Beyond 40 standard deviations the density is below the smallest double.
    end = delta + 40.0 * math.sqrt(var_inf)
    total, _ = quad(lambda x: scale * math.exp(-0.5 * x * x / var_inf), delta, end,
                    epsabs=0.0, epsrel=1e-12, limit=200)
    return 2.0 * float(total)


def probabilities(rng: np.random.Generator, draws: int = 1_000_000) -> list[Row]:
    """Return the rows of section 4.4."""
    found, alpha = [], ALPHA.value
    for state, deltas in ((MEDIUM, (0.05, DELTA)), (HIGH, (0.05, DELTA, 0.15))):
        u = np.abs(simulate(np.arange(draws) * (_SPACING / alpha), alpha, state.sigma, rng))
        for delta in deltas:
            share = float(np.mean(u > delta))
            formula = beyond_by_quadrature(delta, state.variance)
            closed = beyond(delta, state.variance)
            found.append(Row(
                'Section 4.4', f'P(|U| > {1e3 * delta:g} mV), {state.label}', '',
                Printed(f'{formula:.4g}'), share,
                f'printed integral by quadrature, against {draws} independent samples of the OU',
                f'The formula is right, and is erfc(delta / sqrt(2 Var_inf)) = {closed:.4g}.',
                error=math.sqrt(share * (1.0 - share) / draws)))
    return [*found, *_threshold_rows()]


def _threshold_rows() -> list[Row]:
    low, medium, high = (state.variance for state in LOADED)
    ratio = beyond(DELTA, high) / beyond(DELTA, medium)
    spread = [beyond(DELTA, (1e-3 * v) ** 2) for s in (MEDIUM, HIGH)
              for v in s.vrms_range]
    load = HIGH.load / MEDIUM.load
    times = [mean_first_passage(0.0, DELTA / math.sqrt(v)) / ALPHA.value
             for v in (medium, high)]
    wide = over(HIGH.vrms_range, LOW.vrms_range)
    return [
        Row('Section 4.4', f'P(|U| > {1e3 * DELTA:g} mV), 40 % over 10 %', '',
            Printed(f'> {load:g}'), ratio, 'quotient of the formula',
            f'"Nonlinear" holds: {load:.0f} times the load gives {ratio:.0f} times the '
            f'probability; the resolution of Vrms allows {spread[2] / spread[1]:.0f} to '
            f'{spread[3] / spread[0]:.0f}.',
            inputs=(spread[2] / spread[1], spread[3] / spread[0])),
        Row('Section 4.4', f'rate of falls by {1e3 * DELTA:g} mV, 40 over 10 %', '',
            Printed('> 1'), times[0] / times[1], 'quotient of mean first-passage times',
            'P(|U| > delta) is a share of time, not a frequency; the mean first-passage time to '
            f'such a fall is {times[0]:.3g} s at 10 % and {times[1]:.3g} s at 40 %.'),
        Row('Section 4.4', 'Var_inf, 40 % over 5 %', '', Printed('> 1'), high / low,
            'squared quotient of the Vrms',
            f'Larger, as printed: {high / low:.0f} times, {wide[0] ** 2:.0f} to '
            f'{wide[1] ** 2:.0f} within half a step.', inputs=(wide[0] ** 2, wide[1] ** 2))]


def rc_rail(resistance: float, capacitance: float, density: float) -> tuple[float, float]:
    """Return the rate, 1/s, and variance, V^2, of an RC rail under white current noise."""
    a = np.array([[-1.0 / (resistance * capacitance)]])
    b = np.array([[math.sqrt(density) / capacitance]])
    return (float(-np.linalg.eigvals(a)[0].real),
            float(solve_continuous_lyapunov(a, -b @ b.T)[0, 0]))


def doubled(network: PowerNetwork) -> tuple[Rail, Rail]:
    """Return the bus at 40 % throttle, now and with a second capacitor in parallel."""
    more = with_capacitance(network, 2.0 * network.bulk_capacitance)
    return rail_at(network, HIGH.load), rail_at(more, HIGH.load)


def _elasticity(before: float, after: float) -> float:
    return math.log(after / before) / math.log(2.0)


def share_above(frequency: float) -> float:
    """Return the share of an OU's variance above a frequency, Hz, for the paper's alpha."""
    return 1.0 - 2.0 / math.pi * math.atan(2.0 * math.pi * frequency / ALPHA.value)


def hardware_and_growth() -> list[Row]:
    """Return the rows of sections 4.1, 4.2, 4.5 and 6."""
    return [*_hardware(), *_capacitance(), *_growth()]


def _hardware() -> list[Row]:
    low, high = ESC_HZ
    nyquist = 0.5 * SAMPLING_HZ
    return [
        Row('Section 4.1', 'nominal voltage of 6S', 'V', BATTERY_V,
            3.7 * BATTERY_CELLS, '6 cells of 3.7 V', 'The arithmetic is right.'),
        Row('Section 4.2', 'Nyquist frequency at 1 MHz', 'kHz', Printed(f'> {1e-3 * high:g}'),
            1e-3 * nyquist, 'half of the sampling frequency',
            f'ESC lines at {1e-3 * low:g} to {1e-3 * high:g} kHz are resolved with '
            f'{int(nyquist / high)} harmonics; the OU itself has {percent(share_above(low))} '
            'of its variance there.')]


def _capacitance() -> list[Row]:
    one, two = (rc_rail(_R, k * _C, _S) for k in (1.0, 2.0))
    before, after = doubled(PowerNetwork())
    alpha, var = (_elasticity(a, b) for a, b in zip(one, two))
    net_alpha, net_var = (_elasticity(before.alpha, after.alpha),
                          _elasticity(before.var_inf, after.var_inf))
    loop = before.network.battery_resistance + before.network.bulk_esr
    farad = 1.0 / (ALPHA.value * loop)
    return [
        Row('Section 4.5', 'd ln alpha / d ln C', '', Printed('> 0'), alpha,
            'eigenvalue of an RC rail, C doubled',
            f'alpha = 1/(R C) falls with C ({net_alpha:+.2f} for a 6S network of typical parts '
            f'with capacitors in parallel, whose alpha is {before.alpha:.2g} 1/s; {ALPHA.text} '
            f'1/s would need {farad:.2g} F).', point=7),
        Row('Section 4.5', 'd ln Var_inf / d ln C', '', Printed('< 0'), var,
            "Lyapunov's equation of an RC rail under white current noise, C doubled",
            f'The advice is right for another reason: Var_inf = S R/(2 C) falls ({net_var:+.2f} '
            'for that network).', point=7)]


def _growth() -> list[Row]:
    first, first_in = exponent(LOW, MEDIUM)
    second, second_in = exponent(MEDIUM, HIGH)
    above = sum(state.load > HIGH.load for state in TABLE_1)
    ratio = HIGH.vrms.value / LOW.vrms.value
    return [
        Row('Section 6', 'exponent of sigma in load, 5 -> 10 %', '', Printed('> 1'), first,
            'ln(Vrms quotient) / ln(load quotient)',
            f'Faster than the load: exponent {first:.2f}, {first_in[0]:.2f} to {first_in[1]:.2f} '
            'within half a step of Vrms.', inputs=first_in, point=6),
        Row('Section 6', 'exponent of sigma in load, 10 -> 40 %', '', Printed('> 1'), second,
            'ln(Vrms quotient) / ln(load quotient)',
            f'Towards 40 % sigma grows more slowly than the load: exponent {second:.2f}, '
            f'{second_in[0]:.2f} to {second_in[1]:.2f} within half a step of Vrms.',
            inputs=second_in, point=6),
        Row('Section 6', 'load states measured above 40 %', '', Printed('> 0'), float(above),
            'rows of Table 1', '"40 % and above" is claimed, but nothing above was measured.',
            point=6),
        Row('Section 8', 'sigma, 40 % over 5 %', '', Printed('> 1'), ratio,
            'quotient of the Vrms', f'Noise grows with load, {ratio:.1f} times in all.',
            inputs=over(HIGH.vrms_range, LOW.vrms_range))]
