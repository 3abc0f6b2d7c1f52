"""Effects outside the catalogue: a program must report that it cannot explain them."""

import math

from hidden_circuit import Bench
from hidden_registry import effect
import numpy as np


@effect('unknown/skewed_noise', near=('jumps', 'heavy_tails'))
def skewed_noise(bench: Bench, gain: float) -> dict[str, object]:
    """Shake the rail by charges of one sign only, minus their mean: gamma increments."""
    skew = min(bench.draw.uniform(1.0, 2.0) * gain, 4.0)
    # A sum of gammas is a gamma: shape of one sample 4/skew^2, an equal part of it a fine step.
    shape = 4 / skew**2 / bench.substeps
    charge = bench.path.gamma(shape, size=bench.n_fine)
    bench.increments = (shape - charge) * math.sqrt(bench.h / shape)
    return {'skew_of_innovations': -skew}


@effect('unknown/ringing_bursts', near=('resonance', 'jumps', 'glitches'), substeps=16)
def ringing_bursts(bench: Bench, gain: float) -> dict[str, object]:
    """Let a relay hit a filter at random: bursts that swell, ring and die."""
    rate, hertz = bench.draw.uniform(0.5, 1.5), bench.draw.uniform(0.03, 0.1) * bench.rate
    time = bench.draw.uniform(0.02, 0.06)
    volts = bench.draw.uniform(5.0, 9.0) * gain * bench.innovation
    t = np.arange(0, 10 * time, bench.h)
    burst = volts * t / time * np.exp(1 - t / time) * np.sin(2 * np.pi * hertz * t)
    out = np.zeros(bench.n_fine)
    for at in bench.event_times(rate):
        piece = burst[:bench.n_fine - at]
        out[at:at + piece.size] += piece
    bench.series.append(out)
    return {'rate': rate, 'frequency_hz': hertz, 'time_s': time, 'amplitude_v': volts}


@effect('unknown/noise_bursts', near=('regime_switching', 'volatility', 'heavy_tails'))
def noise_bursts(bench: Bench, gain: float) -> dict[str, object]:
    """Let a radio transmit at random: noise that starts at once and fades linearly."""
    rate, time = bench.draw.uniform(0.3, 0.8), bench.draw.uniform(0.1, 0.3)
    more = bench.draw.uniform(3.0, 5.0) * gain
    fade = np.linspace(1, 0, int(time / bench.h))
    extra = np.zeros(bench.n_fine)
    for at in bench.event_times(rate):
        piece = fade[:bench.n_fine - at]
        extra[at:at + piece.size] = np.maximum(extra[at:at + piece.size], piece)
    bench.sigma = bench.sigma * (1 + more * extra)
    return {'rate': rate, 'time_s': time, 'peak_ratio': 1 + more}


@effect('unknown/hysteresis', near=('load_transient', 'load_sag'))
def hysteresis(bench: Bench, gain: float) -> dict[str, object]:
    """Let the converter change phases on the way up and down at different throttles (relay)."""
    volts = bench.draw.uniform(0.8, 1.4) * gain * bench.stationary
    low, high = np.quantile(bench.load, [0.3, 0.7])
    state, out = 1.0, []
    for x in bench.load.tolist():
        state = 1.0 if x > high else -1.0 if x < low else state
        out.append(state)
    # The mean response to throttle itself is compensated: what is left is the loop.
    loop = np.array(out) - np.polyval(np.polyfit(bench.load, out, 3), bench.load)
    bench.series.append(-volts * loop)
    return {'volts': volts, 'low': float(low), 'high': float(high)}


@effect('unknown/state_noise', near=('nonlinear_restoring', 'volatility', 'heavy_tails'))
def state_noise(bench: Bench, gain: float) -> dict[str, object]:
    """Let the noise grow where the rail is low: a converter near its drop-out."""
    slope = bench.draw.uniform(0.35, 0.55) * gain
    scale, exp = bench.stationary, math.exp
    bench.state_gain = lambda x: exp(min(max(-slope * x / scale, -1.0), 1.0))
    return {'ln_sigma_per_std': -slope}


@effect('unknown/sawtooth', near=('tone', 'resonance', 'jumps'))
def sawtooth(bench: Bench, gain: float) -> dict[str, object]:
    """Let a converter hiccup: it charges slowly and discharges at once, at irregular times."""
    period = bench.draw.uniform(20.0, 60.0) / bench.rate
    blur = bench.draw.uniform(0.15, 0.3)
    volts = bench.draw.uniform(3.0, 4.5) * gain * bench.innovation
    count = int(3 * (bench.duration + 2) / period)
    ends = np.cumsum(period * np.exp(blur * bench.path.normal(size=count))) - 1.5
    turn = np.searchsorted(ends, bench.time)
    phase = (bench.time - ends[turn - 1]) / (ends[turn] - ends[turn - 1])
    bench.series.append(volts * (phase - 0.5))
    return {'period_s': period, 'blur': blur, 'height_v': volts}


@effect('unknown/linear_dropouts', near=('jumps', 'regime_switching', 'second_relaxation'))
def linear_dropouts(bench: Bench, gain: float) -> dict[str, object]:
    """Let the supply drop out at random and be ramped up again by its soft start."""
    rate, time = bench.draw.uniform(0.2, 0.5), bench.draw.uniform(0.2, 0.6)
    depth = max(bench.draw.uniform(2.0, 4.0) * bench.stationary,
                6 * bench.innovation) * gain
    ramp = depth * np.linspace(1, 0, int(time / bench.h))
    out = np.zeros(bench.n_fine)
    for at in bench.event_times(rate):
        piece = ramp[:bench.n_fine - at]
        out[at:at + piece.size] = np.maximum(out[at:at + piece.size], piece)
    bench.series.append(-out)
    return {'rate': rate, 'ramp_s': time, 'depth_v': depth}


