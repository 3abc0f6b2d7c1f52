"""A flight compared with the model of its supply: an old pack is found, a good one is not."""

from dataclasses import replace
import math

from live import ROOT
import numpy as np
from ou_monitor import MonitorSettings, SupplyMonitor
from ou_monitor.model.load import WARMING, WARMING_SE
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadDependentNoise, LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise, Quantization
from ou_monitor.model.terms.slow import Drift
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.model_watch import ModelVerdict
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Level, Recording
from ou_monitor.simulation import constant, Profile, recorded_throttle, simulated
from pushed import pushed
import pytest

# Learned from the recorded flight whose throttle the simulated ones have.
GECKO = read_model(ROOT / 'models' / 'gecko.yaml').model
FLOWN: Profile = recorded_throttle(read_recording(
    ROOT / 'bags' / 'recorded' / 'gecko.csv'), 'gecko')


def flight(duration, seed, *, age=1.0, throttle=FLOWN):
    """Return a simulated flight of a pack with `age` times the response to throttle."""
    (piece,) = simulated(GECKO, throttle, duration=duration, rate=100.0, seed=seed,
                         charge=math.nan, resistance=age)
    return piece


def watched(model, made, voltage=1.0):
    """Return the last report of a monitor that has seen a flight, voltages times a factor."""
    monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=5.0), model)
    monitor.push(made.t, voltage * made.voltage, made.throttle)
    return monitor.report(0.0)


def taught(made):
    """Return what a filter learns of a flight."""
    return pushed(LoadFilter(), made.t, made.voltage, made.throttle, made.current).learned()


@pytest.mark.parametrize('age, verdict', [
    (1.0, ModelVerdict.AS_MODEL), (1.2, ModelVerdict.WEAKER), (1.4, ModelVerdict.WEAKER)])
def test_a_pack_that_has_aged_is_found_within_a_minute(age, verdict):
    report = watched(GECKO, flight(60.0, 1, age=age))
    found = report.model
    assert found.verdict is verdict
    assert abs(found.sag_ratio - age) < 1.96 * found.sag_ratio_se < 0.14 * age
    # The simulated noise has longer tails than the recorded one, so the ratio is 1.06 to 1.28.
    assert abs(found.noise_ratio - 1.0) < 2.0 * found.noise_ratio_se < 0.4
    assert report.fields['model_verdict'] == verdict.name
    assert float(report.fields['model_sag_ratio']) == found.sag_ratio
    low, high = map(float, report.fields['model_sag_ratio_95'].split())
    assert low < age < high
    weaker = verdict is ModelVerdict.WEAKER
    words = f'above the model of {GECKO.date}: weak or cold pack'
    assert GECKO.date and (words in report.summary) is weaker
    assert bool(found.words) is weaker and (report.level >= Level.WARN or not weaker)


def sticks(t):
    """Return throttles of 0.2 to 0.9, each held for 1 s on average."""
    rng = np.random.default_rng(1)
    ends = np.cumsum(rng.exponential(1.0, 400))
    return rng.uniform(0.2, 0.9, ends.size)[np.searchsorted(ends, t, 'right')]


@pytest.mark.parametrize('noise', [
    (), (MeasurementNoise(0.03),), (MeasurementNoise(0.02), Quantization(0.05)),
    (MeasurementNoise(0.015), LoadDependentNoise((0.0,) * 3, (0.0, 0.4, 0.9), (0.0, 0.8, 1.5)))],
    ids=['ou', 'white', 'adc', 'load'])
