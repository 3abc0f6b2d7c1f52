"""
A recording -> Tables 1 and 2 of the paper, with intervals, tests and curves over throttle.

Risk and sliding estimates need no constant throttle: `SupplyMonitor` computes them as in flight,
so that command and node agree, and with the monitor's limits.  The risk is for the end of the
recording; 0.1 or more above the highest throttle flown, it is NaN.

`as_data` returns the JSON of `analyze`; see doc/analysis.md.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.crafts import Craft, craft_of
from ou_monitor.analysis.level_result import (
    fit_all, fit_level, judge_levels, LevelResult, ProcessType)
from ou_monitor.analysis.level_tests import alpha_constancy, AlphaTest, EFFECT, LEAST, LEVEL
from ou_monitor.analysis.levels import find_levels, LoadLevel
from ou_monitor.analysis.noise import flown_near, remainder, THROTTLES, without_wild
from ou_monitor.analysis.overview import Overview, overview
from ou_monitor.analysis.quality import noise_items, quality_list, QualityItem
from ou_monitor.analysis.supply import alarms, Dips, fed, node_for
from ou_monitor.criticism.innovations import FAMILY_WISE
from ou_monitor.model.sinusoid import FALSE_ALARM
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.courses import throttle_gap
from ou_monitor.online.settings import DEFAULT_LIMIT, MonitorSettings, RAIL
from ou_monitor.records import Estimate, FloatArray, NAN, Recording
from ou_monitor.text import Z95
from ou_monitor.timeline import pause_words, readings_of, supplied

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Analysis:
    """Result of `analyze`."""

    recording: Recording
    levels: tuple[LevelResult, ...]  # In order of throttle
    alpha_test: AlphaTest  # Whether alpha is the same at all levels
    by_throttle: ByThrottle  # Risk over throttle
    sliding: Sliding  # Estimates and risk of the node over time
    quality: tuple[QualityItem, ...]  # Cautions about the numbers, worst first
    brownout_default: bool  # No limit was given: the node's default for a 5 V rail, else no limit
    notes: tuple[str, ...]  # What was dropped or left out, one sentence each
    overview: Overview  # Lowest voltage, dips, sag and noise
    craft: Craft  # Cells, and a comparison with known craft
    alarms: tuple[Dips, ...]  # Dips below usual alarms per cell; empty if cells are unknown


def analyze(recording: Recording, *, levels: tuple[float, ...] | None = None,
            window: float = 2.0, brownout_voltage: float | None = None,
            brownout_horizon: float = 5.0, cells: int = 0,
            progress: Progress | None = None) -> Analysis:
    """Analyse a recording load level by load level (window and horizon in s, voltage in V)."""
    # cells: number of cells in series, for the voltage per cell; 0: not given.
    report: Progress = progress or (lambda share: None)
    all_of_it = readings_of(recording)
    recording = supplied(all_of_it)
    voltage = _default_voltage(recording) if brownout_voltage is None else brownout_voltage
    raw = remainder(recording)
    recording, left = without_wild(recording, raw)
    found = find_levels(recording.t, recording.throttle, levels)
    results = []
    whole = cache(lambda: fit_all(recording, left, found)) if len(found) > 1 else None
    for k, level in enumerate(found):
        results.append(fit_level(recording, left, level, len(found), whole))
        report(0.5 * (k + 1) / len(found))
    sliding = slide(recording, window, voltage, brownout_horizon,
                    lambda share: report(0.5 + 0.5 * share))
    judged = judge_levels(results)
    seen = overview(all_of_it, None if math.isnan(voltage) else voltage, judged, cells,
                    raw, sliding.monitor)
    throttles = [level.throttle for level in judged]
    estimates = [level.estimate for level in judged]
    # A second relaxation biases alpha even at levels where it is too weak to be detected.
    wanders = any(level.wanders for level in judged)
    alpha = alpha_constancy(throttles, estimates,
                            [wanders or level.doubted for level in judged])
    craft = craft_of(recording, seen.facts, cells)
    return Analysis(
        recording, judged, alpha,
        by_throttle(recording, seen, voltage, brownout_horizon), sliding,
        quality_list(recording, throttles, estimates,
                     [item for name, at in (
                         ('LINES_LEFT_IN', [one for one in judged if one.lines_kept]),
                         ('SECOND_RELAXATION', [one for one in judged if one.wanders]),
                         ('IMPULSES', [one for one in judged if one.estimate.usable
                                       and one.verdict.within is ProcessType.IMPULSES]))
                         for item in noise_items(name, [one.throttle for one in at])],
                     seen.facts.ou.status == 'ok', pause_words(all_of_it.t)),
        brownout_voltage is None, recording.notes + _left_out(recording, found), seen,
        craft, alarms(all_of_it, craft.cells, seen.facts.noise))


def _default_voltage(recording: Recording) -> float:
    """Return the default of the node, V, for a 5 V rail; NaN for other supplies."""
    low, high = RAIL
    middle = float(np.median(recording.voltage)) if recording.n else NAN
    return DEFAULT_LIMIT if low <= middle <= high else NAN


def _left_out(recording: Recording, found: tuple[LoadLevel, ...]) -> tuple[str, ...]:
    if not recording.n:
        return ('The recording holds no samples.',)
    if not recording.has_throttle:
        return ('The recording has no throttle: it is taken as one load level.',)
    if any(math.isnan(level.throttle) for level in found):
        return ('No throttle was held long enough for a load level: the whole recording is taken '
                'as one level, without its response to throttle. --levels can name levels.',)
    step = float(np.median(np.diff(recording.t))) if recording.n > 1 else 0.0
    held = sum(float(recording.t[s.stop - 1] - recording.t[s.start]) + step
               for level in found for s in level.segments)
    settling = sum(level.settling for level in found)
    notes = []
    unknown = int(np.isnan(recording.throttle).sum())
    if unknown:
        notes.append(f'{unknown} samples without throttle belong to no load level.')
    if settling > 0.0:
        notes.append(f'The levels leave out {settling:.3g} s in which the voltage settled after '
                     'changes of throttle.')
    moving = recording.duration - held - settling
    if moving > 0.01 * recording.duration:
        notes.append(f'{moving:.3g} of {recording.duration:.3g} s were spent between load '
                     'levels.')
    return tuple(notes)


@dataclass(frozen=True, eq=False)
class Sliding:
    """Sliding estimates of a whole recording."""

    window: float  # Length of the window, s
    t: FloatArray  # Stamps of the newest sample of each window, s; shape (k,)
    estimates: tuple[Estimate, ...]  # One for each stamp; unusable ones have NaN
    risk: FloatArray  # Probability of a brown-out within the horizon; NaN if unknown; shape (k,)
    # Voltage, V, and horizon, s, of the risk.
    brownout_voltage: float
    brownout_horizon: float
    monitor: SupplyMonitor | None  # State at the end of the recording; None without a limit

    def series(self, name: str) -> FloatArray:
        """Return one field of the estimates as an array."""
        return np.array([getattr(e, name) for e in self.estimates], dtype=np.float64)

    def interval(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the 95 % intervals of a field."""
        value = self.series(name)
        factor = np.exp(Z95 * self.series(name + '_se'))
        return value / factor, value * factor


