"""Notches: one filter, and notches that follow the motors: frequencies, off, bad input."""

import cmath
import math
import random

import numpy as np
from ou_monitor import AdaptiveNotch
from ou_monitor.online.notch import HIGHEST, Notch, phase_lag, WIDTHS
import pytest


# Bandwidths over frequency that the proof is for.
NARROWEST, WIDEST = 0.08, 2.0


def notch(ratio, width, share=1.0, x=0.0):
    one = Notch(x)
    one.ratio, one.width, one.depth = ratio, width, share
    return one


@pytest.mark.parametrize('ratio, width, share', [
    (0.1, 0.3, 1.0), (0.28, 1.0, 1.0), (0.44, 0.1, 1.0), (0.2, 0.5, 0.4)])
def test_response_is_what_a_tone_shows(ratio, width, share):
    """After its transient a tone is multiplied by the response, in amplitude and phase."""
    one = notch(ratio, width, share)
    at = 0.5 * ratio
    n = 4000
    out = np.array([one.advance(math.cos(2 * math.pi * at * k)) for k in range(n)])
    late = np.arange(n - 1000, n)
    # 1000 samples hold whole periods of each of these tones.
    seen = 2.0 * np.mean(out[late] * np.exp(-2j * math.pi * at * late))
    assert seen == pytest.approx(one.response(at), abs=1e-9)
    assert phase_lag([one], at) == pytest.approx(-cmath.phase(seen), abs=1e-9)


def test_its_own_frequency_is_gone_and_the_mean_stays():
    """The zero lies on the frequency exactly: what is left is rounding."""
    one = notch(0.28, 0.3)
    out = [one.advance(2.0 + math.sin(2 * math.pi * 0.28 * k)) for k in range(2000)]
    assert max(abs(y - 2.0) for y in out[-200:]) < 1e-9
    assert notch(0.28, 0.3).response(0.28) == pytest.approx(0.0, abs=1e-12)


def test_delay_of_slow_signals():
    """Far below it a notch lags by width / (2 pi f), the analogue of tan(pi r) / pi r less."""
    r, k = 0.05, 0.4
    lag = phase_lag([notch(r, k)], 1e-5) / (2 * math.pi * 1e-5)
    assert lag == pytest.approx(k / (2 * math.tan(math.pi * r)), rel=1e-6)


def test_what_was_built_up_dies_out():
    """Without input the energy of the proof never grows, whatever the coefficients do."""
    rng = random.Random(1)
    e = 2.0 * NARROWEST / (4.0 + NARROWEST**2)
    one = notch(0.3, 0.2)
    one._s1, one._s2 = 1.0, -2.0
    energy = math.inf
    for _ in range(3000):
        one.ratio, one.width = rng.uniform(1e-3, HIGHEST), rng.uniform(NARROWEST, WIDEST)
        one.advance(0.0)
        now = one._s1**2 + one._s2**2 + 2.0 * e * one._s1 * one._s2
        assert now <= energy * (1.0 + 1e-12)
        energy = now
    assert energy < 1e-12


def test_widths_in_use_are_those_of_the_proof():
    """What is chosen from lies within what the bound is for."""
    assert NARROWEST <= WIDTHS.min() and WIDTHS.max() <= WIDEST


RATE = 1000.0
A, B = -40.0, 420.0


