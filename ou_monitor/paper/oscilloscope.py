"""
What the oscilloscope showed: crest factors Vpp/Vrms, and the decay of Fig. 5.

Crest factors: paths of an OU are drawn with the exact transition over steps of a hundred samples.
Extremes within a step are drawn from a Brownian bridge; their relative error is alpha dt = 0.006.
The crest factor does not depend on sigma.  For section 5, "diffusion and jump components", jumps
that relax at the rate alpha are simulated.

Fig. 5: an AC-coupled oscilloscope is a first-order high-pass: it shows a step of the rail as a
decay at 2 pi times its corner, unless the rail is slower.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import math

import numpy as np
from ou_monitor.model.ou import simulate, transition
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.shocks import Jumps
from ou_monitor.model.terms.slow import ACCoupling
from ou_monitor.paper import published
from ou_monitor.paper.published import mean_and_error, over, Printed, Range, Row
from ou_monitor.records import FloatArray
from ou_monitor.text import Z95
from scipy import stats
from scipy.optimize import brentq, curve_fit
from scipy.signal import lfilter

# Screen lengths tried, ms; the paper gives none.
SCREENS_MS = (10, 100, 500)
TYPICAL_MS = 100  # Length for the statements and the plot, ms
# Share of screens below, and above, the band of crest factors.
TAIL = 0.05
# Oscilloscope samples per step of the simulation; segments in memory at once; number of screens of
# white noise.
_SAMPLES, _AT_ONCE, _WHITE = 100, 100, 200


@dataclass(frozen=True, eq=False)
class Crests:
    """Crest factors of simulated screens."""

    # Vpp/Vrms of every screen, by its length in ms; rows are independent; shape (paths, k).
    by_screen: dict[int, FloatArray]
    white: FloatArray  # Of white Gaussian noise, on a screen of 100 ms; shape (k,)

    def mean(self, screen: int) -> tuple[float, float]:
        """Return mean and standard error on screens of this length, ms."""
        return mean_and_error(self.by_screen[screen].mean(axis=1))

    def quantile(self, screen: int, share: float) -> float:
        """Return a quantile over screens of this length, ms."""
        return float(np.quantile(self.by_screen[screen], share))

    @property
    def band(self) -> Range:
        """5 % quantile of the shortest to 95 % quantile of the longest screens."""
        return (self.quantile(min(self.by_screen), TAIL),
                self.quantile(max(self.by_screen), 1.0 - TAIL))


def crest_of(screens: FloatArray) -> FloatArray:
    """Return Vpp over the rms about the mean of each row."""
    return np.asarray(np.ptp(screens, axis=-1) / screens.std(axis=-1))


def simulate_crests(rng: np.random.Generator, paths: int) -> Crests:
    """Draw screens of an OU with the paper's alpha, sampled at 1 MHz."""
    drawn = [_draw(rng, min(_AT_ONCE, paths - begin)) for begin in range(0, paths, _AT_ONCE)]
    points = round(1e-3 * TYPICAL_MS * published.SAMPLING_HZ)
    white = [float(crest_of(rng.standard_normal(points))) for _ in range(_WHITE)]
    return Crests({ms: np.concatenate([part[ms] for part in drawn]) for ms in SCREENS_MS},
                  np.array(white))


def _draw(rng: np.random.Generator, paths: int) -> dict[int, FloatArray]:
    """Return the crest factors of all screens of `paths` simulated segments."""
    dt = _SAMPLES / published.SAMPLING_HZ
    # For a stationary variance of 1.
    sigma = math.sqrt(2.0 * published.ALPHA.value)
    phi, q = (float(v) for v in transition(published.ALPHA.value, sigma, dt))
    noise = rng.standard_normal((paths, 1 + round(1e-3 * max(SCREENS_MS) / dt)))
    noise[:, 1:] *= math.sqrt(q)
    path = lfilter([1.0], [1.0, -phi], noise, axis=1)
    left, right = path[:, :-1], path[:, 1:]
    # Extremes of a bridge from a to b with variance s^2 dt:
    # (a + b +- sqrt((b - a)^2 - 2 s^2 dt ln U)) / 2, U uniform.
    middle, square = left + right, (right - left) ** 2
    top, bottom = (middle + sign * np.sqrt(
        square + 2.0 * q * rng.standard_exponential(square.shape)) for sign in (1.0, -1.0))
    # Sampled at 1 MHz, extremes are smaller by 0.5826 sigma sqrt(1 us) on each side (Broadie,
    # Glasserman & Kou, Math. Finance 7 (1997) 325).
    unseen = 2.0 * 0.5826 * sigma / math.sqrt(published.SAMPLING_HZ)
    found = {}
    for ms in SCREENS_MS:
        shape = (paths, -1, round(1e-3 * ms / dt))
        vpp = 0.5 * (top.reshape(shape).max(axis=2) - bottom.reshape(shape).min(axis=2)) - unseen
        found[ms] = vpp / left.reshape(shape).std(axis=2)
    return found


