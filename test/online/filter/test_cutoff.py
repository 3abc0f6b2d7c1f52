"""Each law of the cutoff against its derivation, and the cutoff in force as time series."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.online.filter.cutoff import (
    Bound, cutoff_for_noise, CutoffControl, relative_cutoff, SampleInterval, supply_noise,
    time_constant, wanted_cutoff)
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


DT = 0.01


def control(**options):
    """Return a control without smoothing, slew and dead band unless they are given."""
    return CutoffControl(FilterSettings(**{
        'smoothing': 0.0, 'slew': 0.0, 'dead_band': 0.0, **options}))


def line(made, wanted, error=NAN, interval=0.0):
    return [made.update(one, error, DT, interval) for one in wanted]


def test_limits_saturate_and_say_which():
    made = control()
    assert line(made, [1.0]) == [20.0] and made.bound is Bound.LOWEST
    assert line(made, [1e6]) == [150.0] and made.bound is Bound.HIGHEST
    assert line(made, [70.0]) == [70.0] and made.bound is Bound.NONE


def test_the_sample_rate_bounds_down_to_the_lowest():
    made = control()
    assert line(made, [100.0], interval=0.01) == [45.0] and made.bound is Bound.RATE
    assert line(made, [100.0], interval=0.05) == [20.0] and made.bound is Bound.LOWEST
    assert line(made, [100.0], interval=0.001) == [100.0]


def test_smoothing_is_exponential_in_the_logarithm():
    made = control(smoothing=0.2)
    line(made, [100.0])
    got = line(made, [25.0] * 40)
    t = DT * np.arange(1, 41)
    assert got == pytest.approx(list(25.0 * 4.0 ** np.exp(-t / 0.2)))
    assert made.bound is Bound.SMOOTHING
    assert line(made, [25.0] * 400)[-1] == 25.0 and made.bound is Bound.NONE


@pytest.mark.parametrize('error, expected', [
    (NAN, 0.2), (0.1, 0.2), (0.05, 0.1), (0.2, 0.4), (0.0, 0.05), (5.0, 0.8), (math.inf, 0.8)])
def test_a_certain_sigma_moves_the_cutoff_faster(error, expected):
    """Proportional to the error, within a factor of 4; not known: as given."""
    s = FilterSettings()
    assert time_constant(s, error) == pytest.approx(expected)
    made = CutoffControl(FilterSettings(slew=0.0, dead_band=0.0))
    line(made, [100.0])
    got = line(made, [50.0], error)[0]
    assert got == pytest.approx(50.0 * 2.0 ** math.exp(-DT / expected))


def test_slew_limits_octaves_per_second():
    """4 octaves/s: from 150 to 37.5 Hz takes half a second, on a straight line in log2."""
    made = control(slew=4.0)
    line(made, [150.0])
    got = line(made, [37.5] * 60)
    assert got[:50] == pytest.approx(list(150.0 * 2.0 ** (-0.04 * np.arange(1, 51))))
    assert got[50:] == pytest.approx([37.5] * 10)
    assert line(made, [150.0])[0] < 40.0 and made.bound is Bound.SLEW


def test_dead_band_holds_and_then_follows():
    made = control(dead_band=0.1)
    assert line(made, [100.0, 106.0, 94.0]) == [100.0] * 3
    assert made.bound is Bound.DEAD_BAND
    # The band lies around the cutoff that was taken last: 108 Hz, down to 100.8.
    assert line(made, [108.0, 102.0, 100.0]) == [108.0, 108.0, 100.0]


def test_after_the_fallback_the_dead_band_does_not_hold():
    """A sigma that has come back is followed, however near it is; then the band is there again."""
    made = control(dead_band=0.5, fallback=75.0)
    assert line(made, [100.0, NAN, 80.0, 85.0]) == [100.0, 75.0, 80.0, 80.0]


def test_configure_keeps_the_cutoff_within_the_new_limits():
    made = control()
    line(made, [100.0])
    made.configure(FilterSettings(fmax=60.0, fallback=50.0))
    assert made.cutoff == 60.0
    made.configure(FilterSettings(fmin=5.0, fmax=200.0))
    assert made.cutoff == 60.0


@pytest.mark.parametrize('intervals, mean', [
    # The mean of all up to 100; from then on each counts 1/100.
    ((1.0,) * 98 + (2.0,), 1.0 + 1.0 / 99.0),
    ((1.0,) * 99 + (2.0,), 1.01),
    ((1.0,) * 250 + (2.0,), 1.01),
    # Up to five means, or down to a fifth, it is an interval as others; beyond, it is odd.
    ((1.0,) * 9 + (5.0,), 1.4),
    ((1.0,) * 9 + (5.001,), 1.0),
    ((1.0,) * 9 + (0.2,), 0.92),
    # Four odd ones in a row are gaps (or repeats), five are a new rate.
    ((1.0,) * 9 + (6.0,) * 4, 1.0),
    ((1.0,) * 9 + (6.0,) * 5, 6.0),
    ((1.0,) * 200 + (0.1,) * 5, 0.1),
    # Gaps are left out if they are a third of all, and not if they are half.
    ((1.0, 1.0) * 5 + (6.0, 1.0, 1.0) * 50, 1.0),
    ((1.0, 1.0) * 5 + (6.0, 1.0) * 8 + (6.0,), 6.0),
    ((1.0, 1.0) * 5 + (6.0, 1.0) * 8, 1.0),
    # One that is not odd in between, and they are not in a row.
    ((1.0,) * 9 + (6.0,) * 4 + (1.0,) * 8 + (6.0,) * 4, 1.0),
])
def test_the_sample_interval_by_a_table(intervals, mean):
    """Means worked out by hand; odd is five times off, and five odd ones are a new rate."""
    interval = SampleInterval()
    for dt in intervals:
        got = interval.add(dt)
    assert got == interval.mean == pytest.approx(mean, rel=1e-12)
