"""
Which notches pay: the noise of a D term at equal lag, by the signal's own spectrum.

The noise of a candidate is the power that its notches and a low-pass of order 2 leave of the
derivative above `fmin`, the cutoff of the low-pass so much higher that both lag as much as the
low-pass alone.  Running means of it, of frames that the law had not seen yet, tell what
each candidate would have come to behind a slower and a faster low-pass too; "no notch" is one of
them.  A channel takes the best where that leaves less than `_ON` of the rms of none, and harms
behind none of the low-passes; it changes for one that is better by a tenth in power, and gives
up where `_OFF` or more is left or harm is done.

Limits: the past decides; what was worth a notch for the last seconds has it in the next.

Every `HOP` of the last `FRAME` seconds a periodogram of the differences (Hann window), on an
even grid: unit^2/s^2 in each bin as the derivative would have it, one row a channel.

Limits: a frame with a gap of more than five intervals is thrown away; smaller unevenness is
interpolated linearly.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.online.notch.biquads import HIGHEST
from ou_monitor.records import FloatArray

# A notch is learned on what a quarter of a second shows: 4 Hz of resolution, and throttle moves
# little in it; four looks at each sample.
FRAME, HOP = 0.25, 0.0625
_SHORTEST, _LONGEST = 16, 4096
_GAP, _UNEVEN = 5.0, 0.3


class Frames:
    """Spectra of samples of an interval, s, and what went with them; `frequencies` in Hz."""

    def __init__(self, interval: float) -> None:
        self.interval = interval
        self.size = int(min(max(round(FRAME / interval), _SHORTEST), _LONGEST))
        self.hop = max(int(round(self.size * HOP / FRAME)), 1)
        self._window = np.hanning(self.size + 2)[1:-1]
        self._scale = 1.0 / (interval * float(np.sqrt(np.sum(self._window**2) * self.size / 2.0)))
        self.frequencies = np.asarray(np.fft.rfftfreq(self.size, interval), dtype=np.float64)
        self._t: list[float] = []
        self._rows: list[list[float]] = []
        self._due = self.size + 1

    def add(self, t: float, row: list[float]) -> bool:
        """Take a sample (channels, then what goes with it); tell whether a frame is due."""
        if self._t and t - self._t[-1] > _GAP * self.interval:
            self._t, self._rows, self._due = [], [], self.size + 1
        self._t.append(t)
        self._rows.append(row)
        self._due -= 1
        return self._due <= 0

    def take(self, channels: int) -> tuple[FloatArray, FloatArray]:
        """Return the power in each bin, shape (channels, K), and the means of the rest."""
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


# Bandwidths over frequency that are tried, of one notch and of one notch for each motor.
WIDTHS: FloatArray = np.array([1.0, 0.66, 0.45, 0.3, 0.2, 0.13, 0.085])
# Low-passes behind, over `cutoff`; none is faster than that share of the sample rate.
_BEHIND, _FASTEST = (0.5, 1.0, 1.5), 0.25
_ON, _OFF, _HARM, _BETTER = 0.9, 0.97, 0.99, 0.9
# s over which the noise is averaged, and the loudest is forgotten; frames before anything is
# decided.
_MEMORY, _LEVEL, _FEWEST = 5.0, 2.0, 6
# Least share of the lag that is left to the low-pass in a frame (one ten times as fast hardly
# filters), and in the mean of frames.
_LEAST, _LEAST_MEAN = 0.1, 0.4
# Frames count by their amplitude: by power one crash would be all that is remembered.
_BY_AMPLITUDE = 0.5
_TINY = 1e-300


class Family(NamedTuple):
    """Notches but for their width."""

    source: str  # 'rpm' or 'throttle'
    many: bool  # Whether each motor has its own
    times: int  # How often the same notch


class Candidate(NamedTuple):
    """Some notches."""

    family: Family  # Which
    width: float  # Bandwidth over frequency


def families(count: int) -> tuple[Family, ...]:
    """Return what is tried with at most so many notches."""
    found = [Family(source, False, times) for source in ('throttle', 'rpm')
             for times in range(1, min(count, 2) + 1)]
    return (*found, Family('rpm', True, 1)) if count > 1 else tuple(found)


class Choice:
    """
    Choice of the candidate of each channel; `chosen`: one a channel, None: no notch.

    frequencies of the bins, Hz; settings: `fmin` and `cutoff`, Hz; rate of the samples, Hz.
    """

    def __init__(self, frequencies: FloatArray, settings: tuple[float, float], rate: float,
                 channels: int, count: int) -> None:
        self._fmin, cutoff = settings
        self._rate = rate
        self._used = frequencies >= self._fmin
        self._warped: FloatArray = np.tan(
            np.pi * np.minimum(frequencies[self._used] / rate, 0.499))
        # Low-passes by the bilinear rule, as most are.
        at = np.tan(np.pi * np.minimum(cutoff / rate * np.array(_BEHIND), _FASTEST))
        self._fourth: FloatArray = (self._warped[None, :] / at[:, None])**4
        self._lag: FloatArray = np.sqrt(2.0) / (2.0 * rate * at)
        self._low: FloatArray = 1.0 / (1.0 + self._fourth)
        self.families = families(count)
        shape = (len(self.families), WIDTHS.size, channels, len(_BEHIND))
        self._noise: FloatArray = np.zeros(shape)
        self._none: FloatArray = np.zeros((shape[0], 1, *shape[2:]))
        self._left: FloatArray = np.ones((*shape[:2], len(_BEHIND)))
        self._frames = [0] * len(self.families)
        self._loudest: FloatArray = np.zeros(channels)
        self.chosen: list[Candidate | None] = [None] * channels

    def usual(self, power: FloatArray, passed: float) -> tuple[FloatArray, float]:
        """
        Return a frame over the loudest of late behind the low-pass, shape (channels, K).

        Quiet frames count once the loud ones are past; a louder one makes those before it count
        for less, by the factor that is returned beside it.
        """
        before = self._loudest * np.exp(-passed / _LEVEL)
        self._loudest = np.maximum(power[:, self._used] @ self._low[1], before)
        lost = (before / np.maximum(self._loudest, _TINY))**_BY_AMPLITUDE
        self._noise *= lost[:, None]
        self._none *= lost[:, None]
        return power / np.maximum(self._loudest, _TINY)[:, None], float(np.mean(lost))

    def low_passed(self, power: FloatArray) -> FloatArray:
        """Return the power behind the low-pass, mean of the channels, shape (K,)."""
        seen: FloatArray = np.zeros(self._used.size)
        seen[self._used] = power[:, self._used].mean(axis=0) * self._low[1]
        return seen

    def take(self, power: FloatArray, throttle: float, motors: FloatArray,
             passed: float) -> None:
        """
        Take a frame: power, shape (channels, K); frequencies by throttle and by the rpm, Hz.

        throttle: NaN while not known; motors: empty while not known.
        """
        power = power[:, self._used]
        none = power @ self._low.T
        mean = motors.mean(keepdims=True) if motors.size else motors
        for j, family in enumerate(self.families):
            f = (np.array([throttle]) if family.source == 'throttle' else
                 motors if family.many else mean)
            f = f[(f >= self._fmin) & (f <= HIGHEST * self._rate)]
            if not f.size:
                continue
            passes, delay = self._cascade(f, family.times)
            left = np.maximum(1.0 - delay[:, None] / self._lag, _LEAST)
            noise = np.einsum('ck,wk,wrk->wcr', power, passes,
                              1.0 / (1.0 + self._fourth * left[..., None]**4))
            self._frames[j] += 1
            weight = max(1.0 / self._frames[j], passed / _MEMORY)
            self._noise[j] += weight * (noise - self._noise[j])
            self._none[j] += weight * (none - self._none[j])
            self._left[j] += weight * (left - self._left[j])

    def _cascade(self, f: FloatArray, times: int) -> tuple[FloatArray, FloatArray]:
        """Return the power that notches pass for each width, shape (W, K), and delays, s."""
        at = np.tan(np.pi * f / self._rate)
        p = self._warped / at[:, None]
        off = (1.0 - p * p)**2
        passes = np.prod(off / (off + (WIDTHS[:, None, None] * p)**2), axis=1)
        return passes**times, times * WIDTHS * float(np.sum(0.5 / (self._rate * at)))

    def decide(self, sources: set[str]) -> None:
        """Choose for each channel among the candidates whose source is known now."""
        known = np.array([one.source in sources and frames >= _FEWEST for one, frames in
                          zip(self.families, self._frames, strict=True)])
        left = self._noise / np.maximum(self._none, _TINY)
        harms: npt.NDArray[np.bool_] = (np.max(left, axis=3) > _HARM**2) | (
            np.min(self._left, axis=2) < _LEAST_MEAN)[..., None]
        gain = np.where(known[:, None, None], np.mean(left, axis=3), np.inf)
        for c, old in enumerate(self.chosen):
            able = np.where(harms[..., c], np.inf, gain[..., c])
            j, w = np.unravel_index(int(np.argmin(able)), able.shape)
            best, found = float(able[j, w]), Candidate(self.families[j], float(WIDTHS[w]))
            now = np.inf
            if old is not None:
                k = self.families.index(old.family)
                now = float(able[k, int(np.argmin(np.abs(WIDTHS - old.width)))])
            # After a loss of the source the other one is held to what the first one was.
            limit = _ON if old is None else _OFF
            if best < limit**2 and best < _BETTER * now:
                self.chosen[c] = found
            elif now > _OFF**2:
                self.chosen[c] = None
