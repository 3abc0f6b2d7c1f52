"""The low-pass against scipy, and as a whole: what changes its output, and what must not."""

import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.online.filter.cutoff import Bound, relative_cutoff
from ou_monitor.online.filter.filter_state import cutoff_for_lag, LowPassState, phase_lag
from ou_monitor.online.settings import FILTER_PARAMETERS, FilterSettings
import pytest
from scipy import integrate, signal


def analog(order, fc, mode):
    num, den = signal.butter(order, 2.0 * math.pi * fc, analog=True)
    return (np.polymul(num, [1.0, 0.0]) if mode == 'derivative' else num), den


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
def test_irregular_steps_and_moving_cutoffs_against_an_ode_solver(order, mode):
    rng = np.random.default_rng(5)
    t = np.concatenate([[0.0], np.cumsum(10.0 ** rng.uniform(-4.0, -1.0, 60))])
    x = rng.standard_normal(61)
    w = 2.0 * math.pi * 10.0 ** rng.uniform(0.0, 2.3, 60)
    state = LowPassState(0.0 if mode == 'derivative' else x[0])
    reference = np.array([state.y, 0.0])
    for k in range(60):
        dt, slope = t[k + 1] - t[k], (x[k + 1] - x[k]) / (t[k + 1] - t[k])

        def rate(s, z, k=k, slope=slope):
            u = slope if mode == 'derivative' else x[k] + slope * s
            if order == 1:
                return [w[k] * (u - z[0]), 0.0]
            return [w[k] * z[1], w[k] * (u - z[0] - math.sqrt(2.0) * z[1])]
        reference = integrate.solve_ivp(
            rate, (0.0, dt), reference, method='DOP853', rtol=1e-11, atol=1e-12).y[:, -1]
        ends = (slope, slope) if mode == 'derivative' else (x[k], x[k + 1])
        got = state.advance(order, w[k] * dt, *ends)
        assert got == pytest.approx(reference[0], rel=1e-7, abs=1e-8)


@pytest.mark.parametrize('order', [1, 2])
def test_short_steps_lose_nothing(order):
    """100 000 steps of 1e-8 of the time constant add up to the one long step."""
    short, long = LowPassState(), LowPassState()
    for k in range(100_000):
        short.advance(order, 1e-8, k * 1e-5, (k + 1) * 1e-5)
    long.advance(order, 1e-3, 0.0, 1.0)
    assert short.y == pytest.approx(long.y, rel=1e-6)


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('fc', [5.0, 10.0, 40.0])
def test_lag_is_that_of_the_filter(order, fc):
    """Phase of scipy's response; and FIELD's 14, 27, 45, 63 degrees of order 1 come out."""
    response = signal.freqs(*analog(order, fc, 'lowpass'), worN=[20.0 * math.pi])[1][0]
    lag = phase_lag(order, fc, 10.0)
    assert lag == pytest.approx(-math.degrees(np.angle(response)))
    assert cutoff_for_lag(order, lag, 10.0) == pytest.approx(fc)


@pytest.mark.parametrize('order, lag', [(1, 90.0), (2, 180.0), (1, 0.0), (2, math.nan)])
def test_impossible_lags_are_refused(order, lag):
    with pytest.raises(ValueError, match='lags by more than 0'):
        cutoff_for_lag(order, lag, 10.0)


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


NAN = math.nan
BOUND = {1: 1.0, 2: 1.0 / math.tanh(0.5 * math.pi)}


def warm(seed=0, **options):
    """Return a filter after 100 samples of noise at 1 kHz, and its last output."""
    f = AdaptiveLowPass(**options)
    x = np.random.default_rng(seed).standard_normal(100)
    return f, float(f.filter(np.arange(100) * 1e-3, x, 0.5)[-1])


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
@pytest.mark.parametrize('order', [1, 2])
def test_the_cutoff_may_jump_at_every_sample(order, mode):
    """Sigma alternates so that the cutoff goes between 20 and 150 Hz; the output does not jump."""
    # Over a step of 1 us, 2 pi fc dt is below 1e-3: the output moves by less than that times what
    # separates it from its input, whatever the cutoff was before.
    f = AdaptiveLowPass(mode=mode, order=order, smoothing=0.0, slew=0.0, dead_band=0.0)
    rng = np.random.default_rng(3)
    t, x = 0.0, 0.0
    before = f.filter(t, x, 0.1)
    seen = set()
    for k in range(400):
        t, x = t + 1e-3, rng.standard_normal()
        before = f.filter(t, x, (0.1, 10.0)[k % 2])
        t += 1e-6
        after = f.filter(t, x, (10.0, 0.1)[k % 2])
        seen.add(round(f.cutoff))
        # A derivative has slopes of 1e3 and more for its input.
        assert abs(after - before) < 1e-3 * (6000.0 if mode == 'derivative' else 6.0)
        before = after
    assert seen == {20, 150}


