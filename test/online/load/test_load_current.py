"""Current in the load filter: resistance, level without throttle, and no harm from a wrong one."""

import numpy as np
from ou_monitor.model.load import lowpass
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import Basis, LoadStatus
from pushed import pushed
import pytest
from simulated_packs import Pack

FULL = 60.0
TRUE = Pack(4, 0.25, charge=0.85, size=0.1, full_current=FULL, fast_share=0.1, slow_share=0.2,
            inrush=1e-9, lag=1e-4)
OHM = 0.1 * 4 * 3.8 / FULL


@pytest.fixture(scope='module')
def flight():
    """Return stamps, voltage, throttle and current of 40 s with wind in the current."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 40.0, 0.02)
    step = (2 * t).astype(int)
    u = np.clip(0.35 + 0.25 * rng.standard_normal(81), 0.0, 1.0)[step]
    wind = np.repeat(np.clip(1.0 + 0.4 * rng.standard_normal(20), 0.2, 2.0), 100)
    current = FULL * u ** 1.8 * wind
    return t, TRUE.path(t, u, current) + 0.02 * rng.standard_normal(t.size), u, current


def loaded(t, v, u, current):
    return pushed(LoadFilter(), t, v, u, current).load()


@pytest.mark.parametrize('scale', [1.0, -1.0, 1000.0, 0.01])
def test_resistance_in_the_unit_of_the_current(flight, scale):
    """Within two errors, scale and sign as they come; the better predictor gives the level."""
    t, v, u, current = flight
    load = loaded(t, v, u, scale * current)
    ohm = load.resistance * abs(scale)
    assert abs(ohm - OHM) < 2.0 * load.resistance_se * abs(scale)
    assert ohm == pytest.approx(OHM, rel=0.1)
    # Wind is in the current and not in throttle.
    assert load.basis is Basis.CURRENT and load.known
    assert load.level == pytest.approx(15.7, abs=0.3)


def test_the_voltage_at_rest_is_kept_when_the_current_rises():
    """Seven seconds at 1.4 A tell the level, 15.2 V; 2 to 6 A alone tell it half as well."""
    errors = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 22.0, 0.02)
        drawn = np.where(t < 7.0, 1.4, rng.uniform(2.0, 6.0, 45)[(2 * t).astype(int)])
        v = 15.2 - 0.1 * lowpass(drawn, t, 0.1) + 0.05 * rng.standard_normal(t.size)
        loads = pushed(LoadFilter(), t, v, None, lowpass(drawn, t, 0.1))
        errors.append(loads._current.level - 15.2)
    assert np.sqrt(np.mean(np.square(errors))) < 0.085


@pytest.mark.parametrize('current', [np.nan, 0.0, 1e-4, 12.0])
def test_a_current_that_says_nothing_does_no_harm(flight, current):
    """NaN, zero or a stuck sensor: no resistance, and all else as without it."""
    t, v, u, _ = flight
    load, plain = loaded(t, v, u, current), loaded(t, v, u, None)
    assert np.isnan(load.resistance) and load.basis is Basis.THROTTLE
    assert load.level == plain.level and float(load.sag(0.5)) == float(plain.sag(0.5))


def test_a_current_of_another_vehicle_is_no_resistance(flight):
    """What does not move the voltage has none, and the level stays that of throttle."""
    t, v, u, current = flight
    load = loaded(t, v, u, np.roll(current, 777))
    assert load.basis is Basis.THROTTLE
    assert np.isnan(load.resistance) or load.resistance_se > 0.1 * load.resistance


def test_level_from_current_without_throttle(flight):
    """The open-circuit voltage is known, the sag over throttle is not."""
    t, v, _, current = flight
    load = loaded(t, v, None, current)
    assert load.status is LoadStatus.NO_THROTTLE and load.basis is Basis.CURRENT
    assert load.level == pytest.approx(loaded(*flight).level, abs=0.1)
    assert load.resistance == pytest.approx(OHM, rel=0.1)


def test_the_error_covers_a_load_that_bypasses_the_sensor(flight):
    """1.5 V by throttle, as much as by current; a sensor that is slow by 0.1 s costs nothing."""
    t, v, u, current = flight
    load = loaded(t, v - 1.5 * u ** 1.8, u, current)
    # The least error, a tenth, would not cover it.
    assert 0.4 * load.resistance < load.resistance - OHM < 2.0 * load.resistance_se
    slow = current.copy()
    for k in range(1, t.size):
        slow[k] += (slow[k - 1] - slow[k]) * np.exp(-0.02 / 0.1)
    load = loaded(t, v, u, slow)
    assert load.resistance_se == pytest.approx(0.1 * load.resistance, rel=0.05)


@pytest.mark.parametrize('seed', range(4))
def test_a_current_that_throttle_determines_is_still_a_resistance(seed):
    """Only the rounding of the current tells it from throttle, and says nothing of a bypass."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.uniform(0.1, 0.9, 60), 25)
    current = (40.0 * u ** 1.8).round(2)
    v = 16.4 - 0.03 * current + 0.02 * rng.standard_normal(u.size)
    load = loaded(0.02 * np.arange(u.size), v, u, current)
    assert abs(load.resistance - 0.03) < 2.0 * load.resistance_se


