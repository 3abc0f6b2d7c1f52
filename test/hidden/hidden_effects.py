"""
Recordings with a hidden effect, simulated by circuit and instrument.

`draw` makes one; `causes`, `variants` and `unknowns` list the effects. This module uses neither
formulas nor code of the program under test.
"""

from dataclasses import dataclass
from itertools import combinations, product

import effects_lines
import effects_load
import effects_noise
import effects_sensor
import effects_unknown
from hidden_circuit import Bench, FINE_RATE, make_bench
from hidden_registry import Effect, EFFECTS, LABELS as labels
import numpy as np

KINDS = ('single', 'pair', 'none', 'variant', 'unknown')
_MODULES = (effects_lines, effects_load, effects_noise, effects_sensor, effects_unknown)

# Causes that are visible behind a series capacitor, on a rail too slow to relax by itself.
_WITH_AC = {'measurement_noise', 'tone', 'throttle_tone', 'resonance', 'jumps', 'glitches',
            'load_dependent_sigma', 'heavy_tails', 'quantization', 'held_samples', 'saturation'}
# Pairs in which one cause hides, cancels or imitates the other at moderate strength.
_APART = [
    {'load_sag', 'load_transient'},
    {'second_relaxation', 'flicker_noise', 'drift'},
    {'second_relaxation', 'flicker_noise', 'regime_switching'},
    {'volatility', 'regime_switching', 'heavy_tails', 'jumps'},
    {'glitches', 'jumps', 'heavy_tails', 'clock_jitter'},
    {'measurement_noise', 'quantization', 'flicker_noise', 'clock_jitter'},
    {'held_samples', 'tone', 'throttle_tone', 'resonance', 'clock_jitter', 'measurement_noise'},
    {'held_samples', 'glitches', 'heavy_tails', 'jumps'},
    {'nonlinear_restoring', 'load_dependent_alpha', 'saturation', 'regime_switching',
     'flicker_noise', 'second_relaxation'},
    {'drift', 'saturation'}, {'saturation', 'regime_switching'},
    {'load_dependent_sigma', 'volatility'}, {'load_dependent_sigma', 'load_dependent_alpha'},
    {'load_dependent_sigma', 'nonlinear_restoring'}, {'volatility', 'nonlinear_restoring'},
    {'load_dependent_alpha', 'load_transient'},
    *({'load_dependent_noise', other} for other in (
        'load_dependent_sigma', 'load_dependent_alpha', 'volatility', 'regime_switching',
        'measurement_noise', 'clock_jitter', 'quantization', 'held_samples', 'saturation',
        'jumps', 'glitches', 'heavy_tails')),
]


@dataclass(frozen=True)
class Hidden:
    """A recording and what is hidden in it."""

    # Stamps, s.
    t: np.ndarray
    # V.
    voltage: np.ndarray
    # 0..1.
    throttle: np.ndarray
    # Names of the causes, sorted; empty for a plain rail and for unknown effects.
    truth: tuple[str, ...]
    # One of KINDS.
    kind: str
    # Physical parameters of the rail ('rail') and of each effect; 'nats' of an effect is the gain
    # in log-likelihood from knowing its signal.
    detail: dict[str, dict[str, object]]
    # Family of each name in `truth`.
    families: tuple[str, ...]
    # Realisation: names in the table of effects, joined by '+'; 'none' if none.
    name: str
    # Lists of names, sorted, that describe this circuit correctly; `truth` is the first.
    accepted: tuple[tuple[str, ...], ...]
    # For 'unknown': names that describe a part, acceptable beside "not explained".
    near: tuple[str, ...]


def causes() -> tuple[str, ...]:
    """Return the names of the catalogue, each of which has a straightforward realisation."""
    return tuple(labels)


def variants() -> tuple[str, ...]:
    """Return the other realisations, ``cause/shape``."""
    return tuple(name for name, e in EFFECTS.items() if '/' in name and e.cause in labels)


def unknowns() -> tuple[str, ...]:
    """Return the effects outside the catalogue, ``unknown/shape``."""
    return tuple(name for name, e in EFFECTS.items() if e.cause == 'unknown')


def compatible(first: str, second: str) -> bool:
    """Return whether two causes can both be found in one recording."""
    both = {first, second}
    if 'ac_coupling' in both:
        return bool(both & _WITH_AC) and len(both) == 2
    return len(both) == 2 and not any(both <= group for group in _APART)


