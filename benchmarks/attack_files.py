"""
Damage bags and CSVs at random: the reader must return true values or report damage (3 min).

In a bag each voltage is a function of its stamp, so wrong values are recognized; in a CSV each
value must come from the line of its stamp.  A mutated file may be refused with one line, or read
with notes that count dropped samples, or read completely; anything else is a fault, whose seed is
printed.  The exit status is 1 if there were faults.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator
import math
from pathlib import Path
import re
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
from typing import Any
import warnings
import zlib

import common  # noqa: F401
import lz4.frame
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType, Writer
import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.mcap_file import MAGIC
from ou_monitor.recordings.read import read_recording
from ou_monitor.recordings.standard_types import (
    BATTERY_STATE, encode_battery, encode_scalars, FLOAT32, FLOAT64, SCHEMAS)
from ou_monitor.records import Recording
import zstandard

START = 1_704_067_200_000_000_000
MS = 1_000_000
COUNT = 400
# Timeout of one reading, s, with a margin for a busy machine.
PATIENCE = 60
LIES = (0, 1, 2, 7, 8, 0x7f, 0xff, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63,
        2**64 - 1)
WAYS: dict[str, dict[str, Any]] = {
    'zstd': {}, 'lz4': {'compression': CompressionType.LZ4},
    'plain': {'compression': CompressionType.NONE},
    'no message index': {'index_types': IndexType.CHUNK},
    'no summary': {'index_types': IndexType.NONE, 'use_statistics': False,
                   'use_summary_offsets': False, 'repeat_channels': False,
                   'repeat_schemas': False},
    'no chunks': {'use_chunking': False, 'enable_data_crcs': True},
}


def volts(k: Any) -> Any:
    """Return the voltage of the k-th sample, exact in float32."""
    return 12.0 + (np.asarray(k) * 37 % 1024) / 256


def written(path: Path, stamped: bool, **options: Any) -> bytes:
    """Return an undamaged file."""
    k = np.arange(COUNT)
    kind = BATTERY_STATE if stamped else FLOAT64
    data = (encode_battery(START + k * MS, volts(k)) if stamped
            else encode_scalars(FLOAT64, volts(k)))
    with path.open('wb') as file:
        writer = Writer(file, **{'chunk_size': 4000, **options})
        writer.start(profile='ros2', library='attack')
        channels = [writer.register_channel(topic, 'cdr', writer.register_schema(
            of, 'ros2msg', SCHEMAS[of].encode())) for topic, of in (
                ('/voltage', kind), ('/throttle', FLOAT32))]
        writer.add_attachment(0, 0, 'note', 'text/plain', b'hello')
        writer.add_metadata('ou_monitor', {'vehicle': 'one'})
        for i, message in enumerate(data):
            at = START + i * MS
            writer.add_message(channels[0], at, message, at)
            if i % 10 == 0:
                writer.add_message(channels[1], at, encode_scalars(FLOAT32, [0.5])[0], at)
        writer.finish()
    return path.read_bytes()


def records(data: bytes) -> list[tuple[int, int]]:
    """Return begin and end of every record."""
    found, at = [], len(MAGIC)
    while at + 9 <= len(data) - len(MAGIC):
        end = at + 9 + int.from_bytes(data[at + 1:at + 9], 'little')
        found.append((at, end))
        at = end
    return found


# Damage that needs no knowledge of the format.
BYTES = ('bits', 'bytes', 'zeros', 'cut', 'hole')


def damage(data: bytearray, kind: str, at: int, most: int, rng: np.random.Generator) -> None:
    """Damage at most `most` bytes from `at` on."""
    size = int(rng.integers(1, most))
    if kind == 'bits':
        for place in rng.integers(len(data), size=int(rng.integers(1, 9))).tolist():
            data[place] ^= 1 << int(rng.integers(8))
    elif kind == 'cut':
        del data[at:]
    else:
        there = len(data[at:at + size])
        data[at:at + size] = {'bytes': rng.bytes(there), 'zeros': bytes(there), 'hole': b''}[kind]


def mutated(sound: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Return the kind of an attack, and a file after it."""
    data = bytearray(sound)
    parts = records(sound)
    # Without statistics, a missing chunk cannot be detected: leave the chunks alone.
    if not any(sound[begin] == Opcode.STATISTICS for begin, _ in parts):
        parts = [part for part in parts if sound[part[0]] != Opcode.CHUNK]
    kind = str(rng.choice([*BYTES, 'more', 'swap', 'twice', 'lost', 'length', 'word', 'kind',
                           'tail']))
    at = int(rng.integers(len(MAGIC), len(data)))
    one, other = (parts[int(k)] for k in rng.integers(len(parts), size=2))
    if kind in BYTES:
        damage(data, kind, at, 3000, rng)
    elif kind == 'more':
        data[at:at] = rng.bytes(int(rng.integers(1, 300)))
    elif kind == 'swap':
        first, last = sorted((one, other))
        if first != last:
            data[:] = (data[:first[0]] + data[slice(*last)] + data[first[1]:last[0]]
                       + data[slice(*first)] + data[last[1]:])
    elif kind == 'twice':
        data[other[0]:other[0]] = data[slice(*one)]
    elif kind == 'lost':
        del data[slice(*one)]
    elif kind == 'length':
        data[one[0] + 1:one[0] + 9] = struct.pack('<Q', int(rng.choice(np.array(LIES, object))))
    elif kind == 'word':
        # Within a record: a count, the length of a string, or a size.
        place = int(rng.integers(one[0] + 9, max(one[1], one[0] + 10)))
        data[place:place + 4] = struct.pack('<I', int(rng.choice(LIES[:11])))
    elif kind == 'kind':
        data[one[0]] = int(rng.choice([*range(16), 0x80, 0xff]))
    else:
        data += data[at:]
    return kind, bytes(data)