@effect('unknown/periodic_sigma', near=('volatility', 'regime_switching'))
def periodic_sigma(bench: Bench, gain: float) -> dict[str, object]:
    """Let a gimbal or a scanner modulate the noise at 1..6 Hz, whatever the throttle."""
    hertz, depth = bench.draw.uniform(1.0, 6.0), bench.draw.uniform(0.5, 0.8) * gain
    bench.sigma = bench.sigma * np.exp(depth * np.sin(2 * np.pi * hertz * bench.time))
    return {'frequency_hz': hertz, 'ln_sigma_amplitude': depth}


@effect('unknown/throttle_bursts', near=('load_dependent_sigma', 'volatility'))
def throttle_bursts(bench: Bench, gain: float) -> dict[str, object]:
    """Let noise follow the *changes* of throttle and fade: ESCs out of step."""
    time = bench.draw.uniform(0.05, 0.2)
    moved = np.abs(np.diff(bench.throttle, prepend=bench.throttle[0]))
    # The memory of all movements, as if each fell by exp(-t/time).
    recent = bench.lagged(moved / bench.h, time) * time
    top = float(np.quantile(recent, 0.95))
    more = bench.draw.uniform(2.0, 3.5) * gain
    bench.sigma = bench.sigma * (1 + more * np.minimum(recent / top, 1.0))
    return {'time_s': time, 'ratio': 1 + more}


@effect('unknown/slew_limit', near=('second_relaxation', 'measurement_noise', 'heavy_tails'))
def slew_limit(bench: Bench, gain: float) -> dict[str, object]:
    """
    Let the amplifier before the ADC be slow for large signals: dv/dt = S tanh((x - v)/(S time)).

    It settles in half a sample, but follows no faster than about one innovation per sample.
    """
    limit = bench.draw.uniform(0.9, 1.4) * bench.innovation / gain**0.5
    step, scale, tanh = limit / bench.substeps, 0.5 * limit, math.tanh

    def follow(v: np.ndarray) -> np.ndarray:
        state, out = float(v[0]), []
        for x in v.tolist():
            state += step * tanh((x - state) / scale)
            out.append(state)
        return np.array(out)
    bench.stage('front_end', follow)
    return {'slew_v_s': limit * bench.rate, 'settling_s': 0.5 / bench.rate}


@effect('unknown/chaotic_converter', near=('resonance', 'tone', 'measurement_noise'))
def chaotic_converter(bench: Bench, gain: float) -> dict[str, object]:
    """
    Run a converter of constant slope past its stability: heights by the logistic map, r = 3.9.

    A higher ripple takes longer, so the chaos is in the times too and no line stands out.
    """
    cycle = bench.draw.uniform(6.0, 15.0) / bench.rate
    volts = bench.draw.uniform(2.0, 3.0) * gain * bench.innovation
    x, heights = float(bench.path.uniform(0.2, 0.8)), []
    for _ in range(int(3 * (bench.duration + 2) / cycle) + 3):
        x = 3.9 * x * (1 - x)
        heights.append(x)
    height = np.array(heights)
    ends = np.cumsum(2 * cycle * height) - 1.5
    turn = np.searchsorted(ends, bench.time)
    phase = (ends[turn] - bench.time) / (2 * cycle * height[turn])
    bench.series.append(volts * height[turn] * (1 - np.abs(2 * phase - 1)) * 2)
    return {'cycle_s': cycle, 'amplitude_v': volts}


@effect('unknown/spread_spectrum', near=('tone', 'resonance', 'throttle_tone'))
def spread_spectrum(bench: Bench, gain: float) -> dict[str, object]:
    """Sweep a converter's clock up and down irregularly to spread its line."""
    middle = bench.draw.uniform(0.15, 0.3) * bench.rate
    width = bench.draw.uniform(0.05, 0.12) * bench.rate
    sweeps = bench.draw.uniform(2.0, 9.0)
    turns = np.cumsum(np.exp(0.3 * bench.path.normal(
        size=int(4 * sweeps * (bench.duration + 2)) + 4)) / (2 * sweeps)) - 1.5
    saw = np.interp(bench.time, turns, np.where(np.arange(turns.size) % 2, 1.0, -1.0))
    phase = 2 * np.pi * np.cumsum(middle + width * saw) * bench.h
    volts = bench.draw.uniform(0.4, 0.7) * gain * bench.innovation
    bench.series.append(volts * np.sin(phase))
    return {'middle_hz': middle, 'width_hz': width, 'sweeps_per_s': sweeps,
            'amplitude_v': volts}


@effect('unknown/leverage', near=('volatility', 'heavy_tails', 'regime_switching'))
def leverage(bench: Bench, gain: float) -> dict[str, object]:
    """Let each fall of the rail, but not a rise, increase the noise of the next samples."""
    feed = min(bench.draw.uniform(0.5, 0.8) * gain, 0.9)
    keep, slots, gains = 0.6, bench.n_fine // bench.substeps, []
    kicks = bench.white().reshape(slots, bench.substeps)
    sums = (kicks.sum(axis=1) * math.sqrt(bench.rate)).tolist()
    power = 1.0
    for z in sums:
        gains.append(math.sqrt(power))
        # E[z^2; z<0] = 1/2: keeps the mean power at 1.
        shock = power * z * z if z < 0 else 0.0
        power = (1 - keep - 0.5 * (1 - keep) * feed) + keep * power \
            + (1 - keep) * feed * shock
    bench.increments = (kicks * np.array(gains)[:, None]).ravel()
    return {'feed': feed, 'keep': keep}
