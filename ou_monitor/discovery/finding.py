"""Result of `discover`: frozen records, and the same as plain data."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
import enum
import math
from typing import Any

from ou_monitor.criticism.samples import Samples
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Term
from ou_monitor.records import NAN, plain_data
from ou_monitor.text import Z95


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
    # Band: in one of a hundred recordings of a correct model, some statistic leaves its band.
    low: float
    high: float
    # Probability that any statistic of a correct model is as far off.
    p_before: float
    p_after: float

    @property
    def was_off(self) -> bool:
        """Whether the statistic lies outside the band under the plain model."""
        return not self.low <= self.before <= self.high

    @property
    def is_off(self) -> bool:
        """Whether the statistic lies outside the band under the extended model."""
        return not self.low <= self.after <= self.high


@dataclass(frozen=True)
class Explanation:
    """What is said of a cause, or of several terms of one kind that share a gain."""

    meaning: str
    estimates: tuple[str, ...]  # Of each term
    more: tuple[str, ...]  # Sentences: how it was found, its gain, what it may be confused with
    remedy: str

    @property
    def text(self) -> str:
        """Return all sentences."""
        found = [f'{one}.' for one in self.estimates] if len(self.estimates) == 1 else [
            f'({k}) {one}.' for k, one in enumerate(self.estimates, 1)]
        return ' '.join(part for part in (
            self.meaning, f'Estimate{"s" * (len(found) > 1)}:', *found, *self.more, self.remedy)
            if part)


@dataclass(frozen=True, eq=False)
class Cause:
    """A cause that was named."""

    term: Term
    se: Mapping[str, Any]  # Errors, in the parameters' units; NaN: unknown, inf: undetermined
    # Loss of held-out score without the cause, nats per sample.
    gain: float
    gain_se: float
    p_value: float  # See `gain.cause_gain`; 0 for exact findings
    alternatives: tuple[str, ...]  # Causes that this recording cannot separate from it
    explanation: Explanation
    exact: bool  # Found without a model

    @property
    def name(self) -> str:
        """Return the name of the cause."""
        return self.term.NAME


@dataclass(frozen=True)
class LowDips:
    """Dips below a low level, in the samples and in simulations."""

    level: float = NAN  # V
    count: int = 0  # Dips in the samples
    made: int | None = None  # Dips that the lowest load would not cause; None: no load response
    # Dips per minute in the samples and on average in simulations.
    observed: float = NAN
    baseline: float = NAN
    extended: float = NAN
    # Standard errors: of `observed`, for independent dips, and of the averages.
    observed_se: float = NAN
    baseline_se: float = NAN
    extended_se: float = NAN

    @property
    def worse(self) -> bool:
        """Whether the extended model is significantly wrong, and more so than the plain OU."""
        off = abs(self.extended - self.observed)
        return (off > Z95 * math.hypot(self.extended_se, self.observed_se)
                and off > abs(self.baseline - self.observed))


# Relative error above which the model does not reproduce a fall under load.
_WRONG = 0.5


@dataclass(frozen=True)
class LoadFall:
    """Fall of the median voltage from readings at low load to those at high load."""

    # Low and high load.
    low: float = NAN
    high: float = NAN
    # Fall, V: as measured, of the mean of the model, and standard error of their difference.
    measured: float = NAN
    explained: float = NAN
    error: float = NAN

    @property
    def fits(self) -> bool:
        """Whether the model explains most of the measured fall, and not much more."""
        off = abs(self.explained - self.measured)
        return not (off > _WRONG * abs(self.measured) and off > Z95 * self.error)


@dataclass(frozen=True, eq=False)
class Finding:
    """Result of `discover`."""

    recording: str
    n: int  # Samples of the recording
    duration: float  # s
    verdict: Verdict
    words: tuple[str, ...] = ()  # The verdict, in sentences
    baseline: OU | None = None  # The plain model, fitted to everything
    # Mean log predictive density of held-out blocks, nats per sample.
    baseline_score: float = NAN
    criticism: tuple[Criticism, ...] = ()  # All statistics
    causes: tuple[Cause, ...] = ()  # In order of acceptance
    model: SupplyModel | None = None  # The extended model, fitted to everything
    se: tuple[Mapping[str, Any], ...] = ()  # Its standard errors, one dict per term
    # Score of the extended model, its gain, and the gain's standard error, nats per sample.
    score: float = NAN
    gain: float = NAN
    gain_se: float = NAN
    # Relative reduction of the rms of one-step errors on held-out blocks, against the plain OU.
    shrink: float = NAN
    larger: bool = False  # Whether these errors exceed the plain OU's by a standard error
    dips: LowDips = LowDips()
    fall: LoadFall = LoadFall()
    notes: tuple[str, ...] = ()  # What was dropped, left out or cannot be decided
    samples: Samples | None = None  # Samples that were fitted
    # The extended model of `samples`; it lacks effects removed from them, such as repeats.
    simulated: SupplyModel | None = None
    refused: str = ''  # Why the extended model is refused, in words; otherwise empty
    full: float = NAN  # Current at which the load is 1, A; NaN if current is not the load
    has_throttle: bool = True
    seed: int = 0

    @property
    def sentence(self) -> str:
        """Return the verdict in words."""
        return ' '.join(self.words)

    @property
    def load(self) -> str:
        """Return the load: 'throttle', 'current' if that predicts better, or 'none'."""
        return ('current' if math.isfinite(self.full) else
                'throttle' if self.has_throttle else 'none')

    @property
    def size_gain(self) -> float:
        """Return the gain from a better predicted size of the errors, nats."""
        return self.gain + math.log1p(-self.shrink) if self.shrink < 1.0 else NAN

    @property
    def unsaved(self) -> str:
        """Return why a model file cannot hold the extended model; empty if it can."""
        return '' if self.model is not None else (
            f"'{self.recording}' was not fitted. {self.sentence}")

    @property
    def closer(self) -> bool:
        """Whether errors and dips of the extended model are no worse than the plain OU's."""
        return bool(self.causes) and not self.larger and not self.dips.worse

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
        """Return the finding for JSON (doc/discovery.md), with `se` and `units` of `params`."""
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
                'units': _units(type(cause.term)), 'curves': {
                    name: {'at': at, 'factor': factor}
                    for name, (at, factor) in cause.term.factors().items()},
                'alternatives': list(cause.alternatives),
                'explanation': cause.explanation.text} for cause in self.causes],
            'extended': {
                **self._extended(), 'heldout_score': self.score, 'gain': self.gain,
                'gain_se': self.gain_se, 'errors_shrink': self.shrink,
                'size_gain': self.size_gain, 'closer': self.closer,
                'crossing_rate': {name: getattr(self.dips, name) for name in (
                    'observed', 'baseline', 'extended', 'observed_se', 'baseline_se',
                    'extended_se')}},
            'remaining': [_discrepancy(c, c.after, c.p_after) for c in self.remaining],
            'dips': {'level_v': self.dips.level, 'count': self.dips.count,
                     'made_by_load': self.dips.made},
            'fall': {'from': self.fall.low, 'to': self.fall.high,
                     'measured_v': self.fall.measured, 'explained_v': self.fall.explained},
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
