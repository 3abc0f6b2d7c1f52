"""
How the voltage relaxes after a change of load, as in the paper's Fig. 5, with honest intervals.

From the moment throttle stands still, U(t) = U0 + A exp(-t/tau) in the noise of that level: OU
and white noise, whose exact covariance weighs the samples (generalised least squares, through the
one-step innovations).  tau is common to all changes of one kind, U0 and A are each one's own; the
interval of tau is where the profile likelihood drops by less than chi^2 allows.

The noise itself is where the level before left it: the louder of the two levels gives the variance
of its first deviation, which then decays.  Only what goes beyond that is a relaxation.

Whether one exponential is enough is tested with two more, four times as fast and as slow, each
change with amplitudes of its own.

Limits: one exponential; alpha, sigma and noise of the level count as known; motors that follow
their command late bend the first milliseconds; after slow ramps little is left to relax, which
widens the interval and does no harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.innovations import Filter, StateSpace
from ou_monitor.offline.analysis.level_sag import mean_variance
from ou_monitor.offline.analysis.steps import Step
from ou_monitor.records import Estimate, FloatArray, NAN, Recording
from scipy import stats

# What is watched after a change: so many relaxation times of the noise, and seconds, at least.
_WATCHED, _WATCHED_S = 20.0, 0.5
_FEWEST, _MOST = 12, 2000
_COARSE, _FINE = 41, 61
# Of the voltage before a change the last so many seconds give its level.
_BEFORE_S, _SETTLED_S = 0.5, 0.1
_HALF_95 = 1.920729410347062
_Z = 1.959963984540054
# Probability that noise alone is seen to relax; an amplitude for each change, and tau.
_CHANCE = 1e-4
# Probability that one exponential is said not to be enough where it is, and the time constants of
# those that are tried beside it, in tau.
BADLY_FITTED, _BESIDE = 1e-3, (0.25, 4.0)


@dataclass(frozen=True)
class Release:
    """
    One change of load.

    Attributes
    ----------
    t : float
        When throttle had arrived, s, by the recording's clock.
    throttle_before, throttle_after : float
        Levels, 0..1.
    level_before, level_before_se : float
        Mean voltage at the end of the stay before and its standard error, V; NaN when the stay
        was too short.
    level, level_se : float
        Voltage U0 that it settles at, V.
    amplitude, amplitude_se : float
        A: how far from U0 it is when throttle has arrived, V; negative after a release.
    beyond : float
        How far it goes beyond U0 to the other side, V: overshoot after a release, undershoot
        after a load.
    beyond_p : float
        Probability that noise goes as far (a bound, over all changes of the kind).
    duration : float
        Time watched, s.
    n : int
        Samples used.

    """

    t: float
    throttle_before: float
    throttle_after: float
    level_before: float
    level_before_se: float
    level: float
    level_se: float
    amplitude: float
    amplitude_se: float
    beyond: float
    beyond_p: float
    duration: float
    n: int


@dataclass(frozen=True)
class Relaxation:
    """
    All changes of one kind, fitted with one tau.

    Attributes
    ----------
    kind : str
        ``release`` (throttle falls) or ``load`` (it rises).
    releases : tuple of Release
        Those fitted.
    tau, tau_low, tau_high : float
        s, and 95 % interval; an end that the data leave open is 0 or inf; all NaN when nothing
        is seen to relax.
    misfit : float
        Mean square of the standardised innovations: 1 when one exponential in the level's noise
        describes it.
    misfit_p : float
        Probability that further exponentials take as much out of the residuals where one is all
        there is; NaN when nothing is seen to relax.
    likelihood_gain : float
        Twice the gain of log likelihood over no relaxation at all; large without a tau when the
        voltage moves on over the whole time watched.

    """

    kind: str
    releases: tuple[Release, ...]
    tau: float = NAN
    tau_low: float = NAN
    tau_high: float = NAN
    misfit: float = NAN
    likelihood_gain: float = NAN
    misfit_p: float = NAN

    @property
    def badly_fitted(self) -> bool:
        """Whether one exponential does not describe what relaxes."""
        return self.misfit_p < BADLY_FITTED

    @property
    def caveat(self) -> str:
        """Return what to say next to tau when one exponential is not enough; else empty."""
        if not self.badly_fitted:
            return ''
        p = '< 1e-6' if self.misfit_p < 1e-6 else f'= {self.misfit_p:.1g}'
        return (f'One exponential does not describe it (p {p}; mean square of the residuals '
                f'{self.misfit:.2f} of what the noise has): neither tau nor its interval is to be '
                'trusted, nor what rests on them.')

    @property
    def log_se(self) -> float:
        """Return the standard error of ln(tau); NaN when an end of the interval is open."""
        if not (self.tau_low > 0.0 and math.isfinite(self.tau_high)):
            return NAN
        return math.log(self.tau_high / self.tau_low) / (2.0 * _Z)

    @property
    def seen(self) -> bool:
        """Whether anything is seen to relax."""
        return math.isfinite(self.tau)

    @property
    def moves_on(self) -> bool:
        """Whether the voltage moves, and does not level off while watched."""
        return not self.seen and self.likelihood_gain > _limit(len(self.releases))


class _Window:
    """The samples after one change, made independent."""

    def __init__(self, recording: Recording, step: Step, estimate: Estimate, rms: float,
                 before: float) -> None:
        t = recording.t
        alpha = estimate.alpha if estimate.usable else math.inf
        reach = max(_WATCHED / alpha, _WATCHED_S) if math.isfinite(alpha) else 2.0 * _WATCHED_S
        stop = min(step.stop, int(np.searchsorted(t, t[step.enter] + reach)))
        stride = max(1, -(-(stop - step.enter) // _MOST))
        self.since = t[step.enter:stop:stride] - t[step.enter]
        self.voltage = recording.voltage[step.enter:stop:stride]
        self.n = self.since.size
        noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
        if not math.isfinite(alpha):
            self.var_inf, self.noise_var = 0.0, rms * rms
            self.filter = None
            self.sd = np.full(self.n, rms)
        else:
            self.var_inf, self.noise_var = estimate.var_inf, noise * noise
            first = max(self.var_inf, before)
            self.filter = Filter(_ou(self.since, alpha, self.var_inf, self.noise_var, first))
            self.sd = np.sqrt(self.var_inf + self.noise_var
                              + (first - self.var_inf) * np.exp(-2.0 * alpha * self.since))
        e = self.whitened(np.column_stack([self.voltage, np.ones(self.n)]))
        self._one = e[:, 1]
        self._y = e[:, 0] - _project(self._one, e[:, 0])
        self.rss_flat = float(self._y @ self._y)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns as standardised innovations."""
        if self.filter is None:
            return columns / math.sqrt(self.noise_var)
        e = self.filter.innovations(columns)
        return np.asarray(e / np.sqrt(self.filter.variance[:self.n])[:, None])

    def rss(self, taus: FloatArray) -> FloatArray:
        """Return the residual sum of squares for each tau, level and amplitude fitted."""
        basis = self.whitened(np.exp(-self.since[:, None] / taus[None, :]))
        basis -= np.outer(self._one, self._one @ basis) / float(self._one @ self._one)
        size = np.maximum((basis ** 2).sum(axis=0), 1e-300)
        found: FloatArray = self.rss_flat - (self._y @ basis) ** 2 / size
        return found

    def more(self, tau: float) -> tuple[float, int]:
        """Return by how much exponentials beside tau lower the sum of squares, and how many."""
        times = tau * np.array((1.0, *_BESIDE))
        basis = self.whitened(np.exp(-self.since[:, None] / times[None, :]))
        basis -= np.outer(self._one, self._one @ basis) / float(self._one @ self._one)
        basis /= np.maximum(np.sqrt((basis ** 2).sum(axis=0)), 1e-300)
        found, _, rank, _ = np.linalg.lstsq(basis, self._y, rcond=1e-6)
        rest = self._y - basis @ found
        alone = self._y - basis[:, 0] * float(basis[:, 0] @ self._y)
        return max(0.0, float(alone @ alone - rest @ rest)), int(rank) - 1

    def solve(self, tau: float, scale: float) -> tuple[float, float, float, float]:
        """Return U0 and A with their standard errors; of U0 alone without a tau to be seen."""
        x = self.whitened(np.column_stack([self.voltage, np.ones(self.n)]))
        if not tau < self.since[-1]:
            size = float(x[:, 1] @ x[:, 1])
            return float(x[:, 1] @ x[:, 0]) / size, math.sqrt(scale / size), NAN, NAN
        decay = np.exp(-self.since / tau)
        x = np.column_stack([x, self.whitened(decay[:, None])])
        found = np.linalg.lstsq(x[:, 1:], x[:, 0], rcond=None)[0]
        bend = self.whitened((found[1] * decay * self.since / tau)[:, None])
        jacobian = np.column_stack([x[:, 1:], bend])
        errors = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian) * scale))
        return float(found[0]), float(errors[0]), float(found[1]), float(errors[1])


