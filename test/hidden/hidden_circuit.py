"""
The bench: a rail made of components, the loads and sources on it, and its instrument.

Everything runs on a grid finer than the samples, by the trapezoidal rule where the circuit is
linear and by Heun's method where it is not. No formula here is exact for the sampling step, so the
data are made differently from the exact discrete formulas that a program may fit.

The sensed voltage is ``level + u(t) + series sources``, where ``u`` is the voltage of a capacitor
fed through a resistance and shaken by a white current::

    C du/dt = -(u - setpoint) / R + K dW/dt       alpha = 1/(R C), sigma = K/C
"""

from collections.abc import Callable
from dataclasses import dataclass, field
import math

import numpy as np
from scipy.signal import bilinear, lfilter

LEAD = 1.0                  # s simulated before the first sample, in which filters settle
FINE_RATE = 8000.0          # 1/s: the coarsest fine grid
REFERENCE_RATE = 1000.0     # 1/s: at which the innovation of the rail is drawn
REFERENCE_TIME = 60.0       # s: the length for which moderate strengths are chosen
# Stages of an instrument in their order; each takes and returns volts.
STAGES = ('front_end', 'sampled', 'noise', 'range', 'converter', 'bus', 'logger')

# Throttle commands as of pilots and autopilots.
UPDATE_RATE = 50.0      # 1/s: RC links and autopilots renew the command 50 times a second
RESOLUTION = 1e-3       # a PWM command of 1000..2000 us in whole microseconds
STICK_TIME = 0.06       # s: a hand does not move a stick faster

Stage = Callable[[np.ndarray], np.ndarray]


