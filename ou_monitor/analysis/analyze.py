"""A recording -> the paper's Tables 1 and 2 for it, with intervals, and what they rest on."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.analysis.crafts import Craft, craft_of
from ou_monitor.analysis.level_comparison import alpha_constancy, AlphaTest
from ou_monitor.analysis.level_result import fit_level, judge_levels, LevelResult
from ou_monitor.analysis.levels import find_levels, LoadLevel
from ou_monitor.analysis.overview import Overview, overview
from ou_monitor.analysis.quality import (
    coupling_items, line_item, quality_list, QualityItem, second_items)
from ou_monitor.analysis.relaxation import (
    find_steps, fit_relaxation, judge_cause, Relaxation, ReleaseCause)
from ou_monitor.analysis.replay import by_throttle, ByThrottle, slide, Sliding
from ou_monitor.analysis.supply import remainder
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import NAN, Recording
from ou_monitor.timeline.line import readings_of

Progress = Callable[[float], None]

# Voltages, V, between which the median of a 5 V rail lies.
RAIL = (4.0, 6.0)


@dataclass(frozen=True, eq=False)
class Analysis:
    """Result of `analyze`."""

    recording: Recording  # What was analysed
    levels: tuple[LevelResult, ...]  # In order of throttle
    # After falls of throttle (``release``) and rises (``load``).
    relaxations: tuple[Relaxation, ...]
    # Of each relaxation: the noise's own time constant, or the instrument.
    causes: tuple[ReleaseCause, ...]
    alpha_test: AlphaTest  # Whether alpha is the same at all levels
    by_throttle: ByThrottle  # Sag, noise and risk over throttle
    sliding: Sliding  # What the node would have published
    quality: tuple[QualityItem, ...]  # What to know before using the numbers, worst first
    # Whether the voltage of the risk is the node's default, not one that was asked for.
    brownout_default: bool
    notes: tuple[str, ...]  # What was dropped or left out, one sentence each
    overview: Overview  # Lowest voltage, dips, sag and noise: what is known of every recording
    craft: Craft  # Cells, and sag, noise and resistance beside those of known crafts


def analyze(recording: Recording, *, levels: tuple[float, ...] | None = None,
            window: float = 2.0, brownout_voltage: float | None = None,
            brownout_horizon: float = 5.0, cells: int = 0,
            progress: Progress | None = None) -> Analysis:
    """
    Analyse a recording load level by load level.

    window in s, brownout_voltage in V (of so many cells, to tell it by the cell),
    brownout_horizon in s, progress 0..1.
    """
    if not (np.diff(recording.t) > 0.0).all():
        raise ValueError('stamps must be finite and increase, as read_recording leaves them')
    report: Progress = progress or (lambda share: None)
    recording = readings_of(recording)
    voltage = _default_voltage(recording) if brownout_voltage is None else brownout_voltage
    found = find_levels(recording.t, recording.throttle, levels)
    left = remainder(recording)
    results = []
    for k, level in enumerate(found):
        results.append(fit_level(recording, left, level, len(found)))
        report(0.5 * (k + 1) / len(found))
    sliding = slide(recording, window, voltage, brownout_horizon,
                    lambda share: report(0.5 + 0.5 * share))
    seen = overview(recording, None if math.isnan(voltage) else voltage, results, cells,
                    left, sliding.monitor)
    judged = judge_levels(results, seen.load)
    throttles = [level.throttle for level in judged]
    estimates = [level.estimate for level in judged]
    relaxations = _relaxations(recording, judged)
    lines = [line_item(level.throttle, level.estimate, level.with_lines) for level in judged
             if level.lines.lines]
    # A second relaxation is the supply's: where it is too faint to detect it still biases alpha.
    wanders = any(level.wanders for level in judged)
    alpha = alpha_constancy(throttles, estimates,
                            [wanders or level.doubted for level in judged])
    return Analysis(
        recording, judged, relaxations, tuple(judge_cause(r, alpha) for r in relaxations), alpha,
        by_throttle(seen, voltage, brownout_horizon), sliding,
        quality_list(recording, throttles, estimates,
                     lines + second_items([level.throttle for level in judged if level.wanders])
                     + coupling_items([level.throttle for level in judged if level.coupled])),
        brownout_voltage is None, recording.notes + _left_out(recording, found), seen,
        craft_of(recording, seen.facts, cells))


def _default_voltage(recording: Recording) -> float:
    """Return the node's default, V, for a 5 V rail; NaN for any other supply."""
    low, high = RAIL
    middle = float(np.median(recording.voltage)) if recording.n else NAN
    return MonitorSettings().brownout_voltage if low <= middle <= high else NAN


def _relaxations(recording: Recording, levels: Sequence[LevelResult]) -> tuple[Relaxation, ...]:
    """Fit what follows falls and rises of throttle."""
    throttles = [level.throttle for level in levels]
    estimates, rms = [level.estimate for level in levels], [level.vrms for level in levels]
    steps = find_steps(recording, throttles)
    falls = [throttles[step.after] < throttles[step.before] for step in steps]
    return tuple(
        fit_relaxation(recording, kind, [step for step, down in zip(steps, falls)
                                         if down == wanted], throttles, estimates, rms)
        for kind, wanted in (('release', True), ('load', False)))


def _left_out(recording: Recording, found: tuple[LoadLevel, ...]) -> tuple[str, ...]:
    """Say which part of the recording no level holds."""
    if not recording.n:
        return ('The recording holds no samples.',)
    if not recording.has_throttle:
        return ('The recording has no throttle: it is taken as one load level.',)
    if any(math.isnan(level.throttle) for level in found):
        return ('No throttle was held long enough for a load level: the recording is taken as '
                'one, with throttle as a regressor; --levels names levels.',)
    held = sum(float(recording.t[s.stop - 1] - recording.t[s.start])
               for level in found for s in level.segments)
    settling = sum(level.settling for level in found)
    notes = []
    unknown = int(np.isnan(recording.throttle).sum())
    if unknown:
        notes.append(f'{unknown} samples before the first throttle belong to no load level.')
    if settling > 0.0:
        notes.append(f'{settling:.3g} s after changes of throttle were left out of the levels '
                     '(settling).')
    moving = recording.duration - held - settling
    if moving > 0.01 * recording.duration:
        notes.append(f'{moving:.3g} of {recording.duration:.3g} s were spent between load '
                     'levels.')
    return tuple(notes)
