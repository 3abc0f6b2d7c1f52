"""The order and bookkeeping of fits in a search, with models that are names and evidence."""

from types import SimpleNamespace

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision, fitting, search as rules
from ou_monitor.discovery.fitting import Fitter, Trial
from ou_monitor.discovery.search_state import Search
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_answer import LoadSag
from ou_monitor.model.terms.load_dependent import LoadDependentNoise, LoadDependentSigma
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
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
        """Return whether there is a term of that name."""
        return any(term.NAME == name for term in self.terms)


class Table(Fitter):
    """Fits whose evidence is that of a table of what they hold beside the OU."""

    def __init__(self, worth):
        super().__init__(SimpleNamespace(n=1000, throttle=None))
        self.worth, self.asked = worth, []

    def evidence(self, composite):
        """Return that of the model."""
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
    """It must bring three nats beside the last one; a rough fit near that is made a fine one."""
    search = searched('measurement_noise', 'second_relaxation')
    fitter = Table({('second_relaxation',): without})
    fitter.simplest = lambda composite, index: None
    needed = decision.needed_evidence(MeasurementNoise)
    assert needed == 3.0 and decision.in_doubt(MeasurementNoise, SecondRelaxation)
    rules._prune(fitter, search, chosen=False)
    assert ('measurement_noise' in search.accepted) is stays
    assert search.removed == ([] if stays else ['measurement_noise'])
    assert search.composite.has('measurement_noise') is stays
    # Rough first; then in full, unless it is far off or there is none.
    near = without is not None and 20.0 - (without - 1.0) < needed + decision.ROUGH
    assert fitter.asked == [(('second_relaxation',), rough)
                            for rough in ([True, False] if near else [True])]


def test_a_cause_may_stay_in_its_simplest_form():
    """Where that brings what the whole one does not, nothing is removed."""
    search = searched('measurement_noise', 'second_relaxation')
    plain = Model(search.composite.terms, 21.5)
    fitter = Table({('second_relaxation',): 18.0})
    fitter.simplest = lambda composite, index: plain if index == 1 else None
    rules._prune(fitter, search, chosen=False)
    assert search.composite is plain and search.removed == []
    assert search.log == ['measurement_noise in a simpler form']


def test_the_last_one_and_answers_just_chosen_are_not_in_doubt():
    """Nothing is fitted for them."""
    search = Search(Model([BASE, LoadSag(0.1, 0.0), SLOW], 20.0),
                    ['load_sag', 'second_relaxation'])
    fitter = Table({})
    rules._prune(fitter, search, chosen=True)
    assert fitter.asked == [] and search.accepted == ['load_sag', 'second_relaxation']


def trial(name, evidence, *terms):
    """Return a trial."""
    return Trial(name, Model([BASE, *terms], 10.0 + evidence), evidence)


def test_trials_near_the_best_are_fitted_again():
    """Laws are fitted in full anyway; what a full fit makes worse stays as it was."""
    fitter = Table({('measurement_noise',): 26.0, ('second_relaxation',): 14.0, ('drift',): 30.0})
    top = 15.0
    given = [trial('measurement_noise', top, NOISE), trial('second_relaxation', top - 1.0, SLOW),
             trial('heavy_tails', top - 0.5),
             trial('drift', top - decision.ROUGH, Drift(0.1, 0.0))]
    found = fitter.refine(Model([BASE], 10.0), given)
    assert fitter.asked == [(('measurement_noise',), False), (('second_relaxation',), False)]
    assert [(one.name, one.evidence) for one in found] == [
        ('measurement_noise', 16.0), ('heavy_tails', 14.5), ('second_relaxation', 14.0),
        ('drift', top - decision.ROUGH)]
    assert found[0].composite.worth == 26.0 and found[2].composite.worth == 24.0


@pytest.mark.parametrize('held, best', [
    ((True, True), 2), ((True, False), 1), ((False, False), 0)])
def test_the_best_start_is_of_those_that_hold(held, best, monkeypatch):
    """Of two starts the one of more evidence, if the fit is still what it is said to be."""
    starts = [Drift(0.1, 0.0), Drift(0.2, 0.0)]
    monkeypatch.setattr(Drift, 'candidates', classmethod(lambda cls, view: starts))
    monkeypatch.setattr(Drift, 'holds', lambda self, view: held[starts.index(self)])
    fitter = Table({})
    fitter.fit = lambda terms, known, rough: Model(terms, starts.index(terms[-1]))
    found = fitter.best_start(Model([BASE], 0.0), Drift, None)
    assert (found is None) if not best else found.terms[-1] is starts[best - 1]


def test_starts_come_by_what_they_explain_or_by_their_likelihood(monkeypatch):
    """Only the first two are fitted, in that order."""
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


def test_what_scores_explain():
    """Starts in the order of the part of the scores that their columns explain."""
    rng = np.random.default_rng(1)
    n = 2000
    t, u = 1e-2 * np.arange(n), rng.random(n)
    samples = Samples(t, np.zeros(n), u)
    view = SimpleNamespace(variance=np.ones(n), phi=np.zeros(n), train=slice(0, n),
                           z=rng.standard_normal(n) - 3.0 * u + 0.2 * (t / t[-1] - 0.5))
    sag, drift = LoadSag(0.1, 0.0), Drift(0.1, 0.0)
    assert fitting._by_scores(samples, [drift, sag], view) == [sag, drift]
    assert fitting._by_scores(samples, [sag, drift], view) == [sag, drift]


