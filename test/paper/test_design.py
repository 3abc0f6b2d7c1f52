"""The capacitance for a target risk: the root, the verdicts, the two risks, monotonicity."""

from dataclasses import replace
import math

import numpy as np
from ou_monitor.model.passage import mean_first_passage
from ou_monitor.paper.design import (
    answer, design, DesignVerdict, row_of, with_capacitance)
from ou_monitor.paper.network import PowerNetwork, rail_at
from ou_monitor.report.design_document import design_document
from ou_monitor.report.terminal import terminal
import pytest

QUESTION = {'voltage': 19.8, 'horizon': 5.0, 'risk': 1e-3}


def test_the_least_capacitance_meets_the_risk_and_less_does_not():
    network = PowerNetwork()
    result = design(network, 0.4, **QUESTION)
    assert result.verdict is DesignVerdict.FOUND
    assert result.least.risk <= 1e-3
    assert result.least.risk == pytest.approx(1e-3, rel=1e-6)
    less = with_capacitance(network, 0.99 * result.least.capacitance)
    assert row_of(rail_at(less, 0.4), 19.8, 5.0).risk > 1.05e-3
    assert result.present.capacitance == 470e-6 and result.present.risk > 0.99


def test_adding_a_capacitor_lowers_alpha_and_the_variance():
    result = design(PowerNetwork(), 0.4, **QUESTION)
    table = np.array([[r.alpha, r.var_inf, r.risk] for r in result.rows])
    assert (np.diff(table, axis=0) <= 0.0).all() and result.falls
    assert {(r.sag, r.mean) for r in result.rows} == {(result.present.sag, result.present.mean)}
    assert result.present.alpha == pytest.approx(30391.0, rel=1e-4)
    assert result.present.var_inf == pytest.approx(0.161, rel=1e-2)


def test_a_row_is_the_ou_of_the_rail():
    row = design(PowerNetwork(), 0.3, **QUESTION).present
    assert row.tau * row.alpha == pytest.approx(1.0)
    assert row.sigma**2 == pytest.approx(2.0 * row.alpha * row.var_inf)
    barrier = (row.mean - 19.8) / math.sqrt(row.var_inf)
    assert row.mean_time == pytest.approx(mean_first_passage(0.0, barrier) / row.alpha)
    assert row.risk_ou == pytest.approx(1.0 - math.exp(-5.0 / row.mean_time))
    assert row.risk_crossing == pytest.approx(1.0 - math.exp(-5.0 * row.crossing_rate))
    assert row.risk == max(row.risk_ou, row.risk_crossing)
    assert row.rate == max(1.0 / row.mean_time, row.crossing_rate)


def test_a_capacitor_that_is_large_enough_is_said_so():
    result = design(PowerNetwork(), 0.1, **QUESTION)
    assert result.verdict is DesignVerdict.ENOUGH
    # The end of the range is no minimum.
    assert result.least is None and result.rows[0].risk <= 1e-3
    assert 'No more capacitance is needed' in answer(result)


def test_all_risks_are_those_of_the_flight():
    """Of throttle, share of the sag and of the noise; no change is needed below the target."""
    def flown(throttle, sag, noise):
        return min(1.0, 0.02 * throttle * sag ** 4 * (0.5 + 0.5 * noise))

    found = design(PowerNetwork(), 0.1, **{**QUESTION, 'risk': 1e-3}, flown=flown)
    bulk, packs, ohm, limit = found.levers
    assert found.present.risk == pytest.approx(0.002) and found.verdict is not DesignVerdict.ENOUGH
    assert limit.risk == pytest.approx(0.0016) and limit.least == pytest.approx(5.0, rel=0.01)
    assert packs.risk == pytest.approx(0.002 / 16.0) and packs.least == 2
    assert ohm.least / ohm.present == pytest.approx(0.5 ** 0.25, rel=0.01)
    assert found.rows[-1].risk <= bulk.risk < found.present.risk
    enough = design(PowerNetwork(), 0.1, **{**QUESTION, 'risk': 0.01}, flown=flown)
    assert enough.verdict is DesignVerdict.ENOUGH
    noise = enough.rows[-1].var_inf / enough.present.var_inf
    assert enough.rows[-1].risk == pytest.approx(flown(0.1, 1.0, noise)) and noise < 0.9
    assert all(lever.least == lever.present for lever in enough.levers)


def test_a_smaller_resistance_is_never_riskier():
    """Where an estimate says so, because a smaller sag leaves more of the level's error."""
    found = design(PowerNetwork(), 0.1, **QUESTION, flown=lambda u, sag, noise: 0.3 - 0.05 * sag)
    assert {lever.risk for lever in found.levers[1:3]} == {found.present.risk}


def test_a_fixed_esr_may_leave_no_capacitance():
    result = design(PowerNetwork(), 0.4, esr_follows=False, **QUESTION)
    assert result.verdict is DesignVerdict.OUT_OF_RANGE and result.least is None
    assert 'What would help: 2 packs in parallel' in answer(result)
    wide = design(PowerNetwork(), 0.4, esr_follows=False, capacitances=(10e-6, 0.1), **QUESTION)
    assert wide.rows[-1].alpha > wide.present.alpha
    for falls in (True, False):
        said = terminal(design_document(replace(wide, falls=falls), 'given'))
        assert ('does not always lower the risk' in said) is not falls


def test_no_capacitor_helps_below_the_level():
    result = design(PowerNetwork(), 0.9, **QUESTION)
    assert result.verdict is DesignVerdict.LEVEL and result.least is None
    assert result.present.risk == 1.0 and result.present.mean_time == 0.0
    assert 'open-circuit' not in answer(result)


def test_a_level_above_the_battery_is_said_so():
    result = design(PowerNetwork(), 0.4, voltage=23.0, horizon=5.0, risk=1e-3)
    assert result.verdict is DesignVerdict.LEVEL
    assert 'The limit is at or above the open-circuit' in answer(result)
    regulated = design(PowerNetwork(), 0.4, rail='regulated', voltage=5.0, horizon=5.0, risk=1e-3)
    assert regulated.verdict is DesignVerdict.LEVEL and 'regulator_voltage' in answer(regulated)


def test_without_throttle_there_is_no_noise():
    result = design(PowerNetwork(), 0.0, **QUESTION)
    assert result.verdict is DesignVerdict.ENOUGH and result.present.risk == 0.0
    assert math.isinf(result.present.mean_time) and result.present.sigma == 0.0
    assert result.present.var_inf == 0.0


@pytest.mark.parametrize('changed, words', [
    ({'risk': 0.0}, 'risk must be between'), ({'risk': 1.0}, 'risk must be between'),
    ({'risk': math.nan}, 'risk must be between'), ({'horizon': 0.0}, 'horizon must be positive'),
    ({'voltage': math.nan}, 'voltage must be positive'),
    ({'voltage': -1.0}, 'voltage must be positive'),
    ({'capacitances': (1e-3, 1e-4)}, 'minimum capacitance must be below'),
    ({'capacitances': (0.0, 1e-4)}, 'minimum capacitance must be positive'),
    ({'capacitances': (1e-5, math.inf)}, 'maximum capacitance must be positive'),
    ({'rail': 'motor'}, 'rail must be')])
def test_bad_questions_are_refused(changed, words):
    with pytest.raises(ValueError, match=words):
        design(PowerNetwork(), 0.4, **{**QUESTION, **changed})
