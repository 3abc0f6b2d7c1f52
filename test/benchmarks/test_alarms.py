"""What the alarms of the closed loop and of the autopilots are, where the answer is known."""

from alarms import ardupilot_low, dips_of, fly_loop, px4_charge
import numpy as np
import pytest


def test_dips_are_critical_within_100_ms_and_a_healthy_flight_is_quiet():
    """Each dip of 20 to 500 ms, none missed; nothing in half a minute without."""
    wrong, delays, missed = fly_loop(3, 0.0, 6)
    assert (wrong, missed, len(delays)) == (0, 0, 6)
    assert max(delays) <= 0.1 + 1e-9
    assert fly_loop(4, 1.0, 0) == (0, [], 0)


def test_ardupilot_waits_ten_seconds_without_a_break():
    """One reading above the limit starts the timer anew; the voltage at rest adds R I."""
    t = np.arange(0.0, 40.0, 0.1)
    low = np.full(t.size, 10.0)
    none = np.zeros(t.size)
    on = ardupilot_low(t, low, none, 10.5, at_rest=False)
    assert t[np.flatnonzero(on)[0]] == pytest.approx(10.1)
    low[95] = 10.6
    on = ardupilot_low(t, low, none, 10.5, at_rest=False)
    assert t[np.flatnonzero(on)[0]] == pytest.approx(t[96] + 10.1)
    # A load of 40 mOhm that switches between 5 and 30 A: 12 V at rest, 10.8 V under load.
    current = np.where(np.floor(t).astype(int) % 2, 30.0, 5.0)
    voltage = 12.0 - 0.04 * current
    assert ardupilot_low(t, np.minimum(voltage, 11.0), none, 11.2, at_rest=True)[-1]
    assert not ardupilot_low(t, voltage, current, 11.2, at_rest=True).any()


def test_px4_takes_the_sag_out_where_it_knows_the_current():
    """Charge of a cell at rest, 0.45 V from empty to full, through a low-pass of 1 s."""
    t = np.arange(0.0, 30.0, 0.02)
    current = np.where(np.floor(t).astype(int) % 2, 30.0, 5.0)
    voltage = 4 * (3.825 - 0.005 * current)
    assert px4_charge(t, voltage, current, 4)[-1] == pytest.approx(0.5, abs=0.01)
    bare = px4_charge(t, voltage, np.zeros(t.size), 4)
    assert 0.1 < bare[t > 10.0].min() < bare[t > 10.0].max() < 0.5


def test_a_dip_ends_above_the_limit_and_near_ones_are_one():
    """Three runs below the limit, two of them 0.2 s apart; what is before 20 s does not count."""
    t = np.arange(0.0, 40.0, 0.02)
    v = np.full(t.size, 12.0)
    for begin, end in ((10.0, 10.2), (25.0, 25.1), (25.3, 25.5), (30.0, 30.1)):
        v[(t >= begin - 1e-9) & (t < end - 1e-9)] = 10.0
    found = dips_of(t, v, 11.0, 0.01)
    assert np.allclose(found, [[25.0, 25.5], [30.0, 30.1]])
