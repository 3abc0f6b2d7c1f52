"""
Compare load levels: the change of sigma, and whether alpha is constant.

The paper assumes the same alpha at every load.  The test is chi^2 of ln(alpha) about the weighted
mean.  The standard errors, proportional to 1/sqrt(alpha T), are computed with the common alpha;
otherwise, levels whose alpha is high by chance would weigh too much.  Levels that one OU in white
noise does not describe (more than one relaxation, or lines with impulses) are withheld, because
their standard errors ignore the misfit.  Limits: only levels with a usable fit count; weak
lines stay in the fit; a test that does not reject proves nothing without the detectable ratio.

The significance level is `LEVEL`, which matches the printed 95 % intervals.  Each level is fitted
by itself here; `discover` fits one model to a whole recording, and tests whether its innovations
depend on throttle (`ou_monitor.criticism.score_statistics`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.records import determined, Estimate, exp_or_inf, FloatArray, log_interval, NAN
from ou_monitor.text import p_words
from scipy import stats
from scipy.special import chndtrinc

# Significance level of a difference, and power of the test at `detectable_ratio`.
LEVEL, POWER = 0.05, 0.9
# Minimum change that matters, as a factor: most flights do not determine tau more precisely.
NARROW = 1.5


@dataclass(frozen=True)
class AlphaTest:
    """Result of the test."""

    # ``differs``, ``constant`` (the test would have detected a change by `NARROW`) or
    # ``undetermined``.
    verdict: str
    levels: int  # Number of levels in the test
    # Common alpha, 1/s, and the standard error of its logarithm.
    alpha: float = NAN
    alpha_se: float = NAN
    # chi^2 with levels - 1 degrees of freedom.
    statistic: float = NAN
    p_value: float = NAN
    # Ratio of alpha, at the highest over at the lowest throttle, that the test detects with 90 %
    # probability if ln(alpha) is linear in throttle.
    detectable_ratio: float = NAN
    # The fitted ratio (NaN if not determined), and its 95 % interval.
    ratio: float = NAN
    ratio_low: float = NAN
    ratio_high: float = NAN
    # Throttles of usable levels that one OU in white noise does not describe.
    withheld: tuple[float, ...] = ()

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the common alpha, 1/s."""
        return log_interval(self.alpha, self.alpha_se)

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        return self._verdict() + self._withheld()

    def _withheld(self) -> str:
        if not self.withheld:
            return ''
        names = ', '.join('all' if math.isnan(x) else f'{100.0 * x:.3g} %' for x in self.withheld)
        return (f' Withheld: {names}, because a level shows more than one relaxation, or both '
                'lines and impulses.')

    def _verdict(self) -> str:
        if self.levels < 2:
            return ('This recording cannot decide whether alpha depends on load: '
                    f'{"only one" if self.levels else "no"} throttle held long enough has '
                    f'a usable fit{" and is described by one OU" if self.withheld else ""}.')
        least, ends = _factor(self.detectable_ratio), 'from the lowest to the highest throttle'
        if self.verdict == 'differs':
            size = 'by a factor that is not determined' if math.isnan(self.ratio) else (
                f'by a factor of {_factor(self.ratio)} (95 % {_factor(self.ratio_low)} to '
                f'{_factor(self.ratio_high)})')
            return (f'Alpha depends on load ({p_words(self.p_value)}): it changes {size} {ends}; '
                    'the paper assumes a constant alpha.')
        if self.verdict == 'constant':
            return (f'Alpha shows no dependence on load ({p_words(self.p_value)}); the test would '
                    f'have detected a change by a factor of {least} {ends} (90 %).')
        return ('This recording cannot decide whether alpha depends on load '
                f'({p_words(self.p_value)}): the test would have detected only a change by a '
                f'factor of {least} {ends} (90 %).')


def _factor(ratio: float) -> str:
    """Return a ratio in words: three digits, 'more than 100' or 'less than 0.01'."""
    if ratio > 100.0:
        return 'more than 100'
    return 'less than 0.01' if ratio < 0.01 else f'{ratio:#.3g}'.rstrip('.')


