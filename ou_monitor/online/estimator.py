"""
The sliding-window OU estimator, used by the node and by the offline tools.

Limits: no white measurement noise in the model yet (noise_std is NaN, and
noise is taken for diffusion); the cost of `estimate` grows with the samples
in the window.
"""

from __future__ import annotations

from collections import deque
import math

import numpy as np
import numpy.typing as npt

from ou_monitor.model.exact_fit import fit_exact
from ou_monitor.records import Counters, Estimate, Flag, FloatArray, NAN, Status

MIN_SAMPLES = 16
MIN_RELAXATIONS = 5.0
GOOD_RELAXATIONS = 25.0
# A pause longer than this share of the window ends the window: what lies
# behind it says nothing of the rail now.
GAP_SHARE = 1.0
# Throttle that moves less than this (rms, of full scale) cannot tell sag.
MIN_THROTTLE_STD = 0.005


class SlidingEstimator:
    """
    OU parameters of the last `window` seconds of a voltage.

    Parameters
    ----------
    window : float
        Length of the window, s, > 0.

    Raises
    ------
    ValueError
        When the window is not a positive finite number.

    """

    def __init__(self, window: float = 2.0) -> None:
        self._window = _checked_window(window)
        self._blocks: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()
        self._last_t = -math.inf
        self._last_throttle = NAN
        self._pushed = self._used = self._non_finite = self._late = self._resets = 0
        self._cached: Estimate | None = None

    @property
    def window(self) -> float:
        """Length of the window, s."""
        return self._window

    @window.setter
    def window(self, value: float) -> None:
        """Change the length; samples still inside the new length stay."""
        self._window = _checked_window(value)
        self._forget()

    def reset(self) -> None:
        """Clear the window; the counters go on."""
        self._blocks.clear()
        self._last_t = -math.inf
        self._last_throttle = NAN
        self._resets += 1
        self._cached = None

    def push(self, t: npt.ArrayLike, voltage: npt.ArrayLike,
             throttle: npt.ArrayLike | None = None) -> None:
        """
        Add samples.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  Samples at or before the newest one are dropped and
            counted; a step back by more than the window clears it.
        voltage : float or array_like, shape (n,)
            Voltage, V.  NaN and infinite samples are dropped and counted.
        throttle : float or array_like, shape (n,), optional
            Throttle, 0..1; NaN or left out means unknown.

        Raises
        ------
        ValueError
            When the shapes differ.

        """
        stamps = np.atleast_1d(np.asarray(t, dtype=np.float64))
        volts = np.atleast_1d(np.asarray(voltage, dtype=np.float64))
        if stamps.ndim != 1 or stamps.shape != volts.shape:
            raise ValueError(
                f't and voltage must have one shape (n,): got {stamps.shape} and {volts.shape}')
        given = np.asarray(NAN if throttle is None else throttle, dtype=np.float64)
        if given.ndim > 0 and given.shape != stamps.shape:
            raise ValueError(
                f'throttle must be one number or have the shape of t, {stamps.shape}: got '
                f'{given.shape}')
        load = np.broadcast_to(given, stamps.shape)
        self._pushed += stamps.size
        good = np.isfinite(stamps) & np.isfinite(volts)
        self._non_finite += int(stamps.size - good.sum())
        stamps, volts, load = stamps[good], volts[good], load[good]
        if not stamps.size:
            return
        if stamps[0] < self._last_t - self._window:
            self.reset()
        elif stamps[0] - self._last_t > GAP_SHARE * self._window and self._blocks:
            self.reset()
        newest = np.maximum.accumulate(np.concatenate(([self._last_t], stamps)))[:-1]
        fresh = stamps > newest
        self._late += int(stamps.size - fresh.sum())
        stamps, volts, load = stamps[fresh], volts[fresh], load[fresh]
        if not stamps.size:
            return
        self._used += stamps.size
        self._blocks.append((stamps, volts, np.array(load)))
        self._last_t = float(stamps[-1])
        self._last_throttle = float(load[-1])
        self._forget()

    def _forget(self) -> None:
        """Drop what has left the window."""
        self._cached = None
        edge = self._last_t - self._window
        while self._blocks and self._blocks[0][0][-1] < edge:
            self._blocks.popleft()
        if self._blocks and self._blocks[0][0][0] < edge:
            t, v, u = self._blocks[0]
            keep = int(np.searchsorted(t, edge))
            self._blocks[0] = (t[keep:], v[keep:], u[keep:])

    def estimate(self) -> Estimate:
        """Return the estimate for the window that ends at the newest sample."""
        if self._cached is None:
            self._cached = self._fit()
        return self._cached

    def _counters(self) -> Counters:
        return Counters(pushed=self._pushed, used=self._used, non_finite=self._non_finite,
                        late=self._late, resets=self._resets)

    def _fit(self) -> Estimate:
        if not self._blocks:
            return Estimate(counters=self._counters())
        t, v, u = (np.concatenate(part) for part in zip(*self._blocks))
        duration = float(t[-1] - t[0])
        rate = (t.size - 1) / duration if duration > 0.0 else NAN

        def unusable(status: Status) -> Estimate:
            return Estimate(t=float(t[-1]), status=status, n=t.size, duration=duration,
                            rate=rate, u0=float(v.mean()), voltage=float(v[-1]),
                            throttle=self._last_throttle,
                            counters=self._counters())

        if t.size < MIN_SAMPLES:
            return unusable(Status.TOO_FEW_SAMPLES)
        if np.ptp(v) == 0.0:
            return unusable(Status.CONSTANT)
        flags: list[Flag] = []
        known = bool(np.isfinite(u).all())
        moves = known and float(u.std()) > MIN_THROTTLE_STD
        columns = [np.ones(t.size)]
        if moves:
            columns.append(u - u[-1])
        elif known:
            flags.append(Flag.NO_EXCITATION)
        fit = fit_exact(t, v, np.column_stack(columns))
        if fit.at_high:
            return unusable(Status.NO_RELAXATION)
        # What the restricted likelihood leaves of the bias of alpha: 2/T.
        alpha = fit.alpha - 2.0 / duration
        if fit.at_low or fit.alpha * duration < MIN_RELAXATIONS or alpha <= 0.0:
            return unusable(Status.TOO_SHORT)
        sigma = math.sqrt(2.0 * fit.alpha * fit.var_inf)
        dt = duration / (t.size - 1)
        if alpha * dt > 1.0:
            flags.append(Flag.SLOW_RATE)
        relaxations = alpha * duration
        # Information of a clean AR(1): Var ln(phi) gives alpha, n/2 gives the
        # innovation variance; their sum gives sigma and Var_inf.
        spread = math.expm1(2.0 * alpha * dt) / (t.size * (alpha * dt) ** 2)
        shared = 1.0 - 2.0 * alpha * dt / math.expm1(2.0 * alpha * dt)
        sigma_var = 2.0 / t.size + shared ** 2 * spread
        var_log = 2.0 / (t.size * math.tanh(alpha * dt))
        return Estimate(
            t=float(t[-1]), alpha=alpha, sigma=sigma, var_inf=sigma * sigma / (2.0 * alpha),
            u0=float(fit.beta[0]), alpha_se=math.sqrt(spread),
            sigma_se=0.5 * math.sqrt(sigma_var), var_inf_se=math.sqrt(var_log),
            u0_se=math.sqrt(float(fit.beta_cov[0, 0])),
            sag=float(fit.beta[1]) if moves else NAN, voltage=float(v[-1]),
            throttle=self._last_throttle,
            status=Status.OK if relaxations >= GOOD_RELAXATIONS else Status.SHORT_WINDOW,
            flags=tuple(flags), n=t.size, duration=duration, rate=rate,
            counters=self._counters())


def _checked_window(window: float) -> float:
    value = float(window)
    if not (math.isfinite(value) and value > 0.0):
        raise ValueError(f'window must be a positive number of seconds, got {window}')
    return value
