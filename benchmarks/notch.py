r"""
Notches that follow the motors, against low-passes of the same lag, on recorded gyros (2 min).

    OU_MONITOR_REALDATA=FOLDER python benchmarks/notch.py --page doc/results/notch.md

A D term is the difference quotient of the gyro through the filters.  Its noise is the rms of its
part above 60 Hz (zero-phase Butterworth of order 4); its lag is the phase delay at 10 Hz of all
filters; both over the scored part.  Each notch is followed by a low-pass whose cutoff is raised
until both together have the lag of a Butterworth low-pass of order 2 alone; the noise is divided
by the noise of the best fixed low-pass of that lag.  Low-passes are Butterworth or one to three
equal poles, whichever is best on the scored part, with and without notch.

The first half of a flight is for learning; the second is scored.  `from nothing`: the whole flight
is scored, without learning before.

Betaflight's RPM filter: three harmonics of each motor up to 0.48 of the rate, Q 5, faded in over
100..150 Hz, motor speeds through a low-pass of 150 Hz (src/main/flight/rpm_filter.c and
pg/rpm_filter.c, 4.5).
ArduPilot: harmonic notch, throttle-based, 1st and 2nd harmonic, 40 dB, bandwidth half of the
frequency at hover, f = FREQ max(FM_RAT, sqrt(throttle / REF)) with FM_RAT 0.7, FREQ the highest
peak above 60 Hz of the first half within 0.05 of its median throttle, REF that throttle
(libraries/Filter/HarmonicNotchFilter.cpp; wiki, "Throttle Based Dynamic Notch Setup").
"""

from __future__ import annotations

from collections.abc import Iterator
import math
import sys

from common import arguments, deliver, say, table
import gyros
import numpy as np
from ou_monitor import AdaptiveNotch
from ou_monitor.online.notch import Notch, phase_lag
from scipy import optimize, signal

LAG_AT, NOISE_FROM = 10.0, 60.0
CUTOFFS = (40.0, 60.0, 80.0, 120.0)
# Highest cutoff over the sample rate; above it there is no low-pass.
OF_RATE = 0.25
KINDS = ('butter', '1', '2', '3')
_BLOCK = 0.05


def response(b: np.ndarray, a: np.ndarray, rate: float) -> float:
    """Return the phase delay at `LAG_AT`, s."""
    _, h = signal.freqz(b, a, [LAG_AT], fs=rate)
    return float(-np.angle(h[0]) / (2.0 * math.pi * LAG_AT))


