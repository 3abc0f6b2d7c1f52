"""Spectra: the fitted and the measured one agree in kind and scale."""


import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.level_result import level_spectrum, ou_spectrum
import pytest
from simulated_recordings import ALPHA, recording


def test_the_curve_holds_the_whole_variance():
    """Its integral to the Nyquist frequency is Var_inf plus the noise, aliases folded in."""
    frequency = (np.arange(200000) + 0.5) * 500.0 / 200000
    density = ou_spectrum(frequency, ALPHA, 0.3, 1000.0, noise_std=0.02)
    total = density.sum() * 500.0 / 200000
    assert total == pytest.approx(0.3 ** 2 / (2 * ALPHA) + 0.02 ** 2, rel=1e-6)


def test_measured_and_true_spectrum_agree():
    # About 40 points a decade over two decades; each averages >= 8 pieces (relative error below
    # 1/sqrt(8) = 35 %), and most points average several bins; the mean of 60 or more is known to
    # 35 % / sqrt(60) = 5 %. A two-sided or badly scaled density is off by 2.
    simulated = recording(1, ((0.1, 0.3),), seconds=60.0)
    (level,) = analyze(simulated).levels
    found = level_spectrum(simulated, level.segments, level.estimate)
    frequency, density = found.frequency, found.density
    assert frequency.size >= 60 and frequency[0] > 0.0 and frequency[-1] < 500.0
    ratio = density / ou_spectrum(frequency, ALPHA, 0.3, 1000.0)
    assert ratio.mean() == pytest.approx(1.0, abs=0.2)
    # The fit itself is within its 10 % of sigma and of alpha.
    assert (density / found.fitted).mean() == pytest.approx(1.0, abs=0.2)


def test_short_segments_give_nothing():
    """Fewer than 32 samples: empty arrays."""
    simulated = recording(2, ((0.1, 0.3),), seconds=0.02)
    (level,) = analyze(simulated).levels
    assert level_spectrum(simulated, level.segments, level.estimate).frequency.size == 0


def test_unknown_noise_counts_as_none():
    frequency = np.array([1.0])
    assert ou_spectrum(frequency, 63.0, 0.3, 1e3, np.nan) == ou_spectrum(
        frequency, 63.0, 0.3, 1e3)