def flight(seconds=6.0, line=30.0, seed=0, rate=RATE):
    """Throttle that moves, a line that follows it as motors do, white noise, a manoeuvre."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate)
    t = np.arange(n) / rate
    throttle = 0.45 + 0.2 * np.sin(2 * np.pi * 0.4 * t) + 0.1 * np.sin(2 * np.pi * 0.93 * t)
    root = np.sqrt(throttle)
    for k in range(1, n):
        root[k] = root[k - 1] + (root[k] - root[k - 1]) * -math.expm1(-1 / (0.03 * rate))
    f = A + B * root
    x = 100.0 * np.sin(2 * np.pi * 1.5 * t) + rng.standard_normal(n)
    return t, x + line * np.sin(2 * np.pi * np.cumsum(f) / rate), throttle, f


def high(x):
    """Rms of the second differences: what is fast."""
    return math.sqrt(np.mean(np.diff(x, 2)**2))


def test_learns_the_law_and_takes_the_line_away():
    """The law is found within the width of the notch, and what is left is near the noise."""
    t, x, throttle, f = flight()
    notch = AdaptiveNotch()
    y = notch.filter(t, x, throttle)
    late = t > 3.0
    a, b = notch.law
    assert np.max(np.abs(a + b * np.sqrt(throttle) - (A + B * np.sqrt(throttle)))) < 12.0
    assert notch.active and notch.source == 'throttle'
    assert notch.frequencies == pytest.approx(f[-1], abs=12.0)
    clean = flight(line=0.0)[1]
    # 4 to 5 % off in frequency a notch of width 0.3 or more leaves a quarter of the line at most.
    assert high(y[late]) < high(clean[late]) + 0.25 * (high(x[late]) - high(clean[late]))


def test_follows_the_rpm():
    """With the speed of each motor there is a notch on each, at once where it is."""
    t, x, throttle, f = flight()
    two = x + 30.0 * np.sin(2 * np.pi * np.cumsum(1.12 * f) / RATE)
    rpm = 60.0 * np.column_stack((f, 1.12 * f))
    notch = AdaptiveNotch()
    y = notch.filter(t, two, throttle, rpm)
    assert notch.source == 'rpm'
    assert notch.frequencies == pytest.approx([f[-1], 1.12 * f[-1]], rel=0.01)
    late = t > 3.0
    assert high(y[late]) < 1.5 * high(flight(line=0.0)[1][late])


def test_erpm_needs_the_poles():
    t, x, _, f = flight(3.0)
    notch = AdaptiveNotch(rpm_unit='erpm', poles=14)
    notch.filter(t, x, rpm=60.0 * 7.0 * f)
    assert notch.frequencies == pytest.approx(f[-1], rel=0.01)
    turns = AdaptiveNotch(rpm_unit='rad_s')
    turns.filter(t, x, rpm=2.0 * np.pi * f)
    assert turns.frequencies == pytest.approx(f[-1], rel=0.01)
    with pytest.raises(ValueError, match=r"notch.rpm_unit 'erpm' needs notch.poles.*got 0"):
        AdaptiveNotch(rpm_unit='erpm')
    with pytest.raises(ValueError, match='even number of magnets.*got 7'):
        notch.configure(poles=7)
    assert notch.settings.poles == 14


def test_off_where_it_does_not_pay():
    """In white noise a notch takes less than it costs: the output is the input, bit for bit."""
    t, x, throttle, _ = flight(12.0, line=0.0)
    notch = AdaptiveNotch()
    assert np.array_equal(notch.filter(t, x, throttle), x)
    assert not notch.active and notch.delay == 0.0 and notch.frequencies.size == 0


def test_gives_up_a_line_that_ends_and_fades():
    """On and off come within seconds, and in between no sample steps."""
    t, x, throttle, _ = flight(26.0)
    x = np.where(t < 6.0, x, flight(26.0, line=0.0)[1])
    notch = AdaptiveNotch()
    y = notch.filter(t[t < 6.0], x[t < 6.0], throttle[t < 6.0])
    assert notch.active
    rest = notch.filter(t[t >= 6.0], x[t >= 6.0], throttle[t >= 6.0])
    assert not notch.active
    taken = x - np.concatenate((y, rest))
    # What is taken away is at most a line of 30 at 330 Hz and noise of 1; a step would stand out
    # of its slope, which is 2 sin(pi 0.33) 30 = 52.
    assert np.max(np.abs(np.diff(taken))) < 60.0


def test_causal_and_carried_over():
    """In pieces it is what it is in one; what comes later changes nothing of what was."""
    t, x, throttle, f = flight(4.0)
    rpm = 60.0 * f
    whole = AdaptiveNotch().filter(t, x, throttle, rpm)
    notch = AdaptiveNotch()
    edges = [0, 1, 700, 701, 2500, 4000]
    pieces = [notch.filter(t[a:b], x[a:b], throttle[a:b], rpm[a:b])
              for a, b in zip(edges, edges[1:])]
    assert np.array_equal(np.concatenate(pieces), whole)
    one = AdaptiveNotch()
    assert [one.filter(*map(float, row)) for row in zip(
        t[:50], x[:50], throttle[:50], rpm[:50])] == whole[:50].tolist()


def test_channels_are_judged_apart():
    """A quiet axis beside a loud one stays as it is, and may change its mind alone."""
    t, x, throttle, _ = flight()
    quiet = flight(line=0.0, seed=1)[1]
    both = np.column_stack((x, quiet))
    y = AdaptiveNotch().filter(t, both, throttle)
    assert y.shape == both.shape
    assert np.array_equal(y[:, 1], quiet) and high(y[t > 3.0, 0]) < 0.4 * high(x[t > 3.0])


def test_rpm_that_stops():
    """Motor speeds that stop give way to throttle, throttle that stops to nothing."""
    t, x, throttle, f = flight(8.0)
    rpm = np.where(t < 4.0, 60.0 * f, np.nan)
    throttle = np.where(t < 6.0, throttle, np.nan)
    notch = AdaptiveNotch()
    sources = [(notch.filter(t[k:k + 500], x[k:k + 500], throttle[k:k + 500], rpm[k:k + 500]),
                notch.source)[1] for k in range(0, 8000, 500)]
    assert sources[6:8] == ['rpm', 'rpm'] and sources[9:12] == ['throttle'] * 3
    assert sources[14:] == ['none', 'none'] and not notch.active


def test_rpm_that_freezes():
    """A speed that changed and now stands still to the last digit is gone; a constant is not."""
    t, x, throttle, f = flight(8.0)
    rpm = 60.0 * f
    rpm[4000:] = rpm[4000]
    notch = AdaptiveNotch()
    notch.filter(t, x, throttle, rpm)
    assert notch.source == 'throttle'
    steady = AdaptiveNotch()
    noise = np.random.default_rng(0).standard_normal(t.size)
    tone = np.sin(2 * np.pi * 200.0 * t) + 0.01 * noise
    steady.filter(t, tone, rpm=12000.0)
    assert steady.frequencies == pytest.approx(200.0)


def test_delay_is_what_the_output_shows():
    t, x, throttle, f = flight(8.0)
    rpm = np.full(t.size, 60.0 * 250.0)
    slow = 1e3 * np.sin(2 * np.pi * 10.0 * t)
    tone = 1e3 * np.sin(2 * np.pi * 250.0 * t)
    notch = AdaptiveNotch()
    y = notch.filter(t, slow + tone, rpm=rpm)
    late = slice(7000, 8000)
    turned = np.mean(y[late] * np.exp(-2j * np.pi * 10.0 * t[late])) / np.mean(
        slow[late] * np.exp(-2j * np.pi * 10.0 * t[late]))
    assert notch.active
    # What the fade of half a second ago left is below 1e-6.
    assert notch.delay == pytest.approx(-np.angle(turned) / (2 * np.pi * 10.0), rel=1e-3)
    assert notch.delay == pytest.approx(
        max(phase_lag(bank, 0.01) for bank in notch._banks) / (2 * np.pi * 10.0))


def test_what_is_above_half_the_sample_rate():
    """A motor that is too fast for the samples has no notch; the others keep theirs."""
    t, x, throttle, f = flight(4.0)
    rpm = 60.0 * np.column_stack((f, np.full(t.size, 700.0)))
    notch = AdaptiveNotch()
    notch.filter(t, x, throttle, rpm)
    assert notch.source == 'rpm'
    assert np.allclose(notch.frequencies, f[-1], rtol=0.01)


def test_bad_samples_are_counted_and_do_not_move_the_output():
    t, x, throttle, f = flight(4.0)
    t, x = t.copy(), x.copy()
    x[1500], x[1600], t[1700], t[1800] = np.nan, np.inf, t[1699], t[1790]
    t[2500:] += 3.0
    throttle[3000:3010] = np.nan
    notch = AdaptiveNotch()
    y = notch.filter(t, x, throttle)
    assert (notch.counters.non_finite, notch.counters.repeated) == (2, 1)
    # After the step back the stamps go on 11 ms later: one gap more than that of 3 s.
    assert (notch.counters.back, notch.counters.gaps) == (1, 2)
    assert np.all(np.isfinite(y)) and np.max(np.abs(y)) < 160.0
    assert notch.active


def test_a_new_rate_begins_anew():
    """After a jump of the rate it learns again, at the frequency in Hz that it has then."""
    t, x, throttle, f = flight(4.0)
    t2, x2, throttle2, f2 = flight(6.0, rate=2000.0)
    notch = AdaptiveNotch()
    notch.filter(t, x, throttle)
    notch.filter(t[-1] + 1e-3 + t2, x2, throttle2)
    assert notch.rate == pytest.approx(2000.0, rel=1e-6)
    assert notch.frequencies == pytest.approx(f2[-1], abs=12.0)


@pytest.mark.parametrize('options, words', [
    ({'count': -1}, 'within 0..4'), ({'count': 5}, 'within 0..4'),
    ({'fmin': math.nan}, 'finite number'), ({'fmn': 60.0}, "unknown notch option 'fmn'"),
    ({'rpm_unit': 'rps'}, "unknown 'rps'")])
def test_options_are_checked(options, words):
    """What cannot be used is refused in one line."""
    with pytest.raises(ValueError, match=words):
        AdaptiveNotch(**options)


def test_shapes_are_checked():
    """Shapes that do not fit are refused, and so is another number of channels."""
    notch = AdaptiveNotch()
    with pytest.raises(ValueError, match='t must be'):
        notch.filter([0.0, 1.0], [0.0])
    with pytest.raises(ValueError, match='throttle must be'):
        notch.filter([0.0, 1.0], [0.0, 1.0], [0.5])
    with pytest.raises(ValueError, match='rpm must be'):
        notch.filter([0.0, 1.0], [0.0, 1.0], rpm=[[1.0]])
    notch.filter(0.0, [1.0, 2.0])
    with pytest.raises(ValueError, match='channels changed from 2 to 1'):
        notch.filter(1.0, 1.0)


def test_none_at_all():
    """With count 0 what is in force fades, and nothing is learned."""
    t, x, throttle, f = flight()
    rpm = 60.0 * np.column_stack((f, f))
    notch = AdaptiveNotch()
    notch.filter(t, x, throttle, rpm)
    assert notch.active
    notch.configure(count=0)
    y = notch.filter(t + 6.0, x, throttle, rpm)
    assert not notch.active and np.array_equal(y[300:], x[300:]) and y[0] != x[0]


def test_places_of_motors_that_are_not_there():
    t, x, throttle, f = flight(3.0)
    rpm = np.zeros((t.size, 8))
    rpm[:, 2], rpm[:, 5] = 60.0 * f, 60.0 * 1.1 * f
    notch = AdaptiveNotch()
    notch.filter(t, x, throttle, rpm)
    assert notch._motors == pytest.approx([f[-1], 1.1 * f[-1]])


def test_more_motors_than_notches_share_them_with_their_neighbours():
    """Two pairs, 10 Hz apart within each, and two notches: one at the mean of each pair."""
    t, x, throttle, _ = flight(4.0, line=0.0)
    speeds = np.array([330.0, 200.0, 210.0, 320.0])
    for f in speeds:
        x = x + 30.0 * np.sin(2.0 * np.pi * f * t)
    notch = AdaptiveNotch(rpm_unit='hz', count=2)
    # As speeds that are measured, they are never twice the same.
    jitter = 1e-3 * np.random.default_rng(1).standard_normal((t.size, 1))
    notch.filter(t, x, throttle, speeds + jitter)
    assert notch.source == 'rpm'
    assert sorted(notch.frequencies) == pytest.approx([205.0, 325.0], abs=0.1)
