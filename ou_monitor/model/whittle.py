"""
Whittle likelihood: fits spectra to a periodogram, in milliseconds for a whole recording.

The periodogram ordinates of a long series are nearly independent exponential variables, whose
means are the spectrum (Whittle, Ark. Mat. 2 (1953) 423); means over bins follow gamma
distributions.  `Ordinates` is for the scores of a model.  `CrossSpectrum` is for a voltage with
regressors, and uses the expected ordinates for the length of the window (debiased Whittle
likelihood: Sykulski et al., Biometrika 106 (2019) 251).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import functools
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.records import FloatArray

# Number of ordinates at low frequencies that are not binned, and bins per octave above them.
_SINGLE, _TO_OCTAVE = 16, 10
# Limit at which scores are clipped.
_FAR = 5.0
_ROUNDS = 25  # Maximum number of rounds of scoring
_STEP = 1e-3  # Step of the numerical derivatives
_SETTLED = 0.01  # Convergence tolerance, nats
_MOST = 1.0  # Maximum step of a coordinate
_DAMPED, _STUCK = 1e-3, 1e4  # Initial and maximum damping of a step


@dataclass(frozen=True, eq=False)
class Ordinates:
    """The periodogram of scores, in bins."""

    # Mean of the ordinates of each bin, expected to be 1 for white scores of variance 1; shape
    # (k,).
    power: FloatArray
    count: FloatArray  # Number of ordinates in each bin; shape (k,)
    omega: FloatArray  # Centre of each bin, radians per sample; shape (k,)

    @classmethod
    def of(cls, z: FloatArray) -> Ordinates:
        """Return the ordinates of a series of scores, with outliers clipped."""
        z = np.clip(z, -_FAR, _FAR)
        power = np.abs(np.fft.rfft(z - z.mean())[1:-1]) ** 2 / z.size
        first = min(_SINGLE, power.size)
        more = max(2, round(_TO_OCTAVE * math.log2(max(power.size / first, 2.0))))
        edges = np.unique(np.concatenate((
            np.arange(first), np.geomspace(first, power.size, more).round())).astype(int))
        total = np.concatenate(([0.0], np.cumsum(power)))
        count = np.diff(edges).astype(np.float64)
        return cls(np.diff(total[edges]) / count, count,
                   np.pi * (edges[:-1] + edges[1:] + 1.0) / z.size)

    def likelihood(self, log: FloatArray) -> float:
        """Return the log-likelihood, nats, of a spectrum; log: its logarithm, shape (k,)."""
        return -float(self.count @ (log + self.power * np.exp(-log)))

    def climb(self, log_of: Callable[[FloatArray], FloatArray], start: FloatArray
              ) -> tuple[FloatArray, float]:
        """Maximise over x the likelihood of log_of(x); return x and the gain over white, nats."""
        x = np.asarray(start, dtype=np.float64)
        log = log_of(x)
        value, damping = self.likelihood(log), _DAMPED
        for _ in range(_ROUNDS):
            slopes = np.stack([(log_of(x + step) - log) / _STEP
                               for step in _STEP * np.eye(x.size)], axis=1)
            weighted = self.count[:, None] * slopes
            information = slopes.T @ weighted
            gradient = weighted.T @ (self.power * np.exp(-log) - 1.0)
            scale = np.sqrt(information.diagonal()) + 1e-9
            information = information / np.outer(scale, scale)
            gain = 0.0
            while gain <= 0.0 and damping < _STUCK:
                by = np.linalg.solve(information + damping * np.eye(x.size), gradient / scale)
                move = np.clip(by / scale, -_MOST, _MOST)
                there = log_of(x + move)
                gain = self.likelihood(there) - value
                damping *= 0.1 if gain > 0.0 else 10.0
            if not gain > 0.0:
                break
            x, log, value = x + move, there, value + gain
            if gain < _SETTLED:
                break
        return x, value - self.likelihood(np.zeros(self.power.size))


# Number of ordinates of a cross spectrum that are not binned; relative width of the bins above.
_ONE_BY_ONE, _WIDTH = 24, 0.06


def cosines(x: FloatArray) -> FloatArray:
    """Return the orthonormal cosine transform (DCT-II) of rows, shape (q, n)."""
    n = x.shape[1]
    # Computed by one Fourier transform of the even samples followed by the reversed odd samples
    # (Makhoul, IEEE Trans. Acoust. Speech Signal Process. 28 (1980) 27).
    F = np.fft.rfft(np.concatenate([x[:, ::2], x[:, 1::2][:, ::-1]], axis=1), axis=1)
    F *= _turned(n)
    return np.concatenate([F.real, -F.imag[:, (n - 1) // 2:0:-1]], axis=1)


@functools.lru_cache(maxsize=8)
def _turned(n: int) -> npt.NDArray[np.complex128]:
    """Return the factors with which a Fourier transform becomes a cosine transform."""
    factors = np.exp(-0.5j * np.pi / n * np.arange(n // 2 + 1)) * math.sqrt(2.0 / n)
    factors[0] *= math.sqrt(0.5)
    return np.asarray(factors, np.complex128)


# Frequencies at which the absorption by a regression is tabulated, radians per sample.
ABSORBED_AT = np.append(0.0, np.geomspace(1e-6, np.pi, 200))


def absorbed_by(basis: FloatArray) -> FloatArray:
    """Return the number of ordinates, up to each of ABSORBED_AT, that regressors absorb."""
    # basis: orthonormal regressors, shape (p, n).
    n = basis.shape[1]
    total = np.append(0.0, np.cumsum(np.sum(cosines(basis) ** 2, axis=0)))
    return np.asarray(np.interp(ABSORBED_AT, np.pi * (np.arange(n + 1) - 0.5) / n, total))


class SpectrumBins:
    """Bins of the ordinates of stretches of readings; arrays have shape (bins,)."""

    def __init__(self, lengths: tuple[int, ...], each_mean: bool) -> None:
        # Lost messages may cause hundreds of stretches, so stretches of similar length share bins.
        groups: dict[int, list[int]] = {}
        for k, size in enumerate(lengths):
            groups.setdefault(round(math.log(size) / _WIDTH), []).append(k)
        # For each stretch: its number, its first bin, and the ends of its bins.
        self.stretches: list[tuple[int, int, npt.NDArray[np.intp]]] = []
        sizes, places, begin = [], [], 0
        for group in groups.values():
            longest = max(lengths[k] for k in group)
            edges = [*range(min(_ONE_BY_ONE, longest) + 1)]
            while edges[-1] < longest:
                edges.append(min(longest, edges[-1] + max(1, int(_WIDTH * edges[-1]))))
            # For each bin: number of ordinates, sum of their indices over the length, and sum of
            # (-1)^index.
            sums = np.zeros((3, len(edges) - 1))
            for k in group:
                size = lengths[k]
                ends = np.append([a for a in edges[:-1] if a < size], min(edges[-1], size))
                count = np.diff(ends)
                sums[:, :count.size] += np.stack([
                    count, count * 0.5 * (ends[:-1] + ends[1:] - 1) / size,
                    count % 2 * (1 - 2 * (ends[:-1] % 2))])
                sums[0, 0] -= each_mean
                self.stretches.append((k, begin, ends))
            begin += sums.shape[1]
            places.append(sums)
            sizes.append(np.full(sums.shape[1], sum(lengths[k] for k in group) / len(group)))
        self.size = np.concatenate(sizes)
        self.count, place, sign = np.concatenate(places, axis=1)
        omega = np.pi * place / np.maximum(self.count, 1e-9)
        self.sign = sign / np.maximum(self.count, 1.0)
        self.chord = 4.0 * np.sin(0.5 * omega) ** 2
        # Sum of the squares of an ordinate's weights on the first and the last reading.
        self.ends = np.where(omega > 0.0, 4.0 - self.chord, 2.0) / self.size
        # Inverse of the ordinates of a random walk, with a nominal value for the mean (omega 0).
        self.walk = 4.0 * np.sin(0.5 * np.maximum(omega, 0.5 * np.pi / self.size)) ** 2

    def ou(self, a: FloatArray) -> FloatArray:
        """Return the expected ordinates of an OU of variance 1; a: alpha dt, shape (k, 1)."""
        # The inverse covariance is (1 - phi)^2 + phi L, whose eigenvectors are the cosines, plus
        # phi (1 - phi) at both ends, which needs Woodbury's formula.
        phi, gap = np.exp(-a), -np.expm1(-a)
        square = gap * gap + phi * self.chord
        end = self.ends * phi * gap * (1.0 - self.sign * np.exp(-a * self.size)) / (1.0 + phi)
        return np.asarray(gap * (1.0 + phi) / square * (1.0 - end / square))


_bins = functools.lru_cache(maxsize=8)(SpectrumBins)


class CrossSpectrum:
    """Cross spectra of regressors and a voltage, and the likelihood of a noise spectrum."""

    def __init__(self, rows: FloatArray, lengths: Sequence[int],
                 absorbed: FloatArray | None = None) -> None:
        # The cosine transform continues the window as its mirror image.  So, unlike in a Fourier
        # transform, different values at the two ends cause no leakage.
        # rows: regressors, then the voltage, shape (q, n), in stretches of evenly spaced readings;
        # without regressors (q = 1), each stretch has its own mean.
        # absorbed: result of `absorbed_by` for an earlier regression, divided by the number of
        # readings.
        q, n = rows.shape
        self.free = n - (q - 1 or len(lengths))
        self._q, self.bins = q, _bins(tuple(lengths), q == 1)
        count = self.bins.count
        parts = np.split(rows, np.cumsum(lengths)[:-1], axis=1)
        cross, gone = np.zeros((count.size, q, q)), np.zeros(count.size)
        for k, begin, ends in self.bins.stretches:
            C = cosines(parts[k])
            if q == 1:
                C[:, 0] = 0.0
            place = slice(begin, begin + ends.size - 1)
            for j, row in enumerate(C):
                cross[place, j, j:] += np.add.reduceat(C[j:] * row, ends[:-1], axis=1).T
            if absorbed is not None:
                size = parts[k].shape[1]
                gone[place] += size * np.diff(np.interp(
                    np.pi * (ends - 0.5) / size, ABSORBED_AT, absorbed))
        self._cross = (cross + np.triu(cross, 1).transpose(0, 2, 1)).reshape(-1, q * q)
        # Number of ordinates not absorbed; at least a tenth, because the absorbed number is only
        # an average.
        self._left = count - np.minimum(gone, 0.9 * count)
        self._effective = self.free - float(np.sum(count - self._left))

    @property
    def size(self) -> int:
        """Return the number of values of one spectrum."""
        return max(self._cross.shape)

    def cost(self, S: FloatArray, used: int | None = None
             ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return minus the restricted log-likelihood of spectra (k, bins), factors, products."""
        # The likelihood is maximised over a factor on each spectrum, shape (k,).  The products are
        # x' K^-1 z of all rows, shape (k, q, q).  used: number of regressors to use.
        gram = ((1.0 / S) @ self._cross).reshape(-1, self._q, self._q)
        # Keep the matrices positive definite despite rounding.
        np.einsum('kii->ki', gram)[...] *= 1.0 + 1e-10
        free, own = self.free, gram
        if used is not None and used < self._q - 1:
            kept = [*range(used), self._q - 1]
            free, own = free + self._q - 1 - used, gram[:, kept][:, :, kept]
        effective = self._effective + free - self.free
        d = np.log(np.diagonal(np.linalg.cholesky(own), axis1=1, axis2=2))
        left = 2.0 * d[:, -1]
        value = 0.5 * effective * left + 0.5 * np.log(S) @ self._left + d[:, :-1].sum(axis=1)
        return value, np.exp(left) / free, gram
