"""
One load level of a recording -> its fit, tests, spectrum and lines.

The onboard estimator (`ou_monitor.online.estimator.estimator.SlidingEstimator`) fits each segment
of the level, with a window as long as the segment, after spectral lines were taken out; the
estimates are then pooled.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from ou_monitor.analysis.level_comparison import at_common_alpha, level_sags, LevelSag
from ou_monitor.analysis.levels import LoadLevel, Segment
from ou_monitor.analysis.process_type import classify, ProcessType, Verdict
from ou_monitor.analysis.spectrum import level_spectrum, Spectrum
from ou_monitor.criticism.curves import bin_width
from ou_monitor.criticism.innovations import FAMILY_WISE, fresh, innovations
from ou_monitor.criticism.level_tests import adjusted, examine_level, holm, Shape
from ou_monitor.model.spectral_lines import find_lines, Grid, LineSearch, on_grid, without_lines
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.records import (
    Estimate, Flag, FloatArray, LOG_NAMES, NAN, Recording, Status)
from ou_monitor.text import p_words
from scipy import stats

# Fewer samples than this are not even offered to the estimator.
_MIN_SEGMENT = 16
# Intervals widened by more than this factor have a note.
_WIDENED = 1.5
# Fewer samples have no histogram.
_LEAST_BINNED = 50


def fit_segment(recording: Recording, start: int, stop: int) -> Estimate:
    """Fit one segment of samples with the estimator that flies."""
    t = recording.t[start:stop]
    # A hair longer than the segment, so that rounding loses no sample.
    estimator = SlidingEstimator(window=1.001 * float(t[-1] - t[0]) + 1e-6)
    throttle = recording.throttle[start:stop]
    known = bool(np.isfinite(throttle).any())
    estimator.push(t, recording.voltage[start:stop], throttle if known else None)
    return estimator.estimate()


def pool(estimates: Sequence[Estimate]) -> tuple[Estimate, float]:
    """
    Combine the estimates of segments that share one set of parameters.

    The logarithms of alpha, sigma and Var_inf are averaged with the duration
    of each segment as weight.  That is the inverse variance when the segments
    do share their parameters; weights from each segment's own standard error
    would favour the segments whose alpha came out high by chance.
    """
    if not estimates:
        raise ValueError('nothing to pool: no estimates')
    if len(estimates) == 1:
        return estimates[0], 1.0
    good = [e for e in estimates if e.usable]
    if sum(e.duration for e in good) < 0.5 * sum(e.duration for e in estimates) or not good:
        return _majority(estimates), 1.0
    if len(good) == 1:
        return good[0], 1.0
    weight = np.array([e.duration for e in good])
    weight /= weight.sum()
    values: dict[str, float] = {}
    scatter = 1.0
    for name in LOG_NAMES:
        logs = np.log([getattr(e, name) for e in good])
        se = np.array([getattr(e, name + '_se') for e in good])
        mean = float(weight @ logs)
        values[name] = math.exp(mean)
        values[name + '_se'] = float(np.sqrt(weight ** 2 @ se ** 2))
        chi2 = float(np.sum(((logs - mean) / se) ** 2))
        scatter = max(scatter, math.sqrt(chi2 / (len(good) - 1)))
    n = sum(e.n for e in good)
    duration = float(sum(e.duration for e in good))
    flags = tuple(f for f in Flag if any(f in e.flags for e in good))
    long_enough = any(e.status is Status.OK for e in good)
    return Estimate(
        t=good[-1].t, alpha=values['alpha'], sigma=values['sigma'], var_inf=values['var_inf'],
        u0=float(weight @ [e.u0 for e in good]), noise_std=_rms([e.noise_std for e in good]),
        alpha_se=scatter * values['alpha_se'], sigma_se=scatter * values['sigma_se'],
        var_inf_se=scatter * values['var_inf_se'], u0_se=_mean_se(weight, good),
        throttle=good[-1].throttle,
        status=Status.OK if long_enough else Status.SHORT_WINDOW,
        flags=flags, n=n, duration=duration,
        rate=float(np.median([e.rate for e in good]))), scatter


def disagreement(estimates: Sequence[Estimate]) -> float:
    """
    Test whether segments share one set of parameters.

    chi^2 of the logarithms of alpha, sigma and Var_inf about their weighted means, each of the
    three against its own standard errors; the error of alpha is carried over to the common alpha,
    for a segment whose alpha came out low shows too small a one.
    """
    good = [e for e in estimates if e.usable]
    if len(good) < 2:
        return NAN
    least = 1.0
    for name in LOG_NAMES:
        logs = np.log([getattr(e, name) for e in good])
        own = np.array([getattr(e, name + '_se') for e in good])
        if name != 'sigma':
            own = at_common_alpha(np.log([e.alpha for e in good]), own)
        weight = 1.0 / own ** 2
        chi2 = float(weight @ (logs - float(weight @ logs / weight.sum())) ** 2)
        least = min(least, float(stats.chi2.sf(chi2, len(good) - 1)))
    return min(1.0, len(LOG_NAMES) * least)


def _majority(estimates: Sequence[Estimate]) -> Estimate:
    """Return the longest of the unusable estimates whose status held longest."""
    bad = [e for e in estimates if not e.usable]
    time: dict[Status, float] = {}
    for e in bad:
        time[e.status] = time.get(e.status, 0.0) + e.duration
    most = max(time, key=lambda status: time[status])
    return max((e for e in bad if e.status is most), key=lambda e: (e.duration, e.n))


def _rms(values: Sequence[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return math.sqrt(sum(v * v for v in known) / len(known)) if known else NAN


def _mean_se(weight: FloatArray, good: Sequence[Estimate]) -> float:
    return float(np.sqrt(weight ** 2 @ np.array([e.u0_se for e in good]) ** 2))


@dataclass(frozen=True, eq=False)
class LevelResult:
    """
    What one load level shows.

    Attributes
    ----------
    throttle : float
        Throttle, 0..1; NaN for a level that holds the whole recording.
    segments : tuple of Segment
        Segments of samples that were used.
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
        OU parameters, pooled over the segments, of the voltage without its lines.
    shape : Shape
        Tests of the kind of process, adjusted over all levels.
    verdict : Verdict
        Kind of process, and why.
    sag : LevelSag
        How far the mean lies below that of the lowest throttle.
    spectrum : Spectrum
        PSD, measured and fitted.
    lines : LineSearch
        Spectral lines, and what would have been found.
    with_lines : Estimate or None
        As the node would see the level, when its lines were taken out; None when they were not.
    notes : tuple of str
        What to know before using the numbers.
    scatter : float
        How much more its segments differ than their errors allow; those of the pooled estimate
        are already widened by it.
    scatter_p : float
        Probability that segments of one process differ as much, after Holm over all levels; NaN
        with fewer than two segments.

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
    shape: Shape
    verdict: Verdict = Verdict(ProcessType.UNDETERMINED, 'not judged')
    sag: LevelSag = LevelSag()
    spectrum: Spectrum = field(default_factory=Spectrum)
    lines: LineSearch = field(default_factory=LineSearch)
    with_lines: Estimate | None = None
    notes: tuple[str, ...] = ()
    scatter: float = 1.0
    scatter_p: float = NAN

    @property
    def kind(self) -> ProcessType:
        """Kind of process."""
        return self.verdict.kind

    @property
    def doubted(self) -> bool:
        """Whether one OU in white noise does not describe what was fitted."""
        lines_in = bool(self.lines.lines) and self.with_lines is None
        return lines_in or self.shape['one_relaxation'].rejects or self.wanders

    @property
    def wanders(self) -> bool:
        """Whether a second relaxation is detected."""
        return self.shape['second_relaxation'].rejects

    @property
    def coupled(self) -> bool:
        """Whether the noise lacks what an AC-coupled instrument takes out."""
        return self.shape.coupling_p < FAMILY_WISE

    @property
    def crest(self) -> float:
        """Vpp over Vrms, dimensionless."""
        return self.vpp / self.vrms if self.vrms > 0.0 else NAN

    def density(self) -> tuple[FloatArray, FloatArray]:
        """Return edges and density of the deviation over Vrms; empty with too few samples."""
        if self.n < _LEAST_BINNED or not self.vrms > 0.0:
            return np.zeros(0), np.zeros(0)
        z = self.deviation / self.vrms
        # Within what a plot can show.
        width = min(max(bin_width(z), 0.05), 0.5)
        edges = np.arange(-6.0, 6.0 + width, width)
        return edges, np.histogram(z, edges)[0] / (self.n * np.diff(edges))

    @property
    def label(self) -> str:
        """Name of the level for people."""
        return 'all' if math.isnan(self.throttle) else f'{100.0 * self.throttle:.3g} %'


