"""Hidden lines: ringing, tones of converters, and tones of the motors."""

import math

from hidden_circuit import Bench, REFERENCE_TIME
from hidden_registry import effect
import numpy as np

# Evidence, in nats, of a tone in a minute at 1 kHz at the edge of being found: the look-elsewhere
# price, ln(n/2) = 10, and half as much again. This is 0.8 mV on a rail of 17 mV innovation.
FLOOR_NATS = 15.0


def _shape(bench: Bench, hertz: float) -> float:
    """Return |1 - phi exp(-i w dt)|: what whitening the rail does to a line."""
    return abs(1 - bench.phi * np.exp(-2j * np.pi * hertz / bench.rate))


def _floor(bench: Bench, hertz: float) -> float:
    """Return the amplitude (V) of a line at the edge of being found in a minute."""
    n = REFERENCE_TIME * bench.rate
    return 2 * bench.innovation * math.sqrt(FLOOR_NATS / n) / _shape(bench, hertz)


def _alias(hertz: float, rate: float) -> float:
    """Return the frequency at which a line shows in samples taken at `rate`."""
    return abs(hertz - rate * round(hertz / rate))


def _visible(bench: Bench, low: float, high: float) -> float:
    """Draw a frequency, Hz, whose alias is neither near zero nor near half the rate."""
    while True:
        hertz = float(bench.draw.uniform(low, high))
        if min(20.0, 0.05 * bench.rate) < _alias(hertz, bench.rate) < 0.45 * bench.rate:
            return hertz


def _in_series(bench: Bench, volts: np.ndarray, found: dict[str, object]) -> dict[str, object]:
    """Add a source in series and note the log-likelihood that knowing it gains."""
    bench.series.append(volts)
    return {**found, 'nats': bench.nats(volts)}


def _tank(bench: Bench, gain: float, hertz: float) -> dict[str, object]:
    """Put a tank of L, C and a damping resistor in series, shaken by a white current."""
    omega, damping = 2 * math.pi * hertz, bench.draw.uniform(20.0, 60.0)
    farad = float(np.exp(bench.draw.uniform(math.log(0.5e-3), math.log(10e-3))))
    # Power at the peak over that of the rail there; the spectral density of a ringing of
    # variance v and damping g peaks at v/g.
    over = bench.draw.uniform(1.5, 3.5) * gain**2
    rail = bench.sigma0**2 / (bench.alpha0**2 + omega**2)
    variance = over * damping * rail
    amps = farad * math.sqrt(4 * damping * variance)
    current = amps * bench.white() / bench.h
    # C dv/dt = i - v/Rp - iL, L diL/dt = v.
    bench.series.append(bench.filtered(
        current, [1 / farad, 0.0], [1.0, 2 * damping, omega**2]))
    return {'frequency_hz': hertz, 'damping': damping, 'tank_farad': farad,
            'tank_henry': 1 / (omega**2 * farad), 'tank_ohm': 1 / (2 * damping * farad),
            'noise_current_a_sqrt_s': amps, 'std_v': math.sqrt(variance), 'peak_over_rail': over}


def _ringing(bench: Bench) -> float:
    """Draw a ringing frequency, Hz; below 0.3 of the rate."""
    return float(bench.draw.uniform(60.0, 250.0)) * min(1.0, bench.rate / 1000.0)


@effect('resonance', substeps=16)
def resonance(bench: Bench, gain: float) -> dict[str, object]:
    """Let a filter choke ring with its capacitor."""
    return _tank(bench, gain, _ringing(bench))


@effect('resonance/two_modes', substeps=16)
def resonance_two(bench: Bench, gain: float) -> dict[str, object]:
    """Let two filters ring, an octave or so apart."""
    first = 0.55 * _ringing(bench)
    second = first * bench.draw.uniform(1.7, 2.2)
    return {'first': _tank(bench, gain, first), 'second': _tank(bench, gain, second)}


@effect('resonance/lc_rail', substeps=16)
def resonance_rail(bench: Bench, gain: float) -> dict[str, object]:
    """Feed the rail's own capacitor through R and L: the relaxation itself is a pair of poles."""
    omega = 2 * math.pi * _ringing(bench)
    damping = bench.draw.uniform(20.0, 60.0) / gain
    # Z(s) = (R + s L)/(1 + s R C + s^2 L C), R/L = 2 damping.
    bench.transfer = ([bench.sigma0, 2 * damping * bench.sigma0],
                      [1.0, 2 * damping, omega**2])
    henry = bench.resistance / (2 * damping)
    return {'frequency_hz': omega / (2 * math.pi), 'damping': damping, 'rail_henry': henry,
            'rail_farad': 1 / (henry * omega**2)}


