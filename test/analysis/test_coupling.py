"""Coupling of supply noise into a signal: gain, false alarms, common causes, resampling."""

import math
from pathlib import Path

import numpy as np
from ou_monitor.analysis import coupling as engine
from ou_monitor.analysis.coupling import estimate_coupling, on_grid, POWER
from ou_monitor.errors import InputError
from ou_monitor.report.coupling_document import _answer, _facts
import pytest
from scipy import stats
from scipy.signal import lfilter

RATE, SECONDS, ALPHA = 500.0, 20.0, 63.0
DRAWS = 80


def noise(rng, n, alpha, deviation):
    """Return an OU of unit deviation times `deviation`, at RATE."""
    phi = np.exp(-alpha / RATE)
    return deviation * lfilter([np.sqrt(1.0 - phi**2)], [1.0, -phi], rng.standard_normal(n))


def flight(rng, gain=0.0, lag=0, common=0.0, square=0.0, seconds=SECONDS):
    """Return stamps, voltage, signal, throttle."""
    # The intensity of both noises grows with throttle, as on a vehicle: that is no coupling.
    # `common` and `square` let throttle move both, each through a lag of its own.
    n = int(seconds * RATE)
    t = np.arange(n) / RATE
    throttle = np.repeat(rng.uniform(0.1, 0.9, round(2 * seconds)), int(RATE / 2))
    rise = 0.3 + 3.0 * throttle
    supply = noise(rng, n, ALPHA, 0.03 * rise)
    signal = noise(rng, n, 30.0, 1.0) + 2.0 * rise * rng.standard_normal(n)
    load = common * throttle + square * throttle**2
    pole = 1.0 - np.exp(-30.0 / RATE)
    slow = lfilter([pole], [1.0, pole - 1.0], load)
    return (t, 5.0 + supply - 0.1 * slow, signal + gain * np.roll(supply, lag) + load - slow,
            throttle)


def binomial(share, draws):
    """Return four standard deviations of a share: 1 in 16000 by chance."""
    return 4.0 * np.sqrt(share * (1.0 - share) / draws)


def test_gain_is_within_its_interval_as_often_as_stated():
    """95 % intervals hold the gain; the lag is right to a tenth of a sample."""
    rng, gain, inside, lags, gains = np.random.default_rng(1), -40.0, 0, [], []
    for _ in range(DRAWS):
        t, voltage, signal, throttle = flight(rng, gain, lag=2)
        found = estimate_coupling(t, voltage, t, signal, throttle=throttle)
        assert found.seen and found.partial and not found.narrow and not found.signal_leads
        inside += found.gain_ci95[0] <= gain <= found.gain_ci95[1]
        lags.append(found.lag)
        gains.append(found.gain)
    assert abs(inside / DRAWS - 0.95) < binomial(0.95, DRAWS)
    assert np.mean(gains) == pytest.approx(gain, abs=4.0 * np.std(gains) / np.sqrt(DRAWS))
    assert np.mean(lags) == pytest.approx(2.0 / RATE, abs=0.1 / RATE)


@pytest.mark.parametrize('cause', [{}, {'common': 20.0}, {'square': 20.0}])
def test_no_coupling_is_detected_where_there_is_none(cause):
    """At most the stated 5 % of false alarms, throttle moving both or not."""
    rng, alarms = np.random.default_rng(2), 0
    for _ in range(DRAWS):
        t, voltage, signal, throttle = flight(rng, **cause)
        found = estimate_coupling(t, voltage, t, signal, throttle=throttle)
        alarms += found.seen
        assert found.seen == np.isfinite(found.gain)
    assert alarms / DRAWS < 0.05 + binomial(0.05, DRAWS)


def test_a_common_cause_is_taken_for_coupling_where_throttle_is_not_known():
    """So the test above has something to find; and the note says that it is missing."""
    t, voltage, signal, throttle = flight(np.random.default_rng(3), common=40.0)
    found = estimate_coupling(t, voltage, t, signal)
    assert found.seen and not found.partial
    assert any('Throttle is unknown' in note for note in found.notes)
    assert not estimate_coupling(t, voltage, t, signal, throttle=throttle).seen


