"""Fits of many states and of laws, and starts of slow states from the spectrum."""

import math

import numpy as np
from ou_monitor.criticism import structure
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import from_spectrum, standard_errors
from ou_monitor.discovery.gain import guess
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.regime_switching import RegimeSwitching
from ou_monitor.model.terms.shocks import Volatility
from ou_monitor.model.terms.slow import FlickerNoise, SecondRelaxation
from ou_monitor.model.whittle import Ordinates
import pytest
from scipy.signal import lfilter


def test_parameters_that_fit_a_part_but_not_all_samples_are_rejected(monkeypatch):
    """Where there are too many states for more rounds a fit is no worse than its start."""
    rng = np.random.default_rng(4)
    t = np.arange(8000) / 100.0
    # The part looked at is the liveliest.
    v = 5.0 + 0.02 * rng.standard_normal(t.size) * np.where(t < 30.0, 3.0, 1.0)
    samples = Samples(t, v + 0.005 * np.cumsum(rng.standard_normal(t.size)), None)
    best = fit_composite(samples, (OU(5.0, 0.1, 5.0), MeasurementNoise(0.02)), slice(0, t.size))
    monkeypatch.setattr(structure, '_EXPENSIVE', -1)
    monkeypatch.setattr(structure, '_MANY', 0)
    again = fit_composite(samples, best.terms, slice(0, t.size), best)
    assert again.density.sum() >= best.density.sum() - 1e-6
    assert again.gaussian.se[1]['std'] > 0.0


def test_a_rough_fit_of_many_states_has_no_errors_and_says_so_of_each_term():
    """One dict a term, empty or not: those of laws come after them."""
    t = np.arange(400) / 100.0
    terms = (OU(5.0, 0.1, 12.0), FlickerNoise(0.01, 0.5, 20.0))
    samples = Samples(t, SupplyModel(terms).simulate(t, np.random.default_rng(3)), None)
    fit = fit_composite(samples, terms, slice(0, samples.n), rough=True, begun=True)
    assert fit.se == ({}, {})
    found = standard_errors(samples, fit, slice(0, samples.n))
    assert len(found) == 2 and found[0]['u0'] > 0.0


RATE, N = 200.0, 6000
T = np.arange(N) / RATE
RAIL = OU(20.0, 0.3, 5.0)


@pytest.mark.parametrize('law', [
    RegimeSwitching(1.5, 1.0, 0.0, 3.0, 1.0, 2.0), Volatility(0.8, 3.0)])
def test_simulations_of_the_fit_spread_as_far_as_the_data(law):
    # In 30 s the share of each state is known to a fifth, the mean of ln sigma to 0.8 sqrt(2/90).
    voltage = SupplyModel((RAIL, law)).simulate(T, np.random.default_rng(2), None)
    samples, whole = Samples(T, voltage, None), slice(0, N)
    plain = fit_composite(samples, [RAIL], whole)
    found = fit_composite(samples, [plain.terms[0], type(law)], whole)
    assert plain.terms[0].sigma > 1.8 * RAIL.sigma
    error = 0.06 if isinstance(law, RegimeSwitching) else 2.0 * 0.8 * math.sqrt(2.0 / 90.0)
    again = fit_composite(samples, found.terms, whole, found)
    for one in (found, again):
        assert abs(math.log(one.terms[0].sigma / RAIL.sigma)) < error
    model = SupplyModel(again.terms)
    spread = [model.simulate(T, np.random.default_rng(k), None).std() for k in range(12)]
    assert np.median(spread) == pytest.approx(voltage.std(), rel=0.3)


@pytest.mark.parametrize('level, at_once, rates', [
    (0.2, True, (0.5, 2.0)), (-0.2, True, (0.4, 0.8)), (0.25, False, (0.6, 0.2))])
