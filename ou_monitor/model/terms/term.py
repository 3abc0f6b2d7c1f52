"""
What every term is: named parameters with units, and a simulator.

A term says what it does to a `Stretch` of samples; stretches pass through the
terms of a model in the order of their `Stage`.  A simulator draws from its own
generator and keeps its state from stretch to stretch, so a recording does not
depend on the stretches it is made in, nor one term's draws on another's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
import enum
import math
from typing import Any, ClassVar, Self

import numpy as np

from ou_monitor.records import FloatArray


class Stage(enum.IntEnum):
    """When a term acts on the samples, from the clock to the logger."""

    CLOCK = 0
    DRIVE = 1
    STATE = 2
    LEVEL = 3
    INSTRUMENT = 4
    SENSOR = 5
    CLIP = 6
    CODE = 7
    LOGGER = 8


@dataclass
class Stretch:
    """
    Consecutive samples in the making; terms change it in place.

    Attributes
    ----------
    t : ndarray, shape (n,)
        Stamps, s.
    at : ndarray, shape (n,)
        Instants at which the samples are really taken, s.
    step : ndarray, shape (n,)
        Time since the sample before, s; infinite before the first one, which
        is drawn from the stationary law.
    throttle : ndarray, shape (n,)
        0..1, held from the stamp before to its own stamp.
    origin : float
        Stamp of the first sample of all, s.
    alpha, sigma : ndarray, shape (n,)
        Rate, 1/s, and intensity, V/sqrt(s), over the step before each sample.
    power : ndarray, shape (n,)
        Factor on the variance of what the noise adds in that step.
    push : ndarray, shape (n,)
        Added to the state at the end of the step, V.
    bend : tuple of float
        Coefficients of x^2, 1/(V s), and x^3, 1/(V^2 s), in the restoring
        force, beside alpha x.
    x : ndarray, shape (n,)
        OU deviation, V.
    level : ndarray, shape (n,)
        All else that the rail does, V.
    voltage : ndarray, shape (n,)
        What is logged, V.

    """

    t: FloatArray
    at: FloatArray
    step: FloatArray
    throttle: FloatArray
    origin: float
    alpha: FloatArray
    sigma: FloatArray
    power: FloatArray
    push: FloatArray
    bend: tuple[float, float]
    x: FloatArray
    level: FloatArray
    voltage: FloatArray


Effect = Callable[[Stretch], None]


def parameter(unit: str, text: str, low: float = -math.inf, high: float = math.inf, *,
              above: bool = False) -> Any:
    """
    Declare a parameter of a term.

    Parameters
    ----------
    unit : str
        SI unit; empty for a pure number.
    text : str
        What it is.
    low, high : float
        Range.
    above : bool
        Whether it must be above `low`, not at it.

    Returns
    -------
    dataclass field
        With that as its metadata.

    """
    return field(metadata={'unit': unit, 'text': text, 'low': low, 'high': high, 'above': above})


def parameters(unit: str, text: str) -> Any:
    """Declare a parameter that is a list of numbers; as `parameter`, any finite value."""
    return field(metadata={'unit': unit, 'text': text, 'low': -math.inf, 'high': math.inf,
                           'above': False, 'several': True})


@dataclass(frozen=True)
class Term:
    """
    Base of all terms: a frozen record of parameters.

    Attributes
    ----------
    NAME, FAMILY : str
        As in a model file and in a finding.
    STAGE : Stage
        When it acts.
    NEEDS_THROTTLE : bool
        Whether it says nothing without throttle.

    Raises
    ------
    ValueError
        When a parameter is not a number or out of its range.

    """

    NAME: ClassVar[str] = ''
    FAMILY: ClassVar[str] = ''
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = False

    def __post_init__(self) -> None:
        """Check every parameter against its declaration."""
        for spec in fields(self):
            value = getattr(self, spec.name)
            if 'several' in spec.metadata:
                if not isinstance(value, (list, tuple)):
                    raise ValueError(f'{self.NAME}.{spec.name} must be a list of numbers, got '
                                     f'{value!r}')
                checked: Any = tuple(_number(self.NAME, spec.name, v) for v in value)
            else:
                checked = _number(self.NAME, spec.name, value)
                _check_range(self.NAME, spec.name, checked, spec.metadata)
            object.__setattr__(self, spec.name, checked)
        self.check()

    def check(self) -> None:
        """Check relations between parameters; the base has none."""

    def start(self, rng: np.random.Generator) -> Effect:
        """
        Begin a simulation.

        Parameters
        ----------
        rng : numpy.random.Generator
            This term's own source of randomness.

        Returns
        -------
        callable
            Changes one `Stretch` after the other, in order.

        """
        raise NotImplementedError

    @classmethod
    def parameters(cls) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(spec.name for spec in fields(cls))

    @classmethod
    def unit(cls, name: str) -> str:
        """Return the unit of a parameter; empty for a pure number."""
        return next(str(spec.metadata['unit']) for spec in fields(cls) if spec.name == name)

    @classmethod
    def read(cls, params: Mapping[str, Any]) -> Self:
        """
        Return a term from named values.

        Parameters
        ----------
        params : mapping
            A value for every parameter, and for nothing else.

        Returns
        -------
        Term
            Checked.

        Raises
        ------
        ValueError
            Names what is missing, unknown or out of range.

        """
        names = cls.parameters()
        missing = [name for name in names if name not in params]
        unknown = [name for name in params if name not in names]
        if missing:
            raise ValueError(f"term '{cls.NAME}' lacks {_listed(missing)}")
        if unknown:
            raise ValueError(f"term '{cls.NAME}' has no parameter {_listed(unknown)}; it takes "
                             f'{_listed(names)}')
        return cls(**params)

    def values(self) -> dict[str, Any]:
        """Return the parameters by name; a tuple becomes a list."""
        found = {spec.name: getattr(self, spec.name) for spec in fields(self)}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in found.items()}


def _listed(names: Any) -> str:
    return ', '.join(f"'{name}'" for name in names)


def _number(term: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f'{term}.{name} must be a number, got {value!r}')
    if not math.isfinite(value):
        raise ValueError(f'{term}.{name} must be finite, got {value}')
    return float(value)


def _check_range(term: str, name: str, value: float, rule: Mapping[str, Any]) -> None:
    low, high = rule['low'], rule['high']
    wrong = value > high or value < low or (rule['above'] and value == low)
    if wrong:
        unit = f' {rule["unit"]}' if rule['unit'] else ''
        least = f'above {low:g}' if rule['above'] else f'at least {low:g}'
        wanted = least if high == math.inf else (
            f'at most {high:g}' if low == -math.inf else f'{least} and at most {high:g}')
        raise ValueError(f'{term}.{name} must be {wanted}{unit}, got {value:g}')
