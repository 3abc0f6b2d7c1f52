"""
First-passage risk: the probability that the supply goes below a voltage within a horizon.

Limits: the continuous path is meant (sampled monitors see fewer passages);
the law of the passage time is taken as exponential with the exact mean, which
is good for rare events and rough when the barrier is within one standard
deviation; the uncertainty of the estimate is not yet carried into the risk.
"""

from __future__ import annotations

import math

from ou_monitor.model.passage import mean_first_passage
from ou_monitor.records import Estimate, NAN


def brownout_probability(e: Estimate, voltage: float, horizon: float,
                         now: float | None = None) -> float:
    """
    Return the probability of going below `voltage` within `horizon`.

    Parameters
    ----------
    e : Estimate
        The estimate; unless it is usable the risk is unknown.
    voltage : float
        Brown-out level, V.
    horizon : float
        Time ahead, s, > 0.
    now : float, optional
        Present voltage, V; the mean level when left out.

    Returns
    -------
    float
        Probability 0..1; NaN when the estimate is not usable and the present
        voltage does not decide; 1 when the present voltage is at or below
        `voltage`.

    Raises
    ------
    ValueError
        When the horizon is not positive or the voltage not finite.

    """
    if not (math.isfinite(horizon) and horizon > 0.0):
        raise ValueError(f'horizon must be a positive number of seconds, got {horizon}')
    if not math.isfinite(voltage):
        raise ValueError(f'brown-out voltage must be finite, got {voltage} V')
    if now is not None and now <= voltage:
        return 1.0
    if not e.usable:
        return NAN
    sd = math.sqrt(e.var_inf)
    barrier = (e.u0 - voltage) / sd
    start = 0.0 if now is None or math.isnan(now) else (e.u0 - now) / sd
    mean = mean_first_passage(start, barrier) / e.alpha
    if mean == 0.0:
        return 1.0
    return -math.expm1(-horizon / mean)
