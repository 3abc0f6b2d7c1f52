"""
Crest factors Vpp/Vrms of an Ornstein-Uhlenbeck process on a screen, without and with jumps.

Paths are drawn with the exact transition over steps of a hundred oscilloscope samples.  Extremes
within a step are drawn from a Brownian bridge; their relative error is alpha dt = 0.006.  The
crest factor does not depend on sigma.  For section 5, "diffusion and jump components", jumps that
relax at the rate alpha are simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.model.ou import simulate, transition
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.shocks import Jumps
from ou_monitor.paper import published
from ou_monitor.paper.published import mean_and_error, over, Printed, Range, Row
from ou_monitor.records import FloatArray
from scipy.signal import lfilter

# Screen lengths tried, ms; the paper gives none.
SCREENS_MS = (10, 100, 500)
TYPICAL_MS = 100  # Length for the statements and the plot, ms
# Share of screens below, and above, the band of crest factors.
TAIL = 0.05
# Oscilloscope samples per step of the simulation; segments in memory at once; number of screens of
# white noise.
_SAMPLES, _AT_ONCE, _WHITE = 100, 100, 200


@dataclass(frozen=True, eq=False)
class Crests:
    """Crest factors of simulated screens."""

    # Vpp/Vrms of every screen, by its length in ms; rows are independent; shape (paths, k).
    by_screen: dict[int, FloatArray]
    white: FloatArray  # Of white Gaussian noise, on a screen of 100 ms; shape (k,)

    def mean(self, screen: int) -> tuple[float, float]:
        """Return mean and standard error on screens of this length, ms."""
        return mean_and_error(self.by_screen[screen].mean(axis=1))

    def quantile(self, screen: int, share: float) -> float:
        """Return a quantile over screens of this length, ms."""
        return float(np.quantile(self.by_screen[screen], share))

    @property
    def band(self) -> Range:
        """5 % quantile of the shortest to 95 % quantile of the longest screens."""
        return (self.quantile(min(self.by_screen), TAIL),
                self.quantile(max(self.by_screen), 1.0 - TAIL))


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
    # For a stationary variance of 1.
    sigma = math.sqrt(2.0 * published.ALPHA.value)
    phi, q = (float(v) for v in transition(published.ALPHA.value, sigma, dt))
    noise = rng.standard_normal((paths, 1 + round(1e-3 * max(SCREENS_MS) / dt)))
    noise[:, 1:] *= math.sqrt(q)
    path = lfilter([1.0], [1.0, -phi], noise, axis=1)
    left, right = path[:, :-1], path[:, 1:]
    # Extremes of a bridge from a to b with variance s^2 dt:
    # (a + b +- sqrt((b - a)^2 - 2 s^2 dt ln U)) / 2, U uniform.
    middle, square = left + right, (right - left) ** 2
    top, bottom = (middle + sign * np.sqrt(
        square + 2.0 * q * rng.standard_exponential(square.shape)) for sign in (1.0, -1.0))
    # Sampled at 1 MHz, extremes are smaller by 0.5826 sigma sqrt(1 us) on each side (Broadie,
    # Glasserman & Kou, Math. Finance 7 (1997) 325).
    unseen = 2.0 * 0.5826 * sigma / math.sqrt(published.SAMPLING_HZ)
    found = {}
    for ms in SCREENS_MS:
        shape = (paths, -1, round(1e-3 * ms / dt))
        vpp = 0.5 * (top.reshape(shape).max(axis=2) - bottom.reshape(shape).min(axis=2)) - unseen
        found[ms] = vpp / left.reshape(shape).std(axis=2)
    return found


def screen_for(crest_factor: float) -> float:
    """Return the screen length at which an OU shows a crest factor, s."""
    # At this length, half of the screens exceed crest/2 standard deviations on one side.
    return math.log(2.0) * mean_first_passage(0.0, 0.5 * crest_factor) / published.ALPHA.value


def rows(crests: Crests) -> list[Row]:
    """Return one row for each load state with a Vrms."""
    mean, error = crests.mean(TYPICAL_MS)
    count = crests.by_screen[TYPICAL_MS].shape[0]
    found = []
    for state in published.LOADED:
        value, inputs = state.crest, state.crest_range
        beyond = ('' if inputs[0] <= crests.band[1] else
                  f'; even {inputs[0]:.1f} would need a screen of {screen_for(inputs[0]):.2g} s')
        found.append(Row(
            'Table 1', f'Vpp/Vrms, {state.label}', '', Printed(f'{value:.1f}'), mean,
            f'OU with tau {published.TAU_MS.text} ms sampled at 1 MHz, {count} segments of '
            f'{max(SCREENS_MS)} ms',
            f'One OU shows {mean:.1f} on a {TYPICAL_MS} ms screen and lies within '
            f'{crests.band[0]:.1f} to {crests.band[1]:.1f} on screens of {min(SCREENS_MS)} to '
            f'{max(SCREENS_MS)} ms; the resolution of Vpp and Vrms allows {inputs[0]:.1f} to '
            f'{inputs[1]:.1f}{beyond}.',
            error=error, band=crests.band, printed_inputs=inputs, point=5))
    return found


WHERE = 'Section 5'
# Jumps per second, and shares of the variance, that are tried.
RATES = (2.0, 5.0, 10.0, 20.0, 50.0)
SHARES = (0.25, 0.5, 0.75, 0.95)
JUMP_SCREENS_MS = (100, 500)
# Sampling rate with jumps, Hz; compared with 1 MHz it lowers a crest factor by less than 0.1.
_SAMPLING = 20e3


@dataclass(frozen=True)
class JumpCrest:
    """Crest factors of an OU with jumps that relax at its alpha."""

    screen: int  # Length, ms
    rate: float  # Jumps per second
    share: float  # Their share of the variance
    # Mean Vpp/Vrms and its standard error.
    mean: float
    error: float
    band: Range  # 5 % and 95 % of the screens

    def size(self, vrms: float) -> float:
        """Return the standard deviation of the jumps, in the unit of `vrms`."""
        return vrms * math.sqrt(2.0 * published.ALPHA.value * self.share / self.rate)


def simulate_jumps(rng: np.random.Generator, seconds: float,
                   progress: Callable[[float], None] = lambda share: None) -> list[JumpCrest]:
    """Draw screens of OUs with jumps (seconds in s, progress 0..1)."""
    alpha = published.ALPHA.value
    longest = max(JUMP_SCREENS_MS)
    # One more screen, dropped later, lets the jumps become stationary.
    t = np.arange(round((seconds + 1e-3 * longest) * _SAMPLING)) / _SAMPLING
    begin = round(1e-3 * longest * _SAMPLING)
    found = []
    for k, rate in enumerate(RATES):
        plain = simulate(t, alpha, math.sqrt(2.0 * alpha), rng)[begin:]
        jumping = SupplyModel((
            OU(alpha, 0.0, 0.0), Jumps(rate, 0.0, math.sqrt(2.0 * alpha / rate)))
        ).simulate(t, rng)[begin:]
        for share in SHARES:
            path = math.sqrt(1.0 - share) * plain + math.sqrt(share) * jumping
            for ms in JUMP_SCREENS_MS:
                values = crest_of(path.reshape(-1, round(1e-3 * ms * _SAMPLING)))
                low, high = np.quantile(values, [TAIL, 1.0 - TAIL])
                # Screens are many tau long, so neighbours are almost independent.
                found.append(JumpCrest(
                    ms, rate, share, *mean_and_error(values), (float(low), float(high))))
        progress((k + 1) / len(RATES))
    return found


def largest(found: list[JumpCrest], screen: int) -> JumpCrest:
    """Return the jumps with the largest mean crest factor on screens of this length, ms."""
    return max((c for c in found if c.screen == screen), key=lambda c: c.mean)


def impulse_height(state: published.PrintedLoad, crests: Crests) -> float:
    """Return the height of short impulses that would raise an OU to the printed Vpp, mV."""
    return state.vpp.value - crests.mean(TYPICAL_MS)[0] * state.vrms.value


def jump_rows(found: list[JumpCrest], crests: Crests) -> list[Row]:
    """Return the rows of section 5 on jumps."""
    low, high = published.LOW.crest, published.HIGH.crest
    inputs = over(published.HIGH.crest_range, published.LOW.crest_range)
    result = [Row(
        WHERE, 'Vpp/Vrms, 40 % over 5 %', '', Printed('> 1'), high / low, 'quotient from Table 1',
        '"From Gaussian noise to impulse disturbances with load" would raise Vpp/Vrms, but it '
        f'falls from {low:.1f} to {high:.1f}; the resolution of the readings allows a quotient of '
        f'{inputs[0]:.2f} to {inputs[1]:.2f}.', inputs=inputs, point=8)]
    for state in (published.LOW, published.MEDIUM):
        value, inputs = state.crest, state.crest_range
        for ms in JUMP_SCREENS_MS:
            best = largest(found, ms)
            result.append(Row(
                WHERE, f'Vpp/Vrms, {state.label}, jumps, {ms} ms screen', '',
                Printed(f'{value:.1f}'), best.mean,
                f'OU with compound Poisson jumps that relax at alpha, best of '
                f'{len(RATES) * len(SHARES)} rates and shares, Monte Carlo',
                f'Largest mean: {best.mean:.1f} ({best.band[0]:.1f} to {best.band[1]:.1f}), '
                f'with {best.rate:g} jumps a second of {best.size(state.vrms.value):.0f} mV rms, '
                f'{100 * best.share:.0f} % of the variance; impulses too short to count in Vrms '
                f"would have to add {impulse_height(state, crests):.0f} mV to the OU's Vpp.",
                error=best.error, band=best.band, printed_inputs=inputs, point=8))
    return result
