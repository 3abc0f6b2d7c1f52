"""
Where throttle goes from one load level to another and stays there.

Limits: throttle is a command; motors follow it some 5 to 20 ms later, which a relaxation
watched from the end of the step does not know.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from ou_monitor.analyze.levels import HALF_WIDTH, half_width, stays
from ou_monitor.records import Recording

# Longest way from one level to the other, s: after a slower one nothing is left to relax.
LONGEST_RAMP = 1.0
# Shorter stays at a level are passages through it, s.
SHORTEST_STAY = 0.1
# Throttle has arrived, and stays, within this share of the change.
_STILL = 0.1


@dataclass(frozen=True)
class Step:
    """
    A change of load level.

    Attributes
    ----------
    before, after : int
        Numbers of the levels.
    leave : int
        Index of the first sample that is no longer at the level before.
    enter : int
        Index of the sample from which throttle stands still at the level after.
    begin, stop : int
        First sample of the stay before; one past the last that throttle stands still after.

    """

    before: int
    after: int
    leave: int
    enter: int
    begin: int
    stop: int


def find_steps(recording: Recording, throttles: Sequence[float]) -> tuple[Step, ...]:
    """Find the changes between load levels (throttles 0..1)."""
    t, throttle = recording.t, recording.throttle
    if not np.isfinite(throttles).all():
        return ()
    width = half_width(t, throttle)
    runs = [(run.start, run.stop, k) for run, k in stays(throttle, throttles, width)
            if t[run.stop - 1] - t[run.start] >= SHORTEST_STAY]
    found = []
    for (begin, leave, before), (start, stop, after) in zip(runs, runs[1:]):
        change = abs(throttles[after] - throttles[before])
        if before == after or change < 2.0 * HALF_WIDTH or start < leave:
            continue
        if t[start] - t[leave - 1] > LONGEST_RAMP:
            continue
        stay = throttle[start:stop]
        # Where the stick jitters as wide as that, what is still is as wide as the jitter.
        wide = width if width > HALF_WIDTH else 0.0
        still = np.abs(stay - np.median(stay)) <= max(_STILL * change, wide)
        enter = start + int(still.argmax())
        moved = np.flatnonzero(~still[enter - start:])
        end = enter + int(moved[0]) if moved.size else stop
        if t[end - 1] - t[enter] >= SHORTEST_STAY:
            found.append(Step(before, after, leave, enter, begin, end))
    return tuple(found)
