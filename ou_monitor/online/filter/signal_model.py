r"""
The signal of the law `kalman` as a linear model of one step: what it is told, as matrices.

The state is the signal (a voltage: its deviation from the level; of two poles
also its slope), and beside it what else is seen: `coupling` times the deviation
of the supply, or the error of the level.  Each block is exact over a step of any
length: transition exp(A dt), driving covariance P - exp(A dt) P exp(A dt)^T with
the stationary P (a random walk: sigma^2 dt).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray

_ROOT2 = math.sqrt(2.0)
# Time over which what is not told of the level moves, s: ten of the default windows.
LEVEL_TIME = 20.0


class Known(NamedTuple):
    """
    What is known of the supply.

    Attributes
    ----------
    sigma : float
        Noise intensity, V/sqrt(s).
    alpha : float
        Relaxation rate, 1/s.
    level_se : float
        Standard error of the level, V; NaN: there is no level, and the voltage
        counts as a random walk.

    """

    sigma: float
    alpha: float
    level_se: float


class Step(NamedTuple):
    """
    The model over one step; shapes (k, k).

    Attributes
    ----------
    phi, drive : ndarray
        Transition and driving covariance.
    still : ndarray
        Stationary covariance.
    rows : list of list of float
        `phi` for quick use.

    """

    phi: FloatArray
    drive: FloatArray
    still: FloatArray
    rows: list[list[float]]


def has_beside(s: FilterSettings) -> bool:
    """Tell whether the last of the state is seen beside the signal."""
    return bool(s.coupling) or not s.signal_bandwidth


def size_of(s: FilterSettings) -> int:
    """Return the size of the state."""
    return s.signal_poles + bool(s.coupling) if s.signal_bandwidth else 2


def step_model(s: FilterSettings, known: Known, dt: float) -> Step:
    """Return the model for a step of `dt`, s (dt in s)."""
    if not s.signal_bandwidth:
        levelled = known.level_se == known.level_se
        slow = 1.0 / LEVEL_TIME
        error = known.level_se if levelled else 0.0
        blocks = [_ou(known.alpha if levelled else 0.0, known.sigma, dt),
                  _ou(slow, error * math.sqrt(2.0 * slow), dt)]
    else:
        w = 2.0 * math.pi * s.signal_bandwidth
        blocks = [_ou(w, s.signal_rms * math.sqrt(2.0 * w), dt) if s.signal_poles == 1 else
                  _butterworth(w, s.signal_rms, dt)]
        if s.coupling:
            blocks.append(_ou(known.alpha, s.coupling * known.sigma, dt))
    size = size_of(s)
    phi, drive, still = np.zeros((size, size)), np.zeros((size, size)), np.zeros((size, size))
    at = 0
    for a, q, p in blocks:
        place = slice(at, at + a.shape[0])
        phi[place, place], drive[place, place], still[place, place] = a, q, p
        at += a.shape[0]
    return Step(phi, drive, still, phi.tolist())


_Block = tuple[FloatArray, FloatArray, FloatArray]


def _ou(rate: float, intensity: float, dt: float) -> _Block:
    """Return transition, driving and stationary variance of an OU; of a random walk at rate 0."""
    if rate == 0.0:
        # Nothing is known of where it starts: the first sample decides.
        drive = intensity * intensity * dt
        return np.eye(1), np.array([[drive]]), np.array([[1e6 * drive]])
    still = intensity * intensity / (2.0 * rate)
    return (np.array([[math.exp(-rate * dt)]]),
            np.array([[-still * math.expm1(-2.0 * rate * dt)]]), np.array([[still]]))


def _butterworth(w: float, rms: float, dt: float) -> _Block:
    """Return the same of a Butterworth process of two poles: its value and its slope."""
    angle = w * dt
    p = angle / _ROOT2
    cos, sin, decay = math.cos(p), math.sin(p), math.exp(-p)
    phi = decay * np.array([[cos + sin, _ROOT2 * sin / w], [-_ROOT2 * w * sin, cos - sin]])
    still = np.diag([rms * rms, (w * rms)**2])
    if angle < 1e-3:
        # The difference below would cancel; what is left out here is of relative size `angle`.
        power = 2.0 * _ROOT2 * w**3 * rms * rms
        drive = power * np.array([[dt**3 / 3.0, dt * dt / 2.0], [dt * dt / 2.0, dt]])
    else:
        drive = still - phi @ still @ phi.T
    return phi, drive, still