def crest_rows(crests: Crests) -> list[Row]:
    """Return one row for each load state with a Vrms."""
    mean, error = crests.mean(TYPICAL_MS)
    count = crests.by_screen[TYPICAL_MS].shape[0]
    found = []
    for state in published.LOADED:
        value, inputs = state.crest, state.crest_range
        # At this length, half of the screens exceed crest/2 standard deviations on one side.
        screen = math.log(2.0) / published.ALPHA.value * mean_first_passage(0.0, 0.5 * inputs[0])
        beyond = ('' if inputs[0] <= crests.band[1] else
                  f'; even {inputs[0]:.1f} would need a screen of {screen:.2g} s')
        found.append(Row(
            'Table 1', f'Vpp/Vrms, {state.label}', '', Printed(f'{value:.1f}'), mean,
            f'OU with tau {published.TAU_MS.text} ms sampled at 1 MHz, {count} segments of '
            f'{max(SCREENS_MS)} ms',
            f'One OU shows {mean:.1f} on a {TYPICAL_MS} ms screen and lies within '
            f'{crests.band[0]:.1f} to {crests.band[1]:.1f} on screens of {min(SCREENS_MS)} to '
            f'{max(SCREENS_MS)} ms; the resolution of Vpp and Vrms allows {inputs[0]:.1f} to '
            f'{inputs[1]:.1f}{beyond}.',
            error=error, band=crests.band, printed_inputs=inputs, point=5))
    return found


# Jumps per second, and shares of the variance, that are tried.
RATES = (2.0, 5.0, 10.0, 20.0, 50.0)
SHARES = (0.25, 0.5, 0.75, 0.95)
JUMP_SCREENS_MS = (100, 500)
# Sampling rate with jumps, Hz; compared with 1 MHz it lowers a crest factor by less than 0.1.
_SAMPLING = 20e3


@dataclass(frozen=True)
class JumpCrest:
    """Crest factors of an OU with jumps that relax at its alpha."""

    screen: int  # Length, ms
    rate: float  # Jumps per second
    share: float  # Their share of the variance
    # Mean Vpp/Vrms and its standard error.
    mean: float
    error: float
    band: Range  # 5 % and 95 % of the screens

    def size(self, vrms: float) -> float:
        """Return the standard deviation of the jumps, in the unit of `vrms`."""
        return vrms * math.sqrt(2.0 * published.ALPHA.value * self.share / self.rate)


def simulate_jumps(rng: np.random.Generator, seconds: float) -> list[JumpCrest]:
    """Draw screens of OUs with jumps (seconds in s)."""
    alpha = published.ALPHA.value
    longest = max(JUMP_SCREENS_MS)
    # One more screen, dropped later, lets the jumps become stationary.
    t = np.arange(round((seconds + 1e-3 * longest) * _SAMPLING)) / _SAMPLING
    begin = round(1e-3 * longest * _SAMPLING)
    found = []
    for rate in RATES:
        plain = simulate(t, alpha, math.sqrt(2.0 * alpha), rng)[begin:]
        jumping = SupplyModel((
            OU(alpha, 0.0, 0.0), Jumps(rate, 0.0, math.sqrt(2.0 * alpha / rate)))
        ).simulate(t, rng)[begin:]
        for share in SHARES:
            path = math.sqrt(1.0 - share) * plain + math.sqrt(share) * jumping
            for ms in JUMP_SCREENS_MS:
                values = crest_of(path.reshape(-1, round(1e-3 * ms * _SAMPLING)))
                low, high = np.quantile(values, [TAIL, 1.0 - TAIL])
                # Screens are many tau long, so neighbours are almost independent.
                found.append(JumpCrest(
                    ms, rate, share, *mean_and_error(values), (float(low), float(high))))
    return found


