"""
The node `adaptive_filter`: low-pass a topic, with a cutoff that follows the noise of the supply.

doc/messages.md lists its topics:

- `input`: a type in `filter_channels.CHANNELS`, or with `input.field` any installed type;
- `state` of the estimator, if published: sigma's error, alpha, throttle, noise under load, and
  whether the estimate is usable;
- `throttle` and `rpm`, if `notch.count` is above 0: for the notches, which come before the
  low-pass; without `throttle`, the throttle in `state` is used;
- `~/output`: has type, stamp and frame of the input; but a derivative, except of a bare number, is
  a geometry_msgs AccelStamped or Vector3Stamped, or if the input has no stamp, a Float64.

Limits: of an Imu only the angular velocity is filtered, of a BatteryState only the voltage, unless
`input.field` names another field.  All other fields, including covariances, are copied unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math
from typing import Any, NamedTuple

from diagnostic_msgs.msg import DiagnosticArray
from ou_monitor.errors import InputError
from ou_monitor.nodes.base import MonitorNode, PUBLISH_RATE
from ou_monitor.nodes.filter_channels import CHANNELS, Channels, channels_of
from ou_monitor.nodes.inputs import (
    Console, decode, INPUT_QOS, NO_CLOCK, Silence, SourceFinder, Stamper, types_on)
from ou_monitor.nodes.sources import AUTO, message_class, MOTOR_PARAMETERS, Source
from ou_monitor.online.filter.cutoff import Bound
from ou_monitor.online.filter.lowpass import AdaptiveLowPass, FilterCounters
from ou_monitor.online.notch import AdaptiveNotch
from ou_monitor.online.settings import (
    FILTER_PARAMETERS, FilterSettings, notch_options, NOTCH_PARAMETERS, NotchSettings, Parameter)
from ou_monitor.online.trust import InputClock, SLOW_MISSED, SourceInterval, StampOrder
from ou_monitor.records import Level, NAN, Status
from std_msgs.msg import Float64

# Not changeable at run time, because the mode determines the unit of the output.
_MODE = next(p for p in FILTER_PARAMETERS if p.name == 'mode')
INPUT_PARAMETERS = (
    Parameter('input.type', AUTO, "Message type of `input`; auto: the publisher's type."),
    Parameter('input.field', '',
              'Field path of the signal; empty: data, voltage of a battery, angular velocity of '
              'an IMU.'))
# Fields of the state that the filter uses.
_FIELDS = ('sigma_se', 'alpha', 'throttle', 'load_noise')
_UNKNOWN = [NAN] * len(_FIELDS)
# Ratio of sigma's window to the sliding window above which sigma comes from a longer fit.
_LONGER = 1.1
_USABLE = (Status.OK.name, Status.SHORT_WINDOW.name)


class SupplyEstimate(NamedTuple):
    """Latest valid estimate of the supply."""

    # Noise intensity, V/sqrt(s), and the standard error of its logarithm; NaN: unknown.
    sigma: float = NAN
    sigma_se: float = NAN
    alpha: float = NAN  # Relaxation rate, 1/s; NaN: unknown
    throttle: float = NAN  # Throttle, 0..1; NaN: unknown
    why: str = ''  # Why sigma is unknown; empty when it is valid
    # 'relaxation': the estimator's sigma; 'load': the load model's noise; 'none'.
    source: str = 'none'


class SupplyInput:
    """Newest `sigma` and `state`; each is dropped when stale (`now`: monotonic clock, s)."""

    def __init__(self, now: Callable[[], float], topic: str) -> None:
        self._topic = topic
        self._sigma = NAN
        self._state: dict[str, str] = {}
        self.sigma_silence, self.state_silence = Silence(now), Silence(now)
        self._values = _UNKNOWN

    def take_sigma(self, value: float) -> None:
        """Take a sigma, V/sqrt(s); negative values count as unknown."""
        self.sigma_silence.record()
        self._sigma = value if value >= 0.0 and math.isfinite(value) else NAN

    def take_state(self, message: Any) -> None:
        """Take a DiagnosticArray of the estimator; ignore messages of other nodes."""
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if 'sigma_se' in values:
                self.state_silence.record()
                self._state = values
                # The error refers to ln sigma, as `AdaptiveLowPass` expects.
                error, *others = (_number(values, key) for key in _FIELDS)
                self._values = [error if error >= 0.0 else NAN, *others]
                return

    def now(self, stale_after: float, rate: float = NAN) -> SupplyEstimate:
        """Return the latest values that are not older than `stale_after`, s."""
        # If sigma is unknown, take the sigma of an OU with relaxation `rate`, 1/s, and the rms of
        # the load model's noise at the present throttle.  This sigma includes the white noise of
        # the ADC, so it is not below the supply's own sigma.
        fresh = self.state_silence.age <= stale_after
        error, alpha, throttle, noise = self._values if fresh else _UNKNOWN
        why = self._why_no_sigma(fresh, stale_after)
        if why and noise > 0.0 and rate > 0.0:
            return SupplyEstimate(noise * math.sqrt(2.0 * rate), throttle=throttle, source='load')
        if why:
            return SupplyEstimate(throttle=throttle, why=why)
        return SupplyEstimate(self._sigma, error, alpha, throttle, source='relaxation')

    def _why_no_sigma(self, fresh: bool, stale_after: float) -> str:
        age = self.sigma_silence.age
        if age == math.inf:
            return f'no message on {self._topic}'
        if age > stale_after:
            return f'sigma on {self._topic} is stale, {age:.1f} s old'
        if math.isnan(self._sigma):
            return f'sigma on {self._topic} is not a number, or negative'
        status = self._state.get('status', Status.OK.name)
        if fresh and status not in _USABLE:
            return f'the estimator reports {status}'
        window = _number(self._state, 'window_s')
        if fresh and window > _LONGER * _number(self._state, 'duration'):
            # An average over a long window does not follow throttle.
            return f'sigma is an average over the last {window:g} s, too long for the filter'
        return ''


def _number(values: dict[str, str], key: str) -> float:
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return NAN


class MotorInputs:
    """Newest throttle, and motor speeds not taken yet (`now`: monotonic clock, s)."""

    def __init__(self, node: MonitorNode, values: Mapping[str, Any],
                 now: Callable[[], float]) -> None:
        self._node = node
        self.silence = {quantity: Silence(now) for quantity in ('throttle', 'rpm')}
        self._throttle = NAN
        self._speeds: list[float] = []
        self.sources = SourceFinder(node, tuple(self.silence), values, self._open)

    def throttle(self, stale_after: float) -> float:
        """Return the throttle, 0..1; NaN if the newest is older than `stale_after`, s."""
        return self._throttle if self.silence['throttle'].age <= stale_after else NAN

    def take_speeds(self) -> list[float]:
        """Return the motor speeds received since the last call; empty if there are none."""
        speeds, self._speeds = self._speeds, []
        return speeds

    def _open(self, source: Source) -> None:
        message, extractor = source.open_many()

        def take(arrived: Any) -> None:
            values = extractor.extract(arrived).tolist()
            if source.quantity == 'rpm':
                self._speeds = values
            elif len(values) == 1 and math.isfinite(values[0]):
                self._throttle = values[0]
            else:
                return
            self.silence[source.quantity].record()
        self._node.create_subscription(
            message, source.topic, self._node.guarded(take), INPUT_QOS)


class AdaptiveFilterNode(MonitorNode):
    """Low-pass with a cutoff driven by sigma, as a node."""

    RUN_TIME = (*(p for p in FILTER_PARAMETERS if p is not _MODE), *NOTCH_PARAMETERS,
                PUBLISH_RATE)
    FIXED = (*INPUT_PARAMETERS, _MODE, *MOTOR_PARAMETERS)

    def start(self) -> None:
        self._channels: Channels | None = None
        values = self.values()
        # One for each signal; until the signals are known, one.
        self._filters = [AdaptiveLowPass(**_filter_options(values))]
        self._notch = AdaptiveNotch(**notch_options(values))
        self._motors = MotorInputs(self, values, self.steady_now)
        self._supply = SupplyInput(self.steady_now, self.resolve_topic_name('sigma'))
        self._input_silence = Silence(self.steady_now)
        self._dropped = self._passed = 0
        self._input_clock = InputClock()
        self._input_interval = SourceInterval()
        self._found: list[str] = []
        self._unplaced = False
        self._console = Console(self)
        self._type, self._field = values['input.type'], values['input.field']
        self._topic = self.resolve_topic_name('input')
        self._stamper = Stamper(self, self._jumped)
        self._cutoff_output = self.create_publisher(Float64, '~/cutoff', 10)
        self._lag_output = self.create_publisher(Float64, '~/lag', 10)
        self.create_subscription(Float64, 'sigma', self.guarded(
            lambda message: self._supply.take_sigma(message.data)), INPUT_QOS)
        self.create_subscription(DiagnosticArray, 'state', self.guarded(
            self._supply.take_state), INPUT_QOS)
        if self._type != AUTO:
            self._open(self._type)
        self.every(0.2, self._watch)
        self.every(1.0, self._diagnose)
        self.publish_every(self._publish)

    def check(self, values: Mapping[str, Any]) -> None:
        FilterSettings(**_filter_options(values))
        NotchSettings.from_options(notch_options(values))

    def apply(self, values: Mapping[str, Any]) -> None:
        super().apply(values)
        for channel in self._filters:
            channel.configure(**_filter_options(values))
        self._notch.configure(**notch_options(values))

    @property
    def low_pass(self) -> AdaptiveLowPass:
        """Filter of the first signal; all signals have the same cutoff."""
        return self._filters[0]

    # -- messages in

    def _watch(self) -> None:
        """Subscribe to the input as soon as its type is known from a publisher."""
        self._stamper.follow()
        if self._notch.settings.count:
            self._motors.sources.watch()
        if self._channels is None:
            self._found = types_on(self, self._topic)
            known = [kind for kind in self._found if self._field or kind in CHANNELS]
            if known:
                self._open(known[0])
        if self._input_silence.age == math.inf and (self._channels is not None or not self._found):
            self._console.waiting(self._topic)

    def _open(self, kind: str) -> None:
        channels = channels_of(kind, self._field, mode=self.low_pass.settings.mode)
        message = message_class(kind)
        self._type, self._channels = kind, channels
        self._filters = [AdaptiveLowPass(**_filter_options(self.values()))
                         for _ in channels.names]
        self._output = self.create_publisher(
            message_class(channels.output or kind), '~/output', 10)
        self._message = message
        self._stamped = message.get_fields_and_field_types().get('header') == 'std_msgs/Header'
        self.create_subscription(
            message, 'input', self.with_info(self._take_input), INPUT_QOS, raw=True)
        self.get_logger().info(
            f"filtering {self._topic} ({kind}, {', '.join(channels.names)})")

    def _take_input(self, data: bytes, info: Any) -> None:
        assert self._channels is not None
        arrived = self.steady_now()
        self._input_silence.record(arrived)
        self._input_interval.push_one(arrived)
        try:
            message = decode(data, self._message, self._topic)
        except InputError:
            self._dropped += 1
            return
        values = self._channels.take(message)
        own = message.header.stamp if self._stamped else None
        stamp = self._stamper.time_of(own.sec + own.nanosec * 1e-9 if own else 0.0, info)
        self._unplaced = math.isnan(stamp)
        if not values or not all(map(math.isfinite, (stamp, *values))):
            self._dropped += 1
            return
        stamp = self._input_clock.time_of(stamp, arrived)
        supply = self._supply_now()
        values = self._apply_notches(stamp, values, supply)
        self._output.publish(self._channels.put(message, [
            channel.step(stamp, value, supply.sigma, supply.sigma_se, supply.alpha)
            for channel, value in zip(self._filters, values, strict=True)]))
        self._passed += 1

    def _apply_notches(self, stamp: float, values: Sequence[float], supply: SupplyEstimate
                       ) -> Sequence[float]:
        """Return the signals after the notches; unchanged in shadow mode."""
        if not self._notch.settings.count and not self._notch.active:
            return values
        throttle = self._motors.throttle(self.low_pass.settings.stale_after)
        if math.isnan(throttle):
            throttle = supply.throttle
        out = self._notch.step(stamp, values, throttle, self._motors.take_speeds())
        return values if self.low_pass.settings.shadow else out

    @property
    def _delay(self) -> float:
        """Phase delay of low-pass and notches at `lag_frequency`, s."""
        s = self.low_pass.settings
        notched = 0.0 if s.shadow else max(self._notch.delays(s.lag_frequency), default=0.0)
        return self.low_pass.delay + notched

    def _supply_now(self) -> SupplyEstimate:
        return self._supply.now(self.low_pass.settings.stale_after,
                                self.low_pass.settings.alpha)

    def _jumped(self, reason: str) -> None:
        """Keep the output, because the filter ignores a step back in time."""
        self.get_logger().info(f'{reason}: the filter continues from its output')

    # -- reporting

    def _publish(self) -> None:
        self._cutoff_output.publish(Float64(data=self.low_pass.cutoff))
        self._lag_output.publish(Float64(data=1e3 * self._delay))

    def _diagnose(self) -> None:
        supply, low_pass = self._supply_now(), self.low_pass
        settings = low_pass.settings
        level, summary = self._judge(supply)
        if self.fault_notes:
            level, summary = Level.ERROR, ' '.join((*self.fault_notes, summary))
        counters: FilterCounters = low_pass.counters
        fields: dict[str, object] = {
            'input_type': self._type, 'law': settings.law, 'mode': settings.mode,
            'order': settings.order, 'shadow': settings.shadow,
            'cutoff': low_pass.cutoff, 'cutoff_wanted': low_pass.wanted,
            'decided_by': self._decided_by(supply), 'lag': low_pass.phase_lag,
            'delay': self._delay, 'lag_frequency': settings.lag_frequency,
            'sigma': supply.sigma, 'sigma_source': supply.source,
            'sigma_se': supply.sigma_se, 'alpha': supply.alpha,
            'throttle': supply.throttle,
            'notch_active': self._notch.active, 'notch_source': self._notch.source,
            'notch_frequencies': ', '.join(f'{f:.4g}' for f in self._notch.frequencies),
            'notch_law_a': self._notch.law[0], 'notch_law_b': self._notch.law[1],
            'notch_problem': ' '.join(filter(None, self._motors.sources.problems.values())),
            **{f'{name}_age': silence.age for name, silence in self._motors.silence.items()},
            'passed': self._passed, 'dropped': self._dropped,
            'repeated': counters.repeated, 'back': counters.back, 'gaps': counters.gaps,
            'sigma_age': self._supply.sigma_silence.age,
            'state_age': self._supply.state_silence.age,
            'stamps': self._input_clock.stamps.name,
            'placed_by_arrival': self._input_clock.by_arrival,
            'input_age': self._input_silence.age, 'callback_errors': self.faults}
        self.diagnose('adaptive low-pass', level, summary, fields, self._topic)

    def _decided_by(self, supply: SupplyEstimate) -> str:
        low_pass = self.low_pass
        s, bound = low_pass.settings, low_pass.bound
        if not self._passed:
            return f'nothing yet: no message was filtered; the cutoff starts at {s.fallback:g} Hz'
        if bound is Bound.FALLBACK:
            return f'the fallback, because {_unknown(supply)}'
        if bound is Bound.LAG:
            return (f'fmin, {s.lowest:.4g} Hz by max_lag ({s.max_lag:g} degrees at '
                    f'{s.lag_frequency:g} Hz)')
        if bound in (Bound.SLEW, Bound.SMOOTHING):
            aim = (f'{low_pass.wanted:.4g} Hz' if math.isfinite(low_pass.wanted) else
                   f'the fallback, because {_unknown(supply)}')
            return f'{bound.value}, on the way to {aim}'
        return bound.value

    def _judge(self, supply: SupplyEstimate) -> tuple[Level, str]:
        s = self.low_pass.settings
        if self._channels is None and self._found:
            return Level.WARN, (
                f"Cannot filter {self._topic} of type {', '.join(self._found)}: name its signal "
                f"with input.field; only {', '.join(CHANNELS)} need no name.")
        if self._channels is None:
            return Level.STALE, f'Waiting for a publisher on {self._topic}.'
        if self._input_silence.age > max(s.stale_after, SLOW_MISSED * self._input_interval.value):
            return Level.STALE, (
                f"No message on {self._topic}{self._input_silence.words or ' yet'}.")
        if self._stamper.waiting and self._unplaced:
            return Level.WARN, NO_CLOCK
        if self._input_clock.stamps is not StampOrder.GOOD:
            return Level.WARN, f'{self._topic}: ' + self._input_clock.stamps.sentence(
                'their arrival times are used')
        if math.isnan(supply.sigma):
            return Level.WARN, (
                f'The cutoff goes to the fallback, {s.fallback:g} Hz, because '
                f'{_unknown(supply)}.')
        if self.low_pass.highest < s.lowest:
            return Level.WARN, (
                f'The messages on {self._topic} are too slow: 0.45 of their rate is '
                f'{self.low_pass.highest:.4g} Hz, below fmin ({s.lowest:.4g} Hz), which is used.')
        shadow = 'Shadow, the signal passes unfiltered: ' if s.shadow else ''
        return Level.OK, (
            f'{shadow}Cutoff {self.low_pass.cutoff:.4g} Hz by law {s.law} at sigma '
            f'{supply.sigma:.4g} V/sqrt(s); decided by {self._decided_by(supply)}; lag '
            f'{360.0 * s.lag_frequency * self._delay:.3g} degrees ({1e3 * self._delay:.3g} ms) at '
            f'{s.lag_frequency:g} Hz{self._notch_words()}.')

    def _notch_words(self) -> str:
        notch = self._notch
        if not notch.settings.count:
            return ''
        if not notch.active:
            return '; notches off, they would not help' if notch.source == 'none' else ''
        at = ', '.join(f'{f:.0f}' for f in notch.frequencies)
        return f'; notches at {at} Hz by {notch.source}'


def _unknown(supply: SupplyEstimate) -> str:
    return supply.why or 'sigma was unknown at the last message'


def _filter_options(values: Mapping[str, Any]) -> dict[str, Any]:
    return {p.name: values[p.name] for p in FILTER_PARAMETERS}
