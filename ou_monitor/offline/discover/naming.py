"""
Which causes a recording shows: candidates are fitted, scored, and criticised again.

Evidence is the gain in log-likelihood on the part fitted, less its price, plus
that on the part kept.  Measured inputs come before anything latent; a cause
stays only while it is needed beside the others; causes that do as well are
told with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np

from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Role, Term, View
from ou_monitor.offline.discover.battery import is_sign, statistics
from ou_monitor.offline.discover.composite import Composite, fit_composite, scene_of, view_of
from ou_monitor.offline.discover.data import Samples
from ou_monitor.offline.discover.gain import mean_difference
from ou_monitor.offline.discover.null_bank import NullBank
from ou_monitor.offline.discover.structure import evaluate
from ou_monitor.records import FloatArray

# Evidence from which a cause is accepted, nats.
ACCEPT = 6.0
# Causes within this of the best cannot be told from it here, nats.
TIE = 3.0
# Evidence from which a measured cause stays when others have come, nats.
NEEDED = -2.0
# A statistic this far off asks for the terms that it is a sign of.
ASK = 2.6
# The same for terms that take seconds to fit.
ASK_DEAR = 3.2
# Evidence from which a cause that leaves nothing off (so far) spares trials of
# other families.
CLEAR, _LEFT = 30.0, 4.5
# Kinds of which there may be one more.
_AGAIN = frozenset({'tone', 'throttle_tone', 'resonance', 'second_relaxation', 'load_transient'})
# Kinds that imitate each other: one beside another would only mend its form.
_ALIKE = (frozenset({'volatility', 'regime_switching', 'heavy_tails', 'jumps'}),
          frozenset({'glitches', 'jumps', 'heavy_tails', 'clock_jitter'}),
          frozenset({'second_relaxation', 'flicker_noise', 'regime_switching'}))
# Gain in its standard errors from which it is not by chance of a few stretches.
_STEADY, _RAGGED = 2.3, 8.0
# Causes accepted at most, of these what no input was measured for, and lines that
# come with a tone.
MOST, MOST_LATENT, MOST_LINES = 8, 3, 12
# Starting points that are fitted in full, and samples that tell which.
_FULL, _GLANCE = 2, 8000
# What a fit to some thousand samples may lack of that to all, nats.
_ROUGH = 20.0


@dataclass(frozen=True, eq=False)
class Trial:
    """
    A candidate, fitted beside what was accepted before.

    `left` are the statistics of the model with it, where its evidence is clear.
    """

    name: str
    composite: Composite
    evidence: float
    left: dict[str, float] | None = None


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
                given: Sequence[str] = (), latent: bool = True,
                progress: Callable[[float], None] | None = None) -> Search:
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
    latent : bool
        Whether causes are tried for which nothing was measured.
    progress : callable, optional
        Called with the share done.

    Returns
    -------
    Search
        The model and its causes.

    """
    search = Search(_fitted(samples, baseline.terms, baseline) or baseline)
    values = criticise(samples, search.composite, bank)
    only = ''
    for turn in range(MOST):
        if progress is not None:
            progress(turn / MOST)
        trials, good = [], []
        hidden = {name for name in search.accepted if not _is_measured(catalogue()[name])}
        for tier in range(_TIERS if latent and len(hidden) < MOST_LATENT else 1):
            # Measured inputs first: what is latent can imitate them, and costs more.
            trials += _trials(samples, search, values, given, tier, bank, only)
            good = [trial for trial in trials if trial.evidence > ACCEPT
                    and (not (_is_measured(catalogue()[trial.name]) and _ragged(values))
                         or _throughout(trial.composite, search.composite))]
            if good:
                break
        if not good:
            break
        trials = _refined(samples, search.composite, trials)
        named = {trial.name for trial in good}
        best = next(trial for trial in trials if trial.name in named)
        search.rivals[best.name] = [
            trial.name for trial in trials
            if trial.name != best.name and trial.evidence > best.evidence - TIE]
        search.log.append(f'{best.name}: {best.evidence:.1f} nats; '
                          + ', '.join(f'{t.name} {t.evidence:.1f}' for t in trials[:6]
                                      if t is not best))
        search.composite = best.composite
        search.accepted.append(best.name)
        after = criticise(samples, search.composite, bank)
        if best.name == 'tone':
            after = _more_lines(samples, search, after, bank)
        _prune(samples, search)
        if _tier(catalogue()[best.name], values) > 0 and not _helped(values, after):
            # What is wrong here may not be in the catalogue: other terms would dress
            # it up.  Only one more of the kind may still be missing.
            search.log.append(f'{best.name} leaves most of what is wrong')
            if best.name not in _AGAIN or only:
                break
            only = best.name
        values = after
    return search


