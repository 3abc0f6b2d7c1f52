"""The power network against closed forms, integrals and simulated paths."""

from dataclasses import fields, replace
import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.paper.network import PowerNetwork, rail_at, UNITS
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

# Battery, capacitor and ESC current alone: the textbook RC.
RC = PowerNetwork(bulk_esr=0.0, mcu_current=0.0, mcu_noise=0.0)


def gains(f, a, b, c):
    """Return c (s - A)^-1 B at frequencies, Hz."""
    s = 2j * math.pi * np.asarray(f, dtype=float)[..., None, None] * np.eye(len(a)) - a
    return c @ np.linalg.solve(s, np.broadcast_to(b, (*np.shape(f), *b.shape)))


def impedance(rail, f):
    """Return the fall of a rail per ampere of ESC current, whose source is the third last."""
    k = len(rail.a) - 3
    return -(gains(f, rail.a[:k, :k], rail.a[:k, k:k + 1], rail.c[:k])[..., 0] + rail.c[k])


def density(rail, f):
    return float(2.0 * np.sum(np.abs(gains(f, rail.a, rail.b, rail.c)) ** 2))


def switching(rail):
    """Return rate, 1/s, and variance, A^2, of the ESC current."""
    return -rail.a[-3, -3], rail.b[-3, 0] ** 2 / (-2.0 * rail.a[-3, -3])


def test_rc_has_the_textbook_pole_and_variance():
    """Var = v R^2 a / (a + lambda) for a current of variance v that relaxes at lambda."""
    rail = rail_at(RC, 0.4)
    a = 1.0 / (0.04 * 470e-6)
    rate, variance = switching(rail)
    assert rail.alpha == pytest.approx(a, rel=1e-12)
    assert rail.var_inf == pytest.approx(variance * 0.04**2 * a / (a + rate), rel=1e-10)
    assert rail.mean == pytest.approx(22.2 - 0.04 * 120.0 * 0.4**1.5, rel=1e-14)


def test_esr_moves_the_pole_and_leaves_a_floor():
    """Pole 1/((R + r) C); the impedance runs from R to R || r, flat at both ends."""
    network = replace(RC, bulk_esr=0.03)
    rail = rail_at(network, 0.4)
    a, both = 1.0 / (0.07 * 470e-6), 0.04 * 0.03 / 0.07
    rate, variance = switching(rail)
    assert rail.alpha == pytest.approx(a, rel=1e-12)
    assert impedance(rail, 0.0).real == pytest.approx(0.04, rel=1e-12)
    assert np.abs(impedance(rail, [1e8, 1e9])) == pytest.approx(both, rel=1e-6)
    expected = variance * (both**2 + (0.04**2 - both**2) * a / (a + rate))
    assert rail.var_inf == pytest.approx(expected, rel=1e-10)
    large = rail_at(replace(network, bulk_capacitance=1e3), 0.4)
    assert large.var_inf == pytest.approx(variance * both**2, rel=1e-6)


def test_a_noise_slower_than_the_network_gives_its_own_rate():
    rail = rail_at(replace(RC, bulk_capacitance=10e-6), 0.4)
    assert rail.alpha == pytest.approx(48e3 / 0.24, rel=1e-9)


def test_constant_power_is_a_negative_resistance():
    """The bus sees R / (1 - R P/V^2), at the voltage where the regulator takes P."""
    network = PowerNetwork(mcu_current=3.0)
    rail = rail_at(network, 0.4)
    power = 5.0 * 3.0 / 0.9
    current = network.current_at(0.4)
    assert rail.mean == pytest.approx(22.2 - 0.04 * (current + power / rail.mean), rel=1e-13)
    through = 0.04 / (1.0 - 0.04 * power / rail.mean**2)
    assert rail.alpha == pytest.approx(1.0 / ((through + 0.03) * 470e-6), rel=1e-10)
    assert impedance(rail, 0.0).real == pytest.approx(through, rel=1e-12)


