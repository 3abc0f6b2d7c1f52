"""Samples: spread over coarse codes, and chosen from a long recording with events and lines."""

import math

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor import Recording
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.innovations import innovations, steps_before
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import (
    choose_samples, events_between, lines_between, MOST, Samples, without_tones)
from ou_monitor.discovery.gain import guess
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.model.terms.shocks import Volatility
import pytest
from scipy.signal import lfilter
from scipy.special import ndtr
from scipy.stats import norm


STEP, N = 0.005, 1500
T = np.arange(N) / 100.0


def read(noise: float) -> np.ndarray:
    """Return the codes of a slow rail and of white noise of so many steps."""
    rng = np.random.default_rng(5)
    rail = lfilter([1.0], [1.0, -0.99], 0.1 * STEP * rng.standard_normal(N))
    return STEP * np.rint((rail + noise * STEP * rng.standard_normal(N)) / STEP)


@pytest.mark.parametrize('noise, spread', [(0.2, True), (2.0, True), (8.0, False)])
def test_only_coarse_codes_are_spread(noise, spread):
    """Each value stays within half a step of its code, and the codes are kept."""
    codes = 3.8 + read(noise)
    samples = examine(Recording(T, codes, np.full(N, np.nan))).samples
    assert (samples.cell > 0.0) is spread and (samples.codes is not None) is spread
    assert np.abs(samples.voltage - codes).max() <= 0.5 * STEP * (1.0 + 1e-6)
    assert samples.logged == pytest.approx(codes, abs=1e-12)
    part = samples.part(slice(10, 20))
    assert part.logged == pytest.approx(codes[10:20], abs=1e-12) and part.cell == samples.cell


def test_the_mean_log_density_within_a_cell_is_at_most_that_of_the_cell():
    """Of a normal law one step wide, at codes up to two steps away."""
    rng = np.random.default_rng(6)
    codes = STEP * rng.integers(-2, 3, 20000)
    samples = Samples(np.arange(codes.size) / 100.0, codes, None).spread(codes, STEP, rng)
    z = samples.voltage / STEP
    for code in range(-2, 3):
        at = samples.logged == STEP * code
        mean = float(np.mean(-0.5 * z[at] ** 2)) - math.log(math.sqrt(2.0 * math.pi))
        cell = math.log(ndtr(code + 0.5) - ndtr(code - 0.5))
        # Half the variance of the log density, (code^2 + ..)/12; and 5 errors of a mean of 4000.
        error = (abs(code) + 0.1) / math.sqrt(12.0 * 4000)
        assert -(code ** 2 + 1.0) / 20.0 < mean - cell < 5.0 * error
    assert samples.blur == pytest.approx(STEP ** 2 / 12.0)


def test_ties_pay_for_no_wandering_intensity():
    """A rail of constant sigma, 0.2 steps of noise: from codes as they are, hundreds of nats."""
    codes = 3.8 + read(0.2)
    spread = examine(Recording(T, codes, np.full(N, np.nan))).samples
    gains = []
    for samples in (Samples(T, codes, None), spread):
        part = slice(0, samples.n)
        plain = fit_composite(samples, [guess(samples), Quantization(STEP)], part)
        law = fit_composite(samples, [*plain.terms, Volatility], part, plain)
        gains.append(float((law.density - plain.density).sum()))
    assert gains[0] > 300.0 > 30.0 > gains[1]
    assert isinstance(plain.terms[0], OU)


def rail(n, keep, seed):
    """Return a sampled OU of variance 1."""
    noise = np.random.default_rng(seed).standard_normal(n)
    return lfilter([math.sqrt(1.0 - keep * keep)], [1.0, -keep], noise)


@pytest.mark.parametrize('code', (0.0, 3.0))
def test_coarse_codes_do_not_hide_a_fast_relaxation(code):
    """A relaxation of 16 samples among 8e5, of which every 10th would be too few."""
    # Codes of three standard deviations: most differences are 0, and so is the smaller half.
    v = rail(8 * MOST + 80_000, math.exp(-1.0 / 16.0), 1)
    if code:
        v = code * np.rint(v / code)
    which, note = choose_samples(v, 1e3)
    assert 'middle' in note and which.step <= 8
    assert (which.start + which.stop) / 2 == pytest.approx(v.size / 2, abs=1.0)
    assert which.stop - which.start == MOST * which.step


def test_steps_a_little_off_count_as_the_usual_one():
    t = np.cumsum([5.0, 1.0, 1.29, 0.71, 1.31, 0.69, 1.0, 1.0])
    assert_allclose(steps_before(t), [np.inf, 1.0, 1.0, 1.0, 1.31, 0.69, 1.0, 1.0])


def test_innovations_are_those_of_the_joint_normal_law():
    """Cholesky of the covariance of an OU in white noise; of white noise alone, its scores."""
    rng = np.random.default_rng(3)
    # Steps that differ by more than 30 % and so are not taken for alike.
    t = np.cumsum(rng.choice([0.1, 0.2, 0.5], 40))
    deviation = rng.standard_normal(40)
    covariance = 2.0 * np.exp(-1.3 * np.abs(t[:, None] - t)) + 0.5 * np.eye(40)
    assert_allclose(innovations(t, deviation, 1.3, 2.0, 0.5),
                    np.linalg.solve(np.linalg.cholesky(covariance), deviation), atol=1e-6)
    assert_allclose(innovations(t, deviation, math.inf, 2.0, 0.5), deviation / math.sqrt(2.5))
    assert_allclose(innovations(t[:1], deviation[:1], 1.3, 2.0, 0.5),
                    deviation[:1] / math.sqrt(2.5))


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
