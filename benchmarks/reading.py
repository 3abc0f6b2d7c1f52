"""
Reading bags against rosbags, which decodes message by message; and memory (2 min).

    python benchmarks/reading.py peers --page doc/results/reading.md
    python benchmarks/reading.py memory --page doc/results/reading.md

CPU time of both readers on the same file, alternating; their arrays must be equal.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

from common import arguments, deliver, environment, ROOT, say, table
from mcap.writer import CompressionType, Writer
import numpy as np
from ou_monitor.recordings.bag import BagReader, BagWriter, read_fields
from ou_monitor.recordings.bag_samples import choose
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_blocks, encode_scalars, FLOAT32, FLOAT32_ARRAY, SCHEMAS)
from rosbags.highlevel import AnyReader
from rosbags.typesys import get_typestore, Stores

COMPRESSIONS = {'none': CompressionType.NONE, 'lz4': CompressionType.LZ4,
                'zstd': CompressionType.ZSTD}
# Repeats of our reader, which takes milliseconds; rosbags takes seconds.
REPEATS = 5
VOLTAGE, THROTTLE = '/voltage', '/throttle'
START = 1_704_067_200_000_000_000
BLOCK = 100
# Size of a chunk that rosbag2 writes.
CHUNK = 786_432


@dataclass(frozen=True)
class Case:
    """One type of message."""

    name: str
    type: str  # noqa: A003
    config: str
    value: Callable[[Any], Any]
    stamped: bool = False
    block: bool = False


CASES = (
    Case('Float32', FLOAT32, 'std_float32', lambda m: m.data),
    Case('BatteryState', BATTERY_STATE, 'battery_state', lambda m: m.voltage, stamped=True),
    Case(f'Float32MultiArray, {BLOCK} samples', FLOAT32_ARRAY, 'adc_block', lambda m: m.data,
         block=True))


def messages(case: Case, count: int) -> list[tuple[str, int, bytes]]:
    """
    Return (topic, log time in ns, message), with a throttle after every twentieth voltage.

    Messages come at 1 kHz; blocks come so that their samples are at 10 kHz.
    """
    rng = np.random.default_rng(7)
    times = START + np.arange(1, count + 1) * (10_000_000 if case.block else 1_000_000)
    values = rng.normal(5.0, 0.1, count)
    if case.block:
        voltage = encode_blocks(rng.normal(5.0, 0.1, (count, BLOCK)))
    elif case.type == BATTERY_STATE:
        voltage = encode_battery(times, values)
    else:
        voltage = encode_scalars(case.type, values)
    throttle = encode_scalars(FLOAT32, rng.random(count // 20 + 1))
    rows: list[tuple[str, int, bytes]] = []
    for k, (at, data) in enumerate(zip(times.tolist(), voltage)):
        if k % 20 == 0:
            rows.append((THROTTLE, at, throttle[k // 20]))
        rows.append((VOLTAGE, at, data))
    return rows


def write(path: Path, case: Case, rows: list[tuple[str, int, bytes]],
          compression: CompressionType) -> Path:
    """Write a bag with the Python library of MCAP."""
    with path.open('wb') as file:
        writer = Writer(file, chunk_size=CHUNK, compression=compression)
        writer.start(profile='ros2', library='benchmark')
        channels = {}
        for topic, kind in ((VOLTAGE, case.type), (THROTTLE, FLOAT32)):
            schema = writer.register_schema(kind, 'ros2msg', SCHEMAS[kind].encode())
            channels[topic] = writer.register_channel(topic, 'cdr', schema)
        for topic, at, data in rows:
            writer.add_message(channels[topic], at, data, at)
        writer.finish()
    return path


# Topic -> log times or stamps (s), values.
Columns = dict[str, tuple[np.ndarray, np.ndarray]]


def collect(case: Case, messages: Any) -> Columns:
    """Return columns from (topic, log time in ns, message) one by one."""
    voltage: tuple[list[float], list[Any]] = ([], [])
    throttle: tuple[list[float], list[Any]] = ([], [])
    value = case.value
    for topic, at, message in messages:
        if topic == THROTTLE:
            throttle[0].append(at * 1e-9)
            throttle[1].append(message.data)
        elif case.stamped:
            stamp = message.header.stamp
            voltage[0].append(stamp.sec + 1e-9 * stamp.nanosec)
            voltage[1].append(value(message))
        else:
            voltage[0].append(at * 1e-9)
            voltage[1].append(value(message))
    join: Callable[[list[Any]], np.ndarray] = np.concatenate if case.block else np.array
    return {VOLTAGE: (np.array(voltage[0]), join(voltage[1]).astype(float)),
            THROTTLE: (np.array(throttle[0]), np.array(throttle[1], dtype=float))}


def rosbags(path: Path, case: Case) -> Columns:
    """Read with rosbags: `AnyReader`, one object per message."""
    with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        wanted = [c for c in reader.connections if c.topic in (VOLTAGE, THROTTLE)]
        return collect(case, ((c.topic, t, reader.deserialize(data, c.msgtype))
                              for c, t, data in reader.messages(connections=wanted)))


def ours(path: Path, case: Case) -> Columns:
    """Read with this package, into the same arrays as rosbags."""
    bag = BagReader(path)
    _, specs, _ = choose(path, bag.topics, msg_config=case.config)
    columns = read_fields(bag, {VOLTAGE: specs['voltage'], THROTTLE: specs['throttle']})
    return {topic: (column.stamp, column.values) for topic, column in columns.items()}


def timed(call: Callable[[], Any], repeats: int) -> tuple[float, Any]:
    """Return the least CPU time of some calls, s, and the result of the last one."""
    best, result = np.inf, None
    for _ in range(repeats):
        begin = time.process_time()
        result = call()
        best = min(best, time.process_time() - begin)
    return best, result


def peers(given: argparse.Namespace, folder: Path) -> str:
    """Compare with rosbags: types of messages and compressions."""
    rows = []
    for case in CASES:
        content = messages(case, given.messages)
        for name, compression in COMPRESSIONS.items():
            say(f'{case.name}, {name}')
            path = write(folder / 'bag.mcap', case, content, compression)
            mine, found = timed(lambda: ours(path, case), REPEATS)
            other, theirs = timed(lambda: rosbags(path, case), given.repeats)
            for topic in (VOLTAGE, THROTTLE):
                np.testing.assert_array_equal(found[topic][1], theirs[topic][1])
                # Float64 seconds since 1970 resolve 0.24 us.
                np.testing.assert_allclose(found[topic][0], theirs[topic][0], rtol=0, atol=1e-6)
            rows.append([case.name, name, f'{1e6 * mine / given.messages:.2f}',
                         f'{1e6 * other / given.messages:.1f}', f'**{other / mine:.0f}**'])
    return table(['type of the voltage', 'compression', 'this package', 'rosbags', 'times'], rows)


# Program that reads a bag, or only imports the libraries, and prints the number of samples, peak
# resident memory (MB) and CPU time (s).
CHILD = """
import re, sys, time
from ou_monitor.recordings.read import read_recording
begin = time.process_time()
count = read_recording(sys.argv[1]).n if sys.argv[2] == 'whole' else 0
# getrusage would include the parent's peak, if that is larger.
peak = int(re.search(r'VmHWM:\\s*(\\d+) kB', open('/proc/self/status').read())[1])
print(count, peak * 1.024e-3, time.process_time() - begin)
"""


def write_long(path: Path, seconds: int) -> None:
    """Write a battery at 1 kHz with a throttle at 50 Hz."""
    rng = np.random.default_rng(1)
    with BagWriter(path) as bag:
        bag.add_topic('voltage', BATTERY_STATE)
        bag.add_topic('throttle', FLOAT32)
        for second in range(seconds):
            stamps = (1000 * second + np.arange(1, 1001)) * 1_000_000
            throttle = encode_scalars(FLOAT32, rng.random(50))
            for k, (at, message) in enumerate(zip(
                    stamps.tolist(), encode_battery(stamps, rng.normal(14.0, 0.1, 1000)))):
                if k % 20 == 0:
                    bag.write('throttle', at, throttle[k // 20])
                bag.write('voltage', at, message)


def memory(given: argparse.Namespace, folder: Path) -> str:
    """Peak memory and CPU time of a process that reads an hour at 1 kHz."""
    path = folder / 'hour.mcap'
    write_long(path, given.seconds)
    rows = []
    for words, how in (('nothing read (Python, NumPy, mcap)', 'none'), ('whole', 'whole')):
        say(words)
        found = []
        for _ in range(REPEATS):
            done = subprocess.run([sys.executable, '-c', CHILD, str(path), how], check=True,
                                  capture_output=True, text=True, cwd=ROOT)
            found.append([float(word) for word in done.stdout.split()])
            assert how == 'none' or found[-1][0] == 1000 * given.seconds
        _, peak, seconds = np.min(found, axis=0)
        rows.append([words, f'{peak:.0f}', f'{seconds:.2f}' if how == 'whole' else '-'])
    return (f'{given.seconds} s of BatteryState at 1 kHz and a throttle at 50 Hz, '
            f'{path.stat().st_size / 1e6:.0f} MB on disk, {24e-3 * given.seconds:.0f} MB as '
            f'arrays (stamp, voltage, throttle); least of {REPEATS} runs.\n\n'
            + table(['reading', 'peak resident memory, MB', 'CPU, s'], rows))


def main() -> int:
    """Parse arguments, measure, write."""
    parser = arguments(__doc__)
    parser.add_argument('part', choices=('peers', 'memory'))
    parser.add_argument('--messages', type=int, default=100_000, help='of the voltage')
    parser.add_argument('--seconds', type=int, default=3600, help='of the long bag')
    parser.add_argument('--repeats', type=int, default=2, help='of rosbags')
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        text = {'peers': peers, 'memory': memory}[given.part](given, Path(name))
    deliver(f'{environment("mcap", "rosbags")}.\n\n{text}', given.page, given.part)
    return 0


if __name__ == '__main__':
    sys.exit(main())
