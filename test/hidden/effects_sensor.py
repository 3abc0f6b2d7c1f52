"""Hidden effects of the instrument: noise, steps, range, hold, glitches, clock, AC coupling."""

import math

from hidden_circuit import Bench
from hidden_registry import effect
import numpy as np


@effect('measurement_noise')
def white_noise(bench: Bench, gain: float) -> dict[str, object]:
    """Add the amplifier's Gaussian noise, 0.3..0.8 of an innovation."""
    std = bench.draw.uniform(0.3, 0.8) * gain * bench.innovation
    bench.stage('noise', lambda v: v + std * bench.path.normal(size=v.size))
    return {'std_v': std}


@effect('measurement_noise/uniform')
def white_noise_uniform(bench: Bench, gain: float) -> dict[str, object]:
    """Add noise that is uniform, as that of a subtractive dither not subtracted."""
    std = bench.draw.uniform(0.4, 0.9) * gain * bench.innovation
    width = math.sqrt(12) * std
    bench.stage('noise', lambda v: v + width * (bench.path.random(v.size) - 0.5))
    return {'std_v': std}


def _step(bench: Bench, gain: float) -> tuple[float, float, dict[str, object]]:
    """Draw an ADC; returns the step and the offset of its codes, V."""
    step = bench.draw.uniform(0.7, 2.0) * gain * bench.innovation
    bits = max(4, math.ceil(math.log2(1.3 * bench.level / step)))
    return step, step * bench.draw.uniform(), {
        'step_v': step, 'bits': bits, 'full_scale_v': step * 2**bits}


@effect('quantization')
def quantization(bench: Bench, gain: float) -> dict[str, object]:
    """Round to the nearest code of an ADC whose step is 0.7..2 innovations."""
    step, offset, found = _step(bench, gain)
    bench.stage('converter', lambda v: offset + step * np.round((v - offset) / step))
    return found


@effect('quantization/mid_rise')
def quantization_mid_rise(bench: Bench, gain: float) -> dict[str, object]:
    """Round down, and report the middle of the step."""
    step, _, found = _step(bench, gain)
    bench.stage('converter', lambda v: step * (np.floor(v / step) + 0.5))
    return found


@effect('quantization/dithered', also=(('quantization', 'measurement_noise'),))
def quantization_dithered(bench: Bench, gain: float) -> dict[str, object]:
    """Add triangular dither of one step before rounding."""
    step, offset, found = _step(bench, gain)

    def convert(v: np.ndarray) -> np.ndarray:
        dither = bench.path.random(v.size) - bench.path.random(v.size)
        return offset + step * np.round((v - offset) / step + dither)
    bench.stage('converter', convert)
    return found


@effect('held_samples')
def held_samples(bench: Bench, gain: float) -> dict[str, object]:
    """Let the ADC update its value 2..6 times slower than the logger writes, in step or not."""
    factor = 1 + min(bench.draw.uniform(1.5, 5.0) * gain, 5.0)
    if bench.draw.random() < 0.5:
        factor = max(2.0, float(round(factor)))
    start = bench.draw.uniform(0, factor)
    row = np.arange(bench.n)
    # The last conversion before each row of the log, and the first row that shows it.
    begun = np.floor((row + start) / factor) * factor - start
    bench.sample_delay = (begun - row) / bench.rate
    first = np.maximum(np.ceil(begun - 1e-9).astype(int), 0)
    bench.stage('logger', lambda v: v[first])
    return {'factor': factor, 'converter_rate_hz': bench.rate / factor}


@effect('held_samples/lost')
def held_lost(bench: Bench, gain: float) -> dict[str, object]:
    """Lose conversions at random; the logger writes the last one that arrived."""
    lost = min(bench.draw.uniform(0.25, 0.6) * gain, 0.8)

    def hold(v: np.ndarray) -> np.ndarray:
        fresh = bench.path.random(v.size) >= lost
        fresh[0] = True
        return v[np.maximum.accumulate(np.where(fresh, np.arange(v.size), 0))]
    bench.stage('logger', hold)
    return {'lost_share': lost}


@effect('saturation')
def saturation(bench: Bench, gain: float) -> dict[str, object]:
    """End the ADC's range where 1..5 % of the samples lie beyond it, at the top or bottom."""
    share = bench.draw.uniform(0.01, 0.05) * gain
    top = bool(bench.draw.integers(2))
    found: dict[str, object] = {'share': share, 'top': top}

    def clip(v: np.ndarray) -> np.ndarray:
        limit = float(np.quantile(v, 1 - share if top else share))
        found['limit_v'] = limit
        return np.minimum(v, limit) if top else np.maximum(v, limit)
    bench.stage('range', clip)
    return found


