"""The data in the page: the plotted values within the stated rounding, with all peaks."""

from hypothesis import given, strategies as st
import numpy as np
from ou_monitor.report.document import Document, Figure, Text
from ou_monitor.report.page import embed, envelope, html
from ou_monitor.report.svg import Curve, Plot
from pages import self_contained, unpacked
import pytest

EVIL = '</script><img src=x onerror="alert(1)"/>]]>&amp;<!--'


def noise(n, seed=0):
    """Return a rail with noise and its stamps, scattered about 1 kHz."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / 1000.0 + rng.uniform(-1e-4, 1e-4, n)
    return np.sort(t) - t.min(), 4.9 + 0.05 * rng.standard_normal(n)


def embedded(plot, **more):
    return unpacked(embed(plot, **more))['curves']


def test_columns_are_float32():
    """With gaps, repeated and unsorted x; what no float32 holds is infinite or 0."""
    x = np.array([0.0, 0.1, 0.1, np.nan, 7.0 / 3.0, -1.0])
    y = np.array([1e-300, np.nan, np.inf, -1e300, 0.1, np.pi])
    (curve,) = embedded(Plot('t', 'x', 'y').line(x, y))
    assert np.allclose(curve['x'], x, 2.0 ** -24, 0.0, equal_nan=True)
    assert np.allclose(curve['y'], [0.0, np.nan, np.inf, -np.inf, 0.1, np.pi], 2.0 ** -24, 0.0,
                       equal_nan=True)


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, np.nan]), min_size=1, max_size=30))
def test_steps_lose_nothing(values):
    y = np.array(values)
    x = np.arange(float(y.size))
    (curve,) = embedded(Plot('t', 'x', 'y').steps(x, y))
    held = curve['y'][np.searchsorted(curve['x'], x, side='right') - 1]
    assert np.array_equal(held, y, equal_nan=True) and curve['x'][-1] == x[-1]


def test_separate_points_come_in_order():
    """Dots and bars of any order, each with its own values; one without a place is left out."""
    x, y = np.array([3.0, np.nan, 1.0, 2.0]), np.array([30.0, 5.0, 10.0, np.nan])
    dots, bars = embedded(Plot('t', 'x', 'y').markers(x, y).bars(x, y, y + 1.0))
    assert dots['x'].tolist() == bars['x'].tolist() == [1.0, 2.0, 3.0]
    assert np.array_equal(dots['y'], [10.0, np.nan, 30.0], equal_nan=True)
    assert np.array_equal(bars['high'], [11.0, np.nan, 31.0], equal_nan=True)


@given(st.lists(st.sampled_from([0.0, -3.0, 5.0, 9.0, np.nan, np.inf]), min_size=1, max_size=40),
       st.integers(2, 7))
def test_an_envelope_keeps_every_extreme_and_every_gap(values, every):
    """Of each group the lowest, the highest and a break, as a plain loop finds them."""
    y = np.array(values)
    x = np.arange(float(y.size))
    line = envelope(Curve(x, y, None, '', 's0', 'line'), every)
    assert np.all(np.diff(line.x) > 0.0) and np.array_equal(
        line.y, y[line.x.astype(int)], equal_nan=True)
    band = envelope(Curve(x, y, y + 1.0, '', 's0', 'band'), every)
    for k, start in enumerate(range(0, y.size, every)):
        part = y[start:start + every]
        known = part[np.isfinite(part)]
        kept = line.y[(line.x >= start) & (line.x < start + every)]
        whole = kept[np.isfinite(kept)]
        assert (~np.isfinite(kept)).any() == (~np.isfinite(part)).any()
        assert whole.size == min(known.size, np.unique(known).size, 2)
        assert set(whole) == ({known.min(), known.max()} if known.size else set())
        assert np.isfinite(band.y[k]) == bool(known.size)
        if known.size:
            assert (band.y[k], band.high[k]) == (known.min(), known.max() + 1.0)


def test_long_recordings_become_envelopes_that_say_so():
    """Within the points allowed; the one peak is there; short curves beside stay as they are."""
    t, y = noise(70_000)
    y[54321] = 99.0
    plot = Plot('t', 'time, s', 'V').line(t, y, 'voltage').line(t[:50], y[:50], 'short')
    plot.band(t, y - 1.0, y + 1.0, 'band')
    line, short, band = embedded(plot, most=9000)
    assert line['x'].size + band['x'].size <= 9000
    assert line['every'] > 1 and band['every'] > 1 and short['every'] == 1
    assert short['x'].size == 50
    assert line['y'].max() == pytest.approx(99.0) and band['high'].max() == pytest.approx(100.0)
    assert abs(line['x'][line['y'].argmax()] - t[54321]) < np.median(np.diff(line['x'])) / 1999.0
    assert all(curve['every'] == 1 for curve in embedded(plot))


@pytest.mark.parametrize('seconds, exact', [(134, True), (3600, False)])
def test_pages_stay_small(seconds, exact):
    """Voltage and throttle at 1 kHz, stamps that scatter: 2 MB for an hour, every peak inside."""
    t, y = noise(1000 * seconds)
    throttle = np.round(50.0 + 40.0 * np.sin(t), 0)
    voltage = Plot('Voltage', 'time, s', 'V').line(t, y)
    whole = html(Document('t', 's', [], [
        Figure(voltage), Figure(Plot('Throttle', 'time, s', '%').steps(t, throttle))]))
    assert len(whole) < 2e6
    drawn = embedded(voltage)[0]
    assert (drawn['x'].size == t.size) == exact and drawn['x'].size > 100_000
    assert drawn['y'].max() == pytest.approx(y.max(), rel=1e-6)


def test_hostile_names_stay_names():
    plot = Plot(EVIL, EVIL, EVIL).line(np.arange(3.0), np.arange(3.0), EVIL)
    plot.shade(0.0, 1.0, 2, EVIL).mark(0.5, EVIL)
    script = embed(plot)
    assert script.count('<') == 2 and script.count('>') == 2 and '&' not in script
    found = unpacked(script)
    assert found['title'] == found['curves'][0]['label'] == found['marks'][0][1] == EVIL
    assert found['shades'][0][3] == EVIL
    whole = html(Document(EVIL, EVIL, [EVIL], [Figure(plot, EVIL)]))
    tree = self_contained(whole)
    assert len(list(tree.iter('script'))) == 2 and '<img' not in whole


def test_a_page_without_plots_has_no_script():
    """Nothing to run, and the policy forbids all of it."""
    self_contained(html(Document('t', 's', [], [Text('c')])))


@pytest.mark.parametrize('label, name, unit', [
    ('time, s', 'time', 's'), ('V', '', 'V'), ('V/\u221as', '', 'V/\u221as'),
    ('PSD, V\u00b2/Hz', 'PSD', 'V\u00b2/Hz'),
    ('10\u207b\u2076 V\u00b2', '', '10\u207b\u2076 V\u00b2'),
    ('probability', 'probability', ''), ('Vpp/Vrms', 'Vpp/Vrms', ''), ('%', '', '%'),
    ('1/s', '', '1/s'), ('rms, mV', 'rms', 'mV')])
def test_axis_labels_hold_a_name_and_a_unit(label, name, unit):
    """A tooltip shows the unit behind the value."""
    y = unpacked(embed(Plot('t', 'x', label)))['y']
    assert (y['label'], y['name'], y['unit']) == (label, name, unit)


def test_static_drawings_carry_no_data():
    """A drawing by itself, as in doc/, is the drawing alone."""
    assert 'script' not in Plot('t', 'x', 'y').line(np.arange(3.0), np.arange(3.0)).svg()
