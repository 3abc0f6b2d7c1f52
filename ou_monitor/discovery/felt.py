"""
What a model says in units that a pilot feels: the dip after a punch-out, and whose dips these are.

Limits first: a punch-out is a step from the least to the most throttle flown, held; of a dip it is
said that throttle made most of it, not that nothing else did.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from ou_monitor.criticism.samples import Samples
from ou_monitor.model.terms.term import Role, Term
from ou_monitor.records import FloatArray, NAN
from ou_monitor.text import number

# Throttle flown: shares of the samples below; seconds before and after a punch-out, and samples
# of it at most.
_FLOWN, _BEFORE, _AFTER, _MOST = (0.01, 0.99), 1.0, 5.0, 6000
# Shares of what comes back after which it has, and of the dip from which it counts.
_BACK, _COUNTS = 0.9, 0.1
# Falls that are closer than that, s, are one dip; where its bottom is looked for in the path.
_APART, _NEAR = 0.2, 0.05
# Share of a dip's depth from which throttle has made it.
_MADE = 0.5


@dataclass(frozen=True)
class Felt:
    """A model in units that a pilot feels."""

    # Throttle before and after a punch-out.
    low: float = NAN
    high: float = NAN
    # Deepest point of the mean after it, V below the voltage before, and when, s.
    dip: float = NAN
    after: float = NAN
    # What comes back while throttle is held, V, and 90 % of it within, s; 0 and NaN for none.
    recovered: float = 0.0
    within: float = NAN
    level: float = NAN  # Voltage, V, below which dips are counted
    # Dips, and those of which throttle made more than half.
    dips: int = 0
    made: int = 0

    def as_data(self) -> dict[str, Any]:
        """Return it as JSON holds it."""
        return {
            'punch_out': {'from': self.low, 'to': self.high, 'dip_v': self.dip,
                          'dip_after_s': self.after, 'recovered_v': self.recovered,
                          'recovered_within_s': self.within},
            'dips': {'level_v': self.level, 'count': self.dips, 'made_by_throttle': self.made}}

    @property
    def words(self) -> str:
        """Return it in a sentence or two; empty where throttle does nothing."""
        if not self.dip > 0.0:
            return ''
        found = (f'A punch-out from throttle {number(self.low, 2)} to {number(self.high, 2)} '
                 f'costs {number(self.dip, 2)} V')
        if self.recovered > 0.0:
            found += (f' after {number(1e3 * self.after, 2)} ms, of which '
                      f'{number(self.recovered, 2)} V come back within {number(self.within, 2)} s')
        found += '.'
        if self.dips:
            made = (f'made {self.made} of the {self.dips} dips' if self.dips > 1 else
                    f'{"made" if self.made else "did not make"} the one dip')
            found += f' Throttle {made} below {number(self.level, 4)} V.'
        return found


def felt(samples: Samples, terms: Sequence[Term], level: float) -> Felt:
    """Return what a model says of punch-outs, and of the dips below a level, V."""
    answers = [term for term in terms if term.ROLE is Role.MEAN and term.MEASURED]
    u = samples.throttle
    if u is None or not any(term.NEEDS_THROTTLE for term in answers):
        return Felt()
    low, high = np.quantile(u, _FLOWN).tolist()
    step = max(float(np.median(samples.step[1:])), (_BEFORE + _AFTER) / _MOST)
    t = step * np.arange(math.ceil((_BEFORE + _AFTER) / step), dtype=np.float64)
    held = [term for term in answers if term.NEEDS_THROTTLE]
    path = _path(Samples(t, t, np.where(t < _BEFORE, low, high)), held)
    begin = int(np.searchsorted(t, _BEFORE))
    fall = path[begin - 1] - path[begin:]
    deepest = int(np.argmax(fall))
    dip = float(fall[deepest])
    back = dip - fall[deepest:]
    recovered = float(back.max(initial=0.0))
    if not recovered > _COUNTS * dip:
        recovered = 0.0
    within = step * int(np.argmax(back >= _BACK * recovered)) if recovered else NAN
    dips, made = _dips(samples, _path(samples, answers), level)
    return Felt(low, high, dip, step * (deepest + 1), recovered, within, level, dips, made)


def _path(samples: Samples, answers: Sequence[Term]) -> FloatArray:
    """Return what throttle and time do to the mean, V."""
    s = samples.segment(1.0, 0.0)
    path = np.zeros(samples.n)
    for term in answers:
        path += term.columns(s) @ np.array(term.linear_values())
    return path


def _dips(samples: Samples, path: FloatArray, level: float) -> tuple[int, int]:
    """Return the number of dips below a level, V, and of those that the path makes."""
    v, t = samples.logged, samples.t
    below = np.flatnonzero(v < level)
    if not below.size:
        return 0, 0
    depth, made = float(np.median(v)), 0
    usual = float(np.median(path))
    groups = np.split(below, np.flatnonzero(np.diff(t[below]) > _APART) + 1)
    for group in groups:
        bottom = int(group[int(np.argmin(v[group]))])
        first, last = np.searchsorted(t, [t[bottom] - _NEAR, t[bottom] + _NEAR])
        lowest = float(path[first:last + 1].min())
        made += usual - lowest > _MADE * (depth - float(v[bottom]))
    return len(groups), made
