"""The pages in a headless browser: what a reader points at, drags and presses."""

import json
import re
import time

from browser import Browser, find_browser
import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.report.analysis_document import analysis_document
from ou_monitor.report.document import Document, Figure, Pair
from ou_monitor.report.page import html
from ou_monitor.report.svg import Plot
import pytest
from simulated_recordings import recording

PROGRAM = find_browser()
pytestmark = pytest.mark.skipif(
    PROGRAM is None, reason='no Chromium or Chrome on the PATH (or in OU_MONITOR_BROWSER)')

EVIL = '</script><img src=x onerror="window.broken=1"><b>&amp;'
SECONDS, PEAK, HIGH, GAP = 40.0, 18_002, 9_001, slice(30_000, 32_000)


@pytest.fixture(scope='module')
def data():
    """Return stamps and noise: one sample far below, one above, two seconds unknown."""
    t = np.arange(int(1000 * SECONDS)) / 1000.0
    v = 4.9 + 0.02 * np.random.default_rng(5).standard_normal(t.size)
    v[PEAK], v[HIGH], v[GAP] = 3.1234, 5.15, np.nan
    return t, v


@pytest.fixture(scope='module')
def file(data, tmp_path_factory):
    """Return a page: voltage, throttle as steps, spectrum on log axes, a histogram, dots."""
    t, v = data
    whole = (0.0, SECONDS)
    voltage = Plot('Voltage', 'time, s', 'V').limits(whole, (3.0, 5.2)).line(t, v, EVIL)
    throttle = Plot('Throttle', 'time, s', '%').limits(whole)
    throttle.steps(t, 10.0 * np.floor(t / 6.0), 'set')
    f = np.geomspace(0.1, 500.0, 60)
    spectrum = Plot('PSD', 'frequency, Hz', 'PSD, V\u00b2/Hz', width=450, log_x=True, log_y=True)
    spectrum.line(f, 1e-4 / (1.0 + f * f), 'data').line(f, 2e-4 / (1.0 + f * f), '', 0, 'dash')
    spectrum.band(f, 5e-5 / (1.0 + f * f), 3e-4 / (1.0 + f * f), 'simulated', 1)
    edges = np.linspace(-1.0, 1.0, 5)
    outline = Plot('Histogram', 'deviation', 'density', width=450)
    outline.line(np.repeat(edges, 2)[1:-1], np.repeat([0.1, 0.4, 0.3, 0.2], 2), 'outline')
    # Separate points in no order, two of them above one another.
    outline.markers(np.array([0.6, 0.25, 0.6]), np.array([0.05, 0.15, 0.35]), 'dot', 1)
    outline.mark(0.9, EVIL)
    outline.bars(np.array([-0.75]), np.array([0.05]), np.array([0.2]), 'bar', 2)
    path = tmp_path_factory.mktemp('page') / 'it <b>.html'
    path.write_text(html(Document(EVIL, EVIL, [EVIL], [
        Figure(voltage, EVIL), Figure(throttle), Pair([Figure(spectrum), Figure(outline)])])))
    return path


@pytest.fixture(scope='module')
def started(tmp_path_factory):
    with Browser(PROGRAM, tmp_path_factory.mktemp('profile')) as tab:
        yield tab


@pytest.fixture
def browser(started):
    """Return the tab as for a light screen, with nothing noted."""
    started.media()
    started.requests.clear()
    started.errors.clear()
    return started


@pytest.fixture
def tab(browser, file):
    """Return the tab with the page freshly opened; no error may remain."""
    browser.visit(file, 'document.documentElement.dataset.plots === "4"')
    yield browser
    assert browser.errors == []
    assert browser.requests == [file.as_uri()]


