"""The facts of a supply that all commands share, in numbers and words."""

from dataclasses import replace
import json
import math
import re
from types import SimpleNamespace

import numpy as np
from ou_monitor import read_recording, Recording, supply_facts
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.noise import noise_of
from ou_monitor.analysis.overview import answers, determined, known_lines, overview
from ou_monitor.analysis.supply import alarms, node_for
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.online.settings import MonitorSettings
from ou_monitor.report.analysis_document import answer
from ou_monitor.timeline import supplied
from project import ROOT
import pytest
from simulated_packs import flown

RATE = 200.0


def flight(rng, rising=0.02, seconds=30.0):
    """Return a recording: throttle in steps, sag, noise of 10 mV and `rising` per throttle, V."""
    t = np.arange(int(seconds * RATE)) / RATE
    u = np.repeat(rng.uniform(0.1, 0.9, int(seconds / 1.5) + 1), int(1.5 * RATE))[:t.size]
    noise = (0.01 + rising * u) * rng.standard_normal(t.size)
    return Recording(t, 16.0 - 1.5 * u ** 1.8 + noise, u)


@pytest.mark.parametrize('limit', [9.9, 19.8, 13.2, 14.1, 4.7])
def test_a_reading_at_the_limit_is_no_dip_in_a_message_either(limit):
    v = np.tile([limit + 1.0, limit], 200)
    for volts in (v, v.astype(np.float32)):
        assert supply_facts(Recording(np.arange(400) / 100.0, volts), limit).dips.count == 0
    assert supply_facts(Recording(np.arange(400) / 100.0, v - 1e-5), limit).dips.count > 0


def test_dips_are_runs():
    v = np.full(2000, 12.0)
    v[500:510] = 9.0
    # Above the limit by less than a step of the ADC (1 V): the same dip.
    v[505] = 10.0
    v[700], v[900] = 9.0, 8.0
    found = supply_facts(Recording(np.arange(2000) / 100.0, v, np.full(2000, np.nan)), 9.5)
    # Readings at the limit are not below it.
    assert (found.dips.count, found.dips.limit_v) == (3, 9.5)
    assert (found.dips.seconds, found.dips.longest_s) == pytest.approx((0.11, 0.09))
    assert (found.lowest.voltage_v, found.lowest.time_s) == (8.0, 9.0)
    assert (found.dips.first_s, found.dips.brief) == (5.0, 3)
    # The deepest first, at the throttle of its lowest reading; of equal ones the first.
    u = np.arange(2000) / 2000.0
    listed = supply_facts(Recording(np.arange(2000) / 100.0, v, u), 9.5).dips.deepest
    assert [(one.begin_s, one.lowest_v, one.throttle) for one in listed] == [
        (9.0, 8.0, 0.45), (5.0, 9.0, 0.25), (7.0, 9.0, 0.35)]
    assert [one.seconds for one in listed] == pytest.approx([0.01, 0.09, 0.01])
    v[::20] = 9.0
    assert len(supply_facts(Recording(np.arange(2000) / 100.0, v, u), 9.5).dips.deepest) == 10


def test_usual_alarms_of_a_pack():
    """Two dips of 0.5 s and 2 s from 16 V, in V per cell; none if the cells are unknown."""
    v = np.full(2000, 16.0)
    v[500:550], v[900:1100] = 14.3, 13.9
    recording = Recording(np.arange(2000) / 100.0, v, np.full(2000, np.nan))
    found = alarms(recording, 4, noise_of(recording))
    assert [one.limit_v for one in found] == pytest.approx([14.8, 14.4, 14.0, 13.6, 13.2])
    assert [(one.count, one.brief) for one in found] == [(2, 1), (2, 1), (1, 0), (0, 0), (0, 0)]
    assert [one.first_s for one in found[:3]] == pytest.approx([5.0, 5.0, 9.0])
    assert [one.seconds for one in found[:3]] == pytest.approx([2.5, 2.5, 2.0])
    assert alarms(recording, 0, noise_of(recording)) == ()


