"""Laws of the noise: jumps that relax, bad samples, heavy tails, slow changes of sigma."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.hidden_chain import forward
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.term import (
    climb, curvature_se, Effect, LawFit, log_normal, normal_scores, parameter, refine, Role,
    Segment, Stage, Term, View)
from ou_monitor.records import FloatArray
from scipy.linalg import eigh_tridiagonal
from scipy.special import comb, digamma, gammainccinv, gammaincinv, ndtr


_TINY = 1e-280  # Minimum denominator
# Maximum number of events in one segment; limits time and memory.
_MOST = 5_000_000
# Maximum share of samples with an event in a first fit: with more, the noise itself has another
# distribution.
_OFTEN = 0.05


@dataclass(frozen=True)
class Jumps(Term):
    """Add jumps of normally distributed size to the state, at the times of a Poisson process."""

    NAME = 'jumps'
    FAMILY = 'events'
    STAGE = Stage.DRIVE
    ROLE = Role.LAW
    SIGNS = ('kurtosis', 'tails', 'skewness')
    IMITATES = 'clock_jitter', 'glitches', 'heavy_tails', 'regime_switching', 'volatility'
    EVENTS = True
    SEVERAL = True
    MEANING = 'Random jumps of the rail that decay at the rate alpha: load pulses.'
    REMEDY = 'Look for loads that switch at that rate: servos, payload, radio.'
    SEPARATED_BY = 'recordings with one load after another switched off'

    rate: float = parameter('1/s', 'jumps per second', 0.0)
    mean: float = parameter('V', 'mean size')
    std: float = parameter('V', 'standard deviation of the size', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        waits, sizes = rng.spawn(2)
        next_at = math.nan

        def effect(s: Segment) -> None:
            nonlocal next_at
            if self.rate == 0.0:
                return
            if math.isnan(next_at):
                next_at = float(s.at[0]) + waits.standard_exponential() / self.rate
            if self.rate * (s.at[-1] - next_at) > _MOST:
                raise ValueError(f'{self.NAME}.rate of {self.rate:g} 1/s exceeds the limit of '
                                 f'{_MOST} jumps per segment of samples; model them as noise')
            times = []
            while next_at <= s.at[-1]:
                times.append(next_at)
                next_at += waits.standard_exponential() / self.rate
            if not times:
                return
            when = np.array(times)
            # A jump within a step decays until the end of the step.
            k = np.searchsorted(s.at, when)
            size = self.mean + self.std * sizes.standard_normal(when.size)
            np.add.at(s.push, k, size * np.exp(-s.alpha[k] * (s.at[k] - when)))

        return effect

    def holds(self, view: View) -> bool:
        """Return whether jumps are rare."""
        return self.rate <= 2.0 * _OFTEN * view.rate

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a mixture to the scores: most are normal, and some contain a jump."""
        return _if_worth(cls._best_fit(view, _OFTEN), view)

    def refit_law(self, view: View) -> LawFit | None:
        return self._best_fit(view, 1.0)

    @classmethod
    def _best_fit(cls, view: View, most: float) -> LawFit | None:
        """Return the fit; None if the share of samples with a jump is above `most`."""
        # A free mean size must earn its price: of one or two jumps it would explain the size.
        found = [fit for fit in (cls._fit(view, most, True), cls._fit(view, most, False))
                 if fit is not None]
        return max(found, default=None, key=lambda fit: _worth(fit, view))

    @classmethod
    def _fit(cls, view: View, most: float, centred: bool) -> LawFit | None:
        found = _rare_events(view, centred)
        if found is None or found[0] > most:
            return None
        share, mean, spread, jumped, scores, gain = found
        step = 1.0 / view.rate
        push = np.where(jumped > 0.5, spread * spread + mean * mean, 0.0)
        n = view.train.stop * share
        term = cls(share / step, mean, spread)
        se = {'rate': term.rate / math.sqrt(max(n, 1.0)), 'mean': spread / math.sqrt(max(n, 1.0)),
              'std': spread / math.sqrt(2.0 * max(n, 1.0))}
        return LawFit(term, se, scores, gain, 3 if centred else 4, push=push)


def _worth(fit: LawFit, view: View) -> float:
    """Return the gain of a law less the penalty of its parameters, nats."""
    return float(fit.gain.sum()) - 0.5 * fit.free * math.log(view.train.stop)


