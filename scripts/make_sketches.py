#!/usr/bin/env python3
"""
Write the sketches of doc/glossary.md and the two figures of doc/theory.md.

A sketch is a simulated recording of a rail with one of the causes that `discover` names.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from pathlib import Path
import sys

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'benchmarks')]

from common import drawing  # noqa: E402, I100, I202
from ou_monitor.model.supply import SupplyModel  # noqa: E402
from ou_monitor.model.terms.catalogue import catalogue  # noqa: E402
from ou_monitor.paper import published  # noqa: E402

# Cause: its parameters, and the seconds shown.
CAUSES: dict[str, tuple[dict[str, object], float]] = {
    'ou': ({}, 1.0),
    'ac_coupling': ({'corner': 0.6, 'offset': 5.0}, 2.0),
    'clock_jitter': ({'std': 3e-3}, 1.0),
    'drift': ({'rate': -0.12, 'curvature': 0.0}, 4.0),
    'flicker_noise': ({'amplitude': 0.06, 'low': 0.2, 'high': 50.0}, 10.0),
    'glitches': ({'probability': 0.02, 'std': 0.4}, 1.0),
    'heavy_tails': ({'dof': 2.5}, 1.0),
    'held_samples': ({'rate': 60.0}, 0.5),
    'jumps': ({'rate': 3.0, 'mean': -0.3, 'std': 0.05}, 1.0),
    'load_dependent_alpha': ({'slope': -5.0}, 2.0),
    'load_dependent_noise': (
        {'number': (0, 0), 'at': (0.0, 1.0), 'log_factor': (0.0, 1.5)}, 2.0),
    'load_dependent_sigma': ({'throttle': [0.0, 1.0], 'log_factor': [0.0, 2.5]}, 2.0),
    'load_sag': ({'linear': 0.5, 'square': 0.0}, 2.0),
    'load_transient': ({'gain': -0.4, 'tau': 0.1, 'delay': 0.0}, 2.0),
    'lopsided_noise': ({'skew': -0.8, 'tail': 0.8}, 1.0),
    'measurement_noise': ({'std': 0.06}, 1.0),
    'nonlinear_restoring': ({'square': 600.0, 'cube': 9000.0}, 1.0),
    'quantization': ({'step': 0.06}, 0.5),
    'regime_switching': ({'rate_up': 4.0, 'rate_down': 4.0, 'level': -0.3, 'sigma_ratio': 1.0,
                          'at_once': 0.0, 'states': 2.0}, 2.0),
    'resonance': ({'frequency': 30.0, 'damping': 6.0, 'std': 0.08, 'tilt': 0.0}, 1.0),
    'saturation': ({'low': 4.95, 'high': 5.05}, 1.0),
    'second_relaxation': ({'alpha': 3.0, 'sigma': 0.25}, 4.0),
    'throttle_tone': ({'amplitude': 0.1, 'idle': 8.0, 'slope': 40.0, 'phase': 0.0,
                       'linewidth': 0.0}, 1.0),
    'tone': ({'amplitude': 0.1, 'frequency': 20.0, 'phase': 0.0, 'linewidth': 0.0}, 0.5),
    'volatility': ({'std': 1.2, 'rate': 2.0}, 2.0),
}
# Causes that are visible only together with another one; other sketches have only the OU besides.
_SEEN_BY = {'ac_coupling': 'load_sag', 'clock_jitter': 'tone',
            'load_dependent_noise': 'measurement_noise', 'lopsided_noise': 'measurement_noise'}
_POINTS, _WIDTH, _HEIGHT = 300, 240, 64
# The sketches' own style, independent of the benchmarks'.
_STYLE = """<style>
.line { fill: none; stroke-width: 1.6; stroke-linejoin: round; }
.s0 { stroke: #0072b2; } .s7 { stroke: #9aa5a9; }
</style>"""
# Sigma of the OU in a sketch, V/sqrt(s): small, so that the cause is easy to see, except for
# causes that change the OU.
_CALM, _LOUD = 0.15, 0.632
_CHANGES_THE_OU = ('ou', 'saturation', 'nonlinear_restoring', 'held_samples', 'quantization')


def line(x: np.ndarray, y: np.ndarray, style: str) -> str:
    """Return a polyline through points in pixels."""
    points = ' '.join(f'{a:.1f},{b:.1f}' for a, b in zip(x, y))
    return f'<polyline class="line {style}" points="{points}"/>'


def recording(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return voltage and throttle of a rail with one cause."""
    params, seconds = CAUSES[name]
    kinds = catalogue()
    others = [name] if name != 'ou' else []
    if name in _SEEN_BY:
        others.insert(0, _SEEN_BY[name])
    sigma = _LOUD if name in _CHANGES_THE_OU else _CALM
    terms = [kinds['ou'](alpha=published_alpha(), sigma=sigma, u0=5.0)]
    terms += [kinds[other](**(params if other == name else CAUSES[other][0])) for other in others]
    t = np.arange(_POINTS) * seconds / _POINTS
    throttle = np.where((t > 0.3 * seconds) & (t < 0.7 * seconds), 0.8, 0.1)
    return SupplyModel(tuple(terms)).simulate(t, np.random.default_rng(4), throttle), throttle


def published_alpha() -> float:
    """Return the paper's relaxation rate, 1/s."""
    return float(published.ALPHA.value)


def sketch(name: str) -> str:
    """Return the drawing of a cause: voltage, and throttle where the cause needs it."""
    voltage, throttle = recording(name)
    low, high = float(voltage.min()), float(voltage.max())
    x = np.linspace(4, _WIDTH - 4, _POINTS)
    parts = [line(x, _HEIGHT - 6 - (voltage - low) / (high - low) * (_HEIGHT - 12), 's0')]
    if catalogue()[name].NEEDS_THROTTLE or _SEEN_BY.get(name) == 'load_sag':
        parts.insert(0, line(x, _HEIGHT - 4 - throttle * (_HEIGHT - 8), 's7'))
    return drawing(parts, _WIDTH, _HEIGHT, f'A recording with {name}', _STYLE)


def axes(width: int, height: int, texts: Sequence[tuple[float, float, str]]) -> list[str]:
    """Return a frame with labels at their positions."""
    floor = height - 40
    return [f'<polyline class="line s7" points="60,20 60,{floor} {width - 20},{floor}"/>',
            *(f'<text x="{x:.0f}" y="{y:.0f}">{text}</text>' for x, y, text in texts)]


def release() -> str:
    """Return the figure of the voltage after throttle is released, and the fit."""
    alpha, width, height = published_alpha(), 560, 260
    points = [(ms, u.value) for ms, u in zip(published.FIG_5_MS, published.FIG_5_MV)]

    def at(t: float, u: float) -> tuple[float, float]:
        return 60 + t * 9.0, height - 40 - u * 0.5

    t = np.linspace(0.0, 52.0, 100)
    parts = axes(width, height, [
        (300, height - 8, 'ms after release'), (8, 16, 'deviation, mV'),
        (250, 70, f'368 mV exp(-{alpha:g} t): tau = {1e3 / alpha:.1f} ms'),
        *((at(k, 0)[0] - 6, height - 24, f'{k:.0f}') for k in (0, 10, 20, 30, 40, 50)),
        *((26, at(0, u)[1] + 4, f'{u:.0f}') for u in (0, 100, 200, 300))])
    fit = [at(float(a), 368.0 * math.exp(-alpha * 1e-3 * float(a))) for a in t]
    parts.append(line(np.array([p[0] for p in fit]), np.array([p[1] for p in fit]), 's0'))
    parts += [f'<circle cx="{at(*p)[0]:.1f}" cy="{at(*p)[1]:.1f}" r="4" fill="#d55e00"/>'
              for p in points]
    return drawing(parts, width, height, 'Voltage after throttle is released, and its fit')


def load() -> str:
    """Return the figure of the noise over load, with the probability of more than 100 mV."""
    width, height, beyond = 560, 260, 100.0
    rms = [(state.load, state.vrms.value) for state in published.LOADED]
    x = np.array([80 + 1000.0 * u for u, _ in rms])
    y = np.array([height - 40 - 3.0 * v for _, v in rms])
    texts = [(240.0, height - 8.0, 'throttle, %'), (8.0, 16.0, 'rms, mV'),
             *((26.0, height - 36.0 - 3.0 * v, f'{v}') for v in (0, 20, 40, 60))]
    for a, b, (u, v) in zip(x, y, rms):
        sigma = 1e-3 * v * math.sqrt(2.0 * published_alpha())
        chance = 100.0 * math.erfc(beyond / v / math.sqrt(2.0))
        said = f'sigma {sigma:.2f} V/sqrt(s); {chance:.2g} % of the time beyond {beyond:g} mV' \
            if chance > 1e-6 else f'sigma {sigma:.2f} V/sqrt(s); never beyond {beyond:g} mV'
        texts += [(a - 8, height - 24.0, f'{100 * u:.0f}'),
                  (a + 10 if u < 0.4 else a - 345, b + 12 if u < 0.4 else b - 10, said)]
    parts = [*axes(width, height, texts), line(x, y, 's0')]
    parts += [f'<circle cx="{a:.0f}" cy="{b:.1f}" r="4" fill="#d55e00"/>' for a, b in zip(x, y)]
    return drawing(parts, width, height, 'Noise of the supply over throttle')


def main() -> int:
    """Write all drawings."""
    folder = ROOT / 'doc' / 'causes'
    folder.mkdir(exist_ok=True)
    for name in CAUSES:
        (folder / f'{name}.svg').write_text(sketch(name), encoding='utf-8')
    for name, text in (('release', release()), ('load', load())):
        (ROOT / 'doc' / f'theory_{name}.svg').write_text(text, encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
