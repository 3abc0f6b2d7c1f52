"""
Voltage paths of a power network, exact in law at any spacing of the stamps.

Limits: Gaussian, the telegraph of each ESC replaced by noise of the same
covariance; piecewise-constant throttle.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.network.components import PowerNetwork
from ou_monitor.paper.network.rail import rail_at
from ou_monitor.records import FloatArray
from scipy.linalg import expm


def discretise(a: npt.ArrayLike, b: npt.ArrayLike, dt: float) -> tuple[FloatArray, FloatArray]:
    """
    Return transition and noise covariance of dx = A x dt + B dW over a step.

    Van Loan (IEEE Trans. Automatic Control 23 (1978) 395) over a step short
    enough not to overflow, then doubled: Q(2h) = Q(h) + F Q(h) F'.

    a in 1/s, dt in s.
    """
    if not (math.isfinite(dt) and dt >= 0.0):
        raise ValueError(f'the step must be finite and not negative, got {dt} s')
    rates, noise = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    n = rates.shape[0]
    size = float(np.linalg.norm(rates, 1)) * dt
    halvings = max(0, math.ceil(math.log2(size))) if size > 0.0 else 0
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = -rates
    block[:n, n:] = noise @ noise.T
    block[n:, n:] = rates.T
    e = expm(block * (dt / 2.0**halvings))
    step = e[n:, n:].T
    covariance = step @ e[:n, n:]
    for _ in range(halvings):
        covariance = covariance + step @ covariance @ step.T
        step = step @ step
    return np.asarray(step), np.asarray(0.5 * (covariance + covariance.T))


def simulate(
    network: PowerNetwork, t: npt.ArrayLike, throttle: npt.ArrayLike, rng: np.random.Generator, *,
    rail: str = 'bus',
) -> FloatArray:
    """Draw a voltage path of a rail (t in s, result in V)."""
    stamps = np.asarray(t, dtype=np.float64)
    if stamps.ndim != 1:
        raise ValueError(f't must have shape (n,), got {stamps.shape}')
    steps = np.diff(stamps)
    if not np.isfinite(stamps).all() or (steps < 0.0).any():
        raise ValueError('stamps must be finite and not decreasing, s')
    held = np.broadcast_to(np.asarray(throttle, dtype=np.float64), stamps.shape)
    rails = {float(u): rail_at(network, float(u), rail) for u in np.unique(held)}
    if not stamps.size:
        return np.empty(0)
    first = rails[float(held[0])]
    size = first.a.shape[0]
    noise = rng.standard_normal((stamps.size, size))
    # Deviations are counted from the mean of the present throttle.
    levels = {u: _state_means(network, r.load.bus, r.load.regulated, size)
              for u, r in rails.items()}
    voltage = np.empty(stamps.size)
    x = _root(first.covariance) @ noise[0]
    voltage[0] = first.mean + float(first.c @ x)
    laws: dict[tuple[float, float], tuple[FloatArray, FloatArray]] = {}
    last = float(held[0])
    for k, dt in enumerate(steps, start=1):
        now = float(held[k])
        here = rails[now]
        if now != last:
            x = x + levels[last] - levels[now]
            last = now
        # Spacings of stamps far from 0 differ in their last digits; seven are kept.
        key = (now, float(f'{dt:.6e}'))
        if key not in laws:
            transition, covariance = discretise(here.a, here.b, key[1])
            laws[key] = (transition, _root(covariance))
        transition, root = laws[key]
        x = transition @ x + root @ noise[k]
        voltage[k] = here.mean + float(here.c @ x)
    return voltage


def _state_means(network: PowerNetwork, bus: float, regulated: float, size: int) -> FloatArray:
    """Return the means of the states; the inductor carries what the regulator draws."""
    means = np.zeros(size)
    means[0] = bus
    k = 1
    source = bus
    if network.filter_inductance > 0.0:
        drawn = network.regulator_current(bus)
        source = bus - network.filter_resistance * drawn
        means[1:3] = drawn, source
        k = 3
    means[k:k + 2] = source, regulated
    return means


def _root(covariance: FloatArray) -> FloatArray:
    """Return a square root of a covariance that may be singular."""
    scale = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(scale > 0.0, scale, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray(scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0)))
