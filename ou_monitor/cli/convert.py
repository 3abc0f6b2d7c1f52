"""`ou-monitor convert LOG OUT`: a log becomes an MCAP bag."""

from __future__ import annotations

import argparse
from typing import Any

from ou_monitor.cli import output
from ou_monitor.errors import InputError

# Ending of LOG -> what it is.
FORMATS = {'.csv': 'CSV with the columns time_s, voltage_v[, throttle]'}

# Endings that OUT cannot have: a folder of that name would mislead.
LOG_ENDINGS = ('.csv', '.ulg', '.bin', '.bbl', '.bfl', '.log', '.db3', '.bag', '.txt')

TYPES = ('battery_state', 'float32', 'float64', 'adc_block')


def add_parser(subparsers: Any) -> None:
    """
    Add the command to the parser.

    Parameters
    ----------
    subparsers : argparse subparsers
        Where to add it.

    """
    parser: argparse.ArgumentParser = subparsers.add_parser(
        'convert', help='a log becomes an MCAP bag',
        description='Convert a log to a bag with the topics /voltage and /throttle.',
        epilog='Read today: ' + '; '.join(FORMATS.values()) + '.')
    parser.add_argument('log', metavar='LOG', type=output.path_argument, help='what to read')
    parser.add_argument(
        'out', metavar='OUT', type=output.path_argument,
        help='what to write: NAME.mcap for one file, NAME for a rosbag2 folder')
    parser.add_argument(
        '--type', choices=TYPES, default='battery_state',
        help='message of the voltage (default %(default)s; adc_block needs a steady 10 kHz)')
    parser.add_argument(
        '--json', metavar='FILE', help='write what was converted (- is standard output)')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """
    Convert.

    Parameters
    ----------
    args : argparse.Namespace
        As parsed.

    Returns
    -------
    int
        Exit status, 0.

    Raises
    ------
    InputError
        When LOG cannot be read or OUT cannot be written.

    """
    ending = args.log.suffix.lower()
    if not args.log.exists():
        raise InputError(f"there is no log '{args.log}': check the path")
    if ending not in FORMATS:
        raise InputError(
            f"'{args.log}' cannot be converted: formats read today: "
            + '; '.join(f'{key} ({words})' for key, words in FORMATS.items()))
    if args.out.suffix.lower() in LOG_ENDINGS:
        raise InputError(f"OUT '{args.out}' must end in .mcap, or be the name of a folder")
    output.check_paths({'LOG': args.log}, {'OUT': args.out, '--json': args.json})
    output.check_writable(args.json)

    from ou_monitor.recordings.read import read_recording
    from ou_monitor.recordings.write import TYPES as MESSAGES, write_recording

    recording = read_recording(args.log)
    with output.Progress('writing') as progress:
        notes = write_recording(recording, args.out, type=args.type, progress=progress)
    notes = recording.notes + notes
    topics = {'/voltage': MESSAGES[args.type]}
    if recording.has_throttle:
        topics['/throttle'] = 'std_msgs/msg/Float32'
    if args.json is not None:
        output.write_json({
            'log': str(args.log), 'out': str(args.out), 'n': recording.n,
            'duration_s': recording.duration, 'topics': topics, 'notes': list(notes)}, args.json)
    if args.json != output.STDOUT:
        output.say(f'{args.out}: {recording.n} samples, {recording.duration:.3f} s, '
                   + ', '.join(f'{topic} ({kind})' for topic, kind in topics.items()))
        for note in notes:
            output.say(f'note: {note}')
    return 0
