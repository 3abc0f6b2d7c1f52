"""
Hidden Markov chains over many samples, in library code.

Forward probabilities are products of small matrices; the products of equal
blocks are formed side by side, so that the Python loop has a few hundred turns
whatever the number of samples (Rabiner, Proc. IEEE 77 (1989) 257, for the
recursion itself).
"""

from __future__ import annotations

import math

import numpy as np

from ou_monitor.records import FloatArray

# Products between two scalings: far from the smallest number, for the largest
# density of each sample is scaled to 1.
_EVERY = 8
# Probability that counts as none: a sample out of reach of all states that are possible.
_NONE = 1e-300


def forward(log_density: FloatArray, transition: FloatArray, start: FloatArray
            ) -> tuple[FloatArray, FloatArray]:
    """
    Filter.

    Parameters
    ----------
    log_density : ndarray, shape (n, k, k)
        Log density of each sample given the states before and at it.
    transition : ndarray, shape (k, k)
        Probabilities; rows add up to 1.
    start : ndarray, shape (k,)
        Law of the state before the first sample.

    Returns
    -------
    before : ndarray, shape (n, k)
        Law of the state before each sample, given all samples before.
    evidence : ndarray, shape (n,)
        Log predictive density of each sample; at least that of the likeliest
        state less 691, where that state cannot be reached.

    """
    n, k, _ = log_density.shape
    size = max(1, math.isqrt(n))
    blocks = -(-n // size)
    top = log_density.reshape(n, -1).max(axis=1)
    m = np.exp(log_density - top[:, None, None]) * transition
    # The last block is filled up with samples that say nothing.
    padded = np.broadcast_to(transition, (blocks * size, k, k)).copy()
    padded[:n] = m
    padded = np.ascontiguousarray(padded.reshape(blocks, size, k, k).transpose(1, 2, 3, 0))
    whole = padded[0]
    for j in range(1, size):
        whole = (whole[:, :, None] * padded[j][None]).sum(axis=1)
        if j % _EVERY == 0:
            total = whole.sum(axis=(0, 1))
            whole = whole / np.where(total > 0.0, total, 1.0)
    first = np.empty((blocks, k))
    law = start / start.sum()
    for b in range(blocks):
        first[b] = law
        law = law @ whole[:, :, b]
        law = _law(law[:, None], start)[:, 0]
    before = np.empty((size, k, blocks))
    norm = np.empty((size, blocks))
    now = first.T
    for j in range(size):
        before[j] = now
        now = (now[:, None] * padded[j]).sum(axis=0)
        norm[j] = np.maximum(now.sum(axis=0), _NONE)
        now = _law(now, start)
    return (before.transpose(2, 0, 1).reshape(-1, k)[:n],
            np.log(norm.T.reshape(-1)[:n]) + top)


def _law(weight: FloatArray, start: FloatArray) -> FloatArray:
    """Return weights, shape (k, blocks), as laws; as the first where all are too small."""
    total = weight.sum(axis=0)
    fresh = (start / start.sum())[:, None]
    law: FloatArray = np.where(total >= _NONE, weight / np.maximum(total, _NONE), fresh)
    return law
