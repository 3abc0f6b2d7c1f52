"""
The last minutes of a flight, possible courses of throttle, and the lowest voltage in each.

doc/risk.md has the formulas for the lowest voltage (step 1), the pilot's future throttle (3), and
the excursions (4).

A course is throttle that goes to a peak, then to another value.  Its samples form four groups:
during the inrush, in the two halves of the remaining peak, and after the peak.  Limits: within a
group, the mean path counts as constant; samples of noise are independent, as in the load filter.

Pilot's future throttle: each completed horizon provides one course.  One rise from the present
throttle into each fifth of the range above it is added (rule of succession).  Limits: within a
horizon, the peak is assumed to come first.

Excursions do not need the load: the risk follows from the margin of the present voltage, and from
the drops of this flight.  One further drop, twice the standard deviation of the last 5 s, is added
for everything that has not been flown yet.  Horizons below 1 s or above 5 s use the nearest
coefficients.  Limits: throttle is not used; beyond 8 deviations, the risk is assumed to fall like
the tail of Student's t with five degrees of freedom (`forecast.py`).

Limits of the blocks: if the source is slower than a block, empty blocks repeat its last value, up
to a maximum silence; a horizon with a longer silence counts as incomplete.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import numpy.typing as npt
from ou_monitor.model.load import INRUSH_TIME, LAGS, LINEAR_LAGS, POWER
from ou_monitor.model.passage import normal_below
from ou_monitor.online.load.supply_load import LoadState
from ou_monitor.records import FloatArray, NAN

# Duration of the first group after a rise, in time constants of the inrush.
_RISE = 2.0
# Duration of a rise, s.  A rise is a ramp, so its inrush is smaller than a step's by the factor
# time constant / duration.
_RAMP = 0.2
_SHARE_OF_RISE = INRUSH_TIME / _RAMP


# Length of a block, s; time that is kept, s; maximum silence that is filled, s.
BLOCK, KEPT, SILENCE = 0.05, 300.0, 2.5
# Minimum width of a gap in the throttle flown across which nothing is interpolated (our choice).
_WIDE = 0.5
# Throttle within this distance of the highest throttle belongs to the peak.
AT_PEAK = 0.05
# `brief`, the squared relative error of the predicted fall, falls from 1 for a peak of one block
# with the squared number of blocks (the dwell is known to about a block), but not below this.  On
# gecko, nazgul, roma and hiro the error beyond noise is 0.1 to 0.5 of the squared fall for one
# block, and at most 0.01 from 0.15 s on.
_LASTING = 0.1


def _largest_medians() -> tuple[FloatArray, FloatArray, FloatArray]:
    """
    Return ln n, and mean and deviation of the largest of n running medians of three normals.

    A median is below x unless two of its three samples are above x.  That gives a chain of three
    states (number of samples since the last one above x), which is computed for n = 1, 2, 4, ...
    steps by squaring.
    """
    x = np.linspace(-6.0, 8.0, 561)
    over = normal_below(-x)
    step = np.zeros((x.size, 3, 3))
    step[:, 0, 0], step[:, 0, 1] = 1.0 - over, over
    step[:, 1, 2] = step[:, 2, 0] = 1.0 - over
    first = step @ step
    weight = np.full(x.size, x[1] - x[0])
    weight[[0, -1]] *= 0.5
    counts, means, deviations = [], [], []
    power = step
    for k in range(17):
        # Integrals of 1 - F, from the lowest x on, by trapezoids.
        above = (1.0 - (first @ power)[:, 0].sum(axis=1)) * weight
        mean = x[0] + above.sum()
        square = x[0] ** 2 + (2.0 * x * above).sum()
        counts.append(k * np.log(2.0))
        means.append(mean)
        deviations.append(np.sqrt(square - mean ** 2))
        power = power @ power
    return np.array(counts), np.array(means), np.array(deviations)


_LN_N, _MEAN, _DEVIATION = _largest_medians()


@dataclass(frozen=True, eq=False)
class Courses:
    """Possible future throttle: k courses; all shapes (k,)."""

    peak: FloatArray  # Throttle at the peak, 0..1.
    dwell: FloatArray  # Time at the peak, s.
    rest: FloatArray  # Throttle after the peak, 0..1.

    def after(self, first: Courses) -> Courses:
        """Return the courses of `first`, followed by these."""
        return Courses(*(np.concatenate(pair) for pair in (
            (first.peak, self.peak), (first.dwell, self.dwell), (first.rest, self.rest))))


@dataclass(frozen=True)
class Sampling:
    """Interval of the samples, s, and the mean sqrt|du| between them."""

    interval: float
    activity: float


def held(throttle: npt.ArrayLike, dwell: npt.ArrayLike, rest: float) -> Courses:
    """Return courses that go to a throttle, stay for a time, s, and return to `rest`."""
    peak, times = np.broadcast_arrays(*np.atleast_1d(throttle, dwell))
    return Courses(peak.astype(np.float64), times.astype(np.float64),
                   np.full(peak.shape, rest))


def _groups(state: LoadState, u: FloatArray, tau: FloatArray, inrush: FloatArray) -> FloatArray:
    """Return the mean regressors, (k, j, states), of j consecutive groups of k courses."""
    x = u ** POWER
    g = -state.size
    rows = np.empty(u.shape + (state.mean.size,))
    rows[..., 0] = 1.0
    rows[..., 1] = -state.fall * np.cumsum(x * tau, axis=1)
    rows[..., 2], rows[..., 3], rows[..., 4] = g * x, g * u, g * u ** 3
    rows[..., -1] = g * inrush
    time, now, lags = tau[..., None], np.array(state.lags), np.array(LAGS + LINEAR_LAGS)
    loads = np.stack([x] * len(LAGS) + [u] * len(LINEAR_LAGS), axis=-1)
    decay = np.exp(-time / lags)
    share = (1.0 - decay) * lags / np.maximum(time, 1e-9)
    for j in range(u.shape[1]):
        load = loads[:, j]
        apart = now - load
        rows[:, j, 5:-1] = g * (load + apart * share[:, j])
        now = load + apart * decay[:, j]
    return rows


def mean_now(state: LoadState) -> float:
    """Return the mean voltage, V, at the present throttle and lags, without inrush."""
    u = state.throttle
    regressors = np.array([u ** POWER, u, u ** 3, *state.lags])
    return float(state.mean[0] - state.size * (regressors @ state.mean[2:-1]))


def lowest(state: LoadState, courses: Courses, horizon: npt.ArrayLike, sampling: Sampling
           ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return mean, noise and error of each lowest voltage, V, and `brief`; shapes (k,)."""
    peak, dt = courses.peak, sampling.interval
    span = np.maximum(horizon, dt)
    stay = np.clip(courses.dwell, dt, span)
    first = np.minimum(stay, max(2.0 * dt, _RISE * INRUSH_TIME))
    half = 0.5 * (stay - first)
    tau = np.stack([first, half, half, span - stay], axis=1)
    u = np.stack([peak, peak, peak, courses.rest], axis=1)
    # The inrush and noise of a rise affect a median of three only if two samples are in the ramp.
    up = np.maximum(0.0, peak - state.throttle) * _SHARE_OF_RISE * min(
        max(_RAMP / dt - 1.0, 0.0), 1.0)
    inrush = np.zeros_like(u)
    inrush[:, 0] = up
    rows = _groups(state, u, tau, inrush)
    activity = np.full_like(u, sampling.activity)
    activity[:, 0] = np.maximum(np.sqrt(up), sampling.activity)
    sd = np.interp(np.clip(u, *state.flown), np.linspace(0.0, 1.0, len(state.deviation)),
                   state.deviation)
    sd *= np.exp(0.5 * state.log_variance[2] * (activity - sampling.activity))
    means, count, k = rows @ state.mean, tau / dt, np.arange(peak.size)
    largest = np.interp(np.log(np.maximum(count, 1.0)), _LN_N, _MEAN)
    j = np.argmin(np.where(tau > 0.5 * dt, means - sd * largest, np.inf), axis=1)
    row, mean, sd, largest = rows[k, j], means[k, j], sd[k, j], largest[k, j]
    # Samples of other groups count in proportion to how often they are as low as group j's lowest.
    apart = np.maximum(means - mean[:, None], 0.0) / sd[:, None]
    ln_n = np.log(np.maximum((count * np.exp(-largest[:, None] * apart)).sum(axis=1), 1.0))
    known = np.maximum(((row @ state.covariance) * row).sum(axis=1), 0.0)
    # The throttle of a peak is uniformly distributed within `AT_PEAK`, which counts as noise.
    c = state.size * state.mean
    slope = (c[2] + c[5:5 + len(LAGS)].sum()) * POWER * peak ** (POWER - 1.0) + (
        c[3] + c[5 + len(LAGS):-1].sum()) + 3.0 * c[4] * peak ** 2
    noise = np.hypot(sd * np.interp(ln_n, _LN_N, _DEVIATION), AT_PEAK / math.sqrt(12.0) * slope)
    brief = np.maximum((BLOCK / np.maximum(stay, BLOCK)) ** 2, _LASTING)
    return mean - sd * np.interp(ln_n, _LN_N, _MEAN), noise, np.sqrt(known), brief


