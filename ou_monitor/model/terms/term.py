"""
Base of all terms: named parameters with units, a simulator, a likelihood, explanations.

A term defines its effect on a `Segment` of samples.  Each simulator has its own
generator and keeps its state from segment to segment, so a simulated recording depends
neither on the division into segments nor on the draws of other terms.

Each class in this folder that has a NAME and is derived from `Term` is a cause: search,
reports and model files find the class through `catalogue`, and use its attributes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, MISSING, replace
import enum
import math
from typing import Any, cast, ClassVar, Generic, Self, TypeVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.records import FloatArray

Value = TypeVar('Value')

# Initial value of a coefficient that is to be fitted; a coefficient of exactly 0 is not fitted.
NEXT_TO_ZERO = 1e-12


class Role(enum.Enum):
    """How a term enters a likelihood."""

    # Detected without a model, from ADC codes and stamps.
    EXACT = enum.auto()
    # A sum of known columns with coefficients.
    MEAN = enum.auto()
    # Changes alpha, sigma or the white noise with a measured input.
    DRIVE = enum.auto()
    # Adds states to the linear system.
    BLOCK = enum.auto()
    # White noise of the measurement.
    NOISE = enum.auto()
    # Another distribution of the one-step innovations.
    LAW = enum.auto()


def parameter(unit: str, text: str, low: float = -math.inf, high: float = math.inf, *,
              above: bool = False, default: float | None = None, label: str = '') -> Any:
    """Declare a parameter; one with a default may be omitted, also in a model file."""
    # label: name of the parameter in texts, if it differs from the name of the attribute.
    about = {'unit': unit, 'text': text, 'low': low, 'high': high, 'above': above, 'label': label}
    return field(metadata=about) if default is None else field(default=default, metadata=about)


def parameters(unit: str, text: str) -> Any:
    """Declare a parameter that is a list of finite numbers."""
    return field(metadata={'unit': unit, 'text': text, 'low': -math.inf, 'high': math.inf,
                           'above': False, 'several': True})


class _ByParameters(Generic[Value]):
    """An attribute with a fixed value on the class, and a computed value on each instance."""

    def __init__(self, usual: Value, own: Callable[[Any], Value]) -> None:
        self._usual, self._own = usual, own

    def __get__(self, term: Any, kind: type) -> Value:
        return self._usual if term is None else self._own(term)


def by_parameters(usual: Value, own: Callable[[Any], Value]) -> Value:
    """Declare an attribute of the class that each term computes from its parameters."""
    return cast('Value', _ByParameters(usual, own))


@dataclass(frozen=True)
class Term:
    """
    Base of all terms: a frozen record of parameters.

    Raises ValueError if a parameter is not a number, or out of its range.

    Examples
    --------
    >>> from ou_monitor.model.terms.catalogue import catalogue
    >>> sag = catalogue()['load_sag'](linear=0.3, square=0.1)
    >>> sag.NAME, sag.linear, sag.NEEDS_THROTTLE
    ('load_sag', 0.3, True)

    """

    # Name and family in model files and findings.
    NAME: ClassVar[str] = ''
    FAMILY: ClassVar[str] = ''
    # When the term acts in a simulation.
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = False
    # How the term enters a likelihood.
    ROLE: ClassVar[Role] = Role.MEAN
    # Parameters that multiply known columns (`Role.MEAN`).
    LINEAR: ClassVar[tuple[str, ...]] = ()
    # Parameters found by maximum likelihood (`DRIVE`, `BLOCK`, `NOISE`), on the scale of `moved`.
    FREE: ClassVar[tuple[str, ...]] = ()
    # Prefixes of the names of the statistics that indicate this term; a leading + or - restricts
    # this to deviations of that sign.
    SIGNS: ClassVar[tuple[str, ...]] = ()
    # Whether the term depends on throttle or time only; the search tries such terms before latent
    # causes.
    MEASURED: ClassVar[bool] = False
    # Causes that are hard to distinguish from this one: the search does not add one of such a pair
    # to the other.  It suffices that one of the two classes names the other.
    IMITATES: ClassVar[tuple[str, ...]] = ()
    # Whether a model can have several terms of this class, and whether the search looks for more
    # after it has found one.
    SEVERAL: ClassVar[bool] = False
    RECURS: ClassVar[bool] = False
    # Minimum evidence, as a share of the evidence of all responses of the mean together.
    LEAST_SHARE: ClassVar[float] = 0.0
    # Share of its initial value that an indicating statistic may keep; 0: no statistic may fail.
    MAY_LEAVE: ClassVar[float] = 0.0
    # Statistics that must not fail after the fit.
    REFUTED_BY: ClassVar[tuple[str, ...]] = ()
    # Penalty for the choices of the search, nats, in addition to the penalty for free parameters.
    SEARCH: ClassVar[float] = 0.0
    # Evidence per sample, nats, that this form of a response needs beyond other forms.
    FORM_COST: ClassVar[float] = 0.0
    # Number of parameters that `apart` fits, outside the joint fit.
    APART: ClassVar[int] = 0
    # Whether a fit takes seconds; late in a search, such fits are skipped.
    SLOW_FIT: ClassVar[bool] = False
    # Whether the spectrum is broad and stationary; then a fit starts from the scores' spectrum.
    BROAD: ClassVar[bool] = False
    # Number of states that the term adds to the linear system (`Role.BLOCK`).
    STATES: ClassVar[int] = 0
    # The term that this one modifies, which the model must contain; None: the `ou`.
    CHANGES: ClassVar[type[Term] | None] = None
    # Whether the live estimate, which is for the present throttle, includes the effect.
    LIVE: ClassVar[bool] = False
    # Texts for the report: meaning, remedy, and a recording that separates it from other causes.
    MEANING: ClassVar[str] = ''
    REMEDY: ClassVar[str] = ''
    SEPARATED_BY: ClassVar[str] = ''

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
        """Check relations between parameters; the base class has none."""

    def start(self, rng: np.random.Generator) -> Effect:
        """Return a function that applies the term to one `Segment` after another, in order."""
        return self.change

    def change(self, s: Segment) -> None:
        """Apply a term that draws nothing and keeps no state from segment to segment."""
        raise NotImplementedError

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return starting points for a fit to the residual of the model, best first."""
        return ()

    def objection(self, path: FloatArray, at: FloatArray) -> str:
        """Return an objection to a fitted path (offset, log power) at times, s; '' for none."""
        return ''

    def holds(self, view: View) -> bool:
        """Return whether the fitted parameters still describe this cause; by default True."""
        return True

    def beside(self, ou: Term) -> Term:
        """Return the `ou` from which a fit with this term starts; by default, the given one."""
        return ou

    def columns(self, s: Segment) -> FloatArray:
        """Return a column for each parameter in `LINEAR`, V per unit, shape (n, p)."""
        columns = []
        rng = np.random.default_rng(0)
        for name in self.LINEAR:
            unit = replace(self, **{other: float(other == name) for other in self.LINEAR})
            level = replace(s, level=np.zeros(s.t.size))
            unit.start(rng)(level)
            columns.append(level.level)
        return np.stack(columns, axis=1) if columns else np.empty((s.t.size, 0))

    def linear_values(self) -> list[float]:
        """Return the coefficients of the columns."""
        return [float(getattr(self, name)) for name in self.LINEAR]

    def with_linear(self, beta: Sequence[float]) -> Self:
        """Return the term with new coefficients of its columns."""
        return replace(self, **dict(zip(self.LINEAR, map(float, beta), strict=True)))

    def factors(self) -> dict[str, tuple[list[float], list[float]]]:
        """Return knots and factors on the noise by input, if the parameters are such lists."""
        return {}

    def free(self) -> tuple[str, ...]:
        """Return the names of the coordinates over which the likelihood is maximised."""
        return self.FREE

    def moved(self, name: str, by: float) -> Self:
        """Return the term with one coordinate changed (by default the parameter's logarithm)."""
        return replace(self, **{name: getattr(self, name) * math.exp(by)})

    def apart(self, view: View) -> Self:
        """Refit the `APART` parameters to the scores of a model that contains this term."""
        return self

    def per_coordinate(self, name: str) -> float:
        """Return the derivative of a parameter with respect to its coordinate."""
        return float(getattr(self, name))

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return the states that this term adds (`Role.BLOCK`): f, q, h.

        f, q, shape (n, d, d): transition into each sample, and covariance of the added noise, V^2
        (at the first sample the stationary covariance); h, shape (d,): weights of the states in
        the voltage.
        """
        raise NotImplementedError

    def variance(self) -> float:
        """Return the variance that this term adds to each measurement, V^2 (`Role.NOISE`)."""
        return 0.0

    def variances(self, s: Segment) -> FloatArray | float:
        """Return the variance at each sample of a segment; one number if it is constant."""
        return self.variance()

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit the law to the normal scores (`Role.LAW`); None if that fails."""
        return None

    def refit_law(self, view: View) -> LawFit | None:
        """Fit the law again to nearly the same scores; by default, from the beginning."""
        return type(self).fit_law(view)

    @classmethod
    def parameters(cls) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(spec.name for spec in fields(cls))

    @classmethod
    def usual(cls) -> dict[str, Any]:
        """Return the defaults of the parameters that may be omitted."""
        return {spec.name: spec.default for spec in fields(cls) if spec.default is not MISSING}

    @classmethod
    def unit(cls, name: str) -> str:
        """Return the unit of a parameter; empty if dimensionless."""
        return next(str(spec.metadata['unit']) for spec in fields(cls) if spec.name == name)

    @classmethod
    def label(cls, name: str) -> str:
        """Return the name of a parameter in texts."""
        return next(str(spec.metadata.get('label') or name) for spec in fields(cls)
                    if spec.name == name)

    @classmethod
    def positive(cls, name: str) -> bool:
        """Return whether a parameter has no negative values."""
        return next(float(spec.metadata['low']) >= 0.0 for spec in fields(cls)
                    if spec.name == name)

    @classmethod
    def read(cls, params: Mapping[str, Any]) -> Self:
        """Return a term from its parameters; a ValueError names missing or unknown ones."""
        names = cls.parameters()
        missing = [name for name in names if name not in {**cls.usual(), **params}]
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


