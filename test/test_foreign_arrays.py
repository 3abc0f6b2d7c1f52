"""Time axes and arrays of pandas, xarray and NumPy: understood or refused, never misread."""

from datetime import datetime, timedelta, timezone

import numpy as np
from ou_monitor import MonitorSettings, Recording, SlidingEstimator, SupplyMonitor
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
        """Keep the values."""
        self._values = values

    def __array__(self, dtype=None, copy=None):
        """Return the values."""
        return self._values if dtype is None else self._values.astype(dtype)


AXES = {
    'seconds': SECONDS, 'list': SECONDS.tolist(), 'dates': DATES, 'milliseconds': DATES.astype(
        'datetime64[ms]'), 'spans': DATES - DATES[0], 'pandas': Axis(DATES),
    'zone': Axis(np.array([BEGIN + timedelta(seconds=t) for t in SECONDS.tolist()], dtype=object)),
    'datetime': np.array([BEGIN.replace(tzinfo=None) + timedelta(seconds=t)
                          for t in SECONDS.tolist()], dtype=object),
    'masked': np.ma.masked_array(SECONDS, np.zeros(N, dtype=bool))}


@pytest.mark.parametrize('axis', AXES)
def test_a_time_axis_is_seconds(axis):
    """A recording, the estimator and the monitor have the samples 10 ms apart."""
    recording = Recording(AXES[axis], VOLTS, np.full(N, 0.3))
    np.testing.assert_allclose(np.diff(recording.t), 0.01, atol=1e-6)
    assert (recording.t[0] > 1.7e9) == (axis in (
        'dates', 'milliseconds', 'pandas', 'zone', 'datetime'))
    estimator, monitor = SlidingEstimator(), SupplyMonitor(MonitorSettings())
    estimator.push(AXES[axis], VOLTS)
    monitor.push(AXES[axis], VOLTS, 0.3)
    found = estimator.estimate()
    assert found.rate == pytest.approx(100.0, rel=0.01) and found.counters.resets == 0
    assert monitor.report(0.0).estimate.rate == pytest.approx(100.0, rel=0.01)


def test_dates_to_the_microsecond():
    """Nanoseconds since 1970 are beyond float64, their seconds are not."""
    t = np.datetime64('2024-05-16T08:00:00.123456', 'ns') + np.arange(4) * np.timedelta64(10, 'us')
    np.testing.assert_allclose(np.diff(Recording(t, VOLTS[:4], VOLTS[:4]).t), 1e-5, atol=3e-7)


def test_what_is_masked_is_unknown():
    """In voltage, throttle and time; NaT too."""
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


@pytest.mark.parametrize('t, volts', [
    (SECONDS, DATES), (SECONDS, VOLTS.astype(str)), (SECONDS.astype(str), VOLTS),
    (SECONDS, VOLTS.astype(complex)),
    (SECONDS, Axis(np.array([object()] * N)))])
def test_what_is_none_of_these_is_refused(t, volts):
    """Dates as voltage, text, complex numbers, objects."""
    for use in (lambda: Recording(t, volts, np.full(N, 0.3)),
                lambda: SlidingEstimator().push(t, volts),
                lambda: SupplyMonitor(MonitorSettings()).push(t, volts)):
        with pytest.raises(ValueError):
            use()
