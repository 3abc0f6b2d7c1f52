"""Spectral lines: of a tone, of a resonance, and of a tone whose frequency follows throttle."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np
from ou_monitor.model.ou import first_order
from ou_monitor.model.sinusoid import fit_sinusoid
from ou_monitor.model.spectral_lines import find_lines, Line, on_grid
from ou_monitor.model.terms.term import (
    by_parameters, Effect, parameter, Role, Segment, Stage, Term, View)
from ou_monitor.records import FloatArray
from scipy.signal import welch
from scipy.special import chndtrix


@dataclass(frozen=True)
class Tone(Term):
    """Add a sine whose phase is a random walk, so that its spectral line is `linewidth` wide."""

    NAME = 'tone'
    FAMILY = 'line'
    STAGE = Stage.LEVEL
    # If the phase wanders, the term has two states instead of known columns.
    ROLE = by_parameters(
        Role.MEAN, lambda term: Role.BLOCK if term.linewidth else Role.MEAN)
    LINEAR = by_parameters(
        ('amplitude', 'phase'), lambda term: () if term.linewidth else ('amplitude', 'phase'))
    FREE = by_parameters(
        (), lambda term: ('amplitude', 'frequency', 'linewidth') if term.linewidth else ())
    SIGNS = ('line',)
    SEARCH = 10.0
    STATES = 2
    SEVERAL = True
    RECURS = True
    MAY_LEAVE = 0.3
    MEANING = (
        'A spectral line at a fixed frequency: PWM of an ESC or its alias, or a DC-DC converter.')
    REMEDY = 'Find the source from its frequency; sample at another rate to identify an alias.'
    SEPARATED_BY = 'the same rail at two sampling rates: an alias moves, a true line does not'

    amplitude: float = parameter('V', 'peak', 0.0)
    frequency: float = parameter('Hz', 'frequency', 0.0, above=True)
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: a pure tone', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        wander = phase_noise(self.linewidth, rng)

        def effect(s: Segment) -> None:
            phase = 2.0 * math.pi * ((s.at - s.origin) * self.frequency % 1.0) + self.phase
            s.level += self.amplitude * np.sin(phase + wander(s.step))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of the residual, the first also with a wandering phase."""
        found = [cls.at(line, view) for line in lines_of(view)[:_MOST]]
        spread = math.sqrt(float(np.median(view.variance)))
        return [*found, *(cls(0.3 * spread, line.frequency, 0.0, width) for line in found[:1]
                          for width in _widths(line.frequency, view))]

    @classmethod
    def at(cls, line: Line, view: View) -> Tone:
        """Return a starting point at the frequency of a line, refined over the whole recording."""
        grid = on_grid(view.at, view.z)
        wave = fit_sinusoid(grid.values, grid.rate, line.frequency, line.resolution)
        return cls(0.0, wave.frequency, 0.0, 0.0)

    def holds(self, view: View) -> bool:
        """Return whether this may be a line rather than ringing."""
        return self.linewidth < SHARP * self.frequency < 0.5 * SHARP * view.rate and (
            steady_or_ringing(view, self.frequency, self.linewidth)[0])

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, math.pi * self.linewidth, s.step, self.amplitude / math.sqrt(2.0))

    def columns(self, s: Segment) -> FloatArray:
        """Return a sine and a cosine of unit amplitude."""
        columns = []
        for phase in (0.0, 0.5 * math.pi):
            level = replace(s, level=np.zeros(s.t.size))
            unit = replace(self, amplitude=1.0, phase=phase, linewidth=0.0)
            unit.start(np.random.default_rng(0))(level)
            columns.append(level.level)
        return np.stack(columns, axis=1)

    def linear_values(self) -> list[float]:
        return [self.amplitude * math.cos(self.phase), self.amplitude * math.sin(self.phase)]

    def with_linear(self, beta: Sequence[float]) -> Tone:
        return replace(self, amplitude=math.hypot(*beta), phase=math.atan2(beta[1], beta[0]))


def lines_of(view: View) -> tuple[Line, ...]:
    """Return the lines of the residual, strongest first."""
    # Include the held-out part, because a line may begin late.  A penalty covers the
    # search for its frequency.
    grid = on_grid(view.at, view.z)
    return find_lines([grid.values], grid.rate, false_alarm=_PROPOSED, wide=True).lines


