"""
One load level of a recording -> its fit, tests, spectrum and lines.

Level and load are subtracted from the whole recording first
(`ou_monitor.analysis.noise.remainder`); the residual in the segments of the level, without
spectral lines, is fitted by the model that all commands share (`ou_monitor.model.ou_fit`).

Limits: a relaxation slower than half a segment, or than 2.5 s, counts as drift of the level.

The process types are from Table 1 of the paper, which assigns them by eye.  Here tests decide
(`ou_monitor.analysis.level_tests`), adjusted so that only one in a hundred recordings of
stationary OU levels has any rejection.  The first rule that applies names the level:

1. mean or intensity changes: 'quasi-stationary' (the verdict also names the type without them);
2. isolated extreme innovations, or heavy tails: 'with impulses';
3. not a normal distribution: 'not Gaussian';
4. samples too few, or ADC steps too coarse, to detect heavy tails: 'undetermined';
5. neighbours uncorrelated: 'Gaussian';
6. lines carry most of the variance, or no relaxation is visible: 'stationary stochastic';
7. no usable fit: 'undetermined';
8. relaxation faster than the sampling, or more white noise than relaxation: 'Gaussian';
9. one relaxation leaves correlated innovations, or a second one is detected: 'stationary
   stochastic'; otherwise 'diffusion'.

Limits: the power of the tests depends on the length of the level; impulses cannot be distinguished
from an intensity that changes within a block.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import enum
import math
from typing import Any

import numpy as np
from ou_monitor.analysis.level_tests import examine_level, holm, Shape, TestResult
from ou_monitor.analysis.levels import LoadLevel
from ou_monitor.analysis.noise import Remainder
from ou_monitor.criticism.innovations import FAMILY_WISE, innovations, sampled_spectrum
from ou_monitor.model.ou_fit import fit_pieces, white_variance
from ou_monitor.model.spectral_lines import (
    even_on_log, EvenGrid, find_lines, LineSearch, on_grid, without_lines)
from ou_monitor.online.estimator.quality import examine, input_flags
from ou_monitor.records import (
    Counters, Estimate, Flag, FloatArray, LOG_NAMES, NAN, OuFacts, Recording, Status)
from ou_monitor.text import number, p_words, percent
from ou_monitor.timeline import TAIL
from scipy import stats
from scipy.signal import welch


# Excess kurtosis that the tests must be able to detect (power `_POWER`) to name a level Gaussian.
VISIBLE_KURTOSIS = 1.0
_POWER = 0.9
# Maximum share of spectral lines in the variance of a level named a diffusion.
_LINE_SHARE = 0.5


class ProcessType(enum.Enum):
    """Process type; the value is the word for the table."""

    CONSTANT = 'constant'
    QUASI_STATIONARY = 'quasi-stationary'
    IMPULSES = 'with impulses'
    NOT_GAUSSIAN = 'not Gaussian'
    GAUSSIAN = 'Gaussian'
    STATIONARY = 'stationary stochastic'
    DIFFUSION = 'diffusion'
    UNDETERMINED = 'undetermined'


def detectable_kurtosis(n: int) -> float:
    """Return the excess kurtosis that n innovations reveal with 90 % probability."""
    if n < 1:
        return math.inf
    # The other half of the significance level is for the largest innovation.
    reach = float(stats.norm.isf(0.5 * FAMILY_WISE) + stats.norm.ppf(_POWER))
    return reach * math.sqrt(24.0 / n)


@dataclass(frozen=True)
class KindVerdict:
    """Process type of a level, and the reason."""

    kind: ProcessType
    why: str  # Reason without numbers, by which levels are grouped
    figures: str = ''  # Numbers of the reason; may be empty
    # For 'quasi-stationary', the type apart from the changes; otherwise `kind`.
    within: ProcessType = ProcessType.UNDETERMINED

    @property
    def sentence(self) -> str:
        """Reason and numbers in one sentence."""
        why = self.why.rstrip('.')
        figures = f' ({self.figures})' if self.figures else ''
        return f'{why[0].upper()}{why[1:]}{figures}.'


def classify(estimate: Estimate, shape: Shape, line_share: float = 0.0) -> KindVerdict:
    """Return the process type and the reason."""
    if estimate.status is Status.CONSTANT:
        return _plain(ProcessType.CONSTANT, 'the voltage never changes')
    if all(math.isnan(test.p_value) for test in shape.tests):
        return _plain(ProcessType.UNDETERMINED, estimate.status.value)
    drift, intensity = shape['mean_drift'], shape['variance_drift']
    rest = _apart_from_changes(estimate, shape, line_share)
    if not (drift.rejects or intensity.rejects):
        return rest
    moves, figures = [], []
    if drift.rejects:
        moves.append('the mean moves')
        figures.append(f'the mean by {drift.effect:.2g} standard deviations, {_p(drift)}')
    if intensity.rejects:
        moves.append('the intensity changes')
        figures.append(f'the intensity by {100.0 * intensity.effect:.0f} %, {_p(intensity)}')
    return KindVerdict(
        ProcessType.QUASI_STATIONARY,
        f'from block to block {" and ".join(moves)}; apart from that {rest.kind.value}',
        '; '.join(figures), rest.kind)


def _apart_from_changes(estimate: Estimate, shape: Shape, line_share: float) -> KindVerdict:
    """Return the type of a level, ignoring changes from block to block."""
    tails, normal = shape['impulses'], shape['gaussian']
    if tails.rejects:
        return _plain(ProcessType.IMPULSES, 'single innovations lie beyond the range of '
                      'the noise, or the tails are heavy',
                      f'{shape.impulses} of {shape.n}, excess kurtosis '
                      f'{number(shape.kurtosis, 2)}, {_p(tails)}')
    if normal.rejects:
        return _plain(ProcessType.NOT_GAUSSIAN, 'the innovations do not follow the normal '
                      'law', f'skewness {number(shape.skewness, 2)}, excess kurtosis '
                      f'{number(shape.kurtosis, 2)}, {_p(normal)}')
    if tails.why_not:
        return _plain(ProcessType.UNDETERMINED, tails.why_not)
    visible = detectable_kurtosis(shape.n)
    if visible > VISIBLE_KURTOSIS:
        return _plain(ProcessType.UNDETERMINED, 'no test finds a deviation, but so few samples '
                      'cannot reveal heavy tails',
                      f'{shape.n} samples, excess kurtosis up to {visible:.2g}')
    return _gaussian(estimate, shape, line_share, f'no excess kurtosis above {visible:.2g}')


def _gaussian(estimate: Estimate, shape: Shape, line_share: float, normal: str) -> KindVerdict:
    """Return the type of a level whose distribution no test distinguishes from a normal one."""
    correlated = shape['correlated']
    if not correlated.rejects:
        return _plain(ProcessType.GAUSSIAN, 'neighbouring samples are uncorrelated', normal)
    if line_share > _LINE_SHARE:
        return _plain(ProcessType.STATIONARY, 'spectral lines carry most of the variance',
                      f'{100.0 * line_share:.0f} %; {normal}')
    if estimate.status is Status.NO_RELAXATION:
        return _plain(ProcessType.STATIONARY, 'neighbouring samples are correlated, but not as '
                      'a relaxation would correlate them', f'{_p(correlated)}; {normal}')
    if not estimate.usable:
        return _plain(ProcessType.UNDETERMINED, estimate.status.value)
    step = estimate.alpha / estimate.rate
    if step > 1.0:
        return _plain(ProcessType.GAUSSIAN, 'relaxation is faster than the sampling',
                      f'alpha dt = {step:.2g}; {normal}')
    noise = estimate.noise_std ** 2
    if noise > estimate.var_inf:
        return _plain(ProcessType.GAUSSIAN, 'white noise carries most of the variance',
                      f'{100.0 * (noise / (noise + estimate.var_inf)):.0f} %; {normal}')
    rest = shape['one_relaxation']
    if rest.rejects:
        return _plain(ProcessType.STATIONARY, 'one relaxation leaves correlated innovations',
                      f'{_p(rest)}; {normal}')
    second = shape['second_relaxation']
    if second.rejects:
        return _plain(ProcessType.STATIONARY, 'the innovations show a second relaxation, '
                      'slower or faster than the fitted one, so alpha is a mixture',
                      f'{_share(second.effect)}, {_p(second)}; {normal}')
    lines = f'; lines carry {percent(line_share)} of the variance' if line_share else ''
    return _plain(ProcessType.DIFFUSION, 'one relaxation, slower than the sampling, leaves '
                  'independent Gaussian innovations', f'alpha dt = {step:.2g}; {normal}{lines}')


def _share(share: float) -> str:
    """Return a share of Var_inf in words; a first-order estimate, not accurate above 1."""
    return 'as large as Var_inf' if share > 1.0 else f'about {100.0 * share:.0f} % of Var_inf'


def _plain(kind: ProcessType, why: str, figures: str = '') -> KindVerdict:
    return KindVerdict(kind, why, figures, kind)


def _p(test: TestResult) -> str:
    return p_words(test.p_adjusted)


# Minimum length of a Welch segment, samples.
_MIN_LENGTH = 32
# Minimum number of averages: the relative error is 1/sqrt(8), and a segment of 25 relaxation times
# still shows a decade below the corner.
_AVERAGES = 8
# Points of the spectrum per decade; enough to resolve a tone.
_PER_DECADE = 40


def _empty() -> FloatArray:
    return np.zeros(0)


@dataclass(frozen=True, eq=False)
class LevelSpectrum:
    """One-sided power spectral density of a level."""

    frequency: FloatArray = field(default_factory=_empty)  # Even on a log axis, Hz; shape (k,)
    density: FloatArray = field(default_factory=_empty)  # Measured, V^2/Hz; shape (k,)
    # Density of the fitted OU in white noise at the same rate, V^2/Hz; NaN without; shape (k,).
    fitted: FloatArray = field(default_factory=_empty)


def level_spectrum(recording: Recording, segments: Sequence[slice],
                   estimate: Estimate) -> LevelSpectrum:
    """Return the PSD of a level (Welch, Hann), averaged over its segments."""
    # Samples are treated as evenly spaced; if they are not, the PSD is smeared near the Nyquist
    # frequency.
    longest = max((s.stop - s.start for s in segments), default=0)
    rate = segment_rate(recording, segments)
    if longest < _MIN_LENGTH or not rate > 0.0:
        return LevelSpectrum()
    length = longest
    while length > _MIN_LENGTH and _pieces(segments, length) < _AVERAGES:
        length = max(_MIN_LENGTH, length * 4 // 5)
    frequency, summed, weight = np.zeros(0), np.zeros(length // 2 + 1), 0
    for s in segments:
        n = s.stop - s.start
        if n >= length:
            frequency, density = welch(recording.voltage[s], fs=rate,
                                       nperseg=length, detrend='constant')
            summed, weight = summed + n * density, weight + n
    # Leave out the first two bins, which the removal of the mean distorts, and the last, at the
    # Nyquist frequency, whose density is not doubled.
    frequency, density = even_on_log(frequency[2:-1], summed[2:-1] / weight, _PER_DECADE)
    fitted = np.full(frequency.size, math.nan)
    if estimate.usable:
        fitted = ou_spectrum(frequency, estimate.alpha, estimate.sigma, rate, estimate.noise_std)
    return LevelSpectrum(frequency, density, fitted)


def segment_rate(recording: Recording, segments: Sequence[slice]) -> float:
    """Return the mean rate of the samples within segments, Hz; 0 if they have no duration."""
    steps = sum(s.stop - s.start - 1 for s in segments)
    time = float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments))
    return steps / time if time > 0.0 else 0.0


def _pieces(segments: Sequence[slice], length: int) -> int:
    """Return the number of half-overlapping pieces of a length in the segments."""
    return sum(max(0, 2 * (s.stop - s.start) // length - 1) for s in segments)


def ou_spectrum(frequency: FloatArray, alpha: float, sigma: float, rate: float,
                noise_std: float = 0.0) -> FloatArray:
    """Return the one-sided PSD of a *sampled* OU in white noise (frequency and rate in Hz, V)."""
    # The Lorentzian 2 sigma^2 / (alpha^2 + (2 pi f)^2) with its aliases is the spectrum of an
    # AR(1) with the coefficient exp(-alpha/rate).
    ar1 = sigma * sigma / (2.0 * alpha) * sampled_spectrum(
        2.0 * math.pi * frequency / rate, alpha / rate)
    white = noise_std * noise_std if math.isfinite(noise_std) else 0.0
    density: FloatArray = 2.0 / rate * (ar1 + white)
    return density


# Minimum samples of a segment for spectrum, tests and lines.
_MIN_SEGMENT = 16
# Minimum samples of a histogram.
_LEAST_BINNED = 50
# A series is a random walk if half the mean square of its steps is below this share of its mean
# square (1 for white noise).
_WANDERS = 0.5


def mean_variance(time: float, n: int, estimate: Estimate, rms: float) -> float:
    """Return the variance of the mean of a segment of OU in white noise, V^2 (in s and V)."""
    if not estimate.usable:
        return rms * rms / max(n, 1)
    at = max(estimate.alpha * time, 1e-9)
    # Papoulis, Probability, Random Variables and Stochastic Processes, ch. 9.
    of_ou = 2.0 * estimate.var_inf * (at + math.expm1(-at)) / (at * at)
    noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
    return of_ou + noise * noise / max(n, 1)


def fit_parts(recording: Recording, left: Remainder, segments: Sequence[slice],
              throttle: float = NAN) -> tuple[OuFacts, Estimate]:
    """Fit segments of a recording, and return the fit as facts and as the node's record."""
    n = sum(s.stop - s.start for s in segments)
    if not n:
        return OuFacts('no_data'), Estimate(throttle=throttle, status=Status.TOO_FEW_SAMPLES)
    parts = [(left.voltage[s], left.size[s]) for s in segments]
    ou = fit_pieces(parts, left.dt, left.walk, left.absorbed)
    time = float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments))
    mean = sum(float(recording.voltage[s].sum()) for s in segments) / n
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
        status = (Status.TOO_SHORT if ou.status != 'not_visible' else
                  Status.CONSTANT if not ou.var_inf_below else
                  Status.UNBOUND if 0.5 * steps < _WANDERS * square else Status.NO_RELAXATION)
        return ou, replace(blank, status=status)
    errors: dict[str, Any] = {f'{name}_se': ou.log_se(name) for name in LOG_NAMES}
    e = replace(blank, status=Status.OK, alpha=ou.alpha, sigma=ou.sigma, var_inf=ou.var_inf,
                noise_std=math.sqrt(white_variance(ou, steps, left.dt)), **errors)
    flags = (*e.flags, Flag.SLOW_RATE) if ou.alpha * left.dt > 1.0 else e.flags
    return ou, replace(e, flags=flags, u0_se=math.sqrt(mean_variance(time, n, e, NAN)))


