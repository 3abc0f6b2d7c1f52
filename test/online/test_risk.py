"""Brown-out probability: limits, monotonicity, unknown."""

import math

from ou_monitor import brownout_probability
from ou_monitor.records import Estimate, Status
import pytest

GOOD = Estimate(t=0.0, alpha=63.0, sigma=0.632, var_inf=0.632**2 / 126.0, u0=5.0,
                status=Status.OK)


def test_against_the_mean_first_passage():
    """Barrier 1 sd below the mean from the mean: T = 2.0934066 tau."""
    sd = math.sqrt(GOOD.var_inf)
    p = brownout_probability(GOOD, 5.0 - sd, 0.01)
    assert p == pytest.approx(-math.expm1(-0.63 / 2.0934066496783218), rel=1e-9)


def test_monotone_in_horizon_level_and_present_voltage():
    low = brownout_probability(GOOD, 4.8, 1.0)
    assert low < brownout_probability(GOOD, 4.8, 5.0) < 1.0
    assert low < brownout_probability(GOOD, 4.85, 1.0)
    assert low < brownout_probability(GOOD, 4.8, 1.0, now=4.81)


def test_limits():
    assert brownout_probability(GOOD, 0.0, 1.0) == 0.0
    assert brownout_probability(GOOD, 4.8, 1.0, now=4.8) == 1.0
    assert brownout_probability(GOOD, 5.5, 1.0) == 1.0
    assert brownout_probability(GOOD, 4.8, 1e-12) < 1e-10


def test_unknown_is_nan_never_zero():
    for status in Status:
        p = brownout_probability(Estimate(status=status), 4.5, 5.0, now=4.9)
        assert math.isnan(p)


@pytest.mark.parametrize('voltage, horizon', [(4.5, 0.0), (4.5, -1.0), (4.5, math.nan),
                                              (math.nan, 1.0), (math.inf, 1.0)])
def test_bad_questions_are_refused(voltage, horizon):
    with pytest.raises(ValueError, match='horizon|voltage'):
        brownout_probability(GOOD, voltage, horizon)
