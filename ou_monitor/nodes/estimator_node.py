"""
The node of `estimator`.

Inputs: voltage and throttle, as a msg_config says (`voltage`, `throttle` by
default), best effort.  Outputs at `publish_rate` of real time, reliable:
`~/alpha`, `~/sigma`, `~/var_inf`, `~/brownout_risk`, `~/throttle_budget`
(std_msgs/Float64, NaN when not known), `~/brownout` (std_msgs/Bool, published
only while it is known, so that it is never silently false), `~/state`
(DiagnosticArray, every field of one estimate, stamped with the estimate's
newest sample), and `/diagnostics` at 1 Hz.  Service `~/clear_brownout`
(std_srvs/Trigger): drops a flag that is latched or held.  Hold, delay and
latch count real time, under `use_sim_time` too.

Limits: one voltage; an estimate older than `stale_after` is not published as
a number, though `~/state` still shows its fields.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import diagnostic, MonitorNode, PUBLISH_RATE
from ou_monitor.nodes.clocks import SendClock
from ou_monitor.nodes.inputs import INPUT_QOS, Silence, Stamper, types_on
from ou_monitor.nodes.model_choice import ModelChoice
from ou_monitor.nodes.sources import find_source, Source, SOURCE_PARAMETERS
from ou_monitor.online.monitor import Level, MonitorReport, SupplyMonitor
from ou_monitor.online.settings import ESTIMATOR_PARAMETERS, monitor_settings
from ou_monitor.stream.samples import SampleStream
from std_msgs.msg import Bool, Float64
from std_srvs.srv import Trigger

# How often the samples collected go to the monitor, s, whatever `publish_rate` is: bounds memory.
FLUSH = 0.05
OUTPUTS = ('alpha', 'sigma', 'var_inf', 'brownout_risk', 'throttle_budget')


class EstimatorNode(MonitorNode):
    """Sliding OU estimate of one supply, as a node."""

    def __init__(self, name: str) -> None:
        self._models = ModelChoice()
        super().__init__(name, (*ESTIMATOR_PARAMETERS, PUBLISH_RATE), SOURCE_PARAMETERS)
        settings = monitor_settings(_of_monitor(self.values()))
        self._monitor = SupplyMonitor(settings, self._models.use(settings.model_file))
        self._stream = SampleStream(self._monitor)
        self._arrived = Silence(self.steady_now)
        self._usable = Silence(self.steady_now)
        self._throttle_heard = Silence(self.steady_now)
        self._problems: dict[str, str] = {}
        self._opened: dict[str, Source] = {}
        self._outputs = {key: self.create_publisher(Float64, '~/' + key, 10) for key in OUTPUTS}
        self._brownout = self.create_publisher(Bool, '~/brownout', 10)
        self._state = self.create_publisher(DiagnosticArray, '~/state', 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
        self.create_service(Trigger, '~/clear_brownout', self.guarded(self._clear))
        self._stamper = Stamper(self, self._jumped)
        self._send_clock = SendClock() if self.get_parameter('smooth_stamps').value else None
        self._sources = self._find_sources()
        self.every(0.2, self._watch)
        self.every(FLUSH, self._stream.flush)
        self.every(1.0, self._diagnose)
        self.publish_every(self._publish)

    def check(self, values: Mapping[str, Any]) -> None:
        """Raise `ValueError` when the parameters contradict each other."""
        self._models.check(monitor_settings(_of_monitor(values)).model_file)

    def apply(self, values: Mapping[str, Any]) -> None:
        """Bring checked parameters into force; no sample in the window is lost."""
        super().apply(values)
        settings = monitor_settings(_of_monitor(values))
        self._monitor.configure(settings)
        self._monitor.set_model(self._models.use(settings.model_file))

    # -- where the input comes from

    def _find_sources(self) -> dict[str, Source]:
        values = {p.name: self.get_parameter(p.name).value for p in SOURCE_PARAMETERS}
        sources = {}
        for quantity in ('voltage', 'throttle'):
            source = find_source(quantity, values)
            if source is not None:
                sources[quantity] = source
            if source is not None and source.spec is not None:
                self._open_known(source)
        return sources

    def _open_known(self, source: Source) -> None:
        """Open what needs no publisher; without the throttle's package the voltage will do."""
        try:
            self._open(source)
        except InputError as error:
            if source.quantity == 'voltage':
                raise
            self._problems['throttle'] = f'Throttle is not used: {error}'
            self.get_logger().warning(self._problems['throttle'])

    def _watch(self) -> None:
        """Look at who publishes, 5 times a second."""
        self._stamper.follow()
        for source in self._sources.values():
            if source.quantity in self._opened:
                self._compare(self._opened[source.quantity])
            elif source.spec is None:
                self._detect(source)
        self._watch_throttle()

    def _detect(self, source: Source) -> None:
        """Open the source as soon as a publisher shows a type that is known."""
        topic = self.resolve_topic_name(source.topic)
        types = types_on(self, topic)
        chosen = source.choose(types)
        if chosen is not None:
            self._problems.pop(source.quantity, None)
            self._open(chosen)
        elif types:
            self._problem(source.quantity, (
                f"{topic} carries {', '.join(types)}, which no generic msg_config describes "
                f"({', '.join(source.known_types)}): set {source.quantity}.type and "
                f'{source.quantity}.field, or msg_config.'))

    def _compare(self, source: Source) -> None:
        """Notice publishers of another type: DDS would drop their messages without a word."""
        topic = self.resolve_topic_name(source.topic)
        types = types_on(self, topic)
        self._problems.pop(source.quantity, None)
        if types and source.spec is not None and source.spec.type not in types:
            self._problem(source.quantity, (
                f"{topic} carries {', '.join(types)}, but msg_config '{source.config}' expects "
                f'{source.spec.type}.'))

    def _problem(self, quantity: str, text: str) -> None:
        if self._problems.get(quantity) != text:
            self._problems[quantity] = text
            self.get_logger().warning(text, throttle_duration_sec=10.0)

    def _open(self, source: Source) -> None:
        message, extractor = source.open()
        topic = self.resolve_topic_name(source.topic)
        if source.quantity == 'voltage':
            self._stream.open_voltage(extractor)
            if extractor.spec.sample_rate is not None:
                # Blocks have a time line of their own.
                self._send_clock = None
            take = self._take_voltage
        else:
            self._stream.open_throttle(extractor)
            take = self._take_throttle
        self.create_subscription(message, source.topic, self.with_info(take), INPUT_QOS)
        self._opened[source.quantity] = source
        self.get_logger().info(
            f'{source.quantity} from {topic}: {extractor.spec.type} field '
            f"'{extractor.spec.field}' (msg_config '{source.config}')")

    # -- messages in

    def _take_voltage(self, message: Any, info: Any) -> None:
        self._arrived.heard()
        if self._stream.take_voltage(
                message, lambda: self._stamper.source_time(info, self._send_clock)):
            self._usable.heard()

    def _take_throttle(self, message: Any, info: Any) -> None:
        if self._stream.take_throttle(message, lambda: self._stamper.source_time(info)):
            self._throttle_heard.heard()

    def _watch_throttle(self) -> None:
        """Stop believing a throttle that has fallen silent."""
        age = self._throttle_heard.age
        limit = self._throttle_limit()
        if age is not None and age > limit and not math.isnan(self._stream.throttle):
            self._stream.lose_throttle()

    def _throttle_limit(self) -> float:
        """Return the patience with the throttle, s: three messages missed of a slow source."""
        return 3.0 * max(self._monitor.settings.stale_after, self._throttle_heard.interval)

    def _jumped(self, reason: str) -> None:
        self._stream.reset(reason)

    def _clear(self, request: Any, response: Any) -> Any:
        done = self._monitor.clear_brownout()
        response.success, response.message = bool(done), done or (
            'Nothing to clear: the brown-out flag is not CRITICAL.')
        return response

    # -- reports out

    def _report(self) -> tuple[MonitorReport, Level, str]:
        """Return the monitor's report, with what only the node can know put first."""
        self._stream.flush()
        report = self._monitor.report(self._usable.age, self.steady_now())
        level, summary = report.level, report.summary
        problem = self._problems.get('voltage')
        limit = self._monitor.settings.stale_after
        silent = not report.fresh
        if level is Level.ERROR:
            # A flag that is set comes before what is wrong with the input.
            summary = f'{summary} {problem}' if problem else summary
        elif problem:
            level, summary = (Level.ERROR if silent else Level.WARN), problem
        elif 'voltage' not in self._opened:
            topic = self.resolve_topic_name(self._sources['voltage'].topic)
            summary = f'Waiting for a publisher on {topic}.'
        elif silent and self._arrived.age is not None and self._arrived.age <= limit:
            summary = self._useless()
        elif silent and not self.count_publishers(self._topic('voltage')):
            summary = f"No publisher on {self._topic('voltage')}: {report.summary}"
        return report, level, summary

    def _useless(self) -> str:
        """Say why messages that arrive do not count as a voltage."""
        if self._stamper.waiting and self._stream.unplaced:
            return ('Messages without a stamp cannot be placed in time: use_sim_time is set, but '
                    'nothing comes on /clock.')
        spec = self._opened['voltage'].spec
        return (f"Messages arrive on {self._topic('voltage')}, but their field "
                f"'{spec.field if spec else ''}' holds no finite voltage.")

    def _topic(self, quantity: str) -> str:
        return self.resolve_topic_name(self._opened[quantity].topic)

    def _publish(self) -> None:
        report, level, summary = self._report()
        values = {'alpha': report.estimate.alpha, 'sigma': report.estimate.sigma,
                  'var_inf': report.estimate.var_inf, 'brownout_risk': report.risk,
                  'throttle_budget': report.budget}
        for key, output in self._outputs.items():
            # What is stale is no longer known.
            output.publish(Float64(data=values[key] if report.fresh else math.nan))
        if report.brownout is not None:
            self._brownout.publish(Bool(data=report.brownout))
        self._state.publish(self._message('state', report, level, summary, report.estimate.t))

    def _diagnose(self) -> None:
        self._diagnostics.publish(
            self._message('supply', *self._report(), self.stamp_now()))

    def _message(self, part: str, report: MonitorReport, level: Level, summary: str,
                 stamp: float) -> DiagnosticArray:
        throttle_age = self._throttle_heard.age
        source = self._opened.get('voltage', self._sources['voltage'])
        fields = {**report.fields,
                  'msg_config': source.config,
                  'messages': str(self._stream.messages),
                  'smoothed_rate': repr(self._send_clock.rate if self._send_clock else math.nan),
                  'throttle_age': repr(math.inf if throttle_age is None else throttle_age),
                  'throttle_problem': self._problems.get('throttle', ''),
                  'model_terms': self._models.terms}
        return diagnostic(f'{self.get_fully_qualified_name()[1:]}: {part}', level, summary,
                          fields, stamp, hardware_id=self.resolve_topic_name(source.topic))


def _of_monitor(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that belong to the monitor itself."""
    return {name: value for name, value in values.items() if name != PUBLISH_RATE.name}
