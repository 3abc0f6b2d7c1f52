"""
The node of `adc`.

An IIO device with a buffer is read in blocks by a thread and published on `voltage` as
sensor_msgs/JointState (a header and an array; `position` holds the samples, V, the stamp is that
of the last one, by the kernel): msg_config `adc` reads it.  hwmon, and IIO without a buffer, are
asked at their rate and published as sensor_msgs/BatteryState, a sample each, stamped when asked.
`/diagnostics` at 1 Hz.

Limits: one channel.  The blocks' stamps are the kernel's only with a timestamp channel; holes that
it shows split a block, so that the estimator sees the gap.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
import math
from pathlib import Path
import time
from typing import Any

from ou_monitor.adc.devices import Block, find_device, IioBuffer, PolledChannel
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import MonitorNode, to_time
from ou_monitor.nodes.inputs import Silence
from ou_monitor.nodes.pacing import wait_until
from ou_monitor.online.settings import Parameter
from ou_monitor.records import Level
from sensor_msgs.msg import BatteryState, JointState

ADC_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('device', '', 'IIO or hwmon device: its name, that of its folder, or a path.'),
    Parameter('channel', '', 'Channel, as in_voltage0 or in1; empty: the only one.'),
    Parameter('gain', 1.0, 'Volts of the supply for a volt at the ADC (the divider).',
              1.0e-6, 1.0e6),
    Parameter('offset', 0.0, 'Added after that, V.', -1000.0, 1000.0),
    Parameter('rate', 0.0,
              'Sampling frequency that is set (IIO), or how often a polled device is asked, Hz; '
              '0: as the device says.', 0.0, 1.0e7),
    Parameter('block', 0, 'Samples in a message; 0: those of 10 ms.', 0, 1_000_000),
    Parameter('trigger', '', 'Name of the IIO trigger that is set; empty: as it is.'),
    Parameter('polled', False, 'Whether an IIO device is polled, though it has a buffer.'),
    Parameter('sysfs', '/sys', 'Where sysfs is.'),
    Parameter('dev', '/dev', 'Where the character devices are.'),
)
# Silence after which the device is told to be silent, s.
SILENT = 1.0


class AdcNode(MonitorNode):
    """One voltage of the kernel's, as a node."""

    def __init__(self, name: str) -> None:
        super().__init__(name, (), ADC_PARAMETERS)
        self.begin()

    def start(self) -> None:
        """Open the device, and read it in a thread."""
        values = {p.name: self.get_parameter(p.name).value for p in ADC_PARAMETERS}
        self._gain, self._shift = values['gain'], values['offset']
        folder = find_device(values['device'], Path(values['sysfs']))
        self._device = folder.name
        self._silence = Silence(self.steady_now)
        self._samples, self._interval = 0, math.nan
        self._buffer: IioBuffer | None = None
        work: Callable[[], None]
        if values['polled'] or not (folder / 'scan_elements').is_dir():
            polled = PolledChannel(folder, values['channel'])
            self.rate, channel = values['rate'] or polled.rate, polled.channel
            self._output = self.create_publisher(BatteryState, 'voltage', 10)
            work = self._poller(polled)
        else:
            self._buffer = IioBuffer(
                folder, Path(values['dev']) / folder.name, values['channel'], values['block'],
                values['rate'], values['trigger'])
            self.at_stop(self._close)
            self.rate, channel = self._buffer.rate, self._buffer.channel
            self._output = self.create_publisher(JointState, 'voltage', 100)
            work = self._read
        self._channel = channel
        hint = '' if self._buffer is None else (
            f'; estimator: -p msg_config:=adc -p adc.sample_rate:={self.rate:g}')
        topic = self.resolve_topic_name('voltage')
        self.get_logger().info(f'{self._device} {channel} at {self.rate:g} Hz on {topic}{hint}')
        self.every(1.0, self._diagnose)
        self.run_beside(work)

    def _read(self) -> None:
        """Publish blocks until the end."""
        assert self._buffer is not None
        message = JointState(name=[self._channel])
        for block in self._buffer.blocks():
            if self.ending.is_set():
                return
            if block is not None:
                self._publish(message, block)

    def _publish(self, message: Any, block: Block) -> None:
        message.header.stamp = to_time(block.stamp)
        volts = block.volts * self._gain + self._shift
        # It is taken over as it is; a list would be looked at number by number.
        message.position = array('d', volts.tobytes())
        self._output.publish(message)
        self._samples += volts.size
        self._interval = block.interval
        self._silence.heard()

    def _poller(self, polled: PolledChannel) -> Callable[[], None]:
        """Return the work that asks a channel at its rate."""
        def work() -> None:
            nan = math.nan
            message = BatteryState(
                current=nan, charge=nan, capacity=nan, design_capacity=nan, percentage=nan,
                temperature=nan, present=True, location=self._channel)
            due = time.monotonic()
            while wait_until(due, lambda: not self.ending.is_set()):
                message.header.stamp = to_time(time.time())
                message.voltage = polled.read() * self._gain + self._shift
                self._output.publish(message)
                self._samples += 1
                self._silence.heard()
                # Where it cannot keep up it does not catch up.
                due = max(due + 1.0 / self.rate, time.monotonic())
        return work

    def _diagnose(self) -> None:
        age = self._silence.age
        holes = 0 if self._buffer is None else self._buffer.holes
        level, summary = Level.OK, f'{self._channel} of {self._device} is read.'
        if self.problem:
            level, summary = Level.ERROR, f'{self._device} is no longer read: {self.problem}'
        elif age is None or age > max(SILENT, 3.0 / self.rate if self.rate > 0.0 else 0.0):
            level, summary = Level.STALE, (
                f'No samples of {self._channel} from {self._device}'
                + ('' if age is None else f' for {age:.1f} s')
                + ': does its trigger run?')
        elif holes:
            level, summary = Level.WARN, (
                f'{summary} {holes} times samples were missing: a larger block, or a lower rate.')
        fields = {
            'device': self._device, 'channel': self._channel, 'rate': repr(self.rate),
            'measured_rate': repr(1.0 / self._interval if self._interval > 0.0 else math.nan),
            'samples': str(self._samples), 'holes': str(holes),
            'stamps': 'kernel' if self._interval > 0.0 else 'read'}
        self.diagnose('adc', level, summary, fields, self._device)

    def _close(self) -> None:
        """Stop the buffer."""
        assert self._buffer is not None
        try:
            self._buffer.close()
        except InputError as error:
            self.get_logger().warning(str(error))
