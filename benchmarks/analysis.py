"""
How often `analyze` finds effects that are there, and effects that are not (10 min).

Recordings of three load levels, 5 s each at 1 kHz, with the paper's alpha, white noise of 3 mV and
a sag; or six stays of 2.5 s at 0 and 50 %, with noise that continues over the changes.
"""

from __future__ import annotations

from collections.abc import Callable
import sys
from typing import Any

from common import arguments, deliver, table
import numpy as np
from ou_monitor.analysis.analyze import Analysis, analyze
from ou_monitor.model.ou import simulate
from ou_monitor.records import FloatArray, Recording
from scipy.signal import lfilter

ALPHA, RATE, SECONDS, TAU = 63.0, 1000.0, 5.0, 0.03
THROTTLES, SIGMAS = (0.1, 0.3, 0.6), (0.2, 0.4, 0.6)
Effect = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]


def levels(seed: int, effect: Effect | None = None, alphas: tuple[float, ...] = (ALPHA,) * 3,
           tau: float = 0.0) -> Recording:
    """Return three levels; the sag of 0.5 V times throttle follows with tau, s, or at once."""
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE)
    t, which = np.arange(3 * n) / RATE, np.arange(3 * n) // n
    throttle, sigma = np.array(THROTTLES)[which], np.array(SIGMAS)[which]
    voltage = 5.0 - 0.5 * throttle
    if tau:
        before = 5.0 - 0.5 * np.array(THROTTLES)[np.maximum(which - 1, 0)]
        voltage = voltage + (before - voltage) * np.exp(-np.mod(t, SECONDS) / tau)
    voltage = voltage + rng.normal(0.0, 0.003, t.size) + np.concatenate(
        [simulate(t[which == k], alphas[k], SIGMAS[k], rng) for k in range(3)])
    if effect is not None:
        voltage = voltage + effect(t, sigma / np.sqrt(RATE), rng)
    return Recording(t, voltage, throttle)


def stays(seed: int, sag: float) -> Recording:
    """Return six stays at 0 and 50 %: sigma 0.1 and 0.6; the sag at 50 %, V, follows with TAU."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(15.0 * RATE)) / RATE
    loaded = np.floor(t / 2.5) % 2
    phi, slow = np.exp(-ALPHA / RATE), np.exp(-1.0 / (RATE * TAU))
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


def kinds(found: Analysis) -> set[str]:
    """Return the process types of the levels."""
    return {level.kind.value for level in found.levels}


def line(found: Analysis) -> bool:
    """Return whether any line was found."""
    return any(level.lines.lines for level in found.levels)


def differs(found: Analysis) -> bool:
    """Return whether alpha is reported to differ."""
    return found.alpha_test.verdict == 'differs'


# False alarms that are counted in plain OU levels.
ALARMS: dict[str, Callable[[Analysis], bool]] = {
    "a process type other than 'diffusion'": lambda found: kinds(found) != {'diffusion'},
    'a line': line, 'alpha differs (stated 5 %)': differs,
    'a transient': lambda found: any(fit.detected for fit in found.relaxations)}
# Effects that are there, and the check that finds them.
THERE: dict[str, tuple[Callable[[Analysis], bool], dict[str, Any]]] = {
    'tone of 1.4 mV rms: a line': (line, {'effect': tone}),
    'one sample in 1000 off by 8 steps: with impulses': (
        lambda found: 'with impulses' in kinds(found), {'effect': glitches}),
    'alpha 40, 63, 100 1/s: differs': (differs, {'alphas': (40.0, 63.0, 100.0)}),
    'sag of 0.10 and 0.15 V with tau = 30 ms: seen': (
        lambda found: found.relaxations[1].detected, {'tau': TAU})}


def sags(sag: float, count: int) -> list[str]:
    """Return the row of stays with a sag."""
    found = [analyze(stays(20_000 + seed, sag)) for seed in range(count)]
    shows = [fit for one in found for fit in one.relaxations if fit.detected]
    after = [sum(one.relaxations[k].detected for one in found) for k in (0, 1)]
    return [f'{sag:g} V', *map(str, after),
            f'{sum(fit.tau_low < TAU < fit.tau_high for fit in shows)} of {len(shows)}',
            str(sum(fit.badly_fitted for fit in shows))]


def main() -> int:
    """Measure and print the tables, or put them into the page."""
    parser = arguments(__doc__)
    parser.add_argument('--recordings', type=int, default=200)
    given = parser.parse_args()
    n = given.recordings
    plain = [analyze(levels(seed)) for seed in range(n)]
    text = table([f'in {n} recordings of plain OU levels', 'found'], [
        [what, str(sum(map(shows, plain)))] for what, shows in ALARMS.items()])
    text += '\n' + table(
        [f'in {n // 2} recordings of six stays, with a sag of', 'relaxation after falls',
         'after rises', 'intervals that hold 30 ms', 'called badly fitted'],
        [sags(sag, n // 2) for sag in (0.0, 0.1, 0.3)])
    text += '\n' + table([f'in {n // 4} recordings with', 'found'], [
        [what, str(sum(shows(analyze(levels(10_000 + k, **options))) for k in range(n // 4)))]
        for what, (shows, options) in THERE.items()])
    deliver(text, given.page, 'analysis')
    return 0


if __name__ == '__main__':
    sys.exit(main())