def _ragged(values: dict[str, float]) -> bool:
    """Return whether scores are so far from normal that likelihoods count some samples too much."""
    return any(name.startswith(('kurtosis', 'tails', 'clustering')) and value > _RAGGED
               for name, value in values.items())


def _throughout(new: Composite, old: Composite) -> bool:
    """Return whether a gain is more than stretches differ in: not that of a few outliers."""
    mean, error = mean_difference(new.density, old.density)
    return not mean <= _STEADY * error


def _more_lines(samples: Samples, search: Search, values: dict[str, float], bank: NullBank
                ) -> dict[str, float]:
    """Add the lines that come with the one accepted last, as harmonics do; return what is left."""
    kind = catalogue()['tone']
    for _ in range(MOST_LINES):
        if values['line'] < ASK:
            break
        view = view_of(samples, search.composite.gaussian, search.composite.z, samples.train)
        start = kind.candidates(view)[0]
        made = _joined(samples, search.composite, start, rough=True)
        gain = -1.0 if made is None else made.score(samples) - search.composite.score(samples)
        if made is None or gain < ACCEPT:
            break
        search.log.append(f'tone: {gain:.1f} nats beside it')
        search.composite = made
        search.accepted.append('tone')
        values = criticise(samples, search.composite, bank)
    return values


def _trials(samples: Samples, search: Search, values: dict[str, float], given: Sequence[str],
            tier: int, bank: NullBank, only: str = '') -> list[Trial]:
    """Return the candidates that something asks for, fitted, the dear ones last."""
    composite = search.composite
    view = view_of(samples, composite.gaussian, composite.z, samples.train)
    before = composite.score(samples)
    found: list[Trial] = []
    for kind in _kinds(composite, values, given, tier, samples.throttle is not None):
        if any(_settled(trial, kind) for trial in found) or (only and kind.NAME != only):
            continue
        best = _best_start(samples, composite, kind, view)
        if best is not None:
            trial = Trial(kind.NAME, best, best.score(samples) - before)
            if trial.evidence > CLEAR:
                trial = replace(trial, left=criticise(samples, best, bank))
            found.append(trial)
    return found


def _refined(samples: Samples, composite: Composite, trials: list[Trial]) -> list[Trial]:
    """Return trials, the best first, those near it fitted to all samples."""
    top = max(trial.evidence for trial in trials)
    before = composite.score(samples)
    made = []
    for trial in trials:
        if trial.evidence > top - _ROUGH and catalogue()[trial.name].ROLE is not Role.LAW:
            start = trial.composite
            full = _fitted(samples, start.terms, start)
            if full is not None and full.score(samples) - before > trial.evidence:
                trial = replace(trial, composite=full, evidence=full.score(samples) - before)
        made.append(trial)
    return sorted(made, key=lambda trial: -trial.evidence)


def _kinds(composite: Composite, values: dict[str, float], given: Sequence[str], tier: int,
           throttle: bool) -> list[type[Term]]:
    """Return the kinds to try: those of a tier that something asks for."""
    found = []
    for name, kind in catalogue().items():
        if name in ('ou', *given) or kind.ROLE is Role.EXACT or not kind.SIGNS:
            continue
        if _tier(kind, values) != tier or (kind.NEEDS_THROTTLE and not throttle):
            continue
        if composite.has(name) and name not in _AGAIN:
            continue
        if any(name in group and any(composite.has(other) for other in group - {name})
               for group in _ALIKE):
            continue
        if _asks(kind, values):
            found.append(kind)
    # The one that is asked for most may spare the others.
    return sorted(found, key=lambda kind: (kind.DEAR, -_asks(kind, values)))


