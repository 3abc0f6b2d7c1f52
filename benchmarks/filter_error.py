"""
Mean square error and lag: every law against hindsight and against the truth.

Run by `filter.py error` and `filter.py bags`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from pathlib import Path

import filter_methods as methods
from filter_signals import ADC, Case, CASES, Flights, fly, kalman, RATE
import numpy as np
from ou_monitor.online.filter.cutoff_laws import wanted_cutoff
from ou_monitor.online.settings import FilterSettings
from ou_monitor.recordings.read import read_recording
from tables import number, table

TRUTH = 'Kalman filter that knows sigma'
FIXED = 'best fixed cutoff in hindsight'
CURVE = "Betaflight's curve, f..2 f, best f in hindsight"
FORM = 'the same filter, best cutoff for each true sigma in hindsight'
_LEVELS = 8
WINDOWS = (0.25, 0.5, 1.0, 2.0)
# Candidates of what is chosen in hindsight.
_FIXED, _CURVES = 41, 21


@dataclass(frozen=True, eq=False)
class Result:
    """
    Of one case.

    Attributes
    ----------
    name : str
        Case.
    errors : dict of str to ndarray, shape (flights,)
        Mean square error.
    lags : dict of str to float
        ms.
    cutoffs : dict of str to (float, float)
        5 % and 95 % quantile, Hz.

    """

    name: str
    errors: dict[str, np.ndarray]
    lags: dict[str, float]
    cutoffs: dict[str, tuple[float, float]]


def score(case: Case, flights: Flights, seen: np.ndarray, best: np.ndarray) -> Result:
    """Run every method on flights; `best` is the estimate that knows the truth."""
    errors = {TRUTH: methods.error(best, flights.truth)}
    lags = {TRUTH: methods.lag_ms(best, flights.truth)}
    cutoffs: dict[str, tuple[float, float]] = {}

    def keep(name: str, output: np.ndarray, cutoff: np.ndarray) -> None:
        errors[name] = methods.error(output, flights.truth)
        lags[name] = methods.lag_ms(output, flights.truth)
        settled = cutoff[..., int(methods.SETTLE * RATE):] if cutoff.ndim > 1 else cutoff
        cutoffs[name] = (float(np.quantile(settled, 0.05)), float(np.quantile(settled, 0.95)))

    x, order, (fmin, fmax) = flights.measured, case.order, case.limits
    fixed = np.geomspace(fmin, fmax, _FIXED)
    outputs = methods.sweep(x, fixed[:, None, None], order)
    chosen = _least(methods.error(outputs, flights.truth))
    keep(FIXED, _taken(outputs, chosen), fixed[chosen])
    middle = float(np.median(fixed[chosen]))
    # One octave is in the curve itself, so both may use the whole range.
    curves = np.minimum(methods.curve(flights.throttle, np.geomspace(fmin, fmax / 2.0, _CURVES)),
                        fmax)
    outputs = methods.sweep(x, curves, order)
    chosen = _least(methods.error(outputs, flights.truth))
    keep(CURVE, _taken(outputs, chosen), _taken(curves, chosen))
    del outputs, curves
    keep('threshold, an octave either side of it',
         *methods.adaptive(methods.threshold(case, middle), flights, seen, x))
    for law, variants in methods.laws(case).items():
        runs = [methods.adaptive(options, flights, seen, x) for options in variants]
        keep(law, *runs[0])
        if len(runs) > 1:
            chosen = _least(np.array([methods.error(y, flights.truth) for y, _ in runs]))
            keep(f'{law}, its parameter in hindsight',
                 *(_taken(np.array([run[k] for run in runs]), chosen) for k in range(2)))
    for name, options in methods.mistaken(case).items():
        keep(name, *methods.adaptive(options, flights, seen, x))
    # The law alone, without estimator and smoothing: what its form is worth.
    settings = FilterSettings.from_options(methods.laws(case)['wiener'][0])
    grid = np.geomspace(flights.sigma.min(), flights.sigma.max() * 1.0001, 200)
    wanted = [wanted_cutoff(settings, float(s), case.alpha, 0.5, 1.0 / RATE) for s in grid]
    exact = np.exp(np.interp(np.log(flights.sigma), np.log(grid), np.log(wanted)))
    keep('wiener, told the true sigma', methods.sweep(x, exact[None], order)[0], exact)
    # The form of the filter alone: of many cutoffs the best for each sigma, by trial.
    keep(FORM, *_by_level(flights, methods.sweep(x, fixed[:, None, None], order), fixed, order))
    return Result(case.name, errors, lags, cutoffs)


def _least(found: np.ndarray) -> np.ndarray:
    """Return the candidate of the least error of each flight, from (candidates, flights)."""
    chosen: np.ndarray = np.argmin(found, axis=0)
    return chosen


def _taken(outputs: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    taken: np.ndarray = outputs[chosen, np.arange(chosen.size)]
    return taken


def _by_level(flights: Flights, outputs: np.ndarray, fixed: np.ndarray, order: int,
              ) -> tuple[np.ndarray, np.ndarray]:
    """Return output and cutoff of a law found by trial: the best cutoff in each band of sigma."""
    first = int(methods.SETTLE * RATE)
    log = np.log(flights.sigma)
    edges = np.quantile(log[:, first:], np.linspace(0.0, 1.0, _LEVELS + 1))
    centres, best = [], []
    for low, high in zip(edges, edges[1:]):
        inside = (log >= low) & (log <= high)
        inside[:, :first] = False
        if inside.any():
            lost = [np.mean((y[inside] - flights.truth[inside])**2) for y in outputs]
            centres.append(float(log[inside].mean()))
            best.append(math.log(fixed[int(np.argmin(lost))]))
    places = np.argsort(centres)
    cutoff = np.exp(np.interp(log, np.array(centres)[places], np.array(best)[places]))
    return methods.sweep(flights.measured, cutoff[None], order)[0], cutoff


def errors(flights: int, seconds: float, seed: int, window: float,
           tell: Callable[[str], None]) -> list[Result]:
    """Run all cases."""
    results = []
    for number_, case in enumerate(CASES):
        tell(case.name)
        flown = fly(case, np.random.default_rng([seed, number_]), flights, seconds)
        off = methods.agrees(case, flown)
        if off > 1e-9:
            raise SystemExit(f'the vectorized filter is off by {off:g}: the comparison is void')
        results.append(score(case, flown, methods.estimates(flown, window),
                             kalman(case, flown)[0]))
    return results


def windows(flights: int, seconds: float, seed: int, tell: Callable[[str], None]) -> str:
    """Return how the error of the law `kalman` depends on the estimator's window."""
    rows = []
    for place, case in enumerate(CASES):
        flown = fly(case, np.random.default_rng([seed, place]), flights, seconds)
        best = methods.error(kalman(case, flown)[0], flown.truth)
        fixed = methods.error(methods.sweep(
            flown.measured, np.geomspace(*case.limits, _FIXED)[:, None, None], case.order),
            flown.truth).min(axis=0)
        for window in WINDOWS:
            tell(f'{case.name}, window {window:g} s')
            seen = methods.estimates(flown, window)
            known = float(np.isfinite(seen[0, :, int(methods.SETTLE * RATE):]).mean())
            output, _ = methods.adaptive(methods.laws(case)['kalman'][0], flown, seen,
                                         flown.measured)
            found = methods.error(output, flown.truth)
            rows.append([case.name, f'{window:g}', _ratio(found, best), _ratio(found, fixed),
                         f'{100.0 * known:.0f} %'])
    return table(['case', 'window, s', 'MSE over truth-knowing', 'MSE over best fixed',
                  'sigma known'], rows)


