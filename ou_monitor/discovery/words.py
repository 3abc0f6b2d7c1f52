"""A finding in words: verdict, causes, gains, remaining discrepancies, helpful recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math
from typing import Any

from ou_monitor.discovery import decision
from ou_monitor.discovery.finding import Cause, Criticism, Explanation, Finding, Verdict
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.term import Term
from ou_monitor.records import LARGEST_LOG_SE
from ou_monitor.text import chance as shown_chance, filled, listed, number, Z95

# Explanation of gains and of the errors printed beside them.
GAIN = ('Gain: log predictive density of samples not used for the fit, in mnat (thousandths of a '
        'nat: 1 mnat per sample makes 1000 samples e = 2.7 times as likely); +- is half the 95 % '
        'interval.')
# Maximum number of causes that the first sentence names.
_FIRST = 3
# Reasons why a gain is unknown.
VAGUE = ('its error is more than ten times the gain, because the rest of the recording hardly '
         'determines its parameters.')
NO_OTHER = 'the model cannot be fitted without it.'
NOT_KNOWN = 'not known'
# Text of a number whose error is too large.
VAGUE_NUMBER = 'not determined'

_PLAIN = ((
    'autocorrelation', 'neighbouring prediction errors are correlated'),
    ('band', 'the spectrum has too much or too little power in some band'),
    ('line', 'the spectrum has a narrow peak'),
    ('order line', 'a narrow peak of the spectrum follows $load'),
    ('skewness', 'prediction errors are skewed'),
    ('kurtosis', 'prediction errors have tails that are too heavy or too light'),
    ('tails', 'there are too many outliers'),
    ('clustering', 'large errors come in clusters'),
    ('variance time', 'the noise changes with time'),
    ('variance throttle', 'the noise depends on $load'),
    ('variance change', 'the noise rises when $load changes'),
    ('variance state', 'the noise depends on the voltage'),
    ('time', 'the mean changes with time'),
    ('throttle', 'the mean depends on $load or its changes'),
    ('state throttle', 'the relaxation depends on $load'),
    ('state', 'the restoring force is not proportional to the deviation'),
    ('growing effect', 'the effect of $load on the mean changes with time'),
    ('loop of throttle', 'the mean depends on whether $load rose or fell before'),
    ('bursts', 'power at some frequencies comes and goes'),
    ('products of three', 'neighbouring errors are dependent beyond their spectrum'),
    ('pairs', 'large errors are followed by related ones'))


def plain_words(statistic: str, load: str = 'throttle') -> str:
    """Return what it means that a statistic lies outside its simulated band."""
    fits = [(len(sign), text) for sign, text in _PLAIN if statistic.startswith(sign)]
    return filled(max(fits)[1], load) if fits else statistic


# Maximum number of values in a printed list.
_LISTED = 6


def parameters(term: Term, se: Mapping[str, Any], load: str = 'throttle') -> str:
    """Return the estimates of a term with units and errors; omit unknown and unused parameters."""
    curves = term.factors()
    known = {name: value for name, value in term.values().items()
             if se.get(name) != math.inf and value != term.usual().get(name, 0.0)
             and not (curves and isinstance(value, list))}
    long = [name for name, value in known.items()
            if isinstance(value, list) and len(value) > _LISTED]
    found = []
    for name, value in known.items():
        if name not in long:
            error, positive = se.get(name), term.positive(name)
            found.append(f'{term.label(name)} {VAGUE_NUMBER}' if positive and is_vague(
                value, error) else f'{term.label(name)} = ' + ' '.join(filter(None, (
                    with_error(value, error, positive=positive), term.unit(name)))))
    found += [f'factor over {input_words(name, load)} = {curve_text(*curve)}'
              for name, curve in curves.items()]
    return '; '.join([*found, *([f'{listed(long)} have {len(known[long[0]])} values each, see the '
                                 'plot and --json'] if long else [])])


# Inputs of curves in words, by the first word of their name in `Term.factors`.
_INPUTS = {'throttle': '$load', 'fast': 'distance of $load from its mean over',
           'step': 'change of $load',
           'slow': 'distance of smoothed $load from its mean over',
           'rises': 'rise of $load within', 'falls': 'fall of $load within',
           'product': 'product of these factors'}


def input_words(name: str, load: str = 'throttle') -> str:
    """Return the input of a curve in words."""
    first, *span = name.split()
    return ' '.join([filled(_INPUTS.get(first, first), load), *span])


def curve_text(at: Sequence[float], factors: Sequence[float]) -> str:
    """List the points of a curve."""
    return ', '.join(f'{number(factor)} at {number(x)}' for x, factor in zip(at, factors))


def with_error(value: Any, error: Any, *, positive: bool = False) -> str:
    """Return a number, or a list of numbers, with half its 95 % interval if known."""
    # A positive number may be "not determined", see `is_vague`.
    if isinstance(value, list):
        errors = error if isinstance(error, list) else [None] * len(value)
        return '[' + ', '.join(with_error(
            v, e, positive=positive) for v, e in zip(value, errors)) + ']'
    if error == math.inf:
        return 'beyond what the recording shows'
    if isinstance(error, float) and math.isfinite(error) and error > 0.0:
        if positive and is_vague(value, error):
            return VAGUE_NUMBER
        half = Z95 * error
        if positive and half > value > 0.0:
            return ' to '.join(number(value * math.exp(by / value), 2) for by in (-half, half))
        digits = min(max(2 + math.floor(math.log10(max(abs(value) / half, 1.0))), 2), 6)
        return f'{number(value, digits)} +- {number(half, 2)}'
    return str(value) if isinstance(value, int) else number(value, 4)


def is_vague(value: Any, error: Any) -> bool:
    """Return whether a positive number's relative error exceeds `LARGEST_LOG_SE` (`Estimate`)."""
    return (isinstance(value, float) and isinstance(error, float)
            and 0.0 < LARGEST_LOG_SE * value < error)


