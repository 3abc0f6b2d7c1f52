"""
How the voltage relaxes after a change of load, as in the paper's Fig. 5, with honest intervals.

From the moment throttle stands still, U(t) = U0 + A exp(-t/tau) in the noise of that level: OU
and white noise, whose exact covariance weighs the samples (generalised least squares, through the
one-step innovations).  tau is common to all changes of one kind, U0 and A are each one's own; the
interval of tau is where the profile likelihood drops by less than chi^2 allows.

The noise itself is where the level before left it: the louder of the two levels gives the variance
of its first deviation, which then decays.  Only what goes beyond that is a relaxation.

Whether one exponential is enough is tested with two more, four times as fast and as slow, each
change with amplitudes of its own.  Where it is not, the first third of tau is left out, if that
makes it fit: late motors, or a rail much faster than the instrument, are over by then.

Limits: one exponential; alpha, sigma and noise of the level count as known; motors that follow
their command late bend the first milliseconds; after slow ramps little is left to relax, which
widens the interval and does no harm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.level_result import mean_variance
from ou_monitor.analysis.steps import Step, Window
from ou_monitor.records import determined, Estimate, FloatArray, NAN, Recording
from ou_monitor.text import p_words, Z95
from scipy import stats

_FEWEST = 12
_COARSE, _FINE = 41, 61
# Of the voltage before a change the last so many seconds give its level.
_BEFORE_S, _SETTLED_S = 0.5, 0.1
_HALF_95 = 1.920729410347062
# Probability that a relaxation is detected in noise alone; an amplitude a change, and tau.
_CHANCE = 1e-4
# Probability that one exponential is said not to be enough where it is.
BADLY_FITTED = 1e-3
# Probability that noise alone goes as far as one change of load.
_ALONE = 0.05
# Where it is not, so much of tau is left out at first, and what is left has to fit this well: of
# a rail 16 times faster than the instrument, or motors that follow late, nothing is left by then.
_LATER, _WELL = 1.0 / 3.0, 0.05


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
        s, and 95 % interval; tau is NaN where the interval spans more than a factor of 10 either
        way, an open end is 0 or inf; all NaN when no relaxation is detected.
    misfit : float
        Mean square of the standardised innovations: 1 when one exponential in the level's noise
        describes it.
    misfit_p : float
        Probability that further exponentials take as much out of the residuals where one is all
        there is; NaN when no relaxation is detected.
    likelihood_gain : float
        Twice the gain of log likelihood over no relaxation at all; large without a tau when the
        voltage moves on over the whole time watched.
    left_out : float
        Time after throttle arrived that the fit leaves out, s: one exponential describes only
        what follows.

    """

    kind: str
    releases: tuple[Release, ...]
    tau: float = NAN
    tau_low: float = NAN
    tau_high: float = NAN
    misfit: float = NAN
    likelihood_gain: float = NAN
    misfit_p: float = NAN
    left_out: float = 0.0

    @property
    def clear(self) -> tuple[Release, ...]:
        """Return the changes that stand out of the noise one by one, at 5 %."""
        return tuple(change for change in self.releases if change.beyond_p < _ALONE
                     or abs(change.amplitude) > Z95 * change.amplitude_se)

    @property
    def badly_fitted(self) -> bool:
        """Whether one exponential does not describe what relaxes."""
        return self.misfit_p < BADLY_FITTED

    @property
    def caveat(self) -> str:
        """Return what to say next to tau when one exponential is not enough; else empty."""
        if not self.badly_fitted:
            return (f'The fit leaves out the first {1e3 * self.left_out:.2g} ms after the change '
                    'of throttle, which one exponential does not describe; a second exponential '
                    'nearly as slow would still bias tau.' if self.left_out > 0.0 else '')
        return (f'One exponential does not describe it ({p_words(self.misfit_p)}; mean square of '
                f'the residuals {self.misfit:.2f} of what the noise has): do not rely on tau, on '
                'its interval, or on what follows from them.')

    @property
    def log_se(self) -> float:
        """Return the standard error of ln(tau), where tau is known."""
        return math.log(self.tau_high / self.tau_low) / (2.0 * Z95)

    def decay(self, change: Release, since: FloatArray) -> FloatArray:
        """Return the fitted voltage less the level it settles at, V, some s after a change."""
        return change.amplitude * np.exp(-since / self.tau)

    @property
    def detected(self) -> bool:
        """Whether a relaxation is detected, and its tau known."""
        return math.isfinite(self.tau)

    @property
    def bounded(self) -> bool:
        """Whether only an upper bound of tau is known."""
        return not self.detected and self.tau_high < math.inf

    @property
    def moves_on(self) -> bool:
        """Whether the voltage moves, and does not level off while watched."""
        return not (self.detected or self.bounded) and (
            self.likelihood_gain > _limit(len(self.releases)))


