"""
Brown-out risk as a weighted mean of several methods, and the risk if throttle changes.

Methods: `first_passage` (the OU in the window, at the present throttle), `load` (half the response
to the pilot's future throttle, half the excursions), and `excursions` (the drops of this flight,
used alone if the load is unknown).  First passage is averaged with one of the other methods; the
other method's weight is the share of completed horizons whose lowest voltage contradicts first
passage.

Law learned in flight, by least squares with forgetting over completed horizons: lowest - start =
b0 s + b1 (mu - start) + e.  start is the mean voltage at the beginning; `lowest` gives mean mu,
noise s, error r and `brief` f.  e has Student's t distribution with five degrees of freedom, and
the variance k0 s^2 + k1 f (mu - start)^2 + k2 r^2.

A law is mixed with a wider one, whose weight is the share of horizons that contradict the law
(rule of succession).  A horizon counts by the probability that the law was wrong in it, times
step / horizon if horizons overlap.  First passage is mixed with the other method.  The law for a
given throttle is mixed with a law that initially has the width of the excursions, but at most
`_WIDEST` times its own width, because excursions include bursts of throttle, which are irrelevant
to idling.  The wider law widens further if contradicting voltages lie beyond its width.

`look_ahead` computes the risk, its curve over throttle, and the throttle budget.  Limits, beyond
those in doc/risk.md: one bias and one gain apply to all throttles; laws are interpolated between
two horizons.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from statistics import median

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import ripple
from ou_monitor.model.passage import prepare
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import LoadState, LoadStatus, SupplyLoad
from ou_monitor.online.risk.courses import (
    BLOCK, Courses, excursion_risk, excursions, FlightHistory, flown, FlownHorizons, held, lowest,
    mean_now, pilot, Sampling, throttle_gap)
from ou_monitor.online.risk.first_passage import Passage, risk_of, Supply
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, FloatArray, NAN
from ou_monitor.timeline import Batch

# Degrees of freedom of Student's t: heavy tails, because the model is sometimes wrong.
FREEDOM = 5.0
_NORM = math.exp(math.lgamma(0.5 * FREEDOM + 0.5) - math.lgamma(0.5 * FREEDOM)) / math.sqrt(
    math.pi * (FREEDOM - 2.0))
# Coefficients of the power series of the tail in FREEDOM / (FREEDOM + t^2), highest power first.
_TAIL = [8.0 / (3.0 * math.pi) * math.comb(2 * k, k) / 4.0**k / (2 * k + 5)
         for k in range(9, -1, -1)]
# Prior of the law: weight of the variances, in horizons; k0 (1 to 6 on nine recorded flights, from
# gecko to cf_takeoff), k1 (a peak of one block: see `courses`) and k2 (1: the error stated by the
# load filter is right); precision matrix of bias and gain (elements 00, 01, 11).
_PRIOR, _VARIANCES = 5.0, np.array([3.0, 0.1, 1.0])
_PRECISION = (1.0 / 0.75, 0.0, 1.0 / 0.48)
# Memory, s; limit of squared standardised errors; standardised error above which errors weigh less
# in the regression.
MEMORY, _LARGEST, _HUBER = 120.0, 36.0, 3.0
# Maximum initial width of the wider law, in widths of the law: chosen on gecko, nazgul, roma,
# bf3s, erle and cf_solo (2 to 6 tried).
_WIDEST = 4.0
# Weight of the wider law's initial width in its average with the misses of this flight, in
# horizons (chosen on gecko, frc_ol_1 and cf_solo; 1 and 4 tried).
_FIRST = 4.0
# Number of horizons that initially count as agreeing with the law for a given throttle: chosen on
# the recordings of `_WIDEST`, hiro, cf_pair, cf_bl00, frc_ol_1 and euc_1 (1, 4, 9, 19 tried).
_AGREE = 4.0


def density(x: FloatArray, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return the density of Student's t with a mean and a deviation, elementwise."""
    z = (x - mean) / deviation
    return np.asarray(_NORM / deviation * (1.0 + z * z / (FREEDOM - 2.0)) ** (
        -0.5 * (FREEDOM + 1.0)))


