"""
Relaxation of the voltage after a change of load, as in Fig. 5 of the paper, with intervals.

Once throttle is constant, U(t) = U0 + A exp(-t/tau) in the noise of that level: OU and white
noise, whose exact covariance weights the samples (generalised least squares, through the one-step
innovations).  tau is common to all changes of one kind; U0 and A differ for each.  The interval of
tau comes from the profile likelihood.

At the change, the noise still has the variance of the level before; if that is the larger one, the
excess decays.  Only a deviation beyond this is a relaxation.

An F test with two further exponentials, four times as fast and as slow, tests whether one is
enough.  If it is not, the first third of tau is left out, provided that the rest then fits:
delayed motors, or a rail much faster than the instrument, have settled by then.

The relaxation may be that of the rail or of the instrument.  An AC-coupled input is a high-pass:
any step decays to the level before, at a rate that its corner sets and that the noise shows too.
So a voltage that returns to the level before tells nothing about the rail, but one that settles at
another level excludes the high-pass.

Limits: throttle is a command that motors follow after 5 to 20 ms, which distorts the first
milliseconds.  One exponential; alpha, sigma and noise of the level are taken as known.  Slow ramps
leave little relaxation and so a wide interval.  A regulator that compensates a change of load
looks like a high-pass.  The level before is known only if it was held for several time constants.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.level_comparison import AlphaTest, LEVEL
from ou_monitor.analysis.level_result import mean_variance
from ou_monitor.analysis.levels import HALF_WIDTH, half_width, level_segments
from ou_monitor.criticism.innovations import ou_filter
from ou_monitor.records import determined, Estimate, FloatArray, log_interval, NAN, Recording
from ou_monitor.text import number, p_words, volts, Z95
from scipy import stats


# Maximum duration of a change of level, s; a slower one leaves nothing to relax.
LONGEST_RAMP = 1.0
# Minimum time at a level, s; in less, throttle only passes through it.
SHORTEST_STAY = 0.1
# Tolerance of throttle after a change, as a share of the change.
_STILL = 0.1
# Minimum time fitted after a change, in relaxation times of the noise and in s; maximum samples.
_WATCHED, _WATCHED_S = 20.0, 0.5
_MOST = 2000
# Time constants of further exponentials in the test of one, in tau.
_BESIDE = (0.25, 4.0)


@dataclass(frozen=True)
class LevelChange:
    """A change of load level."""

    # Numbers of the levels.
    before: int
    after: int
    leave: int  # Index of the first sample that is no longer at the level before
    enter: int  # Index of the sample from which throttle is constant at the level after
    # First sample at the level before; end of the samples with constant throttle after.
    begin: int
    stop: int


def find_steps(recording: Recording, throttles: Sequence[float]) -> tuple[LevelChange, ...]:
    """Find the changes between load levels (throttles 0..1)."""
    t, throttle = recording.t, recording.throttle
    if not np.isfinite(throttles).all():
        return ()
    width = half_width(t, throttle)
    runs = [(run.start, run.stop, k) for run, k in level_segments(throttle, throttles, width)
            if t[run.stop - 1] - t[run.start] >= SHORTEST_STAY]
    found = []
    for (begin, leave, before), (start, stop, after) in zip(runs, runs[1:]):
        change = abs(throttles[after] - throttles[before])
        if before == after or change < 2.0 * HALF_WIDTH or start < leave:
            continue
        if t[start] - t[leave - 1] > LONGEST_RAMP:
            continue
        stay = throttle[start:stop]
        # A jittering stick has a wider tolerance.
        wide = width if width > HALF_WIDTH else 0.0
        still = np.abs(stay - np.median(stay)) <= max(_STILL * change, wide)
        enter = start + int(still.argmax())
        moved = np.flatnonzero(~still[enter - start:])
        end = enter + int(moved[0]) if moved.size else stop
        if t[end - 1] - t[enter] >= SHORTEST_STAY:
            found.append(LevelChange(before, after, leave, enter, begin, end))
    return tuple(found)


class Window:
    """The samples after one change, whitened."""

    def __init__(self, recording: Recording, step: LevelChange, estimate: Estimate, rms: float,
                 before: float, later: float = 0.0) -> None:
        """Take the samples (rms in V, before in V^2, later in s)."""
        t = recording.t
        alpha = estimate.alpha if estimate.usable else math.inf
        reach = max(_WATCHED / alpha, _WATCHED_S) if math.isfinite(alpha) else 2.0 * _WATCHED_S
        stop = min(step.stop, int(np.searchsorted(t, t[step.enter] + later + reach)))
        start = min(stop, int(np.searchsorted(t, t[step.enter] + later)))
        stride = max(1, -(-(stop - start) // _MOST))
        self.since = t[start:stop:stride] - t[step.enter]
        self.voltage = recording.voltage[start:stop:stride]
        self.n = self.since.size
        noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
        if not math.isfinite(alpha):
            self.var_inf, self.noise_var = 0.0, rms * rms
            self.filter = None
            self.sd = np.full(self.n, rms)
        else:
            self.var_inf, self.noise_var = estimate.var_inf, noise * noise
            louder = np.exp(-2.0 * alpha * self.since) * max(0.0, before - self.var_inf)
            first = self.var_inf + float(louder[0])
            self.filter = ou_filter(self.since, alpha, self.var_inf, self.noise_var, first)
            self.sd = np.sqrt(self.var_inf + self.noise_var + louder)
        e = self.whitened(np.column_stack([self.voltage, np.ones(self.n)]))
        self._one = e[:, 1]
        y = e[:, 0]
        self._y: FloatArray = y - self._one * float(self._one @ y) / float(self._one @ self._one)
        self.rss_flat = float(self._y @ self._y)

    def whitened(self, columns: FloatArray) -> FloatArray:
        """Return columns as standardised innovations."""
        if self.filter is None:
            return columns / math.sqrt(self.noise_var)
        e = self.filter.innovations(columns)
        return np.asarray(e / np.sqrt(self.filter.variance)[:, None])

    def rss(self, taus: FloatArray) -> FloatArray:
        """Return the residual sum of squares for each tau, level and amplitude fitted."""
        basis = self._decays(taus)
        size = np.maximum((basis ** 2).sum(axis=0), 1e-300)
        found: FloatArray = self.rss_flat - (self._y @ basis) ** 2 / size
        return found

    def _decays(self, taus: FloatArray) -> FloatArray:
        """Return exponentials, whitened, without the level; shape (n, taus)."""
        basis = self.whitened(np.exp(-self.since[:, None] / taus[None, :]))
        basis -= np.outer(self._one, self._one @ basis) / float(self._one @ self._one)
        return basis

    def more(self, tau: float) -> tuple[float, int]:
        """Return the reduction of the sum of squares by further exponentials, and their number."""
        basis = self._decays(tau * np.array((1.0, *_BESIDE)))
        basis /= np.maximum(np.sqrt((basis ** 2).sum(axis=0)), 1e-300)
        found, _, rank, _ = np.linalg.lstsq(basis, self._y, rcond=1e-6)
        rest = self._y - basis @ found
        alone = self._y - basis[:, 0] * float(basis[:, 0] @ self._y)
        return max(0.0, float(alone @ alone - rest @ rest)), int(rank) - 1

    def solve(self, tau: float, scale: float) -> tuple[float, float, float, float]:
        """Return U0 and A with their standard errors; without a tau, A is not fitted."""
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


# Minimum samples of a change, and points of the grids of tau.
_FEWEST = 12
_COARSE, _FINE = 41, 61
# Maximum time before a change that gives the level before, and settling time left out there, s.
_BEFORE_S, _SETTLED_S = 0.5, 0.1
# Half the 95 % quantile of chi^2 with one degree of freedom.
_HALF_95 = 1.920729410347062
# Probability of detecting a relaxation in noise alone.
_CHANCE = 1e-4
# Level of the test of one exponential.
BADLY_FITTED = 1e-3
# Level at which a single change stands out of the noise.
_ALONE = 0.05
# If one exponential is not enough: start of the fit, in tau, and minimum p-value of the rest.  A
# rail 16 times faster than the instrument, or delayed motors, have settled by then.
_LATER, _WELL = 1.0 / 3.0, 0.05


@dataclass(frozen=True)
class Release:
    """One change of load."""

    t: float  # Time when throttle was constant again, s, clock of the recording
    # Levels, 0..1.
    throttle_before: float
    throttle_after: float
    # Mean voltage at the end of the level before and its standard error, V; NaN if it was too
    # short.
    level_before: float
    level_before_se: float
    # U0, the voltage after settling, V.
    level: float
    level_se: float
    # A, the deviation from U0 when throttle is constant again, V; negative after a release.
    amplitude: float
    amplitude_se: float
    beyond: float  # Overshoot beyond U0 after a release, undershoot after a load, V
    beyond_p: float  # Upper bound of its p-value, over all changes of the kind
    duration: float  # Time fitted, s
    n: int  # Samples used


@dataclass(frozen=True)
class Relaxation:
    """All changes of one kind, fitted with one tau."""

    kind: str  # ``release`` (throttle falls) or ``load`` (it rises)
    releases: tuple[Release, ...]  # Those fitted
    # s, with its 95 % interval.  tau is NaN if an end is more than a factor of 10 away; an open
    # end is 0 or inf; all are NaN if no relaxation is detected.
    tau: float = NAN
    tau_low: float = NAN
    tau_high: float = NAN
    misfit: float = NAN  # Mean square of the standardised innovations; 1 if the model is right
    # Twice the gain of log likelihood over no relaxation; also large, without a tau, if the
    # voltage moves during the whole time.
    likelihood_gain: float = NAN
    misfit_p: float = NAN  # p-value of further exponentials; NaN if no relaxation is detected
    left_out: float = 0.0  # Time after the change that the fit leaves out, s

    @property
    def clear(self) -> tuple[Release, ...]:
        """Return the changes that stand out of the noise one by one, at 5 %."""
        return tuple(change for change in self.releases if change.beyond_p < _ALONE
                     or abs(change.amplitude) > Z95 * change.amplitude_se)

    @property
    def badly_fitted(self) -> bool:
        """Whether one exponential does not describe the relaxation."""
        return self.misfit_p < BADLY_FITTED

    @property
    def caveat(self) -> str:
        """Return a caution about tau if one exponential is not enough; otherwise empty."""
        if not self.badly_fitted:
            return (f'The fit leaves out the first {1e3 * self.left_out:.2g} ms after the change '
                    'of throttle, which one exponential does not describe; a second exponential '
                    'nearly as slow would still bias tau.' if self.left_out > 0.0 else '')
        return (f'One exponential does not describe it ({p_words(self.misfit_p)}; mean square of '
                f'the residuals {self.misfit:.2f} times that of the noise): do not rely on tau or '
                'its interval.')

    @property
    def log_se(self) -> float:
        """Return the standard error of ln(tau), where tau is known."""
        return math.log(self.tau_high / self.tau_low) / (2.0 * Z95)

    def decay(self, change: Release, since: FloatArray) -> FloatArray:
        """Return the fitted deviation from U0, V, at times since a change, s."""
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
        """Whether the voltage moves and does not settle in the time fitted."""
        return not (self.detected or self.bounded) and (
            self.likelihood_gain > _detection_limit(len(self.releases)))


def fit_relaxation(recording: Recording, kind: str, steps: Sequence[LevelChange],
                   throttles: Sequence[float], estimates: Sequence[Estimate],
                   rms: Sequence[float]) -> Relaxation:
    """Fit one tau to several changes of load (throttles 0..1, rms in V)."""
    used, windows = _windows(recording, steps, estimates, rms, 0.0)
    if not windows:
        return Relaxation(kind, ())
    fit, left_out = _profile(windows), 0.0
    misfit_p = _misfit_p(windows, fit[0], fit[3])
    if misfit_p < BADLY_FITTED:
        rest, once, p = _begin_later(recording, steps, estimates, rms, _LATER * fit[0])
        _, twice, _ = _begin_later(recording, steps, estimates, rms, 2.0 * _LATER * fit[0])
        # If tau changes again when more is left out, the misfit is not limited to the beginning.
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


def _windows(recording: Recording, steps: Sequence[LevelChange], estimates: Sequence[Estimate],
             rms: Sequence[float], later: float) -> tuple[list[LevelChange], list[Window]]:
    """Return the changes with enough samples from `later` s after throttle is constant again."""
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


def _begin_later(recording: Recording, steps: Sequence[LevelChange], estimates: Sequence[Estimate],
                 rms: Sequence[float], later: float
                 ) -> tuple[list[Window], tuple[float, float, float, float, float], float]:
    """Return windows that begin later, the result of `_profile`, and the p-value of a misfit."""
    _, windows = _windows(recording, steps, estimates, rms, later)
    if not windows:
        return [], (NAN, NAN, NAN, NAN, NAN), NAN
    fit = _profile(windows)
    return windows, fit, _misfit_p(windows, fit[0], fit[3])


def _detection_limit(changes: int) -> float:
    """Return the gain of likelihood needed to detect a relaxation: chi^2 at `_CHANCE`."""
    return float(stats.chi2.isf(_CHANCE, changes + 1))


def _variance(estimate: Estimate, rms: float) -> float:
    """Return the variance of the OU at a level, V^2; the whole variance without a fit."""
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
    if not drop > _detection_limit(len(windows)):
        return NAN, NAN, NAN, scale, drop
    # The fine grid covers the minimum and the interval.
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
    """Return the p-value of further exponentials; F test."""
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
    """Return where the drop of the likelihood first reaches the 95 % limit; NaN if nowhere."""
    beyond = np.flatnonzero(fall > _HALF_95)
    if not beyond.size:
        return NAN
    k = int(beyond[0])
    share = (_HALF_95 - fall[k - 1]) / (fall[k] - fall[k - 1])
    return float(x[k - 1] + share * (x[k] - x[k - 1]))


def _level_before(recording: Recording, step: LevelChange, estimate: Estimate, rms: float
                  ) -> tuple[float, float]:
    """Return the mean voltage at the end of the level before, and its standard error."""
    t = recording.t
    last = float(t[step.leave - 1])
    first = max(last - _BEFORE_S, float(t[step.begin]) + _SETTLED_S)
    begin = int(np.searchsorted(t, first))
    n = step.leave - begin
    if n < _FEWEST // 2:
        return NAN, NAN
    mean = float(recording.voltage[begin:step.leave].mean())
    return mean, math.sqrt(mean_variance(last - first, n, estimate, rms))


# Change of level, as a share of the transient: above the first a high-pass is excluded, below the
# second the voltage counts as returned.  Minimum significance of both, standard errors.
_ELSEWHERE, _BACK = 0.5, 0.25
_SURE = 4.0
# tau and 1/alpha agree if they differ by less than this factor with 95 % confidence.
_CLOSE = 1.5


@dataclass(frozen=True)
class ReleaseCause:
    """Comparison of tau with the noise, and with an AC-coupled instrument."""

    # ``agrees`` (tau alpha within a factor of 1.5 of 1 with 95 %), ``differs`` or
    # ``undetermined``.
    noise: str
    # tau times the common alpha of the noise, and its 95 % interval, which is NaN if one
    # exponential does not describe the transient.
    ratio: float
    ratio_low: float
    ratio_high: float
    p_value: float  # p-value of a ratio of 1
    instrument: str  # ``excluded``, ``possible`` or ``undetermined``
    corner: float  # Of the high-pass that would explain it, 1/(2 pi tau), Hz
    # Level after minus level before, in the direction of the transient, V: mean of the changes
    # with a significant amplitude; NaN without any.
    step: float
    step_se: float
    sentence: str  # Both verdicts in words


def judge_cause(relaxation: Relaxation, alpha: AlphaTest) -> ReleaseCause:
    """Compare a relaxation with the noise and with an AC-coupled instrument."""
    if not relaxation.detected:
        return ReleaseCause('undetermined', NAN, NAN, NAN, NAN, 'undetermined', NAN, NAN, NAN,
                            _why_none(relaxation))
    noise, ratio, low, high, p = _against_noise(relaxation, alpha)
    instrument, step, step_se = _against_instrument(relaxation)
    corner = 1.0 / (2.0 * math.pi * relaxation.tau)
    of_noise = {
        'agrees': 'tau agrees with 1/alpha of the noise',
        'differs': f'tau differs from 1/alpha of the noise ({p_words(p)})',
        'undetermined': 'the data show neither that tau differs from 1/alpha of the noise nor '
                        'that they agree'}[noise]
    if math.isfinite(low):
        of_noise += f' (tau alpha = {ratio:.2f}, 95 % {low:.2f} to {high:.2f})'
    of_instrument = {
        'excluded': f'the level changes with the load by {volts(step)} and stays, so '
                    'this is not the high-pass of an AC-coupled instrument',
        'possible': 'the voltage returns to the level before although the load has changed: a '
                    f'high-pass of {corner:.2g} Hz (AC coupling) would do the same to the '
                    'transient and to the noise, a regulator only to the transient; this '
                    'recording cannot separate them',
        'undetermined': 'the level before is not known well enough to decide whether a high-pass '
                        f'of the instrument ({corner:.2g} Hz) explains it'}[instrument]
    return ReleaseCause(noise, ratio, low, high, p, instrument, corner, step, step_se,
                        f'{of_noise[0].upper()}{of_noise[1:]}; {of_instrument}.')


def _why_none(relaxation: Relaxation) -> str:
    what = 'falls' if relaxation.kind == 'release' else 'rises'
    if not relaxation.releases:
        return f'Throttle never {what} from one load level to another and stays there.'
    if relaxation.moves_on:
        return (f'After throttle {what}, the voltage keeps moving for the whole time observed '
                'and settles at no level that could be fitted.')
    if relaxation.bounded:
        return (f'After throttle {what}, the voltage settles in tau < '
                f'{number(1e3 * relaxation.tau_high)} ms (95 %); how much less is not determined.')
    return f'No relaxation is detected after throttle {what}.'


def _against_noise(relaxation: Relaxation, alpha: AlphaTest
                   ) -> tuple[str, float, float, float, float]:
    se = math.hypot(relaxation.log_se, alpha.alpha_se)
    if not (math.isfinite(se) and se > 0.0 and alpha.alpha > 0.0):
        return 'undetermined', NAN, NAN, NAN, NAN
    log = math.log(relaxation.tau * alpha.alpha)
    p = 2.0 * float(stats.norm.sf(abs(log) / se))
    reach = abs(log) + Z95 * se
    if relaxation.badly_fitted:
        # The error of tau, and so p-value and interval, are not valid.
        return 'undetermined', math.exp(log), NAN, NAN, NAN
    word = 'differs' if p < LEVEL else 'agrees' if reach < math.log(_CLOSE) else 'undetermined'
    ratio = math.exp(log)
    low, high = log_interval(ratio, se)
    if not determined(ratio, low, high):
        ratio = low = high = NAN
    return word, ratio, low, high, p


def _against_instrument(relaxation: Relaxation) -> tuple[str, float, float]:
    """Return the verdict and the mean lasting change of the level, with its error."""
    steps, errors, sizes = [], [], []
    for change in relaxation.releases:
        if math.isfinite(change.level_before_se) and (
                abs(change.amplitude) > _SURE * change.amplitude_se):
            # The transient starts on the side of the level before.
            steps.append(-math.copysign(1.0, change.amplitude)
                         * (change.level - change.level_before))
            errors.append(math.hypot(change.level_se, change.level_before_se))
            sizes.append(abs(change.amplitude))
    if not steps:
        return 'undetermined', NAN, NAN
    weight = 1.0 / np.square(errors)
    step = float(weight @ steps / weight.sum())
    se, size = float(1.0 / math.sqrt(weight.sum())), float(weight @ sizes / weight.sum())
    if abs(step) > _SURE * se and abs(step) > _ELSEWHERE * size:
        return 'excluded', step, se
    if abs(step) + Z95 * se < _BACK * size:
        return 'possible', step, se
    return 'undetermined', step, se
