"""`ou-monitor discover`: CSV in; summary, JSON, model and page out; bad input one line."""

import json
import re
from xml.etree import ElementTree

import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_sag import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.recordings.model_file import read_model
import pytest


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Return a CSV of a rail that sags, 12 s at 500 Hz."""
    rng = np.random.default_rng(2)
    t = np.arange(6000) / 500.0
    u = np.repeat(rng.random(31), 200)[:t.size]
    v = SupplyModel((OU(63.0, 0.3156, 5.0), LoadSag(0.6, 0.0))).simulate(t, rng, u)
    path = tmp_path_factory.mktemp('csv') / 'my flight.csv'
    write(path, t, v, u)
    return path


def write(path, t, voltage, throttle=None):
    """Write a CSV as the contract has it."""
    columns = [t, voltage] if throttle is None else [t, voltage, throttle]
    np.savetxt(path, np.column_stack(columns), '%.9g', ',', comments='',
               header=','.join(['time_s', 'voltage_v', 'throttle'][:len(columns)]))


def strict(text):
    """Parse JSON; NaN and Infinity are errors."""
    def refuse(word):
        raise ValueError(f'{word} is not JSON')

    return json.loads(text, parse_constant=refuse)


def failure(capsys, *argv):
    """Run a command that must fail; return its one line."""
    assert main([str(word) for word in argv]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert re.fullmatch(r'ou-monitor discover: [^\n]+\n', err)
    return err


def test_json_on_standard_output_is_alone(flight, capsys):
    """Strict JSON, nothing beside it, the sag in it."""
    assert main(['discover', str(flight), '--json', '-']) == 0
    out, err = capsys.readouterr()
    data = strict(out)
    assert err == '' and data['n'] == 6000 and data['recording'] == 'my flight.csv'
    assert data['verdict'] == 'explained'
    assert [cause['name'] for cause in data['causes']] == ['load_sag']
    assert data['extended']['gain'] == pytest.approx(
        data['extended']['heldout_score'] - data['baseline']['heldout_score'])


def test_summary_model_and_page(flight, tmp_path, capsys):
    """All at once: within 100 columns; the model can be read and simulated; the page parses."""
    data, model, page = (tmp_path / name for name in ('d.json', 'm.yaml', 'r.html'))
    assert main(['discover', str(flight), '--seed', '5', '--json', str(data), '--save-model',
                 str(model), '--report', str(page)]) == 0
    out = capsys.readouterr().out
    assert all(len(line) <= 100 for line in out.replace(str(tmp_path), '').splitlines())
    for part in ('explained by load_sag', 'gain mnat/sample', 'times a minute', 'Plain OU: alpha',
                 str(model), str(page)):
        assert part in out
    file = read_model(model)
    found = strict(data.read_text())
    assert [term.NAME for term in file.model.terms] == list(found['extended']['params'])
    assert file.se[0]['alpha'] == pytest.approx(found['extended']['se']['ou']['alpha'])
    assert file.provenance['recording'] == 'my flight.csv' and file.provenance['seed'] == 5
    assert file.provenance['heldout_score'] == found['extended']['heldout_score']
    text = page.read_text()
    ElementTree.fromstring(text.replace('<!DOCTYPE html>\n', ''))
    assert f'ou-monitor discover &#x27;{flight}&#x27; --seed 5' in text
    bag = tmp_path / 'again.mcap'
    assert main(['simulate', '--model', str(model), '--throttle', '0.4', '--duration', '2',
                 '--rate', '200', '--output', str(bag)]) == 0
    assert bag.stat().st_size > 1000


def test_too_short_is_a_result(tmp_path, capsys):
    """Exit 0 with the reason; but there is no model to save."""
    path = tmp_path / 'short.csv'
    write(path, np.array([0.0, 0.1]), np.array([5.0, 5.1]))
    assert main(['discover', str(path)]) == 0
    assert 'at least' in capsys.readouterr().out
    err = failure(capsys, 'discover', path, '--save-model', tmp_path / 'm.yaml')
    assert 'no model' in err and not (tmp_path / 'm.yaml').exists()


@pytest.mark.parametrize('words, part', [
    (['--seed', '-1'], '--seed'), (['--report', '-'], '--report'),
    (['--save-model', '-'], '--save-model'), (['--json', '/no/such/folder/x.json'], 'folder'),
    (['--msg-config', 'px4'], 'CSV'), (['--reprot', 'x'], '--report')])
def test_bad_options_are_one_line(flight, capsys, words, part):
    """Each names what is wrong."""
    assert main(['discover', str(flight), *words]) == 2
    out, err = capsys.readouterr()
    assert out == '' and part in err and err.count('\n') == 1


def test_bad_recordings_are_one_line(tmp_path, capsys):
    """A missing file, and one without the columns."""
    assert 'none.csv' in failure(capsys, 'discover', tmp_path / 'none.csv')
    path = tmp_path / 'odd.csv'
    path.write_text('a,b\n1,2\n')
    failure(capsys, 'discover', path)
