"""The report of `analyze`: its records, the most important first."""

from dataclasses import replace

import numpy as np
from ou_monitor import bench
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.quality import quality_list
from ou_monitor.analysis.supply import Dip, Dips
from ou_monitor.records import Flag, Recording, Severity
from ou_monitor.report.analysis_document import analysis_document, answer, facts, notes
import pytest
from simulated_packs import flown
from simulated_recordings import recording

TRUTH = ((0.1, 0.3156), (0.4, 0.632))


@pytest.fixture(scope='module')
def analysis():
    return analyze(recording(1, TRUTH), brownout_voltage=4.5)


def test_headline_warns_of_what_changes_its_own_numbers():
    """Millivolts, swapped leads; nothing where nothing is wrong."""
    simulated = recording(1, TRUTH, seconds=2.0)
    assert not any('Beware' in one for one in answer(analyze(simulated)))
    sentence = answer(analyze(replace(simulated, voltage=1e3 * simulated.voltage)))[0]
    assert sentence == ('Beware: the voltages seem to be millivolts or counts, not volts.')
    swapped = answer(analyze(replace(simulated, voltage=-simulated.voltage)))
    assert swapped[0].startswith('Beware: the voltage is negative throughout')
    assert not any('fell' in one or 'safe' in one or 'sag' in one for one in swapped)
    stuck = answer(analyze(replace(simulated, voltage=np.full(simulated.n, 5.0))))
    assert stuck[0].startswith('Beware: the voltage does not change at all: the sensor is stuck')
    assert not any('above' in one or 'sag' in one for one in stuck)
    few = analyze(replace(simulated, voltage=16.6 / 5.0 * simulated.voltage), cells=6,
                  brownout_voltage=19.8)
    assert 'or it has 4 cells, not 6' in answer(few)[0]
    slow = replace(simulated, t=1e3 * simulated.t[::20], voltage=simulated.voltage[::20],
                   throttle=simulated.throttle[::20], current=None)
    found = analyze(slow)
    assert answer(found)[0] == 'Beware: the time seems to be in a unit smaller than seconds.'
    assert 'TIME_UNIT' in {item.name for item in found.quality}
    # Dates since 1970 are in s.
    dated = analyze(replace(slow, t=1.7e9 + slow.t))
    assert 'TIME_UNIT' not in {item.name for item in dated.quality}


def test_the_same_caution_of_two_levels_is_said_once(analysis):
    def said(**changes):
        items = quality_list(
            analysis.recording, [level.throttle for level in analysis.levels],
            [replace(level.estimate, **changes) for level in analysis.levels])
        return list(notes(replace(analysis, quality=items, notes=())).notes)

    assert said(flags=(Flag.QUANTIZED,), noise_std=0.001) == [
        (Severity.WARNING, f'At 10 and 40 % throttle: {Flag.QUANTIZED.value}')]
    assert said(flags=(), noise_std=0.001) == []


def over_throttle(analysis):
    table, *_ = next(part for part in analysis_document(analysis).parts
                     if getattr(part, 'heading', '') == 'Over throttle').parts
    return table


def test_the_table_over_throttle_is_that_of_the_facts(analysis):
    table = over_throttle(analysis)
    assert table.heads[0] == 'throttle' and table.heads[-1] == 'brown-out risk'
    known = {row[0]: dict(zip(table.heads, row)) for row in table.rows}
    noise = analysis.overview.facts.noise
    for k in (1, 4):
        assert float(known[f'{10 * k} %']['noise, mV rms']) == pytest.approx(
            1e3 * noise.rms_v[k], rel=5e-3)
    others = [row for name, row in known.items() if name not in ('10 %', '40 %')]
    assert len(others) == 9 and {row['noise, mV rms'] for row in others} == {'-'}
    assert all(row['throttle'].endswith('\nnot flown') for row in others)


def test_throttles_of_which_nothing_is_known_are_left_out(analysis):
    seen, unknown = analysis.overview, (float('nan'),) * 11
    nothing = replace(
        analysis, by_throttle=replace(analysis.by_throttle, risk=np.array(unknown)),
        overview=replace(seen, facts=replace(
            seen.facts, sag=replace(seen.facts.sag, sag_v=unknown))))
    assert [row[0] for row in over_throttle(nothing).rows] == ['10 %', '40 %']


