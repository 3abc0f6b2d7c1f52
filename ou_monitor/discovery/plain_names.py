"""What a pilot calls a cause, beside its name in code, YAML and JSON; the finding in short."""

from __future__ import annotations

from collections.abc import Sequence
import math
import re

from ou_monitor.discovery.finding import Finding, Verdict
from ou_monitor.discovery.words import gain_words
from ou_monitor.text import listed, number, Z95

PLAIN_NAMES = {
    'ac_coupling': 'an AC-coupled instrument',
    'clock_jitter': 'jitter of the time stamps',
    'drift': 'discharge or warming',
    'flicker_noise': '1/f noise',
    'glitches': 'single bad samples',
    'heavy_tails': 'noise with rare large kicks',
    'held_samples': 'a logger that repeats its last value',
    'jumps': 'kicks of the load',
    'load_dependent_alpha': 'a relaxation that changes with throttle',
    'load_dependent_noise': 'sensor noise that follows throttle',
    'load_dependent_sigma': 'noise that changes with throttle',
    'load_sag': 'sag',
    'load_transient': 'slow recovery after throttle',
    'measurement_noise': 'noise of the sensor',
    'nonlinear_restoring': 'a load of constant power',
    'quantization': 'a coarse ADC',
    'regime_switching': 'two states of the supply',
    'resonance': 'ringing of leads and capacitors',
    'saturation': 'clipping at the end of the ADC',
    'second_relaxation': 'a second time constant',
    'throttle_tone': 'a line that follows the motors',
    'tone': 'a line at a fixed frequency',
    'volatility': 'noise that comes and goes',
}
# As many causes stand in the first sentence; a table has the others.
_FIRST = 3
# Names that are no words of English; the others stand for themselves where they are no cause.
_CODE = re.compile(r'(?<![\w(])(' + '|'.join(
    name for name in sorted(PLAIN_NAMES, key=len, reverse=True) if '_' in name) + r')(?![\w)])')


def plain(text: str, causes: Sequence[str] = ()) -> str:
    """Return a text with what a pilot calls each cause before its name in code."""
    said: set[str] = set()

    def both(found: re.Match[str]) -> str:
        name = found[1]
        if name in said:
            return PLAIN_NAMES[name]
        said.add(name)
        return both_names(name)

    text = _CODE.sub(both, text)
    for name in dict.fromkeys(causes):
        if '_' not in name and name in PLAIN_NAMES:
            text = re.sub(rf'(?<![\w(]){name}(?![\w)])', both_names(name), text, count=1)
    return text[:1].upper() + text[1:]


def headline(finding: Finding) -> str:
    """Return what to read first: the strongest causes, and what they are worth."""
    strongest, worth = in_short(finding)
    if not finding.causes:
        return strongest
    closer = ('With them it passes every test.' if finding.verdict is Verdict.EXPLAINED else
              'With them it comes closer, but is not yet right.')
    refused = f' {finding.refused}: believe its names, not its numbers.' if finding.refused else ''
    return f'{strongest} {closer} {worth}{refused}'


def in_short(finding: Finding) -> tuple[str, str]:
    """Return the strongest causes, and what all are worth in errors of prediction."""
    if not finding.causes:
        return plain(finding.sentence), f'{finding.n} samples in {finding.duration:.4g} s.'
    order = sorted(finding.causes, key=lambda c: -c.gain if math.isfinite(c.gain) else math.inf)
    names = [both_names(name) for name in dict.fromkeys(cause.name for cause in order)]
    more = len(names) - _FIRST
    others = [f'{more} more'] if more > 0 else []
    return (f'A plain simulation lacks {listed([*names[:_FIRST], *others])}.',
            worth_words(finding.gain, finding.gain_se, finding.shrink, finding.size_gain))


def worth_words(gain: float, gain_se: float, shrink: float, size_gain: float) -> str:
    """
    Return a gain in two parts: smaller errors of prediction, and their size better known.

    gain, gain_se and size_gain in nats; shrink is a share.
    """
    if not (gain > Z95 * gain_se) or not math.isfinite(size_gain):
        return gain_words(gain, gain_se)
    errors = ('shrink by ' if shrink > 0.0 else 'grow by ') + f'{number(100.0 * abs(shrink), 2)} %'
    return (f'One-step errors on samples not used for the fit {errors} (rms), and their size is '
            f'{"better" if size_gain >= 0.0 else "worse"} known, by '
            f'{number(1e3 * abs(size_gain), 2)} of the {number(1e3 * gain)} +- '
            f'{number(1e3 * gain_se, 2)} mnat gained per sample.')


def both_names(name: str) -> str:
    """Return what a pilot calls a cause, with its name in code behind it."""
    return f'{PLAIN_NAMES[name]} ({name})' if name in PLAIN_NAMES else name
