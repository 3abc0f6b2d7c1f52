"""
Segments of simulated samples.

Segments pass through the terms of a model in the order of their `Stage`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
import enum

import numpy as np
from ou_monitor.records import FloatArray


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
