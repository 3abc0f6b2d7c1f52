"""
Used by filter.py: the control loop that an adaptive D term closes through the supply.

    throttle -> load -> sigma and sag -> SlidingEstimator -> cutoff -> D term -> throttle

One rate axis of a multirotor in hover: four motors in two pairs, first-order motors, no air.  Only
the order of magnitude of the margins is meaningful.

The load is the rms of the motors' commands, sqrt(u^2 + d^2) for the collective u and the
differential d, so noise in d draws current.  sigma is `intensity` (load / hover)^steepness; the
paper's loads of 10 and 40 % have a steepness of ln(0.632 / 0.3156) / ln(4) = 0.5.  The collective
keeps the thrust constant when the voltage sags.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
import math
from typing import Any

from common import number, say, table
import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.filter.lowpass import AdaptiveLowPass
from ou_monitor.records import FloatArray, NAN

# Minimum swing of the cutoff, octaves, that counts as hunting.
SWING = 0.5
# Minimum ratio of the swing to the swing with the loop cut.
FACTOR = 3.0
COUPLINGS = (0.1, 0.3, 1.0, 1.5, 2.0, 3.0, 4.0)
# A threshold just above sigma in a quiet hover, where a law is most likely to hunt.
_ABOVE = 0.72
_BARE = {'smoothing': 0.0, 'slew': 0.0, 'dead_band': 0.0}
# The coupling of this law is set to the loop's.
_KALMAN = {'law': 'kalman', 'n0': 1e-7}
CASES: dict[str, dict[str, object]] = {
    'constant_noise, defaults': {},
    'constant_noise, defaults, sigma ~ load^3': {'steepness': 3.0},
    'constant_noise, nothing held': {'filter': {**_BARE}},
    'constant_noise, nothing held, sigma ~ load^3': {
        'filter': {**_BARE, 'fmin': 5.0}, 'steepness': 3.0},
    'threshold, defaults': {'filter': {'law': 'threshold', 'sigma_ref': _ABOVE}},
    'threshold, nothing held': {'filter': {'law': 'threshold', 'sigma_ref': _ABOVE, **_BARE}},
    'kalman, lag <= 20 degrees at 10 Hz': {'filter': {**_KALMAN, 'max_lag': 20.0}},
    'kalman, fmin 5 Hz, sigma ~ load^3': {
        'filter': {**_KALMAN, 'fmin': 5.0}, 'steepness': 3.0},
    'threshold, slew 0.2 octaves/s': {
        'filter': {'law': 'threshold', 'sigma_ref': _ABOVE, 'slew': 0.2}},
}


def scan(seconds: float, seed: int) -> dict[str, list[Verdict]]:
    """Return verdicts of each case at each coupling."""
    found: dict[str, list[Verdict]] = {}
    for name, options in CASES.items():
        found[name] = []
        for coupling in COUPLINGS:
            given = dict(options)
            of_filter = given.get('filter', {})
            if 'kalman' in name:
                given['filter'] = {**of_filter, 'coupling': coupling}  # type: ignore[dict-item]
            found[name].append(judge(Loop(coupling=coupling, **given),  # type: ignore[arg-type]
                                     seconds, seed))
        say(name)
    return found


def render(found: dict[str, list[Verdict]]) -> str:
    """Return a table."""
    rows = []
    for name, verdicts in found.items():
        first = next((k for k, v in enumerate(verdicts) if v.cycle), None)
        rows.append([
            name, *(f'{v.swing:.2f}{" *" if v.cycle else ""}' for v in verdicts),
            'none' if first is None else f'{COUPLINGS[first]:g}',
            '-' if first is None else number(verdicts[first].period, '.1f')])
    share = found['constant_noise, defaults']
    return ('**Swing of the cutoff, octaves (95 % less 5 % quantile; * it hunts), by coupling, '
            'rad/s per V**\n\n'
            + table(['law', *(f'{c:g}' for c in COUPLINGS), 'hunts from', 'period, s'], rows)
            + '\nRms of the differential command in the first row: '
            + ', '.join(f'{v.command:.2f}' for v in share) + '.\n')


@dataclass(frozen=True)
class Loop:
    """Vehicle, controller, supply, estimator and filter."""

    hover: float = 0.4  # Collective throttle that holds the thrust at `nominal` volts, 0..1.
    authority: float = 100.0  # Angular acceleration of a unit differential command, rad/s^2.
    motor_lag: float = 0.03  # Time constant of the motors, s.
    # Gains on rad/s, rad and rad/s^2 to differential command; D on the measurement.
    p: float = 0.4
    i: float = 0.8
    d: float = 0.01
    gyro_noise: float = 0.005  # White noise of a sample, rad/s.
    gust: float = 0.3  # White angular acceleration, rad/s^2/sqrt(Hz).
    coupling: float = 0.1  # Supply noise in the gyro, rad/s per V.
    # Voltage without load, V; its fall per unit load, V.
    nominal: float = 5.0
    sag: float = 0.75
    # Supply: relaxation, 1/s; sigma in a quiet hover, V/sqrt(s); exponent of the load in sigma.
    alpha: float = 63.0
    intensity: float = 0.632
    steepness: float = 0.5
    adc_noise: float = 0.002  # White noise of a voltage sample, V.
    # Samples per second, Hz; time between estimates, s.
    rate: float = 500.0
    every: float = 0.05
    window: float = 2.0  # Of the estimator, s.
    # Options of `AdaptiveLowPass` other than its mode.
    filter: Mapping[str, Any] = field(default_factory=dict)  # noqa: A003
    closed: bool = True  # Whether the D term's command is part of the load.


@dataclass(frozen=True, eq=False)
class Flight:
    """Time series at the times of the estimates."""

    t: FloatArray  # s.
    cutoff: FloatArray  # Hz.
    # V/sqrt(s), of the supply and as estimated (NaN while unknown).
    sigma: FloatArray
    seen: FloatArray
    command: FloatArray  # Rms of the differential command since the estimate before.
    turn: FloatArray  # Rms of the body rate since the estimate before, rad/s.


@dataclass(frozen=True)
class Verdict:
    """Whether the cutoff hunts."""

    cycle: bool  # Whether the cutoff hunts.
    # 95 % minus 5 % quantile of the cutoff, octaves, and the same with the loop cut (NaN, as not
    # needed, where the first is below `SWING`).
    swing: float
    quiet: float
    period: float  # s; NaN when there is no cycle.
    command: float  # Rms of the differential command, 0..1.


def fly(loop: Loop, seconds: float, seed: int) -> Flight:
    """Simulate."""
    dt = 1.0 / loop.rate
    n = round(seconds * loop.rate)
    block = max(1, round(loop.every * loop.rate))
    draws = np.random.default_rng(seed).standard_normal((n, 4))
    kicks, gusts, gyro = (draws[:, k].tolist() for k in range(3))
    adc = loop.adc_noise * draws[:, 3]
    estimator = SlidingEstimator(window=loop.window)
    low_pass = AdaptiveLowPass(mode='derivative', **loop.filter)
    phi = math.exp(-loop.alpha * dt)
    step = math.sqrt((1.0 - phi * phi) / (2.0 * loop.alpha))
    motor = -math.expm1(-dt / loop.motor_lag)
    gust = loop.gust * math.sqrt(dt)
    noise = rate = thrust = integral = 0.0
    load = collective = loop.hover
    level, sigma = loop.nominal - loop.sag * load, loop.intensity
    seen = error = alpha = NAN
    voltage, throttle = np.empty(block), np.empty(block)
    rows: list[tuple[float, ...]] = []
    commands = turns = 0.0
    for k in range(n):
        t = k * dt
        noise = phi * noise + step * sigma * kicks[k]
        at = k % block
        voltage[at], throttle[at] = level + noise + adc[k], collective
        measured = rate + loop.coupling * noise + loop.gyro_noise * gyro[k]
        slope = low_pass.step(t, measured, seen, error, alpha)
        integral = min(max(integral - loop.i * measured * dt, -0.3), 0.3)
        command = min(max(integral - loop.p * measured - loop.d * slope, -1.0), 1.0)
        # A sagging supply needs a larger collective for the same thrust.
        collective = min(loop.hover * loop.nominal / max(level, 0.5 * loop.nominal), 1.0)
        load = math.sqrt(collective * collective + (command * command if loop.closed else 0.0))
        level += motor * (loop.nominal - loop.sag * load - level)
        sigma = loop.intensity * (load / loop.hover) ** loop.steepness
        strength = loop.authority * (level / loop.nominal)
        thrust += motor * (command - thrust)
        rate += strength * thrust * dt + gust * gusts[k]
        commands += command * command
        turns += rate * rate
        if at == block - 1:
            estimator.push(dt * np.arange(k + 1 - block, k + 1), voltage, throttle)
            e = estimator.estimate()
            seen = e.sigma if e.usable else NAN
            error, alpha = e.sigma_se, e.alpha
            rows.append((t, low_pass.cutoff, sigma, seen, math.sqrt(commands / block),
                         math.sqrt(turns / block)))
            commands = turns = 0.0
    return Flight(*np.array(rows).T)


def judge(loop: Loop, seconds: float = 40.0, seed: int = 1) -> Verdict:
    """Fly with the loop closed and cut, and compare the cutoffs."""
    closed = fly(replace(loop, closed=True), seconds, seed)
    half = closed.t.size // 2
    octaves = np.log2(closed.cutoff[half:])
    swing, quiet = _swing(octaves), NAN
    cycle = swing >= SWING
    if cycle:
        cut = fly(replace(loop, closed=False), seconds, seed)
        quiet = _swing(np.log2(cut.cutoff[half:]))
        cycle = swing >= FACTOR * quiet
    return Verdict(cycle, swing, quiet, _period(octaves) * loop.every if cycle else NAN,
                   float(np.sqrt(np.mean(closed.command[half:]**2))))


def _swing(octaves: FloatArray) -> float:
    low, high = np.quantile(octaves, [0.05, 0.95])
    return float(high - low)


def _period(octaves: FloatArray) -> float:
    """Return the lag (in steps) of the autocorrelation's first maximum after its first zero."""
    x = octaves - octaves.mean()
    correlation = np.correlate(x, x, 'full')[x.size - 1:]
    below = np.flatnonzero(correlation < 0.0)
    if not below.size or below[0] >= x.size // 2:
        return NAN
    return float(below[0] + np.argmax(correlation[below[0]:x.size * 3 // 4]))
