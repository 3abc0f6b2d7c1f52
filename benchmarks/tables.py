"""Markdown tables, drawings that stand alone, and what is written between marks of a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from windows import NAMES

_TITLES = {'alpha': 'alpha', 'sigma': 'sigma', 'var_inf': 'Var_inf'}


STYLE = """<style>
text { fill: #5d686c; font: 12px system-ui, -apple-system, "Segoe UI", sans-serif; }
text.title { fill: #1c2326; font-weight: 600; font-size: 13px; } text.legend { fill: #1c2326; }
text.light { fill: #ffffff; } .grid { stroke: #dde3e5; stroke-width: 1; }
.line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.thick { stroke-width: 2.2; } .dash { stroke-dasharray: 6 4; }
.s0 { stroke: #0072b2; } .s1 { stroke: #d55e00; } .s2 { stroke: #009e73; }
.s3 { stroke: #cc79a7; } .s4 { stroke: #8a6d00; } .s5 { stroke: #56b4e9; }
.s6 { stroke: #444444; } .s7 { stroke: #9aa5a9; }
.band { stroke: none; opacity: .18; } .faint { opacity: .5; }
.band.s0, .dot.s0 { fill: #0072b2; } .band.s1, .dot.s1 { fill: #d55e00; }
.dot.s2 { fill: #009e73; } .dot.s3 { fill: #cc79a7; } .dot.s4 { fill: #8a6d00; }
.band.s7, .dot.s7 { fill: #9aa5a9; }
.shade { fill: #d55e00; opacity: .35; }
.panel { fill: #ffffff; opacity: .8; } .right { fill: none; stroke: #1c2326; stroke-width: 1.2; }
</style>"""


def drawing(parts: Sequence[str], width: int, height: int, title: str) -> str:
    """Return an SVG document that stands alone, on white."""
    return '\n'.join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" '
        f'aria-label="{escape(title, quote=True)}">', STYLE,
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>', *parts, '</svg>', ''])


def put(path: Path, text: str, name: str) -> None:
    """Write text: between the marks of that name where the file has them, else as the file."""
    begin, end = f'<!-- {name} begins -->', f'<!-- {name} ends -->'
    if path.exists():
        head, mark, rest = path.read_text().partition(begin)
        _, last, tail = rest.partition(end)
        if mark and last:
            text = f'{head}{mark}\n{text}\n{last}{tail}'
    path.write_text(text)


def deliver(text: str, page: Path | None, name: str) -> None:
    """Put a text between the marks of a page, or print it where there is none."""
    if page is None:
        print(text)
    else:
        put(page, text, name)


def recorded() -> Path:
    """Return the folder of the recorded flights; it ends a program where there is none."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        raise SystemExit('OU_MONITOR_REALDATA is not set: it names the folder of the flights')
    return Path(folder)


def median3(v: np.ndarray) -> np.ndarray:
    """Return the middle one of each sample and the two before."""
    padded = np.concatenate((v[:1], v[:1], v))
    return np.median(np.stack((padded[:-2], padded[1:-1], padded[2:])), axis=0)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table; all columns but the first are aligned right."""
    lines = ['| ' + ' | '.join(head) + ' |', '|---|' + '---:|' * (len(head) - 1)]
    lines += ['| ' + ' | '.join(row) + ' |' for row in rows]
    return '\n'.join(lines) + '\n'


def number(value: float, form: str = '.1f') -> str:
    """Return a number, or a dash for none."""
    return format(value, form) if math.isfinite(value) else '-'


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