def fit_relaxation(recording: Recording, kind: str, steps: Sequence[Step],
                   throttles: Sequence[float], estimates: Sequence[Estimate],
                   rms: Sequence[float]) -> Relaxation:
    """
    Fit one tau to several changes of load.

    Parameters
    ----------
    recording : Recording
        What to read from.
    kind : str
        ``release`` or ``load``.
    steps : sequence of Step
        The changes.
    throttles : sequence of float
        Of the levels, 0..1.
    estimates : sequence of Estimate
        Of the levels; where one is not usable its noise counts as white.
    rms : sequence of float
        Of the deviation at each level, V.

    Returns
    -------
    Relaxation
        NaN for tau when nothing is seen to relax.

    """
    used, windows = [], []
    for step in steps:
        if step.stop - step.enter >= _FEWEST and rms[step.after] > 0.0:
            window = _Window(recording, step, estimates[step.after], rms[step.after],
                             _variance(estimates[step.before], rms[step.before]))
            if window.n >= _FEWEST:
                used.append(step)
                windows.append(window)
    if not windows:
        return Relaxation(kind, ())
    tau, low, high, scale, drop = _profile(windows)
    releases = []
    for step, window in zip(used, windows):
        level, level_se, amplitude, amplitude_se = window.solve(tau, scale)
        before, before_se = _level_before(recording, step, estimates[step.before],
                                          rms[step.before])
        side = 1.0 if kind == 'release' else -1.0
        off = side * (window.voltage - level)
        beyond = max(0.0, float(off.max()))
        furthest = max(0.0, float((off / np.hypot(window.sd, level_se)).max()))
        bound = min(1.0, len(windows) * window.n * float(stats.norm.sf(furthest)))
        releases.append(Release(
            float(recording.t[step.enter]), throttles[step.before], throttles[step.after],
            before, before_se, level, level_se, amplitude, amplitude_se, beyond, bound,
            float(window.since[-1]), window.n))
    return Relaxation(kind, tuple(releases), tau, low, high, scale, drop,
                      _misfit_p(windows, tau, scale))


