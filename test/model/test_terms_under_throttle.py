"""Terms of a flight whose noise follows throttle: levels beside it, and its own line."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.load_dependent import LoadDependentSigma
from ou_monitor.model.terms.regime_switching import _SLOW_AHEAD, _slow_levels, RegimeSwitching
from ou_monitor.model.terms.segment import first_order
import pytest


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


def test_levels_beside_noise_that_follows_throttle():
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
