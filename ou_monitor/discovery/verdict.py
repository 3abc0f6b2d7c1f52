"""The verdict on a recording: what its causes leave, its falls, and where parameters stand."""

from __future__ import annotations

from collections.abc import Sequence

from ou_monitor.discovery.finding import Criticism, CrossingRate, Verdict
from ou_monitor.model.terms.load_answer import LoadTransient
from ou_monitor.model.terms.term import Term
from ou_monitor.text import listed, number

# Chance that any statistic of a right model lies outside its band.
NOTHING = 0.01
# Step, in a coordinate, that a parameter at the end of its range cannot take.
_STEP = 1e-4


def judge(remaining: Sequence[Criticism], causes: int, doubts: Sequence[str] = ()) -> Verdict:
    """Return the verdict on a number of causes: by what remains, and doubts beside it."""
    if causes == 0:
        return Verdict.UNEXPLAINED if remaining else Verdict.NO_EFFECT
    return Verdict.PARTLY_EXPLAINED if remaining or doubts else Verdict.EXPLAINED


def doubts(terms: Sequence[Term], crossing: CrossingRate, duration: float, step: float,
           larger: bool = False) -> tuple[str, ...]:
    """
    Return what speaks against a model beside its statistics, for people (times in s).

    larger: whether its one-step errors are larger than those of the plain OU.
    """
    found = ['its one-step errors are larger than those of the plain OU'] if larger else []
    if crossing.worse:
        found.append(f'it falls through {number(crossing.level, 4)} V '
                     f'{number(crossing.extended)} times a minute, where '
                     f'{number(crossing.observed)} were measured and the plain OU says '
                     f'{number(crossing.baseline)}')
    ends = [f'{name} of {term.NAME}' for term in terms for name in _at_ends(term, duration, step)]
    if ends:
        found.append(f'{listed(ends)} {"stand" if ends[1:] else "stands"} at the end of the range')
    return tuple(found)


def _at_ends(term: Term, duration: float, step: float) -> list[str]:
    """Return the parameters of a term that stand at the end of their range."""
    if isinstance(term, LoadTransient) and not term.delay:
        return [] if 2.0 * step < term.tau < 0.25 * duration else ['tau']
    return [name for name in term.free()
            if not (_moves(term, name, _STEP) and _moves(term, name, -_STEP))]


def _moves(term: Term, name: str, by: float) -> bool:
    try:
        return term.moved(name, by) != term
    except ValueError:
        return False
