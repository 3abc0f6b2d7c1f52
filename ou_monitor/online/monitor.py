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

from ou_monitor.online.estimator import SlidingEstimator
from ou_monitor.online.risk import brownout_probability
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
    brownout : bool or None
        The flag; None when not known.
    level : Level
        Level for the diagnostics.
    summary : str
        One line for the pilot.
    age : float
        Time since the last voltage arrived, s; inf when none ever did.

    """

    estimate: Estimate
    risk: float
    brownout: bool | None
    level: Level
    summary: str
    age: float

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

    """

    def __init__(self, settings: MonitorSettings | None = None) -> None:
        self._settings = settings or MonitorSettings()
        self._estimator = SlidingEstimator(self._settings.window)
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

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None) -> None:
        """Add samples; see `SlidingEstimator.push`."""
        self._estimator.push(t, voltage, throttle)

    def reset(self, reason: str) -> None:
        """Clear the window, and remember why for the next reports."""
        self._estimator.reset()
        self._reset_reason = reason

    def report(self, age: float | None) -> MonitorReport:
        """
        Return what is known now.

        Parameters
        ----------
        age : float or None
            Time since the last voltage arrived, s; None when none ever did.

        Returns
        -------
        MonitorReport
            The report.

        """
        e = self._estimator.estimate()
        s = self._settings
        silent = math.inf if age is None else max(age, 0.0)
        if age is None or silent > s.stale_after or e.status is Status.NO_DATA:
            return MonitorReport(e, NAN, None, Level.STALE, self._silence(age, e), silent)
        risk = brownout_probability(e, s.brownout_voltage, s.brownout_horizon, e.voltage)
        brownout = None if math.isnan(risk) else risk >= s.brownout_critical
        level, summary = self._judge(e, risk)
        return MonitorReport(e, risk, brownout, level, summary, silent)

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

    def _judge(self, e: Estimate, risk: float) -> tuple[Level, str]:
        s = self._settings
        if risk >= s.brownout_critical:
            return Level.ERROR, (
                f'Brown-out risk {risk:.2g} within {s.brownout_horizon:g} s of '
                f'{s.brownout_voltage:g} V (critical from {s.brownout_critical:g}); supply now '
                f'{e.voltage:.3f} V.')
        if not e.usable:
            rate = f' Input: {e.n} samples at {e.rate:.3g} Hz.' if e.rate > 0.0 else ''
            return Level.WARN, e.status.value + rate
        if risk >= s.brownout_warn:
            return Level.WARN, (
                f'Brown-out risk {risk:.2g} within {s.brownout_horizon:g} s of '
                f'{s.brownout_voltage:g} V.')
        doubts = [flag.value for flag in e.flags if flag in _DOUBTFUL]
        if doubts:
            return Level.WARN, ' '.join(doubts)
        return Level.OK, e.status.value
