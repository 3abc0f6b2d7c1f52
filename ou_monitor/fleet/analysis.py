"""Analyse one recording for the fleet table; workers run this module."""

from __future__ import annotations

from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

import numpy as np
from ou_monitor.analysis.analyze import analyze
from ou_monitor.analysis.crafts import check_cells, full_voltage
from ou_monitor.analysis.level_result import LevelResult
from ou_monitor.analysis.overview import Overview
from ou_monitor.analysis.quality import faults
from ou_monitor.errors import InputError
from ou_monitor.fleet.vehicles import start_of
from ou_monitor.online.risk.first_passage import brownout_probability
from ou_monitor.recordings.importers.formats import CSV, kind_of
from ou_monitor.recordings.importers.log import CsvColumns
from ou_monitor.recordings.read import read_recording
from ou_monitor.records import Defect, defect_of, NAN, Recording
from ou_monitor.text import printable
from ou_monitor.timeline import check_size


@dataclass(frozen=True)
class Options:
    """Options of the analysis, the same for every recording of the fleet."""

    levels: tuple[float, ...] | None = None  # Throttles of the load levels; None: detect them
    window: float = 2.0  # Window of the sliding estimate, s
    # Voltage, V, and horizon, s, of the risk; if the voltage is NaN, the risk is unknown.
    brownout_voltage: float = NAN
    brownout_horizon: float = 5.0
    cells: int = 0  # Cells in series; 0: from the log, else a guess
    # Arguments of `read_recording`.
    msg_config: str | None = None
    msg_config_hash: str = ''  # Of the file; if it changes, the recordings are analysed again
    voltage_topic: str | None = None
    throttle_topic: str | None = None
    columns: CsvColumns | None = None
    # Whether to read the intact part of damaged bags; bad lines of CSVs are always skipped.
    partial: bool = False
    discover: bool = False  # Whether to search for causes: some seconds per recording
    seed: int = 0


def work(path: str, options: Options) -> dict[str, Any]:
    """Analyse one recording; the result reports any failure."""
    try:
        return _analysed(path, options)
    except InputError as error:
        why = str(error)
    except MemoryError:
        why = 'The recording does not fit into the memory of the worker: use fewer workers.'
    except Exception as error:
        # A defect of this package must not stop the analysis of the other recordings.
        why = (f'The analysis failed ({type(error).__name__}: {printable(error, 200)}): please '
               'report it.')
    return {'error': ' '.join(why.split()), 'levels': []}


def _analysed(path: str, options: Options) -> dict[str, Any]:
    recording = read_recording(
        path, msg_config=options.msg_config, voltage_topic=options.voltage_topic,
        throttle_topic=options.throttle_topic, columns=options.columns,
        partial=options.partial or kind_of(Path(path)) == CSV)
    check_size(recording)
    if found := faults(recording):
        # Such a recording is not compared with the others.
        raise InputError(' '.join(item.text for item in found))
    if options.cells:
        check_cells(full_voltage(recording), options.cells)
    # Overflows give non-finite values, which the analysis reports in its status.
    with np.errstate(all='ignore'):
        analysis = analyze(
            recording, levels=options.levels if recording.has_throttle else None,
            window=options.window, brownout_voltage=options.brownout_voltage,
            brownout_horizon=options.brownout_horizon, cells=options.cells)
        start, start_from = start_of(recording)
        facts, craft = analysis.overview.facts, analysis.craft
        known = analysis.sliding.risk[np.isfinite(analysis.sliding.risk)]
        return {
            'error': '', 'recording': recording.name,
            'vehicle': recording.source.get('vehicle', ''),
            'start': start, 'start_from': start_from, 'duration_s': recording.duration,
            'samples': recording.n, 'rate_hz': (recording.n - 1) / recording.duration,
            **_facts(analysis.overview), 'supply': facts.to_dict(),
            'cells': craft.cells or None, 'cells_from': craft.cells_from, 'full_v': craft.full_v,
            'risk_max': float(known.max()) if known.size else NAN,
            'alpha_p': analysis.alpha_test.p_value,
            'quality': [f'{item.severity.value}: {item.text}' for item in analysis.quality],
            'levels': [_level(level, options) for level in analysis.levels],
            'notes': list(analysis.notes), 'damage': [
                note for note in recording.notes if defect_of(note) is Defect.DAMAGED_FILE],
            **(_discovery(recording, options.seed) if options.discover else {})}


def _level(level: LevelResult, options: Options) -> dict[str, Any]:
    e = level.estimate
    risk = NAN if math.isnan(options.brownout_voltage) else brownout_probability(
        e, options.brownout_voltage, options.brownout_horizon)
    line = level.lines.lines[0] if level.lines.lines else None
    return {
        'level': level.label, 'throttle': level.throttle, 'time_s': level.time, 'n': level.n,
        'mean': level.mean, 'vpp': level.vpp, 'vrms': level.vrms,
        **{name: float(getattr(e, name)) for name in (
            'alpha', 'alpha_se', 'sigma', 'sigma_se', 'var_inf', 'var_inf_se', 'u0', 'u0_se',
            'noise_std')},
        'excess_kurtosis': level.shape.kurtosis, 'impulses': level.shape.impulses,
        'line_hz': line.frequency if line else NAN, 'line_rms': line.rms if line else NAN,
        'process': level.kind.value, 'risk': risk, 'status': e.status.name,
        'flags': [flag.name for flag in e.flags]}


def _facts(found: Overview) -> dict[str, float]:
    lowest, dips, sag = found.facts.lowest, found.facts.dips, found.facts.sag
    there = found.sag if sag.known else (NAN, NAN, NAN)
    return {
        'lowest': lowest.voltage_v, 'lowest_at': lowest.time_s, 'lowest_throttle': lowest.throttle,
        'dips': dips.count if dips else NAN, 'below_s': dips.seconds if dips else NAN,
        'sag_throttle': there[0], 'sag': there[1], 'sag_se': there[2],
        'sag_full': sag.sag_v[-1] if sag.known else NAN,
        'sag_full_se': sag.se_v[-1] if sag.known else NAN,
        'resistance': found.facts.resistance.ohm, 'resistance_se': found.facts.resistance.se_ohm}


def _discovery(recording: Recording, seed: int) -> dict[str, Any]:
    from ou_monitor.discovery.discover import discover

    finding = discover(recording, seed=seed)
    return {'verdict': finding.verdict.value, 'causes': [cause.name for cause in finding.causes],
            'gain': finding.gain, 'gain_se': finding.gain_se}
