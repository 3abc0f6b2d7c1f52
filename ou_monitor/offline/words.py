"""An analysis in words and in plain data: headline, status lines, JSON."""

from __future__ import annotations

import math
from typing import Any

from ou_monitor.offline.analyze import Analysis, LevelResult
from ou_monitor.records import Estimate, Status

NOISE_UNKNOWN = (
    'White noise of the sensor is not told from the supply here: where there is some, alpha '
    'and sigma come out too high (Var_inf does not).')


def number(value: float, digits: int = 3) -> str:
    """
    Return a number to some significant digits, zeros at the end included.

    Parameters
    ----------
    value : float
        The number.
    digits : int
        Significant digits, > 0.

    Returns
    -------
    str
        ``-`` when it is not finite.

    """
    if not math.isfinite(value):
        return '-'
    if value == 0.0:
        return '0'
    # By way of the exponent form, which rounds first: 99.96 is 1.00e+02.
    mantissa, exponent = f'{value:.{digits - 1}e}'.split('e')
    size = int(exponent)
    if -3 <= size < 6:
        return f'{value:.{max(0, digits - 1 - size)}f}'
    return f'{mantissa}e{size}'


def headline(analysis: Analysis) -> str:
    """
    Return what the recording says, one or two sentences.

    Parameters
    ----------
    analysis : Analysis
        Result.

    Returns
    -------
    str
        With numbers and 95 % intervals.

    """
    good = ([level for level in analysis.levels if level.estimate.status is Status.OK]
            or [level for level in analysis.levels if level.estimate.usable])
    if not good:
        return ('No load level of this recording can be fitted: see the status of each level '
                'for the reason.')
    low, high = good[0], good[-1]
    if len(good) == 1:
        e = low.estimate
        where = '' if math.isnan(low.throttle) else f' at {low.label} throttle'
        return (f'The supply{where} wanders with sigma = {_ci(e)} V/sqrt(s) and '
                f'relaxes in tau = {_tau(e)} ms: a standard deviation of '
                f'{number(1e3 * math.sqrt(e.var_inf))} mV.')
    growth = high.estimate.sigma / low.estimate.sigma
    spread = 1.96 * math.hypot(low.estimate.sigma_se, high.estimate.sigma_se)
    factor = (f'factor {number(growth)}, 95 % {number(growth * math.exp(-spread))} to '
              f'{number(growth * math.exp(spread))}')
    if abs(math.log(growth)) <= spread:
        change = (f'sigma does not change measurably from {low.label} to {high.label} throttle '
                  f'({factor})')
    else:
        verb = 'grows' if growth > 1.0 else 'falls'
        change = (f'sigma {verb} from {number(low.estimate.sigma)} to '
                  f'{number(high.estimate.sigma)} V/sqrt(s) from {low.label} to {high.label} '
                  f'throttle ({factor})')
    return (f'{change[0].upper()}{change[1:]}. At {high.label} the supply relaxes in tau = '
            f'{_tau(high.estimate)} ms, with a standard deviation of '
            f'{number(1e3 * math.sqrt(high.estimate.var_inf))} mV.')


def _ci(e: Estimate) -> str:
    low, high = e.interval('sigma')
    return f'{number(e.sigma)} (95 % {number(low)} to {number(high)})'


def _tau(e: Estimate) -> str:
    low, high = e.interval('alpha')
    return f'{number(1e3 / e.alpha)} (95 % {number(1e3 / high)} to {number(1e3 / low)})'


def cautions(analysis: Analysis) -> list[str]:
    """
    Return what to know before using the numbers.

    Parameters
    ----------
    analysis : Analysis
        Result.

    Returns
    -------
    list of str
        Sentences (status unless it is good, flags, notes), each led by the
        levels it is true of.

    """
    where: dict[str, list[str]] = {}
    for level in analysis.levels:
        status = level.estimate.status
        for text in [*([] if status is Status.OK else [status.value]),
                     *[flag.value for flag in level.estimate.flags], *level.notes]:
            where.setdefault(text, []).append(level.label)
        # Measured at 20 mV of noise beside 56 mV of OU, 1 kHz: alpha +194 %.
        if level.estimate.usable and math.isnan(level.estimate.noise_std):
            where.setdefault(NOISE_UNKNOWN, []).append(level.label)
    return [f'{", ".join(labels)}: {text}' for text, labels in where.items()]


def as_data(analysis: Analysis) -> dict[str, Any]:
    """
    Return an analysis as plain data; NaN stands for unknown.

    Parameters
    ----------
    analysis : Analysis
        Result.

    Returns
    -------
    dict
        Keys ``recording``, ``n``, ``duration_s``, ``rate_hz``, ``source``,
        ``headline``, ``levels``, ``sliding``, ``notes``.  SI units throughout;
        ``<name>_se`` is the standard error of the logarithm, except
        ``u0_se`` (V); ``<name>_ci95`` is ``[low, high]``.

    """
    recording = analysis.recording
    sliding = analysis.sliding
    duration = recording.duration
    return {
        'recording': recording.name,
        'n': recording.n,
        'duration_s': duration,
        'rate_hz': (recording.n - 1) / duration if duration > 0.0 else math.nan,
        'source': dict(recording.source),
        'headline': headline(analysis),
        'levels': [_level(level) for level in analysis.levels],
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
        'notes': list(analysis.notes),
    }


def _level(level: LevelResult) -> dict[str, Any]:
    e = level.estimate
    alpha_low, alpha_high = e.interval('alpha')
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
        'u0': e.u0, 'u0_se': e.u0_se,
        'noise_std': e.noise_std,
        'excess_kurtosis': level.kurtosis, 'excess_kurtosis_se': level.kurtosis_se,
        'process_type': level.kind.value,
        'process_reason': level.reason,
        'status': e.status.name,
        'status_text': e.status.value,
        'flags': [{'name': flag.name, 'text': flag.value} for flag in e.flags],
        'notes': list(level.notes),
    }
