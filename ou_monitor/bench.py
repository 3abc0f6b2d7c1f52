"""
The commands on recordings and models as functions that return a `Result`.

A recording is a `Recording`, or a path that `read_recording` reads.  Modules are imported inside
the functions, so that each function loads only what it uses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING, Union

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import as_numbers, as_seconds, FloatArray, Recording
from ou_monitor.report.result import Result
from ou_monitor.text import counted, number
from ou_monitor.timeline import check_size, ordered, readings_of, supplied

if TYPE_CHECKING:
    from ou_monitor.analysis.analyze import Analysis
    from ou_monitor.analysis.coupling import Coupling
    from ou_monitor.analysis.supply import SupplyFacts
    from ou_monitor.model.supply import SupplyModel
    from ou_monitor.paper.design import Flight
    from ou_monitor.recordings.importers.log import CsvColumns, Series
    from ou_monitor.recordings.model_file import ModelFile
    from ou_monitor.simulation import Profile, Run

Given = Union[Recording, str, Path]
Progress = Callable[[float], None]
Pairs = tuple[npt.ArrayLike, npt.ArrayLike]

# Minimum rate at which samples are written in blocks by default, Hz.
_BLOCKS_FROM = 5000.0


def _read(recording: Given) -> Recording:
    if isinstance(recording, Recording):
        return ordered(recording)
    if not isinstance(recording, (str, Path)):
        raise TypeError('a Recording or a path is needed, got a '
                        f'{type(recording).__name__}: make a Recording(t, voltage, throttle)')
    from ou_monitor.recordings.read import read_recording

    return read_recording(recording)


def _limit(recording: Recording, limit: float | None, cells: int) -> tuple[float | None, int]:
    """Return the pack's limit, V, and number of cells: as given, else as the log states them."""
    from ou_monitor.analysis.crafts import check_cells, full_voltage, pack_limit, stated_limit

    for name, value in (('brownout_voltage', limit), ('cells', cells)):
        if value is not None and not isinstance(value, (int, float, np.number)):
            raise TypeError(f'{name} must be a number, got {value!r}')
    if cells:
        check_cells(full_voltage(recording), cells)
    if (given := pack_limit(limit, cells)) is not None:
        return given, cells
    stated = stated_limit(recording.source)
    return (None, 0) if stated is None else (stated[1], stated[0])


def analyze(recording: Given, *, levels: tuple[float, ...] | None = None, window: float = 2.0,
            brownout_voltage: float | None = None, brownout_horizon: float = 5.0, cells: int = 0,
            progress: Progress | None = None) -> Result:
    """
    Analyze the noise of a supply, load level by load level.

    Parameters
    ----------
    recording : Recording or path
        Voltage, V, and throttle, 0..1.
    levels : tuple of float, optional
        Throttles, 0..1, of the load levels; by default they are detected.
    window : float
        Window of the sliding estimate, s.
    brownout_voltage : float, optional
        Brown-out limit, V; if `cells` is given, V per cell, by default 3.3.  If neither is given:
        the limit in the log's header, else, for a 5 V rail, the default of the node.
    brownout_horizon : float
        Horizon of the risk, s.
    cells : int
        Cells in series; 0: from the log, or a guess.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Result
        Its record has `levels`, `by_throttle`, `quality`, `craft`; its table one row per level.

    Raises
    ------
    InputError
        When the recording cannot be read, is too short, or contradicts `cells`.

    Examples
    --------
    >>> from ou_monitor import analyze, read_recording
    >>> found = analyze(read_recording('bags/load_40', end=5.0))
    >>> round(found.supply.ou.sigma, 1), found.to_dict()['levels'][0]['process_type']
    (0.6, 'diffusion')

    """
    from dataclasses import replace
    from ou_monitor.analysis.analyze import analyze as analyzed
    from ou_monitor.report.analysis_document import analysis_document

    recording = _read(recording)
    voltage, cells = _limit(recording, brownout_voltage, cells)
    check_size(recording)
    if levels is not None and not recording.has_throttle:
        raise InputError(f"--levels: '{recording.name}' has no throttle; leave --levels out, or "
                         'name the topic with --throttle-topic')
    found = analyzed(recording, levels=levels, window=window, brownout_voltage=voltage,
                     brownout_horizon=brownout_horizon, cells=cells, progress=progress)
    facts = found.overview.facts
    if found.brownout_default:
        # Without a given limit, `supply` has no dips and no budget, as with the other commands.
        facts = replace(facts, dips=None, budget=None)
    return Result(found, partial(analysis_document, found), partial(_analysis_data, found),
                  'levels', facts)


