"""
The load model on recorded flights: share of the voltage explained by throttle (2 min).

Simulated ahead: the model is fitted to the first half and predicts the second from its throttle;
an offset of the prediction counts as error. One second ahead: predictions by the filter in the
second half, given the throttle of that second.
"""

from __future__ import annotations

import sys
import time

from common import arguments, deliver, flights, say, table
import numpy as np
from ou_monitor.model.load_fit import fit_load, LoadInput
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.records import Recording

# Time after which the load should be known, s; for a flight shorter than 30 s.
SETTLED, SHORT_SETTLED = 20.0, 8.0
# Time between reports of the filter, s, as in a node.
LOOK = 0.1


def explained(voltage: np.ndarray, predicted: np.ndarray) -> float:
    """Return the share of variance explained; an offset counts as error."""
    return 1.0 - float(np.sum((voltage - predicted) ** 2) / np.sum(
        (voltage - voltage.mean()) ** 2))


def measure(name: str, recording: Recording) -> list[str]:
    """Return one row: simulated ahead, a second ahead, share known, cost."""
    good = np.isfinite(recording.throttle)
    t, v = recording.t[good] - recording.t[good][0], recording.voltage[good]
    u = np.clip(recording.throttle[good], 0.0, 1.0)
    current = (np.full(t.size, np.nan) if recording.current is None
               else recording.current[good])
    second = t > 0.5 * t[-1]
    started = time.process_time()
    fit = fit_load(LoadInput.THROTTLE, t[~second], v[~second], u[~second], falls=True)
    fit_time = time.process_time() - started
    ahead = explained(v[second], fit.path(t, u)[second])
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
            f'{fit_time:.2f}', f'{1e6 * spent / t.size:.0f}']


def main() -> int:
    """Measure the flights and print the table, or put it into the page."""
    options = arguments(__doc__, names=True).parse_args()
    rows = []
    for name, recording in flights(options.names):
        if not np.isfinite(recording.throttle).any():
            say(f'{name}: the log has no throttle, left out')
            continue
        rows.append(measure(name, recording))
        say(rows[-1])
    text = table(['flight', 's', 'Hz', 'simulated ahead', '1 s ahead', '1 s ahead, RMSE mV',
                  'known %', 'delay, ms', 'mOhm', 'fit, CPU s', 'sample, CPU us'], rows)
    deliver(text, options.page, 'flights')
    return 0


if __name__ == '__main__':
    sys.exit(main())