def alpha_constancy(throttles: Sequence[float], estimates: Sequence[Estimate],
                    doubted: Sequence[bool] | None = None) -> AlphaTest:
    """Test whether the levels share one alpha (throttles 0..1)."""
    usable = [k for k, e in enumerate(estimates)
              if e.usable and e.alpha_se > 0.0 and math.isfinite(throttles[k])]
    good = [k for k in usable if doubted is None or not doubted[k]]
    withheld = tuple(throttles[k] for k in usable if k not in good)
    if not good:
        return AlphaTest('undetermined', 0, withheld=withheld)
    x = np.array([throttles[k] for k in good])
    logs = np.log([estimates[k].alpha for k in good])
    own = np.array([estimates[k].alpha_se for k in good])
    weight = 1.0 / at_common_alpha(logs, own) ** 2
    mean = float(weight @ logs / weight.sum())
    common = (math.exp(mean), float(1.0 / math.sqrt(weight.sum())))
    if len(good) < 2:
        return AlphaTest('undetermined', len(good), *common, withheld=withheld)
    freedom = len(good) - 1
    statistic = float(weight @ (logs - mean) ** 2)
    p = float(stats.chi2.sf(statistic, freedom))
    # Straight line of ln(alpha) over throttle, from the lowest to the highest level.
    reach = float(np.ptp(x))
    along = (x - float(weight @ x / weight.sum())) / reach
    size = float(weight @ along ** 2)
    ratio = exp_or_inf(float(weight @ (along * logs)) / size)
    low, high = log_interval(ratio, 1.0 / math.sqrt(size))
    # At this noncentrality, chi^2 rejects with probability `POWER`.
    far = float(chndtrinc(stats.chi2.isf(LEVEL, freedom), freedom, 1.0 - POWER))
    detectable = exp_or_inf(math.sqrt(far / size))
    verdict = 'differs' if p < LEVEL else 'constant' if detectable <= NARROW else 'undetermined'
    return AlphaTest(verdict, len(good), *common, statistic, p, detectable,
                     ratio if determined(ratio, low, high) else NAN, low, high, withheld)


def at_common_alpha(logs: FloatArray, errors: FloatArray) -> FloatArray:
    """Return relative errors of alpha or Var_inf at the common alpha (logs: ln of alpha, 1/s)."""
    # The error is proportional to sqrt(2 / (alpha T)), so it is too small for an alpha that is
    # high by chance.
    found = errors
    for _ in range(20):
        weight = 1.0 / found ** 2
        found = errors * np.exp(0.5 * (logs - float(weight @ logs / weight.sum())))
    return found


@dataclass(frozen=True)
class SigmaChange:
    """Sigma of one level over sigma of another."""

    # The fitted ratio (NaN if not determined), and its 95 % interval.
    ratio: float
    ratio_low: float
    ratio_high: float

    @property
    def differs(self) -> bool | None:
        """Whether sigma differs at `LEVEL`; None if a change by `NARROW` cannot be excluded."""
        if not self.ratio_low <= 1.0 <= self.ratio_high:
            return True
        return False if self.ratio_low * NARROW > 1.0 and self.ratio_high < NARROW else None


def sigma_change(low: Estimate, high: Estimate, others: Sequence[Estimate] = ()) -> SigmaChange:
    """Return sigma of `high` over that of `low`; its error includes the scatter of all levels."""
    # If ln sigma scatters about a straight line over throttle by more than the errors of the
    # levels, the excess has another cause, such as a load that throttle does not show.
    every = [low, *others, high]
    scatter = 0.0
    if others:
        x, y = np.array([(e.throttle, math.log(e.sigma)) for e in every]).T
        left = y - np.polyval(np.polyfit(x, y, 1), x)
        scatter = max(0.0, float(left @ left) / (x.size - 2) - float(np.mean(
            [e.sigma_se ** 2 for e in every])))
    ratio = high.sigma / low.sigma
    ends = log_interval(ratio, math.hypot(low.sigma_se, high.sigma_se, math.sqrt(2.0 * scatter)))
    return SigmaChange(ratio if determined(ratio, *ends) else NAN, *ends)
