"""
Compare a recording with simulations of it under the recorded throttle.

Limits: the only input of the fitted model is throttle or current; the bands include errors of its
parameters, estimated from held-out parts, but not later changes of the craft.

Dips below a level are counted with hysteresis, as in `supply_facts`.

The score of a number is its distance from the median, in half-widths of a band that is estimated
from the simulations and the recording; the half-width is at least a difference that a pilot would
not notice.  The largest weighted score is ranked among the largest scores of the simulations.  Of
recordings that follow the model, at most 2 % are called different by this rank, and 5 % because
their mean voltage is outside its band.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import enum
import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.noise import (
    dip_begins, noise_of, remainder, rise_that_ends, without_wild)
from ou_monitor.comparison.flight_model import file_simulator, fit_flight, MOVES
from ou_monitor.criticism.adc import find_step, without_repeats
from ou_monitor.criticism.readings import current_at, on_time, usable, why_no_model
from ou_monitor.errors import InputError
from ou_monitor.model.load_fit import LoadInput
from ou_monitor.model.sinusoid import LOBE
from ou_monitor.model.spectral_lines import find_lines, Line
from ou_monitor.model.supply import SupplyModel
from ou_monitor.records import FloatArray, NAN, Recording
from ou_monitor.text import counted, number, percent, Z95
from ou_monitor.timeline import part_of
from scipy.signal import welch


class Likeness(enum.Enum):
    """Whether the recording could be one of its simulations; the value is its wording."""

    LOOKS_LIKE_IT = 'The simulation looks like the recording'
    DIFFERS = 'The simulation differs from the recording'


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
BAND = (2.5, 97.5)


@dataclass(frozen=True, eq=False)
class ComparedNumber:
    """A number of the recording beside its distribution over the simulations."""

    kind: str  # Key of _WEIGHTS
    name: str
    unit: str
    digits: int
    least: float  # Minimum half-width of the band in which scores are counted
    at: tuple[float, ...]  # Level, V, or frequencies, Hz
    measured: float  # In the recording
    simulated: FloatArray  # In each simulation; shape (seeds,)
    # 2.5 %, 50 % and 97.5 % quantiles of the simulations.
    low: float = field(init=False)
    median: float = field(init=False)
    high: float = field(init=False)

    def __post_init__(self) -> None:
        # By this method, 95 % of further simulations lie in low..high; by NumPy's default method,
        # only 91 % do if the band comes from 50 simulations.
        for name, value in zip(('low', 'median', 'high'), np.percentile(
                self.simulated, [BAND[0], 50.0, BAND[1]], method='weibull').tolist()):
            object.__setattr__(self, name, value)

    @property
    def inside(self) -> bool:
        """Return whether the recording lies in the band."""
        return not self.outside[0]

    @property
    def outside(self) -> npt.NDArray[np.bool_]:
        """Return whether the recording, then each simulation, lies outside the band."""
        values = np.append(self.measured, self.simulated)
        hair = 1e-9 * np.abs(values)
        # No distance from the distribution is too small.
        low = 0.0 if self.kind == 'ks' else self.low
        return np.asarray((values < low - hair) | (values > self.high + hair))

    @property
    def label(self) -> str:
        """Return the name with the unit of the data."""
        return f'{self.name}, {self.unit}' if self.unit else self.name

    @property
    def texts(self) -> list[str]:
        """Return the unit, the measured number, and low, median and high of the simulations."""
        # Levels in V, differences in mV.
        factor, unit = (1e3, 'mV') if (self.unit, self.digits) == ('V', 3) else (1.0, self.unit)
        return [unit, *(number(factor * x, self.digits)
                        for x in (self.measured, self.low, self.median, self.high))]

    @property
    def words(self) -> str:
        """Return the number as a part of a sentence."""
        unit, measured, low, median, high = self.texts
        unit = f' {unit}' if unit else ''
        return (f'{self.name}, simulated {median}{unit} ({low} to {high}), measured '
                f'{measured}{unit}')

    def as_data(self) -> dict[str, float]:
        """Return the four numbers by name."""
        return {'measured': self.measured, 'simulated_low': self.low,
                'simulated_median': self.median, 'simulated_high': self.high}

    def scores(self) -> FloatArray:
        """Return the weighted scores: of the recording, then of each simulation."""
        # The scale includes the recording like each simulation; otherwise the recording would have
        # the largest score too often.
        off = np.append(self.measured, self.simulated)
        if self.kind == 'spectrum':
            off = 2.0 * np.log(np.maximum(off, 1e-150))
        off -= np.median(off)
        up, down = (Z95 * math.sqrt(float(np.mean(side ** 2))) if side.size else 0.0
                    for side in (off[off > 0.0], off[off < 0.0]))
        half = np.maximum(np.where(off > 0.0, up, down), self.least)
        return np.asarray(_WEIGHTS[self.kind] * np.abs(off) / half)


class _Number(NamedTuple):
    """A number of one voltage; the fields are those of `ComparedNumber` up to `measured`."""

    kind: str
    name: str
    unit: str
    digits: int
    least: float
    at: tuple[float, ...]
    measured: float


@dataclass(frozen=True, eq=False)
class Measures:
    """Measures of one voltage."""

    numbers: list[_Number]  # All but the KS distance
    response: FloatArray  # Mean response to rises, V; empty with too few; shape (points,)
    distribution: FloatArray  # Share of the samples below each edge; shape (bins,)


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
    bias_by_third: tuple[float, ...]  # V
    rows: tuple[ComparedNumber, ...]
    p_value: float  # Share, of simulations and recording, with at least the recording's score
    verdict: Likeness
    words: str  # The largest difference, as a part of a sentence
    farthest: str  # Kind of that difference: a key of _WEIGHTS, or path
    notes: tuple[str, ...]  # What was left out or assumed
    # For a page: the part compared, stamps in s after the first sample; one simulation of it, V;
    # every stride-th sample of each, V; and the measures of the recording, then of each.
    part: Recording
    one: FloatArray
    stride: int
    drawn: npt.NDArray[np.float32]
    yardstick: Yardstick
    measured: tuple[Measures, ...]

    def of(self, kind: str) -> list[ComparedNumber]:
        """Return the rows of a kind."""
        return [row for row in self.rows if row.kind == kind]

    @property
    def lowest(self) -> ComparedNumber:
        """Return the lowest voltage."""
        return self.of('lowest')[0]

    @property
    def seeds(self) -> int:
        """Return the number of simulations."""
        return len(self.drawn)

    @property
    def in_part(self) -> bool:
        """Return whether more numbers are outside their bands than chance explains."""
        counts = np.sum([row.outside for row in self.rows], axis=0)
        return bool(np.mean(counts >= counts[0]) <= max(LEVEL, 1.0 / counts.size))

    @property
    def worst(self) -> str:
        """Return the largest difference in a sentence."""
        chance = '' if self.verdict is Likeness.DIFFERS or self.in_part else ', within chance'
        return f'Largest difference{chance}: {self.words}.'

    def measures(self) -> list[dict[str, Any]]:
        """Return all numbers of the recording and of the simulations, in SI units."""
        return [{'measure': row.label, **row.as_data(),
                 'inside': row.inside} for row in self.rows]

    def as_data(self) -> dict[str, Any]:
        """Return the data of `--json`."""
        return {
            'recording': self.recording, 'fitted_s': list(self.fitted),
            'simulated_s': list(self.simulated), 'model': list(self.model),
            'mean_path': {'variance_explained': self.explained, 'rmse_v': self.rmse,
                          'bias_v': self.bias, 'bias_by_third_v': list(self.bias_by_third)},
            'lowest_v': self.lowest.as_data(),
            'crossings_per_min': [{'level_v': row.at[0], **row.as_data()}
                                  for row in self.of('dips')],
            'spectrum': [{'from_hz': row.at[0], 'to_hz': row.at[1],
                          'simulated_over_measured': (
                             (row.median / row.measured) ** 2 if row.measured > 0.0 else NAN)}
                         for row in self.of('spectrum')],
            'ks_distance': self.of('ks')[0].measured, 'worst': self.worst,
            'verdict': self.verdict.name.lower()}


# Quantiles of the measured voltage that give the two low levels.
LOW_SHARES = (0.01, 0.05)
# Bands of the spectrum, and maximum length of a Welch segment, s.
_BANDS, _SEGMENT = 5, 20.0
# A rise of throttle: minimum rise, maximum duration, s, and minimum time without a rise before, s.
_RISE, _WITHIN, _QUIET = 0.1, 0.2, 1.0
# Response: time before and after a rise begins, s, points, and minimum number of rises.
_BEFORE, _AFTER, _POINTS, _FEWEST = 0.2, 1.5, 86, 3
# Time after a rise begins at which the recovery is measured, s.
RECOVERED = 1.0
# Bins of the distribution.
_BINS = 2000


class Yardstick:
    """Levels, frequency bands and rises of a recording, by which voltages are compared."""

    def __init__(self, samples: Recording, lsb: float, limits: tuple[float, ...] = ()) -> None:
        # lsb: step of the ADC, V, or 0; limits: levels, V, in addition to the two low ones.
        v, t = samples.voltage, samples.t
        self._t = t
        self._minutes = float(t[-1] - t[0]) / 60.0
        # Levels between two codes of the ADC, so that no reading equals them.
        low = dict.fromkeys(np.quantile(v, LOW_SHARES, method='lower').tolist())
        self.levels = [*limits, *(code + 0.5 * lsb for code in low)]
        flown, left = without_wild(samples, remainder(samples))
        self._rise = rise_that_ends(v, samples.throttle, noise_of(flown, left))
        self._rate = 1.0 / float(np.median(np.diff(t)))
        self._segment = int(min(v.size, max(64, min(_SEGMENT * self._rate, v.size / 4))))
        self._bands = np.geomspace(self._rate / self._segment, 0.5 * self._rate, _BANDS + 1)
        self._line = _lasting_line(np.nan_to_num(left.voltage), self._rate)
        self.rises = _rise_times(t, samples.throttle)
        self.after = np.linspace(-_BEFORE, _AFTER, _POINTS)
        self._spread = float(np.ptp(v))
        reach = 0.5 * self._spread + 10.0 * lsb
        # Edges of the bins of the distribution, V.
        self.edges = np.linspace(v.min() - reach, v.max() + reach, _BINS)

    def measure(self, v: FloatArray) -> Measures:
        """Measure a voltage at the stamps of the part, V."""
        volts = max(_RANGE * self._spread, 1e-12)
        found = [_Number('lowest', 'lowest voltage', 'V', 4, volts, (), float(v.min())),
                 _Number('level', 'mean voltage', 'V', 4, volts, (), float(v.mean()))]
        for level in self.levels:
            count = dip_begins(v, level, self._rise).size
            # The Poisson error of the count, at least.
            least = max((_RATE - 1.0) * count, math.sqrt(max(count, 1)))
            found.append(_Number('dips', f'dips below {round(level, 3):g} V', '1/min', 3,
                                 least / self._minutes, (level,), count / self._minutes))
        response = np.empty(0)
        if self.rises.size >= _FEWEST:
            around = np.interp(self.rises[:, None] + self.after, self._t, v)
            before = around[:, self.after < 0.0].mean(axis=1, keepdims=True)
            response = (around - before).mean(axis=0)
            begin, later = np.searchsorted(self.after, [0.0, RECOVERED]).tolist()
            found += [_Number('answer', name, 'V', 3, volts, (), -float(low)) for name, low in (
                ('fall after rises', response[begin:].min()),
                ('fall left after 1 s', response[later]))]
        f, density = welch(v, self._rate, nperseg=self._segment)
        power = f[1] * np.histogram(
            np.minimum(f, self._bands[-1]), self._bands, weights=density)[0]
        found += [
            _Number('spectrum', f'rms {number(low, 2)} to {number(high, 2)} Hz', 'V', 3,
                    math.log(_POWER), (low, high), math.sqrt(one))
            for low, high, one in zip(self._bands.tolist(), self._bands[1:].tolist(), power)]
        if self._line is not None:
            at, width = self._line.frequency, self._line.resolution
            f, density = welch(v, self._rate, nperseg=min(v.size, round(self._rate / width)))
            found.append(_Number(
                'line', f'rms at {number(at, 4)} Hz (line)', 'V', 3, volts, (at,),
                math.sqrt(width * density[np.abs(f - at) <= LOBE * width].sum())))
        return Measures(found, response,
                        np.searchsorted(np.sort(v), self.edges, side='right') / v.size)


def rows_of(measured: Sequence[Measures]) -> list[ComparedNumber]:
    """Return the rows of a table, from the recording's measures and each simulation's."""
    pooled = np.mean([one.distribution for one in measured], axis=0)
    every = [[*one.numbers, _Number(
        'ks', 'distribution (KS distance)', '', 2, _KS, (),
        float(np.abs(one.distribution - pooled).max()))] for one in measured]
    return [ComparedNumber(*own, np.array([other[k].measured for other in every[1:]]))
            for k, own in enumerate(every[0])]


def _lasting_line(rest: FloatArray, rate: float) -> Line | None:
    """Return the strongest line that both halves of a residual, V, have; None without one."""
    # Lines are detected in differences, whose spectrum is flatter.
    first, second = (find_lines([half], rate, white=[np.diff(half, prepend=0.0)]).lines
                     for half in np.array_split(rest, 2))
    return max((one for one in first if any(
        abs(one.frequency - other.frequency) < one.resolution + other.resolution
        for other in second)), key=lambda line: line.rms, default=None)


def _rise_times(t: FloatArray, throttle: FloatArray) -> npt.NDArray[np.float64]:
    """Return the stamps at which throttle begins to rise, s."""
    before = np.searchsorted(t, t - _WITHIN)
    rising = throttle - throttle[before] >= _RISE
    found: list[float] = []
    for k in np.flatnonzero(rising[1:] & ~rising[:-1]) + 1:
        room = t[0] + _BEFORE + _WITHIN < t[k] < t[-1] - _AFTER
        if room and (not found or t[k] - found[-1] > _QUIET):
            # The rise is detected at its end; its beginning is the steepest point.
            steepest = int(np.argmax(np.diff(throttle[before[k]:k + 1])))
            found.append(float(t[before[k] + steepest]))
    return np.array(found)


def judge(found: Sequence[ComparedNumber], explained: float, moved: bool
          ) -> tuple[float, Likeness, str, str]:
    """Return p-value, verdict, the largest difference in words, and its kind."""
    # explained: share of the variance explained by the mean path; moved: whether that path moves.
    scores = np.array([one.scores() for one in found])
    largest = scores.max(axis=0)
    p = float(np.mean(largest >= largest[0]))
    rare = p <= max(LEVEL, 1.0 / largest.size)
    if moved and explained < 0.0 and not rare:
        return p, Likeness.DIFFERS, (
            f'the mean path explains {number(100.0 * explained, 2)} % of the variance, less than '
            'a constant would'), 'path'
    worst = found[int(np.argmax(scores[:, 0]))]
    off = {one.kind: one for one in found
           if not one.inside and abs(one.measured - one.median) > one.least}
    if 'level' in off and 'answer' not in off:
        # The other differences follow from the level, unless the response to throttle is wrong.
        rare, worst = True, off['level']
    return p, Likeness.DIFFERS if rare else Likeness.LOOKS_LIKE_IT, worst.words, worst.kind


# Minimum readings and duration, s, of a part; minimum number of simulations (at which 5 % of good
# models are rejected), and maximum.
_LEAST, _SHORTEST, _FEWEST_SEEDS, _MOST_SEEDS = 50, 0.2, 20, 10_000
# Maximum points of the band on a page.
_PLOTTED = 2000
# Minimum time at the beginning of the recording over which a model from a file is aligned, s.  It
# is doubled until the means over it differ between simulations by a standard deviation of at most
# `_STEADY` times that of single samples; it then holds about ten independent pieces.
_ALIGNED, _STEADY = 2.0, 0.3
# Probability above which the other kind of level (constant or falling) is reported.
_UNSURE = 0.05
# What is said of the load that was fitted.
_LOADS = {LoadInput.NONE: ['No recorded load explains the voltage: only level and noise are '
                           'simulated.'],
          LoadInput.THROTTLE: [], LoadInput.CURRENT: ['The simulated load is the current.']}


def compare(recording: Recording, model: SupplyModel | None = None, *,
            fit_until: float | None = None, seeds: int = 50, seed: int = 0,
            levels: tuple[float, ...] = (),
            progress: Callable[[float], None] | None = None) -> Agreement:
    """Compare a recording with simulations: see `ou_monitor.compare` (levels: limits, V)."""
    report = progress or (lambda share: None)
    if not _FEWEST_SEEDS <= seeds <= _MOST_SEEDS:
        raise ValueError(f'seeds must lie within {_FEWEST_SEEDS} to {_MOST_SEEDS}, got {seeds}')
    notes = list(recording.notes)
    samples = _samples(recording, notes)
    begin = _start_index(samples, fit_until, fitted=model is None)
    late: list[str] = []
    if samples.current is not None:
        current, sign = on_time(samples.t, samples.voltage, samples.current, 'current', late,
                                begin if model is None else None)
        samples = replace(samples, current=current * (sign if model is None else 1.0))
    if model is None:
        fitted = fit_flight(part_of(samples, slice(0, begin)))
        fit, names, draw = fitted.fits[0], fitted.names, fitted.simulator(samples)
        notes += (late if fit.load is LoadInput.CURRENT else []) + _LOADS[fit.load]
        if (doubt := float(1.0 - fitted.odds[0])) > _UNSURE:
            notes.append('Whether the pack discharges is open: the level '
                         f'{"is constant" if fit.falls else "falls"} in {percent(doubt)} of the '
                         'simulations.')
        elif fit.load is not LoadInput.NONE and not fit.falls:
            notes.append('No discharge is visible, so the level is constant.')
    else:
        names, draw = [term.NAME for term in model.terms], file_simulator(model, samples)
        notes += late if model.full_current else []
        notes.append('The errors of the parameters in the model file are not simulated: the '
                     'bands include only the noise.')
    report(0.3)
    # Codes of an ADC may have any offset.
    lsb, code = find_step(samples.voltage), float(np.sort(samples.voltage)[samples.n // 2])

    def read(v: FloatArray) -> FloatArray:
        return np.asarray(code + lsb * np.rint((v - code) / lsb)) if lsb > 0.0 else v

    own = part_of(samples, slice(begin, None))
    own = replace(own, voltage=read(own.voltage))
    yardstick = Yardstick(own, lsb, levels)
    stride = -(-own.n // _PLOTTED)
    # A model from a file has the level of another flight.
    aligned = slice(0) if model is None else _beginning(own.t, np.array([
        draw(np.random.default_rng((seed, k)))[begin::stride]
        for k in range(_FEWEST_SEEDS)]), stride)
    rng, shifts = np.random.default_rng(seed), np.zeros(seeds)
    measured = [yardstick.measure(own.voltage)]
    drawn = np.empty((seeds, own.t[::stride].size), dtype=np.float32)
    total, one = np.zeros(own.n), own.voltage
    for k in range(seeds):
        v = draw(rng)[begin:]
        if not np.isfinite(v).all():
            raise InputError('the model diverges over this throttle: its voltage is not finite')
        if model is not None:
            # Align each simulation by itself, so that the bands include the error of the level.
            shifts[k] = (own.voltage[aligned] - v[aligned]).mean()
            v = v + shifts[k]
        total += v
        v = read(v)
        one = v if k == 0 else one
        measured.append(yardstick.measure(v))
        drawn[k] = v[::stride]
        report(0.3 + 0.7 * (k + 1.0) / seeds)
    if model is not None:
        notes.append(f'The level of the model was moved by {number(float(shifts.mean()), 3)} V '
                     f'(+- {number(float(shifts.std()), 2)} V), so that the mean of the first '
                     f'{number(float(np.ptp(own.t[aligned])))} s of each simulation equals the '
                     "recording's.")
    path = fitted.path(samples)[begin:] if model is None else total / seeds
    error = path - own.voltage
    rows = rows_of(measured)
    explained = 1.0 - float(np.mean(error ** 2) / own.voltage.var())
    return Agreement(
        recording.name, (0.0, float(own.t[0]) if model is None else 0.0),
        (float(own.t[0]), float(own.t[-1])), tuple(names),
        explained, math.sqrt(float(np.mean(error ** 2))), round(float(error.mean()), 12),
        tuple(float(third.mean()) for third in np.array_split(error, 3)), tuple(rows),
        *judge(rows, explained, bool(np.ptp(own.throttle) >= MOVES and np.ptp(path) > 0.0)),
        tuple(notes), own, one, stride, drawn, yardstick, tuple(measured))


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


def _samples(recording: Recording, notes: list[str]) -> Recording:
    """Return the readings without repeats, with stamps from 0 s on."""
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
    return Recording(t - t[0], v, np.array(NAN) if u is None else np.clip(u, 0.0, 1.0),
                     current=current_at(recording, t))


def _start_index(samples: Recording, fit_until: float | None, fitted: bool) -> int:
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
