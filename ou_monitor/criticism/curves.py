"""
Curves of the data and of simulations of models: spectrum, distribution, dependence on throttle.

Also histograms for pages: bins by the rule of Freedman and Diaconis, and their outline.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.adc import find_step
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray
from scipy.signal import welch

# Simulations of each model; their range misses about one point in twenty of the data.
DRAWS = 40
_BINS, _LEVELS, _LAGS, _BANDS = 60, 10, 40, 60  # Points: density, throttle, lag, spectrum
# Maximum number of distinct throttles for which each has its own bin.
_DISTINCT = 12

Curve = Callable[[FloatArray], FloatArray]
# Title and labels, x, the curve, log x, log y, and separate points.
_Curve = tuple[tuple[str, str, str], FloatArray, Curve, tuple[bool, bool, bool]]


@dataclass(frozen=True, eq=False)
class Comparison:
    """A curve of the data, and its range in simulations."""

    title: str
    x_label: str
    y_label: str
    x: FloatArray  # shape (p,)
    data: FloatArray  # NaN where unknown; shape (p,)
    # Lowest and highest of the simulations, for each model; shape (p,).
    bands: tuple[tuple[FloatArray, FloatArray], ...]
    log_x: bool = False
    log_y: bool = False
    points: bool = False  # Separate values, drawn without a line


def compare_curves(samples: Samples, models: Sequence[SupplyModel], rng: np.random.Generator,
                   draws: int = DRAWS) -> list[Comparison]:
    """Simulate the models and compare curves."""
    curves = _curves(samples)
    bands: list[list[tuple[FloatArray, FloatArray]]] = [[] for _ in curves]
    for model in models:
        low = [np.full(x.size, np.inf) for _, x, _, _ in curves]
        high = [np.full(x.size, -np.inf) for _, x, _, _ in curves]
        for _ in range(draws):
            try:
                v = model.simulate(samples.t, rng, samples.throttle)
            except ValueError:
                # A diverging force has no simulation.
                break
            for k, (_, _, curve, _) in enumerate(curves):
                drawn = curve(v)
                low[k], high[k] = np.fmin(low[k], drawn), np.fmax(high[k], drawn)
        for k, (a, b) in enumerate(zip(low, high)):
            bands[k].append((np.where(np.isfinite(a), a, np.nan),
                             np.where(np.isfinite(b), b, np.nan)))
    return [Comparison(title, xl, yl, x, curve(samples.logged), tuple(bands[k]), *log)
            for k, ((title, xl, yl), x, curve, log) in enumerate(curves)]


def _curves(samples: Samples) -> list[_Curve]:
    v, n = samples.logged, samples.n
    step = float(np.median(samples.step[1:]))
    even = samples.even
    grid = np.arange(samples.t[0], samples.t[-1] + 0.5 * step, step)

    def evened(y: FloatArray) -> FloatArray:
        # Data and simulations are resampled alike, so the effect cancels.
        return y if even else np.interp(grid, samples.t, y)

    size = n if even else grid.size
    # Segments of an eighth, half overlapping.
    length = max(16, size // 8)
    frequency = np.fft.rfftfreq(length, step)[1:]
    edges = np.unique(np.round(np.geomspace(1, frequency.size, _BANDS)).astype(int)) - 1
    centres = np.array([frequency[a:max(b, a + 1)].mean()
                        for a, b in zip(edges[:-1], edges[1:])])

    def spectrum(y: FloatArray) -> FloatArray:
        power = welch(evened(y), 1.0 / step, nperseg=length)[1][1:]
        return np.array([power[a:max(b, a + 1)].mean() for a, b in zip(edges[:-1], edges[1:])])

    lags = np.unique(np.round(np.geomspace(1, max(size // 20, 2), _LAGS)).astype(int))

    def correlation(y: FloatArray) -> FloatArray:
        y = evened(y)
        c = y - y.mean()
        spectrum_ = np.abs(np.fft.rfft(c, 2 * c.size)) ** 2
        r: FloatArray = np.fft.irfft(spectrum_)[lags] / max(float(c @ c), 1e-300)
        return r

    # Every bin has the same number of codes; otherwise the histogram would be a comb.
    code = find_step(v)
    values = _bins(v, code)
    changes = _bins(np.diff(v), code)
    found: list[_Curve] = [
        (('Spectrum', 'frequency, Hz', 'PSD, V\u00b2/Hz'), centres, spectrum,
         (True, True, False)),
        (('Autocorrelation', 'lag, s', 'correlation'), lags * step, correlation,
         (True, False, False)),
        (('Distribution of the voltage', 'voltage, V', 'density, 1/V'), _middle(values),
         lambda y: _density(y, values), (False, True, False)),
        (('Distribution of the increments', 'change from sample to sample, mV',
          'density, 1/V'), 1e3 * _middle(changes),
         lambda y: _density(np.diff(y), changes), (False, True, False)),
    ]
    u = samples.throttle
    if u is not None:
        which, bins = _by_throttle(u)
        count = np.bincount(which, minlength=bins).astype(np.float64)
        at = np.bincount(which, u, minlength=bins) / np.maximum(count, 1.0)
        # A few levels are drawn as points, without a line between them.
        few = bins <= _DISTINCT and np.unique(u).size == bins or bins < 3

        def mean(y: FloatArray) -> FloatArray:
            return _averages(y, which, count)

        def spread(y: FloatArray) -> FloatArray:
            d = np.diff(y, prepend=y[0])
            return 1e3 * np.sqrt(_averages(d * d, which, count))

        found += [
            (('Mean voltage by throttle', 'throttle, %', 'V'), 100.0 * at, mean,
             (False, False, few)),
            (('Size of increments by throttle', 'throttle, %', 'rms, mV'), 100.0 * at, spread,
             (False, False, few))]
    return found


def _by_throttle(u: FloatArray) -> tuple[np.ndarray, int]:
    """Return the bin of each sample, and the number of bins: distinct values if they are few."""
    values, which = np.unique(u, return_inverse=True)
    if values.size <= _DISTINCT:
        return which, values.size
    edges = np.unique(np.quantile(u, np.linspace(0.0, 1.0, _LEVELS + 1)))
    return np.clip(np.searchsorted(edges, u, side='right') - 1, 0, edges.size - 2), edges.size - 1


def _averages(y: FloatArray, which: np.ndarray, count: FloatArray) -> FloatArray:
    total = np.bincount(which, y, minlength=count.size)
    return np.where(count >= 5.0, total / np.maximum(count, 1.0), np.nan)


def _bins(y: FloatArray, code: float = 0.0) -> FloatArray:
    """Return edges with room for the tails; with codes, halfway between them, evenly spaced."""
    low, high = float(y.min()), float(y.max())
    room = 0.15 * (high - low) or 1e-6
    if not code > 0.0:
        return np.linspace(low - room, high + room, _BINS + 1)
    width = code * max(1, round((high - low + 2.0 * room) / (_BINS * code)))
    beside = math.ceil(room / width)
    count = 2 * beside + math.ceil((high - low + code) / width)
    edges: FloatArray = width * np.arange(count + 1, dtype=np.float64)
    return edges + (low - 0.5 * code - width * beside)


def _middle(edges: FloatArray) -> FloatArray:
    return 0.5 * (edges[1:] + edges[:-1])


def _density(y: FloatArray, edges: FloatArray) -> FloatArray:
    counts = np.histogram(y, edges)[0]
    return np.asarray(counts / (y.size * np.diff(edges)), dtype=np.float64)


def bin_width(values: FloatArray) -> float:
    """Return the width of histogram bins by the rule of Freedman and Diaconis (1981)."""
    low, high = np.quantile(values, [0.25, 0.75])
    return float(2.0 * (high - low) / values.size ** (1.0 / 3.0))


def outline(edges: FloatArray, heights: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a histogram, from the first edge to the last."""
    return np.repeat(edges, 2)[1:-1], np.repeat(np.asarray(heights, dtype=np.float64), 2)


