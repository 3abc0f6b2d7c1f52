"""
Group samples into blocks; learn the delay of throttle, changes of the response, and noise.

All samples of a block have the same throttle; at steady throttle, there are at most 67 blocks a
second.  Limits: an incomplete block is not returned, so a fast source is followed 20 ms late; of
several throttle changes within 20 ms, only the first three are resolved.

Delay: the voltage, without changes slower than a second, is correlated with throttle at assumed
delays of 0 to 200 ms.  The largest correlation determines the delay, unless the source is slower
than 7 Hz.  A new delay is adopted only if it leaves a quarter less variance than the present one.

Noise: ln variance = b . (1, ripple(u), sqrt|du|) for throttle u and its change du, with b learned
by Fisher scoring.  In a mean of n samples, the variance within a block is divided by n.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
import math
from operator import add

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.records import FloatArray, NAN

# Width of the bins, s: motors and pack respond more slowly.
WIDTH = 0.02
# Samples at least this far apart, s, are separate blocks.
_APART = 0.75 * WIDTH
# Difference below which throttles count as equal; their sags differ by less than an ADC step.
EQUAL = 0.01
# Maximum number of throttle changes within a bin that end a block.
_CHANGES = 3


@dataclass(frozen=True, slots=True)
class LoadBlock:
    """Consecutive samples with one throttle."""

    # Mean and last stamp, s.
    t: float
    last: float
    voltage: float  # Mean voltage, V
    throttle: float  # Mean throttle, 0..1; NaN if unknown
    current: float  # Mean of the known currents, A; NaN if none is known
    n: int  # Number of samples
    within: float  # Variance of a sample about the mean, V^2; NaN for a single sample


class LoadBlocks:
    """Collects samples into blocks; a sample at least 15 ms after the last is its own block."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start again with the next sample; drop the incomplete block."""
        self._sums: FloatArray | None = None
        # Last sample: stamp, throttle, step before it, throttle changes in its bin so far.
        self._last = (-math.inf, NAN, math.inf, 0)
        self._zero = NAN

    def push(self, columns: FloatArray) -> list[LoadBlock]:
        """Return the blocks that these samples complete (rows in s, V, 0..1 and A; (4, n))."""
        t, voltage, throttle, current = columns
        if not t.size:
            return []
        if math.isnan(self._zero):
            # Subtracted before squaring, to keep precision.
            self._zero = float(voltage[0])
        before, held, step, changes = self._last
        dt = np.diff(t, prepend=before)
        bins = np.floor(np.concatenate(([t[0] if before == -math.inf else before], t)) / WIDTH)
        alone = dt >= _APART
        fresh = alone | (np.concatenate(([step], dt[:-1])) >= _APART) | (np.diff(bins) != 0.0)
        u = np.concatenate(([held], throttle))
        differs = ~((np.abs(np.diff(u)) <= EQUAL) | (np.isnan(u[1:]) & np.isnan(u[:-1])))
        # Changes since the bin began.
        total = np.cumsum(differs & ~fresh) + changes
        base = np.maximum.accumulate(np.where(fresh, total, 0))
        count = total - base
        starts = np.flatnonzero(fresh | differs & (count <= _CHANGES))
        self._last = float(t[-1]), float(throttle[-1]), float(dt[-1]), int(count[-1])
        known = np.isfinite(current)
        off = voltage - self._zero
        rows = np.stack((np.ones(t.size), t, off, off * off, throttle,
                         np.where(known, current, 0.0), known, t))
        cuts = starts if starts.size and starts[0] == 0 else np.concatenate(([0], starts))
        sums = np.add.reduceat(rows, cuts, axis=1)
        sums[-1] = t[np.append(cuts[1:], t.size) - 1]
        done = []
        if self._sums is not None:
            if starts.size and starts[0] == 0:
                done.append(self._block(self._sums))
            else:
                sums[:-1, 0] += self._sums[:-1]
        done += [self._block(column) for column in sums.T[:-1]]
        self._sums = sums[:, -1]
        if alone[-1]:
            done.append(self._block(self._sums))
            self._sums = None
        return done

    def _block(self, sums: FloatArray) -> LoadBlock:
        n, t, off, square, throttle, current, known, last = sums.tolist()
        within = max(0.0, square - off * off / n) / (n - 1.0) if n > 1.0 else NAN
        # Round the mean throttle, because its rounding error depends on how samples are split into
        # calls, and sqrt|du| of the noise would amplify this error from 1e-17 to 1e-8.
        return LoadBlock(t / n, last, self._zero + off / n, round(throttle / n, 12),
                         current / known if known else NAN, int(n), within)


