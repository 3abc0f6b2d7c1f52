"""
What the filter hears of the supply and of the motors.

`sigma`, and the estimator's `state` where there is one; throttle and speeds, from topics found by
their types.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

from ou_monitor.nodes.base import MonitorNode
from ou_monitor.nodes.inputs import INPUT_QOS, Silence, SourceFinder, within
from ou_monitor.nodes.sources import Source
from ou_monitor.records import Status

NAN = math.nan
# Fields of the state that the filter uses as they are.
_FIELDS = ('alpha', 'throttle', 'u0', 'u0_se', 'load_noise')
# A sigma of a window longer than the sliding one by this is that of a fit.
_LONGER = 1.1
_USABLE = (Status.OK.name, Status.SHORT_WINDOW.name)


class KnownSupply(NamedTuple):
    """The supply as it is known."""

    # Noise intensity, V/sqrt(s), and the standard error of its logarithm; NaN: not known.
    sigma: float = NAN
    sigma_se: float = NAN
    alpha: float = NAN  # Relaxation rate, 1/s; NaN: not known
    throttle: float = NAN  # Throttle, 0..1; NaN: not known
    # Level at the present throttle and its standard error, V; NaN: not known.
    level: float = NAN
    level_se: float = NAN
    why: str = ''  # Why sigma is not known; empty when it is
    # 'relaxation': the estimator's sigma; 'load': the noise beside the load; 'none'.
    source: str = 'none'


class SupplyInput:
    """Newest of `sigma` and `state`, each forgotten when it is stale (`now`: monotonic, s)."""

    def __init__(self, now: Callable[[], float], topics: tuple[str, str]) -> None:
        self._topic, self._state_topic = topics
        self._sigma = NAN
        self._state: dict[str, str] = {}
        self._heard, self._state_heard = Silence(now), Silence(now)
        self._error = NAN
        self._known = [NAN] * len(_FIELDS)

    @property
    def age(self) -> float | None:
        """Seconds since the last sigma; None when there was none."""
        return self._heard.age

    @property
    def state_age(self) -> float | None:
        """Seconds since the last state; None when there was none."""
        return self._state_heard.age

    def take_sigma(self, value: float) -> None:
        """Take a sigma, V/sqrt(s); negative counts as not known."""
        self._heard.heard()
        self._sigma = value if value >= 0.0 and math.isfinite(value) else NAN

    def take_state(self, message: Any) -> None:
        """Take a DiagnosticArray of the estimator; others on the topic are passed over."""
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            if 'sigma_se' in values:
                self._state_heard.heard()
                self._state = values
                # Of ln sigma, as `AdaptiveLowPass` takes it.
                error = _number(values, 'sigma_se')
                self._error = error if error >= 0.0 else NAN
                self._known = [_number(values, key) for key in _FIELDS]
                return

    def now(self, stale_after: float, rate: float = NAN) -> KnownSupply:
        """
        Return what is known, nothing of it older than `stale_after`, s.

        Without a sigma it is that of an OU of the deviation which the load leaves
        at the present throttle, and of the `rate`, 1/s: white noise of the ADC is
        in it, so that it is no less than the supply's own.
        """
        fresh = within(self._state_heard.age, stale_after)
        error, (alpha, throttle, level, level_se, noise) = (
            (self._error, self._known) if fresh else (NAN, [NAN] * len(_FIELDS)))
        why = self._why(fresh, stale_after)
        if why and noise > 0.0 and rate > 0.0:
            return KnownSupply(noise * math.sqrt(2.0 * rate), throttle=throttle, source='load')
        if why:
            return KnownSupply(throttle=throttle, why=why)
        return KnownSupply(
            self._sigma, error, alpha, throttle, level, level_se, source='relaxation')

    def why_no_throttle(self, stale_after: float) -> str:
        """Say why the throttle is not known."""
        age = self._state_heard.age
        if age is None:
            return f'no message on {self._state_topic}'
        if not within(age, stale_after):
            return f'{self._state_topic} has been silent for {age:.1f} s'
        return f'the state on {self._state_topic} has no throttle'

    def _why(self, fresh: bool, stale_after: float) -> str:
        age = self._heard.age
        if age is None:
            return f'no message on {self._topic}'
        if not within(age, stale_after):
            return f'sigma on {self._topic} is stale, {age:.1f} s old'
        if math.isnan(self._sigma):
            return f'sigma on {self._topic} is not a number, or negative'
        status = self._state.get('status', Status.OK.name)
        if fresh and status not in _USABLE:
            return f'the estimator says {status}'
        window = _number(self._state, 'window_s')
        if fresh and window > _LONGER * _number(self._state, 'duration'):
            # It does not follow the throttle.
            return f'sigma is of the last {window:g} s, too long for the filter'
        return ''


def _number(values: dict[str, str], key: str) -> float:
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return NAN


QUANTITIES = ('throttle', 'rpm')


class MotorInputs:
    """
    Newest throttle, and motor speeds that have not been asked for yet.

    By the values of `sources.MOTOR_PARAMETERS` and a monotonic clock, s.
    """

    def __init__(self, node: MonitorNode, values: Mapping[str, Any],
                 now: Callable[[], float]) -> None:
        self._node = node
        self._silence = {quantity: Silence(now) for quantity in QUANTITIES}
        self._throttle = NAN
        self._speeds: list[float] = []
        self.sources = SourceFinder(node, QUANTITIES, values, self._open)

    def age(self, quantity: str) -> float | None:
        """Return the seconds since a message came; None when there was none."""
        return self._silence[quantity].age

    def throttle(self, stale_after: float) -> float:
        """Return the throttle, 0..1; NaN when none younger than `stale_after`, s, came."""
        return self._throttle if within(self._silence['throttle'].age, stale_after) else NAN

    def take_speeds(self) -> list[float]:
        """Return the motor speeds that came since this was asked last; empty: none."""
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
            self._silence[source.quantity].heard()
        self._node.create_subscription(
            message, source.topic, self._node.guarded(take), INPUT_QOS)
        self._node.get_logger().info(
            f'{source.quantity} from {self._node.resolve_topic_name(source.topic)}: '
            f"{extractor.spec.type} field '{extractor.spec.field}'")
