"""Sums over lags against loops over pairs, however the samples came."""

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.online.estimator.window import LAGS, Resolution, SLOTS
import pytest

DT = 1e-3


def loops(t, y, breaks, reference, lags=LAGS):
    """Return n, first, place, second, pairs, change, spread by loops over pairs."""
    z = y - reference
    run = np.zeros(t.size, dtype=int)
    for j in range(1, t.size):
        run[j] = 0 if j in breaks else run[j - 1] + 1
    pairs, change, spread = np.zeros(lags), np.zeros(lags), np.zeros(lags)
    for k in range(1, lags + 1):
        for j in range(k, t.size):
            if run[j] >= k:
                pairs[k - 1] += 1
                change[k - 1] += z[j] - z[j - k]
                spread[k - 1] += (z[j] - z[j - k]) ** 2
    return (t.size, z.sum(), float(z @ np.arange(t.size)), float(z @ z), pairs, change, spread)


def check(sums, expected):
    """Compare; the terms are the same in another order, so 1e-10 of their size is left."""
    n, first, place, second, pairs, change, spread = expected
    assert sums.n == n
    assert sums.first[0] == pytest.approx(first, rel=1e-9, abs=1e-9)
    assert sums.place[0] == pytest.approx(place, rel=1e-9, abs=1e-7)
    assert sums.second[0, 0] == pytest.approx(second, rel=1e-9)
    assert sums.pairs.tolist() == pairs.tolist()
    assert sums.change[:, 0] == pytest.approx(change, abs=1e-9)
    assert sums.spread[:, 0, 0] == pytest.approx(spread, rel=1e-9, abs=1e-12)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10 ** 6), st.integers(1, 300),
       st.lists(st.integers(1, 299), max_size=6), st.lists(st.integers(1, 299), max_size=5))
def test_sums_are_those_of_loops(seed, n, holes, cuts):
    """Any breaks, any pieces, sums taken after each piece or not."""
    rng = np.random.default_rng(seed)
    t, y = np.arange(n) * DT, 5.0 + np.cumsum(rng.standard_normal(n))
    breaks = sorted({hole for hole in holes if hole < n})
    resolution = Resolution(1.0)
    edges = sorted({0, n, *(cut for cut in cuts if cut < n)})
    for begin, end in zip(edges[:-1], edges[1:]):
        inside = [b - begin for b in breaks if begin <= b < end] + ([0] if begin == 0 else [])
        resolution.add(t[begin:end], y[begin:end], None,
                       np.array(sorted(set(inside)), dtype=np.int64))
        if rng.random() < 0.5:
            resolution.sums.total()
    check(resolution.sums.total(), loops(t, y, breaks, resolution.sums.reference))


def test_a_window_that_slid_holds_its_own_samples():
    """Moments of the window alone; pairs that end in it may begin just before it."""
    rng = np.random.default_rng(1)
    n = 3000
    t, y = np.arange(n) * DT, rng.standard_normal(n)
    resolution = Resolution(1.0)
    for begin in range(0, n, 37):
        part = slice(begin, begin + 37)
        resolution.add(t[part], y[part], None, np.array([0] if not begin else [], dtype=np.int64))
        resolution.sums.total()
    sums = resolution.sums.total()
    first = resolution.series.first
    assert n - sums.n == first and abs(sums.n * DT - 1.0) <= 1.0 / SLOTS + DT
    z = y - resolution.sums.reference
    assert sums.first[0] == pytest.approx(z[first:].sum(), abs=1e-9)
    assert sums.place[0] == pytest.approx(z[first:] @ np.arange(sums.n), abs=1e-7)
    for k in range(1, LAGS + 1):
        spread = ((z[first:] - z[first - k:n - k]) ** 2).sum()
        assert sums.spread[k - 1, 0, 0] == pytest.approx(spread, rel=1e-9)
        assert sums.pairs[k - 1] == sums.n


def test_joint_sums_while_throttle_moves():
    """Products of all pairs of variables, by matrices."""
    rng = np.random.default_rng(2)
    n = 500
    t, y = np.arange(n) * DT, rng.standard_normal(n)
    u = 0.3 + 0.4 * (np.floor(t / 0.1) % 2)
    resolution = Resolution(1.0)
    resolution.add(t, y, u, np.array([0], dtype=np.int64))
    sums = resolution.sums.total()
    load = resolution.series.load(resolution.series.first, resolution.series.end)
    z = np.stack([y - resolution.sums.reference, u, u * u, load[1], load[2]])
    assert sums.second == pytest.approx(z @ z.T, rel=1e-9)
    assert sums.first == pytest.approx(z.sum(axis=1), rel=1e-9)
    for k in (1, 5, LAGS):
        d = z[:, k:] - z[:, :-k]
        assert sums.spread[k - 1] == pytest.approx(d @ d.T, rel=1e-9, abs=1e-12)
        assert sums.change[k - 1] == pytest.approx(d.sum(axis=1), abs=1e-10)


def test_coarser_samples_are_means_of_four():
    """Also when they come in pieces; what does not fill a block waits."""
    rng = np.random.default_rng(5)
    n = 1001
    t, y = np.arange(n) * DT, rng.standard_normal(n)
    resolution = Resolution(5.0)
    for begin, end in ((0, 333), (333, 334), (334, n)):
        resolution.add(t[begin:end], y[begin:end], None,
                       np.array([0] if not begin else [], dtype=np.int64))
        coarse = resolution.coarser()
    expected = np.stack([t, y])[:, :1000].reshape(2, 250, 4).mean(axis=2)
    assert coarse.series.columns(0, 250) == pytest.approx(expected, abs=1e-12)
    assert coarse.series.size == 250 and coarse.series.even
    check(coarse.sums.total(), loops(*expected, [], coarse.sums.reference))
