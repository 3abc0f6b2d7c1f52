"""Headline, cautions, numbers, and the plain data behind the JSON."""

from dataclasses import replace
import math

from made_recordings import recording, without_throttle
from ou_monitor.offline.analyze import analyze
from ou_monitor.offline.words import as_data, cautions, headline, NOISE_UNKNOWN, number
from ou_monitor.records import Flag
import pytest

TRUTH = ((0.1, 0.3156), (0.4, 0.632))
LEVEL_KEYS = {
    'throttle', 'segments', 'time_s', 'n', 'mean', 'vpp', 'peak', 'vrms', 'crest', 'alpha',
    'alpha_se', 'alpha_ci95', 'tau', 'tau_se', 'tau_ci95', 'sigma', 'sigma_se', 'sigma_ci95',
    'var_inf', 'var_inf_se', 'var_inf_ci95', 'u0', 'u0_se', 'noise_std', 'excess_kurtosis',
    'excess_kurtosis_se', 'process_type', 'process_reason', 'status', 'status_text', 'flags',
    'notes'}


@pytest.mark.parametrize('value, digits, text', [
    (0.0, 3, '0'), (math.nan, 3, '-'), (math.inf, 3, '-'), (15.0, 3, '15.0'), (0.02, 3, '0.0200'),
    (99.96, 3, '100'), (0.9999, 3, '1.00'), (123456.0, 3, '123456'), (1234567.0, 3, '1.23e6'),
    (7.91e-4, 3, '7.91e-4'), (0.00317, 3, '0.00317'), (-63.04, 3, '-63.0'), (4.9351, 4, '4.935')])
def test_number(value, digits, text):
    """Significant digits, zeros kept, rounding across a decade."""
    assert number(value, digits) == text


def test_headline_tells_growth_with_its_interval():
    """A doubled sigma grows; an equal one does not change measurably."""
    grown = headline(analyze(recording(1, TRUTH)))
    assert grown.startswith('Sigma grows from') and '10 % to 40 % throttle' in grown
    same = headline(analyze(recording(2, ((0.1, 0.3), (0.4, 0.3)))))
    assert 'does not change measurably' in same
    fallen = headline(analyze(recording(3, ((0.1, 0.6), (0.4, 0.3)))))
    assert fallen.startswith('Sigma falls from')


def test_headline_of_one_level_and_of_none():
    """One level is described; without any the reader is sent to the statuses."""
    made = without_throttle(recording(4, ((0.1, 0.3),)))
    assert headline(analyze(made)).startswith('The supply wanders with sigma = 0.')
    short = recording(5, ((0.1, 0.3),), seconds=0.012)
    assert 'can be fitted' in headline(analyze(short))


def test_data_has_all_keys_and_the_values_of_the_levels():
    """Keys are stable; the tau interval is that of alpha, turned over."""
    analysis = analyze(recording(6, TRUTH))
    data = as_data(analysis)
    assert set(data) == {'recording', 'n', 'duration_s', 'rate_hz', 'source', 'headline',
                         'levels', 'sliding', 'notes'}
    assert (data['n'], data['duration_s']) == (20000, pytest.approx(19.999))
    assert data['rate_hz'] == pytest.approx(1000.0)
    for level, found in zip(data['levels'], analysis.levels):
        assert set(level) == LEVEL_KEYS
        assert level['alpha'] == found.estimate.alpha
        assert level['tau'] == pytest.approx(1.0 / level['alpha'])
        assert level['tau_ci95'][0] == pytest.approx(1.0 / level['alpha_ci95'][1])
        assert level['alpha_ci95'][1] / level['alpha'] == pytest.approx(
            math.exp(1.96 * level['alpha_se']), rel=1e-4)
        assert level['var_inf'] == pytest.approx(level['sigma'] ** 2 / (2 * level['alpha']))
    lengths = {len(data['sliding'][name]) for name in ('t', 'alpha', 'sigma', 'status')}
    assert len(lengths) == 1 and lengths.pop() > 10


def test_the_same_caution_of_two_levels_is_said_once():
    """It is led by both labels."""
    analysis = analyze(recording(7, TRUTH))

    def with_changes(**changes):
        return replace(analysis, levels=tuple(
            replace(level, estimate=replace(level.estimate, **changes))
            for level in analysis.levels))

    said = cautions(with_changes(flags=(Flag.QUANTIZED,), noise_std=0.001))
    assert said == [f'10 %, 40 %: {Flag.QUANTIZED.value}']
    assert cautions(with_changes(flags=(), noise_std=0.001)) == []
    assert cautions(with_changes(flags=(), noise_std=math.nan)) == [
        f'10 %, 40 %: {NOISE_UNKNOWN}']
