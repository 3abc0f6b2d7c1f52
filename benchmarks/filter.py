r"""
The adaptive low-pass against the best fixed cutoff and the truth; its control loop (15 min).

    python benchmarks/filter.py error --page doc/results/filter.md
    python benchmarks/filter.py dterm --page doc/results/filter.md \
        --figure doc/results/filter_dterm.svg
    python benchmarks/filter.py loop --page doc/results/filter.md

sigma follows throttle, which moves in steps and ramps.  Each signal has a linear model, so a
Kalman filter that knows sigma at every sample gives the best linear estimate; it uses no code of
the package.  *In hindsight*: of 41 cutoffs (or 21 curves), the one with the least mean square
error in that flight.  `sweep` runs many cutoffs at once; a test compares it with the package.  The
first 3 s of a flight, in which the estimator fills its window, are not scored.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
import math
from pathlib import Path
import sys
from typing import Any

from common import arguments, deliver, drawing, number, say, table, throttles
import control_loop
import numpy as np
from ou_monitor import AdaptiveLowPass, SlidingEstimator
from ou_monitor.report.svg import Plot
from scipy.linalg import expm

SEED = 20261121
RATE = 1000.0
# Standard deviation of the supply at half throttle, V, and of the body rate, rad/s.
SPREAD, BODY = 0.05, 1.0
# Noise of a gyro, rad/s.
GYRO = 0.01
# Supply noise in the gyro, rad/s per V: at half throttle as large as the body rate.
COUPLING = 20.0
_DWELL, _RAMP = (2.0, 6.0), (0.5, 1.5)


@dataclass(frozen=True)
class Case:
    """One kind of signal to be filtered."""

    name: str  # For the table.
    # A body rate with one pole ('ou') or two (Butterworth, 'smooth').
    kind: str
    alpha: float  # Of the supply, 1/s.
    bandwidth: float  # Of the body rate, Hz.
    order: int  # Order of the compared filters.
    limits: tuple[float, float]  # fmin and fmax for all of them, Hz.
    coupling: float = COUPLING  # Supply noise in the gyro, rad/s per V.


CASES = (
    Case('Body rate of one pole at 5 Hz, alpha 600', 'ou', 600.0, 5.0, 2, (1.0, 300.0)),
    Case('Body rate of two poles at 5 Hz, alpha 600', 'smooth', 600.0, 5.0, 2, (1.0, 300.0)),
    Case('Body rate of one pole at 5 Hz, alpha 63', 'ou', 63.0, 5.0, 2, (1.0, 300.0)),
)


@dataclass(frozen=True, eq=False)
class Flights:
    """Flights of one case, shape (flights, n) each."""

    t: np.ndarray  # s.
    # 0..1; V/sqrt(s).
    throttle: np.ndarray
    sigma: np.ndarray
    voltage: np.ndarray  # Input of the estimator, V.
    # The signal and its derivative (NaN for one pole), in its unit and unit/s.
    truth: np.ndarray
    slope: np.ndarray
    # The signal with all noise, and only the noise.
    measured: np.ndarray
    noise: np.ndarray


def _motion(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition over a sample, its noise and the stationary covariance."""
    if case.kind != 'smooth':
        phi = math.exp(-2.0 * math.pi * case.bandwidth / RATE)
        power = BODY**2
        return (np.array([[phi]]), np.array([[power * (1.0 - phi * phi)]]),
                np.array([[power]]))
    w = 2.0 * math.pi * case.bandwidth
    a = np.array([[0.0, 1.0], [-w * w, -math.sqrt(2.0) * w]])
    still = np.diag([BODY**2, (w * BODY)**2])
    phi = expm(a / RATE)
    return phi, still - phi @ still @ phi.T, still


