"""The report and the words of a fleet: complete, escaped, and present even if little is known."""

from dataclasses import replace
import xml.etree.ElementTree as ElementTree

import numpy as np
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import judge
from ou_monitor.fleet.table import NAMES
from ou_monitor.report.fleet_document import (
    answer, as_data, change, finding_words, fleet_document, lowest_table, pack_table,
    short_names, trend_words, vehicle_table, worst)
from ou_monitor.report.page import html
import pytest
from simulated_fleets import table


def fleet(rows: list[dict]) -> Fleet:
    """Return a fleet of rows; what a row leaves out is not known."""
    whole = [{**dict.fromkeys(NAMES), 'recording': 'r', **row} for row in rows]
    return Fleet(whole, judge(whole), ('Vehicles: by <hand> & eye.',),
                 len({row['path'] for row in whole}))


@pytest.fixture(scope='module')
def odd() -> Fleet:
    """Return a fleet with a drift, an odd vehicle, an odd flight, a failure and a copy."""
    rows = table(np.random.default_rng(1), 12, 10, drift={2: 0.08}, odd_vehicles={4: 2.5},
                 odd_flights={(6, 3): 1.2})
    for row in rows:
        row['vehicle'] = row['vehicle'].replace('uav2', '<b>uav2</b> & co')
    return fleet([*rows, {'path': '/f/bad', 'error': '/f/bad is no <bag>'},
                  {'path': '/f/copy', 'duplicate_of': '/f/uav1/1'}])


def page_text(simulated: Fleet) -> str:
    """Return the text of the report, which is well-formed."""
    page = html(fleet_document(simulated), "ou-monitor fleet 'a <b>'")
    root = ElementTree.fromstring(page.split('\n', 1)[1])
    return ' '.join(' '.join(root.itertext()).split())


def test_the_page_tells_what_stands_out(odd):
    """Each finding, each failure and each copy is on it; nothing of a name becomes HTML."""
    text = page_text(odd)
    found = finding_words(odd)
    assert len(found) >= 3
    for sentence in (*found, fleet_document(odd).headline, '/f/bad is no <bag>',
                     '/f/copy is /f/uav1/1',
                     'Vehicles: by <hand> & eye.', "ou-monitor fleet 'a <b>'"):
        assert ' '.join(sentence.split()) in text
    for words in ('Drift over the flights: <b>uav2</b> & co.', 'rest of the fleet: uav4.',
                  'other flights of their vehicle: 1 recording.'):
        assert words in fleet_document(odd).headline


def test_an_interval_without_zero_is_never_nothing():
    """Three packs with four flights: one may age, but not for certain among all tests."""
    few = fleet(table(np.random.default_rng(4), 3, 4, ageing={1: 0.08}))
    assert not few.judgement.drifting and {t.vehicle for t in few.judgement.possible} == {'uav1'}
    first = answer(few)[0]
    for trend in few.judgement.possible:
        assert f'{trend.quantity} {change(trend.slope)}' in first and trend_words(
            trend) in page_text(few)
    assert 'uav1' in first and 'not certain among 12 tests' in first
    assert 'Nothing stands out.' not in fleet_document(few).headline


def test_stars_mark_significant_values_only(odd):
    """The drifting vehicle at its slope, the odd one at its median; no star elsewhere."""
    made = vehicle_table(odd)
    heads, rows = made.heads, made.rows
    assert 'dips' not in heads
    at = heads.index('sigma, V/sqrt(s)')
    cells = {row[0]: row for row in rows}
    assert '*\n[' in cells['<b>uav2</b> & co'][at + 1] and cells['uav4'][at].endswith('*')
    assert sum('*' in cell for row in cells.values() for cell in row) == 2


def test_plain_data_agrees(odd):
    data = as_data(odd)
    assert [(d['vehicle'], d['quantity']) for d in data['drift'] if d['significant']] == [
        ('<b>uav2</b> & co', 'sigma')]
    assert {(o['what'], o['vehicle'], o['path']) for o in data['outliers']} == {
        ('vehicle', 'uav4', None), ('recording', 'uav6', '/f/uav6/3')}


@pytest.mark.parametrize('rows, words', [
    ([{'path': '/f/bad', 'error': 'no bag'}], 'could not be'),
    (table(np.random.default_rng(2), 1, 1), 'too few recordings per vehicle'),
    ([{'path': '/f/a', 'vehicle': 'v', 'flight': 1, 'status': 'TOO_SHORT', 'flags': ['TREND']}],
     'no estimate of sigma at any level'),
    ([{**row, 'vehicle': None, 'flight': None} for row in table(
        np.random.default_rng(3), 1, 8)], 'too few recordings per vehicle'),
])
def test_fleets_with_little_data_have_a_report(rows, words):
    simulated = fleet(rows)
    assert words in fleet_document(simulated).headline and words in page_text(simulated)


