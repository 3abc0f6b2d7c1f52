"""
Compare sag, noise and resistance of a supply with known craft.

Limits: a few craft in each class, with one flight each; noise depends on where and how fast the
voltage was measured, so a slow or filtered sensor seems quiet.  "Usual" means within a factor of
two of the median of the class; it does not mean safe.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
import math
import re
from typing import Any

import numpy as np
from ou_monitor.analysis.noise import flown_near
from ou_monitor.analysis.supply import SupplyFacts
from ou_monitor.errors import InputError
from ou_monitor.model.load import FULL_CELL
from ou_monitor.online.trust import MOST_SUPPLY
from ou_monitor.records import NAN, plain_data, Recording
from ou_monitor.text import counted, number

# Throttle at which craft are compared; half width of the range around it that must be flown.
_AT, _NEAR = 0.5, 0.15
# Maximum factor between a usual value and the median of its class.
_USUAL = 2.0
# A lithium cell at rest, V: highest after charging (LiHV 4.35 V, and 0.1 V for the sensor), lowest
# without damage (a lead-acid cell has 2.1 V), and lowest at the beginning of a flight.
HIGHEST_CELL, LOWEST_CELL, _BEGINS = 4.45, 2.5, 3.0
# Lowest voltage of a cell at which a supply is guessed to be a pack, V: pilots are warned below it
# (vbat_warning_cell_voltage of Betaflight).  Thus rails of 3.3, 5, 6, 9 and 10 V are not packs.
_PACK = 3.5
# Maximum number of cells that is guessed: 100 V, the limit of common high-voltage ESCs.
_MOST_GUESSED = 24
# Lowest usual voltage of a cell at rest, V: half full; highest of a full LiHV cell (4.35 V, and
# 0.03 V for the sensor).
_HALF, _FULL_HIGH = 3.8, 4.38
# Cells of common LiFePO4 packs, and the plateau of such a cell at rest, V.
_IRON_CELLS, _IRON = (4, 8, 12, 16), (3.2, 3.45)
# Voltage of an empty lithium cell under load, V (vbat_min_cell_voltage of Betaflight, and the
# default of `design`).
CELL_LIMIT = 3.3
# Maximum voltage of a cell, V: above any charged lithium cell.
_CELL_MOST = 5.0
# The voltage of the full pack is the highest median over this time, s.
_FULL = 0.5

MICRO, QUAD, ROBOT = '1S micro', 'quad, 2S and more', 'robot on 12 V'
# Class -> craft -> cells, sag and noise at half throttle, V, and resistance of the pack, Ohm (NaN:
# unknown), by `supply_facts` in November 2026.
KNOWN: dict[str, dict[str, tuple[float, float, float, float]]] = {
    # Crazyflie in close flight and taking off (aerorobotics/neural-swarm).
    MICRO: {'cf_solo': (1, 0.095, 0.0034, NAN), 'cf_takeoff': (1, 0.134, 0.0038, NAN)},
    # Betaflight: fc-blackbox (gecko), gimbal-ghost (roma), gyroflow issue 72 (ar8), and public
    # logs of a nazgul, a 3S and an older 4S, whose current is absent or wrongly scaled;
    # ArduCopter: Erle-Copter in AltHold, and one of version 3.1.3 with current, read at 1 Hz.
    QUAD: {'gecko': (4, 0.750, 0.079, NAN), 'nazgul': (4, 0.554, 0.565, NAN),
           '3s_erpm2': (3, 0.289, 0.214, NAN), 'ar8': (6, 1.889, 0.050, NAN),
           'hiro': (4, 0.521, 0.767, NAN), 'roma': (6, 1.178, 0.537, 0.0351),
           'erle': (3, 0.665, 0.109, NAN), 'jd': (4, 0.398, NAN, 0.0175)},
    # DTU REGBOT (zachasme/regbot); an FRC robot of 2022 with a lead-acid battery, which counts as
    # 3 cells (orangelight/DSLOG-Reader).
    ROBOT: {'regbot_10': (3, 0.043, 0.0058, NAN), 'regbot_19': (3, 0.063, 0.0113, NAN),
            'regbot_28': (3, 0.083, 0.0108, 0.174), 'regbot_30': (3, 0.058, 0.0079, NAN),
            'regbot_62': (3, 0.111, 0.0169, 0.415), 'regbot_81': (3, NAN, 0.0117, NAN),
            'frc_ol_1': (3, NAN, NAN, 0.0275)}}
# Maximum number of cells of a known quad; more are not compared: 24 V robots look like 7 cells.
_MOST_CELLS = max(cells for cells, *_ in KNOWN[QUAD].values())
# Cells of the class of robots, and formats that do not show the kind of vehicle.
_ROBOT_CELLS, _ANY_VEHICLE = 3, ('csv', 'mcap', '')
_UNITS = {'sag': 'mV per cell at 50 % throttle', 'noise': 'mV rms per cell at 50 % throttle',
          'resistance': 'mOhm per cell'}
# (Measure, whether it is high) -> (likely reason, remedy).
_REASONS = {
    ('sag', True): ('a small, aged or cold pack, thin or long leads, or a poor connector',
                    'feel whether a connector is warm after a flight, then try a fresh or larger '
                    'pack'),
    ('sag', False): ('a large pack, or a voltage that the flight controller has corrected for sag',
                     'none needed; check that the logged voltage has no sag compensation'),
    ('noise', True): ('no capacitor, or one of high ESR, at the ESCs, or an ESC that loses step',
                      'a low-ESR capacitor of 470 to 1000 uF at the battery pads of the ESCs'),
    ('noise', False): ('a sensor that is slow or filtered before it is logged',
                       'raise its rate or filter cutoff before judging the noise'),
    ('resistance', True): ('an aged or cold pack, a poor connector, or a load that bypasses the '
                           'current sensor',
                           'warm the pack, then try a fresh one and other leads'),
    ('resistance', False): ('a large pack, or a current that is scaled too high',
                            "compare the consumed mAh with the charger's")}


@dataclass(frozen=True)
class Measure:
    """One number of a supply, compared with known craft."""

    kind: str  # Class that it is compared with
    name: str  # sag, noise or resistance
    value: float  # V, V or Ohm per cell
    usual: tuple[float, float]  # Usual range, in the same unit
    verdict: str  # usual, high, low or unknown
    reason: str  # Likely reason; empty if usual
    remedy: str


@dataclass(frozen=True)
class Craft:
    """Cells of a supply, its class, and a comparison with known craft."""

    cells: int  # 0: unknown
    cells_from: str  # given, log, guessed or unknown
    full_v: float  # Highest median of half a second, V
    kind: str  # Class; empty if there is none, or more than one
    measures: tuple[Measure, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the craft as strict JSON."""
        return {'cells': self.cells or None, 'cells_from': self.cells_from,
                'full_v': plain_data(self.full_v), 'class': self.kind or None, 'measures': [
                    {'class': one.kind, 'name': one.name, 'value': plain_data(one.value),
                     'usual': list(one.usual), 'verdict': one.verdict, 'reason': one.reason,
                     'remedy': one.remedy}
                    for one in self.measures]}


