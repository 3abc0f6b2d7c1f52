"""Sections 3.1 and 8: what the matrix as printed does, and what averaging predicts."""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.paper.reproduce import paper
from ou_monitor.paper.reproduce.row import Printed, Row
from ou_monitor.paper.theory.markov_chain import Generator
from ou_monitor.paper.theory.matrix_model import MatrixModel
from ou_monitor.paper.theory.switched_system import SwitchedSystem
from ou_monitor.records import FloatArray

# An example, since the paper gives no values but alpha: rates 1/s, rad/s; two
# states that switch as an ESC of 24 kHz does, each coefficient +-30 % about its mean.
DAMPING, COUPLING, CARRIER = 100.0, 40.0, 2.0 * math.pi * 10.0
_SWING = np.array([1.3, 0.7])


def printed_matrix() -> MatrixModel:
    """Return the matrix of 3.1 as printed, with the paper's alpha as gamma."""
    return MatrixModel.as_printed(DAMPING, CARRIER, 0.0, paper.ALPHA.value)


def switched() -> SwitchedSystem:
    """Return the matrix model as the text means it, its coefficients switched by an ESC."""
    rate = 2.0 * paper.ESC_HZ[0]
    return SwitchedSystem.of_matrix_model(
        Generator.telegraph(rate, rate), alpha=DAMPING * _SWING, omega=CARRIER * _SWING,
        beta=COUPLING * _SWING, alpha_p=paper.ALPHA.value * _SWING)


def _late_over_early(path: FloatArray) -> FloatArray:
    """Return the log-decay of the second half over that of the first, by column."""
    log = np.log(path)
    return np.asarray((log[2] - log[1]) / (log[1] - log[0]))


def rows(rng: np.random.Generator, paths: int = 400) -> list[Row]:
    """Return the rows of sections 3.1 and 8."""
    tau = 1.0 / paper.ALPHA.value
    printed = printed_matrix()
    grown = float(printed.solve([0.0, tau], [1.0, 0.0, 1.0])[1, 2])
    half = 1.0 / CARRIER
    phase = printed.solve([0.0, half, 2.0 * half], [0.0, 1.0, 0.0])[:, 1]
    turned = float((phase[2] - phase[1]) / (phase[1] - phase[0]))
    system = switched()
    t = np.array([0.0, 0.5 * tau, tau])
    u = system.simulate(t, [1.0, 0.0, 1.0], rng, paths=paths)
    amplitude, amplitude_se = _of_mean(u[:, :, 0])
    power, power_se = _of_mean(u[:, :, 2])
    limit = _late_over_early(system.averaged().solve(t, [1.0, 0.0, 1.0])[:, [0, 2]])
    advance = np.diff(u[:, :, 1].mean(axis=0))
    ratio = float(advance[1] / advance[0])
    how = f'{paths} paths of the matrix model switched at {1e-3 * paper.ESC_HZ[0]:g} kHz'
    return [
        Row('Section 3.1', 'P(tau)/P(0), +gamma on the diagonal', '', Printed('< 1'), grown,
            'printed matrix, gamma = alpha as its note says',
            'The power grows by e in one tau; one that relaxes needs -alpha there.'),
        Row('Section 8', 'phase: late over early advance', '', Printed('1', 0.0), turned,
            'printed matrix over two spans of 1/omega',
            'The printed row is dphi/dt = omega phi, an exponential; with dphi/dt = omega the '
            f'switched model gives {ratio:.4f}, linear as said.'),
        Row('Section 8', 'amplitude: late over early decay', '', Printed('1', 0.0),
            amplitude, how, 'The mean amplitude decays as one exponential, as said.',
            error=amplitude_se),
        Row('Section 8', 'power: late over early decay', '', Printed('1', 0.0), power,
            f'{how}, beta = {COUPLING:g} 1/s',
            f'Fed by the amplitude, the power is a sum of two exponentials (averaged model: '
            f'{limit[1]:.3f}); it is pure only when beta = 0.', error=power_se)]


def _of_mean(paths: FloatArray) -> tuple[float, float]:
    """Return the late over early decay rate of the mean path, and its jackknife error."""
    count = len(paths)
    total = paths.sum(axis=0)
    value = float(_late_over_early(total[:, None] / count)[0])
    without = _late_over_early(((total - paths) / (count - 1)).T)
    error = math.sqrt((count - 1) / count * float(np.sum((without - without.mean()) ** 2)))
    return value, error
