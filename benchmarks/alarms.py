"""
The brown-out flag on recorded flights, beside the battery alarms of PX4 and ArduPilot (8 min).

Each limit has its own monitor, with reports at 10 Hz. Limits: those that the voltage undershoots
in 1 and 5 % of the seconds, and 3.3 and 3.5 V per cell. A dip: the median of three readings is at
or below the limit; dips less than 0.3 s apart count as one. Caught: the alarm is on at some time
from 2 s before the dip begins to 0.25 s after; its lead is measured from the first such report.
Lone: no other dip in the 4 s before. Quiet: at least 2 s away from any dip. A false rise: no dip
follows within 2 s. Limits that the voltage undershoots for more than 30 % of the flight are left
out.

The autopilots' alarms, with their defaults and the cells of the pack, are taken to be on while
their condition holds, although both latch them until landing.  Without a current neither
compensates the sag.

PX4 (`src/lib/battery/battery.cpp`, `battery.h`, `module.yaml`, `battery_params_common.c`): charge
= (E - 3.6 V) / 0.45 V per cell, with E = voltage + R current through a low-pass of 1 s; R comes
from recursive least squares with a forgetting factor of 0.95, updated only while its covariance
shrinks; critical below 0.07.

ArduPilot Copter (`AP_BattMonitor_Params.cpp`, `AP_BattMonitor_Backend.cpp`, read at 10 Hz): low
after more than BATT_LOW_TIMER = 10 s below BATT_LOW_VOLT = 10.5 V; raw voltage, or with
BATT_FS_VOLTSRC = 1 the voltage at rest.  Also with BATT_LOW_VOLT set to the limit.

The closed loop is simulated: dips that throttle does not cause, and an hour without dips.

    OU_MONITOR_REALDATA=... python benchmarks/alarms.py flights --page doc/results/alarms.md
    OU_MONITOR_REALDATA=... python benchmarks/alarms.py flights gecko --strips doc/results
    python benchmarks/alarms.py loop --page doc/results/alarms.md
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
import sys

from common import arguments, deliver, drawing, FLIGHTS, flights, HIRO, median3, say, table
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.records import Recording
from ou_monitor.report.svg import Plot

# The flights, and the cells of their packs.
FLOWN = {**{name: FLIGHTS[name] for name in ('gecko', 'nazgul', 'roma', 'bf3s')}, 'hiro': HIRO,
         'erle': FLIGHTS['erle']}
CELLS = {'gecko': 4, 'nazgul': 4, 'roma': 6, 'bf3s': 3, 'hiro': 4, 'erle': 3}
# Time between reports, and before the first one that is counted, s.
LOOK, SETTLED = 0.1, 20.0
# A dip is caught by an alarm from BEFORE to AFTER its start, s; lone: no other dip ALONE before.
BEFORE, AFTER, ALONE = 2.0, 0.25, 4.0
# The limit drawn; the voltage is drawn as its lowest value in each COLUMN seconds.
DRAWN, COLUMN = '5 %', 0.3
OURS, PX4 = 'CRITICAL', 'PX4, critical'
ARDUPILOT = ('ArduPilot, 10.5 V', 'ArduPilot, the limit', 'ArduPilot, the limit at rest')
ALARMS = (OURS, PX4, *ARDUPILOT)
# Short names for the rows of a strip, WARN first.
SHORT = ('WARN', 'CRITICAL', 'PX4', 'AP 10.5 V', 'AP limit', 'AP rest')
SHADES = ('#e0b84c', '#d55e00', *4 * ['#444444'])


def dips_of(t: np.ndarray, middle: np.ndarray, limit: float, step: float) -> list[list[float]]:
    """Return start and end of each dip, s."""
    over = middle > limit + max(step, 0.003 * limit)
    decides = np.flatnonzero((middle <= limit) | over)
    low = middle[decides] <= limit
    dips: list[list[float]] = []
    for k in decides[low & np.append(True, ~low[:-1])]:
        after = np.flatnonzero(over[k:])
        end = t[k + after[0]] if after.size else t[-1]
        if dips and t[k] - dips[-1][1] < 0.3:
            dips[-1][1] = end
        else:
            dips.append([t[k], end])
    return [dip for dip in dips if dip[0] >= SETTLED]


def px4_charge(t: np.ndarray, voltage: np.ndarray, current: np.ndarray, cells: int) -> np.ndarray:
    """Return the state of charge from voltage, 0..1, as `battery.cpp` without a capacity does."""
    resistance = 0.005
    state, covariance = np.zeros(2), np.eye(2)
    filtered, out = 0.0, np.empty(t.size)
    for k in range(t.size):
        v, i, dt = float(voltage[k]), float(current[k]), float(t[k] - t[max(k - 1, 0)])
        if t[k] - t[0] <= 2.0:
            # The pack has just been connected: everything restarts.
            resistance = 0.005
            state = np.array([v, resistance * cells])
            covariance = np.diag([1.5, 0.1]) * cells
            filtered = v / cells + resistance * max(i, 0.0)
        cell = v / cells
        if i > 0.0:
            x = np.array([1.0, -i])
            gain = covariance @ x / (0.95 + x @ covariance @ x)
            later = (covariance - np.outer(gain, x @ covariance)) / 0.95
            if np.linalg.norm(later) < np.linalg.norm(covariance):
                state = state + gain * (v - x @ state)
                covariance = later
                resistance = max(state[1] / cells, 0.0)
            else:
                state[0] = v + state[1] * i
            cell += resistance * i
        filtered += (cell - filtered) * dt / (1.0 + dt)
        out[k] = (filtered - 3.6) / 0.45
    return np.clip(out, 0.0, 1.0)


def ardupilot_low(t: np.ndarray, voltage: np.ndarray, current: np.ndarray, limit: float,
                  at_rest: bool) -> np.ndarray:
    """Return whether the failsafe is on, from readings at 10 Hz, as in `AP_BattMonitor`."""
    resistance = most = v_filtered = i_filtered = reference_i = reference_v = 0.0
    since, out = np.nan, np.zeros(t.size, bool)
    for k in range(t.size):
        v, i, dt = float(voltage[k]), float(current[k]), float(t[k] - t[max(k - 1, 0)])
        used = v
        if i > 0.0:
            most = max(most, i)
            delta = i - i_filtered
            if delta:
                if v > reference_v:
                    reference_v, reference_i = v, i
                share = min(dt / (dt + 0.5), 0.5)
                weight = min(1.0, 0.1 * abs(delta / most))
                found = -(v - v_filtered) / delta
                if found > 0.0:
                    resistance += weight * (found - resistance)
                if reference_v > v and i > reference_i:
                    resistance = min(resistance, (reference_v - v) / (i - reference_i))
                v_filtered += share * (v - v_filtered)
                i_filtered += share * delta
            used = max(v, v + i * resistance) if at_rest else v
        since = (t[k] if np.isnan(since) else since) if used < limit else np.nan
        out[k] = t[k] - since > 10.0
    return out


@dataclass(frozen=True, eq=False)
class Watch:
    """One flight and limit: what was measured, and which alarms were on; s, V, 0..1."""

    flight: str
    limit: float
    t: np.ndarray
    voltage: np.ndarray
    throttle: np.ndarray
    dips: list[list[float]]
    at: np.ndarray
    on: dict[str, np.ndarray]
    warn: np.ndarray
    budget: np.ndarray

    def counts(self, alarm: str) -> np.ndarray:
        """Return caught, dips, ahead, lone, quiet and on, quiet and WARN, quiet, false, looks."""
        at, on = self.at, self.on[alarm]
        flown = at >= SETTLED
        quiet = flown.copy()
        for begin, end in self.dips:
            quiet &= (at < begin - BEFORE) | (at > end + 2.0)
        rises = at[on & ~np.append(False, on[:-1]) & flown]
        lone = [b for k, (b, _) in enumerate(self.dips)
                if not k or b - self.dips[k - 1][1] > ALONE]
        return np.array([
            len(self.leads(alarm)), len(self.dips),
            sum((on & (at >= b - BEFORE) & (at <= b - 0.2)).any() for b in lone), len(lone),
            (on & quiet).sum(), (self.warn & quiet).sum(), quiet.sum(),
            sum(all(not b - BEFORE - 0.05 <= x <= e + 0.35 for b, e in self.dips)
                for x in rises), flown.sum()])

    def leads(self, alarm: str) -> list[float]:
        """Return the lead of an alarm over each dip that it catches, s."""
        found = []
        for begin, _ in self.dips:
            near = self.at[self.on[alarm] & (self.at >= begin - BEFORE) & (
                self.at <= begin + AFTER)]
            if near.size:
                found.append(begin - near[0])
        return found


def fly(flight: str, recording: Recording, cells: int) -> Iterator[tuple[str, Watch]]:
    """Yield name and `Watch` of each limit."""
    good = np.isfinite(recording.throttle)
    t, v = recording.t[good] - recording.t[good][0], recording.voltage[good]
    u, middle = np.clip(recording.throttle[good], 0.0, 1.0), median3(v)
    current = np.zeros(t.size) if recording.current is None else np.nan_to_num(
        recording.current[good])
    looks = np.unique(np.searchsorted(t, np.arange(LOOK, t[-1], LOOK)))
    low = np.array([middle[k + 1:np.searchsorted(t, t[k] + 1.0, 'right')].min(initial=np.inf)
                    for k in looks])
    low = low[(t[looks] >= SETTLED) & np.isfinite(low)]
    step = float(np.diff(np.unique(np.round(v, 6))).min())
    limits = {f'{share} %': np.quantile(low, share / 100, method='higher') + 0.5 * step
              for share in (1, 5)} | {f'{each} V a cell': each * cells for each in (3.3, 3.5)}
    charge = px4_charge(t, v, current, cells)[looks]
    # An autopilot reads the mean since its last reading.
    begins = np.concatenate(([0], looks[:-1] + 1))
    means = [np.add.reduceat(x, begins)[:looks.size] / np.diff(begins, append=looks[-1] + 1)
             for x in (v[:looks[-1] + 1], current[:looks[-1] + 1])]
    for name, limit in limits.items():
        if np.mean(middle[t >= SETTLED] <= limit) > 0.3:
            continue
        monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=float(limit)))
        levels, budgets, before = [], [], 0
        for k in looks:
            part, before = slice(before, k + 1), k + 1
            monitor.push(t[part], v[part], u[part])
            report = monitor.report(0.0)
            levels.append(report.flag.level)
            budgets.append(report.budget)
        on = {OURS: np.array([level is FlagLevel.CRITICAL for level in levels]),
              PX4: charge < 0.07}
        for alarm, volts, at_rest in zip(ARDUPILOT, (10.5, limit, limit), (False, False, True)):
            on[alarm] = ardupilot_low(t[looks], *means, volts, at_rest)
        yield name, Watch(flight, float(limit), t, v, u, dips_of(t, middle, limit, step),
                          t[looks], on, np.array([level is FlagLevel.WARN for level in levels]),
                          np.array(budgets))


def numbers(n: np.ndarray, leads: list[float]) -> list[str]:
    """Return caught, median lead, on in quiet time, and false rises a minute."""
    return [f'{n[0]} of {n[1]}', f'{np.median(leads):.1f}' if leads else '-',
            f'{100.0 * n[4] / max(n[6], 1):.1f}', f'{n[7] / (n[8] * LOOK / 60.0):.2f}']


def tables(watches: list[tuple[str, Watch]]) -> str:
    """Return the flag at each limit, and all alarms of each flight."""
    rows, total = [], {alarm: np.zeros(9, np.int64) for alarm in ALARMS}
    leads: dict[str, list[float]] = {alarm: [] for alarm in ALARMS}
    for limit, watch in watches:
        n = watch.counts(OURS)
        rows.append([watch.flight, limit, *numbers(n, watch.leads(OURS)), f'{n[2]} of {n[3]}',
                     f'{100.0 * n[5] / max(n[6], 1):.0f}'])
    beside = []
    for flight in dict.fromkeys(watch.flight for _, watch in watches):
        mine = [watch for _, watch in watches if watch.flight == flight]
        for alarm in ALARMS:
            n = np.sum([watch.counts(alarm) for watch in mine], axis=0)
            found = [lead for watch in mine for lead in watch.leads(alarm)]
            beside.append([flight if alarm == OURS else '', alarm, *numbers(n, found)])
            total[alarm] += n
            leads[alarm] += found
    n = total[OURS]
    rows.append(['all', '', *numbers(n, leads[OURS]), f'{n[2]} of {n[3]}',
                 f'{100.0 * n[5] / max(n[6], 1):.0f}'])
    beside += [['all' if alarm == OURS else '', alarm, *numbers(total[alarm], leads[alarm])]
               for alarm in ALARMS]
    head = ['dips caught', 'median lead, s', 'on in quiet time, %', 'false rises a minute']
    return ('**CRITICAL, at each limit**\n\n' + table(
        ['flight', 'limit', *head, 'lone dips, 0.2 s ahead', 'WARN in quiet time, %'], rows)
        + '\n**Beside the autopilots, all limits of a flight together**\n\n'
        + table(['flight', 'alarm', *head], beside))


def strip(watch: Watch) -> str:
    """Return the drawing of a flight: voltage, dips, throttle, budget, and when alarms were on."""
    column = np.floor(watch.t / COLUMN).astype(int)
    begins = np.flatnonzero(np.diff(column, prepend=-1))
    t = watch.t[begins]
    span = (0.0, float(watch.t[-1]))
    volts = Plot(f'{watch.flight}: voltage (lowest of {COLUMN:g} s), limit {watch.limit:.2f} V, '
                 'dips', '', 'V', width=900, height=170)
    volts.line(t, np.minimum.reduceat(median3(watch.voltage), begins), '', 0)
    volts.line(np.array(span), np.full(2, watch.limit), '', 1, 'dash').limits(x=span)
    for begin, end in watch.dips:
        volts.shade(begin, max(end, begin + 0.3), 1)
    load = Plot('throttle (highest of it), and the budget', 's', '', width=900, height=150)
    load.line(t, np.maximum.reduceat(watch.throttle, begins), 'throttle', 2)
    load.line(watch.at, watch.budget, 'budget', 3).limits(x=span, y=(0.0, 1.05))
    parts = [f'<svg width="900" height="170">{volts.svg()}</svg>',
             f'<svg y="{170 + 14 * len(SHORT)}" width="900" height="150">{load.svg()}</svg>']
    left, right = 62.0, 886.0
    wide = (right - left) / span[1]
    for row, on in enumerate((watch.warn, *watch.on.values())):
        y = 156 + 14 * row
        parts.append(f'<text x="{left - 4}" y="{y + 10}" text-anchor="end" '
                     f'style="font-size:10px">{SHORT[row]}</text>')
        edges = np.flatnonzero(np.diff(np.concatenate(([0], on.astype(int), [0]))))
        for a, b in zip(edges[::2], edges[1::2]):
            begin = watch.at[a]
            end = watch.at[min(b, on.size - 1)]
            parts.append(f'<rect x="{left + wide * begin:.1f}" y="{y + 2}" height="10" '
                         f'width="{max(wide * (end - begin), 0.8):.1f}" fill="{SHADES[row]}"/>')
    return drawing(parts, 900, 320 + 14 * len(SHORT), f'{watch.flight}, alarms')


def recorded_flights(options: argparse.Namespace) -> str:
    """Return the tables of recorded flights; draw their strips."""
    watches = []
    for name, recording in flights(options.flight, FLOWN):
        for limit, watch in fly(name, recording, CELLS[name]):
            watches.append((limit, watch))
            say(name, limit, numbers(watch.counts(OURS), watch.leads(OURS)))
            if options.strips and limit == DRAWN:
                (options.strips / f'alarms_{name}.svg').write_text(
                    strip(watch), encoding='utf-8')
    return tables(watches)


# The closed loop: readings and reports per second (`publish_rate`), limit, V, and time in which
# the load becomes known, s.
RATE, REPORTS, LIMIT, WARM_UP = 100, 10, 13.2, 30.0
# Time between dips, and their length, s; maximum time between a dip and an alarm for it, s.
APART, DIP, ITS_OWN = (6.0, 12.0), (0.02, 0.5), 0.5


def supply(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return stamps, s, voltage of a healthy 4S pack, V, and throttle, held for 0.3 to 4 s."""
    ends = np.cumsum(rng.uniform(0.3, 4.0, n * 4 // RATE + 8))
    t = np.arange(n) / RATE
    wanted = rng.choice([0.15, 0.3, 0.4, 0.5, 0.75], ends.size)[np.searchsorted(ends, t)]
    throttle, lagged, slow = np.empty(n), np.empty(n), np.empty(n)
    u = x = y = wanted[0]
    for k in range(n):
        u += (wanted[k] - u) * 0.2
        x += (u ** 1.8 - x) / (0.06 * RATE)
        y += (u ** 1.8 - y) / (2.0 * RATE)
        throttle[k], lagged[k], slow[k] = u, x, y
    # An hour needs several packs: the level falls, and jumps to a full pack's every ten minutes.
    level = 16.3 - 0.8 * (t % 600.0) / 600.0
    noise = 0.02 * (1.0 + throttle) * rng.standard_normal(n)
    voltage = level - 1.2 * lagged - 0.5 * slow + noise
    return t, 0.01 * np.rint(100.0 * voltage), throttle


def fly_loop(seed: int, minutes: float, dips: int) -> tuple[int, list[float], int]:
    """
    Return false rises of CRITICAL, delays of dips, s, and the number of missed dips of a flight.

    In a dip another load pulls the supply 0.1 to 1 V below the limit for 20 to 500 ms, at any
    throttle.  A flight without dips lasts `minutes`.
    """
    rng = np.random.default_rng(seed)
    gaps = rng.uniform(*APART, dips)
    seconds = WARM_UP + (gaps.sum() + APART[1] if dips else 60.0 * minutes)
    t, v, u = supply(rng, round(seconds * RATE))
    begins = WARM_UP + np.cumsum(gaps)
    for begin, length in zip(begins, rng.uniform(*DIP, dips)):
        low = (t >= begin) & (t < begin + length)
        v[low] = np.minimum(v[low], LIMIT - rng.uniform(0.1, 1.0))
    monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=LIMIT))
    rises, before = [], False
    each = RATE // REPORTS
    for k in range(0, t.size - each + 1, each):
        part = slice(k, k + each)
        monitor.push(t[part], v[part], u[part])
        on = monitor.report(0.0).flag.level is FlagLevel.CRITICAL
        if on and not before and t[k] >= WARM_UP:
            rises.append(float(t[k + each - 1]))
        before = on
    first = t[np.searchsorted(t, begins)]
    delays = [[rise - begin for rise in rises if -ITS_OWN <= rise - begin <= ITS_OWN]
              for begin in first]
    return len(rises) - sum(map(len, delays)), [d[0] for d in delays if d], sum(
        not d for d in delays)


