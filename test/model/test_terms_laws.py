"""Shared parts of fits of terms: standard errors, mixtures, runs, the view."""

from itertools import combinations
import math

import numpy as np
from ou_monitor.model.terms.shocks import _best_runs
from ou_monitor.model.terms.term import climb, curvature_se, mixture_cdf, normal_scores, refine
import pytest
from scipy.stats import norm


def test_standard_errors_are_those_of_a_parabola():
    """A log-likelihood of 3 - sum (x/s)^2/2 has the errors s; one that is not curved has none."""
    s = np.array([0.02, 1.0, 7.0])
    at = np.array([0.3, -2.0, 0.0])

    def value(x):
        return 3.0 - 0.5 * float((((x - at) / s) ** 2).sum())

    assert curvature_se(value, at) == pytest.approx(s, rel=1e-6)
    # The second difference of a parabola is exact whatever the step, and off the top too.
    assert curvature_se(value, at + 1.0, step=0.5) == pytest.approx(s, rel=1e-6)
    # The step of a cosine: (2 cos(h) - 2)/h^2.
    assert curvature_se(lambda x: math.cos(x[0]), np.zeros(1)) == pytest.approx(
        [0.05 / math.sqrt(2.0 - 2.0 * math.cos(0.05))], rel=1e-9)
    for flat in (lambda x: 4.0, lambda x: x[0], lambda x: x[0] ** 2):
        assert math.isnan(curvature_se(flat, np.zeros(1))[0])


def test_the_climb_finds_the_top_of_a_parabola():
    at, top = climb(lambda x: 5.0 - (x[0] - 0.4) ** 2 - 3.0 * (x[1] + 1.0) ** 2, np.zeros(2), 0.5,
                    most=400)
    assert at == pytest.approx([0.4, -1.0], abs=0.02) and top == pytest.approx(5.0, abs=0.01)


def test_a_mixture_has_the_weighted_chance():
    z = np.linspace(-4.0, 5.0, 19)
    weight, mean, std = np.array([0.3, 0.7]), np.array([-1.0, 2.0]), np.array([0.5, 3.0])
    assert mixture_cdf(z, weight, mean, std) == pytest.approx(
        0.3 * norm.cdf(z, -1.0, 0.5) + 0.7 * norm.cdf(z, 2.0, 3.0), rel=1e-12)


@pytest.mark.parametrize('seed', range(20))
def test_best_runs_are_the_best_of_all_choices(seed):
    """Seven runs, all 128 choices of them: the largest sum of gains of runs that are apart."""
    rng = np.random.default_rng(seed)
    begin = rng.integers(0, 20, 7)
    end, gain = begin + rng.integers(1, 6, 7), rng.random(7)

    def apart(some):
        return all(end[i] < begin[j] or end[j] < begin[i] for i, j in combinations(some, 2))

    choices = [some for k in range(8) for some in combinations(range(7), k) if apart(some)]
    best = max(choices, key=lambda some: sum(gain[k] for k in some))
    expected = np.zeros(30, dtype=bool)
    for k in best:
        expected[begin[k]:end[k]] = True
    assert _best_runs(begin, end, gain, 30).tolist() == expected.tolist()


@pytest.mark.parametrize('start', [(0.0, 0.0), (0.9, -1.6), (0.4, -1.0)])
def test_newton_finds_the_top_that_is_near(start):
    bend = np.array([[40.0, 12.0], [12.0, 9.0]])
    top = np.array([0.4, -1.0])

    def values(x):
        return 5.0 - 0.5 * np.einsum('ki,ij,kj->k', x - top, bend, x - top)

    at, most, errors = refine(values, start)
    assert 5.0 - most < 0.05 and most == pytest.approx(float(values(at[None])[0]))
    assert errors == pytest.approx(np.sqrt(np.diag(np.linalg.inv(bend))), rel=1e-6)
    assert curvature_se(lambda x: float(values(x[None])[0]), top) == pytest.approx(errors)


def test_newton_gives_up_where_nothing_is_curved():
    """Nor where there is no number; its steps are half a unit at most."""
    assert refine(lambda x: x[:, 0], [0.0]) is None
    assert refine(lambda x: x[:, 0] ** 2, [1.0]) is None
    assert refine(lambda x: np.full(len(x), math.inf), [0.0]) is None
    assert refine(lambda x: -(x[:, 0] - 1.4) ** 2, [0.0])[0] == pytest.approx([1.4], abs=0.25)


def test_scores_of_certain_probabilities_are_finite():
    """Some eight deviations on either side; the middle is 0."""
    low, middle, high = normal_scores(np.array([0.0, 0.5, 1.0]))
    assert -8.3 < low < -7.9 and middle == 0.0 and 7.9 < high < 8.3