def low_pass(kind: str, cutoff: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a low-pass: 'butter', or '1', '2' or '3' equal poles."""
    if kind == 'butter':
        return signal.butter(2, cutoff, fs=rate)
    b, a = signal.butter(1, cutoff, fs=rate)
    powers = int(kind)
    found = np.array([1.0]), np.array([1.0])
    for _ in range(powers):
        found = np.polymul(found[0], b), np.polymul(found[1], a)
    return found


def of_lag(kind: str, delay: float, rate: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the low-pass with a delay, s; None if no cutoff gives it."""
    def off(cutoff: float) -> float:
        return response(*low_pass(kind, cutoff, rate), rate) - delay
    if off(0.49 * rate) > 0.0 or off(1.0) < 0.0:
        return None
    return low_pass(kind, optimize.brentq(off, 1.0, 0.49 * rate), rate)


def noise(x: np.ndarray, filters: list[tuple[np.ndarray, np.ndarray]], rate: float,
          part: np.ndarray) -> np.ndarray:
    """Return the mean square noise of the D term of each axis over a part."""
    d = np.diff(x, axis=0, prepend=x[:1]) * rate
    for b, a in filters:
        d = signal.lfilter(b, a, d, axis=0)
    sos = signal.butter(4, NOISE_FROM, 'highpass', fs=rate, output='sos')
    return np.mean(signal.sosfiltfilt(sos, d, axis=0)[part]**2, axis=0)


# -- methods: a gyro -> its filtered axes, and the lag of each sample and axis, s


def ours(gyro: gyros.Gyro, rpm: bool) -> tuple[np.ndarray, np.ndarray]:
    """Filter with `AdaptiveNotch` and its defaults, from nothing."""
    notch = AdaptiveNotch()
    out, lag = np.empty_like(gyro.signal), np.zeros_like(gyro.signal)
    block = max(int(_BLOCK * gyro.rate), 1)
    for k in range(0, gyro.t.size, block):
        at = slice(k, k + block)
        out[at] = notch.filter(gyro.t[at], gyro.signal[at], gyro.throttle[at],
                               gyro.rpm[at] if rpm and gyro.rpm is not None else None)
        lag[at] = notch.delays(LAG_AT)
    return out, lag


def notches(gyro: gyros.Gyro, f: np.ndarray, width: float, share: np.ndarray,
            floor: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return notches in series (f and share of shape (n, notches)); `floor`: the gain at f."""
    out, lag = gyro.signal.copy(), np.zeros_like(gyro.signal)
    ratios = np.clip(f / gyro.rate, 1e-6, 0.48)
    for j in range(f.shape[1]):
        g = np.tan(np.pi * ratios[:, j])
        part = share[:, j] * (1.0 - floor)
        for axis in range(3):
            s1, s2 = 0.0, float(out[0, axis])
            values = out[:, axis].tolist()
            for k, (x, gk, m) in enumerate(zip(values, g.tolist(), part.tolist())):
                v1 = (gk * (x - s2) + s1) / (1.0 + gk * (gk + width))
                v2 = s2 + gk * v1
                s1, s2 = 2.0 * v1 - s1, 2.0 * v2 - s2
                values[k] = x - m * width * v1
            out[:, axis] = values
        one = Notch(0.0)
        one.width = width
        lags = np.empty(-(-gyro.t.size // 20))
        for i, k in enumerate(range(0, gyro.t.size, 20)):
            one.ratio, one.depth = float(ratios[k, j]), float(part[k])
            lags[i] = phase_lag([one], LAG_AT / gyro.rate) / (2.0 * math.pi * LAG_AT)
        lag += np.repeat(lags, 20)[:gyro.t.size, None]
    return out, lag


def rpm_filter(gyro: gyros.Gyro) -> tuple[np.ndarray, np.ndarray]:
    """Filter as Betaflight's RPM filter."""
    assert gyro.rpm is not None
    b, a = low_pass('1', 150.0, gyro.rate)
    motors = signal.lfilter(b, a, gyro.rpm / 60.0, axis=0)
    f = np.concatenate([k * motors for k in (1, 2, 3)], axis=1)
    share = np.clip((f - 100.0) / 50.0, 0.0, 1.0) * (f < 0.48 * gyro.rate)
    # Notches above the limit are left out; Betaflight, at 3.2 kHz or more, holds them at it.
    keep = share.max(axis=0) > 0.0
    return notches(gyro, np.maximum(f, 100.0)[:, keep], 0.2, share[:, keep])


def harmonic_notch(gyro: gyros.Gyro) -> tuple[np.ndarray, np.ndarray]:
    """Filter as ArduPilot's throttle-based harmonic notch, set up from the first half."""
    first = gyro.t < 0.5 * gyro.t[-1]
    flown = first & (gyro.throttle > 0.1)
    hover = float(np.median(gyro.throttle[flown]))
    near = flown & (np.abs(gyro.throttle - hover) < 0.05)
    size = int(0.5 * gyro.rate)
    powers = [np.abs(np.fft.rfft(gyro.signal[k:k + size] * np.hanning(size)[:, None],
                                 axis=0))**2
              for k in range(0, int(first.sum()) - size, size // 2) if near[k:k + size].all()]
    frequencies = np.fft.rfftfreq(size, 1.0 / gyro.rate)
    mean = np.where(frequencies > NOISE_FROM, np.mean(powers, axis=0).sum(axis=1), 0.0)
    at = float(frequencies[np.argmax(mean)])
    f = at * np.maximum(np.sqrt(np.maximum(gyro.throttle, 0.0) / hover), 0.7)
    both = np.column_stack((f, 2.0 * f))
    return notches(gyro, both, 0.5, 1.0 * (both < 0.48 * gyro.rate), 10.0**(-40.0 / 20.0))


def measure(gyro: gyros.Gyro, cutoffs: tuple[float, ...]) -> Iterator[list[str]]:
    """Yield a row per cutoff: noise relative to the best fixed low-pass with the same lag."""
    second = gyro.t > 0.5 * gyro.t[-1]
    whole = gyro.t >= 0.0
    methods: list[tuple[np.ndarray, np.ndarray, np.ndarray] | None] = [
        (*harmonic_notch(gyro), second)]
    from_throttle = ours(gyro, False)
    methods += [(*from_throttle, second), (*from_throttle, whole)]
    if gyro.rpm is None:
        methods += [None, None, None]
    else:
        from_rpm = ours(gyro, True)
        methods += [(*rpm_filter(gyro), second), (*from_rpm, second), (*from_rpm, whole)]
    for cutoff in cutoffs:
        if cutoff > OF_RATE * gyro.rate:
            continue
        delay = response(*low_pass('butter', cutoff, gyro.rate), gyro.rate)
        best = {}
        for name, part in (('second', second), ('whole', whole)):
            fixed = [noise(gyro.signal, [one], gyro.rate, part)
                     for kind in KINDS
                     if (one := of_lag(kind, delay, gyro.rate)) is not None]
            best[name] = min(fixed, key=np.sum)
        cells = []
        for method in methods:
            if method is None:
                cells.append('-')
                continue
            out, lag, part = method
            cells.append(_cell(_behind(gyro, out, delay - lag[part].mean(axis=0), part),
                               best['whole' if part is whole else 'second']))
        yield [gyro.name, f'{gyro.rate:.0f}', f'{cutoff:.0f}', f'{1e3 * delay:.1f}', *cells]


def _behind(gyro: gyros.Gyro, out: np.ndarray, delays: np.ndarray,
            part: np.ndarray) -> np.ndarray:
    """Return the noise of each axis after the best low-pass for the remaining lag."""
    tried = []
    for kind in KINDS:
        low = [of_lag(kind, float(delay), gyro.rate) for delay in delays]
        tried.append(np.array([
            np.inf if one is None else noise(out[:, axis:axis + 1], [one], gyro.rate, part)[0]
            for axis, one in enumerate(low)]))
    return min(tried, key=np.sum)


def _cell(left: np.ndarray, fixed: np.ndarray) -> str:
    """Return the ratio of the rms of all axes, and of the worst axis."""
    if not np.all(np.isfinite(left)):
        return 'too slow'
    ratio = math.sqrt(float(left.sum() / fixed.sum()))
    return f'{ratio:.2f} ({math.sqrt(float(np.max(left / fixed))):.2f})'


HEAD = ['gyro', 'Hz', 'low-pass, Hz', 'lag, ms', "ArduPilot's notch by throttle",
        '`AdaptiveNotch` by throttle', 'from nothing', "Betaflight's RPM filter",
        '`AdaptiveNotch` by rpm', 'from nothing']


def main() -> int:
    """Measure and print the table, or put it into the page."""
    parser = arguments(__doc__, names=True)
    parser.add_argument('--seconds', type=float, default=math.inf, help='length read of each')
    parser.add_argument('--cutoffs', type=float, nargs='+', default=list(CUTOFFS))
    options = parser.parse_args()
    rows = []
    for name, *_ in gyros.FLIGHTS:
        if options.names and name not in options.names:
            continue
        gyro = gyros.read(name, options.seconds)
        if gyro is not None:
            for row in measure(gyro, tuple(options.cutoffs)):
                rows.append(row)
                say(row)
    text = table(HEAD, rows)
    deliver(text, options.page, 'notch')
    return 0


if __name__ == '__main__':
    sys.exit(main())
