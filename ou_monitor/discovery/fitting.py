"""
Candidates for the next cause: their starting points, and fits together with the accepted causes.

Most starts are compared on a few thousand samples.  Evidence is the gain in log-likelihood on the
fitted part, minus the penalty of the parameters, plus the gain on the held-out part.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math
from operator import is_
from typing import Any

import numpy as np
from ou_monitor.criticism.composite import Composite, fit_composite, LAW_COST, view_of
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import (
    coefficients, driven, evaluate, state_space, white_noise, whitened)
from ou_monitor.discovery import decision
from ou_monitor.discovery.gain import all_moved
from ou_monitor.model.terms.load_response import LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.term import LawFit, Role, Term, View
from ou_monitor.model.whittle import Ordinates
from ou_monitor.records import FloatArray, NAN

# Maximum starting points to fit, samples by which they are selected, and kinds fitted in full.
_FULL, _PREVIEW, _FEW = 2, 8000, 4
# First estimates below this share of the best are dropped: a full fit at most doubles an estimate.
_WITHIN = 0.5
# Maximum alternations between the fit and the `APART` parameters of its terms.
_AGAIN = 3
# Differences below which the gains of two fits, nats, and normal scores count as equal.
_ALIKE, _SAME = 0.1, 1e-6
# Degree of a smooth drift, as of a discharge under changing load, and the variance inflation
# factor above which the load counts as collinear with it: flights have 1.0 to 1.4, staircases and
# ramps of test stands 5.2 to 11.
_SMOOTH, COLLINEAR = 4, 5.0
# Step of the derivative of a mean, in the logarithm of a time constant.
_STEP = 1e-3


# First estimate: gain, nats, kind, and start (None for a law).
_FirstEstimate = tuple[float, type[Term], Composite | None]


@dataclass(frozen=True, eq=False)
class Trial:
    """A candidate, fitted together with the accepted causes."""

    kind: type[Term]
    composite: Composite
    evidence: float  # nats
    beside: str = ''  # Name of a cause that it needs and that is added with it; otherwise empty

    @property
    def name(self) -> str:
        """Return the name of the cause."""
        return self.kind.NAME


@dataclass(eq=False)
class Fitter:
    """Fit models to one recording, and count the processor time."""

    samples: Samples
    cost: float = 0.0  # Processor time of the fits, s, estimated from their filters
    # For each law: the scores to which it was last fitted, and that fit (None: it failed).
    law_fits: dict[type[Term], tuple[FloatArray, LawFit | None]] = field(default_factory=dict)
    # Kinds that were tried without success, with their gain by score tests at that time, nats.
    failed: dict[type[Term], float] = field(default_factory=dict)

    def evidence(self, composite: Composite) -> float:
        """Return the evidence for a model, nats."""
        return composite.score(self.samples)

    def view(self, composite: Composite) -> View:
        """Return the residuals of a model."""
        return view_of(self.samples, composite.gaussian, composite.z, self.samples.train)

    def holds(self, composite: Composite) -> bool:
        """Return whether every term still has the effect that its name says."""
        view = self.view(composite)
        return all(term.holds(view) for term in composite.terms)

    def fit(self, terms: Sequence[Term | type[Term]], known: Composite | None,
            rough: bool = False, begun: bool = False) -> Composite | None:
        """Return a fit to the first part, its mean fitted to everything; None if it fails."""
        part = self.samples.train
        found = self._fit(terms, part, known, rough, begun)
        return found if found is None or rough else self._fit_apart(found, part)

    def _fit(self, terms: Sequence[Term | type[Term]], part: slice, known: Composite | None,
             rough: bool = False, begun: bool = False) -> Composite | None:
        """Run `fit_composite` and count its cost; None if it fails."""
        try:
            found = fit_composite(self.samples, terms, part, known, rough=rough, begun=begun,
                                  first=self.law_fit)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            # Parameters out of range, or an overflow.
            return None
        self.cost += 0.0 if found is None else found.cost
        return found

    def _fit_apart(self, found: Composite, part: slice) -> Composite:
        """Fit the `APART` parameters of terms and all others in turn while evidence grows."""
        for _ in range(_AGAIN):
            view = view_of(self.samples, found.gaussian, found.z, part)
            terms = [term.apart(view) for term in found.terms]
            if all(map(is_, terms, found.terms)):
                break
            again = self._fit(terms, part, found, rough=True)
            if again is None or not self.evidence(again) > self.evidence(found) + _ALIKE:
                break
            found = again
        return found

    def whole(self, model: Composite) -> Composite:
        """Return a model fitted to everything, or unchanged if that fails."""
        # The laws were already fitted to all samples.
        again = self._fit(model.terms, slice(0, self.samples.n), model)
        if again is None or not math.isfinite(float(again.density.sum())):
            return model
        return self._fit_apart(again, slice(0, self.samples.n))

    def join(self, composite: Composite, starts: Sequence[Term]) -> Composite | None:
        """Return a rough fit with more terms, inserted before the laws."""
        structural = [term for term in composite.terms if term.ROLE is not Role.LAW]
        laws = [term for term in composite.terms if term.ROLE is Role.LAW]
        structural[0] = starts[-1].beside(structural[0])
        return self.fit([*structural, *starts, *laws], composite, rough=True)

    def trials(self, composite: Composite, kinds: Sequence[type[Term]],
               statistics: Callable[[Composite], Mapping[str, float]]) -> list[Trial]:
        """Return kinds that improve a model: all are estimated, the best few fitted in full."""
        # Kinds that failed are tried again if their gain by score tests is larger now.  Kinds that
        # are slow to fit come last, and only if they imitate the best other kind, or if score
        # tests still show them once that kind is added.
        values = statistics(composite)
        shown = {kind: decision.score_gain(kind, values) for kind in kinds}
        tried = [kind for kind in kinds if not kind.SLOW_FIT
                 and shown[kind] > self.failed.get(kind, -1.0)]
        estimates = self._first_estimates(composite, tried, 0.0)
        found = self._in_full(composite, estimates, [])
        slow = [kind for kind in kinds if kind.SLOW_FIT and decision.affordable(kind, self.cost)
                and shown[kind] > self.failed.get(
                    kind, decision.TIE if kind.ROLE is Role.LAW else -1.0)]
        top = max((estimate[0] for estimate in estimates), default=0.0)
        if slow and found:
            best = max(found, key=lambda trial: trial.evidence)
            left = statistics(best.composite)
            slow = [kind for kind in slow if decision.imitate(kind, best.kind)
                    or decision.score_gain(kind, left) > decision.TIE]
        if slow:
            estimates += self._first_estimates(composite, slow, _WITHIN * top)
            found = self._in_full(composite, estimates, found)
            # BROAD kinds below `least` were not estimated in full, so they have not failed.
            tried += [kind for kind in slow if not top or not kind.BROAD]
        gained = {estimate[1] for estimate in estimates}
        self.failed |= {kind: shown[kind] for kind in tried if kind not in gained}
        return found

    def _first_estimates(self, composite: Composite, kinds: Sequence[type[Term]], least: float
                         ) -> list[_FirstEstimate]:
        """Return the first estimates of kinds that gain enough (least: for BROAD kinds, nats)."""
        view, before = self.view(composite), self.evidence(composite)
        found = []
        for kind in kinds:
            if kind.ROLE is Role.LAW and not self._finds_events(kind, composite, view):
                gain, start = self._law_gain(kind, view), None
            else:
                start = self.best_start(composite, kind, view, least)
                gain = -math.inf if start is None else self.evidence(start) - before
            # Keep kinds that gain less than others: a full fit may reverse the order.
            if gain > (least if kind.BROAD else 0.0):
                found.append((gain, kind, start))
        return found

    def _in_full(self, composite: Composite, estimates: Sequence[_FirstEstimate],
                 known: list[Trial]) -> list[Trial]:
        """Fit the trials with the best estimates in full, reusing known fits."""
        found, done = list(known), {trial.kind for trial in known}
        best = sorted(estimates, key=lambda estimate: -estimate[0])[:_FEW]
        for gain, kind, start in best:
            # A full fit of a law may gain nothing, so compare the estimates with full fits only.
            top = max((trial.evidence for trial in found), default=0.0)
            if gain < _WITHIN * top or kind in done:
                continue
            full = self.fit([*composite.terms, kind] if start is None else start.terms,
                            start or composite)
            if start is not None and (full is None or self.evidence(full) < self.evidence(start)):
                full = start
            if full is not None and full.last(kind).holds(self.view(composite)):
                with_it = kind.CHANGES is not None and not composite.has(kind.CHANGES.NAME)
                found.append(Trial(
                    kind, full, self.evidence(full) - self.evidence(composite),
                    kind.CHANGES.NAME if kind.CHANGES and with_it else ''))
        return found

    def law_fit(self, kind: type[Term], view: View) -> LawFit | None:
        """Return a law fitted to a view, cached by the scores."""
        last = self.law_fits.get(kind)
        if last is None or not np.allclose(last[0], view.z, rtol=0.0, atol=_SAME):
            try:
                last = view.z, kind.fit_law(view)
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):
                last = view.z, None
            self.law_fits[kind] = last
        return last[1]

    def _finds_events(self, kind: type[Term], composite: Composite, view: View) -> bool:
        """Return whether a law finds events, which inflate the variances of fits without it."""
        if _hidden_by_laws(kind, composite):
            return True
        found = None if kind.SLOW_FIT else self.law_fit(kind, view)
        return found is not None and (found.push is not None or found.error is not None)

    def _law_gain(self, kind: type[Term], view: View) -> float:
        """Return the evidence for a law of scores, nats."""
        if kind.SLOW_FIT:
            self.cost += LAW_COST * self.samples.n
        fit = self.law_fit(kind, view)
        return -math.inf if fit is None else (
            float(fit.gain.sum()) - fit.term.SEARCH
            - 0.5 * fit.free * math.log(self.samples.train.stop))

    def best_start(self, composite: Composite, kind: type[Term], view: View, least: float = 0.0,
                   starts: Sequence[Term] | None = None) -> Composite | None:
        """Return the best fit with one more term of a kind (starts: its candidates by default)."""
        # least: minimum gain of a BROAD kind in the spectrum, nats.
        if kind.ROLE is Role.LAW:
            found = self.fit([*composite.terms, kind],
                             None if _hidden_by_laws(kind, composite) else composite, rough=True)
            return found if found is not None and found.last(kind).holds(view) else None
        starts = list(kind.candidates(view)) if starts is None else list(starts)
        if kind.BROAD and not any(term.ROLE is Role.BLOCK and term.NEEDS_THROTTLE
                                  for term in composite.terms):
            return self._by_spectrum(composite, starts, view, least)
        known = [term for term in starts if term.ROLE is Role.MEAN]
        hidden = [term for term in starts if term.ROLE is not Role.MEAN]
        if known:
            known = _by_scores(self.samples, known, view)
        if len(hidden) > _FULL:
            hidden = self._by_likelihood(composite, hidden)
        best: Composite | None = None
        changed = [] if kind.CHANGES is None or composite.has(kind.CHANGES.NAME) else list(
            kind.CHANGES.candidates(view))[-1:]
        for start in (*known[:_FULL], *hidden[:_FULL]):
            found = self.join(composite, [*changed, start])
            if found is not None and _added_term(found).holds(view) and (
                    best is None or self.evidence(found) > self.evidence(best)):
                best = found
        return best

    def _by_spectrum(self, composite: Composite, starts: Sequence[Term], view: View,
                     least: float) -> Composite | None:
        """Return the best fit from starts that were first fitted to the spectrum of the scores."""
        ou, *others = composite.gaussian.terms
        laws = [term for term in composite.terms if term.ROLE is Role.LAW]
        moved = [from_spectrum(self.samples, composite, [start.beside(ou), *others, start])
                 for start in starts]
        # A start that gains less than the penalty in the spectrum does so in the samples, too.
        moved = sorted((fit for fit in moved if fit[0][-1].holds(view)
                        and fit[1] > max(decision.ACCEPT, least)), key=lambda fit: -fit[1])
        # Starts with the same gain have converged to one fit.
        distinct = [fit for k, fit in enumerate(moved)
                    if not any(fit[1] > other[1] - _ALIKE for other in moved[:k])]
        fits = [self.fit([*terms, *laws], composite, rough=True, begun=True)
                for terms, _ in distinct[:_FULL]]
        return max((fit for fit in fits if fit is not None and _added_term(fit).holds(view)),
                   default=None, key=self.evidence)

    def _by_likelihood(self, composite: Composite, starts: list[Term]) -> list[Term]:
        """Sort starts by their likelihood without a fit, on a part of the samples."""
        few = self.samples.part(slice(0, min(self.samples.train.stop, _PREVIEW)))
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
    """Return whether the `ou` of a model is too slow to be a relaxation in a recording."""
    ou = model.terms[0]
    assert isinstance(ou, OU)
    return not decision.relaxes(ou.alpha, float(samples.t[-1] - samples.t[0]))


def _hidden_by_laws(kind: type[Term], composite: Composite) -> bool:
    """Return whether the laws of a model may have absorbed the events that a kind finds."""
    return kind.EVENTS and any(term.ROLE is Role.LAW for term in composite.terms)


def _added_term(composite: Composite) -> Term:
    return [term for term in composite.terms if term.ROLE is not Role.LAW][-1]


def _by_scores(samples: Samples, starts: list[Term], view: View) -> list[Term]:
    """Sort starts by their gain in the normal scores; drop lines that gain too little."""
    # Other kinds are kept: the `ou` absorbs part of a slow effect, which then gains little here.
    s = samples.segment(1.0, 0.0)
    scale = np.sqrt(view.variance)
    price = 0.5 * math.log(samples.train.stop)

    def explained(term: Term) -> float:
        columns = term.columns(s)
        through = columns.copy()
        through[1:] -= view.phi[1:, None] * columns[:-1]
        through = (through / scale[:, None])[view.train]
        through = through - through.mean(axis=0)
        z = view.z[view.train]
        beta = np.linalg.lstsq(through, z, rcond=1e-10)[0]
        rest: FloatArray = z - through @ beta
        return 0.5 * float(z @ z - rest @ rest)

    gains = [(explained(term), term) for term in starts]
    return [term for gain, term in sorted(gains, key=lambda pair: -pair[0])
            if term.FAMILY != 'line' or gain > _WITHIN * (price * len(term.LINEAR) + term.SEARCH)]


def from_spectrum(samples: Samples, composite: Composite, starts: Sequence[Term]
                  ) -> tuple[tuple[Term, ...], float]:
    """Return terms fitted to the spectrum of a model's scores, and the gain of the fit, nats."""
    # starts: the initial `ou`, the other terms of `composite` without its laws, then new terms.
    ordinates = Ordinates.of(composite.z[samples.train])
    turn = np.exp(1j * ordinates.omega)
    few = Samples(float(np.median(samples.step[1:])) * np.arange(3.0), np.zeros(3), None)
    known = composite.gaussian.terms
    ou = known[0]
    assert isinstance(ou, OU)
    # Mean effects of throttle on alpha, sigma and noise.
    s = driven(samples, known)
    faster = math.exp(float(np.mean(np.log(s.alpha / ou.alpha))))
    louder = 1.0 / math.sqrt(float(np.mean((ou.sigma / s.sigma) ** 2)))
    white = samples.blur + sum(term.variance() for term in known)
    each = white_noise(samples, known, s)
    noisier = 1.0 / float(np.mean(white / each)) if white > 0.0 else 1.0

    def spectrum(terms: Sequence[Term]) -> FloatArray:
        """Return the spectrum of a model, up to a factor."""
        ou = terms[0]
        assert isinstance(ou, OU)
        ou = replace(ou, alpha=ou.alpha * faster, sigma=ou.sigma * louder)
        kept = [term for term in terms[1:] if term.ROLE is Role.BLOCK]
        space = state_space(few, [ou, *kept], None)[1]
        f, q, h = space.f[1], space.q[1], space.h
        left = turn[:, None, None] * np.eye(h.size) - f
        seen = np.linalg.solve(left.transpose(0, 2, 1), np.broadcast_to(
            h[:, None], (turn.size, h.size, 1)))[..., 0]
        noise = samples.blur + sum(
            term.variance() for term in terms[1:] if term.ROLE is Role.NOISE)
        found: FloatArray = np.einsum('ki,ij,kj->k', seen.conj(), q, seen).real
        return found + noise * noisier

    free = [(k, name) for k, term in enumerate(starts) if k == 0 or term.ROLE in (
        Role.BLOCK, Role.NOISE) for name in term.free()]
    before = spectrum(known)
    x, gain = ordinates.climb(
        lambda x: np.log(spectrum(all_moved(starts, free, x)) / before), np.zeros(len(free)))
    return all_moved(starts, free, x), gain


