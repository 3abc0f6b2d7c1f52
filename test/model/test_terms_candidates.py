"""Starts of fits of terms: closed forms, and noise that depends on throttle."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.load_response import LoadDependentSigma
from ou_monitor.model.terms.regime_switching import (
    _SLOW_AHEAD, _slow_levels, RegimeSwitching, relaxing)
from ou_monitor.model.terms.term import View
from ou_monitor.model.terms.tones import order_power
import pytest
from scipy.linalg import dft
from scipy.stats import median_abs_deviation


def view_of(n, rate, decay=63.0):
    """Return even samples of residuals whose standard deviation is 0.2 V."""
    flat = np.ones(n)
    residual = 0.2 * np.where(np.arange(n) % 2, 1.0, -1.0)
    return View(z=flat, variance=flat, phi=np.full(n, math.exp(-decay / rate)), state=flat,
                residual=residual, at=np.arange(n) / rate, step=flat / rate, throttle=None,
                train=slice(0, n))


@pytest.mark.parametrize('rate, lengths', [(200.0, (64, 32)), (1500.0, (512, 64))])
def test_power_along_throttle_is_that_of_every_line(rate, lengths):
    """
    Power of white noise along each line frequency = idle + slope throttle, by plain transforms.

    A line of n segments has a mean of n exponentials for its power; the chance of a mean m
    is bounded by exp(-n (m - 1 - ln m)) (Cramer).  Two in a hundred lines count as
    independent, two bins a sample.
    """
    rng = np.random.default_rng(4)
    n = 40 * lengths[0]
    z, u = rng.standard_normal(n), np.repeat(rng.random(n // 16), 16)
    top, trials, largest = 0.0, 0.0, 0.0
    for length in lengths:
        count, width = n // length, rate / (2.0 * length)
        pieces = z.reshape(count, length) * np.hanning(length)
        power = np.abs(pieces @ dft(2 * length)[:length]) ** 2
        power /= power.mean(axis=0)
        load = u.reshape(count, length).mean(axis=1)
        slopes = np.arange(-rate, rate, 2.0 * width / np.ptp(load))
        for slope in slopes:
            shift = np.rint(slope * load / width).astype(int)
            places = (np.arange(length) + shift[:, None]) % (2 * length)
            mean = float(np.take_along_axis(power, places, 1).mean(axis=0).max())
            top = max(top, count * (mean - 1.0 - math.log(mean)))
            largest = max(largest, mean)
        trials += 0.02 * 2.0 * length * slopes.size
    # So that a mean below 2 counts as well.
    assert 1.0 < largest
    found = order_power(z, u, rate)
    assert found == pytest.approx((top, trials), rel=1e-4)


def test_the_view_of_a_faster_rail_has_its_residuals():
    """Residuals less phi^2 times the state before, over what noise of that phi makes of a step."""
    rng = np.random.default_rng(9)
    phi = np.tile([0.9, 0.8, 0.9], 400)
    state, z, variance = rng.standard_normal(1200), rng.standard_normal(1200), np.tile(
        [0.3, 0.4, 0.3], 400)
    view = replace(view_of(1200, 100.0), phi=phi, state=state, z=z, variance=variance)
    assert relaxing(view, 1.0) is view
    found = relaxing(view, 2.0)
    error = z * np.sqrt(variance) + phi * state - phi ** 2 * state
    middle = np.median(error)
    # The usual step is that of phi 0.9; the middle half of a normal reaches to 0.6745.
    std = median_abs_deviation(error) / 0.6745
    expected = std ** 2 * (1.0 - phi ** 4) / (1.0 - 0.9 ** 4)
    assert found.phi == pytest.approx(phi ** 2, rel=1e-12)
    assert found.variance == pytest.approx(expected, rel=1e-4)
    assert found.z == pytest.approx((error - middle) / np.sqrt(expected), rel=1e-4, abs=1e-9)


def flown(levels=0.0, seed=1, n=20_000):
    """Return the view of an OU whose sigma grows by e^1.5 with throttle, levels (V) on it."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.random(n // 1000), 1000)
    std = 0.02 * np.exp(1.5 * u)
    keep = math.exp(-0.06)
    x = first_order(np.full(n, keep), std * math.sqrt(1.0 - keep**2) * rng.standard_normal(n), 0.0)
    residual = x - levels * (np.cumsum(rng.random(n) < 0.001) % 2)
    residual -= residual.mean()
    before = np.concatenate(([0.0], residual[:-1]))
    variance = std**2 * (1.0 - keep**2)
    return View(z=(residual - keep * before) / np.sqrt(variance), variance=variance,
                phi=np.full(n, keep), state=before, residual=residual, at=0.001 * np.arange(n),
                step=np.full(n, 0.001), throttle=u, train=slice(0, n))


def test_noise_that_follows_throttle_is_no_level():
    """Two levels in the means of that noise gain no more than their three parameters do."""
    assert all(_slow_levels(flown(seed=seed))[1] < _SLOW_AHEAD for seed in (1, 2))


def test_levels_are_found_beside_noise_that_follows_throttle():
    """Levels of three deviations of the calm rail are seen, and about as high as they are."""
    fit = RegimeSwitching.fit_law(flown(levels=0.1))
    assert abs(fit.term.level) == pytest.approx(0.1, rel=0.15)
    assert fit.term.sigma_ratio == pytest.approx(1.0, abs=0.15)
    assert float(fit.gain.sum()) > 100.0


def test_a_line_of_sigma_is_level_nowhere():
    """Its ends are those of throttle throughout, also of the part that is not fitted."""
    view = flown()
    view = replace(view, z=view.z * np.exp(1.5 * view.throttle), train=slice(1, 12_000),
                   throttle=np.concatenate(([1.5], view.throttle[1:-1], [-0.5])))
    line = min(LoadDependentSigma.candidates(view), key=lambda term: len(term.throttle))
    assert line.throttle == (-0.5, 1.5)
    assert (line.log_factor[1] - line.log_factor[0]) / 2.0 == pytest.approx(1.5, abs=0.1)
