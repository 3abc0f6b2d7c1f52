"""
What lies ahead of the supply: risk, what it stands on, the curve over throttle, and the budget.

The window knows the supply of the last seconds; the curves learned in flight know the intensity
of the present throttle, which after a step is not that of the window; and how fast the intensity
has been seen to wander tells what may become of it within the horizon.  `Forecast` knows the
other legs.

Limits: no throttle above the highest flown in the last minutes is called safe.  Of first passage:
throttle stays as it is; a throttle not flown before has the error of the curves' prior; alpha is
that of the present estimate at every throttle, as the paper assumes; the supply is taken to have
settled, so the dip that follows a step of throttle (inrush, overshoot) is not in the risk, nor is
further discharge; the terms of a model file count as `EventRisk` says.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from ou_monitor.model.passage.law import prepare
from ou_monitor.online.load.supply_load import LoadStatus, SupplyLoad
from ou_monitor.online.risk.curves import LearnedCurves
from ou_monitor.online.risk.first_passage import as_sampled, EventRisk, Passage, risk_of, Supply
from ou_monitor.online.risk.forecast import Forecast, Outcome
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, FloatArray, NAN

if TYPE_CHECKING:
    from ou_monitor.model.supply import SupplyModel

# probability(u0, u0_se, ln_sigma, ln_sigma_se, ln_alpha, ln_alpha_se) -> risk, elementwise.
Probability = Callable[
    [FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]

# Throttles at which the risk is computed, and points between two of them.
_STEPS = 50
_FINE = 9
_GRID = np.linspace(0.0, 1.0, _STEPS + 1)


@dataclass(frozen=True, eq=False)
class ThrottleBudget:
    """
    The highest throttle that keeps the risk under a limit.

    Attributes
    ----------
    throttle : float
        The budget, 0..1; NaN when unknown; 0 when even idle, flown, is above the limit.
    reason : str
        What ends the budget, or why it is unknown, in words.
    risks : ndarray, shape (51,)
        Risk at throttles from 0 to 1; empty when nothing could be computed.
    known : ndarray of bool, shape (51,)
        Whether data near that throttle weigh more than the prior.

    """

    throttle: float
    reason: str
    risks: FloatArray = field(default_factory=lambda: np.empty(0))
    known: npt.NDArray[np.bool_] = field(default_factory=lambda: np.empty(0, dtype=np.bool_))


def throttle_budget(estimate: Estimate, curves: LearnedCurves, *, voltage: float,
                    horizon: float, limit: float, probability: Probability) -> ThrottleBudget:
    """
    Return the highest throttle up to which the risk stays within the limit.

    A rail that holds at the lowest throttle flown is taken to hold below it.  Where it does not,
    the budget lies below, and is known as far as the prior is good enough for that.

    voltage in V, horizon in s.
    """
    if not estimate.usable:
        return ThrottleBudget(NAN, 'Estimate not usable: ' + estimate.status.value)
    if not curves.throttle_known:
        return ThrottleBudget(NAN, 'No throttle is known.')
    lowest, highest = curves.extent
    if math.isnan(highest):
        return ThrottleBudget(NAN, 'No throttle has been held long enough yet to learn from.')
    risks = _risks(_GRID, estimate, curves, probability)
    known = curves.seen_curve(_GRID)
    known.setflags(write=False)
    risks.setflags(write=False)
    throttle, reason = _end(risks, known, lowest, highest, limit,
                            lambda at: _risks(at, estimate, curves, probability))
    if math.isfinite(throttle):
        reason += f' Brown-out: below {voltage:g} V within {horizon:g} s.'
    return ThrottleBudget(throttle, reason, risks, known)


def _risks(throttles: FloatArray, e: Estimate, curves: LearnedCurves,
           probability: Probability) -> FloatArray:
    """Return the risk at throttles of shape (k,)."""
    level, level_se = curves.level_curve(throttles)
    log_sigma, log_sigma_se = curves.sigma_curve(throttles)
    log_alpha = np.full(throttles.shape, math.log(e.alpha))
    alpha_se = np.full(throttles.shape, e.alpha_se if math.isfinite(e.alpha_se) else 0.0)
    # A quadrature may round to just above 1; NaN stays.
    return np.clip(np.asarray(
        probability(level, level_se, log_sigma, log_sigma_se, log_alpha, alpha_se),
        dtype=np.float64), 0.0, 1.0)


def _end(risks: FloatArray, known: npt.NDArray[np.bool_], lowest: float, highest: float,
         limit: float, risks_at: Callable[[FloatArray], FloatArray]) -> tuple[float, str]:
    """Return where the budget ends, and why."""
    first, last = round(lowest * _STEPS), round(highest * _STEPS)
    # NaN is not within the limit.
    within = risks <= limit
    if not within[first]:
        if math.isnan(risks.item(first)):
            return NAN, f'The risk could not be computed at throttle {lowest:.2f}.'
        if first == 0:
            return 0.0, f'Even at idle the risk is {risks.item(0):.2g}, more than allowed.'
        if not within[0]:
            return NAN, (f'Above the limit at {lowest:.2f}, the lowest throttle flown '
                         f'(risk {risks.item(first):.2g}); no data below.')
        first = 0
    beyond = np.flatnonzero(~within[first:last + 1])
    if not beyond.size:
        if last == _STEPS:
            return 1.0, 'Within the limit up to full throttle.'
        return highest, f'No data above {highest:.2f}; within the limit up to there.'
    k = first + beyond.item(0)
    at = np.linspace(_GRID.item(k - 1), _GRID.item(k), _FINE + 2)
    fine = np.concatenate([risks[k - 1:k], risks_at(at[1:-1]), risks[k:k + 1]])
    j = int(np.flatnonzero(~(fine <= limit)).item(0))
    end = at.item(j - 1)
    low, high = fine.item(j - 1), fine.item(j)
    if low > 0.0 and high > limit > low:
        # The logarithm of the risk is nearly straight over so short a way.
        end += (at.item(j) - end) * math.log(limit / low) / math.log(high / low)
    if math.isnan(high):
        return end, f'The risk could not be computed above {end:.2f}.'
    if not known[k]:
        return end, f'No data near {_GRID.item(k):.2f}: the risk there may be above the limit.'
    return end, f'The risk passes the limit of {limit:.2g} at throttle {end:.2f}.'


# Share of the walk of ln sigma within the horizon that counts: the risk is of all of it,
# not of its end, but the largest sigma counts most.
_SHARE = 0.8
# Largest error of ln sigma that is averaged over: beyond it sigma is unknown.
_LARGEST = 1.0
# Newest voltages of which the middle one is where the supply is now: one bad sample is
# no brown-out.
_NEWEST = 3


# Time ahead, s, for which the flag asks what happens if throttle stays as it is.
SOON = 1.0


class Outlook:
    """Risk and throttle budget of one supply; tables for a model are made in a thread, or not."""

    def __init__(self, *, background: bool = True) -> None:
        # A third of a second, once: not while samples are coming.
        prepare()
        self._curves = LearnedCurves()
        self._newest = np.empty(0)
        # Whether no throttle has come yet: all samples are then of one.
        self._blind = True
        self._background = background
        self._events: EventRisk | None = None
        self._noise = 0.0

    def set_model(self, model: SupplyModel | None) -> None:
        """Change the terms that ride along with the OU; nothing learned is lost."""
        self._events, self._noise = None, 0.0
        if model is None:
            return
        # Here, for without a model the nodes need none of it: it costs them 60 MB.
        from ou_monitor.model.terms.reading import MeasurementNoise
        self._events = EventRisk(model, background=self._background)
        self._noise = math.sqrt(sum(
            term.std**2 for term in model.terms if isinstance(term, MeasurementNoise)))

    @property
    def events(self) -> EventRisk | None:
        """Return what the model adds to the risk; None without a model."""
        return self._events

    @property
    def curves(self) -> LearnedCurves:
        """Return what has been learned in flight."""
        return self._curves

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike, throttle: npt.ArrayLike | None,
             estimate: Estimate) -> None:
        """Learn from samples, given the newest estimate; see `LearnedCurves.update`."""
        volts = np.atleast_1d(np.asarray(voltage, dtype=np.float64))[-64:]
        last = np.concatenate((self._newest, volts[np.isfinite(volts)]))
        self._newest = last[-_NEWEST:]
        if self._blind:
            if throttle is None or not np.isfinite(np.asarray(throttle, dtype=np.float64)).any():
                self._curves.update(t, voltage, 0.0, estimate)
                return
            self._blind, self._curves = False, LearnedCurves()
        self._curves.update(t, voltage, throttle, estimate)

    def new_time_line(self) -> None:
        """Forget where the supply was last; what throttle does to it stays learned."""
        self._newest = np.empty(0)

    @property
    def voltage(self) -> float:
        """Where the supply is now, V: the middle one of the last three samples; NaN of one."""
        return float(np.median(self._newest)) if self._newest.size > 1 else NAN

    def supply(self, e: Estimate, horizon: float) -> Supply:
        """Return what is known of the supply at the present throttle (horizon in s)."""
        plain = Supply.of(e)
        throttle = 0.0 if self._blind else e.throttle
        if math.isnan(throttle):
            return plain
        sigma, level = self._curves.sigma_at(throttle), self._curves.level_at(throttle)
        if not (math.isfinite(sigma.value) and math.isfinite(level.value)):
            return plain
        u0, u0_se = plain.u0, plain.u0_se
        if level.se < float(np.asarray(u0_se)):
            u0, u0_se = level.value, level.se
        ln_sigma, error = self._ahead(np.array([sigma.value]), np.array([sigma.se]), horizon)
        return Supply(u0, u0_se, plain.ln_alpha, plain.ln_alpha_se, ln_sigma.item(), error.item())

    def _ahead(self, ln_sigma: FloatArray, error: FloatArray, horizon: float
               ) -> tuple[FloatArray, FloatArray]:
        """Return ln sigma with what it wanders, and the error of that within the horizon."""
        wander = self._curves.wander
        variance = error**2 + wander.variance + _SHARE * wander.fast_speed * horizon
        return ln_sigma + wander.value, np.minimum(np.sqrt(variance), _LARGEST)

    def passage(self, e: Estimate, horizon: float) -> Passage | None:
        """Return the law of the lowest voltage within a horizon, s; None when not known."""
        now = self.voltage
        if not e.usable or math.isnan(now):
            return None
        return Passage(self.supply(e, horizon), now, self._noise_of(e))

    def _noise_of(self, e: Estimate) -> float:
        return e.noise_std if e.noise_std > 0.0 else self._noise

    def risk(self, e: Estimate, voltage: float, horizon: float, watch: str = 'continuous'
             ) -> float:
        """Return P(below `voltage`, V, within `horizon`, s); NaN when not known."""
        now = self.voltage
        if now <= voltage:
            return 1.0
        if not e.usable:
            return NAN
        here = None if math.isnan(now) else now
        supply = self.supply(e, horizon)
        risk = float(risk_of(supply, voltage, horizon, here, self._noise_of(e)))
        if watch == 'sampled':
            risk = as_sampled(e, supply, voltage, horizon, here, risk)
        if self._events is None:
            return risk
        self._events.follow(float(np.asarray(supply.ln_alpha)), float(np.asarray(supply.ln_sigma)))
        added = self._events.survival(
            supply.u0 if here is None else here, voltage, horizon,
            ln_alpha=supply.ln_alpha, ln_sigma=supply.ln_sigma, u0=supply.u0)
        return _with_events(np.array(risk), added).item()

    def budget(self, e: Estimate, settings: MonitorSettings) -> ThrottleBudget:
        """Return the throttle budget; its throttle is NaN when not known."""
        s = settings
        if self._blind:
            return ThrottleBudget(NAN, 'No throttle is known.')

        def probability(u0: FloatArray, u0_se: FloatArray, ln_sigma: FloatArray,
                        ln_sigma_se: FloatArray, ln_alpha: FloatArray, ln_alpha_se: FloatArray
                        ) -> FloatArray:
            ln_sigma, ln_sigma_se = self._ahead(ln_sigma, ln_sigma_se, s.brownout_horizon)
            risk = risk_of(Supply(u0, u0_se, ln_alpha, ln_alpha_se, ln_sigma, ln_sigma_se),
                           s.brownout_voltage, s.brownout_horizon, coarse=True)
            if self._events is None:
                return risk
            return _with_events(risk, self._events.survival(
                u0, s.brownout_voltage, s.brownout_horizon, ln_alpha=ln_alpha,
                ln_sigma=ln_sigma, u0=u0))

        return throttle_budget(e, self._curves, voltage=s.brownout_voltage,
                               horizon=s.brownout_horizon, limit=s.budget_limit,
                               probability=probability)


def _with_events(risk: FloatArray, added: FloatArray) -> FloatArray:
    """Return the risk with what events add; NaN where that is not known yet."""
    # With a risk of 1 nothing can be added.
    inside = np.minimum(risk, 1.0 - 1e-16)
    total: FloatArray = np.where(risk >= 1.0, 1.0, -np.expm1(np.log1p(-inside) + added))
    return total


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
    soon : float
        Risk within `SOON` with throttle as it is now; NaN when not known.
    tight : bool
        Whether the budget is below the throttle that was passed for a tenth of the last 30 s.

    """

    outcome: Outcome = Outcome()
    budget: float = NAN
    budget_reason: str = ''
    curve: tuple[float, ...] = ()
    soon: float = NAN
    tight: bool = False


