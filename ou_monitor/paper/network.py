"""
A multirotor's power network: components, the load at a throttle, and a rail as an OU.

    battery -- R --+-- bus --+-- regulator -- Ro --+-- regulated
                   |         |                     |
               ESC current   C + ESR          Co + ESR, MCU current

The network is linear about its operating point, dx = A x dt + B dW, and the rail's deviation is
c x.  Noise is coloured, with one state per source, so that the variance stays finite where a
capacitor's ESR (r) turns current directly into voltage.

Limits: leads have no inductance, so edges faster than L/R (0.1 to 1 us) are not modelled. The
battery is one resistance without polarisation, so recovery over 0.3 s and more is missing. There
is no LC filter before the regulator, which draws constant power: its input has the incremental
resistance -V^2/P. The random part of the ESC current is the Markov switching of the paper, which
spreads the power of a regular PWM over all frequencies: an upper bound, unless `switching_scale`
is set from a measured rail.

More bulk capacitance lowers Var_inf on both rails for noise of any colour, because the impedance
from ESC current to bus, |Z(f)|^2 = R^2 (1 + (w r C)^2) / (1 + (w (R + r) C)^2), falls at every
frequency; and it lowers the pole 1/((R + r) C), although section 4.5 of the paper says that alpha
rises. Exceptions:

- Slow noise.  If the noise relaxes more slowly than the pole (a small C, or flutter), alpha is the
  rate of the noise and does not depend on C.
- ESR.  With r fixed, fast noise of the current causes at least (R r / (R + r))^2 times its own
  variance in the voltage, whatever C is.  As C rises, the pole's share of Var_inf falls; below
  1 %, alpha jumps up to the next pole, the rate of the noise.  With r C fixed (capacitors of one
  series in parallel), neither effect occurs on the bus.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
import math
from typing import Any

import numpy as np
from ou_monitor.records import FloatArray
from scipy.linalg import solve_continuous_lyapunov

RAILS = ('bus', 'regulated')
# Lower limit of the duty: at 0 and 1 a telegraph has no noise and an infinite rate.
LEAST_DUTY = 0.01
# A lithium cell at rest, V.
NOMINAL_CELL = 3.7
# Minimum share of Var_inf for a pole to count as excited.
EXCITED = 0.01
# Noise currents: the last states of the system, in this order.
SOURCES = ('switching', 'flutter', 'mcu')


def completed(values: dict[str, Any]) -> dict[str, Any]:
    """Fill in the battery voltage from cells, and the regulator voltage of a 1S craft."""
    found = dict(values)
    if found.get('cells'):
        found.setdefault('battery_voltage', NOMINAL_CELL * found['cells'])
    if found.get('battery_voltage', math.inf) <= PowerNetwork.regulator_voltage:
        # A craft of one cell, such as a Crazyflie.
        found.setdefault('regulator_voltage', 3.0)
    return found


def _part(default: Any, unit: str = '', *, zero: bool = False) -> Any:
    return field(default=default, metadata={'unit': unit, 'zero': zero})


@dataclass(frozen=True, kw_only=True)
class PowerNetwork:
    """Components in SI units; the defaults are a typical 6S multirotor."""

    # LiPo cells in series; sets the default brown-out level of the bus. 0: the source is a rail.
    cells: int = _part(6, zero=True)
    battery_voltage: float = _part(22.2, 'V')  # Open-circuit voltage, V (6 x 3.7 V nominal).
    # Battery, connector and leads, Ohm (a 6S pack of 1.3..2.2 Ah has 20..60 mOhm; PX4
    # assumes 5 mOhm per cell).
    battery_resistance: float = _part(0.04, 'Ohm')
    # Capacitor at the battery pads of the ESC, F and Ohm (470 uF..1000 uF of a low-ESR 35 V
    # series have 20..40 mOhm).
    bulk_capacitance: float = _part(470e-6, 'F')
    bulk_esr: float = _part(0.03, 'Ohm', zero=True)
    # Mean current of the motors is current_max * throttle**current_exponent, A; 4 x 30 A, exponent
    # 1..3 (typical values; 1.5 puts the largest ripple at a throttle of 2/3; in recordings it is
    # at 0.65..0.75).
    current_max: float = _part(120.0, 'A')
    current_exponent: float = _part(1.5)
    escs: int = _part(4)  # ESCs that switch independently.
    # PWM frequency, Hz (24..48 kHz, the paper's section 4.5).
    esc_frequency: float = _part(48e3, 'Hz')
    # Rms of the random ESC current, relative to the telegraph process.
    switching_scale: float = _part(1.0, zero=True)
    # Slow fluctuation of the motor current (control loop, gusts): rms as a share of the
    # mean, and its rate, 1/s (motor and propeller, 30 ms); off by default.
    flutter: float = _part(0.0, zero=True)
    flutter_rate: float = _part(33.3, '1/s')
    # Output voltage, V (0: no regulator), and output resistance within the bandwidth, Ohm.
    regulator_voltage: float = _part(5.0, 'V', zero=True)
    regulator_resistance: float = _part(0.03, 'Ohm')
    # The regulator rejects changes of its input slower than this, Hz, and multiplies faster ones
    # by `line_gain`.  If that is None, it is the open-loop gain of a buck converter, the duty
    # regulator_voltage / battery_voltage (Erickson & Maksimovic, Power Electronics, section 8.2).
    regulator_bandwidth: float = _part(20e3, 'Hz')
    regulator_efficiency: float = _part(0.9)  # Output power over input power, 0..1.
    line_gain: float | None = _part(None, zero=True)
    # Capacitor of the regulated rail, F and Ohm (2 x 22 uF ceramic).
    output_capacitance: float = _part(44e-6, 'F')
    output_esr: float = _part(0.003, 'Ohm', zero=True)
    # Mean current of the regulated rail, rms of its fluctuation, A, and the fluctuation's
    # relaxation rate, 1/s.
    mcu_current: float = _part(0.5, 'A', zero=True)
    mcu_noise: float = _part(0.05, 'A', zero=True)
    mcu_noise_rate: float = _part(1e6, '1/s')

    def __post_init__(self) -> None:
        """Raise ValueError for values that no component can have."""
        for part in fields(self):
            self._check(part.name, getattr(self, part.name), part.metadata)
        if self.regulator_efficiency > 1.0:
            raise ValueError(
                f'regulator_efficiency must be at most 1, got {self.regulator_efficiency}')
        if self.regulator_voltage >= self.battery_voltage:
            raise ValueError(f'regulator_voltage must be below battery_voltage (a step-down), got '
                             f'{self.regulator_voltage} V of {self.battery_voltage} V')
        if self.current_exponent < 1.0:
            raise ValueError('current_exponent must be at least 1 (the phase current does not '
                             f'rise as throttle falls), got {self.current_exponent}')

    def _check(self, name: str, value: object, about: Mapping[str, Any]) -> None:
        if name == 'line_gain' and value is None:
            return
        unit = f' {about["unit"]}'.rstrip()
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f'{name} must be a number{unit and f" in{unit}"}, got {value!r}')
        if name in ('cells', 'escs') and value != int(value if math.isfinite(value) else 0):
            raise ValueError(f'{name} must be a whole number, got {value}')
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not about['zero']):
            least = 'zero or positive' if about['zero'] else 'positive'
            raise ValueError(f'{name} must be {least} and finite, got {value}{unit}')

    @property
    def line_feedthrough(self) -> float:
        """Gain from the regulator's input to its output above its bandwidth."""
        if self.line_gain is None:
            return self.regulator_voltage / self.battery_voltage
        return self.line_gain

    @property
    def regulator_power(self) -> float:
        """Power that the regulator draws, W."""
        return self.regulator_voltage * self.mcu_current / self.regulator_efficiency

    def current_at(self, throttle: float) -> float:
        """Return the mean current of the motors, A, at a throttle 0..1."""
        return float(self.current_max * throttle**self.current_exponent)


