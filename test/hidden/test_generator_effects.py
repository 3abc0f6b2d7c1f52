"""
Each part of the bench does what its parameters say, by one effect that uses it.

Measured directly by the true rail: a size is the mean of several draws over what was claimed, and
its error is that of the draws.  That every other effect is there, `test_generator` tests.
"""

from hidden_measures import (
    assert_as_claimed, assert_regression, correlation, density, each, late, rate, simulated,
    whitened)
import numpy as np
import pytest


def test_a_rail_of_two_poles_rings_where_it_should():
    """The variant without a relaxation has its peak at the frequency of its L and C."""
    for h, claimed, _ in each('resonance/lc_rail', 3):
        f, p = density(h, 1.0)
        assert abs(f[1:][np.argmax(p[1:])] - claimed['frequency_hz']) < 6.0
        assert claimed['frequency_hz'] == pytest.approx(
            1 / (2 * np.pi * np.sqrt(claimed['rail_henry'] * claimed['rail_farad'])))


@pytest.mark.parametrize('cause', [
    'quantization', 'quantization/mid_rise', 'quantization/dithered'])
def test_quantization_is_as_claimed(cause):
    """All values are on a lattice of the claimed step, many neighbours on one code."""
    for h, claimed, rail in each(cause, 3):
        codes = (h.voltage - h.voltage[0]) / claimed['step_v']
        assert np.max(np.abs(codes - np.round(codes))) < 1e-6
        assert np.min(np.diff(np.unique(np.round(codes)))) == 1
        assert claimed['full_scale_v'] > h.voltage.max()
        assert 0.45 < claimed['step_v'] / rail['innovation_v'] < 2.7


@pytest.mark.parametrize('cause, sides', [('saturation', 1), ('saturation/two_sided', 2)])
def test_saturation_is_as_claimed(cause, sides):
    for h, claimed, _ in each(cause, 4):
        on = [np.mean(h.voltage == limit) for limit in (h.voltage.min(), h.voltage.max())]
        assert sum(share > 1e-3 for share in on) == sides
        assert sum(on) == pytest.approx(sides * claimed['share'], abs=3e-4)


