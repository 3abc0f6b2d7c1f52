"""
Remove causes that do not improve predictions of held-out blocks, and check the model.

A cause is removed if the rest, refitted, predicts held-out blocks equally well.  The other causes
are then tested again, because one of them may now account for the effect of the removed one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.composite import Composite
from ou_monitor.criticism.samples import Samples
from ou_monitor.discovery import decision
from ou_monitor.discovery.fitting import follows_time, is_trend, standard_errors
from ou_monitor.discovery.gain import cause_gain, held_out, HeldOut, without
from ou_monitor.discovery.search import outside_range, position
from ou_monitor.discovery.words import is_vague
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Term
from ou_monitor.records import NAN

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
        state.worth = []
        _leave_out_vague(samples, state)
        _measure(samples, state, plain, scored, lambda share: progress(
            1.0 - 0.5 ** turn * (1.0 - 0.5 * share)))
        failing = [k for k, worth in enumerate(state.worth) if worth.less is not None
                   and not decision.improves_predictions(worth.gain, worth.error, worth.chance)
                   and not _absorbs_trend(samples, state, k)
                   and not _extrapolated(samples, state, k)]
        if turn == _ROUNDS - 1:
            return state
        worst = (min(failing, key=lambda k: (-state.worth[k].chance, state.worth[k].gain))
                 if failing else _cause_of_straying(samples, state))
        if worst is None:
            return state
        _leave_out(state, worst)
    return state


def _leave_out_vague(samples: Samples, state: Pruned) -> None:
    """Remove causes whose amplitudes are all undetermined, unless another cause needs them."""
    for k in reversed(range(len(state.names))):
        at = position(state.full.model, state.names, k)
        term = state.full.model.terms[at]
        if any(other.CHANGES is type(term) for other in state.full.model.terms):
            continue
        errors = standard_errors(samples, state.full.model, slice(0, samples.n))[at]
        vague = [is_vague(value, errors.get(name)) for name, value in term.values().items()
                 if term.positive(name) and term.unit(name) in ('V', 'V/sqrt(s)')]
        less = without(samples, state.full.model, at) if vague and all(vague) else None
        if less is not None:
            state.worth = [Worth(less=held_out(samples, less))] * len(state.names)
            _leave_out(state, k)
    state.worth = []


def _leave_out(state: Pruned, worst: int) -> None:
    """Remove a cause and the terms that depend on it."""
    less = state.worth[worst].less
    assert less is not None
    kept = {term.NAME for term in less.model.terms}
    gone = state.names[worst]
    many = state.worth[worst].size > 1
    left = [name for k, name in enumerate(state.names)
            if k != worst and not (many and name == gone)
            and (name in kept or name == gone)]
    state.out += [name for name in set(state.names) if state.names.count(name)
                  > left.count(name)]
    state.names, state.full = left, less


def _cause_of_straying(samples: Samples, state: Pruned) -> int | None:
    """Return the cause, if any, whose removal keeps simulations within the recorded range."""
    # A term may improve one-step predictions although its simulations exceed the recorded range.
    # Responses of the mean are not tested.
    def far_of(model: Composite) -> float:
        try:
            return outside_range(samples, model.terms)
        except ValueError:
            return math.inf

    far = far_of(state.full.model)
    if not far > 0.0:
        return None
    other = {k: far_of(worth.less.model) for k, worth in enumerate(state.worth)
             if worth.less is not None and not decision.is_response(catalogue()[state.names[k]])}
    # The single cause with the least gain; combinations are not tried.
    return min((k for k, stays in other.items() if not stays > 0.0), default=None,
               key=lambda k: state.worth[k].gain)


def _absorbs_trend(samples: Samples, state: Pruned, k: int) -> bool:
    """Return whether `ou` would become a trend without this response of the mean."""
    less = state.worth[k].less
    return (decision.is_response(catalogue()[state.names[k]]) and less is not None
            and is_trend(samples, less.model) and not is_trend(samples, state.full.model))


def _extrapolated(samples: Samples, state: Pruned, k: int) -> bool:
    """Return whether held-out blocks cannot judge a response that the fit shows."""
    # If the load follows time, predicting a left-out block extrapolates both load and time.
    return (state.worth[k].chance <= decision.CHANCE
            and decision.is_response(catalogue()[state.names[k]]) and follows_time(samples) > 0.0)


def _measure(samples: Samples, state: Pruned, plain: HeldOut, scored: npt.NDArray[np.bool_],
             progress: Callable[[float], None]) -> None:
    """Measure the gain of each cause, or of all causes of one kind if there are many."""
    # If the rest predicts worse than the plain OU, the gain is relative to the plain OU.
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
