"""
The list of what is doubtful about a recording, worst first.

The list gathers what the estimator flags at each level, what the reader dropped or mended, what
the samples and stamps show by themselves, and what lines, a second relaxation and the settling
after changes of throttle do to the fit of a level.

Limits: a list without warnings says that nothing was found, not that there is nothing.  Settling
is known only from relaxations detected after changes between levels; its share of the variance
assumes one exponential and is relative to a fit that includes the settling itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import enum
import math

import numpy as np
from ou_monitor.analysis.levels import GAP_STEPS, SETTLE
from ou_monitor.analysis.relaxation import Relaxation
from ou_monitor.online.estimator.quality import examine
from ou_monitor.records import Estimate, Flag, Recording, Status
from ou_monitor.text import counted, Z95
from ou_monitor.timeline.line import TAIL

# Flags that inform; the others make numbers doubtful.
_INFORMS = frozenset({Flag.HELD_SAMPLES, Flag.IRREGULAR, Flag.NO_EXCITATION})
# Root mean square of the steps about their median, in medians, from which a clock is uneven.
_UNEVEN = 0.05
# No supply of a UAV has more, V; the millivolts of any do.
_MOST_VOLTS = 1000.0
# No autopilot tells its battery less often, s; nor, once a second, for as long in one flight, s.
_LONG_STEP, _SLOW, _LONG_FLIGHT = 5.0, 0.9, 10_800.0
# Throttle may go beyond 0..1 by so much, as sticks out of trim do, and by more for so small a
# share of the samples.
_TRIM, _RARE = 0.05, 0.01
# Segments of samples examined for ADC steps.
_LOOKS = 8
# What the reader's sentences are about: a word in them, the name, and whether numbers suffer.
_READER = (('cannot be decoded', 'DAMAGED_FILE', True), ('damaged', 'DAMAGED_FILE', True),
           ('gap', 'GAPS', True), ('sorted by stamp', 'UNORDERED', True),
           ('clock went back', 'UNORDERED', True), ('stamp was there', 'REPEATED_STAMPS', True),
           ('not a finite', 'NON_FINITE', True))

NOISE_UNKNOWN = (
    'The fit cannot separate white noise of the sensor from the supply here: if there is any, '
    'alpha and sigma come out too high (Var_inf does not).')
# Share of a level's variance that may be left of the settling: alpha is then off by about as much.
SHARE = 0.02


class Severity(enum.IntEnum):
    """How much it matters."""

    ERROR = 3
    WARNING = 2
    INFO = 1


@dataclass(frozen=True)
class QualityItem:
    """
    One thing to know before using the numbers.

    Attributes
    ----------
    name : str
        Stable key in capitals.
    severity : Severity
        ERROR: there are no numbers; WARNING: they are doubtful; INFO: good to know.
    text : str
        One sentence.
    throttles : tuple of float
        Levels it is true of; empty when it is of the whole recording.

    """

    name: str
    severity: Severity
    text: str
    throttles: tuple[float, ...] = ()


def quality_list(recording: Recording, throttles: Sequence[float], estimates: Sequence[Estimate],
                 notes: Sequence[Sequence[str]], more: Sequence[QualityItem] = ()
                 ) -> tuple[QualityItem, ...]:
    """Gather what is doubtful."""
    found: dict[tuple[str, Severity, str], list[float]] = {}
    for throttle, estimate, own in zip(throttles, estimates, notes):
        for item in [*_of_estimate(estimate), *(('SEGMENTS', Severity.INFO, text)
                                                for text in own)]:
            found.setdefault(item, []).append(throttle)
    items = [QualityItem(*key, tuple(where)) for key, where in found.items()]
    items += more
    items += [_of_reader(note) for note in recording.notes]
    items = _of_units(recording) + items + _of_stamps(recording) + _of_samples(recording)
    return tuple(sorted(items, key=lambda item: -item.severity))


def _of_estimate(e: Estimate) -> list[tuple[str, Severity, str]]:
    items = []
    if e.status is not Status.OK:
        severity = Severity.WARNING if e.usable else Severity.ERROR
        items.append((e.status.name, severity, e.status.value))
    items += [(flag.name, Severity.INFO if flag in _INFORMS else Severity.WARNING, flag.value)
              for flag in e.flags]
    # Measured at 20 mV of noise beside 56 mV of OU, 1 kHz: alpha +194 %.
    if e.usable and math.isnan(e.noise_std):
        items.append(('NOISE_UNKNOWN', Severity.WARNING, NOISE_UNKNOWN))
    return items


def _of_reader(note: str) -> QualityItem:
    for word, name, suffers in _READER:
        if word in note:
            return QualityItem(name, Severity.WARNING if suffers else Severity.INFO, note)
    return QualityItem('READER', Severity.INFO, note)


def _of_units(recording: Recording) -> list[QualityItem]:
    """Return what the sizes of the numbers say of their units."""
    items = []
    middle = float(np.median(np.abs(recording.voltage))) if recording.n else 0.0
    if middle > _MOST_VOLTS:
        items.append(QualityItem('VOLTAGE_UNIT', Severity.WARNING, (
            f'The median of the voltages is {middle:.4g}, more than any supply of a UAV has in '
            'volts: is this mV, or counts of an ADC? Alpha and tau hold; figures in V are in '
            'that unit instead, and no risk is computed. --unit mV reads a CSV in mV; for a bag '
            'there is unit_factor in a msg config.')))
    step = float(np.median(np.diff(recording.t))) if recording.n > 1 else 0.0
    if step > _LONG_STEP or (step > _SLOW and recording.duration > _LONG_FLIGHT):
        items.append(QualityItem('TIME_UNIT', Severity.WARNING, (
            f'The samples are {step:.3g} s apart, over {recording.duration / 3600.0:.3g} hours: '
            'is the time in ms or us? --time-unit ms reads a CSV in ms. All rates and times are '
            'wrong by that factor otherwise.')))
    known = recording.throttle[np.isfinite(recording.throttle)]
    low, high = np.quantile(known, (_RARE, 1.0 - _RARE)) if known.size else (0.0, 1.0)
    if low < -_TRIM or high > 1.0 + _TRIM:
        items.append(QualityItem('THROTTLE_RANGE', Severity.WARNING, (
            f'Throttle runs from {low:.3g} to {high:.3g} instead of 0 to 1: curves, risk and '
            'throttle budget end at 0 and 1, and sag counts from the lowest throttle. Use '
            '(x + 1) / 2 for a stick from -1 to 1, the absolute value for reverse thrust.')))
    return items


def _of_stamps(recording: Recording) -> list[QualityItem]:
    """Return what the stamps show: pauses, and an uneven clock."""
    steps = np.diff(recording.t)
    if steps.size < 2:
        return []
    items = []
    median = float(np.median(steps))
    pauses = steps > GAP_STEPS * median
    if pauses.any():
        items.append(QualityItem('PAUSES', Severity.WARNING, (
            f'{counted(int(pauses.sum()), "pause")} without samples, '
            f'{float(steps[pauses].sum()):.3g} s in all, the longest '
            f'{float(steps.max()):.3g} s; no level spans a pause.')))
    jitter = float(np.sqrt(np.mean((steps[~pauses] / median - 1.0) ** 2)))
    if jitter > _UNEVEN:
        items.append(QualityItem('UNEVEN_CLOCK', Severity.INFO, (
            f'The steps between stamps scatter by {100.0 * jitter:.0f} % of their median '
            f'({1e3 * median:.3g} ms): the spectra assume even steps.')))
    unknown = int(np.isnan(recording.throttle).sum())
    if unknown and recording.has_throttle:
        items.append(QualityItem('THROTTLE_UNKNOWN', Severity.INFO, (
            f'Throttle is unknown for {unknown} of {recording.n} samples.')))
    return items


def _of_samples(recording: Recording) -> list[QualityItem]:
    """Return what the samples show: the ADC's step, repeats, a rail of the ADC."""
    n = recording.n
    starts = np.unique(np.linspace(0, max(0, n - TAIL), _LOOKS).astype(int))
    looks = [examine(recording.voltage[k:k + TAIL]) for k in starts.tolist()]
    items = []
    steps = [look.step for look in looks if look.step > 0.0]
    if 2 * len(steps) > len(looks):
        step = float(np.median(steps))
        rms = float(np.median([look.rms_increment for look in looks if look.step > 0.0]))
        items.append(QualityItem('ADC_STEP', Severity.INFO, (
            f'Voltages lie on a lattice of {1e3 * step:.3g} mV, {step / rms:.2g} times the '
            'scatter from sample to sample.')))
    clipped = sum(look.saturated for look in looks)
    if clipped:
        items.append(QualityItem('CLIPPED', Severity.WARNING, (
            f'In {clipped} of {len(looks)} segments examined the voltage piles up at one end of '
            'its range: the ADC may be saturated.')))
    return items


