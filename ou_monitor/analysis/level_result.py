"""
One load level of a recording -> its fit, tests, spectrum and lines.

Level and load are taken out of the whole recording first (`ou_monitor.analysis.supply.remainder`);
what they leave in the segments of the level, without its spectral lines, is fitted by the model
that all commands share (`ou_monitor.model.ou_fit`).

Limits: a relaxation slower than half of a segment, or than 2.5 s, is the level's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from ou_monitor.analysis.levels import LoadLevel, Segment
from ou_monitor.analysis.process_type import classify, ProcessType, Verdict
from ou_monitor.analysis.spectrum import level_spectrum, Spectrum
from ou_monitor.analysis.supply import Remainder
from ou_monitor.criticism.curves import bin_width
from ou_monitor.criticism.innovations import FAMILY_WISE, innovations
from ou_monitor.criticism.level_tests import examine_level, holm, Shape
from ou_monitor.model.ou_fit import fit_pieces
from ou_monitor.model.spectral_lines import find_lines, Grid, LineSearch, on_grid, without_lines
from ou_monitor.online.estimator.quality import examine, input_flags
from ou_monitor.online.load.supply_load import SupplyLoad
from ou_monitor.records import (
    Counters, Estimate, Flag, FloatArray, NAN, OuFacts, Recording, Status)
from ou_monitor.text import Z95
from ou_monitor.timeline.line import TAIL

# Fewer samples than this have no spectrum, tests or lines.
_MIN_SEGMENT = 16
# Fewer samples have no histogram.
_LEAST_BINNED = 50
# What is correlated without a relaxation wanders: the mean square of its steps is less than this
# share of what that of white noise would be.
_WANDERS = 0.5


@dataclass(frozen=True)
class LevelSag:
    """Sag of one level, of the facts."""

    sag: float = NAN  # V, positive
    sag_se: float = NAN  # V

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval, V."""
        return self.sag - Z95 * self.sag_se, self.sag + Z95 * self.sag_se


def mean_variance(time: float, n: int, estimate: Estimate, rms: float) -> float:
    """
    Return the variance of the mean of a segment of OU in white noise.

    time in s, rms in V, result in V^2.
    """
    if not estimate.usable:
        return rms * rms / max(n, 1)
    at = max(estimate.alpha * time, 1e-9)
    # Papoulis, Probability, Random Variables and Stochastic Processes, ch. 9.
    of_ou = 2.0 * estimate.var_inf * (at + math.expm1(-at)) / (at * at)
    noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
    return of_ou + noise * noise / max(n, 1)


def fit_parts(recording: Recording, left: Remainder, segments: Sequence[Segment],
              throttle: float = NAN) -> tuple[OuFacts, Estimate]:
    """Fit segments of a recording, and return the fit as facts and as the node's record."""
    n = sum(s.stop - s.start for s in segments)
    if not n:
        return OuFacts('no_data'), Estimate(throttle=throttle, status=Status.TOO_FEW_SAMPLES)
    parts = [(left.voltage[s.start:s.stop], left.size[s.start:s.stop]) for s in segments]
    ou = fit_pieces(parts, left.dt, left.walk)
    time = float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments))
    mean = sum(float(recording.voltage[s.start:s.stop].sum()) for s in segments) / n
    looked = examine(recording.voltage[segments[-1].start:segments[-1].stop][-TAIL:])
    blank = Estimate(
        t=float(recording.t[segments[-1].stop - 1]), u0=mean, throttle=throttle,
        flags=tuple(input_flags(Counters(), looked, math.inf)), n=n, duration=time,
        rate=1.0 / left.dt)
    ends = [part[0] for part in parts if part[0].size > 1]
    count = sum(part.size for part in ends)
    square = sum(float(part @ part) for part in ends) / max(count, 1)
    steps = sum(float(np.sum(np.diff(part) ** 2)) for part in ends) / max(count - len(ends), 1)
    if ou.status != 'ok':
        status = (Status.TOO_FEW_SAMPLES if ou.status != 'not_visible' else
                  Status.CONSTANT if not ou.var_inf_below else
                  Status.UNBOUND if 0.5 * steps < _WANDERS * square else Status.NO_RELAXATION)
        return ou, replace(blank, status=status)
    # Of the mean square of steps, what the relaxation does not make.
    white = math.sqrt(max(0.0, 0.5 * steps + ou.var_inf * math.expm1(-ou.alpha * left.dt)))
    alpha_se, sigma_se, var_inf_se = (0.5 / Z95 * math.log(high / low) for low, high in (
        ou.alpha_95, ou.sigma_95, ou.var_inf_95))
    e = replace(
        blank, status=Status.OK, alpha=ou.alpha, sigma=ou.sigma, var_inf=ou.var_inf,
        noise_std=white, alpha_se=alpha_se, sigma_se=sigma_se, var_inf_se=var_inf_se)
    flags = (*e.flags, Flag.SLOW_RATE) if ou.alpha * left.dt > 1.0 else e.flags
    return ou, replace(e, flags=flags, u0_se=math.sqrt(mean_variance(time, n, e, NAN)))


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
    ou : OuFacts
        Relaxation in what level and load leave, without its lines, or its bounds.
    estimate : Estimate
        The same, as the node gives it.
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
        With its lines, when these were taken out; None when they were not.

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
    ou: OuFacts
    estimate: Estimate
    shape: Shape
    verdict: Verdict = Verdict(ProcessType.UNDETERMINED, 'not judged')
    sag: LevelSag = LevelSag()
    spectrum: Spectrum = field(default_factory=Spectrum)
    lines: LineSearch = field(default_factory=LineSearch)
    with_lines: Estimate | None = None

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


