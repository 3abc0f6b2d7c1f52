"""
`analyze` and `discover` see the same in the same samples: one whitening, one finder, one test.

`analyze` takes a recording as one load level, here with all of its level; `discover` scores
the same model with its own filter of many terms.  The samples are those that `discover` keeps, of
every bag and of every recorded run there is, tables and raw logs.
"""

import math

import numpy as np
from ou_monitor.analysis.level_result import fit_all
from ou_monitor.analysis.levels import find_levels
from ou_monitor.analysis.noise import remainder
from ou_monitor.criticism.composite import view_of
from ou_monitor.criticism.innovations import FAMILY_WISE, innovations, second_relaxation
from ou_monitor.criticism.integrity import examine
from ou_monitor.criticism.samples import Samples
from ou_monitor.criticism.structure import evaluate
from ou_monitor.model.sinusoid import FALSE_ALARM
from ou_monitor.model.spectral_lines import find_lines, on_grid
from ou_monitor.model.terms.ou import OU
from ou_monitor.model.terms.reading import MeasurementNoise
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.records import Recording
from project import REAL, recorded, ROOT
import pytest
from simulated_recordings import as_one_level

PATHS = [*sorted(path.parent for path in (ROOT / 'bags').glob('**/metadata.yaml')),
         *sorted(REAL.glob('*.csv')), *sorted((REAL / 'raw').glob('*.[bBu]*'))]
BATTERY = 'battery_status[0].voltage_v'
# A line this unlikely by chance is clear: the two models whiten a little differently.
CLEAR = 1e-3 * FALSE_ALARM


@pytest.fixture(scope='module', params=PATHS, ids=lambda path: path.name)
def both(request):
    """Return samples, what `analyze` says of them, and what `discover` may look at."""
    # Of the two batteries of a log the first.
    columns = CsvColumns(voltage=BATTERY) if request.param.suffix == '.ulg' else None
    whole = recorded(request.param, **({} if columns is None else {'columns': columns}))
    kept = examine(whole)
    if kept.samples is None:
        # Neither verb says anything.
        assert not as_one_level(whole).estimate.usable
        pytest.skip(kept.reason)
    samples = Samples(kept.samples.t, kept.samples.voltage, None)
    same = Recording(samples.t, samples.voltage, np.full(samples.n, np.nan), 'same')
    level = as_one_level(same)
    # Lines were found before they were taken out of the fit.
    fit = fit_all(same, remainder(same), find_levels(same.t, same.throttle))
    if fit.usable:
        terms = [OU(fit.alpha, fit.sigma, float(samples.voltage.mean()))]
        if fit.noise_std > 0.0:
            terms.append(MeasurementNoise(fit.noise_std))
        gaussian = evaluate(samples, terms)
    else:
        # No relaxation: both whiten by nothing but the mean.
        rate = 1.0 / float(np.median(samples.step[1:]))
        gaussian = evaluate(samples, [OU(rate, math.sqrt(2.0 * rate) * float(
            samples.voltage.std()), float(samples.voltage.mean()))])
    return samples, level, fit, view_of(samples, gaussian, gaussian.z, slice(0, samples.n))


def test_the_scores_are_the_same(both):
    """To 5e-3 of a standard deviation, on an even clock: one of the two takes a settled gain."""
    samples, _, fit, view = both
    if not fit.usable or np.ptp(np.diff(samples.t)) > 1e-3 * samples.step[1]:
        pytest.skip('no OU in white noise, or an uneven clock')
    noise = fit.noise_std ** 2 if fit.noise_std > 0.0 else 0.0
    z = innovations(samples.t, samples.voltage - samples.voltage.mean(), fit.alpha,
                    fit.sigma ** 2 / (2.0 * fit.alpha), noise)
    assert z == pytest.approx(view.z, abs=5e-3)


def test_the_lines_are_the_same(both):
    # Both are asked at one false-alarm rate: at the higher one of `lines_of`, which proposes, the
    # feet of neighbouring lines join (five in the 8 Hz of bf_ar8_6s.BFL become two). A line below
    # one percent of the noise may be found by one alone (18 Hz in frc_ol_1, .1 %).
    _, level, _, view = both
    scores = on_grid(view.at, view.z)
    ours, theirs = level.lines.lines, find_lines([scores.values], scores.rate).lines
    for some, others in ((ours, theirs), (theirs, ours)):
        for line in some:
            assert line.p_value > CLEAR or line.share < 0.01 or any(
                abs(line.frequency - other.frequency)
                < 2.0 * max(line.resolution, other.resolution) for other in others), line


def test_a_second_relaxation_is_the_same(both):
    samples, _, fit, view = both
    if not fit.usable:
        pytest.skip('no OU in white noise')
    noise = fit.noise_std ** 2 if fit.noise_std > 0.0 else 0.0
    var_inf = fit.sigma ** 2 / (2.0 * fit.alpha)
    z = innovations(samples.t, samples.voltage - samples.voltage.mean(), fit.alpha, var_inf,
                    noise)
    ours, theirs = (second_relaxation([scores], view.rate, fit.alpha, var_inf, noise)[0]
                    for scores in (z, view.z))
    assert (ours < FAMILY_WISE) == (theirs < FAMILY_WISE)
    assert math.isclose(ours, theirs, rel_tol=0.05, abs_tol=1e-3)
