"""Stamps from source timestamps: even where the source is steady, untouched where it is not."""

import math

import numpy as np
from ou_monitor.nodes.send_clock import line_under, SendClock
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


def test_sigma_through_a_busy_machine():
    """The reason for it all: intervals of 20 us multiply sigma."""
    rng = np.random.default_rng(4)
    due, sent = sent_by_a_busy_machine(rng, 6000, 0.001)
    phi = math.exp(-0.063)
    noise = rng.normal(size=6000) * math.sqrt(1.0 - phi * phi)
    u = np.zeros(6000)
    for k in range(1, 6000):
        u[k] = phi * u[k - 1] + noise[k]
    clock = SendClock()
    out = np.array([clock(s) for s in sent])

    def sigma(t):
        dt = np.diff(t[1000:])
        shrink = np.exp(-63.0 * dt)
        step = u[1001:] - shrink * u[1000:-1]
        return math.sqrt(np.mean(step ** 2 / -np.expm1(-126.0 * dt)))
    # 5000 samples: 1 % of sampling error, 4 % of spacing.
    assert sigma(due) == pytest.approx(1.0, abs=0.03)
    assert sigma(sent) > 1.2
    assert sigma(out) == pytest.approx(1.0, abs=0.05)


def test_an_irregular_source_is_left_alone():
    """Of a Poisson source the sent times are all there is."""
    rng = np.random.default_rng(5)
    sent = 1.7e9 + np.cumsum(rng.exponential(0.001, 5000))
    clock = SendClock()
    assert [clock(s) for s in sent] == sent.tolist()
    assert math.isnan(clock.rate)


def test_a_gap_is_a_gap():
    """A second without messages is seen in the stamps, and the line goes on after it."""
    clock = SendClock()
    for k in range(1000):
        clock(0.001 * k)
    assert clock(2.0) == 2.0
    assert clock(2.001) == pytest.approx(2.001)


def test_going_back_is_going_back():
    """A replay that begins anew, or a clock set back."""
    clock = SendClock()
    for k in range(1000):
        clock(100.0 + 0.001 * k)
    assert clock(3.0) == 3.0
    assert clock(3.001) == pytest.approx(3.001)


def test_a_lost_message_is_made_up_slowly():
    """One of 1000 lost: the line is one period behind, and leans."""
    clock = SendClock()
    for k in range(2000):
        clock(0.001 * k)
    after = [clock(0.001 * k) for k in range(2001, 8000)]
    assert np.diff(after).max() < 0.00101
    assert after[-1] == pytest.approx(7.999, abs=1e-4)


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


def test_the_line_under_late_times():
    """Half of the messages are late by up to 50 periods; the period is exact all the same."""
    rng = np.random.default_rng(6)
    late = rng.uniform(0.0, 0.05, 400) * (rng.random(400) < 0.5)
    period, share = line_under((1.7e9 + 0.001 * np.arange(400) + late).tolist())
    # Unix seconds in floats are good to 2.4e-7 s, over a hull edge of some 10 messages at least.
    assert period == pytest.approx(0.001, abs=1e-7)
    # Half are on time, and of the late ones 1 in 50 is late by less than a period.
    assert share == pytest.approx(0.51, abs=0.1)
