"""
Findings that need no model (stamps, repeats, ADC codes, clipping), and the samples to fit.

These findings are exact, because equal readings have probability zero in a diffusion.  If stamps
scatter about an even grid, the scatter is real only if the voltage increments follow the steps.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.adc import (
    find_rails, find_step, innovation_std, step_words, usual_change, without_repeats)
from ou_monitor.criticism.readings import load_of, usable, why_no_model
from ou_monitor.criticism.samples import (
    choose_samples, events_between, lines_between, Samples, without_tones)
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.reading import ClockJitter, HeldSamples, Quantization, Saturation
from ou_monitor.model.terms.shocks import outlying
from ou_monitor.model.terms.term import Term
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import counted, percent
from ou_monitor.timeline import on_grid, repeats_words, scatter_words

# Minimum samples of a fit.
LEAST = 100
# Minimum step of the ADC that is named a cause, in standard deviations of the innovations.
NAMED_STEP = 0.3
# Minimum range of throttle; if it moves less, it is not used.
MOVES = 0.01


@dataclass(frozen=True, eq=False)
class Integrity:
    """Exact findings in a recording, and the samples to fit."""

    samples: Samples | None  # For the fit; None if there is nothing to fit
    exact: tuple[Term, ...]  # Causes found without a model, with parameters
    notes: tuple[str, ...]  # What was dropped or left out, one sentence each
    reason: str = ''  # Why there is nothing to fit; otherwise empty
    full: float = NAN  # Current at which the load is 1, A; NaN if the load is throttle
    # Clipped samples, which are replaced by random draws and so not scored; shape (samples.n,).
    drawn: npt.NDArray[np.bool_] | None = None


def examine(recording: Recording, progress: Callable[[float], None] | None = None) -> Integrity:
    """Examine a recording (progress 0..1)."""
    report = progress or (lambda share: None)
    notes = list(recording.notes)
    t, v, u = usable(recording, notes)
    reason = why_no_model(v) if v.size >= LEAST else (
        f'It holds {counted(v.size, "usable sample")}; at least {LEAST} are needed.')
    if reason:
        return Integrity(None, (), tuple(notes), reason)
    report(0.2)
    exact: list[Term] = []
    whole = t
    t, v, u, held = without_repeats(t, v, u)
    u, full = load_of(recording, t, v, u, notes)
    rate = (v.size - 1) / float(t[-1] - t[0])
    if recording.held or held > 1.0:
        exact.append(HeldSamples(rate))
    if held > 1.0:
        notes.append(repeats_words(whole, t))
    report(0.4)
    which, note = choose_samples(v, rate)
    if note:
        notes.append(note)
    lines = lines_between(t, v, which)
    for line in lines:
        notes.append(f'The line at {line.frequency:.6g} Hz was found in all samples and '
                     'subtracted from the samples used, whose rate is too low to show it.')
    between = events_between(v, u, rate, which)
    origin = float(t[which.start])
    events = (t[between], without_tones(t[between], v[between], origin, lines),
              None if u is None else u[between])
    t, v, u = t[which], v[which], None if u is None else u[which]
    v = without_tones(t, v, origin, lines)
    exact += lines
    report(0.6)
    drawn = None
    step = find_step(v)
    low, high = find_rails(v, step or usual_change(v), innovation_std(v[~outlying(v)]))
    if math.isfinite(low) or math.isfinite(high):
        drawn = (v <= low) | (v >= high)
        # A limit that was not found is set far from all readings.
        far = 1e3 * float(np.ptp(v))
        exact.append(Saturation(low if math.isfinite(low) else float(v.min()) - far,
                                high if math.isfinite(high) else float(v.max()) + far))
        notes.append(f'{int(drawn.sum())} clipped samples were replaced by random draws beyond '
                     'the limit, from a model of the other samples.')
    cell = _judge_step(step, innovation_std(v), exact, notes)
    t, error = judge_stamps(t, v, notes)
    if error > 0.0:
        exact.append(ClockJitter(error))
    recorded = recording.has_throttle or math.isfinite(full)
    samples = Samples(t, v, _usable_throttle(u, recorded, notes),
                      by_current=math.isfinite(full))
    if between.size and drawn is None and error == 0.0:
        samples = _joined(samples, *events)
        notes.append(f'{between.size} samples around sudden changes were kept as well.')
    samples = samples.spread(samples.voltage, cell, np.random.default_rng(0))
    report(1.0)
    return Integrity(samples, tuple(exact), tuple(notes), full=full, drawn=drawn)


def _joined(samples: Samples, t: FloatArray, v: FloatArray, u: FloatArray | None) -> Samples:
    at = np.searchsorted(samples.t, t)
    more = None if samples.throttle is None or u is None else np.insert(samples.throttle, at, u)
    return replace(samples, t=np.insert(samples.t, at, t),
                   voltage=np.insert(samples.voltage, at, v), throttle=more)


def _judge_step(step: float, noise: float, exact: list[Term], notes: list[str]) -> float:
    """Return the step of the ADC, V, if it is large enough to be named a cause; else 0."""
    if step <= 0.0:
        return 0.0
    # Rounding adds step^2/12 to the variance of a sample, up to twice that to an innovation.
    own = math.sqrt(max(noise * noise - step * step / 6.0, 0.01 * noise * noise))
    named = step >= NAMED_STEP * own
    exact += [Quantization(step)] if named else []
    notes.append(step_words(step, noise))
    return step if named else 0.0


def _usable_throttle(u: FloatArray | None, recorded: bool, notes: list[str]) -> FloatArray | None:
    """Return throttle if it moves, else None with a note on the causes that cannot be tested."""
    if u is not None and float(u.max() - u.min()) >= MOVES:
        return u
    names = [name for name, kind in catalogue().items() if kind.NEEDS_THROTTLE]
    why = 'constant' if u is not None else 'not usable' if recorded else 'not recorded'
    notes.append(f'Throttle is {why}: {", ".join(names)} cannot be tested.')
    return None


# Scatter of stamps about a grid, as a share of a step: below `_SMALL` it is ignored, above
# `_LARGE` there is no grid.
_SMALL, _LARGE = 0.02, 1.0
# Correlation of neighbouring errors from which they are the wander of a clock: late stamps of a
# simulated queue have 0.6.
_WHITE = 0.8
_TINY = 1e-6  # Scatter that counts as zero, in steps


def judge_stamps(t: FloatArray, voltage: FloatArray, notes: list[str]
                 ) -> tuple[FloatArray, float]:
    """Return stamps, s, or an even grid if their scatter is negligible or wrong; and its error."""
    # error: standard deviation of wrong stamps, s; 0 if stamps are right.
    step = np.diff(t)
    usual = float(np.median(step))
    # Late stamps look like gaps, but those after them are not late: the nearer grid is right.
    number, gapped = np.ones(step.size), np.maximum(1.0, np.rint(step / usual))
    grid, other = on_grid(t, number), on_grid(t, gapped)
    if float((t - other).std()) < float((t - grid).std()):
        number, grid = gapped, other
    gaps = int((number > 1.0).sum())
    if gaps:
        notes.append(f'{counted(gaps, "gap")} in the stamps, the longest '
                     f'{float(step.max()):.3g} s: kept as they are.')
    off = t - grid
    scatter = float(off.std()) / usual
    if scatter < _TINY:
        return t if gaps else grid, 0.0
    white = abs(np.corrcoef(off[1:], off[:-1])[0, 1]) < _WHITE
    if scatter < _SMALL:
        notes.append(f'Stamps scatter by {percent(scatter)} of a step about an even grid, '
                     'which was used instead.')
        return grid, 0.0
    if white and scatter < _LARGE and _are_wrong(step / usual, number, voltage):
        error = float(off.std())
        notes.append(f'Stamps scatter by {1e3 * error:.3g} ms about an even grid, but the voltage '
                     'does not follow: the stamps are wrong, and the grid was used.')
        return grid, error
    if uneven := scatter_words(t, _SMALL):
        notes.append(f'{uneven}: kept.')
    return t, 0.0


def _are_wrong(step: FloatArray, number: FloatArray, voltage: FloatArray) -> bool:
    """Return whether increments do not follow the steps, so that the stamps are wrong."""
    # The likelihood ratio must exceed the penalty of a parameter, as for causes.  White noise of
    # the sensor, which does not depend on the steps, is allowed for.
    change = np.diff(voltage)
    change = change - np.median(change)
    limit = 4.0 * float(np.median(np.abs(change))) / 0.6745
    use = (number == 1.0) & (np.abs(change) < limit)
    both = use[1:] & use[:-1]
    if not both.any():
        return False
    # White noise gives neighbouring increments a negative correlation.
    power = float(np.mean(change[use] ** 2))
    noise = -2.0 * float(np.mean((change[1:] * change[:-1])[both])) / power
    rail = min(max(1.0 - noise, 0.0), 1.0)
    square = change[use] ** 2 / power - 1.0
    x = step[use] - step[use].mean()
    follow, weight = float(x @ square), float(x @ x)
    # Log-likelihood ratio for normal errors with the variance of the squares.
    ratio = 0.5 * ((follow - rail * weight) ** 2 - follow**2) / (
        weight * float(square @ square) / square.size)
    return bool(ratio > 0.5 * math.log(square.size))