def explain(term: Term, se: Mapping[str, Any], alternatives: Sequence[str], exact: bool = False,
            why: str = '', together: int = 1, load: str = 'throttle') -> Explanation:
    """Return the explanation of a cause (why: why its gain is unknown)."""
    # If several terms share a row, or no amplitude differs from 0, use the texts of the class.
    unsigned = bool(term.LINEAR) and all(
        abs(getattr(term, name)) < Z95 * (se.get(name) or 0.0) for name in term.LINEAR)
    about = type(term) if together > 1 or unsigned else term
    more = ['The samples themselves show it, without a model.'] if exact else []
    if why:
        more.append(f'Its gain cannot be measured on this recording: {why}')
    elif together > 1:
        more.append(f'Its gain is the joint gain of all {together} {term.NAME} terms.')
    if alternatives:
        separate = [f'{filled(catalogue()[name].SEPARATED_BY, load)} (for {name})'
                    for name in (term.NAME, *alternatives)]
        more.append(f'This recording cannot separate it from {listed(list(alternatives))}. To '
                    f'separate them: {"; ".join(dict.fromkeys(separate))}.')
    return Explanation(filled(about.MEANING, load), (parameters(term, se, load),), tuple(more),
                       filled(about.REMEDY, load))


def left_out_note(count: int, scored: int, load: str) -> str:
    """Return the note for samples at a throttle that other blocks do not cover."""
    return filled(
        f'{count} samples are at a $load that the rest of the recording does not cover, so a '
        f'model fitted to the rest does not apply. Only the other {scored} are scored.', load)


def coupling_note(alpha: float, duration: float, n: int) -> str:
    """Return for which rails an AC coupling is not ruled out (1/s, s, number of samples)."""
    # A recording of duration T gives 0.24 alpha T nats of evidence for an AC coupling, where alpha
    # is the rate of the supply, before the penalty of its parameter (BIC).
    slowest = 0.24 * duration / (decision.ACCEPT + 0.5 * math.log(n))
    return (f'If the supply itself takes more than {number(slowest)} s to relax, the '
            'relaxation found could come from an AC-coupled instrument (a high-pass at '
            f'{number(alpha / (2.0 * math.pi))} Hz); a DC-coupled recording would settle it.')


def no_relaxation_note(step: float) -> str:
    """Return the note for samples too far apart, s, to show the relaxation."""
    return (f'Samples {number(1e3 * step)} ms apart are nearly uncorrelated: the rail is faster '
            'than the sampling, or the noise comes from the sensor.')


def remaining_words(left: Sequence[Criticism], load: str) -> str:
    """Return the largest remaining discrepancies, in words."""
    texts = list(dict.fromkeys(plain_words(c.statistic, load) for c in left))
    return listed(texts[:4]) + ('' if len(texts) <= 4 else f' ({len(texts) - 4} more)')


