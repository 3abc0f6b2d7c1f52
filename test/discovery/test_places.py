"""The search first finds input and place of an effect: rises of throttle, white noise."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.discovery.gain import growth_of, HeldOut
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import (
    Inputs, INPUTS, LoadDependentNoise, LoadSag, LoadTransient)
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.term import View
import pytest
from scipy.signal import lfilter

RATE, N = 100.0, 5000
T = np.arange(N) / RATE
RAIL = OU(8.0, 0.1, 15.0)


def flown(seed, rate=RATE, n=N):
    """Return throttle that a pilot moves within tenths of a second."""
    rng = np.random.default_rng([seed, 77])
    held = np.repeat(rng.uniform(0.1, 0.9, n), rng.integers(20, 120, n))[:n]
    return lfilter([0.3], [1.0, -0.7], held)


def named(found):
    return [cause.name for cause in found.causes]


def scores_of(log, u):
    """Return what a law sees: white scores whose deviation has that logarithm."""
    z = np.exp(log) * np.random.default_rng(5).standard_normal(u.size)
    step = np.full(u.size, 1.0 / RATE)
    step[0] = np.inf
    return View(z / z.std(), np.ones(u.size), np.zeros(u.size), np.zeros(u.size), z, T, step, u,
                slice(0, u.size), 0.0)


@pytest.mark.parametrize('form', [
    lambda u: 1.5 * u * u, lambda u: 1.2 * np.exp(-np.square((u - 0.5) / 0.12)),
    lambda u: 12.0 * np.abs(np.diff(u, prepend=u[0])),
    lambda u: 1.5 * lfilter([1.0], [1.0, -np.exp(-1.0 / (0.5 * RATE))],
                            np.maximum(np.diff(u, prepend=u[0]), 0.0))])
def test_white_noise_may_follow_throttle_its_changes_and_its_rises(form):
    u = flown(1)
    view = scores_of(form(u), u)
    term, *_ = LoadDependentNoise.candidates(view)
    segment_noise = SupplyModel((OU(1.0, 0.0, 0.0), MeasurementNoise(1.0), term))
    drawn = np.log(np.abs(np.mean([np.square(segment_noise.simulate(
        T, np.random.default_rng(k), u)) for k in range(40)], axis=0))) / 2.0

    def gain(log):
        log = log - 0.5 * np.log(np.mean(view.z**2 * np.exp(-2.0 * log)))
        log = log - log.mean()
        scale = np.mean(view.z**2 * np.exp(-2.0 * log))
        return -float(log.sum()) - 0.5 * view.z.size * float(np.log(scale))

    found = term.log_of(Inputs(range(len(INPUTS)))(view.step, u))
    assert gain(found) > 0.9 * gain(form(u)) > 50.0
    # What is simulated has the same law.
    assert np.corrcoef(drawn, found)[0, 1] > 0.8


def test_a_law_of_noise_that_saturates_is_bent():
    """Where throttle is high and leaps, a plain sum of curves has four times the variance."""
    u = flown(1)
    keep = np.exp(-1.0 / (0.03 * RATE))
    both = 3.0 * u + 15.0 * np.abs(u - lfilter([1.0 - keep], [1.0, -keep], u))
    view = scores_of(np.minimum(both, 2.0), u)
    term, *_ = LoadDependentNoise.candidates(view)
    found = term.log_of(Inputs(range(len(INPUTS)))(view.step, u))
    error = found - np.minimum(both, 2.0)
    assert np.std(error) < 0.1
    square = view.z**2 * np.exp(-2.0 * found)
    most = np.argsort(both)[-N // 100:]
    # 50 squares: their mean has an error of 0.2.
    assert 0.6 < np.mean(square[most]) / np.mean(square) < 1.4


@pytest.mark.parametrize('count, drawn', [
    (20, lambda rng: rng.standard_normal(N)), (8, lambda rng: rng.standard_t(3.0, N))])
def test_noise_that_follows_nothing_gets_no_curve(count, drawn):
    """Normal or heavy-tailed, whose squares say less of their mean: no recording has a knot."""
    u = flown(2)
    view = scores_of(np.zeros(N), u)
    for seed in range(count):
        z = drawn(np.random.default_rng(seed))
        term, *_ = LoadDependentNoise.candidates(replace(view, z=z / z.std(), residual=z))
        assert not term.at, seed


@pytest.mark.parametrize('n', [30, 60, 400])
def test_few_samples_give_few_knots_or_none(n):
    """Of 399 samples of a robot each bin had less than twenty, and the search broke off."""
    u = flown(1)[:n]
    whole = scores_of(np.zeros(N), flown(1))
    term, *_ = LoadDependentNoise.candidates(View(
        whole.z[:n], whole.variance[:n], whole.phi[:n], whole.state[:n], whole.z[:n], T[:n],
        whole.step[:n], u, slice(0, n), 0.0))
    assert term.APART <= 1


def test_white_noise_that_grows_as_the_square_of_throttle_is_white_noise():
    """It was alpha over throttle and a second pole, whose forms were freer."""
    u = flown(3)
    rng = np.random.default_rng(3)
    v = SupplyModel((RAIL, LoadSag(0.5, 0.0))).simulate(T, rng, u)
    v = v + 0.08 * u * u * rng.standard_normal(N)
    found = discover(Recording(T, v, u, 'made'))
    assert {'load_sag', 'load_dependent_noise'} <= set(named(found))
    assert not {'load_dependent_alpha', 'second_relaxation'} & set(named(found))


def test_a_law_of_white_noise_below_the_noise_of_the_rail_is_found_whole():
    """It was found with a third of its slope, and a law of sigma or alpha made up for the rest."""
    found = []
    for seed in range(4):
        u, rng = flown(seed), np.random.default_rng(seed)
        v = SupplyModel((OU(40.0, 0.03, 15.0), LoadSag(0.5, 0.0))).simulate(T, rng, u)
        v += 0.0007 * np.exp(1.6 * u) * rng.standard_normal(N)
        causes = discover(Recording(T, v, u, 'made')).causes
        found += [cause.term for cause in causes if {one.name for one in causes} == {
            'load_sag', 'measurement_noise', 'load_dependent_noise'}
            and cause.name == 'load_dependent_noise']
    # The slopes scatter by 0.2, so their mean by 0.1; three times that.
    factors = [term.factors()['throttle'] for term in found]
    assert len(found) >= 3 and np.mean([
        np.log(y[-1]) / (x[-1] - x[0]) for x, y in factors]) == pytest.approx(1.6, abs=0.3)


def test_an_inrush_responds_to_rises_only():
    """A dip as throttle rises and none upwards as it falls is one transient, with its rise."""
    u = flown(6)
    rng = np.random.default_rng(6)
    truth = SupplyModel((OU(30.0, 0.1, 15.0), LoadSag(0.5, 0.0),
                         LoadTransient(0.0, 0.08, 0.0, -0.8)))
    found = discover(Recording(T, truth.simulate(T, rng, u), u, 'made'))
    (term,) = [cause.term for cause in found.causes if cause.name == 'load_transient']
    assert term.rise < -0.5 and abs(term.gain) < 0.25 * abs(term.rise)


def test_a_model_file_without_a_rise_is_read():
    old = {'gain': 0.1, 'tau': 0.02, 'delay': 0.0}
    assert LoadTransient.read(old).rise == 0.0
    with pytest.raises(ValueError, match="'tau'"):
        LoadTransient.read({'gain': 0.1, 'delay': 0.0})


def bursts(n=4000, rate=200.0):
    """Return a rail that a load drives for a tenth of a second, four times; else it rests."""
    rng = np.random.default_rng(2)
    u, sigma = np.full(n, 0.1 + 0.05 * rng.random()), np.full(n, 0.002)
    noise = rng.standard_normal(n)
    for at in range(n // 8, n, n // 4):
        u[at:at + 20] = 0.1 + 0.9 * np.hanning(22)[1:-1]
        sigma[at:at + 20] = 1.0
    keep, noise[0] = np.exp(-10.0 / rate), 0.0
    rail = lfilter([1.0], [1.0, -keep], sigma * np.sqrt(1.0 - keep**2) * noise)
    return Recording(np.arange(n) / rate, 12.0 + rail + 0.004 * rng.standard_normal(n), u)


def test_sigma_follows_where_the_load_shakes_the_rail():
    """To call bursts of the rail white gains nats, as most errors are small; the few double."""
    found = discover(bursts())
    (law,) = [cause.term for cause in found.causes if cause.name == 'load_dependent_noise']
    assert law.on_sigma > 0.5
    assert not found.larger and found.gain > 1.0 and found.shrink > -0.1


def held(error):
    """Return held-out errors of a model whose predictive variance is 1."""
    ones = np.ones(error.size)
    model = SimpleNamespace(gaussian=SimpleNamespace(variance=ones))
    return HeldOut(model, ones, ones.astype(bool), error)


def test_errors_grow_where_a_model_takes_a_wander_for_noise():
    """Not by chance: of right models 2.5 % have larger errors than another one, by 1.96 errors."""
    rng = np.random.default_rng(4)
    grown = []
    for share in (1.0, 0.1):
        # AR(1) of variance 1, predicted rightly, or with too little of the sample before.
        e = rng.standard_normal((400, 500))
        x = lfilter([1.0], [1.0, -0.8], e, axis=1)
        other = 0.7 * x[:, :-1]
        grown.append(np.mean([growth_of(held(a[1:] - share * 0.8 * a[:-1]), held(a[1:] - b),
                                        np.ones(499, bool)) > 1.96 for a, b in zip(x, other)]))
    assert grown[0] < 0.025 and grown[1] == 1.0
