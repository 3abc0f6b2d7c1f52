"""Presets: the paper's numbers, and simulations that show them."""

import math

import numpy as np
from ou_monitor.simulation import PRESETS, read_profile, simulated
import pytest

# Typed from the paper's Tables 1 and 2: throttle, Vrms in mV.
VRMS = {'load_05': (0.05, 9.38), 'load_10': (0.10, 28.1), 'load_40': (0.40, 56.3)}
SIGMA = {'load_10': 0.3156, 'load_40': 0.6320}
VAR_INF = {'load_10': 7.91e-4, 'load_40': 3.17e-3}


def drawn(name, seconds, seed=1, rate=None):
    """Return t, voltage and throttle of a preset."""
    preset = PRESETS[name]
    pieces = list(simulated(preset.model, read_profile(preset.throttle), duration=seconds,
                            rate=rate or preset.rate, seed=seed))
    return tuple(np.concatenate([getattr(piece, key) for piece in pieces])
                 for key in ('t', 'voltage', 'throttle'))


def test_the_presets_and_profiles_have_these_names():
    assert set(PRESETS) == {'idle', 'load_05', 'load_10', 'load_40', 'transient', 'loads',
                            'flight', 'flight_full'}
    for preset in PRESETS.values():
        assert preset.text and preset.rate > 0.0 and preset.duration > 0.0
        assert preset.model.ou.alpha == 63.0 and preset.model.ou.u0 == 5.0


@pytest.mark.parametrize('name', sorted(VRMS))
def test_presets_have_the_rms_of_the_paper(name):
    """Vrms = sigma / sqrt(2 alpha) within the last digit printed; throttle as labelled."""
    # Table 2 prints 4 digits of sigma and 3 of Var_inf.
    throttle, vrms = VRMS[name]
    ou = PRESETS[name].model.ou
    assert float(PRESETS[name].throttle) == throttle
    assert 1e3 * ou.sigma / math.sqrt(126.0) == pytest.approx(vrms, rel=2e-3)
    if name in SIGMA:
        assert ou.sigma == pytest.approx(SIGMA[name], rel=2e-4)
        assert ou.sigma ** 2 / 126.0 == pytest.approx(VAR_INF[name], rel=2e-3)


def test_idle_reads_zero():
    """Motors off read "~0": below half a step of 9.375 mV, and some noise all the same."""
    vrms = PRESETS['idle'].model.ou.sigma / math.sqrt(126.0)
    assert 2e-3 < vrms < 4.7e-3 * (1.0 + 1e-9)


@pytest.mark.parametrize('name', sorted(VRMS))
def test_forty_seconds_show_the_table(name):
    """Vrms and Var_inf of 40 s, within 4 standard errors."""
    # The variance of an OU over T has the relative error sqrt(2/(alpha T)) = 2.8 %, Vrms half of
    # it; the mean is that of the rail to Vrms sqrt(2/(alpha T)).
    t, voltage, throttle = drawn(name, 40.0)
    assert t.size == 40_000 and set(throttle) == {float(np.float32(VRMS[name][0]))}
    error = math.sqrt(2.0 / (63.0 * 40.0))
    vrms = VRMS[name][1] * 1e-3
    assert abs(np.std(voltage) / vrms - 1.0) < 4.0 * 0.5 * error
    assert abs(voltage.mean() - 5.0) < 4.0 * vrms * error
    if name in VAR_INF:
        assert abs(np.var(voltage) / VAR_INF[name] - 1.0) < 4.0 * error
    # Loads are told apart: the nearest other Vrms is a factor 2 off.
    assert 4.0 * error < 0.2


def test_loads_follow_the_four_states():
    """10 s each: innovations give sigma to sqrt(1/(2 n)) = 0.7 %, so 4 % are seen."""
    _, voltage, throttle = drawn('loads', 40.0, seed=2)
    phi = math.exp(-0.063)
    e = (voltage[1:] - 5.0) - phi * (voltage[:-1] - 5.0)
    for load, vrms in ((0.0, 4.7e-3), (0.05, 9.38e-3), (0.1, 28.1e-3), (0.4, 56.3e-3)):
        own = e[np.isclose(throttle[1:], load)]
        assert own.size > 9990
        found = math.sqrt(own.var() / (1.0 - phi ** 2))
        assert abs(found / vrms - 1.0) < 4.0 * math.sqrt(0.5 / own.size) + 2e-3


def test_transient_is_that_of_the_figure():
    """Release of 20 %: 368 mV at once, then exp(-63 t), as the paper fits it."""
    # Averages of 40 releases, noise of 9.4 mV: to 1.5 mV. The printed points at 10 and 25 ms, 200
    # and 80 mV, are within 5 mV of that exponential.
    t, voltage, throttle = drawn('transient', 400.0, seed=3)
    assert float(throttle.max()) == pytest.approx(0.2, rel=1e-6)
    # A throttle holds until the next stamp: the decay counts from its own.
    first = np.flatnonzero(np.diff(throttle) < 0.0) + 1
    assert first.size == 40 and np.allclose(t[first] % 10.0, 6.0)
    path = np.mean([voltage[k:k + 60] - 5.0 for k in first], axis=0)
    expected = -0.368 * np.exp(-63.0 * np.arange(60) / 1000.0)
    error = 9.38e-3 / math.sqrt(40.0)
    assert np.abs(path - expected).max() < 4.5 * error
    assert abs(path[10] + 0.200) < 5e-3 + 4.0 * error
    assert abs(path[25] + 0.080) < 5e-3 + 4.0 * error


def test_flight_sags_and_is_noisy():
    """Mean at hover against that at idle: sag 0.3 V at full throttle; white noise of 2 mV."""
    # Differences at 20 kHz are of the noise: 2 std^2, and sigma^2 dt of the rail.
    t, voltage, throttle = drawn('flight', 40.0, seed=4)
    hover, idle = np.isclose(throttle, 0.4), (throttle == 0.0) & (t < 2.0)
    assert hover.sum() > 10_000
    fall = voltage[idle].mean() - voltage[hover].mean()
    # 10 s and 2 s of an OU: Vrms sqrt(2/(alpha T)).
    assert abs(fall - 0.12) < 4.0 * (56.3e-3 * math.sqrt(2.0 / 630.0)
                                     + 4.7e-3 * math.sqrt(2.0 / 126.0))
    _, voltage, _ = drawn('flight', 2.0, seed=5, rate=20_000.0)
    own = np.diff(voltage)
    truth = 2.0 * (2e-3) ** 2 + (4.7e-3) ** 2 * 126.0 / 20_000.0
    assert abs(own.var() / truth - 1.0) < 4.0 * math.sqrt(3.0 / own.size)


def test_flight_full_has_adc_steps():
    """Whole steps of 10 mV, discharge of 1 mV/s."""
    _, voltage, _ = drawn('flight_full', 10.0)
    codes = voltage / 10e-3
    assert np.abs(codes - np.rint(codes)).max() < 1e-6 and np.unique(codes).size > 5
    drift = [term for term in PRESETS['flight_full'].model.terms if term.NAME == 'drift']
    assert drift[0].rate == -1e-3
