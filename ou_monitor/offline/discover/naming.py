"""
Which causes a recording shows: candidates are fitted, scored, and criticised again.

Evidence is the gain in log-likelihood on the part fitted, less its price, plus
that on the part kept.  Measured inputs come before anything latent; a cause
stays only while it is needed beside the others; causes that do as well are
told with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math

import numpy as np

from ou_monitor.model.supply import SEVERAL
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role, Term, View
from ou_monitor.offline.discover.battery import statistics
from ou_monitor.offline.discover.composite import Composite, fit_composite, scene_of, view_of
from ou_monitor.offline.discover.data import Samples
from ou_monitor.offline.discover.null_bank import NullBank
from ou_monitor.offline.discover.structure import evaluate
from ou_monitor.records import FloatArray

# Evidence from which a cause is accepted, nats.
ACCEPT = 6.0
# Causes within this of the best cannot be told from it here, nats.
TIE = 3.0
# A statistic this far off asks for the terms that it is a sign of.
ASK = 2.6
# The same for terms that take seconds to fit.
ASK_DEAR = 3.2
# Causes accepted at most, and of these what no input was measured for.
MOST, MOST_LATENT = 8, 3
# Starting points that are fitted in full, and samples that tell which.
_FULL, _GLANCE = 2, 8000


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate, fitted beside what was accepted before."""

    name: str
    composite: Composite
    evidence: float


@dataclass(eq=False)
class Search:
    """
    What the search has come to.

    Attributes
    ----------
    composite : Composite
        The model so far.
    accepted : list of str
        Causes in the order of their acceptance.
    rivals : dict of str to list of str
        For each cause, those that did as well in its round.
    log : list of str
        What was tried and what came of it, one line each.

    """

    composite: Composite
    accepted: list[str] = field(default_factory=list)
    rivals: dict[str, list[str]] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)


def criticise(samples: Samples, composite: Composite, bank: NullBank) -> dict[str, float]:
    """Return the statistics of a model, as they would be N(0, 1) if it were right."""
    return bank.standardised(statistics(composite.z, scene_of(samples, composite)))


def name_causes(samples: Samples, baseline: Composite, bank: NullBank, *,
                given: Sequence[str] = (), progress: Callable[[float], None] | None = None
                ) -> Search:
    """
    Accept causes one after the other, the best first.

    Parameters
    ----------
    samples : Samples
        Clean samples.
    baseline : Composite
        The model to begin with: the `ou`, and what is known without a model.
    bank : NullBank
        How statistics spread when nothing is wrong.
    given : sequence of str
        Causes known without a model; not tried.
    progress : callable, optional
        Called with the share done.

    Returns
    -------
    Search
        The model and its causes.

    """
    search = Search(_fitted(samples, baseline.terms, baseline) or baseline)
    for turn in range(MOST):
        if progress is not None:
            progress(turn / MOST)
        values = criticise(samples, search.composite, bank)
        trials, good = [], []
        latent = sum(_tier(catalogue()[name], values) > 0 for name in search.accepted)
        for tier in range(_TIERS if latent < MOST_LATENT else 1):
            # Measured inputs first: what is latent can imitate them, and costs more.
            trials += _trials(samples, search, values, given, tier)
            good = [trial for trial in trials if trial.evidence > ACCEPT]
            if good:
                break
        if not good:
            break
        trials.sort(key=lambda trial: -trial.evidence)
        best = trials[0]
        search.rivals[best.name] = [
            trial.name for trial in trials
            if trial.name != best.name and trial.evidence > best.evidence - TIE]
        search.log.append(f'{best.name}: {best.evidence:.1f} nats; '
                          + ', '.join(f'{t.name} {t.evidence:.1f}' for t in trials[:6]
                                      if t is not best))
        search.composite = best.composite
        search.accepted.append(best.name)
        _prune(samples, search)
        if _tier(catalogue()[best.name], values) > 0 and not _helped(
                values, criticise(samples, search.composite, bank)):
            # What is wrong here is not in the catalogue: more terms would only dress it up.
            search.log.append(f'{best.name} leaves most of what is wrong: no further causes')
            break
    return search


def _trials(samples: Samples, search: Search, values: dict[str, float], given: Sequence[str],
            tier: int) -> list[Trial]:
    """Return the candidates that something asks for, fitted."""
    asked = {dear: [name for name, value in values.items() if abs(value) > limit]
             for dear, limit in ((False, ASK), (True, ASK_DEAR))}
    composite = search.composite
    view = view_of(samples, composite.gaussian, composite.z, samples.train)
    before = composite.score(samples)
    found = []
    for name, kind in catalogue().items():
        if name in ('ou', *given) or kind.ROLE is Role.EXACT or not kind.SIGNS:
            continue
        if _tier(kind, values) != tier:
            continue
        if composite.has(name) and name not in SEVERAL:
            continue
        if kind.NEEDS_THROTTLE and samples.throttle is None:
            continue
        if not any(word.startswith(sign) for word in asked[kind.ROLE is Role.BLOCK]
                   for sign in kind.SIGNS):
            continue
        best = _best_start(samples, composite, kind, view)
        if best is not None:
            found.append(Trial(name, best, best.score(samples) - before))
    return found


