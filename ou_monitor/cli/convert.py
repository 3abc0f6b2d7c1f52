"""`ou-monitor convert LOG OUT`: convert a log to an MCAP bag."""

from __future__ import annotations

import argparse
from typing import Any

from ou_monitor.cli import output
from ou_monitor.cli.arguments import check_outputs, columns_given
from ou_monitor.cli.output import Progress
from ou_monitor.errors import InputError
from ou_monitor.report.document import Document, Facts, Notes, Part, Table, Text


def run(args: argparse.Namespace) -> int:
    if args.list and args.out is not None:
        raise InputError(f"--list writes no bag: leave '{args.out}' out")
    # Check the outputs first: reading the log may take long.
    check_outputs(args, ('OUT', args.out), LOG=args.log)

    from ou_monitor.recordings.importers.formats import import_log
    from ou_monitor.recordings.importers.log import Request

    names = frozenset(name for name in (args.voltage, args.throttle, args.current, *args.signal)
                      if name is not None)
    with Progress('reading') as progress:
        log = import_log(args.log, Request(args.flight, names, args.poles, args.list, progress,
                                           columns_given(args)))
    return _list(args, log) if args.list else _convert(args, log)


def _convert(args: argparse.Namespace, log: Any) -> int:
    from ou_monitor.recordings.importers.choose import choose, choose_extras
    from ou_monitor.recordings.write import write_log

    chosen = choose(args.log, log, voltage=args.voltage, throttle=args.throttle,
                    current=args.current)
    extras, said = choose_extras(args.log, log, imu=args.imu, signals=args.signal)
    about = {'log_file': args.log.name, 'log_format': log.format,
             'log_time': 'as in the file, s' if log.format == 'csv' else
             's from the start of the log',
             **{f'log_{key}': value for key, value in log.facts.items()}}
    with Progress('writing') as progress, \
            output.replacing(args.out, args.force):
        topics, moved = write_log(chosen, extras, args.out, about, progress=progress)
    notes = (*log.notes, *chosen.notes, *said, *moved)
    volts = chosen.voltage
    duration = float(volts.t[-1] - volts.t[0])
    taken = _topic_contents(chosen, extras)
    parts: list[Part] = [
        Table(['topic', 'from', 'what it is', 'samples', 'unit', 'message'], [
            [topic, one['field'], one['what'], str(one['n']), one['unit'], topics[topic]]
            for topic, one in taken.items()], left=[0, 1, 2, 4, 5]),
        Facts([(name, str(value)) for name, value in log.facts.items()]), Notes.of(notes)]
    subject = (f'{args.out}: {volts.n} samples, {duration:.3f} s'
               + (f', {volts.rate:.6g} Hz' if volts.n > 1 else ''))
    output.tell(args, Document('A bag', subject, (), parts), lambda: {
        'log': str(args.log), 'out': str(args.out), 'n': volts.n, 'duration_s': duration,
        'topics': topics, 'source': {**about, **taken}, 'notes': notes})
    return 0


def _topic_contents(chosen: Any, extras: dict[str, Any]) -> dict[str, dict[str, Any]]:
    found = {'voltage': chosen.voltage, 'throttle': chosen.throttle, 'current': chosen.current,
             **extras}
    return {f'/{topic}': {'field': one.name, 'scale': one.scale, 'what': one.words,
                          'unit': one.unit, 'n': one.n}
            for topic, one in found.items() if one is not None}


def _list(args: argparse.Namespace, log: Any) -> int:
    import numpy as np
    from ou_monitor.recordings.importers.choose import default
    from ou_monitor.recordings.importers.log import CURRENT, IMU, SIGNAL, SPEEDS, THROTTLE, VOLTAGE

    taken = {quantity: [one.name for one in default(log, quantity)]
             for quantity in (VOLTAGE, THROTTLE, CURRENT)}
    rows = []
    order = (VOLTAGE, THROTTLE, CURRENT, 'any', SIGNAL)
    for one in sorted(log.scalars, key=lambda one: (
            one.quantity not in order, order.index(one.quantity) if one.quantity in order else 0,
            one.rank is None, one.rank or 0)):
        known = one.values[np.isfinite(one.values)]
        low, high = (float(known.min()), float(known.max())) if known.size else (np.nan, np.nan)
        rows.append({
            'quantity': one.quantity, 'name': one.name, 'what': one.words,
            'default': one.name in taken.get(one.quantity, ()), 'n': one.n,
            'rate_hz': one.rate, 'min': low, 'max': high, 'unit': one.unit,
            'repeats': one.repeats, 'scale': one.scale})
    gyros = [{'name': one.name, 'what': one.words, 'n': one.n, 'scale': one.scale,
              'angular_velocity': True, 'acceleration': one.values.shape[1] > 3,
              'default': one in default(log, IMU)[:1]} for one in log.of(IMU)]
    several = [f'Several series are candidates for {quantity}: choose by --{quantity} NAME.'
               for quantity in (VOLTAGE, THROTTLE) if len(taken[quantity]) > 1]
    motors = log.of(SPEEDS)
    speeds = [name for one in motors for name in one.name.split(', ')]
    parts: list[Part] = [
        Table(('', 'quantity', 'name', 'samples', 'rate Hz', 'min', 'max', 'unit', 'repeats',
               'what'), [
            ['*' if row['default'] else '', row['quantity'], row['name'], str(row['n']),
             *(f'{row[key]:.4g}' for key in ('rate_hz', 'min', 'max')), row['unit'],
             f'{row["repeats"]:.0%}', row['what']] for row in rows], left=(0, 1, 2, 7, 9)),
        Table(('', '--imu', 'samples', 'what'), [
            ['*' if row['default'] else '', row['name'], str(row['n']), row['what']
             + ('' if row['acceleration'] else ', no accelerometer')] for row in gyros],
              left=(0, 1, 3)),
        Text(''.join(f'* /motor_speed: {one.words}, {one.n} samples, {one.name}'
                     for one in motors)), Notes.of([*several, *log.notes])]
    output.tell(args, Document('A log', f'{args.log}: {log.format}' + ''.join(
        f', {name} {value}' for name, value in log.facts.items()), (), parts), lambda: {
            'log': str(args.log), 'format': log.format, 'facts': log.facts, 'series': rows,
            'imu': gyros, 'motor_speed': speeds, 'notes': log.notes})
    return 0
