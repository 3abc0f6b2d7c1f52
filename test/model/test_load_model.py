"""The model of voltage under load: the curve of a cell, and the fit to a recording."""

import numpy as np
from ou_monitor.model.load import cells_in_series, charge_at, lowpass, open_circuit
from ou_monitor.model.load_fit import fit_load, LoadInput
from project import needs_recordings, REAL, recorded, ROOT
import pytest
from simulated_packs import Pack


def test_the_open_circuit_curve_rises_and_has_an_inverse():
    """It rises throughout, is full at 4.2 V a cell, and its inverse brings charge back."""
    charge = np.linspace(-0.2, 1.1, 200)
    assert (np.diff(open_circuit(charge)) > 0.0).all()
    assert open_circuit(1.0) == pytest.approx(4.2, abs=0.02)
    assert charge_at(float(open_circuit(0.6))) == pytest.approx(0.6, abs=1e-3)


@pytest.mark.parametrize('voltage, cells', [(4.2, 1), (12.6, 3), (16.8, 4), (25.2, 6)])
def test_cells_of_a_full_pack(voltage, cells):
    assert cells_in_series(voltage) == cells


def test_two_half_steps_are_one():
    """A low-pass is exact over gaps while its input holds."""
    t = np.array([0.0, 0.1, 0.5, 7.0, 7.2])
    x = np.array([0.0, 1.0, 0.3, 0.8, 0.1])
    fine = np.sort(np.concatenate((t, 0.5 * (t[1:] + t[:-1]))))
    held = x[np.searchsorted(t, fine)]
    np.testing.assert_allclose(lowpass(held, fine, 2.0)[::2], lowpass(x, t, 2.0), atol=1e-12)


T = np.arange(0.0, 80.0, 0.02)
HALF = T < 40.0


def steps(seed: int) -> np.ndarray:
    """Return throttle that is held for half a second at a time."""
    rng = np.random.default_rng(seed)
    return np.clip(0.35 + 0.3 * np.repeat(rng.standard_normal(T.size // 25), 25), 0.0, 1.0)


def test_a_simulated_pack_is_predicted():
    """The rest of the flight within the noise, and the level falls."""
    u = steps(5)
    clean = Pack(4, 0.25, charge=0.85, size=0.15, power=1.9, endurance=400.0).path(T, u)
    v = clean + 0.05 * np.random.default_rng(6).standard_normal(T.size)
    falls, constant = (fit_load(LoadInput.THROTTLE, T[HALF], v[HALF], u[HALF], falls=falls)
                       for falls in (True, False))
    assert falls.evidence > constant.evidence + 3.0
    assert falls.evidence > fit_load(LoadInput.NONE, T[HALF], v[HALF]).evidence + 100.0
    assert np.sqrt(np.mean((falls.path(T, u) - clean)[~HALF] ** 2)) < 0.05


@pytest.mark.parametrize('falls', [False, True])
def test_the_errors_of_a_fit_are_those_of_its_predictions(falls):
    """A response of the fitted form: of 20 fits the mean error is some standard errors squared."""
    u = steps(7)
    true = fit_load(LoadInput.THROTTLE, T, Pack(4, 0.25).path(T, u), u, falls=falls)
    clean, off = true.path(T, u), []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        v = clean + 0.05 * rng.standard_normal(T.size)
        fit = fit_load(LoadInput.THROTTLE, T[HALF], v[HALF], u[HALF], falls=falls)
        drawn = [fit.draw(rng).path(T, u)[~HALF].mean() for _ in range(40)]
        off.append((clean[~HALF].mean() - np.mean(drawn)) / np.std(drawn))
    # chi^2 of 20; the slow error and the form, which are not simulated, make the errors larger.
    assert 0.1 < np.mean(np.square(off)) < 2.1


def test_a_current_gives_ohms_law():
    """A supply of 12 V and 20 mOhm; held out voltage has no effect."""
    rng = np.random.default_rng(8)
    current = 60.0 * steps(9)
    v = 12.0 - 0.02 * current + 0.01 * rng.standard_normal(T.size)
    spoiled = np.where(HALF, v, 3.0)
    fit = fit_load(LoadInput.CURRENT, T, spoiled, current, left_out=slice(2000, 4000))
    # Coefficients at once and after lags of less than a second.
    assert fit.values[1:4].sum() / fit.full == pytest.approx(0.02, rel=0.05)
    assert fit.path(T, current)[-500:] == pytest.approx(12.0 - 0.02 * current[-500:], abs=0.03)
    assert fit.resized(2.0).path(T, current) == pytest.approx(
        fit.values[0] + 2.0 * (fit.path(T, current) - fit.values[0]))
    with pytest.raises(ValueError, match='current'):
        fit.path(T, None)


@pytest.mark.parametrize('t', [np.array([0.0, 1.0, 1.0]), np.array([0.0, 0.1, 0.2])])
def test_a_load_that_cannot_be_fitted_is_refused(t):
    with pytest.raises(ValueError, match='s'):
        fit_load(LoadInput.THROTTLE, t, np.full(3, 16.0), np.full(3, 0.3))


@pytest.mark.parametrize('path', [ROOT / 'bags/recorded/gecko.csv', *(
    pytest.param(REAL / f'{name}.csv', marks=needs_recordings)
    for name in ('cf_solo_large', 'cf_pair_large', 'cf_takeoff'))])
def test_a_fit_stays_physical(path):
    """
    A minute beyond the data, and over a third of the samples: no parabola, no pole runs away.

    An extended model of sums of poles held +25.8 V beside -19 V on one of these.
    """
    flight = recorded(path)
    t, v, u = flight.t - flight.t[0], flight.voltage, np.clip(flight.throttle, 0.0, 1.0)
    t, v, u = t[::3], v[::3], u[::3]
    half = t <= 0.5 * t[-1]
    fit = fit_load(LoadInput.THROTTLE, t[half], v[half], u[half], falls=True)
    swing = float(np.ptp(v))
    # No part of the response is much larger than what was flown, so none can cancel another.
    assert np.abs(fit.values[3:] * np.ptp(fit.regressors(t, u)[1:], axis=1)).max() < 1.5 * swing
    if path.stem == 'gecko':
        left = (v - fit.path(t, u))[~half]
        assert fit.cells == 4
        assert np.sum(left ** 2) < 0.1 * np.sum((v[~half] - v[~half].mean()) ** 2)
    beyond = np.concatenate((t, t[-1] + np.arange(0.1, 60.0, 0.1)))
    held = np.concatenate((u, np.full(beyond.size - t.size, float(np.mean(u)))))
    path = fit.path(beyond, held)
    assert path.max() < v.max() + 0.25 * swing
    assert path.min() > v.min() - 0.5 * swing - 0.02 * v.max()
