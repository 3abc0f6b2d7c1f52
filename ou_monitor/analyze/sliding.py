"""What the node would have published while this recording was made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.risk.outlook import Outlook
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import Estimate, FloatArray, NAN, Recording

MAX_POINTS = 300
# The node estimates at least so often, s; here, up to so many times in all.
_STEP, _MOST = 0.5, 1200


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

    """

    window: float
    t: FloatArray
    estimates: tuple[Estimate, ...]
    risk: FloatArray
    brownout_voltage: float
    brownout_horizon: float
    outlook: Outlook
    settings: MonitorSettings

    def series(self, name: str) -> FloatArray:
        """Return one field of the estimates as an array."""
        return np.array([getattr(e, name) for e in self.estimates], dtype=np.float64)

    @property
    def last_usable(self) -> Estimate | None:
        """Return the newest estimate that may be acted on; None when there is none."""
        return next((e for e in reversed(self.estimates) if e.usable), None)


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
    settings = MonitorSettings(brownout_horizon=brownout_horizon)
    if asked:
        settings = replace(settings, brownout_voltage=brownout_voltage)
    estimator, outlook = SlidingEstimator(window=window), Outlook(background=False)
    t, voltage, throttle = recording.t, recording.voltage, recording.throttle
    known = recording.has_throttle
    stamps, estimates, risk = [], [], []
    step = max(0.25 * window, recording.duration / MAX_POINTS)
    # In between, estimates are for the curves alone, which follow the newest.
    parts = max(1, min(math.ceil(step / _STEP), _MOST // MAX_POINTS))
    first = float(t[0]) if t.size else 0.0
    count = int(recording.duration / step) * parts
    done = 0
    newest = Estimate()
    for k in range(1, count + 1):
        stop = int(np.searchsorted(t, first + k * step / parts, side='right'))
        if stop == done:
            continue
        stick = throttle[done:stop] if known else None
        estimator.push(t[done:stop], voltage[done:stop], stick)
        # As in `SupplyMonitor`: samples are learned from with the estimate before them.
        outlook.push(t[done:stop], voltage[done:stop], stick, newest)
        done = stop
        # Until the first window is full its estimates would only look poor.
        filling = t[stop - 1] - first < min(window, 0.5 * recording.duration)
        newest = estimator.estimate()
        if filling or k % parts:
            continue
        stamps.append(float(t[stop - 1]))
        estimates.append(newest)
        risk.append(outlook.risk(newest, settings) if asked else NAN)
        if progress is not None:
            progress(k / count)
    if done < t.size and estimates:
        outlook.push(t[done:], voltage[done:], throttle[done:] if known else None, newest)
    return Sliding(window, np.array(stamps), tuple(estimates), np.array(risk),
                   brownout_voltage, brownout_horizon, outlook, settings)
