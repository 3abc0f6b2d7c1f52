"""The model of voltage under load: closed forms, fit of a simulated pack, no degenerate fit."""

from dataclasses import replace

import numpy as np
from ou_monitor.model.load import (
    CELL, cells_in_series, charge_at, LoadModel, lowpass, open_circuit)
from ou_monitor.model.load_fit import fit_load
from project import needs_recordings, REAL, recorded, ROOT
import pytest


# A pack that does not run down while one looks, at the voltage at which sag is counted.
STIFF = LoadModel(4, 0.2, charge=charge_at(CELL), endurance=1e12, before=0.0)


def test_the_open_circuit_curve_rises_and_has_an_inverse():
    """It rises throughout, is full at 4.2 V a cell, and its inverse brings charge back."""
    charge = np.linspace(-0.2, 1.1, 200)
    assert (np.diff(open_circuit(charge)) > 0.0).all()
    assert open_circuit(1.0) == pytest.approx(4.2, abs=0.02)
    assert charge_at(float(open_circuit(0.6))) == pytest.approx(0.6, abs=1e-3)


@pytest.mark.parametrize('voltage, cells', [(4.2, 1), (12.6, 3), (16.8, 4), (25.2, 6)])
def test_cells_of_a_full_pack(voltage, cells):
    assert cells_in_series(voltage) == cells


def test_a_held_throttle_ends_at_the_static_sag():
    """After many time constants the path is the open-circuit voltage less the sag."""
    t = np.arange(0.0, 400.0, 0.1)
    v = STIFF.path(t, np.full(t.size, 0.6))
    assert v[-1] == pytest.approx(4 * CELL - float(STIFF.sag(0.6)), abs=2e-5)
    assert float(STIFF.sag(1.0)) == pytest.approx(0.12 * 4 * CELL * 1.5)


@pytest.mark.parametrize('share, tau', [('fast_share', 1.0), ('slow_share', 20.0)])
def test_polarisation_reaches_63_percent_after_one_tau(share, tau):
    """One tau after a step 1 - 1/e of the polarisation is there."""
    model = replace(STIFF, **{'fast_share': 1e-12, 'slow_share': 1e-12, 'inrush': 1e-12,
                              'lag': 1e-6, share: 0.4})
    t = np.arange(0.0, 30.0, 0.001)
    u = np.where(t > 5.0, 0.5, 0.0)
    v = model.path(t, u)
    sag = 0.12 * 4 * CELL * 0.5 ** 1.8
    start, later = np.searchsorted(t, [5.0005, 5.0005 + tau])
    assert v[start - 1] == pytest.approx(4 * CELL, abs=2e-5)
    later = (v[start - 1] - v[later]) / sag
    assert later == pytest.approx(1.0 + 0.4 * (1.0 - np.exp(-1.0)), abs=1e-3)


def test_two_half_steps_are_one():
    """A low-pass is exact over gaps while its input holds."""
    t = np.array([0.0, 0.1, 0.5, 7.0, 7.2])
    x = np.array([0.0, 1.0, 0.3, 0.8, 0.1])
    fine = np.sort(np.concatenate((t, 0.5 * (t[1:] + t[:-1]))))
    held = x[np.searchsorted(t, fine)]
    np.testing.assert_allclose(lowpass(held, fine, 2.0)[::2], lowpass(x, t, 2.0), atol=1e-12)


def test_current_as_the_load_gives_ohms_law():
    model = replace(STIFF, full_current=50.0, inrush=1e-12, fast_share=1e-12, slow_share=1e-12)
    t = np.arange(0.0, 5.0, 0.01)
    v = model.path(t, np.zeros(t.size), np.full(t.size, 25.0))
    assert v[-1] == pytest.approx(4 * CELL * (1.0 - 0.12 / 2.0), abs=2e-5)
    with pytest.raises(ValueError, match='current'):
        model.path(t, np.zeros(t.size))
    with pytest.raises(ValueError, match='current'):
        model.sag(0.5)


