"""First-order recursions x_k = phi_k x_{k-1} + e_k, in compiled library code."""

from __future__ import annotations

import numpy as np
from ou_monitor.records import FloatArray
from scipy.linalg.lapack import dtbtrs
from scipy.signal import lfilter


def first_order(phi: FloatArray, e: FloatArray, before: float) -> FloatArray:
    """Run the recursion."""
    n = e.size
    if not n:
        return np.empty(0)
    if steady(phi[1:]):
        x: FloatArray = lfilter([1.0], [1.0, -phi[-1]], e, zi=[phi[0] * before])[0]
        return x
    # A lower bidiagonal system with a unit diagonal, laid out as LAPACK has it:
    # otherwise it is copied line by line.
    band = np.empty((2, n), order='F')
    band[0] = 1.0
    np.negative(phi[1:], out=band[1, :-1])
    band[1, -1] = 0.0
    right = np.array(e[:, None], order='F')
    right[0] += phi[0] * before
    solved: FloatArray = dtbtrs(band, right, uplo='L', diag='U', overwrite_b=True)[0][:, 0]
    return solved


def steady(values: FloatArray) -> bool:
    """Tell whether all values are the same."""
    # The last one first: what varies mostly differs there.
    return not values.size or values.strides == (0,) or bool(
        values[0] == values[-1] and (values == values[0]).all())
