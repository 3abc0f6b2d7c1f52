"""First passage: its law and its mean against closed forms, published values, simulations."""

from concurrent.futures import ThreadPoolExecutor
import math

from hypothesis import given, settings, strategies as st
import numpy as np
from ou_monitor.model import passage as law
from ou_monitor.model.passage import mean_first_passage, passage_probability, prepare
import pytest
from scipy.integrate import quad, trapezoid
from scipy.special import log_ndtr, ndtr, pbdv


@pytest.mark.parametrize('start, barrier, expected', [
    (0.0, 1.0, 2.0934066496783218), (0.0, 0.0, 0.0), (2.0, 1.0, 0.0)])
def test_mean_first_passage_has_known_values(start, barrier, expected):
    assert mean_first_passage(start, barrier) == pytest.approx(expected, rel=1e-12)


def test_out_of_reach_is_never():
    assert mean_first_passage(0.0, 40.0) == math.inf


# What the table is allowed to be off by, relative to P.
TABLE = 1e-3


def test_the_normal_law_is_scipys():
    """To the last digits but three; its logarithm far below and far above, too."""
    x = np.concatenate((np.linspace(-60.0, 10.0, 701), [-1e200, -np.inf, np.inf, np.nan]))
    np.testing.assert_allclose(law.normal_below(x[x > -37.0]), ndtr(x[x > -37.0]), rtol=1e-13)
    np.testing.assert_allclose(law.log_normal_below(x), log_ndtr(x), rtol=1e-13, atol=1e-88)
    assert law.normal_below(np.empty((0, 2))).shape == (0, 2)


def constant_pull(gap, barrier, span):
    """Return the passage of a Brownian motion with the drift of the OU at the barrier."""
    wide = math.sqrt(2.0 * span)
    return (ndtr((-gap - barrier * span) / wide)
            + math.exp(-barrier * gap + log_ndtr((-gap + barrier * span) / wide)))


@pytest.mark.parametrize('span', [1e-5, 1e-3, 0.1, 1.0, 5.0, 20.0])
def test_a_barrier_at_the_mean_has_its_closed_form(span):
    """2 Phi(-|x| e^-s / sqrt(1 - e^-2s)): by symmetry; down to 1e-12."""
    y = np.array([0.05, 0.5, 1.0, 2.0, 4.0, 7.0])
    x = -y * math.sqrt(math.expm1(2.0 * span))
    x = x[x > -20.0]
    expected = 2.0 * ndtr(x / math.sqrt(math.expm1(2.0 * span)))
    np.testing.assert_allclose(passage_probability(x, 0.0, span), expected, rtol=TABLE)


def log_cylinder(p, z):
    """Return ln D_-p(z) for p > 0, from its integral (DLMF 12.5.1)."""
    # For p > 1; scipy's pbdv, good for small p, is off by 0.3 % at p = 60 here and there.
    if p <= 1.0:
        return math.log(pbdv(-p, z)[0])

    def log(t):
        return (p - 1.0) * math.log(t) - 0.5 * t * t - z * t

    top = 0.5 * (-z + math.sqrt(z * z + 4.0 * (p - 1.0)))
    wide = 12.0 / math.sqrt(1.0 + (p - 1.0) / top ** 2)
    total, _ = quad(lambda t: math.exp(log(t) - log(top)), max(1e-9, top - wide), top + wide,
                    epsrel=1e-12, limit=200)
    return math.log(total) + log(top) - 0.25 * z * z - math.lgamma(p)


@pytest.mark.parametrize('barrier', [-2.5, 0.0, 2.0, 5.0])
@pytest.mark.parametrize('gap', [0.1, 1.0, 3.0])
@pytest.mark.parametrize('p', [0.03, 1.0, 8.0, 60.0])
def test_the_laplace_transform_is_that_of_parabolic_cylinders(barrier, gap, p):
    """E exp(-p T) = exp((x^2 - b^2)/4) D_-p(-x) / D_-p(-b); as small as 1e-14."""
    x = barrier - gap
    expected = math.exp((x * x - barrier * barrier) / 4.0 + log_cylinder(p, -x)
                        - log_cylinder(p, -barrier))
    log = np.linspace(math.log(1e-8 / p), math.log(60.0 / p), 5000)
    s = np.exp(log)
    got = trapezoid(p * np.exp(-p * s) * passage_probability(x, barrier, s) * s, log)
    assert got == pytest.approx(expected, rel=TABLE)


