"""Benchmarks on small cases."""

import sys

from alarms import ardupilot_low, dips_of, fly_loop, px4_charge
import attack_files
from filter import RATE, sweep
import numpy as np
from ou_monitor import AdaptiveLowPass
from project import needs_recordings, REAL
import pytest
from scipy import stats


def test_dips_are_critical_within_100_ms_and_a_healthy_flight_is_quiet():
    """Each dip of 20 to 500 ms, none missed; nothing in half a minute without."""
    wrong, delays, missed = fly_loop(3, 0.0, 4)
    assert (wrong, missed, len(delays)) == (0, 0, 4)
    assert max(delays) <= 0.1 + 1e-9
    assert fly_loop(4, 0.5, 0) == (0, [], 0)


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


@pytest.mark.parametrize('order', [1, 2])
@pytest.mark.parametrize('mode', ['lowpass', 'derivative'])
def test_the_sweep_of_cutoffs_is_the_filter_of_the_package(order, mode):
    """At one cutoff, sample by sample; both are exact, so rounding alone remains."""
    x = np.cumsum(np.random.default_rng(4).standard_normal((1, 2000)), axis=1)
    ours = AdaptiveLowPass(order=order, fmin=1.0, fmax=30.0, fallback=20.0, mode=mode).filter(
        np.arange(2000) / RATE, x[0], np.nan)
    found = sweep(x, np.full((1, 1, 1), 20.0), order, mode == 'derivative')[0, 0]
    assert np.abs(found - ours).max() < 1e-9 * np.abs(ours).max()


def test_a_small_attack_runs(monkeypatch, capsys):
    monkeypatch.setattr(sys, 'argv', [
        'attack_files.py', '--mutated', '130', '--crafted', '60', '--sheets', '300', '--seed',
        '11'])
    assert attack_files.main() == 0, capsys.readouterr().err
    said = capsys.readouterr().out
    assert said.splitlines()[-1].startswith('0 faults in 680 readings')
    for kind in ('bits', 'cut', 'swap', 'length', 'crafted', 'csv quote', 'csv cell'):
        assert kind in said


@pytest.fixture(scope='module')
def bench():
    pytest.importorskip('orangebox')
    import coupling
    return coupling


@pytest.fixture(scope='module')
def flights(bench):
    """Return recordings by name; their folder is not part of the project."""
    kept = {'nazgul': bench.LOGS['nazgul']}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, 'LOGS', kept)
        return {one.name: one for one in bench.flights(REAL)}


@needs_recordings
def test_false_alarms_keep_their_rate_and_a_gain_of_five_is_found(bench, flights):
    """At most what a test of 5 % exceeds once in 10^4; the gain is seen in six of six."""
    rng, alarms, power = np.random.default_rng(9), [], []
    for name, other in (('nazgul', 'crazyflie solo'), ('crazyflie solo', 'nazgul'),
                        ('crazyflie pair', 'nazgul')):
        for kind in bench.KINDS:
            for axis in flights[name].axes.values():
                seen = bench.draw(rng, kind, flights[name], axis, flights[other])
                alarms += seen['alarm']
                power += seen['power'] if name == 'nazgul' else []
    assert len(alarms) == 24 and sum(alarms) <= stats.binom.isf(1e-4, 24, 0.05)
    assert len(power) == 12 and all(power)


@needs_recordings
def test_the_voltage_of_a_log_is_taken_where_it_was_read(bench, flights):
    """The quad's at 50 Hz of a log of 1 kHz."""
    from ou_monitor.analysis.coupling import estimate_coupling
    flight = flights['nazgul']
    found = estimate_coupling(flight.t, flight.voltage, flight.gyro_t,
                              flight.axes['gyroADC x'], throttle=flight.throttle)
    assert found.grid.rates[0] == pytest.approx(50.0, rel=0.01)
    assert found.frequency[-1] < 12.6


def ratios(name, seconds, cutoff):
    """Return the cells of one row of the table as numbers, all axes; NaN for a dash."""
    import gyros
    from notch import measure
    (row,) = measure(gyros.read(name, seconds), (cutoff,))
    return [float(cell.split(' ')[0]) if cell != '-' else np.nan for cell in row[4:]]


@needs_recordings
def test_notches_halve_the_noise_of_a_loud_craft():
    """Half and a third of the noise are left, on what was not learned from."""
    pytest.importorskip('orangebox')
    *_, throttle, nothing, _, rpm, _ = ratios('bf3s', 40.0, 80.0)
    assert throttle < 0.5 and nothing < 0.6 and rpm < 0.42


@needs_recordings
def test_notches_cost_a_quiet_craft_at_most_2_percent():
    pytest.importorskip('orangebox')
    *_, throttle, nothing, _, _, _ = ratios('nazgul', 25.0, 80.0)
    assert throttle <= 1.02 and nothing <= 1.02
