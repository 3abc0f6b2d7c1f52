"""
The node of `adaptive_filter`.

Inputs (relative names): `sigma` (std_msgs/Float64), `input` (a type of
`filter_channels.CHANNELS`).  Outputs: `~/output` (type and stamp of the
input), `~/cutoff` (std_msgs/Float64, Hz) at `publish_rate`, `/diagnostics`.

Limits: of an IMU the angular velocity is filtered and of a BatteryState the
voltage, the rest passes through;
a message with a non-finite signal is counted and not passed on.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.base import MonitorNode, PUBLISH_RATE
from ou_monitor.nodes.diagnostics import diagnostic
from ou_monitor.nodes.filter_channels import CHANNELS, Channels
from ou_monitor.nodes.inputs import INPUT_QOS, Silence, Stamper, types_on
from ou_monitor.nodes.message_types import message_class
from ou_monitor.online.lowpass import AdaptiveLowPass
from ou_monitor.online.monitor import Level
from ou_monitor.online.settings import FILTER_PARAMETERS, filter_settings, Parameter
from std_msgs.msg import Float64

FIXED = (Parameter('input_type', 'auto', 'Type of `input`; auto: that of its publisher.',
                   choices=('auto', *CHANNELS)),)


class AdaptiveFilterNode(MonitorNode):
    """Low-pass with a cutoff driven by sigma, as a node."""

    def __init__(self, name: str) -> None:
        super().__init__(name, (*FILTER_PARAMETERS, PUBLISH_RATE), FIXED)
        self._channels: Channels | None = None
        self._filters: list[AdaptiveLowPass] = []
        self._sigma = math.nan
        self._sigma_silence = Silence(self.steady_now)
        self._input_silence = Silence(self.steady_now)
        self._dropped = self._passed = 0
        self._found: list[str] = []
        self._type = self.get_parameter('input_type').value
        self._topic = self.resolve_topic_name('input')
        self._stamper = Stamper(self, self._jumped)
        self._cutoff_output = self.create_publisher(Float64, '~/cutoff', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_subscription(Float64, 'sigma', self.guarded(self._take_sigma), INPUT_QOS)
        if self._type != 'auto':
            self._open(self._type)
        self.every(0.2, self._watch)
        self.every(1.0, self._diagnose)
        self.publish_every(self._publish_cutoff)

    def check(self, values: Mapping[str, Any]) -> None:
        """Raise `ValueError` when the parameters contradict each other."""
        filter_settings(_of_filter(values))
        kind = self.get_parameter('input_type').value
        if kind not in ('auto', *CHANNELS):
            raise ValueError(f"input_type: cannot filter '{kind}': {nearest(kind, CHANNELS)}")

    def apply(self, values: Mapping[str, Any]) -> None:
        """Bring checked parameters into force; the output does not move."""
        super().apply(values)
        for channel in self._filters:
            channel.configure(**_of_filter(values))

    @property
    def sigma(self) -> float:
        """Sigma, V/sqrt(s); NaN when it is stale or not known."""
        age = self._sigma_silence.age
        stale = age is None or age > self.get_parameter('stale_after').value
        return math.nan if stale else self._sigma

    def _watch(self) -> None:
        """Subscribe as soon as a publisher shows the type."""
        self._stamper.follow()
        if self._channels is None:
            self._found = types_on(self, self._topic)
            known = [kind for kind in self._found if kind in CHANNELS]
            if known:
                self._open(known[0])

    def _open(self, kind: str) -> None:
        message = message_class(kind)
        self._type, self._channels = kind, CHANNELS[kind]
        self._filters = [AdaptiveLowPass(**_of_filter(self.values()))
                         for _ in self._channels.names]
        self._output = self.create_publisher(message, '~/output', 10)
        self.create_subscription(message, 'input', self.with_info(self._take_input), INPUT_QOS)
        self.get_logger().info(f'filtering {self._topic} ({kind})')

    def _take_sigma(self, message: Float64) -> None:
        self._sigma_silence.heard()
        self._sigma = message.data if message.data >= 0.0 else math.nan

    def _take_input(self, message: Any, info: Any) -> None:
        self._input_silence.heard()
        if self._channels is None:
            raise InputError('a message came before its type was known')
        values = self._channels.take(message)
        stamp = self._stamper.time_of(message, info)
        if not all(map(math.isfinite, (stamp, *values))):
            self._dropped += 1
            return
        sigma = self.sigma
        self._channels.put(message, [
            float(channel.filter(stamp, value, sigma))
            for channel, value in zip(self._filters, values, strict=True)])
        self._output.publish(message)
        self._passed += 1

    def _jumped(self, reason: str) -> None:
        """Do nothing: to the filter a step back is a step of no length, its output stays."""
        self.get_logger().info(f'{reason}: the filter goes on from its output')

    def _publish_cutoff(self) -> None:
        self._cutoff_output.publish(Float64(data=self.cutoff))

    @property
    def cutoff(self) -> float:
        """Cutoff in force, Hz."""
        if self._filters:
            return self._filters[0].cutoff
        return float(self.get_parameter('fallback').value)

    def _diagnose(self) -> None:
        level, summary = self._judge()
        fields = {
            'input_type': self._type, 'cutoff': repr(self.cutoff), 'sigma': repr(self.sigma),
            'passed': str(self._passed), 'dropped': str(self._dropped),
            'sigma_age': repr(self._sigma_silence.age), 'input_age':
            repr(self._input_silence.age)}
        self._diagnostics.publish(diagnostic(
            f'{self.get_fully_qualified_name()[1:]}: adaptive low-pass', level, summary, fields,
            self.stamp_now(), hardware_id=self._topic))

    def _judge(self) -> tuple[Level, str]:
        limit = self.get_parameter('stale_after').value
        age = self._input_silence.age
        if self._channels is None and self._found:
            return Level.WARN, (
                f"Cannot filter {self._topic} of type {', '.join(self._found)}: "
                f"{', '.join(CHANNELS)} only.")
        if self._channels is None:
            return Level.STALE, f'Waiting for a publisher on {self._topic}.'
        if age is None or age > limit:
            return Level.STALE, f'No message on {self._topic}' + (
                ' yet.' if age is None else f' for {age:.1f} s.')
        if self._stamper.waiting and not self._passed:
            return Level.WARN, 'use_sim_time is set, but nothing comes on /clock.'
        if math.isnan(self.sigma):
            topic = self.resolve_topic_name('sigma')
            return Level.WARN, (
                f'Sigma on {topic} is missing, stale or unknown: the cutoff goes to the '
                f"fallback, {self.get_parameter('fallback').value:g} Hz.")
        return Level.OK, f'Cutoff {self.cutoff:.4g} Hz at sigma {self.sigma:.4g} V/sqrt(s).'


def _of_filter(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that belong to the filter itself."""
    return {name: value for name, value in values.items() if name != PUBLISH_RATE.name}
