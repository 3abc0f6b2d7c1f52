"""Time axes and arrays of pandas, xarray and NumPy: understood or refused, never misread."""

from datetime import datetime, timedelta, timezone

import numpy as np
from ou_monitor import (
    analyze, compare, coupling, discover, InputError, MonitorSettings, Recording,
    SlidingEstimator, supply_facts, SupplyMonitor)
from ou_monitor.records import as_seconds
import pytest

N = 400
SECONDS = 0.01 * np.arange(N)
VOLTS = 15.0 + 0.01 * np.random.default_rng(1).standard_normal(N)
DATES = np.datetime64('2024-05-16T08:00', 'ns') + np.rint(1e9 * SECONDS).astype('timedelta64[ns]')
BEGIN = datetime(2024, 5, 16, 8, 0, tzinfo=timezone.utc)


class Axis:
    """An array of another library, as `pandas.Series` and `xarray.DataArray` are to NumPy."""

    def __init__(self, values):
        self._values = values

    def __array__(self, dtype=None, copy=None):
        return self._values if dtype is None else self._values.astype(dtype)


AXES = {
    'seconds': SECONDS, 'list': SECONDS.tolist(), 'dates': DATES, 'milliseconds': DATES.astype(
        'datetime64[ms]'), 'spans': DATES - DATES[0], 'pandas': Axis(DATES),
    'zone': Axis(np.array([BEGIN + timedelta(seconds=t) for t in SECONDS.tolist()], dtype=object)),
    'datetime': np.array([BEGIN.replace(tzinfo=None) + timedelta(seconds=t)
                          for t in SECONDS.tolist()], dtype=object),
    'masked': np.ma.masked_array(SECONDS, np.zeros(N, dtype=bool)),
    'whole ns': DATES.astype(np.int64), 'float ns': DATES.astype(np.int64).astype(float),
    'whole us': DATES.astype('datetime64[us]').astype(np.int64),
    'float ms': 1e3 * (BEGIN.timestamp() + SECONDS), 'pandas ns': Axis(DATES.astype(np.int64)),
    'list of ms': (1e3 * (BEGIN.timestamp() + SECONDS)).tolist(),
    'masked ns': np.ma.masked_array(DATES.astype(np.int64), np.zeros(N, dtype=bool))}


@pytest.mark.parametrize('axis', AXES)
def test_a_time_axis_is_seconds(axis):
    """A recording, the estimator and the monitor have the samples 10 ms apart."""
    recording = Recording(AXES[axis], VOLTS, np.full(N, 0.3))
    np.testing.assert_allclose(np.diff(recording.t), 0.01, atol=1e-6)
    counted = axis in ('seconds', 'list', 'spans', 'masked')
    assert recording.t[0] == pytest.approx(0.0 if counted else BEGIN.timestamp(), abs=1e-6)
    estimator, monitor = SlidingEstimator(), SupplyMonitor(MonitorSettings())
    estimator.push(AXES[axis], VOLTS)
    monitor.push(AXES[axis], VOLTS, 0.3)
    found = estimator.estimate()
    assert found.rate == pytest.approx(100.0, rel=0.01) and found.counters.resets == 0
    assert monitor.report(0.0).estimate.rate == pytest.approx(100.0, rel=0.01)


def test_dates_are_exact_to_the_microsecond():
    """Nanoseconds since 1970 are beyond float64, their seconds are not."""
    t = np.datetime64('2024-05-16T08:00:00.123456', 'ns') + np.arange(4) * np.timedelta64(10, 'us')
    np.testing.assert_allclose(np.diff(Recording(t, VOLTS[:4], VOLTS[:4]).t), 1e-5, atol=3e-7)


def test_dates_far_from_today_and_whole_numbers_to_the_microsecond():
    """Nanoseconds of a year 3000 are beyond int64; of 2024 beyond float64."""
    far = np.array(['3000-01-01T00:00:00.5', '1000-01-01'], dtype='datetime64[ms]')
    np.testing.assert_allclose(as_seconds(far), [32503680000.5, -30610224000.0])
    ns = DATES.astype(np.int64)[:4] + np.arange(4) * 10_123
    np.testing.assert_allclose(np.diff(as_seconds(ns)), 0.010010123, atol=3e-7)


