"""
Notches that follow the motors, by motor speeds or else by throttle, and switch off if useless.

samples -> spectra of frames -> law (throttle to frequency) and choice (which notches, or none)
-> frequency, width and depth of each notch, sample by sample -> output.

**Law** for unknown motor speeds: f = a + b sqrt(u), learned from the noise.  The thrust of a motor
in hover is proportional to its speed squared.  So f is proportional to the square root of throttle
u if the controller's throttle is a thrust; otherwise, there is an offset.  The candidates are all
pairs of a frequency at `LOW` and one at `HIGH`; the score of each is the share of the past noise
(old frames are forgotten) that a notch at its frequency would have removed.  The highest score
wins.  (A law fitted to the median of the peaks would follow the most frequent peak, not the
strongest.)

**Choice** of notches in each channel: least noise in a D term at equal lag.  The noise of a
candidate is the power of the derivative above `fmin` after its notches and a low-pass of order 2.
The cutoff of this low-pass is raised until both together lag as much as the low-pass did alone.
The noise is computed for three low-passes: at `cutoff`, a slower and a faster one.  It is averaged
over frames, each scored before the law learns from it.  A channel uses the best candidate if less
than `_ON` of the rms without notches remains, and less noise with each of the low-passes.  It
changes to another candidate that has a tenth less power.  It switches off if `_OFF` or more
remains, or if the noise with any low-pass is not less.

Limits: only spectral lines that follow the motors are removed, and motor speeds or throttle are
needed.  The law does not resolve the speeds of single motors.  Lines above half the sample rate
are not followed, because their aliases fall as throttle rises.  A change of the vehicle is learned
in half a minute.  Frames with a gap of more than five intervals are dropped; frames with less
uneven stamps are resampled.

**Filters**: state-variable filters whose coefficients may change.  With w = 2 pi f and
k = bandwidth / f, one notch of depth m is

    s1' = w (x - s2 - k s1),  s2' = w s1,  y = x - m k s1

by the trapezoidal rule with g = tan(pi f dt), so that the zero lies exactly at f
(Zavalishin, The Art of VA Filter Design, 2012, ch. 4; Simper 2013):

    v1 = (g (x - s2) + s1) / (1 + g (g + k)),  v2 = s2 + g v1,  s <- 2 v - s.

A step of the coefficients causes a step of y, so the caller changes them smoothly.

The filter is stable under any sequence of f, k and m: with K the smallest k, P = [[1, e], [e, 1]]
and e < 4 K / (4 + K^2), s^T P s is a Lyapunov function for every k in K..2, and m is outside the
loop.  test_notch.py checks this for random coefficients.
"""

from __future__ import annotations

import cmath
from collections.abc import Iterable, Sequence
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.cutoff import SampleInterval
from ou_monitor.online.filter.lowpass import FilterCounters, LARGEST, LATEST, SHORTEST
from ou_monitor.online.settings import NotchSettings
from ou_monitor.records import FloatArray, NAN

# Speeds count as frozen if, after at least _CHANGES changes, they stay constant for _FROZEN mean
# intervals between changes, and for _STUCK seconds: no motor holds its speed to the last digit.
_CHANGES, _FROZEN, _STUCK = 20, 50.0, 1.0


