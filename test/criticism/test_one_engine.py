"""
`analyze` and `discover` see the same in the same samples: one whitening, one finder, one test.

`analyze` takes a recording as one load level, fitted by the onboard estimator; `discover` scores
the same model with its own filter of many terms.  The samples are those that `discover` keeps.
"""

import math
import os
from pathlib import Path

import numpy as np
from ou_monitor.analysis.level_result import fit_level
from ou_monitor.analysis.levels import LoadLevel, Segment
from ou_monitor.criticism.composite import fit_composite, view_of
from ou_monitor.criticism.innovations import FAMILY_WISE, innovations, other_pole
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.spectral_lines import FALSE_ALARM
from ou_monitor.model.terms.measurement_noise import MeasurementNoise
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.tone import lines_of
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import NAN, Recording
from project import ROOT
import pytest

REAL = Path(os.environ.get('OU_MONITOR_REALDATA', 'nowhere'))
PATHS = [*sorted(path.parent for path in (ROOT / 'bags').glob('**/metadata.yaml')),
         *(sorted(REAL.glob('*.csv')))]
# A line this unlikely by chance is clear: the two models whiten a little differently.
CLEAR = 1e-3 * FALSE_ALARM


@pytest.fixture(scope='module', params=PATHS, ids=lambda path: path.name)
def both(request):
    """Return samples, what `analyze` says of them, and what `discover` may look at."""
    kept = examine(read_recording(request.param)).samples
    samples = Samples(kept.t, kept.voltage, None)
    recording = Recording(samples.t, samples.voltage, np.full(samples.n, NAN), 'same')
    level = fit_level(recording, recording, LoadLevel(NAN, (Segment(0, samples.n),)), 1)
    # Lines were found before they were taken out of the fit.
    seen = level.with_lines or level.estimate
    if seen.usable:
        terms = [OU(seen.alpha, seen.sigma, float(samples.voltage.mean()))]
        if seen.noise_std > 0.0:
            terms.append(MeasurementNoise(seen.noise_std))
        gaussian = evaluate(samples, terms)
    else:
        start = OU(1.0 / float(np.median(samples.step[1:])), 1.0, float(samples.voltage.mean()))
        gaussian = fit_composite(samples, [start], slice(0, samples.n)).gaussian
    return samples, level, seen, view_of(samples, gaussian, gaussian.z, slice(0, samples.n))


def test_the_scores_are_the_same(both):
    """To 5e-3 of a standard deviation, on an even clock: one of the two takes a settled gain."""
    samples, _, seen, view = both
    if not seen.usable or np.ptp(np.diff(samples.t)) > 1e-3 * samples.step[1]:
        pytest.skip('no OU in white noise, or an uneven clock')
    noise = seen.noise_std ** 2 if seen.noise_std > 0.0 else 0.0
    z = innovations(samples.t, samples.voltage - samples.voltage.mean(), seen.alpha,
                    seen.sigma ** 2 / (2.0 * seen.alpha), noise)
    assert z == pytest.approx(view.z, abs=5e-3)


def test_the_lines_are_the_same(both):
    """Each clear line of one is a line of the other, to the width of two bins."""
    _, level, _, view = both
    ours = level.lines.lines
    theirs = [line for line in lines_of(view) if line.p_value < FALSE_ALARM]
    for some, others in ((ours, theirs), (theirs, ours)):
        for line in some:
            assert line.p_value > CLEAR or any(
                abs(line.frequency - other.frequency)
                < 2.0 * max(line.resolution, other.resolution) for other in others), line


def test_another_pole_is_the_same(both):
    """A second relaxation and an AC coupling, from the scores of either."""
    samples, _, seen, view = both
    if not seen.usable:
        pytest.skip('no OU in white noise')
    noise = seen.noise_std ** 2 if seen.noise_std > 0.0 else 0.0
    var_inf = seen.sigma ** 2 / (2.0 * seen.alpha)
    z = innovations(samples.t, samples.voltage - samples.voltage.mean(), seen.alpha, var_inf,
                    noise)
    found = [other_pole([scores], view.rate, seen.alpha, var_inf, noise)
             for scores in (z, view.z)]
    for name in ('second_p', 'coupling_p'):
        ours, theirs = (getattr(pole, name) for pole in found)
        assert (ours < FAMILY_WISE) == (theirs < FAMILY_WISE)
        assert math.isclose(ours, theirs, rel_tol=0.05, abs_tol=1e-3)
