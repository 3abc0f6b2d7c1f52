"""
Level, sag, noise intensity and brown-out risk as curves over throttle.

They are those of the node (`ou_monitor.online.risk.outlook`), learned from the recording as the
node learns them in flight, so that both say the same of the same data, also where throttle never
stands still.  Limits: those of the node's curves; the risk is that of the supply as it was at the
end of the recording, settled at each throttle.  What has not been flown is NaN.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.analyze.sliding import Sliding
from ou_monitor.records import Estimate, FloatArray, NAN
from ou_monitor.text import Z95

_POINTS = 51


@dataclass(frozen=True, eq=False)
class ByThrottle:
    """
    Curves over throttle.

    Attributes
    ----------
    throttle : ndarray, shape (k,)
        0, 0.02, .. 1.
    known : ndarray of bool, shape (k,)
        Whether that throttle was flown; the curves are NaN elsewhere.
    level, level_se : ndarray, shape (k,)
        Mean voltage at the end of the recording, and its standard error, V.
    sag, sag_low, sag_high : ndarray, shape (k,)
        How far the level lies below that of the lowest throttle flown, and its 95 % interval, V.
        The errors of the two levels count as independent, which makes it too wide.
    sigma, sigma_low, sigma_high : ndarray, shape (k,)
        Noise intensity and its 95 % interval, V/sqrt(s).
    risk : ndarray, shape (k,)
        Probability of a brown-out within the horizon, with the errors of the curves in it.
    budget : float
        Highest throttle that keeps the risk within `limit`; NaN when unknown.
    budget_reason : str
        What ends it, or why it is not known.
    limit : float
        That risk.
    voltage, horizon : float
        What the risk is of, V and s.
    time : float
        Stamp of the estimate that the risk rests on, s; NaN when none could be used.

    """

    throttle: FloatArray
    known: npt.NDArray[np.bool_]
    level: FloatArray
    level_se: FloatArray
    sag: FloatArray
    sag_low: FloatArray
    sag_high: FloatArray
    sigma: FloatArray
    sigma_low: FloatArray
    sigma_high: FloatArray
    risk: FloatArray
    budget: float
    budget_reason: str
    limit: float
    voltage: float
    horizon: float
    time: float

    def at(self, throttle: float, name: str) -> float:
        """Return one curve at a throttle, between its points; NaN when unknown."""
        if math.isnan(throttle):
            return NAN
        return float(np.interp(throttle, self.throttle, getattr(self, name)))


def by_throttle(sliding: Sliding, has_throttle: bool) -> ByThrottle:
    """Read the curves that were learned from a recording."""
    outlook = sliding.outlook
    grid = np.linspace(0.0, 1.0, _POINTS)
    asked = math.isfinite(sliding.brownout_voltage)
    estimate = sliding.last_usable
    curves = outlook.curves
    unknown = np.full(_POINTS, NAN)
    # Without throttle all samples count as of throttle 0: that is no curve.
    known = curves.seen_curve(grid) & has_throttle
    level, level_se = (np.where(known, c, NAN) for c in curves.level_curve(grid))
    ln_sigma, ln_sigma_se = (np.where(known, c, NAN) for c in curves.sigma_curve(grid))
    # Without a usable one, the last says why there is no budget.
    given = estimate or (sliding.estimates[-1] if sliding.estimates else Estimate())
    budget = outlook.budget(given, sliding.settings)
    risk = unknown
    if asked and budget.throttles.size:
        risk = np.where(known, np.interp(grid, budget.throttles, budget.risks), NAN)
    first = int(known.argmax())
    sag = level[first] - level
    reach = np.where(np.arange(_POINTS) == first, 0.0, Z95 * np.hypot(level_se, level_se[first]))
    return ByThrottle(
        grid, known, level, level_se, sag, sag - reach, sag + reach, np.exp(ln_sigma),
        np.exp(ln_sigma - Z95 * ln_sigma_se), np.exp(ln_sigma + Z95 * ln_sigma_se), risk,
        budget.throttle if asked else NAN,
        # What the risk is of stands beside it.
        budget.reason.split(' Brown-out:')[0] if asked else 'No voltage was asked for.',
        budget.limit, sliding.brownout_voltage, sliding.brownout_horizon,
        estimate.t if estimate is not None else NAN)
