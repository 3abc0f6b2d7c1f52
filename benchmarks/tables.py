"""The tables of estimator.py."""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import Any

from common import number, table
from windows import NAMES

_TITLES = {'alpha': 'alpha', 'sigma': 'sigma', 'var_inf': 'Var_inf'}


def _bias(one: dict[str, float]) -> str:
    if not math.isfinite(one['bias']):
        return '-'
    return f"{one['bias']:+.1f} ± {number(one['bias_mc'])}"


def _cells(summary: dict[str, Any]) -> list[str]:
    cells = []
    for name in NAMES:
        one = summary[name]
        cells += [_bias(one), number(one['rmse']), number(one['coverage'], '.0f')]
    return cells


_HEAD = [f'{_TITLES[n]} {what}' for n in NAMES for what in ('bias %', 'RMSE %', 'cover %')]


def accuracy(tables: dict[str, Any]) -> str:
    """Return one table for each sensor."""
    out = []
    for sensor, methods in tables.items():
        rows = []
        for name, s in methods.items():
            lost = s['windows'] - s['told']
            windows = f"{s['windows']}" + (f' ({lost} failed)' if lost else '')
            rows.append([name, *_cells(s), number(s['cpu_ms'], '.3g'), windows])
        out.append(f'**{sensor}**\n\n' + table(['method', *_HEAD, 'CPU ms', 'windows'], rows))
    return '\n'.join(out)


def ratios(results: dict[str, Any]) -> str:
    """Return our RMSE over the reference's."""
    rows = [[sensor, reference, *(_ratio(values[name]) for name in NAMES)]
            for sensor, references in results.items()
            for reference, values in references.items()]
    return table(['sensor', 'our RMSE over that of', *_TITLES.values()], rows)


def _ratio(pair: Sequence[float]) -> str:
    return f"{number(pair[0], '.3f')} ± {number(pair[1], '.3f')}"


def small(results: dict[str, Any]) -> str:
    """Return tables of short windows."""
    rows, shares = [], []
    for relaxations, one in results.items():
        for name, key in (('ours', 'ours'), ('Kalman, same windows', 'kalman'),
                          ('Kalman, all windows', 'kalman_all')):
            rows.append([relaxations, name, *_cells(one[key]), str(one[key]['told'])])
        total = one['ours']['windows']
        found = sorted(one['ours']['statuses'].items(), key=lambda item: -item[1])
        shares.append([relaxations, str(one['samples']), str(total),
                       ', '.join(f'{k} {100.0 * v / total:.0f} %' for k, v in found)])
    return (table(['alpha T', 'method', *_HEAD, 'windows told'], rows) + '\n'
            + table(['alpha T', 'samples', 'windows', 'what our estimator says'], shares))


def load(results: dict[str, Any]) -> str:
    """Return the table of throttle steps."""
    rows = []
    for name, one in results.items():
        s, ratio = one['summary'], one['ratio']
        rows.append([name, *_cells(s), *(_ratio(ratio[n]) if ratio else '1' for n in NAMES),
                     f"{s['told']}/{s['windows']}"])
    return table(['response of the supply', *_HEAD,
                  *(f'{t} ratio' for t in _TITLES.values()), 'told'], rows)


_PUSHES = (
    ('push_scalar', 'push(float, float, float)'),
    ('push_bare', 'push(t, voltage)'),
    ('push', 'push(t, voltage, throttle)'),
    ('push_moving', 'the same, throttle moving'),
    ('sustained', 'push(t, voltage, throttle) and a fit at 20 Hz'),
)


def throughput(results: dict[str, Any]) -> str:
    """Return millions of samples a second, and ratios to the limits."""
    rows = []
    for rate, blocks in results.items():
        for block, r in blocks.items():
            for key, name in _PUSHES:
                if key not in r:
                    continue
                rows.append([rate, block, name, *(
                    number(1e-6 * r[k], '.3g') for k in (key, 'dot', 'hot_dot', 'hot_copy')),
                    *(number(r[k] / r[key], '.3g') for k in ('dot', 'hot_dot', 'hot_copy'))])
    return table(['spacing', 'block', 'what', 'M/s', 'dot M/s', 'dot (hot) M/s', 'copy (hot) M/s',
                  'dot / push', 'dot (hot) / push', 'copy (hot) / push'], rows)


def latency(results: dict[str, Any]) -> str:
    """Return the latency of estimate() by window."""
    rows = []
    for window, cases in results.items():
        for case, name in (('still', 'steady'), ('moving', 'moving')):
            r = cases[case]
            rows.append([f'{window} s', name, *(number(r[k], '.0f') for k in (
                'p50_us', 'p99_us', 'wall_p50_us', 'wall_p99_us', 'first_us'))])
    return table(['window', 'throttle', 'CPU p50 us', 'CPU p99 us', 'wall p50 us', 'wall p99 us',
                  'first fit, CPU us'], rows)
