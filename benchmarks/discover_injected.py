"""
Effects hidden in recorded runs: which of them are named, and whether the run's own causes stay.

Each is hidden in a piece of each recording, at a strength drawn from 1 to 3 (`injected`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
import time
import zlib

from injected import EFFECTS, noise_of
import numpy as np
from ou_monitor import discover
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Recording
from real_flights import BENCHES, FLIGHTS
from tables import table

# Seconds of each recording; what is shorter is taken whole, and so is jd, of one sample a second.
PIECES = {'gecko': (30.0, 60.0), 'nazgul': (40.0, 80.0), 'roma': (40.0, 80.0),
          'bf3s': (0.0, 40.0), 'jd': (0.0, 400.0), 'cf_solo': (10.0, 50.0),
          'cf_pair': (10.0, 50.0), 'cf_takeoff': (0.0, 40.0), 'mm_bench_3': (0.0, 4.0),
          'mm_bench_5': (0.0, 4.0), 'xt_pico_a': (2.0, 6.0)}
# What is hidden; the others of `EFFECTS` are of the sensor, and there or not without a model.
HIDDEN = ('tone', 'slow', 'levels', 'glitches', 'jumps', 'held', 'regimes', 'tails', 'dropouts')
STRENGTHS = (1.0, 3.0)


def pieces(folder: Path, names: Sequence[str]) -> Iterator[tuple[str, Recording]]:
    """Yield the pieces of the recordings that are there."""
    for name, file, options in (*FLIGHTS, *BENCHES):
        if name not in PIECES or (names and name not in names) or not (folder / file).exists():
            continue
        flight = int(options[options.index('--flight') + 1]) if '--flight' in options else None
        whole = read_recording(folder / file, flight=flight)
        first, last = PIECES[name]
        at = whole.t - whole.t[0]
        part = (at >= first) & (at < last)
        yield name, Recording(whole.t[part], whole.voltage[part],
                              whole.throttle[part])


@dataclass(frozen=True)
class Hidden:
    """
    What came of one.

    Attributes
    ----------
    recording, effect : str
        What was hidden where; no effect: the piece as it is.
    strength : float
        Of the effect.
    named, alternatives : tuple of str
        Causes that were named, and those that did as well.
    seconds : float
        CPU time, s.

    """

    recording: str
    effect: str
    strength: float
    named: tuple[str, ...]
    alternatives: tuple[str, ...]
    seconds: float

    def outcome(self, clean: Hidden) -> str:
        """
        Return what came of an effect: 'yes', 'no', or 'there' where nothing can be said.

        It is named where a name that is right for it is in the set and is not, or not as often,
        in that of the piece as it is.
        """
        right = EFFECTS[self.effect][1]
        if any(self.named.count(name) > clean.named.count(name) for name in right) or (
                right & set(self.alternatives) - set(clean.named)):
            return 'yes'
        return 'there' if right & set(clean.named) & set(self.named) else 'no'

    def stays(self, clean: Hidden) -> tuple[int, int]:
        """Return how many causes of the piece as it is are still named, and how many it has."""
        return len(set(clean.named) & set(self.named)), len(set(clean.named))

    def false(self, clean: Hidden) -> tuple[str, ...]:
        """Return what is named that neither was there nor is right."""
        return tuple(sorted(set(self.named) - set(clean.named) - EFFECTS[self.effect][1]))


def found(name: str, effect: str, strength: float, recording: Recording) -> Hidden:
    """Return what `discover` makes of a recording."""
    began = time.process_time()
    causes = discover(recording).causes
    return Hidden(name, effect, strength, tuple(cause.name for cause in causes),
                  tuple(other for cause in causes for other in cause.alternatives),
                  time.process_time() - began)


def examine(folder: Path, names: Sequence[str], effects: Sequence[str], seed: int,
            say: Callable[[str], None]) -> list[Hidden]:
    """Hide each effect in each piece, and return what came of it, the piece as it is first."""
    results = []
    for name, piece in pieces(folder, names):
        clean = found(name, '', 0.0, piece)
        say(f'{name}: {", ".join(clean.named) or "nothing"}; {clean.seconds:.1f} s')
        results.append(clean)
        for effect in effects or HIDDEN:
            rng = np.random.default_rng([seed, zlib.crc32(f'{name} {effect}'.encode())])
            strength = float(rng.uniform(*STRENGTHS))
            hidden = EFFECTS[effect][0](piece, strength * noise_of(piece.voltage), rng)
            one = found(name, effect, strength, hidden)
            kept, had = one.stays(clean)
            say(f'{name} {effect} x{strength:.1f}: {one.outcome(clean)}; '
                f'{", ".join(one.named) or "nothing"}; kept {kept} of {had}; '
                f'{one.seconds:.1f} s')
            results.append(one)
    return results


def injected_table(results: Sequence[Hidden]) -> str:
    """Return the table: a row a recording, a column an effect, and what became of its causes."""
    clean = {one.recording: one for one in results if not one.effect}
    effects = list(dict.fromkeys(one.effect for one in results if one.effect))
    rows, named, counted = [], Counter[str](), Counter[str]()
    kept, had, false = np.zeros(3, dtype=int)
    for name, bare in clean.items():
        mine = {one.effect: one for one in results if one.recording == name and one.effect}
        cells = []
        for effect in effects:
            if effect not in mine:
                cells.append('-')
                continue
            outcome = mine[effect].outcome(bare)
            named[effect] += outcome == 'yes'
            counted[effect] += outcome != 'there'
            cells.append(f'{outcome} ({mine[effect].strength:.1f})')
        stays = np.sum([one.stays(bare) for one in mine.values()], axis=0)
        wrong = [cause for one in mine.values() for cause in one.false(bare)]
        kept, had, false = kept + stays[0], had + stays[1], false + len(wrong)
        most = ', '.join(f'{cause} {many}' for cause, many in Counter(wrong).most_common())
        rows.append([name, *cells, f'{stays[0]} of {stays[1]}', most or '-'])
    rows.append(['named', *(f'{named[effect]} of {counted[effect]}' for effect in effects),
                 f'{kept} of {had}', str(false)])
    total, tried = sum(named.values()), sum(counted.values())
    return table(['recording', *effects, 'own causes kept', 'named beside, times'], rows) + (
        f'\nNamed: {total} of {tried}, {100.0 * total / max(tried, 1):.0f} %; '
        f'own causes kept: {100.0 * kept / max(had, 1):.0f} %.\n')
