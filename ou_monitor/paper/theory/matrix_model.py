"""
The deterministic matrix model of amplitude, phase and power (paper, 3.1).

u = (A, phi, P), du/dt = C u with the printed matrix

    [[-alpha, 0, 0], [0, omega, 0], [beta, 0, gamma]].

Two of its entries do not do what the text around them says:

- The paper identifies the relaxation rate of the supply with gamma. With
  +gamma on the diagonal and gamma > 0 the power grows as exp(gamma t); it
  relaxes only when the entry is -alpha_p with alpha_p > 0.
- omega is called the angular frequency of the carrier, so dphi/dt = omega. The
  printed row says dphi/dt = omega phi, a phase that grows as exp(omega t).

`MatrixModel` takes both as the text means them; `MatrixModel.as_printed` takes
the matrix as printed, and `stability` says what grows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import math
from typing import Literal

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.theory.affine import AffineSystem, check_state, check_times
from ou_monitor.records import FloatArray
from scipy.integrate import solve_ivp

Coefficient = float | Callable[[float], float]
COMPONENTS = ('amplitude', 'phase', 'power')


@dataclass(frozen=True)
class Stability:
    """What the matrix does to each component at one moment."""

    # Diagonal entry of each component, 1/s; the matrix is triangular, so these are its
    # eigenvalues.
    rates: dict[str, float]
    growing: tuple[str, ...]  # Components that grow exponentially
    text: str  # One sentence: ``stable`` or ``unstable: ...`` with the rates

    @property
    def stable(self) -> bool:
        """Tell whether no component grows exponentially."""
        return not self.growing


@dataclass(frozen=True)
class MatrixModel:
    """The matrix model with constant or time-varying coefficients."""

    alpha: Coefficient  # Damping of the amplitude, 1/s, >= 0; a callable is given the time, s
    omega: Coefficient  # Angular frequency of the carrier, rad/s
    beta: Coefficient  # Coupling of the amplitude to the power, unit of P per unit of A per second
    # Relaxation rate of the power, 1/s, > 0: the alpha of the Ornstein-Uhlenbeck supply voltage.
    # With ``power_sign='printed'`` it is the paper's gamma, of any sign, put on the diagonal as it
    # is.
    alpha_p: Coefficient
    # Diagonal entry of the power: -alpha_p, or +gamma as printed.
    power_sign: Literal['decaying', 'printed'] = 'decaying'
    # dphi/dt = omega, or dphi/dt = omega phi as printed.
    phase: Literal['carrier', 'printed'] = 'carrier'

    def __post_init__(self) -> None:
        """Check what can be checked before a time is given."""
        if self.power_sign not in ('decaying', 'printed'):
            raise ValueError(
                f"power_sign must be 'decaying' or 'printed', got {self.power_sign!r}")
        if self.phase not in ('carrier', 'printed'):
            raise ValueError(f"phase must be 'carrier' or 'printed', got {self.phase!r}")
        if self.is_constant:
            self._at(0.0)

    @classmethod
    def as_printed(
        cls, alpha: Coefficient, omega: Coefficient, beta: Coefficient, gamma: Coefficient,
    ) -> MatrixModel:
        """
        Return the model with the matrix exactly as the paper prints it.

        alpha, omega, beta, gamma in 1/s.
        """
        return cls(alpha, omega, beta, gamma, power_sign='printed', phase='printed')

    @property
    def is_constant(self) -> bool:
        """Tell whether no coefficient is a function of time."""
        return not any(map(callable, (self.alpha, self.omega, self.beta, self.alpha_p)))

    def _at(self, t: float) -> tuple[float, float, float, float]:
        """Return alpha, omega, beta and the diagonal entry of the power at a time."""
        values = []
        for name in ('alpha', 'omega', 'beta', 'alpha_p'):
            coefficient = getattr(self, name)
            value = float(coefficient(t) if callable(coefficient) else coefficient)
            when = f' at t = {t:g} s' if callable(coefficient) else ''
            if not math.isfinite(value):
                raise ValueError(f'{name} must be finite, got {value}{when}')
            values.append(value)
            if name == 'alpha' and value < 0.0:
                raise ValueError(f'alpha must be zero or positive, got {value} 1/s{when}')
            if name == 'alpha_p' and self.power_sign == 'decaying' and not value > 0.0:
                raise ValueError(
                    f'alpha_p must be positive, got {value} 1/s{when}: the diagonal entry is '
                    "-alpha_p; power_sign='printed' puts the paper's +gamma there")
        alpha, omega, beta, power = values
        return alpha, omega, beta, power if self.power_sign == 'printed' else -power

    def matrix(self, t: float = 0.0) -> FloatArray:
        """Return the matrix C at a time (t in s, result in 1/s)."""
        alpha, omega, beta, power = self._at(t)
        turning = omega if self.phase == 'printed' else 0.0
        return np.array([[-alpha, 0.0, 0.0], [0.0, turning, 0.0], [beta, 0.0, power]])

    def offset(self, t: float = 0.0) -> FloatArray:
        """Return the constant velocity at `t` s: (0, omega, 0) for a carrier, else zeros."""
        omega = self._at(t)[1]
        return np.array([0.0, omega if self.phase == 'carrier' else 0.0, 0.0])

    def at(self, t: float = 0.0) -> AffineSystem:
        """Return du/dt = C u + c with the coefficients frozen at `t` s."""
        return AffineSystem(self.matrix(t), self.offset(t))

    def stability(self, t: float = 0.0) -> Stability:
        """
        Say which components grow, and how fast.

        A carrier's phase advances linearly: that is no instability.

        t in s.
        """
        rates = dict(zip(COMPONENTS, np.diag(self.matrix(t)).tolist(), strict=True))
        growing = tuple(name for name in COMPONENTS if rates[name] > 0.0)
        if not growing:
            return Stability(rates, (), 'stable')
        said = ', '.join(f'{name} grows as exp({rates[name]:g} t)' for name in growing)
        cure = []
        if 'power' in growing:
            cure.append('a power that relaxes needs -alpha_p on the diagonal')
        if 'phase' in growing:
            cure.append('a carrier of frequency omega has dphi/dt = omega')
        return Stability(rates, growing, f'unstable: {said}; ' + '; '.join(cure))

    def solve(
        self, t: npt.ArrayLike, u0: npt.ArrayLike, *, rtol: float = 1e-10,
        max_step: float | None = None,
    ) -> FloatArray:
        """
        Return amplitude, phase and power at the given times.

        Constant coefficients: the closed form. Time-varying ones: LSODA, which
        bears stiff coefficients.

        t in s, max_step in s.
        """
        times = check_times(t)
        state = check_state(u0, 3)
        for name, value in (('rtol', rtol), ('max_step', max_step)):
            if value is not None and not value > 0.0:
                raise ValueError(f'{name} must be positive, got {value}')
        with np.errstate(all='ignore'):
            path = (self._closed_form(times - times[0], state) if self.is_constant
                    else self._integrate(times, state, rtol, max_step))
        if not np.isfinite(path).all():
            first = int(np.flatnonzero(~np.isfinite(path).all(axis=1))[0])
            raise ValueError(
                f'the solution overflows at t = {times[first]:g} s: '
                f'{self.stability(float(times[0])).text}')
        return path

    def _closed_form(self, t: FloatArray, u0: FloatArray) -> FloatArray:
        """Return the solution for constant coefficients at times since `u0`, s."""
        alpha, omega, beta, power = self._at(0.0)
        amplitude = u0[0] * np.exp(-alpha * t)
        phase = u0[1] * np.exp(omega * t) if self.phase == 'printed' else u0[1] + omega * t
        # (exp(x t) - exp(y t)) / (x - y), which is t exp(x t) where the two rates meet.
        larger, gap = max(-alpha, power), abs(alpha + power)
        mixed = np.exp(larger * t) * (-np.expm1(-gap * t) / gap if gap else t)
        return np.stack([
            amplitude, phase, u0[2] * np.exp(power * t) + beta * u0[0] * mixed], axis=1)

    def _integrate(
        self, t: FloatArray, u0: FloatArray, rtol: float, max_step: float | None,
    ) -> FloatArray:
        """Return the solution for time-varying coefficients."""
        span = float(t[-1] - t[0])
        if span == 0.0:
            return np.tile(u0, (t.size, 1))

        def velocity(now: float, u: FloatArray) -> FloatArray:
            return self.matrix(now) @ u + self.offset(now)

        # solve_ivp wants each time once.
        once, where = np.unique(t, return_inverse=True)
        scale = np.maximum(np.abs(u0), 1e-6 * max(1.0, float(np.abs(u0).max())))
        solution = solve_ivp(
            velocity, (t[0], t[-1]), u0, method='LSODA', t_eval=once, rtol=rtol,
            atol=rtol * scale, max_step=max_step or span / 100.0)
        if not solution.success:
            raise ValueError(
                f'the integration stopped at t = {solution.t[-1] if solution.t.size else t[0]:g}'
                f' s: {solution.message}')
        return np.asarray(solution.y.T[where])
