"""
What a soak does to the node, and when: drawn from a seed, so that it can be done again.

Two schedules run side by side: what the source sends (phases, with dips at random times), and
what is done to the node (parameters, services, the CPU).
"""

from __future__ import annotations

from dataclasses import dataclass
import math
import random
from typing import Any

# Hz.
RATE = 1000.0
# What comes: a weight each.  Stamps: `good` (the time of the sample), `none` (0), `frozen` at
# that of the phase's begin, `backwards`, `jumps` (steps of 10 ms to 12 days, either way),
# `future` (nine years ahead), `wild` (each within 100 s of the truth), `fast` (milliseconds taken
# for seconds).  Values: `nan`, `huge` (a fifth of the samples).  Also: `burst` (sent 100 at once),
# `lumps` (no stamps, and three of six seconds sent 100 at once), `second` (another publisher of
# the topic comes, and ends or is killed).
SEEN = {'good': 6.0, 'none': 2.0, 'frozen': 1.0, 'backwards': 1.0, 'jumps': 1.0, 'future': 1.0,
        'wild': 1.0, 'fast': 1.0, 'nan': 1.0, 'huge': 1.0, 'burst': 1.0, 'lumps': 1.0,
        'second': 1.0}
# What holds no voltage that the node can take for one: all samples NaN, millivolts, another
# message type, a publisher that pauses, or that ends and begins anew.
UNSEEN = {'only_nan': 0.7, 'millivolts': 0.7, 'type': 0.7, 'silent': 0.7, 'restart': 1.0}
# During these no estimate can be made, so the flag must never be false.
NEVER_FALSE = ('frozen', 'backwards', 'wild', 'only_nan', 'type', 'silent')
LONG, SHORT = (4.0, 12.0), (2.0, 4.0)
# Nothing is asked of a dip so shortly after the start, or after a new publisher, s: discovery;
# nor so shortly before a publisher ends: what has been sent may go with it.
SETTLE, FIRST, LEAVE = 1.0, 3.0, 0.3
# Of dips: s between them (dense ones: never less than two can be told apart), s, and V; all at or
# below the lowest floor that is ever set.
BETWEEN, DENSE, DIP, DEPTH = (1.5, 5.0), (1.3, 2.0), (0.04, 0.08), (3.0, 4.1)
# Events at the node: s between them.
PAUSE = (1.0, 5.0)
SLICES = ((0.02, 0.01), (0.05, 0.05), (0.2, 0.1), (0.4, 0.2))


@dataclass(frozen=True)
class Phase:
    """What the source sends from `begin` to `end`, s."""

    kind: str
    begin: float
    end: float


@dataclass(frozen=True)
class Dip:
    """One dip."""

    # s.
    begin: float
    length: float
    voltage: float  # V.
    unseen: str  # Why the node cannot see it; empty where it must.


@dataclass(frozen=True)
class Event:
    """Something done to the node at `begin`, s."""

    kind: str
    begin: float
    about: Any = None


def phases(seed: int, seconds: float) -> list[Phase]:
    """Return what is sent, phase by phase."""
    rng = random.Random(f'phases {seed}')
    weights = {**SEEN, **UNSEEN}
    made, now = [Phase('good', 0.0, FIRST + 2.0)], FIRST + 2.0
    while now < seconds:
        # A publisher that pauses or changes while another is there would lose its place to it.
        kind = rng.choices(list(weights), list(weights.values()))[0]
        length = rng.uniform(*(LONG if kind in SEEN else SHORT))
        if kind == 'second':
            length = max(length, 8.0)
        made.append(Phase(kind, now, min(now + length, seconds)))
        now += length
    return made


def dips(seed: int, sent: list[Phase], dense: bool = False) -> list[Dip]:
    """Return the dips, whole milliseconds each."""
    rng = random.Random(f'dips {seed}')
    made: list[Dip] = []
    now = 0.0
    while True:
        now = round(now + rng.uniform(*(DENSE if dense else BETWEEN)), 3)
        length = round(rng.uniform(*DIP), 3)
        if now + length >= sent[-1].end:
            return made
        made.append(Dip(now, length, rng.uniform(*DEPTH), _unseen(now, now + length, sent)))


def _unseen(begin: float, end: float, sent: list[Phase]) -> str:
    if begin < FIRST:
        return 'start'
    for phase in sent:
        if phase.kind in UNSEEN:
            ends = phase.kind in ('type', 'restart')
            before, after = (LEAVE, SETTLE) if ends else (0.1, 0.1)
            if end > phase.begin - before and begin < phase.end + after:
                return phase.kind
    return ''


def events(seed: int, seconds: float, fifo: str, model: str) -> list[Event]:
    """Return what is done to the node (fifo, model: paths of files)."""
    rng = random.Random(f'events {seed}')
    made, now = [], FIRST
    while True:
        now += rng.uniform(*PAUSE)
        if now > seconds - 10.0:
            return made
        kind = rng.choices(['set', 'refused', 'clear', 'slices', 'busy'], [6, 4, 1, 1.5, 1])[0]
        about: Any = None
        if kind == 'set':
            about = [good_parameter(rng, model) for _ in range(rng.choice([1, 1, 1, 3]))]
        elif kind == 'refused':
            about = [rng.choice(bad_parameters(fifo))]
        elif kind in ('slices', 'busy'):
            about = (rng.uniform(3.0, 12.0), rng.choice(SLICES))
        made.append(Event(kind, now, about))
        if kind in ('slices', 'busy'):
            now += about[0]


def good_parameter(rng: random.Random, model: str) -> tuple[str, Any]:
    """Return a parameter and a value that are taken, whatever the others are."""
    return rng.choice([
        lambda: ('window', rng.uniform(0.5, 4.0)),
        lambda: ('stale_after', rng.uniform(0.5, 2.0)),
        lambda: ('publish_rate', rng.uniform(5.0, 20.0)),
        lambda: ('brownout.horizon', rng.uniform(0.5, 5.0)),
        lambda: ('brownout.warn', rng.uniform(0.005, 0.05)),
        lambda: ('brownout.critical', rng.uniform(0.1, 0.5)),
        lambda: ('brownout.leave', rng.uniform(0.1, 0.9)),
        lambda: ('brownout.hold', rng.choice([0.0, 0.0, 0.2, 1.0])),
        lambda: ('brownout.delay', rng.choice([0.0, 0.2])),
        lambda: ('brownout.latch', rng.random() < 0.3),
        lambda: ('brownout.floor', rng.uniform(4.15, 4.35)),
        lambda: ('brownout.floor_time', rng.uniform(0.005, 0.03)),
        lambda: ('brownout.budget_limit', rng.choice([0.0, 0.02])),
        lambda: ('model_file', rng.choice(['', model])),
    ])()


def bad_parameters(fifo: str) -> list[tuple[str, Any]]:
    """Return parameters that must be refused."""
    return [
        ('window', -1.0), ('window', math.nan), ('window', 'long'), ('window', 1e9),
        ('publish_rate', 0.0), ('publish_rate', 1e9), ('publish_rate', math.inf),
        ('brownout.warn', 0.6), ('brownout.warn', -0.1), ('brownout.critical', 0.001),
        ('brownout.leave', 1.0), ('brownout.floor', 100.0), ('brownout.floor', math.nan),
        ('brownout.latch', 1), ('brownout.hold', -1.0),
        ('model_file', fifo), ('model_file', '/dev/zero'), ('model_file', '/no/such.yaml'),
        ('voltage.topic', 'elsewhere'), ('lock_parameters', True), ('no_such_parameter', 1.0)]
