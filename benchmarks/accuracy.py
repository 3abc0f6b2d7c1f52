"""Accuracy: the same simulated windows to every method."""

from __future__ import annotations

from collections.abc import Callable
import sys
import time
from typing import Any

import data
from data import Array, SENSORS, TRUTH
import kalman
import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
import peers
from records import Fit, Fits, NAMES, rmse_ratio

OURS = 'ou_monitor SlidingEstimator'
KALMAN = 'Kalman, restricted likelihood'
CORRECTED = 'the same, corrected by 2/T'
# alpha T of the small windows; they are seen with this sensor.
RELAXATIONS = (5, 8, 12, 25, 40, 126, 630)
SMALL_SENSOR = '5 mV noise'
# Name, time constant, dead time (s), and whether steps fall on the sampling grid.
RESPONSES: tuple[tuple[str, float, float, bool], ...] = (
    ('(a) at once', 0.0, 0.0, True),
    ('(b) through a 10 ms lag', 0.010, 0.0, True),
    ('(c) 10 ms lag, steps between samples', 0.010, 0.0, False),
    ('(d) through a 20 ms lag', 0.020, 0.0, True),
    ('(e) 10 ms lag after 5 ms dead time', 0.010, 0.005, True),
)


def say(text: str) -> None:
    """Tell progress."""
    print(text, file=sys.stderr, flush=True)


def ours(y: Array, dt: float, throttle: Array | None = None) -> Fit:
    """Return our estimate of one window, from nothing; the window starts with a slot."""
    n = y.size
    window = n * dt
    # Steps of exactly dt; a start at a multiple of the window keeps all samples.
    estimator = SlidingEstimator(window)
    estimator.push(1000.0 * window + np.arange(n) * dt, y, throttle)
    e = estimator.estimate()
    return Fit(e.alpha, e.sigma, e.var_inf, (e.alpha_se, e.sigma_se, e.var_inf_se),
               e.status.name)


def run(method: Callable[..., Any], windows: Array, *columns: Array) -> Fits:
    """Fit each window; CPU time of this process, errors of a fit left out where they are extra."""
    out = Fits()
    for row, y in enumerate(windows):
        begin = time.process_time()
        fit = method(y, data.DT, *(c[row] for c in columns))
        out.seconds.append(time.process_time() - begin)
        if isinstance(fit, tuple):
            fit = fit[1]()
        out.fits.append(fit)
    return out


def correct(plain: Fits, duration: float) -> Fits:
    """Return fits less their small-sample bias."""
    return Fits([kalman.corrected(f, duration) for f in plain.fits], plain.seconds)


def compare(seed: int, windows: int, slow: int) -> dict[str, Any]:
    """
    Compare all methods on 2 s windows at 1 kHz.

    Parameters
    ----------
    seed : int
        Of the random numbers.
    windows, slow : int
        Windows for each method, and for the slow ones (the first of the same).

    Returns
    -------
    dict
        Sensor -> method -> summary, and sensor -> RMSE ratio to the reference.

    """
    rng = np.random.default_rng(seed)
    paths = data.simulate(rng, windows, round(data.WINDOW / data.DT))
    tables: dict[str, Any] = {}
    ratios: dict[str, Any] = {}
    for sensor, see in SENSORS.items():
        seen = see(paths, rng)
        results = {OURS: run(ours, seen)}
        for name, package, method, is_slow in peers.PEERS:
            if not peers.installed(package):
                say(f'  {name}: {package} is not installed, left out')
                continue
            begin = time.monotonic()
            results[name] = run(method, seen[:slow] if is_slow else seen)
            say(f'  {sensor}: {name}: {time.monotonic() - begin:.1f} s')
            if name == KALMAN:
                results[CORRECTED] = correct(results[name], data.WINDOW)
        tables[sensor] = {name: fits.summary(TRUTH) for name, fits in results.items()}
        ratios[sensor] = _ratios(results)
    return {'tables': tables, 'ratios': ratios}


def _ratios(results: dict[str, Fits]) -> dict[str, Any]:
    own = results[OURS].relative(TRUTH)
    out: dict[str, Any] = {}
    for reference in (KALMAN, CORRECTED):
        other = results[reference].relative(TRUTH)
        out[reference] = {name: rmse_ratio(own[:, i], other[:, i], paired=True)
                          for i, name in enumerate(NAMES)}
    return out


def small(seed: int, windows: int) -> dict[str, Any]:
    """
    Shorten the window.

    Parameters
    ----------
    seed, windows : int
        As in `compare`.

    Returns
    -------
    dict
        alpha T -> {'ours', 'kalman', 'kalman_all'}: ours where it publishes
        alpha, the corrected reference on the same windows and on all.

    """
    rng = np.random.default_rng(seed)
    out: dict[str, Any] = {}
    for relaxations in RELAXATIONS:
        n = round(relaxations / data.ALPHA / data.DT)
        seen = SENSORS[SMALL_SENSOR](data.simulate(rng, windows, n), rng)
        own = run(ours, seen)
        reference = correct(run(kalman.fit, seen), n * data.DT)
        told = np.isfinite(own.relative(TRUTH)[:, 0])
        out[str(relaxations)] = {
            'samples': n, 'ours': own.summary(TRUTH, told),
            'kalman': reference.summary(TRUTH, told), 'kalman_all': reference.summary(TRUTH)}
        say(f'  alpha T = {relaxations} done')
    return out


def load(seed: int, windows: int) -> dict[str, Any]:
    """
    Step the throttle within the window.

    Parameters
    ----------
    seed, windows : int
        As in `compare`.

    Returns
    -------
    dict
        Case -> summary, with the RMSE ratio to the same windows without steps.

    """
    rng = np.random.default_rng(seed)
    n = round(data.WINDOW / data.DT)
    still = SENSORS[SMALL_SENSOR](data.simulate(rng, windows, n), rng)
    throttle, times = data.throttle_steps(rng, windows, n)
    rest = run(ours, still, np.full_like(still, data.LOW))
    base = rest.relative(TRUTH)
    out: dict[str, Any] = {'no steps': {'summary': rest.summary(TRUTH), 'ratio': None}}

    def add(name: str, fits: Fits) -> None:
        errors = fits.relative(TRUTH)
        out[name] = {'summary': fits.summary(TRUTH),
                     'ratio': {p: rmse_ratio(errors[:, i], base[:, i], paired=True)
                               for i, p in enumerate(NAMES)}}

    add('throttle moves, supply does not sag', run(ours, still, throttle))
    for name, lag, delay, on_grid in RESPONSES:
        sag = data.sagging(throttle, times, lag, delay, on_grid)
        add(name, run(ours, still + sag, throttle))
        say(f'  {name} done')
    sag = data.sagging(throttle, times, RESPONSES[1][1])
    add('(b), throttle not given', run(ours, still + sag))
    return out
