"""
The same arithmetic compiled with Numba, where Numba is installed.

Optional: without Numba nothing here is used and nothing is missing but speed.
The scalar fit of model/arma.py is compiled from its own text; the two
loops over samples are written out here and tested against their NumPy twins to
1e-9.  Compiling takes seconds (half a second from Numba's cache), so it runs
in a thread; until it is done, and if it fails, NumPy does the work.
Set OU_MONITOR_COMPILED=0 to keep to NumPy.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import importlib.util
import logging
import math
import os
import threading
from typing import Any

import numpy as np
from ou_monitor.model import arma
from ou_monitor.records import FloatArray

# What the fit calls; each can be called from Python and from compiled code.
_SCALAR: tuple[Callable[..., Any], ...] = (
    arma.block_autocovariance, arma.theta_at, arma.noise_free_theta, arma.noise_share,
    arma.innovation_variance, arma.log_covariance, arma.objective, arma.innovation,
    arma.information, arma.polish, arma.minimise, arma.guess, arma.descend, arma.search,
    arma.finish, arma.trend_score, arma.fit_still)
# Sums may be reordered, which lets them run several at a time; NaN and infinity keep their
# meaning.
_REORDERED = {'reassoc', 'contract', 'nsz'}
# The largest finite double: NaN and infinity are not below it.
LARGEST = 1.7976931348623157e308


@dataclass(frozen=True)
class Kernels:
    """
    Compiled functions.

    Attributes
    ----------
    fit_sums, search, finish : callable
        Those of `model.arma`, for arrays.
    take_slots, add_slots, slide : callable
        Sums over slots, see the functions of these names.
    check : callable
        Whether samples are finite and evenly spaced, see `check`.

    """

    fit_sums: Callable[..., tuple[float, ...]]
    search: Callable[..., tuple[float, float, bool]]
    finish: Callable[..., tuple[float, ...]]
    take_slots: Callable[..., int]
    add_slots: Callable[..., FloatArray]
    slide: Callable[..., tuple[int, int, FloatArray]]
    check: Callable[..., bool]


def slot_sums(z, runs, edges, lags, rows):  # type: ignore[no-untyped-def]
    """Fill rows of `LagSums`, one per slot."""
    c = z.shape[0]
    at_place = 1 + c
    at_second = at_place + c
    at_pairs = at_second + c * c
    at_change = at_pairs + lags
    at_spread = at_change + lags * c
    for slot in range(edges.size - 1):
        begin = edges[slot]
        end = edges[slot + 1]
        row = rows[slot]
        row[:] = 0.0
        row[0] = end - begin
        whole = True
        for j in range(begin, end):
            if runs[j] < lags:
                whole = False
        for p in range(c):
            one = z[p, lags + begin:lags + end]
            first = 0.0
            place = 0.0
            for j in range(end - begin):
                first += one[j]
                place += one[j] * j
            row[1 + p] = first
            row[at_place + p] = place
            for q in range(p + 1):
                two = z[q, lags + begin:lags + end]
                second = 0.0
                for j in range(end - begin):
                    second += one[j] * two[j]
                row[at_second + p * c + q] = second
                row[at_second + q * c + p] = second
        for k in range(1, lags + 1):
            pairs = end - begin
            if not whole:
                pairs = 0
                for j in range(begin, end):
                    if runs[j] >= k:
                        pairs += 1
            row[at_pairs + k - 1] = pairs
            base = at_spread + (k - 1) * c * c
            for p in range(c):
                one = z[p, lags + begin:lags + end]
                one_back = z[p, lags + begin - k:lags + end - k]
                change = 0.0
                if whole:
                    # What enters at one end and leaves at the other.
                    for j in range(k):
                        change += z[p, lags + end - 1 - j] - z[p, lags + begin - 1 - j]
                else:
                    for j in range(end - begin):
                        if runs[begin + j] >= k:
                            change += one[j] - one_back[j]
                row[at_change + (k - 1) * c + p] = change
                for q in range(p + 1):
                    two = z[q, lags + begin:lags + end]
                    two_back = z[q, lags + begin - k:lags + end - k]
                    spread = 0.0
                    if whole:
                        for j in range(end - begin):
                            spread += (one[j] - one_back[j]) * (two[j] - two_back[j])
                    else:
                        for j in range(end - begin):
                            if runs[begin + j] >= k:
                                spread += (one[j] - one_back[j]) * (two[j] - two_back[j])
                    row[base + p * c + q] = spread
                    row[base + q * c + p] = spread


def take_slots(z, runs, t, origin, slot, last, number, lags, rows, begins, head, tail):  # type: ignore[no-untyped-def]  # noqa: E501
    """Sum new samples into the rows of `LagSums` (t in s)."""
    c = z.shape[0]
    edges = np.empty(2, dtype=np.int64)
    open_row = rows[:1]
    begin = 0
    while begin < t.size:
        own = math.floor((t[begin] - origin) / slot + 1e-6)
        end = begin + 1
        while end < t.size and math.floor((t[end] - origin) / slot + 1e-6) == own:
            end += 1
        edges[0] = begin
        edges[1] = end
        if begin == 0 and head < tail and own == last:
            open_row = np.empty((1, rows.shape[1]))
            slot_sums(z, runs, edges, lags, open_row)  # type: ignore[no-untyped-call]
            offset = number - begins[tail - 1]
            for p in range(c):
                open_row[0, 1 + c + p] += offset * open_row[0, 1 + p]
            for i in range(rows.shape[1]):
                rows[tail - 1, i] += open_row[0, i]
        else:
            row = rows[tail:tail + 1]
            slot_sums(z, runs, edges, lags, row)  # type: ignore[no-untyped-call]
            begins[tail] = number + begin
            tail += 1
        begin = end
    return tail


def add_slots(rows, begins, first, c):  # type: ignore[no-untyped-def]
    """Return the sums over slots."""
    total = np.zeros(rows.shape[1])
    for i in range(rows.shape[0]):
        offset = float(begins[i] - first)
        for j in range(rows.shape[1]):
            total[j] += rows[i, j]
        for p in range(c):
            total[1 + c + p] += offset * rows[i, 1 + p]
    return total


def slide(main, run, at, end, back, reference, origin, slot, last, number, lags, rows, begins, head, tail, first):  # type: ignore[no-untyped-def]  # noqa: E501
    """Bring the sums of the voltage alone up to date, and add them (reference in V)."""
    while head < tail and begins[head] < first:
        head += 1
    if at < end:
        z = np.zeros((1, lags + end - at))
        for j in range(back + end - at):
            z[0, lags - back + j] = main[1, at - back + j] - reference
        runs = run[at:end].copy()
        for j in range(min(lags - back, end - at)):
            runs[j] = min(runs[j], back + j)
        tail = take_slots(z, runs, main[0, at:end], origin, slot, last, number,  # type: ignore[no-untyped-call]  # noqa: E501
                          lags, rows, begins, head, tail)
    return head, tail, add_slots(rows[head:tail], begins[head:tail], first, 1)  # type: ignore[no-untyped-call]  # noqa: E501


def check(t, y, before, low, high):  # type: ignore[no-untyped-def]
    """Return whether samples are finite and evenly spaced."""
    bad = 0 if low <= t[0] - before <= high else 1
    for j in range(1, t.size):
        step = t[j] - t[j - 1]
        bad += 0 if (step >= low) & (step <= high) else 1
    for j in range(t.size):
        bad += 0 if abs(y[j]) <= LARGEST else 1
    return bad == 0


def build() -> Kernels:
    """Compile all kernels now; raises what Numba raises."""
    import numba  # type: ignore[import-not-found,unused-ignore]
    from numba.extending import register_jitable  # type: ignore[import-not-found,unused-ignore]

    for called in _SCALAR:
        register_jitable(called)
    register_jitable(add_slots)
    register_jitable(fastmath=_REORDERED)(slot_sums)
    register_jitable(fastmath=_REORDERED)(take_slots)
    compile_one = numba.njit(cache=True, nogil=True)
    kernels = Kernels(
        compile_one(arma.fit_sums), compile_one(arma.search), compile_one(arma.finish),
        numba.njit(cache=True, nogil=True, fastmath=_REORDERED)(take_slots),
        compile_one(add_slots), compile_one(slide), compile_one(check))
    # One call each with the types that are used, so that no caller waits.
    c = np.array([0.9, 0.8])
    kernels.fit_sums(np.array([100.0, 0.0, 0.0, 100.0, 99.0, 98.0, 0.0, 0.0, 19.8, 39.2]), 2,
                     math.nan, math.nan, 1)
    kernels.search(1.0, c, 97.0, -3.0, 0.1, 1, 0.0, 0.0)
    kernels.finish(1.0, c, 100, 97.0, -3.0, 0.1, False, 1)
    for size in (1, 5):
        rows = np.zeros((2, 1 + 2 * size + size * size + 2 * (1 + size + size * size)))
        begins = np.zeros(2, dtype=np.int64)
        stamps = np.zeros((2, 4))[0]
        kernels.take_slots(np.zeros((size, 6)), np.zeros(4, dtype=np.int8), stamps, 0.0, 1.0,
                           math.nan, 0, 2, rows, begins, 0, 0)
        kernels.add_slots(rows[:1], begins[:1], 0, size)
    kernels.slide(np.zeros((2, 8)), np.zeros(8, dtype=np.int8), 2, 6, 2, 0.0, 0.0, 1.0, math.nan,
                  0, 2, np.zeros((2, 10)), begins, 0, 0, 0)
    kernels.check(np.zeros(2), np.zeros(2), 0.0, 1.0, 2.0)
    return kernels


class Compilation:
    """Compiles once, in a thread; `ready` are the functions, None until they are there."""

    def __init__(self) -> None:
        self.ready: Kernels | None = None
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def start(self) -> threading.Thread | None:
        """Start compiling, once; return the thread, None where there is nothing to do."""
        with self._lock:
            if self._thread is None and wanted():
                self._thread = threading.Thread(target=self._work, daemon=True,
                                                name='ou_monitor-compile')
                self._thread.start()
            return self._thread

    def _work(self) -> None:
        try:
            self.ready = build()
        except Exception as error:  # a broken Numba must not stop the estimator: it is said
            logging.getLogger(__name__).warning('Numba is not used: %s', error)


COMPILED = Compilation()


def wanted() -> bool:
    """Whether Numba is installed and not switched off."""
    return (os.environ.get('OU_MONITOR_COMPILED', '1') != '0'
            and importlib.util.find_spec('numba') is not None)


def kernels(wait: bool = False) -> Kernels | None:
    """Return the compiled kernels if they are ready; start compiling if not."""
    if COMPILED.ready is None:
        thread = COMPILED.start()
        if wait and thread is not None:
            thread.join()
    return COMPILED.ready