def _if_worth(fit: LawFit | None, view: View) -> LawFit | None:
    return fit if fit is not None and _worth(fit, view) > 0.0 else None


def _rare_events(view: View, centred: bool
                 ) -> tuple[float, float, float, FloatArray, FloatArray, FloatArray] | None:
    """Return share, mean and std (V) of events, their probabilities, scores and gains."""
    z, var = view.z, view.variance
    found = _mixture(z[view.train], var[view.train], centred)
    if found is None:
        return None
    share, mean, spread, unit = found
    calm, event = _parts(z, var, *found)
    both = np.logaddexp(calm, event)
    s = np.sqrt(var)
    scores = normal_scores((1.0 - share) * ndtr(z / unit) + share * ndtr(
        (z - mean / s) / np.sqrt(unit * unit + spread * spread / var)))
    return share, mean, spread, np.exp(event - both), scores, both - log_normal(z)


def _parts(z: FloatArray, var: FloatArray, share: float, mean: float, spread: float, unit: float
           ) -> tuple[FloatArray, FloatArray]:
    """Return the log densities, weights included, without and with a jump."""
    calm = math.log1p(-share) + log_normal(z, 0.0, unit * unit)
    jump = math.log(share) + log_normal(z, mean / np.sqrt(var),
                                        unit * unit + spread * spread / var)
    return calm, jump


def _mixture(z: FloatArray, var: FloatArray, centred: bool
             ) -> tuple[float, float, float, float] | None:
    """Return share, mean and std (V) of the events, and the scale of the noise, by EM."""
    # centred: the mean is 0.
    s = np.sqrt(var)
    # Start from the largest scores.
    count = max(int((np.abs(z) > 4.0).sum()), 3)
    big = np.argsort(np.abs(z))[-count:]
    share = count / z.size
    mean = 0.0 if centred else float((z * s)[big].mean())
    spread, unit = float((z * s)[big].std() + s.mean()), 1.0
    for _ in range(60):
        calm, jump = _parts(z, var, share, mean, spread, unit)
        weight = np.exp(jump - np.logaddexp(calm, jump))
        total = float(weight.sum())
        if total < 1.0:
            return None
        before = share
        share = min(total / z.size, 0.5)
        # Share of an innovation that is due to the jump, given both variances.
        part = spread * spread / (spread * spread + unit * unit * var)
        size = mean + part * (z * s - mean)
        mean = 0.0 if centred else float((weight * size).sum()) / total
        spread = math.sqrt(max(float((weight * ((size - mean) ** 2
                                                + part * unit * unit * var)).sum()) / total,
                               1e-12 * float(var.mean())))
        unit = math.sqrt(float(((1.0 - weight) * z * z).sum()) / (z.size - total))
        if abs(share - before) < 1e-4 * share:
            break
    return share, mean, spread, unit


