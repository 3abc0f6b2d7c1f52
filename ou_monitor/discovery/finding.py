"""What a discovery found: frozen records, and the same as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
import enum
from functools import cached_property
import math
from typing import Any

from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.felt import Felt, felt
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Term
from ou_monitor.records import NAN
from ou_monitor.text import Z95


class Verdict(enum.Enum):
    """What became of a recording."""

    NO_EFFECT = 'no_effect'
    EXPLAINED = 'explained'
    PARTLY_EXPLAINED = 'partly_explained'
    UNEXPLAINED = 'unexplained'
    INSUFFICIENT_DATA = 'insufficient_data'


@dataclass(frozen=True)
class Criticism:
    """One statistic of the data, and where simulations put it."""

    statistic: str  # Name
    # Normal score of the data under the plain and under the extended model.
    before: float
    after: float
    # Band that simulations of the right model leave once in a hundred recordings, all statistics
    # taken together.
    low: float
    high: float
    # Chance that any statistic of a right model is as far off.
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
    # What is lost of the held-out score without it, nats per sample.
    gain: float
    gain_se: float
    p_value: float  # See `gain.cause_gain`; 0 for exact findings, which have no chance at all
    alternatives: tuple[str, ...]  # Causes that this recording cannot separate from it
    explanation: str  # For people
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
    """How often the voltage falls through a level, on the part kept."""

    level: float = NAN  # V
    # Crossings per minute in the data and on average in simulations.
    observed: float = NAN
    baseline: float = NAN
    extended: float = NAN
    # Standard errors: of the count, as if crossings were independent, and of the averages.
    observed_se: float = NAN
    baseline_se: float = NAN
    extended_se: float = NAN

    @property
    def worse(self) -> bool:
        """Whether the extended model is wrong by its errors, and more so than the plain OU."""
        off = abs(self.extended - self.observed)
        return (off > Z95 * math.hypot(self.extended_se, self.observed_se)
                and off > abs(self.baseline - self.observed))


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of `discover`."""

    recording: str  # Name
    n: int  # Samples of the recording
    duration: float  # s
    verdict: Verdict  # What became of it
    sentence: str  # The same in a sentence
    baseline: OU | None = None  # The plain model, fitted on everything
    # Mean log predictive density of blocks kept back in turn, nats per sample.
    baseline_score: float = NAN
    criticism: tuple[Criticism, ...] = ()  # All statistics
    causes: tuple[Cause, ...] = ()  # As accepted
    model: SupplyModel | None = None  # The extended model, fitted on everything
    se: tuple[Mapping[str, Any], ...] = ()  # Its standard errors, a dict a term
    # Of the extended model on blocks kept back in turn, nats per sample.
    score: float = NAN
    gain: float = NAN
    gain_se: float = NAN
    # Share by which the rms of its one-step errors on those blocks is smaller than that of the
    # plain OU.
    shrink: float = NAN
    larger: bool = False  # Whether they are larger than those of the plain OU, by their error
    crossing: CrossingRate = field(default_factory=CrossingRate)  # What a pilot feels
    notes: tuple[str, ...] = ()  # What was dropped, left out or cannot be decided
    samples: Samples | None = None  # What was fitted
    # The extended model as it makes `samples`: without what was undone in them, such as repeats.
    simulated: SupplyModel | None = None
    # Why the extended model has not earned its place, in words; empty where it has.
    refused: str = ''
    # What is called throttle: 'throttle', or 'current' where the measured current is the load.
    load: str = 'throttle'
    seed: int = 0  # Of all randomness

    @property
    def size_gain(self) -> float:
        """Return what of the gain is not in smaller errors: their size is better known, nats."""
        return self.gain + math.log1p(-self.shrink) if self.shrink < 1.0 else NAN

    @property
    def closer(self) -> bool:
        """Whether the extended model is nowhere worse than the plain OU: errors and falls."""
        return bool(self.causes) and not self.larger and not self.crossing.worse

    @property
    def discrepancies(self) -> tuple[Criticism, ...]:
        """Return what the plain model gets wrong, worst first."""
        return tuple(sorted((c for c in self.criticism if c.was_off),
                            key=lambda c: -abs(c.before)))

    @property
    def remaining(self) -> tuple[Criticism, ...]:
        """Return what the extended model gets wrong, worst first."""
        return tuple(sorted((c for c in self.criticism if c.is_off), key=lambda c: -abs(c.after)))

    @cached_property
    def felt(self) -> Felt:
        """Return what the extended model says in units that a pilot feels."""
        if self.samples is None or self.simulated is None:
            return Felt()
        return felt(self.samples, self.simulated.terms, self.crossing.level)

    def as_data(self) -> dict[str, Any]:
        """
        Return the finding as JSON holds it.

        Returns
        -------
        dict
            As CONTRACT section 5, and beside it `sentence`, `remaining`,
            `felt`, `notes`, and `se` and `units` beside all `params`.

        """
        baseline = self.baseline
        found: dict[str, Any] = _plain({
            'recording': self.recording, 'load': self.load, 'n': self.n,
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
            'felt': self.felt.as_data(), 'refused': self.refused or None,
            'notes': list(self.notes)})
        return found

    def _extended(self) -> dict[str, Any]:
        """Return parameters, errors and units by term; a second one of a kind gets a number."""
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


def _plain(value: Any) -> Any:
    """Return numbers that are not finite as None, and sequences as lists, all the way down."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
