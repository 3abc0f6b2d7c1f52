"""The removal of causes one after the other, from tables with given fits and scores."""

from types import SimpleNamespace

from ou_monitor.discovery import named as pruning
from ou_monitor.discovery.named import Pruned, prune_by_gain, refusal, Worth
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.model.terms.tones import Tone
import pytest

BASE = OU(50.0, 0.5, 5.0)
KINDS = {'measurement_noise': MeasurementNoise(0.01),
         'second_relaxation': SecondRelaxation(3.0, 0.1), 'drift': Drift(0.1, 0.0),
         'tone': Tone(0.01, 10.0, 0.0, 0.0)}


def scored_model(*names):
    """Return a model with these causes, as it is scored."""
    return SimpleNamespace(model=SimpleNamespace(terms=(BASE, *(KINDS[n] for n in names))))


def state_of(*names, sizes=()):
    """Return a state in which each cause may be left out alone."""
    worth = [Worth(0.1, 0.01, 0.0, 1, scored_model(*names[:k], *names[k + 1:]))
             for k in range(len(names))]
    return Pruned(scored_model(*names), list(names), worth)


@pytest.mark.parametrize('names, worst, less, size, left, out', [
    (['drift', 'tone'], 0, ['tone'], 1, ['tone'], ['drift']),
    # What the rest does not hold any more goes with it.
    (['drift', 'tone', 'measurement_noise'], 1, ['drift'], 1, ['drift'],
     ['measurement_noise', 'tone']),
    # A line that wanders is a state; a fit to all samples goes without states.
    (['tone', 'drift', 'tone'], 1, ['tone'], 1, ['tone'], ['drift', 'tone']),
    # One of several alone, or all of them together.
    (['tone', 'drift', 'tone'], 0, ['drift', 'tone'], 1, ['drift', 'tone'], ['tone']),
    (['tone', 'drift', 'tone', 'tone', 'tone'], 0, ['drift'], 4, ['drift'], ['tone'])])
def test_a_removed_cause_leaves_names_and_model_consistent(names, worst, less, size, left, out):
    state = state_of(*names)
    rest = scored_model(*less)
    state.worth[worst] = Worth(0.0, 1.0, 1.0, size, rest)
    pruning._leave_out(state, worst)
    assert state.names == left and sorted(state.out) == out and state.full is rest


def run(monkeypatch, values, names, vague=()):
    """Return what is left, with (gain, chance) of each cause in each round; error 0.01."""
    rounds = iter(values)
    monkeypatch.setattr(pruning, 'held_out', lambda samples, model: scored_model(*names))
    monkeypatch.setattr(pruning, '_undetermined', lambda samples, state: [
        k for k, name in enumerate(state.names) if name in vague])
    monkeypatch.setattr(pruning, '_absorbs_trend', lambda *given: False)

    def measure(samples, state, plain, scored, progress):
        table = next(rounds)
        state.worth = []
        for k, name in enumerate(state.names):
            gain, chance = table[name]
            rest = [one for j, one in enumerate(state.names) if j != k]
            state.worth.append(Worth(gain, 0.01, chance, 1, scored_model(*rest)))

    monkeypatch.setattr(pruning, '_measure', measure)
    return prune_by_gain(None, None, names, None, None, lambda share: None)


@pytest.mark.parametrize('name, errors, vague', [
    ('tone', {'amplitude': 0.1}, True), ('tone', {'amplitude': 0.001, 'frequency': 1e3}, False),
    ('second_relaxation', {'sigma': 1.0}, True), ('second_relaxation', {'alpha': 99.0}, False),
    ('drift', {'rate': 9.0}, False)])
def test_a_cause_of_undetermined_size_is_left_out(name, errors, vague, monkeypatch):
    """Its size has an error beyond the largest; others stay."""
    monkeypatch.setattr(pruning, 'standard_errors', lambda samples, model: [
        {}, {'std': 0.001}, errors])
    state = state_of('measurement_noise', name)
    assert pruning._undetermined(SimpleNamespace(n=9), state) == [1] * vague
    good = dict.fromkeys(state.names, (0.5, 0.0))
    found = run(monkeypatch, [good, good], state.names, [name] * vague)
    assert found.out == [name] * vague


