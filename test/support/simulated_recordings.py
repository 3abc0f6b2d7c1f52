"""Recordings with known truth, for the tests of the bench."""

from dataclasses import replace

import numpy as np
from ou_monitor.analysis.level_result import fit_level, fit_parts, LevelResult
from ou_monitor.analysis.level_tests import holm
from ou_monitor.analysis.levels import LoadLevel
from ou_monitor.analysis.noise import Remainder
from ou_monitor.model.ou import simulate
from ou_monitor.records import Estimate, NAN, Recording

ALPHA = 63.0


def recording(seed: int, levels=((0.1, 0.3156), (0.4, 0.632)), seconds: float = 10.0,
              rate: float = 1000.0, sag: float = -0.5, name: str = 'made') -> Recording:
    """Return an OU of rate ALPHA that holds each (throttle, sigma) for some seconds."""
    t = np.arange(int(round(seconds * rate)) * len(levels)) / rate
    which = np.minimum((t / seconds + 1e-9).astype(int), len(levels) - 1)
    throttle = np.array([level for level, _ in levels])[which]
    sigma = np.array([value for _, value in levels])[which]
    voltage = simulate(t, ALPHA, sigma, np.random.default_rng(seed), u0=5.0 + sag * throttle)
    return Recording(t, voltage, throttle, name)


def without_throttle(simulated: Recording) -> Recording:
    """Return the same recording with its throttle unknown."""
    return Recording(simulated.t, simulated.voltage, np.full(simulated.n, np.nan), simulated.name)


def bare(simulated: Recording) -> Remainder:
    """Return the deviation of a recording from its mean, without subtracting level or load."""
    return Remainder(simulated.voltage - simulated.voltage.mean(), np.ones(simulated.n),
                     float(np.median(np.diff(simulated.t))), 1e-3)


def as_one_level(simulated: Recording) -> LevelResult:
    """Return the result of `analyze` for a recording as one load level, ten times as fast."""
    whole = LoadLevel(NAN, (slice(0, simulated.n),))
    level = fit_level(simulated, bare(simulated), whole, 1)
    return replace(level, shape=holm([level.shape])[0])


def fitted(simulated: Recording, start: int, stop: int) -> Estimate:
    """Return the estimate of a level of these samples."""
    return fit_parts(simulated, bare(simulated), [slice(start, stop)])[1]