def unsettled(relaxations: Sequence[Relaxation], throttles: Sequence[float],
              estimates: Sequence[Estimate], times: Sequence[float]) -> list[QualityItem]:
    """
    Return a warning for each kind of change after which levels hold the settling too.

    throttles 0..1, times in s.
    """
    items = []
    for fit in relaxations:
        shares = {x: _share(fit, x, e, time)
                  for x, e, time in zip(throttles, estimates, times) if e.usable and time > 0.0}
        where = tuple(x for x, share in shares.items() if share > SHARE)
        if not where:
            continue
        what = {'release': 'falls', 'load': 'rises'}[fit.kind]
        start = f'After throttle {what} the voltage '
        end = (f'the levels leave out only {1e3 * SETTLE:.3g} ms: alpha and sigma here include '
               'the settling')
        if not fit.moves_on:
            tau = f'= {1e3 * fit.tau:.3g}' if fit.detected else f'< {1e3 * fit.tau_high:.3g}'
            most = 100.0 * min(1.0, max(shares[x] for x in where))
            text = (f'{start}settles in tau {tau} ms, and {end} (up to '
                    f'{most:.0f} % of the variance).')
        else:
            text = f'{start}keeps moving for the whole time observed, and {end}.'
        items.append(QualityItem('NOT_SETTLED', Severity.WARNING, text, where))
    return items


