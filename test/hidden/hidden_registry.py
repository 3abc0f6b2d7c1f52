"""The table of hidden effects; each module of effects adds its own on import."""

from collections.abc import Callable
from dataclasses import dataclass

from hidden_circuit import Bench

# Families as in section 6 of the contract.
LABELS = {
    'load_dependent_noise': 'intensity',
    'load_sag': 'load', 'load_transient': 'load', 'load_dependent_sigma': 'intensity',
    'load_dependent_alpha': 'restoring', 'drift': 'slow', 'measurement_noise': 'sensor',
    'quantization': 'sensor', 'held_samples': 'sensor', 'saturation': 'sensor',
    'second_relaxation': 'slow', 'resonance': 'line', 'tone': 'line', 'throttle_tone': 'line',
    'ac_coupling': 'instrument', 'jumps': 'events', 'heavy_tails': 'events',
    'glitches': 'events', 'regime_switching': 'switching', 'volatility': 'intensity',
    'nonlinear_restoring': 'restoring', 'flicker_noise': 'slow', 'clock_jitter': 'sensor',
}

Apply = Callable[[Bench, float], dict[str, object]]


@dataclass(frozen=True)
class Effect:
    """One physical realisation of a hidden effect."""

    # ``cause``, ``cause/shape`` for another realisation, ``unknown/shape`` outside the catalogue.
    name: str
    # Name in the catalogue, or 'unknown'.
    cause: str
    # Changes a bench with a given strength; returns the physical parameters.
    apply: Apply
    # Names that a program must report.
    truth: tuple[str, ...]
    # Other lists of names that also describe this circuit correctly.
    also: tuple[tuple[str, ...], ...] = ()
    # For 'unknown': names that describe a part of it, acceptable beside "not explained".
    near: tuple[str, ...] = ()
    # Fine steps per sample that it needs.
    substeps: int = 8


EFFECTS: dict[str, Effect] = {}


def effect(name: str, *, truth: tuple[str, ...] | None = None,
           also: tuple[tuple[str, ...], ...] = (), near: tuple[str, ...] = (),
           substeps: int = 8) -> Callable[[Apply], Apply]:
    """Add a function to the table; `truth` defaults to its cause, or nothing if unknown."""
    cause = name.partition('/')[0]

    def enter(function: Apply) -> Apply:
        names = truth if truth is not None else () if cause == 'unknown' else (cause,)
        EFFECTS[name] = Effect(name, cause, function, names, also, near, substeps)
        return function
    return enter
