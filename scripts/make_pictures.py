#!/usr/bin/env python3
"""
Write the pictures in doc/pages/: the first screen of each report and of `ou-monitor live`.

Each page is made by its command from a recording in bags/, and captured in a headless Chromium or
Chrome, 1000 px wide; the page of `analyze` also 390 px wide and dark.  The live page is captured
after a bag has played into the nodes for half a minute.
"""

from __future__ import annotations

import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'test' / 'support'))

from browser import Browser, find_browser  # noqa: E402

FOLDER = ROOT / 'doc' / 'pages'
GECKO = 'bags/recorded/gecko.csv'
# Picture, command, width, theme.
PAGES = (
    ('analyze', ('analyze', GECKO, '--brownout-voltage', '13.5', '--brownout-horizon', '1'),
     1000, 'light'),
    ('analyze_phone', ('analyze', GECKO, '--brownout-voltage', '13.5', '--brownout-horizon', '1'),
     390, 'dark'),
    ('compare', ('compare', GECKO), 1000, 'light'),
    ('discover', ('discover', GECKO), 1000, 'light'),
    ('coupling', ('coupling', 'bags/recorded/gecko_gyro.csv', '--signal', 'gyro_x_deg_s',
                  '--cells', '4'), 1000, 'light'),
    ('fleet', ('fleet', 'bags', '--brownout-voltage', '4.5'), 1000, 'light'),
    ('reproduce', ('reproduce',), 1000, 'light'),
)
HEIGHT = 900
# Time for the live page to have something to show, s.
PLAYED = 35.0


def command(words: tuple[str, ...], folder: Path) -> Path:
    """Run a command; return its page."""
    page = folder / 'page.html'
    output = ['--output', str(folder / 'fleet')] if words[0] == 'fleet' else [
        '--report', str(page)]
    subprocess.run([sys.executable, '-m', 'ou_monitor.cli.main', *words, *output], cwd=ROOT,
                   check=True, stdout=subprocess.DEVNULL)
    return folder / 'fleet' / 'fleet.html' if words[0] == 'fleet' else page


def photograph(program: str, page: Path, picture: Path, width: int, theme: str) -> None:
    """Write the first screen of a page."""
    with tempfile.TemporaryDirectory() as folder, \
            Browser(program, folder, width=width, height=HEIGHT) as tab:
        tab.send('Emulation.setDeviceMetricsOverride', width=width, height=HEIGHT,
                 deviceScaleFactor=1, mobile=width < 600)
        tab.media(theme=theme)
        tab.visit(page, 'document.readyState === "complete"')
        tab.run('new Promise(done => setTimeout(() => done(1), 1500))')
        tab.picture(picture, whole=False)


def live(program: str, picture: Path) -> None:
    """Capture the live page while a bag plays."""
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(random.randint(60, 99)),
                   'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'}

    def start(module: str, *words: str) -> subprocess.Popen[str]:
        return subprocess.Popen([sys.executable, '-u', '-m', f'ou_monitor.{module}', *words],
                                cwd=ROOT, env=environment, stdout=subprocess.PIPE,
                                stderr=subprocess.DEVNULL, text=True)

    running = [
        start('nodes', 'estimator'),
        start('nodes', 'adaptive_filter', '--ros-args', '-r', 'input:=/voltage',
              '-r', 'sigma:=/ou_estimator/sigma', '-r', 'state:=/ou_estimator/state'),
        start('nodes', 'replay', 'bags/flight', '--loop'),
        start('cli.main', 'live', '--port', '0')]
    try:
        assert running[-1].stdout is not None
        address = running[-1].stdout.readline().split()[2]
        with tempfile.TemporaryDirectory() as folder, \
                Browser(program, folder, width=1000, height=1280) as tab:
            tab.send('Page.navigate', url=address)
            time.sleep(PLAYED)
            tab.picture(picture, whole=False)
    finally:
        for process in running:
            process.send_signal(signal.SIGINT)
        for process in running:
            process.wait(20.0)


def main() -> int:
    """Write all pictures, or those named as arguments."""
    program = find_browser()
    if program is None:
        print('no Chromium or Chrome: the pictures stay as they are', file=sys.stderr)
        return 1
    FOLDER.mkdir(exist_ok=True)
    named = sys.argv[1:]
    for name, words, width, theme in PAGES:
        if not named or name in named:
            with tempfile.TemporaryDirectory() as folder:
                page = command(words, Path(folder))
                photograph(program, page, FOLDER / f'{name}.png', width, theme)
    if not named or 'live' in named:
        live(program, FOLDER / 'live.png')
    return 0


if __name__ == '__main__':
    sys.exit(main())
