"""Hidden effects of the load: sag, transients, and what throttle does to sigma and alpha."""

import math

from hidden_circuit import Bench, REFERENCE_TIME
from hidden_registry import effect
import numpy as np

TYPICAL_INNOVATION = 12e-3      # V at 1 kHz: middle of what is drawn
# Evidence for an effect of load that a minute must have even in a quiet flight, nats.
LEAST_NATS = 25.0
BOTH = ('load_sag', 'load_transient')


def _battery(bench: Bench, gain: float) -> tuple[float, float, dict[str, float]]:
    """Draw a battery and motors; return ohm, ampere at full throttle, and the parameters."""
    # The sag at full throttle is 0.15..0.4 V on a rail of ordinary noise, less on a quiet one and
    # more on a noisy one: as the square root, which is half way between equal volts and equal
    # evidence.
    sag = gain * bench.draw.uniform(0.15, 0.4) * math.sqrt(
        bench.reference_innovation / TYPICAL_INNOVATION)
    ohm = float(np.exp(bench.draw.uniform(math.log(4e-3), math.log(30e-3))))
    return ohm, sag / ohm, {'battery_ohm': ohm, 'full_current_a': sag / ohm,
                            'sag_v_per_unit': sag}


def _drop(bench: Bench, drop: np.ndarray, found: dict[str, float]) -> None:
    """Put a voltage drop (V, fine grid) in series with the rail and note its log-likelihood."""
    bench.series.append(-drop)
    found['nats'] = bench.nats(drop)
    found['nats_beyond_sag'] = bench.nats(drop, bench.throttle)


def _transient(bench: Bench, gain: float, drop: np.ndarray, found: dict[str, float]) -> None:
    """Do the same for a transient, with heavier motors if the flight would not show it."""
    enough = LEAST_NATS * gain**2 * bench.duration / REFERENCE_TIME
    more = max(1.0, math.sqrt(enough / bench.nats(drop, bench.throttle)))
    for key in ('full_current_a', 'sag_v_per_unit'):
        found[key] *= more
    _drop(bench, more * drop, found)


@effect('load_sag')
def sag(bench: Bench, gain: float) -> dict[str, object]:
    """Let the motor current, linear in throttle, flow through the battery's resistance."""
    ohm, ampere, found = _battery(bench, gain)
    _drop(bench, ohm * ampere * bench.throttle, found)
    return {**found, 'exponent': 1.0}


@effect('load_sag/power_1.5')
def sag_curved(bench: Bench, gain: float) -> dict[str, object]:
    """Let the current rise as throttle^1.5, between thrust and power of a propeller."""
    ohm, ampere, found = _battery(bench, 1.15 * gain)
    _drop(bench, ohm * ampere * bench.throttle**1.5, found)
    return {**found, 'exponent': 1.5}


@effect('load_sag/quadratic')
def sag_quadratic(bench: Bench, gain: float) -> dict[str, object]:
    """Let the current rise as throttle squared."""
    ohm, ampere, found = _battery(bench, 1.3 * gain)
    _drop(bench, ohm * ampere * bench.throttle**2, found)
    return {**found, 'exponent': 2.0}


@effect('load_sag/growing', also=(('drift', 'load_sag'),))
def sag_growing(bench: Bench, gain: float) -> dict[str, object]:
    """Let the resistance change with the charge drawn: a pack empties, or it warms up."""
    ohm, ampere, found = _battery(bench, gain)
    ratio = bench.draw.uniform(1.6, 2.2)**bench.draw.choice([-1.0, 1.0])
    exponent = bench.draw.uniform(1.0, 2.0)
    current = ampere * bench.throttle**exponent
    drawn = np.cumsum(np.where(bench.time > 0.0, current, 0.0))
    _drop(bench, ohm * (1.0 + (ratio - 1.0) * drawn / drawn[-1]) * current, found)
    return {**found, 'exponent': exponent, 'ratio': ratio}


@effect('load_sag/at_capacitor', also=(BOTH, ('load_transient',)))
def sag_at_capacitor(bench: Bench, gain: float) -> dict[str, object]:
    """Draw the current at the rail's own capacitor: the sag is reached at the rate alpha."""
    _, _, found = _battery(bench, 1.2 * gain)
    volts = found['sag_v_per_unit']
    bench.setpoint = -volts * bench.throttle
    return {'sag_v_per_unit': volts, 'full_current_a': volts / bench.resistance,
            'nats': bench.nats(bench.lagged(bench.setpoint, 1 / bench.alpha0))}


