"""
Fit a whole model: its Gaussian part, then the laws of its innovations in turn.

A law is a term that describes the distribution of the innovations.  It maps normal scores to new
ones and returns the ratio of densities, so that laws can be chained.  Events that a law finds
enter the Gaussian part as extra variance, and both are fitted again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import (
    driven, Events, fit_gaussian, GaussianFit, slope_of_lines, white_noise)
from ou_monitor.model.terms.term import LawFit, Role, Term, View
from ou_monitor.records import FloatArray

# Maximum rounds in which laws and Gaussian part are refitted.
_ROUNDS = 3
# Limits of a factor on the noise; convergence tolerance: mean change of its logarithm.
_POWERS = 1e-3, 1e3
_ALIKE = 0.03
# Processor time of the fastest law with a `SLOW_FIT`, s per sample.
LAW_COST = 1e-5
# A function that fits a law for the first time.
LawFitter = Callable[[type[Term], View], LawFit | None]


@dataclass(frozen=True, eq=False)
class Composite:
    """A fitted model."""

    terms: tuple[Term, ...]  # All, laws included, with parameters
    se: tuple[dict[str, float], ...]  # Standard errors, one dict per term
    gaussian: GaussianFit
    z: FloatArray  # Normal scores of the one-step predictions; shape (n,)
    density: FloatArray  # Log predictive density of each sample, nats; shape (n,)
    free: int  # Number of fitted parameters
    search: float  # Penalty for searched alternatives, nats
    events: Events | None = None  # Events from the laws, used in the Gaussian part
    offset: FloatArray | None = None  # Offset from the laws, subtracted first, V; shape (n,)
    cost: float = 0.0  # Processor time of the fits, s, estimated from filters and laws

    def score(self, samples: Samples) -> float:
        """Return the penalised log density of the fitted part and the held-out part, nats."""
        return float(self.density.sum() - 0.5 * self.free * math.log(samples.train.stop)
                     - self.search)

    def last(self, kind: type[Term]) -> Term:
        """Return the last term of a kind."""
        return [term for term in self.terms if term.NAME == kind.NAME][-1]

    def has(self, name: str) -> bool:
        """Return whether the model has a term of that name."""
        return any(term.NAME == name for term in self.terms)


def fit_composite(samples: Samples, terms: Sequence[Term | type[Term]], part: slice,
                  known: Composite | None = None, *, rough: bool = False, begun: bool = False,
                  first: LawFitter | None = None) -> Composite | None:
    """Fit a model on a part, its mean on everything; None if a law cannot be fitted."""
    # A law that has no parameters yet is given as its class, and fitted by `first`.  The fit
    # starts from the events and offset of `known`; with the same laws, there is one round only.
    structural = [term for term in terms
                  if isinstance(term, Term) and term.ROLE is not Role.LAW]
    laws = sorted((term for term in terms if term.ROLE is Role.LAW),
                  key=lambda law: not law.EVENTS)
    events = None if known is None else known.events
    offset = None if known is None else known.offset
    fits: list[LawFit] = []
    cost = 0.0
    last = 0 if known is not None and _kinds(known.terms) == _kinds(terms) else _ROUNDS
    for turn in range(1 + last):
        gaussian = fit_gaussian(samples, structural, part, events, offset, rough, begun)
        z, density, cost = gaussian.z, gaussian.density, cost + gaussian.cost
        fits = []
        push, error, moved = np.zeros(samples.n), np.zeros(samples.n), np.zeros(samples.n)
        power, white, bias = np.ones(samples.n), np.ones(samples.n), np.zeros(samples.n)
        for k, law in enumerate(laws):
            view = replace(view_of(samples, gaussian, z, part), variance=gaussian.variance * power,
                           power=1.0 if events is None else events.power)
            fit = (law.refit_law(view) if isinstance(law, Term) else
                   first(law, view) if first else law.fit_law(view))
            if law.SLOW_FIT:
                cost += LAW_COST * samples.n
            if fit is None:
                return None
            laws[k] = fit.term
            fits.append(fit)
            z, density = fit.z, density + fit.gain
            push += 0.0 if fit.push is None else fit.push
            error += 0.0 if fit.error is None else fit.error
            moved += 0.0 if fit.offset is None else fit.offset
            power *= 1.0 if fit.power is None else np.clip(fit.power, *_POWERS)
            white *= 1.0 if fit.white is None else np.clip(fit.white, *_POWERS)
            bias += 0.0 if fit.bias is None else fit.bias
        found = Events(push, error, power, white, bias)
        if _converged(events, offset, found, moved, gaussian) or turn == last:
            break
        if events is not None or any(
                x.any() for x in (push, error, power - 1.0, white - 1.0)):
            events = found
        offset = moved if moved.any() else None
        structural = list(gaussian.terms)
    fitted = (*gaussian.terms, *(fit.term for fit in fits))
    free = sum(len(term.free()) + len(term.LINEAR) + term.APART for term in gaussian.terms) + 1
    return Composite(fitted, (*gaussian.se, *(fit.se for fit in fits)), gaussian, z, density,
                     free + sum(fit.free for fit in fits), sum(term.SEARCH for term in fitted),
                     events, offset, cost)


def _kinds(terms: Sequence[Term | type[Term]]) -> list[str]:
    return [term.NAME for term in terms if term.ROLE is Role.LAW]


def _converged(events: Events | None, offset: FloatArray | None, found: Events, moved: FloatArray,
               gaussian: GaussianFit) -> bool:
    before = events or Events(np.zeros(1), np.zeros(1), np.ones(1), np.ones(1), np.zeros(1))
    if ((found.push > 0.0) != (before.push > 0.0)).any() or (
            (found.error > 0.0) != (before.error > 0.0)).any():
        return False
    if any(float(np.mean(np.abs(np.log(now / then)))) > _ALIKE for now, then in (
            (found.power, before.power), (found.white, before.white))):
        return False
    change = moved - (0.0 if offset is None else offset)
    return float(np.mean(change**2)) < 0.01 * float(np.median(gaussian.variance))


def view_of(samples: Samples, gaussian: GaussianFit, z: FloatArray, part: slice) -> View:
    """Return the series from which a law or a candidate is fitted."""
    residual = samples.voltage - gaussian.mean
    s = driven(samples, gaussian.terms)
    white = white_noise(samples, gaussian.terms, s)
    return View(z=z, variance=gaussian.variance, phi=gaussian.phi,
                state=np.concatenate(([0.0], residual[:-1])), residual=residual,
                at=samples.t - samples.t[0], step=samples.step, throttle=samples.throttle,
                by_current=samples.by_current, train=part,
                trust=np.clip(1.0 - white / gaussian.variance, 0.0, 1.0),
                driven=np.clip(s.added / gaussian.variance, 0.0, 1.0),
                slope=slope_of_lines(samples, gaussian.terms))
