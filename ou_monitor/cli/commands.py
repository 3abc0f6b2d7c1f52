"""The table of commands: purpose, module, options.  A module is imported when its command runs."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
import math
import re
from typing import Any

from ou_monitor.cli.output import given, path_argument
from ou_monitor.text import plain_number, printable


class Option:
    """Names of an option or of an argument, and its settings for argparse."""

    def __init__(self, *names: str, **keywords: Any) -> None:
        self.names = names
        self.keywords = keywords


class OptionalOut(argparse.Action):
    """A flag that makes OUT optional (with nargs='?', OUT could not follow an option)."""

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace,
                 values: Any, option_string: str | None = None) -> None:
        setattr(namespace, self.dest, True)
        for action in parser._actions:
            if action.dest == 'out':
                action.required = False


# Maximum digits of a whole number, within 64 bits.
_DIGITS = 18


def whole(what: str, low: int, high: float = math.inf, step: int = 1) -> Callable[[str], int]:
    """Return a parser of multiples of step, low to high (what: wording for the error)."""
    def read(text: str) -> int:
        value = int(text) if text.isascii() and text.isdigit() and len(text) <= _DIGITS else -1
        if not low <= value <= high or value % step:
            raise argparse.ArgumentTypeError(f"'{printable(text, 60)}' is not {what}")
        return value
    return read


def number(what: str, fits: Callable[[float], bool]) -> Callable[[str], float]:
    """Return a parser of numbers for which `fits` is true (what: wording for the error)."""
    def read(text: str) -> float:
        try:
            value = plain_number(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f"'{printable(text, 60)}' is not {what}")
        return value
    return read


# Divisors, because unlike the factor 1e-6, 1e6 is exact: 10u is exactly 1e-5.
_PREFIX = {'': 1.0, 'p': 1e12, 'n': 1e9, 'u': 1e6, 'µ': 1e6, 'm': 1e3, 'k': 1e-3, 'M': 1e-6}
# Upper limit of a quantity, so that products stay finite.
_QUANTITY_MOST = 1e15
# Upper limits of components, with a margin; if a number is larger, its prefix was forgotten.
_PART_MOST = {'F': 10.0, 'H': 1.0, 'Ohm': 100.0}
_QUANTITY = re.compile(r'([+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d+)?)\s*([pnuµmkM]?)'
                       r'(F|H|[Oo]hm|Ω|V|A|Hz|W|s|1/s)?', re.ASCII)


def quantity(unit: str) -> Callable[[object], float]:
    """Return a parser of numbers with an optional SI prefix and unit."""
    def read(text: object) -> float:
        match = None if isinstance(text, bool) else _QUANTITY.fullmatch(str(text).strip())
        if not match or not abs(float(match[1])) < _QUANTITY_MOST:
            raise argparse.ArgumentTypeError(
                f"'{printable(text, 60)}' is not a number; write it as " + (
                    f'0.00047, 470u or 470u{unit}' if unit else '0.4 or 1e-3'))
        given = {'ohm': 'Ohm', 'Ω': 'Ohm'}.get(match[3], match[3])
        if given is not None and given != unit:
            raise argparse.ArgumentTypeError(f"'{text}' must be in {unit}" if unit else
                                             f"'{text}' must have no unit")
        value = float(match[1]) / _PREFIX[match[2]]
        if value > (most := _PART_MOST.get(unit, math.inf)):
            small = 'mOhm' if unit == 'Ohm' else f'u{unit}'
            raise argparse.ArgumentTypeError(
                f"'{text}' is {value:g} {unit}, beyond {most:g} {unit}: write the prefix, such as "
                f'{match[1]}{small}')
        return value
    return read


def throttles(text: str) -> tuple[float, ...]:
    """Read throttles 0..1 separated by commas; return them in order."""
    read = number('a throttle between 0 and 1; write 5 % as 0.05 and separate levels by commas',
                  lambda value: 0.0 <= value <= 1.0)
    ordered = tuple(sorted(read(word.strip()) for word in text.split(',')))
    if any(high - low < 1e-6 for low, high in zip(ordered, ordered[1:])):
        raise argparse.ArgumentTypeError(f"a level is given twice in '{text}'")
    return ordered


def band(text: str) -> tuple[float, float]:
    """Read two frequencies, Hz."""
    try:
        low, high = (plain_number(word) for word in text.split(','))
    except ValueError:
        raise argparse.ArgumentTypeError(
            f"'{text}' is not LOW,HIGH in Hz, such as 10,100") from None
    if not (0.0 < low < high and math.isfinite(high)):
        raise argparse.ArgumentTypeError(f"'{text}' must be two frequencies, 0 < LOW < HIGH")
    return low, high


def ends(text: str) -> str:
    """Check a unit of throttle, or LOW:HIGH, the values at zero and full throttle."""
    low, _, high = text.partition(':')
    read = number('1, %, us or the ends LOW:HIGH, such as 364:1684', math.isfinite)
    if text not in ('1', '%', 'us') and read(low) == read(high):
        raise argparse.ArgumentTypeError(f"'{text}' must have two different ends")
    return text


FLIGHT = whole('a number from 1 on', 1)
NUMBER = number('a number', math.isfinite)
POSITIVE = number('a positive number', lambda value: 0.0 < value < math.inf)
PROBABILITY = number('a probability between 0 and 1', lambda value: 0.0 < value < 1.0)
TIME = number('a time in seconds, 0 or more', lambda value: 0.0 <= value < math.inf)

RECORDING = Option(
    'recording', metavar='RECORDING', type=given,
    help='.mcap file, rosbag2 folder, CSV of any logger, or a log that convert reads (.bbl, .bin, '
    '.ulg)')
# Part of a recording to read.
PART = (
    Option('--from', metavar='S', dest='start', type=TIME,
           help='leave out samples before this time, s after the first message'),
    Option('--to', metavar='S', dest='end', type=TIME,
           help='leave out samples from this time on, s after the first message'))
# How a bag is read.
TOPICS = (
    Option('--msg-config', metavar='NAME', type=given,
           help='msg_config with topic and field of the voltage'),
    Option('--voltage-topic', metavar='TOPIC', help='topic of the voltage'),
    Option('--throttle-topic', metavar='TOPIC', help='topic of the throttle'),
    Option('--partial', action='store_true',
           help='use the intact part of a damaged file, and a CSV without its bad lines'))


# Format of a CSV, if it is not detected correctly.
CSV = (
    Option('--time-column', metavar='NAME', help='column of a CSV (default: found by its name)'),
    Option('--unit', choices=('V', 'dV', 'cV', 'mV', 'uV'),
           help='unit of the voltage in a CSV (default: detected)'),
    Option('--time-unit', choices=('s', 'ms', 'us', 'ns'),
           help='unit of the time in a CSV (default: detected)'),
    Option('--throttle-unit', metavar='{1,%,us,LOW:HIGH}', type=ends,
           help='unit of the throttle in a CSV: 0..1, percent, pulses of 1000 to 2000 us, or the '
           'values at zero and full throttle, as --throttle-unit=-1024:1024 (default: detected)'),
    Option('--sample-interval', metavar='S', type=POSITIVE,
           help='time between rows of a CSV without a column of time, s'),
    Option('--delimiter', metavar='C',
           help="separator of the cells of a CSV: a character, 'tab' or 'space' (default: "
           'detected)'),
    Option('--decimal', choices=('.', ','), help='decimal mark of a CSV (default: detected)'),
    Option('--skip-rows', metavar='N', type=whole('a number of lines, 0 or more', 0),
           help='lines above the header of a CSV (default: detected)'))
# How a log or a CSV is read.
COLUMNS = (
    Option('--voltage-column', metavar='NAME',
           help='column of a CSV (default: found by its name), or series of a log (default: the '
           'battery)'),
    Option('--throttle-column', metavar='NAME',
           help="column of a CSV or series of a log, or 'none' (default: detected)"),
    Option('--current-column', metavar='NAME',
           help="column of a CSV or series of a log, or 'none' (default: detected)"),
    *CSV)
FILES = (
    Option('--flight', metavar='N', type=FLIGHT,
           help='flight of a log with several, from 1 (default: the largest)'), *COLUMNS)
JSON = Option(
    '--json', metavar='FILE', type=given,
    help="write the result as JSON ('-': to standard output, and nothing else)")
FORCE = Option('--force', action='store_true', help='overwrite existing files')
REPORT = Option('--report', metavar='FILE.html', type=given,
                help='write a self-contained HTML page')
# Up to the cells of the largest packs in use, with a margin.
_CELLS = whole('a number of cells, 1 to 28', 1, 28)
TYPES = ('battery_state', 'float32', 'float64', 'adc_block')


def seed(default: int, text: str = 'same seed, same result') -> Option:
    """Return the option of a seed."""
    return Option('--seed', metavar='N', type=whole('a whole number, 0 or more', 0),
                  default=default, help=f'{text} (default: %(default)s)')


def levels(found: str) -> Option:
    """Return the option of the load levels; found: wording of the default."""
    return Option('--levels', metavar='0,0.05,...', type=throttles,
                  help=f'throttles 0..1 of the load levels (default: {found})')


def limit(meaning: str, *also: str, kind: Callable[[str], float] = POSITIVE,
          ) -> tuple[Option, ...]:
    """Return --brownout-voltage (meaning: its help; also: its other names) and --cells."""
    return (Option('--brownout-voltage', *also, metavar='V', type=kind, help=meaning),
            Option('--cells', metavar='N', type=_CELLS,
                   help='cells in series: --brownout-voltage is then in volts per cell (default '
                   'with --cells: 3.3)'))


def estimate(voltage: str) -> tuple[Option, ...]:
    """Return the options of the sliding estimate and of the risk."""
    return (
        Option('--window', metavar='S', type=POSITIVE, default=2.0,
               help='window of the sliding estimate, s (default: %(default)s)'),
        *limit(voltage),
        Option('--brownout-horizon', metavar='S', type=POSITIVE, default=5.0,
               help='horizon of the brown-out risk, s (default: %(default)s)'))


class _Help(argparse.HelpFormatter):
    """A help formatter that leaves indented lines, such as examples, unchanged."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        fill = super()._fill_text
        return '\n'.join(line if line.startswith('  ') or not line else fill(line, width, indent)
                         for line in text.split('\n'))


