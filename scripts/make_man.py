#!/usr/bin/env python3
"""Write doc/ou-monitor.1, the man page, from the texts of `ou-monitor --help`."""

from __future__ import annotations

import argparse
from pathlib import Path
import sys

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from ou_monitor import __version__  # noqa: E402
from ou_monitor.cli.main import build_parser, PROGRAM  # noqa: E402

PAGE = ROOT / 'doc' / 'ou-monitor.1'


def plain(text: str | None) -> str:
    """Return a text escaped for troff."""
    text = ' '.join((text or '').split()).replace('\\', r'\e').replace('-', r'\-')
    return r'\&' + text if text[:1] in ("'", '.') else text


def option(action: argparse.Action, parser: argparse.ArgumentParser) -> list[str]:
    """Return an option or an argument and its text."""
    choices = f"{{{','.join(map(str, action.choices))}}}" if action.choices else ''
    shown = action.metavar or choices or (action.dest if action.nargs != 0 else '')
    value = rf'\fI{plain(str(shown))}\fR' if action.nargs != 0 and shown else ''
    names = ', '.join(rf'\fB{plain(name)}\fR' for name in action.option_strings)
    text = (action.help or '') % {**vars(action), 'prog': parser.prog}
    return ['.TP', ' '.join(filter(None, (names, value))), plain(text)]


def page() -> str:
    """Return the man page."""
    parser = build_parser()
    (commands,) = (action for action in parser._actions
                   if isinstance(action, argparse._SubParsersAction))
    lines = [f'.TH OU\\-MONITOR 1 "" "ou_monitor {__version__}" "User Commands"', '.SH NAME',
             f'{plain(PROGRAM)} \\- {plain(parser.description)}', '.SH SYNOPSIS',
             rf'\fB{plain(PROGRAM)}\fR [\fB\-\-version\fR] \fICOMMAND\fR ...', '.SH COMMANDS']
    for name, command in commands.choices.items():
        lines += [f'.SS {plain(name)}', plain(command.description)]
        for action in command._actions:
            if action.help is not argparse.SUPPRESS:
                lines += option(action, command)
        # Examples keep their lines.
        for part in (command.epilog or '').split('\n\n'):
            lines += ['.PP', '.nf', *map(plain, part.splitlines()), '.fi'] if (
                part.startswith('Examples:')) else ['.PP', plain(part)] if part else []
    return '\n'.join([*lines, '.SH EXIT STATUS',
                      '0, or 2 after bad input, which one line on standard error describes.', ''])


if __name__ == '__main__':
    PAGE.write_text(page(), encoding='utf-8')
