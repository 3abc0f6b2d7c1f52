"""
The laws of throttle: which of sigma, white noise and alpha follow it.

In errors of one step each can stand for another, so that what was tried first would stay.  Each
is compared with the others after a fit beside the same other terms.
"""

from __future__ import annotations

from collections.abc import Sequence

from ou_monitor.criticism.composite import Composite
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter
from ou_monitor.discovery.search_state import Search
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_dependent import (
    LoadDependentAlpha, LoadDependentNoise, LoadDependentSigma)
from ou_monitor.model.terms.term import Term

LAWS: tuple[type[Term], ...] = (LoadDependentSigma, LoadDependentNoise, LoadDependentAlpha)
_NAMES = tuple(kind.NAME for kind in LAWS)
# Intensities that follow throttle: each may only mend the form of the other.
OTHER_CURVE = {
    LoadDependentSigma.NAME: LoadDependentNoise.NAME,
    LoadDependentNoise.NAME: LoadDependentSigma.NAME}


def compare_laws(fitter: Fitter, search: Search) -> None:
    """Keep the laws of throttle that do best beside all else; those that do as well are rivals."""
    for _ in range(2 * len(LAWS)):
        if not _moved(fitter, search):
            return


def worth(fitter: Fitter, composite: Composite, name: str) -> float:
    """Return the evidence that a model loses without its term of a name, nats."""
    less = _without(fitter, composite, name)
    return fitter.evidence(composite) - (0.0 if less is None else fitter.evidence(less))


def _moved(fitter: Fitter, search: Search) -> bool:
    """Take out or exchange one law, the move that is best; return whether there was one."""
    composite = search.composite
    names = [name for name in search.accepted if name in _NAMES]
    if not names:
        return False
    others = {name: _without(fitter, composite, name) for name in names}
    rest = {name: less for name, less in others.items() if less is not None}
    swaps = [(name, kind, found) for name, less in rest.items() for kind in LAWS
             if kind.NAME in catalogue() and not composite.has(kind.NAME)
             and (kind.CHANGES is None or composite.has(kind.CHANGES.NAME))
             for found in [fitter.best_start(less, kind, fitter.view(less))]
             if found is not None and fitter.holds(found)]
    value = fitter.evidence(composite)
    if any(fitter.evidence(found) > value - decision.ROUGH for _, _, found in swaps):
        composite = fitter.fit(composite.terms, composite) or composite
        swaps = [(name, kind, _in_full(fitter, found, value)) for name, kind, found in swaps]
        value = fitter.evidence(composite)
        search.composite = composite
    best = max(swaps, key=lambda swap: fitter.evidence(swap[2]), default=None)
    if best is not None and fitter.evidence(best[2]) > value:
        name, kind, found = best
        search.log.append(f'{kind.NAME} in place of {name}: '
                          f'{fitter.evidence(found) - value:.1f} nats')
        search.composite = found
        search.accepted[search.accepted.index(name)] = kind.NAME
        search.rivals.pop(name, None)
        # Where the better one is not needed either, this one is not tried again.
        search.hopeless.add(name)
        return True
    least = min(rest, key=lambda name: value - fitter.evidence(rest[name]), default=None)
    if least is not None and value - fitter.evidence(rest[least]) < _needed(
            fitter, rest[least], least):
        search.log.append(f'{least} is not needed beside the others')
        search.composite = rest[least]
        search.accepted.remove(least)
        search.removed.append(least)
        search.hopeless.add(least)
        return True
    for name in names:
        search.rivals[name] = [kind.NAME for other, kind, found in swaps if other == name
                               and fitter.evidence(found) > value - decision.TIE]
    return False


def _needed(fitter: Fitter, less: Composite, name: str) -> float:
    """Return the evidence that a law must bring beside the other laws of a model, nats."""
    other = OTHER_CURVE.get(name, '')
    share = decision.FORM * worth(fitter, less, other) if less.has(other) else 0.0
    alone = not any(less.has(law) for law in _NAMES)
    return max(decision.NEEDED if alone else decision.ACCEPT, share)


def _without(fitter: Fitter, composite: Composite, name: str) -> Composite | None:
    """Return the fit without the term of a name."""
    kept: Sequence[Term] = [term for term in composite.terms if term.NAME != name]
    return fitter.fit(kept, composite, rough=True)


def _in_full(fitter: Fitter, found: Composite, value: float) -> Composite:
    """Return a fit to all samples of what is near a value; the better of two."""
    if fitter.evidence(found) < value - decision.ROUGH:
        return found
    full = fitter.fit(found.terms, found)
    return full if full is not None and fitter.evidence(full) > fitter.evidence(found) else found