# Maximum number of lines tried, and their false-alarm probability, which is large because the
# evidence decides later.
_MOST, _PROPOSED = 3, 0.5
# A fit starts from two linewidths: _WANDERS times the resolution of the recording, and the
# geometric mean of this and the maximum.
_WANDERS = 3.0
SHARP = 0.05  # Maximum width of a line relative to its frequency


def _widths(frequency: float, view: View) -> list[float]:
    """Return the linewidths, Hz, from which a fit of a narrow line starts."""
    least = _WANDERS / float(view.at[-1])
    return [width for width in (least, math.sqrt(least * SHARP * frequency))
            if width < SHARP * frequency]


@dataclass(frozen=True)
class Resonance(Term):
    """
    Add noise with a broad spectral line.

    Autocovariance std^2 exp(-damping |tau|) (cos(w |tau|) + tilt damping/w sin(w |tau|)),
    w = 2 pi frequency; exact in law at any spacing.  tilt = 0 is the real part of a
    complex OU, 1 the voltage of the capacitor of an LC filter (passes low
    frequencies), -1 the current of its choke (nothing at 0 Hz).
    """

    NAME = 'resonance'
    FAMILY = 'line'
    STAGE = Stage.LEVEL
    ROLE = Role.BLOCK
    # The tilt is fitted unless it is 0.
    FREE = by_parameters(
        ('frequency', 'damping', 'std'),
        lambda term: ('frequency', 'damping', 'std', *(('tilt',) if term.tilt else ())))
    SLOW_FIT = True
    SIGNS = ('line', '+band', 'autocorrelation')
    IMITATES = ('tone',)
    # Few broad peaks are distinct, but as many narrow ones as of a `tone`.
    SEARCH = by_parameters(5.0, lambda term: Tone.SEARCH if term.is_narrow() else 5.0)
    STATES = 2
    SEVERAL = True
    RECURS = True
    # A limit is needed, because a broad line fits almost any spectrum.
    MAY_LEAVE = 0.1
    # Ringing that is driven by noise is Gaussian, so it has no bursts and no third moments.
    REFUTED_BY = ('bursts', 'products of three')
    MEANING = 'The rail rings: inductance of the leads against the capacitors.'
    REMEDY = 'Damp it with a resistive (electrolytic) capacitor or shorter leads.'
    SEPARATED_BY = 'constant $load, sampled at ten times that frequency'

    frequency: float = parameter('Hz', 'frequency of the ringing', 0.0, above=True)
    damping: float = parameter('1/s', 'decay rate of the ringing', 0.0, above=True)
    std: float = parameter('V', 'standard deviation', 0.0)
    tilt: float = parameter('', 'slope of the spectrum: 1 low-pass, -1 band-pass', -1.0, 1.0)

    def moved(self, name: str, by: float) -> Resonance:
        if name != 'tilt':
            return super().moved(name, by)
        return replace(self, tilt=min(max(self.tilt + by, -_STEEPEST), _STEEPEST))

    def per_coordinate(self, name: str) -> float:
        return 1.0 if name == 'tilt' else super().per_coordinate(name)

    def start(self, rng: np.random.Generator) -> Effect:
        before = 0.0 + 0.0j

        def effect(s: Segment) -> None:
            nonlocal before
            n = s.t.size
            pairs = rng.standard_normal((n, 2))
            q = self.block(s)[1]
            low = np.sqrt(np.maximum(q[:, 0, 0], 0.0))
            across = np.divide(q[:, 0, 1], low, out=np.zeros(n), where=low > 0.0)
            rest = np.sqrt(np.maximum(q[:, 1, 1] - across * across, 0.0))
            kicks = low * pairs[:, 0] + 1j * (across * pairs[:, 0] + rest * pairs[:, 1])
            # In a rotating frame, the ringing is an OU with a real rate.
            turn = np.exp(2j * math.pi * self.frequency * ((s.at - s.origin) % (
                1.0 / self.frequency)))
            phi = np.exp(-self.damping * s.step)
            kicks /= turn
            still = first_order(phi, kicks.real, before.real) + 1j * first_order(
                phi, kicks.imag, before.imag)
            before = complex(still[-1])
            s.level += (still * turn).real

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return starting points at the broad peaks of the residual, and at its strongest line."""
        spread = float(np.sqrt(np.median(view.variance)))
        return [*(cls(frequency, width, 0.5 * spread, tilt)
                  for frequency, width in broad_peaks(view.z[view.train], view.rate)
                  for tilt in (0.0, -_STEEP, _STEEP)),
                *(cls(line.frequency, math.pi * width, 0.2 * spread, 0.0)
                  for line in lines_of(view)[:1] for width in _widths(line.frequency, view)
                  if steady_or_ringing(view, line.frequency, width)[1])]

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        turn = 2.0 * math.pi * self.frequency * np.where(np.isfinite(s.step), s.step, 0.0)
        return rotation(turn, self.damping, s.step, self.std,
                        self.tilt * self.damping / (2.0 * math.pi * self.frequency))

    def holds(self, view: View) -> bool:
        """Return whether this oscillates, and may be ringing rather than a line."""
        # It is ringing if its line is too wide for a tone, or if its amplitude varies.
        width = self.damping / math.pi
        return width < 2.0 * self.frequency < view.rate and (
            not self.is_narrow() or steady_or_ringing(view, self.frequency, width)[1])

    def is_narrow(self) -> bool:
        """Return whether the line is as narrow as a tone may be."""
        return self.damping < math.pi * SHARP * self.frequency


# Initial and maximum |tilt|: at 1, a step would add no noise to one of the states.
_STEEP, _STEEPEST = 0.9, 0.99


@dataclass(frozen=True)
class ThrottleTone(Term):
    """Add a sine of frequency idle + slope * throttle, with the random phase of `Tone`."""

    NAME = 'throttle_tone'
    FAMILY = 'line'
    STAGE = Stage.LEVEL
    NEEDS_THROTTLE = True
    ROLE = Role.BLOCK
    FREE = ('amplitude', 'linewidth')
    SLOW_FIT = True
    SIGNS = ('order', 'line')
    SEARCH = 9.0
    STATES = 2
    SEVERAL = True
    RECURS = True
    MAY_LEAVE = 0.3
    MEANING = 'A spectral line that follows $load: commutation of the motors.'
    REMEDY = 'Add capacitance at the ESC, or a notch that follows $load.'
    SEPARATED_BY = 'a slow sweep of $load'

    amplitude: float = parameter('V', 'peak', 0.0)
    idle: float = parameter('Hz', 'frequency at zero $load; below 0 for an alias')
    slope: float = parameter('Hz', 'frequency at full $load less idle')
    phase: float = parameter('rad', 'phase at the first sample')
    linewidth: float = parameter('Hz', 'width of the line; 0: it follows $load exactly', 0.0)

    def start(self, rng: np.random.Generator) -> Effect:
        turns = 0.0
        wander = phase_noise(self.linewidth, rng)

        def effect(s: Segment) -> None:
            nonlocal turns
            step = np.where(np.isfinite(s.step), s.step, 0.0)
            run = turns + np.cumsum((self.idle + self.slope * s.throttle) * step)
            turns = float(run[-1]) % 1.0
            phase = 2.0 * math.pi * run + self.phase
            s.level += self.amplitude * np.sin(phase + wander(s.step))

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return the strongest lines of the residual that move with throttle."""
        if view.throttle is None:
            return ()
        spread = math.sqrt(float(np.median(view.variance)))
        moving = _MOVES / float(view.at[-1]) / max(float(np.ptp(view.throttle)), 1e-6)
        return [cls(0.3 * spread, idle, slope, 0.0, 0.05)
                for idle, slope in order_lines(view) if abs(slope) > moving]

    def holds(self, view: View) -> bool:
        """Return whether throttle moves the line by more than its width."""
        return view.throttle is not None and (
            abs(self.slope) * float(view.throttle[view.train].std()) > _MORE * self.linewidth)

    def block(self, s: Segment) -> tuple[FloatArray, FloatArray, FloatArray]:
        step = np.where(np.isfinite(s.step), s.step, 0.0)
        turn = 2.0 * math.pi * (self.idle + self.slope * s.throttle) * step
        damping = math.pi * max(self.linewidth, _NARROWEST)
        return rotation(turn, damping, s.step, self.amplitude / math.sqrt(2.0))


