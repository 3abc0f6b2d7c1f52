"""
Parameters of the nodes `estimator` and `adaptive_filter`: name, default, range and description.

Each field of a settings class is a parameter. The nodes declare their ROS parameters from these
fields, and the YAML in `config/` is tested against them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
import math
from numbers import Real
from typing import Any, cast, TypeVar

from ou_monitor.errors import nearest
from ou_monitor.online.filter.filter_state import cutoff_for_lag, most_lag


@dataclass(frozen=True)
class Parameter:
    """One parameter of a node."""

    name: str  # Dotted name as in YAML
    default: bool | int | float | str  # Default; its type is the parameter's type
    description: str  # One sentence with the unit
    # Range, inclusive; None: no limit.
    low: float | None = None
    high: float | None = None
    # Accepted words; empty: any.  With a range, numbers within it are accepted too.
    choices: tuple[str, ...] = ()

    @property
    def mixed(self) -> bool:
        """Whether both a word and a number are accepted."""
        return bool(self.choices) and self.low is not None


def _parameter(default: bool | int | float | str, description: str, low: float | None = None,
               high: float | None = None, choices: tuple[str, ...] = ()) -> Any:
    """Return a field of settings that is a parameter of a node."""
    return field(default=default, metadata={
        'default': default, 'description': description, 'low': low, 'high': high,
        'choices': choices})


def parameters_of(settings: type[Any], prefix: str = '') -> tuple[Parameter, ...]:
    """Return the parameters of a class of settings; a group has a dotted prefix."""
    return tuple(Parameter(prefix + one.name.replace('brownout_', 'brownout.'), **one.metadata)
                 for one in fields(settings))


_Settings = TypeVar('_Settings')

# Value of `window` for a length that is chosen from the data.
AUTO = 'auto'
# Values of `law`.
LAWS = ('constant_noise', 'kalman', 'threshold')


def _documented(settings: type[_Settings]) -> type[_Settings]:
    """List the parameters in the docstring of a settings class, before its examples."""
    head, mark, tail = str(settings.__doc__).partition('    Examples\n')
    lines = [f'    {one.name} : {one.type}\n        {one.metadata["description"]}\n'
             for one in fields(cast('Any', settings))]
    settings.__doc__ = f'{head}    Attributes\n    ----------\n{"".join(lines)}\n{mark}{tail}'
    return settings


# Default limit, V, for a 5 V rail, and the range of the median voltage, V, that counts as a 5 V
# rail: a lower voltage is a lithium cell, or a rail in constant brown-out.
DEFAULT_LIMIT, RAIL = 4.5, (4.5, 6.0)


@_documented
@dataclass(frozen=True)
class MonitorSettings:
    """
    Settings of `SupplyMonitor`: the parameters of the node `estimator`.

    Examples
    --------
    >>> from ou_monitor import MonitorSettings
    >>> settings = MonitorSettings(brownout_voltage=14.0, brownout_horizon=2.0)
    >>> settings.window, settings.brownout_latch
    ('auto', False)

    """

    window: float | str = _parameter(
        AUTO, 'Length of the sliding window, s; auto: the shortest of 2, 8, 30 and 60 s in which '
        'alpha is known within a factor of 1.5, else the longest.', 0.05, 3600.0, (AUTO,))
    stale_after: float = _parameter(
        1.0, 'Silence after which the input counts as stale, s.  It is shorter for a fast source '
        '(300 intervals, but at least 0.3 s), longer for a slow one (2.5 intervals).',
        0.01, 3600.0)
    brownout_voltage: float = _parameter(
        DEFAULT_LIMIT, 'Lowest permitted supply voltage, V (default: the lower limit of PX4 for a '
        '5 V rail).', 0.0, 1000.0)
    brownout_horizon: float = _parameter(
        5.0, 'Time ahead for which the risk is computed, s.', 0.001, 3600.0)
    brownout_warn: float = _parameter(0.1, 'Risk at which the diagnostics warn, 0..1.', 0.0, 1.0)
    brownout_critical: float = _parameter(
        0.5, 'Risk within 1 s at the present throttle at which the brown-out flag is set, 0..1.',
        0.0, 1.0)
    brownout_leave: float = _parameter(
        0.5, 'WARN or CRITICAL ends when the risk falls below this share of the value at which it '
        'begins, from 0.001 to below 1 (default: half, our choice).', 0.001, 1.0)
    brownout_hold: float = _parameter(
        1.0, 'Minimum duration of WARN and CRITICAL, also while the risk is unknown, s (2 s made '
        'false alarms last twice as long on five recorded quads).', 0.0, 3600.0)
    brownout_delay: float = _parameter(
        0.15, 'Time that a risk must last before WARN or CRITICAL begins, s (default: three '
        'reports; two gave twice as many false alarms on recorded quads; ArduPilot waits 10 s '
        'before a voltage failsafe).', 0.0, 3600.0)
    brownout_latch: bool = _parameter(
        False, 'Whether CRITICAL stays until ~/clear_brownout is called or this parameter is set '
        'to false (default: no; PX4 latches its battery warning while armed).')
    brownout_floor: float = _parameter(
        -1.0, 'Voltage at or below which the flag is CRITICAL whatever the model predicts, V; 0: '
        'off; negative: brownout.voltage (default).', -1.0, 1000.0)
    brownout_floor_time: float = _parameter(
        0.01, 'Time over which the median of the voltage is compared with the floor, s, at least '
        'three samples (default: longer than a bad sample, but no longer than the dips of '
        'recorded quads, 10 ms and more).', 0.0, 10.0)
    brownout_budget_limit: float = _parameter(
        0.01, 'Highest risk that the throttle budget allows, 0..1; 0: brownout.warn.', 0.0, 1.0)
    model_file: str = _parameter(
        '', 'Model file of the supply (discover --save-model); empty: none.')

    def __post_init__(self) -> None:
        """Refuse values that are out of range or contradict each other."""
        check_values(self)
        if not self.brownout_warn < self.brownout_critical:
            raise ValueError(
                f'brownout.warn ({self.brownout_warn}) must be less than brownout.critical '
                f'({self.brownout_critical})')
        if not self.brownout_leave < 1.0:
            raise ValueError(
                f'brownout.leave ({self.brownout_leave}) must be less than 1: WARN and '
                'CRITICAL end at brownout.leave times the risk at which they begin')
        if self.brownout_floor > self.brownout_voltage:
            raise ValueError(
                f'brownout.floor ({self.brownout_floor} V) must not exceed brownout.voltage '
                f'({self.brownout_voltage} V): lower it, or set 0 (off) or -1 (equal)')
        if self.brownout_budget_limit > self.brownout_critical:
            raise ValueError(
                f'brownout.budget_limit ({self.brownout_budget_limit}) must not exceed '
                f'brownout.critical ({self.brownout_critical}): the throttle that it allows would '
                'set the flag')

        if not 0.0 < self.budget_limit < 1.0:
            raise ValueError(
                f'brownout.budget_limit ({self.brownout_budget_limit:g}; 0: brownout.warn, '
                f'{self.brownout_warn:g}) must give a limit above 0 and below 1: no throttle '
                'has a risk below 0, and no risk exceeds 1')

    @cached_property
    def floor(self) -> float:
        """Return the voltage floor in force, V; 0: off."""
        if self.brownout_floor < 0.0:
            return max(self.brownout_voltage, 0.0)
        return self.brownout_floor

    @cached_property
    def budget_limit(self) -> float:
        """Return the highest risk that the throttle budget allows, 0..1."""
        return self.brownout_budget_limit or self.brownout_warn


ESTIMATOR_PARAMETERS = parameters_of(MonitorSettings)


@dataclass(frozen=True)
class FilterSettings:
    """Settings of `AdaptiveLowPass`."""

    mode: str = _parameter(
        'lowpass', 'Output: the signal, or its derivative in unit/s (for a D term).',
        choices=('lowpass', 'derivative'))
    order: int = _parameter(2, 'Order of the low-pass: 1, or 2 (Butterworth).', 1, 2)
    law: str = _parameter('constant_noise', 'Law from sigma to cutoff.', choices=LAWS)
    fmin: float = _parameter(
        20.0, 'Lowest cutoff, Hz; it limits the lag, so it is a safety limit.', 0.001, 1.0e6)
    fmax: float = _parameter(150.0, 'Highest cutoff, Hz.', 0.001, 1.0e6)
    max_lag: float = _parameter(
        0.0, 'Maximum lag at lag_frequency, degrees, which replaces fmin; 0: fmin is used.',
        0.0, 179.0)
    lag_frequency: float = _parameter(
        10.0, 'Frequency at which the lag is computed and limited, Hz.', 0.001, 1.0e6)
    sigma_ref: float = _parameter(
        0.3, 'Sigma up to which the cutoff stays at fmax, V/sqrt(s) (threshold, and '
        'constant_noise without noise_wanted).', 1.0e-9, 1.0e6)
    coupling: float = _parameter(
        0.0, 'Supply noise in the signal, unit of the signal per V; 0: unknown, constant_noise is '
        'then relative to sigma_ref.', 0.0, 1.0e9)
    noise_wanted: float = _parameter(
        0.0, 'Rms of the output noise that constant_noise keeps constant, unit of the output, '
        'with coupling; 0: the noise at sigma_ref and fmax.', 0.0, 1.0e12)
    n0: float = _parameter(
        0.0, 'White measurement noise for kalman, unit^2/Hz, two-sided: variance of a '
        'sample divided by the sample rate.', 0.0, 1.0e12)
    alpha: float = _parameter(
        63.0, 'Relaxation rate of the supply until the estimator provides one, 1/s.',
        1.0e-6, 1.0e9)
    smoothing: float = _parameter(
        0.2, 'Time constant of ln(cutoff) if the relative error of sigma is 0.1, s; it is '
        'proportional to that error, within a factor of 4.', 0.0, 3600.0)
    slew: float = _parameter(
        4.0, 'Maximum rate of change of the cutoff, octaves/s; 0: no limit.', 0.0, 1.0e6)
    dead_band: float = _parameter(
        0.1, 'Changes of the wanted cutoff below this are ignored, octaves.', 0.0, 10.0)
    fallback: float = _parameter(75.0, 'Cutoff when sigma is stale or unknown, Hz.', 0.001, 1.0e6)
    shadow: bool = _parameter(
        False, 'Whether the cutoff is only computed and published, and the signal passes '
        'unfiltered.')
    stale_after: float = _parameter(
        1.0, 'Age of sigma after which the fallback is used, s.', 0.01, 3600.0)

    def __post_init__(self) -> None:
        """Refuse values that are out of range or contradict each other."""
        check_values(self)
        self._check_limits()
        self._check_law()

    def _check_limits(self) -> None:
        if self.max_lag:
            if self.max_lag >= most_lag(self.order):
                raise ValueError(
                    f'max_lag ({self.max_lag:g} degrees) must be less than '
                    f'{most_lag(self.order):g}, which order {self.order} never reaches; 0: none')
            if not self.lowest < self.fmax:
                raise ValueError(
                    f'max_lag ({self.max_lag:g} degrees at {self.lag_frequency:g} Hz) needs a '
                    f'cutoff of at least {self.lowest:.4g} Hz, which is not below fmax '
                    f'({self.fmax} Hz): allow more lag or raise fmax')
        elif not self.fmin < self.fmax:
            raise ValueError(f'fmin ({self.fmin} Hz) must be less than fmax ({self.fmax} Hz)')
        if not self.lowest <= self.fallback <= self.fmax:
            why = f' (fmin by max_lag {self.max_lag:g} degrees)' if self.max_lag else ''
            raise ValueError(
                f'fallback ({self.fallback} Hz) must lie within fmin..fmax '
                f'({self.lowest:.6g}..{self.fmax} Hz){why}')

    def _check_law(self) -> None:
        if self.law == 'constant_noise' and self.noise_wanted and not self.coupling:
            raise ValueError(
                f'noise_wanted ({self.noise_wanted:g}) needs coupling (above 0): without it '
                'the noise in the signal is known only relative to sigma_ref')
        if self.law == 'kalman' and not (self.coupling > 0.0 or self.n0 > 0.0):
            raise ValueError('law kalman needs the noise: coupling (supply noise in the signal), '
                             'n0 (its white noise), or both, above 0')

    @property
    def lowest(self) -> float:
        """Return the lowest cutoff, Hz: fmin, or the cutoff for max_lag."""
        if self.max_lag:
            return cutoff_for_lag(self.order, self.max_lag, self.lag_frequency)
        return self.fmin

    @classmethod
    def from_options(cls, options: Mapping[str, object],
                     base: FilterSettings | None = None) -> FilterSettings:
        """Return settings with options changed; `fallback`, if omitted, moves into fmin..fmax."""
        values = _known(options, [one.name for one in fields(cls)], 'filter option')
        old = base or cls()
        if 'fallback' not in values:
            try:
                lowest = replace(old, **{**values, 'fallback': values.get('fmax', old.fmax)}
                                 ).lowest
            except (TypeError, ValueError):
                # Reported below, with the old fallback.
                lowest = math.nan
            if math.isfinite(lowest):
                values['fallback'] = min(max(old.fallback, lowest),
                                         values.get('fmax', old.fmax))
        return replace(old, **values)


FILTER_PARAMETERS = parameters_of(FilterSettings)


def monitor_settings(values: Mapping[str, object]) -> MonitorSettings:
    """Return settings from dotted parameter names."""
    known = _known(values, [one.name for one in ESTIMATOR_PARAMETERS], 'parameter')
    return MonitorSettings(**{name.replace('.', '_'): value for name, value in known.items()})


def _known(options: Mapping[str, object], known: list[str], what: str) -> dict[str, Any]:
    """Return options; `ValueError` if a name is not known."""
    for name in options:
        if name not in known:
            raise ValueError(f"unknown {what} '{name}': {nearest(name, known)}")
    return dict(options)


def _is_number(value: object) -> bool:
    if isinstance(value, bool):
        return False
    try:
        return isinstance(value, Real) and math.isfinite(value)
    except OverflowError:
        return False


def check_values(settings: object, prefix: str = '') -> None:
    """Raise `ValueError` for a value that its parameter does not allow."""
    for parameter in parameters_of(type(settings), prefix):
        value = getattr(settings, parameter.name.removeprefix(prefix).replace('.', '_'))
        if parameter.choices and not (parameter.mixed and not isinstance(value, str)):
            if value not in parameter.choices:
                raise ValueError(
                    f"{parameter.name}: unknown '{value}': "
                    f'{nearest(str(value), parameter.choices)}'
                    + ', or a number above 0' * parameter.mixed)
        elif isinstance(parameter.default, (bool, str)) and not parameter.mixed:
            if not isinstance(value, type(parameter.default)):
                word = 'true or false' if isinstance(parameter.default, bool) else 'text'
                raise ValueError(f'{parameter.name} must be {word}, got {value!r}')
        else:
            whole = isinstance(parameter.default, int)
            if not _is_number(value) or (whole and value != int(value)):
                word = 'an integer' if whole else 'a finite number'
                raise ValueError(
                    f"{parameter.name} must be {' or '.join((word, *parameter.choices))}, "
                    f'got {value!r}')
            low, high = parameter.low, parameter.high
            if (low is not None and value < low) or (high is not None and value > high):
                raise ValueError(f'{parameter.name} must lie within {low}..{high}, got {value}')


# Revolutions per second of one unit, and whether to divide by the pole pairs of the motors.
RPM_UNITS: dict[str, tuple[float, bool]] = {
    'rpm': (1.0 / 60.0, False), 'erpm': (1.0 / 60.0, True), 'hz': (1.0, False),
    'rad_s': (0.5 / math.pi, False)}


@dataclass(frozen=True)
class NotchSettings:
    """Settings of `AdaptiveNotch`."""

    count: int = _parameter(4, 'Maximum number of notches that follow the motors; 0: none.', 0, 4)
    fmin: float = _parameter(
        60.0, 'Lowest frequency of notches and of the noise they reduce, Hz: above the bandwidth '
        'of the flight controller.', 1.0, 1.0e5)
    cutoff: float = _parameter(
        80.0, 'Cutoff of the second-order low-pass after the notches, Hz: notches are used if '
        'they reduce the noise of its derivative at equal lag.', 1.0, 1.0e5)
    rpm_unit: str = _parameter(
        'rpm', 'Unit of the motor speeds: rpm, hz or rad_s of the shaft, or erpm, electrical '
        '(needs notch.poles).', choices=tuple(RPM_UNITS))
    poles: int = _parameter(
        0, 'Number of magnets of a motor, for erpm: 14 on most motors for 5 inch propellers; 0: '
        'unknown.',
        0, 200)
    stale_after: float = _parameter(
        0.25, 'Age of the motor speeds after which throttle is used instead, s.', 0.001, 3600.0)

    def __post_init__(self) -> None:
        """Refuse values that are out of range or contradict each other."""
        check_values(self, 'notch.')
        if RPM_UNITS[self.rpm_unit][1] and (self.poles < 2 or self.poles % 2):
            raise ValueError(
                f"notch.rpm_unit '{self.rpm_unit}' needs notch.poles, an even number of magnets "
                f'(14 on most motors for 5 inch propellers), got {self.poles}')

    @property
    def per_unit(self) -> float:
        """Shaft revolutions per second for one unit of `rpm_unit`."""
        scale, electrical = RPM_UNITS[self.rpm_unit]
        return scale / (0.5 * self.poles) if electrical else scale

    @classmethod
    def from_options(cls, options: Mapping[str, object],
                     base: NotchSettings | None = None) -> NotchSettings:
        """Return settings with the given options changed."""
        names = [one.name for one in fields(cls)]
        return replace(base or cls(), **_known(options, names, 'notch option'))


# In the node, notches are off by default.
NOTCH_PARAMETERS = tuple(replace(one, default=0) if one.name == 'notch.count' else one
                         for one in parameters_of(NotchSettings, 'notch.'))


def notch_options(values: Mapping[str, object]) -> dict[str, object]:
    """Return the notch options from the parameters of the node."""
    return {parameter.name.removeprefix('notch.'): values[parameter.name]
            for parameter in NOTCH_PARAMETERS}
