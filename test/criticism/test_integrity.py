"""Exact findings: each is found if it is there, and only then."""

import math
import tracemalloc

import numpy as np
from ou_monitor.criticism.adc import find_step
from ou_monitor.criticism.integrity import _judge_step, examine, judge_stamps, LEAST
from ou_monitor.criticism.samples import choose_samples, events_between, MOST
from ou_monitor.model.ou import simulate
from ou_monitor.records import Recording
import pytest

ALPHA, SIGMA, RATE = 63.0, 0.3156, 1000.0
# Standard deviation of what a millisecond adds, V.
STEP_STD = SIGMA * math.sqrt(-math.expm1(-2.0 * ALPHA / RATE) / (2.0 * ALPHA))


def rail(seed, n=20_000, rate=RATE, alpha=ALPHA, u0=5.0):
    t = np.arange(n) / rate
    return t, simulate(t, alpha, SIGMA, np.random.default_rng(seed), u0=u0)


def examined(t, v, u=None):
    return examine(Recording(t, v, np.full(t.size, np.nan) if u is None else u, 'made'))


def names(found):
    return [term.NAME for term in found.exact]


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('rounded', [False, True])
def test_a_plain_rail_has_nothing(seed, rounded):
    """Neither in float64 nor after float32; no sample is lost."""
    t, v = rail(seed, u0=16.0)
    found = examined(t, v.astype(np.float32).astype(float) if rounded else v)
    assert names(found) == [] and found.samples.n == t.size and found.samples.even


@pytest.mark.parametrize('load', [0.0, 0.4])
@pytest.mark.parametrize('count', [30, 200])
def test_outliers_are_no_limit_of_the_adc(load, count):
    t, v = rail(4, u0=12.0)
    u = np.where(t % 4.0 < 3.0, 0.2, 0.7)
    v = v - load * u
    v[np.random.default_rng(1).choice(t.size, count, replace=False)] -= 2.0
    assert names(examined(t, v, u)) == []


@pytest.mark.parametrize('factor', [2.0, 4.0, 5.743])
def test_repeats_are_dropped(factor):
    """The source's own rate and stamps come back, whole ratio or not."""
    t, v = rail(1)
    begun = np.floor(np.floor(np.arange(t.size) / factor) * factor).astype(int)
    found = examined(t, v[begun])
    assert names(found) == ['held_samples']
    assert found.exact[0].rate == pytest.approx(RATE / factor, rel=1e-3)
    assert abs(found.samples.n - t.size / factor) <= 3
    assert np.diff(found.samples.voltage).all() and found.samples.even
    assert np.median(np.diff(found.samples.t)) == pytest.approx(factor / RATE, rel=1e-3)


def test_lost_conversions_are_repeats():
    """At random distances: every tie goes, nothing else."""
    t, v = rail(2)
    fresh = np.random.default_rng(5).random(t.size) > 0.3
    fresh[0] = True
    held = v[np.maximum.accumulate(np.where(fresh, np.arange(t.size), 0))]
    found = examined(t, held)
    assert names(found) == ['held_samples'] and found.samples.n == fresh.sum()
    assert np.array_equal(found.samples.t, t[fresh])


@pytest.mark.parametrize('offset', [0.0, 3.3, 48.123])
@pytest.mark.parametrize('share', [0.05, 0.5, 2.0])
def test_steps_are_found_and_named_where_they_matter(share, offset):
    """In float32, at any offset: within 1e-3; named from 0.3 of the noise."""
    t, v = rail(3)
    step = share * STEP_STD
    coded = offset + step * np.rint(v / step)
    coded = coded.astype(np.float32).astype(float)
    assert find_step(coded) == pytest.approx(step, rel=1e-3)
    found = examined(t, coded)
    assert names(found) == (['quantization'] if share > 0.3 else [])
    assert found.samples.n == t.size
    assert any('voltage resolution' in note for note in found.notes)


def test_no_lattice_in_what_is_rounded_to_text():
    """Six digits of a continuous voltage are no ADC that matters."""
    t, v = rail(4)
    assert names(examined(t, np.round(v, 5))) == []


@pytest.mark.parametrize('step', [0.0, 0.3 * STEP_STD])
@pytest.mark.parametrize('sides', ['low', 'high', 'both'])
def test_rails_are_found(step, sides):
    """4 % beyond an end: the limits; all samples stay as they are."""
    t, v = rail(5)
    v = step * np.rint(v / step) if step else v
    low, high = np.quantile(v, [0.04, 0.96])
    clipped = np.clip(v, low if sides != 'high' else -np.inf, high if sides != 'low' else np.inf)
    found = examined(t, clipped)
    (term,) = [term for term in found.exact if term.NAME == 'saturation']
    s = found.samples.voltage
    assert (term.low == low) == (sides != 'high') and (term.high == high) == (sides != 'low')
    assert np.array_equal(s, clipped)
    assert np.array_equal(found.drawn, (clipped <= term.low) | (clipped >= term.high))


