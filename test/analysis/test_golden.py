"""
Golden tables: results of `analyze` for the bags, number by number, and against their truth.

After an intended change of numbers, run `scripts/make_golden.py` and look at the differences.
"""

import importlib.util
import json
import math
import sys

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.recordings.read import read_recording
from project import ROOT
import pytest
import yaml

NAMES = sorted(path.parent.name for path in (ROOT / 'bags').glob('*/truth.yaml'))
# Another BLAS changes numbers by 1e-10 and risks of 1e-184 by 1e-6 (measured).
RELATIVE = 1e-6
# Voltages and probabilities smaller than this count as 0.
ABSOLUTE = 1e-12


@pytest.fixture(scope='module')
def maker():
    """Return scripts/make_golden.py as a module."""
    spec = importlib.util.spec_from_file_location('make_golden',
                                                  ROOT / 'scripts' / 'make_golden.py')
    module = importlib.util.module_from_spec(spec)
    before = list(sys.path)
    spec.loader.exec_module(module)
    sys.path[:] = before
    return module


@pytest.fixture(scope='module')
def found():
    """Return (truth, analysis) of every bag."""
    return {name: (yaml.safe_load((ROOT / 'bags' / name / 'truth.yaml').read_text('utf-8')),
                   analyze(read_recording(ROOT / 'bags' / name))) for name in NAMES}


def differences(found, wanted, where=''):
    """Return the paths at which two tables differ by more than another BLAS explains."""
    if isinstance(wanted, dict) and isinstance(found, dict):
        if found.keys() != wanted.keys():
            return [f'{where}: keys {sorted(found.keys() ^ wanted.keys())}']
        return [line for key in wanted
                for line in differences(found[key], wanted[key], f'{where}/{key}')]
    if isinstance(wanted, list) and isinstance(found, list):
        if len(found) != len(wanted):
            return [f'{where}: {len(found)} entries, not {len(wanted)}']
        return [line for k, (a, b) in enumerate(zip(found, wanted))
                for line in differences(a, b, f'{where}[{k}]')]
    number = all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in (found, wanted))
    same = (math.isclose(found, wanted, rel_tol=RELATIVE, abs_tol=ABSOLUTE) if number
            else found == wanted)
    return [] if same else [f'{where}: {found}, not {wanted}']


@pytest.mark.parametrize('name', NAMES)
def test_the_tables_are_the_golden_ones(maker, found, name):
    """Every number, word and flag; `scripts/make_golden.py` updates them."""
    wanted = json.loads((maker.GOLDEN / f'{name}.json').read_text(encoding='utf-8'))
    assert differences(maker.table(found[name][1]), wanted)[:10] == []


def test_a_small_change_of_a_number_is_a_difference(maker):
    """A change by 1e-5, a missing entry, a lost key, another word."""
    wanted = json.loads((maker.GOLDEN / 'transient.json').read_text(encoding='utf-8'))
    for change in (lambda d: d['levels'][0].update(alpha=d['levels'][0]['alpha'] * 1.00001),
                   lambda d: d['levels'].pop(), lambda d: d['brownout'].pop('horizon_s'),
                   lambda d: d['levels'][0].update(status='SHORT_WINDOW'),
                   lambda d: d['transients'][0].update(tau=None)):
        changed = json.loads(json.dumps(wanted))
        change(changed)
        assert len(differences(changed, wanted)) == 1


def test_intervals_of_the_bags_hold_their_truth(found):
    """
    Alpha, sigma and Var_inf of all levels of all bags, 42 intervals: at least 35 hold.

    A binomial of 42 and 0.95 falls below 35 with probability 3e-3; every one holds at 4
    standard errors.
    """
    inside, total = 0, 0
    for truth, analysis in found.values():
        p = truth['parameters']
        for level in analysis.levels:
            sigma = p.get('sigma') or float(np.interp(
                level.throttle, *zip(*p['sigma_by_throttle'])))
            for name, value in (('alpha', p['alpha']), ('sigma', sigma),
                                ('var_inf', sigma ** 2 / (2.0 * p['alpha']))):
                low, high = level.estimate.interval(name)
                inside += low < value < high
                total += 1
                low, high = level.estimate.interval(name, 4.0)
                assert low < value < high, (analysis.recording.name, level.label, name)
    assert total == 42 and inside >= 35


def test_the_transient_is_that_of_the_bag(found):
    """Figure 5: tau = 1/63 s in both intervals, A = 368 mV, and not the instrument."""
    truth, analysis = found['transient']
    p = truth['parameters']
    for fit, cause, sign in zip(analysis.relaxations, analysis.causes, (-1.0, 1.0)):
        assert fit.tau_low < 1.0 / p['alpha'] < fit.tau_high
        (change,) = fit.releases
        assert change.amplitude == pytest.approx(sign * p['sag'], abs=3.0 * change.amplitude_se)
        # Motion of the voltage begins with the sample after the one that has the new throttle.
        assert change.t - analysis.recording.t[0] == pytest.approx(
            p['throttle_off_s'] if fit.kind == 'release' else p['throttle_on_s'], abs=2e-3)
        assert cause.instrument == 'excluded' and cause.ratio_low < 1.0 < cause.ratio_high


def test_sag_of_the_flight_is_that_of_the_bag(found):
    """0.3 V at full throttle: each level and each throttle flown within 3 standard errors."""
    truth, analysis = found['flight']
    sag = truth['parameters']['sag']
    for level in analysis.levels[1:]:
        assert level.sag.sag == pytest.approx(sag * level.throttle, abs=3.0 * level.sag.sag_se)
    curves = analysis.by_throttle
    off = np.abs(curves.sag - sag * curves.throttle)[curves.known]
    assert np.all(off <= 3.0 * ((curves.sag_high - curves.sag_low) / 3.92)[curves.known])


def test_no_bag_has_a_line_a_flag_of_shape_or_another_alpha(found):
    """OU in white noise and nothing else: 'diffusion' throughout, no line, one alpha."""
    for _, analysis in found.values():
        assert {level.kind.value for level in analysis.levels} == {'diffusion'}
        assert not any(level.lines.lines for level in analysis.levels)
        assert analysis.alpha_test.verdict != 'differs'
