"""
The paper's theory (section 3): matrix model, Markov switching, averaging and diffusion limits.

A chain x(t) on n states has the generator Q: Q[x, y] is the rate of going from x to y, 1/s, and
every row sums to zero.  Every state must be reachable from every other: then the stationary law pi
(pi Q = 0) is unique, and the potential R0 = integral_0^inf (exp(Q t) - Pi) dt exists.  Holding
times are exponential; the next state is drawn in proportion to the rates of the present one.

A system switched by the chain is du/dt = D u + d + speed (A_x u + a_x), x = x(clock t). The paper
has two scalings with a small eps. Neither speeds up D and d; eps = 1 leaves the system unchanged:

- averaging (eq. 1): clock 1/eps, speed 1; u^eps -> the averaged system.
- diffusion (eq. 3): clock 1/eps^2, speed 1/eps, for A, a of zero average: the paths tend in law to
  the diffusion with generator b phi' + B phi'' / 2, where for C(u; x) = A_x u + a_x

      b(u) = sum_xy pi(x) R0(x, y) A_y (A_x u + a_x),
      B(u) = 2 sum_xy pi(x) R0(x, y) sym[C(u; x) C(u; y)'].

  Equation (6) of the paper lacks the factor 2 that (4), as printed, needs: the variance of the
  integral of C(x(t)) grows at twice the integral of its autocovariance over positive lags
  (Korolyuk & Limnios, Stochastic Systems in Merging Phase Space, 2005, give it with the 2).

Between two jumps a switched system is affine; so are its average and the drift of
its diffusion limit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import get_args, Literal

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray
from scipy.linalg import expm
from scipy.sparse.csgraph import connected_components


def flow(matrix: FloatArray, offset: FloatArray, tau: FloatArray, u: FloatArray) -> FloatArray:
    """Move m states along their affine systems (1/s), each for its own time tau, s."""
    # Taylor series of the exponential acting on the state, to double precision, in substeps of
    # norm at most 1. It needs no eigenvectors, so it handles a defective matrix too.
    norm = np.abs(matrix).sum(axis=-1).max(axis=-1)
    reach = float(np.max(np.abs(tau) * norm, initial=0.0))
    parts = max(1, math.ceil(reach))
    step = tau[:, None] / parts
    reach /= parts
    for _ in range(parts):
        term = step * (np.einsum('mij,mj->mi', matrix, u) + offset)
        u = u + term
        k, size = 1, reach
        while size > 1e-17:
            k += 1
            term = (step / k) * np.einsum('mij,mj->mi', matrix, term)
            u += term
            size *= reach / k
    return u


@dataclass(frozen=True, eq=False)
class AffineSystem:
    """du/dt = A u + a."""

    matrix: FloatArray  # A, 1/s; shape (d, d)
    offset: FloatArray  # a, unit of u per second; shape (d,)

    @property
    def growth_rate(self) -> float:
        """Return the largest real part of an eigenvalue of A, 1/s; >= 0: no restoring force."""
        return float(np.linalg.eigvals(self.matrix).real.max())

    def solve(self, t: npt.ArrayLike, u0: npt.ArrayLike) -> FloatArray:
        """Return the exact solution by the matrix exponential (t in s)."""
        times = check_times(t)
        state = check_state(u0, self.offset.size)
        with np.errstate(all='ignore'):
            # The exponential of [[A, a], [0, 0]] propagates (u, 1).
            d = self.offset.size
            full = np.zeros((d + 1, d + 1))
            full[:d, :d], full[:d, d] = self.matrix, self.offset
            power = expm(full * (times - times[0])[:, None, None])
            path = np.asarray(power[:, :-1, :-1] @ state + power[:, :-1, -1])
        if not np.isfinite(path).all():
            raise ValueError(
                f'unstable: the solution overflows; the largest eigenvalue of the matrix is '
                f'{self.growth_rate:+.6g} 1/s')
        return path


def check_times(t: npt.ArrayLike) -> FloatArray:
    """Return the times as an array (t in s)."""
    times = np.asarray(t, dtype=np.float64)
    if times.ndim != 1 or not times.size:
        raise ValueError(f't must have shape (k,) with k >= 1, got {times.shape}')
    if not np.isfinite(times).all() or (np.diff(times) < 0.0).any():
        raise ValueError('t must be finite and must not decrease, s')
    return times


def check_state(u0: npt.ArrayLike, d: int) -> FloatArray:
    """Return an initial state as an array."""
    state = np.atleast_1d(np.asarray(u0, dtype=np.float64))
    if state.shape != (d,):
        raise ValueError(f'u0 must have shape ({d},), got {state.shape}')
    if not np.isfinite(state).all():
        raise ValueError('u0 must be finite')
    return state


def matrix_model(alpha: float, omega: float, beta: float, alpha_p: float, *,
                 printed: bool = False) -> AffineSystem:
    """
    Return the deterministic matrix model of amplitude, phase and power (paper, 3.1).

    u = (A, phi, P), du/dt = C u.  alpha >= 0, 1/s: damping of the amplitude; omega, rad/s: angular
    frequency of the carrier; beta: coupling of the amplitude to the power, unit of P per unit of A
    per second; alpha_p > 0, 1/s: relaxation rate of the power, the alpha of the Ornstein-Uhlenbeck
    supply voltage.  Two entries of the printed matrix contradict the text around them.  +gamma on
    the diagonal makes the power grow as exp(gamma t), but the power must relax (-alpha_p).
    dphi/dt = omega phi makes the phase grow as exp(omega t), but a carrier has dphi/dt = omega.
    The default follows the text; `printed` follows the printed matrix, and alpha_p is then the
    paper's gamma, of any sign.
    """
    for name, value in (('alpha', alpha), ('omega', omega), ('beta', beta),
                        ('alpha_p', alpha_p)):
        if not math.isfinite(value):
            raise ValueError(f'{name} must be finite, got {value}')
    if alpha < 0.0:
        raise ValueError(f'alpha must be zero or positive, got {alpha} 1/s')
    if not printed and not alpha_p > 0.0:
        raise ValueError(
            f'alpha_p must be positive, got {alpha_p} 1/s: the diagonal entry is -alpha_p; '
            "`printed` puts the paper's +gamma there")
    turning, power, carrier = (omega, alpha_p, 0.0) if printed else (0.0, -alpha_p, omega)
    return AffineSystem(
        np.array([[-alpha, 0.0, 0.0], [0.0, turning, 0.0], [beta, 0.0, power]]),
        np.array([0.0, carrier, 0.0]))


# Tolerance of a row sum, as a share of the largest rate: rounding of the input.
_ROW_TOLERANCE = 1e-9


@dataclass(frozen=True, eq=False)
class Generator:
    """Generator of an irreducible Markov chain on a finite number of states."""

    # Rates, 1/s; read-only. The diagonal is set to exactly minus the sum of the row's other rates;
    # shape (n, n).
    q: FloatArray

    def __post_init__(self) -> None:
        """Check that this is a generator with one stationary law."""
        if np.iscomplexobj(self.q):
            raise ValueError('rates must be real, 1/s')
        q = np.array(self.q, dtype=np.float64)
        if q.ndim != 2 or q.shape[0] != q.shape[1]:
            raise ValueError(f'Q must be square, got shape {q.shape}')
        if len(q) < 2:
            raise ValueError('Q must have two states or more: one state never switches')
        if not np.isfinite(q).all():
            row, column = np.argwhere(~np.isfinite(q))[0]
            raise ValueError(f'Q[{row}, {column}] is {q[row, column]}: rates must be finite, 1/s')
        rates = q - np.diag(np.diag(q))
        if (rates < 0.0).any():
            row, column = np.unravel_index(np.argmin(rates), q.shape)
            raise ValueError(f'Q[{row}, {column}] = {q[row, column]:g} 1/s is negative: only the '
                             'diagonal may be')
        tolerance = _ROW_TOLERANCE * float(np.abs(q).max())
        defect = q.sum(axis=1)
        row = np.argmax(np.abs(defect))
        if abs(defect[row]) > tolerance:
            raise ValueError(
                f'row {row} of Q sums to {defect[row]:.6g} 1/s, not to 0 (tolerance '
                f'{tolerance:.3g} 1/s): its diagonal entry should be {-rates[row].sum():.6g}')
        count, label = connected_components(rates > 0.0, directed=True, connection='strong')
        if count > 1:
            classes = [np.flatnonzero(label == c).tolist() for c in range(count)]
            raise ValueError(
                f'the chain has no single stationary law: not every state is reached from every '
                f'other (states that reach one another: {", ".join(map(str, classes))})')
        np.fill_diagonal(q, -rates.sum(axis=1))
        q.setflags(write=False)
        object.__setattr__(self, 'q', q)

    @classmethod
    def telegraph(cls, up: float, down: float) -> Generator:
        """Return the generator of a chain of two states, off (0) and on (1)."""
        return cls(np.array([[-up, up], [down, -down]]))

    @property
    def size(self) -> int:
        return len(self.q)

    @property
    def leaving(self) -> FloatArray:
        """Return the rates q(x) of leaving each state, 1/s, shape (n,)."""
        return -np.diag(self.q)

    @cached_property
    def stationary(self) -> FloatArray:
        """Return the stationary law pi, shape (n,)."""
        # pi Q = 0, with one of the equations replaced by sum(pi) = 1.
        equations = self.q.T / np.abs(self.q).max()
        equations[-1] = 1.0
        law = np.linalg.solve(equations, np.eye(self.size)[-1])
        law.setflags(write=False)
        return law

    @cached_property
    def potential(self) -> FloatArray:
        """Return R0 = integral_0^inf (exp(Q t) - Pi) dt, s, shape (n, n)."""
        # (s Pi - Q)^-1 - Pi / s is the same for every s > 0; s is the mean rate of leaving, so
        # that the matrix to invert is well scaled.
        rate = float(self.leaving.mean())
        # Pi: every row is the stationary law.
        projector = np.tile(self.stationary, (self.size, 1))
        potential = np.asarray((np.linalg.inv(projector - self.q / rate) - projector) / rate)
        potential.setflags(write=False)
        return potential


Scaling = Literal['averaging', 'diffusion']


@dataclass(frozen=True, eq=False)
class SwitchedSystem:
    """An affine system with a matrix and an offset for every state of the chain."""

    generator: Generator  # The chain, n states
    matrices: FloatArray  # A_x, 1/s; shape (n, d, d)
    # a_x, unit of u per second; zeros when left out; shape (n, d).
    offsets: FloatArray = field(default_factory=lambda: np.empty(0))
    # D, 1/s: not switched, not sped up; zeros when left out; shape (d, d).
    drift_matrix: FloatArray = field(default_factory=lambda: np.empty(0))
    # d, unit of u per second; shape (d,)
    drift_offset: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Check the shapes and fill in the zeros."""
        n = self.generator.size
        matrices = np.asarray(self.matrices, dtype=np.float64)
        if matrices.ndim != 3 or matrices.shape[0] != n or \
                matrices.shape[1] != matrices.shape[2]:
            raise ValueError(
                f'matrices must have shape ({n}, d, d), one for each state of the chain, got '
                f'{matrices.shape}')
        d = matrices.shape[1]
        object.__setattr__(self, 'matrices', matrices)
        for name, shape in (
                ('offsets', (n, d)), ('drift_matrix', (d, d)), ('drift_offset', (d,))):
            value = getattr(self, name)
            array = np.asarray(value, dtype=np.float64) if len(value) else np.zeros(shape)
            if array.shape != shape:
                raise ValueError(f'{name} must have shape {shape}, got {array.shape}')
            object.__setattr__(self, name, array)
        for name in ('matrices', 'offsets', 'drift_matrix', 'drift_offset'):
            if not np.isfinite(getattr(self, name)).all():
                raise ValueError(f'{name} must be finite')

    @classmethod
    def of_matrix_model(
        cls, generator: Generator, *, alpha: npt.ArrayLike, omega: npt.ArrayLike,
        beta: npt.ArrayLike, alpha_p: npt.ArrayLike,
    ) -> SwitchedSystem:
        """Return the matrix model of 3.1 with switched coefficients."""
        given = {'alpha': alpha, 'omega': omega, 'beta': beta, 'alpha_p': alpha_p}
        for name, value in given.items():
            if np.shape(value) not in ((), (generator.size,)):
                raise ValueError(f'{name} must be one number or have shape ({generator.size},), '
                                 f'got {np.shape(value)}')
        rows = np.column_stack([np.broadcast_to(one, generator.size) for one in given.values()])
        systems = [matrix_model(*row) for row in rows.astype(np.float64).tolist()]
        return cls(generator, np.array([one.matrix for one in systems]),
                   np.array([one.offset for one in systems]))

    def switched_average(self) -> tuple[FloatArray, FloatArray]:
        """Return sum_x pi(x) A_x and sum_x pi(x) a_x."""
        pi = self.generator.stationary
        return np.tensordot(pi, self.matrices, 1), pi @ self.offsets

    def averaged(self) -> AffineSystem:
        """Return the averaged system du/dt = C_hat(u) = sum_x pi(x) C(u; x)."""
        matrix, offset = self.switched_average()
        return AffineSystem(self.drift_matrix + matrix, self.drift_offset + offset)

    def scaled(self, eps: float, scaling: Scaling) -> SwitchedSystem:
        """Return the system at eps, with the unswitched drift merged into the matrices."""
        if not 0.0 < eps < np.inf:
            raise ValueError(f'eps must be positive and finite, got {eps}')
        if scaling not in get_args(Scaling):
            raise ValueError(f"scaling must be 'averaging' or 'diffusion', got {scaling!r}")
        clock, speed = (1.0 / eps, 1.0) if scaling == 'averaging' else (1.0 / eps**2, 1.0 / eps)
        return SwitchedSystem(
            Generator(clock * self.generator.q), self.drift_matrix + speed * self.matrices,
            self.drift_offset + speed * self.offsets)

    def simulate(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, rng: np.random.Generator, *,
        eps: float = 1.0, paths: int = 1, scaling: Scaling = 'averaging',
    ) -> FloatArray:
        """Draw paths with exact jump times, and exact motion between jumps (t in s)."""
        at_eps, times = self.scaled(eps, scaling), check_times(t)
        if paths < 1:
            raise ValueError(f'paths must be 1 or more, got {paths}')
        chain, matrices, offsets = at_eps.generator, at_eps.matrices, at_eps.offsets
        rates = chain.leaving
        # Where each state jumps to, cumulated; each row ends at exactly 1.
        kernel = np.cumsum(np.maximum(chain.q, 0.0), axis=1)
        kernel /= kernel[:, -1:]
        state = rng.choice(chain.size, paths, p=chain.stationary)
        hold = rng.standard_exponential(paths) / rates[state]
        u = np.tile(check_state(u0, self.matrices.shape[1]), (paths, 1))
        found = np.empty((paths, times.size, u.shape[1]))
        found[:, 0] = u
        with np.errstate(over='ignore', invalid='ignore'):
            for k, width in enumerate(np.diff(times)):
                left = np.full(paths, width)
                which = np.flatnonzero(hold < left)
                while which.size:
                    held, at = hold[which], state[which]
                    u[which] = flow(matrices[at], offsets[at], held, u[which])
                    rest = left[which] - held
                    at = (rng.random(at.size)[:, None] >= kernel[at]).sum(axis=1)
                    new = rng.standard_exponential(which.size) / rates[at]
                    left[which], state[which], hold[which] = rest, at, new
                    which = which[new < rest]
                u = flow(matrices[state], offsets[state], left, u)
                if not np.isfinite(u).all():
                    raise ValueError(f'unstable: a path overflows before t = {times[k + 1]:g} s')
                found[:, k + 1] = u
                hold -= left
        return found