def _analysis_data(found: Analysis) -> dict[str, Any]:
    from ou_monitor.analysis.analyze import as_data
    from ou_monitor.report.analysis_document import analysis_document

    return {**as_data(found), 'headline': analysis_document(found).headline}


def compare(recording: Given, model: SupplyModel | str | Path | None = None, *,
            fit_until: float | None = None, seeds: int = 50, seed: int = 0,
            levels: tuple[float, ...] = (), brownout_voltage: float | None = None,
            cells: int = 0, progress: Progress | None = None) -> Result:
    """
    Compare a recording with simulations of it.

    Parameters
    ----------
    recording : Recording or path
        Voltage, V, and throttle, 0..1.
    model : SupplyModel or path, optional
        Model to simulate; by default a model fitted to the part before fit_until.
    fit_until : float, optional
        Start of the simulated part, s after the first sample; by default the middle of the
        recording, or its first sample if a model is given.
    seeds : int
        Number of simulations, 20 to 10000.
    seed : int
        Equal seeds give equal simulations.
    levels : tuple of float
        Further voltages, V, below which dips are counted.
    brownout_voltage, cells
        As for `analyze`; dips below that voltage are counted too.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Result
        What the simulations get right and wrong; its table has one row per measure.

    Raises
    ------
    InputError
        When the recording is too short, is constant, or lacks the throttle that the model needs;
        when fit_until lies outside the recording.
    ValueError
        When seeds is out of its range.

    Examples
    --------
    >>> from ou_monitor import compare, read_recording
    >>> found = compare(read_recording('bags/flight', end=4.0), seeds=20)
    >>> round(found.lowest.measured, 2), found.seeds
    (4.96, 20)

    """
    from ou_monitor.analysis.overview import overview
    from ou_monitor.comparison.compare import compare as compared
    from ou_monitor.recordings.model_file import read_model
    from ou_monitor.report.comparison_document import comparison_document

    if isinstance(model, (str, Path)):
        model = read_model(model).model
    recording = _read(recording)
    limit, cells = _limit(recording, brownout_voltage, cells)
    with np.errstate(over='ignore', under='ignore'):
        found = compared(recording, model, fit_until=fit_until, seeds=seeds, seed=seed,
                         levels=levels if limit is None else (*levels, limit), progress=progress)
    seen = overview(recording, limit, cells=cells)
    return Result(found, partial(comparison_document, found, seen), found.as_data,
                  found.measures, seen.facts)


def coupling(recording: Given, signal: str | Series | Pairs, *,
             band: tuple[float, float] | None = None, level: float = 0.05,
             brownout_voltage: float | None = None, cells: int = 0) -> Result:
    """
    Estimate how much of a signal is supply noise.

    Parameters
    ----------
    recording : Recording or path
        The supply.
    signal : str or pair of arrays
        The signal.  If the recording is a path: name of a topic and field, a column or a series
        in that file; if it is a `Recording`: stamps (s, or dates) and values.
    band : tuple of float, optional
        Frequency band, Hz; by default from 5 Hz to a quarter of the slower rate.
    level : float
        Probability of a false alarm.
    brownout_voltage, cells
        As for `analyze`; dips below that voltage are counted.

    Returns
    -------
    Result
        Gain, lag, coherence; its table has one row per frequency.

    Raises
    ------
    InputError
        When there is no such signal, or it hardly overlaps with the voltage.

    Examples
    --------
    >>> import numpy as np
    >>> from ou_monitor import coupling, read_recording
    >>> supply = read_recording('bags/load_40', end=10.0)
    >>> noise = np.random.default_rng(1).standard_normal(supply.n)
    >>> found = coupling(supply, (supply.t, 3.0 * supply.voltage + 0.1 * noise))
    >>> found.seen, round(found.gain, 1)
    (True, 3.0)

    """
    from ou_monitor.analysis.coupling import as_data, estimate_coupling
    from ou_monitor.analysis.overview import overview
    from ou_monitor.recordings.importers.log import Series, UNKNOWN
    from ou_monitor.recordings.read import read_beside
    from ou_monitor.report.coupling_document import coupling_document

    name = signal if isinstance(signal, str) else 'signal'
    if isinstance(signal, str):
        if isinstance(recording, Recording):
            raise InputError(f"the signal '{signal}' is in a file: give its path instead of a "
                             'Recording, or stamps and values instead of a name')
        recording, signal = read_beside(recording, signal)
    recording = _read(recording)
    unit = ''
    if isinstance(signal, Series):
        name = signal.name if name == 'signal' else name
        unit = '' if signal.unit == UNKNOWN else signal.unit
        signal = signal.t, signal.values
    if len(signal) != 2 or not np.ndim(signal[0]):
        raise InputError('the signal must be stamps and values, (t, values)')
    t, values = as_seconds(signal[0]), as_numbers(signal[1])
    limit, cells = _limit(recording, brownout_voltage, cells)
    try:
        found = estimate_coupling(recording.t, recording.voltage, t, values,
                                  throttle=recording.throttle, band=band, level=level)
    except InputError as error:
        raise InputError(f"'{recording.name}', signal '{name}': {error}") from error
    # Everything else uses the readings without repeats, as `analyze` does.
    read = readings_of(recording)
    seen = overview(read, limit, cells=cells)
    return Result(
        found, partial(coupling_document, found, read, (t, values), name, unit, seen),
        partial(as_data, found, read.name, name, unit, read.notes), partial(_spectrum, found),
        seen.facts)