class View:
    """One plot of the page on the screen: places in it, and what it says."""

    def __init__(self, tab, k):
        self._tab, self._one = tab, f'document.querySelectorAll(".live")[{k}]'

    def at(self, x, y=0.5):
        """Return a place of the window from shares of the axes, y upwards; scroll if need be."""
        left, top, width, height = self._tab.run(
            f'(() => {{ const e = {self._one}.querySelector(".live-view"); '
            'e.scrollIntoView({block: "nearest"}); const r = e.getBoundingClientRect(); '
            'return [r.left, r.top, r.width, r.height]; })()')
        return left + 62.0 + x * (width - 76.0), top + height - 42.0 - y * (height - 50.0)

    def point(self, x, y=0.5):
        self._tab.mouse('mouseMoved', *self.at(x, y))
        return self.tip()

    def tip(self):
        """Return the lines of the tooltip; none where it is hidden."""
        return self._tab.run(
            f'(() => {{ const e = {self._one}.querySelector(".live-tip"); '
            'return e.hidden ? [] : [...e.children].map((c) => c.textContent); })()')

    def ends(self, axis='x'):
        return [float(v) for v in self._tab.run(
            f'{self._one}.querySelector(".live-view").dataset.{axis}').split()]

    def ink(self, variable, x=(0.0, 1.0), y=(0.0, 1.0)):
        """Return how many pixels have a colour of the page, of all or of shares of the axes."""
        return self._tab.run(f"""(() => {{
            const of = {self._one}.querySelector(".live-curves");
            const c = new OffscreenCanvas(of.width, of.height);
            c.getContext("2d").drawImage(of, 0, 0);
            const w = c.width - 76, h = c.height - 50, [m, n] = {list(x)}, [u, v] = {list(y)};
            const p = c.getContext("2d").getImageData(62 + m * w, 8 + (1 - v) * h,
              Math.max((n - m) * w, 1), Math.max((v - u) * h, 1)).data;
            const hex = getComputedStyle(document.documentElement)
              .getPropertyValue("--{variable}").trim();
            const [r, g, b] = [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16));
            let count = 0;
            for (let i = 0; i < p.length; i += 4)
              count += p[i + 3] > 60 && Math.abs(p[i] - r) + Math.abs(p[i + 1] - g)
                + Math.abs(p[i + 2] - b) < 30;
            return count; }})()""")

    def click(self, name):
        self._tab.run(f'[...{self._one}.querySelectorAll("button")]'
                      f'.find((b) => b.textContent === {name!r}).click()')


def shown(tab, selector):
    return tab.run(f'[...document.querySelectorAll({selector!r})]'
                   '.filter((e) => e.getClientRects().length).length')


def number(text):
    return float(re.search(r'\u2212?[\d.]+(e\u2212?\d+)?', text)[0].replace('\u2212', '-'))


def test_every_figure_becomes_interactive(tab):
    """A canvas with ink in the place of each drawing; names are shown, not obeyed."""
    assert shown(tab, 'figure canvas.live-curves') == 4 and shown(tab, 'figure > svg') == 0
    assert View(tab, 0).ink('c0') > 500 and View(tab, 3).ink('c1') > 20
    assert View(tab, 2).ink('c0') > 50
    assert tab.run('window.broken') is None and tab.run('document.querySelector("img, b")') is None
    assert tab.run('document.querySelector(".live-name").textContent') == EVIL
    assert tab.run('document.title') == EVIL


def test_an_analysis_becomes_interactive(browser, tmp_path):
    """Each drawing of a real page, those of one axis linked: time, and throttle."""
    path = tmp_path / 'a.html'
    text = html(analysis_document(analyze(recording(1, seconds=3.0))))
    path.write_text(text)
    axes = [json.loads(text)['x']['name'] for text in re.findall(
        r'<script type="application/json"[^>]*>(.*?)</script>', text, re.DOTALL)]
    browser.visit(path, 'document.documentElement.dataset.plots')
    drawn = browser.run('document.querySelectorAll("figure").length')
    assert shown(browser, 'canvas.live-curves') == drawn >= 6
    for name, least in (('time', 4), ('throttle', 3)):
        View(browser, axes.index(name)).point(0.5)
        assert shown(browser, '.live-tip') == axes.count(name) >= least
    assert browser.errors == []


