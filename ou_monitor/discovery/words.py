"""A finding in words: the verdict, each cause, what remains, what would decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any

from ou_monitor.discovery.finding import Cause, Criticism, Finding, Verdict
from ou_monitor.discovery.gain_words import gain_words, why_named
from ou_monitor.model.terms.catalogue import catalogue
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Term
from ou_monitor.text import listed, number

# An estimate whose error is so many times as large is none.
_UNDETERMINED = 1e4

_PLAIN = ((
    'autocorrelation', 'neighbouring prediction errors are correlated'),
    ('band', 'the spectrum has too much or too little power in some band'),
    ('line', 'the spectrum has a line'),
    ('order line', 'a line follows throttle'),
    ('skewness', 'prediction errors are lopsided'),
    ('kurtosis', 'prediction errors are too often large or too peaked'),
    ('tails', 'there are too many outliers'),
    ('clustering', 'large errors come in clusters'),
    ('variance time', 'the noise changes with time'),
    ('variance throttle', 'the noise depends on throttle'),
    ('variance change', 'the noise rises when throttle changes'),
    ('variance state', 'the noise depends on the voltage'),
    ('time', 'the mean changes with time'),
    ('throttle', 'the mean depends on throttle or its changes'),
    ('state throttle', 'the relaxation depends on throttle'),
    ('state', 'the relaxation is not proportional to the deviation'),
    ('growing effect', 'what throttle does to the mean changes with time'),
    ('loop of throttle', 'the mean depends on whether throttle has come from above or below'),
    ('after large', 'what follows a large error is not what the relaxation says'),
    ('power after large', 'a large error is followed by more noise, or by less'),
    ('irreversibility', 'it looks different backwards in time'),
    ('small errors', 'neighbouring small errors are correlated'),
    ('bursts', 'power at some frequencies comes and goes'),
    ('products of three', 'neighbouring errors depend on each other in a way no spectrum shows'),
    ('pairs', 'large errors are followed by related ones'))


def plain_words(statistic: str) -> str:
    """Return what it means when a statistic is off."""
    fits = [(len(sign), text) for sign, text in _PLAIN if statistic.startswith(sign)]
    return max(fits)[1] if fits else statistic


def parameters(term: Term, se: Mapping[str, Any]) -> str:
    """Return the estimates of a term with units and standard errors."""
    return '; '.join(f'{name} = {with_error(value, se.get(name))}{_unit(term, name)}'
                     for name, value in term.values().items())


def with_error(value: Any, error: Any) -> str:
    """Return a number, or a list of them, with its standard error where known."""
    if isinstance(value, list):
        errors = error if isinstance(error, list) else [None] * len(value)
        return '[' + ', '.join(with_error(v, e) for v, e in zip(value, errors)) + ']'
    if isinstance(error, float) and math.isfinite(error) and error > 0.0:
        if abs(value) * _UNDETERMINED < error and value != 0.0:
            return f'{number(value, 2)} (not determined)'
        digits = min(max(2 + math.floor(math.log10(max(abs(value) / error, 1.0))), 2), 6)
        return f'{number(value, digits)} +- {number(error, 2)}'
    return number(value, 4)


def _unit(term: Term, name: str) -> str:
    unit = term.unit(name)
    return f' {unit}' if unit else ''


def explain(term: Term, se: Mapping[str, Any], gain: float, gain_se: float,
            alternatives: Sequence[str], exact: bool, why: str = '', together: int = 1,
            chance: float = math.nan) -> str:
    """
    Return what a cause is, its estimate, its gain and what to do, for people.

    gain, gain_se in nats.
    """
    parts = [term.MEANING, f'Estimate: {parameters(term, se)}.']
    if exact:
        parts.append('Seen in the samples themselves, without a model.')
    parts.append(gain_words(gain, gain_se, why))
    if together > 1 and math.isfinite(gain):
        parts.append(f'That is the gain of all {together} terms {term.NAME} together.')
    if not exact:
        parts.append(why_named(gain, gain_se, chance))
    if alternatives:
        separate = [f'{catalogue()[name].SEPARATED_BY} (for {name})'
                    for name in (term.NAME, *alternatives)]
        parts.append(f'This recording does not tell it from {listed(list(alternatives))}; what '
                     f'would: {"; ".join(dict.fromkeys(separate))}.')
    parts.append(term.REMEDY)
    return ' '.join(part for part in parts if part)


def left_out_note(count: int, scored: int) -> str:
    """Return that samples at throttle which the part fitted has not seen are not scored."""
    return (f'{count} samples of the last 40 % are at throttle that the first 60 % never had: a '
            f'model fitted there says nothing of them. Only the other {scored} are scored.')


def coupling_note(alpha: float, duration: float) -> str:
    """
    Return what can be said of an AC coupling that was not found.

    Evidence for one grows as 0.24 alpha T nats, alpha being the rate of the
    rail behind it.

    alpha in 1/s, duration in s.
    """
    slowest = 6.0 / (0.24 * duration)
    corner = alpha / (2.0 * math.pi)
    return (f'An AC-coupled instrument with a corner at {number(corner)} Hz would show '
            f'the same relaxation. {number(duration)} s exclude that only for rails of '
            f'their own rate above {number(slowest)} 1/s (one of 1 1/s takes 25 s, of 0.1 1/s 250 '
            's): where in doubt, repeat with the instrument DC-coupled.')


def no_relaxation_note(alpha: float, step: float) -> str:
    """Return what it means that samples are farther apart than the rail remembers."""
    return (f'Samples {number(1e3 * step)} ms apart are nearly uncorrelated: the rail is faster '
            f'than the sampling, or the noise is that of the sensor, and alpha = {number(alpha)} '
            '1/s, fitted on the first 60 %, is only a lower bound.')


def coupling_found(duration: float) -> str:
    """Return what would confirm an AC coupling that was found."""
    return (f'An AC coupling was found in {number(duration)} s; its evidence grows as 0.24 nats '
            'times rate of the rail times duration. A DC-coupled recording confirms it.')


def remaining_words(left: Sequence[Criticism]) -> str:
    """Return the worst of what remains, in words."""
    texts = list(dict.fromkeys(plain_words(c.statistic) for c in left))
    return listed(texts[:4]) + ('' if len(texts) <= 4 else f' ({len(texts) - 4} more)')


def verdict_sentence(verdict: Verdict, causes: Sequence[Cause], left: Sequence[Criticism],
                     gain: float, gain_se: float, dropped: Sequence[str] = (),
                     why: str = '', unseen: int = 0) -> str:
    """Return the verdict in a sentence or two (gain, gain_se in nats)."""
    names = _counted([cause.name for cause in causes])
    tried = (f' The nearest entries of the catalogue ({listed(list(dropped))}) fit in part only.'
             if dropped else '')
    if left and unseen:
        tried += (f' {unseen} samples of the last 40 % are at throttle that the first 60 %, on '
                  'which models are fitted, never had: what is left may be no more than that'
                  + ('.' if why else '; a recording that goes through all of its throttle in '
                     'both parts would tell.'))
    if verdict is Verdict.NO_EFFECT:
        return ('The plain OU simulates this recording: nothing is wrong with it that this length '
                'could show.')
    if verdict is Verdict.UNEXPLAINED:
        if not left:
            return f'Something is wrong with the simulation that no known cause explains.{tried}'
        return ('The simulation is wrong, and no known cause explains it: '
                f'{remaining_words(left)}.{tried}')
    if verdict is Verdict.EXPLAINED:
        return (f'What the plain OU gets wrong is explained by {listed(names)}. '
                + gain_words(gain, gain_se, why))
    rest = f': {remaining_words(left)}' if left else ''
    return (f'{listed(names)} explain{"s" if len(names) == 1 else ""} a part of what the plain OU '
            f'gets wrong; something else is left{rest}.{tried} ' + gain_words(gain, gain_se, why))


def _counted(names: Sequence[str]) -> list[str]:
    """Return each name once, with how often it is there."""
    return [name if names.count(name) == 1 else f'{name} ({names.count(name)} terms)'
            for name in dict.fromkeys(names)]


def crossing_words(finding: Finding) -> str:
    """Return what a pilot feels, in a sentence."""
    c = finding.crossing
    if not math.isfinite(c.observed):
        return ''
    extended = (f', the extended model {number(c.extended)} +- {number(c.extended_se, 2)}'
                if finding.causes and math.isfinite(c.extended) else '')
    return (f'The voltage fell through {number(c.level, 4)} V '
            f'{number(c.observed)} +- {number(c.observed_se, 2)} times a minute; the plain OU '
            f'says {number(c.baseline)} +- {number(c.baseline_se, 2)}{extended}.')


def plain_model_words(baseline: OU) -> str:
    """Return the plain model on one line."""
    return (f'alpha = {number(baseline.alpha)} 1/s, sigma = {number(baseline.sigma)} V/sqrt(s), '
            f'u0 = {number(baseline.u0, 4)} V')
