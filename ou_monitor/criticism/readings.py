"""
Clean the readings of a recording: drop error codes, bad samples and implausible throttle.

Each correction adds a note.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import timing
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import counted, number
from ou_monitor.timeline import in_order, supplied
from scipy.special import chdtri

# Minimum distance of an outlier from the median: in standard deviations, and relative to the next
# smaller distance.
_FAR, _GAP = 50.0, 5.0
# Minimum repeats of an outlying value to be an error code; maximum share of such samples.
_CODE, _MOST_CODES = 3, 0.2
# Maximum number of single bad samples left out; in long recordings, one for each _EACH samples.
_SINGLES, _EACH = 3, 100_000
# Minimum number of other samples if the share of an error code exceeds _MOST_CODES.
_OTHERS = 100
# Maximum number of values used for the spread.
_EXAMINED = 200_000
# A voltage counts as constant if at most this number, or this share, of samples differ.
_ODD, _ODD_SHARE = 3, 1e-3
# Maximum voltage and minimum range, V: fourth powers neither overflow nor vanish.
_LARGEST, _SMALLEST = 1e30, 1e-30
# Median above which volts may be millivolts.
_MILLIVOLTS = 1000.0
# Largest plausible throttle, with trim, and tolerance of the range 0..1; the readers of recordings
# have already converted or refused other units.
_MOST, _EDGE = 1.5, 0.05
# Maximum gap in a current, s; quantile of its absolute value that counts as full load; lags of the
# mean response to a load, s.
_HOLE, _FULL, _LAGS = 1.0, 0.99, np.array([0.02, 0.2, 2.0])
# Probability that an unrelated current is taken as the load if there is no throttle.
_CHANCE = 0.02
# Minimum autocorrelation from which a decay is computed.
_CORRELATED = 0.1
# Two levels of a voltage: minimum distance, in standard deviations about them and in ADC steps;
# minimum switches, samples per switch, and share of the samples at each level.
_APART, _STEPS, _SWITCHES, _DWELL, _SHARE = 5.0, 4.0, 3, 20, 0.05
# Maximum second difference of a voltage that counts as a straight line, in rounding errors.
_ROUNDINGS = 16.0


def usable(recording: Recording, notes: list[str]
           ) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Return the readings of a recording, in order."""
    before = len(recording.notes)
    recording = supplied(recording)
    notes += recording.notes[before:]
    t, v = recording.t, recording.voltage
    u: FloatArray | None = recording.throttle if recording.has_throttle else None
    which, said = in_order(t, v[:, None], float(np.finfo(np.float64).max))
    notes += said
    t, v, u = t[which], v[which], None if u is None else u[which]
    bad = find_bad(v)
    if bad.any():
        notes += bad_notes(t, v, bad)
        t, v, u = t[~bad], v[~bad], None if u is None else u[~bad]
    usual = _quantiles(v[:_EXAMINED], 0.5)[0] if v.size else 0.0
    if _MILLIVOLTS < abs(usual) <= _LARGEST:
        notes.append(f'The voltage is near {number(usual)}: taken as volts. If it is in '
                     'millivolts or counts of the ADC, every result in V is wrong by that factor; '
                     'give it in volts.')
    if u is not None:
        u = _fill_gaps(t, _drop_implausible(u, notes), notes) if np.isfinite(u).any() else None
    return t, v, u


def current_at(recording: Recording, t: FloatArray) -> FloatArray | None:
    """Return the current at some stamps, s, in A; None if it has large gaps."""
    if recording.current is None:
        return None
    known = np.isfinite(recording.current) & np.isfinite(recording.t)
    if not known.any():
        return None
    order = np.argsort(recording.t[known], kind='stable')
    stamps, current = recording.t[known][order], recording.current[known][order]
    after = np.searchsorted(stamps, t)
    near = np.minimum(np.abs(t - stamps[np.minimum(after, stamps.size - 1)]),
                      np.abs(t - stamps[np.maximum(after - 1, 0)]))
    if near.max() > max(_HOLE, 3.0 * float(np.median(np.diff(t)))):
        return None
    return np.asarray(np.interp(t, stamps, current), dtype=np.float64)


