"""`analyze` on recordings with known truth: numbers, process types, risk, spectrum, JSON."""

from dataclasses import replace
import math
import re

import numpy as np
from ou_monitor.analysis.analyze import analyze, as_data, slide
from ou_monitor.analysis.level_result import (
    classify, detectable_kurtosis, level_spectrum, ou_spectrum, ProcessType)
from ou_monitor.analysis.level_tests import EFFECT, examine_level, Shape, TestResult
from ou_monitor.analysis.supply import supply_facts
from ou_monitor.model.ou import simulate
from ou_monitor.online.estimator.estimator import SlidingEstimator
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Estimate, plain_data, Recording, Status
from ou_monitor.report.analysis_document import answer
from project import ROOT
import pytest
from scipy import stats
from scipy.signal import lfilter
from simulated_recordings import ALPHA, recording, without_throttle

TRUTH = ((0.1, 0.3156), (0.4, 0.632))


def test_amplitudes_are_those_of_the_samples():
    """Vpp, peak and Vrms of an exact triangle, apart from its offset."""
    t = np.arange(4000) / 1000.0
    wave = 2.0 * np.abs((np.arange(4000) % 100) / 50.0 - 1.0) - 1.0
    simulated = Recording(t, 5.0 + 0.01 * wave, np.full(t.size, 0.2))
    (level,) = analyze(simulated).levels
    assert level.vpp == pytest.approx(0.02)
    assert level.peak == pytest.approx(0.01)
    assert level.vrms == pytest.approx(float(0.01 * wave.std()))
    assert (level.n, level.time) == (4000, pytest.approx(3.999))


def test_a_level_in_two_pieces_is_one_process():
    """A sag between the pieces moves neither Var_inf nor Vrms: each has its own mean."""
    simulated = recording(4, ((0.1, 0.3), (0.4, 0.3), (0.1, 0.3)), seconds=5.0)
    voltage = simulated.voltage - 0.5 * (simulated.t > 10.0)
    low = analyze(Recording(simulated.t, voltage, simulated.throttle)).levels[0]
    var_inf = 0.3 ** 2 / (2.0 * ALPHA)
    assert len(low.segments) == 2
    # T = 10 s in all; the offset would make Vrms 0.25 V instead of 27 mV.
    assert abs(math.log(low.estimate.var_inf / var_inf)) < 4.0 * math.sqrt(2.0 / (ALPHA * 10.0))
    assert low.vrms == pytest.approx(math.sqrt(var_inf), rel=0.15)


def test_the_transient_after_a_step_is_not_noise():
    """An exponential of 0.5 V after each step of throttle leaves Var_inf alone."""
    simulated = recording(5, TRUTH, seconds=5.0)
    since = simulated.t - 5.0
    wave = np.where(since >= 0.0, 0.5 * np.exp(-ALPHA * np.maximum(since, 0.0)), 0.0)
    var_inf = TRUTH[1][1] ** 2 / (2.0 * ALPHA)
    high = analyze(Recording(simulated.t, simulated.voltage + wave, simulated.throttle)).levels[1]
    # Unsettled it would add 0.25 V^2 tau / (2 T) = 4e-4 V^2, 12 % of Var_inf,
    # and an offset of the peak of 0.5 V, nine standard deviations.
    assert high.peak < 5.0 * math.sqrt(var_inf)


@pytest.mark.parametrize('tau', [0.016, 0.1, 0.2])
def test_a_sag_that_settles_is_not_noise(tau):
    """1 V times throttle follows with tau in stays of 2.5 s: alpha and sigma hold."""
    t = np.arange(15000) / 1000.0
    throttle = np.where(np.floor(t / 2.5) % 2 == 0, 0.2, 0.5)
    phi = math.exp(-1e-3 / tau)
    sag = lfilter([1.0 - phi], [1.0, -phi], throttle, zi=[phi * throttle[0]])[0]
    rng = np.random.default_rng(1)
    noise = simulate(t, ALPHA, 0.1 + 0.2 * throttle, rng) + rng.normal(0.0, 0.002, t.size)
    levels = analyze(Recording(t, 5.0 - sag + noise, throttle)).levels
    for level, sigma in zip(levels, (0.14, 0.2)):
        for name, truth in (('alpha', ALPHA), ('sigma', sigma)):
            low, high = level.estimate.interval(name, 4.0)
            assert low < truth < high


