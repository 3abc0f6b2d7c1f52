"""
The voltage under load, learned in flight by a Kalman filter, without a relaxation rate.

Limits: throttle more than 200 ms late, or sampled below 7 Hz, makes the sag too small; outside the
throttle range flown, the sag is extrapolated; changes of the true sag are followed within minutes.
doc/load.md has the equations and the figures.
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import (
    CELL, cells_in_series, INRUSH_TIME, LAG, LAGS, LEVELS, LINEAR_LAGS, LoadStart, POWER, ripple,
    SLOPES, usual_coefficients)
from ou_monitor.online.load.blocks import (
    CLIP, DIVERGED, EQUAL, LoadBlock, LoadBlocks, LoadChange, LoadDelay, LoadNoise, log_density)
from ou_monitor.online.load.current_filter import CurrentFilter, UNKNOWN_HELD
from ou_monitor.online.load.model_watch import (
    BINS, compare, LoadContrasts, ModelComparison, NEAR, OTHER_LEVEL, other_pack, SIZE_ERROR)
from ou_monitor.online.load.supply_load import (
    Basis, hold, LoadState, LoadStatus, rising, static, SupplyLoad, TABLE)
from ou_monitor.records import FloatArray, NAN
from ou_monitor.timeline import MOST_CURRENT, MOST_THROTTLE, plausible

# Random walk of the level, V per sqrt(s) and cell: usual, as in an OU of 4.6 mV and 20 s (from the
# batch fit); and for a nearly empty pack (chosen on bf_hiro_4s; 0.02 to 0.05 work).
_WALK, _FAST_WALK = 0.0015, 0.03
# Distance between the level and a `FastLevel` that predicts better, V per cell, above which the
# level uses the fast walk too.  With 0.005, a sag that appears when motors are armed was learned
# late; with 0.01, a fall of the level was still taken for sag (simulated packs that empty in their
# last 8 to 30 s).
_BEHIND = 0.0075
# `FastLevel`: prediction time, s; ratio of mean square errors below which it is used; memory, s;
# minimum time compared, s; interval of predictions, s.
_AHEAD, _PAYS, _COMPARED, _LEAST_COMPARED, _EVERY = 1.0, 0.98, 30.0, 10.0, 0.1
# Variance of the change of the coefficients per second: all in common, 25 % in 100 s; each alone,
# 2 % of the full sag in 100 s.
_WARMING, _CHANGE = 0.25 ** 2 / 100.0, 0.02 ** 2 / 100.0
# Time constant with which the scale of the load follows the level, s.  If it were shorter, each
# correction of the level would change the regressors even at constant throttle, and the filter
# would learn from these changes.
_RESIZE = 30.0
# Memory of the throttle flown, s.
_FLOWN_MEMORY = 120.0
# The sag counts as known if its error over the throttle range flown is below the first share of
# the sag (raised from 0.25 because of one recording), or below the second share of the noise.
_SAG_SHARE, _NOISE_SHARE = 0.33, 0.5
# Minimum range of throttle flown for an estimate of the sag.
_MOVED = 0.02
# Minimum relative error of the sag, because the filter's own standard error, which omits changes
# during a flight, was up to 9 times too small.
_LEAST_ERROR = 0.1
# Gap, s, after which the level is unknown: the battery may have been changed.
_PAUSE = 60.0
# Ratio of two levels, up or down, above which the battery belongs to another craft.
_OTHER_CRAFT = 1.6
# Relative variance of the size of the sag on another day.
_OTHER_DAY = 0.2 ** 2
# dE/ds of a cell, V, at each 10 mV of open-circuit voltage from 3.4 V.
_LOWEST, _PER_VOLT = 3.4, 100.0
_SLOPE_AT = np.interp(_LOWEST + np.arange(91) / _PER_VOLT, LEVELS, SLOPES).tolist()
_MEAN, _COV, _SIZE = usual_coefficients()
_STATES = 2 + _MEAN.size
# Variance of the changes of each coefficient per second, relative to the square of the steady sag.
_DRIFT = _CHANGE * np.eye(_MEAN.size) * (_SIZE / _MEAN[:-1].sum()) ** 2


class FastLevel:
    """A level that follows faster than the filter's level, for use while it predicts better."""

    def __init__(self) -> None:
        # Stamp, s; level as if nothing had been discharged, V, and its variance, V^2; fall by
        # discharge, V; time compared, s.
        self._t = self._level = self._variance = NAN
        self._drawn = self._since = 0.0
        # Stamp, level of the filter, and faster level; mean squares of the errors of both, V^2.
        self._past: deque[tuple[float, float, float]] = deque()
        self._errors = (0.0, 0.0)
        self._better = False

    def fall(self, volts: float) -> None:
        """Lower the level by a fall due to the charge drawn, V."""
        self._drawn += volts

    def take(self, t: float, rest: float, variance: float, level: float, walk: float) -> None:
        """Take a rest voltage, V, its variance, the filter's level, and walk, V per sqrt(s)."""
        rest, level = rest + self._drawn, level + self._drawn
        if math.isnan(self._t):
            self._t, self._level, self._variance = t, level, variance
        dt, self._t = t - self._t, t
        prior = self._variance + walk ** 2 * dt
        gain = prior / (prior + variance)
        self._level += gain * (rest - self._level)
        self._variance = prior * (1.0 - gain)
        past = self._past
        if not past or t - past[-1][0] >= _EVERY:
            past.append((t, level, self._level))
        while len(past) > 1 and past[1][0] <= t - _AHEAD:
            past.popleft()
        if past[0][0] <= t - _AHEAD:
            share = -math.expm1(-dt / _COMPARED)
            slow, fast = (old + share * ((rest - one) ** 2 - old)
                          for old, one in zip(self._errors, past[0][1:]))
            self._errors, self._since = (slow, fast), self._since + dt
            self._better = self._since > _LEAST_COMPARED and fast < _PAYS * slow

    def of(self, level: float, variance: float) -> tuple[float, float]:
        """Return the better level, the filter's or this one, V, and its variance, V^2."""
        return (self._level - self._drawn, self._variance) if self._better else (level, variance)


