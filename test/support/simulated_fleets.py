"""Tables of a fleet with known truth."""

import math

import numpy as np

LEVELS = ((0.1, 20.0), (0.3, 30.0), (0.5, 10.0))
# ln sigma over throttle, a curve like the paper's.
SLOPE, BEND = 2.4, -1.5
# Scatter of ln resistance and ln sag between flights.
PACK = 0.05


def table(rng: np.random.Generator, vehicles: int, flights: int, *, scatter: float = 0.08,
          drift: dict | None = None, odd_flights: dict | None = None,
          odd_vehicles: dict | None = None, levels=LEVELS, ageing: dict | None = None,
          ohms: dict | None = None) -> list[dict]:
    """Return a fleet table with a row per level; effects are on ln sigma."""
    # ageing: vehicle -> growth of ln resistance and ln sag per flight; ohms: vehicle -> their
    # offset.
    rows = []
    for v in range(vehicles):
        vehicle = 0.15 * rng.standard_normal() + (odd_vehicles or {}).get(v, 0.0)
        for f in range(1, flights + 1):
            sigma = math.log(0.4) + vehicle + scatter * rng.standard_normal()
            sigma += (drift or {}).get(v, 0.0) * f + (odd_flights or {}).get((v, f), 0.0)
            alpha = math.log(63.0) + scatter * rng.standard_normal()
            old = (ageing or {}).get(v, 0.0) * f + (ohms or {}).get(v, 0.0)
            sag = 0.5 * math.exp(old + PACK * rng.standard_normal())
            ohm = 0.02 * math.exp(old + PACK * rng.standard_normal())
            for u, time in levels:
                se = 0.2 / math.sqrt(time)
                rows.append({
                    'path': f'/f/uav{v}/{f}', 'vehicle': f'uav{v}', 'flight': f, 'throttle': u,
                    'time_s': time, 'status': 'OK', 'sag': 0.7 * sag, 'sag_se': 0.02,
                    'sag_throttle': 0.8, 'sag_full': sag, 'sag_full_se': 0.02,
                    'resistance': ohm, 'resistance_se': 0.1 * ohm, 'cells': 4,
                    'cells_from': 'log', 'start': None,
                    'sigma': math.exp(sigma + (0.0 if u is None else SLOPE * u + BEND * u * u)
                                      + se * rng.standard_normal()), 'sigma_se': se,
                    'alpha': math.exp(alpha + 2 * se * rng.standard_normal()),
                    'alpha_se': 2 * se})
    return rows
