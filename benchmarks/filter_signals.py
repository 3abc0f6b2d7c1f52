"""
Flights for the filter benchmark, and Kalman filters that know the truth of each.

Nothing of the package is used.  sigma follows throttle, which moves in steps
and ramps: noise that steps with load.  A signal is a stochastic process with a
state, and so has a best linear estimate: that of a Kalman filter which is told
the true sigma at every sample.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from scipy.linalg import expm

RATE = 1000.0
# Stationary deviation of the supply at half throttle, V, and that of the body rate, rad/s.
SPREAD, BODY = 0.05, 1.0
# Noise of an ADC that needs a filter, V; of a gyro, rad/s.
ADC, GYRO = 0.03, 0.01
# Supply noise in the gyro, rad/s per V: at half throttle as strong as the body rate.
COUPLING = 20.0
_DWELL, _RAMP = (2.0, 6.0), (0.5, 1.5)


@dataclass(frozen=True)
class Case:
    """
    What is filtered.

    Attributes
    ----------
    name : str
        For the table.
    kind : {'voltage', 'ou', 'smooth'}
        The voltage itself in noise of the ADC; a body rate with one pole, or
        with two (Butterworth), in supply noise and noise of the gyro.
    alpha : float
        Of the supply, 1/s.
    bandwidth : float
        Of the body rate, Hz.
    order : int
        Of the filters that are compared.
    limits : tuple of float
        fmin and fmax for all of them, Hz.
    coupling : float
        Supply noise in the gyro, rad/s per V.

    """

    name: str
    kind: str
    alpha: float
    bandwidth: float
    order: int
    limits: tuple[float, float]
    coupling: float = COUPLING

    @property
    def white(self) -> float:
        """Deviation of the white noise of a sample."""
        return ADC if self.kind == 'voltage' else GYRO


CASES = (
    Case('Voltage, alpha 10', 'voltage', 10.0, 0.0, 1, (2.0, 400.0)),
    Case('Voltage, alpha 63', 'voltage', 63.0, 0.0, 1, (2.0, 400.0)),
    Case('Body rate of one pole at 5 Hz, alpha 600', 'ou', 600.0, 5.0, 2, (1.0, 300.0)),
    Case('Body rate of two poles at 5 Hz, alpha 600', 'smooth', 600.0, 5.0, 2, (1.0, 300.0)),
    Case('Body rate of one pole at 5 Hz, alpha 63', 'ou', 63.0, 5.0, 2, (1.0, 300.0)),
)


@dataclass(frozen=True, eq=False)
class Flights:
    """
    Flights of one case, shape (flights, n) each.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    throttle, sigma : ndarray
        0..1; V/sqrt(s).
    voltage : ndarray
        What the estimator gets, V.
    truth, slope : ndarray
        The signal and its derivative (NaN for one pole), unit and unit/s.
    measured, noise : ndarray
        The signal with all noise, and the noise alone.

    """

    t: np.ndarray
    throttle: np.ndarray
    sigma: np.ndarray
    voltage: np.ndarray
    truth: np.ndarray
    slope: np.ndarray
    measured: np.ndarray
    noise: np.ndarray


def throttles(rng: np.random.Generator, flights: int, n: int) -> np.ndarray:
    """Return throttle in steps and ramps, shape (flights, n)."""
    out = np.empty((flights, n))
    for row in out:
        at, before = 0, float(rng.uniform(0.1, 0.9))
        while at < n:
            after = float(rng.uniform(0.1, 0.9))
            ramp = int(rng.uniform(*_RAMP) * RATE) if rng.random() < 0.5 else 1
            end = at + ramp + int(rng.uniform(*_DWELL) * RATE)
            piece = np.concatenate((np.linspace(before, after, ramp + 1)[1:],
                                    np.full(end - at - ramp, after)))
            row[at:end] = piece[:n - at]
            at, before = end, after
    return out


def _motion(case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the transition over a sample, its noise and the stationary covariance."""
    if case.kind != 'smooth':
        rate = case.alpha if case.kind == 'voltage' else 2.0 * math.pi * case.bandwidth
        phi = math.exp(-rate / RATE)
        power = 1.0 if case.kind == 'voltage' else BODY**2
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
    throttle = throttles(rng, flights, n)
    # Flights show noise that grows 3 to 13 times from low to high throttle.
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
    white = case.white * rng.standard_normal((flights, n))
    t = np.arange(n) / RATE
    if case.kind == 'voltage':
        return Flights(t, throttle, sigma, 5.0 + supply + white, 5.0 + supply,
                       np.full((flights, n), np.nan), 5.0 + supply + white, white)
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
    """Return the estimates of signal and slope (NaN for one pole) that know sigma."""
    count, n = flights.measured.shape
    phi, driven, still = _motion(case)
    decay = math.exp(-case.alpha / RATE)
    grown = flights.sigma**2 * (1.0 - decay**2) / (2.0 * case.alpha)
    if case.kind == 'voltage':
        look, size = np.array([1.0]), 1
    else:
        size = phi.shape[0] + 1
        wide = np.zeros((size, size))
        wide[:-1, :-1], wide[-1, -1] = phi, decay
        phi, look = wide, np.zeros(size)
        look[0], look[-1] = 1.0, case.coupling
    noise = np.zeros((count, size, size))
    if case.kind != 'voltage':
        noise[:, :-1, :-1] = driven
    p = np.zeros((count, size, size))
    p[:, :still.shape[0], :still.shape[0]] = still
    p[:, -1, -1] = flights.sigma[:, 0]**2 / (2.0 * case.alpha)
    x = np.zeros((count, size))
    level = 5.0 if case.kind == 'voltage' else 0.0
    out = np.full((2, count, n), np.nan)
    for k in range(n):
        if k:
            x = x @ phi.T
            noise[:, -1, -1] = grown[:, k]
            p = phi @ p @ phi.T + noise
        gain = p @ look
        gain /= (gain @ look + case.white**2)[:, None]
        x = x + gain * (flights.measured[:, k] - level - x @ look)[:, None]
        p = p - gain[:, :, None] * (look @ p)[:, None, :]
        out[0, :, k] = level + x[:, 0]
        if case.kind == 'smooth':
            out[1, :, k] = x[:, 1]
    return out[0], out[1]
