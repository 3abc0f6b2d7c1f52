"""Statistics of scores: N(0, 1) without an effect, and far off with one."""

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.criticism.score_statistics import after_large, large_signs, score, throttle_paths
import pytest
from scipy.stats import kstest

N = 8000
KEEP = 0.9


def throttle(rng):
    """Return a throttle that wanders over its whole range."""
    knots = rng.uniform(0.1, 0.9, 60)
    return np.interp(np.arange(N), np.linspace(0, N, 60), knots)


def test_paths_are_no_function_of_throttle_now():
    u = throttle(np.random.default_rng(1))
    paths = dict(throttle_paths(u, 0.0))
    assert set(paths) == {'growing effect of throttle', 'loop of throttle 15 to 85 %',
                          'loop of throttle 28 to 72 %', 'loop of throttle 40 to 60 %'}
    for path in paths.values():
        for power in (1, 2, 3):
            assert abs(score(path, u**power)) < 0.5


def test_a_throttle_that_only_rises_has_no_loop_and_a_constant_one_nothing():
    # The relay turns once, with throttle: a function of it.
    rising = dict(throttle_paths(np.repeat([0.2, 0.8], N // 2), KEEP))
    assert not any(name.startswith('loop') for name in rising)
    assert not dict(throttle_paths(np.full(N, 0.5), KEEP))


def test_the_loop_statistic_detects_a_relay_in_the_mean_and_growth_does_not():
    rng = np.random.default_rng(2)
    u = throttle(rng)
    state, out = 1.0, np.empty(N)
    for k, x in enumerate(u):
        state = 1.0 if x > 0.7 else -1.0 if x < 0.3 else state
        out[k] = state
    mean = 2.0 * out
    errors = rng.standard_normal(N) + mean - KEEP * np.concatenate((mean[:1], mean[:-1]))
    statistics_of = {name: score(errors, path) for name, path in throttle_paths(u, KEEP)}
    assert statistics_of['loop of throttle 28 to 72 %'] > 4.8
    assert abs(statistics_of['growing effect of throttle']) < 4.0


def test_an_effect_of_throttle_that_grows_is_detected():
    rng = np.random.default_rng(3)
    u = throttle(rng)
    mean = 12.0 * np.linspace(-1.0, 1.0, N) * (u - u.mean())
    errors = rng.standard_normal(N) + mean - KEEP * np.concatenate((mean[:1], mean[:-1]))
    statistics_of = {name: score(errors, path) for name, path in throttle_paths(u, KEEP)}
    assert statistics_of['growing effect of throttle'] > 5.0


def test_large_ones_are_the_first_of_each_group_and_what_laws_have_found():
    errors = np.zeros(200)
    # One 20 samples after the last belongs to its group, 21 after it does not; 3.99 is not large.
    errors[[0, 20, 41, 62, 150]] = 5.0, -6.0, -4.01, 3.99, 4.5
    found = np.zeros(200, bool)
    found[100] = True
    errors[100] = -1.0
    large = large_signs(errors, found)
    assert_allclose(np.flatnonzero(large), [0, 41, 100, 150])
    assert_allclose(large[[0, 41, 100, 150]], [1.0, -1.0, -1.0, 1.0])


def test_after_large_errors_of_independent_scores_nothing_follows():
    # 400 draws of independent scores with planted large ones: N(0, 1), by its law.
    rng = np.random.default_rng(4)
    values = {}
    for _ in range(400):
        w = rng.standard_normal(N)
        w[rng.integers(0, N, 20)] = rng.choice([-5.0, 5.0], 20)
        square = w * w - np.mean(w * w)
        for name, value in after_large(w, square, large_signs(w)):
            values.setdefault(name, []).append(value)
    assert len(values) == 10
    for name, drawn in values.items():
        # 10 tests: one in 10 000 each.  Windows of few samples hold squares of few: not normal.
        if not name.startswith('power after large errors 1 '):
            assert kstest(drawn, 'norm').pvalue > 1e-4, name
        assert np.std(drawn) == pytest.approx(1.0, abs=4.5 / np.sqrt(2 * 400) * 1.5), name


@pytest.mark.parametrize('sign', (1.0, -1.0))
def test_a_ramp_after_each_large_error_is_detected_with_its_sign(sign):
    rng = np.random.default_rng(5)
    w = rng.standard_normal(N)
    for at in range(300, N - 300, 400):
        w[at] = 6.0 * sign
        w[at + 16:at + 64] += 0.5 * sign
    statistics_of = dict(after_large(w, w * w - np.mean(w * w), large_signs(w)))
    # 19 windows of 48 samples: 0.5 sqrt(912) = 15 standard deviations.
    assert statistics_of['after large errors 16 to 64'] == pytest.approx(15.1, abs=4.0)
    assert abs(statistics_of['after large errors 256 to 1024']) < 5.0


def test_few_large_errors_are_not_tested_and_short_recordings_have_no_long_windows():
    w = np.random.default_rng(6).standard_normal(300)
    statistics_of = dict(after_large(w, w * w - 1.0, np.zeros(300)))
    assert set(statistics_of.values()) == {0.0}
    assert 'after large errors 16 to 64' in statistics_of
    assert 'after large errors 64 to 256' not in statistics_of
