"""The matrix model of 3.1 against the matrix exponential, quadrature and its own warnings."""

import math
import re

import numpy as np
from ou_monitor.paper.theory.matrix_model import MatrixModel
import pytest
from scipy.integrate import quad
from scipy.linalg import expm

U0 = np.array([0.7, 0.3, -1.2])
T = np.array([0.0, 0.01, 0.05, 0.05, 0.3])


@pytest.mark.parametrize('model', [
    MatrixModel(5.0, 40.0, 3.0, 63.0),
    MatrixModel(63.0, 40.0, 3.0, 5.0),
    MatrixModel(63.0, 40.0, -3.0, 63.0),
    MatrixModel(0.0, 0.0, 3.0, 63.0),
    MatrixModel(5.0, 4.0, 3.0, 6.0, phase='printed'),
    MatrixModel.as_printed(5.0, 4.0, 3.0, 6.0),
    MatrixModel.as_printed(5.0, 4.0, 3.0, -5.0),
])
def test_closed_form_is_the_matrix_exponential(model):
    """Also where two rates meet and the matrix cannot be diagonalised."""
    full = np.zeros((4, 4))
    full[:3, :3], full[:3, 3] = model.matrix(), model.offset()
    expected = np.array([(expm(full * t) @ np.append(U0, 1.0))[:3] for t in T])
    assert model.solve(T, U0) == pytest.approx(expected, rel=1e-11, abs=1e-13)
    assert model.at().solve(T, U0) == pytest.approx(expected, rel=1e-11, abs=1e-13)


def test_rates_that_nearly_meet_keep_their_digits():
    """Beta A0 t exp(-alpha t) when the rates differ in the twelfth digit."""
    model = MatrixModel(63.0, 0.0, 3.0, 63.0 * (1.0 + 1e-12))
    power = model.solve([0.0, 0.02], [2.0, 0.0, 0.0])[1, 2]
    assert power == pytest.approx(3.0 * 2.0 * 0.02 * math.exp(-63.0 * 0.02), rel=1e-10)


def test_as_printed_is_the_matrix_of_the_paper():
    alpha, omega, beta, gamma = 5.0, 4.0, 3.0, 63.0
    model = MatrixModel.as_printed(alpha, omega, beta, gamma)
    assert model.matrix().tolist() == [[-alpha, 0, 0], [0, omega, 0], [beta, 0, gamma]]
    assert model.offset().tolist() == [0.0, 0.0, 0.0]


def test_the_sign_decides_between_relaxation_and_growth():
    """After five relaxation times P has gone by exp(-5) or grown by exp(5)."""
    t, u0 = [0.0, 5.0 / 63.0], [0.0, 0.0, 1.0]
    assert MatrixModel(5.0, 4.0, 0.0, 63.0).solve(t, u0)[1, 2] == pytest.approx(math.exp(-5.0))
    printed = MatrixModel(5.0, 4.0, 0.0, 63.0, power_sign='printed')
    assert printed.solve(t, u0)[1, 2] == pytest.approx(math.exp(5.0))
    assert MatrixModel(5.0, 4.0, 3.0, 63.0).stability().stable
    assert re.match(r'unstable: power grows as exp\(63 t\).*-alpha_p', printed.stability().text)


def test_the_printed_phase_grows_and_the_carrier_advances():
    printed = MatrixModel.as_printed(5.0, 4.0, 3.0, -63.0)
    assert printed.stability().growing == ('phase',)
    assert 'dphi/dt = omega' in printed.stability().text
    carrier = MatrixModel(5.0, 2.0 * math.pi * 50.0, 3.0, 63.0)
    assert carrier.solve([0.0, 0.04], [0.0, 0.1, 0.0])[1, 1] == pytest.approx(
        0.1 + 4.0 * math.pi)


