"""
Fit an Ornstein-Uhlenbeck process and white noise to a voltage, together with level and load.

1. `known_ou` selects the shortest window that determines alpha well, and removes its spectral
   lines: a tone as large as the OU may double alpha.
2. `regress` removes a flexible level (linear hat functions every 5 s), throttle and measured
   current; both loads enter directly and through several lags with free initial states.
3. `fit_ou` fits the noise jointly with these regressors, by restricted likelihood in the frequency
   domain (`whittle.CrossSpectrum`).  Intervals are quantiles from importance sampling about all
   maxima over alpha; the prior is flat in ln(alpha) and arcsine in the OU's share of variance.

`fit_pieces` fits residuals of an earlier regression, and allows for the power that it absorbed.

The model of the noise is white noise, the OU, and a random walk of the level.  The size of the
noise follows the load and its changes, and readings are weighted by it; otherwise errors of the
load model would be fitted as a fast OU.  The walk, whose size has a prior and may be zero, absorbs
changes of the level that the hats miss and that would be fitted as a slow OU.

Limits: samples are treated as evenly spaced between gaps; a relaxation slower than 2.5 s (a sixth
of a window below 15 s) counts as level; OU and white noise are assumed to change in proportion,
and results are for their mean size.  Repeats or rounding of slow changes, a load that neither
throttle nor current shows, and noise with another spectrum (a filtered sensor) are wrongly fitted
as OU.

Coverage of the 95 % intervals on 1200 simulated rails under a quad's throttle (alpha 2 to 500 1/s,
50 to 1000 Hz, OU of 20 mV, white noise to 30 mV, windows of 20 s, or 8 s above 300 Hz): alpha 93 %
(most intervals that missed it lay above), sigma 93 %, Var_inf 92 %; without white noise 90, 90 and
87 %.  99 % of the bounds were correct.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import CELL, POWER
from ou_monitor.model.sinusoid import tones
from ou_monitor.model.whittle import CrossSpectrum
from ou_monitor.records import determined, FloatArray, MOST_READINGS, OU_WINDOWS, OuFacts

# Minimum evidence for a relaxation over white noise alone, nats.  No window of 120 simulated
# recordings of white noise reached it (test_ou_fit.py repeats a part).
VISIBLE = 12.0
_HATS = 5.0  # Distance of the level's knots, s, at 1 Hz or faster
_PER_KNOT, _PARTS = 5, 3  # Minimum readings per knot, and minimum number of spans between knots
# Lags, s, of throttle and current: from an ESC to polarisation.
_LAGS = (0.004, 0.02, 0.06, 0.3, 1.0, 4.0)
# Maximum shift of throttle and current, samples, and number of readings used to find it.
_DELAYS, _DELAY_READINGS = 4, 8000
# Maximum shift of a current, samples, even if `reach` allows more.
_FAR = 20
# Minimum range of a load that moves, relative to its maximum or 1, whichever is larger.
_MOVED = 0.01
# Minimum gap, in median steps: splitting the data at smaller gaps would cost more accuracy than
# ignoring them.
GAP = 5.0
_STRETCH = 16  # Minimum number of readings between gaps
# Minimum share of the readings that pieces of equal length must contain.
_HELD = 0.8
# The shortest of OU_WINDOWS that determines alpha within this factor is used, else the longest.
# Selecting by the visibility of the relaxation instead would bias alpha, because in a short window
# visibility depends on the error of alpha.
PRECISE = 1.5
FEWEST = 40  # Minimum number of readings beyond the number of regressors
# Maximum number of elements in an array of the likelihood: 16 MB of complex numbers.
_AT_ONCE = 1 << 20
# Number of points of the first grid in ln(alpha dt), logit(share of the OU) and ln(walk); ends of
# the logit.  The upper end is close to a share of 1: at alpha dt = 0.004, even white noise of 1e-3
# of the variance is half as large as the OU in the spectrum at the highest frequency.
_GRID, _LOGIT = (24, 16, 5), (-7.0, 12.0)
# For the bounds: further points in logit(share) about the best of the grid, and successive steps
# in ln(walk) that refine the walk.
_ASIDE = np.linspace(-1.2, 1.2, 17)
_REFINE = (1.2, 0.6, 0.3, 0.15)
# Size of the noise: time constants, s, of the lagged loads whose differences are predictors;
# prior standard deviation of the coefficients; rounds of the fit.
_CHANGES, _SIZE_SD, _SIZE_ROUNDS = (0.03, 0.2, 1.0), 0.5, 12
# Maximum number of steps towards the maximum, and convergence tolerance of a step.
_LOOKS, _NEAR = 40, 0.05
_DRAWS, _ROUNDS = 1000, 4  # Draws in each round, over all maxima, and number of rounds
_FEWEST_DRAWN = 0.05  # Minimum share of the draws for a maximum
# Maximum excess over the lowest cost, nats, at which a minimum at another alpha is refined, and at
# which it is then kept (e^-6 of the likelihood does not affect a 95 % interval).
_REFINED, _RIVAL = 10.0, 6.0
# A window is imprecise above this standard deviation of ln(alpha) (from the curvature at the
# maximum, times 1.2): among 437 simulated windows, the 190 precise ones had at most 0.28.
_IMPRECISE = 0.37
# Usual walk of the level, V per sqrt(s) and cell; prior standard deviation of ln(walk) above the
# usual walk.  Walks of .0015 to .015 fit the recordings.
_WALK, _WALK_SD = 0.004, 0.8
# Maximum alpha dt: beyond it, neighbouring readings are uncorrelated.
_FASTEST = 5.0
# A window is too short if the interval of alpha begins within this factor of the slowest rate.
_EDGE = 1.25
# Loss of profile log-likelihood at the edge of a 95 % region of alpha and share, nats: half of
# chi^2 with 2 degrees of freedom.
_DROP = 3.0
# Largest share of the variance that an OU slower than `tau_below_s` may have.
_QUARTER = 0.25
# Relative size below which a regressor counts as dependent on the others.
_SPANNED = 1e-5
# Minimum periods of a line between knots of the level, which absorbs slower lines.
_PERIODS = 10.0


def usual_walk(v: FloatArray) -> float:
    """Return the usual walk of the level of a voltage, V per sqrt(s)."""
    return _WALK * max(abs(float(v.mean())), 1e-3) / CELL


def stretches(t: FloatArray) -> list[slice]:
    """Return the stretches between gaps; a few lost messages do not count as a gap."""
    steps = np.diff(t)
    gaps = np.flatnonzero(steps > GAP * np.median(steps))
    edges = [0, *(gaps + 1).tolist(), t.size]
    return [slice(a, b) for a, b in zip(edges, edges[1:]) if b - a >= _STRETCH]


def _lagged(x: FloatArray, share: float) -> FloatArray:
    """Return x after a first-order lag that moves `share` of the way to x at each sample."""
    # 1 / (1 - r z) is the product of all 1 + (r z)^(2^k).
    lagged = share * (x - x[0])
    step, rest = 1, 1.0 - share
    while step < x.size and rest > 1e-17:
        lagged[step:] = lagged[step:] + rest * lagged[:-step]
        step, rest = 2 * step, rest * rest
    return np.asarray(x[0] + lagged)


def _fill_gaps(t: FloatArray, x: FloatArray | None) -> FloatArray | None:
    """Return a load with its gaps filled; None if it is unknown or does not move."""
    if x is None:
        return None
    known = np.isfinite(x)
    if known.sum() < 0.5 * x.size:
        return None
    full = np.interp(t, t[known], x[known])
    return full if np.ptp(full) > _MOVED * max(1.0, float(np.abs(full).max())) else None


def _basis(rows: FloatArray) -> FloatArray:
    """Return an orthonormal basis of rows; later rows that depend on earlier ones are dropped."""
    size = np.sqrt(np.mean(rows * rows, axis=1))
    rows = rows[size > 0.0] / size[size > 0.0, None]
    R = np.linalg.qr(rows.T, mode='r')
    kept = np.flatnonzero(np.abs(R.diagonal()) >= _SPANNED * math.sqrt(rows.shape[1]))
    # Faster than computing Q by Householder (a third of the time), and valid for dependent rows.
    return np.asarray(np.linalg.inv(np.linalg.qr(R[:, kept], mode='r')).T @ rows[kept])


def _orthogonal_basis(rows: FloatArray, basis: FloatArray) -> FloatArray:
    """Return an orthonormal basis of rows after projection orthogonal to `basis`."""
    size = np.sqrt(np.mean(rows * rows, axis=1))
    rows = rows[size > 0.0] / size[size > 0.0, None]
    # Twice, because of rounding.
    for _ in range(2):
        rows = rows - (rows @ basis.T) @ basis
    rows = rows[np.sqrt(np.mean(rows * rows, axis=1)) >= _SPANNED]
    return _basis(rows) if rows.size else rows


def _shifted(x: FloatArray, late: int) -> FloatArray:
    """Return `x` as read `late` samples later; the end values are held."""
    if not late:
        return x
    moved = np.roll(x, -late)
    moved[slice(-late, None) if late > 0 else slice(0, -late)] = x[-1 if late > 0 else 0]
    return moved


@dataclass(frozen=True, eq=False)
class Regression:
    """Residual of a voltage after level and load, and the regressors."""

    dt: float  # mean step within the stretches, s
    places: npt.NDArray[np.intp]  # indices of the readings in stretches, shape (n,)
    voltage: FloatArray  # V, residual, shape (n,)
    size: FloatArray  # size of the noise relative to its rms, shape (n,)
    # Regressors divided by the size, orthonormal, shape (p, n); if empty, a mean per stretch.
    basis: FloatArray
    lengths: list[int]  # of the stretches
    walk: float  # usual walk of the level, V per sqrt(s)
    slowest: float  # half the distance of the level's knots, s: slower changes count as level
    absorbed: FloatArray | None = None  # as in `CrossSpectrum`

    @property
    def free(self) -> int:
        """Return the number of readings less the number of regressors."""
        return int(self.voltage.size - (self.basis.shape[0] or len(self.lengths)))


def regress(t: FloatArray, v: FloatArray, u: FloatArray | None, i: FloatArray | None,
            reach: float = 0.0) -> Regression:
    """Remove level and load from a voltage by regression; reach: maximum shift of current, s."""
    parts = stretches(t)
    dt = float(np.median(np.diff(t)))
    if parts:
        dt = sum(t[s.stop - 1] - t[s.start] for s in parts) / max(
            1, sum(s.stop - s.start - 1 for s in parts))
    span = float(t[-1] - t[0])
    apart = max(_HATS, _PER_KNOT * span / t.size)
    knots = np.linspace(t[0], t[-1], max(_PARTS, math.ceil(span / apart)) + 1)
    level = [np.interp(t, knots, row) for row in np.eye(knots.size)]
    taus = [tau for tau in _LAGS if 0.5 * dt < tau < span / 3.0]
    u, i = _fill_gaps(t, u), _fill_gaps(t, i)

    def responses(x: FloatArray) -> list[FloatArray]:
        return [x, *(_lagged(x, -math.expm1(-dt / tau)) for tau in taus)]

    def of_throttle(x: FloatArray) -> list[FloatArray]:
        x = np.clip(np.abs(x), 0.0, 2.0)
        return [x, x ** 3, *responses(x ** POWER)]

    columns = level
    last = slice(-_DELAY_READINGS, None)

    def best(x: FloatArray, regressors: Any, most: int = _DELAYS) -> list[FloatArray]:
        """Return the regressors of a load at the delay with the smallest residual."""
        left, held = {}, _basis(np.stack(columns)[:, last])
        rest = v[last] - (held @ v[last]) @ held
        for late in sorted(range(-most, most + 1), key=abs):
            # The earlier half of the readings only lets the lagged loads settle.
            loads = regressors(_shifted(x[-2 * _DELAY_READINGS:], late))[:5]
            Q = _orthogonal_basis(np.stack([c[last] for c in loads]), held)
            left[late] = float(rest @ rest - np.sum((Q @ rest) ** 2))
        least = min(left, key=left.__getitem__)
        # A delay must improve the fit clearly, because the smallest residual may be chance.
        late = least if left[least] < left[0] * (1.0 - 10.0 / rest.size) else 0
        found: list[FloatArray] = regressors(_shifted(x, late))
        return found

    walk = usual_walk(v)
    v = v - v.mean()
    if i is not None:
        columns = [*columns, *best(i, responses, max(_DELAYS, min(_FAR, round(reach / dt))))]
    if u is not None:
        columns = [*columns, *best(u, of_throttle)]
        if i is not None:
            columns.append(u * i)
    places = np.concatenate([np.arange(s.start, s.stop) for s in parts] or [
        np.zeros(0)]).astype(np.intp)
    if u is not None or i is not None:
        # Free initial states of the lags, because the load before the window is unknown.
        columns = [*columns, *(np.exp((t[0] - t) / tau) for tau in taus)]
    rows, v = np.stack([c[places] for c in columns]), v[places]
    size = np.ones(v.size)
    law = NoiseSize(load_signs(t.size, dt, u, i)[:, places])
    # Start with equal weights, then weight by the size of the noise.
    left = v
    basis = np.empty((0, v.size))
    for again in range(0 if not v.size else 3 if law.follows else 1):
        if again:
            size = law.fit(_innovations(left))
        basis, left = _basis(rows / size), v / size
        # Twice, because of rounding.
        for _ in range(2):
            left = left - (basis @ left) @ basis
        left = left * size
    if law.follows and left.any():
        # Scale the size so that weighting keeps the variance, even if `law` is wrong.
        size = size * math.sqrt(float(np.sum((left / size) ** 2)) / float(left @ left))
    return Regression(dt, places, left, size, basis, [s.stop - s.start for s in parts],
                      walk, 0.5 * float(knots[1] - knots[0]))


def _innovations(x: FloatArray) -> FloatArray:
    """Return the innovations of an AR(1)."""
    # `NoiseSize` assumes independent values: fitted to a slow OU, it would follow its excursions.
    power = float(x @ x)
    phi = float(x[1:] @ x[:-1]) / power if power > 0.0 else 0.0
    return x - phi * np.append(x[:1], x[:-1])


def load_signs(n: int, dt: float, *loads: FloatArray | None) -> FloatArray:
    """Return magnitudes of loads, and of their changes over several times; shape (k, n)."""
    rows: list[FloatArray] = []
    for x in loads:
        if x is not None:
            held = [x, *(_lagged(x, -math.expm1(-dt / tau)) for tau in _CHANGES)]
            rows += [x, np.diff(x, prepend=x[0]), *(a - b for a, b in zip(held, held[1:]))]
    return np.abs(np.stack(rows)) if rows else np.zeros((0, n))


class NoiseSize:
    """Size of the noise: its ln is linear in ln(1 + scaled `load_signs`), within fitted limits."""

    def __init__(self, signs: FloatArray) -> None:
        n = max(1, signs.shape[1])
        # A constant row carries no information.
        self._used = (signs != signs[:, :1]).any(axis=1)
        self._scale = 0.3 * np.sqrt((signs[self._used] ** 2).sum(axis=1, keepdims=True) / n)
        logs = self._logs(signs)
        self._mean = logs.sum(axis=1, keepdims=True) / n
        self._X = np.vstack([np.ones(signs.shape[1]), logs - self._mean])
        self._beta, self._rms, self._ends = np.zeros(len(self._X)), 1.0, (0.0, 0.0)

    @property
    def follows(self) -> bool:
        """Return whether any load moves."""
        return len(self._X) > 1

    def _logs(self, signs: FloatArray) -> FloatArray:
        return np.asarray(np.log1p(signs[self._used] / self._scale))

    def fit(self, left: FloatArray) -> FloatArray:
        """Fit the coefficients to noise, V; return its size relative to the rms, shape (n,)."""
        X, n = self._X, left.size
        mean = float(left @ left) / max(1, n)
        if not self.follows or not mean > 1e-18:
            self._rms = math.sqrt(max(mean, 1e-300))
            return np.ones(n)
        square = left * left / mean
        prior = np.append(0.0, np.full(len(X) - 1, 2.0 / _SIZE_SD ** 2))
        beta, H = np.zeros(len(X)), X @ X.T + np.diag(prior)
        for _ in range(_SIZE_ROUNDS):
            # Score of the Gamma likelihood of the squares.
            score = X @ (square * np.exp(-np.clip(beta @ X, -6.0, 6.0)) - 1.0) - prior * beta
            beta = beta + np.clip(np.linalg.solve(H, score), -1.0, 1.0)
        log = np.clip(beta @ X, -6.0, 6.0)
        variance = np.exp(log)
        self._beta, self._ends = beta, (float(log.min()), float(log.max()))
        self._rms = math.sqrt(max(mean, 1e-300))
        return np.asarray(np.sqrt(variance / variance.mean()))

    def of(self, signs: FloatArray) -> FloatArray:
        """Return the size of the noise, V, for `load_signs`, by the last fit."""
        X = np.vstack([np.ones(signs.shape[1]), self._logs(signs) - self._mean])
        return np.asarray(self._rms * np.exp(0.5 * np.clip(self._beta @ X, *self._ends)))


class _Likelihood:
    """Restricted likelihood (regressors integrated out) of OU, white noise and walk."""

    def __init__(self, part: Regression) -> None:
        self._cross = CrossSpectrum(
            np.vstack([part.basis, part.voltage / part.size]), part.lengths, part.absorbed)

    def at(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return minus the log-likelihood, and the variance of OU plus white noise, V^2."""
        # Points of shape (k, 3): ln(alpha dt), logit(share of the OU), and ln(walk).  Walk is the
        # variance of a step of the level, divided by the variance of OU plus white noise.
        half = points.shape[0] // 2
        if half and points.shape[0] * self._cross.size > _AT_ONCE:
            value, variance = zip(self.at(points[:half]), self.at(points[half:]))
            return np.concatenate(value), np.concatenate(variance)
        # A grid has few rates, and each spectrum is expensive.
        rates, of = np.unique(points[:, 0], return_inverse=True)
        share = 1.0 / (1.0 + np.exp(-points[:, 1:2]))
        excess = self._cross.bins.ou(np.exp(rates)[:, None]) - 1.0
        return self._cross.cost(
            1.0 + share * excess[of] + np.exp(points[:, 2:]) / self._cross.bins.walk)[:2]


