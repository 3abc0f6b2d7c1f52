"""Throttle commands as of pilots and autopilots, drawn at random."""

import numpy as np

UPDATE_RATE = 50.0      # 1/s: RC links and autopilots renew the command 50 times a second
RESOLUTION = 1e-3       # a PWM command of 1000..2000 us in whole microseconds
STICK_TIME = 0.06       # s: a hand does not move a stick faster


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


KINDS = {'hover': (_hover, 0.3), 'mission': (_mission, 0.25), 'aggressive': (_aggressive, 0.2),
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
            kind = str(rng.choice(list(KINDS), p=[weight for _, weight in KINDS.values()]))
            size = int(min(rng.uniform(4.0, 15.0), duration / 3) * UPDATE_RATE) + 1
            pieces.append(KINDS[kind][0](size, level, rng))
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
