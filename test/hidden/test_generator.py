"""The generator of hidden effects: interface, the plain rail, seeds, and its fine grid."""

import json

from hidden_effects import causes, compatible, draw, KINDS, labels, pairs, unknowns, variants
from hidden_measures import band, correlation, largest, signs, whitened
import numpy as np
import pytest
from scipy.stats import chi2

# About fifty scores on one recording: P(max |z| > 5) is below 1e-4 for normal ones, and e^-5
# for the largest line, which is why that has a limit of its own.
QUIET = 5.0


def simulated(kind, cause=None, seed=0, **options):
    return draw(kind, np.random.default_rng(seed), cause=cause, **options)


def test_all_causes_shapes_and_pairs_are_there():
    assert len(causes()) == 23 and set(causes()) == set(labels)
    assert {name.partition('/')[0] for name in variants()} <= set(causes())
    assert len(variants()) >= 30 and len(unknowns()) >= 8
    assert {c for pair in pairs() for c in pair} == set(causes())
    assert all(compatible(b, a) for a, b in pairs())
    assert not compatible('tone', 'tone')


ALL = ([('none', None)] + [('single', c) for c in causes()] + [('variant', c) for c in variants()]
       + [('unknown', c) for c in unknowns()])


@pytest.mark.parametrize('kind, cause', ALL)
def test_every_effect_is_a_sound_recording(kind, cause):
    """Shapes, order and range hold; names and families are those of the catalogue."""
    h = simulated(kind, cause, duration=5.0, rate=500.0)
    assert h.kind == kind and h.name == (cause or 'none')
    assert h.t.shape == h.voltage.shape == h.throttle.shape == (2500,)
    assert np.all(np.isfinite(h.voltage)) and np.all(np.diff(h.t) > 0)
    assert h.throttle.min() >= 0 and h.throttle.max() <= 1
    assert h.families == tuple(labels[name] for name in h.truth)
    assert bool(h.truth) == (kind in ('single', 'variant'))
    assert h.accepted[0] == h.truth and all(set(a) <= set(labels) for a in h.accepted)
    assert set(h.near) <= set(labels) and bool(h.near) == (kind == 'unknown')
    if kind == 'single':
        # A transient comes with its sag; all others come alone.
        company = {'load_sag'} if cause == 'load_transient' else set()
        assert set(h.truth) == {cause} | company
    if kind == 'variant':
        assert cause.partition('/')[0] in h.truth


def test_every_pair_can_be_drawn():
    """Two effects do not overwrite each other's part of the bench."""
    for first, second in pairs():
        h = simulated('pair', (first, second), duration=2.0, rate=200.0)
        assert {first, second} <= set(h.truth) and np.all(np.isfinite(h.voltage))
        assert {first, second, 'rail'} == set(h.detail)
        assert json.loads(json.dumps(h.detail)) == h.detail


@pytest.mark.parametrize('kind, cause', [
    ('none', None), ('single', None), ('pair', None), ('variant', None), ('unknown', None)])
def test_seeds_reproduce_and_draws_differ(kind, cause):
    """One seed is one recording; the next draw is another rail, flight and effect."""
    rng = np.random.default_rng(7)
    first = simulated(kind, cause, 7, duration=3.0)
    again = draw(kind, rng, cause=cause, duration=3.0)
    assert np.array_equal(first.voltage, again.voltage)
    assert np.array_equal(first.t, again.t) and np.array_equal(first.throttle, again.throttle)
    assert first.detail == again.detail and first.name == again.name
    others = [draw(kind, rng, cause=cause, duration=3.0) for _ in range(6)]
    assert len({h.detail['rail']['alpha'] for h in (first, *others)}) == 7
    assert len({h.throttle.std() for h in (first, *others)}) == 7
    assert kind == 'none' or len({h.name for h in (first, *others)}) > 1


def test_draws_fill_their_ranges():
    """Rails span the decade and more that real ones do, and flights always move."""
    many = [simulated('none', seed=s, duration=20.0, rate=100.0) for s in range(60)]
    for key, low, high in (('alpha', 20, 120), ('level_v', 3.3, 25)):
        values = np.array([h.detail['rail'][key] for h in many])
        assert low <= values.min() < low * (high / low)**0.15
        assert low * (high / low)**0.85 < values.max() <= high
    rails = [h.detail['rail'] for h in many]
    at_1_khz = np.array([r['sigma'] * np.sqrt((1 - np.exp(-2e-3 * r['alpha'])) / (2 * r['alpha']))
                         for r in rails])
    assert 5e-3 <= at_1_khz.min() < 7e-3 and 25e-3 < at_1_khz.max() <= 30e-3
    for r in rails:
        assert r['alpha'] == pytest.approx(1 / (r['resistance_ohm'] * r['capacitance_f']))
        assert r['sigma'] == pytest.approx(r['noise_current_a_sqrt_s'] / r['capacitance_f'])
    assert min(h.throttle.std() for h in many) > 0.07
    assert {piece for r in rails for piece in r['throttle']} == {
        'hover', 'mission', 'aggressive', 'chirp', 'constant'}


