"""
Compare a recording with simulations of it under the recorded throttle.

Limits: the only input of the fitted model is throttle or current; the bands include errors of its
parameters, estimated from held-out parts, but not later changes of the craft.

The two low levels lie halfway between two codes of the ADC, so that no reading equals them.  Dips
below a level are counted with hysteresis, as in `supply_facts`.

The score of a number is its distance from the median, in half-widths of a band that is estimated
from the simulations and the recording; the half-width is at least a difference that a pilot would
not notice.  The largest weighted score is ranked among the largest scores of the simulations.  Of
recordings that follow the model, at most 2 % are called different by this rank, and 5 % because
their mean voltage is outside its band.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import enum
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.noise import dip_begins, noise_of, remainder, rise_that_ends
from ou_monitor.comparison.flight_model import FiledModel, fit_flight, FlightModel, MOVES, Readings
from ou_monitor.criticism.adc import without_repeats
from ou_monitor.criticism.curves import stray
from ou_monitor.criticism.readings import current_at, on_time, usable, why_no_model
from ou_monitor.errors import InputError
from ou_monitor.model.load_fit import Load
from ou_monitor.model.sinusoid import LOBE
from ou_monitor.model.spectral_lines import find_lines
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import counted, number, percent, Z95
from scipy.signal import welch


class Likeness(enum.Enum):
    """Whether the recording could be one of its simulations; the value is its wording."""

    LOOKS_LIKE_IT = 'The simulation looks like the recording'
    DIFFERS = 'The simulation differs from the recording'


@dataclass(frozen=True)
class Band:
    """A number of the recording, and its distribution over the simulations."""

    measured: float  # In the recording
    # 2.5 %, 50 % and 97.5 % quantiles of the simulations.
    low: float
    median: float
    high: float

    @property
    def inside(self) -> bool:
        """Return whether the recording lies in the band."""
        hair = 1e-9 * abs(self.measured)
        return self.low - hair <= self.measured <= self.high + hair

    def as_data(self) -> dict[str, float]:
        """Return the four numbers by name."""
        return {'measured': self.measured, 'simulated_low': self.low,
                'simulated_median': self.median, 'simulated_high': self.high}


@dataclass(frozen=True)
class SpectrumBand:
    """Rms, V, between two frequencies, Hz."""

    low_hz: float
    high_hz: float
    rms: Band

    @property
    def middle_hz(self) -> float:
        """Return the geometric mean of the two frequencies, Hz."""
        return math.sqrt(self.low_hz * self.high_hz)


@dataclass(frozen=True, eq=False)
class Traces:
    """Curves for a page: the part compared, and simulations of it."""

    # The recording: stamps, s, voltage, V, and throttle, 0..1 (NaN: not recorded).
    t: FloatArray
    voltage: FloatArray
    throttle: FloatArray
    simulated: FloatArray  # One simulation, V
    # Stamps, s, and the 95 % band of the simulations, V.
    at: FloatArray
    low: FloatArray
    high: FloatArray
    # Time after a rise of throttle, s, and the mean response to it, V.
    after: FloatArray
    response: FloatArray
    response_low: FloatArray
    response_high: FloatArray
    # Voltages, V, and the share of the samples below each.
    edges: FloatArray
    distribution: FloatArray
    simulated_distribution: FloatArray


# Number of rows outside their 95 % bands that 2 % of good simulations with 12 rows reach.
_TOO_MANY = 3


@dataclass(frozen=True, eq=False)
class Agreement:
    """A recording, compared with its simulations."""

    recording: str
    # Time ranges, s after the first sample; (0, 0) if nothing was fitted.
    fitted: tuple[float, float]
    simulated: tuple[float, float]
    model: tuple[str, ...]  # Names of the terms
    # Mean path: share of the variance explained, rms error and bias, V.
    explained: float
    rmse: float
    bias: float
    bias_by_third: tuple[float, float, float]  # V
    # Lowest and mean voltage, V.
    lowest: Band
    mean: Band
    levels: tuple[float, ...]  # V
    dips: tuple[Band, ...]  # Dips below each level per minute
    spectrum: tuple[SpectrumBand, ...]  # By band of frequency
    line: SpectrumBand | None  # About the strongest spectral line of the recording, if any
    # Deepest fall of the mean response to rises of throttle, and its value 1 s after, V.
    fall: Band | None
    recovery: Band | None
    rises: int
    # Largest difference (KS) from the joint distribution of all simulations.
    apart: Band
    seeds: int
    p_value: float  # Share, of simulations and recording, with at least the recording's score
    verdict: Likeness
    words: str  # The largest difference, as a part of a sentence
    farthest: str  # Kind of that difference: a key of _WEIGHTS, or path
    notes: tuple[str, ...]  # What was left out or assumed
    traces: Traces  # For a page

    @property
    def in_part(self) -> bool:
        """Return whether more numbers are outside their bands than chance explains."""
        return sum(not one.inside for *_, one in self.rows()) >= _TOO_MANY

    @property
    def worst(self) -> str:
        """Return the largest difference in a sentence."""
        chance = '' if self.verdict is Likeness.DIFFERS or self.in_part else ', within chance'
        return f'Largest difference{chance}: in the simulation, {self.words}.'

    def rows(self) -> list[tuple[str, str, int, Band]]:
        """Return all numbers: name, unit, digits and band."""
        response = [('fall after rises', self.fall), ('fall left after 1 s', self.recovery)]
        return [('lowest voltage', 'V', 4, self.lowest), ('mean voltage', 'V', 4, self.mean),
                *((f'dips below {round(level, 3):g} V', '1/min', 3, dips)
                  for level, dips in zip(self.levels, self.dips)),
                *((name, 'V', 3, one) for name, one in response if one is not None),
                ('distribution (KS distance)', '', 2, self.apart),
                *((f'rms {number(one.low_hz, 2)} to {number(one.high_hz, 2)} Hz', 'V', 3, one.rms)
                  for one in self.spectrum),
                *([] if self.line is None else [
                    (f'rms at {number(self.line.middle_hz, 4)} Hz (line)', 'V', 3,
                     self.line.rms)])]

    def measures(self) -> list[dict[str, Any]]:
        """Return all numbers of the recording and of the simulations, in SI units."""
        return [{'measure': f'{name}, {unit}'.removesuffix(', '), **one.as_data(),
                 'inside': one.inside} for name, unit, _, one in self.rows()]

    def as_data(self) -> dict[str, Any]:
        """Return the data of `--json`."""
        return {
            'recording': self.recording, 'fitted_s': list(self.fitted),
            'simulated_s': list(self.simulated), 'model': list(self.model),
            'mean_path': {'variance_explained': self.explained, 'rmse_v': self.rmse,
                          'bias_v': self.bias, 'bias_by_third_v': list(self.bias_by_third)},
            'lowest_v': self.lowest.as_data(),
            'crossings_per_min': [{'level_v': level, **dips.as_data()}
                                  for level, dips in zip(self.levels, self.dips)],
            'spectrum': [{'from_hz': one.low_hz, 'to_hz': one.high_hz,
                          'simulated_over_measured': _ratio(one.rms) ** 2}
                         for one in self.spectrum],
            'ks_distance': self.apart.measured, 'worst': self.worst,
            'verdict': self.verdict.name.lower()}


def _ratio(rms: Band) -> float:
    return rms.median / rms.measured if rms.measured > 0.0 else float('nan')


# Quantiles of the measured voltage that give the two low levels.
LOW_SHARES = (0.01, 0.05)
# Bands of the spectrum, and maximum length of a Welch segment, s.
_BANDS, _SEGMENT = 5, 20.0
# A rise of throttle: minimum rise, maximum duration, s, and minimum time without a rise before, s.
_RISE, _WITHIN, _QUIET = 0.1, 0.2, 1.0
# Response: time before and after a rise begins, s, points, and minimum number of rises.
_BEFORE, _AFTER, _POINTS, _FEWEST = 0.2, 1.5, 86, 3
# Bins of the distribution.
_BINS = 2000


@dataclass(frozen=True, eq=False)
class Measures:
    """Measures of one voltage."""

    mean: float  # V
    lowest: float  # V
    dips: FloatArray  # Dips below each level per minute; shape (levels,)
    power: FloatArray  # Power in each band, V^2; shape (bands,)
    line: float  # Rms about the recording's strongest line, V; 0 without one
    response: FloatArray  # Mean response to rises, V; empty with too few; shape (points,)
    distribution: FloatArray  # Share of the samples below each edge; shape (bins,)


class Yardstick:
    """Levels, frequency bands and rises of a recording, by which voltages are compared."""

    def __init__(self, samples: Readings, lsb: float, limits: tuple[float, ...] = (),
                 code: float = 0.0) -> None:
        # lsb: step of the ADC, V, or 0; limits: levels, V, in addition to the two low ones; code:
        # one code of the ADC, V.
        v, t = samples.voltage, samples.t
        self._t = t
        self.minutes = float(t[-1] - t[0]) / 60.0
        low = [float(np.quantile(v, share)) for share in LOW_SHARES]
        self.levels = [*limits, *(between_codes(level, lsb, code) for level in low)]
        u = np.full(t.size, NAN) if samples.throttle is None else samples.throttle
        flown = Recording(t, v, u, current=samples.current)
        left = remainder(flown)
        self._rise = rise_that_ends(v, u, noise_of(flown, left))
        self._rate = 1.0 / samples.spacing
        self._segment = int(min(v.size, max(64, min(_SEGMENT * self._rate, v.size / 4))))
        lowest, highest = self._rate / self._segment, 0.5 * self._rate
        self.bands = np.geomspace(lowest, highest, _BANDS + 1)
        # Lines of the residual are detected in its differences, whose spectrum is flatter.
        rest = np.nan_to_num(left.voltage)
        found = find_lines([rest], self._rate, white=[np.diff(rest, prepend=0.0)]).lines
        self.line = max(found, key=lambda line: line.rms, default=None)
        self.rises = _rise_times(t, samples.throttle)
        self.after = np.linspace(-_BEFORE, _AFTER, _POINTS)
        reach = 0.5 * (float(v.max()) - float(v.min())) + 10.0 * lsb
        # Edges of the bins of the distribution, V.
        self.edges = np.linspace(v.min() - reach, v.max() + reach, _BINS)

    def measure(self, v: FloatArray) -> Measures:
        """Measure a voltage at the stamps of the part, V."""
        dips = [dip_begins(v, level, self._rise).size / self.minutes for level in self.levels]
        f, density = welch(v, self._rate, nperseg=self._segment)
        at = np.clip(np.searchsorted(self.bands, f, side='right') - 1, -1, _BANDS - 1)
        power = np.array([density[at == k].sum() for k in range(_BANDS)]) * (f[1] - f[0])
        return Measures(
            float(v.mean()), float(v.min()), np.array(dips), power, self._line(v),
            self._response(v), np.searchsorted(np.sort(v), self.edges, side='right') / v.size)

    def _line(self, v: FloatArray) -> float:
        if self.line is None:
            return 0.0
        width = self.line.resolution
        f, density = welch(v, self._rate, nperseg=min(v.size, round(self._rate / width)))
        return math.sqrt(width * density[np.abs(f - self.line.frequency) <= LOBE * width].sum())

    def _response(self, v: FloatArray) -> FloatArray:
        if self.rises.size < _FEWEST:
            return np.empty(0)
        around = np.interp(self.rises[:, None] + self.after, self._t, v)
        responses = around - around[:, self.after < 0.0].mean(axis=1, keepdims=True)
        return np.asarray(responses.mean(axis=0), dtype=np.float64)


def between_codes(level: float, lsb: float, code: float = 0.0) -> float:
    """Return the midpoint between the two codes around a level, V (code: any code)."""
    return code + (np.floor((level - code) / lsb + 1e-6) + 0.5) * lsb if lsb > 0.0 else level


def _rise_times(t: FloatArray, throttle: FloatArray | None) -> npt.NDArray[np.float64]:
    """Return the stamps at which throttle begins to rise, s."""
    if throttle is None:
        return np.empty(0)
    before = np.searchsorted(t, t - _WITHIN)
    rising = throttle - throttle[before] >= _RISE
    begins = np.flatnonzero(rising[1:] & ~rising[:-1]) + 1
    found: list[float] = []
    for k in begins:
        since = t[k]
        room = t[0] + _BEFORE < since - _WITHIN and since + _AFTER < t[-1]
        if room and (not found or since - found[-1] > _QUIET):
            # The rise is detected at its end; its beginning is the steepest point.
            window = throttle[before[k]:k + 1]
            steepest = int(np.argmax(np.diff(window))) if window.size > 1 else 0
            found.append(float(t[before[k] + steepest]))
    return np.array(found)


# Probability of a false `DIFFERS` by the largest score; with n < 49 simulations it is 1 / (n + 1),
# and the score must exceed all of theirs.
LEVEL = 0.02
# Importance for a pilot, relative to the lowest voltage and the number of dips.
_WEIGHTS = {'lowest': 1.0, 'dips': 1.0, 'level': 0.8, 'answer': 0.8, 'line': 0.8,
            'spectrum': 0.5, 'ks': 0.5}
# Differences that a pilot would not notice: a share of the range of the voltage, factors of a rate
# and of a power, and a KS distance.
_RANGE, _RATE, _POWER, _KS = 0.03, 1.25, 1.5, 0.05
# Ends of a 95 % band, %.
_LOW, _HIGH = 2.5, 97.5
# Time after a rise begins at which the recovery is measured, s.
RECOVERED = 1.0


@dataclass(frozen=True)
class Difference:
    """One number that is judged, and its wording."""

    kind: str  # Key of its weight
    measured: float  # In the recording
    simulated: FloatArray  # In each simulation; shape (seeds,)
    least: float  # Minimum half-width of the band
    words: Callable[[Band], str]  # Band -> part of a sentence

    @property
    def band(self) -> Band:
        """Return measured value and band."""
        return band(self.measured, self.simulated)

    def scores(self) -> FloatArray:
        """Return the weighted scores: of the recording, then of each simulation."""
        # The scale includes the recording like each simulation; otherwise the recording would have
        # the largest score too often.
        off = np.append(self.measured, self.simulated)
        off -= np.median(off)
        up, down = (Z95 * math.sqrt(float(np.mean(side ** 2))) if side.size else 0.0
                    for side in (off[off > 0.0], off[off < 0.0]))
        half = np.maximum(np.where(off > 0.0, up, down), self.least)
        return np.asarray(_WEIGHTS[self.kind] * np.abs(off) / half)

    @property
    def off(self) -> bool:
        """Return whether the recording lies outside the band, by a difference that matters."""
        own = self.band
        return not own.inside and abs(own.measured - own.median) > self.least


def band(measured: float, simulated: FloatArray) -> Band:
    """Return a number of the recording with the band of the simulations, shape (seeds,)."""
    # By this method, 95 % of further simulations lie in low..high; by NumPy's default method, only
    # 91 % do if the band comes from 50 simulations.
    low, median, high = np.percentile(simulated, [_LOW, 50.0, _HIGH], method='weibull').tolist()
    return Band(measured, low, median, high)


def differences(yardstick: Yardstick, own: Measures, others: Sequence[Measures],
                spread: float, bias: Sequence[float]) -> list[Difference]:
    """Return the judged numbers (spread: range of the voltage; bias: of the path by third; V)."""
    volts = max(_RANGE * spread, 1e-12)

    def of(pick: Callable[[Measures], float]) -> FloatArray:
        return np.array([pick(one) for one in others])

    found = [
        Difference('lowest', own.lowest, of(lambda m: m.lowest), volts, lambda b: (
            f'the lowest voltage is {number(b.median, 4)} V ({_span(b, 4)}), measured '
            f'{number(b.measured, 4)} V')),
        Difference('level', own.mean, of(lambda m: m.mean), volts, lambda _: (
            f'the voltage is on average {_off(float(np.mean(bias)))}'
            + (f' ({_off(bias[0])} in the first third, {_off(bias[-1])} in the last: it falls '
               f'{"less" if bias[-1] > bias[0] else "more"} with time than the recording)'
               if abs(bias[-1] - bias[0]) > max(volts, abs(bias[0])) else '')))]
    for k, level in enumerate(yardstick.levels):
        rate = own.dips[k]
        # Poisson error of the count.
        chance = math.sqrt(max(rate * yardstick.minutes, 1.0)) / yardstick.minutes
        found.append(Difference(
            'dips', float(rate), of(lambda m, k=k: float(m.dips[k])),  # type: ignore[misc]
            max((_RATE - 1.0) * float(rate), chance), lambda b, level=level: (  # type: ignore
                f'the voltage dips below {round(level, 3):g} V {number(b.median, 2)} times a '
                f'minute ({_span(b, 2)}), measured {number(b.measured, 2)}')))
    if own.response.size:
        begin, later = np.searchsorted(yardstick.after, [0.0, RECOVERED]).tolist()
        found += [
            Difference('answer', float(own.response[begin:].min()),
                       of(lambda m: float(m.response[begin:].min())), volts, lambda b: (
                f'after rises of throttle the voltage falls by {_fall(b.median)} '
                f'({_fall(b.high)} to {_fall(b.low)}), measured {_fall(b.measured)}')),
            Difference('answer', float(own.response[later]),
                       of(lambda m: float(m.response[later])), volts, lambda b: (
                f'a second after rises of throttle the voltage is down by {_fall(b.median)} '
                f'({_fall(b.high)} to {_fall(b.low)}), measured {_fall(b.measured)}'))]
    for k in range(own.power.size):
        if own.power[k] > 0.0:
            low, high = yardstick.bands[k], yardstick.bands[k + 1]
            found.append(Difference(
                'spectrum', math.log(own.power[k]),
                of(lambda m, k=k: math.log(max(m.power[k], 1e-300))),  # type: ignore[misc]
                math.log(_POWER), lambda b, low=low, high=high: (  # type: ignore[misc]
                    f'between {number(low, 2)} and {number(high, 2)} Hz the simulated voltage has '
                    f'{number(math.exp(b.median - b.measured), 2)} times the measured power')))
    if (line := yardstick.line) is not None:
        found.append(Difference('line', own.line, of(lambda m: m.line), volts, lambda b: (
            f'the line at {number(line.frequency, 4)} Hz has '
            f'{number(1e3 * b.median, 2)} mV rms, measured {number(1e3 * b.measured, 3)} mV')))
    pooled = np.mean([m.distribution for m in (own, *others)], axis=0)
    found.append(Difference(
        'ks', distance(own, pooled), of(lambda m: distance(m, pooled)), _KS, lambda b: (
            f'the share of time below a voltage differs by up to {number(b.measured, 2)} '
            f'(simulations among themselves: {_span(b, 2)})')))
    return found


def distance(one: Measures, pooled: FloatArray) -> float:
    """Return the Kolmogorov-Smirnov distance of a voltage from a pooled distribution."""
    return float(np.max(np.abs(one.distribution - pooled)))


def _span(b: Band, digits: int) -> str:
    return f'{number(b.low, digits)} to {number(b.high, digits)}'


def _off(v: float) -> str:
    return f'{number(1e3 * abs(v), 2)} mV too {"high" if v > 0.0 else "low"}'


def _fall(v: float) -> str:
    return f'{number(-1e3 * v, 2)} mV'


def judge(found: Sequence[Difference], explained: float, moved: bool
          ) -> tuple[float, Likeness, str, str]:
    """Return p-value, verdict, the largest difference in words, and its kind."""
    # explained: share of the variance explained by the mean path; moved: whether that path moves.
    scores = np.array([one.scores() for one in found])
    largest = scores.max(axis=0)
    p = float(np.mean(largest >= largest[0]))
    worst = int(np.argmax(scores[:, 0]))
    level = next(k for k, one in enumerate(found) if one.kind == 'level')
    rare = p <= max(LEVEL, 1.0 / largest.size)
    verdict = Likeness.DIFFERS if rare else Likeness.LOOKS_LIKE_IT
    if verdict is Likeness.LOOKS_LIKE_IT and moved and explained < 0.0:
        return p, Likeness.DIFFERS, (
            f'the mean path explains {number(100.0 * explained, 2)} % of the variance, less than '
            'a constant would'), 'path'
    if found[level].off and not any(one.off for one in found if one.kind == 'answer'):
        # The other differences follow from the level, unless the response to throttle is wrong.
        verdict, worst = Likeness.DIFFERS, level
    return p, verdict, found[worst].words(found[worst].band), found[worst].kind


# Minimum readings and duration, s, of a part; minimum number of simulations (at which 5 % of good
# models are rejected), and maximum.
_LEAST, _SHORTEST, _FEWEST_SEEDS, _MOST_SEEDS = 50, 0.2, 20, 10_000
# Maximum points of the band on a page.
_PLOTTED = 2000
# Probability above which the other kind of level (constant or falling) is reported.
_UNSURE = 0.05
# Minimum time at the beginning of the recording over which a model from a file is aligned, s.  It
# is doubled until the means over it differ between simulations by a standard deviation of at most
# `_STEADY` times that of single samples; it then holds about ten independent pieces.
_ALIGNED, _STEADY = 2.0, 0.3


def compare(recording: Recording, model: SupplyModel | None = None, *,
            fit_until: float | None = None, seeds: int = 50, seed: int = 0,
            levels: tuple[float, ...] = (),
            progress: Callable[[float], None] | None = None) -> Agreement:
    """Compare a recording with simulations: see `ou_monitor.compare` (levels: limits, V)."""
    report = progress or (lambda share: None)
    if not _FEWEST_SEEDS <= seeds <= _MOST_SEEDS:
        raise ValueError(f'seeds must lie within {_FEWEST_SEEDS} to {_MOST_SEEDS}, got {seeds}')
    notes = list(recording.notes)
    samples, offset = _samples(recording, notes)
    duration = float(samples.t[-1])
    begin = _start_index(samples, fit_until, fitted=model is None)
    if model is None:
        if samples.current is not None:
            current, sign = on_time(samples.t, samples.voltage, samples.current, 'current', notes)
            samples = replace(samples, current=sign * current)
        fitted = fit_flight(samples.part(slice(0, begin)), lambda share: report(0.6 * share))
        simulator: FlightModel | FiledModel = fitted
        notes += _fit_notes(fitted, samples)
    else:
        samples = _checked_load(model, samples, recording.name, notes)
        simulator = FiledModel(model)
        notes.append('The errors of the parameters in the model file are not simulated: the '
                     'bands include only the noise.')
    part = slice(begin, samples.t.size)
    # Codes of an ADC may have any offset.
    lsb, code = samples.lsb, float(np.sort(samples.voltage)[samples.t.size // 2])

    def read(v: FloatArray) -> FloatArray:
        return np.asarray(code + lsb * np.rint((v - code) / lsb)) if lsb > 0.0 else v

    own = samples.part(part)
    own = replace(own, voltage=read(own.voltage))
    yardstick = Yardstick(own, lsb, levels, code)
    rng = np.random.default_rng(seed)
    shifts = np.zeros(seeds)
    stride = max(1, -(-own.t.size // _PLOTTED))
    # A model from a file has the level of another flight.
    aligned, before = None, 0.6
    if model is not None:
        drawn, before = [], 0.3
        for k in range(_FEWEST_SEEDS):
            drawn.append(simulator.draw(samples, np.random.default_rng((seed, k)))[part][::stride])
            report(before * (k + 1) / _FEWEST_SEEDS)
        aligned = _beginning(own.t, np.array(drawn), stride)
    measured: list[Measures] = []
    traces = np.empty((seeds, own.voltage[::stride].size), dtype=np.float32)
    total, first = np.zeros(own.t.size), own.voltage
    strays = 0
    for k in range(seeds):
        v = simulator.draw(samples, rng)[part]
        if not np.isfinite(v).all():
            raise InputError('the model diverges over this throttle: its voltage is not finite')
        if aligned is not None:
            # Align each simulation by itself, so that the bands include the error of the level.
            shifts[k] = (own.voltage[aligned] - v[aligned]).mean()
            v = v + shifts[k]
        total += v
        v = read(v)
        first = v if k == 0 else first
        strays += stray(v, samples.voltage) > 0.0
        measured.append(yardstick.measure(v))
        traces[k] = v[::stride]
        report(before + (1.0 - before) * (k + 1.0) / seeds)
    if aligned is not None:
        notes.append(f'The level of the model was moved by {number(float(shifts.mean()), 3)} V '
                     f'(+- {number(float(shifts.std()), 2)} V), so that the mean of the first '
                     f'{number(float(np.ptp(own.t[aligned])))} s of each simulation equals the '
                     "recording's.")
    if strays:
        notes.append(f'{strays} of {seeds} simulations leave the range of the recording by more '
                     'than half of it.')
    path = fitted.path(samples)[part] if model is None else total / seeds
    real = yardstick.measure(own.voltage)
    spread = float(np.ptp(own.voltage))
    error = path - own.voltage
    thirds = tuple(float(part.mean()) for part in np.array_split(error, 3))
    found = differences(yardstick, real, measured, spread, thirds)
    explained = 1.0 - float(error @ error) / float(
        np.sum((own.voltage - own.voltage.mean()) ** 2))
    p, verdict, words, farthest = judge(found, explained, own.throttle is not None and bool(
        np.ptp(own.throttle) >= MOVES and np.ptp(path) > 0.0))
    pooled = np.mean([m.distribution for m in measured], axis=0)
    responses = np.array([m.response for m in measured])
    falls = [band(-one.measured, -one.simulated) for one in found if one.kind == 'answer']
    low, high = np.percentile(traces, [2.5, 97.5], axis=0)
    empty = np.empty(0)
    response_low, response_high = (empty, empty) if not responses.size else np.percentile(
        responses, [2.5, 97.5], axis=0)
    return Agreement(
        recording.name, (0.0, float(own.t[0]) if model is None else 0.0),
        (float(own.t[0]), duration), tuple(simulator.names),
        explained, math.sqrt(float(np.mean(error ** 2))), round(float(error.mean()), 12),
        thirds,  # type: ignore[arg-type]
        found[0].band, found[1].band, tuple(yardstick.levels),
        tuple(one.band for one in found if one.kind == 'dips'),
        tuple(SpectrumBand(float(a), float(b), band(
            math.sqrt(real.power[k]), np.sqrt([m.power[k] for m in measured])))
            for k, (a, b) in enumerate(zip(yardstick.bands, yardstick.bands[1:]))),
        None if yardstick.line is None else SpectrumBand(
            yardstick.line.frequency, yardstick.line.frequency, next(
                one.band for one in found if one.kind == 'line')),
        falls[0] if falls else None, falls[1] if falls else None, int(yardstick.rises.size),
        band(distance(real, pooled), np.array([distance(m, pooled) for m in measured])),
        seeds, p, verdict, words, farthest, tuple(notes),
        Traces(own.t + offset, own.voltage,
               np.full(own.t.size, np.nan) if own.throttle is None else own.throttle, first,
               own.t[::stride] + offset, low, high, yardstick.after if responses.size else empty,
               real.response, response_low, response_high, yardstick.edges,
               real.distribution, pooled))


def _beginning(t: FloatArray, drawn: FloatArray, stride: int) -> slice:
    """Return the samples over which simulations, V (every stride-th sample), are aligned."""
    moves = drawn - drawn.mean(axis=0)
    span = _ALIGNED
    while span < t[-1] - t[0]:
        end = max(10, int(np.searchsorted(t, t[0] + span, side='right')))
        if moves[:, :max(1, end // stride)].mean(axis=1).std() <= _STEADY * moves.std():
            return slice(0, end)
        span *= 2.0
    return slice(0, t.size)


def _samples(recording: Recording, notes: list[str]) -> tuple[Readings, float]:
    """Return the readings without repeats, with stamps from 0 s on, and the first stamp, s."""
    t, v, u = usable(recording, notes)
    if v.size < 2 * _LEAST:
        raise InputError(f"'{recording.name}' holds {counted(v.size, 'usable sample')}; a "
                         f'comparison needs at least {2 * _LEAST}')
    reason = why_no_model(v)
    if reason:
        raise InputError(f"'{recording.name}': {reason}")
    t, v, u, period = without_repeats(t, v, u)
    if period > 1.0:
        notes.append(f'The logger repeats its last value, {number(period, 3)} samples per '
                     'reading: each reading is simulated and counted once.')
    if u is not None:
        u = np.clip(u, 0.0, 1.0)
    return Readings(t - t[0], v, u, current_at(recording, t)), float(t[0])


def _start_index(samples: Readings, fit_until: float | None, fitted: bool) -> int:
    duration = float(samples.t[-1])
    until = (0.5 * duration if fitted else 0.0) if fit_until is None else fit_until
    if not 0.0 <= until < duration or (fitted and not until > 0.0):
        raise InputError(f'the fit must end within the recording, 0 to {number(duration, 4)} s, '
                         f'got {until:g} s')
    begin = int(np.searchsorted(samples.t, until))
    for what, n, seconds in (
            ('fitted', begin, until), ('simulated', samples.t.size - begin, duration - until)):
        if (what == 'simulated' or fitted) and (n < _LEAST or not seconds > _SHORTEST):
            raise InputError(
                f'the part to be {what} has {counted(n, "reading")} in {number(seconds, 3)} s; it '
                f'needs {_LEAST} in more than {_SHORTEST:g} s')
    return begin


def _fit_notes(model: FlightModel, samples: Readings) -> list[str]:
    fit = model.fits[0]
    if fit.load is not Load.NONE:
        found = []
        if fit.load is Load.CURRENT:
            found.append('The simulated load is current, which explains the voltage better than '
                         'throttle.' if samples.throttle is not None else
                         'The simulated load is current.')
        doubt = float(model.odds[1])
        if doubt > _UNSURE:
            found.append('Whether the pack discharges is open: the level '
                         f'{"is constant" if fit.falls else "falls"} in {percent(doubt)} of the '
                         'simulations.')
        elif not fit.falls:
            found.append('No discharge is visible, so the level is constant.')
        return found
    if samples.current is None and samples.throttle is None:
        return ['Throttle is not recorded: only level and noise are simulated.']
    if samples.current is None and samples.throttle is not None and not np.ptp(
            samples.throttle) >= MOVES:
        return ['Throttle does not move: only level and noise are simulated.']
    return ['Neither throttle nor current explains the voltage: only level and noise are '
            'simulated.']


def _checked_load(model: SupplyModel, samples: Readings, name: str, notes: list[str]
                  ) -> Readings:
    """Return the readings with late current corrected; InputError if the load is missing."""
    needs = model.needs_throttle
    if model.full_current:
        if needs and samples.current is None:
            raise InputError(f"the load of the model is a current, and '{name}' has none")
        return samples if samples.current is None else replace(samples, current=on_time(
            samples.t, samples.voltage, samples.current, 'current', notes)[0])
    if needs and samples.throttle is None:
        raise InputError(f"the model's term '{needs[0]}' needs throttle, and the recording has "
                         'none')
    return samples
