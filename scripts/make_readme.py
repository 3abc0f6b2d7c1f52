#!/usr/bin/env python3
"""
Write the example and the picture of README.md: `scripts/make_readme.py`.

The example is the real output of README.md's command for a recorded flight, shortened to its first
paragraphs.  The picture shows part of its report (`_SHOWN`) in a headless Chromium or Chrome;
without a browser it is not changed.  test/test_readme.py runs the same command and compares.
"""

from __future__ import annotations

from pathlib import Path
import shlex
import subprocess
import sys
import tempfile

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'support'))

from browser import Browser, find_browser  # noqa: E402

README = ROOT / 'README.md'
PICTURE = ROOT / 'doc' / 'report.png'
_MARKS = ('<!-- example begins -->\n', '<!-- example ends -->')
# Number of paragraphs of the output that are shown.
_FIRST = 3
# Part of the report shown: voltage, throttle with its load levels, and the plot over throttle.
_SHOWN = """
    const figures = [...document.querySelectorAll('figure')];
    const wanted = new Set(figures.slice(0, 2));
    for (const section of document.querySelectorAll('section')) {
        const title = section.querySelector('h2');
        if (title && title.textContent === 'Over throttle') {
            wanted.add(section.querySelector('figure'));
        }
    }
    document.body.replaceChildren(document.querySelector('h1'), ...wanted);
"""
_BOTTOM = 'Math.ceil(document.body.lastElementChild.getBoundingClientRect().bottom)'
# The page draws in the next frame.
_DRAWN = 'new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(1))))'


def command(text: str) -> list[str]:
    """Return the words of the command between the marks of README.md."""
    part = text.split(_MARKS[0])[1].split(_MARKS[1])[0]
    return shlex.split(part.split('```console\n')[1].split('\n```')[0].replace('\\\n', ''))


def run(words: list[str], report: Path) -> str:
    """Run the command with its report written to `report`; return its output."""
    named = words[1:]
    words = [str(report) if word.endswith('.html') else word for word in named]
    done = subprocess.run([sys.executable, '-m', 'ou_monitor.cli.main', *words], cwd=ROOT,
                          capture_output=True, text=True, check=True)
    return done.stdout.replace(str(report), next(w for w in named if w.endswith('.html')))


def shortened(printed: str) -> str:
    """Return the first paragraphs, an ellipsis for the others, and the last."""
    parts = printed.strip().split('\n\n')
    return '\n\n'.join([*parts[:_FIRST], '[...]', parts[-1]])


def photograph(page: Path) -> bool:
    """Write the picture of a report; False without a browser."""
    program = find_browser()
    if program is None:
        return False
    with tempfile.TemporaryDirectory() as folder, \
            Browser(program, folder, width=860, height=640) as tab:
        # Plots become interactive when they are scrolled into view; the page then adds a hint.
        tab.visit(page, 'document.querySelector(".live-hint")')
        tab.run(_SHOWN)
        tab.until('!document.querySelector("figure:not(.is-live)")')
        tab.run(_DRAWN)
        tab.send('Emulation.setDeviceMetricsOverride', width=860, height=tab.run(_BOTTOM) + 16,
                 deviceScaleFactor=1, mobile=False)
        tab.run(_DRAWN)
        tab.picture(PICTURE, whole=False)
    return True


def main() -> int:
    """Write both."""
    text = README.read_text(encoding='utf-8')
    words = command(text)
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / 'report.html'
        printed = shortened(run(words, page))
        if not photograph(page):
            print('no Chromium or Chrome: the picture stays as it is', file=sys.stderr)
    head, rest = text.split(_MARKS[0])
    example, tail = rest.split(_MARKS[1])
    example = example.split('```text\n')[0] + f'```text\n{printed}\n```\n'
    README.write_text(f'{head}{_MARKS[0]}{example}{_MARKS[1]}{tail}', encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
