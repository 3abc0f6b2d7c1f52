"""What a pilot calls a cause, beside its name in code, YAML and JSON."""

from __future__ import annotations

from collections.abc import Sequence
import re

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


def both_names(name: str) -> str:
    """Return what a pilot calls a cause, with its name in code behind it."""
    return f'{PLAIN_NAMES[name]} ({name})' if name in PLAIN_NAMES else name