@pytest.mark.parametrize('begin, end', [(0, 100), (2000, 2400), (5900, 6000)])
def test_a_supply_that_is_off_counts_within_the_recording_for_lowest_and_dips_only(begin, end):
    """Switched on late, a pack changed, a plug pulled: the rest is as without these readings."""
    whole = flight(np.random.default_rng(4))
    v = whole.voltage.copy()
    v[begin:end] = 0.01 * np.random.default_rng(5).integers(0, 3, end - begin)
    others = np.delete(np.arange(v.size), np.arange(begin, end))
    off, on = (supply_facts(one, 13.0) for one in (
        replace(whole, voltage=v),
        Recording(whole.t[others], whole.voltage[others], whole.throttle[others])))
    if 0 < begin and end < v.size:
        assert off.lowest.voltage_v == 0.0 and off.dips.count == 1
        assert off.dips.seconds == pytest.approx((end - begin) / RATE)
    else:
        assert off.lowest.voltage_v == on.lowest.voltage_v and replace(
            off.dips, first_s=0.0) == replace(on.dips, first_s=0.0)
        lowest = whole.t[whole.voltage == off.lowest.voltage_v][0]
        assert off.lowest.time_s == pytest.approx(lowest)
    assert repr((off.noise, off.sag, off.ou)) == repr((on.noise, on.sag, on.ou))
    found = analyze(replace(whole, voltage=v), brownout_voltage=13.0)
    assert found.recording.n == others.size and repr(found.overview.facts) == repr(off)


@pytest.mark.parametrize('value, size, left_out', [
    (-3.0, 1, True), (0.0, 1, True), (0.0, 2, False), (-3.0, 12, False)])
def test_a_single_impossible_reading_is_unknown_and_a_brownout_is_not(value, size, left_out):
    whole = flight(np.random.default_rng(4))
    v = whole.voltage.copy()
    v[2000:2000 + size] = value
    found = analyze(replace(whole, voltage=v), brownout_voltage=13.0)
    facts, others = found.overview.facts, np.delete(np.arange(v.size), 2000)
    assert any(f'1 sample left out: {value:g} V' in note for note in found.notes) == left_out
    if left_out:
        assert repr(facts) == repr(supply_facts(
            Recording(whole.t[others], whole.voltage[others], whole.throttle[others]), 13.0))
    else:
        assert facts.lowest.voltage_v == value and facts.dips.seconds > 0.99 * size / RATE


def test_error_codes_change_no_fact():
    whole = flight(np.random.default_rng(4))
    v = whole.voltage.copy()
    v[[700, 701, 3000]] = 65535.0
    others = np.delete(np.arange(v.size), [700, 701, 3000])
    assert repr(supply_facts(replace(whole, voltage=v), 13.0)) == repr(supply_facts(
        Recording(whole.t[others], whole.voltage[others], whole.throttle[others]), 13.0))


@pytest.mark.parametrize('v', [
    np.tile([0.0, 12.0], 500).repeat(10), np.random.default_rng(6).standard_normal(10_000),
    np.linspace(0.0, 12.0, 10_000)], ids=['switched', 'ac_coupled', 'ramp'])
def test_a_signal_about_zero_is_no_supply_that_was_off(v):
    whole = Recording(np.arange(v.size) / RATE, v, np.full(v.size, np.nan))
    assert supplied(whole) is whole


def test_noise_is_of_its_throttle():
    """Within 15 % of the truth at each throttle flown, steady or not; beyond as at the edge."""
    # A band holds a step of throttle of 300 readings or more: its rms has an error of 4 %, and the
    # noise changes by 7 % across it.
    found = supply_facts(flight(np.random.default_rng(4))).noise
    for u, rms, steady in zip(found.throttle, found.rms_v, found.steady_rms_v):
        truth = 0.01 + 0.02 * np.clip(u, *found.flown)
        assert rms == pytest.approx(truth, rel=0.15)
        assert steady == pytest.approx(truth, rel=0.15) or math.isnan(steady) and not (
            found.flown[0] < u < found.flown[1])


def test_noise_is_measured_where_throttle_was_flown_and_only_there():
    """At 90 % for 0.8 s of 100 s, which is less than 1 %; the 0.2 s at 100 % are too short."""
    rng = np.random.default_rng(6)
    t = np.arange(20_000) / RATE
    u = np.where(rng.random(40) < 0.5, 0.2, 0.6).repeat(500)
    u[10_000:10_160], u[15_000:15_040] = 0.9, 1.0
    spread = np.where(u > 0.95, 0.3, np.where(u > 0.8, 0.1, 0.02))
    recording = Recording(t, 16.0 - 1.5 * u + spread * rng.standard_normal(t.size), u)
    seen = overview(recording)
    found = seen.facts.noise.rms_v
    assert seen.flown == (2, 9) and seen.noise[1] == (0.9, found[9])
    # 160 readings have an error of 6 %; the regression takes some of them.
    assert found[9] == pytest.approx(0.1, rel=0.25) and found[10] == found[9]


