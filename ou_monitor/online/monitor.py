"""
Everything the node knows, without ROS: estimate, risk, and the health of the input.

The node pushes samples and asks for a report; the offline tools do the same
with a recording, so both say the same thing of the same data.
"""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

import numpy.typing as npt
from ou_monitor.model.supply import SupplyModel
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.risk.flag import BrownoutFlag, FlagLevel, FlagState
from ou_monitor.online.risk.outlook import Outlook
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, Flag, NAN, Status

# Cautions that make the numbers doubtful; the others only inform.
_DOUBTFUL = frozenset({Flag.SLOW_RATE, Flag.QUANTIZED, Flag.LOWPASS_UPSTREAM, Flag.SATURATED,
                       Flag.TREND})


class Level(enum.IntEnum):
    """Levels of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2
    STALE = 3


@dataclass(frozen=True)
class MonitorReport:
    """
    What is known at one instant.

    Attributes
    ----------
    estimate : Estimate
        Newest estimate.
    risk : float
        Probability of a brown-out within the horizon; NaN when not known.
    budget : float
        Highest throttle, 0..1, that keeps the risk under
        `brownout.budget_limit`; NaN when not known.
    budget_reason : str
        What ends the budget, or why it is not known.
    left_out : tuple of str
        Terms of the model file that move the supply and that the risk does not know of.
    flag : FlagState
        The brown-out flag, and why.
    level : Level
        Level for the diagnostics.
    summary : str
        One line for the pilot.
    age : float
        Time since the last voltage arrived, s; inf when none ever did.

    """

    estimate: Estimate
    risk: float
    budget: float
    budget_reason: str
    left_out: tuple[str, ...]
    flag: FlagState
    level: Level
    summary: str
    age: float

    @property
    def brownout(self) -> bool | None:
        """Return the flag; None when not known."""
        return self.flag.brownout

    @property
    def fields(self) -> dict[str, str]:
        """Return every field as text, for diagnostics; numbers round-trip."""
        e = self.estimate
        values: dict[str, object] = {
            name: getattr(e, name) for name in (
                't', 'alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'var_inf_se', 'tau',
                'u0', 'u0_se', 'noise_std', 'sag', 'voltage', 'throttle', 'n', 'duration', 'rate')}
        values['brownout_risk'] = self.risk
        values['brownout'] = 'unknown' if self.brownout is None else str(self.brownout).lower()
        values['brownout_level'] = self.flag.level.name
        values['brownout_level_age'] = self.flag.age
        values['brownout_reason'] = self.flag.reason
        values['throttle_budget'] = self.budget
        values['model_left_out'] = ','.join(self.left_out)
        values['throttle_budget_reason'] = self.budget_reason
        values['age'] = self.age
        values['status'] = e.status.name
        values['status_text'] = e.status.value
        values['flags'] = ','.join(flag.name for flag in e.flags)
        for name in ('pushed', 'used', 'non_finite', 'late', 'held', 'resets'):
            values[name] = getattr(e.counters, name)
        return {name: repr(v) if isinstance(v, float) else str(v) for name, v in values.items()}


class SupplyMonitor:
    """
    Estimator, risk and health of the input behind one node.

    Parameters
    ----------
    settings : MonitorSettings, optional
        Settings; the defaults when left out.
    model : SupplyModel, optional
        Terms of the supply, as `discover` found them; none when left out.
    background : bool
        Whether tables for these terms are made in a thread, so that reports never wait;
        until they are there the risk is unknown.

    """

    def __init__(self, settings: MonitorSettings | None = None,
                 model: SupplyModel | None = None, *, background: bool = True) -> None:
        self._settings = settings or MonitorSettings()
        self._estimator = SlidingEstimator(self._settings.window)
        self._flag = BrownoutFlag(self._settings)
        self._outlook = Outlook(background=background)
        self._outlook.set_model(model)
        self._newest = Estimate()
        self._model = model
        self._reset_reason = ''

    @property
    def settings(self) -> MonitorSettings:
        """Return the settings in force."""
        return self._settings

    def configure(self, settings: MonitorSettings) -> None:
        """Change settings; no sample inside the new window is lost."""
        if settings.window != self._settings.window:
            self._estimator.window = settings.window
        self._settings = settings
        self._flag.configure(settings)

    @property
    def outlook(self) -> Outlook:
        """Return what lies ahead: learned curves, risk and budget."""
        return self._outlook

    @property
    def model(self) -> SupplyModel | None:
        """Return the terms of the supply in force."""
        return self._model

    def set_model(self, model: SupplyModel | None) -> None:
        """Change the terms of the supply; window and flag stay."""
        self._model = model
        self._outlook.set_model(model)

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None) -> None:
        """Add samples; see `SlidingEstimator.push`."""
        self._estimator.push(t, voltage, throttle)
        self._flag.push(t, voltage)
        self._outlook.push(t, voltage, throttle, self._newest)

    def clear_brownout(self) -> str:
        """
        Drop a CRITICAL that is latched or held; the next report judges anew.

        Returns
        -------
        str
            What was cleared; empty when there was nothing.

        """
        old = self._flag.state
        return (f'CRITICAL of {old.age:.1f} s is cleared; the flag is judged anew.'
                if self._flag.clear() else '')

    def reset(self, reason: str) -> None:
        """Clear the window, and remember why for the next reports; the flag stays held."""
        self._estimator.reset()
        self._flag.new_time_line()
        self._outlook.new_time_line()
        self._reset_reason = reason

    def report(self, age: float | None, now: float | None = None) -> MonitorReport:
        """
        Return what is known now.

        Parameters
        ----------
        age : float or None
            Time since the last voltage arrived, s; None when none ever did.
        now : float, optional
            The clock by which the flag counts hold and delay, s; when left
            out the stamp of the newest sample plus `age`.

        Returns
        -------
        MonitorReport
            The report.

        """
        e = self._newest = self._estimator.estimate()
        silent = math.inf if age is None else max(age, 0.0)
        stale = silent > self._settings.stale_after or e.status is Status.NO_DATA
        risk = NAN if stale else self._outlook.risk(e, self._settings)
        budget = None if stale else self._outlook.budget(e, self._settings)
        events = self._outlook.events
        flag = self._flag.update(e.t + silent if now is None else now, risk, fresh=not stale)
        level, summary = self._judge(e, risk, flag, self._silence(age, e) if stale else '')
        return MonitorReport(e, risk, NAN if budget is None else budget.throttle,
                             '' if budget is None else budget.reason,
                             () if events is None else events.left_out, flag, level,
                             summary, silent)

    def _silence(self, age: float | None, e: Estimate) -> str:
        if age is not None and age > self._settings.stale_after:
            return (f'No voltage for {age:.1f} s (stale_after = {self._settings.stale_after:g} '
                    's): check the publisher.')
        if e.counters.non_finite and not e.counters.used:
            return (f'No usable voltage: all {e.counters.non_finite} samples were NaN or '
                    'infinite; check the sensor.')
        if self._reset_reason:
            return f'The window was cleared ({self._reset_reason}) and is filling again.'
        return Status.NO_DATA.value

    def _judge(self, e: Estimate, risk: float, flag: FlagState,
               silence: str) -> tuple[Level, str]:
        """Return the level of the diagnostics and the line for the pilot."""
        critical = flag.level is FlagLevel.CRITICAL
        if silence:
            still = f' The brown-out flag is still set: {flag.reason}.' if critical else ''
            return Level.STALE, silence + still
        if critical:
            return Level.ERROR, self._of_risk(e, risk, flag)
        if flag.level is FlagLevel.WARN and flag.brownout is not None:
            return Level.WARN, self._of_risk(e, risk, flag)
        if not e.usable:
            rate = f' Input: {e.n} samples at {e.rate:.3g} Hz.' if e.rate > 0.0 else ''
            return Level.WARN, e.status.value + rate
        if flag.level is not FlagLevel.OK:
            return Level.WARN, self._of_risk(e, risk, flag)
        doubts = [caution.value for caution in e.flags if caution in _DOUBTFUL]
        if doubts:
            return Level.WARN, ' '.join(doubts)
        return Level.OK, e.status.value

    def _of_risk(self, e: Estimate, risk: float, flag: FlagState) -> str:
        s = self._settings
        load = f' at throttle {e.throttle:.2f}' if math.isfinite(e.throttle) else ''
        known = 'unknown' if math.isnan(risk) else f'{risk:.2g}'
        supply = f'; supply now {e.voltage:.3f} V' if math.isfinite(e.voltage) else ''
        return (f'Brown-out risk {known} within {s.brownout_horizon:g} s of '
                f'{s.brownout_voltage:g} V (critical from {s.brownout_critical:g}){load}{supply}; '
                f'{flag.level.name} for {flag.age:.1f} s: {flag.reason}.')