def text(value: str | bytes) -> bytes:
    """Return a string as stored in a record."""
    data = value.encode() if isinstance(value, str) else value
    return struct.pack('<I', len(data)) + data


def record(op: int, *parts: bytes, length: int | None = None) -> bytes:
    """Return a record; `length`: a false one to be stated."""
    content = b''.join(parts)
    return struct.pack('<BQ', op, len(content) if length is None else length) + content


class Crafted:
    """A crafted file of correct chunks and of parts with false contents."""

    def __init__(self, rng: np.random.Generator) -> None:
        """Start a file; `rng` decides which parts are false."""
        self.rng, self.count = rng, 0

    def lies(self, chance: float = 0.12) -> bool:
        """Return whether the next part is false."""
        return bool(self.rng.random() < chance)

    def lie(self) -> int:
        """Return a number that is almost certainly wrong."""
        return int(self.rng.choice(np.array(LIES, object)))

    def definitions(self) -> bytes:
        """Return a schema and a channel, and some that are unused or contradict them."""
        name, definition = FLOAT64, 'float64 data\n'
        out = record(Opcode.SCHEMA, struct.pack('<H', 1), text(name), text('ros2msg'),
                     text(definition))
        out += record(Opcode.CHANNEL, struct.pack('<HH', 1, 1), text('/voltage'), text('cdr'),
                      text(b''))
        if self.lies():  # endless text
            out += record(Opcode.SCHEMA, struct.pack('<HI', 2, 2**32 - 1), b'x' * 50)
        if self.lies():  # second definition
            out += record(Opcode.SCHEMA, struct.pack('<H', 1), text(name), text('ros2msg'),
                          text('float32 data\nfloat32 more\n'))
        if self.lies():  # long names
            out += b''.join(record(Opcode.CHANNEL, struct.pack('<HH', k + 2, 1), text(
                f'/x{k}' * 200), text('cdr'), text(b'')) for k in range(300))
        if self.lies():  # json
            out += record(Opcode.CHANNEL, struct.pack('<HH', 999, 0), text('/j'), text('json'),
                          text(b''))
        return out

    def messages(self, n: int) -> bytes:
        """Return messages of the voltage."""
        out = b''
        for data in encode_scalars(FLOAT64, volts(np.arange(self.count, self.count + n))):
            at = START + self.count * MS
            out += record(Opcode.MESSAGE, struct.pack('<HIQQ', 1, self.count, at, at), data)
            self.count += 1
        if self.lies(0.03):
            out += record(Opcode.MESSAGE, bytes(int(self.rng.integers(22))))
        if self.lies(0.05):
            out += record(Opcode.MESSAGE, struct.pack('<HIQQ', 77, 0, START, START), bytes(12))
        if self.lies(0.03):
            out += record(Opcode.MESSAGE, bytes(30), length=self.lie())
        return out

    def chunk(self, content: bytes, first: int) -> bytes:
        """Return a chunk, whose header may be false."""
        way = str(self.rng.choice(['', 'zstd', 'lz4']))
        packed, size, crc = content, len(content), zlib.crc32(content)
        if self.lies(0.05):
            content = bytes(int(self.rng.choice([10**6, 2 * 10**8])))
        if way == 'zstd':
            one = zstandard.ZstdCompressor(
                level=1, write_content_size=bool(self.rng.integers(2))).compressobj()
            packed = one.compress(content) + one.flush()
        elif way == 'lz4':
            packed = lz4.frame.compress(content)
        else:
            packed = content[:10**6]
        if self.lies(0.05):
            size = self.lie()
        if self.lies(0.05):
            crc = 12345
        if self.lies(0.03):
            way = str(self.rng.choice(['lz4', 'zstd', '', 'gzip', 'x' * 5000]))
        length = self.lie() if self.lies(0.03) else len(packed)
        return record(Opcode.CHUNK, struct.pack(
            '<QQQI', START + first * MS, START + max(first, self.count - 1) * MS, size, crc),
            text(way), struct.pack('<Q', length), packed)

    def file(self) -> bytes:
        """Return the whole file."""
        data = MAGIC + record(Opcode.HEADER, text('ros2'), text(''))
        indexes = b''
        chunks = int(self.rng.integers(1, 6))
        for k in range(chunks):
            first = self.count
            # Messages may also be outside of chunks.
            if self.rng.random() < 0.1 and k:
                data += self.messages(int(self.rng.integers(1, 50)))
                continue
            content = self.definitions() if k == 0 else b''
            content += self.messages(int(self.rng.integers(1, 100)))
            one = self.chunk(content, first)
            numbers = [START + first * MS, START + (self.count - 1) * MS, len(data), len(one)]
            size = len(content)
            if self.lies(0.1):
                numbers[int(self.rng.integers(4))] = self.lie()
            if self.lies(0.05):
                size = self.lie()
            entry = record(
                Opcode.CHUNK_INDEX, struct.pack('<QQQQ', *numbers),
                text(struct.pack('<HQ', 1, len(data) + len(one))), struct.pack('<Q', 0),
                text(''), struct.pack('<QQ', size, size))
            data += one
            indexes += entry * (0 if self.lies(0.05) else
                                int(self.rng.integers(2, 40)) if self.lies(0.05)
                                else 1)
            if self.lies(0.05):
                data += record(0x90, bytes(30))
            if self.lies(0.03):
                data += self.rng.bytes(40)
        data += record(Opcode.DATA_END, bytes(4))
        start = len(data)
        if self.rng.random() < 0.3:
            start = 0
        else:
            counted = self.count + (self.lies() and int(self.rng.integers(-5, 6)))
            data += self.definitions() + indexes + record(
                Opcode.STATISTICS, struct.pack(
                    '<QHIIIIQQ', max(counted, 0), 1, 1, 0, 0, chunks, START,
                    START + self.count * MS), text(struct.pack('<HQ', 1, max(counted, 0))))
        return data + record(Opcode.FOOTER, struct.pack('<QQI', start, 0, 0)) + MAGIC