def test_one_clock_reads_sample_by_sample():
    estimator, monitor = SlidingEstimator(), SupplyMonitor(MonitorSettings())
    for t, volts in zip((1e3 * (BEGIN.timestamp() + SECONDS)).tolist(), VOLTS.tolist()):
        estimator.push(t, volts)
        monitor.push(t, volts)
    assert estimator.estimate().rate == pytest.approx(100.0, rel=0.01)
    assert monitor.report(0.0).estimate.counters.resets == 0


MANY = [1.7e12 + 1e3 * t if k % 2 else 1.7e9 + t for k, t in enumerate(SECONDS.tolist())]


@pytest.mark.parametrize('t, words', [
    (MANY, 'implausible'), (np.sort(MANY), 'implausible'),
    (np.where(np.arange(N) == 50, 1.7e12, SECONDS), 'implausible'),
    # Nanoseconds since a start-up 25 minutes ago look like milliseconds of 2017, 10^4 s apart.
    ((1.5e12 + 1e9 * SECONDS).astype(np.int64), 'implausible'), (1e14 * SECONDS, 'implausible')])
def test_a_mixed_or_unknown_unit_is_refused(t, words):
    """No stamp is taken for seconds which another shows to be none; a stream drops them."""
    with pytest.raises(ValueError, match=words):
        Recording(t, VOLTS, VOLTS)
    monitor = SupplyMonitor(MonitorSettings())
    monitor.push(t, VOLTS, 0.3)
    assert monitor.report(0.0).estimate.counters.non_finite == (np.abs(t) > 1e11).sum() > 0


CALLS = {
    'analyze': analyze, 'discover': discover, 'compare': lambda one: compare(one, seeds=20),
    'coupling': lambda one: coupling(one, (one.t, -one.voltage)), 'supply_facts': supply_facts}


@pytest.mark.parametrize('call', sorted({*CALLS} - {'coupling'}))
def test_stamps_in_whole_seconds(call):
    """100 samples share a stamp: refused, because their times could only be guessed."""
    t = np.arange(3000) / 100.0
    throttle = np.where(t % 2.0 < 1.0, 0.2, 0.5)
    volts = 15.0 - throttle + 0.01 * np.random.default_rng(2).standard_normal(t.size)
    found = CALLS[call](Recording(t, volts, throttle))
    fine = getattr(found, 'supply', found)
    dates = np.datetime64('2026-01-01') + t.astype('timedelta64[s]')
    with pytest.raises(InputError, match='share 30 stamps: give finer stamps, or the interval'):
        CALLS[call](Recording(dates, volts, throttle))
    # A logger that repeats stamp and reading loses nothing.
    places = np.repeat(np.arange(t.size), np.arange(t.size) % 7 + 1)
    again = CALLS[call](Recording(t[places], volts[places], throttle[places]))
    assert getattr(again, 'supply', again).to_dict() == fine.to_dict()


@pytest.mark.parametrize('call', CALLS)
def test_stamps_in_disorder_are_sorted_as_of_a_file(call):
    """Decreasing, repeated, unknown or negative: the same answer as in order; others no answer."""
    t = np.arange(600) * 0.01 - 5.0
    throttle = np.where(t % 2.0 < 1.0, 0.2, 0.5)
    volts = 15.0 - throttle + 0.01 * np.random.default_rng(2).standard_normal(t.size)
    part = [*range(t.size)[::-1], 7, 9]
    facts = []
    for recording in (Recording(t, volts, throttle), Recording(
            np.append(t[::-1], [t[5], np.nan]), volts[part], throttle[part])):
        found = CALLS[call](recording)
        facts.append(getattr(found, 'supply', found).to_dict())
    assert facts[0]['ou']['status'] == 'not_visible' and facts[0]['sag']['known']
    assert facts[1] == facts[0]
    with pytest.raises(InputError, match='1e.04 s apart: are the stamps in ms, us or ns'):
        CALLS[call](Recording(1e6 * t, volts, throttle))


