"""
Export a model to another simulator, and report what that simulator cannot express.

According to their sources (`SOURCES`), PX4 simulates a linear discharge from full to empty, Gazebo
also the sag of a constant load, and ArduPilot a charge curve minus current times resistance.  None
of them simulates noise, lags, inrush or an ADC.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import json
import math
import re

import numpy as np
from ou_monitor.comparison.compare import compare
from ou_monitor.errors import InputError
from ou_monitor.model.load import cells_in_series, charge_at, POWER
from ou_monitor.model.supply import SupplyModel
from ou_monitor.model.terms.load_response import LoadSag
from ou_monitor.model.terms.slow import Drift
from ou_monitor.records import FloatArray, Recording
from ou_monitor.simulation import RunningSupply

# Sources of names and equations: repository, file, commit.
SOURCES = {
    'px4': ('PX4/PX4-Autopilot src/modules/simulation/battery_simulator/BatterySimulator.cpp '
            '1295561, battery_simulator_params.yaml 3debe5b, src/lib/battery/module.yaml 042778a'),
    'gazebo': 'gazebosim/gz-sim src/systems/battery_plugin/LinearBatteryPlugin.cc 01d9d94',
    'ardupilot': ('ArduPilot/ardupilot libraries/SITL/SITL.cpp 0061411, SIM_Battery.cpp 018c7ee, '
                  'SIM_Frame.h 07b1fa1, libraries/AP_BattMonitor/AP_BattMonitor_Params.cpp '
                  '000ecd1'),
}
# Voltages of a cell that counts as empty, and as critical, V.
_EMPTY, _CRITICAL = 3.5, 3.3
_SEEDS = 20  # Simulations of each model


@dataclass(frozen=True)
class Export:
    """A model for another simulator."""

    text: str  # Parameters in the format of that simulator
    notes: tuple[str, ...]  # A line for each term that it cannot express, with the term's effect
    model: SupplyModel  # The part that it can simulate, as a model


@dataclass(frozen=True)
class _Numbers:
    """Numbers from which the parameters of the targets are computed."""

    cells: int
    full: float  # Initial level, V
    empty: float  # Level that counts as empty, V
    drain: float  # Time between these levels under the usual load, s; inf: no discharge
    charge: float  # Charge drawn between these levels, 0..1 of the pack
    capacity: float  # Ah; NaN: unknown
    current: float  # Current at full throttle, A; NaN: unknown
    share: float  # Usual load, as a share of the load at full throttle
    sag: float  # Sag at full throttle, V
    usual_sag: float  # Sag under the usual load, V


def export(model: SupplyModel, target: str, *, throttle: FloatArray, rate: float,
           full_current: float = math.nan, recording: Recording | None = None) -> Export:
    """Return a model for another simulator (throttle at rate, Hz; full_current in A)."""
    # The throttle determines the usual load, and the effect of each term is measured over it.
    # With the recording, the notes say how much of it the model and the exported part explain.
    if target == 'json':
        data = {'model': [{'term': t.NAME, 'params': t.values()} for t in model.terms],
                'load': None if model.load is None else model.load.values(),
                'full_load_a': model.full_current or None}
        return Export(json.dumps(data, indent=1, allow_nan=False), (), model)
    if math.isnan(full_current):
        full_current = abs(model.full_current) or math.nan
    if full_current <= 0.0 or math.isinf(full_current):
        raise InputError(f'--full-current must be above 0 A, got {full_current:g}')
    stated = _stated_capacity(recording)
    n = _numbers(model, throttle, full_current, stated)
    if target != 'px4' and math.isnan(full_current):
        raise InputError(f'--export {target} needs --full-current A, the current at full '
                         'throttle: the model has only throttle')
    if target != 'px4' and math.isnan(n.capacity):
        raise InputError('the model does not say how fast throttle empties the pack (load): '
                         'no capacity can be given')
    kept, lines = {'px4': (('drift',), _px4), 'gazebo': (('drift', 'load_sag'), _gazebo),
                   'ardupilot': (('drift', 'load_sag'), _ardupilot)}[target]
    sags = [t for t in model.terms if isinstance(t, LoadSag)]
    left = SupplyModel((replace(model.ou, sigma=0.0, u0=n.full - (
        n.usual_sag if target == 'gazebo' else 0.0)), *(
        () if math.isinf(n.drain) else (Drift((n.empty - n.full) / n.drain, 0.0),)), *(
        t.at(0.0) for t in sags if target == 'ardupilot')), full_current=model.full_current)
    notes = _omitted_terms(model, kept, throttle, rate)
    if target == 'gazebo' and n.usual_sag:
        notes.append(f'load_sag is the sag under the usual load, {n.usual_sag:.3g} V: throttle '
                     'does not change it')
    if target != 'px4' and n.sag:
        notes.append('the resistance is computed from the settled fall at '
                     f'{"the usual load" if target == "gazebo" else "full throttle"}; analyze '
                     'gives the resistance after 1 s')
    notes += [f'load_sag keeps its initial value: in the model, it grows by {t.growth:.3g} V/s at '
              'full throttle' for t in sags if target != 'px4' and t.growth]
    if target != 'px4' and math.isnan(stated):
        notes.append(f'the capacity, {n.capacity:.3g} Ah, is estimated from the fall of the '
                     'voltage: replace it by the capacity printed on the pack')
    for words, one in (('the model', model), ('the exported part', left)):
        if recording is not None:
            found = compare(recording, one, seeds=_SEEDS)
            notes.append(
                f'{words}: explains {100.0 * max(found.explained, 0.0):.0f} % of '
                f'{recording.name}, lowest voltage {found.lowest.median:.2f} V (measured '
                f'{found.lowest.measured:.2f} V). {found.verdict.value}')
    return Export('\n'.join(lines(n)), tuple(notes), left)


def _numbers(model: SupplyModel, throttle: FloatArray, current: float, stated: float) -> _Numbers:
    load, u0 = model.load, model.ou.u0
    cells = round(load.cells) if load is not None else cells_in_series(u0)
    share = float(np.mean(np.maximum(throttle, 0.0) ** POWER))
    empty = min(cells * _EMPTY, u0)
    drain, charge, capacity = math.inf, math.nan, stated
    drift = next((t for t in model.terms if isinstance(t, Drift)), None)
    if load is not None:
        charge = charge_at(u0 / load.cells) - charge_at(empty / load.cells)
        if load.discharge * share > 0.0 and charge > 0.0:
            drain = charge / (load.discharge * share)
            if math.isnan(stated):
                capacity = current * share * drain / charge / 3600.0
    elif drift is not None:
        rate = drift.rate + drift.charge * float(np.mean(throttle))
        drain = (empty - u0) / rate if rate < 0.0 and empty < u0 else math.inf

    def sag(u: FloatArray) -> float:
        return float(sum(np.mean(t.linear * u + t.square * u * u)
                         for t in model.terms if isinstance(t, LoadSag)))

    return _Numbers(cells, u0, empty, drain, charge, capacity, current, share, sag(np.ones(1)),
                    sag(throttle))


def _stated_capacity(recording: Recording | None) -> float:
    """Return the capacity that the log of a recording states, Ah; otherwise NaN."""
    source = {} if recording is None else recording.source
    text = source.get('capacity_mah', source.get('log_capacity_mah', ''))
    return float(text) / 1e3 if re.fullmatch('[1-9][0-9]{0,6}', text) else math.nan


def _px4(n: _Numbers) -> tuple[str, ...]:
    return (
        f'# {SOURCES["px4"]}', f'param set BAT1_N_CELLS {n.cells}',
        f'param set BAT1_V_CHARGED {n.full / n.cells:.3f}',
        f'param set BAT1_V_EMPTY {n.empty / n.cells:.3f}',
        # 0 would disable the discharge.
        f'param set SIM_BAT_DRAIN {n.drain if math.isfinite(n.drain) else 1e6:.0f}',
        'param set SIM_BAT_MIN_PCT 0')


def _gazebo(n: _Numbers) -> tuple[str, ...]:
    current = n.current * n.share
    # A straight line over charge drawn, from the present level to empty: E = e0 + e1 (1 - q/c).
    slope = (n.empty - n.full) / n.charge
    return (
        f'<!-- {SOURCES["gazebo"]} -->',
        '<plugin filename="gz-sim-linearbatteryplugin-system"',
        '        name="gz::sim::systems::LinearBatteryPlugin">',
        '  <battery_name>battery</battery_name>',
        f'  <voltage>{n.full:.3f}</voltage>',
        f'  <open_circuit_voltage_constant_coef>{n.full:.3f}</open_circuit_voltage_constant_coef>',
        f'  <open_circuit_voltage_linear_coef>{slope:.3f}</open_circuit_voltage_linear_coef>',
        f'  <capacity>{n.capacity:.4f}</capacity>',
        f'  <initial_charge>{n.capacity:.4f}</initial_charge>',
        f'  <resistance>{n.usual_sag / current:.5f}</resistance>',
        '  <smooth_current_tau>1.0</smooth_current_tau>',
        f'  <power_load>{current * (n.full - n.usual_sag):.2f}</power_load>',
        '  <fix_issue_225>true</fix_issue_225>', '</plugin>')


def _ardupilot(n: _Numbers) -> tuple[str, ...]:
    return (
        f'# {SOURCES["ardupilot"]}', f'SIM_BATT_VOLTAGE {n.full:.2f}',
        f'SIM_BATT_CAP_AH {n.capacity:.3f}', f'BATT_CAPACITY {1e3 * n.capacity:.0f}',
        f'BATT_LOW_VOLT {n.cells * _EMPTY:.2f}', f'BATT_CRT_VOLT {n.cells * _CRITICAL:.2f}',
        '# In the JSON of the frame (sim_vehicle.py --model NAME:frame.json):',
        f'# "maxVoltage": {n.cells * 4.2:.1f}, "battCapacityAh": {n.capacity:.3f}, '
        f'"refBatRes": {n.sag / n.current:.5f}')


def _omitted_terms(model: SupplyModel, kept: tuple[str, ...], throttle: FloatArray, rate: float
                   ) -> list[str]:
    """Return a line for each term that is left out, with its effect on the simulated voltage."""
    def simulated(one: SupplyModel) -> FloatArray:
        return RunningSupply(one, rate=rate, seed=0).draw(throttle)

    whole, notes = simulated(model), []
    for k, term in enumerate(model.terms):
        if term.NAME in kept:
            continue
        rest = (replace(model.ou, sigma=0.0), *model.terms[1:]) if k == 0 else (
            *model.terms[:k], *model.terms[k + 1:])
        # The random draws of a term do not depend on other terms: the difference is its effect.
        moved = whole - simulated(SupplyModel(rest, model.load))
        notes.append(f'{term.NAME} is left out; its effect: {1e3 * float(np.std(moved)):.3g} mV '
                     f'rms, up to {1e3 * float(np.abs(moved).max()):.3g} mV')
    return notes
