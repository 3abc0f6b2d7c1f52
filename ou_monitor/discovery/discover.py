"""A recording -> errors of its simulation, their causes, and the gain of the extended model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.analysis.noise import rise_at
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.integrity import examine, Integrity
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import criticise, family_chance, family_edge
from ou_monitor.criticism.structure import within_range
from ou_monitor.discovery.decision import relaxes
from ou_monitor.discovery.finding import Cause, Criticism, Finding, LoadFall, LowDips, Verdict
from ou_monitor.discovery.fitting import (
    COLLINEAR, Fitter, follows_time, standard_errors, with_reach)
from ou_monitor.discovery.gain import (
    covered, gain_of, growth_of, guess, held_out, mean_score, shrink_of, why_unknown, without)
from ou_monitor.discovery.load_effects import load_fall, low_dips
from ou_monitor.discovery.named import (
    FittedSearch, Named, named_causes, prune_by_gain, Pruned, refusal)
from ou_monitor.discovery.redraw import redraw_clipped, redraw_within_codes
from ou_monitor.discovery.regression import load_terms
from ou_monitor.discovery.search import position, Progress, Search, under_load, whole_load
from ou_monitor.discovery.words import (
    collinear_note, coupling_note, explain, left_out_note, NO_OTHER, no_relaxation_note, VAGUE,
    verdict_words)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.catalogue import blamed, catalogue, left_out, withdraw
from ou_monitor.model.terms.load_response import LoadTransient, SHORTEST
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import Saturation
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import Recording
from ou_monitor.text import listed, number, Z95

# Why the gain of a line above the Nyquist frequency of the samples used is unknown.
FAST = 'the rate of the samples used is too low to show this line.'
# Alternations between drawing clipped or coarse samples and fitting the load to them.
_REDRAWN = 3
# Number of these alternations that also choose the terms of the load: first from the codes, then
# from readings drawn within the codes.
_SEARCHED = 2


def discover(recording: Recording, *, seed: int = 0,
             progress: Progress | None = None) -> Finding:
    """Criticise a recording's simulation, name causes, extend its model: `ou_monitor.discover`."""
    while True:
        try:
            found = _discover(recording, seed, progress)
            return replace(found, notes=(*found.notes, *left_out().values()))
        except Exception as error:
            # A cause from another package may fail anywhere: repeat without it, and note that.
            if not withdraw(error):
                raise


