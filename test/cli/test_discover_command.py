"""`ou-monitor discover`: CSV in; summary, JSON, model, page out; one line for bad input."""

import json
import re
from xml.etree import ElementTree

from command_line import answer, failure, strict, write_csv
import numpy as np
from ou_monitor.cli.main import main
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.ou import OU
from ou_monitor.online.load.load_filter import LoadFilter
from ou_monitor.recordings.model_file import read_model
from ou_monitor.recordings.read import read_recording
from project import ROOT
import pytest


@pytest.fixture(scope='module')
def flight(tmp_path_factory):
    """Return a CSV of a rail that sags, 6 s at 500 Hz."""
    rng = np.random.default_rng(2)
    t = np.arange(3000) / 500.0
    u = np.repeat(rng.random(15), 200)
    v = SupplyModel((OU(63.0, 0.3156, 5.0), LoadSag(0.6, 0.0))).simulate(t, rng, u)
    return write_csv(tmp_path_factory.mktemp('csv') / 'my flight.csv', t, v, u)


def test_json_on_standard_output_is_alone(flight, capsys):
    data = answer(capsys, 'discover', flight)
    assert data['n'] == 3000 and data['recording'] == 'my flight.csv'
    assert data['verdict'] == 'explained'
    assert [cause['name'] for cause in data['causes']] == ['load_sag']
    assert data['extended']['gain'] == pytest.approx(
        data['extended']['heldout_score'] - data['baseline']['heldout_score'])


def test_a_part_is_read_and_said_again(flight, tmp_path, capsys, monkeypatch):
    page = tmp_path / 'a.html'
    part = ['--from', '2', '--to', '2.2']
    data = answer(capsys, 'discover', flight, *part, '--report', page)
    assert data['n'] == 100 and data['duration_s'] == pytest.approx(0.198)
    assert '--from 2 --to 2.2' in page.read_text()
    assert "--from: 'x'" in failure(capsys, 'discover', flight, '--from', 'x')
    assert 'no sample from 100 s' in failure(capsys, 'discover', flight, '--from', '100')
    monkeypatch.setattr('sys.stderr.isatty', lambda: True)
    bag = ROOT / 'bags' / 'load_40'
    assert main(['discover', str(bag), '--to', '0.1', '--json', str(tmp_path / 'a.json')]) == 0
    assert re.search(r'reading \[#+\] 100%', capsys.readouterr().err)


def test_one_run_writes_summary_model_and_page(flight, tmp_path, capsys):
    """All at once: within 100 columns; the model can be read and simulated; the page parses."""
    data, model, page = (tmp_path / name for name in ('d.json', 'm.yaml', 'r.html'))
    assert main(['discover', str(flight), '--seed', '5', '--json', str(data), '--save-model',
                 str(model), '--report', str(page)]) == 0
    out = capsys.readouterr().out
    assert all(len(line) <= 100 for line in out.replace(str(tmp_path), '').splitlines())
    for part in ('A plain simulation lacks sag (load_sag)', 'gain, mnat/sample', 'dips below',
                 'The plain OU, whose noise', str(model), str(page)):
        assert part in out
    file = read_model(model)
    found = strict(data.read_text())
    assert [term.NAME for term in file.model.terms] == list(found['extended']['params'])
    assert file.se[0]['alpha'] == pytest.approx(found['extended']['se']['ou']['alpha'])
    # What the load filter learned from the same recording goes with it.
    recording, loads = read_recording(flight), LoadFilter()
    loads.push(recording.t, recording.voltage, recording.throttle)
    assert file.model.load is not None and file.model.load == loads.learned()
    assert file.provenance['recording'] == 'my flight.csv' and file.provenance['seed'] == 5
    assert file.provenance['heldout_score'] == found['extended']['heldout_score']
    text = page.read_text()
    ElementTree.fromstring(text.replace('<!DOCTYPE html>\n', ''))
    assert f'ou-monitor discover &#x27;{flight}&#x27; --seed 5' in text
    bag = tmp_path / 'again.mcap'
    assert main(['simulate', '--model', str(model), '--throttle', '0.4', '--duration', '2',
                 '--rate', '200', '--output', str(bag)]) == 0
    assert bag.stat().st_size > 1000