def below(level: float, mean: FloatArray, deviation: FloatArray) -> FloatArray:
    """Return P(x < level) for the same Student's t, elementwise."""
    t = (level - mean) / deviation * math.sqrt(FREEDOM / (FREEDOM - 2.0))
    # Abramowitz & Stegun 26.7.4; in the far tail, where its terms cancel, the series is used.
    angle = np.arctan2(math.sqrt(FREEDOM), np.abs(t))
    c = np.sin(angle)
    tail = (angle - np.cos(angle) * c * (1.0 + 2.0 / 3.0 * c * c)) / math.pi
    far = c < 0.2
    if far.any():
        tail = np.where(far, c**5 * np.polyval(_TAIL, c * c), tail)
    return np.asarray(np.where(t < 0.0, tail, 1.0 - tail))


def _wider(spread: FloatArray, deviation: float, misses: tuple[float, float]) -> FloatArray:
    n, squares = misses
    first = np.minimum(np.hypot(spread, deviation), _WIDEST * spread)
    missed = np.sqrt((_FIRST * first * first + squares) / (_FIRST + n))
    return np.asarray(np.maximum(first, missed))


def moments(law: FloatArray, parts: Sequence[FloatArray], start: float
            ) -> tuple[FloatArray, FloatArray]:
    """Return mean and deviation of the lowest voltage, V, errors of the law included."""
    # law: bias b0, gain b1, variances k0 to k2, and covariance of b0 and b1 (3 values); parts:
    # from `lowest`.
    mean, noise, error, brief = parts
    bias, gain, k0, k1, k2, c00, c01, c11 = law.tolist()
    x = mean - start
    return start + bias * noise + gain * x, np.sqrt(
        (k0 + c00) * noise * noise + 2.0 * c01 * noise * x + (k1 * brief + c11) * x * x
        + k2 * error * error)


class Calibrator:
    """Learns a law of the lowest voltage (see `moments`) from completed horizons."""

    def __init__(self) -> None:
        # Normal equations of the regression of the fall on noise and predicted fall.
        self._information: tuple[float, ...] = _PRECISION
        self._weighted: tuple[float, ...] = _PRECISION[1:]
        # For each variance: effective number of horizons, and sum of the variances they imply.
        self._count, self._squares = np.zeros(3), np.zeros(3)
        self._settle()

    def _settle(self) -> None:
        a, both, b = self._information
        first, second = self._weighted
        whole = a * b - both * both
        self._b = (b * first - both * second) / whole, (a * second - both * first) / whole
        self._variance = (_PRIOR * _VARIANCES + self._squares) / (_PRIOR + self._count)
        self.law = np.array([*self._b, *self._variance, b / whole, -both / whole, a / whole])

    def add(self, low: float, predicted: Sequence[float], start: float, weight: float,
            elapsed: float) -> None:
        """Learn from a completed horizon: lowest, V, predicted (see `lowest`) and start, V."""
        mean, noise, error, brief = predicted
        keep = math.exp(-elapsed / MEMORY)
        x, y = mean - start, low - start
        miss = y - self._b[0] * noise - self._b[1] * x
        parts = self._variance * np.array([noise * noise, brief * x * x, error * error])
        total = float(parts.sum())
        least = weight / total * min(1.0, _HUBER * math.sqrt(total) / max(abs(miss), 1e-9))
        # Each variance learns in proportion to its share of the total (score equations).
        share = weight * parts / total
        self._count = self._count * keep + share
        self._squares = self._squares * keep + share * self._variance * min(
            miss * miss / total, _LARGEST)
        self._information = tuple(
            prior + (old - prior) * keep + least * one
            for prior, old, one in zip(_PRECISION, self._information, (
                noise * noise, noise * x, x * x)))
        self._weighted = tuple(
            prior + (old - prior) * keep + least * y * one
            for prior, old, one in zip(_PRECISION[1:], self._weighted, (noise, x)))
        self._settle()


class ContradictionRate:
    """Share of horizons that contradict a law; initially, `right` horizons count as agreeing."""

    def __init__(self, right: float) -> None:
        self._right, self._wrong = right, 1.0
        self._first = right
        self._squares = 0.0

    @property
    def value(self) -> float:
        """Return the share."""
        return self._wrong / (self._wrong + self._right)

    @property
    def misses(self) -> tuple[float, float]:
        """Return number and sum of squares, V^2, of the misses that contradict the law."""
        return self._wrong - 1.0, self._squares

    def add(self, law: float, far: float, weight: float, elapsed: float, miss: float = 0.0
            ) -> None:
        """Learn from both densities, 1/V, of a lowest voltage (miss: V below the law's mean)."""
        keep = math.exp(-elapsed / MEMORY)
        share = self.value
        both = share * far + (1.0 - share) * law
        wrong = share * far / both if both > 0.0 else 1.0
        self._wrong = 1.0 + (self._wrong - 1.0) * keep + weight * wrong
        self._squares = self._squares * keep + weight * wrong * miss * miss
        self._right = self._first + (self._right - self._first) * keep + weight * (1.0 - wrong)


