"""A model of one flight, fitted to a part of it, that can be drawn over any throttle."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Protocol

import numpy as np
from ou_monitor.criticism.adc import find_step
from ou_monitor.model.load import lowpass
from ou_monitor.model.load_fit import LoadFit
from ou_monitor.model.residual import NoiseLaw, ResidualOU, SLOW_TIME
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.reading import Quantization
from ou_monitor.records import FloatArray
from scipy.signal import lfilter


@dataclass(frozen=True, eq=False)
class Readings:
    """What a comparison is about: each reading of the ADC once."""

    # Stamps, s, and readings, V; shape (n,).
    t: FloatArray
    voltage: FloatArray
    # 0..1, and A; None where not recorded; shape (n,).
    throttle: FloatArray | None
    current: FloatArray | None = None

    def part(self, which: slice) -> Readings:
        """Return some of the samples."""
        def of(x: FloatArray | None) -> FloatArray | None:
            return None if x is None else x[which]

        return Readings(self.t[which], self.voltage[which], of(self.throttle), of(self.current))

    @property
    def spacing(self) -> float:
        """Return the usual time from one sample to the next, s."""
        return float(np.median(np.diff(self.t)))

    @property
    def lsb(self) -> float:
        """Return the step of the ADC, V; 0 where none is seen."""
        return find_step(self.voltage)


class Drawn(Protocol):
    """What can be simulated over the stamps, throttle and current of a recording."""

    @property
    def names(self) -> list[str]:
        """Return the names of its terms."""

    @property
    def alone(self) -> bool:
        """Return whether it tells its own level, so that none is taken from the recording."""

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V, before the ADC."""


@dataclass(frozen=True)
class Damping:
    """
    How much of the fast changes of a path the voltage does not follow.

    Throttle jitters, arrives at other moments than the voltage, and is no current: what is fast in
    the path is partly not in the voltage, and would be counted twice, in the path and as noise.
    """

    share: float = 0.0  # Share of the fast part that is missing, 0..1
    time: float = 0.02  # What is faster than this time constant, s

    def of(self, path: FloatArray, t: FloatArray) -> FloatArray:
        """Return a path, V, at stamps, s, damped."""
        if not self.share > 0.0:
            return path
        return np.asarray(path - self.share * (path - lowpass(path, t, self.time)))


@dataclass(frozen=True, eq=False)
class FlightModel:
    """Load model, slow process, OU and white noise, as fitted to a part of a recording."""

    load: LoadFit | None  # The answer to the load; None where the level is all there is
    # Level, V, without a load model, and its standard error.
    level: float
    level_se: float
    damping: Damping  # Of its path
    # Factor on the variance of the slow process: how much farther parts that were left out lay
    # from their prediction than the fit says.
    spread: float
    sag_error: float  # Relative error of the sag, as parts that were left out show it
    noise: NoiseLaw  # White noise
    ou: ResidualOU  # What has memory in the residuals
    until: float  # End of the part fitted, s

    @property
    def names(self) -> list[str]:
        """Return the names of its terms, as in a model file."""
        found = ['ou']
        if self.load is not None:
            found += ['load_sag', 'load_transient',
                      *(['drift'] if math.isnan(self.load.model.stands) else [])]
        follows = self.noise.limits[0] < self.noise.limits[1]
        return [*found, 'measurement_noise', *(['load_dependent_noise'] if follows else [])]

    @property
    def alone(self) -> bool:
        """Return that it tells its own level."""
        return True

    def path(self, samples: Readings) -> FloatArray:
        """Return the mean voltage, V."""
        if self.load is None:
            return np.full(samples.t.size, self.level)
        return self.damping.of(
            self.load.model.path(samples.t, samples.throttle, samples.current), samples.t)

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V; the errors of the parameters are drawn too."""
        n = samples.t.size
        throttle = np.zeros(n) if samples.throttle is None else samples.throttle
        slow = 0.0
        if self.load is None:
            voltage = np.full(n, self.level + self.level_se * rng.standard_normal())
        else:
            load = self.load.draw(rng)
            path = load.path(samples.t, samples.throttle, samples.current)
            size = load.size * math.exp(self.sag_error * float(rng.standard_normal()))
            other = replace(load, size=size).path(
                samples.t, samples.throttle, samples.current)
            # Over the part fitted the mean is known: a larger sag goes with a higher level.
            path = other - float((other - path)[samples.t <= self.until].mean())
            voltage = self.damping.of(path, samples.t)
            slow = self.spread * self.load.slow_std ** 2
        dt = np.diff(samples.t, prepend=samples.t[0])
        white, variance, tau = self.ou.draw(rng)
        for var, time in ((slow, SLOW_TIME), (variance, tau)):
            if var > 0.0:
                voltage = voltage + math.sqrt(var) * _ou(dt, time, rng)
        factor = math.sqrt(white / self.ou.white) if self.ou.white > 0.0 else 1.0
        return np.asarray(voltage + factor * self.noise.draw(samples.t, throttle, rng))


def _ou(dt: FloatArray, tau: float, rng: np.random.Generator) -> FloatArray:
    """Return an OU of variance 1; steps are taken as even, but for gaps."""
    usual = float(np.median(dt))
    keep = math.exp(-usual / tau)
    kicks = math.sqrt(1.0 - keep * keep) * rng.standard_normal(dt.size)
    begins = [0, *np.flatnonzero(dt > 3.0 * usual).tolist(), dt.size]
    out, state = np.empty(dt.size), float(rng.standard_normal())
    for first, last in zip(begins, begins[1:]):
        over = math.exp(-float(dt[first]) / tau) if first else 1.0
        state = over * state + math.sqrt(1.0 - over * over) * float(rng.standard_normal())
        kicks[first] = state
        out[first:last] = lfilter([1.0], [1.0, -keep], kicks[first:last])
        state = float(out[last - 1])
    return out


@dataclass(frozen=True, eq=False)
class FiledModel:
    """A model from a file, drawn at each reading of the ADC, so that none is held twice."""

    model: SupplyModel  # As in the file

    @property
    def names(self) -> list[str]:
        """Return the names of its terms."""
        return [term.NAME for term in self.model.terms]

    @property
    def alone(self) -> bool:
        """Return that its level is that of another day."""
        return False

    def draw(self, samples: Readings, rng: np.random.Generator) -> FloatArray:
        """Return one simulated voltage, V."""
        analogue = SupplyModel(tuple(
            term for term in self.model.terms
            if term.NAME not in ('held_samples', Quantization.NAME)))
        return analogue.simulate(samples.t, rng, samples.throttle)
