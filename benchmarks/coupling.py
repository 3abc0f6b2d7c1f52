"""
False alarms and power of `coupling` on recorded gyros (3 min).

False alarms, without any coupling: a simulated supply with constant sigma, one whose sigma follows
the throttle of another flight, or the flight's own voltage with its gyro shifted in time.  Power:
the same simulated supplies added to the gyro with a gain of 5 deg/s per V (their rms is 50 mV).
Every gyro axis of the recordings is used, unfiltered if the log has it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math
from pathlib import Path
import sys

from common import arguments, deliver, FLIGHTS, recorded, say, table
import numpy as np
from ou_monitor.analysis.coupling import estimate_coupling
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.csv_table import read_column, read_csv
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import IMU, Request
from scipy import stats
from scipy.signal import lfilter

LOGS = {**{name: FLIGHTS[name] for name in ('nazgul', 'roma', 'bf3s', 'erle', 'jd')},
        'gecko': ('raw/ie_btfl_002.bbl', 1), 'px4': ('raw/px_sample_log_small.ulg', None)}
TABLES = {'crazyflie solo': 'cf_solo_large.csv', 'crazyflie pair': 'cf_pair_large.csv'}
KINDS = ('constant sigma', "sigma of another flight's throttle", 'gyro shifted')
ALPHAS, DEVIATION, GAIN = (20.0, 63.0, 200.0), 0.05, math.radians(5.0)
# Highest rate of a simulated supply, Hz, as of an ADC.
FASTEST = 500.0


@dataclass(frozen=True, eq=False)
class Flight:
    """Stamps (s), voltage (V), throttle; gyro axes by name with their stamps (s, rad/s)."""

    name: str
    t: np.ndarray
    voltage: np.ndarray
    throttle: np.ndarray
    gyro_t: np.ndarray
    axes: dict[str, np.ndarray]


def flights(folder: Path) -> Iterator[Flight]:
    """Yield the recordings that are there."""
    for name, (file, number) in LOGS.items():
        path = folder / file
        if not path.exists():
            say(f'{name}: {path} is not there, left out')
            continue
        log = import_log(path, Request(number or 1))
        volts = 'battery_status[1].voltage_v' if name == 'px4' else None
        chosen = choose(path, log, voltage=volts)
        axes = {f'{one.name} {axis}': one.values[:, k]
                for one in log.of(IMU) if one.t.size == log.of(IMU)[0].t.size
                for k, axis in enumerate('xyz')}
        series = chosen.throttle
        throttle = (np.full(chosen.voltage.n, np.nan) if series is None else
                    np.interp(chosen.voltage.t, series.t, series.values))
        yield Flight(name, chosen.voltage.t, chosen.voltage.values, throttle,
                     log.of(IMU)[0].t, axes)
    for name, file in TABLES.items():
        path = folder / file
        if path.exists():
            raw = read_csv(path)
            t, voltage, throttle = raw.t, raw.voltage, raw.throttle
            at, rate = read_column(path, 'roll_rate')
            yield Flight(name, t, voltage, throttle, at, {'roll_rate': np.radians(rate)})


def supply(rng: np.random.Generator, t: np.ndarray, rise: np.ndarray) -> np.ndarray:
    """Return an OU whose driving noise is proportional to `rise`, V."""
    phi = math.exp(-float(rng.choice(ALPHAS)) * float(np.median(np.diff(t))))
    drive = math.sqrt(1.0 - phi**2) * DEVIATION * rise * rng.standard_normal(t.size)
    return lfilter([1.0], [1.0, -phi], drive)


def draw(rng: np.random.Generator, kind: str, flight: Flight, axis: np.ndarray,
         other: Flight) -> dict[str, list[bool]]:
    """Return whether coupling was reported: without coupling, and with coupling added."""
    turned = np.roll(axis, rng.integers(axis.size // 10, axis.size - axis.size // 10))
    if kind == KINDS[2]:
        found = estimate_coupling(flight.t, flight.voltage, flight.gyro_t, turned,
                                  throttle=flight.throttle)
        return {'alarm': [found.seen], 'power': []}
    rate = min(FASTEST, 1.0 / float(np.median(np.diff(flight.gyro_t))))
    t = np.arange(flight.gyro_t[0], flight.gyro_t[-1], 1.0 / rate)
    rise = np.ones(t.size)
    if kind == KINDS[1]:
        known = np.isfinite(other.throttle)
        span = float(np.ptp(other.t))
        at = other.t[0] + np.mod(t - t[0] + rng.uniform(0.0, span), span)
        rise = 0.3 + 3.0 * np.interp(at, other.t[known], other.throttle[known])
    voltage = supply(rng, t, rise)
    throttle = np.interp(t, flight.t, flight.throttle)
    gone = estimate_coupling(t, voltage, flight.gyro_t, axis, throttle=throttle)
    there = estimate_coupling(t, voltage, flight.gyro_t,
                              axis + GAIN * np.interp(flight.gyro_t, t, voltage),
                              throttle=throttle)
    return {'alarm': [gone.seen], 'power': [there.seen]}


def share(values: list[bool], whole: bool = False) -> str:
    """Return a count, with its share and 95 % interval (Clopper and Pearson, 1934) if `whole`."""
    if not values:
        return '-'
    if not whole:
        return f'{sum(values)} of {len(values)}'
    low, high = stats.binomtest(sum(values), len(values)).proportion_ci(0.95)
    return (f'{sum(values)} of {len(values)} ({100 * sum(values) / len(values):.1f} %, '
            f'95 %: {100 * low:.1f} to {100 * high:.1f})')


def main() -> int:
    """Draw and print the table, or put it into the page."""
    parser = arguments(__doc__)
    parser.add_argument('--each', type=int, default=2, help='draws of each axis and kind')
    options = parser.parse_args()
    rng = np.random.default_rng(20)
    known = list(flights(recorded()))
    flown = [one for one in known if np.isfinite(one.throttle).any() and np.ptp(one.t) > 20.0]
    counts: dict[str, dict[str, dict[str, list[bool]]]] = {}
    for flight in known:
        mine = counts[flight.name] = {kind: {'alarm': [], 'power': []} for kind in KINDS}
        for kind in KINDS:
            # A battery at 10 Hz and less has no band in common with the gyro.
            if kind == KINDS[2] and 1.0 / np.median(np.diff(flight.t)) < 20.0:
                continue
            if np.ptp(flight.gyro_t) < 20.0 or np.median(np.diff(flight.gyro_t)) > 1.0 / 40.0:
                continue
            for axis in flight.axes.values():
                for _ in range(options.each):
                    others = [one for one in flown if one.name != flight.name]
                    other = others[int(rng.integers(len(others)))]
                    for what, seen in draw(rng, kind, flight, axis, other).items():
                        mine[kind][what] += seen
        say(flight.name, {kind: share(one['alarm']) for kind, one in mine.items()})
    axes = {one.name: len(one.axes) for one in known}
    rows = [[name, str(axes[name]), *(share(mine[kind]['alarm']) for kind in KINDS),
             share([seen for kind in KINDS for seen in mine[kind]['power']])]
            for name, mine in counts.items() if mine[KINDS[0]]['alarm']]
    alarms = [[seen for mine in counts.values() for seen in mine[kind]['alarm']]
              for kind in KINDS]
    power = [seen for mine in counts.values() for kind in KINDS for seen in mine[kind]['power']]
    rows.append(['**all**', str(sum(int(row[1]) for row in rows)),
                 *(share(one, True) for one in (*alarms, power))])
    text = table(['recording', 'axes', *(f'{kind}: seen' for kind in KINDS),
                  'gain 5 deg/s per V: seen'], rows)
    deliver(text, options.page, 'coupling')
    return 0


if __name__ == '__main__':
    sys.exit(main())
