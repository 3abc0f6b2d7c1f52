"""
Hidden Markov chains over many samples, without a Python loop over samples.

Forward probabilities are products of small matrices (Rabiner, Proc. IEEE 77 (1989) 257).  The
samples are split into blocks of equal length, whose products are computed side by side.  So the
number of iterations in Python grows only with the square root of the number of samples.
"""

from __future__ import annotations

import math
from operator import mul

import numpy as np
from ou_monitor.records import FloatArray

# Number of products, and of levels of pairwise products, between two normalisations: too few to
# underflow, because the largest density of each sample is scaled to 1.
_EVERY, _LEVELS = 8, 3
# Samples per block, relative to the square root of the number of samples: below 1, because a step
# within the blocks (arrays) costs more than a step from block to block (plain Python).
_SHORT = 0.4
# Probability below which a sample counts as impossible in every state.
_NONE = 1e-300


def forward(log_density: FloatArray, transition: FloatArray, start: FloatArray
            ) -> tuple[FloatArray, FloatArray]:
    """Return the state probabilities before each sample, and the log density of each sample."""
    # log_density: of each sample, given the previous and the present state, shape (n, k, k).
    n, k, _ = log_density.shape
    top, padded = _in_blocks(log_density, transition)
    size, blocks = padded.shape[0], padded.shape[3]
    first = _before_blocks(padded, start)
    before = np.empty((size, k, blocks))
    norm = np.empty((size, blocks))
    now = first.T
    for j in range(size):
        before[j] = now
        now = (now[:, None] * padded[j]).sum(axis=0)
        norm[j] = np.maximum(now.sum(axis=0), _NONE)
        now = _normalised(now, start)
    return (before.transpose(2, 0, 1).reshape(-1, k)[:n],
            np.log(norm.T.reshape(-1)[:n]) + top)


def smoothed(log_density: FloatArray, transition: FloatArray, start: FloatArray) -> FloatArray:
    """Return the probabilities of the states at each sample, given all samples, shape (n, k)."""
    ahead = forward(log_density, transition, start)[0][1:]
    behind = forward(log_density[::-1].transpose(0, 2, 1), transition.T,
                     np.ones(start.size))[0][::-1]
    both: FloatArray = np.concatenate((ahead, ahead[-1:])) * behind
    law: FloatArray = both / np.maximum(both.sum(axis=1, keepdims=True), _NONE)
    return law


def log_likelihood(log_density: FloatArray, transition: FloatArray, start: FloatArray) -> float:
    """Return the sum of the log densities of `forward`, much faster."""
    k = transition.shape[0]
    log: FloatArray = log_density.transpose(1, 2, 0)
    top = _largest(log)
    total = float(top.sum())
    m: FloatArray = np.empty(log.shape)
    for i, j in np.ndindex(k, k):
        np.exp(log[i, j] - top, out=m[i, j])
        m[i, j] *= transition[i, j]
    # Multiply neighbours in pairs, then pairs of pairs, and so on.
    level = 0
    while m.shape[2] > 1:
        if m.shape[2] % 2:
            m = np.concatenate((m, np.eye(k)[:, :, None]), axis=2)
        left, right = m[:, :, ::2], m[:, :, 1::2]
        m = left[:, 0, None] * right[None, 0]
        for j in range(1, k):
            m += left[:, j, None] * right[None, j]
        level += 1
        if level % _LEVELS == 0 or m.shape[2] == 1:
            scale = m.sum(axis=(0, 1))
            if not scale.all():
                return -math.inf
            m /= scale
            total += float(np.log(scale).sum())
    left_over = float((start / start.sum() @ m[:, :, 0]).sum())
    return total + math.log(left_over) if left_over > 0.0 else -math.inf


def _largest(log: FloatArray) -> FloatArray:
    """Return the largest element of each matrix, shape (k, k, n)."""
    top: FloatArray = log[0, 0].copy()
    for i, j in np.ndindex(log.shape[:2]):
        np.maximum(top, log[i, j], out=top)
    return top


def _in_blocks(log_density: FloatArray, transition: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log of each sample's scale, and scaled factors, shape (size, k, k, blocks)."""
    n, k, _ = log_density.shape
    log: FloatArray = log_density.transpose(1, 2, 0)
    size = max(1, round(_SHORT * math.sqrt(n)))
    blocks = -(-n // size)
    top = _largest(log)
    padded = np.empty((size, k, k, blocks))
    # The last block is padded with samples whose density is 1 in all states.
    row = np.zeros(blocks * size)
    for i, j in np.ndindex(k, k):
        np.exp(log[i, j] - top, out=row[:n])
        row[n:] = 1.0
        np.multiply(row.reshape(blocks, size).T, transition[i, j], out=padded[:, i, j])
    return top, padded


def _before_blocks(padded: FloatArray, start: FloatArray) -> FloatArray:
    """Return the probabilities of the states before each block."""
    size = padded.shape[0]
    whole = padded[0]
    for j in range(1, size):
        whole = (whole[:, :, None] * padded[j][None]).sum(axis=1)
        if j % _EVERY == 0:
            total = whole.sum(axis=(0, 1))
            whole = whole / np.where(total > 0.0, total, 1.0)
    # For these few numbers, plain Python is faster than arrays.
    fresh = law = (start / start.sum()).tolist()
    first = []
    for product in whole.transpose(2, 0, 1).tolist():
        first.append(law)
        weight = [sum(map(mul, law, column)) for column in zip(*product)]
        total = sum(weight)
        law = [one / total for one in weight] if total >= _NONE else fresh
    return np.array(first)


def _normalised(weight: FloatArray, start: FloatArray) -> FloatArray:
    """Normalise weights, shape (k, blocks); columns that sum to about 0 become `start`."""
    total = weight.sum(axis=0)
    fresh = (start / start.sum())[:, None]
    law: FloatArray = np.where(total >= _NONE, weight / np.maximum(total, _NONE), fresh)
    return law
