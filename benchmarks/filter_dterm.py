"""
The D term: noise that comes out against lag.

Run by `filter.py dterm`.  A filter is linear once its cutoff is given, so
noise and signal are filtered apart by one cutoff: the noise is told from the
signal exactly, and the lag is that of the signal alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import filter_methods as methods
from filter_signals import BODY, Case, Flights, fly, kalman, RATE, SPREAD
import numpy as np
from ou_monitor.report.svg import Plot
from tables import number, table

CASE = Case('D term of a body rate of two poles at 5 Hz, alpha 600', 'smooth', 600.0, 5.0, 2,
            (20.0, 150.0), coupling=2.0)
FIXED, CURVE, SWITCH = 'fixed', "Betaflight's curve, f..2 f", 'threshold, f/2..f'
CONSTANT, KALMAN = 'constant_noise', 'kalman'
# Cutoffs, Hz, and wanted noise, rad/s^2.
_CUTOFFS, _BASES = np.geomspace(15.0, 200.0, 28), (15.0, 25.0, 40.0, 60.0, 75.0, 90.0)
_LAGS = (0.0, 30.0, 20.0, 12.0)
_TOPS, _WANTED = (40.0, 70.0, 110.0, 150.0), (4.0, 7.0, 12.0, 20.0, 30.0)


@dataclass(frozen=True)
class Point:
    """
    One setting of one method.

    Attributes
    ----------
    method, setting : str
        What and how.
    noise, loud, lag, rms_error : float
        Rms of the noise that comes out and that of the loudest second in
        twenty, rad/s^2; delay of the signal, ms; rms of output less the true
        derivative, rad/s^2.
    low, high : float
        5 % and 95 % quantile of the cutoff, Hz.

    """

    method: str
    setting: str
    noise: float
    loud: float
    lag: float
    rms_error: float
    low: float = math.nan
    high: float = math.nan


def run(flights: int, seconds: float, seed: int, window: float, tell: Callable[[str], None],
        ) -> list[Point]:
    """Return the points of all methods."""
    flown = fly(CASE, np.random.default_rng([seed, 100]), flights, seconds)
    off = methods.agrees(CASE, flown)
    if off > 1e-9:
        raise SystemExit(f'the vectorized filter is off by {off:g}: the comparison is void')
    seen = methods.estimates(flown, window)
    points = []

    def keep(method: str, setting: str, noise: np.ndarray, signal: np.ndarray,
             cutoff: np.ndarray) -> None:
        points.append(_point(method, setting, flown, noise, signal, cutoff))

    tell(FIXED)
    for name, cutoffs, settings in (
            (FIXED, _CUTOFFS[:, None, None], [f'{f:.0f} Hz' for f in _CUTOFFS]),
            (CURVE, methods.curve(flown.throttle, np.array(_BASES)),
             [f'{f:g}..{2 * f:g} Hz' for f in _BASES])):
        noises = methods.sweep(flown.noise, cutoffs, 2, True)
        signals = methods.sweep(flown.truth, cutoffs, 2, True)
        for k, setting in enumerate(settings):
            keep(name, setting, noises[k], signals[k], cutoffs[k])
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
        tell(f'{name}, {setting}')
        noise, cutoff = methods.adaptive(options, flown, seen, flown.noise)
        keep(name, setting, noise,
             methods.sweep(flown.truth, cutoff[None], 2, True)[0], cutoff)
    for limit in _LAGS:
        options = {**base, 'law': 'kalman', 'coupling': CASE.coupling, 'signal_poles': 2,
                   'signal_bandwidth': CASE.bandwidth, 'signal_rms': BODY, 'fmin': 5.0,
                   'fmax': 300.0, 'max_lag': limit, 'n0': CASE.white**2 / RATE}
        setting = f'lag <= {limit:g} degrees' if limit else 'free'
        tell(f'{KALMAN}, {setting}')
        # Its gains do not look at the signal, so that noise and signal may be run apart.
        noise, cutoff = methods.adaptive(options, flown, seen, flown.noise)
        keep(KALMAN, setting, noise, methods.adaptive(options, flown, seen, flown.truth)[0],
             cutoff)
    slope = kalman(CASE, flown)[1]
    points.append(Point('Kalman filter that knows sigma', '-', math.nan, math.nan,
                        methods.lag_ms(slope, flown.slope),
                        float(np.sqrt(methods.error(slope, flown.slope).mean()))))
    return points


def _point(method: str, setting: str, flown: Flights, noise: np.ndarray, signal: np.ndarray,
           cutoff: np.ndarray) -> Point:
    first, second = int(methods.SETTLE * RATE), int(RATE)
    rest = noise[:, first:]
    pieces = rest[:, :rest.shape[1] // second * second].reshape(-1, second)
    settled = cutoff[..., first:] if cutoff.shape[-1] > 1 else cutoff
    return Point(
        method, setting, float(np.sqrt(np.mean(rest**2))),
        float(np.quantile(np.sqrt(np.mean(pieces**2, axis=1)), 0.95)),
        methods.lag_ms(signal, flown.slope),
        float(np.sqrt(methods.error(noise + signal, flown.slope).mean())),
        float(np.quantile(settled, 0.05)), float(np.quantile(settled, 0.95)))


def render(points: list[Point]) -> tuple[str, Plot]:
    """Return a table and a figure."""
    fixed = [p for p in points if p.method == FIXED]
    lags = np.array([p.lag for p in fixed])
    order = np.argsort(lags)

    def at(lag: float, what: str) -> float:
        values = np.log([getattr(p, what) for p in fixed])
        if not lags.min() <= lag <= lags.max():
            return math.nan
        return math.exp(float(np.interp(lag, lags[order], values[order])))

    least = min(fixed, key=lambda p: p.rms_error)
    rows = []
    for p in (least, *(p for p in points if p.method != FIXED)):
        rows.append([p.method, p.setting, number(p.lag, '.1f'), number(p.noise, '.3g'),
                     number(p.noise / at(p.lag, 'noise'), '.2f'), number(p.loud, '.3g'),
                     number(p.loud / at(p.lag, 'loud'), '.2f'), number(p.rms_error, '.3g'),
                     f'{p.low:.0f}..{p.high:.0f}' if math.isfinite(p.low) else '-'])
    plot = Plot('D term: noise of the loudest second in twenty against lag', 'lag, ms',
                'rms of the noise, rad/s^2', width=760, height=360, log_y=True)
    for colour, name in enumerate((FIXED, CONSTANT, SWITCH, CURVE, KALMAN)):
        found = sorted((p for p in points if p.method == name), key=lambda p: p.lag)
        x = np.array([p.lag for p in found])
        plot.line(x, np.array([p.loud for p in found]), name, colour, 'thick')
        if name != FIXED:
            plot.markers(x, np.array([p.loud for p in found]), '', colour)
    return table(['method', 'setting', 'lag, ms', 'noise, rad/s^2', 'over fixed of that lag',
                  'loudest second', 'over fixed of that lag', 'rms error', 'cutoff 5..95 %, Hz'],
                 rows), plot
