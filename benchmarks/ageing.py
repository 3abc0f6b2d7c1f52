"""
Verdicts on flights compared with a saved model: aged packs, recorded pairs (5 min per model).

`aged`: a model is learned from one simulated flight and compared with 60 s of others, which have
1, 1.1, 1.2 and 1.4 times the sag and start at three places of the recorded throttle, and with 6 s
at three quarters of the voltage. A verdict at any second counts, not only the last. `pairs`: two
recorded flights of one craft, or the halves of one flight, are each compared with the model of the
other; the verdict at the last sample is reported, and whether it was WEAKER at any second. Needs
`OU_MONITOR_REALDATA`.

    python benchmarks/ageing.py aged models/gecko.yaml:bags/recorded/gecko.csv --page PAGE
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations
import math
from pathlib import Path

from common import arguments, deliver, FLIGHTS, flights, HIRO, table
import numpy as np
from ou_monitor.model.load import LoadStart
from ou_monitor.model.supply import SupplyModel
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.model_watch import ModelComparison, ModelVerdict
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Recording
from ou_monitor.simulation import recorded_throttle, simulated

# Sampling rate, Hz; lengths of the flight for learning and of the compared flights, s.
RATE, TAUGHT, LENGTH = 100.0, 120.0, 60.0
AGES, PLACES = (1.0, 1.1, 1.2, 1.4), (0.0, 1.0 / 3.0, 2.0 / 3.0)
# Recorded flights by craft; a craft with one flight is compared by its halves.
CRAFTS: dict[str, dict[str, tuple[str, int | None]]] = {
    'gecko': {'gecko': FLIGHTS['gecko']}, 'nazgul': {'nazgul': FLIGHTS['nazgul']},
    'hiro': {'hiro': HIRO}, 'erle': {'erle': FLIGHTS['erle']},
    'roma': {f'roma {k}': (FLIGHTS['roma'][0], k) for k in (1, 2, 3)},
    'cf': {'Crazyflie alone': FLIGHTS['cf_solo'], 'Crazyflie in a pair': FLIGHTS['cf_pair']}}


def seconds(made: Recording, start: LoadStart, factor: float = 1.0) -> Iterator[ModelComparison]:
    """Compare a flight, its voltages scaled, with a model; yield the result of each second."""
    loads = LoadFilter()
    loads.begin_with(start)
    edges = np.searchsorted(made.t, np.arange(made.t[0], made.t[-1] + 1.0))
    for first, last in zip(edges, edges[1:]):
        part = slice(first, last)
        loads.push(made.t[part], factor * made.voltage[part], made.throttle[part])
        yield loads.against(start)


def learned(made: Recording) -> LoadStart | None:
    """Return the model learned from a flight."""
    loads = LoadFilter()
    loads.push(made.t, made.voltage, made.throttle)
    return loads.learned()


def aged(model: SupplyModel, flown: Recording, name: str, seeds: int) -> list[list[str]]:
    """Return a row for each age."""
    throttle = recorded_throttle(flown, name)

    def flight(seed: int, age: float = 1.0, place: float = 0.0,
               length: float = LENGTH) -> Recording:
        (made,) = simulated(
            model, lambda t: throttle((t + place * flown.duration) % flown.duration),
            duration=length, rate=RATE, seed=seed, charge=math.nan, resistance=age)
        return made

    found: dict[float, list[tuple[float, float, float]]] = {age: [] for age in AGES}
    other = runs = 0
    for taught in range(seeds):
        start = learned(flight(1000 + taught, length=TAUGHT))
        if start is None:
            continue
        for place in PLACES:
            runs += 1
            *_, last = seconds(flight(taught, 1.0, place, 6.0), start, 0.75)
            other += last.verdict is ModelVerdict.OTHER_PACK
            for age in AGES:
                said = list(seconds(flight(taught, age, place), start))
                weaker = [k for k, one in enumerate(said, 1) if one.verdict is ModelVerdict.WEAKER]
                found[age].append((said[-1].sag_ratio, said[-1].noise_ratio,
                                   weaker[0] if weaker else math.inf))
    rows = []
    for age, one in found.items():
        ratio, noise, at = np.array(one).T
        rows.append([
            name, f'{age:g}', f'{np.isfinite(at).sum()} of {len(one)}',
            f'{np.median(at):.0f}' if np.isfinite(np.median(at)) else '-',
            f'{np.nanmean(ratio):.2f} ± {np.nanstd(ratio):.2f}',
            f'{np.nanmean(noise):.2f} ± {np.nanstd(noise):.2f}',
            f'{other} of {runs}' if age == 1.0 else ''])
    return rows


def half(made: Recording, second: bool) -> Recording:
    """Return a half of a recording."""
    part = (made.t >= 0.5 * (made.t[0] + made.t[-1])) == second
    return Recording(made.t[part], made.voltage[part], made.throttle[part], made.name)


def pairs() -> list[list[str]]:
    """Return two rows for each recorded pair, one in each direction."""
    rows = []
    for craft in CRAFTS.values():
        parts = list(flights(of=craft))
        if len(parts) == 1:
            (name, made), = parts
            parts = [(f'{name}, first half', half(made, False)),
                     (f'{name}, second half', half(made, True))]
        for (then, first), (now, second) in permutations(parts, 2):
            start = learned(first)
            if start is None:
                rows.append([now, then, '-', '-', 'the model has no load', ''])
                continue
            said = list(seconds(second, start))
            last, ever = said[-1], any(one.verdict is ModelVerdict.WEAKER for one in said)
            rows.append([now, then, f'{last.sag_ratio:.2f} ± {last.sag_ratio_se:.2f}',
                         f'{last.noise_ratio:.2f} ± {last.noise_ratio_se:.2f}',
                         last.verdict.name, 'yes' if ever else ''])
    return rows


def main() -> int:
    """Measure, and print the tables, or put them into the page."""
    parser = arguments(__doc__)
    parser.add_argument('what', choices=('aged', 'pairs'))
    parser.add_argument('runs', nargs='*', metavar='MODEL.yaml:RECORDING')
    parser.add_argument('--seeds', type=int, default=10)
    options = parser.parse_args()
    if options.what == 'aged':
        rows = []
        for run in options.runs:
            path, _, recording = run.partition(':')
            rows += aged(read_model(path).model, read_recording(recording), Path(path).stem,
                         options.seeds)
        text = table(('model', 'sag factor', 'ever weaker', 'median s', 'sag now / then',
                      'noise now / then', 'another pack'), rows)
    else:
        text = table(('flight', 'model of', 'sag now / then', 'noise now / then', 'verdict',
                      'ever weaker'), pairs())
    deliver(text, options.page, options.what)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
