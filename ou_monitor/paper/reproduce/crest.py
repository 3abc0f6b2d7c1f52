"""
Vpp over Vrms of one Ornstein-Uhlenbeck process on a screen.

Paths are drawn with the exact transition over a hundred of the paper's samples; the extremes in
between follow the law of the Brownian bridge, which differs from the process by a share
alpha dt = 0.006 over such a step.  The crest factor does not depend on sigma.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.ou import transition
from ou_monitor.paper.reproduce import published
from ou_monitor.paper.reproduce.row import Printed, Range, Row
from ou_monitor.paper.reproduce.table1 import over, vpp_range, vrms_range
from ou_monitor.records import FloatArray
from scipy.signal import lfilter

# The paper does not say how long its screens are, ms.
SCREENS_MS = (10, 100, 500)
TYPICAL_MS = 100
# Share of screens left out at either end.
TAIL = 0.05
# Samples of the oscilloscope to a step of the simulation; segments held in
# memory; screens of white noise.
_SAMPLES, _AT_ONCE, _WHITE = 100, 100, 200


@dataclass(frozen=True, eq=False)
class Crests:
    """Crest factors of simulated screens."""

    # Vpp/Vrms of every screen, by its length in ms; rows are independent; shape (paths, k).
    by_screen: dict[int, FloatArray]
    white: FloatArray  # Of white Gaussian noise, on a screen of 100 ms; shape (k,)

    def mean(self, screen: int) -> tuple[float, float]:
        """Return mean and standard error on screens of that many ms."""
        return mean_and_error(self.by_screen[screen].mean(axis=1))

    def quantile(self, screen: int, share: float) -> float:
        """Return a quantile over screens of that many ms."""
        return float(np.quantile(self.by_screen[screen], share))

    @property
    def band(self) -> Range:
        """5 % quantile of the shortest to 95 % quantile of the longest screens."""
        return (self.quantile(min(self.by_screen), TAIL),
                self.quantile(max(self.by_screen), 1.0 - TAIL))


def mean_and_error(values: FloatArray) -> tuple[float, float]:
    """Return the mean of independent values and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / math.sqrt(values.size))


def crest_of(screens: FloatArray) -> FloatArray:
    """Return Vpp over the rms about the mean of each row."""
    return np.asarray(np.ptp(screens, axis=-1) / screens.std(axis=-1))


def simulate_crests(rng: np.random.Generator, paths: int,
                    progress: Callable[[float], None] = lambda share: None) -> Crests:
    """Draw screens of an OU with the paper's alpha, sampled at 1 MHz (progress 0..1)."""
    found: dict[int, list[FloatArray]] = {ms: [] for ms in SCREENS_MS}
    for begin in range(0, paths, _AT_ONCE):
        for ms, values in _draw(rng, min(_AT_ONCE, paths - begin)).items():
            found[ms].append(values)
        progress(min(1.0, (begin + _AT_ONCE) / paths))
    points = round(1e-3 * TYPICAL_MS * published.SAMPLING_HZ)
    white = [float(crest_of(rng.standard_normal(points))) for _ in range(_WHITE)]
    return Crests({ms: np.concatenate(rows) for ms, rows in found.items()}, np.array(white))


def _draw(rng: np.random.Generator, paths: int) -> dict[int, FloatArray]:
    """Return the crest factors of all screens of `paths` simulated segments."""
    dt = _SAMPLES / published.SAMPLING_HZ
    # Of stationary variance 1.
    sigma = math.sqrt(2.0 * published.ALPHA.value)
    phi, q = (float(v) for v in transition(published.ALPHA.value, sigma, dt))
    noise = rng.standard_normal((paths, 1 + round(1e-3 * max(SCREENS_MS) / dt)))
    noise[:, 1:] *= math.sqrt(q)
    path = lfilter([1.0], [1.0, -phi], noise, axis=1)
    left, right = path[:, :-1], path[:, 1:]
    # Largest and smallest value of a bridge from a to b of variance s^2 dt:
    # (a + b +- sqrt((b - a)^2 - 2 s^2 dt ln U)) / 2, U uniform.
    middle, square = left + right, (right - left) ** 2
    top, bottom = (middle + sign * np.sqrt(
        square + 2.0 * q * rng.standard_exponential(square.shape)) for sign in (1.0, -1.0))
    # Sampling at 1 MHz gives a little less (Broadie, Glasserman & Kou, Math.
    # Finance 7 (1997) 325): 0.5826 sigma sqrt(1 us) on each side.
    unseen = 2.0 * 0.5826 * sigma / math.sqrt(published.SAMPLING_HZ)
    found = {}
    for ms in SCREENS_MS:
        shape = (paths, -1, round(1e-3 * ms / dt))
        vpp = 0.5 * (top.reshape(shape).max(axis=2) - bottom.reshape(shape).min(axis=2)) - unseen
        found[ms] = vpp / left.reshape(shape).std(axis=2)
    return found


def crest(state: published.PrintedLoad) -> tuple[float, Range]:
    """Return Vpp/Vrms of a load state and its range within half a step of either."""
    return (state.vpp.value / state.vrms.value, over(vpp_range(state), vrms_range(state)))


def screen_for(crest_factor: float) -> float:
    """
    Return how long a screen must be for an OU to show a crest factor, s.

    Half of the screens of that length go beyond crest/2 standard deviations on
    one side: passages above a high level d come nearly as a Poisson process of
    rate alpha d exp(-d^2/2) / sqrt(2 pi).

    result in s.
    """
    d = 0.5 * crest_factor
    rate = published.ALPHA.value * d * math.exp(-0.5 * d * d) / math.sqrt(2.0 * math.pi)
    return math.log(2.0) / rate


def rows(crests: Crests) -> list[Row]:
    """Return one row for each load state with a Vrms."""
    mean, error = crests.mean(TYPICAL_MS)
    count = crests.by_screen[TYPICAL_MS].shape[0]
    found = []
    for state in published.LOADED:
        value, inputs = crest(state)
        beyond = ('' if inputs[0] <= crests.band[1] else
                  f'; the least would take a screen of {screen_for(inputs[0]):.2g} s')
        found.append(Row(
            'Table 1', f'Vpp/Vrms, {state.label}', '', Printed(f'{value:.1f}'), mean,
            f'OU with tau {published.TAU_MS.text} ms sampled at 1 MHz, {count} segments of '
            f'{max(SCREENS_MS)} ms',
            f'One OU shows {mean:.1f} on a {TYPICAL_MS} ms screen and lies within '
            f'{crests.band[0]:.1f} to {crests.band[1]:.1f} on screens of {min(SCREENS_MS)} to '
            f'{max(SCREENS_MS)} ms; half a step of Vpp and Vrms allows {inputs[0]:.1f} to '
            f'{inputs[1]:.1f}{beyond}.',
            error=error, band=crests.band, printed_inputs=inputs, point=5))
    return found