def _beyond(flown: tuple[float, float], error: FloatArray) -> FloatArray:
    """Return errors over TABLE, raised so that they do not decrease above the throttles flown."""
    # They might decrease there, because the correction of a sag, which counts as an error, may
    # change sign.
    low, high = np.searchsorted(TABLE, flown, 'right').tolist()
    return np.append(error[:high], np.maximum.accumulate(
        np.append(error[low - 1:high].max(), error[high:]))[1:])


class LoadFilter:
    """Level, sag and noise of a supply, sample by sample."""

    # States: level, V; discharge per load, 1/s; coefficients, V, as in `LoadStart`.

    def __init__(self) -> None:
        self._start: LoadStart | None = None
        self._t = self._last = self._throttle = NAN
        self._blocks = LoadBlocks()
        self._opening = False
        # None until a current has been measured.
        self._current: CurrentFilter | None = None
        self._delay = LoadDelay()
        # Blocks whose load has not arrived yet, and blocks whose load may still be needed.
        self._waiting: deque[LoadBlock] = deque()
        self._received: deque[LoadBlock] = deque()
        # Log density of the last block, nats; mean gain by using the current; time compared, s.
        self._density, self._better, self._compared = NAN, NAN, 0.0

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None,
             current: npt.ArrayLike | None = None) -> None:
        """Add samples in order, s, V, 0..1, A; an unknown load keeps its last value for 1 s."""
        # For few samples, this is several times as fast as `broadcast_arrays`.
        columns = np.full((4, np.size(t)), NAN)
        for row, given in zip(columns, (t, voltage, throttle, current)):
            if given is not None:
                row[:] = given
        columns[2] = np.clip(plausible(columns[2], MOST_THROTTLE), 0.0, 1.0)
        columns[3] = plausible(columns[3], MOST_CURRENT)
        for block in self._blocks.push(columns):
            self._arrive(block)

    def begin_with(self, start: LoadStart | None) -> None:
        """Start from the model of another flight; has no effect after the first voltage."""
        if not math.isfinite(self._t):
            self._start = start
            self._delay = LoadDelay(0.0 if start is None else start.delay)

    def new_time_line(self) -> None:
        """Start a new time line: keep coefficients and noise, re-estimate the level."""
        self._blocks.forget()
        self._waiting.clear()
        self._received.clear()
        self._delay.forget()
        if self._current is not None:
            self._current.delay.forget()
        self._opening = math.isfinite(self._t)

    def _arrive(self, block: LoadBlock) -> None:
        """Pair each block with the throttle and the current received `delay` later."""
        if math.isfinite(block.throttle) and self._delay.take(
                block.t, block.voltage, block.throttle ** POWER):
            # Coefficients learned with the old delay are wrong, and their errors too small.
            self._forget()
        if self._current is None and math.isfinite(block.current):
            self._current = CurrentFilter()
        if self._current is not None:
            self._current.time(block)
        late = self._delay.delay, 0.0 if self._current is None else self._current.delay.delay
        if not any(late) and not self._waiting:
            self._take(block)
            return
        self._waiting.append(block)
        self._received.append(block)
        while self._waiting and self._waiting[0].t + max(late) <= block.last:
            first = self._waiting.popleft()
            while len(self._received) > 1 and self._received[1].last <= first.t + min(late):
                self._received.popleft()
            throttle, current = (next(
                one for one in reversed(self._received)
                if one.last <= first.t + by or one is self._received[0]) for by in late)
            self._take(replace(first, throttle=throttle.throttle, current=current.current))

    def _take(self, block: LoadBlock) -> None:
        """Take one block: the very first, the first of a new time line, or a later one."""
        u, before, self._density = block.throttle, self._t, NAN
        fresh = self._opening or not block.t - self._t <= _PAUSE
        if not math.isfinite(self._t):
            self._begin(block.voltage, u)
        else:
            self._opening = self._opening or block.t - self._t > _PAUSE
            if math.isfinite(u):
                self._known_at = block.last
            elif not self._opening and block.t - self._known_at <= UNKNOWN_HELD:
                u = self._throttle
            if self._opening or math.isfinite(u) is not math.isfinite(self._throttle):
                self._open(block.voltage, u)
            else:
                du = abs(u - self._throttle)
                pieces = [(block.t, u)]
                if u != self._throttle and self._last > self._t:
                    # The previous throttle lasted to the end of its block.
                    pieces.insert(0, (self._last, self._throttle))
                self._throttle = u
                self._predict(pieces)
                self._correct(block, du)
        if self._current is not None:
            self._current.take(block, self._cells, fresh=fresh)
            self._compare(self._current, block.t - before)
        self._t, self._last, self._throttle = block.t, block.last, u
        self._known_at = block.last if math.isfinite(block.throttle) else self._known_at

    def _compare(self, current: CurrentFilter, dt: float) -> None:
        """Update the gain in log density by using the current instead of throttle."""
        if current.lost:
            self._better, self._compared = NAN, 0.0
        gain = current.density - self._density
        if math.isfinite(gain):
            self._compared += dt
            share = max(-math.expm1(-dt / _COMPARED), dt / self._compared)
            self._better = gain if share == 1.0 else self._better + share * (gain - self._better)

    def _begin(self, v: float, u: float) -> None:
        """Start a flight with the prior, scaled by the first voltage."""
        self._volts = max(v, 1e-3)
        # A supply below 2.5 V is not a lithium cell, so scale the curve of a cell.
        self._cells = float(cells_in_series(self._volts)) if self._volts > 2.5 else \
            self._volts / CELL
        start = self._start
        if start is not None and (
                1.0 / OTHER_LEVEL < self._volts / start.volts < OTHER_LEVEL):
            self._cells = start.cells
        else:
            self._start = None
        # Whether throttle has been known since the start.
        self._loaded = math.isfinite(u)
        self._known_at, self._highest = -math.inf, NAN
        # For each bin of throttle: seconds, samples, and sum of squared residuals, V^2.
        self._flown = np.zeros((3, BINS + 1))
        self._m = np.zeros(_STATES)
        self._factor = 1.0
        self._forget()
        self._settle(v, u)

    def _forget(self) -> None:
        """Reset coefficients and noise to the prior; the next block sets the level again."""
        self._contrasts = LoadContrasts()
        # Noise with known throttle, and with unknown throttle, whose effect then counts as noise.
        self._noise, self._other = LoadNoise(self._volts), LoadNoise(self._volts)
        # Time for which throttle has been known, s.
        self._seen = 0.0 if self._start is None else math.inf
        self._opening = True
        m, P = np.zeros(_STATES), np.zeros((_STATES, _STATES))
        m[2:], P[2:, 2:] = _MEAN * self._volts, _COV * self._volts ** 2
        # Prior of the discharge: 350 s at a mean load of 0.23, within a factor of two.
        m[1] = 1.0 / 80.0
        P[1, 1] = m[1] ** 2
        m[0] = self._m[0]
        self._m, self._P = m, P
        start = self._start
        if start is not None:
            self._noise = LoadNoise(self._volts, start.log_variance)
            m[1:] = start.discharge, *start.coefficients
            P[2:, 2:] = start.covariance + _OTHER_DAY * np.outer(m[2:], m[2:])

    def _open(self, v: float, u: float) -> None:
        """Re-estimate the level after a pause, a new time line, or a start or end of throttle."""
        here = float(self._m[0])
        other = self._opening and not here / _OTHER_CRAFT < v < here * _OTHER_CRAFT
        if other or (math.isfinite(u) and not self._loaded):
            self._begin(v, u)
            return
        if self._opening:
            # The battery may have been changed.
            self._contrasts, self._highest = LoadContrasts(), NAN
        if math.isfinite(u) is not math.isfinite(self._throttle):
            self._noise, self._other = self._other, self._noise
        self._settle(v, u)

    def _settle(self, v: float, u: float) -> None:
        """Set the level from one voltage, V, and the coefficients."""
        self._opening, self._bias, self._throttle = False, 0.0, u
        self._change = LoadChange()
        self._fast = FastLevel()
        held = u if math.isfinite(u) else 0.0
        self._lagged = self._settled = held
        x = held ** POWER
        # The state of the slowest lag is unknown: use the mean of no load and a steady load.
        self._lags = [x] * (len(LAGS) - 1) + [0.5 * x] + [held] * len(LINEAR_LAGS)
        m, P = self._m, self._P
        h = self._regressors()
        m[0] = self._rest = v - float(h[2:] @ m[2:])
        if math.isnan(self._highest) and math.isfinite(u):
            self._highest = float(m[0])
        # The level is computed from the voltage, so it shares the errors of the coefficients.
        P[0, 1:] = P[1:, 0] = -P[1:, 1:] @ h[1:]
        P[0, 0] = (0.02 * self._volts) ** 2 + h[1:] @ P[1:, 1:] @ h[1:]

    def _resize(self, dt: float) -> None:
        """Scale the load over dt, s: a propeller draws less at a lower level."""
        level = min(4.3, max(3.2, float(self._m[0]) / self._cells))
        self._factor += ((level / CELL) ** (POWER - 1.0) - self._factor) * (
            -math.expm1(-dt / _RESIZE))

    def _regressors(self) -> FloatArray:
        u, g = self._lagged, -self._factor
        if math.isnan(self._throttle):
            # If throttle is unknown, the level is the voltage under the present load.
            g = 0.0
        return np.array([1.0, 0.0, g * u ** POWER, g * u, g * u ** 3,
                         *(g * x for x in self._lags), g * max(u - self._settled, 0.0)])

    def _advance(self, dt: float, u: float) -> float:
        """Advance the regressors by dt, s (exact once `LAG` has settled); return the load."""
        self._lagged = u + (self._lagged - u) * math.exp(-dt / LAG)
        self._settled = self._lagged + (self._settled - self._lagged) * math.exp(
            -dt / INRUSH_TIME)
        x = self._lagged ** POWER
        loads = (x,) * len(LAGS) + (self._lagged,) * len(LINEAR_LAGS)
        self._lags = [load + (low - load) * math.exp(-dt / tau) for load, low, tau in zip(
            loads, self._lags, LAGS + LINEAR_LAGS)]
        return float(x)

    def _fall(self, level: float) -> float:
        """Return the fall of the level per unit of charge, V, for all cells in series."""
        place = int((level / self._cells - _LOWEST) * _PER_VOLT + 0.5)
        return self._cells * float(_SLOPE_AT[min(len(_SLOPE_AT) - 1, max(0, place))])

    def _predict(self, pieces: list[tuple[float, float]]) -> None:
        """Predict over pieces: each has the stamp of its end, s, and its throttle."""
        m, P, used = self._m, self._P, 0.0
        dt = pieces[-1][0] - self._t
        if math.isnan(self._throttle):
            self._t = pieces[-1][0]
            P[0, 0] += (_WALK * self._cells) ** 2 * dt
            return
        self._seen += dt
        self._flown *= 1.0 - min(dt / _FLOWN_MEMORY, 1.0)
        for t, u in pieces:
            used += self._advance(t - self._t, u) * (t - self._t)
            self._flown[0, int(u * BINS + 0.5)] += t - self._t
            self._t = t
        used *= self._fall(float(m[0]))
        m[0] -= used * m[1]
        self._fast.fall(used * float(m[1]))
        P[0] -= P[1] * used
        P[:, 0] -= P[:, 1] * used
        self._resize(dt)
        # A fall that the level cannot follow would be taken for sag.  In a gap, a pack may recover
        # by more than its random walk: by up to 2 % in a minute.
        behind = abs(self._fast.of(float(m[0]), 0.0)[0] - float(m[0])) > _BEHIND * self._cells
        P[0, 0] += ((_FAST_WALK if behind else _WALK) * self._cells) ** 2 * dt + (
            0.02 * self._volts) ** 2 * max(0.0, dt - 2.0) / 60.0
        a = m[2:]
        # Steady sag at full throttle, V.  Use its expected square, so that a small sag can grow.
        sag = float(a[:-1].sum())
        square = sag * sag + max(0.0, float(P[2:-1, 2:-1].sum()))
        P[2:, 2:] += dt * (_WARMING * a[:, None] * a + square * _DRIFT)

    def _correct(self, block: LoadBlock, du: float) -> None:
        """Take a block whose throttle differs by du from the previous block's."""
        m, P, noise = self._m, self._P, self._noise
        u = 0.0 if math.isnan(self._throttle) else self._throttle
        du = 0.0 if math.isnan(du) else du
        R = noise.variance(u, du, block.n)
        h = self._regressors()
        e = block.voltage - float(h @ m)
        g = P @ h
        s = float(h @ g)
        if not 0.0 <= s < DIVERGED:
            self._begin(block.voltage, self._throttle)
            return
        scale = max(1.0, noise.scale)
        score = e / math.sqrt(s + R * scale)
        # Correlated innovations (ADC steps, errors of the model) contain less information.
        total = s + R * scale * (1.0 + noise.correlation) / (1.0 - noise.correlation)
        noise.see(block.voltage)
        total += noise.rounding
        total *= max(1.0, abs(e) / math.sqrt(total) / CLIP)
        noise.learn(e, s, u, du, block.n, block.within)
        if math.isfinite(self._throttle):
            self._contrasts.take(block.t, block.voltage, h[2:], total,
                                 float(m[0]) / self._cells)
            self._highest = max(self._highest, float(m[0]))
            # Use only the share of the error that is due to noise, not to the state's uncertainty.
            share = R / (s + R)
            square = share * block.n * min(abs(e), self._volts) ** 2
            square += (block.n - 1) * block.within if block.n > 1 else 0.0
            self._flown[1:, int(u * BINS + 0.5)] += share * block.n, share * square
            if du < EQUAL:
                self._contrasts.take_noise(u, share * block.n, share * square * min(
                    1.0, CLIP ** 2 / max(score * score, 1.0)))
        clipped = max(-CLIP, min(CLIP, score))
        noise.follow(clipped)
        self._density = log_density(clipped, s + R * scale)
        # After large errors of one sign for half a second, perhaps due to another battery, let the
        # level move.
        self._bias += 0.1 * (max(-6.0, min(6.0, score)) - self._bias)
        if abs(self._bias) > 3.0:
            P[0, 0] += (0.05 * self._volts) ** 2
            self._bias = 0.0
        rest = block.voltage - float(h[2:] @ m[2:])
        if self._change.take(block.t, rest, float(h[2])):
            P[2:, 2:] += _COV * self._volts ** 2
            self._noise = LoadNoise(self._volts)
            self._delay.forget()
        self._fast.take(block.t, rest, total, float(m[0]), _FAST_WALK * self._cells)
        m += g * (e / total)
        P -= g[:, None] * (g / total)
        self._rest = block.voltage - float(h[2:] @ m[2:])

    def _deviations(self) -> tuple[float, ...]:
        """Return the rms that the load does not explain, V, in each bin of throttle."""
        b, u = self._noise.log_variance, np.arange(BINS + 1) / BINS
        if math.isnan(self._throttle):
            return (math.exp(0.5 * b[0]),) * u.size
        law = np.exp(b[0] + b[1] * ripple(u))
        seconds, samples, squares = self._flown
        # For throttles flown for less than about a second, use the law at constant throttle.
        known = float(samples.sum()) / max(float(seconds.sum()), 1.0)
        near = [np.convolve(one, np.ones(NEAR), 'same') for one in (samples, squares)]
        return tuple(np.sqrt((near[1] + known * law) / (near[0] + known)).tolist()) if known \
            else tuple(np.sqrt(law).tolist())

    def _between(self, share: float) -> tuple[float, float]:
        """Return the range of throttles flown, without a share of the time at either end."""
        total = np.cumsum(self._flown[0])
        if not total[-1] > 0.0:
            return self._throttle, self._throttle
        low, high = np.searchsorted(total, (share * total[-1], (1.0 - share) * total[-1]))
        return float(low) / BINS, float(high) / BINS

    def load(self) -> SupplyLoad:
        """Return the present result."""
        if not math.isfinite(self._t):
            return SupplyLoad()
        a, C = self._sag_law()
        H = static(TABLE, hold(self._seen))
        raw = H @ a
        sag = np.maximum.accumulate(H @ rising(a, C, H))
        low, high = self._flown_range()
        # The correction of a negative or decreasing sag counts as an error.
        error = _beyond((low, high), np.sqrt(np.maximum(
            np.einsum('ij,jk,ik->i', H, C, H), (sag - raw) ** 2)))
        basis, level, rest = Basis.THROTTLE, self._level, self._rest
        resistance = resistance_se = at_once = NAN
        if self._current is not None:
            resistance, resistance_se = self._current.resistance
            if math.isfinite(resistance):
                at_once = self._current.at_once
                if self._better > 0.0:
                    basis, level, rest = Basis.CURRENT, self._current.level, self._current.rest
        load = SupplyLoad(
            LoadStatus.STILL, level, rest, resistance, resistance_se, at_once, basis=basis,
            flown=(low, high),
            _sag=tuple(sag.tolist()),
            _sag_se=tuple(np.maximum(error, _LEAST_ERROR * sag).tolist()),
            _noise=self._deviations(), _range=self._between(0.02),
            delay=self._delay.delay)
        if math.isnan(self._throttle):
            load = replace(load, status=LoadStatus.NO_THROTTLE,
                           basis=basis if basis is Basis.CURRENT else Basis.NONE)
            return load if self._loaded else replace(load, _sag=(), _sag_se=())
        if high - low >= _MOVED:
            status, most = self._by_throttle(low, high)
            load = replace(load, status=status)
            if status is not LoadStatus.KNOWN and basis is Basis.CURRENT and self._current:
                load = self._by_current(load, self._current, most)
        return load

    @property
    def known(self) -> bool:
        """Whether the sag is known: as `load().known`, but several times as fast."""
        low, high = self._flown_range() if math.isfinite(self._t + self._throttle) else (0.0, 0.0)
        return high - low >= _MOVED and (
            self._by_throttle(low, high)[0] is LoadStatus.KNOWN
            or self._current is not None and self.load().known)

    def _sag_law(self) -> tuple[FloatArray, FloatArray]:
        """Return coefficients of the static sag, V, and their covariance."""
        scale = max(1.0, (self._noise if math.isfinite(self._throttle) else self._other).scale)
        return (self._m[2:-1] * self._factor, self._P[2:-1, 2:-1] * self._factor ** 2 * scale)

    def _flown_range(self) -> tuple[float, float]:
        low, high = self._between(0.1)
        if high - low < _MOVED:
            # Include short climbs, which may have determined the sag.
            low, high = self._between(0.02)
        return self._start.flown if high - low < _MOVED and self._start is not None else (
            low, high)

    def _by_throttle(self, low: float, high: float) -> tuple[LoadStatus, float]:
        """Return the status by throttle alone, and the error, V, that is allowed for any sag."""
        (a, C), b, held = self._sag_law(), self._noise.log_variance, hold(self._seen)
        d = static(high, held) - static(low, held)
        swing, swing_se = float(d @ a), math.sqrt(max(0.0, float(d @ C @ d)))
        most = _NOISE_SHARE * math.exp(0.5 * (b[0] + b[1] * ripple(0.5 * (low + high))))
        limit = max(_SAG_SHARE * swing, most)
        if swing < -2.0 * swing_se:
            return LoadStatus.RISES, most
        if swing_se >= limit:
            return LoadStatus.UNCERTAIN, most
        return (LoadStatus.NO_RELATION if swing < 2.0 * swing_se or self._delay.unrelated else
                LoadStatus.KNOWN), most

    @property
    def _level(self) -> float:
        """Return the level that predicts better, V."""
        return self._fast.of(float(self._m[0]), 0.0)[0]

    def _by_current(self, load: SupplyLoad, current: CurrentFilter, most: float) -> SupplyLoad:
        """Return the load with the sag from the current expected at each throttle."""
        raw, se = current.sag(TABLE)
        sag = np.maximum.accumulate(np.maximum(raw, 0.0))
        error = np.maximum(_beyond(load.flown, np.hypot(se, sag - raw)), _LEAST_ERROR * sag)
        at = np.interp(load.flown, TABLE, error)
        swing = np.diff(np.interp(load.flown, TABLE, sag))
        known = float(np.max(at)) < max(_SAG_SHARE * float(swing[0]), most)
        return replace(load, status=LoadStatus.KNOWN if known else LoadStatus.UNCERTAIN,
                       _sag=tuple(sag.tolist()), _sag_se=tuple(error.tolist()))

    def state(self) -> LoadState | None:
        """Return the state for prediction; None before the first voltage and throttle."""
        if not (math.isfinite(self._t) and math.isfinite(self._throttle)):
            return None
        mean, covariance = self._m.copy(), self._P * max(1.0, self._noise.scale)
        mean[0], covariance[0, 0] = self._fast.of(float(mean[0]), float(covariance[0, 0]))
        return LoadState(
            self._t, self._throttle, mean, covariance, tuple(self._lags), self._factor,
            self._fall(self._level),
            self._noise.log_variance, self._noise.ripple_se, self._deviations(),
            self._between(0.02))

    def learned(self) -> LoadStart | None:
        """Return start values for the next flight of this craft; None: the sag is unknown."""
        load = self.load()
        if not (load.known and self._m[0] > 0.0):
            return None
        # The coefficients follow the last half minute.  So average their size (relative error
        # SIZE_ERROR) with the size over the last five minutes, weighted by the errors.
        found, size, size_se = self._contrasts.against(self._m[2:]), 1.0, SIZE_ERROR
        if found.ratio > 0.0:
            size += (found.ratio - 1.0) / (1.0 + (found.se / SIZE_ERROR) ** 2)
            share = found.se / found.ratio
            size_se = share * SIZE_ERROR / math.hypot(share, SIZE_ERROR)
        ohm, ohm_se, noise, noise_se, level = np.nan_to_num((
            load.resistance, load.resistance_se, *self._contrasts.noise(load.flown), found.level)
        ).tolist()
        scale = size ** 2 * max(1.0, self._noise.scale)
        P = 0.5 * (self._P[2:, 2:] + self._P[2:, 2:].T) * scale
        return LoadStart(
            self._cells, float(self._m[0]), tuple((size * self._m[2:]).tolist()),
            tuple(tuple(row) for row in P.tolist()), max(0.0, float(self._m[1])),
            self._noise.b, load.flown, self._delay.delay, ohm, ohm_se,
            noise, noise_se, size_se, level, found.warming, found.warming_se)

    def against(self, start: LoadStart | None, date: str = '') -> ModelComparison:
        """Compare this flight with the model of another flight, learned on `date`."""
        if start is None or not math.isfinite(self._t) or math.isnan(self._highest):
            return ModelComparison()
        ohm = (NAN, NAN) if self._current is None else self._current.resistance
        return compare(self._contrasts, start, *ohm,
                       other_pack(start, self._highest, self._level), date, float(self._m[1]),
                       math.sqrt(max(0.0, float(self._P[1, 1])) * max(1.0, self._noise.scale)))

    def path(self, t: FloatArray, throttle: FloatArray | None,
             current: FloatArray | None = None) -> FloatArray:
        """Return the predicted mean voltage, V, from throttle or current, A; NaN: unknown."""
        if not math.isfinite(self._t):
            raise ValueError('no voltage has arrived: the prediction has no start')
        load, delay = (throttle, self._delay.delay) if current is None else (
            current, 0.0 if self._current is None else self._current.delay.delay)
        if load is None:
            raise ValueError('a path needs throttle or current')
        # The load at each time is the one received `delay` later; at the end, the last one.
        load = load[np.searchsorted(t, t + delay, 'right') - 1] if delay else load
        if current is not None and self._current is not None:
            return self._current.path(t, load)
        if current is not None or math.isnan(self._throttle):
            return np.full(t.size, NAN)
        kept = self._lagged, self._settled, self._lags
        now, level = self._t, self._level
        out = np.empty(t.size)
        for k in range(t.size):
            # Times before the last sample count as the last sample.
            dt = max(0.0, float(t[k]) - now)
            level -= self._m[1] * self._advance(dt, float(load[k])) * dt * self._fall(level)
            out[k] = level + self._regressors()[2:] @ self._m[2:]
            now = max(now, float(t[k]))
        self._lagged, self._settled, self._lags = kept
        return out