def standard_errors(samples: Samples, model: Composite) -> tuple[dict[str, Any], ...]:
    """Return standard errors by parameter, one dict per term."""
    found = [_gathered(term, se) for term, se in zip(model.terms, model.se)]
    for k, more in _mean_errors(samples, model).items():
        found[k] = {**more, **found[k]}
    return tuple(found)


def with_reach(term: Term, se: dict[str, Any], samples: Samples) -> dict[str, Any]:
    """Return errors, infinite for parameters that the recording cannot determine."""
    duration = float(samples.t[-1] - samples.t[0])
    values = term.values()
    far = [name for name, value in values.items() if isinstance(value, float) and (
        (term.unit(name) == 's' and value > duration)
        or (term.unit(name) == '1/s' and 0.0 < value * duration < 1.0))]
    if isinstance(term, Saturation):
        far += [name for name, met in (('low', term.low >= float(samples.logged.min())),
                                       ('high', term.high <= float(samples.logged.max())))
                if not met]
    return {**se, **dict.fromkeys(far, math.inf)}


def follows_time(samples: Samples) -> float:
    """Return the variance inflation of the load by a smooth drift; 0 below the limit."""
    if samples.throttle is None:
        return 0.0
    x = 2.0 * (samples.t - samples.t[0]) / (samples.t[-1] - samples.t[0]) - 1.0
    drift = np.polynomial.legendre.legvander(x, _SMOOTH)
    left = samples.throttle - drift @ np.linalg.lstsq(drift, samples.throttle, rcond=None)[0]
    found = float(np.var(samples.throttle) / max(np.var(left), 1e-12))
    return found if found > COLLINEAR else 0.0


