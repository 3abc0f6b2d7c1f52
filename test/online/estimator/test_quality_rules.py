"""Rules of the findings about raw samples, each at its edge."""

import math

import numpy as np
from ou_monitor.online.estimator.quality import examine, lattice, Quality
import pytest


def test_a_lattice_has_a_thousand_steps_at_most():
    """Each within 2 % of the step, and those within 0.1 % of the least are one."""
    assert lattice(0.01 * np.array([1.0, 2.0, 1000.0])) == pytest.approx(0.01)
    assert lattice(0.01 * np.array([1.0, 2.0, 1001.0])) == 0.0
    # 2 differs from twice the step of best fit by 1.7 and by 2.1 % of it.
    assert lattice(np.array([1.0, 2.0, 3.04])) == pytest.approx(14.12 / 14.0)
    assert lattice(np.array([1.0, 2.0, 3.05])) == 0.0
    assert lattice(np.array([1.0, 1.0005, 2.0, 3.0])) == pytest.approx(1.00005, abs=2e-5)
    assert lattice(np.array([1.0, 1.0015, 2.0])) == 0.0
    assert lattice(np.array([3.0]), 1) == 3.0 and lattice(np.array([3.0])) == 0.0


@pytest.mark.parametrize('changes, found', [(57, 0.5), (60, 0.0)])
def test_two_sizes_are_a_lattice_where_neighbours_are_equal(changes, found):
    """Below nine changes in ten."""
    rng = np.random.default_rng(2)
    steps = np.zeros(64)
    at = rng.choice(64, changes, replace=False)
    steps[at] = 0.5 * rng.choice([1.0, 2.0], changes) * rng.choice([-1.0, 1.0], changes)
    assert examine(np.concatenate(([0.0], np.cumsum(steps)))).step == found


@pytest.mark.parametrize('side', [1.0, -1.0])
@pytest.mark.parametrize('many, beside, found', [
    (10, 1, True), (9, 1, False), (12, 4, False), (13, 4, True)])
def test_an_end_holds_ten_samples_and_three_times_its_neighbour(side, many, beside, found):
    """Of 500 samples: a hundredth would be five."""
    rng = np.random.default_rng(3)
    y = np.concatenate((rng.uniform(0.0, 1.0, 500 - many - beside), np.full(beside, 1.5),
                        np.full(many, 2.0)))
    assert examine(side * rng.permutation(y)).saturated is found


def test_nothing_is_told_of_nothing():
    assert Quality() == Quality(0.0, 1.0, False, pytest.approx(math.nan, nan_ok=True))
    two = np.r_[np.zeros(40), np.ones(40), np.zeros(40)]
    assert math.isnan(examine(two).rms_increment)
    three = np.r_[two, np.ones(40)]
    assert examine(three).rms_increment == pytest.approx(math.sqrt(3.0 / 159.0))
