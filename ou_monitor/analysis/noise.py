"""
Noise of a recording, by regression of the voltage on level, throttle and current; and dips.

Noise is the residual of that regression (`ou_monitor.model.ou_fit`), fitted minute by minute.  In
all commands, a dip ends when a reading exceeds the limit by more than a hysteresis: the noise at
steady throttle or the step of the ADC, whichever is larger.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.adc import find_step
from ou_monitor.criticism.readings import bad_notes, find_bad
from ou_monitor.model.ou_fit import FEWEST, regress
from ou_monitor.model.whittle import ABSORBED_AT, absorbed_by
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.timeline import (
    in_order, MOST_THROTTLE, MOST_VOLTAGE, part_of, plausible, readings_of, supplied)
from scipy.ndimage import maximum_filter1d, minimum_filter1d

# Throttles at which sag and noise are given.
THROTTLES = tuple(k / 10.0 for k in range(11))
# Length of a part with its own regression, s, and its minimum number of readings: five times the
# number of regressors in 60 s.
_PART, _IN_PART = 60.0, 200
# Maximum shift of the current against the voltage, s.
_LATE = 0.06
# Maximum range of throttle that counts as steady, and the time over which the range is taken, s.
_STEADY, _STEADY_TIME = 0.02, 0.2
# Maximum share of readings left out as outliers ("wild"); if more are far off, none is left out.
_WILD = 0.01
# Half width of the band of throttle about each of THROTTLES; minimum readings in it.
BAND, _IN_BAND = 0.05, 10
# Minimum time covered by these readings, s, or share of the recording, whichever is shorter.
_IN_TIME, _IN_SHARE = 0.5, 0.02


@dataclass(frozen=True)
class Noise:
    """Rms of the voltage that the load does not explain, over throttle."""

    throttle: tuple[float, ...]  # 0..1
    rms_v: tuple[float, ...]  # in flight, including changes of throttle, V
    steady_rms_v: tuple[float, ...]  # at steady throttle, V
    flown: tuple[float, float]  # 1 % and 99 % quantile of throttle


def floats(values: FloatArray) -> tuple[float, ...]:
    """Return an array as a tuple."""
    return tuple(float(x) for x in values)


def rise_at(recording: Recording, t: FloatArray) -> FloatArray:
    """Return the hysteresis of dips in `supply_facts`, V, at given stamps, s."""
    which, _ = in_order(recording.t, recording.voltage[:, None], MOST_VOLTAGE)
    recording = part_of(recording, which)
    if recording.n < 2:
        return np.zeros(t.size)
    recording = readings_of(replace(
        recording, throttle=plausible(recording.throttle, MOST_THROTTLE)))
    there, outer = supplied(recording), supplied(recording, at_ends=True)
    rise = rise_that_ends(
        outer.voltage, outer.throttle, noise_of(*without_wild(there, remainder(there))))
    return np.asarray(np.interp(t, outer.t, rise))


def rise_that_ends(v: FloatArray, u: FloatArray, noise: Noise) -> FloatArray:
    """Return the hysteresis of a dip, V, at each reading: the larger of ADC step and noise."""
    rms, throttle = np.array(noise.steady_rms_v), np.array(THROTTLES)
    known = np.isfinite(rms)
    steady = np.interp(np.nan_to_num(u), throttle[known], rms[known]) if known.any() else 0.0
    return np.asarray(np.maximum(find_step(v), np.full(u.shape, steady)))


def is_below(v: FloatArray, limit: float) -> npt.NDArray[np.bool_]:
    """Return which readings are below a limit by more than the rounding error of a float32."""
    return v < limit - 2.0 ** -23 * abs(limit)


def dip_begins(v: FloatArray, limit: float, rise: FloatArray) -> npt.NDArray[np.intp]:
    """Return the indices at which dips below a limit begin."""
    below = is_below(v, limit)
    # Ignore readings within the hysteresis: a dip begins where a reading above is followed by one
    # below.
    decides = np.flatnonzero(below | (v > limit + rise))
    return np.asarray(decides[below[decides] & np.append(True, ~below[decides[:-1]])])


@dataclass(frozen=True, eq=False)
class Remainder:
    """The voltage of a recording without level and load, regressed part by part."""

    voltage: FloatArray  # V, corrected for degrees of freedom; NaN near gaps
    size: FloatArray  # size of the noise relative to its rms in the part
    dt: float  # median step, s
    walk: float  # median random walk of the level, V/sqrt(s)
    above: float = 0.0  # lowest frequency that the level has not absorbed, Hz
    absorbed: FloatArray | None = None  # `absorbed_by` of the regressions, per reading


def remainder(recording: Recording) -> Remainder:
    """Subtract level and load from the voltage of a recording."""
    t, n = recording.t, recording.n
    left, size, steps, walks, above = np.full(n, NAN), np.ones(n), [], [], 0.0
    absorbed, used = np.zeros(ABSORBED_AT.size), 0
    edges: list[int] = [] if not n else np.searchsorted(t, np.linspace(
        t[0], t[-1], 1 + max(1, min(round(float(t[-1] - t[0]) / _PART), n // _IN_PART)))[1:-1]
                                                ).tolist()
    for begin, end in zip([0, *edges], [*edges, n]):
        if end - begin < FEWEST:
            continue
        cut = slice(begin, end)
        part = regress(t[cut], recording.voltage[cut], recording.throttle[cut],
                       None if recording.current is None else recording.current[cut], _LATE)
        if part.free >= FEWEST:
            left[begin + part.places] = part.voltage * math.sqrt(part.places.size / part.free)
            size[begin + part.places] = part.size
            steps.append(part.dt)
            walks.append(part.walk)
            above = max(above, 0.5 / part.slowest)
            absorbed += absorbed_by(part.basis)
            used += part.places.size
    return Remainder(left, size, float(np.median(steps)) if steps else NAN,
                     float(np.median(walks)) if walks else NAN, above,
                     absorbed / max(used, 1))


def without_wild(recording: Recording, left: Remainder) -> tuple[Recording, Remainder]:
    """Return a recording without outliers of its remainder, and the new remainder."""
    known = np.flatnonzero(np.isfinite(left.voltage))
    wild = known[find_bad(left.voltage[known], int(_WILD * known.size))]
    if not wild.size:
        return recording, left
    bad = np.zeros(recording.n, dtype=np.bool_)
    bad[wild] = True
    recording = part_of(recording, ~bad, *bad_notes(
        recording.t, recording.voltage, bad, 'left out, except from lowest voltage and dips'))
    return recording, remainder(recording)


def noise_of(recording: Recording, left: Remainder | None = None) -> Noise:
    """Return the noise over throttle; left: the recording's `remainder`."""
    u, square = recording.throttle, (left or remainder(recording)).voltage ** 2
    known, flown = u[np.isfinite(u)], (NAN, NAN)
    if known.size:
        flown = float(np.quantile(known, 0.01)), float(np.quantile(known, 0.99))
    seen = np.isfinite(square)
    if not seen.any():
        unknown = (NAN,) * len(THROTTLES)
        return Noise(THROTTLES, unknown, unknown, flown)
    if not math.isfinite(flown[0]):
        rms = (math.sqrt(float(square[seen].mean())),) * len(THROTTLES)
        return Noise(THROTTLES, rms, rms, flown)
    still = _still(recording.t, u)
    enough = _needed_readings(recording)
    return Noise(THROTTLES, _over_throttle(u[seen], square[seen], enough),
                 _over_throttle(u[seen & still], square[seen & still], enough, NAN), flown)


