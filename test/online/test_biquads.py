"""One notch: its response, and stability with any sequence of coefficients."""

import cmath
import math
import random

import numpy as np
from ou_monitor.online.notch import HIGHEST, Notch, phase_lag, WIDTHS
import pytest

# Bandwidths over frequency that the proof is for.
NARROWEST, WIDEST = 0.08, 2.0


def notch(ratio, width, share=1.0, x=0.0):
    one = Notch(x)
    one.ratio, one.width, one.depth = ratio, width, share
    return one


@pytest.mark.parametrize('ratio, width, share', [
    (0.1, 0.3, 1.0), (0.28, 1.0, 1.0), (0.44, 0.1, 1.0), (0.2, 0.5, 0.4)])
def test_response_is_what_a_tone_shows(ratio, width, share):
    """After its transient a tone is multiplied by the response, in amplitude and phase."""
    one = notch(ratio, width, share)
    at = 0.5 * ratio
    n = 4000
    out = np.array([one.advance(math.cos(2 * math.pi * at * k)) for k in range(n)])
    late = np.arange(n - 1000, n)
    # 1000 samples hold whole periods of each of these tones.
    seen = 2.0 * np.mean(out[late] * np.exp(-2j * math.pi * at * late))
    assert seen == pytest.approx(one.response(at), abs=1e-9)
    assert phase_lag([one], at) == pytest.approx(-cmath.phase(seen), abs=1e-9)


def test_its_own_frequency_is_gone_and_the_mean_stays():
    """The zero lies on the frequency exactly: what is left is rounding."""
    one = notch(0.28, 0.3)
    out = [one.advance(2.0 + math.sin(2 * math.pi * 0.28 * k)) for k in range(2000)]
    assert max(abs(y - 2.0) for y in out[-200:]) < 1e-9
    assert notch(0.28, 0.3).response(0.28) == pytest.approx(0.0, abs=1e-12)


def test_delay_of_slow_signals():
    """Far below it a notch lags by width / (2 pi f), the analogue of tan(pi r) / pi r less."""
    r, k = 0.05, 0.4
    lag = phase_lag([notch(r, k)], 1e-5) / (2 * math.pi * 1e-5)
    assert lag == pytest.approx(k / (2 * math.tan(math.pi * r)), rel=1e-6)


def test_what_was_built_up_dies_out():
    """Without input the energy of the proof never grows, whatever the coefficients do."""
    rng = random.Random(1)
    e = 2.0 * NARROWEST / (4.0 + NARROWEST**2)
    one = notch(0.3, 0.2)
    one._s1, one._s2 = 1.0, -2.0
    energy = math.inf
    for _ in range(3000):
        one.ratio, one.width = rng.uniform(1e-3, HIGHEST), rng.uniform(NARROWEST, WIDEST)
        one.advance(0.0)
        now = one._s1**2 + one._s2**2 + 2.0 * e * one._s1 * one._s2
        assert now <= energy * (1.0 + 1e-12)
        energy = now
    assert energy < 1e-12


def test_widths_in_use_are_those_of_the_proof():
    """What is chosen from lies within what the bound is for."""
    assert NARROWEST <= WIDTHS.min() and WIDTHS.max() <= WIDEST
