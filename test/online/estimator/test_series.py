"""Columns that slide: lags of the throttle, runs of equal steps, memory."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.online.estimator.window import (
    FAST, lagged, LOAD_LAGS, SLOW, T, U, WindowColumns, Y)
import pytest

START = np.array([0], dtype=np.int64)
NONE = np.array([], dtype=np.int64)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.integers(2, 60), st.sampled_from([1e-4, 1e-3, 0.02, 1.0]),
       st.sampled_from([0.01, 0.04]))
def test_lagged_is_the_exact_solution_for_held_input(seed, n, step, tau):
    """Sample by sample: x' = (u - x)/tau with u held from each stamp to the next."""
    rng = np.random.default_rng(seed)
    t = 7.0 + np.cumsum(rng.exponential(step, n) + 1e-7)
    u = np.repeat(rng.random(n), 3)[:n]
    state, expected = u[0], [u[0]]
    for j in range(1, n):
        keep = math.exp(-(t[j] - t[j - 1]) / tau)
        state = keep * state + (1.0 - keep) * u[j - 1]
        expected.append(state)
    # What has settled to 1e-7 is set to the throttle.
    before = (math.nan, math.nan, math.nan)
    assert lagged(t, u, tau, before) == pytest.approx(expected, abs=3e-7)
    half = n // 2
    first = lagged(t[:half], u[:half], tau, before) if half else np.empty(0)
    if half:
        rest = lagged(t[half:], u[half:], tau, (t[half - 1], u[half - 1], first[-1]))
        assert np.concatenate([first, rest]) == pytest.approx(expected, abs=3e-7)


def test_lags_are_ten_and_forty_milliseconds():
    """A step reaches 1 - 1/e after one lag: motors 5..20 ms, current within 40 ms."""
    series = WindowColumns(24)
    t = np.arange(200) * 1e-3
    u = np.where(t >= 0.0495, 1.0, 0.0)
    series.append(t, np.zeros(200), u, START)
    assert LOAD_LAGS == (0.010, 0.040)
    for column, lag in ((FAST, 10), (SLOW, 40)):
        assert series.column(column)[50 + lag] == pytest.approx(1.0 - math.exp(-1.0), abs=1e-6)
    assert series.column(U).tolist() == u.tolist()


@settings(deadline=None, max_examples=60)
@given(st.lists(st.tuples(st.integers(1, 400), st.integers(0, 500), st.booleans()), max_size=25))
def test_columns_are_what_was_put_in(steps):
    """Any appends and drops: contents, numbering, runs, and what stays readable behind."""
    reach = 24
    series = WindowColumns(reach)
    t, y, run, first = [], [], [], 0
    for n, drop, broken in steps:
        begin = len(t)
        new = np.arange(begin, begin + n, dtype=float)
        breaks = START if broken or not begin else NONE
        series.append(new, 2.0 * new, None, breaks)
        for j in range(n):
            run.append(0 if (j == 0 and breaks.size) else run[-1] + 1)
        t += new.tolist()
        y += (2.0 * new).tolist()
        series.drop_before(first + drop)
        first = min(first + drop, len(t))
        assert (series.first, series.end, series.size) == (first, len(t), len(t) - first)
        assert series.column(T).tolist() == t[first:]
        assert series.column(Y).tolist() == y[first:]
        assert series.runs(first, len(t)).tolist() == [min(r, reach) for r in run[first:]]
        back = series.behind
        assert back <= reach
        assert series.columns(first - back, len(t))[T].tolist() == t[first - back:]
