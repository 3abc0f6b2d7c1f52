"""
First passage as samples see it: the chance that one of the next ones is beyond.

Units as in `passage_law`: stationary standard deviations, relaxation times.
Samples see fewer passages than the continuous path makes, and white noise of the
sensor shows some that are none.

Coarse steps: the transition density on Gauss-Legendre nodes, doubled again and
again; chances of being seen are added up, never taken from 1, so small ones keep
their relative accuracy.  Fine steps: the law of the continuous path with the
barrier moved by 0.5826 sqrt(2 step) (Broadie, Glasserman & Kou, Math. Finance 7
(1997) 325); with noise by what the same problem on a straight line says.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
import math

import numpy as np
from ou_monitor.model.passage.law import (
    log_normal_below, normal_below, passage_probability)
from ou_monitor.records import FloatArray

# The state is taken as within this many standard deviations.
_REACH = 4.7
# Nodes in a standard deviation of a step, or of the noise, and their most.
_DENSITY = 1.25
_MOST = 112
# Samples are taken together while the path moves by less than this part of the noise.
_SLIGHT = 0.35
# Noise of less than this part of what a step adds is none.
_NO_NOISE = 1e-4
# Of fine steps this part: it moves the barrier by 4e-4 of a step, and less noise would take
# thousands of nodes.
_NO_FINE_NOISE = 0.02
# Time, in relaxation times, after which where it began is forgotten.
_FORGOTTEN = 25.0


def sampled_passage_probability(start: float, barrier: float, step: float, count: float,
                                noise: float = 0.0) -> float:
    """Return the chance that any of the next samples is beyond a barrier."""
    if any(math.isnan(value) for value in (start, barrier, step, count, noise)):
        return math.nan
    if not step > 0.0:
        raise ValueError(f'step must be positive, in relaxation times, got {step}')
    if not (0.0 <= count < math.inf and count == math.floor(count)):
        raise ValueError(f'count must be a whole number of samples, got {count}')
    if not 0.0 <= noise < math.inf:
        raise ValueError(f'noise must be zero or positive and finite, got {noise}')
    if count == 0:
        return 0.0
    if math.isinf(barrier) or math.isinf(start):
        return 1.0 if barrier == -math.inf or start == math.inf > barrier else 0.0
    if noise < _NO_NOISE * math.sqrt(-math.expm1(-2.0 * step)):
        noise = 0.0
    grid = _panels(start, barrier, step, count, noise)
    if grid.count <= _MOST:
        return _doubled(start, barrier, step, int(count), noise, grid, 1.0)
    # Where the path hardly moves within the noise, several samples are one block.
    blocks = math.ceil(count / max(1.0, 0.5 * (_SLIGHT * noise) ** 2 / step))
    samples = count / blocks
    grid = _panels(start, barrier, step * samples, blocks, noise)
    if grid.count <= _MOST:
        return _doubled(start, barrier, step * samples, blocks, noise, grid, samples)
    return _fine(start, barrier, step, count, noise)


@lru_cache(maxsize=256)
def _straight(noise: float) -> tuple[float, FloatArray, FloatArray]:
    """
    Solve for a fine walk far below a barrier at 0: it does not feel the pull.

    The chance that a walk of unit normal steps is not seen grows as u(x), with
    u(x) = E[(1 - g(x')) u(x')], g the chance of being seen, and far below
    u = overstep - x.  Without noise the overstep is 0.5826.
    """
    # A walk much finer than the noise is looked at in blocks of samples, as it hardly
    # moves in one.
    block = max(1.0, (noise / 6.0) ** 2)
    unit = math.sqrt(block)
    noise = noise / unit
    low = -7.0 * noise - 8.0
    if noise == 0.0:
        x, weight = _gauss((low, 0.0), (0.7,))
    else:
        middle, fine = min(-5.0 * noise, -1.0), 0.5 * min(noise, 1.0)
        x, weight = _gauss((low, middle, 0.0, 5.0 * noise + 1.0), (1.0, fine, fine))
        weight = weight * np.exp(block * log_normal_below(-x / noise))
    kernel = _normal(x - x[:, None]) * weight
    # Below the grid the function is the line through its first value.
    below = normal_below(low - x)
    right = x - kernel @ x - x * below + _normal(low - x)
    kernel[:, 0] += below
    found = np.linalg.solve(np.eye(x.size) - kernel, right)
    return unit * float(found[0]), unit * x, unit * (found - x)


def _fine(start: float, barrier: float, step: float, count: float, noise: float) -> float:
    """Return the chance by that of the continuous path to a barrier that is moved."""
    unit = math.sqrt(2.0 * step)
    part = noise / unit
    overstep, x, u = _straight(float(f'{part:.3g}') if part >= _NO_FINE_NOISE else 0.0)
    at = (start - barrier) / unit
    gap = overstep - at if at <= x[0] else float(np.interp(at, x, u))
    moved = barrier + unit * overstep
    return float(passage_probability(moved - unit * max(gap, 0.0), moved, step * count))


def _normal(z: FloatArray) -> FloatArray:
    """Return the density of N(0, 1)."""
    density: FloatArray = np.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
    return density


@lru_cache(maxsize=128)
def _legendre(count: int) -> tuple[FloatArray, FloatArray]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes, weights


def _gauss(edges: tuple[float, ...], scales: tuple[float, ...]) -> tuple[FloatArray, FloatArray]:
    """Return Gauss-Legendre nodes and weights of adjacent panels that resolve given scales."""
    nodes, weights = [], []
    for low, high, scale in zip(edges[:-1], edges[1:], scales, strict=True):
        z, v = _legendre(_count(high - low, scale))
        nodes.append(0.5 * (low + high) + 0.5 * (high - low) * z)
        weights.append(0.5 * (high - low) * v)
    return np.concatenate(nodes), np.concatenate(weights)


def _count(width: float, scale: float) -> int:
    """Return how many nodes resolve a normal density of that scale, in steps of 4."""
    return max(8, 4 * math.ceil(_DENSITY * width / scale / 4.0))


@dataclass(frozen=True)
class _Grid:
    """Panels that the state is on while it is not seen, and what they cost."""

    edges: tuple[float, ...]
    scales: tuple[float, ...]

    @property
    def count(self) -> int:
        return sum(map(_count, np.diff(self.edges).tolist(), self.scales))


def _panels(start: float, barrier: float, step: float, count: float, noise: float) -> _Grid:
    """Return the panels on which paths to the barrier run."""
    spread = math.sqrt(-math.expm1(-2.0 * step))
    span = step * count
    wide = math.sqrt(-math.expm1(-2.0 * span))
    low = max(min(-_REACH, start - 1.0),
              min(start, start * math.exp(-span)) - _REACH * wide)
    low = min(low, barrier - _REACH * spread)
    if noise == 0.0:
        return _Grid((low, barrier), (spread,))
    # The chance of being seen changes within the noise.
    top = barrier + 5.0 * min(noise, 1.0)
    if noise >= spread:
        return _Grid((low, top), (spread,))
    return _Grid((low, max(barrier - 5.0 * noise, 0.5 * (low + barrier)), top), (spread, noise))


def _doubled(start: float, barrier: float, step: float, count: int, noise: float, grid: _Grid,
             samples: float) -> float:
    """
    Return the chance by doubling the kernel of one step.

    Of several samples in a step, the last and half of the others are taken at its
    end, and the rest at its begin.
    """
    x, weight = _gauss(grid.edges, grid.scales)
    phi, spread = math.exp(-step), math.sqrt(-math.expm1(-2.0 * step))
    begin = np.concatenate(([start], x))
    gap = (barrier - phi * begin) / math.hypot(spread, noise)
    kernel = _normal((x - phi * begin[:, None]) / spread) * weight
    if samples == 1.0:
        seen, unseen = normal_below(-gap), normal_below(gap)
        if noise > 0.0:
            kernel *= normal_below((barrier - x) / noise)
        # What the nodes miss of the chance not to be seen, the cut far below included.
        kernel *= (unseen / np.maximum(kernel.sum(axis=1), 1e-300))[:, None]
    else:
        kernel /= np.maximum(kernel.sum(axis=1), 1e-300)[:, None]
        each = log_normal_below((barrier - begin) / noise)
        hidden, later = 0.5 * (samples - 1.0) * each, 0.5 * (samples + 1.0) * each[1:]
        seen = -(kernel @ np.expm1(later)) * np.exp(hidden) - np.expm1(hidden)
        kernel *= np.exp(hidden[:, None] + later)
    first, matrix = kernel[0], kernel[1:]
    chance, power = seen[1:], matrix
    result = np.zeros(x.size)
    left, block = count - 1, 1
    while left and (block * step < _FORGOTTEN or left == 1):
        if left & 1:
            result = chance + power @ result
        left >>= 1
        if left:
            chance = chance + power @ chance
            power = power @ power
            block *= 2
    total = float(seen[0] + first @ result)
    if not left:
        return min(total, 1.0)
    # Now share block begins from the same law, and is seen at the same rate.
    law = first @ power
    size = float(law.sum())
    if size < 1e-290 or total >= 1.0:
        return 1.0
    share = min(float(law @ chance) / size, 1.0)
    if share >= 1.0:
        return 1.0
    return -math.expm1(math.log1p(-total) + left * math.log1p(-share))
