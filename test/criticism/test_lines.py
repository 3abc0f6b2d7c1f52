"""Spectral lines: false alarms and power as stated, correct amplitudes."""

import math

import numpy as np
from ou_monitor.analysis.level_result import fit_all
from ou_monitor.analysis.levels import find_levels
from ou_monitor.analysis.noise import remainder
from ou_monitor.model.ou import simulate
from ou_monitor.model.sinusoid import fit_sinusoid, tones
from ou_monitor.model.spectral_lines import (
    find_lines, fundamental_of, on_grid, tail, without_lines)
from ou_monitor.records import Recording
import pytest
from scipy import signal
from scipy.signal import lfilter
from simulated_recordings import ALPHA, as_one_level


RATE = 1000.0
MEMORY = math.exp(-ALPHA / RATE)


def noise(seed, n=3000):
    """Return 10 mV of white noise."""
    return np.random.default_rng(seed).normal(0.0, 0.01, n)


def tone(frequency, rms, n=3000, phase=0.3):
    return rms * math.sqrt(2.0) * np.sin(2.0 * math.pi * frequency * np.arange(n) / RATE + phase)


@pytest.mark.parametrize('pieces, neighbours', [(1, 64), (5, 16)])
def test_the_tail_is_that_of_simulated_ratios(pieces, neighbours):
    """Share of ratios beyond where the tail says 5 % and 0.5 %."""
    # 40000 draws: standard errors 0.11 % and 0.035 %; 4 of them.
    rng = np.random.default_rng(1)
    others = np.sort(rng.gamma(pieces, size=(40000, neighbours)), axis=1)
    p = tail(rng.gamma(pieces, size=40000) / others[:, neighbours // 2], pieces, neighbours)
    for level in (0.05, 0.005):
        assert (p < level).mean() == pytest.approx(
            level, abs=4.0 * math.sqrt(level * (1.0 - level) / 40000))


@pytest.mark.parametrize('cut', [1, 3])
def test_false_alarms_are_as_stated(cut):
    """OU in white noise, whole or in three segments, at a stated rate of 20 %."""
    # 200 recordings: 40 +- 5.7 at most; 57 is 3 standard deviations up, and 17 as far down as 4,
    # for the union bound takes some.
    alarms = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        v = simulate(np.arange(2000) / RATE, ALPHA, 0.3, rng) + rng.normal(0.0, 0.01, 2000)
        parts = np.array_split(v, cut)
        alarms += bool(find_lines(parts, RATE, false_alarm=0.2, white=[
            lfilter([1.0, -MEMORY], [1.0], part - part.mean()) for part in parts]).lines)
    assert 17 <= alarms <= 57


@pytest.mark.parametrize('corner', [0.7, 1.3, 3.0])
def test_slow_noise_behind_a_filter_has_no_lines(corner):
    """An ESC's filter of second order: power falls by 16 in each octave above a corner, Hz."""
    # 15 s at 100 Hz, as on a thrust stand: the corner lies 10 to 45 bins up. Neighbours alone
    # show a line in all 40; a few bins of the slope remain, with a share of hardly anything.
    b, a = signal.butter(2, corner, fs=100.0)
    alarms = 0
    for seed in range(40):
        v = lfilter(b, a, np.random.default_rng(seed).standard_normal(3000))[1500:]
        lines = find_lines([v], 100.0).lines
        alarms += bool(lines)
        assert sum(line.share for line in lines) < 0.05
    assert alarms <= 10


def test_a_line_of_the_stated_size_is_found_nine_times_in_ten():
    """At any frequency and phase; the size is for the worst place between two bins."""
    # 80 trials at 90 %: fewer than 63 has probability 1e-3. Half that size is found in less than
    # half of them.
    found = {1.0: 0, 0.5: 0}
    rng = np.random.default_rng(2)
    for seed in range(80):
        v = noise(seed)
        least = find_lines([v], RATE).detectable
        for factor in found:
            f = rng.uniform(20.0, 480.0)
            lines = find_lines([v + tone(f, factor * least, phase=rng.uniform(0, 6))], RATE).lines
            found[factor] += any(abs(line.frequency - f) < 2.0 * line.resolution
                                 for line in lines)
    assert found[1.0] >= 63 and found[0.5] < 40


def test_intervals_of_the_amplitude_hold():
    """60 tones, five times what can be seen: at least 50 intervals hold the truth."""
    # A binomial of 60 and 0.95 falls below 50 with probability 1e-4. The frequency is right to a
    # tenth of a bin, the share is that of the variance.
    inside = 0
    rng = np.random.default_rng(3)
    for seed in range(60):
        f, rms = rng.uniform(20.0, 480.0), 0.006
        v = noise(seed) + tone(f, rms, phase=rng.uniform(0, 6))
        line = find_lines([v], RATE).lines[0]
        inside += line.rms_low < rms < line.rms_high
        assert line.frequency == pytest.approx(f, abs=0.1 * line.resolution)
        assert line.share == pytest.approx(line.rms ** 2 / v.var(), rel=0.01)
    assert inside >= 50


def test_amplitude_agrees_with_a_periodogram_of_scipy():
    """The power within five bins of a spectrum of the same window."""
    v = noise(4) + tone(123.0, 0.008)
    line = find_lines([v], RATE).lines[0]
    f, power = signal.periodogram(v, RATE, window='hann', detrend='linear')
    near = np.abs(f - 123.0) < 2.5 * line.resolution
    assert line.rms == pytest.approx(math.sqrt(power[near].sum() * line.resolution), rel=0.02)


def test_a_strong_line_neither_hides_a_weak_one_nor_makes_others():
    """1 V beside 3 mV, 15 Hz apart: exactly the two."""
    v = noise(5) + tone(200.0, 1.0) + tone(215.0, 0.003)
    lines = find_lines([v], RATE).lines
    assert [round(line.frequency) for line in lines] == [200, 215]


def test_a_line_in_pieces_of_a_level_is_found_though_few_show_it():
    """Ten segments of 0.3 s: what all but two or so hide stands out of all of them."""
    rms = 0.0016
    parts = [noise(100 + k, 300) + tone(150.0, rms, 300, phase=k) for k in range(10)]
    assert sum(bool(find_lines([part], RATE).lines) for part in parts) <= 2
    (line,) = find_lines(parts, RATE).lines
    assert line.rms_low < rms < line.rms_high


@pytest.mark.parametrize('parts', [[], [np.zeros(0)], [np.zeros(127)], [np.ones(60)] * 9])
def test_short_levels_are_not_searched(parts):
    found = find_lines(parts, RATE)
    assert found.why_not and not found.lines and math.isnan(found.detectable)


def test_a_constant_has_no_lines():
    assert not find_lines([np.full(500, 5.0)], RATE).lines


def test_a_line_is_at_most_all_of_the_noise():
    """A slow line of one long segment among short quiet ones: nearly all of that segment."""
    rng, k = np.random.default_rng(1), np.arange(4096)
    parts = [np.sin(0.0175 * k) + 0.1 * rng.standard_normal(k.size),
             *0.1 * rng.standard_normal((40, 300))]
    (line,) = find_lines(parts, 100.0).lines
    assert 0.9 < line.share <= 1.0


def test_samples_between_those_of_the_clock_do_not_move_a_line():
    """Thinned recordings keep samples around sudden changes: half steps, two for each."""
    t = np.arange(20_000) / 1000.0
    t = np.sort(np.append(t, t[500:19_000:370] + 0.0005))
    grid = on_grid(t, np.sin(2.0 * np.pi * 120.0 * t))
    assert grid.rate == pytest.approx(1000.0, rel=1e-4) and grid.values.size == 20_000
    wave = fit_sinusoid(grid.values, grid.rate, 120.0, 0.5)
    # A tenth of the resolution; counted as whole steps they would move it by 0.15 Hz.
    assert abs(wave.frequency - 120.0) < 0.005
    assert wave.amplitude == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize('seed', range(3))
def test_tones_are_summed_and_noise_is_left_alone(seed):
    """Two tones, one of them for half of the time, within 10 % of their rms; none in noise."""
    v = noise(seed, 8000)
    assert not tones(v, v, RATE).any()
    added = tone(57.3, 0.01, 8000) + tone(211.7, 0.02, 8000) * (np.arange(8000) >= 4000)
    error = tones(v + added, v + added, RATE) - added
    assert np.sqrt(np.mean(error ** 2)) < 0.1 * np.sqrt(np.mean(added ** 2))


@pytest.mark.parametrize('count', (5, 8, 16))
def test_harmonics_have_their_fundamental_and_unrelated_lines_none(count):
    """Harmonics with errors of 0.01 %; of 1000 sets of unrelated lines, p < .001 allows 5."""
    rng = np.random.default_rng(count)
    orders = np.arange(1, count + 1)
    found = fundamental_of([*(106.5 * orders * rng.normal(1.0, 1e-4, count)), 78.1])
    assert found == pytest.approx(106.5, rel=1e-3)
    false = sum(fundamental_of(rng.uniform(5.0, 500.0, count)) > 0.0 for _ in range(1000))
    assert false <= 5


def test_more_lines_than_a_binomial_coefficient_can_count():
    """Of 1200 lines it exceeds the largest float."""
    assert fundamental_of(0.4 * np.arange(1.0, 1201.0)) == pytest.approx(0.4)


SIGMA = 0.3


def simulated(tone, seed, seconds=20.0, frequency=120.3):
    """Return 20 s of an OU of 27 mV, 3 mV of white noise and a tone of that rms, V."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    phi = np.exp(-ALPHA / RATE)
    spread = SIGMA / np.sqrt(2.0 * ALPHA)
    steps = spread * np.sqrt(1.0 - phi ** 2) * rng.standard_normal(n)
    steps[0] /= np.sqrt(1.0 - phi ** 2)
    t = np.arange(n) / RATE
    voltage = (5.0 + lfilter([1.0], [1.0, -phi], steps) + rng.normal(0.0, 0.003, n)
               + np.sqrt(2.0) * tone * np.sin(2.0 * np.pi * frequency * t + rng.uniform(0.0, 6.0)))
    return Recording(t, voltage, np.full(n, np.nan), 'made')


def test_a_steady_tone_goes_and_the_rest_stays():
    """Of 20 mV rms less than 0.7 mV is left: the noise in the bins of the line."""
    # The noise has 3.3e-7 V^2/Hz at 120 Hz; the largest of three bins of 0.25 Hz has some 1.8
    # times the mean: 0.39 mV, in each of five pieces with an error of a third.
    noisy, clean = simulated(0.02, 1), simulated(0.0, 1)
    search = find_lines([noisy.voltage], RATE, white=[
        lfilter([1.0, -np.exp(-ALPHA / RATE)], [1.0], noisy.voltage - noisy.voltage.mean())])
    assert [round(line.frequency) for line in search.lines] == [120]
    left = without_lines(noisy.voltage, RATE, search.lines) - clean.voltage
    assert np.sqrt(np.mean(left ** 2)) < 7e-4
    assert np.array_equal(without_lines(clean.voltage, RATE, ()), clean.voltage)


def test_a_faint_tone_does_not_bias_alpha_and_sigma():
    """4 mV beside 27 mV: 20 recordings, each interval holds the truth as often as it says."""
    # Of 20 at 95 % fewer than 16 have a probability of 0.003.
    holds = {'alpha': 0, 'sigma': 0}
    for seed in range(20):
        noisy = simulated(0.004, seed)
        level = as_one_level(noisy)
        assert level.lines.lines
        plain = fit_all(noisy, remainder(noisy), find_levels(noisy.t, noisy.throttle))
        assert plain.sigma > level.estimate.sigma
        for name, truth in (('alpha', ALPHA), ('sigma', SIGMA)):
            low, high = level.estimate.interval(name)
            holds[name] += low <= truth <= high
    assert min(holds.values()) >= 16
