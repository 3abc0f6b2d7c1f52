"""The list of all doubts about a recording: each is found, named and ranked."""

from dataclasses import replace
import math
import pickle

import numpy as np
from ou_monitor.analysis.quality import quality_list, QualityItem
from ou_monitor.records import (
    Defect, defect_of, Estimate, Flag, Note, prefixed, Recording, Severity, Status)
from ou_monitor.timeline import in_order, pause_words, readings_of
import pytest
from simulated_recordings import recording

GOOD = Estimate(alpha=63.0, sigma=0.3, var_inf=7e-4, u0=5.0, noise_std=0.0, status=Status.OK)
# A clock that went back once, by 2 s of 900 samples.
BACK = np.concatenate((np.arange(900.0), np.arange(900.0) - 1.5)) / 450.0


def listed(simulated, estimates=(GOOD,)):
    return quality_list(simulated, [0.1] * len(estimates), estimates,
                        pauses=pause_words(simulated.t))


def names(items):
    return {item.name: item.severity for item in items}


def test_a_clean_recording_has_an_empty_list():
    """Nothing is raised where nothing is wrong."""
    assert listed(recording(1, ((0.1, 0.3),))) == ()


def test_worst_comes_first_and_levels_share_an_entry():
    bad = Estimate(status=Status.CONSTANT)
    flagged = replace(GOOD, flags=(Flag.QUANTIZED, Flag.HELD_SAMPLES))
    items = quality_list(recording(1, ((0.1, 0.3),)), [0.1, 0.2, 0.3], [flagged, bad, flagged])
    assert [(item.name, item.severity, item.throttles) for item in items] == [
        ('CONSTANT', Severity.ERROR, (0.2,)), ('QUANTIZED', Severity.WARNING, (0.1, 0.3)),
        ('HELD_SAMPLES', Severity.INFO, (0.1, 0.3))]


@pytest.mark.parametrize('status', [
    Status.NO_RELAXATION, Status.BURIED, Status.TOO_SHORT, Status.UNBOUND, Status.TOO_FEW_SAMPLES])
def test_the_rate_or_length_of_a_recording_is_no_fault(status):
    """A limit is information; where the whole shows alpha, the level does not deny it."""
    bad = [Estimate(status=status)]
    (item,) = listed(recording(1, ((0.1, 0.3),)), bad)
    assert (item.name, item.severity, item.text) == (status.name, Severity.INFO, status.value)
    (item,) = quality_list(recording(1, ((0.1, 0.3),)), [0.1], bad, known=True)
    assert item.severity is Severity.INFO and item.name == 'LEVEL_ALONE'


@pytest.mark.parametrize('defect', Defect)
def test_a_note_is_judged_by_what_it_is_about(defect):
    """Not by its words, also led by a name; a bare sentence is good to know."""
    text = 'The damaged bag has gaps.'
    for note in (Note(text, defect), *prefixed('vbat', [Note(text, defect)])):
        simulated = replace(recording(1, ((0.1, 0.3),)), notes=(note,))
        (item,) = listed(simulated)
        assert (item.name, item.severity, item.text) == (defect.name, defect.severity, note)
        assert defect_of(pickle.loads(pickle.dumps(note))) is defect
    (item,) = listed(replace(simulated, notes=(text,)))
    assert (item.name, item.severity) == ('READER', Severity.INFO)


def test_the_stage_of_samples_says_what_it_notes():
    t = np.array([0.0, 2.0, 1.0, 1.0, 3.0, 4.0])
    notes = in_order(t, np.array([1.0, 1.0, 1.0, 1.0, math.nan, 1.0])[:, None], 1e6)[1]
    assert {defect_of(note) for note in notes} == {
        Defect.UNORDERED, Defect.REPEATED_STAMPS, Defect.NON_FINITE}
    (back, *_) = in_order(BACK, BACK[:, None], 1e6)[1]
    assert defect_of(back) is Defect.UNORDERED


@pytest.mark.parametrize('factor, named', [
    (1.0, None), (80.0, None), (1e3, 'VOLTAGE_UNIT'), (3e3, 'VOLTAGE_UNIT'),
    (-1.0, 'VOLTAGE_SIGN'), (1e-300, None)])
def test_voltages_of_no_supply_are_called_so(factor, named):
    """A rail of 5 V, a battery of 400 V; 5000 and 15000 are no volts, nor is -5."""
    simulated = recording(3, ((0.1, 0.3),))
    lattice = 0.005 * np.round(simulated.voltage / 0.005)
    items = names(listed(replace(simulated, voltage=factor * lattice)))
    assert [name for name in items if name.startswith('VOLTAGE')] == [named] * (named is not None)
    assert items.get(named, Severity.WARNING) is Severity.WARNING


@pytest.mark.parametrize('low, high, named', [
    (0.0, 1.0, False), (-0.04, 1.04, False), (-0.4, 1.0, True), (0.0, 1.3, True)])
def test_a_throttle_outside_of_its_range_is_called_so(low, high, named):
    """Reverse thrust, or a stick that goes both ways; a little beyond is trim."""
    simulated = recording(3, ((0.1, 0.3),))
    items = names(listed(replace(simulated, throttle=np.linspace(low, high, simulated.n))))
    assert (items.get('THROTTLE_RANGE') is Severity.WARNING) == named


def test_pauses_and_an_uneven_clock_are_measured():
    """A pause of 2 s; stamps off by 10 % of a step at random."""
    simulated = recording(2, ((0.1, 0.3),))
    (item,) = listed(replace(simulated, t=simulated.t + 2.0 * (simulated.t > 5.0)))
    assert item.name == 'PAUSES' and '1 pause without' in item.text and '2 s' in item.text
    shaken = simulated.t + np.random.default_rng(1).uniform(-1e-4, 1e-4, simulated.n)
    (item,) = listed(replace(simulated, t=shaken))
    # Two independent uniform errors of +-10 %: 0.1 sqrt(2/3) = 8 %.
    assert item.name == 'UNEVEN_CLOCK' and ' 8.1 %' in item.text


def test_the_samples_show_the_step_of_the_adc():
    """A lattice of 5 mV, repeats of four, a rail at 5.03 V, and throttle that comes late."""
    simulated = recording(3, ((0.1, 0.3),))
    step = listed(replace(simulated, voltage=0.005 * np.round(simulated.voltage / 0.005)))
    assert names(step) == {'ADC_STEP': Severity.INFO} and 'is 5 mV' in step[0].text
    held = listed(readings_of(replace(
        simulated, voltage=np.repeat(simulated.voltage[::4], 4))))
    assert names(held) == {'READER': Severity.INFO} and 'repeats were left' in held[0].text
    clipped = listed(replace(simulated, voltage=np.minimum(simulated.voltage, 4.98)))
    assert names(clipped) == {'CLIPPED': Severity.WARNING}
    late = simulated.throttle.copy()
    late[:100] = np.nan
    assert names(listed(Recording(simulated.t, simulated.voltage, late))) == {
        'THROTTLE_UNKNOWN': Severity.INFO}


def test_the_same_doubt_of_two_levels_is_one_item():
    twice = [QualityItem('LINES', Severity.INFO, 'Same.', (u,)) for u in (0.1, 0.4)]
    (item,) = quality_list(recording(1, ((0.1, 0.3),)), [0.1], [GOOD], twice)
    assert item.throttles == (0.1, 0.4)
