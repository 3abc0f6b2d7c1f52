"""
Base class of the nodes: parameters from tables, start and stop, a thread, and diagnostics.

The name and default of each parameter are defined once, in a table.  An exception in a callback
does not end a node.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
import functools
import inspect
import math
from threading import Event, Thread
import time
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from ou_monitor.errors import InputError, nearest
from ou_monitor.nodes.run import one_line
from ou_monitor.online.settings import Parameter
from ou_monitor.records import Level
from rcl_interfaces.msg import (
    FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult)
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.lifecycle import LifecycleNodeMixin, LifecycleState, TransitionCallbackReturn
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.time import Time
from rclpy.timer import Timer
from sensor_msgs.msg import BatteryState
from std_srvs.srv import Trigger

# Declared by rclpy itself.
_BUILT_IN = ('use_sim_time', 'start_type_description_service')

LOCK = Parameter(
    'lock_parameters', False,
    'Whether to refuse what can disarm the node at run time: changes of any parameter except '
    'publish_rate, and the services ~/clear_brownout and ~/save_model.')
# Busy wait at the end of a sleep, s: the usual lateness of `sleep`.  For a 1 kHz bag, the busy
# wait takes a tenth of a core.
SPIN = 0.0001
# Maximum single sleep, s: limits the delay in noticing a signal.
NAP = 0.05
# Maximum time for which a second thread may hold the interpreter, s.  With Python's default, each
# call of the executor, or each message of a replay, may wait for 5 ms.
SWITCH = 2e-4
# Time for which the diagnostics report an exception of a callback, s.
TELL = 10.0
PUBLISH_RATE = Parameter('publish_rate', 10.0, 'How often the outputs are published, Hz.',
                         0.01, 1000.0)


class MonitorNode(Node):
    """Node whose parameters come from tables; a managed node begins when it is activated."""

    # Changes of `RUN_TIME` parameters are checked together (if `check` raises `ValueError`, the
    # old values stay), then passed to `apply`, which must keep all state.  `FIXED` parameters are
    # read at the start.

    RUN_TIME: ClassVar[tuple[Parameter, ...]] = ()
    FIXED: ClassVar[tuple[Parameter, ...]] = ()
    # True between `begin` and `stop`.
    running = False

    def __init__(self, name: str, *, managed: bool = False) -> None:
        Node.__init__(self, name)
        self.managed = managed
        # What the node had when it began; None before that.
        self._before: set[Any] | None = None
        self._at_stop: list[Callable[[], object]] = []
        self.faults, self.fault = 0, ''
        self._faulted = -math.inf
        # Error that ended the work of the thread; empty if there was none.
        self.problem = ''
        self.ending = Event()
        self._thread: Thread | None = None
        self._publishing: Timer | None = None
        self._polled: list[Subscription] = []
        self.steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._changeable = {parameter.name for parameter in self.RUN_TIME}
        self._fixed = {parameter.name for parameter in self.FIXED}
        declared = [*self.RUN_TIME, *self.FIXED, LOCK]
        self._floats = {p.name for p in declared if isinstance(p.default, float) or p.mixed}
        overrides = self._parameter_overrides
        overrides.update({p.name: p for p in self._widen(list(overrides.values()))})
        for parameter in declared:
            self.declare_parameter(parameter.name, parameter.default, _descriptor(
                parameter, read_only=not managed and parameter.name not in self._changeable))
        self._warn_misspelt()
        try:
            self.check(self.values())
        except ValueError as error:
            raise InputError(str(error)) from error
        self.locked = bool(self.get_parameter(LOCK.name).value)
        self.add_pre_set_parameters_callback(self._widen)
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self.guarded(self._after_set))
        if not managed:
            self.begin()

    def start(self) -> None:
        """Create publishers, subscriptions, services and timers."""

    def begin(self) -> None:
        """Start; if that fails, close everything opened so far."""
        self._before = self._entities
        try:
            self._diagnostics = self.create_publisher(DiagnosticArray, '/diagnostics', 10)
            self.start()
        except Exception:
            self.stop()
            raise
        self.running = True

    def stop(self) -> None:
        """Close everything opened since `begin`; parameters stay."""
        self.running = False
        self.ending.set()
        if self._thread is not None:
            # The thread must end before the publishers are closed.
            self._thread.join(2.0)
        for made in set() if self._before is None else self._entities - self._before:
            for destroy in (self.destroy_timer, self.destroy_subscription, self.destroy_service,
                            self.destroy_publisher):
                if destroy(made):
                    break
        for close in self._at_stop:
            close()
        del self._polled[:], self._at_stop[:]
        self._publishing = self._before = None

    def run_beside(self, work: Callable[[], None]) -> None:
        """Run work in a thread; it must end when `ending` is set."""
        def run() -> None:
            try:
                work()
            except Exception as error:
                # Errors of publishing after a shutdown are ignored.
                if not self.ending.is_set() and self.context.ok():
                    self.problem = str(error) if isinstance(error, InputError) else (
                        f'{type(error).__name__}: {error}')
                    self.get_logger().error(self.problem)
        self.ending.clear()
        self._thread = Thread(target=run, daemon=True)
        self._thread.start()

    def at_stop(self, close: Callable[[], object]) -> None:
        """Register a function that is called when the node stops."""
        self._at_stop.append(close)

    def destroy_node(self) -> None:
        self.stop()
        super().destroy_node()

    def values(self) -> dict[str, Any]:
        return {name: self.get_parameter(name).value for name in self._changeable | self._fixed}

    def check(self, values: Mapping[str, Any]) -> None:
        """Raise `ValueError` when the parameters contradict each other."""

    def apply(self, values: Mapping[str, Any]) -> None:
        """Apply checked parameters without losing state."""
        timer = self._publishing
        if timer and timer.timer_period_ns != (period := round(1e9 / values[PUBLISH_RATE.name])):
            timer.timer_period_ns = period
            # Otherwise it applies the new period only at the end of the present one.
            timer.reset()

    def every(self, period: float, callback: Callable[[], None]) -> Timer:
        """Call back every `period` s of real time, so that silence of `/clock` is detected too."""
        return self.create_timer(period, self.guarded(callback), clock=self.steady)

    def publish_every(self, callback: Callable[[], None]) -> None:
        """Call back at `publish_rate`, which may change."""
        self._publishing = self.every(1.0 / self.values()[PUBLISH_RATE.name], callback)

    def guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """Return a callback whose exceptions are reported instead of raised."""
        # An uncaught exception becomes a SystemError in the EventsExecutor.
        @functools.wraps(callback)
        def call(*args: Any) -> Any:
            try:
                return callback(*args)
            except Exception as error:
                # After a shutdown by a signal the publishers are closed: ignore the error.
                if self.context.ok():
                    self._take_fault(error)
        return call

    def _take_fault(self, error: Exception) -> None:
        words = one_line(error)[:200]
        self.fault = f'{type(error).__name__}: {words}' if words else type(error).__name__
        self.faults += 1
        self._faulted = self.steady_now()
        self.get_logger().error(self.fault, throttle_duration_sec=10.0)
        self.recover(error)

    def recover(self, error: Exception) -> None:
        """Restart work that a failed callback may have left unfinished; by default, nothing."""

    @property
    def fault_notes(self) -> list[str]:
        """Return a note on a recent exception of a callback, if any."""
        recent = self.steady_now() - self._faulted < TELL
        return [f'A callback failed ({self.faults} times so far): {self.fault}.'] if recent else []

    def status(self, part: str, level: Level, summary: str, fields: Mapping[str, object],
               stamp: float, hardware_id: str) -> DiagnosticArray:
        """Return the status of a part of the node as a stamped message (stamp in s)."""
        # `repr` keeps all digits of a float.
        message = DiagnosticArray()
        message.header.stamp = to_time(stamp)
        message.status = [DiagnosticStatus(
            level=bytes([level]), name=f'{self.get_fully_qualified_name()[1:]}: {part}',
            message=summary, hardware_id=hardware_id,
            values=[KeyValue(key=key, value=repr(value) if isinstance(value, float)
                             else str(value)) for key, value in fields.items()])]
        return message

    def diagnose(self, part: str, level: Level, summary: str, fields: Mapping[str, object],
                 hardware_id: str) -> None:
        """Publish the status of a part of the node in the diagnostics."""
        self._diagnostics.publish(self.status(
            part, level, summary, fields, self.stamp_now(), hardware_id))

    @property
    def _entities(self) -> set[Any]:
        return {*self.timers, *super().subscriptions, *self.services, *self.publishers}

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Return the subscriptions that an executor serves: all except polled ones."""
        return (s for s in super().subscriptions if s not in self._polled)

    def serve(self, name: str, work: Callable[[], str]) -> None:
        """Offer a Trigger: `work` returns what was done, or refuses by an InputError."""
        def answer(request: Any, response: Any) -> Any:
            try:
                response.message, response.success = work(), True
            except InputError as error:
                response.message, response.success = str(error), False
            return response
        self.create_service(Trigger, name, self.guarded(answer))

    def create_polled(self, kind: Any, topic: str, qos: QoSProfile) -> Subscription:
        """Return a subscription whose messages wait in the middleware until they are taken."""
        # The queue of the EventsExecutor is unbounded, and messages in it delay every timer.
        # rclpy requires a callback, although it is never called.
        polled = self.create_subscription(kind, topic, lambda message: None, qos, raw=True)
        self._polled.append(polled)
        return polled

    def with_info(self, callback: Callable[[Any, Any], None]) -> Callable[..., Any]:
        """Return a guarded subscription callback of (message, info) that suits every executor."""
        # The EventsExecutor of rclpy 7.1 passes one tuple, other executors pass two arguments.
        inner = self.guarded(callback)

        def call(*args: Any) -> None:
            inner(*(args if len(args) == 2 else args[0]))
        call.__signature__ = inspect.signature(callback)  # type: ignore[attr-defined]
        return call

    # Monotonic time, s, for measuring silence, because the wall clock may jump.
    steady_now = staticmethod(time.monotonic)

    def stamp_now(self) -> float:
        """Return the node's clock, s (simulated time when `use_sim_time`)."""
        return float(self.get_clock().now().nanoseconds) * 1e-9

    def _widen(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Turn integers into floats for float parameters, because YAML files may say 2 for 2.0."""
        return [RosParameter(p.name, RosParameter.Type.DOUBLE, float(p.value))
                if p.name in self._floats and p.type_ is RosParameter.Type.INTEGER else p
                for p in parameters]

    def _warn_misspelt(self) -> None:
        """Warn of overrides that rclpy would silently ignore."""
        for name in self._parameter_overrides:
            if not self.has_parameter(name) and not name.startswith(_BUILT_IN):
                known = [key for key in self._parameters if not key.startswith(_BUILT_IN)]
                self.get_logger().warning(
                    f"parameter '{name}' does not exist and is ignored: {nearest(name, known)}")

    def _on_set(self, parameters: list[RosParameter]) -> SetParametersResult:
        changed = {p.name: p.value for p in parameters if p.name in self._changeable}
        if self.locked and (set(changed) - {PUBLISH_RATE.name}
                            or any(p.name == 'use_sim_time' for p in parameters)):
            return SetParametersResult(
                successful=False, reason='lock_parameters is set: only publish_rate can be '
                'changed, until the node is restarted without it')
        if self.running and any(p.name in self._fixed for p in parameters):
            return SetParametersResult(
                successful=False, reason='this parameter is read when the node is activated: '
                'deactivate the node first')
        try:
            if changed:
                self.check({**self.values(), **changed})
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _after_set(self, parameters: list[RosParameter]) -> None:
        if self.running and any(p.name in self._changeable for p in parameters):
            self.apply(self.values())


def _descriptor(parameter: Parameter, read_only: bool) -> ParameterDescriptor:
    """Return what `ros2 param describe` shows."""
    words = list(parameter.choices)
    ends: dict[str, Any] = {}
    if parameter.mixed:
        words.append(f'{parameter.low:g}..{parameter.high:g}')
    elif parameter.low is not None and parameter.high is not None:
        ends = {'integer_range': [IntegerRange(
            from_value=int(parameter.low), to_value=int(parameter.high))]} if isinstance(
                parameter.default, int) else {'floating_point_range': [FloatingPointRange(
                    from_value=float(parameter.low), to_value=float(parameter.high))]}
    return ParameterDescriptor(
        description=parameter.description, read_only=read_only, dynamic_typing=parameter.mixed,
        additional_constraints=' | '.join(words), **ends)


def managed(kind: type[MonitorNode]) -> Callable[[str], MonitorNode]:
    """Return a class of managed nodes from a class of nodes (design.ros2.org)."""
    # Before the node is active, it has only parameters and lifecycle services.  If an InputError
    # refuses a transition, the node stays in its former state.
    class Managed(LifecycleNodeMixin, kind):  # type: ignore[misc, valid-type]
        """A node that begins and ends its work by lifecycle transitions."""

        def __init__(self, name: str) -> None:
            kind.__init__(self, name, managed=True)  # type: ignore[call-arg]
            LifecycleNodeMixin.__init__(self)
            change = self._service_change_state
            original = change.callback

            def answer(request: Any, response: Any) -> Any:
                # rclpy 7.1 raises an exception for an impossible transition, which would end the
                # node.
                try:
                    return original(request, response)
                except Exception as error:
                    self.get_logger().error(f'no such transition now: {one_line(error)}')
                    response.success = False
                    return response
            change.callback = answer

        def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
            def tried() -> None:
                self.begin()
                self.stop()
            return self._done('configured', tried)

        def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('activated', self.begin)

        def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('deactivated', self.stop)

        def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('shut down', self.stop)

        def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
            return self._done('reset', self.stop)

        def _done(self, what: str, work: Callable[[], Any]) -> TransitionCallbackReturn:
            # rclpy would report an exception without its message, so report it here.
            try:
                work()
            except InputError as error:
                self.get_logger().error(f'cannot be {what}: {error}')
                return TransitionCallbackReturn.FAILURE
            except Exception as error:
                self.get_logger().error(f'cannot be {what}: {type(error).__name__}: {error}')
                return TransitionCallbackReturn.ERROR
            return TransitionCallbackReturn.SUCCESS

    return Managed


def wait_until(instant: float, going: Callable[[], bool]) -> bool:
    """Wait until `time.monotonic()` reaches an instant, s; return False once not `going()`."""
    while True:
        if not going():
            return False
        left = instant - time.monotonic()
        if left <= SPIN:
            break
        time.sleep(min(left - SPIN, NAP))
    while time.monotonic() < instant:
        pass
    return True


def battery(location: str = '') -> BatteryState:
    """Return a BatteryState for setting a voltage; all other values are unknown (NaN)."""
    nan = math.nan
    return BatteryState(current=nan, charge=nan, capacity=nan, design_capacity=nan, percentage=nan,
                        temperature=nan, present=True, location=location)


def to_time(stamp: float) -> object:
    """Return the builtin_interfaces/Time of a stamp, s; 0 if the stamp is NaN or out of range."""
    nanoseconds = round(stamp * 1e9) if 0.0 <= stamp < 2.0 ** 31 else 0
    return Time(nanoseconds=nanoseconds).to_msg()
