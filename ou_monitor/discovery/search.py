"""
The search for causes: which ones a recording shows.

Candidates are fitted, scored and criticised again, one round after the other.  Measured
inputs come before anything latent; a cause stays only while it is needed beside the
others; causes that do as well are named as its alternatives.  What is tried, accepted
and withdrawn is decided in `decision`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math

import numpy as np
from ou_monitor.criticism.composite import Composite, view_of
from ou_monitor.criticism.null_bank import criticise, NullBank
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter, is_trend, Trial
from ou_monitor.discovery.gain import BLOCKS, mean_difference
from ou_monitor.discovery.load_start import choose_answer
from ou_monitor.discovery.search_state import Search
from ou_monitor.discovery.throttle_laws import compare_laws, LAWS, OTHER_CURVE, worth
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_dependent import LoadDependentSigma
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.terms.tones import lines_of, Tone

Progress = Callable[[float], None]

# Time of one fit, s, up to which the mean is chosen anew after each cause.
_SOON = 1.0

# Turns in which lines are joined to a tone: three motors or converters, each with its harmonics.
_LINE_TURNS = 3


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
        hidden = {kind for kind in kinds_of(search.accepted) if not kind.MEASURED}
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


def kinds_of(names: Sequence[str]) -> list[type[Term]]:
    """Return the kinds of causes."""
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
