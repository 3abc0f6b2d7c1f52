"""A slow state shows in the spectrum of the scores, and starts from there."""

import math

import numpy as np
from ou_monitor.criticism.composite import fit_composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import from_spectrum
from ou_monitor.discovery.gain import guess
from ou_monitor.model.ou import simulate
from ou_monitor.model.terms.slow import SecondRelaxation
from ou_monitor.model.whittle import Ordinates
import pytest

ALPHA, SIGMA, RATE = 60.0, 0.5, 2.5
START = SecondRelaxation(10.0, 0.05)


def fitted(std, seed):
    """Return 60 s at 500 Hz of an OU, with a slow one of a standard deviation, and a plain fit."""
    rng = np.random.default_rng(seed)
    t = np.arange(30_000) / 500.0
    v = simulate(t, ALPHA, SIGMA, rng, u0=15.0)
    v += simulate(t, RATE, std * math.sqrt(2.0 * RATE), rng)
    samples = Samples(t, v, None)
    return samples, fit_composite(samples, [guess(samples)], samples.train)


def begun(std, seed):
    """Return the slow term where it starts, and the gain, nats."""
    samples, plain = fitted(std, seed)
    terms, gain = from_spectrum(samples, plain, [plain.terms[0], START])
    return terms, gain


def test_it_starts_near_the_truth():
    """
    36 s hold 90 relaxations of it: rate and variance are known to about 15 %.

    Shares of its spectrum that the rail hides make that twice as much.
    """
    for seed in (1, 2):
        (ou, slow), gain = begun(0.03, seed)
        assert abs(math.log(slow.alpha / RATE)) < 0.9
        assert slow.sigma / math.sqrt(2.0 * slow.alpha) == pytest.approx(0.03, rel=0.3)
        assert ou.alpha == pytest.approx(ALPHA, rel=0.1)
        assert gain > 30.0


def test_without_one_it_gains_what_two_parameters_do():
    """Twice the gain is chi-squared of two or fewer: 9.2 nats come once in 10 000."""
    assert max(begun(0.0, seed)[1] for seed in (3, 4, 5)) < 9.2


def test_ordinates_are_all_counted():
    """As many as half the samples, of mean one for white scores of variance one."""
    z = np.random.default_rng(6).standard_normal(20_001)
    seen = Ordinates.of(z)
    total = float(seen.count.sum())
    assert total == z.size // 2 - 1
    assert float(seen.count @ seen.power) / total == pytest.approx(1.0, abs=4.0 / math.sqrt(total))
    assert np.all(np.diff(seen.omega) > 0.0) and seen.omega[-1] < math.pi
