"""
Where a search begins: the answer of the mean to throttle and time, and the noise of a load.

On real flights that is nearly all of the variance, so that nothing else can be seen before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter, is_trend
from ou_monitor.discovery.regression import load_terms
from ou_monitor.discovery.search import backward, choose_answer, Search
from ou_monitor.model.terms.ac_coupling import ACCoupling
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_answer import LoadSag, LoadTransient
from ou_monitor.model.terms.load_dependent import LoadDependentNoise, LoadDependentSigma
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.term import Role, Term

# Rate, 1/s, from which a fit finds what the load leaves: minutes and tenths of a second are both
# within reach of it.
_SLOW = 1.0


def under_load(fitter: Fitter, search: Search) -> None:
    """
    Start from the load model: the answer to throttle, and noise that follows it, at once.

    In a flight they are nearly all of the variance: one by one, each would be fitted to what the
    others leave.  Nothing is accepted that the mean without them does not need.
    """
    load, plain = load_terms(fitter.samples), search.composite
    noisy = whole_load(fitter, plain, load)
    if noisy is None:
        choose_answer(fitter, search, ())
        return
    search.composite = noisy
    choose_answer(fitter, search, load)
    if not any(catalogue()[name].FAMILY == LoadSag.FAMILY for name in search.accepted):
        # Throttle does not move the mean: what the noise is, the search asks one by one.
        search.composite, search.accepted = plain, []
        choose_answer(fitter, search, ())
        return
    means = [term for term in search.composite.terms if decision.is_answer(type(term))]
    bare = fitter.fit([*plain.terms, *means], plain)
    if bare is None:
        return
    # Again beside the mean as it is now, each for its own evidence.
    known = [term.NAME for term in plain.terms]
    best = _noise_beside(fitter, bare)
    if fitter.evidence(search.composite) > fitter.evidence(best):
        best = fitter.fit(search.composite.terms, search.composite) or search.composite
    search.composite = best
    for term in best.terms:
        if term.NAME not in known and not decision.is_answer(type(term)):
            search.accepted.append(term.NAME)
            search.rivals.setdefault(term.NAME, [])
            search.log.append(f'{term.NAME}: with the load')
    backward(fitter, search)
    choose_answer(fitter, search, ())
    _coupled(fitter, search)


def _coupled(fitter: Fitter, search: Search) -> None:
    """Let a coupled sag stand for transients alone where it does better; a tie makes rivals."""
    composite = search.composite
    means = [term for term in composite.terms if decision.is_answer(type(term))]
    if ACCoupling.NAME not in catalogue() or not decision.only_to_changes(map(type, means)):
        return
    changes = [term for term in means if isinstance(term, LoadTransient)]
    if any(term.delay > 0.0 for term in changes):
        return
    # What a step of throttle leaves dies out with the corner.
    tau = max(term.tau for term in changes)
    coupling = ACCoupling(0.5 / (math.pi * tau), 0.0)
    ou, *others = [term for term in composite.terms if term not in means]
    structural = [term for term in others if term.ROLE is not Role.LAW]
    laws = [term for term in others if term.ROLE is Role.LAW]
    fit = fitter.fit([coupling.beside(ou), *structural, LoadSag(0.0, 0.0), coupling, *laws],
                     composite)
    # A rail that does not relax within the recording is, coupled, one that does.
    if fit is None or is_trend(fitter.samples, fit):
        return
    gain = fitter.evidence(fit) - fitter.evidence(composite)
    names = [term.NAME for term in means]
    if abs(gain) < decision.TIE:
        for name in names:
            search.rivals[name] = [*search.rivals.get(name, []), ACCoupling.NAME]
    if gain < decision.TIE:
        return
    search.log.append(f'{ACCoupling.NAME} and {LoadSag.NAME} in place of {", ".join(names)}: '
                      f'{gain:.1f} nats')
    search.composite = fit
    search.accepted = [LoadSag.NAME, ACCoupling.NAME,
                       *(name for name in search.accepted if name not in names)]
    for name in (LoadSag.NAME, ACCoupling.NAME):
        search.rivals[name] = []


def whole_load(fitter: Fitter, plain: Composite, load: Sequence[Term]) -> Composite | None:
    """Return a model with all terms of a load and the noise beside them; None for no load."""
    full = fitter.fit([*plain.terms, *load], plain, rough=True) if load else None
    return None if full is None else _noise_beside(fitter, full)


def _noise_beside(fitter: Fitter, composite: Composite) -> Composite:
    """Return a model with the noise that a recording under load shows beside its mean."""
    best = composite
    ou = composite.terms[0]
    assert isinstance(ou, OU)
    error = math.sqrt(float(np.median(composite.gaussian.variance)))
    # What the load leaves is slow, and small beside the white noise; or it is the noise itself.
    slow = replace(ou, alpha=_SLOW, sigma=0.3 * error * math.sqrt(2.0 * _SLOW))
    while True:
        view = fitter.view(best)
        tried: list[Composite] = []
        for kind in (LoadDependentSigma, LoadDependentNoise, MeasurementNoise):
            if best.has(kind.NAME) or kind.NAME not in catalogue():
                continue
            found = fitter.best_start(best, kind, view)
            if found is not None:
                tried.append(found)
            if not best.has(MeasurementNoise.NAME) and kind is not LoadDependentSigma:
                more: list[Term] = [MeasurementNoise(0.8 * error)]
                if kind is LoadDependentNoise:
                    more = [*more, *LoadDependentNoise.candidates(view)]
                found = fitter.fit([slow, *best.terms[1:], *more], best, rough=True)
                if found is not None:
                    tried.append(found)
        top = max(tried, default=None, key=fitter.evidence)
        gain = -math.inf if top is None else fitter.evidence(top) - fitter.evidence(best)
        if top is None or gain < decision.ACCEPT:
            return best
        best = top
