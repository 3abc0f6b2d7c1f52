"""What a search for causes has found so far."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from ou_monitor.criticism.composite import Composite


@dataclass(eq=False)
class Search:
    """State of the search."""

    composite: Composite  # The model so far
    accepted: list[str] = field(default_factory=list)  # Causes in the order of their acceptance
    # For each cause, those that did as well in its round.
    rivals: dict[str, list[str]] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)  # Trials and their results, one line each
    # Causes taken out again, because later ones made them needless.
    removed: list[str] = field(default_factory=list)
    largest: float = 0.0  # Largest evidence of an accepted cause, nats
    # Causes that may only mend the form of another one, and are not tried again.
    hopeless: set[str] = field(default_factory=set)
    # For each cause accepted in a round, the statistics that it was accepted for.
    asked: dict[str, Mapping[str, float]] = field(default_factory=dict)
    # Causes without evidence, and the statistic that asked for each.
    failed: dict[str, float] = field(default_factory=dict)
    stopped: bool = False  # Whether the search ended because it took too long

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
