"""Properties of all terms: names, parameters, messages, and independence of pieces."""

import math

import numpy as np
from ou_monitor.model.supply import Simulation, SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
import pytest
from term_examples import EXAMPLES, OU, still, supply, term

# Typed by hand from the table of causes, so that a renamed term is a broken promise.
FAMILIES = {
    'load_sag': 'load', 'load_transient': 'load', 'load_dependent_sigma': 'intensity',
    'load_dependent_noise': 'intensity',
    'load_dependent_alpha': 'restoring', 'drift': 'slow', 'measurement_noise': 'sensor',
    'quantization': 'sensor', 'held_samples': 'sensor', 'saturation': 'sensor',
    'second_relaxation': 'slow', 'resonance': 'line', 'tone': 'line', 'throttle_tone': 'line',
    'ac_coupling': 'instrument', 'jumps': 'events', 'heavy_tails': 'events',
    'lopsided_noise': 'events',
    'glitches': 'events', 'regime_switching': 'switching', 'volatility': 'intensity',
    'nonlinear_restoring': 'restoring', 'flicker_noise': 'slow', 'clock_jitter': 'sensor',
}
THROTTLED = {'load_sag', 'load_transient', 'load_dependent_sigma', 'load_dependent_alpha',
             'load_dependent_noise', 'throttle_tone'}
# What is out of range, and what the message must say.
OUT_OF_RANGE = [
    ('ou', 'alpha', 0.0, 'above 0 1/s'), ('ou', 'alpha', -1.0, 'above 0 1/s'),
    ('ou', 'sigma', -0.1, 'at least 0 V/sqrt(s)'),
    ('load_transient', 'tau', 0.0, 'above 0 s'), ('load_transient', 'delay', -0.1, 'at least 0 s'),
    ('measurement_noise', 'std', -1e-3, 'at least 0 V'),
    ('lopsided_noise', 'tail', 0.0, 'above 0'), ('quantization', 'step', 0.0, 'above 0 V'),
    ('held_samples', 'rate', 0.0, 'above 0 Hz'),
    ('second_relaxation', 'alpha', 0.0, 'above 0 1/s'),
    ('second_relaxation', 'sigma', -1.0, 'at least 0 V/sqrt(s)'),
    ('resonance', 'frequency', 0.0, 'above 0 Hz'), ('resonance', 'damping', 0.0, 'above 0 1/s'),
    ('resonance', 'std', -1.0, 'at least 0 V'), ('tone', 'amplitude', -1.0, 'at least 0 V'),
    ('tone', 'frequency', 0.0, 'above 0 Hz'), ('tone', 'linewidth', -1.0, 'at least 0 Hz'),
    ('throttle_tone', 'amplitude', -1.0, 'at least 0 V'),
    ('ac_coupling', 'corner', 0.0, 'above 0 Hz'),
    ('jumps', 'rate', -1.0, 'at least 0 1/s'), ('jumps', 'std', -1.0, 'at least 0 V'),
    ('heavy_tails', 'dof', 2.0, 'above 2'), ('glitches', 'probability', 1.5, 'at most 1'),
    ('glitches', 'probability', -0.1, 'at least 0'), ('glitches', 'std', -1.0, 'at least 0 V'),
    ('regime_switching', 'rate_up', 0.0, 'above 0 1/s'),
    ('regime_switching', 'rate_down', 0.0, 'above 0 1/s'),
    ('regime_switching', 'sigma_ratio', -1.0, 'at least 0'),
    ('volatility', 'std', -1.0, 'at least 0'), ('volatility', 'rate', 0.0, 'above 0 1/s'),
    ('nonlinear_restoring', 'cube', -1.0, 'at least 0 1/(V^2 s)'),
    ('flicker_noise', 'amplitude', -1.0, 'at least 0 V'),
    ('flicker_noise', 'low', 0.0, 'above 0 Hz'), ('flicker_noise', 'high', 0.0, 'above 0 Hz'),
    ('clock_jitter', 'std', -1.0, 'at least 0 s'),
]
NEUTRAL = {
    'load_sag': {'linear': 0.0, 'square': 0.0},
    'load_transient': {'gain': 0.0, 'tau': 0.03, 'delay': 0.01},
    'load_dependent_sigma': {'throttle': [0.3], 'log_factor': [0.0]},
    'load_dependent_noise': {'number': [], 'at': [], 'log_factor': []},
    'load_dependent_alpha': {'slope': 0.0}, 'drift': {'rate': 0.0, 'curvature': 0.0},
    'measurement_noise': {'std': 0.0}, 'lopsided_noise': {'skew': 0.0, 'tail': 1.0},
    'quantization': {'step': 1e-12},
    'held_samples': {'rate': 1000.0}, 'saturation': {'low': -100.0, 'high': 100.0},
    'second_relaxation': {'alpha': 4.0, 'sigma': 0.0},
    'resonance': {'frequency': 120.0, 'damping': 40.0, 'std': 0.0,
                  'tilt': 0.0},
    'tone': {'amplitude': 0.0, 'frequency': 50.0, 'phase': 0.4, 'linewidth': 2.0},
    'throttle_tone': {
        'amplitude': 0.0, 'idle': 20.0, 'slope': 300.0, 'phase': 0.1, 'linewidth': 0.0},
    'jumps': {'rate': 0.0, 'mean': 1.0, 'std': 1.0},
    'glitches': {'probability': 0.0, 'std': 0.3},
    'regime_switching': {'rate_up': 20.0, 'rate_down': 50.0, 'level': 0.0, 'sigma_ratio': 1.0,
                         'at_once': 1.0,
                         'states': 2.0},
    'volatility': {'std': 0.0, 'rate': 5.0}, 'nonlinear_restoring': {'square': 0.0, 'cube': 0.0},
    'flicker_noise': {'amplitude': 0.0, 'low': 0.5, 'high': 200.0}, 'clock_jitter': {'std': 0.0},
}
EACH = sorted(EXAMPLES)
OTHERS = [name for name in EACH if name != 'ou']


