"""
Recordings in which nothing is hidden, of three generators, and what `discover` names all the same.

What every flight has may be in the base: a sag, noise that follows throttle, white noise, steps of
the ADC.  Each of these that was put in is true, whatever is named beyond it is a false alarm.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
import importlib.util
import json
import os
from pathlib import Path
import time
from typing import Any

from discover_tables import Level
from hidden_circuit import FINE_RATE, make_bench, UPDATE_RATE
from hidden_registry import EFFECTS
import numpy as np
from ou_monitor import discover
from ou_monitor.records import Recording
from real_flights import flights
from tables import table

Draw = Callable[[np.random.Generator, float, float], tuple[Recording, tuple[str, ...]]]

# What a base may have, each with a chance of one half.
BASE = ('load_sag', 'load_dependent_sigma', 'measurement_noise', 'quantization')
RATES, DURATIONS = (50, 100, 200, 500, 1000), (20.0, 60.0, 120.0)


@dataclass(frozen=True)
class Null:
    """
    One recording with nothing hidden.

    Attributes
    ----------
    name : str
        Of its generator.
    number : int
        Which of it.
    rate, duration : float
        Hz, s.
    truth : tuple of str
        What is in its base.
    recording : Recording

    """

    name: str
    number: int
    rate: float
    duration: float
    truth: tuple[str, ...]
    recording: Recording


def plain(rng: np.random.Generator, rate: float, duration: float
          ) -> tuple[Recording, tuple[str, ...]]:
    """Draw a plain rail under made throttle."""
    return _run(rng, rate, duration, None, ())


def flown(rng: np.random.Generator, rate: float, duration: float
          ) -> tuple[Recording, tuple[str, ...]]:
    """Draw a base with what flights have under throttle, recorded where there is some."""
    throttle = _recorded()
    base = tuple(name for name in BASE if rng.random() < 0.5)
    return _run(rng, rate, duration, throttle[rng.integers(len(throttle))] if throttle else None,
                base)


def _recorded(known: list[np.ndarray] = []) -> list[np.ndarray]:
    """Return throttle of recorded flights at the rate of commands, read once."""
    folder = os.environ.get('OU_MONITOR_REALDATA')
    if folder is not None and not known:
        for _, recording in flights(Path(folder), []):
            if recording.throttle is not None and recording.n > 1000:
                t = recording.t - recording.t[0]
                at = np.arange(0.0, float(t[-1]), 1.0 / UPDATE_RATE)
                known.append(np.clip(np.interp(at, t, recording.throttle), 0.0, 1.0))
    return known


def _run(rng: np.random.Generator, rate: float, duration: float, throttle: np.ndarray | None,
         base: Iterable[str]) -> tuple[Recording, tuple[str, ...]]:
    bench = make_bench(duration, rate, int(np.ceil(FINE_RATE / rate)), rng)
    if throttle is not None:
        need = bench.commands.size
        again = np.concatenate((throttle, throttle[::-1]))
        begin = int(rng.integers(again.size))
        bench.commands = np.resize(np.roll(again, -begin), need)
        bench.__post_init__()
    truth: set[str] = set()
    for name in base:
        EFFECTS[name].apply(bench, float(np.exp(rng.uniform(np.log(0.3), np.log(3.0)))))
        truth.update(EFFECTS[name].truth)
    t, voltage, held = bench.run()
    return Recording(t, voltage, held, 'null'), tuple(sorted(truth))


def elsewhere(file: Path) -> Draw:
    """Return a generator written elsewhere: `make('null', seed, T)` at 1 kHz, sigma(throttle)."""
    spec = importlib.util.spec_from_file_location('elsewhere', file)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)

    def draw(rng: np.random.Generator, rate: float, duration: float
             ) -> tuple[Recording, tuple[str, ...]]:
        every = round(1000.0 / rate)
        t, throttle, voltage = module.make('null', int(rng.integers(2**31)), T=duration)
        return (Recording(t[::every], voltage[::every], throttle[::every], 'null'),
                ('load_dependent_sigma',))

    return draw


def draw(name: str, make: Draw, seed: int, number: int) -> Null:
    """Draw one recording; all of it comes from seed, generator and number."""
    word = int.from_bytes(sha256(name.encode()).digest()[:8], 'big')
    rng = np.random.default_rng([seed, number, word])
    rate, duration = float(rng.choice(RATES)), float(rng.choice(DURATIONS))
    recording, truth = make(rng, rate, duration)
    return Null(name, number, rate, duration, truth, recording)


def examine(null: Null) -> dict[str, Any]:
    """Discover a recording; return what was named, and what of it is false."""
    began = time.process_time()
    data = discover(null.recording).as_data()
    named = [cause['name'] for cause in data['causes']]
    false = sorted({name for name in named if name not in null.truth})
    return {'generator': null.name, 'number': null.number, 'rate': null.rate,
            'duration': null.duration, 'truth': null.truth, 'verdict': data['verdict'],
            'named': named, 'false': false, 'cpu_s': time.process_time() - began}


def nulls_of(each: int, seed: int, file: Path | None, chosen: Sequence[str] | None,
             lines: Path | None, more: bool) -> Iterator[dict[str, Any]]:
    """Yield the results of all recordings, those known already from their file first."""
    makers: dict[str, Draw] = {'plain': plain, 'flown': flown}
    if file is not None:
        makers['elsewhere'] = elsewhere(file)
    known: dict[tuple[Any, ...], dict[str, Any]] = {}
    if lines is not None and lines.exists():
        for text in lines.read_text().splitlines():
            line = json.loads(text)
            known[line['generator'], line['seed'], line['number']] = line
    for number in range(each):
        for name, make in makers.items():
            if chosen is not None and name not in chosen:
                continue
            line = known.get((name, seed, number))
            if line is None and more:
                line = {**examine(draw(name, make, seed, number)), 'seed': seed}
                if lines is not None:
                    with lines.open('a') as out:
                        out.write(json.dumps(line) + '\n')
            if line is not None:
                yield line


def nulls_table(lines: Sequence[dict[str, Any]]) -> str:
    """Return how many recordings had a false name, by generator."""
    rows = []
    for name in (*dict.fromkeys(line['generator'] for line in lines), 'all'):
        of = [line for line in lines if name in (line['generator'], 'all')]
        wrong = sum(bool(line['false']) for line in of)
        low, high = Level('', '', 0.0, wrong, len(of)).interval
        names = Counter(one for line in of for one in line['false'])
        left = sum(line['verdict'] in ('partly_explained', 'unexplained') for line in of)
        rows.append([name, f'{wrong} of {len(of)}', f'{100 * low:.1f}..{100 * high:.1f} %',
                     ', '.join(f'{one} {many}' if many > 1 else one
                               for one, many in names.items()) or '-', f'{left}',
                     f'{np.median([line["cpu_s"] for line in of]):.1f}'])
    return table(['base', 'with a false name', '95 % interval', 'false names',
                  'something left', 'median CPU s'], rows)
