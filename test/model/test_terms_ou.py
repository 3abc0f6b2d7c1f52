"""The OU, and the terms that change its mean, rate, intensity or force."""

import math

import numpy as np
from ou_monitor.model.ou import simulate, stationary_variance, transition
import pytest
from scipy.integrate import quad
from scipy.linalg import solve_continuous_lyapunov
from term_examples import agrees, ALPHA, clusters, has_covariance, SIGMA, still, supply, term, U0

VAR = 0.632 ** 2 / 126.0


@pytest.mark.parametrize('alpha, sigma', [(63.0, 0.632), (4.0, 2.0), (900.0, 0.05)])
def test_ou_at_uneven_stamps(alpha, sigma):
    """Mean u0 and covariance sigma^2/(2 alpha) exp(-alpha lag), steps of 0.1 to 60 relaxations."""
    # 60 000 independent groups: a variance to sqrt(2/60 000) = 0.6 %, so that 5 % is seen.
    offsets = np.array([0.0, 0.1, 0.5, 1.5]) / alpha
    groups = clusters(supply(alpha=alpha, sigma=sigma), offsets, 60.0 / alpha, 60_000, 1) - U0
    var = sigma ** 2 / (2.0 * alpha)
    # Four samples within 1.5 relaxations count for one at least.
    assert abs(groups.mean()) < 4.0 * math.sqrt(var / 60_000)
    has_covariance(groups, offsets, lambda lag: var * math.exp(-alpha * lag))


@pytest.mark.parametrize('dt', [1e-4, 0.01, 0.05])
def test_ou_at_even_stamps(dt):
    """It is AR(1): coefficient and variance of the innovations, which are independent."""
    # n = 400 000: the variance to sqrt(2/n) = 0.22 %, so that 2 % is seen; the coefficient to
    # sqrt((1 - phi^2)/n).
    n = 400_000
    phi = math.exp(-ALPHA * dt)
    x = supply().simulate(np.arange(n) * dt, np.random.default_rng(2)) - U0
    e = x[1:] - phi * x[:-1]
    agrees(e.var(), VAR * (1.0 - phi * phi), VAR * (1.0 - phi * phi) * math.sqrt(2.0 / n), 0.02)
    assert abs(np.mean(e * x[:-1]) / VAR) < 4.0 * math.sqrt((1.0 - phi * phi) / n)
    assert abs(np.mean(e[1:] * e[:-1]) / e.var()) < 4.0 / math.sqrt(n)
    # A mean of n samples that are worth n tanh(alpha dt / 2) independent ones.
    assert abs(x.mean()) < 4.0 * math.sqrt(VAR / (n * math.tanh(0.5 * ALPHA * dt)))


def test_second_relaxation_adds_its_own_covariance():
    """Variance sigma^2/(2 alpha) of its own; the sum of two exponentials with the ou."""
    offsets = np.array([0.0, 0.002, 0.02, 0.15])
    other = term('second_relaxation', alpha=5.0, sigma=0.2)
    own = 0.2 ** 2 / 10.0
    alone = clusters(still(other), offsets, 5.0, 90_000, 3)
    has_covariance(alone, offsets, lambda lag: own * math.exp(-5.0 * lag))
    both = clusters(supply(other), offsets, 5.0, 90_000, 4) - U0
    has_covariance(both, offsets, lambda lag: own * math.exp(-5.0 * lag) + VAR * math.exp(
        -ALPHA * lag))


@pytest.mark.parametrize('throttle, log_factor', [
    (0.0, 0.3), (0.1, 0.3), (0.2, 0.4), (0.4, 0.7), (0.7, 0.55), (1.0, 0.4)])
def test_sigma_follows_throttle(throttle, log_factor):
    """Ln sigma on straight lines between knots, level outside; alpha as it was."""
    # The factors are read off the knots (0.1, 0.3), (0.3, 0.5), (0.4, 0.7), (1, 0.4) by hand.
    model = supply(term('load_dependent_sigma', throttle=[0.1, 0.3, 0.4, 1.0],
                        log_factor=[0.3, 0.5, 0.7, 0.4]))
    offsets = np.array([0.0, 0.01])
    groups = clusters(model, offsets, 0.5, 80_000, 5, throttle) - U0
    var = VAR * math.exp(2.0 * log_factor)
    has_covariance(groups, offsets, lambda lag: var * math.exp(-ALPHA * lag))


@pytest.mark.parametrize('throttle, rate', [(0.0, 63.0), (0.5, 63.0 * math.exp(-0.4)),
                                            (1.0, 63.0 * math.exp(-0.8))])
