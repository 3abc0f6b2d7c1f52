"""The noise that the load leaves: an OU in white noise, its size, and its simulation."""

import numpy as np
from ou_monitor.comparison.flight_model import fit_noise, FlightNoise, Readings
from ou_monitor.model.ou import simulate
import pytest

DT, N = 0.01, 12_000
T = DT * np.arange(N)


def series(seed: int, std: float, white: float) -> np.ndarray:
    """Return an OU of 0.2 s and white noise, V."""
    rng = np.random.default_rng(seed)
    return simulate(T, 5.0, std * np.sqrt(10.0), rng) + white * rng.standard_normal(N)


def fitted(x: np.ndarray, load: np.ndarray | None = None, slow: float = 0.0) -> FlightNoise:
    """Fit the noise of a supply of 4 cells."""
    return fit_noise(Readings(T, 15.0 + x, load), x, load, slow)


def correlation(x: np.ndarray, lag: int) -> float:
    return float(x[lag:] @ x[:-lag]) / float(x @ x)


def test_an_ou_in_white_noise_is_drawn_again():
    found = fitted(series(1, 0.05, 0.05))
    drawn = np.concatenate([found.draw(N, None, np.random.default_rng(k)) for k in range(8)])
    # 120 s hold 300 relaxation times: the OU's variance is known to 8 %, its rate to some 12 %.
    assert drawn.var() == pytest.approx(2.0 * 0.05 ** 2, rel=0.15)
    for lag in (1, 10):
        assert correlation(drawn, lag) == pytest.approx(0.5 * np.exp(-5.0 * DT * lag), abs=0.08)


def test_errors_of_prediction_are_white():
    """They have no memory, and less variance than the series, a slow process or not."""
    for slow in (0.0, 0.02):
        x = series(2, 0.05, 0.05)
        x = x + (simulate(T, 0.05, slow * np.sqrt(0.1), np.random.default_rng(3)) if slow else 0.0)
        found = fitted(x, slow=slow ** 2)
        # In the order of their stamps again: without a load all sizes are alike.
        assert abs(correlation(found.errors, 1)) < 4.0 / np.sqrt(N)
        assert np.mean(found.errors ** 2) < 0.8 * x.var()


def test_white_noise_stays_white():
    """No OU is visible in it: VISIBLE is beyond what white noise shows."""
    found = fitted(series(4, 0.0, 0.05))
    assert found.phi == found.theta == 0.0
    # The mean of independent errors.
    assert found.mean_error(DT * N) == pytest.approx(0.05 / np.sqrt(N), rel=0.05)


def test_the_size_follows_load_and_changes():
    rng = np.random.default_rng(5)
    u = rng.random(N // 10)[np.arange(N) // 10]
    changed = np.abs(np.diff(u, prepend=u[0])) > 0.2
    size = 0.02 * np.exp(1.5 * u) * np.where(changed, 4.0, 1.0)
    found = fitted(size * rng.standard_normal(N), u)
    assert found.sizes.follows
    drawn = np.stack([found.draw(N, u, np.random.default_rng(k)) for k in range(8)])
    # 780 changes have an rms known to 2.5 %; the law is smooth in the change, the size is not.
    for there, error in ((~changed & (u < 0.2), 0.1), (~changed & (u > 0.8), 0.1), (changed, 0.2)):
        expected = np.sqrt(np.mean(size[there] ** 2))
        assert np.std(drawn[:, there]) == pytest.approx(expected, rel=error)
    assert not fitted(size * rng.standard_normal(N), np.full(N, 0.4)).sizes.follows


def test_rounding_is_not_drawn():
    rng = np.random.default_rng(6)
    x = 0.1 * np.rint(10.0 * 0.1 * rng.standard_normal(N))
    found = fit_noise(Readings(T, 15.0 + x, None), x, None, 0.0)
    assert found.draw(N, None, rng).var() == pytest.approx(x.var() - 0.1 ** 2 / 12.0, rel=0.08)


def test_a_voltage_without_noise_has_none():
    found = fitted(np.zeros(N), np.linspace(0.0, 1.0, N))
    assert np.all(found.draw(N, np.linspace(0.0, 1.0, N), np.random.default_rng(7)) == 0.0)
