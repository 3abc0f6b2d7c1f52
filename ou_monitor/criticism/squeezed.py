"""
Where an input is squeezed rather than cut: a protection diode before the ADC.

Beyond a knee the reading rises as a logarithm.  Undone, it is an OU again: the
knee and the scale are those under which an AR(1) finds the readings likeliest,
the density of the transformed samples counted.
"""

from __future__ import annotations

import math

import numpy as np
from ou_monitor.records import FloatArray

# Shares of the samples beyond the knee, and scales in standard deviations of the
# innovations.  A larger scale is no limit but a bent characteristic.
_SHARES = (0.01, 0.02, 0.03, 0.045, 0.06, 0.08, 0.1)
_SCALES = (0.05, 0.1, 0.15, 0.2, 0.3)
# Evidence from which it is found, nats.
_FOUND = 50.0
# Falls from just below the knee, at least, and how noisy beside all; and stretches of the
# recording of which half must have been beyond it.
_FEWEST, _AS_NOISY, _PARTS = 30, 0.6, 10
# Beyond so many scales a reading says nothing of what was there.
_FAR = 8.0
# Sums of squares that are none; far from it, their inverse is still a number.
_TINY = 1e-280


def find_knee(voltage: FloatArray, noise: float, side: float) -> float | None:
    """Return where readings begin to be squeezed (voltage in V, noise in V)."""
    x = side * voltage
    plain = _likelihood(x)
    best, found = plain + _FOUND, None
    for share in _SHARES:
        knee = float(np.quantile(x, 1.0 - share))
        over = np.maximum(x - knee, 0.0)
        for scale in _SCALES:
            far = over / (scale * noise)
            if float(far.max()) > 1e3:
                continue
            part = np.minimum(far, _FAR)
            # Beyond, on along the tangent.
            stretched = np.expm1(part) + (far - part) * math.exp(_FAR)
            value = float(part.sum()) + _likelihood(
                np.minimum(x, knee) + scale * noise * stretched)
            if value > best:
                best, found = value, knee
    return side * found if found is not None and _is_limit(x, found) else None


def _is_limit(x: FloatArray, knee: float) -> bool:
    """
    Return whether noise is squeezed above a knee only, and now and then.

    A rail that is quiet while nothing draws current is near its top then, too: but
    just below as well, and for one long while.
    """
    step = np.diff(x)
    near = (x[:-1] < knee) & (x[:-1] > knee - 3.0 * float(np.std(step)))
    # What falls from just below the knee is not squeezed.
    below, all_ = step[near & (step < 0.0)], step[step < 0.0]
    if below.size < _FEWEST or float(np.sqrt(np.mean(below**2))) < _AS_NOISY * float(
            np.sqrt(np.mean(all_**2))):
        return False
    parts = np.array_split(x > knee, _PARTS)
    return sum(bool(part.any()) for part in parts) >= _PARTS // 2


def _likelihood(x: FloatArray) -> float:
    """Return the log-likelihood of an AR(1), but for a constant, nats."""
    a, b = x[:-1] - x[:-1].mean(), x[1:] - x[1:].mean()
    e = b - float(a @ b) / max(float(a @ a), _TINY) * a
    count = int(e.size)
    return -0.5 * count * math.log(max(float(e @ e), _TINY) / count)
