"""The search for causes, and which of them the second criticism leaves standing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.criticism.composite import Composite, fit_composite, scene_of
from ou_monitor.criticism.null_bank import NullBank, simulate_bank, simulate_bank_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import joined
from ou_monitor.discovery.naming import ACCEPT, name_causes, Search
from ou_monitor.discovery.trials import criticise
from ou_monitor.discovery.verdict import is_latent, withdrawn
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Term

# What to say where the search was cut short.
STOPPED = ('The search for causes was cut short where the next ones would have taken long; there '
           'may be more than are named.')


@dataclass(frozen=True, eq=False)
class Named:
    """
    What the search left: a model, its causes, and statistics before and after.

    `model` was fitted on the first part, `whole` on `part`: everything where that could be done.

    """

    model: Composite
    whole: Composite
    part: slice
    names: tuple[str, ...]
    rivals: Mapping[str, list[str]]
    dropped: tuple[str, ...]
    before: Mapping[str, float]
    after: Mapping[str, float]
    failure: str


def named_causes(samples: Samples, start: Composite, rng: np.random.Generator,
                 exact: tuple[Term, ...], progress: Callable[[float], None]) -> Named:
    """Search for causes; withdraw those that claim what they do not explain."""
    phi = float(np.median(start.gaussian.phi[1:]))
    if len(start.terms) > 1:
        bank = simulate_bank_of(samples, start, rng)
    else:
        bank = simulate_bank(scene_of(samples, start), phi, rng)
    progress(0.1)
    before = criticise(samples, start, bank)
    # Beside lines that were taken out there may be slower ones.
    given = [term.NAME for term in exact if term.FAMILY != 'line']
    try:
        search = name_causes(samples, start, bank, given=given,
                             progress=lambda share: progress(0.1 + 0.9 * share))
        failure = STOPPED if search.stopped else ''
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        # A fit outside of what numbers can hold; the criticism still stands.
        search, failure = Search(start), f'The search for causes broke off: {error}.'
    # What happens once, in the part kept, is no fault of the form of a cause.
    whole = _whole(samples, search.composite)
    after = criticise(samples, whole, bank) if search.accepted else before
    kinds = [catalogue()[name] for name in search.accepted]
    out = withdrawn(before, after, kinds)
    dropped = tuple(search.accepted[k] for k in out)
    if dropped:
        stays = [search.composite.terms[position(search.composite, search.accepted, k)]
                 for k, kind in enumerate(kinds) if k not in out and is_latent(kind)]
        # They may have stood in the way of what was measured; a trend that they did better
        # than is none.
        slow = [name for name in search.removed if catalogue()[name].FAMILY == 'slow']
        search = name_causes(samples, start, bank, latent=False, given=[*given, *slow])
        whole, after = _kept_beside(samples, search, stays, before, bank)
    part = samples.train if whole is search.composite else slice(0, samples.n)
    model = search.composite
    if search.accepted:
        # Named with a mean that saw everything; measured with one that did not.
        model = fit_composite(samples, model.terms, samples.train, model) or model
    return Named(model, whole, part, tuple(search.accepted), search.rivals, dropped, before, after,
                 failure)


def _kept_beside(samples: Samples, search: Search, stays: Sequence[Term],
                 before: Mapping[str, float], bank: NullBank
                 ) -> tuple[Composite, dict[str, float]]:
    """Put latent causes that were not withdrawn beside the measured ones; return what is left."""
    whole = _whole(samples, search.composite)
    after = criticise(samples, whole, bank)
    for term in stays:
        made = joined(samples, search.composite, [term], rough=False)
        if made is None or made.score(samples) - search.composite.score(samples) < ACCEPT:
            continue
        again = _whole(samples, made)
        left = criticise(samples, again, bank)
        names = [*search.accepted, term.NAME]
        if withdrawn(before, left, [catalogue()[name] for name in names]):
            continue
        search.composite, whole, after = made, again, left
        search.accepted.append(term.NAME)
        search.rivals.setdefault(term.NAME, [])
    return whole, after


def position(model: Composite, names: list[str] | tuple[str, ...], k: int) -> int:
    """Return where in the model the k-th cause is: the n-th of its kind is the n-th."""
    nth = list(names[:k]).count(names[k])
    return [i for i, term in enumerate(model.terms) if term.NAME == names[k]][nth]


def _whole(samples: Samples, model: Composite) -> Composite:
    """Return a model fitted on everything; as it is where that cannot be done."""
    # Without the levels that switching adds, the rail would seem to relax slower.
    known = model if model.offset is not None else None
    try:
        again = fit_composite(samples, model.terms, slice(0, samples.n), known)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return model
    return again if again is not None and math.isfinite(float(again.density.sum())) else model
