"""The Monte Carlo rows: right within their own errors, and able to detect a missing 2."""

import math

import numpy as np
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.paper import crest, published, switching
from ou_monitor.paper.published import RowVerdict
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

PATHS = 4000


@pytest.fixture(scope='module')
def formulas():
    """Give the rows of section 3.3."""
    return {row.quantity: row for row in switching.rows(np.random.default_rng(11), PATHS)}


@pytest.fixture(scope='module')
def crests():
    """Return simulated crest factors; 600 segments."""
    return crest.simulate_crests(np.random.default_rng(12), 600)


def long_run_rate(q, c):
    """Return the long-run variance rate by integrating the autocovariance."""
    # 2 integral_0^inf sum pi c exp(Qt) c dt with the equation p' = p Q solved numerically; no
    # potential, no formula (6).
    values, vectors = np.linalg.eig(q.T)
    pi = np.real(vectors[:, np.argmin(np.abs(values))])
    pi /= pi.sum()
    c = c - pi @ c

    def change(t, state):
        return np.concatenate([state[:-1] @ q, [state[:-1] @ c]])

    start = np.concatenate([pi * c, [0.0]])
    end = 60.0 / np.abs(np.diag(q)).min()
    return 2.0 * solve_ivp(change, (0.0, end), start, rtol=1e-10, atol=1e-16).y[-1, -1]


@pytest.mark.parametrize('name, system', [
    ('telegraph', switching.telegraph()), ('three states', switching.three_states())])
def test_intensity_is_twice_the_printed_one(formulas, name, system):
    """Within 4 standard errors of an evaluation without potentials; the printed one refused."""
    # 4000 paths give an error of 2.5 %: the missing factor is 20 standard errors away.
    row = formulas[f'B of (6), {name}']
    exact = 1e6 * long_run_rate(np.array(system.generator.q), system.offsets[:, 0])
    assert row.printed.value == pytest.approx(0.5 * exact, rel=1e-3)
    assert abs(row.recomputed - exact) < 4.0 * row.error
    assert row.error < 0.04 * exact
    assert row.verdict is RowVerdict.DOES_NOT_HOLD


def test_drift_lacks_no_factor(formulas):
    """
    Growth of the mean against the eigenvalue of its own equation; half or twice it is refused.

    E U obeys a linear equation with the rate sqrt(q^2 + c^2) - q.
    """
    row = formulas['b/U of (5), multiplicative noise']
    exact = math.sqrt(1000.0 ** 2 + 100.0 ** 2) - 1000.0
    assert row.printed.value == pytest.approx(100.0 ** 2 / 2000.0)
    assert abs(row.recomputed - exact) < 4.0 * row.error
    assert row.verdict is RowVerdict.AGREES
    assert 0.5 * exact > 8.0 * row.error, 'a factor of 2 would be seen'


def test_logarithm_does_not_grow(formulas):
    """Zero within 4 standard errors, where the printed formulas say 2.5 1/s."""
    row = formulas['growth of ln U by (4) to (6)']
    assert row.printed.value == pytest.approx(2.5)
    assert abs(row.recomputed) < 4.0 * row.error < 1.0
    assert row.verdict is RowVerdict.DOES_NOT_HOLD


def test_the_potential_of_a_telegraph_agrees(formulas):
    row = formulas['R0(0, 0) of a telegraph']
    assert row.recomputed == pytest.approx(0.25) and row.verdict is RowVerdict.AGREES


def test_spreading_follows_the_closed_form():
    """Var = c^2/q (t - (1 - exp(-2 q t)) / (2 q)), at every time within 4.5 standard errors."""
    found = switching.spreading(np.random.default_rng(13), PATHS)
    exact = 1e-3 * (found.t + np.expm1(-2000.0 * found.t) / 2000.0)
    assert (np.abs(found.variance - exact)[1:] < 4.5 * found.error[1:]).all()
    assert (found.correct, found.printed) == pytest.approx((1e-3, 5e-4))


