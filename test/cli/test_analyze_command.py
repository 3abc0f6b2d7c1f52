"""`ou-monitor analyze`: table, JSON and page; the limit; one line for every bad input."""

import math
import re

from command_line import answer, failure, strict, write_csv
import numpy as np
from ou_monitor.analysis.crafts import pack_limit
from ou_monitor.cli.main import main
from ou_monitor.errors import InputError
from ou_monitor.model.ou import simulate
import pytest

ALPHA, SECONDS = 63.0, 6.0
SIGMA = {0.1: 0.3156, 0.4: 0.632}


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Return a CSV that holds two load levels of the paper, 6 s each at 500 Hz."""
    t = np.arange(int(2 * SECONDS * 500)) / 500.0
    throttle = np.where(t < SECONDS, 0.1, 0.4)
    sigma = np.where(t < SECONDS, SIGMA[0.1], SIGMA[0.4])
    voltage = simulate(t, ALPHA, sigma, np.random.default_rng(1), u0=5.0 - 0.5 * throttle)
    return write_csv(tmp_path_factory.mktemp('csv') / 'flight <b>.csv', t, voltage, throttle)


def test_json_on_standard_output_is_alone_and_true(flight, capsys):
    """Both levels, within 4 standard errors of the truth."""
    # T = 6 s: ln alpha and ln Var_inf scatter by sqrt(2/(63*6)) = 7.3 %; ln sigma by about
    # 1/sqrt(2*3000) = 1.3 %, 1.5 % with alpha unknown.
    data = answer(capsys, 'analyze', flight)
    assert (data['n'], data['recording']) == (6000, 'flight <b>.csv')
    assert [level['throttle'] for level in data['levels']] == pytest.approx([0.1, 0.4])
    for level in data['levels']:
        sigma = SIGMA[round(level['throttle'], 2)]
        assert abs(math.log(level['sigma'] / sigma)) < 4 * 0.015
        assert abs(math.log(level['alpha'] / ALPHA)) < 4 * 0.073
        assert abs(math.log(level['var_inf'] * 2 * ALPHA / sigma ** 2)) < 4 * 0.073
        assert level['sigma_ci95'][0] < level['sigma'] < level['sigma_ci95'][1]
        assert level['status'] == 'OK' and level['process_type'] == 'diffusion'


def test_report_and_json_files(flight, tmp_path, capsys):
    """Both are written; the page says how to repeat itself, quoted for a shell."""
    report, data = tmp_path / 'r.html', tmp_path / 'r.json'
    assert main(['analyze', str(flight), '--levels', '0.4,0.1', '--window', '1.5',
                 '--brownout-voltage', '4.5', '--report', str(report),
                 '--json', str(data)]) == 0
    assert f'Report: {report}' in capsys.readouterr().out
    sliding = strict(data.read_text())['sliding']
    assert (sliding['window_s'], sliding['brownout_voltage']) == (1.5, 4.5)
    assert all(0.0 <= p <= 1.0 for p in sliding['brownout_risk'])
    html = report.read_text(encoding='utf-8')
    assert '<b>' not in html and '&lt;b&gt;' in html
    command = re.search('<code>(.*)</code>', html).group(1)
    assert command.startswith('ou-monitor analyze &#x27;')
    assert '.csv&#x27; --levels 0.4,0.1 --window 1.5 --brownout-voltage 4.5 --report' in command


def test_unknown_is_null(tmp_path, capsys):
    """A stuck sensor without throttle: status and nulls, exit status 0."""
    path = write_csv(tmp_path / 'stuck.csv', np.arange(100) / 100.0, np.full(100, 5.0))
    (level,) = answer(capsys, 'analyze', path)['levels']
    assert level['throttle'] is None and level['sigma'] is None
    assert level['sigma_ci95'] == [None, None] and level['status'] == 'CONSTANT'


@pytest.mark.parametrize('options, word', [
    (['--levels', '5,10'], "'5'"), (['--levels', 'a'], "'a'"), (['--levels', ''], "''"),
    (['--levels', '0.1,0.1'], 'twice'), (['--levels', '1_0e-2'], "'1_0e-2'"),
    (['--window', '1_0'], "'1_0' is not"), (['--window', '\u0663'], "'\u0663' is not"),
    (['--cells', '9' * 5000], '9...99999'),
    (['--sample-interval', '1e-320'], 'within 1e-12 to 100 s'),
    (['--sample-interval', '1e308'], 'within 1e-12 to 100 s'), (['--levels', 'nan'], "'nan'"),
    (['--window', '0'], '--window'), (['--window', 'inf'], '--window'),
    (['--window', 'x'], '--window'), (['--window', '7200'], '--window: 7200 is not within'),
    (['--brownout-voltage', 'x'], '--brownout-voltage'),
    (['--brownout-horizon', '-1'], '--brownout-horizon'),
    (['--brownout-horizon', '1e6'], '--brownout-horizon: 1e+06 is not within 0.001 to 3600'),
    (['--brownout-voltage', '5000'], '--brownout-voltage: 5000 is not within 0 to 1000'),
    (['--from', '-1'], "--from: '-1'"), (['--to', 'x'], "--to: 'x'"),
    (['--from', '4', '--to', '3'], '--from 4 is not before --to 3'),
    (['--report', '-'], '--report'), (['--report', '/nowhere/r.html'], '/nowhere'),
    (['--json', '/nowhere/r.json'], '/nowhere'), (['--report', '/'], 'folder'),
])
def test_bad_options_are_named(flight, options, word, capsys):
    assert word in failure(capsys, 'analyze', flight, *options)


@pytest.mark.parametrize('content, word', [
    (None, 'bad.csv'), ('', 'empty'), ('time_s,voltage_v\n', 'no usable sample'),
    ('time_s,voltage_v\n0,5\n', '1 usable sample'),
    ('time_s,voltage_v\n0,5\n1,5.1\n', '2 usable samples'), ('time_s,amps\n0,5\n1,5\n', 'volt'),
    ('time_s,voltage_v\n0,nan\n1,nan\n', 'no usable sample'),
])
def test_bad_recordings_are_named(tmp_path, content, word, capsys):
    """Missing, empty, header only, one sample, wrong column, nothing but NaN."""
    path = tmp_path / 'bad.csv'
    if content is not None:
        path.write_text(content)
    assert word in failure(capsys, 'analyze', path)


def test_levels_need_a_throttle(tmp_path, capsys):
    """--levels on a recording without throttle cannot be meant."""
    k = np.arange(100)
    path = write_csv(tmp_path / 'plain.csv', k / 100.0, 5.0 + 0.01 * np.sin(k))
    assert 'no throttle' in failure(capsys, 'analyze', path, '--levels', '0.1')


def test_a_horizon_asked_for_is_that_of_every_budget(flight, capsys):
    assert main(['analyze', str(flight), '--brownout-voltage', '4.5', '--brownout-horizon', '1',
                 '--json', '-']) == 0
    data = strict(capsys.readouterr().out)
    budget = data['supply']['budget']
    assert (budget['throttle'], budget['horizon_s']) == (data['brownout']['throttle_budget'], 1.0)


def test_the_default_of_a_5_v_rail_is_for_one(tmp_path, capsys):
    """A battery of four cells gets no risk against 4.5 V, and the reason."""
    rng = np.random.default_rng(3)
    path = write_csv(tmp_path / 'a.csv', 1e-3 * np.arange(2000),
                     15.0 + 0.0015 * rng.standard_normal(2000).cumsum())
    assert main(['analyze', str(path)]) == 0
    said = ' '.join(capsys.readouterr().out.split())
    assert 'Safe up to unknown: no limit; --brownout-voltage or --cells sets one' in said
    # With a throttle it may be a craft, whose limit is suggested.
    u = np.repeat(rng.uniform(0.1, 0.9, 40), 25).round(2)
    craft = write_csv(tmp_path / 'craft.csv', 0.02 * np.arange(1000),
                      15.9 - u + 0.01 * rng.standard_normal(1000), u)
    assert main(['analyze', str(craft)]) == 0
    said = ' '.join(capsys.readouterr().out.split())
    assert '--cells 4 (a guess from the voltage) sets it to 13.2 V (empty under load)' in said
    found = answer(capsys, 'analyze', path, '--brownout-voltage', '14')
    assert found['brownout']['voltage'] == 14.0 and 0.0 <= found['sliding']['brownout_risk'][-1]


@pytest.mark.parametrize('voltage, cells, limit', [
    (None, None, None), (14.0, None, 14.0), (None, 4, 13.2), (3.5, 4, 14.0), (3.5, 1, 3.5),
    (4.5, None, 4.5)])
def test_with_cells_the_limit_is_volts_per_cell(voltage, cells, limit):
    """Without, of the whole; cells alone have a limit of their own."""
    found = pack_limit(voltage, cells)
    assert found == (None if limit is None else pytest.approx(limit, rel=1e-12))


def test_volts_of_the_pack_beside_cells_are_refused():
    with pytest.raises(InputError, match='no cell has 14 V: write 3.5, or leave --cells out'):
        pack_limit(14.0, 4)


@pytest.mark.parametrize('cells', ['0', '-1', '2.5', 'four', '99'])
def test_an_invalid_number_of_cells_is_one_line(cells, capsys):
    assert main(['analyze', 'x.csv', '--cells', cells]) == 2
    assert f"'{cells}' is not a number of cells, 1 to 28" in capsys.readouterr().err
