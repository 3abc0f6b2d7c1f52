"""
A supply as a sum of terms, and its simulation.

Limits: parameters that change (throttle, sigma) are constant between two samples;
the docstring of each term states which of its effects are exact in law.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math
from typing import cast

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import charge_at, LoadStart, open_circuit, POWER
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Effect, Segment, Stage, Term
from ou_monitor.records import FloatArray

# Number of samples that `SupplyModel.simulate` draws at a time: limits memory, and keeps the data
# of all terms in the processor's caches.
SEGMENT = 15_000

# Relative difference below which steps count as equal, because stamps are rounded.
_ROUNDING = 1e-6


@dataclass(frozen=True)
class SupplyModel:
    """
    Terms that add up to a supply.

    Raises ValueError if the first term is not `ou`, or a term without `SEVERAL` occurs twice.

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor.model.supply import SupplyModel
    >>> from ou_monitor.model.terms.load_response import LoadSag
    >>> from ou_monitor.model.terms.ou import OU
    >>> model = SupplyModel((OU(alpha=63.0, sigma=0.3, u0=5.0), LoadSag(linear=0.4, square=0.0)))
    >>> t = np.arange(1000) / 1000.0
    >>> voltage = model.simulate(t, np.random.default_rng(1), throttle=np.where(t < 0.5, 0.0, 0.5))
    >>> bool(abs(voltage[:500].mean() - voltage[500:].mean() - 0.2) < 0.02)
    True

    """

    # The first is `ou`, which occurs once.
    terms: tuple[Term, ...]
    # Start values of the load filter at take-off, learned from this craft; None: unknown.
    load: LoadStart | None = None
    # Date in the model file on which the model was learned; empty: unknown.
    date: str = field(default='', compare=False)
    # Current at which the load is 1, A (negative if the sensor's current is negative); 0: the load
    # is throttle, 0..1.
    full_current: float = 0.0

    def __post_init__(self) -> None:
        names = [term.NAME for term in self.terms]
        if not names or names[0] != 'ou':
            raise ValueError("the first term of a model must be 'ou', got "
                             + (f"'{names[0]}'" if names else 'no term at all'))
        for term in self.terms:
            count = names.count(term.NAME)
            if count > 1 and not term.SEVERAL:
                raise ValueError(f"a model can have only one term '{term.NAME}', got {count}")

    @property
    def ou(self) -> OU:
        """Return the first term."""
        return cast('OU', self.terms[0])

    @property
    def left_out(self) -> tuple[str, ...]:
        """Return the names of the terms that change the rail but that the live risk ignores."""
        return tuple(term.NAME for term in self.terms
                     if term.STAGE in (Stage.DRIVE, Stage.STATE, Stage.LEVEL) and not term.LIVE)

    @property
    def charged(self) -> bool:
        """Return whether the charge is known: there is an entry `load`, and it is for throttle."""
        return self.load is not None and not self.full_current

    @property
    def needs_throttle(self) -> tuple[str, ...]:
        """Return the names of the terms that need throttle."""
        return tuple(term.NAME for term in self.terms if term.NEEDS_THROTTLE)

    def simulate(self, t: npt.ArrayLike, rng: np.random.Generator,
                 throttle: npt.ArrayLike | None = None) -> FloatArray:
        """
        Draw a recording, V (t in s, rising).

        throttle: 0..1, shape (n,), or one number; `Segment` states when each value applies.
        """
        stamps = np.asarray(t, dtype=np.float64)
        load = None if throttle is None else np.broadcast_to(
            np.asarray(throttle, dtype=np.float64), stamps.shape)
        run = Simulation(self, rng)
        voltage = np.empty(stamps.size)
        for begin in range(0, stamps.size, SEGMENT):
            part = slice(begin, begin + SEGMENT)
            voltage[part] = run.advance(stamps[part], None if load is None else load[part])
        return voltage


class Discharge:
    """Fall of the level as the pack discharges; `charge` is the remaining charge, 0..1."""

    def __init__(self, load: LoadStart, level: float, charge: float = math.nan) -> None:
        self._load = load
        # The charge at which the open-circuit voltage is the level of the model.
        self._origin = charge_at(level / load.cells)
        self.charge = self._origin if math.isnan(charge) else charge

    def __call__(self, s: Segment) -> None:
        """Lower the level as throttle draws charge in a segment."""
        step = np.where(np.isfinite(s.step), s.step, 0.0)
        left = self.charge - np.cumsum(self._load.discharge * s.throttle ** POWER * step)
        s.level += self._load.cells * (open_circuit(left) - open_circuit(self._origin))
        self.charge = float(left[-1])


class Simulation:
    """
    A simulation that continues from segment to segment; each term has its own generator.

    Except for rounding, a seed gives the same samples for any division into segments.
    `resistance` multiplies the response to throttle (above 1: an old pack), and may change between
    segments.  With `charge` (at the first sample, 0..1; NaN: the charge that matches the model's
    level), the level falls as throttle discharges the pack (`model.load`).  This replaces the
    `drift` term.
    """

    def __init__(self, model: SupplyModel, rng: np.random.Generator, *,
                 charge: float | None = None, resistance: float = 1.0) -> None:
        self._model = model
        self.resistance = resistance
        self.discharge: Discharge | None = None
        if charge is not None:
            if model.load is None or not model.charged:
                raise ValueError('the charge needs a model over throttle, but the load of this '
                                 'one is a current' if model.full_current else
                                 "the model has no entry 'load', which the charge needs")
            self.discharge = Discharge(model.load, model.ou.u0, charge)
        self._effects = self._in_order(rng)
        self._origin = math.nan
        self._last = -math.inf

    def advance(self, t: npt.ArrayLike, throttle: npt.ArrayLike | None = None) -> FloatArray:
        """Draw the next samples (t in s, result in V)."""
        stamps = np.asarray(t, dtype=np.float64)
        if stamps.ndim != 1:
            raise ValueError(f't must have shape (n,), got {stamps.shape}')
        if not stamps.size:
            return np.empty(0)
        step = np.diff(stamps, prepend=self._last)
        if not (np.isfinite(stamps).all() and (step > 0.0).all()):
            raise ValueError('stamps must be finite and rise, s')
        later = step[1:]
        if later.size and np.ptp(later) <= _ROUNDING * later[0]:
            later[:] = (stamps[-1] - stamps[0]) / later.size
        if math.isnan(self._origin):
            self._origin = float(stamps[0])
        s = self._segment(stamps, step, self._load(throttle, stamps))
        for effect in self._effects:
            effect(s)
        self._last = float(stamps[-1])
        return s.voltage

    def _in_order(self, rng: np.random.Generator) -> list[Effect]:
        """Return the effects of all terms in the order of their stages."""
        # The draws of a term depend only on the seed, its name and its index among terms of that
        # name, so adding other terms does not change them.
        seeds = rng.integers(0, 2**63, size=2).tolist()
        counts: dict[str, int] = {}
        pairs: list[tuple[Stage, Effect]] = []
        for term in self._model.terms:
            nth = counts[term.NAME] = counts.get(term.NAME, 0) + 1
            own = np.random.default_rng([*seeds, nth, *term.NAME.encode()])
            effect = term.start(own)
            if term.NAME == 'drift' and self.discharge is not None:
                effect = self.discharge
            elif term.FAMILY == 'load':
                effect = self._scaled(effect)
            pairs.append((term.STAGE, effect))
        if self.discharge is not None and not counts.get('drift'):
            pairs.append((Stage.LEVEL, self.discharge))
        effects = [effect for _, effect in sorted(pairs, key=lambda pair: pair[0])]
        at = sum(stage <= Stage.LEVEL for stage, _ in pairs)
        effects.insert(at, _join)
        return effects

    def _scaled(self, effect: Effect) -> Effect:
        """Return an effect of the load that multiplies the change of the level by `resistance`."""
        def scaled(s: Segment) -> None:
            if self.resistance == 1.0:
                effect(s)
                return
            before = s.level.copy()
            effect(s)
            s.level = before + self.resistance * (s.level - before)

        return scaled

    def _load(self, throttle: npt.ArrayLike | None, stamps: FloatArray) -> FloatArray:
        """Return throttle for all samples; NaN if no term needs it."""
        needs = self._model.needs_throttle
        if self.discharge is not None:
            needs = (*needs, 'load')
        if throttle is None:
            if needs:
                raise ValueError(f"the term '{needs[0]}' needs throttle, but none was given")
            return np.broadcast_to(math.nan, stamps.size)
        load = np.asarray(throttle, dtype=np.float64)
        if load.shape != stamps.shape:
            raise ValueError(f'throttle must have the shape of t, {stamps.shape}, got '
                             f'{load.shape}')
        if needs and not np.isfinite(load).all():
            raise ValueError(f"the term '{needs[0]}' needs throttle at every sample, but some of "
                             'it is not finite')
        return load

    def _segment(self, stamps: FloatArray, step: FloatArray, throttle: FloatArray) -> Segment:
        ou, n = self._model.ou, stamps.size
        return Segment(
            t=stamps, at=stamps, step=step, throttle=throttle, origin=self._origin,
            alpha=np.full(n, ou.alpha), sigma=np.full(n, ou.sigma), power=np.ones(n),
            push=np.zeros(n), bend=(0.0, 0.0),
            x=np.broadcast_to(0.0, n), level=np.full(n, ou.u0),
            noise=np.broadcast_to(1.0, n), voltage=np.broadcast_to(0.0, n))


def _join(s: Segment) -> None:
    """Add up the voltage of the rail, before any instrument."""
    s.voltage = s.x + s.level
