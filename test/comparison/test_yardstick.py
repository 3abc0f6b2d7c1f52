"""Measures of a voltage, against closed forms; and the choice of the largest difference."""

import numpy as np
from ou_monitor.analysis.supply import supply_facts
from ou_monitor.comparison.compare import (
    band, between_codes, Difference, differences, judge, Likeness, Yardstick)
from ou_monitor.comparison.flight_model import Readings
from ou_monitor.records import Recording
import pytest
from scipy.stats import norm

RATE, N = 100.0, 20_000


def white(seed: int) -> Readings:
    """Return white noise of 0.1 V about 5 V."""
    t = np.arange(N) / RATE
    return Readings(t, 5.0 + 0.1 * np.random.default_rng(seed).standard_normal(N), None)


def test_falls_of_white_noise_are_counted_as_theory_says():
    """Of independent samples p below and q above by the noise: p q / (p + q) falls a sample."""
    noise = white(1)
    found = Yardstick(noise, 0.0).measure(noise.voltage)
    for share, dips in zip((0.01, 0.05), found.dips):
        above = norm.sf(norm.ppf(share) + 1.0)
        expected = share * above / (share + above) * RATE * 60.0
        # The count is nearly Poisson; the level is the sample's own quantile, which helps.
        assert dips == pytest.approx(expected, abs=4.0 * np.sqrt(expected * 60.0 * RATE / N))


def test_the_level_is_off_by_the_bias_of_the_path():
    """Not by the median of few simulations, which the page would show as a second number."""
    noise = white(3)
    yardstick = Yardstick(noise, 0.0)
    own, other = (yardstick.measure(noise.voltage + x) for x in (0.0, 0.03))
    level = differences(yardstick, own, [other] * 20, 1.0, [-0.019] * 3)[1]
    assert level.kind == 'level' and ' 19 mV too low' in level.words(level.band)


def test_a_fall_is_a_dip_of_the_facts():
    """Both count the same runs: of noise about the level a crossing is none."""
    samples = white(4).part(slice(0, 4000))
    u = (samples.t % 4.0 > 2.0).astype(float)
    v = samples.voltage - 0.3 * u
    own = Recording(samples.t, v, u)
    levels = (4.75, 5.0)
    yardstick = Yardstick(Readings(own.t, v, u), 0.0, levels)
    counts = yardstick.measure(v).dips[:2] * yardstick.minutes
    assert counts.tolist() == pytest.approx([supply_facts(own, x).dips.count for x in levels])
    crossings = [np.count_nonzero((v[:-1] >= x) & (v[1:] < x)) for x in levels]
    assert np.all(counts < 0.8 * np.array(crossings)) and np.all(counts > 0)


def test_white_noise_has_equal_power_in_equal_bands():
    """A flat spectrum: each band has its share of the variance."""
    noise = white(2)
    yardstick = Yardstick(noise, 0.0)
    power = yardstick.measure(noise.voltage).power
    widths = np.diff(yardstick.bands)
    assert power[2:] == pytest.approx(0.01 * widths[2:] / (0.5 * RATE), rel=0.15)


def test_levels_lie_between_codes():
    assert between_codes(14.15, 0.01) == pytest.approx(14.155)
    assert between_codes(14.153, 0.0) == 14.153
    assert between_codes(14.154, 0.01, 14.004) == pytest.approx(14.159)
    coarse = white(3)
    coarse = Readings(coarse.t, 0.1 * np.rint(coarse.voltage / 0.1), None)
    levels = Yardstick(coarse, 0.1).levels
    assert np.allclose(np.mod(np.array(levels) / 0.1, 1.0), 0.5)


def test_the_mean_response_to_rises_is_measured():
    """A step response of -1 V for each unit of throttle, which decays to half of it."""
    t = np.arange(6000) / RATE
    u = np.where((t % 4.0) < 2.0, 0.2, 0.6)
    since = np.where(u > 0.4, t % 4.0 - 2.0, np.inf)
    v = 15.0 - 0.4 * (u > 0.4) * (0.5 + 0.5 * np.exp(-since / 0.3))
    yardstick = Yardstick(Readings(t, v, u), 0.0)
    response = yardstick.measure(v).response
    assert yardstick.rises.size == 15
    assert response.min() == pytest.approx(-0.4, abs=0.02)
    late = np.searchsorted(yardstick.after, 1.0)
    assert response[late] == pytest.approx(-0.2 - 0.2 * np.exp(-1.0 / 0.3), abs=0.005)
    assert not Yardstick(Readings(t, v, None), 0.0).measure(v).response.size


def test_the_worst_is_the_farthest_in_half_bands():
    seeds = np.random.default_rng(4).standard_normal(400)

    def of(kind: str, measured: float, least: float = 1e-9) -> Difference:
        return Difference(kind, measured, seeds, least, lambda b: kind)

    level = of('level', 0.0)
    p, _, worst, kind = judge([of('lowest', 4.0), of('spectrum', 6.0), level], 0.9, True)
    # 6 at half the weight is less than 4.
    assert worst == kind == 'lowest'
    assert p == pytest.approx(1.0 / 401.0)
    p, *_ = judge([of('lowest', 0.0), level], 0.9, True)
    assert p > 0.9
    # A band that is wide by what a pilot would not notice.
    wide = of('lowest', 4.0, least=100.0)
    assert judge([wide, of('level', 0.0, least=100.0)], 0.9, True)[0] == pytest.approx(1.0 / 401.0)
    assert wide.scores()[0] == pytest.approx(0.04, rel=0.1)
    found = band(2.5, seeds)
    assert (found.low, found.high) == pytest.approx((-1.96, 1.96), abs=0.35)
    assert not found.inside


def test_the_verdict_follows_from_path_and_level():
    """Nothing looks alike whose path is worse than a constant, or whose mean is off its band."""
    seeds = np.random.default_rng(5).standard_normal(400)

    def of(kind: str, measured: float) -> Difference:
        return Difference(kind, measured, seeds, 1e-9, lambda b: kind)

    # Twelve others at once: at 1.1 half-bands from the median the level alone is no oddity.
    others = [Difference('lowest', 0.0, np.random.default_rng(k).standard_normal(400), 1e-9,
                         lambda b: 'lowest') for k in range(12)]
    looks, differs = Likeness.LOOKS_LIKE_IT, Likeness.DIFFERS
    at = [(0.0, 0.1, True, looks), (0.0, -0.1, False, looks), (0.0, -0.1, True, differs),
          (2.2, 0.1, True, differs)]
    for level, explained, moved, verdict in at:
        p, said, words, kind = judge([*others, of('level', level)], explained, moved)
        assert p > 0.05 and said is verdict
    assert words == kind == 'level'


def test_a_recording_is_the_farthest_as_often_as_each_simulation():
    """Four numbers of a recording and of 20 simulations, all of one law: p is uniform."""
    # Of 600, 28.6 are expected to be the farthest (standard deviation 5.2), and 30 to lie outside
    # a band of 50 simulations.
    rng, farthest, outside = np.random.default_rng(3), 0, 0
    for _ in range(600):
        x = rng.standard_normal((4, 21))
        p, *_ = judge([Difference(kind, row[0], row[1:], 1e-12, lambda b: '') for kind, row in zip(
            ('lowest', 'level', 'spectrum', 'ks'), x)], 1.0, True)
        farthest += p < 1.5 / 21.0
        y = rng.standard_normal(51)
        outside += not band(y[0], y[1:]).inside
    assert abs(farthest - 28.6) < 4.0 * 5.2
    assert abs(outside - 30.0) < 4.0 * 5.3