def _lag(bench: Bench, gain: float) -> dict[str, object]:
    """Let the motor current follow the command as the inertia of the propeller lets it."""
    ohm, ampere, found = _battery(bench, 1.2 * gain)
    time = bench.draw.uniform(0.025, 0.09)
    _transient(bench, gain, ohm * bench.lagged(ampere * bench.throttle, time), found)
    return {**found, 'shape': 'lag', 'motor_time_s': time}


def _inrush(bench: Bench, gain: float) -> dict[str, object]:
    """Add the current that speeds the propeller up: a dip of about twice the steady sag."""
    ohm, ampere, found = _battery(bench, gain)
    time, extra = bench.draw.uniform(0.025, 0.06), bench.draw.uniform(0.6, 1.3)
    current = ampere * (bench.throttle + extra * (
        bench.throttle - bench.lagged(bench.throttle, time)))
    _transient(bench, gain, ohm * current, found)
    return {**found, 'shape': 'inrush', 'inrush_time_s': time, 'inrush_over_steady': extra}


def _polarisation(bench: Bench, gain: float) -> dict[str, object]:
    """Put the battery's charge transfer, R1 parallel to C1, behind its ohmic resistance."""
    ohm, ampere, found = _battery(bench, gain)
    ratio, time = bench.draw.uniform(0.6, 1.2), bench.draw.uniform(2.0, 9.0)
    _transient(bench, gain, ohm * ampere * (
        bench.throttle + ratio * bench.lagged(bench.throttle, time)), found)
    return {**found, 'shape': 'polarisation', 'polarisation_ohm': ratio * ohm,
            'polarisation_farad': time / (ratio * ohm), 'polarisation_time_s': time}


@effect('load_transient', truth=BOTH, also=(('load_transient',),))
def transient(bench: Bench, gain: float) -> dict[str, object]:
    """Realise one of three: motor lag, inrush, polarisation. Each comes with its sag."""
    return [_lag, _inrush, _polarisation][bench.draw.integers(3)](bench, gain)


effect('load_transient/low_pass', truth=BOTH, also=(('load_transient',),))(_lag)


@effect('load_transient/two_pole', truth=BOTH, also=(('load_transient',),))
def transient_two_pole(bench: Bench, gain: float) -> dict[str, object]:
    """Let ESC and propeller delay the current, one pole each."""
    ohm, ampere, found = _battery(bench, 1.2 * gain)
    esc, motor = bench.draw.uniform(0.015, 0.04), bench.draw.uniform(0.02, 0.06)
    current = bench.lagged(bench.lagged(ampere * bench.throttle, esc), motor)
    _transient(bench, gain, ohm * current, found)
    return {**found, 'esc_time_s': esc, 'motor_time_s': motor}


@effect('load_transient/delay', truth=BOTH, also=(('load_transient',),))
def transient_delay(bench: Bench, gain: float) -> dict[str, object]:
    """Let the command need some time to reach the ESC."""
    ohm, ampere, found = _battery(bench, gain)
    late = bench.draw.uniform(0.01, 0.05)
    steps = int(round(late / bench.h))
    current = ampere * np.concatenate(
        [np.full(steps, bench.throttle[0]), bench.throttle[:-steps]])
    _transient(bench, gain, ohm * current, found)
    return {**found, 'delay_s': late}


@effect('load_transient/asymmetric', truth=BOTH, also=(('load_transient',),))
def transient_asymmetric(bench: Bench, gain: float) -> dict[str, object]:
    """Let the propeller speed up quickly and coast down slowly."""
    ohm, ampere, found = _battery(bench, 1.2 * gain)
    up, down = bench.draw.uniform(0.015, 0.035), bench.draw.uniform(0.08, 0.2)
    rise, fall = 1 - math.exp(-bench.h / up), 1 - math.exp(-bench.h / down)
    state, out = float(bench.throttle[0]), []
    for command in bench.throttle.tolist():
        state += (rise if command > state else fall) * (command - state)
        out.append(state)
    _transient(bench, gain, ohm * ampere * np.array(out), found)
    return {**found, 'spin_up_s': up, 'coast_down_s': down}