def load_of(recording: Recording, t: FloatArray, v: FloatArray, u: FloatArray | None,
            notes: list[str]) -> tuple[FloatArray | None, float]:
    """Return the load, and the current at which it is 1, A; NaN if the load is throttle."""
    # t in s, v in V.  The current (divided by its 99 % quantile) is the load unless throttle
    # predicts the voltage clearly better.
    moved: list[str] = []
    if u is not None:
        u, _ = on_time(t, v, u, 'throttle', moved)
    current = current_at(recording, t)
    if current is None or not float(np.ptp(current)) > 0.0:
        notes += moved
        return u, NAN
    said: list[str] = []
    current, sign = on_time(t, v, current, 'current', said)
    full = sign * float(np.quantile(np.abs(current), _FULL))
    some = _part(v)
    gain = _gain(t[some], v[some], current[some]) - (
        0.0 if u is None else _gain(t[some], v[some], u[some]))
    limit = 0.5 * _LAGS.size * math.log(v.size)
    # Without throttle, any clear relation is enough: causes that need a load are tested later.
    least = 0.5 * float(chdtri(2 + _LAGS.size, _CHANCE)) if u is None else -limit
    if not full or gain < least:
        notes += moved
        return u, NAN
    why = 'throttle was not recorded' if u is None else (
        f'it predicts the voltage better than throttle, by {number(gain)} nats' if gain > limit
        else 'it predicts the voltage as well as throttle')
    notes += [f'The load is the measured current ({why}). Parameters are for a load of 1, which '
              f'is {number(full)} A.', *said]
    return current / full, full