# Units of the numbers of a network.
UNITS = {part.name: part.metadata['unit'] for part in fields(PowerNetwork)}


def _operating_point(network: PowerNetwork, throttle: float) -> tuple[float, float]:
    """Return the mean current of the motors, A, and the mean of the bus, V, at a throttle."""
    if not 0.0 <= throttle <= 1.0:
        raise ValueError(f'throttle must be within 0..1, got {throttle}')
    current, resistance = network.current_at(throttle), network.battery_resistance
    # The bus v solves v = V - R (I + P/v); at the larger solution the network is stable.
    free = network.battery_voltage - resistance * current
    root = free**2 - 4.0 * resistance * network.regulator_power
    bus = (free + math.sqrt(root)) / 2.0 if free > 0.0 and root >= 0.0 else 0.0
    if bus <= network.regulator_voltage:
        raise ValueError(
            f'the battery cannot supply the load at throttle {throttle:g}: {current:.4g} A '
            f'through battery_resistance {resistance:g} Ohm drops {resistance * current:.4g} V of '
            f'{network.battery_voltage:g} V, and at least {network.regulator_voltage:g} V must '
            'remain')
    return current, bus


@dataclass(frozen=True)
class Rail:
    """One rail at one throttle, as `rail_at` returns it."""

    network: PowerNetwork  # Components.
    name: str  # ``bus`` or ``regulated``.
    mean: float  # Mean voltage of the rail, V.
    sag: float  # Battery voltage less the mean of the bus, V.
    # dx = a x dt + b dW for the states x (voltages, V, and currents, A); the deviation of the rail
    # from its mean, V, is c x.
    a: FloatArray
    b: FloatArray
    c: FloatArray

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
    def alpha(self) -> float:
        """Relaxation rate, 1/s: the slowest pole that carries 1 % of Var_inf or more."""
        if self.var_inf == 0.0:
            return math.nan
        poles, vectors = np.linalg.eig(self.a)
        # Part of each pole in the covariance at lag 0, V^2.
        parts = (self.c @ vectors) * np.linalg.solve(vectors, self.covariance @ self.c)
        return float(-poles.real[np.abs(parts.real / self.var_inf) >= EXCITED].max())

    @property
    def tau(self) -> float:
        """Relaxation time 1 / alpha, s."""
        return 1.0 / self.alpha

    @property
    def sigma(self) -> float:
        """Intensity of the OU with this alpha and Var_inf, sqrt(2 alpha Var_inf), V/sqrt(s)."""
        return math.sqrt(2.0 * self.alpha * self.var_inf)

    def crossing_rate(self, voltage: float) -> float:
        """Return the rate, 1/s, at which the rail falls below a voltage, V, far from its mean."""
        # The larger of two rates of the full Gaussian process, not only of its OU. For rough paths
        # it is q/(2 Var) d/sqrt(2 pi) exp(-d^2/2) (Pickands, Trans. AMS 145 (1969) 51), for smooth
        # paths sqrt(v/Var)/(2 pi) exp(-d^2/2) (Rice, Bell Syst. Tech. J. 24 (1945) 46). d:
        # distance to the voltage in standard deviations; q: quadratic variation per second; v:
        # variance of the smooth part of the slope. For an OU, the first rate is the inverse of the
        # mean first-passage time.
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
    if rail == 'regulated' and not network.regulator_voltage:
        raise ValueError('there is no regulated rail: regulator_voltage is 0')
    current, bus = _operating_point(network, throttle)
    # An ESC draws the phase current I_m during the on-time of its PWM only, so its mean is
    # I = D I_m with the duty D = throttle. As a telegraph process with f cycles per second it has
    # the variance I_m^2 D (1 - D) and a covariance that decays at f / (D (1 - D)). At a duty of
    # zero there is no current and no noise.
    duty = min(max(throttle, LEAST_DUTY), 1.0 - LEAST_DUTY)
    phase = current / throttle / network.escs if throttle > 0.0 else 0.0
    switching = network.switching_scale * phase * math.sqrt(
        network.escs * throttle * (1.0 - throttle))
    a, outputs = _circuit(network, network.regulator_power / bus**2)
    b = np.zeros((a.shape[0], len(SOURCES)))
    for k, (rms, rate) in enumerate((
            (switching, network.esc_frequency / (duty * (1.0 - duty))),
            (network.flutter * current, network.flutter_rate),
            (network.mcu_noise, network.mcu_noise_rate))):
        row = a.shape[0] - len(SOURCES) + k
        a[row, row] = -rate
        b[row, k] = rms * math.sqrt(2.0 * rate)
    mean = bus if rail == 'bus' else (
        network.regulator_voltage - network.regulator_resistance * network.mcu_current)
    return Rail(network, rail, mean, network.battery_voltage - bus, a, b, outputs[rail])


