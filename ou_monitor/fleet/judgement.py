"""The fleet table -> what stands out: drifting vehicles, recordings and vehicles that are off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from ou_monitor.fleet.comparison import QUANTITIES, Row, Values, values_of
from ou_monitor.fleet.drift import Trend, trends
from ou_monitor.fleet.outliers import Outliers, outliers
from ou_monitor.records import FloatArray

# Chance of any false drift in a fleet with nothing wrong, and of any false outlier.
DRIFT_RATE = 0.05
OUTLIER_RATE = 0.05
# Fewer vehicles do not tell which of them is off.
LEAST_VEHICLES = 6
# Standard error of a median over that of a mean, of many normal values.
_MEDIAN_ERROR = 1.2533141373155


@dataclass(frozen=True, eq=False)
class VehicleValues:
    """
    One quantity of every vehicle: the medians of its recordings.

    Attributes
    ----------
    names : tuple of str
        Vehicles.
    value, error : ndarray, shape (v,)
        Medians on the scale of `Values.value`, and their standard errors.
    outliers : Outliers
        How far each is off the fleet.

    """

    names: tuple[str, ...]
    value: FloatArray
    error: FloatArray
    outliers: Outliers


@dataclass(frozen=True, eq=False)
class Judgement:
    """
    What stands out in a fleet.

    Attributes
    ----------
    values : dict of str to Values
        Quantity -> recordings.
    trends : tuple of Trend
        All that were tested, least likely first.
    recordings : dict of str to Outliers
        Quantity -> each recording beside those of its vehicle.
    vehicles : dict of str to VehicleValues
        Quantity -> each vehicle beside the others.
    rate : float
        Chance of any false alarm in one of these comparisons, such that it is
        `OUTLIER_RATE` in all together.

    """

    values: dict[str, Values]
    trends: tuple[Trend, ...]
    recordings: dict[str, Outliers]
    vehicles: dict[str, VehicleValues]
    rate: float

    @property
    def drifting(self) -> tuple[Trend, ...]:
        """Return the trends that stand at the family rate."""
        return tuple(t for t in self.trends if t.p_family <= DRIFT_RATE)

    def odd_recordings(self) -> list[tuple[str, int]]:
        """Return (quantity, index) of the recordings that are off, furthest first."""
        found = [(name, int(k)) for name, o in self.recordings.items()
                 for k in np.flatnonzero(o.found)]
        return sorted(found, key=lambda f: -abs(float(self.recordings[f[0]].score[f[1]])))

    def odd_vehicles(self) -> list[tuple[str, int]]:
        """Return (quantity, index) of the vehicles that are off, furthest first."""
        found = [(name, int(k)) for name, v in self.vehicles.items()
                 for k in np.flatnonzero(v.outliers.found)]
        return sorted(found, key=lambda f: -abs(float(
            self.vehicles[f[0]].outliers.score[f[1]])))


def judge(rows: Sequence[Row], seed: int = 0) -> Judgement:
    """Say what stands out."""
    values = {name: values_of(rows, name) for name in QUANTITIES}
    tested = trends(tuple(values.values()))
    # Each quantity is compared twice: recordings within vehicles, and vehicles.
    rate = OUTLIER_RATE / (2 * len(QUANTITIES))
    drifting = [t for t in tested if t.p_family <= DRIFT_RATE]
    recordings, vehicles = {}, {}
    for name, one in values.items():
        trend = np.zeros(one.value.size)
        for t in drifting:
            if t.quantity == name:
                mine = _of(one, t.vehicle) & (one.flights > 0)
                trend[mine] = t.line(one.flights[mine].astype(np.float64)) - t.line(np.array(
                    0.5 * (t.first + t.last)))
        recordings[name] = outliers(one.value, one.error, one.vehicles, rate, trend, seed=seed)
        vehicles[name] = _vehicles(one, recordings[name], rate, seed)
    return Judgement(values, tested, recordings, vehicles, rate)


def _of(values: Values, vehicle: str) -> npt.NDArray[np.bool_]:
    mine: npt.NDArray[np.bool_] = np.array(values.vehicles, dtype=str) == vehicle
    return mine


def _vehicles(values: Values, within: Outliers, rate: float, seed: int) -> VehicleValues:
    """Return the vehicles beside each other."""
    names = tuple(sorted(set(values.vehicles) - {''}))
    scatter = float(np.nan_to_num(within.scatter))
    value, error = np.zeros(len(names)), np.zeros(len(names))
    for k, name in enumerate(names):
        mine = _of(values, name)
        value[k] = np.median(values.value[mine])
        one = np.sqrt(np.mean(scatter ** 2 + values.error[mine] ** 2) / mine.sum())
        # The median of two is their mean.
        error[k] = one * (_MEDIAN_ERROR if mine.sum() > 2 else 1.0)
    return VehicleValues(names, value, error, outliers(
        value, error, ['fleet'] * len(names), rate, least=LEAST_VEHICLES, seed=seed))
