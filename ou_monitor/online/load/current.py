"""
The voltage under a measured current: level, resistance, and how well that predicts.

Limits first: scale and sign of the current are taken as they come, and with the scale the
resistance; a current that does not move says nothing.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model.load import LEVELS, SLOPES
from ou_monitor.online.load.blocks import Block, CLIP, DIVERGED, LoadDelay, LoadNoise, log_density
from ou_monitor.online.load.supply_load import LAGS, static
from ou_monitor.records import FloatArray, NAN

# Largest current so far at which the filter begins, A, and the rise of it that begins anew.
_LEAST, _MORE = 1e-2, 4.0
# Prior deviation, relative to the voltage, of the fall at the largest current; of it at once and
# after each of LAGS the shares, and their deviations.
_FALL = 0.3
_SHARES = np.array([1.0, 0.1, 0.2, 0.3])
_SHARE_STD = (0.3, 0.3, 0.1, 0.15)
_PRIOR = _FALL ** 2 * (np.outer(_SHARES, _SHARES) + np.diag(np.square(_SHARE_STD)))
_STATES = 2 + _SHARES.size
# Level: V per sqrt(s) and cell, twice that under throttle, as charge is counted from a guess.
_WALK = 0.003
# Least time to empty a pack at the largest current, s; the level stands where nothing discharges.
_EMPTY = 100.0
# Change of each coefficient: 2 % of a fall of 12 % in 100 s.
_DRIFT = (0.02 * 0.12) ** 2 / 100.0 * np.eye(_SHARES.size)
# Known: relative error of the resistance below this; its least one, as the filter's own does not
# count how a pack warms.
_KNOWN, LEAST_ERROR = 0.33, 0.1
# Throttle at which an ESC ripples most (`ripple`).
_LOUDEST = 0.7
# Current over throttle: memory, s; time, s, in which deviations are one; prior deviation of
# its coefficients, in such deviations.
_MEMORY, _ONE, _WIDE = 120.0, 1.0, 30.0
# A current that was unknown for so long, s, is lost.
_HOLD = 1.0


class CurrentFilter:
    """Level and resistance of a supply from blocks with current; states level, use, falls."""

    def __init__(self) -> None:
        self._t = self._heard = self._unit = NAN
        self._largest = self._peak = 0.0
        # Current at once and after each of LAGS, A.
        self._drawn: list[float] = []
        self.lost = False
        # Of the last block: voltage with the load's answer taken out, V, and log density, nat.
        self.rest = self.density = NAN
        self.delay = LoadDelay(either=True)
        # Of current over throttle: time-weighted squares of 1, x, u, u^3, and of them and current.
        self._squares = np.zeros((5, 5))

    def time(self, block: Block) -> None:
        """Look how late the current is, of a block as it was heard."""
        self._peak = max(self._peak, abs(block.current))
        if self._peak >= _LEAST and math.isfinite(block.current) and self.delay.take(
                block.t, block.voltage, block.current / self._peak):
            self._unit = NAN

    def _begin(self, voltage: float) -> None:
        self._volts, self._unit = max(voltage, 1e-3), max(self._largest, _LEAST)
        self.noise = LoadNoise(self._volts)
        m, P = np.zeros(_STATES), np.zeros((_STATES, _STATES))
        P[1, 1] = 1.0 / _EMPTY ** 2
        P[2:, 2:] = _PRIOR * self._volts ** 2
        self._m, self._P = m, P
        self._settle(voltage)

    def _settle(self, v: float) -> None:
        """Open the level."""
        m, P = self._m, self._P
        h = self._regressors()
        m[0] = v - h[1:] @ m[1:]
        P[0, 1:] = P[1:, 0] = -P[1:, 1:] @ h[1:]
        P[0, 0] = (0.02 * self._volts) ** 2 + h[1:] @ P[1:, 1:] @ h[1:]

    def _regressors(self) -> FloatArray:
        return np.array([1.0, 0.0, *(-x / self._unit for x in self._drawn)])

    def take(self, block: Block, cells: float, *, fresh: bool) -> None:
        """Take a block (cells in series); fresh: time or supply may be another."""
        x, self.density = block.current, NAN
        if not math.isfinite(x):
            if not block.t - self._heard <= _HOLD:
                self.lost = True
            return
        lost, self.lost, self._heard = self.lost or fresh, False, block.last
        self._largest = max(self._largest, abs(x))
        if lost or not self._drawn:
            # As if steady: a current that does not move then tells nothing.
            self._drawn = [x] * (1 + len(LAGS))
        else:
            self._drawn = _lagged(self._drawn, x, block.t - self._t)
        dt, self._t = block.t - self._t, block.t
        if self._largest < _LEAST:
            return
        if math.isfinite(block.throttle) and not lost:
            h = np.array([1.0, *static(block.throttle)[:3], x])
            self._squares = self._squares * math.exp(-dt / _MEMORY) + dt * np.outer(h, h)
        if not self._largest <= _MORE * self._unit:
            self._begin(block.voltage)
        elif lost:
            self._settle(block.voltage)
        else:
            self._follow(block, dt, cells)
        self._load = self._drawn[0] / self._largest
        self.rest = block.voltage - float(self._regressors()[2:] @ self._m[2:])

    def _follow(self, block: Block, dt: float, cells: float) -> None:
        m, P = self._m, self._P
        x = self._drawn[0] / self._unit
        used = x * dt * cells * float(np.interp(m[0] / cells, LEVELS, SLOPES))
        m[0] -= used * m[1]
        P[0] -= P[1] * used
        P[:, 0] -= P[:, 1] * used
        P[0, 0] += (_WALK * cells) ** 2 * dt
        P[2:, 2:] += _DRIFT * (self._volts ** 2 * dt)
        h = self._regressors()
        noise = self.noise
        # The noise follows the current as it follows throttle: most at the largest.
        now = self._drawn[0] / self._largest
        u, du = _LOUDEST * abs(now), abs(now - self._load)
        R = noise.variance(u, du, block.n)
        e = block.voltage - float(h @ m)
        g = P @ h
        s = float(h @ g)
        if not 0.0 <= s < DIVERGED:
            self._begin(block.voltage)
            return
        scale = max(1.0, noise.scale)
        z = max(-CLIP, min(CLIP, e / math.sqrt(s + R * scale)))
        self.density = log_density(z, s + R * scale)
        total = s + R * scale * (1.0 + noise.correlation) / (1.0 - noise.correlation)
        total *= max(1.0, abs(e) / math.sqrt(total) / CLIP)
        noise.learn(e, s, u, du, block.n, block.within)
        noise.follow(z)
        m += g * (e / total)
        P -= g[:, None] * (g / total)

    @property
    def resistance(self) -> tuple[float, float]:
        """Return the resistance within 0.1 s, Ohm, and its standard error; NaN: not known."""
        if math.isnan(self._unit):
            return NAN, NAN
        value = abs(float(self._m[2] + self._m[3]))
        error = math.sqrt(float(self._P[2:4, 2:4].sum()) * max(1.0, self.noise.scale))
        if not 0.0 < error < _KNOWN * value:
            return NAN, NAN
        return value / self._unit, max(error, LEAST_ERROR * value) / self._unit

    def sag(self, throttle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sag, V, by the current that goes with throttle, and its standard error."""
        ohm, ohm_se = self.resistance
        A = self._squares[:4, :4] + np.diag([0.0, *[_ONE / _WIDE ** 2] * 3])
        inverse = np.linalg.pinv(A)
        a = inverse @ self._squares[:4, 4]
        left = max(0.0, float(self._squares[4, 4] - a @ self._squares[:4, 4]))
        left = left / max(float(A[0, 0]), _ONE)
        H = static(throttle)[:, :3]
        drawn = math.copysign(1.0, float(self._m[2] + self._m[3])) * (H @ a[1:])
        variance = left * _ONE * np.einsum('ij,jk,ik->i', H, inverse[1:, 1:], H)
        return ohm * drawn, np.sqrt((ohm_se * drawn) ** 2 + ohm * ohm * variance)

    @property
    def level(self) -> float:
        """Return the open-circuit voltage, V."""
        return float(self._m[0])

    def path(self, t: FloatArray, current: FloatArray) -> FloatArray:
        """Return the mean voltage ahead, V, at stamps, s, from the current there, A."""
        drawn, now, out = self._drawn, self._t, np.full(t.size, NAN)
        if math.isfinite(self._unit):
            for k, (stamp, x) in enumerate(zip(t.tolist(), current.tolist())):
                drawn, now = _lagged(drawn, x, max(0.0, stamp - now)), max(now, stamp)
                out[k] = self._m[0] - np.array(drawn) @ self._m[2:] / self._unit
        return out


def _lagged(drawn: list[float], x: float, dt: float) -> list[float]:
    return [x, *(x + (low - x) * math.exp(-dt / tau) for low, tau in zip(drawn[1:], LAGS))]
