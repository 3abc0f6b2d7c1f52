"""What a simulation gets right and wrong of a recording: the record, and its data."""

from __future__ import annotations

from dataclasses import dataclass
import enum
from typing import Any

from ou_monitor.records import FloatArray


class Likeness(enum.Enum):
    """Whether the recording could be one of its simulations; the value is said to people."""

    LOOKS_LIKE_IT = 'The simulation looks like the recording'
    DIFFERS = 'The simulation differs from the recording'


@dataclass(frozen=True)
class Band:
    """A number of the recording beside those of the simulations."""

    measured: float  # Of the recording
    # 2.5 %, 50 % and 97.5 % of the simulations.
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
    """Power, V^2, between two frequencies, Hz."""

    low_hz: float
    high_hz: float
    power: Band


@dataclass(frozen=True, eq=False)
class Traces:
    """What a page draws: the part compared, and simulations of it."""

    # The recording, s, V, 0..1 (NaN: not recorded).
    t: FloatArray
    voltage: FloatArray
    throttle: FloatArray
    simulated: FloatArray  # One simulation, V
    # Stamps, s, and 95 % of the simulations there, V.
    at: FloatArray
    low: FloatArray
    high: FloatArray
    # Seconds about a rise of throttle, and the mean answer to it, V.
    after: FloatArray
    answer: FloatArray
    answer_low: FloatArray
    answer_high: FloatArray
    # Voltages, V, and the share of the samples below.
    edges: FloatArray
    distribution: FloatArray
    simulated_distribution: FloatArray


@dataclass(frozen=True, eq=False)
class Agreement:
    """A recording beside its simulations."""

    recording: str  # Its name
    # Parts, s after the first sample; (0, 0) where nothing was fitted.
    fitted: tuple[float, float]
    simulated: tuple[float, float]
    model: tuple[str, ...]  # Names of the terms
    # Of the mean path: share of the variance explained, V, V.
    explained: float
    rmse: float
    bias: float
    bias_by_third: tuple[float, float, float]  # V
    # Least and mean voltage, V.
    lowest: Band
    mean: Band
    levels: tuple[float, ...]  # Levels, V
    falls: tuple[Band, ...]  # Dips below each per minute, as runs
    spectrum: tuple[SpectrumBand, ...]  # By band of frequency
    # Deepest point of the mean answer to rises of throttle, and its value 1 s after, V.
    dip: Band | None
    recovery: Band | None
    rises: int  # Rises of throttle
    ks_distance: float  # Largest difference of the two distributions
    seeds: int  # Simulations
    p_value: float  # Share of the simulations that are as odd among the others
    verdict: Likeness  # The verdict
    words: str  # What the simulation gets wrong most, as a part of a sentence
    farthest: str  # Kind of that difference: lowest, falls, level, answer, spectrum, ks or path
    notes: tuple[str, ...]  # What was left out or assumed
    traces: Traces  # For a page

    @property
    def worst(self) -> str:
        """Return the sentence that says what the simulation gets wrong most."""
        begin = 'Most wrong' if self.verdict is Likeness.DIFFERS else 'Farthest, but within chance'
        return f'{begin}: in the simulation, {self.words}.'

    def measures(self) -> list[dict[str, Any]]:
        """Return every number of the recording beside those of the simulations."""
        answer = [('dip after rises, V', self.dip), ('1 s after rises, V', self.recovery)]
        bands = [('lowest voltage, V', self.lowest), ('mean voltage, V', self.mean),
                 *((f'falls through {level:.4g} V, 1/min', falls)
                   for level, falls in zip(self.levels, self.falls)),
                 *((name, one) for name, one in answer if one is not None),
                 *((f'power {one.low_hz:.3g} to {one.high_hz:.3g} Hz, V^2', one.power)
                   for one in self.spectrum)]
        return [{'measure': name, **one.as_data(), 'inside': one.inside} for name, one in bands]

    def as_data(self) -> dict[str, Any]:
        """Return what `--json` writes."""
        return {
            'recording': self.recording, 'fitted_s': list(self.fitted),
            'simulated_s': list(self.simulated), 'model': list(self.model),
            'mean_path': {'variance_explained': self.explained, 'rmse_v': self.rmse,
                          'bias_v': self.bias, 'bias_by_third_v': list(self.bias_by_third)},
            'lowest_v': self.lowest.as_data(),
            'crossings_per_min': [{'level_v': level, **falls.as_data()}
                                  for level, falls in zip(self.levels, self.falls)],
            'spectrum': [{'from_hz': one.low_hz, 'to_hz': one.high_hz,
                          'simulated_over_measured': _ratio(one.power)}
                         for one in self.spectrum],
            'ks_distance': self.ks_distance, 'worst': self.worst,
            'verdict': self.verdict.name.lower()}


def _ratio(power: Band) -> float:
    return power.median / power.measured if power.measured > 0.0 else float('nan')
