"""Voltages of packs under load, with another model than the one that is fitted."""

from dataclasses import dataclass

import numpy as np
from ou_monitor.model.load import CELL, INRUSH_TIME, lowpass, open_circuit

COOLING = 120.0  # s


@dataclass(frozen=True)
class Pack:
    """
    A lithium pack with two RC pairs, that warms and discharges.

    v = N E(s0 - q) - S [x + f1 LP(x, t1) + f2 LP(x, t2)] - S K (ul - LP(ul, 20 ms))_+
    x = ul^p (E/3.8)^(p-1) exp(-2 h), ul = LP(u, lag), dq = x dt / (mean x T),
    dh = (sag/V) dq - h dt / 120 s.
    """

    cells: int
    mean_load: float  # Mean of x
    charge: float = 0.7  # At the first sample, s0
    size: float = 0.12  # Immediate relative sag at full throttle, S/(3.8 N)
    power: float = 1.8  # p
    fast_share: float = 0.2  # f1, with 1 s
    slow_share: float = 0.3  # f2, with 20 s
    inrush: float = 0.5  # K
    lag: float = 0.01  # s
    endurance: float = 350.0  # Time at the mean load that would empty a full pack, T, s
    full_current: float = 0.0  # Current at a load of 1, A; 0: the load is throttle

    def path(self, t: np.ndarray, throttle: np.ndarray, current: np.ndarray | None = None
             ) -> np.ndarray:
        """Return the mean voltage, V."""
        full, dt = self.mean_load * self.endurance, np.diff(t, prepend=t[0])
        lagged = lowpass(current / self.full_current if self.full_current else throttle, t,
                         self.lag)
        x = lagged
        if not self.full_current:
            x = lagged ** self.power
            level = open_circuit(np.clip(self.charge - np.cumsum(x * dt) / full, 0.0, 1.0))
            x = x * (level / CELL) ** (self.power - 1.0)
        total = self.size * (1.0 + self.fast_share + self.slow_share)
        x = x * np.exp(-2.0 * total * COOLING / full * lowpass(x * x, t, COOLING, 0.0))
        rest = self.cells * open_circuit(np.maximum(self.charge - np.cumsum(x * dt) / full, -1.0))
        response = x + self.fast_share * lowpass(x, t, 1.0)
        response += self.slow_share * lowpass(x, t, 20.0, 0.3 * self.mean_load)
        if not self.full_current:
            response += self.inrush * np.maximum(lagged - lowpass(lagged, t, INRUSH_TIME), 0.0)
        return rest - self.size * CELL * self.cells * response


QUAD = Pack(4, 0.25, charge=0.85, size=0.15, power=1.8)


def flown(seed, seconds=40.0, noise=0.05, pack=QUAD, rest=0.0):
    """Return stamps at 50 Hz, voltage and throttle, which steps each half second after a rest."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    u = np.clip(0.35 + 0.25 * rng.standard_normal(round(2 * seconds) + 1), 0.0, 1.0)[
        (2 * t).astype(int)] * (t >= rest)
    return t, pack.path(t, u) + noise * rng.standard_normal(t.size), u
