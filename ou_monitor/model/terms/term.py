"""
Base of all terms: parameters with units, a simulator, a likelihood, explanations.

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
from functools import cached_property
import math
from typing import Any, cast, ClassVar, Generic, Self, TypeVar

import numpy as np
from ou_monitor.records import FloatArray
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

Value = TypeVar('Value')

# Initial value of a coefficient that is to be fitted; a coefficient of exactly 0 is not fitted.
NEXT_TO_ZERO = 1e-12


class Stage(enum.IntEnum):
    """Order in which terms act on the samples, from the clock to the logger."""

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
class Segment:
    """Consecutive samples during a simulation; terms change it in place."""

    t: FloatArray  # Stamps, s; shape (n,)
    at: FloatArray  # Times at which the samples are actually taken, s; shape (n,)
    # Time since the previous sample, s; infinite before the first, which has the stationary law;
    # shape (n,).
    step: FloatArray
    # 0..1; shape (n,).  For the mean, a value applies from its own stamp to the next stamp; for
    # the noise, it applies from the previous stamp to its own stamp.
    throttle: FloatArray
    origin: float  # Stamp of the first sample of the recording, s
    # Rate, 1/s, and intensity, V/sqrt(s), over the step before each sample; shape (n,).
    alpha: FloatArray
    sigma: FloatArray
    power: FloatArray  # Factor on the variance of the noise in that step; shape (n,)
    push: FloatArray  # Added to the state at the end of the step, V; shape (n,)
    # Coefficients of x^2, 1/(V s), and x^3, 1/(V^2 s), added to the restoring force alpha x.
    bend: tuple[float, float]
    x: FloatArray  # OU deviation, V; shape (n,)
    level: FloatArray  # Voltage of the rail without x, V; shape (n,)
    noise: FloatArray  # Factor on the std of the white measurement noise; shape (n,)
    voltage: FloatArray  # Reading, V; shape (n,)
    slope: FloatArray | float = 0.0  # Slope of the tones, V/s; shape (n,); only for likelihoods
    # Transformations of the normal draws of the white noise, in the order of their application.
    shape: list[Callable[[FloatArray], FloatArray]] = field(default_factory=list)

    @property
    def phi(self) -> FloatArray:
        """Return the share of the OU deviation that remains after each step; shape (n,)."""
        return np.asarray(np.exp(-self.alpha * self.step), dtype=np.float64)

    @property
    def added(self) -> FloatArray:
        """Return the variance of the OU noise in each step, V^2; shape (n,)."""
        decayed = -np.expm1(-2.0 * self.alpha * self.step)
        return np.asarray(self.sigma * self.sigma * decayed / (2.0 * self.alpha))


Effect = Callable[[Segment], None]


LOG_2PI = math.log(2.0 * math.pi)
# Minimum probability, which limits normal scores to about 8.
_EDGE = 1e-15


@dataclass(frozen=True, eq=False)
class View:
    """The residual of the model so far, to which a candidate is fitted."""

    z: FloatArray  # Normal scores of the one-step innovations under the model so far; shape (n,)
    variance: FloatArray  # Predictive variance of each sample, V^2; shape (n,)
    phi: FloatArray  # exp(-alpha step) of the OU in the step before each sample; shape (n,)
    # Deviation of the previous sample from its mean, V; 0 at the first; shape (n,).
    state: FloatArray
    residual: FloatArray  # Voltage less its mean, V; shape (n,)
    at: FloatArray  # Time since the first sample, s; shape (n,)
    step: FloatArray  # Time since the previous sample, s; shape (n,)
    throttle: FloatArray | None  # 0..1; shape (n,)
    train: slice  # Samples to which parameters are fitted
    # Gain of the filter, 0..1: 1 without white noise; shape (n,).
    trust: FloatArray | float = 1.0
    # Share of each variance that is due to the noise of the `ou` in the step before: 1 without
    # white noise and other states; shape (n,).
    driven: FloatArray | float = 1.0
    # Factor on the variance that other laws have found; `variance` excludes it; shape (n,).
    power: FloatArray | float = 1.0
    slope: FloatArray | float = 0.0  # Slope of the tones of the model, V/s; shape (n,)
    by_current: bool = False  # Whether `throttle` is a current as a share of the largest

    @cached_property
    def rate(self) -> float:
        """Return the median sampling rate, Hz."""
        return 1.0 / float(np.median(self.step[1:]))


def normal_scores(cdf: FloatArray) -> FloatArray:
    """Return the normal scores of probabilities."""
    scores: FloatArray = ndtri(np.clip(cdf, _EDGE, 1.0 - 1e-16))
    return scores


def log_normal(z: FloatArray, mean: FloatArray | float = 0.0, var: FloatArray | float = 1.0
               ) -> FloatArray:
    """Return log densities of a normal distribution."""
    result: FloatArray = -0.5 * (LOG_2PI + np.log(var) + (z - mean) ** 2 / var)
    return result


def climb(value: Callable[[FloatArray], float], start: Sequence[float] | FloatArray,
          size: float = 0.4, most: int = 200) -> tuple[FloatArray, float]:
    """Maximise a function of a few parameters (Nelder & Mead); return position and value."""
    x0 = np.asarray(start, dtype=np.float64)
    simplex = np.vstack([x0, x0 + size * np.eye(x0.size)])
    found = minimize(lambda x: -value(x), x0, method='Nelder-Mead',
                     options={'initial_simplex': simplex, 'maxfev': most, 'xatol': 1e-3,
                              'fatol': 1e-2})
    return found.x, -float(found.fun)


def curvature_se(value: Callable[[FloatArray], float], at: FloatArray, step: float = 0.05
                 ) -> FloatArray:
    """Return the joint standard errors at a maximum of a log-likelihood; NaN if undetermined."""
    found = np.array([value(x) for x in at + _around(at.size, step)])
    return _errors(_parabola(found, at.size, step)[1])


def _around(size: int, step: float) -> FloatArray:
    """Return moves that determine a parabola: none, along each axis, and along pairs of axes."""
    moves, pairs = step * np.eye(size), np.triu_indices(size, 1)
    both = moves[pairs[0]] + moves[pairs[1]]
    # Central differences, because one-sided ones are biased by the third derivative.
    return np.concatenate((np.zeros((1, size)), moves, -moves, both, -both))


def _parabola(found: FloatArray, size: int, step: float) -> tuple[FloatArray, FloatArray]:
    """Return gradient and second derivatives from the values at the points of `_around`."""
    with np.errstate(invalid='ignore'):
        top, up, down = found[0], found[1:size + 1], found[size + 1:2 * size + 1]
        bend, pairs = np.diag((up - 2.0 * top + down) / step**2), np.triu_indices(size, 1)
        sides = found[2 * size + 1:].reshape(2, -1).sum(axis=0)
        alone = up + down - top
        bend[pairs] = (sides - alone[pairs[0]] - alone[pairs[1]]) / (2.0 * step**2)
        return (up - down) / (2.0 * step), bend + np.triu(bend, 1).T


def _errors(bend: FloatArray) -> FloatArray:
    """Return joint standard errors from second derivatives of a log-likelihood."""
    errors, slope = np.full(bend.shape[0], math.nan), bend.diagonal()
    # Leave out parameters without effect or at a limit, which must not affect the other errors.
    kept = np.flatnonzero(np.isfinite(slope) & (slope < 0.0))
    scale = np.sqrt(-slope[kept])
    curve, axes = np.linalg.eigh(-bend[np.ix_(kept, kept)] / np.outer(scale, scale))
    if (curve > 0.0).all():
        errors[kept] = np.sqrt((axes**2 / curve).sum(axis=1)) / scale
    return errors


def refine(values: Callable[[FloatArray], FloatArray], start: Sequence[float] | FloatArray,
           step: float = 0.1) -> tuple[FloatArray, float, FloatArray] | None:
    """Return position, value and errors of a maximum near `start` by Newton steps, or None."""
    x = np.asarray(start, dtype=np.float64)
    turn = 0
    while True:
        found = values(x + _around(x.size, step))
        if not np.isfinite(found).all():
            return None
        top, (gradient, bend) = found[0], _parabola(found, x.size, step)
        curve, axes = np.linalg.eigh(bend)
        if curve[0] >= 0.0:
            return None
        # Step uphill along each principal axis, even where the curvature is positive.
        by = axes @ (axes.T @ gradient / np.maximum(np.abs(curve), _STRAIGHT * -curve[0]))
        gain = 0.5 * float(by @ gradient)
        ends = x + np.clip(by, -0.5, 0.5) * _SHARES[:, None]
        further = values(ends) if gain >= _FLAT and turn < _NEWTON else found[:1]
        if not further.max() > top:
            return x, float(top), _errors(bend)
        x, turn = ends[int(np.argmax(further))], turn + 1


_NEWTON, _FLAT = 5, 0.05  # Maximum number of Newton steps, and gain, nats, below which they end
_SHARES = np.array([1.0, 0.4, 0.1])  # Step lengths tried
_STRAIGHT = 1e-3  # Minimum curvature as a share of the largest


def mixture_cdf(z: FloatArray, weight: FloatArray, mean: FloatArray, std: FloatArray
                ) -> FloatArray:
    """Return the cdf of normal mixtures."""
    result: FloatArray = (weight * ndtr((z[:, None] - mean) / std)).sum(axis=1)
    return result


class Role(enum.Enum):
    """How a term enters a likelihood."""

    # Detected without a model, from ADC codes and stamps.
    EXACT = enum.auto()
    # A sum of known columns with coefficients.
    MEAN = enum.auto()
    # Multiplies alpha, sigma or the white noise by a factor that follows a measured input.
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
    # to the other, unless it RECURS.  It suffices that one of the two classes names the other.
    IMITATES: ClassVar[tuple[str, ...]] = ()
    # Whether the law finds single events.  It is fitted before the other laws, which would absorb
    # them, and may be added to one that it imitates.
    EVENTS: ClassVar[bool] = False
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
    # `$load` in them, and in the texts of parameters, stands for throttle or the measured current.
    MEANING: ClassVar[str] = ''
    REMEDY: ClassVar[str] = ''
    SEPARATED_BY: ClassVar[str] = ''

    def __post_init__(self) -> None:
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

    @classmethod
    def variants(cls) -> Sequence[type[Term]]:
        """Return other classes of this NAME that the search tries; by default none."""
        return ()

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
    bias: FloatArray | None = None  # Mean error of the reading, given its score, V; shape (n,)
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
