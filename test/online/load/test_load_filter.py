"""The load in flight: closed forms, simulated packs, bad input, and the recorded flight."""

import dataclasses

import numpy as np
from ou_monitor.model.load import LAGS, lowpass
from ou_monitor.model.load_fit import BEFORE, LoadFit, LoadInput
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import HOLD, LoadStatus, SupplyLoad
from ou_monitor.recordings.read import read_recording
from project import ROOT
from ou_monitor.timeline import as_columns, TimeLine
from pushed import pushed
import pytest
from simulated_packs import flown, QUAD

# Its sag after a second at full throttle, V.
SAG = 0.15 * 15.2 * (1.0 + 0.2 * -np.expm1(-HOLD / 1.0) + 0.3 * -np.expm1(-HOLD / 20.0))


def throttle_of_a_flight(t, rng):
    steps = np.clip(0.35 + 0.25 * rng.standard_normal(int(2 * t[-1]) + 2), 0.0, 1.0)
    return steps[(2 * t).astype(int)]


def loaded(t, v, u):
    return pushed(LoadFilter(), t, v, u).load()


def test_a_simulated_pack_is_recovered():
    """Sag, level and noise; scalar by scalar gives the same as arrays."""
    t, v, u = flown(3)
    load = loaded(t, v, u)
    assert load.known and load.status is LoadStatus.KNOWN
    for throttle in (0.2, 0.4, 0.6):
        expected = SAG * throttle ** 1.8
        assert abs(float(load.sag(throttle)) - expected) < 3.0 * float(load.sag_se(throttle))
    assert float(load.noise(0.35)) == pytest.approx(0.05, rel=0.3)
    assert load.level == pytest.approx(4 * 4.0, abs=0.4)
    assert load.time_constants == LAGS and np.isnan(load.resistance)
    loads = LoadFilter()
    for one in zip(t.tolist(), v.tolist(), u.tolist()):
        loads.push(*one)
    assert loads.load() == load


@pytest.mark.parametrize('lag', [0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0])
def test_a_lag_of_any_length_is_in_the_sag(lag):
    """0.9 V that lag by 0 to 10 s: the interval holds the sag after a second."""
    # A sag two errors off is outside of half of the intervals, and in all six of a lag with 1/64.
    for seed, power in enumerate((1.0, 1.8, 1.8)):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 60.0, 0.02)
        load = lowpass(throttle_of_a_flight(t, rng), t, 0.06)
        fall = load ** power
        noise = lowpass(0.05 * rng.standard_normal(t.size), t, 0.05)
        found = loaded(t, 8.3 - 0.9 * (lowpass(fall, t, lag) if lag else fall) + noise, load)
        for throttle in (0.6, 1.0):
            true = 0.9 * throttle ** power * (1.0 - np.exp(-HOLD / lag) if lag else 1.0)
            assert abs(found.sag(throttle) - true) < 1.96 * found.sag_se(throttle)


def test_the_sag_rises_and_its_error_has_a_floor():
    """Monotone in throttle; never known better than to a tenth."""
    load = loaded(*flown(3, noise=0.005))
    u = np.linspace(0.0, 1.0, 33)
    assert (np.diff(load.sag(u)) >= 0.0).all()
    assert (load.sag_se(u) >= 0.1 * load.sag(u) - 1e-12).all()


def test_an_extrapolated_sag_is_known_no_better_than_a_measured_one():
    """A law that falls below the throttles flown: its correction crosses zero above them."""
    rng = np.random.default_rng(1)
    t, u = np.arange(6000) / 100.0, np.repeat(rng.uniform(0.42, 0.8, 120), 50)
    v = 4.0 - 0.6 * np.maximum(u - 0.6, 0.0) ** 1.5 + 0.004 * rng.standard_normal(t.size)
    load = loaded(t, v, u)
    flown, beyond = (load.sag_se(np.linspace(*ends, 20)) for ends in (
        load.flown, (load.flown[1] + 0.01, 1.0)))
    assert load.known and flown.max() <= beyond.min() and (np.diff(beyond) >= 0.0).all()


def test_a_held_throttle_ends_at_a_steady_answer():
    """The path ahead forgets its start: a minute later only discharge is left."""
    loads = pushed(LoadFilter(), *flown(3))
    ahead = 40.0 + np.arange(1.0, 120.0)
    path = loads.path(ahead, np.full(ahead.size, 0.4))
    fall = np.diff(path)[80:]
    assert (fall < 0.0).all() and (fall > -0.05).all()
    rested = loads.path(ahead, np.zeros(ahead.size))
    assert np.ptp(rested[90:]) < 1e-3
    assert rested[-1] == pytest.approx(loads.load().level, abs=2e-3)


