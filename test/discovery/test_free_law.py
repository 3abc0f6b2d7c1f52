"""A latent law of the noise must show beside any law of throttle, not only beside the usual."""

import numpy as np
from ou_monitor import discover, Recording
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.free_law import free_law
import pytest
from scipy.signal import lfilter

RATE, N = 100.0, 6000


def flown(seed):
    """Return stamps and a throttle that moves within seconds."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-1.0 / (0.6 * RATE))
    path = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(N))
    return np.arange(N) / RATE, 1.0 / (1.0 + np.exp(-1.3 * path))


# Forms that no law of the catalogue has.
FORMS = {
    'hump': lambda u: 1.2 * np.exp(-np.square((u - 0.5) / 0.12)),
    'recent rises': lambda u: 1.0 * lfilter(
        [1.0], [1.0, -np.exp(-1.0 / (0.5 * RATE))], np.maximum(np.diff(u, prepend=u[0]), 0.0)),
    'half a second ago': lambda u: 2.0 * (np.roll(u, 50) - u)}


@pytest.mark.parametrize('form', FORMS)
def test_a_law_of_throttle_in_another_form_is_found(form):
    """Of the gain of the truth more than half."""
    rng = np.random.default_rng(1)
    t, u = flown(2)
    log = 2.0 * FORMS[form](u)
    log -= np.log(np.exp(log).mean())
    z = np.exp(0.5 * log) * rng.standard_normal(N)
    found = free_law(Samples(t, u, u), z)

    def gain(log):
        return -0.5 * float(np.sum(log + z * z * np.expm1(-log)))

    assert gain(found) > 0.5 * gain(log) > 50.0


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('wanders', [0.0, 0.6])
def test_what_throttle_has_no_part_in_is_no_law_of_it(seed, wanders):
    """Nor is an intensity that wanders over seconds, as throttle does."""
    rng = np.random.default_rng(seed)
    t, u = flown(10 + seed)
    keep = np.exp(-1.0 / (3.0 * RATE))
    log = lfilter([np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(N))
    z = np.exp(wanders * log) * rng.standard_normal(N)
    assert free_law(Samples(t, u, u), z) is None


def test_throttle_that_rests_says_nothing():
    """Nor does none."""
    z, t = np.random.default_rng(3).standard_normal(N), np.arange(N) / RATE
    assert free_law(Samples(t, z, None), z) is None
    assert free_law(Samples(t, z, np.full(N, 0.4)), z) is None


def test_another_form_of_the_measured_law_is_no_latent_one():
    """White noise where throttle has moved in the last half second: no wandering, no tails."""
    rng = np.random.default_rng(4)
    t, u = flown(5)
    moved = lfilter([1.0], [1.0, -np.exp(-1.0 / (0.3 * RATE))], np.abs(np.diff(u, prepend=u[0])))
    v = 16.0 - 1.2 * u + 0.01 * np.exp(
        1.2 * np.sqrt(moved / moved.mean()) - 1.2) * rng.standard_normal(N)
    names = {cause.name for cause in discover(Recording(t, v, u)).causes}
    assert 'load_sag' in names
    assert not names & {'volatility', 'heavy_tails', 'jumps', 'glitches', 'regime_switching'}