def slide(recording: Recording, window: float, brownout_voltage: float = NAN,
          brownout_horizon: float = 5.0,
          progress: Callable[[float], None] | None = None) -> Sliding:
    """Run the node's monitor (without a limit, only its estimator) over a recording (s, V)."""
    if not (math.isfinite(brownout_horizon) and brownout_horizon > 0.0):
        raise ValueError(f'the horizon must be a positive number of seconds, got '
                         f'{brownout_horizon}')
    t, duration = recording.t, recording.duration
    monitor, estimator = None, SlidingEstimator(window)
    if math.isfinite(brownout_voltage):
        monitor, parts = node_for(recording, MonitorSettings(
            window=window, brownout_horizon=brownout_horizon, brownout_voltage=brownout_voltage))
    else:
        # Without a limit there is no risk, and the node's forecasts are not needed.
        parts = fed(recording, window, lambda part: estimator.push(
            t[part], recording.voltage[part], recording.throttle[part]))
    found: list[tuple[Estimate, float]] = []
    for now, shown in parts:
        if monitor is None:
            seen = estimator.estimate(), NAN
        else:
            # Reports that are not shown also update the state of the monitor.
            last = monitor.report(0.0, alone=True)
            seen = last.estimate, last.risk
        # Estimates before the first window is full are too poor to show.
        if shown and now >= min(window, 0.5 * duration):
            found.append(seen)
            if progress is not None:
                progress(now / duration)
    return Sliding(window, np.array([estimate.t for estimate, _ in found]),
                   tuple(estimate for estimate, _ in found), np.array([risk for _, risk in found]),
                   brownout_voltage, brownout_horizon, monitor)


