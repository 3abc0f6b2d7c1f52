"""Result of `discover`: frozen records, and the same as plain data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
import enum
import math
from typing import Any

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN, plain_data
from ou_monitor.text import number, Z95


class Verdict(enum.Enum):
    """Verdict on a recording."""

    NO_EFFECT = 'no_effect'
    EXPLAINED = 'explained'
    PARTLY_EXPLAINED = 'partly_explained'
    UNEXPLAINED = 'unexplained'
    INSUFFICIENT_DATA = 'insufficient_data'


@dataclass(frozen=True)
class Criticism:
    """One statistic of the data, compared with simulations."""

    statistic: str  # Name
    # Normal score of the data under the plain and under the extended model.
    before: float
    after: float
    # Band over all statistics: one recording of a correct model in a hundred leaves it.
    low: float
    high: float
    # Probability that any statistic of a correct model is as far off.
    p_before: float
    p_after: float

    @property
    def was_off(self) -> bool:
        """Whether the plain model leaves it outside the band."""
        return not self.low <= self.before <= self.high

    @property
    def is_off(self) -> bool:
        """Whether the extended model leaves it outside the band."""
        return not self.low <= self.after <= self.high


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause that was named."""

    term: Term  # With its parameters
    se: Mapping[str, Any]  # Standard errors, in the units of the parameters; NaN where not known
    # Loss of held-out score without it, nats per sample.
    gain: float
    gain_se: float
    p_value: float  # See `gain.cause_gain`; 0 for exact findings
    alternatives: tuple[str, ...]  # Causes that this recording cannot separate from it
    explanation: str  # In words
    exact: bool  # Found without a model

    @property
    def name(self) -> str:
        """Return the name of the cause."""
        return self.term.NAME

    @property
    def measurable(self) -> bool:
        """Whether the gain is distinguishable from zero."""
        return self.gain > Z95 * self.gain_se