def test_the_noise_ratio_is_1_whatever_rate_and_throttle(noise):
    """The ratio of a flight scatters by 0.03 to 0.1, hence the median of nine by 0.04 at most."""
    model = SupplyModel((OU(8.0, 0.15, 16.5), LoadSag(0.6, 2.4), LoadTransient(-1.2, 0.05, 0.0),
                         Drift(-4e-3, 0.0), *noise))

    def flown(throttle, duration, rate, seed):
        t = np.arange(0.0, duration, 1.0 / rate)
        u = throttle(t)
        return t, model.simulate(t, np.random.default_rng(seed), u), u

    start = pushed(LoadFilter(), *flown(FLOWN, 120.0, 100.0, 99)).learned()

    def compared(throttle, rate, seed, more=0.0):
        t, voltage, u = flown(throttle, 60.0, rate, seed)
        other = LoadFilter()
        other.begin_with(start)
        other.push(t, voltage + more * np.random.default_rng(5).standard_normal(t.size), u)
        return other.against(start)

    found = [compared(*course, seed) for course in (
        (FLOWN, 50.0), (sticks, 100.0), (sticks, 250.0)) for seed in (1, 2, 3)]
    assert abs(np.median([one.noise_ratio for one in found]) - 1.0) < 0.1
    assert max(abs(one.noise_ratio - 1.0) / one.noise_ratio_se for one in found) < 2.0
    rattling = compared(sticks, 100.0, 4, 3.0 * start.noise)
    assert abs(rattling.noise_ratio - math.sqrt(10.0)) < 2.0 * rattling.noise_ratio_se


def test_a_load_that_empties_the_pack_faster_is_measured():
    """Four times as fast: within 30 % beside the usual flight; either within its wide error."""
    found = []
    for factor in (1.0, 4.0):
        (made,) = simulated(
            replace(GECKO, load=replace(GECKO.load, discharge=factor * GECKO.load.discharge)),
            FLOWN, duration=60.0, rate=100.0, seed=11, charge=math.nan, resistance=1.0)
        model = watched(GECKO, made).model
        found.append(model.discharge_ratio)
        assert abs(found[-1] - factor) < 1.96 * model.discharge_ratio_se < 1.5 * found[-1]
    assert found[1] / found[0] == pytest.approx(4.0, rel=0.3)


@pytest.mark.parametrize('voltage', [0.75, 1.5])
def test_another_number_of_cells_is_said_within_five_seconds(voltage):
    report = watched(GECKO, flight(5.0, 3), voltage)
    assert report.model.verdict is ModelVerdict.OTHER_PACK
    assert report.level is Level.WARN and 'another pack' in report.summary


def test_what_cannot_be_compared_has_no_verdict():
    still = watched(GECKO, flight(20.0, 1, throttle=constant(0.3))).model
    assert still.verdict is ModelVerdict.CANNOT_TELL and not still.words
    made = flight(20.0, 1)
    bare = watched(replace(GECKO, load=None), made)
    assert bare.fields['model_verdict'] == 'CANNOT_TELL' and math.isnan(bare.model.sag_ratio)
    none = watched(None, made)
    assert none.model is None and 'model_verdict' not in none.fields


def test_a_model_that_is_set_in_flight_is_compared_with_all_of_it():
    """The same numbers as if it had been there from the start, to the filter's own beginning."""
    made = flight(60.0, 1, age=1.2)
    monitor = SupplyMonitor(MonitorSettings(window=2.0, brownout_voltage=5.0))
    monitor.push(made.t, made.voltage, made.throttle)
    monitor.set_model(GECKO)
    found = monitor.report(0.0).model
    assert found.verdict is ModelVerdict.WEAKER
    assert abs(found.sag_ratio - watched(GECKO, made).model.sag_ratio) < found.sag_ratio_se


def test_what_is_learned_is_of_the_whole_flight():
    """Two flights of one pack teach the same answer, whatever their last half minute was like."""
    found = [taught(flight(120.0, seed)) for seed in (7, 99)]
    high = np.power(0.35, [1.8, 1.0, 3.0, 1.8])
    sags = [float(high @ one.coefficients[:4]) for one in found]
    assert abs(sags[0] / sags[1] - 1.0) < 0.06


