"""A recording compared with simulations: verdicts, measures, the noise that is drawn."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.analysis.supply import supply_facts
from ou_monitor.comparison.compare import (
    Agreement, compare, ComparedNumber, judge, Likeness, rows_of, Yardstick)
from ou_monitor.comparison.flight_model import (
    _sag_error, damping, fit_flight, fit_noise, FlightNoise)
from ou_monitor.errors import InputError
from ou_monitor.model.load import lowpass
from ou_monitor.model.ou import simulate
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.records import Recording
from ou_monitor.report.comparison_document import _answer, _path
from ou_monitor.timeline import part_of
import pytest
from scipy.signal import lfilter
from scipy.stats import norm
from simulated_packs import Pack

ALPHA, SIGMA, LEVEL, SAG = 20.0, 0.3, 15.0, 1.5


def throttle(t: np.ndarray, seed: int = 0) -> np.ndarray:
    """Return throttle that is held for a second and a half at a time."""
    rng = np.random.default_rng(seed)
    return rng.random(int(t[-1] / 1.5) + 2)[(t / 1.5).astype(int)]


def drawn(seed: int, n: int = 4000, rate: float = 100.0) -> Recording:
    """Return a recording of the model below."""
    t = np.arange(n) / rate
    u = throttle(t)
    return Recording(t, model().simulate(t, np.random.default_rng(seed), u), u, 'made')


def model(sigma: float = SIGMA, sag: float = SAG) -> SupplyModel:
    return SupplyModel((OU(ALPHA, sigma, LEVEL), LoadSag(sag, 0.0)))


def test_a_recording_of_the_model_looks_like_it():
    """At most one in twenty differs by chance: of ten at most two, but for 1 % of such tests."""
    found = [compare(drawn(seed), model(), seeds=20, seed=seed) for seed in range(10)]
    assert sum(one.verdict is Likeness.DIFFERS for one in found) <= 2
    assert np.mean([one.p_value for one in found]) > 0.2


def test_a_pack_that_is_charged_is_compared():
    """Its current is negative while it lowers the voltage: the mean load is below 0."""
    rng, t = np.random.default_rng(9), np.arange(3000) * 0.02
    drawn = 10.0 + lowpass(rng.standard_normal(t.size), t, 0.5) * 35.0
    v = 15.6 + 0.03 * drawn + 0.01 * rng.standard_normal(t.size)
    found = compare(Recording(t, v, np.full(t.size, np.nan), current=drawn))
    assert found.verdict is Likeness.LOOKS_LIKE_IT and found.explained > 0.9


def test_dips_are_those_of_the_facts():
    """Short deep dips do not raise the voltage at which a dip ends."""
    rng, t = np.random.default_rng(16), np.arange(30000) * 1e-3
    v = 5.0 + 0.005 * rng.standard_normal(t.size)
    for begin in (20000, 24000, 28000):
        v[begin:begin + 30] -= 0.7
    whole = Recording(t, v, np.full(t.size, np.nan))
    level = 4.993
    (row,) = [row for row in compare(whole, levels=(level,)).of('dips') if row.at == (level,)]
    there = Recording(t[15000:], v[15000:], np.full(15000, np.nan))
    assert row.measured == pytest.approx(4.0 * supply_facts(there, level).dips.count, rel=0.02)


def test_alignment_leaves_an_error_of_the_level():
    """A voltage that wanders for seconds: the level taken from its beginning has an error."""
    # A level without its error made 85 % of such drawings differ with p < 0.05; of 10, more than 3
    # come once in 1000 tests.
    t = np.arange(800) / 20.0
    slow = SupplyModel((OU(1.0, 0.05, LEVEL),))
    found = [compare(Recording(t, slow.simulate(t, np.random.default_rng(seed)),
                               np.full(t.size, np.nan), 'made'), slow, seeds=40)
             for seed in range(10)]
    assert sum(one.p_value < 0.05 for one in found) <= 3


def test_a_level_that_wanders_is_not_taken_from_an_excursion():
    """Each simulation moved to a start of +1 V: the rest was 1 V too high."""
    t = np.arange(4000) / 20.0
    slow = SupplyModel((OU(0.1, 0.1, LEVEL),))
    v = slow.simulate(t, np.random.default_rng(0)) + np.exp(-0.1 * t)
    found = compare(Recording(t, v, np.full(t.size, np.nan), 'made'), slow, seeds=20)
    # Standard error of the mean of 200 s: 0.07 V; of the excursion 0.05 V.
    assert abs(found.bias) < 0.3


def test_the_mean_path_explains_all_but_the_noise():
    """1 - var(OU)/var(v), and no bias beyond that of the first two seconds."""
    recording = drawn(1)
    found = compare(recording, model(), seeds=40)
    noise = SIGMA ** 2 / (2.0 * ALPHA)
    # 4000 samples hold 400 independent ones (two relaxation times each).  The mean over 40
    # simulations adds 1/40 of the noise, the alignment that of two seconds: 2/(alpha 2 s).
    expected = noise * (1.0 + 1.0 / 40.0 + 1.0 / ALPHA) / recording.voltage.var()
    assert 1.0 - found.explained == pytest.approx(expected, rel=4.0 * np.sqrt(2.0 / 400.0))
    assert abs(found.bias) < 4.0 * np.sqrt(noise / ALPHA)


def test_a_doubled_sigma_differs():
    """Twice the intensity: the spectrum above the corner has four times the power."""
    t = np.arange(4000) / 100.0
    v = SupplyModel((OU(ALPHA, SIGMA, LEVEL),)).simulate(t, np.random.default_rng(2))
    found = compare(Recording(t, v, np.full(t.size, np.nan), 'bench'),
                    SupplyModel((OU(ALPHA, 2.0 * SIGMA, LEVEL),)), seeds=40)
    assert found.verdict is Likeness.DIFFERS
    assert found.worst.startswith('Largest difference:')
    top = found.of('spectrum')[-1]
    # 2000 ordinates: 2 % each for the recording and for the median.
    assert (top.median / top.measured) ** 2 == pytest.approx(4.0, rel=0.15)
    assert found.as_data()['spectrum'][-1]['simulated_over_measured'] == pytest.approx(
        (top.median / top.measured) ** 2)
    assert not found.of('line')


def test_a_line_that_the_simulation_lacks_is_a_difference():
    """Of 60 mV rms, in noise of 47 mV."""
    one = drawn(3)
    line = 0.06 * math.sqrt(2.0) * np.sin(2.0 * np.pi * 17.3 * one.t)
    found = compare(replace(one, voltage=one.voltage + line), model(), seeds=40)
    row, = found.of('line')
    assert row.at[0] == pytest.approx(17.3, abs=0.1)
    assert row.measured == pytest.approx(0.06, rel=0.1) and not row.inside
    assert row.high < 0.02


def test_a_faster_discharge_is_the_cause_of_lower_dips():
    """Of 1 V in 40 s: the lowest voltage is farther off, but follows from the level."""
    one = drawn(3)
    found = compare(replace(one, voltage=one.voltage - one.t / 40.0), model(), seeds=40)
    assert found.farthest == 'level' and not found.lowest.inside


@pytest.mark.parametrize('sag', [0.5 * SAG, 2.0 * SAG])
def test_a_wrong_sag_is_the_worst(sag):
    """A sag that is wrong by a factor is told by levels and answers, not by noise."""
    found = compare(drawn(3), model(sag=sag), seeds=40)
    assert found.verdict is Likeness.DIFFERS
    assert any(word in found.worst for word in ('rises of throttle', 'lowest', 'dips below'))


def test_only_the_part_after_fit_until_is_simulated():
    found = compare(drawn(4), model(), fit_until=30.0, seeds=20)
    assert found.simulated == (30.0, pytest.approx(39.99))
    assert found.fitted == (0.0, 0.0)
    assert found.part.t[0] == 30.0


def flight(seed: int, n: int = 1500, rate: float = 50.0) -> Recording:
    """Return a flight of a pack whose noise follows throttle, in steps of 10 mV."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / rate
    u = 0.2 + 0.6 * throttle(t, seed)
    pack = Pack(4, 0.3, charge=0.8, endurance=400.0)
    noise = 0.05 * np.exp(u * (1.4 - u) / 0.49 - 1.0) * rng.standard_normal(n)
    return Recording(t, 0.01 * np.rint(100.0 * (pack.path(t, u) + noise)), u, 'pack')