@effect('load_transient/regulator', truth=('load_transient',))
def transient_regulator(bench: Bench, gain: float) -> dict[str, object]:
    """Sense behind a regulator, which corrects every step of the load within its loop time."""
    ohm, ampere, found = _battery(bench, 1.3 * gain)
    time = bench.draw.uniform(0.08, 0.4)
    high = bench.throttle - bench.lagged(bench.throttle, time)
    _transient(bench, gain, ohm * ampere * high, found)
    return {**found, 'loop_time_s': time, 'sag_v_per_unit': 0.0}


@effect('load_transient/inductive', truth=BOTH, also=(('load_transient',),), substeps=16)
def transient_inductive(bench: Bench, gain: float) -> dict[str, object]:
    """Feed the ESC capacitor through inductive leads: L di/dt, then ringing."""
    ohm, ampere, found = _battery(bench, gain)
    ring, damping = bench.draw.uniform(25.0, 80.0), bench.draw.uniform(0.15, 0.4)
    omega = 2 * math.pi * ring
    # Z(s) = (R + s L)/(1 + s R C + s^2 L C), with 2 damping/omega = R C and L C = 1/omega^2.
    farad = 2 * damping / (omega * ohm)
    henry = 1 / (omega**2 * farad)
    current = bench.lagged(ampere * bench.throttle, 0.004)
    drop = bench.filtered(current, [henry, ohm], [henry * farad, ohm * farad, 1.0])
    _transient(bench, gain, drop, found)
    return {**found, 'lead_henry': henry, 'esc_farad': farad, 'ring_hz': ring,
            'damping_ratio': damping}


def _intensity(bench: Bench, curve: np.ndarray) -> dict[str, object]:
    """Scale the noise by a curve over the load; its rms over the flight stays at the rail's."""
    curve = curve / math.sqrt(np.mean(curve**2))
    bench.sigma = bench.sigma * curve
    return {'sigma_low': float(np.min(bench.sigma)), 'sigma_high': float(np.max(bench.sigma)),
            'ratio': float(np.max(curve) / np.min(curve)),
            'pulse_current_a_sqrt_s': float(np.max(bench.sigma)) * bench.capacitance}


@effect('load_dependent_sigma')
def sigma_of_load(bench: Bench, gain: float) -> dict[str, object]:
    """Let the current pulses of the ESCs grow with throttle: sigma times 2..4 over the range."""
    ratio = bench.draw.uniform(2.0, 4.0)**gain
    return _intensity(bench, 1 + (ratio - 1) * bench.load)


@effect('load_dependent_sigma/step')
def sigma_step(bench: Bench, gain: float) -> dict[str, object]:
    """Let the ESCs change their PWM mode at one throttle."""
    ratio, at = bench.draw.uniform(1.7, 2.8)**gain, float(np.quantile(
        bench.load, bench.draw.uniform(0.3, 0.7)))
    return {**_intensity(bench, np.where(bench.load > at, ratio, 1.0)), 'step_at': at}


@effect('load_dependent_sigma/peak')
def sigma_peak(bench: Bench, gain: float) -> dict[str, object]:
    """Let the ripple be largest at part throttle and fall again towards full."""
    ratio, at = bench.draw.uniform(2.5, 4.0)**gain, bench.draw.uniform(0.5, 0.75)
    bump = np.where(bench.load < at, bench.load / at,
                    1 - 0.7 * (bench.load - at) / (1 - at))
    return {**_intensity(bench, 1 + (ratio - 1) * bump), 'peak_at': at}


@effect('load_dependent_noise', also=(('load_dependent_noise', 'measurement_noise'),))
def noise_of_load(bench: Bench, gain: float) -> dict[str, object]:
    """Let the ADC sample the ripple of the ESCs: an error of its own at each sample."""
    low = bench.draw.uniform(0.15, 0.3) * gain * bench.innovation
    ratio = bench.draw.uniform(3.0, 6.0)
    u = bench.throttle[bench.lead::bench.substeps][:bench.n]
    curve = u * (1.4 - u)
    curve = (curve - curve.min()) / np.ptp(curve)
    std = low * (1.0 + (ratio - 1.0) * curve)
    bench.stage('noise', lambda v: v + std * bench.path.normal(size=v.size))
    return {'std_low_v': low, 'ratio': ratio}


def _rate(bench: Bench, curve: np.ndarray) -> dict[str, object]:
    """Scale the conductance that discharges the rail by a curve around 1."""
    curve = curve / np.mean(curve)
    bench.alpha = bench.alpha0 * curve
    ohm = bench.resistance / curve
    return {'alpha_low': float(bench.alpha.min()), 'alpha_high': float(bench.alpha.max()),
            'resistance_low_ohm': float(ohm.min()), 'resistance_high_ohm': float(ohm.max()),
            'nats': 0.25 * bench.duration * bench.alpha0 * float(np.var(curve))}