def test_a_log_of_1_hz_has_noise():
    """Five minutes of readings a second apart: the white noise beside level and load."""
    rng = np.random.default_rng(3)
    t = np.arange(300.0)
    u = np.clip(0.45 + 0.1 * rng.standard_normal(t.size), 0.0, 1.0)
    v = 16.0 - 0.002 * t - 1.2 * u ** 1.8 + 0.02 * rng.standard_normal(t.size)
    found = supply_facts(Recording(t, v, u)).noise
    # Of 300 readings some 80 go into level and load.
    assert found.rms_v[4] == pytest.approx(0.02, rel=3.0 / np.sqrt(2.0 * 220.0) + 0.05)


def test_sag_and_resistance_are_those_of_the_filter():
    recording = flight(np.random.default_rng(5))
    found, limited = supply_facts(recording), supply_facts(recording, 14.5)
    load = LoadFilter()
    load.push(recording.t, recording.voltage, recording.throttle)
    assert found.sag.known and found.sag.throttle[-1] == 1.0
    assert found.sag.sag_v == tuple(load.load().sag(found.sag.throttle).tolist())
    assert found.sag.sag_v[9] == pytest.approx(1.5 * 0.9 ** 1.8, rel=0.1)
    assert limited.sag.sag_v == pytest.approx(found.sag.sag_v)
    assert np.isnan(found.resistance.ohm)
    assert found.dips is None and found.budget is None
    assert 0.0 <= limited.budget.throttle <= 1.0 and limited.budget.limit_v == 14.5


def test_the_object_is_strict_json():
    """The keys of the contract; what is unknown is null, also of nothing and of one reading."""
    whole = Recording(np.zeros(0), np.zeros(0), np.zeros(0))
    one = Recording(np.zeros(1), np.full(1, 5.0), np.full(1, np.nan))
    still = Recording(np.arange(500) / 100.0, np.full(500, 5.0), np.full(500, 0.5))
    for recording, status in ((whole, 'no_data'), (one, 'too_short'), (still, 'not_visible')):
        found = supply_facts(recording, 4.5).to_dict()
        json.dumps(found, allow_nan=False)
        assert list(found) == ['lowest', 'dips', 'sag', 'noise', 'resistance', 'ou', 'budget']
        assert found['ou']['status'] == status and found['ou']['alpha'] is None
    assert found['noise']['rms_v'] == pytest.approx([0.0] * 11, abs=1e-9)
    with pytest.raises(ValueError, match='finite'):
        supply_facts(still, np.nan)


def test_windows_grow_until_the_relaxation_is_known():
    """The same rail under more white noise needs a longer window."""
    rng = np.random.default_rng(6)
    recording = flight(rng, rising=0.0)
    phi = np.exp(-60.0 / RATE)
    x = np.zeros(recording.n)
    for k in range(1, x.size):
        x[k] = phi * x[k - 1] + 0.03 * np.sqrt(1.0 - phi * phi) * rng.standard_normal()
    loud = replace(recording, voltage=recording.voltage + x)
    first = supply_facts(loud).ou
    noisy = replace(loud, voltage=loud.voltage + 0.04 * rng.standard_normal(x.size))
    second = supply_facts(noisy).ou
    assert (first.status, second.status) == ('ok', 'ok')
    assert first.window_s == 8.0 < second.window_s
    for found in (first, second):
        assert found.alpha_95[0] < 60.0 < found.alpha_95[1]


@pytest.mark.parametrize('name, status', [
    ('recorded/micromouse', 'not_visible'), ('flight', 'ok')])
def test_shipped_recordings_have_their_known_facts(name, status):
    """What is known of them; of the flight the relaxation at hover is 63 1/s by its truth."""
    found = supply_facts(read_recording(ROOT / 'bags' / name)).ou
    assert found.status == status