def test_a_swaying_stick_is_not_noise():
    """0.5 V at full throttle and a sway of 1 %: 3.5 mV rms that are the load's."""
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 200.0
    throttle = np.where(t < 10.0, 0.2, 0.5) + 0.01 * np.sin(2.0 * np.pi * 1.7 * t)
    voltage = 5.0 - 0.5 * throttle + rng.normal(0.0, 0.002, t.size)
    for level in analyze(Recording(t, voltage, throttle)).levels:
        assert level.vrms > 0.0036 and level.estimate.status is Status.NO_RELAXATION
        assert math.sqrt(level.ou.var_inf_below) < 0.002


@pytest.mark.parametrize('sway, found', [(3.7, []), (9.1, [3.7])])
def test_a_line_that_throttle_has_too_is_the_loads(sway, found):
    """Its size changes, so the response to throttle does not remove it."""
    rng = np.random.default_rng(1)
    t = np.arange(4000) / 200.0
    throttle = 0.3 + 0.01 * np.sin(2.0 * np.pi * sway * t)
    wave = np.where(t > 14.0, 0.02, 0.004) * np.sin(2.0 * np.pi * 3.7 * t + 0.5)
    voltage = 5.0 - 0.5 * throttle - wave + rng.normal(0.0, 0.004, t.size)
    (level,) = analyze(Recording(t, voltage, throttle)).levels
    assert [line.frequency for line in level.lines.lines] == pytest.approx(found, abs=0.02)


def test_wild_readings_are_left_out_of_estimates_and_counted():
    """2.5 V below a rail of 12 V, some at high throttle: noise, sigma and alpha do not move."""
    rng = np.random.default_rng(5)
    t = np.arange(8000) / 100.0
    throttle = np.where(t % 10.0 < 8.0, 0.2, 0.7)
    plain = simulate(t, 10.0, 0.05, rng, u0=12.0) - 0.8 * throttle
    plain += rng.normal(0.0, 0.005, t.size)
    before = analyze(Recording(t, plain, throttle))
    assert before.recording.n == t.size
    old = before.overview.facts
    for count in (2, 30):
        wild = plain.copy()
        wild[rng.choice(np.flatnonzero(t % 10.0 > 8.5), count, replace=False)] -= 2.5
        after = analyze(Recording(t, wild, throttle))
        for one, other in zip(before.levels, after.levels):
            assert other.vrms == pytest.approx(one.vrms, rel=0.03)
            assert other.shape['impulses'].rejects == one.shape['impulses'].rejects
        new = after.overview.facts
        assert new.noise.rms_v == pytest.approx(old.noise.rms_v, rel=0.03)
        assert new.ou.sigma == pytest.approx(old.ou.sigma, rel=0.03)
        assert new.lowest.voltage_v == wild.min() and after.recording.n == t.size - count
        assert any(f'{count} bad samples left out' in item.text for item in after.quality)


def test_loads_that_come_and_go_are_no_lines():
    """10 A at 1.8 Hz through 0.1 Ohm, measured 50 ms late, at a throttle that stands still."""
    rng = np.random.default_rng(3)
    t = np.arange(8000) / 200.0
    drawn = np.where((1.8 * t) % 1.0 < 0.3, 10.0, 2.0)
    late = np.concatenate((np.full(10, drawn[0]), drawn[:-10]))
    v = 12.0 - 0.1 * drawn + 0.02 * rng.standard_normal(t.size)
    found = analyze(Recording(t, v, np.full(t.size, 0.5), 'made', current=late))
    assert [line for level in found.levels for line in level.lines.lines] == []


def test_a_slow_relaxation_at_levels_too_short_to_fit_is_no_line():
    """An OU of 10 1/s in white noise, in segments of 3 s: only all levels together show it."""
    rng = np.random.default_rng(3)
    t = np.arange(12000) / 200.0
    throttle = np.repeat(np.resize((0.1, 0.3, 0.5, 0.2, 0.4, 0.6), 20), 600)
    v = simulate(t, 10.0, 0.08, rng, u0=15.0) - throttle + 0.01 * rng.standard_normal(t.size)
    found = analyze(Recording(t, v, throttle)).levels
    assert any(not level.estimate.usable for level in found)
    assert [line for level in found for line in level.lines.lines] == []