def test_wrong_stamps_differ_from_uneven_sampling():
    rng = np.random.default_rng(7)
    t, v = rail(7)
    stamps = t + 0.25 / RATE * np.clip(rng.standard_normal(t.size), -1.8, 1.8)
    used, error = judge_stamps(stamps, v, [])
    assert error == pytest.approx((stamps - t).std(), rel=0.01)
    assert np.abs(used - t).max() < 0.02 / RATE
    assert names(examined(stamps, v)) == ['clock_jitter']
    true = simulate(stamps, ALPHA, SIGMA, rng, u0=5.0)
    used, error = judge_stamps(stamps, true, [])
    assert error == 0.0 and np.array_equal(used, stamps)


@pytest.mark.parametrize('queue', [False, True])
def test_late_stamps_are_no_gaps(queue):
    """Delays of half a step on average, at times of more than one; in a queue, none overtakes."""
    rng = np.random.default_rng(9)
    t, v = rail(9)
    late = rng.exponential(0.5 / RATE, t.size) * (rng.random(t.size) < 0.2 if queue else 1.0)
    stamps = np.maximum.accumulate(t + (2.0 if queue else 1.0) * late)
    stamps += 1e-3 / RATE * np.arange(t.size) / t.size
    notes = []
    used, error = judge_stamps(stamps, v, notes)
    assert error == pytest.approx((stamps - used).std(), rel=0.01)
    # The grid is that of the mean delay.
    assert np.ptp(used - t) < 0.1 / RATE
    assert not any('gap' in note for note in notes)
    # With lost samples, and stamps in time, there are gaps.
    kept = rng.random(t.size) < 0.99
    judge_stamps(t[kept], v[kept], notes)
    assert any('gap' in note for note in notes)


@pytest.mark.parametrize('seed', range(3))
def test_a_short_recording_tells_wrong_stamps_by_their_likelihood(seed):
    """3000 samples, a tenth of a step: the slope is known to 0.2, and 0 and 1 lie apart."""
    rng = np.random.default_rng(seed)
    grid = np.arange(3000) / 1000.0
    stamps = grid + 1e-4 * np.clip(rng.standard_normal(grid.size), -4.0, 4.0)
    assert judge_stamps(stamps, simulate(grid, 63.0, 0.3, rng), [])[1] > 0.0
    assert judge_stamps(stamps, simulate(stamps, 63.0, 0.3, rng), [])[1] == 0.0


def test_gaps_stay_and_are_counted():
    t, v = rail(8)
    keep = np.ones(t.size, bool)
    keep[5000:5400] = keep[9000:9003] = False
    found = examined(t[keep], v[keep])
    assert np.array_equal(found.samples.t, t[keep])
    assert any('2 gaps' in note and '0.401 s' in note for note in found.notes)


def test_nan_is_dropped_and_stamps_are_sorted():
    t, v = rail(9, 1000)
    u = np.linspace(0.0, 1.0, t.size)
    expected = np.delete(t, 10)
    v[10] = np.nan
    u[[0, 500]] = np.nan
    order = np.arange(t.size)
    order[[700, 701]] = 701, 700
    t2 = np.append(t[order], t[300])
    found = examined(t2, np.append(v[order], v[300]), np.append(u[order], u[300]))
    assert np.allclose(found.samples.t, expected, atol=1e-9)
    assert found.samples.throttle[0] == u[1] and np.isfinite(found.samples.throttle).all()
    assert found.samples.throttle[499] == u[499]
    text = ' '.join(found.notes)
    assert '1 sample dropped' in text and 'sorted by stamp' in text and 'unknown at 2' in text


@pytest.mark.parametrize('n, value', [(2, None), (LEAST - 1, None), (5000, 3.3), (0, None)])
def test_too_little_has_a_reason(n, value):
    t = np.arange(n) / RATE
    v = rail(1, n)[1] if value is None and n else np.full(n, value or 0.0)
    found = examined(t, v)
    assert found.samples is None and found.reason.endswith('.')


@pytest.mark.parametrize('u, word', [(None, 'not recorded'), (0.4, 'constant')])
def test_throttle_that_does_not_move_is_left_out_with_a_note(u, word):
    """It is left out, and the causes that need it are said to be untestable."""
    t, v = rail(1, 2000)
    found = examined(t, v, None if u is None else np.full(t.size, u))
    assert found.samples.throttle is None
    (note,) = [note for note in found.notes if 'cannot be tested' in note]
    assert word in note and 'load_sag' in note and 'throttle_tone' in note