def _still(t: FloatArray, u: FloatArray) -> npt.NDArray[np.bool_]:
    """Return where throttle has been steady for `_STEADY_TIME`."""
    held = np.nan_to_num(u, nan=-1.0)
    count = max(1, math.ceil(_STEADY_TIME / max(float(np.median(np.diff(t))), 1e-9)))
    if count + 1 >= t.size:
        return np.full(t.size, bool(np.ptp(held) <= _STEADY))
    # The window ends at each reading.
    behind = {'size': count + 1, 'origin': count // 2}
    span = maximum_filter1d(held, **behind) - minimum_filter1d(held, **behind)
    return np.asarray(span <= _STEADY)


def flown_near(recording: Recording, throttle: npt.ArrayLike, reach: float = BAND,
               ) -> npt.NDArray[np.bool_]:
    """Return whether there are enough readings within `reach` of throttles, shape (k,)."""
    enough = _needed_readings(recording)
    return np.array([np.count_nonzero(np.abs(recording.throttle - u) <= reach) >= enough
                     for u in np.atleast_1d(throttle)])


def _needed_readings(recording: Recording) -> float:
    """Return how many readings near a throttle show that it was flown."""
    share = min(_IN_TIME / max(recording.duration, 1e-9), _IN_SHARE)
    return max(_IN_BAND, share * recording.n)


def _over_throttle(u: FloatArray, square: FloatArray, enough: float,
                   beyond: float | None = None) -> tuple[float, ...]:
    """Return rms, V, at THROTTLES; outside the flown ones, `beyond`, or the nearest if None."""
    at, rms = [], []
    for throttle in THROTTLES:
        near = np.abs(u - throttle) <= BAND
        if near.sum() >= enough:
            at.append(float(throttle))
            rms.append(math.sqrt(float(square[near].mean())))
    return floats(np.interp(THROTTLES, at, rms, left=beyond, right=beyond)) if at else (
        (NAN,) * len(THROTTLES))
