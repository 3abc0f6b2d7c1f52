"""With any input the cutoff stays within fmin..fmax and the output stays finite."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import AdaptiveLowPass
import pytest

ANY = st.floats(allow_nan=True, allow_infinity=True)
STEP = st.one_of(st.sampled_from([1e-3, 1e-4, 0.0, -1e-3, -50.0, 1e-9, 1.0, 33.0, 1e9]), ANY)
SIGMA = st.one_of(st.floats(0.0, 10.0), ANY)
CHANGE = st.one_of(st.none(), st.fixed_dictionaries({}, optional={
    'fmin': st.sampled_from([0.01, 5.0, 20.0, 60.0]), 'fmax': st.sampled_from([100.0, 3000.0]),
    'max_lag': st.sampled_from([0.0, 30.0]), 'fallback': st.sampled_from([70.0, 99.0]),
    'law': st.sampled_from(['threshold', 'constant_noise', 'kalman']),
    'slew': st.sampled_from([0.0, 4.0]), 'shadow': st.booleans()}))


def check(f):
    """Assert that what the filter publishes lies within its limits."""
    low, high = f.settings.lowest, f.settings.fmax
    assert low <= f.cutoff <= high, f.bound
    assert math.isnan(f.wanted) or low <= f.wanted <= high
    assert f.bound is not None and math.isfinite(f.phase_lag)


@settings(max_examples=150, deadline=None)
@given(order=st.sampled_from([1, 2]), blocks=st.lists(st.tuples(
    STEP, SIGMA, CHANGE, st.sampled_from([1, 5, 60, 150]), st.integers(0, 99)),
    min_size=1, max_size=10))
@pytest.mark.filterwarnings('ignore::RuntimeWarning')
def test_any_stamps_sigma_and_parameters(order, blocks):
    f = AdaptiveLowPass(order=order, n0=1e-5)
    t, learned = 100.0, False
    for step, sigma, change, n, seed in blocks:
        if change:
            try:
                f.configure(**change)
            except ValueError:
                pass
            check(f)
        rng = np.random.default_rng(seed)
        stamps = t + step * np.arange(1.0, n + 1.0)
        if seed % 3 == 0:
            stamps = 100.0 * rng.random(n)
        t = float(stamps[-1]) if math.isfinite(stamps[-1]) else 100.0
        x = rng.standard_normal(n)
        out = f.filter(stamps, x, sigma) if seed % 2 else np.array(
            [f.filter(*one, sigma) for one in zip(stamps, x)])
        check(f)
        assert not np.isinf(out).any()
        # After the law kalman the output goes over from what it was.
        learned = learned or f.settings.law == 'kalman'
        assert learned or np.nanmax(np.abs(np.append(out, 0.0))) < 10.0


@pytest.mark.parametrize('order', [1, 2])
def test_random_stamps_leave_fmin_in_force(order):
    """At random within 100 s the mean interval is 33 s: 0.45 of that rate is 0.014 Hz."""
    f = AdaptiveLowPass(order=order)
    f.filter(100.0 * np.random.default_rng(4).random(3000), np.ones(3000), 0.3)
    assert f.highest < 0.1 and f.cutoff == 20.0


def test_a_slow_signal_is_followed_at_fmin():
    """10 Hz: 0.45 of the rate is 4.5 Hz; many at once are as one by one."""
    t, x = 0.1 * np.arange(600), np.sin(np.arange(600))
    one, many = AdaptiveLowPass(), AdaptiveLowPass()
    out = np.array([one.filter(*pair, 0.3) for pair in zip(t, x)])
    assert many.filter(t, x, 0.3) == pytest.approx(out, abs=1e-9)
    assert many.cutoff == one.cutoff == 20.0 and one.highest == pytest.approx(4.5)
