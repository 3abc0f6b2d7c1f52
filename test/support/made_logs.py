"""
Logs written byte by byte from the published formats, independently of any parser.

ULog: docs.px4.io "ULog File Format".  Dataflash: libraries/AP_Logger/LogStructure.h
of ArduPilot.  Blackbox: "Blackbox logging internals" of Betaflight.  Crazyflie:
src/deck/drivers/src/usddeck.c of crazyflie-firmware.
"""

import struct
import zlib

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.recordings.importers.choose import choose
from ou_monitor.recordings.importers.formats import import_log
from ou_monitor.recordings.importers.log import Request


def load(folder, content, name='a.log', **request):
    """Write a log, whole or in pieces; return its path, and the importer's result."""
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else b''.join(content))
    return path, import_log(path, Request(**request))


def outcomes_of_flipped_bytes(folder, whole, first, seed, tries, samples=60):
    """
    Return the numbers of logs with three flipped bytes that were refused, and read with a note.

    Each refusal is one line; samples are in order, and lost ones are mentioned in a note.
    """
    rng, refused, mended = np.random.default_rng(seed), 0, 0
    for _ in range(tries):
        broken = bytearray(whole)
        for at in rng.integers(first, len(whole), 3):
            broken[at] = rng.integers(0, 256)
        try:
            path, log = load(folder, bytes(broken))
            chosen = choose(path, log)
        except InputError as error:
            assert '\n' not in str(error)
            refused += 1
            continue
        assert (np.diff(chosen.voltage.t) > 0).all()
        if chosen.voltage.n < samples:
            assert log.notes or chosen.notes
            mended += 1
    return refused, mended


def named(log):
    """Return the series by name."""
    return {one.name: one for one in log.series}


# --- PX4 ULog -------------------------------------------------------------------------------

def ulog_message(kind, content):
    return struct.pack('<HB', len(content), ord(kind)) + content


def ulog_info(key, value):
    """Return an information message with a string."""
    text = f'char[{len(value)}] {key}'.encode()
    return ulog_message('I', struct.pack('B', len(text)) + text + value.encode())


def ulog(topics, start_us=0, info=None, extra=b''):
    """Return a ULog as a list of pieces, cut at message boundaries."""
    # `topics` is a list of (name, instance, [(type, field)], rows), the first field of each being
    # the timestamp in us; rows are sorted into one stream by it.
    codes = {'uint64_t': 'Q', 'float': 'f', 'uint8_t': 'B', 'bool': '?', 'uint32_t': 'I'}
    pieces = [b'ULog\x01\x12\x35\x01' + struct.pack('<Q', start_us),
              ulog_message('B', bytes(40))]
    pieces += [ulog_info(key, value) for key, value in (info or {}).items()]
    for name, form in {name: fields for name, _, fields, _ in topics}.items():
        text = name + ':' + ''.join(f'{kind} {field};' for kind, field in form)
        pieces.append(ulog_message('F', text.encode()))
    stream = []
    for number, (name, instance, fields, rows) in enumerate(topics):
        pieces.append(ulog_message('A', struct.pack('<BH', instance, number) + name.encode()))
        layout = '<H'
        for kind, _ in fields:
            stem, _, size = kind.partition('[')
            layout += (size.rstrip(']') if size else '') + codes[stem]
        stream += [(row[0], struct.pack(layout, number, *row)) for row in rows]
    stream.sort(key=lambda entry: entry[0])
    return pieces + [ulog_message('D', data) for _, data in stream] + ([extra] if extra else [])


BATTERY = [('uint64_t', 'timestamp'), ('float', 'voltage_v'), ('float', 'current_a'),
           ('bool', 'connected')]


def px4_flight(n=200, step_us=10_000, start_us=5_000_000):
    """Return topics of a PX4 flight, with a 5 V rail, and the voltage, throttle and current."""
    rng = np.random.default_rng(3)
    t = start_us + step_us * np.arange(n)
    volts = np.float32(16.0 + 0.1 * rng.standard_normal(n))
    amperes = np.float32(10.0 + rng.standard_normal(n))
    motor = np.float32(0.5 + 0.1 * rng.standard_normal((n, 2)))
    rail = np.float32(5.0 + 0.01 * rng.standard_normal(n))
    topics = [
        ('battery_status', 0, BATTERY,
         [(int(a), b, c, True) for a, b, c in zip(t, volts, amperes)]),
        ('system_power', 0, [('uint64_t', 'timestamp'), ('float', 'voltage5v_v')],
         [(int(a), b) for a, b in zip(t, rail)]),
        ('actuator_motors', 0, [('uint64_t', 'timestamp'), ('float[4]', 'control')],
         [(int(a) + 1000, *b, np.nan, np.nan) for a, b in zip(t, motor)]),
    ]
    return topics, t, volts, motor.astype(np.float64).mean(axis=1), amperes


