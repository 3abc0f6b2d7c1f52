"""Simulated supplies: throttle profiles, presets, seeds, recorded throttle, a brown-out."""

import math
import os
from pathlib import Path

from live import ROOT
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.model.load import charge_at, LoadStart, open_circuit, SIZE
from ou_monitor.model.supply import SEGMENT, SupplyModel
from ou_monitor.model.terms.load_response import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import NonlinearRestoring, OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import Drift
from ou_monitor.online.risk.flag import FlagLevel
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.simulation import (
    constant, is_recording, lacks, plan, PRESETS, PROFILES, read_profile,
    RunningSupply, simulated, through)
import pytest

SAGGING = SupplyModel((OU(63.0, 0.3, 5.0), LoadSag(0.5, 0.0)))


def test_pieces_have_consecutive_stamps():
    """Together they have the stamps k/rate, and none is longer than a segment."""
    pieces = list(simulated(SAGGING, read_profile('loads'), duration=3.0, rate=50_000.0, seed=1,
                            name='made'))
    assert sum(piece.n for piece in pieces) == 150_000
    assert max(piece.n for piece in pieces) == SEGMENT
    assert {piece.name for piece in pieces} == {'made'}
    np.testing.assert_array_equal(np.concatenate([piece.t for piece in pieces]),
                                  np.arange(150_000) / 50_000.0)


def test_samples_are_those_of_the_model():
    """The same as one run of the model over all stamps, with the same seed."""
    pieces = list(simulated(SAGGING, read_profile('loads'), duration=90.0, rate=1000.0, seed=7))
    t = np.arange(90_000) / 1000.0
    throttle = np.concatenate([piece.throttle for piece in pieces])
    np.testing.assert_array_equal(throttle, read_profile('loads')(t).astype(np.float32))
    np.testing.assert_allclose(
        np.concatenate([piece.voltage for piece in pieces]),
        SAGGING.simulate(t, np.random.default_rng(7), throttle), rtol=0, atol=1e-9)


@pytest.mark.parametrize('terms, words', [
    ((OU(63.0, 1e200, 5.0),), 'beyond 1e\\+09 V'), ((OU(63.0, 0.3, 1e300),), 'beyond'),
    ((OU(1e-300, 1e30, 0.0),), 'beyond'),
    ((OU(63.0, 1e3, 5.0), NonlinearRestoring(-1e6, 1e-3)), 'diverges'),
])
def test_an_impossible_simulation_is_refused(terms, words):
    """One line; no warning of NumPy, no infinity in the recording."""
    with pytest.raises(InputError, match=words):
        list(simulated(SupplyModel(terms), constant(0.0), duration=2.0, rate=1000.0, seed=1))


FLIGHT = PRESETS['flight_full'].model
LOAD = LoadStart(4.0, 15.6, (1.0,) * SIZE, tuple(map(tuple, np.eye(SIZE).tolist())), 0.01,
                 (-8.0, 0.0, 0.0), (0.1, 0.9))
PACK = SupplyModel((OU(5.0, 0.0, 15.6), Drift(-0.01, 0.0), LoadSag(2.0, 0.5),
                    LoadTransient(-1.0, 0.1, 0.0)), LOAD)


def test_step_by_step_equals_one_batch():
    profile = read_profile('flight')
    batch = np.concatenate([piece.voltage for piece in simulated(
        FLIGHT, profile, duration=40.0, rate=250.0, seed=5)])
    run = RunningSupply(FLIGHT, rate=250.0, seed=5)
    sizes = np.random.default_rng(1).integers(1, 7, 5000)
    path = []
    for n in sizes[:np.searchsorted(np.cumsum(sizes), batch.size)].tolist():
        path.append(run.draw(profile(run.times(n))))
    steps = np.concatenate(path)
    assert steps.size > 9900
    np.testing.assert_allclose(steps, batch[:steps.size], rtol=0.0, atol=1e-9)


def test_resistance_scales_only_the_response():
    """The response to throttle grows from the next sample on; everything else is unchanged."""
    paths = {}
    for resistance in (1.0, 1.4):
        run = RunningSupply(SupplyModel((*PACK.terms, MeasurementNoise(0.02))), rate=100.0, seed=3)
        first = run.draw(np.full(50, 0.6))
        run.simulation.resistance = resistance
        paths[resistance] = first, run.draw(np.full(500, 0.6))
    np.testing.assert_array_equal(paths[1.0][0], paths[1.4][0])
    np.testing.assert_allclose(paths[1.0][1] - paths[1.4][1], 0.4 * (2.0 * 0.6 + 0.5 * 0.36),
                               rtol=1e-6)


