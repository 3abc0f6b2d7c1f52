"""Real sampling: irregular stamps, gaps, losses, repeats, fast ADC blocks, float32."""

import math

import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.model.ou import simulate
from ou_monitor.records import Status
from pushed import pushed
import pytest
from simulated_windows import ALPHA, DT, errors, estimate, LEVEL, paths, SIGMA, stamps

N = 2000
T = stamps(N)


def unbiased(found, limit=0.02, truth=None):
    """Whether no mean error exceeds the limit and 2.6 Monte Carlo errors."""
    error = errors(found) if truth is None else errors(found, truth)
    spread = error.std(axis=0) / math.sqrt(len(found))
    return bool((np.abs(error.mean(axis=0)) < limit + 2.6 * spread).all())


def poisson(rng):
    """Return stamps at 200 Hz on average, and an OU."""
    # One rate for all steps would make alpha 13 % low (the mean of exp(-alpha dt) is 1/(1 + alpha
    # D) for alpha D = 0.315), six standard errors of 60.
    t = np.cumsum(rng.exponential(5e-3, 400))
    return t, LEVEL + simulate(t, ALPHA, SIGMA, rng)


def jittering(rng):
    """Return stamps +-45 % of 8 ms: each step is within "even", yet the grid is no grid."""
    t = np.cumsum(8e-3 * rng.uniform(0.55, 1.45, 600))
    return t, LEVEL + simulate(t, ALPHA, SIGMA, rng)


def losing(share):
    """Return samples of which some are lost: 60 % leave hardly a run whole."""
    def made(rng):
        keep = rng.random(N) >= share
        return T[keep], paths(rng, 1, N)[0][keep]
    return made


def holding(hold):
    """Return a 1 kHz logger of a source that is slower by a factor."""
    which = np.floor(np.arange(N) / hold + 1e-9).astype(int)
    return lambda rng: (T, paths(rng, 1, N, hold * DT)[0][which])


def coarse(rng):
    """Return refreshes that happen to repeat the code; they are refreshes all the same."""
    return T, np.repeat(0.02 * np.round(paths(rng, 1, N // 4, 4 * DT)[0] / 0.02), 4)


@pytest.mark.parametrize('made, count, limit', [
    (poisson, 60, 0.03), (jittering, 40, 0.02), (losing(0.1), 40, 0.02), (losing(0.3), 40, 0.02),
    (losing(0.6), 40, 0.02),
    # A noise that is bounded at zero costs some percent at so slow a rate.
    (holding(4.0), 40, 0.06), (holding(2.5), 40, 0.06), (coarse, 40, 0.08)])
def test_odd_sampling_leaves_no_bias(made, count, limit):
    rng = np.random.default_rng(25)
    found = [estimate(*made(rng)) for _ in range(count)]
    assert {e.status for e in found} == {Status.OK}
    assert errors(found)[:, 0].std() / math.sqrt(count) < 0.03
    assert unbiased(found, limit)


def test_a_gap_is_not_a_step():
    """0.4 s missing in the middle: alpha, sigma and the count of what is left."""
    rng = np.random.default_rng(24)
    keep = (T < 0.5) | (T >= 0.9)
    found = [estimate(T[keep], y[keep]) for y in paths(rng, 60, N)]
    assert unbiased(found)
    assert found[0].n == keep.sum() and found[0].duration == pytest.approx(1.999)


def test_adc_blocks_of_a_megahertz():
    """1 MHz in blocks of 1000 with 5 mV of noise is averaged to 10 kHz and knows it."""
    # One s is alpha T = 63; sigma is told to 1 % (ESTIMATION.md: 0.76 % for 2 s); AR(1) on the
    # samples would give ten times sigma, block means taken for samples -19 %.
    rng = np.random.default_rng(27)
    n = 1_000_000
    found = []
    for _ in range(5):
        y = paths(rng, 1, n, 1e-6)[0] + 5e-3 * rng.standard_normal(n)
        estimator = SlidingEstimator(1.03)
        for begin in range(0, n, 1000):
            estimator.push(np.arange(begin, begin + 1000) * 1e-6, y[begin:begin + 1000])
        found.append(estimator.estimate())
    e = found[0]
    assert (e.n, e.rate) == (n, pytest.approx(1e6, rel=1e-4))
    assert e.duration == pytest.approx(1.0, abs=1e-3)
    error = errors(found)
    assert abs(error[:, 1].mean()) < 0.02
    assert np.median([e.noise_std for e in found]) == pytest.approx(5e-3, rel=0.3)
    assert (np.abs(error.mean(axis=0)) < 0.35).all()


def test_fastest_is_the_rate_kept():
    """20 kHz with fastest=2000: ten samples a block, the same sigma to 3 %."""
    rng = np.random.default_rng(28)
    t = stamps(40_000, 5e-5)
    fine, coarse = [], []
    for y in paths(rng, 10, t.size, 5e-5):
        fine.append(estimate(t, y, window=2.06, fastest=2e4))
        coarse.append(estimate(t, y, window=2.06, fastest=2e3))
    assert np.mean([c.sigma / f.sigma for c, f in zip(coarse, fine)]) == pytest.approx(
        1.0, abs=0.03)
    assert np.mean([c.alpha / f.alpha for c, f in zip(coarse, fine)]) == pytest.approx(
        1.0, abs=0.03)
    assert coarse[0].n == fine[0].n == 40_000


def test_float32_and_lists():
    """Float32 voltage is what it says, to its rounding; lists are arrays."""
    rng = np.random.default_rng(29)
    y = paths(rng, 1, N)[0].astype(np.float32)
    one = estimate(T, y)
    two = estimate(T, y.astype(np.float64))
    assert (one.alpha, one.sigma, one.u0, one.n) == (two.alpha, two.sigma, two.u0, two.n)
    assert estimate(T.tolist(), y.tolist(), window=2.1).alpha == pytest.approx(two.alpha, rel=1e-9)
    assert one.alpha == pytest.approx(
        estimate(T, y + 1e-9).alpha, rel=1e-4)


def test_stamps_of_this_decade_cost_no_accuracy():
    """Stamps of this decade, 1.7e9 s, are only good to 0.24 us."""
    # At 1 kHz that is 2e-4 of a step: nothing the estimate can feel beyond that.
    y = paths(np.random.default_rng(30), 1, N)[0]
    early, late = estimate(T, y, window=2.06), estimate(1.7e9 + T, y, window=2.06)
    assert late.alpha == pytest.approx(early.alpha, rel=1e-3)
    assert late.sigma == pytest.approx(early.sigma, rel=1e-3)


def test_rate_that_changes_is_learnt_anew():
    """From 1 kHz to 250 Hz: when the window holds the new rate alone, all is as new."""
    rng = np.random.default_rng(31)
    found = []
    for _ in range(30):
        t = np.concatenate([stamps(1000), 1.0 + stamps(600, 4e-3)])
        y = LEVEL + simulate(t, ALPHA, SIGMA, rng)
        estimator = pushed(SlidingEstimator(2.0), t[:1000], y[:1000])
        estimator.estimate()
        for begin in range(1000, 1600, 50):
            estimator.push(t[begin:begin + 50], y[begin:begin + 50])
        found.append(estimator.estimate())
    assert found[0].rate == pytest.approx(250.0, rel=0.01)
    assert unbiased(found, 0.05)