def test_a_long_recording_is_looked_at_no_more_often_than_15_minutes(monkeypatch):
    """Once every 0.8 s of an hour, as every 0.2 s of a flight."""
    looks = []
    monkeypatch.setattr(LoadFilter, 'known', property(lambda self: looks.append(1) is None))
    t = np.arange(500) / 50.0
    for seconds, wanted in ((600.0, 50), (3600.0, 12.5)):
        ends = np.array([0.0, seconds])
        looks.clear()
        monitor, _ = node_for(Recording(ends, ends, ends), MonitorSettings())
        monitor.push(t, 12.0 - t / 1e3, t / 10.0)
        assert abs(len(looks) - wanted) <= 1.5


@pytest.mark.parametrize('horizon', [1.0, 3.0, 20.0])
def test_a_replay_takes_less_time_and_has_the_same_risk(horizon):
    recording = flight(np.random.default_rng(4))
    settings = MonitorSettings(window=2.0, brownout_voltage=15.0, brownout_horizon=horizon)
    replayed, parts = node_for(recording, settings)
    node, risks, done = SupplyMonitor(settings), [], 0
    for now, _ in parts:
        part = slice(done, done := int(np.searchsorted(recording.t, now, 'right')))
        node.push(recording.t[part], recording.voltage[part], recording.throttle[part])
        shown, known = replayed.report(0.0, alone=True), node.report(0.0)
        assert shown.risk == pytest.approx(known.risk, rel=1e-9, nan_ok=True)
        assert math.isnan(shown.budget)
        assert node.load_filter.known == node.load_filter.load().known
        risks.append(known.risk)
    assert len(set(risks)) > 20 and node.load_filter.known
    assert replayed.report(0.0).risk_curve == pytest.approx(known.risk_curve, rel=1e-9)


@pytest.mark.parametrize('rate, seconds, known', [
    (20.0, 60.0, True), (10.0, 60.0, False), (200.0, 0.8, False)])
