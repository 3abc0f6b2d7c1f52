"""Order and bookkeeping of fits in a search, with models that are only names and evidence."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision, fitting, named as rules_of_names, search as rules
from ou_monitor.discovery.fitting import Fitter, Trial
from ou_monitor.discovery.named import _with_trends
from ou_monitor.discovery.search import Search
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentNoise, LoadDependentSigma, LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import LopsidedNoise, MeasurementNoise
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.model.terms.tones import Tone
import pytest

BASE = OU(50.0, 0.5, 5.0)
NOISE, SLOW = MeasurementNoise(0.01), SecondRelaxation(3.0, 0.1)
SIGMA = LoadDependentSigma((0.0, 1.0), (0.0, 0.5))


class Model:
    """Terms, and an evidence in nats."""

    def __init__(self, terms, evidence, cost=0.0):
        self.terms, self.worth, self.cost = tuple(terms), evidence, cost
        self.gaussian = SimpleNamespace(terms=self.terms, cost=cost)

    def has(self, name):
        return any(term.NAME == name for term in self.terms)


class Table(Fitter):
    """Fits whose evidence is that of a table of what they hold beside the OU."""

    def __init__(self, worth):
        super().__init__(SimpleNamespace(n=1000, throttle=None))
        self.worth, self.asked = worth, []

    def evidence(self, composite):
        return composite.worth

    def view(self, composite):
        """Nothing is looked at."""
        return None

    def holds(self, composite):
        """Whatever is in the table means what its name says."""
        return True

    def fit(self, terms, known, rough=False, begun=False):
        """Return the model of the table; a rough fit is a nat worse."""
        names = tuple(term.NAME for term in terms if term.NAME != 'ou')
        self.asked.append((names, rough))
        worth = self.worth.get(names)
        return None if worth is None else Model(terms, worth - rough)


def searched(*names):
    """Return a search that has accepted these, with what it says of their evidence."""
    terms = {'measurement_noise': NOISE, 'second_relaxation': SLOW}
    return Search(Model([BASE, *(terms[name] for name in names)], 20.0), list(names))


@pytest.mark.parametrize('without, stays', [
    (20.0, False), (17.5, False), (17.0, True), (16.5, True), (5.0, True), (None, True)])
def test_a_cause_that_others_replace_is_taken_out(without, stays):
    """It must bring three nats beside the others; a rough fit near that is made a fine one."""
    search = searched('measurement_noise', 'second_relaxation')
    fitter = Table({('second_relaxation',): without, ('measurement_noise',): 0.0, (): -99.0})
    rules.backward(fitter, search)
    assert ('measurement_noise' in search.accepted) is stays
    assert search.composite.has('measurement_noise') is stays
    # Rough first; then in full, unless it is far off or there is none.
    near = without is not None and 20.0 - (without - 1.0) < decision.TIE + 20.0
    assert fitter.asked[:2] == [(('second_relaxation',), rough) for rough in (True, False)][
        :1 + near] + ([] if near else [(('measurement_noise',), True)])


def test_the_move_that_pays_most_comes_first():
    """Of two causes that could go the one whose loss costs less, and then no other."""
    search = searched('measurement_noise', 'second_relaxation')
    rules.backward(Table({('second_relaxation',): 18.0, ('measurement_noise',): 19.0,
                          (): 5.0}), search)
    assert search.accepted == ['measurement_noise'] and search.composite.worth == 19.0


def test_a_term_that_modifies_a_removed_one_is_removed_too():
    """Noise that follows throttle is nothing without white noise."""
    law = LoadDependentNoise((0.0, 0.0), (0.0, 1.0), (0.0, 0.5))
    search = Search(Model([BASE, NOISE, law], 20.0), [NOISE.NAME, law.NAME])
    fitter = Table({(): 19.0, ('measurement_noise',): 0.0})
    fitter.best_start = lambda composite, kind, view: None
    rules.backward(fitter, search)
    assert search.accepted == [] and search.composite.terms == (BASE,)


def test_the_best_first_estimates_are_fitted_in_full():
    """Those that gain at least half as much as the best; what a full fit makes worse stays."""
    kinds = {MeasurementNoise: NOISE, LoadDependentSigma: SIGMA, Drift: Drift(0.1, 0.0)}
    fitter = Table({('measurement_noise',): 26.0, ('load_dependent_sigma',): 14.0})
    rough = {MeasurementNoise: 25.0, LoadDependentSigma: 24.0, Drift: 17.0, Tone: 9.0}
    fitter.view = lambda composite: SimpleNamespace(
        z=np.zeros(9), variance=np.full(9, 1e-4), at=np.array([0.0, 1e3]))
    fitter.best_start = lambda composite, kind, view, *_: Model(
        [BASE, kinds.get(kind, NOISE)], rough[kind])
    found = fitter.trials(Model([BASE], 10.0), list(rough), lambda model: {})
    assert fitter.asked == [(('measurement_noise',), False), (('load_dependent_sigma',), False)]
    assert [(one.name, one.evidence) for one in found] == [
        ('measurement_noise', 16.0), ('load_dependent_sigma', 14.0)]
    assert found[0].composite.worth == 26.0 and found[1].composite.worth == 24.0


@pytest.mark.parametrize('held, best', [
    ((True, True), 2), ((True, False), 1), ((False, False), 0)])
def test_the_best_start_is_of_those_that_hold(held, best, monkeypatch):
    """Of two starts the one of more evidence, if the fit is still what it is said to be."""
    starts = [Drift(0.1, 0.0), Drift(0.2, 0.0)]
    monkeypatch.setattr(Drift, 'candidates', classmethod(lambda cls, view: starts))
    monkeypatch.setattr(Drift, 'holds', lambda self, view: held[starts.index(self)])
    monkeypatch.setattr(fitting, '_by_scores', lambda samples, known, view: known)
    fitter = Table({})
    fitter.fit = lambda terms, known, rough: Model(terms, starts.index(terms[-1]))
    found = fitter.best_start(Model([BASE], 0.0), Drift, None)
    assert (found is None) if not best else found.terms[-1] is starts[best - 1]


def test_starts_come_by_what_they_explain_or_by_their_likelihood(monkeypatch):
    starts = [Drift(0.1 * k, 0.0) for k in range(1, 6)]
    monkeypatch.setattr(Drift, 'candidates', classmethod(lambda cls, view: starts))
    monkeypatch.setattr(fitting, '_by_scores', lambda samples, known, view: known[::-1])
    fitter, asked = Table({}), []
    fitter.fit = lambda terms, known, rough: asked.append(terms[-1])
    assert fitter.best_start(Model([BASE], 0.0), Drift, None) is None
    assert asked == starts[:2:-1]
    hidden = [SecondRelaxation(float(k), 0.1) for k in range(1, 6)]
    monkeypatch.setattr(SecondRelaxation, 'candidates', classmethod(lambda cls, view: hidden))
    monkeypatch.setattr(SecondRelaxation, 'BROAD', False)
    fitter._by_likelihood = lambda composite, given: given[3:] + given[:3]
    asked.clear()
    fitter.best_start(Model([BASE], 0.0), SecondRelaxation, None)
    assert [term.alpha for term in asked] == [4.0, 5.0]


def test_starts_are_ordered_by_the_scores_they_explain():
    rng = np.random.default_rng(1)
    n = 2000
    t, u = 1e-2 * np.arange(n), rng.random(n)
    samples = Samples(t, np.zeros(n), u)
    view = SimpleNamespace(variance=np.ones(n), phi=np.zeros(n), train=slice(0, n),
                           z=rng.standard_normal(n) - 3.0 * u + 0.2 * (t / t[-1] - 0.5))
    sag, drift = LoadSag(0.1, 0.0), Drift(0.1, 0.0)
    assert fitting._by_scores(samples, [drift, sag], view) == [sag, drift]
    assert fitting._by_scores(samples, [sag, drift], view) == [sag, drift]
    # A line that gains less than half of its price is not fitted; what is slow may gain later.
    line = Tone(0.1, 7.0, 0.0, 0.0)
    price = len(line.LINEAR) * 0.5 * math.log(n) + line.SEARCH
    for gain in (0.4 * price, 0.6 * price):
        view.z = math.sqrt(4.0 * gain / n) * np.sin(2.0 * math.pi * 7.0 * t)
        assert fitting._by_scores(samples, [line, drift], view) == (
            [drift] if gain < 0.5 * price else [line, drift])


@pytest.mark.parametrize('name, price', [
    ('load_dependent_noise', 10.0), ('drift', 4.0), ('load_dependent_sigma', 4.0)])
def test_a_second_curve_must_add_a_tenth_of_the_first(name, price):
    # A rough fit of the table is a nat worse.
    fitter = Table({('measurement_noise',): 401.0})
    assert rules._needed(fitter, Model([BASE, NOISE, SIGMA], 500.0), name) == pytest.approx(price)
    assert rules._needed(fitter, Model([BASE], 0.0), 'load_dependent_noise') == decision.ACCEPT


def test_an_accepted_trial_is_recorded_with_its_rivals():
    """With what comes beside it, its rivals, and the largest evidence so far."""
    search = Search(Model([BASE], 0.0), ['tone'])
    best = Trial('ac_coupling', Model([BASE], 9.0), 9.0, beside='measurement_noise')
    other = Trial('drift', Model([BASE], 8.9), 9.0 - 0.5 * decision.TIE)
    rules._accept(search, best, [best, other, Trial('tone', Model([BASE], 0.0), 0.1)])
    assert search.accepted == ['tone', 'measurement_noise', 'ac_coupling']
    assert search.rivals == {'ac_coupling': ['drift']}
    assert search.composite is best.composite
    rules._accept(search, other, [other])
    assert search.rivals['drift'] == []


def test_starts_that_the_spectrum_moved_the_same_way_are_one(monkeypatch):
    starts = [SecondRelaxation(float(k), 0.1) for k in range(1, 6)]
    gains = dict(zip(starts, (9.0, 8.95, 7.0, 19.0, 5.9)))
    monkeypatch.setattr(fitting, 'from_spectrum', lambda samples, composite, terms: (
        terms, gains[terms[-1]]))
    monkeypatch.setattr(SecondRelaxation, 'holds', lambda self, view: self.alpha != 4.0)
    fitter, asked = Table({}), []

    def fit(terms, known, rough=False, begun=False):
        asked.append((terms[-1].alpha, rough, begun))
        return Model(terms, -terms[-1].alpha)

    fitter.fit = fit
    found = fitter._by_spectrum(Model([BASE], 0.0), starts, None, 0.0)
    # 4 does not hold, 2 went the way of 1, and 5 gains less than any price.
    assert asked == [(1.0, True, True), (3.0, True, True)]
    assert found.terms[-1].alpha == 1.0


def test_a_cause_that_was_removed_again_is_not_accepted_twice(monkeypatch):
    """Otherwise it takes all turns, and the other causes are never tried."""
    asked = []

    def tried(fitter, search, bank, given, latent):
        asked.append(list(given))
        found = SimpleNamespace(gaussian=SimpleNamespace(cost=math.inf))
        return [] if 'drift' in given else [Trial('drift', found, 9.0)]

    monkeypatch.setattr(rules, '_round', tried)
    monkeypatch.setattr(rules, 'backward', lambda fitter, search: search.accepted.clear())
    rules.name_causes(SimpleNamespace(cost=0.0), Search(None), None, given=['tone'])
    assert asked == [['tone'], ['tone', 'drift']]


@pytest.mark.parametrize('on_sigma, leaves', [(0.0, False), (0.1, False), (3.0, True)])
def test_sigma_follows_only_if_all_simulations_stay_in_the_recorded_range(on_sigma, leaves):
    """A factor of 20 on white noise is one of 8000 on sigma by its third power."""
    t = 0.01 * np.arange(2000)
    u = (np.sin(t) > 0.9).astype(float)
    law = LoadDependentNoise((0.0, 0.0), (0.0, 1.0), (0.0, math.log(20.0)))
    terms = (OU(8.0, 0.02, 15.0), MeasurementNoise(0.002), law)
    fitter = Fitter(Samples(t, SupplyModel(terms).simulate(t, np.random.default_rng(1), u), u))
    model = SimpleNamespace(terms=(*terms[:2], LoadDependentNoise(
        law.number, law.at, law.log_factor, on_sigma)))
    assert rules._leaves_range(fitter, model) is leaves


@pytest.mark.parametrize('rate, other, drift', [(0.05, 45.0, True), (45.0, 0.05, True),
                                                (45.0, 5.0, False)])
def test_a_relaxation_too_slow_for_the_recording_may_be_a_drift(rate, other, drift):
    """In 30 s a rate of 0.05 1/s is a trend, whichever of the two terms has it."""
    samples = SimpleNamespace(t=np.array([0.0, 30.0]))
    model = Model([OU(rate, 0.5, 5.0), SecondRelaxation(other, 0.1)], 0.0)
    rivals = _with_trends(samples, model, {SecondRelaxation.NAME: ['flicker_noise']})
    assert (Drift.NAME in rivals[SecondRelaxation.NAME]) is drift


@pytest.mark.parametrize('worth, named', [
    (15.0, ['drift']), (25.0, ['drift', 'second_relaxation'])])
def test_a_cause_in_place_of_a_better_one_that_was_withdrawn_is_not_named(
        worth, named, monkeypatch):
    """It imitates it: the withdrawn one had an evidence of 20 nats."""
    def add(fitter, search, bank, given, **_):
        name = SLOW.NAME if NOISE.NAME in given else NOISE.NAME
        value = worth if NOISE.NAME in given else 20.0
        search.composite, search.accepted = Model([], value), ['drift', name]

    monkeypatch.setattr(rules_of_names, 'Fitter', lambda samples, cost: Table({}))
    monkeypatch.setattr(Table, 'fit', lambda self, terms, known: Model([], 0.0))
    for name in ('covariates_of', 'simulate_bank', 'criticise'):
        monkeypatch.setattr(rules_of_names, name, lambda *_: {})
    monkeypatch.setattr(rules_of_names, 'under_load', lambda fitter, search:
                        search.accepted.append('drift'))
    monkeypatch.setattr(rules_of_names, 'name_causes', add)
    monkeypatch.setattr(rules_of_names, '_fit_everything', lambda fitter, search, bank:
                        rules_of_names._Result(search.copy(), search.composite, {}))
    monkeypatch.setattr(rules_of_names, '_withdrawn', lambda fitter, found, begun: [
        k for k, name in enumerate(found.search.accepted) if name == NOISE.NAME])
    monkeypatch.setattr(rules_of_names, 'without_causes', lambda fitter, search, out: replace(
        search, composite=Model([], 5.0), accepted=['drift']))
    start = Model([BASE], 0.0)
    start.gaussian.phi = np.ones(3)
    found = rules_of_names.named_causes(SimpleNamespace(t=np.arange(3.0)), start, None, (), print)
    assert list(found.names) == named and found.dropped == (NOISE.NAME,)


def test_fits_add_up_their_cost():
    """Each counts, of the first part or of everything; a fit that fails costs nothing."""
    start, t = [OU(50.0, 0.1, 5.0)], np.arange(2000) * 1e-3
    v = SupplyModel(tuple(start)).simulate(t, np.random.default_rng(1))
    fitter = Fitter(Samples(t, v, None))
    one = fitter.fit(start, None)
    assert one.cost > 0.0 and fitter.cost == one.cost
    two = fitter.whole(one)
    assert fitter.cost == pytest.approx(one.cost + two.cost)


def test_a_law_is_fitted_once_to_the_same_scores(monkeypatch):
    """To others it is fitted again; what cannot be fitted is known as well."""
    made = []
    monkeypatch.setattr(LopsidedNoise, 'fit_law', classmethod(
        lambda cls, view: made.append(view) or (None if view.z[0] else SimpleNamespace())))
    fitter = Fitter(SimpleNamespace(n=9))
    one, same, other = (SimpleNamespace(z=np.full(9, z)) for z in (0.0, 1e-9, 1.0))
    found = fitter.law_fit(LopsidedNoise, one)
    assert fitter.law_fit(LopsidedNoise, same) is found is not None and made == [one]
    assert [fitter.law_fit(LopsidedNoise, other) for _ in range(2)] == [None, None]
    assert made == [one, other]
    assert fitter.law_fit(LopsidedNoise, one) is not found and made == [one, other, one]
