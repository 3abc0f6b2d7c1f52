#!/usr/bin/env python3
"""
How often `analyze` finds what is there, and what is not (10 min).

Recordings of three load levels, 5 s each at 1 kHz, with the paper's alpha, white noise of 3 mV and
a sag; half of them with one thing added.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
import sys

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ou_monitor.analysis.analyze import Analysis, analyze  # noqa: E402
from ou_monitor.model.ou import simulate  # noqa: E402, I100
from ou_monitor.records import FloatArray, Recording  # noqa: E402
from scipy.signal import lfilter  # noqa: E402

ALPHA, RATE, SECONDS = 63.0, 1000.0, 5.0
THROTTLES, SIGMAS = (0.1, 0.3, 0.6), (0.2, 0.4, 0.6)
Effect = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]


def simulated(seed: int, effect: Effect | None = None, alphas: tuple[float, ...] = (ALPHA,) * 3,
              tau: float = 0.0) -> Recording:
    """Return a recording; the sag of 0.5 V times throttle follows with tau, or at once."""
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE)
    t = np.arange(3 * n) / RATE
    which = np.arange(3 * n) // n
    throttle, sigma = np.array(THROTTLES)[which], np.array(SIGMAS)[which]
    target = 5.0 - 0.5 * throttle
    if tau:
        since = np.mod(t, SECONDS)
        before = 5.0 - 0.5 * np.array(THROTTLES)[np.maximum(which - 1, 0)]
        target = target + (before - target) * np.exp(-since / tau)
    parts = [simulate(t[which == k], alphas[k], SIGMAS[k], rng) for k in range(3)]
    voltage = target + np.concatenate(parts) + rng.normal(0.0, 0.003, t.size)
    if effect is not None:
        voltage = voltage + effect(t, sigma / np.sqrt(RATE), rng)
    return Recording(t, voltage, throttle)


def stays(seed: int, sag: float = 0.0, tau: float = 0.03) -> Recording:
    """
    Return six stays of 2.5 s at 0 and 50 %: sigma 0.1 and 0.6, the noise unbroken.

    The sag at 50 %, V, follows with tau; 0: the mean does not respond to throttle at all.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(15.0 * RATE)) / RATE
    loaded = np.floor(t / 2.5) % 2
    phi, slow = np.exp(-ALPHA / RATE), np.exp(-1.0 / (RATE * tau))
    shocks = (0.1 + 0.5 * loaded) * np.sqrt((1.0 - phi * phi) / (2.0 * ALPHA))
    noise = lfilter([1.0], [1.0, -phi], shocks * rng.normal(size=t.size))
    level = 5.0 - sag * lfilter([1.0 - slow], [1.0, -slow], loaded)
    return Recording(t, level + noise + rng.normal(0.0, 0.003, t.size), 0.5 * loaded)


def tone(t: FloatArray, step: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return 1.4 mV rms at a random frequency."""
    return 0.002 * np.sin(2.0 * np.pi * rng.uniform(50.0, 450.0) * t)


def glitches(t: FloatArray, step: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return one sample in 1000 off by eight steps of the noise."""
    return np.where(rng.uniform(size=t.size) < 1e-3, 8.0 * step, 0.0)


def kinds(analysis: Analysis) -> set[str]:
    """Return the words for the levels."""
    return {level.kind.value for level in analysis.levels}


def line(analysis: Analysis) -> bool:
    """Return whether any line was found."""
    return any(level.lines.lines for level in analysis.levels)


def share(count: int, effect: Effect | None, shows: Callable[[Analysis], bool],
          first: int = 0, **options: object) -> str:
    """Return how many recordings show something, in percent."""
    found = sum(shows(analyze(simulated(first + k, effect, **options)))  # type: ignore[arg-type]
                for k in range(count))
    return f'{found} of {count}'


def false_alarms(count: int) -> None:
    """Print what is found in plain OU levels."""
    alarms = {'a word other than diffusion': 0, 'a line': 0, 'alpha differs (stated 5 %)': 0,
              'a transient': 0}
    for seed in range(count):
        found = analyze(simulated(seed))
        alarms['a word other than diffusion'] += kinds(found) != {'diffusion'}
        alarms['a line'] += line(found)
        alarms['alpha differs (stated 5 %)'] += found.alpha_test.verdict == 'differs'
        alarms['a transient'] += any(fit.detected for fit in found.relaxations)
    for what, number in alarms.items():
        print(f'  {what}: {number} of {count}')


def throttle_goes_up_and_down(count: int) -> None:
    """Print what is seen after falls and rises of throttle, where there is a sag and where not."""
    for sag in (0.0, 0.1, 0.3):
        found = [analyze(stays(20_000 + seed, sag)) for seed in range(count)]
        shows = [fit for one in found for fit in one.relaxations if fit.detected]
        falls, rises = (sum(one.relaxations[k].detected for one in found) for k in (0, 1))
        text = f'  sag {sag:g} V: seen after falls in {falls}, after rises in {rises} of {count}'
        if sag:
            holds = sum(fit.tau_low < 0.03 < fit.tau_high for fit in shows)
            text += (f'; {holds} of {len(shows)} intervals hold 30 ms; '
                     f'{sum(fit.badly_fitted for fit in shows)} called badly fitted')
        print(text)


def power(count: int) -> None:
    """Print how often something that is there is found."""
    rows: tuple[tuple[str, Effect | None, Callable[[Analysis], bool], dict[str, object]], ...] = (
        ('tone of 1.4 mV rms: a line', tone, line, {}),
        ('one sample in 1000 off by 8 steps: with impulses', glitches,
         lambda a: 'with impulses' in kinds(a), {}),
        ('alpha 40, 63, 100 1/s: differs', None, lambda a: a.alpha_test.verdict == 'differs',
         {'alphas': (40.0, 63.0, 100.0)}),
        ('sag of 0.10 and 0.15 V with tau = 30 ms: seen', None,
         lambda a: a.relaxations[1].detected, {'tau': 0.03}),
        ('... and its 95 % interval holds 30 ms', None,
         lambda a: a.relaxations[1].tau_low < 0.03 < a.relaxations[1].tau_high, {'tau': 0.03}))
    for name, effect, shows, options in rows:
        print(f'  {name}: {share(count, effect, shows, 10_000, **options)}')


if __name__ == '__main__':
    recordings = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    print(f'False alarms in {recordings} recordings of plain OU levels (stated 1 %):')
    false_alarms(recordings)
    print('Six stays, up and down, sigma 0.1 and 0.6, tau 30 ms:')
    throttle_goes_up_and_down(recordings // 2)
    print('Found where it is there:')
    power(recordings // 4)
