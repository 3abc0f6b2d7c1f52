"""
The brown-out risk on recorded flights, causally, against simpler forecasts (10 min).

One monitor with the default window reports at 5 Hz; the CPU time of reports includes its fits.
Levels are those undershot in 1, 5 and 20 % of the flight's horizons, by the median of three
samples or by single samples.  Horizons overlap: n of them count as n / (5 Hz x horizon).  Skill: 1
minus the Brier score divided by the climatology's score so far.

    OU_MONITOR_REALDATA=... python benchmarks/risk_real.py --page doc/results/risk_real.md
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
import json
from pathlib import Path
import sys
import time

from common import arguments, deliver, flights, median3, say, table
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor
from ou_monitor.online.risk.courses import AT_PEAK, excursion_risk, excursions, FlightHistory
from ou_monitor.records import Recording
from scipy.special import expit

QUADS = ('gecko', 'nazgul', 'roma', 'bf3s', 'erle')
OTHERS = ('cf_solo', 'cf_pair')
LOOK, HORIZONS, SHARES = 0.2, (1.0, 2.0), (0.01, 0.05, 0.2)
# Seconds left out at the beginning; of a flight shorter than 30 s.
SETTLED, SHORT_SETTLED = 20.0, 8.0
METHODS = ('published', 'conditional', 'excursions', 'margin', 'margin and sd', 'climatology')
EDGES = (0.0, 0.01, 0.03, 0.1, 0.3, 0.6, 1.0001)


@dataclass(frozen=True, eq=False)
class Case:
    """One flight, horizon and event: (n, 3) of each method, the outcomes, and features."""

    flight: str
    horizon: float
    t: np.ndarray
    said: dict[str, np.ndarray]
    happened: np.ndarray
    below_now: np.ndarray
    features: np.ndarray


def climatology(happened: np.ndarray, horizon: float) -> np.ndarray:
    """Return the share of events in completed horizons, half an event at first; (n, 3)."""
    done = np.cumsum(happened, axis=0)
    lag = round(horizon / LOOK)
    n = np.maximum(np.arange(happened.shape[0]) - lag, 0)[:, None]
    hits = np.where(n > 0, done[np.maximum(n[:, 0] - 1, 0)], 0.0)
    return (hits * LOOK / horizon + 0.5) / (n * LOOK / horizon + 1.0)


def fly(name: str, recording: Recording) -> tuple[list[Case], list[Case], dict[str, float]]:
    """Return cases by the median of three samples, by single samples, and further figures."""
    good = np.isfinite(recording.throttle)
    t, v = recording.t[good] - recording.t[good][0], recording.voltage[good]
    u = np.clip(recording.throttle[good], 0.0, 1.0)
    middle = median3(v)
    looks = np.unique(np.searchsorted(t, np.arange(LOOK, t[-1] - max(HORIZONS), LOOK)))
    # Without a sample within the horizon (slow sampling, or a gap) there is no lowest one.
    looks = looks[np.searchsorted(t, t[looks] + min(HORIZONS), 'right') > looks + 1]
    begin = SETTLED if t[-1] >= 30.0 else SHORT_SETTLED
    late = t[looks] >= begin
    lows, levels = {}, {}
    # Levels lie between two steps of the ADC.
    step = float(np.diff(np.unique(np.round(v, 6))).min())
    for event, x in (('middle', middle), ('single', v)):
        for h in HORIZONS:
            ends = np.searchsorted(t, t[looks] + h, 'right')
            low = np.array([x[k + 1:e].min() for k, e in zip(looks, ends)])
            lows[event, h], levels[event, h] = low, np.quantile(
                low[late], SHARES, method='higher') + 0.5 * step
    monitor = SupplyMonitor(MonitorSettings(
        brownout_voltage=float(levels['middle', 2.0][1]), brownout_horizon=2.0,
        brownout_floor=0.0))
    past = FlightHistory()
    rows: dict[tuple[str, float], list[np.ndarray]] = {key: [] for key in levels}
    known, flags, budgets, costs, alarms = [], [], [], [], 0
    before, level_before = 0, 0
    for k in looks:
        part = slice(before, k + 1)
        before = k + 1
        monitor.push(t[part], v[part], u[part])
        past.push(t[part], v[part], u[part])
        started = time.process_time()
        report = monitor.report(0.0)
        costs.append([time.process_time() - started, 0.0, 0.0])
        if t[k] >= begin:
            known.append(np.isfinite(report.risk))
            flags.append(report.flag.brownout is None)
            budgets.append(np.isfinite(report.budget))
            alarms += report.flag.level.value > level_before and report.flag.level.value == 2
        level_before = report.flag.level.value
        recent = middle[np.searchsorted(t, t[k] - 5.0):k + 1].std()
        for (event, h), at in levels.items():
            ahead = u[k + 1:np.searchsorted(t, t[k] + h, 'right')]
            peak = float(ahead.max())
            dwell = float((ahead >= peak - AT_PEAK).mean()) * h
            started = time.process_time()
            said = [monitor.risk(float(level), h) for level in at]
            asked = time.process_time()
            held = [monitor.risk_if(peak, dwell, float(level), h) for level in at]
            costs[-1][1:] = ((asked - started) / 3.0, (time.process_time() - asked) / 3.0)
            moments = excursions(past, h)
            own = excursion_risk(middle[k], at, h, *moments)
            margin = (middle[k] - at) / v[0]
            rows[event, h].append(np.array([
                said, held, own, margin, [recent / v[0]] * 3, middle[k] <= at]))
    cases: dict[str, list[Case]] = {'middle': [], 'single': []}
    for (event, h), made in rows.items():
        x = np.array(made)
        happened = lows[event, h][:, None] < levels[event, h]
        now = x[:, 5] > 0.0
        said = {'published': x[:, 0], 'conditional': x[:, 1],
                'excursions': np.where(now, 1.0, x[:, 2]),
                'climatology': climatology(happened, h)}
        cases[event].append(Case(
            name, h, t[looks][late], {key: value[late] for key, value in said.items()},
            happened[late], now[late], np.stack((x[:, 3], x[:, 4]), axis=-1)[late]))
    spent = np.array(costs) * 1e3
    return cases['middle'], cases['single'], {
        'known': float(np.mean(known)), 'unknown flag': float(np.mean(flags)),
        'budget': float(np.mean(budgets)), 'critical per min': alarms / ((t[-1] - begin) / 60.0),
        **{f'{what} {q}': float(np.quantile(spent[:, j], p))
           for j, what in enumerate(('report', 'risk', 'risk_if'))
           for q, p in (('p50', 0.5), ('p99', 0.99))}}


def logistic(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return coefficients of a logistic regression, by Newton's method with a slight ridge."""
    b = np.zeros(x.shape[1])
    for _ in range(30):
        p = expit(x @ b)
        hessian = (x * (p * (1.0 - p))[:, None]).T @ x + 1e-3 * np.eye(b.size)
        b += np.linalg.solve(hessian, x.T @ (y - p) - 1e-3 * b)
    return b