def test_a_plain_rail_is_a_clean_ou():
    """A plain rail has alpha = 1/(RC), its sigma, and residuals white, normal and unmoved."""
    for seed in range(3):
        h = simulated('none', seed=seed)
        rail, n = h.detail['rail'], h.t.size - 1
        x = h.voltage - h.voltage.mean()
        phi = (x[1:] @ x[:-1]) / (x[:-1] @ x[:-1])
        error = np.sqrt((1 - phi**2) / n) * 1000 / phi
        # The bias of a rate whose mean is fitted, 4/T (Tang & Chen 2009).
        assert abs(-1000 * np.log(phi) - 4 / 60 - rail['alpha']) < 4 * error
        assert error < 0.1 * rail['alpha']
        e = x[1:] - phi * x[:-1]
        assert abs(e.std() / rail['innovation_v'] - 1) < 4 / np.sqrt(2 * n)
        acf = np.array([correlation(e[k:], e[:-k]) for k in range(1, 31)])
        assert 1e-4 < chi2.sf(acf @ acf, 29) < 1 - 1e-4
        z = signs(h)
        assert z.pop('line') < 12 and largest(z)[0] < QUIET, (seed, z)


WEAKEST = {'line': 12.0}


# Alpha over throttle is too fine for plain averages; its size is tested.
@pytest.mark.parametrize('kind, cause', [
    (k, c) for k, c in ALL if k != 'none' and not c.startswith('load_dependent_alpha')])
def test_every_effect_leaves_a_sign(kind, cause):
    """Each leaves a sign beyond what a plain rail ever shows, in some simple average."""
    z = signs(simulated(kind, cause, seed=1))
    assert any(abs(value) > WEAKEST.get(name, QUIET) for name, value in z.items()), z


def _moments(h):
    """Return innovation variance, lag-1 product, fourth moment, slow variance, log peak."""
    e = whitened(h)
    # Where a line is, if there is one: the bilinear rule moves it when the step is long.
    at = h.detail.get('resonance', {}).get('frequency_hz', 100.0)
    slow = e[:e.size // 100 * 100].reshape(-1, 100).mean(axis=1) * 10
    return np.array([np.mean(e**2), np.mean(e[1:] * e[:-1]), np.mean(e**4), np.mean(slow**2),
                     np.log(band(h, at - 3, at + 3))])


@pytest.mark.parametrize('cause, one_step_is_too_coarse', [
    (None, False), ('load_dependent_alpha', False), ('nonlinear_restoring', False),
    ('load_transient', False), ('second_relaxation', False), ('held_samples', False),
    ('resonance', True), ('clock_jitter', True)])
def test_the_fine_grid_has_converged(cause, one_step_is_too_coarse):
    kind = 'single' if cause else 'none'

    def moments(substeps):
        return np.array([_moments(simulated(kind, cause, seed, duration=10.0, substeps=substeps))
                         for seed in range(12)])
    used = simulated(kind, cause, duration=1.0).detail['rail']['substeps']
    base = moments(used)

    def shift(substeps):
        # The components are the same and the noise is another: paired by rail. The limit is
        # that of Student's t of 11 degrees of freedom at 0.05 %.
        moved = moments(substeps) - base
        return np.abs(moved.mean(axis=0)), moved.std(axis=0, ddof=1) / np.sqrt(len(moved))
    moved, error = shift(2 * used)
    assert np.all(moved < 5.0 * error)
    # Where the step matters, this test would see it, by the same error.
    assert not one_step_is_too_coarse or np.max(shift(1)[0] / error) > 5.0


@pytest.mark.parametrize('kind, options, words', [
    ('double', {}, "'double'"), ('single', {'cause': 'gremlins'}, 'gremlins'),
    ('none', {'cause': 'tone'}, 'hides nothing'),
    ('pair', {'cause': ('load_sag', 'load_transient')}, 'compatible'),
    ('pair', {'cause': 'tone'}, 'compatible'), ('single', {'rate': 0.0}, 'positive'),
    ('single', {'strength': -1.0}, 'positive'), ('single', {'duration': 0.01}, 'at least 100')])
def test_effects_that_cannot_be_drawn_are_refused(kind, options, words):
    with pytest.raises(ValueError, match=words):
        simulated(kind, **options)


def test_a_cause_selects_its_shapes():
    assert simulated('variant', 'drift', duration=2.0).truth == ('drift',)
    assert simulated('variant', 'lc_rail', duration=2.0).name == 'resonance/lc_rail'
    assert simulated('unknown', 'sawtooth', duration=2.0).name == 'unknown/sawtooth'
    assert {'single', 'pair', 'none', 'variant', 'unknown'} == set(KINDS)