def test_the_regulated_rail_in_its_own_noise():
    """Without ESC noise it is an RC with ESR: output resistance, capacitor, MCU current."""
    network = PowerNetwork(switching_scale=0.0, output_esr=0.02)
    rail = rail_at(network, 0.4, 'regulated')
    a, both, rate = 1.0 / (0.05 * 44e-6), 0.03 * 0.02 / 0.05, 1e6
    expected = 0.05**2 * (both**2 + (0.03**2 - both**2) * a / (a + rate))
    assert rail.var_inf == pytest.approx(expected, rel=1e-9)
    assert rail.alpha == pytest.approx(a, rel=1e-9)
    assert rail.mean == pytest.approx(5.0 - 0.03 * 0.5)


def test_without_a_regulator_the_source_feeds_the_load_alone():
    network = PowerNetwork(cells=0, battery_voltage=5.0, current_max=10.0, regulator_voltage=0.0)
    rail = rail_at(network, 0.4)
    assert rail.sag == pytest.approx(0.04 * network.current_at(0.4), rel=1e-12)
    assert rail.alpha == pytest.approx(1.0 / ((0.04 + 0.03) * 470e-6), rel=1e-10)
    assert impedance(rail, 0.0).real == pytest.approx(0.04, rel=1e-12)
    with pytest.raises(ValueError, match='no regulated rail'):
        rail_at(network, 0.4, 'regulated')


@pytest.mark.parametrize('network', [PowerNetwork(), PowerNetwork(line_gain=0.01)])
def test_the_regulator_passes_what_is_faster_than_its_bandwidth(network):
    """Bus to output: gain s/(s + w) times (1 + s r C)/(1 + s (Ro + r) C)."""
    f = np.array([0.0, 1.0, 1e3, 2e4, 1e5, 1e7])
    s = 2j * math.pi * f
    ratio = network.line_feedthrough * s / (s + 2.0 * math.pi * 20e3) * (
        1.0 + s * 0.003 * 44e-6) / (1.0 + s * 0.033 * 44e-6)
    bus, regulated = (impedance(rail_at(network, 0.4, name), f) for name in ('bus', 'regulated'))
    assert regulated == pytest.approx(ratio * bus, rel=1e-9, abs=1e-15)
    assert PowerNetwork().line_feedthrough == pytest.approx(5.0 / 22.2)


@pytest.mark.parametrize('network', [PowerNetwork(), PowerNetwork(flutter=0.05)])
@pytest.mark.parametrize('rail', ['bus', 'regulated'])
def test_variance_is_the_integral_of_the_density(network, rail):
    """Lyapunov's equation against quadrature of the one-sided PSD over ln f."""
    here = rail_at(network, 0.4, rail)
    area = quad(lambda x: density(here, math.exp(x)) * math.exp(x), math.log(1e-4),
                math.log(1e11), limit=500, epsrel=1e-8)[0]
    assert here.var_inf == pytest.approx(area, rel=1e-5)


def test_ripple_is_largest_at_two_thirds_and_independent_escs_add_in_power():
    throttles = np.linspace(0.0, 1.0, 301)
    rms = [math.sqrt(switching(rail_at(PowerNetwork(), float(u)))[1]) for u in throttles]
    assert throttles[np.argmax(rms)] == pytest.approx(2.0 / 3.0, abs=0.004)
    assert rms[0] == rms[-1] == 0.0
    one, four = (switching(rail_at(PowerNetwork(escs=n), 0.4))[1] for n in (1, 4))
    assert four == pytest.approx(one / 4.0)


def test_without_noise_the_rate_is_nan():
    rail = rail_at(PowerNetwork(), 0.0)
    assert rail.var_inf == 0.0 and math.isnan(rail.alpha)
    assert rail.crossing_rate(19.8) == 0.0 and math.isinf(rail.crossing_rate(22.5))


resistances = st.floats(0.005, 0.2)
networks = st.builds(
    PowerNetwork, battery_resistance=resistances, bulk_capacitance=st.floats(10e-6, 10e-3),
    bulk_esr=st.floats(0.0, 0.3), current_max=st.floats(5.0, 80.0),
    esc_frequency=st.floats(8e3, 96e3), flutter=st.floats(0.0, 0.1),
    mcu_current=st.floats(0.0, 5.0), line_gain=st.none() | st.floats(0.001, 1.0))


