"""Repeats by loggers: recognised, distinguished from coarse ADCs, and dropped without bias."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.records import Counters, Flag, Recording, Status
from ou_monitor.timeline import as_columns, Batch, readings_of, refresh_period, Repeats
import pytest
from scipy.signal import lfilter
from simulated_windows import ALPHA, DT, errors, estimate, LEVEL, paths, SIGMA, stamps


# Standard deviation of the increments of the OU over DT, V.
INCREMENT = SIGMA * math.sqrt(DT)
FACTORS = [2, 3, 5, 8, 10, 16, 25, 50]
# 1000 Hz of 300 Hz (3, 3, 4), of 400 Hz (2, 3), of 96 Hz.
RATIOS = [10 / 3, 2.5, 2.2, 1000 / 96]


def which(rng, n, factor):
    return np.floor((np.arange(n) + rng.uniform(0.0, factor)) / factor).astype(int)


def logged(rng, n, factor, alpha=ALPHA):
    return paths(rng, 1, n // 2 + 2, DT, alpha)[0][which(rng, n, factor)]


def lowpassed(y, corner):
    """Return the path through a first-order low-pass, Hz."""
    k = -math.expm1(-2.0 * math.pi * corner * DT)
    return LEVEL + lfilter([k], [1.0, k - 1.0], y - LEVEL)


@pytest.mark.parametrize('factor', FACTORS + RATIOS)
def test_repeats_are_counted_and_noted(factor):
    """Twenty sources of each: the period is right to one sample in the whole."""
    # 1024 samples, as many as the estimator looks at; 20 changes for a factor of 50.
    rng = np.random.default_rng(1)
    for kind in (np.float64, np.float32):
        for _ in range(20):
            y = logged(rng, 1024, factor).astype(kind).astype(np.float64)
            assert refresh_period(y) == pytest.approx(factor, abs=2.0 * factor / 1024)


@pytest.mark.parametrize('factor', [2, 3, 10 / 3, 5, 8, 10])
def test_repeats_through_a_coarse_adc(factor):
    rng = np.random.default_rng(2)
    found = [refresh_period(INCREMENT * np.round(logged(rng, 1024, factor) / INCREMENT))
             for _ in range(40)]
    # Of 60 changes (factor 10) a tenth must be of more than one code, of 22 % expected:
    # 2.3 standard deviations, one in a hundred, and by as much again too few or too many doubles.
    assert np.mean(np.array(found) > 1.0) >= 0.85
    assert np.median(found) == pytest.approx(factor, rel=0.02)


@pytest.mark.parametrize('factor', [5.0, 10 / 3 * 2, 20.0])
def test_repeats_are_found_if_readings_seldom_change_the_code(factor):
    """
    Steps of the ADC three times the deviation of the readings: nearly all changes are by one code.

    Some 150 changes in 8000 samples.  Before, none of 40 was recognised.
    """
    rng = np.random.default_rng(12)
    found = []
    for _ in range(40):
        slow = lfilter([math.sqrt(1.0 - 0.8 ** 2)], [1.0, -0.8], rng.standard_normal(8000))
        found.append(refresh_period(np.round(slow[which(rng, 8000, factor)] / 3.0)))
    assert np.mean(np.array(found) > 1.0) >= 0.9
    assert np.median(found) == pytest.approx(factor, rel=0.02)


def test_repeats_are_found_if_the_logger_loses_samples():
    """One sample in 200 lost: gaps of 9 among those of 10."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        y = logged(rng, 1100, 10)
        y = y[rng.random(y.size) > 0.005][-1024:]
        assert refresh_period(y) == pytest.approx(10.0, rel=0.02)


