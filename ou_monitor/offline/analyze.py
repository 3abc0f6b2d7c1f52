"""
A recording -> the paper's Tables 1 and 2 for it, with intervals.

Every number of the OU comes from the estimator that flies
(`ou_monitor.online.estimator.SlidingEstimator`); here it gets a window as
long as the stretch of constant load.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.offline.levels import find_levels, LoadLevel, Segment
from ou_monitor.offline.pooling import fit_stretch, pool, standardised_increments
from ou_monitor.offline.process_type import classify, excess_kurtosis, ProcessType
from ou_monitor.offline.sliding import slide, Sliding
from ou_monitor.records import Estimate, Flag, FloatArray, NAN, Recording, Status

Progress = Callable[[float], None]

# Fewer samples than this are not even offered to the estimator.
_MIN_SEGMENT = 16


@dataclass(frozen=True, eq=False)
class LevelResult:
    """
    What one load level shows.

    Attributes
    ----------
    throttle : float
        Throttle, 0..1; NaN for a level that holds the whole recording.
    segments : tuple of Segment
        Stretches of samples that were used.
    time : float
        Time in them, s.
    n : int
        Samples in them.
    mean : float
        Mean voltage, V.
    vpp, peak, vrms : float
        Peak to peak, largest absolute value and rms of the deviation from the
        mean of its segment, V (as an AC-coupled oscilloscope would show it).
    deviation : ndarray, shape (n,)
        That deviation, V.
    estimate : Estimate
        OU parameters, pooled over the segments.
    kurtosis, kurtosis_se : float
        Excess kurtosis of the standardised increments and its standard error
        for a Gaussian.
    kind : ProcessType
        Kind of process.
    reason : str
        Why it is called that, one sentence.
    notes : tuple of str
        What to know before using the numbers.

    """

    throttle: float
    segments: tuple[Segment, ...]
    time: float
    n: int
    mean: float
    vpp: float
    peak: float
    vrms: float
    deviation: FloatArray
    estimate: Estimate
    kurtosis: float
    kurtosis_se: float
    kind: ProcessType
    reason: str
    notes: tuple[str, ...] = ()

    @property
    def crest(self) -> float:
        """Vpp over Vrms, dimensionless."""
        return self.vpp / self.vrms if self.vrms > 0.0 else NAN

    @property
    def label(self) -> str:
        """Name of the level for people."""
        return 'all' if math.isnan(self.throttle) else f'{100.0 * self.throttle:.3g} %'


@dataclass(frozen=True, eq=False)
class Analysis:
    """
    Result of `analyze`.

    Attributes
    ----------
    recording : Recording
        What was analysed.
    levels : tuple of LevelResult
        In order of throttle.
    sliding : Sliding
        What the node would have published.
    notes : tuple of str
        What was dropped or left out, one sentence each.

    """

    recording: Recording
    levels: tuple[LevelResult, ...]
    sliding: Sliding
    notes: tuple[str, ...]


def analyze(recording: Recording, *, levels: tuple[float, ...] | None = None,
            window: float = 2.0, brownout_voltage: float = NAN,
            brownout_horizon: float = 5.0, progress: Progress | None = None) -> Analysis:
    """
    Analyse a recording load level by load level.

    Parameters
    ----------
    recording : Recording
        What to analyse.
    levels : tuple of float, optional
        Throttles 0..1 to use; found from the recording when left out.
    window : float
        Window of the sliding estimate, s.
    brownout_voltage : float
        Threshold of the risk, V; NaN leaves the risk unknown.
    brownout_horizon : float
        Horizon of the risk, s.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Analysis
        Tables, sliding series and notes.

    Raises
    ------
    ValueError
        For a level, window or horizon out of range.

    """
    tell: Progress = progress or (lambda share: None)
    found = find_levels(recording.t, recording.throttle, levels)
    results = []
    for k, level in enumerate(found):
        results.append(_level(recording, level))
        tell(0.5 * (k + 1) / len(found))
    sliding = slide(recording, window, brownout_voltage, brownout_horizon,
                    lambda share: tell(0.5 + 0.5 * share))
    return Analysis(recording, tuple(results), sliding,
                    recording.notes + _left_out(recording, found))


def _level(recording: Recording, level: LoadLevel) -> LevelResult:
    """Return the result of one level."""
    segments = [s for s in level.segments if s.stop - s.start >= _MIN_SEGMENT]
    if not segments:
        segments = [s for s in level.segments if s.stop - s.start >= 2]
    if not segments:
        return LevelResult(
            level.throttle, (), 0.0, 0, NAN, NAN, NAN, NAN, np.zeros(0),
            Estimate(throttle=level.throttle, status=Status.TOO_FEW_SAMPLES), NAN, NAN,
            ProcessType.UNDETERMINED, 'No samples at this throttle.')
    fits = [fit_stretch(recording, s.start, s.stop) for s in segments]
    estimate, scatter = pool(fits)
    # Within a level throttle is meant to stand still.
    flags = tuple(f for f in estimate.flags if f is not Flag.NO_EXCITATION)
    estimate = replace(estimate, flags=flags)
    parts = [recording.voltage[s.start:s.stop] for s in segments]
    deviation = np.concatenate([v - v.mean() for v in parts])
    kurtosis, kurtosis_se = excess_kurtosis(np.concatenate([
        standardised_increments(recording, s.start, s.stop, e)
        for s, e in zip(segments, fits)]))
    kind, reason = classify(estimate, kurtosis, kurtosis_se)
    return LevelResult(
        throttle=level.throttle, segments=tuple(segments),
        time=float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments)),
        n=deviation.size, mean=float(np.concatenate(parts).mean()),
        vpp=float(np.ptp(deviation)), peak=float(np.abs(deviation).max()),
        vrms=float(np.sqrt(np.mean(deviation ** 2))), deviation=deviation, estimate=estimate,
        kurtosis=kurtosis, kurtosis_se=kurtosis_se, kind=kind, reason=reason,
        notes=_level_notes(fits, estimate, scatter))


def _level_notes(fits: list[Estimate], pooled: Estimate, scatter: float) -> tuple[str, ...]:
    notes = []
    used = sum(e.usable for e in fits)
    if not pooled.usable and len(fits) > 1:
        longest = max(e.duration for e in fits)
        notes.append(f'Of its {len(fits)} segments (the longest {longest:.3g} s) most cannot be '
                     'fitted.')
    elif used < len(fits) and len(fits) > 1:
        notes.append(f'{len(fits) - used} of {len(fits)} segments could not be fitted; alpha, '
                     'sigma and Var_inf rest on the others.')
    if scatter > 1.5:
        notes.append(f'Its segments differ {scatter:.1f} times more than sampling allows: the '
                     'level is not one process; the intervals were widened by that factor.')
    return tuple(notes)


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
