"""
Base of all terms: named parameters with units, a simulator, a likelihood, words.

A term defines its effect on a `Segment` of samples.  A simulator draws from its own
generator and keeps its state from segment to segment, so a recording does not
depend on the segments it is simulated in, nor one term's draws on another's.

A module in this folder that defines a `Term` is a cause: the search, its words, the
report and the model file find it through `catalogue`, and read all that they need to
know of it from the class.
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

# A coefficient to start from that is not left out as 0 is.
NEXT_TO_ZERO = 1e-12


class Role(enum.Enum):
    """How a term enters a likelihood."""

    # Known without a model: a property of the codes and stamps themselves.
    EXACT = enum.auto()
    # A sum of known columns, each times a coefficient.
    MEAN = enum.auto()
    # Changes alpha or sigma by what is measured.
    DRIVE = enum.auto()
    # Further states of the linear system.
    BLOCK = enum.auto()
    # White noise of the measurement.
    NOISE = enum.auto()
    # Another law of the one-step innovations.
    LAW = enum.auto()


def parameter(unit: str, text: str, low: float = -math.inf, high: float = math.inf, *,
              above: bool = False, default: float | None = None) -> Any:
    """Declare a parameter of a term; one with a default may be left out, in a file too."""
    about = {'unit': unit, 'text': text, 'low': low, 'high': high, 'above': above}
    return field(metadata=about) if default is None else field(default=default, metadata=about)


def parameters(unit: str, text: str) -> Any:
    """Declare a parameter that is a list of numbers; as `parameter`, any finite value."""
    return field(metadata={'unit': unit, 'text': text, 'low': -math.inf, 'high': math.inf,
                           'above': False, 'several': True})


class _ByParameters(Generic[Value]):
    """An attribute with a value for a class, and another for each term by its parameters."""

    def __init__(self, usual: Value, own: Callable[[Any], Value]) -> None:
        self._usual, self._own = usual, own

    def __get__(self, term: Any, kind: type) -> Value:
        return self._usual if term is None else self._own(term)


def by_parameters(usual: Value, own: Callable[[Any], Value]) -> Value:
    """Declare an attribute of a class that a term computes from its parameters."""
    return cast('Value', _ByParameters(usual, own))


@dataclass(frozen=True)
class Term:
    """
    Base of all terms: a frozen record of parameters.

    ValueError: a parameter is not a number, or out of its range.

    Examples
    --------
    >>> from ou_monitor.model.terms.catalogue import catalogue
    >>> sag = catalogue()['load_sag'](linear=0.3, square=0.1)
    >>> sag.NAME, sag.linear, sag.NEEDS_THROTTLE
    ('load_sag', 0.3, True)

    """

    # As in a model file and in a finding.
    NAME: ClassVar[str] = ''
    FAMILY: ClassVar[str] = ''
    # When it acts.
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = False
    # How it enters a likelihood.
    ROLE: ClassVar[Role] = Role.MEAN
    # Parameters that multiply known columns (`Role.MEAN`).
    LINEAR: ClassVar[tuple[str, ...]] = ()
    # Positive parameters found by maximum likelihood, on a log scale (`DRIVE`, `BLOCK`, `NOISE`).
    FREE: ClassVar[tuple[str, ...]] = ()
    # Statistics that show this term, by the beginning of their names, after + or - where only
    # one direction does.
    SIGNS: ClassVar[tuple[str, ...]] = ()
    # Answers to throttle or time alone: the search tries it before latent causes.
    MEASURED: ClassVar[bool] = False
    # Causes that it imitates or that imitate it: one beside the other would only refine its form.
    # It suffices that one of the two names the other.
    IMITATES: ClassVar[tuple[str, ...]] = ()
    # Whether a model can have several, and whether the search looks for another one.
    SEVERAL: ClassVar[bool] = False
    RECURS: ClassVar[bool] = False
    # Evidence that it needs, as a share of the largest of any cause.
    LEAST_SHARE: ClassVar[float] = 0.0
    # Share of its signs that it may leave; 0: it is withdrawn where any statistic fails.
    MAY_LEAVE: ClassVar[float] = 0.0
    # Statistics that it cannot leave.
    REFUTED_BY: ClassVar[tuple[str, ...]] = ()
    # Penalty for what is searched beside the free parameters, nats.
    SEARCH: ClassVar[float] = 0.0
    # Number of parameters that the term finds from the scores, and not the fit (`apart`).
    APART: ClassVar[int] = 0
    # A fit takes seconds: none is begun late in a search.
    DEAR: ClassVar[bool] = False
    # Its spectrum is broad and the same throughout, so that a fit starts from that of the scores,
    # and the number of states that it adds to the linear system (`Role.BLOCK`).
    BROAD: ClassVar[bool] = False
    STATES: ClassVar[int] = 0
    # The term that it changes and that a model needs beside it; None for the `ou`.
    CHANGES: ClassVar[type[Term] | None] = None
    # The live estimate has alpha, sigma or u0 as this term makes them at the present throttle.
    LIVE: ClassVar[bool] = False
    # For people: what it is, what to do about it, which recording separates it from other causes.
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
        """Check relations between parameters; the base has none."""

    def start(self, rng: np.random.Generator) -> Effect:
        """Return a function that changes one `Segment` after the other, in order."""
        raise NotImplementedError

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return starting points for a fit to what the model leaves over, best first."""
        return ()

    def holds(self, view: View) -> bool:
        """Return whether fitted parameters still fit the name; by default they do."""
        return True

    def beside(self, ou: Term) -> Term:
        """Return the `ou` that a fit with this term starts from; the default leaves it."""
        return ou

    def columns(self, s: Segment) -> FloatArray:
        """Return one column for each of `LINEAR`, V per unit, shape (n, p)."""
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
        """Return the term with the coefficients of its columns."""
        return replace(self, **dict(zip(self.LINEAR, map(float, beta), strict=True)))

    def free(self) -> tuple[str, ...]:
        """Return the names of the coordinates found by maximum likelihood."""
        return self.FREE

    def moved(self, name: str, by: float) -> Self:
        """Return the term with one coordinate moved; the default moves the logarithm."""
        return replace(self, **{name: getattr(self, name) * math.exp(by)})

    def apart(self, view: View) -> Self:
        """Return the term with the parameters that it finds itself, from the scores with it."""
        return self

    def per_coordinate(self, name: str) -> float:
        """Return the derivative of a parameter with respect to its coordinate."""
        return float(getattr(self, name))

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        """
        Return the states that this term adds (`Role.BLOCK`): f, q, h.

        f, q, shape (n, d, d): transition into each sample and covariance of what is added, V^2,
        at the first sample the stationary one; h, shape (d,): shares of the states in the voltage.
        """
        raise NotImplementedError

    def variance(self) -> float:
        """Return the variance that this term adds to each measurement, V^2 (`Role.NOISE`)."""
        return 0.0

    def variances(self, s: Segment) -> FloatArray | float:
        """Return the same at each sample of a segment, where what is measured changes it."""
        return self.variance()

    @classmethod
    def fit_law(cls, view: View) -> LawFit | None:
        """Fit another law to the normal scores (`Role.LAW`); None where it cannot be."""
        return None

    def refit_law(self, view: View) -> LawFit | None:
        """Fit the law again to nearly the same scores; the default starts anew."""
        return type(self).fit_law(view)

    @classmethod
    def parameters(cls) -> tuple[str, ...]:
        """Return the names of the parameters."""
        return tuple(spec.name for spec in fields(cls))

    @classmethod
    def usual(cls) -> dict[str, Any]:
        """Return the values of parameters that may be left out."""
        return {spec.name: spec.default for spec in fields(cls) if spec.default is not MISSING}

    @classmethod
    def unit(cls, name: str) -> str:
        """Return the unit of a parameter; empty for a pure number."""
        return next(str(spec.metadata['unit']) for spec in fields(cls) if spec.name == name)

    @classmethod
    def positive(cls, name: str) -> bool:
        """Return whether a parameter has no negative values."""
        return next(float(spec.metadata['low']) >= 0.0 for spec in fields(cls)
                    if spec.name == name)

    @classmethod
    def read(cls, params: Mapping[str, Any]) -> Self:
        """Return a term from a value for every parameter; ValueError names what is wrong."""
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
    """A law of the innovations, fitted."""

    term: Term  # With its parameters
    se: dict[str, float]  # Their standard errors, where known
    z: FloatArray  # Normal scores under the law: independent N(0, 1) when it is right; shape (n,)
    # Log predictive density of each sample over that of N(0, 1) for `View.z`, nats; shape (n,).
    gain: FloatArray
    free: int  # Parameters fitted
    push: FloatArray | None = None  # Variance that events add to the state, V^2; shape (n,)
    error: FloatArray | None = None  # Variance that events add to the measurement, V^2; shape (n,)
    # Factor on the variance of what the noise adds in the step before each sample, as the law
    # believes it was: the inverse of the mean precision; shape (n,).
    power: FloatArray | None = None
    # Voltage that the law adds to the level, V; the Gaussian part is fitted to the rest; shape
    # (n,).
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
