"""
Flights of a rail, simulated for the risk alone: an RC rail, current noise, fine steps.

Nothing of the package is used.  The rail is C dv/dt = (source - v)/R - i(throttle)
- noise, stepped twenty times a sample by the exponential Euler scheme; between
two fine steps the lowest point is drawn by the Brownian bridge, so that what is
counted is the continuous path.  sigma depends on throttle and wanders; throttle
changes in steps; the ADC adds white noise.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

RATE, FINE = 1000.0, 20
# Throttle as a flight has it: what it is set to, and for how long, s.
_THROTTLE, _DWELL = (0.15, 0.9), (2.0, 9.0)


@dataclass(frozen=True, eq=False)
class Flights:
    """
    Some flights of one length.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Stamps, s.
    voltage : ndarray, shape (flights, n)
        What the ADC tells, V.
    throttle : ndarray, shape (flights, n)
        0..1.
    low : ndarray, shape (flights, n)
        Lowest point of the path from the sample before to this one, V.
    path : ndarray, shape (flights, n)
        The rail itself at the samples, V.
    alpha, level, spread : ndarray, shape (flights,)
        1/s; level at half throttle, V; stationary deviation there, V.

    """

    t: np.ndarray
    voltage: np.ndarray
    throttle: np.ndarray
    low: np.ndarray
    path: np.ndarray
    alpha: np.ndarray
    level: np.ndarray
    spread: np.ndarray


def throttle_steps(rng: np.random.Generator, flights: int, n: int) -> np.ndarray:
    """Return steps of throttle, shape (flights, n)."""
    out = np.empty((flights, n))
    for row in out:
        at = 0
        while at < n:
            end = at + int(rng.uniform(*_DWELL) * RATE)
            row[at:end] = rng.uniform(*_THROTTLE)
            at = end
    return out


def fly(rng: np.random.Generator, flights: int, seconds: float, *, wander: float = 0.08,
        noise: float = 0.2, throttle: np.ndarray | None = None) -> Flights:
    """
    Simulate.

    Parameters
    ----------
    rng : numpy.random.Generator
        Source of randomness.
    flights : int
        How many.
    seconds : float
        Length, s.
    wander : float
        Deviation of ln sigma after one second, 1/sqrt(s); it comes back within
        a minute.
    noise : float
        Largest white noise of the ADC, in stationary deviations; drawn.
    throttle : ndarray, shape (flights, n), optional
        Steps are drawn when left out.

    Returns
    -------
    Flights

    """
    n = int(seconds * RATE)
    h = 1.0 / RATE / FINE
    throttle = throttle_steps(rng, flights, n) if throttle is None else throttle
    # Components: 20..120 1/s, 20..150 mV.
    resistance = rng.uniform(0.05, 0.4, flights)
    alpha = np.exp(rng.uniform(math.log(20.0), math.log(120.0), flights))
    capacitance = 1.0 / (alpha * resistance)
    spread = np.exp(rng.uniform(math.log(0.02), math.log(0.15), flights))
    intensity = spread * np.sqrt(2.0 * alpha)
    growth = rng.uniform(0.3, 2.0, flights)
    sag = rng.uniform(0.5, 4.0, flights) * spread
    source = 5.0 + sag * 0.5
    adc = rng.uniform(0.0, noise, flights) * spread
    log = np.zeros(flights)
    keep = np.exp(-h / (resistance * capacitance))
    v = source - sag * throttle[:, 0] + spread * rng.standard_normal(flights)
    voltage, low, path = (np.empty((flights, n), np.float32) for _ in range(3))
    for k in range(n):
        u = throttle[:, k]
        log += wander / math.sqrt(RATE) * rng.standard_normal(flights) - log / (60.0 * RATE)
        current = sag * u / resistance
        rest = source - resistance * current
        # White current through the capacitor, its intensity as throttle and time have it.
        sigma = intensity * (1.0 + growth * (u - 0.5)) * np.exp(log)
        lowest = v
        kicks = rng.standard_normal((FINE, flights))
        drops = rng.exponential(size=(FINE, flights))
        step = sigma * math.sqrt(h)
        for kick, drop in zip(kicks, drops):
            after = rest + (v - rest) * keep + step * kick
            # Lowest point of a Brownian bridge: P(min < m) = exp(-2 (a-m)(b-m) / (sigma^2 h)).
            bottom = 0.5 * (v + after - np.sqrt((v - after)**2 + 2.0 * step**2 * drop))
            lowest = np.minimum(lowest, bottom)
            v = after
        voltage[:, k], low[:, k], path[:, k] = v + adc * rng.standard_normal(flights), lowest, v
    return Flights(np.arange(1, n + 1) / RATE, voltage, throttle, low, path, alpha,
                   source - 0.5 * sag, spread)
