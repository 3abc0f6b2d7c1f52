"""What the notches hear of the motors: throttle and speeds, from topics found by their types."""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any

from ou_monitor.errors import InputError
from ou_monitor.nodes.base import MonitorNode
from ou_monitor.nodes.inputs import INPUT_QOS, Silence, types_on
from ou_monitor.nodes.sources import find_source, Source

NAN = math.nan
QUANTITIES = ('throttle', 'rpm')


class MotorInputs:
    """
    Newest throttle, and motor speeds that have not been asked for yet.

    By the values of `sources.MOTOR_PARAMETERS` and a monotonic clock, s; `problems` says of a
    quantity why it is not used.
    """

    def __init__(self, node: MonitorNode, values: Mapping[str, Any],
                 now: Callable[[], float]) -> None:
        self._node = node
        self._silence = {quantity: Silence(now) for quantity in QUANTITIES}
        self._throttle = NAN
        self._speeds: list[float] = []
        self._opened: set[str] = set()
        self.problems: dict[str, str] = {}
        self._sources = [source for quantity in QUANTITIES
                         if (source := find_source(quantity, values)) is not None]

    @property
    def topics(self) -> list[str]:
        """Return the topics that may be subscribed to."""
        return [source.topic for source in self._sources]

    def age(self, quantity: str) -> float | None:
        """Return the seconds since a message came; None when there was none."""
        return self._silence[quantity].age

    def throttle(self, stale_after: float) -> float:
        """Return the throttle, 0..1; NaN when none younger than `stale_after`, s, came."""
        age = self._silence['throttle'].age
        return self._throttle if age is not None and age <= stale_after else NAN

    def take_speeds(self) -> list[float]:
        """Return the motor speeds that came since this was asked last; empty: none."""
        speeds, self._speeds = self._speeds, []
        return speeds

    def watch(self) -> None:
        """Subscribe to what is published in a type that is known."""
        for source in self._sources:
            if source.quantity in self._opened:
                continue
            if source.spec is not None:
                self._try(source)
                continue
            topic = self._node.resolve_topic_name(source.topic)
            types = types_on(self._node, topic)
            chosen = source.choose(types)
            if chosen is not None:
                self._try(chosen)
            elif types:
                self._problem(source.quantity, (
                    f"{topic} carries {', '.join(types)}: set {source.quantity}.type and "
                    f'{source.quantity}.field, or msg_config.'))

    def _try(self, source: Source) -> None:
        try:
            message, extractor = source.open_many()
        except InputError as error:
            self._problem(source.quantity, f'{source.quantity} is not used: {error}')
            return
        self.problems.pop(source.quantity, None)
        self._opened.add(source.quantity)

        def take(arrived: Any) -> None:
            values = extractor.extract(arrived).tolist()
            if source.quantity == 'rpm':
                self._speeds = values
            elif len(values) == 1 and math.isfinite(values[0]):
                self._throttle = values[0]
            else:
                return
            self._silence[source.quantity].heard()
        self._node.create_subscription(
            message, source.topic, self._node.guarded(take), INPUT_QOS)
        self._node.get_logger().info(
            f'{source.quantity} from {self._node.resolve_topic_name(source.topic)}: '
            f"{extractor.spec.type} field '{extractor.spec.field}'")

    def _problem(self, quantity: str, text: str) -> None:
        if self.problems.get(quantity) != text:
            self.problems[quantity] = text
            self._node.get_logger().warning(text, throttle_duration_sec=10.0)
