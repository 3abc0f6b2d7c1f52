"""
Clean the readings of a recording: drop error codes, bad samples and implausible throttle.

Each correction adds a note.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import lowpass
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import counted, number
from ou_monitor.timeline import in_order, MOST_THROTTLE, plausible, supplied
from scipy.special import chdtri

# Minimum distance of an outlier from the median: in standard deviations, and relative to the next
# smaller distance.
_FAR, _GAP = 50.0, 5.0
# Minimum repeats of an outlying value to be an error code; maximum share of such samples.
_CODE, _MOST_CODES = 3, 0.2
# Maximum number of single bad samples left out; in long recordings, one for each _EACH samples.
_SINGLES, _EACH = 3, 100_000
# Maximum number of values used for the spread.
_EXAMINED = 200_000
# A voltage counts as constant if at most this number, or this share, of samples differ.
_ODD, _ODD_SHARE = 3, 1e-3
# Maximum voltage and minimum range, V: fourth powers neither overflow nor vanish.
_LARGEST, _SMALLEST = 1e30, 1e-30
# Median above which volts may be millivolts.
_MILLIVOLTS = 1000.0
# Tolerance of the range 0..1 of throttle; the readers of recordings have converted or refused
# other units.
_EDGE = 0.05
# Maximum gap in a current, s; quantile of its absolute value that counts as full load; lags of the
# mean response to a load, s.
_HOLE, _FULL, _LAGS = 1.0, 0.99, np.array([0.02, 0.2, 2.0])
# Search for the delay of the load: number of shifts tried to each side, and maximum delay, s.
_SHIFTS, _LATEST = 10, 0.2
_PAYS = 0.95  # Ratio to which a delay must reduce the squared residuals
_SLOWER = 1.0  # Time constant of the high-pass that removes trends, s
_LATE = 0.06  # Time constant of the low-pass for the second regressor, s
# Probability that an unrelated current is taken as the load if there is no throttle.
_CHANCE = 0.02
# Minimum autocorrelation from which a decay is computed.
_CORRELATED = 0.1
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
        u = plausible(u, MOST_THROTTLE)
        low, high = (float(np.nanmin(u)), float(np.nanmax(u))) if np.isfinite(u).any() else (0, 1)
        if low < -_EDGE or high > 1.0 + _EDGE:
            notes.append(f'Throttle lies within {number(low)} to {number(high)}, not 0 to 1: used '
                         'as it is.')
        u = _fill_gaps(t, u, notes)
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
    return slice(None, None, -(-v.size // _EXAMINED))


def on_time(t: FloatArray, v: FloatArray, load: FloatArray, name: str, notes: list[str],
            stop: int | None = None) -> tuple[FloatArray, float]:
    """Return a load with late stamps corrected, and its sign; note the correction."""
    # stop: number of samples that may be used to find both; the rest is held out.
    # If the voltage seems to precede its load, the stamps of the load are late.  If the voltage
    # lags behind its load, the cause is `load_transient`.
    some = slice(None, stop, _part(v[:stop]).step)
    late, sign = timing(t[some], v[some], load[some])
    if not late > 0.0 or (name == 'throttle' and sign < 0.0):
        return load, sign
    notes.append(f'The voltage responds {number(1e3 * late)} ms before the {name}: the stamps of '
                 f'the {name} are late, and were corrected.')
    return np.asarray(np.interp(t + late, t, load)), sign


def timing(t: FloatArray, v: FloatArray, load: FloatArray) -> tuple[float, float]:
    """Return the delay of a load, s, and 1 if voltage falls when the load rises, else -1."""
    # Shifts are counted in tenths of the sampling step.
    dt = float(np.median(np.diff(t)))
    unit = dt / _SHIFTS
    slow = min(_SLOWER, 0.3 * float(t[-1] - t[0]))
    left = v - lowpass(v, t, slow)
    late = lowpass(load, t, _LATE)
    loads = np.stack((load, late)) - lowpass(load, t, slow)

    def fit(order: int, *shifts: int) -> tuple[float, float]:
        """Return the squared residuals of `order`-th differences, and product load * voltage."""
        # X: the mean of the load over the shifts.
        X = np.diff(np.mean([[np.interp(t + shift * unit, t, row) for row in loads]
                             for shift in shifts], axis=0), order)
        y = np.diff(left, order)
        product = X @ y
        return float(y @ y - product @ np.linalg.lstsq(
            X @ X.T, product, rcond=1e-9)[0]), float(product[0])

    found: dict[int, tuple[float, float]] = {}
    coarse, best = max(1, math.ceil(_LATEST / dt / _SHIFTS)), 0
    for by in (coarse, math.ceil(coarse / _SHIFTS)):
        for k in range(-_SHIFTS, _SHIFTS + 1):
            shift = best + k * by * _SHIFTS
            if shift not in found and abs(shift) * unit <= _LATEST:
                found[shift] = fit(0, shift)
        best = min(sorted(found, key=abs), key=lambda shift: found[shift][0])
    # A best shift at the end of the range is not a minimum.
    inside = abs(best) < max(found)
    best = best if inside and found[best][0] < _PAYS * found[0][0] else 0
    # A delay wrong by half a sample leaves glitch-like errors at steep changes of the load.  But a
    # shift by part of a sample also smooths a noisy load.  So the shifted load must fit better
    # than its mean with the oppositely shifted load, which is equally smooth.
    fine = {k: fit(1, best + k)[0] for k in range(-_SHIFTS, _SHIFTS + 1)}
    k = min(sorted(fine, key=abs), key=lambda k: fine[k])
    pays = min(fine[0], fit(1, best + k, best - k)[0]) > fine[k] * t.size ** (1.0 / t.size)
    return (best + k * pays) * unit, -1.0 if found[best][1] > 0.0 else 1.0


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


def _quantiles(v: FloatArray, *shares: float) -> list[float]:
    """Return quantiles without interpolation, which might overflow."""
    at = [round(share * (v.size - 1)) for share in shares]
    found: list[float] = np.partition(v, at)[at].tolist()
    return found


def bad_notes(t: FloatArray, v: FloatArray, bad: npt.NDArray[np.bool_],
              left_out: str = 'left out') -> list[str]:
    """Return notes on bad samples (t in s, v in V; left_out: what was done with them)."""
    low, high = float(v[~bad].min()), float(v[~bad].max())
    rest = f'while all others lie within {_short(low)} to {_short(high)} V'
    values, count = np.unique(v[bad], return_counts=True)
    notes = [f'{many} samples read exactly {_short(value)} V, {rest}: taken as an error code, or '
             f'as the supply being off, and {left_out}.'
             for value, many in zip(values.tolist(), count.tolist()) if many >= _CODE]
    single = np.flatnonzero(bad & np.isin(v, values[count < _CODE]))
    if single.size:
        where = ', '.join(f'{_short(float(v[k]))} V at {number(float(t[k] - t[0]), 4)} s'
                          for k in single[:_SINGLES])
        more = '' if single.size <= _SINGLES else f' and {single.size - _SINGLES} more'
        notes.append(f'{counted(single.size, "bad sample")} {left_out}: {where}{more}, {rest}. '
                     'Glitches of the sensor or the bus, and short dips, look like this.')
    return notes


def _short(value: float) -> str:
    return f'{value:.6g}'


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


def _fill_gaps(t: FloatArray, u: FloatArray, notes: list[str]) -> FloatArray | None:
    """Return throttle with the last value held over gaps, or the first one at the start."""
    there = np.isfinite(u)
    if there.all() or not there.any():
        return u if there.all() else None
    unknown = float(np.diff(t, append=t[-1])[~there].sum())
    notes.append(
        f'Throttle is unknown at {counted(int((~there).sum()), "sample")} ({number(unknown)} of '
        f'{number(float(t[-1] - t[0]))} s): the last known value is held there. If throttle moved '
        'meanwhile, findings about throttle are wrong.')
    first = int(np.argmax(there))
    return u[np.maximum.accumulate(np.where(there, np.arange(u.size), first))]