def test_the_simplest_form_has_fewer_parameters(monkeypatch):
    """It is fitted in the place of the whole one; None where it is that already."""
    wide = LoadDependentSigma((0.0, 0.5, 1.0), (0.0, 0.3, 0.5))
    forms = [wide, SIGMA]
    monkeypatch.setattr(LoadDependentSigma, 'simplest', classmethod(lambda cls, view: forms))
    fitter = Table({('load_dependent_sigma', 'measurement_noise'): 1.0})
    found = fitter.simplest(Model([BASE, wide, NOISE], 0.0), 1)
    assert found.terms == (BASE, SIGMA, NOISE)
    assert fitter.simplest(Model([BASE, SIGMA, NOISE], 0.0), 1) is None
    forms.clear()
    assert fitter.simplest(Model([BASE, wide, NOISE], 0.0), 1) is None


@pytest.mark.parametrize('term, size', [(NOISE, 1), (SLOW, 2), (LoadSag(0.1, 0.2), 2)])
def test_the_number_of_parameters_fitted(term, size):
    """Those that the search moves, and those that are linear."""
    assert fitting._size(term) == size


def test_positions_of_causes_that_recur():
    """The n-th of a kind is the n-th of the model."""
    tones = [Tone(0.01, 10.0 * k, 0.0, 0.0) for k in (1, 2)]
    model = Model([BASE, tones[0], NOISE, tones[1]], 0.0)
    names = ['tone', 'measurement_noise', 'tone']
    assert [rules.position(model, names, k) for k in range(3)] == [1, 2, 3]


@pytest.mark.parametrize('evidence, only', [(9.9, True), (10.1, False)])
def test_a_curve_that_mends_another_one(evidence, only):
    """Below a share of what the other one explains it may only mend its form."""
    search = Search(Model([BASE, NOISE, SIGMA], 500.0), ['load_dependent_sigma'], largest=1e6)
    # A rough fit of the table is a nat worse.
    fitter = Table({('measurement_noise',): 501.0 - 10.0 / decision.FORM})
    one = Trial('load_dependent_noise', Model([BASE], 0.0), evidence)
    assert rules._only_form(fitter, one, search) is only
    assert not rules._only_form(fitter, Trial('drift', Model([BASE], 0.0), evidence), search)
    alone = Search(Model([BASE], 0.0), [])
    assert not rules._only_form(fitter, one, alone)
    assert LoadDependentNoise.NAME in rules.OTHER_CURVE


def test_a_trial_that_is_accepted():
    """With what comes beside it, its rivals, and the largest evidence so far."""
    search = Search(Model([BASE], 0.0), ['tone'], largest=12.0)
    best = Trial('ac_coupling', Model([BASE], 9.0), 9.0, beside='measurement_noise')
    other = Trial('drift', Model([BASE], 8.9), 9.0 - 0.5 * decision.TIE)
    rules._accept(search, best, [best, other, Trial('tone', Model([BASE], 0.0), 0.1)])
    assert search.accepted == ['tone', 'measurement_noise', 'ac_coupling']
    assert search.rivals == {'ac_coupling': ['drift']} and search.largest == 12.0
    assert search.composite is best.composite
    rules._accept(search, other, [other])
    assert search.rivals['drift'] == [] and search.largest == 12.0


def test_dear_kinds_fail_until_something_asks_for_more():
    """Cheap ones are tried again each time."""
    dear = next(kind for kind in catalogue().values() if kind.DEAR and kind.SIGNS)
    sign = dear.SIGNS[0]
    by = -1.0 if sign[0] == '-' else 1.0
    search = Search(Model([BASE], 0.0), failed={dear.NAME: 6.0, 'measurement_noise': 99.0})
    assert rules._in_vain(search, {sign.lstrip('+-'): 5.9 * by}) == [dear.NAME]
    assert rules._in_vain(search, {sign.lstrip('+-'): 6.1 * by}) == []


def test_starts_that_the_spectrum_moved_the_same_way_are_one(monkeypatch):
    """The best of those that hold are fitted, roughly and from there on."""
    starts = [SecondRelaxation(float(k), 0.1) for k in range(1, 6)]
    gains = dict(zip(starts, (5.0, 4.95, 3.0, 9.0, 2.0)))
    monkeypatch.setattr(fitting, 'from_spectrum', lambda samples, composite, terms: (
        terms, gains[terms[-1]]))
    monkeypatch.setattr(SecondRelaxation, 'holds', lambda self, view: self.alpha != 4.0)
    fitter, asked = Table({}), []

    def fit(terms, known, rough=False, begun=False):
        asked.append((terms[-1].alpha, rough, begun))
        return Model(terms, -terms[-1].alpha)

    fitter.fit = fit
    found = fitter._by_spectrum(Model([BASE], 0.0), starts, None)
    # 4 does not hold, and 2 went the way of 1.
    assert asked == [(1.0, True, True), (3.0, True, True)]
    assert found.terms[-1].alpha == 1.0
