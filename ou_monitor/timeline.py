"""
Put the samples of any source in order of time, each reading once, and count dropped samples.

Node, estimator and offline reading share these rules:

- samples with a non-finite or implausible stamp or voltage are dropped (`non_finite`);
- an implausible throttle or current becomes NaN;
- each push is sorted; repeated stamps, and stamps before an earlier push's, are dropped (`late`);
- a stamp that is earlier or later by more than a pause starts a new time line;
- a reading that a logger repeats counts once (`held`).

Repeats: a voltage read at 100 Hz and logged at 1 kHz appears ten times, and the repeats would look
like increments of zero.  They are recognised because the numbers of samples between two changes
(gaps) are multiples of one period, which may be a fraction (3, 3, 4).  A coarse ADC also repeats
values.  Then the gaps are irregular, or (in a ramp, a square wave or ripple) all changes are by
one code and each pair of neighbouring gaps has the same sum.

Limits: repeats are recognised only with at least two samples per reading, and after 64 samples,
which are then passed on again without repeats (`Batch.again`).  They are not recognised if the
readings jitter by more than a tenth of a period (standard deviation), or if there are fewer than
four samples per reading and the ADC step exceeds 1.3 times the usual increment.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import (
    as_numbers, Counters, Defect, FloatArray, LEAST_STEP, LONGEST_STEP, MOST_STAMP, NAN,
    Note, Recording)
from ou_monitor.text import counted, percent

# Minimum pause, in median steps.
GAP_STEPS = 20.0
# Share of gaps that may differ from the pattern, because of lost samples or a late logger.
_ODD = 0.05
# Largest deviation of a gap from the pattern, in periods: 7..13 for a period of 10.
_WIDEST = 0.35
# Minimum evidence for a period against independent changes, nats: exp(-20) is one in 5e8.
_EVIDENCE = 20.0
# Minimum share of changes whose size differs from the most common size.
_SIZES = 0.1
# Minimum share of regular gaps to keep a period found earlier.
_KEEP = 0.8
# Minimum number of gaps for this decision; with fewer, the period is kept.
_FEWEST = 8
# Relative difference below which two step sizes are equal (float32 rounding).
_SAME = 1e-3
# Distance from a whole number below which a period is whole, samples.
_WHOLE = 0.02
# Refinements of a period; each recomputes the number of periods in every gap.
_REFINED = 3
# Maximum number of gap lengths tried as the period, shortest first.
_TRIED = 40
# Minimum period when all changes have one size, samples: a ripple of one ADC code also changes
# every two or three samples.
_ONE_CODE = 4.0
# Number of samples, from the middle of a recording, in which the period is searched.
_MIDDLE = 200_000


@dataclass(slots=True)
class Batch:
    """Clean samples in order."""

    # Stamps, s, strictly increasing; voltage, V; throttle and current, A, NaN where unknown;
    # shape (4, n), n > 0.
    columns: FloatArray
    restart: bool  # a new time line starts here: forget all earlier samples
    again: bool = False  # samples already passed on, now without their repeats

    @property
    def t(self) -> FloatArray:
        """Return the stamps, s."""
        return np.asarray(self.columns[0])

    @property
    def y(self) -> FloatArray:
        """Return the voltage, V."""
        return np.asarray(self.columns[1])


def as_columns(t: FloatArray, y: FloatArray, u: FloatArray | float | None = None,
               i: FloatArray | None = None) -> FloatArray:
    """Return a copy of samples (s, V, 0..1, A; None: unknown) as the columns of a `Batch`."""
    columns = np.full((4, t.size), NAN)
    for row, values in zip(columns, (t, y, u, i)):
        if values is not None:
            row[:] = values
    return columns


def refresh_period(y: FloatArray, known: float = 1.0) -> float:
    """Return the samples per reading, 1 without repeats (y in V; known: period found earlier)."""
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
    # Long gaps span several periods: the code of a coarse ADC changes at few readings only.
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
    """Return the evidence for a period, against independent changes, nats."""
    distance = np.sort(np.abs(_excess(gaps, period)))
    width = float(distance[math.ceil((1.0 - _ODD) * gaps.size) - 1])
    # Gaps are whole samples, so a deviation below one is only rounding.
    if width >= 1.0 and width > _WIDEST * period:
        return 0.0
    if abs(period - round(period)) > _WHOLE:
        # With a fractional period gaps deviate by half a sample or more.
        width = max(width, 0.5)
    share, chance = 1.0 - _ODD, max(_chance(period, width, int(gaps.max())), 1e-12)
    # The Kullback-Leibler divergence of two Bernoulli laws.
    return 0.0 if chance >= share else gaps.size * (
        share * math.log(share / chance) + _ODD * math.log(_ODD / (1.0 - chance)))


def _irregular(gaps: FloatArray, period: float) -> bool:
    """Return whether sums of two neighbouring gaps vary in their number of periods."""
    number = np.rint((gaps[1:] + gaps[:-1]) / period).astype(np.int64)
    return bool(np.bincount(number).max(initial=0) <= (1.0 - _SIZES) * number.size)


def _period(gaps: FloatArray, near: float) -> float:
    """Return the mean period of the gaps without outliers, given an approximate period."""
    number = np.maximum(1.0, np.rint(gaps / near))
    good = np.abs(gaps - near * number) <= max(1.0, _WIDEST * near)
    return float(gaps[good].sum() / number[good].sum()) if good.any() else near


def _excess(gaps: FloatArray, period: float) -> FloatArray:
    """Return gaps less the nearest multiple (at least one) of the period."""
    excess: FloatArray = gaps - period * np.maximum(1.0, np.rint(gaps / period))
    return excess


def _chance(period: float, width: float, longest: int) -> float:
    """Return the share of gaps between independent changes that fit by chance (geometric law)."""
    gaps = np.arange(1.0, max(longest, 20.0 * period) + 1.0)
    law = np.power(1.0 - 1.0 / period, gaps - 1.0) / period
    return float(law[np.abs(_excess(gaps, period)) <= width + 1e-9].sum())


def _several_sizes(sizes: FloatArray) -> bool:
    """Return whether a tenth of the steps differ in size from the most common one."""
    ordered = np.sort(sizes)
    # A new size starts where the next step is larger by more than rounding.
    begins = np.flatnonzero(np.diff(ordered) > _SAME * ordered[1:]) + 1
    counts = np.diff(np.concatenate(([0], begins, [ordered.size])))
    return bool(counts.max() <= (1.0 - _SIZES) * ordered.size)


class Repeats:
    """Drops repeats from a stream, in batches of any size; `period`: samples per reading."""

    # A new reading may equal the previous one, and dropping it would bias the noise.  So a long
    # run of equal values counts as one reading per period, each passed on half a period later.

    def __init__(self) -> None:
        self.period = 1.0
        self.forget()

    def forget(self) -> None:
        """Start a new time line with the next sample; keep the period."""
        self._waiting = np.empty((4, 0))
        self._value = math.nan
        self._place = 0

    def drop(self, batch: Batch) -> Batch | None:
        """Return the new readings among samples; None if there are none."""
        columns = np.concatenate([self._waiting, batch.columns], axis=1)
        columns = columns[:, self.fresh(columns)]
        if not columns.size:
            return None
        return replace(batch, columns=columns)

    def fresh(self, columns: FloatArray) -> npt.NDArray[np.bool_]:
        """Return which samples are new readings; undecided samples wait for the next call."""
        y = columns[1]
        n = y.size
        starts = np.concatenate(([0], np.flatnonzero(y[1:] != y[:-1]) + 1))
        begins = starts.copy()
        if y[0] == self._value:
            # The first run started before these samples.
            begins[0] = -self._place
        sizes = np.diff(np.append(starts, n))
        place = np.arange(n) - np.repeat(begins, sizes)
        length = np.repeat(np.diff(np.append(begins, n)), sizes)
        number = np.rint(place / self.period)
        due = np.rint(number * self.period) == place
        if math.isnan(self._value):
            # The first value of a time line may have been read long before.
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


def new_readings(t: FloatArray, y: FloatArray) -> tuple[Picked, FloatArray, float]:
    """Return indices of new readings (t in s, y in V), their times, s, and samples per reading."""
    repeats = Repeats()
    first = max(0, (y.size - _MIDDLE) // 2)
    repeats.period = period = refresh_period(y[first:first + _MIDDLE])
    if period <= 1.0:
        return slice(None), t, 1.0
    places = np.flatnonzero(repeats.fresh(np.stack([np.empty(y.size), y])))
    t = t[places]
    # A reading is logged up to one logger step late.  If the period is not a whole number of
    # logger steps, the source has its own clock: the readings lie on the even grid nearest to t.
    if t.size > 1 and abs(period - round(period)) >= _WHOLE:
        usual = (t[-1] - t[0]) / (t.size - 1)
        grid = on_grid(t, np.maximum(1.0, np.rint(np.diff(t) / usual)))
        # A logger step is 1/period of the usual step of t.
        if float(np.abs(t - grid).max()) < 1.5 * usual / period:
            t = grid
    return places, t, period


def scatter_words(t: FloatArray, least: float) -> str:
    """Return a note on the scatter of steps between stamps, s; empty if it is at most `least`."""
    steps = np.diff(t)
    usual = float(np.median(steps))
    scatter = float(np.sqrt(np.mean((steps[steps <= GAP_STEPS * usual] / usual - 1.0) ** 2)))
    return (f'The steps between stamps scatter by {percent(scatter)} of their median '
            f'({1e3 * usual:.3g} ms)') * (scatter > least)


def pause_words(t: FloatArray) -> str:
    """Return the pauses between stamps, s, as the end of a sentence; empty without one."""
    steps = np.diff(t)
    long = steps[steps > GAP_STEPS * np.median(steps)] if steps.size > 1 else steps[:0]
    return (f'; {counted(long.size, "pause")} without usable samples, {float(long.sum()):.3g} s '
            f'in all, the longest {float(long.max()):.3g} s') if long.size else ''


def on_grid(t: FloatArray, number: FloatArray) -> FloatArray:
    """Return the even grid nearest to stamps (t in s, number of steps between them, result s)."""
    k = np.concatenate(([0.0], np.cumsum(number)))
    k -= k.mean()
    middle = float(t.mean())
    grid: FloatArray = middle + float(k @ (t - middle)) / float(k @ k) * k
    return grid


def readings_of(recording: Recording) -> Recording:
    """Return a recording without repeated readings and without the sign of a reverse throttle."""
    recording = _unsigned(recording)
    places, t, period = new_readings(recording.t, recording.voltage)
    if period <= 1.0:
        return recording
    note = repeats_words(recording.t, t)
    return replace(part_of(recording, places, note), t=t,
                   held=recording.held + recording.n - t.size)


def _unsigned(recording: Recording) -> Recording:
    """Return a recording with the absolute throttle if that predicts the voltage better."""
    u = recording.throttle
    known = np.isfinite(u) & np.isfinite(recording.voltage)
    if not np.count_nonzero(u < -_REVERSE) > _REVERSE * recording.n:
        return recording
    change = np.diff(recording.voltage[known])
    signed, size = (_explained(change, np.diff(x[known])) for x in (u, np.abs(u)))
    if not size > signed + math.log(recording.n):
        return recording
    return replace(recording, throttle=np.abs(u), notes=(*recording.notes, (
        f'Throttle runs from {float(np.nanmin(u)):.3g} to {float(np.nanmax(u)):.3g}, and the '
        'voltage falls in both directions: the absolute value of throttle is used. For the node, '
        'publish that value.')))


def _explained(y: FloatArray, x: FloatArray) -> float:
    """Return the gain in log-likelihood if y is proportional to -x, nats."""
    product, power = -float(x @ y), float(x @ x) * float(y @ y)
    share = product * product / power if product > 0.0 and power > 0.0 else 0.0
    return -0.5 * y.size * math.log1p(-min(share, 1.0 - 1e-9))


def repeats_words(logged: FloatArray, read: FloatArray) -> str:
    """Return a note on repeats, from the stamps of all samples and of the readings, s."""
    rates = [(t.size - 1) / float(t[-1] - t[0]) for t in (read, logged)]
    return (f'The voltage was read at {rates[0]:.4g} Hz and logged at {rates[1]:.4g} Hz: '
            f'{logged.size - read.size} repeats were left out.')


def supplied(recording: Recording, at_ends: bool = False) -> Recording:
    """
    Return a recording without wild readings and without the times when its supply was off.

    Notes report what was left out.  Readings above `WILD_FACTOR` times the usual voltage, and
    single ones below `OFF` times it, are wild.  A supply is off below `OFF` of its usual voltage;
    the outage includes adjacent readings below `_ON`.  If the supply is low too often, or mostly
    between `OFF` and `_ON`, all readings are kept.
    at_ends: leave out only outages at the start and the end of the recording.
    """
    usual = float(np.quantile(recording.voltage, 0.8)) if recording.n else 0.0
    if not usual > 0.0:
        return recording
    low = recording.voltage < _ON * usual
    beside = np.append(False, low[:-1]) | np.append(low[1:], False)
    wild = np.isfinite(recording.voltage) & (recording.voltage > WILD_FACTOR * usual) | (
        recording.voltage < OFF * usual) & ~beside
    if 0 < wild.sum() <= max(1.0, _FEW * recording.n):
        between = dict.fromkeys(f'{x:.6g} V' for x in np.sort(recording.voltage[wild])[[0, -1]])
        recording = part_of(recording, ~wild, (
            f'{counted(int(wild.sum()))} left out: {" to ".join(between)}, where {usual:.3g} V is '
            'usual.'))
    t, v = recording.t, recording.voltage
    off, low = v < OFF * usual, v < _ON * usual
    if not off.any():
        return recording
    edges = np.flatnonzero(np.diff(low, prepend=False, append=False))
    begins, ends = edges[::2], edges[1::2]
    gone = np.logical_or.reduceat(off, begins)
    begins, ends = begins[gone], ends[gone]
    if (begins.size > max(_OUTAGES, _FEW * v.size) or (low & ~off).sum() > _BETWEEN * off.sum()
            or (ends - begins).sum() > _MOST_OFF * v.size):
        return recording
    if at_ends:
        outer = (begins == 0) | (ends == v.size)
        begins, ends = begins[outer], ends[outer]
    if not begins.size:
        return recording
    gone = np.zeros(v.size, dtype=np.bool_)
    for begin, end in zip(begins.tolist(), ends.tolist()):
        # Include the decay from full voltage: about half the time between the two limits.
        first, last = begin + np.flatnonzero(off[begin:end])[[0, -1]]
        gone[max(0, begin - (first - begin) // 2):end + (end - 1 - last) // 2] = True
    count = int(gone.sum())
    seconds = float((t[np.minimum(ends, t.size - 1)] - t[begins]).sum())
    times = 'once' if begins.size == 1 else f'{begins.size} times'
    return part_of(recording, ~gone, (
        f'{counted(count)} left out: the supply was off {times} '
        f'(near {float(np.median(v[off])):.2g} V), from {float(t[begins[0]] - t[0]):.4g} s on, '
        f'{seconds:.3g} s in all. Lowest voltage and dips of the whole recording include them, '
        'except at its ends; fits and simulations do not.'))


def part_of(recording: Recording, which: Picked | npt.NDArray[np.bool_], *said: str,
            ) -> Recording:
    """Return the selected samples of a recording, with further notes."""
    return replace(
        recording, t=recording.t[which], voltage=recording.voltage[which],
        throttle=recording.throttle[which], notes=(*recording.notes, *said),
        current=None if recording.current is None else recording.current[which])


def ordered(recording: Recording) -> Recording:
    """Return a recording in the order of its stamps, each once; notes count dropped samples."""
    which, said = in_order(recording.t, recording.voltage[:, None], MOST_VOLTAGE, ' V')
    if said:
        check_stamps(recording.name, recording.t, recording.voltage)
        recording = part_of(recording, which, *said)
    check_throttle(recording.name, recording.throttle, recording.voltage)
    if recording.n > 1 and not LEAST_STEP <= (
            step := float(np.median(np.diff(recording.t)))) <= LONGEST_STEP:
        raise InputError(f"the samples of '{recording.name}' are {step:.4g} s apart: are the "
                         'stamps in ms, us or ns? Give them in s, or as dates')
    return recording


# Shares of the usual voltage below which a supply is off (0.3 is on: 5 V of USB in place of 4S),
# and above which it is on again.
OFF, _ON = 0.2, 0.7
# Maximum reading, as a multiple of the usual voltage (6S after 5 V of USB: 5).
WILD_FACTOR = 20.0
# Maximum number of outages, or this share of the samples if that is more; the share is also the
# maximum share of wild readings. Maximum share of samples off; maximum ratio of samples between
# the two limits to samples below the lower one.
_OUTAGES, _FEW, _MOST_OFF, _BETWEEN = 10, 0.01, 0.5, 1.0
# Largest accepted magnitude of a voltage, V: far above any supply, with squares and cubes finite.
MOST_VOLTAGE = 1.0e6
# Largest accepted magnitude of a current, A: far above any supply.
MOST_CURRENT = 1.0e6
# Largest magnitude accepted as a throttle of 0..1, with a margin.
MOST_THROTTLE = 2.0
# Throttle below minus this, in more than this share of the samples, is reverse, not trim.
_REVERSE = 0.05
# Maximum share of implausible throttles that are errors of single samples, not another unit.
WILD = 0.05
# Maximum samples in a batch; NumPy's overhead per call is then negligible.
BATCH = 32768
# Search for repeats: samples used, minimum number, new samples between two searches.
TAIL, _ENOUGH, _LOOK = 1024, 64, 256
# Minimum number of late samples per backward step if the clock itself went back.
_STRETCH = 20
# Indices of samples, or a slice if all are meant.
Picked = npt.NDArray[np.intp] | slice
# Search for repeats if more than this share of the samples is equal to the previous one.
_TIED = 0.25


def plausible(values: FloatArray, most: float) -> FloatArray:
    """Return values with NaN where the magnitude exceeds `most`."""
    # `fmin` and `fmax` ignore NaN; comparisons with NaN are false, so NaN stays.
    if -most <= np.fmin.reduce(values, initial=most) and np.fmax.reduce(
            values, initial=-most) <= most:
        return values
    return np.where(np.abs(values) > most, NAN, values)


def plausible_stamps(name: str, t: FloatArray) -> FloatArray:
    """Return stamps, s, with NaN for implausible ones; refuse a file that has no others."""
    found = plausible(t, MOST_STAMP)
    if not np.isfinite(found).any() and (stamps := t[np.isfinite(t)]).size:
        raise InputError(f'{name}: stamps of {stamps[0]:.4g} s are implausible: is the time in '
                         'ms, us or ns? Give --time-unit for a CSV')
    return found


def like_throttle(voltage: FloatArray) -> bool:
    """Return whether a voltage, V, stays within 0 to 1; of an AC-coupled one, half is below 0."""
    low, high = float(np.nanmin(voltage, initial=0.0)), float(np.nanmax(voltage, initial=0.0))
    return low >= 0.0 and high <= 1.0


def check_throttle(name: str, throttle: FloatArray, voltage: FloatArray | None = None) -> None:
    """Refuse a throttle in percent, microseconds or counts, or swapped with the voltage."""
    if plausible(throttle, MOST_THROTTLE) is throttle:
        return
    known = throttle[np.isfinite(throttle)]
    # A few wild values are errors, not another unit: they become NaN, here as in the node.
    if float(np.count_nonzero(np.abs(known) > MOST_THROTTLE)) <= WILD * known.size:
        return
    if voltage is not None and like_throttle(voltage) and float(np.median(known)) < 100.0:
        raise InputError(
            f'{name}: the voltage stays within 0 to 1 and throttle runs from '
            f'{known.min():g} to {known.max():g}: are the two columns swapped?')
    raise InputError(
        f'{name}: throttle runs from {known.min():g} to {known.max():g}, and 0 to 1 is '
        'expected: state its ends (of a CSV: --throttle-unit LOW:HIGH; of a bag: unit_factor '
        'of a msg config), or divide percent by 100 in a Recording')


def check_stamps(name: str, t: FloatArray, voltage: FloatArray) -> None:
    """Refuse stamps too coarse for the voltage: dropping repeated stamps loses most readings."""
    same = np.diff(t) == 0.0
    # Only changes count: a logger may repeat a reading together with its stamp.
    lost = np.count_nonzero(same & (np.abs(np.diff(voltage)) > 0.0))
    if t.size >= _ENOUGH and lost > t.size - same.sum():
        raise InputError(
            f'{name}: {lost} changes of the voltage have no stamp of their own, as '
            f'{counted(t.size)} share {counted(t.size - int(same.sum()), "stamp")}: give finer '
            'stamps, or the interval of evenly spaced samples (of a CSV: --sample-interval S)')


def hold(values: FloatArray) -> FloatArray:
    """Return values with each NaN replaced by the last finite value."""
    known = np.isfinite(values)
    place = np.maximum.accumulate(np.where(known, np.arange(values.size), -1))
    return np.where(place < 0, NAN, values[place]) if values.size else values


# Time for which a throttle is held without a word, s, and in its usual intervals.
_QUIET, _INTERVALS = 1.0, 10.0


def held_words(t: FloatArray, seen: FloatArray) -> str:
    """Return a note if throttle has no new value for long; empty if not (t, seen: stamps, s)."""
    # t: of the voltage; seen: of the throttle values.
    known, seen = np.isfinite(t), np.sort(seen[np.isfinite(seen)])
    if seen.size < 2 or not known.any():
        return ''
    # Not t[known], a copy of which would be the largest memory of a long bag.
    first, last = t.min(where=known, initial=math.inf), t.max(where=known, initial=-math.inf)
    gaps = np.diff(np.append(seen, max(float(last), float(seen[-1]))))
    long = gaps > max(_QUIET, _INTERVALS * float(np.median(gaps)))
    if not long.any():
        return ''
    at = int(np.argmax(gaps))
    return (f'Throttle has no new value for {float(gaps[long].sum()):.3g} s in all, the '
            f'longest time from {float(seen[at] - first):.4g} s on: its last value '
            'is held there. If it moved meanwhile, what is said of throttle is wrong.')


class TimeLine:
    """Buffers, orders and counts the samples of one source."""

    def __init__(self) -> None:
        # Columns t, V, throttle and current of each push since the last `flush`.
        self._parts: list[FloatArray] = []
        self.waiting = 0  # Samples in them
        self._counts: Counter[str] = Counter()
        self._repeats = Repeats()
        self.forget()

    @property
    def counters(self) -> Counters:
        """Return the counts of samples by outcome."""
        return Counters(**self._counts)

    @property
    def period(self) -> float:
        """Return the samples per reading; 1 without repeats."""
        return self._repeats.period

    def put(self, t: FloatArray, y: FloatArray, u: FloatArray | float | None) -> None:
        """Keep samples, copied, for the next `flush`."""
        self._parts.append(as_columns(t, y, u))
        self.waiting += t.size

    def count(self, **more: int) -> None:
        """Add to the counters."""
        self._counts.update(more)

    def forget(self) -> None:
        """Start a new time line with the next sample; keep the period of repeats."""
        self.newest = -math.inf
        self._begin_anew()

    def _begin_anew(self) -> None:
        self._repeats.forget()
        # Last raw samples (t, V, throttle, current); number since the last search for repeats.
        self._tail = np.empty((4, 0))
        self._since_search, self._searched = 0, False

    def flush(self, pause: float) -> list[Batch]:
        """Empty the buffer; return its readings in order (pause in s)."""
        parts, self._parts, self.waiting = self._parts, [], 0
        return self.take(np.concatenate(parts, axis=1), pause)

    def take(self, columns: FloatArray, pause: float) -> list[Batch]:
        """Return the readings among samples (columns of a `Batch`; pause in s), unbuffered."""
        return [part for batch in self.order(columns, pause) for part in self._readings(batch)]

    def order(self, columns: FloatArray, pause: float) -> list[Batch]:
        """Process samples as `take` does, but keep repeats."""
        self.count(pushed=columns.shape[1])
        good = np.isfinite(columns[:2]).all(axis=0)
        if not good.all():
            self.count(non_finite=int(np.count_nonzero(~good)))
            columns = columns[:, good]
        batches: list[Batch] = []
        # Split at each jump in time: each part after it starts a new time line.
        while columns.size:
            t = columns[0]
            restart = math.isfinite(self.newest) and abs(t[0] - self.newest) > pause
            newest = np.maximum.accumulate(t if restart else np.maximum(t, self.newest))
            jumps = np.flatnonzero(np.abs(t[1:] - newest[:-1]) > pause)
            end = int(jumps[0]) + 1 if jumps.size else t.size
            batch = self._ordered(columns[:, :end], restart)
            if batch is not None:
                batches.append(batch)
            columns = columns[:, end:]
        return batches

    def _ordered(self, columns: FloatArray, restart: bool) -> Batch | None:
        """Sort late samples, and drop repeated stamps."""
        if restart:
            self.newest = -math.inf
            self.count(resets=1)
        columns = columns[:, np.argsort(columns[0], kind='stable')]
        t = columns[0]
        keep = (np.diff(t, prepend=self.newest) > 0.0) & (t > self.newest)
        columns = columns[:, keep]
        self.count(late=t.size - columns.shape[1], used=columns.shape[1])
        if not columns.size:
            return None
        self.newest = float(columns[0, -1])
        return Batch(columns, restart)

    def _readings(self, batch: Batch) -> list[Batch]:
        """Drop repeats; when they are first recognised, pass on the tail again without them."""
        if batch.restart:
            self._begin_anew()
        whole = np.concatenate([self._tail, batch.columns], axis=1)
        self._since_search += batch.t.size
        self._tail = whole[:, -TAIL:].copy()
        before = self._repeats.period
        if self._since_search >= (_LOOK if self._searched else _ENOUGH):
            self._since_search, self._searched = 0, True
            # With repeats, at least a third of the samples equal the previous one.
            y = self._tail[1]
            if before > 1.0 or float(np.mean(y[1:] == y[:-1])) > _TIED:
                self._repeats.period = refresh_period(y, before)
        if self._repeats.period == 1.0:
            if before > 1.0:
                self._repeats.forget()
            return [batch]
        again = before == 1.0
        if again:
            self._repeats.forget()
            batch = Batch(whole, batch.restart, again=True)
        kept = self._repeats.drop(batch)
        dropped = batch.t.size - (0 if kept is None else kept.t.size)
        self.count(held=dropped, used=-dropped)
        return [] if kept is None else [kept]


def in_order(t: FloatArray, rows: FloatArray, most: float, unit: str = '',
             ) -> tuple[Picked, list[str]]:
    """Return which samples a time line keeps (rows: values up to `most`, (n, m)), and notes."""
    # The comparisons are also false for NaN.
    good = np.isfinite(t) & ((rows <= most) & (rows >= -most)).all(axis=1)
    if good.all() and (t[1:] > t[:-1]).all():
        # Everything is kept: a slice avoids a copy.
        return slice(None), []
    notes: list[str] = []
    if not good.all():
        beyond = bool((np.isfinite(rows[~good]) & (np.abs(rows[~good]) > most)).any())
        notes.append(Note(f'{counted(t.size - int(good.sum()))} dropped: not a finite number'
                          + (f', or beyond {most:g}{unit}.' if beyond else '.'),
                          Defect.NON_FINITE))
    stamps = t[good]
    if (steps := int(np.count_nonzero(stamps[1:] < stamps[:-1]))):
        notes.append(Note(back_words(stamps) or f'{counted(steps)} came after a later stamp: '
                          'sorted by stamp.', Defect.UNORDERED))
    places = np.flatnonzero(good)[np.argsort(stamps, kind='stable')]
    first = np.diff(t[places], prepend=-math.inf) > 0.0
    if not first.all():
        notes.append(Note(f'{counted(int((~first).sum()))} dropped: repeated stamp; '
                          'the first of each was kept.', Defect.REPEATED_STAMPS))
    return places[first], notes


def back_words(t: FloatArray) -> str:
    """Return a note if the clock went back over many samples (t in s), else ''."""
    steps = int(np.count_nonzero(np.diff(t) < 0.0))
    ahead = np.maximum.accumulate(t) - t
    behind = int(np.count_nonzero(ahead))
    if not steps or behind < _STRETCH * steps:
        return ''
    times = 'once' if steps == 1 else f'{steps} times'
    return (f'The clock went back {times}, by {float(ahead.max()):.3g} s at most: '
            f'{counted(behind)} overlap earlier ones and were mixed with them; take a '
            'part before or after, or repair the stamps.')


def as_column(values: npt.ArrayLike) -> FloatArray:
    """Return values as a float64 array of shape (n,); a scalar becomes one sample."""
    return np.atleast_1d(as_numbers(values))


# Minimum number of samples: one more than the two parameters of a straight line.
LEAST_SAMPLES = 3


def check_size(recording: Recording) -> None:
    """Raise InputError if a recording is too short for any estimate."""
    if recording.n < LEAST_SAMPLES:
        raise InputError(f"'{recording.name}' holds {counted(recording.n, 'usable sample')}: "
                         f'nothing can be estimated from fewer than {LEAST_SAMPLES}')
