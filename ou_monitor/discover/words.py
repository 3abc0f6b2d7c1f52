"""A finding in words: the verdict, each cause, what remains, what would decide."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import Any

from ou_monitor.discover.finding import Cause, Criticism, Finding, Verdict
from ou_monitor.discover.gain_words import gain_words, why_named
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.term import Term
from ou_monitor.text import listed, number

# What it is; what to do about it; which recording shows it apart from others.
_CAUSES: Mapping[str, tuple[str, str, str]] = {
    'load_sag': (
        'The mean falls with throttle: IR drop of battery, leads and regulator.',
        'Give the estimator throttle, so that it takes the sag out; thicker or shorter leads '
        'reduce it.',
        'throttle held for some seconds at several levels'),
    'load_transient': (
        'The mean answers to changes of throttle: lag, inrush or slow polarisation recovery.',
        'Count the dip after a throttle step into the brown-out margin; capacitance at the ESC '
        'shortens it.',
        'single steps of throttle, each held for ten times the time in which the answer dies out'),
    'load_dependent_sigma': (
        'The noise grows or shrinks with throttle.',
        'Let the estimator run while flying, so that filters and risk follow the load.',
        'throttle held for some seconds at several levels'),
    'load_dependent_alpha': (
        'The relaxation rate depends on throttle.',
        'Fit each load level on its own (analyze); one alpha is wrong at all but one of them.',
        'throttle held for 50 relaxation times at each of several levels'),
    'drift': (
        'The mean moves slowly with time: discharge or warming.',
        'Use a window short beside the drift, or take the trend out first.',
        'a recording several times as long'),
    'measurement_noise': (
        'White noise of the sensor lies on top of the rail.',
        'Average in the ADC or use a finer range; alpha and sigma fitted without it are too '
        'high.',
        'the same rail at several times the sampling rate, or the input of the ADC shorted'),
    'quantization': (
        'The steps of the ADC are comparable to the noise.',
        'Use a finer range of the ADC or more gain ahead of it; sigma is partly rounding.',
        'the same rail with a finer range of the ADC'),
    'held_samples': (
        'The logger repeats its last value until the source has a new one.',
        'Log at the rate of the source, or drop repeats before any fit (done here).',
        'the raw samples of the ADC'),
    'saturation': (
        'The voltage is clipped at the end of the range of the ADC.',
        'Rescale the input: the true excursions are larger, and those are the ones that matter.',
        'the same rail with a larger range'),
    'second_relaxation': (
        'A second relaxation of its own rate adds to the first: a second storage element.',
        'Keep both in the model; one alpha alone describes neither.',
        'a recording ten times as long, throttle held still'),
    'resonance': (
        'The rail rings: inductance of the leads against the capacitors.',
        'Damp it with a resistive (electrolytic) capacitor or shorter leads.',
        'a sampling rate of ten times the ringing, throttle held still'),
    'tone': (
        'A line at a fixed frequency: PWM of an ESC or its alias, or a DC-DC converter.',
        'Find the source by its frequency; sample at another rate to tell an alias.',
        'the same at two sampling rates: an alias moves, a true line does not'),
    'throttle_tone': (
        'A line whose frequency follows throttle: commutation of the motors.',
        'Capacitance at the ESC; a notch that follows throttle.',
        'a slow sweep of throttle'),
    'ac_coupling': (
        'The instrument is AC-coupled: the relaxation that is seen is that of its high-pass.',
        'Repeat with the instrument DC-coupled; alpha of the rail is the one given here, not '
        'the one of the plain fit.',
        'the same rail DC-coupled'),
    'jumps': (
        'The supply is kicked now and then and relaxes at the rate alpha: load impulses.',
        'Look for what switches at that rate: servos, payload, radio.',
        'a recording with each consumer off in turn'),
    'heavy_tails': (
        'The driving noise itself has heavy tails, without distinct events.',
        'Take large excursions as more frequent than a normal law says.',
        'a recording several times as long, at a higher rate'),
    'glitches': (
        'Single bad samples that do not enter the dynamics: bus errors or pick-up of the ADC.',
        'Reject single outliers before the estimator; check cables and ground of the ADC.',
        'two ADCs on one rail: a glitch is in one only'),
    'regime_switching': (
        'The supply switches between two states, unrelated to throttle.',
        'Look for a consumer that goes on and off, or a loose contact.',
        'the state of other consumers recorded beside it'),
    'volatility': (
        'The intensity of the noise wanders slowly, unrelated to throttle.',
        'Keep the window of the estimator short beside that time.',
        'a recording several times as long, temperature recorded beside it'),
    'nonlinear_restoring': (
        'What pulls the voltage back is not proportional to the deviation: a load of constant '
        'power, or softening near brown-out.',
        'Take deep excursions as longer and more frequent than the linear model says.',
        'stronger excursions: steps of load in both directions'),
    'flicker_noise': (
        '1/f noise: there is no single relaxation time.',
        'Treat alpha as a number of this window only; use windows of one length to compare.',
        'a recording over two more decades of frequency'),
    'clock_jitter': (
        'Time stamps are off by a random amount.',
        'Stamp in the interrupt of the ADC, not where the message is sent.',
        'stamps by the clock of the ADC recorded beside the others'),
}

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
    what, advice, _ = _CAUSES.get(term.NAME, (term.MEANING or term.NAME, '', ''))
    parts = [what, f'Estimate: {parameters(term, se)}.']
    if exact:
        parts.append('Seen in the samples themselves, without a model.')
    parts.append(gain_words(gain, gain_se, why))
    if together > 1 and math.isfinite(gain):
        parts.append(f'That is the gain of all {together} terms {term.NAME} together.')
    if not exact:
        parts.append(why_named(gain, gain_se, chance))
    if alternatives:
        separate = [f'{_CAUSES[name][2]} (for {name})' for name in (term.NAME, *alternatives)
                    if name in _CAUSES]
        parts.append(f'This recording does not tell it from {listed(list(alternatives))}; what '
                     f'would: {"; ".join(dict.fromkeys(separate))}.')
    parts.append(advice)
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
