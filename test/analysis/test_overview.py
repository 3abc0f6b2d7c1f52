"""What is always known of a recording: lowest voltage, dips, sag, noise; in numbers and words."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
from ou_monitor.analysis.overview import count_dips, headline, known_lines, overview
from ou_monitor.records import Recording
import pytest

RATE, SECONDS = 50.0, 80.0
SAG = 1.2


def deviation(u):
    """Return the noise, V: the ripple of an ESC is largest at 0.7."""
    return 0.015 * np.exp(u * (1.4 - u) / 0.49)


def flight(seed=3, sag=SAG, throttle=True):
    """Return 16 V less sag u^1.8, throttle 0.1 to 0.8 in steps of 0.5 s, and noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(RATE * SECONDS)) / RATE
    u = np.repeat(rng.uniform(0.1, 0.8, int(2 * SECONDS)), int(RATE / 2))
    noise = deviation(u) * rng.standard_normal(t.size)
    return Recording(t, 16.0 - sag * u ** 1.8 + noise,
                     u if throttle else np.full(t.size, math.nan))


@pytest.mark.parametrize('below,dips,seconds', [
    ((), 0, 0.0), ((0,), 1, 0.01), ((5, 6, 7), 1, 0.03), ((5, 20, 40), 1, 0.03),
    ((5, 27), 2, 0.02), ((99,), 1, 0.01)])
def test_dips_are_apart_by_a_fifth_of_a_second(below, dips, seconds):
    """At 100 Hz: neighbours and those within 0.2 s are one; the last sample counts, too."""
    t = np.arange(100) / 100.0
    v = np.full(100, 5.0)
    v[list(below)] = 4.0
    found, time = count_dips(t, v, 4.5)
    assert found == dips and time == pytest.approx(seconds)
    assert count_dips(t, v, math.nan) == (0, 0.0)


def test_a_gap_after_a_low_sample_is_not_time_below():
    """A minute without samples counts as ten usual intervals at most."""
    t = np.concatenate((np.arange(50), 6000 + np.arange(50))) / 100.0
    v = np.full(100, 5.0)
    v[49] = 4.0
    assert count_dips(t, v, 4.5) == (1, pytest.approx(0.1))


def test_sag_and_noise_are_those_of_the_supply():
    """The sag within three errors of the truth, themselves under a third; noise within 15 %."""
    found = overview(flight(), 15.2)
    assert found.load.known
    at, sag, se = found.sag
    assert at == pytest.approx(0.8, abs=0.01)
    assert abs(sag - SAG * at ** 1.8) < 3.0 * se and se < 0.33 * SAG * at ** 1.8
    low, high = found.noise
    # Of the last 2000 samples at the ends of a line: some 5 %.
    assert low == pytest.approx(deviation(found.flown[0]), rel=0.15)
    assert high == pytest.approx(deviation(found.flown[1]), rel=0.15)
    words = dict(known_lines(found))
    assert words['Noise'].endswith('it grows with throttle')
    assert 'the highest flown' in words['Sag'] and 'at full throttle' in words['Sag']
    assert f'{found.dips} dips below 15.2 V' in headline(found)
    assert f'{found.lowest:.2f} V' in words['Lowest voltage']


def test_what_is_not_known_is_said_and_the_rest_stands():
    """Without throttle; with one that does nothing; without a limit; with a limit never met."""
    blind = overview(flight(throttle=False))
    words = dict(known_lines(blind))
    assert words['Sag'] == 'unknown: the recording has no throttle'
    assert 'mV rms from sample to sample' in words['Noise'] and 'Below' not in ' '.join(words)
    assert headline(blind).startswith('The voltage fell to ')
    idle = dict(known_lines(overview(flight(sag=0.0), 3.0)))
    assert idle['Sag'].startswith('unknown. ') and idle['Below 3 V'] == 'never'
    assert headline(overview(flight(), 3.0)).startswith('The voltage stayed above 3 V')
    one = flight()
    assert headline(overview(replace(one, t=one.t[:0], voltage=one.voltage[:0],
                                     throttle=one.throttle[:0]))) \
        == 'The recording holds no samples.'


@pytest.mark.parametrize('shares,words', [
    ((), ''), ((0.2,), ''), ((0.3,), 'a line at 40.00 Hz makes 30 % of the noise'),
    ((0.2, 0.1), '2 lines, the strongest at 40.00 Hz, make 30 % of the noise')])
def test_lines_are_part_of_the_answer_when_they_make_a_quarter_of_the_noise(shares, words):
    """Alone or together; weaker ones are in the list only."""
    lines = [SimpleNamespace(frequency=40.0 * k, rms=0.01 / k, share=share)
             for k, share in enumerate(shares, 1)]
    level = SimpleNamespace(label='all', lines=SimpleNamespace(lines=lines))
    answer = headline(overview(flight(), 15.2, [level]))
    assert answer.endswith(f'{words}.') if words else 'line' not in answer
