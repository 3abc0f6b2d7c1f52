"""
Measured current as the load: voltage a second ahead and resistance, against PX4's fit (1 min).

The peer fits voltage = level - R current to each reading with a forgetting factor of 0.95, as PX4
does onboard (its pull request 23205); it skips updates that do not shrink its covariance.  Both
get the current of the predicted second.  The first quarter of a recording is not scored.
"""

from __future__ import annotations

import math
import sys

from common import arguments, deliver, FLIGHTS, flights, table
import numpy as np
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.records import Recording
from ou_monitor.timeline import readings_of

# File below OU_MONITOR_REALDATA, flight of a log.
RAILS: dict[str, tuple[str, int | None]] = {
    'frc_ol_1': ('frc_ol_1.csv', None), 'euc_1': ('euc_1.csv', None),
    'hebi_x': ('hebi_x.csv', None), 'js_11t': ('js_11t_6s.csv', None),
    'as_f60': ('as_f60.csv', None), 'jd': FLIGHTS['jd'], 'bf3s': FLIGHTS['bf3s'],
    'ar8': ('raw/bf_ar8_6s.BFL', None), 'nazgul': FLIGHTS['nazgul'], 'roma': FLIGHTS['roma'],
    'in_xr': ('raw/in_xr_141340.TXT', None)}
AHEAD, LOOK = 1.0, 0.1  # s
FORGETTING, LEVEL, OHM, LEVEL_VAR, OHM_VAR = 0.95, 4.2, 0.005, 1.5, 0.1  # Per cell


def peer(voltage: np.ndarray, current: np.ndarray) -> np.ndarray:
    """Return level, V, and resistance, Ohm, after each reading."""
    cells = math.ceil(voltage[0] / 4.25)
    x, P = cells * np.array([LEVEL, OHM]), cells * np.diag([LEVEL_VAR, OHM_VAR])
    least, found = math.inf, np.empty((voltage.size, 2))
    for k, (v, i) in enumerate(zip(voltage, current)):
        h = np.array([1.0, -i])
        gain = P @ h / (FORGETTING + h @ P @ h)
        after = (P - np.outer(gain, h @ P)) / FORGETTING
        if np.linalg.norm(after) < least:
            x, P, least = x + gain * (v - h @ x), after, float(np.linalg.norm(after))
        else:
            x = np.array([v + x[1] * i, x[1]])
        found[k] = x
    return found


def measure(name: str, recording: Recording) -> list[str]:
    """Return the row of a recording."""
    recording = readings_of(recording)
    t, v, u, i = recording.t - recording.t[0], recording.voltage, recording.throttle, \
        recording.current
    known = np.isfinite(i)
    t, v, u, i = t[known], v[known], u[known], i[known]
    beside, loads = peer(v, i), LoadFilter()
    look, first, rows = 0.0, 0, []
    for k in range(t.size):
        if t[k] < look:
            continue
        loads.push(t[first:k + 1], v[first:k + 1], u[first:k + 1], i[first:k + 1])
        look, first, j = t[k] + LOOK, k + 1, int(np.searchsorted(t, t[k] + AHEAD))
        if t[k] > 0.25 * t[-1] and j < t.size and t[j] - t[k] < 2.0 * AHEAD:
            rows.append((loads.path(t[k + 1:j + 1], None, i[k + 1:j + 1])[-1] - v[j],
                         beside[k, 0] - beside[k, 1] * i[j] - v[j],
                         loads.load().resistance, beside[k, 1], v[j]))
    ours, theirs, ohm, other, level = np.array(rows).T
    rms, rms_peer = (1e3 * math.sqrt(np.nanmean(e * e)) for e in (ours, theirs))
    spread = [f'{1e3 * np.nanmean(x):.1f} \u00b1 {1e3 * np.nanstd(x):.1f}' for x in (ohm, other)]
    return [name, f'{1e3 * level.std():.0f}', f'{rms:.0f}', f'{rms_peer:.0f}',
            f'{rms / rms_peer:.2f}', *spread, loads.load().basis.name.lower()]


def main() -> int:
    """Measure the recordings and print the table, or put it into the page."""
    options = arguments(__doc__, names=True).parse_args()
    rows = [measure(*one) for one in flights(options.names, RAILS)]
    text = table(['recording', 'deviation mV', '1 s ahead, mV', 'peer', 'ratio', 'mOhm',
                  'peer', 'basis'], rows)
    deliver(text, options.page, 'rails')
    return 0


if __name__ == '__main__':
    sys.exit(main())