@pytest.mark.parametrize('charge', [np.nan, 0.5])
def test_the_pack_empties_by_the_charge_drawn(charge):
    """Level after 30 s of half throttle; the recording's drift is not added to it."""
    pieces = list(simulated(PACK, read_profile('0:0,10:0,10:0.5,40:0.5'), duration=60.0,
                            rate=100.0, seed=0, charge=charge))
    voltage = np.concatenate([piece.voltage for piece in pieces])
    begin = charge_at(15.6 / 4.0)
    left = begin if np.isnan(charge) else charge
    offset = 15.6 - 4.0 * float(open_circuit(begin))
    # What a read of the table, 5e-3 of a charge, is wrong by.
    assert voltage[0] == pytest.approx(offset + 4.0 * float(open_circuit(left)), abs=2e-3)
    at_end = 4.0 * float(open_circuit(left - 0.01 * 0.5 ** 1.8 * 50.0))
    assert voltage[-1] == pytest.approx(offset + at_end - (2.0 * 0.5 + 0.5 * 0.25), abs=2e-3)


def test_missing_parts_of_a_model_are_named():
    """The other terms are simulated; charge cannot be set in a model without it."""
    assert lacks(PACK) == ()
    assert [words.split(' (')[0] for words in lacks(SupplyModel((OU(5.0, 0.1, 5.0),)))] == [
        'no response to throttle', 'no charge']
    with pytest.raises(ValueError, match="no entry 'load'"):
        RunningSupply(FLIGHT, rate=10.0, seed=0, charge=0.5)


ROWS = '1000,12.0,0.1\n1001,12.0,0.1\n1002,11.5,0.6\n1003,11.4,0.2\n1004,11.9,0.2\n'


@pytest.fixture
def flight(tmp_path):
    """Return a CSV of five seconds that begin at 1000 s."""
    path = tmp_path / 'flight.csv'
    path.write_text('time_s,voltage_v,throttle\n' + ROWS, encoding='utf-8')
    return path


def test_each_value_holds_until_the_next(flight):
    """Stamps count from the begin of the part, and the last value stays."""
    run = plan(throttle=str(flight))
    assert run.duration == 4.0
    at = np.array([0.0, 1.5, 2.0, 2.999, 3.0, 99.0])
    np.testing.assert_allclose(run.profile(at), [0.1, 0.1, 0.6, 0.6, 0.2, 0.2])
    part = plan(throttle=str(flight), start=2.0, end=4.0)
    assert part.duration == 1.0
    np.testing.assert_allclose(part.profile(np.array([0.0, 1.0])), [0.6, 0.2])


def test_recordings_are_told_from_profiles(flight, tmp_path):
    stick = tmp_path / 'stick.csv'
    stick.write_text('time_s,throttle\n0,0.1\n', encoding='utf-8')
    assert is_recording(str(flight)) and is_recording(str(tmp_path))
    assert not any(is_recording(text) for text in (
        str(stick), 'flight', '0.4', 'nowhere.mcap', str(tmp_path / 'no.csv')))


def test_a_simulation_over_a_recording(flight, tmp_path, capsys):
    """Its length is the default; --from and --to take a part; a bag does as well as a CSV."""
    first, again = tmp_path / 'first.mcap', tmp_path / 'again.mcap'
    assert main(['simulate', '--throttle', str(flight), '--rate', '100', '--output',
                 str(first)]) == 0
    one = read_recording(first)
    assert one.n == 400
    np.testing.assert_allclose(one.throttle[[0, 199, 200, 300]], [0.1, 0.1, 0.6, 0.2], atol=1e-6)
    assert main(['simulate', '--throttle', str(first), '--from', '1', '--to', '3', '--rate',
                 '100', '--output', str(again)]) == 0
    two = read_recording(again)
    assert two.n == pytest.approx(200, abs=1)
    np.testing.assert_allclose(two.throttle[[50, 150]], [0.1, 0.6], atol=1e-6)
    # Words, because a long path wraps the line.
    assert '4 s at 100 Hz' in ' '.join(capsys.readouterr().out.split())


