"""The report of `fleet`: what stands out first, then the fleet, then every recording."""

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
    change, comparison_words, failure_words, finding_words, headline, quality_counts,
    vehicle_table)
from ou_monitor.fleet.table import Row
from ou_monitor.records import FloatArray
from ou_monitor.report import page
from ou_monitor.report.page import typeset, UNKNOWN
from ou_monitor.report.svg import Plot
from ou_monitor.text import chance, counted, number

_TITLES = {'sigma': 'Noise intensity \u03c3', 'alpha': 'Relaxation rate \u03b1',
           'sag': 'Sag at full throttle'}
_UNITS = {'sigma': 'V/\u221as', 'alpha': '1/s', 'sag': 'V'}
# Drifts drawn at most; without any, the most likely ones are drawn, so many.
_DRAWN, _LIKELY = 8, 2
# Trends in the table: at least, with those of p below 5 %, and at most.
_LEAST, _MOST = 6, 30
# Recordings in the table of the lowest voltages.
_WORST = 12
# Sentences and recordings listed at most; the table has all of them.
_SENTENCES, _RECORDINGS = 40, 500


def fleet_page(fleet: Fleet, command: str = '') -> str:
    """Return the report of a fleet."""
    rows = lowest.worst(fleet)
    sections = [page.headline(_sentence(headline(fleet)))]
    if rows:
        sections += [page.figure(_lowest(fleet, rows), 'Each dot is a recording.'),
                     page.facts([(name, _sentence(words)) for name, words in lowest.facts(fleet)])]
    sections.append(page.section('What stands out', *_odd(fleet)))
    if rows:
        sections.append(page.section('Lowest voltages', *_worst(fleet)))
    if fleet.failed or fleet.duplicates:
        sections.append(page.section('Not in the comparison', *_left_out(fleet)))
    sections += [
        page.section('Vehicles', *_vehicles(fleet)),
        page.section('Drift over the flights', *_drift(fleet)),
        page.section('Distributions', *_distributions(fleet), folded=True),
        page.section('Quality', *_quality(fleet), folded=True),
        page.section('What to know before using these numbers', page.bullets(
            [_sentence(note) for note in (*fleet.notes, *comparison_words(fleet))])),
        page.section('Recordings', *_recordings(fleet), folded=True),
    ]
    if command:
        sections.append(page.section('Where it comes from', page.paragraph(
            'To repeat this, or to go on with recordings that came later:'), page.code(command),
            folded=True))
    subtitle = (f'{counted(fleet.recordings, "recording")}, '
                f'{counted(len(fleet.vehicles), "vehicle")}, '
                f'{counted(len(fleet.rows), "row")} in the table')
    return page.page('Supply noise of a fleet', subtitle, sections)


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


def _worst(fleet: Fleet) -> list[str]:
    heads, rows = lowest.table(fleet, _WORST)
    names = [k for k, (head, _) in enumerate(heads) if head in ('vehicle', 'recording')]
    listed = [[cell if k in names else typeset(cell) for k, cell in enumerate(row)]
              for row in rows]
    more = len(lowest.once(fleet)) - len(listed)
    return [page.table([head for _, head in heads], listed, left=names)] + (
        [page.paragraph(f'{more} more are below, under Recordings.', soft=True)] if more else [])


def _sentence(text: str) -> str:
    return text.replace('+-', '\u00b1')


def _odd(fleet: Fleet) -> list[str]:
    found = finding_words(fleet)
    if not found:
        return [page.paragraph('Nothing, at the false-alarm rates stated below.')]
    more = len(found) - _SENTENCES
    last = [f'and {more} more: see the table.'] if more > 0 else []
    return [page.bullets([*found[:_SENTENCES], *last], warn=True)]


def _left_out(fleet: Fleet) -> list[str]:
    parts = []
    if fleet.failed:
        parts += [page.paragraph(f'{len(fleet.failed)} could not be analysed; the next run tries '
                                 'them again:'),
                  page.bullets(failure_words(fleet), warn=True)]
    if fleet.duplicates:
        parts += [page.paragraph(f'{len(fleet.duplicates)} have the same content as another one '
                                 'and were not analysed again:'),
                  page.bullets([f"{row['path']} is {row['duplicate_of']}"
                                for row in fleet.duplicates])]
    return parts


def _vehicles(fleet: Fleet) -> list[str]:
    heads, rows = vehicle_table(fleet)
    if not rows:
        return [page.paragraph('No vehicle was identified.', soft=True)]
    parts = [page.table([head for _, head in heads],
                        [[row[0], *map(typeset, row[1:])] for row in rows], left=[0]),
             page.paragraph('The lowest of all flights, their dips together; the rest are medians '
                            'of what was measured, and the change a flight of what is compared. '
                            'A star marks what stands out.', soft=True)]
    for name in LOGARITHMIC:
        values = fleet.judgement.values[name]
        if values.value.size:
            parts.append(page.figure(_by_vehicle(fleet, values), (
                'As measured: the mean over the levels of each recording.'
                if name == 'sigma' else '')))
    return parts


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