@dataclass(frozen=True, eq=False)
class LawFit:
    """A fitted law (distribution of the innovations)."""

    term: Term  # With its fitted parameters
    se: dict[str, float]  # Standard errors of the parameters, where known
    z: FloatArray  # Normal scores: independent N(0, 1) if the law is right; shape (n,)
    # Gain of log predictive density at each sample over N(0, 1) for `View.z`, nats; shape (n,).
    gain: FloatArray
    free: int  # Number of fitted parameters
    push: FloatArray | None = None  # Variance that events add to the state, V^2; shape (n,)
    error: FloatArray | None = None  # Variance that events add to the measurement, V^2; shape (n,)
    # Factor on the variance of the OU noise in the step before each sample: the inverse of the
    # mean precision; shape (n,).
    power: FloatArray | None = None
    white: FloatArray | None = None  # Like `power`, for the white noise; shape (n,)
    # Voltage that the law adds to the level, V; subtracted before the Gaussian fit; shape (n,).
    offset: FloatArray | None = None


def _listed(names: Any) -> str:
    return ', '.join(f"'{name}'" for name in names)


def _number(term: str, name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f'{term}.{name} must be a number, got {value!r}')
    try:
        number = float(value)
    except OverflowError:
        raise ValueError(f'{term}.{name} must be finite, got an integer of '
                         f'{int(value).bit_length()} bits') from None
    if not math.isfinite(number):
        raise ValueError(f'{term}.{name} must be finite, got {number}')
    return number


def _check_range(term: str, name: str, value: float, rule: Mapping[str, Any]) -> None:
    low, high = rule['low'], rule['high']
    wrong = value > high or value < low or (rule['above'] and value == low)
    if wrong:
        unit = f' {rule["unit"]}' if rule['unit'] else ''
        least = f'above {low:g}' if rule['above'] else f'at least {low:g}'
        wanted = least if high == math.inf else (
            f'at most {high:g}' if low == -math.inf else f'{least} and at most {high:g}')
        raise ValueError(f'{term}.{name} must be {wanted}{unit}, got {value:g}')
