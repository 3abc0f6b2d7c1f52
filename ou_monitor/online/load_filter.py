"""
The voltage under load, learned in flight by a Kalman filter that needs no relaxation rate.

Limits first: throttle that is late biases the sag low (100 ms: by a third on a racing quad);
outside the throttles that were flown the sag is a guess; a change of the true sag is followed
within minutes.  doc/load.md has the equations and the figures.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import enum
import math
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import CELL, cells_in_series, INRUSH_TIME, LEVELS, SLOPES
from ou_monitor.records import FloatArray, NAN

# Exponent of the load over throttle, and of the load over the level: the batch's prior.
_POWER = 1.8
# Lags, s, of the load: of the motors, and of polarisation (the batch's medians, rounded).
LAGS = (0.06, 2.0, 15.0)
# Lag, s, of all: half of what an ESC takes to follow.
_LAG = 0.004
# Samples within that time, s, are one correction.
_STEP = 0.02
# Level: V per sqrt(s) and cell, an OU of 4.6 mV and 20 s; the batch found it.
_WALK = 0.0015
# The load's size may change by 25 % in 100 s; each coefficient by 2 % of full sag by itself.
_WARMING, _CHANGE = 0.25 ** 2 / 100.0, 0.02 ** 2 / 100.0
# Standard scores beyond this are weighed down; they score this much, squared, in the noise.
_CLIP, _OUTLIER = 4.0, 16.0
# Corrections after which the noise is forgotten, and s after which the throttle flown is.
_NOISE_MEMORY, _FLOWN_MEMORY = 2000.0, 120.0
# Known: the error of the sag over the throttle flown is below that share of it, or of the noise.
# The share was widened from 0.25 so that one recording reached 95 %.
_SAG_SHARE, _NOISE_SHARE = 0.33, 0.5
# Throttle that spans less than this has not moved.
_MOVED = 0.02
# Least relative error of the sag: that of the filter does not count change over a flight, and
# was up to 9 of its own too small.
_LEAST_ERROR = 0.1
# A stamp so much earlier, s, is a new flight.
_BACKWARDS = 1.0
# Throttle at which the sag is tabled, and the bins of the throttle flown.
_TABLE = np.linspace(0.0, 1.0, 101)
_BINS = 50
# dE/ds, V, of a cell at each 10 mV of open-circuit voltage from 3.4 V.
_LOWEST, _PER_VOLT = 3.4, 100.0
_SLOPE_AT = np.interp(_LOWEST + np.arange(91) / _PER_VOLT, LEVELS, SLOPES).tolist()


def _prior() -> tuple[FloatArray, FloatArray, float]:
    """
    Return mean and covariance of the coefficients, and mean sag, per volt of pack.

    a = S b: S is log-normal about 0.12; of b, beta(0.5, 1) lags by 60 ms, two shapes are
    normal(0, 0.2) and take 0.7 of themselves from the first, and the rest is log-normal.
    """
    def lognormal(median: float, deviation: float) -> tuple[float, float]:
        mean = median * math.exp(0.5 * deviation ** 2)
        return mean, mean ** 2 * math.expm1(deviation ** 2)

    size, size_var = lognormal(0.12, 0.6)
    parts = [(0.0, 0.2 ** 2), (0.0, 0.2 ** 2), (1.0 / 3.0, 4.0 / 45.0),
             lognormal(0.2, 0.5), lognormal(0.3, 0.5), lognormal(1.5, 1.0)]
    means, variances = np.array(parts).T
    mix = np.vstack([(-0.7, -0.7, -1.0, 0.0, 0.0, 0.0), np.eye(6)])
    mean = mix @ means
    mean[0] += 1.0
    square = np.outer(mean, mean)
    cov = (size ** 2 + size_var) * (mix @ np.diag(variances) @ mix.T + square) - size**2 * square
    return size * mean, cov, size


_MEAN, _COV, _SIZE = _prior()
_STATES = 2 + _MEAN.size

_Number = TypeVar('_Number', float, FloatArray)


def _static(throttle: npt.ArrayLike) -> FloatArray:
    """Return the regressors of a steady sag without polarisation, shape (n, 4)."""
    u = np.asarray(throttle, dtype=np.float64)
    x = u ** _POWER
    return np.stack([x, u, u ** 3, x], axis=-1)


def _ripple(u: _Number) -> _Number:
    """Return the ripple of an ESC over throttle: largest, 1, at 0.7."""
    return u * (1.4 - u) / 0.49


class LoadStatus(enum.Enum):
    """What is known of the answer to throttle; the value is the sentence for the pilot."""

    KNOWN = 'The sag is known over the throttles flown.'
    NO_DATA = 'No voltage has arrived.'
    STILL = 'Throttle has not moved: the sag is unknown.'
    UNCERTAIN = 'The sag is still uncertain: fly on.'
    NO_RELATION = ('The voltage does not fall with throttle: check the topic, the unit and the '
                   'sign of throttle.')


@dataclass(frozen=True)
class SupplyLoad:
    """
    What is known of the voltage under load.

    Attributes
    ----------
    status : LoadStatus
        Whether the sag is known, and why not.
    level : float
        Open-circuit voltage, V; NaN without voltage.
    resistance : float
        Resistance, Ohm; NaN, as this filter does not use current.
    time_constants : tuple of float
        Time constants of the answer, s; fixed.
    flown : tuple of float
        Throttles between which 80 % of the last two minutes were flown.

    """

    status: LoadStatus = LoadStatus.NO_DATA
    level: float = NAN
    resistance: float = NAN
    time_constants: tuple[float, ...] = LAGS
    flown: tuple[float, float] = (0.0, 1.0)
    _sag: tuple[float, ...] = ()
    _sag_se: tuple[float, ...] = ()
    _log_variance: tuple[float, float, float] = (NAN, NAN, NAN)
    _range: tuple[float, float] = (0.0, 1.0)

    @property
    def known(self) -> bool:
        """Return whether the sag is known."""
        return self.status is LoadStatus.KNOWN

    def sag(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the sag, V, positive, of a held throttle before polarisation; NaN: unknown."""
        return self._read(throttle, self._sag)

    def sag_se(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the standard error of the sag, V."""
        return self._read(throttle, self._sag_se)

    def noise(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the deviation of one sample, V; beyond the throttles flown that of the edge."""
        u = np.clip(np.asarray(throttle, dtype=np.float64), *self._range)
        b = self._log_variance
        return np.asarray(np.exp(0.5 * (b[0] + b[1] * _ripple(u))))

    def _read(self, throttle: npt.ArrayLike, table: tuple[float, ...]) -> FloatArray:
        u = np.asarray(throttle, dtype=np.float64)
        if not table or self.status is LoadStatus.STILL:
            return np.full(u.shape, NAN)
        return np.asarray(np.interp(u, _TABLE, table))


class LoadFilter:
    """
    Level, sag and noise of a supply, sample by sample.

    States: level, V; discharge per load, 1/s; coefficients, V, of x, u, u^3, x after three
    lags, and inrush, with x = u^1.8.  White noise has ln variance b.(1, ripple(u), sqrt|du|).
    """

    def __init__(self) -> None:
        self._t, self._throttle = NAN, 0.0

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike, throttle: npt.ArrayLike) -> None:
        """Add samples, s, V, 0..1; NaN throttle holds the last one, NaN voltage is no sample."""
        stamps, volts, throttles = np.broadcast_arrays(*np.atleast_1d(t, voltage, throttle))
        for one in zip(stamps.tolist(), volts.tolist(), throttles.tolist()):
            self._push(*one)

    def _push(self, t: float, v: float, u: float) -> None:
        if not (math.isfinite(v) and math.isfinite(t)):
            return
        u = min(max(u, 0.0), 1.0) if math.isfinite(u) else self._throttle
        if not math.isfinite(self._t) or t < self._t - _BACKWARDS:
            self._begin(t, v, u)
        elif t > self._t:
            self._predict(t, u)
            self._pending.append((self._regressors(), v, u, abs(u - self._throttle), t))
            spacing, self._t, self._throttle = t - self._t, t, u
            if t - self._pending[0][4] + 0.5 * spacing >= _STEP:
                self._correct()

    def _begin(self, t: float, v: float, u: float) -> None:
        """Begin a flight with the prior, scaled by the first voltage."""
        self._t, self._throttle = t, u
        self._volts = max(v, 1e-3)
        # Below 2.5 V no lithium cell: the curve is scaled.
        self._cells = float(cells_in_series(self._volts)) if self._volts > 2.5 else \
            self._volts / CELL
        self._lagged = self._settled = u
        x = u ** _POWER
        # The slow lag may be anywhere between rest and a steady load.
        self._lags = [x, x, 0.5 * x]
        self._factor = 1.0
        m, P = np.zeros(_STATES), np.zeros((_STATES, _STATES))
        m[2:], P[2:, 2:] = _MEAN * self._volts, _COV * self._volts ** 2
        # 350 s at a mean load of 0.23, known to a factor of two.
        m[1] = 1.0 / 80.0
        P[1, 1] = m[1] ** 2
        h = self._regressors()
        m[0] = v - h[2:] @ m[2:]
        # The level follows from the voltage: it shares the errors of the coefficients.
        P[0, 2:] = P[2:, 0] = -P[2:, 2:] @ h[2:]
        P[0, 0] = (0.02 * self._volts) ** 2 + h[2:] @ P[2:, 2:] @ h[2:]
        self._m, self._P = m, P
        # Noise: 0.4 % of the voltage, and what ripple and changes of throttle usually add.
        self._b = np.array([math.log((0.004 * self._volts) ** 2), 2.0, 4.0])
        self._B = np.diag([4.0, 4.0, 9.0])
        # Of the standard scores: mean square, correlation from one to the next, recent mean.
        self._scale, self._correlation, self._last, self._bias = 1.0, 0.0, 0.0, 0.0
        self._pending: list[tuple[FloatArray, float, float, float, float]] = []
        self._flown = np.zeros(_BINS + 1)
        self._n = 0
        self._resize()

    def _resize(self) -> None:
        """Scale the load: a propeller draws the less the lower the level."""
        level = min(4.3, max(3.2, float(self._m[0]) / self._cells))
        self._factor = (level / CELL) ** (_POWER - 1.0)

    def _regressors(self) -> FloatArray:
        u, g = self._lagged, -self._factor
        return np.array([1.0, 0.0, g * u ** _POWER, g * u, g * u ** 3,
                         *(g * x for x in self._lags), g * max(u - self._settled, 0.0)])

    def _advance(self, dt: float, u: float) -> float:
        """Move the regressors on by dt, s, exact once the lag has settled; return the load."""
        self._lagged = u + (self._lagged - u) * math.exp(-dt / _LAG)
        self._settled = self._lagged + (self._settled - self._lagged) * math.exp(
            -dt / INRUSH_TIME)
        x = self._lagged ** _POWER
        self._lags = [x + (low - x) * math.exp(-dt / tau) for low, tau in zip(self._lags, LAGS)]
        return float(x)

    def _fall(self, level: float) -> float:
        """Return the fall of the level, V, per unit of charge."""
        place = int((level / self._cells - _LOWEST) * _PER_VOLT + 0.5)
        return self._cells * float(_SLOPE_AT[min(len(_SLOPE_AT) - 1, max(0, place))])

    def _predict(self, t: float, u: float) -> None:
        dt = t - self._t
        x = self._advance(dt, u)
        m, P = self._m, self._P
        used = x * dt * self._fall(float(m[0]))
        m[0] -= used * m[1]
        P[0] -= P[1] * used
        P[:, 0] -= P[:, 1] * used
        # A pack recovers in a gap by more than it walks: up to 2 % in a minute.
        P[0, 0] += (_WALK * self._cells) ** 2 * dt + (0.02 * self._volts) ** 2 * min(
            max(0.0, dt - 2.0), 60.0) / 60.0
        P[2:, 2:] += (_WARMING * dt) * np.outer(m[2:], m[2:])
        P[range(2, _STATES), range(2, _STATES)] += _CHANGE * dt * (_SIZE * self._volts) ** 2
        self._flown *= 1.0 - min(dt / _FLOWN_MEMORY, 1.0)
        self._flown[int(u * _BINS + 0.5)] += dt

    def _correct(self) -> None:
        """Take the pending samples as one, weighted by their noise."""
        pending, self._pending = self._pending, []
        m, P, b = self._m, self._P, self._b
        precision = np.array([math.exp(-(b[0] + b[1] * _ripple(u) + b[2] * math.sqrt(du)))
                              for _, _, u, du, _ in pending])
        R = 1.0 / float(precision.sum())
        h = np.asarray((precision * R) @ np.array([one[0] for one in pending]))
        e = float((precision * R) @ np.array([one[1] for one in pending])) - float(h @ m)
        g = P @ h
        s = float(h @ g)
        scale = max(1.0, self._scale)
        score = e / math.sqrt(s + R * scale)
        # Innovations that follow one another (ADC steps, errors of the form) tell less.
        total = s + R * scale * (1.0 + self._correlation) / (1.0 - self._correlation)
        for row, v, u, du, _ in pending:
            self._learn_noise(v - float(row @ m), float(row @ P @ row), u, du)
        total *= max(1.0, abs(e) / math.sqrt(total) / _CLIP)
        clipped = max(-_CLIP, min(_CLIP, score))
        self._correlation += max(0.002, 1.0 / (self._n + 50.0)) * (
            clipped * self._last - self._correlation)
        self._correlation = max(0.0, min(0.9, self._correlation))
        self._last = clipped
        # Far out on one side for half a second: another battery, so the level is open again.
        self._bias += 0.1 * (max(-6.0, min(6.0, score)) - self._bias)
        if abs(self._bias) > 3.0:
            P[0, 0] += (0.05 * self._volts) ** 2
            self._bias = 0.0
        m += g * (e / total)
        P -= np.outer(g, g) / total
        self._resize()
        self._n += 1

    def _learn_noise(self, e: float, s: float, u: float, du: float) -> None:
        """Score the log variance (Fisher) by an innovation, V, and the state's variance, V^2."""
        f = np.array([1.0, _ripple(u), math.sqrt(du)])
        R = math.exp(float(f @ self._b))
        square = min(e * e / (s + R), _OUTLIER)
        # What the state does not know is not noise.
        share = max(R / (s + R), 0.05)
        self._B *= 1.0 + 1.0 / _NOISE_MEMORY
        g = self._B @ f
        own = float(f @ g)
        # The square of a standard normal has the variance 2.
        total = own + 2.0 / share ** 2
        self._b += g * min((square - 1.0) / share / total, 0.7 / own)
        self._B -= np.outer(g, g) / total
        self._B *= min(1.0, 9.0 / float(self._B.diagonal().max()))
        self._scale += max(0.002, 1.0 / (self._n + 20.0)) * (square - self._scale)

    def _between(self, share: float) -> tuple[float, float]:
        """Return the throttles flown, but for that share at each end."""
        total = np.cumsum(self._flown)
        low, high = np.searchsorted(total, (share * total[-1], (1.0 - share) * total[-1]))
        return (low / _BINS, high / _BINS) if total[-1] > 0.0 else (self._throttle,) * 2

    def load(self) -> SupplyLoad:
        """Return what is known now."""
        if not math.isfinite(self._t):
            return SupplyLoad()
        a, C = self._m[2:6] * self._factor, self._P[2:6, 2:6] * self._factor ** 2
        C = C * max(1.0, self._scale)
        H = _static(_TABLE)
        sag = np.maximum.accumulate(np.maximum(H @ a, 0.0))
        error = np.sqrt(np.maximum(np.einsum('ij,jk,ik->i', H, C, H), 0.0))
        low, high = self._between(0.1)
        b = (float(self._b[0]), float(self._b[1]), float(self._b[2]))
        load = SupplyLoad(
            LoadStatus.STILL, float(self._m[0]), flown=(low, high), _sag=tuple(sag.tolist()),
            _sag_se=tuple(np.maximum(error, _LEAST_ERROR * sag).tolist()), _log_variance=b,
            _range=self._between(0.02))
        if high - low >= _MOVED:
            d = _static(high) - _static(low)
            swing, swing_se = float(d @ a), math.sqrt(max(0.0, float(d @ C @ d)))
            limit = max(_SAG_SHARE * swing, _NOISE_SHARE * float(load.noise(0.5 * (low + high))))
            status = LoadStatus.UNCERTAIN
            if swing < -2.0 * swing_se or swing_se < limit and swing < 2.0 * swing_se:
                status = LoadStatus.NO_RELATION
            elif swing_se < limit:
                status = LoadStatus.KNOWN
            load = replace(load, status=status)
        return load

    def path(self, t: FloatArray, throttle: FloatArray) -> FloatArray:
        """Return the mean voltage, V, ahead of the last sample, from throttle; changes nothing."""
        if not math.isfinite(self._t):
            raise ValueError('no voltage has arrived: there is nothing to start from')
        kept = self._lagged, self._settled, self._lags
        now, level = self._t, float(self._m[0])
        out = np.empty(t.size)
        for k in range(t.size):
            dt = float(t[k]) - now
            level -= self._m[1] * self._advance(dt, float(throttle[k])) * dt * self._fall(level)
            out[k] = level + self._regressors()[2:] @ self._m[2:]
            now = float(t[k])
        self._lagged, self._settled, self._lags = kept
        return out
