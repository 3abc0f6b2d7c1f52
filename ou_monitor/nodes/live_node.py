"""
The node of the live page: listens to estimator and filter, and keeps rows of the last minute.

Limits: with five rows per second, the plot of the voltage misses dips between two rows (the flag
shows them).  For the filter's signals, each row has the extremes since the previous row.
"""

from __future__ import annotations

from collections import deque
from functools import partial
import math
from threading import Lock
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from ou_monitor.errors import InputError
from ou_monitor.nodes.filter_channels import channels_of
from ou_monitor.nodes.inputs import INPUT_QOS, types_on
from ou_monitor.nodes.sources import message_class
from rclpy.node import Node
from std_msgs.msg import Float64

# Period of the rows, s, and number of rows kept.
PERIOD, KEPT = 0.2, 300
# Period of checking the graph, s.
_LOOK = 1.0
# Age above which a state is no longer shown, s.
_STALE = 2.0
# Fields of the state shown as numbers, and as words.
_NUMBERS = ('voltage', 'throttle', 'sigma', 'noise_std', 'brownout_risk', 'throttle_budget', 'age')
_WORDS = ('brownout', 'brownout_level', 'risk_basis', 'status')
# Topics that a filter subscribes to in addition to its signal.
_BESIDE = ('sigma', 'state', 'rpm', 'throttle', 'clock')


class LiveNode(Node):
    """Listens to the nodes `estimator` and `low_pass`, and makes rows for the page."""

    def __init__(self, estimator: str, low_pass: str) -> None:
        super().__init__('ou_live')
        self._lock = Lock()
        self._rows: deque[dict[str, Any]] = deque(maxlen=KEPT)
        self._count = 0
        self._begin = time.monotonic()
        self._state: dict[str, str] = {}
        self._level, self._summary, self._state_arrival = 0, '', -math.inf
        # Cutoff, Hz, and lag, ms, of the filter.
        self._newest = {'cutoff': math.nan, 'lag': math.nan}
        self._signals: dict[str, list[float]] = {'raw': [], 'filtered': []}
        self._open: dict[str, str] = {}
        self._estimator, self._filter = estimator, low_pass
        self.create_subscription(DiagnosticArray, f'{estimator}/state', self._take_state, 10)
        for name in self._newest:
            self.create_subscription(
                Float64, f'{low_pass}/{name}', partial(self._take_number, name), 10)
        self.create_timer(PERIOD, self._add_row)
        self.create_timer(_LOOK, self._find_signals)

    def rows(self, after: int) -> list[dict[str, Any]]:
        """Return the rows with numbers above `after`."""
        with self._lock:
            return [row for row in self._rows if row['k'] > after]

    # -- messages in

    def _take_state(self, message: Any) -> None:
        status = message.status[0]
        self._state = {item.key: item.value for item in status.values}
        self._level, self._summary = status.level[0], status.message
        self._state_arrival = time.monotonic()

    def _take_number(self, name: str, message: Any) -> None:
        self._newest[name] = message.data

    def _find_signals(self) -> None:
        """Subscribe to the filter's signals once they exist."""
        self._listen('filtered', f'{self._filter}/output')
        source = self._input()
        if source:
            self._listen('raw', source)

    def _input(self) -> str:
        """Return the topic of the filter's input; empty if there is none."""
        space, _, name = self._filter.rpartition('/')
        try:
            topics = self.get_subscriber_names_and_types_by_node(name, space or '/')
        except Exception:
            # The node does not exist yet; each rclpy version raises its own error for that.
            return ''
        return next((topic for topic, _ in topics
                     if topic.rpartition('/')[2] not in _BESIDE), '')

    def _listen(self, name: str, topic: str) -> None:
        kinds = types_on(self, topic)
        if not kinds or self._open.get(name) == topic:
            return
        try:
            channels = channels_of(kinds[0], '')
            kind = message_class(kinds[0])
        except InputError:
            return

        def keep(message: Any) -> None:
            values = channels.take(message)
            if len(values) and math.isfinite(values[0]):
                self._signals[name].append(float(values[0]))
        self._open[name] = topic
        self.create_subscription(kind, topic, keep, INPUT_QOS)

    # -- rows out

    def _add_row(self) -> None:
        now = time.monotonic()
        silent = now - self._state_arrival
        row: dict[str, Any] = {
            't': now - self._begin, 'silent': None if math.isinf(silent) else silent,
            'limit': known(self._state.get('brownout_voltage')),
            'horizon': known(self._state.get('brownout_horizon'))}
        if silent < _STALE:
            row.update({name: known(self._state.get(name)) for name in _NUMBERS})
            row.update({name: self._state.get(name, '') for name in _WORDS})
            row.update(level=self._level, summary=self._summary)
        row.update({name: known(value) for name, value in self._newest.items()})
        for name, values in self._signals.items():
            row[name] = [min(values), max(values)] if values else None
            values.clear()
        with self._lock:
            self._count += 1
            self._rows.append({'k': self._count, **row})


def known(value: str | float | None) -> float | None:
    """Return a number for JSON; None if it is not a finite number."""
    try:
        number = math.nan if value is None else float(value)
    except ValueError:
        return None
    return number if math.isfinite(number) else None
