"""
Shared by all programs: paths, arguments, Markdown tables, drawings.

Import it before NumPy: it adds the checkout to the path and limits each process to one thread, so
that CPU times are comparable.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from html import escape
from importlib import metadata
import math
import os
from pathlib import Path
import platform
import re
import subprocess
import sys

for _name in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
    os.environ.setdefault(_name, '1')
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'test/support'), str(ROOT / 'test/hidden')]

import numpy as np  # noqa: E402
from ou_monitor.recordings.read import read_recording  # noqa: E402
from ou_monitor.records import Recording  # noqa: E402

# Recorded flights: file below OU_MONITOR_REALDATA, and flight of the log.
FLIGHTS: dict[str, tuple[str, int | None]] = {
    'gecko': ('bf_gecko_a.csv', None), 'nazgul': ('raw/bf_nazgul_4s.bbl', 1),
    'roma': ('raw/bf_roma_6s.bbl', 3), 'bf3s': ('raw/bf_3s_erpm2.bbl', 2),
    'erle': ('raw/ac_erle_althold2.BIN', None), 'jd': ('raw/ac_jd_2004.bin', None),
    'cf_solo': ('cf_solo_large.csv', None), 'cf_pair': ('cf_pair_large.csv', None),
    'cf_takeoff': ('cf_takeoff.csv', None)}
HIRO = ('raw/bf_hiro_4s.BFL', None)
# Bench recordings.
BENCHES = {name: (f'{name}.csv', None) for name in (
    'mm_bench_1', 'mm_bench_3', 'mm_bench_5', 'xt_pico_a')}

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
.right { fill: none; stroke: #1c2326; stroke-width: 1.2; }
</style>"""


def arguments(doc: str | None, names: bool = False, help_option: bool = True
              ) -> argparse.ArgumentParser:
    """Return a parser with `--page` and, if `names` is true, names of recordings."""
    parser = argparse.ArgumentParser(description=(doc or '').strip().partition('\n')[0],
                                     add_help=help_option)
    if names:
        parser.add_argument('names', nargs='*', metavar='NAME', help='recordings (default: all)')
    parser.add_argument('--page', type=Path, help='page whose table is replaced')
    return parser


def say(*words: object) -> None:
    """Report progress."""
    print(*words, file=sys.stderr, flush=True)


def recorded() -> Path:
    """Return the folder of the recorded flights; end the program if there is none."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is None:
        raise SystemExit('OU_MONITOR_REALDATA is not set: it names the folder of the flights')
    return Path(folder)


def flights(names: Sequence[str] = (), of: Mapping[str, tuple[str, int | None]] = FLIGHTS
            ) -> Iterator[tuple[str, Recording]]:
    """Yield name and recording of each flight whose file exists; report the missing ones."""
    folder = recorded()
    for name, (file, number) in of.items():
        if names and name not in names:
            continue
        if (folder / file).exists():
            yield name, read_recording(folder / file, flight=number)
        else:
            say(f'{name}: {folder / file} is not there, left out')


def environment(*packages: str) -> str:
    """Return the conditions of a measurement: date, versions, processor and commit."""
    about = [date.today().isoformat(), f'Python {platform.python_version()}']
    for name in ('numpy', 'scipy', *packages):
        try:
            about.append(f'{name} {metadata.version(name)}')
        except metadata.PackageNotFoundError:
            about.append(f'{name} not installed')
    info = Path('/proc/cpuinfo')
    found = re.search(r'model name\s*:\s*(.+)', info.read_text()) if info.exists() else None
    commit = subprocess.run(['git', 'describe', '--always', '--dirty'], cwd=ROOT, text=True,
                            capture_output=True, check=False).stdout.strip()
    return ', '.join([*about, found[1] if found else platform.machine(),
                      f'commit {commit or "unknown"}'])


def median3(v: np.ndarray) -> np.ndarray:
    """Return the median of each sample and the two before it."""
    padded = np.concatenate((v[:1], v[:1], v))
    return np.median(np.stack((padded[:-2], padded[1:-1], padded[2:])), axis=0)


def throttles(rng: np.random.Generator, flights: int, n: int, rate: float,
              dwell: tuple[float, float], span: tuple[float, float],
              ramp: tuple[float, float] | None = None) -> np.ndarray:
    """Return throttle in steps, half of them ramps, shape (flights, n) (dwell and ramp in s)."""
    out = np.empty((flights, n))
    for row in out:
        at, before = 0, float(rng.uniform(*span))
        while at < n:
            after = float(rng.uniform(*span))
            rise = int(rng.uniform(*ramp) * rate) if ramp and rng.random() < 0.5 else 1
            end = at + rise + int(rng.uniform(*dwell) * rate)
            piece = np.concatenate((np.linspace(before, after, rise + 1)[1:],
                                    np.full(end - at - rise, after)))
            row[at:end] = piece[:n - at]
            at, before = end, after
    return out


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table; columns of words are aligned left, like the first."""
    right = ['---' if k == 0 or any(re.match('[a-z]{2}', row[k]) for row in rows) else '---:'
             for k in range(len(head))]
    lines = ['| ' + ' | '.join(row) + ' |' for row in (head, *rows)]
    return '\n'.join([lines[0], '|' + '|'.join(right) + '|', *lines[1:]]) + '\n'


def number(value: float, form: str = '.1f') -> str:
    """Return a number, or a dash if it is not finite."""
    return format(value, form) if math.isfinite(value) else '-'


def drawing(parts: Sequence[str], width: int, height: int, title: str, style: str = STYLE) -> str:
    """Return a self-contained SVG document on white."""
    return '\n'.join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" '
        f'width="{width}" height="{height}" role="img" '
        f'aria-label="{escape(title, quote=True)}">', style,
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>', *parts, '</svg>', ''])


def deliver(text: str, page: Path | None, name: str) -> None:
    """Write a text between the marks of that name in a page; print it if no page is given."""
    if page is None:
        print(text)
        return
    begin, end = f'<!-- {name} begins -->', f'<!-- {name} ends -->'
    if page.exists():
        head, mark, rest = page.read_text().partition(begin)
        _, last, tail = rest.partition(end)
        if mark and last:
            text = f'{head}{mark}\n{text}\n{last}{tail}'
    page.write_text(text)