def test_crest_factors_are_those_of_1_mhz(crests):
    """Against paths drawn sample by sample at 1 MHz, without bridges: mean and 95 % quantile."""
    # 10000 screens of 10 ms: the mean to 0.007. What 1 MHz leaves unseen is 0.04 there, ten times
    # as much is what lies between the points of the simulation.
    rng, phi = np.random.default_rng(14), math.exp(-63e-6)
    direct = []
    for _ in range(100):
        noise = math.sqrt(1.0 - phi * phi) * rng.standard_normal((100, 10_000))
        noise[:, 0] = rng.standard_normal(100)
        u = lfilter([1.0], [1.0, -phi], noise, axis=1)
        direct.append(np.ptp(u, axis=1) / u.std(axis=1))
    direct = np.concatenate(direct)
    mean, error = crests.mean(10)
    error = math.hypot(error, direct.std() / math.sqrt(direct.size))
    assert abs(mean - direct.mean()) < 4.0 * error < 0.03
    # A quantile scatters by sqrt(p (1 - p) / n) / density; the density there is above 0.15.
    limit = 4.0 * math.sqrt(0.05 * 0.95 / 10_000) / 0.15
    assert abs(crests.quantile(10, 0.95) - np.quantile(direct, 0.95)) < limit


def test_verdicts_on_the_crest_factors(crests):
    """40 % agrees, 5 % only within its rounding; 10 % by what the screens say, either way."""
    low, medium, high = crest.rows(crests)
    assert (low.verdict, high.verdict) == (RowVerdict.ROUNDING, RowVerdict.AGREES)
    # (225 - 3.1) / (28.1 + 4.7), the least that the readings allow.
    least = (225.0 - 3.125) / (28.1 + 4.69)
    assert medium.printed_inputs[0] == pytest.approx(least, rel=1e-3)
    inside = crests.quantile(500, 0.95) >= medium.printed_inputs[0]
    assert medium.verdict is (RowVerdict.ROUNDING if inside else RowVerdict.DOES_NOT_HOLD)


def test_screen_that_a_crest_factor_takes():
    """Half of the screens of that length pass 5 deviations; the law is that of rare passages."""
    mean = mean_first_passage(0.0, 5.0) / 63.0
    # To the first order, 1/d^2.
    assert crest.screen_for(10.0) == pytest.approx(math.log(2.0) * mean, rel=0.05)


def test_jumps_have_the_kurtosis_said():
    """Moments of the simulated process against 3 alpha share^2 / rate."""
    # Drawn here in closed form: each of the jumps of the last 12 tau, relaxed.
    rng, alpha, rate, share = np.random.default_rng(16), 63.0, 20.0, 0.75
    draws, span = 200_000, 12.0 / alpha
    count = rng.poisson(rate * span, draws)
    owner = np.repeat(np.arange(draws), count)
    size = math.sqrt(2.0 * alpha * share / rate) * rng.standard_normal(owner.size)
    x = np.bincount(owner, size * np.exp(-alpha * span * rng.random(owner.size)), draws)
    x += math.sqrt(1.0 - share) * rng.standard_normal(draws)
    assert x.var() == pytest.approx(1.0, rel=0.03)
    kurtosis = np.mean(x ** 4) / x.var() ** 2 - 3.0
    assert kurtosis == pytest.approx(crest.excess_kurtosis(rate, share), rel=0.15)


def test_jumps_raise_the_crest_factor_of_long_screens(crests):
    """Beyond the OU on 500 ms; rows name what was best, and size gives back the variance."""
    found = crest.simulate_jumps(np.random.default_rng(17), 20.0)
    best = crest.largest(found, 500)
    assert best.mean == max(c.mean for c in found if c.screen == 500)
    assert best.mean - crests.mean(500)[0] > 5.0 * best.error
    share = best.size(1.0) ** 2 * best.rate / (2.0 * published.ALPHA.value)
    assert share == pytest.approx(best.share)
    rows = crest.jump_rows(found, crests)
    assert len(rows) == 5
    assert rows[0].recomputed == pytest.approx((287.5 / 56.3) / (81.3 / 9.38))
    assert crest.impulse_height(published.LOW, crests) == pytest.approx(
        81.3 - 9.38 * crests.mean(100)[0])