def _spectrum(found: Coupling) -> dict[str, Any]:
    return {'frequency_hz': found.frequency, 'coherence': found.coherence,
            'gain_per_v': abs(found.response)}


def discover(recording: Given, *, seed: int = 0, brownout_voltage: float | None = None,
             cells: int = 0, progress: Progress | None = None) -> Result:
    """
    Find what a simulation of a recording gets wrong, name the cause, and extend the model.

    Parameters
    ----------
    recording : Recording or path
        Voltage, V, and throttle, 0..1.
    seed : int
        Equal seeds give equal results.
    brownout_voltage, cells
        As for `analyze`; dips below that voltage are counted.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Result
        Verdict, causes, extended model, gain; its table has one row per cause.

    Raises
    ------
    InputError
        When a path cannot be read.

    Examples
    --------
    >>> from ou_monitor import discover, simulate
    >>> drawn = simulate(preset='transient', duration=20.0, rate=100.0)
    >>> 'load_sag' in [cause.name for cause in discover(drawn.recording).causes]
    True

    """
    from ou_monitor.analysis.overview import overview
    from ou_monitor.discovery.discover import discover as discovered
    from ou_monitor.report.discovery_document import discovery_document

    recording = _read(recording)
    limit, cells = _limit(recording, brownout_voltage, cells)
    # The search refuses values that overflow; NumPy's warnings about them would not help a user.
    with np.errstate(all='ignore'):
        found = discovered(recording, seed=seed, progress=progress)
    seen = overview(recording, limit, cells=cells)
    return Result(found, partial(discovery_document, found, seen), found.as_data, 'causes',
                  seen.facts)