def test_the_second_half_follows_from_the_first():
    found = compare(flight(1), seeds=40)
    assert found.fitted == (0.0, pytest.approx(14.99, abs=0.03))
    assert found.verdict is Likeness.LOOKS_LIKE_IT
    assert 'load_sag' in found.model and 'load_dependent_noise' in found.model
    assert found.explained > 0.9
    assert all(dips.inside for dips in found.of('dips'))
    # What is farthest off is named, too, though it is within chance.
    assert found.words
    assert found.farthest in ('lowest', 'dips', 'level', 'answer', 'spectrum', 'ks')


def test_the_lowest_voltage_is_mostly_within_its_band():
    """Of 16 flights, each outside its 95 % band by chance, more than 4 with probability 9e-4."""
    assert sum(not compare(flight(seed), seeds=40).lowest.inside for seed in range(16)) <= 4


@pytest.mark.parametrize('warming', [0.0, 6.0])
def test_how_much_a_pack_warms_is_fitted(warming):
    """A pack with another curve of the cell, whose resistance is constant, or falls by a third."""
    rng = np.random.default_rng(2)
    n, dt = 6000, 0.02
    t, keep = dt * np.arange(n), math.exp(-1.2 * dt)
    u = 0.33 + lfilter([0.07 * math.sqrt(1.0 - keep ** 2)], [1.0, -keep], rng.standard_normal(n))
    at = 4.0
    while at < 112.0:
        end = at + rng.uniform(0.3, 1.6)
        u[(t >= at) & (t < end)] = rng.uniform(0.7, 1.0)
        at = end + 1.5 + rng.exponential(4.0)
    u = np.clip(u, 0.0, 1.0)
    curve = ([0.0, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 1.0],
             [3.30, 3.55, 3.66, 3.73, 3.79, 3.88, 4.02, 4.10, 4.19])
    charge, slow, heat, motor, v = 0.97, 0.0, 0.0, 0.0, np.full(n, 16.0)
    for k in range(n):
        motor += -math.expm1(-dt / 0.04) * (u[k] - motor)
        current = 0.6 + 118.0 * motor ** 1.9 * v[k - 1] / 15.2
        ohm = 0.021 * math.exp(-warming * heat)
        v[k] = 4.0 * np.interp(charge, *curve) - slow - ohm * current
        slow += -math.expm1(-dt / 1.5) * (0.5 * ohm * current - slow)
        drawn_now = current * dt / 3600.0 / 1.3
        charge -= drawn_now
        heat += 1.5 * ohm * current / 15.2 * drawn_now
    assert (math.exp(-warming * heat) < 0.75) is (warming > 0.0)
    v += (0.012 + 0.08 * u) * rng.standard_normal(n)
    found = compare(Recording(t, 0.01 * np.rint(100.0 * v), u, 'pack'), seeds=40)
    assert found.verdict is Likeness.LOOKS_LIKE_IT, found.words
    assert found.lowest.inside


