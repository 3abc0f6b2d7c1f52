"""`ou-monitor reproduce` for users."""

from xml.etree import ElementTree

from command_line import failure, strict
from ou_monitor.cli.main import main
from ou_monitor.paper import reproduce as module
import pytest


def test_table_json_and_report_agree(tmp_path, capsys, monkeypatch):
    """One run writes all three, and they agree; test_bench.py has a second with the same seed."""
    monkeypatch.setattr(module, 'CREST_PATHS', 200)
    monkeypatch.setattr(module, 'JUMP_SECONDS', 10.0)
    report, data = tmp_path / 'r.html', tmp_path / 'r.json'
    assert main(['reproduce', '--seed', '7', '--report', str(report), '--json', str(data)]) == 0
    out, err = capsys.readouterr()
    assert err == ''
    lines = out.splitlines()
    assert all(len(line) <= 100 for line in lines)
    found = strict(data.read_text(encoding='utf-8'))
    assert found['seed'] == 7 and f'Report: {report}' in lines
    # The table has one line a row, in the same order, with the same verdict.
    words = {'AGREES': 'agrees', 'ROUNDING': 'rounding', 'DOES_NOT_HOLD': 'does not hold'}
    shown = [line for line in lines if line.endswith(tuple('  ' + w for w in words.values()))]
    assert [line.split('  ')[-1] for line in shown] == [
        words[row['verdict']] for row in found['rows']]
    assert ' '.join(found['headline'].split()) in ' '.join(out.split())
    for point in found['points']:
        assert point['text'] in ' '.join(out.split())
    # The page.
    html = report.read_text(encoding='utf-8')
    ElementTree.fromstring(html.replace('<!DOCTYPE html>\n', ''))
    assert found['headline'] in html and 'ou-monitor reproduce --seed 7' in html
    # What must come out.
    verdict = {(row['where'], row['quantity']): row['verdict'] for row in found['rows']}
    assert verdict['Section 3.3', 'B of (6), telegraph'] == 'DOES_NOT_HOLD'
    assert verdict['Section 4.5', 'd ln alpha / d ln C'] == 'DOES_NOT_HOLD'
    assert verdict['Table 2', 'sigma, 40 %'] == 'AGREES'
    assert verdict['Table 1', 'Vrms, motors off'] == 'ROUNDING'


@pytest.mark.parametrize('options, word', [
    (['--seed', '-1'], '--seed'), (['--seed', 'x'], '--seed'), (['--seed', '1.5'], '--seed'),
    (['--report', '-'], '--report'), (['--report', '/nowhere/r.html'], '/nowhere'),
    (['--json', '/nowhere/r.json'], '/nowhere'), (['--report', '/'], 'folder'),
    (['paper.txt'], 'paper.txt'), (['--sead', '1'], '--seed')])
def test_bad_options_are_named(options, word, capsys):
    """One line with the option or the value, before any work."""
    assert word in failure(capsys, 'reproduce', *options)