def test_a_simulation_of_switching_has_the_mean_and_dips_of_the_data(level, at_once, rates):
    """Two levels, 600 s at 50 Hz; errors of the rates are at least those of counting switches."""
    rng, n, rate = np.random.default_rng(7), 30_000, 50.0
    high, states = 0, []
    for u in rng.random(n).tolist():
        high ^= u < rates[high] / rate
        states.append(high)
    moved = level * np.array(states)
    phi = math.exp(-8.0 / rate)
    e = 0.05 * math.sqrt(1.0 - phi * phi) * rng.standard_normal(n)
    if not at_once:
        e += (1.0 - phi) * moved
    voltage = 11.5 + lfilter([1.0], [1.0, -phi], e) + at_once * moved
    samples, whole = Samples(np.arange(n) / rate, voltage, None), slice(0, n)
    plain = fit_composite(samples, [guess(samples)], whole)
    found = fit_composite(samples, [plain.terms[0], RegimeSwitching], whole)
    switching, se = found.terms[-1], found.se[-1]
    changes = int(np.count_nonzero(np.diff(states)))
    for name, truth in zip(('rate_up', 'rate_down'), rates[::-1 if level < 0.0 else 1]):
        error = se[name] / getattr(switching, name)
        assert 1.0 / math.sqrt(changes) < error < 4.0 / math.sqrt(changes)
        assert abs(math.log(getattr(switching, name) / truth)) < 4.0 * error
    low = float(np.quantile(voltage, 0.01))

    def dips(v):
        return int(np.count_nonzero((v[1:] < low) & (v[:-1] >= low)))

    share = rates[0] / sum(rates)
    # The share of time in a state is known from the switches alone.
    error = abs(level) * math.sqrt(2.0 * share * (1.0 - share) / (sum(rates) * 600.0))
    drawn = [SupplyModel(found.terms).simulate(samples.t, np.random.default_rng(k), None)
             for k in range(8)]
    assert abs(np.mean(drawn) - voltage.mean()) < 4.0 * error / math.sqrt(8.0)
    # The number of dips scatters by an eighth from simulation to simulation.
    assert np.mean([dips(v) for v in drawn]) == pytest.approx(dips(voltage), rel=0.3)


ALPHA, SIGMA, SLOW = 60.0, 0.5, 2.5
START = SecondRelaxation(10.0, 0.05)


def fitted(std, seed):
    """Return 60 s at 500 Hz of an OU, with a slow one of a standard deviation, and a plain fit."""
    rng = np.random.default_rng(seed)
    t = np.arange(30_000) / 500.0
    v = simulate(t, ALPHA, SIGMA, rng, u0=15.0)
    v += simulate(t, SLOW, std * math.sqrt(2.0 * SLOW), rng)
    samples = Samples(t, v, None)
    return samples, fit_composite(samples, [guess(samples)], samples.train)


def begun(std, seed):
    """Return the slow term where it starts, and the gain, nats."""
    samples, plain = fitted(std, seed)
    terms, gain = from_spectrum(samples, plain, [plain.terms[0], START])
    return terms, gain


def test_a_start_of_a_second_relaxation_is_near_the_truth():
    """36 s hold 90 relaxations of it: rate and variance are known to about 15 %."""
    for seed in (1, 2):
        (ou, slow), gain = begun(0.03, seed)
        assert abs(math.log(slow.alpha / SLOW)) < 0.9
        assert slow.sigma / math.sqrt(2.0 * slow.alpha) == pytest.approx(0.03, rel=0.3)
        assert ou.alpha == pytest.approx(ALPHA, rel=0.1)
        assert gain > 30.0


def test_without_a_second_relaxation_its_gain_is_that_of_two_parameters():
    """Twice the gain is chi-squared of two or fewer: 9.2 nats come once in 10 000."""
    assert max(begun(0.0, seed)[1] for seed in (3, 4, 5)) < 9.2


def test_ordinates_are_all_counted():
    """As many as half the samples, of mean one for white scores of variance one."""
    z = np.random.default_rng(6).standard_normal(20_001)
    seen = Ordinates.of(z)
    total = float(seen.count.sum())
    assert total == z.size // 2 - 1
    assert float(seen.count @ seen.power) / total == pytest.approx(1.0, abs=4.0 / math.sqrt(total))
    assert np.all(np.diff(seen.omega) > 0.0) and seen.omega[-1] < math.pi
