"""
The samples that `discover` fits, and their choice in a long recording.

If a recording has too many samples, every k-th is used: unlike averages, these are again samples
of an OU, and all terms keep their meaning.  If this would lose the relaxation, a segment from the
middle is used instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.innovations import steps_before
from ou_monitor.model.sinusoid import fit_sinusoid, Sinusoid
from ou_monitor.model.spectral_lines import find_lines
from ou_monitor.model.terms.term import Segment, Term
from ou_monitor.model.terms.tones import Tone
from ou_monitor.records import FloatArray
from scipy.special import ndtri

# Share of the samples for fitting; the rest is held out to score models.
TRAIN = 0.6
# Maximum samples of a fit.
MOST = 80_000
# Maximum step, in relaxation times, at which alpha stays identifiable.
_STEP = 0.3
# (gamma(2L) - gamma(L)) / (gamma(4L) - gamma(2L)) of an OU's variogram gamma at that step L:
# exp(x) / (1 + exp(-x)), x = _STEP.  White noise cancels.
_RATIO = math.exp(_STEP) / (1.0 + math.exp(-_STEP))
# Maximum number of values used for that ratio.
_EXAMINED = 1_000_000
# Samples that share a noise scale; probability that noise alone makes any change an event; margin
# for the error of the scale.
_SHARE, _CHANCE, _MORE = 1024, 0.02, 1.05
# Minimum change of throttle that counts as a load step, and the time after it in which a change of
# voltage is attributed to the load, s.
_STEPS, _SOON = 0.01, 0.02
# Maximum number of events around which more samples are kept; of more events, the samples used
# contain enough.
_FEW = 300
# Changes are limited to this many standard deviations in the search for lines (larger ones are
# events); minimum share of a line's power that one sinusoid explains.
_EVENT, _COMMON = 5.0, 0.5
# Maximum distance of stamps from an even grid, in steps; number of stamps checked at a time.
_EVEN, _CHUNK = 0.1, 500_000


@dataclass(frozen=True, eq=False)
class Samples:
    """Clean samples in order."""

    t: FloatArray  # Increasing, s; shape (n,)
    voltage: FloatArray  # V; shape (n,)
    throttle: FloatArray | None  # 0..1; None if unknown or constant; shape (n,)
    longer: Samples | None = None  # Longer series that begins with these samples
    # ADC codes as logged, V, if `voltage` is spread evenly within their cells; shape (n,).
    codes: FloatArray | None = None
    cell: float = 0.0  # Width of a cell, V; 0 without spreading
    by_current: bool = False  # Whether `throttle` is a current as a share of the largest
    # Caches: columns by term; the last design (voltage, level, columns) by terms.
    _known: dict[Term, FloatArray] = field(default_factory=dict, init=False)
    designs: dict[tuple[Term, ...], FloatArray] = field(default_factory=dict, init=False)
    # Factors on alpha, sigma and the white noise by the terms of `Role.DRIVE` that cause them.
    factors: dict[tuple[Term, ...], tuple[FloatArray, FloatArray, FloatArray]] = field(
        default_factory=dict, init=False)

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return int(self.t.size)

    @property
    def train(self) -> slice:
        """Return the part for fitting."""
        return slice(0, round(TRAIN * self.n))

    def part(self, part: slice, voltage: FloatArray | None = None) -> Samples:
        """Return a part of the samples, with another voltage if one is given."""
        return replace(
            self, t=self.t[part], voltage=(self.voltage if voltage is None else voltage)[part],
            throttle=None if self.throttle is None else self.throttle[part],
            longer=self.longer or self if slice(None, part.stop) == part else None,
            codes=None if self.codes is None else self.codes[part])

    def columns(self, term: Term) -> FloatArray:
        """Return the columns of a term of the mean, cached; shorter parts share them."""
        source, unit = self.longer or self, unit_of(term)
        if unit not in source._known:
            source._known[unit] = unit.columns(source.segment(1.0, 0.0))
        return source._known[unit][:self.n]

    @property
    def logged(self) -> FloatArray:
        """Return the voltage as logged, V."""
        return self.voltage if self.codes is None else self.codes

    @property
    def blur(self) -> float:
        """Return the variance that spreading adds to a sample, V^2."""
        return self.cell * self.cell / 12.0

    def spread(self, codes: FloatArray, cell: float, rng: np.random.Generator) -> Samples:
        """Return samples with codes, V, spread evenly within cells, V (width 0: unchanged)."""
        # The mean log density of a value spread within a cell is at most the log of the code's
        # probability over the width (Jensen; Theis et al., ICLR 2016).  So, where codes repeat, a
        # narrow distribution cannot gain without limit, as it does with the density at the code.
        if not cell > 0.0:
            return replace(self, voltage=codes)
        drawn = codes + cell * (rng.random(self.n) - 0.5)
        return replace(self, voltage=drawn, longer=self.longer or self, codes=codes, cell=cell)

    def redrawn(self, at: npt.NDArray[np.int64], voltage: FloatArray) -> Samples:
        """Return the samples with the voltage, V, replaced at some indices."""
        v, codes = self.voltage.copy(), self.codes
        v[at] = voltage
        if codes is not None:
            codes = codes.copy()
            codes[at] += self.cell * np.rint((voltage - codes[at]) / self.cell)
        return replace(self, voltage=v, longer=self.longer or self, codes=codes)

    @cached_property
    def step(self) -> FloatArray:
        """Return the time before each sample, s; infinite before the first."""
        return steps_before(self.t)

    @cached_property
    def even(self) -> bool:
        """Return whether all steps are equal."""
        step = self.step[1:]
        return bool((step == step[0]).all()) if step.size else True

    def segment(self, alpha: float, sigma: float) -> Segment:
        """Return an initial segment for terms to change."""
        n = self.n
        return Segment(
            t=self.t, at=self.t, step=self.step,
            throttle=np.full(n, np.nan) if self.throttle is None else self.throttle,
            origin=float(self.t[0]), alpha=np.full(n, alpha), sigma=np.full(n, sigma),
            power=np.ones(n), push=np.zeros(n), bend=(0.0, 0.0), x=np.zeros(n),
            level=np.zeros(n), noise=np.ones(n), voltage=np.zeros(n))


@lru_cache(maxsize=1000)
def unit_of(term: Term) -> Term:
    """Return a term of the mean with coefficients of 1, on which its columns do not depend."""
    return term.with_linear([1.0] * len(term.LINEAR))


def choose_samples(voltage: FloatArray, rate: float) -> tuple[slice, str]:
    """Return which samples to use (voltage in V, rate in Hz)."""
    n = voltage.size
    if n <= MOST:
        return slice(0, n), ''
    factor = math.ceil(n / MOST)
    widest = _widest_step(voltage, factor)
    if widest >= factor:
        return slice(0, n, factor), (
            f'{n} samples: one in {factor} was used ({rate / factor:.4g} Hz); lines above '
            f'{0.5 * rate / factor:.4g} Hz are aliased.')
    size = MOST * widest
    first = (n - size) // 2
    what = f'one in {widest} was used' if widest > 1 else 'all were used'
    return slice(first, first + size, widest), (
        f'{n} samples: of the {size / rate:.4g} s in the middle, {what} ({rate / widest:.4g} Hz), '
        'because the rail relaxes too fast for a lower rate; effects slower than that segment '
        'are not detected.')


def events_between(voltage: FloatArray, throttle: FloatArray | None, rate: float, which: slice
                   ) -> npt.NDArray[np.int64]:
    """Return further samples to keep: around sudden changes (voltage in V, rate in Hz)."""
    # A jump that is clear between neighbours may be lost in the noise of k steps.
    first, stop, k = which.start, min(which.stop, voltage.size), which.step or 1
    none = np.zeros(0, dtype=np.int64)
    change = np.diff(voltage[first:stop])
    blocks = change.size // _SHARE
    if k == 1 or blocks < 1:
        return none
    size = np.abs(change[:blocks * _SHARE]).reshape(blocks, _SHARE)
    scale = np.median(size, axis=1) / 0.6745
    if not (scale > 0.0).all():
        # Coarse codes: most changes are 0.
        return none
    limit = -_MORE * float(ndtri(0.5 * _CHANCE / change.size))
    row, column = np.nonzero(size > limit * scale[:, None])
    at = first + row * _SHARE + column
    if throttle is not None:
        stepped = np.flatnonzero(np.abs(np.diff(throttle[first:stop])) > _STEPS) + first
        last = np.searchsorted(stepped, at, side='right') - 1
        since = np.where(last < 0, np.inf, at - stepped[last] if stepped.size else 0)
        at = at[since > _SOON * rate]
    if not 0 < at.size <= _FEW:
        return none
    # The samples before and after the change, and the next, which tells a bad sample from a jump.
    near: npt.NDArray[np.int64] = np.unique(np.concatenate((at, at + 1, at + 2)))
    kept: npt.NDArray[np.int64] = near[(near < stop) & ((near - first) % k != 0)]
    return kept


def lines_between(t: FloatArray, voltage: FloatArray, which: slice) -> list[Tone]:
    """Find steady lines in all samples above the Nyquist frequency of the samples used."""
    # In the samples used, such lines would be aliased, and mostly hidden by noise.
    k = which.step or 1
    part = slice(which.start, min(which.stop, voltage.size))
    t, v = t[part], voltage[part]
    n = v.size
    dt = float(t[-1] - t[0]) / max(n - 1, 1)
    if k == 1 or not all(_even(t[a:a + _CHUNK], t[0] + a * dt, dt)
                         for a in range(0, n, _CHUNK)):
        return []
    e, keep = _whitened(v)
    found = []
    for line in find_lines([e], 1.0 / dt, lowest=0.5 / (k * dt)).lines:
        wave = fit_sinusoid(e, 1.0 / dt, line.frequency, line.resolution)
        if 0.5 * wave.amplitude ** 2 > _COMMON * line.rms ** 2:
            turn = 2.0 * math.pi * wave.frequency * dt
            # The first error belongs to the second sample.
            gain = 1.0 - keep * np.exp(-1j * turn)
            found.append(Tone(wave.amplitude / abs(gain), wave.frequency,
                              wave.phase - turn - float(np.angle(gain)), 0.0))
    return found


def without_tones(t: FloatArray, voltage: FloatArray, origin: float, lines: Sequence[Tone]
                  ) -> FloatArray:
    """Return a voltage less steady lines (origin in s, result in V)."""
    for line in lines:
        wave = Sinusoid(line.amplitude, line.frequency, line.phase)
        voltage = voltage - wave.sampled(t - origin)
    return voltage


def _even(t: FloatArray, first: float, dt: float) -> bool:
    """Return whether stamps lie on an even grid."""
    return float(np.abs(t - first - dt * np.arange(t.size)).max()) < _EVEN * dt


def _whitened(v: FloatArray) -> tuple[FloatArray, float]:
    """Return the errors of an AR(1) prediction, limited at events, and its coefficient."""
    c = v - v.mean()
    keep = float(c[1:] @ c[:-1]) / max(float(c @ c), 1e-300)
    e: FloatArray = c[1:] - keep * c[:-1]
    del c
    limit = _EVENT * float(np.median(np.abs(e[::max(e.size // _CHUNK, 1)]))) / 0.6745
    return (np.clip(e, -limit, limit, out=e) if limit > 0.0 else e), keep


def _widest_step(voltage: FloatArray, factor: int) -> int:
    """Return the largest step in samples, up to `factor`, that resolves the relaxation."""
    first = max(0, (voltage.size - _EXAMINED) // 2)
    v = voltage[first:first + _EXAMINED]
    lag, risen = 1, False
    coarse = bool(np.mean(v[4:] == v[:-4]) > 0.1)
    while lag < factor and 16 * lag < v.size:
        near, mid, far = (_variogram(v, k * lag, coarse) for k in (1, 2, 4))
        # Squares within 4 lags are correlated.
        error = 3.0 * far * math.sqrt(8.0 * lag / v.size)
        if far - mid > error:
            risen = True
            if (mid - near) / (far - mid) > _RATIO:
                return lag
        elif risen:
            # The variogram has flattened, so the relaxation is faster.
            return max(1, lag // 2)
        lag *= 2
    return factor


def _variogram(v: FloatArray, lag: int, coarse: bool) -> float:
    """Return the variogram at a lag, V^2, up to a factor."""
    # Computed from the smaller half of the differences; load steps, which would hide how fast the
    # rail itself relaxes, are in the larger half.  Coarse codes need all differences.
    d = np.square(v[lag:] - v[:-lag])
    if coarse:
        return 0.5 * float(d.mean())
    half = d.size // 2 + 1
    return 0.5 * float(np.partition(d, half - 1)[:half].mean())