def test_without_throttle_there_is_one_level_and_it_is_said():
    analysis = analyze(without_throttle(recording(6, ((0.1, 0.3),))))
    assert [level.label for level in analysis.levels] == ['all']
    assert analysis.levels[0].estimate.status is Status.OK
    assert any('no throttle' in note for note in analysis.notes)


def test_too_short_is_said_and_not_invented():
    """A voltage that only drifts never returns: a status, and NaN for the numbers."""
    t = np.arange(500) / 1000.0
    drift = 5.0 + 0.2 * t + np.random.default_rng(7).normal(0.0, 1e-6, t.size).cumsum()
    (level,) = analyze(Recording(t, drift, np.full(t.size, 0.1))).levels
    assert level.estimate.status in (Status.TOO_SHORT, Status.UNBOUND)
    assert math.isnan(level.estimate.alpha)
    assert level.kind is ProcessType.UNDETERMINED
    assert level.vpp == pytest.approx(0.1, rel=0.01)


def test_a_stuck_sensor_is_said():
    """A constant voltage is 'constant', with amplitudes of zero."""
    t = np.arange(2000) / 1000.0
    (level,) = analyze(Recording(t, np.full(2000, 5.0), np.full(2000, 0.1))).levels
    assert level.estimate.status is Status.CONSTANT and level.kind is ProcessType.CONSTANT
    assert (level.vpp, level.vrms) == (0.0, 0.0) and math.isnan(level.crest)


def test_white_noise_is_no_diffusion():
    """Uncorrelated samples: no relaxation, or one faster than the sampling."""
    t = np.arange(4000) / 1000.0
    noise = np.random.default_rng(8).normal(0.0, 0.01, t.size)
    (level,) = analyze(Recording(t, 5.0 + noise, np.full(t.size, 0.1))).levels
    assert level.kind is ProcessType.GAUSSIAN


def test_impulses_are_called_so():
    """Steps of 0.2 V, 5 a second, that relax: heavy tails of the increments."""
    simulated = recording(9, ((0.1, 0.3),), seconds=20.0)
    kicks = np.zeros(simulated.n)
    kicks[::200] = 0.2
    relaxing = np.zeros(simulated.n)
    phi = math.exp(-ALPHA / 1000.0)
    for k in range(1, simulated.n):
        relaxing[k] = phi * relaxing[k - 1] + kicks[k]
    voltage = simulated.voltage + relaxing
    (level,) = analyze(Recording(simulated.t, voltage, simulated.throttle)).levels
    assert level.kind is ProcessType.IMPULSES


def test_a_level_that_was_never_flown_stays_in_the_table():
    levels = analyze(recording(10, TRUTH), levels=(0.1, 0.9)).levels
    assert levels[1].n == 0 and math.isnan(levels[1].vrms)
    assert levels[1].estimate.status is Status.TOO_FEW_SAMPLES


def test_time_between_levels_is_accounted_for():
    simulated = recording(11, TRUTH)
    ramp = simulated.throttle.copy()
    ramp[8000:12000] = np.linspace(0.1, 0.4, 4000)
    notes = analyze(Recording(simulated.t, simulated.voltage, ramp)).notes
    assert any('between load levels' in note for note in notes)


def test_a_reading_a_second_counts_a_second():
    """Sixty readings at two throttles, of which none lies between the levels."""
    rng = np.random.default_rng(2)
    u = np.repeat((0.2, 0.6) * 5, 6)
    found = analyze(Recording(np.arange(60.0), 12.0 - u + 0.01 * rng.standard_normal(60), u),
                    levels=(0.2, 0.6))
    assert not any('between load levels' in note for note in found.notes)


def test_sliding_is_what_the_node_would_say():
    """The last point equals the estimator fed with every sample."""
    simulated = recording(12, TRUTH)
    sliding = slide(simulated, window=2.0)
    node = SlidingEstimator(window=2.0)
    upto = simulated.t <= sliding.t[-1]
    node.push(simulated.t[upto], simulated.voltage[upto], simulated.throttle[upto])
    # A search started from the estimate before ends within its tolerance of this one.
    assert sliding.series('sigma')[-1] == pytest.approx(node.estimate().sigma, rel=1e-4)
    assert np.all(np.diff(sliding.t) > 0.0) and sliding.t[0] >= 1.9
    assert np.isnan(sliding.risk).all()