def test_pointing_reads_the_samples_to_the_digit(tab, data):
    """Far out a column's extremes, close up the sample itself; linked plots follow."""
    t, v = data
    view = View(tab, 0)
    where, values = view.point((PEAK / 1000.0) / SECONDS)
    assert number(where.removeprefix('time ')) == pytest.approx(PEAK / 1000.0, abs=0.2)
    read = re.fullmatch(r'(.*): ([\d.]+) to ([\d.]+) V \((\d+) samples\)', values)
    low, high = (float(read[k]) for k in (2, 3))
    # A column of the 824 pixels; which one, to the rounding of the pointer.
    column = 1000.0 * SECONDS / 824.0
    tops = [v[int(PEAK + (k - 0.5) * column):int(PEAK + (k + 0.5) * column)].max()
            for k in np.linspace(-1.0, 1.0, 201)]
    assert read[1] == EVIL and low == pytest.approx(v[PEAK], abs=1e-3)
    assert np.abs(np.array(tops) - high).min() < 1e-3 and abs(int(read[4]) - column) < 2.0
    assert View(tab, 1).tip()[1] == 'set: 30.00 %'
    share = PEAK / 1000.0 / SECONDS
    for _ in range(2):
        tab.drag(view.at(share - 0.05), view.at(share + 0.05))
        low, high = view.ends()
        share = (PEAK / 1000.0 - low) / (high - low)
    assert high - low < 0.5 and View(tab, 1).ends() == [low, high]
    for k in (PEAK, PEAK - 40, PEAK + 17):
        where, value = view.point((t[k] - low) / (high - low))
        assert number(where.removeprefix('time ')) == pytest.approx(t[k], abs=1e-4)
        assert number(value.removeprefix(EVIL)) == pytest.approx(v[k], abs=6e-4)


def test_zoom_and_reset_work_with_the_mouse(tab):
    """Drag, wheel, shift and drag, double click; the plots of one axis together, others not."""
    view, whole = View(tab, 0), [0.0, SECONDS]
    tab.drag(view.at(0.25, 0.5), view.at(0.5, 0.52))
    assert view.ends() == pytest.approx([0.25 * SECONDS, 0.5 * SECONDS], rel=1e-6)
    assert View(tab, 1).ends() == view.ends() and view.ends('y') == [3.0, 5.2]
    assert View(tab, 2).ends() != view.ends()
    before = view.ends()
    tab.mouse('mouseWheel', *view.at(0.5), deltaX=0, deltaY=-200, modifiers=2)
    tab.until(f'document.querySelector(".live-view").dataset.x !== "{before[0]} {before[1]}"')
    low, high = view.ends()
    assert high - low < 0.8 * (before[1] - before[0])
    tab.drag(view.at(0.5), view.at(0.25), modifiers=8)
    assert view.ends() == pytest.approx([low + 0.25 * (high - low), high + 0.25 * (high - low)])
    tab.drag(view.at(0.2, 0.9), view.at(0.8, 0.4))
    assert view.ends('y') == pytest.approx([3.88, 4.98], abs=1e-6)
    for count in (1, 2):
        tab.mouse('mousePressed', *view.at(0.5), clickCount=count)
        tab.mouse('mouseReleased', *view.at(0.5), clickCount=count)
    assert view.ends() == View(tab, 1).ends() == whole and view.ends('y') == [3.0, 5.2]
    tab.drag(view.at(0.9), view.at(0.95))
    view.click('Show all')
    assert view.ends() == whole


def test_log_axes_bands_and_dashes_read_right(tab):
    """Between points as the eye sees it on the axes; the dashed one bears the name's colour."""
    rows = View(tab, 2).point(0.5)
    f = number(rows[0].removeprefix('frequency '))
    assert rows[0].endswith(' Hz') and f == pytest.approx(np.sqrt(0.1 * 500.0), rel=0.08)
    assert [row.split(':')[0] for row in rows[1:]] == ['data', 'data, dashed', 'simulated']
    for row, size in zip(rows[1:], (1e-4, 2e-4, 5e-5)):
        assert number(row.split(': ')[1]) == pytest.approx(size / (1.0 + f * f), rel=2e-3)
        assert row.endswith(' V\u00b2/Hz')


def test_outlines_dots_and_bars_read_right(tab):
    """The step of a histogram, a single dot, a bar; nothing where there is nothing."""
    view = View(tab, 3)
    low, high = view.ends()
    for where, wanted in ((0.25, {'outline: 0.3000', 'dot: 0.1500'}),
                          (-0.75, {'outline: 0.1000', 'bar: 0.05000 to 0.2000'}),
                          (-0.4, {'outline: 0.4000'})):
        rows = view.point((where - low) / (high - low))[1:]
        read = {row.split(':')[0]: number(row.split(': ')[1]) for row in rows}
        assert read == pytest.approx({w.split(':')[0]: number(w.split(': ')[1]) for w in wanted})
    for y, dot in ((0.1, 0.05), (0.9, 0.35)):
        rows = view.point((0.6 - low) / (high - low), y)
        assert [number(row) for row in rows if row.startswith('dot')] == [dot]


