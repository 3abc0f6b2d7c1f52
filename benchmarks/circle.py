"""
Whether `compare` and `discover` recognise simulations of models saved by `discover` (25 min).

    OU_MONITOR_REALDATA=FOLDER python benchmarks/circle.py --page doc/results/circle.md

Each model is simulated with the throttle of its own recording and new seeds.  `compare` must
report that the simulation looks like the model; `discover` must find no cause that the model
lacks; a tone that is added to the model must be found at its frequency.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path
import tempfile

from common import arguments, BENCHES, deliver, FLIGHTS, HIRO, recorded, say, table
import numpy as np
from ou_monitor import compare, discover, read_recording, Recording, simulate
from ou_monitor.cli.recorded import model_text
from ou_monitor.comparison.compare import Likeness
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.tones import Resonance, Tone
from ou_monitor.recordings.model_file import read_model

# Five flights and a robot.
MODELS = {**{name: FLIGHTS[name] for name in ('gecko', 'nazgul', 'bf3s', 'cf_solo')},
          'hiro': HIRO, 'mm_bench_3': BENCHES['mm_bench_3']}
# Part of each recording that is simulated, s.
SECONDS = 60.0
# The added tone: its amplitude relative to the rms of the readings' differences, and two
# frequencies relative to the rate, of which the one farther from the model's lines is used.
AMPLITUDE, SHARES = 1.0, (0.23, 0.13)
# Largest relative error of a frequency that counts as found.
NEAR = 1e-3


def saved(name: str, path: Path) -> Recording:
    """Save the model of a recording, and return its first minute."""
    file, flight = MODELS[name]
    # A model file is for throttle.
    recording = replace(
        read_recording(recorded() / file, flight=flight, end=SECONDS), current=None)
    path.write_text(model_text(discover(recording).record, recording))
    return recording


def named(recording: Recording, model: SupplyModel) -> list[str]:
    """Return the causes that `discover` finds and the model lacks."""
    own = {term.NAME for term in model.terms}
    return [cause.name for cause in discover(recording).causes if cause.name not in own]


def row(name: str, seeds: int) -> list[str]:
    """Simulate the model of a recording, and judge the simulations."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / 'model.yaml'
        recording = saved(name, file)
        filed = read_model(file)
    model, foreign = filed.model, Counter[str]()
    alike = clean = found = 0
    rate = 1.0 / float(np.median(np.diff(recording.t)))
    draw = partial(simulate, throttle=recording, rate=rate)
    size = AMPLITUDE * float(np.diff(recording.voltage).std())
    own = [term.frequency for term in model.terms if isinstance(term, (Tone, Resonance))]
    hum = rate * max(SHARES, key=lambda share: min(
        (abs(share * rate - line) for line in own), default=0.0))
    hummed = replace(filed, model=SupplyModel((*model.terms, Tone(size, hum, 0.0, 0.0))))
    for seed in range(seeds):
        drawn = draw(filed, seed=seed).recording
        # The simulations differ for each drawing, so that the verdicts are independent.
        alike += compare(drawn, model, seed=seeds + seed).verdict is Likeness.LOOKS_LIKE_IT
        new = named(drawn, model)
        clean += not new
        foreign.update(new)
        found += any(isinstance(cause.term, Tone) and abs(cause.term.frequency / hum - 1.0) < NEAR
                     for cause in discover(draw(hummed, seed=seed).recording).causes)
        say(name, seed, alike, clean, dict(foreign), found)
    return [name, ', '.join(term.NAME for term in model.terms), f'{alike} of {seeds}',
            f'{clean} of {seeds}', ', '.join(f'{k} {n}' for k, n in foreign.most_common()) or '-',
            f'{found} of {seeds}']


def main() -> None:
    """Measure, and write the page."""
    parser = arguments(__doc__, names=True)
    parser.add_argument('--seeds', type=int, default=20)
    args = parser.parse_args()
    deliver(table(('model of', 'terms', 'looks like it', 'nothing new', 'new', 'tone found'),
                  [row(name, args.seeds) for name in args.names or MODELS]), args.page, 'circle')


if __name__ == '__main__':
    main()
