"""Recordings from a model, piece by piece: memory does not grow with their length."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel
from ou_monitor.records import Recording
from ou_monitor.simulation.profiles import Profile

# Far beyond any supply, V, and within what messages hold.
LARGEST = 1e9


def simulated(model: SupplyModel, profile: Profile, *, duration: float, rate: float, seed: int,
              name: str = 'simulated') -> Iterator[Recording]:
    """Yield a recording in pieces (profile in s, duration in s, rate in Hz)."""
    total = round(duration * rate)
    run = Simulation(model, np.random.default_rng(seed))
    for first in range(0, total, SEGMENT):
        t = np.arange(first, min(first + SEGMENT, total)) / rate
        # As a bag can hold it, so that the truth is what the bag says.
        throttle = profile(t).astype(np.float32).astype(np.float64)
        try:
            with np.errstate(over='ignore', invalid='ignore'):
                voltage = run.advance(t, throttle)
        except ValueError as error:
            raise InputError(str(error)) from error
        if not (np.abs(voltage) <= LARGEST).all():
            raise InputError(
                f'the model gives voltages beyond {LARGEST:g} V: check its parameters')
        yield Recording(t, voltage, throttle, name)