@dataclass(frozen=True)
class Command:
    """One command."""

    name: str  # As on the command line
    job: str  # One line
    # Module, and after a colon the name of the function (default: ``run``) that takes the parsed
    # arguments and returns the exit status.
    module: str
    description: str  # Start of its help
    # Options; the options in a tuple exclude one another.
    options: tuple[Option | tuple[Option, ...], ...]
    examples: tuple[str, ...]  # Command lines, without ``ou-monitor`` and its name
    epilog: str = ''  # Text before the examples at the end of its help

    def add_to(self, subparsers: Any) -> None:
        parser: argparse.ArgumentParser = subparsers.add_parser(
            self.name, allow_abbrev=False, help=self.job.replace('%', '%%'),
            description=self.description, epilog='\n'.join([
                *([self.epilog, ''] if self.epilog else []), 'Examples:',
                *[f'  ou-monitor {self.name} {example}'.rstrip() for example in self.examples]]),
            formatter_class=_Help)
        for option in self.options:
            choice = option if isinstance(option, tuple) else (option,)
            group = parser.add_mutually_exclusive_group() if len(choice) > 1 else parser
            for one in choice:
                group.add_argument(*one.names, **one.keywords)
        parser.set_defaults(run=self.run)

    def run(self, args: argparse.Namespace) -> int:
        module, _, name = self.module.partition(':')
        function: Callable[[argparse.Namespace], int] = getattr(
            import_module(module), name or 'run')
        return function(args)


