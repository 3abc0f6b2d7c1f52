"""Headline, cautions and numbers in words."""

from dataclasses import replace
import math

from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.quality import quality_list
from ou_monitor.analysis.words import cautions, facts, headline
from ou_monitor.records import Flag
from ou_monitor.text import number
import pytest
from simulated_recordings import recording, without_throttle

TRUTH = ((0.1, 0.3156), (0.4, 0.632))


@pytest.mark.parametrize('value, digits, text', [
    (0.0, 3, '0'), (math.nan, 3, '-'), (math.inf, 3, '-'), (15.0, 3, '15.0'), (0.02, 3, '0.0200'),
    (99.96, 3, '100'), (0.9999, 3, '1.00'), (123456.0, 3, '123456'), (1234567.0, 3, '1.23e6'),
    (7.91e-4, 3, '7.91e-4'), (0.00317, 3, '0.00317'), (-63.04, 3, '-63.0'), (4.9351, 4, '4.935')])
def test_number(value, digits, text):
    """Significant digits, zeros kept, rounding across a decade."""
    assert number(value, digits) == text


def test_headline_tells_growth_with_its_interval():
    """A doubled sigma grows; an equal one does not change measurably."""
    grown = headline(analyze(recording(1, TRUTH)))
    assert ' Sigma grows from' in grown and '10 % to 40 % throttle' in grown
    same = headline(analyze(recording(2, ((0.1, 0.3), (0.4, 0.3)))))
    assert 'does not change measurably' in same
    fallen = headline(analyze(recording(3, ((0.1, 0.6), (0.4, 0.3)))))
    assert ' Sigma falls from' in fallen


def test_headline_of_one_level_and_of_none():
    """One level is described; without any the facts say why."""
    simulated = without_throttle(recording(4, ((0.1, 0.3),)))
    assert ' the supply wanders with sigma = 0.' in headline(analyze(simulated))
    short = recording(5, ((0.1, 0.3),), seconds=0.012)
    analysis = analyze(short)
    assert headline(analysis).startswith('The voltage stayed above 4.5 V')
    assert facts(analysis)[-1] == ('Relaxation', 'unknown: too few readings')


def test_headline_warns_of_what_changes_its_own_numbers():
    """Millivolts; nothing where nothing is wrong."""
    simulated = recording(1, TRUTH)
    assert 'Beware' not in headline(analyze(simulated))
    sentence = headline(analyze(replace(simulated, voltage=1e3 * simulated.voltage)))
    assert sentence.endswith('Beware: the voltages seem to be millivolts or counts, not volts.')
    found = analyze(replace(simulated, t=1e3 * simulated.t[::20], voltage=simulated.voltage[::20],
                            throttle=simulated.throttle[::20], current=None))
    assert headline(found).endswith('Beware: the time seems to be in ms or us, not in s.')
    assert any('is the time in ms or us? --time-unit ms' in text for text in cautions(found))


def test_the_same_caution_of_two_levels_is_said_once():
    """It is led by both labels."""
    analysis = analyze(recording(7, TRUTH))

    def said(**changes):
        items = quality_list(
            analysis.recording, [level.throttle for level in analysis.levels],
            [replace(level.estimate, **changes) for level in analysis.levels])
        return cautions(replace(analysis, quality=items))

    assert said(flags=(Flag.QUANTIZED,), noise_std=0.001) == [
        f'10 %, 40 %: {Flag.QUANTIZED.value}']
    assert said(flags=(), noise_std=0.001) == []