def fly(case: Case, rng: np.random.Generator, flights: int, seconds: float) -> Flights:
    """Simulate."""
    n = int(seconds * RATE)
    throttle = throttles(rng, flights, n, RATE, _DWELL, (0.1, 0.9), _RAMP)
    # In recorded flights noise grows 3 to 13 times from low to high throttle.
    growth = np.exp(rng.uniform(math.log(3.0), math.log(13.0), (flights, 1)))
    power = np.log(growth) / math.log(9.0)
    sigma = SPREAD * math.sqrt(2.0 * case.alpha) * (throttle / 0.5)**power
    decay = math.exp(-case.alpha / RATE)
    supply = np.empty((flights, n))
    kick = math.sqrt((1.0 - decay**2) / (2.0 * case.alpha)) * sigma
    kick *= rng.standard_normal((flights, n))
    u = sigma[:, 0] / math.sqrt(2.0 * case.alpha) * rng.standard_normal(flights)
    for k in range(n):
        u = decay * u + kick[:, k]
        supply[:, k] = u
    white = GYRO * rng.standard_normal((flights, n))
    t = np.arange(n) / RATE
    phi, driven, still = _motion(case)
    size = phi.shape[0]
    state = np.linalg.cholesky(still) @ rng.standard_normal((size, flights))
    root = np.linalg.cholesky(driven)
    body = np.empty((size, flights, n))
    for k in range(n):
        state = phi @ state + root @ rng.standard_normal((size, flights))
        body[:, :, k] = state
    slope = body[1] if size == 2 else np.full((flights, n), np.nan)
    noise = case.coupling * supply + white
    voltage = 5.0 + supply + 0.002 * rng.standard_normal((flights, n))
    return Flights(t, throttle, sigma, voltage, body[0], slope, body[0] + noise, noise)


def kalman(case: Case, flights: Flights) -> tuple[np.ndarray, np.ndarray]:
    """Return the estimates of signal and slope (NaN for one pole) with known sigma."""
    count, n = flights.measured.shape
    phi, driven, still = _motion(case)
    decay = math.exp(-case.alpha / RATE)
    grown = flights.sigma**2 * (1.0 - decay**2) / (2.0 * case.alpha)
    size = phi.shape[0] + 1
    wide = np.zeros((size, size))
    wide[:-1, :-1], wide[-1, -1] = phi, decay
    phi, look = wide, np.zeros(size)
    look[0], look[-1] = 1.0, case.coupling
    noise = np.zeros((count, size, size))
    noise[:, :-1, :-1] = driven
    p = np.zeros((count, size, size))
    p[:, :still.shape[0], :still.shape[0]] = still
    p[:, -1, -1] = flights.sigma[:, 0]**2 / (2.0 * case.alpha)
    x = np.zeros((count, size))
    out = np.full((2, count, n), np.nan)
    for k in range(n):
        if k:
            x = x @ phi.T
            noise[:, -1, -1] = grown[:, k]
            p = phi @ p @ phi.T + noise
        gain = p @ look
        gain /= (gain @ look + GYRO**2)[:, None]
        x = x + gain * (flights.measured[:, k] - x @ look)[:, None]
        p = p - gain[:, :, None] * (look @ p)[:, None, :]
        out[0, :, k] = x[:, 0]
        if case.kind == 'smooth':
            out[1, :, k] = x[:, 1]
    return out[0], out[1]


# Seconds between estimates, and seconds at the start that are not scored.
EVERY, SETTLE = 0.05, 3.0
_ROOT2 = math.sqrt(2.0)


def estimates(flights: Flights, window: float) -> np.ndarray:
    """Return sigma, its error and alpha at each sample, shape (3, flights, n)."""
    count, n = flights.voltage.shape
    block = int(EVERY * RATE)
    out = np.full((3, count, n), np.nan)
    for f in range(count):
        estimator = SlidingEstimator(window=window)
        for at in range(0, n, block):
            piece = slice(at, at + block)
            estimator.push(flights.t[piece], flights.voltage[f, piece],
                           flights.throttle[f, piece])
            e = estimator.estimate()
            if e.usable:
                # Known from the next sample on.
                out[:, f, at + block:at + 2 * block] = np.array(
                    [e.sigma, e.sigma_se, e.alpha])[:, None]
    return out


