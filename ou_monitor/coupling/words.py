"""A coupling in words, for a terminal and a page alike."""

from __future__ import annotations

from ou_monitor.coupling.coupling import Coupling, POWER
from ou_monitor.text import chance, number, p_words


def headline(found: Coupling, signal: str, unit: str) -> str:
    """Return the sentence that a pilot reads first."""
    low, high = found.frequency[0], found.frequency[-1]
    band = f'{number(low, 2)} to {number(high, 2)} Hz'
    if found.seen:
        return (f'{_percent(found.noise_share)} of {signal} from {band} is noise of the supply: '
                f'{number(found.gain)} {_per(unit)}.')
    return (f'No noise of the supply is seen in {signal} from {band}; a gain of '
            f'{number(found.limit)} {_per(unit)} would have been.')


def facts(found: Coupling, unit: str) -> list[tuple[str, str]]:
    """Return what was found, or would have been: pairs of name and words."""
    peak = int(found.coherence.argmax())
    lines = []
    if found.seen:
        low, high = found.gain_ci95
        lines += [('Gain', f'{number(found.gain, 4)} {_per(unit)} (95 %: {number(low, 4)} to '
                   f'{number(high, 4)})'),
                  ('Lag', f'{number(1e3 * found.lag)} ms of the signal behind the voltage '
                   f'(+- {number(2e3 * found.lag_se, 2)} ms)'),
                  ('Share', f'{_percent(found.noise_share)} of the signal in this band'),
                  ('For the filter', f'coupling: {number(abs(found.gain))}')]
    else:
        lines += [('Would be seen', f'a gain of {number(found.limit, 4)} {_per(unit)}, in '
                   f'{100.0 * POWER:.0f} % of such recordings'),
                  ('For the filter', 'no law that follows sigma helps this signal')]
    return [*lines, ('Chance', f'{p_words(found.p_value)}; seen is what is below '
                     f'{chance(found.level)}'),
            ('Largest coherence', f'{number(found.coherence[peak])} (squared) at '
             f'{number(found.frequency[peak])} Hz; by chance up to {number(found.threshold)}')]


def parts(found: Coupling) -> str:
    """Return what was compared."""
    return (f'{found.grid.duration:.4g} s in common, {found.segments:.0f} segments'
            + (', throttle taken out' if found.partial else ''))


def remarks(found: Coupling, notes: tuple[str, ...]) -> list[str]:
    """Return notes of the reader, what was dropped, and cautions."""
    grid = found.grid
    lost = [f'{n} samples of the {what} dropped.' for n, what in
            zip(grid.lost, ('voltage', 'signal')) if n]
    gaps = [f'{grid.gaps} gap{"s" * (grid.gaps != 1)} left out.'] if grid.gaps else []
    return [*notes, *lost, *gaps, *found.notes]


def _per(unit: str) -> str:
    return f'{unit} per V'.lstrip()


def _percent(share: float) -> str:
    return f'{number(100.0 * share, 2)} %'