_ANALYZE = Command(
    'analyze', 'Vpp, Vrms, alpha, tau, sigma, Var_inf with 95 % intervals per load level',
    'ou_monitor.cli.recorded:analyze',
    'Analyze the noise of a supply: per load level Vpp, Vrms, alpha, tau, sigma and Var_inf with '
    '95 % intervals, and the type of process.',
    (RECORDING, levels('detected'), *PART,
     *estimate('lowest permitted voltage, V (default: 4.5 for a 5 V rail)'),
     *TOPICS, *FILES, JSON, REPORT, FORCE),
    ('flight.bbl --cells 4 --report flight.html',
     'flight.mcap --brownout-voltage 14 --from 10 --to 70',
     'log.csv --voltage-column CH2 --throttle-unit us'))

_COMPARE = Command(
    'compare', 'a recording and simulations of it: the largest difference',
    'ou_monitor.cli.recorded:compare',
    'Simulate a recording many times under its own throttle, and compare: mean path, lowest '
    'voltage, dips below low levels, spectrum, response to throttle, distribution. '
    'Without --model, a model is fitted to the part before --fit-until; the rest is simulated.',
    (RECORDING, *PART,
     Option('--model', metavar='FILE.yaml', type=path_argument,
            help='simulate this model (from discover --save-model), with its level moved to the '
            "level of the recording's first seconds"),
     Option('--fit-until', metavar='S', type=TIME,
            help='start of the simulation, s after the first sample (default: the middle of the '
            'recording; with --model, its first sample)'),
     Option('--seeds', metavar='N', type=whole('a whole number, 20 to 10000', 20, 10_000),
            default=50, help='simulations (default: %(default)s)'),
     seed(0, 'same seed, same simulations'),
     *limit('also count dips below this voltage, V (dips below two low levels of the recording '
            'are always counted)'),
     *TOPICS, *FILES, JSON, REPORT, FORCE),
    ('flight.mcap --report flight.html', 'flight.bbl --fit-until 60 --cells 4',
     'flight.mcap --model other_day.yaml'))

