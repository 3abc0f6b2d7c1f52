r"""
The notches themselves: state-variable filters whose coefficients may move.

One notch, with w = 2 pi f and k = bandwidth / f:

    s1' = w (x - s2 - k s1),  s2' = w s1,  y = x - m k s1

by the trapezoidal rule with g = tan(pi f dt), so that the zero lies on f exactly
(Zavalishin, The Art of VA Filter Design, 2012, ch. 4; Simper 2013):

    v1 = (g (x - s2) + s1) / (1 + g (g + k)),  v2 = s2 + g v1,  s <- 2 v - s.

**Stable under any sequence of f, k and m.**  With A = [[-k, -1], [1, 0]] and
P = [[1, e], [e, 1]],

    -(A^T P + P A) = [[2 k - 2 e, k e], [k e, 2 e]]

is positive definite for each k with 4 k > e (4 + k^2): one e < 4 K / (4 + K^2), K = least k,
serves all k in K..2, so that s^T P s is a Lyapunov function of all of them.  The rule has
s+ - s = 2 g (A v + b x) and s+ + s = 2 v, so that

    V(s+) - V(s) = 2 g (v^T (A^T P + P A) v + 2 x b^T P v),

which is below 0 wherever |v| > 2 |P b| X / q (q: least eigenvalue of the form above, X: bound
of the input); and |v| >= (|s| - g X) / |I - g A|, so that a large state has a large v while
g is bounded, as it is by `HIGHEST`.  `bound` puts it in numbers (it is loose: what is
seen under adversarial sequences is a tenth).  m stays within 0..1 and is outside the loop.

Limits: a step of the coefficients moves y by what v1 changes within the sample; the caller
moves them smoothly.
"""

from __future__ import annotations

import cmath
from collections.abc import Iterable
import math

import numpy as np

# Frequencies in shares of the sample rate; bandwidths in shares of the frequency.
HIGHEST = 0.45
NARROWEST, WIDEST = 0.08, 2.0


class Notch:
    """
    One notch of one channel; it begins as if its first sample x had always been there.

    `width`: bandwidth over frequency; `share`: how much of it is in force, 0..1.
    """

    __slots__ = ('_g', '_ratio', '_s1', '_s2', 'share', 'width')

    def __init__(self, x: float) -> None:
        self._s1, self._s2 = 0.0, x
        self._ratio = self._g = 0.0
        self.width, self.share = 1.0, 0.0

    @property
    def ratio(self) -> float:
        """Frequency over sample rate, 0..`HIGHEST`."""
        return self._ratio

    @ratio.setter
    def ratio(self, ratio: float) -> None:
        if ratio != self._ratio:
            self._ratio = min(max(ratio, 0.0), HIGHEST)
            self._g = math.tan(math.pi * self._ratio)

    def restart(self, x: float) -> None:
        """Forget what was: as if this sample had always been there."""
        self._s1, self._s2 = 0.0, x

    def advance(self, x: float) -> float:
        """Filter one sample."""
        g, k = self._g, self.width
        v1 = (g * (x - self._s2) + self._s1) / (1.0 + g * (g + k))
        v2 = self._s2 + g * v1
        self._s1 = 2.0 * v1 - self._s1
        self._s2 = 2.0 * v2 - self._s2
        return x - self.share * k * v1

    def response(self, ratio: float) -> complex:
        """Return the response to a frequency over the sample rate, coefficients standing."""
        if not self._g:
            return 1.0 + 0.0j
        p = 1j * math.tan(math.pi * ratio) / self._g
        k = self.width
        return 1.0 - self.share * k * p / (p * p + k * p + 1.0)


def phase_lag(notches: Iterable[Notch], ratio: float) -> float:
    """Return by how much a cascade lags at a frequency over the sample rate, rad."""
    return -sum(cmath.phase(one.response(ratio)) for one in notches)


def bound(narrowest: float = NARROWEST, highest: float = HIGHEST) -> float:
    """
    Return how much larger than the input one notch can ever come out, whatever its sequence.

    narrowest: least bandwidth over frequency; highest: most frequency over sample rate.
    """
    g = math.tan(math.pi * highest)
    e = 2.0 * narrowest / (4.0 + narrowest * narrowest)
    p = np.array([[1.0, e], [e, 1.0]])
    q, turned = math.inf, float(np.hypot(1.0, e))
    worst = 0.0
    for k in np.linspace(narrowest, WIDEST, 400):
        a = np.array([[-k, -1.0], [1.0, 0.0]])
        q = min(q, float(np.linalg.eigvalsh(-(a.T @ p + p @ a))[0]))
        worst = max(worst, float(np.linalg.norm(np.eye(2) - g * a, 2)))
    # Largest v that does not lose energy, the state that goes with it, and one step beyond.
    v = 2.0 * turned / q
    state = worst * v + g
    energy = (1.0 + e) * state * state + 2.0 * g * turned * turned / q
    most = math.sqrt(energy / (1.0 - e))
    # v1 is half of s1 before and after; y = x - m k v1.
    return 1.0 + WIDEST * most
