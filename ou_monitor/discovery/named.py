"""
Named causes: accepted by a search, not refuted by a second criticism, and of use to predictions.

The model is criticised on the whole recording; causes that do not explain their statistics, or
whose simulations leave the recorded range, are withdrawn, and the search continues without them.
Then a cause is removed if the rest, refitted, predicts held-out blocks equally well; the others
are tested again, because one of them may now account for its effect.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.score_statistics import criticise, NullBank, simulate_bank
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import Fitter, is_trend, standard_errors
from ou_monitor.discovery.gain import cause_gain, held_out, HeldOut, without
from ou_monitor.discovery.search import (
    name_causes, outside_range, position, Progress, Search, under_load, without_causes)
from ou_monitor.discovery.words import is_vague
from ou_monitor.model.terms.catalogue import blamed, catalogue
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import NAN

# Maximum number of searches, each without the causes withdrawn before.
_TURNS = 3

# Note if the search was cut short.
STOPPED = ('The search for causes was cut short because the next ones would have taken too long; '
           'there may be more.')


# Why a cause was withdrawn.
REFUTED = 'did not explain its statistics'
STRAYS = 'its simulations leave the recorded range'


@dataclass(frozen=True)
class FittedSearch:
    """A search, its model fitted to everything, and the statistics of that model."""

    search: Search
    whole: Composite
    after: Mapping[str, float]


@dataclass(frozen=True)
class Named:
    """Result of all searches."""

    found: FittedSearch
    bank: NullBank  # Calibration of the statistics
    dropped: Mapping[str, str]  # Causes that were withdrawn, and why, in words
    before: Mapping[str, float]  # Statistics of the plain model
    failure: str  # Why the search ended early; otherwise empty


def named_causes(samples: Samples, start: Composite, rng: np.random.Generator,
                 exact: tuple[Term, ...], progress: Progress,
                 loaded: tuple[Fitter, Search] | None = None) -> Named:
    """Search for causes; withdraw those that do not explain their statistics."""
    # loaded: result of `under_load`, if known.
    bank = simulate_bank(samples, start, rng)
    before = criticise(samples, start, bank)
    found = FittedSearch(Search(start), start, before)
    given = [term.NAME for term in exact]
    failure, begun = '', None
    dropped: dict[str, str] = {}
    refuted = -math.inf
    try:
        fitter, search = loaded or under_load(samples, start)
        begun = found = _fit_everything(fitter, search, bank)
        for turn in range(_TURNS):
            # In the last turn, name no latent causes: those named were withdrawn repeatedly.
            less, latent = search.copy(), turn < _TURNS - 1
            name_causes(fitter, search, bank, given=[*given, *dropped], latent=latent,
                        progress=None if turn else lambda share: progress(0.1 + 0.9 * share))
            if latent and fitter.evidence(search.composite) < refuted:
                # These causes are worse than the withdrawn ones that they replace.
                search = less
            found = _fit_everything(fitter, search, bank)
            out, why = _withdrawn(fitter, found, begun), REFUTED
            if out:
                refuted = max(refuted, fitter.evidence(search.composite))
            else:
                out, why = _straying(fitter, found), STRAYS
            if not out:
                break
            dropped |= {search.accepted[k]: why for k in out}
            found = begun
            rest = without_causes(fitter, search, _with_corrections(search.accepted, out))
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
    return Named(found, bank, {name: why for name, why in dropped.items()
                               if name not in found.search.accepted},
                 before, failure or (STOPPED if fitter.cost > decision.MOST_COST else ''))


def _fit_everything(fitter: Fitter, search: Search, bank: NullBank) -> FittedSearch:
    """Return a search with its model fitted to everything, held-out events included."""
    whole = fitter.whole(search.composite)
    return FittedSearch(search.copy(), whole, criticise(fitter.samples, whole, bank))


def _withdrawn(fitter: Fitter, found: FittedSearch, begun: FittedSearch) -> list[int]:
    """Return the causes that do not explain their statistics, or no longer fit their name."""
    names = found.search.accepted
    kinds = [catalogue()[name] for name in names]
    out = decision.withdrawn(begun.after, found.after, kinds, found.search.before_accepted)
    # Noise terms of the load model stay.
    out = [k for k in out if names[k] not in begun.search.accepted]
    view = fitter.view(found.whole)
    return sorted({*out,
                   # Causes with states of their own that no longer fit their name.
                   *(k for k, kind in enumerate(kinds) if kind.ROLE is Role.BLOCK
                     and not found.whole.terms[position(found.whole, names, k)].holds(view))})


def _with_corrections(accepted: Sequence[str], out: Sequence[int]) -> list[int]:
    """Return withdrawn causes, and those accepted later that may only have corrected them."""
    kinds = [catalogue()[name] for name in accepted]
    return [k for k in range(len(kinds)) if k in out or any(
        j < k and decision.imitate(kinds[k], kinds[j]) for j in out)]


def _straying(fitter: Fitter, found: FittedSearch) -> list[int]:
    """Return the cause, if any, whose removal keeps simulations within the recorded range."""
    # A term may improve one-step predictions although its simulations exceed the recorded range.
    # Responses of the mean are not tested, nor combinations of causes.
    def strays(model: Composite | None) -> bool:
        try:
            return model is None or outside_range(fitter.samples, model.terms) > 0.0
        except ValueError:
            return True

    if not strays(found.whole):
        return []
    best: tuple[float, list[int]] = (-math.inf, [])
    for k, name in enumerate(found.search.accepted):
        less = None if decision.is_response(catalogue()[name]) else without_causes(
            fitter, found.search, [k])
        if less is not None and not strays(fitter.whole(less.composite)):
            best = max(best, (fitter.evidence(less.composite), [k]))
    return best[1]


# Minimum number of causes of one kind whose gain is measured together.
MANY = 4
# Maximum number of rounds.
_ROUNDS = 4


@dataclass(frozen=True)
class Worth:
    """What the model loses without a group of terms."""

    # Gain and standard error, nats per sample.
    gain: float = NAN
    error: float = NAN
    chance: float = NAN  # p-value; see `gain.cause_gain`
    size: int = 1  # Terms of the group
    less: HeldOut | None = None  # The model without the group


@dataclass(eq=False)
class Pruned:
    """The remaining model, and the gain of each of its causes."""

    full: HeldOut
    names: list[str]  # Its causes, in the order of acceptance
    worth: list[Worth] = field(default_factory=list)
    out: list[str] = field(default_factory=list)  # Removed causes


def prune_by_gain(samples: Samples, model: Composite, names: Sequence[str], plain: HeldOut,
                  scored: npt.NDArray[np.bool_], progress: Callable[[float], None]) -> Pruned:
    """Remove the causes that do not improve held-out predictions, the worst first."""
    state = Pruned(held_out(samples, model), list(names))
    for turn in range(_ROUNDS):
        _measure(samples, state, plain, scored, lambda share: progress(
            1.0 - 0.5 ** turn * (1.0 - 0.5 * share)))
        vague = _undetermined(samples, state)
        failing = [k for k, worth in enumerate(state.worth) if worth.less is not None and (
            k in vague or not decision.improves_predictions(worth.gain, worth.error, worth.chance)
            and not _absorbs_trend(samples, state, k))]
        if not failing or turn == _ROUNDS - 1:
            break
        _leave_out(state, min(failing, key=lambda k: (
            -state.worth[k].chance, state.worth[k].gain)))
    return state


def _undetermined(samples: Samples, state: Pruned) -> list[int]:
    """Return causes whose amplitudes are all undetermined, unless another cause needs them."""
    model, found = state.full.model, []
    errors = standard_errors(samples, model)
    for k, worth in enumerate(state.worth):
        at = position(model, state.names, k)
        term = model.terms[at]
        vague = [is_vague(value, errors[at].get(name)) for name, value in term.values().items()
                 if term.positive(name) and term.unit(name) in ('V', 'V/sqrt(s)')]
        if worth.size == 1 and vague and all(vague) and not any(
                other.CHANGES is type(term) for other in model.terms):
            found.append(k)
    return found


def _leave_out(state: Pruned, worst: int) -> None:
    """Remove a cause, and those that the model without it lacks."""
    less = state.worth[worst].less
    assert less is not None
    there = [term.NAME for term in less.model.terms]
    rest = state.names[:worst] + state.names[worst + 1:]
    left = [name for k, name in enumerate(rest) if rest[:k].count(name) < there.count(name)]
    state.out += [name for name in dict.fromkeys(state.names)
                  if state.names.count(name) > left.count(name)]
    state.names, state.full = left, less


def _absorbs_trend(samples: Samples, state: Pruned, k: int) -> bool:
    """Return whether `ou` would become a trend without this response of the mean."""
    less = state.worth[k].less
    return (decision.is_response(catalogue()[state.names[k]]) and less is not None
            and is_trend(samples, less.model) and not is_trend(samples, state.full.model))


def _measure(samples: Samples, state: Pruned, plain: HeldOut, scored: npt.NDArray[np.bool_],
             progress: Callable[[float], None]) -> None:
    """Measure the gain of each cause, or of all causes of one kind if there are many."""
    # If the rest predicts worse than the plain OU, the gain is relative to the plain OU.
    state.worth = []
    found: dict[tuple[int, ...], Worth] = {}
    for k in range(len(state.names)):
        group = group_of(state.full.model, state.names, k)
        if group not in found:
            less = without(samples, state.full.model, *group, plain=plain.model)
            if less is None:
                found[group] = Worth(size=len(group))
            else:
                other = held_out(samples, less)
                both = scored & other.known & plain.known
                if both.any() and other.density[both].mean() < plain.density[both].mean():
                    other = plain
                found[group] = Worth(*cause_gain(state.full, other, scored), len(group), other)
        state.worth.append(found[group])
        progress((k + 1) / len(state.names))


def group_of(model: Composite, names: Sequence[str], k: int) -> tuple[int, ...]:
    """Return the index of the k-th cause in a model, or of all of its kind if there are many."""
    if list(names).count(names[k]) < MANY:
        return (position(model, names, k),)
    return tuple(position(model, names, j) for j, name in enumerate(names) if name == names[k])


def refusal(samples: Samples, terms: Sequence[Term], gain: float, gain_se: float,
            larger: bool = False) -> str:
    """Return why a model is refused, in words; otherwise empty (gains in nats per sample)."""
    # larger: whether its one-step errors are significantly larger than those of the plain OU.
    if math.isfinite(gain) and not decision.improves_predictions(gain, gain_se, 0.0):
        return 'The extended model predicts worse than the plain OU'
    if larger:
        return 'One-step errors of the extended model are larger than those of the plain OU'
    try:
        far = outside_range(samples, terms)
    except ValueError as error:
        return f'The extended model cannot be simulated ({error})'
    if far > 0.0:
        by = 'without bound' if math.isinf(far) else f'by {far:.2g} V'
        return ('Simulations of the extended model exceed the recorded range and its margin (half '
                f'of the range at either end) {by}')
    return ''