_CONVERT = Command(
    'convert', 'convert a log to an MCAP bag', 'ou_monitor.cli.convert',
    'Convert a log to a bag with the topics /voltage, /throttle and /current (A, positive while '
    'the battery discharges), and from autopilot logs /imu and, with eRPM or ESC telemetry, '
    '/motor_speed. Stamps count from the start of the log, in seconds; the times of a CSV are '
    'kept.',
    (Option('log', metavar='LOG', type=path_argument, help='log to read'),
     Option('out', metavar='OUT', type=path_argument,
            help='bag to write: NAME.mcap for one file, NAME for a rosbag2 folder'),
     Option('--list', action=OptionalOut, nargs=0, default=False,
            help='list the series (*: taken by default) and write nothing; OUT is not needed'),
     Option('--voltage', metavar='NAME',
            help='voltage (default: the battery, if there is one)'),
     Option('--throttle', metavar='NAME',
            help="throttle, or 'none' (default: motors, else the command to them or the "
            'stick)'),
     Option('--current', metavar='NAME',
            help="current, or 'none' (default: from the same sensor as the voltage)"),
     Option('--signal', metavar='NAME', action='append', default=[],
            help='any other series, as a topic of its own; may be given several times'),
     Option('--imu', metavar='NAME',
            help="gyro for /imu, or 'none' (default: the first that --list shows)"),
     Option('--poles', metavar='N', type=whole('an even number from 2 on', 2, step=2),
            help='magnets of a rotor, for eRPM (default: as the log says)'),
     Option('--flight', metavar='N', type=FLIGHT,
            help='which flight of a file with several, from 1 (default: the largest)'),
     *CSV, JSON, FORCE),
    ('flight.ulg --list', 'flight.bbl flight.mcap --flight 2',
     'flight.bin flight.mcap --signal RCOU.C3'),
    'Formats: PX4 ULog (.ulg), ArduPilot dataflash (.bin, .log), Betaflight and INAV blackbox '
    '(.bbl, .bfl), Crazyflie micro-SD logs, CSV; they are recognised by the first bytes, not by '
    'the ending of the name.')

_COUPLING = Command(
    'coupling', 'gain from the supply voltage to a signal, such as a gyro axis',
    'ou_monitor.cli.recorded:coupling',
    'Estimate how much noise of the supply is in a signal: gain with 95 % interval and lag, or '
    'the gain that would have been detected.',
    (RECORDING, *PART,
     Option('--signal', metavar='NAME', required=True,
            help='TOPIC/FIELD.PATH (/imu/angular_velocity.x), a column, or a series of a log '
            '(gyroUnfilt[0], IMU.GyrX)'),
     Option('--band', metavar='LOW,HIGH', type=band,
            help='frequency band, Hz (default: 5 to a quarter of the slower rate)'),
     Option('--level', metavar='P', default=0.05, type=PROBABILITY,
            help='probability of a false alarm (default: %(default)s)'),
     *limit('also count dips below this voltage, V'), *TOPICS, *FILES, JSON, REPORT, FORCE),
    ('flight.bbl --signal gyroUnfilt[0] --report gyro.html',
     'flight.mcap --signal /imu/angular_velocity.x --band 10,100'))

