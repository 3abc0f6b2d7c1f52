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
from filter_signals import ADC, Case, CASES, Flights, fly, kalman, RATE, SPREAD
import numpy as np
from ou_monitor.online.filter.cutoff_laws import wanted_cutoff
from ou_monitor.online.settings import FilterSettings
from ou_monitor.recordings.read import read_recording
from ou_monitor.report.svg import Plot
from tables import number, table

TRUTH = 'Kalman filter that knows sigma'
FIXED = 'best fixed cutoff in hindsight'
CURVE = "Betaflight's curve, f..2 f, best f in hindsight"
FORM = 'the same filter, best cutoff for each true sigma in hindsight'
_LEVELS = 8
WINDOWS = (0.25, 0.5, 1.0, 2.0)
# Candidates of what is chosen in hindsight.
_FIXED, _CURVES = 41, 21


CASE = Case('D term of a body rate of two poles at 5 Hz, alpha 600', 'smooth', 600.0, 5.0, 2,
            (20.0, 150.0), coupling=2.0)
FIXED_CUTOFF, CURVE_CUTOFF, SWITCH = 'fixed', "Betaflight's curve, f..2 f", 'threshold, f/2..f'
CONSTANT, KALMAN = 'constant_noise', 'kalman'
# Cutoffs, Hz, and wanted noise, rad/s^2.
_CUTOFFS, _BASES = np.geomspace(15.0, 200.0, 28), (15.0, 25.0, 40.0, 60.0, 75.0, 90.0)
_LAGS = (0.0, 30.0, 20.0, 12.0)
_TOPS, _WANTED = (40.0, 70.0, 110.0, 150.0), (4.0, 7.0, 12.0, 20.0, 30.0)


@dataclass(frozen=True)
class Point:
    """
    One setting of one method.

    Attributes
    ----------
    method, setting : str
        What and how.
    noise, loud, lag, rms_error : float
        Rms of the noise that comes out and that of the loudest second in
        twenty, rad/s^2; delay of the signal, ms; rms of output less the true
        derivative, rad/s^2.
    low, high : float
        5 % and 95 % quantile of the cutoff, Hz.

    """

    method: str
    setting: str
    noise: float
    loud: float
    lag: float
    rms_error: float
    low: float = math.nan
    high: float = math.nan


def run_dterm(flights: int, seconds: float, seed: int, window: float,
              tell: Callable[[str], None]) -> list[Point]:
    """Return the points of all methods."""
    flown = fly(CASE, np.random.default_rng([seed, 100]), flights, seconds)
    off = methods.agrees(CASE, flown)
    if off > 1e-9:
        raise SystemExit(f'the vectorized filter is off by {off:g}: the comparison is void')
    seen = methods.estimates(flown, window)
    points = []

    def keep(method: str, setting: str, noise: np.ndarray, signal: np.ndarray,
             cutoff: np.ndarray) -> None:
        points.append(_point(method, setting, flown, noise, signal, cutoff))

    tell(FIXED_CUTOFF)
    for name, cutoffs, settings in (
            (FIXED_CUTOFF, _CUTOFFS[:, None, None], [f'{f:.0f} Hz' for f in _CUTOFFS]),
            (CURVE_CUTOFF, methods.curve(flown.throttle, np.array(_BASES)),
             [f'{f:g}..{2 * f:g} Hz' for f in _BASES])):
        noises = methods.sweep(flown.noise, cutoffs, 2, True)
        signals = methods.sweep(flown.truth, cutoffs, 2, True)
        for k, setting in enumerate(settings):
            keep(name, setting, noises[k], signals[k], cutoffs[k])
        del noises, signals
    middle = SPREAD * math.sqrt(2.0 * CASE.alpha)
    base = {'mode': 'derivative', 'order': 2, 'alpha': CASE.alpha}
    runs = [(SWITCH, f'{0.5 * f:g}..{f:g} Hz', {
        **base, 'law': 'threshold', 'fmin': 0.5 * f, 'fmax': f, 'sigma_ref': middle})
        for f in _TOPS]
    runs += [(CONSTANT, f'{w:g} rad/s^2', {
        **base, 'law': 'constant_noise', 'fmin': 10.0, 'fmax': 300.0,
        'coupling': CASE.coupling, 'noise_wanted': w}) for w in _WANTED]
    for name, setting, options in runs:
        tell(f'{name}, {setting}')
        noise, cutoff = methods.adaptive(options, flown, seen, flown.noise)
        keep(name, setting, noise,
             methods.sweep(flown.truth, cutoff[None], 2, True)[0], cutoff)
    for limit in _LAGS:
        options = {**base, 'law': 'kalman', 'coupling': CASE.coupling, 'fmin': 5.0,
                   'fmax': 300.0, 'max_lag': limit, 'n0': CASE.white**2 / RATE}
        setting = f'lag <= {limit:g} degrees' if limit else 'free'
        tell(f'{KALMAN}, {setting}')
        # It learns from powers, which are the same to sampling error with the noise turned over:
        # half the difference of both is the noise, half the sum the signal.
        both, cutoff = methods.adaptive(options, flown, seen, flown.truth + flown.noise)
        other, _ = methods.adaptive(options, flown, seen, flown.truth - flown.noise)
        keep(KALMAN, setting, 0.5 * (both - other), 0.5 * (both + other), cutoff)
    slope = kalman(CASE, flown)[1]
    points.append(Point('Kalman filter that knows sigma', '-', math.nan, math.nan,
                        methods.lag_ms(slope, flown.slope),
                        float(np.sqrt(methods.error(slope, flown.slope).mean()))))
    return points


