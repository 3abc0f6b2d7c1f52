"""Simple direct measurements of a made recording, for the tests of the generator."""

from hidden_effects import Hidden
import numpy as np
from scipy.signal import lfilter, welch


def whitened(h: Hidden) -> np.ndarray:
    """Return the innovations by the true alpha, in units of the true one, shape (n - 1,)."""
    rail = h.detail['rail']
    phi = np.exp(-rail['alpha'] / rate(h))
    x = h.voltage - h.voltage.mean()
    return (x[1:] - phi * x[:-1]) / rail['innovation_v']


def rate(h: Hidden) -> float:
    """Return the nominal sampling rate, 1/s."""
    return round((h.t.size - 1) / (h.t[-1] - h.t[0]))


def late(h: Hidden, signal: np.ndarray, time: float) -> np.ndarray:
    """Return a held signal, shape (n,), after a low-pass of the time constant, s: exact."""
    keep = np.exp(-1 / (rate(h) * time))
    return signal[0] + lfilter([0.0, 1 - keep], [1.0, -keep], signal - signal[0])


def correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Return the correlation as a z-score: times the root of the count."""
    a, b = a - a.mean(), b - b.mean()
    return float(np.sqrt(a.size) * (a @ b) / np.sqrt((a @ a) * (b @ b)))


def plain_density(h: Hidden, f: np.ndarray) -> np.ndarray:
    """Return the one-sided density of the sampled plain rail, V^2/Hz, at f (Hz)."""
    rail = h.detail['rail']
    phi = np.exp(-rail['alpha'] / rate(h))
    return 2 * rail['innovation_v']**2 / rate(h) / np.abs(
        1 - phi * np.exp(-2j * np.pi * f / rate(h)))**2


def density(h: Hidden, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return frequencies (Hz) and Welch's one-sided density, V^2/Hz, of blocks in s."""
    return welch(h.voltage, rate(h), nperseg=int(seconds * rate(h)), detrend='constant')


def band(h: Hidden, low: float, high: float, seconds: float = 2.0) -> float:
    """Return the mean density between low and high (Hz) over that of the plain rail."""
    f, p = density(h, seconds)
    inside = (f >= low) & (f <= high)
    return float(np.mean(p[inside] / plain_density(h, f[inside])))


def signs(h: Hidden) -> dict[str, float]:
    """Return z-scores that are about N(0,1) on a plain rail, and large with a hidden effect."""
    # They know the true alpha and innovation; all but 'line' and the bands are plain averages.
    e = whitened(h)
    n = e.size
    square = np.minimum(e**2, 16.0)
    load, step = h.throttle[1:], np.abs(np.diff(h.throttle))
    recent = lfilter([1.0], [1.0, -0.99], step)
    z = {
        'skew': np.mean(e**3) / np.sqrt(15 / n), 'kurtosis': (np.mean(e**4) - 3) / np.sqrt(96 / n),
        'variance': (np.mean(e**2) - 1) / np.sqrt(2 / n),
        'throttle': correlation(e, load), 'moved': correlation(e, recent),
        'time': correlation(e, h.t[1:]),
        'square_throttle': correlation(square, load), 'square_moved': correlation(square, recent),
        'ties': float(np.sum(np.diff(h.voltage) == 0)),
        'stamps': 1e3 * float(np.max(np.abs(np.diff(h.t) * rate(h) - 1))),
    }
    for lag in (1, 2, 5, 20, 100):
        z[f'lag_{lag}'] = correlation(e[lag:], e[:-lag])
        z[f'square_lag_{lag}'] = correlation(square[lag:], square[:-lag])
        z[f'after_fall_{lag}'] = correlation(square[lag:], np.clip(e[:-lag], -4, 4))
        z[f'with_level_{lag}'] = correlation(
            square[lag:], np.clip(h.voltage[:-lag][:n - lag] - h.voltage.mean(),
                                  -4 * h.voltage.std(), 4 * h.voltage.std()))
    slow = e[:n // 500 * 500].reshape(-1, 500).mean(axis=1) * np.sqrt(500)
    z['slow'] = (np.mean(slow**2) - 1) / np.sqrt(2 / slow.size)
    swift = h.throttle - late(h, h.throttle, 0.15)
    phi = np.exp(-h.detail['rail']['alpha'] / rate(h))
    z['throttle_change'] = correlation(e, swift[1:] - phi * swift[:-1])
    half = h.throttle - h.throttle.mean()
    z['throttle_time'] = correlation(e, (half * (h.t - h.t.mean()))[1:])
    x = (h.voltage[:-1] - h.voltage.mean()) / h.voltage.std()
    z['level_throttle'] = correlation(e, x * (load - load.mean()))
    z['level_square'], z['level_cube'] = correlation(e, x**2 - 1), correlation(e, x**3 - 3 * x)
    # The largest of n/2 exponentials is ln(n/2) plus a Gumbel of unit scale.
    power = np.abs(np.fft.rfft(e))**2 / n
    z['line'] = float(power[1:].max() - np.log(n / 2))
    blocks = power[1:1 + (n // 2 - 1) // 300 * 300].reshape(-1, 300).mean(axis=1)
    z['colour'] = float(np.max(np.abs(blocks - 1)) * np.sqrt(300) - 1.5)
    return {name: float(value) for name, value in z.items()}


def largest(z: dict[str, float]) -> tuple[float, str]:
    """Return the largest score and its name."""
    return max((abs(value), name) for name, value in z.items())
