r"""
Which notches pay: the noise of a D term at equal lag, by the signal's own spectrum.

The noise of a candidate is the power that its notches and a low-pass of order 2 leave of the
derivative above `fmin`, the cutoff of the low-pass so much higher that both lag as much as the
low-pass alone.  Running means of it, of frames that the law had not seen yet, tell what
each candidate would have come to; "no notch" is one of them.  A channel takes its best where that
leaves less than `_ON` of the rms of none, changes for one that is better by a tenth in power,
and gives up where it leaves more than `_OFF`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from ou_monitor.online.notch.biquads import HIGHEST
from ou_monitor.records import FloatArray

# Bandwidths over frequency that are tried, of one notch and of one notch for each motor.
WIDTHS: FloatArray = np.array([1.0, 0.66, 0.45, 0.3, 0.2, 0.13, 0.085])
_ON, _OFF, _BETTER = 0.9, 0.97, 0.9
# s over which the noise is averaged, and the loudest is forgotten; frames before anything is
# decided.
_MEMORY, _LEVEL, _FEWEST = 5.0, 2.0, 6

# Share of the lag that notches may take.
_SHARE = 0.6
# Frames count by their amplitude: by power one crash would be all that is remembered.
_BY_AMPLITUDE = 0.5
_TINY = 1e-300


class Candidate(NamedTuple):
    """
    Some notches.

    Attributes
    ----------
    source : str
        'rpm' or 'throttle'.
    many : bool
        Whether each motor has its own.
    width : float
        Bandwidth over frequency.
    times : int
        How often the same notch.

    """

    source: str
    many: bool
    width: float
    times: int = 1


def candidates(count: int) -> tuple[Candidate, ...]:
    """Return what is tried with at most so many notches."""
    found = [Candidate(source, False, float(width), times) for source in ('throttle', 'rpm')
             for times in range(1, min(count, 2) + 1) for width in WIDTHS]
    if count > 1:
        found += [Candidate('rpm', True, float(width)) for width in WIDTHS]
    return tuple(found)


class Choice:
    """
    Choice of the candidate of each channel.

    Parameters
    ----------
    frequencies : ndarray, shape (K,)
        Of the bins, Hz.
    settings : tuple of float
        `fmin` and `cutoff`, Hz.
    channels, count : int
        Channels; most notches.

    Attributes
    ----------
    chosen : list of (Candidate or None)
        One a channel; None: no notch.

    """

    def __init__(self, frequencies: FloatArray, settings: tuple[float, float], rate: float,
                 channels: int, count: int) -> None:
        self._fmin, self._cutoff = settings
        self._rate = rate
        self._used = frequencies >= self._fmin
        self._f = frequencies[self._used]
        self._warped = np.tan(np.pi * np.minimum(self._f / rate, 0.499))
        self._fourth = self._f**4
        self.all = candidates(count)
        self._noise: FloatArray = np.full((channels, len(self.all)), np.nan)
        self._frames: FloatArray = np.zeros(len(self.all))
        self._none: FloatArray = np.full((channels, len(self.all)), np.nan)
        self._loudest: FloatArray = np.zeros(channels)
        self.chosen: list[Candidate | None] = [None] * channels

    def usual(self, power: FloatArray, passed: float) -> tuple[FloatArray, float]:
        """
        Return a frame over the loudest of late behind the low-pass, shape (channels, K).

        Quiet frames count once the loud ones are past; a louder one makes those before it count
        for less, by the factor that is returned beside it.
        """
        low = 1.0 / (1.0 + self._fourth / self._cutoff**4)
        before = self._loudest * np.exp(-passed / _LEVEL)
        self._loudest = np.maximum(power[:, self._used] @ low, before)
        lost = (before / np.maximum(self._loudest, _TINY))**_BY_AMPLITUDE
        self._noise *= lost[:, None]
        self._none *= lost[:, None]
        return power / np.maximum(self._loudest, _TINY)[:, None], float(np.mean(lost))

    def low_passed(self, power: FloatArray) -> FloatArray:
        """Return the power behind the low-pass, mean of the channels, shape (K,)."""
        seen = np.zeros(self._used.size)
        seen[self._used] = power[:, self._used].mean(axis=0) / (
            1.0 + self._fourth / self._cutoff**4)
        return seen

    def take(self, power: FloatArray, throttle: float, motors: FloatArray,
             passed: float) -> None:
        """
        Take a frame: power, shape (channels, K); frequencies by throttle and by the rpm, Hz.

        throttle: NaN while not known; motors: empty while not known.
        """
        power = power[:, self._used]
        none = power @ (1.0 / (1.0 + self._fourth / self._cutoff**4))
        sets = {('throttle', False): np.array([throttle]), ('rpm', True): motors,
                ('rpm', False): motors.mean(keepdims=True) if motors.size else motors}
        squares: dict[tuple[str, bool], tuple[FloatArray, FloatArray]] = {}
        for key, f in sets.items():
            good = f[(f >= self._fmin) & (f <= HIGHEST * self._rate)]
            if good.size:
                squares[key] = self._cascade(good)
        for j, one in enumerate(self.all):
            found = squares.get((one.source, one.many))
            if found is None:
                continue
            w = int(np.argmin(np.abs(WIDTHS - one.width)))
            passes, delay = found[0][w]**one.times, one.times * float(found[1][w])
            left = 1.0 - delay * self._cutoff * 2.0 * np.pi / np.sqrt(2.0)
            if left < 1.0 - _SHARE:
                noise = none * 1e6
            else:
                noise = power @ (passes / (1.0 + self._fourth * (left / self._cutoff)**4))
            self._frames[j] += 1.0
            weight = max(1.0 / self._frames[j], passed / _MEMORY)
            first = self._frames[j] == 1.0
            self._noise[:, j] = noise if first else (
                self._noise[:, j] + weight * (noise - self._noise[:, j]))
            self._none[:, j] = none if first else (
                self._none[:, j] + weight * (none - self._none[:, j]))

    def _cascade(self, f: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the power that notches pass for each width, shape (widths, K), and delays, s."""
        p = self._warped[None, :] / np.tan(np.pi * f / self._rate)[:, None]
        off = (1.0 - p * p)**2
        cut = (WIDTHS[:, None, None] * p[None])**2
        passes = np.prod(off[None] / (off[None] + cut), axis=1)
        return passes, WIDTHS * float(np.sum(0.5 / (self._rate * np.tan(np.pi * f / self._rate))))

    def decide(self, sources: set[str]) -> None:
        """Choose for each channel among the candidates whose source is known now."""
        open_ = np.array([one.source in sources for one in self.all]) & (
            self._frames >= _FEWEST)
        for c, old in enumerate(self.chosen):
            gain = np.where(open_, self._noise[c] / np.maximum(self._none[c], _TINY), np.inf)
            best = int(np.argmin(gain))
            at = self.all.index(old) if old in self.all else -1
            if at < 0 or not open_[at]:
                # After a loss of the source the other one is held to what the first one was.
                limit = (_ON if old is None else _OFF)**2
                self.chosen[c] = self.all[best] if gain[best] < limit else None
            elif gain[at] > _OFF**2 and gain[best] > _ON**2:
                self.chosen[c] = None
            elif gain[best] < _BETTER * gain[at]:
                self.chosen[c] = self.all[best]
