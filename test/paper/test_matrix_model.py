"""The matrix model of 3.1 against the matrix exponential, and its own warnings."""

import math

import numpy as np
from ou_monitor.paper.theory import matrix_model
import pytest
from scipy.linalg import expm

U0 = np.array([0.7, 0.3, -1.2])
T = np.array([0.0, 0.01, 0.05, 0.05, 0.3])


@pytest.mark.parametrize('model', [
    matrix_model(5.0, 40.0, 3.0, 63.0),
    matrix_model(63.0, 40.0, 3.0, 5.0),
    matrix_model(63.0, 40.0, -3.0, 63.0),
    matrix_model(0.0, 0.0, 3.0, 63.0),
    matrix_model(5.0, 4.0, 3.0, 6.0, printed=True),
    matrix_model(5.0, 4.0, 3.0, -5.0, printed=True),
])
def test_closed_form_is_the_matrix_exponential(model):
    """Also where two rates meet and the matrix cannot be diagonalised."""
    full = np.zeros((4, 4))
    full[:3, :3], full[:3, 3] = model.matrix, model.offset
    expected = np.array([(expm(full * t) @ np.append(U0, 1.0))[:3] for t in T])
    assert model.solve(T, U0) == pytest.approx(expected, rel=1e-11, abs=1e-13)


def test_overflow_is_one_clear_line():
    with pytest.raises(ValueError, match='unstable: the solution overflows.* [+]63 1/s'):
        matrix_model(5.0, 1.0, 1.0, 63.0, printed=True).solve([0.0, 1.0, 20.0], U0)


@pytest.mark.parametrize('arguments, message', [
    ({'alpha_p': 0.0}, 'alpha_p must be positive, got 0.0.*`printed`'),
    ({'alpha_p': -63.0}, 'alpha_p must be positive'),
    ({'alpha': -1.0}, 'alpha must be zero or positive'),
    ({'omega': math.nan}, 'omega must be finite'),
])
def test_wrong_coefficients_are_refused(arguments, message):
    values = {'alpha': 5.0, 'omega': 4.0, 'beta': 3.0, 'alpha_p': 63.0} | arguments
    with pytest.raises(ValueError, match=message):
        matrix_model(**values)


@pytest.mark.parametrize('t, u0, message', [
    ([0.0, -1.0], U0, 'must not decrease'),
    ([], U0, r'shape \(k,\)'),
    ([0.0, 1.0], [1.0, 2.0], r'u0 must have shape \(3,\)'),
    ([0.0, 1.0], [1.0, math.inf, 0.0], 'u0 must be finite'),
])
def test_wrong_times_and_states_are_refused(t, u0, message):
    with pytest.raises(ValueError, match=message):
        matrix_model(5.0, 4.0, 3.0, 63.0).solve(t, u0)
