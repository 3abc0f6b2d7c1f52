"""
The fleet table -> what stands out: drifting vehicles, recordings and vehicles that are off.

Drift: the test is that of Mann and Kendall: exact for few flights, and it asks for
nothing but that flights without drift come in any order.  The slope is that
of Theil and Sen with its interval.  All tests of the fleet are held to one
family rate by Holm's procedure.

Outliers: a value deviates by its distance from the median of its group (or from the
line that its group drifts along), over sqrt(s^2 + se^2): se is its standard
error, and s the scatter between recordings that makes the median of these
ratios that of a normal law (as a median absolute deviation).  The bound is
where the largest ratio of the whole fleet lies when nothing is wrong, by
simulation of fleets of the same groups and errors, estimated in the same way
(with s at its upper 90 % bound, so that the rate is rather below than above).

Limits of drift: flights in a row that share a cause (a season, a battery) look like a
drift.  Below a certain number of flights no order of them is rare enough in a
fleet of many tests; `fewest` returns that number.

Limits of outliers: the scatter between good recordings is taken to be normal and of one
size on every vehicle.  Where its tails are heavier there are more alarms than
stated; where a large part of a group is off, its median follows.  A median of
few deviations is vague, so the bound of few is wide: doc/fleet.md has it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.fleet.comparison import QUANTITIES, Row, Values, values_of
from ou_monitor.records import FloatArray, NAN

# With fewer flights not even one vehicle alone can reach 5 %: 2/4! is 0.08.
LEAST_FLIGHTS = 5


@dataclass(frozen=True)
class Trend:
    """Trend of one quantity of one vehicle."""

    # Of what.
    quantity: str
    vehicle: str
    flights: int  # How many were used
    # Change a flight (of the logarithm, or V for sag) and its 95 % interval.
    slope: float
    low: float
    high: float
    start: float  # Value of the line at flight 0
    # Numbers of the first and the last flight used.
    first: int
    last: int
    p_value: float  # Of the test alone
    p_family: float = NAN  # After Holm, over all tests of the fleet

    def line(self, flight: FloatArray) -> FloatArray:
        """Return the line at some flights."""
        return self.start + self.slope * np.asarray(flight, dtype=np.float64)


def trends(all_values: Sequence[Values]) -> tuple[Trend, ...]:
    """Test every vehicle and quantity with enough flights."""
    from ou_monitor.analysis.level_tests import adjusted
    found = [trend for values in all_values for trend in _of_values(values)]
    done = [replace(trend, p_family=p) for trend, p in zip(
        found, adjusted([trend.p_value for trend in found]))]
    return tuple(sorted(done, key=lambda t: (t.p_family, t.p_value, t.vehicle, t.quantity)))


def _of_values(values: Values) -> list[Trend]:
    # A second to import, and the workers do not need it.
    from scipy import stats

    found = []
    names = np.array(values.vehicles, dtype=str)
    for name in sorted(set(values.vehicles) - {''}):
        mine = np.flatnonzero((names == name) & (values.flights > 0))
        if mine.size < LEAST_FLIGHTS:
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


def fewest(tests: int, rate: float) -> int:
    """Return the flights below which no drift can be significant among some tests."""
    n = LEAST_FLIGHTS
    while 2.0 / math.factorial(n) > rate / max(tests, 1):
        n += 1
    return n


# The median of |z| of a normal law.
_MEDIAN = 0.6744897501960817
# A group of fewer says nothing about which of its members is off.
LEAST = 4
SIMULATIONS = 4000
# Cells of the arrays that are simulated at once; bounds memory.
_CELLS = 2_000_000
# One-sided bound of 90 % in standard deviations of a normal law.
_UPPER = 1.2815515655446004


@dataclass(frozen=True, eq=False)
class Outliers:
    """How far each value is off."""

    # Distance from the group in standard deviations; NaN where the group is too small; shape (n,).
    score: FloatArray
    # Chance that any value of a fleet with nothing wrong is as far off; NaN where there is no
    # score; shape (n,).
    chance: FloatArray
    centre: FloatArray  # What each was compared with; shape (n,)
    # Standard deviation between recordings of one group, beside their errors; NaN when unknown.
    scatter: float
    bound: float  # Score that is reached with chance `rate` in a fleet with nothing wrong
    rate: float  # That chance

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Which values are outliers; shape (n,)."""
        beyond: npt.NDArray[np.bool_] = np.abs(np.nan_to_num(self.score)) > self.bound
        return beyond


