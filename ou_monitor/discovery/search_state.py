"""What a search for causes has found so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ou_monitor.criticism.composite import Composite


@dataclass(eq=False)
class Search:
    """
    State of the search.

    Attributes
    ----------
    composite : Composite
        The model so far.
    accepted : list of str
        Causes in the order of their acceptance.
    rivals : dict of str to list of str
        For each cause, those that did as well in its round.
    log : list of str
        Trials and their results, one line each.
    removed : list of str
        Causes taken out again, because later ones made them needless.
    largest : float
        Largest evidence of an accepted cause, nats.
    hopeless : set of str
        Causes that may only mend the form of another one, and are not tried again.
    asked : dict of str to dict
        For each cause accepted in a round, the statistics that it was accepted for.
    failed : dict of str to float
        Causes without evidence, and the statistic that asked for each.
    stopped : bool
        Whether the search ended because it took too long.

    """

    composite: Composite
    accepted: list[str] = field(default_factory=list)
    rivals: dict[str, list[str]] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)
    removed: list[str] = field(default_factory=list)
    largest: float = 0.0
    hopeless: set[str] = field(default_factory=set)
    asked: dict[str, Mapping[str, float]] = field(default_factory=dict)
    failed: dict[str, float] = field(default_factory=dict)
    stopped: bool = False

    def take(self, name: str, composite: Composite) -> None:
        """Take a cause back into the model."""
        self.composite = composite
        self.accepted.append(name)
        self.rivals.setdefault(name, [])

    def copy(self) -> Search:
        """Return a search that goes on from here and leaves this one as it is."""
        return replace(self, accepted=list(self.accepted), rivals=dict(self.rivals),
                       log=list(self.log), removed=list(self.removed),
                       hopeless=set(self.hopeless), asked=dict(self.asked),
                       failed=dict(self.failed))