def seen(path: str, vehicle: str, lowest: float, dips: int | None, **more) -> dict:
    return {'path': path, 'recording': path, 'vehicle': vehicle, 'lowest': lowest,
            'lowest_at': 12.0, 'dips': dips, 'below_s': None if dips is None else 0.1 * dips,
            **more}


def test_the_lowest_voltage_comes_first():
    rows = [seen('a', 'quad', 14.2, 0, sag=1.2, sag_se=0.1, sag_throttle=0.9),
            seen('b', 'quad', 13.1, 3, lowest_throttle=0.8, sag=1.9, sag_se=0.2,
                 sag_throttle=0.95), seen('c', 'hexa', 13.4, 1)]
    known = replace(fleet(rows), limit=13.5)
    assert fleet_document(known).headline.startswith(
        '4 dips below 13.5 V, 0.40 s in all, in 2 of 3 recordings, most in b (quad), 3: the '
        'lowest was 13.10 V at 12.0 s of b (quad), at 80 % throttle. The rail sags by up to '
        '1.90 V, at 95 % throttle in b (quad).')
    assert [row['path'] for row in worst(known)] == ['b', 'c', 'a']
    text = page_text(known)
    assert text.index('4 dips below') < text.index('Lowest voltages') < text.index('Vehicles')
    made = vehicle_table(known)
    assert made.heads == ['vehicle', 'flights', 'lowest, V', 'dips']
    assert made.rows[0] == ['hexa', '0', '13.40', '1']
    made = lowest_table(known, 2)
    assert [row[made.heads.index('vehicle')] for row in made.rows] == ['quad', 'hexa']
    assert as_data(known)['brownout_voltage'] == 13.5


def test_packs_have_their_resistance_per_cell():
    """5 mOhm a cell, of one growing; without its cells a value is marked as that of the pack."""
    rows = [{**row, 'cells_from': 'guessed'}
            for row in table(np.random.default_rng(8), 2, 8, ageing={1: 0.1})]
    packs, unknown = (pack_table(fleet([{**row, **more} for row in rows]))
                      for more in ({}, {'cells': None}))
    assert [(row[0], row[2]) for row in packs.rows] == [('uav0', '4?'), ('uav1', '4?')]
    assert float(packs.rows[0][3]) == pytest.approx(5.0, rel=0.1)
    assert '*' in packs.rows[1][4] and '*' not in packs.rows[0][4]
    assert ['(pack)' in ' '.join(row) for row in (*packs.rows, *unknown.rows)] == [
        False, False, True, True]


def test_packs_of_other_cells_are_compared_per_cell():
    """3.9 V of one cell are more than 13.2 V of four."""
    mixed = fleet([seen('a', 'quad', 13.2, None, cells=4), seen('b', 'micro', 3.9, None, cells=1)])
    assert [row['path'] for row in worst(mixed)] == ['a', 'b']
    made = lowest_table(mixed)
    assert made.heads[2:4] == ['lowest, V', 'per cell, V']
    assert [row[3] for row in made.rows] == ['3.300', '3.900']
    assert fleet_document(mixed).headline.startswith(
        'The lowest voltage was 3.300 V per cell (13.20 V, 4 cells) at 12.0 s of a (quad).')


def test_many_dips_do_not_go_before_a_lower_voltage():
    rows = [seen('a', 'quad', 13.4, 9), seen('b', 'quad', 12.1, 1), seen('c', 'quad', 14.2, 0)]
    known = replace(fleet(rows), limit=13.5)
    made = lowest_table(known)
    assert [row[made.heads.index('lowest, V')] for row in made.rows] == ['12.10', '13.40', '14.20']
    assert 'most in a (quad), 9: the lowest was 12.10 V' in fleet_document(known).headline


def test_long_names_are_cut_where_they_stay_apart():
    """A serial number loses its middle, unless two would look the same."""
    board = 'CUBEPILOT_CUBEORANGE 0006000000003836'
    names = ['uav1', board + '38393239510d', board + '38393239510e', board + 'x' + 'y' * 16,
             board + 'z' + 'y' * 16]
    found = short_names(names)
    assert found['uav1'] == 'uav1' and found[names[1]] == 'CUBEPILOT_CUB\u2026383638393239510d'
    assert len(set(found.values())) == 5 and found[names[3]] == names[3]
