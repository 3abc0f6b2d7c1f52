"""
One round of the search: which kinds are tried, and what each is worth.

A kind is tried where a statistic asks for it.  Evidence is the gain in
log-likelihood on the part fitted, less its price, plus that on the part kept.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from ou_monitor.criticism.battery import is_sign, statistics
from ou_monitor.criticism.composite import Composite, scene_of, view_of
from ou_monitor.criticism.null_bank import NullBank
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import best_start, fitted, sag_with_lag
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role, Term

# A statistic this far off asks for the terms that it is a sign of.
ASK = 2.6
# The same for terms that take seconds to fit.
ASK_DEAR = 3.2
# Evidence from which a cause that leaves nothing off (so far) spares trials of
# other families.
CLEAR, _LEFT = 30.0, 4.5
# What a fit to some thousand samples may lack of that to all, nats.
ROUGH = 20.0
# What filters may cost before no further dear kind is tried, s, about.
MOST_WORK = 10.0
# Turns: measured inputs, laws where there are clear outliers, the rest.
TIERS = 3
_SHAPE = ('kurtosis', 'tails')
_CLEAR_SHAPE = 25.0
# Correlation of small neighbours, as a score, from which on it is white noise.
_WHITE = -8.0


@dataclass(frozen=True, eq=False)
class Trial:
    """
    A candidate, fitted beside what was accepted before.

    `left` are the statistics of the model with it, where its evidence is clear; `beside` is
    the name of what comes with it, if anything.
    """

    name: str
    composite: Composite
    evidence: float
    left: dict[str, float] | None = None
    beside: str = ''


def criticise(samples: Samples, composite: Composite, bank: NullBank) -> dict[str, float]:
    """Return the statistics of a model, as they would be N(0, 1) if it were right."""
    return bank.standardised(statistics(composite.z, scene_of(samples, composite)))


def trials_of(samples: Samples, composite: Composite, values: dict[str, float],
              given: Sequence[str], tier: int, bank: NullBank, only: str = '') -> list[Trial]:
    """Return the candidates that something asks for, fitted, the dear ones last."""
    view = view_of(samples, composite.gaussian, composite.z, samples.train)
    before = composite.score(samples)
    found: list[Trial] = []
    for kind in kinds_to_try(composite, values, given, tier, samples.throttle is not None):
        if any(_settled(trial, kind) for trial in found) or (only and kind.NAME != only):
            continue
        if kind.DEAR and samples.work[0] > MOST_WORK:
            continue
        best = best_start(samples, composite, kind, view)
        if best is not None:
            trial = Trial(kind.NAME, best, best.score(samples) - before)
            if trial.evidence > CLEAR:
                trial = replace(trial, left=criticise(samples, best, bank))
            found.append(trial)
    if not composite.has('load_sag') and {'load_sag', 'load_transient'} <= {
            trial.name for trial in found}:
        both = sag_with_lag(samples, composite, view)
        if both is not None:
            found.append(Trial('load_transient', both, both.score(samples) - before,
                               beside='load_sag'))
    return found


def refined(samples: Samples, composite: Composite, trials: list[Trial]) -> list[Trial]:
    """Return trials, the best first, those near it fitted to all samples."""
    top = max(trial.evidence for trial in trials)
    before = composite.score(samples)
    made = []
    for trial in trials:
        if trial.evidence > top - ROUGH and catalogue()[trial.name].ROLE is not Role.LAW:
            start = trial.composite
            full = fitted(samples, start.terms, start)
            if full is not None and full.score(samples) - before > trial.evidence:
                trial = replace(trial, composite=full, evidence=full.score(samples) - before)
        made.append(trial)
    return sorted(made, key=lambda trial: -trial.evidence)


def kinds_to_try(composite: Composite, values: dict[str, float], given: Sequence[str],
                 tier: int, throttle: bool) -> list[type[Term]]:
    """Return the kinds to try: those of a tier that something asks for."""
    found = []
    for name, kind in catalogue().items():
        if name in ('ou', *given) or kind.ROLE is Role.EXACT or not kind.SIGNS:
            continue
        if tier_of(kind, values) != tier or (kind.NEEDS_THROTTLE and not throttle):
            continue
        if composite.has(name) and not kind.RECURS:
            continue
        if any(imitate(kind, type(term)) for term in composite.terms):
            continue
        # What is cheap and linear in what was measured is looked at wherever something
        # was found and something is left.
        if asks(kind, values) or (len(composite.terms) > 1 and kind.MEASURED
                                  and kind.ROLE is Role.MEAN and anything(values)):
            found.append(kind)
    # The one that is asked for most may spare the others.
    return sorted(found, key=lambda kind: (kind.DEAR, -asks(kind, values)))


def asks(kind: type[Term], values: dict[str, float]) -> float:
    """Return how far off the statistic is that asks most for a kind; 0 where none does."""
    limit = ASK_DEAR if kind.DEAR else ASK
    return max((abs(value) for name, value in values.items() for sign in kind.SIGNS
                if abs(value) > limit and is_sign(sign, name, value)), default=0.0)


def anything(values: dict[str, float]) -> bool:
    """Return whether any statistic is clearly off."""
    return max(map(abs, values.values())) > _LEFT


def _settled(trial: Trial, kind: type[Term]) -> bool:
    """Return whether a trial leaves nothing that a dear kind of another family could explain."""
    return (kind.DEAR and trial.left is not None and not asks(kind, trial.left)
            and not anything(trial.left)
            and catalogue()[trial.name].FAMILY != kind.FAMILY
            and not imitate(kind, catalogue()[trial.name]))


def tier_of(kind: type[Term], values: dict[str, float]) -> int:
    """Return when a kind has its turn: measured inputs, clear outliers, the rest."""
    if kind.MEASURED or any(
            values.get(name, 0.0) > clear for name, clear in kind.CLEAR_ABOVE.items()):
        return 0
    shape = max((abs(value) for name, value in values.items()
                 if name.startswith(_SHAPE)), default=0.0)
    # No Gaussian term makes outliers: where there are many, laws come before.
    outliers = shape > _CLEAR_SHAPE
    if kind.ROLE is Role.NOISE:
        # White noise is in every sensor, and hides what is slow and weak; but bad samples
        # look like some, if not among small errors.
        return int(outliers and values.get('small errors lag 1', 0.0) > _WHITE)
    return 1 if kind.ROLE is Role.LAW and outliers else 2


def imitate(one: type[Term], other: type[Term]) -> bool:
    """Return whether two kinds imitate each other."""
    return other.NAME in one.IMITATES or one.NAME in other.IMITATES