# Replacements for the number in a cell of a CSV.
CELLS = ('', ' ', 'nan', 'NaN', 'null', 'inf', '-inf', '1e308', '-1e308', '1e400', '1e-320',
         '5,01', '0x10', '1_000', '\u0661\u0662', '--5', '+5', ' 5 ', '5V', '9' * 400, '1e5',
         '"5"', '"5', '\0', '\x1b[31m5', '\u2028', '#5', '1;2', '5\t', '=1+1')
# A number of a CSV must match this; `float` accepts more.
_NUMBER = re.compile(r'[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?', re.ASCII)


def sheet() -> bytes:
    """Return a correct CSV; a blank throttle repeats the last one, and `note` is not read."""
    lines = ['time_s,voltage_v,throttle,current_a,note']
    lines += [f'{k / 1000},{float(volts(k))},{k % 90 / 100 if k % 7 else ""},{k % 31 / 8},n{k}'
              for k in range(COUNT)]
    return ('\n'.join(lines) + '\n').encode()


def mutated_sheet(sound: bytes, rng: np.random.Generator) -> tuple[str, bytes]:
    """Return the kind of an attack, and a CSV after it."""
    kind = str(rng.choice([*BYTES, 'swap', 'twice', 'less', 'more', 'cell', 'quote', 'endless',
                           'ends', 'marks', 'text', 'header', 'short']))
    data = bytearray(sound)
    lines = sound.decode().splitlines()
    at = int(rng.integers(len(data)))
    one, other = (int(k) for k in rng.integers(1, len(lines), size=2))
    cells = lines[one].split(',')
    which = int(rng.integers(len(cells)))
    if kind in BYTES:
        damage(data, kind, at, 300, rng)
        return kind, bytes(data)
    end = '\n'
    if kind == 'swap':
        lines[one], lines[other] = lines[other], lines[one]
    elif kind == 'twice':
        lines[other:other] = lines[one:one + int(rng.integers(1, 50))]
    elif kind == 'less':
        lines[one] = ','.join(cells[:which] + cells[which + 1:])
    elif kind == 'more':
        lines[one] = ','.join(cells[:which] + [str(rng.choice(CELLS))] + cells[which:])
    elif kind == 'cell':
        cells[which] = str(rng.choice(CELLS))
        lines[one] = ','.join(cells)
    elif kind == 'quote':
        for line in {one, other} if rng.random() < 0.5 else {one}:
            cells = lines[line].split(',')
            cells[which] = '"' + cells[which]
            lines[line] = ','.join(cells)
    elif kind == 'endless':
        lines[one] += str(rng.choice(['x', '0', ',', '"', ' '])) * int(
            rng.choice([1000, 100_000, 3_000_000]))
    elif kind == 'ends':
        end = str(rng.choice(['\r', '\r\n', '\n\n', '\r\r\n', '\n\r', '\x0b', '\u2028']))
        if rng.random() < 0.5:
            lines[one] += end
            end = '\n'
    elif kind == 'marks':
        old, new = str(rng.choice(['.,', ',;', ',\t', ', ', ',|', '.;']))
        lines[:] = [line.replace(old, new) for line in lines[:one]] + lines[one:]
    elif kind == 'header':
        names = lines[0].split(',')
        change = int(rng.integers(5))
        if change < 3:
            names[which] = [str(rng.choice(names)), '"' + names[which],
                            str(rng.choice(CELLS))][change]
        elif change == 3:
            rng.shuffle(names)
        lines[0] = ','.join(names)
        if change == 4:
            lines.insert(one, lines[0])
    elif kind == 'short':
        lines = [[], ['#'], [''], lines[:1], lines[:2], lines[1:], lines[:1] * 3, ['"'], ['\0']][
            int(rng.integers(9))]
    text = end.join([*lines, ''])
    if kind == 'text':
        return kind, text.encode(str(rng.choice(
            ['utf-8-sig', 'utf-16', 'utf-16-le', 'utf-32', 'cp037'])))
    return kind, text.encode()


