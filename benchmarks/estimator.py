"""
The sliding-window estimator against the exact likelihood and AR(1), and its speed (10 min).

    python benchmarks/estimator.py [--windows 500] [--parts awts] [--quick]
        [--page doc/results/estimator.md]

The likelihood uses no code of the package.  benchmarks/README.md defines the columns.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import importlib.util
import math
import sys
import time
from typing import Any

from common import arguments, deliver, environment, number, say, table
import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
from scipy.optimize import minimize, minimize_scalar
import windows as simulated
from windows import Array, cells, errors, Fit, SENSORS, statuses

SEED = 20260131
HEAD = [f'{name} {what}' for name in ('alpha', 'sigma', 'Var_inf')
        for what in ('bias %', 'RMSE %', 'cover %')]
# alpha T of the short and long windows, and their sensor.
RELAXATIONS, SENSOR = (5, 8, 12, 25, 40, 126, 630), '5 mV noise'
# Name, time constant, dead time (s), and whether steps fall on the sampling grid.
RESPONSES: tuple[tuple[str, float, float, bool], ...] = (
    ('(a) at once', 0.0, 0.0, True), ('(b) through a 10 ms lag', 0.010, 0.0, True),
    ('(c) 10 ms lag, steps between samples', 0.010, 0.0, False),
    ('(d) through a 20 ms lag', 0.020, 0.0, True),
    ('(e) 10 ms lag after 5 ms dead time', 0.010, 0.005, True))


# -- methods: one window and its spacing, s -> a fit


def ours(y: Array, dt: float, throttle: Array | None = None) -> Fit:
    """Return the estimate of one window by a new estimator."""
    estimator = SlidingEstimator(y.size * dt)
    estimator.push(1000.0 * y.size * dt + np.arange(y.size) * dt, y, throttle)
    e = estimator.estimate()
    return Fit((e.alpha, e.sigma, e.var_inf), (e.alpha_se, e.sigma_se, e.var_inf_se),
               e.status.name)


_LOW, _HIGH = math.log(1e-5), math.log(8.0)
# Noise variances, in units of sigma^2 dt, from which the search starts.
_STARTS = (0.02, 0.2, 2.0)
_LEAST_NOISE, _MOST_NOISE = math.log(1e-6), math.log(1e4)


def _compiled(function: Callable[..., Any]) -> Any:
    if importlib.util.find_spec('numba') is None:
        return function
    import numba
    return numba.njit(function)


@_compiled
def _filtered(y: Array, a: float, noise: float) -> tuple[float, float, float]:
    """Return quadratic form, log-determinant, and information on the level."""
    phi = math.exp(-a)
    stationary = 0.5 / a
    drive = -stationary * math.expm1(-2.0 * a)
    variance = stationary
    state = 0.0
    unit = 0.0
    by_data = 0.0
    crossed = 0.0
    by_level = 0.0
    log_det = 0.0
    for value in y:
        total = variance + noise
        gain = variance / total
        error = value - state
        left = 1.0 - unit
        by_data += error * error / total
        crossed += error * left / total
        by_level += left * left / total
        log_det += math.log(total)
        state = phi * (state + gain * error)
        unit = phi * (unit + gain * left)
        variance = phi * phi * variance * (1.0 - gain) + drive
    return by_data - crossed * crossed / by_level, log_det, by_level


def _deviance(y: Array, log_a: float, noise: float) -> float:
    """Return minus twice the restricted log-likelihood with the scale profiled out."""
    form, log_det, by_level = _filtered(y, math.exp(log_a), noise)
    return float((y.size - 1) * math.log(form) + log_det + math.log(by_level))


def _log_errors(y: Array, log_a: float, log_scale: float, noise: float) -> Array:
    """
    Return standard errors of ln(alpha), ln(sigma), ln(Var_inf).

    Observed information by central differences.  The noise variance counts as unknown even on its
    bound, where this makes the errors larger.
    """
    def value(p: Array) -> float:
        form, log_det, by_level = _filtered(y, math.exp(p[0]), p[2])
        return float(0.5 * ((y.size - 1) * p[1] + form * math.exp(-p[1]) + log_det
                            + math.log(by_level)))

    at = np.array([log_a, log_scale, noise])
    steps = np.array([1e-2, 1e-3, 3e-3 * max(noise, 0.1)])
    hessian = np.empty((3, 3))
    for i in range(3):
        for j in range(i + 1):
            one, other = np.eye(3)[i] * steps, np.eye(3)[j] * steps
            hessian[i, j] = hessian[j, i] = (
                value(at + one + other) - value(at + one - other) - value(at - one + other)
                + value(at - one - other)) / (4.0 * steps[i] * steps[j])
    try:
        covariance = np.linalg.inv(hessian)
    except np.linalg.LinAlgError:
        return np.full(3, np.nan)
    turn = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.0], [-1.0, 1.0, 0.0]])
    variances = (turn @ covariance @ turn.T).diagonal()
    return np.sqrt(np.where(variances > 0.0, variances, np.nan))


def kalman(y: Array, dt: float) -> Fit:
    """
    Return the restricted maximum-likelihood fit by the Kalman filter.

    The level is integrated out (its flat prior gives the term in `by_level`), the scale is
    profiled out, and the noise variance is bounded at 0: the bound is searched separately, and the
    interior from several starts, to find the global maximum.
    """
    centred = y - y.mean()
    edge = minimize_scalar(lambda x: _deviance(centred, x, 0.0), bounds=(_LOW, _HIGH),
                           method='bounded', options={'xatol': 1e-7})
    best, log_a, noise = float(edge.fun), float(edge.x), 0.0
    for start in _STARTS:
        # With noise the slope of the variogram at the edge is too steep.
        begin = np.array([max(log_a - 0.5 * math.log1p(start), _LOW + 1.0), math.log(start)])
        found = minimize(
            lambda p: _deviance(centred, p[0], math.exp(p[1])), begin, method='Nelder-Mead',
            bounds=((_LOW, _HIGH), (_LEAST_NOISE, _MOST_NOISE)),
            options={'xatol': 1e-5, 'fatol': 1e-8})
        if found.fun < best - 1e-9:
            best, log_a, noise = float(found.fun), float(found.x[0]), math.exp(found.x[1])
    form = _filtered(centred, math.exp(log_a), noise)[0]
    scale = form / (y.size - 1)
    alpha = math.exp(log_a) / dt
    sigma2 = scale / dt
    return Fit((alpha, math.sqrt(sigma2), sigma2 / (2.0 * alpha)),
               tuple(_log_errors(centred, log_a, math.log(scale), noise).tolist()))


def corrected(plain: Fit, duration: float) -> Fit:
    """
    Return a restricted fit with its small-sample bias removed.

    A bias of 2/T remains in alpha (Tang & Chen 2009, less the half that comes from the level);
    Var_inf, convex in alpha, is taken at alpha - 1/T.
    """
    alpha, sigma, _ = plain.values
    if alpha * duration <= 2.0:
        return Fit()
    return replace(plain, values=(alpha - 2.0 / duration, sigma,
                                  sigma ** 2 / (2.0 * (alpha - 1.0 / duration))))


def autoregression(y: Array, dt: float) -> Fit:
    """Return the least-squares AR(1), exactly in continuous time; delta-method errors."""
    x, later = y[:-1] - y[:-1].mean(), y[1:] - y[1:].mean()
    phi = float(x @ later / (x @ x))
    if not 0.0 < phi < 1.0:
        return Fit()
    shock = float(np.mean((later - phi * x) ** 2))
    rate, var_inf = -math.log(phi), shock / (1.0 - phi * phi)
    # Derivatives of ln(alpha), ln(sigma), ln(Var_inf) by phi; by ln(shock): 0, 1/2, 1.
    by_alpha, by_var = -1.0 / (phi * rate), 2.0 * phi / (1.0 - phi * phi)
    by_phi = np.array([by_alpha, 0.5 * (by_alpha + by_var), by_var])
    variance = by_phi ** 2 * shock / (x @ x) + np.array([0.0, 0.25, 1.0]) * 2.0 / y.size
    return Fit((rate / dt, math.sqrt(2.0 * rate / dt * var_inf), var_inf),
               tuple(np.sqrt(variance).tolist()))


def run(method: Callable[..., Fit], windows: Array, *columns: Array) -> list[Fit]:
    """Fit each window; add the CPU time of this process."""
    out = []
    for row, y in enumerate(windows):
        begin = time.process_time()
        fit = method(y, simulated.DT, *(c[row] for c in columns))
        out.append(replace(fit, seconds=time.process_time() - begin))
    return out


# -- parts


def accuracy(windows: int) -> str:
    """Compare the methods on 2 s windows at 1 kHz."""
    rng = np.random.default_rng(SEED)
    paths = simulated.simulate(rng, windows, round(simulated.WINDOW / simulated.DT))
    parts = []
    for sensor, see in SENSORS.items():
        seen = see(paths, rng)
        exact = run(kalman, seen)
        rows = [[name, *cells(fits), number(1e3 * float(np.median([f.seconds for f in fits])),
                                            '.3g')]
                for name, fits in (
                    ('ou_monitor SlidingEstimator', run(ours, seen)),
                    ('Kalman, restricted likelihood', exact),
                    ('the same, corrected by 2/T',
                     [corrected(fit, simulated.WINDOW) for fit in exact]),
                    ('AR(1)', run(autoregression, seen)))]
        parts.append(f'**{sensor}**\n\n' + table(['method', *HEAD, 'CPU ms'], rows))
        say(f'  {sensor} done')
    return '### Accuracy: 2 s windows at 1 kHz\n\n' + '\n'.join(parts)


def lengths(windows: int) -> str:
    """Vary the length of the window."""
    rng = np.random.default_rng(SEED + 1)
    rows, shares = [], []
    for relaxations in RELAXATIONS:
        n = round(relaxations / simulated.ALPHA / simulated.DT)
        seen = SENSORS[SENSOR](simulated.simulate(rng, windows, n), rng)
        own = run(ours, seen)
        exact = [corrected(fit, n * simulated.DT) for fit in run(kalman, seen)]
        given = np.isfinite(errors(own)).all(axis=1)
        rows += [[str(relaxations), name, *cells(fits, only)] for name, fits, only in (
            ('ours', own, None), ('Kalman, same windows', exact, given),
            ('Kalman, all windows', exact, None))]
        shares.append([str(relaxations), str(n), str(windows), statuses(own)])
        say(f'  alpha T = {relaxations} done')
    return (f'### Short and long windows ({SENSOR})\n\n'
            + table(['alpha T', 'method', *HEAD], rows) + '\n'
            + table(['alpha T', 'samples', 'windows', 'status of our estimate'], shares))


def steps(windows: int) -> str:
    """Step the throttle within the window."""
    rng = np.random.default_rng(SEED + 2)
    n = round(simulated.WINDOW / simulated.DT)
    still = SENSORS[SENSOR](simulated.simulate(rng, windows, n), rng)
    throttle, times = simulated.throttle_steps(rng, windows, n)
    found = {'no steps': run(ours, still, np.full_like(still, simulated.LOW)),
             'throttle moves, supply does not sag': run(ours, still, throttle)}
    for name, lag, dead, on_grid in RESPONSES:
        found[name] = run(ours, still + simulated.sagging(throttle, times, lag, dead, on_grid),
                          throttle)
        say(f'  {name} done')
    found['(b), throttle not given'] = run(
        ours, still + simulated.sagging(throttle, times, RESPONSES[1][1]))
    return f'### Throttle steps, sag 0.3 V ({SENSOR})\n\n' + table(
        ['response of the supply', *HEAD],
        [[name, *cells(fits)] for name, fits in found.items()])


def speed(scale: int) -> str:
    """Time `push` by block, and `estimate` by window: CPU time of this thread."""
    rng = np.random.default_rng(5)

    def supply(n: int) -> tuple[Array, Array, Array]:
        y = SENSORS[SENSOR](simulated.simulate(rng, 1, n)[0], rng)
        return (1000.0 + np.arange(n) * simulated.DT, y,
                np.repeat(0.3 + 0.4 * rng.random(n // 100 + 1), 100)[:n])
    pushes = []
    for block in (1, 10, 100, 1000):
        n = 200_000 // scale // block * block
        t, y, u = supply(n)
        blocks = [(t[i:i + block], y[i:i + block], u[i:i + block]) for i in range(0, n, block)]
        least = math.inf
        for _ in range(5):
            push, begin = SlidingEstimator(simulated.WINDOW).push, time.thread_time()
            for one in blocks:
                push(*one)
            least = min(least, time.thread_time() - begin)
        pushes.append([str(block), f'{1e6 * least * block / n:.1f}', f'{1e-6 * n / least:.3g}'])
    fits = []
    for window in (2.0, 20.0, 200.0):
        filled, rounds = round(1.1 * window / simulated.DT), 400 // scale
        t, y, u = supply(filled + 100 * rounds)
        for throttle, how in ((np.full_like(u, simulated.LOW), 'steady'), (u, 'moving')):
            estimator, spent = SlidingEstimator(window), []
            estimator.push(t[:filled], y[:filled], throttle[:filled])
            for i in range(filled, t.size, 100):
                part = slice(i, i + 100)
                begin = time.thread_time()
                estimator.estimate()
                spent.append(1e6 * (time.thread_time() - begin))
                estimator.push(t[part], y[part], throttle[part])
            middle, high = np.percentile(spent[2:], [50, 99])
            fits.append([f'{window:g} s', how, f'{middle:.0f}', f'{high:.0f}', f'{spent[0]:.0f}'])
    return ('### `push(t, voltage, throttle)`\n\n'
            + table(['samples in a block', 'CPU us a block', 'million samples/s'], pushes)
            + '\n### `estimate()` after pushes of 100 samples at 1 kHz\n\n'
            + table(['window', 'throttle', 'CPU p50 us', 'CPU p99 us', 'first fit, CPU us'], fits))


def main() -> int:
    """Parse arguments, measure, write."""
    parser = arguments(__doc__)
    parser.add_argument('--windows', type=int, default=500, help='windows of each case')
    parser.add_argument('--quick', action='store_true', help='20 windows, a tenth of the samples')
    parser.add_argument('--parts', default='awts',
                        help='a: accuracy, w: lengths of the window, t: throttle steps, s: speed')
    given = parser.parse_args()
    count = min(given.windows, 20) if given.quick else given.windows
    made: dict[str, Any] = {'a': accuracy, 'w': lengths, 't': steps}
    setting = f'<!-- {environment("numba")}'
    parts = [made[part](count) for part in given.parts if part in made]
    if parts:
        text = '\n'.join([f'{setting}; {count} windows -->\n', *parts])
        deliver(text, given.page, 'accuracy')
    if 's' in given.parts:
        deliver(f'{setting} -->\n\n{speed(10 if given.quick else 1)}', given.page, 'speed')
    return 0


if __name__ == '__main__':
    sys.exit(main())
