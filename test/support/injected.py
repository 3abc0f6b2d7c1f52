"""
Effects hidden in recorded flights, in units of the recording's own noise.

Sizes are in standard deviations of white noise with the second differences of the recording, which
hardly contain slow changes; the largest twentieth is left out, because the load causes it.  The
noise is taken as at least half a step of the ADC.  Strengths of 1 to 3 are moderate.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from ou_monitor import Recording
from ou_monitor.criticism.adc import find_step
from ou_monitor.records import FloatArray
from scipy.signal import lfilter

# Applies an effect to a recording, given strength times noise, V.
Inject = Callable[[Recording, float, np.random.Generator], Recording]


def noise_of(voltage: FloatArray) -> float:
    """Return the standard deviation of white noise with these second differences, V."""
    bent = np.abs(np.diff(voltage, 2))
    usual = bent[bent <= np.quantile(bent, 0.95)]
    return max(float(np.sqrt(np.mean(usual**2) / 6.0)), 0.5 * find_step(voltage))


def _added(recording: Recording, more: FloatArray) -> Recording:
    """Return a recording with a voltage added to the supply, as read by its own ADC."""
    voltage = recording.voltage + more
    step = find_step(recording.voltage)
    if step > 0.0:
        # Rounded as in the recording, where a code of 5.28 mV may be 5 or 6.
        decimals = next((k for k in range(7) if np.allclose(
            recording.voltage, recording.voltage.round(k), 0.0, 1e-8)), 9)
        low = float(recording.voltage.min())
        voltage = (low + step * np.rint((voltage - low) / step)).round(decimals)
    return replace(recording, voltage=voltage)


def _relaxing(drive: FloatArray, rate: float, step: float) -> FloatArray:
    """Return the response to pushes that relax at a rate (1/s; step in s)."""
    return np.asarray(lfilter([1.0], [1.0, -np.exp(-rate * step)], drive))


def _step(recording: Recording) -> float:
    return float(np.median(np.diff(recording.t)))


def _often(recording: Recording, rate: float) -> float:
    """Return the probability per sample of events at a rate, 1/s, or of 40 in all if short."""
    step = _step(recording)
    return step * max(rate, 40.0 / (recording.t.size * step))


def tone(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    rate = 1.0 / _step(recording)
    at = rng.uniform(0.1, 0.4) * rate
    return _added(recording, 0.8 * noise * np.sin(2.0 * np.pi * at * recording.t))


def jumps(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add falls of six deviations, one per second, that recover within ten samples."""
    step = _step(recording)
    hit = rng.random(recording.t.size) < _often(recording, 1.0)
    drive = hit * noise * rng.uniform(-8.0, -4.0, recording.t.size)
    return _added(recording, _relaxing(drive, 0.1 / step, step))


def glitches(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add errors of six deviations, up or down, to one sample in a hundred."""
    hit = rng.random(recording.t.size) < 0.01
    return _added(recording, hit * noise * 6.0 * rng.standard_normal(recording.t.size))


def dropouts(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add falls by six deviations for two or three samples, one per second."""
    begins = rng.random(recording.t.size) < _often(recording, 1.0)
    longer = begins & (rng.random(recording.t.size) < 0.5)
    down = begins | np.roll(begins, 1) | np.roll(longer, 2)
    return _added(recording, -6.0 * noise * down)


def held(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Replace three values in ten by the one before."""
    voltage = recording.voltage.copy()
    for k in np.flatnonzero(rng.random(voltage.size) < 0.3)[1:]:
        voltage[k] = voltage[k - 1]
    return replace(recording, voltage=voltage)


def steps(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Round to steps of two deviations."""
    return replace(recording, voltage=2.0 * noise * np.rint(recording.voltage / (2.0 * noise)))


def white(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add white noise as large as that of the recording."""
    return _added(recording, noise * rng.standard_normal(recording.t.size))


def tails(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add an OU that forgets within ten samples, driven by Student-t noise of three degrees."""
    step = _step(recording)
    push = rng.standard_t(3.0, recording.t.size) / np.sqrt(3.0)
    return _added(recording, noise * _relaxing(push, 0.1 / step, step))


def regimes(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add such an OU that is three times as intense for a second at times."""
    step = _step(recording)
    flips = rng.random(recording.t.size) < _often(recording, 1.0)
    push = (1.0 + 2.0 * (np.cumsum(flips) % 2)) * rng.standard_normal(recording.t.size)
    return _added(recording, noise * _relaxing(push, 0.1 / step, step))


def drift(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add a fall by four deviations from start to end."""
    return _added(recording, -4.0 * noise * np.linspace(0.0, 1.0, recording.t.size))


def slow(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add an OU of two deviations that forgets within a second or two, or in a thirtieth."""
    step, rate = _step(recording), rng.uniform(0.5, 1.5)
    rate = max(rate, 30.0 / (recording.t.size * step))
    push = rng.standard_normal(recording.t.size) * np.sqrt(-np.expm1(-2.0 * rate * step))
    return _added(recording, 2.0 * noise * _relaxing(push, rate, step))


def levels(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add two levels four deviations apart, for a second or so each."""
    flips = rng.random(recording.t.size) < _often(recording, 1.0 / rng.uniform(0.8, 1.6))
    return _added(recording, -4.0 * noise * (np.cumsum(flips) % 2))


def jitter(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add errors of a tenth of a step to the stamps."""
    off = 0.1 * _step(recording) * rng.standard_normal(recording.t.size)
    return replace(recording, t=recording.t + off)


def rail(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Clip at the voltage that one reading in fifty is below."""
    return replace(recording, voltage=np.maximum(
        recording.voltage, np.quantile(recording.voltage, 0.02)))


# Each effect with its correct names.
EFFECTS: dict[str, tuple[Inject, frozenset[str]]] = {
    'tone': (tone, frozenset({'tone'})),
    'jumps': (jumps, frozenset({'jumps'})),
    'glitches': (glitches, frozenset({'glitches'})),
    'dropouts': (dropouts, frozenset({'glitches', 'regime_switching'})),
    'held': (held, frozenset({'held_samples'})),
    'steps': (steps, frozenset({'quantization'})),
    'white': (white, frozenset({'measurement_noise'})),
    'tails': (tails, frozenset({'heavy_tails'})),
    'regimes': (regimes, frozenset({'regime_switching', 'volatility'})),
    'drift': (drift, frozenset({'drift'})),
    'slow': (slow, frozenset({'second_relaxation', 'flicker_noise'})),
    'levels': (levels, frozenset({'regime_switching'})),
    'jitter': (jitter, frozenset({'clock_jitter'})),
    'rail': (rail, frozenset({'saturation'})),
}
