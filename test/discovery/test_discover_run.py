"""From a recording to a finding and its page: clear causes, bad input, correct verdicts."""

import json
import math
import re
import subprocess
import sys

import numpy as np
import ou_monitor
from ou_monitor import discover
from ou_monitor.discovery.finding import Verdict
from ou_monitor.errors import InputError
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import HeldSamples
from ou_monitor.records import Recording
from ou_monitor.report.discovery_document import discovery_document
from ou_monitor.report.document import Figure, Pair, Section
from ou_monitor.report.page import html as page_of
from ou_monitor.report.terminal import terminal
from pages import parsed, self_contained
from project import needs_recordings, REAL, ROOT
import pytest

RAIL = OU(63.0, 0.3156, 5.0)


def drawn_from(*terms, seed=1, n=20_000, throttle=True, name='made'):
    """Return a recording at 1 kHz, throttle in steps of 0.4 s."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / 1000.0
    u = np.repeat(rng.random(n // 400 + 1), 400)[:n]
    v = SupplyModel((RAIL, *terms)).simulate(t, rng, u)
    return Recording(t, v, u if throttle else np.full(n, np.nan), name)


@pytest.fixture(scope='module')
def sag():
    return discover(drawn_from(LoadSag(0.5, 0.0), n=12_000, name='sag <b>'))


def names(finding):
    return [cause.name for cause in finding.causes]


def test_a_sag_is_found_and_its_gain_measured(sag):
    """0.5 V: named alone, within four errors, gain above zero, rail as it is without."""
    assert sag.verdict is Verdict.EXPLAINED and names(sag) == ['load_sag']
    (cause,) = sag.causes
    fall = cause.term.linear + cause.term.square
    assert abs(fall - 0.5) < 4.0 * math.hypot(*cause.se.values())
    assert cause.gain > 1.96 * cause.gain_se and cause.p_value < 1e-6
    assert cause.gain == pytest.approx(sag.gain) and sag.score > sag.baseline_score
    ou = sag.model.ou
    assert abs(ou.alpha - RAIL.alpha) < 4.0 * sag.se[0]['alpha']
    assert sag.baseline.alpha < 0.7 * RAIL.alpha
    assert any(c.statistic.startswith('throttle') for c in sag.discrepancies)
    assert len(sag.remaining) < len(sag.discrepancies)
    json.dumps(sag.as_data(), allow_nan=False)


def test_repeats_are_undone_and_the_rail_found_behind():
    found = discover(drawn_from(HeldSamples(250.0)))
    assert 'held_samples' in names(found)
    cause = found.causes[0]
    # Both models are scored on readings: leaving repeats out is no gain.
    assert cause.exact and cause.p_value == 0.0 and cause.gain == 0.0
    assert abs(found.model.ou.alpha - RAIL.alpha) < 4.0 * found.se[0]['alpha']
    # The model that is saved repeats; the one compared with the samples left does not.
    assert 'held_samples' in [term.NAME for term in found.model.terms]
    assert 'held_samples' not in [term.NAME for term in found.simulated.terms]


def test_same_seed_same_finding_and_progress_to_the_end():
    """Bit for bit; the share done rises to 1."""
    shares = []
    recording = drawn_from(n=4000)
    first = discover(recording, seed=3, progress=shares.append)
    assert first.as_data() == discover(recording, seed=3).as_data()
    assert shares == sorted(shares) and shares[-1] == 1.0 and len(shares) > 5


def test_discover_loads_few_modules():
    """At most 55 of the package, and 67 with the readers: one reads them all to understand it."""
    code = ("import sys; of = lambda: sum(name.split('.')[0] == 'ou_monitor' "
            'for name in sys.modules); import ou_monitor.discovery.discover; print(of()); '
            'from ou_monitor import read_recording; print(of())')
    run = subprocess.run([sys.executable, '-c', code], cwd=ROOT, capture_output=True, text=True,
                         check=True)
    alone, reading = map(int, run.stdout.split())
    assert 20 < alone <= 55 and alone < reading <= 67


def test_a_path_is_read(tmp_path):
    recording = drawn_from(n=1500)
    path = tmp_path / 'x.csv'
    np.savetxt(path, np.column_stack([recording.t, recording.voltage]), '%.9g', ',', comments='',
               header='time_s,voltage_v')
    assert discover(str(path)).n == 1500 and ou_monitor.discover is discover
    with pytest.raises(InputError, match='nowhere'):
        discover(tmp_path / 'nowhere.csv')


def test_the_page_shows_verdict_causes_plots_and_command(sag):
    """Well formed, escaped, finite; verdict, cause, pictures, command."""
    html = page_of(discovery_document(sag), 'ou-monitor discover x.csv')
    root = self_contained(html)
    text = ' '.join(''.join(root.itertext()).split())
    assert 'sag <b>' in text and '<b>' not in html
    for part in ('load_sag', 'Statistics before and after', 'ou-monitor discover x.csv',
                 'V/sqrt(s)'):
        assert part in text
    # Names of causes stand behind plain ones.
    said = sag.sentence
    assert 'sag (load_sag)' in said and ' '.join(said.replace('+-', '\u00b1').split()) in text
    # The voltage over its simulations, and over load and frequency.
    assert len(root.findall('.//figure/svg')) == 4
    coordinates = re.findall(r'="([^"]*)"', ''.join(
        re.findall(r'<(?:path|line|circle|rect)[^>]*>', html)))
    assert not any(re.search(r'nan|inf', c) for c in coordinates)
    assert all(text.count(one.statistic) for one in sag.discrepancies[:18])


def plots(parts):
    """Return the plots of parts by title."""
    found = {}
    for part in parts:
        if isinstance(part, Figure):
            found[part.drawing.title] = part.drawing
        elif isinstance(part, (Section, Pair)) or callable(part):
            found |= plots(part() if callable(part) else getattr(part, 'parts', None)
                           or getattr(part, 'figures', ()))
    return found


def test_the_pictures_show_what_a_plain_simulation_lacks(sag):
    """The fall under load lies in the band of the extended model, outside the plain OU's."""
    found = plots(discovery_document(sag).parts)
    assert set(found) == {'Voltage', 'Voltage over load', 'Changes between samples', 'Spectrum'}
    plain, extended, measured = found['Voltage over load'].curves
    assert (plain.label, extended.label, measured.label) == (
        'plain OU', 'extended model', 'measured')
    falls = np.polyfit(measured.x, measured.y, 1)[0]
    assert falls == pytest.approx(-0.5, abs=0.1)
    inside = [float(np.mean((one.y <= measured.y) & (measured.y <= one.high)))
              for one in (plain, extended)]
    # Of 20 draws, a correct model's range holds a 21st in 19 of 21 bins on average.
    assert inside[0] < 0.7 < inside[1]


