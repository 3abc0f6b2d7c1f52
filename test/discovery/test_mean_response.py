"""Regression of the mean: similar responses, neighbours, and candidates."""

import math
from types import SimpleNamespace

import numpy as np
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import regression
from ou_monitor.discovery.discover import discover
from ou_monitor.discovery.finding import Verdict
from ou_monitor.discovery.regression import (
    _contains, _is_near, _Regression, mean_response)
from ou_monitor.model.load import lowpass
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.records import Recording
import pytest
from scipy.signal import lfilter


def response(tau, delay=0.0):
    """Return a response to throttle with a time constant and a delay, s."""
    return LoadTransient(-0.1, tau, delay)


@pytest.mark.parametrize('one, other, near, there', [
    (response(0.1), response(0.1), True, True), (response(0.1), response(0.14), True, True),
    (response(0.1), response(0.16), True, False), (response(0.16), response(0.1), True, False),
    (response(0.1), response(0.21), False, False), (response(0.21), response(0.1), False, False),
    (response(10.0), response(12.0), True, True), (response(10.0), response(0.09), False, False),
    (response(0.1), response(0.1, 0.05), False, False),
    (response(9.0, 0.05), response(9.0, 0.06), True, False),
    (response(9.0, 0.05), response(9.0, 0.11), False, False),
    (response(0.1), LoadSag(0.1, 0.0), False, False),
    (Drift(0.1, 0.0), Drift(-0.2, 0.0), False, True)])
def test_time_constants_are_compared_by_their_ratio(one, other, near, there):
    assert _is_near(one, other) is near
    assert _contains(one, [other]) is there
    assert _contains(one, [LoadSag(0.1, 0.0), other]) is there
    assert not _contains(one, [])


N = 1200


def made(pool, columns, voltage, monkeypatch):
    """Return the regression of a voltage on 1 and on the columns of each term of a pool."""
    through = np.column_stack([voltage, np.ones(N), *columns])
    monkeypatch.setattr(regression, 'whitened', lambda *given: through.copy())
    model = SimpleNamespace(terms=(), events=None, offset=None)
    samples = SimpleNamespace(n=N, t=np.arange(N) / 20.0, voltage=voltage,
                              throttle=np.linspace(0.0, 1.0, N))
    return _Regression(samples, model, pool), through


