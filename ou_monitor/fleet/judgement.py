"""
The fleet table -> drifting vehicles, and outliers among recordings and vehicles.

doc/fleet.md states the tests, their false-alarm rates and their limits.  This module computes
them as follows.

Common throttle: the logarithms of sigma and alpha follow one curve over throttle for all vehicles
(straight between knots, fitted by Huber's estimate, with an offset for each vehicle).  Values are
moved along the curve to the median throttle, which adds an error; values without throttle are not
moved.  Resistance and sag come from the `supply` facts, per cell where cells are known.

Outliers: the score of a value is its distance from the median (or the drift line) of its group
divided by sqrt(s^2 + se^2).  se is the standard error of the value, s the scatter between
recordings (a median absolute deviation).  The bound is a quantile of the largest score in
simulated fleets without faults.  They are simulated with the upper 90 % bound of s, which gives
too few false alarms rather than too many.  If many members of a group are off, so is its median.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.level_tests import adjusted
from ou_monitor.online.load.current_filter import LEAST_ERROR
from ou_monitor.records import FloatArray, NAN
from scipy import stats

Row = Mapping[str, Any]
IntArray = npt.NDArray[np.intp]
USABLE = ('OK', 'SHORT_WINDOW')
# Quantities compared, on the log scale -> unit; the first two are per cell where cells are known,
# the others are measured at several levels of throttle.
QUANTITIES = {'resistance': 'Ohm', 'sag': 'V', 'sigma': 'V/sqrt(s)', 'alpha': '1/s'}
OF_PACK = {'resistance': ('resistance', 'resistance_se', 'resistance', ''),
           'sag': ('sag_full', 'sag_full_se', 'sag', 'sag_throttle')}
# Maximum relative error of a pack's value; with a larger error the value is unknown.
_VAGUE = 0.5
# Bend of Huber's function, in standard deviations (95 % efficiency); maximum rounds of the fit.
_HUBER = 1.345
_ROUNDS = 30
# Maximum pieces of the curve, minimum rows for each, and minimum distance (throttle) of its knots.
_PIECES, _ROWS, _APART = 8, 12, 0.03


@dataclass(frozen=True)
class CommonCurve:
    """The common curve over throttle of the logarithm of a quantity: straight between knots."""

    reference: float  # Throttle at which recordings are compared; NaN without throttle
    # Throttles of the knots, and the curve there minus its value at the reference; empty: flat.
    knots: tuple[float, ...] = ()
    heights: tuple[float, ...] = ()
    # Covariance of the slopes between k knots, for independent recordings; shape (k - 1, k - 1).
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __call__(self, throttle: FloatArray) -> FloatArray:
        """Return the difference from the logarithm at the reference throttle; 0 where unknown."""
        u = np.asarray(throttle, dtype=np.float64)
        if not self.knots:
            return np.zeros(u.shape)
        rise: FloatArray = np.nan_to_num(np.interp(u, self.knots, self.heights))
        return rise


@dataclass(frozen=True, eq=False)
class Values:
    """One quantity of every recording that has it."""

    name: str
    paths: tuple[str, ...]  # Recordings
    vehicles: tuple[str, ...]  # Vehicle of each; empty where unknown
    flights: IntArray  # Number of the flight; 0 where unknown; shape (n,)
    # Logarithm at the reference throttle (sag: at full throttle), and its standard error, which
    # includes the error of the move; shape (n,).
    value: FloatArray
    error: FloatArray
    curve: CommonCurve  # Curve that was subtracted
    # Values as measured, in the unit of the quantity (geometric means weighted by time), and the
    # mean throttle at which they were measured, NaN where unknown; shape (n,).
    measured: FloatArray
    throttle: FloatArray
    cells: IntArray  # Number of cells that each value is divided by; 0: not divided; shape (n,)
    months: FloatArray  # Dates, months since 1970; NaN where unknown; shape (n,)

    def of(self, vehicle: str) -> npt.NDArray[np.bool_]:
        """Return which values are of a vehicle, shape (n,)."""
        return np.asarray(np.array(self.vehicles, dtype=str) == vehicle)


def values_of(rows: Sequence[Row], name: str) -> Values:
    """Return one quantity of every recording."""
    if name in OF_PACK:
        whole_of, se_of, shown, at = OF_PACK[name]
        once = list({row['path']: row for row in rows if row[whole_of] is not None
                     and row[whole_of] > 0.0 and row[se_of] < _VAGUE * row[whole_of]}.values())
        cells = np.array([row['cells'] or 0 for row in once], dtype=np.intp)
        whole, se, seen = (np.array([_number(row[column]) for row in once]) / np.maximum(cells, 1)
                           for column in (whole_of, se_of, shown))
        return _values(name, once, CommonCurve(NAN), np.log(whole), se / whole, seen, np.array([
            _number(row[at]) if at else NAN for row in once]), cells)
    good = [row for row in rows if row['status'] in USABLE and row[name] is not None]
    y = np.log(np.array([row[name] for row in good], dtype=np.float64))
    u = np.array([_number(row['throttle']) for row in good])
    by_path: dict[str, list[int]] = {}
    for k, row in enumerate(good):
        by_path.setdefault(row['path'], []).append(k)
    of = np.zeros(len(good), dtype=np.intp)
    for number, ks in enumerate(by_path.values()):
        of[ks] = number
    curve = _curve(y, u, [row['vehicle'] or '' for row in good], of)
    level = y - curve(u)
    # Derivative of the curve with respect to each slope, shape (n, k - 1).
    pieces = _pieces(np.where(np.isfinite(u), u, curve.reference), curve.knots)
    found, place = [], []
    for ks in by_path.values():
        weight = np.array([_number(good[k]['time_s']) for k in ks])
        weight = weight / weight.sum() if weight.sum() > 0.0 else np.full(len(ks), 1.0 / len(ks))
        se = np.nan_to_num([_number(good[k][name + '_se']) for k in ks])
        found.append((float(weight @ level[ks]), float(np.sqrt(weight ** 2 @ se ** 2)),
                      math.exp(float(weight @ y[ks])), float(weight @ u[ks])))
        place.append(weight @ pieces[ks])
    value, error, measured, throttle = np.array(found).reshape(-1, 4).T
    return _values(name, [good[ks[0]] for ks in by_path.values()], curve, value,
                   np.hypot(error, _move_error(np.array(place), curve)), measured, throttle)


def _move_error(place: FloatArray, curve: CommonCurve) -> FloatArray:
    """Return the error of moving each recording to the common throttle."""
    if not curve.knots or not place.size:
        return np.zeros(len(place))
    # A move common to all recordings cancels in the comparison.
    move = place - np.median(place, axis=0)
    variance = np.einsum('ki,ij,kj->k', move, curve.covariance, move)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _number(value: Any) -> float:
    return NAN if value is None else float(value)


def _values(name: str, rows: Sequence[Row], curve: CommonCurve, value: FloatArray,
            error: FloatArray, measured: FloatArray, throttle: FloatArray,
            cells: IntArray | None = None) -> Values:
    return Values(name, tuple(row['path'] for row in rows),
                  tuple(row['vehicle'] or '' for row in rows),
                  np.array([row['flight'] or 0 for row in rows], dtype=np.intp),
                  np.asarray(value, dtype=np.float64),
                  np.nan_to_num(np.asarray(error, dtype=np.float64)), curve, measured, throttle,
                  np.zeros(len(rows), dtype=np.intp) if cells is None else cells,
                  np.array([row['start'].timestamp() / _MONTH if row['start'] else NAN
                            for row in rows]))


def _pieces(u: FloatArray, knots: Sequence[float]) -> FloatArray:
    """Return how much of each span between knots lies below u, shape (n, k - 1)."""
    columns = [np.clip(u - low, 0.0, high - low) for low, high in zip(knots, knots[1:])]
    return np.column_stack(columns) if columns else np.zeros((u.size, 0))


def _curve(y: FloatArray, u: FloatArray, vehicles: Sequence[str], recordings: IntArray
           ) -> CommonCurve:
    """Return the common curve of load levels (y: logarithms, u: throttle); flat if u is steady."""
    known = np.isfinite(u)
    if not known.any():
        return CommonCurve(NAN)
    u, y = u[known], y[known]
    reference = float(np.median(u))
    knots = _knots(u)
    names = sorted(set(vehicles))
    of = np.array([names.index(v) for v in vehicles])[known]
    basis = _pieces(u, knots)
    parts = basis.shape[1]
    if not parts or y.size <= len(names) + parts:
        return CommonCurve(reference)
    weight = np.ones(y.size)
    slopes = np.zeros(parts)
    inner, rest = np.zeros((y.size, parts + 1)), y
    for _ in range(_ROUNDS):
        # Centring removes each vehicle's offset; a vehicle without known throttle has count 0.
        count = np.maximum(np.bincount(of, weight, len(names)), 1e-300)
        inner = np.column_stack([
            column - (np.bincount(of, weight * column, len(names)) / count)[of]
            for column in (*basis.T, y)])
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * inner[:, :-1], root[:, 0] * inner[:, -1], rcond=1e-9)[0]
        rest = inner[:, -1] - inner[:, :-1] @ found
        scale = float(np.median(np.abs(rest))) / 0.6745
        settled = np.allclose(found, slopes, rtol=1e-10, atol=1e-12) or not scale > 0.0
        slopes = found
        if settled:
            break
        weight = np.minimum(1.0, _HUBER * scale / np.maximum(np.abs(rest), 1e-300))
    heights = np.concatenate(([0.0], np.cumsum(slopes * np.diff(knots))))
    heights -= np.interp(reference, knots, heights)
    if not np.isfinite(heights).all():
        return CommonCurve(reference)
    covariance = _jackknife(inner[:, :-1], rest, weight, recordings[known], of)
    return CommonCurve(reference, tuple(knots), tuple(heights.tolist()), covariance)


def _jackknife(inner: FloatArray, rest: FloatArray, weight: FloatArray, of: IntArray,
               vehicle: IntArray) -> FloatArray:
    """Return the covariance of slopes by leaving out one recording (`of`) at a time."""
    # Residuals within a recording are correlated, so whole recordings are left out.
    # Derivative of Huber's function: 0 beyond its bend.
    pulls = (weight >= 1.0).astype(np.float64)
    bread = np.linalg.pinv((inner * pulls[:, None]).T @ inner, rcond=1e-9)
    count = np.maximum(np.bincount(vehicle, pulls), 1.0)
    found = np.zeros(bread.shape)
    recordings = np.unique(of)
    for one in recordings:
        mine = of == one
        x = inner[mine]
        hat = x @ bread @ x.T + 1.0 / count[vehicle[mine]][:, None]
        left = np.linalg.pinv(np.eye(len(x)) - hat * pulls[mine], rcond=1e-9)
        step = bread @ x.T @ (left @ (weight * rest)[mine])
        found += np.outer(step, step)
    found *= 1.0 - 1.0 / len(recordings)
    return found


def _knots(u: FloatArray) -> list[float]:
    """Return increasing knots at even quantiles of throttle, not too close to each other."""
    pieces = min(max(u.size // _ROWS, 1), _PIECES)
    wanted = np.quantile(u, np.linspace(0.0, 1.0, pieces + 1)).tolist()
    knots: list[float] = wanted[:1]
    for knot in wanted[1:]:
        if knot - knots[-1] >= _APART:
            knots.append(knot)
    # The last knot is the highest throttle, so that the curve does not flatten before it.
    if len(knots) > 1:
        knots[-1] = wanted[-1]
    return knots


# Minimum number of flights to test for drift: the line through two flights leaves no scatter.
LEAST_FLIGHTS = 3
_MONTH = 365.25 / 12.0 * 86400.0  # A mean month, s


@dataclass(frozen=True)
class Trend:
    """Trend of one quantity of one vehicle."""

    quantity: str
    vehicle: str
    flights: int  # Number of flights used
    # Change of the logarithm per flight, and its 95 % interval.
    slope: float
    low: float
    high: float
    start: float  # Value of the line at flight 0
    # Numbers of the first and the last flight used.
    first: int
    last: int
    p_value: float  # Of this test alone
    # Change of the logarithm per month, and its 95 % interval; NaN if a date is unknown, or if all
    # flights are within one month.
    monthly: tuple[float, float, float] = (NAN, NAN, NAN)
    p_family: float = NAN  # After Holm, over all tests of the fleet

    def line(self, flight: FloatArray) -> FloatArray:
        """Return the line at some flights."""
        return self.start + self.slope * np.asarray(flight, dtype=np.float64)


def trends(all_values: Sequence[Values]) -> tuple[Trend, ...]:
    """Test every vehicle and quantity with enough flights."""
    found = [trend for values in all_values for trend in _trends_of(values)]
    done = [replace(trend, p_family=p) for trend, p in zip(
        found, adjusted([trend.p_value for trend in found]))]
    return tuple(sorted(done, key=lambda t: (t.p_family, t.p_value, t.vehicle, t.quantity)))


def _trends_of(values: Values) -> list[Trend]:
    found = []
    for name in sorted(set(values.vehicles) - {''}):
        mine = np.flatnonzero(values.of(name) & (values.flights > 0))
        if mine.size < LEAST_FLIGHTS:
            continue
        mine = mine[np.argsort(values.flights[mine])]
        x, y = values.flights[mine].astype(np.float64), values.value[mine]
        slope, start, se = weighted_line(x, y, values.error[mine])
        width = float(stats.t.ppf(0.975, mine.size - 2))
        reach, monthly, months = width * se, (NAN, NAN, NAN), values.months[mine]
        if np.ptp(months) >= 1.0:
            rate, _, rate_se = weighted_line(months - months[0], y, values.error[mine])
            monthly = (rate, rate - width * rate_se, rate + width * rate_se)
        # Equal values would give 0 / 0.
        p_value = 2.0 * float(stats.t.sf(abs(slope) / se, mine.size - 2)) if se > 0.0 else 1.0
        found.append(Trend(values.name, name, int(mine.size), slope, slope - reach, slope + reach,
                           start, int(x[0]), int(x[-1]), p_value, monthly))
    return found


def weighted_line(x: FloatArray, y: FloatArray, error: FloatArray) -> tuple[float, float, float]:
    """Return slope and start of a weighted line, and the standard error of the slope."""
    # The weights are 1 / (error^2 + s^2), with the scatter s that explains the residuals (0 if the
    # errors alone do). The residuals give the scale of the error, with n - 2 degrees of freedom.
    variance = error ** 2

    def fit(scatter: float) -> tuple[float, float, float, float]:
        weight = 1.0 / np.maximum(variance + scatter, 1e-24)
        middle, level = (float(np.average(values, weights=weight)) for values in (x, y))
        spread = float(weight @ (x - middle) ** 2)
        slope = float(weight @ ((x - middle) * (y - level))) / spread
        start = level - slope * middle
        return slope, start, float(weight @ (y - start - slope * x) ** 2) / (x.size - 2), spread

    low, high = 0.0, max(float(np.ptp(y)) ** 2, 1e-24)
    # The scale falls as the scatter grows; 60 halvings exhaust a double's precision.
    for _ in range(60 if fit(0.0)[2] > 1.0 else 0):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fit(middle)[2] > 1.0 else (low, middle)
    slope, start, scale, spread = fit(low)
    return slope, start, math.sqrt(scale / spread)


# The median of |z| of a normal distribution.
_MEDIAN = 0.6744897501960817
# Minimum size of a group: in a smaller one, any member may be the outlier.
LEAST = 4
SIMULATIONS = 4000  # Simulated fleets
# Maximum number of values simulated at once; limits memory.
_CELLS = 2_000_000
# One-sided 90 % bound of a normal distribution, in standard deviations.
_UPPER = 1.2815515655446004


@dataclass(frozen=True, eq=False)
class Outliers:
    """Distance of each value from its group."""

    # Distance from the group in standard deviations; NaN where the group is too small; shape (n,).
    score: FloatArray
    # Probability that a fleet without faults has a score as large; NaN without one; shape (n,).
    chance: FloatArray
    centre: FloatArray  # Value that each was compared with; shape (n,)
    # Standard deviation between recordings of one group, without their errors; NaN if unknown.
    scatter: float
    rate: float  # Probability of any false alarm
    reach: FloatArray | None = None  # Half the 95 % interval of the distance, if known; shape (n,)

    @property
    def found(self) -> npt.NDArray[np.bool_]:
        """Return which values are outliers, shape (n,)."""
        return np.nan_to_num(self.chance, nan=1.0) <= self.rate

    @property
    def compared(self) -> bool:
        """Return whether any value was compared."""
        return bool(np.isfinite(self.chance).any())


def outliers(value: FloatArray, error: FloatArray, groups: Sequence[str], rate: float,
             trend: FloatArray | None = None, *, least: int = LEAST, seed: int = 0,
             simulations: int = SIMULATIONS) -> Outliers:
    """Find the outlying values (rate 0..1)."""
    n = value.size
    names, of = np.unique(np.asarray(groups, dtype=str), return_inverse=True)
    count = np.bincount(of, minlength=names.size)
    good = (count[of] >= least) & (np.asarray(groups, dtype=str) != '') if n else np.zeros(0, bool)
    flat = value if trend is None else value - trend
    score, chance, centre = (np.full(n, np.nan) for _ in range(3))
    if not good.any():
        return Outliers(score, chance, centre, NAN, rate)
    members = [np.flatnonzero(of[good] == g) for g in np.unique(of[good])]
    se = error[good]
    rest, middle = _centred(flat[good][None, :], members)
    scatter = _scatter(rest, se)
    score[good] = (rest / _spread(scatter, se))[0]
    centre[good] = middle[0] + (0.0 if trend is None else trend[good])
    rng = np.random.default_rng(seed)
    size = max(1, min(simulations, _CELLS // se.size))
    # If errors are as large as s, s may be estimated as 0, and scores are then too large: simulate
    # with the upper bound of s.
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
    return Outliers(score, chance, centre, float(scatter[0, 0]), rate)


def _centred(value: FloatArray, members: Sequence[npt.NDArray[np.intp]]
             ) -> tuple[FloatArray, FloatArray]:
    """Return values (k, n) less the medians of their groups, scaled, and the medians."""
    middle = np.empty_like(value)
    wide = np.empty(value.shape[1])
    for index in members:
        middle[:, index] = np.median(value[:, index], axis=1, keepdims=True)
        # A value pulls the median of its group towards itself; the factor is exact for a mean.
        wide[index] = np.sqrt(1.0 - 1.0 / index.size)
    return (value - middle) / wide, middle


def _spread(scatter: FloatArray, error: FloatArray) -> FloatArray:
    """Return sqrt(s^2 + se^2), above zero; shape (k, n)."""
    return np.maximum(np.hypot(scatter, error[None, :]), 1e-300)


def _scatter(rest: FloatArray, error: FloatArray, share: float = 0.5) -> FloatArray:
    """Return s of each row; shape (k, 1)."""
    # The median of |rest| / sqrt(s^2 + se^2) is `_MEDIAN`, as for a normal distribution, if s^2 is
    # the median of rest^2 / `_MEDIAN`^2 - se^2. The quantile at 0.5 + z / (2 sqrt(n)) gives an
    # upper bound of one-sided level Phi(z).
    excess = (rest / _MEDIAN) ** 2 - error[None, :] ** 2
    return np.sqrt(np.maximum(np.quantile(excess, share, axis=1)[:, None], 0.0))


# Probability of any false drift in a fleet without faults, and of any false outlier.
DRIFT_RATE = 0.05
OUTLIER_RATE = 0.05
# Minimum number of vehicles to judge one by the spread of the others.
LEAST_VEHICLES = 6
# Maximum difference of ln resistance or ln sag between two good vehicles: the systematic error of
# these facts (`LEAST_ERROR`), common to all flights of a vehicle.
_TOLERANCE = math.log(1.0 + LEAST_ERROR)
# Standard error of a median relative to the mean, for many normal values.
_MEDIAN_ERROR = 1.2533141373155


@dataclass(frozen=True, eq=False)
class VehicleValues:
    """One quantity of every vehicle: the medians of its recordings."""

    names: tuple[str, ...]
    value: FloatArray  # Medians on the scale of `Values.value`; shape (v,)
    outliers: Outliers  # How far each is from the fleet
    cells: tuple[int, ...]  # Number of cells that each value is divided by; 0: not divided


@dataclass(frozen=True, eq=False)
class Judgement:
    """What stands out in a fleet."""

    values: dict[str, Values]  # Quantity -> recordings
    trends: tuple[Trend, ...]  # All that were tested, lowest p-value first
    recordings: dict[str, Outliers]  # Quantity -> each recording against others of its vehicle
    vehicles: dict[str, VehicleValues]  # Quantity -> each vehicle against the others

    @property
    def drifting(self) -> tuple[Trend, ...]:
        """Return the trends that are significant at the family rate."""
        return tuple(t for t in self.trends if t.p_family <= DRIFT_RATE)

    @property
    def possible(self) -> tuple[Trend, ...]:
        """Return the trends that are significant by themselves (95 %), not at the family rate."""
        return tuple(t for t in self.trends if t.p_family > DRIFT_RATE and t.low * t.high > 0.0)

    def odd_recordings(self) -> list[tuple[str, int]]:
        """Return (quantity, index) of the outlying recordings, largest score first."""
        return _largest_first(self.recordings)

    def odd_vehicles(self) -> list[tuple[str, int]]:
        """Return (quantity, index) of the outlying vehicles, largest score first."""
        return _largest_first({name: v.outliers for name, v in self.vehicles.items()})


def _largest_first(outliers_of: Mapping[str, Outliers]) -> list[tuple[str, int]]:
    found = [(name, int(k)) for name, o in outliers_of.items() for k in np.flatnonzero(o.found)]
    return sorted(found, key=lambda f: -abs(float(outliers_of[f[0]].score[f[1]])))


def judge(rows: Sequence[Row]) -> Judgement:
    """Return drifts, and outliers among recordings and vehicles."""
    values = {name: values_of(rows, name) for name in QUANTITIES}
    tested = trends(tuple(values.values()))
    # Each quantity is compared twice: among the recordings of a vehicle, and among vehicles.
    rate = OUTLIER_RATE / (2 * len(QUANTITIES))
    drifting = [t for t in tested if t.p_family <= DRIFT_RATE]
    recordings, vehicles = {}, {}
    for name, one in values.items():
        trend = np.zeros(one.value.size)
        for t in drifting:
            if t.quantity == name:
                mine = one.of(t.vehicle) & (one.flights > 0)
                trend[mine] = t.line(one.flights[mine].astype(np.float64)) - t.line(np.array(
                    0.5 * (t.first + t.last)))
        recordings[name] = outliers(one.value, one.error, one.vehicles, rate, trend)
        vehicles[name] = _compare_vehicles(one, recordings[name], one.value - trend, rate)
    return Judgement(values, tested, recordings, vehicles)


def _compare_vehicles(values: Values, within: Outliers, flat: FloatArray, rate: float
                      ) -> VehicleValues:
    """Compare vehicles (flat: values without drift); packs only with packs of equal cells."""
    names = tuple(sorted(set(values.vehicles) - {''}))
    scatter = float(np.nan_to_num(within.scatter))
    value, error = np.zeros(len(names)), np.zeros(len(names))
    of = [np.flatnonzero(values.of(name)) for name in names]
    for k, mine in enumerate(of):
        value[k] = np.median(values.value[mine])
        one = np.sqrt(np.mean(scatter ** 2 + values.error[mine] ** 2) / mine.size)
        # The median of two is their mean.
        error[k] = one * (_MEDIAN_ERROR if mine.size > 2 else 1.0)
    # Packs with different numbers of cells belong to different craft.
    cells = tuple(int(values.cells[mine].max()) for mine in of)
    found = outliers(value, error, [f'{one} cells' for one in cells], rate, least=LEAST_VEHICLES)
    for kind in set(cells) if values.name in OF_PACK else ():
        # The scatter of a vehicle with one flight is unknown.
        places = [k for k, one in enumerate(cells) if one == kind and of[k].size > 1]
        if 1 < len(places) and cells.count(kind) < LEAST_VEHICLES:
            found = _judge_few(found, places, [flat[of[k]] for k in places])
    return VehicleValues(names, value, found, cells)


def _judge_few(found: Outliers, places: Sequence[int], flights: Sequence[FloatArray]) -> Outliers:
    """Compare the mean of each of a few vehicles (two flights or more) with the others' mean."""
    # The null hypothesis is a difference of at most `_TOLERANCE`, either way.
    freedom = sum(one.size - 1 for one in flights)
    squares = sum(float(((one - one.mean()) ** 2).sum()) for one in flights)
    if not squares > 0.0:
        return found
    means = np.array([one.mean() for one in flights])
    variance = squares / freedom / np.array([one.size for one in flights])
    reach = np.full(found.score.size, NAN) if found.reach is None else found.reach
    rest = list(range(len(means)))
    # An outlier would move the mean with which the others are compared, so it is removed.
    while len(rest) > 1:
        m, v = means[rest], variance[rest]
        others = (m.sum() - m) / (m.size - 1)
        se = np.sqrt(v + (v.sum() - v) / (m.size - 1) ** 2)
        score, least = (m - others) / se, _TOLERANCE / se
        p = stats.t.sf(np.abs(score) - least, freedom) + stats.t.sf(np.abs(score) + least, freedom)
        chance = np.asarray(adjusted(p.tolist()))
        worst = int(p.argmin())
        odd = m.size > 2 and chance[worst] <= found.rate
        # Two vehicles have a single difference, which is reported for the higher one.
        reported = [worst] if odd else [int(m.argmax())] if m.size == 2 else list(range(m.size))
        places_reported = np.array(places)[rest][reported]
        for column, values in ((found.score, score), (found.chance, chance),
                               (found.centre, others),
                               (reach, float(stats.t.ppf(0.975, freedom)) * se)):
            column[places_reported] = values[reported]
        if not odd:
            break
        del rest[worst]
    return replace(found, reach=reach)
