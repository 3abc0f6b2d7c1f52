"""
A low-pass whose cutoff follows sigma and may move with every sample.

State form: the continuous filter is solved exactly over each step with the
input held, so any dt is right, and the states (output, scaled slope) do not
jump when the cutoff moves.  The sum of their squares never grows by itself at
any sequence of cutoffs, so no modulation can make the filter unstable.

Limits: two laws (`threshold`, `constant_noise`); white noise whose intensity
is proportional to sigma is assumed by `constant_noise`.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from ou_monitor.online.settings import FilterSettings
from ou_monitor.records import FloatArray

_ROOT2 = math.sqrt(2.0)


def cutoff_from_sigma(settings: FilterSettings, sigma: float) -> float:
    """
    Return the cutoff, Hz, that the law asks for at `sigma`.

    `threshold` (the paper's section 6): fmax up to `sigma_ref`, fmin above.
    `constant_noise`: white noise through a low-pass of either order has an
    rms proportional to sigma sqrt(fc), so fc = fmax (sigma_ref / sigma)^2
    holds it at its value for sigma_ref.

    Parameters
    ----------
    settings : FilterSettings
        Law and limits.
    sigma : float
        Noise intensity, V/sqrt(s); NaN, infinite or negative: the fallback.

    Returns
    -------
    float
        Cutoff within fmin..fmax, Hz.

    """
    if not (math.isfinite(sigma) and sigma >= 0.0):
        return settings.fallback
    if settings.law == 'threshold':
        return settings.fmax if sigma <= settings.sigma_ref else settings.fmin
    if sigma <= settings.sigma_ref:
        return settings.fmax
    wanted = settings.fmax * (settings.sigma_ref / sigma) ** 2
    return max(wanted, settings.fmin)


class AdaptiveLowPass:
    """
    Low-pass filter with a cutoff driven by sigma.

    Parameters
    ----------
    **options
        Fields of `FilterSettings`: order (1 or 2), law, fmin, fmax (Hz),
        sigma_ref (V/sqrt(s)), fallback (Hz), smoothing (s).

    Raises
    ------
    ValueError
        For an option that is unknown or out of range.

    """

    def __init__(self, **options: object) -> None:
        self._settings = FilterSettings.from_options(options)
        self._cutoff = self._settings.fallback
        self._t: float | None = None
        self._y = 0.0
        self._slope = 0.0

    @property
    def settings(self) -> FilterSettings:
        """Return the settings in force."""
        return self._settings

    @property
    def cutoff(self) -> float:
        """Cutoff now, Hz."""
        return self._cutoff

    def configure(self, **options: object) -> None:
        """Change options; the output does not move, the cutoff follows."""
        self._settings = FilterSettings.from_options(options, base=self._settings)
        self._cutoff = min(max(self._cutoff, self._settings.fmin), self._settings.fmax)

    def filter(self, t: npt.ArrayLike, x: npt.ArrayLike,  # noqa: A003
               sigma: npt.ArrayLike) -> FloatArray | float:
        """
        Filter samples.

        Parameters
        ----------
        t : float or array_like, shape (n,)
            Stamps, s.  A step back or a repeat is taken as dt = 0: the output
            stays.
        x : float or array_like, shape (n,)
            Signal, any unit.  NaN and infinite samples do not move the filter.
        sigma : float or array_like, shape (n,)
            Noise intensity, V/sqrt(s); NaN means unknown (fallback cutoff).

        Returns
        -------
        float or ndarray, shape (n,)
            Filtered signal, like `x`; NaN until the first finite sample.

        Raises
        ------
        ValueError
            When the shapes differ.

        """
        stamps, signal = np.asarray(t, dtype=np.float64), np.asarray(x, dtype=np.float64)
        if stamps.shape != signal.shape or stamps.ndim > 1:
            raise ValueError(
                f't and x must have one shape: got {stamps.shape} and {signal.shape}')
        if stamps.ndim == 0:
            return self._step(float(stamps), float(signal), float(np.asarray(sigma)))
        intensity = np.broadcast_to(np.asarray(sigma, dtype=np.float64), stamps.shape)
        return np.array([self._step(*one) for one in
                         zip(stamps.tolist(), signal.tolist(), intensity.tolist())])

    def _step(self, t: float, x: float, sigma: float) -> float:
        if not math.isfinite(x) or not math.isfinite(t):
            return self._y if self._t is not None else math.nan
        if self._t is None:
            self._t, self._y, self._slope = t, x, 0.0
            self._cutoff = cutoff_from_sigma(self._settings, sigma)
            return x
        dt = max(t - self._t, 0.0)
        self._t = t
        self._follow(cutoff_from_sigma(self._settings, sigma), dt)
        if dt > 0.0:
            self._advance(2.0 * math.pi * self._limited(dt) * dt, x)
        return self._y

    def _follow(self, target: float, dt: float) -> None:
        """Move the cutoff towards its target, first order in ln(f)."""
        share = -math.expm1(-dt / self._settings.smoothing) if self._settings.smoothing else 1.0
        self._cutoff *= (target / self._cutoff) ** share

    def _limited(self, dt: float) -> float:
        """Keep the cutoff in force under 0.45 of the sample rate."""
        return min(self._cutoff, 0.45 / dt)

    def _advance(self, angle: float, x: float) -> None:
        """Solve the filter over one step of `angle` = 2 pi fc dt, input held at x."""
        if self._settings.order == 1:
            self._y += -math.expm1(-angle) * (x - self._y)
            self._slope = 0.0
            return
        # Butterworth, poles at fc exp(+-3i pi/4): closed form of the 2 x 2 exponential.
        a = angle / _ROOT2
        decay, sin, cos = math.exp(-a), math.sin(a), math.cos(a)
        off, slope = self._y - x, self._slope
        self._y = x + decay * ((cos + sin) * off + _ROOT2 * sin * slope)
        self._slope = decay * (-_ROOT2 * sin * off + (cos - sin) * slope)