def jump_rows(found: list[JumpCrest], crests: Crests) -> list[Row]:
    """Return the rows of section 5 on jumps."""
    low, high = published.LOW.crest, published.HIGH.crest
    inputs = over(published.HIGH.crest_range, published.LOW.crest_range)
    result = [Row(
        'Section 5', 'Vpp/Vrms, 40 % over 5 %', '', Printed('> 1'), high / low,
        'quotient from Table 1',
        '"From Gaussian noise to impulse disturbances with load" would raise Vpp/Vrms, but it '
        f'falls from {low:.1f} to {high:.1f}; the resolution of the readings allows a quotient of '
        f'{inputs[0]:.2f} to {inputs[1]:.2f}.', inputs=inputs, point=8)]
    for state in (published.LOW, published.MEDIUM):
        value, inputs = state.crest, state.crest_range
        # Impulses of this height, mV, would raise the OU to the printed Vpp.
        height = state.vpp.value - crests.mean(TYPICAL_MS)[0] * state.vrms.value
        for ms in JUMP_SCREENS_MS:
            best = max((c for c in found if c.screen == ms), key=lambda c: c.mean)
            result.append(Row(
                'Section 5', f'Vpp/Vrms, {state.label}, jumps, {ms} ms screen', '',
                Printed(f'{value:.1f}'), best.mean,
                f'OU with compound Poisson jumps that relax at alpha, best of '
                f'{len(RATES) * len(SHARES)} rates and shares, Monte Carlo',
                f'Largest mean: {best.mean:.1f} ({best.band[0]:.1f} to {best.band[1]:.1f}), '
                f'with {best.rate:g} jumps a second of {best.size(state.vrms.value):.0f} mV rms, '
                f'{100 * best.share:.0f} % of the variance; impulses too short to count in Vrms '
                f"would have to add {height:.0f} mV to the OU's Vpp.",
                error=best.error, band=best.band, printed_inputs=inputs, point=8))
    return result


# Corner of the AC coupling of many hand-held oscilloscopes, Hz.
CORNER_HZ = 10.0
CORNER = 2.0 * math.pi * CORNER_HZ
# Relaxation rates of the rails that are simulated behind the coupling, 1/s. For comparison: 470 uF
# with 30 mOhm ESR behind a battery of 40 mOhm relaxes at 3e4 1/s.
RAILS = (500.0, 1000.0, 2000.0, 5000.0)
TYPICAL_RAIL = 1000.0
# A simulated release: sampling rate, Hz, time under load and time recorded after it, s.
_RATE, _HOLD, _WATCH = 10e3, 0.3, 0.06

TIME = 1e-3 * np.array(published.FIG_5_MS)
VALUE = np.array([p.value for p in published.FIG_5_MV])
# Points that the paper fits.
USED = slice(0, published.FIG_5_USED)


@dataclass(frozen=True, eq=False)
class LogLine:
    """ln|U| against time by least squares, as the paper fits it."""

    # Rate and standard error, 1/s.
    alpha: float
    alpha_se: float
    # |U(0)| and standard error, in the unit of the points.
    start: float
    start_se: float
    scatter: float  # Standard deviation of ln|U| about the line
    quantile: float  # Student's t of the 95 % interval for its degrees of freedom

    @property
    def half_width(self) -> float:
        """Half of the 95 % interval of alpha, 1/s."""
        return self.quantile * self.alpha_se


def fit_log_line(time: FloatArray, value: FloatArray) -> LogLine:
    """Fit an exponential as the paper does (time in s)."""
    y = np.log(np.abs(value))
    line = stats.linregress(time, y)
    scatter = math.sqrt(float(np.sum((y - line.intercept - line.slope * time) ** 2))
                        / (time.size - 2))
    start = math.exp(line.intercept)
    return LogLine(-float(line.slope), float(line.stderr), start,
                   start * float(line.intercept_stderr), scatter,
                   float(stats.t.ppf(0.975, time.size - 2)))


def decay(time: FloatArray, start: float, alpha: float, offset: float = 0.0) -> FloatArray:
    """Return an exponential with the rate alpha, 1/s, and an offset."""
    return np.asarray(start * np.exp(-alpha * time) + offset)


# The paper's own fit: ln|U| over 0..35 ms.
PAPER_FIT = fit_log_line(TIME[USED], VALUE[USED])


@dataclass(frozen=True, eq=False)
class DecayFit:
    """start exp(-alpha t) + offset by least squares of the five voltages."""

    parameters: FloatArray  # start, alpha, 1/s, and the offset if there is one; shape (2,) or (3,)
    errors: FloatArray  # Standard errors; shape (2,) or (3,)
    rss: float  # Residual sum of squares

    def __call__(self, time: FloatArray) -> FloatArray:
        """Return the curve at times, s."""
        return decay(time, *self.parameters)

    def band(self, k: int) -> Range:
        """Return the 95 % interval of a parameter."""
        free = TIME.size - self.parameters.size
        reach = float(stats.t.ppf(0.975, free)) * float(self.errors[k])
        return float(self.parameters[k]) - reach, float(self.parameters[k]) + reach


