"""An analysis in words: headline, cautions, sentences of its parts."""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.analysis.analyze import Analysis
from ou_monitor.analysis.level_comparison import sigma_change
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.overview import answers, headline as answer, known_lines
from ou_monitor.analysis.quality import QualityItem, Severity
from ou_monitor.analysis.replay import ByThrottle
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, NAN, Status
from ou_monitor.text import counted, number

# What changes the meaning of the numbers in the headline itself.
_BEWARE = {
    'VOLTAGE_UNIT': 'Beware: the voltages seem to be millivolts or counts, not volts.',
    'TIME_UNIT': 'Beware: the time seems to be in ms or us, not in s.',
    'SECOND_RELAXATION': ('Beware: the noise shows a second relaxation, so tau is that of a '
                          'mixture.'),
    'NOT_SETTLED': ('Beware: the levels, and so tau, include the settling after changes of '
                    'throttle.')}


def headline(analysis: Analysis) -> str:
    """Return what the recording says: what was seen, then sigma and tau where they are known."""
    good = _fitted(analysis)
    beware = ''.join(f' {words}' for name, words in _BEWARE.items()
                     if any(item.name == name for item in analysis.quality))
    numbers = f' {_numbers(good)}' if good else ''
    curves = analysis.by_throttle
    safe = '' if math.isnan(curves.budget) else (
        f' Safe up to {100.0 * curves.budget:.0f} % throttle.' if curves.budget > 0.0 else
        f' No throttle keeps the risk within {curves.horizon:g} s below '
        f'{100.0 * curves.limit:g} %.')
    return answer(analysis.overview) + safe + numbers + beware


def in_short(analysis: Analysis) -> tuple[str, str]:
    """Return the answer and what stands behind it, a line each."""
    first, *others = answers(analysis.overview) or ['The recording holds no samples']
    budget = analysis.by_throttle.budget
    if budget > 0.0:
        others.insert(1, f'safe up to {100.0 * budget:.0f} % throttle')
    if not others:
        others = ['the sag is unknown']
    text = '; '.join(others[:2])
    return f'{first}.', f'{text[0].upper()}{text[1:]}.'


def _budget_words(curves: ByThrottle) -> str:
    """Return the budget, and what a throttle beyond it would risk."""
    if not curves.budget:
        return f'no throttle, held for {curves.horizon:g} s. {curves.budget_reason}'
    words = (f'{100.0 * curves.budget:.0f} % throttle, held for {curves.horizon:g} s: the risk of '
             f'falling below {curves.voltage:g} V stays under {100.0 * curves.limit:g} %')
    beyond = [(u, p) for u, p in zip(curves.throttle, curves.risk)
              if u > curves.budget and p >= max(0.05, 2.0 * curves.limit)]
    if beyond:
        u, p = beyond[0]
        words += f'; at {100.0 * u:.0f} % it is {100.0 * p:.2g} %'
    return words


def _fitted(analysis: Analysis) -> list[LevelResult]:
    """Return the levels whose sigma and tau may be quoted."""
    return ([level for level in analysis.levels if level.estimate.status is Status.OK]
            or [level for level in analysis.levels if level.estimate.usable])


def facts(analysis: Analysis) -> list[tuple[str, str]]:
    """Return what is always known, and why sigma and tau are not, as names and words."""
    found = known_lines(analysis.overview)
    curves = analysis.by_throttle
    if math.isfinite(curves.budget):
        found.insert(-1, ('Safe up to', _budget_words(curves)))
    time: dict[Status, float] = {}
    for level in analysis.levels:
        time[level.estimate.status] = time.get(level.estimate.status, 0.0) + level.time
    if time and not _fitted(analysis):
        why = max(time, key=lambda status: time[status]).value
        found.append(('Sigma, tau', f'not given. {why}'))
    return found


def _numbers(good: Sequence[LevelResult]) -> str:
    """Return how sigma goes with throttle, and tau."""
    low, high = good[0], good[-1]
    if len(good) == 1:
        e = low.estimate
        where = '' if math.isnan(low.throttle) else f' at {low.label} throttle'
        return (f'The supply{where} wanders with sigma = {_ci(e)} V/sqrt(s) and '
                f'relaxes in tau = {_tau(e)} ms: a standard deviation of '
                f'{number(1e3 * math.sqrt(e.var_inf))} mV.')
    found = sigma_change(low.estimate, high.estimate)
    factor = (f'factor {number(found.ratio)}, 95 % {number(found.ratio_low)} to '
              f'{number(found.ratio_high)}')
    if not found.differs:
        change = (f'sigma does not change measurably from {low.label} to {high.label} throttle '
                  f'({factor})')
    else:
        verb = 'grows' if found.ratio > 1.0 else 'falls'
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


def cautions(analysis: Analysis, least: Severity = Severity.INFO) -> list[str]:
    """Return what to know before using the numbers."""
    return [caution(item) for item in analysis.quality if item.severity >= least]


def caution(item: QualityItem) -> str:
    """Return one sentence, led by the levels it is true of."""
    labels = ['all' if math.isnan(x) else f'{100.0 * x:.3g} %' for x in item.throttles]
    return f'{", ".join(labels)}: {item.text}' if labels else item.text


def brownout_sentence(analysis: Analysis) -> str:
    """Return what the risk is of, and the throttle budget."""
    curves = analysis.by_throttle
    if math.isnan(curves.voltage) and analysis.brownout_default:
        middle = float(np.median(analysis.recording.voltage)) if analysis.recording.n else NAN
        return (f"No brown-out risk: the node's default of {MonitorSettings().brownout_voltage:g} "
                f'V is for a 5 V rail, and this supply is at {number(middle)} V; '
                '--brownout-voltage sets another.')
    if math.isnan(curves.voltage):
        return 'No brown-out voltage was given.'
    which = ("the node's default for a 5 V rail; --brownout-voltage sets another"
             if analysis.brownout_default else 'as asked for')
    text = (f'Brown-out: going below {curves.voltage:g} V ({which}) within '
            f'{curves.horizon:g} s, with the supply as it was at the end of the recording.')
    if math.isnan(curves.budget):
        return f'{text} Throttle budget unknown: {curves.budget_reason}'
    return (f'{text} Throttle budget for a risk of {curves.limit:g}: '
            f'{100.0 * curves.budget:.3g} %. {curves.budget_reason}')


def relaxation_sentence(analysis: Analysis, k: int) -> str:
    """Return what follows falls (k = 0) or rises (k = 1) of throttle."""
    fit, cause = analysis.relaxations[k], analysis.causes[k]
    if not fit.detected:
        return cause.sentence
    count = len(fit.releases)
    what = {'release': 'fall', 'load': 'rise'}[fit.kind]
    return (f'After {counted(count, what)} of throttle the voltage relaxes in '
            f'tau = {number(1e3 * fit.tau)} (95 % {open_end(1e3 * fit.tau_low)} to '
            f'{open_end(1e3 * fit.tau_high)}) ms. {_led(fit.caveat)}{cause.sentence}')


def _led(text: str) -> str:
    return f'{text} ' if text else ''


def open_end(value: float) -> str:
    """Return one end of an interval; ``open`` where the data leave it so."""
    return number(value) if 0.0 < value < math.inf else 'open'
