"""
Candidates beside what was accepted before: their starting points, tried and fitted.

Most starts are compared on some thousand samples.  Evidence is the gain in
log-likelihood on the part fitted, less its price, plus that on the part kept.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from ou_monitor.criticism.composite import (
    Composite, fit_composite, LAW_COST, pole_beside, view_of)
from ou_monitor.criticism.null_bank import criticise, NullBank
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.spectral_start import from_spectrum
from ou_monitor.criticism.structure import evaluate
from ou_monitor.discovery import decision
from ou_monitor.discovery.free_law import free_law
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.slow import Drift
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray

# Starting points that are fitted in full, and samples that decide which.
_FULL, _GLANCE = 2, 8000
# Times that a term finds its parameters beside those of the fit.
_AGAIN = 3
# Nats by which two fits to one spectrum differ at least.
_ALIKE = 0.1


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate, fitted beside what was accepted before."""

    name: str  # Of the cause
    composite: Composite  # The model with it
    evidence: float  # nats
    # Statistics of the model with it; None where its evidence is not clear.
    left: dict[str, float] | None = None
    # Causes that the score test of another pole shows beside it; empty where `left` is None.
    shown: frozenset[str] = frozenset()
    beside: str = ''  # Name of a cause that comes with it; empty where none does


@dataclass(eq=False)
class Fitter:
    """Fits of models to one recording, and an account of what they cost."""

    samples: Samples  # The recording
    cost: float = 0.0  # Processor time of the fits, s, estimated from their filters
    # Latent laws with clear evidence, most of which a free law of throttle explains.
    throttles: set[str] = field(default_factory=set)

    def evidence(self, composite: Composite) -> float:
        """Return the evidence for a model, nats."""
        return composite.score(self.samples)

    def view(self, composite: Composite) -> View:
        """Return what a model leaves over."""
        return view_of(self.samples, composite.gaussian, composite.z, self.samples.train)

    def holds(self, composite: Composite) -> bool:
        """Return whether all terms of a model still mean what their names say."""
        view = self.view(composite)
        return all(term.holds(view) for term in composite.terms)

    def fit(self, terms: Sequence[Term | type[Term]], known: Composite | None,
            rough: bool = False, begun: bool = False) -> Composite | None:
        """Return a fit to the first part, its mean to everything; None where there is none."""
        try:
            found = fit_composite(self.samples, terms, self.samples.train, known,
                                  whole_mean=True, rough=rough, begun=begun)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            # Parameters have left what a term allows, or numbers can hold.
            return None
        self.cost += 0.0 if found is None else found.cost
        return found if found is None or rough else self._apart(found, self.samples.train)

    def _apart(self, found: Composite, part: slice) -> Composite:
        """Return a model whose terms have found again what the fit does not."""
        for _ in range(_AGAIN):
            if not any(term.APART for term in found.terms):
                break
            view = view_of(self.samples, found.gaussian, found.z, part)
            terms = [term.apart(view) if term.APART else term for term in found.terms]
            try:
                again = fit_composite(self.samples, terms, part, found, whole_mean=True,
                                      rough=True)
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):
                break
            self.cost += 0.0 if again is None else again.cost
            if again is None or not self.evidence(again) > self.evidence(found) + _ALIKE:
                break
            found = again
        return found

    def whole(self, model: Composite) -> Composite:
        """Return a model fitted to everything; as it is where that cannot be done."""
        try:
            # What its laws have found is that of all samples already.
            again = fit_composite(self.samples, model.terms, slice(0, self.samples.n), model)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            return model
        self.cost += 0.0 if again is None else again.cost
        if again is None or not math.isfinite(float(again.density.sum())):
            return model
        return self._apart(again, slice(0, self.samples.n))

    def join(self, composite: Composite, starts: Sequence[Term], rough: bool) -> Composite | None:
        """Return the fit with more terms, the last before the laws."""
        structural = [term for term in composite.terms if term.ROLE is not Role.LAW]
        laws = [term for term in composite.terms if term.ROLE is Role.LAW]
        structural[0] = starts[-1].beside(structural[0])
        return self.fit([*structural, *starts, *laws], composite, rough)

    def trials(self, composite: Composite, values: dict[str, float], given: Collection[str],
               tier: int, bank: NullBank, only: str = '') -> list[Trial]:
        """Return the candidates of a tier that something asks for, fitted, the dear ones last."""
        view = self.view(composite)
        before = self.evidence(composite)
        found: list[Trial] = []
        free: FloatArray | None = None
        asked = False
        model = [type(term) for term in composite.terms]
        for kind in decision.kinds_to_try(catalogue().values(), model, values, given, tier,
                                          self.samples.throttle is not None,
                                          self.poles_shown(composite)):
            if only and kind.NAME != only or not decision.affordable(kind, self.cost):
                continue
            if any(decision.settled(catalogue()[trial.name], trial.left, kind, trial.shown)
                   or decision.comes_first(catalogue()[trial.name], trial.evidence, kind, values)
                   for trial in found):
                continue
            if kind.ROLE is Role.LAW and decision.is_latent(kind):
                if not asked:
                    free, asked = free_law(self.samples, view.z), True
                if free is not None and self._is_throttles(kind, view, free):
                    continue
            best = self.best_start(composite, kind, view)
            if best is not None:
                with_it = kind.CHANGES is not None and not composite.has(kind.CHANGES.NAME)
                trial = Trial(kind.NAME, best, self.evidence(best) - before,
                              beside=kind.CHANGES.NAME if kind.CHANGES and with_it else '')
                if trial.evidence > decision.CLEAR:
                    trial = replace(trial, left=criticise(self.samples, best, bank),
                                    shown=self.poles_shown(best))
                found.append(trial)
        if any(decision.may_be_a_trend(catalogue()[trial.name]) for trial in found):
            found += self._trend(composite, view, before, given)
        return found

    def _trend(self, composite: Composite, view: View, before: float, given: Collection[str]
               ) -> list[Trial]:
        """Return a trial of `drift`, which is measured, beside latent causes that are slow."""
        if composite.has(Drift.NAME) or Drift.NAME in given or Drift.NAME not in catalogue():
            return []
        best = self.best_start(composite, Drift, view)
        return [] if best is None else [Trial(Drift.NAME, best, self.evidence(best) - before)]

    def _is_throttles(self, kind: type[Term], view: View, free: FloatArray) -> bool:
        """Return whether a free law of throttle, a log-variance, explains what a kind does."""
        def evidence(view: View) -> float:
            if kind.DEAR:
                self.cost += LAW_COST * self.samples.n
            try:
                fit = kind.fit_law(view)
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):
                return -math.inf
            return -math.inf if fit is None else (
                float(fit.gain.sum()) - fit.term.SEARCH
                - 0.5 * fit.free * math.log(self.samples.train.stop))

        beside = evidence(replace(view, z=view.z * np.exp(-0.5 * free),
                                  variance=view.variance * np.exp(free)))
        alone = evidence(view) if beside > decision.ACCEPT else 0.0
        found = decision.is_throttles(alone, beside)
        if found and alone > decision.CLEAR:
            self.throttles.add(kind.NAME)
        return found

    def poles_shown(self, composite: Composite) -> frozenset[str]:
        """Return the causes that the score test of another pole shows beside a model."""
        return decision.poles_shown(pole_beside(self.samples, composite))

    def refine(self, composite: Composite, trials: Sequence[Trial]) -> list[Trial]:
        """Return trials, the best first, those near it fitted to all samples."""
        top = max(trial.evidence for trial in trials)
        before = self.evidence(composite)
        refined = []
        for trial in trials:
            if (trial.evidence > top - decision.ROUGH
                    and catalogue()[trial.name].ROLE is not Role.LAW):
                start = trial.composite
                full = self.fit(start.terms, start)
                if full is not None and self.evidence(full) - before > trial.evidence:
                    trial = replace(trial, composite=full,
                                    evidence=self.evidence(full) - before)
            refined.append(trial)
        return sorted(refined, key=lambda trial: -trial.evidence)

    def best_start(self, composite: Composite, kind: type[Term], view: View) -> Composite | None:
        """Return the best fit with one more term of a kind."""
        if kind.ROLE is Role.LAW:
            found = self.fit([*composite.terms, kind], composite)
            return found if found is not None and found.terms[-1].holds(view) else None
        starts = list(kind.candidates(view))
        if kind.BROAD and not any(term.ROLE is Role.BLOCK and term.NEEDS_THROTTLE
                                  for term in composite.terms):
            return self._by_spectrum(composite, starts, view)
        known = [term for term in starts if term.ROLE is Role.MEAN]
        hidden = [term for term in starts if term.ROLE is not Role.MEAN]
        if len(known) > _FULL:
            known = _by_scores(self.samples, known, view)
        if len(hidden) > _FULL:
            hidden = self._by_likelihood(composite, hidden)
        best: Composite | None = None
        changed = [] if kind.CHANGES is None or composite.has(kind.CHANGES.NAME) else list(
            kind.CHANGES.candidates(view))[-1:]
        for start in (*known[:_FULL], *hidden[:_FULL]):
            found = self.join(composite, [*changed, start], rough=True)
            if found is not None and _joined(found).holds(view) and (
                    best is None or self.evidence(found) > self.evidence(best)):
                best = found
        return best

    def _by_spectrum(self, composite: Composite, starts: Sequence[Term], view: View
                     ) -> Composite | None:
        """Return the best fit from starts that the spectrum of the scores has moved."""
        ou, *others = composite.gaussian.terms
        laws = [term for term in composite.terms if term.ROLE is Role.LAW]
        moved = [from_spectrum(self.samples, composite, [start.beside(ou), *others, start])
                 for start in starts]
        moved = sorted((way for way in moved if way[0][-1].holds(view)), key=lambda way: -way[1])
        # Those that went the same way are one.
        ways = [way for k, way in enumerate(moved)
                if not any(way[1] > other[1] - _ALIKE for other in moved[:k])]
        fits = [self.fit([*terms, *laws], composite, rough=True, begun=True)
                for terms, _ in ways[:_FULL]]
        return max((fit for fit in fits if fit is not None and _joined(fit).holds(view)),
                   default=None, key=self.evidence)

    def simplest(self, composite: Composite, index: int) -> Composite | None:
        """Return the fit with one term in its simplest form; None where it is that already."""
        term = composite.terms[index]
        forms = sorted(type(term).simplest(self.view(composite)), key=_size)
        if not forms or _size(forms[0]) >= _size(term):
            return None
        return self.fit([*composite.terms[:index], forms[0], *composite.terms[index + 1:]], None)

    def _by_likelihood(self, composite: Composite, starts: list[Term]) -> list[Term]:
        """Return starts in the order of their likelihood as they are, on a part."""
        few = self.samples.part(slice(0, min(self.samples.train.stop, _GLANCE)))
        structural = [term for term in composite.terms if term.ROLE is not Role.LAW]

        def likelihood(start: Term) -> float:
            terms = [start.beside(structural[0]), *structural[1:], start]
            try:
                fit = evaluate(few, terms)
            except (ValueError, ArithmeticError):
                return -math.inf
            self.cost += fit.cost
            return float(fit.density.sum())

        return sorted(starts, key=lambda start: -likelihood(start))


def is_trend(samples: Samples, model: Composite) -> bool:
    """Return whether the `ou` of a model is too slow for a recording to be a relaxation."""
    ou = model.terms[0]
    assert isinstance(ou, OU)
    return not decision.relaxes(ou.alpha, float(samples.t[-1] - samples.t[0]))


def _joined(composite: Composite) -> Term:
    """Return the term that was joined last."""
    return [term for term in composite.terms if term.ROLE is not Role.LAW][-1]


def _size(term: Term) -> int:
    """Return the number of parameters that are fitted."""
    return len(term.free()) + len(term.LINEAR)


def _by_scores(samples: Samples, starts: list[Term], view: View) -> list[Term]:
    """Return starts in the order of how much of the scores they explain."""
    s = samples.segment(1.0, 0.0)
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
