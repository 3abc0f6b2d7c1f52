"""
Presets, throttle profiles, and simulated recordings, piece by piece.

A profile is a function of time, so memory does not grow with the length of a recording.  The
presets are the paper's load states, and a flight; parameters are from the paper's Tables 1 and 2
unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
import math
from pathlib import Path
from typing import Any

import numpy as np
from ou_monitor.errors import InputError, nearest
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentSigma, LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise, Quantization
from ou_monitor.model.terms.slow import Drift
from ou_monitor.recordings.importers.csv_table import holds_supply, read_throttle_alone
from ou_monitor.recordings.importers.formats import CSV, kind_of
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.recordings.model_file import ModelFile, read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import clock_unit, FloatArray, NAN, Recording
from ou_monitor.text import plain_number, printable

# Stamps (s) -> throttle 0..1.
Profile = Callable[[FloatArray], FloatArray]

# Rate at which a receiver updates the throttle, Hz.
STICK_RATE = 50.0

# (time s, throttle), linear between: arm, take-off, hover, two climbs
# and descents, landing.
FLIGHT = (
    (0.0, 0.0), (2.0, 0.0), (2.2, 0.05), (4.0, 0.05), (4.6, 0.55), (6.0, 0.55), (6.4, 0.40),
    (12.0, 0.40), (12.4, 0.65), (16.0, 0.65), (16.4, 0.40), (19.0, 0.40), (19.4, 0.25),
    (23.0, 0.25), (23.4, 0.40), (26.0, 0.40), (26.3, 0.75), (28.5, 0.75), (28.9, 0.30),
    (32.0, 0.30), (32.4, 0.40), (34.0, 0.40), (36.5, 0.20), (37.0, 0.05), (37.5, 0.0),
    (40.0, 0.0))

# The paper's auxiliary recording (section 4.3): 0 -> 20 -> 0 %.
TRANSIENT = ((0.0, 0.0), (3.0, 0.0), (3.0, 0.20), (6.0, 0.20), (6.0, 0.0), (10.0, 0.0))

# The paper's four load states in turn.
LOADS = ((0.0, 0.0), (10.0, 0.0), (10.0, 0.05), (20.0, 0.05), (20.0, 0.10), (30.0, 0.10),
         (30.0, 0.40), (40.0, 0.40))


def through(points: Sequence[tuple[float, float]], period: float | None = None,
            stick_rate: float | None = None) -> Profile:
    """Return a profile through points (s, 0..1); period in s; stick_rate: rate of steps, Hz."""
    return partial(_through, np.array(points, dtype=np.float64).T, period, stick_rate)


def _through(points: FloatArray, period: float | None, stick_rate: float | None, t: FloatArray,
             ) -> FloatArray:
    # Several times as fast as t % period, and equal to it within one rounding error.
    at = t if period is None else t - np.floor(t / period) * period
    if stick_rate is not None:
        # Tolerance for rounding: a stamp at an update has the new value.
        at = np.floor(at * stick_rate + 1e-6) / stick_rate
    found: FloatArray = np.interp(at, *points)
    return found


def constant(throttle: float) -> Profile:
    """Return the profile that is `throttle` at all times."""
    return partial(np.full_like, fill_value=throttle, dtype=np.float64)


def _hover(t: FloatArray) -> FloatArray:
    """Return a hover at 40 % with the small corrections of a pilot."""
    held = np.floor(t * STICK_RATE + 1e-6) / STICK_RATE
    return 0.4 + 0.04 * np.sin(2.0 * math.pi * 0.31 * held) + 0.03 * np.sin(
        2.0 * math.pi * 0.83 * held + 1.0) + 0.02 * np.sin(2.0 * math.pi * 2.1 * held + 2.0)


PROFILES: dict[str, tuple[Profile, str]] = {
    'flight': (through(FLIGHT, 40.0, STICK_RATE), 'arm, take-off, hover, climbs, landing; 40 s, '
               'repeated'),
    'hover': (_hover, '40 % with the small corrections of a pilot'),
    'loads': (through(LOADS, 40.0), "the paper's 0, 5, 10, 40 % for 10 s each, repeated"),
    'transient': (through(TRANSIENT, 10.0), "the paper's 0 -> 20 -> 0 %; 10 s, repeated"),
}


def read_profile(text: str, columns: CsvColumns | None = None) -> Profile:
    """Return the profile that a text describes (columns: for a CSV)."""
    if text in PROFILES:
        return PROFILES[text][0]
    points = _points_of(text, columns)
    return constant(float(text)) if points is None else through(points)


def _points_of(text: str, columns: CsvColumns | None) -> list[tuple[float, float]] | None:
    """Return the points, s and 0..1, of a text or a CSV; None if the text is a number."""
    if text.lower().endswith('.csv') or Path(text).is_file():
        return _from_csv(Path(text), columns)
    try:
        number = plain_number(text)
    except ValueError:
        if ':' not in text:
            raise InputError(
                f"no throttle profile '{printable(text, 60)}': {nearest(text, PROFILES)} (or give "
                'a number 0..1, points T:U,T:U,..., a CSV file or a recording)') from None
        return _checked(_points(text), f"throttle '{text}'")
    _check_throttle(number, f"throttle '{text}'")
    return None


def _points(text: str) -> list[tuple[float, float]]:
    points = []
    for part in text.split(','):
        try:
            time, value = (plain_number(word) for word in part.split(':'))
        except ValueError:
            raise InputError(f"throttle point '{printable(part, 60)}' is not T:U, seconds and "
                             '0..1') from None
        points.append((time, value))
    return points


def _checked(points: list[tuple[float, float]], where: str) -> list[tuple[float, float]]:
    for (before, _), (after, _) in zip(points, points[1:]):
        if not after >= before:
            raise InputError(f'{where}: times must not fall, {after:g} s comes after {before:g} s')
    for time, value in points:
        if not math.isfinite(time):
            raise InputError(f'{where}: times must be finite')
        _check_throttle(value, where)
    # A profile needs at least two points.
    return points if len(points) > 1 else [points[0], (points[0][0] + 1.0, points[0][1])]


def _check_throttle(value: float, where: str) -> None:
    if not 0.0 <= value <= 1.0:
        raise InputError(f'{where}: throttle must be a number 0..1, got {value:g}')


def _from_csv(path: Path, columns: CsvColumns | None) -> list[tuple[float, float]]:
    t, throttle = read_throttle_alone(path, columns)
    if not t.size:
        raise InputError(f'{path} holds no row')
    # Stamps since 1970 are counted from the first one.
    t = t - (t[0] if clock_unit(t[0]) else 0.0)
    return _checked(list(zip(t.tolist(), throttle.tolist())), str(path))


def is_recording(text: str, columns: CsvColumns | None = None) -> bool:
    """Return whether the text for a throttle names a recording (columns: for a CSV)."""
    path = Path(text)
    if text in PROFILES or not path.exists():
        return False
    # A table without a voltage is a profile: points in time, linear between them.
    table = path.suffix.lower() == '.csv' or kind_of(path) == CSV
    return not table or holds_supply(path, columns)


def recorded_throttle(recording: Recording, name: str, full: float = 0.0) -> Profile:
    """Return a recording's throttle, or its current divided by `full`, A (name: for errors)."""
    # Stamps count from the first sample; each value holds until the next.
    t = recording.t - recording.t[0]
    if full:
        if recording.current is None or not np.isfinite(recording.current).any():
            raise InputError(f"--throttle '{name}': the load of this model is a current (1 = "
                             f'{full:.4g} A), and the recording has none')
        known = np.isfinite(recording.current)
        return partial(_held, t[known], recording.current[known] / full)
    known = np.isfinite(recording.throttle)
    if not known.any():
        raise InputError(f"--throttle '{name}': the recording has no throttle: name its column or "
                         'series with --throttle-column')
    # The reader has already refused percent and pulses; calibrated sticks may slightly exceed
    # 0..1.
    return partial(_held, t[known], np.clip(recording.throttle[known], 0.0, 1.0))