def test_alpha_follows_throttle(throttle, rate):
    offsets = np.array([0.0, 0.01])
    groups = clusters(supply(term('load_dependent_alpha', slope=-0.8)), offsets, 0.5, 80_000, 6,
                      throttle) - U0
    var = SIGMA ** 2 / (2.0 * rate)
    has_covariance(groups, offsets, lambda lag: var * math.exp(-rate * lag))


def test_throttle_acts_on_the_step_before_its_stamp():
    """From the sample where throttle is 1, innovations have the new intensity."""
    n, dt = 200_000, 0.01
    load = (np.arange(n) % 2).astype(float)
    x = supply(term('load_dependent_sigma', throttle=[0.0, 1.0], log_factor=[0.0, 1.0])).simulate(
        np.arange(n) * dt, np.random.default_rng(7), load) - U0
    phi = math.exp(-ALPHA * dt)
    e = x[1:] - phi * x[:-1]
    quiet = VAR * (1.0 - phi * phi)
    error = math.sqrt(2.0 / (n / 2))
    agrees(e[1::2].var(), quiet, quiet * error)
    agrees(e[0::2].var(), quiet * math.e ** 2, quiet * math.e ** 2 * error)


def test_the_log_of_sigma_is_an_ou():
    # The ou relaxes in 1 us here, so a sample is sigma times a fresh normal z, and ln x^2 = ln Var
    # + 2 L + ln z^2: mean ln Var - gamma - ln 2, lagged covariance 4 std^2 exp(-rate lag); exp(2
    # L) has mean exp(2 std^2).
    std, rate, count = 0.7, 8.0, 200_000
    offsets = np.array([0.0, 0.02, 0.06])
    model = supply(term('volatility', std=std, rate=rate), alpha=1e6, sigma=1.0, u0=0.0)
    x = clusters(model, offsets, 2.0, count, 8)
    logs = np.log(x * x) - math.log(0.5e-6)
    middle = -np.euler_gamma - math.log(2.0)
    agrees(logs[:, 0].mean(), middle, math.sqrt((4 * std ** 2 + math.pi ** 2 / 2) / count))
    logs -= middle
    for j, k in ((0, 1), (1, 2), (0, 2)):
        truth = 4.0 * std ** 2 * math.exp(-rate * (offsets[k] - offsets[j]))
        product = logs[:, j] * logs[:, k]
        agrees(product.mean(), truth, product.std() / math.sqrt(count), 0.1)
    square = x[:, 0] ** 2 / 0.5e-6
    agrees(square.mean(), math.exp(2.0 * std ** 2), square.std() / math.sqrt(count), 0.1)


@pytest.mark.parametrize('square, cube, sigma', [
    (0.0, 4000.0, 2.0), (300.0, 3000.0, 2.0), (-300.0, 3000.0, 2.0), (0.0, 1e6, 2.0)])
def test_nonlinear_restoring_has_the_density_of_its_potential(square, cube, sigma):
    """Density ~ exp(-2 V/sigma^2), V the integral of alpha x + square x^2 + cube x^3."""
    # Samples 4 relaxations apart are worth n tanh(2) = 0.96 n at least, as this force pulls harder
    # than the linear one nearly everywhere.
    def weight(x):
        return math.exp(-(ALPHA * x * x + square * x ** 3 / 1.5 + 0.5 * cube * x ** 4)
                        / sigma ** 2)

    far = 2.0 if cube < 1e5 else 0.4
    norm = quad(weight, -far, far, epsabs=1e-13)[0]
    moment = [quad(lambda x, p=p: x ** p * weight(x), -far, far, epsabs=1e-13)[0] / norm
              for p in range(5)]
    # A cube of 1e6 relaxes 15 times faster, and so takes parts that much shorter.
    n, apart = (12_000, 4.0 / ALPHA) if cube < 1e5 else (8_000, 0.4 / ALPHA)
    model = supply(term('nonlinear_restoring', square=square, cube=cube), sigma=sigma, u0=0.0)
    x = model.simulate(np.arange(n) * apart, np.random.default_rng(9))
    for p in (1, 2, 4):
        error = float((x ** p).std()) / math.sqrt(0.9 * n)
        # The mean is 0 without the square, and then needs no power.
        power = math.inf if p == 1 else 0.12 if p == 2 else 0.22
        agrees((x ** p).mean(), moment[p], error, power)
    if square:
        assert abs(moment[1]) > 8.0 * x.std() / math.sqrt(n)
    # The linear law would be far away.
    assert moment[2] < 0.85 * sigma ** 2 / (2.0 * ALPHA)