def outliers(value: FloatArray, error: FloatArray, groups: Sequence[str], rate: float,
             trend: FloatArray | None = None, *, least: int = LEAST, seed: int = 0,
             simulations: int = SIMULATIONS) -> Outliers:
    """Find the values that are off (rate 0..1)."""
    n = value.size
    names, of = np.unique(np.asarray(groups, dtype=str), return_inverse=True)
    count = np.bincount(of, minlength=names.size)
    good = (count[of] >= least) & (np.asarray(groups, dtype=str) != '') if n else np.zeros(0, bool)
    flat = value if trend is None else value - trend
    score, chance, centre = (np.full(n, np.nan) for _ in range(3))
    if not good.any():
        return Outliers(score, chance, centre, float('nan'), float('inf'), rate)
    members = [np.flatnonzero(of[good] == g) for g in np.unique(of[good])]
    se = error[good]
    rest, middle = _centred(flat[good][None, :], members)
    scatter = _scatter(rest, se)
    score[good] = (rest / _spread(scatter, se))[0]
    centre[good] = middle[0] + (0.0 if trend is None else trend[good])
    rng = np.random.default_rng(seed)
    size = max(1, min(simulations, _CELLS // se.size))
    # Where errors are as large as s, s may come out as zero, and the scores of the best recordings
    # too large: fleets are simulated with the largest s that the data allow.
    share = min(0.5 + 0.5 * _UPPER / math.sqrt(se.size), 0.95)
    most = float(_scatter(rest, se, share)[0, 0])
    largest: list[FloatArray] = []
    while sum(part.size for part in largest) < simulations:
        drawn = rng.standard_normal((size, se.size)) * np.hypot(most, se)
        inner, _ = _centred(drawn, members)
        largest.append(np.abs(inner / _spread(_scatter(inner, se), se)).max(axis=1))
    worst = np.sort(np.concatenate(largest)[:simulations])
    over = simulations - np.searchsorted(worst, np.abs(score[good]), side='left')
    chance[good] = (1.0 + over) / (1.0 + simulations)
    bound = float(np.quantile(worst, 1.0 - rate))
    return Outliers(score, chance, centre, float(scatter[0, 0]), bound, rate)


def _centred(value: FloatArray, members: Sequence[npt.NDArray[np.intp]]
             ) -> tuple[FloatArray, FloatArray]:
    """Return rows without the medians of their groups, and the medians; shape (k, n)."""
    middle = np.empty_like(value)
    wide = np.empty(value.shape[1])
    for index in members:
        middle[:, index] = np.median(value[:, index], axis=1, keepdims=True)
        # A value pulls its own median towards it; of a mean it would be exactly this much.
        wide[index] = np.sqrt(1.0 - 1.0 / index.size)
    return (value - middle) / wide, middle


def _spread(scatter: FloatArray, error: FloatArray) -> FloatArray:
    """Return sqrt(s^2 + se^2), above zero; shape (k, n)."""
    return np.maximum(np.hypot(scatter, error[None, :]), 1e-300)


def _scatter(rest: FloatArray, error: FloatArray, share: float = 0.5) -> FloatArray:
    """
    Return s of each row; shape (k, 1).

    The median of |rest| / sqrt(s^2 + se^2) is that of a normal law, `_MEDIAN`,
    where s^2 is the median of rest^2 / `_MEDIAN`^2 - se^2.  A `share` above one
    half gives an upper bound: the median of n values lies below their quantile
    of share 0.5 + z / (2 sqrt(n)) as often as a normal value below z.
    """
    excess = (rest / _MEDIAN) ** 2 - error[None, :] ** 2
    return np.sqrt(np.maximum(np.quantile(excess, share, axis=1)[:, None], 0.0))


# Chance of any false drift in a fleet with nothing wrong, and of any false outlier.
DRIFT_RATE = 0.05
OUTLIER_RATE = 0.05
# Fewer vehicles do not tell which of them is off.
LEAST_VEHICLES = 6
# Standard error of a median over that of a mean, of many normal values.
_MEDIAN_ERROR = 1.2533141373155


@dataclass(frozen=True, eq=False)
class VehicleValues:
    """One quantity of every vehicle: the medians of its recordings."""

    names: tuple[str, ...]  # Vehicles
    # Medians on the scale of `Values.value`, and their standard errors; shape (v,).
    value: FloatArray
    error: FloatArray
    outliers: Outliers  # How far each is off the fleet


@dataclass(frozen=True, eq=False)
class Judgement:
    """What stands out in a fleet."""

    values: dict[str, Values]  # Quantity -> recordings
    trends: tuple[Trend, ...]  # All that were tested, least likely first
    recordings: dict[str, Outliers]  # Quantity -> each recording beside those of its vehicle
    vehicles: dict[str, VehicleValues]  # Quantity -> each vehicle beside the others
    # Chance of any false alarm in one of these comparisons, such that it is `OUTLIER_RATE` in all
    # together.
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
