"""A supply that runs piece by piece: one path, an old pack, a pack that empties."""

import numpy as np
from ou_monitor.model.load import charge_at, LoadStart, open_circuit
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_answer import LoadSag, LoadTransient
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.model.terms.slow import Drift
from ou_monitor.simulation import lacks, PRESETS, read_profile, RunningSupply, simulated
import pytest

FLIGHT = PRESETS['flight_full'].model
LOAD = LoadStart(4.0, 15.6, (1.0,) * 7, tuple(map(tuple, np.eye(7).tolist())), 0.01,
                 (-8.0, 0.0, 0.0), (0.1, 0.9))
PACK = SupplyModel((OU(5.0, 0.0, 15.6), Drift(-0.01, 0.0), LoadSag(2.0, 0.5),
                    LoadTransient(-1.0, 0.1, 0.0)), LOAD)


def test_step_by_step_equals_one_batch():
    """Whatever the pieces: the path of `simulated`, with the same seed."""
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
