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
from scipy.special import xlogy

# Maximum number of values used to find steps and repeats.
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
# Clipping: minimum samples at the limit, visits to it, and gain in log likelihood over the density
# of neighbouring codes, nats: 4 standard errors, by chance in one of 16 000 recordings.
_LEAST, _VISITS, _CLEAR = 8, 3, 8.0
# Maximum step, in standard deviations of the noise, at which the counts of neighbouring codes
# follow a smooth density.
_COARSE = 2.0


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


def find_rails(voltage: FloatArray, step: float, noise: float) -> tuple[float, float]:
    """Return the readings at which the ADC clips, V; infinite if it does not (inputs in V)."""
    if step > _COARSE * noise:
        return -math.inf, math.inf
    return -_clipping_limit(-voltage, step), _clipping_limit(voltage, step)


def _clipping_limit(x: FloatArray, step: float) -> float:
    """Return the top reading if it is more frequent than its neighbours predict; otherwise inf."""
    top = float(x.max())
    tie = _FLOAT32 * abs(top)
    below = top - x
    at = below < 0.5 * step + tie
    others = below[~at]
    count = int(at.sum())
    if count < _LEAST or int((at[1:] & ~at[:-1]).sum()) < _VISITS or not others.size:
        return math.inf
    if float(others.min()) > max(3.5 * step, 0.2 * float(others.std())):
        # A code far from all others is not clipping.
        return math.inf
    if step > 0.0:
        # In a falling tail no code is more frequent than the codes below.
        width = reach = step
        beside = max(int((np.abs(below - k * step) < 0.5 * step).sum()) for k in (1, 2, 3))
    else:
        # Expect the same density as for the nearest samples below.
        reach = float(np.partition(others, min(_LEAST, others.size - 1))[:_LEAST].max())
        width, beside = max(2.0 * tie, 1e-9 * reach), _LEAST
    expected = (count + beside) * width / (width + reach)
    gain = count * math.log(count / expected) + float(
        xlogy(beside, beside / (count + beside - expected)))
    return top if count > expected and gain > _CLEAR else math.inf


# Minimum number of repeats; probability of a tie below which the size of the changes predicts the
# number of ties.
_FEWEST_TIES, _FINE = 20, 0.15
# Lags at which equal values are counted: lag 8 still detects that seven of ten samples are held.
_APART = 2, 4, 8
# Maximum ratio of a rail's noise to its noise at rest, and hence of the probabilities of a tie.
_CALMEST = 100.0
# Minimum excess of ties, standard errors.
_CLEARLY = 6.0


def without_repeats(t: FloatArray, v: FloatArray, u: FloatArray | None
                    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
    """Return the readings, and the number of samples per reading (1 without repeats)."""
    places, t, period = new_readings(t, v)
    v, u = v[places], None if u is None else u[places]
    if period > 1.0:
        return t, v, u, period
    first = max(0, (v.size - EXAMINED) // 2)
    fresh = np.ones(v.size, dtype=np.bool_)
    if _has_excess_ties(v[first:first + EXAMINED]):
        fresh[1:] = v[1:] != v[:-1]
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
    # At least the resolution of float32.
    code = max(find_step(v), usual_change(v), 0.5 * _FLOAT32 * float(np.abs(v).max()))
    # Probability that two normal values have the same code.
    chance = min(1.0, code / (math.sqrt(2.0 * math.pi) * float(np.sqrt(np.mean(moved**2)))))
    share = _ties_without_holds(v, inner)
    if int(((step[1:] == 0.0) & (step[:-1] != 0.0)).sum()) < _FEWEST_TIES:
        # Ties are likelier at rest, but only up to a limit: more of them mean a stuck sensor.
        share = min(share, _CALMEST * chance)
    expected = count * max(chance if chance < _FINE else 0.0, share)
    smooth, error = _ties_of_codes(moved, code)
    return (equal - expected > _CLEARLY * math.sqrt(max(expected, 1.0))
            and equal - smooth > _CLEARLY * math.hypot(math.sqrt(max(smooth, 1.0)), error))


def _ties_of_codes(moved: FloatArray, code: float) -> tuple[float, float]:
    """Return the ties expected from changes by one and two codes, and their standard error."""
    # The log density of a change is nearly a parabola about zero, even with a ramp, a line or a
    # load added, because both signs are about equally likely.
    size = np.abs(moved)
    one, two = (max(0.5 * float((np.abs(size - k * code) < 0.5 * code).sum()), 0.5)
                for k in (1.0, 2.0))
    expected = (one**4 / two) ** (1.0 / 3.0)
    return expected, expected * math.sqrt(8.0 / (9.0 * one) + 1.0 / (18.0 * two))


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
