"""The whole fit from autocovariances: truth in, truth out; the trend; the pull."""

import math

from dense import block_autocovariances
import numpy as np
from ou_monitor.model import arma
import pytest
from scipy.linalg import toeplitz

LAGS = 60


@pytest.mark.parametrize('m', [1, 4, 32])
@pytest.mark.parametrize('a, share', [(0.1, 0.3), (0.01, 0.05), (0.5, 0.0), (0.03, 2.0)])
def test_exact_autocovariances_give_the_truth(a, share, m):
    """
    A billion samples of the model: alpha, scale and noise come back.

    theta^60 is what the lags leave out: 1e-10 at most but for the last case,
    where it is 1e-7.
    """
    scale = 0.4
    gamma = scale * block_autocovariances(a, m, LAGS + 1)
    n = 10 ** 9
    got = arma.fit_still(
        gamma[0] + scale * share, gamma[1:].tolist(), n, 0.0, [0.0] * LAGS, [float(n)] * LAGS,
        math.nan, math.nan, m)
    got_a, theta, q, got_scale, got_share, score, *variances, trend = got
    assert got_a == pytest.approx(a, rel=1e-4)
    assert theta == pytest.approx(arma.theta_at(a, m, share), abs=1e-4)
    assert got_scale == pytest.approx(scale, rel=1e-4)
    assert got_share == pytest.approx(share, rel=1e-3, abs=1e-3)
    assert q == pytest.approx(scale * arma.innovation_variance(a, theta, m), rel=1e-4)
    assert variances == pytest.approx(arma.log_covariance(got_a, theta, m, n), rel=1e-6)
    assert trend == pytest.approx(0.0, abs=1e-6)
    assert (score > 10.0) == (share > 0.0)


def test_start_does_not_matter():
    """From no start, the truth and afar the search ends within STEADY squared."""
    gamma = block_autocovariances(0.1, 4, LAGS + 1)
    c0, c = gamma[0] + 0.2, gamma[1:].tolist()
    ends = [arma.fit_still(c0, c, 2000, 0.0, [0.0] * LAGS, [2000.0] * LAGS, *start, 4)
            for start in ((math.nan, math.nan), (math.log(0.1), 0.1), (-6.0, 0.9), (0.5, -0.2))]
    for end in ends[1:]:
        assert end[0] == pytest.approx(ends[0][0], rel=1e-5)
        assert end[3] == pytest.approx(ends[0][3], rel=1e-5)


def test_pull_is_a_tenth_of_a_standard_error_and_fades():
    """
    0.088 standard errors at a score of 1, none to speak of from 6 on.

    ln(a) moves along as the information says, and theta is never pulled past
    "no noise".
    """
    a, n = 0.1, 2000
    c = block_autocovariances(a, 1, LAGS + 1)
    i_aa, i_at, i_tt = arma.information(math.log(a), 0.0)
    se = math.sqrt(i_aa / (i_aa * i_tt - i_at ** 2) / n)
    moved = {}
    for score in (0.01, 1.0, 6.0):
        end = arma.finish(c[0], c[1:].tolist(), n, n - 1.0, math.log(a), score * se,
                          False, 1)
        moved[score] = score - end[1] / se
        assert end[5] == pytest.approx(score, rel=0.05)
        i_aa, i_at, _ = arma.information(math.log(a), score * se)
        assert math.log(end[0] / a) == pytest.approx(
            i_at / i_aa * moved[score] * se, rel=0.01, abs=1e-9)
    # Half or twice the pull lies outside; the spread differs by some percent from se.
    assert 0.06 < moved[1.0] < 0.13
    assert moved[0.01] == pytest.approx(0.01, abs=1e-6)
    assert moved[6.0] < 0.003


def test_on_the_bound_there_is_no_noise():
    """Neither share nor score nor pull."""
    c = block_autocovariances(0.1, 1, LAGS + 1)
    end = arma.finish(c[0], c[1:].tolist(), 2000, 1999.0, math.log(0.1), 0.0, True, 1)
    assert end[1] == 0.0 and end[4] == 0.0 and end[5] == 0.0


@pytest.mark.parametrize('seed', range(5))
@pytest.mark.parametrize('slope', [0.0, 4.0, -10.0])
def test_trend_score_is_that_of_generalised_least_squares(seed, slope):
    """
    The slope over its error, with the dense covariance of the noise.

    n a = 100 relaxations: the two at the ends shift a score by some 2/sqrt(100).
    """
    rng = np.random.default_rng(seed)
    n, a, share = 1000, 0.1, 0.3
    gamma = block_autocovariances(a, 1, n)
    cov = toeplitz(gamma) + share * np.eye(n)
    number = np.arange(float(n))
    y = np.linalg.cholesky(cov) @ rng.standard_normal(n) + slope * number / n
    x = np.column_stack([np.ones(n), number / n - 0.5])
    solved = np.linalg.solve(cov, np.column_stack([x, y]))
    gram = np.column_stack([x, y]).T @ solved
    beta_cov = np.linalg.inv(gram[:2, :2])
    beta = beta_cov @ gram[:2, 2]
    scale = (gram[2, 2] - gram[2, :2] @ beta) / n
    expected = beta[1] / math.sqrt(beta_cov[1, 1] * scale)
    lags = range(1, 25)
    c0 = float(y.var())
    c = [c0 - float(np.mean((y[k:] - y[:-k]) ** 2)) / 2.0 for k in lags]
    place = float(np.mean((y - y.mean()) * (number / n)))
    got = arma.trend_score(c0, c, n, place, [float((y[k:] - y[:-k]).sum()) for k in lags],
                           [float(n - k) for k in lags], math.log(a),
                           arma.theta_at(a, 1, share))
    assert got == pytest.approx(expected, rel=0.05, abs=0.3)
