"""Simulated supplies: seeds, a running simulation, recorded throttle, a brown-out."""

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
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.simulation import (
    constant, is_recording, lacks, PRESETS, read_profile, read_throttle, RunningSupply, simulated)
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


def test_equal_seeds_give_equal_samples():
    """Another seed gives others; nothing is drawn before it is needed."""
    def first(seed):
        return next(simulated(SAGGING, constant(0.2), duration=1e9, rate=1000.0, seed=seed))

    np.testing.assert_array_equal(first(1).voltage, first(1).voltage)
    assert np.all(first(1).voltage != first(2).voltage)


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
    whole = read_throttle(str(flight))
    assert whole.duration == 4.0
    at = np.array([0.0, 1.5, 2.0, 2.999, 3.0, 99.0])
    np.testing.assert_allclose(whole.profile(at), [0.1, 0.1, 0.6, 0.6, 0.2, 0.2])
    part = read_throttle(str(flight), 2.0, 4.0)
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
        read_throttle(str(none))
    percent = tmp_path / 'percent.csv'
    percent.write_text(
        'time_s,voltage_v,throttle\n0,5,400\n1,5,870\n', encoding='utf-8')
    with pytest.raises(InputError, match='throttle runs from 400 to 870'):
        read_throttle(str(percent))
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