_DESIGN = Command(
    'design', 'which capacitance brings the brown-out risk under X at throttle Y',
    'ou_monitor.cli.design',
    'Compute alpha, sigma, Var_inf and the brown-out risk of a rail from the components of its '
    'power network, for a range of bulk capacitances; find the smallest with a risk below --risk.',
    (Option('--from', metavar='RECORDING', dest='recording', type=given,
            help='take level, sag, resistance and noise from a recording; --set overrides its '
            'values (--set cells=0: the recording is of a rail, not of a pack)'),
     Option('--risk', metavar='X', type=PROBABILITY, default=0.01,
            help='highest allowed probability of a brown-out within the horizon, 0..1 (default: '
            '%(default)s, as for the throttle budget of analyze)'),
     Option('--throttle', metavar='Y', type=number(
         'between 0 and 1; write 40 % as 0.4', lambda value: 0.0 <= value <= 1.0),
            help='throttle, 0..1 (default with --from: exceeded for 1 %% of the flight)'),
     Option('--rail', choices=('bus', 'regulated'), default='bus',
            help='the battery bus at the ESCs, or the regulated rail (default: %(default)s)'),
     *limit('brown-out level, V (default: 3.3 V per cell on the bus; 4.5 V on a regulated rail of '
            '5 V, 2.88 V on one of 3.3 V)', '--voltage', kind=quantity('V')),
     Option('--brownout-horizon', '--horizon', metavar='S', type=quantity('s'), default='5',
            help='horizon, s (default: %(default)s)'),
     Option('--capacitance-min', metavar='F', type=quantity('F'), default='10uF',
            help='smallest capacitance to try (default: %(default)s)'),
     Option('--capacitance-max', metavar='F', type=quantity('F'), default='22mF',
            help='largest capacitance to try (default: %(default)s)'),
     Option('--esr-fixed', action='store_true',
            help='keep the ESR (default: ESR falls as 1/C, as with more equal capacitors in '
            'parallel)'),
     Option('--set', metavar='NAME=VALUE', action='append', default=[],
            help='a component, such as bulk_capacitance=1000uF; may be repeated (see --list)'),
     Option('--network', metavar='FILE.yaml', type=given,
            help='components as a YAML mapping of name to value; --set overrides it'),
     Option('--list', action='store_true', help='list the components and their defaults'),
     *TOPICS, *FILES, REPORT, JSON, FORCE),
    ('--from flight.bbl --cells 4', '--risk 1e-3 --throttle 0.6 --cells 4',
     '--list'),
    'Values are in SI units, or with prefix and unit: 470uF, 40mOhm, 24kHz.')

_DISCOVER = Command(
    'discover', 'what a simulation gets wrong, its cause, a better model, and its gain',
    'ou_monitor.cli.recorded:discover',
    'Fit and simulate the plain OU, find what it gets wrong, name the cause, extend the model, '
    'and measure the gain on samples not used for the fit.',
    (RECORDING, *PART, seed(0), *limit('also count dips below this voltage, V'), *TOPICS, *FILES,
     JSON,
     Option('--save-model', metavar='FILE.yaml', type=given,
            help='write the extended model, for simulate --model and the estimator'),
     Option('--force', action='store_true',
            help='overwrite files that exist already, and save the model even if it predicts '
                 'worse than the plain OU or its simulations leave the recorded range'),
     REPORT),
    ('flight.mcap --report causes.html', 'flight.bbl --save-model flight.yaml --force'))

_FLEET = Command(
    'fleet', 'many recordings -> a table (Parquet) and a report: ageing packs, drift, outliers',
    'ou_monitor.cli.fleet',
    'Analyze many recordings on several processes: one Parquet table with a row for each '
    'recording and load level, and a report with outliers and with the drift of each vehicle over '
    'its flights. The same command, started again, resumes a stopped run.',
    (Option('recordings', metavar='RECORDING', nargs='+', type=given,
            help='bags, CSV files and logs, as for analyze, and folders to search for them'),
     Option('--output', metavar='DIR', required=True, type=given,
            help='folder for fleet.parquet, fleet.html and the parts of a run'),
     Option('--workers', metavar='N', help='local processes (default: one per core)',
            type=whole('a number of processes from 1 to 1024', 1, 1024)),
     Option('--scheduler', metavar='ADDRESS',
            help='Dask scheduler whose workers are used instead, tls://HOST:8786; they need the '
            'recordings under the same paths'),
     Option('--insecure', action='store_true',
            help='allow a scheduler on another machine without TLS'),
     Option('--vehicle-from', metavar='REGEX',
            help='regular expression to search in the path: its first group (or whole match) is '
            'the vehicle if the metadata do not name one (default: the folder is the vehicle)'),
     Option('--discover', action='store_true',
            help='also search for causes; takes a few seconds per recording (default: off)'),
     seed(0, 'of discover'), levels('found in each recording'),
     *estimate('count dips below this voltage, V, and compute the risk of one'), *TOPICS,
     *COLUMNS, JSON, FORCE),
    ('logs/ --output fleet --cells 4', 'logs/ --output fleet --vehicle-from "(uav[0-9]+)"'))

