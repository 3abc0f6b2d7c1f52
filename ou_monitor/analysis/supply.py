"""
Compute the facts that all commands report (sag, noise, dips, resistance, OU): `supply_facts`.

Sag, resistance and budget are the node's values at the end of the recording.  Noise, alpha, sigma
and Var_inf come from regressions of the voltage on level, throttle and current
(`ou_monitor.model.ou_fit`): noise is their residual; alpha, sigma and Var_inf come from the
shortest window at the end of the recording in which alpha is known within a factor of 1.5, else
from the longest.

The limits of that fit and of the node's filter apply.  The filter takes most of the time: 1.6 s of
CPU time for 130 s at 200 Hz; with a limit, the budget raises this to 4 s.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
import math
from typing import Any

import numpy as np
from ou_monitor.analysis.noise import (
    dip_begins, floats, is_below, Noise, noise_of, Remainder, remainder, rise_that_ends, THROTTLES,
    without_wild)
from ou_monitor.model.ou_fit import known_ou
from ou_monitor.online.estimator.estimator import SLIDING
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import AT_ONCE, hold, SupplyLoad
from ou_monitor.online.monitor import MonitorReport, SupplyMonitor
from ou_monitor.online.risk.forecast import LOOK
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.records import FloatArray, NAN, OuFacts, plain_data, Recording
from ou_monitor.timeline import ordered, readings_of, supplied

# Maximum evaluations of the risk: as many as the node makes in 15 minutes.
_LOOKS = 900.0 / LOOK
# Number of reports of the node that are shown; maximum time between two reports, s, and maximum
# number of reports in all.
_POINTS, _STEP, _MOST = 300, 0.5, 1200
# Samples pushed at once: limits memory.
_SLICE = 100_000
# Maximum number of dips that are listed.
_DEEPEST = 10
# Common voltage alarms, V per cell, around Betaflight's vbat_warning_cell_voltage of 3.5.
ALARMS = (3.7, 3.6, 3.5, 3.4, 3.3)


@dataclass(frozen=True)
class Lowest:
    """Lowest reading."""

    voltage_v: float  # V
    time_s: float  # time since the first reading, s
    throttle: float  # 0..1


@dataclass(frozen=True)
class Dip:
    """One dip below a limit."""

    begin_s: float  # time from the first reading to its start, s
    lowest_v: float  # V
    seconds: float  # time below, s
    throttle: float  # at its lowest reading, 0..1


@dataclass(frozen=True)
class Dips:
    """Dips below a limit; one lasts until a reading exceeds limit plus hysteresis."""

    limit_v: float  # V
    count: int  # dips
    seconds: float  # total time below, s
    longest_s: float  # time below in the longest dip, s
    first_s: float = NAN  # time from the first reading to the first dip, s
    brief: int = 0  # dips shorter than a second
    deepest: tuple[Dip, ...] = ()  # at most `_DEEPEST` dips, the deepest first


@dataclass(frozen=True)
class Sag:
    """Sag one second after a step to each throttle, positive, at the end of the recording."""

    known: bool  # whether the sag is known over the throttles flown
    flown: tuple[float, float]  # 1 % and 99 % quantile of throttle
    throttle: tuple[float, ...]  # 0..1
    sag_v: tuple[float, ...]  # V
    se_v: tuple[float, ...]  # V


@dataclass(frozen=True)
class Resistance:
    """Resistance after a second at constant current."""

    ohm: float  # Ohm; NaN without a current that moves the voltage
    se_ohm: float  # Ohm
    at_once_ohm: float = NAN  # after 0.1 s, Ohm; NaN with fewer than 20 readings per second


@dataclass(frozen=True)
class Budget:
    """Highest throttle that keeps the risk at the end of the recording within `risk`."""

    throttle: float  # 0..1; NaN: unknown
    limit_v: float  # V
    horizon_s: float  # s
    risk: float  # 0..1


@dataclass(frozen=True)
class SupplyFacts:
    """
    The facts of a supply; see `supply_facts`.

    Attributes
    ----------
    lowest : Lowest
        Lowest reading.
    dips : Dips or None
        Dips below the limit; None without a limit.
    sag : Sag
        Sag over throttle.
    noise : Noise
        Noise over throttle.
    resistance : Resistance
        Resistance, from the measured current.
    ou : OuFacts
        Relaxation, or bounds on it.
    budget : Budget or None
        Throttle budget; None without a limit.

    Examples
    --------
    >>> from ou_monitor import read_recording, supply_facts
    >>> data = supply_facts(read_recording('bags/load_40', end=2.0)).to_dict()   # as in --json
    >>> sorted(data)
    ['budget', 'dips', 'lowest', 'noise', 'ou', 'resistance', 'sag']

    """

    lowest: Lowest
    dips: Dips | None
    sag: Sag
    noise: Noise
    resistance: Resistance
    ou: OuFacts
    budget: Budget | None

    def to_dict(self) -> dict[str, Any]:
        """Return the facts for strict JSON: unknown numbers are None."""
        found: dict[str, Any] = plain_data(self)
        return found


def supply_facts(recording: Recording, limit: float | None = None) -> SupplyFacts:
    """
    Return the facts of the supply of a recording.

    Parameters
    ----------
    recording : Recording
        The recording.
    limit : float, optional
        Lowest permitted voltage, V, for dips and budget.

    Returns
    -------
    SupplyFacts
        The same for every command; unknown numbers are NaN.

    Raises
    ------
    ValueError
        When the limit is not finite.

    Examples
    --------
    >>> from ou_monitor import read_recording, supply_facts
    >>> facts = supply_facts(read_recording('bags/flight'), limit=4.5)
    >>> round(facts.lowest.voltage_v, 2), facts.dips.count, facts.sag.known
    (4.58, 0, True)

    """
    return facts_and_end(ordered(recording), limit)[0]


def facts_and_end(recording: Recording, limit: float | None = None, left: Remainder | None = None,
                  monitor: SupplyMonitor | None = None,
                  ) -> tuple[SupplyFacts, SupplyLoad, MonitorReport | None]:
    """Return the facts, the node's load model and, with a limit, V, its report at the end."""
    # left: `remainder` of the recording, outliers included; monitor: from `node_for`, fed with the
    # recording.  Both cover only times with power (`supplied`), and are computed if omitted.
    if limit is not None and not math.isfinite(limit):
        raise ValueError(f'the limit must be finite, got {limit} V')
    if left is None and recording.n > 1:
        recording = readings_of(recording)
    if not recording.n:
        unknown = (NAN,) * len(THROTTLES)
        nowhere = (NAN, NAN)
        return SupplyFacts(
            Lowest(NAN, NAN, NAN), None if limit is None else Dips(limit, 0, 0.0, 0.0),
            Sag(False, nowhere, THROTTLES, unknown, unknown),
            Noise(THROTTLES, unknown, unknown, nowhere), Resistance(NAN, NAN),
            OuFacts('no_data'), None), SupplyLoad(), None
    began = float(recording.t[0])
    there, outer = supplied(recording), supplied(recording, at_ends=True)
    there, left = without_wild(there, left or remainder(there))
    t, v, u = outer.t, outer.voltage, outer.throttle
    k = int(np.argmin(v))
    noise = noise_of(there, left)
    load, budget, last = _at_the_end(there, limit, monitor)
    return SupplyFacts(
        Lowest(float(v[k]), float(t[k]) - began, float(u[k])),
        None if limit is None else _dips(t - began, v, u, limit, rise_that_ends(v, u, noise)),
        Sag(load.known, noise.flown, THROTTLES, floats(load.sag(THROTTLES)),
            floats(load.sag_se(THROTTLES))),
        noise, Resistance(
            load.resistance, load.resistance_se, load.resistance_at_once
            if t.size > 1 and 2.0 * float(np.median(np.diff(t))) < 1.01 * AT_ONCE < hold(
                float(t[-1] - t[0])) else NAN),
        known_ou(there.t, there.voltage, there.throttle, there.current), budget), load, last