def _held(t: FloatArray, u: FloatArray, at: FloatArray) -> FloatArray:
    # Tolerance for rounding: a value holds from its own stamp.
    return np.asarray(u[np.maximum(np.searchsorted(t, at + 1e-9, side='right') - 1, 0)])


# The paper's rail, V, and relaxation rate, 1/s (Table 2).
U0 = 5.0
ALPHA = 63.0

# Noise intensity by throttle, V/sqrt(s).  10 % and 40 % are from Table 2; 5 % is from its Vrms of
# 9.38 mV (Table 1).  With the motors off the paper prints "~0", so the Vrms is at most half of the
# oscilloscope's step of 9.375 mV; this half, 4.7 mV, is used here.
SIGMA = {0.0: 4.7e-3 * math.sqrt(2.0 * ALPHA), 0.05: 9.38e-3 * math.sqrt(2.0 * ALPHA),
         0.10: 0.3156, 0.40: 0.632}

# Deviation right after 20 % throttle is released, V (Fig. 5).
TRANSIENT_SAG = 0.368

# Preset 'flight': sag at full throttle, V, and the sensor's white noise, V.
FLIGHT_SAG = 0.3
FLIGHT_NOISE = 2e-3


@dataclass(frozen=True)
class Preset:
    """A supply with its throttle and its sampling."""

    text: str  # Description
    model: SupplyModel  # The supply
    throttle: str  # Throttle, as text for `read_profile`
    rate: float  # Samples per second, Hz
    duration: float  # Length, s


