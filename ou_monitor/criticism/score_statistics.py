"""
Test statistics of a model's scores: each is about standard normal if the model is right.

Mean and spread of each come from a `NullBank`: simulations of the fitted baseline with the stamps
and throttle of the data, fitted and evaluated in the same way.  Lines that follow throttle use
theory instead, because simulating them takes too long.
The name of a statistic begins with its kind, to which the `SIGNS` of terms refer.

Two kinds of statistics belong to no term, loops of throttle and a growing effect of throttle: they
expose effects that imitate a term but have hysteresis or develop over minutes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.tones import order_power
from ou_monitor.records import FloatArray
from scipy.signal import lfilter
from scipy.special import ndtri, stdtr, stdtrit

# Groups of lags, samples.
_LAGS = ((1, 1), (2, 2), (3, 5), (6, 15), (16, 50))
# Number of spectral bands.
_BANDS = 8
# Spans over which power is averaged, s.
_CLUSTERS = (0.02, 0.1, 0.5, 2.5, 8.0)
# Lengths of segments for bursts, samples; maximum lag of products of three, samples.
_SEGMENTS, _TRIPLES = (32, 128, 512), 10
# Quantiles of throttle at which a relay (hysteresis) switches down and up.
_RELAYS = ((0.15, 0.85), (0.28, 0.72), (0.4, 0.6))
# Minimum share of a regressor's power that the static response to throttle leaves unexplained.
_LEAST = 0.02


@dataclass(frozen=True, eq=False)
class Covariates:
    """The series that the scores of a recording are correlated with."""

    state: FloatArray  # Deviation of the sample before, V; shape (n,)
    throttle: FloatArray | None  # 0..1; shape (n,)
    rate: float  # Samples per second, Hz
    keep: float  # Share of the state that remains from one sample to the next
    paths: tuple[tuple[str, FloatArray], ...] = ()  # As `throttle_paths` yields them; shape (n,)


def is_sign(sign: str, name: str, value: float) -> bool:
    """Return whether a statistic matches a sign."""
    if sign[0] in '+-':
        return name.startswith(sign[1:]) and (value > 0.0) == (sign[0] == '+')
    return name.startswith(sign)


def statistics(z: FloatArray, given: Covariates, *, lines: bool = True) -> dict[str, float]:
    """Return all statistics."""
    # An outlier must not dominate statistics of other kinds.
    w = np.clip(z, -5.0, 5.0)
    square = np.minimum(z * z, 25.0) - 1.0
    square -= square.mean()
    found = dict([*_correlations(w), *_spectrum(w, given)])
    if lines and given.throttle is not None:
        # The strongest line whose frequency follows throttle.
        top, count = order_power(w, given.throttle, given.rate)
        found['order line'] = _largest(top, count) if count else 0.0
    return dict([*found.items(), *_moments(z), *_clustering(square, given),
                 *_inputs(w, square, given), *_state(w, square, given),
                 *((name, score(w, path)) for name, path in given.paths),
                 *_beyond_second_order(w, given)])


def _correlations(w: FloatArray) -> Iterator[tuple[str, float]]:
    n = w.size
    c = w - w.mean()
    power = float(c @ c)
    for low, high in _LAGS:
        if 4 * high > n:
            return
        r = sum(float(c[k:] @ c[:-k]) for k in range(low, high + 1)) / power
        name = f'autocorrelation lag {low}' + ('' if low == high else f' to {high}')
        yield name, math.sqrt(n / (high - low + 1.0)) * r


def _spectrum(w: FloatArray, given: Covariates) -> Iterator[tuple[str, float]]:
    n = w.size
    power = np.abs(np.fft.rfft(w - w.mean())[1:]) ** 2
    power /= power.mean()
    edges = np.unique(np.round(np.geomspace(1.0, power.size, _BANDS + 1)).astype(int))
    edges[0] = 0
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:])):
        if b - a >= 2:
            # The cube root makes a mean of exponentials nearly normal (Wilson & Hilferty).
            m = b - a
            mean = float(power[a:b].mean())
            value = (mean ** (1.0 / 3.0) - 1.0 + 1.0 / (9.0 * m)) * 3.0 * math.sqrt(m)
            low, high = max(a, 1) * given.rate / n, b * given.rate / n
            yield f'band {k}, {low:.3g} to {high:.3g} Hz', value
    # The largest of many exponentials.  The spectrum is flat under the null hypothesis of the
    # bank; `find_lines`, which decides which lines are tried, allows for other spectra.
    yield 'line', _largest(float(power[3:].max()), power.size - 3)


def _largest(top: float, count: float) -> float:
    """Return the normal score of the largest of `count` exponentials."""
    return -float(ndtri(min(max(-math.expm1(-count * math.exp(-top)), 1e-300), 0.999)))


def _moments(z: FloatArray) -> Iterator[tuple[str, float]]:
    n = z.size
    c = z - z.mean()
    c = c / math.sqrt(float(c @ c) / n)
    yield 'skewness', math.sqrt(n / 6.0) * float(np.mean(c**3))
    yield 'kurtosis', math.sqrt(n / 24.0) * (float(np.mean(c**4)) - 3.0)
    for limit, chance in ((4.0, 6.334e-5), (5.5, 3.798e-8)):
        found, expected = float((np.abs(z) > limit).sum()), n * chance
        # The square root makes Poisson counts nearly normal (Anscombe).
        value = 2.0 * (math.sqrt(found + 0.375) - math.sqrt(expected + 0.375))
        yield f'tails beyond {limit:g}', value


def _clustering(square: FloatArray, given: Covariates) -> Iterator[tuple[str, float]]:
    n = square.size
    yield 'clustering next sample', score(square[1:], square[:-1])
    yield 'clustering few samples', score(
        square[10:], lfilter(np.ones(9), [1.0], square)[9:-1] if n > 20 else square[10:])
    for span in _CLUSTERS:
        m = round(span * given.rate)
        count = n // m if m else 0
        if m < 4 or count < 12:
            continue
        mean = square[:count * m].reshape(count, m).mean(axis=1)
        yield f'clustering {span:g} s', score(mean[1:], mean[:-1])
        spread = float(mean.var()) * m / max(float(square.var()), 1e-12)
        value = (spread ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * count)) * math.sqrt(9.0 * count / 2.0)
        yield f'clustering spread {span:g} s', value


def _inputs(w: FloatArray, square: FloatArray, given: Covariates) -> Iterator[tuple[str, float]]:
    t = np.linspace(-1.0, 1.0, w.size)
    yield 'time', score(w, t)
    yield 'time squared', score(w, t * t)
    yield 'variance time', score(square, t)
    u = given.throttle
    if u is None:
        return
    yield 'throttle', score(w, u)
    centre = u - u.mean()
    slope = float((centre * centre * centre).mean()) / max(float((centre * centre).mean()), 1e-12)
    yield 'throttle squared', score(w, centre * centre - slope * centre)
    change = np.diff(u, prepend=u[0])
    for span in (0.002, 0.01, 0.05, 0.3, 2.0, 12.0):
        tau = span * given.rate
        if 0.5 <= tau < 0.25 * w.size:
            keep = math.exp(-1.0 / tau)
            recent = lfilter([1.0], [1.0, -keep], change)
            yield f'throttle change over {span:g} s', score(w, recent)
            if span in (0.05, 2.0):
                yield f'throttle direction over {span:g} s', score(w, np.abs(recent))
    # `analyze` instead compares sigma and alpha between levels of constant throttle.
    yield 'variance throttle', score(square, u)
    yield 'variance throttle squared', score(square, centre * centre - slope * centre)
    keep = math.exp(-1.0 / max(0.05 * given.rate, 1.0))
    yield 'variance change of throttle', score(
        square, lfilter([1.0], [1.0, -keep], np.abs(change)))


def _state(w: FloatArray, square: FloatArray, given: Covariates) -> Iterator[tuple[str, float]]:
    x = given.state / max(float(given.state.std()), 1e-12)
    x = np.clip(x, -4.0, 4.0)
    yield 'state squared', score(w, x * x - float((x**3).mean()) * x)
    yield 'state cubed', score(w, x**3 - float((x**4).mean()) * x)
    yield 'variance state', score(square, x)
    yield 'variance state squared', score(square, x * x)
    large = np.flatnonzero(np.abs(w[:-1]) > 3.0)
    pairs = w[large] * w[large + 1]
    yield 'pairs after a large one', float(pairs.sum()) / math.sqrt(
        max(float((w[large] ** 2).sum()), 9.0))
    if given.throttle is not None:
        # A slope of ln alpha over throttle, orthogonal to the score of alpha.
        u = given.throttle - given.throttle.mean()
        yield 'state throttle', score(w, x * u - float((x * x * u).mean()) * x)


def _beyond_second_order(w: FloatArray, given: Covariates) -> Iterator[tuple[str, float]]:
    """Yield statistics beyond second order: bursts of power, and products of three errors."""
    n = w.size
    for length in _SEGMENTS:
        count = n // length
        if count < 16:
            break
        rows = w[:count * length].reshape(count, length) * np.hanning(length)
        power = np.abs(np.fft.rfft(rows, axis=1)[:, 1:-1]) ** 2
        power /= power.mean(axis=0)
        # Squares of exponentials have mean 2 and variance 20.
        value = (float((power * power).mean()) - 2.0) * math.sqrt(power.size / 20.0)
        yield f'bursts within {length / given.rate:.2g} s', value
    if n > 4 * _TRIPLES:
        # Hinich, J. Nonparametr. Stat. 6 (1996) 205.
        c = (w - w.mean()) / float(w.std())
        total, count = 0.0, 0
        for j in range(1, _TRIPLES):
            pair = c[j:] * c[:-j]
            for k in range(j + 1, _TRIPLES + 1):
                third = float(pair[k - j:] @ c[:n - k])
                total += third * third / (n - k)
                count += 1
        yield 'products of three', ((total / count) ** (1.0 / 3.0) - 1.0 + 2.0 / (9.0 * count)
                                    ) * math.sqrt(9.0 * count / 2.0)


def score(a: FloatArray, b: FloatArray) -> float:
    """Return the correlation of two series, as a normal score; 0 for a constant one."""
    a, b = a - a.mean(), b - b.mean()
    norm = math.sqrt(float(a @ a) * float(b @ b))
    return math.sqrt(a.size) * float(a @ b) / norm if norm > 0.0 else 0.0


def throttle_paths(throttle: FloatArray, keep: float) -> Iterator[tuple[str, FloatArray]]:
    """Yield regressors that depend on the history of throttle: growing effect, hysteresis."""
    time = np.linspace(-1.0, 1.0, throttle.size)
    spread = float(throttle.std())
    if not spread > 0.0:
        return
    u = (throttle - throttle.mean()) / spread
    cubic = np.vander(u, 4)
    yield from _residual('growing effect of throttle', u * time, np.column_stack((cubic, time)),
                         keep)
    for low, high in _RELAYS:
        below, above = np.quantile(u, (low, high))
        state = np.where(u > above, 1.0, np.where(u < below, -1.0, 0.0))
        last = np.maximum.accumulate(np.where(state != 0.0, np.arange(u.size), 0))
        yield from _residual(f'loop of throttle {100 * low:g} to {100 * high:g} %', state[last],
                             cubic, keep)


def _residual(name: str, wanted: FloatArray, known: FloatArray, keep: float
              ) -> Iterator[tuple[str, FloatArray]]:
    """Yield the part of a regressor that others do not explain, whitened, if large enough."""
    less = wanted - known @ np.linalg.lstsq(known, wanted, rcond=None)[0]
    if float(less @ less) > _LEAST * float(wanted @ wanted):
        yield name, less - keep * np.concatenate((less[:1], less[:-1]))


def covariates_of(samples: Samples, composite: Composite) -> Covariates:
    """Return the series that the scores of a model are correlated with."""
    gaussian = composite.gaussian
    residual = samples.voltage - gaussian.mean
    keep = float(np.median(gaussian.phi[1:]))
    paths = () if samples.throttle is None else tuple(throttle_paths(samples.throttle, keep))
    return Covariates(
        state=np.concatenate(([0.0], residual[:-1])), throttle=samples.throttle,
        rate=1.0 / float(np.median(samples.step[1:])), keep=keep, paths=paths)


# Number of simulated recordings.
SIZE = 24
# Weight of the theoretical mean 0 and spread 1 in averages with the estimated ones, in recordings.
_PRIOR = 24.0
# Degrees of freedom of a score divided by its spread: if the m draws have weight w, the squared
# spread has variance w^2 2/(m - 1), like a chi square with (m - 1)/w^2 degrees.  Of 8700 plain OU
# recordings (2000 to 6000 samples, five throttles and rates), 0.89 % have a family-wise p below
# 1 %, and 0.14 % below 0.1 %; with the normal distribution, 1.52 and 0.31 % do.
_FREEDOM = (SIZE - 1) * ((SIZE + _PRIOR) / SIZE) ** 2


@dataclass(frozen=True)
class NullBank:
    """Means and standard deviations under the baseline, by statistic."""

    mean: dict[str, float]
    std: dict[str, float]


def criticise(samples: Samples, composite: Composite, bank: NullBank) -> dict[str, float]:
    """Return the statistics of a model, scaled to be N(0, 1) if it is right."""
    values = statistics(composite.z, covariates_of(samples, composite))
    return {name: (value - bank.mean.get(name, 0.0)) / bank.std.get(name, 1.0)
            for name, value in values.items()}


def simulate_bank(samples: Samples, composite: Composite, rng: np.random.Generator) -> NullBank:
    """Simulate the null distributions of the statistics for a model."""
    # A plain OU is fitted again to each simulation.  A model with further terms is needed if the
    # step of the ADC is as large as the noise: then even the errors of the right model are neither
    # normal nor independent.
    model, rows = SupplyModel(composite.terms), []
    given = covariates_of(samples, composite)
    for _ in range(SIZE):
        if len(composite.terms) == 1:
            z, state = refit(lfilter([1.0], [1.0, -given.keep], rng.standard_normal(samples.n)))
        else:
            y = model.simulate(samples.t, rng, samples.throttle)
            drawn = samples.spread(y, samples.cell, rng)
            fit = evaluate(drawn, composite.terms)
            z, state = fit.z, np.concatenate(([0.0], (drawn.voltage - fit.mean)[:-1]))
        rows.append(statistics(z, replace(given, state=state), lines=False))
    # Means are shrunk towards 0, and standard deviations towards 1.
    weight = SIZE / (SIZE + _PRIOR)
    mean, std = {}, {}
    for name in rows[0]:
        v = np.array([row[name] for row in rows if name in row])
        # Do not shrink a mean far from 0.
        strange = abs(float(v.mean())) > 4.0 * float(v.std()) / math.sqrt(v.size) + 1.0
        mean[name] = (1.0 if strange else weight) * float(v.mean())
        std[name] = math.sqrt(weight * float(v.var(ddof=1)) + 1.0 - weight)
    return NullBank(mean, std)


def refit(y: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit the baseline to a series; return its scores and states."""
    before = np.concatenate(([y[0]], y[:-1]))
    a, b = before - before.mean(), y - y.mean()
    phi = float(a @ b) / float(a @ a)
    e = b - phi * a
    return e / e.std(), np.concatenate(([0.0], b[:-1]))


def family_chance(largest: float, count: int) -> float:
    """Return the probability that the largest of `count` scores of a bank reaches `largest`."""
    one = 2.0 * float(stdtr(_FREEDOM, -abs(largest)))
    return -math.expm1(count * math.log1p(-min(one, 1.0 - 1e-16)))


def family_edge(chance: float, count: int) -> float:
    """Return the score that the largest of `count` exceeds with probability `chance`."""
    one = -math.expm1(math.log1p(-chance) / count)
    return -float(stdtrit(_FREEDOM, 0.5 * one))