@settings(max_examples=150, deadline=None)
@given(networks, st.floats(0.05, 0.95), st.floats(1.05, 10.0), st.booleans())
def test_capacitance_lowers_the_variance(network, throttle, factor, follows):
    """On both rails, whether the ESR stays or falls; the means stay."""
    esr = network.bulk_esr / (factor if follows else 1.0)
    more = replace(network, bulk_capacitance=factor * network.bulk_capacitance, bulk_esr=esr)
    for name in ('bus', 'regulated'):
        a, b = rail_at(network, throttle, name), rail_at(more, throttle, name)
        assert b.var_inf <= a.var_inf * (1.0 + 1e-9)
        assert b.mean == a.mean
    if follows and network.flutter == 0.0:
        a, b = rail_at(network, throttle), rail_at(more, throttle)
        assert b.alpha <= a.alpha * (1.0 + 1e-6)


@pytest.mark.parametrize('name', sorted(UNITS))
@pytest.mark.parametrize('value', [-1.0, math.nan, math.inf, '5', True])
def test_impossible_components_are_refused(name, value):
    with pytest.raises(ValueError, match=name) as error:
        PowerNetwork(**{name: value})
    assert f' {UNITS[name]}'.rstrip() in str(error.value)


@pytest.mark.parametrize('name', [
    part.name for part in fields(PowerNetwork) if not part.metadata.get('zero', True)])
def test_zero_is_refused_where_it_means_nothing(name):
    with pytest.raises(ValueError, match=f'{name} must be positive'):
        PowerNetwork(**{name: 0})


@pytest.mark.parametrize('values, words', [
    ({'cells': 5.5}, 'whole number'), ({'regulator_efficiency': 1.1}, 'at most 1'),
    ({'regulator_voltage': 24.0}, 'below battery_voltage'),
    ({'current_exponent': 0.5}, 'at least 1')])
def test_values_that_contradict_are_refused(values, words):
    with pytest.raises(ValueError, match=words):
        PowerNetwork(**values)


@pytest.mark.parametrize('throttle, words', [
    (-0.1, 'throttle'), (1.1, 'throttle'), (math.nan, 'throttle')])
def test_bad_throttles_are_refused(throttle, words):
    with pytest.raises(ValueError, match=words):
        rail_at(PowerNetwork(), throttle)


def test_a_load_beyond_the_battery_is_refused():
    with pytest.raises(ValueError, match='battery cannot supply the load at throttle 0.9'):
        rail_at(PowerNetwork(current_max=600.0), 0.9)
    with pytest.raises(ValueError, match="'bus' or 'regulated'"):
        rail_at(PowerNetwork(), 0.4, 'motor')


def test_crossing_rate_of_a_rough_rail_is_that_of_its_ou():
    """With hardly a capacitor the bus is R times the current, an OU."""
    # At d standard deviations the passage rate differs from its limit by a factor 1 - 1/d^2.
    rail = rail_at(replace(RC, bulk_capacitance=1e-12, bulk_esr=10.0), 0.4)
    d = 8.0
    level = rail.mean - d * math.sqrt(rail.var_inf)
    exact = rail.alpha / mean_first_passage(0.0, d)
    assert rail.crossing_rate(level) == pytest.approx(exact, rel=2.0 / d**2)


def test_crossing_rate_of_a_smooth_rail_is_counted():
    """Rice's rate against the downcrossings in 4000 paths without ESR."""
    # 1333 passages are expected. Over 20 seeds their number had 1.3 times the variance of a
    # Poisson count, and 1.5 % were missed between the steps.
    rail = rail_at(RC, 0.4)
    d, dt, paths, steps = 2.0, 5e-7, 4000, 300
    transition = expm(rail.a * dt)
    # What a step adds is what the stationary covariance has lost by it.
    covariance = rail.covariance - transition @ rail.covariance @ transition.T
    rng = np.random.default_rng(3)
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    x = rng.multivariate_normal(np.zeros(len(rail.a)), rail.covariance, paths, method='eigh')
    level, count = -d * math.sqrt(rail.var_inf), 0
    for _ in range(steps):
        above = x @ rail.c > level
        x = x @ transition.T + rng.standard_normal(x.shape) @ root.T
        count += int(np.sum(above & (x @ rail.c <= level)))
    expected = rail.crossing_rate(rail.mean + level) * paths * steps * dt
    assert 500.0 < expected
    assert abs(count - expected) < 5.0 * math.sqrt(1.3 * expected) + 0.015 * expected
