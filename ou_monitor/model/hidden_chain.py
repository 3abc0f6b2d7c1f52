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
        Log predictive density of each sample.

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
            whole = whole / whole.sum(axis=(0, 1))
    first = np.empty((blocks, k))
    law = start / start.sum()
    for b in range(blocks):
        first[b] = law
        law = law @ whole[:, :, b]
        law = law / law.sum()
    before = np.empty((size, k, blocks))
    norm = np.empty((size, blocks))
    now = first.T
    for j in range(size):
        before[j] = now
        now = (now[:, None] * padded[j]).sum(axis=0)
        norm[j] = now.sum(axis=0)
        now = now / norm[j]
    return (before.transpose(2, 0, 1).reshape(-1, k)[:n],
            np.log(norm.T.reshape(-1)[:n]) + top)