def test_too_short_still_writes_all_but_the_model(tmp_path, capsys):
    path, data, page = (tmp_path / name for name in ('short.csv', 'd.json', 'r.html'))
    write_csv(path, np.array([0.0, 0.1, 0.2]), np.array([5.0, 5.1, 5.0]))
    words = ['discover', path, '--save-model', tmp_path / 'm.yaml', '--report', page, '--json']
    assert 'no model' in failure(capsys, *words, data)
    assert strict(data.read_text())['verdict'] == 'insufficient_data'
    assert 'at least' in page.read_text() and not (tmp_path / 'm.yaml').exists()
    page.unlink()
    assert main(['discover', str(path)]) == 0
    assert 'at least' in capsys.readouterr().out
    assert main([str(word) for word in words] + ['-']) == 2
    out, err = capsys.readouterr()
    assert strict(out)['verdict'] == 'insufficient_data' and err.count('\n') == 1


@pytest.mark.parametrize('words, part', [
    (['--seed', '-1'], '--seed'), (['--report', '-'], '--report'),
    (['--save-model', '-'], '--save-model'), (['--json', '/no/such/folder/x.json'], 'folder'),
    (['--msg-config', 'px4'], 'CSV'), (['--reprot', 'x'], '--report')])
def test_bad_options_are_one_line(flight, capsys, words, part):
    assert part in failure(capsys, 'discover', flight, *words)


def test_bad_recordings_are_one_line(tmp_path, capsys):
    assert 'none.csv' in failure(capsys, 'discover', tmp_path / 'none.csv')
    path = tmp_path / 'odd.csv'
    path.write_text('a,b\n1,2\n')
    failure(capsys, 'discover', path)


def test_a_model_over_current_is_saved_simulated_and_compared(tmp_path, capsys):
    """A vehicle without throttle: its measured current is the load of all commands."""
    rng = np.random.default_rng(4)
    t = np.arange(3000) / 50.0
    amps = np.repeat(rng.uniform(1.0, 40.0, 60), 50)
    volts = 16.0 - 0.03 * amps + 0.01 * rng.standard_normal(t.size)
    path = write_csv(tmp_path / 'a.csv', t, volts, current=amps)
    bare = write_csv(tmp_path / 'bare.csv', t, volts)
    model, data, bag = tmp_path / 'm.yaml', tmp_path / 'a.json', tmp_path / 'b.mcap'
    assert main(['discover', str(path), '--save-model', str(model)]) == 0
    assert main(['simulate', '--model', str(model), '--throttle', str(path), '--output',
                 str(bag)]) == 0
    drawn = read_recording(bag)
    np.testing.assert_allclose(drawn.current, amps[:drawn.n], rtol=1e-6)
    assert not drawn.has_throttle
    slope = -np.polyfit(drawn.current, drawn.voltage, 1)[0]
    # Its error is 0.01 V / (11 A sqrt(3000)) = 2e-5 Ohm.
    assert slope == pytest.approx(0.03, abs=2e-4)
    for run in (path, bag):
        assert main(['compare', str(run), '--model', str(model), '--json', str(data),
                     '--force']) == 0
        found = json.loads(data.read_text())
        assert found['verdict'] == 'looks_like_it'
        assert found['mean_path']['variance_explained'] > 0.98
    capsys.readouterr()
    assert main(['simulate', '--model', str(model), '--throttle', '0.5', '--export', 'json']) == 0
    assert json.loads(capsys.readouterr().out)['full_load_a'] == pytest.approx(amps.max(), rel=0.1)
    for words in (['compare', bare, '--model', model],
                  ['simulate', '--model', model, '--throttle', bare, '--output',
                   tmp_path / 'c.mcap']):
        assert 'a current' in failure(capsys, *words)