def fit_level(recording: Recording, left: Remainder, level: LoadLevel, levels: int
              ) -> LevelResult:
    """Return the result of one level, its kind not judged yet."""
    segments = [s for s in level.segments if s.stop - s.start >= _MIN_SEGMENT]
    if not segments:
        segments = [s for s in level.segments if s.stop - s.start >= 2]
    if not segments:
        ou, nothing = fit_parts(recording, left, ())
        return LevelResult(level.throttle, (), 0.0, 0, NAN, NAN, NAN, NAN, np.zeros(0), ou,
                           replace(nothing, throttle=level.throttle), examine_level([], nothing))
    within = [part for s in segments for part in _known(s, left.voltage)]
    ou, estimate = fit_parts(recording, left, within, level.throttle)
    still = replace(recording, voltage=left.voltage)
    grids = [on_grid(still.t[s.start:s.stop], still.voltage[s.start:s.stop]) for s in within]
    even = _grid_rate(grids)
    lines = find_lines([grid.values for grid in grids], even, levels=levels, white=[
        _white(still.t[s.start:s.stop], still.voltage[s.start:s.stop], estimate)
        for s in within] if estimate.usable else ())
    shape = examine_level(_parts(still, within), estimate, left.above)
    with_lines = None
    # Impulses at even distances have lines, too: those are not taken out.
    if lines.lines and not holm([shape])[0]['impulses'].rejects:
        with_lines = estimate
        clean = _without_lines(still, within, even, lines)
        ou, estimate = fit_parts(recording, replace(left, voltage=clean.voltage), within,
                                 level.throttle)
        shape = examine_level(_parts(clean, within), estimate, left.above)
    parts = [recording.voltage[s.start:s.stop] for s in segments]
    deviation = np.concatenate([v - v.mean() for v in parts])
    return LevelResult(
        throttle=level.throttle, segments=tuple(segments),
        time=float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments)),
        n=deviation.size, mean=float(np.concatenate(parts).mean()),
        vpp=float(np.ptp(deviation)), peak=float(np.abs(deviation).max()),
        vrms=float(np.sqrt(np.mean(deviation ** 2))), deviation=deviation, ou=ou,
        estimate=estimate, shape=shape, spectrum=level_spectrum(still, within, estimate),
        lines=lines, with_lines=with_lines)


def _known(segment: Segment, voltage: FloatArray) -> list[Segment]:
    """Return the parts of a segment without gaps, for which the remainder is known."""
    known = np.isfinite(voltage[segment.start:segment.stop])
    turns = np.flatnonzero(np.diff(known, prepend=False, append=False)) + segment.start
    return [Segment(a, b) for a, b in zip(turns[::2].tolist(), turns[1::2].tolist()) if b - a > 1]


def _parts(recording: Recording, segments: Sequence[Segment]
           ) -> list[tuple[FloatArray, FloatArray]]:
    """Return stamps and voltages of segments."""
    return [(recording.t[s.start:s.stop], recording.voltage[s.start:s.stop]) for s in segments]


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


def judge_levels(results: Sequence[LevelResult], load: SupplyLoad) -> tuple[LevelResult, ...]:
    """Name the kind of each level, the tests of all adjusted together; load: of the facts."""
    shapes = holm([level.shape for level in results])
    return tuple(
        replace(level, shape=shape, sag=LevelSag(
            float(load.sag(level.throttle)), float(load.sag_se(level.throttle)))
                if load.known and math.isfinite(level.throttle) else LevelSag(),
                verdict=classify(level.estimate, shape, sum(
                    line.share for line in level.lines.lines)))
        for level, shape in zip(results, shapes))