def test_ac_coupling_is_as_claimed():
    """A fit finds the corner of the instrument, and at zero frequency there is nothing."""
    for h, claimed, rail in each('ac_coupling', 5):
        corner = 2 * np.pi * claimed['corner_hz']
        assert corner == pytest.approx(1 / (claimed['input_ohm'] * claimed['coupling_farad']))
        x = h.voltage - h.voltage.mean()
        fitted = -1000 * np.log((x[1:] @ x[:-1]) / (x[:-1] @ x[:-1]))
        # Two poles in a row under white noise, one zero: the rates add in what one step forgets.
        assert abs(fitted / (corner + rail['alpha']) - 1) < 0.15
        phi = np.exp(-corner / 1000)
        innovation = (x[1:] - phi * x[:-1])[:60000 // 500 * 500]
        slow = innovation[:59500].reshape(-1, 3500).mean(axis=1) * np.sqrt(3500)
        assert np.mean(slow**2) < 0.3 * rail['innovation_v']**2
        assert 1.0 < rail['alpha'] < 6.6 and abs(h.voltage.mean() - claimed['bias_v']) < 0.05


def test_jumps_are_as_claimed():
    """At double strength each is a step of more than six innovations, and no sample undoes it."""
    for h, claimed, _ in each('jumps', 4, strength=2.0):
        e = whitened(h)
        big = np.abs(e) > 5
        assert abs(big.sum() - claimed['count']) <= 0.1 * claimed['count'] + 2
        where = np.flatnonzero(big[:-1])
        undone = np.mean(e[where + 1] * np.sign(e[where]))
        assert abs(undone) < 5 / np.sqrt(where.size) and np.mean(np.abs(e[where])) > 6
        assert claimed['share_up'] in (0.0, 0.5)


@pytest.mark.parametrize('cause, run', [
    ('glitches', 1), ('glitches/double', 2), ('glitches/triple', 3)])
def test_glitches_are_as_claimed(cause, run):
    """The error appears, stays for the claimed run, and goes as it came."""
    for h, claimed, rail in each(cause, 3, strength=2.0):
        e, phi = whitened(h), np.exp(-rail['alpha'] / 1000)
        far = np.flatnonzero(np.abs(e) > 6)
        first = far[np.diff(far, prepend=-10) > run][:-1]
        assert abs(first.size / (claimed['share'] * h.t.size) - 1) < 4 / np.sqrt(first.size) + 0.05
        size = np.abs(e[first]) * rail['innovation_v']
        assert abs(size.mean() / claimed['mean_size_v'] - 1) < 0.1
        back = np.mean(e[first + run] * np.sign(e[first])) / np.mean(np.abs(e[first]))
        # What follows within four samples of another one is not clean: a few per cent.
        assert abs(back + phi) < 0.1


def test_nonlinear_restoring_is_as_claimed():
    """At two standard deviations the force is off the linear one by the claimed share."""
    shapes = set()
    for h, claimed, rail in each('nonlinear_restoring', 5, duration=80.0):
        shapes.add(claimed['shape'])
        x = h.voltage - rail['level_v']
        two = 2 * rail['stationary_v']
        # A diode is stiffer on the low side only.
        x = -x if claimed['shape'] == 'diode' else x * np.sign(x)
        step = np.diff(h.voltage - rail['level_v'])
        step = -step if claimed['shape'] == 'diode' else step * np.sign(
            h.voltage[:-1] - rail['level_v'])
        near = np.abs(x[:-1] / two - 1) < 0.1
        linear = rail['alpha'] * x[:-1][near] * 1e-3
        force = -step[near].sum() / linear.sum()
        error = rail['innovation_v'] / linear.mean() / np.sqrt(near.sum())
        sign = 1 if claimed['shape'] == 'diode' else -1
        # One step of the samples already relaxes: alpha dt, up to twice 6 % where stiffer.
        room = 0.05 + rail['alpha'] * 1e-3
        assert abs(force - 1 - sign * claimed['change']) < 4 * error + room
        assert 0.25 < claimed['change'] < 0.86
    assert shapes == {'diode', 'current_limit'}


def test_clock_jitter_is_as_claimed():
    """Times wrong by d make steps of variance 1 + d' - d: kurtosis 3 (1 + 2 var d)."""
    ratios, after = [], []
    for h, claimed, _ in each('clock_jitter', 10):
        e = whitened(h)
        ratios.append((np.mean(e**4) / np.mean(e**2)**2 - 3) / (6 * claimed['std_steps']**2))
        square = np.minimum(e**2, 16)
        after.append(correlation(square[1:], square[:-1]))
    # The steps of the fine grid are 1/16, the variance of their rounding below 1 % of the rest.
    assert_as_claimed(ratios, room=0.1)
    # A long interval makes the next one short: ten scores of unit spread.
    assert np.mean(after) < -5 / np.sqrt(10)


def test_irregular_stamps_are_as_claimed():
    h = simulated('clock_jitter/stamps')
    spread = np.std(h.t * rate(h) - np.arange(h.t.size))
    assert spread == pytest.approx(h.detail['clock_jitter/stamps']['std_steps'], rel=0.02)
    assert abs(np.mean(whitened(h)**4) - 3) < 4.5 * np.sqrt(96 / h.t.size)


@pytest.mark.parametrize('cause, exponent', [
    ('load_sag', 1.0), ('load_sag/power_1.5', 1.5), ('load_sag/quadratic', 2.0)])
def test_sag_is_as_claimed(cause, exponent):
    for h, claimed, _ in each(cause, 4):
        volts = claimed['battery_ohm'] * claimed['full_current_a']
        assert volts == pytest.approx(claimed['sag_v_per_unit']) and 0.06 < volts < 0.9
        assert_regression(h, [h.throttle**exponent], -volts)


def test_sag_at_the_capacitor_comes_at_the_rate_alpha():
    for h, claimed, rail in each('load_sag/at_capacitor', 4):
        assert_regression(h, [late(h, h.throttle, 1 / rail['alpha'])], -claimed['sag_v_per_unit'])


@pytest.mark.parametrize('cause', ['load_dependent_sigma', 'load_dependent_sigma/step'])
def test_sigma_over_throttle_is_as_claimed(cause):
    """Squared innovations follow the claimed curve, and nothing is left over."""
    for h, claimed, rail in each(cause, 4):
        load = (h.throttle - h.throttle.min()) / np.ptp(h.throttle)
        low, high = claimed['sigma_low'], claimed['sigma_high']
        curve = low + (high - low) * (load > claimed['step_at'] if 'step_at' in claimed else load)
        e = whitened(h) * rail['sigma'] / curve[:-1]
        assert claimed['ratio'] == pytest.approx(high / low) and claimed['ratio'] > 1.3
        for part in (load[:-1] < 0.4, load[:-1] >= 0.4):
            assert abs(np.mean(e[part]**2) - 1) < 4.5 * np.sqrt(2 / part.sum())
        assert correlation(np.minimum(whitened(h)**2, 16), load[:-1]) > 8


@pytest.mark.parametrize('cause, shape', [
    ('load_dependent_alpha', lambda load, c: 1 + (c['ratio'] - 1) * load),
    ('load_dependent_alpha/resistance', lambda load, c: 1 / (1 + (1 / c['ratio'] - 1) * load)),
    ('load_dependent_alpha/step', lambda load, c: np.where(load > c['step_at'], c['ratio'], 1))])
def test_alpha_over_throttle_is_as_claimed(cause, shape):
    ratios = []
    for h, claimed, rail in each(cause, 6):
        curve = shape((h.throttle - h.throttle.min()) / np.ptp(h.throttle), claimed)
        curve = (curve / curve.mean())[:-1]
        x, d = h.voltage - h.voltage.mean(), np.diff(h.voltage)
        basis = np.column_stack([x[:-1], x[:-1] * (curve - 1)])
        cov = np.linalg.inv(basis.T @ basis)
        pull, change = cov @ (basis.T @ d)
        assert change / np.sqrt(cov[1, 1]) < -2.5 * rail['innovation_v']
        ratios.append(change / pull)
    # The rate of a fit is high by 4/(alpha T), some 0.1 at the slowest.
    assert_as_claimed(ratios, room=0.05)
