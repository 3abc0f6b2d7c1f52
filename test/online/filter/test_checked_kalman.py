"""The Kalman filter of a signal beside fixed low-passes: what is told of each, and the choice."""

import math

import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.online.filter.checked_kalman import _weights
from ou_monitor.online.filter.filter_state import LowPassState
import pytest
from scipy import signal

RATE, ALPHA, SPREAD, COUPLING, WHITE = 1000.0, 63.0, 0.05, 2.0, 0.01
SIGMA = SPREAD * math.sqrt(2.0 * ALPHA)


def ou(rng, n, alpha, deviation):
    """Return an OU."""
    keep = math.exp(-alpha / RATE)
    kick = deviation * math.sqrt(1.0 - keep * keep)
    return signal.lfilter([kick], [1.0, -keep], rng.standard_normal(n))


@pytest.fixture(scope='module')
def flown():
    """Return stamps, a body rate up to 3 Hz, and that in supply noise and white noise."""
    rng, n = np.random.default_rng(8), 8000
    sos = signal.butter(2, 3.0, fs=RATE, output='sos')
    truth = signal.sosfilt(sos, rng.standard_normal(n))
    truth /= truth.std()
    noise = COUPLING * ou(rng, n, ALPHA, SPREAD) + WHITE * rng.standard_normal(n)
    return np.arange(n) / RATE, truth, truth + noise


def filtered(flown, **more):
    """Return the filter and its output."""
    options = {'law': 'kalman', 'fmin': 1.0, 'coupling': COUPLING, 'n0': WHITE**2 / RATE,
               'signal_bandwidth': 3.0, 'signal_rms': 1.0, 'signal_poles': 2, 'alpha': ALPHA}
    low_pass = AdaptiveLowPass(**{**options, **more})
    return low_pass, low_pass.filter(flown[0], flown[2], SIGMA)


def error(flown, y, mode='lowpass'):
    """Return the mean square error over the last 6 s."""
    truth = flown[1] if mode == 'lowpass' else np.gradient(flown[1], 1.0 / RATE)
    return float(np.mean((y - truth)[2000:]**2))


def best_fixed(flown, mode):
    """Return the mean square error of the best fixed cutoff in hindsight."""
    return min(error(flown, AdaptiveLowPass(
        mode=mode, law='threshold', fmin=0.5, fmax=f + 1e-3, fallback=f).filter(
            *flown[::2], math.nan), mode) for f in np.geomspace(1.0, 140.0, 15))


@pytest.mark.parametrize('mode, told, much', [
    ('lowpass', 0.3, 1.5), ('derivative', 30.0, 4.0)])
def test_a_wrong_bandwidth_is_not_believed(flown, mode, told, much):
    """Told a bandwidth ten times off it is far worse than a fixed cutoff; checked it is not."""
    best = best_fixed(flown, mode)
    plain, checked = (error(flown, filtered(
        flown, mode=mode, signal_bandwidth=told, signal_check=check)[1], mode)
        for check in (False, True))
    assert plain > much * best
    assert checked < 1.1 * best


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_a_right_one_stays(flown, mode):
    """Told what is true it does as the filter that is not checked."""
    plain, checked = (error(flown, filtered(flown, mode=mode, signal_check=check)[1], mode)
                      for check in (False, True))
    assert checked < 1.05 * plain


def test_what_is_told_of_each_is_its_error(flown):
    """
    The errors by the signal itself are the true ones, up to what all have in common.

    Over 8 s the noise has 250 independent spans: twice a mean product of noise
    (0.1) and of what filters above 9 Hz differ by (0.2) is off by 0.0025.
    """
    low_pass, _ = filtered(flown)
    check = low_pass._kalman
    told = np.array(check._errors) + 2.0 * np.array(check._crossed) - check._noise
    true = []
    fast = [f for f in check._cutoffs if f > 9.0]
    for f in fast:
        y = AdaptiveLowPass(law='threshold', fmin=0.5, fmax=f + 1e-3, fallback=f).filter(
            *flown[::2], math.nan)
        true.append(np.mean((y - flown[1])**2))
    differ = told[-1 - len(fast):-1] - np.array(true)
    # Half the products of noise and output would leave 0.006.
    assert np.max(np.abs(differ - np.mean(differ))) < 0.0025


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('slope', [False, True])
def test_weights_of_past_samples(order, slope):
    """The first two, and their sum with a ratio, are those of the impulse response."""
    angle, interval, ratio = 0.3, 1e-3, 0.9
    state, h, before = LowPassState(0.0), [], 0.0
    for x in (1.0, *np.zeros(400)):
        quotient = (x - before) / interval
        h.append(state.advance(order, angle, *((quotient,) * 2 if slope else (before, x))))
        before = x
    first, second, all_of = _weights(order, angle, slope, interval, ratio)
    assert (first, second) == pytest.approx(tuple(h[:2]), rel=1e-9)
    assert all_of == pytest.approx(sum(w * ratio**k for k, w in enumerate(h)), rel=1e-9)
