"""The choice of samples from a long recording: limits, events, and lines by their formulas."""

import math

import numpy as np
from ou_monitor.criticism.samples import events_between, lines_between, without_tones
import pytest
from scipy.signal import lfilter
from scipy.stats import norm


def rail(n, keep, seed):
    """Return a sampled OU of variance 1."""
    noise = np.random.default_rng(seed).standard_normal(n)
    return lfilter([math.sqrt(1.0 - keep * keep)], [1.0, -keep], noise)


def jumps(sizes, n=64 * 1024):
    """Return changes of 1 up and down, and among them jumps that stay."""
    change = np.tile([1.0, -1.0], n // 2)
    at = 50 + 200 * np.arange(len(sizes))
    change[at] = sizes
    return np.concatenate(([0.0], np.cumsum(change))), at


def kept(v, throttle=None, step=7):
    return events_between(v, throttle, 1e3, slice(0, v.size, step))


@pytest.mark.parametrize('share, found', ((0.99, False), (1.01, True), (-0.99, False),
                                          (-1.01, True)))
def test_an_event_exceeds_the_largest_change_expected_from_noise(share, found):
    """A chance of 0.02 for the largest of all, 1.05 times; the scale is 1 / 0.6745."""
    n = 64 * 1024
    limit = 1.05 * norm.isf(0.01 / n) / 0.6745
    v, (at,) = jumps([share * limit])
    wanted = [k for k in (at, at + 1, at + 2) if k % 7] if found else []
    assert kept(v).tolist() == wanted


def test_up_to_300_events_are_kept():
    v, at = jumps(np.full(300, 99.0))
    near = (at[:, None] + np.arange(3)).ravel()
    assert kept(v).tolist() == near[near % 7 != 0].tolist()
    assert kept(jumps(np.full(301, 99.0))[0]).size == 0


def test_nothing_is_kept_beside_all_samples_or_where_codes_are_coarse():
    v, _ = jumps([99.0])
    assert kept(v, step=1).size == kept(v[:1024]).size == kept(np.repeat(v, 3)).size == 0


@pytest.mark.parametrize('move, late, found', (
    (0.5, 21, True), (0.5, 20, False), (0.5, 0, False), (0.5, -1, True), (0.009, 0, True)))
def test_changes_within_20_ms_of_a_throttle_step_belong_to_the_load(move, late, found):
    v, (at,) = jumps([99.0])
    throttle = np.full(v.size, 0.3)
    throttle[at - late + 1:] += move
    assert (kept(v, throttle).size > 0) == found


@pytest.mark.parametrize('phase', (0.4, 2.5, -1.7))
def test_a_line_between_the_samples_used_leaves_nothing(phase):
    """A line of 310 Hz of samples at 1 kHz of which every 5th is used, after 3 s."""
    # Its two amplitudes are known to sqrt(2 / n) of the spectrum's level there. A phase or gain of
    # the whitening left in the line would leave more than a tenth of its amplitude.
    n, keep, amplitude = 50_000, 0.9, 0.3
    t = 3.0 + np.arange(n) * 1e-3
    noise = rail(n, keep, 2)
    v = noise + amplitude * np.cos(2.0 * np.pi * 310.0 * (t - t[0]) + phase)
    (line,) = lines_between(t, v, slice(0, n, 5))
    turn = 2.0 * np.pi * 0.31
    level = (1.0 - keep * keep) / abs(1.0 - keep * np.exp(-1j * turn))**2
    error = math.sqrt(2.0 * level / n)
    assert line.amplitude == pytest.approx(amplitude, abs=4.0 * error)
    left = without_tones(t, v, t[0], [line]) - noise
    assert math.sqrt(np.mean(left**2)) < 0.1 * amplitude / math.sqrt(2.0)
    assert not lines_between(t, v, slice(0, n, 1))