@pytest.mark.parametrize('alpha', [63.0, 6300.0])
def test_too_many_samples_keep_their_relaxation(alpha):
    """100 kHz: a slow rail is thinned, a fast one cut; alpha stays to be seen."""
    # The lag-1 correlation has a standard error of sqrt((1 - r^2) / n).
    n = 1_000_000
    t, v = rail(11, n, 1e5, alpha)
    which, note = choose_samples(v, 1e5)
    used = v[which]
    assert MOST // 4 <= used.size <= MOST and note
    assert ('middle' in note) == (alpha > 1000.0)
    step = (which.step or 1) / 1e5
    assert alpha * step < 0.6
    r = np.corrcoef(used[1:], used[:-1])[0, 1]
    wanted = math.exp(-alpha * step)
    # Few relaxation times give few independent samples.
    assert abs(r - wanted) < 5.0 * math.sqrt((1.0 - wanted**2) / used.size)


def test_white_telemetry_is_thinned_over_its_whole_length():
    """A year at 1 Hz remembers nothing from sample to sample: all of it is used."""
    v = np.random.default_rng(0).standard_normal(500_000)
    which, note = choose_samples(v, 1.0)
    assert which.start == 0 and which.stop == v.size and v[which].size <= MOST and note


def test_long_recordings_bound_memory():
    """1e6 held samples: less beside the input than ten arrays of their size."""
    n = 1_000_000
    v = np.repeat(np.random.default_rng(0).standard_normal(n // 4), 4)
    recording = Recording(np.arange(n) / RATE, v, np.full(n, 0.3), 'long')
    tracemalloc.start()
    found = examine(recording)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert names(found) == ['held_samples'] and found.samples.n <= MOST
    assert peak < 10 * 8 * n


def test_a_line_faster_than_the_samples_used_is_found_in_all():
    """Half a million samples at 100 kHz of which every 7th is used: a line at 31 kHz."""
    # Whitened, it gains n amplitude^2 |1 - phi exp(-iw)|^2 / (4 step^2) = 60 nats; phase and
    # amplitude then have standard errors of sqrt(1 / 120) and that share of the amplitude.
    n, rate = 500_000, 1e5
    t, v = rail(12, n, rate)
    step = np.diff(v).std()
    turn = 2.0 * math.pi * 31_234.5 / rate
    amplitude = math.sqrt(60.0 * 4.0 * step**2 / n) / abs(1.0 - np.exp(-1j * turn))
    line = amplitude * np.sin(2.0 * math.pi * 31_234.5 * (t - t[0]) + 1.0)
    assert not names(examined(t, v))
    found = examined(t, v + line)
    (tone,) = [term for term in found.exact if term.NAME == 'tone']
    assert tone.frequency == pytest.approx(31_234.5, abs=0.1)
    assert tone.amplitude == pytest.approx(amplitude, rel=4.0 * math.sqrt(1.0 / 120.0))
    assert any('31234.5 Hz' in note for note in found.notes)
    # What is left of it at the samples used.
    plain = examined(t, v).samples
    rest = found.samples.voltage - plain.voltage
    assert np.abs(rest).max() < 6.0 * math.sqrt(2.0 / 120.0) * amplitude


def test_events_that_only_neighbours_show_are_kept():
    """Jumps of 8 deviations of a step: the samples on both sides; none after throttle."""
    n, rate = 500_000, 1e5
    t, v = rail(13, n, rate)
    where = np.array([40_001, 123_458, 250_003])
    for k in where:
        v[k:] += 8.0 * np.diff(v[:1000]).std()
    plain = choose_samples(v, rate)[0]
    kept = events_between(v, None, rate, plain)
    assert {*where, *(where - 1)} <= {*kept, *range(0, n, plain.step)}
    assert kept.size <= 3 * where.size
    u = np.where(np.arange(n) < where[1], 0.2, 0.6)
    assert not {where[1] - 1, where[1]} & {*events_between(v, u, rate, plain)}
    found = examined(t, v)
    assert found.samples.n == v[plain].size + kept.size
    assert (np.diff(found.samples.t) > 0.0).all()
    assert not events_between(rail(14, n, rate)[1], None, rate, plain).size


@pytest.mark.parametrize('times, named', [(0.25, False), (0.297, False), (0.303, True),
                                          (1.0, True), (2.0, True)])
def test_a_step_is_held_against_the_noise_without_its_own_rounding(times, named):
    """Rounding adds step^2 / 12 to a sample, so step^2 / 6 to the square of an innovation."""
    # A noise of 1 mV that was rounded is 1 mV again: steps count from 0.3 mV on.
    exact, notes = [], []
    _judge_step(1e-3 * times, 1e-3 * math.sqrt(1.0 + times**2 / 6.0), exact, notes)
    assert [term.NAME for term in exact] == ['quantization'] * named