def test_jitter_of_throttle_is_no_noise_and_no_path():
    """What of the path's fast changes is not in the voltage is damped, by least squares."""
    rng = np.random.default_rng(8)
    t = np.arange(4000) / 50.0
    slow = np.cumsum(rng.standard_normal(t.size)) * 0.05
    jitter = 0.3 * rng.standard_normal(t.size)
    path = 15.0 + slow + jitter
    for share in (0.0, 0.7, 1.0):
        v = path - share * (path - lowpass(path, t, 0.02)) + 0.1 * rng.standard_normal(t.size)
        # The fast part has a deviation of some 0.2 V: 0.1/(0.2 sqrt(4000)) = 0.008 of the share.
        assert damping(Recording(t, v), path) == pytest.approx(share, abs=0.04)


def test_without_throttle_there_is_level_and_noise():
    """Also with one that does nothing: no path to fail; at most one of three differs by chance."""
    t = np.arange(6000) / 200.0
    supply = SupplyModel((OU(ALPHA, SIGMA, 5.0), MeasurementNoise(0.02)))
    differ = 0
    for seed, held in enumerate((np.nan, 0.4, np.where(t % 2.0 < 1.0, 0.2, 0.8))):
        v = supply.simulate(t, np.random.default_rng(seed), np.full(t.size, 0.4))
        found = compare(Recording(t, v, np.full(t.size, held), 'bench'), seeds=40)
        assert found.model[:2] == ('ou', 'measurement_noise')
        assert any('only level and noise' in note for note in found.notes)
        assert found.farthest != 'path'
        differ += found.verdict is Likeness.DIFFERS
    assert differ <= 1