def decay_error(dt, square=0.0, cube=6000.0):
    """Return the error of the decay after a jump, over 32 ms, at steps dt, V."""
    model = supply(term('nonlinear_restoring', square=square, cube=cube),
                   term('jumps', rate=3.0, mean=0.3, std=0.0), sigma=0.0, u0=0.0)
    t = np.arange(int(round(3.0 / dt))) * dt
    x = model.simulate(t, np.random.default_rng(11))
    k = int(np.flatnonzero(x)[0])
    later = k + int(round(0.032 / dt))
    # dx/dt = -alpha x - b x^(p + 1): 1/x^p obeys a linear equation.  Either force alone.
    ratio, p = (square / ALPHA, 1) if square else (cube / ALPHA, 2)
    end = (math.exp(p * ALPHA * 0.032) * (x[k] ** -p + ratio) - ratio) ** (-1.0 / p)
    assert not np.any(np.diff(x[k:later + 1]) > 0.0) and end < 0.3 * x[k]
    return abs(x[later] - end) / x[k]


@pytest.mark.parametrize('square, cube', [(0.0, 6000.0), (700.0, 1e-6), (-90.0, 1e-6)])
def test_nonlinear_restoring_is_of_second_order(square, cube):
    """Without noise the closed form is met, four times nearer at half the step."""
    # Order 1 would give 2; the bound is 3, and steps are well below the cut.
    errors = [decay_error(dt, square, cube) for dt in (4e-4, 2e-4, 1e-4)]
    assert errors[0] < 1e-5
    assert 3.0 < errors[0] / errors[1] < 5.5 and 3.0 < errors[1] / errors[2] < 5.5


def test_a_step_longer_than_the_cut_is_divided():
    """At steps of 4 ms (a quarter of a relaxation) the decay is as near as at 0.8 ms."""
    assert decay_error(4e-3) < 5e-5


def test_stationary_variance_solves_the_lyapunov_equation():
    alpha, sigma = 63.0, 0.632
    lyapunov = solve_continuous_lyapunov(np.array([[-alpha]]), -np.array([[sigma**2]]))
    assert stationary_variance(alpha, sigma) == pytest.approx(lyapunov[0, 0], rel=1e-12)


def test_two_half_steps_are_one_step():
    phi, q = transition(63.0, 0.632, [0.004, 0.002])
    assert phi[1] ** 2 == pytest.approx(phi[0], rel=1e-14)
    assert q[1] * (1.0 + phi[1] ** 2) == pytest.approx(q[0], rel=1e-13)


def test_transition_at_a_tiny_step_keeps_its_digits():
    """For alpha dt -> 0 the innovation variance is sigma^2 dt (1 - alpha dt)."""
    _, q = transition(63.0, 0.632, 1e-12)
    assert float(q) == pytest.approx(0.632**2 * 1e-12 * (1.0 - 63e-12), rel=1e-12)


@pytest.mark.parametrize('regular', [True, False])
def test_paths_have_the_exact_covariance(regular):
    """Cov(x_j, x_k) = Var_inf exp(-alpha |t_j - t_k|), over 10 000 paths."""
    # The standard error of a sample covariance is at most Var_inf sqrt(2 / paths); five of them, 7
    # %, bound the largest of 36 entries.
    rng = np.random.default_rng(11)
    t = np.arange(8) * 0.005 if regular else np.array(
        [0.0, 0.001, 0.004, 0.0041, 0.02, 0.03, 0.031, 0.09])
    paths = np.array([simulate(t, 63.0, 0.632, rng) for _ in range(10_000)])
    var_inf = 0.632**2 / 126.0
    expected = var_inf * np.exp(-63.0 * np.abs(t[:, None] - t[None, :]))
    error = np.abs(paths.T @ paths / len(paths) - expected)
    assert error.max() < 5.0 * var_inf * math.sqrt(2.0 / len(paths))


def test_start_and_level_are_respected():
    rng = np.random.default_rng(0)
    t = np.arange(5) * 0.01
    path = simulate(t, 63.0, 0.0, rng, u0=5.0, start=-0.368)
    assert path == pytest.approx(5.0 - 0.368 * np.exp(-63.0 * t), rel=1e-12)


def test_sigma_may_change_along_the_path():
    """Zero noise after the third stamp leaves pure decay."""
    rng = np.random.default_rng(5)
    t = np.arange(6) * 0.01
    path = simulate(t, 63.0, np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]), rng)
    assert path[3:] == pytest.approx(path[2] * np.exp(-63.0 * (t[3:] - t[2])), rel=1e-12)


