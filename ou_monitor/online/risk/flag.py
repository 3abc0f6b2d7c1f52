"""
The brown-out flag: a level from risks and a voltage floor.

doc/risk.md lists the levels, and when they are entered and left.  The flag is only as good as the
risk.  If the risk is unknown, the level is UNKNOWN, never OK, and the flag is never false.

The voltage floor is a threshold on the samples, without a model.  It is compared with the median
of the last `brownout.floor_time` seconds, so that a single wrong sample has no effect.  Every
sample is checked, also those between two reports.  A sample whose stamp is late, frozen, irregular
or missing is placed by its arrival; samples that arrive together are spaced by the usual interval.
The next update reports a dip even if nothing has arrived since.  Limit: a wrong value that a
logger repeats for more than half of `brownout.floor_time` counts as a dip.
"""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.online.trust import SLOW_MISSED
from ou_monitor.records import FloatArray, NAN

# Minimum number of samples for the median: among three, a single wrong one has no effect.
_FEWEST = 3
# If a whole batch is older than the newest sample by more than this, s, a new time line begins.
_BACK = 1.0
# Number of arrivals over which the usual interval is averaged.
_USUAL = 200
# Maximum number of samples kept: the longest floor_time, 10 s, at 20 kHz.
_MOST = 200_000
# Maximum step forward of the time line, in units of `_longest_gap`: twice the span of three
# samples.  Without a limit, random stamps would advance the time line until a float no longer
# resolves milliseconds.
_FAR = 4.0


