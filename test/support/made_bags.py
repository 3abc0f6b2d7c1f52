"""Bags for the tests of reading: by the library with all options, and by hand from records."""

from functools import cache
import struct
import zlib

from mcap.opcode import Opcode as Op
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
import numpy as np
from ou_monitor.recordings.mcap_file import MAGIC
from ou_monitor.recordings.standard_types import (
    encode_blocks, encode_scalars, FLOAT32, FLOAT64, SCHEMAS)

START = 1_704_067_200_000_000_000
MS = 1_000_000
COUNT = 500
WAYS = {
    'zstd': {'compression': CompressionType.ZSTD},
    'lz4': {'compression': CompressionType.LZ4},
    'plain': {'compression': CompressionType.NONE},
    'unindexed': {'index_types': IndexType.NONE, 'use_statistics': False},
    'unchunked': {'use_chunking': False, 'enable_data_crcs': True},
}


def write(path, rows, **options):
    """Write (topic, type, log time in ns, bytes) in the order given, with the library."""
    with path.open('wb') as file:
        writer = Writer(file, **{'chunk_size': 4000, **options})
        writer.start(profile='ros2', library='test')
        channels = {}
        for topic, kind, t, data in rows:
            if topic not in channels:
                schema = writer.register_schema(kind, 'ros2msg', SCHEMAS[kind].encode())
                channels[topic] = writer.register_channel(topic, 'cdr', schema)
                writer.add_metadata('m', {'a': 'b'})
                writer.add_attachment(0, 0, 'note', 'text/plain', b'hello')
            writer.add_message(channels[topic], t, data, t)
        writer.finish()
    return path


def folder_of(path, *names):
    """Make a rosbag2 directory with the metadata of some files; return it."""
    path.mkdir(exist_ok=True)
    (path / 'metadata.yaml').write_text(
        'rosbag2_bagfile_information:\n  storage_identifier: mcap\n'
        f'  relative_file_paths: {list(names)}\n')
    return path


@cache
def _way(generate, kind, text):
    return generate(kind, text or SCHEMAS[kind])[kind]


def encode(kind, content, text=None):
    """Return a message of a type, given as a dict, encoded by the library."""
    return _way(serialize_dynamic, kind, text)(content)


def decode(kind, data, text=None):
    """Return a message as an object, decoded by the library."""
    return _way(generate_dynamic, kind, text)(data)


def encode_block(samples):
    return encode_blocks(np.asarray(samples, dtype=float)[None])[0]


def supply(count=COUNT):
    """Return the rows of a voltage every ms, and of a throttle 1 ns after every tenth."""
    rows = []
    values = np.random.default_rng(1).normal(5.0, 0.1, count)
    for k, data in enumerate(encode_scalars(FLOAT64, values)):
        rows.append(('/voltage', FLOAT64, START + k * MS, data))
        if k % 10 == 0:
            rows.append(('/throttle', FLOAT32, START + k * MS + 1,
                         encode_scalars(FLOAT32, [0.5])[0]))
    return rows


def records(data):
    """Return (begin, end, messages in it) of the records of `supply`, without the reader."""
    at, found, done = len(MAGIC), [], 0
    while at < len(data) - len(MAGIC):
        opcode, length = struct.unpack_from('<BQ', data, at)
        end = at + 9 + length
        inside = 0
        if opcode == Op.MESSAGE:
            inside = 1
        elif opcode == Op.CHUNK:
            # Chunks are in the order of time here, so the last log time gives the number.
            last = struct.unpack_from('<Q', data, at + 17)[0] - START
            k = last // MS
            inside = (k + 1) + (k // 10 + (last % MS == 1 or k % 10 != 0)) - done
        found.append((at, end, inside))
        done += inside
        at = end
    return found


def text(value):
    data = value.encode() if isinstance(value, str) else value
    return struct.pack('<I', len(data)) + data


def record(op, *parts, length=None):
    content = b''.join(parts)
    return struct.pack('<BQ', op, len(content) if length is None else length) + content


def schema(name=FLOAT64, definition='float64 data\n', key=1):
    return record(Op.SCHEMA, struct.pack('<H', key), text(name), text('ros2msg'),
                  text(definition))


def channel(topic='/voltage', key=1, of=1, **metadata):
    pairs = b''.join(text(k) + text(v) for k, v in metadata.items())
    return record(Op.CHANNEL, struct.pack('<HH', key, of), text(topic), text('cdr'), text(pairs))


def message(k, data, key=1):
    return record(Op.MESSAGE, struct.pack('<HIQQ', key, k, 1000 * (k + 1), 0), data)


def messages(n):
    """Return messages of 5 V, 6 V, ..."""
    return b''.join(message(k, data) for k, data in enumerate(
        encode_scalars(FLOAT64, 5.0 + np.arange(n))))


def chunk(content, *, n=100, compression='', packed=None, stated=None, crc=None):
    """Return a chunk of the first n messages; its header may lie."""
    packed = content if packed is None else packed
    return record(Op.CHUNK, struct.pack(
        '<QQQI', 1000, 1000 * n, len(content) if stated is None else stated,
        zlib.crc32(content) if crc is None else crc), text(compression),
        struct.pack('<Q', len(packed)), packed)


HEAD = MAGIC + record(Op.HEADER, text('ros2'), text(''))


def by_hand(path, *parts, summary=b''):
    """Write a file, whose summary may lie."""
    head = HEAD + b''.join(parts) + record(Op.DATA_END, bytes(4))
    start = len(head) if summary else 0
    path.write_bytes(head + summary + record(Op.FOOTER, struct.pack('<QQI', start, 0, 0)) + MAGIC)
    return path
