"""
Readings of a source that a logger, a driver or a link repeats until the next one.

A voltage read at 100 Hz and logged at 1 kHz stands in the log ten times.  Taken as samples, the
repeats look like increments of zero.  They are recognised by the gaps between changes: all are
multiples of one period, which need not be whole (3, 3, 4).  A coarse ADC makes ties as well, but
at irregular distances.  A ramp, a square wave or a ripple through a coarse ADC changes at regular
distances, but always by one code, and two neighbouring gaps of it always add up to the same.

Limits: at least two samples a reading; where the ADC step is larger than 1.3 times the increment
between readings, and the source is read more often than every fourth sample, repeats are not told
from the ADC's own ties; nor is a source whose readings come early or late by more than a tenth of
a period (standard deviation).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray, NAN, Recording

# Gaps that may differ from the pattern: lost samples, a logger that was late.
_ODD = 0.05
# Widest pattern, in periods: gaps of 7..13 where 10 is meant.
_WIDEST = 0.35
# Evidence against gaps of independent changes, nats: by chance once in 5e8.
_EVIDENCE = 20.0
# Share of changes that must be of another size than the commonest.
_SIZES = 0.1
# Least share of regular gaps with which a known period is kept.
_KEEP = 0.8
# Fewest gaps from which a known period is given up.
_FEWEST = 8
# Sizes of steps that differ by less than this share are one (rounding of float32).
_SAME = 1e-3
# Periods nearer than this to a whole number are whole.
_WHOLE = 0.02
# Times a period is refined: the numbers of periods in the gaps follow from it.
_REFINED = 3
# Shortest gaps tried as the period.
_TRIED = 40
# Where all changes are of one size, the shortest period: ripple of one code changes every two or
# three samples as well.
_ONE_CODE = 4.0
# Samples in which the period of a whole recording is looked for: their middle.
_LOOK = 200_000


@dataclass(slots=True)
class Batch:
    """Clean samples in order; views that hold until the next push."""

    t: FloatArray  # stamps, s, strictly increasing, shape (n,)
    y: FloatArray  # voltage, V, shape (n,)
    u: FloatArray | None  # throttle, NaN where unknown; None: unknown throughout
    i: FloatArray | None  # current, A, NaN where unknown; None: unknown throughout
    shortest: float  # least step, from the sample before on, s
    longest: float  # largest step, s
    restart: bool  # whether everything before this batch is to be forgotten
    again: bool = False  # whether this batch holds, without repeats, what was passed on before

    @classmethod
    def of(cls, columns: FloatArray, restart: bool, *, again: bool = False,
           before: float = -math.inf) -> Batch:
        """Return columns t, V, throttle, current, shape (4, n), n > 0; `before`: last stamp, s."""
        t, y, u, i = columns
        steps = np.diff(t, prepend=before)
        # The first sample of all follows nothing: no pause lies before it.
        rest = steps if steps[0] < math.inf or t.size == 1 else steps[1:]
        return cls(t, y, None if np.isnan(u).all() else u, None if np.isnan(i).all() else i,
                   float(steps.min()), float(rest.max()), restart, again)

    def columns(self) -> FloatArray:
        """Return stamps, voltage, throttle and current, shape (4, n); NaN where unknown."""
        return np.stack([self.t, self.y, *(
            np.full(self.t.size, NAN) if x is None else x for x in (self.u, self.i))])


def refresh_period(y: FloatArray, known: float = 1.0) -> float:
    """Return samples per refresh of the source (y in V)."""
    steps = np.diff(y)
    changes = np.flatnonzero(steps)
    gaps = np.diff(changes).astype(np.float64)
    if known > 1.0:
        if gaps.size < _FEWEST:
            return known
        allowed = max(1.0, _WIDEST * known)
        if (np.abs(_excess(gaps, known)) <= allowed).mean() >= _KEEP:
            return _period(gaps, known)
    if gaps.size < 2:
        return 1.0
    usual = float(np.median(gaps))
    if usual < 2.0:
        return 1.0
    # Few readings may change the code: the period is a gap at most as long as the usual one.
    evidence, period = 0.0, 1.0
    for first in np.unique(gaps[gaps <= 1.5 * usual])[:_TRIED].tolist():
        about = _period(gaps, float(gaps[np.abs(gaps - first) <= max(1.0, 0.1 * first)].mean()))
        if about >= 2.0 and (found := _evidence(gaps, about)) > evidence:
            evidence, period = found, about
    if evidence < _EVIDENCE:
        return 1.0
    for _ in range(_REFINED):
        period = _period(gaps, period)
    several = _several_sizes(np.abs(steps[changes]))
    return period if several or period >= _ONE_CODE and _irregular(gaps, period) else 1.0


def _evidence(gaps: FloatArray, period: float) -> float:
    """Return the evidence against gaps of independent changes, nats."""
    distance = np.sort(np.abs(_excess(gaps, period)))
    width = float(distance[math.ceil((1.0 - _ODD) * gaps.size) - 1])
    # Whole samples: less than one is one of two neighbouring lengths.
    if width >= 1.0 and width > _WIDEST * period:
        return 0.0
    if abs(period - round(period)) > _WHOLE:
        # Of a period that is not whole the gaps are off by half a sample and more.
        width = max(width, 0.5)
    return gaps.size * _divergence(1.0 - _ODD, _chance(period, width, int(gaps.max())))


def _irregular(gaps: FloatArray, period: float) -> bool:
    """Return whether two neighbouring gaps add up to several numbers of periods."""
    number = np.rint((gaps[1:] + gaps[:-1]) / period).astype(np.int64)
    return bool(np.bincount(number).max(initial=0) <= (1.0 - _SIZES) * number.size)


def _period(gaps: FloatArray, near: float) -> float:
    """Return the mean period of the gaps, given one close to it; outliers are left out."""
    number = np.maximum(1.0, np.rint(gaps / near))
    good = np.abs(gaps - near * number) <= max(1.0, _WIDEST * near)
    return float(gaps[good].sum() / number[good].sum()) if good.any() else near


def _excess(gaps: FloatArray, period: float) -> FloatArray:
    """Return gaps less the nearest whole number, at least one, of periods."""
    excess: FloatArray = gaps - period * np.maximum(1.0, np.rint(gaps / period))
    return excess


def _chance(period: float, width: float, longest: int) -> float:
    """Return how many gaps of independent changes would fit the pattern (geometric law)."""
    gaps = np.arange(1.0, max(longest, 20.0 * period) + 1.0)
    law = np.power(1.0 - 1.0 / period, gaps - 1.0) / period
    return float(law[np.abs(_excess(gaps, period)) <= width + 1e-9].sum())


def _divergence(share: float, chance: float) -> float:
    """Return the Kullback-Leibler divergence of two Bernoulli laws, nats; 0 when not above."""
    if chance >= share:
        return 0.0
    return (share * math.log(share / max(chance, 1e-12))
            + (1.0 - share) * math.log((1.0 - share) / (1.0 - chance)))


def _several_sizes(sizes: FloatArray) -> bool:
    """Whether a tenth of the steps are of another size than the commonest."""
    ordered = np.sort(sizes)
    # A new size begins where the next step is larger by more than rounding.
    begins = np.flatnonzero(np.diff(ordered) > _SAME * ordered[1:]) + 1
    counts = np.diff(np.concatenate(([0], begins, [ordered.size])))
    return bool(counts.max() <= (1.0 - _SIZES) * ordered.size)


class Repeats:
    """
    Drops repeats from a stream, in batches of any size; `period`: samples per refresh.

    A refresh may happen to give the value of the one before: in a run that is longer than a period
    it is put where it belongs, so that dropping repeats does not select changes.  It is passed on
    when half a period after it has been seen.
    """

    def __init__(self) -> None:
        self.period = 1.0
        self.forget()

    def forget(self) -> None:
        """Take the next sample as the first one; the period stays known."""
        self._waiting = np.empty((4, 0))
        self._value = math.nan
        self._place = 0
        self._last = -math.inf

    def drop(self, batch: Batch) -> Batch | None:
        """Return the refreshes among samples; None when there are none."""
        columns = np.concatenate([self._waiting, batch.columns()], axis=1)
        columns = columns[:, self.fresh(columns)]
        if not columns.size:
            return None
        before, self._last = self._last, float(columns[0, -1])
        return Batch.of(columns, batch.restart, again=batch.again, before=before)

    def fresh(self, columns: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which samples are refreshes; those not known yet are kept waiting."""
        y = columns[1]
        n = y.size
        starts = np.concatenate(([0], np.flatnonzero(y[1:] != y[:-1]) + 1))
        begins = starts.copy()
        if y[0] == self._value:
            # The first run began before these samples.
            begins[0] = -self._place
        sizes = np.diff(np.append(starts, n))
        place = np.arange(n) - np.repeat(begins, sizes)
        length = np.repeat(np.diff(np.append(begins, n)), sizes)
        number = np.rint(place / self.period)
        due = np.rint(number * self.period) == place
        if math.isnan(self._value):
            # Since when the first value of a time line had been there is not known.
            due[0] = False
        sure = (number == 0.0) | (length >= (number + 0.5) * self.period)
        last = int(starts[-1])
        unsure = np.flatnonzero(due[last:] & ~sure[last:])
        known = last + int(unsure[0]) if unsure.size else n
        fresh: npt.NDArray[np.bool_] = due & sure
        fresh[known:] = False
        self._value = float(y[-1])
        self._place = int(place[-1]) + 1 - (n - known)
        self._waiting = columns[:, known:].copy()
        return fresh


