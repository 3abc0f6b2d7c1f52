"""Each law against its derivation: integrals by quadrature, simulated noise, searched minima."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.online.filter.cutoff import (
    cutoff_for_noise, relative_cutoff, supply_noise, wanted_cutoff)
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.online.settings import FilterSettings
import pytest
from scipy import integrate

NAN = math.nan
TWO_PI = 2.0 * math.pi


def power(order, w, mode, u):
    """Return |H|^2 at the angular frequency u."""
    gain = 1.0 / (1.0 + (u / w) ** (2 * order))
    return gain * u * u if mode == 'derivative' else gain


def through(spectrum):
    """Integrate a two-sided spectrum over all frequencies, in Hz, by its logarithm."""
    return integrate.quad(lambda s: spectrum(math.exp(s)) * math.exp(s), -25.0, 35.0, limit=500,
                          epsrel=1e-10, epsabs=0.0)[0] / math.pi


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc, alpha', [(5.0, 63.0), (40.0, 63.0), (150.0, 20.0), (3.0, 400.0)])
def test_supply_noise_is_the_integral_over_the_spectrum(order, mode, fc, alpha):
    """|H|^2 / (alpha^2 + u^2), by quadrature; and the cutoff is found again from the noise."""
    w = TWO_PI * fc
    expected = through(lambda u: power(order, w, mode, u) / (alpha * alpha + u * u))
    got = supply_noise(mode, order, fc, alpha)
    assert got == pytest.approx(expected, rel=1e-6)
    assert cutoff_for_noise(mode, order, 0.7 * math.sqrt(got), 0.7, alpha) == pytest.approx(fc)


@pytest.mark.parametrize('order', [1, 2])
def test_noise_that_is_low_enough_needs_no_filter(order):
    """The whole supply noise has the variance sigma^2 / (2 alpha)."""
    whole = math.sqrt(1.0 / 126.0)
    assert cutoff_for_noise('lowpass', order, 1.001 * whole, 1.0, 63.0) == math.inf
    assert cutoff_for_noise('lowpass', order, 0.999 * whole, 1.0, 63.0) > 300.0
    assert cutoff_for_noise('derivative', order, 1.0, 0.0, 63.0) == math.inf


@pytest.mark.parametrize('mode, order, law', [
    ('lowpass', 1, 2.0), ('lowpass', 2, 2.0), ('derivative', 2, 2.0 / 3.0)])
def test_white_noise_is_held_by_the_power_of_its_order(mode, order, law):
    """Variance of white noise through |H|^2, by quadrature, at the cutoff for 3 times sigma."""
    assert relative_cutoff(mode, order, 150.0, 3.0, 0.0) == pytest.approx(150.0 / 3.0 ** law)
    assert relative_cutoff(mode, order, 150.0, 3.0, 1e-6) == pytest.approx(
        150.0 / 3.0 ** law, rel=5e-3)
    rms = [math.sqrt(through(lambda u, fc=fc: power(order, TWO_PI * fc, mode, u)))
           for fc in (150.0, relative_cutoff(mode, order, 150.0, 3.0, 0.0))]
    assert 3.0 * rms[1] == pytest.approx(rms[0], rel=1e-6)


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc', [20.0, 150.0, 400.0])
@pytest.mark.parametrize('times', [1.5, 4.0])
def test_white_samples_come_out_alike(mode, order, fc, times):
    """The sum of squares of the sampled impulse response is the variance."""
    dt = 1e-3

    def rms(cutoff):
        state, samples, before = LowPassState(), [], 0.0
        angle = TWO_PI * cutoff * dt
        for x in (1.0, *np.zeros(6000)):
            ends = (before, x) if mode == 'lowpass' else ((x - before) / dt,) * 2
            samples.append(state.advance(order, angle, *ends))
            before = x
        return math.sqrt(sum(y * y for y in samples))
    wanted = relative_cutoff(mode, order, fc, times, dt)
    assert wanted < fc
    assert times * rms(wanted) == pytest.approx(rms(fc), rel=1e-4)


@pytest.mark.parametrize('sigma, expected', [(0.3, 150.0), (0.301, 20.0), (0.0, 150.0)])
def test_threshold_switches_at_sigma_ref(sigma, expected):
    s = FilterSettings(law='threshold')
    assert wanted_cutoff(s, sigma, NAN, 1e-3) == expected


@pytest.mark.parametrize('law, more', [
    ('threshold', {}), ('constant_noise', {}), ('constant_noise', {'coupling': 1.0})])
def test_unknown_values_give_nan(law, more):
    s = FilterSettings(law=law, **more)
    for bad in (NAN, math.inf, -1.0):
        assert math.isnan(wanted_cutoff(s, bad, NAN, 1e-3))


@pytest.mark.parametrize('law, more', [
    ('constant_noise', {}), ('constant_noise', {'coupling': 1.0, 'noise_wanted': 0.01}),
    ('constant_noise', {'coupling': 1.0, 'noise_wanted': 5.0, 'mode': 'derivative'}),
    ('threshold', {})])
@pytest.mark.parametrize('order', [1, 2])
def test_more_noise_never_raises_the_cutoff(law, more, order):
    """Within the limits for sigmas over ten decades, 0 included."""
    s = FilterSettings(law=law, order=order, **more)
    cutoffs = [wanted_cutoff(s, sigma, 63.0, 1e-3)
               for sigma in (0.0, *np.geomspace(1e-6, 1e4, 41))]
    assert all(s.fmin <= fc <= s.fmax for fc in cutoffs)
    assert all(b <= a * (1.0 + 1e-3) for a, b in zip(cutoffs, cutoffs[1:]))
    assert cutoffs[0] == pytest.approx(s.fmax) and cutoffs[-1] == pytest.approx(s.fmin)


ANY = st.floats(allow_nan=True, allow_infinity=True)
SETTINGS = [FilterSettings(**{'mode': mode, 'order': order, **more}) for mode, more in (
    (mode, more) for mode in ('lowpass', 'derivative') for more in (
        {}, {'law': 'threshold'}, {'coupling': 2.0},
        {'coupling': 1e9, 'noise_wanted': 1e-9}, {'coupling': 1e-9, 'noise_wanted': 1e12}))
    for order in (1, 2)]


@settings(max_examples=1000, deadline=None)
@given(s=st.sampled_from(SETTINGS), sigma=ANY, alpha=ANY,
       interval=st.one_of(st.just(0.0), st.floats(1e-9, 1e6)))
def test_any_number_gives_a_cutoff_within_the_limits_or_nan(s, sigma, alpha, interval):
    """Numbers from a topic may be anything; nothing overflows, and NaN is for the unknown."""
    got = wanted_cutoff(s, sigma, alpha, interval)
    known = math.isfinite(sigma) and sigma >= 0.0
    assert s.fmin <= got <= s.fmax if known else math.isnan(got)