@pytest.mark.parametrize('throttle, tolerance', [(0.0, 1e-9), (0.5, 5e-3)])
def test_two_half_steps_are_one_in_a_gap(throttle, tolerance):
    """The lags are exact over a gap; discharge takes the slope at its start, 1 mV a second."""
    t, v, u = flown(3)
    u[-25:] = throttle
    loads = pushed(LoadFilter(), t, v, u)
    once = loads.path(np.array([t[-1] + 7.0]), np.array([throttle]))
    twice = loads.path(t[-1] + np.array([3.5, 7.0]), np.array([throttle, throttle]))
    assert once[-1] == pytest.approx(twice[-1], abs=tolerance)


def test_looking_changes_nothing():
    t, v, u = flown(3)
    loads = pushed(LoadFilter(), t, v, u)
    before = loads.load()
    loads.path(t[-1] + np.arange(1.0, 9.0), np.linspace(0.0, 1.0, 8))
    assert loads.load() == before
    with pytest.raises(dataclasses.FrozenInstanceError):
        before.level = 0.0


def test_a_throttle_that_never_moved_says_nothing_of_the_sag():
    t, v, u = flown(3)
    load = loaded(t, 16.0 + 0.05 * np.random.default_rng(1).standard_normal(t.size), 0.0 * u + 0.3)
    assert load.status is LoadStatus.STILL and not load.known
    assert np.isnan(load.sag(0.5)) and np.isnan(load.sag_se(0.5))
    assert float(load.noise(0.3)) == pytest.approx(0.05, rel=0.3) and np.isfinite(load.level)


@pytest.mark.parametrize('seed', range(4))
def test_throttle_of_another_vehicle_is_no_relation(seed):
    t, _, u = flown(3, 60.0)
    v = 16.0 + 0.05 * np.random.default_rng(seed + 10).standard_normal(t.size)
    assert not loaded(t, v, u).known


def test_a_voltage_that_rises_with_throttle_has_no_sag():
    t, v, u = flown(3, 60.0)
    load = loaded(t, v, 1.0 - u)
    assert load.status is LoadStatus.RISES and np.isnan([load.sag(1.0), load.sag_se(1.0)]).all()


def test_throttle_that_is_not_repeated_holds():
    t, v, u = flown(3)
    gap = u.copy()
    gap[1:][np.diff(u) == 0.0] = np.nan
    assert loaded(t, v, gap) == loaded(t, v, u)


@pytest.mark.parametrize('jump', [-1000.0, 1000.0])
def test_a_clock_that_jumps_keeps_the_sag_and_opens_the_level(jump):
    """Another pack, 1 V lower: the sag is known at once, the level within seconds."""
    t, v, u = flown(3)
    loads = pushed(LoadFilter(), t, v, u)
    before = loads.load()
    n = 300
    if jump < 0.0:
        loads.new_time_line()
    loads.push(t[:n] + jump, v[:n] - 1.0, u[:n])
    after = loads.load()
    assert after.known and float(after.sag(0.5)) == pytest.approx(before.sag(0.5), rel=0.2)
    assert after.level == pytest.approx(4 * 4.0 - 1.0, abs=0.3)


def test_a_pack_of_another_size_begins_anew():
    """After a new time line 6 cells for 4 are another craft."""
    t, v, u = flown(3)
    loads = pushed(LoadFilter(), t + 1000.0, v * 1.7, u)
    loads.new_time_line()
    loads.push(t, v, u)
    assert loads.load() == loaded(t, v, u)


def test_throttle_that_was_never_heard():
    t, v, u = flown(3)
    v = 16.0 + 0.05 * np.random.default_rng(1).standard_normal(t.size)
    for throttle in (None, np.full(t.size, np.nan), 100.0 * u + 3.0):
        load = loaded(t, v, throttle)
        assert load.status is LoadStatus.NO_THROTTLE and not load.known
        assert load.level == pytest.approx(16.0, abs=0.02)
        assert float(load.noise(0.7)) == pytest.approx(0.05, rel=0.15)
        assert np.isnan(load.sag(0.5))


