"""
What a report says of the time ahead: risk, what it stands on, throttle curve and budget.

Limits: no throttle above the highest flown in the last minutes is called safe.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.online.risk.forecast import Forecast, Outcome
from ou_monitor.online.risk.outlook import Outlook, ThrottleBudget
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.online.supply_load import LoadStatus, SupplyLoad
from ou_monitor.records import Estimate, FloatArray, NAN

# Throttles at which the risk is computed.
CURVE = np.linspace(0.0, 1.0, 51)


@dataclass(frozen=True)
class Ahead:
    """
    Risk and budget of one instant.

    Attributes
    ----------
    outcome : Outcome
        Risk, its leg, and what makes most of it.
    budget : float
        Throttle budget, 0..1; NaN when not known.
    budget_reason : str
        What ends it, or why it is not known.
    curve : tuple of float
        Risk if throttle goes to each tenth and stays for the horizon; empty when not known.

    """

    outcome: Outcome = Outcome()
    budget: float = NAN
    budget_reason: str = ''
    curve: tuple[float, ...] = ()


def look_ahead(outlook: Outlook, forecast: Forecast, e: Estimate, load: SupplyLoad,
               settings: MonitorSettings) -> Ahead:
    """Return what lies ahead by the settings."""
    s = settings
    voltage, horizon = s.brownout_voltage, s.brownout_horizon
    outcome = risk_of_all(outlook, forecast, e, s, voltage, horizon)
    risks = forecast.risk_if(CURVE, horizon, voltage, horizon)
    known = not np.isnan(risks).any()
    if known and outcome.basis != 'first_passage':
        budget = load_budget(risks, forecast.flown, s.budget_limit, voltage, horizon)
    else:
        budget = outlook.budget(e, s)
        if math.isnan(budget.throttle):
            if known:
                budget = load_budget(risks, forecast.flown, s.budget_limit, voltage, horizon)
            elif not e.usable and load.status is not LoadStatus.NO_DATA:
                return Ahead(outcome, NAN, load.status.value if not load.known else
                             'Less than a second has been flown.')
        elif budget.risks.size:
            # Elsewhere it is the prior's.
            risks = np.where(budget.known, budget.risks, NAN)
    return Ahead(outcome, budget.throttle, budget.reason, _tenths(risks))


def _tenths(risks: FloatArray) -> tuple[float, ...]:
    return () if np.isnan(risks).all() else tuple(risks[::5].tolist())


def risk_of_all(outlook: Outlook, forecast: Forecast, e: Estimate, settings: MonitorSettings,
                voltage: float, horizon: float) -> Outcome:
    """Return the risk of all legs together; voltage in V, horizon in s."""
    passage = outlook.risk(e, voltage, horizon, settings.brownout_watch) if e.usable else NAN
    if e.usable and math.isnan(passage):
        # The tables of events that a model file names are not there yet.
        return Outcome()
    return forecast.risk(voltage, horizon, passage, alone=outlook.events is not None)


def load_budget(risks: FloatArray, flown: tuple[float, float], limit: float, voltage: float,
                dwell: float) -> ThrottleBudget:
    """Return the budget from the risks at `CURVE`, held for `dwell`, s; voltage in V."""
    lowest, highest = flown
    known = (CURVE >= lowest) & (CURVE <= highest)
    what = f' Brown-out: below {voltage:g} V while it is held for {dwell:g} s.'
    if np.isnan(risks).any():
        return ThrottleBudget(NAN, lowest, highest, limit, 'The load is not known.')
    # A risk that falls again beyond a peak is no way through.
    risks = np.maximum.accumulate(risks)
    within = int(np.searchsorted(risks, limit, 'right'))
    if within == 0:
        return ThrottleBudget(0.0, lowest, highest, limit,
                              f'Even idle is above the limit: risk {risks[0]:.2g}.' + what,
                              CURVE, risks, known)
    end = 1.0
    if within < CURVE.size:
        low, high = risks[within - 1], risks[within]
        # The logarithm of the risk is nearly straight over so short a way.
        end = CURVE[within - 1] + (CURVE[within] - CURVE[within - 1]) * (
            math.log(limit / low) / math.log(high / low) if low > 0.0 else 0.0)
    if end > highest:
        throttle, reason = highest, (f'No data above {highest:.2f}; within the limit up to '
                                     'there.')
        if highest == 1.0:
            reason = 'Within the limit up to full throttle.'
    else:
        throttle, reason = end, f'The risk passes the limit of {limit:.2g} at throttle {end:.2f}.'
    return ThrottleBudget(float(throttle), lowest, highest, limit, reason + what, CURVE, risks,
                          known)
