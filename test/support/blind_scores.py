"""
Recordings with hidden effects, and scores of a program's answers: right, in the set, false.

Shared by the tests and by `benchmarks/discover.py`.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import sha256
from typing import Any

from hidden_effects import draw, Hidden, labels
import numpy as np


# Verdicts with something left that no cause explains.
OPEN = ('unexplained', 'partly_explained')


def hide(kind: str, effect: str, seed: int, number: int, *, duration: float, rate: float,
         strength: float) -> Hidden:
    """Hide an effect; all but its name comes from the seed and the number of this effect."""
    # Kind and effect as for `draw`: for a pair two names joined by '+', for 'none' ''.
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
    # As in the JSON of `discover`; empty without a result.
    verdict: str
    # Causes named, each with its alternatives.
    named: Mapping[str, tuple[str, ...]]

    @property
    def alone(self) -> bool:
        """Whether the names are right, with none missing and none in excess."""
        return bool(self.verdict) and tuple(sorted(self.named)) in self.accepted

    @property
    def in_set(self) -> bool:
        """Whether all true names were reported, and no false ones."""
        # A true name is reported if it is named or is an alternative of a name; a name is false
        # unless it or one of its alternatives matches a true name that no other name matches.
        return bool(self.verdict) and any(
            set(way) <= self.reported and _each_stands(list(self.named.items()), set(way))
            for way in self.accepted)

    @property
    def all_named(self) -> bool:
        """Whether all true names were named, perhaps with others."""
        return bool(self.verdict) and any(set(way) <= set(self.named) for way in self.accepted)

    @property
    def covered(self) -> bool:
        """Whether all true names were named or alternatives, perhaps with others."""
        return bool(self.verdict) and any(set(way) <= self.reported for way in self.accepted)

    @property
    def family(self) -> bool:
        """Whether the families of the names are the true ones."""
        found = {labels[name] for name in self.named}
        return bool(self.verdict) and any(
            found == {labels[name] for name in way} for way in self.accepted)

    @property
    def alarm(self) -> bool:
        """Whether any cause was reported, or something unexplained."""
        return self.verdict != 'no_effect'

    @property
    def left_open(self) -> bool:
        """Whether something was reported as not explained."""
        return self.verdict in OPEN

    @property
    def misnamed(self) -> bool:
        """Whether neither a name nor its alternatives belong to the hidden effect."""
        true = set(self.near).union(*self.accepted)
        return any(not true & {name, *also} for name, also in self.named.items())

    @property
    def reported(self) -> set[str]:
        """Return the names and their alternatives."""
        return set(self.named).union(*self.named.values())

    def as_data(self) -> dict[str, Any]:
        return asdict(self)


def from_data(data: Mapping[str, Any]) -> Outcome:
    """Return an outcome from the data of `Outcome.as_data`; other entries are ignored."""
    return Outcome(
        data['kind'], data['effect'], tuple(tuple(way) for way in data['accepted']),
        tuple(data['near']), data['verdict'],
        {name: tuple(also) for name, also in data['named'].items()})


def outcome(hidden: Hidden, verdict: str = '', causes: Iterable[Any] = ()) -> Outcome:
    """Return the outcome for a recording; without a verdict if the program failed."""
    # A cause that is named twice counts once.
    named: dict[str, tuple[str, ...]] = {}
    for cause in causes:
        named[cause.name] = tuple(dict.fromkeys((*named.get(cause.name, ()),
                                                 *cause.alternatives)))
    return Outcome(hidden.kind, hidden.name, hidden.accepted, hidden.near, verdict, named)


def _each_stands(named: Sequence[tuple[str, tuple[str, ...]]], true: set[str]) -> bool:
    """Return whether each of `named` can be matched with a different true name."""
    if not named:
        return True
    (name, also), *rest = named
    return any(_each_stands(rest, true - {one}) for one in true & {name, *also})