def test_gaps_stay_gaps(tab, data):
    """Neither ink nor a value where nothing is known; both beside it."""
    view, (a, b) = View(tab, 0), (float(data[0][GAP][k]) / SECONDS for k in (0, -1))
    assert len(view.point(0.5 * (a + b))) == 1 and len(view.point(a - 0.01)) == 2
    assert view.ink('c0', (a + 0.005, b - 0.005)) == 0 < view.ink('c0', (a - 0.02, a))


def test_a_click_on_a_name_hides_it(tab):
    """With all that bears its colour; a second one brings it back."""
    view = View(tab, 0)
    ink = view.ink('c0')
    view.click(EVIL)
    assert view.ink('c0') == 0 and view.point(0.5)[1:] == []
    view.click(EVIL)
    assert view.ink('c0') == ink
    view = View(tab, 2)
    view.click('data')
    assert [row.split(':')[0] for row in view.point(0.5)[1:]] == ['simulated']


def test_every_action_has_a_key(tab):
    """Reached by Tab; arrows read, plus and minus zoom, shift moves, 0 shows all."""
    tab.run('document.querySelector(".live-name").focus()')
    tab.key('Tab', code='Tab', windowsVirtualKeyCode=9)
    assert tab.run('document.activeElement.className') == 'live-view'
    view = View(tab, 0)
    tab.key('ArrowRight')
    first = number(view.tip()[0].removeprefix('time '))
    tab.key('ArrowLeft')
    tab.key('ArrowLeft')
    assert number(view.tip()[0].removeprefix('time ')) < first
    tab.key('+')
    low, high = view.ends()
    assert high - low == pytest.approx(0.5 * SECONDS)
    tab.key('ArrowRight', modifiers=8)
    assert view.ends()[0] == pytest.approx(low + 0.1 * (high - low))
    tab.key('-')
    assert view.ends() == [0.0, SECONDS]
    tab.key('+')
    tab.key('0')
    assert view.ends() == [0.0, SECONDS]


def test_fingers_read_and_pinch(tab):
    """One finger points, two spread to zoom about where they are."""
    view = View(tab, 0)
    tab.touch('touchStart', view.at(0.3))
    assert len(view.tip()) == 2
    tab.touch('touchEnd')
    tab.touch('touchStart', view.at(0.4), view.at(0.6))
    tab.touch('touchMove', view.at(0.3), view.at(0.7))
    tab.until('document.querySelector(".live-view").dataset.x !== "0 40"')
    low, high = view.ends()
    assert high - low == pytest.approx(0.5 * SECONDS, rel=0.02)
    assert 0.5 * (low + high) == pytest.approx(0.5 * SECONDS, rel=0.02)
    tab.touch('touchEnd')


def test_paper_shows_the_drawings(tab):
    """In print the static drawings stand in their places again."""
    tab.media('print')
    assert shown(tab, 'figure > svg') == 4 and shown(tab, '.live, .live-hint') == 0


def test_paper_shows_folded_sections(tab):
    tab.run('document.body.insertAdjacentHTML("beforeend", '
            "'<details class=\"section\"><summary>a</summary><p id=\"in\">b</p></details>')")
    for kind, seen in (('screen', False), ('print', True)):
        tab.media(kind)
        assert tab.run('document.querySelector("#in").checkVisibility()') == seen


def test_without_scripts_the_drawings_stay(browser, file):
    """Nothing is hidden and nothing is empty."""
    browser.send('Emulation.setScriptExecutionDisabled', value=True)
    browser.visit(file)
    time.sleep(0.1)
    browser.send('Emulation.setScriptExecutionDisabled', value=False)
    assert shown(browser, 'figure > svg') == 4 and shown(browser, 'canvas') == 0


def test_the_policy_forbids_the_network_and_other_scripts(browser, file):
    """Requests that a script of the page would make do not leave; one that was put in is dead."""
    browser.visit(file, 'document.documentElement.dataset.plots')
    tries = ['fetch("http://127.0.0.1:9/").then(() => 1, () => 0)',
             'new Promise((done) => { const i = new Image(); i.onload = () => done(1); '
             'i.onerror = () => done(0); i.src = "http://127.0.0.1:9/i.png"; })']
    assert [browser.run(simulated) for simulated in tries] == [0, 0]
    browser.run('(() => { const s = document.createElement("script"); '
                's.textContent = "window.broken = 1"; document.body.append(s); })()')
    assert browser.run('window.broken') is None
    blocked = [e for e in browser.errors if 'Content Security Policy' in e]
    assert len(blocked) >= 3, browser.errors
