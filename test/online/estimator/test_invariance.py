"""Estimates do not depend on the origin of time or on the pieces in which samples come."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
import pytest
from scipy.signal import lfilter

N, DT = 2400, 1e-3
NAMES = ('alpha', 'sigma', 'var_inf', 'u0', 'noise_std', 'alpha_se', 'sigma_se', 'u0_se', 'n',
         'throttle')


def flight(seed=1):
    """Return stamps, voltage and throttle that steps, rests, is unknown and comes back."""
    rng = np.random.default_rng(seed)
    t = np.arange(N) * DT
    u = np.repeat(rng.random(12), 200)
    u[1000:1400] = 0.4
    u[1700:1800] = math.nan
    u[2100:] = 0.6
    kicks = 0.632 * math.sqrt(DT) * rng.standard_normal(N)
    noise = lfilter([1.0], [1.0, -math.exp(-63.0 * DT)], kicks)
    return t, 5.0 - 0.2 * np.where(np.isnan(u), 0.4, u) + noise, u


KINDS = {
    'plain': lambda t, v, u: (t, v, None), 'throttle': lambda t, v, u: (t, v, u),
    'resting': lambda t, v, u: (t, v, np.where(t < 1.0, u, 0.4)),
    'gap': lambda t, v, u: (t + 0.4 * (t > 1.3), v, u),
    'coarser': lambda t, v, u: (t, v + 0.03 * np.random.default_rng(2).standard_normal(N), u),
    'held': lambda t, v, u: (t, np.repeat(v[::4], 4), u),
    'some': lambda t, v, u: tuple(x[np.random.default_rng(3).random(N) < 0.7] for x in (t, v, u))}


def looks(t, v, u, pieces, window=0.9, shift=0.0):
    """Return estimates at the same four times, samples given in pieces."""
    estimator, found = SlidingEstimator(window), []
    edges = sorted({*pieces, *(round(k * t.size / 4) for k in range(1, 5))})
    begin = 0
    for end in edges:
        part = slice(begin, end)
        estimator.push(t[part] + shift, v[part], None if u is None else u[part])
        if end in {round(k * t.size / 4) for k in range(1, 5)}:
            e = estimator.estimate()
            found.append([getattr(e, name) for name in NAMES] + [e.t - shift])
        begin = end
    return np.array(found, dtype=float)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('shift', (4096.0, -512.0))
def test_where_time_begins_does_not_matter(kind, shift):
    """Shifts by powers of two round stamps of milliseconds by 1e-13 s."""
    made = KINDS[kind](*flight())
    pieces = range(0, N, 150)
    np.testing.assert_allclose(looks(*made, pieces, shift=shift), looks(*made, pieces), rtol=1e-5,
                               atol=1e-7)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('seed', range(3))
def test_pieces_do_not_matter(kind, seed):
    """Of any size, down to single samples: as the quarters at once."""
    made = KINDS[kind](*flight(seed))
    n = made[0].size
    rng = np.random.default_rng(seed)
    pieces = [k for k in np.cumsum(rng.choice([1, 1, 2, 7, 60, 201], 400)) if k < n]
    np.testing.assert_allclose(looks(*made, pieces), looks(*made, []), rtol=1e-6, atol=1e-9)