def numbers(line: str) -> list[float]:
    """Return the numbers in a line of a CSV."""
    cells = (cell.strip(' "').removesuffix('V') for cell in re.split('[,;\t]', line))
    return [float(cell) for cell in cells if _NUMBER.fullmatch(cell)]


def verdict_of_sheet(data: bytes, found: Recording) -> str:
    """Return the verdict on a CSV that was read."""
    wide = 'utf-16' if data[:2] in (b'\xff\xfe', b'\xfe\xff') else 'utf-16-le'
    code = wide if wide == 'utf-16' or data[1:2] == b'\0' else 'utf-8-sig'
    lines = [line for line in re.split('\r\n|\n|\r', data.decode(code, 'replace'))
             if line.strip() and not line.lstrip().startswith('#')]
    while lines[1:] and lines[0] == lines[1] and not numbers(lines[0]):
        lines = lines[1:]  # The header occurs twice.
    lines = lines[not any("'column 1'" in note for note in found.notes):]
    stand: dict[float, list[list[float]]] = {}
    everything = {math.nan}
    for line in lines:
        values = numbers(line)
        everything.update(values)
        for value in values:
            stand.setdefault(value, []).append(values)
    current = np.full(found.n, np.nan) if found.current is None else found.current
    for t, v, u, i in zip(found.t.tolist(), found.voltage.tolist(), found.throttle.tolist(),
                          current.tolist()):
        if not any(v in line and (math.isnan(i) or i in line) for line in stand.get(t, ())):
            return '! wrong value'
        if not (math.isnan(u) or u in everything
                or re.search(r"throttle from '[^']*' \([^)]*a guess", ' '.join(found.notes))):
            return '! wrong throttle, and no note of a guessed unit'
    said = [re.match(r'(\d+) (?:samples? dropped|rows? left out)', note) for note in found.notes]
    dropped = found.held + sum(int(one[1]) for one in said if one)
    if found.n + dropped != len(lines):
        return '! silent loss'
    return 'read, reported as damaged' if found.notes else 'read whole'