@pytest.mark.parametrize('alpha, sigma, dt, word', [
    (0.0, 1.0, 0.1, 'alpha'), (-1.0, 1.0, 0.1, 'alpha'), (math.nan, 1.0, 0.1, 'alpha'),
    (1.0, -1.0, 0.1, 'sigma'), (1.0, 1.0, -0.1, 'steps'), (1.0, 1.0, math.nan, 'steps')])
def test_bad_parameters_are_named(alpha, sigma, dt, word):
    with pytest.raises(ValueError, match=word):
        transition(alpha, sigma, dt)


def test_no_stamps_give_an_empty_path():
    assert simulate([], 63.0, 1.0, np.random.default_rng(0)).shape == (0,)


DT = 1e-3
T = np.arange(400) * DT


def level(*terms, throttle=None, t=T):
    """Return what the terms add to the level, V."""
    return still(*terms).simulate(t, np.random.default_rng(0), throttle)


def step_at(k, low=0.0, high=1.0):
    return np.where(np.arange(T.size) < k, low, high)


@pytest.mark.parametrize('start', [0.0, 1000.0])
def test_sag_follows_throttle_at_once(start):
    """-((linear + growth t) u + square u^2), at once, t from the first sample."""
    throttle = np.random.default_rng(1).random(T.size)
    sag = term('load_sag', linear=0.3, square=0.07, growth=-0.4)
    np.testing.assert_allclose(
        level(sag, throttle=throttle, t=start + T),
        -(0.3 - 0.4 * T) * throttle - 0.07 * throttle ** 2, rtol=0, atol=1e-12)
    np.testing.assert_allclose(level(sag.at(0.2), throttle=throttle),
                               -(0.3 - 0.08) * throttle - 0.07 * throttle ** 2, atol=1e-14)


@pytest.mark.parametrize('gain, tau', [(0.4, 0.03), (-0.2, 0.005), (0.1, 2.0)])
def test_transient_of_a_step(gain, tau):
    """A step from 20 to 70 % shows as 0.5 gain exp(-t/tau) and nothing before."""
    found = level(term('load_transient', gain=gain, tau=tau, delay=0.0),
                  throttle=step_at(100, 0.2, 0.7))
    since = T - T[100]
    np.testing.assert_allclose(
        found, np.where(since >= 0.0, 0.5 * gain * np.exp(-since / tau), 0.0), rtol=0, atol=1e-13)


def test_transient_of_uneven_stamps():
    t = np.cumsum(np.random.default_rng(3).exponential(DT, 400))
    found = level(term('load_transient', gain=0.4, tau=0.03, delay=0.0), throttle=step_at(100),
                  t=t)
    since = t - t[100]
    np.testing.assert_allclose(
        found, np.where(since >= 0.0, 0.4 * np.exp(-since / 0.03), 0.0), rtol=0, atol=1e-13)


@pytest.mark.parametrize('delay, later', [(0.02, 20), (0.001, 1), (0.1, 100), (0.0205, 21)])
@pytest.mark.parametrize('start', [0.0, 0.3, 1000.1])
def test_transient_comes_after_its_delay(delay, later, start):
    t = start + np.arange(400) / 1000.0
    throttle = step_at(100) * 0.5 + 0.1
    prompt = level(term('load_transient', gain=0.4, tau=0.03, delay=0.0), throttle=throttle, t=t)
    late = level(term('load_transient', gain=0.4, tau=0.03, delay=delay), throttle=throttle, t=t)
    np.testing.assert_allclose(late[later:], prompt[:-later], rtol=0, atol=1e-9)
    assert not late[:100 + later].any() and late[100 + later] != 0.0


@pytest.mark.parametrize('start', [0.0, 1.7e9])
def test_drift_counts_from_the_first_sample(start):
    """Rate t + curvature t^2 from the first sample, whatever clock the stamps are of."""
    found = level(term('drift', rate=-0.5, curvature=0.3), t=start + T)
    np.testing.assert_allclose(found, -0.5 * T + 0.3 * T ** 2, rtol=0,
                               atol=1e-12 if start == 0.0 else 1e-6)


def test_drift_follows_the_charge_drawn():
    """Charge times the sum of throttle over time, each value held over the step before it."""
    throttle = np.random.default_rng(2).random(T.size)
    drawn = np.append(0.0, np.cumsum(throttle[1:] * np.diff(T)))
    found = level(term('drift', rate=-0.5, curvature=0.0, charge=-0.2), throttle=throttle)
    np.testing.assert_allclose(found, -0.5 * T - 0.2 * drawn, rtol=0, atol=1e-12)