# Horizons, s, for which laws are learned; laws between two horizons are interpolated in ln h.
HORIZONS = (0.5, 1.0, 2.0, 5.0, 15.0)
_LN_HORIZONS = np.log(HORIZONS)
# Share in the interpolation below which a horizon is left out; larger than rounding errors.
_LEAST_SHARE = 1e-9
# Time between updates, s, and as a share of the horizon.
LOOK, _LOOK_SHARE = 0.2, 0.2
# Minimum time between updates by arrival, s: an update takes 1 ms, and stamps may run a thousand
# times too fast.  A replay at four times the speed is not affected.
_REST = 0.05
# Limit of the error of ln sigma; with a larger error, sigma is practically unknown.
_LARGEST_ERROR = 1.0
# Number of horizons that initially count as agreeing with first passage (one counts as
# contradicting it); large, because first passage is used only if the window shows an OU.
_PREDICTED = 9.0
# Share of the excursions in the method `load`, because the pilot's next throttle is unknown.  The
# errors of the two forecasts differ, and no flight is long enough to learn weights (on ten flights
# of seven quadcopters, weights learned in flight were worse).
_HALF = 0.5
# Time over which the throttle in use is determined, s.
_USED = 30.0
# Possible main causes of a risk.
DOMINANT = ('noise', 'load now', 'throttle to come')


@dataclass(frozen=True)
class Outcome:
    """A risk, its method and its main cause."""

    risk: float = NAN  # Probability, 0..1; NaN if unknown.
    basis: str = 'none'  # ``first_passage``, ``load``, ``excursions`` or ``none``.
    # Main cause: noise, load now, or throttle to come; empty if unknown.
    cause: str = ''


@dataclass(frozen=True, eq=False)
class _PendingHorizon:
    """State at the beginning of a horizon, kept until its end (mean, deviation: of drops)."""

    t: float
    voltage: float
    mean: float
    deviation: float
    state: LoadState | None
    courses: tuple[Courses, FloatArray] | None
    passage: Passage | None


class _HorizonLaws:
    """Laws learned from completed horizons of one length."""

    def __init__(self, horizon: float) -> None:
        self.horizon = horizon
        self.pending: deque[_PendingHorizon] = deque()
        self.next = self.learned = -math.inf
        self.calibrator = Calibrator()
        self.held, self.passage = ContradictionRate(_AGREE), ContradictionRate(_PREDICTED)

    @property
    def values(self) -> FloatArray:
        """Return the values that are interpolated between horizons."""
        return np.append(self.calibrator.law, (
            self.held.value, *self.held.misses, self.passage.value))

    def learn(self, begun: _PendingHorizon, low: float, peak: float, dwell: float,
              sampling: Sampling) -> None:
        """Learn from a completed horizon: lowest voltage, V, highest throttle, time there, s."""
        weight = min(1.0, (begun.t - self.learned) / self.horizon) if math.isfinite(
            self.learned) else 1.0
        elapsed = max(begun.t - self.learned, 0.0) if math.isfinite(self.learned) else 0.0
        self.learned = begun.t
        y = np.array([low])
        far = float(density(y, y * 0.0 + begun.voltage - begun.mean, y * 0.0 + begun.deviation)[0])
        other = far
        if begun.state is not None and begun.courses is not None and math.isfinite(peak):
            start, law = mean_now(begun.state), self.calibrator.law
            courses, shares = begun.courses
            parts = lowest(
                begun.state, courses.after(held(peak, dwell, begun.state.throttle)), self.horizon,
                sampling)
            middle, spread = moments(law, parts, start)
            found = density(y, middle, spread)
            wide = density(y, middle[:1], _wider(spread[:1], begun.deviation, self.held.misses))
            self.held.add(float(found[0]), float(wide[0]), weight, elapsed,
                          max(float(middle[0] - low), 0.0))
            other = _HALF * far + (1.0 - _HALF) * float(shares @ found[1:])
            self.calibrator.add(low, [part.item(0) for part in parts], start, weight, elapsed)
        if begun.passage is not None:
            self.passage.add(begun.passage.density(low, self.horizon), other, weight, elapsed)


