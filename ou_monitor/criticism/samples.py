"""The samples that a discovery works on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from ou_monitor.model.terms.term import Stretch, Term
from ou_monitor.records import FloatArray

# Share of the samples that models are fitted on; the rest is kept to score them.
TRAIN = 0.6
# Samples kept count up to this far outside of the throttle that the part fitted has
# been through: a share of its range, and what is no change of throttle at all.
_BEYOND, _STILL = 0.05, 0.01
# Steps that differ by less than this share count as alike.
ALIKE = 0.3


@dataclass(frozen=True, eq=False)
class Samples:
    """
    Clean samples in order.

    Attributes
    ----------
    t, voltage : ndarray, shape (n,)
        Stamps, s, rising, and V.
    throttle : ndarray, shape (n,), or None
        0..1; None when it says nothing (unknown, or constant).

    """

    t: FloatArray
    voltage: FloatArray
    throttle: FloatArray | None

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

    @cached_property
    def seen(self) -> npt.NDArray[np.bool_]:
        """Return which samples of the part for scoring have throttle that the other part knows."""
        kept = np.zeros(self.n, dtype=np.bool_)
        kept[self.test] = True
        if self.throttle is None:
            return kept
        known = self.throttle[self.train]
        low, high = float(known.min()), float(known.max())
        margin = max(_BEYOND * (high - low), _STILL)
        return kept & (self.throttle >= low - margin) & (self.throttle <= high + margin)

    @cached_property
    def work(self) -> list[float]:
        """Return what filters over these samples and parts of them have cost, s, about."""
        return [0.0]

    def part(self, part: slice, voltage: FloatArray | None = None) -> Samples:
        """Return a part, or all with another voltage; its cost counts here."""
        v = self.voltage if voltage is None else voltage
        made = Samples(self.t[part], v[part],
                       None if self.throttle is None else self.throttle[part])
        made.__dict__['work'] = self.work
        return made

    @cached_property
    def columns(self) -> dict[Term, FloatArray]:
        """Return columns of the mean that were made before, by term with coefficients 1."""
        return {}

    @cached_property
    def step(self) -> FloatArray:
        """Return the time before each sample, s; infinite before the first."""
        step = np.diff(self.t, prepend=-np.inf)
        usual = float(np.median(step[1:]))
        # A step a little off moves a prediction by much less than its error, and an
        # even spacing saves most of the time.
        near = np.abs(step - usual) < ALIKE * usual
        step[near] = usual
        return step

    @cached_property
    def even(self) -> bool:
        """Return whether all steps are alike."""
        step = self.step[1:]
        return bool((step == step[0]).all()) if step.size else True

    def stretch(self, alpha: float, sigma: float) -> Stretch:
        """Return the samples as terms take them, with nothing on them yet."""
        n = self.n
        return Stretch(
            t=self.t, at=self.t, step=self.step,
            throttle=np.full(n, np.nan) if self.throttle is None else self.throttle,
            origin=float(self.t[0]), alpha=np.full(n, alpha), sigma=np.full(n, sigma),
            power=np.ones(n), push=np.zeros(n), bend=(0.0, 0.0), x=np.zeros(n),
            level=np.zeros(n), voltage=np.zeros(n))