def test_time_varying_coefficients_against_quadrature():
    """A and P by one-dimensional integrals, which the integrator does not use."""
    model = MatrixModel(
        lambda t: 5.0 + 3.0 * math.sin(40.0 * t), lambda t: 10.0 * t,
        lambda t: 2.0 + math.cos(t), lambda t: 63.0 / (1.0 + t))
    assert not model.is_constant
    end = 0.4
    found = model.solve([0.0, 0.1, end], U0)[-1]

    def amplitude(t):
        return U0[0] * math.exp(-5.0 * t - 3.0 / 40.0 * (1.0 - math.cos(40.0 * t)))

    def carried(t):
        """P(end) of a unit of P at t: exp(-integral of 63 / (1 + s))."""
        return ((1.0 + t) / (1.0 + end)) ** 63

    fed = quad(lambda t: (2.0 + math.cos(t)) * amplitude(t) * carried(t), 0.0, end,
               epsabs=1e-13, epsrel=1e-12)[0]
    assert found == pytest.approx(
        [amplitude(end), U0[1] + 5.0 * end**2, U0[2] * carried(0.0) + fed], rel=1e-7)


def test_integration_of_constant_functions_is_the_closed_form():
    constant = MatrixModel(5.0, 40.0, 3.0, 63.0)
    varying = MatrixModel(lambda t: 5.0, 40.0, lambda t: 3.0, 63.0)
    assert varying.solve(T, U0) == pytest.approx(constant.solve(T, U0), rel=1e-7, abs=1e-9)


def test_a_short_step_resolves_a_short_event():
    """A load of 1 ms in 10 s: beta acts for 1 ms, so P gains 1 mV (alpha, alpha_p small)."""
    model = MatrixModel(0.0, 0.0, lambda t: 1.0 if 5.0037 <= t < 5.0047 else 0.0, 1e-6)
    found = model.solve([0.0, 10.0], [1.0, 0.0, 0.0], max_step=2e-4)[1, 2]
    assert found == pytest.approx(1e-3, rel=0.01)


def test_overflow_is_one_clear_line():
    with pytest.raises(ValueError, match='overflows at t = 20 s: unstable: power grows'):
        MatrixModel(5.0, 1.0, 1.0, 63.0, power_sign='printed').solve([0.0, 1.0, 20.0], U0)


@pytest.mark.parametrize('arguments, message', [
    ({'alpha_p': 0.0}, "alpha_p must be positive, got 0.0.*power_sign='printed'"),
    ({'alpha_p': -63.0}, 'alpha_p must be positive'),
    ({'alpha': -1.0}, 'alpha must be zero or positive'),
    ({'omega': math.nan}, 'omega must be finite'),
    ({'power_sign': 'plus'}, "power_sign must be 'decaying' or 'printed'"),
    ({'phase': 'linear'}, "phase must be 'carrier' or 'printed'"),
])
def test_wrong_coefficients_are_refused(arguments, message):
    values = {'alpha': 5.0, 'omega': 4.0, 'beta': 3.0, 'alpha_p': 63.0} | arguments
    with pytest.raises(ValueError, match=message):
        MatrixModel(**values)


@pytest.mark.parametrize('t, u0, message', [
    ([0.0, -1.0], U0, 'must not decrease'),
    ([], U0, r'shape \(k,\)'),
    ([0.0, 1.0], [1.0, 2.0], r'u0 must have shape \(3,\)'),
    ([0.0, 1.0], [1.0, math.inf, 0.0], 'u0 must be finite'),
])
def test_wrong_times_and_states_are_refused(t, u0, message):
    with pytest.raises(ValueError, match=message):
        MatrixModel(5.0, 4.0, 3.0, 63.0).solve(t, u0)


def test_a_coefficient_out_of_range_later_is_named_with_its_time():
    model = MatrixModel(5.0, 4.0, 3.0, lambda t: 1.0 - t)
    with pytest.raises(ValueError, match=r'alpha_p must be positive, got .* at t = [12]'):
        model.solve([0.0, 2.0], U0)


@pytest.mark.parametrize('option', ['rtol', 'max_step'])
@pytest.mark.parametrize('value', [0.0, -1.0, math.nan])
def test_options_that_are_not_positive_are_refused(option, value):
    with pytest.raises(ValueError, match=f'{option} must be positive'):
        MatrixModel(5.0, 4.0, 3.0, lambda t: 63.0).solve([0.0, 1.0], U0, **{option: value})