class FlightHistory:
    """Past blocks; rows of `table`: lowest, last median of three, V; mean, highest throttle."""

    def __init__(self) -> None:
        self._clear()

    def _clear(self) -> None:
        self.table: FloatArray = np.empty((4, 0))
        self._start = NAN
        self._tail: FloatArray = np.empty(0)
        # Number of samples in the last block.
        self._last = 0

    @property
    def end(self) -> float:
        """Stamp at which the last block ends, s; NaN without blocks."""
        return float(self._start + self.table.shape[1] * BLOCK)

    def push(self, t: FloatArray, voltage: FloatArray, throttle: FloatArray) -> None:
        """Add samples with rising stamps, s, finite voltages, V, and throttles, 0..1."""
        pauses = np.flatnonzero(np.diff(t, prepend=self.end if self._tail.size else t[0]) > KEPT)
        if pauses.size:
            # Earlier blocks are too old to keep.
            self._clear()
            t, voltage, throttle = (x[pauses[-1]:] for x in (t, voltage, throttle))
        v = np.concatenate((self._tail, voltage))
        if not self._tail.size:
            v = np.concatenate((v[:1], v[:1], v))
        medians = np.maximum(np.minimum(v[:-2], v[1:-1]),
                             np.minimum(np.maximum(v[:-2], v[1:-1]), v[2:]))
        self._tail = v[-2:]
        if not math.isfinite(self._start):
            self._start = float(t[0])
        at = np.floor((t - self._start) / BLOCK).astype(np.intp)
        begin = np.flatnonzero(np.diff(at, prepend=-1))
        count = np.diff(begin, append=at.size)
        rows = np.stack([np.minimum.reduceat(medians, begin), medians[begin + count - 1],
                         np.add.reduceat(throttle, begin) / count,
                         np.maximum.reduceat(throttle, begin)])
        self._place(at[begin], rows, count)

    def _place(self, at: np.ndarray, rows: FloatArray, count: np.ndarray) -> None:
        """Insert the rows of blocks `at`; fill short gaps with the last values, long ones: NaN."""
        old = self.table.shape[1]
        if at[0] < old:
            # Combine the first row with earlier samples of its block.
            last = self.table[:, at[0]]
            rows[0, 0] = min(rows[0, 0], last[0])
            rows[3, 0] = max(rows[3, 0], last[3])
            earlier = self._last / (self._last + count[0])
            rows[2, 0] += earlier * (last[2] - rows[2, 0])
            count[0] += self._last
        self._last = int(count[-1])
        new = np.full((4, max(at[-1] + 1 - old, 0)), NAN)
        table = np.concatenate((self.table, new), axis=1)
        table[:, at] = rows
        filled = np.concatenate(([old - 1] if old else [], at[at >= old])).astype(np.intp)
        for a, b in zip(filled[:-1], filled[1:]):
            if 1 < b - a <= SILENCE / BLOCK:
                table[:, a + 1:b] = table[[1, 1, 2, 2], a][:, None]
        extra = table.shape[1] - round(KEPT / BLOCK)
        if extra > 0:
            table = table[:, extra:]
            self._start += extra * BLOCK
        self.table = table

    def throttles(self, seconds: float, ago: float) -> FloatArray:
        """Return the mean throttle of each block in a span, s, that ended `ago` s before now."""
        end = self.table.shape[1] - round(ago / BLOCK)
        mean = self.table[2, max(0, end - round(seconds / BLOCK)):max(0, end)]
        return np.asarray(mean[np.isfinite(mean)])

    def used(self, seconds: float, share: float) -> float:
        """Return the throttle exceeded for a share of the last seconds; NaN if none is known."""
        high = self.table[3, -round(seconds / BLOCK):]
        high = high[np.isfinite(high)]
        return float(np.quantile(high, 1.0 - share)) if high.size else NAN

    def activity(self) -> float:
        """Return the mean sqrt|du| between blocks in the last minute."""
        change = np.abs(np.diff(self.table[2, -round(60.0 / BLOCK):]))
        change = change[np.isfinite(change)]
        # Round first, because the square root of a rounding error is 1e-8.
        return float(np.sqrt(np.round(change, 12)).mean()) if change.size else 0.0

    def outcome(self, t: float, horizon: float) -> tuple[float, float, float] | None:
        """Return lowest voltage, highest throttle, and time there, s; None: incomplete horizon."""
        begin = math.floor((t - self._start) / BLOCK) + 1
        end = begin + max(1, round(horizon / BLOCK))
        if begin < 0 or end > self.table.shape[1]:
            return None
        low, _, mean, high = self.table[:, begin:end]
        lowest, peak = float(low.min()), float(high.max())
        if math.isnan(lowest):
            return None
        at = int((mean >= peak - AT_PEAK).sum())
        return lowest, peak, max(at, 1) * BLOCK

    def drops(self, horizon: float) -> FloatArray:
        """Return the fall to the lowest voltage in each completed horizon, V; oldest first."""
        width = max(1, round(horizon / BLOCK))
        low, last = self.table[0], self.table[1]
        if low.size <= width:
            return np.empty(0)
        drop = last[:-width] - sliding(np.minimum, low[1:], width)
        return np.asarray(drop[np.isfinite(drop)])


