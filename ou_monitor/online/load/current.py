"""
The voltage under a measured current: level, resistance, and how well that predicts.

Limits first: the scale of the current is taken as it comes, and with it the resistance; the sign
is not looked at, as drivers differ.  A current that does not move says nothing.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model.load import LEVELS, SLOPES
from ou_monitor.online.load.blocks import Block, CLIP, DIVERGED, LoadNoise, scored
from ou_monitor.records import FloatArray, NAN

# Time constants, s, of polarisation: those of the throttle's filter.
_LAGS = (2.0, 15.0)
# Largest current so far at which the filter begins, A, and the rise of it that begins anew.
_LEAST, _MORE = 1e-2, 4.0
# Prior deviation, relative to the voltage, of the fall at the largest current, at once and late.
_FALL = (0.3, 0.15, 0.15)
# Level: V per sqrt(s) and cell, twice that under throttle, as charge is counted from a guess.
_WALK = 0.003
# Time to empty a pack at the largest current, s, to a factor of three.
_EMPTY = 200.0
# Change of each coefficient: 2 % of a fall of 12 % in 100 s.
_CHANGE = (0.02 * 0.12) ** 2 / 100.0
# Known: relative error of the resistance below this; its least one, as the filter's own does not
# count how a pack warms.
_KNOWN, LEAST_ERROR = 0.33, 0.1
# A current that was unknown for so long, s, is lost.
_HOLD = 1.0


class CurrentFilter:
    """Level and resistance of a supply from blocks with current; states level, use, falls."""

    def __init__(self) -> None:
        self._t = self._heard = NAN
        self._largest = 0.0
        self._lost = False
        self.score = NAN

    def _begin(self, block: Block, x: float) -> None:
        v = max(block.voltage, 1e-3)
        self._volts, self._unit = v, max(self._largest, _LEAST)
        self.noise = LoadNoise(v)
        x /= self._unit
        self._lags = [x, 0.5 * x]
        m, P = np.zeros(5), np.zeros((5, 5))
        m[1] = 1.0 / _EMPTY
        P[1, 1] = m[1] ** 2
        P[2:, 2:] = np.diag(np.square(_FALL) * v * v)
        self._m, self._P = m, P
        self._settle(block.voltage, x)
        self.score = NAN

    def _settle(self, v: float, x: float) -> None:
        """Open the level."""
        m, P = self._m, self._P
        h = self._regressors(x)
        m[0] = v - h[1:] @ m[1:]
        P[0, 1:] = P[1:, 0] = -P[1:, 1:] @ h[1:]
        P[0, 0] = (0.02 * self._volts) ** 2 + h[1:] @ P[1:, 1:] @ h[1:]

    def _regressors(self, x: float) -> FloatArray:
        return np.array([1.0, 0.0, -x, *(-low for low in self._lags)])

    def take(self, block: Block, cells: float, *, fresh: bool) -> None:
        """Take a block (cells in series); fresh: time or supply may be another."""
        x = abs(block.current)
        if not math.isfinite(x):
            if not block.t - self._heard <= _HOLD:
                self._lost, self.score = True, NAN
            return
        lost, self._lost, self._heard = self._lost, False, block.last
        self._largest = max(self._largest, x)
        if self._largest < _LEAST:
            return
        if not math.isfinite(self._t) or self._largest > _MORE * self._unit:
            self._begin(block, x)
        elif fresh or lost:
            self._lags = [x / self._unit, 0.5 * x / self._unit]
            self._settle(block.voltage, x / self._unit)
        else:
            self._follow(block, x / self._unit, cells)
        self._t = block.t

    def _follow(self, block: Block, x: float, cells: float) -> None:
        dt = block.t - self._t
        m, P = self._m, self._P
        self._lags = [x + (low - x) * math.exp(-dt / tau) for low, tau in zip(self._lags, _LAGS)]
        slope = cells * float(np.interp(m[0] / cells, LEVELS, SLOPES))
        used = x * dt * slope
        m[0] -= used * m[1]
        P[0] -= P[1] * used
        P[:, 0] -= P[:, 1] * used
        P[0, 0] += (_WALK * cells) ** 2 * dt
        P[range(2, 5), range(2, 5)] += _CHANGE * self._volts ** 2 * dt
        h = self._regressors(x)
        noise = self.noise
        R = noise.variance(0.0, 0.0, block.n)
        e = block.voltage - float(h @ m)
        g = P @ h
        s = float(h @ g)
        if not 0.0 <= s < DIVERGED:
            self._begin(block, x * self._unit)
            return
        scale = max(1.0, noise.scale)
        z = max(-CLIP, min(CLIP, e / math.sqrt(s + R * scale)))
        self.score = scored(self.score, z, s + R * scale, dt)
        total = s + R * scale * (1.0 + noise.correlation) / (1.0 - noise.correlation)
        total *= max(1.0, abs(e) / math.sqrt(total) / CLIP)
        noise.learn(e, s, 0.0, 0.0, block.n, block.within)
        noise.follow(z)
        m += g * (e / total)
        P -= np.outer(g, g) / total

    @property
    def resistance(self) -> tuple[float, float]:
        """Return the resistance at once, Ohm, and its standard error; NaN: not known."""
        if not math.isfinite(self._t):
            return NAN, NAN
        value = float(self._m[2])
        error = math.sqrt(float(self._P[2, 2]) * max(1.0, self.noise.scale))
        if not 0.0 < error < _KNOWN * value:
            return NAN, NAN
        return value / self._unit, max(error, LEAST_ERROR * value) / self._unit

    @property
    def level(self) -> float:
        """Return the open-circuit voltage, V."""
        return float(self._m[0])