def design(throttle: float | None = None, *, recording: Given | None = None,
           network: Mapping[str, Any] | None = None, rail: str = 'bus',
           voltage: float | None = None, cells: int = 0, horizon: float = 5.0, risk: float = 0.01,
           capacitances: tuple[float, float] | None = None, esr_fixed: bool = False) -> Result:
    """
    Find the smallest bulk capacitance that keeps the brown-out risk of a rail below a target.

    Parameters
    ----------
    throttle : float, optional
        Throttle, 0..1; by default the 99 % quantile of the recording's throttle.
    recording : Recording or path, optional
        Flight from which level, sag, resistance and noise are taken.
    network : mapping, optional
        Components in SI units, such as ``{'cells': 4, 'bulk_capacitance': 470e-6}``.  If the
        recording shows the resistance or battery voltage, a value given here replaces it, as if
        the part were exchanged.  Other values describe the recorded craft.
    rail : {'bus', 'regulated'}
        The battery bus at the ESCs, or the regulated rail.
    voltage : float, optional
        Brown-out level, V; on the bus, if `cells` is given, V per cell (by default 3.3).
    cells : int
        Cells in series; 0: as in the network or the recording.  If the network has 0 cells, or the
        recorded voltage fits no pack, the supply is treated as a rail.
    horizon : float
        Horizon of the risk, s.
    risk : float
        Maximum risk, 0..1; the throttle budget of `analyze` has the same default.
    capacitances : tuple of float, optional
        Smallest and largest capacitance tried, F.
    esr_fixed : bool
        Whether the ESR is constant; by default it falls as 1/C.

    Returns
    -------
    Result
        Verdict, smallest capacitance, other remedies; its table has one row per capacitance.

    Raises
    ------
    InputError
        When the recording has neither throttle nor current or does not show its sag, or its
        voltage does not fit the number of cells.
    ValueError
        When a number is out of its range, or the recording does not show its noise.

    Examples
    --------
    >>> from ou_monitor import design
    >>> found = design(0.3, network={'cells': 4}, risk=1e-3)
    >>> found.verdict.name, 1e-6 < found.least.capacitance < 22e-3
    ('FOUND', True)

    """
    from dataclasses import replace
    from ou_monitor.analysis.crafts import (
        cells_of, check_cells, full_voltage, pack_limit, stated_limit)
    from ou_monitor.analysis.quality import faults
    from ou_monitor.paper.network import completed, PowerNetwork
    from ou_monitor.paper.design import (
        as_data, default_voltage, design as designed, LEAST, MOST, network_of,
        SHOWN)
    from ou_monitor.report.design_document import design_document, taken_words

    if throttle is not None and not hasattr(throttle, '__float__'):
        raise TypeError(f'the throttle is a number, 0..1, got a {type(throttle).__name__}: pass '
                        'a Recording or a path as recording=')
    values = dict(network or {})
    if cells:
        if values.setdefault('cells', cells) != cells:
            raise InputError(f'cells: {cells} and {values["cells"]} are both given: give one; for '
                             'a pack of another voltage, --set battery_voltage=V')
        voltage = pack_limit(voltage, cells) if voltage and rail == 'bus' else voltage
    taken, facts, error, known, assumed = '', None, 0.0, None, False
    if recording is None:
        if throttle is None:
            raise ValueError('the throttle is missing: pass 0.4 for 40 %, or a recording, whose '
                             '99 % quantile of throttle is used')
        circuit = PowerNetwork(**completed(values))
        level, source = (voltage, 'given') if voltage is not None else default_voltage(
            *((circuit.cells, circuit.battery_voltage) if rail == 'bus' else
              (0, circuit.regulator_voltage)))
    else:
        flown = supplied(readings_of(_read(recording)))
        if wrong := faults(flown):
            raise InputError(f'{flown.name}: {wrong[0].text}')
        tried = [(flown, '')]
        if flown.current is not None and (
                most := float(np.fmax.reduce(np.abs(flown.current), initial=0.0))) > 0.0:
            tried = [*(tried if flown.has_throttle else ()), (
                replace(flown, throttle=np.abs(flown.current) / most),
                f' Throttle is the measured current divided by its maximum, {number(most)} A.')]
        full, stated = full_voltage(flown), stated_limit(flown.source)
        cells, origin = (values['cells'], 'given') if 'cells' in values else cells_of(flown)
        values['cells'] = cells
        if cells:
            check_cells(full, cells)
        else:
            # The recorded voltage is the rail's own.
            rail = 'bus'
        if rail == 'bus':
            # The recorded voltage already includes the load of a regulator.
            values.setdefault('regulator_voltage', 0.0)
        if voltage is not None:
            level, source = voltage, 'given'
        elif stated is not None and stated[0] == cells:
            level, source = stated[1], 'from the log'
        else:
            level, source = default_voltage(cells, full)
            if origin == 'guessed':
                source += (f', {counted(cells, "cell")} guessed from the voltage: --cells N '
                           'overrides it; for a rail or lead-acid, give --set cells=0 and '
                           '--brownout-voltage V')
        for one, load in tried:
            flight, facts, risk_of = _flight(
                one, full, cells, level if rail == 'bus' else None, horizon, risk)
            sag, se = flight.sag_at(flight.flown[1])
            # As in analyze: the load is the current if no sag over throttle is measurable.
            if facts.sag.known and sag > 2.0 * se or not flight.resistance > 0.0:
                break
        assert facts is not None
        if load and not flight.resistance > 0.0:
            flight = replace(flight, resistance=float(flight.sag[-1]) / most)
        if not facts.sag.known and 'battery_resistance' not in values:
            raise InputError(f'the sag of {flown.name} is unknown, so a remedy cannot be chosen: '
                             'give --set battery_resistance=OHM, or vary the throttle more')
        # The 99 % quantile, so that a peak of a few readings does not count.
        throttle = min(1.0, flight.flown[1]) if throttle is None else throttle
        circuit = network_of(flight, throttle, values)
        if rail != 'bus' and voltage is None:
            level, source = default_voltage(0, circuit.regulator_voltage)
        assumed = not (flight.resistance > 0.0 or 'battery_resistance' in values)
        share = circuit.battery_resistance / flight.resistance if flight.resistance > 0.0 else 1.0
        taken = taken_words(flight, circuit, throttle, assumed, origin) + load
        sag, se = flight.sag_at(throttle)
        error = se / sag
        if risk_of is not None and not values.keys() & SHOWN and facts.budget is not None and (
                math.isfinite(facts.budget.throttle)):
            known = partial(risk_of, share=share, rise=circuit.battery_voltage - flight.level)
    found = designed(circuit, throttle, voltage=level, horizon=horizon, risk=risk, rail=rail,
                     esr_follows=not esr_fixed, capacitances=capacitances or (LEAST, MOST),
                     sag_error=error, flown=known, assumed=assumed)
    return Result(found, partial(design_document, found, source, taken),
                  partial(as_data, found, source, taken), 'rows', facts)


