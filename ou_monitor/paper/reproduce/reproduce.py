"""All rows, points and figures, from one seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from ou_monitor.paper.reproduce import (
    averaging, crest, jumps, network, probability, switching, table1, table2, transient)
from ou_monitor.paper.reproduce.crest import Crests
from ou_monitor.paper.reproduce.figures import draw, Figures
from ou_monitor.paper.reproduce.points import eight_points, Point
from ou_monitor.paper.reproduce.row import Row
from ou_monitor.paper.reproduce.switching import Spreading

Progress = Callable[[float], None]
# Independent stretches of half a second, so that the 95 % quantile is known to 0.03; and
# seconds with jumps.
CREST_PATHS, JUMP_SECONDS = 4000, 100.0
# In the order of the paper.
_ORDER = ('Section 3.1', 'Section 3.3', 'Section 4.1', 'Section 4.2', 'Section 4.4',
          'Section 4.5', 'Table 1', 'Fig. 5', 'Section 5', 'Table 2', 'Section 6', 'Section 8')


@dataclass(frozen=True, eq=False)
class Reproduction:
    """
    Result of `reproduce`.

    Attributes
    ----------
    seed : int
        Of all random numbers.
    rows : tuple of Row
        In the order of the paper.
    points : tuple of Point
        The eight points.
    crests : Crests
        Simulated crest factors.
    spreading : Spreading
        Variance of the integral of telegraph noise.
    figures : Figures
        Further series to draw.

    """

    seed: int
    rows: tuple[Row, ...]
    points: tuple[Point, ...]
    crests: Crests
    spreading: Spreading
    figures: Figures

    def parts(self) -> list[tuple[str, list[Row]]]:
        """Return the rows by table, figure and whole section of the paper, none of them empty."""
        found: dict[str, list[Row]] = {}
        for row in self.rows:
            # 'Section 4.5' belongs to 'Section 4'; 'Fig. 5' stays.
            found.setdefault(row.where.rsplit('.', 1)[0] if row.where.startswith('Section')
                             else row.where, []).append(row)
        return list(found.items())


def reproduce(seed: int = 1, progress: Progress | None = None) -> Reproduction:
    """Recompute the paper (progress 0..1)."""
    tell: Progress = progress or (lambda share: None)

    def within(start: float, stop: float) -> Progress:
        return lambda share: tell(start + share * (stop - start))

    # Each part has its own generator, so that none depends on what others draw.
    rngs = np.random.default_rng(seed).spawn(8)
    crests = crest.simulate_crests(rngs[0], CREST_PATHS, within(0.0, 0.35))
    found = jumps.simulate_jumps(rngs[1], JUMP_SECONDS, within(0.35, 0.6))
    rows = [*table1.rows(*crest.mean_and_error(crests.white)), *crest.rows(crests),
            *table2.rows(), *network.rows(), *jumps.rows(found, crests)]
    rows += transient.rows(rngs[2])
    tell(0.76)
    rows += probability.rows(rngs[3])
    tell(0.8)
    rows += switching.rows(rngs[4])
    tell(0.86)
    rows += averaging.rows(rngs[5])
    spreading = switching.spreading(rngs[6], 20_000)
    tell(0.92)
    figures = draw(rngs[7])
    tell(1.0)
    ordered = tuple(sorted(rows, key=lambda row: _ORDER.index(row.where)))
    return Reproduction(seed, ordered, eight_points(ordered, crests, found), crests, spreading,
                        figures)
