"""
Everything that is doubtful about a recording, in one list, worst first.

It gathers what the estimator flags at each level, what the reader dropped or mended, and what the
samples and stamps show by themselves.  Limits: a list without warnings says that nothing was
found, not that there is nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np
from ou_monitor.analyze.levels import GAP_STEPS
from ou_monitor.criticism.quality_item import QualityItem, Severity
from ou_monitor.online.estimator.quality import examine, TAIL
from ou_monitor.records import Estimate, Flag, Recording, Status

# Flags that inform; the others make numbers doubtful.
_INFORMS = frozenset({Flag.HELD_SAMPLES, Flag.IRREGULAR, Flag.NO_EXCITATION})
# Root mean square of the steps about their median, in medians, from which a clock is uneven.
_UNEVEN = 0.05
# No supply of a UAV has more, V; the millivolts of any do.
_MOST_VOLTS = 1000.0
# Throttle may go beyond 0..1 by so much, as sticks out of trim do, and by more for so small a
# share of the samples.
_TRIM, _RARE = 0.05, 0.01
# Stretches of samples looked at for ADC steps.
_LOOKS = 8
# What the reader's sentences are about: a word in them, the name, and whether numbers suffer.
_READER = (('cannot be decoded', 'DAMAGED_FILE', True), ('damaged', 'DAMAGED_FILE', True),
           ('gap', 'GAPS', True), ('sorted by stamp', 'UNORDERED', True),
           ('clock went back', 'UNORDERED', True), ('stamp was there', 'REPEATED_STAMPS', True),
           ('not a finite', 'NON_FINITE', True))

NOISE_UNKNOWN = (
    'White noise of the sensor is not told from the supply here: where there is some, alpha '
    'and sigma come out too high (Var_inf does not).')


def quality_list(recording: Recording, throttles: Sequence[float], estimates: Sequence[Estimate],
                 notes: Sequence[Sequence[str]], more: Sequence[QualityItem] = ()
                 ) -> tuple[QualityItem, ...]:
    """Gather what is doubtful."""
    found: dict[tuple[str, Severity, str], list[float]] = {}
    for throttle, estimate, told in zip(throttles, estimates, notes):
        for item in [*_of_estimate(estimate), *(('SEGMENTS', Severity.INFO, text)
                                                for text in told)]:
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
            f'Half of the voltages are beyond {middle:.4g}, as no supply of a UAV is in volts: '
            'millivolts, or counts of an ADC? Alpha and tau hold all the same; what is given in V '
            'is in that unit instead, and there is no risk: divide millivolts by 1000 (of a bag: '
            'unit_factor of a msg config).')))
    known = recording.throttle[np.isfinite(recording.throttle)]
    low, high = np.quantile(known, (_RARE, 1.0 - _RARE)) if known.size else (0.0, 1.0)
    if low < -_TRIM or high > 1.0 + _TRIM:
        items.append(QualityItem('THROTTLE_RANGE', Severity.WARNING, (
            f'Throttle runs from {low:.3g} to {high:.3g}, and 0 to 1 is expected: the curves, the '
            'risk and the throttle budget know nothing outside, and sag counts from the lowest '
            'throttle. Of a stick from -1 to 1 take (x + 1) / 2; of reverse thrust the absolute '
            'value.')))
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
            f'{int(pauses.sum())} pause{"s" if pauses.sum() > 1 else ""} without samples, '
            f'{float(steps[pauses].sum()):.3g} s in all, the longest '
            f'{float(steps.max()):.3g} s; no level reaches across one.')))
    jitter = float(np.sqrt(np.mean((steps[~pauses] / median - 1.0) ** 2)))
    if jitter > _UNEVEN:
        items.append(QualityItem('UNEVEN_CLOCK', Severity.INFO, (
            f'The steps between stamps scatter by {100.0 * jitter:.0f} % of their median '
            f'({1e3 * median:.3g} ms): spectra take them as even.')))
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
    held = max((look.held for look in looks), default=1.0)
    if held > 1.0:
        items.append(QualityItem('REPEATS', Severity.INFO, (
            f'The source is refreshed every {held:.3g} samples; the logger repeats it in '
            'between.')))
    clipped = sum(look.saturated for look in looks)
    if clipped:
        items.append(QualityItem('CLIPPED', Severity.WARNING, (
            f'In {clipped} of {len(looks)} stretches looked at the voltage piles up at one end '
            'of its range: the ADC may be at its limit.')))
    return items
