"""One document, two renderers: the same records on a terminal and on a page."""

import math

import numpy as np
from ou_monitor.records import Severity
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Section, Table, Text, worst_first)
from ou_monitor.report.page import html
from ou_monitor.report.svg import Plot
from ou_monitor.report.terminal import terminal
from ou_monitor.text import number, percent
from pages import parsed, self_contained
import pytest

EVIL = '<script>alert("x")</script>&amp;'


def plot():
    return Plot(EVIL, EVIL, EVIL).line(np.arange(3.0), np.arange(3.0), EVIL).mark(0.5, EVIL)


def document(*parts):
    return Document('Title', 'a.csv', ['One.', 'Two.'], parts)


def test_every_part_is_on_the_page_escaped():
    """Markup in any text is shown, not obeyed."""
    page = html(Document(EVIL, EVIL, [EVIL], [
        Text(EVIL), Facts([(EVIL, EVIL)]), Notes.of([EVIL], Severity.WARNING),
        Table([EVIL], [[EVIL + '\n' + EVIL]]), Pair([Figure(plot(), EVIL)]),
        Section(EVIL, [Text(EVIL)], folded=True), lambda: [Text(EVIL)]]), EVIL)
    tree = self_contained(page)
    assert '<script>alert' not in page
    assert sum(EVIL in (e.text or '') for e in tree.iter()) >= 13


def test_a_terminal_draws_nothing_for_a_page_only():
    def drawn():
        pytest.fail('a terminal draws nothing')

    only = (drawn, Figure(plot()), Text('legend', legend=True))
    text = terminal(document(*only, Section('Plots', only), Section('Both', [Text('said')])))
    assert text == 'a.csv\n\nOne. Two.\n\nBoth:\nsaid'


@pytest.mark.parametrize('severity, led', [
    (Severity.ERROR, 'error: '), (Severity.WARNING, 'warning: '), (Severity.INFO, '')])
def test_the_severity_of_a_note_is_that_of_its_record(severity, led):
    notes = document(Notes.of(['An error and a warning.'], severity))
    assert terminal(notes).endswith(f'\n- {led}An error and a warning.')
    (item,) = parsed(html(notes)).iter('li')
    assert ''.join(item.itertext()) == f'{led}An error and a warning.'
    assert item.get('class') == ('warn' if led else None)


def test_the_worst_note_is_first_and_each_is_said_once():
    found = worst_first([(Severity.INFO, 'a'), (Severity.WARNING, 'b'), (Severity.ERROR, 'a'),
                         (Severity.WARNING, 'c')])
    assert found.notes == [(Severity.ERROR, 'a'), (Severity.WARNING, 'b'), (Severity.WARNING, 'c')]


def test_a_terminal_leaves_out_rows_and_says_so():
    rows = [[f'row {k}', '1'] for k in range(9)]
    found = document(Table(['name', 'n'], rows, left=[0], most=4), Notes.of('abc', most=2))
    text = terminal(found)
    assert text.count('row') == 4 and 'and 5 more' in text and 'and 1 more' in text
    assert html(found).count('row ') == 9


def test_a_page_has_typographic_signs():
    """Plus-minus, minus, unknown, symbols of heads, the small line of a cell; not in a command."""
    found = document(Table(['sigma, V/sqrt(s)\n[95 %]', 'time, s'],
                           [['-1.5 +- 0.2\n[-1.7, -1.3]', '-']]),
                     Text('2026-11-23, load-step: -3 mV'))
    page = html(found, 'ou-monitor a-5.csv --x -3')
    text = '|'.join(parsed(page).find('body').itertext())
    for wanted in ('σ, V/√s', 'Time, s', '−1.5 ± 0.2', '[−1.7, −1.3]', '|–|',
                   '2026-11-23, load-step: −3 mV', 'ou-monitor a-5.csv --x -3'):
        assert wanted in text, wanted
    assert '-1.5 +- 0.2 [-1.7, -1.3]' in terminal(found)


@pytest.mark.parametrize('value, digits, text', [
    (0.0, 3, '0'), (math.nan, 3, '-'), (math.inf, 3, '-'), (15.0, 3, '15.0'), (0.02, 3, '0.0200'),
    (99.96, 3, '100'), (0.9999, 3, '1.00'), (123456.0, 3, '123456'), (1234567.0, 3, '1.23e6'),
    (7.91e-4, 3, '7.91e-4'), (0.00317, 3, '0.00317'), (-63.04, 3, '-63.0'), (4.9351, 4, '4.935')])
def test_numbers_keep_their_significant_digits(value, digits, text):
    """Significant digits, zeros kept, rounding across a decade."""
    assert number(value, digits) == text


@pytest.mark.parametrize('share, text', [
    (1.0, '100 %'), (0.996, '100 %'), (0.00056, '0.056 %'), (0.0134, '1.3 %'), (0.0, '0 %')])
def test_shares_have_two_digits_and_no_exponent(share, text):
    """What most lines of a report state: 1e+02 % is not read at a glance."""
    assert percent(share) == text
