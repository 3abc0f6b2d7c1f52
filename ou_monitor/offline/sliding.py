"""What the node would have published while this recording was made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np

from ou_monitor.online.estimator import SlidingEstimator
from ou_monitor.online.risk import brownout_probability
from ou_monitor.records import Estimate, FloatArray, NAN, Recording

MAX_POINTS = 300


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

    """

    window: float
    t: FloatArray
    estimates: tuple[Estimate, ...]
    risk: FloatArray
    brownout_voltage: float
    brownout_horizon: float

    def series(self, name: str) -> FloatArray:
        """
        Return one field of the estimates as an array.

        Parameters
        ----------
        name : str
            Field of `Estimate`.

        Returns
        -------
        ndarray, shape (k,)
            NaN where it is unknown.

        """
        return np.array([getattr(e, name) for e in self.estimates], dtype=np.float64)


def slide(recording: Recording, window: float, brownout_voltage: float = NAN,
          brownout_horizon: float = 5.0,
          progress: Callable[[float], None] | None = None) -> Sliding:
    """
    Run the node's estimator over a recording.

    Parameters
    ----------
    recording : Recording
        What to run over.
    window : float
        Length of the window, s, > 0.
    brownout_voltage : float
        Threshold of the risk, V; NaN leaves the risk unknown.
    brownout_horizon : float
        Horizon of the risk, s, > 0.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Sliding
        At most `MAX_POINTS` estimates, at least a quarter of a window apart.

    Raises
    ------
    ValueError
        When the window or the horizon is not a positive number.

    """
    if not (math.isfinite(brownout_horizon) and brownout_horizon > 0.0):
        raise ValueError(f'the horizon must be a positive number of seconds, got '
                         f'{brownout_horizon}')
    estimator = SlidingEstimator(window=window)
    t, voltage, throttle = recording.t, recording.voltage, recording.throttle
    known = recording.has_throttle
    stamps, estimates, risk = [], [], []
    step = max(0.25 * window, recording.duration / MAX_POINTS)
    first = float(t[0]) if t.size else 0.0
    count = int(recording.duration / step)
    done = 0
    for k in range(1, count + 1):
        stop = int(np.searchsorted(t, first + k * step, side='right'))
        if stop == done:
            continue
        estimator.push(t[done:stop], voltage[done:stop], throttle[done:stop] if known else None)
        done = stop
        # Until the first window is full its estimates would only look poor.
        if t[stop - 1] - first < min(window, 0.5 * recording.duration):
            continue
        e = estimator.estimate()
        stamps.append(float(t[stop - 1]))
        estimates.append(e)
        risk.append(brownout_probability(e, brownout_voltage, brownout_horizon,
                                         float(voltage[stop - 1]))
                    if math.isfinite(brownout_voltage) else NAN)
        if progress is not None:
            progress(k / count)
    return Sliding(window, np.array(stamps), tuple(estimates), np.array(risk),
                   brownout_voltage, brownout_horizon)
