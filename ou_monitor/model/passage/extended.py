"""
First passage of a supply whose OU is pushed and switched by other terms.

What a model file can add to the risk: `jumps`, `regime_switching` and `volatility`.
Terms of the sensor (measurement noise, glitches, codes, clocks) do not shake the
supply and add nothing; those that follow throttle are in the live parameters.
What moves the supply otherwise is left out, by name.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
import math
import threading

import numpy as np
import numpy.typing as npt
from ou_monitor.model.passage.law import passage_probability, prepare
from ou_monitor.model.passage.with_events import (
    build, Chain, EventTable, Jump, longest, without_event)
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.regime_switching import RegimeSwitching
from ou_monitor.model.terms.segment import Stage
from ou_monitor.model.terms.shocks import Jumps
from ou_monitor.model.terms.term import Live, Term
from ou_monitor.model.terms.volatility import Volatility
from ou_monitor.records import FloatArray
from scipy.special import binom

# Stages at which a term moves the supply, not its reading.
_MOVES_SUPPLY = (Stage.DRIVE, Stage.STATE, Stage.LEVEL)
# Levels of ln sigma, out to sqrt(6) standard deviations.
_LEVELS = 7
# States of all chains together, at most.
_MOST_STATES = 14
# A sigma below this part of the largest one is taken as it.
_LEAST_RATIO = 0.02
# Tables are made at steps of this in ln alpha and in the logarithm of the stationary
# standard deviation; so many are kept, and they reach so many steps beyond those around.
_STEP = 0.1
_KEPT = 24
_REACH = 1.5

Key = tuple[int, int]


@dataclass(frozen=True, eq=False)
class _Cell:
    """The tables at the corners around what was prepared."""

    corner: Key
    tables: tuple[EventTable, ...]


class ExtendedPassage:
    """
    Probability of going below a level, with other terms of a model; its `ou` is given live.

    `prepare` makes tables for a small range of alpha and sigma, in a thread of its own if wished;
    `probability` only looks them up.  `used` and `left_out` name the terms that change the risk,
    and those that move the supply and that the risk does not know of.
    """

    def __init__(self, model: SupplyModel) -> None:
        self._jumps: list[Jumps] = []
        self._chain = _one_state()
        used: list[str] = []
        left_out: list[str] = []
        for term in model.terms:
            if term.LIVE is Live.BY_THROTTLE or term.STAGE not in _MOVES_SUPPLY:
                continue
            (used if self._take(term) else left_out).append(term.NAME)
        self.used, self.left_out = tuple(used), tuple(left_out)
        self._plain = not self._jumps and self._chain.law.size == 1
        # Without volts in it a table holds for any sigma.
        self._in_volts = bool(self._jumps or np.any(self._chain.level))
        self._corners = ((0, 0), (1, 0), (0, -1), (0, 1)) if self._in_volts else ((0, 0), (1, 0))
        self._lock = threading.Lock()
        self._kept: OrderedDict[Key, EventTable] = OrderedDict()
        self._cell: _Cell | None = None

    def _take(self, term: Term) -> bool:
        """Take a term in, or return False."""
        if isinstance(term, Jumps):
            if term.rate > 0.0:
                self._jumps.append(term)
            return True
        if isinstance(term, RegimeSwitching):
            chain = _switching(term)
        elif isinstance(term, Volatility):
            chain = _wandering(term)
        else:
            return False
        both = self._chain.times(chain)
        if both.law.size > _MOST_STATES:
            return False
        self._chain = both
        return True

    def prepare(self, alpha: float, sigma: float) -> None:
        """
        Make the tables around the present parameters, unless they are there.

        A few tenths of a second for each new pair, up to four; safe in a thread
        beside `probability`.

        alpha in 1/s, sigma in V/sqrt(s).
        """
        _check(alpha, sigma)
        prepare()
        if self._plain:
            return
        corner = (math.floor(math.log(alpha) / _STEP),
                  round(math.log(sigma / math.sqrt(2.0 * alpha)) / _STEP) if self._in_volts else 0)
        with self._lock:
            if self._cell is not None and self._near(self._cell, alpha, sigma):
                return
            self._cell = _Cell(corner, tuple(
                self._table((corner[0] + i, corner[1] + j)) for i, j in self._corners))

    def _near(self, cell: _Cell, alpha: float, sigma: float) -> bool:
        """Return whether the tables of a cell are good for these parameters."""
        i = math.log(alpha) / _STEP - cell.corner[0]
        j = math.log(sigma / math.sqrt(2.0 * alpha)) / _STEP - cell.corner[1]
        return abs(i - 0.5) <= 1.0 and (abs(j) <= 1.0 or not self._in_volts)

    def _table(self, key: Key) -> EventTable:
        """Return the table at a pair of parameters, made now or before."""
        found = self._kept.get(key)
        if found is None:
            alpha, sd = (math.exp(_STEP * k) for k in key)
            chain = self._scaled(alpha, sd)
            jumps = tuple(Jump(jump.rate / alpha, -jump.mean / sd, jump.std / sd)
                          for jump in self._jumps)
            found = build(chain, jumps)
            self._kept[key] = found
        self._kept.move_to_end(key)
        while len(self._kept) > max(4, _KEPT // self._chain.law.size):
            self._kept.popitem(last=False)
        return found

    def _scaled(self, alpha: float, sd: float) -> Chain:
        """Return the chain in relaxation times and standard deviations, towards the barrier."""
        c = self._chain
        return Chain(c.rates / alpha, -c.level / sd, -c.at_once / sd, c.ratio, c.law)

    def probability(self, start: npt.ArrayLike, level: npt.ArrayLike, horizon: npt.ArrayLike, *,
                    alpha: npt.ArrayLike, sigma: npt.ArrayLike, u0: npt.ArrayLike) -> FloatArray:
        """
        Return the chance that the supply goes below a level within a horizon.

        The state of a regime or of sigma is unknown at the begin: the stationary
        law is taken.  All arguments broadcast.

        start in V, level in V, horizon in s.
        """
        v, low, h, a, e, mean = np.broadcast_arrays(*(
            np.asarray(value, np.float64) for value in (start, level, horizon, alpha, sigma, u0)))
        if (a <= 0.0).any() or (e <= 0.0).any():
            raise ValueError('alpha and sigma must be positive, 1/s and V/sqrt(s)')
        if (h < 0.0).any():
            raise ValueError('horizon must be zero or positive, s')
        shape = v.shape
        v, low, h, a, e, mean = (value.ravel() for value in (v, low, h, a, e, mean))
        sd = e / np.sqrt(2.0 * a)
        b, gap, s = (mean - low) / sd, (v - low) / sd, h * a
        if self._plain:
            return passage_probability(b - gap, b, s).reshape(shape)
        result = np.where(gap <= 0.0, 1.0, math.nan)
        result[np.isnan(mean) | np.isnan(sd) | np.isnan(h)] = math.nan
        result[(gap > 0.0) & (h == 0.0)] = 0.0
        cell = self._cell
        if cell is None:
            return result.reshape(shape)
        i = np.log(a) / _STEP - cell.corner[0]
        j = np.log(sd) / _STEP - cell.corner[1] if self._in_volts else np.zeros(sd.size)
        known = ((np.abs(i - 0.5) < _REACH + 0.5) & (np.abs(j) < _REACH + 0.5) & (gap > 0.0)
                 & (s > 0.0) & np.isfinite(b) & np.isfinite(gap) & np.isfinite(s))
        if known.any():
            result[known] = self._looked_up(cell, b[known], gap[known], s[known], a[known],
                                            sd[known], i[known], j[known])
        return result.reshape(shape)

    def _looked_up(self, cell: _Cell, b: FloatArray, gap: FloatArray, s: FloatArray,
                   alpha: FloatArray, sd: FloatArray, i: FloatArray, j: FloatArray) -> FloatArray:
        """Return probabilities from tables, for each point of arrays of shape (n,)."""
        c = self._chain
        leave = (c.rates.sum(axis=1) + sum(jump.rate for jump in self._jumps))[:, None] / alpha
        level = -c.level[:, None] / sd
        # The table's entry is taken as linear in ln alpha and as a parabola in ln sd; at
        # the same voltages, as what events bring depends on them more than on the noise.
        if self._in_volts:
            weights = [1.0 - i - j * j, i, 0.5 * j * (j - 1.0), 0.5 * j * (j + 1.0)]
            scales = [np.exp(_STEP * (j - y)) for _, y in self._corners]
        else:
            weights, scales = [1.0 - i, i], [np.ones(i.size)] * 2

        def within(s: FloatArray) -> FloatArray:
            """Return the probability within spans that the tables reach."""
            log = sum(w * table.log_hazard(scale * b, scale * gap, s)
                      for w, scale, table in zip(weights, scales, cell.tables, strict=True))
            calm = np.exp(-leave * s)
            each = (calm * without_event(b, gap, s, level, c.ratio)
                    + np.expm1(-leave * s) * np.expm1(-np.exp(log)))
            chance: FloatArray = c.law @ each
            return np.minimum(chance, 1.0)

        end = longest()
        result = within(np.minimum(s, end))
        long = s > end
        if long.any():
            # Then passages come at a steady rate.
            near = within(np.full(s.size, 0.7 * end))
            with np.errstate(divide='ignore', invalid='ignore'):
                left = np.log1p(-result)
                rate = np.maximum(np.log1p(-near) - left, 0.0) / (0.3 * end)
                later = -np.expm1(left - rate * (s - end))
            result = np.where(long & (result < 1.0), later, result)
        return result


def _one_state() -> Chain:
    """Return the chain that does nothing."""
    return Chain(np.zeros((1, 1)), np.zeros(1), np.zeros(1), np.ones(1), np.ones(1))


def _switching(term: RegimeSwitching) -> Chain:
    """Return the chain of a regime switching: per second, levels in volts."""
    n = int(term.states)
    state = np.arange(n, dtype=np.float64)
    ones = np.ones((n, n))
    rates = term.rate_up * np.triu(ones, 1) + term.rate_down * np.tril(ones, -1)
    flow = np.vstack((rates.T - np.diag(rates.sum(axis=1)), ones[:1]))
    law = np.linalg.lstsq(flow / flow.max(axis=1, keepdims=True),
                          np.eye(n + 1)[-1] / flow[-1].max(), rcond=None)[0]
    return Chain(rates, term.level * state, term.at_once * term.level * state,
                 np.maximum(term.sigma_ratio ** state, _LEAST_RATIO), law)


def _wandering(term: Volatility) -> Chain:
    """
    Return a chain for a ln sigma that wanders, per second.

    That of Ehrenfest: it has the variance, the rate and, at each level, the mean
    drift of the OU.
    """
    if term.std == 0.0:
        return _one_state()
    n = _LEVELS - 1
    up = np.arange(n + 1.0)
    rates = 0.5 * term.rate * (np.diag(n - up[:-1], 1) + np.diag(up[1:], -1))
    log = term.std * (2.0 * up - n) / math.sqrt(n)
    return Chain(rates, np.zeros(n + 1), np.zeros(n + 1), np.maximum(np.exp(log), _LEAST_RATIO),
                 binom(n, up) / 2.0**n)


def _check(alpha: float, sigma: float) -> None:
    """Refuse parameters of no OU."""
    if not (alpha > 0.0 and math.isfinite(alpha)):
        raise ValueError(f'alpha must be positive and finite, got {alpha} 1/s')
    if not (sigma > 0.0 and math.isfinite(sigma)):
        raise ValueError(f'sigma must be positive and finite, got {sigma} V/sqrt(s)')