def _load(throttle: float) -> Preset:
    return Preset(f"the paper's load state of {throttle:.0%} throttle",
                  SupplyModel((OU(ALPHA, SIGMA[throttle], U0),)), f'{throttle:g}', 1000.0, 60.0)


def _intensity() -> LoadDependentSigma:
    """Return the paper's intensities, as factors on the intensity at idle."""
    return LoadDependentSigma(tuple(SIGMA),
                              tuple(math.log(s / SIGMA[0.0]) for s in SIGMA.values()))


PRESETS: dict[str, Preset] = {
    'idle': _load(0.0),
    'load_05': _load(0.05),
    'load_10': _load(0.10),
    'load_40': _load(0.40),
    # The sag follows throttle with the relaxation time of the rail.
    'transient': Preset(
        'the auxiliary recording 0 -> 20 -> 0 % of Fig. 5',
        SupplyModel((OU(ALPHA, SIGMA[0.05], U0), LoadSag(TRANSIENT_SAG / 0.2, 0.0),
                     LoadTransient(TRANSIENT_SAG / 0.2, 1.0 / ALPHA, 0.0))),
        'transient', 1000.0, 10.0),
    'loads': Preset("the paper's four load states in turn, sigma following throttle",
                    SupplyModel((OU(ALPHA, SIGMA[0.0], U0), _intensity())), 'loads', 1000.0,
                    40.0),
    'flight': Preset(
        'a flight: sag, sigma following throttle, white sensor noise',
        SupplyModel((OU(ALPHA, SIGMA[0.0], U0), LoadSag(FLIGHT_SAG, 0.0), _intensity(),
                     MeasurementNoise(FLIGHT_NOISE))), 'flight', 1000.0, 120.0),
    'flight_full': Preset(
        'a flight as logs show it: also a lag, discharge and ADC steps',
        SupplyModel((OU(ALPHA, SIGMA[0.0], U0), LoadSag(FLIGHT_SAG, 0.1),
                     LoadTransient(0.15, 0.4, 0.0), _intensity(), Drift(-1e-3, 0.0),
                     MeasurementNoise(5e-3), Quantization(10e-3))), 'flight', 1000.0, 120.0),
}


# Largest voltage, V: far above any supply, and within the range of messages.
LARGEST = 1e9