def bags(folder: Path, seed: int, window: float, tell: Callable[[str], None]) -> list[Result]:
    """Filter the voltage of the bags, with the noise of a poor ADC added: the bag is the truth."""
    import yaml
    results = []
    for name in ('flight', 'load_40'):
        tell(name)
        recording = read_recording(folder / name)
        truth = yaml.safe_load((folder / name / 'truth.yaml').read_text())['parameters']
        every = max(1, round((recording.n - 1) / recording.duration / RATE))
        voltage = recording.voltage[::every][None]
        throttle = np.nan_to_num(recording.throttle[::every])[None]
        if 'sigma_by_throttle' in truth:
            at, values = np.array(truth['sigma_by_throttle']).T
            sigma = np.interp(throttle, at, values)
            level = truth['u0'] - truth['sag'] * throttle
        else:
            sigma = np.full(throttle.shape, truth['sigma'])
            level = np.full(throttle.shape, truth['u0'])
        rng = np.random.default_rng([seed, len(name)])
        white = ADC * rng.standard_normal(voltage.shape)
        t = np.arange(voltage.shape[1]) / RATE
        flown = Flights(t, throttle, sigma, voltage + white, voltage,
                        np.full(voltage.shape, np.nan), voltage + white, white)
        case = Case(f'bags/{name}', 'voltage', truth['alpha'], 0.0, 1, (2.0, 400.0))
        centred = Flights(t, throttle, sigma, flown.voltage, voltage - level + 5.0, flown.slope,
                          voltage + white - level + 5.0, white)
        best = kalman(case, centred)[0] + level - 5.0
        results.append(score(case, flown, methods.estimates(flown, window), best))
    return results


def render(results: list[Result]) -> str:
    """Return a table for each case."""
    parts = []
    for one in results:
        best, fixed = one.errors[TRUTH], one.errors[FIXED]
        rows = []
        for name, found in one.errors.items():
            low, high = one.cutoffs.get(name, (math.nan, math.nan))
            rows.append([
                name, f'{math.sqrt(found.mean()):.4g}', _ratio(found, best),
                _ratio(found, fixed), number(one.lags[name], '.1f'),
                f'{low:.3g}..{high:.3g}' if math.isfinite(low) else '-'])
        parts.append(f'**{one.name}** ({best.size} flight{"s" * (best.size > 1)})\n\n' + table(
            ['filter', 'rms error', 'MSE over truth-knowing', 'MSE over best fixed', 'lag, ms',
             'cutoff 5..95 %, Hz'], rows))
    return '\n'.join(parts)


def _ratio(found: np.ndarray, to: np.ndarray) -> str:
    """Return the geometric mean of the ratios with its standard error."""
    log = np.log(found / to)
    if log.size < 2 or not log.any():
        return f'{math.exp(log.mean()):.3f}'
    se = math.exp(log.mean()) * log.std(ddof=1) / math.sqrt(log.size)
    return f'{math.exp(log.mean()):.3f} ± {se:.3f}'
