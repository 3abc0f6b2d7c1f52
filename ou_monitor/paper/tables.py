"""
Tables 1 and 2, the sections computed from them (4, 5, 6 and 8), and section 3.

The chains of section 3 are simulated jump by jump, with exact motion between jumps: the recomputed
numbers use no limit theorem.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.model.ou import simulate, stationary_variance
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.paper.design import with_capacitance
from ou_monitor.paper.network import PowerNetwork, Rail, rail_at
from ou_monitor.paper.oscilloscope import PAPER_FIT
from ou_monitor.paper.published import (
    ALPHA, BATTERY_CELLS, BATTERY_V, ESC_HZ, HIGH, IDLE, LOADED, LOW, mean_and_error, MEDIUM, over,
    Printed, PrintedLoad, Range, ReadingStep, RESTATED, ROOT_2_ALPHA, Row, SAMPLING_HZ, SIGMA,
    TABLE_1, TAU_MS, VAR_INF, VPP_STEP, VRMS_STEP)
from ou_monitor.paper.theory import (
    Generator, matrix_model, PRINTED_FACTOR, SwitchedSystem, switching_drift,
    switching_intensity)
from ou_monitor.records import FloatArray
from ou_monitor.text import counted, percent
from scipy.integrate import quad
from scipy.linalg import expm
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
    # Half a step of Vrms and half of the 95 % interval of alpha, in quadrature.
    width = sigma * math.hypot(0.5 * step.size / state.vrms.value,
                               0.5 * PAPER_FIT.half_width / PAPER_FIT.alpha)
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
    """Return P(|U| > delta), the integral of section 4.4, in closed form."""
    return float(erfc(delta / math.sqrt(2.0 * var_inf)))


def probabilities(rng: np.random.Generator, draws: int = 1_000_000) -> list[Row]:
    """Return the rows of section 4.4."""
    found, alpha = [], ALPHA.value
    for state, deltas in ((MEDIUM, (0.05, DELTA)), (HIGH, (0.05, DELTA, 0.15))):
        u = np.abs(simulate(np.arange(draws) * (_SPACING / alpha), alpha, state.sigma, rng))
        for delta in deltas:
            share = float(np.mean(u > delta))
            found.append(Row(
                'Section 4.4', f'P(|U| > {1e3 * delta:g} mV), {state.label}', '',
                Printed(f'{beyond(delta, state.variance):.4g}'), share,
                f'printed integral, against {draws} independent samples of the OU',
                'The formula is right, and is erfc(delta / sqrt(2 Var_inf)).',
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
    rate = 1.0 / (resistance * capacitance)
    return rate, stationary_variance(rate, math.sqrt(density) / capacitance)


def doubled(network: PowerNetwork) -> tuple[Rail, Rail]:
    """Return the bus at 40 % throttle, now and with a second capacitor in parallel."""
    more = with_capacitance(network, 2.0 * network.bulk_capacitance)
    return rail_at(network, HIGH.load), rail_at(more, HIGH.load)


def share_above(frequency: float) -> float:
    """Return the share of an OU's variance above a frequency, Hz, for the paper's alpha."""
    return 1.0 - 2.0 / math.pi * math.atan(2.0 * math.pi * frequency / ALPHA.value)


def hardware_and_growth() -> list[Row]:
    """Return the rows of sections 4.1, 4.2, 4.5 and 6."""
    low, high = ESC_HZ
    nyquist = 0.5 * SAMPLING_HZ
    return [
        Row('Section 4.1', 'nominal voltage of 6S', 'V', BATTERY_V,
            3.7 * BATTERY_CELLS, '6 cells of 3.7 V', 'The arithmetic is right.'),
        Row('Section 4.2', 'Nyquist frequency at 1 MHz', 'kHz', Printed(f'> {1e-3 * high:g}'),
            1e-3 * nyquist, 'half of the sampling frequency',
            f'ESC lines at {1e-3 * low:g} to {1e-3 * high:g} kHz are resolved with '
            f'{int(nyquist / high)} harmonics; the OU itself has {percent(share_above(low))} '
            'of its variance there.'),
        *_capacitance(), *_growth()]


def _capacitance() -> list[Row]:
    one, two = (rc_rail(_R, k * _C, _S) for k in (1.0, 2.0))
    before, after = doubled(PowerNetwork())
    # With C doubled, the logarithm to base 2 of a quotient is its elasticity.
    alpha, var = (math.log2(b / a) for a, b in zip(one, two))
    net_alpha, net_var = (math.log2(after.alpha / before.alpha),
                          math.log2(after.var_inf / before.var_inf))
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


# Section of the formulas of switching.
WHERE = 'Section 3.3'
# Telegraph noise of +-SPEED, V/s, with RATE switches a second each way.
RATE, SPEED = 1000.0, 1.0
# Multiplicative noise dU = +-GROWTH U dt, 1/s; the limit's error is GROWTH^2 / (4 RATE^2).
GROWTH = 100.0
# Example coefficients, because the paper gives only alpha: damping and coupling, 1/s, and carrier,
# rad/s. The two states switch like an ESC at 24 kHz; each coefficient is 30 % above or below its
# mean.
DAMPING, COUPLING, CARRIER = 100.0, 40.0, 2.0 * math.pi * 10.0
_SWING = np.array([1.3, 0.7])


def telegraph() -> SwitchedSystem:
    """Return dU/dt = +-SPEED, switching at RATE each way."""
    return SwitchedSystem(Generator.telegraph(RATE, RATE), np.zeros((2, 1, 1)),
                          np.array([[SPEED], [-SPEED]]))


def three_states() -> SwitchedSystem:
    """Return a balanced additive system on a chain of three states that is not reversible."""
    chain = Generator(RATE * np.array([[-3.0, 2.5, 0.5], [0.2, -1.2, 1.0], [2.0, 0.3, -2.3]]))
    speeds = SPEED * np.array([2.0, -1.0, 0.5])
    return SwitchedSystem(chain, np.zeros((3, 1, 1)),
                          (speeds - chain.stationary @ speeds)[:, None])


def multiplicative() -> SwitchedSystem:
    """Return dU/dt = +-GROWTH U, switching at RATE each way."""
    return SwitchedSystem(Generator.telegraph(RATE, RATE),
                          np.array([[[GROWTH]], [[-GROWTH]]]))


def switching_rows(rng: np.random.Generator, paths: int = 20_000) -> list[Row]:
    chain = telegraph().generator
    found, _ = quad(lambda t: float(expm(chain.q * t)[0, 0] - chain.stationary[0]),
                    0.0, 40.0 / RATE, epsrel=1e-10)
    return [
        Row(WHERE, 'R0(0, 0) of a telegraph', 'ms', Printed(f'{1e3 * found:.6g}'),
            1e3 * float(chain.potential[0, 0]),
            'printed integral by quadrature, against (Pi - Q)^-1 - Pi',
            'The definition of the potential is right.'),
        *_intensity(rng, paths), *_drift(rng, paths)]


def _intensity(rng: np.random.Generator, paths: int) -> list[Row]:
    found = []
    for name, what, system in (
            ('telegraph', f'+-{SPEED:g} V/s, {RATE:g} 1/s each way', telegraph()),
            ('three states', 'a chain that is not reversible', three_states())):
        printed = float(switching_intensity(system, [0.0], PRINTED_FACTOR)[0, 0])
        # (Var U(T) - Var U(S)) / (T - S), unbiased if S is longer than the memory of the chain.
        t = np.array([0.0, 10.0, 110.0]) / float(system.generator.leaving.min())
        u = system.simulate(t, [0.0], rng, paths=paths)[:, :, 0]
        rate, error = mean_and_error((u[:, 2] ** 2 - u[:, 1] ** 2) / (t[2] - t[1]))
        found.append(Row(
            WHERE, f'B of (6), {name}', 'mV^2/s', Printed(f'{1e6 * printed:.4g}'), 1e6 * rate,
            f'long-run variance rate of the switching system ({what}), {paths} paths',
            f'The switching system spreads {rate / printed:.3f} +- {error / printed:.3f} times '
            'as fast as (6) says.', error=1e6 * error, point=1))
    return found


def _drift(rng: np.random.Generator, paths: int) -> list[Row]:
    system = multiplicative()
    drift = float(switching_drift(system).matrix[0, 0])
    span = 2.0 * RATE / GROWTH ** 2
    u = system.simulate(np.array([0.0, 0.5 * span, span]), [1.0], rng, paths=paths)[:, 1:, 0]
    # At this time the mean growth is large relative to its scatter.
    mean, error = mean_and_error(u[:, 0])
    rate, rate_se = 2.0 * math.log(mean) / span, 2.0 * error / mean / span
    # Contiguous: in NumPy 1.26 the last digit of a logarithm depends on the memory layout.
    log, log_se = mean_and_error(np.log(np.ascontiguousarray(u[:, 1])) / span)
    intensity = float(switching_intensity(system, [1.0], PRINTED_FACTOR)[0, 0])
    ito = drift - 0.5 * intensity
    # The limit omits a share GROWTH^2 / (4 RATE^2) of the drift.
    left = drift * (GROWTH / RATE) ** 2 / 4.0
    how = f'dU = +-{GROWTH:g} U dt, {RATE:g} 1/s each way, {paths} paths: growth'
    return [
        Row(WHERE, 'b/U of (5), multiplicative noise', '1/s', Printed(f'{drift:.6g}', 0.0), rate,
            f'{how} of the mean',
            f'The mean grows {rate / drift:.3f} +- {rate_se / drift:.3f} times as fast as (5) '
            'says: no factor is missing.', error=rate_se,
            inputs=(rate - left, rate + left), point=1),
        Row(WHERE, 'growth of ln U by (4) to (6)', '1/s', Printed(f'{ito:.6g}', 0.0),
            log, f'{how} of ln U',
            'ln U is driven by noise of mean zero and cannot grow; b - B/2U^2 vanishes only with '
            'the factor 2 in B.', error=log_se, point=1)]


def _late_over_early(path: FloatArray) -> FloatArray:
    log = np.log(path)
    return np.asarray((log[2] - log[1]) / (log[1] - log[0]))


def averaging_rows(rng: np.random.Generator, paths: int = 400) -> list[Row]:
    """Return the rows of sections 3.1 and 8."""
    tau = 1.0 / ALPHA.value
    # The matrix as printed, with the paper's alpha as gamma.
    printed = matrix_model(DAMPING, CARRIER, 0.0, ALPHA.value, printed=True)
    grown = float(printed.solve([0.0, tau], [1.0, 0.0, 1.0])[1, 2])
    half = 1.0 / CARRIER
    phase = printed.solve([0.0, half, 2.0 * half], [0.0, 1.0, 0.0])[:, 1]
    turned = float((phase[2] - phase[1]) / (phase[1] - phase[0]))
    # The matrix as the text intends it, with coefficients switched by an ESC.
    rate = 2.0 * ESC_HZ[0]
    system = SwitchedSystem.of_matrix_model(
        Generator.telegraph(rate, rate), alpha=DAMPING * _SWING, omega=CARRIER * _SWING,
        beta=COUPLING * _SWING, alpha_p=ALPHA.value * _SWING)
    t = np.array([0.0, 0.5 * tau, tau])
    u = system.simulate(t, [1.0, 0.0, 1.0], rng, paths=paths)
    amplitude, amplitude_se = _mean_decay_ratio(u[:, :, 0])
    power, power_se = _mean_decay_ratio(u[:, :, 2])
    limit = _late_over_early(system.averaged().solve(t, [1.0, 0.0, 1.0])[:, [0, 2]])
    advance = np.diff(u[:, :, 1].mean(axis=0))
    ratio = float(advance[1] / advance[0])
    how = f'{paths} paths of the matrix model switched at {1e-3 * ESC_HZ[0]:g} kHz'
    return [
        Row('Section 3.1', 'P(tau)/P(0), +gamma on the diagonal', '', Printed('< 1'), grown,
            'printed matrix, gamma = alpha as its note says',
            'The power grows by e in one tau; to relax, the entry must be -alpha.'),
        Row('Section 8', 'phase: late over early advance', '', Printed('1', 0.0), turned,
            'printed matrix over two spans of 1/omega',
            'The printed row is dphi/dt = omega phi, an exponential; with dphi/dt = omega the '
            f'switched model gives {ratio:.4f}: linear, as the paper says.'),
        Row('Section 8', 'amplitude: late over early decay', '', Printed('1', 0.0),
            amplitude, how, 'The mean amplitude decays as one exponential, as the paper says.',
            error=amplitude_se),
        Row('Section 8', 'power: late over early decay', '', Printed('1', 0.0), power,
            f'{how}, beta = {COUPLING:g} 1/s',
            f'Fed by the amplitude, the power is a sum of two exponentials (averaged model: '
            f'{limit[1]:.3f}); it is one exponential only if beta = 0.', error=power_se)]


def _mean_decay_ratio(paths: FloatArray) -> tuple[float, float]:
    """Return the late over early decay rate of the mean path, and its jackknife error."""
    count = len(paths)
    total = paths.sum(axis=0)
    value = float(_late_over_early(total[:, None] / count)[0])
    without = _late_over_early(((total - paths) / (count - 1)).T)
    error = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    return value, error