def _alpha_ratio(bench: Bench, gain: float) -> float:
    """Draw the ratio of alpha at full load to that at the lowest; up or down."""
    # 1.8..2.4, and up to 4 on a slow rail, of which a minute holds few relaxations: a relative
    # change c(t) of the rate gains T alpha <c^2>/4 nats.
    ratio, sense = float(bench.draw.uniform(1.8, 2.4)), float(bench.draw.choice([-1.0, 1.0]))
    while ratio < 4.0:
        curve = 1 + (ratio**sense - 1) * bench.load
        if 0.25 * REFERENCE_TIME * bench.alpha0 * np.var(curve / curve.mean()) > LEAST_NATS:
            break
        ratio *= 1.05
    return float(ratio**(gain * sense))


@effect('load_dependent_alpha')
def alpha_of_load(bench: Bench, gain: float) -> dict[str, object]:
    """Let the conducting ESCs load the rail: 1/R linear in throttle, x2 or more over the range."""
    ratio = _alpha_ratio(bench, gain)
    return {**_rate(bench, 1 + (ratio - 1) * bench.load), 'ratio': ratio}


@effect('load_dependent_alpha/resistance')
def alpha_of_resistance(bench: Bench, gain: float) -> dict[str, object]:
    """Let R, not 1/R, be linear in throttle (a warming source)."""
    ratio = _alpha_ratio(bench, gain)
    return {**_rate(bench, 1 / (1 + (1 / ratio - 1) * bench.load)), 'ratio': ratio}


@effect('load_dependent_alpha/step')
def alpha_step(bench: Bench, gain: float) -> dict[str, object]:
    """Let a second converter switch in above one throttle."""
    ratio = _alpha_ratio(bench, 0.9 * gain)
    at = float(np.quantile(bench.load, bench.draw.uniform(0.35, 0.65)))
    return {**_rate(bench, np.where(bench.load > at, ratio, 1.0)), 'ratio': ratio,
            'step_at': at}


def _slope(bench: Bench, gain: float) -> tuple[float, dict[str, object]]:
    """Draw a rate of discharge, V/s."""
    # 1..5 mV/s, but not below seven nor above forty standard errors of a slope fitted to a minute
    # of this rail, which is sigma/alpha sqrt(12/T^3).
    error = bench.sigma0 / bench.alpha0 * math.sqrt(12 / REFERENCE_TIME**3)
    slope = float(np.clip(bench.draw.uniform(1e-3, 5e-3), 7 * error, 40 * error)) * gain
    cell = bench.draw.uniform(0.7, 0.9)       # V lost by a lithium cell from full to empty
    cells = max(1, round(bench.level / 3.8))
    ampere_hours = bench.draw.uniform(0.5, 5.0)
    return slope, {'slope_v_s': slope, 'capacity_ah': ampere_hours,
                   'mean_current_a': slope * 3600 * ampere_hours / (cell * cells)}


def _discharge(bench: Bench, volts: np.ndarray, found: dict[str, object]) -> dict[str, object]:
    """Subtract the lost voltage in series."""
    bench.series.append(-volts)
    return {**found, 'nats': bench.nats(volts)}


@effect('drift')
def drift(bench: Bench, gain: float) -> dict[str, object]:
    """Discharge the battery at a constant current along a straight part of its curve."""
    slope, found = _slope(bench, gain)
    return _discharge(bench, slope * bench.time, found)


@effect('drift/exponential')
def drift_exponential(bench: Bench, gain: float) -> dict[str, object]:
    """Let the battery settle from its surface charge, with a time of 12..35 s."""
    slope, found = _slope(bench, gain)
    time = bench.draw.uniform(0.2, 0.6) * REFERENCE_TIME
    lost = slope * REFERENCE_TIME * (1 - np.exp(-np.maximum(bench.time, 0) / time))
    return _discharge(bench, lost, {**found, 'settling_s': time})


@effect('drift/square_root')
def drift_square_root(bench: Bench, gain: float) -> dict[str, object]:
    """Let diffusion in the cell (Warburg) lose voltage as the square root of time."""
    slope, found = _slope(bench, 1.2 * gain)
    lost = slope * REFERENCE_TIME * np.sqrt(np.maximum(bench.time, 0) / REFERENCE_TIME)
    return _discharge(bench, lost, found)