@needs_recordings
def test_a_clean_bench_stays_quiet():
    """mm_bench_5: white and clean, nothing to find."""
    found = discover(REAL / 'mm_bench_5.csv')
    assert found.verdict is Verdict.NO_EFFECT


@needs_recordings
@pytest.mark.parametrize('name', ['mm_bench_1', 'mm_bench_3'])
def test_a_motor_that_starts_late_gains_nothing_absurd(name):
    """What the other blocks did not see is left out: gains are known within errors, or unknown."""
    # In mm_bench_3 a line that wanders from 236 to 246 Hz in 0.7 s has most of the variance: over
    # all blocks its gain is known to half of itself only; the likelihood of the whole names it.
    found = discover(REAL / f'{name}.csv')
    for one in (found, *found.causes):
        assert math.isnan(one.gain) == math.isnan(one.gain_se)
        assert math.isnan(one.gain) or one.gain > -3.0 * one.gain_se - 0.05
    if name == 'mm_bench_3':
        (line,) = [cause for cause in found.causes if cause.term.FAMILY == 'line']
        assert 232.0 < line.term.frequency < 250.0
        assert line.gain > line.gain_se and line.p_value < 1e-50


def test_the_page_of_a_plain_rail_keeps_the_plain_model():
    """No extended model is shown where nothing was added: one picture each, and it is said so."""
    found = discover(drawn_from(seed=2, n=5000))
    assert found.verdict is Verdict.NO_EFFECT
    root = parsed(page_of(discovery_document(found)))
    text = ' '.join(''.join(root.itertext()).split())
    assert 'No cause was named: this is the plain OU' in text and 'xtended' not in text
    assert 'simulations of the plain OU at each moment' in text
    assert len(root.findall('.//figure/svg')) == 4
    assert 'xtended' not in terminal(discovery_document(found))


@pytest.mark.parametrize('limit', [0.149, 0.61])
def test_ctrl_c_ends_the_search_and_the_gains(limit):
    """No partial result is returned that a script could take for a whole one."""
    def progress(share):
        if share > limit:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        discover(drawn_from(LoadSag(0.5, 0.0), n=6000), progress=progress)
