"""
Notches that follow the motors: from their speed, else from throttle; off where they do not pay.

samples -> frames -> spectrum -> law (throttle to frequency) and choice (which notches, or none)
-> frequency, width and share of each notch, sample by sample -> output.

Limits: it takes away what follows the motors, and nothing else.  It needs motor speeds or
throttle.  What lies above half the sample rate has folded down and is followed by neither.
A change of the vehicle is learned within half a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff_control import SampleInterval
from ou_monitor.online.filter.lowpass import FilterCounters
from ou_monitor.online.notch.biquads import HIGHEST, Notch, phase_lag
from ou_monitor.online.notch.choice import Candidate, Choice, Frames
from ou_monitor.online.notch.motors import MotorLaw, MotorSpeeds
from ou_monitor.online.notch.settings import NotchSettings
from ou_monitor.records import FloatArray

NAN = math.nan
# Beyond these a state could overflow, see `lowpass`.
_LARGEST, _LATEST, _SHORTEST = 1e150, 1e18, 1e-12
# A step of so many intervals is a gap; samples from which the interval is known; a change of it
# that is a new rate.
_GAP, _KNOWN, _OTHER = 5.0, 64, 0.1
# s: motors follow a step of throttle with it (25 ms on a 5 inch propeller); notches are faded,
# and moved in width and frequency.
_SPIN_UP, _FADE, _WIDEN, _MOVE = 0.03, 0.2, 0.05, 0.004
# Throttle is taken as it was for so long, s.
_HELD = 1.0
_LAG_FREQUENCY = 10.0

_Maybe = npt.ArrayLike | None


class AdaptiveNotch:
    """
    One to four notches that follow the motors.

    Parameters
    ----------
    **options
        Fields of `NotchSettings`.

    Raises
    ------
    ValueError
        For an option that is unknown or out of range, or eRPM without the
        number of poles.

    """

    def __init__(self, **options: object) -> None:
        self._settings = NotchSettings.from_options(options)
        self._speeds = MotorSpeeds(self._settings.per_unit, self._settings.stale_after)
        self.counters = FilterCounters()
        self._t: float | None = None
        self._out: list[float] = []
        self._banks: list[list[Notch]] = []
        self._interval = SampleInterval()
        self._since = 0
        self._frames: Frames | None = None
        self._law: MotorLaw | None = None
        self._choice: Choice | None = None
        # Square root of throttle as the motors follow it, and when throttle was heard.
        self._root, self._asked, self._heard = NAN, NAN, -math.inf
        self._motors: list[float] = []
        self._sources: set[str] = set()

    @property
    def settings(self) -> NotchSettings:
        """Return the settings in force."""
        return self._settings

    @property
    def active(self) -> bool:
        """Whether any notch is in force in any channel."""
        return any(one.share > 0.0 for bank in self._banks for one in bank)

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies of the notches in force in the channel with most, Hz; empty: none."""
        rate = self.rate
        each = [[one.ratio * rate for one in bank if one.share > 0.0] for bank in self._banks]
        return np.array(max(each, key=len, default=[]), dtype=np.float64)

    @property
    def rate(self) -> float:
        """Sample rate, Hz; NaN while not known."""
        return 1.0 / self._interval.mean if self._interval.mean > 0.0 else NAN

    @property
    def law(self) -> tuple[float, float]:
        """Return a and b of f = a + b sqrt(throttle), Hz; NaN while not known."""
        return (NAN, NAN) if self._law is None else (self._law.a, self._law.b)

    @property
    def source(self) -> str:
        """Return what the notches follow: 'rpm', 'throttle' or 'none'."""
        chosen = [] if self._choice is None else self._choice.chosen
        found = {one.family.source for one in chosen if one is not None}
        return 'rpm' if 'rpm' in found else 'throttle' if found else 'none'

    @property
    def delay(self) -> float:
        """Phase delay of the notches in force at 10 Hz, s, in the channel where it is largest."""
        return max(self.delays(_LAG_FREQUENCY), default=0.0)

    def delays(self, frequency: float) -> list[float]:
        """
        Return the phase delay of the notches in force in each channel, s.

        frequency in Hz.
        """
        ratio = frequency * self._interval.mean
        if not 0.0 < ratio < 0.5:
            return [0.0] * len(self._banks)
        return [phase_lag(bank, ratio) / (2.0 * math.pi * frequency) for bank in self._banks]

    def configure(self, **options: object) -> None:
        """
        Change options; the output does not jump, what was learned stays where it can.

        Raises
        ------
        ValueError
            For an option that cannot be used; the old ones stay.

        """
        old = self._settings
        self._settings = s = NotchSettings.from_options(options, base=old)
        self._speeds.configure(s.per_unit, s.stale_after)
        if (s.count, s.fmin, s.cutoff) != (old.count, old.fmin, old.cutoff):
            self._frames = self._law = self._choice = None

    def filter(self, t: npt.ArrayLike, x: npt.ArrayLike,  # noqa: A003
               throttle: _Maybe = None, rpm: _Maybe = None) -> FloatArray | float:
        """
        Filter samples; the state is carried over from call to call.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  At a repeat or a step back the output stays.
        x : float or array_like, shape (n,) or (n, channels)
            Signal, any unit.  A sample with NaN is counted, and the output stays.
        throttle : float or array_like, shape (n,), optional
            Throttle, 0..1; NaN: as it was, for a second.
        rpm : array_like, shape (n,) or (n, motors), or (motors,) with one number t, optional
            Motor speeds, in `rpm_unit`; NaN: nothing came.

        Returns
        -------
        float or ndarray, shape of x
            Filtered signal; NaN until the first finite sample.

        Raises
        ------
        ValueError
            When the shapes differ, or the number of channels changes.

        """
        stamps, signal = np.asarray(t, dtype=np.float64), np.asarray(x, dtype=np.float64)
        if stamps.ndim > 1 or signal.ndim > stamps.ndim + 1 or (
                signal.shape[:stamps.ndim] != stamps.shape):
            raise ValueError('t must be a number or of shape (n,), and x of shape (n,) or (n, '
                             f'channels) with it: got {stamps.shape} and {signal.shape}')
        n = stamps.size
        u = np.asarray(NAN if throttle is None else throttle, dtype=np.float64)
        if u.shape not in ((), stamps.shape):
            raise ValueError(f'throttle must be one number or of the shape of t, {stamps.shape}: '
                             f'got {u.shape}')
        speeds = np.empty((n, 0)) if rpm is None else np.asarray(rpm, dtype=np.float64)
        if rpm is not None:
            if speeds.ndim > stamps.ndim + 1 or (
                    speeds.ndim and stamps.ndim and speeds.shape[0] != n):
                raise ValueError(f'rpm must be of shape (n,) or (n, motors) with t of '
                                 f'{stamps.shape}: got {speeds.shape}')
            speeds = np.broadcast_to(speeds.reshape(n, -1) if speeds.ndim else speeds,
                                     (n, 1) if not speeds.ndim else (n, speeds.size // max(n, 1)))
        rows = signal.reshape(n, -1).tolist() if n else []
        out = [self.step(*one) for one in zip(
            stamps.reshape(n).tolist(), rows, np.broadcast_to(u, stamps.shape).reshape(n).tolist(),
            speeds.tolist(), strict=True)]
        found = np.array(out, dtype=np.float64).reshape(signal.shape)
        return float(found) if signal.ndim == 0 else found

    def step(self, t: float, values: Sequence[float], throttle: float = NAN,
             rpm: Sequence[float] = ()) -> list[float]:
        """Filter one sample of each channel; as `filter` (the node's short way)."""
        if self._out and len(values) != len(self._out):
            raise ValueError(f'the number of channels changed from {len(self._out)} to '
                             f'{len(values)}: make a new notch for another signal')
        if not abs(t) < _LATEST or not all(abs(x) < _LARGEST for x in values):
            self.counters.non_finite += 1
            return self._out or [NAN] * len(values)
        if self._t is None:
            self.counters.samples += 1
            self._banks = [[Notch(x) for _ in range(4)] for x in values]
            self._t, self._out = t, list(values)
            self._listen(t, 0.0, throttle, rpm)
            return self._out
        dt = t - self._t
        if dt < _SHORTEST:
            if dt < 0.0:
                self._t = t
                self.counters.back += 1
            else:
                self.counters.repeated += 1
            return self._out
        self.counters.samples += 1
        gap = dt > _GAP * self._interval.mean and self.counters.samples > _KNOWN
        self._time(dt)
        self._t = t
        self._listen(t, dt, throttle, rpm)
        self._watch(t, values, dt)
        if gap:
            self.counters.gaps += 1
            for bank, x in zip(self._banks, values, strict=True):
                for one in bank:
                    one.restart(x)
        self._out = [self._filtered(c, x, dt) for c, x in enumerate(values)]
        return self._out

    def _time(self, dt: float) -> None:
        """Follow the interval; a new rate begins anew."""
        mean = self._interval.add(dt)
        if self._frames is None:
            self._since += 1
        elif abs(mean / self._frames.interval - 1.0) > _OTHER:
            self._frames = self._law = self._choice = None
            self._interval, self._since = SampleInterval(), 0
            self._interval.add(dt)

    def _listen(self, t: float, dt: float, throttle: float, rpm: Sequence[float]) -> None:
        """Take throttle and motor speeds."""
        if throttle == throttle:
            self._asked, self._heard = math.sqrt(min(max(throttle, 0.0), 1.0)), t
        elif not t - self._heard <= _HELD:
            self._root = self._asked = NAN
        if self._asked == self._asked:
            off = self._asked - self._root if self._root == self._root else NAN
            self._root = self._asked if off != off else (
                self._root - off * math.expm1(-dt / _SPIN_UP))
        if len(rpm):
            self._speeds.take(t, rpm)
        highest = HIGHEST / self._interval.mean if self._interval.mean > 0.0 else 0.0
        self._motors = [one for one in self._speeds.now(t, self._settings.count)
                        if self._settings.fmin <= one <= highest]

    def _watch(self, t: float, values: Sequence[float], dt: float) -> None:
        """Learn from the signal."""
        s, channels = self._settings, len(values)
        if self._frames is None:
            if not s.count or self._since < _KNOWN or HIGHEST / self._interval.mean < 1.2 * s.fmin:
                return
            self._frames = frames = Frames(self._interval.mean)
            rate = 1.0 / frames.interval
            self._law = MotorLaw(frames.frequencies, s.fmin, rate)
            self._choice = Choice(frames.frequencies, (s.fmin, s.cutoff), rate, channels, s.count)
        speeds = self._motors + [NAN] * (s.count - len(self._motors))
        due = self._frames.add(t, [*values, self._root, *speeds])
        sources = {name for name, known in (('throttle', self._root == self._root),
                                            ('rpm', bool(self._motors))) if known}
        if due and self._law is not None and self._choice is not None:
            power, rest = self._frames.take(channels)
            passed = self._frames.hop * self._frames.interval
            root, motors = float(rest[0]), rest[1:]
            power, lost = self._choice.usual(power, passed)
            # First what the law as it was would have come to, then the law learns.
            self._choice.take(power, self._law.frequency(root), motors[np.isfinite(motors)],
                              passed)
            if root == root:
                self._law.learn(self._choice.low_passed(power), root, passed, lost)
        if self._choice is not None and (due or sources != self._sources):
            self._sources = sources
            self._choice.decide(sources)

    def _wanted(self, chosen: Candidate | None) -> list[float]:
        """Return the frequencies that a candidate has now, Hz; NaN: none."""
        if chosen is None or self._law is None:
            return []
        if chosen.family.source == 'throttle':
            return [self._law.frequency(self._root)] * chosen.family.times
        if chosen.family.many or not self._motors:
            return self._motors
        return [sum(self._motors) / len(self._motors)] * chosen.family.times

    def _filtered(self, c: int, x: float, dt: float) -> float:
        chosen = None if self._choice is None else self._choice.chosen[c]
        wanted = self._wanted(chosen)
        bank = self._banks[c]
        if not wanted and not any(one.share for one in bank):
            for one in bank:
                one.advance(x)
            return x
        interval, lowest = self._interval.mean, self._settings.fmin
        step, moved = dt / _FADE, -math.expm1(-dt / _MOVE)
        for k, one in enumerate(bank):
            f = wanted[k] if k < len(wanted) else NAN
            ratio = f * interval
            if chosen is not None and f >= lowest and ratio <= HIGHEST:
                if one.share == 0.0:
                    one.ratio, one.width = ratio, chosen.width
                elif abs(ratio - one.ratio) > 1e-5 * ratio:
                    one.ratio += (ratio - one.ratio) * moved
                one.width -= (chosen.width - one.width) * math.expm1(-dt / _WIDEN)
                one.share = min(one.share + step, 1.0)
            elif one.share > 0.0:
                one.share = max(one.share - step, 0.0)
            x = one.advance(x)
        return x
