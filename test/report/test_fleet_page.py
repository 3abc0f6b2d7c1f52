"""The report and the words of a fleet: complete, escaped, and present even if little is known."""

from dataclasses import replace
from datetime import datetime, timezone
import re
import xml.etree.ElementTree as ElementTree

import numpy as np
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import judge
from ou_monitor.fleet.table import NAMES
from ou_monitor.report.fleet_document import (
    as_data, facts, finding_words, fleet_document, lowest_table, pack_table, short_names,
    vehicle_table, worst)
from ou_monitor.report.page import html
from ou_monitor.text import number
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
    page = html(fleet_document(simulated, "ou-monitor fleet 'a <b>'"))
    root = ElementTree.fromstring(page.split('\n', 1)[1])
    return ' '.join(' '.join(root.itertext()).split())


def test_the_page_tells_what_stands_out(odd):
    """Each finding, each failure and each copy is on it; nothing of a name becomes HTML."""
    text = page_text(odd)
    found = finding_words(odd)
    assert len(found) >= 3
    for sentence in (*found, fleet_document(odd).headline, '/f/bad: is no <bag>',
                     '/f/copy is /f/uav1/1',
                     'Vehicles: by <hand> & eye.', "ou-monitor fleet 'a <b>'"):
        assert ' '.join(sentence.split()) in text
    for words in ('Drift over the flights: <b>uav2</b> & co.', 'rest of the fleet: uav4.',
                  'other flights of their vehicle: 1 recording.'):
        assert words in fleet_document(odd).headline


def test_stars_mark_significant_values_only(odd):
    """The drifting vehicle at its slope, the odd one at its median; no star elsewhere."""
    made = vehicle_table(odd)
    heads, rows = made.heads, made.rows
    assert 'dips' not in heads
    at = heads.index('sigma, V/sqrt(s)')
    cells = {row[0]: row for row in rows}
    assert cells['<b>uav2</b> & co'][at + 1].endswith('*') and cells['uav4'][at].endswith('*')
    assert sum('*' in cell for row in cells.values() for cell in row) == 2


def test_plain_data_agrees(odd):
    """The JSON names the same drift and the same outliers."""
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
    """A fleet of failures, of one recording, without estimates or vehicles has its report."""
    simulated = fleet(rows)
    assert words in fleet_document(simulated).headline and words in page_text(simulated)


def seen(path: str, vehicle: str, lowest: float, dips: int | None, **more) -> dict:
    """Return the row of a recording of which the lowest voltage is known."""
    return {'path': path, 'recording': path, 'vehicle': vehicle, 'lowest': lowest,
            'lowest_at': 12.0, 'dips': dips, 'below_s': None if dips is None else 0.1 * dips,
            **more}


def test_the_lowest_voltage_comes_first():
    """What a pilot asks: dips, the lowest voltage and where, the sag; in words, page and JSON."""
    rows = [seen('a', 'quad', 14.2, 0, sag=1.2, sag_se=0.1, sag_throttle=0.9),
            seen('b', 'quad', 13.1, 3, lowest_throttle=0.8, sag=1.9, sag_se=0.2,
                 sag_throttle=0.95), seen('c', 'hexa', 13.4, 1)]
    known = replace(fleet(rows), limit=13.5)
    assert fleet_document(known).headline.startswith(
        '4 dips below 13.5 V in 2 of 3 recordings, most in b (quad), 3: the lowest was 13.10 V '
        'at 12.0 s of b (quad). The rail sags by up to 1.90 V, at 95 % throttle in b (quad).')
    assert facts(known) == [
        ('Lowest voltage', '13.10 V at 12.0 s of b (quad), at 80 % throttle'),
        ('Below 13.5 V', '4 dips, 0.40 s in all, in 2 of 3 recordings')]
    assert [row['path'] for row in worst(known)] == ['b', 'c', 'a']
    text = page_text(known)
    assert text.index('4 dips below') < text.index('Lowest voltages') < text.index('Vehicles')
    made = vehicle_table(known)
    assert made.heads == ['vehicle', 'flights', 'lowest, V', 'dips']
    assert made.rows[0] == ['hexa', '0', '13.40', '1']
    made = lowest_table(known, 2)
    assert [row[made.heads.index('vehicle')] for row in made.rows] == ['quad', 'hexa']
    assert as_data(known)['brownout_voltage'] == 13.5