class FloorWatch:
    """
    Detects a voltage at or below the floor; `dips` counts the falls to the floor.

    Three samples that span more than twice `stale_after` are not combined in a median, unless the
    source is slow; `interval`: time between the samples of a slow source, s, otherwise 0.
    """

    def __init__(self, settings: MonitorSettings) -> None:
        self.settings = settings
        self.dips = 0
        self.interval = 0.0
        self._usual = math.nan
        self.reset()

    def reset(self) -> None:
        """Forget the samples, and start a new time line."""
        self._newest = self._arrived = -math.inf
        # Added to stamps, s: each late sample shifts the time line of all later samples.
        self._shift = 0.0
        self._t = np.empty(0)
        self._v = np.empty(0)
        self._low = self._was_low = self._in_dip = False

    def new_time_line(self) -> None:
        """Accept stamps that start again; samples that came with arrival times remain valid."""
        if self._arrived == -math.inf:
            self.reset()

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             arrival: npt.ArrayLike | None = None) -> None:
        """
        Judge samples (t in s, voltage in V, arrival in s on a monotonic clock).

        With `arrival`, samples are judged in the order given, and a stamp may be NaN.  Without it,
        a batch is sorted by its stamps if all are newer than the earlier ones.
        """
        if self.settings.floor <= 0.0:
            if self._t.size:
                self.reset()
            return
        stamps, volts = _column(t), _column(voltage)
        times = None if arrival is None else _column(arrival)
        if stamps.shape != volts.shape or (times is not None and times.shape != volts.shape):
            raise ValueError(f't {stamps.shape} and voltage {volts.shape} differ in shape')
        good = np.isfinite(volts) & np.isfinite(stamps if times is None else times)
        if not good.all():
            stamps, volts = stamps[good], volts[good]
            times = None if times is None else times[good]
        if stamps.size:
            self._judge(*self._placed(stamps, volts, times))

    def _placed(self, t: FloatArray, v: FloatArray, arrival: FloatArray | None
                ) -> tuple[FloatArray, FloatArray]:
        """Return times on a time line that never goes back, s, and voltages in that order, V."""
        if arrival is None:
            if t.max() < self._newest - _BACK:
                self.reset()
            if t.min() > self._newest:
                order = np.argsort(t, kind='stable')
                t, v = t[order], v[order]
        steps = np.diff(t, prepend=self._newest)
        # The comparison is false for NaN, so a missing stamp counts as a late stamp.
        late = ~(steps > 0.0)
        far = _FAR * self._longest_gap
        at = t + self._shift
        if arrival is not None or late.any() or (steps[np.isfinite(steps)] > far).any():
            elapsed = np.cumsum(np.where(late, self._late_steps(arrival), np.minimum(steps, far)))
            if self._t.size:
                at = float(self._t[-1]) + self._paced(elapsed, arrival)
            else:
                at = self._paced(elapsed - elapsed[0], arrival)
            self._shift = float(at[-1] - t[-1])
        if arrival is not None:
            self._learn(arrival, self._arrived)
            self._arrived = float(arrival[-1])
        elif not late.any():
            self._learn(t, self._newest)
        self._newest = float(t[-1])
        return at, v

    @property
    def _longest_gap(self) -> float:
        """Longest time, s, between two samples that are combined in a median."""
        return max(self.settings.stale_after, SLOW_MISSED * self.interval)

    def _late_steps(self, arrival: FloatArray | None) -> FloatArray | float:
        """Return the time by which late samples advance the time line, s."""
        if arrival is None or self._arrived == -math.inf:
            # If the interval is unknown, assume half of `brownout.floor_time`, so that three
            # samples are compared.
            return (0.5 * self.settings.brownout_floor_time if math.isnan(self._usual)
                    else self._usual)
        return np.maximum(np.diff(arrival, prepend=self._arrived), 0.0)

    def _paced(self, elapsed: FloatArray, arrival: FloatArray | None) -> FloatArray:
        """Return times since the newest sample, s; space simultaneous samples by the interval."""
        if arrival is None or math.isnan(self._usual):
            return elapsed
        least = self._usual * np.arange(1.0, elapsed.size + 1.0)
        return least + np.maximum.accumulate(np.maximum(elapsed - least, 0.0))

    def _learn(self, times: FloatArray, before: float) -> None:
        """Update the usual interval (times in s); a pause counts at most as twice the interval."""
        known = before > -math.inf
        n = times.size - 1 + known
        if not n:
            return
        span = float(times[-1]) - (before if known else float(times[0]))
        most = 2.0 * self._usual if self._usual > 0.0 else self._longest_gap
        interval = min(max(span / n, 0.0), most)
        share = 1.0 if math.isnan(self._usual) else min(1.0, n / _USUAL)
        usual = 0.0 if math.isnan(self._usual) else self._usual
        self._usual = usual + share * (interval - usual)

    def _judge(self, t: FloatArray, v: FloatArray) -> None:
        """Judge every new sample together with earlier ones; `t` does not decrease."""
        s = self.settings
        old = self._t.size
        t, v = np.concatenate([self._t, t]), np.concatenate([self._v, v])
        ends = np.arange(old, t.size)
        begin = np.searchsorted(t, t[ends] - s.brownout_floor_time, 'right')
        near = np.searchsorted(t, t[ends] - 2.0 * self._longest_gap, 'left')
        begin = np.minimum(begin, np.maximum(ends - _FEWEST + 1, near))
        below = np.concatenate([[0], np.cumsum(v <= s.floor)])
        count = below[ends + 1] - below[begin]
        # The median is at or below the floor if more than half of the samples are.
        low = (count > 1) & (2 * count > ends + 1 - begin)
        # A single sample in the window neither starts nor ends a dip.
        sure = low[ends > begin]
        self.dips += int(np.count_nonzero(sure & ~np.append(self._in_dip, sure)[:-1]))
        self._in_dip = bool(sure[-1]) if sure.size else self._in_dip
        self._low = bool(low[-1])
        self._was_low = self._was_low or bool(low.any())
        first = max(int(begin[-1]), t.size - _MOST)
        self._t, self._v = t[first:], v[first:]

    def take(self, arriving: bool = True) -> bool:
        """Return whether the voltage was low since the last call, or is now (if `arriving`)."""
        low, self._was_low = self._was_low or (self._low and arriving), False
        return low and self.settings.floor > 0.0


