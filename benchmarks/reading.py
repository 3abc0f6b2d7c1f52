"""
Reading bags: against the libraries that decode message by message; and memory.

    python benchmarks/reading.py peers --table doc/reading.md
    python benchmarks/reading.py files --table doc/reading.md
    python benchmarks/reading.py memory --table doc/reading.md
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from datetime import date
from importlib.metadata import version
from pathlib import Path
import platform
import resource
import subprocess
import sys
import tempfile
import time
from typing import Any

from mcap.writer import CompressionType, IndexType
import numpy as np
from ou_monitor.recordings.bag import BagWriter
from ou_monitor.recordings.read import read_pieces, read_recording
from ou_monitor.recordings.standard_types import (
    encode_block, encode_scalars, FLOAT32, FLOAT32_ARRAY)
from reading_bags import BLOCK, cases, messages, write
from reading_peers import check, mcap_ros2, ours, recording, rosbags, unpacked
from tables import table

COMPRESSIONS = {'none': CompressionType.NONE, 'lz4': CompressionType.LZ4,
                'zstd': CompressionType.ZSTD}
# Repeats of the reader that takes milliseconds; the others take seconds.
REPEATS = 5


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the least CPU time of some calls, s, and what the last one returned."""
    best, result = np.inf, None
    for _ in range(repeats):
        begin = time.process_time()
        result = call()
        best = min(best, time.process_time() - begin)
    return best, result


def peers(given: argparse.Namespace, folder: Path) -> str:
    """Compare with rosbags and mcap-ros2-support: types and compressions."""
    rows = []
    for case in cases(folder):
        count = given.messages
        content = messages(case, count)
        for name, compression in COMPRESSIONS.items():
            print(f'{case.name}, {name}', file=sys.stderr)
            path = write(folder / 'bag.mcap', case, content, compression=compression)
            least, _ = timed(lambda: unpacked(path), REPEATS)
            mine, found = timed(lambda: ours(path, case), REPEATS)
            whole, _ = timed(lambda: recording(path, case), REPEATS)
            cells = [case.name, name, *(f'{seconds / count * 1e6:.2f}'
                                        for seconds in (least, mine, whole))]
            for other in (rosbags, mcap_ros2):
                seconds, theirs = timed(lambda other=other: other(path, case), given.repeats)
                check(case, found, theirs)
                cells += [f'{seconds / count * 1e6:.1f}', f'**{seconds / mine:.0f}**']
            rows.append(cells)
    return table(['type of the voltage', 'compression', 'unpacking alone', 'this package',
                  '`read_recording`', 'rosbags', 'times', 'mcap-ros2-support', 'times'], rows)


def files(given: argparse.Namespace, folder: Path) -> str:
    """Compare files with and without indexes, chunks, summaries."""
    ways: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
        ('chunks, indexed', {}, {}),
        ('chunks, indexed; `partial`: the whole file is checked', {}, {'partial': True}),
        ('chunks of 128 KiB, indexed', {'chunk_size': 128 * 1024}, {}),
        ('chunks without message indexes', {'index_types': IndexType.CHUNK}, {}),
        ('chunks, no summary', {
            'index_types': IndexType.NONE, 'use_statistics': False,
            'use_summary_offsets': False, 'repeat_channels': False, 'repeat_schemas': False}, {}),
        ('no chunks', {'use_chunking': False}, {}),
        ('a tenth of the time (`start`, `end`)', {}, {
            'start': 0.45e-3 * given.messages, 'end': 0.55e-3 * given.messages})]
    rows = []
    first: dict[str, float] = {}
    chosen = [case for case in cases(folder) if case.name in ('Float32', 'BatteryState')]
    contents = {case.name: messages(case, given.messages) for case in chosen}
    for words, options, reading in ways:
        cells = [words]
        for case in chosen:
            path = write(folder / 'bag.mcap', case, contents[case.name], **options)
            seconds, found = timed(
                lambda: read_recording(path, msg_config=case.config, **reading), REPEATS)
            assert found.n == given.messages * (0.1 if 'start' in reading else 1.0)
            first.setdefault(case.name, seconds)
            cells += [f'{seconds * 1e3:.0f}', f'{seconds / first[case.name]:.2f}']
        rows.append(cells)
    return table(['file (zstd)', 'Float32, ms', 'times the first', 'BatteryState, ms',
                  'times the first'], rows)