def test_a_missing_budget_states_the_voltages(analysis):
    """A supply below the limit at rest or at the end, or a flight that just now takes it there."""
    voltage = analysis.recording.voltage.copy()
    voltage[-1] = 13.5
    none = replace(
        analysis, recording=replace(analysis.recording, voltage=voltage),
        by_throttle=replace(analysis.by_throttle, voltage=13.2, budget=0.0,
                            risk=np.full(analysis.by_throttle.throttle.size, 0.3)),
        overview=replace(analysis.overview, load=replace(analysis.overview.load, level=14.0)))
    assert dict(facts(none))['Safe up to'] == (
        'no throttle, at the end of this recording, where the voltage is 13.50 V, and 14.00 V at '
        'rest: the risk of falling below 13.2 V within 5 s is 0.3')


def test_a_switched_load_has_a_risk_at_its_two_throttles_only():
    u = np.repeat(np.random.default_rng(2).integers(0, 2, 60), 50).astype(float)
    u[-25:] = 0.0
    v = 16.0 - 2.0 * u + 0.03 * np.random.default_rng(3).standard_normal(u.size)
    found = analyze(Recording(np.arange(u.size) / 50.0, v, u), brownout_voltage=14.0)
    assert 'At the end of the recording, 0 % throttle is safe for 5 s' in ' '.join(answer(found))
    words = dict(facts(found))['Safe up to']
    assert words.startswith('0 % throttle if held') and '; at 100 % it is ' in words
    assert np.flatnonzero(np.isfinite(found.by_throttle.risk)).tolist() == [0, 10]


def test_a_throttle_just_beyond_the_budget_counts_as_flown(analysis):
    """Its risk is below twice the limit, so it was called not flown."""
    curves = analysis.by_throttle
    risk = np.where(curves.throttle < 1.0, 0.001, 0.015)
    near = replace(analysis, by_throttle=replace(
        curves, voltage=3.0, budget=0.95, limit=0.01, risk=risk))
    assert '; at 100 % it is 1.5 %' in dict(facts(near))['Safe up to']


@pytest.mark.parametrize('budget, warned', [(1.0, True), (0.05, False)])
def test_a_safe_throttle_that_did_fall_below_the_limit_is_contradicted(analysis, budget, warned):
    """The risk is a model's; the flight itself has the last word."""
    v, t = analysis.recording.voltage, analysis.recording.t
    k, lowest = int(v.argmin()), float(v.min())
    dips = Dips(lowest + 0.01, 1, 0.01, 0.01, deepest=(
        Dip(float(t[k] - t[0]), lowest, 0.01, float(analysis.recording.throttle[k])),))
    safe = replace(analysis, by_throttle=replace(
        analysis.by_throttle, voltage=lowest + 0.01, budget=budget), overview=replace(
            analysis.overview, facts=replace(analysis.overview.facts, dips=dips)))
    for words in (dict(facts(safe))['Safe up to'], ' '.join(answer(safe))):
        assert ('but at ' in words) == warned
    assert f'At the end of the recording, {100.0 * budget:.0f} % throttle is safe for 5 s' in words
    above = replace(safe, overview=analysis.overview)
    assert 'but at ' not in ' '.join(answer(above))


@pytest.mark.parametrize('limit, warned', [(3.3, True), (13.2, False)])
def test_a_limit_per_cell_for_a_whole_pack_is_questioned(limit, warned):
    """15 V with a sag are four cells; 3.3 V may be meant for each of them."""
    flown = recording(1, ((0.0, 0.1), (0.5, 0.3), (0.9, 0.5)), sag=-2.0)
    flown = replace(flown, voltage=10.9 + flown.voltage)
    said = ' '.join(answer(analyze(flown, brownout_voltage=limit)))
    assert ('0.82 V per cell if this is a pack of 4 cells' in said) == warned


@pytest.mark.parametrize('command', [bench.analyze, bench.compare, bench.discover])
def test_the_first_line_says_that_the_log_pauses(command):
    """A link that is lost for 20 s; not a supply that is off for 5 s, whose samples are there."""
    t, v, u = flown(1)
    there, off = (t < 10.0) | (t > 30.0), (t > 20.0) & (t < 25.0)
    for samples, words in (((t[there], v[there], u[there]), '20 s in all'),
                           ((t, np.where(off, 0.0, v), u), ''), ((t, v, u), '')):
        found = command(Recording(*samples))
        subject = found.document().subject
        assert ('; 1 pause without usable samples, ' in subject) == bool(words)
        assert words in subject
        assert f'; {off.sum()} left out' in subject or 0.0 not in samples[1]
        if command is bench.analyze:
            assert f'{samples[0].size} samples in ' in subject
            assert ('PAUSES' in {item.name for item in found.quality}) == bool(words)
