"""First-order recursions x_k = phi_k x_{k-1} + e_k, in compiled library code."""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray
from scipy.linalg.lapack import dtbtrs
from scipy.signal import lfilter


def first_order(phi: FloatArray, e: FloatArray, before: float) -> FloatArray:
    """
    Run the recursion.

    Parameters
    ----------
    phi, e : ndarray, shape (n,)
        Coefficients, 0..1, and what is added.
    before : float
        Value before the first.

    Returns
    -------
    ndarray, shape (n,)
        x.

    """
    n = e.size
    if not n:
        return np.empty(0)
    if n > 1 and np.all(phi[1:] == phi[1]):
        first = phi[0] * before + e[0]
        rest = lfilter([1.0], [1.0, -phi[1]], e[1:], zi=[phi[1] * first])[0]
        return np.concatenate(([first], rest))
    # A lower bidiagonal system with a unit diagonal.
    band = np.ones((2, n))
    band[1, :-1] = -phi[1:]
    right = e.copy()
    right[0] += phi[0] * before
    x: FloatArray = dtbtrs(band, right[:, None], uplo='L', diag='U')[0][:, 0]
    return x