def test_throttle_of_an_unusable_recording_is_refused(flight, tmp_path, capsys):
    none = tmp_path / 'none.csv'
    none.write_text('time_s,voltage_v\n0,5\n1,5\n', encoding='utf-8')
    with pytest.raises(InputError, match='has no throttle'):
        plan(throttle=str(none))
    percent = tmp_path / 'percent.csv'
    percent.write_text(
        'time_s,voltage_v,throttle\n0,5,400\n1,5,870\n', encoding='utf-8')
    with pytest.raises(InputError, match='throttle runs from 400 to 870'):
        plan(throttle=str(percent))
    assert main(['simulate', '--throttle', 'flight', '--from', '1', '--output',
                 str(tmp_path / 'x.mcap')]) == 2
    assert 'give --throttle RECORDING' in capsys.readouterr().err
    assert main(['simulate', '--throttle', str(flight), '--output', str(flight)]) == 2


# 3.3 V a cell.
LIMIT = 13.2


def flown(resistance, seed, duration=40.0, rate=100.0, look=0.1):
    """Return stamps of the reports, s, lowest voltage before each since the last, and its flag."""
    monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=LIMIT))
    (piece,) = simulated(
        read_model(ROOT / 'models' / 'gecko.yaml').model, read_profile('flight'),
        duration=duration, rate=rate, seed=seed, charge=np.nan, resistance=resistance)
    each, levels = round(look * rate), []
    for k in range(0, piece.n, each):
        part = slice(k, k + each)
        monitor.push(piece.t[part], piece.voltage[part], piece.throttle[part])
        levels.append(monitor.report(0.0).flag.level is FlagLevel.CRITICAL)
    # The floor takes the median of three readings: a lone one is no dip.
    middle = np.median(np.lib.stride_tricks.sliding_window_view(
        np.concatenate((piece.voltage[:1], piece.voltage, piece.voltage[-1:])), 3), axis=1)
    return piece.t[each - 1::each], middle.reshape(-1, each).min(axis=1), np.array(levels)


def test_a_good_pack_sets_no_flag():
    """Not once in a flight; an hour of them is in the benchmark."""
    _, low, critical = flown(1.0, 0)
    assert low.min() > LIMIT and not critical.any()


@pytest.mark.parametrize('seed', [0, 1])
def test_an_old_pack_is_flagged_before_or_at_the_dip(seed):
    """The report of the samples in which it begins says CRITICAL, at the latest."""
    _, low, critical = flown(1.8, seed)
    below = low <= LIMIT
    begins = np.flatnonzero(below & ~np.append(False, below[:-1]))
    assert begins.size and critical[begins].all()


def at(profile, *times):
    """Return throttle at some times, s."""
    return profile(np.array(times, dtype=float)).tolist()


def refused(text):
    """Return the one line of a profile that must be refused."""
    with pytest.raises(InputError) as caught:
        read_profile(text)
    assert '\n' not in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize('rate', [1000.0, 50.0, 333.0, 20_000.0])
def test_steps_are_at_their_stamps(rate):
    """At the stamp of a step throttle is the new one, one sample before the old; also repeated."""
    loads = read_profile('loads')
    for period in (0.0, 40.0, 4000.0):
        for time, old, new in ((10.0, 0.0, 0.05), (20.0, 0.05, 0.1), (30.0, 0.1, 0.4),
                               (40.0, 0.4, 0.0)):
            k = round((period + time) * rate)
            assert at(loads, (k - 1) / rate, k / rate) == pytest.approx([old, new], abs=0)


def test_the_transient_of_the_paper():
    """0 -> 20 -> 0 %, 3 s each way in 10 s, repeated."""
    assert at(read_profile('transient'), 0.0, 2.999, 3.0, 5.999, 6.0, 9.999, 13.0, 16.0) == [
        0.0, 0.0, 0.2, 0.2, 0.0, 0.0, 0.2, 0.0]


@pytest.mark.parametrize('name', sorted(PROFILES))
def test_named_profiles_stay_within_0_and_1(name):
    """Defined at all times, and equal from one array or sample by sample."""
    assert set(PROFILES) == {'flight', 'hover', 'loads', 'transient'}
    profile = read_profile(name)
    t = np.arange(0.0, 100.0, 0.013)
    whole = profile(t)
    assert whole.shape == t.shape and whole.min() >= 0.0 and whole.max() <= 1.0
    assert np.ptp(whole) > 0.05
    np.testing.assert_array_equal(np.concatenate([profile(t[k:k + 1]) for k in range(t.size)]),
                                  whole)
    assert PROFILES[name][1]


