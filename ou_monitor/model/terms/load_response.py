"""What throttle changes: the mean (sag, lag, inrush, polarisation), sigma, alpha, white noise."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import ClassVar

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.term import (
    by_parameters, Effect, NEXT_TO_ZERO, parameter, parameters, Role, Segment, Stage, Term, View)
from ou_monitor.records import FloatArray
from scipy.signal import correlate


# Evidence required for a growth in addition to the penalty of its parameter, nats.  Without this
# requirement, a growth was found in 5 of 72 simulated flights with a steady sag; with it, in none.
_GROWS = 6.0
# Meaning and remedy of a sag.
_FALLS = ('The mean falls with $load: IR drop of battery, leads and regulator. The estimates '
          'are settled values; sag and resistance of the supply refer to 1 s after a step.')
_LESS = ('Give the estimator the $load, so that it removes the sag; thicker or shorter leads '
         'reduce it.')


@dataclass(frozen=True)
class LoadSag(Term):
    """
    Subtract (linear + growth * t) * throttle + square * throttle^2 from the level.

    t is the time since the first sample.  The growth describes a pack whose resistance rises as it
    empties, and falls as it warms.  A square or growth of exactly 0 is not fitted.
    """

    NAME = 'load_sag'
    FAMILY = 'load'
    STAGE = Stage.LEVEL
    NEEDS_THROTTLE = True
    ROLE = Role.MEAN
    LINEAR = by_parameters(
        ('linear', 'square', 'growth'), lambda term: (
            'linear', *(name for name in ('square', 'growth') if getattr(term, name))))
    SIGNS = ('throttle', 'growing effect')
    SEARCH = by_parameters(0.0, lambda term: _GROWS if term.growth else 0.0)
    MEASURED = True
    LIVE = True
    MEANING = by_parameters(
        _FALLS, lambda term: _FALLS if term.falls() else
        'The mean rises with $load, as if $load were inverted or not the load.')
    REMEDY = by_parameters(_LESS, lambda term: _LESS if term.falls() else
                           'Check topic, unit and sign of $load.')
    SEPARATED_BY = '$load held for some seconds at several levels'

    linear: float = parameter('V', 'drop at full $load, linear part',
                              label='settled fall, linear')
    square: float = parameter('V', 'drop at full $load, quadratic part',
                              label='settled fall, square')
    growth: float = parameter('V/s', 'growth of the linear part', default=0.0)

    def change(self, s: Segment) -> None:
        linear = self.linear + self.growth * (s.at - s.origin)
        s.level -= (linear + self.square * s.throttle) * s.throttle

    def falls(self) -> bool:
        """Return whether full throttle lowers the voltage."""
        return self.linear + self.square >= 0.0

    def at(self, t: float) -> LoadSag:
        """Return the sag t seconds after the first sample, without growth."""
        return LoadSag(self.linear + self.growth * t, self.square)

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line, a parabola, and a parabola that grows."""
        # A straight line is not combined with growth, because the search would then add a slow
        # transient for the curvature.
        return cls(0.0, 0.0), cls(0.0, NEXT_TO_ZERO), cls(0.0, NEXT_TO_ZERO, NEXT_TO_ZERO)