def fit_level(recording: Recording, still: Recording, level: LoadLevel, levels: int
              ) -> LevelResult:
    """Return the result of one level, its kind not judged yet."""
    segments = [s for s in level.segments if s.stop - s.start >= _MIN_SEGMENT]
    if not segments:
        segments = [s for s in level.segments if s.stop - s.start >= 2]
    if not segments:
        nothing = Estimate(throttle=level.throttle, status=Status.TOO_FEW_SAMPLES)
        return LevelResult(level.throttle, (), 0.0, 0, NAN, NAN, NAN, NAN, np.zeros(0), nothing,
                           examine_level([], nothing))
    fits = [fit_segment(recording, s.start, s.stop) for s in segments]
    estimate, scatter = _pooled(fits)
    parts = [recording.voltage[s.start:s.stop] for s in segments]
    grids = [on_grid(still.t[s.start:s.stop], still.voltage[s.start:s.stop]) for s in segments]
    even = _grid_rate(grids)
    lines = find_lines([grid.values for grid in grids], even, levels=levels, white=[
        _white(still.t[s.start:s.stop], still.voltage[s.start:s.stop], estimate)
        for s in segments] if estimate.usable else ())
    shape = examine_level([_kept(still, s, estimate) for s in segments], estimate)
    with_lines = None
    # Impulses at even distances have lines, too: those are not taken out.
    if lines.lines and not holm([shape])[0]['impulses'].rejects:
        with_lines = estimate
        clean, quiet = (_without_lines(x, segments, even, lines) for x in (recording, still))
        fits = [fit_segment(clean, s.start, s.stop) for s in segments]
        estimate, scatter = _pooled(fits)
        shape = examine_level([_kept(quiet, s, estimate) for s in segments], estimate)
    deviation = np.concatenate([v - v.mean() for v in parts])
    return LevelResult(
        throttle=level.throttle, segments=tuple(segments),
        time=float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments)),
        n=deviation.size, mean=float(np.concatenate(parts).mean()),
        vpp=float(np.ptp(deviation)), peak=float(np.abs(deviation).max()),
        vrms=float(np.sqrt(np.mean(deviation ** 2))), deviation=deviation, estimate=estimate,
        shape=shape, spectrum=level_spectrum(still, segments, estimate), lines=lines,
        with_lines=with_lines,
        notes=_level_notes(fits, estimate), scatter=scatter, scatter_p=disagreement(fits))