def test_limit_is_the_gain_detected_with_the_stated_power():
    rng = np.random.default_rng(4)
    t, voltage, signal, throttle = flight(rng)
    limit = np.mean([estimate_coupling(*s[:2], s[0], s[2], throttle=s[3]).limit
                     for s in (flight(rng) for _ in range(20))])
    seen = {1.0: 0, 0.25: 0}
    for share in seen:
        for _ in range(DRAWS):
            t, voltage, signal, throttle = flight(rng, share * limit)
            seen[share] += estimate_coupling(t, voltage, t, signal, throttle=throttle).seen
    # The limit is that of the sum alone; the largest bin may only add to it.
    assert seen[1.0] / DRAWS > POWER - binomial(POWER, DRAWS)
    assert seen[0.25] / DRAWS < 0.5


def test_the_gain_survives_jitter_gaps_and_nan():
    """A gyro at 400 Hz with jitter, gaps and NaN against a rail at 1 kHz: the same gain."""
    rng = np.random.default_rng(5)
    fine = 2000.0
    n = int(40.0 * fine)
    t = np.arange(n) / fine
    phi = np.exp(-ALPHA / fine)
    supply = 0.05 * lfilter([np.sqrt(1.0 - phi**2)], [1.0, -phi], rng.standard_normal(n))
    at = np.flatnonzero(np.diff(np.floor(t * 400.0 + 0.3)) > 0) + rng.integers(0, 2)
    keep = at[(t[at] < 11.0) | (t[at] > 13.5)]
    signal = 30.0 * supply[keep] + 0.3 * rng.standard_normal(keep.size)
    signal[rng.integers(0, keep.size, 5)] = np.nan
    order = rng.permutation(keep.size)
    voltage = 5.0 + supply[::2]
    found = estimate_coupling(t[::2], voltage, t[keep][order], signal[order])
    assert found.seen and found.gain_ci95[0] <= 30.0 <= found.gain_ci95[1]
    assert found.gain == pytest.approx(30.0, rel=0.03)
    assert abs(found.lag) < 0.25e-3
    assert found.grid.gaps >= 1 and found.grid.duration < 37.6
    assert found.frequency[-1] <= 101.0
    assert found.grid.lost[1] >= 3 and found.grid.lost[0] == 0


def test_jump_of_the_rate_is_noted():
    """From 500 Hz to 50 Hz: what is used is said, with the remedy; the gain holds."""
    rng = np.random.default_rng(15)
    t, voltage, signal, throttle = flight(rng, 60.0, seconds=40.0)
    keep = (t < 24.0) | (np.arange(t.size) % 10 == 0)
    found = estimate_coupling(t, voltage, t[keep], signal[keep], throttle=throttle)
    assert found.seen and found.gain_ci95[0] <= 60.0 <= found.gain_ci95[1]
    assert found.grid.duration == pytest.approx(24.0, abs=0.1)
    assert any(note.startswith('Only 24 s of the 40 s') for note in found.notes)
    whole = estimate_coupling(t, voltage, t, signal, throttle=throttle)
    assert not any(note.startswith('Only') for note in whole.notes)


def test_a_much_faster_voltage_is_averaged_not_thinned():
    """What the rail does above the signal's rate does not fold into the band."""
    t = np.arange(400_000) / 20_000.0
    tone = np.sin(2.0 * np.pi * 997.0 * t)
    slow = np.sin(2.0 * np.pi * 11.0 * t)
    at = np.arange(0.0, 20.0, 0.01)
    grid = on_grid({'v': (t, slow + tone), 'x': (at, np.interp(at, t, slow))})
    assert grid.rate == pytest.approx(400.0) and grid.usable == pytest.approx(25.0)
    fast, held = grid.runs[0]
    expected = np.sin(2.0 * np.pi * 11.0 * np.arange(fast.size) / grid.rate)
    inner = slice(20, -20)
    # A box of 2.5 ms leaves sinc(997/400) = 12 % of the tone, and 0.1 % less of the rest.
    assert np.abs(fast[inner] - expected[inner]).max() < 0.15
    assert np.abs(held[inner] - expected[inner]).max() < 0.01


def is_no_coupling(found):
    """Return whether neither the headline nor the advice takes it for coupling."""
    return 'not supply noise' in _answer(found, 'gyro', 'per V') and (
        'coupling' not in dict(_facts(found, 'per V'))['For the filter'])