def loop(options: argparse.Namespace) -> str:
    """Return the table of the closed loop: dips of another load, and an hour of healthy flight."""
    wrong, delays, missed = fly_loop(options.seed, 0.0, options.dips)
    healthy, *_ = fly_loop(options.seed + 1, options.minutes, 0)
    return table(['flight', 'dips', 'missed', 'CRITICAL after, median s', 'at most, s',
                  'false rises'], [
        ['dips of 20 to 500 ms', str(options.dips), str(missed), f'{np.median(delays):.2f}',
         f'{max(delays):.2f}', str(wrong)],
        [f'healthy, {options.minutes:g} min', '0', '-', '-', '-', str(healthy)]])


def main() -> int:
    """Print the tables, or put them into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)
    page = [arguments('', help_option=False)]
    part = parts.add_parser('flights', help=recorded_flights.__doc__, parents=page)
    part.set_defaults(action=recorded_flights)
    part.add_argument('flight', nargs='*', help='names (default all)')
    part.add_argument('--strips', type=Path, help='folder for a drawing of each flight')
    part = parts.add_parser('loop', help=loop.__doc__, parents=page)
    part.set_defaults(action=loop)
    part.add_argument('--dips', type=int, default=200)
    part.add_argument('--minutes', type=float, default=60.0, help='of healthy flight')
    part.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    deliver(options.action(options), options.page, options.part)
    return 0


if __name__ == '__main__':
    sys.exit(main())