# Another accepted value of every parameter, with what it needs beside it.
CHANGES = [
    {'order': 1}, {'law': 'threshold'}, {'law': 'kalman', 'n0': 1e-6},
    {'law': 'kalman', 'n0': 1e-6, 'coupling': 1.0},
    {'fmin': 3.0}, {'fmax': 400.0}, {'max_lag': 30.0}, {'lag_frequency': 3.0},
    {'sigma_ref': 0.01}, {'coupling': 0.4}, {'coupling': 0.4, 'noise_wanted': 0.1},
    {'n0': 1e-3}, {'alpha': 5.0},
    {'smoothing': 0.0}, {'slew': 0.0},
    {'dead_band': 0.0}, {'fallback': 30.0}, {'shadow': True}, {'stale_after': 5.0}]


def test_the_list_of_changes_is_complete():
    assert {name for change in CHANGES for name in change} | {'mode'} == {
        p.name for p in FILTER_PARAMETERS}


@pytest.mark.parametrize('change', CHANGES, ids=str)
@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_no_parameter_change_moves_the_output(change, mode):
    """At the same stamp not at all, 1 ns later by no more than the filter moves in 1 ns."""
    f, y = warm(mode=mode)
    f.configure(**change)
    assert f.filter(0.099, 1e3, 0.5) == y
    # The input goes on with its slope, which is what a derivative has for its input.
    x = np.random.default_rng(0).standard_normal(100)
    going_on = x[-1] + (x[-1] - x[-2]) * 1e-6
    # 2 pi 400 Hz 1 ns = 2.5e-6 of the distance to the input.
    assert f.filter(0.099 + 1e-9, going_on, 0.5) == pytest.approx(
        y, abs=2e-5 * (1e3 if mode == 'derivative' else 1.0))


def test_shadow_passes_the_input_and_computes_the_cutoff():
    f, twin = AdaptiveLowPass(shadow=True), AdaptiveLowPass()
    x = np.random.default_rng(1).standard_normal(500)
    t = np.arange(500) * 1e-3
    assert np.array_equal(f.filter(t, x, 0.6), x)
    twin.filter(t, x, 0.6)
    assert f.cutoff == twin.cutoff < 150.0


def test_shadow_of_a_derivative_is_the_difference_quotient():
    f = AdaptiveLowPass(shadow=True, mode='derivative')
    x = np.random.default_rng(1).standard_normal(50)
    assert f.filter(np.arange(50) * 1e-3, x, 0.6)[1:] == pytest.approx(list(np.diff(x) * 1e3))


def test_leaving_shadow_goes_over_to_the_filter():
    """From the input at once to where a filter that was never a shadow is, within 0.1 s."""
    f, twin = AdaptiveLowPass(shadow=True), AdaptiveLowPass()
    x = np.random.default_rng(1).standard_normal(600)
    t = np.arange(600) * 1e-3
    f.filter(t[:300], x[:300], 0.6)
    f.configure(shadow=False)
    assert f.filter(t[299], 7.0, 0.6) == x[299]
    y, wanted = f.filter(t[300:], x[300:], 0.6), twin.filter(t, x, 0.6)[300:]
    assert abs(y[0] - wanted[0]) > 0.1
    assert y[100:] == pytest.approx(list(wanted[100:]), abs=1e-6)


@settings(max_examples=100, deadline=None)
@given(order=st.sampled_from([1, 2]), shadow=st.booleans(), samples=st.lists(st.tuples(
    st.floats(-0.01, 0.2), st.one_of(st.floats(-1.0, 1.0), st.sampled_from([NAN, math.inf])),
    st.one_of(st.floats(0.0, 1e3), st.sampled_from([NAN, -1.0, math.inf]))),
    min_size=1, max_size=60))
def test_bounded_and_finite_whatever_comes(order, shadow, samples):
    f = AdaptiveLowPass(order=order, shadow=shadow, smoothing=0.0, slew=0.0)
    t, started = 0.0, False
    for dt, x, sigma in samples:
        t += dt
        y = f.filter(t, x, sigma)
        started = started or math.isfinite(x)
        assert math.isfinite(y) == started
        assert not started or abs(y) <= BOUND[order] * (1.0 + 1e-9)
        assert 20.0 <= f.cutoff <= 150.0
    c = f.counters
    assert c.samples + c.non_finite + c.repeated + c.back == len(samples)


@settings(max_examples=200, deadline=None)
@given(mode=st.sampled_from(['lowpass', 'derivative']), order=st.sampled_from([1, 2]),
       samples=st.lists(st.tuples(*[st.floats(allow_nan=True, allow_infinity=True)] * 3),
                        min_size=1, max_size=40))