class NewestSpeeds:
    """Newest motor speeds (per_unit: Hz per unit of the values received; stale_after in s)."""

    def __init__(self, per_unit: float, stale_after: float) -> None:
        self._per_unit, self._stale_after = per_unit, stale_after
        self._speeds: list[float] = []
        self._received = self._changed = self._first = -math.inf
        self._changes = 0

    def configure(self, per_unit: float, stale_after: float) -> None:
        """Change the unit, and the maximum age, s."""
        if per_unit != self._per_unit:
            self._speeds = []
        self._per_unit, self._stale_after = per_unit, stale_after

    def take(self, t: float, values: Sequence[float]) -> None:
        """Take the speeds received at t, s; ignore them if none is finite."""
        speeds = [abs(one) * self._per_unit if math.isfinite(one) else NAN for one in values]
        if all(one != one for one in speeds):
            return
        if self._first == -math.inf or t < self._received:
            self._first, self._changes = t, 0
            self._changed = t
        elif any(one != other for one, other in zip(speeds, self._speeds)
                 if one == one or other == other):
            self._changes += 1
            self._changed = t
        self._speeds, self._received = speeds, t

    def now(self, t: float, most: int) -> list[float]:
        """Return the mean speeds of up to `most` groups of motors, Hz; empty: unknown."""
        if not most or not t - self._received <= self._stale_after:
            return []
        if self._changes >= _CHANGES:
            usual = (self._changed - self._first) / self._changes
            if t - self._changed > max(_FROZEN * usual, _STUCK):
                return []
        if len(self._speeds) <= most:
            return self._speeds
        # Elements for motors that do not exist are 0.
        known = sorted(one for one in self._speeds if one > 0.0)
        if len(known) <= most:
            return known
        # Motors of similar speed share a notch.
        edges = [round(k * len(known) / most) for k in range(most + 1)]
        return [sum(known[a:b]) / (b - a) for a, b in zip(edges, edges[1:])]


# Square roots of throttle at which candidate laws are defined, within the usual range.
LOW, HIGH = 0.4, 0.85
_GRID = 48  # Number of frequencies at each of these
# Bandwidth over frequency of the notch with which laws are scored.
_WIDTH = 0.5
# Memory of frames, s; as a pack empties, the speed at a throttle falls within minutes.
_LAW_MEMORY = 30.0
# Prior score of the laws: share of the noise removed by f ~ sqrt(u); its weight, in frames;
# standard deviation of a / f(HIGH).
_PRIOR, _FRAMES, _SPREAD = 0.1, 8.0, 0.3


class MotorLaw:
    """Candidate laws, and the best of them: `a` and `b`, Hz, NaN while unknown."""

    def __init__(self, frequencies: FloatArray, fmin: float, rate: float) -> None:
        grid: FloatArray = np.geomspace(fmin, max(HIGHEST * rate, fmin * 1.01), _GRID)
        warped = np.tan(np.pi * np.minimum(frequencies / rate, 0.499))
        off = warped[None, :] / np.tan(np.pi * grid / rate)[:, None]
        cut = (_WIDTH * off)**2
        self._removed: FloatArray = cut / ((1.0 - off * off)**2 + cut)
        low, high = (grid[one] for one in np.triu_indices(_GRID))
        self._b = (high - low) / (HIGH - LOW)
        self._a = low - self._b * LOW
        self._prior: FloatArray = _FRAMES * _PRIOR * np.exp(
            -0.5 * (self._a / (_SPREAD * high))**2)
        self._found: FloatArray = np.zeros_like(low)
        # Widen the grid a little, so that rounding does not exclude laws that reach its ends.
        self._log: FloatArray = np.log(grid)
        self._log[[0, -1]] += -1e-3, 1e-3
        self.a = self.b = np.nan

    def frequency(self, root: float) -> float:
        """Return the frequency at a square root of throttle, Hz."""
        return float(self.a + self.b * root)

    def learn(self, power: FloatArray, root: float, passed: float,
              lost: float) -> None:
        """Take a frame, `passed` s after the last one; lost: further factor on old scores."""
        keep = float(np.exp(-passed / _LAW_MEMORY))
        removed = self._removed @ power
        f = self._a + self._b * root
        # Outside the grid there is no notch.
        got = np.interp(np.log(np.maximum(f, 1e-9)), self._log, removed, 0.0, 0.0)
        self._found = keep * lost * self._found + got
        best = int(np.argmax(self._found + self._prior))
        self.a, self.b = float(self._a[best]), float(self._b[best])


# Length and distance of frames, s: throttle changes little within a frame, which resolves 4 Hz.
FRAME, HOP = 0.25, 0.0625
_SMALLEST, _LONGEST = 16, 4096  # Minimum and maximum number of samples in a frame
# Gap that restarts a frame, and deviation from even spacing that needs resampling, in intervals.
_MISSING, _UNEVEN = 5.0, 0.3


