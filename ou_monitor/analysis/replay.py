"""
What the node would have published during a recording, and what it had learned by its end.

The recording goes through `SupplyMonitor`, as in flight, so that both say the same of the same
data, also where throttle never stands still.  Limits: those of the monitor; the risk is that of
the supply as it was at the end of the recording.  What has not been flown is NaN.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.report import MonitorReport, RISK_CURVE
from ou_monitor.online.risk.outlook import Outlook
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, FloatArray, LARGEST_LOG_SE, NAN, Recording
from ou_monitor.text import Z95

MAX_POINTS = 300
# The node estimates at least so often, s; here, up to so many times in all.
_STEP, _MOST = 0.5, 1200
_POINTS = 51


@dataclass(frozen=True, eq=False)
class Sliding:
    """
    Sliding estimates of a whole recording.

    Attributes
    ----------
    window : float
        Length of the window, s.
    t : ndarray, shape (k,)
        Stamps of the newest sample of each window, s.
    estimates : tuple of Estimate
        One a stamp; the numbers of those that are not usable are NaN.
    risk : ndarray, shape (k,)
        Probability of a brown-out within the horizon; NaN when unknown.
    brownout_voltage, brownout_horizon : float
        What the risk is of, V and s.
    outlook : Outlook
        What the node has learned by the end: curves over throttle, risk and budget.
    settings : MonitorSettings
        Of the node; its voltage is the default where none was asked for.
    last : MonitorReport or None
        What the node knows at the end; None of a recording too short for a window.
    highest : float
        Highest throttle of the recording, 0..1; NaN without throttle.

    """

    window: float
    t: FloatArray
    estimates: tuple[Estimate, ...]
    risk: FloatArray
    brownout_voltage: float
    brownout_horizon: float
    outlook: Outlook
    settings: MonitorSettings
    last: MonitorReport | None
    highest: float

    def series(self, name: str) -> FloatArray:
        """Return one field of the estimates as an array."""
        return np.array([getattr(e, name) for e in self.estimates], dtype=np.float64)

    def interval(self, name: str) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the 95 % intervals of a field."""
        value = self.series(name)
        factor = np.exp(Z95 * self.series(name + '_se'))
        return value / factor, value * factor