@dataclass(frozen=True)
class Glitches(Term):
    """Add a normal error to some samples."""

    NAME = 'glitches'
    FAMILY = 'events'
    STAGE = Stage.SENSOR
    ROLE = Role.LAW
    SIGNS = ('kurtosis', 'tails', 'pairs', 'autocorrelation')
    IMITATES = ('clock_jitter', 'heavy_tails', 'jumps')
    EVENTS = True
    SEVERAL = True
    MEANING = (
        'Outlying single readings, or a few in a row, without relaxation after them: bus errors, '
        'pick-up at the ADC, or real dips of a few samples.')
    REMEDY = (
        'Before you reject them, check with a faster or a second ADC that they are not real dips; '
        'check the cables and the ground of the ADC.')
    SEPARATED_BY = 'two ADCs on one rail: a glitch shows in only one'

    probability: float = parameter('', 'share of samples that are bad', 0.0, 1.0)
    std: float = parameter('V', 'standard deviation of the error', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        turns, sizes = rng.spawn(2)

        def effect(s: Segment) -> None:
            bad = turns.random(s.t.size) < self.probability
            s.voltage[bad] += self.std * sizes.standard_normal(int(bad.sum()))

        return effect

    def holds(self, view: View) -> bool:
        """Return whether bad samples are rare."""
        return self.probability <= 2.0 * _OFTEN

    @classmethod
    def variants(cls) -> Sequence[type[Term]]:
        return (SmallGlitches,)

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        return cls.fit_runs(view)

    @classmethod
    def fit_runs(cls, view: View) -> LawFit | None:
        """Find runs of up to three samples that contradict their neighbours on both sides."""
        # Use errors and variances of a filter without measurement noise, in which a sample affects
        # only its own error and the next.  Take the scale from a median, because bad samples have
        # increased the fitted noise.
        own = view.power * view.variance * (
            view.driven + (1.0 - view.trust) * (1.0 + view.phi ** 2))
        plain = (view.residual - view.phi * view.state) / np.sqrt(own)
        unit = float(np.median(np.abs(plain))) / 0.6745
        scaled = replace(view, z=plain / unit, variance=own * unit * unit)
        floor = float(np.median(scaled.variance))
        share, spread = 1e-3, 6.0 * math.sqrt(floor)
        lengths = np.array([1.0, share, share * share])
        for _ in range(3):
            bad = bad_samples(scaled, share, spread, lengths)
            count = int(bad[view.train].sum())
            if count < 3:
                return None
            error = view.z[bad] * np.sqrt(view.variance[bad])
            spread = math.sqrt(max(float(np.mean(error**2)) - floor, floor))
            found = _lengths(bad[view.train])
            runs = int(found.sum())
            share = runs / view.z[view.train].size
            lengths = (found + 0.1) / (runs + 0.3)
        term = cls(min(count / view.z[view.train].size, 1.0), spread)
        scores, gain, free = _glitch_scores(view, bad, share, spread, lengths)
        se = {'probability': term.probability / math.sqrt(count),
              'std': spread / math.sqrt(2.0 * count)}
        # With this variance of the error, the next fit ignores the bad samples.
        return LawFit(term, se, scores, gain, free,
                      error=np.where(bad, spread * spread, 0.0))


class SmallGlitches(Glitches):
    """The same errors, found by the distribution of all scores, not one by one."""

    @classmethod
    def variants(cls) -> Sequence[type[Term]]:
        return ()

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a mixture to the scores: most are normal, and some contain an error."""
        return _if_worth(cls._best_fit(view, _OFTEN), view)

    def refit_law(self, view: View) -> LawFit | None:
        return self._best_fit(view, 1.0)

    @classmethod
    def _best_fit(cls, view: View, most: float) -> LawFit | None:
        """Return the fit; None if the share of samples with an error is above `most`."""
        found = _rare_events(view, centred=True)
        if found is None or found[0] > most:
            return None
        share, _, spread, bad, scores, gain = found
        count = max(share * view.train.stop, 1.0)
        se = {'probability': share / math.sqrt(count), 'std': spread / math.sqrt(2.0 * count)}
        # With this variance, the next fit has the mean of the gains with and without an error.
        part = bad * spread * spread / (view.variance + spread * spread)
        return LawFit(cls(share, spread), se, scores, gain, 3,
                      error=view.variance * part / (1.0 - part))


def _glitch_scores(view: View, bad: npt.NDArray[np.bool_], share: float, spread: float,
                   lengths: FloatArray) -> tuple[FloatArray, FloatArray, int]:
    """Return normal scores, gains in log density, and the number of parameters."""
    # States: a good sample; the first, second and third sample of a run of similar errors.
    e = view.z * np.sqrt(view.variance)
    keep, rest = _repetition(e, bad, view.train, spread)
    wide = np.sqrt(1.0 + spread * spread / view.variance)
    again = np.sqrt(1.0 + rest * rest / view.variance)
    mean = keep * np.concatenate(([0.0], e[:-1])) / np.sqrt(view.variance)
    calm, hit = log_normal(view.z), log_normal(view.z, 0.0, wide * wide)
    more = log_normal(view.z, mean, again * again)
    # Index of the density for each transition: 0 no error, 1 a new error, 2 a similar error again.
    which = np.array([[0, 1, 0, 0], [0, 0, 2, 0], [0, 0, 0, 2], [0, 0, 0, 0]])
    go = 1.0 - lengths[0], lengths[2] / (lengths[1] + lengths[2])
    transition = np.array([[1.0 - share, share, 0.0, 0.0], [1.0 - go[0], 0.0, go[0], 0.0],
                           [1.0 - go[1], 0.0, 0.0, go[1]], [1.0, 0.0, 0.0, 0.0]])
    density = np.stack((calm, hit, more))
    before, _ = forward(density[which].transpose(2, 0, 1), transition,
                        np.array([1.0, 0.0, 0.0, 0.0]))
    chance = np.stack([before @ (transition * (which == k)).sum(axis=1) for k in range(3)])
    scores = normal_scores(chance[0] * ndtr(view.z) + chance[1] * ndtr(view.z / wide)
                           + chance[2] * ndtr((view.z - mean) / again))
    # The filter leaves out the bad samples, which were chosen in hindsight.  So the prior
    # probability of each choice is subtracted in full: a mixture would subtract too little for a
    # small error.
    place = np.arange(e.size)
    state = place - np.maximum.accumulate(np.where(bad, -1, place))
    change = state[:-1], state[1:]
    path = np.concatenate(([math.log1p(-share)], np.log(transition[change])))
    gain = path + density[np.concatenate(([0], which[change])), place] - calm
    return scores, gain, 2 if keep == 0.0 else 6


def _repetition(e: FloatArray, bad: npt.NDArray[np.bool_], train: slice, spread: float
                ) -> tuple[float, float]:
    """Regress each error on the previous error of its run; return slope and residual std, V."""
    e, bad = e[train], bad[train]
    second = np.flatnonzero(bad[1:] & bad[:-1]) + 1
    if second.size < _PAIRS:
        return 0.0, spread
    keep = float(e[second] @ e[second - 1]) / float(e[second - 1] @ e[second - 1])
    return keep, float(np.std(e[second] - keep * e[second - 1]))


# Minimum number of pairs of adjacent bad samples for a regression of their errors.
_PAIRS = 8


def _lengths(bad: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the number of runs of one sample, of two, and of three or more."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], bad, [False]))))
    widths = np.minimum(edges[1::2] - edges[::2], 3)
    return np.bincount(widths, minlength=4)[1:].astype(np.float64)


def bad_samples(view: View, share: float, spread: float, lengths: FloatArray
                ) -> npt.NDArray[np.bool_]:
    """Return the most likely set of bad samples, in runs of up to three."""
    z, phi, n = view.z, view.phi, view.z.size
    size = 0.5 * math.log1p(spread * spread / float(np.median(view.variance)))
    begins, ends, gains = [], [], []
    for width in (1, 2, 3):
        first = np.arange(1, n - width)
        # Without samples k..k+width-1, a single innovation, from sample k-1 to k+width, replaces
        # the innovations k..k+width.
        run, weight, power = z[first + width].copy(), np.ones(first.size), np.ones(first.size)
        before = run**2
        for j in range(width - 1, -1, -1):
            power = power * phi[first + j + 1]
            run += power * z[first + j]
            weight += power * power
            before += z[first + j] ** 2
        penalty = width * size - math.log(share * lengths[width - 1])
        gain = 0.5 * (before - run * run / weight) - penalty
        good = np.flatnonzero(gain > 0.0)
        begins.append(first[good])
        ends.append(first[good] + width)
        gains.append(gain[good])
    return _best_runs(np.concatenate(begins), np.concatenate(ends), np.concatenate(gains), n)


def outlying(voltage: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which readings, V, contradict an AR(1) fitted to the readings; shape (n,)."""
    bad = np.zeros(voltage.size, dtype=np.bool_)
    # The second round estimates the AR(1) without the outliers of the first.
    for _ in range(2):
        c = voltage - voltage[~bad].mean()
        pairs = ~bad[1:] & ~bad[:-1]
        phi = float((c[1:] * c[:-1])[pairs].sum()) / max(float((c[:-1] ** 2)[pairs].sum()), _TINY)
        e = c - phi * np.concatenate((c[:1], c[:-1]))
        scale = float(np.median(np.abs(e))) / 0.6745
        if not scale > 0.0:
            return bad
        one = np.ones(c.size)
        fit = Glitches.fit_runs(View(
            e / scale, scale * scale * one, phi * one, np.concatenate((c[:1], c[:-1])), c,
            np.cumsum(one), one, None, slice(0, c.size)))
        bad = bad if fit is None or fit.error is None else fit.error > 0.0
    return bad


def _best_runs(begin: npt.NDArray[np.int64], end: npt.NDArray[np.int64], gain: FloatArray, n: int
               ) -> npt.NDArray[np.bool_]:
    """Return the samples of the best set of runs (weighted interval scheduling)."""
    order = np.argsort(end, kind='stable')
    begin, end = begin[order], end[order]
    # For each run, the number of runs that end before it begins (a run uses the innovation at its
    # end, so the next run must begin later).
    clear = np.searchsorted(end, begin, side='left').tolist()
    best, taken = [0.0], []
    for value, k in zip(gain[order].tolist(), clear, strict=True):
        taken.append(best[k] + value > best[-1])
        best.append(max(best[k] + value, best[-1]))
    bad = np.zeros(n, dtype=np.bool_)
    at = len(taken)
    while at > 0:
        if taken[at - 1]:
            bad[begin[at - 1]:end[at - 1]] = True
            at = clear[at - 1]
        else:
            at -= 1
    return bad


@dataclass(frozen=True)
class HeavyTails(Term):
    """Make each step's noise Student-t, with the same variance; dof is for one step length."""

    NAME = 'heavy_tails'
    FAMILY = 'events'
    STAGE = Stage.DRIVE
    ROLE = Role.LAW
    SIGNS = ('kurtosis', 'tails')
    IMITATES = 'clock_jitter', 'glitches', 'jumps', 'regime_switching', 'volatility'
    MEANING = 'The driving noise itself has heavy tails, without distinct events.'
    REMEDY = 'Expect more large excursions than a normal distribution predicts.'
    SEPARATED_BY = 'a recording several times as long, at a higher rate'

    dof: float = parameter('', 'degrees of freedom', 2.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        def effect(s: Segment) -> None:
            s.power *= (self.dof - 2.0) / (2.0 * rng.standard_gamma(0.5 * self.dof, s.t.size))

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit a Student-t, with a free scale, to the part of the scores that the OU drives."""
        share = np.broadcast_to(view.driven, view.z.shape)
        square, shares, count = _cells(view.z[view.train], share[view.train])

        def value(x: FloatArray) -> float:
            return float(count @ _Mixture(square, shares, math.exp(x[0]), math.exp(x[1])).log)

        x, _ = climb(value, [math.log(5.0), 0.0])
        dof, scale = math.exp(x[0]), math.exp(x[1])
        if dof <= 2.01 or dof > 200.0:
            return None
        law = _Mixture(view.z * view.z, share, dof, scale)
        scores = np.copysign(normal_scores(law.beyond()), view.z)
        return LawFit(cls(dof), {'dof': dof * float(curvature_se(value, x)[0])}, scores,
                      law.log - log_normal(view.z), 2,
                      power=law.power() if float(np.median(share)) > _ALONE else None)


class _Mixture:
    """Scores that are the sum of a Student-t part and a normal part."""

    def __init__(self, square: FloatArray, share: FloatArray, dof: float, scale: float) -> None:
        # A Student-t is a normal distribution whose variance has an inverse-gamma distribution;
        # the integral over the variance is a sum over a fine grid of its logarithm.  `log`
        # contains the log densities of the scores.
        if dof <= 2.0:
            self.log: FloatArray = np.full(square.size, -math.inf)
            return
        half = 0.5 * dof
        ends = np.log(gammaincinv(half, _OUTSIDE)), np.log(gammainccinv(half, _OUTSIDE))
        gamma = np.exp(np.linspace(*ends, _POINTS))
        log = half * np.log(gamma) - gamma
        # Use logarithms, because with many degrees of freedom most weights underflow.
        log -= log.max()
        log -= math.log(float(np.exp(log).sum()))
        self._weight = np.exp(log)
        self._factor = (half - 1.0) / gamma
        self._scale, self._square = scale, square
        self._variance = scale * scale * (1.0 + share[:, None] * (self._factor - 1.0))
        log = log - 0.5 * (
            np.log(2.0 * math.pi * self._variance) + square[:, None] / self._variance)
        top = log.max(axis=1)
        self._density = np.exp(log - top[:, None])
        self.log = top + np.log(self._density.sum(axis=1))

    def beyond(self) -> FloatArray:
        """Return the probability of a more extreme score on the same side."""
        return np.asarray(ndtr(-np.sqrt(self._square[:, None] / self._variance)) @ self._weight)

    def power(self) -> FloatArray:
        """Return the inverse of the mean precision of the Student-t, given the score."""
        posterior = self._density / self._density.sum(axis=1, keepdims=True)
        return np.asarray(self._scale ** 2 / (posterior @ (1.0 / self._factor)))


def _cells(z: FloatArray, share: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean square, mean share and number of scores in cells of similar scores."""
    edges = np.unique(np.quantile(share, np.linspace(0.0, 1.0, _SHARES + 1)[1:-1]))
    row = np.searchsorted(edges, share)
    column = np.minimum(np.arcsinh(np.abs(z)) / _WIDTH, _CELLS - 1).astype(np.int64)
    _, cell = np.unique(row * _CELLS + column, return_inverse=True)
    count = np.bincount(cell).astype(np.float64)
    return (np.bincount(cell, z * z) / count, np.bincount(cell, share) / count, count)


# Minimum share of the Student-t part in the variance, for giving each sample a `power`.  If there
# is white noise, powers would hide it from the next fit; without powers the variance is still
# right.
_ALONE = 0.99
# Number of grid points of the variance, and probability on either side of the grid.
_POINTS, _OUTSIDE = 40, 1e-10
# For a fit: number of bins of the share, and number and width of bins of asinh(score).
_SHARES, _CELLS, _WIDTH = 8, 300, 0.03


@dataclass(frozen=True)
class Volatility(Term):
    """Multiply sigma and white noise by exp(a second OU), which is constant within a step."""

    NAME = 'volatility'
    FAMILY = 'intensity'
    STAGE = Stage.DRIVE
    ROLE = Role.LAW
    SLOW_FIT = True
    SIGNS = ('clustering', 'kurtosis')
    IMITATES = ('heavy_tails', 'jumps', 'regime_switching')
    MEANING = 'sigma changes slowly at random, independent of $load.'
    REMEDY = 'Judge the noise by the last seconds, not by the mean of a flight.'
    SEPARATED_BY = 'a recording several times as long that includes the temperature'

    std: float = parameter('', 'standard deviation of ln sigma', 0.0)
    rate: float = parameter('1/s', 'relaxation rate of ln sigma', 0.0, above=True)

    def start(self, rng: np.random.Generator) -> Effect:
        before = 0.0

        def effect(s: Segment) -> None:
            nonlocal before
            phi = np.exp(-self.rate * s.step)
            e = self.std * np.sqrt(-np.expm1(-2.0 * self.rate * s.step))
            log = first_order(phi, e * rng.standard_normal(s.t.size), before)
            before = float(log[-1])
            s.sigma *= np.exp(log)
            s.noise = s.noise * np.exp(log)

        return effect

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit an OU of ln sigma, constant within short segments."""
        return cls._best_fit(view, _start(view), known=False)

    def refit_law(self, view: View) -> LawFit | None:
        return self._best_fit(view, np.array([
            math.log(max(self.std, 1e-3)), math.log(self.rate), _start(view)[2]]), known=True)

    def holds(self, view: View) -> bool:
        """Return whether sigma neither has a trend nor is drawn anew at nearly every sample."""
        return _WANDERS / float(view.at[-1]) < self.rate < _FORGETS * view.rate

    @classmethod
    def _best_fit(cls, view: View, start: FloatArray, known: bool) -> LawFit | None:
        size, squares, sizes = _segments(view)
        span = size / view.rate
        trained = view.train.stop // size

        def values(points: FloatArray) -> FloatArray:
            return _log_likelihood(
                squares[:trained], sizes[:trained], span, np.clip(points, *_RANGE))

        def value(x: FloatArray) -> float:
            return float(values(x[None])[0])

        near = refine(values, start) if known else None
        if near is not None:
            x, _, e = near
        else:
            x, _ = climb(value, start, size=0.25, most=_EVALUATIONS[known])
            e = curvature_se(value, x)
        x = np.clip(x, *_RANGE)
        before, density, levels = _grid(squares, sizes, span, x)
        scores = _scores(view.z, before, levels, size)[:view.z.size]
        gain = np.repeat((density + 0.5 * squares) / sizes, size)[:view.z.size]
        term = cls(math.exp(x[0]), math.exp(x[1]))
        # Log probabilities of the levels, given all samples up to the end of each segment.
        log = np.log(np.maximum(before, 1e-300)) - sizes[:, None] * levels - 0.5 * squares[
            :, None] * np.exp(-2.0 * levels)
        weight = np.exp(log - log.max(axis=1)[:, None])
        # Relative to the median, so that the `ou` gets the median of sigma.
        power = weight.sum(axis=1) / (weight @ np.exp(2.0 * (x[2] - levels)))
        power = np.repeat(power, size)[:view.z.size]
        return LawFit(term, {'std': term.std * float(e[0]), 'rate': term.rate * float(e[1])},
                      scores, gain, 3, power=power, white=power)


def _segments(view: View) -> tuple[int, FloatArray, FloatArray]:
    """Return the samples per segment, and the sum of squares and the actual size of each."""
    n = view.z.size
    size = max(1, n // _SEGMENTS)
    begin = np.arange(0, n, size)
    return size, np.add.reduceat(view.z * view.z, begin), np.diff(
        np.append(begin, n)).astype(np.float64)


def _start(view: View) -> FloatArray:
    """Return std, rate and mean of ln sigma, found by moments, in the coordinates of `_grid`."""
    # The logarithm of the mean of m squares is 2 ln sigma plus an error.  The errors of different
    # segments are independent, so covariances at two lags give the variance and the rate.
    size, squares, sizes = _segments(view)
    log = 0.5 * np.log(np.maximum(squares / sizes, 1e-12))[:max(view.train.stop // size, 2)]
    c = log - log.mean()

    def covariance(lag: int) -> float:
        return float(np.mean(c[lag:] * c[:-lag]))

    near = max(covariance(1), 1e-3)
    # The rate is determined best at a lag at which the covariance has dropped clearly.
    lags = [1 << k for k in range(1, 11) if 1 << k < c.size // 4]
    far = next((lag for lag in lags if covariance(lag) < 0.6 * near), lags[-1] if lags else 0)
    fall = math.log(near / max(covariance(far), 0.05 * near)) if far else 1.0
    rate = max(fall, 0.02) / (max(far - 1, 1) * size / view.rate)
    # For a chi-squared variable, the mean of the logarithm is below the logarithm of the mean.
    below = 0.5 * (float(digamma(0.5 * size)) - math.log(0.5 * size))
    return np.array([0.5 * math.log(near), min(math.log(rate), 4.0), float(log.mean()) - below])


def _scores(z: FloatArray, before: FloatArray, levels: FloatArray, size: int) -> FloatArray:
    """Return normal scores, each also conditioned on the earlier samples of its segment."""
    count = before.shape[0]
    padded = np.zeros(count * size)
    padded[:z.size] = z
    z = padded.reshape(count, size, 1)
    # Levels with a noticeable probability in some segment.
    some = before.max(axis=0) > _NOTICED
    before, levels = before[:, some], levels[some]
    std = np.exp(levels)
    log_density = -levels - 0.5 * (z / std) ** 2
    known = np.cumsum(log_density, axis=1) - log_density
    weight = before[:, None, :] * np.exp(known - known.max(axis=2, keepdims=True))
    chance = (weight * ndtr(z / std)).sum(axis=2) / weight.sum(axis=2)
    return normal_scores(chance.ravel())


_SEGMENTS = 1500  # Number of segments in a recording
# Number of levels of ln sigma; they extend to +-8 standard deviations, because later samples may
# leave the fitted range.
_LEVELS = 65
_EVERY = 4  # Number of segments between normalisations, which prevent underflow
# Minimum number of relaxation times of ln sigma in a recording: with 2, the standard error of the
# logarithm of its variance is sqrt(2/2) = 1.
_WANDERS = 2.0
# Maximum rate of ln sigma, in samples per second: its neighbouring values correlate by one half.
# With less, sigma is drawn anew at each sample, which is another law (heavy tails).
_FORGETS = math.log(2.0)
# Stationary probabilities of the levels.
_STATIONARY: FloatArray = comb(_LEVELS - 1, np.arange(_LEVELS)) / 2.0 ** (_LEVELS - 1)
# Range of ln std, ln rate (1/s) and mean of ln sigma.
_RANGE = np.array([[-4.0, -7.0, -math.inf], [1.0, 5.0, math.inf]])
_EVALUATIONS = 60, 30  # Maximum number of evaluations in a first fit, and in a refit
_NOTICED = 1e-9  # Probability below which a level is ignored


@lru_cache(maxsize=1)
def _modes() -> FloatArray:
    """Return the modes of the levels, in columns, each decaying at a multiple of the rate."""
    # Eigenvectors of Ehrenfest's urn model, symmetrised; eigenvalue j is j - (levels - 1)/2.
    k = np.arange(1.0, _LEVELS)
    return np.asarray(eigh_tridiagonal(np.zeros(_LEVELS), 0.5 * np.sqrt(k * (_LEVELS - k)))[1])


def _kernels(keep: FloatArray) -> FloatArray:
    """Return the transition probabilities between levels, shape (rates, levels, levels)."""
    # The levels are the sum of 64 two-state chains.  So their conditional mean and variance equal
    # the OU's, even if the OU is so slow that its steps are much smaller than the spacing of the
    # levels (Rouwenhorst 1995; Kopecky & Suen, Rev. Econ. Dyn. 13 (2010) 701).
    modes, root = _modes(), np.sqrt(_STATIONARY)
    powers = keep[:, None] ** np.arange(_LEVELS - 1.0, -1.0, -1.0)
    chances = (modes * powers[:, None, :]) @ modes.T * (root / root[:, None])
    np.maximum(chances, 0.0, out=chances)
    chances /= chances.sum(axis=2, keepdims=True)
    return chances


def _log_likelihood(squares: FloatArray, sizes: FloatArray, span: float, points: FloatArray
                    ) -> FloatArray:
    """Return the log density of all segments for each point."""
    # Many points share a rate, or the levels: compute all combinations of rates and levels.
    rates, row = np.unique(points[:, 1], return_inverse=True)
    places, column = np.unique(points[:, ::2], axis=0, return_inverse=True)
    if squares.size % 2 == 0:
        # A last segment without samples changes nothing.
        squares, sizes = np.append(squares, 0.0), np.append(sizes, 0.0)
    weight, top = _weights(squares, sizes, _levels(places[:, :1], places[:, 1:]))
    # The chain is reversible: compute its second half, backwards in time, beside its first half.
    half, kernels = squares.size // 2, _kernels(np.exp(-np.exp(rates) * span))
    both = np.concatenate((weight[:half], weight[:half:-1]), axis=1)
    law = np.tile(_STATIONARY, (rates.size, both.shape[1], 1))
    found = np.zeros((rates.size, 2, places.shape[0]))
    for k, factor in enumerate(both):
        law = (law * factor) @ kernels
        if k % _EVERY == 0:
            scale = law.sum(axis=2, keepdims=True)
            law /= scale
            found += np.log(scale).reshape(found.shape)
    first, last = np.split(law, 2, axis=1)
    middle = (first * last * weight[half] / _STATIONARY).sum(axis=2)
    total: FloatArray = found.sum(axis=1) + np.log(middle) + top.sum(axis=0)
    return total[row, column.ravel()]


def _levels(std: FloatArray | float, mean: FloatArray | float) -> FloatArray:
    """Return the levels of ln sigma, from ln of their standard deviation and their mean."""
    reach = math.sqrt(_LEVELS - 1.0)
    return np.asarray(mean + np.exp(std) * np.linspace(-reach, reach, _LEVELS))


def _weights(squares: FloatArray, sizes: FloatArray, levels: FloatArray
             ) -> tuple[FloatArray, FloatArray]:
    """Return the density of each segment at each level, the largest scaled to 1, and its log."""
    weight = np.multiply.outer(-0.5 * squares, np.exp(-2.0 * levels))
    weight -= np.multiply.outer(sizes, levels)
    top = weight.max(axis=-1)
    weight -= top[..., None]
    return np.exp(weight, out=weight), top


def _grid(squares: FloatArray, sizes: FloatArray, span: float, x: FloatArray
          ) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return prior of levels and log density in each segment, and the levels."""
    levels, (kernel,) = _levels(x[0], x[2]), _kernels(np.exp(-np.exp(x[1:2]) * span))
    weight, top = _weights(squares, sizes, levels)
    before, law = np.empty_like(weight), _STATIONARY
    for k, factor in enumerate(weight):
        before[k] = law
        law = (law * factor) @ kernel
        if k % _EVERY == 0:
            law /= law.sum()
    before /= before.sum(axis=1, keepdims=True)
    return before, np.log(np.einsum('kl,kl->k', before, weight)) + top, levels
