"""Times of messages without a stamp: a steady source, bursts, and simulated time."""

import math
import random

import numpy as np
from ou_monitor import SlidingEstimator
from ou_monitor.model.ou import simulate
from ou_monitor.nodes.clocks import line_under, NEAR, ON_LINE, PAIRS, SendClock, SimClockMap
import pytest


def sent_by_a_busy_machine(rng, n, period):
    """Return source times: a timer, small delays, and pauses of 5..40 ms caught up in bursts."""
    due = 1.7e9 + period * np.arange(n)
    ready = due + rng.exponential(0.05 * period, n)
    for k in rng.integers(0, n, max(n // 500, 1)):
        ready[k:] = np.maximum(ready[k:], ready[k] + rng.uniform(0.005, 0.04))
    sent = np.maximum.accumulate(ready)
    # One message takes 20 us to send.
    for k in range(1, n):
        sent[k] = max(sent[k], sent[k - 1] + 20e-6)
    return due, sent


def test_a_steady_source_becomes_even():
    """Spacing within 5 % at 1 kHz where the sent spacing was wrong by up to 4000 %."""
    rng = np.random.default_rng(3)
    due, sent = sent_by_a_busy_machine(rng, 8000, 0.001)
    clock = SendClock()
    out = np.array([clock(s) for s in sent])[1000:]
    spacing = np.diff(out)
    assert np.diff(sent).max() > 0.005 and np.diff(sent).min() < 0.0001
    # A pause p moves the line by gain p = p / FOLLOW periods a message: at most 4 % for 40 ms.
    assert spacing.min() > 0.00095 and spacing.max() < 0.00105
    assert clock.rate == pytest.approx(1000.0, rel=0.01)
    # The line stays at the mean delay, within what the pauses add to it.
    assert np.abs(out - due[1000:]).max() < 0.04


def test_an_irregular_source_is_left_alone():
    rng = np.random.default_rng(5)
    sent = 1.7e9 + np.cumsum(rng.exponential(0.001, 5000))
    clock = SendClock()
    assert [clock(s) for s in sent] == sent.tolist()
    assert math.isnan(clock.rate)


@pytest.mark.parametrize('begin, after', [(0.0, 2.0), (100.0, 3.0)])
def test_gaps_and_steps_back_stay_in_the_stamps(begin, after):
    """A second without messages, or a clock set back; the line goes on after it."""
    clock = SendClock()
    for k in range(1000):
        clock(begin + 0.001 * k)
    assert clock(after) == after
    assert clock(after + 0.001) == pytest.approx(after + 0.001)


def test_a_change_of_rate_is_followed():
    """From 1 kHz to 200 Hz: the period within 400 messages, the phase within seconds."""
    clock = SendClock()
    for k in range(1000):
        clock(0.001 * k)
    stamps = [clock(1.0 + 0.005 * k) for k in range(1600)]
    assert clock.rate == pytest.approx(200.0, rel=1e-6)
    # It can be off by 0.25 s (`GAP`) at most; 1200 messages, 6 s, later by exp(-6) of that.
    assert stamps[-1] == pytest.approx(1.0 + 0.005 * 1599, abs=0.001)


@pytest.mark.parametrize('period', [0.5, 2.0])
def test_slow_sources_follow_their_stamps(period):
    """A battery message a second: hardly anything to smooth."""
    clock = SendClock()
    out = [clock(period * k) for k in range(200)]
    assert out == pytest.approx([period * k for k in range(200)], abs=1e-6)


def paused_at_10_khz(rng, seconds, pauses, lost):
    """Return true stamps, source times and voltages of unstamped scalars at 10 kHz."""
    # The clock is 50 ppm off; the process stands still for 5..50 ms, `pauses` times a second, and
    # catches up at 10 us a message; some messages are lost.
    n = round(1e4 * seconds)
    due = 1e-4 * (1.0 + 50e-6) * np.arange(n)
    ready = due + rng.exponential(5e-6, n)
    for at in np.sort(rng.uniform(0.0, seconds, rng.poisson(pauses * seconds))):
        end = at + rng.uniform(0.005, 0.05)
        ready[slice(*np.searchsorted(ready, [at, end]))] = end
    cost = 10e-6 * np.arange(n)
    sent = np.maximum.accumulate(ready - cost) + cost
    keep = rng.random(n) >= lost
    voltage = simulate(due, 63.0, 0.632, rng, u0=5.0)
    return due[keep], 1.7e9 + sent[keep], voltage[keep]


def estimates(stamps, sent, voltage):
    """Return alpha and sigma of the 2 s windows that end 3, 4, 5 s after the first message."""
    estimator, found = SlidingEstimator(2.0), []
    edges = np.searchsorted(sent, sent[0] + np.arange(-0.025, 5.03, 0.05))
    for k, (begin, end) in enumerate(zip(edges[:-1], edges[1:]), 1):
        estimator.push(stamps[begin:end], voltage[begin:end])
        if k in (60, 80, 100):
            e = estimator.estimate()
            found.append((e.alpha, e.sigma))
    return np.array(found)


@pytest.mark.parametrize('lost', [0.0, 0.01])
@pytest.mark.parametrize('pauses', [1, 20])
def test_unstamped_scalars_at_10_khz_give_true_alpha_and_sigma(pauses, lost):
    """Alpha and sigma within 5 % of those from true stamps, with pauses of up to half the time."""
    # A pause p moves the line by p / FOLLOW of the time it is made up in: spacing is wrong by 5 %
    # at most, in a window by less: measured 2.6 and 0.6 % at worst in 960 windows.
    due, sent, voltage = paused_at_10_khz(np.random.default_rng(40), 5.1, pauses, lost)
    clock = SendClock()
    stamps = np.array([clock(s) for s in sent.tolist()])
    assert (np.diff(stamps) > 0.0).all()
    assert clock.rate == pytest.approx(1e4, rel=0.001 + 1.5 * lost)
    true = estimates(due, sent, voltage)
    np.testing.assert_allclose(estimates(stamps, sent, voltage), true, rtol=0.05)


@pytest.mark.parametrize('n', [200, 400, 1000, 10_000])
def test_steady_sources_are_told_from_random_ones(n):
    # The distance of a Poisson source is a random walk, NEAR sqrt(n) periods a fixed part of it;
    # losses of 1 % make a walk a tenth as wide.
    rng = np.random.default_rng(7)
    poisson = [line_under(np.cumsum(rng.exponential(1e-3, n)))[1] for _ in range(40)]
    timer = [line_under(1e-3 * np.cumsum(rng.geometric(0.99, n)))[1] for _ in range(40)]
    assert max(poisson) < ON_LINE < 0.5 < min(timer)
    # The limit is no narrower than one period, for few messages.
    assert NEAR * math.sqrt(200) > 1.0


def test_a_gap_at_10_khz_keeps_the_rate():
    """A pause of 0.4 s is a gap; the burst after it pulls the line back, not the rate up."""
    sent = 1e-4 * np.arange(40_000)
    sent[20_000:24_000] = 2.4 + 1e-6 * np.arange(4000)
    sent[24_000:] = np.maximum(sent[24_000:], sent[23_999])
    clock = SendClock()
    stamps, rates = np.array([(clock(s), clock.rate) for s in sent.tolist()]).T
    assert (np.diff(stamps) > 0.0).all()
    np.testing.assert_allclose(rates[2200:], 1e4, rtol=0.01)


@pytest.mark.parametrize('period, mark', [(0.001, 50), (0.0001, 160)])
def test_an_emptied_buffer_is_reported(period, mark):
    """When the samples of a burst were taken is not known, and is not guessed."""
    rng = np.random.default_rng(7)
    ends = period * mark * np.arange(1, int(4.0 / (period * mark)))
    ends = np.maximum.accumulate(ends + rng.exponential(0.1 * mark * period, ends.size))
    sent = np.maximum.accumulate((1.7e9 + ends[:, None] + 20e-6 * np.arange(mark)).ravel())
    clock = SendClock()
    told = []
    for source in sent.tolist():
        assert clock(source) == source
        told.append(clock.in_bursts)
    # From 0.2 s on (`FIRST_SPAN`), with 0.1 s for the judgement.
    first = told.index(True)
    assert sent[first] - sent[0] < 0.4 and all(told[first:])
    assert math.isnan(clock.rate) and clock.settled == 0


def test_random_bursts_are_reported():
    """Exponential gaps between bursts of 50: no even line, and no silence about it."""
    rng = np.random.default_rng(8)
    sent = (1.7e9 + np.cumsum(rng.exponential(0.05, 120))[:, None]
            + 20e-6 * np.arange(50)).ravel()
    sent = np.maximum.accumulate(sent)
    clock = SendClock()
    told = []
    for source in sent.tolist():
        clock(source)
        told.append(clock.in_bursts)
    assert math.isnan(clock.rate) and np.mean(told[-len(told) // 2:]) == 1.0


def test_bursts_with_gaps_are_reported():
    """Of 300 samples every 0.3 s each burst stands alone: the third one is told."""
    clock = SendClock()
    told = []
    for k in range(6):
        for j in range(300):
            clock(0.3 * k + 20e-6 * j)
        told.append(clock.in_bursts)
    assert told == [False, False, True, True, True, True]


def test_a_steady_source_is_not_reported():
    """Neither a timer, a busy machine, a Poisson source, nor a battery message a second."""
    rng = np.random.default_rng(9)
    for sent in (0.001 * np.arange(3000), sent_by_a_busy_machine(rng, 6000, 0.001)[1],
                 np.cumsum(rng.exponential(0.001, 5000)), 1.0 * np.arange(300)):
        clock = SendClock()
        told = []
        for source in sent.tolist():
            clock(source)
            told.append(clock.in_bursts)
        assert not any(told)


@pytest.mark.parametrize('rate', [0.25, 1.0, 4.0, 100.0])
def test_maps_at_the_rate_of_the_replay(rate):
    """A source time between and after pairs lands on the line, at unix-sized numbers."""
    mapped = SimClockMap()
    for k in range(200):
        assert not mapped.add(1.7e9 + 0.01 * k, 1.6e9 + 0.01 * rate * k)
    # Floats hold unix seconds to 2.4e-7 s; some tens of roundings are summed.
    found = mapped(1.7e9 + 1.99) - mapped(1.7e9 + 0.99)
    assert found == pytest.approx(rate, rel=1e-4)
    assert mapped(1.7e9 + 1.503) == pytest.approx(1.6e9 + 1.503 * rate, abs=3e-6 * max(rate, 1))
    assert mapped(1.7e9 + 2.1) == pytest.approx(1.6e9 + 2.1 * rate, abs=2e-5 * max(rate, 1))


def test_nothing_is_known_before_two_pairs():
    """One pair gives a time but no rate."""
    mapped = SimClockMap()
    assert not mapped.ready and math.isnan(mapped(5.0))
    mapped.add(1.0, 10.0)
    assert not mapped.ready and math.isnan(mapped(5.0))
    mapped.add(2.0, 12.0)
    assert mapped.ready and mapped(5.0) == pytest.approx(18.0)


def test_a_clock_that_stops_is_not_run_on():
    """For 1 s, or five of its intervals, the line is continued; then nothing is known."""
    quick, slow = SimClockMap(), SimClockMap()
    for k in range(10):
        quick.add(0.01 * k, 0.02 * k)
        slow.add(1.0 * k, 2.0 * k)
    assert quick(0.09 + 0.99) == pytest.approx(2.16) and math.isnan(quick(0.09 + 1.01))
    assert slow(13.9) == pytest.approx(27.8) and math.isnan(slow(14.1))
    # It goes on where it stopped: a step, for the line had run on.
    assert quick.add(5.0, 0.2) and not quick.ready


def test_jitter_of_single_ticks_is_averaged():
    """The standard deviation at the end of a fitted line of n points is s 2 / sqrt(n)."""
    rng = random.Random(1)
    mapped, jitter, errors = SimClockMap(), 0.001, []
    for k in range(1000):
        mapped.add(0.01 * k, 0.04 * k + rng.gauss(0.0, jitter))
        if k >= PAIRS:
            errors.append(mapped(0.01 * k) - 0.04 * k)
    rms = math.sqrt(sum(e * e for e in errors) / len(errors))
    # 950 errors in runs of 50: 19 independent ones, so 16 % of rms; 3 times that.
    assert rms == pytest.approx(2.0 * jitter / math.sqrt(PAIRS), rel=0.5)


@pytest.mark.parametrize('clock', [3.0, 40.0])
def test_a_step_voids_what_was_known(clock):
    """A clock that goes back (next pass) or leaps ahead (seek) starts a new line."""
    mapped = SimClockMap()
    for k in range(100):
        mapped.add(0.01 * k, 10.0 + 0.01 * k)
    assert mapped.add(1.0, clock)
    assert not mapped.ready
    assert not mapped.add(1.01, clock + 0.01)
    assert mapped(1.02) == pytest.approx(clock + 0.02)


def test_a_late_tick_is_not_a_step():
    """A tick 50 ms late at rate 100 is 5 s off, and still the same clock."""
    mapped = SimClockMap()
    for k in range(100):
        assert not mapped.add(0.01 * k, k)
    assert not mapped.add(1.05, 100.0)


def test_a_repeated_tick_is_no_pair():
    """Two pairs at one source time give no rate."""
    mapped = SimClockMap()
    mapped.add(1.0, 10.0)
    assert not mapped.add(1.0, 10.0)
    assert not mapped.ready