@pytest.mark.parametrize('name', ['flight', 'hover'])
def test_the_stick_moves_fifty_times_a_second(name):
    """Values change at multiples of 20 ms alone."""
    t = np.arange(40_000) / 1000.0
    changes = np.flatnonzero(np.diff(read_profile(name)(t))) + 1
    assert changes.size > 100 and np.all(changes % 20 == 0)


def test_the_flight_profile_repeats_every_40_s():
    t = np.arange(0.0, 40.0, 0.02)
    flight = read_profile('flight')
    np.testing.assert_allclose(flight(t + 80.0), flight(t), rtol=0, atol=1e-9)
    assert at(flight, 3.0, 10.0, 27.0) == pytest.approx([0.05, 0.40, 0.75])


@pytest.mark.parametrize('text, value', [('0', 0.0), ('1', 1.0), ('0.4', 0.4), ('4e-1', 0.4),
                                         (' 0.25 ', 0.25)])
def test_a_number_is_a_constant_profile(text, value):
    assert at(read_profile(text), -1.0, 0.0, 1e9) == [value] * 3
    assert at(constant(value), 0.0) == [value]


def test_points_are_joined_by_straight_lines():
    """Constant beyond the last one; two points at one time are a step."""
    assert at(read_profile('1:0.2,3:0.6,3:0.1,5:0.1'), 0.0, 1.0, 2.0, 2.5, 3.0, 4.0, 99.0) == (
        pytest.approx([0.2, 0.2, 0.4, 0.5, 0.1, 0.1, 0.1]))
    assert at(read_profile('2:0.3'), 0.0, 2.0, 9.0) == [0.3] * 3
    assert at(read_profile('0:0,1:0,1:1'), 0.999, 1.0, 5.0) == [0.0, 1.0, 1.0]


def test_profiles_repeat_and_hold_their_values():
    """A period wraps; a held profile keeps the value of the last update."""
    ramp = through([(0.0, 0.0), (1.0, 1.0)], period=1.0, stick_rate=10.0)
    assert at(ramp, 0.0, 0.05, 0.1, 0.15, 0.9, 1.0, 1.25) == pytest.approx(
        [0.0, 0.0, 0.1, 0.1, 0.9, 0.0, 0.2])


def test_a_csv_is_a_profile(tmp_path):
    """Columns by name in any order; others are ignored."""
    path = tmp_path / 'stick.CSV'
    path.write_text('throttle,x,time_s\n0.0,9,0\n0.5,9,1\n0.5,9,2\n0.1,9,2\n')
    assert at(read_profile(str(path)), 0.0, 0.5, 1.5, 2.0, 50.0) == pytest.approx(
        [0.0, 0.25, 0.5, 0.1, 0.1])
    path.write_text('t_ms;gas_percent\n0;0,0\n1000;50,0\n', encoding='utf-8')
    assert at(read_profile(str(path)), 0.5, 2.0) == pytest.approx([0.25, 0.5])
    named = CsvColumns(time='t_ms', throttle='x', throttle_unit='%')
    path.write_text('t_ms;x\n0;0,0\n1000;50,0\n', encoding='utf-8')
    assert at(read_profile(str(path), named), 0.5, 2.0) == pytest.approx([0.25, 0.5])
    one = tmp_path / 'one.csv'
    one.write_text('time_s,throttle\n0,0.7\n')
    assert at(read_profile(str(one)), 0.0, 10.0) == [0.7, 0.7]


def test_points_set_the_length(tmp_path):
    path = tmp_path / 'stick.csv'
    path.write_text('time_s,throttle\n0,0.1\n5,0.45\n90,0.45\n')
    assert [plan(throttle=text).duration for text in (str(path), '0:0.1,30:0.5', '0.4', 'flight')
            ] == [90.0, 30.0, 120.0, 120.0]