def _points(*axes: FloatArray) -> FloatArray:
    return np.stack([x.ravel() for x in np.meshgrid(*axes, indexing='ij')], axis=1)


def fit_ou(part: Regression, span: float, *, precise: bool = False) -> OuFacts:
    """Fit the noise to a window of `span` s; with `precise`, give up if alpha is imprecise."""
    dt = part.dt
    total = float(part.voltage @ part.voltage)
    if not total > 1e-18 * part.voltage.size:
        # A constant signal has no noise, and so no relaxation.
        return OuFacts('not_visible', span, tau_below_s=dt, var_inf_below=0.0)
    likelihood = _Likelihood(part)
    # Approximate ln(walk), as in `_Likelihood.at`, of the usual walk.
    usual = math.log(dt * part.walk ** 2 * part.free / total)
    low = np.array([math.log(dt / part.slowest), _LOGIT[0], usual - 6.0 * _WALK_SD])
    high = np.array([math.log(_FASTEST), _LOGIT[1], usual + 6.0 * _WALK_SD])

    def costs(points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return minus the log-posterior for a flat prior of the share, and the variance, V^2."""
        value, variance = likelihood.at(points)
        off = 0.5 * (points[:, 2] + np.log(variance / dt)) - math.log(part.walk)
        return value + 0.5 * np.maximum(off / _WALK_SD, 0.0) ** 2, variance

    def cost(points: FloatArray) -> FloatArray:
        inside = np.clip(points, low, high)
        return costs(inside)[0] + 10.0 * np.sum((points - inside) ** 2, axis=1)

    points = _points(*(np.linspace(*ends) for ends in zip(low, high, _GRID)))
    value, variance = costs(points)
    white = float(costs(_points(np.zeros(1), np.full(1, -60.0),
                                np.linspace(low[2], high[2], 40)))[0].min())
    step = (high - low) / (np.array(_GRID) - 1)
    peaks = [_minimum(cost, points[np.argmin(value)], step)]
    least = min(peaks[0][1], white)
    if white - least < VISIBLE:
        return OuFacts('not_visible', span) if precise else _bounds(
            costs, low, high, least, dt, span)
    roots = [_curvature(cost, np.clip(peaks[0][0], low, high))]
    if precise and math.sqrt(float(roots[0][0] @ roots[0][0])) > _IMPRECISE:
        return OuFacts('not_visible', span)
    for rival in _rivals(cost, points, value, peaks[0], step):
        peaks.append(rival)
        roots.append(_curvature(cost, np.clip(rival[0], low, high)))
    if precise and len(peaks) > 1:
        return OuFacts('not_visible', span)
    # Importance sampling, at first from a wide distribution about each maximum, and in later
    # rounds from distributions with the moments of the last round's points.
    nearest = np.abs(points[:, :1] - [peak[0] for peak, _ in peaks]).argmin(axis=1)
    laws = [(1.0 / len(peaks), *_moments(
        np.vstack([np.clip(peak, low, high), points[nearest == k]]),
        np.append(1.0, np.exp(lowest - value[nearest == k])), root @ root.T))
        for k, ((peak, lowest), root) in enumerate(zip(peaks, roots))]
    rng = np.random.default_rng(0)
    for _ in range(_ROUNDS):
        points = np.concatenate([_draw(rng, *law) for law in laws])
        points = points[np.all((points >= low) & (points <= high), axis=1)]
        value, variance = costs(points)
        share = 1.0 / (1.0 + np.exp(-points[:, 1]))
        of = np.stack([_log_density(points, *law) for law in laws])
        total = np.logaddexp.reduce(of)
        log_weight = 0.5 * np.log(share * (1.0 - share)) - value - total
        weight = np.exp(log_weight - log_weight.max())
        weight /= weight.sum()
        own = weight * np.exp(of - total)
        parts = np.maximum(own.sum(axis=1), _FEWEST_DRAWN)
        laws = [(float(part), *_moments(points, one, 1e-4 * np.eye(3)))
                for part, one in zip(parts / parts.sum(), own)]
    log_alpha, log_var = points[:, 0] - math.log(dt), np.log(share * variance)
    spread = math.sqrt(2.0 / part.free)
    alpha, *alpha_95 = np.exp(_quantiles(log_alpha, weight, 0.0))
    if alpha_95[0] * part.slowest < _EDGE:
        return OuFacts('too_short', span)
    var_inf, *var_inf_95 = np.exp(_quantiles(log_var, weight, spread))
    ends = np.exp(_quantiles(0.5 * (log_alpha + log_var + math.log(2.0)), weight, 0.5 * spread))
    sigma = math.sqrt(2.0 * alpha * var_inf)
    sigma_95 = min(ends[1], sigma), max(ends[2], sigma)
    found = OuFacts('ok', span, float(alpha), _pair(alpha_95), sigma, _pair(sigma_95),
                    float(var_inf), _pair(var_inf_95))
    return found if all(determined(middle, *around) for middle, around in (
        (found.alpha, found.alpha_95), (found.sigma, found.sigma_95),
        (found.var_inf, found.var_inf_95))) else _bounds(
            costs, low, high, least, dt, span)


def fit_pieces(parts: Sequence[tuple[FloatArray, FloatArray]], dt: float, walk: float,
               absorbed: FloatArray | None = None) -> OuFacts:
    """Fit the noise to pieces (V, relative size of the noise), each with its own mean."""
    parts = [part for part in parts if part[0].size >= _STRETCH]
    total = sum(part[0].size for part in parts)
    # Choose the largest common length of pieces, up to _HATS s, that keeps enough readings.
    n = max([_STRETCH, *(part[0].size for part in parts)])
    n = min(n, max(_STRETCH, round(_HATS / dt)))
    while n > _STRETCH and sum(part[0].size // n * n for part in parts) < _HELD * total:
        n = max(_STRETCH, 4 * n // 5)
    cut = [[x[k:k + n] for x in part]
           for part in parts for k in range(0, part[0].size - n + 1, n)]
    span = dt * n * len(cut)
    if (n - 1) * len(cut) < FEWEST:
        return OuFacts('too_short', span)
    voltage = np.concatenate([piece[0] - piece[0].mean() for piece in cut])
    size = np.concatenate([piece[1] for piece in cut])
    return fit_ou(Regression(
        dt, np.arange(voltage.size), voltage, size / math.sqrt(float(size @ size) / size.size),
        np.zeros((0, voltage.size)), [n] * len(cut), walk, 0.5 * n * dt, absorbed), span)


def white_variance(ou: OuFacts, steps: float, dt: float) -> float:
    """Return the variance of white noise, V^2, beside an OU; steps: mean squared step over dt."""
    relaxed = ou.var_inf * math.expm1(-ou.alpha * dt) if ou.status == 'ok' else 0.0
    return max(0.0, 0.5 * steps + relaxed)


def known_ou(t: FloatArray, v: FloatArray, u: FloatArray | None, i: FloatArray | None) -> OuFacts:
    """Fit the shortest of OU_WINDOWS at the end of the readings that is precise enough."""
    if not t.size:
        return OuFacts('no_data')
    t, v = t[-MOST_READINGS:], v[-MOST_READINGS:]
    u, i = (None if x is None else x[-MOST_READINGS:] for x in (u, i))
    span = float(t[-1] - t[0])
    longest = min(span, OU_WINDOWS[-1])
    last = None
    for window in (*(w for w in OU_WINDOWS if w < longest), longest):
        begin = int(np.searchsorted(t, t[-1] - window))
        if t.size - begin < FEWEST:
            continue
        near, cut = t[begin:], v[begin:].copy()
        throttle, drawn = (None if x is None else x[begin:] for x in (u, i))
        part = regress(near, cut, throttle, drawn)
        if part.free < FEWEST:
            continue
        lines = _tones(part)
        if lines.any():
            cut[part.places] -= lines
            part = regress(near, cut, throttle, drawn)
        last = part, window
        if window < longest:
            found = fit_ou(part, window, precise=True)
            if found.status == 'ok' and found.alpha_95[1] < PRECISE ** 2 * found.alpha_95[0]:
                return found
    return fit_ou(*last) if last else OuFacts('too_short', span)


def _tones(part: Regression) -> FloatArray:
    edges, lowest = np.cumsum(part.lengths)[:-1], 0.5 * _PERIODS / part.slowest
    white = _innovations(part.voltage / part.size)
    return np.concatenate([
        tones(one, other, 1.0 / part.dt, lowest)
        for one, other in zip(np.split(part.voltage, edges), np.split(white, edges))])


def _pair(ends: Sequence[float]) -> tuple[float, float]:
    return float(ends[0]), float(ends[1])


def _minimum(cost: Callable[[FloatArray], FloatArray], point: FloatArray, step: FloatArray,
             ) -> tuple[FloatArray, float]:
    """Return the lowest point by a pattern search of 27 points with halved steps, and its cost."""
    around = _points(*(np.array([-1.0, 0.0, 1.0]),) * 3)
    lowest = math.inf
    for _ in range(_LOOKS):
        values = cost(point + step * around)
        best = int(np.argmin(values))
        lowest = min(lowest, float(values[best]))
        point = point + step * around[best]
        if not around[best].any():
            step = 0.5 * step
        if (step < _NEAR).all():
            break
    return point, lowest


def _rivals(cost: Callable[[FloatArray], FloatArray], points: FloatArray, value: FloatArray,
            peak: tuple[FloatArray, float], step: FloatArray) -> list[tuple[FloatArray, float]]:
    """Return the minima of the cost at other rates, and their costs."""
    by_rate = value.reshape(_GRID[0], -1)
    profile = np.pad(by_rate.min(axis=1), 1, constant_values=math.inf)
    dips = np.flatnonzero((profile[1:-1] <= profile[:-2]) & (profile[1:-1] < profile[2:])
                          & (profile[1:-1] < peak[1] + _REFINED))
    found = [peak]
    for k in (dips * by_rate.shape[1] + by_rate[dips].argmin(axis=1)).tolist():
        if abs(points[k, 0] - peak[0][0]) > 2.0 * step[0]:
            rival = _minimum(cost, points[k], step)
            if rival[1] < peak[1] + _RIVAL and all(
                    abs(rival[0][0] - other[0]) > step[0] for other, _ in found):
                found.append(rival)
    return found[1:]


def _moments(points: FloatArray, weight: FloatArray, more: FloatArray
             ) -> tuple[FloatArray, FloatArray]:
    """Return the mean of weighted points, and a root of their covariance + `more`."""
    weight = weight / max(float(weight.sum()), 1e-300)
    centre = weight @ points
    off = points - centre
    return centre, np.linalg.cholesky((off * weight[:, None]).T @ off + more)


def _draw(rng: np.random.Generator, part: float, centre: FloatArray, root: FloatArray
          ) -> FloatArray:
    """Draw a share of `_DRAWS` from Student's t with 5 degrees of freedom."""
    n = round(part * _DRAWS)
    z = rng.standard_normal((n, 3)) / np.sqrt(rng.chisquare(5.0, (n, 1)) / 5.0)
    return np.asarray(centre + z @ root.T)


def _log_density(points: FloatArray, part: float, centre: FloatArray, root: FloatArray
                 ) -> FloatArray:
    """Return the log density of `_draw`, up to a constant."""
    z = np.linalg.solve(root, (points - centre).T)
    return np.asarray(math.log(part) - np.log(root.diagonal()).sum()
                      - 4.0 * np.log1p(np.sum(z * z, axis=0) / 5.0))


def _curvature(cost: Callable[[FloatArray], FloatArray], centre: FloatArray) -> FloatArray:
    """Return a root of the covariance from a cost's curvature; deviations are at most 2.4."""
    step = 0.15 * np.eye(3)
    signs = ((1, 1, 1.0), (1, -1, -1.0), (-1, 1, -1.0), (-1, -1, 1.0))
    H = np.zeros((3, 3))
    for one, other, sign in signs:
        points = centre + one * step[:, None, :] + other * step[None, :, :]
        H += sign * cost(points.reshape(-1, 3)).reshape(3, 3) / (4.0 * 0.15 ** 2)
    values, vectors = np.linalg.eigh(0.5 * (H + H.T))
    return np.asarray(vectors / np.sqrt(np.clip(values, 0.25, None)) * 1.2)


def _quantiles(log: FloatArray, weight: FloatArray, extra: float) -> FloatArray:
    """Return median, 2.5 and 97.5 % quantile, after adding normal errors of deviation `extra`."""
    if extra:
        nodes, w = np.polynomial.hermite_e.hermegauss(7)
        log = (log[:, None] + extra * nodes).ravel()
        weight = (weight[:, None] * w).ravel()
    order = np.argsort(log)
    mass = np.cumsum(weight[order])
    mass = (mass - 0.5 * weight[order]) / mass[-1]
    return np.interp((0.5, 0.025, 0.975), mass, log[order])


def _bounds(costs: Callable[[FloatArray], tuple[FloatArray, FloatArray]], low: FloatArray,
            high: FloatArray, least: float, dt: float, span: float) -> OuFacts:
    """Return bounds: an OU slower than `tau_below_s` has a variance below `var_inf_below`."""
    axes = [np.linspace(*ends) for ends in zip(low, high, _GRID)]
    first = costs(_points(*axes))[0].reshape(_GRID).reshape(_GRID[0], -1).argmin(axis=1)
    best, walk = np.unravel_index(first, _GRID[1:])
    logits = np.sort(np.hstack([
        np.clip(axes[1][best][:, None] + _ASIDE, *_LOGIT),
        np.broadcast_to(axes[1], _GRID[:2])]), axis=1)
    shape = logits.shape
    points = np.stack(np.broadcast_arrays(
        axes[0][:, None], logits, axes[2][walk][:, None]), axis=2).reshape(-1, 3)
    value, variance = costs(points)
    for step in _REFINE:
        for way in (-step, step):
            other = points + np.array([0.0, 0.0, way])
            cost, size = costs(other)
            better = (cost < value)[:, None]
            points = np.where(better, other, points)
            value, variance = (np.where(better[:, 0], x, y)
                               for x, y in ((cost, value), (size, variance)))
    # At the best walk, interpolate sqrt(loss), which is linear for a parabola.
    lost = (value - min(least, float(value.min()))).reshape(shape)
    fine = _refine_grid(np.sqrt(np.maximum(lost, 0.0))) ** 2
    size, logit = (_refine_grid(x.reshape(shape))
                   for x in (np.log(variance), points[:, 1]))
    tau = dt * np.exp(-np.linspace(low[0], high[0], fine.shape[0]))
    share = 1.0 / (1.0 + np.exp(-logit))
    fits = fine < _DROP
    strong = (fits & (share > _QUARTER)).any(axis=1)
    longest = float(tau[strong].max()) if strong.any() else float(tau.min())
    slower = fits & (tau > longest)[:, None]
    variance = share * np.exp(size)
    return OuFacts('not_visible', span, tau_below_s=longest, var_inf_below=float(
        variance[slower].max() if slower.any() else _QUARTER * np.exp(size.min())))


def _refine_grid(values: FloatArray) -> FloatArray:
    """Return values on a grid 8 times as fine in both directions, by linear interpolation."""
    for _ in range(2):
        at = np.linspace(0.0, values.shape[0] - 1.0, 8 * values.shape[0])
        low = np.minimum(at.astype(np.intp), values.shape[0] - 2)
        values = (values[low] + (at - low)[:, None] * (values[low + 1] - values[low])).T
    return values
