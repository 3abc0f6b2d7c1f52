"""
The components of a multirotor's power network, and the load at a throttle.

    battery -- R --+-- bus --+-- [ L, DCR --+-- filter ] --+-- regulator -- Ro --+-- regulated
                   |         |              |                                    |
               ESC current   C + ESR        Cf + ESR                   Co + ESR, MCU current

Limits: linear about the operating point.  Leads have no inductance, so edges faster than R/L
(0.1 to 1 us) are not modelled.  The battery is one resistance without polarisation, so recovery
over 0.3 s and more is missing.  The random part of the ESC current is the paper's Markov
switching, which spreads over all frequencies the power that a regular PWM keeps at its multiples:
it is an upper bound until `switching_scale` is set from a measured rail.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
import math
from typing import Any

RAILS = ('bus', 'regulated')
# Fields that may be zero; all others must be positive.
MAY_BE_ZERO = frozenset({
    'bulk_esr', 'filter_inductance', 'filter_resistance', 'filter_esr', 'line_gain', 'output_esr',
    'mcu_current', 'mcu_noise', 'switching_scale', 'flutter'})
UNITS = {
    'battery_voltage': 'V', 'battery_resistance': 'Ohm', 'bulk_capacitance': 'F',
    'bulk_esr': 'Ohm', 'current_max': 'A', 'current_exponent': '', 'esc_frequency': 'Hz',
    'switching_scale': '', 'flutter': '', 'flutter_rate': '1/s', 'filter_inductance': 'H',
    'filter_resistance': 'Ohm', 'filter_capacitance': 'F', 'filter_esr': 'Ohm',
    'regulator_voltage': 'V', 'regulator_resistance': 'Ohm', 'regulator_bandwidth': 'Hz',
    'regulator_efficiency': '', 'line_gain': '', 'output_capacitance': 'F', 'output_esr': 'Ohm',
    'mcu_current': 'A', 'mcu_noise': 'A', 'mcu_noise_rate': '1/s', 'cells': '', 'escs': ''}
# Lower limit of the duty: at 0 and 1 a telegraph has no noise and an infinite rate.
LEAST_DUTY = 0.01
# A lithium cell at rest, V.
NOMINAL_CELL = 3.7


def completed(values: dict[str, Any]) -> dict[str, Any]:
    """Return components with derived values: voltage from cells, a rail below a cell."""
    found = dict(values)
    if 'cells' in found:
        found.setdefault('battery_voltage', NOMINAL_CELL * found['cells'])
    if found.get('battery_voltage', math.inf) <= PowerNetwork.regulator_voltage:
        # The rail of a Crazyflie.
        found.setdefault('regulator_voltage', 3.0)
    return found


@dataclass(frozen=True, kw_only=True)
class PowerNetwork:
    """Components in SI units; the defaults are a typical 6S multirotor."""

    cells: int = 6  # LiPo cells in series; sets the default brown-out level of the bus.
    battery_voltage: float = 22.2  # Open-circuit voltage, V (6 x 3.7 V nominal).
    # Battery, connector and leads, Ohm (a 6S pack of 1.3..2.2 Ah has 20..60 mOhm; PX4
    # assumes 5 mOhm a cell).
    battery_resistance: float = 0.04
    # Capacitor at the ESC's battery pads, F and Ohm (470 uF..1000 uF of a low-ESR 35 V
    # series have 20..40 mOhm).
    bulk_capacitance: float = 470e-6
    bulk_esr: float = 0.03
    # Mean current of the motors is current_max * throttle**current_exponent, A; 4 x 30 A,
    # exponent 1..3 (typical values; 1.5 puts the most ripple at a throttle of 2/3,
    # recordings show 0.65..0.75).
    current_max: float = 120.0
    current_exponent: float = 1.5
    escs: int = 4  # ESCs that switch independently.
    esc_frequency: float = 48e3  # PWM frequency, Hz (24..48 kHz, the paper's section 4.5).
    # Measured rms of the random ESC current over the telegraph's; 1 is the telegraph.
    switching_scale: float = 1.0
    # Slow fluctuation of the motor current (control loop, gusts): rms as a share of the
    # mean, and its rate, 1/s (motor and propeller, 30 ms). Left out by default.
    flutter: float = 0.0
    flutter_rate: float = 33.3
    # Optional LC filter between bus and regulator, H, Ohm, F, Ohm; without it the inductance is 0;
    # the two resistances damp it.
    filter_inductance: float = 0.0
    filter_resistance: float = 0.05
    filter_capacitance: float = 100e-6
    filter_esr: float = 0.1
    # Set voltage, V, and output resistance within the bandwidth, Ohm.
    regulator_voltage: float = 5.0
    regulator_resistance: float = 0.03
    # The regulator rejects changes of its input slower than this, Hz, and passes faster ones times
    # `line_gain`; None: the duty of a buck converter, regulator_voltage over battery_voltage,
    # which is its open-loop gain (Erickson & Maksimovic, Fundamentals of Power Electronics,
    # section 8.2).
    regulator_bandwidth: float = 20e3
    regulator_efficiency: float = 0.9  # Output power over input power, 0..1.
    line_gain: float | None = None
    # Whether the regulator draws constant power: its input then has the incremental resistance
    # -V^2/P.
    constant_power: bool = True
    # Capacitor of the regulated rail, F and Ohm (2 x 22 uF ceramic).
    output_capacitance: float = 44e-6
    output_esr: float = 0.003
    # Mean current of the regulated rail, rms of its fluctuation, A, and the fluctuation's
    # relaxation rate, 1/s.
    mcu_current: float = 0.5
    mcu_noise: float = 0.05
    mcu_noise_rate: float = 1e6

    def __post_init__(self) -> None:
        """Refuse values that no component can have."""
        for field in fields(self):
            self._check(field.name, getattr(self, field.name))
        if self.regulator_efficiency > 1.0:
            raise ValueError(
                f'regulator_efficiency must be at most 1, got {self.regulator_efficiency}')
        if self.regulator_voltage >= self.battery_voltage:
            raise ValueError(f'regulator_voltage must be below battery_voltage (a step-down), got '
                             f'{self.regulator_voltage} V of {self.battery_voltage} V')
        if self.current_exponent < 1.0:
            raise ValueError('current_exponent must be at least 1 (the phase current does not '
                             f'rise as throttle falls), got {self.current_exponent}')

    def _check(self, name: str, value: object) -> None:
        if name == 'line_gain' and value is None:
            return
        if name == 'constant_power':
            if not isinstance(value, bool):
                raise ValueError(f'constant_power must be true or false, got {value!r}')
            return
        unit = f' {UNITS[name]}'.rstrip()
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise ValueError(f'{name} must be a number{unit and f" in{unit}"}, got {value!r}')
        if name in ('cells', 'escs') and value != int(value if math.isfinite(value) else 0):
            raise ValueError(f'{name} must be a whole number, got {value}')
        zero = name in MAY_BE_ZERO
        if not math.isfinite(value) or value < 0.0 or (value == 0.0 and not zero):
            raise ValueError(f"{name} must be {'zero or ' if zero else ''}positive and finite, "
                             f'got {value}{unit}')

    @property
    def lc_corner(self) -> float:
        """Corner 1/(2 pi sqrt(L C)) of the LC filter, Hz; inf without one."""
        if self.filter_inductance == 0.0:
            return math.inf
        return 1.0 / (2.0 * math.pi * math.sqrt(self.filter_inductance * self.filter_capacitance))

    @property
    def line_feedthrough(self) -> float:
        """Gain of the regulator from its input to its output above its bandwidth."""
        if self.line_gain is None:
            return self.regulator_voltage / self.battery_voltage
        return self.line_gain

    @property
    def regulator_power(self) -> float:
        """Power that the regulator draws, W."""
        return self.regulator_voltage * self.mcu_current / self.regulator_efficiency

    @property
    def series_resistance(self) -> float:
        """Resistance between bus and regulator, Ohm; 0 without LC filter."""
        return self.filter_resistance if self.filter_inductance > 0.0 else 0.0

    def current_at(self, throttle: float) -> float:
        """Return the mean current of the motors, A, at a throttle 0..1."""
        return float(self.current_max * throttle**self.current_exponent)

    def regulator_current(self, bus: float) -> float:
        """Return the mean current, A, that the regulator draws at a mean bus voltage, V."""
        power = self.regulator_power
        root = bus**2 - 4.0 * self.series_resistance * power
        if bus <= 0.0 or root < 0.0:
            raise ValueError(f'a bus at {bus:g} V cannot give the regulator {power:g} W')
        return 2.0 * power / (bus + math.sqrt(root))


@dataclass(frozen=True)
class Load:
    """The load and the mean voltages at one throttle."""

    throttle: float  # 0..1.
    current: float  # Mean current of the motors, A.
    # Random ESC current: rms, A, and rate of its exponential covariance, 1/s.
    switching_rms: float
    switching_rate: float
    flutter_rms: float  # Rms of the slow fluctuation of the current, A.
    # Mean voltages, V.
    bus: float
    regulated: float
    sag: float  # Battery voltage less the mean of the bus, V.
    # Incremental conductance P/V^2 of the constant-power load, 1/Ohm, counted positive; otherwise
    # 0.
    input_conductance: float

    def mean(self, rail: str) -> float:
        """Return the mean of a rail, V."""
        return {'bus': self.bus, 'regulated': self.regulated}[rail]


def load_at(network: PowerNetwork, throttle: float) -> Load:
    """
    Return the load at a throttle.

    An ESC draws the phase current I_m during the on-time of its PWM and
    nothing else, so that the mean is I = D I_m with the duty D = throttle.  As
    a telegraph with f cycles per second it has the variance I_m^2 D (1 - D) and
    a covariance that decays at f / (D (1 - D)).
    """
    if not 0.0 <= throttle <= 1.0:
        raise ValueError(f'throttle must be within 0..1, got {throttle}')
    current = network.current_at(throttle)
    duty = min(max(throttle, LEAST_DUTY), 1.0 - LEAST_DUTY)
    # Phase current of one ESC; zero duty has no current and no noise.
    phase = current / throttle / network.escs if throttle > 0.0 else 0.0
    rms = network.switching_scale * phase * math.sqrt(
        network.escs * throttle * (1.0 - throttle))
    power = network.regulator_power
    resistance = network.battery_resistance
    # The regulator's input v solves v = V - R (I + P/v) - series P/v.
    free = network.battery_voltage - resistance * current
    root = free**2 - 4.0 * (resistance + network.series_resistance) * power
    source = (free + math.sqrt(root)) / 2.0 if free > 0.0 and root >= 0.0 else 0.0
    if source <= network.regulator_voltage:
        raise ValueError(
            f'the battery cannot give the load at throttle {throttle:g}: {current:.4g} A through '
            f'battery_resistance {resistance:g} Ohm takes {resistance * current:.4g} V of '
            f'{network.battery_voltage:g} V and leaves the regulator less than '
            f'{network.regulator_voltage:g} V')
    drawn = power / source
    bus = free - resistance * drawn
    return Load(
        throttle=throttle, current=current, switching_rms=rms,
        switching_rate=network.esc_frequency / (duty * (1.0 - duty)),
        flutter_rms=network.flutter * current, bus=bus,
        regulated=network.regulator_voltage - network.regulator_resistance * network.mcu_current,
        sag=network.battery_voltage - bus,
        input_conductance=power / source**2 if network.constant_power else 0.0)