# Tolerance of the average, as a share of the largest switched entry.
BALANCE_TOLERANCE = 1e-9
PRINTED_FACTOR = 1.0  # Factor in B of equation (6), as printed
CORRECT_FACTOR = 2.0  # Factor that equation (4) needs


def require_balance(system: SwitchedSystem) -> None:
    """Refuse a system whose switched part does not have zero average."""
    for average, switched in zip(system.switched_average(), (system.matrices, system.offsets)):
        i, *j = np.unravel_index(int(np.argmax(np.abs(average))), average.shape)
        worst = float(average[(i, *j)])
        if abs(worst) > BALANCE_TOLERANCE * float(np.abs(switched).max()):
            what = (f'has a coefficient of {worst:+.6g} 1/s for component {j[0]}' if j else
                    f'is {worst:+.6g} per second at u = 0')
            raise ValueError(
                f'the balance condition does not hold: the averaged velocity of component {i} '
                f'{what}, not 0; move the average to the unswitched drift')


def switching_drift(system: SwitchedSystem) -> AffineSystem:
    """Return b(u), equation (5), of a balanced system."""
    require_balance(system)
    weight = system.generator.stationary[:, None] * system.generator.potential
    # The product is A_y A_x, in this order: the chain is in x first.
    after = np.tensordot(weight, system.matrices, 1)
    return AffineSystem(
        np.einsum('xij,xjk->ik', after, system.matrices),
        np.einsum('xij,xj->i', after, system.offsets))


def switching_intensity(system: SwitchedSystem, u: npt.ArrayLike,
                        factor: float = CORRECT_FACTOR) -> FloatArray:
    """Return B(u), equation (6) with a factor, of a balanced system, shape (d, d)."""
    if not 0.0 < factor < math.inf:
        raise ValueError(f'factor must be positive and finite, got {factor}')
    require_balance(system)
    weight = system.generator.stationary[:, None] * system.generator.potential
    velocity = system.matrices @ check_state(u, system.matrices.shape[1]) + system.offsets
    return np.asarray(0.5 * factor * velocity.T @ (weight + weight.T) @ velocity)
