"""
What kind of process a load level shows, decided by stated tests only.

The words are those of the paper's Table 1; the paper names the kinds by eye,
here each has tests (`ou_monitor.criticism.level_tests`), adjusted so
that a recording of stationary OU levels has any of them reject once in a
hundred times.  The first that applies names the level:

1. mean or intensity changes from block to block: 'quasi-stationary' (the
   verdict also names what the level is apart from that);
2. single innovations far out, or heavy tails: 'with impulses';
3. another shape than the normal law: 'not Gaussian';
4. too few samples to detect heavy tails: 'undetermined';
5. neighbours uncorrelated, or more white noise than relaxation, or relaxation
   faster than the sampling: 'Gaussian';
6. lines carry most of the variance, or one relaxation does not leave
   independent innovations, or a second one is detected: 'stationary stochastic'; if it does:
   'diffusion';
   without a usable fit 'undetermined'.

Limits: a word stands for what was found, and the tests that did not reject
have a power that depends on the length; impulses and an intensity that
wanders within a block look alike.
"""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

from ou_monitor.criticism.innovations import FAMILY_WISE
from ou_monitor.criticism.level_tests import Shape, TestResult
from ou_monitor.records import Estimate, Status
from ou_monitor.text import p_words
from scipy import stats

# A level is called Gaussian only when the tests would have detected this excess kurtosis.
VISIBLE_KURTOSIS = 1.0
_POWER = 0.9
# More of the variance than this in spectral lines is most of it.
_LINE_SHARE = 0.5


class ProcessType(enum.Enum):
    """Kind of process; the value is the word for the table."""

    CONSTANT = 'constant'
    QUASI_STATIONARY = 'quasi-stationary'
    IMPULSES = 'with impulses'
    NOT_GAUSSIAN = 'not Gaussian'
    GAUSSIAN = 'Gaussian'
    STATIONARY = 'stationary stochastic'
    DIFFUSION = 'diffusion'
    UNDETERMINED = 'undetermined'


def detectable_kurtosis(n: int) -> float:
    """Return the excess kurtosis that n innovations reveal with 90 % probability."""
    if n < 1:
        return math.inf
    # Half of the level goes to the largest innovation.
    reach = float(stats.norm.isf(0.5 * FAMILY_WISE) + stats.norm.ppf(_POWER))
    return reach * math.sqrt(24.0 / n)


@dataclass(frozen=True)
class Verdict:
    """What a level is called, and why."""

    kind: ProcessType  # Kind.
    why: str  # The reason without numbers, so that levels of one reason can stand together.
    figures: str = ''  # The numbers behind it; may be empty.
    # For 'quasi-stationary' what the level is called apart from its changes; else `kind`.
    within: ProcessType = ProcessType.UNDETERMINED

    @property
    def sentence(self) -> str:
        """Reason and numbers, one sentence."""
        why = self.why.rstrip('.')
        figures = f' ({self.figures})' if self.figures else ''
        return f'{why[0].upper()}{why[1:]}{figures}.'


def classify(estimate: Estimate, shape: Shape, line_share: float = 0.0) -> Verdict:
    """Name the kind of process and the reason."""
    if estimate.status is Status.CONSTANT:
        return _plain(ProcessType.CONSTANT, 'the voltage never changes')
    if all(math.isnan(test.p_value) for test in shape.tests):
        return _plain(ProcessType.UNDETERMINED, estimate.status.value)
    drift, intensity = shape['mean_drift'], shape['variance_drift']
    rest = _apart_from_changes(estimate, shape, line_share)
    if not (drift.rejects or intensity.rejects):
        return rest
    moves, figures = [], []
    if drift.rejects:
        moves.append('the mean moves')
        figures.append(f'the mean by {drift.effect:.2g} standard deviations, {_p(drift)}')
    if intensity.rejects:
        moves.append('the intensity changes')
        figures.append(f'the intensity by {100.0 * intensity.effect:.0f} %, {_p(intensity)}')
    return Verdict(ProcessType.QUASI_STATIONARY,
                   f'from block to block {" and ".join(moves)}; apart from that '
                   f'{rest.kind.value}', '; '.join(figures), rest.kind)


