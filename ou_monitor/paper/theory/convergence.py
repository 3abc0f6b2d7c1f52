"""
How fast a switched system tends to its limits as eps shrinks.

Averaging (paper, 3.2): u^eps - u^0 is sqrt(eps) times a Gaussian process, so
its root mean square has order 1/2 in eps; `fluctuation_covariance` gives the
constant too. Diffusion (3.3): means and covariances are exact on both sides, so
their errors carry no sampling noise; a two-sample test compares whole laws.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import check_state, check_times
from ou_monitor.paper.theory.diffusion import CORRECT_FACTOR, diffusion_limit
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.records import FloatArray
from scipy.integrate import solve_ivp
from scipy.stats import ks_2samp

# Of the error of the average in eps, by the central limit theorem.
AVERAGING_ORDER = 0.5


@dataclass(frozen=True, eq=False)
class Convergence:
    """
    An error at several eps and its order.

    Attributes
    ----------
    eps : ndarray, shape (m,)
        Small parameters.
    error : ndarray, shape (m,)
        Error at each.
    standard_error : ndarray, shape (m,)
        Of the error; zeros when it is exact.
    order : float
        Slope of ln(error) on ln(eps).
    order_error : float
        Standard error of the order from those of the errors; 0 when they are
        exact.

    """

    eps: FloatArray
    error: FloatArray
    standard_error: FloatArray
    order: float
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


def fluctuation_covariance(
    system: SwitchedSystem, t: npt.ArrayLike, u0: npt.ArrayLike,
) -> FloatArray:
    """
    Return the limit of Cov(u^eps(t)) / eps under averaging.

    S' = A_hat S + S A_hat' + B(u^0(t)), with the intensity B of the switched
    part less its average.

    t in s.
    """
    times, d = check_times(t), system.dimension
    mean = system.averaged()
    noise = diffusion_limit(system.balanced())

    def velocity(_: float, y: FloatArray) -> FloatArray:
        s = y[d:].reshape(d, d)
        growth = mean.matrix @ s
        return np.concatenate([
            mean.matrix @ y[:d] + mean.offset,
            (growth + growth.T + noise.intensity(y[:d])).ravel()])

    start = np.concatenate([check_state(u0, d), np.zeros(d * d)])
    if times[-1] == times[0]:
        return np.zeros((times.size, d, d))
    once, where = np.unique(times, return_inverse=True)
    solved = solve_ivp(velocity, (times[0], times[-1]), start, method='LSODA', t_eval=once,
                       rtol=1e-9, atol=1e-12)
    return np.asarray(solved.y[d:].T.reshape(-1, d, d)[where])


@dataclass(frozen=True, eq=False)
class DiffusionConvergence:
    """
    Distance of a switched system from its diffusion limit.

    Attributes
    ----------
    mean, covariance : Convergence
        Largest error over the times, exact on both sides; the covariance
        relative to the largest entry of that of the limit.
    p_values : ndarray, shape (m, d)
        Of the two-sample Kolmogorov-Smirnov test between the switched system
        and the limit at the last time, for each eps and component.

    """

    mean: Convergence | None
    covariance: Convergence
    p_values: FloatArray


def diffusion_convergence(
    system: SwitchedSystem, t: npt.ArrayLike, u0: npt.ArrayLike, eps: npt.ArrayLike,
    rng: np.random.Generator, paths: int, factor: float = CORRECT_FACTOR,
) -> DiffusionConvergence:
    """Measure how a switched system tends in law to its diffusion limit (system in A, t in s)."""
    times = check_times(t)
    ends = np.array([times[0], times[-1]])
    small = np.asarray(eps, dtype=np.float64)
    limit = diffusion_limit(system, factor)
    mean, covariance = limit.moments(times, u0)
    scale = float(np.abs(covariance).max())
    errors = np.empty((2, small.size))
    p_values = np.empty((small.size, system.dimension))
    for k, value in enumerate(small.tolist()):
        there = system.moments(times, u0, eps=value, scaling='diffusion')
        errors[:, k] = (
            np.abs(there[0] - mean).max(), np.abs(there[1] - covariance).max() / scale)
        switched = system.simulate(
            ends, u0, rng, eps=value, paths=paths, scaling='diffusion')[:, -1]
        diffused = limit.simulate(ends, u0, rng, paths=paths)[:, -1]
        p_values[k] = [ks_2samp(a, b).pvalue
                       for a, b in zip(switched.T, diffused.T, strict=True)]
    exact = errors[0].max() <= 1e-9 * max(float(np.abs(mean).max()), math.sqrt(scale))
    return DiffusionConvergence(
        None if exact else fit_order(small, errors[0]), fit_order(small, errors[1]), p_values)
