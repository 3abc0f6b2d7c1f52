"""From statistics before and after to a verdict: what passes, what fails, what is withdrawn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ou_monitor.criticism.battery import is_sign
from ou_monitor.criticism.null_bank import family_chance
from ou_monitor.discovery.finding import Verdict
from ou_monitor.model.terms.term import Term

# Chance of the largest statistic above which nothing is wrong where no cause was found.
NOTHING = 0.01
# Chance above which a model with causes passes; the causes were chosen to please.
PASSES = 0.001
# A statistic fails that is this far off, and by more than these shares of what it,
# and the worst of all, was before there were any causes.
FAILS, OWN_SHARE, SHARE = 4.8, 0.07, 0.02
# Share of clustering that the form of sigma(throttle) may leave.
_FORM_SHARE = 0.15


def largest_chance(values: Mapping[str, float]) -> float:
    """Return the chance that the largest statistic of a right model is as large as here."""
    largest = max((abs(value) for value in values.values()), default=0.0)
    return family_chance(largest, max(len(values), 1))


def failing(before: Mapping[str, float], after: Mapping[str, float]) -> list[str]:
    """Return the statistics that the causes should have mended and did not."""
    worst = max((abs(value) for value in before.values()), default=0.0)
    return [name for name, value in after.items()
            if abs(value) > max(FAILS, OWN_SHARE * abs(before.get(name, 0.0)), SHARE * worst)]


def is_latent(kind: type[Term]) -> bool:
    """Whether a cause is inferred only: neither from a measured input nor from time."""
    return not (kind.NEEDS_THROTTLE or kind.MEASURED)


def withdrawn(before: Mapping[str, float], after: Mapping[str, float],
              accepted: Sequence[type[Term]]) -> list[int]:
    """Return which of the accepted causes claim what they do not explain."""
    measured = [kind for kind in accepted if not is_latent(kind)]
    # What a measured cause is asked for and leaves is its form, which is not complete.
    left = [name for name in failing(before, after)
            if not any(is_sign(sign, name, after[name]) for kind in measured
                       for sign in kind.SIGNS)]
    if any(kind.FAMILY == 'intensity' for kind in measured):
        left = [name for name in left if not name.startswith(('clustering', 'variance'))
                or abs(after[name]) > _FORM_SHARE * abs(before.get(name, 0.0))]

    def fails(kind: type[Term]) -> bool:
        if not kind.MAY_LEAVE:
            return bool(left)
        if kind.REFUTED_BY and any(name.startswith(kind.REFUTED_BY) for name in left):
            return True
        own = max((abs(value) for name, value in before.items() for sign in kind.SIGNS
                   if is_sign(sign, name, value)), default=0.0)
        return any(is_sign(sign, name, after[name]) and abs(after[name]) > kind.MAY_LEAVE * own
                   for name in left for sign in kind.SIGNS)

    return [k for k, kind in enumerate(accepted) if is_latent(kind) and fails(kind)]


def judge(after: Mapping[str, float], causes: int, dropped: int) -> Verdict:
    """Return the verdict."""
    chance = largest_chance(after)
    if causes == 0:
        return Verdict.NO_EFFECT if chance > NOTHING and not dropped else Verdict.UNEXPLAINED
    if chance > PASSES and not dropped:
        return Verdict.EXPLAINED
    return Verdict.PARTLY_EXPLAINED