DELAYS = (0.0, 0.05, 0.1, 0.15, 0.2)  # s
# Changes slower than this, s, are removed, because they are discharge and recovery.
_SLOW = 1.0
# Prior of the filter: share of the response that lags, and time constant of the lag, s.
_SHARE, _LAG = 1.0 / 3.0, 0.06
# Minimum time over which delays are compared, and memory of the comparison, s.
_FIRST, _MEMORY = 10.0, 60.0
# Another delay is adopted if its residual variance is below this share of the present delay's.
_BETTER = 0.75
# Time for which this condition must hold, s.
_LASTING = 3.0
# Test of the relation between load and voltage: length of segments, s, whose responses are nearly
# independent; memory, s; minimum number of segments.
_PIECE, _PIECES_MEMORY, _FEWEST = 2.0, 120.0, 5.0
# Minimum rms of the load in a segment that is used for this test.
_MOVED = 0.01
# Number of standard errors from which a relation is significant: one false alarm in 700 tests.
_SIGNIFICANT = 3.0
# Maximum step between blocks, s, at which the delays can be distinguished.
_LONGEST = 0.15


class LoadDelay:
    """Running correlations of voltage and load at several delays; uses lists, for speed."""

    def __init__(self, delay: float = 0.0, *, either: bool = False) -> None:
        # Whether the load may have either sign.
        self._either = either
        self.delay = min(DELAYS, key=lambda one: abs(one - delay))
        self.forget()

    def forget(self) -> None:
        """Start again after a break in time; keep the delay."""
        self._t = math.nan
        self._past: deque[tuple[float, float]] = deque()
        self._seen = self._better = 0.0
        self._xx = 0.0
        none = [0.0] * len(DELAYS)
        self._xv, self._vv = none, none
        # Sums of the present segment: time, load squared, products, voltage squared.  Sums over
        # the correlations of complete segments: weights, values, squares.
        self._filled, self._own = 0.0, (0.0, none, none)
        self._pieces, self._sum, self._squares = 0.0, none, none

    def take(self, t: float, v: float, x: float) -> bool:
        """Take a block (t in s, v in V, x: load as received); return whether delay changed."""
        dt = t - self._t
        if not 0.0 < dt <= _LONGEST:
            self.forget()
        if math.isnan(self._t):
            self._t, self._load, self._slow_load, self._slow_volts = t, x, x, v
            return False
        self._t = t
        self._load = x + (self._load - x) * math.exp(-dt / _LAG)
        x += _SHARE * (self._load - x)
        keep = math.exp(-dt / _SLOW)
        self._slow_load = x + (self._slow_load - x) * keep
        self._slow_volts = v + (self._slow_volts - v) * keep
        x -= self._slow_load
        past = self._past
        past.append((t, v - self._slow_volts))
        while len(past) > 1 and past[1][0] <= t - DELAYS[-1]:
            past.popleft()
        volts, k = [], len(past) - 1
        for delay in DELAYS:
            while k and past[k][0] > t + 1e-6 - delay:
                k -= 1
            volts.append(past[k][1])
        keep, load, square = 1.0 - dt / _MEMORY, x * dt, x * x * dt
        products, squares = [load * v for v in volts], [v * v * dt for v in volts]
        self._xx = self._xx * keep + square
        self._xv = [keep * old + new for old, new in zip(self._xv, products)]
        self._vv = [keep * old + new for old, new in zip(self._vv, squares)]
        xx, xv, vv = self._own
        xx, xv, vv = xx + square, list(map(add, xv, products)), list(map(add, vv, squares))
        self._filled, self._own = self._filled + dt, (xx, xv, vv)
        if self._filled >= _PIECE:
            if xx > _MOVED ** 2 * self._filled:
                r = [one / math.sqrt(max(xx * other, 1e-300)) for one, other in zip(xv, vv)]
                keep = 1.0 - _PIECE / _PIECES_MEMORY
                self._pieces = self._pieces * keep + 1.0
                self._sum = [keep * old + one for old, one in zip(self._sum, r)]
                self._squares = [keep * old + one * one for old, one in zip(self._squares, r)]
            self._filled, self._own = 0.0, (0.0, [0.0] * len(volts), [0.0] * len(volts))
        # Count only times at which the load has changed by more than rounding.
        self._seen += dt * (x * x > 1e-6)
        return self._seen >= _FIRST and self._choose(dt)

    @property
    def unrelated(self) -> bool:
        """Return True if a t-test over 2 s segments shows no fall of the voltage with load."""
        if self._pieces < _FEWEST:
            return False
        now = DELAYS.index(self.delay)
        mean = self._sum[now] / self._pieces
        variance = self._squares[now] / self._pieces - mean * mean
        return bool(mean > -_SIGNIFICANT * math.sqrt(max(0.0, variance) / (self._pieces - 1.0)))

    def _choose(self, dt: float) -> bool:
        # With a load of known sign, use only delays at which the voltage falls as the load rises.
        falls = self._xv if self._either else [min(one, 0.0) for one in self._xv]
        left = [1.0 - one * one / max(self._xx * other, 1e-300)
                for one, other in zip(falls, self._vv)]
        best = left.index(min(left))
        now = DELAYS.index(self.delay)
        self._better = self._better + dt if left[best] < _BETTER * left[now] else 0.0
        if self._better < _LASTING:
            return False
        self._better = 0.0
        self.delay = DELAYS[best]
        return True


