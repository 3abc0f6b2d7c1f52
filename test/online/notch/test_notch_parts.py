"""Motor speeds, frames, the law of the motors and the choice of notches: each by itself."""

import math

import numpy as np
from numpy.testing import assert_allclose
from ou_monitor.online.notch.notch import (
    Candidate, families, Family, HIGH, LOW, MotorLaw, NewestSpeeds, NotchChoice, NotchFrames)
import pytest

NAN = math.nan


def test_speeds_in_hertz_and_how_old_they_may_be():
    """The sign is the sense of rotation; NaN: nothing came of that motor."""
    speeds = NewestSpeeds(1.0 / 60.0, 0.5)
    assert speeds.now(0.0, 4) == []
    speeds.take(1.0, [6000.0, -9000.0])
    assert speeds.now(1.5, 4) == [100.0, 150.0] and speeds.now(1.51, 4) == []
    assert speeds.now(1.0, 0) == []
    speeds.take(2.0, [NAN, NAN])
    assert speeds.now(2.0, 4) == []
    speeds.configure(1.0 / 60.0, 2.0)
    assert speeds.now(2.0, 4) == [100.0, 150.0]
    speeds.configure(1.0, 2.0)
    assert speeds.now(2.0, 4) == []


@pytest.mark.parametrize('most, expected', [
    (8, [0.0, 40.0, 10.0, 30.0, 20.0, 50.0]), (5, [10.0, 20.0, 30.0, 40.0, 50.0]),
    (4, [10.0, 20.0, 35.0, 50.0]), (3, [15.0, 30.0, 45.0]), (2, [15.0, 40.0]), (1, [30.0])])
def test_more_motors_than_notches_share_them_with_their_neighbours(most, expected):
    """Groups of equal size, as near as may be; places without a motor, at 0, are left out."""
    speeds = NewestSpeeds(1.0, 1.0)
    speeds.take(0.0, [0.0, 40.0, 10.0, 30.0, 20.0, 50.0])
    assert speeds.now(0.0, most) == expected


@pytest.mark.parametrize('changes, usual', [(20, 0.01), (20, 0.1), (19, 0.1)])
def test_speeds_that_freeze_are_not_known(changes, usual):
    """After 20 changes, and 50 usual times between them, but not within a second."""
    speeds = NewestSpeeds(1.0, 100.0)
    for k in range(changes + 1):
        speeds.take(k * usual, [100.0 + k])
    last = changes * usual
    limit = max(1.0, 50.0 * usual)
    for age, known in ((0.99 * limit, True), (1.01 * limit, changes < 20)):
        speeds.take(last + age, [100.0 + changes])
        assert bool(speeds.now(last + age, 4)) == known
    # Time that goes back begins anew.
    speeds.take(0.0, [100.0 + changes])
    assert speeds.now(0.0, 4)


def test_a_frame_is_the_spectrum_of_the_slope():
    """Of a sine of amplitude A at a bin: the bins beside it hold (2 pi f A)^2 / 2 together."""
    interval, f, amplitude = 1e-3, 40.0, 3.0
    frames = NotchFrames(interval)
    assert (frames.size, frames.hop) == (250, 62)
    assert_allclose(frames.frequencies, np.arange(126) * 4.0)
    due = []
    for k in range(400):
        t = k * interval
        x = amplitude * math.sin(2.0 * math.pi * f * t)
        if frames.add(t, [x, 0.5 * x, float(k)]):
            due.append(k)
            power, rest = frames.take(2)
            assert_allclose(rest, [k - 125.0])
            slope = 2.0 / interval * math.sin(math.pi * f * interval) * amplitude
            assert power[0].sum() == pytest.approx(0.5 * slope ** 2, rel=1e-3)
            assert_allclose(power[1], 0.25 * power[0])
            assert power[0].argmax() == 10 and power[0, 9:12].sum() > 0.99 * power[0].sum()
    assert due == [250, 312, 374]
    # A gap of more than five intervals begins anew; a smaller one is drawn straight.
    assert not frames.add(0.4 + 5.1 * interval, [0.0, 0.0, 0.0])
    for k in range(249):
        assert not frames.add(0.4 + (6.1 + k) * interval, [0.0, 0.0, 0.0])
    assert frames.add(0.4 + 255.1 * interval, [0.0, 0.0, 0.0])