@dataclass(frozen=True, eq=False)
class LevelResult:
    """Results of one load level."""

    throttle: float  # 0..1; NaN if the level is the whole recording
    segments: tuple[slice, ...]  # Segments used
    time: float  # Time in them, s
    n: int  # Samples in them
    mean: float  # Mean voltage, V
    # Peak to peak, largest absolute value and rms of the deviation from the mean of each segment,
    # V, as on an AC-coupled oscilloscope.
    vpp: float
    peak: float
    vrms: float
    deviation: FloatArray  # That deviation, V; shape (n,)
    ou: OuFacts  # Fitted relaxation (level, load and lines removed), or bounds on it
    estimate: Estimate  # The same fit in the form that the node reports
    shape: Shape  # Tests of the process type, adjusted over all levels
    verdict: KindVerdict = KindVerdict(ProcessType.UNDETERMINED, 'not judged')
    spectrum: LevelSpectrum = field(default_factory=LevelSpectrum)
    lines: LineSearch = field(default_factory=LineSearch)
    lines_kept: bool = False  # Whether the fit includes lines, because impulses may cause them

    @property
    def kind(self) -> ProcessType:
        """Process type."""
        return self.verdict.kind

    @property
    def doubted(self) -> bool:
        """Whether one OU in white noise is a doubtful description of the level."""
        return self.lines_kept or self.shape['one_relaxation'].rejects or self.wanders

    @property
    def wanders(self) -> bool:
        """Whether a second relaxation is detected."""
        return self.shape['second_relaxation'].rejects

    @property
    def crest(self) -> float:
        """Vpp over Vrms, dimensionless."""
        return self.vpp / self.vrms if self.vrms > 0.0 else NAN

    def density(self) -> tuple[FloatArray, FloatArray]:
        """Return histogram edges and density of deviation/Vrms; empty with too few samples."""
        if self.n < _LEAST_BINNED or not self.vrms > 0.0:
            return np.zeros(0), np.zeros(0)
        z = self.deviation / self.vrms
        # Bins by Freedman and Diaconis (1981), but of a width that suits a plot.
        width = min(max(2.0 * float(stats.iqr(z)) / z.size ** (1.0 / 3.0), 0.05), 0.5)
        edges = np.arange(-6.0, 6.0 + width, width)
        return edges, np.histogram(z, edges)[0] / (self.n * np.diff(edges))

    @property
    def label(self) -> str:
        """Name of the level, as displayed."""
        return 'all' if math.isnan(self.throttle) else f'{100.0 * self.throttle:.3g} %'


