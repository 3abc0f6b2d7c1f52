"""`ou-monitor COMMAND`: finds and runs the command, and reports an error in one line."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from contextlib import suppress
from io import TextIOWrapper
import os
import signal
import sys
from typing import NoReturn

from ou_monitor import __version__
from ou_monitor.cli.commands import COMMANDS
from ou_monitor.errors import InputError, nearest, refusal

# Set before NumPy is loaded.  Matrices here are small, so BLAS threads only wait for one another:
# on two busy cores a product of two series of 20 000 took 21 ms instead of 4 us.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

PROGRAM = 'ou-monitor'
BAD_INPUT = 2
# Exit status that a shell reports for a program ended by Ctrl-C.
INTERRUPTED = 130


def _complain(text: str) -> None:
    """Write a text to standard error as one line, even if it contains line breaks."""
    with suppress(OSError, ValueError):
        print(' '.join(text.split()), file=sys.stderr, flush=True)


def _end(number: int, frame: object) -> NoReturn:
    """Exit on SIGTERM as after an error, so that files moved aside are restored."""
    sys.exit(128 + number)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, without the usage."""

    def error(self, message: str) -> NoReturn:
        self.exit(BAD_INPUT, f"{self.prog}: {message} (see '{self.prog} --help')\n")


def build_parser(commands: Sequence[str] | None = None) -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROGRAM, allow_abbrev=False,
        description='Ornstein-Uhlenbeck statistics of UAV supply rails.',
        epilog=f"'{PROGRAM} COMMAND --help' shows the options of a command.")
    parser.add_argument('--version', action='version', version=f'{PROGRAM} {__version__}')
    subparsers = parser.add_subparsers(
        dest='command', metavar='COMMAND', title='commands', required=True)
    for name in COMMANDS if commands is None else commands:
        COMMANDS[name].add_to(subparsers)
    return parser


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    first = argv[0] if argv else ''
    if first and not first.startswith('-') and first not in COMMANDS:
        raise InputError(f"unknown command '{first}': {nearest(first, COMMANDS)}")
    parser = build_parser([first] if first in COMMANDS else None)
    # Set by the shell that asks for completions, so other runs skip this.
    if '_ARGCOMPLETE' in os.environ:
        import argcomplete

        argcomplete.autocomplete(parser)
    args, extra = parser.parse_known_args(argv, argparse.Namespace(words=argv))
    if extra:
        options = _options(parser, args.command)
        hint = nearest(extra[0].split('=')[0], options) if extra[0].startswith('-') else (
            f'{args.command} takes no further argument')
        raise InputError(f"{args.command}: unknown argument '{extra[0]}': {hint}")
    return args


def _options(parser: argparse.ArgumentParser, command: str) -> list[str]:
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            chosen = action.choices[command]
            return [o for a in chosen._actions for o in a.option_strings if o.startswith('--')]
    return []


def main(argv: Sequence[str] | None = None) -> int:
    if argv is None:
        signal.signal(signal.SIGTERM, _end)
    given = list(sys.argv[1:] if argv is None else argv)
    where = PROGRAM
    for name in ('stdout', 'stderr'):
        # None if the parent process closed the stream, as for a daemon: discard the output.
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, 'w', encoding='utf-8'))
    if isinstance(sys.stdout, TextIOWrapper):
        # Escape characters that the terminal cannot encode, as standard error does.
        sys.stdout.reconfigure(errors='backslashreplace')
    try:
        try:
            args = _parse(given)
            where = f'{PROGRAM} {args.command}'
            return int(args.run(args))
        except SystemExit as stop:
            # From argparse: --help, --version and bad arguments.  Flush its output here, so that
            # an error in writing it is reported.
            from ou_monitor.cli.output import say

            say('', end='')
            return stop.code if isinstance(stop.code, int) else 0
    except InputError as error:
        _complain(f'{where}: {error}')
        return BAD_INPUT
    except KeyboardInterrupt:
        return INTERRUPTED
    except BrokenPipeError:
        from ou_monitor.cli.output import abandon_stdout

        # The reading program (head, less) closed the pipe: write no more, not even the flush at
        # exit.
        abandon_stdout()
        return 0
    except OSError as error:
        # The operating system may refuse any call, such as listing a folder.
        _complain(f'{where}: {refusal(error)}')
        return BAD_INPUT
    except MemoryError:
        _complain(f'{where}: not enough memory: take a part of the recording (--from, --to)')
        return BAD_INPUT
    except Exception as error:
        from ou_monitor.model.terms.catalogue import blamed

        if not (names := blamed(error)):
            raise
        _complain(f"{where}: the cause '{names[0]}' of another package failed: "
                  f'{type(error).__name__}: {error}')
        return BAD_INPUT


if __name__ == '__main__':
    sys.exit(main())
