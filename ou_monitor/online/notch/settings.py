"""Parameters of the notches that follow the motors: name, default, range and sentence, once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
import math
from typing import Any

from ou_monitor.errors import nearest
from ou_monitor.online.settings import check_values, Parameter

# Revolutions per second for one of the unit, and whether the poles of the motors divide it.
RPM_UNITS: dict[str, tuple[float, bool]] = {
    'rpm': (1.0 / 60.0, False), 'erpm': (1.0 / 60.0, True), 'hz': (1.0, False),
    'rad_s': (0.5 / math.pi, False)}

NOTCH_PARAMETERS: tuple[Parameter, ...] = (
    Parameter('notch.count', 0, 'Most notches that follow the motors; 0: none.', 0, 4),
    Parameter('notch.fmin', 60.0,
              'Lowest frequency of a notch, and lower end of what counts as noise, Hz: above the '
              'band in which the vehicle is flown.', 1.0, 1.0e5),
    Parameter('notch.cutoff', 80.0,
              'Cutoff of the low-pass of order 2 behind the notches for whose derivative and lag '
              'they must pay, Hz.', 1.0, 1.0e5),
    Parameter('notch.rpm_unit', 'rpm',
              'Unit of the motor speeds: rpm, hz or rad_s of the shaft, erpm of the field (needs '
              'notch.poles).', choices=tuple(RPM_UNITS)),
    Parameter('notch.poles', 0,
              'Magnets of a motor, for erpm: 14 on most motors for 5 inch propellers; 0: not '
              'known.', 0, 200),
    Parameter('notch.stale_after', 0.25,
              'Age of the motor speeds after which throttle takes their place, s.',
              0.001, 3600.0),
)


@dataclass(frozen=True)
class NotchSettings:
    """Settings of `AdaptiveNotch`; see `NOTCH_PARAMETERS`."""

    count: int = 4  # Most notches, up to 4; 0: none, what is in force fades
    fmin: float = 60.0  # Lowest frequency of a notch, Hz
    cutoff: float = 80.0  # Cutoff of the low-pass behind, Hz
    rpm_unit: str = 'rpm'  # Unit of the motor speeds
    poles: int = 0  # Magnets of a motor, for erpm
    stale_after: float = 0.25  # Age after which motor speeds are not used, s

    def __post_init__(self) -> None:
        """Refuse values out of range and contradictions."""
        check_values(NOTCH_PARAMETERS, self, 'notch.')
        if RPM_UNITS[self.rpm_unit][1] and (self.poles < 2 or self.poles % 2):
            raise ValueError(
                f"notch.rpm_unit '{self.rpm_unit}' needs notch.poles, an even number of magnets "
                f'(14 on most motors for 5 inch propellers), got {self.poles}')

    @property
    def per_unit(self) -> float:
        """Return the revolutions per second of the shaft for one of the unit."""
        scale, electrical = RPM_UNITS[self.rpm_unit]
        return scale / (0.5 * self.poles) if electrical else scale

    @classmethod
    def from_options(cls, options: Mapping[str, object],
                     base: NotchSettings | None = None) -> NotchSettings:
        """Return settings with the given options changed."""
        known = {f.name for f in fields(cls)}
        for name in options:
            if name not in known:
                raise ValueError(f"unknown notch option '{name}': {nearest(name, known)}")
        values: dict[str, Any] = dict(options)
        return replace(base, **values) if base else cls(**values)


def notch_options(values: Mapping[str, object]) -> dict[str, object]:
    """Return the options that parameters of the node stand for."""
    return {parameter.name.removeprefix('notch.'): values[parameter.name]
            for parameter in NOTCH_PARAMETERS}