def _gathered(term: Term, se: dict[str, float]) -> dict[str, Any]:
    """Gather the errors of single knots, named `parameter 2` and so on, in lists."""
    gathered: dict[str, Any] = {}
    for name, value in se.items():
        base, _, at = name.partition(' ')
        if at:
            values = gathered.setdefault(base, [NAN] * len(getattr(term, base)))
            values[int(at)] = float(value)
        elif name in term.parameters():
            gathered[name] = float(value)
    return gathered


def _mean_errors(samples: Samples, model: Composite) -> dict[int, dict[str, Any]]:
    """Return errors of the level, and of coefficients and lags of the mean, by term index."""
    terms = model.gaussian.terms
    where = [(k, j) for k, term in enumerate(terms) for j in range(len(coefficients(term)))]
    lags = {k: term for k, term in enumerate(terms)
            if isinstance(term, LoadTransient) and not term.delay}
    moved = [replace(term, tau=term.tau * math.exp(by)) for term in lags.values()
             for by in (_STEP, -_STEP)]
    try:
        columns = whitened(samples, terms, moved, own=True)[:, 1:]
    except (ValueError, ArithmeticError):
        # Without its events, the filter of the model is singular.
        return {k: dict.fromkeys(terms[k].LINEAR, math.inf) for k, _ in where}
    through, rest = columns[:, :len(where)], columns[:, len(where):]
    for k in lags:
        # The derivative of the mean with respect to ln(tau).
        beta = np.array(coefficients(terms[k])) / (2.0 * _STEP)
        slope = rest[:, :2 * beta.size] @ np.append(beta, -beta)
        through, rest = np.column_stack((through, slope)), rest[:, 2 * beta.size:]
    norm = np.sqrt((through * through).sum(axis=0))
    # Parameters hidden by the instrument (the level behind a high-pass) have no error.
    norm = np.where(norm > 1e-9 * norm.max(), norm, np.inf)
    through /= norm
    covariance = np.linalg.pinv(through.T @ through) / np.outer(norm, norm)
    covariance *= follows_time(samples) or 1.0
    found: dict[int, dict[str, Any]] = {}
    for k, term in enumerate(terms):
        at = [column for column, (owner, _) in enumerate(where) if owner == k]
        if at:
            found[k] = _by_parameter(term, covariance[np.ix_(at, at)])
    for k, variance in zip(lags, covariance.diagonal()[len(where):].tolist()):
        found[k]['tau'] = lags[k].tau * math.sqrt(variance)
    return found


def _by_parameter(term: Term, covariance: FloatArray) -> dict[str, Any]:
    """Return errors of parameters from the covariance of the coefficients."""
    if isinstance(term, OU):
        return {'u0': math.sqrt(max(float(covariance[0, 0]), 0.0))}
    names = [name for name in term.LINEAR if not isinstance(getattr(term, name), tuple)]

    def values(beta: FloatArray) -> FloatArray:
        moved = term.with_linear(beta.tolist())
        return np.array([getattr(moved, name) for name in names])

    beta = np.array(coefficients(term))
    steps = 1e-3 * np.sqrt(np.maximum(covariance.diagonal(), 0.0))
    slopes = np.stack([(values(beta + by) - values(beta - by)) / max(2.0 * float(by.max()), 1e-300)
                       for by in np.diag(steps)], axis=1)
    variance = np.einsum('ij,jk,ik->i', slopes, covariance, slopes).tolist()
    return {name: math.sqrt(value) for name, value in zip(names, variance) if value > 0.0}
