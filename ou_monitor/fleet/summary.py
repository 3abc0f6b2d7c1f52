"""A fleet in words, in table cells, and as plain data."""

from __future__ import annotations

from collections import Counter
import math
import re
from typing import Any

import numpy as np
from ou_monitor.fleet import lowest
from ou_monitor.fleet.comparison import LOGARITHMIC, QUANTITIES, USABLE, Values
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import (
    DRIFT_RATE, fewest, Judgement, LEAST, LEAST_VEHICLES, OUTLIER_RATE, Trend)
from ou_monitor.records import FloatArray, NAN
from ou_monitor.text import chance, counted, number, p_words

# Mean voltages of one pack differ by less, even from full to empty under load (4.35 V to 2.8 V).
_ONE_PACK = 1.6
# Heads of the table of vehicles.
VEHICLE_HEADS = ('vehicle', 'flights', 'lowest, V', 'dips', 'sag, V', '/flight',
                 'sigma, V/sqrt(s)', '/flight', 'alpha, 1/s', '/flight')


def answer(fleet: Fleet) -> list[str]:
    """Return what the fleet says: the lowest voltage, what stands out, what was analysed."""
    return [part for part in (*lowest.sentences(fleet), _standing_out(fleet), _analysed(fleet))
            if part]


def headline(fleet: Fleet) -> str:
    """Return the answer as a paragraph."""
    return ' '.join(answer(fleet))


def _analysed(fleet: Fleet) -> str:
    parts = [f'{fleet.analysed} of {counted(fleet.recordings, "recording")} of '
             f'{counted(len(fleet.vehicles), "vehicle")} analysed']
    if fleet.failed:
        parts.append(f'{len(fleet.failed)} could not be')
    if fleet.duplicates:
        parts.append('1 is a copy of another' if len(fleet.duplicates) == 1 else
                     f'{len(fleet.duplicates)} are copies of others')
    without = {row['path'] for row in fleet.rows if row['status'] is not None} - {
        row['path'] for row in fleet.rows if row['status'] in USABLE}
    if without:
        parts.append(f'{len(without)} with no estimate of sigma at any level')
    return ', '.join(parts) + '.'


def _standing_out(fleet: Fleet) -> str:
    judged, text = fleet.judgement, ''
    drifting = sorted({t.vehicle for t in judged.drifting})
    odd = {judged.values[name].paths[k] for name, k in judged.odd_recordings()}
    vehicles = sorted({judged.vehicles[name].names[k] for name, k in judged.odd_vehicles()})
    if drifting:
        text += f' Drift over the flights: {_listed(drifting)}.'
    if vehicles:
        text += f' Unlike the rest of the fleet: {_listed(vehicles)}.'
    if odd:
        text += f' Unlike the other flights of their vehicle: {counted(len(odd), "recording")}.'
    if not (drifting or vehicles or odd):
        tested = judged.trends or any(np.isfinite(o.bound) for o in (
            *judged.recordings.values(), *[v.outliers for v in judged.vehicles.values()]))
        text += (' Nothing stands out.' if tested else
                 ' There are too few recordings a vehicle to tell what stands out.')
    return text.strip()


def _listed(names: list[str], most: int = 5) -> str:
    more = len(names) - most
    return ', '.join(names[:most]) + (f' and {more} more' if more > 0 else '')


def change(name: str, value: float) -> str:
    """Return a change of a quantity with its sign: in % on the log scale, else in mV."""
    if not math.isfinite(value):
        return '-'
    if name not in LOGARITHMIC:
        return f'{1e3 * value:+.3g} mV' if abs(value) < 1.0 else f'{value:+.3g} V'
    percent = 100.0 * math.expm1(value)
    if percent >= 100.0:
        return f'x {number(math.exp(value))}'
    return f'{percent:+.0f} %' if abs(percent) >= 10.0 else f'{percent:+.2g} %'


def trend_words(trend: Trend) -> str:
    """Return a drift in a sentence."""
    flights = trend.last - trend.first
    return (f'{trend.vehicle}: {trend.quantity} drifts by '
            f'{change(trend.quantity, trend.slope)} a flight (95 % '
            f'{change(trend.quantity, trend.low)} to {change(trend.quantity, trend.high)}), '
            f'{change(trend.quantity, flights * trend.slope)} over {trend.flights} flights; '
            f'{p_words(trend.p_value)}, over the fleet {chance(trend.p_family)}.')


