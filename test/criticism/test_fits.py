"""Fits of many states and of laws, and starts of slow states from the spectrum."""

import math
from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.criticism import structure
from ou_monitor.criticism.composite import _converged, fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import design_of, evaluate, Events, solved, state_space
from ou_monitor.discovery.decision import rivals_of, TIE
from ou_monitor.discovery.fitting import from_spectrum, standard_errors
from ou_monitor.discovery.gain import guess
from ou_monitor.discovery.search import stray
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentAlpha, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.regime_switching import RegimeSwitching, SwitchingLevels
from ou_monitor.model.terms.shocks import Volatility
from ou_monitor.model.terms.slow import ACCoupling, FlickerNoise, SecondRelaxation
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
    found = standard_errors(samples, fit)
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
    found = fit_composite(samples, [plain.terms[0], SwitchingLevels], whole)
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


def test_the_first_sample_behind_a_high_pass_has_the_law_of_its_throttle():
    n = 50
    throttle = np.linspace(0.1, 0.9, n)
    samples = Samples(1e-3 * np.arange(n), np.random.default_rng(1).standard_normal(n), throttle)
    ou, alpha = OU(60.0, 0.5, 5.0), LoadDependentAlpha(0.8)
    plain = evaluate(samples, (ou, alpha))
    space = state_space(samples, (ou, alpha, ACCoupling(3.0, 0.0)), None)[1]
    rate = 2.0 * math.pi * 3.0
    first = float(plain.variance[0])
    # The same step from the first sample to the second says what alpha is at the first.
    at_first = -1e3 * math.log(state_space(samples, (ou, alpha), None)[1].f[1, 0, 0])
    share = rate / (rate + at_first)
    assert_allclose(space.q[0] / first, [[1.0, share], [share, share]], rtol=0.02)
    late = -1e3 * math.log(state_space(samples, (ou, alpha), None)[1].f[-1, 0, 0])
    assert abs(rate / (rate + late) / share - 1.0) > 0.1


def test_rivals_are_within_a_tie():
    evidence = [('a', 5.0 + TIE), ('b', 5.0), ('c', 5.0 + 0.01), ('d', 9.0 + TIE)]
    assert rivals_of('a', evidence) == ['c', 'd'] and rivals_of('d', evidence) == []


def test_the_mean_is_seen_through_the_instrument():
    """Columns of the load are high-passed; that of the level is the instrument's own."""
    t = 0.01 * np.arange(300)
    u = np.where(t >= 1.0, 0.8, 0.2)
    samples = Samples(t, 5.0 - u, u)
    ou, sag, coupling = OU(60.0, 0.5, 5.0), LoadSag(0.3, 0.1), ACCoupling(2.0, 0.0)
    s = samples.segment(60.0, 0.5)
    bare = design_of(samples, (ou, sag), s)[:, 1:]
    shown = design_of(samples, (ou, sag, coupling), s)[:, 1:]
    assert bare.shape == shown.shape == (300, 3)
    assert_allclose(shown[:, 0], 1.0)
    assert_allclose(shown[:, 1:], coupling.pass_through(bare[:, 1:], s), atol=1e-12)
    assert np.abs(shown[:90, 1:]).max() < 1e-9 < np.abs(bare[:90, 1:]).min()
    # What is kept from before is not touched.
    assert_allclose(design_of(samples, (ou, sag), s)[:, 1:], bare)


def test_the_same_events_are_found_again_where_push_and_error_begin_at_the_same_samples():
    """A tenth of the power apart in the mean logarithm and 1 % of a variance of the mean."""
    one, zero = np.array([0.0, 1.0, 0.0]), np.zeros(3)
    fit = SimpleNamespace(variance=np.full(3, 4.0))

    def same(push, error, before, power=1.0, moved=0.0, offset=None):
        found = Events(push, error, np.full(3, power), np.ones(3), zero)
        return _converged(before, offset, found, np.full(3, moved), fit)
    none = Events(zero, zero, np.ones(3), np.ones(3), zero)
    assert same(zero, zero, None) and same(zero, zero, none)
    for push, error in ((one, zero), (zero, one)):
        assert not same(push, error, None) and not same(push, error, none)
        assert same(9.0 * push, 9.0 * error, Events(push, error, np.ones(3), np.ones(3), zero))
        assert not same(zero, zero, Events(push, error, np.ones(3), np.ones(3), zero))
    assert same(zero, zero, None, moved=0.199) and not same(zero, zero, None, moved=0.201)
    assert same(zero, zero, None, moved=5.1, offset=np.full(3, 5.0))
    assert not same(zero, zero, None, power=4.0)


@pytest.mark.parametrize('width', (3, 400))
def test_least_squares_agree_for_few_and_for_many_columns(width):
    rng = np.random.default_rng(7)
    columns, y = rng.standard_normal((1000, width)), rng.standard_normal(1000)
    columns[:, 1] = 0.0
    columns *= np.geomspace(1.0, 1e3, width)
    both = np.column_stack((y, columns))
    assert_allclose(solved(both.T @ both)[0], np.linalg.pinv(columns) @ y, atol=1e-9)


def test_events_add_to_the_joint_normal_law():
    rng = np.random.default_rng(9)
    n, alpha, sigma, u0 = 40, 1.3, 0.5, 5.0
    t = np.cumsum(rng.choice([0.1, 0.2, 0.5], n))
    v = u0 + 0.4 * rng.standard_normal(n)
    push, error, power = np.zeros(n), np.zeros(n), np.ones(n)
    push[9], error[20], power[30:33] = 0.7, 0.9, 3.0
    std, white = 0.2, np.where(np.arange(n) // 4 == 4, 5.0, 1.0)
    found = evaluate(Samples(t, v, None), [OU(alpha, sigma, u0), MeasurementNoise(std)],
                     Events(push, error, power, white, np.zeros(n)))
    keep = np.append(0.0, np.exp(-alpha * np.diff(t)))
    added = power * sigma**2 / (2.0 * alpha) * (1.0 - keep**2) + push
    spread = np.zeros(n)
    for k in range(n):
        spread[k] = (keep[k]**2 * spread[k - 1] if k else 0.0) + added[k]
    decay = np.exp(-alpha * np.abs(t[:, None] - t))
    covariance = decay * spread[np.minimum.outer(np.arange(n), np.arange(n))] + np.diag(
        error + white * std**2)
    known = np.linalg.cholesky(covariance)
    assert_allclose(found.innovation, np.diag(known) * np.linalg.solve(known, v - u0), atol=1e-4)
    # What an event adds at its own sample is not in the variance there.
    own = (power - 1.0) / power * (added - push) + push + error + (white - 1.0) * std**2
    assert_allclose(found.variance, np.diag(known)**2 - own, rtol=1e-3)


def test_simulations_may_exceed_the_recorded_range_by_half_of_it():
    """Seen 14 to 16 V: 13 to 17 V may be simulated, and what is farther is said in volts."""
    seen = np.array([14.0, 15.0, 16.0])
    assert stray(np.array([[13.0, 17.0], [15.0, 15.5]]), seen) == 0.0
    assert stray(np.array([[15.0, 17.3], [15.0, 15.5]]), seen) == pytest.approx(0.3)
    assert stray(np.array([12.5, 17.2]), seen) == pytest.approx(0.5)
    assert stray(np.array([np.nan, 15.0]), seen) == float('inf')
