"""
Alpha, sigma and Var_inf online: `SlidingEstimator`, and `RelaxationFits` for `window: auto`.

voltage = level + response to throttle + OU(alpha, sigma) + white noise, all estimated together.
doc/estimation.md has the steps, the measured accuracy and the limits.  If a change of the source's
rate changes the number of samples per block, the window is cleared.

`RelaxationFits` keeps the readings of the last minute, and fits them by `known_ou` of `ou_fit`.  A
fit takes 30 to 600 ms of CPU, so it is repeated only after a quarter of its window, and after 1 s
at least.  In the background, fits run in a thread, with at most 5 % of a core.  Limits: as in
`ou_fit`; above 1 kHz, only the last 65 536 readings are kept; a change of the supply is followed
one window late.
"""

from __future__ import annotations

from dataclasses import replace
import math
import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.model import arma
from ou_monitor.model.ou_fit import GAP, known_ou
from ou_monitor.online.estimator.fit import (
    fit_window, FitEnd, JITTER, Maximum, MOST, TREND_SCORE, WindowFit)
from ou_monitor.online.estimator.quality import examine, input_flags, judge, Quality
from ou_monitor.records import (
    as_numbers, as_seconds, Counters, Estimate, Flag, FloatArray, LARGEST_LOG_SE, LOG_NAMES,
    MOST_READINGS, NAN, OU_WINDOWS, OuFacts, Status)
from ou_monitor.timeline import as_column, BATCH, Batch, TAIL, TimeLine

# Time constants, s, with which the load may follow throttle: motors follow the command within
# 5 to 20 ms, and the current settles within 40 ms (doc/estimation.md).
LOAD_LAGS = (0.010, 0.040)
# Time after a change of throttle within which all lags settle, s.
LOOK_BACK = 16.0 * LOAD_LAGS[1]

# Maximum exponent in `lagged`; even exp(2 * _SPAN) is far below the largest double.
_SPAN = 300.0
# Difference from the throttle below which a lagged throttle has settled.
_SETTLED = 1e-7
# Minimum number of samples to determine the rate.
MIN_FOR_RATE = 8
# Relative difference from the usual step above which a step ends a run of even steps.
UNEVEN = 0.5
# The usual step is updated when the median step of recent stamps differs from it by this factor.
NEW_RATE = 1.3
# Number of stamps kept from batch to batch for that median.
MEMORY = 32
# Maximum samples per block, enough for sources up to 10 MHz; closer stamps are invalid.
MOST_BLOCK = 1000.0
# Minimum number of samples for a fit.
MIN_SAMPLES = 20
# Longest lag of increments, readings; minimum share of the readings with such increments.
_LAGS, _EVEN = 24, 0.5
# Tolerance for rounded stamps at the edge of the window, as a share of the window.
_ROUNDING = 1e-6
# If the variance of the increments is below this share of their mean square, the voltage is a
# ramp.
_RAMP = 1e-9
# Number of checks of the input's quality per window.
_LOOKS = 4
# Window of the sliding estimate that complements `RelaxationFits` for `window: auto`, s.
SLIDING = OU_WINDOWS[0]
# Time between two fits, as a share of the window, and its minimum, s.
_SHARE, _SOONEST = 0.25, 1.0
# Maximum share of one core for fits in the background.
_CPU = 0.05
# Statuses of an estimate that has no relaxation because its window is too short.
_SHORT = (Status.TOO_FEW_SAMPLES, Status.TOO_SHORT)
# Cautions about the sliding estimate that do not apply to `RelaxationFits`.
_SLIDING_ONLY = frozenset({Flag.TREND, Flag.SLOW_RATE})


