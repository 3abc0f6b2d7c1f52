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
from ou_monitor.analysis.overview import Overview
from ou_monitor.analysis.supply import node_for, THROTTLES
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.report import MonitorReport
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, FloatArray, NAN, Recording
from ou_monitor.text import Z95


@dataclass(frozen=True, eq=False)
class Sliding:
    """Sliding estimates of a whole recording."""

    window: float  # Length of the window, s
    t: FloatArray  # Stamps of the newest sample of each window, s; shape (k,)
    # One a stamp; the numbers of those that are not usable are NaN.
    estimates: tuple[Estimate, ...]
    risk: FloatArray  # Probability of a brown-out within the horizon; NaN when unknown; shape (k,)
    # What the risk is of, V and s.
    brownout_voltage: float
    brownout_horizon: float
    monitor: SupplyMonitor  # As it is at the end of the recording

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
    Run the node's monitor over a recording.

    window in s, brownout_voltage in V, brownout_horizon in s, progress 0..1.
    """
    if not (math.isfinite(brownout_horizon) and brownout_horizon > 0.0):
        raise ValueError(f'the horizon must be a positive number of seconds, got '
                         f'{brownout_horizon}')
    asked = math.isfinite(brownout_voltage)
    settings = MonitorSettings(window=window, brownout_horizon=brownout_horizon)
    if asked:
        settings = replace(settings, brownout_voltage=brownout_voltage)
    reports: list[MonitorReport] = []
    duration = recording.duration
    monitor, parts = node_for(recording, settings)
    for now, shown in parts:
        # In between, reports are for what the monitor learns from its own estimates.
        last = monitor.report(0.0)
        # Until the first window is full its estimates would only look poor.
        if shown and now >= min(window, 0.5 * duration):
            reports.append(last)
            if progress is not None:
                progress(now / duration)
    return Sliding(window, np.array([report.estimate.t for report in reports]),
                   tuple(report.estimate for report in reports),
                   np.array([report.risk if asked else NAN for report in reports]),
                   brownout_voltage, brownout_horizon, monitor)


@dataclass(frozen=True, eq=False)
class ByThrottle:
    """Curves over throttle."""

    # 0, 0.1, .. 1; shape (k,).
    throttle: FloatArray
    # Whether that throttle was flown; beyond, sag and noise are extrapolated; shape (k,).
    known: npt.NDArray[np.bool_]
    # Sag of the facts and its 95 % interval, V; NaN where it is not known; shape (k,).
    sag: FloatArray
    sag_low: FloatArray
    sag_high: FloatArray
    noise: FloatArray  # Rms of what the load does not explain, of the facts, V; shape (k,)
    # Probability of a brown-out within the horizon; NaN well beyond the highest throttle; shape
    # (k,).
    risk: FloatArray
    budget: float  # Highest throttle that keeps the risk within `limit`; NaN when unknown
    budget_reason: str  # What ends it, or why it is not known
    limit: float  # That risk
    # What the risk is of, V and s.
    voltage: float
    horizon: float
    time: float  # Stamp at which the risk is told, s; NaN of a recording too short for a window

    def at(self, throttle: float, name: str) -> float:
        """Return one curve at a throttle, between its points; NaN when unknown."""
        if math.isnan(throttle):
            return NAN
        return float(np.interp(throttle, self.throttle, getattr(self, name)))


def by_throttle(found: Overview, voltage: float, horizon: float) -> ByThrottle:
    """Return what the facts, and the node at the end, say over throttle (V, s)."""
    grid, sag, last = np.array(THROTTLES), found.facts.sag, found.end
    low, high = sag.flown
    middle, reach = np.array(sag.sag_v), Z95 * np.array(sag.se_v)
    if not sag.known:
        middle = np.full(grid.size, NAN)
    risk = np.full(grid.size, NAN)
    if last is not None and last.risk_curve:
        # RISK_CURVE has the same throttles; one beyond the highest, to interpolate.
        risk = np.where(grid < found.highest + 0.1, last.risk_curve, NAN)
    return ByThrottle(
        grid, (grid >= low) & (grid <= high), middle, middle - reach, middle + reach,
        np.array(found.facts.noise.rms_v), risk, NAN if last is None else last.budget,
        'No voltage was asked for.' if last is None else last.budget_reason,
        MonitorSettings().budget_limit, voltage, horizon,
        NAN if last is None else last.estimate.t)
