"""Hidden effects of the noise: its law, its slow parts, events, regimes and wandering."""

import math

from hidden_circuit import Bench
from hidden_registry import effect
import numpy as np
from scipy.fft import irfft, next_fast_len, rfft


def _slow(bench: Bench, gain: float) -> tuple[float, float, dict[str, object]]:
    """Draw a slow R-C pair; returns its rate (1/s) and standard deviation (V)."""
    # 0.5..5 1/s, and a decade or more below the rail, so that there are two poles to see.
    most = min(5.0, bench.alpha0 / 14)
    rate = float(np.exp(bench.draw.uniform(math.log(0.5), math.log(most))))
    std = bench.draw.uniform(0.55, 1.0) * gain * bench.stationary
    ohm = bench.draw.uniform(5e-3, 50e-3)
    return rate, std, {'rate': rate, 'std_v': std, 'slow_ohm': ohm,
                       'slow_farad': 1 / (rate * ohm)}


@effect('second_relaxation')
def second_relaxation(bench: Bench, gain: float) -> dict[str, object]:
    """Put a slow R-C pair with a white noise current of its own in series."""
    rate, std, found = _slow(bench, gain)
    bench.series.append(bench.relaxing(rate, std))
    return found


@effect('second_relaxation/shots')
def second_relaxation_shots(bench: Bench, gain: float) -> dict[str, object]:
    """Shake the slow pair by Laplacian charges some 20 times a relaxation: not Gaussian."""
    rate, std, found = _slow(bench, gain)
    often = 20 * rate
    charges = (bench.path.random(bench.n_fine) < often * bench.h) * bench.path.laplace(
        size=bench.n_fine)
    bench.series.append(bench.relaxing(rate, std, charges / math.sqrt(2 * often)))
    return {**found, 'charges_per_s': often}


def _one_over_f(bench: Bench, exponent: float, std: float) -> np.ndarray:
    """Return noise of density f^-exponent between 0.05 and 200 Hz, by shaping white noise."""
    size = next_fast_len(2 * bench.n_fine, real=True)
    f = np.fft.rfftfreq(size, bench.h)
    power = np.maximum(f, 0.05)**-exponent / (1 + (f / 200.0)**2)
    power *= size**2 / (2 * power[1:].sum() + power[0])
    # Twice the length, half of it used: what the transform wraps round is not seen.
    noise = rfft(bench.path.normal(size=size)) / math.sqrt(size)
    return std * irfft(noise * np.sqrt(power), size)[:bench.n_fine]


@effect('flicker_noise')
def flicker(bench: Bench, gain: float) -> dict[str, object]:
    """Add the reference's 1/f noise, 0.05..200 Hz, of the same variance as the rail."""
    std = gain * bench.stationary
    bench.series.append(_one_over_f(bench, 1.0, std))
    return {'exponent': 1.0, 'std_v': std}


@effect('flicker_noise/exponent')
def flicker_exponent(bench: Bench, gain: float) -> dict[str, object]:
    """Let the exponent be 0.8..1.2."""
    exponent, std = bench.draw.uniform(0.8, 1.2), gain * bench.stationary
    bench.series.append(_one_over_f(bench, exponent, std))
    return {'exponent': exponent, 'std_v': std}


@effect('flicker_noise/traps')
def flicker_traps(bench: Bench, gain: float) -> dict[str, object]:
    """Add McWhorter's traps: random telegraphs, times log-uniform from 1 ms to 3 s."""
    std = gain * bench.stationary
    times = np.exp(np.linspace(math.log(0.8e-3), math.log(3.0), 40))
    total = np.zeros(bench.n_fine)
    for time in times:
        # Flips at rate 1/(2 time) give a correlation time of `time`.
        flips = bench.path.random(bench.n_fine) < bench.h / (2 * time)
        total += 1 - 2.0 * ((np.cumsum(flips) + bench.path.integers(2)) % 2)
    bench.series.append(std * total / math.sqrt(times.size))
    return {'traps': int(times.size), 'std_v': std}


@effect('volatility')
def volatility(bench: Bench, gain: float) -> dict[str, object]:
    """Let temperature move ln sigma: standard deviation 0.4..0.6, correlation time 2..8 s."""
    spread, time = bench.draw.uniform(0.4, 0.6) * gain, bench.draw.uniform(2.0, 8.0)
    bench.sigma = bench.sigma * np.exp(bench.relaxing(1 / time, spread))
    return {'ln_sigma_std': spread, 'time_s': time}


