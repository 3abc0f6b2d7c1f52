"""Order and bookkeeping of fits in a search, with models that are names and evidence; laws."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision, named as rules_of_names, search as rules
from ou_monitor.discovery.fitting import Fitter, Trial
from ou_monitor.discovery.search import Search
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import (
    LoadDependentAlpha, LoadDependentNoise, LoadDependentSigma, LoadSag)
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
import pytest

BASE = OU(50.0, 0.5, 5.0)
NOISE, SLOW = MeasurementNoise(0.01), SecondRelaxation(3.0, 0.1)
SIGMA = LoadDependentSigma((0.0, 1.0), (0.0, 0.5))
LAW = LoadDependentNoise((0.0, 0.0), (0.0, 1.0), (0.0, 0.5))


class Model:
    """Terms, and an evidence in nats."""

    def __init__(self, terms, evidence, cost=0.0):
        self.terms, self.worth, self.cost = tuple(terms), evidence, cost
        self.gaussian = SimpleNamespace(terms=self.terms, cost=cost)

    def has(self, name):
        return any(term.NAME == name for term in self.terms)

    def last(self, kind):
        return [term for term in self.terms if term.NAME == kind.NAME][-1]


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
        names = tuple(sorted(term.NAME for term in terms if term.NAME != 'ou'))
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
    search = Search(Model([BASE, NOISE, LAW], 20.0), [NOISE.NAME, LAW.NAME])
    fitter = Table({(): 19.0, ('measurement_noise',): 0.0})
    fitter.best_start = lambda composite, kind, view: None
    rules.backward(fitter, search)
    assert search.accepted == [] and search.composite.terms == (BASE,)


@pytest.mark.parametrize('term, price', [
    (LAW, 10.0), (Drift(0.1, 0.0), 4.0), (SIGMA, 4.0), (LoadDependentAlpha(0.5), 4.0),
    (LoadDependentAlpha(0.5, 0.2), 10.0)])
def test_a_second_curve_must_add_a_tenth_of_the_first(term, price):
    # A rough fit of the table is a nat worse.
    fitter = Table({('measurement_noise',): 401.0})
    assert rules._needed(fitter, Model([BASE, NOISE, SIGMA], 500.0), term) == pytest.approx(price)
    assert rules._needed(fitter, Model([BASE], 0.0), LAW) == decision.ACCEPT


def test_a_cause_that_was_removed_again_is_not_accepted_twice(monkeypatch):
    """Otherwise it takes all turns, and the other causes are never tried."""
    asked = []

    def tried(fitter, search, bank, given, latent):
        asked.append(list(given))
        found = SimpleNamespace(gaussian=SimpleNamespace(cost=math.inf))
        return [] if 'drift' in given else [Trial(Drift, found, 9.0)]

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


@pytest.mark.parametrize('worth, test, named', [
    (15.0, '_withdrawn', ['drift']), (25.0, '_withdrawn', ['drift', 'second_relaxation']),
    (15.0, '_straying', ['drift', 'second_relaxation'])])
def test_a_cause_in_place_of_a_better_one_that_was_withdrawn_is_not_named(
        worth, test, named, monkeypatch):
    """It imitates it: the refuted one had 20 nats; one that strays says nothing of others."""
    def add(fitter, search, bank, given, **_):
        name = SLOW.NAME if NOISE.NAME in given else NOISE.NAME
        value = worth if NOISE.NAME in given else 20.0
        search.composite, search.accepted = Model([], value), ['drift', name]

    for name in ('simulate_bank', 'criticise'):
        monkeypatch.setattr(rules_of_names, name, lambda *_: {})
    monkeypatch.setattr(rules_of_names, 'under_load', lambda samples, start: (
        Table({}), Search(Model([], 0.0), ['drift'])))
    monkeypatch.setattr(rules_of_names, 'name_causes', add)
    monkeypatch.setattr(rules_of_names, '_fit_everything', lambda fitter, search, bank:
                        rules_of_names.FittedSearch(search.copy(), search.composite, {}))
    for one in ('_withdrawn', '_straying'):
        monkeypatch.setattr(rules_of_names, one, lambda fitter, found, *_, mine=one == test: [
            k for k, name in enumerate(found.search.accepted) if mine and name == NOISE.NAME])
    monkeypatch.setattr(rules_of_names, 'without_causes', lambda fitter, search, out: replace(
        search, composite=Model([], 5.0), accepted=['drift']))
    start = Model([BASE], 0.0)
    found = rules_of_names.named_causes(SimpleNamespace(t=np.arange(3.0)), start, None, (), print)
    assert found.found.search.accepted == named and [*found.dropped] == [NOISE.NAME]


LAWS = {'s': SIGMA, 'n': LAW, 'a': LoadDependentAlpha(0.5)}


def compared(worth, letters):
    """Return the search after the comparison of laws, and their letters (worth: by letters)."""
    laws = {letter: LAWS[letter].NAME for letter in LAWS}
    fitter = Table({tuple(sorted((NOISE.NAME, *map(laws.get, some)))): value
                    for some, value in worth.items()})
    fitter.best_start = lambda composite, kind, view: fitter.fit(
        [*composite.terms, *(law for law in LAWS.values() if type(law) is kind)], composite)
    search = Search(Model([BASE, NOISE, *map(LAWS.get, letters)],
                          worth[''.join(sorted(letters))]), [NOISE.NAME, *map(laws.get, letters)])
    rules.backward(fitter, search)
    return search, ''.join(sorted(k for k, name in laws.items() if name in search.accepted))


ALONE = {'': 0.0, 's': 30.0, 'n': 14.0, 'a': 5.0, 'ns': 31.0, 'as': 31.0, 'an': 16.0, 'ans': 32.0}


@pytest.mark.parametrize('letters', ['s', 'n', 'a', 'ns', 'an', 'as', 'ans'])
def test_the_best_law_is_named_whatever_was_tried_first(letters):
    """From any set the search ends at the one law that brings more than the others."""
    search, left = compared(ALONE, letters)
    assert left == 's' and search.rivals[LAWS['s'].NAME] == []
    assert search.composite.worth == 30.0


@pytest.mark.parametrize('lost, told', [(2.9, ['load_dependent_noise']), (3.1, [])])
def test_a_law_that_does_nearly_as_well_is_a_rival(lost, told):
    """Within three nats after a full fit in its place; one that does better takes the place."""
    search, left = compared({**ALONE, 'n': 30.0 - lost, 'ns': 30.5}, 's')
    assert left == 's' and search.rivals[LAWS['s'].NAME] == told


@pytest.mark.parametrize('both, left', [(64.0, 's'), (66.0, 'ns')])
def test_two_curves_stay_where_each_explains_a_tenth_of_the_other(both, left):
    """Of 600 nats of the one, 60 of the other: less may be a matter of its form."""
    worth = {**ALONE, 's': 600.0, 'n': 400.0, 'as': 601.0, 'an': 401.0, 'ns': 600.0 + both - 5.0,
             'ans': 600.0 + both - 4.0}
    assert compared(worth, 'ns')[1] == left


def test_constant_white_noise_does_not_follow_throttle():
    rng = np.random.default_rng(6)
    t = np.arange(6000) / 100.0
    walk = np.repeat(rng.uniform(0.2, 0.7, 120), 50)
    throttle = np.convolve(np.pad(walk, 10, 'edge'), np.full(21, 1.0 / 21.0), 'valid')
    truth = SupplyModel((OU(6.0, 0.15, 20.0), LoadSag(1.5, 0.0), MeasurementNoise(0.035),
                         LoadDependentSigma((0.0, 1.0), (0.0, 1.8))))
    voltage = truth.simulate(t, rng, throttle)
    names = [cause.name for cause in discover(Recording(t, voltage, throttle, 'simulated')).causes]
    assert 'load_dependent_sigma' in names
    assert 'load_dependent_noise' not in names and 'load_dependent_alpha' not in names


def test_the_noise_of_the_rail_leaves_the_law_of_the_white_noise():
    """Two thirds of an error are the rail's, and the white noise grows by a factor of 3."""
    rng, n = np.random.default_rng(5), 6000
    u = np.repeat(rng.uniform(0.1, 0.9, n // 60), 60)
    terms = (OU(6.0, 0.14, 12.0), MeasurementNoise(0.008),
             LoadDependentNoise((0.0, 0.0), (0.1, 0.9), (0.0, np.log(3.0))), LoadSag(0.5, 0.0))
    v = SupplyModel(terms).simulate(np.arange(n) / 80.0, rng, u)
    found = discover(Recording(np.arange(n) / 80.0, v, u, 'made'))
    names = {cause.name for cause in found.causes}
    assert names == {'load_sag', 'measurement_noise', 'load_dependent_noise'}
    law = next(cause.term for cause in found.causes if cause.name == 'load_dependent_noise')
    # Six seeds gave 0.96 to 1.08; squares without negative ones gave 0.67 to 0.71.
    assert law.log_factor[-1] - law.log_factor[0] == pytest.approx(np.log(3.0), abs=0.25)


def test_causes_stay_if_the_fit_without_another_fails_from_the_beginning():
    """It starts again from the whole model, whose events the laws that stay need."""
    class Whole(Table):
        def fit(self, terms, known, rough=False, begun=False):
            return super().fit(terms, known, rough, begun) if known else None
    search = searched('measurement_noise', 'second_relaxation')
    left = rules.without_causes(Whole({('measurement_noise',): 12.0}), search, [1])
    assert left.accepted == ['measurement_noise'] and left.composite.worth == 12.0