@dataclass(frozen=True, eq=False)
class ByThrottle:
    """Curves over throttle."""

    throttle: FloatArray  # 0, 0.1, .. 1; shape (k,)
    # Whether each throttle was flown; if not, its risk is inter- or extrapolated; shape (k,).
    known: npt.NDArray[np.bool_]
    risk: FloatArray  # Probability of a brown-out within the horizon; NaN if unknown; shape (k,)
    budget: float  # Highest throttle that keeps the risk within `limit`; NaN if unknown
    budget_reason: str  # What limits the budget, or why it is unknown
    limit: float  # Maximum risk that defines the budget, 0..1
    # Voltage, V, and horizon, s, of the risk.
    voltage: float
    horizon: float
    time: float  # Stamp of the risk, s; NaN if the recording is shorter than a window

    @property
    def safe(self) -> bool:
        """Return whether any throttle is within the budget, which may be idle."""
        return self.budget > 0.0 or bool(self.risk[0] <= self.limit)


def by_throttle(recording: Recording, found: Overview, voltage: float, horizon: float,
                ) -> ByThrottle:
    """Return the node's risk over throttle (voltage in V, horizon in s)."""
    grid, last = np.array(THROTTLES), found.end
    risk = np.full(grid.size, NAN)
    if last is not None and last.risk_curve:
        # RISK_CURVE has the throttles of `grid`; keep one above the highest flown, to interpolate.
        low, high = throttle_gap(recording.throttle)
        risk = np.where((grid >= found.highest + 0.1) | (grid > low) & (grid < high), NAN,
                        last.risk_curve)
    return ByThrottle(
        grid, flown_near(recording, grid), risk, NAN if last is None else last.budget,
        'No voltage limit was given.' if last is None else last.budget_reason,
        MonitorSettings().budget_limit, voltage, horizon,
        NAN if last is None else last.estimate.t)