def test_the_node_takes_each_reading_once(monkeypatch):
    """Its reports along the recording and the facts at the end are of one run."""
    taken, push = [], SupplyMonitor.push
    monkeypatch.setattr(SupplyMonitor, 'push', lambda self, t, *rest, **more: (
        taken.append(np.size(t)), push(self, t, *rest, **more))[1])
    simulated = recording(12, TRUTH, seconds=4.0)
    found = analyze(simulated, brownout_voltage=4.0)
    assert sum(taken) == simulated.n
    assert found.overview.facts.to_dict() == supply_facts(simulated, 4.0).to_dict()


def test_progress_ends_at_one():
    shares = []
    analyze(recording(14, TRUTH, seconds=4.0), progress=shares.append)
    assert shares == sorted(shares) and shares[-1] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize('options', [{'window': 0.0}, {'window': math.nan},
                                     {'brownout_horizon': -1.0}, {'levels': (2.0,)}])
def test_options_out_of_range_raise_value_error(options):
    with pytest.raises(ValueError):
        analyze(recording(15, TRUTH, seconds=0.5), **options)


@pytest.mark.parametrize('n', [0, 1, 2, 3, 15])
def test_tiny_recordings_end_in_a_status(n):
    """Nothing raises, nothing is invented."""
    t = np.arange(n) / 100.0
    simulated = Recording(t, 5.0 + 0.01 * np.sin(np.arange(n)), np.full(n, 0.1))
    for candidate in (simulated, without_throttle(simulated)):
        for level in analyze(candidate).levels:
            assert not level.estimate.usable


def swept(seed, seconds=60.0, rate=500.0):
    """Return a flight whose throttle never stands still: 0.2 to 0.7 in 6 s and back."""
    t = np.arange(int(seconds * rate)) / rate
    throttle = 0.45 + 0.25 * np.sin(2.0 * math.pi * t / 12.0)
    voltage = simulate(t, ALPHA, 0.1 + throttle, np.random.default_rng(seed),
                       u0=5.0 - 0.4 * throttle)
    return Recording(t, voltage, throttle, 'swept')


def test_throttle_that_only_passes_is_known():
    """Sag within 4 standard errors, noise within 15 %, where flown; the risk up to there."""
    analysis = analyze(swept(1), brownout_voltage=4.5)
    found, facts = analysis.by_throttle, analysis.overview.facts
    at, inside = found.throttle, found.known
    assert at[inside] == pytest.approx([0.2, 0.3, 0.4, 0.5, 0.6, 0.7])
    error = np.array(facts.sag.se_v)
    assert (np.abs(np.array(facts.sag.sag_v) - 0.4 * at) < 4.0 * error)[inside].all()
    truth = (0.1 + at[inside]) / math.sqrt(2.0 * ALPHA)
    assert np.array(facts.noise.rms_v)[inside] == pytest.approx(truth, rel=0.15)
    assert np.isfinite(found.risk[at <= 0.7]).all() and np.isnan(found.risk[at > 0.81]).all()


def test_without_a_fit_the_budget_says_why():
    """A recording too short for any window, and one that never changes."""
    short = analyze(recording(2, ((0.1, 0.3),), seconds=0.02)).by_throttle
    assert math.isnan(short.budget) and short.budget_reason
    t = np.arange(3000) / 500.0
    stuck = analyze(Recording(t, np.full(t.size, 5.0), np.full(t.size, 0.1))).by_throttle
    assert math.isnan(stuck.budget) and 'sensor is stuck' in stuck.budget_reason


def test_without_throttle_the_budget_is_unknown():
    """Even where the recording ends below the limit."""
    low = swept(4, seconds=20.0)
    low = Recording(low.t, low.voltage, np.full(low.n, math.nan), current=20.0 * low.throttle)
    found = analyze(low, brownout_voltage=float(low.voltage[-1]) + 0.1)
    assert math.isnan(found.by_throttle.budget)
    assert math.isnan(found.overview.facts.budget.throttle)
    assert 'no throttle keeps' not in ' '.join(answer(found)).lower()


def test_the_voltage_is_the_nodes_unless_asked_for():
    """4.5 V by default; NaN switches the risk off."""
    simulated = recording(3, ((0.1, 0.3), (0.4, 0.5)), seconds=4.0)
    default = analyze(simulated)
    assert default.by_throttle.voltage == MonitorSettings().brownout_voltage
    assert default.brownout_default
    assert not analyze(simulated, brownout_voltage=4.5).brownout_default
    none = analyze(simulated, brownout_voltage=math.nan)
    assert np.isnan(none.by_throttle.risk).all() and math.isnan(none.by_throttle.budget)


