"""What `fleet` says: what stands out first, then the fleet, then every recording."""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any

import numpy as np
from ou_monitor.criticism.curves import outline
from ou_monitor.fleet import lowest
from ou_monitor.fleet.comparison import LOGARITHMIC, QUANTITIES, USABLE, Values
from ou_monitor.fleet.fleet import Fleet
from ou_monitor.fleet.judgement import DRIFT_RATE, Trend
from ou_monitor.fleet.summary import (
    answer, change, comparison_words, failure_words, finding_words, quality_counts, vehicle_table)
from ou_monitor.fleet.table import Row
from ou_monitor.records import FloatArray, Severity
from ou_monitor.report.document import (
    Document, Facts, Figure, Notes, Pair, Part, Section, Table, Text)
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, counted, number

_TITLES = {'sigma': 'Noise intensity \u03c3', 'alpha': 'Relaxation rate \u03b1',
           'sag': 'Sag at full throttle'}
_UNITS = {'sigma': 'V/\u221as', 'alpha': '1/s', 'sag': 'V'}
# Drifts drawn at most; without any, the most likely ones are drawn, so many.
_DRAWN, _LIKELY = 8, 2
# Trends in the table: at least, with those of p below 5 %, and at most.
_LEAST, _MOST = 6, 30
# Recordings in the table of the lowest voltages; rows and sentences on a terminal.
_WORST, _SHOWN = 12, 10
# Sentences and recordings listed at most; the table has all of them.
_SENTENCES, _RECORDINGS = 40, 500


def fleet_document(fleet: Fleet, command: str = '') -> Document:
    """Return what is said of a fleet."""
    rows = lowest.worst(fleet)
    odd = finding_words(fleet)
    vehicles, lows = vehicle_table(fleet), lowest.table(fleet, _WORST)
    copies = [f"{row['path']} is {row['duplicate_of']}" for row in fleet.duplicates]
    subject = (f'{counted(fleet.recordings, "recording")}, '
               f'{counted(len(fleet.vehicles), "vehicle")}, '
               f'{counted(len(fleet.rows), "row")} in the table')
    parts: list[Part] = [
        lambda: [Figure(_lowest(fleet, rows), 'Each dot is a recording.')] if rows else [],
        Facts(lowest.facts(fleet)),
        Section('What stands out', [
            Notes.of(odd[:_SENTENCES], Severity.WARNING, _SHOWN),
            *([Text(f'and {len(odd) - _SENTENCES} more: see the table.')]
              if len(odd) > _SENTENCES else [])] if odd else [
                  Text('Nothing, at the false-alarm rates stated below.')]),
        Section('Lowest voltages', [Table(
            *lows, left=[lows[0].index(name) for name in ('vehicle', 'recording')
                         if name in lows[0]], most=_SHOWN)]),
        Section('Not analysed: the next run tries them again', [
            Notes.of(failure_words(fleet), Severity.ERROR, _SHOWN)] if fleet.failed else []),
        Section('There twice, analysed once', [Notes.of(copies, most=_SHOWN)] if copies else []),
        Section('Vehicles', [
            Table(*vehicles, left=[0], most=2 * _SHOWN),
            Text('The lowest of all flights, their dips together; the rest are medians of what '
                 'was measured, and the change a flight of what is compared. A star marks what '
                 'stands out.', legend=True), lambda: _strips(fleet)]
                if vehicles[1] else [Text('No vehicle was identified.', legend=True)]),
        lambda: [Section('Drift over the flights', _drift(fleet)),
                 Section('Distributions', _distributions(fleet), folded=True),
                 Section('Quality', _quality(fleet), folded=True)],
        Section('What to know before using these numbers', [
            Notes.of([*fleet.notes, *comparison_words(fleet)])]),
        lambda: [Section('Recordings', _recordings(fleet), folded=True)]]
    return Document('Supply noise of a fleet', subject, answer(fleet), parts, command)


def _lowest(fleet: Fleet, rows: list[Row]) -> Plot:
    """Return the lowest voltage of each recording over the vehicles, and the limit."""
    names = [*fleet.vehicles, *(['unknown'] if any(row['vehicle'] is None for row in rows)
                                else [])]
    at = np.array([names.index(row['vehicle'] or 'unknown') + 1.0 for row in rows])
    low = np.array([row['lowest'] for row in rows])
    under = np.array([bool(row['dips']) for row in rows])
    x = at + _side_by_side(at, np.array([float(row['flight'] or 0) for row in rows]))
    plot = Plot('Lowest voltage of every recording', 'vehicle', 'V', height=240).places(
        list(lowest.short_names(names).values()))
    plot.markers(x[~under], low[~under], 'recordings' if under.any() else '', 0)
    if under.any():
        plot.markers(x[under], low[under], 'with dips', 1)
    if math.isfinite(fleet.limit):
        plot.line(np.array([0.4, len(names) + 0.6]), np.full(2, fleet.limit),
                  f'limit {fleet.limit:g} V', 1, 'dash')
    return plot