def _shares(horizon: float) -> list[float]:
    """Return the share of each of HORIZONS in a law for a horizon, s."""
    place = np.interp(math.log(horizon), _LN_HORIZONS, np.arange(_LN_HORIZONS.size))
    off = np.abs(np.arange(_LN_HORIZONS.size) - place)
    shares: list[float] = np.maximum(1.0 - off, 0.0).tolist()
    return shares


def _shorter_horizons(horizon: float) -> list[float]:
    """Return a horizon and the shorter ones of HORIZONS, down to a fifth of it."""
    return [*(one for one in HORIZONS if 0.2 * horizon <= one < horizon), horizon]


class Forecast:
    """
    Risk with the pilot's future throttle, and with a given one.

    look: update interval, s; horizon: the only one for which risks are needed, s; NaN: any.
    """

    def __init__(self, loads: LoadFilter, look: float = LOOK, horizon: float = NAN) -> None:
        # The first call takes a third of a second, so make it before the first sample.
        prepare()
        self._loads, self._look_time = loads, look
        self.follow(Estimate(), 0.0)
        self._by_horizon = tuple(map(_HorizonLaws, HORIZONS))
        self._learning = self._by_horizon if math.isnan(horizon) else tuple(
            laws for laws, share in zip(self._by_horizon, _shares(horizon))
            if share > _LEAST_SHARE or laws.horizon in _shorter_horizons(horizon))
        self.new_time_line()
        self._known = False
        # Earliest arrival for the next update, s.
        self._rested = -math.inf
        self._sampling = Sampling(0.02, 0.1)

    def new_time_line(self) -> None:
        """Clear the past; keep the learned laws."""
        self._past = FlightHistory()
        self._newest = -math.inf
        self._last: FloatArray = np.empty(0)
        self._samples = 0
        self._begun = NAN
        self._next = -math.inf
        self._laws: dict[float, tuple[FloatArray, float, float, float, float]] = {}
        self._kept_drops: dict[float, tuple[float, float]] = {}
        self._kept_flown: dict[float, FlownHorizons] = {}
        self._kept_state: LoadState | None = None
        for laws in self._by_horizon:
            laws.pending.clear()
            laws.next = laws.learned = -math.inf

    def take(self, batch: Batch, came: float = math.inf) -> None:
        """Take readings; came: arrival of the last one, s, by a monotonic clock; inf: unknown."""
        t, v, u, drawn = batch.columns
        if t[0] < self._newest:
            # Stamps increase within one time line, so another one has begun.
            self.new_time_line()
            self._loads.new_time_line()
        begin, n = 0, t.size
        while begin < n:
            # Up to the next update.
            ahead = np.flatnonzero(t[begin:] >= self._next)
            end = begin + int(ahead[0]) + 1 if ahead.size and came >= self._rested else n
            part = slice(begin, end)
            self._loads.push(t[part], v[part], u[part], drawn[part])
            self._take(t[part], v[part], np.clip(u[part], 0.0, 1.0))
            if self._newest >= self._next and came >= self._rested:
                self._next = self._newest + self._look_time
                self._rested = came + _REST if math.isfinite(came) else -math.inf
                self._look()
            begin = end

    def _take(self, t: FloatArray, v: FloatArray, u: FloatArray) -> None:
        self._begun = t.item(0) if math.isnan(self._begun) else self._begun
        self._samples += t.size
        self._newest = t.item(-1)
        self._kept_drops.clear()
        self._kept_flown.clear()
        self._kept_state = None
        self.see(v)
        self._past.push(t, v, u)

    def see(self, v: FloatArray) -> None:
        """Take readings, V, for the present voltage only."""
        self._last = np.concatenate((self._last, v))[-3:]

    @property
    def flown(self) -> FloatArray:
        """Return the highest throttle of each block of the last minutes; NaN where unknown."""
        return np.asarray(self._past.table[3])

    @property
    def throttle(self) -> float:
        """Return the present throttle; NaN if the load is unknown."""
        state = self._state()
        return NAN if state is None else state.throttle

    @property
    def used(self) -> float:
        """Return the throttle exceeded for a tenth of the last 30 s; NaN if unknown."""
        return self._past.used(_USED, 0.1)

    @property
    def voltage(self) -> float:
        """Present voltage, V: the median of the last three samples; NaN for a single sample."""
        return median(self._last.tolist()) if self._last.size > 1 else NAN

    def follow(self, e: Estimate, window: float, ago: float = 0.0) -> None:
        """Take the newest estimate, and the length of its window, s, which ended `ago` s ago."""
        self.estimate, self._window = e, (window, ago)

    def supply(self) -> Supply | None:
        """Return the OU at the present throttle, from window and load; None if unknown."""
        if not self.estimate.usable:
            return None
        plain, state = Supply.of(self.estimate), self._present()
        if state is None:
            return plain
        # sigma is an average over the throttles of the window; the load model scales it to the
        # present throttle.
        flown = np.clip(np.append(self._past.throttles(*self._window), state.throttle),
                        *state.flown)
        apart = ripple(flown) - ripple(flown[-1])
        less = 0.5 * math.log(float(np.exp(state.log_variance[1] * apart).mean()))
        return replace(plain, ln_sigma=plain.ln_sigma - less, ln_sigma_se=min(math.hypot(
            plain.ln_sigma_se, 0.5 * state.ripple_se * float(apart.mean())), _LARGEST_ERROR))

    def passage(self) -> Passage | None:
        """Return the distribution of the lowest voltage from now on; None if unknown."""
        supply, now = self.supply(), self.voltage
        noise = self.estimate.noise_std
        return None if supply is None or math.isnan(now) else Passage(
            supply, now, noise if noise > 0.0 else 0.0)

    def _look(self) -> None:
        """Complete horizons, and start new ones."""
        self._laws.clear()
        self._known = self._loads.known
        if self._samples > 1:
            interval = (self._newest - self._begun) / (self._samples - 1)
            self._sampling = Sampling(interval, self._past.activity())
        due = any(self._newest >= laws.next for laws in self._learning)
        state = self._state() if due else None
        now, passage = self.voltage, self.passage() if due else None
        for laws in self._learning:
            while laws.pending and self._past.end >= laws.pending[0].t + laws.horizon + BLOCK:
                begun = laws.pending.popleft()
                outcome = self._past.outcome(begun.t, laws.horizon)
                if outcome is not None:
                    laws.learn(begun, *outcome, self._sampling)
            if self._newest < laws.next:
                continue
            laws.next = self._newest + max(
                self._look_time, _LOOK_SHARE * laws.horizon) - 0.5 * BLOCK
            mean, deviation = self._drops(laws.horizon)
            if math.isnan(deviation) or math.isnan(now):
                continue
            done = self._flown(laws.horizon)
            laws.pending.append(_PendingHorizon(
                self._newest, now, mean, deviation, state,
                None if state is None else pilot(done, state.throttle, laws.horizon), passage))

    def _drops(self, horizon: float) -> tuple[float, float]:
        """Return mean and deviation of the drops, V, computed once for the newest samples."""
        if horizon not in self._kept_drops:
            self._kept_drops[horizon] = excursions(self._past, horizon)
        return self._kept_drops[horizon]

    def _flown(self, horizon: float) -> FlownHorizons:
        """Return the throttle of completed horizons, computed once for the newest samples."""
        if horizon not in self._kept_flown:
            self._kept_flown[horizon] = flown(self._past, horizon)
        return self._kept_flown[horizon]

    def _learned(self, horizon: float) -> tuple[FloatArray, float, float, float, float]:
        """Return the law, its `held` share and misses (two values), and first passage's share."""
        if horizon not in self._laws:
            values = np.sum([share * laws.values for laws, share in zip(
                self._by_horizon, _shares(horizon)) if share > _LEAST_SHARE], axis=0)
            self._laws[horizon] = (values[:8], *values[8:].tolist())
        return self._laws[horizon]

    def risk(self, voltage: float, horizon: float) -> Outcome:
        """Return P(below `voltage`, V, within `horizon`, s), including future throttle."""
        now = self.voltage
        state = self._state()
        law, _, _, _, missed = self._learned(horizon)
        mean, deviation = self._drops(horizon)
        level = np.array([voltage])
        far = NAN if math.isnan(deviation) or math.isnan(now) else float(
            excursion_risk(now, level, horizon, mean, deviation)[0])
        risk, basis, cause = far, 'excursions', ''
        if state is not None and not math.isnan(far):
            courses, shares = pilot(self._flown(horizon), state.throttle, horizon)
            # At idle, at the present throttle, and with the pilot's future throttle.
            every = courses.after(held([0.0, state.throttle], horizon, state.throttle))
            each = below(voltage, *moments(
                law, lowest(state, every, horizon, self._sampling), mean_now(state)))
            parts = each.item(0), each.item(1), float(shares @ each[2:])
            risk, basis = _HALF * far + (1.0 - _HALF) * parts[2], 'load'
            cause = DOMINANT[int(np.argmax(np.diff(np.maximum.accumulate(
                np.array([0.0, *parts])))))]
        if now <= voltage:
            return Outcome(1.0, basis if not math.isnan(far) else 'none', cause or 'load now')
        supply = self.supply()
        if supply is not None:
            passage = float(risk_of(supply, voltage, horizon, None if math.isnan(now) else now,
                                    self.estimate.noise_std))
            if math.isnan(far):
                return Outcome(passage, 'first_passage', DOMINANT[0])
            risk = missed * risk + (1.0 - missed) * passage
            if missed < 0.5:
                basis, cause = 'first_passage', DOMINANT[0]
        return Outcome(min(max(risk, 0.0), 1.0), 'none' if math.isnan(risk) else basis, cause)

    def risks_held(self, throttle: FloatArray, voltage: float, *horizons: float
                   ) -> list[FloatArray]:
        """Return, for each horizon, the risk of throttles held throughout, (k,); see `risk_if`."""
        every = sorted({one for horizon in horizons for one in _shorter_horizons(horizon)})
        state = self._state()
        risks = dict(zip(every, self._risks_if(state, throttle, math.inf, voltage, every)))
        return [np.asarray(np.max([risks[one] for one in _shorter_horizons(horizon)], axis=0))
                for horizon in horizons]

    def risk_if(self, throttle: npt.ArrayLike, dwell: float, voltage: float, horizon: float,
                sag: float = 1.0, noise: float = 1.0) -> FloatArray:
        """Return the risk, (k,), of each throttle held for `dwell`, s; NaN: load unknown."""
        # sag, noise: factors on the response to throttle, and on the variance of the noise.
        u = np.clip(np.atleast_1d(np.asarray(throttle, dtype=np.float64)), 0.0, 1.0)
        state = self._state()
        if state is not None and (sag, noise) != (1.0, 1.0):
            scale = np.append((1.0, 1.0), np.full(state.mean.size - 2, sag))
            state = replace(state, mean=scale * state.mean,
                            covariance=np.outer(scale, scale) * state.covariance,
                            deviation=tuple(math.sqrt(noise) * x for x in state.deviation))
        # A fall within a shorter horizon is also within this one, and shorter horizons have more
        # data.
        return np.asarray(np.max(self._risks_if(
            state, u, dwell, voltage, _shorter_horizons(horizon), sag), axis=0))

    def _risks_if(self, state: LoadState | None, u: FloatArray, dwell: float, voltage: float,
                  horizons: list[float], sag: float = 1.0) -> list[FloatArray]:
        """Return the risk within each horizon, s, by the law of that horizon alone; (k,)."""
        # Drops and misses of this flight are due to its sag, and change with it by the factor sag.
        now, drops = self.voltage, [sag * self._drops(one)[1] for one in horizons]
        if state is None or math.isnan(now) or np.isnan(drops).any():
            return [np.full(u.shape, 1.0 if now <= voltage else NAN)] * len(horizons)
        within = np.repeat(horizons, u.size)
        courses = held(np.tile(u, len(horizons)), np.minimum(dwell, within), state.throttle)
        parts = np.split(np.stack(lowest(state, courses, within, self._sampling)),
                         len(horizons), axis=1)
        start, risks = mean_now(state), []
        for one, deviation, part in zip(horizons, drops, parts):
            law, wrong, n, squares, *_ = self._learned(one)
            middle, spread = moments(law, list(part), start)
            either = below(voltage, middle, np.stack((
                _wider(spread, deviation, (n, sag * sag * squares)), spread)))
            risk = wrong * either[0] + (1.0 - wrong) * either[1]
            # Below the level now, only less throttle can raise the voltage above it.
            risks.append(np.where((now <= voltage) & (u >= state.throttle), 1.0, risk))
        return risks

    def _state(self) -> LoadState | None:
        """Return the state from which to predict; None if the load is unknown."""
        return self._present() if self._known else None

    def _present(self) -> LoadState | None:
        """Return the state of the load filter, computed once for the newest samples."""
        if self._kept_state is None:
            self._kept_state = self._loads.state()
        return self._kept_state


