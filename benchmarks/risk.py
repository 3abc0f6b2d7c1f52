"""
Predicted and observed frequency of brown-outs of simulated rails (1 h).

    python benchmarks/risk.py --table doc/results/risk.md --figure doc/results/risk_reliability.svg

The flights use no code of the package.  The rail is C dv/dt = (source - v)/R - i(throttle) -
noise, stepped twenty times per sample by the exponential Euler scheme; the lowest point between
two steps is drawn from the Brownian bridge, so that brown-outs of the continuous path are counted.
sigma depends on throttle and drifts; throttle changes in steps; the ADC adds white noise.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date
import json
import math
from pathlib import Path
import sys

from common import deliver, drawing, number, say, table, throttles
import numpy as np
from ou_monitor import brownout_probability
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.report.svg import Plot
from scipy.special import ndtr
from scipy.stats import binomtest

SEED = 20261121
# Flights simulated at once: bounds memory.
_BATCH = 100
# Predictions within this factor of the observed frequency are called calibrated.
_FACTOR = 1.5
# Names that fit into a legend.
_SHORT = {'published risk': 'published', 'window alone, errors averaged': 'window alone',
          'stationary, as the paper': 'paper'}

RATE, FINE = 1000.0, 20
# Throttle of a flight: range of its values, and of their durations, s.
_THROTTLE, _DWELL = (0.15, 0.9), (2.0, 9.0)
# Seconds before the first prediction, and window of the estimator, s.
WARM, WINDOW = 3.0, 2.0
# Samples from one report of the monitor to the next: a slow companion computer.
STEP = 250
PUBLISHED = 'published risk'
# Edges of the bins of predicted probability.
EDGES = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2, 3e-2, 0.1, 0.2, 0.35, 0.5, 0.75, 1.0)


@dataclass(frozen=True)
class Horizon:
    """One prediction and its outcome."""

    flight: int
    t: float  # When it was made, s.
    predicted: dict[str, float]  # Probability by method.
    happened: bool  # Whether the path fell below the level within the horizon.
    steady: bool  # Whether throttle did not change within the horizon.


def predict(flights: Flights, levels: np.ndarray, horizon: float, every: float
            ) -> Iterator[Horizon]:
    """
    Predict each `every` s, over horizons (s) without overlap, with a level (V) for each flight.

    Skip times at which the estimate is not usable or the rail is already below the level.
    """
    count, ahead = flights.t.size, round(horizon * RATE)
    for f, level in enumerate(levels.tolist()):
        # Without a floor, which would replace the risk.
        monitor = SupplyMonitor(MonitorSettings(
            window=WINDOW, brownout_voltage=level, brownout_horizon=horizon, brownout_floor=0.0))
        v, u = flights.voltage[f].astype(np.float64), flights.throttle[f]
        for at in range(STEP, count - ahead, STEP):
            part = slice(at - STEP, at)
            monitor.push(flights.t[part], v[part], u[part])
            report = monitor.report(0.0)
            e = report.estimate
            if at < WARM * RATE or at % round(every * RATE) or not e.usable or (
                    v[at - 1] <= level or flights.path[f, at - 1] <= level):
                continue
            yield Horizon(f, float(flights.t[at - 1]), {
                PUBLISHED: report.risk,
                'window alone, errors averaged': brownout_probability(
                    e, level, horizon, e.voltage),
                # P(|U - U0| > delta): the share of time, both sides.
                'stationary, as the paper': 2.0 * float(
                    ndtr(-(e.u0 - level) / math.sqrt(e.var_inf))),
            }, bool(flights.low[f, at:at + ahead].min() < level),
                bool((u[at:at + ahead] == u[at - 1]).all()))


@dataclass(frozen=True)
class Bin:
    """Similar predictions: their number and mean, and the number of brown-outs."""

    low: float
    high: float
    count: int
    predicted: float
    hits: int

    @property
    def observed(self) -> float:
        """Return the share that happened."""
        return self.hits / self.count

    @property
    def interval(self) -> tuple[float, float]:
        """Return the 95 % interval of the share (Clopper & Pearson 1934)."""
        found = binomtest(self.hits, self.count).proportion_ci(0.95)
        return float(found.low), float(found.high)


def reliability(predicted: np.ndarray, happened: np.ndarray) -> list[Bin]:
    """Return the reliability diagram."""
    bins = []
    for low, high in zip(EDGES[:-1], EDGES[1:]):
        inside = (predicted >= low) & (predicted < (high if high < 1.0 else 2.0))
        if inside.any():
            bins.append(Bin(low, high, int(inside.sum()), float(predicted[inside].mean()),
                            int(happened[inside].sum())))
    return bins


@dataclass(frozen=True, eq=False)
class Flights:
    """Some flights of one length: shape (flights, n), or (flights,)."""

    t: np.ndarray  # s, shape (n,).
    voltage: np.ndarray  # Samples of the ADC, V.
    throttle: np.ndarray
    low: np.ndarray  # Lowest point of the path from the sample before to this one, V.
    path: np.ndarray  # The rail itself at the samples, V.
    # 1/s; level at half throttle, V; stationary deviation there, V.
    alpha: np.ndarray
    level: np.ndarray
    spread: np.ndarray


def fly(rng: np.random.Generator, flights: int, seconds: float) -> Flights:
    """Simulate."""
    n = int(seconds * RATE)
    h = 1.0 / RATE / FINE
    throttle = throttles(rng, flights, n, RATE, _DWELL, _THROTTLE)
    # Components: 20..120 1/s, 20..150 mV.
    resistance = rng.uniform(0.05, 0.4, flights)
    alpha = np.exp(rng.uniform(math.log(20.0), math.log(120.0), flights))
    capacitance = 1.0 / (alpha * resistance)
    spread = np.exp(rng.uniform(math.log(0.02), math.log(0.15), flights))
    intensity = spread * np.sqrt(2.0 * alpha)
    growth = rng.uniform(0.3, 2.0, flights)
    sag = rng.uniform(0.5, 4.0, flights) * spread
    source = 5.0 + sag * 0.5
    adc = rng.uniform(0.0, 0.2, flights) * spread
    log = np.zeros(flights)
    keep = np.exp(-h / (resistance * capacitance))
    v = source - sag * throttle[:, 0] + spread * rng.standard_normal(flights)
    voltage, low, path = (np.empty((flights, n), np.float32) for _ in range(3))
    for k in range(n):
        u = throttle[:, k]
        # ln sigma drifts by 0.08 in a second and returns within a minute.
        log += 0.08 / math.sqrt(RATE) * rng.standard_normal(flights) - log / (60.0 * RATE)
        current = sag * u / resistance
        rest = source - resistance * current
        # White current through the capacitor; its intensity depends on throttle and time.
        sigma = intensity * (1.0 + growth * (u - 0.5)) * np.exp(log)
        lowest = v
        kicks = rng.standard_normal((FINE, flights))
        drops = rng.exponential(size=(FINE, flights))
        step = sigma * math.sqrt(h)
        for kick, drop in zip(kicks, drops):
            after = rest + (v - rest) * keep + step * kick
            # Lowest point of a Brownian bridge: P(min < m) = exp(-2 (a-m)(b-m) / (sigma^2 h)).
            bottom = 0.5 * (v + after - np.sqrt((v - after)**2 + 2.0 * step**2 * drop))
            lowest = np.minimum(lowest, bottom)
            v = after
        voltage[:, k], low[:, k], path[:, k] = v + adc * rng.standard_normal(flights), lowest, v
    return Flights(np.arange(1, n + 1) / RATE, voltage, throttle, low, path, alpha,
                   source - 0.5 * sag, spread)


def predictions(given: argparse.Namespace) -> list[Horizon]:
    """Return all predictions, from the file of lines if it exists."""
    if given.lines and given.lines.exists():
        return [Horizon(**json.loads(line)) for line in given.lines.read_text().splitlines()]
    found: list[Horizon] = []
    for begin in range(0, given.flights, _BATCH):
        rng = np.random.default_rng([given.seed, begin])
        count = min(_BATCH, given.flights - begin)
        flights = fly(rng, count, given.seconds)
        levels = flights.level - flights.spread * rng.uniform(2.5, 7.0, count)
        found += predict(flights, levels, given.horizon, given.horizon)
        say(f'{begin + count} of {given.flights} flights')
    if given.lines:
        given.lines.write_text(''.join(json.dumps(asdict(h)) + '\n' for h in found))
    return found


def calibration(found: Sequence[Horizon], horizon: float) -> tuple[str, str]:
    """Return the tables and a reliability diagram."""
    steady = [h for h in found if h.steady]
    parts = [_reliability_table(
        f'Throttle stays as it is within the horizon: {len(steady)} horizons of '
        f'{horizon:g} s, {sum(h.happened for h in steady)} brown-outs', steady)]
    parts.append(_reliability_table(
        f'Throttle may change within the horizon: {len(found)} horizons, '
        f'{sum(h.happened for h in found)} brown-outs', found))
    return '\n\n'.join(parts), _reliability_figure(steady)


def _columns(found: Sequence[Horizon], method: str) -> tuple[np.ndarray, np.ndarray]:
    return (np.array([h.predicted[method] for h in found]),
            np.array([h.happened for h in found], dtype=float))


def _reliability_table(title: str, found: Sequence[Horizon]) -> str:
    methods = list(found[0].predicted)
    base = float(np.mean([h.happened for h in found]))
    rows = []
    for method in methods:
        predicted, happened = _columns(found, method)
        score = float(np.mean((predicted - happened) ** 2))
        rows.append([method, f'{score:.4f}', f'{1.0 - score / (base * (1.0 - base)):.3f}'])
    text = [f'**{title}**', '', table(['method', 'Brier score', 'skill'], rows), '']
    rows = []
    for b in reliability(*_columns(found, PUBLISHED)):
        low, high = b.interval
        ratio = b.observed / b.predicted
        inside = low <= b.predicted * _FACTOR and high >= b.predicted / _FACTOR
        rows.append([f'{b.low:g}..{b.high:g}', str(b.count), number(b.predicted, '.3g'),
                     number(b.observed, '.3g'), f'{low:.2g}..{high:.2g}', f'{ratio:.2f}',
                     'yes' if 1 / _FACTOR <= ratio <= _FACTOR
                     else 'not refuted' if inside else 'no'])
    return '\n'.join([*text, 'Published risk:', '', table(
        ['predicted', 'horizons', 'mean', 'observed', '95 % interval', 'observed / predicted',
         f'within {_FACTOR:g}'], rows)])


def _reliability_figure(found: Sequence[Horizon]) -> str:
    plot = Plot('Predicted and observed probability of a brown-out', 'predicted', 'observed',
                width=900, height=480, log_x=True, log_y=True)
    line = np.geomspace(1e-4, 1.0, 50)
    plot.line(line, line, '', 7, 'dash')
    plot.band(line, line / _FACTOR, np.minimum(line * _FACTOR, 1.0), f'within {_FACTOR:g}', 7)
    for colour, method in enumerate(found[0].predicted):
        bins = [b for b in reliability(*_columns(found, method)) if b.hits]
        x = np.array([b.predicted for b in bins])
        plot.line(x, np.array([b.observed for b in bins]), _SHORT.get(method, method), colour,
                  'thick')
        if colour == 0:
            for b in bins:
                low, high = b.interval
                plot.line(np.array([b.predicted] * 2), np.array([max(low, 1e-5), high]), '', 0)
    return drawing([plot.svg()], 900, 480, 'reliability')


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--flights', type=int, default=2500)
    parser.add_argument('--seconds', type=float, default=24.0, help='of each flight')
    parser.add_argument('--horizon', type=float, default=2.0, help='s')
    parser.add_argument('--seed', type=int, default=SEED)
    parser.add_argument('--table', type=Path)
    parser.add_argument('--figure', type=Path)
    parser.add_argument('--lines', type=Path,
                        help='results as JSON lines: written, or read where it exists')
    given = parser.parse_args()
    text, figure = calibration(predictions(given), given.horizon)
    text = f'{date.today().isoformat()}, seed {given.seed}.\n\n{text}'
    deliver(text, given.table, 'calibration')
    if given.figure:
        given.figure.write_text(figure, encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