def as_data(analysis: Analysis) -> dict[str, Any]:
    """Return an analysis as plain data; NaN stands for unknown."""
    recording, sliding, curves = analysis.recording, analysis.sliding, analysis.by_throttle
    seen, line = analysis.overview, analysis.overview.line
    duration, begin = recording.duration, float(recording.t[0]) if recording.n else math.nan
    return {
        'recording': recording.name,
        'n': recording.n,
        'duration_s': duration,
        'rate_hz': (recording.n - 1) / duration if duration > 0.0 else math.nan,
        'source': dict(recording.source),
        'overview': {
            'load_status': seen.load.status.name, 'level_v': seen.load.level,
            'highest_throttle': seen.highest,
            'strongest_line': None if line is None else {
                'frequency_hz': line.frequency, 'rms_v': line.rms, 'share_of_variance': line.share,
                'level': line.level, 'fundamental_hz': line.fundamental}},
        'levels': [_level(level) for level in analysis.levels],
        'process_tests': {'family_wise_error': FAMILY_WISE, 'adjusted': 'Holm',
                          'effects': {name: {'meaning': EFFECT[name], 'least': LEAST[name]}
                                      for name in EFFECT}},
        'lines': {'false_alarm': FALSE_ALARM},
        'alpha_constant': _alpha(analysis),
        'by_throttle': {
            'throttle': curves.throttle, 'known': curves.known, 'brownout_risk': curves.risk},
        'brownout': {
            'voltage': curves.voltage, 'horizon_s': curves.horizon,
            'voltage_source': 'default' if analysis.brownout_default else 'given',
            'throttle_budget': curves.budget, 'budget_limit': curves.limit,
            'budget_reason': curves.budget_reason, 't': curves.time - begin},
        'sliding': {
            'window_s': sliding.window,
            't': sliding.t - begin,
            **{name: sliding.series(name) for name in (
                'alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'var_inf_se', 'u0')},
            'status': [e.status.name for e in sliding.estimates],
            'brownout_voltage': sliding.brownout_voltage,
            'brownout_horizon_s': sliding.brownout_horizon,
            'brownout_risk': sliding.risk,
        },
        'quality': [{'name': item.name, 'severity': item.severity.name.lower(),
                     'text': item.text, 'throttles': list(item.throttles)}
                    for item in analysis.quality],
        'craft': analysis.craft.to_dict(), 'alarms': [vars(one) for one in analysis.alarms],
        'notes': list(analysis.notes),
    }


def _level(level: LevelResult) -> dict[str, Any]:
    e, shape = level.estimate, level.shape
    alpha_low, alpha_high = e.interval('alpha')
    rate, rate_low, rate_high = shape.impulse_rate
    return {
        'throttle': level.throttle,
        'segments': len(level.segments),
        'time_s': level.time,
        'n': level.n,
        'mean': level.mean,
        'vpp': level.vpp,
        'peak': level.peak,
        'vrms': level.vrms,
        'crest': level.crest,
        'alpha': e.alpha, 'alpha_se': e.alpha_se, 'alpha_ci95': [alpha_low, alpha_high],
        'tau': e.tau, 'tau_se': e.alpha_se, 'tau_ci95': [1.0 / alpha_high, 1.0 / alpha_low],
        'sigma': e.sigma, 'sigma_se': e.sigma_se, 'sigma_ci95': list(e.interval('sigma')),
        'var_inf': e.var_inf, 'var_inf_se': e.var_inf_se,
        'var_inf_ci95': list(e.interval('var_inf')),
        'tau_below_s': level.ou.tau_below_s, 'var_inf_below': level.ou.var_inf_below,
        'u0': e.u0, 'u0_se': e.u0_se,
        'noise_std': e.noise_std,
        'process_type': level.kind.value,
        'process_within': level.verdict.within.value,
        'process_reason': level.verdict.sentence,
        'process_tests': [{'name': test.name, 'p_value': test.p_value,
                           'p_adjusted': test.p_adjusted, 'effect': test.effect,
                           'rejects': test.rejects, 'not_done': test.why_not}
                          for test in shape.tests],
        'skewness': shape.skewness,
        'excess_kurtosis': shape.kurtosis,
        'impulses': shape.impulses,
        'impulse_rate_hz': rate, 'impulse_rate_ci95': [rate_low, rate_high],
        'lines': [{'frequency_hz': line.frequency, 'resolution_hz': line.resolution,
                   'rms': line.rms, 'rms_ci95': [line.rms_low, line.rms_high],
                   'share_of_variance': line.share, 'p_value': line.p_value}
                  for line in level.lines.lines],
        'line_search': {'from_hz': level.lines.lowest, 'to_hz': level.lines.highest,
                        'tested': level.lines.tested, 'detectable_rms': level.lines.detectable,
                        'not_done': level.lines.why_not},
        'psd': {'frequency_hz': level.spectrum.frequency, 'measured': level.spectrum.density,
                'fitted': level.spectrum.fitted},
        'status': e.status.name,
        'status_text': e.status.value,
        'flags': [{'name': flag.name, 'text': flag.value} for flag in e.flags],
    }


def _alpha(analysis: Analysis) -> dict[str, Any]:
    test = analysis.alpha_test
    return {
        'verdict': test.verdict, 'level': LEVEL, 'levels': test.levels,
        'alpha': test.alpha, 'alpha_se': test.alpha_se,
        'chi2': test.statistic, 'p_value': test.p_value,
        'ratio': test.ratio, 'ratio_ci95': [test.ratio_low, test.ratio_high],
        'detectable_ratio': test.detectable_ratio, 'withheld': list(test.withheld),
        'sentence': test.sentence}
