"""The report of `simulate`: the simulated recording and its terms."""

from __future__ import annotations

from pathlib import Path

from ou_monitor.records import NAN
from ou_monitor.report.analysis_document import voltage_plot
from ou_monitor.report.document import Document, Facts, Figure
from ou_monitor.report.svg import Plot
from ou_monitor.simulation import Run


def simulation_document(run: Run, output: str | Path | None = None) -> Document:
    """Return the report of a simulation; `output` is the bag, if one was written."""
    terms = run.file.model.terms
    said = (f"{run.n} samples of '{run.name}', {run.duration:g} s at {run.rate:g} Hz, "
            f"{', '.join(term.NAME for term in terms)}; seed {run.seed}")
    return Document(
        'Simulation', f'{output or run.name}: {said}', [said], [
            lambda: [Figure(voltage_plot(run.recording, NAN)),
                     Figure(Plot(*(('Current', 'time, s', 'A') if run.file.model.full_current else
                                   ('Throttle', 'time, s', 'throttle')), height=160).line(
                         run.recording.t, run.load, '', 2))],
            Facts([(term.NAME, ', '.join(f'{name} {_words(value)}' for name, value in
                                         term.values().items())) for term in terms])])


def _words(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(map(_words, value))}]"
    return f'{value:.4g}' if isinstance(value, float) else str(value)
