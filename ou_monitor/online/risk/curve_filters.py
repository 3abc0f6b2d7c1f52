"""
What the curves are learned with: blocks of samples, and Kalman filters.

`HatFilter` learns a piecewise-linear curve.  Limits: detail finer than the distance of two nodes
is not resolved; observations are taken as independent and Gaussian; where their scatter says
otherwise, the standard errors are widened by what the last fifty or so show.  Within a block
throttle is taken as constant; the innovations are those of an OU with white noise, with alpha
and noise from the estimate.

`Wander` follows how an intensity goes beside its curve, a random walk whose speed is learned
with it: a bank of scalar Kalman filters, one for each speed, weighted by how well each has
foretold what came (multiple models; Magill, IEEE Trans. Autom. Control 10 (1965) 434).  One
speed at a time, the same for all throttles; what is seen of it is forgotten over minutes.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import Estimate, FloatArray

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
    A piecewise-linear curve over throttle 0..1, at even nodes, and how well it is known.

    The state is the value at each node, and the drift of all of them together; in `forgetting`, s,
    the shape changes by `CurvePrior.change`.
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


# Throttles closer than this are one.
STEADY = 0.03
# Relative variance of sigma^2 at which its logarithm is taken, and up to which it may be.
_SHARP = 0.1
_BLUNT = 0.35
# Fewest squares of one block.
_SQUARES = 8


def noise_variance(e: Estimate) -> float:
    """Return the variance of the white noise of a sample, V^2; 0 when unknown."""
    return e.noise_std ** 2 if e.noise_std > 0.0 else 0.0


class Squares:
    """Squares of innovations, until there are enough for a logarithm."""

    def __init__(self) -> None:
        self._sum = self._weight = self._throttle = self._time = 0.0
        self._worse = 1.0

    def add(self, t: FloatArray, v: FloatArray, throttle: float, dt: float, e: Estimate,
            even: bool, sigma: float) -> None:
        """
        Add a block, as an estimate of sigma^2 with its relative variance; `sigma` is expected.

        Innovations over k steps, e_j = v_j - phi^k v_{j-k} less their mean, have variance
        g + N: g = sigma^2 (1 - phi^2k) / (2 alpha), N = noise^2 (1 + phi^2k).  k is 1 unless
        noise would hide sigma.  `even` when no sample is missing between the stamps.
        """
        n, noise = t.size, noise_variance(e)
        k = 1
        if noise > 0.0:
            k = max(1, min(math.ceil(min(2.0 * noise / (sigma ** 2 * dt), n)), n // 4,
                           int(1.0 / (e.alpha * dt))))
        later, earlier = v[k:], v[:-k]
        step = k * dt
        if not even:
            # Samples were lost, maybe: only pairs that are k steps apart.
            lag = t[k:] - t[:-k]
            usual = float(np.median(lag))
            regular = np.abs(lag - usual) < 0.5 * usual / k
            later, earlier = later[regular], earlier[regular]
            step = float(lag[regular].mean()) if later.size else usual
        m = later.size
        if m - k < _SQUARES:
            return
        phi = math.exp(-e.alpha * step)
        parts = later - phi * earlier
        total = float(parts.sum())
        per_sigma2 = (1.0 - phi * phi) / (2.0 * e.alpha)
        hidden = noise * (1.0 + phi * phi)
        # The mean of overlapping innovations takes k squares of g with it.
        g = (float(parts @ parts) - total * total / m - m * hidden
             + noise * (1.0 - phi) ** 2) / (m - k)
        expected = sigma ** 2 * per_sigma2
        share = expected / (expected + hidden)
        alike = 1.0 + share ** 2 * (k - 1) * (2 * k - 1) / (3.0 * k) + (
            2.0 * ((1.0 - share) * phi / (1.0 + phi * phi)) ** 2)
        weight = 0.5 * (m - k) * share ** 2 / alike
        self._sum += weight * g / per_sigma2
        self._throttle += weight * throttle
        self._weight += weight
        self._time += n * dt
        # Noise that is wrong, or was not found, weighs more where sigma is less than in the
        # window as a whole.
        self._worse = max(self._worse, (e.sigma / sigma) ** 2)

    def take(self, e: Estimate, throttle: float) -> tuple[float, float, float] | None:
        """
        Return throttle, ln(sigma) and its variance, when there are enough squares.

        The logarithm of a mean of squares is too low by half its relative variance.  What the
        estimate says of its own ln(sigma) holds here too, time for time: it has the errors of
        alpha and of the noise in it.
        """
        if not self._weight:
            return None
        relative = 1.0 / self._weight
        at = self._throttle / self._weight
        away = abs(at - throttle) > STEADY
        if relative > _SHARP and not away:
            return None
        mean, time, worse = self._sum / self._weight, self._time, self._worse
        self._worse = 1.0
        self._sum = self._weight = self._throttle = self._time = 0.0
        if relative > _BLUNT or mean <= 0.0:
            return None
        variance = 0.25 * relative
        # What was expected may be wrong, as at a throttle not flown before.
        worse = max(worse, e.sigma ** 2 / mean)
        if e.sigma_se > 0.0 and time > 0.0:
            variance = max(variance, (worse * e.sigma_se) ** 2 * e.duration / time)
        return at, 0.5 * (math.log(mean) + 0.5 * relative), variance


# Speeds that are weighed: variance gained per second.  From a rail that stays as it is to
# one whose sigma changes by a quarter within a second.
_SPEEDS = np.array([0.0, 1e-4, 5e-4, 2e-3, 8e-3, 3e-2])
# What is believed before any data.
_PRIOR = np.array([0.15, 0.2, 0.2, 0.2, 0.15, 0.1])
# Time over which what was seen is forgotten, s.
_MEMORY = 120.0
# An observation further off than this many standard deviations counts as that far.
_FAR = 4.0
# Variance before any data: twofold either way is common.
_WIDE = 0.5


class Wander:
    """
    A level that walks at random, seen through noise: its value and the variance of that.

    `speed`: variance that it gains per second; `fast_speed`: the faster of what may be counted
    more.
    """

    def __init__(self) -> None:
        self._mean = np.zeros(_SPEEDS.size)
        self._variance = np.full(_SPEEDS.size, _WIDE)
        self._log = np.log(_PRIOR)
        self._weight: FloatArray = _PRIOR.copy()

    def elapse(self, dt: float) -> None:
        """Let time go by, s."""
        self._variance += _SPEEDS * dt
        # Towards the first belief.
        keep = math.exp(-dt / _MEMORY)
        self._log = keep * self._log + (1.0 - keep) * np.log(_PRIOR)
        self._weigh()

    def correct(self, seen: float, variance: float) -> None:
        """Take an observation."""
        total = self._variance + variance
        away = np.clip((seen - self._mean) / np.sqrt(total), -_FAR, _FAR)
        gain = self._variance / total
        self._mean += gain * away * np.sqrt(total)
        self._variance *= 1.0 - gain
        self._log -= 0.5 * (away * away + np.log(total))
        self._weigh()

    def _weigh(self) -> None:
        self._log -= self._log.max()
        weight = np.exp(self._log)
        self._weight = weight / weight.sum()

    @property
    def value(self) -> float:
        """Where it is."""
        return float(self._weight @ self._mean)

    @property
    def variance(self) -> float:
        """How well `value` is known, the filters' disagreement included."""
        return float(self._weight @ (self._variance + (self._mean - self.value) ** 2))

    @property
    def speed(self) -> float:
        """Return the variance that it gains per second."""
        return float(self._weight @ _SPEEDS)

    @property
    def fast_speed(self) -> float:
        """Return the same where the faster count by their speed, as tails feel them."""
        speed = self.speed
        return float(self._weight @ _SPEEDS**2) / speed if speed > 0.0 else 0.0