def full_voltage(recording: Recording) -> float:
    """Return the highest median voltage of half a second, V; NaN without a sample."""
    if recording.n < 2:
        return float(recording.voltage[0]) if recording.n else NAN
    size = min(recording.n, max(1, round(_FULL / float(np.median(np.diff(recording.t))))))
    whole = recording.voltage[:recording.n - recording.n % size].reshape(-1, size)
    return float(np.median(whole, axis=1).max())


def likely_cells(full: float) -> tuple[int, ...]:
    """Return the numbers of cells that a voltage at rest, V, cannot tell apart."""
    possible = [n for n in range(1, _MOST_GUESSED + 1) if _PACK <= full / n <= HIGHEST_CELL]
    # A pack that is not between half and full is full LiHV rather than nearly empty.
    return tuple(n for n in possible if _HALF <= full / n <= FULL_CELL) or tuple(
        [n for n in possible if full / n <= _FULL_HIGH] or possible)[:1]


def cells_among(full: float, known: Iterable[int]) -> int:
    """Return which number of a vehicle's flights one with this voltage at rest has; 0: unknown."""
    # A flight that ends an empty pack begins below any usual voltage.
    usual = any(full / n <= _FULL_HIGH for n in likely_cells(full))
    fit = [n for n in known if (_PACK if usual else _BEGINS) <= full / n <= HIGHEST_CELL]
    return 0 if usual and len(fit) > 1 else max(fit, default=0)