def test_repeats_of_a_source_with_jitter_are_found():
    """Refreshes early or late by 5 % of a period of 16 samples."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        at = 16.0 * np.arange(100) + 0.8 * rng.standard_normal(100)
        y = paths(rng, 1, 100)[0][np.searchsorted(at, np.arange(30, 1054))]
        assert refresh_period(y) == pytest.approx(16.0, rel=0.02)


COARSE = {
    'rail': lambda rng: paths(rng, 1, 1024)[0],
    'slow rail': lambda rng: paths(rng, 1, 1024, DT, 1.0)[0],
    'noise': lambda rng: LEVEL + INCREMENT * rng.standard_normal(1024),
    'behind 100 Hz': lambda rng: lowpassed(paths(rng, 1, 1024)[0], 100.0),
    'behind 20 Hz': lambda rng: lowpassed(paths(rng, 1, 1024)[0], 20.0),
    'saturated': lambda rng: np.clip(paths(rng, 1, 1024)[0], LEVEL - 0.03, LEVEL + 0.03),
    'ramp': lambda rng: LEVEL + 5e-3 * rng.random() * np.arange(1024),
    'ripple': lambda rng: (LEVEL + 0.1 * np.sin(0.31 * np.arange(1024) + 6.0 * rng.random())
                           + 2e-3 * rng.standard_normal(1024)),
}


@pytest.mark.parametrize('name', COARSE)
def test_coarse_adcs_are_not_repeats(name):
    """Steps of 0.5 to 3 increments, 200 windows each: never, of 1000."""
    # None in 1000 holds the rate below 0.5 % at 99 % confidence (exp(-0.005 1000)).
    rng = np.random.default_rng(5)
    for steps in (0.5, 1.0, 1.5, 2.0, 3.0):
        code = steps * INCREMENT
        for _ in range(200):
            y = code * np.round(COARSE[name](rng) / code + rng.random())
            assert refresh_period(y) == 1.0


@pytest.mark.parametrize('y', [
    np.full(1024, 5.0), np.empty(0), np.ones(1), np.r_[np.zeros(500), np.ones(500)],
    # A square wave, a glitch once in a hundred samples, a triangle through a coarse ADC.
    np.repeat(np.arange(100) % 2, 10), (np.arange(1024) % 100 == 7) * 1.0,
    np.abs(np.arange(1024) // 10 % 20 - 10.0)])
def test_regular_patterns_are_not_repeats(y):
    """Constants, and what a coarse ADC makes of a signal with a period."""
    assert refresh_period(y.astype(np.float64)) == 1.0


def test_a_known_period_is_kept_until_contradicted():
    """With few changes it stands; a source that refreshes every sample ends it."""
    rng = np.random.default_rng(6)
    assert refresh_period(logged(rng, 100, 50), 50.0) == 50.0
    assert refresh_period(np.full(1024, 5.0), 8.0) == 8.0
    assert refresh_period(logged(rng, 1024, 8), 8.0) == 8.0
    assert refresh_period(paths(rng, 1, 1024)[0], 8.0) == 1.0
    assert refresh_period(logged(rng, 1024, 3), 8.0) == 3.0


def batch(y, first=0):
    """Return samples at 1, 2, 3..."""
    t = 1.0 + first + np.arange(len(y))
    return Batch(as_columns(t, np.asarray(y)), False)


def dropped_to(y, period, sizes=()):
    """Return the places that are kept, fed in pieces of the sizes given."""
    repeats = Repeats()
    repeats.period = period
    kept = []
    edges = [0, *np.minimum(np.cumsum(sizes, dtype=int), len(y)).tolist(), len(y)]
    for low, high in zip(edges[:-1], edges[1:]):
        part = repeats.drop(batch(y[low:high], low)) if high > low else None
        if part is not None:
            kept += (part.t - 1.0).astype(int).tolist()
            assert (part.y == np.asarray(y, dtype=np.float64)[kept[-part.t.size:]]).all()
    return kept


def test_refreshes_stay_where_they_were():
    """Also those that happen to equal the one before; the last is known half a period later."""
    source = [1.0, 2.0, 2.0, 3.0, 1.0, 1.0, 1.0, 5.0]
    assert dropped_to(np.repeat(source, 4), 4.0) == [4 * k for k in range(1, 8)]
    assert dropped_to(np.repeat([1.0, 2.0, 3.0, 4.0], [2, 3, 2, 3]), 2.5) == [2, 5, 7]
    # 3, 3, 4: the run of 7 is two refreshes, that of 10 three.
    assert dropped_to(np.repeat([1.0, 2.0, 3.0, 1.0], [3, 7, 10, 3]), 10 / 3) == [
        3, 6, 10, 13, 17, 20]
    assert dropped_to(np.repeat([1.0, 2.0], [4, 5]), 4.0) == [4]
    assert dropped_to(np.repeat([1.0, 2.0], [4, 6]), 4.0) == [4, 8]


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 10 ** 6), st.floats(2.0, 12.0), st.lists(st.integers(0, 30), max_size=40))
def test_batches_of_any_size_give_equal_readings(seed, period, sizes):
    """The same refreshes, whatever the pieces they come in."""
    rng = np.random.default_rng(seed)
    y = rng.integers(0, 3, 400)[which(rng, 400, period)]
    assert dropped_to(y, period, sizes) == dropped_to(y, period)


def test_steps_and_throttle_of_refreshes():
    repeats = Repeats()
    repeats.period = 4.0
    y = np.repeat([0.0, 1.0, 2.0, 3.0, 4.0], 4)
    assert repeats.drop(batch(y[:12])).t.tolist() == [5.0, 9.0]
    part = batch(y[12:], 12)
    second = repeats.drop(Batch(as_columns(part.t, part.y, np.arange(8.0)), False))
    assert second.t.tolist() == [13.0, 17.0] and second.columns[2].tolist() == [0.0, 4.0]
    assert repeats.drop(batch([4.0], 20)) is None
    repeats.forget()
    assert repeats.drop(batch(y[:12], 30)).t.tolist() == [35.0, 39.0]


@pytest.mark.parametrize('factor', FACTORS + RATIOS[:2])
def test_dropping_leaves_no_bias(factor):
    # Paired with the fit of the source itself, a refresh is late by half a logged sample on
    # average, the same for all: what is left is one sample more or less in 2000, 0.05 %. Against
    # the truth: an error of 3.5 Monte Carlo errors is chance once in 2000, and the bias of windows
    # of 2 s is 1 % at most (doc/estimation.md).
    rng = np.random.default_rng(7)
    n = 2000
    found, alone = [], []
    for y in paths(rng, 40, n):
        count = int(n * factor) - 1
        t = np.arange(count) * (DT / factor)
        log = y[np.minimum(which(rng, count, factor), n - 1)]
        found.append(estimate(t, log, window=2.05, fastest=1e5))
        alone.append(estimate(stamps(n), y, window=2.05))
    assert all(Flag.HELD_SAMPLES in e.flags for e in found)
    assert {e.status for e in found} == {Status.OK}
    error, other = errors(found), errors(alone)
    # One refresh at an end changes alpha by some 0.5 %: an excursion begins or ends there.
    assert np.abs(error - other).mean() < 0.005
    spread = error.std(axis=0) / math.sqrt(40)
    assert (np.abs(error.mean(axis=0)) < 0.015 + 3.5 * spread).all()
    # With power: as they are, the repeats spread each increment over `factor` samples.
    assert spread[1] < 0.01


def test_counters_of_repeats():
    rng = np.random.default_rng(8)
    y = np.repeat(paths(rng, 1, 800)[0], 10)
    t = 1e-4 * np.arange(y.size)
    whole_at_once = estimate(t, y)
    assert whole_at_once.counters == Counters(pushed=8000, used=799, held=7201)
    assert whole_at_once.n == 799 and whole_at_once.rate == pytest.approx(1000.0, rel=0.01)
    estimator = SlidingEstimator(0.5)
    for begin in range(0, y.size, 50):
        estimator.push(t[begin:begin + 50], y[begin:begin + 50])
        e = estimator.estimate()
        c = e.counters
        assert c.pushed == begin + 50 == c.used + c.held and c.held >= 0
    # Found before anything slid out of the window.
    assert (c.used, c.held, c.resets) == (799, 7201, 0)
    assert e.n <= 510 and Flag.HELD_SAMPLES in e.flags


def test_a_fast_logger_is_thinned_after_its_repeats_are_dropped():
    """25 kHz of a 1 kHz source: means of repeats would make sigma wrong."""
    rng = np.random.default_rng(10)
    found = []
    for y in paths(rng, 20, 2000):
        log = np.repeat(y, 25)
        found.append(estimate(np.arange(log.size) * (DT / 25), log, window=2.05))
    assert found[0].counters == Counters(pushed=50_000, used=1999, held=48_001)
    assert found[0].rate == pytest.approx(1000.0, rel=1e-3)
    error = errors(found)
    assert (np.abs(error.mean(axis=0)) < 0.015 + 3.5 * error.std(axis=0) / math.sqrt(20)).all()


def test_a_source_that_stops_repeating():
    """From every tenth sample to every sample: two windows later all are used."""
    rng = np.random.default_rng(11)
    slow, fast = np.repeat(paths(rng, 1, 300)[0], 10), paths(rng, 1, 3000)[0]
    estimator = SlidingEstimator(1.0)
    t, y = stamps(6000), np.concatenate([slow, fast])
    for begin in range(0, 6000, 100):
        estimator.push(t[begin:begin + 100], y[begin:begin + 100])
        e = estimator.estimate()
        if begin == 2900:
            assert Flag.HELD_SAMPLES in e.flags and e.n <= 105
    assert Flag.HELD_SAMPLES not in e.flags and e.status is Status.OK
    assert e.n >= 970 and e.rate == pytest.approx(1000.0, rel=0.01)


@pytest.mark.parametrize('period', [2, 2.5, 3.3, 10])
def test_a_recording_holds_each_reading_once(period):
    """
    Each but the first, also one that repeats the value before; throttle and current beside it.

    A logger of 500 Hz is up to 2 ms late; where its source has a clock of its own the stamps are
    put on the even grid of that, which is true to the mean of that.
    """
    rng = np.random.default_rng(12)
    fresh = np.rint(rng.standard_normal(400) * 5) / 100 + 5
    place = np.floor(np.arange(int(400 * period)) / period).astype(int)
    t = 0.002 * np.arange(place.size)
    found = readings_of(Recording(t, fresh[place], 0.1 * t, current=2.0 * t))
    assert int((np.diff(fresh) == 0).sum()) > 10
    np.testing.assert_array_equal(found.voltage, fresh[1:1 + found.n])
    assert found.n >= 398 and found.held == t.size - found.n
    read = 0.002 * period * np.arange(1, 1 + found.n)
    assert np.abs(found.t - read - np.median(found.t - read)).max() < 0.002
    np.testing.assert_allclose(found.throttle, 0.1 * found.t, atol=2.1e-4)
    np.testing.assert_allclose(found.current, 20.0 * found.throttle)
    assert readings_of(found) is found


def test_ties_without_a_period_are_readings():
    """Where repeats come at no steady distance nothing is left out."""
    rng = np.random.default_rng(13)
    values = np.rint(rng.standard_normal(3000)) / 100 + 5
    one = Recording(0.01 * np.arange(3000), values, np.full(3000, math.nan))
    assert readings_of(one) is one and one.held == 0


def series(gaps, sizes=(1.0, 2.0, 5.0)):
    """Return values that change after these gaps, by steps of several sizes, up and down."""
    steps = np.resize(sizes, len(gaps) + 1) * np.resize((1.0, -1.0, -1.0, 1.0), len(gaps) + 1)
    return np.repeat(np.concatenate(([0.0], np.cumsum(steps))), [1, *gaps, 1])


@pytest.mark.parametrize('period', [2, 3, 4, 7])
def test_a_period_needs_twenty_nats(period):
    gaps = np.arange(1, 2000)
    law = (1.0 - 1.0 / period) ** (gaps - 1) / period
    chance = law[gaps % period == 0].sum()
    divergence = 0.95 * math.log(0.95 / chance) + 0.05 * math.log(0.05 / (1.0 - chance))
    enough = math.ceil(20.0 / divergence)
    assert refresh_period(series([period] * enough)) == period
    assert refresh_period(series([period] * (enough - 1))) == 1.0


@pytest.mark.parametrize('gaps, period', [
    # Two neighbouring lengths, also with a refresh that gave the same value; one in twenty odd.
    ([3, 3, 4] * 20, 10 / 3), ([3, 4, 3, 7, 3, 3] * 10, 23 / 7), ([5] * 57 + [3] * 3, None),
    # 7 to 13 where 10 is meant; 6 and 14 are one and two periods.
    ([7, 13, 10, 10] * 30, 10.0), ([6, 14] * 60, 20 / 3), ([6, 15] * 60, 1.0),
    # One in two samples changes at least; 1.5 times the usual gap is no double one.
    ([2, 2] * 30, 2.0), ([1, 2, 2, 1, 1] * 30, 1.0)])
def test_periods_by_the_gaps(gaps, period):
    found = refresh_period(series(gaps))
    if period is None:
        # The odd ones are left out.
        period = (57 * 5 + (9 if abs(3 - 5) <= 1.75 else 0)) / 57
    assert found == pytest.approx(period)


@pytest.mark.parametrize('depends, size', [(np.abs, True), (lambda u: 0.5 * (u + 1.0), False)])
def test_reverse_counts_as_load_if_the_voltage_falls_with_it(depends, size):
    """A robot's duty from -1 to 1 gave a sag of 3.7 V for 0.7; a stick's middle is half load."""
    rng = np.random.default_rng(5)
    u = rng.choice([-1.0, -0.5, 0.0, 0.3, 1.0], 100).repeat(20)
    t = np.arange(u.size) / 20.0
    v = 12.0 - 0.7 * depends(u) + 0.02 * rng.standard_normal(u.size)
    found = readings_of(Recording(t, v, u))
    np.testing.assert_array_equal(found.throttle, np.abs(u) if size else u)
    assert any('absolute value' in note for note in found.notes) == size