class RunningSupply:
    """A running simulation: sample k is at k/rate, s; charge, resistance: see `Simulation`."""

    def __init__(self, model: SupplyModel, *, rate: float, seed: int,
                 charge: float | None = None, resistance: float = 1.0) -> None:
        self.rate = rate
        self.samples = 0
        self.simulation = Simulation(model, np.random.default_rng(seed), charge=charge,
                                     resistance=resistance)

    def times(self, n: int) -> FloatArray:
        """Return the stamps of the next n samples, s."""
        return np.arange(self.samples, self.samples + n) / self.rate

    def draw(self, throttle: FloatArray) -> FloatArray:
        """Return the next voltages, V, one for each throttle."""
        with np.errstate(over='ignore', invalid='ignore'):
            voltage = self.simulation.advance(
                self.times(throttle.size),
                # Rounded as in a message, so that a bag holds the throttle that was simulated.
                throttle.astype(np.float32).astype(np.float64))
        if not (np.abs(voltage) <= LARGEST).all():
            raise ValueError(
                f'the model gives voltages beyond {LARGEST:g} V: check its parameters')
        self.samples += throttle.size
        return voltage


def lacks(model: SupplyModel) -> tuple[str, ...]:
    """Return the properties of a supply under load that the model lacks, in words."""
    names = {term.NAME for term in model.terms}
    missing = []
    if not any(term.FAMILY == 'load' for term in model.terms):
        missing.append('no response to throttle (load_sag)')
    if not model.charged:
        missing.append('no charge (load)' + (
            '' if 'drift' in names else ' and no drift: it never discharges'))
    return tuple(missing)


def simulated(model: SupplyModel, profile: Profile, *, duration: float, rate: float, seed: int,
              name: str = 'simulated', charge: float | None = None, resistance: float = 1.0,
              ) -> Iterator[Recording]:
    """Yield a recording in pieces (profile in s, duration in s, rate in Hz)."""
    total = round(duration * rate)
    try:
        run = RunningSupply(model, rate=rate, seed=seed, charge=charge, resistance=resistance)
        while run.samples < total:
            t = run.times(min(SEGMENT, total - run.samples))
            load = profile(t).astype(np.float32).astype(np.float64)
            yield _recording(model, t, run.draw(load), load * (model.full_current or 1.0), name)
    except ValueError as error:
        raise InputError(str(error)) from error


def _recording(model: SupplyModel, t: FloatArray, voltage: FloatArray, load: FloatArray,
               name: str) -> Recording:
    """Return a recording whose load is the model's: throttle, 0..1, or a current, A."""
    return Recording(t, voltage, name=name, current=load) if model.full_current else (
        Recording(t, voltage, load, name))


# Maximum rate, Hz (stamps count in ns), and maximum duration, s, of a bag.
_RATE_MOST, _DURATION_MOST = 1e9, 9e9


@dataclass(frozen=True, eq=False)
class Run:
    """A recording to be simulated."""

    file: ModelFile  # The supply
    name: str  # Name of the preset or of the model file
    profile: Profile  # Throttle, 0..1, over stamps, s
    throttle: str  # Throttle as the user named it
    flown: Recording | None  # Recording of the throttle; None: not recorded
    duration: float  # s
    rate: float  # Hz
    seed: int
    charge: float | None  # Initial charge, as for `RunningSupply`
    resistance: float  # Factor on the response to throttle

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return round(self.duration * self.rate)

    def pieces(self) -> Iterator[Recording]:
        """Yield the recording in pieces."""
        return simulated(self.file.model, self.profile, duration=self.duration, rate=self.rate,
                         seed=self.seed, name=self.name, charge=self.charge,
                         resistance=self.resistance)

    @cached_property
    def recording(self) -> Recording:
        """Return the whole recording."""
        pieces = list(self.pieces())
        t, voltage, load = (np.concatenate([getattr(piece, column) for piece in pieces])
                            for column in ('t', 'voltage', 'current' if (
                                self.file.model.full_current) else 'throttle'))
        return _recording(self.file.model, t, voltage, load, self.name)

    @property
    def load(self) -> FloatArray:
        """Return the load of the simulated recording: throttle, 0..1, or current, A."""
        current = self.recording.current
        return self.recording.throttle if current is None else current

    def as_data(self) -> dict[str, Any]:
        """Return the parameters of the simulation, for JSON."""
        return {'duration_s': self.duration, 'rate_hz': self.rate, 'seed': self.seed,
                'throttle': self.throttle, 'n': self.n,
                'model': [{'term': term.NAME, 'params': term.values()}
                          for term in self.file.model.terms]}


