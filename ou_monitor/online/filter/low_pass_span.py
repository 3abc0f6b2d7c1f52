r"""
Four low-passes of fixed cutoffs and the input itself: their steps, their noise, their response.

Every linear combination of them is a filter.  The low-passes are those of `filter_state`, so
that a step is z' = F z + a start + b end, exact for an input that is linear between samples; for a
derivative the input is the difference quotient.

What noise with r(k) = phi^k makes of all outputs is a covariance: with the noise p' = phi p + e
as a state beside z it solves P = A P A^T + q g g^T, which is summed by doubling, A -> A A.

Limits: intervals within 1 % of each other count as one.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from ou_monitor.online.filter.filter_state import LowPassState
from ou_monitor.records import FloatArray

Complexes = npt.NDArray[np.complex128]
# Hz: what vehicles do lies within; two octaves apart (benchmarks/learned.py says on which
# recordings that was chosen).
CUTOFFS = (2.0, 8.0, 32.0, 128.0)
COUNT = len(CUTOFFS) + 1
_TWO_PI = 2.0 * math.pi
_ORDER, _SAME = 2, 0.01
# Steps of different length that are kept.
_STEPS = 64
# Below this nothing of a state is left.
_GONE = 1e-18


class LowPassSpan:
    """
    The low-passes, and the input as the last of `COUNT` outputs.

    Parameters
    ----------
    slope : bool
        Whether the derivative comes out: the input is the difference quotient.

    """

    def __init__(self, slope: bool) -> None:
        self.slope = slope
        self._steps: dict[int, FloatArray] = {}
        self._noise: dict[tuple[int, float], FloatArray] = {}
        self._at: tuple[int, float] | None = None
        self._response: Complexes = np.zeros(COUNT, dtype=np.complex128)

    def step(self, dt: float) -> FloatArray:
        """Return what makes the next states of (states, start, end), shape (8, 10)."""
        key = round(math.log(dt) / _SAME)
        found = self._steps.get(key)
        if found is None:
            if len(self._steps) >= _STEPS:
                self._steps.clear()
            found = self._steps[key] = _step_matrix(math.exp(_SAME * key))
        return found

    def noise(self, interval: float, decay: float) -> FloatArray:
        """
        Return the covariance of the outputs for noise of variance 1, shape (5, 5).

        interval in s; decay in 1/s: of the noise's correlation, infinite for white noise.
        """
        key = (round(math.log(interval) / _SAME), decay if math.isinf(decay) else
               round(math.log(decay) / _SAME))
        found = self._noise.get(key)
        if found is None:
            if len(self._noise) >= _STEPS:
                self._noise.clear()
            found = self._noise[key] = self._covariance(math.exp(_SAME * key[0]), decay)
        return found

    def response(self, interval: float, frequency: float) -> Complexes:
        """Return what each output makes of a wave, shape (5,) (interval in s, Hz)."""
        key = (round(math.log(interval) / _SAME), frequency)
        if key != self._at:
            self._at, self._response = key, self._respond(interval, frequency)
        return self._response

    def _respond(self, interval: float, frequency: float) -> Complexes:
        step = self.step(interval)
        back = np.exp(-1j * _TWO_PI * frequency * interval)
        raw = (1.0 - back) / interval if self.slope else 1.0 + 0.0j
        start = raw if self.slope else back
        states = np.linalg.solve(np.eye(step.shape[0]) - step[:, :-2] * back,
                                 step[:, -2] * start + step[:, -1] * raw)
        return np.append(states[::2], raw)

    def _covariance(self, interval: float, decay: float) -> FloatArray:
        step = self.step(interval)
        size = step.shape[0]
        phi = math.exp(-decay * interval)
        first, second = step[:, -2], step[:, -1]
        # State: noise, low-passes, input; what they make of the noise before, and of its news.
        a, g = np.zeros((size + 2, size + 2)), np.ones(size + 2)
        a[0, 0] = a[-1, 0] = phi
        a[1:-1, 1:-1] = step[:, :-2]
        if self.slope:
            both = (first + second) / interval
            a[1:-1, 0], g[1:-1] = both * (phi - 1.0), both
            a[-1, 0], g[-1] = (phi - 1.0) / interval, 1.0 / interval
        else:
            a[1:-1, 0], g[1:-1] = first + second * phi, second
        p = np.outer(g, g) * -math.expm1(-2.0 * decay * interval)
        while np.max(np.abs(a)) > _GONE:
            p += a @ p @ a.T
            a = a @ a
        outputs = [*range(1, size, 2), size + 1]
        return np.asarray(p[np.ix_(outputs, outputs)])


def _step_matrix(dt: float) -> FloatArray:
    """Return F, a and b of all low-passes, side by side."""
    size = 2 * len(CUTOFFS)
    found = np.zeros((size, size + 2))
    for k, cutoff in enumerate(CUTOFFS):
        at = 2 * k
        columns = [(at, 1.0, 0.0, 0.0, 0.0), (at + 1, 0.0, 1.0, 0.0, 0.0),
                   (size, 0.0, 0.0, 1.0, 0.0), (size + 1, 0.0, 0.0, 0.0, 1.0)]
        for column, y, slope, start, end in columns:
            one = LowPassState(y)
            one.slope = slope
            one.advance(_ORDER, _TWO_PI * cutoff * dt, start, end)
            found[at:at + 2, column] = one.y, one.slope
    return found
