"""
What lies ahead by the settings: the risk, its curve over throttle, and the throttle budget.

Limits: no throttle above the highest flown in the last minutes is called safe.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.load.supply_load import LoadStatus, SupplyLoad
from ou_monitor.online.risk.forecast import Forecast, Outcome
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import FloatArray, NAN

# Throttles at which the risk is computed.
_GRID = np.linspace(0.0, 1.0, 51)
# Time ahead, s, for which the flag asks what happens if throttle stays as it is.
SOON = 1.0


@dataclass(frozen=True, eq=False)
class ThrottleBudget:
    """The highest throttle that keeps the risk under a limit."""

    # The budget, 0..1; NaN when unknown; 0 when even idle, flown, is above the limit.
    throttle: float
    reason: str  # What ends the budget, or why it is unknown, in words.
    # Risk at throttles from 0 to 1; empty when nothing could be computed.
    risks: FloatArray = field(default_factory=lambda: np.empty(0))
    # Whether that throttle lies within those flown.
    known: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))


@dataclass(frozen=True)
class Ahead:
    """Risk and budget of one instant."""

    outcome: Outcome = Outcome()  # Risk, its leg, and what makes most of it.
    budget: float = NAN  # Throttle budget, 0..1; NaN when not known.
    budget_reason: str = ''  # What ends it, or why it is not known.
    # Risk if throttle goes to each tenth and stays for the horizon; empty when not known.
    curve: tuple[float, ...] = ()
    soon: float = NAN  # Risk within `SOON` with throttle as it is now; NaN when not known.
    # Whether the budget is below the throttle that was passed for a tenth of the last 30 s.
    tight: bool = False


def look_ahead(forecast: Forecast, load: SupplyLoad, settings: MonitorSettings) -> Ahead:
    """Return what lies ahead by the settings."""
    s = settings
    voltage, horizon = s.brownout_voltage, s.brownout_horizon
    outcome = forecast.risk(voltage, horizon)
    soon = forecast.risk_held(voltage, SOON)
    if math.isnan(soon):
        soon = forecast.risk(voltage, min(SOON, horizon)).risk
    risks = forecast.risk_if(_GRID, horizon, voltage, horizon)
    if np.isnan(risks).any():
        why = '' if load.status is LoadStatus.NO_DATA else load.status.value if (
            not load.known) else 'Less than a second has been flown.'
        return Ahead(outcome, NAN, why, soon=soon)
    budget = throttle_budget(risks, forecast.flown, s.budget_limit)
    # NaN is not below.
    return Ahead(outcome, budget.throttle, budget.reason, tuple(risks[::5].tolist()), soon,
                 budget.throttle < forecast.used)


def throttle_budget(risks: FloatArray, flown: tuple[float, float], limit: float,
                    ) -> ThrottleBudget:
    """Return the budget from the risks at `_GRID`, and the limit of them."""
    lowest, highest = flown
    known = (_GRID >= lowest) & (_GRID <= highest)
    # A risk that falls again beyond a peak is no way through.
    risks = np.maximum.accumulate(risks)
    within = int(np.searchsorted(risks, limit, 'right'))
    if within == 0:
        return ThrottleBudget(
            0.0, f'Even at idle the risk is {risks[0]:.2g}, more than allowed.', risks, known)
    end = 1.0
    if within < _GRID.size:
        low, high = risks[within - 1], risks[within]
        # The logarithm of the risk is nearly straight over so short a way.
        end = _GRID[within - 1] + (_GRID[within] - _GRID[within - 1]) * (
            math.log(limit / low) / math.log(high / low) if low > 0.0 else 0.0)
    if end > highest:
        throttle, reason = highest, (f'No data above {highest:.2f}; within the limit up to '
                                     'there.')
        if highest == 1.0:
            reason = 'Within the limit up to full throttle.'
    else:
        throttle, reason = end, f'The risk passes the limit of {limit:.2g} at throttle {end:.2f}.'
    return ThrottleBudget(float(throttle), reason, risks, known)
