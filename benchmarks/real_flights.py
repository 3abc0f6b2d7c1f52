"""
The load model on recorded flights: what of the voltage follows from throttle alone (2 min).

Simulated ahead: fitted on the first half, the second predicted from its throttle; offset included.
One second ahead: the filter, on the second half, the throttle of that second given.
Flights that are not there are left out, with a word on stderr.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import redirect_stdout
import os
from pathlib import Path
import sys
import tempfile
import time

import numpy as np
from ou_monitor.cli.main import main as command
from ou_monitor.model.load_fit import fit_load
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Recording
from tables import put, table

ROOT = Path(__file__).resolve().parents[1]
# Name, file below OU_MONITOR_REALDATA, options of `convert` for a log.
FLIGHTS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ('gecko', 'bf_gecko_a.csv', ()),
    ('nazgul', 'raw/bf_nazgul_4s.bbl', ('--flight', '1')),
    ('roma', 'raw/bf_roma_6s.bbl', ('--flight', '3')),
    ('bf3s', 'raw/bf_3s_erpm2.bbl', ('--flight', '2')),
    ('erle', 'raw/ac_erle_althold2.BIN', ()),
    ('jd', 'raw/ac_jd_2004.bin', ()),
    ('cf_solo', 'cf_solo_large.csv', ()),
    ('cf_pair', 'cf_pair_large.csv', ()),
    ('cf_takeoff', 'cf_takeoff.csv', ()),
)
# Recordings on the bench, which only discover looks at.
BENCHES = tuple((name, f'{name}.csv', ()) for name in (
    'mm_bench_1', 'mm_bench_3', 'mm_bench_5', 'xt_pico_a'))
# Seconds until a load should be known; of a flight shorter than 30 s.
SETTLED, SHORT_SETTLED = 20.0, 8.0
# Seconds from one look at the filter to the next: it is read as a node would.
LOOK = 0.1


def explained(voltage: np.ndarray, predicted: np.ndarray) -> float:
    """Return the share of variance explained, offset included."""
    return 1.0 - float(np.sum((voltage - predicted) ** 2) / np.sum(
        (voltage - voltage.mean()) ** 2))


def flights(folder: Path, names: list[str]) -> Iterator[tuple[str, Recording]]:
    """Yield the recordings that are there."""
    for name, file, options in FLIGHTS:
        path = folder / file
        if names and name not in names:
            continue
        if not path.exists():
            print(f'{name}: {path} is not there, left out', file=sys.stderr)
        elif path.suffix == '.csv':
            yield name, read_recording(path)
        else:
            with tempfile.TemporaryDirectory() as made:
                with redirect_stdout(sys.stderr):
                    failed = command(['convert', str(path), f'{made}/flight', *options])
                if failed:
                    print(f'{name}: not converted, left out', file=sys.stderr)
                else:
                    yield name, read_recording(Path(made) / 'flight')


def measure(name: str, recording: Recording) -> list[str]:
    """Return one row: simulated ahead, a second ahead, share known, cost."""
    good = np.isfinite(recording.throttle)
    t, v = recording.t[good] - recording.t[good][0], recording.voltage[good]
    u = np.clip(recording.throttle[good], 0.0, 1.0)
    current = (np.full(t.size, np.nan) if recording.current is None
               else recording.current[good])
    second = t > 0.5 * t[-1]
    started = time.process_time()
    fit = fit_load(t[~second], v[~second], u[~second])
    fit_time = time.process_time() - started
    ahead = explained(v[second], fit.model.path(t, u)[second])
    loads = LoadFilter()
    known, errors, truths, spent, look = [], [], [], 0.0, 0.0
    spacing = float(np.median(np.diff(t)))
    for k in range(t.size):
        started = time.process_time()
        loads.push(t[k], v[k], u[k], current[k])
        spent += time.process_time() - started
        if t[k] < look:
            continue
        look = t[k] + LOOK
        started = time.process_time()
        load = loads.load()
        spent += time.process_time() - started
        if t[k] >= (SETTLED if t[-1] >= 30.0 else SHORT_SETTLED):
            known.append(load.known)
        j = int(np.searchsorted(t, t[k] + 1.0))
        if second[k] and j < t.size and t[j] - t[k] < 1.01 + 2.0 * spacing:
            errors.append(v[j] - loads.path(t[k + 1:j + 1], u[k + 1:j + 1])[-1])
            truths.append(v[j])
    load = loads.load()
    ohm = (f'{1e3 * load.resistance:.0f} \u00b1 {1e3 * load.resistance_se:.0f}'
           if np.isfinite(load.resistance) else '-')
    truth, error = np.array(truths), np.array(errors)
    return [name, f'{t[-1]:.0f}', f'{1.0 / spacing:.0f}', f'{ahead:.2f}',
            f'{explained(truth, truth - error):.2f}', f'{1e3 * np.sqrt(np.mean(error**2)):.0f}',
            f'{100.0 * np.mean(known):.0f}', f'{1e3 * load.delay:.0f}', ohm,
            f'{fit.condition:.0f}', ', '.join(fit.at_bounds) or '-', f'{fit_time:.1f}',
            f'{1e6 * spent / t.size:.0f}']


def main() -> int:
    """Measure the flights and print the table, or put it into the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('flight', nargs='*', help='names (default all)')
    parser.add_argument('--page', type=Path, help='page whose table is replaced')
    options = parser.parse_args()
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        parser.error('OU_MONITOR_REALDATA is not set: it names the folder of the flights')
    rows = []
    for name, recording in flights(Path(folder), options.flight):
        if not np.isfinite(recording.throttle).any():
            print(f'{name}: no throttle was found in the log, left out', file=sys.stderr)
            continue
        rows.append(measure(name, recording))
        print(rows[-1], file=sys.stderr)
    text = table(['flight', 's', 'Hz', 'simulated ahead', '1 s ahead', '1 s ahead, RMSE mV',
                  'known %', 'delay, ms', 'mOhm', 'condition', 'at bounds', 'fit, CPU s',
                  'sample, CPU us'], rows)
    if options.page:
        put(options.page, text, 'flights')
    else:
        print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
