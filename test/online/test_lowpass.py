"""The adaptive low-pass against scipy.signal and against its own promises."""

import math

import numpy as np
from ou_monitor import AdaptiveLowPass
import pytest
from scipy import signal


def fixed(order, fc, **more):
    """Return a filter whose cutoff cannot move from fc."""
    return AdaptiveLowPass(order=order, law='threshold', fmin=fc * 0.999999, fmax=fc,
                           fallback=fc, smoothing=0.0, sigma_ref=1.0, **more)


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc', [5.0, 40.0, 150.0])
def test_equals_the_held_input_solution_of_scipy(order, fc):
    """`lsim`-style zero-order-hold discretisation by scipy, sample for sample."""
    rng = np.random.default_rng(1)
    dt = 1e-3
    x = rng.standard_normal(400)
    num, den = signal.butter(order, 2.0 * math.pi * fc, analog=True)
    a, b, c, d = signal.tf2ss(num, den)
    ad, bd, cd, _, _ = signal.cont2discrete((a, b, c, d), dt, method='zoh')
    state, expected = np.zeros((order, 1)), [0.0]
    for value in x[1:]:
        state = ad @ state + bd * value
        expected.append(float((cd @ state)[0, 0]))
    f = fixed(order, fc)
    f.filter(-dt, 0.0, 0.0)
    x[0] = 0.0
    assert f.filter(np.arange(400) * dt, x, 0.0) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize('order', [1, 2])
def test_irregular_steps_equal_fine_steps(order):
    """A held input over one long step is the same as over many short ones."""
    coarse, fine = fixed(order, 40.0), fixed(order, 40.0)
    for f in (coarse, fine):
        f.filter(0.0, 1.0, 0.0)
    assert coarse.filter(0.010, -0.3, 0.0) == pytest.approx(
        fine.filter(np.arange(1, 101) * 1e-4, np.full(100, -0.3), 0.0)[-1], abs=1e-9)


def test_constant_noise_law_holds_the_output_rms():
    """
    White noise of doubled intensity comes out with the same rms.

    n independent outputs number about 2 fc T = 2 * 37.5 * 200 = 15 000: the
    standard error of each rms is 0.6 %, of their ratio below 1 %.
    """
    rng = np.random.default_rng(4)
    t = np.arange(400_000) * 5e-4
    rms = []
    for factor in (1.0, 2.0):
        f = AdaptiveLowPass(order=2, law='constant_noise', fmin=1.0, fmax=150.0,
                            sigma_ref=0.3, smoothing=0.0)
        y = f.filter(t, factor * rng.standard_normal(t.size), 0.3 * factor)
        rms.append(float(np.std(y[1000:])))
    assert f.cutoff == pytest.approx(37.5)
    assert rms[1] / rms[0] == pytest.approx(1.0, abs=0.04)


def test_cutoff_change_does_not_move_the_output():
    f = AdaptiveLowPass(order=2, fmin=5.0, fmax=150.0, smoothing=0.0)
    rng = np.random.default_rng(0)
    y = f.filter(np.arange(100) * 1e-3, rng.standard_normal(100), 0.1)
    f.configure(fmin=10.0, fmax=20.0)
    assert f.filter(0.099, 5.0, 0.1) == y[-1]


def test_any_modulation_is_stable():
    """Cutoffs drawn at random each sample; the norm of the state never grows."""
    f = AdaptiveLowPass(order=2, law='constant_noise', fmin=0.1, fmax=400.0, sigma_ref=0.01,
                        smoothing=0.0)
    rng = np.random.default_rng(8)
    f.filter(0.0, 1.0, 0.01)
    sigmas = 0.01 * 10.0 ** rng.uniform(0.0, 2.0, 5000)
    y = f.filter(np.arange(1, 5001) * 1e-3, np.zeros(5000), sigmas)
    assert np.abs(y).max() <= 1.0 and abs(y[-1]) < 1e-6


@pytest.mark.parametrize('sigma', [math.nan, math.inf, -1.0])
def test_unknown_sigma_means_fallback(sigma):
    f = AdaptiveLowPass(fallback=60.0)
    f.filter(0.0, 1.0, sigma)
    assert f.cutoff == 60.0


def test_nan_input_does_not_move_the_filter():
    f = AdaptiveLowPass()
    assert math.isnan(f.filter(0.0, math.nan, 0.1))
    assert f.filter(0.0, 2.0, 0.1) == 2.0
    assert f.filter(0.001, math.nan, 0.1) == 2.0


@pytest.mark.parametrize('options, words', [
    ({'fmim': 3.0}, 'fmin'), ({'law': 'treshold'}, 'threshold'), ({'order': 3}, 'order'),
    ({'fmin': 200.0, 'fmax': 100.0}, 'fmin'), ({'fmax': math.nan}, 'fmax'),
    ({'fallback': 500.0}, 'fallback')])
def test_bad_options_are_refused_by_name(options, words):
    with pytest.raises(ValueError, match=words):
        AdaptiveLowPass(**options)


def test_shapes_must_agree():
    with pytest.raises(ValueError, match='shape'):
        AdaptiveLowPass().filter([0.0, 1.0], [1.0], 0.1)
