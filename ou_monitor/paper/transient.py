"""
Fig. 5: the relaxation rate from its points, and whether rail or oscilloscope determines it.

An AC-coupled oscilloscope is a first-order high-pass: it shows a step of the rail as a decay at
2 pi times its corner, unless the rail is slower.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
import math

import numpy as np
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import ACCoupling
from ou_monitor.paper import published
from ou_monitor.paper.published import Printed, Range, Row
from ou_monitor.records import FloatArray
from ou_monitor.text import Z95
from scipy import stats
from scipy.optimize import brentq, curve_fit

WHERE = 'Fig. 5'
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


def rows(rng: np.random.Generator, draws: int = 60) -> list[Row]:
    """Return the rows of Fig. 5."""
    return [*_fit(), *_shape(), *_instrument(simulate_fitted(rng, draws))]


def _fit() -> list[Row]:
    line = PAPER_FIT
    return [
        Row(WHERE, 'alpha', '1/s', published.ALPHA, line.alpha,
            'least squares of ln|U| over 0..35 ms',
            f'The arithmetic is right; four points leave {line.alpha:.1f} +- '
            f'{line.half_width:.1f} 1/s (95 %, two degrees of freedom).',
            point=3),
        Row(WHERE, 'error implied by its digits', '1/s', Printed('0.05', 0.0),
            line.half_width, 'half of the 95 % interval of that fit',
            f'{published.ALPHA.text} has more digits than four points support: the interval is '
            f'{line.alpha - line.half_width:.0f} to {line.alpha + line.half_width:.0f} 1/s.',
            point=3),
        Row(WHERE, '|U(0)|', 'mV', published.FIG_5_MV[0], line.start, 'intercept of that fit',
            f'The line starts at {line.start:.0f} mV, within its error of the first point.',
            error=line.start_se)]


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
            WHERE, f'rate, {ends}', '1/s', published.ALPHA, rate, 'two neighbouring points',
            said + '.', band=(rate - reach, rate + reach), point=3))
    plain, shifted = decay_fits()
    test, p = offset_test()
    found.append(Row(
        WHERE, 'level that the decay settles at', 'mV', Printed('0', 0.0),
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
        Row(WHERE, f'alpha of a {CORNER_HZ:g} Hz corner', '1/s', published.ALPHA,
            CORNER, '2 pi times the corner; interval of the fit to Fig. 5',
            f'{published.ALPHA.text} 1/s is 2 pi times '
            f'{published.ALPHA.value / (2 * math.pi):.2f} Hz: the AC coupling of the '
            'oscilloscope alone gives this rate.',
            band=(CORNER - line.half_width, CORNER + line.half_width), point=2),
        Row(WHERE, f'alpha fitted, rail of {TYPICAL_RAIL:g} 1/s', '1/s',
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