def _side_by_side(at: FloatArray, flights: FloatArray) -> FloatArray:
    """Return how far dots of one place are moved, in the order of their flights."""
    moved = np.zeros(at.size)
    for place in np.unique(at[np.isfinite(at)]):
        mine = np.flatnonzero(at == place)
        if mine.size > 1:
            moved[mine[np.argsort(flights[mine], kind='stable')]] = np.linspace(
                -0.32, 0.32, mine.size)
    return moved


def _strips(fleet: Fleet) -> list[Part]:
    return [Figure(_by_vehicle(fleet, values), (
        'As measured: the mean over the levels of each recording.' if name == 'sigma' else ''))
        for name in LOGARITHMIC if (values := fleet.judgement.values[name]).value.size]


def _by_vehicle(fleet: Fleet, values: Values) -> Plot:
    """Return a strip of dots for each vehicle."""
    names = fleet.vehicles
    out = fleet.judgement.recordings[values.name]
    x = np.array([names.index(v) + 1.0 if v else np.nan for v in values.vehicles])
    # Flights lie side by side in their order, so that a drift shows as a slope.
    spread = _side_by_side(x, values.flights.astype(np.float64))
    y, odd = values.measured, out.found
    plot = Plot(f'{_TITLES[values.name]} of every recording', 'vehicle', _UNITS[values.name],
                height=260, log_y=values.name in LOGARITHMIC)
    plot.places(list(lowest.short_names(names).values()))
    for k in range(0, len(names), 2):
        plot.shade(k + 0.5, k + 1.5, 7)
    plot.markers((x + spread)[~odd], y[~odd], 'recordings', 0)
    if odd.any():
        plot.markers((x + spread)[odd], y[odd], 'outliers of their vehicle', 1)
    return plot


def _drift(fleet: Fleet) -> list[Part]:
    judged = fleet.judgement
    drawn = list(judged.drifting[:_DRAWN]) or list(judged.trends[:_LIKELY])
    if not drawn:
        return [Text('No vehicle has enough flights for a test.')]
    parts: list[Part] = [] if judged.drifting else [
        Text('No drift stands at the rate of the fleet; the most likely ones are drawn.')]
    parts += Pair.two_by_two([
        Figure(_trend_plot(judged.values[t.quantity], t), _caption(t, fleet)) for t in drawn])
    listed = [t for k, t in enumerate(judged.trends) if k < _LEAST or t.p_value < DRIFT_RATE]
    rows = [[t.vehicle, t.quantity, str(t.flights), change(t.quantity, t.slope) + '\n'
             + f'[{change(t.quantity, t.low)}, {change(t.quantity, t.high)}]',
             chance(t.p_value), chance(t.p_family),
             'yes' if t.p_family <= DRIFT_RATE else 'no'] for t in listed[:_MOST]]
    more = len(judged.trends) - len(rows)
    return [*parts, Table(['vehicle', 'quantity', 'flights', 'change a flight\n[95 %]', 'p',
                           'p over the fleet', 'stands'], rows, left=[0, 1]), Text(
        'Intervals by Theil and Sen. p is that of Mann and Kendall, the next one after Holm.'
        + (f' {more} less likely trends are not shown.' if more > 0 else ''), legend=True)]


def _compared(name: str, fleet: Fleet) -> str:
    """Return at which throttle a quantity is compared."""
    at = fleet.judgement.values[name].curve.reference
    return 'full throttle' if name == 'sag' else (
        f'{100.0 * at:.0f} % throttle' if math.isfinite(at) else 'the throttle of each')


def _caption(trend: Trend, fleet: Fleet) -> str:
    return (f'{change(trend.quantity, trend.slope)} a flight; p over the fleet '
            f'{chance(trend.p_family)}. At {_compared(trend.quantity, fleet)}, with its error.')


def _trend_plot(values: Values, trend: Trend) -> Plot:
    mine = np.array([v == trend.vehicle for v in values.vehicles]) & (values.flights > 0)
    x, y = values.flights[mine].astype(float), values.value[mine]
    low, high = values.interval()
    plot = Plot(f'{trend.vehicle}: {_TITLES[values.name]}', 'flight', _UNITS[values.name],
                width=450, height=260, log_y=values.name in LOGARITHMIC)
    plot.limits(x=(trend.first - 0.5, trend.last + 0.5))
    plot.bars(x, low[mine], high[mine], '', 7)
    plot.markers(x, values.shown(y), '', 0)
    at = np.linspace(trend.first, trend.last, 50)
    return plot.line(at, values.shown(trend.line(at)), '', 1, 'thick')