def _share(fit: Relaxation, throttle: float, estimate: Estimate, time: float) -> float:
    """Return the mean square of what is left of the settling, over Var_inf."""
    changes = [change for change in fit.releases if change.throttle_after == throttle]
    if not changes:
        return 0.0
    tau = fit.tau if fit.detected else fit.tau_high
    if not tau < math.inf:
        return math.inf if fit.moves_on else 0.0
    # Of A exp(-t / tau), squared, from the end of what is left out to the end of what is watched.
    left = sum(change.amplitude ** 2 * max(0.0, math.exp(-2.0 * SETTLE / tau)
                                           - math.exp(-2.0 * change.duration / tau))
               for change in changes if math.isfinite(change.amplitude))
    return 0.5 * tau * left / (time * estimate.var_inf)


def line_item(throttle: float, without: Estimate, with_lines: Estimate | None) -> QualityItem:
    """Say what the lines of a level do to its fit, or would have done (throttle 0..1)."""
    if with_lines is None:
        worry = Severity.WARNING if without.usable else Severity.INFO
        return QualityItem('LINES_LEFT_IN', worry, (
            'The level shows impulses beside spectral lines; the lines may come from the impulses '
            'and were left in: alpha and sigma include both.'), (throttle,))
    taken = 'Spectral lines were taken out before the fit'
    if without.usable and with_lines.usable:
        moved = any(abs(math.log(getattr(with_lines, name) / getattr(without, name)))
                    > Z95 * getattr(without, name + '_se') for name in ('alpha', 'sigma'))
        text = (f'{taken}; with them, as in the node, alpha would be {with_lines.alpha:.3g} '
                f'1/s and sigma {with_lines.sigma:.3g} V/sqrt(s).')
    else:
        moved = without.usable or with_lines.usable
        left = ', and the remainder cannot be fitted' if not without.usable else (
            ', and only then does the fit succeed: the node, which keeps them, gives no numbers')
        text = f'{taken}{left}.'
    return QualityItem('LINES_TAKEN_OUT', Severity.WARNING if moved else Severity.INFO, text,
                       (throttle,))


def second_items(throttles: Sequence[float]) -> list[QualityItem]:
    """Say where a second relaxation was found (throttles 0..1)."""
    return [QualityItem('SECOND_RELAXATION', Severity.WARNING, (
        'The noise shows a second relaxation, slower or faster than the fitted one: alpha, tau '
        'and Var_inf are those of a mixture, and their intervals hold for neither; the other '
        'levels may hide the same. `ou-monitor discover` fits both.'), tuple(throttles))
        ] if throttles else []


def scale_items(throttles: Sequence[float]) -> list[QualityItem]:
    """Say at which levels alpha and sigma are not those beside level and load (0..1)."""
    return [QualityItem('OTHER_TIME_SCALE', Severity.INFO, (
        'Alpha and sigma of the level describe another time scale than the relaxation beside '
        'level and load: they hold slow changes of the level, too.'),
        tuple(throttles))] if throttles else []


def coupling_items(throttles: Sequence[float]) -> list[QualityItem]:
    """Say where the noise shows an AC-coupled instrument (throttles 0..1)."""
    return [QualityItem('AC_COUPLING', Severity.WARNING, (
        'Slow noise is missing, as behind an AC-coupled instrument: alpha, tau and Var_inf '
        'describe rail and instrument together; repeat with a DC-coupled instrument. '
        '`ou-monitor discover` fits both.'), tuple(throttles))] if throttles else []
