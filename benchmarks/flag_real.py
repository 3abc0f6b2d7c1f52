"""
The brown-out flag on recorded flights: dips told, and how often it is on where nothing dips.

Reports at 10 Hz of one monitor a limit; limits passed by 1 and 5 % of the seconds, and 3.3 and
3.5 V a cell.  A dip: the middle one of three readings at or below the limit; dips less than 0.3 s
apart are one.  Told: CRITICAL from 2 s before it begins to 0.25 s after.  Lone: none within 4 s
before.  Quiet: 2 s away from any dip.  Limits that are undershot for more than 30 % of the flight
are no limits.  Flights that are not there are left out, with a word on stderr.

    OU_MONITOR_REALDATA=... python benchmarks/flag_real.py --page doc/brownout.md
"""

from __future__ import annotations

import argparse
import os
from pathlib import Path
import sys

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import numpy as np  # noqa: E402
from ou_monitor import MonitorSettings, read_recording, SupplyMonitor  # noqa: E402
from ou_monitor.online.risk.flag import FlagLevel  # noqa: E402
from ou_monitor.records import Recording  # noqa: E402
from risk_real import median3  # noqa: E402
from tables import put, table  # noqa: E402

# Name, file, flight of the log, cells.
FLIGHTS = (('gecko', 'bf_gecko_a.csv', None, 4), ('nazgul', 'raw/bf_nazgul_4s.bbl', 1, 4),
           ('roma', 'raw/bf_roma_6s.bbl', 3, 6), ('bf3s', 'raw/bf_3s_erpm2.bbl', 2, 3),
           ('hiro', 'raw/bf_hiro_4s.BFL', None, 4))
LOOK, SETTLED = 0.1, 20.0
HEAD = ('flight', 'limit', 'dips told', 'ahead of lone dips by 0.2 s', 'CRITICAL, quiet, %',
        'false rises a minute', 'WARN, quiet, %')


def dips_of(t: np.ndarray, middle: np.ndarray, limit: float, step: float) -> list[list[float]]:
    """Return begin and end, s, of each dip."""
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


def fly(recording: Recording, cells: int) -> list[tuple[str, np.ndarray]]:
    """Return name and counts of each limit: told, dips, ahead, lone, on, warn, quiet, false, n."""
    good = np.isfinite(recording.throttle)
    t, v = recording.t[good] - recording.t[good][0], recording.voltage[good]
    u, middle = np.clip(recording.throttle[good], 0.0, 1.0), median3(v)
    looks = np.unique(np.searchsorted(t, np.arange(LOOK, t[-1], LOOK)))
    low = np.array([middle[k + 1:np.searchsorted(t, t[k] + 1.0, 'right')].min(initial=np.inf)
                    for k in looks])
    low = low[(t[looks] >= SETTLED) & np.isfinite(low)]
    step = float(np.diff(np.unique(np.round(v, 6))).min())
    limits = {f'{share} %': np.quantile(low, share / 100, method='higher') + 0.5 * step
              for share in (1, 5)} | {f'{each} V a cell': each * cells for each in (3.3, 3.5)}
    found = []
    for name, limit in limits.items():
        if np.mean(middle[t >= SETTLED] <= limit) > 0.3:
            continue
        monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=float(limit)))
        levels, before = [], 0
        for k in looks:
            part, before = slice(before, k + 1), k + 1
            monitor.push(t[part], v[part], u[part])
            levels.append(monitor.report(0.0).flag.level)
        at, on = t[looks], np.array([level is FlagLevel.CRITICAL for level in levels])
        warn = np.array([level is FlagLevel.WARN for level in levels])
        dips, flown = dips_of(t, middle, limit, step), at >= SETTLED
        quiet = flown.copy()
        for begin, end in dips:
            quiet &= (at < begin - 2.0) | (at > end + 2.0)
        rises = at[on & ~np.append(False, on[:-1]) & flown]
        lone = [b for k, (b, _) in enumerate(dips) if not k or b - dips[k - 1][1] > 4.0]
        found.append((name, np.array([
            sum((on & (at >= b - 2.0) & (at <= b + 0.25)).any() for b, _ in dips), len(dips),
            sum((on & (at >= b - 2.0) & (at <= b - 0.2)).any() for b in lone), len(lone),
            (on & quiet).sum(), (warn & quiet).sum(), quiet.sum(),
            sum(all(not b - 2.05 <= x <= e + 0.35 for b, e in dips) for x in rises),
            flown.sum()])))
    return found


def row(flight: str, limit: str, n: np.ndarray) -> list[str]:
    """Return a row of the table."""
    return [flight, limit, f'{n[0]} of {n[1]}', f'{n[2]} of {n[3]}',
            f'{100.0 * n[4] / max(n[6], 1):.1f}', f'{n[7] / (n[8] * LOOK / 60.0):.2f}',
            f'{100.0 * n[5] / max(n[6], 1):.0f}']


def main() -> int:
    """Print the table, or put it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('flight', nargs='*', help='names (default all)')
    parser.add_argument('--page', type=Path, help='page whose table is replaced')
    options = parser.parse_args()
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        parser.error('OU_MONITOR_REALDATA is not set: it names the folder of the flights')
    rows, total = [], np.zeros(9, np.int64)
    for name, file, flight, cells in FLIGHTS:
        path = Path(folder) / file
        if options.flight and name not in options.flight:
            continue
        if not path.exists():
            print(f'{name}: {path} is not there, left out', file=sys.stderr)
            continue
        for limit, counts in fly(read_recording(path, flight=flight), cells):
            rows.append(row(name, limit, counts))
            total += counts
            print(rows[-1], file=sys.stderr)
    text = table(HEAD, [*rows, row('all', '', total)])
    if options.page:
        put(options.page, text, 'flag')
    else:
        print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
