"""
A curve over throttle, learned as it is flown: Kalman filter of a piecewise-linear curve.

Limits: detail finer than the distance of two nodes is not resolved; observations are taken as
independent and Gaussian; where their scatter says otherwise, the standard errors are widened by
what the last fifty or so show.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import FloatArray

# Throttles at which the weight of the data is kept.
BINS = 51
# Observations further out than this many standard deviations count as that far.
_OUTLIER = 5.0
# Weights are brought back to today's unit beyond this.
_LARGE = 1e100
# Share of one observation in the running scatter.
_SHARE = 0.02
# Distance in throttle over which slow changes of the curve go together.
_ALIKE = 0.5


@dataclass(frozen=True)
class CurvePrior:
    """
    What is believed of a curve before it has been flown, in its own unit.

    Attributes
    ----------
    common : float
        Standard deviation of the level common to all throttles.
    slope : float
        Standard deviation of the slope, per unit throttle.
    bend : float
        Standard deviation of what is not straight, over the whole range of throttle.
    change : float
        Standard deviation of how far a point of the curve moves within the forgetting time.
    walk : float
        Random walk of the common level, per sqrt(s).
    drift, drift_time : float
        Standard deviation, per s, and correlation time, s, of a steady drift of the common level.

    """

    common: float
    slope: float
    bend: float
    change: float
    walk: float = 0.0
    drift: float = 0.0
    drift_time: float = 30.0

    def scaled(self, unit: float) -> CurvePrior:
        """Return the same for a curve in units smaller by a factor."""
        return CurvePrior(unit * self.common, unit * self.slope, unit * self.bend,
                          unit * self.change, unit * self.walk, unit * self.drift,
                          self.drift_time)


class HatFilter:
    """
    A piecewise-linear curve over throttle 0..1 and how well it is known.

    The state is the value at each node, and the drift of all of them together.

    Parameters
    ----------
    nodes : int
        Number of nodes, >= 2, evenly spaced from 0 to 1.
    forgetting : float
        Time in which the shape changes by `CurvePrior.change`, s.

    """

    def __init__(self, nodes: int, forgetting: float) -> None:
        self.nodes = nodes
        self._forgetting = forgetting
        self._x = np.full(nodes + 1, math.nan)
        self._p = np.zeros((nodes + 1, nodes + 1))
        self._prior: CurvePrior | None = None
        self._rate = np.zeros_like(self._p)
        # Sums of 1 / variance; instead of the old ones fading, the unit of the new ones grows.
        self._weight = np.zeros(BINS)
        self._unit = 1.0
        self._needed = math.inf
        self._scatter = 1.0
        reach = round(0.5 * (BINS - 1) / (nodes - 1))
        self._near = np.ones(2 * reach + 1)

    @property
    def started(self) -> bool:
        """Whether anything has been observed."""
        return self._prior is not None

    @property
    def scatter(self) -> float:
        """Mean square of the last fifty or so misses, in standard deviations; about 1 is right."""
        return self._scatter if self.started else math.nan

    @property
    def forgetting(self) -> float:
        """Time in which the shape changes by `CurvePrior.change`, s."""
        return self._forgetting

    @forgetting.setter
    def forgetting(self, value: float) -> None:
        """Change how fast the curve is forgotten; what is known stays."""
        self._forgetting = value
        self._set_rate()

    def start(self, value: float, prior: CurvePrior) -> None:
        """Begin from a flat curve at `value`, as uncertain as the prior says."""
        n = self.nodes
        at = np.linspace(0.0, 1.0, n)
        self._x = np.full(n + 1, value)
        self._x[n] = 0.0
        self._p = np.zeros((n + 1, n + 1))
        # A straight line through the middle, and a random walk across the nodes from the first.
        middle = at - 0.5
        self._p[:n, :n] = (prior.common ** 2 + prior.slope ** 2 * np.outer(middle, middle)
                           + prior.bend ** 2 * np.minimum.outer(at, at))
        self._p[n, n] = prior.drift ** 2
        self._weight[:] = 0.0
        self._unit = 1.0
        spacing = 1.0 / (n - 1)
        self._needed = 1.0 / (prior.bend ** 2 * spacing + (prior.slope * spacing) ** 2)
        self._scatter = 1.0
        self._prior = prior
        self._set_rate()

    def _set_rate(self) -> None:
        """Compute how fast the variance grows, per s."""
        if self._prior is None:
            return
        n = self.nodes
        at = np.linspace(0.0, 1.0, n)
        self._rate = np.zeros((n + 1, n + 1))
        alike = np.exp(-np.abs(np.subtract.outer(at, at)) / _ALIKE)
        self._rate[:n, :n] = (
            self._prior.change ** 2 / self._forgetting * alike + self._prior.walk ** 2)

    def predict(self, dt: float) -> None:
        """Let the time `dt`, s, go by without an observation."""
        prior = self._prior
        if prior is None or dt <= 0.0:
            return
        p = self._p
        p += self._rate * dt
        faded = dt / self._forgetting
        if faded > 100.0:
            self._weight[:] = 0.0
        elif self._unit > _LARGE:
            self._weight /= self._unit * math.exp(faded)
            self._unit = 1.0
        else:
            self._unit *= math.exp(faded)
        if prior.drift == 0.0:
            return
        # The drift is an OU of its own: exact moments of its integral over dt.
        n, time = self.nodes, prior.drift_time
        keep = math.exp(-dt / time)
        gone = time * (1.0 - keep)
        x, square = dt / time, prior.drift ** 2
        self._x[:n] += gone * self._x.item(n)
        self._x[n] *= keep
        with_drift = p[:n, n].copy()
        own = p.item(n, n)
        add = gone * with_drift
        block = p[:n, :n]
        block += add
        block += add[:, None]
        block += gone * gone * own + square * time * time * (
            2.0 * x - 3.0 + 4.0 * keep - keep * keep)
        with_drift *= keep
        with_drift += keep * gone * own + square * time * (1.0 - keep) ** 2
        p[:n, n] = p[n, :n] = with_drift
        p[n, n] = keep * keep * own + square * (1.0 - keep * keep)

    def correct(self, throttle: float, value: float, variance: float) -> None:
        """Take in one observation of the curve at a throttle 0..1."""
        place = throttle * (self.nodes - 1)
        i = min(int(place), self.nodes - 2)
        right = place - i
        left = 1.0 - right
        p, x = self._p, self._x
        gain = p[i] * left + p[i + 1] * right
        total = left * gain.item(i) + right * gain.item(i + 1) + variance
        miss = value - left * x.item(i) - right * x.item(i + 1)
        square = miss * miss / total
        self._scatter += _SHARE * (min(square, _OUTLIER ** 2) - self._scatter)
        if square > _OUTLIER ** 2:
            total *= square / _OUTLIER ** 2
        x += gain * (miss / total)
        gain *= 1.0 / math.sqrt(total)
        p -= gain[:, None] * gain
        self._weight[int(throttle * (BINS - 1) + 0.5)] += self._unit / variance

    def value(self, throttle: float) -> float:
        """Return the curve at one throttle 0..1; NaN before any observation."""
        place = throttle * (self.nodes - 1)
        i = min(int(place), self.nodes - 2)
        right = place - i
        return float((1.0 - right) * self._x.item(i) + right * self._x.item(i + 1))

    def curve(self, throttles: FloatArray, ahead: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return the curve and its standard error (ahead in s)."""
        prior = self._prior
        if prior is None:
            unknown = np.full(throttles.shape, math.nan)
            return unknown, unknown.copy()
        n = self.nodes
        place = np.clip(throttles, 0.0, 1.0) * (n - 1)
        weights = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(n)))
        drift = ahead * self._p[:n, n]
        at_end = (self._p[:n, :n] + drift) + drift[:, None] + ahead * (
            self._rate[:n, :n] + ahead * self._p.item(n, n))
        variance = ((weights @ at_end) * weights).sum(axis=1)
        values = weights @ self._x[:n] + ahead * self._x[n]
        widen = math.sqrt(max(1.0, self._scatter))
        return values, widen * np.sqrt(np.maximum(variance, 0.0))

    def seen(self) -> FloatArray:
        """Return how much the data near each throttle weigh against the prior."""
        return np.convolve(self.flown(), self._near, 'same')

    def flown(self) -> FloatArray:
        """Return the ratio of `seen` for the data at each throttle of the bins alone."""
        return self._weight / (self._unit * self._needed)