def throttle_gap(throttle: FloatArray) -> tuple[float, float]:
    """Return the ends of the first wide gap in throttle, as of a switch; NaN without one."""
    values = np.unique(throttle[np.isfinite(throttle)])
    wide = np.flatnonzero(np.diff(values) > _WIDE)
    return (values.item(wide[0]), values.item(wide[0] + 1)) if wide.size else (NAN, NAN)


def sliding(least: np.ufunc, x: FloatArray, width: int) -> FloatArray:
    """Return the minimum or maximum of each window of `width` values, by doubling."""
    size, out = 1, x
    while 2 * size <= width:
        out = least(out[:-size], out[size:])
        size *= 2
    rest = width - size
    return np.asarray(least(out[:out.size - rest], out[rest:]) if rest else out)


# Logistic fit: horizons, s, and for each the coefficients of 1, of margin less mean drop, and of
# margin.
_LN_HORIZON = np.log([1.0, 2.0, 5.0])
_COEFFICIENTS = np.array([(-0.90, -0.62, -0.34), (-0.52, -0.12, -0.68), (-1.08, 0.23, -0.52)])
# Maximum margin of the fit, in standard deviations of the drops, and power of the margin with
# which the risk falls beyond it.
_FARTHEST, _POWER = 8.0, 5.0
_RECENT = 5.0  # Time over which the standard deviation gives the added drop, s
# Minimum deviation, as a share of the voltage; needed for a constant source.
_LEAST = 1e-3
# Minimum deviation, V; needed at 0 V.
_SMALLEST = 1e-6
# Minimum number of blocks: one second.
_FEWEST = round(1.0 / BLOCK)


