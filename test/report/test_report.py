"""The page: well formed, self-contained, escaped, drawn from the numbers."""

from dataclasses import replace
import math
import re
from xml.etree import ElementTree

from hypothesis import given, strategies as st
import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.records import Recording
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.report.page import html as page_of
from ou_monitor.report.svg import (
    linear_ticks, log_ticks, Plot, Scale, span, thin, tick_text)
from pages import parsed, self_contained
import pytest
from simulated_recordings import recording, without_throttle

ends = st.floats(-1e6, 1e6)


@given(ends, st.floats(1e-6, 1e6))
def test_linear_ticks_are_round_even_and_inside(low, width):
    high = low + width
    if not (high - low) > 1e-9 * max(abs(low), abs(high)):
        return
    ticks = linear_ticks(low, high)
    assert 2 <= len(ticks) <= 13
    steps = np.diff(ticks)
    assert np.allclose(steps, steps[0], rtol=1e-3)
    slack = 1e-6 * width + 1e-9 * max(abs(low), abs(high))
    assert low - slack <= ticks[0] and ticks[-1] <= high + slack
    mantissa = float(f'{steps[0]:.3e}'.split('e')[0])
    assert min(abs(mantissa - m) for m in (1.0, 2.0, 5.0)) < 0.01


@given(st.floats(-9, 6), st.floats(0.05, 12.0))
def test_log_ticks_lie_inside(low, decades):
    ticks = log_ticks(10.0 ** low, 10.0 ** (low + decades))
    assert ticks == sorted(ticks) and len(ticks) <= 14
    assert len(ticks) >= (2 if decades < 0.7 or decades > 1.0 else 1)
    assert all(10.0 ** low * 0.999 <= v <= 10.0 ** (low + decades) * 1.001 for v in ticks)


@pytest.mark.parametrize('value, step, text', [
    (0.0, 1.0, '0'), (10.0, 10.0, '10'), (0.2, 0.2, '0.2'), (4.85, 0.05, '4.85'),
    (-2.0, 1.0, '\u22122'), (1e-4, 1e-4, '1e\u22124'), (2e5, 1e5, '2e5'),
    (0.3 - 0.1 * 3, 0.1, '0')])
def test_ticks_have_the_decimals_of_their_step(value, step, text):
    """Decimals as the step needs them; a true minus; no residue of rounding."""
    assert tick_text(value, step) == text


def test_scale_maps_ends_to_pixels():
    """Linear and logarithmic; what a log axis cannot show is NaN."""
    assert list(Scale(0.0, 10.0, 60.0, 160.0)(np.array([0.0, 5.0, 10.0]))) == [60.0, 110.0, 160.0]
    log = Scale(0.1, 10.0, 100.0, 0.0, log=True)
    assert log(np.array([0.1, 1.0, 10.0])) == pytest.approx([100.0, 50.0, 0.0])
    assert np.isnan(log(np.array([0.0, -1.0]))).all()


@given(st.lists(st.one_of(st.floats(-1e9, 1e9), st.just(math.nan), st.just(math.inf))),
       st.booleans())
def test_span_is_always_an_axis(values, log):
    """Whatever the data: finite ends, low < high, positive on a log axis."""
    low, high = span([np.array(values)], log)
    assert math.isfinite(low) and math.isfinite(high) and low < high
    assert low > 0.0 or not log


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
