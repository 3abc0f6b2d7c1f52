"""Parameters that depend on throttle: sigma, the main finding of the paper; alpha; white noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.load import ripple
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, parameter, parameters, Role, Term
from ou_monitor.records import FloatArray


@dataclass(frozen=True)
class LoadDependentSigma(Term):
    """
    Multiply sigma by a factor that is a straight line in ln between knots.

    Level beyond the outer knots.
    """

    NAME: ClassVar[str] = 'load_dependent_sigma'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.DRIVE
    SIGNS: ClassVar[tuple[str, ...]] = ('variance throttle',)
    MEASURED: ClassVar[bool] = True
    # Where it steps was searched for.
    SEARCH: ClassVar[float] = by_parameters(
        0.0, lambda term: _STEP_PRICE if term.steps() else 0.0)
    LIVE: ClassVar[bool] = True
    MEANING: ClassVar[str] = 'The noise grows or shrinks with throttle.'
    REMEDY: ClassVar[str] = (
        'Let the estimator run while flying, so that filters and risk follow the load.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for some seconds at several levels'

    throttle: tuple[float, ...] = parameters('', 'knots, rising')
    log_factor: tuple[float, ...] = parameters('', 'ln(sigma at the knot / sigma of the ou)')

    def check(self) -> None:
        """Check that the knots rise and match."""
        if len(self.throttle) != len(self.log_factor) or not self.throttle:
            raise ValueError(
                f'{self.NAME}: throttle and log_factor need the same number of values, got '
                f'{len(self.throttle)} and {len(self.log_factor)}')
        if any(b <= a for a, b in zip(self.throttle, self.throttle[1:])):
            raise ValueError(f'{self.NAME}.throttle must rise, got {list(self.throttle)}')

    def steps(self) -> bool:
        """Return whether it is one step."""
        return len(self.throttle) == 2 and self.throttle[1] - self.throttle[0] < 3.0 * _EDGE

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.sigma *= np.exp(np.interp(s.throttle, self.throttle, self.log_factor))

        return effect

    def free(self) -> tuple[str, ...]:
        """Return the knots but the first, which sigma of the ou stands for."""
        return tuple(f'log_factor {k}' for k in range(1, len(self.log_factor)))

    def moved(self, name: str, by: float) -> LoadDependentSigma:
        """Return the term with one knot moved."""
        at = int(name.split()[1])
        factors = tuple(min(max(f + by, -_MOST), _MOST) if k == at else f
                        for k, f in enumerate(self.log_factor))
        return replace(self, log_factor=factors)

    def per_coordinate(self, name: str) -> float:
        """Return 1: a knot is a logarithm already."""
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the likelier two of: a straight line, steps, and as many knots as it takes."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        low, high = np.quantile(u, [0.01, 0.99])
        if high - low < _APART:
            return ()
        bins = _binned(view.z[view.train] ** 2, u, low, high)
        price = 0.5 * math.log(u.size)
        forms = []
        inner = np.unique(np.quantile(u, np.linspace(0.05, 0.95, 91)))
        ends = _ends(view.throttle)
        for knots in (ends, _greedy(bins, ends, price + _KNOT_PRICE),
                      *(np.array([at - _EDGE, at + _EDGE]) for at in inner)):
            factors, misfit = _to_bins(bins, knots)
            found = _STEP_PRICE if knots[-1] - knots[0] < 3.0 * _EDGE else (
                _KNOT_PRICE * (knots.size - 2))
            forms.append((misfit + price * knots.size + found, knots, factors))
        forms.sort(key=lambda form: form[0])
        return [cls(tuple(knots.tolist()), tuple((factors - factors[0]).tolist()))
                for _, knots, factors in forms[:2]]

    def relative(self, view: View) -> View:
        """Return scores as they are without this term, for candidates in its place."""
        assert view.throttle is not None
        factor = np.exp(np.interp(view.throttle, self.throttle, self.log_factor))
        return replace(view, z=view.z * factor)

    @classmethod
    def simplest(cls, view: View) -> Sequence[Term]:
        """Return a straight line."""
        if view.throttle is None:
            return ()
        low, high = _ends(view.throttle).tolist()
        return (cls((low, high), (0.0, 0.5)),) if high - low > _APART else ()


# What the search for the edge of a step costs, nats: ln of the edges tried.
_STEP_PRICE = 4.5
# The same for a knot; bins of throttle, scores in one at least, and knots at most.
_KNOT_PRICE = 3.5
_BINS, _IN_BIN, _MOST_KNOTS = 40, 20, 9
# Logarithms of factors that a fit stays within: where white noise hides the rail, nothing
# else holds them.
_MOST = 4.0
# Knots nearer than this are one, and half the width of a step, in throttle.
_APART, _EDGE = 0.02, 0.002


def _ends(throttle: FloatArray) -> FloatArray:
    """
    Return the knots of a straight line: where it ends, so that it is level nowhere.

    Of throttle throughout, which is known, also of the part kept.
    """
    return np.array([throttle.min(), throttle.max()])


Bins = tuple[FloatArray, FloatArray, FloatArray]


def _binned(square: FloatArray, u: FloatArray, low: float, high: float) -> Bins:
    """Return throttle, ln of the deviation of the scores, and samples, of bins that have some."""
    edges = np.linspace(low, high, _BINS + 1)
    where = np.clip(np.searchsorted(edges, u, side='right') - 1, 0, _BINS - 1)
    count = np.bincount(where, minlength=_BINS).astype(np.float64)
    some = count >= _IN_BIN
    centre = np.bincount(where, u, _BINS)[some] / count[some]
    power = np.bincount(where, square, _BINS)[some] / count[some]
    return centre, 0.5 * np.log(np.maximum(power, 1e-12)), count[some]


def _to_bins(bins: Bins, knots: FloatArray) -> tuple[FloatArray, float]:
    """Return factors at the knots that fit the bins, and what is left, nats."""
    centre, log, count = bins
    # The logarithm of a deviation found from n scores has a variance of 1/(2 n).
    weight = np.sqrt(2.0 * count)
    hats = np.stack([np.interp(centre, knots, row) for row in np.eye(knots.size)], axis=1)
    factors: FloatArray = np.asarray(
        np.linalg.lstsq(hats * weight[:, None], log * weight, rcond=1e-6)[0], dtype=np.float64)
    left = (log - hats @ factors) * weight
    return factors, 0.5 * float(left @ left)


def _greedy(bins: Bins, knots: FloatArray, price: float) -> FloatArray:
    """Return knots: the ends, and one after the other where it helps most, while it pays."""
    misfit = _to_bins(bins, knots)[1]
    while knots.size < _MOST_KNOTS:
        tried = [np.sort(np.append(knots, at)) for at in bins[0].tolist()
                 if float(np.abs(knots - at).min()) > _APART]
        if not tried:
            break
        value, best = min(((_to_bins(bins, more)[1], k) for k, more in enumerate(tried)))
        if misfit - value < price:
            break
        knots, misfit = tried[best], value
    return knots


@dataclass(frozen=True)
class LoadDependentAlpha(Term):
    """Multiply alpha by exp(slope * throttle)."""

    NAME: ClassVar[str] = 'load_dependent_alpha'
    FAMILY: ClassVar[str] = 'restoring'
    STAGE: ClassVar[Stage] = Stage.DRIVE
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.DRIVE
    FREE: ClassVar[tuple[str, ...]] = ('slope',)
    SIGNS: ClassVar[tuple[str, ...]] = ('state throttle',)
    MEASURED: ClassVar[bool] = True
    LIVE: ClassVar[bool] = True
    MEANING: ClassVar[str] = 'The relaxation rate depends on throttle.'
    REMEDY: ClassVar[str] = (
        'Fit each load level on its own (analyze); a single alpha is wrong at all levels but one.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for 50 relaxation times at each of several levels'

    slope: float = parameter('', 'ln of the factor at full throttle')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.alpha *= np.exp(self.slope * s.throttle)

        return effect

    def moved(self, name: str, by: float) -> LoadDependentAlpha:
        """Return the term with its slope moved."""
        return replace(self, slope=self.slope + by)

    def per_coordinate(self, name: str) -> float:
        """Return 1: the slope is that of a logarithm already."""
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the constant rate."""
        return () if view.throttle is None else (cls(0.0),)