def check_cells(full: float, cells: int) -> None:
    """Raise InputError if a pack of this number of cells cannot have this voltage at rest, V."""
    if math.isfinite(full) and not LOWEST_CELL <= full / cells <= HIGHEST_CELL:
        raise InputError(
            f'--cells {cells}: {full:.4g} V at rest would be {full / cells:.3g} V per cell: '
            + ('the voltage seems to be in mV or counts (--unit mV)' if full > MOST_SUPPLY else
               f'it is likely {_either(likely)} (lithium)' if (likely := likely_cells(full)) else
               'no number of charged lithium cells fits')
            + '; for lead-acid, or a rail that is not a pack, leave --cells out and give '
            '--brownout-voltage V')


def doubtful_cells(full: float, cells: int) -> str:
    """Return a warning if this number of cells hardly fits the voltage at rest, V; else ''."""
    likely = likely_cells(full)
    low = 0 < max(likely, default=0) < cells and full / cells < _PACK
    return '' if not low or cells == _iron_cells(full) else (
        f'{full:.4g} V at rest would be {full / cells:.3g} V per cell: the pack is empty or '
        f'damaged, or it has {_either(likely)}, not {cells}.')


def _either(cells: tuple[int, ...]) -> str:
    return ' or '.join(map(str, (*cells[:-1], counted(cells[-1], 'cell'))))


def _iron_cells(full: float) -> int:
    """Return the cells of a common LiFePO4 pack with this voltage at rest, V; 0 if none fits."""
    return next((n for n in _IRON_CELLS if _IRON[0] <= full / n <= _IRON[1]), 0)


def pack_limit(voltage: float | None, cells: int | None) -> float | None:
    """Return the limit of the pack, V, or None (voltage: per cell if cells are given)."""
    if not cells:
        return voltage
    if voltage is not None and voltage > _CELL_MOST:
        raise InputError(
            f'--brownout-voltage: with --cells {cells} it is in volts per cell, and no cell has '
            f'{voltage:g} V: write {voltage / cells:.3g}, or leave --cells out')
    return float(cells * (CELL_LIMIT if voltage is None else voltage))


def cells_of(recording: Recording, given: int = 0) -> tuple[int, str]:
    """Return the cells in series and their source: given, log, guessed or unknown."""
    if given:
        return given, 'given'
    likely = likely_cells(full_voltage(recording))
    return stated_cells(recording.source) or (
        (likely[0], 'guessed') if len(likely) == 1 else (0, 'unknown'))


def stated_cells(source: Mapping[str, str]) -> tuple[int, str] | None:
    """Return the cells that the header of a log states."""
    text = source.get('cells', source.get('log_cells', ''))
    # The metadata of a bag may contain any text.
    return (int(text), 'log') if re.fullmatch('[1-9][0-9]?', text) else None


def stated_limit(source: Mapping[str, str]) -> tuple[int, float] | None:
    """Return the cells, and the lowest voltage of the pack, V, that the header of a log states."""
    cells = stated_cells(source)
    text = source.get('cell_minimum', source.get('log_cell_minimum', ''))
    return (cells[0], cells[0] * float(text)) if cells and re.fullmatch(
        r'[23]\.?[0-9]{0,6}', text) else None