def test_the_worst_goes_first_and_the_others_are_measured_again(monkeypatch):
    """By chance, then by gain; a cause that failed beside a worse one may stay."""
    found = run(monkeypatch, [
        {'drift': (-0.1, 0.9), 'tone': (-0.2, 0.9), 'measurement_noise': (-0.3, 0.5)},
        {'drift': (0.5, 0.0), 'measurement_noise': (-0.3, 0.5)},
        {'drift': (0.5, 0.0)}], ['drift', 'tone', 'measurement_noise'])
    assert found.names == ['drift'] and found.out == ['tone', 'measurement_noise']
    assert [worth.gain for worth in found.worth] == [0.5]


@pytest.mark.parametrize('gain, far, said', [
    (0.1, 0.0, ''), (-0.1, 0.0, 'worse than the plain OU'), (float('nan'), 0.0, ''),
    (0.1, 0.25, 'by 0.25 V'), (0.1, float('inf'), 'without bound'),
    (0.1, None, 'cannot be simulated (runs away)')])
def test_a_model_is_refused_for_its_gain_or_its_simulations(gain, far, said, monkeypatch):
    def given(samples, terms):
        if far is None:
            raise ValueError('runs away')
        return far

    monkeypatch.setattr(pruning, 'outside_range', given)
    text = refusal(None, (BASE,), gain, 0.01)
    assert said in text and bool(text) is bool(said)
    if gain > 0.0:
        assert 'errors' in refusal(None, (BASE,), gain, 0.01, larger=True)


def straying(monkeypatch, far, *names, evidence=()):
    """Return which cause is withdrawn (far: how far simulations stray, V, by their terms)."""
    evidence = dict(zip(names, evidence))

    def left(fitter, search, out):
        return SimpleNamespace(composite=scored_model(
            *(name for k, name in enumerate(names) if k not in out)).model)

    monkeypatch.setattr(pruning, 'outside_range', lambda samples, terms: far(
        [term.NAME for term in terms[1:]]))
    monkeypatch.setattr(pruning, 'without_causes', left)
    fitter = SimpleNamespace(samples=None, whole=lambda model: model, evidence=lambda model: sum(
        evidence.get(term.NAME, 0.0) for term in model.terms))
    return pruning._straying(fitter, pruning.FittedSearch(
        SimpleNamespace(accepted=list(names)), scored_model(*names).model, {}))


@pytest.mark.parametrize('full, less, evidence, out', [
    (0.0, (0.0, 0.0), (1.0, 2.0), []), (1.0, (0.0, 1.0), (2.0, 1.0), [0]),
    (1.0, (1.0, 0.0), (1.0, 2.0), [1]), (1.0, (0.0, 0.0), (2.0, 1.0), [1]),
    (1.0, (2.0, 0.5), (1.0, 2.0), [])])
def test_the_cheapest_cause_of_strays_is_found(full, less, evidence, out, monkeypatch):
    """Of those without which they stay within what was seen, the one that costs least."""
    left = {('tone',): less[1], ('measurement_noise',): less[0]}
    assert straying(monkeypatch, lambda names: left.get(tuple(names), full), 'tone',
                    'measurement_noise', evidence=evidence) == out


def test_a_model_that_cannot_be_simulated_strays_without_bound(monkeypatch):
    """An answer of the mean is never the one that is left out for it."""
    def far(names):
        if 'tone' in names:
            raise ValueError('runs away')
        return 0.0

    assert straying(monkeypatch, far, 'drift', 'tone') == [1]
    assert straying(monkeypatch, far, 'drift') == []
    assert straying(monkeypatch, lambda names: 1.0 - len(names), 'drift') == []


@pytest.mark.parametrize('accepted, out, gone', [
    (['drift', 'jumps', 'volatility'], [1], [1, 2]), (['volatility', 'jumps'], [1], [1]),
    (['jumps', 'tone'], [0], [0]), (['jumps', 'tone', 'heavy_tails'], [0, 1], [0, 1, 2])])
def test_what_imitates_a_withdrawn_cause_and_came_later_goes_with_it(accepted, out, gone):
    """It may only have corrected that cause's form; the search then tries it alone."""
    assert pruning._with_corrections(accepted, out) == gone
