"""
Drift of a vehicle over its flights.

The test is that of Mann and Kendall: exact for few flights, and it asks for
nothing but that flights without drift come in any order.  The slope is that
of Theil and Sen with its interval.  All tests of the fleet are held to one
family rate by Holm's procedure.

Limits: flights in a row that share a cause (a season, a battery) look like a
drift.  Below a certain number of flights no order of them is rare enough in a
fleet of many tests; `fewest` returns that number.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.fleet.comparison import Values
from ou_monitor.records import FloatArray, NAN

# With fewer flights not even one vehicle alone can reach 5 %: 2/4! is 0.08.
LEAST = 5


@dataclass(frozen=True)
class Trend:
    """
    Trend of one quantity of one vehicle.

    Attributes
    ----------
    quantity, vehicle : str
        Of what.
    flights : int
        How many were used.
    slope, low, high : float
        Change a flight (of the logarithm, or V for sag) and its 95 % interval.
    start : float
        Value of the line at flight 0.
    first, last : int
        Numbers of the first and the last flight used.
    p_value : float
        Of the test alone.
    p_family : float
        After Holm, over all tests of the fleet.

    """

    quantity: str
    vehicle: str
    flights: int
    slope: float
    low: float
    high: float
    start: float
    first: int
    last: int
    p_value: float
    p_family: float = NAN

    def line(self, flight: FloatArray) -> FloatArray:
        """Return the line at some flights."""
        return self.start + self.slope * np.asarray(flight, dtype=np.float64)


def trends(all_values: Sequence[Values]) -> tuple[Trend, ...]:
    """Test every vehicle and quantity with enough flights."""
    found = [trend for values in all_values for trend in _of_values(values)]
    adjusted = holm(np.array([trend.p_value for trend in found]))
    done = [replace(trend, p_family=float(p)) for trend, p in zip(found, adjusted)]
    return tuple(sorted(done, key=lambda t: (t.p_family, t.p_value, t.vehicle, t.quantity)))


def _of_values(values: Values) -> list[Trend]:
    # A second to import, and the workers do not need it.
    from scipy import stats

    found = []
    names = np.array(values.vehicles, dtype=str)
    for name in sorted(set(values.vehicles) - {''}):
        mine = np.flatnonzero((names == name) & (values.flights > 0))
        if mine.size < LEAST:
            continue
        mine = mine[np.argsort(values.flights[mine])]
        x, y = values.flights[mine].astype(np.float64), values.value[mine]
        p_value = float(stats.kendalltau(x, y).pvalue)
        slope, start, low, high = (float(v) for v in stats.theilslopes(
            y, x, 0.95, method='joint'))
        found.append(Trend(values.name, name, int(mine.size), slope, low, high, start,
                           int(x[0]), int(x[-1]),
                           # All values equal: no order, no drift.
                           p_value if math.isfinite(p_value) else 1.0))
    return found


def holm(p_values: FloatArray) -> FloatArray:
    """Return p-values adjusted for all tests together (Holm 1979)."""
    m = p_values.size
    order = np.argsort(p_values, kind='stable')
    raised = np.maximum.accumulate((m - np.arange(m)) * p_values[order]) if m else p_values
    adjusted = np.empty(m)
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted


def fewest(tests: int, rate: float) -> int:
    """Return the flights below which no drift can be significant among some tests."""
    n = LEAST
    while 2.0 / math.factorial(n) > rate / max(tests, 1):
        n += 1
    return n