def _point(method: str, setting: str, flown: Flights, noise: np.ndarray, signal: np.ndarray,
           cutoff: np.ndarray) -> Point:
    first, second = int(methods.SETTLE * RATE), int(RATE)
    rest = noise[:, first:]
    pieces = rest[:, :rest.shape[1] // second * second].reshape(-1, second)
    settled = cutoff[..., first:] if cutoff.shape[-1] > 1 else cutoff
    return Point(
        method, setting, float(np.sqrt(np.mean(rest**2))),
        float(np.quantile(np.sqrt(np.mean(pieces**2, axis=1)), 0.95)),
        methods.lag_ms(signal, flown.slope),
        float(np.sqrt(methods.error(noise + signal, flown.slope).mean())),
        float(np.quantile(settled, 0.05)), float(np.quantile(settled, 0.95)))


def render_dterm(points: list[Point]) -> tuple[str, Plot]:
    """Return a table and a figure."""
    fixed = [p for p in points if p.method == FIXED_CUTOFF]
    lags = np.array([p.lag for p in fixed])
    order = np.argsort(lags)

    def at(lag: float, what: str) -> float:
        values = np.log([getattr(p, what) for p in fixed])
        if not lags.min() <= lag <= lags.max():
            return math.nan
        return math.exp(float(np.interp(lag, lags[order], values[order])))

    least = min(fixed, key=lambda p: p.rms_error)
    rows = []
    for p in (least, *(p for p in points if p.method != FIXED_CUTOFF)):
        rows.append([p.method, p.setting, number(p.lag, '.1f'), number(p.noise, '.3g'),
                     number(p.noise / at(p.lag, 'noise'), '.2f'), number(p.loud, '.3g'),
                     number(p.loud / at(p.lag, 'loud'), '.2f'), number(p.rms_error, '.3g'),
                     f'{p.low:.0f}..{p.high:.0f}' if math.isfinite(p.low) else '-'])
    plot = Plot('D term: noise of the loudest second in twenty against lag', 'lag, ms',
                'rms of the noise, rad/s^2', width=760, height=360, log_y=True)
    for colour, name in enumerate((FIXED_CUTOFF, CONSTANT, SWITCH, CURVE_CUTOFF, KALMAN)):
        found = sorted((p for p in points if p.method == name), key=lambda p: p.lag)
        x = np.array([p.lag for p in found])
        plot.line(x, np.array([p.loud for p in found]), name, colour, 'thick')
        if name != FIXED_CUTOFF:
            plot.markers(x, np.array([p.loud for p in found]), '', colour)
    return table(['method', 'setting', 'lag, ms', 'noise, rad/s^2', 'over fixed of that lag',
                  'loudest second', 'over fixed of that lag', 'rms error', 'cutoff 5..95 %, Hz'],
                 rows), plot


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