def _discover(recording: Recording, seed: int, progress: Progress | None) -> Finding:
    done: Progress = progress or (lambda share: None)
    state = examine(recording, lambda share: done(0.05 * share))
    samples = state.samples
    if samples is None:
        return _insufficient(recording, state, state.reason, seed)
    rng = np.random.default_rng(seed)
    try:
        start = _start(samples, state)
        if state.drawn is not None:
            samples, start = _without_clipping(samples, state, start)
        # Name causes from readings drawn within the ADC's codes, but score them on logged codes.
        inside, start, loaded = _within_codes(samples, state, start) if samples.cell else (
            samples, start, None)
        done(0.1)
        named = named_causes(inside, start, rng, state.exact,
                             lambda share: done(0.1 + 0.5 * share), loaded)
        found = named.found
        model, names = (found.whole, found.search.accepted) if inside is samples else (
            _fit_to_codes(samples, state, found))
        alone = _refitted(samples, [guess(samples)])
        assert alone is not None
        plain = held_out(samples, alone)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        if blamed(error):
            raise
        return _insufficient(recording, state, 'No OU can be fitted and simulated: hardly any '
                             'samples differ, or some are far from all others.', seed)
    done(0.6)
    scored = covered(samples)
    uncovered = samples.n - int(scored.sum())
    if state.drawn is not None:
        scored &= ~state.drawn
    left = prune_by_gain(samples, model, names, plain, scored,
                         lambda share: done(0.6 + 0.3 * share))
    whole = left.full.model
    after, accepted = found.after, found.search.accepted
    if len(left.names) < len(accepted):
        less = whole if inside is samples else _refitted(
            inside, [term for term in whole.terms if term.NAME != 'quantization'])
        after = after if less is None else criticise(inside, less, named.bank)
    dropped = (*named.dropped, *left.out, *(name for name in accepted if name not in names))
    se = tuple(with_reach(term, found, samples) for term, found in zip(
        whole.terms, standard_errors(samples, whole), strict=True))
    done(0.95)
    load = 'current' if math.isfinite(state.full) else 'throttle'
    causes = _causes(samples, state, left, se, scored, found.search.rivals, load)
    gain, gain_se = gain_of(left.full, plain, scored)
    unknown = why_unknown(left.full, plain, scored, load if uncovered else None)
    why = unknown or ('' if math.isfinite(gain) else VAGUE)
    criticism = _criticism(named.before, after)
    growth = growth_of(left.full, plain, scored)
    larger = growth > 1.0
    refused = refusal(samples, whole.terms, gain, gain_se, growth > Z95) if causes else ''
    # The effects of other exact terms were removed from the samples; the model includes them.
    undone = tuple(t for t in state.exact if t.NAME != 'quantization')
    baseline = plain.model.terms[0]
    assert isinstance(baseline, OU)
    dips = low_dips(samples, rise_at(recording, samples.t), (baseline,), whole.terms, rng)
    fall = load_fall(samples, whole.terms)
    against = doubts(whole.terms, dips, recording.duration,
                     float(np.median(samples.step[1:])), larger, fall,
                     _of_the_path(whole, samples), load) if causes else ()
    verdict = judge([c for c in criticism if c.is_off], len(causes), against)
    done(1.0)
    finding = Finding(
        recording=recording.name, n=recording.n, duration=recording.duration, verdict=verdict,
        baseline=baseline, baseline_score=mean_score(plain.density, scored & plain.known),
        criticism=criticism, causes=causes, model=SupplyModel((*whole.terms, *undone)),
        se=(*se, *(with_reach(term, {}, samples) for term in undone)),
        score=mean_score(left.full.density, scored & left.full.known),
        gain=gain, gain_se=gain_se, shrink=shrink_of(left.full, plain, scored), larger=larger,
        dips=dips, fall=fall,
        notes=(*state.notes, *_notes(named, whole, dropped, samples, uncovered, load)),
        samples=samples, simulated=SupplyModel(whole.terms), refused=refused,
        full=state.full, has_throttle=recording.has_throttle, seed=seed)
    return replace(finding, words=verdict_words(
        finding, why, tuple(named.dropped), uncovered, against))


def _insufficient(recording: Recording, state: Integrity, reason: str, seed: int) -> Finding:
    return Finding(
        recording=recording.name, n=recording.n, duration=recording.duration,
        verdict=Verdict.INSUFFICIENT_DATA, words=('This recording cannot be judged.', reason),
        notes=state.notes, has_throttle=recording.has_throttle, seed=seed)


def _start(samples: Samples, state: Integrity) -> Composite:
    """Return the initial model of the search: an OU, and exact noise terms."""
    clean = fit_composite(samples, [guess(samples)], samples.train)
    assert clean is not None
    steps = [term for term in state.exact if term.ROLE is Role.NOISE and samples.cell]
    start = fit_composite(samples, [clean.terms[0], *steps], samples.train) if steps else clean
    assert start is not None
    return start


def _without_clipping(samples: Samples, state: Integrity, start: Composite
                      ) -> tuple[Samples, Composite]:
    """Return the samples with clipped ones redrawn, and the start of the search."""
    assert state.drawn is not None
    ends = next(term for term in state.exact if isinstance(term, Saturation))
    rng = np.random.default_rng(0)
    for _ in range(_REDRAWN):
        model = whole_load(Fitter(samples), start, load_terms(samples)) or start
        samples = redraw_clipped(samples, model, ends, state.drawn, rng)
        start = _start(samples, state)
    return samples, start


