"""LearnedCurves against supplies whose level and intensity over throttle are known."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.online.risk.curves import LearnedCurves
from ou_monitor.records import Estimate, Flag, Status
import pytest
from simulated_flights import (
    ALPHA, DrawnSupply, DT, fly, holds, learn, level, log_sigma, truth, wandering)

AT = np.array([0.15, 0.3, 0.45, 0.6, 0.75])


def scores(curves, t_end, drift=0.0):
    """Return how many standard errors level and ln(sigma) are from the truth, shape (2, k)."""
    v, v_se = curves.level_curve(AT)
    s, s_se = curves.sigma_curve(AT)
    return np.array([(v - level(AT) + drift * t_end) / v_se, (s - log_sigma(AT)) / s_se])


def flown(seed=0, throttle=None, duration=20.0, estimate=None, **more):
    """Return curves that have learned one flight."""
    rng = np.random.default_rng(seed)
    throttle = holds(rng, duration) if throttle is None else throttle
    t, y = fly(rng, throttle, **more)
    curves = LearnedCurves()
    learn(curves, t, y, throttle, estimate or truth())
    return curves


@pytest.mark.parametrize('profile', [holds, wandering])
def test_the_standard_errors_are_honest(profile):
    """
    40 supplies that wander as expected: 95 % intervals hold the truth, and are not too wide.

    Throttles of one flight are correlated, so in the worst case the share has the scatter of 40
    draws, and the mean square that of 40 normals.
    """
    z = []
    for seed in range(40):
        rng = np.random.default_rng([1, seed])
        throttle = profile(rng, 20.0)
        supply = DrawnSupply(rng, throttle.size)
        t, y = fly(rng, throttle, level=lambda u: supply.along(supply.level, u),
                   log_sigma=lambda u: supply.along(supply.log_sigma, u))
        curves = LearnedCurves()
        learn(curves, t, y, throttle, truth(sigma_se=0.0))
        v, v_se = curves.level_curve(AT)
        s, s_se = curves.sigma_curve(AT)
        z.append([(v - supply.last(supply.level, AT)) / v_se,
                  (s - supply.last(supply.log_sigma, AT)) / s_se])
    z = np.array(z)
    share = np.mean(np.abs(z) < 1.96, axis=(0, 2))
    assert np.all(share > 0.95 - 3.0 * math.sqrt(0.95 * 0.05 / 40.0)), share
    square = np.mean(z ** 2, axis=(0, 2))
    assert np.all(square < 1.0 + 3.0 * math.sqrt(2.0 / 40.0)), square
    # Twice too wide would be 0.25.
    assert np.all(square > 0.4), square


@pytest.mark.parametrize('noise, dt, profile', [
    (0.0, 1e-3, holds), (0.02, 1e-3, wandering), (0.02, 5e-3, holds)])
def test_with_the_estimator_in_front(noise, dt, profile):
    """Estimates of a sliding window instead of the truth: white noise, discharge at 10 mV/s."""
    z, errors = [], []
    for seed in range(20):
        rng = np.random.default_rng([2, seed])
        throttle = profile(rng, 20.0, dt=dt)
        t, y = fly(rng, throttle, dt, drift=0.01, noise=noise)
        estimator, curves = SlidingEstimator(2.0), LearnedCurves()
        size = round(0.25 / dt)
        for begin in range(0, t.size, size):
            part = slice(begin, begin + size)
            estimator.push(t[part], y[part], throttle[part])
            curves.update(t[part], y[part], throttle[part], estimator.estimate())
        z.append(scores(curves, t[-1], 0.01))
        errors.append([curves.level_curve(AT)[1], curves.sigma_curve(AT)[1]])
    # Well known where most flights have been: 20 mV on 5 V, 15 % of sigma.
    typical = np.median(errors, axis=(0, 2))
    assert typical[0] < 0.02 and typical[1] < 0.15, typical
    square = np.mean(np.array(z) ** 2, axis=(0, 2))
    assert np.all(square < 1.0 + 3.0 * math.sqrt(2.0 / 20.0)), square


def test_drift_is_followed_where_throttle_is_not():
    """Sag learned at 0.6 holds while the level common to all falls by 0.4 V at 0.3."""
    throttle = np.where(np.arange(60000) % 4000 < 2000, 0.3, 0.6)
    throttle[20000:] = 0.3
    curves = flown(throttle=throttle, drift=0.01)
    now = level(0.6) - 0.01 * 59.999
    value, se = curves.level_at(0.6)
    assert abs(value - now) < 4.0 * se
    # Twenty times less than what the level fell since 0.6 was flown.
    assert se < 0.02


def test_sigma_that_ages_is_followed():
    """Ln(sigma) rises by 0.7 within two minutes: the curve at the throttle flown keeps up."""
    throttle = np.full(120000, 0.4)
    rng = np.random.default_rng(3)
    rise = np.linspace(0.0, 0.7, throttle.size)
    t, y = fly(rng, throttle, log_sigma=lambda u: log_sigma(u) + rise)
    curves = LearnedCurves()
    learn(curves, t, y, throttle, truth())
    value, se = curves.sigma_at(0.4)
    # It lags by as long as it averages, some seconds of a rise of 0.006 1/s.
    assert abs(value - log_sigma(0.4) - 0.7) < 3.0 * se + 0.06
    assert se < 0.1


def test_not_seen_is_said():
    """Beyond 0.2..0.4 the errors grow with the distance, and hold the truth."""
    curves = flown(throttle=holds(np.random.default_rng(4), 30.0, 0.2, 0.4), duration=30.0)
    for curve, exact in ((curves.level_curve, level), (curves.sigma_curve, log_sigma)):
        values, errors = curve(np.array([0.3, 0.5, 0.7, 0.9, 1.0]))
        assert np.all(np.diff(errors) > 0.0)
        assert errors[3] > 5.0 * errors[0]
        assert np.all(np.abs(values - exact(np.array([0.3, 0.5, 0.7, 0.9, 1.0]))) < 3.0 * errors)
    assert curves.seen_curve(np.array([0.3, 0.6, 0.0, math.nan])).tolist() == [True] + [False] * 3
    lowest, highest = curves.extent
    assert 0.18 <= lowest < 0.26 and 0.34 < highest <= 0.42
    assert all(map(math.isnan, curves.level_at(math.nan)))


@pytest.mark.parametrize('throttle', [None, math.nan])
def test_nothing_is_known_without_throttle(throttle):
    """No throttle: nothing learned, nothing claimed."""
    rng = np.random.default_rng(5)
    t, y = fly(rng, np.full(3000, 0.5))
    curves = LearnedCurves()
    learn(curves, t, y, None if throttle is None else np.full(t.size, throttle), truth())
    assert all(map(math.isnan, (*curves.level_at(0.5), *curves.sigma_at(0.5), *curves.extent)))
    assert not curves.seen_curve(np.array([0.5])) and not curves.throttle_known


def test_nothing_is_known_without_an_estimate():
    """Samples alone do not make a curve; with estimates that turn bad, the level goes on."""
    rng = np.random.default_rng(6)
    throttle = np.full(20000, 0.5)
    t, y = fly(rng, throttle, drift=0.05)
    curves = LearnedCurves()
    bad = Estimate(status=Status.UNBOUND)
    learn(curves, t[:3000], y[:3000], throttle[:3000], bad)
    assert math.isnan(curves.level_at(0.5).value) and curves.throttle_known
    learn(curves, t[3000:8000], y[3000:8000], throttle[3000:8000], truth())
    sigma = curves.sigma_at(0.5)
    learn(curves, t[8000:], y[8000:], throttle[8000:], bad)
    value, se = curves.level_at(0.5)
    assert abs(value - level(0.5) + 0.05 * t[-1]) < 4.0 * se < 0.2
    # No innovations without a usable estimate: as known as before, and aged.
    assert curves.sigma_at(0.5).value == pytest.approx(sigma.value, abs=0.3 * sigma.se)
    assert curves.sigma_at(0.5).se > sigma.se


def test_steps_of_throttle_do_not_bend_the_curve():
    """Throttle jumps between 0.2 and 0.7 four times a second: the lag is not taken for sag."""
    throttle = np.where(np.arange(60000) % 500 < 250, 0.2, 0.7)
    rng = np.random.default_rng(7)
    t, y = fly(rng, throttle, log_sigma=lambda u: np.full(u.shape, -4.0))
    curves = LearnedCurves()
    learn(curves, t, y, throttle, truth(sigma=math.exp(-4.0), var_inf=math.exp(-8.0) / 126.0))
    for u in (0.2, 0.7):
        # One step unheeded would be 0.16 V * 16 ms / 50 ms = 50 mV in its block.
        assert curves.level_at(u).value == pytest.approx(level(u), abs=0.003)


def test_an_inrush_is_left_out():
    """A dip of twice the sag for 40 ms after each rise, as in racers: the steady sag is found."""
    throttle = np.where(np.arange(60000) % 1000 < 500, 0.2, 0.7)
    rng = np.random.default_rng(18)
    rise = (np.arange(60000) % 1000 >= 500) & (np.arange(60000) % 1000 < 540)
    t, y = fly(rng, throttle, log_sigma=lambda u: np.full(u.shape, -4.0))
    curves = LearnedCurves()
    learn(curves, t, y - 0.35 * rise, throttle,
          truth(sigma=math.exp(-4.0), var_inf=math.exp(-8.0) / (2.0 * ALPHA)), 125)
    # Throttle does not move within blocks that begin with its step.  Left in, the dip would be
    # 0.35 V * 40 ms / 500 ms = 28 mV.
    assert curves.level_at(0.7).value == pytest.approx(level(0.7), abs=0.004)
    # Its end is a jump of 0.35 V, against 0.6 mV of noise a step.
    assert curves.sigma_at(0.7).value == pytest.approx(-4.0, abs=0.1)


@pytest.mark.parametrize('dt, noise', [(1e-3, 0.0), (1e-2, 0.0), (1e-3, 0.02)])
def test_misses_are_as_large_as_expected(dt, noise):
    """
    The variance of each observation is right, before anything is widened.

    The running mean of squares has the scatter sqrt(0.02) of one flight; blocks count as a tenth
    more uncertain than they are, for their correlation, and what wanders less than expected does.
    """
    found = []
    for seed in range(20):
        rng = np.random.default_rng([19, seed])
        throttle = np.full(round(30.0 / dt), 0.4)
        t, y = fly(rng, throttle, dt, noise=noise)
        curves = LearnedCurves()
        learn(curves, t, y, throttle, truth(noise_std=noise, sigma_se=0.0))
        found.append(curves.scatter)
    spread = 3.0 * math.sqrt(0.02 / 20.0)
    mean = np.mean(found, axis=0)
    assert np.all((mean > 0.7 - spread) & (mean < 1.0 + spread)), mean


def test_bad_input_is_harmless():
    """NaN, duplicates, stamps that stand still, pauses, late ones: the same curves in the end."""
    rng = np.random.default_rng(8)
    throttle = holds(rng, 20.0)
    t, y = fly(rng, throttle)
    good, bad = LearnedCurves(), LearnedCurves()
    learn(good, t, y, throttle, truth())
    for k, begin in enumerate(range(0, t.size, 50)):
        part = slice(begin, begin + 50)
        a, b, c = t[part].copy(), y[part].copy(), throttle[part].copy()
        kind = k % 40
        if kind == 0:
            b[10] = math.nan
        elif kind == 5:
            a[20] = math.inf
        elif kind == 10:
            c[:] = math.nan
        elif kind == 15:
            a[:] = a[0]
        elif kind == 20:
            a[30:], b[30:] = a[30:][::-1].copy(), b[30:][::-1].copy()
        elif kind == 25:
            continue
        elif kind == 30:
            bad.update([], [], [], truth())
            b[5] = math.inf
        elif kind == 35:
            c[7] = 1500.0
        bad.update(a, b, c, truth())
    for ours, theirs in ((bad.level_curve, good.level_curve), (bad.sigma_curve, good.sigma_curve)):
        values, errors = ours(AT)
        expected, scale = theirs(AT)
        # A sixth of the samples is missing.
        assert np.all(np.abs(values - expected) < 1.5 * scale)
        assert np.all((errors > 0.8 * scale) & (errors < 1.5 * scale))
    with pytest.raises(ValueError, match='shape'):
        bad.update(t[:3], y[:2], throttle[:3], truth())


def test_a_clock_set_back_widens_and_goes_on():
    """The level is less sure after an unknown time, what is at the new time is learned."""
    curves = flown(seed=9)
    before = curves.level_at(0.5)
    rng = np.random.default_rng(10)
    throttle = np.full(200, 0.2)
    t, y = fly(rng, throttle, level=lambda u: level(u) - 0.3)
    curves.update(t, y, throttle, truth())
    assert curves.level_at(0.5).se > 2.0 * before.se
    throttle = np.full(4000, 0.2)
    t, y = fly(rng, throttle, level=lambda u: level(u) - 0.3)
    learn(curves, t + 0.2, y, throttle, truth())
    value, se = curves.level_at(0.5)
    assert abs(value - level(0.5) + 0.3) < 4.0 * se < 0.2


def test_one_stamp_far_ahead_is_survived():
    """A stamp of another clock, once: curves known again after the flight goes on."""
    rng = np.random.default_rng(11)
    throttle = holds(rng, 20.0)
    t, y = fly(rng, throttle)
    wrong = t.copy()
    wrong[8000] = 1.7e9
    curves = LearnedCurves()
    learn(curves, wrong, y, throttle, truth())
    assert np.abs(scores(curves, t[-1])).max() < 4.0
    assert curves.level_curve(AT)[1].max() < 0.1


@pytest.mark.parametrize('size', [1, 7, 1000, 20000])
def test_blocks_of_any_size(size):
    """Scalars, odd blocks, the whole flight at once: the same curves but for the cuts."""
    rng = np.random.default_rng(12)
    throttle = holds(rng, 20.0)
    t, y = fly(rng, throttle)
    usual, other = LearnedCurves(), LearnedCurves()
    learn(usual, t, y, throttle, truth())
    learn(other, t, y, throttle, truth(), size)
    for ours, theirs in ((other.level_curve, usual.level_curve),
                         (other.sigma_curve, usual.sigma_curve)):
        values, errors = ours(AT)
        expected, scale = theirs(AT)
        # Steps of throttle fall elsewhere in the blocks: some tenth of the data differs.
        assert np.all(np.abs(values - expected) < scale)
        assert errors == pytest.approx(scale, rel=0.3)


def test_the_array_of_the_caller_may_change():
    """Samples that wait are copies."""
    rng = np.random.default_rng(13)
    throttle = np.full(2000, 0.5)
    t, y = fly(rng, throttle)
    mine, theirs = LearnedCurves(), LearnedCurves()
    learn(theirs, t, y, throttle, truth(), 10)
    a, b, c = np.empty(10), np.empty(10), np.empty(10)
    for begin in range(0, t.size, 10):
        a[:], b[:], c[:] = (x[begin:begin + 10] for x in (t, y, throttle))
        mine.update(a, b, c, truth())
    assert mine.level_at(0.5) == theirs.level_at(0.5)
    assert mine.sigma_at(0.5) == theirs.sigma_at(0.5)


def test_repeats_of_a_slow_source():
    """Every value sent five times: the estimator says so, and sigma is that of the source."""
    rng = np.random.default_rng(14)
    throttle = np.full(8000, 0.4)
    t, y = fly(rng, throttle, 5e-3, noise=0.02)
    estimate = truth(flags=(Flag.HELD_SAMPLES,), rate=200.0, n=400, sigma_se=0.05, noise_std=0.02)
    curves = LearnedCurves()
    learn(curves, np.arange(40000) * 1e-3, np.repeat(y, 5), np.repeat(throttle, 5), estimate, 250)
    value, se = curves.sigma_at(0.4)
    assert abs(value - log_sigma(0.4)) < 3.0 * se < 0.3


def test_scatter_that_no_ou_has_widens_the_errors():
    """A second, slow process of 20 mV that the estimate does not know of."""
    throttle = np.full(40000, 0.4)
    z = []
    for seed in range(8):
        rng = np.random.default_rng([15, seed])
        t, y = fly(rng, throttle, log_sigma=lambda u: np.full(u.shape, -3.0))
        keep = math.exp(-DT)
        slow = np.zeros(t.size)
        for k in range(0, t.size, 1000):
            slow[k:] += 0.02 * math.sqrt(1.0 - keep ** 2000) * rng.standard_normal()
        curves = LearnedCurves()
        learn(curves, t, y + slow, throttle,
              truth(sigma=math.exp(-3.0), var_inf=math.exp(-6.0) / (2.0 * ALPHA)))
        value, se = curves.level_at(0.4)
        z.append((value - level(0.4) - slow[-1]) / se)
    assert np.mean(np.square(z)) < 1.0 + 3.0 * math.sqrt(2.0 / 8.0)


def test_shorter_forgetting_forgets_faster(monkeypatch):
    """What was learned at 0.7 is less sure after a minute at 0.3, the more the less is kept."""
    throttle = np.full(60000, 0.3)
    throttle[2000:8000] = 0.7
    rng = np.random.default_rng(17)
    t, y = fly(rng, throttle)
    errors = []
    for forgetting in (30.0, 300.0, 3000.0):
        monkeypatch.setattr('ou_monitor.online.risk.curves.FORGETTING', forgetting)
        curves = LearnedCurves()
        learn(curves, t, y, throttle, truth())
        errors.append(curves.sigma_at(0.7).se)
    assert errors[0] > 1.5 * errors[1] > 2.0 * errors[2]


def test_what_is_old_is_no_longer_seen(monkeypatch):
    """Data weigh less with time: after hours elsewhere nothing is known of 0.7, or claimed."""
    throttle = np.full(8000, 0.3)
    throttle[2000:4000] = 0.7
    rng = np.random.default_rng(21)
    t, y = fly(rng, throttle)
    monkeypatch.setattr('ou_monitor.online.risk.curves.FORGETTING', 20.0)
    monkeypatch.setattr('ou_monitor.online.risk.curves.SHAPE_FORGETTING', 60.0)
    curves = LearnedCurves()
    learn(curves, t, y, throttle, truth())
    assert curves.seen_curve(np.array([0.7])) and curves.extent[1] == pytest.approx(0.7)
    # Longer than the largest number that weights are counted in.
    for hour in range(1, 8):
        learn(curves, t[:2000] + 3600.0 * hour, y[:2000], throttle[:2000], truth())
    assert curves.seen_curve(np.array([0.3, 0.7])).tolist() == [True, False]
    assert curves.extent == pytest.approx((0.3, 0.3))