def fit_level(recording: Recording, left: Remainder, level: LoadLevel, levels: int,
              whole: Callable[[], Estimate] | None = None) -> LevelResult:
    """Return the result of one level, without the verdict (whole: fits all levels together)."""
    segments = [s for s in level.segments if s.stop - s.start >= _MIN_SEGMENT]
    if not segments:
        segments = [s for s in level.segments if s.stop - s.start >= 2]
    if not segments:
        ou, nothing = fit_parts(recording, left, ())
        return LevelResult(level.throttle, (), 0.0, 0, NAN, NAN, NAN, NAN, np.zeros(0), ou,
                           replace(nothing, throttle=level.throttle), examine_level([], nothing))
    within = [part for s in segments for part in _known_parts(s, left.voltage)]
    ou, estimate = fit_parts(recording, left, within, level.throttle)
    still = replace(recording, voltage=left.voltage)
    grids = [on_grid(still.t[s], still.voltage[s]) for s in within]
    even = _grid_rate(grids)
    # Without whitening, the steep spectrum of a slow relaxation would show false lines.
    model = estimate if estimate.usable or whole is None else whole()
    lines = find_lines([grid.values for grid in grids], even, levels=levels, white=[
        _white(still.t[s], still.voltage[s], model)
        for s in within] if model.usable else ())
    if lines.lines and math.isfinite(level.throttle):
        # A line that is also in the throttle belongs to the load.
        commanded = find_lines([on_grid(still.t[s], still.throttle[s]
                                        ).values for s in within], even).lines
        lines = replace(lines, lines=tuple(line for line in lines.lines if not any(
            abs(line.frequency - other.frequency) < line.resolution + other.resolution
            for other in commanded)))
    shape = examine_level(_parts(still, within), estimate, left.above)
    # Do not subtract the lines of periodic impulses.
    kept = bool(lines.lines) and holm([shape])[0]['impulses'].rejects
    if lines.lines and not kept:
        clean = still.voltage.copy()
        for s, grid in zip(within, grids):
            clean[s] = without_lines(grid.values, even, lines.lines)[grid.where]
        ou, estimate = fit_parts(recording, replace(left, voltage=clean), within, level.throttle)
        shape = examine_level(_parts(replace(still, voltage=clean), within), estimate, left.above)
    parts = [recording.voltage[s] for s in segments]
    deviation = np.concatenate([v - v.mean() for v in parts])
    return LevelResult(
        throttle=level.throttle, segments=tuple(segments),
        time=float(sum(recording.t[s.stop - 1] - recording.t[s.start] for s in segments)),
        n=deviation.size, mean=float(np.concatenate(parts).mean()),
        vpp=float(np.ptp(deviation)), peak=float(np.abs(deviation).max()),
        vrms=float(np.sqrt(np.mean(deviation ** 2))), deviation=deviation, ou=ou,
        estimate=estimate, shape=shape, spectrum=level_spectrum(still, within, estimate),
        lines=lines, lines_kept=kept)