def slide(recording: Recording, window: float, brownout_voltage: float = NAN,
          brownout_horizon: float = 5.0,
          progress: Callable[[float], None] | None = None) -> Sliding:
    """
    Run the node's estimator and its outlook over a recording.

    window in s, brownout_voltage in V, brownout_horizon in s, progress 0..1.
    """
    if not (math.isfinite(brownout_horizon) and brownout_horizon > 0.0):
        raise ValueError(f'the horizon must be a positive number of seconds, got '
                         f'{brownout_horizon}')
    asked = math.isfinite(brownout_voltage)
    settings = MonitorSettings(window=window, brownout_horizon=brownout_horizon)
    if asked:
        settings = replace(settings, brownout_voltage=brownout_voltage)
    monitor = SupplyMonitor(settings)
    t, voltage, throttle = recording.t, recording.voltage, recording.throttle
    known, drawn = recording.has_throttle, recording.current

    def push(part: slice) -> None:
        monitor.push(t[part], voltage[part], throttle[part] if known else None,
                     current=None if drawn is None else drawn[part])

    reports: list[MonitorReport] = []
    last = None
    step = max(0.25 * window, recording.duration / MAX_POINTS)
    # In between, reports are for what the monitor learns from its own estimates.
    parts = max(1, min(math.ceil(step / _STEP), _MOST // MAX_POINTS))
    first = float(t[0]) if t.size else 0.0
    count = int(recording.duration / step) * parts
    done = 0
    for k in range(1, count + 1):
        stop = int(np.searchsorted(t, first + k * step / parts, side='right'))
        if stop == done:
            continue
        push(slice(done, stop))
        done = stop
        last = monitor.report(0.0)
        # Until the first window is full its estimates would only look poor.
        filling = t[stop - 1] - first < min(window, 0.5 * recording.duration)
        if filling or k % parts:
            continue
        reports.append(last)
        if progress is not None:
            progress(k / count)
    if done < t.size and reports:
        push(slice(done, t.size))
        last = monitor.report(0.0)
    return Sliding(window, np.array([report.estimate.t for report in reports]),
                   tuple(report.estimate for report in reports),
                   np.array([report.risk if asked else NAN for report in reports]),
                   brownout_voltage, brownout_horizon, monitor.outlook, settings, last,
                   float(np.nanmax(throttle)) if known else NAN)


@dataclass(frozen=True, eq=False)
class ByThrottle:
    """
    Curves over throttle.

    Attributes
    ----------
    throttle : ndarray, shape (k,)
        0, 0.02, .. 1.
    known : ndarray of bool, shape (k,)
        Whether that throttle was flown; the curves are NaN elsewhere.
    level, level_se : ndarray, shape (k,)
        Mean voltage at the end of the recording, and its standard error, V.
    sag, sag_low, sag_high : ndarray, shape (k,)
        How far the level lies below that of the lowest throttle flown, and its 95 % interval, V.
        The errors of the two levels count as independent, which makes it too wide.
    sigma, sigma_low, sigma_high : ndarray, shape (k,)
        Noise intensity and its 95 % interval, V/sqrt(s).
    risk : ndarray, shape (k,)
        Probability of a brown-out within the horizon, with the errors of the curves in it.
    budget : float
        Highest throttle that keeps the risk within `limit`; NaN when unknown.
    budget_reason : str
        What ends it, or why it is not known.
    limit : float
        That risk.
    voltage, horizon : float
        What the risk is of, V and s.
    time : float
        Stamp at which the risk is told, s; NaN of a recording too short for a window.

    """

    throttle: FloatArray
    known: npt.NDArray[np.bool_]
    level: FloatArray
    level_se: FloatArray
    sag: FloatArray
    sag_low: FloatArray
    sag_high: FloatArray
    sigma: FloatArray
    sigma_low: FloatArray
    sigma_high: FloatArray
    risk: FloatArray
    budget: float
    budget_reason: str
    limit: float
    voltage: float
    horizon: float
    time: float

    def at(self, throttle: float, name: str) -> float:
        """Return one curve at a throttle, between its points; NaN when unknown."""
        if math.isnan(throttle):
            return NAN
        return float(np.interp(throttle, self.throttle, getattr(self, name)))


def by_throttle(sliding: Sliding, has_throttle: bool) -> ByThrottle:
    """Read the curves that were learned from a recording."""
    outlook = sliding.outlook
    grid = np.linspace(0.0, 1.0, _POINTS)
    asked = math.isfinite(sliding.brownout_voltage)
    curves = outlook.curves
    unknown = np.full(_POINTS, NAN)
    # Without throttle all samples count as of throttle 0: that is no curve.
    known = curves.seen_curve(grid) & has_throttle
    level, level_se = (np.where(known, c, NAN) for c in curves.level_curve(grid))
    ln_sigma, ln_sigma_se = curves.sigma_curve(grid)
    ln_sigma = np.where(known & (ln_sigma_se <= LARGEST_LOG_SE), ln_sigma, NAN)
    last = sliding.last
    risk = unknown
    if asked and last is not None and last.risk_curve:
        risk = np.interp(grid, RISK_CURVE, last.risk_curve)
        risk = np.where(grid <= sliding.highest, risk, NAN)
    first = int(known.argmax())
    sag = level[first] - level
    reach = np.where(np.arange(_POINTS) == first, 0.0, Z95 * np.hypot(level_se, level_se[first]))
    return ByThrottle(
        grid, known, level, level_se, sag, sag - reach, sag + reach, np.exp(ln_sigma),
        np.exp(ln_sigma - Z95 * ln_sigma_se), np.exp(ln_sigma + Z95 * ln_sigma_se), risk,
        last.budget if asked and last is not None else NAN,
        _reason(last) if asked else 'No voltage was asked for.',
        sliding.settings.budget_limit, sliding.brownout_voltage, sliding.brownout_horizon,
        last.estimate.t if last is not None else NAN)


def _reason(last: MonitorReport | None) -> str:
    """Return what ends the budget; what the risk is of stands beside it."""
    if last is None:
        return 'The recording is shorter than half a window.'
    return last.budget_reason.split(' Brown-out:')[0]