@pytest.mark.parametrize('text, words', [
    ('fligth', ["'fligth'", "'flight'", '0..1', 'CSV']), ('', ["''"]), ('xyz', ["'xyz'"]),
    ('1.1', ['0..1', '1.1']), ('-0.1', ['0..1', '-0.1']), ('nan', ['0..1']), ('inf', ['0..1']),
    ('40%', ["'40%'"]), ('0:0,1', ["'1'", 'T:U']), ('0:0,', ["''", 'T:U']),
    ('0:0:0', ["'0:0:0'", 'T:U']), ('a:0', ["'a:0'"]), ('0:b', ["'0:b'"]),
    ('0:0,1:2', ['0..1', 'got 2']), ('1:0,0:0', ['not fall', '0 s comes after 1 s']),
    ('0:nan,1:0', ['0..1']), ('nan:0.5', ['finite']), ('0:0,inf:0', ['finite']),
    ('0:0,nan:0', ['fall']), ('0:0,1_0:0', ["'1_0:0'"]), ('\u0660', ['valid: flight']),
])
def test_a_wrong_profile_is_named_in_one_line(text, words):
    line = refused(text)
    assert all(word in line for word in words), line


@pytest.mark.parametrize('content, words', [
    (b'', 'empty'), (b'\n\n', 'empty'), (b'time_s,throttle\n', 'no row'),
    (b'time_s,x\n0,0\n', 'valid: time_s, x (--throttle-column)'),
    (b'0,0.1,5\n1,0.2,3\n', "no column 'throttle'"),
    (b'time_s,throttle\n0,0.1\n1,x\n', 'throttle must be a number 0..1'),
    (b'time_s,throttle\n0,0.1\nx,0.1\n', 'times'),
    (b'time_s,throttle\n0,0.1\n1,400\n', 'got 400'),
    (b'time_s,throttle\n1,0.1\n0,0.1\n', 'must not fall'),
    (b'time_s,throttle\n0,0.1\n1,1_0\n', ":3: column 'throttle' holds '1_0'"),
    (b'time_s,throttle\n0,0.1\n1,0.1,5\n', ':3: 3 cells'),
    (b'\xff\xfe\x00time', "no column 'time_s'"), (b'# nothing\n', 'stick.csv'),
    (None, 'cannot read'),
])
def test_a_wrong_profile_csv_is_named_in_one_line(tmp_path, content, words):
    """Also a missing file, an empty one, and bytes."""
    path = tmp_path / 'stick.csv'
    if content is not None:
        path.write_bytes(content)
    line = refused(str(path))
    assert str(path) in line and words in line, line


@pytest.mark.parametrize('make', [Path.mkdir, os.mkfifo])
def test_a_profile_is_a_regular_file(tmp_path, make):
    """No folder, and no FIFO, which would wait for its writer."""
    path = tmp_path / 'a.csv'
    make(path)
    assert not is_recording(str(path))
    assert f'cannot read {path}: ' in refused(str(path))


# Typed from the paper's Tables 1 and 2: throttle, Vrms in mV.
VRMS = {'load_05': (0.05, 9.38), 'load_10': (0.10, 28.1), 'load_40': (0.40, 56.3)}
SIGMA = {'load_10': 0.3156, 'load_40': 0.6320}
VAR_INF = {'load_10': 7.91e-4, 'load_40': 3.17e-3}


def drawn(name, seconds, seed=1, rate=None):
    """Return t, voltage and throttle of a preset."""
    preset = PRESETS[name]
    pieces = list(simulated(preset.model, read_profile(preset.throttle), duration=seconds,
                            rate=rate or preset.rate, seed=seed))
    return tuple(np.concatenate([getattr(piece, key) for piece in pieces])
                 for key in ('t', 'voltage', 'throttle'))


def test_the_presets_and_profiles_have_these_names():
    assert set(PRESETS) == {'idle', 'load_05', 'load_10', 'load_40', 'transient', 'loads',
                            'flight', 'flight_full'}
    for preset in PRESETS.values():
        assert preset.text and preset.rate > 0.0 and preset.duration > 0.0
        assert preset.model.ou.alpha == 63.0 and preset.model.ou.u0 == 5.0


