"""Throttle budget, against supplies whose exact answer is known."""

import math

import numpy as np
from ou_monitor.online.risk.curves import CurvePoint, LearnedCurves
from ou_monitor.online.risk.outlook import throttle_budget
from ou_monitor.records import Estimate, Status
import pytest
from scipy.optimize import brentq
from simulated_flights import fly, holds, learn, level, log_sigma, passage_risk, truth

VOLTAGE, HORIZON = 4.5, 5.0
RISK = passage_risk(VOLTAGE, HORIZON)


def exact_risk(throttle):
    """Return the risk of the supply itself."""
    one = np.array([throttle])
    zero = np.zeros(1)
    return RISK(level(one), zero, log_sigma(one), zero, np.log([63.0]), zero).item()


def exact_budget(limit):
    """Return where the risk of the supply itself reaches the limit."""
    return brentq(lambda u: math.log(exact_risk(u) / limit), 0.1, 0.95)


class Known:
    """Curves without errors, known over a range of throttle."""

    throttle_known = True

    def __init__(self, low=0.0, high=1.0, *, level=level, log_sigma=log_sigma, error=0.0,
                 gap=None):
        self.extent = (low, high)
        self._level, self._log_sigma = level, log_sigma
        self._error, self._gap = error, gap

    def _errors(self, u):
        low, high = self.extent
        unknown = (u < low - 1e-9) | (u > high + 1e-9)
        if self._gap:
            unknown |= (u > self._gap[0]) & (u < self._gap[1])
        return np.where(unknown, self._error, 0.0), ~unknown

    def level_curve(self, u):
        return self._level(u), self._errors(u)[0]

    def sigma_curve(self, u):
        return self._log_sigma(u), self._errors(u)[0]

    def seen_curve(self, u):
        return self._errors(u)[1]

    def level_at(self, u):
        return CurvePoint(*(x.item() for x in self.level_curve(np.array([u]))))

    def sigma_at(self, u):
        return CurvePoint(*(x.item() for x in self.sigma_curve(np.array([u]))))

    def seen(self, u):
        return bool(self.seen_curve(np.array([u])).item())


def budget(curves, limit=1e-3, estimate=None, probability=RISK):
    """Return the budget of the supply of the tests."""
    return throttle_budget(estimate or truth(alpha_se=0.0), curves, voltage=VOLTAGE,
                           horizon=HORIZON, limit=limit, probability=probability)


def learned(seed, duration=30.0, low=0.1, high=0.8, **more):
    """Return curves of one flight."""
    rng = np.random.default_rng([20, seed])
    throttle = holds(rng, duration, low, high)
    t, y = fly(rng, throttle, **more)
    curves = LearnedCurves()
    learn(curves, t, y, throttle, truth())
    return curves


@pytest.mark.parametrize('limit', [1e-6, 1e-4, 1e-3, 1e-2, 0.1])
def test_exact_curves_give_the_exact_budget(limit):
    """To a thousandth of full throttle, with the risk at the budget within the limit."""
    found = budget(Known(), limit)
    assert found.throttle == pytest.approx(exact_budget(limit), abs=1e-3)
    assert exact_risk(found.throttle) <= limit * 1.01
    assert f'{limit:.2g}' in found.reason
    assert found.risks.shape == found.known.shape == (51,)
    assert found.risks[30] == pytest.approx(exact_risk(0.6))


def test_learned_curves_bracket_the_exact_risk():
    """
    The budget of 40 flights is near the exact one.

    The budget carries the errors, so it may lie below the exact one, by about as much as the
    level and sigma are uncertain there, and above it only by chance.
    """
    off, known = [], []
    for seed in range(40):
        curves = learned(seed)
        known.append(curves.seen_curve(np.array([0.5])).item())
        off.append(budget(curves).throttle - exact_budget(1e-3))
    assert np.mean(known) > 0.8
    # d ln(risk) / du is about 20 here: 0.05 of throttle is a factor of e.
    assert np.median(np.abs(off)) < 0.05 and np.mean(off) < 0.01


