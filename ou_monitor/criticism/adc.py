"""
Effects of the ADC on the readings: steps, clipping, repeats.

Ties (equal neighbours) have probability zero in a diffusion, so these effects need no model.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from ou_monitor.timeline import new_readings

# Maximum number of values used to find the step and clipping.
EXAMINED = 200_000
# Relative rounding error of the difference of two float32.
_FLOAT32 = 2.5e-7
# Minimum share of the samples that lie on the grid of codes; maximum distance from it, steps.
_SHARE, _NEAR = 0.99, 0.1
# Minimum step of the ADC, in units of the last printed digit (below two, every value is near a
# code); minimum number of gaps between codes; numbers of decimals tried.
_SPARSE, _FEWEST_CODES = 2.0, 4
_DECIMALS = range(7)
# Minimum number of equal changes in `usual_change`: without ADC codes, no two changes are equal.
_AGAIN = 20
# Clipping: minimum samples at the limit, visits to it, and excess over neighbouring codes in
# standard errors.
_LEAST, _VISITS, _CLEAR = 8, 3, 5.0
# Maximum number of codes by which noise added after clipping raises a reading.
_LIFTED = 2
# Maximum step, in standard deviations of the noise, at which the counts of neighbouring codes
# follow a smooth density.
_COARSE = 2.0
# Number of throttle ranges, each with its own noise; maximum throttle at idle, above the lowest.
_LOADS, _STILL = 8, 0.01


def find_step(voltage: FloatArray) -> float:
    """Return the step of the grid on which the values lie, V; 0 if none is found."""
    v = voltage[:EXAMINED]
    if v.size > 16:
        # The extremes may be clipped off the grid.
        inner = v[(v > v.min()) & (v < v.max())]
        v = inner if np.unique(inner).size > 2 else v
    values, counts = np.unique(v, return_counts=True)
    rounding = _FLOAT32 * float(np.abs(values).max(initial=0.0))
    begins = np.concatenate(([0], np.flatnonzero(np.diff(values) > rounding) + 1))
    if begins.size < 2 or begins.size > 0.5 * v.size:
        return 0.0
    weight = np.add.reduceat(counts, begins).astype(np.float64)
    codes = np.add.reduceat(values * counts, begins) / weight
    gaps = np.diff(codes)
    for first in (float(gaps.min()), float(np.median(gaps))):
        step = _refine_step(codes, gaps, weight, first)
        if step > 8.0 * rounding:
            return step
    return _unprinted(codes, gaps, weight)


def usual_change(voltage: FloatArray) -> float:
    """Return the most frequent change, V; 0 if no change is frequent."""
    # If an offset was added at times, the codes are not on a grid, but most changes are.
    rounding = 2.0 * _FLOAT32 * float(np.abs(voltage).max())
    size = np.sort(np.abs(np.diff(voltage[:EXAMINED])))
    size = size[size > rounding]
    # `same` counts the sizes equal within rounding, `near` those within ten times that distance.
    # `same` must be most of `near`: sizes of a smooth line are close too, but evenly spread.
    same, near = (np.searchsorted(size, size + by * rounding, 'right')
                  - np.searchsorted(size, size - by * rounding) for by in (0.5, 5.0))
    count = np.where(2 * same > near, same, 0)
    return float(size[count.argmax()]) if count.max(initial=0) >= _AGAIN else 0.0


def _unprinted(codes: FloatArray, gaps: FloatArray, weight: FloatArray) -> float:
    """Return the step of an ADC whose codes were printed with few decimals, V; 0 for none."""
    printed = next((10.0 ** -k for k in _DECIMALS if float(np.abs(
        codes * 10.0 ** k - np.rint(codes * 10.0 ** k)).max()) < 1e-3), 0.0)
    # In the middle of the distribution, every code occurs.
    middle = np.cumsum(weight) / weight.sum()
    dense = (middle[:-1] > 0.1) & (middle[1:] < 0.9)
    if not printed or int(dense.sum()) < _FEWEST_CODES:
        return 0.0
    first = float(gaps[dense].mean())
    if first < _SPARSE * printed:
        return 0.0
    step = _refine_step(codes, gaps, weight, first, 0.55 * printed)
    return step if step >= _SPARSE * printed else 0.0


def _refine_step(codes: FloatArray, gaps: FloatArray, weight: FloatArray, first: float,
                 near: float = 0.0) -> float:
    """Return the step near `first` that fits the codes within `near`, V; 0 if none does."""
    step = float(gaps[gaps < 1.5 * first].mean())
    number = np.concatenate(([0.0], np.cumsum(np.rint(gaps / step))))
    middle = float(weight @ number) / float(weight.sum())
    spread = float(weight @ (number - middle) ** 2)
    if not spread > 0.0:
        return 0.0
    step = float(weight @ ((number - middle) * codes)) / spread
    level = float(weight @ codes) / float(weight.sum())
    off = np.abs(codes - level - step * (number - middle))
    return step if weight[off < max(near, _NEAR * step)].sum() >= _SHARE * weight.sum() else 0.0


def innovation_std(v: FloatArray) -> float:
    """Return the standard deviation of the error of an AR(1) prediction, V, without outliers."""
    a, b = v[:-1] - v[:-1].mean(), v[1:] - v[1:].mean()
    e = b - float(a @ b) / max(float(a @ a), 1e-300) * a
    # Clip the errors at events and load steps.
    middle = float(np.quantile(np.abs(e), 0.95))
    return float(np.minimum(np.abs(e), middle).std()) if middle == 0.0 else float(
        np.sqrt(np.mean(np.square(np.clip(e, -middle, middle)))) / 0.8729)


def step_words(step: float, noise: float) -> str:
    """Return a note on the step of the ADC and the noise between samples, V."""
    return (f'The voltage resolution is {1e3 * step:.3g} mV ({step / noise:.2g} times the noise '
            'between samples).')


def find_rails(voltage: FloatArray, step: float, noise: float,
               throttle: FloatArray | None = None) -> tuple[float, float]:
    """Return the readings at which the ADC clips, V; infinite if it does not (inputs in V)."""
    if step > _COARSE * noise:
        return -math.inf, math.inf
    noisy = _at_noisy_throttle(voltage, step, throttle)
    return -_clipping_limit(-voltage, step, noisy), _clipping_limit(voltage, step, noisy)


def _at_noisy_throttle(voltage: FloatArray, step: float, throttle: FloatArray | None
                       ) -> npt.NDArray[np.bool_]:
    """Return the samples at throttles whose noise spans several codes."""
    # A quiet rail at idle may stay within the top code without clipping.
    if throttle is None or not step > 0.0:
        return np.ones(voltage.size, dtype=bool)
    edges = np.unique(np.quantile(throttle, np.arange(1, _LOADS) / _LOADS))
    load = np.where(_idle(throttle), edges.size + 1, np.searchsorted(edges, throttle))
    change, same = np.diff(voltage), load[1:] == load[:-1]
    of = load[1:][same]
    count = np.maximum(np.bincount(of, minlength=edges.size + 2), 1)
    power = np.bincount(of, weights=change[same] ** 2, minlength=edges.size + 2) / count
    return np.asarray(step <= _COARSE * np.sqrt(power))[load]


def _idle(throttle: FloatArray) -> npt.NDArray[np.bool_]:
    return np.asarray(throttle <= throttle.min() + _STILL)


def _leans_up(below: FloatArray, codes: int, step: float) -> bool:
    """Return whether the fullest of the top codes has more samples just above than just below."""
    # Noise after clipping lowers as many readings as it raises.
    count = [int((np.abs(below - k * step) < 0.5 * step).sum()) for k in range(codes + 1)]
    full = max(range(codes), key=lambda k: count[k])
    return full > 0 and count[full - 1] > count[full + 1]


def _clipping_limit(x: FloatArray, step: float, noisy: npt.NDArray[np.bool_]) -> float:
    """Return the top reading if it is more frequent than its neighbours predict; otherwise inf."""
    # If a stage before the ADC clips, later noise may raise some readings by a code or two.
    top = float(x.max())
    tie = _FLOAT32 * abs(top)
    width = step if step > 0.0 else tie
    below = top - x
    for codes in range(1, (_LIFTED if step > 0.0 else 0) + 2):
        inside = below < (codes - 0.5) * width + tie
        at = inside & noisy
        count = int(at.sum())
        if count < _LEAST or int((at[1:] & ~at[:-1]).sum()) < _VISITS:
            continue
        others = below[~inside]
        if not others.size or float(others.min()) > (codes - 1) * step + max(
                3.5 * step, 0.2 * float(others.std())):
            # A code far from all others is not clipping.
            continue
        if step > 0.0:
            # In a falling tail no code is more frequent than the codes below.
            next_ones = [float((np.abs(below[noisy] - (codes - 1 + k) * step)
                                < 0.5 * step).sum()) for k in (1, 2, 3)]
            expected = codes * max(next_ones)
            if codes > 1 and (
                    next_ones[0] > max(next_ones[1:]) + _CLEAR * math.sqrt(next_ones[0])
                    or _leans_up(below[noisy], codes, step)):
                # A peak: the rail is at rest.
                continue
        else:
            # Expect the same density as for the nearest samples below.
            reach = float(np.partition(others, min(_LEAST, others.size - 1))[:_LEAST].max())
            expected = _LEAST * 2.0 * tie / max(reach, tie)
        if count - expected > _CLEAR * math.sqrt(count + codes * expected):
            full = max(range(codes), key=lambda k: int(
                (np.abs(below[noisy] - k * width) < 0.5 * width + tie).sum()))
            return float(x[np.abs(below - full * width) < 0.5 * width + tie].max())
    return math.inf


# Minimum number of repeats, or of runs of repeats; probability of a tie below which the size of
# the changes predicts the number of ties.
_FEWEST_TIES, _FINE = 20, 0.15
# Lags at which equal values are counted (lag 8 still detects that seven of ten samples are held),
# and longer lags, at which the period of a line is sought.
_APART, _PERIODS = (2, 4, 8), range(9, 101)
# Maximum ratio of a rail's noise to its noise at rest, and hence of the probabilities of a tie.
_CALMEST = 100.0
# Minimum excess of ties, and maximum deficit in size of changes that end runs, standard errors.
_CLEARLY, _SHORT = 6.0, 3.0
# Share of the readings at either end of the range; their runs may come from clipping.
_END = 0.1
# Maximum number of samples used to find repeats.
_EXAMINED = 200_000


def without_repeats(t: FloatArray, v: FloatArray, u: FloatArray | None
                    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
    """Return the readings, and the number of samples per reading (1 without repeats)."""
    places, t, period = new_readings(t, v)
    v, u = v[places], None if u is None else u[places]
    if period > 1.0:
        return t, v, u, period
    first = max(0, (v.size - _EXAMINED) // 2)
    held = v[1:] == v[:-1] if _has_excess_ties(v[first:first + _EXAMINED]) else _in_long_runs(v)
    fresh = np.concatenate(([True], ~held))
    return t[fresh], v[fresh], None if u is None else u[fresh], v.size / int(fresh.sum())


def _has_excess_ties(v: FloatArray) -> bool:
    """Return whether there are more repeats than the codes of the ADC explain."""
    step = np.diff(v)
    # Repeats at the ends of the range may be clipping.
    inner = (v[1:] > v.min()) & (v[1:] < v.max())
    equal, count = int(((step == 0.0) & inner).sum()), int(inner.sum())
    if equal < _FEWEST_TIES:
        return False
    moved = step[(step != 0.0) & inner]
    if moved.size < 2:
        return False
    code = _code_step(v)
    # Probability that two normal values have the same code.
    chance = min(1.0, code / (math.sqrt(2.0 * math.pi) * float(np.sqrt(np.mean(moved**2)))))
    if chance >= _FINE and float(np.mean(moved[1:] * moved[:-1] > 0.0)) > 0.5:
        # A smooth voltage stays in each code for some samples.
        return False
    share = _ties_without_holds(v, inner)
    if int(((step[1:] == 0.0) & (step[:-1] != 0.0)).sum()) < _FEWEST_TIES:
        # Ties are likelier at rest, but only up to a limit: more of them mean a stuck sensor.
        share = min(share, _CALMEST * chance)
    expected = count * max(chance if chance < _FINE else 0.0, share)
    smooth, error = _ties_of_codes(moved, code)
    return (equal - expected > _CLEARLY * math.sqrt(max(expected, 1.0))
            and equal - smooth > _CLEARLY * math.hypot(math.sqrt(max(smooth, 1.0)), error)
            and equal > count * _recurring_share(v, inner))


def _code_step(v: FloatArray) -> float:
    """Return the step between codes, at least the resolution of float32, V."""
    return max(find_step(v), usual_change(v), 0.5 * _FLOAT32 * float(np.abs(v).max()))


def _ties_of_codes(moved: FloatArray, code: float) -> tuple[float, float]:
    """Return the ties expected from changes by one and two codes, and their standard error."""
    # The log density of a change is nearly a parabola about zero, even with a ramp, a line or a
    # load added, because both signs are about equally likely.
    size = np.abs(moved)
    one, two = (max(0.5 * float((np.abs(size - k * code) < 0.5 * code).sum()), 0.5)
                for k in (1.0, 2.0))
    expected = (one**4 / two) ** (1.0 / 3.0)
    return expected, expected * math.sqrt(8.0 / (9.0 * one) + 1.0 / (18.0 * two))


def _in_long_runs(v: FloatArray) -> npt.NDArray[np.bool_]:
    """Return which samples (from the second on) belong to runs of repeats too long for chance."""
    # A quiet rail enters and leaves a run with a change of about one code.  With a lost link, the
    # change before the run is of ordinary size, and the change after it is larger.
    step = np.diff(v)
    none = np.zeros(step.size, dtype=np.bool_)
    equal = (step == 0.0) & (v[1:] > v.min()) & (v[1:] < v.max())
    size = np.sort(np.abs(step[step != 0.0]))
    code = _code_step(v)
    edge = np.diff(equal.astype(np.int8), prepend=0, append=0)
    begins, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not size.size or not begins.size:
        return none
    chance = _ties_of_codes(size, code)[0] / step.size
    if float(size[size.size // 2]) < 1.5 * code:
        # If most changes are by one code, runs are longer than independent ties suggest.
        chance = max(chance, float(np.mean(ends - begins > 1)))
    chance = min(chance, 0.9)
    least = max(2, math.ceil(math.log(step.size) / -math.log(chance)))
    long = (ends - begins >= least) & (begins > 0) & (ends < step.size)
    begins, ends = begins[long], ends[long]
    if begins.size < _FEWEST_TIES:
        return none
    low, high = np.quantile(v, (_END, 1.0 - _END))
    if float(np.mean((v[begins] > low) & (v[begins] < high))) < 0.5:
        return none
    usual = 0.5 - _SHORT / math.sqrt(12.0 * begins.size)
    if 0.5 * float(np.mean(size < 1.25 * code)) > usual:
        # Most changes are by one code, so they do not tell a quiet rail from a lost link.
        return none
    for ending in (np.abs(step[begins - 1]), np.abs(step[ends])):
        rank = (np.searchsorted(size, ending - 0.25 * code)
                + np.searchsorted(size, ending + 0.25 * code)) / (2.0 * size.size)
        if float(rank.mean()) < usual:
            return none
    edge[:] = 0
    edge[begins], edge[ends] = 1, -1
    held: npt.NDArray[np.bool_] = np.cumsum(edge[:-1]) > 0
    return held


def _ties_without_holds(v: FloatArray, inner: npt.NDArray[np.bool_]) -> float:
    """Return the share of ties between neighbours that is expected without holds."""
    # If a share h of the samples is held, values k samples apart are equal with probability h^k;
    # other ties are chance.  A chance tie is likelier between neighbours than k samples apart, by
    # the ratio of the rms differences: sqrt(k) in a diffusion, less in white noise.
    near = float(np.mean((v[1:] - v[:-1]) ** 2))
    shares = []
    for k in _APART:
        apart = v[k:] - v[:-k]
        nearer = math.sqrt(max(k, float(np.mean(apart**2)) / near)) if near > 0.0 else math.sqrt(k)
        shares.append(nearer * float(np.mean(apart[inner[k - 1:]] == 0.0)))
    return min(shares)


def _recurring_share(v: FloatArray, inner: npt.NDArray[np.bool_]) -> float:
    """Return the largest share of values that recur after one period of a line."""
    return max((float(np.mean(v[k:][inner[k - 1:]] == v[:-k][inner[k - 1:]]))
                for k in _PERIODS if k < v.size // 2), default=0.0)
