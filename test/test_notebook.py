"""The notebook of doc/ runs from its first cell to its last, as a kernel would run it."""

import ast
import json

from project import ROOT
import pytest

NOTEBOOK = ROOT / 'doc/recording_in_python.ipynb'


def test_the_notebook_runs_and_its_answers_are_those_of_the_recording(monkeypatch):
    monkeypatch.chdir(NOTEBOOK.parent)
    shown = []
    space = {'display': shown.append}
    book = json.loads(NOTEBOOK.read_text(encoding='utf-8'))
    assert book['nbformat'] == 4 and len({cell['id'] for cell in book['cells']}) == len(
        book['cells'])
    for cell in book['cells']:
        if cell['cell_type'] != 'code':
            continue
        assert cell['outputs'] == [] and cell['execution_count'] is None
        tree = ast.parse(''.join(cell['source']))
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        exec(compile(tree, NOTEBOOK.name, 'exec'), space)
        if last is not None:
            shown.append(eval(compile(ast.Expression(last.value), NOTEBOOK.name, 'eval'), space))
    assert any('<svg' in found._repr_html_() for found in shown if hasattr(found, '_repr_html_'))
    recording, analysis = space['recording'], space['analysis']
    assert analysis.supply.lowest.voltage_v == recording.voltage.min()
    assert 'load_sag' in [cause.name for cause in space['finding'].causes]
    assert space['drawn'].duration == pytest.approx(recording.duration, abs=0.01)
    assert space['drawn'].voltage.mean() == pytest.approx(recording.voltage.mean(), abs=0.1)
    assert shown[-1].explained > 0.9
