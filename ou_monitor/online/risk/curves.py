"""
What the supply does at the throttles flown so far: level and intensity as curves over throttle.

Limits: throttle stands for the load, so what else draws current counts as scatter; detail finer
than the distance of two nodes is not resolved; throttle that arrives late or seldom smears the
curves by as much as it moves meanwhile; a low-pass upstream makes the intensity too small, as it
does that of the estimate.  The mean is taken to follow throttle with the rail's own relaxation
time; samples within a step of throttle are left out.  Outside the range flown the curves go on
straight, with the error of the prior.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.online.risk.curve_filters import (
    BINS, CurvePrior, HatFilter, noise_variance, Squares, STEADY, Wander)
from ou_monitor.records import Estimate, Flag, FloatArray, NAN

# Nodes of the curves over throttle 0..1, and the times, s, in which the intensity at a throttle
# not flown is forgotten to 20 % and the sag there to 1 % of the voltage; the level common to all
# throttles is followed within seconds.
_NODES, FORGETTING, SHAPE_FORGETTING = 9, 300.0, 1800.0
# Samples are looked at in blocks of this length, s, and of this many samples or more.
_BLOCK, _FEWEST = 0.05, 32
# A slow source is not waited for longer than this, s.
_PATIENCE = 0.5
# Blocks are pooled into one observation over this time, s.
_POOL = 0.25
# Mean distance of throttle from what the rail has followed beyond which a block is left out,
# and the spread of throttle within a block beyond which it is.
_UNSETTLED = 0.05
_SPREAD = 0.125
# Throttle further outside 0..1 than this is in another unit, or broken.
_OUTSIDE = 0.05
# After a pause the rail is given this many relaxation times.
_SETTLE = 5.0
# Sigma at one throttle against that of the whole window: at most so different.
_RANGE = 30.0
# A pause without samples, s, and in steps, that starts the blocks afresh.
_PAUSE, _PAUSE_STEPS = 0.25, 10.0
# A step back in time, s, that is a clock set back; what time has gone by then is not known.
_BACK, _UNKNOWN_TIME = 1.0, 60.0
# Relaxation times in a block from which powers would lose digits or overflow.
_FAST = 100.0
# Samples that wait at most, when their stamps stand still.
_MOST = 65536
# The curves are told for at most so long after the last observation, s.
_AHEAD = 10.0
# Longest time that is believed to have gone by between two samples, s.
_LONGEST = 3600.0

# Level, as a share of the first voltage: sag of LiPo packs at full throttle is 5..20 %; discharge
# drifts 1..19 mV/s on packs of 8..25 V; cells recover within tens of seconds after a load.
_LEVEL = CurvePrior(common=1.0, slope=0.15, bend=0.05, change=0.01, walk=4e-4, drift=2e-3,
                    drift_time=30.0)
# ln(sigma): grows 3..13 times over the range of throttle and may fall again.
_INTENSITY = CurvePrior(common=1.0, slope=2.0, bend=1.0, change=0.2)


class CurvePoint(NamedTuple):
    """
    One point of a curve.

    Attributes
    ----------
    value : float
        Level, V, or ln(sigma) of sigma in V/sqrt(s); NaN before any data.
    se : float
        Standard error in the same unit.

    """

    value: float
    se: float


class Pool:
    """Means of blocks at one throttle."""

    def __init__(self) -> None:
        self.n = 0
        self.begin = self.end = self.time = 0.0
        self.voltage = self.throttle = self.apart = 0.0

    def add(self, n: int, begin: float, end: float, dt: float, voltage: float, throttle: float,
            apart: float) -> None:
        """Add a block of n samples."""
        if not self.n:
            self.begin = begin
        self.n += n
        self.end = end
        self.time += n * dt
        share = n / self.n
        self.voltage += share * (voltage - self.voltage)
        self.throttle += share * (throttle - self.throttle)
        self.apart += share * (apart - self.apart)


class LearnedCurves:
    """Level and noise intensity against throttle, learned in flight."""

    def __init__(self) -> None:
        self._level = HatFilter(_NODES, SHAPE_FORGETTING)
        self._intensity = HatFilter(_NODES, FORGETTING)
        self._pending: list[tuple[FloatArray, ...]] = []
        self._waiting, self._begin = 0, NAN
        self._newest = -math.inf
        self._clock = self._scale = NAN
        self._estimate: Estimate | None = None
        self._usable = False
        self._throttle_known = False
        self._followed, self._settled = NAN, -math.inf
        self._pool = Pool()
        self._squares = Squares()
        self._wander = Wander()

    @property
    def throttle_known(self) -> bool:
        """Whether any throttle has arrived since the start."""
        return self._throttle_known

    @property
    def scatter(self) -> tuple[float, float]:
        """Return `HatFilter.scatter` of level and intensity: 1 when the errors are right."""
        return self._level.scatter, self._intensity.scatter

    @property
    def extent(self) -> tuple[float, float]:
        """Return the lowest and the highest throttle with data, to 0.01; NaN without any."""
        at = np.flatnonzero((self._level.flown() > 1.0) & (self._intensity.flown() > 1.0))
        if not at.size:
            return NAN, NAN
        return at.item(0) / (BINS - 1), at.item(-1) / (BINS - 1)

    def update(self, t: npt.ArrayLike, voltage: npt.ArrayLike, throttle: npt.ArrayLike | None,
               estimate: Estimate) -> None:
        """Learn from samples."""
        self._usable = estimate.usable and min(estimate.alpha, estimate.sigma) > 0.0
        self._estimate = estimate if self._usable else self._estimate
        if throttle is None:
            return
        stamps, volts, load = _column(t), _column(voltage), _column(throttle)
        if load.size == 1 != stamps.size:
            load = np.full(stamps.shape, load.item(0))
        if not stamps.shape == volts.shape == load.shape or stamps.ndim != 1:
            raise ValueError('t, voltage and throttle must have one shape (n,): got '
                             f'{stamps.shape}, {volts.shape} and {load.shape}')
        if not stamps.size:
            return
        self._begin = self._begin if self._pending else stamps.item(0)
        self._pending.append((stamps, volts, load))
        self._waiting += stamps.size
        span = abs(stamps.item(-1) - self._begin)
        n = self._waiting
        if n > 1 and span * n >= _BLOCK * (n - 1) and (n >= _FEWEST or span > _PATIENCE):
            self._work_off()
        elif n > _MOST or not math.isfinite(span):
            self._work_off()
        else:
            # The caller may fill the same array again.
            self._pending[-1] = (stamps.copy(), volts.copy(), load.copy())

    def level_at(self, throttle: float) -> CurvePoint:
        """Return the mean level, V, at a throttle, for the newest sample's time."""
        values, errors = self.level_curve(np.array([throttle]))
        return CurvePoint(values.item(), errors.item())

    def sigma_at(self, throttle: float) -> CurvePoint:
        """Return ln(sigma), of sigma in V/sqrt(s), at a throttle."""
        values, errors = self.sigma_curve(np.array([throttle]))
        return CurvePoint(values.item(), errors.item())

    @property
    def wander(self) -> Wander:
        """Return how ln(sigma) goes beside the curve: where it is now, and how fast it walks."""
        return self._wander

    def level_curve(self, throttles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return levels and their standard errors, V, at throttles of shape (k,)."""
        return self._level.curve(throttles, self._ahead())

    def sigma_curve(self, throttles: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ln(sigma) and its standard errors at throttles of shape (k,)."""
        return self._intensity.curve(throttles, self._ahead())

    def _ahead(self) -> float:
        """Return the time, s, since the last observation."""
        return min(self._newest - self._clock, _AHEAD) if self._level.started else 0.0

    def seen_curve(self, throttles: FloatArray) -> npt.NDArray[np.bool_]:
        """Return where (k,) data within half a distance of nodes weigh more than the prior."""
        ratio = np.minimum(self._level.seen(), self._intensity.seen())
        known = np.isfinite(throttles)
        place = np.clip(np.where(known, throttles, 0.0), 0.0, 1.0) * (BINS - 1)
        return known & (ratio[(place + 0.5).astype(np.intp)] > 1.0)

    def _work_off(self) -> None:
        """Cut what has been collected into runs of even time, and those into blocks."""
        parts, self._pending, self._waiting = self._pending, [], 0
        if len(parts) == 1:
            t, v, u = parts[0]
        else:
            t, v, u = (np.concatenate(columns) for columns in zip(*parts))
        if not math.isfinite(float(v @ u)) or not math.isfinite(float(t @ u)):
            self._throttle_known = self._throttle_known or bool(np.isfinite(u).any())
            good = np.isfinite(t + v + u)
            if not good.any():
                return
            t, v, u = t[good], v[good], u[good]
        self._throttle_known = True
        steps = t[1:] - t[:-1]
        mean = (t.item(-1) - t.item(0)) / max(t.size - 1, 1)
        pause = max(_PAUSE, _PAUSE_STEPS * mean) if mean > 0.0 else _PAUSE
        if steps.size:
            shortest, longest = float(steps.min()), float(steps.max())
            if shortest > 0.0 and longest <= pause:
                self._run(t, v, u, pause, shortest > 0.5 * mean and longest < 1.5 * mean)
                return
        cuts = np.flatnonzero((steps > pause) | (steps <= 0.0)) + 1
        for part in np.split(np.arange(t.size), cuts):
            self._run(t[part], v[part], u[part], pause, False)

    def _run(self, t: FloatArray, v: FloatArray, u: FloatArray, pause: float,
             even: bool) -> None:
        """Take samples whose stamps rise without a pause; `even` when none were lost."""
        if t.item(0) <= self._newest:
            if self._newest - t.item(-1) > _BACK:
                # The clock was set back.
                self._close()
                self._elapse(_UNKNOWN_TIME)
                self._clock = t.item(0)
                self._followed = NAN
            else:
                if self._newest >= t.item(-1):
                    return
                late = int(np.searchsorted(t, self._newest, 'right'))
                t, v, u = t[late:], v[late:], u[late:]
        elif t.item(0) - self._newest > pause:
            self._followed = NAN
        e = self._estimate
        if e is not None and Flag.HELD_SAMPLES in e.flags and t.size > 1:
            fresh = np.append(True, v[1:] != v[:-1])
            t, v, u = t[fresh], v[fresh], u[fresh]
            even = False
        n = t.size
        self._newest = t.item(-1)
        if e is None or n < 2:
            self._followed = NAN
            return
        pieces = max(1, min(int((self._newest - t.item(0)) / _BLOCK), n // _FEWEST))
        edges = [n * k // pieces for k in range(pieces + 1)]
        for begin, end in zip(edges, edges[1:]):
            self._block(t[begin:end], v[begin:end], u[begin:end], e, even)

    def _block(self, t: FloatArray, v: FloatArray, u: FloatArray, e: Estimate,
               even: bool) -> None:
        """Take one block: what throttle did, the mean, and the squares of innovations."""
        n = t.size
        span = t.item(-1) - t.item(0)
        dt = span / (n - 1)
        a = e.alpha * dt
        low, high = float(u.min()), float(u.max())
        if math.isnan(self._followed):
            self._followed = u.item(0)
            self._settled = t.item(0) + _SETTLE / e.alpha
        # The rail follows throttle with its own relaxation time.
        before, given = self._followed, low
        if low == high:
            decay = -math.expm1(-a * n) / (a * n)
            mean_u = low + (before - low) * decay
            apart = abs(before - low) * decay
            self._followed = low + (before - low) * math.exp(-a * n)
        else:
            follow = _follow(u, before, a)
            mean_u, self._followed = float(follow.mean()), follow.item(-1)
            apart, given = float(np.abs(u - follow).mean()), float(u.mean())
        if (apart > _UNSETTLED or high - low > _SPREAD or t.item(0) < self._settled
                or low < -_OUTSIDE or high > 1.0 + _OUTSIDE):
            self._close()
            return
        # The intensity follows at once.
        mean_u, given = min(max(mean_u, 0.0), 1.0), min(max(given, 0.0), 1.0)
        pool = self._pool
        if pool.n and (abs(mean_u - pool.throttle) > STEADY
                       or t.item(-1) - pool.begin > 1.5 * _POOL):
            self._close()
            pool = self._pool
        pool.add(n, t.item(0), t.item(-1), dt, float(v.mean()), mean_u, apart)
        if self._usable:
            log_sigma, far = self._intensity.value(given), math.log(_RANGE * e.sigma)
            sigma = e.sigma if math.isnan(log_sigma) else math.exp(
                min(max(log_sigma, far - 2.0 * math.log(_RANGE)), far))
            self._squares.add(t, v, given, dt, e, even, sigma)
        if pool.end - pool.begin >= _POOL - 0.5 * _BLOCK:
            self._close()

    def _close(self) -> None:
        """Give what has been pooled to the filters."""
        pool, e = self._pool, self._estimate
        if not pool.n or e is None:
            return
        self._pool = Pool()
        middle = 0.5 * (pool.begin + pool.end)
        if math.isfinite(self._clock):
            self._elapse(min(middle - self._clock, _LONGEST))
        self._clock = middle
        found = self._squares.take(e, pool.throttle)
        if found is not None:
            throttle, value, variance = found
            if not self._intensity.started:
                self._intensity.start(value, _INTENSITY)
            expected, error = self.sigma_at(throttle)
            # What the curve itself does not know says nothing of all throttles together.
            self._wander.correct(value - expected, variance + error * error)
            self._intensity.correct(throttle, value, variance)
        if not self._level.started:
            self._scale = abs(pool.voltage) or 1.0
            self._level.start(pool.voltage, _LEVEL.scaled(self._scale))
        sigma = (math.exp(self._intensity.value(pool.throttle)) if self._intensity.started
                 else e.sigma)
        # Variance of the mean of n samples of an OU, as it adds up over many blocks.
        dt = pool.time / pool.n
        variance = (sigma * sigma / (2.0 * e.alpha * math.tanh(0.5 * e.alpha * dt))
                    + noise_variance(e)) / pool.n
        # The lag itself is known no better than to a factor.
        variance += (_LEVEL.slope * self._scale * pool.apart) ** 2
        self._level.correct(pool.throttle, pool.voltage, variance)

    def _elapse(self, dt: float) -> None:
        self._level.predict(dt)
        self._intensity.predict(dt)
        self._wander.elapse(dt)


def _follow(u: FloatArray, before: float, a: float) -> FloatArray:
    """Return throttle as the rail has followed it at each sample, at a rate a per sample."""
    phi = math.exp(-a)
    if a * u.size > _FAST:
        if a > _FAST:
            # It has forgotten all but the sample itself.
            return u
        # In parts whose growth is a number.
        follow, length = np.empty(u.size), max(int(_FAST / a), 1)
        for begin in range(0, u.size, length):
            part = _follow(u[begin:begin + length], before, a)
            follow[begin:begin + length], before = part, float(part[-1])
        return follow
    # Closed form of the recursion.
    growth = np.exp(a * np.arange(1.0, u.size + 1.0))
    total = (u * growth).cumsum()
    total *= 1.0 - phi
    total += before
    total /= growth
    return total


def _column(values: Any) -> FloatArray:
    """Return values as a float array of shape (n,)."""
    array = np.asarray(values, dtype=np.float64)
    return array.reshape(1) if array.ndim == 0 else array
