"""
A rail of a power network at one throttle: poles, variance, density, OU.

The network is linear about its operating point, dx = A x dt + B dW, and the rail's deviation is
c x.  Noise is coloured, with one state per source, so that the variance stays finite where a
capacitor's ESR turns current directly into voltage.

Effect of more bulk capacitance.  Without LC filter the bus carries the ESC
current through |Z(f)|^2 = R^2 (1 + (w r C)^2) / (1 + (w (R + r) C)^2), which
falls with C at every frequency: Var_inf falls for noise of any colour, on both
rails, and so does the pole 1/((R + r) C), although the paper's section 4.5 says that alpha
rises.  These poles are fast: with 40 mOhm the paper's 63 1/s would take 0.4 F.
Exceptions:

- Slow noise.  When the noise relaxes more slowly than the pole (a small C, or
  flutter), alpha is the rate of the noise and does not move with C.
- ESR.  With r fixed, fast noise leaves (R r / (R + r))^2 times its variance
  however large C is, and the pole carries less and less of it; below
  1 %, alpha jumps up to the next pole, the rate of the noise.  With r C
  fixed (capacitors of one series in parallel), neither happens on the
  bus.
- LC filter.  C shorts the battery resistance that damps L; the resonance rises,
  and where it is excited Var_inf of either rail may rise with C.  A constant-power
  regulator can then turn it into an oscillation.

"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.paper.network.components import Load, load_at, PowerNetwork, RAILS
from ou_monitor.records import FloatArray
from scipy.linalg import solve_continuous_lyapunov

# A pole counts as excited when its share of Var_inf is at least this.
EXCITED = 0.01
# Noise currents are the last states, in this order.
SOURCES = ('switching', 'flutter', 'mcu')
ComplexArray = npt.NDArray[np.complex128]


class UnstableNetworkError(ValueError):
    """The network has a pole in the right half-plane; the text names it."""


@dataclass(frozen=True)
class RailResonance:
    """A complex pair of poles."""

    frequency: float  # |p| / (2 pi), Hz.
    damping: float  # Damping ratio -Re p / |p|, 0..1.
    share: float  # Its part of Var_inf; parts of overlapping modes may exceed 1 or be negative.

    @property
    def q(self) -> float:
        """Quality factor, 1 / (2 damping)."""
        return 0.5 / self.damping


@dataclass(frozen=True)
class Rail:
    """One rail at one throttle, as `rail_at` returns it."""

    network: PowerNetwork  # Components.
    load: Load  # Load and mean voltages.
    name: str  # ``bus`` or ``regulated``.
    a: FloatArray  # Rates between the states (voltages, V, and currents, A), 1/s and mixed.
    b: FloatArray  # Intensities of the independent white noises that drive the sources.
    c: FloatArray  # The rail's deviation from its mean, V, is c x.

    @property
    def mean(self) -> float:
        """Mean voltage of the rail, V."""
        return self.load.mean(self.name)

    @property
    def source_rates(self) -> FloatArray:
        """Rates of the noise sources, 1/s, shape (3,), in the order of `SOURCES`."""
        return np.asarray(-np.diag(self.a)[-len(SOURCES):])

    @cached_property
    def covariance(self) -> FloatArray:
        """Stationary covariance of the states, shape (n, n), by Lyapunov's equation."""
        p = solve_continuous_lyapunov(self.a, -self.b @ self.b.T)
        return np.asarray(0.5 * (p + p.T))

    @cached_property
    def var_inf(self) -> float:
        """Stationary variance of the rail, V^2."""
        return max(0.0, float(self.c @ self.covariance @ self.c))

    @cached_property
    def _modes(self) -> tuple[ComplexArray, ComplexArray]:
        """Poles, slowest first, and their parts of the covariance at lag 0, V^2."""
        poles, vectors = np.linalg.eig(self.a)
        parts = (self.c @ vectors) * np.linalg.solve(vectors, self.covariance @ self.c)
        order = np.argsort(np.abs(poles.real), kind='stable')
        return (np.asarray(poles[order], dtype=np.complex128),
                np.asarray(parts[order], dtype=np.complex128))

    @property
    def poles(self) -> ComplexArray:
        """Poles, 1/s, shape (n,), slowest first, including the noise sources' poles."""
        return self._modes[0]

    @property
    def shares(self) -> FloatArray:
        """Share of Var_inf that each pole carries, shape (n,); zeros without noise."""
        if self.var_inf == 0.0:
            return np.zeros(self.poles.size)
        return np.asarray(self._modes[1].real / self.var_inf)

    @cached_property
    def alpha(self) -> float:
        """
        Relaxation rate, 1/s: the slowest pole that carries 1 % of Var_inf or more.

        For a complex pair, the rate of its envelope; NaN without noise.

        """
        excited = np.flatnonzero(np.abs(self.shares) >= EXCITED)
        return float(-self.poles[excited[0]].real) if excited.size else math.nan

    @property
    def tau(self) -> float:
        """Relaxation time 1 / alpha, s."""
        return 1.0 / self.alpha

    @property
    def sigma(self) -> float:
        """Intensity of the OU with this alpha and Var_inf, sqrt(2 alpha Var_inf), V/sqrt(s)."""
        return math.sqrt(2.0 * self.alpha * self.var_inf)

    @property
    def resonance(self) -> RailResonance | None:
        """Return the complex pair that carries most of Var_inf; None when all poles are real."""
        above = np.flatnonzero(self.poles.imag > 1e-9 * np.abs(self.poles))
        if not above.size:
            return None
        k = above[np.argmax(np.abs(self.shares[above]))]
        pole = self.poles[k]
        return RailResonance(frequency=float(abs(pole)) / (2.0 * math.pi),
                             damping=float(-pole.real / abs(pole)),
                             share=2.0 * float(self.shares[k]))

    def crossing_rate(self, voltage: float) -> float:
        """
        Return the rate of passages below a voltage at high levels, 1/s.

        For the whole Gaussian process, not its OU: with d the distance in
        standard deviations, q the quadratic variation of the rail per second
        and v the variance of the smooth part of its slope, the larger of
        q/(2 Var) d/sqrt(2 pi) exp(-d^2/2) (rough paths: Pickands, Trans. AMS
        145 (1969) 51) and sqrt(v/Var)/(2 pi) exp(-d^2/2) (smooth paths: Rice,
        Bell Syst. Tech. J. 24 (1945) 46).  For an OU the first equals the
        rate of its mean first passage.

        voltage in V.
        """
        if self.mean <= voltage:
            return math.inf
        if self.var_inf == 0.0:
            return 0.0
        d = (self.mean - voltage) / math.sqrt(self.var_inf)
        kick = self.c @ self.b
        slope = self.c @ self.a
        rough = float(kick @ kick) / (2.0 * self.var_inf) * d / math.sqrt(2.0 * math.pi)
        smooth = math.sqrt(max(0.0, float(slope @ self.covariance @ slope)) / self.var_inf)
        return max(rough, smooth / (2.0 * math.pi)) * math.exp(-0.5 * d * d)


