"""Sag of the levels: intervals that hold, and a discharge that is taken out."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.analysis.level_comparison import level_sags, mean_variance
from ou_monitor.analysis.levels import Segment
from ou_monitor.records import Estimate, Status
import pytest
from simulated_recordings import ALPHA, recording

SIGMA = 0.3
VAR_INF = SIGMA ** 2 / (2.0 * ALPHA)
ESTIMATE = Estimate(alpha=ALPHA, sigma=SIGMA, var_inf=VAR_INF, u0=5.0, noise_std=0.0,
                    alpha_se=0.05, sigma_se=0.01, var_inf_se=0.05, status=Status.OK, rate=1000.0)


def sags(simulated, orders, seconds=1.0):
    """Return the sags of levels 10, 30 and 60 %, flown in that order for a second each."""
    stays = [[], [], []]
    for k, level in enumerate(orders):
        stays[level].append(Segment(int(1000 * seconds * k), int(1000 * seconds * (k + 1))))
    return level_sags(simulated, (0.1, 0.3, 0.6), stays, [ESTIMATE] * 3, [math.sqrt(VAR_INF)] * 3)


def flown(seed, orders):
    """Return a recording with a sag of 1 V per unit throttle."""
    levels = [((0.1, 0.3, 0.6)[k], SIGMA) for k in orders]
    return recording(seed, levels, seconds=1.0, sag=-1.0)


def test_intervals_hold():
    """
    Of 60 recordings of 6 stays, at least 51 intervals hold 0.5 V of the highest level.

    A binomial of 60 and 0.95 falls below 51 with probability 1e-3.  The intervals are as narrow
    as the means are known: about 2 sqrt(2 Var_inf / 63).
    """
    orders = (0, 1, 2, 1, 0, 2)
    found = [sags(flown(seed, orders), orders)[2] for seed in range(60)]
    assert sum(sag.interval[0] < 0.5 < sag.interval[1] for sag in found) >= 51
    widths = [sag.sag_se for sag in found]
    assert np.median(widths) < 1.5 * math.sqrt(2.0 * 2.0 * VAR_INF / ALPHA / 2.0)


def test_a_discharge_is_no_sag():
    """0.2 V/s over twelve stays, in an order that goes up with time: taken out."""
    orders = (0, 0, 1, 0, 1, 2, 0, 1, 2, 1, 2, 2)
    simulated = flown(1, orders)
    found = sags(replace(simulated, voltage=simulated.voltage - 0.2 * simulated.t), orders)
    for sag, truth in zip(found, (0.0, 0.2, 0.5)):
        assert sag.sag == pytest.approx(truth, abs=4.0 * sag.sag_se + 1e-12)
    assert found[0].sag_se == 0.0 and found[2].sag_se < 0.05


def test_stays_that_scatter_widen_the_errors():
    """Each stay off by 50 mV at random, ten times more than noise moves it."""
    orders = (0, 1, 2, 1, 0, 2)
    simulated = flown(2, orders)
    plain = sags(simulated, orders)[2].sag_se
    off = np.repeat(np.random.default_rng(3).normal(0.0, 0.05, 6), 1000)
    moved = replace(simulated, voltage=simulated.voltage + off)
    assert sags(moved, orders)[2].sag_se > 3.0 * plain


def test_one_level_has_nothing_to_sag_from():
    """NaN, not 0."""
    found = level_sags(flown(4, (0,)), (0.1, 0.3), [[Segment(0, 1000)], []], [ESTIMATE] * 2,
                       [0.02, math.nan])
    assert all(math.isnan(sag.sag) for sag in found)


@pytest.mark.parametrize('time', [0.01, 0.5])
def test_variance_of_a_mean_is_the_double_sum(time):
    """Of the autocovariance, over 1 kHz samples, to the half step at the ends."""
    n = int(1000 * time) + 1
    lag = np.abs(np.subtract.outer(np.arange(n), np.arange(n))) / 1000.0
    expected = VAR_INF * np.exp(-ALPHA * lag).mean()
    assert mean_variance(time, n, ESTIMATE, 0.0) == pytest.approx(expected, rel=0.02)
    assert mean_variance(time, 100, Estimate(), 0.02) == pytest.approx(4e-6)