def test_resistance_is_compared_where_a_current_is_measured():
    """With 1.3 times the resistance; nothing is said where the model has none."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.02)
    u = np.clip(0.4 + 0.2 * rng.standard_normal(121), 0.0, 1.0)[(2 * t).astype(int)]
    current = 60.0 * u ** 1.8

    def made(ohm):
        return Recording(t, 16.0 - ohm * current + 0.02 * rng.standard_normal(t.size), u,
                         'made', current=current)

    model = SupplyModel(GECKO.terms, taught(made(0.020)))
    old = made(0.026)
    for one, ratio in ((model, 1.3), (GECKO, math.nan)):
        monitor = SupplyMonitor(MonitorSettings(window=2.0), one)
        monitor.push(old.t, old.voltage, old.throttle, current=old.current)
        found = monitor.report(0.0).model
        if math.isnan(ratio):
            assert math.isnan(found.resistance_ratio)
            continue
        assert abs(found.resistance_ratio - ratio) < 1.96 * found.resistance_ratio_se < 0.5
        assert abs(found.sag_ratio - ratio) < 1.96 * found.sag_ratio_se
        assert found.verdict is ModelVerdict.WEAKER


def against(start, made):
    """Return what each second of a flight says beside what another one taught."""
    loads = LoadFilter()
    loads.begin_with(start)
    found = []
    for second in range(int(made.duration)):
        part = (made.t >= second) & (made.t < second + 1)
        loads.push(made.t[part], made.voltage[part], made.throttle[part])
        found.append(loads.against(start))
    return found


@pytest.mark.parametrize('age, verdict', [
    (1.0, ModelVerdict.AS_MODEL), (1.4, ModelVerdict.WEAKER)])
def test_a_pack_that_warmed_in_the_other_flight_is_no_weaker_now(age, verdict):
    made, now = flight(130.0, 1), flight(60.0, 2, age=age)
    late = made.t >= 70.0
    start = taught(Recording(made.t[late], made.voltage[late], made.throttle[late], 'late'))
    found = against(start, now)
    assert start.level < taught(now).level - 0.05
    assert found[-1].verdict is verdict
    assert abs(found[-1].sag_ratio - age) < 1.96 * found[-1].sag_ratio_se
    if age == 1.0:
        assert not [one for one in found if one.verdict is ModelVerdict.WEAKER]


@pytest.mark.parametrize('change', [0.0, 2.0])
def test_how_the_sag_falls_is_learned(change):
    """By the share of its weight beside usual packs, within two errors of its own."""
    t = np.arange(0.0, 120.0, 0.01)
    u = FLOWN(t)
    level = 4.1 - 0.3 * t / 120.0
    sag = 2.0 * u ** 1.8 * (1.0 + change * (level - 3.95))
    v = 4.0 * level - sag + 0.02 * np.random.default_rng(1).standard_normal(t.size)
    start = taught(Recording(t, v, u, 'made'))
    own = 1.0 / (start.warming_se ** -2 - WARMING_SE ** -2)
    share = start.warming_se ** 2 / own
    # The filter itself scales the sag with the level to the power 0.8, as a propeller does.
    usual = WARMING + share * (change - 0.8 / 3.95 - WARMING)
    assert abs(start.warming - usual) < 2.0 * share * math.sqrt(own)
    assert share > 0.5


def test_an_emptied_pack_is_no_other_pack():
    """It began full; one that is as low at the start is another, or an empty one."""
    t = np.arange(0.0, 60.0, 0.01)
    u = FLOWN(t)
    level = 3.9 - 0.85 * np.clip((t - 20.0) / 40.0, 0.0, 1.0)
    v = 4.0 * level - 2.0 * u ** 1.8 + 0.02 * np.random.default_rng(1).standard_normal(t.size)
    start = taught(flight(120.0, 1))
    found = against(start, Recording(t, v, u, 'emptied'))
    assert not [one for one in found if one.verdict is ModelVerdict.OTHER_PACK]
    last = t >= 55.0
    found = against(start, Recording(t[last] - 55.0, v[last], u[last], 'empty'))
    assert found[-1].verdict is ModelVerdict.OTHER_PACK and 'an empty one' in found[-1].words
