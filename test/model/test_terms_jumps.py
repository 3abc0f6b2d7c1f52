"""The EM algorithm of `jumps`, against the largest likelihood found otherwise, and its law."""

import numpy as np
from ou_monitor.model.terms.shocks import _mixture, Jumps
from ou_monitor.model.terms.term import View
import pytest
from scipy.optimize import minimize
from scipy.stats import kstest, norm


def jumping(seed, share=0.01, mean=-0.06, spread=0.03, unit=1.1, n=40_000):
    """Return scores of a scale of their own, some with a jump, V, and variances, V^2."""
    rng = np.random.default_rng(seed)
    var = 0.01**2 * np.exp(rng.uniform(-0.7, 0.7, n))
    jump = (rng.random(n) < share) * (mean + spread * rng.standard_normal(n))
    return unit * rng.standard_normal(n) + jump / np.sqrt(var), var


def test_the_mixture_of_jumps_is_that_of_the_largest_likelihood():
    """Climbing on from where EM ended gains nothing; the truth is within four errors."""
    # n = 40 000 with 400 jumps: mean and spread are known to spread / sqrt(400) and spread /
    # sqrt(800), widened by the noise in each (a third of the spread), the scale of the rest to 1 /
    # sqrt(2 n).
    z, var = jumping(1)
    share, mean, spread, unit = _mixture(z, var)

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
    n = z.size
    ones = np.ones(n)
    view = View(z=z, variance=var, phi=0.9 * ones, state=0.0 * ones, residual=0.0 * ones,
                at=np.arange(n) / 500.0, step=ones / 500.0, throttle=None, train=slice(0, n))
    fit = Jumps.fit_law(view)
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
    n = z.size
    ones = np.ones(n)
    view = View(z=z, variance=var, phi=0.9 * ones, state=0.0 * ones, residual=0.0 * ones,
                at=np.arange(n) / 500.0, step=ones / 500.0, throttle=None, train=slice(0, n))
    fit = Jumps.fit_law(view)
    share, mean, spread, unit = _mixture(z, var)
    middle, wide = mean / np.sqrt(var), np.sqrt(unit**2 + spread**2 / var)
    below = (1.0 - share) * norm.cdf(z, 0.0, unit) + share * norm.cdf(z, middle, wide)
    density = (1.0 - share) * norm.pdf(z, 0.0, unit) + share * norm.pdf(z, middle, wide)
    inner = (below > 1e-14) & (below < 1.0 - 1e-14)
    assert inner.mean() > 0.97
    assert norm.cdf(fit.z[inner]) == pytest.approx(below[inner], rel=1e-6)
    assert fit.gain == pytest.approx(np.log(density) - norm.logpdf(z), rel=1e-9, abs=1e-9)
