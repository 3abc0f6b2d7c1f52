"""
First passage of the OU to a level: the mean time.

A continuous OU path has no finite crossing rate, so risk is told by first
passage (Siegert, Phys. Rev. 81 (1951) 617).  Levels are in units of the
stationary standard deviation, counted towards the barrier; times are in units
of tau = 1/alpha.
"""

from __future__ import annotations

import math

from scipy.integrate import quad
from scipy.special import erfcx

# Beyond this level the mean time exceeds 1e150 tau: never.
_NEVER = 26.0


def mean_first_passage(start: float, barrier: float) -> float:
    """
    Return the mean time of a unit OU from `start` up to `barrier`.

    sqrt(pi/2) * integral from start to barrier of erfcx(-z / sqrt 2) dz.
    """
    if start >= barrier:
        return 0.0
    if barrier > _NEVER:
        return math.inf
    total, _ = quad(lambda z: float(erfcx(-z / math.sqrt(2.0))), start, barrier,
                    epsabs=0.0, epsrel=1e-10, limit=200)
    return math.sqrt(math.pi / 2.0) * float(total)