def adaptive(options: Mapping[str, Any], flights: Flights, seen: np.ndarray,
             x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return output and cutoff of the package's filter, shape (flights, n) each."""
    out, cutoff = np.empty(x.shape), np.empty(x.shape)
    for f in range(x.shape[0]):
        one = AdaptiveLowPass(**options)
        sigma, error, alpha = (s[f].tolist() for s in seen)
        rows = zip(flights.t.tolist(), x[f].tolist(), sigma, error, alpha)
        for k, row in enumerate(rows):
            out[f, k] = one.step(*row)
            cutoff[f, k] = one.cutoff
    return out, cutoff


def sweep(x: np.ndarray, cutoff: np.ndarray, order: int, derivative: bool = False,
          ) -> np.ndarray:
    """Filter with given cutoffs, exactly for an input that is linear between samples."""
    count, n = x.shape
    shape = (cutoff.shape[0], count)
    out = np.empty((*shape, n))
    y = np.zeros(shape) if derivative else np.broadcast_to(x[:, 0], shape).copy()
    slope = np.zeros(shape)
    out[:, :, 0] = y
    fixed = cutoff.shape[2] == 1
    parts = _parts(cutoff[:, :, 0], order) if fixed else ()
    for k in range(1, n):
        if not fixed:
            parts = _parts(cutoff[:, :, k], order)
        a, b, c, d, e, g = parts
        if derivative:
            now = (x[:, k] - x[:, k - 1]) * RATE
            off, rise = y - now, 0.0
        else:
            now = x[:, k]
            off, rise = y - x[:, k - 1], x[:, k] - x[:, k - 1]
        y = now + a * off + b * slope + c * rise
        slope = d * slope + e * off + g * rise
        out[:, :, k] = y
    return out


def _parts(cutoff: np.ndarray, order: int) -> tuple[np.ndarray, ...]:
    """Return the coefficients of a step."""
    angle = 2.0 * math.pi * np.minimum(cutoff, 0.45 * RATE) / RATE
    zero = np.zeros_like(angle)
    if order == 1:
        lost = np.expm1(-angle)
        return 1.0 + lost, zero, lost / angle, zero, zero, zero
    p = angle / _ROOT2
    s, c = np.exp(-p) * np.sin(p), np.exp(-p) * np.cos(p)
    return (c + s, _ROOT2 * s, (c - 1.0) / p, c - s, -_ROOT2 * s, -(c - 1.0 + s) / angle)


def square_error(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Return the mean square error of each flight after `SETTLE`."""
    first = int(SETTLE * RATE)
    found: np.ndarray = np.mean((estimate[..., first:] - truth[..., first:])**2, axis=-1)
    return found


def lag_ms(output: np.ndarray, truth: np.ndarray) -> float:
    """Return the delay of the output relative to the truth from their cross-correlation, ms."""
    first = int(SETTLE * RATE)
    lags = []
    for y, s in zip(output[:, first:], truth[:, first:]):
        size = 1 << (2 * y.size - 1).bit_length()
        both = np.fft.irfft(np.fft.rfft(y - y.mean(), size)
                            * np.conj(np.fft.rfft(s - s.mean(), size)), size)
        around = np.concatenate((both[-300:], both[:300]))
        k = int(np.argmax(around[1:-1])) + 1
        a, b, c = around[k - 1:k + 2]
        lags.append(k - 300 + 0.5 * (a - c) / (a - 2.0 * b + c))
    return float(np.mean(lags)) * 1e3 / RATE


def laws(case: Case) -> dict[str, dict[str, Any]]:
    """Return the options of each law, as a user who knows the case would set them."""
    fmin, fmax = case.limits
    base = {'order': case.order, 'fmin': fmin, 'fmax': fmax, 'alpha': case.alpha,
            'n0': GYRO**2 / RATE, 'coupling': case.coupling}
    return {'kalman': {**base, 'law': 'kalman'},
            'constant_noise': {**base, 'law': 'constant_noise', 'noise_wanted': 0.2 * BODY}}


def mistaken(case: Case) -> dict[str, dict[str, Any]]:
    """Return the options of `kalman` with one parameter wrong by a factor of 2."""
    right = laws(case)['kalman']
    # The gyro's own noise is negligible against the supply's.
    return {f'kalman, coupling {word} the true one': {**right, 'coupling': factor * case.coupling}
            for factor, word in ((0.5, 'half'), (2.0, 'twice'))}


def curve(throttle: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Return Betaflight's curve from `low` to twice that, expo 5, shape (candidates, ...)."""
    share = throttle + 0.5 * throttle * (1.0 - throttle)
    found: np.ndarray = low[:, None, None] * (1.0 + share[None])
    return found


TRUTH = 'Kalman filter that knows sigma'
FIXED = 'best fixed cutoff in hindsight'
CURVE = "Betaflight's curve, f..2 f, best f in hindsight"
CASE = Case('D term of a body rate of two poles at 5 Hz, alpha 600', 'smooth', 600.0, 5.0, 2,
            (20.0, 150.0), coupling=2.0)
FIXED_CUTOFF, CURVE_CUTOFF, SWITCH = 'fixed', "Betaflight's curve, f..2 f", 'threshold, f/2..f'
CONSTANT, KALMAN = 'constant_noise', 'kalman'
# Cutoffs, Hz, and wanted noise, rad/s^2.
_CUTOFFS, _BASES = np.geomspace(15.0, 200.0, 28), (15.0, 25.0, 40.0, 60.0, 75.0, 90.0)
_LAGS = (0.0, 30.0, 20.0, 12.0)
_TOPS, _WANTED = (40.0, 70.0, 110.0, 150.0), (4.0, 7.0, 12.0, 20.0, 30.0)


@dataclass(frozen=True)
class Point:
    """One setting of one method."""

    method: str
    setting: str
    noise: float  # Rms of the output noise, rad/s^2.
    loud: float  # Rms of the loudest second in twenty, rad/s^2.
    lag: float  # Delay of the signal, ms.
    rms_error: float  # Of the output against the true derivative, rad/s^2.
    cutoff: str = '-'  # 5 % and 95 % quantile, Hz.


def run_dterm(flights: int, seconds: float, seed: int, window: float) -> list[Point]:
    """Return the points of all methods."""
    flown = fly(CASE, np.random.default_rng([seed, 100]), flights, seconds)
    seen = estimates(flown, window)
    points = []
    say(FIXED_CUTOFF)
    for name, cutoffs, settings in (
            (FIXED_CUTOFF, _CUTOFFS[:, None, None], [f'{f:.0f} Hz' for f in _CUTOFFS]),
            (CURVE_CUTOFF, curve(flown.throttle, np.array(_BASES)),
             [f'{f:g}..{2 * f:g} Hz' for f in _BASES])):
        noises = sweep(flown.noise, cutoffs, 2, True)
        signals = sweep(flown.truth, cutoffs, 2, True)
        for k, setting in enumerate(settings):
            points.append(point(name, setting, flown, noises[k], signals[k], cutoffs[k]))
        del noises, signals
    middle = SPREAD * math.sqrt(2.0 * CASE.alpha)
    base = {'mode': 'derivative', 'order': 2, 'alpha': CASE.alpha}
    runs = [(SWITCH, f'{0.5 * f:g}..{f:g} Hz', {
        **base, 'law': 'threshold', 'fmin': 0.5 * f, 'fmax': f, 'sigma_ref': middle})
        for f in _TOPS]
    runs += [(CONSTANT, f'{w:g} rad/s^2', {
        **base, 'law': 'constant_noise', 'fmin': 10.0, 'fmax': 300.0,
        'coupling': CASE.coupling, 'noise_wanted': w}) for w in _WANTED]
    for name, setting, options in runs:
        say(f'{name}, {setting}')
        noise, cutoff = adaptive(options, flown, seen, flown.noise)
        points.append(point(name, setting, flown, noise,
                            sweep(flown.truth, cutoff[None], 2, True)[0], cutoff))
    for limit in _LAGS:
        options = {**base, 'law': 'kalman', 'coupling': CASE.coupling, 'fmin': 5.0,
                   'fmax': 300.0, 'max_lag': limit, 'n0': GYRO**2 / RATE}
        setting = f'lag <= {limit:g} degrees' if limit else 'free'
        say(f'{KALMAN}, {setting}')
        # The law learns from powers, which hardly depend on the sign of the noise: half the
        # difference of both outputs is the noise, half the sum the signal.
        both, cutoff = adaptive(options, flown, seen, flown.truth + flown.noise)
        other, _ = adaptive(options, flown, seen, flown.truth - flown.noise)
        points.append(point(KALMAN, setting, flown, 0.5 * (both - other), 0.5 * (both + other),
                            cutoff))
    slope = kalman(CASE, flown)[1]
    points.append(Point('Kalman filter that knows sigma', '-', math.nan, math.nan,
                        lag_ms(slope, flown.slope),
                        float(np.sqrt(square_error(slope, flown.slope).mean()))))
    return points


def point(method: str, setting: str, flown: Flights, noise: np.ndarray, signal: np.ndarray,
          cutoff: np.ndarray) -> Point:
    """Return the noise and lag of one setting."""
    second = int(RATE)
    rest = noise[:, int(SETTLE * RATE):]
    pieces = rest[:, :rest.shape[1] // second * second].reshape(-1, second)
    return Point(
        method, setting, float(np.sqrt(np.mean(rest**2))),
        float(np.quantile(np.sqrt(np.mean(pieces**2, axis=1)), 0.95)),
        lag_ms(signal, flown.slope),
        float(np.sqrt(square_error(noise + signal, flown.slope).mean())), span(cutoff, '.0f'))


def render_dterm(points: list[Point]) -> tuple[str, Plot]:
    """Return a table and a figure."""
    fixed = [p for p in points if p.method == FIXED_CUTOFF]
    lags = np.array([p.lag for p in fixed])
    order = np.argsort(lags)

    def at(lag: float, what: str) -> float:
        values = np.log([getattr(p, what) for p in fixed])
        if not lags.min() <= lag <= lags.max():
            return math.nan
        return math.exp(float(np.interp(lag, lags[order], values[order])))

    least = min(fixed, key=lambda p: p.rms_error)
    rows = []
    for p in (least, *(p for p in points if p.method != FIXED_CUTOFF)):
        rows.append([p.method, p.setting, number(p.lag, '.1f'), number(p.noise, '.3g'),
                     number(p.noise / at(p.lag, 'noise'), '.2f'), number(p.loud, '.3g'),
                     number(p.loud / at(p.lag, 'loud'), '.2f'), number(p.rms_error, '.3g'),
                     p.cutoff])
    plot = Plot('D term: noise of the loudest second in twenty against lag', 'lag, ms',
                'rms of the noise, rad/s^2', width=760, height=360, log_y=True)
    for colour, name in enumerate((FIXED_CUTOFF, CONSTANT, SWITCH, CURVE_CUTOFF, KALMAN)):
        found = sorted((p for p in points if p.method == name), key=lambda p: p.lag)
        x = np.array([p.lag for p in found])
        plot.line(x, np.array([p.loud for p in found]), name, colour, 'thick')
        if name != FIXED_CUTOFF:
            plot.markers(x, np.array([p.loud for p in found]), '', colour)
    return table(['method', 'setting', 'lag, ms', 'noise, rad/s^2', 'over fixed of that lag',
                  'loudest second', 'over fixed of that lag', 'rms error', 'cutoff 5..95 %, Hz'],
                 rows), plot


def hindsight(flights: Flights, cutoffs: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return output and cutoff of the candidate with the least error in each flight."""
    outputs = sweep(flights.measured, cutoffs, order)
    chosen = np.argmin(square_error(outputs, flights.truth), axis=0)
    each = np.arange(chosen.size)
    return outputs[chosen, each], np.broadcast_to(
        cutoffs, (len(cutoffs), chosen.size, cutoffs.shape[2]))[chosen, each]


def score(case: Case, flights: Flights, window: float) -> list[list[str]]:
    """Return a row for each filter."""
    fmin, fmax = case.limits
    seen, x = estimates(flights, window), flights.measured
    found = {TRUTH: (kalman(case, flights)[0], np.full((1, 1), np.nan)),
             FIXED: hindsight(flights, np.geomspace(fmin, fmax, 41)[:, None, None], case.order),
             # The curve spans an octave, so f stays an octave below the upper limit.
             CURVE: hindsight(flights, np.minimum(curve(
                 flights.throttle, np.geomspace(fmin, fmax / 2.0, 21)), fmax), case.order)}
    middle = float(np.median(found[FIXED][1]))
    for name, options in {
            'threshold, an octave either side of it': {
                'order': case.order, 'law': 'threshold', 'fmin': max(0.5 * middle, fmin),
                'fmax': min(2.0 * middle, 450.0),
                'sigma_ref': SPREAD * math.sqrt(2.0 * case.alpha)},
            **laws(case), **mistaken(case)}.items():
        found[name] = adaptive(options, flights, seen, x)
    errors = {name: square_error(output, flights.truth) for name, (output, _) in found.items()}
    return [[name, f'{math.sqrt(errors[name].mean()):.4g}',
             ratio(errors[name], errors[TRUTH]), ratio(errors[name], errors[FIXED]),
             number(lag_ms(output, flights.truth)), span(cutoff, '.3g')]
            for name, (output, cutoff) in found.items()]


def ratio(found: np.ndarray, to: np.ndarray) -> str:
    """Return the geometric mean of the ratios with its standard error."""
    log = np.log(found / to)
    mean = math.exp(log.mean())
    if log.size < 2 or not log.any():
        return f'{mean:.3f}'
    return f'{mean:.3f} ± {mean * log.std(ddof=1) / math.sqrt(log.size):.3f}'


def span(cutoff: np.ndarray, form: str) -> str:
    """Return the 5 % and 95 % quantile of a cutoff, Hz."""
    settled = cutoff[:, int(SETTLE * RATE):] if cutoff.shape[1] > 1 else cutoff
    low, high = np.quantile(settled, [0.05, 0.95])
    return f'{low:{form}}..{high:{form}}' if math.isfinite(low) else '-'


def error(given: argparse.Namespace) -> tuple[str, Plot | None]:
    """Score the mean square error and lag of every law over simulated flights."""
    parts = []
    for k, case in enumerate(CASES, 2):
        say(case.name)
        flown = fly(case, np.random.default_rng([given.seed, k]), given.flights, given.seconds)
        parts.append(f'**{case.name}** ({given.flights} flights)\n\n' + table(
            ['filter', 'rms error', 'MSE over truth-knowing', 'MSE over best fixed', 'lag, ms',
             'cutoff 5..95 %, Hz'], score(case, flown, given.window)))
    return '\n'.join(parts), None


def dterm(given: argparse.Namespace) -> tuple[str, Plot | None]:
    """Compare the noise of the D term with its lag."""
    return render_dterm(run_dterm(given.flights, given.seconds, given.seed, given.window))


def loop(given: argparse.Namespace) -> tuple[str, Plot | None]:
    """Find the coupling at which the loop through the supply starts to hunt."""
    return control_loop.render(control_loop.scan(given.seconds, given.seed)), None


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)
    for action, flights, seconds in ((error, 10, 40.0), (dterm, 10, 40.0), (loop, 1, 30.0)):
        part = parts.add_parser(action.__name__, help=action.__doc__,
                                parents=[arguments('', help_option=False)])
        part.set_defaults(action=action)
        part.add_argument('--flights', type=int, default=flights)
        part.add_argument('--seconds', type=float, default=seconds, help='of each flight')
        part.add_argument('--window', type=float, default=2.0, help='of the estimator, s')
        part.add_argument('--seed', type=int, default=SEED)
        part.add_argument('--figure', type=Path)
    given = parser.parse_args()
    text, plot = given.action(given)
    stamp = f'{date.today().isoformat()}, seed {given.seed}, {given.seconds:g} s each.'
    deliver(f'{stamp}\n\n{text}', given.page, given.part)
    if given.figure and plot is not None:
        given.figure.write_text(drawing([plot.svg()], plot.width, plot.height, plot.title),
                                encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