# Margin on either side of the recorded range, as a share of it.  The extremes of two halves of a
# stationary flight differ by less; those of a wrong sag or a growing drift, by more.
MARGIN = 0.5


def seen_range(voltage: FloatArray) -> tuple[float, float]:
    """Return the range allowed for a simulation: the recorded range, V, and a margin."""
    low, high = float(np.min(voltage)), float(np.max(voltage))
    room = MARGIN * (high - low)
    return low - room, high + room


def stray(simulated: FloatArray, voltage: FloatArray) -> float:
    """Return by how much simulations, V, shape (..., n), leave `seen_range`, V; inf: diverged."""
    low, high = seen_range(voltage)
    if not np.isfinite(simulated).all():
        return float('inf')
    return max(0.0, low - float(np.min(simulated)), float(np.max(simulated)) - high)


def even_on_log(x: FloatArray, y: FloatArray, per_decade: int) -> tuple[FloatArray, FloatArray]:
    """Average a curve over increasing x > 0 in even bins of log x."""
    if x.size < 3:
        return x, y
    bins = np.floor(per_decade * np.log10(x / x[0])).astype(np.intp)
    count = np.bincount(bins)
    some = count > 0
    return np.bincount(bins, x)[some] / count[some], np.bincount(bins, y)[some] / count[some]