def robot(seed: int, seconds: float = 40.0, rate: float = 50.0) -> Recording:
    """Return 12 V at 20 mOhm that do not discharge, their current 60 ms late and negative."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    steps = rng.choice([0.0, 20.0, 60.0, 90.0], 41)
    drawn_now = 5.0 + lowpass(steps[(t * 40.0 / seconds).astype(int)], t, seconds / 2000.0)
    v = 12.5 - 0.02 * drawn_now + 0.02 * rng.standard_normal(t.size)
    enabled = np.where(t > 0.1 * seconds, 1.0, 0.0)
    late = 3 if rate < 100.0 else 0
    return Recording(t, v, enabled, 'robot', current=-np.concatenate((
        np.full(late, drawn_now[0]), drawn_now[:t.size - late])))


@pytest.mark.parametrize('seconds, rate', [(40.0, 50.0), (0.8, 1000.0)])
def test_a_measured_current_is_the_load(seconds, rate):
    """With its sign, its offset at rest and its delay; a level that stands does not discharge."""
    found = compare(robot(1, seconds, rate), seeds=20)
    # Sag 1.2 V, a step a second: a variance of some 0.4 V^2 beside 4e-4 V^2 of noise.
    assert found.explained > 0.97
    assert abs(found.bias) < 0.02
    assert 'load_sag' in found.model and 'drift' not in found.model


def test_a_current_with_gaps_is_used_and_one_that_ends_is_not():
    whole = robot(2)
    off = (whole.t < 3.0) | (whole.t > 4.2)
    gap = Recording(whole.t[off], whole.voltage[off], whole.throttle[off], 'gap',
                    current=whole.current[off])
    assert compare(gap, seeds=20).explained > 0.97
    ends = Recording(whole.t, whole.voltage, whole.throttle, 'ends', current=np.where(
        whole.t < 35.0, whole.current, np.nan))
    assert not compare(ends, seeds=20).explained > 0.5


def test_a_bench_supply_does_not_discharge():
    """A staircase of throttle at a level that stands; then all of it at once."""
    rng = np.random.default_rng(4)
    t = np.arange(4000) / 50.0
    u = np.minimum(np.floor(t / 4.0), 19.0 - np.floor(t / 4.0)) / 10.0
    u = np.clip(u, 0.0, 1.0)
    v = 16.6 - 1.2 * u ** 1.7 + 0.01 * rng.standard_normal(t.size)
    found = compare(Recording(t, v, u, 'bench'), fit_until=30.0, seeds=20)
    assert found.explained > 0.95
    assert any('the level is constant' in note for note in found.notes)


def test_the_error_of_the_sag_is_that_between_two_means_of_four_parts():
    """Each part is held out from a model of the other three."""
    moved = throttle(np.arange(1000) / 100.0)
    sags = np.array([0.9, 1.0, 1.04, 1.1])
    others = (sags.sum() - sags) / 3.0
    # Relative to a sag of 1 V of the model.
    parts = [(15.0 - moved, 15.0 - (1.0 + one - other) * moved)
             for one, other in zip(sags, others)]
    assert _sag_error(parts) == pytest.approx(math.sqrt(2.0 * sags.var(ddof=1) / 4.0))


def test_both_kinds_of_level_are_simulated_by_their_probability():
    """The mean path is their weighted mean, and of 300 simulations their share has the other."""
    recording = flight(0)
    samples = Recording(recording.t, recording.voltage, recording.throttle)
    found = fit_flight(samples)
    one, other = found.fits
    assert one.falls is not other.falls
    assert found.odds == pytest.approx(
        np.array([1.0, math.exp(other.evidence - one.evidence)]) * found.odds[0])
    # Levels 1 kV apart, so that each draw shows which was drawn.
    far = replace(other, values=other.values + np.append(1e3, np.zeros(other.values.size - 1)),
                  falls=False)
    mixed = replace(found, fits=(one, far), odds=np.array([0.7, 0.3]))
    assert mixed.path(samples) == pytest.approx(0.7 * replace(
        found, odds=np.array([1.0, 0.0])).path(samples) + 0.3 * replace(
        mixed, odds=np.array([0.0, 1.0])).path(samples))
    # 300 draws: 0.3 +- 0.026; 4 of them.
    draw, rng = mixed.simulator(part_of(samples, slice(0, 200))), np.random.default_rng(1)
    high = [draw(rng).mean() > 500.0 for _ in range(300)]
    assert np.mean(high) == pytest.approx(0.3, abs=0.106)


@pytest.mark.parametrize('offset', [0.0, 0.25, 0.5, 0.75])
def test_a_coarse_adc_may_have_any_offset(offset):
    """Codes of one deviation: counted from 0 they gave half as many dips, or twice as many."""
    rail = SupplyModel((OU(20.0, 0.2, 15.0),))
    t, step = np.arange(12000) / 100.0, 0.03
    v = rail.simulate(t, np.random.default_rng(3))
    found = compare(Recording(t, step * (np.rint(v / step - offset) + offset)), rail, seeds=20)
    ks, = found.of('ks')
    assert found.verdict is Likeness.LOOKS_LIKE_IT and ks.inside
    assert all(one.low / 1.2 < one.measured < 1.2 * one.high for one in found.of('dips'))


def test_held_samples_count_once():
    """A logger five times as fast as its source tells the same."""
    slow = flight(2, 800)
    fast = Recording(np.arange(4000) / 250.0, np.repeat(slow.voltage, 5),
                     np.repeat(slow.throttle, 5), 'held')
    one, other = (compare(each, model(), seeds=20) for each in (slow, fast))
    assert any('repeats its last value' in note for note in other.notes)
    # But for the first reading, whose begin is not in the recording.
    one, other = (each.of('dips')[1] for each in (one, other))
    assert other.measured == pytest.approx(one.measured, rel=0.1)
    assert other.median == pytest.approx(one.median, rel=0.4)


@pytest.mark.parametrize('change, words', [
    ({'fit_until': 60.0}, 'must end within the recording'),
    ({'fit_until': 0.0}, 'must end within the recording'),
    ({'fit_until': 0.2}, 'the part to be fitted has'),
    ({'fit_until': 39.9}, 'the part to be simulated has')])
def test_parts_that_are_too_short_are_refused_by_name(change, words):
    with pytest.raises(InputError, match=words):
        compare(drawn(6), **change)


def test_recordings_that_cannot_be_compared_are_refused():
    t = np.arange(400) / 100.0
    none = np.full(t.size, np.nan)
    with pytest.raises(InputError, match='needs at least 100'):
        compare(Recording(t[:60], np.sin(t[:60]), none[:60], 'short'))
    with pytest.raises(InputError, match='constant|change'):
        compare(Recording(t, np.full(t.size, 5.0), none, 'flat'))
    with pytest.raises(InputError, match="'load_sag' needs throttle"):
        compare(Recording(t, np.sin(t), none, 'bench'), model())
    with pytest.raises(ValueError, match='20 to 10000, got 3'):
        compare(drawn(7), seeds=3)


def test_numbers_outside_their_bands_are_named_beside_the_verdict():
    found = replace(compare(drawn(1), model()), verdict=Likeness.LOOKS_LIKE_IT)

    def outside(*kinds: str) -> Agreement:
        """Return it with these kinds above their bands, and the others at the median."""
        return replace(found, rows=tuple(replace(
            row, measured=row.high + 1.0 if row.kind in kinds else row.median)
            for row in found.rows))

    far = outside('lowest')
    said = ' '.join(_answer(far))
    assert 'Outside their own bands' in said and 'lowest voltage' in said.split('Outside')[1]
    assert 'chance allows this' in said and 'within chance' in far.worst
    many = outside('lowest', 'level', 'dips', 'answer')
    # No chance is claimed for what chance does not explain.
    assert 'within chance' not in many.worst + str(_path(many))
    assert 'only in part' in _answer(many)[0] and 'distribution (KS distance)' in {
        row['measure'] for row in found.measures()}


RATE, N = 100.0, 20_000


def white(seed: int) -> Recording:
    """Return white noise of 0.1 V about 5 V."""
    t = np.arange(N) / RATE
    return Recording(t, 5.0 + 0.1 * np.random.default_rng(seed).standard_normal(N))


def test_falls_of_white_noise_are_counted_as_theory_says():
    """Of independent samples p below and q above by the noise: p q / (p + q) falls a sample."""
    noise = white(1)
    found = Yardstick(noise, 0.0).measure(noise.voltage)
    rates = [one[-1] for one in found.numbers if one[0] == 'dips']
    for share, dips in zip((0.01, 0.05), rates):
        above = norm.sf(norm.ppf(share) + 1.0)
        expected = share * above / (share + above) * RATE * 60.0
        # The count is nearly Poisson; the level is the sample's own quantile, which helps.
        assert dips == pytest.approx(expected, abs=4.0 * np.sqrt(expected * 60.0 * RATE / N))


def test_a_line_in_one_half_is_none():
    """A line of 60 mV in noise of 100 mV is one if it lasts, as a tone of a converter does."""
    noise = white(8)
    line = 0.06 * np.sin(2.0 * np.pi * 17.3 * noise.t)
    for there, count in ((noise.t > 0.0, 1), (noise.t < 0.5 * noise.t[-1], 0)):
        v = noise.voltage + line * there
        yardstick = Yardstick(replace(noise, voltage=v), 0.0)
        rows = rows_of([yardstick.measure(v)] * 21)
        assert sum(row.kind == 'line' for row in rows) == count


def test_a_fall_is_a_dip_of_the_facts():
    """Both count the same runs: of noise about the level a crossing is none."""
    samples = part_of(white(4), slice(0, 4000))
    u = (samples.t % 4.0 > 2.0).astype(float)
    v = samples.voltage - 0.3 * u
    own = Recording(samples.t, v, u)
    levels = (4.75, 5.0)
    yardstick = Yardstick(Recording(own.t, v, u), 0.0, levels)
    rates = [one[-1] for one in yardstick.measure(v).numbers if one[0] == 'dips']
    counts = np.array(rates[:2]) * np.ptp(own.t) / 60.0
    assert counts.tolist() == pytest.approx([supply_facts(own, x).dips.count for x in levels])
    crossings = [np.count_nonzero((v[:-1] >= x) & (v[1:] < x)) for x in levels]
    assert np.all(counts < 0.8 * np.array(crossings)) and np.all(counts > 0)


def test_white_noise_has_equal_power_in_equal_bands():
    """A flat spectrum: each band has its share of the variance."""
    noise = white(2)
    yardstick = Yardstick(noise, 0.0)
    own = yardstick.measure(noise.voltage)
    bands = [row for row in rows_of([own] * 21) if row.kind == 'spectrum']
    for row in bands[2:]:
        assert row.measured ** 2 == pytest.approx(
            0.01 * (row.at[1] - row.at[0]) / (0.5 * RATE), rel=0.15)


def test_levels_lie_between_codes():
    coarse = white(3)
    coarse = Recording(coarse.t, 0.1 * np.rint(coarse.voltage / 0.1))
    levels = Yardstick(coarse, 0.1).levels
    assert np.allclose(np.mod(np.array(levels) / 0.1, 1.0), 0.5)
    assert len(levels) == len(set(levels))


def test_the_mean_response_to_rises_is_measured():
    """A step response of -1 V for each unit of throttle, which decays to half of it."""
    t = np.arange(6000) / RATE
    u = np.where((t % 4.0) < 2.0, 0.2, 0.6)
    since = np.where(u > 0.4, t % 4.0 - 2.0, np.inf)
    v = 15.0 - 0.4 * (u > 0.4) * (0.5 + 0.5 * np.exp(-since / 0.3))
    yardstick = Yardstick(Recording(t, v, u), 0.0)
    response = yardstick.measure(v).response
    assert yardstick.rises.size == 15
    assert response.min() == pytest.approx(-0.4, abs=0.02)
    late = np.searchsorted(yardstick.after, 1.0)
    assert response[late] == pytest.approx(-0.2 - 0.2 * np.exp(-1.0 / 0.3), abs=0.005)
    assert not Yardstick(Recording(t, v), 0.0).measure(v).response.size


def row(kind: str, measured: float, simulated: np.ndarray, least: float = 1e-9) -> ComparedNumber:
    """Return a row named by its kind."""
    return ComparedNumber(kind, kind, 'V', 3, least, (), measured, simulated)


def test_the_worst_is_the_farthest_in_half_bands():
    seeds = np.random.default_rng(4).standard_normal(400)
    level = row('level', 0.0, seeds)
    p, _, worst, kind = judge(
        [row('lowest', 4.0, seeds), row('line', 4.5, seeds), level], 0.9, True)
    # 4.5 at 0.8 of the weight is less than 4.
    assert worst.startswith('lowest') and kind == 'lowest'
    assert p == pytest.approx(1.0 / 401.0)
    p, *_ = judge([row('lowest', 0.0, seeds), level], 0.9, True)
    assert p > 0.9
    # A band that is wide by what a pilot would not notice.
    wide = row('lowest', 4.0, seeds, least=100.0)
    assert judge([wide, row('level', 0.0, seeds, 100.0)], 0.9, True)[0] == pytest.approx(
        1.0 / 401.0)
    assert wide.scores()[0] == pytest.approx(0.04, rel=0.1)
    found = row('lowest', 2.5, seeds)
    assert (found.low, found.high) == pytest.approx((-1.96, 1.96), abs=0.35)
    assert not found.inside and found.outside[1:].mean() == pytest.approx(0.05, abs=0.01)
    # A spectrum is judged by the logarithm of its power.
    power = row('spectrum', 2.0, np.exp(seeds))
    assert power.scores() == pytest.approx(0.5 / 0.8 * row(
        'level', 2.0 * math.log(2.0), 2.0 * seeds).scores())


def test_the_verdict_follows_from_path_and_level():
    """Nothing looks alike whose path is worse than a constant, or whose mean is off its band."""
    seeds = np.random.default_rng(5).standard_normal(400)
    # Twelve others at once: at 1.1 half-bands from the median the level alone is no oddity.
    others = [row('lowest', 0.0, np.random.default_rng(k).standard_normal(400))
              for k in range(12)]
    looks, differs = Likeness.LOOKS_LIKE_IT, Likeness.DIFFERS
    at = [(0.0, 0.1, True, looks), (0.0, -0.1, False, looks), (0.0, -0.1, True, differs),
          (2.2, 0.1, True, differs)]
    for level, explained, moved, verdict in at:
        p, said, words, kind = judge([*others, row('level', level, seeds)], explained, moved)
        assert p > 0.05 and said is verdict
    assert words.startswith('level') and kind == 'level'


def test_a_recording_is_the_farthest_as_often_as_each_simulation():
    """Four numbers of a recording and of 20 simulations, all of one law: p is uniform."""
    # Of 600, 28.6 are expected to be the farthest (standard deviation 5.2), and 30 to lie outside
    # a band of 50 simulations.
    rng, farthest, outside = np.random.default_rng(3), 0, 0
    for _ in range(600):
        x = rng.standard_normal((4, 21))
        p, *_ = judge([row(kind, one[0], one[1:]) for kind, one in zip(
            ('lowest', 'level', 'dips', 'ks'), x)], 1.0, True)
        farthest += p < 1.5 / 21.0
        y = rng.standard_normal(51)
        outside += not row('level', y[0], y[1:]).inside
    assert abs(farthest - 28.6) < 4.0 * 5.2
    assert abs(outside - 30.0) < 4.0 * 5.3


DT, COUNT = 0.01, 12_000
T = DT * np.arange(COUNT)


def series(seed: int, std: float, white: float) -> np.ndarray:
    """Return an OU of 0.2 s and white noise, V."""
    rng = np.random.default_rng(seed)
    return simulate(T, 5.0, std * np.sqrt(10.0), rng) + white * rng.standard_normal(COUNT)


def fitted(x: np.ndarray, load: np.ndarray | None = None, slow: float = 0.0) -> FlightNoise:
    """Fit the noise of a supply of 4 cells."""
    return fit_noise(Recording(T, 15.0 + x, load), x, load, slow)


def correlation(x: np.ndarray, lag: int) -> float:
    return float(x[lag:] @ x[:-lag]) / float(x @ x)


def test_an_ou_in_white_noise_is_drawn_again():
    found = fitted(series(1, 0.05, 0.05))
    drawn = np.concatenate([found.draw(COUNT, None, np.random.default_rng(k)) for k in range(8)])
    # 120 s hold 300 relaxation times: the OU's variance is known to 8 %, its rate to some 12 %.
    assert drawn.var() == pytest.approx(2.0 * 0.05 ** 2, rel=0.15)
    for lag in (1, 10):
        assert correlation(drawn, lag) == pytest.approx(0.5 * np.exp(-5.0 * DT * lag), abs=0.08)


def test_errors_of_prediction_are_white():
    """They have no memory, and less variance than the series, a slow process or not."""
    for slow in (0.0, 0.02):
        x = series(2, 0.05, 0.05)
        x = x + (simulate(T, 0.05, slow * np.sqrt(0.1), np.random.default_rng(3)) if slow else 0.0)
        found = fitted(x, slow=slow ** 2)
        # In the order of their stamps again: without a load all sizes are alike.
        assert abs(correlation(found.errors, 1)) < 4.0 / np.sqrt(COUNT)
        assert np.mean(found.errors ** 2) < 0.8 * x.var()


def test_white_noise_stays_white():
    """No OU is visible in it: VISIBLE is beyond what white noise shows."""
    found = fitted(series(4, 0.0, 0.05))
    assert found.phi == found.theta == 0.0
    # The mean of independent errors.
    assert found.mean_error(DT * COUNT) == pytest.approx(0.05 / np.sqrt(COUNT), rel=0.05)


def test_the_size_follows_load_and_changes():
    rng = np.random.default_rng(5)
    u = rng.random(COUNT // 10)[np.arange(COUNT) // 10]
    changed = np.abs(np.diff(u, prepend=u[0])) > 0.2
    size = 0.02 * np.exp(1.5 * u) * np.where(changed, 4.0, 1.0)
    found = fitted(size * rng.standard_normal(COUNT), u)
    assert found.sizes.follows
    drawn = np.stack([found.draw(COUNT, u, np.random.default_rng(k)) for k in range(8)])
    # 780 changes have an rms known to 2.5 %; the law is smooth in the change, the size is not.
    for there, error in ((~changed & (u < 0.2), 0.1), (~changed & (u > 0.8), 0.1), (changed, 0.2)):
        expected = np.sqrt(np.mean(size[there] ** 2))
        assert np.std(drawn[:, there]) == pytest.approx(expected, rel=error)
    assert not fitted(size * rng.standard_normal(COUNT), np.full(COUNT, 0.4)).sizes.follows


def test_rounding_is_not_drawn():
    rng = np.random.default_rng(6)
    x = 0.1 * np.rint(10.0 * 0.1 * rng.standard_normal(COUNT))
    found = fit_noise(Recording(T, 15.0 + x), x, None, 0.0)
    assert found.draw(COUNT, None, rng).var() == pytest.approx(x.var() - 0.1 ** 2 / 12.0, rel=0.08)


def test_a_voltage_without_noise_has_none():
    found = fitted(np.zeros(COUNT), np.linspace(0.0, 1.0, COUNT))
    assert np.all(found.draw(COUNT, np.linspace(0.0, 1.0, COUNT), np.random.default_rng(7)) == 0.0)