@cache
def decay_fits() -> tuple[DecayFit, DecayFit]:
    """Return the fits without and with an offset."""
    line, fits = fit_log_line(TIME, VALUE), []
    start, alpha = line.start, line.alpha
    for k, first in ((2, [start, alpha]), (3, [start, alpha, 0.0])):
        found, covariance = curve_fit(
            decay, TIME, VALUE, first, method='trf', x_scale=[start, alpha, 0.1 * start][:k],
            xtol=1e-12, ftol=1e-12, gtol=1e-12)
        fits.append(DecayFit(found, np.sqrt(np.diag(covariance)),
                             float(np.sum((decay(TIME, *found) - VALUE) ** 2))))
    return fits[0], fits[1]


def offset_test() -> tuple[float, float]:
    """Return F and its p-value for the offset of the fits to the five points."""
    plain, shifted = decay_fits()
    free = VALUE.size - 3
    test = (plain.rss - shifted.rss) / (shifted.rss / free)
    return test, float(stats.f.sf(test, 1, free))


def through_coupling(time: FloatArray, rail: float) -> FloatArray:
    """Return a rail's step response behind the high-pass (rail: rate, 1/s; time in s)."""
    return np.asarray(rail / (rail - CORNER) * (np.exp(-CORNER * time) - np.exp(-rail * time)))


def peak_of(rail: float) -> float:
    """Return the time of the peak of `through_coupling`, s."""
    return math.log(rail / CORNER) / (rail - CORNER)


def fitted_through_coupling(time: FloatArray) -> tuple[FloatArray, float]:
    """Return the typical rail behind the coupling, mV, and its largest relative misfit."""
    # Scaled to the points that the paper fits; time, s, counts from the peak of the curve.
    peak = peak_of(TYPICAL_RAIL)
    misfit = np.log(VALUE[USED] / through_coupling(peak + TIME[USED], TYPICAL_RAIL))
    scale = math.exp(float(misfit.mean()))
    return (scale * through_coupling(peak + time, TYPICAL_RAIL),
            float(np.abs(np.expm1(misfit - misfit.mean())).max()))


def fitted_rate(rail: float) -> float:
    """Return the rate, 1/s, that the paper's fit gives for a rail behind the high-pass."""
    used = TIME[USED]
    return fit_log_line(used, through_coupling(peak_of(rail) + used, rail)).alpha


def slowest_rail() -> float:
    """Return the lowest rate, 1/s, at which a rail behind a 10 Hz coupling agrees with Fig. 5."""
    least = PAPER_FIT.alpha - PAPER_FIT.half_width
    return float(brentq(lambda rail: fitted_rate(rail) - least, 70.0, 1e5))


def simulate_fitted(rng: np.random.Generator, draws: int) -> FloatArray:
    """Return the rates, 1/s, that the paper's fit gives for load releases behind the coupling."""
    # One row per rail. Each is an OU whose noise is half a step of the oscilloscope (the most that
    # is read as "~0"); points are taken 0, 10, 25 and 35 ms after the peak of the noiseless trace.
    t = np.arange(round((_HOLD + _WATCH) * _RATE)) / _RATE
    throttle = np.where(t <= _HOLD, published.TRANSIENT_LOAD, 0.0)
    sag = 1e-3 * VALUE[0]
    noise = 0.5e-3 * published.VRMS_STEP.size
    used = TIME[USED]
    found = np.empty((len(RAILS), draws))
    for row, rail in zip(found, RAILS):
        model = SupplyModel((
            OU(rail, noise * math.sqrt(2.0 * rail), 0.0),
            LoadSag(sag / published.TRANSIENT_LOAD, 0.0),
            LoadTransient(sag / published.TRANSIENT_LOAD, 1.0 / rail, 0.0),
            ACCoupling(CORNER_HZ, 0.0)))
        at = np.round((_HOLD + peak_of(rail) + used) * _RATE).astype(np.intp)
        for k in range(draws):
            row[k] = fit_log_line(used, model.simulate(t, rng, throttle)[at]).alpha
    return found