def _limit(changes: int) -> float:
    """Return the gain of likelihood that says something moves: chi^2 at `_CHANCE`."""
    return float(stats.chi2.isf(_CHANCE, changes + 1))


def _variance(estimate: Estimate, rms: float) -> float:
    """Return the variance of the OU at a level, V^2; all of its variance where none is fitted."""
    return estimate.var_inf if estimate.usable else rms * rms if rms > 0.0 else 0.0


def _ou(since: FloatArray, alpha: float, var_inf: float, noise_var: float, first: float
        ) -> StateSpace:
    """Return the level's noise as a state-space model, with the variance it comes with."""
    dt = np.diff(since)
    f = np.concatenate(([0.0], np.exp(-alpha * dt)))[:, None, None]
    q = np.concatenate(([first], -var_inf * np.expm1(-2.0 * alpha * dt)))[:, None, None]
    r = np.full(since.size, max(noise_var, 1e-6 * float(q.min())))
    return StateSpace(f, q, np.ones(1), r)


def _project(direction: FloatArray, y: FloatArray) -> FloatArray:
    return np.asarray(direction * float(direction @ y) / float(direction @ direction))


def _profile(windows: Sequence[_Window]) -> tuple[float, float, float, float, float]:
    """Return tau, its interval, the scale of the residuals, and twice the gain of likelihood."""
    shortest = min(float(np.median(np.diff(w.since))) for w in windows)
    longest = max(float(w.since[-1]) for w in windows)
    grid = np.geomspace(0.3 * shortest, 3.0 * longest, _COARSE)
    total = sum(w.rss(grid) for w in windows)
    freedom = max(1, sum(w.n - 2 for w in windows) - 1)
    scale = float(np.min(total)) / freedom
    flat = sum(w.rss_flat for w in windows)
    drop = float((flat - np.min(total)) / scale) if scale > 0.0 else NAN
    if not drop > _limit(len(windows)):
        return NAN, NAN, NAN, scale, drop
    # Where the drop is small, so that the fine grid holds minimum and interval.
    near = np.flatnonzero((total - np.min(total)) / scale < 16.0)
    a, b = max(0, near[0] - 1), min(grid.size - 1, near[-1] + 1)
    fine = np.geomspace(grid[a], grid[b], _FINE)
    for _ in range(2):
        total = np.asarray(sum(w.rss(fine) for w in windows))
        k = int(np.argmin(total))
        scale = float(total[k]) / freedom
        fall = 0.5 * (total - total[k]) / scale
        inside = np.flatnonzero(fall < 2.0 * _HALF_95)
        left, right = max(0, inside[0] - 1), min(fine.size - 1, inside[-1] + 1)
        if right - left > _FINE // 2:
            break
        fine = np.geomspace(fine[left], fine[right], _FINE)
    logs = np.log(fine)
    tau = math.exp(_vertex(logs, fall, k))
    low, high = _crossing(logs[:k + 1][::-1], fall[:k + 1][::-1]), _crossing(logs[k:], fall[k:])
    if tau > longest:
        return NAN, NAN, NAN, scale, drop
    return (tau, math.exp(low) if math.isfinite(low) else 0.0,
            math.exp(high) if math.isfinite(high) else math.inf, scale, drop)