def _column(values: npt.ArrayLike) -> FloatArray:
    return np.atleast_1d(np.asarray(values, dtype=np.float64))


class FlagLevel(enum.Enum):
    """Levels of the flag; the values order the levels."""

    UNKNOWN = -1
    OK = 0
    WARN = 1
    CRITICAL = 2


@dataclass(frozen=True)
class FlagState:
    """The flag at one instant."""

    level: FlagLevel = FlagLevel.UNKNOWN
    # True at CRITICAL; False at OK and WARN if the risk is known; otherwise None.
    brownout: bool | None = None
    since: float = NAN  # When the level was entered, s, on the caller's clock
    reason: str = 'nothing is known yet'  # A clause without a full stop
    age: float = NAN  # Time spent in the level, s
    low: bool = False  # Whether the voltage is at or below the floor, or was since the last update
    dips: int = 0  # Number of falls of the voltage to the floor so far


class BrownoutFlag:
    """State machine of the flag, by the `brownout_*` settings and `stale_after`."""

    def __init__(self, settings: MonitorSettings | None = None) -> None:
        self._settings = settings or MonitorSettings()
        self._floor = FloorWatch(self._settings)
        self._now = self._last = NAN
        self._level = FlagLevel.UNKNOWN
        # Time at which the level was entered; last time at which the risk was known or the voltage
        # was at the floor.
        self._since = self._known = NAN
        # For each level, the time since which its condition has held.
        self._above: dict[FlagLevel, float] = {}
        self._state = FlagState()
        # Why UNKNOWN is reported in place of OK and WARN; empty: UNKNOWN is not forced.
        self._doubt = ''

    @property
    def settings(self) -> MonitorSettings:
        """Return the present settings."""
        return self._settings

    @property
    def state(self) -> FlagState:
        """Return the result of the last update."""
        return self._state

    def configure(self, settings: MonitorSettings) -> None:
        """Change settings; keep level, hold and samples.  Switching off the latch releases it."""
        self._settings = self._floor.settings = settings

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             arrival: npt.ArrayLike | None = None, interval: float = 0.0) -> None:
        """Check samples against the floor; see `FloorWatch` (interval in s)."""
        self._floor.interval = interval
        self._floor.push(t, voltage, arrival)

    def new_time_line(self) -> None:
        """Accept stamps that start again; level and hold are kept."""
        self._floor.new_time_line()

    def clear(self) -> bool:
        """Clear a CRITICAL that is latched or held; the next update judges again."""
        if self._level is not FlagLevel.CRITICAL:
            return False
        self._enter(FlagLevel.UNKNOWN)
        self._above.clear()
        self._state = FlagState(since=self._since, reason='cleared, not judged since',
                                dips=self._floor.dips)
        return True

    def set_critical(self, reason: str) -> None:
        """Set CRITICAL, for a latch that is restored after a restart."""
        self._enter(FlagLevel.CRITICAL)
        self._state = FlagState(FlagLevel.CRITICAL, True, self._since, reason)

    def doubt(self, reason: str) -> None:
        """Report UNKNOWN for this reason in place of OK and WARN, from now on."""
        self._doubt = reason

    def update(self, t: float, risk: float, soon: float | None = None, tight: bool = False, *,
               fresh: bool = True, arriving: bool | None = None) -> FlagState:
        """
        Judge the level (t in s).

        `risk`: within the horizon; `soon`: within the next second at the present throttle (omitted
        or NaN: as `risk`).  `tight`: whether the budget is below the throttle in use.  `fresh`:
        whether the samples behind the risk are recent.  `arriving` (default: `fresh`): whether
        samples still arrive, whatever their stamps; then a last sample at the floor still counts.
        """
        soon = risk if soon is None or math.isnan(soon) else soon
        for one in (risk, soon):
            if one < 0.0 or one > 1.0:
                raise ValueError(f'a risk must lie within 0..1 or be NaN, got {one}')
        self._set_clock(t)
        low = self._floor.take(fresh if arriving is None else arriving)
        known = fresh and not math.isnan(risk)
        wanted, reason = self._wanted(risk, soon, tight, known, low)
        level, reason = self._after_hold(wanted, reason, known or low)
        if level is not self._level:
            self._enter(level)
        if known or low:
            self._known = self._now
        flag = True if level is FlagLevel.CRITICAL else (
            False if known and level is not FlagLevel.UNKNOWN else None)
        if self._doubt and level is not FlagLevel.CRITICAL:
            level, flag, reason = FlagLevel.UNKNOWN, None, self._doubt
        self._state = FlagState(level, flag, self._since, reason, self._now - self._since, low,
                                self._floor.dips)
        return self._state

    def _set_clock(self, t: float) -> None:
        """Set the clock; if it steps back, stored times are shifted by the same step."""
        self._now = t if math.isfinite(t) else NAN
        if math.isnan(self._now):
            return
        step = t - self._last
        if step < 0.0:
            self._since += step
            self._known += step
            self._above = {level: start + step for level, start in self._above.items()}
        self._last = t
        if math.isnan(self._since):
            self._since = t

    def _enter(self, level: FlagLevel) -> None:
        self._level, self._since = level, self._now

    def _wanted(self, risk: float, soon: float, tight: bool, known: bool, low: bool
                ) -> tuple[FlagLevel, str]:
        """Return the level by risks and floor, before hold and latch, and the reason."""
        s = self._settings
        asks = {FlagLevel.CRITICAL: (soon, s.brownout_critical, f'risk {soon:.2g} within 1 s, '
                                     'at the present throttle'),
                FlagLevel.WARN: (risk, s.brownout_warn, f'risk {risk:.2g}')}
        above = [level for level, (found, enter, _) in asks.items() if known and found >= enter]
        if tight and known and FlagLevel.WARN not in above:
            above.append(FlagLevel.WARN)
        self._above = {level: self._above.get(level, self._now) for level in above}
        if low:
            return FlagLevel.CRITICAL, (
                f'the voltage is at or below brownout.floor ({s.floor:g} V)')
        if not known:
            return FlagLevel.UNKNOWN, 'the risk is not known'
        for level, (found, enter, words) in asks.items():
            word = level.name.lower()
            if level in above and not (self._level.value < level.value and (
                    self._now - self._above[level] < s.brownout_delay)):
                return level, (f'{words} (brownout.{word}: {enter:g})' if found >= enter else
                               'throttle was above the present budget for a tenth of the last '
                               '30 s')
            leave = s.brownout_leave * enter
            if self._level.value >= level.value and found >= leave:
                return level, (f'{words}, has not fallen below {leave:.2g} '
                               f'(brownout.leave x brownout.{word})')
        if above:
            # All levels in `above` are delayed, so they are higher than the present level.
            return self._level, (f'risk {max(risk, soon):.2g} waits for brownout.delay '
                                 f'({s.brownout_delay:g} s)')
        return FlagLevel.OK, f'risk {risk:.2g} (brownout.warn: {s.brownout_warn:g})'

    def _after_hold(self, wanted: FlagLevel, reason: str, sure: bool) -> tuple[FlagLevel, str]:
        """Return the level after latch and hold."""
        s = self._settings
        if wanted.value >= self._level.value:
            return wanted, reason
        if s.brownout_latch and self._level is FlagLevel.CRITICAL:
            return self._level, f'latched until cleared; {reason}'
        if self._level is FlagLevel.OK:
            return wanted, reason
        start = self._since if sure else self._known
        if self._now - start < s.brownout_hold:
            return self._level, f'held for brownout.hold ({s.brownout_hold:g} s); {reason}'
        return wanted, reason