def decay_rows(rng: np.random.Generator, draws: int = 60) -> list[Row]:
    line = PAPER_FIT
    return [
        Row('Fig. 5', 'alpha', '1/s', published.ALPHA, line.alpha,
            'least squares of ln|U| over 0..35 ms',
            f'The arithmetic is right; four points leave {line.alpha:.1f} +- '
            f'{line.half_width:.1f} 1/s (95 %, two degrees of freedom).',
            point=3),
        Row('Fig. 5', 'error implied by its digits', '1/s', Printed('0.05', 0.0),
            line.half_width, 'half of the 95 % interval of that fit',
            f'{published.ALPHA.text} has more digits than four points support: the interval is '
            f'{line.alpha - line.half_width:.0f} to {line.alpha + line.half_width:.0f} 1/s.',
            point=3),
        Row('Fig. 5', '|U(0)|', 'mV', published.FIG_5_MV[0], line.start, 'intercept of that fit',
            f'The line starts at {line.start:.0f} mV, within its error of the first point.',
            error=line.start_se),
        *_shape(), *_instrument(simulate_fitted(rng, draws))]


def _shape() -> list[Row]:
    line = PAPER_FIT
    found = []
    for k, rate in enumerate((-np.diff(np.log(VALUE)) / np.diff(TIME)).tolist()):
        step = float(TIME[k + 1] - TIME[k])
        reach = line.quantile * line.scatter * math.sqrt(2.0) / step
        ends = f'{published.FIG_5_MS[k]:g}..{published.FIG_5_MS[k + 1]:g} ms'
        said = (f'One exponential has the same rate everywhere; here it is {rate:.1f} +- '
                f'{reach:.0f} 1/s (95 %) if every point scatters as the first four do')
        if k >= published.FIG_5_USED - 1:
            said += '; the paper leaves the last point out as noise'
        found.append(Row(
            'Fig. 5', f'rate, {ends}', '1/s', published.ALPHA, rate, 'two neighbouring points',
            said + '.', band=(rate - reach, rate + reach), point=3))
    plain, shifted = decay_fits()
    test, p = offset_test()
    found.append(Row(
        'Fig. 5', 'level that the decay settles at', 'mV', Printed('0', 0.0),
        float(shifted.parameters[2]),
        'exponential plus a constant, least squares of all five voltages',
        f'It fits {plain.rss / shifted.rss:.1f} times better in residual sum of squares (alpha '
        f'{shifted.parameters[1]:.1f} 1/s); with five points that is F(1, 2) = {test:.1f}, '
        f'p = {p:.2f}.', error=float(shifted.errors[2]), band=shifted.band(2), point=3))
    return found


def _instrument(fitted: FloatArray) -> list[Row]:
    line = PAPER_FIT
    typical = fitted[RAILS.index(TYPICAL_RAIL)]
    mean, spread = float(typical.mean()), float(typical.std(ddof=1))
    # Elasticity: slope of ln(fitted) over ln(rail), one value per draw.
    log = np.log(RAILS) - np.mean(np.log(RAILS))
    slopes = log @ np.log(fitted) / float(log @ log)
    slope, slope_se = float(slopes.mean()), float(slopes.std(ddof=1) / math.sqrt(slopes.size))
    return [
        Row('Fig. 5', f'alpha of a {CORNER_HZ:g} Hz corner', '1/s', published.ALPHA,
            CORNER, '2 pi times the corner; interval of the fit to Fig. 5',
            f'{published.ALPHA.text} 1/s is 2 pi times '
            f'{published.ALPHA.value / (2 * math.pi):.2f} Hz: the AC coupling of the '
            'oscilloscope alone gives this rate.',
            band=(CORNER - line.half_width, CORNER + line.half_width), point=2),
        Row('Fig. 5', f'alpha fitted, rail of {TYPICAL_RAIL:g} 1/s', '1/s',
            published.ALPHA, mean,
            f"{typical.size} simulations behind that corner, fitted the paper's way",
            f'A rail {TYPICAL_RAIL / published.ALPHA.value:.0f} times faster is read as '
            f'{mean:.1f} +- {spread:.1f} 1/s.',
            error=spread / math.sqrt(typical.size),
            band=(mean - Z95 * spread, mean + Z95 * spread), point=2),
        Row('Section 5', 'd ln(alpha fitted) / d ln(alpha rail)', '', Printed('1', 0.0), slope,
            f'{fitted.size} simulated recordings, rails of {RAILS[0]:g} to {RAILS[-1]:g} 1/s, '
            f'{CORNER_HZ:g} Hz coupling',
            'The paper calls alpha a structural constant of the power network; behind an AC '
            f'coupling it changes by {100.0 * slope:.1f} % of the change in the network.',
            error=slope_se, point=2)]
