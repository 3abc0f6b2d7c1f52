"""Law kalman: learned, limited, and robust."""

import cmath
import math
from pathlib import Path

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.online.filter import learned_wiener
from ou_monitor.online.filter.cutoff import Bound
from ou_monitor.online.filter.filter_state import phase_lag
import pytest
from scipy import linalg, signal

NAN, TWO_PI = math.nan, 2.0 * math.pi
RATE, ALPHA, SPREAD, COUPLING, WHITE = 1000.0, 63.0, 0.05, 2.0, 0.01
SIGMA = SPREAD * math.sqrt(2.0 * ALPHA)
GYRO = Path(__file__).parents[3] / 'bags' / 'recorded' / 'gecko_gyro.csv'


def ou(rng, n, alpha, deviation, rate=RATE):
    keep = math.exp(-alpha / rate)
    kick = deviation * math.sqrt(1.0 - keep * keep)
    return signal.lfilter([kick], [1.0, -keep], rng.standard_normal(n))


def made(**more):
    return AdaptiveLowPass(**{
        'law': 'kalman', 'fmin': 0.5, 'coupling': COUPLING, 'n0': WHITE**2 / RATE, 'alpha': ALPHA,
        **more})


@pytest.fixture(scope='module')
def flown():
    """Return stamps, a body rate up to 3 Hz, and that in supply noise and white noise."""
    rng, n = np.random.default_rng(8), 8000
    sos = signal.butter(2, 3.0, fs=RATE, output='sos')
    truth = signal.sosfilt(sos, rng.standard_normal(n))
    truth /= truth.std()
    noise = COUPLING * ou(rng, n, ALPHA, SPREAD) + WHITE * rng.standard_normal(n)
    return np.arange(n) / RATE, truth, truth + noise


def error(flown, y, mode='lowpass'):
    """Return the mean square error over the last 6 s."""
    truth = flown[1] if mode == 'lowpass' else np.gradient(flown[1], 1.0 / RATE)
    return float(np.mean((y - truth)[2000:]**2))


def best_fixed(x, of, mode, rate=RATE):
    """Return the least error of Butterworth filters of order 2, or of their slopes."""
    found = []
    for cutoff in np.geomspace(1.0, 140.0, 15):
        w = 2.0 * rate * math.tan(math.pi * cutoff / rate)
        b, a = signal.bilinear([w * w] if mode == 'lowpass' else [w * w, 0.0],
                               [1.0, math.sqrt(2.0) * w, w * w], rate)
        found.append(of(signal.lfilter(b, a, x, zi=signal.lfilter_zi(b, a) * x[0])[0]))
    return min(found)


def best_of_all(flown):
    """Return the errors of the Kalman filter that knows the model: signal, slope."""
    w = TWO_PI * 3.0
    a = linalg.block_diag([[0.0, 1.0], [-w * w, -math.sqrt(2.0) * w]], -ALPHA)
    # The low-pass of white samples that makes the body rate.
    q = np.diag([0.0, 2.0 * math.sqrt(2.0) * w**3, 2.0 * ALPHA * (COUPLING * SPREAD)**2])
    n = 3
    big = linalg.expm(np.block([[-a, q], [np.zeros((n, n)), a.T]]) / RATE)
    phi = big[n:, n:].T
    drive, look = phi @ big[:n, n:], np.array([1.0, 0.0, 1.0])
    p = linalg.solve_discrete_are(phi.T, look[:, None], drive, np.array([[WHITE**2]]))
    gain = p @ look / (look @ p @ look + WHITE**2)
    m, found = np.zeros(3), []
    for x in flown[2]:
        m = phi @ m
        m = m + gain * (x - look @ m)
        found.append(m)
    return error(flown, np.array(found)[:, 0]), error(
        flown, np.array(found)[:, 1], 'derivative')


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_told_nothing_it_comes_near_the_filter_that_knows(flown, mode):
    """Better than any fixed cutoff, and within 15 % of the one that knows all."""
    found = error(flown, made(mode=mode).filter(*flown[::2], SIGMA), mode)
    assert found < 0.95 * best_fixed(flown[2], lambda y: error(flown, y, mode), mode)
    assert found < 1.15 * best_of_all(flown)[mode == 'derivative']


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_noise_told_twice_too_large_is_not_believed(flown, mode):
    """What cannot be noise is not: at most 10 % above the best fixed cutoff."""
    found = error(flown, made(mode=mode, n0=4.0 * WHITE**2 / RATE, coupling=2.0 * COUPLING)
                  .filter(*flown[::2], SIGMA), mode)
    assert found < 1.1 * best_fixed(flown[2], lambda y: error(flown, y, mode), mode)


@pytest.fixture(scope='module')
def table():
    return np.genfromtxt(GYRO, delimiter=',', names=True)


@pytest.mark.parametrize('axis', ['gyro_x_deg_s', 'gyro_z_deg_s'])
@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_a_recorded_gyro(table, axis, mode):
    """From the first sample on, with noise added, never 10 % above the best fixed cutoff."""
    t, rate = table['time_s'], 500.0
    even = np.arange(t[0], t[-1], 1.0 / rate)
    truth = signal.sosfiltfilt(signal.butter(4, 30.0, fs=rate, output='sos'),
                               np.radians(np.interp(even, t, table[axis])))
    rng = np.random.default_rng(5)
    coupling = 0.09 * float(truth.std()) / SPREAD
    x = (truth + coupling * ou(rng, truth.size, ALPHA, SPREAD, rate)
         + WHITE * rng.standard_normal(truth.size))
    target = truth if mode == 'lowpass' else np.gradient(truth, 1.0 / rate)

    def off(y):
        return float(np.mean((y - target)[200:]**2))
    found = off(made(mode=mode, coupling=coupling, n0=WHITE**2 / rate).filter(even, x, SIGMA))
    assert found < 1.1 * best_fixed(x, off, mode, rate)


