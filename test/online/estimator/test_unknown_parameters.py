"""A parameter whose 95 % interval spans more than a factor of 10 either way is unknown."""

from dataclasses import replace
import math

from hypothesis import given, strategies as st
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.analysis.analyze import analyze, as_data
from ou_monitor.analysis.level_tests import alpha_constancy, sigma_change
from ou_monitor.online.estimator.fit import FitEnd, WindowFit
from ou_monitor.online.estimator.quality import judge, Quality
from ou_monitor.records import (
    Counters, Estimate, LARGEST_FACTOR, LARGEST_LOG_SE, Recording, Status)
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.report.terminal import terminal
import pytest

NAMES = ('alpha', 'sigma', 'var_inf')
NAN = math.nan
# Standard errors of a logarithm, as an ill-conditioned fit may have them.
ERRORS = st.one_of(st.just(NAN), st.floats(min_value=0.0))
POSITIVE = st.floats(min_value=1e-300, max_value=1e300)


def nearly_white(seed: int) -> Recording:
    """Return samples at uneven times, almost uncorrelated: the fit says next to nothing."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(40, 300))
    phi = rng.uniform(0.0, 0.15)
    w = rng.standard_normal(n + 1)
    v = np.round((5.0 + 0.03 * (w[1:] + phi * w[:-1])) / 1.6e-3) * 1.6e-3
    return Recording(np.arange(n) / 100.0 + rng.uniform(-0.003, 0.003, n), v, np.full(n, 0.5))


@pytest.mark.parametrize('seed', [3, 74, 122])
def test_a_nearly_white_rail_is_analysed(seed):
    """Relative errors of 8e4 to 3e5: no traceback, and no sigma in the text or the JSON."""
    analysis = analyze(nearly_white(seed))
    (level,) = as_data(analysis)['levels']
    assert math.isnan(level['sigma']) and np.isnan(level['sigma_ci95']).all()
    assert 'sigma =' not in terminal(analysis_document(analysis))


@given(value=POSITIVE, error=ERRORS)
def test_an_estimate_holds_what_is_known(value, error):
    e = Estimate(alpha=value, sigma=value, var_inf=value, u0=5.0, alpha_se=error, sigma_se=error,
                 var_inf_se=error, u0_se=0.01, status=Status.OK, rate=math.inf)
    # NaN: the error was not given.
    known = not error > LARGEST_LOG_SE
    assert e.usable == known and (e.status is Status.OK) == known
    for name in NAMES:
        low, high = e.interval(name)
        assert math.isfinite(getattr(e, name)) == known
        if known and not math.isnan(error):
            edge = LARGEST_FACTOR * (1.0 + 1e-12)
            assert value / edge <= low <= value <= high <= value * edge
        else:
            assert math.isnan(low) and math.isnan(high)


@given(z=st.floats(allow_nan=True, allow_infinity=True))
def test_an_interval_of_any_width(z):
    low, high = Estimate(alpha=3.0, alpha_se=0.5).interval('alpha', z=z)
    assert math.isnan(z) or z < 0.0 or (0.0 <= low <= 3.0 <= high)


@given(log_var=st.tuples(*3 * [st.floats()]), score=st.floats(min_value=0.0), alpha=POSITIVE,
       duration=st.floats(min_value=1e-9, max_value=1e9))
def test_any_information_is_judged(log_var, score, alpha, duration):
    """Singular, negative, infinite: what is usable is known to a factor of 10."""
    fit = WindowFit(FitEnd.FOUND, alpha, 0.6, 0.0, score, log_var, np.array([5.0]),
                    np.empty(0), np.empty((0, 0)), False, 2000, 0.06, 1.5)
    e = judge(fit, {'t': 0.0, 'voltage': 5.0, 'throttle': NAN, 'n': 2000, 'duration': duration,
                    'rate': 1e3, 'counters': Counters()}, Quality(), NAN, NAN)
    for name in NAMES:
        if math.isfinite(getattr(e, name)):
            assert getattr(e, name + '_se') <= LARGEST_LOG_SE


def test_both_sides_of_the_limit():
    """ln(10) / 1.96 = 1.175 is still known; what is wrong is said."""
    for factor, status in ((1.0 - 1e-9, Status.OK), (1.0 + 1e-9, Status.TOO_SHORT)):
        e = Estimate(alpha=3.0, sigma=1.0, var_inf=1.0, u0=5.0, alpha_se=factor * LARGEST_LOG_SE,
                     sigma_se=0.1, var_inf_se=0.3, status=Status.OK, rate=100.0)
        assert e.status is status and (e.sigma, e.var_inf) == (1.0, 1.0)
    assert Estimate(alpha=300.0, alpha_se=2.0, status=Status.OK,
                    rate=100.0).status is Status.NO_RELAXATION
    assert math.log(10.0) / 1.96 == pytest.approx(LARGEST_LOG_SE, rel=1e-4)


def test_a_ratio_follows_the_same_rule():
    """Of levels that are known and differ the ratio may not be: 30, 95 % 2.3 to 390."""
    levels = [Estimate(status=Status.OK, u0=5.0, rate=1e9, alpha=x, sigma=x, var_inf=1.0,
                       alpha_se=0.4, sigma_se=1.1, var_inf_se=0.4)
              for x in (1.0, math.sqrt(30.0), 30.0)]
    change = sigma_change(replace(levels[0], sigma=1e-5), levels[2])
    assert math.isnan(change.ratio) and change.differs and change.ratio_low > 1e4
    test = alpha_constancy([0.0, 0.5, 1.0], levels)
    assert test.ratio_high == pytest.approx(390.0, rel=0.01)
    assert test.verdict == 'differs' and math.isnan(test.ratio)
    assert 'factor that is not determined' in test.sentence


@pytest.mark.parametrize('seed', [3, 122])
def test_the_estimator_publishes_nothing_of_it(seed):
    recording = nearly_white(seed)
    estimator = SlidingEstimator(window=10.0)
    estimator.push(recording.t, recording.voltage)
    e = estimator.estimate()
    assert e.status in (Status.BURIED, Status.NO_RELAXATION)
    assert all(math.isnan(getattr(e, name)) for name in NAMES)