def test_masked_values_are_unknown():
    masked = np.ma.masked_array(VOLTS, VOLTS > 15.01)
    recording = Recording(SECONDS, masked, np.ma.masked_less(np.full(N, 0.3), 0.5))
    assert np.isnan(recording.voltage).sum() == (VOLTS > 15.01).sum() > 0
    assert type(recording.voltage) is np.ndarray and not recording.has_throttle
    estimator = SlidingEstimator()
    estimator.push(SECONDS, masked)
    assert estimator.estimate().counters.non_finite == (VOLTS > 15.01).sum()
    dates = DATES.copy()
    dates[3] = np.datetime64('NaT', 'ns')
    assert np.isnan(Recording(dates, VOLTS, VOLTS).t).tolist() == [k == 3 for k in range(N)]
    # In a zone, pandas has them as objects.
    zoned = [datetime.fromtimestamp(k, timezone.utc) for k in range(N)]
    zoned[0] = np.datetime64('NaT', 'ns')
    assert np.isnan(as_seconds(np.array(zoned, dtype=object))).tolist() == [
        k == 0 for k in range(N)]


class Indexed(Axis):
    """A `pandas.Series`: an array with an index, which has `equals`."""

    def __init__(self, values, order):
        super().__init__(values)
        self.index = self
        self._order = order

    def equals(self, other):
        return self._order == other._order


def test_series_of_two_orders_are_refused():
    """They would be paired by place; the same order, an array or a list beside them will do."""
    volts, throttle = Indexed(VOLTS, 'by time'), np.full(N, 0.3)
    for beside in (Indexed(throttle, 'by time'), throttle, throttle.tolist()):
        np.testing.assert_array_equal(Recording(SECONDS, volts, beside).throttle, throttle)
    with pytest.raises(ValueError, match='different indices: align them'):
        Recording(SECONDS, volts, Indexed(throttle, 'by size'))
    with pytest.raises(ValueError, match='different indices'):
        Recording(Indexed(SECONDS, 'by size'), volts)


def test_a_fourth_array_is_not_taken_for_the_name():
    with pytest.raises(TypeError, match='give a current as current='):
        Recording(SECONDS, VOLTS, VOLTS, VOLTS)


def test_missing_throttle_is_unknown():
    """Left out or None it is unknown; a number holds for all samples."""
    for recording in (Recording(SECONDS, VOLTS), Recording(DATES, VOLTS, None)):
        assert recording.throttle.shape == (N,) and not recording.has_throttle
    assert analyze(Recording(SECONDS, VOLTS)).supply.lowest.voltage_v == VOLTS.min()
    np.testing.assert_array_equal(Recording(SECONDS, VOLTS, 0.3).throttle, np.full(N, 0.3))


@pytest.mark.parametrize('t, volts', [
    (SECONDS, DATES), (SECONDS, VOLTS.astype(str)), (SECONDS.astype(str), VOLTS),
    (SECONDS, VOLTS.astype(complex)),
    (SECONDS, Axis(np.array([object()] * N)))])
def test_other_arrays_are_refused(t, volts):
    for use in (lambda: Recording(t, volts, np.full(N, 0.3)),
                lambda: SlidingEstimator().push(t, volts),
                lambda: SupplyMonitor(MonitorSettings()).push(t, volts)):
        with pytest.raises(ValueError):
            use()


def test_a_dtype_of_another_library():
    """Dates of polars have a dtype that NumPy does not know."""
    class Dates:
        dtype = 'Datetime'

        def __array__(self, dtype=None, copy=None):
            return np.array([1000, 1500], dtype='datetime64[ms]')

    assert as_seconds(Dates()).tolist() == [1.0, 1.5]
