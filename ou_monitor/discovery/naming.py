"""
Which causes a recording shows: candidates are fitted, scored, and criticised again.

Measured inputs come before anything latent; a cause stays only while it is
needed beside the others; causes that do as well are told with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math

import numpy as np
from ou_monitor.criticism.battery import is_sign
from ou_monitor.criticism.composite import Composite, view_of
from ou_monitor.criticism.null_bank import NullBank
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery.fitting import best_start, fitted, joined
from ou_monitor.discovery.gain import BLOCKS, mean_difference
from ou_monitor.discovery.trials import (
    anything, criticise, MOST_WORK, refined, ROUGH, tier_of, TIERS, Trial, trials_of)
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.load_dependent_sigma import LoadDependentSigma
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.model.terms.tone import lines_of, Tone

# Evidence from which a cause is accepted, nats; the same for a mean that answers to what
# was measured, which every flight has some of.
ACCEPT, ACCEPT_MEAN = 6.0, 3.0
# Causes within this of the best cannot be told from it here, nats.
TIE = 3.0
# Evidence from which a measured cause stays when others have come, nats.
NEEDED = 0.0
# Gain in its standard errors from which it is not by chance of a few stretches.
_STEADY, _RAGGED = 4.0, 8.0
# Share of the stretches that gain, from which a gain is throughout: by chance once in 100.
_MOSTLY = 0.75
# Causes accepted at most, of these what no input was measured for, and lines that
# come with a tone.
MOST, MOST_LATENT, MOST_LINES = 8, 3, 12
# Share of the misfit that a latent cause must take away for the search to go on,
# and misfit (squares of statistics that are off) that is too little to ask so.
_SHARE, _LITTLE = 0.5, 100.0


@dataclass(eq=False)
class Search:
    """
    What the search has come to.

    Attributes
    ----------
    composite : Composite
        The model so far.
    accepted : list of str
        Causes in the order of their acceptance.
    rivals : dict of str to list of str
        For each cause, those that did as well in its round.
    log : list of str
        What was tried and what came of it, one line each.
    removed : list of str
        Causes taken out again: others that came later do what they did.
    largest : float
        Largest evidence of an accepted cause, nats.
    stopped : bool
        Whether the search ended because it took too long.

    """

    composite: Composite
    accepted: list[str] = field(default_factory=list)
    rivals: dict[str, list[str]] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    largest: float = 0.0
    stopped: bool = False


def name_causes(samples: Samples, baseline: Composite, bank: NullBank, *,
                given: Sequence[str] = (), latent: bool = True,
                progress: Callable[[float], None] | None = None) -> Search:
    """Accept causes one after the other, the best first."""
    search = Search(fitted(samples, baseline.terms, baseline) or baseline)
    values = criticise(samples, search.composite, bank)
    only, reformed = '', False
    for turn in range(MOST):
        if progress is not None:
            progress(turn / MOST)
        trials, good = [], []
        hidden = {name for name in search.accepted if not catalogue()[name].MEASURED}
        for tier in range(TIERS if latent and len(hidden) < MOST_LATENT else 1):
            # Measured inputs first: what is latent can imitate them, and costs more.
            trials += trials_of(samples, search.composite, values, given, tier, bank, only)
            good = [trial for trial in trials if trial.evidence > _least(trial.name, search)
                    and (not (catalogue()[trial.name].MEASURED and _ragged(values))
                         or _throughout(trial.composite, search.composite))]
            if good:
                break
            if tier == 0 and not reformed and anything(values):
                # Before anything latent mends what the form of a measured cause leaves.
                reformed = True
                if _reform(samples, search):
                    values = criticise(samples, search.composite, bank)
        if not good:
            break
        trials = refined(samples, search.composite, trials)
        named = {trial.name for trial in good}
        best = next(trial for trial in trials if trial.name in named)
        search.rivals[best.name] = [
            trial.name for trial in trials
            if trial.name != best.name and trial.evidence > best.evidence - TIE]
        search.log.append(f'{best.name}: {best.evidence:.1f} nats; '
                          + ', '.join(f'{t.name} {t.evidence:.1f}' for t in trials[:6]
                                      if t is not best))
        search.composite = best.composite
        search.accepted += [name for name in (best.beside, best.name) if name]
        search.largest = max(search.largest, best.evidence)
        _other_means(samples, search, trials)
        after = criticise(samples, search.composite, bank)
        if best.name == 'tone':
            after = _more_lines(samples, search, after, bank)
        _prune(samples, search)
        if tier_of(catalogue()[best.name], values) > 0 and not (
                _helped(values, after) or _helped(values, after, catalogue()[best.name])):
            # What is wrong here may not be in the catalogue: other terms would dress
            # it up.  Only one more of the kind may still be missing.
            search.log.append(f'{best.name} leaves most of what is wrong')
            if not catalogue()[best.name].RECURS or only:
                break
            only = best.name
        values = after
        if samples.work[0] > MOST_WORK:
            break
    search.stopped = samples.work[0] > MOST_WORK
    return search


def _least(name: str, search: Search) -> float:
    """Return the evidence from which a cause is accepted."""
    kind = catalogue()[name]
    if kind.LEAST_SHARE:
        return max(ACCEPT, kind.LEAST_SHARE * search.largest)
    return ACCEPT_MEAN if kind.MEASURED and kind.ROLE is Role.MEAN else ACCEPT


def _ragged(values: dict[str, float]) -> bool:
    """Return whether likelihoods count some samples too much: scores are far from normal."""
    return any(name.startswith(('kurtosis', 'tails', 'clustering')) and value > _RAGGED
               for name, value in values.items())


def _throughout(new: Composite, old: Composite) -> bool:
    """Return whether a gain is more than stretches differ in, or is there in most of them."""
    mean, error = mean_difference(new.density, old.density)
    gains = [float(part.sum()) for part in np.array_split(new.density - old.density, BLOCKS)]
    return not mean <= _STEADY * error or sum(gain > 0.0 for gain in gains) >= _MOSTLY * BLOCKS


def _other_means(samples: Samples, search: Search, trials: Sequence[Trial]) -> None:
    """Accept what else in the mean answers to what was measured, before alpha takes its place."""
    last = search.accepted[-1]
    for trial in trials:
        kind = catalogue()[trial.name]
        if trial.name == last or kind.ROLE is not Role.MEAN or not kind.MEASURED or (
                trial.evidence < _least(trial.name, search) or not catalogue()[last].MEASURED):
            continue
        composite = search.composite
        view = view_of(samples, composite.gaussian, composite.z, samples.train)
        made = best_start(samples, composite, kind, view)
        gain = -math.inf if made is None else made.score(samples) - composite.score(samples)
        if made is not None and gain > _least(trial.name, search):
            search.log.append(f'{trial.name}: {gain:.1f} nats beside it')
            search.composite = made
            search.accepted.append(trial.name)
            search.rivals.setdefault(trial.name, [])


def _more_lines(samples: Samples, search: Search, values: dict[str, float], bank: NullBank
                ) -> dict[str, float]:
    """Add the lines that come with the one accepted last, as harmonics do; return what is left."""
    composite = search.composite
    view = view_of(samples, composite.gaussian, composite.z, samples.train)
    # An amplitude, a phase, and what was searched for the frequency.
    price = math.log(samples.train.stop) + Tone.SEARCH
    # A line of the scores, which have variance 1, gains n rms^2 / 2 nats.
    lines = [Tone.at(line, view) for line in lines_of(view)[:MOST_LINES]
             if 0.5 * samples.n * line.rms ** 2 > price + ACCEPT]
    made = joined(samples, composite, lines, rough=True) if lines else None
    if made is None or made.score(samples) - composite.score(samples) < ACCEPT * len(lines):
        return values
    search.log.append(f'{len(lines)} more lines')
    search.composite = made
    search.accepted += [Tone.NAME] * len(lines)
    return criticise(samples, made, bank)


def _helped(before: dict[str, float], after: dict[str, float],
            kind: type[Term] | None = None) -> bool:
    """Return whether what is off has come nearer: all of it, or what asks for a kind."""
    asking = {name for name, value in before.items()
              if kind is None or any(is_sign(sign, name, value) for sign in kind.SIGNS)}

    def misfit(values: dict[str, float]) -> float:
        return sum(value**2 for name, value in values.items()
                   if name in asking and abs(value) > 4.0)

    left = misfit(after)
    return left < _LITTLE or left < (1.0 - _SHARE) * misfit(before)


def _reform(samples: Samples, search: Search) -> bool:
    """Look for better knots of sigma(throttle) beside all else; return whether there are any."""
    composite = search.composite
    index = next((k for k, term in enumerate(composite.terms)
                  if isinstance(term, LoadDependentSigma)), None)
    if index is None:
        return False
    term = composite.terms[index]
    assert isinstance(term, LoadDependentSigma)
    view = view_of(samples, composite.gaussian, composite.gaussian.z, samples.train)
    for start in term.candidates(term.relative(view)):
        terms = [*composite.terms[:index], start, *composite.terms[index + 1:]]
        made = fitted(samples, terms, composite)
        if made is not None and made.score(samples) > search.composite.score(samples) + TIE:
            search.composite = made
    return search.composite is not composite


def _prune(samples: Samples, search: Search) -> None:
    """Take out causes that are not needed beside those accepted since."""
    full = search.composite.score(samples)
    last = catalogue()[search.accepted[-1]]
    for name in search.accepted[:-1]:
        kind = catalogue()[name]
        if last.ROLE is Role.LAW and kind.MEASURED and kind.FAMILY != last.FAMILY:
            # Another law of the noise is no reason to doubt what answers to an input, unless
            # it is the intensity that wanders: by chance with throttle.
            continue
        index = next(k for k, term in enumerate(search.composite.terms) if term.NAME == name)
        kept = [term for k, term in enumerate(search.composite.terms) if k != index]
        same = search.composite if search.composite.terms[index].ROLE is not Role.LAW else None
        less = fitted(samples, kept, same, rough=True)
        # What was measured stays unless it is worth less than it costs.
        needed = NEEDED if catalogue()[name].MEASURED else TIE
        if less is not None and full - less.score(samples) < needed + ROUGH:
            less = fitted(samples, kept, less)
        if less is not None and full - less.score(samples) < needed:
            plain = _plainer(samples, search.composite, index)
            if plain is not None and plain.score(samples) - less.score(samples) > needed:
                search.log.append(f'{name} in a simpler form')
                search.composite, full = plain, plain.score(samples)
                continue
            search.log.append(f'{name} is not needed any more: {full - less.score(samples):.1f}')
            search.composite = less
            search.accepted.remove(name)
            search.removed.append(name)
            full = less.score(samples)


def _plainer(samples: Samples, composite: Composite, index: int) -> Composite | None:
    """Return the fit with one term in its simplest form; None where it is that already."""
    term = composite.terms[index]
    view = view_of(samples, composite.gaussian, composite.z, samples.train)

    def size(start: Term) -> int:
        return len(start.free()) + len(start.LINEAR)

    forms = sorted(type(term).simplest(view), key=size)
    if not forms or size(forms[0]) >= size(term):
        return None
    return fitted(samples, [*composite.terms[:index], forms[0], *composite.terms[index + 1:]],
                  None)