def excursions(past: FlightHistory, horizon: float) -> tuple[float, float]:
    """Return mean and deviation, V, of the drops within a horizon, s; NaN in the first second."""
    if past.table.shape[1] < _FEWEST:
        return NAN, NAN
    last = past.table[1]
    recent = last[-round(_RECENT / BLOCK):]
    recent = recent[np.isfinite(recent)]
    drops = past.drops(horizon)
    # Overlapping horizons count in part: by the ratio of block to horizon.
    n = drops.size * BLOCK / max(horizon, BLOCK)
    first = 2.0 * float(recent.std())
    least = max(_LEAST * abs(float(last[-1])), _SMALLEST)
    if not drops.size:
        return first, max(first, least)
    mean = (n * float(drops.mean()) + first) / (n + 1.0)
    square = (n * float(((drops - mean) ** 2).mean()) + (first - mean) ** 2) / (n + 1.0)
    return mean, max(math.sqrt(square), least)


def excursion_risk(now: float, levels: FloatArray, horizon: float, mean: float, deviation: float
                   ) -> FloatArray:
    """Return the risk at levels, V, shape (k,); the risk falls as the margin grows."""
    b = [float(np.interp(math.log(horizon), _LN_HORIZON, column)) for column in _COEFFICIENTS.T]
    margin = np.maximum(now - levels, 0.0) / deviation
    far = np.minimum(margin, _FARTHEST)
    score = b[0] + b[1] * np.clip(far - mean / deviation, -4.0, _FARTHEST) + b[2] * far
    return np.asarray(np.minimum(1.0, _FARTHEST / np.maximum(margin, _FARTHEST)) ** _POWER / (
        1.0 + np.exp(-score)))