def _misfit_p(windows: Sequence[_Window], tau: float, scale: float) -> float:
    """Return the probability that exponentials beside tau gain as much by chance; F test."""
    if not math.isfinite(tau):
        return NAN
    gains = [window.more(tau) for window in windows]
    gain, count = sum(one for one, _ in gains), sum(rank for _, rank in gains)
    freedom = sum(window.n - 2 for window in windows) - 1
    left = scale * freedom - gain
    if not (count > 0 and freedom > count and left > 0.0):
        return NAN
    return float(stats.f.sf(gain / count * (freedom - count) / left, count, freedom - count))


def _vertex(x: FloatArray, y: FloatArray, k: int) -> float:
    """Return the minimum of the parabola through three even points; the point at an end."""
    if not 0 < k < x.size - 1:
        return float(x[k])
    left, here, right = y[k - 1:k + 2]
    bend = left - 2.0 * here + right
    return float(x[k] + (0.5 * (left - right) / bend * (x[k + 1] - x[k]) if bend > 0.0 else 0.0))


def _crossing(x: FloatArray, fall: FloatArray) -> float:
    """Return where the fall first reaches that of 95 %; NaN when it does not."""
    beyond = np.flatnonzero(fall > _HALF_95)
    if not beyond.size:
        return NAN
    k = int(beyond[0])
    share = (_HALF_95 - fall[k - 1]) / (fall[k] - fall[k - 1])
    return float(x[k - 1] + share * (x[k] - x[k - 1]))


def _level_before(recording: Recording, step: Step, estimate: Estimate, rms: float
                  ) -> tuple[float, float]:
    """Return the mean voltage at the end of the stay before, and its standard error."""
    t = recording.t
    last = float(t[step.leave - 1])
    first = max(last - _BEFORE_S, float(t[step.begin]) + _SETTLED_S)
    begin = int(np.searchsorted(t, first))
    n = step.leave - begin
    if n < _FEWEST // 2:
        return NAN, NAN
    mean = float(recording.voltage[begin:step.leave].mean())
    return mean, math.sqrt(mean_variance(last - first, n, estimate, rms))
