"""Alarms over whole flights: which come in time, and which come for nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from risk_flights import Flights, RATE
from risk_scores import monitor_settings, stationary, WARM

# Seconds between looks; an alarm is in time that is on at a look from `AFTER` to `LEAD`
# before the brown-out, s, and one is for nothing that no brown-out follows within `AFTER`.
LOOK, LEAD, AFTER = 0.1, 0.5, 5.0
# Looks that are taken together: what lasts is told from a dip.
_STEADY = 5
# Continuous time below a threshold before ArduPilot acts (BATT_LOW_TIMER), s.
TIMER = 10.0


@dataclass(frozen=True, eq=False)
class Timeline:
    """
    What the methods say during a flight, up to its end or its brown-out.

    Attributes
    ----------
    t : ndarray, shape (n,)
        s.
    says : dict of str to ndarray of shape (n,)
        The larger, the more alarming; NaN where nothing is said.
    brownout : float
        When the path went below the level, s; inf when it did not.

    """

    t: np.ndarray
    says: dict[str, np.ndarray]
    brownout: float


def timelines(flights: Flights, levels: np.ndarray, horizon: float,
              progress: Callable[[], None]) -> list[Timeline]:
    """Return one of each flight."""
    made = []
    step = round(LOOK * RATE)
    for f, level in enumerate(levels.tolist()):
        below = np.flatnonzero(flights.low[f] < level)
        end = int(below[0]) if below.size else flights.t.size
        monitor, risks = SupplyMonitor(monitor_settings(level, horizon)), [math.nan] * _STEADY
        v, u = flights.voltage[f].astype(np.float64), flights.throttle[f]
        t, rows = [], []
        for at in range(step, end, step):
            part = slice(at - step, at)
            monitor.push(flights.t[part], v[part], u[part])
            report = monitor.report(0.0)
            e = report.estimate
            risks = [*risks[1:], report.risk]
            if at < WARM * RATE:
                continue
            paper = stationary(e, level) if e.usable else math.nan
            t.append(flights.t[at - 1])
            # How low the last look went, and how high the last ten seconds.
            rows.append((report.risk, min(risks),
                         float(report.flag.level is FlagLevel.CRITICAL), paper,
                         level - v[part].min(),
                         level - v[max(0, at - round(TIMER * RATE)):at].max()
                         if at >= TIMER * RATE else -math.inf))
        table = np.array(rows).reshape(-1, len(METHODS)).T
        made.append(Timeline(np.array(t), dict(zip(METHODS, table)),
                             float(flights.t[end]) if below.size else math.inf))
        progress()
    return made


METHODS = ('published risk', 'published risk, lowest of 0.5 s', 'flag, as set by default',
           'stationary, as the paper', 'threshold on the voltage',
           'threshold with a timer of 10 s')


@dataclass(frozen=True)
class Score:
    """
    One method at one setting.

    Attributes
    ----------
    setting : float
        From which on it alarms.
    missed : float
        Share of brown-outs without an alarm in time.
    false_per_hour : float
        Alarms that no brown-out followed.
    lead : float
        Median time from the alarm to the brown-out, of those in time, s.

    """

    setting: float
    missed: float
    false_per_hour: float
    lead: float


def score(lines: Sequence[Timeline], method: str, setting: float) -> Score:
    """Return how a method does over all flights."""
    outs = missed = wrong = 0
    hours, leads = 0.0, []
    for line in lines:
        on = line.t[line.says[method] >= setting]
        hours += (line.t[-1] - line.t[0]) / 3600.0 if line.t.size else 0.0
        wrong += _apart(on[on < line.brownout - AFTER])
        # A flight in which it happens before anything can be said tells nothing.
        if math.isfinite(line.brownout) and line.t.size and line.brownout > line.t[0] + AFTER:
            outs += 1
            before = on[(on >= line.brownout - AFTER) & (on <= line.brownout - LEAD)]
            if before.size:
                leads.append(line.brownout - before[0])
            else:
                missed += 1
    return Score(setting, missed / outs if outs else math.nan, wrong / hours,
                 float(np.median(leads)) if leads else math.nan)


def _apart(times: np.ndarray) -> int:
    """Return how many alarms these are: one that goes on counts again every `AFTER`."""
    count, last = 0, -math.inf
    for t in times.tolist():
        if t >= last + AFTER:
            count, last = count + 1, t
    return count


def settings(lines: Sequence[Timeline], method: str, count: int = 60) -> np.ndarray:
    """Return settings from never to always."""
    values = np.concatenate([line.says[method] for line in lines])
    values = values[np.isfinite(values)]
    if not values.size:
        return np.array([math.inf])
    share = np.concatenate((np.geomspace(1e-5, 0.1, count // 2),
                            np.linspace(0.12, 1.0, count // 2)))
    return np.unique(np.quantile(values, 1.0 - share))