# A change of throttle is counted over this time, s, or over one sample where those are farther
# apart: what the filter onboard takes as one correction.
_SPAN = 0.02
# Stamps nearer than this are one, s.
_HAIR = 1e-9
# A fit stays within a factor of e^4 on the deviation at the ripple's peak; and within these ratios
# for a step of throttle, of which the least is none.
_MOST_RIPPLE = 8.0
_LEAST_STEP, _MOST_STEP = 1e-3, 1e5
# Ratios that a start is chosen from.
_STEPS = np.geomspace(0.1, 1e4, 26)


@dataclass(frozen=True)
class LoadDependentNoise(Term):
    """
    Multiply the variance of the white noise by exp(ripple r(u)) + (step du)^2.

    r(u) = u (1.4 - u)/0.49 is the ripple current of an ESC over throttle, 1 at u = 0.7; du is the
    change of throttle in the last 20 ms: throttle and voltage are not read at one moment, so that
    an error as large as the change is added.  It changes what `measurement_noise` adds, and
    nothing without one.
    """

    NAME: ClassVar[str] = 'load_dependent_noise'
    FAMILY: ClassVar[str] = 'intensity'
    STAGE: ClassVar[Stage] = Stage.INSTRUMENT
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.DRIVE
    SIGNS: ClassVar[tuple[str, ...]] = ('variance throttle', 'variance change')
    MEASURED: ClassVar[bool] = True
    CHANGES: ClassVar[type[Term] | None] = MeasurementNoise
    # In white noise that the rail hides, one looks like the other.
    MEANING: ClassVar[str] = (
        'The white noise of the reading grows with throttle or with its changes: ripple of the '
        'ESCs, which the ADC samples.')
    REMEDY: ClassVar[str] = (
        'Put capacitance at the ESCs or a filter before the ADC; weigh readings at high throttle '
        'less.')
    SEPARATED_BY: ClassVar[str] = (
        'the same flight at several times the sampling rate: white noise has no memory there '
        'either')

    ripple: float = parameter('', 'ln of the factor on the variance at throttle 0.7')
    step: float = parameter(
        '', 'what a change of throttle from 0 to 1 within 20 ms adds, over that deviation', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        recent = _Recent()

        def effect(s: Segment) -> None:
            factor = np.exp(np.clip(self.ripple * ripple(s.throttle), -_MOST_RIPPLE, _MOST_RIPPLE))
            if self.step:
                factor += np.square(self.step * (s.throttle - recent(s.at, s.throttle)))
            s.noise = s.noise * np.sqrt(factor)

        return effect

    def free(self) -> tuple[str, ...]:
        """Return both: logarithms, the first of either sign."""
        return 'ripple', 'step'

    def moved(self, name: str, by: float) -> LoadDependentNoise:
        """Return the term with one logarithm moved."""
        if name == 'step':
            return replace(self, step=min(max(
                self.step * math.exp(by), _LEAST_STEP), _MOST_STEP))
        return replace(self, ripple=min(max(self.ripple + by, -_MOST_RIPPLE), _MOST_RIPPLE))

    def per_coordinate(self, name: str) -> float:
        """Return the derivative of a parameter with respect to its logarithm."""
        return self.step if name == 'step' else 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the slope that the logarithms of the squared scores have, and the best step."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        square = view.z[view.train] ** 2
        moved = np.square(u - _Recent()(view.at[view.train], u))
        # Where throttle rests, ripple alone is seen.  The logarithm of a squared normal score, cut
        # from below: those next to zero say nothing.
        still = moved <= float(np.median(moved))
        columns = np.column_stack((np.ones(u.size), ripple(u)))
        log = np.log(np.maximum(square[still], 1e-3))
        beta = np.linalg.lstsq(columns[still], log, rcond=1e-8)[0]
        slope = float(np.clip(beta[1], -0.5 * _MOST_RIPPLE, 0.5 * _MOST_RIPPLE))
        base = np.exp(slope * ripple(u))

        def cost(step: float) -> float:
            factor = base + step * step * moved
            # Of any scale: the measurement noise beside it is fitted.
            return 0.5 * float(np.log(factor).mean()) + 0.5 * math.log(
                max(float((square / factor).mean()), 1e-300))

        return (cls(slope, min(_STEPS.tolist(), key=cost)),)


class _Recent:
    """Throttle `_SPAN` before each sample, or that of the sample before where it is older."""

    def __init__(self) -> None:
        self._times = np.empty(0)
        self._values = np.empty(0)

    def __call__(self, at: FloatArray, throttle: FloatArray) -> FloatArray:
        """Return it for the next samples (at in s)."""
        done = self._times.size
        times = np.concatenate((self._times, at))
        values = np.concatenate((self._values, throttle))
        hair = _HAIR + 2.0 * np.spacing(np.abs(at))
        then = np.searchsorted(times, at - _SPAN + hair, side='right') - 1
        then = np.clip(then, 0, None)
        # Never later than the sample before.
        then = np.minimum(then, np.maximum(np.arange(done, times.size) - 1, 0))
        keep = max(int(then[-1]) - 1, 0)
        self._times, self._values = times[keep:], values[keep:]
        return np.asarray(values[then], dtype=np.float64)