# Minimum change of a line's frequency over the range of throttle, in bins; lines that change less
# are tones.
_MOVES = 30.0
# Minimum change of a line's frequency by one standard deviation of throttle, in linewidths.
_MORE = 1.0
_NARROWEST = 1e-4  # Minimum linewidth of the two states, Hz


def phase_noise(linewidth: float, rng: np.random.Generator
                ) -> Callable[[FloatArray], FloatArray]:
    """Return a function of the steps, s, that draws the phase noise of a line (width in Hz)."""
    last = 0.0

    def walk(step: FloatArray) -> FloatArray:
        nonlocal last
        if not linewidth > 0.0:
            return np.zeros(step.size)
        spread = np.sqrt(2.0 * math.pi * linewidth * np.where(np.isfinite(step), step, 0.0))
        path = last + np.cumsum(spread * rng.standard_normal(step.size))
        last = float(path[-1])
        return np.asarray(path)

    return walk


def rotation(turn: FloatArray, damping: float, step: FloatArray, std: float,
             lag: float = 0.0) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return f, q and h (see `Term.block`) of two states that rotate, decay and are driven."""
    # turn: angle in each step, rad; damping in 1/s; std in V.  Autocovariance of the first state:
    # std^2 exp(-damping t) (cos a + lag sin a), with a the angle in time t.
    shrink = np.exp(-damping * step)
    f, q = np.empty((step.size, 2, 2)), np.zeros((step.size, 2, 2))
    along, across = shrink * np.cos(turn), shrink * np.sin(turn)
    f[:, 0, 0] = f[:, 1, 1] = along
    f[:, 1, 0], f[:, 0, 1] = across, -across
    left = std * std * -np.expm1(-2.0 * damping * step)
    if lag == 0.0:
        q[:, 0, 0] = q[:, 1, 1] = left
    else:
        # Stationary covariance (11: 1, 12: -lag, 22: 1 + 2 lag^2, times std^2) less its rotation.
        more, mixed = 2.0 * lag * lag * std * std, 2.0 * lag * std * std * along * across
        q[:, 0, 0] = left - more * across * across - mixed
        q[:, 1, 1] = left + more * (1.0 - along * along) + mixed
        q[:, 0, 1] = q[:, 1, 0] = (more * along * across - lag * std * std * (
            1.0 - along * along + across * across))
    return f, q, np.array([1.0, 0.0])


# `steady_or_ringing`: segments per 1 / linewidth, minimum number of segments, and distances, in
# segments, of neighbouring frequencies.
_FINE, _ENOUGH, _ASIDE = 4.0, 12, (-6.0, -5.0, -4.0, 4.0, 5.0, 6.0)
# Interquartile range / median of powers that are exponentially distributed, as of ringing; its
# standard error, times the root of the number of segments, in simulations of lines and ringing
# 0.3 to 2 Hz wide with white noise; and the number of standard errors that excludes one of both.
_EXPONENTIAL, _SPREADS, _CLEARLY = math.log(3.0) / math.log(2.0), 2.0, 2.0


def steady_or_ringing(view: View, frequency: float, linewidth: float) -> tuple[bool, bool]:
    """Return whether a line may have a constant amplitude, and that of ringing (Hz)."""
    # The powers of segments are compared with those of a constant amplitude in noise (noncentral
    # chi-square) and of ringing.  A weak line may be either; in few segments it counts as a line.
    length = int(view.rate / (_FINE * max(linewidth, 1.0 / float(view.at[-1]))))
    count = view.residual.size // max(length, 1)
    if count < _ENOUGH or length * frequency < _FINE * view.rate:
        return True, False
    size = count * length
    v, at = (view.residual - view.residual.mean())[:size], view.at[:size]

    def powers(centre: float) -> FloatArray:
        turned = v * np.exp(-2j * math.pi * (centre * at % 1.0))
        return np.asarray(np.abs(turned.reshape(count, length) @ np.hanning(length)) ** 2)

    power = powers(frequency)
    noise = float(np.median([powers(frequency + k * view.rate / length) for k in _ASIDE]))
    low, middle, high = np.percentile(power, [25.0, 50.0, 75.0]).tolist()
    if not noise > 0.0 or not middle > 0.0:
        return True, False
    ratio = max(0.0, float(power.mean()) * math.log(2.0) / noise - 1.0)
    first, second, third = chndtrix([0.25, 0.5, 0.75], 2.0, 2.0 * ratio).tolist()
    steady, found = (third - first) / second, (high - low) / middle
    room, midway = _CLEARLY * _SPREADS / math.sqrt(count), 0.5 * (_EXPONENTIAL + steady)
    return found < max(steady + room, midway), found > min(_EXPONENTIAL - room, midway)


def broad_peaks(z: FloatArray, rate: float) -> list[tuple[float, float]]:
    """Return frequency, Hz, and damping, 1/s, of broad spectral peaks of scores (rate in Hz)."""
    found = []
    for length in (64, 256, 1024, 4096):
        if z.size < 4 * length:
            continue
        frequency, density = welch(z, rate, nperseg=length)
        # The lowest bins contain slow noise, not ringing.
        density[:3] = 0.0
        at = int(np.argmax(density))
        # Cramer bound of the tail of a mean of exponentials, against the number of bins searched.
        mean, segments = float(density[at] / np.median(density[3:])), z.size / length
        if segments * (mean - 1.0 - math.log(max(mean, 1e-9))) > math.log(density.size):
            found.append((float(frequency[at]), 4.0 * math.pi * rate / length))
    return found


def order_lines(view: View) -> list[tuple[float, float]]:
    """Return idle and slope, Hz, of lines that follow throttle (Hough transform, refined)."""
    if view.throttle is None:
        return []
    z, u = view.z[view.train], view.throttle[view.train]
    # `_unwound` searches the whole recording, in longer segments: if a line follows throttle
    # exactly, it stays sharp in them.
    found = sorted([line for length in _lengths(view.rate)
                    for line in _hough(z, u, view.rate, length)[:_MOST]]
                   + _unwound(view.z, view.throttle, view.rate), key=lambda line: -line.rise)
    return [_refined(z, u, view.rate, line.idle, line.slope, view.rate / (2.0 * line.length))
            for line in found[:_MOST]]


def order_power(z: FloatArray, u: FloatArray, rate: float) -> tuple[float, float]:
    """Return the `rise` of the strongest line that follows throttle, and the number of trials."""
    top, trials = 0.0, 0.0
    for length in _lengths(rate):
        best = _hough(z, u, rate, length)
        if best:
            top = max(top, best[0].rise)
            trials += _INDEPENDENT * 2.0 * length * len(best)
    return top, trials


# Share of the examined lines that count as independent: small, because neighbours share most
# bins.  With this share, 1 of 120 simulated flights of white noise exceeded the 95 % point.
_INDEPENDENT = 0.02
# Maximum slope, in sampling rates: from idle to full throttle a line may fold once and return.
_REACH = 1.0
# Ratio of long to short segments; short segments show lines while throttle moves fast.
_SHORTER = 8


def _lengths(rate: float) -> tuple[int, ...]:
    """Return the lengths of segments, samples: about 0.25 s, and an eighth of it."""
    long = int(1 << max(5, round(math.log2(max(32.0, 0.25 * rate)))))
    short = max(long // _SHORTER, 32)
    return (long,) if short == long else (long, short)


@dataclass(frozen=True)
class _Line:
    """A line that follows throttle."""

    rise: float  # Lower bound of -ln(probability of such a power by chance)
    # Frequency at zero throttle, and its change up to full throttle, Hz.
    idle: float
    slope: float
    length: int  # Samples in a segment


def _hough(z: FloatArray, u: FloatArray, rate: float, length: int) -> list[_Line]:
    """Return for each slope the line with the best idle frequency, strongest first."""
    count = z.size // length
    if count < 8 or np.ptp(u) < 0.02:
        return []
    shape = z[:count * length].reshape(count, length)
    power = np.abs(np.fft.rfft(shape * np.hanning(length), 2 * length, axis=1)) ** 2
    # Normalise each bin, which suppresses lines at a fixed frequency.
    power = (power / power.mean(axis=0)).astype(np.float32)
    load = u[:count * length].reshape(count, length).mean(axis=1)
    width = rate / (2.0 * length)
    bins = power.shape[1] - 1
    best: list[_Line] = []
    # Beyond the Nyquist frequency a line is folded back.
    fold = np.abs((np.arange(3 * bins) + bins) % (2 * bins) - bins)
    folded = np.ascontiguousarray(power[:, fold])
    total = np.empty(bins, dtype=np.float32)
    reach = _REACH * rate
    for slope in np.arange(-reach, reach, 2.0 * width / np.ptp(load)):
        shift = np.rint(slope * load / width).astype(np.int64)
        total[:] = 0.0
        for row, first in zip(folded, (shift % (2 * bins)).tolist(), strict=True):
            total += row[first:first + bins]
        k = int(np.argmax(total))
        # Cramer bound of the tail of a mean of `count` exponentials.
        mean = float(total[k]) / count
        rise = count * (mean - 1.0 - math.log(max(mean, 1e-9)))
        best.append(_Line(rise if mean > 1.0 else 0.0, k * width, float(slope), length))
    best.sort(key=lambda line: -line.rise)
    return best


def _unwound(z: FloatArray, u: FloatArray, rate: float) -> list[_Line]:
    """Return the strongest lines in segments of 1 s, in which their phase follows throttle."""
    length = round(_UNWOUND * rate)
    count = z.size // max(length, 1)
    if length < 8 or count < 8 or np.ptp(u) < 0.02:
        return []
    moves = np.cumsum(u - u.mean())[:count * length].reshape(count, length) / rate
    # From one slope to the next, the phase changes by half a cycle within a segment in which
    # throttle moves much (90 % quantile).
    step = 0.5 / max(float(np.percentile(np.ptp(moves, axis=1), 90.0)), 1e-6)
    # A line with a negative slope is found as its mirror image at negative frequencies.
    slopes = np.arange(0.0, _REACH * rate, step)
    if slopes.size * z.size > _DEAREST:
        return []
    back = np.exp(-2j * math.pi * step * moves)
    wave = z[:count * length].reshape(count, length).astype(np.complex128)
    found = []
    for slope in slopes.tolist():
        power = (np.abs(np.fft.fft(wave, 2 * length, axis=1)) ** 2).mean(axis=0) / length
        k = int(np.argmax(power))
        mean = float(power[k])
        rise = count * (mean - 1.0 - math.log(mean)) if mean > 1.0 else 0.0
        centre = float(np.fft.fftfreq(2 * length, 1.0 / rate)[k])
        slope = math.copysign(slope, centre)
        found.append(_Line(rise, abs(centre) - slope * float(u.mean()), slope, length))
        wave *= back
    found.sort(key=lambda line: -line.rise)
    return found[:_MOST]


# Length of the segments of `_unwound`, s; maximum slopes x samples: 1 s of processor time.
_UNWOUND, _DEAREST = 1.0, 3e7


def _refined(z: FloatArray, u: FloatArray, rate: float, idle: float, slope: float, width: float
             ) -> tuple[float, float]:
    """Refine idle and slope: maximise the power in segments that grow to the whole recording."""
    turns = np.cumsum(u - u.mean()) / rate
    idle += slope * float(u.mean())
    at = np.arange(z.size) / rate
    length = max(64, int(rate / width))
    while True:
        pieces = max(1, z.size // length)
        size = z.size // pieces
        reach = 1.5 / (length / rate)
        spread = max(float(np.ptp(turns[:size])), 1e-3)
        slopes = slope + np.linspace(-1.0, 1.0, 9) * min(1.0 / spread, 4.0 * width / 0.02)
        idles = idle + np.linspace(-1.0, 1.0, 9) * reach
        top = -1.0
        waves = np.exp(-2j * math.pi * idles[:, None] * at)
        for s in slopes:
            warped = z * np.exp(-2j * math.pi * s * turns)
            for f, turning in zip(idles, waves, strict=True):
                wave = (warped * turning)[:pieces * size]
                value = float((np.abs(wave.reshape(pieces, size).sum(axis=1)) ** 2).sum()) / size
                if value > top:
                    top, idle_best, slope_best = value, float(f), float(s)
        idle, slope = idle_best, slope_best
        if pieces == 1:
            return idle - slope * float(u.mean()), slope
        length *= 4
