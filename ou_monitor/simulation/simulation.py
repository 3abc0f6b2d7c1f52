"""
Supplies and flights to simulate (the paper's load states, and a flight), and their recordings.

Parameters are those of the paper's Tables 1 and 2 unless said otherwise.  Recordings come piece by
piece: memory does not grow with their length.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
import math

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SEGMENT, Simulation, SupplyModel
from ou_monitor.model.terms.drift import Drift
from ou_monitor.model.terms.load_dependent_sigma import LoadDependentSigma
from ou_monitor.model.terms.load_sag import LoadSag
from ou_monitor.model.terms.load_transient import LoadTransient
from ou_monitor.model.terms.measurement_noise import MeasurementNoise
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.quantization import Quantization
from ou_monitor.records import Recording
from ou_monitor.simulation.profiles import Profile

# The paper's rail, V, and relaxation rate, 1/s (Table 2).
U0 = 5.0
ALPHA = 63.0

# Noise intensity by throttle, V/sqrt(s).  10 % and 40 % are Table 2; 5 % follows
# from its Vrms of 9.38 mV (Table 1); motors off reads "~0": half a step of the
# oscilloscope (9.375 mV) at most.
SIGMA = {0.0: 4.7e-3 * math.sqrt(2.0 * ALPHA), 0.05: 9.38e-3 * math.sqrt(2.0 * ALPHA),
         0.10: 0.3156, 0.40: 0.632}

# Deviation right after 20 % throttle is released, V (Fig. 5).
TRANSIENT_SAG = 0.368

# The flight: sag at full throttle, V, and the sensor's white noise, V.
FLIGHT_SAG = 0.3
FLIGHT_NOISE = 2e-3


@dataclass(frozen=True)
class Preset:
    """
    A supply, and how it is flown and sampled.

    Attributes
    ----------
    text : str
        What it is.
    model : SupplyModel
        The supply.
    throttle : str
        Its throttle, as `profiles.read_profile` takes it.
    rate : float
        Samples per second, Hz.
    duration : float
        Length, s.

    """

    text: str
    model: SupplyModel
    throttle: str
    rate: float
    duration: float


def _load(throttle: float) -> Preset:
    return Preset(f"the paper's load state of {throttle:.0%} throttle",
                  SupplyModel((OU(ALPHA, SIGMA[throttle], U0),)), f'{throttle:g}', 1000.0, 60.0)


def _intensity() -> LoadDependentSigma:
    """Return the paper's intensities, as factors on that of idle."""
    return LoadDependentSigma(tuple(SIGMA),
                              tuple(math.log(s / SIGMA[0.0]) for s in SIGMA.values()))


PRESETS: dict[str, Preset] = {
    'idle': _load(0.0),
    'load_05': _load(0.05),
    'load_10': _load(0.10),
    'load_40': _load(0.40),
    # A sag that comes and goes with the relaxation of the rail, not at once.
    'transient': Preset(
        'the auxiliary recording 0 -> 20 -> 0 % of Fig. 5',
        SupplyModel((OU(ALPHA, SIGMA[0.05], U0), LoadSag(TRANSIENT_SAG / 0.2, 0.0),
                     LoadTransient(TRANSIENT_SAG / 0.2, 1.0 / ALPHA, 0.0))),
        'transient', 1000.0, 10.0),
    'loads': Preset("the paper's four load states in turn, sigma following throttle",
                    SupplyModel((OU(ALPHA, SIGMA[0.0], U0), _intensity())), 'loads', 1000.0,
                    40.0),
    'flight': Preset(
        'a flight: sag, sigma following throttle, white sensor noise',
        SupplyModel((OU(ALPHA, SIGMA[0.0], U0), LoadSag(FLIGHT_SAG, 0.0), _intensity(),
                     MeasurementNoise(FLIGHT_NOISE))), 'flight', 1000.0, 120.0),
    'flight_full': Preset(
        'a flight as logs show it: also a lag, discharge and ADC steps',
        SupplyModel((OU(ALPHA, SIGMA[0.0], U0), LoadSag(FLIGHT_SAG, 0.1),
                     LoadTransient(0.15, 0.4, 0.0), _intensity(), Drift(-1e-3, 0.0),
                     MeasurementNoise(5e-3), Quantization(10e-3))), 'flight', 1000.0, 120.0),
}


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
