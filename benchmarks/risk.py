"""
How the brown-out risk compares with what happens, and with the alarms that fly.

    python benchmarks/risk.py calibration --table doc/results/risk.md
        --figure doc/results/risk_reliability.svg
    python benchmarks/risk.py alarms --table doc/results/risk.md
        --figure doc/results/risk_alarms.svg
    python benchmarks/risk.py cost --table doc/results/risk.md
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from datetime import date
import json
import math
from pathlib import Path
import sys
import time

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np  # noqa: E402
from ou_monitor import brownout_probability  # noqa: E402
from ou_monitor.online.monitor import SupplyMonitor  # noqa: E402
from ou_monitor.online.risk.flag import FlagLevel  # noqa: E402
from ou_monitor.records import Estimate, Status  # noqa: E402
from ou_monitor.report.svg import Plot  # noqa: E402
from risk_flights import (  # noqa: E402
    brier, Flights, fly, Horizon, monitor_settings, predict, RATE, reliability, stationary, WARM)
from tables import drawing, number, put, table  # noqa: E402

SEED = 20261121
# Flights simulated at once: bounds memory.
_BATCH = 100
# Predictions within this factor of what is observed are called calibrated.
_FACTOR = 1.5
# Names that fit into a legend.
_SHORT = {'published risk': 'published', 'published risk, lowest of 0.5 s': 'lowest of 0.5 s',
          'window alone, errors averaged': 'window alone',
          'window alone, errors ignored': 'and without errors',
          'stationary, as the paper': 'paper', 'threshold on the voltage': 'threshold',
          'threshold with a timer of 10 s': 'with timer'}


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


def _told(what: str, of: int) -> Callable[[], None]:
    """Return what to call after each of so many steps: tells how far it is."""
    done, begin = [0], time.monotonic()

    def tell() -> None:
        done[0] += 1
        if done[0] % 20 == 0 or done[0] == of:
            rest = (time.monotonic() - begin) / done[0] * (of - done[0])
            print(f'{what}: {done[0]}/{of}, about {rest:.0f} s left', file=sys.stderr)
    return tell


def calibration(given: argparse.Namespace) -> tuple[str, str]:
    """Return a table and a reliability diagram."""
    found: list[Horizon] = []
    if given.lines and given.lines.exists():
        found = [Horizon(**json.loads(line)) for line in given.lines.read_text().splitlines()]
        return _calibration(found, given.horizon)
    tell = _told('flights', given.flights)
    for begin in range(0, given.flights, _BATCH):
        rng = np.random.default_rng([given.seed, begin])
        count = min(_BATCH, given.flights - begin)
        flights = fly(rng, count, given.seconds)
        levels = flights.level - flights.spread * rng.uniform(2.5, 7.0, count)
        found += predict(flights, levels, given.horizon, given.horizon, tell)
    if given.lines:
        given.lines.write_text(''.join(json.dumps(asdict(h)) + '\n' for h in found))
    return _calibration(found, given.horizon)


def _calibration(found: Sequence[Horizon], horizon: float) -> tuple[str, str]:
    steady = [h for h in found if h.steady]
    parts = [_reliability_table(
        f'Throttle stays as it is within the horizon: {len(steady)} horizons of '
        f'{horizon:g} s, {sum(h.happened for h in steady)} brown-outs', steady)]
    parts.append(_reliability_table(
        f'Throttle may change within the horizon: {len(found)} horizons, '
        f'{sum(h.happened for h in found)} brown-outs', found))
    return '\n\n'.join(parts), _reliability_figure(steady)


def _columns(found: Sequence[Horizon], method: str) -> tuple[np.ndarray, np.ndarray]:
    return (np.array([h.predicted[method] for h in found]),
            np.array([h.happened for h in found], dtype=float))


def _reliability_table(title: str, found: Sequence[Horizon]) -> str:
    methods = list(found[0].predicted)
    base = float(np.mean([h.happened for h in found]))
    rows = []
    for method in methods:
        predicted, happened = _columns(found, method)
        score_ = brier(predicted, happened)
        rows.append([method, f'{score_:.4f}', f'{1.0 - score_ / (base * (1.0 - base)):.3f}'])
    text = [f'**{title}**', '', table(['method', 'Brier score', 'skill'], rows), '']
    for method in methods[:1]:
        rows = []
        for b in reliability(*_columns(found, method)):
            low, high = b.interval
            ratio = b.observed / b.predicted
            inside = low <= b.predicted * _FACTOR and high >= b.predicted / _FACTOR
            rows.append([f'{b.low:g}..{b.high:g}', str(b.count), number(b.predicted, '.3g'),
                         number(b.observed, '.3g'), f'{low:.2g}..{high:.2g}',
                         f'{ratio:.2f}', 'yes' if 1 / _FACTOR <= ratio <= _FACTOR
                         else 'not refuted' if inside else 'no'])
        text += [f'{method[0].upper()}{method[1:]}:', '', table(
            ['predicted', 'horizons', 'mean', 'observed', '95 % interval', 'observed / predicted',
             f'within {_FACTOR:g}'], rows)]
    return '\n'.join(text)


def _reliability_figure(found: Sequence[Horizon]) -> str:
    plot = Plot('Predicted and observed probability of a brown-out', 'predicted', 'observed',
                width=900, height=480, log_x=True, log_y=True, legend_row=True)
    line = np.geomspace(1e-4, 1.0, 50)
    plot.line(line, line, '', 7, 'dash')
    plot.band(line, line / _FACTOR, np.minimum(line * _FACTOR, 1.0), f'within {_FACTOR:g}', 7)
    for colour, method in enumerate(found[0].predicted):
        bins = [b for b in reliability(*_columns(found, method)) if b.hits]
        x = np.array([b.predicted for b in bins])
        plot.line(x, np.array([b.observed for b in bins]), _SHORT.get(method, method), colour,
                  'thick')
        if colour == 0:
            for b in bins:
                low, high = b.interval
                plot.line(np.array([b.predicted] * 2), np.array([max(low, 1e-5), high]), '', 0)
    return _document(plot, 'reliability')


def alarms(given: argparse.Namespace) -> tuple[str, str]:
    """Return a table of alarms at equal misses, and curves of both."""
    lines = []
    tell = _told('flights', given.flights)
    for begin in range(0, given.flights, _BATCH):
        rng = np.random.default_rng([given.seed, 1, begin])
        count = min(_BATCH, given.flights - begin)
        flights = fly(rng, count, given.seconds)
        levels = flights.level - flights.spread * rng.uniform(3.5, 9.0, count)
        lines += timelines(flights, levels, given.horizon, tell)
    outs = sum(math.isfinite(line.brownout) for line in lines)
    plot = Plot('Alarms for nothing against brown-outs missed', 'brown-outs missed (share)',
                'false alarms per hour', width=900, height=480, log_y=True, legend_row=True)
    rows = []
    for colour, method in enumerate(METHODS):
        scores = [score(lines, method, s) for s in settings(lines, method)]
        if method == METHODS[2]:
            flag = score(lines, method, 0.5)
            rows.append([method, f'{flag.missed:.2f}', number(flag.false_per_hour, '.3g'),
                         number(flag.lead, '.2g')])
            plot.line(np.array([flag.missed - 0.01, flag.missed + 0.01]),
                      np.array([flag.false_per_hour] * 2), 'flag', colour, 'thick')
            continue
        plot.line(np.array([s.missed for s in scores]),
                  np.array([max(s.false_per_hour, 0.05) for s in scores]),
                  _SHORT.get(method, method), colour, 'thick')
        for missed in (0.1, 0.2, 0.3):
            best = _at(scores, missed)
            rows.append([f'{method}, {missed:.0%} missed at most', f'{best.missed:.2f}',
                         number(best.false_per_hour, '.3g'), number(best.lead, '.2g')]
                        if best else [f'{method}, {missed:.0%} missed at most', '-', '-', '-'])
    hours = sum(line.t[-1] - line.t[0] for line in lines if line.t.size) / 3600.0
    text = (f'**{len(lines)} flights, {hours:.1f} hours, {outs} brown-outs; an alarm counts that '
            'is on half a second before**\n\n' + table(
                ['alarm', 'missed', 'false alarms per hour', 'median lead, s'], rows))
    return text, _document(plot, 'alarms')


def _document(plot: Plot, title: str) -> str:
    return drawing([plot.svg()], 900, 480, title)


def _at(scores: Sequence[Score], missed: float) -> Score | None:
    """Return the setting with the fewest false alarms that misses no more than a share."""
    good = [s for s in scores if s.missed <= missed]
    return min(good, key=lambda s: s.false_per_hour) if good else None


def cost(given: argparse.Namespace) -> tuple[str, str]:
    """Return the time of an evaluation, beside a bare comparison and an estimate."""
    e = Estimate(t=0.0, alpha=63.0, sigma=0.632, var_inf=0.632**2 / 126.0, u0=5.0, alpha_se=0.15,
                 sigma_se=0.02, var_inf_se=0.15, u0_se=0.005, noise_std=0.005, rate=1000.0,
                 n=2000, duration=2.0, status=Status.OK)
    brownout_probability(e, 4.8, 5.0, 4.95)
    took = []
    for k in range(given.flights):
        begin = time.perf_counter()
        brownout_probability(e, 4.7 + 0.0001 * k, 5.0, 4.95)
        took.append(time.perf_counter() - begin)
    p50, p99 = np.quantile(took, [0.5, 0.99]) * 1e3
    return table(['p50, ms', 'p99, ms'], [[f'{p50:.3f}', f'{p99:.3f}']]), ''


def _write(given: argparse.Namespace, text: str, drawing: str) -> None:
    if given.table:
        put(given.table, f'{date.today().isoformat()}, seed {given.seed}.\n\n{text}', given.part)
    else:
        print(text)
    if given.figure and drawing:
        given.figure.write_text(drawing, encoding='utf-8')


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)
    for name, action, flights, seconds in (('calibration', calibration, 2500, 24.0),
                                           ('alarms', alarms, 300, 60.0),
                                           ('cost', cost, 2000, 0.0)):
        part = parts.add_parser(name, help=action.__doc__)
        part.set_defaults(action=action)
        part.add_argument('--flights', type=int, default=flights)
        part.add_argument('--seconds', type=float, default=seconds, help='of each flight')
        part.add_argument('--horizon', type=float, default=2.0, help='s')
        part.add_argument('--seed', type=int, default=SEED)
        part.add_argument('--table', type=Path)
        part.add_argument('--figure', type=Path)
    parts.choices['calibration'].add_argument(
        '--lines', type=Path, help='results as JSON lines: written, or read where it exists')
    given = parser.parse_args()
    _write(given, *given.action(given))
    return 0


if __name__ == '__main__':
    sys.exit(main())