def fit_all(recording: Recording, left: Remainder, levels: Sequence[LoadLevel]) -> Estimate:
    """Fit the segments of all levels together."""
    return fit_parts(recording, left, [part for level in levels for s in level.segments
                                       for part in _known_parts(s, left.voltage)])[1]


def _known_parts(segment: slice, voltage: FloatArray) -> list[slice]:
    """Return the parts of a segment in which the voltage is not NaN (near gaps, it is NaN)."""
    known = np.isfinite(voltage[segment])
    turns = np.flatnonzero(np.diff(known, prepend=False, append=False)) + segment.start
    return [slice(a, b)
            for a, b in zip(turns[::2].tolist(), turns[1::2].tolist()) if b - a > 1]


def _parts(recording: Recording, segments: Sequence[slice]
           ) -> list[tuple[FloatArray, FloatArray]]:
    return [(recording.t[s], recording.voltage[s]) for s in segments]


def _white(t: FloatArray, voltage: FloatArray, estimate: Estimate) -> FloatArray:
    """Return the innovations of a segment on an even clock (t in s, voltage in V)."""
    noise = estimate.noise_std if estimate.noise_std > 0.0 else 0.0
    return on_grid(t, innovations(t, voltage - voltage.mean(), estimate.alpha, estimate.var_inf,
                                  noise * noise)).values


def _grid_rate(grids: Sequence[EvenGrid]) -> float:
    """Return the mean rate of the grids, Hz; 0 if they have no duration."""
    steps = sum(grid.values.size - 1 for grid in grids)
    time = sum((grid.values.size - 1) / grid.rate for grid in grids)
    return steps / time if time > 0.0 else 0.0


def judge_levels(results: Sequence[LevelResult]) -> tuple[LevelResult, ...]:
    """Return the levels with their verdicts, all tests adjusted together."""
    shapes = holm([level.shape for level in results])
    return tuple(replace(level, shape=shape, verdict=classify(level.estimate, shape, sum(
        line.share for line in level.lines.lines))) for level, shape in zip(results, shapes))