_LIVE = Command(
    'live', 'a page to watch while flying, from the topics of the nodes',
    'ou_monitor.nodes.live',
    'Serve one read-only page: voltage and its limit, throttle and its budget, risk, sigma, the '
    'filter, and an alarm lamp, from the topics of the running nodes. Needs ROS 2.',
    (Option('--host', metavar='ADDRESS', default='127.0.0.1',
            help='address to listen on (default: %(default)s); one that other computers can reach '
            'requires the printed token'),
     Option('--port', metavar='N', default=8765, type=whole('a port, 0 to 65535', 0, 65535),
            help='port; 0: any that is free (default: %(default)s)'),
     Option('--estimator', metavar='NODE', default='/ou_estimator',
            help='name of the estimator (default: %(default)s)'),
     Option('--filter', metavar='NODE', default='/ou_adaptive_filter',
            help='name of the adaptive filter (default: %(default)s)')),
    ('', '--port 9000', '--host 0.0.0.0'))

_REPRODUCE = Command(
    'reproduce', 'recompute every number of the paper, verdict per row',
    'ou_monitor.cli.recorded:reproduce',
    'Recompute every number of the paper: printed value, recomputed value, and whether it agrees, '
    'differs by rounding, or does not hold.',
    (seed(1, 'same seed, same simulations'), JSON, REPORT, FORCE),
    ('--report paper.html', '--json -'))

_SIMULATE = Command(
    'simulate', 'a recording from a model', 'ou_monitor.cli.simulate',
    'Simulate a recording from a model of a supply, at any rate. --list shows the presets and the '
    'throttle profiles.',
    ((Option('--preset', metavar='NAME',
             help="preset to simulate (default 'flight'; --list shows all)"),
      Option('--model', metavar='FILE.yaml', type=path_argument,
             help='model file, as discover writes it')),
     Option('--duration', metavar='S', type=POSITIVE, help='length, s'),
     Option('--rate', metavar='HZ', type=POSITIVE,
            help="samples per second (default: as in the preset or the model's recording)"),
     seed(1, 'same seed, same recording'),
     Option('--throttle', metavar='PROFILE',
            help='name of a profile, a number 0..1, points T:U,T:U,... or a CSV of time and '
            'throttle (linear between the points), or a recording (each value holds until the '
            'next); the default length is that of the points or the recording'),
     *PART, *COLUMNS,
     Option('--capacity-left', metavar='X', type=NUMBER,
            help='initial charge, 0..1; the battery then discharges by throttle, not by the term '
            "drift; -1: the charge at the start of the model's recording"),
     Option('--scale-resistance', metavar='X', type=NUMBER, default=1.0,
            help='factor on the response to throttle: 1.4 is a pack aged by 40 %% (default '
            '%(default)s)'),
     Option('--export', metavar='TARGET', choices=('gazebo', 'px4', 'ardupilot', 'json'),
            help='print the parameters of the model for another simulator (gazebo, px4, '
            'ardupilot, json), and the effect, under --throttle, of what they omit'),
     Option('--full-current', metavar='A', type=POSITIVE, default=math.nan,
            help='with --export: current at full throttle'),
     Option('--output', metavar='PATH', type=path_argument,
            help='NAME.mcap for one file, NAME for a rosbag2 folder'),
     Option('--type', choices=TYPES,
            help='message of the voltage (default battery_state, adc_block from 5 kHz on)'),
     Option('--save-model', metavar='FILE.yaml', type=path_argument,
            help='write the simulated model'),
     Option('--list', action='store_true', help='list presets and profiles'), JSON, FORCE),
    ('--preset load_40 --output load_40.mcap',
     '--model flight.yaml --throttle flight.mcap --from 10 --to 70 --output again.mcap',
     '--model flight.yaml --throttle flight.mcap --export px4'))

COMMANDS = {command.name: command for command in (
    _ANALYZE, _COMPARE, _CONVERT, _COUPLING, _DESIGN, _DISCOVER, _FLEET, _LIVE, _REPRODUCE,
    _SIMULATE)}