def test_a_manoeuvre_after_calm_opens_it(flown, monkeypatch):
    """In its first half second the error is a part of that of one that does not look."""
    t, truth, _ = flown
    rng = np.random.default_rng(3)
    calm = truth * np.where(t < 5.0, 0.003, 1.0)
    x = calm + WHITE * rng.standard_normal(t.size) + COUPLING * ou(rng, t.size, ALPHA, SPREAD)

    def onset():
        y = made().filter(t[:5500], x[:5500], SIGMA)
        return float(np.mean((y - calm[:5500])[5000:]**2))
    open_ = onset()
    monkeypatch.setattr(learned_wiener, '_MISFIT', math.inf)
    assert open_ < 0.7 * onset()


@pytest.mark.parametrize('mode, most', [
    ('lowpass', 0.0), ('lowpass', 6.0), ('derivative', 0.0), ('derivative', 12.0)])
def test_a_sine_lags_as_told_and_no_more_than_allowed(mode, most):
    """Of the filter that a sine of 10 Hz in noise has made, its weights held."""
    f = made(mode=mode, max_lag=most, n0=1e-4, smoothing=0.0)
    rng, t = np.random.default_rng(2), np.arange(3000) / RATE
    f.filter(t, np.sin(TWO_PI * t) + 0.3 * rng.standard_normal(t.size), SIGMA)
    lag = f.phase_lag
    f._kalman._learn = lambda *_: None
    t = 3.0 + np.arange(6000) / RATE
    y = f.filter(t, np.sin(TWO_PI * 10.0 * t), SIGMA)[3000:]
    turn = np.sum(y * np.exp(-1j * TWO_PI * 10.0 * t[3000:]))
    found = -math.degrees(cmath.phase(turn * (1.0 if mode == 'derivative' else 1j)))
    assert lag == pytest.approx(found, abs=0.2)
    if most:
        assert lag == pytest.approx(most, abs=0.01) and f.bound is Bound.LAG
    else:
        assert lag > 12.0 and phase_lag(2, f.cutoff, 10.0) == pytest.approx(lag, abs=0.1)


def test_less_lag_than_the_difference_quotient_there_is_not():
    """At 100 Hz it lags by 18 degrees at 10 Hz: that is told, not the limit."""
    f = made(mode='derivative', max_lag=12.0, n0=1e-3)
    t = np.arange(300) / 100.0
    f.filter(t, np.sin(TWO_PI * t), 0.3)
    assert f.phase_lag == pytest.approx(18.0, abs=0.2)


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('change', [
    {'coupling': 20.0}, {'n0': 1e-3}, {'fmin': 140.0}, {'order': 1, 'max_lag': 20.0},
    {'coupling': 0.0, 'n0': 1e-6}, {'law': 'threshold'}], ids=str)
def test_a_change_does_not_move_the_output(flown, change, mode):
    """At the stamp not at all, soon after as if nothing had changed."""
    f, twin = made(mode=mode), made(mode=mode)
    t, _, x = flown
    for one in (f, twin):
        before = one.filter(t[:1000], x[:1000], SIGMA)[-1]
    f.configure(**change)
    assert f.filter(t[999], 77.0, SIGMA) == before
    # The input goes on with its slope, which is what a derivative has for its input.
    going_on = x[999] + (x[999] - x[998]) * 1e-3
    soon = [one.step(t[999] + 1e-6, going_on, SIGMA) for one in (f, twin)]
    assert soon[0] == pytest.approx(soon[1], abs=2e-3 * (100.0 if mode == 'derivative' else 1.0))
    assert np.all(np.isfinite(f.filter(t[1000:2000], x[1000:2000], SIGMA)))


def test_without_sigma_the_fallback_takes_over_without_a_jump(flown):
    """The low-pass at `fallback`, and back, each within what 1 ns can move."""
    f, (t, _, x) = made(fmin=1.0, fallback=30.0), flown
    before = f.filter(t[:1000], x[:1000], SIGMA)[-1]
    assert f.step(t[999] + 1e-9, x[999], NAN) == pytest.approx(before, abs=1e-4)
    y = f.filter(t[1000:4000], x[1000:4000], NAN)
    assert f.cutoff == pytest.approx(30.0, rel=1e-3)
    plain = AdaptiveLowPass(law='threshold', fmin=29.99999, fmax=30.0, fallback=30.0)
    assert y[-1] == pytest.approx(plain.filter(t[:4000], x[:4000], 0.1)[-1], abs=1e-3)
    assert f.step(t[3999] + 1e-9, x[3999], SIGMA) == pytest.approx(y[-1], abs=1e-4)


ANY = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=100, deadline=None)
@given(mode=st.sampled_from(['lowpass', 'derivative']),
       n0=st.sampled_from([0.0, 1e-7, 1e12]), samples=st.lists(
           st.tuples(st.floats(1e-9, 1e3), st.floats(-1e9, 1e9) | st.sampled_from([1e149, 0.0]),
                     ANY, ANY), max_size=25))
def test_any_number_on_the_topics_gives_a_finite_output(mode, n0, samples):
    f, t = made(mode=mode, n0=n0), 0.0
    for dt, x, sigma, alpha in samples:
        t += dt
        assert math.isfinite(f.step(t, x, sigma, NAN, alpha))
        assert 0.0 < f.cutoff < math.inf and not f.phase_lag > 180.0
