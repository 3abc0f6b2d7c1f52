"""
Cautions about the quality of a recording, worst first.

They come from the flags of each level, the samples that the reader dropped or repaired, the
samples and stamps themselves, and the effects of lines and of a second relaxation on the fit of a
level.

Limits: a list without warnings does not prove that a recording is free of defects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ou_monitor.analysis.crafts import doubtful_cells, full_voltage
from ou_monitor.criticism.adc import (
    EXAMINED, find_rails, find_step, innovation_std, step_words, usual_change)
from ou_monitor.criticism.readings import why_stuck
from ou_monitor.online.trust import MOST_SUPPLY
from ou_monitor.records import (
    clock_unit, defect_of, Estimate, Flag, Recording, Severity, Status)
from ou_monitor.timeline import scatter_words

# Flags for information; the others are warnings.
_INFORMS = frozenset({Flag.HELD_SAMPLES, Flag.IRREGULAR, Flag.NO_EXCITATION})
# Statuses that are not defects: the rate or length of the recording does not allow an estimate.
_LIMITS = frozenset({Status.TOO_FEW_SAMPLES, Status.TOO_SHORT, Status.UNBOUND, Status.BURIED,
                     Status.NO_RELAXATION})
# Maximum scatter of the steps of an even clock: rms about the median, as a share of the median.
_UNEVEN = 0.05
# Step, s, above which a wrong time unit is suspected (battery messages of autopilots come more
# often); a lower one for recordings longer than _LONG_FLIGHT, s.
_LONG_STEP, _SLOW, _LONG_FLIGHT = 5.0, 0.9, 10_800.0
# Tolerance of throttle beyond 0..1 (trim), and maximum share of samples beyond that.
_TRIM, _RARE = 0.05, 0.01
# Minimum samples for a statement on the ADC.
_FEWEST = 64
# Warnings that change the meaning of every number.
_BEWARE = {
    'VOLTAGE_SIGN': (
        'Beware: the voltage is negative throughout: swap the leads of the sensor, or change the '
        'sign.'),
    'VOLTAGE_UNIT': 'Beware: the voltages seem to be millivolts or counts, not volts.',
    'TIME_UNIT': 'Beware: the time seems to be in a unit smaller than seconds.'}
# Minimum readings of a constant voltage for a stuck sensor.
_STUCK_READINGS = 10


@dataclass(frozen=True)
class QualityItem:
    """One thing to know before using the numbers."""

    name: str  # Stable key in capitals
    severity: Severity  # ERROR: there are no numbers; WARNING: they are doubtful
    text: str  # One sentence
    throttles: tuple[float, ...] = ()  # Levels it applies to; empty: the whole recording


def quality_list(recording: Recording, throttles: Sequence[float], estimates: Sequence[Estimate],
                 more: Sequence[QualityItem] = (), known: bool = False, pauses: str = '',
                 ) -> tuple[QualityItem, ...]:
    """Return all cautions, worst first (known: alpha of the whole recording is determined)."""
    # pauses: of the recording with the samples that were left out, by `pause_words`.
    found: dict[tuple[str, Severity, str], list[float]] = {}
    for throttle, estimate in zip(throttles, estimates):
        for doubt in _fit_doubts(estimate, known):
            found.setdefault(doubt, []).append(throttle)
    for item in more:
        found.setdefault((item.name, item.severity, item.text), []).extend(item.throttles)
    items = [QualityItem(*key, tuple(where)) for key, where in found.items()]
    for note in recording.notes:
        defect = defect_of(note)
        items.append(QualityItem(defect.name, defect.severity, note))
    if pauses:
        items.append(QualityItem('PAUSES', Severity.WARNING,
                                 f'{pauses[2:]}; no level spans a pause.'))
    items = _unit_items(recording) + items + _stamp_items(recording) + _sample_items(recording)
    return tuple(sorted(items, key=lambda item: -item.severity))


def _fit_doubts(e: Estimate, known: bool) -> list[tuple[str, Severity, str]]:
    items = []
    if e.status in _LIMITS and known:
        items.append(('LEVEL_ALONE', Severity.INFO, 'The relaxation is visible in the noise at '
                      'all throttles together, not at this level alone.'))
    elif e.status in _LIMITS:
        items.append((e.status.name, Severity.INFO, e.status.value))
    elif e.status is not Status.OK:
        severity = Severity.WARNING if e.usable else Severity.ERROR
        items.append((e.status.name, severity, e.status.value))
    items += [(flag.name, Severity.INFO if flag in _INFORMS else Severity.WARNING, flag.value)
              for flag in e.flags]
    return items


def beware(recording: Recording, cells: int = 0) -> tuple[str, ...]:
    """Return the warnings that change the meaning of every number (cells given; 0: none)."""
    found = tuple(_BEWARE.get(item.name, f'Beware: {item.text[0].lower()}{item.text[1:]}')
                  for item in faults(recording))
    doubt = doubtful_cells(full_voltage(recording), cells) if cells else ''
    return (*found, f'Beware: {doubt}') if doubt else found


def faults(recording: Recording) -> list[QualityItem]:
    """Return the faults of a whole recording that make figures in V, or rates, meaningless."""
    stuck = why_stuck(recording.voltage) if recording.n >= _STUCK_READINGS else ''
    return [*(item for item in _unit_items(recording) if item.name in _BEWARE),
            *([QualityItem('STUCK', Severity.ERROR, stuck)] if stuck else [])]


def _unit_items(recording: Recording) -> list[QualityItem]:
    items = []
    middle = float(np.median(np.abs(recording.voltage))) if recording.n else 0.0
    if middle > MOST_SUPPLY:
        items.append(QualityItem('VOLTAGE_UNIT', Severity.WARNING, (
            f'The median voltage is {middle:.4g}, too large for a UAV in volts: is it in mV, or '
            'in counts of an ADC? Alpha and tau are right, but figures marked V have that unit, '
            'and no risk is computed. Use --unit mV for a CSV, unit_factor in a msg config for a '
            'bag.')))
    if recording.n and float(recording.voltage.max()) < 0.0:
        items.append(QualityItem('VOLTAGE_SIGN', Severity.WARNING, (
            'The voltage is negative throughout, so lowest voltage, sag and risk have no meaning: '
            'swap the leads of the sensor, or change the sign.')))
    step = float(np.median(np.diff(recording.t))) if recording.n > 1 else 0.0
    slow = step > _LONG_STEP or (step > _SLOW and recording.duration > _LONG_FLIGHT)
    if slow and not clock_unit(recording.t[0]) and 'time_unit' not in recording.source:
        items.append(QualityItem('TIME_UNIT', Severity.WARNING, (
            f'The samples are {step:.3g} s apart, over {recording.duration / 3600.0:.3g} hours: '
            'is the unit of time smaller? If so, all rates and times are wrong by a factor of '
            '1000 or 1e6; --time-unit states the unit of a CSV.')))
    known = recording.throttle[np.isfinite(recording.throttle)]
    low, high = np.quantile(known, (_RARE, 1.0 - _RARE)) if known.size else (0.0, 1.0)
    if low < -_TRIM or high > 1.0 + _TRIM:
        items.append(QualityItem('THROTTLE_RANGE', Severity.WARNING, (
            f'Throttle runs from {low:.3g} to {high:.3g} instead of 0 to 1: curves, risk and '
            'throttle budget cover only 0 to 1. Check the sign; use (x + 1) / 2 for a stick from '
            '-1 to 1, and the absolute value for reverse thrust.')))
    return items


def _stamp_items(recording: Recording) -> list[QualityItem]:
    if recording.n < 3:
        return []
    items = []
    if scatter := scatter_words(recording.t, _UNEVEN):
        items.append(QualityItem('UNEVEN_CLOCK', Severity.INFO,
                                 f'{scatter}: the spectra assume even steps.'))
    unknown = int(np.isnan(recording.throttle).sum())
    if unknown and recording.has_throttle:
        items.append(QualityItem('THROTTLE_UNKNOWN', Severity.INFO, (
            f'Throttle is unknown for {unknown} of {recording.n} samples.')))
    return items


def _sample_items(recording: Recording) -> list[QualityItem]:
    """Return properties of the samples: the step of the ADC, and clipping."""
    v = recording.voltage[:EXAMINED]
    if v.size < _FEWEST:
        return []
    items, step, noise = [], find_step(v), innovation_std(v)
    if step > 0.0 and noise > 0.0:
        items.append(QualityItem('ADC_STEP', Severity.INFO, step_words(step, noise)))
    if np.isfinite(find_rails(v, step or usual_change(v), noise)).any():
        items.append(QualityItem('CLIPPED', Severity.WARNING, (
            'Readings accumulate at one end of the range: the ADC may be saturated.')))
    return items


# Cautions about the noise of a level: name and sentence.
_NOISE = {
    'LINES_LEFT_IN': (
        'The level shows impulses and spectral lines. The lines may come from the impulses, so '
        'they were not subtracted: alpha and sigma include both.'),
    'SECOND_RELAXATION': (
        'The noise shows a second relaxation, slower or faster than the fitted one: alpha, tau '
        'and Var_inf describe a mixture, and their intervals are valid for neither; other levels '
        'may have it too. `ou-monitor discover` fits both.'),
    'IMPULSES': (
        'The noise has impulses: alpha, sigma and Var_inf include them, and their intervals are '
        'too narrow. `ou-monitor discover` tells impulses from noise.')}


def noise_items(name: str, throttles: Sequence[float]) -> list[QualityItem]:
    """Return the caution of this name for levels at these throttles, 0..1, if any."""
    return [QualityItem(name, Severity.WARNING, _NOISE[name], tuple(throttles))
            ] if throttles else []