# Throttles at which the risk is computed.
_GRID = np.linspace(0.0, 1.0, 51)
# Horizon of the flag's risk at the present throttle, s.
SOON = 1.0


@dataclass(frozen=True)
class RiskOutlook:
    """Risk and budget of one instant."""

    outcome: Outcome = Outcome()  # Risk, its method and its main cause.
    budget: float = NAN  # Throttle budget, 0..1; NaN if unknown.
    budget_reason: str = ''  # Cause that limits it, or why it is unknown.
    # Risk if throttle goes to each tenth and stays for the horizon; empty if unknown.
    curve: tuple[float, ...] = ()
    soon: float = NAN  # Risk within `SOON` at the present throttle; NaN if unknown.
    # Whether the budget is below the throttle exceeded for a tenth of the last 30 s.
    tight: bool = False


def look_ahead(forecast: Forecast, load: SupplyLoad, settings: MonitorSettings, *,
               alone: bool = False) -> RiskOutlook:
    """Return risk, risk curve and throttle budget for the settings; alone: only the risk."""
    s = settings
    voltage, horizon = s.brownout_voltage, s.brownout_horizon
    outcome = forecast.risk(voltage, horizon)
    if alone:
        return RiskOutlook(outcome)
    # One call for both horizons is twice as fast as two calls.
    each = forecast.risks_held(np.append(_GRID, forecast.throttle), voltage, SOON, horizon)
    soon, risks = each[0].item(-1), _rising(each[1][:-1])
    if math.isnan(soon):
        soon = forecast.risk(voltage, min(SOON, horizon)).risk
    if np.isnan(risks).any() or load.status is LoadStatus.NO_THROTTLE:
        why = '' if load.status is LoadStatus.NO_DATA else load.status.value if (
            not load.known) else 'Less than a second has been flown.'
        return RiskOutlook(outcome, NAN, why, soon=soon)
    budget, reason = throttle_budget(risks, forecast.flown, s.budget_limit)
    # The comparison is false for NaN.
    return RiskOutlook(outcome, budget, reason, tuple(risks[::5].tolist()), soon,
                       budget < forecast.used)