@pytest.mark.parametrize('exponent', [1.6, 2.1])
@pytest.mark.parametrize('seed', range(2))
def test_another_exponent_of_throttle_is_no_load_that_bypasses_the_sensor(seed, exponent):
    """A small pack that empties and polarises: the error stays at its minimum, a tenth."""
    rng, t = np.random.default_rng(seed), np.arange(0.0, 120.0, 0.02)
    u = np.clip(0.35 + 0.2 * rng.standard_normal(241), 0.05, 1.0)[(2 * t).astype(int)]
    current = 80.0 * lowpass(u, t, 0.05) ** exponent
    drawn = 0.02 * np.cumsum(current) / 3600.0
    v = (16.5 - 1.5 * drawn - 0.015 * current - 0.006 * lowpass(current, t, 6.0)
         + 0.02 * rng.standard_normal(t.size))
    load = loaded(t, v, u, current)
    assert load.resistance == pytest.approx(0.015 + 0.006 * (1.0 - np.exp(-1.0 / 6.0)), rel=0.1)
    assert load.resistance_se < 0.12 * load.resistance


def test_a_current_that_pauses(flight):
    """Holes of a second and of ten; the resistance is kept over both."""
    t, v, u, current = flight
    holed = current.copy()
    holed[(t > 10.0) & (t < 10.5) | (t > 20.0) & (t < 30.0)] = np.nan
    loads = LoadFilter()
    part = t < 25.0
    loads.push(t[part], v[part], u[part], holed[part])
    assert loads.load().basis is Basis.THROTTLE
    loads.push(t[~part], v[~part], u[~part], holed[~part])
    assert loads.load().resistance == pytest.approx(OHM, rel=0.1)


def test_a_current_that_is_late_and_returns_charge():
    """Three samples late, an offset at rest, and below zero a while: voltage a second ahead."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 60.0, 0.02)
    drawn = rng.choice([-20.0, 0.0, 40.0, 90.0], 121)[(2 * t).astype(int)]
    v = 12.5 - 0.02 * drawn + 0.01 * rng.standard_normal(t.size)
    measured = np.concatenate((np.full(3, drawn[0]), drawn[:-3])) + 38.0
    enabled = np.where(t > 5.0, 1.0, 0.0)
    load = loaded(t, v, enabled, measured)
    assert load.basis is Basis.CURRENT
    assert load.resistance == pytest.approx(0.02, rel=0.1)
    # The offset is in the level: 0.02 Ohm times 38 A.
    assert load.level == pytest.approx(12.5 + 0.76, abs=0.2)
    assert load.rest == pytest.approx(load.level, abs=0.05)


def test_the_sag_follows_from_the_current_where_throttle_hides_it():
    """A switch draws 30 A, and other loads of up to 200 A come and go: 0.02 Ohm, 0.6 V."""
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 120.0, 0.02)
    switch = (t % 20.0 > 10.0).astype(float)
    others = rng.choice([0.0, 100.0, 200.0], 241)[(2 * t).astype(int)]
    current = 30.0 * switch + others
    v = 12.5 - 0.02 * current + 0.01 * rng.standard_normal(t.size)
    load = loaded(t, v, switch, current)
    assert load.known and load.basis is Basis.CURRENT
    assert abs(float(load.sag(1.0)) - 0.6) < 2.0 * float(load.sag_se(1.0))
    assert float(load.sag_se(1.0)) < 0.5


def test_a_resistance_at_once_and_after_a_second():
    """20 mOhm, and 15 mOhm that relax in 0.7 s."""
    rng = np.random.default_rng(1)
    current = np.repeat(rng.uniform(5.0, 40.0, 60), 100)
    late = np.empty_like(current)
    late[0] = current[0]
    for k in range(1, late.size):
        late[k] = current[k] + (late[k - 1] - current[k]) * np.exp(-0.02 / 0.7)
    v = 16.0 - 0.02 * current - 0.015 * late + 0.01 * rng.standard_normal(late.size)
    load = loaded(0.02 * np.arange(late.size), v, None, current)
    assert load.resistance == pytest.approx(0.02 - 0.015 * np.expm1(-1.0 / 0.7), rel=0.05)
    assert load.resistance_at_once == pytest.approx(0.02 - 0.015 * np.expm1(-0.1 / 0.7), rel=0.05)
