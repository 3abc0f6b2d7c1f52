"""`ou-monitor compare`: its sentence, table, JSON and page, and errors."""

from xml.etree import ElementTree

from command_line import answer, failure, write_csv
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.recordings.model_file import as_yaml, ModelFile
import pytest

# Keys of the JSON that users hold on to (none may go or change its name), and their types.
BAND = {'measured': float, 'simulated_low': float, 'simulated_median': float,
        'simulated_high': float}
CONTRACT = {
    'recording': str, 'fitted_s': [float], 'simulated_s': [float], 'model': [str],
    'mean_path': {'variance_explained': float, 'rmse_v': float, 'bias_v': float,
                  'bias_by_third_v': [float]},
    'lowest_v': BAND, 'crossings_per_min': [{'level_v': float, **BAND}],
    'spectrum': [{'from_hz': float, 'to_hz': float, 'simulated_over_measured': float}],
    'ks_distance': float, 'worst': str, 'verdict': str}
MODEL = SupplyModel((OU(20.0, 0.3, 15.0), LoadSag(1.5, 0.0)))


@pytest.fixture(scope='module')
def folder(tmp_path_factory):
    """Return a folder with a flight, the same without throttle, and the model of it."""
    path = tmp_path_factory.mktemp('compared')
    t = np.arange(2000) / 50.0
    u = np.random.default_rng(1).random(30)[(t / 1.5).astype(int)]
    v = MODEL.simulate(t, np.random.default_rng(2), u)
    write_csv(path / 'my flight.csv', t, v, u)
    write_csv(path / 'bench.csv', t, v)
    (path / 'model.yaml').write_text(as_yaml(ModelFile(MODEL)), encoding='utf-8')
    wrong = SupplyModel((OU(20.0, 0.6, 15.0), LoadSag(1.5, 0.0)))
    (path / 'wrong.yaml').write_text(as_yaml(ModelFile(wrong)), encoding='utf-8')
    return path


def check(data, shape, where='$'):
    """Compare names and types, all the way down."""
    if isinstance(shape, dict):
        assert set(data) == set(shape), where
        for key, inner in shape.items():
            check(data[key], inner, f'{where}.{key}')
    elif isinstance(shape, list):
        assert data, where
        for item in data:
            check(item, shape[0], where + '[]')
    else:
        assert type(data) is shape, f'{where}: {data!r}'


@pytest.mark.parametrize('name, options', [
    ('my flight', []), ('bench', ['--fit-until', '15']), ('my flight', ['--model', 'model.yaml'])])
def test_json_has_the_documented_keys(folder, capsys, name, options, monkeypatch):
    """Names and types, with a model, without, and without throttle."""
    monkeypatch.chdir(folder)
    data = answer(capsys, 'compare', f'{name}.csv', '--seeds', '20', *options)
    # Section 11: test_supply_in_json.py.  Steps of an unknown load look like a slow OU.
    assert data.pop('supply')['ou']['status'] == ('too_short' if name == 'bench' else 'ok')
    check(data, CONTRACT)
    assert data['verdict'] in ('looks_like_it', 'differs')
    assert len(data['crossings_per_min']) == 2 and len(data['fitted_s']) == 2
    assert len(data['mean_path']['bias_by_third_v']) == 3
    assert data['simulated_s'][1] == pytest.approx(39.98)
    assert data['fitted_s'][1] == data['simulated_s'][0]


def test_the_page_shows_the_traces_first(folder, tmp_path, capsys):
    """A page that parses, its first plot right under the sentence; the command repeats it."""
    page = tmp_path / 'page.html'
    assert main(['compare', str(folder / 'my flight.csv'), '--seeds', '20', '--model',
                 str(folder / 'model.yaml'), '--report', str(page)]) == 0
    assert capsys.readouterr().out.endswith(f'Report: {page}\n')
    text = page.read_text(encoding='utf-8')
    root = ElementTree.fromstring(text.replace('<!DOCTYPE html>', '', 1))
    body = root.find('body')
    names = [child.get('class') or child.tag for child in body]
    assert names.index('figure') == names.index('headline') + 1
    assert 'measured' in text and 'one simulation' in text
    assert '--seeds 20' in text and '--model' in text


@pytest.mark.parametrize('options, words', [
    (['--fit-until', '99'], 'the fit must end within the recording, 0 to 39.98 s, got 99 s'),
    (['--fit-until', 'nan'], "--fit-until: 'nan' is not a time in seconds"),
    (['--seeds', '5'], "--seeds: '5' is not a whole number, 20 to 10000"),
    (['--to', '1'], 'a comparison needs at least 100'),
    (['--brownout-voltage', '-1'], "--brownout-voltage: '-1' is not a positive number"),
    (['--model', 'my flight.csv'], 'my flight.csv'),
    (['--model', 'none.yaml'], 'none.yaml')])
def test_bad_input_is_one_line(folder, capsys, options, words, monkeypatch):
    monkeypatch.chdir(folder)
    assert words in failure(capsys, 'compare', 'my flight.csv', *options)


def test_a_model_that_needs_throttle_is_refused_without(folder, capsys):
    error = failure(capsys, 'compare', folder / 'bench.csv', '--model', folder / 'model.yaml')
    assert "the model's term 'load_sag' needs throttle, and the recording has none" in error