def stamps(n=1500, uneven=False):
    """Return stamps at 1 kHz, or random ones with the same mean spacing."""
    if uneven:
        return 7.0 + np.cumsum(np.random.default_rng(9).exponential(1e-3, n))
    return 7.0 + np.arange(n) / 1000.0


def throttle(t):
    return np.where((t - 7.0) % 0.5 < 0.2, 0.1, 0.2 + 0.5 * ((t - 7.0) % 0.5))


def test_the_catalogue_has_the_causes_of_the_contract():
    """The 23 causes of the contract, one more, and the `ou` ahead of them; nothing else."""
    assert len(FAMILIES) == 24
    assert list(catalogue())[0] == 'ou' and set(catalogue()) == {'ou', *FAMILIES}
    assert {n: c.FAMILY for n, c in catalogue().items() if n != 'ou'} == FAMILIES
    assert {n for n, c in catalogue().items() if c.NEEDS_THROTTLE} == THROTTLED
    assert set(EXAMPLES) == set(catalogue()) and set(NEUTRAL) | {'ou', 'ac_coupling',
                                                                 'heavy_tails'} == set(EXAMPLES)


@pytest.mark.parametrize('name', EACH)
def test_values_and_read_are_inverse(name):
    """Every parameter by name, in plain types; numpy numbers and integers are taken."""
    cls = catalogue()[name]
    made = cls.read(EXAMPLES[name])
    assert made.values() == EXAMPLES[name] and cls.read(made.values()) == made
    assert cls.parameters() == tuple(EXAMPLES[name])
    flat = {k: np.float64(v) if not isinstance(v, list) else tuple(np.array(v))
            for k, v in EXAMPLES[name].items()}
    assert cls.read(flat) == made and cls(**flat) == made
    assert all(type(v) in (float, list) for v in made.values().values())


@pytest.mark.parametrize('name', EACH)
def test_missing_and_unknown_parameters_are_named(name):
    cls, params = catalogue()[name], EXAMPLES[name]
    for key in params.keys() - cls.usual().keys():
        with pytest.raises(ValueError, match=f"'{name}' lacks '{key}'"):
            cls.read({k: v for k, v in params.items() if k != key})
    with pytest.raises(ValueError, match=f"'{name}' has no parameter 'wobble'") as caught:
        cls.read({**params, 'wobble': 1.0})
    assert all(f"'{key}'" in str(caught.value) for key in params)


@pytest.mark.parametrize('name', EACH)
def test_parameters_that_are_not_finite_numbers_are_refused(name):
    """The message names term and parameter, whatever was given."""
    for key in (key for key, value in EXAMPLES[name].items() if not isinstance(value, list)):
        for value in (math.nan, math.inf, -math.inf, 'x', '5', True, None, [1.0], 1j, 10 ** 400):
            with pytest.raises(ValueError, match=rf'^{name}\.{key} must be (a number|finite)'):
                term(name, **{**EXAMPLES[name], key: value})


@pytest.mark.parametrize('key', ['throttle', 'log_factor'])
@pytest.mark.parametrize('value', [0.5, 'abc', None, [0.0, math.nan, 1.0], [0.0, '1', 2.0]],
                         ids=repr)
def test_lists_hold_finite_numbers(key, value):
    with pytest.raises(ValueError, match=rf'^load_dependent_sigma\.{key} must be'):
        term('load_dependent_sigma', **{**EXAMPLES['load_dependent_sigma'], key: value})


@pytest.mark.parametrize('name, key, value, words', OUT_OF_RANGE)
def test_out_of_range_is_refused_with_the_unit(name, key, value, words):
    with pytest.raises(ValueError) as caught:
        term(name, **{**EXAMPLES[name], key: value})
    text = str(caught.value)
    assert text.startswith(f'{name}.{key} must be ') and words in text
    assert text.endswith(f'got {value:g}')


