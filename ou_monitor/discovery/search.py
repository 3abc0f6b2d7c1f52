"""
The search for causes: which ones a recording shows, and which a second criticism leaves.

Candidates are fitted, scored and criticised again, one round after the other.  Measured
inputs come before anything latent; a cause stays only while it is needed beside the
others; causes that do as well are named as its alternatives.  What is tried, accepted
and withdrawn is decided in `decision`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.criticism.composite import Composite, covariates_of, view_of
from ou_monitor.criticism.null_bank import criticise, NullBank, simulate_bank, simulate_bank_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import decision
from ou_monitor.discovery.errors import standard_errors
from ou_monitor.discovery.fitting import Fitter, is_trend, Trial
from ou_monitor.discovery.gain import BLOCKS, mean_difference
from ou_monitor.discovery.load_start import choose_answer, under_load
from ou_monitor.discovery.search_state import Search
from ou_monitor.discovery.throttle_laws import compare_laws, LAWS, OTHER_CURVE, worth
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.drift import Drift
from ou_monitor.model.terms.lines import prominence
from ou_monitor.model.terms.load_dependent_sigma import LoadDependentSigma
from ou_monitor.model.terms.load_sag import LoadSag
from ou_monitor.model.terms.resonance import Resonance
from ou_monitor.model.terms.second_relaxation import SecondRelaxation
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.terms.tone import lines_of, Tone

Progress = Callable[[float], None]

# Time of one fit, s, up to which the mean is chosen anew after each cause.
_SOON = 1.0

# Turns in which lines are joined to a tone: three motors or converters, each with its harmonics.
_LINE_TURNS = 3

# Note where the search was cut short.
STOPPED = ('The search for causes was cut short where the next ones would have taken long; there '
           'may be more than are named.')

# Note where it was stopped by hand.
INTERRUPTED = ('The search for causes was stopped by hand: these are the causes found until then, '
               'and there may be more.')


@dataclass(frozen=True, eq=False)
class Named:
    """
    What the search left: a model fitted on everything, its causes, statistics before and after.

    `bank` is what the statistics are measured by.

    """

    whole: Composite
    bank: NullBank
    names: tuple[str, ...]
    rivals: Mapping[str, list[str]]
    dropped: tuple[str, ...]
    before: Mapping[str, float]
    after: Mapping[str, float]
    failure: str


def named_causes(samples: Samples, start: Composite, rng: np.random.Generator,
                 exact: tuple[Term, ...], progress: Progress) -> Named:
    """Search for causes; withdraw those that claim what they do not explain."""
    phi = float(np.median(start.gaussian.phi[1:]))
    if len(start.terms) > 1:
        bank = simulate_bank_of(samples, start, rng)
    else:
        bank = simulate_bank(covariates_of(samples, start), phi, rng)
    before = criticise(samples, start, bank)
    fitter = Fitter(samples, start.cost)
    # Beside lines that were taken out there may be slower ones.
    given = [term.NAME for term in exact if term.FAMILY != 'line']
    begun = Search(fitter.fit(start.terms, start) or start)
    bare, search, failure, loaded = begun.composite, begun, '', False
    try:
        under_load(fitter, begun)
        loaded = any(kind.FAMILY == LoadSag.FAMILY for kind in _kinds(begun.accepted))
        search = begun.copy()
        name_causes(fitter, search, bank, given=given,
                    progress=lambda share: progress(0.1 + 0.9 * share))
        failure = STOPPED if search.stopped else ''
    except KeyboardInterrupt:
        failure = INTERRUPTED
        # In the middle of the load there is no model that belongs to the names.
        search = search if search is not begun else Search(bare)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        # A fit outside of what numbers can hold; the criticism still stands.
        failure = f'The search for causes broke off: {error}.'
        search = search if search is not begun else Search(bare)
    # Fitted to everything, so that an event in the part kept does not count against a cause.
    whole = fitter.whole(search.composite)
    after = criticise(samples, whole, bank) if search.accepted else before
    kinds = _kinds(search.accepted)
    # What the measured causes left, which the load begins with.
    measured = before
    if loaded and any(map(decision.is_latent, kinds)):
        measured = criticise(samples, begun.composite, bank)
    out = decision.withdrawn(measured, after, kinds, search.asked)
    # Noise that the load needs is part of it.
    out = [k for k in out if not (loaded and search.accepted[k] in begun.accepted)]
    out = _in_doubt(samples, whole, search.accepted, out)
    out = sorted({*out, *_other(fitter, whole, search.accepted)})
    dropped = tuple(search.accepted[k] for k in out)
    found = _Result(search, whole, after)
    if dropped and failure != INTERRUPTED:
        stays = [search.composite.terms[position(search.composite, search.accepted, k)]
                 for k, kind in enumerate(kinds) if k not in out and not kind.MEASURED]
        # What is sure whatever comes now.
        sure = begun if loaded else Search(bare)
        found = _Result(sure, sure.composite, criticise(samples, sure.composite, bank))
        try:
            found = _without(fitter, search, begun, dropped, stays, measured, bank, given,
                             loaded)
        except KeyboardInterrupt:
            failure = INTERRUPTED
        dropped = tuple(name for name in dropped if name not in found.search.accepted)
    return Named(found.whole, bank, tuple(found.search.accepted),
                 _with_trends(samples, found.whole, found.search.rivals), dropped, before,
                 found.after, failure)


def _with_trends(samples: Samples, whole: Composite, rivals: Mapping[str, list[str]]
                 ) -> dict[str, list[str]]:
    """Return the rivals of each cause; of a pole that is a trend, a drift of any form is one."""
    duration = float(samples.t[-1] - samples.t[0])
    slow = not whole.has(Drift.NAME) and any(
        isinstance(term, SecondRelaxation) and not decision.relaxes(term.alpha, duration)
        for term in whole.terms)
    return {name: [*others, Drift.NAME] if slow and name == SecondRelaxation.NAME
            and Drift.NAME not in others else others for name, others in rivals.items()}


@dataclass(frozen=True)
class _Result:
    """A search, its model fitted to everything, and what that leaves."""

    search: Search
    whole: Composite
    after: Mapping[str, float]


def _in_doubt(samples: Samples, whole: Composite, names: Sequence[str], out: Sequence[int]
              ) -> list[int]:
    """Return those to withdraw, less the lines that are there whatever else is left."""
    errors: Sequence[Mapping[str, float]] = ()
    if any(names[k] == Tone.NAME for k in out):
        errors = standard_errors(samples, whole, slice(0, samples.n))

    def is_sure(k: int) -> bool:
        if names[k] not in (Tone.NAME, Resonance.NAME):
            return False
        at = position(whole, names, k)
        term = whole.terms[at]
        if isinstance(term, Tone):
            return term.amplitude > decision.SURE * errors[at].get('amplitude', math.inf)
        assert isinstance(term, Resonance)
        z = evaluate(samples, [other for other in whole.terms
                               if other is not term and other.ROLE is not Role.LAW]).z
        rate = 1.0 / float(np.median(samples.step[1:]))
        return prominence(z, rate, term.frequency, term.damping / math.pi) > decision.OFF

    return [k for k in out if not is_sure(k)]


def _other(fitter: Fitter, whole: Composite, names: Sequence[str]) -> list[int]:
    """Return the states that are something else by now than their name says."""
    view = fitter.view(whole)
    return [k for k, kind in enumerate(_kinds(names)) if kind.ROLE is Role.BLOCK
            and not whole.terms[position(whole, names, k)].holds(view)]


def _without(fitter: Fitter, search: Search, begun: Search, dropped: Sequence[str],
             stays: Sequence[Term], measured: Mapping[str, float],
             bank: NullBank, given: Sequence[str], loaded: bool) -> _Result:
    """Search again without what was withdrawn; `measured` is what the measured causes left."""
    # The causes withdrawn may have hidden measured ones.  A trend that another slow cause
    # replaced is not tried again.
    slow = [kind.NAME for kind in _kinds(search.removed) if kind.FAMILY == 'slow']
    # Nor are they the last that could explain it: what did less well may be right.
    if decision.searched_again(loaded, fitter.cost):
        again = begun.copy()
        name_causes(fitter, again, bank, given=[*given, *slow, *dropped])
        kinds = _kinds(again.accepted)
        other = fitter.whole(again.composite)
        left = criticise(fitter.samples, other, bank)
        out = [*_in_doubt(fitter.samples, other, again.accepted,
                          decision.withdrawn(measured, left, kinds, again.asked)),
               *_other(fitter, other, again.accepted)]
        if any(map(decision.is_latent, kinds)) and not out:
            return _Result(again, other, left)
    asked, search = search.asked, begun.copy()
    latent = [term for term in stays if decision.is_latent(type(term))]
    for term in stays:
        # What follows throttle without being an answer of the mean: it may be too dear by now.
        fit = None if term in latent else fitter.join(search.composite, [term], rough=False)
        if fit and fitter.evidence(fit) - fitter.evidence(search.composite) >= decision.ACCEPT:
            search.take(term.NAME, fit)
    name_causes(fitter, search, bank, latent=False, given=[*given, *slow])
    search.asked = {**search.asked, **asked}
    return _Result(search, *_kept_beside(fitter, search, latent, measured, bank))


def name_causes(fitter: Fitter, search: Search, bank: NullBank, *,
                given: Sequence[str] = (), latent: bool = True,
                progress: Progress | None = None) -> None:
    """Accept causes one after the other, the best first, beside those found so far."""
    samples = fitter.samples
    values = criticise(samples, search.composite, bank)
    only, reformed = '', False
    for turn in range(decision.MOST):
        if progress is not None:
            progress(turn / decision.MOST)
        trials, good = [], []
        hidden = {kind for kind in _kinds(search.accepted) if not kind.MEASURED}
        deep = latent and len(hidden) < decision.MOST_LATENT
        for tier in range(decision.TIERS if deep else 1):
            # Measured inputs first: latent causes can imitate them, and cost more.
            trials += fitter.trials(
                search.composite, values, [*given, *search.hopeless, *_in_vain(search, values)],
                tier, bank, only)
            search.hopeless |= {trial.name for trial in trials
                                if _only_form(fitter, trial, search)}
            good = [trial for trial in trials if trial.name not in search.hopeless
                    and _acceptable(trial, search, values)]
            search.failed |= {
                trial.name: decision.asks(catalogue()[trial.name], values) for trial in trials
                if trial.evidence <= decision.ACCEPT}
            if good:
                break
            if tier == 0 and not reformed and decision.any_off(values):
                # Before a latent cause imitates what the form of a measured one leaves.
                reformed = True
                if _reform(fitter, search):
                    values = criticise(samples, search.composite, bank)
        if not good:
            break
        trials = fitter.refine(search.composite, trials)
        named = {trial.name for trial in good}
        name = decision.best_of([(trial.name, trial.evidence) for trial in trials
                                 if trial.name in named])
        best = next(trial for trial in trials if trial.name == name)
        _accept(search, best, trials)
        search.asked[best.name] = values
        chosen = best.composite.gaussian.cost < _SOON
        if chosen:
            choose_answer(fitter, search, ())
        after = criticise(samples, search.composite, bank)
        if best.name == Tone.NAME and _more_lines(fitter, search):
            # Beside the strongest the next ones show.
            for _ in range(_LINE_TURNS - 1):
                if not _more_lines(fitter, search):
                    break
            after = criticise(samples, search.composite, bank)
        _prune(fitter, search, chosen)
        kind = catalogue()[best.name]
        if kind in LAWS or kind.ROLE is Role.NOISE:
            compare_laws(fitter, search)
            after = criticise(samples, search.composite, bank)
        if decision.tier_of(kind, values) > 0 and not (
                decision.helped(values, after) or decision.helped(values, after, kind)):
            # The effect may not be in the catalogue; other terms would only imitate it.  One
            # more term of the same kind may still be missing.
            search.log.append(f'{best.name} leaves most of what is wrong')
            if not kind.RECURS or only:
                break
            only = best.name
        values = after
    if fitter.cost <= decision.MOST_COST:
        compare_laws(fitter, search)
    search.stopped = fitter.cost > decision.MOST_COST


def position(model: Composite, names: Sequence[str], k: int) -> int:
    """Return where in the model the k-th cause is: the n-th of its kind is the n-th."""
    nth = list(names[:k]).count(names[k])
    return [i for i, term in enumerate(model.terms) if term.NAME == names[k]][nth]


def _kinds(names: Sequence[str]) -> list[type[Term]]:
    return [catalogue()[name] for name in names]


def _acceptable(trial: Trial, search: Search, values: Mapping[str, float]) -> bool:
    """Return whether a trial may be accepted."""
    kind = catalogue()[trial.name]
    new, old = trial.composite.density, search.composite.density
    gains = [float(part.sum()) for part in np.array_split(new - old, BLOCKS)]
    return decision.acceptable(
        kind, trial.evidence, decision.is_ragged(values),
        decision.is_throughout(*mean_difference(new, old), gains))


def _in_vain(search: Search, values: Mapping[str, float]) -> list[str]:
    """Return the dear kinds that have failed, and that nothing asks for more than it did then."""
    return [name for name, asked in search.failed.items() if catalogue()[name].DEAR
            and decision.asks(catalogue()[name], values) <= asked]


def _only_form(fitter: Fitter, trial: Trial, search: Search) -> bool:
    """Return whether a curve over throttle may only mend the form of another one."""
    other = OTHER_CURVE.get(trial.name, '')
    return search.composite.has(other) and trial.evidence > decision.ACCEPT and (
        trial.evidence < decision.FORM * worth(fitter, search.composite, other))


def _accept(search: Search, best: Trial, trials: Sequence[Trial]) -> None:
    """Accept a trial; what did as well is its rival."""
    search.rivals[best.name] = decision.rivals_of(
        best.name, [(trial.name, trial.evidence) for trial in trials])
    search.log.append(f'{best.name}: {best.evidence:.1f} nats; '
                      + ', '.join(f'{t.name} {t.evidence:.1f}' for t in trials[:6]
                                  if t is not best))
    search.composite = best.composite
    search.accepted += [name for name in (best.beside, best.name) if name]
    search.largest = max(search.largest, best.evidence)


def _more_lines(fitter: Fitter, search: Search) -> bool:
    """Add the lines that come with the one accepted last, as harmonics do."""
    composite, samples = search.composite, fitter.samples
    view = fitter.view(composite)
    # An amplitude, a phase, and what was searched for the frequency.
    price = math.log(samples.train.stop) + Tone.SEARCH
    # A line of the scores, which have variance 1, gains n rms^2 / 2 nats.
    lines = [Tone.at(line, view) for line in lines_of(view)[:decision.MOST_LINES]
             if 0.5 * samples.n * line.rms ** 2 > price + decision.ACCEPT]
    fit = fitter.join(composite, lines, rough=True) if lines else None
    if fit is None or (fitter.evidence(fit) - fitter.evidence(composite)
                       < decision.ACCEPT * len(lines)):
        return False
    search.log.append(f'{len(lines)} more lines')
    search.composite = fit
    search.accepted += [Tone.NAME] * len(lines)
    return True


def _reform(fitter: Fitter, search: Search) -> bool:
    """Look for better knots of sigma(throttle) beside all else; return whether there are any."""
    composite = search.composite
    index = next((k for k, term in enumerate(composite.terms)
                  if isinstance(term, LoadDependentSigma)), None)
    if index is None:
        return False
    term = composite.terms[index]
    assert isinstance(term, LoadDependentSigma)
    # Its scores before any law of the noise.
    gaussian = composite.gaussian
    view = view_of(fitter.samples, gaussian, gaussian.z, fitter.samples.train)
    for start in term.candidates(term.relative(view)):
        terms = [*composite.terms[:index], start, *composite.terms[index + 1:]]
        fit = fitter.fit(terms, composite)
        if fit is not None and fitter.evidence(fit) > (
                fitter.evidence(search.composite) + decision.TIE):
            search.composite = fit
    return search.composite is not composite


def _prune(fitter: Fitter, search: Search, chosen: bool) -> None:
    """
    Take out causes that are not needed beside those accepted since.

    chosen: whether the regression has just decided on the answers to what is measured.
    """
    full = fitter.evidence(search.composite)
    last = catalogue()[search.accepted[-1]]
    for name in dict.fromkeys(search.accepted[:-1]):
        kind = catalogue()[name]
        if not decision.in_doubt(kind, last) or (chosen and decision.is_answer(kind)):
            continue
        index = next(k for k, term in enumerate(search.composite.terms) if term.NAME == name)
        kept = [term for k, term in enumerate(search.composite.terms) if k != index]
        same = search.composite if search.composite.terms[index].ROLE is not Role.LAW else None
        less = fitter.fit(kept, same, rough=True)
        needed = decision.needed_evidence(kind)
        if less is not None and full - fitter.evidence(less) < needed + decision.ROUGH:
            less = fitter.fit(kept, less)
        if less is None or not full - fitter.evidence(less) < needed or not fitter.holds(less):
            continue
        if decision.is_answer(kind) and is_trend(fitter.samples, less):
            # The `ou` has taken its place: a trend, and no relaxation any more.
            continue
        plain = fitter.simplest(search.composite, index)
        if plain is not None and fitter.evidence(plain) - fitter.evidence(less) > needed:
            search.log.append(f'{name} in a simpler form')
            search.composite, full = plain, fitter.evidence(plain)
            continue
        lost = full - fitter.evidence(less)
        search.log.append(f'{name} is not needed any more: {lost:.1f}')
        search.composite, full = less, fitter.evidence(less)
        search.accepted.remove(name)
        search.removed.append(name)


def _kept_beside(fitter: Fitter, search: Search, stays: Sequence[Term],
                 before: Mapping[str, float], bank: NullBank
                 ) -> tuple[Composite, dict[str, float]]:
    """Put latent causes that were not withdrawn beside the measured ones; return what is left."""
    samples = fitter.samples
    whole = fitter.whole(search.composite)
    after = criticise(samples, whole, bank)
    # Lines come at once: none explains what the others do.
    lines = [term for term in stays if isinstance(term, Tone)]
    groups: list[list[Term]] = [[*lines], *([term] for term in stays if term not in lines)]
    for terms in groups:
        more = [term for term in terms if term.SEVERAL or not search.composite.has(term.NAME)]
        while more:
            fit = fitter.join(search.composite, more, rough=False)
            if fit is None or (fitter.evidence(fit) - fitter.evidence(search.composite)
                               < decision.ACCEPT * len(more)):
                break
            again = fitter.whole(fit)
            left = criticise(samples, again, bank)
            names = [*search.accepted, *(term.NAME for term in more)]
            kinds = _kinds(names)
            out = _in_doubt(samples, again, names,
                            decision.withdrawn(before, left, kinds, search.asked))
            out += _other(fitter, again, names)
            bad = [k - len(search.accepted) for k in out if k >= len(search.accepted)]
            if not bad:
                search.composite, whole, after, search.accepted = fit, again, left, names
                for term in more:
                    search.rivals.setdefault(term.NAME, [])
                break
            more = [term for k, term in enumerate(more) if k not in bad]
    return whole, after