def _circuit(net: PowerNetwork, g: float) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return the matrix `a`, with zeros for the noise sources, and the row `c` of each rail."""
    # g: incremental conductance P/V^2 of the regulator's input, 1/Ohm.
    names = ['bulk', 'line', 'output', *SOURCES]
    unit = dict(zip(names, np.eye(len(names))))
    rate = {name: np.zeros(len(names)) for name in names}
    r, esr = net.battery_resistance, net.bulk_esr
    drawn = unit['switching'] + unit['flutter']
    bus = (r * unit['bulk'] - r * esr * drawn) / (r + esr - r * esr * g)
    rate['bulk'] = (-bus / r - drawn + g * bus) / net.bulk_capacitance
    # `line` is the slow part of the bus, which the regulator rejects.
    rate['line'] = 2.0 * math.pi * net.regulator_bandwidth * (bus - unit['line'])
    passed = net.line_feedthrough * (bus - unit['line'])
    ro, eso = net.regulator_resistance, net.output_esr
    regulated = (ro * unit['output'] + eso * passed - ro * eso * unit['mcu']) / (ro + eso)
    rate['output'] = ((passed - regulated) / ro - unit['mcu']) / net.output_capacitance
    return np.array([rate[name] for name in names]), {'bus': bus, 'regulated': regulated}
