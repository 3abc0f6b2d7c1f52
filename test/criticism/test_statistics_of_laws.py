"""Statistics of scores against closed forms, exact tails and dense sums."""

from itertools import combinations
import math

import numpy as np
from ou_monitor.criticism.score_statistics import Covariates, is_sign, statistics
import pytest
from scipy import stats

RATE = 512.0


def plain(z, **changes):
    """Return the statistics of scores with a state that says nothing and no throttle."""
    zero = np.zeros(z.size)
    given = {'state': zero, 'at': np.arange(z.size) / RATE, 'throttle': None, 'rate': RATE,
             'keep': 0.0}
    return statistics(z, Covariates(**{**given, **changes}))


def correlation(a, b):
    return math.sqrt(a.size) * np.corrcoef(a, b)[0, 1]


def test_a_flat_spectrum_has_every_band_at_its_expectation():
    """A single pulse: every ordinate is 1, and the cube root of a mean of 1 is 1."""
    # What remains of Wilson and Hilferty's score is its bias term, 3 sqrt(m) / (9 m). The edges of
    # 8 bands of 256 ordinates are powers of two.
    pulse = np.zeros(512)
    pulse[100] = 1.0
    found = {name: value for name, value in plain(pulse).items() if name.startswith('band')}
    edges = [1, *(2**k for k in range(1, 9))]
    assert list(found) == [f'band {k}, {a} to {b} Hz'
                           for k, (a, b) in enumerate(zip(edges[:-1], edges[1:]))]
    counts = [2, *(2**k for k in range(1, 8))]
    assert list(found.values()) == pytest.approx([1.0 / (3.0 * math.sqrt(m)) for m in counts])


def test_the_bands_and_the_line_are_tails_of_exponentials():
    """Sinusoids of equal amplitude: ordinates of 0 and of 256 over their number."""
    n, bins = 512, np.arange(20, 240, 20)
    z = 0.3 * sum(np.cos(2.0 * np.pi * k * np.arange(n) / n + k) for k in bins)
    found, top = plain(z), 256.0 / bins.size
    # The highest of the 253 ordinates above the three slowest.
    assert found['line'] == pytest.approx(
        stats.norm.isf(-math.expm1(-253.0 * math.exp(-top))), rel=1e-6)
    edges = [0, *(2**k for k in range(1, 9))]
    for k, (a, b) in enumerate(zip(edges[:-1], edges[1:])):
        # Ordinate j belongs to frequency j + 1.
        total = top * int(((bins > a) & (bins <= b)).sum())
        value = next(v for name, v in found.items() if name.startswith(f'band {k},'))
        if total > 0.0:
            assert value == pytest.approx(stats.norm.isf(stats.gamma.sf(total, b - a)), abs=0.05)
        else:
            assert value == pytest.approx((1.0 / (9.0 * (b - a)) - 1.0) * 3.0 * math.sqrt(b - a))


def test_autocorrelations_sum_their_lags():
    z = np.random.default_rng(1).uniform(-1.0, 1.0, 400)
    c = z - z.mean()
    r = np.correlate(c, c, 'full')[c.size - 1:] / (c @ c)
    found = {name: value for name, value in plain(z).items() if name.startswith('autocorr')}
    groups = {'1': (1, 1), '2': (2, 2), '3 to 5': (3, 5), '6 to 15': (6, 15), '16 to 50': (16, 50)}
    assert found == pytest.approx({
        f'autocorrelation lag {name}': r[a:b + 1].sum() * math.sqrt(z.size / (b - a + 1))
        for name, (a, b) in groups.items()})
    assert not any('16 to 50' in name for name in plain(z[:199]))


def test_small_errors_leave_out_pairs_with_a_large_one():
    z = np.random.default_rng(2).uniform(-4.0, 4.0, 1000)
    pairs = [(b, a) for a, b in zip(z[:-1], z[1:]) if max(abs(a), abs(b)) < 2.5]
    assert plain(z)['small errors lag 1'] == pytest.approx(correlation(*np.array(pairs).T))


def test_moments_and_tails_have_their_normal_scores():
    rng = np.random.default_rng(3)
    z = np.append(rng.exponential(0.7, 9995), [4.5, -5.0, 6.0, -7.0, 8.0])
    z[:-5] = np.minimum(z[:-5], 3.9)
    found, n = plain(z), z.size
    assert found['skewness'] == pytest.approx(stats.skew(z) * math.sqrt(n / 6.0))
    assert found['kurtosis'] == pytest.approx(stats.kurtosis(z) * math.sqrt(n / 24.0))
    for limit, count in ((4.0, 5), (5.5, 3)):
        expected = 2.0 * n * stats.norm.sf(limit)
        assert found[f'tails beyond {limit:g}'] == pytest.approx(
            2.0 * (math.sqrt(count + 0.375) - math.sqrt(expected + 0.375)), rel=2e-4)


