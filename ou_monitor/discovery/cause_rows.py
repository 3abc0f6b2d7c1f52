"""The causes as rows of a table, for the terminal and the page: terms of one gain are one row."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

from ou_monitor.discovery.finding import Cause
from ou_monitor.discovery.words import parameters
from ou_monitor.text import number, Z95

NOT_KNOWN = 'not known'
# Chance from which a cause cannot be told from none by the part fitted.
_CHANCE = 0.05


@dataclass(frozen=True)
class CauseRow:
    """
    One row: a cause, or several terms of one kind that share a gain.

    Attributes
    ----------
    name : str
        Of the cause.
    label : str
        The same, and how many terms there are when more than one.
    family : str
        Of the catalogue.
    gain : str
        mnat per sample with its standard error, or that it is not known.
    remark : str
        What to make of the gain, and why the cause is named; empty when it is one.
    chance : str
        p, ``exact``, or that it is not known.
    alternatives : tuple of str
        Causes that cannot be told from it.
    estimates : tuple of str
        Parameters of each term, with units and standard errors.
    explanation : str
        For people; lists the parameters of each term.

    """

    name: str
    label: str
    family: str
    gain: str
    remark: str
    chance: str
    alternatives: tuple[str, ...]
    estimates: tuple[str, ...]
    explanation: str


def cause_rows(causes: Sequence[Cause]) -> list[CauseRow]:
    """Return the rows of the table of causes."""
    # By the text of the numbers: NaN is not equal to itself.
    groups: dict[tuple[str, ...], list[Cause]] = {}
    for cause in causes:
        key = (cause.name, repr(cause.gain), repr(cause.gain_se), _chance(cause))
        groups.setdefault(key, []).append(cause)
    return [CauseRow(
        group[0].name, group[0].name if len(group) == 1 else f'{group[0].name} x{len(group)}',
        group[0].term.FAMILY, gain_text(group[0].gain, group[0].gain_se),
        _remark(group[0]), _chance(group[0]),
        tuple(dict.fromkeys(name for cause in group for name in cause.alternatives)),
        tuple(parameters(cause.term, cause.se) for cause in group),
        _explanation(group)) for group in groups.values()]


def gain_text(gain: float, gain_se: float) -> str:
    """Return a gain given in nats, in mnat, with its standard error as far as it is known."""
    if not math.isfinite(gain):
        return NOT_KNOWN
    if not math.isfinite(gain_se):
        return f'{number(1e3 * gain)}, error {NOT_KNOWN}'
    return f'{number(1e3 * gain)} +- {number(1e3 * gain_se, 2)}'


def gain_remark(gain: float, gain_se: float) -> str:
    """Return what to make of a gain; nothing when it is one, or is not known."""
    if not (math.isfinite(gain) and math.isfinite(gain_se)) or gain > Z95 * gain_se:
        return ''
    if gain < -Z95 * gain_se:
        return 'worse on the part kept'
    return 'not distinguishable from none'


def _remark(cause: Cause) -> str:
    """Return what to make of the gain of a cause, and why it is named all the same."""
    remark = gain_remark(cause.gain, cause.gain_se) if math.isfinite(cause.gain) else (
        'not measurable here')
    if cause.exact or not remark:
        return remark
    first = math.isfinite(cause.p_value) and cause.p_value <= _CHANCE
    return remark + ('; named for what it explains in the first 60 %' if first
                     else '; named by the search on the whole recording')


def _chance(cause: Cause) -> str:
    if cause.exact:
        return 'exact'
    return f'{cause.p_value:.2g}' if math.isfinite(cause.p_value) else NOT_KNOWN


def _explanation(group: Sequence[Cause]) -> str:
    """Return the explanation of the first, with the estimates of all."""
    first = group[0]
    if len(group) == 1:
        return first.explanation
    own = f'Estimate: {parameters(first.term, first.se)}.'
    every = ' '.join(f'({k}) {parameters(cause.term, cause.se)}.'
                     for k, cause in enumerate(group, 1))
    if own not in first.explanation:
        return f'{first.explanation} Estimates: {every}'
    return first.explanation.replace(own, f'Estimates: {every}', 1)
