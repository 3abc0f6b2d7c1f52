"""
The supply voltage driven by a switching current: sigma from the chain.

dU = -alpha U dt + c(x(t)) dt with x(t) a fast chain, for instance an ESC that
switches at 24..48 kHz. In the limit of fast switching U is the
Ornstein-Uhlenbeck process with sigma^2 = 2 sum pi c R0 c, c less its mean; for
the switching as it is, variance and autocovariance have a closed form too.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import check_times
from ou_monitor.paper.theory.diffusion import CORRECT_FACTOR
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.paper.theory.switching import Generator
from ou_monitor.records import FloatArray
from scipy.linalg import expm


@dataclass(frozen=True, eq=False)
class SwitchedOU:
    """
    dU = -alpha U dt + c(x(t)) dt.

    Attributes
    ----------
    alpha : float
        Relaxation rate, 1/s, > 0.
    generator : Generator
        The chain, n states.
    amplitudes : ndarray, shape (n,)
        c(x), V/s: for a rail of capacitance C, the current of the state over
        C.

    """

    alpha: float
    generator: Generator
    amplitudes: FloatArray

    def __post_init__(self) -> None:
        """Check the parameters."""
        if not 0.0 < self.alpha < math.inf:
            raise ValueError(
                f'unstable: alpha must be positive and finite, got {self.alpha} 1/s')
        amplitudes = np.asarray(self.amplitudes, dtype=np.float64)
        if amplitudes.shape != (self.generator.size,):
            raise ValueError(
                f'amplitudes must have shape ({self.generator.size},), one for each state, '
                f'got {amplitudes.shape}')
        if not np.isfinite(amplitudes).all():
            raise ValueError('amplitudes must be finite, V/s')
        object.__setattr__(self, 'amplitudes', amplitudes)

    @property
    def level(self) -> float:
        """Return the mean voltage, V: mean amplitude over alpha."""
        return float(self.generator.stationary @ self.amplitudes) / self.alpha

    @property
    def centred(self) -> FloatArray:
        """Return the amplitudes less their mean, V/s, shape (n,): they are in balance."""
        return self.amplitudes - self.generator.stationary @ self.amplitudes

    def sigma(self, factor: float = CORRECT_FACTOR) -> float:
        """Return the sigma of the limiting Ornstein-Uhlenbeck process (result in V/sqrt(s))."""
        c = self.centred
        rate = factor * float((self.generator.stationary * c) @ self.generator.potential @ c)
        return math.sqrt(max(rate, 0.0))

    def _with_state(self, eps: float) -> FloatArray:
        """Return Cov(U, 1_x) of the stationary system at eps, V, shape (n,)."""
        if not 0.0 < eps < math.inf:
            raise ValueError(f'eps must be positive and finite, got {eps}')
        n = self.generator.size
        drive = self.generator.stationary * self.centred * eps
        return np.asarray(np.linalg.solve(
            self.alpha * eps**2 * np.eye(n) - self.generator.q.T, drive))

    def variance(self, eps: float = 1.0) -> float:
        """Return the exact stationary variance of the switched system (result in V^2)."""
        return float(self._with_state(eps) @ self.centred) / (eps * self.alpha)

    def autocovariance(self, lags: npt.ArrayLike, eps: float = 1.0) -> FloatArray:
        """
        Return the exact stationary autocovariance of the switched system.

        lags in s, result in V^2.
        """
        times, n = check_times(lags), self.generator.size
        if times[0] < 0.0:
            raise ValueError(f'lags must not be negative, got {times[0]:g} s')
        # U and the indicators of the states together obey a linear equation.
        change = np.zeros((n + 1, n + 1))
        change[0, 0] = -self.alpha
        change[0, 1:] = self.centred / eps
        change[1:, 1:] = self.generator.q.T / eps**2
        start = np.concatenate([[self.variance(eps)], self._with_state(eps)])
        return np.asarray((expm(change * times[:, None, None]) @ start)[:, 0])

    def system(self) -> SwitchedSystem:
        """Return the switched system of dimension 1, balanced, with mean in its drift."""
        n = self.generator.size
        return SwitchedSystem(
            self.generator, np.zeros((n, 1, 1)), self.centred[:, None],
            np.array([[-self.alpha]]), np.array([self.alpha * self.level]))


@dataclass(frozen=True)
class OULimit:
    """
    The Ornstein-Uhlenbeck process that a switched system tends to.

    Attributes
    ----------
    alpha : float
        Relaxation rate, 1/s.
    sigma : float
        Noise intensity, V/sqrt(s).
    level : float
        Mean, V.
    var_inf : float
        sigma^2 / (2 alpha), V^2.
    variance_ratio : float
        Exact variance of the switched system over that of the limit; it
        differs from 1 by about alpha times the memory of the chain, and near
        1 the limit may be used.

    """

    alpha: float
    sigma: float
    level: float
    var_inf: float
    variance_ratio: float


def ou_of_switching(
    alpha: float, generator: Generator, amplitudes: npt.ArrayLike,
    factor: float = CORRECT_FACTOR,
) -> OULimit:
    """
    Return the Ornstein-Uhlenbeck process of a rail under fast switching.

    alpha in 1/s, amplitudes in V/s.
    """
    switched = SwitchedOU(alpha, generator, np.asarray(amplitudes, dtype=np.float64))
    sigma = switched.sigma(factor)
    var_inf = sigma**2 / (2.0 * alpha)
    limit = switched.sigma() ** 2 / (2.0 * alpha)
    ratio = switched.variance() / limit if limit > 0.0 else math.nan
    return OULimit(alpha, sigma, switched.level, var_inf, ratio)


def esc_chain(
    frequency: float, duty: float, phases: int = 1,
) -> tuple[Generator, npt.NDArray[np.bool_]]:
    """
    Return a chain that switches on and off as an ESC does, with jitter.

    On and off time each last `phases` exponential phases in turn, so each has
    the relative spread 1/sqrt(phases); many phases are a regular pulse train,
    whose slow noise vanishes.

    frequency in Hz.
    """
    if not 0.0 < frequency < math.inf:
        raise ValueError(f'frequency must be positive and finite, got {frequency} Hz')
    if not 0.0 < duty < 1.0:
        raise ValueError(f'duty must lie between 0 and 1, got {duty}: else nothing switches')
    if not isinstance(phases, (int, np.integer)) or phases < 1:
        raise ValueError(f'phases must be a whole number, 1 or more, got {phases}')
    on = np.arange(2 * phases) < phases
    return Generator.cycle(phases * frequency / np.where(on, duty, 1.0 - duty)), on