def craft_of(recording: Recording, facts: SupplyFacts, given: int = 0) -> Craft:
    """Compare a supply with known craft of its class, or of all possible classes."""
    cells, source = cells_of(recording, given)
    kinds = [MICRO if cells == 1 else QUAD] if 0 < cells <= _MOST_CELLS else []
    if source == 'guessed' and cells == _ROBOT_CELLS and (
            recording.source.get('format', '') in _ANY_VEHICLE):
        kinds.append(ROBOT)
    if not kinds or not recording.has_throttle:
        return Craft(cells, source, full_voltage(recording), '', ())
    seen = bool(flown_near(recording, _AT, _NEAR)[0])
    # Noise that is high only while throttle changes comes from errors of the load model, not from
    # a bad capacitor.
    calm = float(np.interp(_AT, facts.noise.throttle, facts.noise.steady_rms_v)) / cells
    # Values and standard errors; the error of the noise is negligible.
    values = {
        'sag': [float(np.interp(_AT, facts.sag.throttle, one)) if seen and facts.sag.known else NAN
                for one in (facts.sag.sag_v, facts.sag.se_v)],
        'noise': [float(np.interp(_AT, facts.noise.throttle, facts.noise.rms_v)) if seen else NAN,
                  0.0],
        'resistance': [facts.resistance.ohm, facts.resistance.se_ohm]}
    found = []
    for kind in kinds:
        for k, (name, (value, se)) in enumerate(values.items()):
            known = [row[1 + k] / row[0] for row in KNOWN[kind].values()
                     if math.isfinite(row[1 + k])]
            if known:
                middle = float(np.median(known))
                one = _measure(kind, name, value / cells, 2.0 * se / cells, middle)
                found.append(replace(one, verdict='unknown', reason='', remedy='')
                             if name == 'noise' and one.verdict == 'high' and not calm >= middle
                             else one)
    return Craft(cells, source, full_voltage(recording), kinds[0] if len(kinds) == 1 else '',
                 tuple(found))


def _measure(kind: str, name: str, value: float, reach: float, middle: float) -> Measure:
    usual = middle / _USUAL, middle * _USUAL
    high = value - reach > usual[1]
    if high or value + reach < usual[0]:
        return Measure(kind, name, value, usual, 'high' if high else 'low', *_REASONS[name, high])
    # False if a number is NaN.
    known = reach <= value and usual[0] <= value <= usual[1]
    return Measure(kind, name, value, usual, 'usual' if known else 'unknown', '', '')


def craft_line(craft: Craft) -> str:
    """Return the comparison in words; empty if there is none."""
    found: dict[str, list[str]] = {}
    for one in craft.measures:
        if one.verdict != 'unknown':
            low, high = (number(1e3 * x, 2) for x in one.usual)
            found.setdefault(one.kind, []).append(
                f'{one.name} {number(1e3 * one.value)} {_UNITS[one.name]} is {one.verdict}'
                + ('' if one.verdict == 'usual' else f' (usual: {low} to {high})'))
    likely = likely_cells(craft.full_v)
    if not craft.cells and likely:
        return f'if it is a pack: {_either(likely)} of LiPo; give --cells N'
    if not found and (craft.measures or not craft.cells):
        return ''
    iron = _iron_cells(craft.full_v)
    source = {'log': ' (from the log)', 'guessed': ' of LiPo (from the voltage)' + (
        f' or {iron} of LiFePO4' if iron > craft.cells else '')}.get(craft.cells_from, '')
    # The voltage alone does not tell a pack from a rail: 12, 24, 36 and 48 V are 4 V per cell.
    sags = any(one.name == 'sag' and one.verdict in ('usual', 'high') for one in craft.measures)
    maybe = 'if it is a pack: ' if craft.cells_from == 'guessed' and not sags else ''
    return f'{maybe}{counted(craft.cells, "cell")}{source}, ' + ('; or '.join(
        f'class "{kind}": {"; ".join(words)}' for kind, words in found.items())
        or 'no class known to compare with')


def craft_advice(craft: Craft) -> list[str]:
    """Return a sentence for each measure that is high: the likely reason and a remedy."""
    # If the number of cells is a guess, the supply may not be a battery pack at all.
    if craft.cells_from == 'guessed':
        return []
    return [f'The {one.name} is {_USUAL * one.value / one.usual[1]:.1f} times the median of '
            f'known craft ({craft.kind}): likely {one.reason}. Remedy: {one.remedy}.'
            for one in craft.measures if one.verdict == 'high']