def pairs() -> tuple[tuple[str, str], ...]:
    """Return the pairs that `draw` can hide."""
    return tuple(pair for pair in combinations(labels, 2) if compatible(*pair))


def _choose(kind: str, cause: str | tuple[str, str] | None,
            rng: np.random.Generator) -> list[Effect]:
    """Return the effects to apply."""
    if kind == 'none':
        if cause is not None:
            raise ValueError(f"cause {cause!r} given, but kind 'none' hides nothing")
        return []
    if kind == 'pair':
        pick = cause if cause is not None else pairs()[rng.integers(len(pairs()))]
        if isinstance(pick, str) or len(pick) != 2 or not compatible(*pick):
            raise ValueError(f'{pick!r} is not a pair of compatible causes; see pairs()')
        names: list[str] = list(pick)
    else:
        table = {'single': causes, 'variant': variants, 'unknown': unknowns}
        if kind not in table:
            raise ValueError(f'kind is {kind!r}; it must be one of {KINDS}')
        known = table[kind]()
        # The name of a cause selects any of its variants.
        fit = [k for k in known if cause is None or k == cause or (
            kind != 'single' and cause in k.split('/'))]
        if not fit:
            raise ValueError(f'{cause!r} is not one of {known}')
        names = [fit[rng.integers(len(fit))]]
    # The coupling replaces the rail, so it comes first: other effects are scaled to the new rail.
    return sorted((EFFECTS[name] for name in names), key=lambda e: e.cause != 'ac_coupling')


def _rail(bench: Bench) -> dict[str, object]:
    """Return the parameters of the plain rail."""
    return {'alpha': bench.alpha0, 'sigma': bench.sigma0, 'resistance_ohm': bench.resistance,
            'capacitance_f': bench.capacitance, 'level_v': bench.level,
            'noise_current_a_sqrt_s': bench.sigma0 * bench.capacitance,
            'innovation_v': bench.innovation, 'stationary_v': bench.stationary,
            'throttle': list(bench.pieces), 'substeps': bench.substeps}


def _plain(value: object) -> object:
    """Return a value in Python's own types, for JSON."""
    if isinstance(value, dict):
        return {key: _plain(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_plain(part) for part in value]
    return value.item() if isinstance(value, np.generic) else value


def draw(kind: str, rng: np.random.Generator, *,
         cause: str | tuple[str, str] | None = None, duration: float = 60.0,
         rate: float = 1000.0, strength: float = 1.0, substeps: int | None = None) -> Hidden:
    """Draw a recording of one of KINDS: rail, flight, effect and noise are drawn from `rng`."""
    # `cause` selects the effect (otherwise any): a cause; for 'pair' two of them; for 'variant'
    # and 'unknown' a name from `variants` or `unknowns`, or the cause or shape in it. Length in s,
    # rate in Hz. Strength 1 is moderate: the right likelihood almost always finds it in a minute
    # at 1 kHz. It scales amplitudes, the logarithms of ratios, and the inverse of degrees of
    # freedom; in addition the strength of each effect varies by 30 % either way. `substeps` are
    # fine steps per sample, by default as many as the effects need.
    if not (duration > 0 and rate > 0 and strength > 0):
        raise ValueError(f'duration {duration} s, rate {rate} 1/s and strength {strength} '
                         'must be positive')
    if duration * rate < 100:
        raise ValueError(f'{duration * rate:.0f} samples; at least 100 are needed')
    chosen = _choose(kind, cause, rng)
    need = max([e.substeps for e in chosen], default=8)
    coarse = int(np.ceil(FINE_RATE / rate))
    bench = make_bench(duration, rate, substeps or max(need, coarse), rng)
    detail = {}
    for e in chosen:
        detail[e.name] = e.apply(bench, strength * bench.draw.uniform(0.7, 1.3))
    detail['rail'] = _rail(bench)
    t, voltage, throttle = bench.run()
    # All names of each effect, combined with all names of the other; the first is the truth.
    accepted = tuple(tuple(sorted({name for names in ways for name in names}))
                     for ways in product(*((e.truth, *e.also) for e in chosen)))
    truth = accepted[0]
    return Hidden(t, voltage, throttle, truth, kind, _plain(detail),
                  tuple(labels[name] for name in truth),
                  '+'.join(e.name for e in chosen) or 'none', accepted,
                  chosen[0].near if chosen else ())
