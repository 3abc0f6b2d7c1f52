"""What the jitter of the stick makes of the voltage of a level is taken out."""

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.levels import find_levels, without_jitter
from ou_monitor.records import Recording

RATE = 200.0


def recording(sag, jitter, seed=1):
    """Return two levels with a swaying stick, and white noise of 2 mV."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(20 * RATE)) / RATE
    throttle = np.where(t < 10.0, 0.2, 0.5) + jitter * np.sin(2.0 * np.pi * 1.7 * t)
    return Recording(t, 5.0 - sag * throttle + rng.normal(0.0, 0.002, t.size), throttle, 'made')


def test_the_sag_of_a_swaying_stick_goes_and_the_levels_stay():
    """0.5 V at full throttle and a sway of 1 %: 3.5 mV rms beside 2 mV of noise."""
    simulated = recording(0.5, 0.01)
    levels = find_levels(simulated.t, simulated.throttle)
    voltage = without_jitter(simulated, levels)
    for level in levels:
        (s,) = level.segments
        raw, left = simulated.voltage[s.start:s.stop], voltage[s.start:s.stop]
        assert raw.std() > 0.0036
        # The standard deviation of 1900 values is known to 1.6 %.
        assert abs(left.std() / 0.002 - 1.0) < 0.08
        assert abs(left.mean() - (5.0 - 0.5 * level.throttle)) < 5.0 * 0.002 / np.sqrt(1900)


def test_a_throttle_that_stands_still_changes_nothing():
    """Not a bit of the voltage."""
    simulated = recording(0.5, 0.0)
    levels = find_levels(simulated.t, simulated.throttle)
    assert np.array_equal(without_jitter(simulated, levels), simulated.voltage)


def test_without_throttle_the_voltage_is_as_it_was():
    """One level that holds everything has no stick."""
    simulated = recording(0.5, 0.01)
    blind = Recording(simulated.t, simulated.voltage, np.full(simulated.t.size, np.nan), 'made')
    assert np.array_equal(without_jitter(blind, find_levels(blind.t, blind.throttle)),
                          simulated.voltage)


def test_loads_that_come_and_go_are_no_lines():
    """10 A at 1.8 Hz through 0.1 Ohm, measured 50 ms late, at a throttle that stands still."""
    rng = np.random.default_rng(3)
    t = np.arange(int(40 * RATE)) / RATE
    drawn = np.where((1.8 * t) % 1.0 < 0.3, 10.0, 2.0)
    late = np.concatenate((np.full(10, drawn[0]), drawn[:-10]))
    v = 12.0 - 0.1 * drawn + 0.02 * rng.standard_normal(t.size)
    found = analyze(Recording(t, v, np.full(t.size, 0.5), 'made', current=late))
    assert [line for level in found.levels for line in level.lines.lines] == []