def _distributions(fleet: Fleet) -> list[Part]:
    figures = []
    for name in QUANTITIES:
        values = fleet.judgement.values[name]
        if values.value.size >= 5:
            edges, count = values.histogram()
            x, height = outline(edges, count)
            # On a log axis the outline has its corners where the bins are even in the logarithm.
            plot = Plot(f'{_TITLES[name]}, all recordings', _UNITS[name], 'recordings', width=450,
                        height=240, log_x=name in LOGARITHMIC)
            plot.limits(y=(0.0, 1.08 * float(count.max())))
            figures.append(Figure(plot.line(
                values.shown(np.concatenate((x[:1], x, x[-1:]))),
                np.concatenate(([0.0], height, [0.0])), '', 0, 'thick')))
    over = _over_throttle(fleet)
    if over:
        figures.append(Figure(over))
    if not figures:
        return [Text('Fewer than five recordings have an estimate.', legend=True)]
    parts: list[Part] = [*Pair.two_by_two(figures)]
    if over:
        parts.append(Text(
            'Histograms are at the reference throttle. Over throttle: every level of every '
            'recording, and the common curve that is taken out, through the median of all.',
            legend=True))
    return parts


def _over_throttle(fleet: Fleet) -> Plot | None:
    values = fleet.judgement.values['sigma']
    good = [row for row in fleet.rows if row['status'] in USABLE and row['sigma'] is not None
            and row['throttle'] is not None]
    if len(good) < 5 or not math.isfinite(values.curve.reference):
        return None
    u = np.array([row['throttle'] for row in good])
    plot = Plot(f'{_TITLES["sigma"]} over throttle, all levels', 'throttle, %', _UNITS['sigma'],
                width=450, height=240, log_y=True)
    plot.markers(100.0 * u, np.array([row['sigma'] for row in good]), '', 7)
    at = np.linspace(float(u.min()), float(u.max()), 60)
    return plot.line(100.0 * at, values.common_curve(at), '', 1, 'thick')


def _quality(fleet: Fleet) -> list[Part]:
    counts = quality_counts(fleet)
    if not counts:
        return [Text('Every level has an estimate, and no flag was raised.')]
    return [Table(['what', 'how often'], [[text, str(n)] for text, n in counts], left=[0])]


def _recordings(fleet: Fleet) -> list[Part]:
    judged = fleet.judgement
    places: dict[str, dict[str, int]] = {
        name: {path: k for k, path in enumerate(values.paths)}
        for name, values in judged.values.items()}
    once: dict[str, Mapping[str, Any]] = {}
    flags: dict[str, set[str]] = {}
    for row in fleet.rows:
        if row['error'] is not None or row['duplicate_of'] is not None:
            continue
        once.setdefault(row['path'], row)
        flags.setdefault(row['path'], set()).update(row['flags'] or ())
    rows, names = [], lowest.short_names(fleet.vehicles)
    for path, first in list(once.items())[:_RECORDINGS]:
        cells = [names.get(first['vehicle'], '-'), str(first['flight'] or '-'),
                 f"{first['recording']}\n{_date(first)}",
                 number(first['duration_s'] or math.nan)]
        for name, values in judged.values.items():
            cells.append(_cell(values, judged.recordings[name].score, places[name].get(path)))
        cells[4:4] = ['-' if first['lowest'] is None else number(first['lowest'], 4),
                      '-' if first['dips'] is None else f"{first['dips']:g}"]
        rows.append([*cells, ', '.join(sorted(flags[path])) or '-'])
    heads = ['vehicle', 'flight', 'recording', 's', 'lowest, V', 'dips', *[
        f'{name}, {_UNITS[name]}' for name in QUANTITIES], 'flags']
    more = len(once) - _RECORDINGS
    return [Table(heads, rows, left=[0, 2, 9]), Text(
        'As measured. Small: at which throttle, and, where the vehicle has enough flights, how '
        'far from the others of it, in standard deviations.' + (
            f' {more} more recordings are in the Parquet table.' if more > 0 else ''),
        legend=True)]


def _date(row: Mapping[str, Any]) -> str:
    return '' if row['start'] is None else row['start'].strftime('%Y-%m-%d %H:%M UTC')


def _cell(values: Values, score: FloatArray, k: int | None) -> str:
    if k is None:
        return '-'
    at = values.throttle[k]
    small = [f'at {100.0 * at:.0f} %'] if math.isfinite(at) else []
    small += [f'{score[k]:+.1f} sd'] if math.isfinite(score[k]) else []
    return number(float(values.measured[k])) + '\n' + ', '.join(small)