def verdict_words(found: Finding, why: str = '', dropped: Sequence[str] = (), uncovered: int = 0,
                  doubts: Sequence[str] = ()) -> tuple[str, ...]:
    """Return the verdict as sentences: causes, whether simulations pass, gain, refusal."""
    # why: reason for an unknown gain; uncovered: samples at a throttle that other blocks lack.
    if not found.causes:
        return (_without_causes(found, dropped, uncovered),)
    order = sorted(found.causes, key=lambda c: -c.gain if math.isfinite(c.gain) else math.inf)
    names = list(dict.fromkeys(
        both_names(cause.name, plain_name(cause.term, found.load)) for cause in order))
    more = len(names) - _FIRST
    others = [f'{more} more'] if more > 0 else []
    closer = f'With {"it" if len(names) == 1 else "them"} the simulation ' + (
        'passes every test' if found.verdict is Verdict.EXPLAINED else
        'comes closer, but is not yet right' if found.closer else 'does not come closer')
    refused = [f'{found.refused}: trust the named causes, not the fitted values.'
               ] if found.refused else []
    return (f'A plain simulation lacks {listed([*names[:_FIRST], *others])}.',
            f'{": ".join([closer, *(["; ".join(doubts)] if doubts else [])])}.',
            _gain(found, why), *refused)


def _without_causes(found: Finding, dropped: Sequence[str], uncovered: int) -> str:
    if found.verdict is Verdict.NO_EFFECT:
        return ('The plain OU reproduces this recording: none of the statistics that can be '
                'computed at this length deviates.')
    left = remaining_words(found.remaining, found.load)
    names = [both_names(name, load=found.load) for name in dropped]
    return ('The simulation deviates from the recording, and no known cause explains it: '
            + f'{left}.' + (
                f' The nearest causes of the catalogue ({listed(names)}) explain a part.'
                if dropped else '') + (filled(
                    f' {uncovered} samples are at a $load that the rest of the recording does not '
                    'cover; this alone may explain the deviation.', found.load)
                    if uncovered else ''))


def _gain(found: Finding, why: str) -> str:
    """Return a gain in words: how much one-step errors, and predictions of their size, improve."""
    gain, shrink, size = found.gain, found.shrink, found.size_gain
    if not math.isfinite(gain):
        return f'Its gain cannot be measured on this recording{f": {why}" if why else "."}'
    whole = f'{gain_text(gain, found.gain_se)} mnat per sample'
    if not gain > Z95 * found.gain_se:
        what = 'Worse' if gain < -Z95 * found.gain_se else 'No measurable gain'
        return f'{what} on samples not used for the fit ({whole}).'
    errors = ('shrink by ' if shrink > 0.0 else 'grow by ') + f'{number(100.0 * abs(shrink), 2)} %'
    # Errors may grow although predictions improve: a few large errors dominate their rms.
    parts = (f'; {"+" * (shrink > 0.0)}{number(1e3 * (gain - size))} mnat per sample) and their '
             f'size is predicted better (+{number(1e3 * size)}): ' if size > Z95 * found.gain_se
             else '), a gain of ')
    return f'On samples not used for the fit, one-step errors {errors} (rms{parts}{whole} in all.'


def collinear_note(inflation: float, limit: float, load: str) -> str:
    """Return a note that sag and drift are hard to tell apart."""
    return filled('$Load changes with time like a staircase or a ramp (variance inflation '
                  f'{number(inflation, 2)}; limit {limit:g}): a sag and a drift are hard to tell '
                  'apart, so the errors of the response are larger. Return to a low $load between '
                  'the steps.', load)


def unmeasured_words(fewest: int, scored: int, load: str | None) -> str:
    """Return why a gain cannot be measured, and which recording would measure it."""
    # load: None if the load is not the reason.
    few = (f'only {scored} samples can be scored, fewer than {fewest}' if scored
           else 'no part of the recording can be scored with parameters from the other parts')
    if load:
        return filled(f'{few}: the parts cover different ranges of $load. A recording that covers '
                      'its whole range of $load more than once would measure it.', load)
    return f'{few}. A longer recording would measure it.'