@pytest.fixture
def driven():
    """Return a pool of terms, their columns, and a voltage that two of them make."""
    rng = np.random.default_rng(5)
    u = np.repeat(rng.random(N // 20), 20)
    slow = [np.convolve(u, np.exp(-np.arange(400) / tau) / tau)[:N] for tau in (20.0, 30.0, 300.0)]
    pool = [LoadSag(0.1, 0.0), response(0.2), response(0.3), response(3.0), Drift(0.1, 0.0)]
    columns = [np.column_stack([u, u * u][:len(pool[0].LINEAR)]), *slow,
               np.column_stack([np.linspace(-1.0, 1.0, N), np.linspace(-1.0, 1.0, N) ** 2][
                   :len(pool[4].LINEAR)])]
    columns = [column.reshape(N, -1) for column in columns]
    voltage = 3.0 - 4.0 * u - 6.0 * slow[0] + rng.standard_normal(N)
    return pool, columns, voltage


@pytest.mark.parametrize('start', [(), (4,), (0, 3), (0, 1, 3, 4)])
def test_the_search_finds_the_true_terms_from_any_start(driven, start, monkeypatch):
    pool, columns, voltage = driven
    found, _ = made(pool, columns, voltage, monkeypatch)
    found_response = found.search(start)
    assert {type(term) for term in found_response.terms} == {LoadSag, LoadTransient}
    (lag,) = (term for term in found_response.terms if isinstance(term, LoadTransient))
    assert lag.tau in (0.2, 0.3)
    chosen = tuple(sorted(pool.index(term) for term in found_response.terms))
    lost = [found._evidence(chosen) - found._evidence(found._less(chosen, pool.index(term)))
            for term in found_response.terms]
    assert lost[0] >= lost[1] > 3.0
    # A lag nearby in its place is no better.
    assert found._best_exchange(chosen, found._evidence(chosen)) is None
    (other,) = {1, 2} - set(chosen)
    worse = tuple(sorted((0, other)))
    if found._evidence(chosen) > found._evidence(worse) + 0.1:
        assert found._best_exchange(worse, found._evidence(worse)) == chosen


def test_a_steady_sag_gets_no_growth():
    """BIC of n = 2000 and 6 nats take a parameter without effect once in 10^5 recordings."""
    n, rate = 2000, 100.0
    model, grown = (OU(6.0, 0.2, 16.0), LoadSag(1.4, 0.5)), 0
    t = np.arange(n) / rate
    for seed in range(80):
        rng = np.random.default_rng([21, seed])
        throttle = np.repeat(rng.uniform(0.1, 0.9, n // 50), 50)
        samples = Samples(t, SupplyModel(model).simulate(t, rng, throttle), throttle)
        composite = fit_composite(samples, model, samples.train)
        view = view_of(samples, composite.gaussian, composite.z, samples.train)
        (sag,) = (term for term in mean_response(samples, composite, view).terms
                  if isinstance(term, LoadSag))
        grown += sag.growth != 0.0
    assert grown == 0


def test_no_two_time_constants_are_within_an_octave(driven, monkeypatch):
    """A difference of two lags of 0.2 and 0.3 s is described by one, though two fit better."""
    pool, columns, voltage = driven
    voltage = voltage - 60.0 * columns[1][:, 0] + 60.0 * columns[2][:, 0]
    found, _ = made(pool, columns, voltage, monkeypatch)
    assert found._evidence((0, 1, 2)) > max(found._evidence((0, 1)), found._evidence((0, 2))) + 5.0
    chosen = found.search((0, 1, 2)).terms
    assert sum(isinstance(term, LoadTransient) and term.tau < 1.0 for term in chosen) == 1


@pytest.mark.parametrize('seed', range(3))
def test_a_time_constant_between_those_of_the_list_is_measured(seed):
    """A polarisation of 1.5 s is found within 7 %, and no second relaxation."""
    # Half a step of the list is 19 %; the steps of the refinement end at 2 %.
    rng = np.random.default_rng(seed)
    t = np.arange(6000) / 100.0
    u = np.repeat(rng.uniform(0.0, 1.0, 60), 100)
    keep = math.exp(-0.01 / 1.5)
    late = lfilter([1.0 - keep], [1.0, -keep], u, zi=[keep * u[0]])[0]
    v = 12.0 - 0.6 * u - 0.5 * late + simulate(t, 30.0, 0.08, rng)
    found = discover(Recording(t, v + 0.005 * rng.standard_normal(t.size), u, 'made'))
    (lag,) = [cause.term for cause in found.causes if isinstance(cause.term, LoadTransient)]
    assert lag.tau == pytest.approx(1.5, rel=0.07)
    assert not any(isinstance(cause.term, SecondRelaxation) for cause in found.causes)


@pytest.mark.parametrize('rate, delay', [(50.0, 0.3), (100.0, 0.13), (250.0, 0.036)])
def test_throttle_that_is_late_by_any_whole_steps_is_one_cause(rate, delay):
    """Not several large responses that nearly cancel, nor a drift."""
    rng, n = np.random.default_rng(7), int(40.0 * rate)
    t, late = np.arange(n) / rate, round(delay * rate)
    u = lowpass(np.repeat(rng.uniform(0.1, 0.9, 41), int(rate))[:n], t, 0.3)
    u = u + 0.01 * rng.standard_normal(n)
    v = 16.2 - 2.0 * np.append(np.full(late, u[0]), u[:-late]) + 0.02 * rng.standard_normal(n)
    found = discover(Recording(t, v, u, 'made'))
    (cause,) = found.causes
    assert (found.verdict, cause.name) == (Verdict.EXPLAINED, 'load_transient')
    assert cause.term.delay == pytest.approx(delay)
    assert cause.term.gain == pytest.approx(-2.0, abs=0.02)


@pytest.mark.parametrize('seed', [4, 6])
def test_motors_that_lag_before_they_draw_current_leave_no_law_of_throttle(seed):
    # The square of the lagging speed draws the current.  With a lag of the squared throttle, what
    # remained after steps was named noise that follows throttle; and the first fit has an OU as
    # slow as the discharge, without which the search named delays.
    rng, dt, n = np.random.default_rng(seed), 0.02, 6000
    t = dt * np.arange(n)

    def ou(alpha, std):
        keep = math.exp(-alpha * dt)
        return lfilter([std * math.sqrt(1.0 - keep * keep)], [1.0, -keep],
                       rng.standard_normal(n))

    def low(x, tau):
        gain = -math.expm1(-dt / tau)
        return lfilter([gain], [1.0, gain - 1.0], x)

    u, begin = np.clip(0.3 + ou(1.2, 0.07), 0.0, 1.0), 4.0
    while begin < t[-1]:
        stay = rng.uniform(0.3, 1.6)
        u[(t >= begin) & (t < begin + stay)] = rng.uniform(0.7, 1.0)
        begin += stay + rng.uniform(2.0, 6.0)
    u[t < 2.0] = 0.0
    load = low(np.append(u[0], u[:-1]), 0.04) ** 2
    voltage = (24.8 - 3.0 * (load + 0.5 * low(load, 3.0)) - 0.03 * dt * np.cumsum(load)
               + ou(2.0, 0.02) + 0.014 * rng.standard_normal(n))
    found = discover(Recording(name='pack', t=t, voltage=np.round(voltage, 2), throttle=u))
    # Drift and white noise are not required: 1/f noise can take their place.
    names = {cause.name for cause in found.causes}
    assert 'load_sag' in names and not any(name.startswith('load_dependent') for name in names)
    lags = [cause.term for cause in found.causes if isinstance(cause.term, LoadTransient)]
    (motor,) = (lag for lag in lags if lag.lagged)
    assert motor.lagged == pytest.approx(3.0, rel=0.03)
    assert motor.tau == pytest.approx(0.04, rel=0.05) and not any(lag.delay for lag in lags)


def test_a_current_does_not_lag_behind_the_motors():
    forms = [LoadTransient(0.0, 0.05, 0.0).forms(by_current) for by_current in (False, True)]
    assert [any(form.lagged for form in some) for some in forms] == [True, False]


def test_a_lag_before_the_square_must_gain_more_than_one_after_it(driven, monkeypatch):
    _, columns, voltage = driven
    pool = [LoadTransient(0.0, 0.1, 0.0, square=0.1), LoadTransient(0.0, 0.1, 0.0, lagged=0.1)]
    both = np.column_stack((columns[0], columns[1]))[:, :2]
    found, _ = made(pool, [both, both], voltage, monkeypatch)
    more = found._evidence((0,)) - found._evidence((1,))
    assert more == pytest.approx(pool[1].FORM_COST * N) and more > 1.0