def test_samples_at_uneven_times_are_put_onto_an_even_grid():
    """A straight line stays one: its slope is constant, all in the lowest bins."""
    rng = np.random.default_rng(1)
    frames = NotchFrames(1e-3)
    t = 0.0
    for _ in range(251):
        t += 1e-3 * rng.uniform(0.5, 1.5)
        due = frames.add(t, [7.0 * t])
    assert due
    power, _ = frames.take(1)
    assert power[0, 4:].sum() < 1e-6 * power[0].sum()
    assert NotchFrames(0.1).size == 16 and NotchFrames(1e-6).size == 4096
    assert NotchFrames(0.1).hop == 4


@pytest.mark.parametrize('a, b', [(0.0, 300.0), (-40.0, 420.0), (60.0, 250.0)])
def test_a_law_of_the_motors_is_found_on_its_grid(a, b):
    """From lines at changing throttle, within a few per cent; the prior is proportional."""
    frequencies = np.arange(126) * 4.0
    law = MotorLaw(frequencies, 60.0, 1000.0)
    assert math.isnan(law.a) and math.isnan(law.b)
    rng = np.random.default_rng(2)
    for _ in range(200):
        root = rng.uniform(LOW, HIGH)
        power = np.exp(-0.5 * ((frequencies - a - b * root) / 6.0) ** 2)
        law.learn(power / power.sum(), root, 0.0625, 1.0)
    for root in (0.45, 0.6, 0.8):
        assert law.frequency(root) == pytest.approx(a + b * root, rel=0.06)
    # Most of what was is forgotten within two minutes, or at once where it counts for nothing.
    for _ in range(40):
        root = rng.uniform(LOW, HIGH)
        power = np.exp(-0.5 * ((frequencies - 1.3 * (a + b * root)) / 6.0) ** 2)
        law.learn(power / power.sum(), root, 0.0625, 0.8)
    assert law.frequency(0.6) == pytest.approx(1.3 * (a + b * 0.6), rel=0.08)


def test_families():
    """One or two notches on either source; one a motor where there may be several."""
    assert families(1) == (Family('throttle', False, 1), Family('rpm', False, 1))
    assert families(4) == (
        Family('throttle', False, 1), Family('throttle', False, 2), Family('rpm', False, 1),
        Family('rpm', False, 2), Family('rpm', True, 1))


def choice(count=1, channels=1):
    return NotchChoice(np.arange(126) * 4.0, (60.0, 90.0), 1000.0, channels, count)


def frame(line=0.0, f=160.0):
    """Return a frame of white noise of the slope, and a line."""
    frequencies = np.arange(126) * 4.0
    return (1e-3 * (frequencies / 100.0) ** 2
            + line * np.exp(-0.5 * ((frequencies - f) / 3.0) ** 2))[None, :]


def test_a_notch_is_chosen_after_six_frames_where_it_pays():
    """On a line that makes most of the noise; without the line never."""
    for line, expected in ((1.0, True), (0.0, False)):
        one = choice()
        for k in range(12):
            power, lost = one.usual(frame(line), 0.0625)
            # As loud as the one before, which counts for less by half of what two seconds take.
            assert lost == (pytest.approx(math.exp(-0.25 * 0.0625)) if k else 0.0)
            one.take(power, 160.0, np.empty(0), 0.0625)
            one.decide({'throttle'})
            assert (one.chosen[0] is not None) == (expected and k >= 5)
        if expected:
            assert one.chosen[0].family == Family('throttle', False, 1)
            # The source is lost: no notch.
            one.decide(set())
            assert one.chosen == [None]


def test_frames_without_a_frequency_or_outside_the_range_do_not_count():
    one = choice()
    for f in (NAN, 59.0, 500.0):
        for _ in range(12):
            one.take(one.usual(frame(1.0), 0.0625)[0], f, np.empty(0), 0.0625)
        one.decide({'throttle'})
        assert one.chosen == [None]


def test_each_channel_has_its_own_notch():
    one = choice(2, 2)
    power = np.concatenate((frame(1.0), frame(0.0)))
    for _ in range(8):
        one.take(one.usual(power, 0.0625)[0], NAN, np.array([155.0, 165.0]), 0.0625)
    one.decide({'rpm'})
    assert isinstance(one.chosen[0], Candidate) and one.chosen[1] is None
    assert one.chosen[0].family.source == 'rpm'
    seen = one.low_passed(power)
    assert seen[0] == 0.0 and seen[14] == 0.0 and seen[15] > 0.0
    assert seen[40] == pytest.approx(power[:, 40].mean() / (
        1.0 + (math.tan(math.pi * 0.16) / math.tan(math.pi * 0.09)) ** 4), rel=1e-6)
