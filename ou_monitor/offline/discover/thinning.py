"""
Recordings too long to be fitted whole: which samples are used, and why.

Every k-th sample of an OU is an OU, and all terms keep their meaning, which an
average would not leave them; so samples are left out, and not averaged.  Where
that would lose the relaxation, a stretch from the middle is used instead.
"""

from __future__ import annotations

import math

import numpy as np

from ou_monitor.records import FloatArray

# Samples that are fitted at most.
MOST = 80_000
# Steps of up to this many relaxation times keep alpha identifiable.
_STEP = 0.3
# What (gamma(2L) - gamma(L)) / (gamma(4L) - gamma(2L)) is at that step, gamma
# being the variogram of an OU: exp(x) / (1 + exp(-x)).  White noise cancels.
_RATIO = math.exp(_STEP) / (1.0 + math.exp(-_STEP))
# Values looked at for it.
_LOOK = 1_000_000


def choose_samples(voltage: FloatArray, rate: float) -> tuple[slice, str]:
    """
    Return which samples to use.

    Parameters
    ----------
    voltage : ndarray, shape (n,)
        V.
    rate : float
        Samples per second, for the note, Hz.

    Returns
    -------
    which : slice
        Of at most `MOST` samples.
    note : str
        What was done; empty when all are used.

    """
    n = voltage.size
    if n <= MOST:
        return slice(0, n), ''
    factor = math.ceil(n / MOST)
    widest = _widest(voltage, factor)
    if widest >= factor:
        return slice(0, n, factor), (
            f'{n} samples: every {_nth(factor)} was used ({rate / factor:.4g} Hz); lines above '
            f'{0.5 * rate / factor:.4g} Hz show up at other frequencies.')
    size = MOST * widest
    first = (n - size) // 2
    what = f'every {_nth(widest)} was used' if widest > 1 else 'all were used'
    return slice(first, first + size, widest), (
        f'{n} samples: {what} of the {size / rate:.4g} s in the middle ({rate / widest:.4g} Hz), '
        'for the rail relaxes too fast for fewer; what is slower than that stretch is not seen.')


def _nth(k: int) -> str:
    ends = {1: 'st', 2: 'nd', 3: 'rd'}
    return f'{k}{"th" if k % 100 in (11, 12, 13) else ends.get(k % 10, "th")}'


def _widest(voltage: FloatArray, factor: int) -> int:
    """Return the largest whole step, up to `factor`, that keeps the relaxation."""
    first = max(0, (voltage.size - _LOOK) // 2)
    v = voltage[first:first + _LOOK]
    lag, seen = 1, False
    coarse = bool(np.mean(v[4:] == v[:-4]) > 0.1)
    while lag < factor and 16 * lag < v.size:
        near, mid, far = (_variogram(v, k * lag, coarse) for k in (1, 2, 4))
        # Squares of neighbours within 4 lags go together.
        error = 3.0 * far * math.sqrt(8.0 * lag / v.size)
        if far - mid > error:
            seen = True
            if (mid - near) / (far - mid) > _RATIO:
                return lag
        elif seen:
            # Risen and level: the relaxation lies before.
            return max(1, lag // 2)
        lag *= 2
    return factor


def _variogram(v: FloatArray, lag: int, coarse: bool) -> float:
    """
    Return half the variance of what a lag adds, up to a factor, V^2.

    Of the smaller half of the differences: the steps of a load, which are fewer,
    take as long to level off as they are apart, and would hide how fast the
    rail itself relaxes.  Not so for codes so coarse that half do not differ.
    """
    d = np.square(v[lag:] - v[:-lag])
    if coarse:
        return 0.5 * float(d.mean())
    half = d.size // 2 + 1
    return 0.5 * float(np.partition(d, half - 1)[:half].mean())