def test_a_line_that_both_share_is_called_narrow():
    """A motor that shakes the gyro and ripples the rail at one frequency."""
    rng = np.random.default_rng(7)
    t, voltage, signal, throttle = flight(rng)
    line = np.sin(2.0 * np.pi * 81.0 * t)
    found = estimate_coupling(t, voltage + 0.03 * line, t, signal + 3.0 * line, throttle=throttle)
    assert found.seen and found.narrow and is_no_coupling(found)
    assert found.frequency[found.coherence.argmax()] == pytest.approx(81.0, abs=2.0)


def test_leading_signal_is_noted():
    rng = np.random.default_rng(8)
    t, voltage, signal, throttle = flight(rng)
    found = estimate_coupling(t, voltage + 0.05 * np.roll(signal, 5), t, signal,
                              throttle=throttle)
    assert found.seen and found.signal_leads and found.lag < -0.005 and is_no_coupling(found)


T = np.arange(5000) / RATE


@pytest.mark.parametrize('signal_t, signal, options, words', [
    (T + 100.0, T, {}, 'no time in common'),
    (T, np.full(T.size, np.nan), {}, 'finite samples'),
    (T, np.ones(T.size), {}, 'does not change'),
    (T[:600], np.sin(99 * T[:600]), {}, 'at least 16 segments'),
    (T[::50], np.sin(9 * T[::50]), {}, 'the slower series has 10 Hz'),
    (T, np.sin(99 * T), {'band': (20.0, 200.0)}, 'usable up to 125 Hz'),
    (T, np.sin(99 * T), {'band': (20.0, 20.1)}, 'widen it'),
    (T, np.sin(99 * T), {'level': 0.0}, 'between 0 and 1'),
])
def test_undecidable_input_is_refused(signal_t, signal, options, words):
    voltage = 5.0 + np.random.default_rng(9).standard_normal(T.size)
    with pytest.raises(InputError, match=words):
        estimate_coupling(T, voltage, signal_t, signal, **options)


@pytest.mark.parametrize('tail', [0.0, 1e-160])
def test_a_signal_that_is_mostly_constant_is_not_coupled(tail):
    """A flag of 0 and 1: what is left of it elsewhere by rounding does not decide."""
    rng = np.random.default_rng(1)
    t = np.arange(12_000) / 50.0
    signal = np.zeros(t.size)
    signal[2000:6000] = 1.0
    signal[7000:] = tail * rng.standard_normal(5000)
    found = estimate_coupling(t, 12.0 + rng.normal(0.0, 0.1, t.size), t, signal)
    assert not found.seen and np.isfinite(found.limit)


def test_the_voltage_is_no_signal():
    t, voltage, _, throttle = flight(np.random.default_rng(5))
    with pytest.raises(InputError, match='the signal is the voltage itself'):
        estimate_coupling(t, voltage, t, voltage, throttle=throttle)


GYRO = Path(__file__).resolve().parents[2] / 'bags/recorded/gecko_gyro.csv'
LEVEL = 0.05


def most(trials):
    """Return false alarms that a test of 5 % exceeds once in 10^4."""
    return stats.binom.isf(1e-4, trials, LEVEL)


def supply(rng, t, deviation):
    """Return an OU of 63 /s whose driving noise may change with time, V."""
    phi = math.exp(-63.0 * float(np.median(np.diff(t))))
    drive = math.sqrt(1.0 - phi**2) * deviation * rng.standard_normal(t.size)
    return 15.0 + lfilter([1.0], [1.0, -phi], drive)


@pytest.fixture(scope='module')
def gyro():
    """Return the columns of a recorded flight: gyro as logged, deg/s."""
    table = np.loadtxt(GYRO, delimiter=',', skiprows=1)
    return table[:, 0], table[:, 1], table[:, 2], table[:, 3:].T


