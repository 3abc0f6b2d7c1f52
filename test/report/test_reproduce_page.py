"""All rows, their words, and the page: complete, well formed, equal to the rows."""

from collections import Counter
import re

import numpy as np
from ou_monitor.paper import published, reproduce as module
from ou_monitor.paper.published import Printed, Row, RowVerdict
from ou_monitor.paper.reproduce import as_data, headline, recomputed
from ou_monitor.report.page import html
from ou_monitor.report.reproduction_document import reproduction_document
from pages import self_contained
import pytest


@pytest.fixture(scope='module')
def result():
    """Return a reproduction with fewer simulations; every row is there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, 'CREST_PATHS', 200)
        patch.setattr(module, 'JUMP_SECONDS', 10.0)
        shares = []
        found = module.reproduce(3, shares.append)
    assert shares == sorted(shares) and shares[-1] == 1.0
    return found


@pytest.fixture(scope='module')
def tree(result):
    """Return the page, parsed as XML."""
    return self_contained(html(reproduction_document(result), 'ou-monitor reproduce --seed 3'))


def test_every_printed_number_has_its_row(result):
    """All of Table 1, Fig. 5, Table 2 and what repeats them."""
    texts = Counter((row.where, row.printed.text) for row in result.rows)
    for state in published.TABLE_1:
        for printed in (state.vpp, state.amp, state.vrms):
            assert texts['Table 1', printed.text] >= 1, printed.text
    for printed in [published.TAU_MS, *published.SIGMA.values(), *published.VAR_INF.values()]:
        assert texts['Table 2', printed.text] == 1, printed.text
    assert texts['Fig. 5', '63.0'] >= 1 and texts['Fig. 5', '368'] == 1
    assert texts['Section 5', '11.22'] == 1
    for where, _, printed, _ in published.RESTATED:
        assert texts[where, printed.text] >= 1, where
    for where in ('Section 3.1', 'Section 3.3', 'Section 4.4', 'Section 4.5', 'Section 6'):
        assert any(row.where == where for row in result.rows), where


def test_headline_counts_the_rows(result):
    """72 rows or however many there are, each in one of three counts."""
    counts = Counter(row.verdict for row in result.rows)
    numbers = [int(n) for n in re.findall(r'\d+', headline(result))]
    assert numbers == [len(result.rows), counts[RowVerdict.AGREES], counts[RowVerdict.ROUNDING],
                       counts[RowVerdict.DOES_NOT_HOLD]]
    assert sum(numbers[1:]) == numbers[0]
    data = as_data(result)
    assert data['counts'] == {verdict.name: counts[verdict] for verdict in RowVerdict}
    assert len(data['rows']) == numbers[0] and len(data['points']) == 8


@pytest.mark.parametrize('printed, value, error, text', [
    ('63.0', 63.04585, None, '63.05'), ('15.873', 15.873016, None, '15.8730'),
    ('1', 0.99512, 0.0123, '0.995 +- 0.012'), ('500', 1004.4, 10.7, '1004 +- 11'),
    ('368', 373.4, 123.0, '373 +- 123'), ('> 0', -1.0, None, '-1.000')])
def test_digits_follow_the_error(printed, value, error, text):
    """Two digits of error; without one, more digits than were printed."""
    row = Row('Table 0', 'x', '', Printed(printed), value, 'how', 'Says.', error=error)
    assert recomputed(row) == text


def test_page_shows_every_row_and_figure(result, tree):
    """One table row each, with its verdict; 8 drawings; headline and command."""
    text = ' '.join(tree.itertext())
    assert headline(result) in text and 'ou-monitor reproduce --seed 3' in text
    cells = [[''.join(cell.itertext()) for cell in line] for line in tree.iter('tr')]
    lines = [cell for cell in cells if cell[-1] in {v.value for v in RowVerdict}]
    assert len(lines) == len(result.rows)
    shown = [(cell[2], cell[-1]) for cell in lines]
    parts = [row for _, rows in result.parts() for row in rows]
    assert shown == [(row.printed.text, row.verdict.value) for row in parts]
    assert len(list(tree.iter('figure'))) == 8


@pytest.mark.parametrize('state', [published.MEDIUM, published.HIGH])
def test_spectra_follow_the_lorentzian(state):
    """At 100 Hz to 10 kHz within 25 %, also behind a coupling that is slow there."""
    # Bins there average 7 segments and several lines, so each scatters by 12 % at most.
    frequency, density, coupled = module.spectrum(state, np.random.default_rng(3))
    use = (frequency > 100.0) & (frequency < 1e4)
    exact = 2.0 * 1e-6 * state.vrms.value ** 2 * 126.0 / (
        63.0 ** 2 + (2.0 * np.pi * frequency[use]) ** 2)
    assert abs(density[use] / exact - 1.0).max() < 0.25
    assert abs(coupled[use] / exact - 1.0).max() < 0.25
