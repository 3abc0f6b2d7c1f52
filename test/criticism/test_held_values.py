"""Held values, distinguished from codes equal by chance, from lines, and from rest."""

import numpy as np
from ou_monitor.criticism.adc import without_repeats
import pytest
from scipy.signal import lfilter

N, RATE, CODE = 12_000, 200.0, 0.5
T = np.arange(N) / RATE


def wander(seed, sd=1.0, phi=0.9):
    """Return an AR(1) of some deviation, in standard deviations of its own innovations at 1."""
    steps = np.random.default_rng(seed).standard_normal(N) * np.sqrt(1.0 - phi * phi)
    return sd * lfilter([1.0], [1.0, -phi], steps)


def coded(x, code=CODE):
    return code * np.round(x / code)


def left(v):
    return without_repeats(T, v, None)[1].size


def triangle(period, rise=0.15):
    """Return a wave of a fast and a slow flank, with values alike a period apart."""
    p = np.mod(np.arange(N) / period, 1.0)
    return np.where(p < rise, 1.0 - 2.0 * p / rise, 2.0 * (p - rise) / (1.0 - rise) - 1.0)


SIGNALS = {
    'a triangle': lambda s: wander(s) + 4.0 * triangle(14.9),
    'a square': lambda s: wander(s) + 3.0 * np.sign(np.sin(2.0 * np.pi * T * 13.4 + s)),
    'a sine': lambda s: wander(s) + 3.0 * np.sin(2.0 * np.pi * T * 13.4 + s),
    'values held under noise': lambda s: np.repeat(wander(s)[::5], 5)
    + 0.4 * np.random.default_rng(s + 100).standard_normal(N),
    'calm phases': lambda s: wander(s) * np.exp(wander(s + 100, phi=0.999)),
}


@pytest.mark.parametrize('signal', SIGNALS)
def test_codes_of_any_signal_hold_nothing(signal):
    """Whatever line, slope or change of intensity makes values alike."""
    for seed in range(6):
        v = coded(SIGNALS[signal](seed))
        assert np.mean(v[1:] == v[:-1]) > 0.05 and left(v) == N


@pytest.mark.parametrize('line', [0.0, 2.0])
def test_values_held_are_found_beside_a_line(line):
    """Three of ten, at random: all ties go, as always."""
    keep = np.random.default_rng(5).random(N) > 0.3
    keep[0] = True
    x = wander(3) + line * np.sin(2.0 * np.pi * T * 13.4)
    v = coded(x, 0.2)[np.maximum.accumulate(np.where(keep, np.arange(N), 0))]
    assert left(v) == 1 + np.count_nonzero(np.diff(v))


@pytest.mark.parametrize('code', [0.0, 0.1, 0.2, 0.3])
def test_a_link_that_is_lost_for_a_while_is_found(code):
    """0.1 to 0.4 s, 25 times: what it held goes, codes alike by chance stay."""
    x = wander(4)
    v = coded(x, code) if code else x
    rng = np.random.default_rng(6)
    lost = np.zeros(N, dtype=bool)
    for begin in np.arange(25) * 470 + 100:
        lost[begin:begin + int(RATE * rng.uniform(0.1, 0.4))] = True
    v = v[np.maximum.accumulate(np.where(lost, 0, np.arange(N)))]
    # Where the next code is the same by chance, a run is longer.
    assert 0 <= N - lost.sum() - left(v) <= 25 * (2 if code > 0.2 else 1)


def test_a_rail_at_rest_is_not_held():
    """Less than a code of noise for a second, 20 times: it comes to rest by steps of a code."""
    rest = np.mod(T, 3.0) < 1.0
    still = lfilter([0.05], [1.0, -0.95], np.where(rest, 0.0, wander(7)))
    assert left(coded(still + 0.02 * wander(8), 0.05)) == N