def reading_places(y: FloatArray) -> tuple[npt.NDArray[np.intp], float]:
    """Return where a recorded voltage, V, was read anew, and samples per reading (1: all)."""
    first = max(0, (y.size - _LOOK) // 2)
    repeats = Repeats()
    repeats.period = refresh_period(y[first:first + _LOOK])
    if repeats.period <= 1.0:
        return np.arange(y.size), 1.0
    return np.flatnonzero(repeats.fresh(np.stack([np.empty(y.size), y]))), repeats.period


def refreshes(t: FloatArray, y: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return a series where its source was read, and samples per reading (t in s)."""
    places, period = reading_places(y)
    return reading_times(t[places], period), y[places], period


def reading_times(t: FloatArray, period: float) -> FloatArray:
    """
    Return when a source was read, from when that was logged first, s.

    A logger is late by up to one of its own steps: where the source keeps a clock of its own, of
    no whole number of these steps, its readings lie on the even grid nearest to their stamps.
    """
    if t.size < 2 or abs(period - round(period)) < _WHOLE:
        return t
    usual = (t[-1] - t[0]) / (t.size - 1)
    grid = on_grid(t, np.maximum(1.0, np.rint(np.diff(t) / usual)))
    # The logger's step is 1/period of those here.
    return grid if float(np.abs(t - grid).max()) < 1.5 * usual / period else t


def on_grid(t: FloatArray, number: FloatArray) -> FloatArray:
    """Return the even grid nearest to stamps (t in s, number of steps between them, result s)."""
    k = np.concatenate(([0.0], np.cumsum(number)))
    k -= k.mean()
    middle = float(t.mean())
    grid: FloatArray = middle + float(k @ (t - middle)) / float(k @ k) * k
    return grid


def readings_of(recording: Recording) -> Recording:
    """Return a recording with each reading of its source once; a note says what that took."""
    places, period = reading_places(recording.voltage)
    if period <= 1.0:
        return recording
    t = reading_times(recording.t[places], period)
    held = recording.n - t.size
    logged = (recording.n - 1) / recording.duration
    note = (f'The voltage was read at {(t.size - 1) / float(t[-1] - t[0]):.4g} Hz and logged at '
            f'{logged:.4g} Hz: {held} repeats were left out.')
    return replace(
        recording, t=t, voltage=recording.voltage[places], throttle=recording.throttle[places],
        current=None if recording.current is None else recording.current[places],
        notes=(*recording.notes, note), held=recording.held + held)
