"""The verdict on a recording, from the statistics that its causes leave."""

from __future__ import annotations

from collections.abc import Mapping

from ou_monitor.criticism.null_bank import family_chance
from ou_monitor.discovery.finding import Verdict

# Chance of the largest statistic above which a model without causes passes.
NOTHING = 0.01
# The same for a model with causes: they were chosen to pass, so that a failure means more.
PASSES = 0.001


def largest_chance(values: Mapping[str, float]) -> float:
    """Return the chance that the largest statistic of a right model is as large as this one."""
    largest = max((abs(value) for value in values.values()), default=0.0)
    return family_chance(largest, max(len(values), 1))


def judge(after: Mapping[str, float], causes: int, dropped: int) -> Verdict:
    """Return the verdict on statistics after some causes, others withdrawn."""
    chance = largest_chance(after)
    if causes == 0:
        return Verdict.NO_EFFECT if chance > NOTHING and not dropped else Verdict.UNEXPLAINED
    if chance > PASSES and not dropped:
        return Verdict.EXPLAINED
    return Verdict.PARTLY_EXPLAINED