def risk_over_throttle(forecast: Forecast, voltage: float, horizon: float, sag: float = 1.0,
                       noise: float = 1.0) -> FloatArray:
    """Return the risk of each throttle of a grid, (51,), held for the horizon; see `risk_if`."""
    return _rising(forecast.risk_if(_GRID, horizon, voltage, horizon, sag, noise))


def _rising(risks: FloatArray) -> FloatArray:
    # Less throttle is never riskier, but just after high throttle the law may predict otherwise.
    return np.asarray(np.minimum.accumulate(risks[::-1])[::-1])


def throttle_budget(risks: FloatArray, flown: FloatArray, limit: float) -> tuple[float, str]:
    """Return the highest throttle with a risk within a limit (0: none), and why; risks: (51,)."""
    # The budget ends at the first throttle above the limit, even if the risk falls again beyond.
    risks = np.maximum.accumulate(risks)
    within = int(np.searchsorted(risks, limit, 'right'))
    if within == 0:
        return 0.0, f'Even at idle the risk is {risks[0]:.2g}, more than allowed.'
    end = 1.0
    if within < _GRID.size:
        low, high = risks[within - 1], risks[within]
        # Interpolate the logarithm of the risk, which is nearly linear over this distance.
        end = float(_GRID[within - 1] + (_GRID[within] - _GRID[within - 1]) * (
            math.log(limit / low) / math.log(high / low) if low > 0.0 else 0.0))
    gap = throttle_gap(flown)
    if gap[0] < end < gap[1]:
        return gap[0], (f'No data between {gap[0]:.2f} and {gap[1]:.2f}; the risk is within the '
                        'limit up to there.')
    highest = float(np.fmax.reduce(flown, initial=NAN))
    if end <= highest:
        return end, f'The risk passes the limit of {limit:.2g} at throttle {end:.2f}.'
    return highest, ('The risk is within the limit up to full throttle.' if highest == 1.0 else
                     f'No data above {highest:.2f}; the risk is within the limit up to there.')
