"""From statistics before and after to a verdict: what passes, what fails, what is withdrawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ou_monitor.model.terms.term import Term
from ou_monitor.offline.discover.finding import Verdict
from ou_monitor.offline.discover.null_bank import family_chance

# Chance of the largest statistic above which nothing is wrong where no cause was found.
NOTHING = 0.01
# Chance above which a model with causes passes; the causes were chosen to please.
PASSES = 0.001
# A statistic this far off fails.
FAILS = 5.0
# Share by which the causes must reduce a failing statistic to have touched it.
TOUCHED = 0.7


def largest_chance(values: Mapping[str, float]) -> float:
    """Return the chance that the largest statistic of a right model is as large as here."""
    largest = max((abs(value) for value in values.values()), default=0.0)
    return family_chance(largest, max(len(values), 1))


def untouched(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Return statistics that failed before the causes and still do, little reduced."""
    return [name for name, value in after.items()
            if abs(value) > FAILS and abs(before.get(name, 0.0)) > FAILS
            and abs(value) > (1.0 - TOUCHED) * abs(before[name])]


def is_latent(kind: type[Term]) -> bool:
    """Whether a cause is inferred only: neither from a measured input nor from time."""
    return not (kind.NEEDS_THROTTLE or kind.FAMILY == 'load' or kind.NAME == 'drift')


def withdrawn(before: Mapping[str, float], after: Mapping[str, float],
              accepted: Sequence[type[Term]]) -> list[int]:
    """
    Return which of the accepted causes claim what they do not explain.

    Parameters
    ----------
    before, after : mapping of str to float
        Statistics of the plain and of the extended model, as normal scores.
    accepted : sequence of type
        Kinds of the causes found by the search.

    Returns
    -------
    list of int
        Positions in `accepted`: latent causes that an untouched statistic is a
        sign of.

    """
    left = untouched(before, after)
    return [k for k, kind in enumerate(accepted) if is_latent(kind)
            and any(name.startswith(sign) for name in left for sign in kind.SIGNS)]


def judge(after: Mapping[str, float], causes: int, dropped: int) -> Verdict:
    """
    Return the verdict.

    Parameters
    ----------
    after : mapping of str to float
        Statistics of the final model.
    causes, dropped : int
        Causes that it holds, exact findings included, and causes withdrawn.

    Returns
    -------
    Verdict
        Not `INSUFFICIENT_DATA`.

    """
    chance = largest_chance(after)
    if causes == 0:
        return Verdict.NO_EFFECT if chance > NOTHING and not dropped else Verdict.UNEXPLAINED
    if chance > PASSES and not dropped:
        return Verdict.EXPLAINED
    return Verdict.PARTLY_EXPLAINED
