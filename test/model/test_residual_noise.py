"""The noise that a load model leaves: an OU and white noise by spectrum, and its law."""

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.model.ou import simulate
from ou_monitor.model.residual import changes, fit_noise_law, fit_residual_ou, innovations
import pytest

DT, N = 0.01, 12_000


def series(seed: int, tau: float, std: float, white: float) -> np.ndarray:
    """Return an OU and white noise, V."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(N)
    ou = simulate(t, 1.0 / tau, std * np.sqrt(2.0 / tau), rng, u0=0.0) if std else 0.0
    return ou + white * rng.standard_normal(N)


def test_an_ou_in_white_noise_is_found():
    """120 s hold 300 relaxation times: tau is known to some 10 %, and within the grid's steps."""
    found = fit_residual_ou(series(1, 0.2, 0.05, 0.05), DT, 0.0)
    assert found.gain > 0.05
    assert found.tau == pytest.approx(0.2, rel=0.5)
    assert np.sqrt(found.variance) == pytest.approx(0.05, rel=0.15)
    assert np.sqrt(found.white) == pytest.approx(0.05, rel=0.05)


def test_white_noise_has_no_ou():
    """An OU that is not there does not gain on parts left out, or next to nothing."""
    found = [fit_residual_ou(series(seed, 0.2, 0.0, 0.05), DT, 0.0) for seed in range(2, 4)]
    assert all(one.variance < 0.1 * one.white for one in found)
    assert any(one.variance == 0.0 for one in found)


def test_innovations_are_white():
    """The predictor's errors have the variance that it says, and no memory."""
    x = series(3, 0.2, 0.05, 0.05)
    ou = fit_residual_ou(x, DT, 0.0)
    e, state = innovations(x, DT, ou, 0.0)
    assert np.mean(e ** 2) == pytest.approx(state + ou.white, rel=0.05)
    assert abs(np.mean(e[1:] * e[:-1])) < 4.0 / np.sqrt(N) * np.mean(e ** 2)
    assert np.mean(e ** 2) < 0.8 * x.var()


def test_the_law_is_found_and_drawn():
    """Coefficients within four errors; what is drawn has that variance again."""
    rng = np.random.default_rng(4)
    t = DT * np.arange(N)
    u = rng.random(N // 50)[np.arange(N) // 50]
    b = np.array([-6.0, 2.5, -1.0])
    variance = np.exp(b[0] + b[1] * ripple(u)) + np.exp(b[2]) * changes(t, u) ** 2
    e = np.sqrt(variance) * rng.standard_normal(N)
    law = fit_noise_law(t, e, u, 0.0)
    assert np.all(np.abs(law.b - b) < 4.0 * np.sqrt(np.diag(law.covariance)))
    assert np.all(np.sqrt(np.diag(law.covariance))[:2] < 0.06)
    drawn = law.draw(t, u, rng)
    for low, high in ((0.0, 0.3), (0.6, 0.9)):
        there = (u >= low) & (u < high)
        assert drawn[there].var() == pytest.approx(e[there].var(), rel=0.2)


def test_what_is_beside_the_noise_is_not_drawn():
    """Rounding and states have their share of the errors."""
    rng = np.random.default_rng(5)
    t = DT * np.arange(N)
    e = np.sqrt(0.01 + 0.02) * rng.standard_normal(N)
    law = fit_noise_law(t, e, np.zeros(N), 0.02)
    assert law.draw(t, np.zeros(N), rng).var() == pytest.approx(0.01, rel=0.15)


def test_the_memory_of_neighbours():
    """Noise behind a filter is drawn with the correlation of neighbours and the same variance."""
    rng = np.random.default_rng(6)
    t = DT * np.arange(N)
    e = np.empty(N)
    e[0] = 0.0
    for k in range(1, N):
        e[k] = 0.5 * e[k - 1] + rng.standard_normal()
    law = fit_noise_law(t, e, np.zeros(N), 0.0)
    # One standard error is sqrt(1 - 0.25)/sqrt(N) = 0.008.
    assert law.memory == pytest.approx(0.5, abs=0.032)
    drawn = law.draw(t, np.zeros(N), rng)
    assert drawn.var() == pytest.approx(e.var(), rel=0.15)
    assert drawn[1:] @ drawn[:-1] / (drawn @ drawn) == pytest.approx(0.5, abs=0.04)
    assert fit_noise_law(t, rng.standard_normal(N), np.zeros(N), 0.0).memory == 0.0


def test_changes_count_over_20_ms():
    """A rise in two steps of 10 ms counts in full, at 100 Hz and at 1 kHz."""
    for dt in (0.01, 0.001):
        t = dt * np.arange(round(0.2 / dt))
        u = np.clip((t - 0.1) / 0.02, 0.0, 1.0)
        assert changes(t, u).max() == pytest.approx(1.0, abs=0.02)
    t = 0.1 * np.arange(10)
    assert changes(t, np.linspace(0.0, 0.9, 10)).max() == pytest.approx(0.1)
