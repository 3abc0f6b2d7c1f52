"""Jumps, heavy tails and switching: rates, moments and events within a step."""

import math

import numpy as np
import pytest
from scipy.stats import kstest, t as student
from term_examples import agrees, ALPHA, clusters, SIGMA, still, supply, term

VAR = SIGMA ** 2 / (2.0 * ALPHA)


def jumps(rate=50.0, mean=-0.05, std=0.03):
    return term('jumps', rate=rate, mean=mean, std=std)


@pytest.mark.parametrize('dt', [2e-3, 0.05])
def test_jumps_have_the_moments_of_shot_noise(dt):
    """Mean rate m/alpha, variance rate (m^2 + s^2)/(2 alpha), covariance exp(-alpha lag)."""
    # The fourth cumulant is rate E J^4/(4 alpha). A run of n samples is worth n tanh(alpha dt/2)
    # for its mean and n tanh(alpha dt) for its variance. At steps of 50 ms, 3 relaxations, a jump
    # within a step has relaxed since it came.
    n = round(3500.0 / dt) if dt < 0.01 else 70_000
    x = still(jumps()).simulate(np.arange(n) * dt, np.random.default_rng(1))
    x = x[round(0.5 / dt):]
    mean, std, rate = -0.05, 0.03, 50.0
    var = rate * (mean ** 2 + std ** 2) / (2.0 * ALPHA)
    fourth = rate * (mean ** 4 + 6.0 * (mean * std) ** 2 + 3.0 * std ** 4) / (4.0 * ALPHA)
    worth = x.size * math.tanh(0.5 * ALPHA * dt)
    agrees(x.mean(), rate * mean / ALPHA, math.sqrt(var / worth))
    centred = x - rate * mean / ALPHA
    # The fourth cumulant relaxes at 2 alpha too.
    error = math.sqrt((2.0 * var ** 2 + fourth) / (x.size * math.tanh(ALPHA * dt)))
    agrees(np.mean(centred ** 2), var, error)
    lag = max(1, round(0.01 / dt))
    agrees(np.mean(centred[lag:] * centred[:-lag]) / np.mean(centred ** 2),
           math.exp(-ALPHA * lag * dt), 1.0 / math.sqrt(worth), math.inf)


def test_jumps_are_a_poisson_process():
    """Seen at 20 kHz: numbers, exponential waits, normal sizes, decay in between."""
    # N jumps: their rate to 1/sqrt(N).
    dt, n = 5e-5, 1_000_000
    x = still(jumps()).simulate(np.arange(n) * dt, np.random.default_rng(2))
    e = x[1:] - math.exp(-ALPHA * dt) * x[:-1]
    at = np.flatnonzero(np.abs(e) > 1e-9)
    # Two in one step of 0.0025 jumps are seen as one.
    steps = -math.expm1(-50.0 * dt) * n
    agrees(at.size, steps, math.sqrt(steps), 0.13)
    assert kstest(np.diff(at) * dt, 'expon', (0.0, 1.0 / 50.0)).pvalue > 1e-4
    # Within its step a jump has relaxed by 0.3 % at most.
    assert kstest((e[at] + 0.05) / 0.03, 'norm').pvalue > 1e-4
    agrees(e[at].mean(), -0.05, 0.03 / math.sqrt(at.size), 0.08)
    agrees(e[at].std(), 0.03, 0.03 / math.sqrt(2.0 * at.size), 0.09)


@pytest.mark.parametrize('dof', [3.0, 5.0, 12.0])
def test_innovations_are_student_t(dof):
    # 100 000 of them tell 15 % more or fewer degrees up to 5, and 60 % at 12.
    n, dt = 100_000, 1e-3
    x = supply(term('heavy_tails', dof=dof), u0=0.0).simulate(
        np.arange(n) * dt, np.random.default_rng(4))
    phi = math.exp(-ALPHA * dt)
    z = (x[1:] - phi * x[:-1]) / math.sqrt(VAR * (1.0 - phi * phi))

    def likelihood(nu):
        scale = math.sqrt((nu - 2.0) / nu)
        return student.logpdf(z, nu, scale=scale)

    scale = math.sqrt((dof - 2.0) / dof)
    assert kstest(z, 't', (dof, 0.0, scale)).pvalue > 1e-4
    change = 1.15 if dof < 10.0 else 1.6
    for wrong in (max(dof / change, 2.3), dof * change):
        gain = likelihood(dof) - likelihood(wrong)
        assert gain.sum() > 4.0 * gain.std() * math.sqrt(n)
    assert abs(np.mean(z[1:] * z[:-1])) < 5.0 / math.sqrt(n)


UP, DOWN = 20.0, 60.0
SHARE = UP / (UP + DOWN)