# Evidence per sample, nats, that `lagged` needs beyond other forms: errors shrink by 0.2 %.
# Chosen on 12 simulated packs, gecko and cf_takeoff; in the recordings, the forms nearly tie.
_LAGGED = 0.002
# Tolerance of stamps, s: the resolution of a bag.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class LoadTransient(Term):
    """
    Add gain * d(u) + square * d(u^2) + lagged * (u^2 - low(u)^2) + rise * max(d(u), 0).

    u is the delayed throttle, low(x) the low-pass of x (tau), and d(x) = x - low(x).  A unit step
    up adds (gain + rise) * exp(-t/tau), and a unit step down adds -gain * exp(-t/tau): motors draw
    more current while they speed up, but return no current while they slow down.  gain > 0 delays
    the sag; gain < 0 deepens it at first (inrush).  If gain and square equal the sag's linear and
    square, the sag is low-passed; if gain and lagged do, throttle is low-passed before the sag,
    as by a motor whose speed lags.
    """

    NAME = 'load_transient'
    FAMILY = 'load'
    STAGE = Stage.LEVEL
    NEEDS_THROTTLE = True
    ROLE = Role.MEAN
    # A rise, square or lagged of 0 is not fitted.
    LINEAR = by_parameters(
        ('gain', 'rise', 'square', 'lagged'), lambda term: (
            'gain', *(name for name in ('rise', 'square', 'lagged') if getattr(term, name))))
    SIGNS = ('throttle',)
    SEARCH = 3.4
    FORM_COST = by_parameters(0.0, lambda term: _LAGGED * (term.lagged != 0.0))
    MEASURED = True
    SEVERAL = True
    RECURS = True
    MEANING = by_parameters(
        'The mean responds to changes of $load: lag, inrush or slow recovery of polarisation.',
        lambda term: term.about()[0])
    REMEDY = by_parameters(
        'Include the fall after a $load step in the brown-out margin.',
        lambda term: term.about()[1])
    SEPARATED_BY = (
        'single steps of $load, each held for ten times the time constant of the response')

    gain: float = parameter('V', 'part of a step to full $load that decays with tau',
                            label='decaying part')
    tau: float = parameter('s', 'time constant of the decay', 0.0, above=True)
    delay: float = parameter('s', 'delay before the response begins', 0.0)
    rise: float = parameter('V', 'added to the gain while $load rises', default=0.0)
    square: float = parameter('V', 'decaying part that follows the square of $load',
                              label='decaying part, square', default=0.0)
    lagged: float = parameter('V', 'decaying part that follows the square of the lagging $load',
                              label='decaying part, square of the lag', default=0.0)

    def about(self) -> tuple[str, str]:
        """Return meaning and remedy of a response of this sign and time constant."""
        kind = type(self)
        late = self.gain + self.rise + self.square + self.lagged > 0.0
        return (kind.MEANING, kind.REMEDY) if self.delay else _ABOUT[self.tau > _INRUSH, late]

    def start(self, rng: np.random.Generator) -> Effect:
        slow: dict[int, float] = {}
        times = np.empty(0)
        values = np.empty(0)
        last = math.nan

        def effect(s: Segment) -> None:
            nonlocal times, values, last
            throttle = s.throttle
            if self.delay > 0.0:
                # Use the throttle `delay` ago; at the beginning, the first throttle.
                times = np.concatenate((times, s.at))
                values = np.concatenate((values, throttle))
                # Tolerance for rounding, in case the delay is a whole number of steps.
                rounding = _ROUNDING + 2.0 * np.spacing(np.abs(s.at))
                then = np.searchsorted(times, s.at - self.delay + rounding, side='right') - 1
                throttle = values[np.maximum(then, 0)]
                keep = max(int(then[-1]), 0)
                times, values = times[keep:], values[keep:]
            phi = np.exp(-s.step / self.tau)
            # Each throttle holds until the next one.
            held = np.concatenate((throttle[:1] if math.isnan(last) else [last], throttle[:-1]))
            last = float(throttle[-1])

            def change(power: int) -> FloatArray:
                value, before = throttle ** power, held ** power
                low = first_order(phi, (1.0 - phi) * before, slow.get(power, float(before[0])))
                slow[power] = float(low[-1])
                return value - low

            if self.gain or self.rise or self.lagged:
                linear = change(1)
                s.level += self.gain * linear + self.rise * np.maximum(linear, 0.0)
                # u^2 - low^2 with low = u - linear.
                s.level += self.lagged * (2.0 * throttle - linear) * linear
            if self.square:
                s.level += self.square * change(2)

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return time constants from half a step to an eighth of the recording, and delays."""
        step = 1.0 / view.rate
        longest = LONGEST * float(view.at[-1])
        if longest <= 2.0 * step:
            return ()
        count = max(2, math.ceil(2.0 * math.log2(longest / (SHORTEST * step))))
        lags = [cls(0.0, float(tau), 0.0) for tau in np.geomspace(
            SHORTEST * step, longest, count)]
        # A pure delay, of whole steps, is a response that never decays.
        latest = max(_LATEST, 4.0 * step)
        delays = np.unique(np.append(np.rint(np.geomspace(step, latest, _DELAYS) / step),
                                     _likely_delay(view, round(latest / step)))) * step
        late = [cls(0.0, _LASTING / LONGEST * longest, float(delay)) for delay in delays]
        return tuple(form for term in (*lags, *late) for form in term.forms(view.by_current))

    def forms(self, by_current: bool) -> tuple[LoadTransient, ...]:
        """Return variants to fit: linear, with a square, and those of motors if fast enough."""
        names = ['square']
        if self.tau < _INRUSH and not self.delay:
            # A measured current does not lag behind the motors.
            names += ['rise'] if by_current else ['rise', 'lagged']
        plain = replace(self, rise=0.0, square=0.0, lagged=0.0)
        return plain, *(replace(plain, **{name: NEXT_TO_ZERO}) for name in names)


# Shortest visible time constant, in steps: a seventh of the response remains at the next sample.
SHORTEST = 0.5
# Longest time constant, as a share of the recording, because a slower response looks like a drift
# (with 0.25, held-out scores of ar8, jd and cf_takeoff were lower).
LONGEST = 0.125
# Longest time that motors take to speed up, s.
_INRUSH = 0.2
# Meaning and remedy; keys: whether the response is slower than the motors, and whether it delays
# the fall rather than deepening it.
_ABOUT = {
    (False, True): ('Part of the fall lags behind $load: motors and filters respond late.',
                    'Expect a smaller fall in short bursts of $load.'),
    (False, False): ('The voltage falls deepest just after $load rises: inrush of motors.',
                     'Include this fall in the brown-out margin; capacitance at the ESC reduces '
                     'it.'),
    (True, True): ('Part of the fall follows $load slowly, and recovers as slowly: '
                   'polarisation of a battery, or a slow regulator.',
                   'Set the brown-out margin for the longest burst of $load.'),
    (True, False): ('Part of the fall after a rise of $load recovers while $load is held: a '
                    'regulator corrects it, or a battery warms.',
                    LoadTransient.REMEDY)}
# Number of delays to try, and maximum delay, s.
_DELAYS, _LATEST = 16, 0.5
# Time constant, in durations of the recording, for a response that never decays.
_LASTING = 1e5


def _likely_delay(view: View, latest: int) -> int:
    """Return the delay, in steps, at which throttle, whitened, tells most of the scores."""
    if view.throttle is None:
        return 1
    u = view.throttle.copy()
    u[1:] -= view.phi[1:] * view.throttle[:-1]
    u = (u / np.sqrt(view.variance))[view.train]
    product = correlate(view.z[view.train], u - u.mean())[u.size:][:latest]
    return 1 + int(np.argmax(np.abs(product))) if product.size else 1


@dataclass(frozen=True)
class LoadDependentSigma(Term):
    """Multiply sigma by a factor whose ln is linear between knots, and constant beyond them."""

    NAME = 'load_dependent_sigma'
    FAMILY = 'intensity'
    STAGE = Stage.DRIVE
    NEEDS_THROTTLE = True
    ROLE = Role.DRIVE
    SIGNS = ('variance throttle',)
    MEASURED = True
    # Penalty of the search for a step's position.
    SEARCH = by_parameters(
        0.0, lambda term: _STEP_COST if term.steps() else 0.0)
    LIVE = True
    MEANING = 'The noise grows or shrinks with $load.'
    REMEDY = (
        'Run the estimator in flight, so that filter and risk use the noise at the present load.')
    SEPARATED_BY = '$load held for some seconds at several levels'

    throttle: tuple[float, ...] = parameters('', 'knots, rising')
    log_factor: tuple[float, ...] = parameters('', 'ln(sigma at the knot / sigma of the ou)')

    def check(self) -> None:
        """Check that the knots rise, and that each has a factor."""
        if len(self.throttle) != len(self.log_factor) or not self.throttle:
            raise ValueError(
                f'{self.NAME}: throttle and log_factor need the same number of values, got '
                f'{len(self.throttle)} and {len(self.log_factor)}')
        if any(b <= a for a, b in zip(self.throttle, self.throttle[1:])):
            raise ValueError(f'{self.NAME}.throttle must rise, got {list(self.throttle)}')

    def steps(self) -> bool:
        """Return whether the curve is a single step."""
        return len(self.throttle) == 2 and self.throttle[1] - self.throttle[0] < 3.0 * _EDGE

    def change(self, s: Segment) -> None:
        s.sigma *= np.exp(np.interp(s.throttle, self.throttle, self.log_factor))

    def free(self) -> tuple[str, ...]:
        """Return the log factors to fit: all but the first, where sigma is the OU's."""
        return tuple(f'log_factor {k}' for k in range(1, len(self.log_factor)))

    def moved(self, name: str, by: float) -> LoadDependentSigma:
        at = int(name.split()[1])
        factors = tuple(min(max(f + by, -_MOST), _MOST) if k == at else f
                        for k, f in enumerate(self.log_factor))
        return replace(self, log_factor=factors)

    def per_coordinate(self, name: str) -> float:
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the two most likely curves: a straight line, a single step, or several knots."""
        if view.throttle is None:
            return ()
        u = view.throttle[view.train]
        low, high = np.quantile(u, [0.01, 0.99])
        if high - low < _APART:
            return ()
        bins = _binned(view.z[view.train] ** 2, u, np.linspace(low, high, _BINS + 1))
        penalty = 0.5 * math.log(u.size)
        forms = []
        inner = np.unique(np.quantile(u, np.linspace(0.05, 0.95, 91)))
        ends = _ends(view.throttle)
        steps = np.column_stack((inner - _EDGE, inner + _EDGE))
        line, bent = _to_bins(bins, ends[None]), _greedy(bins, ends, penalty + _KNOT_COST, _APART)
        for knots, factors, misfit in (
                (ends, line[0][0], float(line[1][0])), bent,
                *zip(steps, *_to_bins(bins, steps), strict=True)):
            found = _STEP_COST if knots[-1] - knots[0] < 3.0 * _EDGE else (
                _KNOT_COST * (knots.size - 2))
            forms.append((misfit + penalty * knots.size + found, knots, factors))
        forms.sort(key=lambda form: form[0])
        return [cls(tuple(knots.tolist()), tuple((factors - factors[0]).tolist()))
                for _, knots, factors in forms[:2]]


# Penalty of the search for the position of a step, nats: ln of the number of positions tried (91).
_STEP_COST = 4.5
_KNOT_COST = 3.5  # Penalty of the search for a knot, nats
# Number of bins, minimum number of scores in a bin, and maximum number of knots.
_BINS, _IN_BIN, _MOST_KNOTS = 40, 20, 9
# Maximum |ln factor|: where white noise hides the rail, the data do not limit the factor.
_MOST = 4.0
# Minimum distance between knots, and half the width of a step, in throttle.
_APART, _EDGE = 0.02, 0.002


def _ends(throttle: FloatArray) -> FloatArray:
    """Return lowest and highest throttle of all samples, as the knots of a straight line."""
    return np.array([throttle.min(), throttle.max()])


# Result of `_binned`.
Bins = tuple[FloatArray, FloatArray, FloatArray]


def _binned(square: FloatArray, x: FloatArray, edges: FloatArray) -> Bins:
    """Return mean input, ln of the scores' std, and count, for each bin with enough scores."""
    last = edges.size - 2
    where = np.clip(np.searchsorted(edges, x, side='right') - 1, 0, last)
    count = np.bincount(where, minlength=last + 1).astype(np.float64)
    some = count >= _IN_BIN
    centre = np.bincount(where, x, last + 1)[some] / count[some]
    power = np.bincount(where, square, last + 1)[some] / count[some]
    # Mean squares from which a known variance was subtracted may be negative: use at least one
    # standard error.
    least = np.sqrt(np.bincount(where, square * square, last + 1)[some]) / count[some]
    return centre, 0.5 * np.log(np.maximum(np.maximum(power, least), 1e-12)), count[some]