def finding_words(fleet: Fleet) -> list[str]:
    """Return what stands out, a sentence each: drift, vehicles, recordings."""
    judged = fleet.judgement
    found = [trend_words(trend) for trend in judged.drifting]
    for name, k in judged.odd_vehicles():
        one = judged.vehicles[name]
        centre = float(one.outliers.centre[k])
        values = judged.values[name]
        found.append(f'{one.names[k]}: {name} is {shown(values, one.value[k])}{_at(values)}, '
                     f'{change(name, float(one.value[k]) - centre)} beside the median of the '
                     f'vehicles; p over the fleet {chance(float(one.outliers.chance[k]))}.')
    for name, k in judged.odd_recordings():
        values, out = judged.values[name], judged.recordings[name]
        off = change(name, float(values.value[k] - out.centre[k]))
        found.append(f'{values.vehicles[k]}, {values.paths[k]}: {name} is '
                     f'{shown(values, values.value[k])}{_at(values)} ({_measured(values, k)}), '
                     f'{off} beside the other flights; p over the fleet '
                     f'{chance(float(out.chance[k]))}.')
    return found


def failure_words(fleet: Fleet) -> list[str]:
    """Return each recording without numbers and why, the path named once."""
    found = []
    for row in fleet.failed:
        error = str(row['error']).removeprefix(row['path'])
        # What is left may name a line of it, or a file within it.
        found.append(row['path'] + (error if re.match(r':\d+:|/', error) else
                                    f": {error.lstrip(': ')}"))
    return found


def shown(values: Values, value: float | FloatArray) -> str:
    """Return one value in its unit, as it is at the reference throttle."""
    return f'{number(float(values.shown(value)))} {QUANTITIES[values.name]}'


def _at(values: Values) -> str:
    """Return the throttle that recordings are compared at."""
    if values.name == 'sag':
        return ' at full throttle'
    at = values.curve.reference
    return f' at {100.0 * at:.0f} % throttle' if math.isfinite(at) else ''


def _measured(values: Values, k: int) -> str:
    at = values.throttle[k]
    return (f'{number(float(values.measured[k]))} as measured'
            + (f' at {100.0 * at:.0f} %' if math.isfinite(at) else ''))


def comparison_words(fleet: Fleet) -> list[str]:
    """Return sentences: how recordings were compared, and what so few cannot tell."""
    judged = fleet.judgement
    notes = []
    for vehicle in fleet.vehicles:
        means = [row['mean'] for row in fleet.rows if row['vehicle'] == vehicle
                 and row['mean'] is not None and row['mean'] > 0.0]
        if means and max(means) > _ONE_PACK * min(means):
            notes.append(f'{vehicle}: voltages of {number(min(means))} to {number(max(means))} V '
                         'are those of several supplies, and compared as one: --vehicle-from '
                         'REGEX, or a folder each, parts them.')
    references = [judged.values[name].curve.reference for name in LOGARITHMIC]
    if all(map(math.isfinite, references)):
        notes.append('sigma and alpha are shown as measured. To be compared they are brought to '
                     + ' and '.join(dict.fromkeys(f'{100.0 * u:.0f} %' for u in references))
                     + ' throttle along a curve common to all, and the error of that curve is '
                     'counted; sag is compared at full throttle.')
    tests = len(judged.trends)
    if tests:
        need = fewest(tests, DRIFT_RATE)
        few = sorted({t.vehicle for t in judged.trends if t.flights < need})
        notes.append(f'Drift: {tests} tests, held to {100 * DRIFT_RATE:g} % for any false one '
                     f'(Holm); with so many, {need} flights of a vehicle are the fewest that can '
                     'show one' + (f', which {counted(len(few), "vehicle")} of those tested '
                                   'do not have.' if few else '.'))
    else:
        notes.append('No vehicle has the 5 flights that a test for drift needs.')
    if any(np.isfinite(o.bound) for o in judged.recordings.values()):
        notes.append(
            f'Outliers: a fleet with nothing wrong shows any with chance '
            f'{100 * OUTLIER_RATE:g} % (all quantities, recordings and vehicles together, where '
            'the scatter between good recordings is normal).')
    else:
        notes.append(f'No vehicle has the {LEAST} flights that outliers among them need.')
    if len(fleet.vehicles) < LEAST_VEHICLES:
        notes.append(f'Vehicles are not compared with each other: that needs {LEAST_VEHICLES}.')
    return notes


