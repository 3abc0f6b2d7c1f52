"""
The node `supply_simulator`: publish the voltage of a saved model under throttle.

A thread simulates samples under the newest throttle, and publishes each when the node's clock
reaches its time.  doc/simulation.md describes topics, parameters and `~/reset`.

Limits: one voltage, no current.  Above 200 Hz, samples are drawn in pieces of 20 ms, so throttle
acts up to 20 ms late, and messages with a stamp are sent together at the end of a piece.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
import threading
import time
from typing import Any

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import battery, MonitorNode, NAP
from ou_monitor.nodes.inputs import (
    NO_CLOCK, PolledInput, PublisherWatch, Silence, SourceFinder)
from ou_monitor.nodes.sources import find_source, Source, SOURCE_PARAMETERS
from ou_monitor.online.settings import Parameter
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import FloatArray, Level
from ou_monitor.simulation import (
    is_recording, lacks, Profile, read_profile, recorded_throttle, RunningSupply, STICK_RATE)
from ou_monitor.stream.config import parse_field_path, put, walk

# These are read again at each reset; scale_resistance also takes effect at once.
LIVE_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('seed', 0, 'Seed of the random numbers, from the next ~/reset on.', 0, 2**31 - 1),
    Parameter('capacity_left', -1.0,
              'Initial charge of the pack, 0..1, from the next ~/reset on; -1: the charge at the '
              "start of the model's recording.", -1.0, 1.0),
    Parameter('scale_resistance', 1.0,
              'Factor on the response to throttle: 1.4 is a pack aged by 40 %; effective at once.',
              0.0, 100.0),
)
FIXED_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('model_file', '', 'Model of the supply, from discover --save-model.'),
    Parameter('rate', 100.0, 'Samples per second, Hz.', 0.1, 1000.0),
    Parameter('throttle.play', '',
              'Throttle to play, repeat and publish: a profile (flight, hover), 0..1, points T:U, '
              'or a recording; empty: use the throttle topic.'),
)
_SOURCES = tuple(p for p in SOURCE_PARAMETERS if p.name != 'adc.sample_rate')
# Message types that are used if the parameters specify none.
_USUAL = {'voltage': 'sensor_msgs/msg/BatteryState', 'throttle': 'std_msgs/msg/Float32'}
# Rate, Hz, above which samples are not drawn one by one but in pieces of this length, s: a call of
# the model takes 0.2 ms of CPU, and waking the thread costs as much as a message.
_EACH, _AHEAD = 200.0, 0.02
# Time for which the last throttle is held, s; after it, throttle is 0.
_HOLD = 1.0
# Throttle of a larger magnitude is ignored (as in the estimator); the rest is clipped to 0..1.
_MOST_THROTTLE = 2.0
# If the clock and the next sample differ by more than this, s, the clock was set, and samples
# continue from the clock's time.  The limit is larger than pauses under load, which last up to a
# second.
_JUMP = 5.0
# Period of checking simulated time, s.
_LOOK = 0.002


class Sender:
    """Publishes a number and its stamp in the message that a msg_config describes."""

    def __init__(self, node: MonitorNode, source: Source) -> None:
        if source.spec is None:
            usual = source.choose([_USUAL[source.quantity]])
            assert usual is not None
            source = usual
        self.source = source
        kind, spec = source.open()
        if spec.sample_rate is not None:
            raise InputError(f"msg_config '{source.config}' has blocks of samples, which are not "
                             'simulated live: ou-monitor simulate --type adc_block, and replay')
        self.message = battery() if spec.type == _USUAL['voltage'] else kind()
        self._set = _setter(self.message, spec.field, spec.type)
        self._scale, self._offset = spec.sign * spec.unit_factor, spec.offset
        # Writes the stamp, if there is one.
        self.stamp = None if spec.stamp_field is None else _setter(
            self.message, spec.stamp_field, spec.type, stamp_factor=spec.stamp_factor)
        self._output = node.create_publisher(kind, source.topic, 100)

    def send(self, stamp: float, value: float) -> None:
        """Publish a value (stamp in s)."""
        self._set((value - self._offset) / self._scale)
        if self.stamp is not None:
            self.stamp(stamp)
        self._output.publish(self.message)


def _setter(message: Any, path: str, kind: str, stamp_factor: float = math.nan,
            ) -> Callable[[float], None]:
    """Return a function that writes a number, or a stamp in s, at a field path of a type."""
    *steps, last = parse_field_path(path)
    owner = walk(message, tuple(steps), path, kind)
    now = None if owner is None else walk(owner, (last,), path, kind)
    if now is None:
        raise InputError(f"field '{path}' has no element to write to")
    if hasattr(now, 'nanosec'):
        def stamp(value: float) -> None:
            now.sec, now.nanosec = divmod(round(value * 1e9), 10**9)
        return stamp

    def write(value: float) -> None:
        scaled = value / stamp_factor if stamp_factor > 0.0 else value
        put(owner, (last,), round(scaled) if isinstance(now, int) else scaled)
    return write


class SupplySimulatorNode(MonitorNode):
    """Simulates the voltage of a saved model, as a node."""

    RUN_TIME = LIVE_PARAMETERS
    FIXED = (*_SOURCES, *FIXED_PARAMETERS)

    def start(self) -> None:
        values = self.values()
        self._lock = threading.Lock()
        if not values['model_file']:
            raise InputError('model_file is needed: ou-monitor discover RECORDING --save-model '
                             'm.yaml makes one')
        self._model = read_model(values['model_file']).model
        self._needs_throttle = bool(self._model.needs_throttle) or self._model.charged
        self._lacks = lacks(self._model)
        self._rate = values['rate']
        self._lost = self._sent = 0
        self._reset()
        voltage = find_source('voltage', values)
        assert voltage is not None
        self._voltage = Sender(self, voltage)
        self._sources = SourceFinder(self, ('throttle',), values, self._open)
        self._throttle_source = self._sources.sources.get('throttle')
        self._played = self._play(values['throttle.play'])
        self._input: PolledInput | None = None
        self._throttle_silence = Silence(self.steady_now)
        self._throttle, self._turn = 0.0, -1
        self._watched = PublisherWatch(self)
        self.serve('~/reset', self._reset)
        self.get_logger().info(
            f"{', '.join(term.NAME for term in self._model.terms)} at {self._rate:g} Hz on "
            f'{self.resolve_topic_name(self._voltage.source.topic)}'
            + ''.join(f'; {one}' for one in self._lacks)
            + (f'; its load is a current: throttle 1 means {self._model.full_current:.4g} A'
               if self._model.full_current else ''))
        self._watch()
        self.every(0.2, self._watch)
        self.every(1.0, self._diagnose)
        self.run_beside(self._run)

    def apply(self, values: Mapping[str, Any]) -> None:
        self._run_now.simulation.resistance = values['scale_resistance']

    def check(self, values: Mapping[str, Any]) -> None:
        if -1.0 < values['capacity_left'] < 0.0:
            raise ValueError('capacity_left must lie within 0..1, or be -1')

    def _reset(self) -> str:
        """Start again from the first sample; return what was done."""
        values = self.values()
        left = values['capacity_left']
        charge = math.nan if left < 0.0 else left
        if not self._model.charged and left >= 0.0:
            raise InputError("capacity_left: the model has no entry 'load' over throttle, so its "
                             'charge is unknown')
        with self._lock:
            self._run_now = RunningSupply(
                self._model, rate=self._rate, seed=values['seed'],
                charge=charge if self._model.charged else None,
                resistance=values['scale_resistance'])
            # Stamp of the first sample, s; NaN: set from the clock when that sample is drawn.
            self._begin = math.nan
            self.problem = ''
        return f"Restarted with seed {values['seed']}."

    def _play(self, text: str) -> tuple[Profile, float, Sender] | None:
        """Return the throttle to play, its length, s, and its publisher; None: nothing to play."""
        if not text:
            return None
        if self._throttle_source is None:
            raise InputError('throttle.play: the msg_config has no throttle to publish it on')
        sender = Sender(self, self._throttle_source)
        if is_recording(text):
            flown = read_recording(text)
            return (recorded_throttle(flown, text, self._model.full_current), flown.duration,
                    sender)
        return read_profile(text), math.inf, sender

    # -- throttle

    def _watch(self) -> None:
        if self._played is None:
            self._sources.watch('throttle')
        self._watched.look(self._input)

    def _open(self, source: Source) -> None:
        kind, spec = source.open()
        self._input = PolledInput(self, kind, source.topic, spec)

    def _newest_throttle(self) -> float:
        """Return the newest throttle, which is held for `_HOLD`; after that, 0."""
        found = None if self._input is None else self._input.take()
        if found is not None:
            good = np.flatnonzero(np.abs(found.column.values) <= _MOST_THROTTLE)
            if good.size:
                self._throttle = min(max(float(found.column.values[good[-1]]), 0.0), 1.0)
                self._throttle_silence.record()
        if self._throttle_silence.age > _HOLD:
            self._throttle = 0.0
        return self._throttle

    # -- the thread

    def _run(self) -> None:
        while not self.ending.is_set():
            self._piece()

    def _piece(self) -> None:
        now = self.stamp_now()
        if now <= 0.0 or self.problem:
            time.sleep(NAP)
            return
        with self._lock:
            run = self._run_now
            due = self._begin + run.samples / self._rate
            if not abs(now - due) <= _JUMP + 1.0 / self._rate:
                if not math.isnan(self._begin):
                    self._lost += max(0, int((now - due) * self._rate))
                    self.get_logger().warning(f'the clock jumped by {now - due:+.3g} s: the '
                                              'supply continues from its last state')
                self._begin = now - run.samples / self._rate
            begin = self._begin
            times = run.times(1 if self._rate <= _EACH else int(_AHEAD * self._rate))
            throttle = self._throttle_at(times)
            try:
                voltage = run.draw(throttle)
            except ValueError as error:
                self.problem = str(error)
                self.get_logger().error(self.problem)
                return
        if run.simulation.discharge is not None and hasattr(self._voltage.message, 'percentage'):
            self._voltage.message.percentage = min(max(run.simulation.discharge.charge, 0.0), 1.0)
        for t, u, v in zip(times.tolist(), throttle.tolist(), voltage.tolist()):
            due = times[-1] if self._voltage.stamp is not None else t
            if not self._wait(begin + due) or run is not self._run_now:
                return
            turn = math.floor(t * STICK_RATE + 1e-6)
            if self._played is not None and turn != self._turn:
                self._turn = turn
                self._played[2].send(begin + t, u)
            self._voltage.send(begin + t, v)
            self._sent += 1

    def _throttle_at(self, times: FloatArray) -> FloatArray:
        if self._played is None:
            return np.full(times.size, self._newest_throttle())
        profile, length, _ = self._played
        throttle = profile(times % length if math.isfinite(length) else times)
        self._throttle = float(throttle[-1])
        return throttle

    def _wait(self, due: float) -> bool:
        """Wait until the clock reaches `due`, s, or jumps; return False if the node is ending."""
        while not self.ending.is_set():
            simulated = self.get_clock().ros_time_is_active
            left = due - (self.stamp_now() if simulated else time.time())
            if left <= 0.0 or left > _JUMP + 1.0 / self._rate:
                return True
            time.sleep(_LOOK if simulated else min(left, NAP))
        return False

    # -- diagnostics

    def _diagnose(self) -> None:
        level, notes = Level.OK, []
        topic = '' if self._throttle_source is None else self.resolve_topic_name(
            self._throttle_source.topic)
        voltage = self.resolve_topic_name(self._voltage.source.topic)
        idle = self._throttle_silence.age > _HOLD
        if self._played is None and self._needs_throttle and idle:
            notes.append(f'No throttle {f"on {topic}" if topic else "in this msg_config"}'
                         f'{self._throttle_silence.words}: the craft idles.')
        notes += [*filter(None, self._sources.problems.values()), *self._watched.notes(topic)]
        if self.count_publishers(voltage) > 1:
            notes.append(f'{voltage} has another publisher.')
        notes += self.fault_notes
        if self.stamp_now() <= 0.0:
            notes.append(NO_CLOCK)
        if notes:
            level = Level.WARN
        if self.problem:
            level, notes = Level.ERROR, [f'{self.problem} (~/reset restarts it).']
        run = self._run_now
        discharge = run.simulation.discharge
        fields = {
            'rate': self._rate, 'samples': self._sent, 'lost': self._lost,
            'throttle': self._throttle, 'seed': self.values()['seed'],
            'charge': math.nan if discharge is None else discharge.charge,
            'scale_resistance': run.simulation.resistance,
            'model_terms': ','.join(term.NAME for term in self._model.terms),
            'lacks': '; '.join(self._lacks), **self._watched.fields()}
        self.diagnose('supply', level, ' '.join(notes) or (
            f'A simulated supply at {self._rate:g} Hz on {voltage}.'), fields, voltage)
