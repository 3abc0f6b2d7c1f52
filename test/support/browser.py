"""A headless Chromium, controlled over two pipes by the DevTools protocol, without a driver."""

import base64
import fcntl
import json
import os
from pathlib import Path
import select
import shutil
import subprocess
import sys
import time

_NAMES = ('chromium', 'chromium-browser', 'google-chrome', 'google-chrome-stable', 'chrome')
_TIMEOUT = 30.0
# The browser reads commands from descriptor 3 and writes answers to 4.
_START = ('import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); '
          'os.execv(sys.argv[3], sys.argv[3:])')


def find_browser():
    """Return the path of a Chromium or Chrome, from OU_MONITOR_BROWSER or the PATH; or None."""
    given = os.environ.get('OU_MONITOR_BROWSER')
    return shutil.which(given) if given else next(filter(None, map(shutil.which, _NAMES)), None)


def _pipe():
    """Return the ends of a pipe, with numbers that the browser does not use."""
    ends = os.pipe()
    moved = [fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10) for end in ends]
    for end in ends:
        os.close(end)
    return moved


class Browser:
    """One tab, which records the requests, messages and errors of its page."""

    def __init__(self, program, folder, width=1000, height=900):
        there, there_end = _pipe()
        back_end, back = _pipe()
        command = [sys.executable, '-IS', '-c', _START, str(there), str(back), program,
                   '--headless', '--remote-debugging-pipe', '--disable-gpu', '--no-first-run',
                   '--hide-scrollbars',
                   '--disable-background-networking', '--disable-extensions', '--disable-sync',
                   '--disable-component-update', f'--user-data-dir={folder}',
                   f'--window-size={width},{height}']
        if os.geteuid() == 0:
            command.append('--no-sandbox')
        self._process = subprocess.Popen(
            command, pass_fds=(there, back), stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        os.close(there)
        os.close(back)
        self._out, self._in = there_end, back_end
        self._number, self._rest, self._session = 0, b'', None
        self.requests, self.errors = [], []
        target = self.send('Target.createTarget', url='about:blank')['targetId']
        self._session = self.send('Target.attachToTarget', targetId=target,
                                  flatten=True)['sessionId']
        for domain in ('Page', 'Network', 'Runtime', 'Log'):
            self.send(f'{domain}.enable')

    def __enter__(self):
        """Return the tab."""
        return self

    def __exit__(self, *error):
        """End the browser."""
        try:
            self._session = None
            self.send('Browser.close')
            self._process.wait(10.0)
        except (OSError, RuntimeError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        finally:
            os.close(self._out)
            os.close(self._in)

    def send(self, method, **arguments):
        """Send one command and return its answer; events are recorded meanwhile."""
        self._number += 1
        message = {'id': self._number, 'method': method, 'params': arguments}
        if self._session:
            message['sessionId'] = self._session
        data = json.dumps(message).encode() + b'\0'
        while data:
            data = data[os.write(self._out, data):]
        while True:
            answer = self._next()
            if answer.get('id') == self._number:
                if 'error' in answer:
                    raise RuntimeError(f'{method}: {answer["error"]["message"]}')
                return answer['result']

    def _next(self):
        end = time.monotonic() + _TIMEOUT
        while b'\0' not in self._rest:
            ready, _, _ = select.select([self._in], [], [], max(end - time.monotonic(), 0.0))
            more = os.read(self._in, 1 << 20) if ready else b''
            if not more:
                raise RuntimeError('the browser has stopped answering')
            self._rest += more
        line, self._rest = self._rest.split(b'\0', 1)
        message = json.loads(line)
        self._note(message.get('method'), message.get('params', {}))
        return message

    def _note(self, method, about):
        if method == 'Network.requestWillBeSent':
            self.requests.append(about['request']['url'])
        elif method == 'Runtime.exceptionThrown':
            self.errors.append(json.dumps(about['exceptionDetails']))
        elif method == 'Runtime.consoleAPICalled' and about['type'] in ('error', 'warning'):
            self.errors.append(json.dumps(about['args']))
        elif method == 'Log.entryAdded' and about['entry']['level'] in ('error', 'warning'):
            self.errors.append(about['entry']['text'])

    def visit(self, path, wanted='true'):
        """Open a file and wait until it is loaded and an expression is true."""
        self.run('window.before = true')
        self.send('Page.navigate', url=Path(path).resolve().as_uri())
        self.until('!window.before && document.readyState === "complete"')
        self.until(wanted)

    def until(self, expression):
        end = time.monotonic() + _TIMEOUT
        while not self.run(f'Boolean({expression})'):
            assert time.monotonic() < end, (expression, self.errors)
            time.sleep(0.02)

    def run(self, expression):
        """Return the value of an expression, by way of JSON."""
        answer = self.send('Runtime.evaluate', expression=expression, returnByValue=True,
                           awaitPromise=True)
        assert 'exceptionDetails' not in answer, answer
        return answer['result'].get('value')

    def mouse(self, kind, x, y, **more):
        """Move, press, release or scroll the mouse at a place in the window."""
        held = {'mousePressed': {'button': 'left', 'clickCount': 1, 'buttons': 1},
                'mouseReleased': {'button': 'left', 'clickCount': 1}}.get(kind, {})
        self.send('Input.dispatchMouseEvent', type=kind, x=x, y=y, **{**held, **more})

    def drag(self, start, stop, **more):
        """Press at one place, move, release at another."""
        self.mouse('mouseMoved', *start)
        self.mouse('mousePressed', *start, **more)
        for share in (0.5, 1.0):
            self.mouse('mouseMoved', *(a + share * (b - a) for a, b in zip(start, stop)),
                       button='left', buttons=1, **more)
        self.mouse('mouseReleased', *stop, **more)

    def key(self, name, **more):
        for kind in ('keyDown', 'keyUp'):
            self.send('Input.dispatchKeyEvent', type=kind, key=name, **more)

    def touch(self, kind, *points):
        """Put, move or lift fingers."""
        self.send('Input.dispatchTouchEvent', type=kind,
                  touchPoints=[{'x': x, 'y': y, 'id': k} for k, (x, y) in enumerate(points)])

    def media(self, kind='screen', theme='light'):
        """Show the page on screen or paper, light or dark."""
        self.send('Emulation.setEmulatedMedia', media=kind,
                  features=[{'name': 'prefers-color-scheme', 'value': theme}])

    def picture(self, path, whole=True):
        """Write a screenshot as a PNG file."""
        shot = self.send('Page.captureScreenshot', captureBeyondViewport=whole)
        Path(path).write_bytes(base64.b64decode(shot['data']))