def _drift(fleet: Fleet) -> list[str]:
    judged = fleet.judgement
    drawn = list(judged.drifting[:_DRAWN]) or list(judged.trends[:_LIKELY])
    if not drawn:
        return [page.paragraph('No vehicle has enough flights for a test.', soft=True)]
    parts = []
    if not judged.drifting:
        parts.append(page.paragraph('No drift stands at the rate of the fleet; the most likely '
                                    'ones are drawn.'))
    parts += _pairs([page.figure(_trend_plot(judged.values[t.quantity], t), _caption(t, fleet))
                     for t in drawn])
    listed = [t for k, t in enumerate(judged.trends) if k < _LEAST or t.p_value < DRIFT_RATE]
    rows = [[t.vehicle, t.quantity, str(t.flights), typeset(change(t.quantity, t.slope)) + '\n'
             + f'{typeset(change(t.quantity, t.low))} to {typeset(change(t.quantity, t.high))}',
             chance(t.p_value), chance(t.p_family),
             'yes' if t.p_family <= DRIFT_RATE else 'no'] for t in listed[:_MOST]]
    parts.append(page.table(['Vehicle', 'Quantity', 'Flights', 'Change a flight', 'p',
                             'p over the fleet', 'Stands'], rows, left=[0, 1]))
    more = len(judged.trends) - len(rows)
    parts.append(page.paragraph(
        'Small: 95 % interval (Theil and Sen). p is that of Mann and Kendall, the next one after '
        'Holm.' + (f' {more} less likely trends are not shown.' if more > 0 else ''), soft=True))
    return parts


def _pairs(figures: list[str]) -> list[str]:
    """Return figures two by two; a lone one keeps half of the width."""
    return [page.pair(*(figures[k:k + 2] + ['<div></div>'])[:2])
            for k in range(0, len(figures), 2)]


def _compared(name: str, fleet: Fleet) -> str:
    """Return at which throttle a quantity is compared."""
    at = fleet.judgement.values[name].curve.reference
    return 'full throttle' if name == 'sag' else (
        f'{100.0 * at:.0f} % throttle' if math.isfinite(at) else 'the throttle of each')


def _caption(trend: Trend, fleet: Fleet) -> str:
    return (f'{typeset(change(trend.quantity, trend.slope))} a flight; p over the fleet '
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


def _distributions(fleet: Fleet) -> list[str]:
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
            figures.append(page.figure(plot.line(
                values.shown(np.concatenate((x[:1], x, x[-1:]))),
                np.concatenate(([0.0], height, [0.0])), '', 0, 'thick')))
    over = _over_throttle(fleet)
    if over:
        figures.append(page.figure(over))
    if not figures:
        return [page.paragraph('Fewer than five recordings have an estimate.', soft=True)]
    parts = _pairs(figures)
    if over:
        parts.append(page.paragraph(
            'Histograms are at the reference throttle. Over throttle: every level of every '
            'recording, and the common curve that is taken out, through the median of all.',
            soft=True))
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


def _quality(fleet: Fleet) -> list[str]:
    counts = quality_counts(fleet)
    if not counts:
        return [page.paragraph('Every level has an estimate, and no flag was raised.')]
    return [page.table(['What', 'How often'], [[text, str(n)] for text, n in counts], left=[0])]


def _recordings(fleet: Fleet) -> list[str]:
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
        cells = [names.get(first['vehicle'], UNKNOWN), str(first['flight'] or UNKNOWN),
                 f"{first['recording']}\n{_date(first)}",
                 typeset(number(first['duration_s'] or math.nan))]
        for name, values in judged.values.items():
            cells.append(_cell(values, judged.recordings[name].score, places[name].get(path)))
        cells[4:4] = [UNKNOWN if first['lowest'] is None else number(first['lowest'], 4),
                      UNKNOWN if first['dips'] is None else f"{first['dips']:g}"]
        rows.append([*cells, ', '.join(sorted(flags[path])) or UNKNOWN])
    heads = ['Vehicle', 'Flight', 'Recording', 's', 'Lowest, V', 'Dips', *[
        f'{symbol}, {_UNITS[name]}' for name, symbol in zip(
            QUANTITIES, ('\u03c3', '\u03b1', 'Sag'))], 'Flags']
    more = len(once) - _RECORDINGS
    return [page.table(heads, rows, left=[0, 2, 9]), page.paragraph(
        'As measured. Small: at which throttle, and, where the vehicle has enough flights, how '
        'far from the others of it, in standard deviations.' + (
            f' {more} more recordings are in the Parquet table.' if more > 0 else ''),
        soft=True)]


def _date(row: Mapping[str, Any]) -> str:
    return '' if row['start'] is None else row['start'].strftime('%Y-%m-%d %H:%M UTC')


def _cell(values: Values, score: FloatArray, k: int | None) -> str:
    if k is None:
        return UNKNOWN
    at = values.throttle[k]
    small = [f'at {100.0 * at:.0f} %'] if math.isfinite(at) else []
    small += [typeset(f'{score[k]:+.1f} sd')] if math.isfinite(score[k]) else []
    return typeset(number(float(values.measured[k]))) + '\n' + ', '.join(small)