@dataclass(frozen=True)
class CrossingRate:
    """How often the voltage falls through a level, on the held-out part."""

    level: float = NAN  # V
    # Crossings per minute in the data and on average in simulations.
    observed: float = NAN
    baseline: float = NAN
    extended: float = NAN
    # Standard errors: of the count, for independent crossings, and of the averages.
    observed_se: float = NAN
    baseline_se: float = NAN
    extended_se: float = NAN

    @property
    def worse(self) -> bool:
        """Whether the extended model is significantly wrong, and more so than the plain OU."""
        off = abs(self.extended - self.observed)
        return (off > Z95 * math.hypot(self.extended_se, self.observed_se)
                and off > abs(self.baseline - self.observed))


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of `discover`."""

    recording: str  # Name
    n: int  # Samples of the recording
    duration: float  # s
    verdict: Verdict
    sentence: str  # The verdict in a sentence
    baseline: OU | None = None  # The plain model, fitted on everything
    # Mean log predictive density of held-out blocks, nats per sample.
    baseline_score: float = NAN
    criticism: tuple[Criticism, ...] = ()  # All statistics
    causes: tuple[Cause, ...] = ()  # As accepted
    model: SupplyModel | None = None  # The extended model, fitted on everything
    se: tuple[Mapping[str, Any], ...] = ()  # Its standard errors, one dict per term
    # Score of the extended model, its gain, and the gain's standard error, nats per sample.
    score: float = NAN
    gain: float = NAN
    gain_se: float = NAN
    # Relative reduction of the rms of one-step errors on held-out blocks, against the plain OU.
    shrink: float = NAN
    larger: bool = False  # Whether these errors are significantly larger than the plain OU's
    crossing: CrossingRate = field(default_factory=CrossingRate)  # Falls through a low level
    throttle_effects: ThrottleEffects = field(default_factory=lambda: ThrottleEffects())
    notes: tuple[str, ...] = ()  # What was dropped, left out or cannot be decided
    samples: Samples | None = None  # Samples that were fitted
    # The extended model of `samples`; it lacks effects removed from them, such as repeats.
    simulated: SupplyModel | None = None
    refused: str = ''  # Why the extended model is refused, in words; otherwise empty
    full: float = NAN  # Current that is a load of 1, A; NaN if the load is throttle
    seed: int = 0  # Random seed

    @property
    def load(self) -> str:
        """Return the load: 'throttle', or 'current' if that predicts the voltage better."""
        return 'current' if math.isfinite(self.full) else 'throttle'

    @property
    def size_gain(self) -> float:
        """Return the gain from a better predicted size of the errors, nats."""
        return self.gain + math.log1p(-self.shrink) if self.shrink < 1.0 else NAN

    @property
    def unsaved(self) -> str:
        """Return why a model file cannot hold the extended model; empty if it can."""
        if self.model is None:
            return f"'{self.recording}' was not fitted. {self.sentence}"
        return '' if self.load == 'throttle' else (
            'Its load is the measured current, and a model file is for throttle (--current-column '
            'none uses throttle as the load)')

    @property
    def closer(self) -> bool:
        """Whether errors and falls of the extended model are no worse than the plain OU's."""
        return bool(self.causes) and not self.larger and not self.crossing.worse

    @property
    def discrepancies(self) -> tuple[Criticism, ...]:
        """Return the statistics outside the band under the plain model, worst first."""
        return tuple(sorted((c for c in self.criticism if c.was_off),
                            key=lambda c: -abs(c.before)))

    @property
    def remaining(self) -> tuple[Criticism, ...]:
        """Return the statistics outside the band under the extended model, worst first."""
        return tuple(sorted((c for c in self.criticism if c.is_off), key=lambda c: -abs(c.after)))

    def as_data(self) -> dict[str, Any]:
        """Return the finding for JSON (doc/discovery.md); beside `params` lie `se` and `units`."""
        baseline = self.baseline
        found: dict[str, Any] = plain_data({
            'recording': self.recording, 'load': self.load, 'full_load_a': self.full,
            'n': self.n,
            'duration_s': self.duration,
            'verdict': self.verdict.value, 'sentence': self.sentence,
            'baseline': {
                'params': dict.fromkeys(('alpha', 'sigma', 'u0')) if baseline is None
                else baseline.values(),
                'units': _units(OU), 'heldout_score': self.baseline_score},
            'discrepancies': [_discrepancy(c, c.before, c.p_before) for c in self.discrepancies],
            'causes': [{
                'name': cause.name, 'family': cause.term.FAMILY, 'gain': cause.gain,
                'gain_se': cause.gain_se, 'p_value': cause.p_value, 'exact': cause.exact,
                'params': cause.term.values(), 'se': dict(cause.se),
                'units': _units(type(cause.term)), 'alternatives': list(cause.alternatives),
                'explanation': cause.explanation} for cause in self.causes],
            'extended': {
                **self._extended(), 'heldout_score': self.score, 'gain': self.gain,
                'gain_se': self.gain_se, 'errors_shrink': self.shrink,
                'size_gain': self.size_gain, 'closer': self.closer,
                'crossing_rate': {
                    'observed': self.crossing.observed, 'baseline': self.crossing.baseline,
                    'extended': self.crossing.extended, 'level_v': self.crossing.level,
                    'observed_se': self.crossing.observed_se,
                    'baseline_se': self.crossing.baseline_se,
                    'extended_se': self.crossing.extended_se, 'unit': '1/min'}},
            'remaining': [_discrepancy(c, c.after, c.p_after) for c in self.remaining],
            'throttle_effects': self.throttle_effects.as_data(),
            'refused': self.unsaved or self.refused or None, 'notes': list(self.notes)})
        return found

    def _extended(self) -> dict[str, Any]:
        """Return parameters, errors and units by term; the second of a kind is ``tone 2``."""
        found: dict[str, dict[str, Any]] = {'params': {}, 'se': {}, 'units': {}}
        terms = () if self.model is None else self.model.terms
        for k, term in enumerate(terms):
            nth = sum(other.NAME == term.NAME for other in terms[:k]) + 1
            name = term.NAME if nth == 1 else f'{term.NAME} {nth}'
            found['params'][name] = term.values()
            found['se'][name] = dict(self.se[k]) if k < len(self.se) else {}
            found['units'][name] = _units(type(term))
        return found


def _units(kind: type[Term]) -> dict[str, str]:
    return {name: kind.unit(name) for name in kind.parameters()}


def _discrepancy(c: Criticism, observed: float, chance: float) -> dict[str, Any]:
    return {'statistic': c.statistic, 'observed': observed, 'simulated_low': c.low,
            'simulated_high': c.high, 'p_value': chance}


# Quantiles of the load between which a fall is measured.
_FLOWN = (0.01, 0.99)
# Minimum time between two dips, s, and range in which the predicted minimum of a dip is sought, s.
_APART, _NEAR = 0.2, 0.05
# Relative error of a fall under load above which the model does not reproduce it.
_WRONG = 0.5
# Share of a dip's depth above which throttle has caused it.
_MADE = 0.5


