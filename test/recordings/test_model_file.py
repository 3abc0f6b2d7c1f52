"""Model files: round trips, and one line for every error."""

from dataclasses import replace
import datetime
import math

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.recordings.model_file import as_yaml, ModelFile, parse_model, read_model
import pytest
import yaml

OU = {'term': 'ou', 'params': {'alpha': 63.0, 'sigma': 0.3156, 'u0': 5.0}}
SAG = {'term': 'load_sag', 'params': {'linear': 0.3, 'square': 0.0, 'growth': 0.0}}
KNOTS = {'term': 'load_dependent_sigma',
         'params': {'throttle': [0.1, 0.4], 'log_factor': [0.0, 0.7]}}


def model(*names_and_params):
    return SupplyModel(tuple(catalogue()[n](**p) for n, p in names_and_params))


def failure(data, where='m.yaml'):
    """Return the message of a model that must be refused: one line that names the file."""
    with pytest.raises(InputError) as caught:
        parse_model(data, where)
    text = str(caught.value)
    assert text.startswith(where) and '\n' not in text
    return text


def test_a_model_file_reads_back_exactly(tmp_path):
    """Every digit of parameters, errors and provenance survives."""
    rng = np.random.default_rng(1)
    third, tiny = 1.0 / 3.0, 1.234567890123456e-17
    supply = model(('ou', {'alpha': 63.0 + third, 'sigma': tiny, 'u0': -5.0}),
                   ('load_dependent_sigma', {'throttle': [0.1, third, 0.9],
                                             'log_factor': rng.standard_normal(3).tolist()}),
                   ('tone', {'amplitude': 1e-9, 'frequency': 1e9, 'phase': -third,
                             'linewidth': 0.0}),
                   ('tone', {'amplitude': 1.0, 'frequency': 2.0, 'phase': 0.0,
                             'linewidth': third}))
    file = ModelFile(supply, ({'alpha': third, 'sigma': 1e-30}, {'log_factor': [0.1, 0.2, third]},
                              {}, {'phase': 0.5}),
                     {'recording': 'flight <ü>: 1', 'commit': 'abc', 'heldout_score': -third,
                      'date': datetime.date(2026, 11, 21), 'n': 5})
    file = replace(file, model=replace(file.model, full_current=-third))
    path = tmp_path / 'm.yaml'
    path.write_text(as_yaml(file), encoding='utf-8')
    assert read_model(path) == file and read_model(str(path)) == file
    assert as_yaml(read_model(path)) == as_yaml(file)


@pytest.mark.parametrize('name', sorted(set(catalogue()) - {'ou'}))
def test_every_term_goes_through_a_file(name):
    cls = catalogue()[name]
    params = {key: [0.25, 0.5] if key in ('at', 'throttle', 'log_factor')
              else 0.5 + 2.0 * k + 2.0 * (key == 'dof')
              for k, key in enumerate(cls.parameters())}
    # Shares, and a number of states, have a range of their own.
    params.update({key: value for key, value in (
        ('probability', 0.5), ('at_once', 0.25), ('states', 3.0), ('tilt', -0.5),
        ('number', [0.0, 0.0]))
        if key in params})
    file = ModelFile(model(('ou', OU['params']), (name, params)), ({}, {}))
    back = parse_model(yaml.safe_load(as_yaml(file)), 'x')
    assert back == file and back.model.terms[1].values() == params


def test_the_text_is_that_of_the_contract():
    """`model:` a list of term, params, se; `provenance:`; empty parts are left out."""
    file = ModelFile(model(('ou', OU['params']), ('load_sag', SAG['params'])),
                     ({'alpha': 0.5}, {}), {'commit': 'abc'})
    assert yaml.safe_load(as_yaml(file)) == {
        'model': [{**OU, 'se': {'alpha': 0.5}}, SAG], 'provenance': {'commit': 'abc'}}
    assert yaml.safe_load(as_yaml(ModelFile(file.model))) == {'model': [OU, SAG]}


def test_unknown_standard_errors_are_null():
    """Unknown errors are null in the file and NaN when read; whole numbers are valid."""
    file = parse_model({'model': [{**OU, 'se': {'alpha': None, 'u0': 1}},
                                  {**KNOTS, 'se': {'log_factor': [None, 0.5]}}]}, 'x')
    assert math.isnan(file.se[0]['alpha']) and file.se[0]['u0'] == 1.0
    assert math.isnan(file.se[1]['log_factor'][0]) and file.se[1]['log_factor'][1] == 0.5
    again = yaml.safe_load(as_yaml(file))['model']
    assert again[0]['se'] == {'alpha': None, 'u0': 1.0}
    assert again[1]['se'] == {'log_factor': [None, 0.5]}


@pytest.mark.parametrize('entry, words', [
    ({**OU, 'se': {'alfa': 1.0}}, ["'alfa'", "'alpha'"]), ({**OU, 'se': [1.0]}, ["'se'", "'ou'"]),
    ({**OU, 'se': {'alpha': 'x'}}, ["'x'", 'standard error', 'ou']),
    ({**OU, 'se': {'alpha': True}}, ['True', 'standard error']),
    ({**OU, 'se': {'alpha': [1.0, 'y']}}, ["'y'"]),
    ({**OU, 'se': {'alpha': -0.1}}, ['standard error of ou.alpha', '-0.1']),
    ({**OU, 'se': {'alpha': math.inf}}, ['standard error of ou.alpha', 'inf']),
])
def test_bad_standard_errors(entry, words):
    text = failure({'model': [entry]})
    assert 'term 1' in text and all(word in text for word in words), text


