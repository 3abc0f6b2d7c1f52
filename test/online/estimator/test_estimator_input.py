"""Bad input: every sample is counted, and unusable input is refused with a reason."""

from dataclasses import astuple

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.records import Counters, Status
from pushed import pushed
import pytest
from simulated_windows import DT, estimate, paths, stamps

N = 1000
T = stamps(N)
Y = paths(np.random.default_rng(41), 1, N)[0]


def alike(a, b, rel=1e-9):
    """Whether two estimates agree in everything that a sample decides."""
    names = ('alpha', 'sigma', 'var_inf', 'u0', 'noise_std', 'alpha_se', 'sigma_se',
             'var_inf_se', 'u0_se', 'sag', 'voltage', 'throttle', 't', 'duration', 'rate')
    assert (a.status, a.flags, a.n) == (b.status, b.flags, b.n)
    assert [getattr(a, n) for n in names] == pytest.approx(
        [getattr(b, n) for n in names], rel=rel, abs=1e-12, nan_ok=True)


@pytest.mark.parametrize('t, y, u', [
    (T, Y[:-1], None), (T[:, None], Y[:, None], None), (T, 5.0, None), (T, Y, [0.1, 0.2]),
    (0.0, Y, None), (T, Y, np.zeros((N, 1)))])
def test_shapes_that_differ_are_refused(t, y, u):
    estimator = SlidingEstimator(2.0)
    with pytest.raises(ValueError, match=r'\('):
        estimator.push(t, y, u)
    assert estimator.estimate().counters == Counters()


@pytest.mark.parametrize('window', [0.0, -1.0, float('nan'), float('inf')])
def test_windows_that_are_none_are_refused(window):
    with pytest.raises(ValueError, match='window'):
        SlidingEstimator(window)
    with pytest.raises(ValueError, match='fastest'):
        SlidingEstimator(1.0, fastest=window)
    estimator = SlidingEstimator(1.0)
    with pytest.raises(ValueError, match='window'):
        estimator.window = window
    assert estimator.window == 1.0


def test_nothing_and_one_sample():
    estimator = pushed(SlidingEstimator(2.0), [], [])
    estimator.push(np.empty(0), np.empty(0), 0.5)
    e = estimator.estimate()
    assert e.status is Status.NO_DATA and e.counters == Counters()
    estimator.push(3.0, 5.0, 0.2)
    e = estimator.estimate()
    assert (e.status, e.n, e.t, e.voltage) == (Status.TOO_FEW_SAMPLES, 1, 3.0, 5.0)
    estimator.push([], [])
    assert estimator.estimate() == e


def test_a_fit_needs_twenty_samples():
    for n in (19, 20):
        assert (estimate(T[:n], Y[:n], window=2.0).status is Status.TOO_FEW_SAMPLES) == (n < 20)


def test_non_finite_samples_are_dropped_and_counted():
    t, y = T.copy(), Y.copy()
    y[[3, 500]] = np.nan, np.inf
    t[[10, 700]] = -np.inf, np.nan
    good = np.isfinite(t) & np.isfinite(y)
    a, b = estimate(t, y, window=2.0), estimate(t[good], y[good], window=2.0)
    assert a.counters == Counters(pushed=N, used=N - 4, non_finite=4)
    assert a.alpha == pytest.approx(b.alpha, rel=1e-12) and a.n == N - 4
    e = estimate([0.0, np.nan], [np.nan, 5.0], window=2.0)
    assert e.status is Status.NO_DATA and e.counters == Counters(pushed=2, non_finite=2)


def test_late_samples_in_one_batch_are_sorted_in():
    order = np.random.default_rng(42).permutation(N)
    # The first stamp stays first: what comes before the window begins is another matter.
    order = np.concatenate([[0], order[order != 0]])
    e = estimate(T[order], Y[order], window=2.0)
    alike(estimate(T, Y, window=2.0), e, rel=1e-12)
    assert e.counters == Counters(pushed=N, used=N)
    e = estimate(np.append(T, T[-1]), np.append(Y, 99.0), window=2.0)
    assert e.counters == Counters(pushed=N + 1, used=N, late=1) and e.voltage == Y[-1]


def test_late_samples_after_an_estimate_are_dropped_and_counted():
    estimator = pushed(SlidingEstimator(2.0), T, Y)
    before = estimator.estimate()
    estimator.push(T[-5:], Y[-5:])
    after = estimator.estimate()
    assert after.counters == Counters(pushed=N + 5, used=N, late=5)
    assert after.alpha == pytest.approx(before.alpha, rel=1e-6)
    # None of several late samples, and none among good ones, gets through.
    t = [T[-1] + DT, T[-3], T[-2], T[-1] + 2 * DT]
    estimator.push(t, [5.0] * 4)
    e = estimator.estimate()
    assert (e.counters.used, e.counters.late, e.t) == (N + 2, 7, t[-1])


@pytest.mark.parametrize('shift', [-100.0, 100.0])
@pytest.mark.parametrize('first', [True, False])
def test_jumps_of_more_than_the_window_clear_it(shift, first):
    """Also within one push, the first one or not: what is left is what came after."""
    fresh, jumped = SlidingEstimator(2.0), SlidingEstimator(2.0)
    fresh.push(T + shift, Y)
    t, y = np.concatenate([T, T + shift]), np.concatenate([Y + 1.0, Y])
    if first:
        jumped.push(t, y)
    else:
        jumped.push(t[:5], y[:5])
        jumped.estimate()
        jumped.push(t[5:], y[5:])
    a, b = jumped.estimate(), fresh.estimate()
    assert (a.n, a.t) == (N, b.t)
    assert a.alpha == pytest.approx(b.alpha, rel=1e-6)
    assert a.counters == Counters(pushed=2 * N, used=2 * N, resets=1)


def test_reset_clears_and_counts():
    estimator = pushed(SlidingEstimator(2.0), T, Y)
    estimator.reset()
    e = estimator.estimate()
    assert e.status is Status.NO_DATA and e.n == 0
    assert e.counters == Counters(pushed=N, used=N, resets=1)
    estimator.push(T[:500], Y[:500])
    assert estimator.estimate().n == 500


SAMPLE = st.tuples(
    st.sampled_from(['step', 'step', 'step', 'back', 'same', 'gap', 'far back', 'nan t', 'inf y']),
    st.booleans())


@settings(deadline=None, max_examples=150)
@given(st.lists(SAMPLE, max_size=80), st.integers(1, 30), st.booleans())
def test_the_account_adds_up(samples, block, throttle):
    estimator = SlidingEstimator(0.05)
    now, t, y = 0.0, [], []
    for kind, _ in samples:
        now += {'step': DT, 'back': -0.01, 'same': 0.0, 'gap': 1.0, 'far back': -1.0}.get(kind, DT)
        t.append(float('nan') if kind == 'nan t' else now)
        y.append(float('inf') if kind == 'inf y' else 5.0 + 0.01 * len(t) % 3)
    looks = [look for _, look in samples]
    for begin in range(0, len(t), block):
        part = slice(begin, begin + block)
        estimator.push(t[part], y[part], 0.5 if throttle else None)
        if looks[begin]:
            estimator.estimate()
    e = estimator.estimate()
    c = e.counters
    assert c.pushed == len(t) == c.used + c.non_finite + c.late + c.held
    assert c.non_finite == sum(kind in ('nan t', 'inf y') for kind, _ in samples)
    assert min(astuple(c)) >= 0
    assert e.n <= c.used
