"""A recording -> what the simulation gets wrong, why, and what the extended model gains."""

from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite, fit_composite
from ou_monitor.criticism.integrity import examine, Integrity
from ou_monitor.criticism.null_bank import family_chance
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate, fit_gaussian
from ou_monitor.discovery.decision import judge, NOTHING
from ou_monitor.discovery.errors import standard_errors
from ou_monitor.discovery.finding import Cause, Criticism, Finding, Verdict
from ou_monitor.discovery.gain import (
    cause_gain, crossing_rates, if_known, mean_difference, mean_score, Scale, without)
from ou_monitor.discovery.search import Named, named_causes, position, Progress
from ou_monitor.discovery.words import (
    coupling_found, coupling_note, explain, left_out_note, NO_OTHER, no_relaxation_note, VAGUE,
    verdict_sentence)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Role
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import FloatArray, Recording
from scipy.special import ndtri

# Why the gain of a line is not known that was found in all samples, of which some are used.
FAST = 'the samples that are used are too few to show a line so fast.'
# Steps of more relaxation times than this hide the relaxation.
_BLIND = 1.0
# Relaxation times in a recording from which its rate is one, and no trend.
_RELAXES = 20.0
# Causes of one kind from which their gain is measured together.
_MANY = 4


def discover(recording: Recording | str | Path, *, seed: int = 0,
             progress: Progress | None = None) -> Finding:
    """
    Criticise the simulation of a recording, name the cause, extend, measure the gain.

    Parameters
    ----------
    recording : Recording or path
        What to look at; a path is read as `read_recording` does.
    seed : int
        Same seed, same result.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Finding
        With `as_data` for JSON.

    Raises
    ------
    InputError
        When a path cannot be read.

    """
    if not isinstance(recording, Recording):
        recording = read_recording(recording)
    done: Progress = progress or (lambda share: None)
    state = examine(recording, lambda share: done(0.05 * share))
    samples = state.samples
    if samples is None:
        return _insufficient(recording, state, state.reason, seed)
    rng = np.random.default_rng(seed)
    try:
        plain, plain_density, start = _baseline(samples, state)
        done(0.1)
        named = named_causes(samples, start, rng, state.exact,
                             lambda share: done(0.1 + 0.6 * share))
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return _insufficient(recording, state, 'No OU can be fitted to it and simulated: hardly '
                             'any of its samples differ, or some are far beyond all others.',
                             seed)
    done(0.7)
    whole = named.whole
    se = standard_errors(samples, whole, named.part)
    done(0.75)
    scored = _kept(samples, state)
    scale = Scale(samples, named.model, scored)
    causes = _causes(samples, state, named, whole, se, start, plain_density, scale,
                     lambda share: done(0.75 + 0.2 * share))
    gain, gain_se = scale.gain(named.model.density, plain_density)
    unknown = scale.why_unknown()
    why = unknown or ('' if math.isfinite(gain) else VAGUE)
    verdict = judge(named.after, len(causes), len(named.dropped))
    criticism = _criticism(named.before, named.after)
    left = sorted((c for c in criticism if c.is_off), key=lambda c: -abs(c.after))
    # The other exact terms were undone in the samples; the model needs them again.
    undone = tuple(t for t in state.exact if t.NAME != 'quantization')
    crossing = crossing_rates(samples, (plain,), () if unknown else named.model.terms, rng)
    done(1.0)
    return Finding(
        recording=recording.name, n=recording.n, duration=recording.duration, verdict=verdict,
        sentence=verdict_sentence(verdict, causes, left, gain, gain_se, named.dropped, why,
                                  _uncovered(samples)),
        baseline=plain, baseline_score=mean_score(plain_density, scored), criticism=criticism,
        causes=causes, model=SupplyModel((*whole.terms, *undone)),
        se=(*se, *({} for _ in undone)), score=mean_score(named.model.density, scored),
        gain=gain, gain_se=gain_se, crossing=crossing, notes=_notes(state, named, samples),
        samples=samples, simulated=SupplyModel(whole.terms), seed=seed)


def _insufficient(recording: Recording, state: Integrity, reason: str, seed: int) -> Finding:
    return Finding(
        recording=recording.name, n=recording.n, duration=recording.duration,
        verdict=Verdict.INSUFFICIENT_DATA, sentence=f'Nothing can be said of it. {reason}',
        notes=state.notes, seed=seed)


def _kept(samples: Samples, state: Integrity) -> npt.NDArray[np.bool_]:
    """Return which samples are scored: those of `covered` that were measured."""
    kept = samples.covered
    return kept if state.drawn is None else kept & ~state.drawn


def _uncovered(samples: Samples) -> int:
    """Return the number of samples kept at throttle that the part fitted never had."""
    count: int = samples.n - samples.train.stop - int(samples.covered.sum())
    return count


def _guess(samples: Samples) -> OU:
    """Return a start for the fit: from the correlation of neighbours."""
    v = samples.voltage[samples.train]
    c = v - v.mean()
    power = float(c @ c)
    keep = min(max(float(c[1:] @ c[:-1]) / power, 0.05), 0.9999)
    alpha = -math.log(keep) / float(np.median(samples.step[1:]))
    return OU(alpha, math.sqrt(power / c.size * 2.0 * alpha), float(v.mean()))


