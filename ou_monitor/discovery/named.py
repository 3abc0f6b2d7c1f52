"""
Named causes: the causes that a search accepted and that a second criticism does not refute.

The model is criticised on the whole recording; causes that do not explain their statistics are
withdrawn, and the search continues without them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import (
    covariates_of, criticise, NullBank, simulate_bank, simulate_bank_of)
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter, standard_errors
from ou_monitor.discovery.search import (
    kinds_of, name_causes, position, Progress, Search, under_load, without_causes)
from ou_monitor.model.terms.catalogue import blamed
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import Drift, SecondRelaxation
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.terms.tones import prominence, Resonance, Tone

# Maximum number of searches, each without the causes withdrawn before.
_TURNS = 3
# Amplitude, in standard errors, from which a line is never withdrawn.
_SURE = 25.0

# Note if the search was cut short.
STOPPED = ('The search for causes was cut short because the next ones would have taken too long; '
           'there may be more.')


@dataclass(frozen=True, eq=False)
class Named:
    """Result of the search."""

    whole: Composite  # Model fitted to everything
    bank: NullBank  # Calibration of the statistics
    names: tuple[str, ...]  # Causes in the order of acceptance
    rivals: Mapping[str, list[str]]  # For each cause, the causes that tie with it
    dropped: tuple[str, ...]  # Causes that were withdrawn
    # Statistics of the plain and of the extended model.
    before: Mapping[str, float]
    after: Mapping[str, float]
    failure: str  # Why the search ended early; otherwise empty


def named_causes(samples: Samples, start: Composite, rng: np.random.Generator,
                 exact: tuple[Term, ...], progress: Progress) -> Named:
    """Search for causes; withdraw those that do not explain their statistics."""
    phi = float(np.median(start.gaussian.phi[1:]))
    if len(start.terms) > 1:
        bank = simulate_bank_of(samples, start, rng)
    else:
        bank = simulate_bank(covariates_of(samples, start), phi, rng)
    before = criticise(samples, start, bank)
    fitter = Fitter(samples, start.cost)
    search = Search(fitter.fit(start.terms, start) or start)
    found = _Result(search.copy(), start, before)
    # Only lines above the Nyquist frequency were subtracted, so `line` causes stay allowed.
    given = [term.NAME for term in exact if term.FAMILY != 'line']
    failure, begun = '', None
    dropped: list[str] = []
    refuted = -math.inf
    try:
        under_load(fitter, search)
        begun = found = _fit_everything(fitter, search, bank)
        for turn in range(_TURNS):
            less = search.copy()
            # In the last turn, name no latent causes: those named were withdrawn repeatedly.
            name_causes(fitter, search, bank, given=[*given, *dropped],
                        latent=turn < _TURNS - 1,
                        progress=None if turn else lambda share: progress(0.1 + 0.9 * share))
            if fitter.evidence(search.composite) < refuted:
                # These causes are worse than the withdrawn ones that they replace.
                search = replace(less, stopped=search.stopped)
            found = _fit_everything(fitter, search, bank)
            out = _withdrawn(fitter, found, begun)
            if not out:
                break
            dropped += [search.accepted[k] for k in out]
            refuted = max(refuted, fitter.evidence(search.composite))
            found = begun
            rest = without_causes(fitter, search, out)
            if rest is None:
                break
            search = rest
            found = _fit_everything(fitter, search, bank)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        if blamed(error):
            raise
        # A numerical failure; the criticism is still valid.
        failure = f'The search for causes failed: {error}.'
    if failure and begun is not None:
        # Once the load model has been chosen, any state of the search can be used.
        found = _fit_everything(fitter, search, bank)
    names = found.search.accepted
    return Named(found.whole, bank, tuple(names),
                 _with_trends(samples, found.whole, found.search.rivals),
                 tuple(name for name in dict.fromkeys(dropped) if name not in names), before,
                 found.after, failure or (STOPPED if search.stopped else ''))


@dataclass(frozen=True)
class _Result:
    """A search, its model fitted to everything, and the statistics of that model."""

    search: Search
    whole: Composite
    after: Mapping[str, float]


def _fit_everything(fitter: Fitter, search: Search, bank: NullBank) -> _Result:
    """Return a search with its model fitted to everything, held-out events included."""
    whole = fitter.whole(search.composite)
    return _Result(search.copy(), whole, criticise(fitter.samples, whole, bank))


def _withdrawn(fitter: Fitter, found: _Result, begun: _Result) -> list[int]:
    """Return the causes that do not explain their statistics, or no longer fit their name."""
    names = found.search.accepted
    out = decision.withdrawn(begun.after, found.after, kinds_of(names),
                             found.search.before_accepted)
    # Noise terms of the load model stay.
    out = [k for k in out if names[k] not in begun.search.accepted]
    view = fitter.view(found.whole)
    return sorted({*_in_doubt(fitter.samples, found.whole, names, out),
                   # Causes with states of their own that no longer fit their name.
                   *(k for k, kind in enumerate(kinds_of(names)) if kind.ROLE is Role.BLOCK
                     and not found.whole.terms[position(found.whole, names, k)].holds(view))})


def _with_trends(samples: Samples, whole: Composite, rivals: Mapping[str, list[str]]
                 ) -> dict[str, list[str]]:
    """Return the rivals of each cause; a relaxation that is a trend has a drift as a rival."""
    duration = float(samples.t[-1] - samples.t[0])
    # The `ou` may be the slower of the two.
    slow = whole.has(SecondRelaxation.NAME) and not whole.has(Drift.NAME) and any(
        isinstance(term, (OU, SecondRelaxation)) and not decision.relaxes(term.alpha, duration)
        for term in whole.terms)
    return {name: [*others, Drift.NAME] if slow and name == SecondRelaxation.NAME
            and Drift.NAME not in others else others for name, others in rivals.items()}


def _in_doubt(samples: Samples, whole: Composite, names: Sequence[str], out: Sequence[int]
              ) -> list[int]:
    """Return the causes to withdraw; strong lines always stay."""
    errors: Sequence[Mapping[str, float]] = ()
    if any(names[k] == Tone.NAME for k in out):
        errors = standard_errors(samples, whole, slice(0, samples.n))

    def is_sure(k: int) -> bool:
        if names[k] not in (Tone.NAME, Resonance.NAME):
            return False
        at = position(whole, names, k)
        term = whole.terms[at]
        if isinstance(term, Tone):
            return term.amplitude > _SURE * errors[at].get('amplitude', math.inf)
        assert isinstance(term, Resonance)
        z = evaluate(samples, [other for other in whole.terms
                               if other is not term and other.ROLE is not Role.LAW]).z
        rate = 1.0 / float(np.median(samples.step[1:]))
        return prominence(z, rate, term.frequency, term.damping / math.pi) > decision.FAILS

    return [k for k in out if not is_sure(k)]
