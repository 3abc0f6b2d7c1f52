"""Gains in words: how large, why not known, why a cause is named without one."""

from __future__ import annotations

from collections.abc import Sequence
import math

from ou_monitor.discovery.finding import Cause
from ou_monitor.text import number, Z95

# What a gain is counted in.
MNAT = ('mnat: a thousandth of a nat of log predictive density. A gain of 1 mnat per sample makes '
        '1000 samples e = 2.7 times as likely as before.')
# What to say where the error of a gain leaves nothing known of it.
VAGUE = ('its error is more than ten times as large as itself, as the first 60 % hardly determine '
         'its parameters.')
# What to say where there is no model to compare with.
NO_OTHER = 'the model cannot be fitted without it.'
# Chance from which a cause cannot be told from none by the part fitted.
_CHANCE = 0.05


def gain_words(gain: float, gain_se: float, why: str = '') -> str:
    """Return the gain in a sentence; one that is not distinguishable from zero is none."""
    if not math.isfinite(gain):
        return 'Its gain cannot be measured on this recording' + (f': {why}' if why else '.')
    size = f'{number(1e3 * gain)} +- {number(1e3 * gain_se, 2)} mnat per sample'
    if gain > Z95 * gain_se:
        return f'Gain on samples not used for the fit: {size}.'
    if gain < -Z95 * gain_se:
        return f'Worse on the part kept, which was not used for the fit: {size}.'
    return f'No measurable gain on samples not used for the fit ({size}).'


def why_named(gain: float, gain_se: float, chance: float) -> str:
    """Return why a cause is named whose gain does not say so; empty where it does."""
    if gain > Z95 * gain_se or not math.isfinite(chance):
        return ''
    if chance > _CHANCE:
        return ('Named by the search, whose evidence is that of the whole recording; models '
                f'fitted on the first 60 %, with and without it, do not show it '
                f'(p = {chance:.2g}).')
    return f'Named for what it explains in the first 60 % (p = {chance:.2g}).'


def overlap_words(causes: Sequence[Cause], gain: float) -> str:
    """
    Return why single gains are larger than that of the whole; empty where none is.

    gain in nats.
    """
    larger = list(dict.fromkeys(
        c.name for c in causes if c.measurable and c.gain > max(gain, 0.0) + Z95 * c.gain_se))
    if not larger:
        return ''
    return (f'Without {" or without ".join(larger)} the rest of the model predicts worse than the '
            'plain OU, so that this gain is larger than that of the whole model: single gains '
            'overlap and do not add up.')


def unmeasured_words(fewest: int, scored: int, throttle: bool) -> str:
    """Return why a gain cannot be measured, and what recording would measure it."""
    few = f'{scored} samples are left to score it on, fewer than {fewest}'
    if throttle:
        return (f'{few if scored < fewest else "models are fitted on the first 60 % for this"}, '
                'and throttle there does not go through what the rest holds. One that goes '
                'through all of its throttle in both parts would measure it.')
    if scored < fewest:
        return f'{few}. A longer one would measure it.'
    return ('the first 60 %, on which models are fitted for this, do not determine it. A longer '
            'one would measure it.')