# Time at the end of a recording from which its level is taken, s.
_RECENT = 10.0


def _flight(recording: Recording, full: float, cells: int, level: float | None, horizon: float,
            risk: float) -> tuple[Flight, SupplyFacts, Callable[..., float] | None]:
    """Return flight, facts, and a function for the risk at the end (full and level in V)."""
    from ou_monitor.analysis.noise import remainder, without_wild
    from ou_monitor.analysis.supply import facts_and_end, node_for
    from ou_monitor.online.estimator.estimator import SLIDING
    from ou_monitor.online.load.supply_load import Basis
    from ou_monitor.online.settings import MonitorSettings
    from ou_monitor.paper.design import Flight

    if not recording.has_throttle:
        raise InputError(f'--from {recording.name}: the recording has no throttle and no current, '
                         'so sag and noise over throttle are unknown: name one '
                         '(--throttle-column, --throttle-topic, --current-column), or give '
                         '--throttle and --set without --from')
    monitor = None
    if level is not None:
        # The same samples as in `analyze`.
        clean, _ = without_wild(recording, remainder(recording))
        monitor, parts = node_for(clean, MonitorSettings(
            window=SLIDING, brownout_voltage=level, brownout_horizon=horizon,
            brownout_budget_limit=risk, brownout_critical=max(risk, 0.5)))
        deque(parts, 0)
    facts, load, _ = facts_and_end(recording, level, monitor=monitor)

    @cache
    def over_throttle(sag: float, noise: float, rise: float) -> FloatArray:
        assert monitor is not None and level is not None
        # The logarithm is interpolated, as for the throttle budget.
        return np.asarray(np.log(np.maximum(
            monitor.changed_risk(sag, noise, level - rise), 1e-300)))

    def risk_at(throttle: float, sag: float, noise: float, *, share: float, rise: float) -> float:
        # share: resistance divided by the recorded one; rise: change of the battery voltage, V.
        risks = over_throttle(share * sag, noise, rise)
        if share < 1.0:
            # Less resistance cannot raise the risk; the error of the level can make it seem so.
            risks = np.minimum(risks, over_throttle(1.0, noise, rise))
        return float(np.exp(np.interp(throttle, np.linspace(0.0, 1.0, risks.size), risks)))

    level_now = load.level
    if load.basis is Basis.CURRENT:
        # That is the voltage at zero current; a flight needs the voltage at zero throttle.
        last = recording.t > recording.t[-1] - _RECENT
        level_now = float(np.nanmedian(recording.voltage[last] + np.interp(
            recording.throttle[last], facts.sag.throttle, facts.sag.sag_v)))
    return Flight(level_now, full, cells, facts.sag.throttle, facts.sag.sag_v, facts.sag.se_v,
                  facts.noise.rms_v, facts.noise.steady_rms_v, facts.noise.flown,
                  facts.resistance.ohm, facts.ou.alpha, facts.ou.var_inf), facts, (
                      risk_at if monitor else None)