def _asks(kind: type[Term], values: dict[str, float]) -> float:
    """Return how far off the statistic is that asks most for a kind; 0 where none does."""
    limit = ASK_DEAR if kind.DEAR else ASK
    return max((abs(value) for name, value in values.items() for sign in kind.SIGNS
                if abs(value) > limit and is_sign(sign, name, value)), default=0.0)


def _settled(trial: Trial, kind: type[Term]) -> bool:
    """Return whether a trial leaves nothing that a dear kind of another family could explain."""
    return (kind.DEAR and trial.left is not None and not _asks(kind, trial.left)
            and max(map(abs, trial.left.values())) < _LEFT
            and catalogue()[trial.name].FAMILY != kind.FAMILY)


def _best_start(samples: Samples, composite: Composite, kind: type[Term], view: View
                ) -> Composite | None:
    """Return the best fit with one more term of a kind."""
    if kind.ROLE is Role.LAW:
        # A law that has no parameters yet.
        made = _fitted(samples, [*composite.terms, object.__new__(kind)], composite)
        return made if made is not None and made.terms[-1].holds(view) else None
    starts = list(kind.candidates(view))
    known = [term for term in starts if term.ROLE is Role.MEAN]
    hidden = [term for term in starts if term.ROLE is not Role.MEAN]
    if len(known) > _FULL:
        known = _screened(samples, known, view)
    if len(hidden) > _FULL:
        hidden = _likely(samples, composite, hidden)
    best: Composite | None = None
    for start in (*known[:_FULL], *hidden[:_FULL]):
        made = _joined(samples, composite, start, rough=True)
        if made is not None and made.terms[_place(made)].holds(view) and (
                best is None or made.score(samples) > best.score(samples)):
            best = made
    return best


def _joined(samples: Samples, composite: Composite, start: Term, rough: bool
            ) -> Composite | None:
    """Return the fit with one more term, the last before the laws."""
    structural = [term for term in composite.terms if term.ROLE is not Role.LAW]
    laws = [term for term in composite.terms if term.ROLE is Role.LAW]
    structural[0] = start.beside(structural[0])
    return _fitted(samples, [*structural, start, *laws], composite, rough)


def _place(composite: Composite) -> int:
    """Return where the term is that was joined last."""
    return sum(term.ROLE is not Role.LAW for term in composite.terms) - 1


def _fitted(samples: Samples, terms: Sequence[Term], known: Composite | None,
            rough: bool = False) -> Composite | None:
    """Return a fit to the first part, its mean to everything; None where it cannot be fitted."""
    try:
        return fit_composite(samples, terms, samples.train, known, whole_mean=True,
                             rough=rough)
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
    if _is_measured(kind) or kind.ROLE is Role.NOISE:
        # White noise is in every sensor, and hides what is slow and weak.
        return 0
    shape = max((abs(value) for name, value in values.items()
                 if name.startswith(_SHAPE)), default=0.0)
    # No Gaussian term makes outliers: where there are many, laws are tried alone.
    return 1 if kind.ROLE is Role.LAW and shape > _CLEAR_SHAPE else 2


def _is_measured(kind: type[Term]) -> bool:
    """Return whether a kind answers to throttle or time alone."""
    return kind.FAMILY != 'line' and (kind.NEEDS_THROTTLE or kind.NAME == 'drift')


_SHAPE = ('kurtosis', 'tails')
_CLEAR_SHAPE = 25.0


def _prune(samples: Samples, search: Search) -> None:
    """Take out causes that are not needed beside those accepted since."""
    full = search.composite.score(samples)
    for name in search.accepted[:-1]:
        index = next(k for k, term in enumerate(search.composite.terms) if term.NAME == name)
        kept = [term for k, term in enumerate(search.composite.terms) if k != index]
        same = search.composite if search.composite.terms[index].ROLE is not Role.LAW else None
        less = _fitted(samples, kept, same, rough=True)
        # What was measured stays unless it is worth less than it costs.
        needed = NEEDED if _is_measured(catalogue()[name]) else TIE
        if less is not None and full - less.score(samples) < needed + _ROUGH:
            less = _fitted(samples, kept, less)
        if less is not None and full - less.score(samples) < needed:
            search.log.append(f'{name} is not needed any more: {full - less.score(samples):.1f}')
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