def rail_at(network: PowerNetwork, throttle: float, rail: str = 'bus') -> Rail:
    """Return a rail of a network at a throttle."""
    if rail not in RAILS:
        raise ValueError(f"rail must be 'bus' or 'regulated', got {rail!r}")
    load = load_at(network, throttle)
    a, outputs = _circuit(network, load.input_conductance)
    b = np.zeros((a.shape[0], len(SOURCES)))
    rms = (load.switching_rms, load.flutter_rms, network.mcu_noise)
    rates = (load.switching_rate, network.flutter_rate, network.mcu_noise_rate)
    for k, (size, rate) in enumerate(zip(rms, rates)):
        row = a.shape[0] - len(SOURCES) + k
        a[row, row] = -rate
        b[row, k] = size * math.sqrt(2.0 * rate)
    poles = np.linalg.eigvals(a)
    worst = poles[np.argmax(poles.real)]
    if worst.real >= 0.0:
        raise UnstableNetworkError(
            f'the network is unstable at throttle {throttle:g}: pole at {worst.real:.4g} '
            f'+- {abs(worst.imag):.4g}i 1/s; the regulator as a constant-power load is a negative '
            f'resistance of {-1.0 / load.input_conductance:.4g} Ohm at its input: damp the filter '
            '(raise filter_resistance or filter_esr) or raise filter_capacitance')
    return Rail(network, load, rail, a, b, outputs[rail])


def _circuit(net: PowerNetwork, g: float) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the rates of the states, without the noise sources', and the rails as rows."""
    filtered = net.filter_inductance > 0.0
    names = ['bulk', *(['inductor', 'filter'] if filtered else []), 'line', 'output', *SOURCES]
    unit = dict(zip(names, np.eye(len(names))))
    rate = {name: np.zeros(len(names)) for name in names}
    r, esr = net.battery_resistance, net.bulk_esr
    drawn = unit['switching'] + unit['flutter']
    if filtered:
        current = unit['inductor']
        bus = (r * unit['bulk'] - r * esr * (drawn + current)) / (r + esr)
        # The capacitor's current is the inductor's less -g v of the regulator.
        source = (unit['filter'] + net.filter_esr * current) / (1.0 - net.filter_esr * g)
        rate['inductor'] = (bus - net.filter_resistance * current - source) / net.filter_inductance
        rate['filter'] = (current + g * source) / net.filter_capacitance
    else:
        bus = source = (r * unit['bulk'] - r * esr * drawn) / (r + esr - r * esr * g)
        current = -g * source
    rate['bulk'] = (-bus / r - drawn - current) / net.bulk_capacitance
    # `line` is the part of its input that the regulator rejects; the rest passes.
    rate['line'] = 2.0 * math.pi * net.regulator_bandwidth * (source - unit['line'])
    passed = net.line_feedthrough * (source - unit['line'])
    ro, eso = net.regulator_resistance, net.output_esr
    regulated = (ro * unit['output'] + eso * passed - ro * eso * unit['mcu']) / (ro + eso)
    rate['output'] = ((passed - regulated) / ro - unit['mcu']) / net.output_capacitance
    return np.array([rate[name] for name in names]), {'bus': bus, 'regulated': regulated}
