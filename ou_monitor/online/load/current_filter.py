"""
Level and resistance of a supply from its measured current, by a Kalman filter.

Limits: scale and sign of the current are not corrected, so a wrong scale makes the resistance
wrong.  A load that follows throttle but bypasses the current sensor makes the resistance too high:
on a robot that draws 1 A, a further sag of 0.1 V at full throttle makes it 0.4 instead of 0.2 Ohm.
The stated error includes this effect only if throttle clearly explains a part of the residual.  A
constant current has no information.  (Throttle as a further regressor would absorb the other load,
but on quads with slow current sensors also at least half of the resistance.)
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.model.load import (
    CURRENT_SHARE_STD, CURRENT_SHARES, LAGS, LEVELS, POWER, SLOPES)
from ou_monitor.online.load.blocks import (
    CLIP, DIVERGED, LoadBlock, LoadDelay, LoadNoise, log_density)
from ou_monitor.online.load.supply_load import AT_ONCE, hold, reached
from ou_monitor.records import FloatArray, NAN

# Minimum current for starting the filter, A; factor by which the largest current must rise before
# the state is rescaled and the prior is applied again.
_LEAST, _MORE = 1e-2, 4.0
# Prior: standard deviation of the voltage drop at the largest current, relative to the voltage.
_FALL = 0.3
_PRIOR = _FALL ** 2 * (np.outer(CURRENT_SHARES, CURRENT_SHARES) + np.diag(CURRENT_SHARE_STD ** 2))
_DRAWN_STATES = 2 + CURRENT_SHARES.size
# Random walk of the level, V per sqrt(s) and cell: twice the walk in `LoadFilter`, because less is
# known about the discharge.
_DRAWN_WALK = 0.003
# Typical minimum time in which the largest current empties a pack, s; for the prior of the
# discharge.
_EMPTY = 100.0
# Variance of the change of each coefficient, per second: 2 % of a sag of 12 % in 100 s.
_DRAWN_DRIFT = (0.02 * 0.12) ** 2 / 100.0 * np.eye(CURRENT_SHARES.size)
# Relative error above which the resistance counts as unknown; minimum relative error, because the
# filter's own error omits the warming of a pack.
_KNOWN, LEAST_ERROR = 0.33, 0.1
# Throttle at which an ESC ripples most (`ripple`).
_LOUDEST = 0.7
# Regression of current on throttle: memory, s; correlation time of the residuals, s; prior
# standard deviation of the coefficients, in residuals.
_MEMORY, _ONE, _WIDE = 120.0, 1.0, 30.0
# Time constants, s, of the band in which throttle is tried as a further regressor; minimum share
# of the throttle's variance that current must leave unexplained.  Smaller shares are due to
# rounding or lag of the current (up to 0.0045 in simulated vehicles without a bypass, 5e-5 on
# hebi_x); 0.005 to 0.8 occurred on roma 1 and 3, ar8, jd, in_xr, js_11t, as_f60, euc_1, frc_ol_1,
# and regbot_28, 62 and 81.
_BAND, _APART = np.array([[1.0], [20.0]]), 5e-3
# Exponents of throttle tried for that regressor: the usual one, plus and
# minus up to about two of its standard deviations between crafts.
_POWERS = np.array([1.4, 1.6, 1.8, 2.0, 2.2])
# Time for which the last throttle or current is held if the present one is unknown, s.
UNKNOWN_HELD = 1.0


class CurrentFilter:
    """Level and resistance from blocks with current; states: level, discharge, voltage drops."""

    def __init__(self) -> None:
        self._t = self._known_at = self._unit = NAN
        # Largest current used and largest received; last current, A; time with current, s.
        self._largest = self._peak = self._before = self._seen = 0.0
        # Present current, and the current behind each of LAGS, A.
        self._drawn: list[float] = []
        self.lost = False
        # Of the last block: voltage without the response to load, V, and log density, nats.
        self.rest = self.density = NAN
        self.delay = LoadDelay(either=True)
        # Regression of current on throttle: weighted products of (1, x, u, u^3, current).
        self._squares = np.zeros((5, 5))
        # Weighted products of band-passed powers of throttle, current and voltage; the low-passes.
        self._beside = np.zeros((_POWERS.size + 2, _POWERS.size + 2))
        self._lags = np.zeros((2, 0))

    def time(self, block: LoadBlock) -> None:
        """Update the delay of the current from a block that is not yet paired with its load."""
        self._peak = max(self._peak, abs(block.current))
        if self._peak >= _LEAST and math.isfinite(block.current) and self.delay.take(
                block.t, block.voltage, block.current / self._peak):
            self._unit = NAN

    def _begin(self, voltage: float) -> None:
        self._volts, self._unit = max(voltage, 1e-3), max(self._largest, _LEAST)
        self.noise = LoadNoise(self._volts)
        m, P = np.zeros(_DRAWN_STATES), np.zeros((_DRAWN_STATES, _DRAWN_STATES))
        P[1, 1] = 1.0 / _EMPTY ** 2
        P[2:, 2:] = _PRIOR * self._volts ** 2
        self._m, self._P = m, P
        self._seen = 0.0
        self._settle(voltage)

    def _rescale(self) -> None:
        """Rescale the state to the largest current, and apply the prior again; keep the level."""
        m, P, ratio = self._m, self._P, self._largest / self._unit
        self._unit = self._largest
        m[1:] *= ratio
        P[1:] *= ratio
        P[:, 1:] *= ratio
        prior = np.zeros((_DRAWN_STATES - 1, _DRAWN_STATES - 1))
        prior[0, 0], prior[1:, 1:] = 1.0 / _EMPTY ** 2, _PRIOR * self._volts ** 2
        gain = P[:, 1:] @ np.linalg.inv(P[1:, 1:] + prior)
        m -= gain @ m[1:]
        P -= gain @ P[1:]

    def _settle(self, v: float) -> None:
        """Re-estimate the level from one voltage, V."""
        m, P = self._m, self._P
        h = self._regressors()
        m[0] = v - h[1:] @ m[1:]
        P[0, 1:] = P[1:, 0] = -P[1:, 1:] @ h[1:]
        P[0, 0] = (0.02 * self._volts) ** 2 + h[1:] @ P[1:, 1:] @ h[1:]

    def _regressors(self) -> FloatArray:
        return np.array([1.0, 0.0, *(-x / self._unit for x in self._drawn)])

    def take(self, block: LoadBlock, cells: float, *, fresh: bool) -> None:
        """Take a block (cells in series); fresh: on a new time line, or after a long pause."""
        x, self.density = block.current, NAN
        if not math.isfinite(x):
            if not block.t - self._known_at <= UNKNOWN_HELD:
                self.lost = True
            return
        # A single wild reading must not rescale the filter, so wait for a second one.
        alone = max(self._before, self._largest) < abs(x) / _MORE and self._largest >= _LEAST
        self._before = abs(x)
        if alone:
            return
        lost, self.lost, self._known_at = self.lost or fresh, False, block.last
        self._largest = max(self._largest, abs(x))
        if lost or not self._drawn:
            # Assume that the current was constant before, so that it has no information yet.
            self._drawn = [x] * (1 + len(LAGS))
        else:
            self._drawn = _lagged(self._drawn, x, block.t - self._t)
        dt, self._t = block.t - self._t, block.t
        if self._largest < _LEAST:
            return
        if math.isfinite(block.throttle) and not lost:
            u = block.throttle
            h = np.array([1.0, u ** POWER, u, u ** 3, x])
            self._squares = self._squares * math.exp(-dt / _MEMORY) + dt * h * h[:, None]
        begun = math.isfinite(self._unit)
        if not begun:
            self._begin(block.voltage)
        elif self._largest > _MORE * self._unit:
            self._rescale()
        if begun and lost:
            self._settle(block.voltage)
        elif begun:
            self._follow(block, dt, cells)
        self._load = self._drawn[0] / self._largest
        if math.isfinite(block.throttle):
            self._compare(np.array([*block.throttle ** _POWERS, x, block.voltage]),
                          0.0 if lost else dt)
        self.rest = block.voltage - float(self._regressors()[2:] @ self._m[2:])

    def _compare(self, now: FloatArray, dt: float) -> None:
        """Update the products that `_bypassed` uses; now: see `_beside`."""
        if not dt or not self._lags.size:
            self._lags = np.stack((now, now))
        self._lags = self._lags - np.expm1(-dt / _BAND) * (now - self._lags)
        changes = self._lags[0] - self._lags[1]
        self._beside = self._beside * math.exp(-dt / _MEMORY) + dt * changes * changes[:, None]

    @property
    def _bypassed(self) -> float:
        """Return the relative error of the resistance due to loads that bypass the sensor."""
        # The error is the relative change of the resistance with throttle as a further regressor,
        # times the share of the residual voltage that throttle explains.  Both factors are
        # computed after a band-pass, because throttle also explains fast errors of the sensor, and
        # the level changes slowly.
        # x is the power of throttle that the current follows best, so that a wrong exponent is not
        # mistaken for another load.
        B, n = self._beside, _POWERS.size
        best = int(np.argmax(B[:n, n] ** 2 / np.maximum(B.diagonal()[:n], 1e-300)))
        at = np.array([best, n, n + 1])
        (xx, xi, xv), (_, ii, iv), (_, _, vv) = B[np.ix_(at, at)].tolist()
        # Residual squares of voltage and x, and their residual product, after regression on
        # current.
        rest, moved, both = (vv - iv * iv / ii, xx - xi * xi / ii, xv - xi * iv / ii
                             ) if ii > 0.0 else (0.0, 0.0, 0.0)
        if not (rest > 0.0 and moved > _APART * xx and iv):
            return 0.0
        return float(abs(both / moved * xi / iv) * both * both / (moved * rest))

    def _follow(self, block: LoadBlock, dt: float, cells: float) -> None:
        m, P = self._m, self._P
        x = self._drawn[0] / self._unit
        self._seen += dt
        used = x * dt * cells * float(np.interp(m[0] / cells, LEVELS, SLOPES))
        m[0] -= used * m[1]
        P[0] -= P[1] * used
        P[:, 0] -= P[:, 1] * used
        P[0, 0] += (_DRAWN_WALK * cells) ** 2 * dt
        P[2:, 2:] += _DRAWN_DRIFT * (self._volts ** 2 * dt)
        h = self._regressors()
        noise = self.noise
        # Use the law of the noise over throttle, with the largest noise at the largest current.
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
        """Return the resistance after `hold`, Ohm, and its standard error; NaN: unknown."""
        if math.isnan(self._unit):
            return NAN, NAN
        h = self._reached()
        value = abs(float(h @ self._m[2:]))
        error = math.sqrt(float(h @ self._P[2:, 2:] @ h) * max(1.0, self.noise.scale))
        if 0.0 < error < _KNOWN * value:
            error = math.hypot(max(error, LEAST_ERROR * value), self._bypassed * value)
        if not 0.0 < error < _KNOWN * value:
            return NAN, NAN
        return value / self._unit, error / self._unit

    @property
    def at_once(self) -> float:
        """Return the resistance after `AT_ONCE`, Ohm, even if its error is large."""
        return abs(float(np.append(1.0, reached(AT_ONCE)) @ self._m[2:])) / self._unit

    def _reached(self) -> FloatArray:
        """Return the share of each coefficient's response that has developed after `hold`."""
        return np.append(1.0, reached(hold(self._seen)))

    def sag(self, throttle: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the sag, V, from the current expected at throttles, and its standard error."""
        ohm, ohm_se = self.resistance
        A = self._squares[:4, :4] + np.diag([0.0, *[_ONE / _WIDE ** 2] * 3])
        inverse = np.linalg.pinv(A)
        a = inverse @ self._squares[:4, 4]
        left = max(0.0, float(self._squares[4, 4] - a @ self._squares[:4, 4]))
        left = left / max(float(A[0, 0]), _ONE)
        H = np.stack([throttle ** POWER, throttle, throttle ** 3], axis=-1)
        drawn = math.copysign(1.0, float(self._reached() @ self._m[2:])) * (H @ a[1:])
        variance = left * _ONE * np.einsum('ij,jk,ik->i', H, inverse[1:, 1:], H)
        return ohm * drawn, np.sqrt((ohm_se * drawn) ** 2 + ohm * ohm * variance)

    @property
    def level(self) -> float:
        """Return the open-circuit voltage, V."""
        return float(self._m[0])

    def path(self, t: FloatArray, current: FloatArray) -> FloatArray:
        """Return the predicted mean voltage, V, at stamps, s, for the currents there, A."""
        drawn, now, out = self._drawn, self._t, np.full(t.size, NAN)
        if math.isfinite(self._unit):
            for k, (stamp, x) in enumerate(zip(t.tolist(), current.tolist())):
                drawn, now = _lagged(drawn, x, max(0.0, stamp - now)), max(now, stamp)
                out[k] = self._m[0] - np.array(drawn) @ self._m[2:] / self._unit
        return out


def _lagged(drawn: list[float], x: float, dt: float) -> list[float]:
    return [x, *(x + (low - x) * math.exp(-dt / tau) for low, tau in zip(drawn[1:], LAGS))]