def _part(v: FloatArray) -> slice:
    """Return the samples that are examined."""
    return slice(None, None, -(-v.size // _EXAMINED))


def on_time(t: FloatArray, v: FloatArray, load: FloatArray, name: str, notes: list[str]
            ) -> tuple[FloatArray, float]:
    """Return a load with late stamps corrected, and its sign; note the correction."""
    # If the voltage seems to precede its load, the stamps of the load are late.  If the voltage
    # lags behind its load, the cause is `load_transient`.
    some = _part(v)
    late, sign = timing(t[some], v[some], load[some])
    if not late > 0.0 or (name == 'throttle' and sign < 0.0):
        return load, sign
    notes.append(f'The voltage responds {number(1e3 * late)} ms before the {name}: the stamps of '
                 f'the {name} are late, and were corrected.')
    return np.asarray(np.interp(t + late, t, load)), sign


def _gain(t: FloatArray, v: FloatArray, load: FloatArray) -> float:
    """Return the gain in log-likelihood from a load, its square and its lags, nats."""
    lags = [lowpass(load, t, tau) for tau in _LAGS[_LAGS > float(np.median(np.diff(t)))].tolist()]
    columns = np.stack([load, load * load, *lags])
    columns = columns - columns.mean(axis=1, keepdims=True)
    spread = columns.std(axis=1)
    trend = np.stack([np.ones(t.size), (t - t.mean()) / max(float(np.ptp(t)), 1e-300)])
    both = np.concatenate((trend, columns[spread > 0.0] / spread[spread > 0.0, None]))
    # The noise is modelled as an AR(1) with the coefficient of its slowest part, so that a
    # wandering level is not mistaken for a response.
    without, left = (_rest(v, x, 0.0) for x in (trend, both))
    slow = _slowest(left)
    alone = min(_squares(v, trend, phi) for phi in (slow, _slowest(without)))
    beside = _squares(v, both, slow)
    return 0.5 * v.size * math.log(max(alone, 1e-300) / max(beside, 1e-9 * alone, 1e-300))


def _rest(v: FloatArray, columns: FloatArray, phi: float) -> FloatArray:
    """Return the residual of a regression whose two sides are whitened by an AR(1)."""
    x, y = columns[:, 1:] - phi * columns[:, :-1], v[1:] - phi * v[:-1]
    beta = np.linalg.lstsq(x @ x.T, x @ y, rcond=1e-9)[0]
    return np.asarray(y - beta @ x)


def _squares(v: FloatArray, columns: FloatArray, phi: float) -> float:
    return float(np.sum(_rest(v, columns, phi) ** 2))


def _slowest(rest: FloatArray) -> float:
    """Return the coefficient per sample of the slowest decay of an autocorrelation."""
    found, m, whole = 0.0, 1, float(rest @ rest)
    while 8 * m < rest.size and (now := float(rest[m:] @ rest[:-m])) > _CORRELATED * whole:
        later = float(rest[2 * m:] @ rest[:-2 * m])
        found = max(found, max(later / now, 0.0) ** (1.0 / m))
        m *= 2
    return min(found, 1.0)


def find_bad(v: FloatArray, singles: int = _SINGLES) -> npt.NDArray[np.bool_]:
    """Return which samples are error codes or glitches (v in V; singles: their maximum number)."""
    bad = np.zeros(v.size, dtype=np.bool_)
    some = v[::max(1, v.size // _EXAMINED)]
    if some.size < 2:
        return bad
    off = _off_value(some)
    if off is not None:
        bad[v == off] = True
        bad[~bad] = find_bad(v[~bad], singles)
        return bad
    low, middle, high = _quantiles(some, 0.2, 0.5, 0.8)
    if low == high:
        low, high = _quantiles(some, 0.05, 0.95)
    # Standard deviation of a normal distribution whose inner 60 % spans this range.
    spread = (high - low) / 1.683
    with np.errstate(over='ignore'):
        away = np.abs(v - middle)
    if not spread > 0.0 or not (away > _FAR * spread).any():
        return bad
    far = np.flatnonzero(away > _FAR * spread)
    reach = float(away[away <= _FAR * spread].max())
    order = far[np.argsort(away[far], kind='stable')]
    before = np.concatenate(([reach], away[order][:-1]))
    alone = np.flatnonzero(away[order] > _GAP * before)
    if not alone.size:
        return bad
    far = order[alone[0]:]
    values, which, count = np.unique(v[far], return_inverse=True, return_counts=True)
    code = (count >= _CODE)[which]
    single = far[~code]
    if int(code.sum()) <= _MOST_CODES * v.size:
        bad[far[code]] = True
    if single.size <= max(singles, v.size // _EACH):
        bad[single] = True
    return bad


def _off_value(v: FloatArray) -> float | None:
    """Return the frequent value, if any, that is far from all other samples."""
    values, count = np.unique(v, return_counts=True)
    value = float(values[count.argmax()])
    others = v[v != value]
    if int(count.max()) <= _MOST_CODES * v.size or others.size < _OTHERS:
        return None
    low, middle, high = _quantiles(others, 0.2, 0.5, 0.8)
    away = np.abs(others - middle)
    near = away[away <= _FAR * (high - low) / 1.683]
    reach = max(_FAR * (high - low) / 1.683, _GAP * float(near.max()))
    return value if high > low and abs(value - middle) > reach else None


def _quantiles(v: FloatArray, *shares: float) -> list[float]:
    """Return quantiles without interpolation, which might overflow."""
    at = [round(share * (v.size - 1)) for share in shares]
    found: list[float] = np.partition(v, at)[at].tolist()
    return found


def bad_notes(t: FloatArray, v: FloatArray, bad: npt.NDArray[np.bool_]) -> list[str]:
    """Return notes on bad samples (t in s, v in V)."""
    rest = f'while all others lie within {_range(v[~bad])} V'
    values, count = np.unique(v[bad], return_counts=True)
    notes = [f'{many} samples read exactly {_short(value)} V, {rest}: taken as an error code, or '
             'as the supply being off, and left out.'
             for value, many in zip(values.tolist(), count.tolist()) if many >= _CODE]
    single = np.flatnonzero(bad & np.isin(v, values[count < _CODE]))
    if single.size:
        where = ', '.join(f'{_short(float(v[k]))} V at {number(float(t[k] - t[0]), 4)} s'
                          for k in single[:_SINGLES])
        more = '' if single.size <= _SINGLES else f' and {single.size - _SINGLES} more'
        notes.append(f'{counted(single.size, "bad sample")} left out: {where}{more}, {rest}. '
                     'Glitches of the sensor or the bus, and short dips, look like this.')
    return notes


def _range(v: FloatArray) -> str:
    return f'{_short(float(v.min()))} to {_short(float(v.max()))}'


def _short(value: float) -> str:
    return f'{value:.6g}'


def two_levels(v: FloatArray) -> str:
    """Return the note for a voltage without a load that switches between two levels, or ''."""
    ordered = np.sort(v[np.isfinite(v)])
    sums, count = np.cumsum(ordered)[:-1], np.arange(1.0, ordered.size)
    # Otsu's split of the values.
    low, high = sums / count, (ordered.sum() - sums) / (ordered.size - count)
    between = count * (ordered.size - count) * (high - low) ** 2
    k = int(np.argmax(between)) if between.any() else 0
    if not _SHARE < k / max(v.size, 1) < 1.0 - _SHARE:
        return ''
    apart, steps = float(high[k] - low[k]), np.diff(ordered)
    within = math.sqrt(max(0.0, float(ordered.var() - between[k] / ordered.size ** 2)))
    # Leave out transitions between the levels.
    there = v[np.abs(v - 0.5 * (low[k] + high[k])) > 0.25 * apart] > ordered[k]
    switches = int(np.count_nonzero(np.diff(there)))
    least = max(_APART * within, _STEPS * float(steps[steps > 0.0].min()))
    if not (least < apart and _SWITCHES <= switches < v.size / _DWELL):
        return ''
    return (f'The voltage switches between two levels, {number(float(low[k]), 4)} and '
            f'{number(float(high[k]), 4)} V: a column of the load (--current-column or '
            '--throttle-column) would explain it; without one, it counts as noise and lines.')


def why_stuck(v: FloatArray) -> str:
    """Return why the sensor seems to be stuck at one reading, V; empty if it does not."""
    if float(v.min()) == float(v.max()):
        return ('The voltage does not change at all: the sensor is stuck, or its step is larger '
                'than the noise.')
    usual = _quantiles(v, 0.5)[0]
    odd = int((v != usual).sum())
    if odd <= max(_ODD, _ODD_SHARE * v.size):
        return (f'All but {odd} of its {v.size} samples read {_short(usual)} V: the sensor is '
                'stuck, or its step is larger than the noise.')
    return ''


def why_no_model(v: FloatArray) -> str:
    """Return why no model can be fitted to voltages, V; empty if one can."""
    if stuck := why_stuck(v):
        return stuck
    largest = float(np.abs(v).max())
    if largest > _LARGEST:
        return f'The voltage reaches {_short(largest)} V: no supply does; check its unit.'
    if float(v.max()) - float(v.min()) < _SMALLEST:
        return (f'The voltage moves by only {_short(float(v.max()) - float(v.min()))} V: no '
                'sensor resolves that; check its unit.')
    if float(np.abs(np.diff(v, 2)).max(initial=0.0)) <= _ROUNDINGS * 2.3e-16 * largest:
        return 'The voltage is a straight line without any noise: there is nothing to simulate.'
    return ''


def _drop_implausible(u: FloatArray, notes: list[str]) -> FloatArray:
    """Return throttle with NaN where it is far outside 0..1; note all values outside."""
    with np.errstate(invalid='ignore'):
        wild = np.abs(u) > _MOST
    if wild.any():
        notes.append(f'Throttle is far outside its range at {counted(int(wild.sum()), "sample")}: '
                     'taken as unknown there.')
        u = np.where(wild, np.nan, u)
    known = u[np.isfinite(u)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 1.0)
    if low < -_EDGE or high > 1.0 + _EDGE:
        notes.append(f'Throttle lies within {number(low)} to {number(high)}, not 0 to 1: used '
                     'as it is.')
    return u


def _fill_gaps(t: FloatArray, u: FloatArray, notes: list[str]) -> FloatArray | None:
    """Return throttle with the last value held over gaps; note their size."""
    there = np.isfinite(u)
    known = np.flatnonzero(there)
    if not known.size:
        return None
    if known.size == u.size:
        return u
    step = np.diff(t, append=t[-1])
    total = float(step[~there].sum())
    # Lengths of the gaps: unknown time between known samples.
    lost = np.concatenate(([0.0], np.cumsum(np.where(there, 0.0, step))))
    ends = lost[np.concatenate((known, [u.size]))]
    longest = float(np.diff(ends, prepend=0.0).max())
    notes.append(
        f'Throttle is unknown at {counted(u.size - known.size, "sample")} ({number(total)} of '
        f'{number(float(t[-1] - t[0]))} s, the longest gap {number(longest)} s): the last '
        'known value is held there' + ('' if there[0] else
                                       ', and the first known one at the start')
        + '. If throttle moved meanwhile, findings about throttle are wrong.')
    at = np.searchsorted(known, np.arange(u.size), side='right') - 1
    return u[known[np.maximum(at, 0)]]
