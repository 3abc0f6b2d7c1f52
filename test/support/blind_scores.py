"""
Recordings drawn blind, and what a program said of them: right, in the set, false.

Shared by the tests and by `benchmarks/discover.py`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from typing import Any

from hidden_effects import draw, Hidden, labels
import numpy as np


# Verdicts that say that something is left that no cause explains.
OPEN = ('unexplained', 'partly_explained')


def hide(kind: str, effect: str, seed: int, number: int, *, duration: float, rate: float,
         strength: float) -> Hidden:
    """
    Hide an effect; all but its name comes from the seed and the number of this effect.

    Kind and effect as `draw` takes them: for a pair two names joined by '+', for 'none' ''.
    """
    word = int.from_bytes(sha256(f'{kind} {effect}'.encode()).digest()[:8], 'big')
    cause = tuple(effect.split('+')) if kind == 'pair' else effect or None
    return draw(kind, np.random.default_rng([seed, number, word]), cause=cause,
                duration=duration, rate=rate, strength=strength)


@dataclass(frozen=True)
class Outcome:
    """What was hidden and what was reported."""

    # Kind of recording, and the entry of the generator's table.
    kind: str
    effect: str
    # As in `Hidden`.
    accepted: tuple[tuple[str, ...], ...]
    near: tuple[str, ...]
    # As in the JSON of `discover`; empty when there is none.
    verdict: str
    # Causes named, each with its alternatives.
    named: Mapping[str, tuple[str, ...]]

    @property
    def alone(self) -> bool:
        """Whether the names are right, none missing and none more."""
        return bool(self.verdict) and tuple(sorted(self.named)) in self.accepted

    @property
    def in_set(self) -> bool:
        """
        Whether all that is true was reported, and nothing false.

        A true name is reported when it is named or an alternative of what is;
        a name is false unless it, or one of its alternatives, stands for a
        true name that no other does.
        """
        return bool(self.verdict) and any(
            set(way) <= self.reported and _each_stands(list(self.named.items()), set(way))
            for way in self.accepted)

    @property
    def all_named(self) -> bool:
        """Whether all that is true was named, whatever else was."""
        return bool(self.verdict) and any(set(way) <= set(self.named) for way in self.accepted)

    @property
    def covered(self) -> bool:
        """Whether all that is true was named or an alternative, whatever else was."""
        return bool(self.verdict) and any(set(way) <= self.reported for way in self.accepted)

    @property
    def family(self) -> bool:
        """Whether the families of the names are those of the truth."""
        found = {labels[name] for name in self.named}
        return bool(self.verdict) and any(
            found == {labels[name] for name in way} for way in self.accepted)

    @property
    def alarm(self) -> bool:
        """Whether something was reported wrong with the recording."""
        return self.verdict != 'no_effect'

    @property
    def left_open(self) -> bool:
        """Whether it was said that something is not explained."""
        return self.verdict in OPEN

    @property
    def misnamed(self) -> bool:
        """Whether a name has nothing to do with what is hidden, nor has an alternative."""
        true = set(self.near).union(*self.accepted)
        return any(not true & {name, *also} for name, also in self.named.items())

    @property
    def reported(self) -> set[str]:
        """Return the names and their alternatives."""
        return set(self.named).union(*self.named.values())

    def as_data(self) -> dict[str, Any]:
        return asdict(self)


def from_data(data: Mapping[str, Any]) -> Outcome:
    """Return an outcome from what `Outcome.as_data` made, whatever is beside it."""
    return Outcome(
        data['kind'], data['effect'], tuple(tuple(way) for way in data['accepted']),
        tuple(data['near']), data['verdict'],
        {name: tuple(also) for name, also in data['named'].items()})


def outcome(hidden: Hidden, verdict: str = '', causes: Iterable[Any] = ()) -> Outcome:
    """
    Return what became of a recording; no verdict where the program failed.

    A cause that is named twice counts once.
    """
    named: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        named[cause.name] = tuple(dict.fromkeys((*named.get(cause.name, ()),
                                                 *cause.alternatives)))
    return Outcome(hidden.kind, hidden.name, hidden.accepted, hidden.near, verdict, named)


def _each_stands(named: Sequence[tuple[str, tuple[str, ...]]], true: set[str]) -> bool:
    """Return whether each of `named` can stand for a true name of its own."""
    if not named:
        return True
    (name, also), *rest = named
    return any(_each_stands(rest, true - {one}) for one in true & {name, *also})
