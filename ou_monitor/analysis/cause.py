"""
What relaxes after a change of load: the rail as its noise shows it, or the instrument.

An AC-coupled input is a high-pass: whatever the rail does, a step comes out of it as a decay to
the level before, at its own corner, and the noise shows the same corner.  So a supply that comes
back to the level that it had under the other load says nothing about the rail.  One that settles
at another level excludes the high-pass, for a high-pass keeps no level.

Limits: a regulator that compensates a change of load looks like a high-pass; the stay before has
to last some time constants, or its level is not known.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.level_comparison import AlphaTest, LEVEL
from ou_monitor.analysis.relaxation import Relaxation, Release
from ou_monitor.records import determined, log_interval, NAN
from ou_monitor.text import number, p_words, volts, Z95
from scipy import stats

# A level that is off by more than this share of the transient has settled elsewhere; by less
# than the other, it has come back.
_ELSEWHERE, _BACK = 0.5, 0.25
_SURE = 4.0
# tau and 1/alpha nearer than this factor, with 95 %, are called the same.
_CLOSE = 1.5


@dataclass(frozen=True)
class Cause:
    """How tau compares with the noise, and whether the instrument explains it."""

    # ``agrees`` (tau alpha within a factor of 1.5 of 1 with 95 %), ``differs`` or
    # ``undetermined``.
    noise: str
    # tau alpha, with alpha that of the noise, common to all levels, and its 95 % interval;
    # that is NaN where one exponential does not describe the transient.
    ratio: float
    ratio_low: float
    ratio_high: float
    p_value: float  # Of a ratio so far from 1.
    instrument: str  # ``excluded``, ``possible`` or ``undetermined``.
    corner: float  # Of the high-pass that would explain it, 1/(2 pi tau), Hz.
    # Level after less level before in the direction of the transient, mean of the changes
    # that have an amplitude, V; NaN when none has.
    step: float
    step_se: float
    sentence: str  # Both verdicts in words.


def judge_cause(relaxation: Relaxation, alpha: AlphaTest) -> Cause:
    """Compare a relaxation with the noise and with an AC-coupled instrument."""
    if not relaxation.detected:
        return Cause('undetermined', NAN, NAN, NAN, NAN, 'undetermined', NAN, NAN, NAN,
                     _nothing(relaxation))
    noise, ratio, low, high, p = _against_noise(relaxation, alpha)
    instrument, step, step_se = _against_instrument(relaxation)
    corner = 1.0 / (2.0 * math.pi * relaxation.tau)
    of_noise = {
        'agrees': 'tau agrees with 1/alpha of the noise',
        'differs': f'tau is not 1/alpha of the noise ({p_words(p)})',
        'undetermined': 'the data neither separate tau from 1/alpha of the noise nor show '
                        'them equal'}[noise]
    if math.isfinite(low):
        of_noise += f' (tau alpha = {ratio:.2f}, 95 % {low:.2f} to {high:.2f})'
    of_instrument = {
        'excluded': f'the level changes with the load by {volts(step)} and stays, so '
                    'this is not the high-pass of an AC-coupled instrument',
        'possible': 'the voltage returns to the level before although the load has changed: a '
                    f'high-pass of {corner:.2g} Hz (AC coupling) would do the same to the '
                    'transient and to the noise, a regulator to the transient; this recording '
                    'cannot separate them',
        'undetermined': 'the level before is not known well enough to decide whether a high-pass '
                        f'of the instrument ({corner:.2g} Hz) explains it'}[instrument]
    return Cause(noise, ratio, low, high, p, instrument, corner, step, step_se,
                 f'{of_noise[0].upper()}{of_noise[1:]}; {of_instrument}.')


def _nothing(relaxation: Relaxation) -> str:
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
        # The p-value and the interval rest on an error of tau that does not hold.
        return 'undetermined', math.exp(log), NAN, NAN, NAN
    word = 'differs' if p < LEVEL else 'agrees' if reach < math.log(_CLOSE) else 'undetermined'
    ratio = math.exp(log)
    low, high = log_interval(ratio, se)
    if not determined(ratio, low, high):
        ratio = low = high = NAN
    return word, ratio, low, high, p


def _against_instrument(relaxation: Relaxation) -> tuple[str, float, float]:
    """Return the verdict and the mean step of the level that stays, with its error."""
    steps, errors, sizes = [], [], []
    for change in relaxation.releases:
        if math.isfinite(change.level_before_se) and _tells(change):
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


def _tells(change: Release) -> bool:
    """Whether a change has an amplitude to compare its level with."""
    return abs(change.amplitude) > _SURE * change.amplitude_se
