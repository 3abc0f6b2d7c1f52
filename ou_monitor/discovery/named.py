"""
What is named: the causes of a search, less those that a second criticism refutes.

The search is criticised on everything; what claims more than it explains is withdrawn, and the
search goes on without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.criticism.composite import Composite, covariates_of
from ou_monitor.criticism.null_bank import criticise, NullBank, simulate_bank, simulate_bank_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import decision
from ou_monitor.discovery.errors import standard_errors
from ou_monitor.discovery.fitting import Fitter
from ou_monitor.discovery.load_start import under_load
from ou_monitor.discovery.search import kinds_of, name_causes, position, Progress
from ou_monitor.discovery.search_state import Search
from ou_monitor.model.terms.lines import prominence
from ou_monitor.model.terms.load_answer import LoadSag
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.terms.tones import Resonance, Tone

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

    `bank` is what the statistics are measured by; `throttles` are laws that throttle explains.

    """

    whole: Composite
    bank: NullBank
    names: tuple[str, ...]
    rivals: Mapping[str, list[str]]
    dropped: tuple[str, ...]
    before: Mapping[str, float]
    after: Mapping[str, float]
    failure: str
    throttles: tuple[str, ...]


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
        loaded = any(kind.FAMILY == LoadSag.FAMILY for kind in kinds_of(begun.accepted))
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
    kinds = kinds_of(search.accepted)
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
                 found.after, failure,
                 tuple(sorted(fitter.throttles.difference(found.search.accepted))))


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
    return [k for k, kind in enumerate(kinds_of(names)) if kind.ROLE is Role.BLOCK
            and not whole.terms[position(whole, names, k)].holds(view)]


def _without(fitter: Fitter, search: Search, begun: Search, dropped: Sequence[str],
             stays: Sequence[Term], measured: Mapping[str, float],
             bank: NullBank, given: Sequence[str], loaded: bool) -> _Result:
    """Search again without what was withdrawn; `measured` is what the measured causes left."""
    # The causes withdrawn may have hidden measured ones.  A trend that another slow cause
    # replaced is not tried again.
    slow = [kind.NAME for kind in kinds_of(search.removed) if kind.FAMILY == 'slow']
    # Nor are they the last that could explain it: what did less well may be right.
    if decision.searched_again(loaded, fitter.cost):
        again = begun.copy()
        name_causes(fitter, again, bank, given=[*given, *slow, *dropped])
        kinds = kinds_of(again.accepted)
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
            kinds = kinds_of(names)
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
