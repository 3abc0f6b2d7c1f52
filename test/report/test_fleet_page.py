"""The report and the words of a fleet: complete, escaped, and there also when little is known."""

import xml.etree.ElementTree as ElementTree

import numpy as np
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import judge
from ou_monitor.fleet.summary import (
    as_data, change, finding_words, headline, short_names, vehicle_rows)
from ou_monitor.fleet.table import NAMES
from ou_monitor.report.fleet_page import fleet_page
import pytest
from simulated_fleets import table


def fleet(rows: list[dict]) -> Fleet:
    """Return a fleet of rows; what a row leaves out is not known."""
    whole = [{**dict.fromkeys(NAMES), 'recording': 'r', **row} for row in rows]
    return Fleet(whole, judge(whole), ('Vehicles: by <hand> & eye.',),
                 len({row['path'] for row in whole}), 0)


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
    page = fleet_page(simulated, "ou-monitor fleet 'a <b>'")
    root = ElementTree.fromstring(page.split('\n', 1)[1])
    return ' '.join(' '.join(root.itertext()).split())


def test_the_page_tells_what_stands_out(odd):
    """Each finding, each failure and each copy is on it; nothing of a name becomes HTML."""
    text = page_text(odd)
    found = finding_words(odd)
    assert len(found) >= 3
    for sentence in (*found, headline(odd), '/f/bad: is no <bag>', '/f/copy is /f/uav1/1',
                     'Vehicles: by <hand> & eye.', "ou-monitor fleet 'a <b>'"):
        assert ' '.join(sentence.split()) in text
    for words in ('Drift over the flights: <b>uav2</b> & co.', 'rest of the fleet: uav4.',
                  'other flights of their vehicle: 1 recording.'):
        assert words in headline(odd)


def test_stars_mark_what_stands(odd):
    """The drifting vehicle at its slope, the odd one at its median; no star elsewhere."""
    cells = {row[0]: row for row in vehicle_rows(odd)}
    assert cells['<b>uav2</b> & co'][3].endswith('*') and cells['uav4'][2].endswith('*')
    assert sum('*' in cell for row in cells.values() for cell in row) == 2


def test_plain_data_agrees(odd):
    """The JSON names the same drift and the same outliers."""
    data = as_data(odd)
    assert [(d['vehicle'], d['quantity']) for d in data['drift'] if d['stands']] == [
        ('<b>uav2</b> & co', 'sigma')]
    assert {(o['what'], o['vehicle'], o['path']) for o in data['outliers']} == {
        ('vehicle', 'uav4', None), ('recording', 'uav6', '/f/uav6/3')}


@pytest.mark.parametrize('rows, words', [
    ([{'path': '/f/bad', 'error': 'no bag'}], 'could not be'),
    (table(np.random.default_rng(2), 1, 1), 'too few recordings a vehicle'),
    ([{'path': '/f/a', 'vehicle': 'v', 'flight': 1, 'status': 'TOO_SHORT', 'flags': ['TREND']}],
     'no estimate at any level'),
    ([{**row, 'vehicle': None, 'flight': None} for row in table(
        np.random.default_rng(3), 1, 8)], 'too few recordings a vehicle'),
])
def test_little_is_known(rows, words):
    """A fleet of failures, of one recording, without estimates or vehicles has its report."""
    simulated = fleet(rows)
    assert words in headline(simulated) and words in page_text(simulated)


def test_changes_have_their_unit():
    """Percent of what has a logarithm, a factor where it is large, mV of sag."""
    assert [change('sigma', value) for value in (0.0296, -0.4, 1.2, float('nan'))] == [
        '+3 %', '-33 %', 'x 3.32', '-']
    assert change('sag', -0.0123) == '-12.3 mV'


def test_long_names_are_cut_where_they_stay_apart():
    """A serial number loses its middle, unless two would look the same."""
    board = 'CUBEPILOT_CUBEORANGE 0006000000003836'
    names = ['uav1', board + '38393239510d', board + '38393239510e', board + 'x' + 'y' * 16,
             board + 'z' + 'y' * 16]
    found = short_names(names)
    assert found['uav1'] == 'uav1' and found[names[1]] == 'CUBEPILOT_CUB\u2026383638393239510d'
    assert len(set(found.values())) == 5 and found[names[3]] == names[3]
