"""From one flight to the next: the load is saved, read, and known at take-off."""

from dataclasses import replace

import numpy as np
from ou_monitor.errors import InputError
from ou_monitor.model.load import LoadStart
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.ou import OU
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.online.load.supply_load import HOLD, LoadStatus
from ou_monitor.online.monitor import SupplyMonitor
from ou_monitor.recordings.model_file import as_yaml, ModelFile, parse_model, read_model
from pushed import pushed
import pytest
from simulated_packs import flown, QUAD
import yaml

# Sag after a second at full throttle, relative to `size`, V.
SAG = 15.2 * (1.0 + 0.2 * -np.expm1(-HOLD / 1.0) + 0.3 * -np.expm1(-HOLD / 20.0))


def flight(seed, pack=QUAD):
    """Return stamps, voltage and throttle of 30 s, the first 2 s at rest."""
    return flown(seed, 30.0, pack=pack, rest=2.0)


@pytest.fixture(scope='module')
def learned():
    loads = pushed(LoadFilter(), *flight(1))
    return loads.learned()


def begun(start):
    loads = LoadFilter()
    loads.begin_with(start)
    return loads


def test_the_sag_is_known_at_take_off(learned):
    """With the first sample, at rest; within its error of the truth."""
    t, v, u = flight(2)
    loads, plain = begun(learned), LoadFilter()
    for one in loads, plain:
        one.push(t[:50], v[:50], u[:50])
    load = loads.load()
    assert load.known and plain.load().status is LoadStatus.STILL
    assert abs(load.sag(0.5) - 0.15 * SAG * 0.5 ** 1.8) < 2.0 * load.sag_se(0.5)
    assert load.sag_se(0.5) > 0.15 * load.sag(0.5)
    loads.push(t[50:], v[50:], u[50:])
    assert loads.load().sag_se(0.5) < load.sag_se(0.5)


def test_another_day_is_learned(learned):
    """A pack with half as much sag again: after 28 s within two errors."""
    worn = replace(QUAD, size=0.22)
    loads = begun(learned)
    loads.push(*flight(3, worn))
    load = loads.load()
    assert load.known
    assert abs(load.sag(0.5) - 0.22 * SAG * 0.5 ** 1.8) < 2.0 * load.sag_se(0.5)


def test_a_pack_of_another_size_begins_without_it(learned):
    t, v, u = flight(2)
    loads, plain = begun(learned), LoadFilter()
    for one in loads, plain:
        one.push(t, 1.5 * v, u)
    assert loads.load() == plain.load()


def test_a_model_file_carries_it(learned, tmp_path):
    model = SupplyModel((OU(63.0, 0.3, 16.0),), learned)
    path = tmp_path / 'model.yaml'
    path.write_text(as_yaml(ModelFile(model)))
    back = read_model(path).model
    assert back == model
    t, v, u = flight(2)
    monitor = SupplyMonitor()
    monitor.set_model(back)
    monitor.push(t[:50], v[:50], u[:50])
    before = monitor.report(0.0).load
    assert before.known
    monitor.set_model(None)
    assert monitor.report(0.0).load == before
    monitor.restart(RuntimeError('a fault'))
    monitor.push(t[:50], v[:50], u[:50])
    assert monitor.report(0.0).load.status is LoadStatus.STILL


def test_a_file_without_it_is_as_before():
    text = as_yaml(ModelFile(SupplyModel((OU(63.0, 0.3, 16.0),))))
    assert 'load' not in text and parse_model(yaml.safe_load(text), 'file').model.load is None


@pytest.mark.parametrize('change, words', [
    ({'coefficients': [1.0]}, '10 coefficients'), ({'volts': 0.0}, 'above 0'),
    ({'cells': 'four'}, 'number'), ({'sag': 1.0}, "no entry 'sag'"), ({'delay': 9.0}, 'delay'),
    ({'flown': [0.5, 0.2]}, 'flown'), ({'discharge': float('nan')}, 'finite'),
    ({'covariance': (-np.eye(10)).tolist()}, 'negative'), ({'log_variance': [0.0]}, '3 numbers')])
def test_a_broken_entry_is_refused_by_name(learned, change, words):
    data = yaml.safe_load(as_yaml(ModelFile(SupplyModel((OU(63.0, 0.3, 16.0),), learned))))
    data['load'].update(change)
    with pytest.raises(InputError, match=words):
        parse_model(data, 'file')


def test_nothing_is_learned_of_nothing(learned):
    loads = LoadFilter()
    assert loads.learned() is None
    t = np.arange(0.0, 10.0, 0.02)
    loads.push(t, 16.0 + 0.0 * t, 0.3)
    assert loads.learned() is None
    with pytest.raises(ValueError, match='lacks'):
        LoadStart.read({'cells': 4})