def test_numbers_with_an_exponent_need_no_point(tmp_path):
    """1e-3 is a number to people and to YAML 1.2; other text is not."""
    path = tmp_path / 'm.yaml'
    path.write_text('model:\n- term: ou\n  params: {alpha: 6.3e1, sigma: 3E-1, u0: -5e+0}\n'
                    '- term: load_dependent_sigma\n'
                    '  params: {throttle: [0, 1], log_factor: [1e-1, 2]}\n')
    first, second = read_model(path).model.terms
    assert first.values() == {'alpha': 63.0, 'sigma': 0.3, 'u0': -5.0}
    assert second.values() == {'throttle': [0.0, 1.0], 'log_factor': [0.1, 2.0]}
    for text in ('1e', 'e5', '1e999', '0x1p3', 'nan'):
        assert 'ou.u0' in failure({'model': [{'term': 'ou', 'params': {
            **OU['params'], 'u0': text}}]})


@pytest.mark.parametrize('full', [0, 0.0, 'x', True, math.inf, [1.0]])
def test_the_current_of_a_full_load_is_a_number_other_than_zero(full):
    assert 'full_load_a' in failure({'model': [OU], 'full_load_a': full})


@pytest.mark.parametrize('entry, words', [
    ('load_sag', ['term: NAME']), (None, ['term: NAME']), ({'params': {}}, ['term: NAME']),
    ({'term': 'load_sak', 'params': {}}, ["'load_sak'", "'load_sag'"]),
    ({'term': None, 'params': {}}, ['unknown term']), ({'term': [1], 'params': {}}, ['unknown']),
    ({'term': 'Load_sag', 'params': {}}, ["'load_sag'"]),
    ({**SAG, 'parms': {}}, ["'parms'", "'params'", 'load_sag']),
    ({'term': 'load_sag'}, ["'load_sag'", "'linear'", "'square'"]),
    ({'term': 'load_sag', 'params': None}, ["lacks 'linear'"]),
    ({'term': 'load_sag', 'params': {'linear': 0.1}}, ["'load_sag'", "lacks 'square'"]),
    ({'term': 'load_sag', 'params': {'linear': 0.1, 'square': 0.0, 'cube': 1.0}},
     ["no parameter 'cube'", "'linear', 'square'"]),
    ({'term': 'load_sag', 'params': {1: 0.1, 'linear': 0.1, 'square': 0.0}}, ["'1'"]),
    ({'term': 'load_sag', 'params': [0.1, 0.2]}, ["'params'", 'mapping']),
    ({'term': 'load_sag', 'params': {'linear': 'x', 'square': 0.0}}, ['load_sag.linear', "'x'"]),
    ({'term': 'load_sag', 'params': {'linear': None, 'square': 0.0}}, ['load_sag.linear']),
    ({'term': 'load_sag', 'params': {'linear': math.nan, 'square': 0.0}}, ['finite']),
    ({'term': 'load_sag', 'params': {'linear': 10 ** 400, 'square': 0.0}}, ['load_sag.linear']),
    ({'term': 'jumps', 'params': {'rate': -2.0, 'mean': 0.0, 'std': 0.1}},
     ['jumps.rate', '1/s', '-2']),
    ({'term': 'load_dependent_sigma', 'params': {'throttle': 0.1, 'log_factor': [0.0]}},
     ['load_dependent_sigma.throttle', 'list']),
])
def test_a_wrong_term_is_named_with_the_nearest_word(entry, words):
    text = failure({'model': [OU, entry]})
    assert 'term 2' in text and all(word in text for word in words), text


@pytest.mark.parametrize('data, words', [
    (None, "needs 'model:'"), ([], "needs 'model:'"), ('text', "needs 'model:'"), (5, "'model:'"),
    ({}, "needs 'model:'"), ({'modell': [OU]}, "needs 'model:'"),
    ({'model': [OU], 'provenence': {}}, "'provenance'"), ({'model': [OU], 3: 1}, "entry '3'"),
    ({'model': None}, 'list of terms'), ({'model': OU}, 'list of terms'),
    ({'model': 'ou'}, 'list of terms'), ({'model': []}, "'ou', got no term at all"),
    ({'model': [SAG]}, "'ou', got 'load_sag'"), ({'model': [SAG, OU]}, "'ou', got 'load_sag'"),
    ({'model': [OU, OU]}, "one term 'ou', got 2"),
    ({'model': [OU, SAG, SAG]}, "one term 'load_sag', got 2"),
    ({'model': [OU], 'provenance': ['x']}, "'provenance'"),
    ({'model': [OU], 'provenance': 'x'}, "'provenance'"),
])
def test_a_malformed_model_file_is_refused(data, words):
    """Keys that are missing, misspelt, out of order or repeated are refused too."""
    assert words in failure(data)