# --- ArduPilot dataflash ----------------------------------------------------------------------

SIZES = {'Q': 'Q', 'B': 'B', 'b': 'b', 'H': 'H', 'h': 'h', 'I': 'I', 'f': 'f', 'n': '4s',
         'N': '16s', 'Z': '64s', 'c': 'h', 'd': 'd', 'M': 'B'}
FMT = 0x80


class Dataflash:
    """Collects the messages of a dataflash log, binary and text."""

    def __init__(self):
        """Start with the format of format messages."""
        self.pieces, self.lines, self.known = [], [], {}
        self.form(FMT, 'FMT', 'BBnNZ', 'Type,Length,Name,Format,Columns')

    def form(self, number, name, letters, columns):
        layout = '<' + ''.join(SIZES[letter] for letter in letters)
        self.known[name] = number, layout, letters
        self.put('FMT', number, 3 + struct.calcsize(layout), name, letters, columns)

    def put(self, name, *values):
        number, layout, letters = self.known[name]
        packed = [value.encode() if isinstance(value, str) else value for value in values]
        raw = [round(value * 100) if letter == 'c' else value
               for value, letter in zip(packed, letters)]
        self.pieces.append(b'\xa3\x95' + bytes([number]) + struct.pack(layout, *raw))
        shown = [value if isinstance(value, str) else repr(float(value)) if letter in 'fdc'
                 else str(value) for value, letter in zip(values, letters)]
        self.lines.append(', '.join([name, *shown]) + '\n')

    @property
    def binary(self):
        return b''.join(self.pieces)

    @property
    def text(self):
        return ''.join(self.lines).encode()


def copter(n=120, batteries=1, parameters=True, throttle_factor=1.0, start_us=3_000_000):
    """Return the log of a copter at 10 Hz, and its voltage, throttle and current."""
    rng = np.random.default_rng(4)
    log = Dataflash()
    log.form(1, 'MSG', 'QZ', 'TimeUS,Message')
    log.form(2, 'PARM', 'QNf', 'TimeUS,Name,Value')
    log.form(3, 'BAT', 'QBffffffcfB',
             'TimeUS,Inst,Volt,VoltR,Curr,CurrTot,EnrgTot,Res,Temp,X,RemPct')
    log.form(4, 'POWR', 'QffH', 'TimeUS,Vcc,VServo,Flags')
    log.form(5, 'CTUN', 'Qff', 'TimeUS,ThI,ThO')
    log.form(6, 'RCOU', 'QHHHH', 'TimeUS,C1,C2,C3,C4')
    log.put('MSG', start_us, 'ArduCopter V4.5.1 (abcd1234)')
    log.put('MSG', start_us, 'CubeOrange 00380038 3533510A 38373438')
    if parameters:
        for name, value in (('SERVO1_FUNCTION', 33), ('SERVO2_FUNCTION', 34),
                            ('SERVO3_FUNCTION', 10), ('MOT_PWM_MIN', 1100),
                            ('MOT_PWM_MAX', 1900)):
            log.put('PARM', start_us, name, float(value))
    volts = np.float32(22.0 + 0.2 * rng.standard_normal((batteries, n)))
    amperes = np.float32(20.0 + rng.standard_normal(n))
    share = np.float32(0.4 + 0.05 * rng.standard_normal(n))
    pulses = rng.integers(1200, 1800, (n, 4))
    t = start_us + 100_000 * np.arange(n)
    for k in range(n):
        for battery in range(batteries):
            log.put('BAT', int(t[k]), battery, volts[battery, k], volts[battery, k] + 0.3,
                    amperes[k], 1.0, 2.0, 0.01, 25.5, 0.0, 90)
        log.put('POWR', int(t[k]), np.float32(5.0), np.float32(5.4), 1)
        log.put('CTUN', int(t[k]) + 500, np.float32(0.3), np.float32(share[k] * throttle_factor))
        log.put('RCOU', int(t[k]) + 700, *[int(pulse) for pulse in pulses[k]])
    return log, (t - start_us) * 1e-6, volts, share, amperes, pulses


# --- Betaflight blackbox ----------------------------------------------------------------------

MAGIC = b'H Product:Blackbox flight data recorder by Nicholas Sherlock\n'
END = b'E\xffEnd of log\x00'


def unsigned_vb(value):
    """Return a number of 32 bits, seven per byte, lowest first."""
    value &= 0xffffffff
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes(out) + bytes([value])


def signed_vb(value):
    """Return a signed number, its sign in the lowest bit."""
    value = (value + 2**31) % 2**32 - 2**31
    return unsigned_vb((value << 1) ^ (value >> 31))