def test_a_resistance_at_once_needs_two_readings_in_its_time(rate, seconds, known):
    """And a recording that is long enough to read one later."""
    rng, n = np.random.default_rng(6), int(rate * seconds)
    drawn = np.repeat(rng.uniform(5.0, 60.0, n // 10), 10)
    facts = supply_facts(Recording(
        np.arange(n) / rate, 12.0 - 0.02 * drawn + 0.002 * rng.standard_normal(n),
        np.full(n, math.nan), current=drawn))
    assert facts.resistance.ohm == pytest.approx(0.02, rel=0.2)
    assert math.isfinite(facts.resistance.at_once_ohm) == known


HZ, SECONDS = 50.0, 80.0
SAG = 1.2


def deviation(u):
    """Return the noise, V: the ripple of an ESC is largest at 0.7."""
    return 0.015 * np.exp(u * (1.4 - u) / 0.49)


def paced(seed=3, sag=SAG, throttle=True, seconds=SECONDS):
    """Return 16 V less sag u^1.8, throttle 0.1 to 0.8 in steps of 0.5 s, and noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(HZ * seconds)) / HZ
    u = np.repeat(rng.uniform(0.1, 0.8, int(2 * seconds)), int(HZ / 2))
    noise = deviation(u) * rng.standard_normal(t.size)
    return Recording(t, 16.0 - sag * u ** 1.8 + noise,
                     u if throttle else np.full(t.size, math.nan))


def test_a_gap_after_a_low_sample_is_not_time_below():
    """A minute without samples counts as ten usual intervals at most."""
    t = np.concatenate((np.arange(50), 6000 + np.arange(50))) / 100.0
    v = np.full(100, 5.0)
    v[49] = 4.0
    dips = supply_facts(Recording(t, v, np.full(100, math.nan)), 4.5).dips
    assert (dips.count, dips.seconds) == (1, pytest.approx(0.1))


@pytest.mark.parametrize('step', [0.02, 0.2])
def test_a_current_that_throttle_does_not_tell_gives_the_fall(step):
    """Of its largest value that lasts three readings, not of one wild reading."""
    rng, n = np.random.default_rng(2), 2000
    drawn = np.repeat(rng.uniform(0.0, 60.0, n // 10), 10)
    drawn[1000] = 500.0
    v = 12.0 - 0.02 * drawn + 0.005 * rng.standard_normal(n)
    v[1000] = 12.0
    throttle = np.repeat(rng.uniform(0.0, 1.0, n // 10), 10)
    found = overview(Recording(step * np.arange(n), v, throttle, current=drawn))
    # The largest of 200 values lies below 58.5 with a chance of 0.6 %.
    assert 58.5 < found.drawn < 60.0
    ohm = found.facts.resistance.ohm
    assert ohm == pytest.approx(0.02, rel=0.1)
    assert f'lowers the rail by {ohm * found.drawn:.2f} V' in answers(found)[1]
    assert ' after 1 s' in dict(known_lines(found))['Resistance']
    assert 'no sag over throttle is measurable' in answers(found)[1]
    # A sag that the facts give as uncertain is not denied.
    seen = replace(found, facts=replace(found.facts, sag=replace(
        found.facts.sag, known=False, sag_v=(1.0,) * 11, se_v=(0.1,) * 11)))
    assert 'lowers' in answers(seen)[1] and 'no sag' not in answers(seen)[1]
    # Of either sign; a current that charges lowers nothing.
    for sign, charge in ((-1.0, 0.0), (1.0, 60.0), (-1.0, 60.0)):
        other = overview(Recording(step * np.arange(n), v + 0.02 * charge, throttle,
                                   current=sign * (drawn - charge)))
        assert other.drawn < 0.2 if charge else other.drawn == found.drawn
        assert any('lowers' in one for one in answers(other)) == (not charge)


def test_words_are_those_of_the_facts():
    """The sag within three errors of the truth; each number in words is one of `supply_facts`."""
    found, facts = overview(paced(), 15.2), supply_facts(paced(), 15.2)
    assert found.facts.to_dict() == facts.to_dict() and facts.sag.known
    at, sag, se = found.sag
    assert at == 0.8 and sag == facts.sag.sag_v[8]
    assert abs(sag - SAG * at ** 1.8) < 3.0 * se and se < 0.33 * SAG * at ** 1.8
    (low, first), (high, last) = found.noise
    # A tenth of throttle changes the noise by up to 25 %.
    assert (low, high) == (0.1, 0.8)
    assert first == pytest.approx(deviation(low), rel=0.3)
    assert last == pytest.approx(deviation(high), rel=0.15)
    words = dict(known_lines(found))
    assert words['Noise'].endswith('it grows with throttle')
    assert f'{1e3 * last:.1f} mV at 80 %' in words['Noise']
    assert words['Sag'].startswith(f'{1e3 * sag:.0f} mV')
    assert 'extrapolated to full throttle' in words['Sag']
    assert f'{facts.dips.count} dips below 15.2 V' in answers(found)[0]
    assert f'{facts.lowest.voltage_v:.2f} V' in words['Lowest voltage']


def test_a_sag_smaller_than_its_error_is_a_bound():
    """The same rule in each row; not flown: unknown unless the highest throttle flown is known."""
    found = overview(paced(seconds=20.0))
    assert found.flown == (1, 8)
    for se, at_end, beyond in ((0.1, True, True), (0.4, False, False)):
        sag = replace(found.facts.sag, sag_v=(0.5,) * 11, se_v=(0.1,) * 8 + (se,) + (0.1,) * 2)
        one = replace(found, facts=replace(found.facts, sag=sag))
        assert (determined(one, 8), determined(one, 10, flown=False)) == (at_end, beyond)
        assert determined(one, 4)


def test_no_sag_is_given_where_none_can_be():
    """None at 0 % throttle alone, and none beyond half of the voltage by extrapolation."""
    found = overview(paced(seconds=20.0))
    sag = replace(found.facts.sag, sag_v=(0.0,) * 11, se_v=(0.0,) * 11, known=False)
    idle = replace(found, flown=(0, 0), facts=replace(found.facts, sag=sag))
    assert len(answers(idle)) == 1
    assert dict(known_lines(idle))['Sag'].startswith('unknown')
    half = 0.5 * found.load.level
    for most, words in ((0.99 * half, 'V (+- 20.0 mV) extrapolated'), (1.01 * half, 'cannot be')):
        sag = replace(found.facts.sag, sag_v=(0.5,) * 10 + (most,), se_v=(0.01,) * 11, known=True)
        steep = replace(found, facts=replace(found.facts, sag=sag))
        assert words in dict(known_lines(steep))['Sag']


@pytest.mark.parametrize('last', [0.030, 0.015])
def test_one_loud_throttle_is_no_trend(last):
    """Of 16 mV at all throttles; as an end alone, 30 mV would be growth."""
    one = paced()
    high = one.throttle > 0.78
    noise = np.where(high, last, 0.016) * np.random.default_rng(5).standard_normal(one.n)
    found = overview(replace(one, voltage=16.0 - SAG * one.throttle ** 1.8 + noise))
    assert 0.8 < found.growth < 1.25
    assert dict(known_lines(found))['Noise'].endswith('without a trend over throttle')


@pytest.mark.parametrize('growth, packs, least, most', [(0.0, 20, 0, 3), (2.0, 6, 6, 6)])
def test_noise_grows_only_beyond_its_scatter(growth, packs, least, most):
    """Packs read at 10 Hz, whose steps of throttle leave more residuals at some throttles."""
    # Growth that is seen in half of the packs is seen in all 6 of them once in 64.
    said = 0
    for seed in range(packs):
        t, v, u = flown(seed, seconds=120.0, noise=0.0)
        rng = np.random.default_rng(seed + 999)
        v = v + 0.02 * (1.0 + growth * u) * rng.standard_normal(t.size)
        found = overview(Recording(t[::5], v[::5], u[::5]))
        said += 'grows with throttle' in dict(known_lines(found))['Noise']
    assert least <= said <= most


def test_rounding_is_no_relaxation_in_the_answer():
    """Of 4 packs with white noise, rounded to 0.2 V, most seem to relax, by less than 58 mV."""
    seem = 0
    for seed in range(4):
        t, v, u = flown(seed, seconds=70.0, noise=0.02)
        found = analyze(Recording(t, 0.2 * np.rint(5.0 * v), u))
        relaxes = found.overview.facts.ou.status == 'ok'
        assert ('rounding' in dict(known_lines(found.overview))['Relaxation']) == relaxes
        assert not any('relaxes in' in one for one in answer(found))
        seem += relaxes
    assert seem >= 2


def test_unknown_facts_are_stated_and_the_others_kept():
    """Without throttle; with one that does nothing; without a limit; with a limit never met."""
    blind = overview(paced(throttle=False, seconds=20.0))
    words = dict(known_lines(blind))
    assert words['Sag'] == 'unknown: the recording has no throttle'
    assert words['Noise'].endswith(' mV rms') and 'Below' not in ' '.join(words)
    assert answers(blind)[0].startswith('The voltage fell to ')
    idle = dict(known_lines(overview(paced(sag=0.0, seconds=20.0), 3.0)))
    # What is known: a bound, above the true 0.
    bound = re.match(r'below ([\d.]+) mV at 80 % throttle \(95 %\)', idle['Sag'])
    assert 0.0 < float(bound[1]) < 200.0 and idle['Below 3 V'] == 'never'
    high = answers(overview(paced(seconds=20.0), 3.0))[0]
    assert high.startswith('The voltage stayed above 3 V')
    one = paced(seconds=1.0)
    assert answers(overview(replace(one, t=one.t[:0], voltage=one.voltage[:0],
                                    throttle=one.throttle[:0]))) == []


@pytest.mark.parametrize('shares,words', [
    ((), ''), ((0.2,), ''), ((0.3,), 'A line at 40.00 Hz makes 30 % of the noise'),
    ((0.2, 0.1), '2 lines, the strongest at 40.00 Hz, make 30 % of the noise')])
def test_lines_are_part_of_the_answer_when_they_make_a_quarter_of_the_noise(shares, words):
    """Alone or together; weaker ones are in the list only."""
    lines = [SimpleNamespace(frequency=40.0 * k, rms=0.01 / k, share=share)
             for k, share in enumerate(shares, 1)]
    level = SimpleNamespace(label='all', kind=None, lines=SimpleNamespace(lines=lines))
    said = answers(overview(paced(seconds=10.0), 15.2, [level]))
    assert said[-1] == f'{words}.' if words else not any('line' in one for one in said)


def test_a_stationary_recording_of_one_level_is_known_from_all_of_it():
    """Its fit agrees with that of the last 2 s, and is known better; two levels have none."""
    seen = analyze(read_recording('bags/load_40')).overview
    (low, high), (least, most) = seen.whole.alpha_95, seen.facts.ou.alpha_95
    assert low < 63.0 < high and high / low < 0.7 * most / least and low < most and least < high
    assert seen.whole.window_s == pytest.approx(20.0, rel=0.01) and seen.facts.ou.window_s == 2.0
    assert known_lines(seen)[-1][1].startswith(f'alpha {seen.whole.alpha:.1f} ')
    assert analyze(paced(seconds=20.0)).overview.whole is None