def fit_relaxation(recording: Recording, kind: str, steps: Sequence[Step],
                   throttles: Sequence[float], estimates: Sequence[Estimate],
                   rms: Sequence[float]) -> Relaxation:
    """Fit one tau to several changes of load (throttles 0..1, rms in V)."""
    used, windows = _watched(recording, steps, estimates, rms, 0.0)
    if not windows:
        return Relaxation(kind, ())
    fit, left_out = _profile(windows), 0.0
    misfit_p = _misfit_p(windows, fit[0], fit[3])
    if misfit_p < BADLY_FITTED:
        rest, once, p = _later(recording, steps, estimates, rms, _LATER * fit[0])
        _, twice, _ = _later(recording, steps, estimates, rms, 2.0 * _LATER * fit[0])
        # Where more of it moves tau again, it is not the beginning alone that does not fit.
        if p > _WELL and len(rest) == len(used) and once[1] < twice[0] < once[2]:
            left_out, windows, fit, misfit_p = _LATER * fit[0], rest, once, p
    tau, low, high, scale, drop = fit
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
    return Relaxation(kind, tuple(releases), tau if determined(tau, low, high) else NAN, low, high,
                      scale, drop, misfit_p, left_out)


def _watched(recording: Recording, steps: Sequence[Step], estimates: Sequence[Estimate],
             rms: Sequence[float], later: float) -> tuple[list[Step], list[Window]]:
    """Return the changes with enough to watch from `later` s after throttle arrived."""
    used, windows = [], []
    for step in steps:
        begin = int(np.searchsorted(recording.t, recording.t[step.enter] + later))
        if step.stop - begin >= _FEWEST and rms[step.after] > 0.0:
            window = Window(recording, step, estimates[step.after], rms[step.after],
                            _variance(estimates[step.before], rms[step.before]), later)
            if window.n >= _FEWEST:
                used.append(step)
                windows.append(window)
    return used, windows


def _later(recording: Recording, steps: Sequence[Step], estimates: Sequence[Estimate],
           rms: Sequence[float], later: float
           ) -> tuple[list[Window], tuple[float, float, float, float, float], float]:
    """Return windows that begin later, what `_profile` finds in them, and how well it fits."""
    _, windows = _watched(recording, steps, estimates, rms, later)
    if not windows:
        return [], (NAN, NAN, NAN, NAN, NAN), NAN
    fit = _profile(windows)
    return windows, fit, _misfit_p(windows, fit[0], fit[3])


def _limit(changes: int) -> float:
    """Return the gain of likelihood that says something moves: chi^2 at `_CHANCE`."""
    return float(stats.chi2.isf(_CHANCE, changes + 1))


def _variance(estimate: Estimate, rms: float) -> float:
    """Return the variance of the OU at a level, V^2; all of its variance where none is fitted."""
    return estimate.var_inf if estimate.usable else rms * rms if rms > 0.0 else 0.0


def _profile(windows: Sequence[Window]) -> tuple[float, float, float, float, float]:
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


def _misfit_p(windows: Sequence[Window], tau: float, scale: float) -> float:
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