def _within_codes(samples: Samples, state: Integrity, start: Composite
                  ) -> tuple[Samples, Composite, tuple[Fitter, Search] | None]:
    """Return the samples drawn within coarse codes, the start of the search, and its load."""
    rng, inside, model, loaded = np.random.default_rng(0), samples, start, None
    for turn in range(_REDRAWN):
        if turn < _SEARCHED:
            # Use the terms of the load that have evidence: readings drawn from a model with all
            # terms would confirm each of them.
            loaded = under_load(inside, start)
            model = loaded[1].composite
        else:
            model = Fitter(inside).fit(model.terms, model) or model
        drawn = redraw_within_codes(samples, model, rng)
        if drawn is samples:
            break
        inside, start, loaded = drawn, _start(drawn, state), None
    return inside, start, loaded


def _fit_to_codes(samples: Samples, state: Integrity, found: FittedSearch
                  ) -> tuple[Composite, list[str]]:
    """Fit the named model to the codes; return it and its causes, without terms that fail."""
    steps = [term for term in state.exact if term.ROLE is Role.NOISE]
    terms, names = list(found.whole.terms), list(found.search.accepted)
    while True:
        try:
            model = _refitted(samples, [terms[0], *steps, *terms[1:]])
        except (ValueError, ArithmeticError, np.linalg.LinAlgError):
            # Parameters out of range, or an overflow.
            model = None
        if model is not None:
            return model, names
        if len(terms) == 1:
            raise ArithmeticError('the model within codes does not fit the codes')
        names.remove(terms.pop().NAME)


def _refitted(samples: Samples, terms: Sequence[Term]) -> Composite | None:
    """Return terms fitted to everything; None if a law cannot be fitted."""
    return fit_composite(samples, terms, slice(0, samples.n))


def _causes(samples: Samples, state: Integrity, left: Pruned, se: tuple[dict[str, Any], ...],
            scored: npt.NDArray[np.bool_], rivals: Mapping[str, list[str]], load: str
            ) -> tuple[Cause, ...]:
    """Return all causes: exact findings first, then the causes that the search named."""
    # The gain of a cause is what the model loses when refitted without it.  If there are many
    # causes of one kind (harmonics of a line), they are left out together and share one gain.
    # Repeats, clipping and wrong stamps are corrected in the samples of both models: no gain.
    found: list[Cause] = []
    model = left.full.model
    for term in state.exact:
        why = ''
        if term.ROLE is Role.NOISE:
            # A model reduced to the plain OU does not have this term.
            index = next((i for i, t in enumerate(model.terms) if t.NAME == term.NAME), None)
            less = None if index is None else without(samples, model, index)
            gain, error = (math.nan, math.nan) if less is None else gain_of(
                left.full, held_out(samples, less), scored)
            why = '' if math.isfinite(gain) else NO_OTHER if less is None else VAGUE
        elif term.FAMILY == 'line':
            gain, error, why = math.nan, math.nan, FAST
        else:
            gain, error = 0.0, 0.0
        shown = with_reach(term, {}, samples)
        found.append(Cause(term, shown, gain, error, 0.0, (),
                           explain(term, shown, (), True, why, load=load), True))
    for k, name in enumerate(left.names):
        worth, index = left.worth[k], position(model, left.names, k)
        why = '' if math.isfinite(worth.gain) else NO_OTHER if worth.less is None else (
            why_unknown(left.full, worth.less, scored,
                        load if catalogue()[name].NEEDS_THROTTLE else None) or VAGUE)
        others = tuple(dict.fromkeys(rivals.get(name, ())))
        term = model.terms[index]
        found.append(Cause(
            term, se[index], worth.gain, worth.error, worth.chance, others,
            explain(term, se[index], others, False, why, worth.size, load), False))
    return tuple(found)


def _criticism(before: Mapping[str, float], after: Mapping[str, float]) -> tuple[Criticism, ...]:
    """Return all statistics, with their band at the family-wise level `NOTHING`."""
    count = len(before)
    edge = family_edge(NOTHING, count)
    return tuple(Criticism(
        name, value, after.get(name, math.nan), -edge, edge, family_chance(value, count),
        family_chance(after[name], count) if name in after else math.nan)
        for name, value in before.items())


