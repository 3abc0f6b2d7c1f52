"""
Sections 3 and 8: the matrix as printed, averaging, and formulas (4) to (6) of switching.

The chain is simulated jump by jump, with exact motion between jumps: the recomputed numbers use no
limit theorem.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.paper import published
from ou_monitor.paper.crest import mean_and_error
from ou_monitor.paper.published import Printed, Row
from ou_monitor.paper.theory import (
    CORRECT_FACTOR, Generator, matrix_model, PRINTED_FACTOR, SwitchedSystem, switching_drift,
    switching_intensity)
from ou_monitor.records import FloatArray
from scipy.integrate import quad
from scipy.linalg import expm

WHERE = 'Section 3.3'
# Telegraph noise of +-SPEED, V/s, with RATE switches a second each way.
RATE, SPEED = 1000.0, 1.0
# Multiplicative noise dU = +-GROWTH U dt, 1/s; the limit's error is GROWTH^2 / (4 RATE^2).
GROWTH = 100.0
# Example coefficients, because the paper gives only alpha: damping and coupling, 1/s, and carrier,
# rad/s. The two states switch like an ESC at 24 kHz; each coefficient is 30 % above or below its
# mean.
DAMPING, COUPLING, CARRIER = 100.0, 40.0, 2.0 * math.pi * 10.0
_SWING = np.array([1.3, 0.7])


@dataclass(frozen=True, eq=False)
class IntegralVariance:
    """Variance of the integral of telegraph noise, from Monte Carlo."""

    t: FloatArray  # Times, s; shape (k,)
    # Variance and its standard error, V^2; shape (k,).
    variance: FloatArray
    error: FloatArray
    # Rates by formula (6) with the factor of 2 and without, V^2/s.
    correct: float
    printed: float


def telegraph() -> SwitchedSystem:
    """Return dU/dt = +-SPEED, switching at RATE each way."""
    return SwitchedSystem(Generator.telegraph(RATE, RATE), np.zeros((2, 1, 1)),
                          np.array([[SPEED], [-SPEED]]))


def three_states() -> SwitchedSystem:
    """Return a balanced additive system on a chain of three states that is not reversible."""
    chain = Generator(RATE * np.array([[-3.0, 2.5, 0.5], [0.2, -1.2, 1.0], [2.0, 0.3, -2.3]]))
    speeds = SPEED * np.array([2.0, -1.0, 0.5])
    return SwitchedSystem(chain, np.zeros((3, 1, 1)),
                          (speeds - chain.stationary @ speeds)[:, None])


def multiplicative() -> SwitchedSystem:
    """Return dU/dt = +-GROWTH U, switching at RATE each way."""
    return SwitchedSystem(Generator.telegraph(RATE, RATE),
                          np.array([[[GROWTH]], [[-GROWTH]]]))


def variance_rate(system: SwitchedSystem, rng: np.random.Generator,
                  paths: int) -> tuple[float, float]:
    """Return the long-run growth rate of the variance of a balanced additive system."""
    # (Var U(T) - Var U(S)) / (T - S), unbiased if S is longer than the memory of the chain.
    memory = 1.0 / float(system.generator.leaving.min())
    t = memory * np.array([0.0, 10.0, 110.0])
    u = system.simulate(t, [0.0], rng, paths=paths)[:, :, 0]
    return mean_and_error((u[:, 2] ** 2 - u[:, 1] ** 2) / (t[2] - t[1]))


def spreading(rng: np.random.Generator, paths: int) -> IntegralVariance:
    """Return the variance of the integral of telegraph noise over time."""
    system = telegraph()
    t = np.linspace(0.0, 30.0 / RATE, 31)
    u = system.simulate(t, [0.0], rng, paths=paths)[:, :, 0]
    variance = np.mean(u ** 2, axis=0)
    error = np.std(u ** 2, axis=0) / math.sqrt(paths)
    return IntegralVariance(t, variance, error, *(
        float(switching_intensity(system, [0.0], factor)[0, 0])
        for factor in (CORRECT_FACTOR, PRINTED_FACTOR)))


def rows(rng: np.random.Generator, paths: int = 20_000) -> list[Row]:
    """Return the rows of formulas (4) to (6)."""
    return [_potential(), *_intensity(rng, paths), *_drift(rng, paths)]


def _potential() -> Row:
    chain = telegraph().generator
    found, _ = quad(lambda t: float(expm(chain.q * t)[0, 0] - chain.stationary[0]),
                    0.0, 40.0 / RATE, epsrel=1e-10)
    return Row(WHERE, 'R0(0, 0) of a telegraph', 'ms', Printed(f'{1e3 * found:.6g}'),
               1e3 * float(chain.potential[0, 0]),
               'printed integral by quadrature, against (Pi - Q)^-1 - Pi',
               'The definition of the potential is right.')


def _intensity(rng: np.random.Generator, paths: int) -> list[Row]:
    found = []
    for name, what, system in (
            ('telegraph', f'+-{SPEED:g} V/s, {RATE:g} 1/s each way', telegraph()),
            ('three states', 'a chain that is not reversible', three_states())):
        printed = float(switching_intensity(system, [0.0], PRINTED_FACTOR)[0, 0])
        rate, error = variance_rate(system, rng, paths)
        found.append(Row(
            WHERE, f'B of (6), {name}', 'mV^2/s', Printed(f'{1e6 * printed:.4g}'), 1e6 * rate,
            f'long-run variance rate of the switching system ({what}), {paths} paths',
            f'The switching system spreads {rate / printed:.3f} +- {error / printed:.3f} times '
            'as fast as (6) says.', error=1e6 * error, point=1))
    return found


def _drift(rng: np.random.Generator, paths: int) -> list[Row]:
    system = multiplicative()
    drift = float(switching_drift(system).matrix[0, 0])
    span = 2.0 * RATE / GROWTH ** 2
    u = system.simulate(np.array([0.0, 0.5 * span, span]), [1.0], rng, paths=paths)[:, 1:, 0]
    # At this time the mean growth is large relative to its scatter.
    mean, error = mean_and_error(u[:, 0])
    rate, rate_se = 2.0 * math.log(mean) / span, 2.0 * error / mean / span
    # Contiguous: in NumPy 1.26 the last digit of a logarithm depends on the memory layout.
    log, log_se = mean_and_error(np.log(np.ascontiguousarray(u[:, 1])) / span)
    intensity = float(switching_intensity(system, [1.0], PRINTED_FACTOR)[0, 0])
    ito = drift - 0.5 * intensity
    # The limit omits a share GROWTH^2 / (4 RATE^2) of the drift.
    left = drift * (GROWTH / RATE) ** 2 / 4.0
    how = f'dU = +-{GROWTH:g} U dt, {RATE:g} 1/s each way, {paths} paths: growth'
    return [
        Row(WHERE, 'b/U of (5), multiplicative noise', '1/s', Printed(f'{drift:.6g}', 0.0), rate,
            f'{how} of the mean',
            f'The mean grows {rate / drift:.3f} +- {rate_se / drift:.3f} times as fast as (5) '
            'says: no factor is missing.', error=rate_se,
            inputs=(rate - left, rate + left), point=1),
        Row(WHERE, 'growth of ln U by (4) to (6)', '1/s', Printed(f'{ito:.6g}', 0.0),
            log, f'{how} of ln U',
            'ln U is driven by noise of mean zero and cannot grow; b - B/2U^2 vanishes only with '
            'the factor 2 in B.', error=log_se, point=1)]


def _late_over_early(path: FloatArray) -> FloatArray:
    log = np.log(path)
    return np.asarray((log[2] - log[1]) / (log[1] - log[0]))


def averaging_rows(rng: np.random.Generator, paths: int = 400) -> list[Row]:
    """Return the rows of sections 3.1 and 8."""
    tau = 1.0 / published.ALPHA.value
    # The matrix as printed, with the paper's alpha as gamma.
    printed = matrix_model(DAMPING, CARRIER, 0.0, published.ALPHA.value, printed=True)
    grown = float(printed.solve([0.0, tau], [1.0, 0.0, 1.0])[1, 2])
    half = 1.0 / CARRIER
    phase = printed.solve([0.0, half, 2.0 * half], [0.0, 1.0, 0.0])[:, 1]
    turned = float((phase[2] - phase[1]) / (phase[1] - phase[0]))
    # The matrix as the text intends it, with coefficients switched by an ESC.
    rate = 2.0 * published.ESC_HZ[0]
    system = SwitchedSystem.of_matrix_model(
        Generator.telegraph(rate, rate), alpha=DAMPING * _SWING, omega=CARRIER * _SWING,
        beta=COUPLING * _SWING, alpha_p=published.ALPHA.value * _SWING)
    t = np.array([0.0, 0.5 * tau, tau])
    u = system.simulate(t, [1.0, 0.0, 1.0], rng, paths=paths)
    amplitude, amplitude_se = _mean_decay_ratio(u[:, :, 0])
    power, power_se = _mean_decay_ratio(u[:, :, 2])
    limit = _late_over_early(system.averaged().solve(t, [1.0, 0.0, 1.0])[:, [0, 2]])
    advance = np.diff(u[:, :, 1].mean(axis=0))
    ratio = float(advance[1] / advance[0])
    how = f'{paths} paths of the matrix model switched at {1e-3 * published.ESC_HZ[0]:g} kHz'
    return [
        Row('Section 3.1', 'P(tau)/P(0), +gamma on the diagonal', '', Printed('< 1'), grown,
            'printed matrix, gamma = alpha as its note says',
            'The power grows by e in one tau; to relax, the entry must be -alpha.'),
        Row('Section 8', 'phase: late over early advance', '', Printed('1', 0.0), turned,
            'printed matrix over two spans of 1/omega',
            'The printed row is dphi/dt = omega phi, an exponential; with dphi/dt = omega the '
            f'switched model gives {ratio:.4f}: linear, as the paper says.'),
        Row('Section 8', 'amplitude: late over early decay', '', Printed('1', 0.0),
            amplitude, how, 'The mean amplitude decays as one exponential, as the paper says.',
            error=amplitude_se),
        Row('Section 8', 'power: late over early decay', '', Printed('1', 0.0), power,
            f'{how}, beta = {COUPLING:g} 1/s',
            f'Fed by the amplitude, the power is a sum of two exponentials (averaged model: '
            f'{limit[1]:.3f}); it is one exponential only if beta = 0.', error=power_se)]


def _mean_decay_ratio(paths: FloatArray) -> tuple[float, float]:
    """Return the late over early decay rate of the mean path, and its jackknife error."""
    count = len(paths)
    total = paths.sum(axis=0)
    value = float(_late_over_early(total[:, None] / count)[0])
    without = _late_over_early(((total - paths) / (count - 1)).T)
    error = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    return value, error