@effect('saturation/two_sided')
def saturation_two(bench: Bench, gain: float) -> dict[str, object]:
    """Clip at both ends of the range."""
    share = bench.draw.uniform(0.01, 0.04) * gain

    def clip(v: np.ndarray) -> np.ndarray:
        return np.clip(v, *np.quantile(v, [share, 1 - share]))
    bench.stage('range', clip)
    return {'share': share}


@effect('ac_coupling')
def ac_coupling(bench: Bench, gain: float) -> dict[str, object]:
    """Read a rail of 1..5 1/s through a series capacitor, corner 5..12 Hz."""
    # Strength scales the rail's own rate, to which the evidence is proportional.
    alpha = bench.draw.uniform(1.6, 5.0) * gain
    # The same innovation as the rail that was drawn, so that only the relaxation is slower.
    phi2 = math.exp(-2 * alpha / bench.rate)
    bench.set_rail(alpha, bench.innovation * math.sqrt(2 * alpha / (1 - phi2)))
    corner = bench.draw.uniform(5.0, 12.0)
    ohm = float(bench.draw.choice([1e5, 1e6, 1e7]))
    # An oscilloscope is centred on zero; an ADC behind a divider, on half its reference.
    bias = float(bench.draw.choice([0.0, 1.65, 2.5]))
    # The rail starts at 0, about which the coupling capacitor is charged, a second ahead.
    bench.stage('front_end', lambda v: bias + bench.filtered(
        v - v[0], [1.0, 0.0], [1.0, 2 * math.pi * corner]))
    return {'corner_hz': corner, 'coupling_farad': 1 / (2 * math.pi * corner * ohm),
            'input_ohm': ohm, 'bias_v': bias, 'rail_alpha': alpha,
            'nats': 0.24 * alpha * bench.duration}


@effect('ac_coupling/probe_and_input')
def ac_coupling_twice(bench: Bench, gain: float) -> dict[str, object]:
    """Add the amplifier's second coupling capacitor, at a corner ten times lower."""
    found = ac_coupling(bench, gain)
    second = 0.1 * float(found['corner_hz'])    # type: ignore[arg-type]
    bench.stage('front_end', lambda v: v[0] + bench.filtered(
        v - v[0], [1.0, 0.0], [1.0, 2 * math.pi * second]))
    return {**found, 'second_corner_hz': second}


def _glitches(bench: Bench, gain: float, run: int) -> dict[str, object]:
    """Corrupt runs of samples on the bus by 5..10 innovations; the rail is not affected."""
    share = bench.draw.uniform(0.002, 0.01) / run**0.5
    size = bench.innovation * gain

    def corrupt(v: np.ndarray) -> np.ndarray:
        first = np.flatnonzero(bench.path.random(v.size) < share)
        wrong = bench.path.uniform(5.0, 10.0, first.size) * bench.path.choice(
            [-1.0, 1.0], first.size) * size
        v = v.copy()
        for k in range(run):
            inside = first + k < v.size
            v[first[inside] + k] += wrong[inside]
        return v
    bench.stage('bus', corrupt)
    return {'share': share, 'run': run, 'mean_size_v': 7.5 * size}


@effect('glitches')
def glitches(bench: Bench, gain: float) -> dict[str, object]:
    """Corrupt 0.2..1 % of the samples, one at a time."""
    return _glitches(bench, gain, 1)


@effect('glitches/double')
def glitches_double(bench: Bench, gain: float) -> dict[str, object]:
    """Corrupt two samples in a row by the same error."""
    return _glitches(bench, gain, 2)


@effect('glitches/triple')
def glitches_triple(bench: Bench, gain: float) -> dict[str, object]:
    """Corrupt three samples in a row by the same error."""
    return _glitches(bench, gain, 3)


def _latency(bench: Bench, gain: float) -> tuple[np.ndarray, dict[str, object]]:
    """Draw delays, s, inside nine tenths of each sample's own slot: a symmetric beta law."""
    # So conversions stay in order, and no two have the same time on the fine grid.
    spread, slot = min(bench.draw.uniform(0.22, 0.35) * gain, 0.35), 0.9
    shape = 0.5 * (slot**2 / (4 * spread**2) - 1)
    late = slot * (bench.path.beta(shape, shape, bench.n) - 0.5)
    return late / bench.rate, {'std_steps': spread, 'std_s': spread / bench.rate}


@effect('clock_jitter', substeps=16)
def clock_jitter(bench: Bench, gain: float) -> dict[str, object]:
    """Convert when the task gets the processor, but stamp as if on time."""
    bench.sample_delay, found = _latency(bench, gain)
    return found


@effect('clock_jitter/stamps')
def clock_jitter_stamps(bench: Bench, gain: float) -> dict[str, object]:
    """Convert on time, and stamp when the message gets through: the stamps are irregular."""
    bench.stamp_error, found = _latency(bench, gain)
    return found