class SlidingEstimator:
    """
    OU parameters of the last `window` seconds of a voltage.

    Parameters
    ----------
    window : float
        Length of the window, s, > 0.
    fastest : float
        Highest rate kept, Hz; faster sources are averaged in blocks, and the fit accounts for
        that.

    Raises
    ------
    ValueError
        When the window or the rate is not a positive finite number.

    Examples
    --------
    >>> from ou_monitor import read_recording, SlidingEstimator
    >>> recording = read_recording('bags/load_40')      # simulated: sigma 0.632 V/sqrt(s)
    >>> estimator = SlidingEstimator(window=2.0)
    >>> estimator.push(recording.t, recording.voltage, recording.throttle)
    >>> estimate = estimator.estimate()
    >>> estimate.status.name, estimate.usable
    ('OK', True)
    >>> low, high = estimate.interval('sigma')
    >>> low < 0.632 < high
    True

    """

    def __init__(self, window: float = 2.0, *, fastest: float = 1.0e4,
                 line: TimeLine | None = None) -> None:
        self._window = _positive('window', window, 's')
        self._line = TimeLine() if line is None else line
        self._fastest = _positive('fastest', fastest, 'Hz')
        self._thinner = BlockAverager(self._fastest)
        # Stamps, voltage and throttle; only the lags of throttle use readings before `_begin`, s.
        self._kept = ReadingBuffer(3)
        self._begin = -math.inf
        self._tail = np.empty(0)
        self._quality = Quality()
        self._looked = -math.inf
        # The last fit, and its last stamp, s.
        self._before: Maximum | None = None
        self._before_end = -math.inf
        self._cached: Estimate | None = None

    @property
    def window(self) -> float:
        """Length of the window, s."""
        return self._window

    @window.setter
    def window(self, value: float) -> None:
        """Change the length; keep samples within the new length."""
        self._flush()
        self._window = _positive('window', value, 's')
        self._slide()
        self._cached = None

    def reset(self) -> None:
        """Clear the window; keep the counters."""
        self._flush()
        self._line.forget()
        self._line.count(resets=1)
        self._forget()
        self._cached = None

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None) -> None:
        """
        Add samples.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  Late samples are sorted within one call, otherwise dropped
            and counted.  A step back, or a pause longer than the window, clears
            the window.
        voltage : float or array_like, shape (n,)
            Voltage, V.  NaN and infinite samples are dropped and counted.
        throttle : float or array_like, shape (n,), optional
            Throttle, 0..1; NaN or left out means unknown.

        Raises
        ------
        ValueError
            When the shapes differ.

        """
        self._cached = None
        stamps, volts = np.atleast_1d(as_seconds(t)), as_column(voltage)
        if stamps.shape != volts.shape or stamps.ndim != 1:
            raise ValueError(
                f't and voltage must have one shape (n,): got {stamps.shape} and {volts.shape}')
        load = None if throttle is None else as_numbers(throttle)
        if load is not None and load.shape not in ((), stamps.shape):
            raise ValueError(
                f'throttle must be one number or have the shape of t, {stamps.shape}: got '
                f'{load.shape}')
        for begin in range(0, stamps.size, BATCH):
            part = slice(begin, begin + BATCH)
            if self._line.waiting + stamps[part].size > BATCH:
                self._flush()
            self._line.put(stamps[part], volts[part],
                           load[part] if load is not None and load.ndim else load)

    def estimate(self) -> Estimate:
        """Return the estimate for the window that ends at the newest sample."""
        if self._cached is None or self._cached.counters != self._line.counters:
            self._flush()
            self._cached = self._estimate()
        return self._cached

    @property
    def counters(self) -> Counters:
        """Return the samples processed so far, by outcome."""
        return self._line.counters

    def _flush(self) -> None:
        """Move the pushed samples into the window."""
        if not self._line.waiting:
            return
        for batch in self._line.flush(self._window):
            self.take(batch)

    def take(self, batch: Batch) -> None:
        """Take readings in order, from a `TimeLine`."""
        self._cached = None
        if batch.restart:
            self._forget()
        if batch.again:
            # Discard the block means, because repeats cannot be removed from them.
            self._thinner = BlockAverager(self._fastest)
            self._kept = ReadingBuffer(3)
            self._tail = np.empty(0)
        self._tail = batch.y[-TAIL:].copy() if batch.y.size >= TAIL else np.concatenate(
            [self._tail, batch.y])[-TAIL:]
        columns, restart = self._thinner.take(batch)
        if restart:
            # Means of blocks of different sizes cannot be fitted together.
            self._line.count(resets=1)
            self._kept = ReadingBuffer(3)
        if columns.size:
            self._kept.append(columns, self._window + LOOK_BACK)
            self._slide()

    def _forget(self) -> None:
        self._thinner.forget()
        self._kept = ReadingBuffer(3)
        self._begin = -math.inf
        self._tail = np.empty(0)
        self._looked = -math.inf
        self._before = None

    def _slide(self) -> None:
        """Move the window to the newest reading; its begin never moves back."""
        t = self._kept.columns[0]
        if t.size:
            self._begin = max(self._begin, t.item(-1) - (1.0 + _ROUNDING) * self._window)

    def _estimate(self) -> Estimate:
        line, kept = self._line, self._kept.columns
        at = int(kept[0].searchsorted(self._begin))
        t, y, u = kept[:, at:]
        if t.size and not 0.0 <= line.newest - self._looked < self._window / _LOOKS:
            self._quality = examine(self._tail, line.period)
            self._looked = line.newest
        quality = self._quality
        counters = line.counters
        if not t.size:
            waiting = self._thinner.waiting(line.newest - self._window)
            n = waiting.size
            if not n:
                return Estimate(counters=counters)
            duration = line.newest - waiting.item(0)
            return Estimate(t=line.newest, voltage=float(self._tail[-1]), n=n,
                            duration=duration, rate=(n - 1) / duration if duration else NAN,
                            counters=counters, status=Status.TOO_FEW_SAMPLES,
                            flags=tuple(input_flags(counters, quality, NAN)))
        duration = t.item(-1) - t.item(0)
        m, n = self._thinner.m, t.size
        measured: dict[str, Any] = {
            't': line.newest, 'voltage': self._tail.item(-1), 'throttle': u.item(-1),
            'n': n * m, 'duration': duration, 'counters': counters,
            'rate': (n - 1) * m / duration if duration > 0.0 else NAN}
        status = None
        if n < MIN_SAMPLES:
            status = Status.TOO_FEW_SAMPLES
        elif y.item(0) == y.item(-1) and not np.ptp(y) > 0.0:
            status = Status.CONSTANT
        if status is not None:
            return Estimate(status=status, u0=float(y.mean()),
                            flags=tuple(input_flags(counters, quality, NAN)),
                            **measured)
        # Regress on throttle and its lags if throttle is known and has moved.
        known = not np.isnan(u).any()
        back = int(kept[0].searchsorted(t.item(0) - LOOK_BACK))
        before = kept[2, back:]
        load = np.empty((0, n))
        if known and np.nanmax(before) > np.nanmin(before):
            load = np.stack([u, u * u, *(
                lagged(kept[0, back:], before, tau)[at - back:] for tau in LOAD_LAGS)])
        fit, smoothness = self._fit(t, y, load, quality)
        return judge(fit, measured, quality, float(u.std()) if known else NAN, smoothness)

    def _fit(self, t: FloatArray, y: FloatArray, load: FloatArray, quality: Quality,
             ) -> tuple[WindowFit, float]:
        """Return the fit, and the excess smoothness of adjacent increments."""
        m = self._thinner.m
        steps = np.diff(t)
        usual = float(np.median(steps))
        even = np.abs(steps - usual) <= UNEVEN * usual
        jitter = float(np.std(steps[steps < GAP * usual])) if m == 1 and t.size <= MOST else 0.0
        # If two windows have half of their samples in common, their fits are similar.
        near = t.item(t.size // 2) < self._before_end
        before = self._before if near else None
        fit, self._before = fit_window(t, y, load, m, quality.step, jitter, before)
        self._before_end = t.item(-1)
        if fit.outcome is FitEnd.UNCORRELATED or jitter * fit.alpha > JITTER or 2 * fit.n < t.size:
            return fit, NAN
        one, two, far = (_increments(y, even, lag) for lag in (1, 2, _LAGS))
        smoothness = NAN
        if one[1] > _RAMP * one[0]:
            smoothness = _smoothness(two[1] / one[1], fit.alpha_step, m)
        # The fit may take any drift for chance if it finds no return to the mean.  So also report
        # a trend if the voltage drifts faster than a random walk with these increments would.
        # Increments over the longest lag reveal movements in one direction.  Skip this check if
        # throttle moves, because the sag is still in these increments.
        if not load.size and far[2] >= _EVEN * t.size and one[2] * (
                one[0] - one[1]) > TREND_SCORE ** 2 * max(one[1], far[1] / _LAGS):
            fit = replace(fit, trend=True)
        return fit, smoothness


def _smoothness(ratio: float, a: float, m: int) -> float:
    """Return by how much the correlation of neighbouring increments exceeds an OU's."""
    # ratio: D_2 / D_1, the variances of z_j - z_{j-2} and z_j - z_{j-1}; the correlation of
    # neighbouring increments is D_2 / (2 D_1) - 1.
    gamma0, gamma1 = arma.block_autocovariance(a, m)
    of_ou = (gamma0 - gamma1 * math.exp(-a)) / (2.0 * (gamma0 - gamma1)) - 1.0
    return 0.5 * ratio - 1.0 - of_ou


def _increments(y: FloatArray, even: npt.NDArray[np.bool_], lag: int) -> tuple[float, float, int]:
    """Return mean square, V^2, variance, and number of increments over a lag of even steps."""
    count = np.concatenate([[0], np.cumsum(even)])
    pairs = (y[lag:] - y[:-lag])[count[lag:] - count[:-lag] == lag]
    if not pairs.size:
        return 0.0, 0.0, 0
    square = float(pairs @ pairs) / pairs.size
    return square, square - float(pairs.mean()) ** 2, pairs.size


def _positive(name: str, value: float, unit: str) -> float:
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise ValueError(f'{name} must be a positive number of {unit}, got {value}')
    return number


class ReadingBuffer:
    """The newest readings, one per column; row 0 holds the stamps, s."""

    def __init__(self, rows: int) -> None:
        self._store = np.empty((rows, 1024))
        self._size = 0

    @property
    def columns(self) -> FloatArray:
        """Return the readings kept, shape (rows, n); a view."""
        return self._store[:, :self._size]

    def cut(self, size: int) -> None:
        """Forget all but the first `size` readings."""
        self._size = size

    def append(self, columns: FloatArray, reach: float, most: int = 1 << 62) -> None:
        """Add readings; keep at least those of the last `reach` s, or the last `most` if fewer."""
        count = columns.shape[1]
        if self._size + count > self._store.shape[1]:
            # Keep one reading more, which shows that there are data before the window.
            first = max(0, int(np.searchsorted(
                self.columns[0], columns[0, -1] - reach)) - 1, self._size + count - most - 1)
            old = self.columns[:, first:]
            self._store = np.empty((len(old), 2 * (old.shape[1] + count)))
            self._size = old.shape[1]
            self._store[:, :self._size] = old
        self._store[:, self._size:self._size + count] = columns
        self._size += count


def lagged(t: FloatArray, u: FloatArray, tau: float) -> FloatArray:
    """Return a first-order lag of the throttle, exact for held input (t, tau in s)."""
    unknown = np.isnan(u)
    if 0 < np.count_nonzero(unknown) < u.size:
        place = np.maximum.accumulate(np.where(unknown, -1, np.arange(u.size)))
        filled = u[np.where(place < 0, np.flatnonzero(~unknown)[0], place)]
        out = lagged(t, filled, tau).copy()
        out[unknown] = math.nan
        return out
    t0, u0 = float(t[0]), float(u[0])
    state = u0
    out = np.empty_like(u)
    begin = 0
    while begin < t.size:
        end = t.size
        if float(t[-1]) - t0 > _SPAN * tau:
            end = max(int(np.searchsorted(t, t0 + _SPAN * tau)), begin + 1)
        weight = np.exp(np.minimum((t[begin:end] - t0) / tau, 2.0 * _SPAN))
        gain = weight.copy()
        gain[0] -= 1.0
        gain[1:] -= weight[:-1]
        gain[0] *= u0
        gain[1:] *= u[begin:end - 1]
        np.add.accumulate(gain, out=gain)
        gain += state
        np.divide(gain, weight, out=out[begin:end])
        t0, u0, state = float(t[end - 1]), float(u[end - 1]), float(out[end - 1])
        begin = end
    near = np.abs(out - u) < _SETTLED
    out[near] = u[near]
    return out


class BlockAverager:
    """Measures the rate of the source; averages in blocks if the rate exceeds `fastest`, Hz."""

    def __init__(self, fastest: float) -> None:
        self._fastest = fastest
        self.m = 0
        self.step = NAN
        self.forget()

    def forget(self) -> None:
        """Treat the next sample as the first, but keep the rate."""
        self._rest = np.empty((3, 0))
        self._stamps = np.empty(0)

    def waiting(self, since: float) -> FloatArray:
        """Return the stamps, from `since` on, of samples that wait for a rate or a full block."""
        stamps: FloatArray = self._rest[0]
        return stamps[stamps >= since]

    def take(self, batch: Batch) -> tuple[FloatArray, bool]:
        """Return stamps, voltage and throttle to keep, and whether to drop those kept before."""
        t = batch.t
        columns = batch.columns[:3]
        restart = False
        stamps = np.concatenate([self._stamps, t])
        steps = np.diff(stamps[-t.size - 1:])
        if not (steps.size and np.abs(steps - self.step).max() <= UNEVEN * self.step):
            restart = self._learn(stamps)
        self._stamps = stamps[-MEMORY:].copy()
        columns = np.concatenate([self._rest, columns], axis=1)
        if self.m == 0:
            self._rest = columns
            return columns[:, :0], False
        if self.m > 1:
            return self._blocks(columns), restart
        self._rest = columns[:, :0]
        return columns, restart

    def _learn(self, stamps: FloatArray) -> bool:
        """Update the usual step; return whether the block size changed."""
        if stamps.size < MIN_FOR_RATE:
            return False
        step = float(np.median(np.diff(stamps[-BATCH:])))
        if self.m and self.step / NEW_RATE < step < self.step * NEW_RATE:
            return False
        before, self.step = self.m, step
        self.m = max(1, round(min(1.0 / step / self._fastest, MOST_BLOCK)))
        return before not in (0, self.m)

    def _blocks(self, columns: FloatArray) -> FloatArray:
        """Average full blocks; an incomplete block waits for more samples; a gap drops it."""
        m = self.m
        gaps = np.flatnonzero(np.abs(np.diff(columns[0]) - self.step) > UNEVEN * m * self.step) + 1
        parts = []
        for part in np.split(columns, gaps, axis=1):
            whole = part.shape[1] // m
            parts.append(part[:, :whole * m].reshape(3, whole, m).mean(axis=2))
            self._rest = part[:, whole * m:].copy()
        return np.concatenate(parts, axis=1)


class RelaxationFits:
    """Readings of the last minute, and the newest fit to them; `end`: its last stamp, s."""

    def __init__(self, *, background: bool) -> None:
        self._background = background
        self._thread: threading.Thread | None = None
        # Result of the thread: number of its time line, the fit or the error, and last stamp, s.
        self._found: tuple[int, OuFacts | Exception, float] | None = None
        self._line = 0
        self._rest = -math.inf
        self.forget()

    def forget(self) -> None:
        """Forget all readings."""
        # Rows: stamp, voltage, throttle and current.
        self._kept = ReadingBuffer(4)
        self._line += 1
        self.facts: OuFacts | None = None
        self.end = self._due = NAN

    @property
    def readings(self) -> FloatArray:
        """Return stamps, s, V, throttle and A of the readings kept, shape (4, n)."""
        return self._kept.columns

    def take(self, batch: Batch) -> None:
        """Take readings in order."""
        t = self.readings[0]
        if batch.again:
            # The batch replaces the newest readings kept, without their repeats.
            self._kept.cut(int(np.searchsorted(t, batch.t[0])))
        elif t.size and batch.t[0] <= t[-1]:
            self.forget()
        self._kept.append(batch.columns[:, -MOST_READINGS:], OU_WINDOWS[-1], MOST_READINGS)

    def update(self) -> None:
        """Fit if a fit is due; in the background, start the thread, and take its last result."""
        if self._found is not None:
            (line, found, end), self._found = self._found, None
            if line == self._line:
                self._put(found, end)
        # Before the first fit, `_due` is NaN, so a fit is due.
        if not self.readings.size or self.readings[0, -1] < self._due:
            return
        if not self._background:
            self._put(known_ou(*self.readings), float(self.readings[0, -1]))
        elif time.monotonic() >= self._rest and (
                self._thread is None or not self._thread.is_alive()):
            self._thread = threading.Thread(
                target=self._fit, args=(self.readings.copy(), self._line), name='relaxation',
                daemon=True)
            self._thread.start()

    def _fit(self, readings: FloatArray, line: int) -> None:
        begin = time.thread_time()
        found: OuFacts | Exception
        try:
            found = known_ou(*readings)
        except Exception as error:
            found = error
        self._rest = time.monotonic() + (time.thread_time() - begin) * (1.0 / _CPU - 1.0)
        self._found = line, found, float(readings[0, -1])

    def _put(self, found: OuFacts | Exception, end: float) -> None:
        if isinstance(found, Exception):
            # The monitor then restarts, and reports the reason.
            raise found
        self.facts, self.end = found, end
        self._due = end + max(_SOONEST, _SHARE * found.window_s)

    def in_force(self, e: Estimate) -> tuple[Estimate, OuFacts, float]:
        """Return the estimate to publish, its relaxation, and the age of the relaxation, s."""
        facts, age = self.facts, e.t - self.end
        sliding = of_estimate(e)
        # Whether there are newer readings than in the fit.
        later = not self.readings.size or self.readings[0, -1] > self.end
        if facts is None or e.status is Status.NO_DATA or (
                later and sliding.status == 'ok' and facts.window_s < sliding.window_s):
            # In the first seconds, the sliding window may be longer than the window of the fit.
            return e, sliding, 0.0
        if facts.status in ('no_data', 'too_short'):
            return _unknown(e, Status.TOO_SHORT), facts, age
        if age > max(facts.window_s, SLIDING):
            # The fit is too old, because fits take too long.
            return _unknown(e, Status.TOO_SHORT), OuFacts('no_data'), age
        if facts.status == 'not_visible':
            return _unknown(e, Status.NO_RELAXATION), facts, age
        if later and facts.window_s <= SLIDING and sliding.status == 'ok' and (
                _overlap(facts.alpha_95, sliding.alpha_95)
                and _overlap(facts.sigma_95, sliding.sigma_95)):
            return e, sliding, 0.0
        errors: dict[str, Any] = {
            f'{name}_se': min(facts.log_se(name), LARGEST_LOG_SE) for name in LOG_NAMES}
        return replace(
            e, alpha=facts.alpha, sigma=facts.sigma, var_inf=facts.var_inf, **errors,
            status=Status.OK if math.isfinite(e.u0) else e.status,
            flags=tuple(flag for flag in e.flags if flag not in _SLIDING_ONLY)), facts, age


def of_estimate(e: Estimate) -> OuFacts:
    """Return the relaxation of a sliding estimate, without bounds."""
    if e.usable:
        return OuFacts('ok', e.duration, e.alpha, e.interval('alpha'), e.sigma,
                       e.interval('sigma'), e.var_inf, e.interval('var_inf'))
    return OuFacts('no_data' if e.status in (Status.NO_DATA, Status.UNTIMED) else
                   'too_short' if e.status in _SHORT else 'not_visible', e.duration)


def untimed(e: Estimate) -> Estimate:
    """Return the estimate for samples without trusted times."""
    return e if e.status is Status.NO_DATA else replace(_unknown(e, e.status),
                                                        status=Status.UNTIMED)


def _unknown(e: Estimate, status: Status) -> Estimate:
    """Return an estimate without its relaxation; if it was usable, with the given status."""
    return replace(e, alpha=NAN, alpha_se=NAN, sigma=NAN, sigma_se=NAN, var_inf=NAN,
                   var_inf_se=NAN, status=status if e.usable else e.status)


def _overlap(one: tuple[float, float], other: tuple[float, float]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]
