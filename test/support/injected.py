"""
Effects hidden in recorded flights, in units of what the recording itself shows.

Sizes are in standard deviations of white noise with the second differences of the recording, in
which no slow motion shows; a twentieth of them, the largest, are the load's.  An ADC is coarse
beside less than half of its step.  Strengths of 1 to 3 are moderate.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from ou_monitor import Recording
from ou_monitor.criticism.adc import find_step
from ou_monitor.records import FloatArray
from scipy.signal import lfilter

# Effect of a recording and its strength times its noise, V: what to add, or what to do.
Inject = Callable[[Recording, float, np.random.Generator], Recording]


def noise_of(voltage: FloatArray) -> float:
    """Return the standard deviation of white noise with these second differences, V."""
    bent = np.abs(np.diff(voltage, 2))
    usual = bent[bent <= np.quantile(bent, 0.95)]
    return max(float(np.sqrt(np.mean(usual**2) / 6.0)), 0.5 * find_step(voltage))


def _added(recording: Recording, more: FloatArray) -> Recording:
    """Return a recording with something on the supply, read by its own ADC."""
    voltage = recording.voltage + more
    step = find_step(recording.voltage)
    if step > 0.0:
        # As printed: a code of 5.28 mV may be there as 5 or as 6.
        decimals = next((k for k in range(7) if np.allclose(
            recording.voltage, recording.voltage.round(k), 0.0, 1e-8)), 9)
        low = float(recording.voltage.min())
        voltage = (low + step * np.rint((voltage - low) / step)).round(decimals)
    return replace(recording, voltage=voltage)


def _relaxing(drive: FloatArray, rate: float, step: float) -> FloatArray:
    """Return what pushes leave behind that relax at a rate (1/s; step in s)."""
    return np.asarray(lfilter([1.0], [1.0, -np.exp(-rate * step)], drive))


def _step(recording: Recording) -> float:
    return float(np.median(np.diff(recording.t)))


def _often(recording: Recording, rate: float) -> float:
    """Return the chance a sample of events at a rate (1/s), or of 40 in a short recording."""
    step = _step(recording)
    return step * max(rate, 40.0 / (recording.t.size * step))


def tone(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    rate = 1.0 / _step(recording)
    at = rng.uniform(0.1, 0.4) * rate
    return _added(recording, 0.8 * noise * np.sin(2.0 * np.pi * at * recording.t))


def jumps(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add falls of six deviations, one a second, that recover within ten samples."""
    step = _step(recording)
    hit = rng.random(recording.t.size) < _often(recording, 1.0)
    drive = hit * noise * rng.uniform(-8.0, -4.0, recording.t.size)
    return _added(recording, _relaxing(drive, 0.1 / step, step))


def glitches(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add single wrong values, one of a hundred, of six deviations either way."""
    hit = rng.random(recording.t.size) < 0.01
    return _added(recording, hit * noise * 6.0 * rng.standard_normal(recording.t.size))


def dropouts(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add falls by six deviations for two or three samples, one a second."""
    begins = rng.random(recording.t.size) < _often(recording, 1.0)
    longer = begins & (rng.random(recording.t.size) < 0.5)
    down = begins | np.roll(begins, 1) | np.roll(longer, 2)
    return _added(recording, -6.0 * noise * down)


def held(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Let three values of ten repeat the one before."""
    voltage = recording.voltage.copy()
    for k in np.flatnonzero(rng.random(voltage.size) < 0.3)[1:]:
        voltage[k] = voltage[k - 1]
    return replace(recording, voltage=voltage)


def steps(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Read in codes two deviations apart."""
    return replace(recording, voltage=2.0 * noise * np.rint(recording.voltage / (2.0 * noise)))


def white(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add white noise as large again as what is there."""
    return _added(recording, noise * rng.standard_normal(recording.t.size))


def tails(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add an OU that forgets within ten samples, driven by Student-t noise of three degrees."""
    step = _step(recording)
    push = rng.standard_t(3.0, recording.t.size) / np.sqrt(3.0)
    return _added(recording, noise * _relaxing(push, 0.1 / step, step))


def regimes(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add an OU as fast that is three times as intense for a second now and then."""
    step = _step(recording)
    flips = rng.random(recording.t.size) < _often(recording, 1.0)
    push = (1.0 + 2.0 * (np.cumsum(flips) % 2)) * rng.standard_normal(recording.t.size)
    return _added(recording, noise * _relaxing(push, 0.1 / step, step))


def drift(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Add a fall by four deviations from begin to end."""
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
    """Make stamps wrong by a tenth of a step."""
    off = 0.1 * _step(recording) * rng.standard_normal(recording.t.size)
    return replace(recording, t=recording.t + off)


def rail(recording: Recording, noise: float, rng: np.random.Generator) -> Recording:
    """Read by an ADC that ends where one reading of fifty would be below."""
    return replace(recording, voltage=np.maximum(
        recording.voltage, np.quantile(recording.voltage, 0.02)))


# Each with the names that are right for it.
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