def plan(model: SupplyModel | ModelFile | str | Path | None = None, *, preset: str | None = None,
         throttle: Any = None, start: float | None = None, end: float | None = None,
         duration: float | None = None, rate: float | None = None, seed: int = 1,
         capacity_left: float | None = None, resistance: float = 1.0,
         columns: CsvColumns | None = None) -> Run:
    """Return the run that the arguments of `ou_monitor.simulate` describe."""
    name = 'flight' if preset is None else preset
    if name not in PRESETS:
        raise InputError(f"no preset '{name}': {nearest(name, PRESETS)}")
    usual = PRESETS[name]
    if model is None:
        file = ModelFile(usual.model, provenance={'preset': name})
    elif isinstance(model, (str, Path)):
        file, name = read_model(model), Path(model).stem
    else:
        file, name = model if isinstance(model, ModelFile) else ModelFile(model), 'model'
    still = throttle is None and model is not None and not (
        file.model.needs_throttle or file.model.load)
    profile, words, flown, length = (constant(NAN), 'none', None, NAN) if still else _throttle_of(
        usual.throttle if throttle is None else throttle, start, end, columns,
        file.model.full_current)
    length = length if length > 0.0 else usual.duration
    rate = _positive('--rate', _rate_of(file, usual.rate) if rate is None else rate, 'Hz')
    duration = _positive('--duration', length if duration is None else duration, 's')
    if not 1.0 <= duration * rate <= 1e12:
        raise InputError(f'{duration:g} s at {rate:g} Hz are {duration * rate:.3g} samples, '
                         'outside 1 to 1e12')
    for option, value, most, unit in (('--duration', duration, _DURATION_MOST, 's'),
                                      ('--rate', rate, _RATE_MOST, 'Hz')):
        if value > most:
            raise InputError(f'{option} must be at most {most:g} {unit}, as bags count in ns; got '
                             f'{value:g}')
    if capacity_left is not None and capacity_left != -1.0 and not 0.0 <= capacity_left <= 1.0:
        raise InputError(f'--capacity-left must lie within 0..1, or be -1, got {capacity_left:g}')
    resistance = _positive('--scale-resistance', resistance, '')
    charge = math.nan if capacity_left == -1.0 else capacity_left
    return Run(file, name, profile, words, flown, duration, rate, seed, charge, resistance)


def _rate_of(file: ModelFile, usual: float) -> float:
    """Return the rate of the recording that a model was learned from, if stated, else `usual`."""
    rate = file.provenance.get('rate_hz')
    return float(rate) if isinstance(rate, (int, float)) and 0.0 < rate <= _RATE_MOST else usual


def _throttle_of(throttle: Any, start: float | None, end: float | None,
                 columns: CsvColumns | None, full: float
                 ) -> tuple[Profile, str, Recording | None, float]:
    """Return the profile of a throttle, its name, its recording, and its length, s, or NaN."""
    words = throttle.name if isinstance(throttle, Recording) else str(throttle)
    if callable(throttle):
        return throttle, 'given', None, NAN
    flown = throttle if isinstance(throttle, Recording) else read_recording(
        words, start=start, end=end, columns=columns) if is_recording(words, columns) else None
    if flown is not None:
        return recorded_throttle(flown, words, full), words, flown, flown.duration
    if start is not None or end is not None:
        raise InputError('--from and --to take a part of a recorded throttle: give --throttle '
                         'RECORDING')
    points = None if words in PROFILES else _points_of(words, columns)
    return (read_profile(words), words, None, NAN) if points is None else (
        through(points), words, None, points[-1][0])


def _positive(name: str, value: float, unit: str) -> float:
    if not (math.isfinite(value) and value > 0.0):
        raise InputError(f'{name} must be a positive number{unit and f" of {unit}"}, '
                         f'got {value:g}')
    return value