@effect('volatility/random_walk')
def volatility_walk(bench: Bench, gain: float) -> dict[str, object]:
    """Let ln sigma walk at random, 0.07..0.14 a root second (ageing that never returns)."""
    speed = bench.draw.uniform(0.07, 0.14) * gain
    walk = np.cumsum(speed * bench.white())
    bench.sigma = bench.sigma * np.exp(walk - walk.mean())
    return {'ln_sigma_per_sqrt_s': speed}


def _mixture(bench: Bench, variance: np.ndarray) -> None:
    """Give each sampling interval its own variance of the noise: one PWM period, one pulse."""
    slots = np.concatenate([np.ones(bench.lead), np.repeat(variance, bench.substeps)])
    # The pulse that ends in sample k+1 belongs to interval k.
    bench.increments = bench.white() * np.sqrt(np.roll(slots, 1))


@effect('heavy_tails')
def heavy_tails(bench: Bench, gain: float) -> dict[str, object]:
    """Shake the rail by Student-t charges of 3..5 degrees of freedom, one each PWM period."""
    dof = max(bench.draw.uniform(3.0, 5.0) / gain, 2.6)
    # Gaussian of inverse-gamma variance; the mean of that is 1.
    variance = 0.5 * (dof - 2) / bench.path.gamma(dof / 2, size=bench.n)
    _mixture(bench, variance)
    return {'dof': dof}


@effect('heavy_tails/laplace')
def heavy_laplace(bench: Bench, gain: float) -> dict[str, object]:
    """Let the charges be variance-gamma; Laplacian at strength 1."""
    shape = 1 / gain
    _mixture(bench, bench.path.gamma(shape, 1 / shape, bench.n))
    return {'gamma_shape': shape}


@effect('heavy_tails/nig')
def heavy_nig(bench: Bench, gain: float) -> dict[str, object]:
    """Let the charges be normal inverse Gaussian."""
    shape = bench.draw.uniform(0.4, 1.0) / gain
    _mixture(bench, bench.path.wald(1.0, shape, bench.n))
    return {'ig_shape': shape}


def _impulses(bench: Bench, gain: float, exponential: bool) -> dict[str, object]:
    """Dump charges on the capacitor at Poisson times."""
    rate = bench.draw.uniform(0.3, 2.0)
    up = float(bench.draw.choice([0.0, 0.5, 0.5]))
    at = bench.event_times(rate)
    if exponential:
        size = 3.0 + bench.path.exponential(3.5, at.size)
    else:
        size = bench.path.uniform(5.0, 8.0, at.size)
    volts = gain * bench.innovation * size * np.where(bench.path.random(at.size) < up, 1, -1)
    bench.kicks = np.bincount(at, volts, bench.n_fine)
    return {'rate': rate, 'share_up': up, 'count': int(at.size),
            'mean_charge_c': 6.5 * gain * bench.innovation * bench.capacitance}


@effect('jumps')
def jumps(bench: Bench, gain: float) -> dict[str, object]:
    """Dump charges of 5..8 innovations, 0.3..2 times a second, down only or either way."""
    return _impulses(bench, gain, False)


@effect('jumps/exponential')
def jumps_exponential(bench: Bench, gain: float) -> dict[str, object]:
    """Let the sizes have an exponential tail above three innovations."""
    return _impulses(bench, gain, True)


def _regimes(bench: Bench, dwell: list[float], shape: float = 1.0) -> np.ndarray:
    """Draw the path of a switch on the fine grid, shape (n_fine,) of ints."""
    # Dwell times have the given means (s) and a gamma law of the given shape, 1 being Markov; the
    # next state is any other, all alike.
    state = int(bench.path.integers(len(dwell)))
    pieces, total = [], 0
    while total < bench.n_fine:
        steps = 1 + int(bench.path.gamma(shape, dwell[state] / shape) / bench.h)
        pieces.append(np.full(steps, state))
        total += steps
        state = (state + int(bench.path.integers(1, len(dwell)))) % len(dwell)
    return np.concatenate(pieces)[:bench.n_fine]


def _sigma_levels(bench: Bench, gain: float, count: int, shape: float) -> dict[str, object]:
    """Switch sigma between levels in equal ratios."""
    ratio = bench.draw.uniform(1.6, 2.5)**gain
    dwell = [float(bench.draw.uniform(0.3, 3.0)) for _ in range(count)]
    levels = ratio**(np.arange(count) - 0.5 * (count - 1))
    bench.sigma = bench.sigma * levels[_regimes(bench, dwell, shape)]
    return {'of': 'sigma', 'ratio': ratio, 'dwell_s': dwell, 'dwell_shape': shape}