def _hats(x: FloatArray, knots: FloatArray) -> FloatArray:
    """Return weights, shape (sets, inputs, knots), that interpolate at x; knots: (sets, knots)."""
    sets, count = knots.shape
    at = np.clip((x[None, :, None] >= knots[:, None, :]).sum(axis=2) - 1, 0, count - 2)
    rows = np.arange(sets)[:, None]
    low, high = knots[rows, at], knots[rows, at + 1]
    share = np.clip((x - low) / (high - low), 0.0, 1.0)
    hats = np.zeros((sets, x.size, count))
    places = rows, np.arange(x.size)[None, :]
    hats[(*places, at)] = 1.0 - share
    hats[(*places, at + 1)] += share
    return hats


def _to_bins(bins: Bins, knots: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Fit log factors to the bins for each set of knots; return them and the misfits, nats."""
    centre, log, count = bins
    # The logarithm of a standard deviation estimated from n scores has a variance of 1/(2 n).
    weight = 2.0 * count
    hats = _hats(centre, knots)
    gram = np.einsum('sik,i,sil->skl', hats, weight, hats)
    product = np.einsum('sik,i->sk', hats, weight * log)
    factors = np.einsum('skl,sl->sk', np.linalg.pinv(gram, rcond=1e-9, hermitian=True), product)
    left = log - np.einsum('sik,sk->si', hats, factors)
    return factors, 0.5 * (left * left) @ weight


def _greedy(bins: Bins, knots: FloatArray, penalty: float, apart: float
            ) -> tuple[FloatArray, FloatArray, float]:
    """Add the best knot while that gains `penalty`; return knots, log factors and misfit, nats."""
    factors, misfit = _to_bins(bins, knots[None])
    found = knots, factors[0], float(misfit[0])
    while found[0].size < _MOST_KNOTS:
        tried = [np.sort(np.append(found[0], at)) for at in bins[0].tolist()
                 if float(np.abs(found[0] - at).min()) > apart]
        if not tried:
            break
        factors, misfit = _to_bins(bins, np.array(tried))
        best = int(np.argmin(misfit))
        if found[2] - misfit[best] < penalty:
            break
        found = tried[best], factors[best], float(misfit[best])
    return found


@dataclass(frozen=True)
class LoadDependentAlpha(Term):
    """
    Multiply alpha by exp(slope * throttle), and sigma by exp(sigma_slope * throttle).

    A sigma_slope of exactly 0 is not fitted; with half of the slope, Var_inf does not change.
    """

    NAME = 'load_dependent_alpha'
    FAMILY = 'restoring'
    STAGE = Stage.DRIVE
    NEEDS_THROTTLE = True
    ROLE = Role.DRIVE
    FREE = by_parameters(('slope', 'sigma_slope'), lambda term: (
        ('slope', 'sigma_slope') if term.sigma_slope else ('slope',)))
    SIGNS = ('state throttle',)
    MEASURED = True
    LIVE = True
    MEANING = by_parameters(
        'The relaxation rate depends on $load.', lambda term:
        'The relaxation rate and the noise depend on $load.' if term.sigma_slope else
        type(term).MEANING)
    REMEDY = (
        'Fit each $load level separately (analyze): a single alpha is right at one level only.')
    SEPARATED_BY = '$load held for 50 relaxation times at each of several levels'

    slope: float = parameter('', 'ln of the factor of alpha at full $load')
    sigma_slope: float = parameter('', 'ln of the factor of sigma at full $load', default=0.0)

    def change(self, s: Segment) -> None:
        s.alpha *= np.exp(self.slope * s.throttle)
        s.sigma *= np.exp(self.sigma_slope * s.throttle)

    def moved(self, name: str, by: float) -> LoadDependentAlpha:
        return replace(self, **{name: getattr(self, name) + by})

    def per_coordinate(self, name: str) -> float:
        return 1.0

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a slope of alpha alone, and one of both, each from 0."""
        return () if view.throttle is None else (cls(0.0), cls(0.0, NEXT_TO_ZERO))


# Time constants of the moving means of throttle from which changes are measured, s.
_FAST, _SLOW = 0.03, 0.2
# Inputs on which the noise may depend, and their time constants, s: throttle; the distance of
# throttle from its mean over the last 30 ms; its change between samples; the distance between its
# means over the last 30 and 200 ms; and decaying sums of its rises and of its falls.
INPUTS = (('throttle', 0.0), ('fast', _FAST), ('step', 0.0), ('slow', _SLOW), *(
    (what, span) for span in (0.1, 0.5, 2.5) for what in ('rises', 'falls')))
# Penalty of choosing an input, nats: ln of the number of inputs.
_INPUT_COST = math.log(len(INPUTS))
# Minimum share of white noise in the one-step errors for separating it from the rail's noise.
_LEAST_WHITE = 0.05
# Quantiles at the edges of an input's bins; dense at the top, because most changes are zero.
_SHARES = np.array([*np.linspace(0.0, 0.95, 39), 0.97, 0.98, 0.985, 0.99, 0.995, 0.998, 1.0])
# Maximum squared score once the curves are roughly known, to limit the effect of outliers.
_LARGEST = 25.0
_ROUNDS = 2  # Number of rounds in which each curve is fitted given the others
_SPACING = 0.02  # Minimum distance between knots, relative to the range of the input
# Index of the curve that is applied to the sum of the other curves.
SUM = len(INPUTS)


def _curve(square: FloatArray, x: FloatArray, shares: FloatArray, log: FloatArray | None
           ) -> tuple[FloatArray, FloatArray] | None:
    """Return knots in x, and ln of the scores' std, 0 at the first knot; None if constant."""
    # square: squared scores, shape (n,); shares: quantiles at the edges of the bins of x; log: a
    # rough estimate of ln of the scores' std, shape (n,), if available.
    edges = np.unique(np.quantile(x, shares))
    if edges.size < 3:
        return None
    if log is not None:
        usual = float(np.mean(np.minimum(square, _LARGEST * float(np.mean(square)))))
        square = np.minimum(square, _LARGEST * usual * np.exp(2.0 * log))
    centre, values, count = _binned(square, x, edges)
    if log is not None:
        # With heavy tails, the mean square is less certain: reduce the effective count.
        unit = square * np.exp(-2.0 * log)
        count = count / max(0.5 * float(np.mean(unit**2) / np.mean(unit)**2) - 0.5, 1.0)
    flat = 0.0 if centre.size < 2 else float(np.sum(
        count * (values - np.average(values, weights=count)) ** 2))
    penalty = 0.5 * math.log(x.size)
    if flat < penalty + _INPUT_COST:
        return None
    knots, factors, misfit = _greedy((centre, values, count), centre[[0, -1]],
                                     penalty + _KNOT_COST, _SPACING * float(np.ptp(centre)))
    if flat - misfit < penalty * (knots.size - 1) + _KNOT_COST * (knots.size - 2) + _INPUT_COST:
        return None
    return knots, np.clip(factors - factors[0], -_MOST, _MOST)


# Remedy of white noise that depends on the load.
_FASTER = ('Sample faster to tell ripple from a fast rail; against ripple, add capacitance at the '
           'ESCs or a filter before the ADC.')


@dataclass(frozen=True)
class LoadDependentNoise(Term):
    """
    Multiply the white noise by a factor that depends on throttle and its changes.

    The logarithm of the factor is a sum of curves over some of `INPUTS`, linear between knots and
    constant beyond them; a last curve may be applied to the sum.  If the load disturbs the rail
    itself, sigma is multiplied by a power of the factor.
    """

    NAME = 'load_dependent_noise'
    FAMILY = 'intensity'
    STAGE = Stage.DRIVE
    NEEDS_THROTTLE = True
    ROLE = Role.DRIVE
    SIGNS = ('variance throttle', 'variance change')
    MEASURED = True
    # Penalty of the search for inputs and knots.
    SEARCH = by_parameters(0.0, lambda term: sum(
        _KNOT_COST * (values.size - 2) + _INPUT_COST for _, values in term.curves().values()))
    APART = by_parameters(0, lambda term: max(0, len(term.at) - len(set(term.number)) - 1))
    CHANGES = MeasurementNoise
    MEANING = (
        'The white noise of the readings depends on $load or its changes: ripple of the ESCs, '
        'or a rail that relaxes faster than the sampling, which looks the same.')
    REMEDY: ClassVar[str] = by_parameters(
        f'{_FASTER} Give readings at high $load less weight.',
        lambda term: LoadDependentNoise.REMEDY if 0 in term.number else
        f'{_FASTER} Give readings soon after changes of $load less weight.')
    SEPARATED_BY = (
        'the same flight at several times the sampling rate: white noise stays uncorrelated')

    number: tuple[float, ...] = parameters('', 'index of the input of each knot: see INPUTS, SUM')
    at: tuple[float, ...] = parameters('', 'value of the input at the knot, rising for each input')
    log_factor: tuple[float, ...] = parameters('', 'ln of the factor at the knot')
    on_sigma: float = parameter('', 'power of the factor that multiplies sigma', 0.0, default=0.0)

    def check(self) -> None:
        """Check the indices, that all lists have the same length, and that the knots rise."""
        whole = all(float(k).is_integer() and 0 <= k <= SUM for k in self.number)
        if not whole or not len(self.number) == len(self.at) == len(self.log_factor):
            raise ValueError(f'{self.NAME}: number (0 to {SUM}), at and log_factor '
                             f'need the same length, got {list(self.number)}, {list(self.at)} and '
                             f'{list(self.log_factor)}')
        for knots, _ in self.curves().values():
            if any(b <= a for a, b in zip(knots, knots[1:])):
                raise ValueError(f'{self.NAME}.at must rise for one input, got {list(knots)}')

    def curves(self) -> dict[int, tuple[FloatArray, FloatArray]]:
        """Return knots and log factors by the index of the input."""
        numbers = np.asarray(self.number, dtype=int)
        return {k: (np.asarray(self.at)[numbers == k], np.asarray(self.log_factor)[numbers == k])
                for k in np.unique(numbers).tolist()}

    def factors(self) -> dict[str, tuple[list[float], list[float]]]:
        """Return knots and factors by input; `product`: the product of the other factors."""
        names = [f'{what} {span:g} s' if span else what for what, span in INPUTS]
        return {(*names, 'product')[k]: (
            (np.exp(at) if k == SUM else at).tolist(), np.exp(log).tolist())
            for k, (at, log) in self.curves().items()}

    def start(self, rng: np.random.Generator) -> Effect:
        inputs = Inputs(self.curves())

        def effect(s: Segment) -> None:
            log = self.log_of(inputs(s.step, s.throttle))
            s.noise = s.noise * np.exp(log)
            if self.on_sigma:
                s.sigma = s.sigma * np.exp(self.on_sigma * log)

        return effect

    def free(self) -> tuple[str, ...]:
        """Return the scale of the logarithm, and the power on sigma if sigma follows it."""
        # `apart` finds the form of the curves from squared scores, which a wrong scale biases.
        return ('scale',) * bool(self.number) + ('on_sigma',) * bool(self.on_sigma)

    def moved(self, name: str, by: float) -> LoadDependentNoise:
        if name != 'scale':
            return replace(self, on_sigma=min(self.on_sigma * math.exp(by), _MOST_POWER))
        # The last curve, if any, gives the scale of the sum.
        last = SUM in self.number
        return replace(self, log_factor=tuple(
            value * math.exp(by) if k == SUM or not last else value
            for k, value in zip(self.number, self.log_factor, strict=True)))

    def per_coordinate(self, name: str) -> float:
        return 1.0 if name == 'scale' else super().per_coordinate(name)

    def log_of(self, inputs: Mapping[int, FloatArray]) -> FloatArray:
        """Return ln of the factor for the inputs that `Inputs` returns."""
        size = next((x.size for x in inputs.values()), 1)
        curves = self.curves()
        bent = curves.pop(SUM, None)
        total = np.asarray(sum((np.interp(inputs[k], *curve) for k, curve in curves.items()),
                               np.zeros(size)))
        return total if bent is None else np.interp(total, *bent)

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return curves fitted to the squared scores, without and with a factor on sigma."""
        if view.throttle is None:
            return []
        white = cls((), (), ()).apart(view)
        return [white, replace(white, on_sigma=1.0)] if white.at else [white]

    def apart(self, view: View) -> LoadDependentNoise:
        """Refit the curves, as factors on white noise only, to the scores of their model."""
        assert view.throttle is not None
        inputs = {k: x[view.train] for k, x in Inputs(range(len(INPUTS)))(
            view.step, view.throttle).items()}
        square = view.z[view.train] ** 2
        white = 1.0 - np.broadcast_to(view.trust, view.z.shape)[view.train]
        if float(white.mean()) > _LEAST_WHITE:
            # Subtract the share of the rail's noise, which the term does not scale.  Keep negative
            # results, because without them low noise would be overestimated.
            square = (square - (1.0 - white)) / np.maximum(white, _LEAST_WHITE)
        square = square * np.exp(2.0 * self.log_of(inputs))
        few = max(1, math.ceil(2.0 * _IN_BIN * _SHARES.size / square.size))
        shares = np.append(_SHARES[:-1:few], 1.0)
        found: dict[int, tuple[FloatArray, FloatArray]] = {}
        logs = {k: np.zeros(square.size) for k in inputs}
        for turn in range(_ROUNDS):
            for k, x in inputs.items():
                curve = _curve(square * np.exp(-2.0 * (sum(logs.values()) - logs[k])), x, shares,
                               logs[k] if turn else None)
                if curve is None:
                    found.pop(k, None)
                    logs[k] = np.zeros(square.size)
                else:
                    found[k] = curve
                    logs[k] = np.interp(x, *curve)
        total = np.asarray(sum(logs.values()))
        bent = _curve(square * np.exp(-2.0 * total), total, shares, np.zeros(square.size))
        if bent is not None:
            found[SUM] = bent[0], bent[0] + bent[1]
        number, at, log_factor = (
            tuple(float(value) for part in parts for value in part) for parts in (
                [[k] * knots.size for k, (knots, _) in found.items()],
                [knots for knots, _ in found.values()], [values for _, values in found.values()]))
        return replace(self, number=number, at=at, log_factor=log_factor)


# Maximum power on sigma: then sigma alone follows the load, and the white noise hardly does.
_MOST_POWER = 10.0


class Inputs:
    """Computes some of INPUTS, with a state that is kept from segment to segment."""

    def __init__(self, wanted: Iterable[int]) -> None:
        self._wanted = [k for k in wanted if k != SUM]
        self._last = math.nan
        self._before: dict[tuple[str, float], float] = {}

    def __call__(self, step: FloatArray, throttle: FloatArray) -> dict[int, FloatArray]:
        """Return the inputs of the next samples by index (step in s)."""
        if math.isnan(self._last):
            self._last = float(throttle[0])
            self._before = {('mean', span): self._last for span in (_FAST, _SLOW)}
        change = np.diff(throttle, prepend=self._last)
        self._last = float(throttle[-1])
        known: dict[tuple[str, float], FloatArray] = {}

        def through(what: str, span: float) -> FloatArray:
            """Return the mean of throttle, or a decaying sum of its rises or falls (span, s)."""
            if (what, span) not in known:
                keep = np.exp(-step / span)
                added = ((1.0 - keep) * throttle if what == 'mean' else
                         np.maximum(change if what == 'rises' else -change, 0.0))
                series = first_order(keep, added, self._before.get((what, span), 0.0))
                self._before[what, span] = float(series[-1])
                known[what, span] = series
            return known[what, span]

        found = {}
        for k in self._wanted:
            what, span = INPUTS[k]
            if what == 'throttle':
                found[k] = throttle
            elif what == 'step':
                found[k] = np.abs(change)
            elif what == 'fast':
                found[k] = np.abs(throttle - through('mean', _FAST))
            elif what == 'slow':
                found[k] = np.abs(through('mean', _FAST) - through('mean', _SLOW))
            else:
                found[k] = through(what, span)
        return found
