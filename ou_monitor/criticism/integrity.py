"""
What a recording shows without any model, and the samples left for one.

Not-a-number, stamps, repeated values, codes and rails: exact findings, for in a diffusion ties
have probability zero.  Stamps that scatter about an even grid are either true, and then the
increments follow the steps, or wrong, and then they do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.adc import find_knee, find_rails, find_step, redraw, usual_change
from ou_monitor.criticism.readings import usable, why_nothing
from ou_monitor.criticism.samples import (
    choose_samples, events_between, lines_between, Samples, without_tones)
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.clock_jitter import ClockJitter
from ou_monitor.model.terms.held_samples import HeldSamples
from ou_monitor.model.terms.quantization import Quantization
from ou_monitor.model.terms.saturation import Saturation
from ou_monitor.model.terms.term import Term
from ou_monitor.online.estimator.quality import refresh_period, Repeats
from ou_monitor.online.estimator.series import Batch
from ou_monitor.records import FloatArray, Recording
from ou_monitor.text import counted

# Fewer samples than this are not fitted.
LEAST = 100
# Steps of the ADC from this share of the innovations' standard deviation are named.
NAMED_STEP = 0.3
# Throttle that moves less than this says nothing.
MOVES = 0.01
# Repeats that are called so, at least; and the share of ties by chance up to which the size of
# the changes says how many there are.
_FEWEST_TIES, _FINE = 20, 0.15
# Samples apart at which values alike are counted: at 8 seven held of ten show.
_APART = 2, 4, 8
# The noise of a rail falls to one part in so many at rest: ties are so much likelier there.
_CALMEST = 100.0
_FLOAT32 = 1.2e-7
# Samples looked at for repeats, and passed at once.
_LOOK, _CHUNK = 200_000, 500_000
# Scatter below this share of a step is put onto the grid: it changes nothing else.
_SMALL = 0.02
# Scatter above this share of a step is no scatter about a grid.
_LARGE = 0.45
# Correlation of neighbouring errors up to which they count as independent.
_WHITE = 0.3
# The increments must be the rail's to at least this share, and follow the steps
# to less than this, for the stamps to be called wrong.
_RAIL, _FOLLOW, _SURE = 0.5, 0.25, 0.06
_TINY = 1e-6


@dataclass(frozen=True, eq=False)
class Integrity:
    """
    What a recording is, before any model.

    Attributes
    ----------
    samples : Samples or None
        For the fit; None when there is nothing to fit.
    exact : tuple of Term
        What was found, with parameters.
    notes : tuple of str
        What was dropped or left out, one sentence each.
    reason : str
        Why there is nothing to fit; empty when there is.
    raw : Samples or None
        The samples as logged, repeats included, where those differ from
        `samples` by an exact finding: for the score of the plain model.
    drawn : ndarray of bool, shape (samples.n,), or None
        Samples that were drawn and not measured: they take no part in scores.

    """

    samples: Samples | None
    exact: tuple[Term, ...]
    notes: tuple[str, ...]
    reason: str = ''
    raw: Samples | None = None
    drawn: npt.NDArray[np.bool_] | None = None


def examine(recording: Recording, progress: Callable[[float], None] | None = None) -> Integrity:
    """Examine a recording."""
    report = progress or (lambda share: None)
    notes = list(recording.notes)
    t, v, u = usable(recording, notes)
    if v.size < LEAST:
        return Integrity(None, (), tuple(notes), f'It holds {counted(v.size, "usable sample")}; '
                         f'at least {LEAST} are needed.')
    reason = why_nothing(v)
    if reason:
        return Integrity(None, (), tuple(notes), reason)
    report(0.2)
    exact: list[Term] = []
    logged = (t, v, u)
    t, v, u, period = without_repeats(t, v, u)
    if period > 1.0:
        fresh = (v.size - 1) / float(t[-1] - t[0])
        exact.append(HeldSamples(fresh))
        notes.append(f'The logger repeats its last value: the source refreshes at {fresh:.4g} Hz; '
                     f'{logged[0].size - v.size} repeats were dropped.')
    report(0.4)
    rate = (v.size - 1) / float(t[-1] - t[0])
    which, note = choose_samples(v, rate)
    if note:
        notes.append(note)
    lines = lines_between(t, v, which)
    for line in lines:
        notes.append(f'The line at {line.frequency:.6g} Hz was found in all samples and taken '
                     'out of those used, which are too few to show it.')
    between = events_between(v, u, rate, which)
    origin = float(t[which.start])
    events = (t[between], without_tones(t[between], v[between], origin, lines),
              None if u is None else u[between])
    t, v, u = t[which], v[which], None if u is None else u[which]
    v = without_tones(t, v, origin, lines)
    exact += lines
    report(0.6)
    drawn = None
    noise = _innovation_std(v)
    step = find_step(v)
    low, high = find_rails(v, step or usual_change(v), noise)
    soft = 'readings squeezed near the end of the range'
    if not math.isfinite(low) and not math.isfinite(high):
        low, high = _knees(v, noise)
    else:
        soft = 'samples at the end of the range'
    if math.isfinite(low) or math.isfinite(high):
        drawn = (v <= low) | (v >= high)
        exact.append(_saturation(v, low, high))
        notes.append(f'{int(drawn.sum())} {soft} were redrawn from the '
                     'law of an OU beyond it, given their neighbours.')
        v = redraw(v, low, high, step, np.random.default_rng(0))
    cell = _judge_step(step, _innovation_std(v), exact, notes)
    stamps = judge_stamps(t, v)
    notes += stamps.notes
    if stamps.error > 0.0:
        exact.append(ClockJitter(stamps.error))
    useful = _useful(u, recording.has_throttle, notes)
    samples = Samples(stamps.t, v, useful)
    if between.size and drawn is None and stamps.error == 0.0:
        samples = _joined(samples, *events)
        notes.append(f'{between.size} samples around changes that stand out between neighbours '
                     'were kept as well.')
    samples = samples.spread(samples.voltage, cell, np.random.default_rng(0))
    report(1.0)
    return Integrity(samples, tuple(exact), tuple(notes), raw=_as_logged(*logged, exact),
                     drawn=drawn)


def without_repeats(t: FloatArray, v: FloatArray, u: FloatArray | None
                    ) -> tuple[FloatArray, FloatArray, FloatArray | None, float]:
    """Return the refreshes, and the samples a refresh: 1 where none repeats."""
    first = max(0, (v.size - _LOOK) // 2)
    look = v[first:first + _LOOK]
    period = refresh_period(look)
    if period <= 1.0:
        if not _ties(look):
            return t, v, u, 1.0
        fresh = np.concatenate(([True], v[1:] != v[:-1]))
        return t[fresh], v[fresh], None if u is None else u[fresh], v.size / fresh.sum()
    repeats = Repeats()
    repeats.period = period
    parts = []
    for begin in range(0, v.size, _CHUNK):
        part = slice(begin, begin + _CHUNK)
        step = np.diff(t[part])
        kept = repeats.drop(Batch(
            t[part], v[part], None if u is None else u[part],
            float(step.min(initial=math.inf)), float(step.max(initial=0.0)), False))
        if kept is not None:
            parts.append(kept)
    t = np.concatenate([part.t for part in parts])
    v = np.concatenate([part.y for part in parts])
    known = [part.u for part in parts if part.u is not None]
    # The first one was there before the recording began: since when is not known.
    return (_refreshed(t[1:], period), v[1:], np.concatenate(known)[1:] if known else None,
            period)


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
    code = max(find_step(v), usual_change(v), _FLOAT32 * float(np.abs(v).max()))
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
    return equal - expected > 6.0 * math.sqrt(max(expected, 1.0))


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


def _refreshed(t: FloatArray, period: float) -> FloatArray:
    """Return when a source with a clock of its own was read, from when that was logged."""
    if abs(period - round(period)) < 0.02:
        return t
    usual = (t[-1] - t[0]) / (t.size - 1)
    grid = on_grid(t, np.maximum(1.0, np.rint(np.diff(t) / usual)))
    # The logger is late by up to one of its own steps, 1/period of those here.
    return grid if float(np.abs(t - grid).max()) < 1.5 * usual / period else t


def _joined(samples: Samples, t: FloatArray, v: FloatArray, u: FloatArray | None) -> Samples:
    """Return samples with more between them."""
    at = np.searchsorted(samples.t, t)
    more = None if samples.throttle is None or u is None else np.insert(samples.throttle, at, u)
    return Samples(np.insert(samples.t, at, t), np.insert(samples.voltage, at, v), more)


def _innovation_std(v: FloatArray) -> float:
    """Return the standard deviation of the error of predicting from the sample before, V."""
    a, b = v[:-1] - v[:-1].mean(), v[1:] - v[1:].mean()
    e = b - float(a @ b) / max(float(a @ a), 1e-300) * a
    # Events and load steps are no noise.
    middle = float(np.quantile(np.abs(e), 0.95))
    return float(np.minimum(np.abs(e), middle).std()) if middle == 0.0 else float(
        np.sqrt(np.mean(np.square(np.clip(e, -middle, middle)))) / 0.8729)


def _judge_step(step: float, noise: float, exact: list[Term], notes: list[str]) -> float:
    """Name the step of the ADC where it matters, and return it, V; else 0."""
    if step <= 0.0:
        return 0.0
    # Rounding adds step^2/12 to each sample, and so up to twice that to an innovation.
    own = math.sqrt(max(noise * noise - step * step / 6.0, 0.01 * noise * noise))
    named = step >= NAMED_STEP * own
    exact += [Quantization(step)] if named else []
    size = f'{step / own:.2g} times the' if named else 'small beside the'
    notes.append(f'The ADC counts in steps of {1e3 * step:.3g} mV, {size} noise between samples.')
    return step if named else 0.0


def _knees(v: FloatArray, noise: float) -> tuple[float, float]:
    """Return the limits beyond which readings are squeezed; infinite where there is none."""
    if not noise > 0.0:
        return -math.inf, math.inf
    bottom, top = find_knee(v, noise, -1.0), find_knee(v, noise, 1.0)
    return -math.inf if bottom is None else bottom, math.inf if top is None else top


def _saturation(v: FloatArray, low: float, high: float) -> Term:
    """Return the term; a rail that was not met is put where no reading comes."""
    far = 1e3 * (float(v.max()) - float(v.min()))
    return Saturation(low if math.isfinite(low) else float(v.min()) - far,
                      high if math.isfinite(high) else float(v.max()) + far)


def _useful(u: FloatArray | None, recorded: bool, notes: list[str]) -> FloatArray | None:
    """Return throttle where it moves; say what cannot be tested where it does not."""
    if u is not None and float(u.max() - u.min()) >= MOVES:
        return u
    names = [name for name, kind in catalogue().items() if kind.NEEDS_THROTTLE]
    why = 'constant' if u is not None else 'not usable' if recorded else 'not recorded'
    notes.append(f'Throttle is {why}: {", ".join(names)} cannot be tested.')
    return None


def _as_logged(t: FloatArray, v: FloatArray, u: FloatArray | None, exact: list[Term]
               ) -> Samples | None:
    """Return the first samples as logged, where the fit works on others."""
    if not any(term.NAME in ('held_samples', 'saturation', 'clock_jitter') for term in exact):
        return None
    part = slice(0, min(v.size, _LOOK))
    return Samples(t[part], v[part], None)


@dataclass(frozen=True, eq=False)
class Stamps:
    """
    What became of the stamps.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Stamps to use, s.
    error : float
        Standard deviation of stamps that are wrong, s; 0: none are.
    notes : tuple of str
        Sentences.

    """

    t: FloatArray
    error: float
    notes: tuple[str, ...]


def judge_stamps(t: FloatArray, voltage: FloatArray) -> Stamps:
    """
    Judge stamps, and put them onto the grid where that is where they belong.

    t in s, voltage in V.
    """
    step = np.diff(t)
    usual = float(np.median(step))
    # Without gaps first: steps that scatter by half of their length look like gaps.
    number = np.ones(step.size)
    grid = on_grid(t, number)
    if float((t - grid).std()) > _LARGE * usual:
        number = np.maximum(1.0, np.rint(step / usual))
        grid = on_grid(t, number)
    gaps = int((number > 1.0).sum())
    notes = []
    if gaps:
        notes.append(f'{counted(gaps, "gap")} in the stamps, the longest '
                     f'{float(step.max()):.3g} s: kept as they are.')
    off = t - grid
    scatter = float(off.std()) / usual
    if scatter < _TINY:
        return Stamps(t if gaps else grid, 0.0, tuple(notes))
    white = abs(_correlation(off[1:], off[:-1])) < _WHITE
    if scatter < _SMALL:
        notes.append(f'Stamps scatter by {100.0 * scatter:.2g} % of a step about an even grid: '
                     'taken as even.')
        return Stamps(grid, 0.0, tuple(notes))
    if white and scatter < _LARGE and _wrong(step / usual, number, voltage):
        error = float(off.std())
        notes.append(f'Stamps scatter by {1e3 * error:.3g} ms about an even grid while the '
                     'voltage does not follow: the stamps are wrong, the grid was used.')
        return Stamps(grid, error, tuple(notes))
    uneven = float(step[number == 1.0].std()) / usual
    if uneven > _SMALL:
        notes.append(f'Steps between stamps scatter by {100.0 * uneven:.2g} %: taken as they '
                     'are.')
    return Stamps(t, 0.0, tuple(notes))


def on_grid(t: FloatArray, number: FloatArray) -> FloatArray:
    """Return the even grid nearest to stamps (t in s, result in s)."""
    k = np.concatenate(([0.0], np.cumsum(number)))
    k -= k.mean()
    middle = float(t.mean())
    grid: FloatArray = middle + float(k @ (t - middle)) / float(k @ k) * k
    return grid


def _wrong(step: FloatArray, number: FloatArray, voltage: FloatArray) -> bool:
    """Return whether increments do not follow the steps as those of a rail would."""
    change = np.diff(voltage)
    change = change - np.median(change)
    limit = 4.0 * float(np.median(np.abs(change))) / 0.6745
    use = (number == 1.0) & (np.abs(change) < limit)
    if use.sum() < 200:
        return False
    # White noise of the sensor makes neighbouring increments undo each other; it
    # follows no step.
    both = use[1:] & use[:-1]
    power = float(np.mean(change[use] ** 2))
    noise = -2.0 * float(np.mean((change[1:] * change[:-1])[both])) / power
    square = change[use] ** 2 / power - 1.0
    x = step[use] - step[use].mean()
    follow = float(x @ square) / float(x @ x)
    error = float(square.std()) / float(np.sqrt(x @ x))
    return 1.0 - noise > _RAIL and error < _SURE and follow < _FOLLOW


def _correlation(a: FloatArray, b: FloatArray) -> float:
    a, b = a - a.mean(), b - b.mean()
    norm = float(np.sqrt((a @ a) * (b @ b)))
    return float(a @ b) / norm if norm > 0.0 else 0.0
