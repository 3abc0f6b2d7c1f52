"""
What is measured of a voltage, recorded or simulated alike.

Levels lie half-way between two codes of the ADC, so that no reading is on them.  A fall is a dip
as `supply_facts` counts them: a run, however its noise crosses the level.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.supply import dip_begins, noise_of, rise_that_ends
from ou_monitor.comparison.flight_model import Readings
from ou_monitor.records import FloatArray, NAN, Recording
from scipy.signal import welch

# Shares of the measured samples below the two low levels.
LOW_SHARES = (0.01, 0.05)
# Bands of the spectrum, and the longest segment of Welch's mean, s.
_BANDS, _SEGMENT = 5, 20.0
# A rise of throttle: so much within that time, s, and none in the time before.
_RISE, _WITHIN, _QUIET = 0.1, 0.2, 1.0
# Seconds before and after the begin of a rise, points between, and rises at least.
_BEFORE, _AFTER, _POINTS, _FEWEST = 0.2, 1.5, 86, 3
# Bins of the distribution.
_BINS = 2000


@dataclass(frozen=True, eq=False)
class Measures:
    """What was measured of one voltage."""

    mean: float  # Mean, V
    thirds: FloatArray  # Means of the thirds, V; shape (3,)
    lowest: float  # Least voltage, V
    # Dips below each level per minute, as `supply_facts` counts them; shape (levels,).
    falls: FloatArray
    power: FloatArray  # Power in each band, V^2; shape (bands,)
    # Mean answer to rises of throttle, V; empty where there are too few; shape (points,).
    answer: FloatArray
    distribution: FloatArray  # Share of the samples below each edge; shape (bins,)


class Yardstick:
    """
    What to measure, chosen from the recorded part alone.

    lsb: step of the ADC, V, 0 where none is seen; limits: levels, V, beside the two low ones.
    """

    def __init__(self, samples: Readings, lsb: float, limits: tuple[float, ...] = ()) -> None:
        v, t = samples.voltage, samples.t
        self._t = t
        self.minutes = float(t[-1] - t[0]) / 60.0
        low = [float(np.quantile(v, share)) for share in LOW_SHARES]
        self.levels = [*limits, *(between_codes(level, lsb) for level in low)]
        u = np.full(t.size, NAN) if samples.throttle is None else samples.throttle
        noise = noise_of(Recording(t, v, u, current=samples.current))
        self._rise = rise_that_ends(v, u, noise)
        self._rate = 1.0 / samples.spacing
        self._segment = int(min(v.size, max(64, min(_SEGMENT * self._rate, v.size / 4))))
        lowest, highest = self._rate / self._segment, 0.5 * self._rate
        self.bands = np.geomspace(lowest, highest, _BANDS + 1)
        self.rises = _rises(t, samples.throttle)
        self.after = np.linspace(-_BEFORE, _AFTER, _POINTS)
        reach = 0.5 * (float(v.max()) - float(v.min())) + 10.0 * lsb
        self._edges = np.linspace(v.min() - reach, v.max() + reach, _BINS)

    def measure(self, v: FloatArray) -> Measures:
        """Measure a voltage at the stamps of the part, V."""
        falls = [dip_begins(v, level, self._rise).size / self.minutes for level in self.levels]
        f, density = welch(v, self._rate, nperseg=self._segment)
        at = np.clip(np.searchsorted(self.bands, f, side='right') - 1, -1, _BANDS - 1)
        power = np.array([density[at == k].sum() for k in range(_BANDS)]) * (f[1] - f[0])
        return Measures(
            float(v.mean()), np.array([part.mean() for part in np.array_split(v, 3)]),
            float(v.min()), np.array(falls), power, self._answer(v),
            np.searchsorted(np.sort(v), self._edges, side='right') / v.size)

    def _answer(self, v: FloatArray) -> FloatArray:
        if self.rises.size < _FEWEST:
            return np.empty(0)
        around = np.interp(self.rises[:, None] + self.after, self._t, v)
        answers = around - around[:, self.after < 0.0].mean(axis=1, keepdims=True)
        return np.asarray(answers.mean(axis=0), dtype=np.float64)

    @property
    def edges(self) -> FloatArray:
        """Return the edges of the distribution, V."""
        return self._edges


def between_codes(level: float, lsb: float) -> float:
    """Return the middle between two codes just above a level, V."""
    return (np.floor(level / lsb + 1e-6) + 0.5) * lsb if lsb > 0.0 else level


def _rises(t: FloatArray, throttle: FloatArray | None) -> npt.NDArray[np.float64]:
    """Return the stamps at which throttle begins to rise, s."""
    if throttle is None:
        return np.empty(0)
    before = np.searchsorted(t, t - _WITHIN)
    rising = throttle - throttle[before] >= _RISE
    begins = np.flatnonzero(rising[1:] & ~rising[:-1]) + 1
    found: list[float] = []
    for k in begins:
        since = t[k]
        room = t[0] + _BEFORE < since - _WITHIN and since + _AFTER < t[-1]
        if room and (not found or since - found[-1] > _QUIET):
            # The rise was seen when it was done in full: it began where most of it happened.
            window = throttle[before[k]:k + 1]
            steepest = int(np.argmax(np.diff(window))) if window.size > 1 else 0
            found.append(float(t[before[k] + steepest]))
    return np.array(found)
