"""The report of `fleet` (what stands out, the vehicles, every recording), and its JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
import math
from typing import Any

import numpy as np
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import (
    DRIFT_RATE, Judgement, LEAST, LEAST_FLIGHTS, LEAST_VEHICLES, OF_PACK, OUTLIER_RATE, QUANTITIES,
    Trend, USABLE, Values)
from ou_monitor.fleet.table import Row
from ou_monitor.records import FloatArray, NAN, Severity
from ou_monitor.report.document import (
    Document, Figure, Notes, Pair, Part, Section, Table, Text, UNKNOWN)
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, counted, listed, number, p_words, some, volts, Z95

_TITLES = {'resistance': 'Resistance', 'sag': 'Sag at full throttle',
           'sigma': 'Noise intensity \u03c3', 'alpha': 'Relaxation rate \u03b1'}
_UNITS = {'resistance': 'mOhm', 'sag': 'mV', 'sigma': 'V/\u221as', 'alpha': '1/s'}
# Maximum number of drifts drawn, the most likely ones.
_DRAWN = 8
# Maximum recordings in the table of lowest voltages; maximum rows or sentences on a terminal.
_WORST, _SHOWN = 12, 10
# Maximum recordings listed on the page; JSON and the Parquet table have all.
_RECORDINGS = 500
# Maximum ratio of mean voltages of one pack: 4.35 V per cell if full, 2.8 V if empty under load.
_ONE_PACK = 1.6
# Maximum ageing packs named in the answer.
_OLD = 3
TITLE = 'Supply noise of a fleet'
# Heads of the tables of packs and of vehicles.
PACK_HEADS = ('vehicle', 'flights', 'dates', 'cells', 'resistance\nper cell, mOhm',
              'per flight\n[95 %]', 'sag\nper cell, mV', 'per flight\n[95 %]')
VEHICLE_HEADS = ('vehicle', 'flights', 'lowest, V', 'dips', 'sigma, V/sqrt(s)',
                 'per flight\n[95 %]', 'alpha, 1/s', 'per flight\n[95 %]')
# Maximum characters of a vehicle's name in a table.
_NAME = 30
# Heads of the table of recordings.
LOWEST_HEADS = ('vehicle', 'recording', 'lowest, V', 'per cell, V', 'at, s', 'dips', 'below, s',
                'resistance, mOhm', 'sag, V', 'at throttle')


def fleet_document(fleet: Fleet) -> Document:
    rows = worst(fleet)
    odd, possible = finding_words(fleet), fleet.judgement.possible
    vehicles = vehicle_table(fleet)
    copies = [f"{_prefix(row)}{row['path']} is {row['duplicate_of']}" for row in fleet.duplicates]
    subject = (f'{counted(fleet.recordings, "recording")}, '
               f'{counted(len(fleet.vehicles), "vehicle")}, '
               f'{counted(len(fleet.rows), "row")} in the table')
    parts: list[Part] = [
        lambda: [Figure(_lowest(fleet, rows), 'Each dot is a recording.')] if rows else [],
        Section('What stands out', [
            Notes.of(odd, Severity.WARNING, _SHOWN),
            *([] if odd else [Text('Nothing for certain, at the false-alarm rates stated below.'
                                   if possible else
                                   'Nothing, at the false-alarm rates stated below.')]),
            Notes.of([trend_words(trend) for trend in possible], most=_SHOWN)]),
        Section('Packs: resistance and sag', _packs(fleet)),
        Section('Lowest voltages', [lowest_table(fleet)]),
        Section('Not analysed: the next run tries them again', [
            Notes.of(failure_words(fleet), Severity.ERROR, _SHOWN)] if fleet.failed else []),
        Section('Duplicates, analysed once', [Notes.of(copies, most=_SHOWN)] if copies else []),
        Section('Vehicles', [
            vehicles,
            Text('Lowest voltage and total dips of all flights.' + (
                ' sigma and alpha: medians as measured. "Per flight": slope of a straight line '
                'fitted to the logarithms at the common throttle, weighted by the errors. A star '
                'marks what stands out: of a slope, by a t test on the scatter about the line, '
                'Holm-adjusted.' if {*VEHICLE_HEADS[4:]}.intersection(
                    vehicles.heads) else ''), legend=True)]
                if vehicles.rows else [Text('No vehicle was identified.', legend=True)]),
        lambda: [Section('Drift over the flights', _drift(fleet)),
                 Section('Verdicts and causes', _causes(fleet), folded=True)],
        Section('What to know before using these numbers', [
            Notes.of([*fleet.notes, *comparison_words(fleet)])]),
        lambda: [Section('Recordings', _recordings(fleet), folded=True)]]
    return Document(TITLE, subject, answer(fleet), parts)


def answer(fleet: Fleet) -> list[str]:
    """Return the answer: ageing packs, lowest voltage, what stands out, what was analysed."""
    return [part for part in (_ageing(fleet), *sentences(fleet), _anomalies(fleet),
                              _analysed(fleet)) if part]


def _ageing(fleet: Fleet) -> str:
    """Return which packs age, or the fastest ageing not excluded; '' without resistance or sag."""
    judged = fleet.judgement
    if not any(judged.values[name].value.size for name in OF_PACK):
        return ''
    tested = [t for t in judged.trends if t.quantity in OF_PACK]
    certain = [t for t in tested if t.p_family <= DRIFT_RATE and t.slope > 0.0]
    old = certain or [t for t in tested if t.low > 0.0]
    if old:
        words = [f'{vehicle}{_flights_of_pack(fleet, [t for t in old if t.vehicle == vehicle])}: '
                 + ', '.join(_growth(judged, t) for t in old if t.vehicle == vehicle)
                 for vehicle in dict.fromkeys(t.vehicle for t in old)]
        more = f'; and {len(words) - _OLD} more' if len(words) > _OLD else ''
        doubt = '' if certain else f'; not certain among {counted(len(judged.trends), "test")}'
        return (f'{"A" if certain else "Possibly a"}geing pack{"s" * (len(words) > 1)} '
                f'({len(words)} of {len({t.vehicle for t in tested})}): '
                f'{"; ".join(words[:_OLD])}{more}{doubt}.')
    if not tested:
        return (f'Whether a pack ages is unknown: no vehicle has {LEAST_FLIGHTS} flights with a '
                'known resistance or sag.')
    least = {vehicle: min((t for t in tested if t.vehicle == vehicle), key=lambda t: t.high)
             for vehicle in {t.vehicle for t in tested}}
    most = max(least.values(), key=lambda t: t.high)
    return (f'No ageing pack is detected; not excluded (95 %): {most.quantity} '
            f'{change(most.high)} per flight on {most.vehicle}, which has {most.flights} flights.')


def _flights_of_pack(fleet: Fleet, trends: Sequence[Trend]) -> str:
    mine = fleet.recordings_of(trends[0].vehicle)
    guessed = sorted({row['cells'] for row in mine if _guessed(row)})
    words = [counted(max(t.flights for t in trends), 'flight'), _dates(mine),
             f'{listed(list(map(str, guessed)))} cells, a guess' if guessed else '']
    return f' ({"; ".join(word for word in words if word)})'


def _growth(judged: Judgement, trend: Trend) -> str:
    values = judged.values[trend.quantity]
    first, last = (_without_unit(values, trend.line(np.array(float(flight))))
                   for flight in (trend.first, trend.last))
    return (f'{trend.quantity} {_rates(trend)}, {first} to {last} {_UNITS[trend.quantity]}'
            + _a_cell(judged, trend.quantity, trend.vehicle)
            + ' at full throttle' * (trend.quantity == 'sag'))


def _analysed(fleet: Fleet) -> str:
    parts = [f'{len(fleet.analysed)} of {counted(fleet.recordings, "recording")} of '
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


def _anomalies(fleet: Fleet) -> str:
    judged, parts = fleet.judgement, []
    drifting = sorted({t.vehicle for t in judged.drifting})
    odd = {judged.values[name].paths[k] for name, k in judged.odd_recordings()}
    vehicles = sorted({judged.vehicles[name].names[k] for name, k in judged.odd_vehicles()})
    if drifting:
        parts.append(f'Drift over the flights: {some(drifting, 5)}.')
    if vehicles:
        parts.append(f'Unlike the rest of the fleet: {some(vehicles, 5)}.')
    if odd:
        parts.append(
            f'Unlike the other flights of their vehicle: {counted(len(odd), "recording")}.')
    if not parts:
        tested = judged.trends or any(o.compared for o in (
            *judged.recordings.values(), *[v.outliers for v in judged.vehicles.values()]))
        parts.append('Nothing stands out for certain.' if judged.possible else
                     'Nothing stands out.' if tested else
                     'There are too few recordings per vehicle to tell what stands out.')
    return ' '.join(parts)


def change(value: float) -> str:
    """Return a change of a logarithm with its sign, in %, or as a factor."""
    if not math.isfinite(value):
        return UNKNOWN
    if value >= math.log(2.0):
        # With few flights the interval may be enormous.
        return f'x {number(math.exp(value))}' if value < 7.0 else 'x 1000 or more'
    percent = 100.0 * math.expm1(value)
    return f'{percent:+.0f} %' if abs(percent) >= 10.0 else f'{percent:+.2g} %'


def _rates(trend: Trend) -> str:
    """Return the change per flight, and per month where the dates are known."""
    rates = {'flight': (trend.slope, trend.low, trend.high), 'month': trend.monthly}
    return ', '.join(f'{change(rate)} per {what} (95 % {change(low)} to {change(high)})'
                     for what, (rate, low, high) in rates.items() if math.isfinite(rate))


def trend_words(trend: Trend) -> str:
    """Return a drift in a sentence."""
    flights = trend.last - trend.first
    return (f'{trend.vehicle}: {trend.quantity} drifts by {_rates(trend)}, '
            f'{change(flights * trend.slope)} from flight {trend.first} to {trend.last}; '
            f'{p_words(trend.p_value)}, fleet-wide {chance(trend.p_family)}.')


def finding_words(fleet: Fleet) -> list[str]:
    """Return what stands out, one sentence each: drift, vehicles, recordings."""
    judged = fleet.judgement
    found = [trend_words(trend) for trend in judged.drifting]
    for name, k in judged.odd_vehicles():
        one = judged.vehicles[name]
        off = float(one.value[k] - one.outliers.centre[k])
        values, reach = judged.values[name], one.outliers.reach
        few = reach is not None and math.isfinite(reach[k])
        beside = 'the mean of the others' if few else 'the median of the vehicles'
        interval = '' if not few or reach is None else (
            f' (95 % {change(off - float(reach[k]))} to {change(off + float(reach[k]))})')
        found.append(f'{one.names[k]}: {_as_compared(judged, name, one.names[k], one.value[k])}, '
                     f'{change(off)}{interval} from {beside}; fleet-wide p '
                     f'{chance(float(one.outliers.chance[k]))}.')
    for name, k in judged.odd_recordings():
        values, out = judged.values[name], judged.recordings[name]
        vehicle, at = values.vehicles[k], values.throttle[k]
        raw = f'{number(_thousandths(name) * float(values.measured[k]))} as measured' + (
            f' at {100.0 * at:.0f} %' if math.isfinite(at) else '')
        found.append(f'{vehicle}, {values.paths[k]}: '
                     f'{_as_compared(judged, name, vehicle, values.value[k])} ({raw}), '
                     f'{change(float(values.value[k] - out.centre[k]))} from the other flights; '
                     f'fleet-wide p {chance(float(out.chance[k]))}.')
    return found


def _as_compared(judged: Judgement, name: str, vehicle: str, value: float) -> str:
    """Return a value of a vehicle as it is compared: at the common throttle."""
    values = judged.values[name]
    unit = _UNITS[name] if name in OF_PACK else QUANTITIES[name]
    return (f'{name} is {_without_unit(values, value)} {unit}{_a_cell(judged, name, vehicle)}'
            f'{_at_throttle(values)}')


def failure_words(fleet: Fleet) -> list[str]:
    """Return each failed recording with the reason, which may begin with its path."""
    return [_prefix(row) + (row['error'] if row['error'].startswith(row['path']) else
                            f"{row['path']}: {row['error']}") for row in fleet.failed]


def _prefix(row: Row) -> str:
    """Return the vehicle of a row, to put before its path."""
    return '' if row['vehicle'] is None else f"{row['vehicle']}: "


def _without_unit(values: Values, value: float | FloatArray) -> str:
    """Return one value without its unit; resistance and sag in thousandths (mOhm, mV)."""
    return number(_thousandths(values.name) * math.exp(value))


def _thousandths(name: str) -> float:
    return 1e3 if name in OF_PACK else 1.0


def _a_cell(judged: Judgement, name: str, vehicle: str) -> str:
    """Return ' per cell' if the values of a vehicle are per cell."""
    one = judged.vehicles[name]
    return ' per cell' if vehicle in one.names and one.cells[one.names.index(vehicle)] else ''


def _cells_of(rows: Sequence[Row]) -> str:
    """Return the cells of a vehicle, with a question mark if they are a guess."""
    return ', '.join(f'{cells}{"?" * guess}' for cells, guess in sorted({
        (row['cells'], _guessed(row)) for row in rows if row['cells']})) or UNKNOWN


def _guessed(row: Row) -> bool:
    return bool(row['cells']) and row['cells_from'] == 'guessed'


def _dates(rows: Sequence[Row]) -> str:
    found = [row['start'] for row in rows if row['start']]
    days = sorted({f'{date:%Y-%m-%d}' for date in (min(found), max(found))}) if found else []
    return ' to '.join(days)


def _at_throttle(values: Values) -> str:
    """Return ' at ... throttle', at which recordings are compared; empty without one."""
    if values.name in OF_PACK:
        return ' at full throttle' if values.name == 'sag' else ''
    at = values.curve.reference
    return f' at {100.0 * at:.0f} % throttle' if math.isfinite(at) else ''


def comparison_words(fleet: Fleet) -> list[str]:
    """Return how recordings were compared, and what a small fleet cannot show."""
    judged = fleet.judgement
    notes = []
    for vehicle in fleet.vehicles:
        means = [row['mean'] for row in fleet.rows if row['vehicle'] == vehicle
                 and row['mean'] is not None and row['mean'] > 0.0]
        if means and max(means) > _ONE_PACK * min(means):
            notes.append(f'{vehicle}: voltages of {number(min(means))} to {number(max(means))} V '
                         'come from different supplies but are compared as one vehicle; separate '
                         'them by --vehicle-from REGEX or by a folder for each.')
    references = [judged.values[name].curve.reference for name in ('sigma', 'alpha')]
    if all(map(math.isfinite, references)):
        notes.append('sigma and alpha are shown as measured. For comparison they are moved to '
                     + ' and '.join(dict.fromkeys(f'{100.0 * u:.0f} %' for u in references))
                     + ' throttle along a curve common to all recordings; its error is '
                     'included.')
    if any(judged.values[name].value.size for name in OF_PACK):
        notes.append('Resistance and sag are computed as in analyze, per cell if the number of '
                     'cells is known ("?": guessed from the voltage). The sag is compared at full '
                     'throttle. A current sensor with a different scale looks like a different '
                     'resistance.')
    tests = len(judged.trends)
    if tests:
        notes.append(f'Drift: {counted(tests, "test")}, with {100 * DRIFT_RATE:g} % probability '
                     'of any false alarm (Holm).')
    few = sorted({*fleet.vehicles} - {t.vehicle for t in judged.trends})
    if few:
        notes.append(f'Drift unknown for {some(few, 5)}: it needs {LEAST_FLIGHTS} flights with '
                     'known values.')
    if any(o.compared for o in judged.recordings.values()):
        notes.append(
            f'Outliers: a fleet without faults shows one with {100 * OUTLIER_RATE:g} % '
            'probability (over all quantities, recordings and vehicles, if the scatter between '
            'good recordings is normal).')
    else:
        notes.append(f'No vehicle has the {LEAST} flights with known values that a search for '
                     'outliers needs.')
    compared = any(v.outliers.compared for v in judged.vehicles.values())
    if len(fleet.vehicles) < LEAST_VEHICLES:
        notes.append(
            'Vehicles: the mean resistance and sag of each are compared with the mean of the '
            'others with the same number of cells, relative to the scatter between flights. Below '
            f'{LEAST_VEHICLES} vehicles the spread between good ones is unknown, so only a '
            'difference above 10 % counts.'
            if compared else 'Vehicles are not compared with each other: that needs two with the '
            'same number of cells, each with two flights of known resistance or sag.')
    return notes


def pack_table(fleet: Fleet) -> Table:
    """Return the table of packs: resistance and sag of each vehicle, with their drift."""
    judged = fleet.judgement
    short = short_names(fleet.vehicles)
    rows = []
    for vehicle in fleet.vehicles:
        mine = fleet.recordings_of(vehicle)
        if any(row[name] is not None for row in mine for name in OF_PACK):
            rows.append([short[vehicle], _flights(mine), _dates(mine) or UNKNOWN,
                         _cells_of(mine)])
            for name in OF_PACK:
                rows[-1] += [_pack_value(mine, name, _star(judged, name, vehicle)),
                             _slope(judged, name, vehicle)]
    return Table.of_known(PACK_HEADS, rows, left=[0, 2], most=2 * _SHOWN)


def _pack_value(rows: Sequence[Row], name: str, star: str) -> str:
    """Return the median of a quantity of a pack as measured, with its throttle."""
    mine = [row for row in rows if row[name] is not None]
    if not mine:
        return UNKNOWN
    whole = not all(row['cells'] for row in mine)
    value = float(np.median([row[name] / (1 if whole else row['cells']) for row in mine]))
    at = {row['sag_throttle'] for row in mine} if name == 'sag' else set()
    ends = [f'{100.0 * u:.0f}' for u in sorted({min(at), max(at)})] if at else []
    where = f'\nat {" to ".join(ends)} %' if ends else ''
    return f'{number(1e3 * value)}{star}{" (pack)" * whole}{where}'


def _star(judged: Judgement, name: str, vehicle: str) -> str:
    one = judged.vehicles[name]
    return '*' * bool(vehicle in one.names and one.outliers.found[one.names.index(vehicle)])


def _packs(fleet: Fleet) -> list[Part]:
    made = pack_table(fleet)
    if not made.rows:
        return []
    return [made, Text(
        'Medians as measured; sag at the highest throttle flown. (pack): of the whole supply, '
        'because the number of cells is unknown. "per flight": drift (of the sag: at full '
        'throttle). A star marks what stands out.',
        legend=True)]


def _flights(rows: Sequence[Row]) -> str:
    return str(sum(row['flight'] is not None for row in rows))


def vehicle_table(fleet: Fleet) -> Table:
    judged = fleet.judgement
    found = []
    shown_as = short_names(fleet.vehicles)
    for vehicle in fleet.vehicles:
        mine = fleet.recordings_of(vehicle)
        seen = [row for row in mine if row['lowest'] is not None]
        dips = dips_of(seen)
        cells = [shown_as[vehicle], _flights(mine),
                 number(min((row['lowest'] for row in seen), default=NAN), 4),
                 UNKNOWN if dips is None else str(dips[0])]
        for name in ('sigma', 'alpha'):
            cells += [_median(judged, name, vehicle), _slope(judged, name, vehicle)]
        found.append(cells)
    return Table.of_known(VEHICLE_HEADS, found, left=[0], most=2 * _SHOWN)


def _median(judged: Judgement, name: str, vehicle: str) -> str:
    one = judged.vehicles[name]
    if vehicle not in one.names:
        return UNKNOWN
    values = judged.values[name]
    mine = [k for k, of in enumerate(values.vehicles) if of == vehicle]
    return number(float(np.median(values.measured[mine]))) + _star(judged, name, vehicle)


def _slope(judged: Judgement, name: str, vehicle: str) -> str:
    for trend in judged.trends:
        if (trend.quantity, trend.vehicle) == (name, vehicle):
            return (f'{change(trend.slope)}{"*" * (trend.p_family <= DRIFT_RATE)}\n'
                    f'[{change(trend.low)}, {change(trend.high)}]')
    return UNKNOWN


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
        'headline': ' '.join(answer(fleet)), 'recordings': fleet.recordings,
        'analysed': len(fleet.analysed), 'failed': len(fleet.failed),
        'duplicates': len(fleet.duplicates),
        'brownout_voltage': fleet.limit,
        'vehicles': [{
            'vehicle': vehicle,
            'cells': _cells_of(fleet.recordings_of(vehicle)),
            **{name + ('_a_cell' if _a_cell(judged, name, vehicle) else ''): _vehicle_value(
                judged, name, vehicle) for name in QUANTITIES}}
            for vehicle in fleet.vehicles],
        'drift': [{
            'vehicle': t.vehicle, 'quantity': t.quantity, 'flights': t.flights,
            'slope': t.slope, 'ci95': [t.low, t.high],
            'slope_per_month': t.monthly[0], 'slope_per_month_ci95': [*t.monthly[1:]],
            'p_value': t.p_value, 'p_family': t.p_family, 'significant': t.p_family <= DRIFT_RATE}
            for t in judged.trends],
        'outliers': odd,
        'rows': [{name: value.isoformat() if name == 'start' and value is not None else value
                  for name, value in row.items()} for row in fleet.rows],
        'notes': [*fleet.notes, *comparison_words(fleet)]}


def _vehicle_value(judged: Judgement, name: str, vehicle: str) -> float:
    one = judged.vehicles[name]
    return (math.exp(one.value[one.names.index(vehicle)])
            if vehicle in one.names else NAN)


def dips_of(rows: Sequence[Row]) -> tuple[int, float, int] | None:
    """Return number of dips, seconds below the limit, recordings with dips; None if unknown."""
    known = [row for row in rows if row['dips'] is not None]
    return None if not known else (
        sum(int(row['dips']) for row in known), sum(row['below_s'] for row in known),
        sum(row['dips'] > 0 for row in known))


def worst(fleet: Fleet) -> list[Row]:
    """Return the recordings by lowest voltage per cell."""
    return sorted((row for row in fleet.analysed if row['lowest'] is not None),
                  key=lambda row: (_of_a_cell(row), row['path']))


def _of_a_cell(row: Row) -> float:
    """Return the lowest voltage per cell, V; of the supply if the cells are unknown."""
    return float(row['lowest']) / (row['cells'] or 1)


def sentences(fleet: Fleet) -> list[str]:
    """Return the main facts for a pilot; empty if no recording has a voltage."""
    rows = worst(fleet)
    if not rows:
        return []
    lowest, found = _lowest_of(rows), dips_of(rows)
    if found is None:
        text = f'The lowest voltage was {lowest}'
    elif not found[0]:
        text = f'No recording fell below {fleet.limit:g} V: the lowest was {lowest}'
    else:
        most = max(rows, key=lambda row: row['dips'] or 0)
        count, below, recordings = found
        where = f'in {recordings} of {counted(len(rows), "recording")}'
        if recordings > 1 and most['dips'] > 1:
            where += f', most in {_name(most)}, {most["dips"]}'
        text = (f'{counted(count, "dip")} below {fleet.limit:g} V, {number(below, 2)} s in all, '
                f'{where}: the lowest was {lowest}')
    sags = [row for row in rows if row['sag'] is not None]
    if not sags:
        return [f'{text}.']
    row = max(sags, key=lambda row: row['sag'])
    return [f'{text}.', f'The rail sags by up to {volts(row["sag"])}, at '
            f'{100.0 * row["sag_throttle"]:.0f} % throttle in {_name(row)}.']


def _lowest_of(rows: Sequence[Row]) -> str:
    """Return the lowest voltage per cell in words, and where and when it was."""
    low = rows[0]
    found = f'{number(low["lowest"], 4)} V'
    if low['cells'] and len({row['cells'] for row in rows}) > 1:
        found = f'{number(_of_a_cell(low), 4)} V per cell ({found}, {_cells_of([low])} cells)'
    u = low['lowest_throttle']
    return f'{found} at {number(low["lowest_at"])} s of {_name(low)}' + (
        '' if u is None else f', at {100.0 * u:.0f} % throttle')


def _name(row: Row) -> str:
    vehicle = '' if row['vehicle'] is None else f' ({row["vehicle"]})'
    return f'{row["recording"]}{vehicle}'


def short_names(names: Sequence[str]) -> dict[str, str]:
    """Return names for tables: long ones without their middle if that leaves them unique."""
    short = {name: name if len(name) <= _NAME else f'{name[:13]}\u2026{name[13 - _NAME + 1:]}'
             for name in names}
    uses = Counter(short.values())
    return {name: text if uses[text] == 1 else name for name, text in short.items()}


def lowest_table(fleet: Fleet, most: int = _WORST) -> Table:
    """Return the recordings with the lowest voltages."""
    names = short_names(fleet.vehicles)
    return Table.of_known(LOWEST_HEADS, [
        [names.get(row['vehicle'], UNKNOWN), row['recording'], _cell(row['lowest'], 4),
         _cell(_of_a_cell(row), 4) if row['cells'] else UNKNOWN, _cell(row['lowest_at']),
         UNKNOWN if row['dips'] is None else f'{row["dips"]:g}',
         _cell(row['below_s'], 2), _cell(row['resistance'], factor=1e3), _cell(row['sag']),
         UNKNOWN if row['sag_throttle'] is None else f'{100.0 * row["sag_throttle"]:.0f} %']
        for row in worst(fleet)[:most]], left=[0, 1], most=_SHOWN)


def _cell(value: float | None, digits: int = 3, factor: float = 1.0) -> str:
    return UNKNOWN if value is None else number(factor * value, digits)


def _lowest(fleet: Fleet, rows: list[Row]) -> Plot:
    names = [*fleet.vehicles, *(['unknown'] if any(row['vehicle'] is None for row in rows)
                                else [])]
    plot = Plot('Lowest voltage of every recording', 'vehicle', 'V', height=240)
    plot.places(list(short_names(names).values()))
    x = np.array([names.index(row['vehicle'] or 'unknown') + 1.0 for row in rows])
    flights = np.array([row['flight'] or 0 for row in rows])
    for place in np.unique(x):
        mine = np.flatnonzero(x == place)
        if mine.size > 1:
            # Side by side in the order of flights, so that a drift appears as a slope.
            x[mine[np.argsort(flights[mine], kind='stable')]] += np.linspace(
                -0.32, 0.32, mine.size)
    lowest = np.array([row['lowest'] for row in rows])
    under = np.array([bool(row['dips']) for row in rows])
    plot.markers(x[~under], lowest[~under], 'recordings' if under.any() else '', 0)
    if under.any():
        plot.markers(x[under], lowest[under], 'with dips', 1)
    if math.isfinite(fleet.limit):
        plot.level((0.4, len(names) + 0.6), fleet.limit, f'limit {fleet.limit:g} V')
    return plot


def _drift(fleet: Fleet) -> list[Part]:
    """Return plots of the drifts that are certain."""
    judged = fleet.judgement
    return [*Pair.two_by_two([Figure(_trend_plot(judged.values[t.quantity], t), (
        f'{change(t.slope)} per flight; fleet-wide p {chance(t.p_family)}. Values'
        f'{_at_throttle(judged.values[t.quantity]) or " as measured"}, with 95 % intervals.'))
        for t in judged.drifting[:_DRAWN]])]


def _trend_plot(values: Values, trend: Trend) -> Plot:
    mine = values.of(trend.vehicle) & (values.flights > 0)
    x, y, reach = values.flights[mine].astype(float), values.value[mine], Z95 * values.error[mine]
    scale = _thousandths(values.name)
    cell = ' per cell' * bool(values.cells[mine].all())
    plot = Plot(f'{trend.vehicle}: {_TITLES[values.name]}{cell}', 'flight', _UNITS[values.name],
                width=450, height=260, log_y=True)
    plot.limits(x=(trend.first - 0.5, trend.last + 0.5))
    plot.bars(x, scale * np.exp(y - reach), scale * np.exp(y + reach), '', 7)
    plot.markers(x, scale * np.exp(y), '', 0)
    at = np.linspace(trend.first, trend.last, 50)
    return plot.line(at, scale * np.exp(trend.line(at)), '', 1, 'thick')


def _causes(fleet: Fleet) -> list[Part]:
    found = [row for row in fleet.analysed if row['verdict'] is not None]
    counts = Counter([f"verdict {row['verdict']}" for row in found] + [
        f'cause {cause}' for row in found for cause in dict.fromkeys(row['causes'] or ())])
    return [Table(['what', 'recordings'], [[text, str(n)] for text, n in counts.most_common()],
                  left=[0])] if counts else []


def _recordings(fleet: Fleet) -> list[Part]:
    judged = fleet.judgement
    places: dict[str, dict[str, int]] = {
        name: {path: k for k, path in enumerate(values.paths)}
        for name, values in judged.values.items()}
    flags: dict[str, set[str]] = {}
    for row in fleet.rows:
        flags.setdefault(row['path'], set()).update(row['flags'] or ())
    rows, names = [], short_names(fleet.vehicles)
    for row in fleet.analysed[:_RECORDINGS]:
        measured = [
            _measured(values, judged.recordings[name].score, places[name].get(row['path']))
            for name, values in judged.values.items()]
        start = f"{row['start']:%Y-%m-%d %H:%M UTC}" if row['start'] else ''
        rows.append([
            names.get(row['vehicle'], UNKNOWN), str(row['flight'] or UNKNOWN),
            f"{row['recording']}\n{start}", _cells_of([row]), _cell(row['duration_s'] or None),
            _cell(row['lowest'], 4), UNKNOWN if row['dips'] is None else f"{row['dips']:g}",
            *measured, ', '.join(sorted(flags[row['path']])) or UNKNOWN])
    heads = ['vehicle', 'flight', 'recording', 'cells', 's', 'lowest, V', 'dips', *[
        f'{name}, {_UNITS[name]}' + '\nper cell' * (name in OF_PACK) for name in QUANTITIES],
        'flags']
    more = len(fleet.analysed) - _RECORDINGS
    return [Table.of_known(heads, rows, left=[0, 2, len(heads) - 1]), Text(
        'As measured; "?": guessed; pack: of the whole supply. Small print: the '
        'throttle and, if the vehicle has enough flights, the distance from its other flights in '
        'standard deviations.' + (
            f' {more} more recordings are in the Parquet table.' if more > 0 else ''),
        legend=True)]


def _measured(values: Values, score: FloatArray, k: int | None) -> str:
    if k is None:
        return UNKNOWN
    at = values.throttle[k]
    small = ['pack'] if values.name in OF_PACK and not values.cells[k] else []
    small += [f'at {100.0 * at:.0f} %'] if math.isfinite(at) else []
    small += [f'{score[k]:+.1f} sd'] if math.isfinite(score[k]) else []
    return (number(_thousandths(values.name) * float(values.measured[k])) + '\n'
            + ', '.join(small)).rstrip()