def _notes(named: Named, model: Composite, dropped: Sequence[str], samples: Samples,
           uncovered: int, load: str) -> tuple[str, ...]:
    """Return notes: withdrawn causes, and undecided questions."""
    notes = [named.failure] if named.failure else []
    for name in dict.fromkeys(dropped):
        one = f"A further '{name}'" if model.has(name) else f"'{name}'"
        notes.append(f'{one} was fitted, but {named.dropped[name]}: withdrawn.'
                     if name in named.dropped else
                     f'{one} was fitted, but did not improve predictions of held-out samples, '
                     'or its size is not determined: left out.')
    if uncovered:
        notes.append(left_out_note(uncovered, samples.n - uncovered, load))
    if model.has('load_sag') and follows_time(samples):
        notes.append(collinear_note(follows_time(samples), COLLINEAR, load))
    duration = float(samples.t[-1] - samples.t[0])
    ou = model.terms[0]
    assert isinstance(ou, OU)
    step = float(np.median(samples.step[1:]))
    # Whether chance alone makes the correlation between samples as large.
    if math.exp(-ou.alpha * step) < Z95 / math.sqrt(samples.n):
        notes.append(no_relaxation_note(step))
    elif relaxes(ou.alpha, duration) and not any(
            model.has(name) for name in ('ac_coupling', 'load_sag', 'drift')):
        # A lasting sag or drift would rule out an AC coupling.
        notes.append(coupling_note(ou.alpha, duration, samples.n))
    return tuple(notes)


# Probability that any statistic of a correct model lies outside its band.
NOTHING = 0.01
# Step by which a parameter is moved to see whether it is at the end of its range.
_STEP = 1e-4


def judge(remaining: Sequence[Criticism], causes: int, doubts: Sequence[str] = ()) -> Verdict:
    """Return the verdict, from the number of causes, remaining statistics and doubts."""
    if causes == 0:
        return Verdict.UNEXPLAINED if remaining else Verdict.NO_EFFECT
    return Verdict.PARTLY_EXPLAINED if remaining or doubts else Verdict.EXPLAINED


def doubts(terms: Sequence[Term], dips: LowDips, duration: float, step: float,
           larger: bool = False, fall: LoadFall = LoadFall(), more: Sequence[str] = (),
           load: str = 'throttle') -> tuple[str, ...]:
    """Return objections to a model besides its statistics, in words (times in s)."""
    # larger: whether one-step errors of the model are larger than the plain OU's.
    found = ['its one-step errors are larger than those of the plain OU'] if larger else []
    if dips.worse:
        found.append(f'it dips below {dips.level:g} V {number(dips.extended)} times a minute; the '
                     f'recording does so {number(dips.observed)} times, and the plain OU '
                     f'{number(dips.baseline)} times')
    if not fall.fits:
        found.append(f'its voltage falls by {number(fall.explained, 2)} V from low to high '
                     f'{load}; the readings fall by {number(fall.measured, 2)} V')
    ends = [f'{name} of {term.NAME}' for term in terms for name in _at_ends(term, duration, step)]
    if ends:
        found.append(f'{listed(ends)} {"are" if ends[1:] else "is"} at the end of the range')
    return (*found, *more)


def _of_the_path(model: Composite, samples: Samples) -> list[str]:
    """Return objections of the terms to the path of states or levels that their laws found."""
    path = model.offset if model.offset is not None else (
        None if model.events is None else np.log(model.events.power))
    said = [] if path is None else [term.objection(path, samples.t) for term in model.terms]
    return [one for one in said if one]


def _at_ends(term: Term, duration: float, step: float) -> list[str]:
    """Return the parameters of a term at the end of their range."""
    if isinstance(term, LoadTransient) and not term.delay:
        return [] if SHORTEST * step < term.tau < 0.25 * duration else ['tau']
    return [name for name in term.free()
            if any(within_range(term, name, by) == term for by in (-_STEP, _STEP))]