class NotchFrames:
    """Spectra of frames of samples, and means of other inputs (interval in s; bins in Hz)."""

    def __init__(self, interval: float) -> None:
        self.interval = interval
        self.size = int(min(max(round(FRAME / interval), _SMALLEST), _LONGEST))
        self.hop = max(int(round(self.size * HOP / FRAME)), 1)
        self._window = np.hanning(self.size + 2)[1:-1]
        self._scale = 1.0 / (interval * float(np.sqrt(np.sum(self._window**2) * self.size / 2.0)))
        self.frequencies = np.asarray(np.fft.rfftfreq(self.size, interval), dtype=np.float64)
        self._t: list[float] = []
        self._rows: list[list[float]] = []
        self._due = self.size + 1

    def add(self, t: float, row: list[float]) -> bool:
        """Take a sample (channels, then other inputs); return whether a frame is complete."""
        if self._t and t - self._t[-1] > _MISSING * self.interval:
            self._t, self._rows, self._due = [], [], self.size + 1
        self._t.append(t)
        self._rows.append(row)
        self._due -= 1
        return self._due <= 0

    def take(self, channels: int) -> tuple[FloatArray, FloatArray]:
        """Return the power in each bin, shape (channels, K), and the means of the other inputs."""
        keep = self.size + 1
        self._t, self._rows = self._t[-keep:], self._rows[-keep:]
        self._due = self.hop
        rows = np.array(self._rows)
        signal = rows[:, :channels].T
        t = np.array(self._t)
        if np.max(np.abs(np.diff(t) - self.interval)) > _UNEVEN * self.interval:
            even = t[-1] - self.interval * np.arange(keep - 1, -1, -1)
            signal = np.array([np.interp(even, t, one) for one in signal])
        spectra = np.fft.rfft(np.diff(signal, axis=1) * self._window, axis=1)
        power = (np.abs(spectra) * self._scale)**2
        return power, rows[:, channels:].mean(axis=0)


# Candidate bandwidths relative to the frequency.
WIDTHS: FloatArray = np.array([1.0, 0.66, 0.45, 0.3, 0.2, 0.13, 0.085])
# Cutoffs of the low-passes after the notches, relative to `cutoff`; their maximum, relative to the
# sample rate.
_BEHIND, _FASTEST = (0.5, 1.0, 1.5), 0.25
# Maximum share of the rms that may remain, to switch on, to stay on, and with each low-pass; share
# of the present candidate's power below which another candidate is chosen.
_ON, _OFF, _HARM, _BETTER = 0.9, 0.97, 0.99, 0.9
# Memory of the noise, and of the loudest frame, s; number of frames before the first decision.
_MEMORY, _LEVEL, _FEWEST = 5.0, 2.0, 6
# Minimum share of the lag that remains for the low-pass, in a frame (with less, the low-pass
# hardly filters) and on average.
_LEAST, _LEAST_MEAN = 0.1, 0.4
# Exponent of power in the weight of a frame: weights by amplitude, because with weights by power a
# crash would dominate.
_BY_AMPLITUDE = 0.5
_TINY = 1e-300


class Candidate(NamedTuple):
    """Notches that may be chosen: one at the law's frequency, or one at each motor's frequency."""

    source: str
    width: float  # Bandwidth over frequency


SOURCES = ('throttle', 'rpm')