def test_no_number_can_break_it(mode, order, samples):
    """Any floats at all, subnormal steps included; afterwards it works as ever."""
    f = AdaptiveLowPass(mode=mode, order=order)
    for t, x, sigma in samples:
        assert not math.isinf(f.filter(t, x, sigma))
    t = -2e17 + np.arange(0.0, 640.0 * 3000, 640.0)
    y = f.filter(t, 3.0 + 2.0 * (t - t[0]), 0.1)
    assert y[-1] == pytest.approx(2.0 if mode == 'derivative' else 3.0 + 2.0 * (t[-1] - t[0]),
                                  rel=1e-2)


def test_nan_input_does_not_move_the_filter():
    f = AdaptiveLowPass()
    assert math.isnan(f.filter(0.0, NAN, 0.1))
    assert f.filter(0.0, 2.0, 0.1) == 2.0
    assert f.filter(0.001, NAN, 0.1) == 2.0
    assert f.filter(0.002, 1e200, 0.1) == 2.0
    assert f.filter(NAN, 3.0, 0.1) == 2.0
    assert f.counters.non_finite == 4 and f.counters.samples == 1


def test_nan_samples_are_bridged():
    """A line with holes in it stays a line: what comes after is as if the hole was filled."""
    t = np.arange(200) * 1e-3
    x = 3.0 * t
    whole, holed = AdaptiveLowPass(), AdaptiveLowPass()
    wanted = whole.filter(t, x, 0.1)
    x[90:95] = NAN
    assert holed.filter(t, x, 0.1)[95:] == pytest.approx(list(wanted[95:]), abs=1e-9)


def test_time_back_and_repeats_are_counted_and_hold_the_output():
    f, y = warm()
    assert f.filter(0.099, 50.0, 0.5) == y and f.counters.repeated == 1
    assert f.filter(0.010, 50.0, 0.5) == y and f.counters.back == 1
    # Time goes on from there: the next step is one of 1 ms.
    assert abs(f.filter(0.011, 50.0, 0.5) - y) > 1.0 and f.counters.back == 1


def test_a_new_time_line_has_no_spike_in_its_derivative():
    """A bag that starts again, at another level: the slope is that of its own samples."""
    f = AdaptiveLowPass(mode='derivative')
    t = 10.0 + np.arange(1000) * 1e-3
    f.filter(t, 2.0 * t, 0.1)
    again = f.filter(t - 5.0, 100.0 + 2.0 * t, 0.1)
    assert again == pytest.approx([2.0] * 1000)


def test_gaps_are_counted():
    f, _ = warm()
    f.filter(0.5, 0.0, 0.5)
    assert f.counters.gaps == 1
    f.filter(0.502, 0.0, 0.5)
    assert f.counters.gaps == 1


def test_a_gap_does_not_slow_the_filter():
    """0.45 of the sample rate is of the usual rate: after 0.5 s the output is at the input."""
    f, _ = warm()
    f.filter(0.6, 4.0, 0.1)
    f.filter(1.1, 4.0, 0.1)
    assert f.cutoff > 20.0 and f.filter(1.101, 4.0, 0.1) == pytest.approx(4.0, abs=1e-9)


@pytest.mark.parametrize('sigma', [NAN, math.inf, -1.0])
def test_unknown_sigma_means_fallback(sigma):
    f = AdaptiveLowPass(fallback=60.0)
    f.filter(0.0, 1.0, sigma)
    assert f.cutoff == 60.0 and f.bound is Bound.FALLBACK and math.isnan(f.wanted)


def test_time_line_of_a_sigma_that_fails_and_comes_back():
    """Law, fallback, law: each reached, with the slew of 4 octaves/s between."""
    f = AdaptiveLowPass(smoothing=0.0)
    t = np.arange(4000) * 1e-3
    sigma = np.where((t >= 1.0) & (t < 2.5), NAN, 0.6)
    cutoffs = []
    for one, s in zip(t, sigma):
        f.filter(one, 0.0, s)
        cutoffs.append(f.cutoff)
    low = relative_cutoff('lowpass', 2, 150.0, 2.0, 1e-3)
    assert cutoffs[2499] == 75.0
    assert [cutoffs[999], cutoffs[-1]] == pytest.approx([low, low])
    assert cutoffs[1100] == pytest.approx(low * 2.0 ** 0.404, rel=0.01)
    there = 1000 + int(250.0 * math.log2(75.0 / low))
    assert cutoffs[there - 10] < 75.0 == cutoffs[there + 10]


