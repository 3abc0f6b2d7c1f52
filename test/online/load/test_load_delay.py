"""Throttle that is late or unrelated to the voltage, and coarse ADCs."""

import numpy as np
from ou_monitor.online.load.blocks import DELAYS, LoadDelay
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import LoadStatus
from pushed import pushed
import pytest
from simulated_packs import flown, Pack

FLIGHT = flown(4)


@pytest.mark.parametrize('late', DELAYS)
def test_late_throttle_is_found_and_costs_nothing(late):
    t, v, u = FLIGHT
    n = round(late / 0.02)
    heard = np.concatenate((np.full(n, u[0]), u))[:t.size]
    loads, prompt = pushed(LoadFilter(), t, v, heard), pushed(LoadFilter(), t, v, u)
    load, expected = loads.load(), prompt.load()
    assert load.delay == late and expected.delay == 0.0
    assert load.known
    for throttle in (0.3, 0.5, 0.7):
        assert abs(load.sag(throttle) - expected.sag(throttle)) < load.sag_se(throttle)
    ahead = t[-1] + np.arange(0.02, 2.0, 0.02)
    stick = np.where(ahead > t[-1] + 1.0, 0.6, 0.3)
    at = np.searchsorted(ahead, t[-1] + 1.5)
    assert loads.path(ahead, stick)[at] == pytest.approx(prompt.path(ahead, stick)[at], abs=0.15)


def test_a_slow_source_cannot_tell():
    """Below 7 Hz, and of a throttle that rests, nothing is decided."""
    delay = LoadDelay()
    rng = np.random.default_rng(1)
    u = rng.random(300)
    assert not any(delay.take(float(k), 16.0 - x, y ** 1.8)
                   for k, (x, y) in enumerate(zip(u[1:], u)))
    assert not delay.unrelated
    for k in range(2000):
        assert not delay.take(300.0 + 0.02 * k, 16.0 + 0.01 * rng.standard_normal(), 0.4 ** 1.8)
    assert delay.delay == 0.0 and not delay.unrelated


@pytest.mark.parametrize('seed', range(3))
def test_a_voltage_that_moves_by_itself_is_no_answer(seed):
    """Throttle of another vehicle over another one's sags: no relation in any of 20 looks."""
    t, v, _ = FLIGHT
    rng = np.random.default_rng(seed)
    u = np.clip(0.4 + 0.2 * rng.standard_normal(134), 0.0, 1.0)[(t / 0.3).astype(int)]
    loads = LoadFilter()
    for second in range(40):
        piece = (t >= second) & (t < second + 1)
        loads.push(t[piece], v[piece], u[piece])
        if second >= 20:
            assert loads.load().status in (
                LoadStatus.NO_RELATION, LoadStatus.RISES, LoadStatus.UNCERTAIN)


def test_steps_of_the_adc_that_hide_the_answer():
    """0.05 V under steps of 0.1 V is not taken for small; under 1 mV it is known."""
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 40.0, 0.02)
    u = np.clip(0.6 + 0.05 * rng.standard_normal(161), 0.0, 1.0)[(4 * t).astype(int)]
    cell = Pack(1, 0.4, charge=0.6, size=0.15, power=1.8, endurance=2000.0)
    v = cell.path(t, u) + 0.002 * rng.standard_normal(t.size)
    coarse = pushed(LoadFilter(), t, np.round(v, 1), u).load()
    size = 0.15 * 3.8 * 0.6 ** 1.8
    assert not coarse.known or abs(coarse.sag(0.6) - size) < 3.0 * coarse.sag_se(0.6)
    fine = pushed(LoadFilter(), t, np.round(v, 3), u).load()
    assert fine.known
    swing = fine.sag(0.65) - fine.sag(0.55)
    assert swing == pytest.approx(0.15 * 3.8 * (0.65 ** 1.8 - 0.55 ** 1.8), rel=0.35)