@dataclass(frozen=True)
class CauseRow:
    """One row: a cause, or several terms of one kind that share a gain."""

    what: str  # Plain name of the cause
    label: str  # Name, with the number of terms if there are several
    family: str  # Family in the catalogue
    gain: str  # mnat per sample, or `NOT_KNOWN`
    chance: str  # p, ``exact``, or `NOT_KNOWN`
    alternatives: tuple[str, ...]  # Causes that the recording cannot separate from it
    explanation: str  # With the parameters of each term


def cause_rows(causes: Sequence[Cause], load: str = 'throttle') -> list[CauseRow]:
    """Return the rows of the table of causes."""
    # Compare numbers as text, because NaN is not equal to itself.
    groups: dict[tuple[str, ...], list[Cause]] = {}
    for cause in causes:
        key = (cause.name, repr(cause.gain), repr(cause.gain_se), _chance(cause))
        groups.setdefault(key, []).append(cause)
    return [CauseRow(
        plain_name(group[0].term, load),
        group[0].name if len(group) == 1 else f'{group[0].name} x{len(group)}',
        group[0].term.FAMILY, gain_text(group[0].gain, group[0].gain_se),
        _chance(group[0]),
        tuple(dict.fromkeys(name for cause in group for name in cause.alternatives)),
        _together(group).text) for group in groups.values()]


def _together(group: Sequence[Cause]) -> Explanation:
    """Return the explanation of the first cause, with the estimates of all."""
    return replace(group[0].explanation, estimates=tuple(
        one for cause in group for one in cause.explanation.estimates))


def gain_text(gain: float, gain_se: float) -> str:
    """Return a gain, nats, in mnat with half its 95 % interval."""
    if not math.isfinite(gain):
        return NOT_KNOWN
    if not math.isfinite(gain_se):
        return f'{number(1e3 * gain)}, error {NOT_KNOWN}'
    # A gain below a hundredth of its error is shown as 0.
    shown = gain if 100.0 * abs(gain) > Z95 * gain_se else 0.0
    return f'{number(1e3 * shown)} +- {number(1e3 * Z95 * gain_se, 2)}'


def _chance(cause: Cause) -> str:
    if cause.exact:
        return 'exact'
    return shown_chance(cause.p_value) if math.isfinite(cause.p_value) else NOT_KNOWN


PLAIN_NAMES = {
    'ac_coupling': 'an AC-coupled instrument',
    'clock_jitter': 'jitter of the time stamps',
    'drift': 'discharge or warming',
    'flicker_noise': '1/f noise',
    'glitches': 'single bad samples',
    'heavy_tails': 'noise with rare large jumps',
    'held_samples': 'a logger that repeats its last value',
    'jumps': 'load pulses',
    'load_dependent_alpha': 'a relaxation that changes with $load',
    'load_dependent_noise': 'sensor noise that follows $load',
    'load_dependent_sigma': 'noise that changes with $load',
    'load_sag': 'sag',
    'load_transient': 'a response to changes of $load',
    'lopsided_noise': 'noise with falls deeper than its rises',
    'measurement_noise': 'noise of the sensor',
    'nonlinear_restoring': 'a nonlinear restoring force',
    'quantization': 'a coarse ADC',
    'regime_switching': 'two states of the supply',
    'resonance': 'ringing of leads and capacitors',
    'saturation': 'clipping at the end of the range of the ADC',
    'second_relaxation': 'a second time constant',
    'throttle_tone': 'a spectral line that follows the motors',
    'tone': 'a spectral line at a fixed frequency',
    'volatility': 'noise that comes and goes',
}


# Names of causes that depend on changes of the load only, not on the load itself.
_OF_CHANGES = {
    'load_dependent_noise': 'sensor noise that follows changes of $load',
}


def plain_name(term: Term, load: str = 'throttle') -> str:
    """Return the plain name of a cause, which says whether the load or its changes matter."""
    curves = term.factors()
    of_changes = bool(curves) and 'throttle' not in curves
    name = (_OF_CHANGES if of_changes else PLAIN_NAMES).get(term.NAME) or PLAIN_NAMES.get(
        term.NAME, term.NAME)
    return filled(name, load)


def both_names(name: str, what: str = '', load: str = 'throttle') -> str:
    """Return a cause's plain name (`what`, else the usual one), and its name in code."""
    return f'{what or filled(PLAIN_NAMES[name], load)} ({name})' if name in PLAIN_NAMES else name
