"""Fits of terms: starts, laws of the innovations, standard errors."""

from dataclasses import replace
from itertools import combinations
import math

import numpy as np
from ou_monitor.model.hidden_chain import forward, log_likelihood
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.load_response import LoadDependentSigma
from ou_monitor.model.terms.regime_switching import (
    chain_of, rates_between, relaxing, Scores, stationary_law, step_chances, SwitchingLevels)
from ou_monitor.model.terms.shocks import _best_runs, _grid, _log_likelihood, _mixture, Jumps
from ou_monitor.model.terms.term import curvature_se, normal_scores, refine, View
from ou_monitor.model.terms.tones import order_power
import pytest
from scipy.linalg import dft
from scipy.optimize import minimize
from scipy.signal import lfilter
from scipy.special import ndtr
from scipy.stats import kstest, median_abs_deviation, norm


def view_of(n, rate, decay=63.0):
    """Return even samples of residuals whose standard deviation is 0.2 V."""
    flat = np.ones(n)
    residual = 0.2 * np.where(np.arange(n) % 2, 1.0, -1.0)
    return View(z=flat, variance=flat, phi=np.full(n, math.exp(-decay / rate)), state=flat,
                residual=residual, at=np.arange(n) / rate, step=flat / rate, throttle=None,
                train=slice(0, n))


