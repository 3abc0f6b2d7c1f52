"""
How fast a switched supply tends to its limits as eps shrinks, and a rail under an ESC (10 s).

    python benchmarks/convergence.py

Averaging (paper, 3.2): u^eps - u^0 is sqrt(eps) times a Gaussian process, so
its root mean square has order 1/2 in eps.  Diffusion (3.3): the variance of a
switched rail is exact, so its distance from the limit carries no sampling noise.

A rail driven by a switching current is dU = -alpha U dt + c(x(t)) dt with x(t) a
fast chain, for instance an ESC that switches at 24..48 kHz. In the limit of fast
switching U is the Ornstein-Uhlenbeck process with sigma^2 = 2 sum pi c R0 c, c
less its mean; for the switching as it is, variance and autocovariance have a
closed form too.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
import sys

import numpy as np
import numpy.typing as npt
from scipy.linalg import expm

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from ou_monitor.paper.theory import (  # noqa: E402, I100
    check_times, CORRECT_FACTOR, Generator, PRINTED_FACTOR, SwitchedSystem)
from ou_monitor.records import FloatArray  # noqa: E402
from tables import table  # noqa: E402

# Of the error of the average in eps, by the central limit theorem.
AVERAGING_ORDER = 0.5


@dataclass(frozen=True, eq=False)
class Convergence:
    """An error at several eps and its order."""

    eps: FloatArray  # Small parameters.
    error: FloatArray  # Error at each.
    standard_error: FloatArray  # Of the error; zeros when it is exact.
    order: float  # Slope of ln(error) on ln(eps).
    # Standard error of the order from those of the errors; 0 when they are exact.
    order_error: float


def fit_order(
    eps: npt.ArrayLike, error: npt.ArrayLike, standard_error: npt.ArrayLike = 0.0,
) -> Convergence:
    """Fit error = constant * eps^order."""
    small = np.asarray(eps, dtype=np.float64)
    size = np.asarray(error, dtype=np.float64)
    spread = np.array(np.broadcast_to(np.asarray(standard_error, dtype=np.float64), size.shape))
    if small.ndim != 1 or np.unique(small).size < 2 or not (small > 0.0).all():
        raise ValueError('eps must hold two or more different positive numbers')
    if size.shape != small.shape or not (size > 0.0).all():
        raise ValueError('error must be positive and of the shape of eps')
    known = bool((spread > 0.0).all())
    weight = (size / spread) ** 2 if known else np.ones(small.size)
    x = np.log(small) - np.average(np.log(small), weights=weight)
    square = float(weight @ x**2)
    order = float((weight * x) @ np.log(size)) / square
    return Convergence(
        small, size, spread, order, 1.0 / math.sqrt(square) if known else 0.0)


def averaging_convergence(
    system: SwitchedSystem, t: npt.ArrayLike, u0: npt.ArrayLike, eps: npt.ArrayLike,
    rng: np.random.Generator, paths: int,
) -> tuple[Convergence, Convergence]:
    """Measure how u^eps tends to the averaged solution u^0 (t in s)."""
    if paths < 2:
        raise ValueError(f'paths must be 2 or more for a standard error, got {paths}')
    limit = system.averaged().solve(t, u0)
    small = np.asarray(eps, dtype=np.float64)
    squares = np.empty((2, small.size, paths))
    for k, value in enumerate(small.tolist()):
        found = system.simulate(t, u0, rng, eps=value, paths=paths)
        distance = np.square(found - limit).sum(axis=2)
        squares[:, k] = distance.max(axis=1), distance[:, -1]
    rms = np.sqrt(squares.mean(axis=2))
    spread = squares.std(axis=2, ddof=1) / (2.0 * rms * math.sqrt(paths))
    return fit_order(small, rms[0], spread[0]), fit_order(small, rms[1], spread[1])


@dataclass(frozen=True, eq=False)
class SwitchedOU:
    """dU = -alpha U dt + c(x(t)) dt."""

    alpha: float  # Relaxation rate, 1/s, > 0.
    generator: Generator  # The chain, n states.
    # c(x), V/s: for a rail of capacitance C, the current of the state over C.
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


def variance_convergence(rail: SwitchedOU, eps: npt.ArrayLike, factor: float) -> Convergence:
    """Measure how the variance of a switched rail tends to its limit, relative to that."""
    limit = rail.sigma(factor)**2 / (2.0 * rail.alpha)
    return fit_order(eps, [abs(rail.variance(one) / limit - 1.0)
                           for one in np.asarray(eps, dtype=np.float64).tolist()])


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
    return cycle(phases * frequency / np.where(on, duty, 1.0 - duty)), on


def cycle(rates: npt.ArrayLike) -> Generator:
    """Return a chain of phases visited in turn (rates, 1/s): k equal ones, an Erlang time."""
    rate = np.asarray(rates, dtype=np.float64)
    q = np.diag(-rate)
    q[np.arange(rate.size), np.roll(np.arange(rate.size), -1)] = rate
    return Generator(q)


def main() -> int:
    """Measure the orders; print the tables."""
    rng, eps = np.random.default_rng(1), [0.03, 0.01, 0.003, 0.001]
    system = SwitchedSystem.of_matrix_model(
        Generator.telegraph(up=20.0, down=10.0), alpha=5.0, omega=6.28, beta=3.0,
        alpha_p=[40.0, 80.0])
    largest, last = averaging_convergence(
        system, np.linspace(0.0, 0.1, 11), [1.0, 0.0, 0.5], eps, rng, paths=2000)
    print('### Averaging: root mean square of u^eps - u^0; the theorem says 1/2\n')
    print(_orders({'largest over 0.1 s': largest, 'at 0.1 s': last}))
    rail = SwitchedOU(1.0, Generator.telegraph(1.0, 1.0), np.array([1.0, -1.0]))
    small = [0.2, 0.1, 0.05]
    print('### Diffusion: relative error of the variance, exact; with the 2, order 2\n')
    print(_orders({name: variance_convergence(rail, small, factor) for name, factor in (
        ('with the 2', CORRECT_FACTOR), ('as printed', PRINTED_FACTOR))}))
    return 0


def _orders(found: dict[str, Convergence]) -> str:
    eps = next(iter(found.values())).eps
    return table(['error', *(f'eps = {value:g}' for value in eps), 'order'], [
        [name, *(f'{value:.4g}' for value in one.error),
         f'{one.order:.3f}' + (f' ± {one.order_error:.3f}' if one.order_error else '')]
        for name, one in found.items()])


if __name__ == '__main__':
    sys.exit(main())