class NotchChoice:
    """Choice of a candidate for each channel; `chosen`: the candidates, None: no notch."""

    def __init__(self, frequencies: FloatArray, settings: tuple[float, float], rate: float,
                 channels: int) -> None:
        self._fmin, cutoff = settings
        self._rate = rate
        self._used = frequencies >= self._fmin
        self._warped: FloatArray = np.tan(
            np.pi * np.minimum(frequencies[self._used] / rate, 0.499))
        # Low-passes are discretised by the bilinear transform.
        at = np.tan(np.pi * np.minimum(cutoff / rate * np.array(_BEHIND), _FASTEST))
        self._fourth: FloatArray = (self._warped[None, :] / at[:, None])**4
        self._lag: FloatArray = np.sqrt(2.0) / (2.0 * rate * at)
        self._low: FloatArray = 1.0 / (1.0 + self._fourth)
        shape = (len(SOURCES), WIDTHS.size, channels, len(_BEHIND))
        self._noise: FloatArray = np.zeros(shape)
        self._without: FloatArray = np.zeros((shape[0], 1, *shape[2:]))
        self._left: FloatArray = np.ones((*shape[:2], len(_BEHIND)))
        self._frames = [0] * len(SOURCES)
        self._loudest: FloatArray = np.zeros(channels)
        self.chosen: list[Candidate | None] = [None] * channels

    def normalise(self, power: FloatArray, passed: float) -> tuple[FloatArray, float]:
        """Return a frame relative to the loudest recent power, and a factor on earlier frames."""
        # A louder frame reduces the weight of earlier frames; quiet frames regain weight as loud
        # frames are forgotten.
        before = self._loudest * np.exp(-passed / _LEVEL)
        self._loudest = np.maximum(power[:, self._used] @ self._low[1], before)
        lost = (before / np.maximum(self._loudest, _TINY))**_BY_AMPLITUDE
        self._noise *= lost[:, None]
        self._without *= lost[:, None]
        return power / np.maximum(self._loudest, _TINY)[:, None], float(np.mean(lost))

    def low_passed(self, power: FloatArray) -> FloatArray:
        """Return the power after the low-pass, averaged over channels, shape (K,)."""
        seen: FloatArray = np.zeros(self._used.size)
        seen[self._used] = power[:, self._used].mean(axis=0) * self._low[1]
        return seen

    def take(self, power: FloatArray, throttle: float, motors: FloatArray,
             passed: float) -> None:
        """Take a frame: power, shape (channels, K), `passed` s after the last one."""
        # throttle: frequency of the law, Hz, NaN if unknown; motors: their frequencies, Hz.
        power = power[:, self._used]
        none = power @ self._low.T
        for j, f in enumerate((np.array([throttle]), motors)):
            f = f[(f >= self._fmin) & (f <= HIGHEST * self._rate)]
            if not f.size:
                continue
            passes, delay = self._cascade(f)
            left = np.maximum(1.0 - delay[:, None] / self._lag, _LEAST)
            noise = np.einsum('ck,wk,wrk->wcr', power, passes,
                              1.0 / (1.0 + self._fourth * left[..., None]**4))
            self._frames[j] += 1
            weight = max(1.0 / self._frames[j], passed / _MEMORY)
            self._noise[j] += weight * (noise - self._noise[j])
            self._without[j] += weight * (none - self._without[j])
            self._left[j] += weight * (left - self._left[j])

    def _cascade(self, f: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the power response of the notches for each width, shape (W, K), and delays, s."""
        at = np.tan(np.pi * f / self._rate)
        p = self._warped / at[:, None]
        off = (1.0 - p * p)**2
        passes = np.prod(off / (off + (WIDTHS[:, None, None] * p)**2), axis=1)
        return passes, WIDTHS * float(np.sum(0.5 / (self._rate * at)))

    def decide(self, sources: set[str]) -> None:
        """Choose, for each channel, among the candidates whose source is available now."""
        known = np.array([source in sources and frames >= _FEWEST for source, frames in
                          zip(SOURCES, self._frames, strict=True)])
        left = self._noise / np.maximum(self._without, _TINY)
        harms: npt.NDArray[np.bool_] = (np.max(left, axis=3) > _HARM**2) | (
            np.min(self._left, axis=2) < _LEAST_MEAN)[..., None]
        gain = np.where(known[:, None, None], np.mean(left, axis=3), np.inf)
        for c, old in enumerate(self.chosen):
            able = np.where(harms[..., c], np.inf, gain[..., c])
            j, w = np.unravel_index(int(np.argmin(able)), able.shape)
            best, found = float(able[j, w]), Candidate(SOURCES[j], float(WIDTHS[w]))
            now = np.inf
            if old is not None:
                k = SOURCES.index(old.source)
                now = float(able[k, int(np.argmin(np.abs(WIDTHS - old.width)))])
            # If the source of the old candidate is lost, `now` is infinite, and another is chosen.
            limit = _ON if old is None else _OFF
            if best < limit**2 and best < _BETTER * now:
                self.chosen[c] = found
            elif now > _OFF**2:
                self.chosen[c] = None


# Minimum length of a gap, in intervals; number of samples that determine the interval; relative
# change of the interval above which the rate is new.
_GAP, _KNOWN, _OTHER = 5.0, 64, 0.1
# Time constant of the motors after a step of throttle (25 ms with a 5 inch propeller); time in
# which a notch fades in or out; time constants of its width and of its frequency, s.
_SPIN_UP, _FADE, _WIDEN, _MOVE = 0.03, 0.2, 0.05, 0.004
# Time for which the last throttle is held, s.
_HELD = 1.0
_LAG_FREQUENCY = 10.0  # Frequency at which the delay is stated, Hz

_Optional = npt.ArrayLike | None


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

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor import AdaptiveNotch
    >>> t = np.arange(4000) / 1000.0
    >>> hum = np.sin(2.0 * np.pi * 150.0 * t)                  # a motor at 150 Hz
    >>> notch = AdaptiveNotch(rpm_unit='hz')
    >>> y = notch.filter(t, hum, rpm=np.full((t.size, 1), 150.0))
    >>> notch.active, bool(np.std(y[2000:]) < 0.5 * np.std(hum))
    (True, True)

    """

    def __init__(self, **options: object) -> None:
        self._settings = NotchSettings.from_options(options)
        self._speeds = NewestSpeeds(self._settings.per_unit, self._settings.stale_after)
        self.counters = FilterCounters()
        self._t: float | None = None
        self._out: list[float] = []
        self._banks: list[list[Notch]] = []
        self._interval = SampleInterval()
        self._since = 0
        self._frames: NotchFrames | None = None
        self._law: MotorLaw | None = None
        self._choice: NotchChoice | None = None
        # Square root of throttle after the lag of the motors, and as received; stamp of the last
        # throttle, s.
        self._root, self._newest_root, self._received = NAN, NAN, -math.inf
        self._motors: list[float] = []
        self._sources: set[str] = set()

    @property
    def settings(self) -> NotchSettings:
        """Return the present settings."""
        return self._settings

    @property
    def active(self) -> bool:
        """Whether a notch is in use in any channel."""
        return any(one.depth > 0.0 for bank in self._banks for one in bank)

    @property
    def frequencies(self) -> FloatArray:
        """Frequencies of the notches in the channel with the most notches, Hz; empty: none."""
        rate = self.rate
        each = [[one.ratio * rate for one in bank if one.depth > 0.0] for bank in self._banks]
        return np.array(max(each, key=len, default=[]), dtype=np.float64)

    @property
    def rate(self) -> float:
        """Sample rate, Hz; NaN while unknown."""
        return 1.0 / self._interval.mean if self._interval.mean > 0.0 else NAN

    @property
    def law(self) -> tuple[float, float]:
        """Return a and b of f = a + b sqrt(throttle), Hz; NaN while unknown."""
        return (NAN, NAN) if self._law is None else (self._law.a, self._law.b)

    @property
    def source(self) -> str:
        """Return what the notches follow: 'rpm', 'throttle' or 'none'."""
        chosen = [] if self._choice is None else self._choice.chosen
        found = {one.source for one in chosen if one is not None}
        return 'rpm' if 'rpm' in found else 'throttle' if found else 'none'

    @property
    def delay(self) -> float:
        """Phase delay of the notches at 10 Hz, s, in the channel where it is largest."""
        return max(self.delays(_LAG_FREQUENCY), default=0.0)

    def delays(self, frequency: float) -> list[float]:
        """
        Return the phase delay of the notches in each channel, s.

        frequency in Hz.
        """
        ratio = frequency * self._interval.mean
        if not 0.0 < ratio < 0.5:
            return [0.0] * len(self._banks)
        return [phase_lag(bank, ratio) / (2.0 * math.pi * frequency) for bank in self._banks]

    def configure(self, **options: object) -> None:
        """
        Change options; the output does not jump, and learned values are kept if they still apply.

        Raises
        ------
        ValueError
            For an option that cannot be used; no option changes then.

        """
        old = self._settings
        self._settings = s = NotchSettings.from_options(options, base=old)
        self._speeds.configure(s.per_unit, s.stale_after)
        if (s.count, s.fmin, s.cutoff) != (old.count, old.fmin, old.cutoff):
            self._frames = self._law = self._choice = None

    def filter(self, t: npt.ArrayLike, x: npt.ArrayLike,  # noqa: A003
               throttle: _Optional = None, rpm: _Optional = None) -> FloatArray | float:
        """
        Filter samples; the state is carried over from call to call.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  A repeated or earlier stamp does not change the output.
        x : float or array_like, shape (n,) or (n, channels)
            Signal, any unit.  A sample with NaN is counted and does not change the output.
        throttle : float or array_like, shape (n,), optional
            Throttle, 0..1; for NaN, the last finite value is used, for a second.
        rpm : array_like, shape (n,) or (n, motors), or (motors,) with one number t, optional
            Motor speeds, in `rpm_unit`; NaN: not received.

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
        """Filter one sample of each channel like `filter`, but faster."""
        if self._out and len(values) != len(self._out):
            raise ValueError(f'the number of channels changed from {len(self._out)} to '
                             f'{len(values)}: make a new notch for another signal')
        if not abs(t) < LATEST or not all(abs(x) < LARGEST for x in values):
            self.counters.non_finite += 1
            return self._out or [NAN] * len(values)
        if self._t is None:
            self.counters.samples += 1
            self._banks = [[Notch(x) for _ in range(4)] for x in values]
            self._t, self._out = t, list(values)
            self._take_inputs(t, 0.0, throttle, rpm)
            return self._out
        dt = t - self._t
        if dt < SHORTEST:
            if dt < 0.0:
                self._t = t
                self.counters.back += 1
            else:
                self.counters.repeated += 1
            return self._out
        self.counters.samples += 1
        gap = dt > _GAP * self._interval.mean and self.counters.samples > _KNOWN
        self._follow_interval(dt)
        self._t = t
        self._take_inputs(t, dt, throttle, rpm)
        self._analyse(t, values, dt)
        if gap:
            self.counters.gaps += 1
            for bank, x in zip(self._banks, values, strict=True):
                for one in bank:
                    one.restart(x)
        self._out = [self._filter_channel(c, x, dt) for c, x in enumerate(values)]
        return self._out

    def _follow_interval(self, dt: float) -> None:
        """Track the mean interval; discard frames, law and choice if the rate changes."""
        mean = self._interval.add(dt)
        if self._frames is None:
            self._since += 1
        elif abs(mean / self._frames.interval - 1.0) > _OTHER:
            self._frames = self._law = self._choice = None
            self._interval, self._since = SampleInterval(), 0
            self._interval.add(dt)

    def _take_inputs(self, t: float, dt: float, throttle: float, rpm: Sequence[float]) -> None:
        if throttle == throttle:
            self._newest_root, self._received = math.sqrt(min(max(throttle, 0.0), 1.0)), t
        elif not t - self._received <= _HELD:
            self._root = self._newest_root = NAN
        if self._newest_root == self._newest_root:
            off = self._newest_root - self._root if self._root == self._root else NAN
            self._root = self._newest_root if off != off else (
                self._root - off * math.expm1(-dt / _SPIN_UP))
        if len(rpm):
            self._speeds.take(t, rpm)
        highest = HIGHEST / self._interval.mean if self._interval.mean > 0.0 else 0.0
        self._motors = [one for one in self._speeds.now(t, self._settings.count)
                        if self._settings.fmin <= one <= highest]

    def _analyse(self, t: float, values: Sequence[float], dt: float) -> None:
        s, channels = self._settings, len(values)
        if self._frames is None:
            if not s.count or self._since < _KNOWN or HIGHEST / self._interval.mean < 1.2 * s.fmin:
                return
            self._frames = frames = NotchFrames(self._interval.mean)
            rate = 1.0 / frames.interval
            self._law = MotorLaw(frames.frequencies, s.fmin, rate)
            self._choice = NotchChoice(frames.frequencies, (s.fmin, s.cutoff), rate, channels)
        speeds = self._motors + [NAN] * (s.count - len(self._motors))
        due = self._frames.add(t, [*values, self._root, *speeds])
        sources = {name for name, known in (('throttle', self._root == self._root),
                                            ('rpm', bool(self._motors))) if known}
        if due and self._law is not None and self._choice is not None:
            power, rest = self._frames.take(channels)
            passed = self._frames.hop * self._frames.interval
            root, motors = float(rest[0]), rest[1:]
            power, lost = self._choice.normalise(power, passed)
            # Score the law before it learns from this frame.
            self._choice.take(power, self._law.frequency(root), motors[np.isfinite(motors)],
                              passed)
            if root == root:
                self._law.learn(self._choice.low_passed(power), root, passed, lost)
        if self._choice is not None and (due or sources != self._sources):
            self._sources = sources
            self._choice.decide(sources)

    def _filter_channel(self, c: int, x: float, dt: float) -> float:
        chosen = None if self._choice is None else self._choice.chosen[c]
        # Present frequencies of the candidate, Hz; NaN while unknown.
        wanted = [] if chosen is None or self._law is None else [
            self._law.frequency(self._root)] if chosen.source == 'throttle' else self._motors
        bank = self._banks[c]
        if not wanted and not any(one.depth for one in bank):
            for one in bank:
                one.advance(x)
            return x
        interval, lowest = self._interval.mean, self._settings.fmin
        step, moved = dt / _FADE, -math.expm1(-dt / _MOVE)
        for k, one in enumerate(bank):
            f = wanted[k] if k < len(wanted) else NAN
            ratio = f * interval
            if chosen is not None and f >= lowest and ratio <= HIGHEST:
                if one.depth == 0.0:
                    one.ratio, one.width = ratio, chosen.width
                elif abs(ratio - one.ratio) > 1e-5 * ratio:
                    one.ratio += (ratio - one.ratio) * moved
                one.width -= (chosen.width - one.width) * math.expm1(-dt / _WIDEN)
                one.depth = min(one.depth + step, 1.0)
            elif one.depth > 0.0:
                one.depth = max(one.depth - step, 0.0)
            x = one.advance(x)
        return x


# Highest frequency of a notch, as a share of the sample rate.
HIGHEST = 0.45


class Notch:
    """One notch of one channel, starting as if the input had always been x."""

    __slots__ = ('_g', '_ratio', '_s1', '_s2', 'depth', 'width')

    def __init__(self, x: float) -> None:
        self._s1, self._s2 = 0.0, x
        self._ratio = self._g = 0.0
        # Bandwidth over frequency; depth, 0 (off) to 1.
        self.width, self.depth = 1.0, 0.0

    @property
    def ratio(self) -> float:
        """Frequency over sample rate, 0..`HIGHEST`."""
        return self._ratio

    @ratio.setter
    def ratio(self, ratio: float) -> None:
        if ratio != self._ratio:
            self._ratio = min(max(ratio, 0.0), HIGHEST)
            self._g = math.tan(math.pi * self._ratio)

    def restart(self, x: float) -> None:
        """Restart as if the input had always been x."""
        self._s1, self._s2 = 0.0, x

    def advance(self, x: float) -> float:
        """Filter one sample."""
        g, k = self._g, self.width
        v1 = (g * (x - self._s2) + self._s1) / (1.0 + g * (g + k))
        v2 = self._s2 + g * v1
        self._s1 = 2.0 * v1 - self._s1
        self._s2 = 2.0 * v2 - self._s2
        return x - self.depth * k * v1

    def response(self, ratio: float) -> complex:
        """Return the response at a frequency over the sample rate, for constant coefficients."""
        if not self._g:
            return 1.0 + 0.0j
        p = 1j * math.tan(math.pi * ratio) / self._g
        k = self.width
        return 1.0 - self.depth * k * p / (p * p + k * p + 1.0)


def phase_lag(notches: Iterable[Notch], ratio: float) -> float:
    """Return the lag of a cascade at a frequency over the sample rate, rad."""
    return -sum(cmath.phase(one.response(ratio)) for one in notches)
