"""
What jumps and switching of a model file add to the risk, kept ready beside the live parameters.

Tables for the present alpha and sigma are made in a thread of their own, a few
tenths of a second each, and only looked up when a risk is asked for.  Limits:
the state of a regime is not followed, its stationary law is taken; sigma of the
window is that of all regimes together.
"""

from __future__ import annotations

import math
import threading

import numpy as np
import numpy.typing as npt
from ou_monitor.model.passage.extended import ExtendedPassage
from ou_monitor.model.passage.law import passage_probability
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.term import Live
from ou_monitor.records import FloatArray

# The live parameters may be so far from those prepared, in logarithms; further ones are
# taken as if they were there.
_NEAR = 0.1
_NEARLY_ONE = 1.0 - 1e-12


class EventRisk:
    """Risk that events of a model add; its tables are made in a thread, or waited for."""

    def __init__(self, model: SupplyModel, *, background: bool = True) -> None:
        kept = SupplyModel(tuple(term for term in model.terms if term.LIVE is not Live.BY_TIME))
        self._passage = ExtendedPassage(kept)
        self._background = background
        self._thread: threading.Thread | None = None
        self._at: tuple[float, float] | None = None
        self._wanted: tuple[float, float] | None = None

    @property
    def used(self) -> tuple[str, ...]:
        """Names of the terms that change the risk."""
        return self._passage.used

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names of the terms that move the supply and that the risk does not know of."""
        return self._passage.left_out

    def follow(self, ln_alpha: float, ln_sigma: float) -> None:
        """Have tables ready for parameters like these."""
        if not (self.used and math.isfinite(ln_alpha) and math.isfinite(ln_sigma)):
            return
        at = self._at
        if at is not None and max(abs(at[0] - ln_alpha), abs(at[1] - ln_sigma)) < 0.5 * _NEAR:
            return
        self._wanted = ln_alpha, ln_sigma
        if not self._background:
            self._make()
        elif self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._make, name='risk tables', daemon=True)
            self._thread.start()

    def _make(self) -> None:
        wanted = self._wanted
        if wanted is not None:
            self._passage.prepare(math.exp(wanted[0]), math.exp(wanted[1]))
            self._at = wanted

    def survival(self, start: npt.ArrayLike, level: float, horizon: float, *,
                 ln_alpha: npt.ArrayLike, ln_sigma: npt.ArrayLike, u0: npt.ArrayLike
                 ) -> FloatArray:
        """
        Return by what factor events lower the chance to get through the horizon.

        start in V, level in V, horizon in s.
        """
        a, e, v, mean = np.broadcast_arrays(*(
            np.asarray(x, dtype=np.float64) for x in (ln_alpha, ln_sigma, start, u0)))
        if not self.used:
            return np.zeros(a.shape)
        if self._at is None:
            return np.full(a.shape, math.nan)
        alpha = np.exp(np.clip(a, self._at[0] - _NEAR, self._at[0] + _NEAR))
        sigma = np.exp(np.clip(e, self._at[1] - _NEAR, self._at[1] + _NEAR))
        with_events = self._passage.probability(v, level, horizon, alpha=alpha, sigma=sigma,
                                                u0=mean)
        sd = sigma / np.sqrt(2.0 * alpha)
        without = passage_probability((mean - v) / sd, (mean - level) / sd, alpha * horizon)
        found: FloatArray = np.log1p(-np.minimum(with_events, _NEARLY_ONE)) - np.log1p(
            -np.minimum(without, _NEARLY_ONE))
        return np.minimum(found, 0.0)
