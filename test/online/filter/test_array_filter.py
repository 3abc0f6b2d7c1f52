"""Arrays through the low-pass: the samples one by one."""

import math

import numpy as np
from ou_monitor import AdaptiveLowPass
from ou_monitor.online.filter.filter_state import sound_piece
import pytest

N = 2500


def both(t, x, sigma, **options):
    """Return a filter that took an array, its output, and those of one that took samples."""
    many, single = AdaptiveLowPass(**options), AdaptiveLowPass(**options)
    y = many.filter(t, x, sigma, sigma_se=0.07)
    wide = np.broadcast_to(sigma, t.shape)
    z = np.array([single.filter(*map(float, row), sigma_se=0.07)
                  for row in zip(t, x, wide)])
    return many, y, single, z


def alike(many, y, single, z):
    """Tell whether output, state and what is told are the same to rounding."""
    assert np.array_equal(np.isnan(y), np.isnan(z))
    # Angles within 1e-9 of each other count as one.
    assert np.nanmax(np.abs(y - z)) < 2e-9 * max(np.nanmax(np.abs(z)), 1.0)
    assert many.counters == single.counters and many.bound == single.bound
    assert many.cutoff == pytest.approx(single.cutoff, rel=1e-12)
    assert many.wanted == pytest.approx(single.wanted, rel=1e-12, nan_ok=True)


@pytest.fixture(scope='module')
def samples():
    """Return stamps with jitter, a signal, and a sigma that changes 10 times a second."""
    rng = np.random.default_rng(3)
    t = np.cumsum(1e-3 * rng.uniform(0.5, 1.5, N))
    return t, rng.standard_normal(N) + 3.0, np.repeat(rng.uniform(0.1, 2.0, N // 100), 100)


@pytest.mark.parametrize('options', [
    {}, {'order': 1}, {'mode': 'derivative'}, {'mode': 'derivative', 'order': 1},
    {'slew': 0.0, 'dead_band': 0.0}, {'smoothing': 0.0}, {'smoothing': 0.0, 'slew': 0.0},
    {'law': 'threshold', 'slew': 40.0}, {'shadow': True}, {'coupling': 2.0},
    {'slew': 1.0, 'smoothing': 0.002}, {'law': 'wiener', 'n0': 1e-5}])
def test_an_array_is_its_samples(samples, options):
    """Laws, orders, modes, and every way in which the cutoff moves."""
    alike(*both(*samples, **options))


@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_even_stamps_and_one_sigma(samples, mode):
    """What is filtered by one biquad."""
    alike(*both(np.arange(N) * 1e-3, samples[1], 0.6, mode=mode))


@pytest.mark.parametrize('options', [{}, {'smoothing': 0.0, 'dead_band': 0.0, 'slew': 0.0}])
def test_a_new_sigma_at_each_sample(samples, options):
    """Known or not, with an error that changes as well, beyond the table and below sigma_ref."""
    t, x, _ = samples
    rng = np.random.default_rng(5)
    sigma = np.exp(rng.uniform(-3.0, 9.0, N))
    sigma[rng.random(N) < 0.01] = np.nan
    error = np.where(rng.random(N) < 0.1, np.nan, rng.uniform(0.01, 1.0, N))
    many, single = AdaptiveLowPass(**options), AdaptiveLowPass(**options)
    y = many.filter(t, x, sigma, sigma_se=error)
    z = np.array([single.step(*row) for row in zip(*(
        one.tolist() for one in (t, x, sigma, error)))])
    alike(many, y, single, z)


def test_throttle_and_a_rate_that_drifts(samples):
    """The law of that name over a mean interval that grows by half, and pieces of any size."""
    _, x, _ = samples
    rng = np.random.default_rng(6)
    t = np.cumsum(np.linspace(1e-3, 1.5e-3, N) * rng.uniform(0.6, 1.4, N))
    throttle = rng.uniform(0.0, 1.0, N)
    many, single = (AdaptiveLowPass(law='throttle') for _ in range(2))
    edges = [0, 700, 771, 1500, N]
    y = np.concatenate([many.filter(t[a:b], x[a:b], np.nan, throttle=throttle[a:b])
                        for a, b in zip(edges, edges[1:])])
    z = np.array([single.filter(float(a), float(b), np.nan, throttle=float(c))
                  for a, b, c in zip(t, x, throttle)])
    alike(many, y, single, z)


def test_odd_samples(samples):
    """A gap, a repeat, NaN, a step back, a new rate, sigma unknown."""
    t, x, sigma = (one.copy() for one in samples)
    t[800:] += 2.0
    t[1000] = t[999]
    x[1200] = np.nan
    t[1500] = t[1490]
    t[2000:] += np.arange(500) * 3e-3
    sigma[300:600] = np.nan
    alike(*both(t, x, sigma))


def test_a_change_of_parameters_between_arrays(samples):
    """What is still being smoothed over fades in an array as it does in samples."""
    t, x, _ = samples
    filters = [AdaptiveLowPass(), AdaptiveLowPass()]
    for one in filters:
        one.filter(t[:1000], x[:1000], 0.3)
        one.configure(shadow=True)
    y = filters[0].filter(t[1000:], x[1000:], 0.3)
    z = [filters[1].step(float(a), float(b), 0.3) for a, b in zip(t[1000:], x[1000:])]
    assert np.max(np.abs(y - z)) < 1e-12


@pytest.mark.parametrize('place, change, sound', [
    (30, {}, 60), (30, {'dt': 4.9e-3}, 60), (30, {'dt': 6e-3}, 30), (30, {'dt': 0.21e-3}, 60),
    (30, {'dt': 0.19e-3}, 30), (0, {'dt': 6e-3}, 0), (30, {'x': math.nan}, 30),
    (30, {'x': 2e6}, 30), (0, {'x': math.inf}, 0), (30, {'t': math.nan}, 30)])
def test_samples_that_are_sound_together(place, change, sound):
    """Up to the first of another interval, by a factor of five of the mean, or of no number."""
    dt, x = np.full(60, 1e-3), np.ones(60)
    dt[place] = change.get('dt', 1e-3)
    t = 7.0 + np.cumsum(dt)
    x[place], t[place] = change.get('x', 1.0), change.get('t', t[place])
    piece = sound_piece(t, x, 7.0, 1e-3, (1e6, 1e9, 1e-6))
    assert piece[0] == sound and piece[1].size == piece[2].size == sound
    assert np.allclose(piece[1], dt[:sound])
    # The mean interval forgets over a hundred.
    mean = 1e-3
    for step, told in zip(piece[1], piece[2]):
        mean += (step - mean) / 100.0
        assert told == pytest.approx(mean, rel=1e-9)
