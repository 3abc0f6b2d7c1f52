"""Numbers and lists as words, for every message and page."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math
from string import Template

# Half the width of a 95 % interval of a normal distribution, in standard errors.
Z95 = 1.959963984540054


def printable(text: object, most: int | None = None) -> str:
    """Return a text as one line, unprintable characters escaped, without its middle if long."""
    found = str(text)
    if not found.isprintable():
        found = ''.join(
            c if c.isprintable() else c.encode('unicode_escape', 'surrogatepass').decode('ascii')
            for c in found)
    if most is not None and len(found) > most:
        head = (most - 3) // 3
        found = f'{found[:head]}...{found[len(found) - (most - 3 - head):]}'
    return found


def plain_number(text: str) -> float:
    """Parse a number; unlike `float`, raise ValueError for 5_01 and for non-ASCII digits."""
    if '_' in text or not text.isascii():
        raise ValueError(f"'{printable(text, 60)}' is not a number")
    return float(text)


def some(names: Iterable[str], most: int = 40) -> str:
    """Return at most `most` names in one line, and the number left out."""
    held = list(names)
    more = len(held) - most
    return ', '.join(held[:most]) + (f' and {more} more' if more > 0 else '')


def number(value: float, digits: int = 3) -> str:
    """Return a number with `digits` significant digits, trailing zeros included."""
    if not math.isfinite(value):
        return '-'
    if value == 0.0:
        return '0'
    # The exponent form rounds first: 99.96 is 1.00e+02.
    mantissa, exponent = f'{value:.{digits - 1}e}'.split('e')
    size = int(exponent)
    if -3 <= size < 6:
        return f'{value:.{max(0, digits - 1 - size)}f}'
    return f'{mantissa}e{size}'


def percent(share: float) -> str:
    """Return a share, 0..1, in percent, to two significant digits: '0.056 %', '100 %'."""
    value = float(f'{100.0 * share:.2g}')
    return f'{value:g} %'


def listed(names: Sequence[str]) -> str:
    """Return names as a list in a sentence."""
    return names[0] if len(names) == 1 else ', '.join(names[:-1]) + ' and ' + names[-1]


def filled(text: str, load: str) -> str:
    """Return a text with the name of the load ('none': throttle) for `$load` and `$Load`."""
    name = 'throttle' if load == 'none' else load
    return Template(text).safe_substitute(load=name, Load=name.capitalize())


def counted(count: int, word: str = 'sample') -> str:
    """Return '1 sample', '2 samples'."""
    return f'{count} {word}' if count == 1 else f'{count} {word}s'


def chance(p: float) -> str:
    """Return a probability with two digits, or '< 0.001': smaller ones are not reliable."""
    if not math.isfinite(p):
        return '-'
    return '< 0.001' if p < 0.001 else f'{p:.2g}'


def p_words(p: float) -> str:
    """Return a p-value in a sentence."""
    return f'p {chance(p)}' if p < 0.001 else f'p = {chance(p)}'


def volts(value: float) -> str:
    """Return a difference of voltage in V, or in mV below 1 V."""
    return f'{number(value)} V' if abs(value) >= 1.0 else f'{number(1e3 * value)} mV'


def span_words(start: float | None, end: float | None) -> str:
    """Return 'from 2 s to 5 s'."""
    return f"from {start or 0.0:g} s to {'the end' if end is None else f'{end:g} s'}"


def outside_words(name: str, start: float | None, end: float | None, length: float) -> str:
    """Return the error message for a part without samples (length of the recording in s)."""
    return f'{name} holds no sample {span_words(start, end)}: it lasts {length:.3f} s'


def part_words(start: float | None, end: float | None) -> str:
    """Return the note that only a part was read."""
    return (f'Only the part {span_words(start, end)} of the recording was read; times in the '
            'report count from the start of this part.')
