"""No degenerate fit of recorded flights that are not shipped."""

import os
from pathlib import Path

import numpy as np
from ou_monitor.model.load_fit import fit_load
from ou_monitor.recordings.read import read_recording
import pytest

FOLDER = os.environ.get('OU_MONITOR_REALDATA')


@pytest.mark.skipif(FOLDER is None, reason='OU_MONITOR_REALDATA is not set: recordings of others '
                                           'are not shipped')
@pytest.mark.parametrize('name', ['cf_solo_large', 'cf_pair_large', 'cf_takeoff'])
def test_a_fit_stays_physical(name):
    """
    Answers of the size of the swing, distinct times, a condition, and no trend beyond the data.

    An extended model of sums of poles held +25.8 V beside -19 V on one of these.
    """
    flight = read_recording(Path(FOLDER) / f'{name}.csv')
    t, v, u = flight.t - flight.t[0], flight.voltage, np.clip(flight.throttle, 0.0, 1.0)
    t, v, u = t[::3], v[::3], u[::3]
    half = t <= 0.5 * t[-1]
    fit = fit_load(t[half], v[half], u[half])
    model = fit.model
    swing = float(np.ptp(v))
    # No part of the answer is larger than what was seen, so none can cancel another.
    for part in (1.0, model.fast_share, model.slow_share):
        over = float(model.sag(u.max()) - model.sag(u.min()))
        assert 0.0 < part * over / (1.0 + model.fast_share + model.slow_share) < swing
    assert float(model.sag(u.max())) < 0.35 * v.max()
    assert 10.0 * model.lag < model.fast_time < 0.5 * model.slow_time
    assert fit.condition < 1e3 and np.isfinite(fit.covariance).all()
    # A minute beyond the data the charge is that of the load: no parabola, no pole runs away.
    beyond = np.concatenate((t, t[-1] + np.arange(0.1, 60.0, 0.1)))
    held = np.concatenate((u, np.full(beyond.size - t.size, float(np.mean(u)))))
    path = model.path(beyond, held)
    assert path.max() < v.max() + 0.25 * swing
    assert path.min() > v.min() - 0.5 * swing - 0.02 * v.max()
    # What a hover does not decide stands at a bound and is named; what it decides does not.
    assert not {'size', 'charge', 'endurance'} & set(fit.at_bounds)