def memory(given: argparse.Namespace, folder: Path) -> str:
    """Peak memory of a process that reads a long bag, whole and in pieces."""
    path = folder / 'long.mcap'
    rng = np.random.default_rng(1)
    blocks = [encode_block(row) for row in rng.normal(5.0, 0.1, (997, BLOCK))]
    with BagWriter(path) as bag:
        bag.add_topic('voltage', FLOAT32_ARRAY, sample_rate=10_000.0)
        bag.add_topic('throttle', FLOAT32)
        for k in range(given.samples // BLOCK):
            at = (k + 1) * 10_000_000
            if k % 5 == 0:
                bag.write('throttle', at, encode_scalars(FLOAT32, [k % 7 / 7])[0])
            bag.write('voltage', at, blocks[k % len(blocks)])
    rows = []
    for words, how in (('nothing read (Python, NumPy, mcap)', 'none'),
                       ('whole', 'whole'), ('in pieces of 1 000 000 samples', '1000000'),
                       ('in pieces of 100 000 samples', '100000')):
        print(words, file=sys.stderr)
        done = subprocess.run([sys.executable, __file__, 'child', str(path), how], check=True,
                              capture_output=True, text=True)
        count, peak, seconds = (float(word) for word in done.stdout.split())
        assert how == 'none' or count == given.samples // BLOCK * BLOCK
        rows.append([words, f'{peak:.0f}', f'{seconds:.2f}' if count else '-'])
    size = path.stat().st_size / 1e6
    return (f'{given.samples // 1_000_000} million samples in blocks of {BLOCK}, {size:.0f} MB on '
            f'disk, {given.samples * 24 / 1e6:.0f} MB as arrays (stamp, voltage, throttle).\n\n'
            + table(['reading', 'peak resident memory, MB', 'CPU, s'], rows))


def child(path: str, how: str) -> None:
    """Read, and print samples, peak resident memory (MB) and CPU time (s)."""
    begin, count = time.process_time(), 0
    if how == 'whole':
        count = read_recording(path).n
    elif how != 'none':
        for piece in read_pieces(path, samples=int(how)):
            count += piece.n
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024 * 1.048576
    print(count, peak, time.process_time() - begin)


def stamp() -> str:
    """Return what the numbers depend on."""
    names = ' '.join(f'{name} {version(name)}' for name in (
        'numpy', 'mcap', 'mcap-ros2-support', 'rosbags'))
    return (f'{date.today().isoformat()}; Python {platform.python_version()}, {names}, '
            f'{platform.machine()}.')


def main() -> int:
    """Parse arguments, measure, write."""
    if sys.argv[1:2] == ['child']:
        child(*sys.argv[2:])
        return 0
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('part', choices=('peers', 'files', 'memory'))
    parser.add_argument('--messages', type=int, default=100_000, help='of the voltage')
    parser.add_argument('--samples', type=int, default=40_000_000, help='of the long bag')
    parser.add_argument('--repeats', type=int, default=2, help='of the other libraries')
    parser.add_argument('--table', type=Path)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        text = {'peers': peers, 'files': files, 'memory': memory}[given.part](given, Path(name))
    text = f'{stamp()}\n\n{text}'
    if given.table is None:
        print(text)
        return 0
    begin, end = f'<!-- {given.part} begins -->', f'<!-- {given.part} ends -->'
    old = given.table.read_text(encoding='utf-8')
    if begin not in old or end not in old:
        raise SystemExit(f'{given.table} has no lines "{begin}" and "{end}"')
    given.table.write_text(f'{old.split(begin, 1)[0]}{begin}\n{text}\n{end}'
                           f'{old.split(end, 1)[1]}', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