def vehicle_table(fleet: Fleet) -> tuple[list[str], list[list[str]]]:
    """Return what is known of each vehicle: heads and cells, no column empty."""
    judged = fleet.judgement
    found, seen = [], lowest.once(fleet)
    shown_as = lowest.short_names(fleet.vehicles)
    for vehicle in fleet.vehicles:
        flights = {row['path'] for row in fleet.rows if row['vehicle'] == vehicle
                   and row['flight'] is not None}
        mine = [row for row in seen if row['vehicle'] == vehicle]
        dips = lowest.dips_of(mine)
        cells = [shown_as[vehicle], str(len(flights)),
                 number(min((row['lowest'] for row in mine), default=NAN), 4),
                 lowest.UNKNOWN if dips is None else str(dips.count)]
        for name in ('sag', 'sigma', 'alpha'):
            cells += [_median(judged, name, vehicle), _slope(judged, name, vehicle)]
        found.append(cells)
    return lowest.without_empty(VEHICLE_HEADS, found)


def _median(judged: Judgement, name: str, vehicle: str) -> str:
    one = judged.vehicles[name]
    if vehicle not in one.names:
        return lowest.UNKNOWN
    k = one.names.index(vehicle)
    star = '*' if one.outliers.found[k] else ''
    values = judged.values[name]
    mine = [k for k, of in enumerate(values.vehicles) if of == vehicle]
    return number(float(np.median(values.measured[mine]))) + star


def _slope(judged: Judgement, name: str, vehicle: str) -> str:
    for trend in judged.trends:
        if (trend.quantity, trend.vehicle) == (name, vehicle):
            return change(name, trend.slope) + ('*' if trend.p_family <= DRIFT_RATE else '')
    return lowest.UNKNOWN


def quality_counts(fleet: Fleet) -> list[tuple[str, int]]:
    """Return statuses that are not good, flags, verdicts and causes with how often they occur."""
    counts: Counter[str] = Counter()
    counted_paths: set[str] = set()
    for row in fleet.rows:
        if row['status'] is not None:
            if row['status'] not in USABLE:
                counts[f"level without estimate: {row['status']}"] += 1
            counts.update(f'level with flag {flag}' for flag in row['flags'] or ())
        if row['path'] not in counted_paths and row['verdict'] is not None:
            counts[f"recording with verdict {row['verdict']}"] += 1
            counts.update(f'recording with cause {cause}' for cause in set(row['causes'] or ()))
        counted_paths.add(row['path'])
    return counts.most_common()


def as_data(fleet: Fleet) -> dict[str, Any]:
    """Return a fleet as plain data; NaN stands for unknown."""
    judged = fleet.judgement
    odd = [{'what': 'vehicle', 'quantity': name, 'vehicle': judged.vehicles[name].names[k],
            'path': None, 'score': float(judged.vehicles[name].outliers.score[k]),
            'p_family': float(judged.vehicles[name].outliers.chance[k])}
           for name, k in judged.odd_vehicles()]
    odd += [{'what': 'recording', 'quantity': name, 'vehicle': judged.values[name].vehicles[k],
             'path': judged.values[name].paths[k],
             'score': float(judged.recordings[name].score[k]),
             'p_family': float(judged.recordings[name].chance[k])}
            for name, k in judged.odd_recordings()]
    return {
        'headline': headline(fleet), 'recordings': fleet.recordings, 'analysed': fleet.analysed,
        'failed': len(fleet.failed), 'duplicates': len(fleet.duplicates),
        'brownout_voltage': fleet.limit,
        'vehicles': [{
            'vehicle': vehicle,
            **{name: _vehicle_value(judged, name, vehicle) for name in QUANTITIES}}
            for vehicle in fleet.vehicles],
        'drift': [{
            'vehicle': t.vehicle, 'quantity': t.quantity, 'flights': t.flights,
            'slope': t.slope, 'ci95': [t.low, t.high], 'p_value': t.p_value,
            'p_family': t.p_family, 'stands': t.p_family <= DRIFT_RATE} for t in judged.trends],
        'outliers': odd,
        'rows': [{name: value.isoformat() if name == 'start' and value is not None else value
                  for name, value in row.items()} for row in fleet.rows],
        'notes': [*fleet.notes, *comparison_words(fleet)]}


def _vehicle_value(judged: Judgement, name: str, vehicle: str) -> float:
    one = judged.vehicles[name]
    return (float(judged.values[name].shown(one.value[one.names.index(vehicle)]))
            if vehicle in one.names else NAN)
