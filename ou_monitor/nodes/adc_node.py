"""
The node `adc`: publish the voltage of a Linux IIO or hwmon device.

A thread reads an IIO device with a buffer in blocks, and publishes each block on `voltage` as a
sensor_msgs/JointState, because that has a header and an array: `position` contains the samples, V,
and the stamp is the kernel's time of the last sample.  msg_config `adc` describes these messages.
hwmon devices, and IIO devices without a buffer, are polled; each sample is a
sensor_msgs/BatteryState, stamped when polled.

Limits: one channel.  Blocks have kernel stamps only if the device has a timestamp channel; a gap
in these stamps splits a block, so that the estimator detects the gap.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable
from functools import partial
import math
from pathlib import Path
import time
from typing import Any

from ou_monitor.adc import Block, find_device, IioBuffer, PolledChannel
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import battery, MonitorNode, to_time, wait_until
from ou_monitor.nodes.inputs import Silence
from ou_monitor.online.settings import Parameter
from ou_monitor.records import Level
from sensor_msgs.msg import BatteryState, JointState

ADC_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('device', '', 'IIO or hwmon device: its name, its folder name, or a path.'),
    Parameter('channel', '', 'Channel, such as in_voltage0 or in1; empty: the only one.'),
    Parameter('gain', 1.0, 'Supply volts per volt at the ADC (the divider).',
              1.0e-6, 1.0e6),
    Parameter('offset', 0.0, 'Added after the gain, V.', -1000.0, 1000.0),
    Parameter('rate', 0.0,
              'Sampling frequency to set (IIO), or polling rate of a polled device, Hz; '
              '0: as the device is set.', 0.0, 1.0e7),
    Parameter('block', 0, 'Samples in a message; 0: 10 ms of samples.', 0, 1_000_000),
    Parameter('trigger', '', 'Name of the IIO trigger to set; empty: unchanged.'),
    Parameter('polled', False, 'Whether to poll an IIO device even if it has a buffer.'),
    Parameter('sysfs', '/sys', 'Path of sysfs.'),
    Parameter('dev', '/dev', 'Path of the character devices.'),
)
# Time without samples after which the device is reported as silent, s.
SILENT = 1.0


class AdcNode(MonitorNode):
    """One voltage read from the kernel, as a node."""

    FIXED = ADC_PARAMETERS

    def start(self) -> None:
        values = self.values()
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
            work = partial(self._poll, polled)
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
        # Assign an array, because the message would check each number of a list.
        message.position = array('d', volts.tobytes())
        self._output.publish(message)
        self._samples += volts.size
        self._interval = block.interval
        self._silence.record()

    def _poll(self, polled: PolledChannel) -> None:
        message = battery(self._channel)
        due = time.monotonic()
        while wait_until(due, lambda: not self.ending.is_set()):
            message.header.stamp = to_time(time.time())
            message.voltage = polled.read() * self._gain + self._shift
            self._output.publish(message)
            self._samples += 1
            self._silence.record()
            # Skip missed polls.
            due = max(due + 1.0 / self.rate, time.monotonic())

    def _diagnose(self) -> None:
        holes = 0 if self._buffer is None else self._buffer.holes
        level, summary = Level.OK, f'{self._channel} of {self._device} is read.'
        if self.problem:
            level, summary = Level.ERROR, f'{self._device} is no longer read: {self.problem}'
        elif self._silence.age > max(SILENT, 3.0 / self.rate if self.rate > 0.0 else 0.0):
            level, summary = Level.STALE, (
                f'No samples of {self._channel} from {self._device}{self._silence.words}: '
                'is its trigger running?')
        elif holes:
            level, summary = Level.WARN, (
                f'{summary} Samples were lost {holes} times: enlarge the block or lower the rate.')
        fields = {
            'device': self._device, 'channel': self._channel, 'rate': self.rate,
            'measured_rate': 1.0 / self._interval if self._interval > 0.0 else math.nan,
            'samples': self._samples, 'holes': holes,
            'stamps': 'kernel' if self._interval > 0.0 else 'read'}
        self.diagnose('adc', level, summary, fields, self._device)

    def _close(self) -> None:
        assert self._buffer is not None
        try:
            self._buffer.close()
        except InputError as error:
            self.get_logger().warning(str(error))
