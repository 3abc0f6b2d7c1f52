"""An analysis as plain data: the JSON of `analyze`, see doc/analysis.md."""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.analysis.analyze import Analysis
from ou_monitor.analysis.level_comparison import LEVEL
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.level_tests import EFFECT, LEAST
from ou_monitor.analysis.overview import Overview
from ou_monitor.analysis.relaxation import Relaxation, ReleaseCause
from ou_monitor.criticism.innovations import FAMILY_WISE
from ou_monitor.model.spectral_lines import FALSE_ALARM


def as_data(analysis: Analysis) -> dict[str, Any]:
    """Return an analysis as plain data; NaN stands for unknown."""
    recording = analysis.recording
    sliding = analysis.sliding
    duration = recording.duration
    return {
        'recording': recording.name,
        'n': recording.n,
        'duration_s': duration,
        'rate_hz': (recording.n - 1) / duration if duration > 0.0 else math.nan,
        'source': dict(recording.source),
        'overview': _overview(analysis.overview),
        'levels': [_level(level) for level in analysis.levels],
        'process_tests': {'family_wise_error': FAMILY_WISE, 'adjusted': 'Holm',
                          'effects': {name: {'meaning': EFFECT[name], 'least': LEAST[name]}
                                      for name in EFFECT}},
        'lines': {'false_alarm': FALSE_ALARM},
        'transients': [_relaxation(fit, cause)
                       for fit, cause in zip(analysis.relaxations, analysis.causes)],
        'alpha_constant': _alpha(analysis),
        'by_throttle': _by_throttle(analysis),
        'brownout': _brownout(analysis),
        'sliding': {
            'window_s': sliding.window,
            't': sliding.t,
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
        'craft': analysis.craft.to_dict(),
        'notes': list(analysis.notes),
    }


def _overview(found: Overview) -> dict[str, Any]:
    line = found.line
    return {
        'load_status': found.load.status.name, 'level_v': found.load.level,
        'highest_throttle': found.highest,
        'strongest_line': None if line is None else {
            'frequency_hz': line.frequency, 'rms_v': line.rms, 'share_of_variance': line.share,
            'level': line.level},
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
        'sag': level.sag.sag, 'sag_se': level.sag.sag_se, 'sag_ci95': list(level.sag.interval),
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
        'with_lines': None if level.with_lines is None else {
            name: getattr(level.with_lines, name) for name in ('alpha', 'sigma', 'var_inf')},
        'line_search': {'from_hz': level.lines.lowest, 'to_hz': level.lines.highest,
                        'tested': level.lines.tested, 'detectable_rms': level.lines.detectable,
                        'not_done': level.lines.why_not},
        'psd': {'frequency_hz': level.spectrum.frequency, 'measured': level.spectrum.density,
                'fitted': level.spectrum.fitted},
        'status': e.status.name,
        'status_text': e.status.value,
        'flags': [{'name': flag.name, 'text': flag.value} for flag in e.flags],
    }


def _relaxation(fit: Relaxation, cause: ReleaseCause) -> dict[str, Any]:
    return {
        'kind': fit.kind,
        'tau': fit.tau, 'tau_ci95': [fit.tau_low, fit.tau_high],
        'misfit': fit.misfit, 'misfit_p_value': fit.misfit_p, 'badly_fitted': fit.badly_fitted,
        'left_out_s': fit.left_out, 'likelihood_gain': fit.likelihood_gain,
        'tau_alpha': cause.ratio, 'tau_alpha_ci95': [cause.ratio_low, cause.ratio_high],
        'tau_alpha_p_value': cause.p_value,
        'against_noise': cause.noise,
        'instrument': cause.instrument,
        'instrument_corner_hz': cause.corner,
        'level_step': cause.step, 'level_step_se': cause.step_se,
        'sentence': f'{fit.caveat} {cause.sentence}'.strip(),
        'changes': [{
            't': change.t, 'throttle_before': change.throttle_before,
            'throttle_after': change.throttle_after, 'level_before': change.level_before,
            'level_before_se': change.level_before_se, 'level': change.level,
            'level_se': change.level_se, 'amplitude': change.amplitude,
            'amplitude_se': change.amplitude_se, 'beyond': change.beyond,
            'beyond_p_value': change.beyond_p, 'duration_s': change.duration, 'n': change.n}
            for change in fit.releases],
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


def _by_throttle(analysis: Analysis) -> dict[str, Any]:
    curves = analysis.by_throttle
    return {
        'throttle': curves.throttle, 'known': curves.known,
        'sag': curves.sag, 'sag_low': curves.sag_low, 'sag_high': curves.sag_high,
        'noise': curves.noise,
        'brownout_risk': curves.risk}


def _brownout(analysis: Analysis) -> dict[str, Any]:
    curves = analysis.by_throttle
    return {
        'voltage': curves.voltage, 'horizon_s': curves.horizon,
        'voltage_source': 'default' if analysis.brownout_default else 'given',
        'throttle_budget': curves.budget, 'budget_limit': curves.limit,
        'budget_reason': curves.budget_reason, 't': curves.time}