def test_throttle_lost_in_flight_and_found_again():
    """What it did is kept; when it is back the sag is known at once."""
    t, v, u = flown(3, 60.0)
    gone = (t > 30.0) & (t < 45.0)
    loads = pushed(LoadFilter(), t[t <= 30.0], v[t <= 30.0], u[t <= 30.0])
    before = loads.load()
    loads.push(t[gone], v[gone])
    lost = loads.load()
    assert lost.status is LoadStatus.NO_THROTTLE and not lost.known
    assert np.isnan(loads.path(t[-1:] + 1.0, np.ones(1))).all()
    np.testing.assert_allclose(lost.sag(0.5), before.sag(0.5), rtol=0.1)
    loads.push(t[t >= 45.0], v[t >= 45.0], u[t >= 45.0])
    after = loads.load()
    assert after.known and float(after.sag(0.5)) == pytest.approx(before.sag(0.5), rel=0.1)
    assert float(after.noise(0.35)) == pytest.approx(0.05, rel=0.3)


def test_a_fast_source_is_averaged():
    """1 kHz in pieces of any size: the same as at once; noise of a sample, settling in it."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 25.0, 0.001)
    u = throttle_of_a_flight(t, rng)
    v = QUAD.path(t, u) + 0.05 * rng.standard_normal(t.size)
    load = loaded(t, v, u)
    assert load.known and 0.05 < float(load.noise(0.35)) < 0.07
    assert float(load.sag(0.5)) == pytest.approx(SAG * 0.5 ** 1.8, rel=0.2)
    loads = LoadFilter()
    start = 0
    while start < t.size:
        piece = slice(start, start + int(rng.integers(1, 60)))
        loads.push(t[piece], v[piece], u[piece])
        start = piece.stop
    other = loads.load()
    np.testing.assert_allclose(other.sag(0.5), load.sag(0.5), rtol=1e-10)


def test_one_sample_a_second():
    """Each counts at once; as throttle between them is not seen, the sag comes out low."""
    t, v, u = flown(3, 300.0)
    t, v, u = t[::50], v[::50], u[::50]
    loads = pushed(LoadFilter(), t[0], v[0], u[0])
    assert np.isfinite(loads.load().level)
    loads.push(t, v, u)
    load = loads.load()
    assert load.known and float(load.sag(0.5)) == pytest.approx(SAG * 0.5 ** 1.8, rel=0.4)


def test_another_battery_in_flight():
    """A level that jumps is found again, and the sag stays."""
    t, v, u = flown(3, 80.0)
    load = loaded(t, np.where(t > 40.0, v - 1.5, v), u)
    plain = loaded(t, v, u)
    assert plain.level - load.level == pytest.approx(1.5, abs=0.2)
    assert float(load.sag(0.5)) == pytest.approx(float(plain.sag(0.5)), rel=0.2)


def test_nothing_is_known_of_nothing():
    load = LoadFilter().load()
    assert load == SupplyLoad() and load.status is LoadStatus.NO_DATA and not load.known
    assert np.isnan([load.level, load.sag(0.5), load.sag_se(0.5), load.noise(0.5)]).all()
    with pytest.raises(ValueError, match='no voltage'):
        LoadFilter().path(np.arange(3.0), np.zeros(3))


def test_the_recorded_flight():
    """Known after 20 s and from then on; the path of the last 30 s follows from throttle."""
    recording = read_recording(ROOT / 'bags/recorded/gecko.csv')
    t, v, u = recording.t - recording.t[0], recording.voltage, recording.throttle
    loads = LoadFilter()
    known = []
    for second in range(100):
        piece = (t >= second) & (t < second + 1)
        loads.push(t[piece], v[piece], u[piece])
        known.append(loads.load().known)
    assert all(known[20:])
    ahead = (t >= 100.0) & (t < 110.0)
    path = loads.path(t[ahead], np.clip(u[ahead], 0.0, 1.0))
    assert np.sum((v[ahead] - path) ** 2) < 0.25 * np.sum((v[ahead] - v[ahead].mean()) ** 2)


@pytest.mark.parametrize('seed', range(6))
def test_garbage_raises_nothing(seed):
    """Zero, negative and mad voltages, throttles and currents, holes, and clocks that jump."""
    rng = np.random.default_rng(seed)
    loads, line = LoadFilter(), TimeLine()
    t = 0.0
    for _ in range(20):
        n = int(rng.integers(1, 60))
        stamps = t + np.cumsum(rng.choice([1e-4, 1e-3, 0.02, 0.3, 1.0, 70.0]) * rng.random(n))
        t = stamps[-1] - rng.choice([0.0, 0.5, 5.0, -1e9], p=[0.8, 0.1, 0.05, 0.05])
        v = rng.choice([0.0, -5.0, 3.7, 16.0, 1e5, -1e6]) + 0.05 * rng.standard_normal(n)
        v[rng.random(n) < 0.05] = np.nan
        u = rng.choice([np.nan, 0.0, 0.5, -1.0]) + rng.random(n)
        current = rng.choice([np.nan, 0.0, 10.0, -1e9, np.inf]) * rng.random(n)
        for batch in line.take(as_columns(stamps, v, u, current), 60.0):
            if batch.restart:
                loads.new_time_line()
            loads.push(*batch.columns)
        load = loads.load()
        assert load.status in LoadStatus and loads.path(t + np.arange(3.0), np.ones(3)).size == 3
        loads.learned()


def test_the_level_follows_a_pack_that_empties():
    """In the last 5 s of a knee the voltage a second ahead is right within half its noise."""
    errors = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = np.arange(0.0, 80.0, 0.04)
        u = np.clip(0.4 + 0.25 * rng.standard_normal(161), 0.0, 1.0)[(2 * t).astype(int)]
        x = u ** 1.8
        drawn = np.cumsum(x) / x.sum()
        v = (15.2 - 0.4 * drawn - 6.0 * np.maximum(drawn - 0.8, 0.0) - 1.5 * x
             + 0.3 * rng.standard_normal(t.size))
        loads, last = LoadFilter(), int(75.0 / 0.04)
        loads.push(t[:last], v[:last], u[:last])
        for k in range(last, t.size - 25, 10):
            errors.append(loads.path(t[k:k + 25], u[k:k + 25])[-1] - v[k + 24])
            loads.push(t[k:k + 10], v[k:k + 10], u[k:k + 10])
    assert abs(np.mean(errors)) < 0.15


def test_noise_counts_the_changes_of_throttle_as_flown():
    """White noise of 20 mV, and of 200 mV more where throttle has just moved, each 0.2 s."""
    rng = np.random.default_rng(8)
    t = np.arange(0.0, 60.0, 0.02)
    u = np.clip(0.4 + 0.15 * rng.standard_normal(301), 0.0, 1.0)[(5 * t).astype(int)]
    moved = np.diff(u, prepend=u[0]) != 0.0
    noise = np.where(moved, 0.2, 0.02) * rng.standard_normal(t.size)
    load = loaded(t, 16.0 - 1.5 * u ** 1.8 + noise, u)
    for throttle in (0.3, 0.4, 0.5):
        near = np.abs(u - throttle) < 0.05
        measured = float(np.sqrt(np.mean(noise[near] ** 2)))
        assert 1.0 / 1.3 < float(load.noise(throttle)) / measured < 1.3


def test_a_sag_known_only_between_throttles_keeps_its_rise():
    """
    Flown at 45 to 80 %, where it rises by 0.14 V: a sag that rises everywhere rises so there.

    The powers alone are negative below 70 % (as of a Crazyflie at hover).
    """
    t = np.arange(6000) / 100.0
    u = 0.62 + 0.17 * np.sin(0.7 * t) * np.sin(0.05 * t)
    sag = 0.05 + 0.9 * np.maximum(u - 0.45, 0.0)**1.8
    v = 3.9 - sag - 0.001 * t + 0.002 * np.random.default_rng(3).standard_normal(t.size)
    load = loaded(t, v, u)
    rises = np.diff(load.sag(np.linspace(0.0, 1.0, 21)))
    assert load.known and (rises > -1e-9).all()
    low, high = np.interp((0.5, 0.75), u[np.argsort(u)], sag[np.argsort(u)])
    assert float(load.sag(0.75) - load.sag(0.5)) == pytest.approx(high - low, rel=0.2)


def moving_stick(seed, seconds, hold, low, high):
    """Return stamps of 50 Hz, throttle that moves to another value in `hold` s, and normals."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, seconds, 0.02)
    at = np.arange(0.0, seconds + hold, hold)
    return t, np.interp(t, at, rng.uniform(low, high, at.size)), rng.standard_normal(t.size)