def verdict(path: Path, count: int, partial: bool) -> str:
    """Read a file; return the verdict, which starts with '!' for a fault."""
    def hang(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGALRM, hang)
    signal.alarm(PATIENCE)
    try:
        found = read_recording(path, partial=partial)
    except InputError as error:
        return 'refused' if str(error).isprintable() else '! a refusal with control characters'
    except TimeoutError:
        return '! hang'
    except Exception:
        traceback.print_exc()
        return '! traceback'
    finally:
        signal.alarm(0)
    if path.suffix == '.csv':
        return verdict_of_sheet(path.read_bytes(), found)
    told = any(word in note for note in found.notes for word in ('damaged', 'left out', 'dropped'))
    k = np.rint((found.t - START * 1e-9) * 1e3)
    if not np.array_equal(found.voltage, volts(k)):
        return 'wrong, and reported as damaged' if told else '! wrong value'
    if found.n != count and not told:
        return '! silent loss'
    return 'read, reported as damaged' if told else 'read whole'


def attacks(given: argparse.Namespace, path: Path) -> Iterator[tuple[str, int, bytes, int]]:
    """Yield the kind of each attack, its seed, the file and the samples in it."""
    sound = [written(path, stamped, **options) for options in WAYS.values()
             for stamped in (True, False)]
    for seed in range(given.seed, given.seed + given.mutated):
        rng = np.random.default_rng(seed)
        kind, data = mutated(sound[int(rng.integers(len(sound)))], rng)
        yield kind, seed, data, COUNT
    for seed in range(given.seed, given.seed + given.crafted):
        crafted = Crafted(np.random.default_rng([seed, 1]))
        data = crafted.file()
        yield 'crafted', seed, data, crafted.count
    plain = sheet()
    for seed in range(given.seed, given.seed + given.sheets):
        kind, data = mutated_sheet(plain, np.random.default_rng([seed, 2]))
        yield f'csv {kind}', seed, data, COUNT


def main() -> int:
    """Attack, and count."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--mutated', type=int, default=2200, help='damaged bags')
    parser.add_argument('--crafted', type=int, default=560, help='bags made by hand')
    parser.add_argument('--sheets', type=int, default=1250, help='damaged CSVs')
    parser.add_argument('--seed', type=int, default=1)
    given = parser.parse_args()
    tally: Counter[tuple[str, str]] = Counter()
    faults, slowest = 0, 0.0
    with tempfile.TemporaryDirectory() as name:
        bag, table = Path(name) / 'attack.mcap', Path(name) / 'attack.csv'
        # NumPy's warnings count as faults: they come from numbers that were not considered.
        warnings.simplefilter('error')
        for kind, seed, data, count in attacks(given, bag):
            path = table if kind.startswith('csv') else bag
            path.write_bytes(data)
            for partial in (False, True) if path == bag else (False,):
                began = time.process_time()
                said = verdict(path, count, partial)
                slowest = max(slowest, time.process_time() - began)
                tally[kind, said] += 1
                if said.startswith('!'):
                    faults += 1
                    print(f'{said}: {kind}, seed {seed}, partial {partial}', file=sys.stderr)
    for (kind, said), n in sorted(tally.items()):
        print(f'{kind:12} {said:32} {n}')
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
    print(f'{faults} faults in {sum(tally.values())} readings; slowest {slowest:.2f} s of CPU; '
          f'peak {peak:.0f} MB resident')
    return 1 if faults else 0


if __name__ == '__main__':
    sys.exit(main())