def test_confidence_is_used():
    t, x = np.arange(50) * 1e-3, np.zeros(50)
    sigma = np.where(t < 0.01, 0.3, 0.6)
    got = []
    for error in (0.01, 0.1, 1.0):
        f = AdaptiveLowPass(slew=0.0)
        f.filter(t, x, sigma, sigma_se=error)
        got.append(f.cutoff)
    assert got[0] < got[1] < got[2]


def test_lag_is_that_of_the_cutoff_in_force():
    f = AdaptiveLowPass(order=1, lag_frequency=10.0)
    f.filter(0.0, 0.0, 10.0)
    assert f.cutoff == 20.0 and f.phase_lag == pytest.approx(26.565, abs=1e-3)
    assert f.delay == pytest.approx(26.565 / 3600.0, abs=1e-6)
    f = AdaptiveLowPass(order=2, max_lag=40.0)
    f.filter(0.0, 0.0, 10.0)
    assert f.phase_lag == pytest.approx(40.0) and f.bound is Bound.LAG


def test_mode_does_not_change_while_filtering():
    f = AdaptiveLowPass()
    f.configure(mode='derivative')
    f.filter(0.0, 0.0, 0.1)
    with pytest.raises(ValueError, match='make a new filter'):
        f.configure(mode='lowpass')
    assert f.settings.mode == 'derivative'


@pytest.mark.parametrize('options, words', [
    ({'fmim': 3.0}, 'fmin'), ({'law': 'treshold'}, 'threshold'), ({'order': 3}, 'order'),
    ({'fmin': 200.0, 'fmax': 100.0}, 'fmin'), ({'fmax': NAN}, 'fmax'),
    ({'fmin': 150.0}, 'fmin .150.0 Hz. must be less than fmax'),
    ({'fallback': 500.0}, 'fallback'), ({'mode': 'derivation'}, "did you mean 'derivative'"),
    ({'max_lag': 95.0, 'order': 1}, 'less than 90, which order 1 never reaches'),
    ({'max_lag': 5.0}, 'needs a cutoff of .* allow more lag or raise fmax'),
    ({'max_lag': 20.0, 'fallback': 30.0}, 'fmin by max_lag 20 degrees'),
    ({'law': 'kalman'}, 'needs the noise'), ({'law': 'wiener'}, 'unknown .wiener'),
    ({'noise_wanted': 1.0}, 'needs coupling'), ({'shadow': 1}, 'true or false'),
    ({'slew': -1.0}, 'slew')])
def test_bad_options_are_refused_by_name_and_the_old_ones_stay(options, words):
    with pytest.raises(ValueError, match=words) as caught:
        AdaptiveLowPass(**options)
    assert '\n' not in str(caught.value)
    f = AdaptiveLowPass()
    with pytest.raises(ValueError, match=words):
        f.configure(**options)
    assert f.settings == FilterSettings()


def test_limits_alone_are_enough():
    assert AdaptiveLowPass(fmin=100.0, fmax=400.0).settings.fallback == 100.0
    assert AdaptiveLowPass(fmin=1.0, fmax=50.0).settings.fallback == 50.0
    assert AdaptiveLowPass(max_lag=9.0, fmax=150.0).settings.fallback == pytest.approx(90.7, 1e-2)


@pytest.mark.parametrize('arguments, more, words', [
    (([0.0, 1.0], [1.0], 0.1), {}, 't and x'),
    (([0.0, 1.0], [1.0, 2.0], [0.1] * 3), {}, 'sigma'),
    (([0.0, 1.0], [1.0, 2.0], 0.1), {'alpha': [0.1]}, 'alpha')])
def test_shapes_must_agree(arguments, more, words):
    with pytest.raises(ValueError, match=words):
        AdaptiveLowPass().filter(*arguments, **more)


@pytest.mark.parametrize('alpha, used', [
    (1e-6, True), (1e9, True), (7.0, True), (math.nextafter(1e-6, 0.0), False),
    (math.nextafter(1e9, math.inf), False), (0.0, False), (-7.0, False), (NAN, False)])
def test_a_relaxation_rate_is_used_within_the_range_of_the_parameter(alpha, used):
    """Within 1e-6..1e9 1/s the filter is that of the parameter alpha; else alpha is not known."""
    x = np.random.default_rng(2).standard_normal(50)
    t = np.arange(50) * 1e-3
    options = {'law': 'kalman', 'coupling': 1.0, 'n0': 1e-4}
    got = AdaptiveLowPass(**options).filter(t, x, 0.3, alpha=alpha)
    at_default = AdaptiveLowPass(**options).filter(t, x, 0.3)
    assert (got.tolist() == at_default.tolist()) is not used
    if used:
        assert got.tolist() == AdaptiveLowPass(**options, alpha=alpha).filter(t, x, 0.3).tolist()