@pytest.mark.parametrize('sag', [0.2, 2.0])
def test_motors_that_are_armed_change_the_sag_at_once(sag):
    """The stick moves for 60 s with the motors off: 20 s after arming, the sag is known."""
    for seed in range(2):
        t, u, noise = moving_stick(seed, 80.0, 2.0, 0.1, 0.9)
        load = loaded(t, 16.0 - sag * (t > 60.0) * u ** 1.8 + 0.01 * noise, u)
        assert load.known
        assert abs(float(load.sag(0.8)) - sag * 0.8 ** 1.8) < 3.0 * float(load.sag_se(0.8))
        assert float(load.sag_se(0.8)) < 0.3 * sag


def test_a_small_sag_of_a_rail_is_known():
    """50 mV in noise of 3 mV: a drift of 2 % of a pack's usual sag would hide it."""
    for seed in range(2):
        t, u, noise = moving_stick(seed, 120.0, 3.0, 0.0, 1.0)
        load = loaded(t, 12.0 - 0.05 * u + 0.003 * noise, u)
        assert load.known
        assert abs(float(load.sag(0.8)) - 0.04) < 3.0 * float(load.sag_se(0.8))
        assert float(load.sag_se(0.8)) < 0.2 * 0.04


def test_a_short_climb_keeps_the_sag_known():
    """A plane at constant throttle: its sag was unknown again, "throttle has not moved"."""
    rng = np.random.default_rng(3)
    t = np.arange(0.0, 240.0, 0.1)
    u = np.where(t < 4.0, 0.0, np.where((t > 100.0) & (t < 115.0), 0.9, 0.55))
    load = loaded(t, 8.2 - 0.8 * u ** 1.5 + 0.01 * rng.standard_normal(t.size), u)
    assert load.known
    assert abs(float(load.sag(0.9)) - 0.8 * 0.9 ** 1.5) < 2.0 * float(load.sag_se(0.9))


