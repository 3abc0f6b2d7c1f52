"""
Tests of the process type of a load level, and of alpha and sigma across levels.

Each test but `correlated` works on the one-step innovations of the fitted model, which are
independent and standard normal if the level is a stationary OU in white noise:

=============  ========================================================================
mean_drift     means of blocks of innovations, F test that includes the errors of the fit
variance_drift Layard's test of equal variances of blocks (J. Am. Stat. Assoc. 68, 1973),
               which is robust against heavy tails
gaussian       D'Agostino & Pearson's K^2 of skewness and kurtosis, of innovations divided
               by the standard deviation of their block
impulses       the largest innovation (Sidak) or a positive excess kurtosis, each at
               half the significance level
correlated     lags 1..5 of the deviation, with variances robust against changing
               intensity (Lo & MacKinlay, Rev. Financ. Stud. 1, 1988)
one_relaxation lags 1..10 of the innovations, in the same way
second_relaxation
               periodogram of the innovations (`ou_monitor.criticism.innovations`)
=============  ========================================================================

A rejection counts only if the effect is large enough to matter: with 10^5 samples, even a change
of sigma by 1 % is significant.  Limits: the OU is fitted to the same samples and absorbs part of a
slow drift or a second time constant, which lowers the power; coarse ADC steps hide the shape;
changes within a sixteenth of the level average out; if a tone correlates the samples, the tests of
the shape reject a little too often.

`alpha_constancy` tests whether alpha is the same at all loads, as the paper assumes: chi^2 of
ln(alpha) about the weighted mean, with standard errors, proportional to 1/sqrt(alpha T), at the
common alpha; otherwise, levels whose alpha is high by chance would weigh too much.  Levels that
one OU in white noise does not describe (more than one relaxation, or lines with impulses) are
withheld, because their errors ignore the misfit.  Limits: only levels with a usable fit count;
weak lines stay in the fit; a test that does not reject proves nothing without the detectable
ratio.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.criticism.innovations import (
    FAMILY_WISE, innovations, join, LEAST_SHARE, second_relaxation)
from ou_monitor.records import (
    determined, Estimate, exp_or_inf, Flag, FloatArray, log_interval, NAN, Status)
from ou_monitor.text import p_words
from scipy import stats
from scipy.special import chndtrinc

# Minimum samples for a test, and minimum innovations per block; maximum number of blocks.
FEWEST = 50
_BLOCKS = 16
# Minimum length of a block in the test of the mean, relaxation times.
_MEAN_BLOCK = 5.0
# Innovations farther from the median, in standard deviations, are left out of the test of
# intensity, or a few impulses would determine the variance of a block.  With heavy tails
# (Student's t with 5 degrees of freedom), 1 in 10^4 is left out.
_FAR = 10.0
_LAGS_RAW, _LAGS_FITTED = 5, 10  # Lags tested, of samples and of innovations
# Minimum effects that matter, in the unit of each test.
LEAST = {'mean_drift': 0.25, 'variance_drift': 0.1, 'gaussian': 0.3, 'impulses': 0.5,
         'correlated': 0.0, 'one_relaxation': 0.1, 'second_relaxation': LEAST_SHARE}
EFFECT = {
    'mean_drift': 'standard deviation of the mean beyond its sampling error, divided by the '
                  'standard deviation of the voltage',
    'variance_drift': 'relative standard deviation of the intensity beyond its sampling error',
    'gaussian': 'larger of |skewness| and |excess kurtosis| / 2',
    'impulses': 'excess kurtosis, or impulses beyond the range of the noise per 1000 samples',
    'correlated': 'root of the sum of squared autocorrelations',
    'one_relaxation': 'root of the sum of squared autocorrelations',
    'second_relaxation': 'variance of a second relaxation, divided by Var_inf'}


@dataclass(frozen=True)
class TestResult:
    """One test of one level."""

    name: str  # Key of `EFFECT`
    p_value: float = NAN  # NaN if the test was not possible
    effect: float = NAN  # Effect size, see `EFFECT`
    p_adjusted: float = NAN  # Holm-adjusted over all tests of all levels of the recording
    why_not: str = ''  # Why the test was not possible; otherwise empty

    # pytest must not collect this class as a test.
    __test__ = False

    @property
    def rejects(self) -> bool:
        """Whether the test rejects at the level `FAMILY_WISE`, with an effect that matters."""
        return self.p_adjusted < FAMILY_WISE and self.effect >= LEAST[self.name]


@dataclass(frozen=True, eq=False)
class Shape:
    """Tests and moments of the innovations of a level."""

    tests: tuple[TestResult, ...]  # In the order of `EFFECT`
    n: int  # Innovations
    # Skewness and excess kurtosis of innovations divided by the standard deviation of their block.
    skewness: float
    kurtosis: float
    impulses: int  # Innovations beyond the 99 % quantile of the largest of n normal ones
    impulse_rate: tuple[float, float, float]  # Their rate, 1/s, and its 95 % interval (Poisson)

    def __getitem__(self, name: str) -> TestResult:
        return next(test for test in self.tests if test.name == name)


def examine_level(parts: Sequence[tuple[FloatArray, FloatArray]], estimate: Estimate,
                  above: float = 0.0) -> Shape:
    """Test one level (parts: stamps, s, and V); noise below `above`, Hz, was removed."""
    parts = [(t, v) for t, v in parts if t.size >= 2]
    n = sum(t.size for t, _ in parts)
    time = sum(float(t[-1] - t[0]) for t, _ in parts)
    if n < FEWEST:
        return _untested(n, f'fewer than {FEWEST} samples')
    model = (estimate.alpha, estimate.var_inf, max(0.0, estimate.noise_std)
             if math.isfinite(estimate.noise_std) else 0.0) if estimate.usable else None
    own = [v - v.mean() for _, v in parts]
    spread = float(np.sqrt(np.mean(join(own) ** 2)))
    if not spread > 0.0:
        return _untested(n, 'the voltage never changes')
    correlated = _portmanteau('correlated', own, _LAGS_RAW)
    if model is None and estimate.status is not Status.NO_RELAXATION:
        why = 'without a usable fit the samples cannot be whitened'
        return replace(_untested(n, why), tests=tuple(
            correlated if name == 'correlated' else TestResult(name, why_not=why)
            for name in EFFECT))
    alpha, var_inf, noise = model or (math.inf, spread ** 2, 0.0)
    apart = [innovations(t, d, alpha, var_inf, noise * noise)
             for (t, _), d in zip(parts, own)]
    z = join(apart)
    tests = [_mean_drift(parts, estimate, alpha, var_inf, noise * noise, spread),
             _variance_drift(z)]
    # Without the mean of each block, in its standard deviations.
    local = join([(piece - piece.mean()) / max(float(piece.std()), 1e-300)
                  for piece in np.array_split(z, _block_count(z.size))])
    skewness, kurtosis = float(stats.skew(local)), float(stats.kurtosis(local))
    far = float(stats.norm.isf(0.5 * -math.expm1(math.log1p(-0.01) / n)))
    count = int((np.abs(local) > far).sum())
    if Flag.QUANTIZED in estimate.flags:
        lost = 'steps of the ADC hide the shape of the noise'
        tests += [TestResult('gaussian', why_not=lost), TestResult('impulses', why_not=lost)]
        skewness = kurtosis = NAN
        count = 0
    else:
        tests += [
            TestResult('gaussian', float(stats.normaltest(local).pvalue),
                       max(abs(skewness), 0.5 * abs(kurtosis))),
            _impulses(local, kurtosis, count)]
    tests.append(correlated)
    if model:
        second, share = second_relaxation(
            apart, (n - len(parts)) / time, alpha, var_inf, noise * noise, above)
        tests += [_portmanteau('one_relaxation', [z], _LAGS_FITTED),
                  TestResult('second_relaxation', second, share,
                             why_not='' if math.isfinite(second) else 'too few samples')]
    else:
        tests += [TestResult(name, why_not='there is no fitted model')
                  for name in ('one_relaxation', 'second_relaxation')]
    return Shape(tuple(tests), n, skewness, kurtosis, count, _poisson(count, time))


def holm(shapes: Sequence[Shape]) -> tuple[Shape, ...]:
    """Adjust the p-values of all levels together (Holm 1979)."""
    flat = [test.p_value for shape in shapes for test in shape.tests]
    found = iter(adjusted(flat))
    return tuple(replace(shape, tests=tuple(
        replace(test, p_adjusted=next(found)) for test in shape.tests)) for shape in shapes)


def adjusted(p_values: Sequence[float]) -> tuple[float, ...]:
    """Adjust p-values of one family (Holm 1979)."""
    done = sorted((p, k) for k, p in enumerate(p_values) if math.isfinite(p))
    found = [NAN] * len(p_values)
    largest = 0.0
    for rank, (p, k) in enumerate(done):
        found[k] = largest = max(largest, min(1.0, (len(done) - rank) * p))
    return tuple(found)


def _untested(n: int, why: str) -> Shape:
    return Shape(tuple(TestResult(name, why_not=why) for name in EFFECT), n, NAN, NAN, 0,
                 (NAN, NAN, NAN))


def _mean_drift(parts: Sequence[tuple[FloatArray, FloatArray]], estimate: Estimate, alpha: float,
                var_inf: float, noise_var: float, spread: float) -> TestResult:
    """Compare the means of blocks of innovations with the mean of the whole level."""
    total = join([v for _, v in parts])
    time = sum(float(t[-1] - t[0]) for t, _ in parts)
    blocks = _BLOCKS if math.isinf(alpha) else min(_BLOCKS, int(alpha * time / _MEAN_BLOCK))
    blocks = min(blocks, total.size // FEWEST)
    if blocks < 3:
        return TestResult('mean_drift', why_not=(
            f'fewer than three blocks of {_MEAN_BLOCK:g} relaxation times, {FEWEST} samples'))
    centre = float(total.mean())
    z = join([innovations(t, v - centre, alpha, var_inf, noise_var) for t, v in parts])
    # A shift of the voltage shifts all innovations equally, except the first of each part, which
    # has no past and is left out.
    ends = np.cumsum([t.size for t, _ in parts])[:-1]
    z = np.delete(z, np.concatenate(([0], ends)).astype(np.intp))
    pieces = np.array_split(z, blocks)
    means = np.array([piece.mean() for piece in pieces])
    counts = np.array([piece.size for piece in pieces])
    q = float(counts @ (means - float(z.mean())) ** 2)
    scale = 1.0
    if math.isinf(alpha):
        # Correlation of neighbours increases the scatter of the means of blocks.
        centred = [piece - piece.mean() for piece in pieces]
        square = sum(float(c @ c) for c in centred)
        near = sum(float(c[lag:] @ c[:-lag]) for c in centred
                   for lag in range(1, _LAGS_RAW + 1)) / square
        scale = square / (z.size - blocks) * max(1.0, 1.0 + 2.0 * near)
    # The error of the fit scales all innovations alike, which limits the degrees of freedom.
    freedom = math.inf
    if math.isfinite(alpha):
        error = 2.0 * math.hypot(estimate.alpha_se, estimate.sigma_se)
        freedom = max(2.0 / error ** 2, 1.0)
    statistic = q / ((blocks - 1) * scale)
    p = float(stats.f.sf(statistic, blocks - 1, freedom) if math.isfinite(freedom)
              else stats.chi2.sf(q / scale, blocks - 1))
    gain = _constant_gain(parts, alpha, var_inf, noise_var)
    beyond = max(0.0, float(np.mean((means - means.mean()) ** 2)) * blocks / (blocks - 1)
                 - scale * float(np.mean(1.0 / counts)))
    return TestResult('mean_drift', p, math.sqrt(beyond) / gain / spread)


def _constant_gain(parts: Sequence[tuple[FloatArray, FloatArray]], alpha: float, var_inf: float,
                   noise_var: float) -> float:
    """Return the innovation to which a constant input of 1 V settles, 1/V."""
    t = max((t for t, _ in parts), key=len)
    step = float(np.median(np.diff(t)))
    steady: FloatArray = step * np.arange(float(max(64, t.size)))
    return float(innovations(steady, np.ones(steady.size), alpha, var_inf, noise_var)[-1])


def _block_count(n: int) -> int:
    return max(1, min(_BLOCKS, n // FEWEST))


def _variance_drift(z: FloatArray) -> TestResult:
    blocks = _block_count(z.size)
    if blocks < 3:
        return TestResult('variance_drift', why_not=f'fewer than three blocks of {FEWEST} samples')
    pieces = [_without_impulses(piece) for piece in np.array_split(z, blocks)]
    free = np.array([piece.size - 1.0 for piece in pieces])
    logs = np.log([max(float(piece.var(ddof=1)), 1e-300) for piece in pieces])
    centred = [piece - piece.mean() for piece in pieces]
    # Kurtosis within the blocks increases the scatter of their variances beyond chi^2.
    fourth = float(np.mean(join([c ** 4 / max(float(np.mean(c ** 2)), 1e-300) ** 2
                                 for c in centred])))
    scatter = 2.0 + (1.0 - 1.0 / blocks) * max(fourth - 3.0, -1.0)
    q = float(free @ (logs - free @ logs / free.sum()) ** 2) / scatter
    beyond = max(0.0, float(np.var(logs, ddof=1)) - scatter * float(np.mean(1.0 / free)))
    # ln sigma is half of ln variance.
    return TestResult('variance_drift', float(stats.chi2.sf(q, blocks - 1)),
                      0.5 * math.sqrt(beyond))


def _without_impulses(piece: FloatArray) -> FloatArray:
    """Return a block without impulses, which have their own test."""
    away = np.abs(piece - np.median(piece))
    middle = float(np.median(away)) / 0.6745
    return piece[away <= _FAR * middle] if middle > 0.0 else piece


def _impulses(z: FloatArray, kurtosis: float, count: int) -> TestResult:
    largest = float(np.abs(z).max())
    of_largest = -math.expm1(z.size * math.log1p(-min(2.0 * float(stats.norm.sf(largest)),
                                                      1.0 - 1e-16)))
    of_kurtosis = float(stats.kurtosistest(z, alternative='greater').pvalue)
    p = min(1.0, 2.0 * min(of_largest, of_kurtosis))
    return TestResult('impulses', p, max(kurtosis, 1000.0 * count / z.size))


def _portmanteau(name: str, parts: Sequence[FloatArray], lags: int) -> TestResult:
    """Portmanteau test of autocorrelations, with variances robust against changing intensity."""
    total = sum(float(d @ d) for d in parts)
    n = sum(d.size for d in parts)
    if not total > 0.0 or n <= 10 * lags:
        return TestResult(name, why_not='too few samples')
    q, squares, freedom = 0.0, 0.0, float(lags)
    for lag in range(1, lags + 1):
        products = [d[lag:] * d[:-lag] for d in parts if d.size > lag]
        top = sum(float(p.sum()) for p in products)
        variance = sum(float(p @ p) for p in products)
        r = top / total
        # Correct the bias from removing the mean of each part.
        r += len(parts) / n if name == 'correlated' else 0.0
        se = math.sqrt(max(variance, 1e-300)) / total
        q += (r / se) ** 2
        squares += max(0.0, r * r - se * se)
    # Of the fitted parameters, only the white noise has an effect at these few lags.
    freedom = lags - 1.0 if name == 'one_relaxation' else freedom
    return TestResult(name, float(stats.chi2.sf(q, freedom)), math.sqrt(squares))


def _poisson(count: int, time: float) -> tuple[float, float, float]:
    """Return a rate, 1/s, and its exact 95 % interval."""
    if not time > 0.0:
        return NAN, NAN, NAN
    low = float(stats.chi2.ppf(0.025, 2 * count)) / 2.0 if count else 0.0
    return count / time, low / time, float(stats.chi2.ppf(0.975, 2 * count + 2)) / 2.0 / time


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