def elsewhere(rng, values):
    """Return a series turned round by at least a tenth of its length."""
    return np.roll(values, rng.integers(values.size // 10, values.size - values.size // 10))


@pytest.mark.parametrize('kind', ['constant sigma', 'sigma of another throttle', 'shifted'])
def test_a_recorded_gyro_is_not_coupled_to_a_foreign_supply(gyro, kind):
    """Simulated supplies, and the flight's own shifted in time with the gyro left."""
    t, logged, throttle, axes = gyro
    rng, alarms, draws = np.random.default_rng(1), 0, 8
    for axis in axes:
        for _ in range(draws):
            if kind == 'shifted':
                found = estimate_coupling(t, logged, t, elsewhere(rng, axis), throttle=throttle)
                # As logged every reading is there two or three times.
                assert found.grid.rates[0] == pytest.approx(200.0, rel=0.2)
            else:
                other = elsewhere(rng, throttle[::-1])
                rise = 0.3 + 3.0 * other if kind != 'constant sigma' else np.ones(t.size)
                found = estimate_coupling(t, supply(rng, t, 0.05 * rise), t, axis,
                                          throttle=throttle)
            alarms += found.seen
    assert alarms <= most(3 * draws)


def test_a_gain_of_five_is_seen_on_a_recorded_gyro(gyro):
    t, _, throttle, axes = gyro
    rng, inside = np.random.default_rng(2), 0
    for axis in [*axes, *axes]:
        voltage = supply(rng, t, np.full(t.size, 0.05))
        found = estimate_coupling(t, voltage, t, axis + 5.0 * voltage, throttle=throttle)
        assert found.seen and not found.signal_leads and found.limit < 5.0
        inside += found.gain_ci95[0] <= 5.0 <= found.gain_ci95[1]
    # Two of six outside 95 % intervals: once in 30.
    assert inside >= 4


def bursts(rng, t):
    """Return a signal whose resonance comes and goes beside a steady part."""
    rate = 1.0 / (t[1] - t[0])
    second = np.repeat(np.exp(1.5 * rng.standard_normal(math.ceil(t.size / rate))), int(rate))
    ring = lfilter([1.0], [1.0, -1.98 * math.cos(2.0 * math.pi * 30.0 / rate), 0.98],
                   rng.standard_normal(t.size))
    slow = math.exp(-30.0 / rate)
    steady = lfilter([math.sqrt(1.0 - slow**2)], [1.0, -slow], rng.standard_normal(t.size))
    return steady + 0.2 * second[:t.size] * ring + 0.3 * rng.standard_normal(t.size)


def moving_line(rng, t):
    """Return a signal with a strong line that follows a throttle, as of a motor."""
    slow = lfilter([0.01], [1.0, -0.99], np.repeat(rng.uniform(0.1, 0.9, t.size // 250), 250))
    rate = 1.0 / (t[1] - t[0])
    phase = 2.0 * math.pi * np.cumsum(40.0 + 60.0 * np.sqrt(slow)) / rate
    return rng.standard_normal(t.size) + 10.0 * np.sin(phase)


@pytest.mark.parametrize('signal', [bursts, moving_line])
def test_a_spectrum_that_changes_its_shape_makes_no_coupling(signal):
    t = np.arange(15_000) / 500.0
    rng, draws, alarms = np.random.default_rng(3), 40, 0
    for _ in range(draws):
        alarms += estimate_coupling(
            t, supply(rng, t, np.full(t.size, 0.05)), t, signal(rng, t)).seen
    assert alarms <= most(draws)


def test_a_line_in_a_band_of_few_bins_is_narrow():
    """At the rate of most blackbox logs, the band holds eight bins."""
    rng, t = np.random.default_rng(10), np.arange(6000) / 50.0
    line = 0.3 * np.sin(2.0 * np.pi * 4.5 * t)
    found = estimate_coupling(t, 5.0 + line + rng.standard_normal(t.size), t,
                              line + rng.standard_normal(t.size))
    assert found.frequency.size == 8 and found.seen and found.narrow


def test_small_chances_are_extrapolated():
    """Beyond the draws: a strong coupling has a p-value far below one over their number."""
    rng = np.random.default_rng(5)
    v, noise = (rng.standard_normal((2, 120, 30)) + 1j * rng.standard_normal((2, 120, 30)))
    p_sum, p_max = engine._sign_test(v, v + noise, [], rng)
    assert p_sum < 1e-4 and p_max < 1e-3


def test_repeats_of_a_logger_are_not_a_signal(gyro):
    t, logged, throttle, axes = gyro
    found = estimate_coupling(t, logged, t, axes[0], throttle=throttle)
    assert any('repeats were left out' in note for note in found.notes)
    rng = np.random.default_rng(6)
    true = supply(rng, t, np.full(t.size, 0.2))
    held = np.repeat(true[::5], 5)[:t.size]
    signal = 8.0 * true + rng.standard_normal(t.size)
    found = estimate_coupling(t, held, t, signal)
    assert found.seen and found.gain == pytest.approx(8.0, rel=0.15)
    # The steps of a held voltage lie half a refresh, 4 ms, behind its readings.
    assert abs(found.lag) < 1.5e-3
    assert found.grid.rates[0] == pytest.approx(100.0, rel=0.01)