@pytest.mark.parametrize('barrier', [-3.0, 0.0, 2.0, 9.0, 25.0])
@pytest.mark.parametrize('w', [0.1, 1.0, 3.0, 6.0])
def test_short_spans_are_those_of_a_brownian_motion(barrier, w):
    """A Brownian motion with constant drift, to order w^2 s; within and below the table."""
    for span in (1e-5, 1e-7):
        gap = w * math.sqrt(2.0 * span)
        assert passage_probability(barrier - gap, barrier, span) == pytest.approx(
            constant_pull(gap, barrier, span), rel=TABLE + 3.0 * w * w * span)


@pytest.mark.parametrize('barrier', [45.0, 100.0])
def test_very_far_barriers_have_a_constant_pull(barrier):
    """Near them the pull is constant; the mean is out of reach."""
    gap, span = 1.0 / barrier, 0.3 / barrier ** 2
    assert passage_probability(barrier - gap, barrier, span) == pytest.approx(
        constant_pull(gap, barrier, span), rel=0.02)
    assert passage_probability(0.0, barrier, 1e5) < 1e-100


@pytest.mark.parametrize('barrier, rate', [
    (1.0, 0.3882382947067829), (2.0, 0.0972745958588434)])
def test_long_run_rate_published(barrier, rate):
    """The smallest zero of D_nu(-b)."""
    p = passage_probability(0.0, barrier, [12.0, 20.0])
    assert math.log((1.0 - p[0]) / (1.0 - p[1])) / 8.0 == pytest.approx(rate, rel=1e-4)


@pytest.mark.parametrize('barrier', [6.0, 8.5, 12.0, 20.0])
def test_rare_passages_come_at_the_inverse_of_the_mean_time(barrier):
    """P = s / T to order 1/s and s/T, across the end of the table."""
    for span in (1e3, 1e5):
        expected = -math.expm1(-span / mean_first_passage(0.0, barrier))
        assert passage_probability(0.0, barrier, span) == pytest.approx(
            expected, rel=TABLE + 5.0 / span)


levels = st.floats(-6.0, 9.0)
spans = st.floats(-4.0 * math.log(10.0), 5.0 * math.log(10.0)).map(math.exp)


@settings(max_examples=300, deadline=None)
@given(levels, levels, levels, spans, spans)
def test_more_time_or_a_nearer_barrier_is_no_less_likely(x, b, c, s, r):
    near, far = min(b, c), max(b, c)
    short, long = min(s, r), max(s, r)
    p = passage_probability([x, x, x], [near, far, near], [short, short, long])
    assert ((p >= 0.0) & (p <= 1.0)).all()
    slack = 1.0 + 2.0 * TABLE
    assert p[1] <= p[0] * slack + 1e-13 and p[0] <= p[2] * slack + 1e-13
    q = passage_probability([near, far], x, s)
    assert q[0] <= q[1] * slack + 1e-13


def test_the_ends_are_certain_impossible_or_unknown():
    """1 at or beyond the barrier, 0 without time, 1 for ever; NaN where something is unknown."""
    p = passage_probability([2.0, 3.0, 0.0, 0.0, math.nan, 0.0, 0.0, 0.0, -math.inf, 0.0],
                            [2.0, 2.0, 2.0, 2.0, 2.0, math.nan, 2.0, math.inf, 2.0, -math.inf],
                            [0.0, 1.0, 0.0, math.inf, 1.0, 1.0, math.nan, 1.0, 1.0, 1.0])
    np.testing.assert_array_equal(p, [1, 1, 0, 1, math.nan, math.nan, math.nan, 0, 0, 1])
    assert passage_probability(0.0, 1.0, 1.0).shape == ()
    assert passage_probability(np.zeros((2, 1)), np.ones(3), 1.0).shape == (2, 3)
    assert passage_probability([], 1.0, 1.0).size == 0


def test_negative_span_is_refused():
    with pytest.raises(ValueError, match='span must be zero or positive'):
        passage_probability(0.0, 1.0, -1.0)


def test_one_table_for_all_threads():
    with ThreadPoolExecutor(4) as pool:
        tables = list(pool.map(lambda _: prepare(), range(8)))
    assert all(table is tables[0] for table in tables)
