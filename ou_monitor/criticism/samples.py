"""
The samples that `discover` fits, and their choice in a long recording.

If a recording has too many samples, every k-th is used: unlike averages, these are again samples
of an OU, and all terms keep their meaning.  If this would lose the relaxation, a segment from the
middle is used instead.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.criticism.innovations import steps_before
from ou_monitor.model.terms.term import Segment, Term
from ou_monitor.records import FloatArray

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

    @property
    def n(self) -> int:
        """Return the number of samples."""
        return int(self.t.size)

    @property
    def train(self) -> slice:
        """Return the part for fitting."""
        return slice(0, round(TRAIN * self.n))

    @property
    def test(self) -> slice:
        """Return the part for scoring."""
        return slice(round(TRAIN * self.n), self.n)

    def part(self, part: slice, voltage: FloatArray | None = None) -> Samples:
        """Return a part of the samples, with another voltage if one is given."""
        return replace(
            self, t=self.t[part], voltage=(self.voltage if voltage is None else voltage)[part],
            throttle=None if self.throttle is None else self.throttle[part],
            longer=self.longer or self if slice(None, part.stop) == part else None,
            codes=None if self.codes is None else self.codes[part])

    def columns(self, term: Term) -> FloatArray:
        """Return the columns of a term of the mean, cached; shorter parts share them."""
        source = self.longer or self
        # The columns do not depend on the coefficients of the term.
        unit = term.with_linear([1.0] * len(term.LINEAR))
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
