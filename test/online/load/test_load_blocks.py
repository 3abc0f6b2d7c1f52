"""Blocks of equal throttle against their rules, told sample by sample; noise against its laws."""

import math

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.model.load import ripple
from ou_monitor.online.load.blocks import LoadBlocks, LoadNoise
import pytest

NAN = math.nan


def by_hand(t, v, u, current):
    """
    Return the blocks of samples: stamps, mean voltage, throttle, current, number, variance.

    A bin of 20 ms ends a block, a sample 15 ms or more from its neighbours stands alone, and the
    first three changes of throttle, of more than 0.01, within a bin begin a block each.
    """
    rows, changes = [], 0
    for k in range(t.size):
        after = math.inf if k == 0 else t[k] - t[k - 1]
        before = math.inf if k < 2 else t[k - 1] - t[k - 2]
        fresh = (after >= 0.015 or before >= 0.015
                 or math.floor(t[k] / 0.02) != math.floor(t[k - 1] / 0.02))
        other = k > 0 and not (abs(u[k] - u[k - 1]) <= 0.01
                               or math.isnan(u[k]) and math.isnan(u[k - 1]))
        changes = 0 if fresh else changes + other
        if fresh or other and changes <= 3:
            rows.append([])
        rows[-1].append(k)
    blocks = []
    for k in rows:
        known = current[k][np.isfinite(current[k])]
        blocks.append((t[k].mean(), t[k[-1]], v[k].mean(), u[k].mean(),
                       known.mean() if known.size else NAN, len(k),
                       v[k].var(ddof=1) if len(k) > 1 else NAN))
    return blocks


def values(blocks):
    return [(b.t, b.last, b.voltage, b.throttle, b.current, b.n, b.within) for b in blocks]


@pytest.mark.parametrize('seed', range(6))
def test_blocks_in_pieces_of_any_size_are_those_of_the_rules(seed):
    """Fast, slow and mixed sources; steps of throttle of all sizes, and holes in it."""
    rng = np.random.default_rng(seed)
    n = 400
    steps = rng.choice([[1e-3, 4e-3], [1e-3, 2e-3], [4e-3, 1.45e-2, 1.55e-2], [1e-3, 0.02, 0.3],
                        [5e-4, 1e-3], [3e-3, 1.6e-2]][seed], n)
    t = 3.0 + np.cumsum(steps)
    u = np.cumsum(rng.choice([0.0, 0.0, 0.0095, 0.0105, -0.03], n)) % 1.0
    u[rng.random(n) < 0.1] = NAN
    v, current = 15.0 + rng.standard_normal(n), 20.0 + rng.standard_normal(n)
    current[rng.random(n) < 0.3] = NAN
    blocks, found, start = LoadBlocks(), [], 0
    while start < n:
        stop = min(n, start + int(rng.integers(0, 30)))
        found += blocks.push(np.stack((t, v, u, current))[:, start:stop])
        start = stop
    found += blocks.push(np.array([[t[-1] + 1.0], [15.0], [0.5], [NAN]]))[:-1]
    assert_allclose(values(found), by_hand(t, v, u, current), rtol=1e-9, atol=1e-9)


def test_a_slow_source_waits_for_nothing():
    """15 ms or more after the last: given out with the push that brings it; less: not yet."""
    blocks = LoadBlocks()
    column = np.array([[1.0], [15.0], [0.5], [7.0]])
    (first,) = blocks.push(column)
    assert (first.t, first.last, first.voltage, first.throttle, first.current, first.n) == (
        1.0, 1.0, 15.0, 0.5, 7.0, 1) and math.isnan(first.within)
    assert len(blocks.push(column + [[0.0155], [0.0], [0.0], [0.0]])) == 1
    assert not blocks.push(column + [[0.016], [0.0], [0.0], [0.0]])
    assert not blocks.push(np.empty((4, 0)))
    blocks.forget()
    (only,) = blocks.push(column + [[9.0], [1.0], [0.0], [0.0]])
    assert only.n == 1 and only.voltage == 16.0


def test_equal_throttle_is_within_a_hundredth():
    """At the edge it is equal."""
    for high, count in ((0.01, 1), (0.0101, 2)):
        t = np.array([0.0, 0.021, 0.022, 0.023, 0.1])
        u = np.array([0.0, 0.0, 0.0, high, 0.0])
        found = LoadBlocks().push(np.stack((t, 0.0 * t + 5.0, u, 0.0 * t)))
        assert [b.n for b in found] == ([1, 1, 2, 1] if count == 1 else [1, 1, 1, 1, 1])


def test_noise_begins_with_what_is_usual_or_was_learned():
    """0.4 % of the voltage, 2 of ripple, 4 of a change; a mean of n counts less within a block."""
    noise = LoadNoise(15.0)
    assert noise.of_blocks == (pytest.approx(2.0 * math.log(0.06)), 2.0, 4.0)
    assert noise.variance(0.6, 0.09, 1) == pytest.approx(
        0.06 ** 2 * math.exp(2.0 * float(ripple(0.6)) + 4.0 * 0.3))
    assert noise.log_variance == noise.of_blocks
    assert LoadNoise(15.0, (-3.0, 1.0, 0.5)).of_blocks == (-3.0, 1.0, 0.5)
    assert (noise.scale, noise.correlation) == (1.0, 0.0)