# Correlation of voltage at rest and load, averaged over two successive segments of `_PIECE`, above
# which the response has changed; minimum number of blocks in a segment.  With 0.8, no change
# was detected in 22 recordings (gecko, nazgul, roma, hiro, cf_pair, erle, jd, euc_1, frc_ol_1 and
# others), and simulated sags of 20 to 200 times the noise were detected within 6 s.
_CHANGED, _BLOCKS = 0.8, 20


class LoadChange:
    """Detects a change of the response to load, for example when the motors are armed."""

    def __init__(self) -> None:
        # Sums of 1, voltage at rest, load, and their products in the present segment; its start.
        self._sums = np.zeros(6)
        self._begun = math.nan
        self._last = 0.0  # Correlation in the last segment.

    def take(self, t: float, rest: float, x: float) -> bool:
        """Take time, s, voltage at rest, V, and load; return whether the response has changed."""
        if not t - self._begun < _BLOCKS * _PIECE:
            self._begun, self._last, self._sums = t, 0.0, np.zeros(6)
        changed = False
        if t - self._begun >= _PIECE and self._sums[0] >= _BLOCKS:
            _, v_mean, x_mean, vv, xx, xv = (self._sums / self._sums[0]).tolist()
            vv, xx, xv = vv - v_mean * v_mean, xx - x_mean * x_mean, xv - v_mean * x_mean
            r = xv / math.sqrt(vv * xx) if vv > 0.0 and xx > _MOVED ** 2 else 0.0
            changed = abs(r + self._last) > 2.0 * _CHANGED
            self._begun, self._last, self._sums = t, 0.0 if changed else r, np.zeros(6)
        self._sums += (1.0, rest, x, rest * rest, x * x, x * rest)
        return changed


# Standard score above which errors weigh less, and limit of squared scores for learning the noise.
CLIP, _OUTLIER = 4.0, 16.0
# Variance of a prediction, V^2, above which the filter has diverged, for example after readings of
# megavolts, and is restarted.
DIVERGED = 1e12
# Difference below which two voltages are the same reading of an ADC, V.
_SAME = 1e-6
# Change of throttle below which throttle counts as constant.
_HELD = 1e-3
# Memory of the noise, in updates: maximum, initial value, and growth per update.  The memory is
# short at first, while the coefficients are still wrong.
_NOISE_MEMORY, _NOISE_FIRST, _NOISE_SHARE = 2000.0, 50.0, 1.0 / 3.0


def _dot(x: Sequence[float], y: Sequence[float]) -> float:
    return x[0] * y[0] + x[1] * y[1] + x[2] * y[2]