def node_for(recording: Recording, settings: MonitorSettings,
             ) -> tuple[SupplyMonitor, Iterator[tuple[float, bool]]]:
    """Return a monitor, and the iterator `fed` that feeds it with a recording."""
    monitor = SupplyMonitor(settings, look=max(LOOK, recording.duration / _LOOKS), replay=True)
    throttle, drawn = recording.throttle if recording.has_throttle else None, recording.current
    return monitor, fed(
        recording, SLIDING if isinstance(settings.window, str) else settings.window,
        lambda part: monitor.push(recording.t[part], recording.voltage[part],
                                  None if throttle is None else throttle[part],
                                  current=None if drawn is None else drawn[part]))


def fed(recording: Recording, window: float, push: Callable[[slice], None],
        ) -> Iterator[tuple[float, bool]]:
    """Push a recording in parts; yield each end, s, and whether the report there is shown."""
    t, duration, done = recording.t, recording.duration, 0
    step = max(0.25 * window, duration / _POINTS)
    each = max(1, min(math.ceil(step / _STEP), _MOST // _POINTS))
    ends = np.searchsorted(t, t[:1] + step / each * np.arange(
        1, int(duration / step) * each + 1), 'right').tolist()
    for k, stop in enumerate([*ends, t.size], 1):
        if stop > done:
            push(slice(done, stop))
            done = stop
            yield float(t[stop - 1] - t[0]), k <= len(ends) and not k % each


def _at_the_end(recording: Recording, limit: float | None, monitor: SupplyMonitor | None,
                ) -> tuple[SupplyLoad, Budget | None, MonitorReport | None]:
    if limit is None:
        load = LoadFilter()
        for begin in range(0, recording.n, _SLICE):
            part = slice(begin, begin + _SLICE)
            load.push(recording.t[part], recording.voltage[part], recording.throttle[part],
                      None if recording.current is None else recording.current[part])
        return load.load(), None, None
    if monitor is None:
        # The budget does not depend on the fit of `window: auto`.
        monitor, parts = node_for(
            recording, MonitorSettings(window=SLIDING, brownout_voltage=limit))
        deque(parts, 0)
    last, asked = monitor.report(0.0), monitor.settings
    return last.load, Budget(
        last.budget, limit, asked.brownout_horizon, asked.budget_limit), last


def _dips(t: FloatArray, v: FloatArray, u: FloatArray, limit: float, rise: FloatArray) -> Dips:
    begins = dip_begins(v, limit, rise)
    if not begins.size:
        return Dips(limit, 0, 0.0, 0.0)
    # Each reading stands for the time to the next one, but for 10 usual steps at most.
    spacing = np.diff(t)
    usual = float(np.median(spacing)) if spacing.size else 0.0
    held = np.where(is_below(v, limit), np.append(np.minimum(spacing, 10.0 * usual), usual), 0.0)
    seconds = np.add.reduceat(held, begins)
    deepest, ends = [], [*begins[1:], v.size]
    for k in np.argsort(np.minimum.reduceat(v, begins), kind='stable')[:_DEEPEST].tolist():
        at = begins[k] + int(np.argmin(v[begins[k]:ends[k]]))
        deepest.append(Dip(float(t[begins[k]]), float(v[at]), float(seconds[k]), float(u[at])))
    return Dips(limit, int(begins.size), float(seconds.sum()), float(seconds.max()),
                float(t[begins[0]]), int((seconds < 1.0).sum()), tuple(deepest))


def alarms(recording: Recording, cells: int, noise: Noise) -> tuple[Dips, ...]:
    """Return the dips below each of ALARMS; empty if the number of cells is unknown (0)."""
    if not (cells and recording.n):
        return ()
    there = supplied(recording, at_ends=True)
    t, rise = there.t - recording.t[0], rise_that_ends(there.voltage, there.throttle, noise)
    return tuple(_dips(t, there.voltage, there.throttle, cells * one, rise) for one in ALARMS)