def test_the_fall_of_an_emptying_pack_is_no_sag():
    """Packs that lose 0.2 to 0.7 V a cell at their end: half of the sags were off by half."""
    errors = []
    for seed in range(7):
        rng = np.random.default_rng(seed)
        cells, t = int(rng.choice([1, 3, 4, 6])), np.arange(0.0, 100.0, 0.02)
        u = np.repeat(rng.uniform(0.05, 0.85, 300), rng.integers(20, 150, 300))[:t.size]
        full, lasts = cells * rng.uniform(0.2, 0.45), rng.uniform(8.0, 30.0)
        gone = np.clip((t - (t[-1] - lasts)) / lasts, 0.0, 1.0) ** 1.5
        level = cells * (4.0 - 0.001 * t - rng.uniform(0.2, 0.7) * gone)
        v = level - full * lowpass(u, t, 0.06) ** 1.4 + 0.007 * cells * rng.standard_normal(t.size)
        errors.append(float(loaded(t, v, u).sag(0.7)) / (full * 0.7 ** 1.4) - 1.0)
    assert np.median(np.abs(errors)) < 0.3


def test_the_fit_of_recordings_has_the_regressors_of_the_filter():
    """One load model, computed sample by sample and for a whole recording."""
    rng, t = np.random.default_rng(4), np.arange(0.0, 110.0, 0.02)
    u = np.where(t < 30.0, np.repeat(rng.uniform(0.1, 0.9, t.size // 25), 25), 0.3)
    loads = pushed(LoadFilter(), t, QUAD.path(t, u) + 0.02 * rng.standard_normal(t.size), u)
    state = loads.state()
    # The last 80 s were at 0.3, so that all lags are settled; then steps of throttle.
    ahead = t[-1] + np.arange(0.02, 1.5, 0.02)
    stick = np.where(np.sin(20.0 * ahead) > 0.0, 0.8, 0.3)
    fit = LoadFit(LoadInput.THROTTLE, False, 4, 1.0, 0.3 ** 1.8 / BEFORE, np.append(
        state.mean[0], state.size * state.mean[2:]), np.empty((0, 0)))
    rows = fit.regressors(np.append(t[-1], ahead), np.append(0.3, stick))[:, 1:]
    path = fit.voltage(fit.values, rows)
    assert np.ptp(path) > 1.0
    # The filter's level falls with the charge drawn.
    fall = path - loads.path(ahead, stick)
    np.testing.assert_allclose(fall, fall[-1] / rows[0, -1] * rows[0], atol=1e-3)
    assert 0.0 < fall[-1] < 0.05
