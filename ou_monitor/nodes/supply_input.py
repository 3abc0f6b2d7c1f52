"""What the filter hears of the supply: `sigma`, and the estimator's `state` where there is one."""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple

from ou_monitor.nodes.inputs import Silence
from ou_monitor.records import Status

NAN = math.nan
# Fields of the state that the filter uses as they are.
_FIELDS = ('alpha', 'throttle', 'u0', 'u0_se', 'load_noise')
_USABLE = (Status.OK.name, Status.SHORT_WINDOW.name)


class Supply(NamedTuple):
    """
    The supply as it is known.

    Attributes
    ----------
    sigma, sigma_se : float
        Noise intensity, V/sqrt(s), and the standard error of its logarithm; NaN: not known.
    alpha : float
        Relaxation rate, 1/s; NaN: not known.
    throttle : float
        Throttle, 0..1; NaN: not known.
    level, level_se : float
        Level at the present throttle and its standard error, V; NaN: not known.
    why : str
        Why sigma is not known; empty when it is.
    source : str
        'relaxation': the estimator's sigma; 'load': the noise beside the load; 'none'.

    """

    sigma: float = NAN
    sigma_se: float = NAN
    alpha: float = NAN
    throttle: float = NAN
    level: float = NAN
    level_se: float = NAN
    why: str = ''
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

    def now(self, stale_after: float, rate: float = NAN) -> Supply:
        """
        Return what is known, nothing of it older than `stale_after`, s.

        Without a sigma it is that of an OU of the deviation which the load leaves
        at the present throttle, and of the `rate`, 1/s: white noise of the ADC is
        in it, so that it is no less than the supply's own.
        """
        fresh = _fresh(self._state_heard.age, stale_after)
        error, (alpha, throttle, level, level_se, noise) = (
            (self._error, self._known) if fresh else (NAN, [NAN] * len(_FIELDS)))
        why = self._why(fresh, stale_after)
        if why and noise > 0.0 and rate > 0.0:
            return Supply(noise * math.sqrt(2.0 * rate), throttle=throttle, source='load')
        if why:
            return Supply(throttle=throttle, why=why)
        return Supply(self._sigma, error, alpha, throttle, level, level_se, source='relaxation')

    def why_no_throttle(self, stale_after: float) -> str:
        """Say why the throttle is not known."""
        age = self._state_heard.age
        if age is None:
            return f'no message on {self._state_topic}'
        if not _fresh(age, stale_after):
            return f'{self._state_topic} has been silent for {age:.1f} s'
        return f'the state on {self._state_topic} has no throttle'

    def _why(self, fresh: bool, stale_after: float) -> str:
        age = self._heard.age
        if age is None:
            return f'no message on {self._topic}'
        if not _fresh(age, stale_after):
            return f'sigma on {self._topic} is stale, {age:.1f} s old'
        if math.isnan(self._sigma):
            return f'sigma on {self._topic} is not a number, or negative'
        status = self._state.get('status', Status.OK.name)
        if fresh and status not in _USABLE:
            return f'the estimator says {status}'
        return ''


def _fresh(age: float | None, limit: float) -> bool:
    return age is not None and age <= limit


def _number(values: dict[str, str], key: str) -> float:
    try:
        return float(values[key])
    except (KeyError, ValueError):
        return NAN