def test_an_ageing_pack_is_the_headline():
    """Its vehicle, growth, values a cell and dates; else what is not excluded, or why unknown."""
    rows = table(np.random.default_rng(8), 2, 8, ageing={1: 0.1})
    for row in rows:
        row['start'] = datetime(2024, 5, row['flight'], tzinfo=timezone.utc)
        row['cells_from'] = 'guessed'
    made = fleet(rows)
    first = made.judgement.trends[0]
    assert (first.vehicle, first.low < 0.1 < first.high) == ('uav1', True)
    said = fleet_document(made).headline
    assert said.startswith('Ageing pack: uav1 (8 flights; 2024-05-01 to 2024-05-08; 4 cells, a '
                           'guess): ') and 'uav0' not in said
    # 5 mOhm a cell at first, twice as much after seven more flights; three errors of a line.
    start, end = (float(word) for word in re.search(
        r'resistance [^:]*, ([\d.]+) to ([\d.]+) mOhm per cell', said).groups())
    assert start == pytest.approx(5.0 * np.exp(0.1), rel=3 * 0.05) and end / start == (
        pytest.approx(np.exp(0.7), rel=3 * 0.05))
    packs = pack_table(made)
    assert packs.heads[:4] == ['vehicle', 'flights', 'dates', 'cells']
    assert [row[:4] for row in packs.rows] == [
        [name, '8', '2024-05-01 to 2024-05-08', '4?'] for name in ('uav0', 'uav1')]
    assert '*' in packs.rows[1][5] and '*' not in packs.rows[0][5]
    assert 'Resistance per cell' in page_text(made)
    # Without its cells a value is marked as that of the pack.
    unknown = pack_table(fleet([{**row, 'cells': None} for row in rows]))
    assert ['(pack)' in ' '.join(row) for row in (*packs.rows, *unknown.rows)] == [
        False, False, True, True]
    healthy = fleet_document(fleet(table(np.random.default_rng(9), 2, 5))).headline
    assert healthy.startswith('No ageing pack is detected; not excluded (95 %): ')
    assert fleet_document(fleet(table(
        np.random.default_rng(9), 1, 8, ageing={0: -0.2}))).headline.startswith('No pack ages: ')
    assert fleet_document(fleet(table(np.random.default_rng(9), 2, 2))).headline.startswith(
        'Whether a pack ages is unknown: no vehicle has 3 flights')


def test_without_a_limit_no_dip_is_counted():
    """Not known is no column, not 0; and where a limit was kept, that is said."""
    assert fleet_document(fleet([seen('a', 'quad', 14.2, None)])).headline.startswith(
        'The lowest voltage was 14.20 V at 12.0 s of a (quad).')
    made = lowest_table(fleet([seen('a', 'quad', 14.2, None)]))
    assert made.heads == ['vehicle', 'recording', 'lowest, V', 'at, s']
    kept = replace(fleet([seen('a', 'quad', 14.2, 0)]), limit=14.0)
    assert fleet_document(kept).headline.startswith(
        'No recording fell below 14 V: the lowest was 14.20 V')


def test_packs_of_other_cells_are_compared_per_cell():
    """3.9 V of one cell are more than 13.2 V of four."""
    mixed = fleet([seen('a', 'quad', 13.2, None, cells=4), seen('b', 'micro', 3.9, None, cells=1)])
    assert [row['path'] for row in worst(mixed)] == ['a', 'b']
    assert fleet_document(mixed).headline.startswith(
        'The lowest voltage was 3.300 V per cell (13.20 V, 4 cells) at 12.0 s of a (quad).')


def test_tables_show_values_as_measured():
    """Recordings of one load each keep their order, as in `analyze`, however they are compared."""
    truth = {0.0: 0.05, 0.05: 0.10, 0.1: 0.32, 0.4: 0.63}
    known = fleet([seen(f'load {u}', 'rail', 4.8, None, flight=k + 1, level='x', throttle=u,
                        time_s=20.0, status='OK', sigma=sigma, sigma_se=0.01, alpha=63.0,
                        alpha_se=0.02)
                   for k, (u, sigma) in enumerate(truth.items())])
    values = known.judgement.values['sigma']
    assert values.measured == pytest.approx(list(truth.values()), rel=1e-12)
    assert values.throttle == pytest.approx(list(truth), rel=1e-12)
    # The line through four points does not fit; the moves carry its error, the typical one none.
    assert not np.array_equal(np.argsort(values.value), np.argsort(values.measured))
    assert values.error[-1] > 10.0 * 0.01
    text = page_text(known)
    for u, sigma in truth.items():
        assert f'{number(sigma)} at {100 * u:.0f} %' in text


def test_long_names_are_cut_where_they_stay_apart():
    """A serial number loses its middle, unless two would look the same."""
    board = 'CUBEPILOT_CUBEORANGE 0006000000003836'
    names = ['uav1', board + '38393239510d', board + '38393239510e', board + 'x' + 'y' * 16,
             board + 'z' + 'y' * 16]
    found = short_names(names)
    assert found['uav1'] == 'uav1' and found[names[1]] == 'CUBEPILOT_CUB\u2026383638393239510d'
    assert len(set(found.values())) == 5 and found[names[3]] == names[3]