@pytest.mark.parametrize('name, change, words', [
    ('saturation', {'low': 5.1}, 'low must be below high'),
    ('flicker_noise', {'high': 0.5}, 'low must be below high'),
    ('load_dependent_sigma', {'throttle': [0.0, 1.0]}, 'same number'),
    ('load_dependent_sigma', {'throttle': [], 'log_factor': []}, 'same number'),
    ('load_dependent_sigma', {'throttle': [0.0, 1.0, 0.4]}, 'must rise'),
    ('load_dependent_sigma', {'throttle': [0.0, 0.4, 0.4]}, 'must rise'),
    ('nonlinear_restoring', {'cube': 0.0}, 'diverges'),
])
def test_contradictory_parameters_are_refused(name, change, words):
    with pytest.raises(ValueError, match=words) as caught:
        term(name, **{**EXAMPLES[name], **change})
    assert str(caught.value).startswith(name)


@pytest.mark.parametrize('uneven', [False, True], ids=['even', 'uneven'])
@pytest.mark.parametrize('name', EACH)
def test_samples_do_not_depend_on_the_segments(name, uneven):
    """Random cuts, many of them one sample long: the same to 1e-9 V, in one piece or many."""
    t = stamps(uneven=uneven)
    model = supply() if name == 'ou' else supply(term(name, **EXAMPLES[name]))
    whole = model.simulate(t, np.random.default_rng(4), throttle(t))
    rng = np.random.default_rng(2)
    run, parts, begin = Simulation(model, np.random.default_rng(4)), [], 0
    while begin < t.size:
        part = slice(begin, begin + int(rng.choice([1, 1, 2, 3, 40, 300])))
        parts.append(run.advance(t[part], throttle(t[part])))
        begin = part.stop
    assert len(parts) > 15 and sum(p.size == 1 for p in parts) > 3
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=0, atol=1e-9)
    other = model.simulate(t, np.random.default_rng(5), throttle(t))
    assert np.ptp(whole) > 0 and np.any(other != whole)


@pytest.mark.parametrize('name', OTHERS)
def test_ordinary_parameters_change_the_samples(name):
    t = stamps()
    needed = catalogue()[name].CHANGES
    beside = () if needed is None else (term(needed.NAME, **EXAMPLES[needed.NAME]),)
    plain = supply(*beside).simulate(t, np.random.default_rng(4), throttle(t))
    changed = supply(*beside, term(name, **EXAMPLES[name])).simulate(
        t, np.random.default_rng(4), throttle(t))
    assert np.abs(changed - plain).max() > 1e-3


@pytest.mark.parametrize('name', sorted(NEUTRAL))
def test_neutral_parameters_change_nothing(name):
    """To rounding: zero amplitude, no jumps, rails far away, codes of 1 pV."""
    t = stamps()
    plain = supply().simulate(t, np.random.default_rng(4), throttle(t))
    same = supply(term(name, **NEUTRAL[name])).simulate(t, np.random.default_rng(4), throttle(t))
    np.testing.assert_allclose(same, plain, rtol=0, atol=2e-12)


def test_terms_without_a_neutral_value_have_a_limit():
    """A corner far below takes away the level alone; many degrees of freedom are normal."""
    t = stamps()
    plain = supply().simulate(t, np.random.default_rng(4))
    coupled = supply(term('ac_coupling', corner=1e-9, offset=0.0)).simulate(
        t, np.random.default_rng(4))
    np.testing.assert_allclose(coupled, plain - 5.0, rtol=0, atol=1e-4)
    # The factor on the variance scatters by sqrt(2/dof) = 1.4e-5.
    tails = supply(term('heavy_tails', dof=1e10)).simulate(t, np.random.default_rng(4))
    np.testing.assert_allclose(tails, plain, rtol=0, atol=1e-4 * np.abs(plain - 5.0).max())


@pytest.mark.parametrize('name', [
    'load_sag', 'load_transient', 'drift', 'measurement_noise', 'second_relaxation', 'resonance',
    'tone', 'throttle_tone', 'flicker_noise', 'glitches', 'jumps'])
def test_a_term_of_the_level_leaves_other_draws_unchanged(name):
    t = stamps()
    added = term(name, **EXAMPLES[name])
    # Volatility multiplies the white noise.
    others = [term(n, **EXAMPLES[n]) for n in ('jumps', 'volatility', 'measurement_noise', 'tone')
              if n != name and (n, name) != ('volatility', 'measurement_noise')]
    alone = still(added).simulate(t, np.random.default_rng(4), throttle(t))
    for base in ([], others):
        without = supply(*base).simulate(t, np.random.default_rng(4), throttle(t))
        together = supply(added, *base).simulate(t, np.random.default_rng(4), throttle(t))
        np.testing.assert_allclose(together, without + alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize('name', sorted(THROTTLED))
def test_terms_of_throttle_ask_for_it(name):
    t = stamps(20)
    model = SupplyModel((term('ou', **OU), term(name, **EXAMPLES[name])))
    assert model.needs_throttle == (name,)
    with pytest.raises(ValueError, match=f"'{name}' needs throttle"):
        model.simulate(t, np.random.default_rng(0))
    with pytest.raises(ValueError, match=f"'{name}' needs throttle at every sample"):
        model.simulate(t, np.random.default_rng(0), np.where(t > t[4], 0.3, np.nan))