@pytest.mark.parametrize('name', sorted(VRMS))
def test_presets_have_the_rms_of_the_paper(name):
    """Vrms = sigma / sqrt(2 alpha) within the last digit printed; throttle as labelled."""
    # Table 2 prints 4 digits of sigma and 3 of Var_inf.
    throttle, vrms = VRMS[name]
    ou = PRESETS[name].model.ou
    assert float(PRESETS[name].throttle) == throttle
    assert 1e3 * ou.sigma / math.sqrt(126.0) == pytest.approx(vrms, rel=2e-3)
    if name in SIGMA:
        assert ou.sigma == pytest.approx(SIGMA[name], rel=2e-4)
        assert ou.sigma ** 2 / 126.0 == pytest.approx(VAR_INF[name], rel=2e-3)


def test_idle_reads_zero():
    """Motors off read "~0": below half a step of 9.375 mV, and some noise all the same."""
    vrms = PRESETS['idle'].model.ou.sigma / math.sqrt(126.0)
    assert 2e-3 < vrms < 4.7e-3 * (1.0 + 1e-9)


def test_loads_follow_the_four_states():
    """10 s each: innovations give sigma to sqrt(1/(2 n)) = 0.7 %, so 4 % are seen."""
    _, voltage, throttle = drawn('loads', 40.0, seed=2)
    phi = math.exp(-0.063)
    e = (voltage[1:] - 5.0) - phi * (voltage[:-1] - 5.0)
    for load, vrms in ((0.0, 4.7e-3), (0.05, 9.38e-3), (0.1, 28.1e-3), (0.4, 56.3e-3)):
        own = e[np.isclose(throttle[1:], load)]
        assert own.size > 9990
        found = math.sqrt(own.var() / (1.0 - phi ** 2))
        assert abs(found / vrms - 1.0) < 4.0 * math.sqrt(0.5 / own.size) + 2e-3


def test_transient_is_that_of_the_figure():
    """Release of 20 %: 368 mV at once, then exp(-63 t), as the paper fits it."""
    # Averages of 40 releases, noise of 9.4 mV: to 1.5 mV. The printed points at 10 and 25 ms, 200
    # and 80 mV, are within 5 mV of that exponential.
    t, voltage, throttle = drawn('transient', 400.0, seed=3)
    assert float(throttle.max()) == pytest.approx(0.2, rel=1e-6)
    # A throttle holds until the next stamp: the decay counts from its own.
    first = np.flatnonzero(np.diff(throttle) < 0.0) + 1
    assert first.size == 40 and np.allclose(t[first] % 10.0, 6.0)
    path = np.mean([voltage[k:k + 60] - 5.0 for k in first], axis=0)
    expected = -0.368 * np.exp(-63.0 * np.arange(60) / 1000.0)
    error = 9.38e-3 / math.sqrt(40.0)
    assert np.abs(path - expected).max() < 4.5 * error
    assert abs(path[10] + 0.200) < 5e-3 + 4.0 * error
    assert abs(path[25] + 0.080) < 5e-3 + 4.0 * error


def test_flight_sags_and_is_noisy():
    """Mean at hover against that at idle: sag 0.3 V at full throttle; white noise of 2 mV."""
    # Differences at 20 kHz are of the noise: 2 std^2, and sigma^2 dt of the rail.
    t, voltage, throttle = drawn('flight', 40.0, seed=4)
    hover, idle = np.isclose(throttle, 0.4), (throttle == 0.0) & (t < 2.0)
    assert hover.sum() > 10_000
    fall = voltage[idle].mean() - voltage[hover].mean()
    # 10 s and 2 s of an OU: Vrms sqrt(2/(alpha T)).
    assert abs(fall - 0.12) < 4.0 * (56.3e-3 * math.sqrt(2.0 / 630.0)
                                     + 4.7e-3 * math.sqrt(2.0 / 126.0))
    _, voltage, _ = drawn('flight', 2.0, seed=5, rate=20_000.0)
    own = np.diff(voltage)
    truth = 2.0 * (2e-3) ** 2 + (4.7e-3) ** 2 * 126.0 / 20_000.0
    assert abs(own.var() / truth - 1.0) < 4.0 * math.sqrt(3.0 / own.size)


def test_flight_full_has_adc_steps():
    """Whole steps of 10 mV, discharge of 1 mV/s."""
    _, voltage, _ = drawn('flight_full', 10.0)
    codes = voltage / 10e-3
    assert np.abs(codes - np.rint(codes)).max() < 1e-6 and np.unique(codes).size > 5
    drift = [term for term in PRESETS['flight_full'].model.terms if term.NAME == 'drift']
    assert drift[0].rate == -1e-3