class LoadNoise:
    """Law of the noise of blocks; volts: voltage of the pack; b: initial coefficients."""

    def __init__(self, volts: float, b: tuple[float, float, float] | None = None) -> None:
        # Prior: 0.4 % of the voltage, and typical effects of ripple and throttle changes; or the
        # coefficients of another flight, within a factor of 1.4.
        self.b = (math.log((0.004 * volts) ** 2), 2.0, 4.0) if b is None else b
        x, y, z = (4.0, 4.0, 9.0) if b is None else (0.5, 0.5, 1.0)
        self._covariance = [[x, 0.0, 0.0], [0.0, y, 0.0], [0.0, 0.0, z]]
        # Mean square of the standard scores, and correlation of successive ones.
        self.scale, self.correlation = 1.0, 0.0
        self._last, self._n = 0.0, 0
        # Step of the ADC, V, and share of blocks whose value differs from the previous one.
        self._step, self._changing, self._held = math.inf, 1.0, math.nan
        self._unseen = (0.05 * volts) ** 2
        # Averages over blocks: number of samples, variance within a block, and variance of the
        # mean of a block, V^2.
        self._size, self._within, self._between = 1.0, 0.0, 0.0

    def variance(self, u: float, du: float, n: int) -> float:
        """Return the variance of a mean of n samples, V^2."""
        whole = math.exp(_dot(self.b, (1.0, ripple(u), math.sqrt(du))))
        return whole + self._within * max(0.0, 1.0 / n - 1.0 / self._size)

    @property
    def log_variance(self) -> tuple[float, float, float]:
        """Return b for a single sample, with the variance of rounding added."""
        own = 1.0
        if self._between > 0.0:
            own += self._within * (1.0 - 1.0 / self._size) / self._between
        least = 0.0 if math.isinf(self._step) else self._step ** 2 / 12.0
        whole = math.exp(self.b[0]) * own + least
        return math.log(whole), self.b[1], self.b[2]

    @property
    def ripple_se(self) -> float:
        """Return the standard error of b[1], the coefficient of ripple."""
        return math.sqrt(max(self._covariance[1][1], 0.0))

    def see(self, voltage: float) -> None:
        """Update the ADC step from the means of blocks, V."""
        step = abs(voltage - self._held)
        self._held = voltage
        changed = step > _SAME
        if changed:
            self._step = min(self._step, step)
        self._changing += max(0.002, 1.0 / (self._n + 20.0)) * (changed - self._changing)

    @property
    def rounding(self) -> float:
        """Return the variance of rounding, V^2, for values that repeat with the same error."""
        if math.isinf(self._step):
            # The value has never changed, so the step is unknown.
            return self._unseen
        return self._step ** 2 / 12.0 / max(self._changing, 0.002)

    def follow(self, score: float) -> None:
        """Take a clipped standard score, to measure the correlation of innovations."""
        self.correlation += max(0.002, 1.0 / (self._n + 50.0)) * (
            score * self._last - self.correlation)
        self.correlation = max(0.0, min(0.9, self.correlation))
        self._last = score
        self._n += 1

    def learn(self, e: float, s: float, u: float, du: float, n: int, within: float) -> None:
        """Update ln variance by an innovation, V (Fisher scoring); s: state variance, V^2."""
        f = 1.0, ripple(u), math.sqrt(du)
        R = self.variance(u, du, n)
        square = min(e * e / (s + R), _OUTLIER)
        # Share of noise in the variance; the rest is uncertainty of the state.
        share = max(R / (s + R), 0.05)
        grown = 1.0 + 1.0 / min(_NOISE_MEMORY, _NOISE_FIRST + _NOISE_SHARE * self._n)
        C = [[grown * one for one in row] for row in self._covariance]
        g = [_dot(row, f) for row in C]
        own = _dot(f, g)
        # The square of a standard normal has the variance 2.
        total = own + 2.0 / share ** 2
        step = min((square - 1.0) / share / total, 0.7 / own)
        x, y, z = (b + one * step for b, one in zip(self.b, g))
        self.b = x, y, z
        C = [[c - one * other / total for c, other in zip(row, g)] for row, one in zip(C, g)]
        most = min(1.0, 9.0 / max(C[0][0], C[1][1], C[2][2]))
        self._covariance = [[most * one for one in row] for row in C]
        weight = max(0.002, 1.0 / (self._n + 20.0))
        self.scale += weight * (square - self.scale)
        self._size += weight * (n - self._size)
        if n > 1 and du < _HELD:
            self._within += weight * (within - self._within)
            self._between += weight * (math.exp(_dot(f, self.b)) - self._between)


def log_density(z: float, variance: float) -> float:
    """Return the log density of a block, nats, up to a constant; z: clipped standard score."""
    return -0.5 * (z * z + math.log(variance))
