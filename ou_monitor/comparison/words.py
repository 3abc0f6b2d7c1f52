"""A comparison in words and rows, for a terminal and a page alike."""

from __future__ import annotations

from ou_monitor.comparison.agreement import Agreement, Band, Verdict
from ou_monitor.text import number

# What a model can be fitted to.
_NOTHING_FITTED = (0.0, 0.0)


def headline(found: Agreement) -> str:
    """Return the sentence that a pilot reads first."""
    low = found.lowest
    lowest = (f'lowest voltage is {number(low.median, 4)} V ({number(low.low, 4)} to '
              f'{number(low.high, 4)}), measured {number(low.measured, 4)} V')
    if found.verdict is Verdict.LOOKS_LIKE_IT:
        # Without throttle the path is a level, which explains nothing.
        path = '' if not found.explained > 0.0 else (
            f', and its mean path explains {100.0 * found.explained:.0f} % of the variance')
        return f'{found.verdict.value}: its {lowest}{path}.'
    if 'lowest' in found.words:
        return f'{found.verdict.value}: {found.words}.'
    return f'{found.verdict.value}: {found.words}; the {lowest}.'


def in_short(found: Agreement) -> tuple[str, str]:
    """Return the verdict and the lowest voltages, a line each."""
    low = found.lowest
    said = f': {found.words}' if found.verdict is Verdict.DIFFERS else ''
    return (f'{found.verdict.value}{said}.',
            f'Lowest voltage measured {number(low.measured, 4)} V, simulated '
            f'{number(low.median, 4)} V ({number(low.low, 4)} to {number(low.high, 4)}).')


def parts(found: Agreement) -> str:
    """Return which parts were fitted and simulated."""
    first, last = found.simulated
    simulated = f'simulated {number(first, 4)} to {number(last, 4)} s'
    if found.fitted == _NOTHING_FITTED:
        return f'{simulated} with the model given'
    return f'fitted 0 to {number(found.fitted[1], 4)} s, {simulated}'


def rows(found: Agreement) -> list[tuple[str, str, str, str]]:
    """Return quantity, measured, simulated with its 95 % band, and a remark."""
    def row(name: str, of: Band, digits: int, factor: float = 1.0) -> tuple[str, str, str, str]:
        low, high = sorted((factor * of.low, factor * of.high))
        return (name, number(factor * of.measured, digits),
                f'{number(factor * of.median, digits)} [{number(low, digits)}, '
                f'{number(high, digits)}]', '' if of.inside else 'outside')

    out = [row('lowest voltage, V', found.lowest, 4)]
    out += [row(f'falls through {number(level, 4)} V, 1/min', falls, 3)
            for level, falls in zip(found.levels, found.falls)]
    if found.dip is not None and found.recovery is not None:
        out += [row(f'dip after {found.rises} rises, mV', found.dip, 3, -1e3),
                row('1 s after a rise, mV', found.recovery, 3, -1e3)]
    out += [row(f'rms {number(one.low_hz, 2)} to {number(one.high_hz, 2)} Hz, mV',
                Band(*(max(x, 0.0) ** 0.5 for x in (
                    one.power.measured, one.power.low, one.power.median, one.power.high))), 3,
                1e3) for one in found.spectrum]
    return out


def path_rows(found: Agreement) -> list[tuple[str, str]]:
    """Return what is said of the mean path and of the distribution."""
    thirds = ', '.join(number(1e3 * b, 2) for b in found.bias_by_third)
    return [('Mean path', f'explains {number(100.0 * found.explained, 3)} % of the variance'),
            ('Its rms error', f'{number(1e3 * found.rmse, 3)} mV'),
            ('Its bias', f'{number(1e3 * found.bias, 2)} mV (by thirds {thirds})'),
            ('Distributions', f'{number(found.ks_distance, 2)} apart (KS distance)')]