@effect('tone')
def tone(bench: Bench, gain: float) -> dict[str, object]:
    """Let the PWM of an ESC, 8..48 kHz, through to the ADC: its alias is a line."""
    pwm = _visible(bench, 8e3, 48e3)
    alias = _alias(pwm, bench.rate)
    volts = bench.draw.uniform(3.0, 6.0) * gain * _floor(bench, alias)
    phase = bench.draw.uniform(0, 2 * np.pi)
    bench.stage('sampled', lambda v: v + volts * np.sin(
        2 * np.pi * pwm * bench.sample_time + phase))
    whitened = volts * _shape(bench, alias) / bench.innovation
    return {'pwm_hz': pwm, 'frequency_hz': alias, 'amplitude_v': volts,
            'nats': bench.n * whitened**2 / 4}


@effect('tone/wandering', also=(('resonance',),))
def tone_wandering(bench: Bench, gain: float) -> dict[str, object]:
    """Let a converter's burst frequency wander by about 1 Hz over seconds (temperature)."""
    hertz = _visible(bench, 0.05 * bench.rate, 0.4 * bench.rate)
    spread, time = bench.draw.uniform(0.2, 1.0), bench.draw.uniform(1.0, 4.0)
    volts = bench.draw.uniform(6.0, 10.0) * gain * _floor(bench, hertz)
    wander = hertz + bench.relaxing(1 / time, spread)
    wave = volts * np.sin(2 * np.pi * np.cumsum(wander) * bench.h)
    return _in_series(bench, wave, {'frequency_hz': hertz, 'amplitude_v': volts,
                                    'spread_hz': spread, 'wander_time_s': time})


@effect('tone/square', substeps=16)
def tone_square(bench: Bench, gain: float) -> dict[str, object]:
    """Let a converter in burst mode switch on and off: a square wave with its harmonics."""
    hertz = _visible(bench, 0.025 * bench.rate, 0.1 * bench.rate)
    volts = bench.draw.uniform(3.0, 6.0) * gain * _floor(bench, hertz)
    duty, phase = bench.draw.uniform(0.35, 0.65), bench.draw.uniform()
    on = (hertz * bench.time + phase) % 1.0 < duty
    # The edges are those of the output filter, 0.3 ms.
    wave = bench.lagged(np.pi / 4 * volts * np.where(on, 1.0, -1.0), 0.3e-3)
    return _in_series(bench, wave, {'frequency_hz': hertz, 'amplitude_v': volts, 'duty': duty})


@effect('tone/modulated')
def tone_modulated(bench: Bench, gain: float) -> dict[str, object]:
    """Let the amplitude of a tone follow a slowly varying load."""
    hertz = _visible(bench, 0.05 * bench.rate, 0.4 * bench.rate)
    volts = bench.draw.uniform(5.0, 8.0) * gain * _floor(bench, hertz)
    time = bench.draw.uniform(2.0, 6.0)
    wave = volts * np.exp(bench.relaxing(1 / time, 0.5)) * np.sin(2 * np.pi * hertz * bench.time)
    return _in_series(bench, wave, {'frequency_hz': hertz, 'amplitude_v': volts,
                                    'modulation_time_s': time})


def _motor(bench: Bench, gain: float, speed: np.ndarray,
           overtone: float = 0.0) -> dict[str, object]:
    """Add the commutation ripple of motors whose relative speed is given (fine grid, 0..1)."""
    scale = min(1.0, bench.rate / 1000.0)
    start, slope = (float(bench.draw.uniform(*b)) * scale for b in ((50, 130), (50, 160)))
    volts = bench.draw.uniform(6.0, 10.0) * gain * _floor(
        bench, start + slope * float(np.mean(speed)))
    # Gusts vary the speed: the phase forgets itself in a second or two.
    blur = bench.draw.uniform(0.3, 1.0)
    phase = np.cumsum(2 * np.pi * (start + slope * speed) * bench.h
                      + math.sqrt(2 * blur) * bench.white())
    wave = volts * (np.sin(phase) + overtone * np.sin(2 * phase))
    return _in_series(bench, wave, {
        'idle_hz': start, 'slope_hz': slope, 'amplitude_v': volts, 'phase_rate': blur,
        'pole_pairs': 7, 'idle_rpm': 60 * start / 7})


@effect('throttle_tone')
def throttle_tone(bench: Bench, gain: float) -> dict[str, object]:
    """Let the commutation frequency be linear in throttle."""
    return _motor(bench, gain, bench.throttle)


@effect('throttle_tone/lagging')
def throttle_tone_lagging(bench: Bench, gain: float) -> dict[str, object]:
    """Let the propeller reach its speed 30..80 ms late."""
    time = bench.draw.uniform(0.03, 0.08)
    return {**_motor(bench, gain, bench.lagged(bench.throttle, time)), 'motor_time_s': time}


@effect('throttle_tone/square_root')
def throttle_tone_root(bench: Bench, gain: float) -> dict[str, object]:
    """Let the speed go as the root of throttle, as where throttle commands thrust."""
    return _motor(bench, gain, np.sqrt(bench.throttle))


@effect('throttle_tone/harmonic')
def throttle_tone_harmonic(bench: Bench, gain: float) -> dict[str, object]:
    """Add the second order at half the amplitude."""
    return _motor(bench, gain, bench.throttle, overtone=0.5)
