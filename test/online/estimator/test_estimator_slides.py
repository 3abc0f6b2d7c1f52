"""The sliding window: blocks or single samples, hours, other lengths, bounded memory."""

import tracemalloc

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.records import Counters
import pytest
from simulated_windows import DT, estimate, paths, stamps

NAMES = ('alpha', 'sigma', 'var_inf', 'u0', 'alpha_se', 'sigma_se', 'var_inf_se', 'u0_se', 'sag')
Y = paths(np.random.default_rng(51), 1, 6000)[0]
T = stamps(6000)
U = 0.2 + 0.5 * (np.floor(T / 0.7) % 2)


def numbers(e):
    return [getattr(e, name) for name in NAMES]


@pytest.mark.parametrize('moving', [False, True])
def test_estimates_on_the_way_change_nothing(moving):
    """With 60 estimates on the way searches start warm."""
    # Each stops where a step gains less than 1e-9 nats, 1e-4 standard errors.
    once, often = SlidingEstimator(2.0), SlidingEstimator(2.0)
    y = Y - 0.6 * U if moving else Y
    once.push(T, y, U if moving else None)
    for begin in range(0, 6000, 97):
        part = slice(begin, begin + 97)
        often.push(T[part], y[part], U[part] if moving else None)
        often.estimate()
    a, b = once.estimate(), often.estimate()
    assert numbers(a) == pytest.approx(numbers(b), rel=1e-4, nan_ok=True)
    assert (a.n, a.duration, a.status, a.flags) == (b.n, b.duration, b.status, b.flags)


@pytest.mark.parametrize('seconds', [1.0, 2.0, 5.0])
def test_the_window_is_as_long_as_asked(seconds):
    estimator = SlidingEstimator(seconds)
    for begin in range(0, 6000, 13):
        estimator.push(T[begin:begin + 13], Y[begin:begin + 13])
        e = estimator.estimate()
        if T[begin] > seconds + 0.1:
            assert seconds - DT <= e.duration <= seconds * (1.0 + 1e-6)


@settings(deadline=None, max_examples=25)
@given(st.floats(0.01, 100.0), st.floats(-100.0, 100.0), st.floats(0.1, 10.0), st.booleans())
def test_units_and_shifts(scale, shift, slower, moving):
    # Doubles at a level of 100 V leave 1e-12 of sums of squares, the search its 1e-4 standard
    # errors (see above).
    n = 1500
    t, y = T[:n], Y[:n]
    u = None
    if moving:
        # Lags are in seconds, so only voltage may be scaled while throttle moves.
        slower, u = 1.0, U[:n]
        y = y - 0.6 * u
    one = estimate(t, y, u, window=2.0)
    two = estimate(slower * t, shift + scale * y, u, window=2.0 * slower)
    assert (two.status, two.n) == (one.status, one.n)
    tight = 2e-4
    assert two.alpha * slower == pytest.approx(one.alpha, rel=tight)
    assert two.sigma * slower ** 0.5 == pytest.approx(scale * one.sigma, rel=tight)
    assert two.var_inf == pytest.approx(scale ** 2 * one.var_inf, rel=tight)
    assert two.u0 == pytest.approx(shift + scale * one.u0, abs=1e-4 * scale)
    assert two.noise_std == pytest.approx(scale * one.noise_std, abs=1e-4 * scale)
    assert (two.alpha_se, two.sigma_se, two.var_inf_se) == pytest.approx(
        (one.alpha_se, one.sigma_se, one.var_inf_se), rel=1e-3)


def test_window_change_keeps_samples():
    """Shorter: the newest stay. Longer: nothing is lost, and the past is not invented."""
    estimator = SlidingEstimator(4.0)
    estimator.push(T, Y)
    assert estimator.estimate().n == pytest.approx(4000, abs=1)
    estimator.window = 1.0
    e = estimator.estimate()
    assert e.n == pytest.approx(1000, abs=1) and e.t == T[-1]
    assert e.alpha == pytest.approx(
        estimate(T[-e.n:], Y[-e.n:], window=1.1).alpha, rel=0.05)
    estimator.window = 3.0
    assert estimator.estimate().n == e.n
    assert estimator.estimate().counters == Counters(pushed=6000, used=6000)
    more = T[-1] + DT * np.arange(1, 1001)
    estimator.push(more, Y[:1000])
    assert estimator.estimate().n == e.n + 1000
    assert estimator.estimate().counters.resets == 0


def test_no_drift_and_bounded_memory():
    """Ten million samples at a level of 12 V, then against an estimator that is new."""
    rng = np.random.default_rng(52)
    y = 12.0 + 0.05 * paths(rng, 1, 10_000)[0]
    t = stamps(10_000)
    old = SlidingEstimator(2.0)
    blocks = 1000
    peak = 0
    for block in range(blocks):
        old.push(block * 10.0 + t, y)
        if block % 20 == 0:
            old.estimate()
        if block == 20:
            tracemalloc.start()
            old.estimate()
            begin = tracemalloc.get_traced_memory()[0]
    end, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # A batch of 32768 in three columns takes 0.8 MB, with room for as many 1.6 MB.
    assert end - begin < 4e6 and peak < 3e7
    e = old.estimate()
    assert e.counters == Counters(pushed=10_000 * blocks, used=10_000 * blocks)
    new = SlidingEstimator(2.0)
    new.push((blocks - 1) * 10.0 + t, y)
    # New searches start elsewhere, which is 1e-6.
    fresh = new.estimate()
    assert (e.n, e.status) == (fresh.n, fresh.status)
    assert numbers(e)[:5] == pytest.approx(numbers(fresh)[:5], rel=1e-5)
