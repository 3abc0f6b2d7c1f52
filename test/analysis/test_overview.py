"""Facts known of any recording (lowest voltage, dips, sag, noise), in numbers and words."""

from dataclasses import replace
import math
import re
from types import SimpleNamespace

import numpy as np
from ou_monitor import supply_facts
from ou_monitor import read_recording
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.overview import (
    answers, determined, known_lines, overview)
from ou_monitor.records import Recording
import pytest

RATE, SECONDS = 50.0, 80.0
SAG = 1.2


def deviation(u):
    """Return the noise, V: the ripple of an ESC is largest at 0.7."""
    return 0.015 * np.exp(u * (1.4 - u) / 0.49)


def flight(seed=3, sag=SAG, throttle=True, seconds=SECONDS):
    """Return 16 V less sag u^1.8, throttle 0.1 to 0.8 in steps of 0.5 s, and noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(RATE * seconds)) / RATE
    u = np.repeat(rng.uniform(0.1, 0.8, int(2 * seconds)), int(RATE / 2))
    noise = deviation(u) * rng.standard_normal(t.size)
    return Recording(t, 16.0 - sag * u ** 1.8 + noise,
                     u if throttle else np.full(t.size, math.nan))


def test_a_gap_after_a_low_sample_is_not_time_below():
    """A minute without samples counts as ten usual intervals at most."""
    t = np.concatenate((np.arange(50), 6000 + np.arange(50))) / 100.0
    v = np.full(100, 5.0)
    v[49] = 4.0
    dips = supply_facts(Recording(t, v, np.full(100, math.nan)), 4.5).dips
    assert (dips.count, dips.seconds) == (1, pytest.approx(0.1))


@pytest.mark.parametrize('step', [0.02, 0.2])
def test_a_current_that_throttle_does_not_tell_gives_the_fall(step):
    """Of its largest value that lasts three readings, not of one wild reading."""
    rng, n = np.random.default_rng(2), 4000
    drawn = np.repeat(rng.uniform(0.0, 60.0, n // 10), 10)
    drawn[1000] = 500.0
    v = 12.0 - 0.02 * drawn + 0.005 * rng.standard_normal(n)
    v[1000] = 12.0
    throttle = np.repeat(rng.uniform(0.0, 1.0, n // 10), 10)
    found = overview(Recording(step * np.arange(n), v, throttle, current=drawn))
    assert 59.0 < found.drawn < 60.0
    ohm = found.facts.resistance.ohm
    assert ohm == pytest.approx(0.02, rel=0.1)
    assert f'lowers the rail by {ohm * found.drawn:.2f} V' in answers(found)[1]
    assert ' after 1 s' in dict(known_lines(found))['Resistance']


def test_words_are_those_of_the_facts():
    """The sag within three errors of the truth; each number in words is one of `supply_facts`."""
    found, facts = overview(flight(), 15.2), supply_facts(flight(), 15.2)
    assert found.facts.to_dict() == facts.to_dict() and facts.sag.known
    at, sag, se = found.sag
    assert at == 0.8 and sag == facts.sag.sag_v[8]
    assert abs(sag - SAG * at ** 1.8) < 3.0 * se and se < 0.33 * SAG * at ** 1.8
    (low, first), (high, last) = found.noise
    # A tenth of throttle changes the noise by up to 25 %.
    assert (low, high) == (0.1, 0.8)
    assert first == pytest.approx(deviation(low), rel=0.3)
    assert last == pytest.approx(deviation(high), rel=0.15)
    words = dict(known_lines(found))
    assert words['Noise'].endswith('it grows with throttle')
    assert f'{1e3 * last:.1f} mV at 80 %' in words['Noise']
    assert words['Sag'].startswith(f'{1e3 * sag:.0f} mV')
    assert 'extrapolated to full throttle' in words['Sag']
    assert f'{facts.dips.count} dips below 15.2 V' in answers(found)[0]
    assert f'{facts.lowest.voltage_v:.2f} V' in words['Lowest voltage']


def test_a_sag_smaller_than_its_error_is_a_bound():
    """The same rule in each row; not flown: unknown unless the highest throttle flown is known."""
    found = overview(flight(seconds=20.0))
    assert found.flown == (1, 8)
    for se, at_end, beyond in ((0.1, True, True), (0.4, False, False)):
        sag = replace(found.facts.sag, sag_v=(0.5,) * 11, se_v=(0.1,) * 8 + (se,) + (0.1,) * 2)
        one = replace(found, facts=replace(found.facts, sag=sag))
        assert (determined(one, 8), determined(one, 10, flown=False)) == (at_end, beyond)
        assert determined(one, 4)


@pytest.mark.parametrize('last', [0.030, 0.015])
def test_one_loud_throttle_is_no_trend(last):
    """Of 16 mV at all throttles; as an end alone, 30 mV would be growth."""
    one = flight()
    high = one.throttle > 0.78
    noise = np.where(high, last, 0.016) * np.random.default_rng(5).standard_normal(one.n)
    found = overview(replace(one, voltage=16.0 - SAG * one.throttle ** 1.8 + noise))
    assert 0.8 < found.growth < 1.25
    assert dict(known_lines(found))['Noise'].endswith('without a trend over throttle')


def test_unknown_facts_are_stated_and_the_others_kept():
    """Without throttle; with one that does nothing; without a limit; with a limit never met."""
    blind = overview(flight(throttle=False, seconds=20.0))
    words = dict(known_lines(blind))
    assert words['Sag'] == 'unknown: the recording has no throttle'
    assert words['Noise'].endswith(' mV rms') and 'Below' not in ' '.join(words)
    assert answers(blind)[0].startswith('The voltage fell to ')
    idle = dict(known_lines(overview(flight(sag=0.0, seconds=20.0), 3.0)))
    # What is known: a bound, above the true 0.
    bound = re.match(r'below ([\d.]+) mV at 80 % throttle \(95 %\)', idle['Sag'])
    assert 0.0 < float(bound[1]) < 200.0 and idle['Below 3 V'] == 'never'
    high = answers(overview(flight(seconds=20.0), 3.0))[0]
    assert high.startswith('The voltage stayed above 3 V')
    one = flight(seconds=1.0)
    assert answers(overview(replace(one, t=one.t[:0], voltage=one.voltage[:0],
                                    throttle=one.throttle[:0]))) == []


@pytest.mark.parametrize('shares,words', [
    ((), ''), ((0.2,), ''), ((0.3,), 'A line at 40.00 Hz makes 30 % of the noise'),
    ((0.2, 0.1), '2 lines, the strongest at 40.00 Hz, make 30 % of the noise')])
def test_lines_are_part_of_the_answer_when_they_make_a_quarter_of_the_noise(shares, words):
    """Alone or together; weaker ones are in the list only."""
    lines = [SimpleNamespace(frequency=40.0 * k, rms=0.01 / k, share=share)
             for k, share in enumerate(shares, 1)]
    level = SimpleNamespace(label='all', kind=None, lines=SimpleNamespace(lines=lines))
    said = answers(overview(flight(seconds=10.0), 15.2, [level]))
    assert said[-1] == f'{words}.' if words else not any('line' in one for one in said)


def test_a_stationary_recording_of_one_level_is_known_from_all_of_it():
    """Its fit agrees with that of the last 2 s, and is known better; two levels have none."""
    seen = analyze(read_recording('bags/load_40')).overview
    (low, high), (least, most) = seen.whole.alpha_95, seen.facts.ou.alpha_95
    assert low < 63.0 < high and high / low < 0.7 * most / least and low < most and least < high
    assert seen.whole.window_s == pytest.approx(20.0, rel=0.01) and seen.facts.ou.window_s == 2.0
    assert known_lines(seen)[-1][1].startswith(f'alpha {seen.whole.alpha:.1f} ')
    assert analyze(flight(seconds=20.0)).overview.whole is None