def _mean_levels(bench: Bench, gain: float, count: int, shape: float,
                 at_output: bool = False) -> dict[str, object]:
    """Switch the set-point between levels, 1.4..2 stationary standard deviations apart."""
    apart = bench.draw.uniform(1.4, 2.0) * gain * bench.stationary
    # A level has to last some relaxations to be one.
    least = max(0.3, 25 / bench.alpha0)
    dwell = [float(bench.draw.uniform(least, 3.0)) for _ in range(count)]
    levels = apart * (np.arange(count) - 0.5 * (count - 1))
    path = levels[_regimes(bench, dwell, shape)]
    if at_output:
        bench.series.append(path)
    else:
        bench.setpoint = path
    return {'of': 'mean', 'apart_v': apart, 'dwell_s': dwell, 'dwell_shape': shape}


def _either(bench: Bench, gain: float, count: int, shape: float) -> dict[str, object]:
    """Switch sigma or the mean, one as likely as the other."""
    which = _sigma_levels if bench.draw.random() < 0.5 else _mean_levels
    return which(bench, gain, count, shape)


@effect('regime_switching')
def regimes(bench: Bench, gain: float) -> dict[str, object]:
    """Let a converter change its mode, Markov, dwell 0.3..3 s: sigma or set-point, two levels."""
    return _either(bench, gain, 2, 1.0)


@effect('regime_switching/three_level')
def regimes_three(bench: Bench, gain: float) -> dict[str, object]:
    """Let there be three levels."""
    return _either(bench, gain, 3, 1.0)


@effect('regime_switching/semi_markov')
def regimes_semi(bench: Bench, gain: float) -> dict[str, object]:
    """Let the dwell times be more regular than exponential: gamma of shape 4."""
    return _either(bench, gain, 2, 4.0)


@effect('regime_switching/at_output')
def regimes_output(bench: Bench, gain: float) -> dict[str, object]:
    """Switch the ground of the sensor: the level moves at once, not at the rate alpha."""
    return _mean_levels(bench, gain, 2, 1.0, at_output=True)


def _change(bench: Bench, gain: float) -> float:
    """Draw by how much the restoring force differs from the linear one at two deviations."""
    # 0.4..0.8, but not so small on a slow rail, of which a minute holds few relaxations.
    least = max(0.4, math.sqrt(8 / bench.alpha0))
    return min(bench.draw.uniform(least, 0.8) * gain, 0.85)


@effect('nonlinear_restoring')
def restoring(bench: Bench, gain: float) -> dict[str, object]:
    """Make the source's current a nonlinear function of its voltage, in one of two ways."""
    # A source that limits its current: i = I tanh(x/(I R)), softer on both sides. Or one behind an
    # OR-ing diode: i = I (exp(-x/V) - 1), stiffer when the rail is low.
    change, two = _change(bench, gain), 2 * bench.stationary
    if bench.draw.random() < 0.5:
        change = min(change, 0.65)
        # tanh(u)/u = 1 - change, by Newton's chord from a point beyond.
        u = 6.0
        while math.tanh(u) / u < 1 - change:
            u *= 0.999
        scale, alpha, tanh = two / u, bench.alpha0, math.tanh
        bench.restoring = lambda x: -alpha * scale * tanh(x / scale)
        return {'shape': 'current_limit', 'change': change,
                'limit_a': scale / bench.resistance}
    u = 3.0
    while (math.exp(u) - 1) / u > 1 + change:
        u *= 0.999
    scale, alpha, expm1 = two / u, bench.alpha0, math.expm1
    bench.restoring = lambda x: alpha * scale * expm1(-x / scale)
    return {'shape': 'diode', 'change': change, 'diode_v': scale,
            'bias_a': scale / bench.resistance}


@effect('nonlinear_restoring/cubic')
def restoring_cubic(bench: Bench, gain: float) -> dict[str, object]:
    """Let a clamp (varistor) stiffen the rail on both sides as the cube."""
    change, alpha = 1.6 * _change(bench, gain), bench.alpha0
    cube = change / (2 * bench.stationary)**2
    bench.restoring = lambda x: -alpha * x * (1 + cube * x * x)
    return {'change': change, 'varistor_a_per_v3': cube / bench.resistance}


@effect('nonlinear_restoring/asymmetric')
def restoring_asymmetric(bench: Bench, gain: float) -> dict[str, object]:
    """Let a constant-power load soften the rail below its nominal voltage only."""
    change, alpha = min(1.15 * _change(bench, gain), 0.8), bench.alpha0
    knee, tanh = 0.5 * bench.stationary, math.tanh

    def force(x: float) -> float:
        return -alpha * x * (1 + change * tanh(x / knee)) if x < 0 else -alpha * x
    bench.restoring = force
    return {'change': change, 'load_w_per_v2': change / bench.resistance}
