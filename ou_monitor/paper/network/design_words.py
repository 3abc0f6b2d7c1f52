"""A power-network design in words and as JSON."""

from __future__ import annotations

from dataclasses import asdict
import math
from typing import Any

from ou_monitor.paper.network.design import Design, DesignRow, row_of, Verdict, with_capacitance
from ou_monitor.paper.network.rail import rail_at, UnstableNetworkError
from ou_monitor.text import number


def as_data(result: Design, source: str) -> dict[str, Any]:
    """Return the result for JSON."""
    def row(r: DesignRow | None) -> dict[str, float] | None:
        return None if r is None else {**asdict(r), 'risk': r.risk}

    return {
        'network': asdict(result.network), 'rail': result.rail, 'throttle': result.throttle,
        'brownout_voltage': result.voltage, 'brownout_voltage_source': source,
        'horizon_s': result.horizon, 'target_risk': result.target,
        'esr_follows': result.esr_follows, 'verdict': result.verdict.name.lower(),
        'answer': answer(result), 'effect': effect(result), 'present': row(result.present),
        'least': row(result.least), 'resistance_at_level': result.resistance,
        'risk_falls_with_capacitance': result.falls, 'lc_corner_hz': result.network.lc_corner,
        'rows': [row(r) for r in result.rows]}


def answer(result: Design) -> str:
    """Return the answer in words."""
    present, least = result.present, result.least
    if result.verdict is Verdict.ENOUGH:
        also = '' if least is None else f' From {_uf(least)} on the target is met.'
        return (f'No more capacitance is needed: with the present {_uf(present)} the risk is '
                f'{probability(present.risk)}.{also}')
    if result.verdict is Verdict.FOUND:
        assert least is not None
        return (f'{_uf(least)} is the least capacitance that brings the risk under '
                f'{result.target:g}.')
    if result.verdict is Verdict.OUT_OF_RANGE:
        return (f'No capacitance between {_uf(result.rows[0])} and {_uf(result.rows[-1])} brings '
                f'the risk under {result.target:g}: with the largest it is still '
                f'{probability(result.rows[-1].risk)}. A lower ESR, a lower battery resistance '
                'or less throttle would.')
    text = (f'No capacitor helps: the mean, {present.mean:.4g} V, is at or below '
            f'{result.voltage:g} V.')
    if math.isfinite(result.resistance):
        text += (f' Lower battery_resistance from {1e3 * result.network.battery_resistance:.3g} '
                 f'mOhm to less than {1e3 * result.resistance:.3g} mOhm, or fly with less '
                 'throttle.')
    elif result.rail == 'bus':
        text += (' That level is not below the open-circuit voltage: check cells and '
                 'battery_voltage, or lower the level.')
    else:
        text += ' Raise regulator_voltage or lower the level.'
    return text


def effect(result: Design) -> str:
    """Return what adding capacitance does, in words."""
    a = result.present
    if a.var_inf == 0.0:
        return 'There is no noise at this throttle.'
    if result.verdict is Verdict.FOUND and result.least is not None:
        b = result.least
    elif result.verdict is Verdict.OUT_OF_RANGE and result.rows[-1].capacitance > a.capacitance:
        b = result.rows[-1]
    else:
        twice = with_capacitance(result.network, 2.0 * a.capacitance, result.esr_follows)
        try:
            b = row_of(rail_at(twice, result.throttle, result.rail), result.voltage,
                       result.horizon)
        except UnstableNetworkError as error:
            return f'With {number(2e6 * a.capacitance)} uF {error}.'
    if not b.stable:
        return f'With {_uf(b)} the network is unstable.'
    text = (f'From {_uf(a)} to {_uf(b)}: alpha {_change(a.alpha, b.alpha, " 1/s")}, Var_inf '
            f'{_change(a.var_inf, b.var_inf, " V^2")}, sigma '
            f'{_change(a.sigma, b.sigma, " V/sqrt(s)")}, risk {_change(a.risk, b.risk)}.')
    if b.alpha < a.alpha and b.var_inf < a.var_inf:
        text += ' The rail returns more slowly, and strays less far.'
    return text


def _change(a: float, b: float, unit: str | None = None) -> str:
    """Return how a value changes; a risk when there is no unit."""
    first, second = (probability(v) if unit is None else number(v) for v in (a, b))
    if first == second:
        return f'stays at {first}{unit or ""}'
    return f'{"falls" if b < a else "rises"} from {first} to {second}{unit or ""}'


def _uf(row: DesignRow) -> str:
    return f'{number(1e6 * row.capacitance)} uF'


def remarks(result: Design) -> list[str]:
    """Return what else must be known."""
    notes = []
    rail = rail_at(result.network, result.throttle, result.rail)
    if any(math.isclose(rail.alpha, rate, rel_tol=1e-6) for rate in rail.source_rates):
        notes.append('With the present capacitor alpha is the rate of the noise, not of the '
                     'network: capacitance moves it only once the network is the slower one.')
    if result.least is not None and result.least.risk_crossing > result.least.risk_ou:
        notes.append('The crossing rate of the whole process decides: part of the noise is '
                     'faster than the OU of the slowest pole.')
    if not result.falls:
        if not all(row.stable for row in result.rows):
            notes.append('Some capacitances make the network unstable: the regulator as a '
                         'constant-power load undoes the damping of the filter.')
        notes.append('The risk does not fall at each step of the capacitance here (resonance or '
                     'ESR): more is not simply better; choose a value from the table.')
    if result.network.filter_inductance > 0.0:
        text = f'LC filter: corner {result.network.lc_corner:.4g} Hz'
        if rail.resonance is None:
            text += ', no resonance (all poles are real).'
        else:
            text += (f', resonance at {rail.resonance.frequency:.4g} Hz with Q '
                     f'{rail.resonance.q:.3g}.')
        notes.append(text)
    return notes


def probability(value: float) -> str:
    """Return a probability to two digits; below 1e-12 only that."""
    return '<1e-12' if 0.0 < value < 1e-12 else number(value, 2)