def blackbox(rows, fields=('loopIteration', 'time', 'rcCommand[3]', 'vbatLatest',
                           'amperageLatest', 'motor[0]', 'motor[1]'),
             headers=None, key_every=32, end=END):
    """Return one flight as pieces: the header, then one frame each; rows are whole numbers."""
    given = {'Firmware revision': 'Betaflight 4.3.0 (abc) STM32F405', 'Craft name': 'Maker',
             'minthrottle': '1070', 'maxthrottle': '2000', 'motorOutput': '100,2100',
             **(headers or {})}
    n = len(fields)
    head = MAGIC + b'H Data version:2\n' + (
        f'H I interval:{key_every}\nH P interval:1/1\n'
        f'H Field I name:{",".join(fields)}\n'
        f'H Field I signed:{",".join("0" * n)}\n'
        f'H Field I predictor:{",".join("0" * n)}\n'
        f'H Field I encoding:{",".join("1" * n)}\n'
        f'H Field P predictor:{",".join(["6", "2", *["1"] * (n - 2)])}\n'
        f'H Field P encoding:{",".join(["9", *["0"] * (n - 1)])}\n').encode()
    head += b''.join(f'H {key}:{value}\n'.encode() for key, value in given.items() if value)
    pieces = [head]
    past = []
    for k, row in enumerate(rows):
        row = [int(value) for value in row]
        if k % key_every == 0:
            frame = b'I' + b''.join(unsigned_vb(value) for value in row)
            past = [row, row]
        else:
            # Time is predicted linearly; other fields are predicted unchanged.
            line = 2 * past[0][1] - past[1][1]
            frame = b'P' + signed_vb(row[1] - line) + b''.join(
                signed_vb(value - before) for value, before in zip(row[2:], past[0][2:]))
            past = [row, past[0]]
        pieces.append(frame)
    return pieces + ([end] if end else [])


def quad(n=600, step_us=2000, start_us=17_000_000, refresh=5):
    """Return the rows of a flight whose ADC is read every `refresh` frames."""
    rng = np.random.default_rng(5)
    volts = np.repeat(1600 + np.rint(20 * rng.standard_normal(n // refresh + 1)), refresh)[:n]
    return np.column_stack([
        np.arange(n), start_us + step_us * np.arange(n), rng.integers(1000, 2000, n), volts,
        rng.integers(500, 3000, n), rng.integers(100, 2100, n),
        rng.integers(100, 2100, n)]).astype(np.int64)


# --- Crazyflie micro-SD deck -------------------------------------------------------------------

FIXED = 0xFFFF


def crazyflie(events, records, version=2):
    """Return a log as pieces: the header, one record each, the checksum."""
    # `events` is a list of (number, name, ['group.name(type)']), `records` of (number, stamp in ms
    # of version 1 and us of version 2, values).
    head = struct.pack('<BHH', 0xBC, version, len(events))
    layouts = {}
    for number, name, variables in events:
        head += struct.pack('<H', number) + name.encode() + b'\0' + struct.pack(
            '<H', len(variables)) + b''.join(one.encode() + b'\0' for one in variables)
        layouts[number] = '<H' + 'IQ'[version - 1] + ''.join(one[-2] for one in variables)
    pieces = [head, *(struct.pack(layouts[number], number, stamp, *values)
                      for number, stamp, values in records)]
    return [*pieces, struct.pack('<I', zlib.crc32(b''.join(pieces)))]


CRAZYFLIE = ['pm.vbat(f)', 'motor.m1(I)', 'motor.m2(I)', 'motor.m3(I)', 'motor.m4(I)',
             'gyro.x(f)', 'gyro.y(f)', 'gyro.z(f)', 'acc.x(f)', 'acc.y(f)', 'acc.z(f)',
             'pm.state(b)']


def hover(n=300, refresh=1):
    """Return events and records at 500 Hz, with another event, and the table that is in them."""
    rng = np.random.default_rng(11)
    volts = np.repeat(3.8 + 0.02 * rng.standard_normal(n // refresh + 1), refresh)[:n]
    table = np.column_stack([np.float32(volts), rng.integers(0, 65536, (n, 4)),
                             np.float32(rng.standard_normal((n, 6))), rng.integers(-1, 3, n)])
    records = []
    for k, row in enumerate(table):
        whole = [int(value) if 1 <= j <= 4 or j == 11 else value for j, value in enumerate(row)]
        records.append((FIXED, 1_000_000 + 2000 * k, whole))
        if k % 7 == 0:
            records.append((3, 1_000_900 + 2000 * k, (k, 0.5, 4.0)))
    events = [(FIXED, 'fixedFrequency', CRAZYFLIE),
              (3, 'estTDOA', ['id(H)', 'x(e)', 'pm.vbat(f)'])]
    return events, records, table
