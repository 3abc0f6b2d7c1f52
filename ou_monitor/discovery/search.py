"""
The search for the causes that a recording shows.

It begins with the response of the mean to throttle and time, and with the noise under load: on
real flights they make up nearly all of the variance and hide everything else.  In each round,
every candidate of the catalogue is then added to the model and fitted, and the one with most
evidence is accepted.  Causes no longer worth their penalty are removed, and one of `LAWS` may be
exchanged for a better one.  Measured inputs come before latent causes, which can imitate them;
causes that tie become alternatives.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
import math

import numpy as np
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import criticise, NullBank
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter, is_trend, Trial
from ou_monitor.discovery.gain import BLOCKS, complete
from ou_monitor.discovery.regression import load_terms, mean_response, STARTS
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import catalogue, every_kind
from ou_monitor.model.terms.load_response import (
    LoadDependentAlpha, LoadDependentNoise, LoadDependentSigma, LoadSag)
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.term import NEXT_TO_ZERO, Role, Term
from ou_monitor.model.terms.tones import lines_of, Tone
from ou_monitor.records import FloatArray
from ou_monitor.text import Z95

Progress = Callable[[float], None]

# Terms by which noise or alpha depends on throttle.  Their effects on one-step errors are similar,
# so one may be exchanged for another.
LAWS: tuple[type[Term], ...] = (LoadDependentSigma, LoadDependentNoise, LoadDependentAlpha)
# Intensity over throttle: a further term of it may only correct the form of one of these.
_CURVES = LoadDependentSigma.NAME, LoadDependentNoise.NAME
# Maximum loss of a fit with few rounds, nats.
_ROUGH = 20.0
# If the best fit of a round takes less time than this, s, the response to load is chosen anew.
_SOON = 1.0
# Maximum rounds that add lines to a tone (three motors or converters, each with harmonics), and
# maximum lines added in one round.
_LINE_TURNS, _MOST_LINES = 3, 12


@dataclass(eq=False)
class Search:
    """State of the search."""

    composite: Composite  # The model so far
    accepted: list[str] = field(default_factory=list)  # Causes in the order of their acceptance
    # For each cause, the causes that tied in its round.
    rivals: dict[str, list[str]] = field(default_factory=dict)
    # For each latent cause, the statistics before it was accepted.
    before_accepted: dict[str, Mapping[str, float]] = field(default_factory=dict)

    def copy(self) -> Search:
        """Return an independent copy of the search."""
        return replace(self, accepted=list(self.accepted), rivals=dict(self.rivals),
                       before_accepted=dict(self.before_accepted))


def name_causes(fitter: Fitter, search: Search, bank: NullBank, *,
                given: Sequence[str] = (), latent: bool = True,
                progress: Progress | None = None) -> None:
    """Accept causes one after the other, the best first."""
    # Causes that were accepted and removed: without this list, they would be accepted again.
    removed: list[str] = []
    for turn in range(decision.MOST):
        if progress is not None:
            progress(turn / decision.MOST)
        if fitter.cost > 2.0 * decision.MOST_COST:
            break
        trials = _round(fitter, search, bank, [*given, *removed], latent)
        if not trials:
            break
        best = trials[0]
        if decision.is_latent(catalogue()[best.name]):
            search.before_accepted[best.name] = criticise(fitter.samples, search.composite, bank)
        search.rivals[best.name] = decision.rivals_of(
            best.name, [(trial.name, trial.evidence) for trial in trials])
        search.composite = best.composite
        search.accepted += [name for name in (best.beside, best.name) if name]
        if catalogue()[best.name].ROLE is Role.LAW or catalogue()[best.name].FAMILY == 'line':
            # Outliers and lines may have hidden smaller effects until now: try all kinds again.
            fitter.failed.clear()
        if best.composite.gaussian.cost < _SOON:
            choose_response(fitter, search, ())
        if best.name == Tone.NAME:
            # Weaker lines become visible once the strongest is in the model.
            for _ in range(_LINE_TURNS):
                if not _more_lines(fitter, search):
                    break
        backward(fitter, search)
        if best.name not in search.accepted:
            removed.append(best.name)


def backward(fitter: Fitter, search: Search) -> None:
    """Remove or exchange causes, the best change first, until none gains."""
    for _ in range(2 * decision.MOST):
        if not _make_best_move(fitter, search):
            return


def without_causes(fitter: Fitter, search: Search, out: Sequence[int]) -> Search | None:
    """Return the search without some of its causes; None if the fit fails."""
    at = {position(search.composite, search.accepted, k) for k in out}
    kept = [term for k, term in enumerate(search.composite.terms) if k not in at]
    fit = fitter.fit(kept, None) or fitter.fit(kept, search.composite)
    return None if fit is None else replace(search.copy(), composite=fit, accepted=[
        name for k, name in enumerate(search.accepted) if k not in out])


def choose_response(fitter: Fitter, search: Search, start: Sequence[Term]) -> None:
    """Choose the measured terms of the mean again, given the noise found so far."""
    composite = search.composite
    response = mean_response(fitter.samples, composite, fitter.view(composite), start)
    own = [term for term in composite.terms if decision.is_response(type(term))]
    shapes, others = ([term.with_linear([NEXT_TO_ZERO] * len(term.LINEAR)) for term in terms]
                      for terms in (own, response.terms))
    if not start and len(shapes) == len(others) and all(one in shapes for one in others):
        return
    structural = [term for term in composite.terms
                  if term.ROLE is not Role.LAW and not decision.is_response(type(term))]
    laws = [term for term in composite.terms if term.ROLE is Role.LAW]
    gone = {term.NAME for term in own} - {term.NAME for term in response.terms}
    # An `ou` that is itself a trend must not take the place of a drift.
    kept = [term for term in own if term.NAME in gone and term.FAMILY == 'slow'] if is_trend(
        fitter.samples, composite) else []
    fit = fitter.fit([*structural, *response.terms, *kept, *laws], composite)
    if fit is None or (not start and fitter.evidence(fit) < fitter.evidence(composite)):
        return
    search.composite = fit
    before = [name for name in search.accepted if decision.is_response(catalogue()[name])]
    names = [term.NAME for term in (*response.terms, *kept)]
    search.accepted = [*names, *(name for name in search.accepted if name not in before)]
    for term, rivals in zip(response.terms, response.rivals, strict=True):
        search.rivals[term.NAME] = list(rivals)


def position(model: Composite, names: Sequence[str], k: int) -> int:
    """Return the index in the model of the k-th cause; causes of a kind keep their order."""
    nth = list(names[:k]).count(names[k])
    return [i for i, term in enumerate(model.terms) if term.NAME == names[k]][nth]


def _round(fitter: Fitter, search: Search, bank: NullBank, given: Sequence[str], latent: bool
           ) -> list[Trial]:
    """Return the trials of a round that may be accepted, best first."""
    # A measured input comes before latent causes only if it gains throughout the recording: a few
    # outliers at one throttle can imitate a response.
    trials: list[Trial] = []
    for first in (True, False)[:1 + latent]:
        kinds = decision.kinds_to_try(
            every_kind(), [type(term) for term in search.composite.terms], given,
            fitter.samples.throttle is not None, first)
        trials += [trial for trial in fitter.trials(
            search.composite, kinds, lambda model: criticise(fitter.samples, model, bank))
                   if trial.evidence > _needed(
                       fitter, search.composite, trial.composite.last(trial.kind))]
        steady = [trial for trial in trials if decision.is_shared([
            float(part.sum()) for part in np.array_split(
                trial.composite.density - search.composite.density, BLOCKS)], Z95)]
        if first and steady:
            return sorted(steady, key=lambda trial: -trial.evidence)
    trials.sort(key=lambda trial: -trial.evidence)
    # In a tie, measured causes come first (a trend counts as measured, because time is).
    return sorted(trials, key=lambda trial: not (
        catalogue()[trial.name].MEASURED and trial.evidence > trials[0].evidence - decision.TIE))


def _needed(fitter: Fitter, model: Composite, term: Term, least: float = decision.ACCEPT) -> float:
    """Return the minimum evidence for adding a cause to a model, nats."""
    other = next((name for name in _CURVES if name != term.NAME and model.has(name)), '')
    if not other or not (term.NAME in _CURVES or (
            isinstance(term, LoadDependentAlpha) and term.sigma_slope)):
        return least
    less = _without(fitter, model, other)
    worth = fitter.evidence(model) - (0.0 if less is None else fitter.evidence(less))
    return max(least, decision.CURVE * worth)


def _more_lines(fitter: Fitter, search: Search) -> bool:
    """Add lines beside the one accepted last, such as its harmonics."""
    composite, samples = search.composite, fitter.samples
    view = fitter.view(composite)
    # Penalty for amplitude, phase, and the search for the frequency.
    penalty = math.log(samples.train.stop) + Tone.SEARCH
    # A line of the scores, with variance 1, gains n rms^2 / 2 nats.
    lines = [Tone.at(line, view) for line in lines_of(view)[:_MOST_LINES]
             if 0.5 * samples.n * line.rms ** 2 > penalty + decision.ACCEPT]
    fit = fitter.join(composite, lines) if lines else None
    if fit is None or (fitter.evidence(fit) - fitter.evidence(composite)
                       < decision.ACCEPT * len(lines)):
        return False
    search.composite = fit
    search.accepted += [Tone.NAME] * len(lines)
    return True


def _make_best_move(fitter: Fitter, search: Search) -> bool:
    """Make the best removal or exchange of one cause; return whether there was one."""
    value = fitter.evidence(search.composite)
    # Evidence above the required minimum, nats; cause; its replacement, empty for none; model.
    moves: list[tuple[float, str, str, Composite]] = []
    names = dict.fromkeys(name for name in search.accepted
                          if not decision.is_response(catalogue()[name]))
    swapped: dict[str, list[str]] = {name: [] for name in names if catalogue()[name] in LAWS}
    for name in names:
        less = _without(fitter, search.composite, name)
        if less is None:
            continue
        needed = _needed(fitter, less, search.composite.last(catalogue()[name]), decision.TIE)
        if value - fitter.evidence(less) < needed + _ROUGH:
            less = _refit(fitter, less)
        if fitter.holds(less):
            moves.append((needed - value + fitter.evidence(less), name, '', less))
        for kind in _replacements(less, name):
            found = fitter.best_start(less, kind, fitter.view(less))
            if found is None or fitter.evidence(found) < value - _ROUGH or not fitter.holds(found):
                continue
            found = _refit(fitter, found)
            moves.append((fitter.evidence(found) - value, name, kind.NAME, found))
            if moves[-1][0] > -decision.TIE and kind.NAME != name:
                swapped[name].append(kind.NAME)
    gain, gone, replacement, model = max(moves, default=(0.0, '', '', search.composite),
                                         key=lambda move: move[0])
    if not gain > 0.1:
        for name, others in swapped.items():
            search.rivals[name] = others
        return False
    at = len(search.accepted) - 1 - search.accepted[::-1].index(gone)
    search.accepted[at:at + 1] = [replacement] if replacement else []
    search.accepted = [name for name in search.accepted if model.has(name)]
    search.composite = model
    return True


def _replacements(less: Composite, name: str) -> list[type[Term]]:
    """Return possible replacements of one of `LAWS`: another one, or other knots."""
    return [kind for kind in LAWS if kind.NAME in catalogue() and not less.has(kind.NAME)
            and (kind.CHANGES is None or less.has(kind.CHANGES.NAME))
            and (kind.NAME != name or kind is LoadDependentSigma)
            ] if catalogue()[name] in LAWS else []


def _without(fitter: Fitter, composite: Composite, name: str) -> Composite | None:
    """Return the fit without the last term of a name and the terms that modify it."""
    terms = list(composite.terms)
    del terms[max(k for k, term in enumerate(terms) if term.NAME == name)]
    law = catalogue()[name].ROLE is Role.LAW
    return fitter.fit(complete(terms), None if law else composite, rough=True)


def _refit(fitter: Fitter, found: Composite) -> Composite:
    full = fitter.fit(found.terms, found)
    return full if full is not None and fitter.evidence(full) > fitter.evidence(found) else found


def _leaves_range(fitter: Fitter, model: Composite) -> bool:
    """Return whether sigma follows `LoadDependentNoise` and a simulation leaves the range."""
    # Quantile 1, the largest: without heavy tails even the farthest simulation should stay inside.
    follows = any(isinstance(term, LoadDependentNoise) and term.on_sigma for term in model.terms)
    return follows and outside_range(fitter.samples, model.terms, 1.0) > 0.0


# Initial rate of the slow residual of the load, 1/s; a fit that starts here converges to
# relaxation times from tenths of a second to minutes.
_SLOW = 1.0


def under_load(samples: Samples, start: Composite) -> tuple[Fitter, Search]:
    """Start from the load model: response to throttle, and noise that follows it, together."""
    fitter = Fitter(samples, start.cost)
    plain = fitter.fit(start.terms, start) or start
    # Without throttle, or in a short recording, the starts may be equal.
    loads = dict.fromkeys(load_terms(samples, lags) for lags in STARTS)
    found = [_from_load(fitter, plain, load) for load in loads]
    return fitter, max(found, key=lambda search: fitter.evidence(search.composite))


def _from_load(fitter: Fitter, plain: Composite, load: Sequence[Term]) -> Search:
    # If the terms were added one by one, each would absorb effects of the others.  Afterwards each
    # must be worth its own penalty.
    search = Search(plain)
    noisy = whole_load(fitter, plain, load)
    if noisy is None:
        choose_response(fitter, search, ())
        return search
    search.composite = noisy
    choose_response(fitter, search, load)
    if not any(catalogue()[name].FAMILY == LoadSag.FAMILY for name in search.accepted):
        # Throttle does not move the mean: the search tests the noise terms one by one.
        search.composite, search.accepted = plain, []
        choose_response(fitter, search, ())
        return search
    means = [term for term in search.composite.terms if decision.is_response(type(term))]
    bare = fitter.fit([*plain.terms, *means], plain)
    if bare is None:
        return search
    # Choose the noise terms again for the new mean, each by its own evidence.
    known = [term.NAME for term in plain.terms]
    best = _noise_beside(fitter, bare, on_sigma=True)
    if fitter.evidence(search.composite) > fitter.evidence(best):
        best = fitter.fit(search.composite.terms, search.composite) or search.composite
    search.composite = best
    for term in best.terms:
        if term.NAME not in known and not decision.is_response(type(term)):
            search.accepted.append(term.NAME)
            search.rivals.setdefault(term.NAME, [])
    backward(fitter, search)
    choose_response(fitter, search, ())
    return search


def whole_load(fitter: Fitter, plain: Composite, load: Sequence[Term]) -> Composite | None:
    """Return a model with all terms of a load and its noise; None without a load."""
    full = fitter.fit([*plain.terms, *load], plain, rough=True) if load else None
    return None if full is None else _noise_beside(fitter, full, on_sigma=False)


def _noise_beside(fitter: Fitter, composite: Composite, on_sigma: bool) -> Composite:
    """Return a model with the noise terms that have evidence."""
    # on_sigma: whether sigma may depend on throttle like the white noise; False until the response
    # to throttle is chosen, because noise with memory imitates a response.  Such a fit is rejected
    # if simulations leave the recorded range, which one-step predictions hardly constrain.
    best = composite
    ou = composite.terms[0]
    assert isinstance(ou, OU)
    error = math.sqrt(float(np.median(composite.gaussian.variance)))
    # Two starts: all noise as `ou`; a slow residual of the load, smaller than the white noise.
    slow = replace(ou, alpha=_SLOW, sigma=0.3 * error * math.sqrt(2.0 * _SLOW))
    while True:
        view = fitter.view(best)
        tried: list[Composite | None] = []
        for kind in (LoadDependentSigma, LoadDependentNoise, MeasurementNoise):
            if best.has(kind.NAME) or kind.NAME not in catalogue():
                continue
            starts = kind.candidates(view)
            groups = [[start] for start in starts[:1 + on_sigma]] if (
                kind is LoadDependentNoise) else [starts]
            tried += [fitter.best_start(best, kind, view, starts=group) for group in groups]
            if not best.has(MeasurementNoise.NAME) and kind is not LoadDependentSigma:
                white = MeasurementNoise(0.8 * error)
                for law in groups if kind is LoadDependentNoise else [()]:
                    tried.append(fitter.fit([slow, *best.terms[1:], white, *law], best,
                                            rough=True))
        top = max((found for found in tried
                   if found is not None and not _leaves_range(fitter, found)),
                  default=None, key=fitter.evidence)
        gain = -math.inf if top is None else fitter.evidence(top) - fitter.evidence(best)
        if top is None or gain < decision.ACCEPT:
            return best
        best = top


# Number of simulations whose range is compared, and margin on either side of the recorded range,
# as a share of it.  The extremes of two halves of a stationary flight differ by less; a wrong sag
# or a growing drift moves them by more.
_DRAWS, _MARGIN = 16, 0.5


def outside_range(samples: Samples, terms: Sequence[Term], share: float = 0.5) -> float:
    """Return how far simulated levels leave the recorded range, V (quantile `share` of draws)."""
    # The level is a running median of five samples, which ignores single bad samples.  With heavy
    # tails of index a, the extreme of a simulation of the right model is more than twice the
    # recorded one with probability 1/(1 + 2^a).  So with a = 2, one in five simulations leaves the
    # range and its margin, but their median does so in fewer than 1 % of recordings.
    rng, model = np.random.default_rng(0), SupplyModel(tuple(terms))

    def level(voltage: FloatArray) -> FloatArray:
        near = np.lib.stride_tricks.sliding_window_view(voltage, 5)
        return np.asarray(np.median(near, axis=1))

    return float(np.quantile([stray(level(model.simulate(samples.t, rng, samples.throttle)),
                                    samples.logged) for _ in range(_DRAWS)], share))


def stray(simulated: FloatArray, voltage: FloatArray) -> float:
    """Return how far simulations leave a recorded range and its margin, V; inf if not finite."""
    low, high = float(np.min(voltage)), float(np.max(voltage))
    room = _MARGIN * (high - low)
    if not np.isfinite(simulated).all():
        return math.inf
    return max(0.0, low - room - float(np.min(simulated)), float(np.max(simulated)) - high - room)