# Scales over which the weight of a past horizon falls: difference in throttle, and age, s.
_LIKE, _MEMORY = 0.25, 100.0
# Added rises, as shares of the range above the present throttle; their dwell, in horizons.
_RISES, _RISE_DWELL = (0.1, 0.3, 0.5, 0.7, 0.9), 0.2
# Minimum distance between starts of horizons, in s and in horizons; maximum number of starts.
_APART, _SHARE, _MOST = 0.2, 0.1, 320


@dataclass(frozen=True, eq=False)
class FlownHorizons:
    """Throttle in completed horizons: first, peak, dwell (s), rest; age (s); shapes (k,)."""

    first: FloatArray
    peak: FloatArray
    dwell: FloatArray
    rest: FloatArray
    age: FloatArray


def flown(past: FlightHistory, horizon: float) -> FlownHorizons:
    """Return the throttle in completed horizons (horizon in s)."""
    width = max(1, round(horizon / BLOCK))
    mean, high = past.table[2], past.table[3]
    n = mean.size - width
    if n <= 0:
        none = np.empty(0)
        return FlownHorizons(none, none, none, none, none)
    step = max(1, round(_APART / BLOCK), round(_SHARE * width), -(-n // _MOST))
    at = np.arange((n - 1) % step, n, step)
    peak = sliding(np.maximum, high[1:], width)[at]
    within = sliding_window_view(mean[1:], width)[at]
    near = within >= peak[:, None] - AT_PEAK
    count = near.sum(axis=1)
    total = within.sum(axis=1)
    rest = np.where(count < width, (total - (within * near).sum(axis=1))
                    / np.maximum(width - count, 1), peak)
    good = np.isfinite(total + mean[at])
    # At least one block, because even the mean of the block with the peak may be below the peak.
    dwell = np.maximum(count, 1) * BLOCK
    return FlownHorizons(*(x[good] for x in (mean[at], peak, dwell, rest, (n - 1 - at) * BLOCK)))


def pilot(past: FlownHorizons, throttle: float, horizon: float) -> tuple[Courses, FloatArray]:
    """Return the courses that may follow a throttle, and their weights, which add up to 1."""
    weight = np.exp(-0.5 * ((past.first - throttle) / _LIKE) ** 2 - past.age / _MEMORY)
    if past.age.size > 1:
        weight *= min((past.age[0] - past.age[1]) / horizon, 1.0)
    n = len(_RISES)
    ahead = throttle + (1.0 - throttle) * np.array(_RISES)
    weight = np.concatenate((weight, np.full(n, 1.0 / n)))
    courses = Courses(
        np.concatenate((np.maximum(past.peak, throttle), ahead)),
        np.concatenate((past.dwell, np.full(n, _RISE_DWELL * horizon))),
        np.concatenate((past.rest, np.full(n, throttle))))
    return courses, weight / weight.sum()
