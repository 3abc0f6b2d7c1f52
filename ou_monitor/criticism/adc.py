"""
What the ADC and its input did to the readings: steps between codes, rails, squeezed ends.

Ties have no chance in a diffusion, so steps and rails are findings without a model.  A protection
diode before the ADC squeezes readings beyond a knee: they rise as a logarithm.  Undone, they are
an OU again: the knee and the scale are those under which an AR(1) finds the readings likeliest,
the density of the transformed samples counted.

Leaving clipped samples out would cut the law where they were, and every statistic of the rest
would see the cut.  So they are drawn from the law of an AR(1), given their neighbours and that
they lie beyond the limit (Gibbs sampling; Tanner & Wong, J. Am. Stat. Assoc. 82 (1987) 528).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from ou_monitor.timeline.line import reading_places, reading_times
from scipy.special import ndtr, ndtri

# Values looked at for the step: more would not change it.
_MOST = 200_000
# Rounding of float32, as a share of the value, with room for two of them.
_FLOAT32 = 2.5e-7
# Share of the samples that must lie on the lattice, and how near, in steps.
_SHARE, _NEAR = 0.99, 0.1
# Printed steps to one of the ADC from which it is looked for: below two, any value is within half
# a printed step of one code or the next.  Gaps between codes that show it, at least; decimals.
_SPARSE, _FEWEST_CODES = 2.0, 4
_DECIMALS = range(7)
# Equal changes from which they come again and again: of a voltage without codes no two are equal.
_AGAIN = 20
# Samples at a rail, visits to it, and standard errors above its neighbours, at least.
_LEAST, _VISITS, _CLEAR = 8, 3, 5.0
# Codes that noise lifts clipped readings by, at most.
_LIFTED = 2
# With steps above this many standard deviations of the noise the codes next to
# each other say nothing of a density.
_COARSE = 2.0
# Parts of equal size by throttle, each with a noise of its own, and how near to its lowest it is
# idle.
_LOADS, _STILL = 8, 0.01
# Sweeps over all samples drawn: excursions last some relaxation times at most.
_SWEEPS = 60
# Shares of the samples beyond the knee, and scales in standard deviations of the
# innovations.  A larger scale is no limit but a bent characteristic.
_SHARES = (0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.1)
_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3)
# Evidence from which it is found, nats.
_FOUND = 50.0
# Falls from just below the knee, at least, and how noisy beside all; and parts of the
# recording of which half must have been beyond it.
_FEWEST, _AS_NOISY, _PARTS = 30, 0.6, 10
# Samples before from which lines are predicted: two for each, and as many for the noise about it.
_LINES = 16
# Beyond so many scales a reading says nothing of what was there.
_FAR = 8.0
# Sums of squares that are none; far from it, their inverse is still a number.
_TINY = 1e-280


def find_step(voltage: FloatArray) -> float:
    """Return the step of the lattice on which the values lie (voltage in V)."""
    v = voltage[:_MOST]
    if v.size > 16:
        # A rail need not be a code.
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
        step = _fitted(codes, gaps, weight, first)
        if step > 8.0 * rounding:
            return step
    return _unprinted(codes, gaps, weight)


def usual_change(voltage: FloatArray) -> float:
    """Return the change that comes most often, V; 0 where none comes again and again."""
    # Codes to which something was added now and then lie on no lattice, but most changes do.
    rounding = 2.0 * _FLOAT32 * float(np.abs(voltage).max())
    size = np.sort(np.abs(np.diff(voltage[:_MOST])))
    size = size[size > rounding]
    first = np.flatnonzero(np.diff(size, prepend=-np.inf) > rounding)
    count = np.diff(first, append=size.size)
    return float(size[first[count.argmax()]]) if count.max(initial=0) >= _AGAIN else 0.0


def _unprinted(codes: FloatArray, gaps: FloatArray, weight: FloatArray) -> float:
    """Return the step of an ADC whose codes were printed with few decimals, V; 0 for none."""
    printed = next((10.0 ** -k for k in _DECIMALS if float(np.abs(
        codes * 10.0 ** k - np.rint(codes * 10.0 ** k)).max()) < 1e-3), 0.0)
    # Where most values are, every code is taken.
    middle = np.cumsum(weight) / weight.sum()
    dense = (middle[:-1] > 0.1) & (middle[1:] < 0.9)
    if not printed or int(dense.sum()) < _FEWEST_CODES:
        return 0.0
    first = float(gaps[dense].mean())
    if first < _SPARSE * printed:
        return 0.0
    step = _fitted(codes, gaps, weight, first, 0.55 * printed)
    return step if step >= _SPARSE * printed else 0.0


def _fitted(codes: FloatArray, gaps: FloatArray, weight: FloatArray, first: float,
            near: float = 0.0) -> float:
    """Return the step near `first` that the codes fit (to `near`, V); 0 when they do not."""
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


def find_rails(voltage: FloatArray, step: float, noise: float,
               throttle: FloatArray | None = None) -> tuple[float, float]:
    """Return the readings at which the ADC clips (voltage in V, step in V, noise in V)."""
    if step > _COARSE * noise:
        return -math.inf, math.inf
    told = _told(voltage, step, throttle)
    return -_limit(-voltage, step, told), _limit(voltage, step, told)


def _told(voltage: FloatArray, step: float, throttle: FloatArray | None) -> npt.NDArray[np.bool_]:
    """
    Return the samples at throttles at which the noise fills the codes.

    A rail at idle may be so quiet that it stays within one code, the top one: that is no end.
    """
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
    """Return where throttle is at its lowest."""
    return np.asarray(throttle <= throttle.min() + _STILL)


def _limit(x: FloatArray, step: float, told: npt.NDArray[np.bool_]) -> float:
    """
    Return the reading at the top that holds more than its neighbours below say; inf for none.

    A stage before the ADC may clip, and noise after it lift some readings by a code or two.
    """
    top = float(x.max())
    tie = _FLOAT32 * abs(top)
    width = step if step > 0.0 else tie
    below = top - x
    for codes in range(1, (_LIFTED if step > 0.0 else 0) + 2):
        inside = below < (codes - 0.5) * width + tie
        at = inside & told
        count = int(at.sum())
        # The extremes of a bell need not be tested where nothing is heaped.
        if count < _LEAST or int((at[1:] & ~at[:-1]).sum()) < _VISITS:
            continue
        others = below[~inside]
        if not others.size or float(others.min()) > (codes - 1) * step + max(
                3.5 * step, 0.2 * float(others.std())):
            # Far from all others: a code of its own, no end of a range.
            continue
        if step > 0.0:
            # A tail that falls has no more in any code than in those below.
            next_ones = [float((np.abs(below[told] - (codes - 1 + k) * step)
                                < 0.5 * step).sum()) for k in (1, 2, 3)]
            expected = codes * max(next_ones)
            if codes > 1 and next_ones[0] > max(next_ones[1:]) + _CLEAR * math.sqrt(next_ones[0]):
                # The flank of a bell: a rail at rest.
                continue
        else:
            # As dense as the nearest interval that holds some samples.
            reach = float(np.partition(others, min(_LEAST, others.size - 1))[:_LEAST].max())
            expected = _LEAST * 2.0 * tie / max(reach, tie)
        if count - expected > _CLEAR * math.sqrt(count + codes * expected):
            full = max(range(codes), key=lambda k: int(
                (np.abs(below[told] - k * width) < 0.5 * width + tie).sum()))
            return float(x[np.abs(below - full * width) < 0.5 * width + tie].max())
    return math.inf


def redraw(voltage: FloatArray, low: float, high: float, step: float,
           rng: np.random.Generator) -> FloatArray:
    """
    Return the voltage with clipped samples drawn beyond their limit.

    voltage in V, low, high in V, step in V.
    """
    v = voltage.astype(np.float64)
    top, bottom = voltage >= high, voltage <= low
    sites = np.flatnonzero(top | bottom)
    sites = sites[(sites > 0) & (sites < v.size - 1)]
    halves = [sites[sites % 2 == parity] for parity in (0, 1)]
    for _ in range(_SWEEPS):
        mean = float(v.mean())
        c = v - mean
        phi = min(float(c[1:] @ c[:-1]) / float(c @ c), 0.9999)
        spread = float(np.sqrt(np.mean((c[1:] - phi * c[:-1]) ** 2) / (1.0 + phi * phi)))
        for k in halves:
            centre = mean + phi / (1.0 + phi * phi) * (c[k - 1] + c[k + 1])
            side = np.where(top[k], 1.0, -1.0)
            limit = np.where(top[k], high, low)
            # On the side of the limit: -z is below where the limit lies.
            room = ndtr(side * (centre - limit) / spread)
            draw = -ndtri(np.maximum(room * (1.0 - rng.random(k.size)), 1e-300))
            c[k] = np.where(room > 1e-12, centre + side * spread * draw, limit) - mean
        v = c + mean
    if step > 0.0:
        for at, end in ((top, high), (bottom, low)):
            v[at] = end + step * np.rint((v[at] - end) / step)
    return v


def find_knee(voltage: FloatArray, noise: float, side: float,
              throttle: FloatArray | None = None) -> float | None:
    """Return where readings begin to be squeezed (voltage in V, noise in V)."""
    x = side * voltage
    plain = _likelihood(x)
    best, found, undone, squeezed = plain + _FOUND, None, x, 0.0
    for share in _SHARES:
        knee = float(np.quantile(x, 1.0 - share))
        over = np.maximum(x - knee, 0.0)
        for scale in _SCALES:
            far = over / (scale * noise)
            if float(far.max()) > 1e3:
                continue
            part = np.minimum(far, _FAR)
            # Beyond, on along the tangent.
            stretched = np.expm1(part) + (far - part) * math.exp(_FAR)
            whole = np.minimum(x, knee) + scale * noise * stretched
            value = float(part.sum()) + _likelihood(whole)
            if value > best:
                best, found, undone, squeezed = value, knee, whole, float(part.sum())
    if found is None or not _is_limit(x, found):
        return None
    # Where idle is beyond it, and what is beyond it idle, it may be how quiet the rail is then.
    idle = None if throttle is None else _idle(throttle)
    if idle is not None and not idle.all() and min(
            float(idle[x > found].mean()), float((x > found)[idle].mean())) > 0.5:
        return None
    # A line is slow at its turning points: of what is predicted with it they are no likelier.
    gain = squeezed + _likelihood(undone, _LINES) - _likelihood(x, _LINES)
    return side * found if gain > _FOUND else None


def _is_limit(x: FloatArray, knee: float) -> bool:
    """
    Return whether noise is squeezed above a knee only, and now and then.

    A rail that is quiet while nothing draws current is near its top then, too: but
    just below as well, and for one long while.
    """
    step = np.diff(x)
    near = (x[:-1] < knee) & (x[:-1] > knee - 3.0 * float(np.std(step)))
    # What falls from just below the knee is not squeezed.
    below, all_ = step[near & (step < 0.0)], step[step < 0.0]
    if below.size < _FEWEST or float(np.sqrt(np.mean(below**2))) < _AS_NOISY * float(
            np.sqrt(np.mean(all_**2))):
        return False
    parts = np.array_split(x > knee, _PARTS)
    return sum(bool(part.any()) for part in parts) >= _PARTS // 2


def _likelihood(x: FloatArray, order: int = 1) -> float:
    """Return the log-likelihood of an AR of some order, but for a constant, nats."""
    count = int(x.size - order)
    c = x - x.mean()
    past = np.lib.stride_tricks.sliding_window_view(c, order + 1)
    square = past.T @ past
    weights = np.linalg.lstsq(square[:order, :order], square[:order, order], rcond=None)[0]
    e = past[:, order] - past[:, :order] @ weights
    return -0.5 * count * math.log(max(float(e @ e), _TINY) / count)


# Repeats, or runs of them, that are called so, at least; and the share of ties by chance up to
# which the size of the changes says how many there are.
_FEWEST_TIES, _FINE = 20, 0.15
# Samples apart at which values alike are counted: at 8 seven held of ten show.  A line brings its
# values back after periods of its own, where holds are no longer seen.
_APART, _PERIODS = (2, 4, 8), range(9, 101)
# The noise of a rail falls to one part in so many at rest: ties are so much likelier there.
_CALMEST = 100.0
# Standard errors by which ties must exceed what is expected, and ends of runs may fall short.
_CLEARLY, _SHORT = 6.0, 3.0
# Share at either end of the range where readings may be squeezed together.
_END = 0.1
# Samples looked at for repeats.
_LOOK = 200_000


def without_repeats(t: FloatArray, v: FloatArray, u: FloatArray | None
                    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
    """Return readings, and samples a reading: 1 where none repeats."""
    places, period = reading_places(v)
    t, v, u = reading_times(t[places], period), v[places], None if u is None else u[places]
    if period > 1.0:
        return t, v, u, period
    first = max(0, (v.size - _LOOK) // 2)
    held = v[1:] == v[:-1] if _ties(v[first:first + _LOOK]) else _stuck(v)
    fresh = np.concatenate(([True], ~held))
    return t[fresh], v[fresh], None if u is None else u[fresh], v.size / int(fresh.sum())


def _ties(v: FloatArray) -> bool:
    """Return whether more samples repeat the one before than the codes of the ADC explain."""
    step = np.diff(v)
    # At the ends of the range there are other reasons to repeat.
    inner = (v[1:] > v.min()) & (v[1:] < v.max())
    equal, count = int(((step == 0.0) & inner).sum()), int(inner.sum())
    if equal < _FEWEST_TIES:
        return False
    moved = step[(step != 0.0) & inner]
    if moved.size < 2:
        return False
    code = _code(v)
    # Chance of two normal values one code apart or less, on average over their codes.
    chance = min(1.0, code / (math.sqrt(2.0 * math.pi) * float(np.sqrt(np.mean(moved**2)))))
    if chance >= _FINE and float(np.mean(moved[1:] * moved[:-1] > 0.0)) > 0.5:
        # A voltage that goes on where it goes stays in each code for a while.
        return False
    share = _ties_without_holds(v, inner)
    if int(((step[1:] == 0.0) & (step[:-1] != 0.0)).sum()) < _FEWEST_TIES:
        # Where a rail is calm, ties are likelier; but that calm none is, and a sensor was stuck.
        share = min(share, _CALMEST * chance)
    expected = count * max(chance if chance < _FINE else 0.0, share)
    smooth, error = _ties_of_codes(moved, code)
    return (equal - expected > _CLEARLY * math.sqrt(max(expected, 1.0))
            and equal - smooth > _CLEARLY * math.hypot(math.sqrt(max(smooth, 1.0)), error)
            and equal > count * _alike_again(v, inner))


def _code(v: FloatArray) -> float:
    """Return the step between codes, at least that of floats, V."""
    return max(find_step(v), usual_change(v), 0.5 * _FLOAT32 * float(np.abs(v).max()))


def _ties_of_codes(moved: FloatArray, code: float) -> tuple[float, float]:
    """
    Return the ties expected from changes by one and by two codes (V), and their standard error.

    The logarithm of a density that is smooth about zero is a parabola there: that of a normal law
    behind any ramp, line or load, as most of what adds to a change is as likely at either sign.
    """
    size = np.abs(moved)
    one, two = (max(0.5 * float((np.abs(size - k * code) < 0.5 * code).sum()), 0.5)
                for k in (1.0, 2.0))
    expected = (one**4 / two) ** (1.0 / 3.0)
    return expected, expected * math.sqrt(8.0 / (9.0 * one) + 1.0 / (18.0 * two))


def _stuck(v: FloatArray) -> npt.NDArray[np.bool_]:
    """
    Return which samples but the first repeat the one before in runs that no chance makes.

    A rail that is calm comes to rest, and moves on, by a code or so; a link that is lost holds
    what it had in the midst of ordinary changes, and has moved on by the more when it is back.
    """
    step = np.diff(v)
    none = np.zeros(step.size, dtype=np.bool_)
    equal = (step == 0.0) & (v[1:] > v.min()) & (v[1:] < v.max())
    size = np.sort(np.abs(step[step != 0.0]))
    code = _code(v)
    edge = np.diff(equal.astype(np.int8), prepend=0, append=0)
    begins, ends = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not size.size or not begins.size:
        return none
    chance = _ties_of_codes(size, code)[0] / step.size
    if float(size[size.size // 2]) < 1.5 * code:
        # Where most changes are by one code, what is alike stays so more often than codes say.
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
        # Coming to rest by a code is no small change.
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
    """
    Return the share of ties to neighbours that values alike without any hold explain.

    Values some samples apart are alike by chance of their codes, whatever the intensity does over
    the recording; neighbours are the more so as they lie nearer to each other, by sqrt(k) over k
    samples in a diffusion and less in white noise, or as the recording itself says.  Of a share h
    held, h^k are alike k apart, too.
    """
    near = float(np.mean((v[1:] - v[:-1]) ** 2))
    shares = []
    for k in _APART:
        apart = v[k:] - v[:-k]
        nearer = math.sqrt(max(k, float(np.mean(apart**2)) / near)) if near > 0.0 else math.sqrt(k)
        shares.append(nearer * float(np.mean(apart[inner[k - 1:]] == 0.0)))
    return min(shares)


def _alike_again(v: FloatArray, inner: npt.NDArray[np.bool_]) -> float:
    """Return the share of values that come back after the period at which most do."""
    return max((float(np.mean(v[k:][inner[k - 1:]] == v[:-k][inner[k - 1:]]))
                for k in _PERIODS if k < v.size // 2), default=0.0)