def _apart_from_changes(estimate: Estimate, shape: Shape, line_share: float) -> Verdict:
    """Return the kind of a level as if nothing moved from block to block."""
    tails, normal = shape['impulses'], shape['gaussian']
    if tails.rejects:
        return _plain(ProcessType.IMPULSES, 'single innovations lie beyond the range of '
                      'the noise, or the tails are heavy',
                      f'{shape.impulses} of {shape.n}, excess kurtosis {shape.kurtosis:.2g}, '
                      f'{_p(tails)}')
    if normal.rejects:
        return _plain(ProcessType.NOT_GAUSSIAN, 'the innovations do not follow the normal '
                      'law', f'skewness {shape.skewness:.2g}, excess kurtosis '
                      f'{shape.kurtosis:.2g}, {_p(normal)}')
    if tails.why_not:
        return _plain(ProcessType.UNDETERMINED, tails.why_not)
    visible = detectable_kurtosis(shape.n)
    if visible > VISIBLE_KURTOSIS:
        return _plain(ProcessType.UNDETERMINED, 'no test rejects, but so few samples cannot '
                      'reveal heavy tails',
                      f'{shape.n} samples, excess kurtosis up to {visible:.2g}')
    return _gaussian(estimate, shape, line_share, f'no excess kurtosis above {visible:.2g}')


def _gaussian(estimate: Estimate, shape: Shape, line_share: float, normal: str) -> Verdict:
    """Return the kind of a level whose shape no test rejects as Gaussian."""
    correlated = shape['correlated']
    if not correlated.rejects:
        return _plain(ProcessType.GAUSSIAN, 'neighbouring samples are uncorrelated', normal)
    if line_share > _LINE_SHARE:
        return _plain(ProcessType.STATIONARY, 'spectral lines carry most of the variance',
                      f'{100.0 * line_share:.0f} %; {normal}')
    if estimate.status is Status.NO_RELAXATION:
        return _plain(ProcessType.STATIONARY, 'neighbouring samples are correlated, but not as '
                      'a relaxation would correlate them', f'{_p(correlated)}; {normal}')
    if not estimate.usable:
        return _plain(ProcessType.UNDETERMINED, estimate.status.value)
    step = estimate.alpha / estimate.rate
    if step > 1.0:
        return _plain(ProcessType.GAUSSIAN, 'relaxation is faster than the sampling',
                      f'alpha dt = {step:.2g}; {normal}')
    noise = estimate.noise_std ** 2
    if noise > estimate.var_inf:
        return _plain(ProcessType.GAUSSIAN, 'white noise carries most of the variance',
                      f'{100.0 * (noise / (noise + estimate.var_inf)):.0f} %; {normal}')
    rest = shape['one_relaxation']
    if rest.rejects:
        return _plain(ProcessType.STATIONARY, 'one relaxation leaves correlated innovations',
                      f'{_p(rest)}; {normal}')
    second = shape['second_relaxation']
    if second.rejects:
        return _plain(ProcessType.STATIONARY, 'the innovations show a second relaxation, '
                      'slower or faster than the fitted one: alpha is that of neither',
                      f'{_share(second.effect)}, {_p(second)}; {normal}')
    beside = f'; beside lines of {100.0 * line_share:.2g} % of the variance' if line_share else ''
    return _plain(ProcessType.DIFFUSION, 'one relaxation, slower than the sampling, leaves '
                  'independent Gaussian innovations', f'alpha dt = {step:.2g}; {normal}{beside}')


def _share(share: float) -> str:
    """Return a share of Var_inf to first order, which beyond the whole says no more than that."""
    return 'as large as Var_inf' if share > 1.0 else f'some {100.0 * share:.0f} % of Var_inf'


def _plain(kind: ProcessType, why: str, figures: str = '') -> Verdict:
    return Verdict(kind, why, figures, kind)


def _p(test: TestResult) -> str:
    return p_words(test.p_adjusted)