@dataclass(frozen=True)
class ThrottleEffects:
    """Effects of the load: the fall of the voltage from low to high load, and the dips."""

    # Low and high load.
    low: float = NAN
    high: float = NAN
    # Fall of the median from readings at the low load to those at the high, V: as measured, of the
    # mean of the model, and standard error of their difference.
    measured: float = NAN
    explained: float = NAN
    error: float = NAN
    full: float = NAN  # Current that is a load of 1, A; NaN if the load is throttle
    level: float = NAN  # Voltage, V, below which dips are counted
    # Number of dips, and of dips of which the load caused more than half.
    dips: int = 0
    made: int = 0

    def as_data(self) -> dict[str, Any]:
        """Return the fields for JSON."""
        return {
            'fall': {'from': self.low, 'to': self.high, 'measured_v': self.measured,
                     'explained_v': self.explained},
            'dips': {'level_v': self.level, 'count': self.dips, 'made_by_throttle': self.made}}

    @property
    def fits(self) -> bool:
        """Whether the model explains most of the measured fall, and not much more."""
        off = abs(self.explained - self.measured)
        return not (off > _WRONG * abs(self.measured) and off > Z95 * self.error)

    @property
    def words(self) -> str:
        """Return the effects in words; empty if the load has none."""
        if math.isnan(self.measured):
            return ''
        load, unit = ('current', ' A') if math.isfinite(self.full) else ('throttle', '')
        low, high = (number(self.full * end if unit else end, 2) + unit
                     for end in (self.low, self.high))
        found = (f'The median voltage falls by {number(self.measured, 2)} V from {load} {low} to '
                 f'{high}, {number(self.explained, 2)} V by the model'
                 + ('.' if self.fits else ': trust the readings.'))
        if self.dips:
            made = (f'caused {self.made} of the {self.dips} dips' if self.dips > 1 else
                    f'{"caused" if self.made else "did not cause"} the only dip')
            found += (f' {"The current" if unit else "Throttle"} {made} below '
                      f'{number(self.level, 4)} V.')
        return found


def throttle_effects(samples: Samples, terms: Sequence[Term], level: float, full: float = NAN
                     ) -> ThrottleEffects:
    """Compare the fall under load with the model's; count dips below a level, V (full in A)."""
    responses = [term for term in terms if term.ROLE is Role.MEAN and term.MEASURED]
    u, v = samples.throttle, samples.logged
    if u is None or not any(term.NEEDS_THROTTLE for term in responses):
        return ThrottleEffects()
    low, high = np.quantile(u, _FLOWN).tolist()
    mean, ends = _path(samples, responses), (u <= low, u >= high)
    measured, explained = (float(np.median(y[ends[0]]) - np.median(y[ends[1]]))
                           for y in (v, mean))
    # Readings of one stay at a load are not independent.
    stays = [1 + int((end[1:] & ~end[:-1])[1:].sum()) for end in ends]
    error = float(np.std(v - mean)) * math.sqrt(sum(1.0 / count for count in stays))
    return ThrottleEffects(low, high, measured, explained, error, full, level,
                           *_dips(samples, mean, level))


def _path(samples: Samples, responses: Sequence[Term]) -> FloatArray:
    """Return the effect of throttle and time on the mean, V."""
    s = samples.segment(1.0, 0.0)
    path = np.zeros(samples.n)
    for term in responses:
        path += term.columns(s) @ np.array(term.linear_values())
    return path


def _dips(samples: Samples, path: FloatArray, level: float) -> tuple[int, int]:
    """Return the number of dips below a level, V, and of dips caused by the path."""
    v, t = samples.logged, samples.t
    below = np.flatnonzero(v < level)
    if not below.size:
        return 0, 0
    depth, made = float(np.median(v)), 0
    usual = float(np.median(path))
    groups = np.split(below, np.flatnonzero(np.diff(t[below]) > _APART) + 1)
    for group in groups:
        bottom = int(group[int(np.argmin(v[group]))])
        first, last = np.searchsorted(t, [t[bottom] - _NEAR, t[bottom] + _NEAR])
        lowest = float(path[first:last + 1].min())
        made += usual - lowest > _MADE * (depth - float(v[bottom]))
    return len(groups), made
