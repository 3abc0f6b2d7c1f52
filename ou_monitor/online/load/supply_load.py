"""
The voltage under load: level, sag, noise, and whether the sag is known.

Limits: outside the throttles flown, the sag is extrapolated.  The stated error omits changes of
the sag during the flight; it is at least a tenth of the sag.
"""

from __future__ import annotations

from dataclasses import dataclass
import enum
import math

import numpy as np
import numpy.typing as npt
from ou_monitor.model.load import LAGS, LINEAR_LAGS, POWER
from ou_monitor.records import Estimate, FloatArray, NAN, Status

# Time at constant throttle for which the sag is stated, s: motors and converters have settled, and
# longer bursts of throttle are rare.  If the load has been known for less than _HOLDS times HOLD,
# the sag is stated for 1/_HOLDS of that time, because for a longer time it would be extrapolated.
HOLD, _HOLDS = 1.0, 10.0
# Time at constant current for which the immediate resistance is stated, s: the resistance that a
# user would compute from changes between samples at 10 Hz.
AT_ONCE = 0.1
# Throttles of the table of the sag.
TABLE = np.linspace(0.0, 1.0, 101)
# Number of sweeps in `rising` (with 10, results on cf_pair are within 3 % of convergence).
_SWEEPS = 10
# Sentences on the relaxation for statuses in which only level, sag and noise are known.
_NO_ALPHA = {
    Status.NO_RELAXATION: 'The relaxation is not visible{at}: it is too fast or too weak.',
    Status.BURIED: 'The relaxation is buried in noise{at}.',
    Status.UNBOUND: 'No relaxation is visible in the window{at}.',
    Status.TOO_SHORT: 'The window is too short for the relaxation{at}.'}


def reached(seconds: float, lags: tuple[float, ...] = LAGS) -> FloatArray:
    """Return the share of each lagged response that has developed `seconds` after a step."""
    return -np.expm1(-seconds / np.array(lags))


def hold(known: float) -> float:
    """Return the time for which the sag is stated, s; known: time with known load, s."""
    return min(HOLD, known / _HOLDS)


def static(throttle: npt.ArrayLike, held: float = HOLD) -> FloatArray:
    """Return the regressors of the sag, (n, SIZE - 1), at throttles held for `held` s."""
    u = np.asarray(throttle, dtype=np.float64)[..., None]
    x = u ** POWER
    return np.concatenate([x, u, u ** 3, x * reached(held), u * reached(held, LINEAR_LAGS)], -1)


def rising(a: FloatArray, covariance: FloatArray, table: FloatArray) -> FloatArray:
    """Return the most likely coefficients for which table @ a increases (Hildreth's method)."""
    steps = np.diff(table[::10], axis=0)
    falls, both, push = steps @ a, steps @ covariance @ steps.T, np.zeros(steps.shape[0])
    for k in np.tile(np.arange(push.size), _SWEEPS if (falls < 0.0).any() else 0).tolist():
        push[k] = max(0.0, push[k] - (falls[k] + both[k] @ push) / both[k, k])
    return np.asarray(a + covariance @ steps.T @ push)


class LoadStatus(enum.Enum):
    """State of the response to throttle; the value is the sentence for the pilot."""

    KNOWN = 'The sag is known over the throttles flown.'
    NO_DATA = 'No voltage has arrived.'
    NO_THROTTLE = ('Throttle is unknown, so the sag is unknown too; the level is the voltage '
                   'under load.')
    STILL = 'Throttle has moved by less than 2 %: too little for a sag over throttle.'
    UNCERTAIN = 'The sag is too uncertain: it needs more changes of throttle.'
    RISES = ('The voltage rises with throttle; unless a regulator raises it, check topic, unit '
             'and sign of throttle.')
    NO_RELATION = ('The voltage does not fall with throttle, as on a regulated rail; on a '
                   'battery, check topic, unit and sign of throttle.')


class Basis(enum.Enum):
    """Input from which the level is computed: the best one over the last half minute."""

    NONE = 'neither throttle nor current'
    THROTTLE = 'throttle'
    CURRENT = 'current'