@pytest.mark.parametrize('bad', [-0.1, 50.0, np.nan])
def test_throttle_in_another_unit_is_refused(bad):
    with pytest.raises(ValueError, match='0..1'):
        STIFF.path(np.arange(3.0), np.array([0.1, bad, 0.2]))


def test_a_simulated_pack_is_recovered():
    """Sag within four standard errors and 5 %; the rest of the flight within the noise."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 80.0, 0.02)
    u = np.clip(0.35 + 0.3 * np.repeat(rng.standard_normal(t.size // 25), 25), 0.0, 1.0)
    true = LoadModel(4, 0.25, charge=0.85, size=0.15, power=1.9, endurance=400.0)
    clean = true.path(t, u)
    v = clean + 0.05 * rng.standard_normal(t.size)
    half = t < 40.0
    fit = fit_load(t[half], v[half], u[half])
    assert fit.model.cells == 4 and fit.condition < 1e3
    assert float(fit.model.sag(0.8)) == pytest.approx(float(true.sag(0.8)), rel=0.05)
    error = abs(np.log(fit.model.size / true.size))
    assert error < 4.0 * np.sqrt(fit.covariance[0, 0]) + 0.02
    ahead = fit.model.path(t, u)[~half] - clean[~half]
    assert np.sqrt(np.mean(ahead ** 2)) < 0.05
    # White noise of a mean of two or three samples.
    assert 0.05 / np.sqrt(3.0) * 0.9 < fit.noise_std < 0.05 / np.sqrt(2.0) * 1.1


@pytest.mark.parametrize('t', [np.array([0.0, 1.0, 1.0]), np.array([0.0, 0.1, 0.2])])
def test_a_load_that_cannot_be_fitted_is_refused(t):
    with pytest.raises(ValueError, match='s'):
        fit_load(t, np.full(3, 16.0), np.full(3, 0.3))


@pytest.mark.parametrize('path', [ROOT / 'bags/recorded/gecko.csv', *(
    pytest.param(REAL / f'{name}.csv', marks=needs_recordings)
    for name in ('cf_solo_large', 'cf_pair_large', 'cf_takeoff'))])
def test_a_fit_stays_physical(path):
    """
    Answers of the size of the swing, distinct times, a condition, and no trend beyond the data.

    An extended model of sums of poles held +25.8 V beside -19 V on one of these.
    """
    flight = recorded(path)
    t, v, u = flight.t - flight.t[0], flight.voltage, np.clip(flight.throttle, 0.0, 1.0)
    # A third of the samples: the answer is slower than that.
    t, v, u = t[::3], v[::3], u[::3]
    half = t <= 0.5 * t[-1]
    fit = fit_load(t[half], v[half], u[half])
    model = fit.model
    swing = float(np.ptp(v))
    # No part of the answer is much larger than what was seen, so none can cancel another.
    for part in (1.0, model.fast_share, model.slow_share):
        over = float(model.sag(u.max()) - model.sag(u.min()))
        assert 0.0 < part * over / (1.0 + model.fast_share + model.slow_share) < swing
    assert float(model.sag(u.max())) < 0.35 * v.max()
    assert 4.0 * model.lag < model.fast_time < 0.5 * model.slow_time
    assert fit.condition < 1e3 and np.isfinite(fit.covariance).all()
    if path.stem == 'gecko':
        left = (v - model.path(t, u))[~half]
        assert model.cells == 4
        assert np.sum(left ** 2) < 0.1 * np.sum((v[~half] - v[~half].mean()) ** 2)
    # A minute beyond the data the charge is that of the load: no parabola, no pole runs away.
    beyond = np.concatenate((t, t[-1] + np.arange(0.1, 60.0, 0.1)))
    held = np.concatenate((u, np.full(beyond.size - t.size, float(np.mean(u)))))
    path = model.path(beyond, held)
    assert path.max() < v.max() + 0.25 * swing
    assert path.min() > v.min() - 0.5 * swing - 0.02 * v.max()