def _pooled(fits: Sequence[Estimate]) -> tuple[Estimate, float]:
    """Return the estimate of a level and the scatter of its segments."""
    estimate, scatter = pool(fits)
    # Within a level throttle is meant to stand still.
    return replace(estimate, flags=tuple(
        flag for flag in estimate.flags if flag is not Flag.NO_EXCITATION)), scatter


def _white(t: FloatArray, voltage: FloatArray, estimate: Estimate) -> FloatArray:
    """Return the innovations of a segment on an even clock (t in s, voltage in V)."""
    noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
    return on_grid(t, innovations(t, voltage - voltage.mean(), estimate.alpha, estimate.var_inf,
                                  noise * noise)).values


def _grid_rate(grids: Sequence[Grid]) -> float:
    """Return the rate of the clock of segments, Hz; 0 when there is no time."""
    steps = sum(grid.values.size - 1 for grid in grids)
    time = sum((grid.values.size - 1) / grid.rate for grid in grids)
    return steps / time if time > 0.0 else 0.0


def _without_lines(recording: Recording, segments: Sequence[Segment], rate: float,
                   lines: LineSearch) -> Recording:
    """Return the recording without the spectral lines of a level, in its segments."""
    voltage = recording.voltage.copy()
    for s in segments:
        grid = on_grid(recording.t[s.start:s.stop], voltage[s.start:s.stop])
        voltage[s.start:s.stop] = without_lines(grid.values, rate, lines.lines)[grid.where]
    return replace(recording, voltage=voltage)


def _kept(recording: Recording, segment: Segment, estimate: Estimate
          ) -> tuple[FloatArray, FloatArray]:
    """Return stamps and voltages of a segment, repeats of the logger left out."""
    t = recording.t[segment.start:segment.stop]
    voltage = recording.voltage[segment.start:segment.stop]
    keep = fresh(voltage, estimate)
    return t[keep], voltage[keep]


def judge_levels(recording: Recording, results: Sequence[LevelResult]
                 ) -> tuple[LevelResult, ...]:
    """Name the kind of each level, the tests of all adjusted together; and compare means."""
    shapes = holm([level.shape for level in results])
    sags = level_sags(recording, [level.throttle for level in results],
                      [level.segments for level in results],
                      [level.estimate for level in results], [level.vrms for level in results])
    apart = adjusted([level.scatter_p for level in results])
    return tuple(
        replace(level, shape=shape, sag=sag, scatter_p=p,
                notes=level.notes + _scatter_notes(level.scatter, p), verdict=classify(
                    level.estimate, shape, sum(line.share for line in level.lines.lines)))
        for level, shape, sag, p in zip(results, shapes, sags, apart))


def _scatter_notes(scatter: float, p: float) -> tuple[str, ...]:
    """Say that the segments differ: that they are not one process, or only what was widened."""
    if p < FAMILY_WISE:
        return (f'Its segments differ {scatter:.1f} times more than sampling allows ('
                f'{p_words(p)}): the level is not one process; the intervals were widened by that '
                'factor.',)
    if scatter > _WIDENED:
        return (f'The intervals are wider by a factor of {scatter:.1f}, by which its segments '
                'scatter more than their errors; so much comes by chance.',)
    return ()


def _level_notes(fits: list[Estimate], pooled: Estimate) -> tuple[str, ...]:
    notes = []
    used = sum(e.usable for e in fits)
    if not pooled.usable and len({e.status for e in fits}) > 1:
        notes.append('Most of its segments are too short to be fitted, or show no relaxation.')
    elif used < len(fits) and len(fits) > 1:
        notes.append(f'{len(fits) - used} of {len(fits)} segments could not be fitted; alpha, '
                     'sigma and Var_inf rest on the others.')
    return tuple(notes)
