"""The mean falls with throttle: IR drop of battery, leads and regulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from ou_monitor.model.terms.laws import View
from ou_monitor.model.terms.segment import Effect, Segment, Stage
from ou_monitor.model.terms.term import by_parameters, Live, NEXT_TO_ZERO, parameter, Role, Term


@dataclass(frozen=True)
class LoadSag(Term):
    """
    Subtract linear * throttle + square * throttle^2 from the level.

    A square of exactly 0 stands for a straight line, in a fit too.
    """

    NAME: ClassVar[str] = 'load_sag'
    FAMILY: ClassVar[str] = 'load'
    STAGE: ClassVar[Stage] = Stage.LEVEL
    NEEDS_THROTTLE: ClassVar[bool] = True
    ROLE: ClassVar[Role] = Role.MEAN
    # The square is left out of a fit where it is 0.
    LINEAR: ClassVar[tuple[str, ...]] = by_parameters(
        ('linear', 'square'), lambda term: ('linear', 'square') if term.square else ('linear',))
    SIGNS: ClassVar[tuple[str, ...]] = ('throttle',)
    MEASURED: ClassVar[bool] = True
    LIVE: ClassVar[Live] = Live.BY_THROTTLE
    MEANING: ClassVar[str] = (
        'The mean falls with throttle: IR drop of battery, leads and regulator.')
    REMEDY: ClassVar[str] = (
        'Give the estimator throttle, so that it takes the sag out; thicker or shorter leads '
        'reduce it.')
    SEPARATED_BY: ClassVar[str] = 'throttle held for some seconds at several levels'

    linear: float = parameter('V', 'fall at full throttle, linear part')
    square: float = parameter('V', 'fall at full throttle, square part')

    def start(self, rng: np.random.Generator) -> Effect:
        """Begin a simulation."""
        def effect(s: Segment) -> None:
            s.level -= (self.linear + self.square * s.throttle) * s.throttle

        return effect

    @classmethod
    def candidates(cls, view: View) -> Sequence[Term]:
        """Return a straight line and a parabola."""
        return cls(0.0, 0.0), cls(0.0, NEXT_TO_ZERO)
