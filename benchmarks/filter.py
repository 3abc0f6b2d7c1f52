r"""
The adaptive low-pass against hindsight, against the truth, in a loop (15 min).

    python benchmarks/filter.py error --table doc/results/filter.md
    python benchmarks/filter.py dterm --table doc/results/filter.md \
        --figure doc/results/filter_dterm.svg
    python benchmarks/filter.py loop --table doc/results/filter.md \
        --figure doc/results/filter_loop.svg
    python benchmarks/filter.py flight --figure doc/results/filter_flight.svg
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from datetime import date
from pathlib import Path
import sys
import time

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from common import deliver, drawing  # noqa: E402
import control_loop  # noqa: E402
import filter_error  # noqa: E402
from filter_error import CASES, fly, RATE  # noqa: E402
import numpy as np  # noqa: E402
from ou_monitor.report.svg import Plot  # noqa: E402

SEED = 20261121


def _tell() -> Callable[[str], None]:
    """Return what says on standard error where a run is."""
    begin = time.monotonic()
    return lambda what: print(f'{time.monotonic() - begin:6.0f} s  {what}', file=sys.stderr)


def _drawing(plots: list[tuple[Plot, int, int]], title: str) -> str:
    """Return plots one below the other as a document that stands alone, on white."""
    width, height = max(w for _, w, _ in plots), sum(h for *_, h in plots)
    parts, top = [], 0
    for plot, wide, high in plots:
        parts.append(plot.svg().replace(
            '<svg ', f'<svg x="0" y="{top}" width="{wide}" height="{high}" ', 1))
        top += high
    return drawing(parts, width, height, title)


def error(given: argparse.Namespace) -> tuple[str, str]:
    """Mean square error and lag of every law over simulated flights."""
    return filter_error.render(filter_error.errors(
        given.flights, given.seconds, given.seed, given.window, _tell())), ''


def dterm(given: argparse.Namespace) -> tuple[str, str]:
    """Noise of the D term against its lag."""
    text, plot = filter_error.render_dterm(filter_error.run_dterm(
        given.flights, given.seconds, given.seed, given.window, _tell()))
    return text, _drawing([(plot, 760, 360)], 'D term: noise against lag')


def loop(given: argparse.Namespace) -> tuple[str, str]:
    """Where the loop through the supply begins to hunt."""
    text, plot = control_loop.render(control_loop.scan(given.seconds, given.seed, _tell()))
    return text, _drawing([(plot, 760, 380)], 'Swing of the cutoff against coupling')


def flight(given: argparse.Namespace) -> tuple[str, str]:
    """Voltage, sigma, cutoff and signal over a flight."""
    case = CASES[2]
    many = fly(case, np.random.default_rng([given.seed, 200]), 8, given.seconds)
    # Of eight flights the one whose noise changes most: there is most to be seen.
    change = np.quantile(np.log(many.sigma), 0.9, 1) - np.quantile(np.log(many.sigma), 0.1, 1)
    most = int(np.argmax(change))
    flown = replace(many, **{
        name: getattr(many, name)[most:most + 1] for name in
        ('throttle', 'sigma', 'voltage', 'truth', 'slope', 'measured', 'noise')})
    seen = filter_error.estimates(flown, given.window)
    output, cutoff = filter_error.adaptive(filter_error.laws(case)['kalman'][0], flown, seen,
                                           flown.measured)
    fixed = np.geomspace(*case.limits, 41)
    outputs = filter_error.sweep(flown.measured, fixed[:, None, None], case.order)
    best = int(np.argmin(filter_error.error(outputs, flown.truth)[:, 0]))
    t, every = flown.t, slice(None, None, 10)

    def plot(title: str, unit: str, height: int = 190, log_y: bool = False) -> Plot:
        return Plot(title, 'time, s', unit, width=860, height=height, log_y=log_y)

    def rms(of: np.ndarray) -> np.ndarray:
        return np.sqrt(np.convolve((of - flown.truth[0])**2, np.full(500, 1 / 500), 'same'))[every]
    throttle = plot('Throttle', '0..1', 130).line(t[every], flown.throttle[0, every], '', 6,
                                                  'thick')
    volts = plot('Voltage of the supply', 'V').line(t, flown.voltage[0])
    sigmas = plot('Noise intensity', 'V/sqrt(s)', log_y=True).line(
        t[every], flown.sigma[0, every], 'true', 7, 'dash')
    sigmas.line(t[every], seen[0, 0, every], f'estimated, window {given.window:g} s', 1, 'thick')
    cutoffs = plot('Cutoff', 'Hz', log_y=True).line(
        t[every], cutoff[0, every], 'that lags as much, law kalman', 1, 'thick')
    cutoffs.line(t[[0, -1]], np.full(2, fixed[best]), 'best fixed in hindsight', 2, 'dash')
    errors = plot('Error against the true body rate, rms of half a second', 'rad/s', 220, True)
    errors.line(t[every], rms(flown.measured[0]), 'unfiltered', 7)
    errors.line(t[every], rms(outputs[best, 0]), 'best fixed', 2, 'thick')
    errors.line(t[every], rms(output[0]), 'adaptive', 1, 'thick')
    step = np.abs(np.log(flown.sigma[0, 500:] / flown.sigma[0, :-500]))[3500:-2000]
    at = 3250 + int(np.argmax(step))
    piece = slice(at, at + int(2 * RATE))
    close = plot('Body rate, two seconds around the largest change of sigma', 'rad/s', 260)
    close.line(t[piece], flown.measured[0, piece], 'measured', 7, 'faint')
    close.line(t[piece], flown.truth[0, piece], 'true', 0, 'thick')
    close.line(t[piece], output[0, piece], 'filtered', 1, 'thick')
    return '', _drawing([(throttle, 860, 130), (volts, 860, 190), (sigmas, 860, 190),
                         (cutoffs, 860, 190), (errors, 860, 220), (close, 860, 260)],
                        'Voltage, sigma, cutoff and signal over a flight')


def _write(given: argparse.Namespace, text: str, figure: str) -> None:
    if given.table and text:
        stamp = f'{date.today().isoformat()}, seed {given.seed}, {given.seconds:g} s each.'
        deliver(f'{stamp}\n\n{text}', given.table, given.part)
    elif text:
        print(text)
    if given.figure and figure:
        given.figure.write_text(figure, encoding='utf-8')


def main() -> int:
    """Parse arguments, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parts = parser.add_subparsers(dest='part', required=True)
    for action, flights, seconds in ((error, 10, 40.0), (dterm, 10, 40.0), (loop, 1, 30.0),
                                     (flight, 1, 30.0)):
        part = parts.add_parser(action.__name__, help=action.__doc__)
        part.set_defaults(action=action)
        part.add_argument('--flights', type=int, default=flights)
        part.add_argument('--seconds', type=float, default=seconds, help='of each flight')
        part.add_argument('--window', type=float, default=2.0, help='of the estimator, s')
        part.add_argument('--seed', type=int, default=SEED)
        part.add_argument('--table', type=Path)
        part.add_argument('--figure', type=Path)
    given = parser.parse_args()
    _write(given, *given.action(given))
    return 0


if __name__ == '__main__':
    sys.exit(main())