def look_ahead(outlook: Outlook, forecast: Forecast, e: Estimate, load: SupplyLoad,
               settings: MonitorSettings) -> Ahead:
    """Return what lies ahead by the settings."""
    s = settings
    voltage, horizon = s.brownout_voltage, s.brownout_horizon
    outcome = risk_of_all(outlook, forecast, e, s, voltage, horizon)
    soon = forecast.risk_held(voltage, SOON) if outcome.basis == 'load' else NAN
    if math.isnan(soon):
        soon = risk_of_all(outlook, forecast, e, s, voltage, min(SOON, horizon)).risk
    risks = forecast.risk_if(_GRID, horizon, voltage, horizon)
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
                             'Less than a second has been flown.', soon=soon)
        elif budget.risks.size:
            # Elsewhere it is the prior's.
            risks = np.where(budget.known, budget.risks, NAN)
    # NaN is not below.
    return Ahead(outcome, budget.throttle, budget.reason, _tenths(risks), soon,
                 budget.throttle < forecast.used)


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
    """Return the budget from the risks at `_GRID`, held for `dwell`, s; voltage in V."""
    lowest, highest = flown
    known = (_GRID >= lowest) & (_GRID <= highest)
    what = f' Brown-out: below {voltage:g} V while it is held for {dwell:g} s.'
    if np.isnan(risks).any():
        return ThrottleBudget(NAN, 'The load is not known.')
    # A risk that falls again beyond a peak is no way through.
    risks = np.maximum.accumulate(risks)
    within = int(np.searchsorted(risks, limit, 'right'))
    if within == 0:
        return ThrottleBudget(
            0.0, f'Even at idle the risk is {risks[0]:.2g}, more than allowed.{what}', risks,
            known)
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
    return ThrottleBudget(float(throttle), reason + what, risks, known)