def test_rounding_is_that_of_the_step_over_the_share_of_changes():
    """A value that never changed may be of any step up to a tenth of the voltage."""
    noise, share = LoadNoise(10.0), 1.0
    assert noise.rounding == pytest.approx(0.25)
    v = [5.0, 5.0, 5.2, 5.2 + 5e-7, 5.3, 5.3, 5.3, 5.7]
    for k, (last, now) in enumerate(zip([NAN, *v], v)):
        noise.see(now)
        share += (float(abs(now - last) > 1e-6) - share) / 20.0
        if k < 2:
            assert noise.rounding == pytest.approx(0.25)
    assert noise.rounding == pytest.approx(0.1 ** 2 / 12.0 / share, rel=1e-4)
    assert noise.log_variance[0] == pytest.approx(math.log(0.04 ** 2 + 0.1 ** 2 / 12.0), rel=1e-4)
    for _ in range(4000):
        noise.see(5.7)
    assert noise.rounding == pytest.approx(0.1 ** 2 / 12.0 / 0.002, rel=1e-2)


def test_correlation_of_scores_is_a_running_mean_between_none_and_nine_tenths():
    """Weights of 1 / (50 + n), at least 0.002."""
    noise, expected, last = LoadNoise(10.0), 0.0, 0.0
    # A score of nought is learned too: so n counts.
    for n, score in enumerate([1.0, 2.0, 1.5, -0.5, -1.0, 0.3, 4.0, 4.0]):
        noise.follow(score)
        expected += (score * last - expected) / (n + 50.0)
        expected, last = min(0.9, max(0.0, expected)), score
        assert noise.correlation == pytest.approx(expected)
    for _ in range(900):
        noise.follow(4.0)
    assert noise.correlation == 0.9
    before = noise.correlation
    noise.follow(0.0)
    assert noise.correlation == pytest.approx(before * (1.0 - 0.002))


@pytest.mark.parametrize('e, s', [(0.1, 0.0), (0.02, 0.003), (3.0, 0.0), (0.05, 1.0)])
def test_one_innovation_moves_the_noise_by_fisher_scoring(e, s):
    """
    In information form: each adds share^2 / 2 along its regressors, after the memory's loss.

    The square counts 16 at most, the share of the noise 0.05 at least, the step 0.7 nats at most.
    """
    u, du, n = 0.7, 0.04, 1
    noise = LoadNoise(15.0)
    b, C = np.array(noise.of_blocks), np.diag([4.0, 4.0, 9.0])
    for k in range(3):
        f = np.array([1.0, float(ripple(u)), 0.2])
        R = math.exp(b @ f)
        square, share = min(e * e / (s + R), 16.0), max(R / (s + R), 0.05)
        C = C * (1.0 + 1.0 / (50.0 + k / 3.0))
        g, own = C @ f, f @ C @ f
        C = np.linalg.inv(np.linalg.inv(C) + 0.5 * share ** 2 * np.outer(f, f))
        step = C @ f * 0.5 * share * (square - 1.0)
        b = b + (step if step @ f < 0.7 else g * 0.7 / own)
        C = C * min(1.0, 9.0 / C.diagonal().max())
        scale = noise.scale
        noise.learn(e, s, u, du, n, NAN)
        assert_allclose(noise.of_blocks, b, rtol=1e-9)
        assert noise.scale == pytest.approx(scale + (square - scale) / (20.0 + k))
        noise.follow(0.0)


def test_scatter_within_blocks_is_that_of_their_samples():
    """White noise in blocks of 20: a sample has 20 times the variance of their mean."""
    rng = np.random.default_rng(1)
    noise = LoadNoise(5.0)
    for _ in range(3000):
        some = 0.02 * rng.standard_normal(20)
        noise.learn(some.mean(), 0.0, 0.0, 0.0, 20, some.var(ddof=1))
        noise.follow(0.0)
    # The log-variance forgets within 2000, its error is sqrt(2 / 4000).
    assert noise.of_blocks[0] == pytest.approx(math.log(0.02 ** 2 / 20.0), abs=0.1)
    assert noise.log_variance[0] == pytest.approx(math.log(0.02 ** 2), abs=0.1)
    whole, one = noise.variance(0.0, 0.0, 20), noise.variance(0.0, 0.0, 1)
    assert one - whole == pytest.approx(0.02 ** 2 * (1.0 - 1.0 / 20.0), rel=0.05)
    assert noise.variance(0.0, 0.0, 40) == whole
    # Under a throttle that moves nothing is learned of it.
    before = noise.variance(0.0, 0.0, 1) - noise.variance(0.0, 0.0, 20)
    for _ in range(100):
        noise.learn(0.0, 1e9, 0.0, 0.002, 20, 1.0)
    assert noise.variance(0.0, 0.0, 1) - noise.variance(0.0, 0.0, 20) == pytest.approx(
        before, rel=1e-4)
