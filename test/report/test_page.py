"""A document on a terminal and on a page: complete, escaped, drawn from the numbers."""

from dataclasses import replace
import math
import re
from xml.etree import ElementTree

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.records import Recording, Severity
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Section, Table, Text, worst_first)
from ou_monitor.report.page import html, html as page_of
from ou_monitor.report.svg import Plot, thin
from ou_monitor.report.terminal import terminal
from ou_monitor.text import number, percent
from pages import parsed, self_contained
import pytest
from simulated_recordings import recording, without_throttle

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


@pytest.mark.parametrize('log, ends, ticks', [
    (False, (0.0, 10.0), '0 2 4 6 8 10'), (False, (4.83, 4.97), '4.85 4.90 4.95'),
    (False, (-2.5, 2.5), '−2 −1 0 1 2'), (False, (-0.3, 0.31), '−0.2 0 0.2'),
    (False, (0.0, 5e5), '0 1e5 2e5 3e5 4e5 5e5'),
    (False, (0.0, 1e-4), '0 2e−5 4e−5 6e−5 8e−5 1e−4'),
    (True, (0.1, 10.0), '0.1 0.2 0.5 1 2 5 10'),
    (True, (1e-5, 2.0), '1e−5 1e−4 0.001 0.01 0.1 1'),
    (True, (2.0, 5.0), '2 3 4 5'), (True, (1e-9, 1e9), '1e−9 1e−6 0.001 1 1000 1e6 1e9')])
def test_ticks_are_round_and_have_the_decimals_of_their_step(log, ends, ticks):
    """With a true minus, and without residue of rounding; at their places on the axis."""
    drawing = Plot('t', 'x', 'y', log_y=log).limits((0.0, 1.0), ends).svg()
    found = re.findall(r'text-anchor="end" x="56" y="([\d.]+)">([^<]+)<', drawing)
    assert [text for _, text in found] == ticks.split()
    low, high = np.log10(ends) if log else ends
    for y, text in found:
        value = float(text.replace('−', '-'))
        share = ((math.log10(value) if log else value) - low) / (high - low)
        assert float(y) == pytest.approx(198.0 - 168.0 * share + 4.0, abs=0.1)


def test_thinning_keeps_every_extreme_and_break():
    """A single peak in 100000 samples stays, and so does a NaN."""
    x = np.arange(100000.0)
    y = np.sin(x)
    y[41234], y[77777] = 50.0, math.nan
    kept_x, kept_y = thin(x, y, 800)
    assert kept_x.size <= 3 * 800 and np.all(np.diff(kept_x) > 0.0)
    assert np.nanmax(kept_y) == 50.0 and np.isnan(kept_y).sum() == 1


def test_a_line_goes_through_its_points_and_breaks_at_nan():
    """Two segments, the first from corner to corner of the axes."""
    plot = Plot('t', 'x', 'y').limits((0.0, 4.0), (0.0, 1.0))
    plot.line(np.arange(5.0), np.array([0.0, 1.0, math.nan, 0.5, 0.5]))
    path = re.search(r'class="line s0" d="([^"]+)"', plot.svg()).group(1)
    segments = path.split('M')[1:]
    assert len(segments) == 2
    first = [tuple(map(float, p.split(','))) for p in segments[0].split('L')]
    assert first[0][1] > first[1][1], 'up is up'
    assert first[1][0] - first[0][0] == pytest.approx((860 - 62 - 14) / 4.0, abs=0.1)


@pytest.mark.parametrize('values', [[], [math.nan] * 3, [1.0], [5.0, 5.0, 5.0],
                                    [1e300, -1e300, 0.0], [math.inf, 0.0]])
@pytest.mark.parametrize('log', [False, True])
def test_plots_accept_any_data(values, log):
    """Empty, unknown, constant, huge: well formed, and no nan among the coordinates."""
    y = np.array(values)
    plot = Plot('<&"', 'x', 'y', log_y=log)
    x = np.arange(float(y.size))
    plot.line(x, y, 'a').band(x, y, y, 'b').steps(x, y)
    drawing = plot.shade(0.0, 1.0, 2, 'c').mark(0.5, 'd').svg()
    ElementTree.fromstring(drawing)
    assert not re.search(r'\b(nan|inf)\b', drawing)


def analysis_of(**changes):
    return analyze(replace(recording(1, seconds=3.0, name='<b>.csv'), notes=('2 <dropped>.',),
                           source={'file': '<b>.csv'}), **changes)


def test_report_is_self_contained_and_well_formed():
    """No address, one script, nothing to fetch; the name is shown as it is."""
    html = page_of(analysis_document(analysis_of(brownout_voltage=4.5)),
                   "ou-monitor analyze '<b>.csv'")
    tree = self_contained(html)
    assert '<b>' not in html
    text = ' '.join(tree.itertext())
    for wanted in ('<b>.csv', "ou-monitor analyze '<b>.csv'", '2 <dropped>.', 'Sigma grows',
                   'Throttle', 'frequency, Hz', 'Risk of going below 4.5 V', 'diffusion'):
        assert wanted in text
    # Five over time, five over throttle, two of the shape; no change of throttle relaxes.
    assert len(list(tree.iter('figure'))) == 12


def test_report_holds_the_numbers_of_the_levels():
    analysis = analysis_of()
    rows = list(list(parsed(page_of(analysis_document(analysis))).iter('table'))[2].iter('tr'))[1:]
    shown = [float(next(list(row)[2].itertext())) for row in rows]
    assert shown == pytest.approx([v.estimate.sigma for v in analysis.levels], rel=5e-3)


@pytest.mark.parametrize('simulated', [
    without_throttle(recording(2, seconds=1.0)),
    recording(3, seconds=0.02),
    Recording(np.arange(500) / 100.0, np.full(500, 5.0), np.full(500, 0.1), 'stuck'),
    Recording(np.zeros(0), np.zeros(0), np.zeros(0), 'empty'),
    Recording(np.array([1e9]), np.array([5.0]), np.array([math.nan]), 'one'),
], ids=lambda simulated: simulated.name)
def test_a_recording_without_results_has_a_report(simulated):
    html = page_of(analysis_document(analyze(simulated)))
    parsed(html)
    assert not re.search(r'[ ",]nan\b', html)


@pytest.mark.parametrize('title', ['short', 'a title that leaves no room beside it'])
def test_a_legend_covers_no_curve(title):
    x = np.linspace(0.0, 1.0, 9)
    plot = Plot(title, 'x', 'y', width=300)
    tree = ElementTree.fromstring(plot.line(x, x, 'data').band(x, x, x + 1.0, 'simulated').svg())
    axes = next(part for part in tree if part.tag == 'svg')
    entries = [part for part in tree if part.get('class') == 'legend']
    assert len(entries) == 2 and all(float(e.get('y')) < float(axes.get('y')) for e in entries)


def test_labels_of_marks_neither_cover_each_other_nor_leave_the_axes():
    """Two close lines, one far from them, and one at the right edge, in any order."""
    plot = Plot('t', 'x', 'y').line(np.array([0.0, 10.0]), np.zeros(2))
    for at in (4.2, 9.9, 4.0, 6.0):
        plot.mark(at, f'label {at}')
    found = {label: (float(x), float(y)) for x, y, label in re.findall(
        r'<text class="marked" x="([\d.]+)" y="([\d.]+)">([^<]+)<', plot.svg())}
    first, second, far, last = (found[f'label {at}'] for at in (4.0, 4.2, 6.0, 9.9))
    assert first[1] == far[1] == last[1] and second[1] == first[1] + 15.0
    assert last[0] + 7.0 * len('label 9.9') < plot.width - 14