def reproduce(*, seed: int = 1, progress: Progress | None = None) -> Result:
    """
    Recompute every number of the paper.

    Parameters
    ----------
    seed : int
        Equal seeds give equal simulations.
    progress : callable, optional
        Called with the share done, 0..1.

    Returns
    -------
    Result
        Its table has one row per printed number, with the verdict.

    Examples
    --------
    >>> from ou_monitor import reproduce
    >>> found = reproduce()
    >>> sorted(found.to_dict()['counts'])
    ['AGREES', 'DOES_NOT_HOLD', 'ROUNDING']

    """
    from ou_monitor.paper.reproduce import as_data, reproduce as reproduced
    from ou_monitor.report.reproduction_document import reproduction_document

    found = reproduced(seed, progress)
    return Result(found, partial(reproduction_document, found), partial(as_data, found), 'rows')


def simulate(model: SupplyModel | ModelFile | str | Path | None = None, *,
             preset: str | None = None, throttle: float | Given | Profile | None = None,
             start: float | None = None, end: float | None = None, duration: float | None = None,
             rate: float | None = None, seed: int = 1, capacity_left: float | None = None,
             scale_resistance: float = 1.0, output: str | Path | None = None,
             message: str | None = None, columns: CsvColumns | None = None,
             progress: Progress | None = None) -> Result:
    """
    Simulate a recording of a supply; doc/simulation.md states which terms are exact.

    Parameters
    ----------
    model : SupplyModel or path, optional
        Model of the supply, or a model file written by `discover`.
    preset : str, optional
        Name of a preset, used without a model; by default 'flight'.
    throttle : str, float, Recording, path or callable, optional
        Name of a profile, throttle 0..1, points 'T:U,T:U,...', a recording, or a function of
        stamps, s; by default the preset's.
    start, end : float, optional
        Part of the recording that `throttle` names, s.
    duration : float, optional
        Length, s; by default the length of the preset or of the recorded throttle.
    rate : float, optional
        Samples per second, Hz; by default the rate of the model's recording if the model file
        states it, else the preset's rate.
    seed : int
        Equal seeds give equal recordings.
    capacity_left : float, optional
        Initial charge, 0..1; -1: as at the start of the model's recording.
    scale_resistance : float
        Factor on the response to throttle.
    output : path, optional
        Bag to write, piece by piece; without it, samples are simulated on demand.
    message : str, optional
        Message of the voltage in the bag.
    columns : CsvColumns, optional
        As for `read_recording`, for the CSV that `throttle` names.
    progress : callable, optional
        Called with the share of the bag written, 0..1.

    Returns
    -------
    Result
        Its record has the `recording`; its table one row per sample.

    Raises
    ------
    InputError
        When there is no such preset, profile or file, or a number is out of its range.

    Examples
    --------
    >>> from ou_monitor import simulate
    >>> found = simulate(preset='load_40', duration=10.0, rate=500.0)
    >>> found.recording.n, round(found.supply.ou.alpha) in range(40, 90)
    (5000, True)

    """
    from ou_monitor.recordings.write import write_recording
    from ou_monitor.report.analysis_document import simulation_document
    from ou_monitor.simulation import plan

    run = plan(model, preset=preset, throttle=throttle, start=start, end=end, duration=duration,
               rate=rate, seed=seed, capacity_left=capacity_left, resistance=scale_resistance,
               columns=columns)
    written: dict[str, Any] = {}
    if output is not None:
        def pieces() -> Iterator[Recording]:
            for piece in run.pieces():
                yield piece
                if progress is not None:
                    progress(round(piece.t[-1] * run.rate + 1.0) / run.n)

        kind = message or ('adc_block' if run.rate >= _BLOCKS_FROM else 'battery_state')
        written = {'topics': write_recording(pieces(), output, type=kind,
                                             sample_rate=run.rate)[0]}

    return Result(
        run, partial(simulation_document, run, output),
        partial(dict, {'output': None if output is None else str(output), **run.as_data(),
                       **written}), partial(_columns, run), partial(_drawn_facts, run))


def _columns(run: Run) -> dict[str, Any]:
    drawn = run.recording
    load = 'throttle' if drawn.current is None else 'current_a'
    return {'time_s': drawn.t, 'voltage_v': drawn.voltage, load: run.load}


def _drawn_facts(run: Run) -> SupplyFacts:
    from ou_monitor.analysis.supply import supply_facts

    return supply_facts(run.recording)
