"""
The short-time spectrum of what a D term would make of the signal.

Every `HOP` of the last `FRAME` seconds a periodogram of the differences (Hann window), on an
even grid: unit^2/s^2 in each bin as the derivative would have it, one row a channel.

Limits: a frame with a gap of more than five intervals is thrown away; smaller unevenness is
interpolated linearly.
"""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray

# A notch is learned on what a quarter of a second shows: 4 Hz of resolution, and throttle moves
# little in it; four looks at each sample.
FRAME, HOP = 0.25, 0.0625
_LEAST, _MOST = 16, 4096
_GAP, _UNEVEN = 5.0, 0.3


class Frames:
    """
    Collects samples and what went with them; makes spectra.

    Parameters
    ----------
    interval : float
        Mean time between samples, s.

    Attributes
    ----------
    frequencies : ndarray, shape (K,)
        Of the bins, Hz.

    """

    def __init__(self, interval: float) -> None:
        self.interval = interval
        self.size = int(min(max(round(FRAME / interval), _LEAST), _MOST))
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
