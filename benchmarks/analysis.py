"""
How often `analyze` detects real effects, and how often it raises false alarms (10 min).

Recordings of three load levels, 5 s each at 1 kHz, with the paper's alpha, white noise of 3 mV and
a sag.
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

ALPHA, RATE, SECONDS = 63.0, 1000.0, 5.0
THROTTLES, SIGMAS = (0.1, 0.3, 0.6), (0.2, 0.4, 0.6)
Effect = Callable[[FloatArray, FloatArray, np.random.Generator], FloatArray]


def levels(seed: int, effect: Effect | None = None,
           alphas: tuple[float, ...] = (ALPHA,) * 3) -> Recording:
    """Return three levels, with a sag of 0.5 V times throttle."""
    rng = np.random.default_rng(seed)
    n = int(SECONDS * RATE)
    t, which = np.arange(3 * n) / RATE, np.arange(3 * n) // n
    throttle, sigma = np.array(THROTTLES)[which], np.array(SIGMAS)[which]
    voltage = 5.0 - 0.5 * throttle + rng.normal(0.0, 0.003, t.size) + np.concatenate(
        [simulate(t[which == k], alphas[k], SIGMAS[k], rng) for k in range(3)])
    if effect is not None:
        voltage = voltage + effect(t, sigma / np.sqrt(RATE), rng)
    return Recording(t, voltage, throttle)


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
    'a line': line, 'alpha differs (stated 5 %)': differs}
# Effects in the recordings, and the check that should detect each.
THERE: dict[str, tuple[Callable[[Analysis], bool], dict[str, Any]]] = {
    'tone of 1.4 mV rms: a line': (line, {'effect': tone}),
    'one sample in 1000 off by 8 steps: with impulses': (
        lambda found: 'with impulses' in kinds(found), {'effect': glitches}),
    'alpha 40, 63, 100 1/s: differs': (differs, {'alphas': (40.0, 63.0, 100.0)})}


def main() -> int:
    """Measure and print the tables, or put them into the page."""
    parser = arguments(__doc__)
    parser.add_argument('--recordings', type=int, default=200)
    given = parser.parse_args()
    n = given.recordings
    plain = [analyze(levels(seed)) for seed in range(n)]
    text = table([f'in {n} recordings of plain OU levels', 'found'], [
        [what, str(sum(map(shows, plain)))] for what, shows in ALARMS.items()])
    text += '\n' + table([f'in {n // 4} recordings with', 'found'], [
        [what, str(sum(shows(analyze(levels(10_000 + k, **options))) for k in range(n // 4)))]
        for what, (shows, options) in THERE.items()])
    deliver(text, given.page, 'analysis')
    return 0


if __name__ == '__main__':
    sys.exit(main())
