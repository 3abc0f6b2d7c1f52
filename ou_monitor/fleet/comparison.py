"""
Recordings brought to one throttle, so that they can be compared.

The logarithms of sigma and alpha follow a common curve over throttle (straight
between knots), fitted to all levels by Huber's estimate with a level of its own
for each vehicle; what a recording lies above it, averaged over its levels by
time, is its deviation.  What is shown is what was measured; what is compared
carries the error of the curve between its own throttle and the usual one.

Limits: the shape of the curve is taken to be that of all vehicles, and
throttle to mean the same load on each.  Recordings without throttle are
compared as they are.  Sag is compared at full throttle, where it is known no
better than the form of the load (doc/load.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.curves import bin_width
from ou_monitor.records import FloatArray, NAN
from ou_monitor.text import Z95

Row = Mapping[str, Any]
IntArray = npt.NDArray[np.intp]
USABLE = ('OK', 'SHORT_WINDOW')
# Quantities that are compared -> unit; the first two on the log scale.
QUANTITIES = {'sigma': 'V/sqrt(s)', 'alpha': '1/s', 'sag': 'V'}
LOGARITHMIC = ('sigma', 'alpha')
_HUBER = 1.345
_ROUNDS = 30
_MOST_BINS = 60.0
# Pieces of the curve at most, rows that each takes, and how far apart its knots are at least.
_PIECES, _ROWS, _APART = 8, 12, 0.03


@dataclass(frozen=True)
class CommonCurve:
    """The common curve over throttle of the logarithm of a quantity: straight between knots."""

    reference: float  # Throttle that all recordings are brought to; NaN when none has any
    # Throttles, and the logarithm there above that at the reference; empty for a flat curve.
    knots: tuple[float, ...] = ()
    heights: tuple[float, ...] = ()
    # Of the slopes between k knots; recordings, not levels, count as independent; shape (k - 1, k
    # - 1).
    covariance: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))

    def __call__(self, throttle: FloatArray) -> FloatArray:
        """Return what is added to the logarithm at the reference; 0 where unknown."""
        u = np.asarray(throttle, dtype=np.float64)
        if not self.knots:
            return np.zeros(u.shape)
        rise: FloatArray = np.nan_to_num(np.interp(u, self.knots, self.heights))
        return rise

    def pieces(self, throttle: FloatArray) -> FloatArray:
        """Return how much of each slope lies below some throttles, shape (n, k - 1)."""
        u = np.asarray(throttle, dtype=np.float64)
        known = np.where(np.isfinite(u), u, self.reference)
        return _pieces(known, self.knots)


@dataclass(frozen=True, eq=False)
class Values:
    """One quantity of every recording that has it."""

    name: str  # Quantity
    paths: tuple[str, ...]  # Recordings
    vehicles: tuple[str, ...]  # Of each; empty where unknown
    flights: IntArray  # Number of the flight; 0 where there is none; shape (n,)
    # Logarithm at the reference throttle (sag: V at full throttle) and its standard error, with
    # that of the move from its own throttle rather than from the usual one; shape (n,).
    value: FloatArray
    error: FloatArray
    curve: CommonCurve  # What was taken out
    # In the unit of the quantity, as measured, and at which throttle; the mean over the levels (by
    # time; of the logarithm); NaN where throttle is unknown; shape (n,).
    measured: FloatArray
    throttle: FloatArray

    def shown(self, value: FloatArray | float) -> FloatArray:
        """Return values of `value` in the unit of the quantity."""
        data = np.asarray(value, dtype=np.float64)
        return np.exp(data) if self.name in LOGARITHMIC else data

    def interval(self) -> tuple[FloatArray, FloatArray]:
        """Return the ends of the 95 % intervals in the unit of the quantity."""
        reach = Z95 * self.error
        return self.shown(self.value - reach), self.shown(self.value + reach)

    def histogram(self) -> tuple[FloatArray, npt.NDArray[np.int_]]:
        """Return edges, on the scale of `value`, and counts; outliers do not widen the bins."""
        value = self.value
        width = max(bin_width(value), float(np.ptp(value)) / _MOST_BINS, 1e-9)
        first = math.floor(float(value.min()) / width) * width
        bins = int(math.ceil((float(value.max()) - first) / width + 1e-9)) or 1
        counts, edges = np.histogram(value, first + width * np.arange(bins + 1))
        return edges, counts

    def common_curve(self, throttle: FloatArray) -> FloatArray:
        """Return the common curve through the median of all, in the unit of the quantity."""
        return self.shown(float(np.median(self.value)) + self.curve(throttle))


def values_of(rows: Sequence[Row], name: str) -> Values:
    """Return one quantity of every recording."""
    if name == 'sag':
        once = list({row['path']: row for row in rows if row['sag_full'] is not None}.values())
        return _values(name, once, CommonCurve(NAN), *(
            np.array([_number(row[column]) for row in once])
            for column in ('sag_full', 'sag_full_se', 'sag', 'sag_throttle')))
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
    pieces = curve.pieces(u)
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
    """Return the error of the move of each recording from its throttle to the usual one."""
    if not curve.knots or not place.size:
        return np.zeros(len(place))
    # What all are moved by alike cancels when they are compared.
    move = place - np.median(place, axis=0)
    variance = np.einsum('ki,ij,kj->k', move, curve.covariance, move)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _number(value: Any) -> float:
    return NAN if value is None else float(value)


def _values(name: str, rows: Sequence[Row], curve: CommonCurve, value: FloatArray,
            error: FloatArray, measured: FloatArray, throttle: FloatArray) -> Values:
    return Values(name, tuple(row['path'] for row in rows),
                  tuple(row['vehicle'] or '' for row in rows),
                  np.array([row['flight'] or 0 for row in rows], dtype=np.intp),
                  np.asarray(value, dtype=np.float64),
                  np.nan_to_num(np.asarray(error, dtype=np.float64)), curve, measured, throttle)


def _pieces(u: FloatArray, knots: Sequence[float]) -> FloatArray:
    """Return how much of each span between knots lies below throttles, shape (n, k - 1)."""
    columns = [np.clip(u - low, 0.0, high - low) for low, high in zip(knots, knots[1:])]
    return np.column_stack(columns) if columns else np.zeros((u.size, 0))


def _curve(y: FloatArray, u: FloatArray, vehicles: Sequence[str], recordings: IntArray
           ) -> CommonCurve:
    """Return the common curve of levels; flat where throttle does not vary."""
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
        # Each vehicle has a level of its own, taken out by centring.  One without throttle has
        # no weight here, and no row.
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
    """
    Return the covariance of slopes when recordings are left out one by one.

    As residuals are alike within a recording (of), and each vehicle takes a level.
    """
    # Slope of Huber's function: what lies beyond its bend does not pull.
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
    """Return knots at even shares of the rows, not too near each other; increasing."""
    pieces = min(max(u.size // _ROWS, 1), _PIECES)
    wanted = np.quantile(u, np.linspace(0.0, 1.0, pieces + 1)).tolist()
    knots = wanted[:1]
    for knot in wanted[1:]:
        if knot - knots[-1] >= _APART:
            knots.append(knot)
    # The last one holds the end, so that nothing is flat that should not be.
    if len(knots) > 1:
        knots[-1] = wanted[-1]
    return [float(knot) for knot in knots]
