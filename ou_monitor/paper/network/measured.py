"""
The power network of a craft that flew: its components, so that they give what was measured.

Limits: sag and noise are of the sensor, its filter and its white noise included, so that noise
slower than its filter alone is seen.  What noise is added while throttle moves, and an OU that was
found, are slow fluctuations of the current, which no capacitor of a board changes; the rest is
taken for the switching of the ESCs.  Without a current the resistance is the one given, and the
current is scaled to the sag: what packs in parallel buy then holds, an ESR beside it is a guess.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from ou_monitor.paper.network.components import completed, PowerNetwork
from ou_monitor.paper.network.rail import rail_at

# Throttle from which a sag is more than what stands in the way of its exponent.
_FROM = 0.1
# Bounds of the exponent of the current over throttle.
_EXPONENTS = 1.0, 4.0


@dataclass(frozen=True)
class Flight:
    """What a recording says of a supply, as numbers; NaN: unknown."""

    level: float  # Open-circuit voltage at its end, V
    full: float  # Its highest voltage but for a few readings, V
    cells: int  # In series; 0: unknown
    throttle: Sequence[float]  # 0..1, of the next three
    sag: Sequence[float]  # V
    noise: Sequence[float]  # Rms as flown, V
    steady: Sequence[float]  # Rms while throttle stands still, V
    flown: tuple[float, float]  # Throttles, 1 % and 99 % quantile
    highest: float  # Throttle, 0..1
    resistance: float  # At once, from a current, Ohm
    alpha: float  # Of an OU that was found, 1/s
    var_inf: float  # Its variance, V^2


def network_of(flight: Flight, throttle: float, given: dict[str, Any]) -> PowerNetwork:
    """
    Return the network of a flight; `given` goes before what was measured.

    Raises ValueError where level, sag or noise at the throttle are unknown.
    """
    low, high = flight.flown
    u, sag = np.asarray(flight.throttle), np.asarray(flight.sag)
    at = float(np.interp(throttle, u, sag))
    rms, steady = (float(np.interp(throttle, u, np.asarray(one)))
                   for one in (flight.noise, flight.steady))
    if not (math.isfinite(flight.level) and math.isfinite(at) and at > 0.0):
        raise ValueError('the recording does not show its sag: throttle and voltage must move')
    if not math.isfinite(rms):
        raise ValueError(f'the recording does not show the noise at throttle {throttle:g}')
    values: dict[str, Any] = {'battery_voltage': flight.level}
    if flight.resistance > 0.0:
        values['battery_resistance'] = flight.resistance
    network = PowerNetwork(**completed({**values, **given}))
    seen = (u >= max(_FROM, low)) & (u <= high) & (sag > 0.0)
    if 'current_exponent' not in given and seen.sum() > 1:
        slope = float(np.polyfit(np.log(u[seen]), np.log(sag[seen]), 1)[0])
        network = replace(network, current_exponent=float(np.clip(slope, *_EXPONENTS)))
    if 'current_max' not in given:
        network = replace(network, current_max=at / network.battery_resistance / max(
            throttle, 1e-3) ** network.current_exponent)
    slow = max(0.0, rms ** 2 - steady ** 2) if math.isfinite(steady) else 0.0
    rate = network.flutter_rate
    if flight.var_inf > slow:
        slow, rate = min(flight.var_inf, rms ** 2), flight.alpha
    quiet = replace(network, switching_scale=0.0, flutter=0.0, flutter_rate=rate)
    base = rail_at(quiet, throttle).var_inf
    scales: dict[str, Any] = {}
    for name, variance in (('switching_scale', rms ** 2 - slow - base), ('flutter', slow)):
        unit: dict[str, Any] = {name: 1.0}
        one = rail_at(replace(quiet, **unit), throttle).var_inf - base
        scales[name] = math.sqrt(max(0.0, variance) / one) if one > 0.0 else 0.0
    return replace(quiet, **{name: value for name, value in scales.items() if name not in given})