def test_clusters_are_correlations_of_squares():
    n = 2100
    # Squares that rise and fall every 120 samples.
    z = np.random.default_rng(4).uniform(-1.0, 1.0, n) * (1.5 + np.sin(np.arange(n) / 19.0))
    found = plain(z)
    square = z * z - np.mean(z * z)
    assert found['clustering next sample'] == pytest.approx(correlation(square[1:], square[:-1]))
    nine = np.array([square[k - 9:k].sum() for k in range(10, n)])
    assert found['clustering few samples'] == pytest.approx(
        correlation(square[10:], nine))
    spans = {span: round(span * RATE) for span in (0.02, 0.1)}
    assert {name for name in found if name.endswith(' s') and 'cluster' in name} == {
        f'clustering {what}{span:g} s' for span in spans for what in ('', 'spread ')}
    for span, m in spans.items():
        count = n // m
        mean = np.array([square[k * m:(k + 1) * m].mean() for k in range(count)])
        assert found[f'clustering {span:g} s'] == pytest.approx(correlation(mean[1:], mean[:-1]))


@pytest.mark.parametrize('scale', (0.7, 1.0, 1.3))
def test_spread_of_blocks_is_a_chi_square_tail(scale):
    """100 blocks of 10 whose means have `scale` times the variance of independent squares."""
    m, count = 10, 100
    inner = np.tile([1.0, -1.0], m // 2)
    outer = np.repeat(np.random.default_rng(5).permutation(np.tile([1.0, -1.0], count // 2)), m)
    # Var of the mean of a block over var / m: scale = m b^2 / (a^2 + b^2).
    b2 = scale / m
    square = math.sqrt(1.0 - b2) * np.tile(inner, count) + math.sqrt(b2) * outer
    found = plain(np.sqrt(3.0 + square), rate=100.0)
    value = stats.norm.isf(stats.chi2.sf(scale * count, count))
    assert found['clustering spread 0.1 s'] == pytest.approx(value, abs=0.02)


def test_products_of_three_are_a_chi_square_tail():
    """All pairs of lags up to 10, each product over all of its samples."""
    n = 60
    z = np.random.default_rng(6).uniform(-2.0, 2.0, n) + 0.4
    c = (z - z.mean()) / z.std()
    total = sum(sum(c[t] * c[t - j] * c[t - k] for t in range(k, n))**2 / (n - k)
                for j, k in combinations(range(1, 11), 2))
    assert plain(z)['products of three'] == pytest.approx(
        stats.norm.isf(stats.chi2.sf(total, 45)), abs=0.01)
    assert 'products of three' in plain(z[:41]) and 'products of three' not in plain(z[:40])


def test_white_noise_has_no_bursts():
    """
    Independent scores: ordinates are exponential, their mean square 2 and its variance 24 - 4.

    Divided by their own mean over c segments their mean square is 2 c / (c + 1).  The window
    correlates amplitudes of neighbours by 2/3 and 1/6, which widens the spread.
    """
    rng = np.random.default_rng(7)
    drawn = {}
    for _ in range(100):
        for name, value in plain(rng.standard_normal(8192)).items():
            if name.startswith('bursts'):
                drawn.setdefault(name, []).append(value)
    assert list(drawn) == ['bursts within 0.062 s', 'bursts within 0.25 s', 'bursts within 1 s']
    # Squares of exponentials whose amplitudes squared correlate by r: covariance 16 r + 4 r^2.
    spread = math.sqrt(1.0 + 2.0 * sum((16.0 * r + 4.0 * r * r) / 20.0
                                       for r in ((2.0 / 3.0)**2, (1.0 / 6.0)**2)))
    for length, (name, values) in zip((32, 128, 512), drawn.items()):
        count = 8192 // length
        mean = -2.0 / (count + 1.0) * math.sqrt(count * (length / 2 - 1) / 20.0)
        # Of 100 draws: one in 10 000.
        assert np.mean(values) == pytest.approx(mean, abs=4.0 * spread / 10.0), name
        assert np.std(values) < spread * (1.0 + 4.0 / math.sqrt(200.0)), name


def test_a_sign_has_its_direction():
    for sign, name, value, wanted in (
            ('+kurtosis', 'kurtosis', 1.0, True), ('+kurtosis', 'kurtosis', -1.0, False),
            ('-kurtosis', 'kurtosis', -1.0, True), ('-kurtosis', 'kurtosis', 1.0, False),
            ('-kurtosis', 'kurtosis', 0.0, True), ('+band', 'skewness', 1.0, False),
            ('band', 'band 3, 1 to 2 Hz', -1.0, True), ('band', 'band 0, 1 to 2 Hz', 1.0, True),
            ('band', 'order line', 1.0, False)):
        assert is_sign(sign, name, value) is wanted, (sign, name, value)