def test_monotone_in_the_limit():
    """A higher limit never gives a lower budget."""
    curves = learned(50)
    budgets = [budget(curves, limit).throttle for limit in np.geomspace(1e-6, 0.9, 30)]
    assert np.all(np.diff(budgets) >= 0.0) and budgets[-1] > budgets[0] + 0.1


def test_errors_only_lower_it():
    """The same curves, less well known in alpha, allow less."""
    sharp = budget(Known(), estimate=truth(alpha_se=0.0))
    blunt = budget(Known(), estimate=truth(alpha_se=0.3))
    assert blunt.throttle < sharp.throttle - 0.02


def test_the_edge_of_the_data_is_no_claim_of_safety():
    """Flown up to 0.4 only, where the risk is small: the budget ends there and says why."""
    curves = learned(51, high=0.4)
    found = budget(curves, 0.05)
    assert found.throttle == curves.extent[1] <= 0.42
    assert f'No data above {found.throttle:.2f}' in found.reason
    assert not found.known[-1] and found.known[15]


def test_full_throttle_when_all_is_within():
    """A rail that holds everywhere, flown everywhere."""
    found = budget(Known(log_sigma=lambda u: np.full(u.shape, -4.0)))
    assert found.throttle == 1.0 and 'full throttle' in found.reason


def test_a_gap_in_the_data_ends_it():
    """Between 0.2 and 0.3 nothing was flown, and the errors there are large."""
    found = budget(Known(gap=(0.2, 0.3), error=1.0))
    assert 0.19 <= found.throttle <= 0.22 and 'No data near 0.22' in found.reason
    assert budget(Known(gap=(0.2, 0.3), error=1e-3)).throttle > 0.4


def test_above_the_limit_from_the_start():
    """Idle flown: 0.  Idle not flown: unknown, or as far as the prior reaches."""
    low = {'level': lambda u: np.full(u.shape, 4.52)}
    idle = budget(Known(**low))
    assert idle.throttle == 0.0 and 'idle' in idle.reason
    above = budget(Known(0.3, **low))
    assert math.isnan(above.throttle)
    assert '0.30' in above.reason and 'no data below' in above.reason
    below = budget(Known(0.7, error=0.01))
    assert below.throttle == pytest.approx(exact_budget(1e-3), abs=0.05)


def test_what_is_not_known_is_nan_with_the_reason():
    """No throttle, no data, no usable estimate, no number from the risk."""
    empty = LearnedCurves()
    no_throttle = budget(empty)
    assert math.isnan(no_throttle.throttle) and 'throttle' in no_throttle.reason
    empty.update(np.arange(10) * 1e-3, np.full(10, 5.0), np.full(10, 0.5), truth())
    empty.update(np.arange(10, 60) * 1e-3, np.full(50, 5.0), np.full(50, 0.5), truth())
    young = budget(empty)
    assert math.isnan(young.throttle) and 'held' in young.reason
    for status in set(Status) - {Status.OK, Status.SHORT_WINDOW}:
        bad = budget(learned(52, 2.0), estimate=Estimate(status=status))
        assert math.isnan(bad.throttle) and status.value in bad.reason
        assert bad.risks.size == 0
    nothing = budget(Known(), probability=lambda u0, *more: np.full(u0.shape, math.nan))
    assert math.isnan(nothing.throttle) and 'could not be computed' in nothing.reason
    part = budget(Known(), 0.5, probability=lambda u0, *more: np.where(
        u0 < level(0.3), math.nan, 0.01))
    assert part.throttle == pytest.approx(0.3, abs=0.003)
    assert 'could not be computed' in part.reason


def test_certain_risks_stay_probabilities():
    """Far above and far below the barrier: 0 and 1, no overflow."""
    safe = budget(Known(log_sigma=lambda u: np.full(u.shape, -9.0)))
    assert safe.throttle == 1.0 and 0.0 <= safe.risks.min() and safe.risks.max() < 1e-200
    lost = budget(Known(level=lambda u: np.full(u.shape, 4.0)))
    assert lost.throttle == 0.0 and 0.999 < lost.risks.min() and lost.risks.max() <= 1.0