@dataclass(frozen=True)
class SupplyLoad:
    """Result of the load filter."""

    status: LoadStatus = LoadStatus.NO_DATA  # Whether the sag is known, or why not.
    # Open-circuit voltage, V; if throttle is unknown, the voltage under load; NaN: no voltage.
    level: float = NAN
    # Last voltage without the response to load (sag-compensated), V; the level is its mean.
    rest: float = NAN
    # Resistance after `hold`, Ohm; NaN without a current that moves the voltage.
    resistance: float = NAN
    resistance_se: float = NAN  # Its standard error, Ohm.
    resistance_at_once: float = NAN  # Resistance after `AT_ONCE`, Ohm.
    time_constants: tuple[float, ...] = LAGS  # Time constants of the response, s; fixed.
    delay: float = 0.0  # Delay of throttle behind the voltage, s.
    # Input from which the level is computed, and the sag too if throttle does not determine it.
    basis: Basis = Basis.NONE
    # Throttles between which 80 % of the last two minutes were flown.
    flown: tuple[float, float] = (0.0, 1.0)
    _sag: tuple[float, ...] = ()
    _sag_se: tuple[float, ...] = ()
    _noise: tuple[float, ...] = (NAN, NAN)
    _range: tuple[float, float] = (0.0, 1.0)

    @property
    def known(self) -> bool:
        """Return whether the sag is known."""
        return self.status is LoadStatus.KNOWN

    def sag(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the sag after `hold`, V; unless `known`, it is close to the prior, or NaN."""
        return self._read(throttle, self._sag)

    def sag_se(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the standard error of the sag, V."""
        return self._read(throttle, self._sag_se)

    def noise(self, throttle: npt.ArrayLike) -> FloatArray:
        """Return the rms that the load does not explain, V, at the nearest throttle flown."""
        u = np.clip(np.asarray(throttle, dtype=np.float64), *np.nan_to_num(self._range))
        return np.asarray(np.interp(u, np.linspace(0.0, 1.0, len(self._noise)), self._noise))

    def fields(self, throttle: float) -> dict[str, object]:
        """Return the published values, with noise at a throttle; V, Ohm, s."""
        return {
            'load_status': self.status.name, 'load_status_text': self.status.value,
            'load_level': self.level, 'load_rest': self.rest, 'sag': float(self.sag(1.0)),
            'sag_se': float(self.sag_se(1.0)), 'load_noise': self._noise_at(throttle),
            'load_resistance': self.resistance, 'load_resistance_se': self.resistance_se,
            'load_delay': self.delay, 'load_basis': self.basis.name}

    def words(self, e: Estimate) -> str:
        """Return sag, level, noise, and why alpha is unknown; '' if alpha may be known."""
        if math.isnan(self.level) or e.status not in _NO_ALPHA:
            return ''
        why = _NO_ALPHA[e.status].format(at=f' at {e.rate:.3g} Hz' if e.rate > 0.0 else '')
        noise = f'noise {self._noise_at(e.throttle):.2g} V'
        if not self.known:
            return f'Level {self.level:.2f} V, {noise}. {self.status.value} {why}'
        error = max(float(self.sag_se(1.0)), 1e-3)
        digits = max(0, 1 - math.floor(math.log10(error)) - 1)
        return (f'Sag {float(self.sag(1.0)):.{digits}f} V at full throttle \u00b1 '
                f'{error:.{digits}f}, level {self.level:.2f} V, {noise}. {why}')

    def _noise_at(self, throttle: float) -> float:
        return float(self.noise(throttle if math.isfinite(throttle) else 0.0))

    def _read(self, throttle: npt.ArrayLike, table: tuple[float, ...]) -> FloatArray:
        u = np.asarray(throttle, dtype=np.float64)
        if not table or self.status in (LoadStatus.STILL, LoadStatus.RISES):
            return np.full(u.shape, NAN)
        return np.asarray(np.interp(u, TABLE, table))


@dataclass(frozen=True, eq=False)
class LoadState:
    """Present state of the load filter, for prediction."""

    # Stamp, s, and throttle now.
    t: float
    throttle: float
    # State: level, V; discharge per load, 1/s; coefficients, V, as in `LoadStart`.  The covariance
    # is enlarged if innovations were larger than predicted.
    mean: FloatArray
    covariance: FloatArray
    lags: tuple[float, ...]  # x = u^1.8 after LAGS, and throttle u after LINEAR_LAGS.
    size: float  # Load at the present level, relative to the load at 3.8 V per cell.
    fall: float  # Fall of the level, V per unit of charge.
    # Coefficients of ln variance, V^2, of a sample: 1, ripple, sqrt|du|.
    log_variance: tuple[float, float, float]
    ripple_se: float  # Standard error of the coefficient of ripple.
    deviation: tuple[float, ...]  # Noise, V, at equal steps of throttle from 0 to 1.
    flown: tuple[float, float]  # Throttles between which the noise is known.
