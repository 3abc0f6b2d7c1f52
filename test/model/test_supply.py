"""A supply as a sum of terms: valid models, stamps, throttle, seeds, memory."""

import math
import tracemalloc

import numpy as np
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel
from ou_monitor.model.terms.catalogue import catalogue
import pytest
from term_examples import agrees, EXAMPLES, OU, supply, term

T = np.arange(300) / 1000.0


def test_the_ou_comes_first():
    with pytest.raises(ValueError, match="must be 'ou', got no term at all"):
        SupplyModel(())
    with pytest.raises(ValueError, match="must be 'ou', got 'drift'"):
        SupplyModel((term('drift', **EXAMPLES['drift']), term('ou', **OU)))
    with pytest.raises(ValueError, match="one term 'ou', got 2"):
        SupplyModel((term('ou', **OU), term('ou', **OU)))


@pytest.mark.parametrize('name', sorted(EXAMPLES))
def test_terms_that_may_occur_once_are_refused_twice(name):
    """Lines, poles and events can be there several times; the others once."""
    if name == 'ou':
        return
    several = {'tone', 'throttle_tone', 'second_relaxation', 'resonance', 'load_transient',
               'jumps', 'glitches', 'regime_switching', 'ac_coupling'}
    assert catalogue()[name].SEVERAL == (name in several)
    twice = [term(name, **EXAMPLES[name])] * 2
    if name in several:
        assert supply(*twice).simulate(T, np.random.default_rng(0), 0.3).shape == T.shape
    else:
        with pytest.raises(ValueError, match=f"one term '{name}', got 2"):
            supply(*twice)


def test_two_of_one_kind_draw_apart():
    """Two equal relaxations have twice the variance of one, not four times."""
    one = term('second_relaxation', alpha=50.0, sigma=1.0)
    n = 50_000
    x = supply(one, one, sigma=0.0, u0=0.0).simulate(
        np.arange(n) * 0.2, np.random.default_rng(1))
    agrees(np.mean(x * x), 0.02, 0.02 * math.sqrt(2.0 / n))


def test_the_order_of_terms_does_not_matter():
    """Stages do: the same samples from either order of different terms."""
    names = ['flicker_noise', 'jumps', 'ac_coupling', 'measurement_noise', 'volatility',
             'quantization', 'clock_jitter', 'tone']
    terms = [term(name, **EXAMPLES[name]) for name in names]
    one = supply(*terms).simulate(T, np.random.default_rng(2))
    other = supply(*terms[::-1]).simulate(T, np.random.default_rng(2))
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)


def test_all_terms_together_give_finite_samples():
    model = supply(*(term(name, **EXAMPLES[name]) for name in EXAMPLES if name != 'ou'))
    load = 0.3 + 0.2 * np.sin(40.0 * T)
    whole = model.simulate(T, np.random.default_rng(3), load)
    run = Simulation(model, np.random.default_rng(3))
    cuts = [0, 1, 2, 3, 50, 51, 120, 300]
    parts = [run.advance(T[a:b], load[a:b]) for a, b in zip(cuts, cuts[1:])]
    assert np.isfinite(whole).all() and set(model.needs_throttle) == {
        'load_sag', 'load_transient', 'drift', 'load_dependent_sigma', 'load_dependent_alpha',
        'load_dependent_noise', 'throttle_tone'}
    # Of codes of 10 mV, none is another.
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=0, atol=1e-9)


def test_long_recordings_are_made_in_segments():
    t = np.arange(SEGMENT + 1000) / 1e4
    whole = supply().simulate(t, np.random.default_rng(6))
    run = Simulation(supply(), np.random.default_rng(6))
    parts = [run.advance(t[:4_000]), run.advance(t[4_000:])]
    np.testing.assert_allclose(np.concatenate(parts), whole, rtol=0, atol=1e-9)


@pytest.mark.parametrize('t', [[0.0, 0.0], [1.0, 0.5], [0.0, math.nan], [0.0, math.inf]])
def test_stamps_that_do_not_rise_are_refused(t):
    """Refused, also when it is the next segment that goes back."""
    with pytest.raises(ValueError, match='finite and rise'):
        supply().simulate(t, np.random.default_rng(0))
    run = Simulation(supply(), np.random.default_rng(0))
    run.advance([0.0, 1.0])
    for later in (1.0, 0.5, math.nan):
        with pytest.raises(ValueError, match='finite and rise'):
            run.advance([later])


def test_stamps_and_throttle_are_one_row_each():
    """Stamps are one row; throttle has as many; nothing gives nothing."""
    run = Simulation(supply(), np.random.default_rng(0))
    with pytest.raises(ValueError, match=r'shape \(n,\)'):
        run.advance([[0.0, 1.0]])
    with pytest.raises(ValueError, match='shape of t'):
        run.advance([0.0, 1.0], [0.5])
    assert run.advance([]).shape == (0,) == supply().simulate([], np.random.default_rng(0)).shape
    assert run.advance([0.0]).shape == (1,)


def test_the_caller_keeps_his_arrays():
    """Stamps and throttle are not written to, nor do results share memory."""
    model = supply(*(term(name, **EXAMPLES[name]) for name in (
        'load_sag', 'load_dependent_alpha', 'clock_jitter', 'ac_coupling', 'saturation')))
    t, load = T.copy(), np.full(T.size, 0.4)
    t.flags.writeable = load.flags.writeable = False
    first = model.simulate(t, np.random.default_rng(0), load)
    np.testing.assert_array_equal(t, T)
    run = Simulation(model, np.random.default_rng(0))
    again = run.advance(t, load)
    kept = again.copy()
    run.advance(t + 1.0, load)
    np.testing.assert_array_equal(again, kept)
    np.testing.assert_allclose(first, again, rtol=0, atol=1e-12)


def test_throttle_may_be_unknown_if_no_term_needs_it():
    np.testing.assert_array_equal(
        supply().simulate(T, np.random.default_rng(1), math.nan),
        supply().simulate(T, np.random.default_rng(1)))


@pytest.mark.parametrize('name', ['jumps', 'clock_jitter', 'ac_coupling', 'load_transient',
                                  'heavy_tails'])
def test_memory_does_not_grow(name):
    """Forty segments of 20 000 samples take no more than the first three."""
    # One array of a segment is 160 kB; all samples would be 6 MB.
    run = Simulation(supply(term(name, **EXAMPLES[name])), np.random.default_rng(0))
    n, load = 20_000, np.full(20_000, 0.3)
    base = np.arange(n) / 1000.0
    tracemalloc.start()
    try:
        for k in range(3):
            run.advance(base + k * 20.0, load)
        early, first_peak = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for k in range(3, 40):
            run.advance(base + k * 20.0, load)
        late, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert late < early + 160_000 and peak < 1.2 * first_peak + 160_000
