"""Gains, their errors, and crossings, against known truth."""

import math
from types import SimpleNamespace

import numpy as np
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import gain as gains
from ou_monitor.discovery.fitting import standard_errors
from ou_monitor.discovery.gain import (
    BLOCKS, blocks_of, cause_gain, covered, gain_of, held_out, HeldOut,
    mean_difference, mean_score, without)
from ou_monitor.model.ou import simulate
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import Drift, FlickerNoise
import pytest
from scipy.signal import lfilter
from scipy.stats import chi2, norm

ALPHA, SIGMA = 63.0, 0.3156


def simulated(seed, n=4000, sag=0.0):
    """Return samples of an OU with a sag, at 1 kHz, throttle of 50 ms steps."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / 1000.0
    u = np.repeat(rng.random(n // 50 + 1), 50)[:n]
    return Samples(t, simulate(t, ALPHA, SIGMA, rng, u0=5.0 - sag * u), u)


@pytest.mark.parametrize('keep', [0.0, 0.97])
def test_the_error_of_a_mean_includes_correlation(keep):
    """Over 300 series the stated error is the true scatter within a quarter."""
    # The scatter itself is known to 1/sqrt(600) = 4 %; correlation over 33 of 166 samples a block
    # is left out by 17 % at most, of which a lag mends a part. With `keep` 0.97 an error that
    # ignores correlation is 8 times too small.
    rng = np.random.default_rng(3)
    stated, means = [], []
    for _ in range(300):
        d = lfilter([1.0], [1.0, -keep], rng.standard_normal(4000))
        mean, error = mean_difference(d + 1.0, np.ones(d.size))
        means.append(mean)
        stated.append(error)
    assert np.mean(stated) == pytest.approx(np.std(means), rel=0.25)
    assert abs(np.mean(means)) < 4.0 * np.std(means) / math.sqrt(300)


def test_too_few_samples_have_no_gain():
    """Fewer than blocks: unknown; as many as blocks: known."""
    mean, error = mean_difference(np.ones(BLOCKS - 1), np.zeros(BLOCKS - 1))
    assert math.isnan(mean) and math.isnan(error)
    mean, error = mean_difference(np.ones(BLOCKS), np.zeros(BLOCKS))
    assert mean == 1.0 and error == 0.0
    scored = np.arange(40) < BLOCKS
    assert mean_score(np.where(scored, 2.0, 9.0), scored) == 2.0
    assert math.isnan(mean_score(np.ones(40), np.arange(40) < BLOCKS - 1))


def test_a_cause_that_is_not_there_gains_nothing():
    """Throttle without sag: within 3.5 errors of 0, p not small, in 20 recordings."""
    chances = []
    for seed in range(20):
        samples = simulated(seed)
        full = fit_composite(samples, [OU(50.0, 0.3, 5.0), LoadSag(0.0, 0.0)],
                             slice(0, samples.n))
        gain, error, chance = cause_gain(
            held_out(samples, full), held_out(samples, without(samples, full, 1)),
            covered(samples))
        assert abs(gain) < 3.5 * error + 2.0 / samples.n
        chances.append(chance)
    # The smallest of 20 is below 1e-3 with chance 2 %; doubling makes it rarer.
    assert min(chances) > 1e-4 and np.median(chances) > 0.1


def test_a_block_whose_rest_gives_no_model_is_not_scored(monkeypatch):
    """The step to the other blocks may end at a covariance that is singular."""
    samples = simulated(3)
    model = fit_composite(samples, [OU(50.0, 0.3, 5.0)], slice(0, samples.n))
    whole = held_out(samples, model)
    calls = []

    def fails_for_one(*given, **more):
        calls.append(None)
        # One of the model, then one a block; a step that fails is halved.
        if 0 <= len(calls) - (1 + 3) <= gains._HALVINGS:
            raise ValueError('singular')
        return evaluate(*given, **more)

    monkeypatch.setattr(gains, 'evaluate', fails_for_one)
    part = held_out(samples, model)
    third = blocks_of(samples.n)[2]
    assert not part.known[third].any()
    kept = np.delete(np.arange(samples.n), np.arange(samples.n)[third])
    assert part.known[kept].all() and (part.density[kept] == whole.density[kept]).all()


def test_errors_of_the_mean_are_its_scatter():
    """Sag and level over 40 recordings: scatter known to 11 %, tolerance three times that."""
    found, stated = [], []
    for seed in range(40):
        samples = simulated(seed, 2000, 0.4)
        model = fit_composite(samples, [OU(63.0, 0.3, 5.0), LoadSag(0.4, 0.01)],
                              slice(0, samples.n))
        se = standard_errors(samples, model)
        found.append([model.terms[0].u0, model.terms[1].linear, model.terms[1].square])
        stated.append([se[0]['u0'], se[1]['linear'], se[1]['square']])
        assert {'alpha', 'sigma'} <= set(se[0])
    scatter = np.std(found, axis=0, ddof=1)
    assert np.mean(stated, axis=0) == pytest.approx(scatter, rel=0.34)


@pytest.mark.parametrize('gain, error, known', [
    (0.00072, 0.797, False), (-1e-4, 50.0, False), (0.00072, 0.05, True), (4.0, 4.0, True),
    (0.1, 0.02, True)])
def test_a_gain_with_a_huge_error_is_unknown(gain, error, known):
    """Ten times as large as the gain, and large beside any; small ones are just none."""
    swing = error * math.sqrt(BLOCKS - 1.0) * (-1.0) ** np.arange(BLOCKS)
    found = gain_of(held(gain + swing), held(0.0 * swing), np.ones(BLOCKS, bool))
    assert found == pytest.approx((gain, error) if known else (math.nan, math.nan), nan_ok=True)


def held(density, free=2, search=0.0, known=None):
    """Return a model that was scored, as far as a gain looks at it."""
    n = density.size
    return HeldOut(SimpleNamespace(density=density, free=free, search=search), density,
                   np.ones(n, bool) if known is None else known, np.zeros(n))


@pytest.mark.parametrize('gain', (0.02, 0.0, -0.02))
@pytest.mark.parametrize('search', (0.0, 2.0))
def test_the_chance_of_a_cause_is_twice_the_smaller_of_two(gain, search):
    """Of the likelihood ratio, a chi-square, with the price of the search; of the gain kept."""
    rng = np.random.default_rng(1)
    n = 2400
    old = rng.standard_normal(n)
    new = old + gain + 0.2 * rng.standard_normal(n)
    scored = np.arange(n) >= 1200
    found, error, chance = cause_gain(held(new, 4, search), held(old, 2), scored)
    mean, se = mean_difference(new[1200:], old[1200:])
    assert (found, error) == (mean, se)
    fitted = min(1.0, chi2.sf(max(0.0, 2.0 * (new - old).sum()), 2) * math.exp(search))
    assert chance == pytest.approx(min(1.0, 2.0 * min(fitted, norm.sf(mean / se))), rel=1e-9)


def test_a_cause_loses_no_more_than_without_further_states(monkeypatch):
    """With many states only a part is fitted, which may hardly show what is left out."""
    def fitted(samples, terms, known):
        names = tuple(term.NAME for term in terms)
        return SimpleNamespace(names=names, density=np.full(
            4, -3.0 if 'flicker_noise' in names else 1.0))

    monkeypatch.setattr(gains, '_fitted', fitted)
    model = SimpleNamespace(terms=(
        OU(8.0, 0.04, 12.0), LoadSag(0.5, 0.0), Drift(-1e-3, 0.0), FlickerNoise(1e-3, 0.1, 45.0)))
    for plain in (-4.0, 0.0):
        less = without(simulated(0, 100), model, 2, plain=SimpleNamespace(
            density=np.full(4, plain)))
        assert less.names == ('ou', 'load_sag')
