"""
Orders of convergence of a switched supply to its limits (10 s), and chains that switch it.

Averaging (paper, 3.2): u^eps - u^0 is sqrt(eps) times a Gaussian process, so its rms has order 1/2
in eps.  Diffusion (3.3): a rail driven by a fast chain x(t), dU = -alpha U dt + c(x) dt, tends to
the Ornstein-Uhlenbeck process with sigma^2 = 2 sum pi c R0 c, where c is centred. The variance at
any eps is computed exactly, so the distance from the limit has no sampling noise.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
import sys

from common import table
import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory import CORRECT_FACTOR, Generator, PRINTED_FACTOR, SwitchedSystem
from ou_monitor.records import FloatArray


@dataclass(frozen=True, eq=False)
class Convergence:
    """An error at several eps and its order."""

    eps: FloatArray
    error: FloatArray
    standard_error: FloatArray  # Of the error; zeros if it is exact.
    order: float  # Slope of ln(error) on ln(eps).
    order_error: float  # Its standard error; 0 if the errors are exact.


def fit_order(eps: npt.ArrayLike, error: npt.ArrayLike, standard_error: npt.ArrayLike = 0.0
              ) -> Convergence:
    """Fit error = constant * eps^order, weighted by the standard errors."""
    small, size = np.asarray(eps, dtype=float), np.asarray(error, dtype=float)
    spread = np.array(np.broadcast_to(np.asarray(standard_error, dtype=float), size.shape))
    exact = not (spread > 0.0).all()
    weight = np.ones(small.size) if exact else (size / spread) ** 2
    x = np.log(small) - np.average(np.log(small), weights=weight)
    square = float(weight @ x**2)
    return Convergence(small, size, spread, float((weight * x) @ np.log(size)) / square,
                       0.0 if exact else 1.0 / math.sqrt(square))


def averaging_convergence(
    system: SwitchedSystem, t: npt.ArrayLike, u0: npt.ArrayLike, eps: npt.ArrayLike,
    rng: np.random.Generator, paths: int,
) -> tuple[Convergence, Convergence]:
    """Return the convergence of u^eps to u^0 (t in s): largest distance, and the last one."""
    limit = system.averaged().solve(t, u0)
    small = np.asarray(eps, dtype=float)
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

    alpha: float  # Relaxation rate, 1/s.
    generator: Generator  # The chain.
    amplitudes: FloatArray  # c(x), V/s: the current in each state over the capacitance.

    @property
    def level(self) -> float:
        """Return the mean voltage, V."""
        return float(self.generator.stationary @ self.amplitudes) / self.alpha

    @property
    def centred(self) -> FloatArray:
        """Return the amplitudes less their mean, V/s."""
        return self.amplitudes - self.generator.stationary @ self.amplitudes

    def sigma(self, factor: float = CORRECT_FACTOR) -> float:
        """Return sigma of the limiting Ornstein-Uhlenbeck process, V/sqrt(s)."""
        c = self.centred
        return math.sqrt(factor * float(
            (self.generator.stationary * c) @ self.generator.potential @ c))

    def variance(self, eps: float = 1.0) -> float:
        """Return the exact stationary variance at eps, V^2."""
        # Cov(U, 1_x) of the stationary system, V.
        with_state = np.linalg.solve(
            self.alpha * eps**2 * np.eye(self.generator.size) - self.generator.q.T,
            self.generator.stationary * self.centred * eps)
        return float(with_state @ self.centred) / (eps * self.alpha)

    def system(self) -> SwitchedSystem:
        """Return the switched system of dimension 1, balanced, with the mean in its drift."""
        return SwitchedSystem(
            self.generator, np.zeros((self.generator.size, 1, 1)), self.centred[:, None],
            np.array([[-self.alpha]]), np.array([self.alpha * self.level]))


def variance_convergence(rail: SwitchedOU, eps: list[float], factor: float) -> Convergence:
    """Return the convergence of a switched rail's variance to its limit (relative error)."""
    limit = rail.sigma(factor)**2 / (2.0 * rail.alpha)
    return fit_order(eps, [abs(rail.variance(one) / limit - 1.0) for one in eps])


def cycle(rates: npt.ArrayLike) -> Generator:
    """Return a chain that visits its states in turn (rates, 1/s)."""
    rate = np.asarray(rates, dtype=float)
    q = np.diag(-rate)
    q[np.arange(rate.size), np.roll(np.arange(rate.size), -1)] = rate
    return Generator(q)


def esc_chain(frequency: float, duty: float, phases: int = 1
              ) -> tuple[Generator, npt.NDArray[np.bool_]]:
    """
    Return a chain that switches as an ESC does (frequency, Hz), and in which states it is on.

    On and off time each last `phases` exponential phases, so their relative spread is
    1/sqrt(phases); with many phases the pulse train is regular and its slow noise vanishes.
    """
    on = np.arange(2 * phases) < phases
    return cycle(phases * frequency / np.where(on, duty, 1.0 - duty)), on


def orders(found: dict[str, Convergence]) -> str:
    """Return a table of errors and their order."""
    eps = next(iter(found.values())).eps
    return table(['error', *(f'eps = {value:g}' for value in eps), 'order'], [
        [name, *(f'{value:.4g}' for value in one.error),
         f'{one.order:.3f}' + (f' ± {one.order_error:.3f}' if one.order_error else '')]
        for name, one in found.items()])


def main() -> int:
    """Measure the orders; print the tables."""
    system = SwitchedSystem.of_matrix_model(
        Generator.telegraph(up=20.0, down=10.0), alpha=5.0, omega=6.28, beta=3.0,
        alpha_p=[40.0, 80.0])
    largest, last = averaging_convergence(
        system, np.linspace(0.0, 0.1, 11), [1.0, 0.0, 0.5], [0.03, 0.01, 0.003, 0.001],
        np.random.default_rng(1), paths=2000)
    print('### Averaging: root mean square of u^eps - u^0; the theorem says 1/2\n')
    print(orders({'largest over 0.1 s': largest, 'at 0.1 s': last}))
    rail = SwitchedOU(1.0, Generator.telegraph(1.0, 1.0), np.array([1.0, -1.0]))
    print('### Diffusion: relative error of the variance, exact; with the 2, order 2\n')
    print(orders({name: variance_convergence(rail, [0.2, 0.1, 0.05], factor)
                  for name, factor in (('with the 2', CORRECT_FACTOR),
                                       ('as printed', PRINTED_FACTOR))}))
    return 0


if __name__ == '__main__':
    sys.exit(main())
