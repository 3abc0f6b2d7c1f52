"""False alarms of `coupling` on recorded gyros and on spectra that change their shape."""

import math
from pathlib import Path

import numpy as np
from ou_monitor.analysis import coupling as engine
from ou_monitor.analysis.coupling import estimate_coupling
import pytest
from scipy import stats
from scipy.signal import lfilter

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
def test_a_spectrum_that_changes_its_shape_makes_no_coupling(signal, monkeypatch):
    t = np.arange(15_000) / 500.0
    alarms = dict.fromkeys(('test', 'one weight'), 0)
    rng, draws = np.random.default_rng(3), 24
    for _ in range(draws):
        given = t, supply(rng, t, np.full(t.size, 0.05)), t, signal(rng, t)
        alarms['test'] += estimate_coupling(*given).seen
        with monkeypatch.context() as patch:
            patch.setattr(engine, 'local_size', lambda part: np.sqrt(
                np.mean(np.abs(part)**2, axis=1, keepdims=True)))
            patch.setattr(engine, '_sign_test', lambda *_: (0.0, 0.0))
            alarms['one weight'] += estimate_coupling(*given).seen
    assert alarms['test'] <= most(draws)
    assert signal is not bursts or alarms['one weight'] > most(draws)


def segments(rng, count, bins):
    """Return coefficients of half-overlapping Hann segments of white noise, every second bin."""
    length = 4 * bins + 8
    series = rng.standard_normal(length * (count + 1) // 2)
    window = np.hanning(length + 1)[:-1]
    parts = [np.fft.rfft(window * series[k:k + length])[3:3 + 2 * bins:2]
             for k in range(0, series.size - length + 1, length // 2)]
    return np.array(parts)


@pytest.mark.parametrize('count, bins', [(16, 4), (60, 20), (200, 8)])
def test_drawn_signs_alone_keep_their_level(count, bins):
    """Of overlapping segments, few or many, and whatever the sizes of the signal's."""
    rng, draws, p = np.random.default_rng(4), 200, []
    for _ in range(draws):
        v, x = segments(rng, count, bins), segments(rng, count, bins)
        assert x.shape == (count, bins)
        p.append(engine._sign_test(v, x * np.exp(rng.standard_normal((count, 1))), [], rng))
    for values in np.transpose(p):
        # The p-value is uniform: its share below each level, to four deviations.
        for level in (0.05, 0.25, 0.5):
            spread = 4.0 * math.sqrt(level * (1.0 - level) / draws)
            assert abs((values <= level).mean() - level) < spread + 1.0 / 256.0


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