def test_the_curve_holds_the_whole_variance():
    """Its integral to the Nyquist frequency is Var_inf plus the noise, aliases folded in."""
    frequency = (np.arange(200000) + 0.5) * 500.0 / 200000
    density = ou_spectrum(frequency, ALPHA, 0.3, 1000.0, noise_std=0.02)
    total = density.sum() * 500.0 / 200000
    assert total == pytest.approx(0.3 ** 2 / (2 * ALPHA) + 0.02 ** 2, rel=1e-6)


def test_measured_and_true_spectrum_agree():
    # About 40 points a decade over two decades; each averages >= 8 pieces (relative error below
    # 1/sqrt(8) = 35 %), and most points average several bins; the mean of 60 or more is known to
    # 35 % / sqrt(60) = 5 %. A two-sided or badly scaled density is off by 2.
    simulated = recording(1, ((0.1, 0.3),), seconds=60.0)
    (level,) = analyze(simulated).levels
    found = level_spectrum(simulated, level.segments, level.estimate)
    frequency, density = found.frequency, found.density
    assert frequency.size >= 60 and frequency[0] > 0.0 and frequency[-1] < 500.0
    ratio = density / ou_spectrum(frequency, ALPHA, 0.3, 1000.0)
    assert ratio.mean() == pytest.approx(1.0, abs=0.2)
    # The fit itself is within its 10 % of sigma and of alpha.
    assert (density / found.fitted).mean() == pytest.approx(1.0, abs=0.2)


def test_short_segments_give_nothing():
    """Fewer than 32 samples: empty arrays."""
    simulated = recording(2, ((0.1, 0.3),), seconds=0.02)
    (level,) = analyze(simulated).levels
    assert level_spectrum(simulated, level.segments, level.estimate).frequency.size == 0


def test_unknown_noise_counts_as_none():
    frequency = np.array([1.0])
    assert ou_spectrum(frequency, 63.0, 0.3, 1e3, np.nan) == ou_spectrum(
        frequency, 63.0, 0.3, 1e3)


USABLE = Estimate(alpha=63.0, sigma=0.3, var_inf=7e-4, u0=5.0, alpha_se=0.1, sigma_se=0.1,
                  var_inf_se=0.1, noise_std=0.0, status=Status.OK, n=10000, duration=10.0,
                  rate=1000.0)
WHITE = Estimate(status=Status.NO_RELAXATION, rate=1000.0)


def shape(*rejecting, n=10000, undone=()):
    """Return tests of which those named reject, or could not be done."""
    tests = []
    for name in EFFECT:
        p = 1e-9 if name in rejecting else 0.5
        tests.append(TestResult(name, why_not='Steps of the ADC hide it.') if name in undone
                     else TestResult(name, p, 2.0, min(1.0, 10.0 * p)))
    return Shape(tuple(tests), n, 0.1, 2.0, 7, (0.7, 0.3, 1.4))


@pytest.mark.parametrize('estimate, tests, kind', [
    (USABLE, shape('correlated'), ProcessType.DIFFUSION),
    (USABLE, shape('correlated', 'impulses', 'gaussian'), ProcessType.IMPULSES),
    (USABLE, shape('correlated', 'gaussian'), ProcessType.NOT_GAUSSIAN),
    (USABLE, shape('correlated', 'one_relaxation'), ProcessType.STATIONARY),
    (USABLE, shape('correlated', 'mean_drift', 'impulses'), ProcessType.QUASI_STATIONARY),
    (USABLE, shape('correlated', 'variance_drift'), ProcessType.QUASI_STATIONARY),
    (USABLE, shape('correlated', undone=('impulses', 'gaussian')), ProcessType.UNDETERMINED),
    (USABLE, shape('correlated', n=300), ProcessType.UNDETERMINED),
    (USABLE, shape(), ProcessType.GAUSSIAN),
    (replace(USABLE, alpha=2000.0), shape('correlated'), ProcessType.GAUSSIAN),
    (replace(USABLE, noise_std=0.03), shape('correlated'), ProcessType.GAUSSIAN),
    (replace(USABLE, noise_std=0.02), shape('correlated'), ProcessType.DIFFUSION),
    (WHITE, shape(), ProcessType.GAUSSIAN),
    (WHITE, shape('correlated'), ProcessType.STATIONARY),
    (WHITE, examine_level([], WHITE), ProcessType.UNDETERMINED),
    (Estimate(status=Status.CONSTANT), shape(), ProcessType.CONSTANT),
    (Estimate(status=Status.TOO_SHORT), shape('correlated'), ProcessType.UNDETERMINED),
])
def test_each_kind_has_its_reason(estimate, tests, kind):
    """The first rule that applies decides, and says why."""
    found = classify(estimate, tests)
    assert found.kind is kind
    assert found.sentence.endswith('.') and not found.sentence.endswith('..')