def _baseline(samples: Samples, state: Integrity) -> tuple[OU, FloatArray, Composite]:
    """
    Return the plain OU, its density of each sample, and where the search starts.

    The plain OU is fitted to the samples as logged, repeats and wrong stamps
    included; the search starts with what is known without a model.

    """
    guess = _guess(samples)
    clean = fit_composite(samples, [guess], samples.train)
    assert clean is not None
    plain, density = clean.terms[0], clean.density
    if state.raw is not None and np.ptp(state.raw.voltage[state.raw.train]) > 0.0:
        plain = fit_gaussian(state.raw, [_guess(state.raw)], state.raw.train).terms[0]
        density = evaluate(samples, [plain]).density
    assert isinstance(plain, OU)
    steps = [term for term in state.exact if term.ROLE is Role.NOISE]
    start = fit_composite(samples, [clean.terms[0], *steps], samples.train) if steps else clean
    assert start is not None
    return plain, density, start


def _causes(samples: Samples, state: Integrity, named: Named, whole: Composite,
            se: tuple[dict[str, Any], ...], start: Composite, plain_density: FloatArray,
            scale: Scale, progress: Progress) -> tuple[Cause, ...]:
    """
    Return all causes: exact findings first, then those of the search.

    The gain of a cause is what the model loses without it, fitted again; causes
    of one kind, where there are many (the harmonics of a line), are left out
    together, and each has the gain of all.  That of repeats, rails and wrong
    stamps, which are undone in the samples, is what the OU fitted to the
    samples as logged loses on those left, all together.  Parameters are those
    fitted to everything.

    """
    found: list[Cause] = []
    for term in state.exact:
        why = ''
        if term.ROLE is Role.NOISE:
            index = next(i for i, t in enumerate(named.model.terms) if t.NAME == term.NAME)
            less = without(samples, named.model, index)
            gain, error = (math.nan, math.nan) if less is None else scale.gain(
                named.model.density, less.density, (index,))
            why = _why_unknown(gain, less, scale, (index,))
        elif term.FAMILY == 'line':
            gain, error, why = math.nan, math.nan, FAST
        else:
            clean = evaluate(samples, fit_gaussian(
                samples, [start.terms[0]], samples.train).terms)
            gain, error = if_known(*mean_difference(
                clean.density[scale.scored], plain_density[scale.scored]))
            why = '' if math.isfinite(gain) else VAGUE
        found.append(Cause(term, {}, gain, error, 0.0, (),
                           explain(term, {}, gain, error, (), True, why), True))
    groups: dict[tuple[int, ...], tuple[float, float, float, str]] = {}
    for k, name in enumerate(named.names):
        index = position(named.model, named.names, k)
        many = named.names.count(name) >= _MANY
        group = tuple(position(named.model, named.names, j) for j, other in enumerate(named.names)
                      if other == name) if many else (index,)
        if group not in groups:
            less = start if len(group) == len(named.names) else without(
                samples, named.model, *group)
            gain, error, chance = (math.nan,) * 3 if less is None else cause_gain(
                samples, named.model, less, scale, group)
            groups[group] = gain, error, chance, _why_unknown(gain, less, scale, group)
        gain, error, chance, why = groups[group]
        rivals = tuple(dict.fromkeys(named.rivals.get(name, ())))
        term = whole.terms[index]
        found.append(Cause(term, se[index], gain, error, chance, rivals, explain(
            term, se[index], gain, error, rivals, False, why, len(group), chance), False))
        progress((k + 1) / len(named.names))
    return tuple(found)


def _why_unknown(gain: float, less: Composite | None, scale: Scale, group: tuple[int, ...]
                 ) -> str:
    """Return why the gain of a group of terms is not known; empty where it is."""
    if math.isfinite(gain):
        return ''
    return scale.why_unknown(group) or (NO_OTHER if less is None else VAGUE)


def _criticism(before: Mapping[str, float], after: Mapping[str, float]) -> tuple[Criticism, ...]:
    """Return all statistics with the band that a right model leaves with chance `NOTHING`."""
    count = len(before)
    one = -math.expm1(math.log1p(-NOTHING) / count)
    edge = -float(ndtri(0.5 * one))
    return tuple(Criticism(
        name, value, after.get(name, math.nan), -edge, edge, family_chance(value, count),
        family_chance(after[name], count) if name in after else math.nan)
        for name, value in before.items())


def _notes(state: Integrity, named: Named, samples: Samples) -> tuple[str, ...]:
    """Return what to know: the way in, what was withdrawn, what cannot be decided."""
    notes = [*state.notes, *([named.failure] if named.failure else [])]
    for name in dict.fromkeys(named.dropped):
        notes.append(f"'{name}' fitted, but left what it should explain: withdrawn.")
    out = _uncovered(samples)
    if out:
        notes.append(left_out_note(out, int(samples.covered.sum())))
    duration = float(samples.t[-1] - samples.t[0])
    ou = named.model.terms[0]
    assert isinstance(ou, OU)
    coupled = named.model.has('ac_coupling')
    step = float(np.median(samples.step[1:]))
    if coupled:
        notes.append(coupling_found(duration))
    elif ou.alpha * step > _BLIND:
        notes.append(no_relaxation_note(ou.alpha, step))
    elif ou.alpha * duration > _RELAXES:
        notes.append(coupling_note(ou.alpha, duration))
    return tuple(notes)
