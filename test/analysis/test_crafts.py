"""The number of cells of a pack, and a comparison of its supply with those of known crafts."""

from dataclasses import replace
import json

import numpy as np
from ou_monitor.analysis.crafts import (
    _measure, cells_of, craft_advice, craft_line, craft_of, doubtful_cells, KNOWN, likely_cells,
    MICRO, QUAD, ROBOT, stated_limit)
from ou_monitor.analysis.overview import answers, overview
from ou_monitor.analysis.supply import supply_facts
from ou_monitor.cli.main import main
from ou_monitor.records import NAN, Recording
import pytest


def flown(cells=4, sag=0.6, noise=0.08, source=None, n=1500):
    """Return a recording of a pack with a sag and a noise at half throttle, V."""
    rng = np.random.default_rng(3)
    t = np.arange(n) / 50.0
    u = np.repeat(rng.uniform(0.1, 0.85, n // 25), 25)
    v = 4.1 * cells - 2.0 * sag * u + noise * rng.standard_normal(n)
    return Recording(t, v, u, 'made', source or {}, (), None)


@pytest.mark.parametrize('volts, cells', [
    (4.2, 1), (3.6, 1), (8.4, 2), (11.1, 3), (12.6, 3), (16.8, 4), (15.2, 4), (17.4, 4),
    (22.59, 6), (25.2, 6), (26.1, 6), (22.1, 6), (30.3, 7), (39.1, 10), (49.0, 12), (0.0, 0),
    (NAN, 0), (3.31, 0), (5.0, 0), (6.05, 0), (9.1, 0), (10.1, 0), (12.0, 3), (100.8, 24),
    (400.0, 0), (16500.0, 0)])
def test_cells_are_guessed_by_the_voltage(volts, cells):
    """Those of 3.8 to 4.25 V, else near it; most rails are no packs, but 12 V may be."""
    assert likely_cells(volts) == ((cells,) if cells else ())


def test_cells_that_the_voltage_cannot_tell_are_unknown():
    wheel = replace(flown(cells=16), throttle=None)
    assert likely_cells(67.2) == (16, 17) and cells_of(wheel) == (0, 'unknown')
    assert '16 or 17 cells' in craft_line(craft_of(wheel, supply_facts(wheel)))


def test_given_cells_override_the_log_and_the_log_the_guess():
    """What is given goes before the log, the log before the voltage."""
    log = {'cells': '6', 'cell_minimum': '3.5'}
    assert cells_of(flown(source=log), 3) == (3, 'given')
    assert cells_of(flown(source=log)) == (6, 'log')
    assert cells_of(flown()) == (4, 'guessed')
    assert stated_limit(log) == (6, 21.0) and stated_limit({'log_cells': '4'}) is None
    for cells, low in (('4', 'nan'), ('4', 'x'), ('4', '1e9'), ('x', '3.5'), ('9' * 9, '3.5')):
        assert stated_limit({'log_cells': cells, 'log_cell_minimum': low}) is None


@pytest.mark.parametrize('volts, other', [
    (13.2, '4 of LiFePO4'), (26.6, '8 of LiFePO4'), (12.6, ''), (16.5, ''), (25.2, '')])
def test_cells_of_the_other_chemistry(volts, other):
    """Where a usual pack of LiFePO4 rests at that voltage."""
    one = flown(cells=1)
    one = replace(one, voltage=volts - 0.1 * one.throttle + 0.01 * (one.voltage - 4.1))
    said = craft_line(craft_of(one, supply_facts(one)))
    assert 'of LiPo (from the voltage)' in said and ('LiFePO4' in said) == bool(other)
    assert other in said and 'LiPo' not in craft_line(craft_of(one, supply_facts(one), 6))


def test_a_voltage_alone_does_not_make_a_pack():
    """A rail of 24 V looks like six cells; no throttle, no comparison."""
    rail = replace(flown(cells=6), throttle=None)
    facts = supply_facts(rail)
    assert craft_line(craft_of(rail, facts)).startswith('if it is a pack: 6 cells of LiPo')
    assert craft_line(craft_of(rail, facts, 6)).startswith('6 cells, no class known')
    assert craft_line(craft_of(replace(rail, voltage=1e3 * rail.voltage), facts)) == ''
    # Nor does a comparison of its noise, if the supply does not sag as a pack.
    for sag, maybe in ((0.0, True), (1e-3, True), (0.8, False)):
        one = flown(cells=6, sag=sag)
        line = craft_line(craft_of(one, supply_facts(one)))
        assert 'noise' in line and line.startswith('if it is a pack: 6 cells') == maybe


@pytest.mark.parametrize('full, cells, doubt', [
    (16.6, 6, 'has 4 cells, not 6'), (16.6, 5, 'has 4 cells, not 5'), (16.6, 4, ''), (2.9, 1, ''),
    (18.1, 6, 'has 5 cells, not 6'), (21.5, 6, ''), (13.0, 5, 'has 3 cells, not 5'), (5.3, 2, ''),
    # Four full cells of LiFePO4 have as much as three of LiPo.
    (13.2, 4, '')])
def test_a_count_that_hardly_fits_is_doubted(full, cells, doubt):
    """Below 3.5 V per cell at rest, where fewer cells would have a usual voltage."""
    found = doubtful_cells(full, cells)
    assert doubt in found and bool(found) == bool(doubt)


def test_values_are_called_usual_high_or_low():
    """Against the median of a class, a cell; a reason and a remedy where it is not usual."""
    middle = {name: np.nanmedian([row[k] / row[0] for row in KNOWN[QUAD].values()])
              for k, name in ((1, 'sag'), (2, 'noise'))}
    for factor, verdict in ((1.0, 'usual'), (3.0, 'high'), (0.25, 'low')):
        for name in ('sag', 'noise'):
            quiet = {'sag': 4.0 * middle['sag'], 'noise': 0.4 * middle['noise']}
            one = flown(**{**quiet, name: 4.0 * factor * middle[name]})
            facts = supply_facts(one)
            craft = craft_of(one, facts)
            assert (craft.cells, craft.cells_from, craft.kind) == (4, 'guessed', QUAD)
            found = {measure.name: measure for measure in craft.measures}
            assert found['resistance'].verdict == 'unknown'
            assert found[name].verdict == verdict, (name, found[name])
            assert found[name].value == pytest.approx(factor * middle[name], rel=0.25)
            assert bool(found[name].remedy) == (verdict != 'usual')
            known = craft_of(one, facts, 4)
            assert f'is {verdict}' in craft_line(known) and not craft_advice(craft)
            assert [found[name].remedy in said for said in craft_advice(known)] == (
                [True] if verdict == 'high' else [])
    for cells in (7, 10):
        wheel = flown(cells=cells)
        craft = craft_of(wheel, supply_facts(wheel))
        assert craft.measures == () and 'no class known' in craft_line(craft)
    micro = flown(cells=1, sag=0.1, noise=0.02)
    found = craft_of(micro, supply_facts(micro))
    assert found.kind == MICRO
    assert {one.name: one.verdict for one in found.measures} == {'sag': 'usual', 'noise': 'high'}


@pytest.mark.parametrize('steady, verdict', [(0.02, 'unknown'), (0.5, 'high')])
def test_noise_of_changes_alone_is_not_called_high(steady, verdict):
    """A load model that follows changes badly is no lack of a capacitor."""
    recording = flown(noise=0.9)
    facts = supply_facts(recording)
    facts = replace(facts, noise=replace(facts.noise, steady_rms_v=(steady,) * 11))
    found = [one for one in craft_of(recording, facts, 4).measures if one.name == 'noise']
    assert [one.verdict for one in found] == [verdict]
    assert bool(found[0].remedy) == (verdict == 'high')


def test_twelve_volts_of_an_unknown_vehicle_may_be_a_robots():
    """Both classes are compared then; a flight controller's log, or given cells, decides."""
    small = flown(cells=3, sag=0.08, noise=0.012)
    craft = craft_of(small, supply_facts(small))
    assert craft.kind == ''
    assert {(one.kind, one.name): one.verdict for one in craft.measures if one.name != 'resistance'
            } == {(QUAD, 'sag'): 'low', (QUAD, 'noise'): 'low',
                  (ROBOT, 'sag'): 'usual', (ROBOT, 'noise'): 'usual'}
    assert f'or class "{ROBOT}": sag' in craft_line(craft)
    for one, given in ((small, 3), (replace(small, source={'format': 'blackbox'}), 0)):
        assert craft_of(one, supply_facts(one), given).kind == QUAD


def test_a_sag_that_its_error_hides_is_neither_judged_nor_said():
    """As of a robot whose log has a flag for a throttle: 8 mV a cell, +- volts, is not low."""
    one = flown(noise=0.3)
    facts = supply_facts(one)
    assert 'The rail sags by' in ' '.join(answers(overview(one)))
    hidden = replace(facts, sag=replace(facts.sag, sag_v=(0.03,) * 11, se_v=(1.0,) * 11))
    craft = craft_of(one, hidden)
    assert {one.name: one.verdict for one in craft.measures} == {
        'sag': 'unknown', 'noise': 'usual', 'resistance': 'unknown'}
    assert 'sag' not in craft_line(craft)
    said = ' '.join(answers(replace(overview(one), facts=hidden)))
    assert 'is below 2.03 V' in said and 'sags' not in said


@pytest.mark.parametrize('value, reach, verdict', [
    (3.0, 0.5, 'high'), (3.0, 1.5, 'unknown'), (0.2, 0.1, 'low'), (0.2, 0.5, 'unknown'),
    (1.0, 0.9, 'usual'), (1.0, 1.1, 'unknown'), (NAN, NAN, 'unknown'), (1.0, NAN, 'unknown')])
def test_a_verdict_is_by_the_interval(value, reach, verdict):
    """Usual is 0.5 to 2: beyond it with the whole interval, or in it with half of one."""
    assert _measure(QUAD, 'sag', value, reach, 1.0).verdict == verdict


def test_impossible_cells_are_refused_with_the_likely_number(tmp_path, capsys):
    path = tmp_path / 'a.csv'
    one = flown(n=600)
    path.write_text('time_s,voltage_v,throttle\n' + ''.join(
        f'{a:.3f},{b:.4f},{c:.4f}\n' for a, b, c in zip(one.t, one.voltage, one.throttle)))
    # Seven cells would be lead-acid, 2.3 V each.
    for cells in ('3', '7', '9'):
        assert main(['analyze', str(path), '--cells', cells]) == 2
        assert 'it is likely 4 cells (lithium); for lead-acid' in capsys.readouterr().err
    assert main(['analyze', str(path), '--cells', '4', '--json', '-']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['craft']['cells'] == 4 and found['craft']['cells_from'] == 'given'
    assert [measure['name'] for measure in found['craft']['measures']] == [
        'sag', 'noise', 'resistance']
