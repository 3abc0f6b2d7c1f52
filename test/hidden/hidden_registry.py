"""The table of hidden effects; each module of effects enters its own on import."""

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
    """
    One physical realisation of something hidden.

    Attributes
    ----------
    name : str
        ``cause`` for the straightforward realisation, ``cause/shape`` for another one,
        ``unknown/shape`` for what the catalogue does not have.
    cause : str
        Name in the catalogue, or 'unknown'.
    apply : callable
        Changes a bench at a strength; returns the physical parameters. A key 'truth' in what it
        returns overrides the names below.
    truth : tuple of str
        The names that a program must report.
    also : tuple of tuple of str
        Other lists of names that describe this circuit as truly.
    near : tuple of str
        For 'unknown': names that describe a part of it, acceptable beside "not explained".
    substeps : int
        Fine steps a sample that it needs.

    """

    name: str
    cause: str
    apply: Apply
    truth: tuple[str, ...]
    also: tuple[tuple[str, ...], ...] = ()
    near: tuple[str, ...] = ()
    substeps: int = 8


EFFECTS: dict[str, Effect] = {}


def effect(name: str, *, truth: tuple[str, ...] | None = None,
           also: tuple[tuple[str, ...], ...] = (), near: tuple[str, ...] = (),
           substeps: int = 8) -> Callable[[Apply], Apply]:
    """Enter a function into the table; `truth` defaults to its cause, or nothing if unknown."""
    cause = name.partition('/')[0]

    def enter(function: Apply) -> Apply:
        names = truth if truth is not None else () if cause == 'unknown' else (cause,)
        EFFECTS[name] = Effect(name, cause, function, names, also, near, substeps)
        return function
    return enter