@dataclass
class Bench:
    """A set-up: effects change it, and `run` simulates it."""

    # Samples per second, and length, s.
    rate: float
    duration: float
    # Fine steps a sample.
    substeps: int
    # Physical parameters come from `draw`, noise and events from `path`, so that the same
    # components can be simulated on another grid.
    draw: np.random.Generator
    path: np.random.Generator
    # Of the rail: ohm, farad, K/C in V/sqrt(s), quiescent voltage in V.
    resistance: float
    capacitance: float
    intensity: float
    level: float
    commands: np.ndarray
    pieces: list[str]
    # 1/(R C), 1/s, and K/C, V/sqrt(s): numbers, or one per fine step.
    alpha: float | np.ndarray = 0.0
    sigma: float | np.ndarray = 0.0
    setpoint: np.ndarray | None = None
    kicks: np.ndarray | None = None
    increments: np.ndarray | None = None
    restoring: Callable[[float], float] | None = None
    state_gain: Callable[[float], float] | None = None
    transfer: tuple[list[float], list[float]] | None = None
    series: list[np.ndarray] = field(default_factory=list)
    stages: dict[str, list[Stage]] = field(default_factory=dict)
    sample_delay: np.ndarray | None = None
    stamp_error: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Set up the grids and the plain rail."""
        self.n = int(round(self.duration * self.rate))
        self.h = 1.0 / (self.rate * self.substeps)
        self.lead = int(round(LEAD * self.rate)) * self.substeps
        self.n_fine = self.lead + self.n * self.substeps
        self.time = (np.arange(self.n_fine) - self.lead) * self.h
        self.t = np.arange(self.n) / self.rate
        self.set_rail(1.0 / (self.resistance * self.capacitance), self.intensity)
        # The command is held from one update to the next, and before the first sample.
        update = np.floor(self.time * UPDATE_RATE + 1e-6).astype(int)
        self.throttle = self.commands[np.clip(update, 0, self.commands.size - 1)]
        low, high = self.throttle.min(), self.throttle.max()
        self.load = (self.throttle - low) / (high - low)

    def set_rail(self, alpha: float, sigma: float) -> None:
        """Make the rail one of rate `alpha` (1/s) and intensity `sigma` (V/sqrt(s))."""
        self.alpha0, self.sigma0 = float(alpha), float(sigma)
        self.alpha, self.sigma = self.alpha0, self.sigma0
        self.capacitance = 1.0 / (self.alpha0 * self.resistance)
        self.stationary = self.sigma0 / math.sqrt(2 * self.alpha0)
        self.phi = math.exp(-self.alpha0 / self.rate)
        # Standard deviation of a sample given the one before: the unit of all small effects.
        self.innovation = self.stationary * math.sqrt(1 - self.phi**2)
        reference = math.exp(-2 * self.alpha0 / REFERENCE_RATE)
        self.reference_innovation = self.stationary * math.sqrt(1 - reference)

    def stage(self, name: str, work: Stage) -> None:
        """Add work to one stage of the instrument."""
        self.stages.setdefault(name, []).append(work)

    def samples(self, fine: np.ndarray) -> np.ndarray:
        """Return a fine series at the nominal sample times, shape (n,)."""
        return fine[self.lead::self.substeps]

    def nats(self, signal: np.ndarray, *known: np.ndarray) -> float:
        """Return the log-likelihood that knowing an additive signal gains, nats."""
        # Signals are in V on the fine grid; linear effects of `known` signals, and a constant, are
        # removed first.
        def whitened(fine: np.ndarray) -> np.ndarray:
            at = self.samples(fine)
            return at[1:] - self.phi * at[:-1]
        target = whitened(signal)
        basis = np.column_stack([whitened(k) for k in (np.ones(self.n_fine), *known)])
        rest = target - basis @ np.linalg.lstsq(basis, target, rcond=None)[0]
        return float(rest @ rest / (2 * self.innovation**2))

    def white(self) -> np.ndarray:
        """Return Wiener increments on the fine grid, sqrt(s), shape (n_fine,)."""
        return self.path.normal(size=self.n_fine) * math.sqrt(self.h)

    def filtered(self, x: np.ndarray, num: list[float], den: list[float]) -> np.ndarray:
        """Pass a fine series through an analogue transfer function, by the trapezoidal rule."""
        b, a = bilinear(num, den, 1.0 / self.h)
        # Starts at rest at the first value, like a circuit that has been on for long.
        rest = num[-1] / den[-1] if len(num) == len(den) or num[-1] else 0.0
        return lfilter(b, a, x - x[0]) + rest * x[0]

    def lagged(self, x: np.ndarray, time: float) -> np.ndarray:
        """Pass a fine series through a first-order low-pass of the given time constant, s."""
        return self.filtered(x, [1.0], [time, 1.0])

    def relaxing(self, rate: float, std: float, noise: np.ndarray | None = None) -> np.ndarray:
        """Return an independent relaxation of rate (1/s) and standard deviation (V)."""
        dw = self.white() if noise is None else noise
        half = 0.5 * rate * self.h
        dw = dw * std * math.sqrt(2 * rate) / (1 + half)
        dw[0] += std * self.path.normal()
        return lfilter([1.0], [1.0, -(1 - half) / (1 + half)], dw)

    def event_times(self, rate: float) -> np.ndarray:
        """Draw the fine indices of Poisson events after the lead, at rate (1/s)."""
        count = self.path.poisson(rate * self.duration)
        return np.sort(self.path.integers(self.lead, self.n_fine, count))

    def capacitor(self) -> np.ndarray:
        """Integrate the rail; returns u(t) on the fine grid, V, shape (n_fine,)."""
        dw = self.white() if self.increments is None else self.increments
        shaken = self.sigma * dw
        if self.kicks is not None:
            shaken = shaken + self.kicks
        start = self.path.normal() * self.stationary
        if self.transfer is not None:
            num, den = self.transfer
            u = self.filtered(np.concatenate([[0.0], shaken[1:] / self.h]), num, den)
        elif self.restoring is None and self.state_gain is None:
            u = self._linear(shaken, start)
        else:
            u = self._nonlinear(shaken, start)
        return u

    def _linear(self, shaken: np.ndarray, start: float) -> np.ndarray:
        """Trapezoidal rule for du = -alpha (u - setpoint) dt + dM."""
        half = 0.5 * self.h * self.alpha
        force = shaken.copy()
        if self.setpoint is not None:
            force[1:] += self.h * np.broadcast_to(self.alpha, self.n_fine)[1:] * 0.5 * (
                self.setpoint[1:] + self.setpoint[:-1])
            start += self.setpoint[0]
        keep, gain = (1 - half) / (1 + half), 1 / (1 + half)
        force = force * gain
        if np.ndim(keep) == 0:
            force[0] = start
            return lfilter([1.0], [1.0, -keep], force)
        out, u = [start], start
        for a, b in zip(np.asarray(keep).tolist()[1:], force.tolist()[1:], strict=True):
            u = a * u + b
            out.append(u)
        return np.array(out)

    def _nonlinear(self, shaken: np.ndarray, start: float) -> np.ndarray:
        """Heun's method; noise that depends on the state is taken in the sense of Ito."""
        alpha = float(np.mean(self.alpha))
        force = self.restoring or (lambda x: -alpha * x)
        gain = self.state_gain or (lambda x: 1.0)
        target = np.zeros(self.n_fine) if self.setpoint is None else self.setpoint
        h = self.h
        moved = np.diff(target, prepend=target[0]).tolist()
        out, x = [start], start
        for dm, step in zip(shaken.tolist()[1:], moved[1:], strict=True):
            # x is the deviation from the set-point, so a step of the set-point moves x the other
            # way.
            dm = gain(x) * dm - step
            slope = force(x)
            x += 0.5 * h * (slope + force(x + h * slope + dm)) + dm
            out.append(x)
        return np.array(out) + target

    def run(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Simulate the circuit and read the instrument: stamps (s), voltage (V), throttle."""
        work = {name: self.stages.get(name, []) for name in STAGES}
        v = self.level + self.capacitor() + sum(self.series, np.zeros(self.n_fine))
        for front_end in work['front_end']:
            v = front_end(v)
        at = self.lead + self.substeps * np.arange(self.n)
        if self.sample_delay is not None:
            late = np.round(self.sample_delay * self.rate * self.substeps).astype(int)
            at = np.clip(at + late, 0, self.n_fine - 1)
        self.sample_time = self.time[at]
        v = v[at]
        for name in STAGES[1:]:
            for step in work[name]:
                v = step(v)
        t = self.t if self.stamp_error is None else self.t + self.stamp_error
        return t, v, self.samples(self.throttle).copy()


def make_bench(duration: float, rate: float, substeps: int,
               rng: np.random.Generator) -> Bench:
    """Draw a plain rail and a flight: length in s, rate in Hz, fine steps a sample."""
    # Relaxation 20..120 1/s, innovation of 5..30 mV at 1 kHz, level 3.3..25 V.
    flight, draw, path = (np.random.default_rng(rng.integers(2**63)) for _ in range(3))

    def log_uniform(low: float, high: float) -> float:
        return float(np.exp(draw.uniform(np.log(low), np.log(high))))
    commands, pieces = draw_commands(duration, flight)
    alpha, resistance = log_uniform(20.0, 120.0), log_uniform(0.05, 2.0)
    innovation, level = log_uniform(5e-3, 30e-3), log_uniform(3.3, 25.0)
    sigma = innovation * math.sqrt(2 * alpha / (1 - math.exp(-2 * alpha / REFERENCE_RATE)))
    return Bench(rate, duration, substeps, draw, path, resistance, 1 / (alpha * resistance),
                 sigma, level, commands, pieces)


def _hover(n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """Return a level with the small movements that hold a position."""
    keep = np.exp(-1.0 / (UPDATE_RATE * rng.uniform(0.2, 0.8)))
    moves = rng.normal(size=n) * rng.uniform(0.02, 0.06) * np.sqrt(1 - keep**2)
    out = np.empty(n)
    state = 0.0
    for k in range(n):
        state = keep * state + moves[k]
        out[k] = level + state
    return out


def _mission(n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """Return climbs, cruise and descents joined by ramps of a second."""
    out = np.empty(0)
    last = level
    while out.size < n:
        goal = rng.choice([rng.uniform(0.6, 0.85), level, rng.uniform(0.15, 0.3)])
        ramp = int(UPDATE_RATE * rng.uniform(0.3, 1.2)) + 1
        hold = int(UPDATE_RATE * rng.uniform(0.8, 3.0)) + 1
        out = np.concatenate([out, np.linspace(last, goal, ramp), np.full(hold, goal)])
        last = goal
    return out[:n] + 0.01 * rng.normal(size=n)


def _aggressive(n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """Return full movements of the stick every few tenths of a second."""
    out = np.empty(0)
    while out.size < n:
        goal = np.clip(level + rng.normal() * 0.3, 0.05, 0.98)
        out = np.concatenate([out, np.full(int(UPDATE_RATE * rng.uniform(0.15, 0.9)) + 1, goal)])
    return out[:n]


def _chirp(n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """Return the sweep of a system identification flight."""
    t = np.arange(n) / UPDATE_RATE
    low, high = rng.uniform(0.1, 0.4), rng.uniform(2.0, 6.0)
    span = max(n / UPDATE_RATE, 1e-9)
    phase = 2 * np.pi * low * span / np.log(high / low) * ((high / low)**(t / span) - 1)
    return level + rng.uniform(0.12, 0.3) * np.sin(phase)


def _constant(n: int, level: float, rng: np.random.Generator) -> np.ndarray:
    """Return one command, unchanged."""
    return np.full(n, np.clip(level + rng.uniform(-0.15, 0.25), 0.1, 0.9))


PIECES = {'hover': (_hover, 0.3), 'mission': (_mission, 0.25), 'aggressive': (_aggressive, 0.2),
         'chirp': (_chirp, 0.1), 'constant': (_constant, 0.15)}


def draw_commands(duration: float, rng: np.random.Generator) -> tuple[np.ndarray, list[str]]:
    """
    Draw the commands of a flight of a length (s), one for each update, and its pieces in order.

    Throttle, 0..1, has a standard deviation of at least 0.08 and a 2..98 % range of at least 0.3,
    so that effects of throttle are visible.
    """
    n = int(np.ceil(UPDATE_RATE * duration)) + 1
    while True:
        level = rng.uniform(0.3, 0.5)
        pieces: list[np.ndarray] = []
        kinds: list[str] = []
        left = n
        while left > 0:
            kind = str(rng.choice(list(PIECES), p=[weight for _, weight in PIECES.values()]))
            size = int(min(rng.uniform(4.0, 15.0), duration / 3) * UPDATE_RATE) + 1
            pieces.append(PIECES[kind][0](size, level, rng))
            kinds.append(kind)
            left -= size
        raw = np.concatenate(pieces)[:n]
        keep = np.exp(-1.0 / (UPDATE_RATE * STICK_TIME))
        state = raw[0]
        for k in range(n):
            state = keep * state + (1 - keep) * raw[k]
            raw[k] = state
        commands = np.round(np.clip(raw, 0.0, 1.0) / RESOLUTION) * RESOLUTION
        if commands.std() >= 0.08 and np.diff(np.quantile(commands, [0.02, 0.98]))[0] >= 0.3:
            return commands, kinds