def test_switching_of_the_level():
    """Share of the second state, and covariance level^2 p (1 - p) exp(-(up + down) lag)."""
    # Sampled every 100 ms, 8 relaxations of the chain; 8 and 25 ms give the lags.
    n, level = 60_000, 0.3
    state = term('regime_switching', rate_up=UP, rate_down=DOWN, level=level, sigma_ratio=1.0,
                 at_once=1.0, states=2.0)
    t = (np.arange(n)[:, None] * 0.125 + np.array([0.0, 0.008, 0.025])).ravel()
    x = still(state).simulate(t, np.random.default_rng(6)).reshape(n, 3)
    # The level of the supply, 0 here, is the mean over the states.
    low, high = np.unique(x)
    assert (low, high) == pytest.approx((-SHARE * level, (1.0 - SHARE) * level))
    agrees(np.mean(x[:, 0] == high), SHARE, math.sqrt(SHARE * (1.0 - SHARE) / n))
    for k, lag in ((1, 0.008), (2, 0.025)):
        product = x[:, 0] * x[:, k]
        truth = level ** 2 * SHARE * (1.0 - SHARE) * math.exp(-(UP + DOWN) * lag)
        agrees(product.mean(), truth, product.std() / math.sqrt(n), 0.06 if k == 1 else 0.2)


def test_a_level_that_comes_at_the_rate_alpha():
    """A telegraph behind a low-pass: variance level^2 p (1 - p) alpha/(alpha + up + down)."""
    # Whatever the steps: groups of samples 1 and 30 ms apart, independent of each other.
    level = 0.3
    slow = term('regime_switching', rate_up=UP, rate_down=DOWN, level=level, sigma_ratio=1.0,
                at_once=0.0, states=2.0)
    x = clusters(still(slow), np.array([0.0, 0.001, 0.031]), 0.5, 60_000, 3)
    truth = level ** 2 * SHARE * (1.0 - SHARE) * ALPHA / (ALPHA + UP + DOWN)
    for k in (1, 2):
        square = x[:, k] ** 2
        agrees(square.mean(), truth, square.std() / math.sqrt(x.shape[0]))
    assert abs(x[:, 2].mean()) < 4.0 * math.sqrt(truth / x.shape[0])


def test_three_states_keep_detailed_balance():
    # With q = up/down: 0 is left at 2 up, 1 at up + down, 2 at 2 down. Samples 6 relaxations of
    # the chain apart correlate by exp(-6): half a percent of a variance.
    up, down, count = 20.0, 30.0, 60_000
    three = term('regime_switching', rate_up=up, rate_down=down, level=0.5, sigma_ratio=1.0,
                 at_once=1.0, states=3.0)
    x = clusters(still(three), np.array([0.0]), 6.0 / (up + down), count, 4)[:, 0]
    # Flow into each state is flow out of it.
    flow = np.array([[-2.0 * up, down, down], [up, -up - down, down], [1.0, 1.0, 1.0]])
    law = np.linalg.solve(flow, [0.0, 0.0, 1.0])
    levels = np.unique(x)
    assert levels == pytest.approx(0.5 * (np.arange(3) - law @ np.arange(3)))
    for level, share in zip(levels, law, strict=True):
        agrees(np.mean(x == level), share, math.sqrt(share * (1.0 - share) / count))


@pytest.mark.parametrize('dt', [1e-3, 0.02, 0.06])
def test_switching_of_sigma_within_a_step(dt):
    """Variance of innovations given the state at the end of the step, in closed form."""
    # Looking back a time u from a sample in state s, the chain is in the second state with p + (s
    # - p) exp(-(up + down) u); noise of that time counts with 2 alpha exp(-2 alpha u). A level of
    # 100 V shows the state. Steps of 60 ms are 5 stays in the second state long.
    n, ratio = 200_000, 3.0
    x = supply(term('regime_switching', rate_up=UP, rate_down=DOWN, level=100.0,
                    sigma_ratio=ratio, at_once=1.0, states=2.0), u0=0.0).simulate(
        np.arange(n) * dt, np.random.default_rng(8))
    state = (x > 100.0 * (0.5 - SHARE)).astype(float)
    x = x - 100.0 * (state - SHARE)
    e = x[1:] - math.exp(-ALPHA * dt) * x[:-1]
    plain = VAR * -math.expm1(-2.0 * ALPHA * dt)
    both = 2.0 * ALPHA + UP + DOWN
    memory = 2.0 * ALPHA / both * math.expm1(-both * dt) / math.expm1(-2.0 * ALPHA * dt)
    for s in (0.0, 1.0):
        own = e[state[1:] == s] ** 2
        truth = plain * (1.0 + (ratio ** 2 - 1.0) * (SHARE + (s - SHARE) * memory))
        # Neighbouring steps share states: up to twice the variance of independent ones.
        agrees(own.mean(), truth, 1.3 * own.std() / math.sqrt(own.size), 0.1)


@pytest.mark.parametrize('wild, words', [
    (jumps(rate=1e12), 'jumps.rate of 1e'),
    (term('regime_switching', rate_up=1e12, rate_down=1e11, level=0.1, sigma_ratio=1.0,
          at_once=1.0, states=2.0),
     'regime_switching: 1.8')])
def test_more_events_than_can_be_drawn_are_refused(wild, words):
    with pytest.raises(ValueError, match=words):
        supply(wild).simulate(np.arange(1000) / 1000.0, np.random.default_rng(0))
