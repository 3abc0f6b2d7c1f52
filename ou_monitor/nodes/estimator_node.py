"""
The node `estimator`: voltage and throttle -> OU estimate, brown-out risk and flag.

doc/messages.md lists its topics, services and fields.  Inputs are best effort; outputs are
reliable, at `publish_rate` in real time.  `~/brownout` is published only while the flag is known,
so that it is never false by mistake.  Messages wait in the middleware (doc/reliability.md: how
many), and are fetched 50 times a second and read before each report, so that a flood of messages
does not delay an output.  Hold, delay and latch run in real time, even under `use_sim_time`.

Limits: one voltage.  The values of an estimate older than `stale_after` are published as NaN, but
`~/state` still shows them.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path
import sys
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import LOCK, MonitorNode, PUBLISH_RATE, SWITCH
from ou_monitor.nodes.clocks import IN_BURSTS, SendClock
from ou_monitor.nodes.inputs import (
    Arrivals, Console, NO_CLOCK, PolledInput, PublisherWatch, Silence, SourceFinder, Stamper)
from ou_monitor.nodes.node_files import LatchFile, ModelChoice
from ou_monitor.nodes.sources import Source, SOURCE_PARAMETERS
from ou_monitor.online.monitor import MonitorReport, SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.online.settings import (
    ESTIMATOR_PARAMETERS, monitor_settings, MonitorSettings, Parameter)
from ou_monitor.records import FloatArray, Level
from ou_monitor.stream.samples import SampleStream, SourceClock
from rclpy.logging import get_logging_directory
from std_msgs.msg import Bool, Float64

# Period of fetching the waiting messages, s, whatever `publish_rate` is.
POLL = 0.02
# Maximum time between two transfers of fetched messages to the monitor, s; each report makes a
# transfer too.  A transfer takes 2 to 3 ms of CPU, however few the samples.
HAND_OVER = 0.25
# Maximum share of CPU time.  To stay below it, estimates are made less often, and if pushing the
# samples alone exceeds it, samples are thinned.
SHARE = 0.25
# CPU time of an estimate, s, above which it is not repeated for every report.
HEAVY = 0.02
MOST_THIN = 1024  # Maximum factor by which samples are thinned
# Maximum number of throttle messages that are placed among the voltages in one transfer; of more,
# an even selection is used.
MOST_THROTTLES = 100
STATE_FILE = Parameter(
    'state_file', '',
    'File that keeps a latched flag over a restart of the node (if a folder: a file in it, named '
    "after the node; a relative path is under ROS's log directory); empty: off.")
LANDED = 0.05  # Throttle above which the craft may be in flight
OUTPUTS = ('alpha', 'sigma', 'var_inf', 'brownout_risk', 'throttle_budget')


class EstimatorNode(MonitorNode):
    """Sliding OU estimate of one supply, as a node."""

    RUN_TIME = (*ESTIMATOR_PARAMETERS, PUBLISH_RATE)
    FIXED = (*SOURCE_PARAMETERS, STATE_FILE)

    def __init__(self, name: str, *, managed: bool = False) -> None:
        self._models = ModelChoice()
        super().__init__(name, managed=managed)

    def start(self) -> None:
        sys.setswitchinterval(SWITCH)
        values = self.values()
        settings = _settings(values)
        self._monitor = SupplyMonitor(settings, self._models.use(settings.model_file),
                                      background=True)
        self._stream = SampleStream(self._monitor)
        self._inputs: dict[str, PolledInput] = {}
        self._arrived = Silence(self.steady_now)
        self._usable = Silence(self.steady_now)
        self._source_clock = SourceClock()
        self._watched = PublisherWatch(self)
        self._settled = 0
        self._console = Console(self)
        # Times, s, at which the next estimate is due, and at which outputs and diagnostics were
        # last published; below: CPU time of pushing samples, s, and since when it is counted.
        self._due = self._published = self._diagnosed = -math.inf
        self._load, self._loaded = 0.0, self.steady_now()
        self._handed_over = -math.inf
        self._throttle_silence = Silence(self.steady_now)
        self._outputs = {key: self.create_publisher(Float64, '~/' + key, 10) for key in OUTPUTS}
        self._brownout = self.create_publisher(Bool, '~/brownout', 10)
        self._state = self.create_publisher(DiagnosticArray, '~/state', 10)
        self.serve('~/clear_brownout', self._clear)
        self.serve('~/save_model', self._save_model)
        self._stamper = Stamper(self, self._jumped)
        self._send_clock: SendClock | None = SendClock()
        self._latch = self._open_latch(values[STATE_FILE.name])
        self._sources = SourceFinder(self, ('voltage', 'throttle'), values, self._open)
        self._sources.watch('voltage')
        self.every(0.2, self._watch)
        self.every(POLL, lambda: self._poll(HAND_OVER))
        self.every(1.0, self._diagnose)
        self.publish_every(lambda: self._publish(*self._report()))

    def _open_latch(self, name: str) -> LatchFile | None:
        if not name:
            return None
        latch = LatchFile(Path(get_logging_directory()) / Path(name).expanduser(),
                          self.get_fully_qualified_name())
        # At the stop, finish a write in progress.
        self.at_stop(latch.close)
        reason = latch.read()
        if latch.problem:
            self.get_logger().error(latch.problem)
        if latch.refused:
            self._monitor.doubt_brownout(latch.problem)
        if reason and self._monitor.settings.brownout_latch:
            self._monitor.set_brownout(reason)
            self.get_logger().warning(f'The brown-out flag is CRITICAL: {reason}')
        return latch

    def recover(self, error: Exception) -> None:
        """Restart the monitor without the data so far, after an exception in a callback."""
        if self.running:
            self._monitor.restart(error)

    def check(self, values: Mapping[str, Any]) -> None:
        path = _settings(values).model_file
        self._models.check(path, self._keep_working)

    def _keep_working(self) -> None:
        """Do the work of the timers while a callback waits for a file."""
        if not self.running:
            return
        now = self.steady_now()
        self._poll()
        if now - self._published >= 1.0 / self.values()[PUBLISH_RATE.name]:
            self._publish(*self._report())
        if now - self._diagnosed >= 1.0:
            self._diagnose()

    def apply(self, values: Mapping[str, Any]) -> None:
        """Apply checked parameters; no sample in the window is lost."""
        super().apply(values)
        settings = _settings(values)
        self._monitor.configure(settings)
        self._monitor.set_model(self._models.use(settings.model_file))

    # -- sources of the input

    def _watch(self) -> None:
        self._stamper.follow()
        self._watched.look(self._inputs.get('voltage'))
        if self._arrived.age == math.inf and not self._sources.problems['voltage']:
            self._console.waiting(self._voltage.topic)
        self._sources.watch()
        # A slow source may miss three messages.
        limit = 3.0 * max(self._monitor.settings.stale_after, self._throttle_silence.interval)
        if self._throttle_silence.age > limit and not math.isnan(self._stream.throttle):
            self._stream.lose_throttle()

    def _open(self, source: Source) -> None:
        message, spec = source.open()
        if source.quantity == 'voltage':
            self._stream.open_voltage(spec)
            if spec.sample_rate is not None:
                # Blocks have their own time line.
                self._send_clock = None
        else:
            self._stream.open_throttle(spec)
        self._inputs[source.quantity] = PolledInput(
            self, message, source.topic, spec, source.current)

    # -- messages in

    def _poll(self, most: float = 0.0) -> None:
        """Fetch messages; pass them on if the last transfer was at least `most` s ago."""
        for each in self._inputs.values():
            each.fetch()
        now = self.steady_now()
        # On simulated time, transfer at once, because a message counts as received when read.
        if now - self._handed_over < most and not self._stamper.simulated and not any(
                each.full for each in self._inputs.values()):
            return
        self._handed_over = now
        voltage = self._inputs['voltage'].take() if 'voltage' in self._inputs else None
        throttle = self._inputs['throttle'].take() if 'throttle' in self._inputs else None
        if throttle is not None:
            voltage = self._merge(voltage, throttle)
        if voltage is not None:
            self._take_voltages(voltage)
        pushing = time.thread_time()
        self._stream.flush()
        self._thin_if_costly(time.thread_time() - pushing)

    def _merge(self, voltage: Arrivals | None, throttle: Arrivals) -> Arrivals | None:
        """Place throttle messages among voltages by arrival; return the remaining voltages."""
        times = self._times(throttle)
        column = throttle.column
        for k in range(0, column.n, -(-column.n // MOST_THROTTLES)):
            if voltage is not None:
                first, voltage = voltage.split(int(np.searchsorted(
                    voltage.arrived, throttle.arrived[k], 'left')))
                self._take_voltages(first)
            if self._stream.add_throttle(times.item(k), bool(column.stamped[k]),
                                         column.values.item(k)):
                self._throttle_silence.record(throttle.arrived.item(k))
        return voltage

    def _take_voltages(self, messages: Arrivals) -> None:
        column = messages.column
        if not column.n:
            return
        self._arrived.record(messages.arrived.item(-1))
        ends = self._times(messages, self._send_clock)
        if self._send_clock is not None and self._send_clock.settled > self._settled:
            # Earlier messages, perhaps also some of this poll, have times on another time line.
            self._settled = self._send_clock.settled
            self._stream.reset('the source is steady: messages that came in bursts get new times')
            ends = np.full(ends.size, math.nan)
        held = self._stream.take_voltages(
            ends, column.stamped, column.counts, column.values, messages.arrived,
            column.beside)
        if held.any():
            # On simulated time the arrival time is unknown, so use the present time.
            received = (np.full(ends.size, self.stamp_now()) if self._stamper.simulated
                        else messages.received)
            self._usable.record(messages.arrived[held].item(-1))
            self._source_clock.take(ends[held], received[held], messages.arrived[held].item(-1))

    def _times(self, messages: Arrivals, smooth: SendClock | None = None) -> FloatArray:
        """Return the times of messages, s: stamps, or sending times where there is no stamp."""
        column = messages.column
        if column.stamped.all():
            return column.stamp
        return np.array([
            end if own else self._stamper.source_time(end, smooth)
            for end, own in zip(column.stamp.tolist(), column.stamped.tolist())])

    def _thin_if_costly(self, pushed: float) -> None:
        """Thin the samples if pushing them costs too much (pushed: CPU time, s)."""
        self._load += pushed
        now = self.steady_now()
        if now - self._loaded < 1.0:
            return
        share = self._load / (now - self._loaded)
        self._load, self._loaded = 0.0, now
        stream = self._stream
        if share > SHARE and stream.thin < MOST_THIN:
            stream.thin *= 2
        elif share < 0.25 * SHARE and stream.thin > 1:
            stream.thin //= 2

    def _jumped(self, reason: str) -> None:
        self._source_clock = SourceClock()
        self._stream.reset(reason)

    def _clear(self) -> str:
        if self.locked:
            raise InputError(
                f'{LOCK.name} is set: the flag is cleared only by restarting the node without it'
                + (', and without the file of state_file.' if self._latch else '.'))
        done = self._monitor.clear_brownout()
        if not done:
            raise InputError('Nothing to clear: the brown-out flag is not CRITICAL.')
        return done

    def _save_model(self) -> str:
        """Write the load model learned in this flight into `model_file`, after landing."""
        loads, model = self._monitor.load_filter, self._monitor.model
        learned = loads.learned()
        if self.locked:
            raise InputError(f'{LOCK.name} is set: the model stays as it is.')
        if self._stream.throttle > LANDED:
            raise InputError('Land first: throttle is not at rest.')
        if model is None:
            raise InputError('There is no model_file.')
        if learned is None or not learned.level > 0.0:
            raise InputError('Nothing to save: throttle moved too little to determine the sag.')
        found = loads.against(model.load)
        values = {'level_v': learned.volts, 'sag_ratio': found.sag_ratio,
                  'sag_ratio_se': found.sag_ratio_se, 'resistance_ohm': learned.resistance,
                  'noise_v': learned.noise}
        path = self._models.save(learned, {
            'date': time.strftime('%Y-%m-%d', time.gmtime()),
            **{name: value if value > 0.0 else None for name, value in values.items()}},
            self._keep_working)
        self._monitor.set_model(self._models.use(path))
        return f'{path}: saved the load model of this flight; unchanged: {self._models.terms}.'

    # -- reports out

    def _report(self) -> tuple[MonitorReport, Level, str]:
        """Return the monitor's report, and its level and summary with the node's findings."""
        self._poll()
        now = self.steady_now()
        bursts = self._send_clock is not None and self._send_clock.in_bursts
        self._monitor.distrust(IN_BURSTS if bursts else '')
        again, begin = now >= self._due, time.thread_time()
        report = self._monitor.report(
            self._source_clock.age(now), now, self._usable.age, again=again)
        if again:
            # At 10 Hz, an estimate of 1 ms costs little; after 100 ms, the next one must wait.
            took = time.thread_time() - begin
            self._due = now + (took / SHARE if took > HEAVY else 0.0)
        self._console.flag(report.flag)
        if self._latch is not None:
            self._latch.keep(report.flag.level is FlagLevel.CRITICAL
                             and self._monitor.settings.brownout_latch, report.flag.reason)
        level, summary = report.level, report.summary
        problem = self._sources.problems['voltage']
        limit = max(self._monitor.settings.stale_after, report.patience)
        silent = not report.fresh
        if level is Level.ERROR:
            # The active flag is reported before problems of the input.
            summary = f'{summary} {problem}' if problem else summary
        elif problem:
            level, summary = (Level.ERROR if silent else Level.WARN), problem
        elif 'voltage' not in self._inputs:
            summary = f'Waiting for a publisher on {self._topic}.'
        elif silent and self._arrived.age <= limit and (
                self._usable.age > max(report.patience, self._arrived.age)):
            summary = self._why_unusable()
        elif silent and not self.count_publishers(self._topic):
            summary = f'No publisher on {self._topic}: {report.summary}'
        notes = self._notes()
        if notes:
            summary = ' '.join((summary, *notes))
            level = max(level, Level.WARN) if level is not Level.STALE else level
        if self._latch is not None and self._latch.problem:
            # Report a problem of the latch file in any case, because the user relies on the latch.
            level, summary = Level.ERROR, f'{summary} {self._latch.problem}.'
        return report, level, summary

    def _notes(self) -> list[str]:
        notes = []
        if self._stream.thin > 1:
            notes.append(f'Overload: one of {self._stream.thin} samples enters the estimate; all '
                         'are checked against the floor.')
        notes += self.fault_notes
        if 'voltage' in self._inputs:
            notes += self._watched.notes(self._topic)
        return notes

    def _why_unusable(self) -> str:
        """Return why arriving messages contain no usable voltage."""
        if self._stamper.waiting and self._stream.unplaced:
            return f'Messages without a stamp cannot be placed in time: {NO_CLOCK}'
        spec = self._voltage.spec
        return (f'Messages arrive on {self._topic}, but their field '
                f"'{spec.field if spec else ''}' holds no finite voltage.")

    @property
    def _voltage(self) -> Source:
        return self._sources.opened.get('voltage', self._sources.sources['voltage'])

    @property
    def _topic(self) -> str:
        return str(self.resolve_topic_name(self._voltage.topic))

    def _publish(self, report: MonitorReport, level: Level, summary: str) -> None:
        """Publish a report on every topic but the diagnostics."""
        self._published = self.steady_now()
        values = {'alpha': report.estimate.alpha, 'sigma': report.estimate.sigma,
                  'var_inf': report.estimate.var_inf, 'brownout_risk': report.risk,
                  'throttle_budget': report.budget}
        for key, output in self._outputs.items():
            # Publish stale values as unknown.
            output.publish(Float64(data=values[key] if report.fresh else math.nan))
        if report.brownout is not None:
            self._brownout.publish(Bool(data=report.brownout))
        self._state.publish(self._message('state', report, level, summary, report.estimate.t))

    def _diagnose(self) -> None:
        self._diagnosed = self.steady_now()
        found = self._report()
        if found[0].flag.low:
            # Without a hold, a dip is in only one report, so publish this one.
            self._publish(*found)
        self._diagnostics.publish(self._message('supply', *found, self.stamp_now()))

    def _message(self, part: str, report: MonitorReport, level: Level, summary: str,
                 stamp: float) -> DiagnosticArray:
        settings = self._monitor.settings
        fields = {**report.fields,
                  'brownout_voltage': settings.brownout_voltage,
                  'brownout_horizon': settings.brownout_horizon,
                  'msg_config': self._voltage.config,
                  'messages': self._stream.messages,
                  'smoothed_rate': self._send_clock.rate if self._send_clock else math.nan,
                  'throttle_age': self._throttle_silence.age,
                  'throttle_problem': self._sources.problems.get('throttle', ''),
                  'model_terms': self._models.terms,
                  'clock': self._source_clock.name,
                  'arrival_age': self._arrived.age,
                  **self._watched.fields(),
                  'callback_errors': self.faults}
        return self.status(part, level, summary, fields, stamp, self._topic)


def _settings(values: Mapping[str, Any]) -> MonitorSettings:
    return monitor_settings({p.name: values[p.name] for p in ESTIMATOR_PARAMETERS})