def _best_start(samples: Samples, composite: Composite, kind: type[Term], view: View
                ) -> Composite | None:
    """Return the best fit with one more term of a kind."""
    terms = composite.terms
    if kind.ROLE is Role.LAW:
        return _fitted(samples, [*terms, _blank(kind)], None)
    starts = list(kind.candidates(view))
    if kind.ROLE is Role.MEAN and len(starts) > _FULL:
        starts = _screened(samples, starts, view)
    if kind.ROLE is Role.BLOCK and len(starts) > 1:
        starts = _likely(samples, composite, starts)
    best: Composite | None = None
    for start in starts[:_FULL]:
        structural = [term for term in terms if term.ROLE is not Role.LAW]
        laws = [term for term in terms if term.ROLE is Role.LAW]
        structural[0] = start.beside(structural[0])
        made = _fitted(samples, [*structural, start, *laws], composite)
        if made is not None and (best is None or made.score(samples) > best.score(samples)):
            best = made
    return best


def _fitted(samples: Samples, terms: Sequence[Term], known: Composite | None
            ) -> Composite | None:
    """Return a fit to the first part, its mean to everything; None where it cannot be fitted."""
    try:
        return fit_composite(samples, terms, samples.train, known, whole_mean=True)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        # Parameters have left what a term allows, or numbers can hold.
        return None


def _likely(samples: Samples, composite: Composite, starts: list[Term]) -> list[Term]:
    """Return starts in the order of their likelihood as they are, on a part."""
    part = slice(0, min(samples.train.stop, _GLANCE))
    few = Samples(samples.t[part], samples.voltage[part],
                  None if samples.throttle is None else samples.throttle[part])
    structural = [term for term in composite.terms if term.ROLE is not Role.LAW]

    def value(start: Term) -> float:
        terms = [start.beside(structural[0]), *structural[1:], start]
        return float(evaluate(few, terms).density.sum())

    return sorted(starts, key=lambda start: -value(start))


def _blank(kind: type[Term]) -> Term:
    """Return a stand-in that only tells its law."""
    return object.__new__(kind)


def _screened(samples: Samples, starts: list[Term], view: View) -> list[Term]:
    """Return starts in the order of how much of the scores their columns explain."""
    s = samples.stretch(1.0, 0.0)
    scale = np.sqrt(view.variance)

    def explained(term: Term) -> float:
        columns = term.columns(s)
        through = columns.copy()
        through[1:] -= view.phi[1:, None] * columns[:-1]
        through = (through / scale[:, None])[view.train]
        through = through - through.mean(axis=0)
        z = view.z[view.train]
        beta = np.linalg.lstsq(through, z, rcond=1e-10)[0]
        rest: FloatArray = z - through @ beta
        return float(z @ z - rest @ rest)

    return sorted(starts, key=lambda term: -explained(term))


_TIERS = 3
# Share of the misfit that a latent cause must take away for the search to go on,
# and misfit (squares of statistics that are off) that is too little to ask so.
_SHARE, _LITTLE = 0.5, 100.0


def _helped(before: dict[str, float], after: dict[str, float]) -> bool:
    """Return whether statistics that are off have come nearer."""
    def misfit(values: dict[str, float]) -> float:
        return sum(value**2 for value in values.values() if abs(value) > 4.0)

    left = misfit(after)
    return left < _LITTLE or left < (1.0 - _SHARE) * misfit(before)


def _tier(kind: type[Term], values: dict[str, float]) -> int:
    """Return when a kind has its turn: measured inputs, clear outliers, the rest."""
    if kind.FAMILY != 'line' and (kind.NEEDS_THROTTLE or kind.NAME == 'drift'):
        return 0
    shape = max((abs(value) for name, value in values.items()
                 if name.startswith(_SHAPE)), default=0.0)
    # No Gaussian term makes outliers: where there are many, laws are tried alone.
    return 1 if kind.ROLE is Role.LAW and shape > _CLEAR_SHAPE else 2


_SHAPE = ('kurtosis', 'tails')
_CLEAR_SHAPE = 25.0


def _prune(samples: Samples, search: Search) -> None:
    """Take out causes that are not needed beside those accepted since."""
    full = search.composite.score(samples)
    for name in search.accepted[:-1]:
        index = next(k for k, term in enumerate(search.composite.terms) if term.NAME == name)
        kept = [term for k, term in enumerate(search.composite.terms) if k != index]
        same = search.composite if search.composite.terms[index].ROLE is not Role.LAW else None
        less = _fitted(samples, kept, same)
        if less is not None and full - less.score(samples) < TIE:
            search.log.append(f'{name} is not needed any more')
            search.composite = less
            search.accepted.remove(name)
            full = less.score(samples)


def worst(values: dict[str, float]) -> tuple[str, float]:
    """Return the statistic that is furthest off."""
    name = max(values, key=lambda key: abs(values[key]))
    return name, values[name]


def nats_per_sample(a: FloatArray, b: FloatArray) -> float:
    """Return the mean difference of two log densities, nats."""
    return math.fsum(a - b) / a.size