@pytest.mark.parametrize('rate, lengths', [(200.0, (64, 32)), (1500.0, (512, 64))])
def test_power_along_throttle_is_that_of_every_line(rate, lengths):
    """
    Power of white noise along each line frequency = idle + slope throttle, by plain transforms.

    A line of n segments has a mean of n exponentials for its power; the chance of a mean m
    is bounded by exp(-n (m - 1 - ln m)) (Cramer).  Two in a hundred lines count as
    independent, two bins a sample.
    """
    rng = np.random.default_rng(4)
    n = 40 * lengths[0]
    z, u = rng.standard_normal(n), np.repeat(rng.random(n // 16), 16)
    top, trials, largest = 0.0, 0.0, 0.0
    for length in lengths:
        count, width = n // length, rate / (2.0 * length)
        pieces = z.reshape(count, length) * np.hanning(length)
        power = np.abs(pieces @ dft(2 * length)[:length]) ** 2
        power /= power.mean(axis=0)
        load = u.reshape(count, length).mean(axis=1)
        slopes = np.arange(-rate, rate, 2.0 * width / np.ptp(load))
        for slope in slopes:
            shift = np.rint(slope * load / width).astype(int)
            places = (np.arange(length) + shift[:, None]) % (2 * length)
            mean = float(np.take_along_axis(power, places, 1).mean(axis=0).max())
            top = max(top, count * (mean - 1.0 - math.log(mean)))
            largest = max(largest, mean)
        trials += 0.02 * 2.0 * length * slopes.size
    # So that a mean below 2 counts as well.
    assert 1.0 < largest
    found = order_power(z, u, rate)
    assert found == pytest.approx((top, trials), rel=1e-4)


def test_the_view_of_a_faster_rail_has_its_residuals():
    """Residuals less phi^2 times the state before, over what noise of that phi makes of a step."""
    rng = np.random.default_rng(9)
    phi = np.tile([0.9, 0.8, 0.9], 400)
    state, z, variance = rng.standard_normal(1200), rng.standard_normal(1200), np.tile(
        [0.3, 0.4, 0.3], 400)
    view = replace(view_of(1200, 100.0), phi=phi, state=state, z=z, variance=variance)
    assert relaxing(view, 1.0) is view
    found = relaxing(view, 2.0)
    error = z * np.sqrt(variance) + phi * state - phi ** 2 * state
    middle = np.median(error)
    # The usual step is that of phi 0.9; the middle half of a normal reaches to 0.6745.
    std = median_abs_deviation(error) / 0.6745
    expected = std ** 2 * (1.0 - phi ** 4) / (1.0 - 0.9 ** 4)
    assert found.phi == pytest.approx(phi ** 2, rel=1e-12)
    assert found.variance == pytest.approx(expected, rel=1e-4)
    assert found.z == pytest.approx((error - middle) / np.sqrt(expected), rel=1e-4, abs=1e-9)


def flown(levels=0.0, seed=1, n=20_000):
    """Return the view of an OU whose sigma grows by e^1.5 with throttle, levels (V) on it."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 1000), 1000)
    std = 0.02 * np.exp(1.5 * u)
    keep = math.exp(-0.06)
    x = first_order(np.full(n, keep), std * math.sqrt(1.0 - keep**2) * rng.standard_normal(n), 0.0)
    residual = x - levels * (np.cumsum(rng.random(n) < 0.001) % 2)
    residual -= residual.mean()
    before = np.concatenate(([0.0], residual[:-1]))
    variance = std**2 * (1.0 - keep**2)
    return View(z=(residual - keep * before) / np.sqrt(variance), variance=variance,
                phi=np.full(n, keep), state=before, residual=residual, at=0.001 * np.arange(n),
                step=np.full(n, 0.001), throttle=u, train=slice(0, n))


def test_levels_are_found_beside_noise_that_follows_throttle():
    """Levels of three deviations of the calm rail are seen, and about as high as they are."""
    fit = SwitchingLevels.fit_law(flown(levels=0.1))
    assert abs(fit.term.level) == pytest.approx(0.1, rel=0.15)
    assert fit.term.sigma_ratio == pytest.approx(1.0, abs=0.15)
    assert float(fit.gain.sum()) > 100.0


def test_a_line_of_sigma_is_level_nowhere():
    """Its ends are those of throttle throughout, also of the part that is not fitted."""
    view = flown()
    view = replace(view, z=view.z * np.exp(1.5 * view.throttle), train=slice(1, 12_000),
                   throttle=np.concatenate(([1.5], view.throttle[1:-1], [-0.5])))
    line = min(LoadDependentSigma.candidates(view), key=lambda term: len(term.throttle))
    assert line.throttle == (-0.5, 1.5)
    assert (line.log_factor[1] - line.log_factor[0]) / 2.0 == pytest.approx(1.5, abs=0.1)


def test_standard_errors_are_those_of_a_parabola():
    """A log-likelihood of 3 - sum (x/s)^2/2 has the errors s; one that is not curved has none."""
    s = np.array([0.02, 1.0, 7.0])
    at = np.array([0.3, -2.0, 0.0])

    def value(x):
        return 3.0 - 0.5 * float((((x - at) / s) ** 2).sum())

    assert curvature_se(value, at) == pytest.approx(s, rel=1e-6)
    # The second difference of a parabola is exact whatever the step, and off the top too.
    assert curvature_se(value, at + 1.0, step=0.5) == pytest.approx(s, rel=1e-6)
    # The step of a cosine: (2 cos(h) - 2)/h^2.
    assert curvature_se(lambda x: math.cos(x[0]), np.zeros(1)) == pytest.approx(
        [0.05 / math.sqrt(2.0 - 2.0 * math.cos(0.05))], rel=1e-9)
    for flat in (lambda x: 4.0, lambda x: x[0], lambda x: x[0] ** 2):
        assert math.isnan(curvature_se(flat, np.zeros(1))[0])


@pytest.mark.parametrize('seed', range(20))
def test_best_runs_are_the_best_of_all_choices(seed):
    """Seven runs, all 128 choices of them: the largest sum of gains of runs that are apart."""
    rng = np.random.default_rng(seed)
    begin = rng.integers(0, 20, 7)
    end, gain = begin + rng.integers(1, 6, 7), rng.random(7)

    def apart(some):
        return all(end[i] < begin[j] or end[j] < begin[i] for i, j in combinations(some, 2))

    choices = [some for k in range(8) for some in combinations(range(7), k) if apart(some)]
    best = max(choices, key=lambda some: sum(gain[k] for k in some))
    expected = np.zeros(30, dtype=bool)
    for k in best:
        expected[begin[k]:end[k]] = True
    assert _best_runs(begin, end, gain, 30).tolist() == expected.tolist()


@pytest.mark.parametrize('count', [1, 40, 41])
def test_volatility_from_both_ends_is_as_likely_as_from_the_beginning(count):
    """The densities of the filter, summed; points that share a rate or the levels, or neither."""
    rng = np.random.default_rng(count)
    squares = np.exp(rng.standard_normal(count)) * rng.chisquare(4, count)
    sizes = np.full(count, 4.0)
    points = np.array([[-1.0, 0.0, 0.0], [-1.0, 1.0, 0.0], [0.2, 1.0, 0.3], [0.2, 0.0, 0.3]])
    alone = [_grid(squares, sizes, 0.1, x)[1].sum() for x in points]
    assert _log_likelihood(squares, sizes, 0.1, points) == pytest.approx(alone, abs=1e-9)


@pytest.mark.parametrize('start', [(0.0, 0.0), (0.9, -1.6), (0.4, -1.0)])
def test_newton_finds_the_top_that_is_near(start):
    bend = np.array([[40.0, 12.0], [12.0, 9.0]])
    top = np.array([0.4, -1.0])

    def values(x):
        return 5.0 - 0.5 * np.einsum('ki,ij,kj->k', x - top, bend, x - top)

    at, most, errors = refine(values, start)
    assert 5.0 - most < 0.05 and most == pytest.approx(float(values(at[None])[0]))
    assert errors == pytest.approx(np.sqrt(np.diag(np.linalg.inv(bend))), rel=1e-6)
    assert curvature_se(lambda x: float(values(x[None])[0]), top) == pytest.approx(errors)


def test_newton_gives_up_where_nothing_is_curved():
    """Nor where there is no number; its steps are half a unit at most."""
    assert refine(lambda x: x[:, 0], [0.0]) is None
    assert refine(lambda x: x[:, 0] ** 2, [1.0]) is None
    assert refine(lambda x: np.full(len(x), math.inf), [0.0]) is None
    assert refine(lambda x: -(x[:, 0] - 1.4) ** 2, [0.0])[0] == pytest.approx([1.4], abs=0.25)


def test_scores_of_certain_probabilities_are_finite():
    """Some eight deviations on either side; the middle is 0."""
    low, middle, high = normal_scores(np.array([0.0, 0.5, 1.0]))
    assert -8.3 < low < -7.9 and middle == 0.0 and 7.9 < high < 8.3


def jumping(seed, share=0.01, mean=-0.06, spread=0.03, unit=1.1, n=40_000):
    """Return scores of a scale of their own, some with a jump, V, and variances, V^2."""
    rng = np.random.default_rng(seed)
    var = 0.01**2 * np.exp(rng.uniform(-0.7, 0.7, n))
    jump = (rng.random(n) < share) * (mean + spread * rng.standard_normal(n))
    return unit * rng.standard_normal(n) + jump / np.sqrt(var), var


def view_of_jumps(z, var):
    n, ones = z.size, np.ones(z.size)
    return View(z=z, variance=var, phi=0.9 * ones, state=0.0 * ones, residual=0.0 * ones,
                at=np.arange(n) / 500.0, step=ones / 500.0, throttle=None, train=slice(0, n))


def test_the_mixture_of_jumps_is_that_of_the_largest_likelihood():
    """Climbing on from where EM ended gains nothing; the truth is within four errors."""
    # n = 40 000 with 400 jumps: mean and spread are known to spread / sqrt(400) and spread /
    # sqrt(800), widened by the noise in each (a third of the spread), the scale of the rest to 1 /
    # sqrt(2 n).
    z, var = jumping(1)
    share, mean, spread, unit = _mixture(z, var, centred=False)

    def loss(x):
        size, scale = np.exp(x[2]), np.exp(x[3])
        chance = 1.0 / (1.0 + np.exp(-x[0]))
        calm = np.log1p(-chance) + norm.logpdf(z, 0.0, scale)
        jumped = np.log(chance) + norm.logpdf(
            z, x[1] / np.sqrt(var), np.sqrt(scale**2 + size**2 / var))
        return -float(np.logaddexp(calm, jumped).sum())

    at = np.array([np.log(share / (1.0 - share)), mean, np.log(spread), np.log(unit)])
    best = minimize(loss, at, method='Nelder-Mead', options={
        'xatol': 1e-6, 'fatol': 1e-4, 'initial_simplex': np.vstack([at, at + np.diag(
            [0.05, 0.003, 0.05, 0.005])])})
    # A step of one error in one parameter costs half a nat.
    assert loss(at) - best.fun < 0.02
    assert abs(share - 0.01) < 4.0 * 0.01 / np.sqrt(400)
    assert abs(mean + 0.06) < 4.0 * 1.1 * 0.03 / np.sqrt(400)
    assert abs(spread - 0.03) < 4.0 * 1.3 * 0.03 / np.sqrt(800)
    assert abs(unit - 1.1) < 4.0 * 1.1 / np.sqrt(2 * 40_000)


def test_the_law_of_jumps_scores_and_errors():
    """Scores are N(0, 1) under the law; events are the jumps, of their mean square."""
    z, var = jumping(2)
    fit = Jumps.fit_law(view_of_jumps(z, var))
    assert kstest(fit.z, 'norm').pvalue > 1e-3
    assert fit.term.rate == pytest.approx(0.01 * 500.0, rel=0.2)
    pushed = fit.push[fit.push > 0.0]
    assert pushed == pytest.approx(fit.term.mean**2 + fit.term.std**2)
    # Where a jump is likelier than none, by the true parameters.
    likelier = (np.log(0.01) + norm.logpdf(z, -0.06 / np.sqrt(var), np.sqrt(1.21 + 9e-4 / var))
                > np.log(0.99) + norm.logpdf(z, 0.0, 1.1))
    assert pushed.size == pytest.approx(likelier.sum(), rel=0.05)
    assert (likelier == (fit.push > 0.0)).mean() > 0.999
    assert fit.se['rate'] == pytest.approx(fit.term.rate / np.sqrt(400), rel=0.1)
    assert fit.se['mean'] == pytest.approx(fit.term.std / np.sqrt(400), rel=0.1)
    assert fit.se['std'] == pytest.approx(fit.term.std / np.sqrt(800), rel=0.1)


def test_scores_and_densities_are_those_of_the_mixture():
    """Normal scores of its distribution function, and its density over that of N(0, 1)."""
    z, var = jumping(3, share=0.03, n=4000)
    fit = Jumps.fit_law(view_of_jumps(z, var))
    share, mean, spread, unit = _mixture(z, var, centred=False)
    middle, wide = mean / np.sqrt(var), np.sqrt(unit**2 + spread**2 / var)
    below = (1.0 - share) * norm.cdf(z, 0.0, unit) + share * norm.cdf(z, middle, wide)
    density = (1.0 - share) * norm.pdf(z, 0.0, unit) + share * norm.pdf(z, middle, wide)
    inner = (below > 1e-14) & (below < 1.0 - 1e-14)
    assert inner.mean() > 0.97
    assert norm.cdf(fit.z[inner]) == pytest.approx(below[inner], rel=1e-6)
    assert fit.gain == pytest.approx(np.log(density) - norm.logpdf(z), rel=1e-9, abs=1e-9)


N, RATE, KEEP, DRIVE, WHITE = 4000, 100.0, 0.98, 0.02, 0.1
UP, DOWN = 1.5, 2.5


def filtered(voltage, drive):
    """Return what the settled filter of an OU in white noise leaves over."""
    b = WHITE ** 2 * (1.0 - KEEP ** 2) - drive ** 2
    ahead = 0.5 * (-b + math.sqrt(b * b + 4.0 * (drive * WHITE) ** 2))
    variance = ahead + WHITE ** 2
    trust = ahead / variance
    guess = lfilter([0.0, KEEP * trust], [1.0, -KEEP * (1.0 - trust)], voltage)
    ones = np.ones(N)
    return View(z=(voltage - guess) / math.sqrt(variance), variance=variance * ones,
                phi=KEEP * ones, state=np.concatenate(([0.0], voltage[:-1])), residual=voltage,
                at=np.arange(N) / RATE, step=ones / RATE, throttle=None, train=slice(0, N),
                trust=trust * ones)


def drawn(height, at_once, seed):
    """Return a rail in white noise with levels on it, and the levels, less their mean."""
    rng = np.random.default_rng(seed)
    state, states = 0, []
    for u in rng.random(N):
        state = int(u > DOWN / RATE) if state else int(u < UP / RATE)
        states.append(state)
    levels = height * (np.array(states) - UP / (UP + DOWN))
    drive = DRIVE * rng.standard_normal(N)
    if not at_once:
        drive += (1.0 - KEEP) * np.concatenate(([0.0], levels[:-1]))
    rail = lfilter([1.0], [1.0, -KEEP], drive)
    return rail + at_once * levels + WHITE * rng.standard_normal(N), levels


@pytest.mark.parametrize('height, at_once', [(0.4, 1.0), (1.0, 0.0)])
def test_scores_of_the_true_levels_are_standard_normal(height, at_once):
    """Variance within 4 errors, sqrt(2/n); no correlation of neighbours, 1/sqrt(n)."""
    voltage, _ = drawn(height, at_once, 3)
    view = filtered(voltage, DRIVE)
    x = np.array([math.log(UP), math.log(DOWN), height / math.sqrt(view.variance[0]), 0.0, 0.0])
    scores = Scores.of(view).following(x, at_once)
    chain, mean, std = chain_of(scores, x, at_once)
    before, density = forward(*chain)
    chance = sum(before[:, i] * chain[1][i, j] * ndtr((view.z - mean[i, j]) / std[j])
                 for i, j in np.ndindex(2, 2))
    z = normal_scores(chance)
    if at_once:
        assert abs(np.mean(z ** 2) - 1.0) < 4.0 * math.sqrt(2.0 / N)
        assert abs(np.mean(z[1:] * z[:-1])) < 4.0 / math.sqrt(N)
    # As if the filter followed at once, the levels are hardly seen.
    blind = log_likelihood(*chain_of(scores.at_once, x, at_once)[0])
    assert float(density.sum()) > blind + (300.0 if at_once else 80.0)


@pytest.mark.parametrize('at_once', [0.0, 1.0])
def test_the_followed_level_is_that_of_the_recursion(at_once):
    """The recursion, sample by sample and pair by pair."""
    view = filtered(drawn(0.4, at_once, 6)[0], DRIVE)
    x = np.array([math.log(UP), math.log(DOWN), 4.0, 0.2, 0.0])
    scores = Scores.of(view)
    chances, law = step_chances(x, scores.step, 2), stationary_law(rates_between(UP, DOWN, 2))
    middle, std = law[1], np.exp(0.2 * np.arange(2))
    before, followed, moved, wanted = law.copy(), 0.0, 0.0, []
    for k in range(N):
        keep, draw = view.phi[k] * np.array([1.0 - scores.trust[k], scores.trust[k]])
        behind = keep * (followed if at_once else followed - moved)
        wanted.append(behind)
        known, after = before[1] - middle, np.zeros(2)
        for i, j in np.ndindex(2, 2):
            mean = ((j - middle) - draw * (i - middle) if at_once
                    else (1.0 - view.phi[k]) * (i - middle)) - behind
            off = (view.z[k] - x[2] * scores.unit[k] * mean) / std[j]
            after[j] += before[i] * chances[i, j] / std[j] * math.exp(-0.5 * off * off)
        before = after / after.sum()
        followed = keep * followed + draw * (known if at_once else moved)
        moved = view.phi[k] * moved + (1.0 - view.phi[k]) * known
    found = scores.following(x, at_once).followed
    assert np.ptp(found) > 0.05
    # The fixed point is accurate to a millionth of an innovation.
    np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-6)


def test_without_white_noise_nothing_is_behind():
    view = filtered(drawn(0.4, 1.0, 4)[0], 1e3 * WHITE)
    x = np.array([0.0, 0.0, 4.0, 0.0, 0.0])
    assert not Scores.of(view).following(x, 1.0).followed.any()