def test_a_changing_level_keeps_its_process_type():
    assert classify(USABLE, shape('correlated', 'mean_drift')).within is ProcessType.DIFFUSION
    assert classify(USABLE, shape('mean_drift', 'impulses')).within is ProcessType.IMPULSES


def test_lines_that_carry_most_of_the_variance_are_no_relaxation():
    assert classify(USABLE, shape('correlated'), 0.6).kind is ProcessType.STATIONARY
    assert classify(USABLE, shape('correlated'), 0.4).kind is ProcessType.DIFFUSION


def test_a_rejection_without_consequence_does_not_count():
    """An effect of 0.01 with p = 1e-9 is none."""
    small = replace(shape('correlated'), tests=tuple(
        replace(test, p_adjusted=1e-9, effect=0.01) if test.name == 'variance_drift' else test
        for test in shape('correlated').tests))
    assert classify(USABLE, small).kind is ProcessType.DIFFUSION


def test_visible_kurtosis_is_what_the_test_sees():
    assert detectable_kurtosis(0) == math.inf
    n = next(n for n in range(50, 2000) if detectable_kurtosis(n) < 1.0)
    assert n == pytest.approx(24.0 * (stats.norm.isf(0.005) + stats.norm.isf(0.1)) ** 2, abs=2)


@pytest.fixture(scope='module')
def analysis():
    return analyze(recording(6, ((0.1, 0.3156), (0.4, 0.632))))


def test_data_has_the_values_of_the_levels(analysis):
    """The tau interval is that of alpha, turned over."""
    data = as_data(analysis)
    assert (data['n'], data['duration_s']) == (20000, pytest.approx(19.999))
    assert data['rate_hz'] == pytest.approx(1000.0)
    for level, found in zip(data['levels'], analysis.levels):
        assert level['alpha'] == found.estimate.alpha
        assert level['tau'] == pytest.approx(1.0 / level['alpha'])
        assert level['tau_ci95'][0] == pytest.approx(1.0 / level['alpha_ci95'][1])
        assert level['alpha_ci95'][1] / level['alpha'] == pytest.approx(
            math.exp(1.96 * level['alpha_se']), rel=1e-4)
        assert level['var_inf'] == pytest.approx(level['sigma'] ** 2 / (2 * level['alpha']))
        assert len({len(level['psd'][name]) for name in level['psd']}) == 1
    lengths = {len(data['sliding'][name]) for name in ('t', 'alpha', 'sigma', 'status')}
    assert len(lengths) == 1 and lengths.pop() > 10


def test_times_count_from_the_first_sample(analysis):
    """As in `supply`, of a log whose stamps are dates."""
    dated = replace(analysis.recording, t=analysis.recording.t + 1.7e9)
    found, wanted = (as_data(analyze(one)) for one in (dated, analysis.recording))
    assert 19.0 < found['brownout']['t'] < 20.0
    assert found['brownout']['t'] == pytest.approx(wanted['brownout']['t'], abs=1e-3)
    assert found['sliding']['t'] == pytest.approx(wanted['sliding']['t'], abs=1e-3)


def names(value):
    """Yield every key of nested data."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield key
            yield from names(item)
    elif isinstance(value, list):
        for item in value:
            yield from names(item)


def test_every_key_is_documented(analysis):
    text = (ROOT / 'doc' / 'analysis.md').read_text(encoding='utf-8')
    documented = set(re.findall(r'`([a-z0-9_]+)`', text))
    data = plain_data(as_data(analyze(read_recording(ROOT / 'bags' / 'transient'))))
    data['source'] = {}
    assert sorted(set(names(data)) - documented) == []