def with_logistics(cases: list[Case]) -> None:
    """Add the probabilities of logistic regressions trained on the other airframes."""
    for case in cases:
        others = [c for c in cases if c.flight != case.flight and c.horizon == case.horizon]
        for name, make in (('margin', lambda f: f[..., :1]), ('margin and sd', shape)):
            x = np.concatenate([make(c.features).reshape(-1, make(c.features).shape[-1])
                                for c in others])
            y = np.concatenate([c.happened.ravel() for c in others]).astype(float)
            scale = x.std(axis=0)
            b = logistic(np.column_stack((np.ones(y.size), x / scale)), y)
            mine = make(case.features) / scale
            case.said[name] = np.where(case.below_now, 1.0, expit(b[0] + mine @ b[1:]))


def shape(features: np.ndarray) -> np.ndarray:
    """Return the margin, the recent deviation, and their ratio."""
    ratio = np.clip(features[..., 0] / np.maximum(features[..., 1], 1e-4), 0.0, 10.0)
    return np.concatenate((features, ratio[..., None]), axis=-1)


def pooled(cases: list[Case], method: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return probabilities (the climatology if unknown), climatology and outcomes of all cases."""
    base = np.concatenate([c.said['climatology'] for c in cases]).ravel()
    said = np.concatenate([c.said[method] for c in cases]).ravel()
    happened = np.concatenate([c.happened for c in cases]).ravel().astype(float)
    return np.where(np.isnan(said), base, said), base, happened


def skill(cases: list[Case], method: str) -> float:
    """Return the Brier skill against the climatology so far."""
    p, base, y = pooled(cases, method)
    return 1.0 - float(np.mean((p - y) ** 2) / np.mean((base - y) ** 2))


def small(cases: list[Case], method: str) -> str:
    """Return observed and predicted frequency below 0.01, their ratio, and events of horizons."""
    p, _, y = pooled(cases, method)
    below = p < 0.01
    if not below.any():
        return '-'
    observed, predicted = y[below].mean(), p[below].mean()
    events = y[below].sum() * LOOK / cases[0].horizon
    return (f'{observed:.4f} / {predicted:.4f} ({observed / predicted:.1f}; {events:.1f} of '
            f'{below.sum() * LOOK / cases[0].horizon:.0f})')


def reliability(cases: list[Case], method: str) -> str:
    """Return predicted -> observed for bins with ten events or more."""
    p, _, y = pooled(cases, method)
    out = []
    for low, high in zip(EDGES[:-1], EDGES[1:]):
        inside = (p >= low) & (p < high)
        events = y[inside].sum() * LOOK / cases[0].horizon
        if events >= 10.0:
            out.append(f'{p[inside].mean():.2f} -> {y[inside].mean():.2f}')
    return ', '.join(out) or '-'


def false_alarms(cases: list[Case], says: Callable[[Case], np.ndarray], share: float) -> float:
    """Return alarms per minute without a dip below the 5 % level, at a share of caught dips."""
    highest, rises, minutes = [], [], 0.0
    for case in cases:
        y, loud = case.happened[:, 1].astype(int), says(case)
        # A run of reports before one or more dips; these are caught if one report has an alarm.
        begins = np.flatnonzero(np.diff(y, prepend=0) == 1)
        ends = np.flatnonzero(np.diff(y, append=0) == -1) + 1
        highest += [loud[a:b].max() for a, b in zip(begins, ends)]
        minutes += case.t.size * LOOK / 60.0
    limit = np.quantile(highest, 1.0 - share, method='lower')
    for case in cases:
        on = (says(case) >= limit).astype(int)
        rises.append(int(((np.diff(on, prepend=0) == 1) & ~case.happened[:, 1]).sum()))
    return sum(rises) / minutes


def tables(cases: dict[str, list[Case]], facts: dict[str, dict[str, float]]) -> str:
    """Return all tables."""
    parts = []
    for event, words in (('middle', 'the middle one of three samples'),
                         ('single', 'a single sample')):
        rows = []
        for method in METHODS[:-1]:
            row = [method]
            for h in HORIZONS:
                chosen = [c for c in cases[event] if c.horizon == h and c.flight in QUADS]
                row += [f'{skill(chosen, method):.3f}', small(chosen, method),
                        reliability(chosen, method)]
            rows.append(row)
        head = [f'{what}, {h:g} s' for h in HORIZONS for what in (
            'skill', 'below 0.01: observed / predicted', 'predicted -> observed')]
        parts.append(f'**Quads, event: {words} below the level**\n\n'
                     + table(['forecast', *head], rows))
    rows = []
    for name in facts:
        row = [name]
        for h in HORIZONS:
            mine = [c for c in cases['middle'] if c.horizon == h and c.flight == name]
            row += [f"{skill(mine, 'published'):.2f}", f"{skill(mine, 'conditional'):.2f}",
                    f"{skill(mine, 'excursions'):.2f}"]
        rows.append([*row, *(f'{100.0 * facts[name][key]:.0f}' for key in (
            'known', 'budget', 'unknown flag')), f"{facts[name]['critical per min']:.1f}"])
    parts.append('**Each flight**\n\n' + table(
        ['flight', *(f'{m}, {h:g} s' for h in HORIZONS for m in METHODS[:3]), 'risk known %',
         'budget known %', 'flag UNKNOWN %', 'CRITICAL a minute'], rows))
    rows = []
    for what, says in (('published risk', lambda c: c.said['published'][:, 1]),
                       ('excursions', lambda c: c.said['excursions'][:, 1]),
                       ('bare margin, share of the first voltage',
                        lambda c: -c.features[:, 1, 0])):
        row = [what]
        for h in HORIZONS:
            chosen = [c for c in cases['middle'] if c.horizon == h and c.flight in QUADS]
            row += [f'{false_alarms(chosen, says, share):.1f}' for share in (0.5, 0.8)]
        rows.append(row)
    parts.append('**False alarms a minute, 5 % level, quads, one limit for all**\n\n' + table(
        ['alarm', *(f'{share} % caught, {h:g} s' for h in HORIZONS for share in (50, 80))], rows))
    spent = {key: np.median([f[key] for f in facts.values()]) for key in next(
        iter(facts.values())) if key[-3:] in ('p50', 'p99')}
    parts.append('**CPU ms of a call**\n\n' + table(['call', 'p50', 'p99'], [
        [call, f'{spent[call + " p50"]:.2f}', f'{spent[call + " p99"]:.2f}']
        for call in ('report', 'risk', 'risk_if')]))
    return '\n\n'.join(parts)


def main() -> int:
    """Measure the flights and print the tables, or put them into the page."""
    parser = arguments(__doc__, names=True)
    parser.add_argument('--json', type=Path, help='file for the figures of each flight')
    options = parser.parse_args()
    cases: dict[str, list[Case]] = {'middle': [], 'single': []}
    facts = {}
    for name, recording in flights(options.names or [*QUADS, *OTHERS]):
        if not np.isfinite(recording.throttle).any():
            say(f'{name}: the log has no throttle, left out')
            continue
        middle, single, facts[name] = fly(name, recording)
        cases['middle'] += middle
        cases['single'] += single
        say(name, facts[name])
    for event in cases.values():
        with_logistics([c for c in event if c.flight in QUADS])
    if options.json:
        options.json.write_text(json.dumps(facts, indent=1), encoding='utf-8')
    text = tables(cases, facts)
    deliver(text, options.page, 'real flights')
    return 0


if __name__ == '__main__':
    sys.exit(main())
