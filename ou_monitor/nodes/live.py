"""
`ou-monitor live`: a page to watch while flying, served from the topics of the nodes.

The page is read-only.  Limits: HTTP without encryption.  If the address is not a loopback address,
requests need the token that the command prints.  Connections beyond `CONNECTIONS` are closed, and
so are connections without a complete request within `PATIENCE`.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import hashlib
import hmac
from importlib import resources
import ipaddress
import json
import secrets
from threading import Thread
from typing import Any

from ou_monitor.errors import how_to_install, InputError
from ou_monitor.nodes.run import make_executor, run as run_ros, turn

NAME = 'ou_live'
# Period of checking for new rows and for the end of the context, s.
_STEP = 0.1
# Maximum connections: a browser takes up to six, and each open page holds one.
CONNECTIONS = 64
# Timeout of a request on an open connection, s.
PATIENCE = 10.0
# Maximum header and body of a request, bytes; browsers send a header of about 1000, and no body.
_HEADER, _BODY = 16384, 0
# Maximum number of digits parsed as a row number: Python raises an error for a few thousand.
_DIGITS = 18
# Period of the comment lines that keep an idle connection open, s.
_ALIVE = 5.0


def run(args: argparse.Namespace) -> int:
    if not args.host:
        raise InputError('--host: the address is empty; 0.0.0.0 listens on all addresses')
    try:
        import tornado.web  # noqa: F401
    except ImportError as error:
        raise InputError(f"live needs tornado: {how_to_install('live')}") from error
    # Node names with a leading slash, as in ROS.
    names = [f"/{name.strip('/')}" for name in (args.estimator, args.filter)]
    return run_ros(NAME, lambda: _serve(args.host, args.port, *names), [])


def _serve(host: str, port: int, estimator: str, low_pass: str) -> int:
    from ou_monitor.nodes.live_node import LiveNode

    node = LiveNode(estimator, low_pass)
    executor = make_executor()
    executor.add_node(node)

    # The thread ends with the context.
    thread = Thread(target=lambda: turn(executor, node))
    thread.start()
    try:
        asyncio.run(_page(node, host, port))
    finally:
        node.context.try_shutdown()
        thread.join()
        executor.remove_node(node)
        node.destroy_node()
    return 0


def _local(host: str) -> bool:
    try:
        return host == 'localhost' or ipaddress.ip_address(host.strip('[]')).is_loopback
    except ValueError:
        return False


async def _page(node: Any, host: str, port: int) -> None:
    token = '' if _local(host) else secrets.token_urlsafe(16)
    server = make_server(application(node, token))
    try:
        server.listen(port, address=host)
    except OSError as error:
        raise InputError(f'cannot listen on {host}:{port}: {error.strerror or error}; '
                         'give another --port or --host') from error
    held = next(iter(server._sockets.values())).getsockname()[1]
    shown = f'[{host}]' if ':' in host else host
    print(f'Live page: http://{shown}:{held}/' + (f'?token={token}' if token else '')
          + '  (Ctrl-C ends it)', flush=True)
    try:
        while node.context.ok():
            await asyncio.sleep(_STEP)
    finally:
        server.stop()


def make_server(app: Any, patience: float = PATIENCE) -> Any:
    """Return the server of an application; timeout `patience` in s."""
    from tornado.httpserver import HTTPServer

    class BoundedServer(HTTPServer):
        """Closes connections beyond `CONNECTIONS`."""

        def handle_stream(self, stream: Any, address: Any) -> None:
            if len(self._connections) >= CONNECTIONS:
                stream.close()
            else:
                super().handle_stream(stream, address)

    # No timeout runs while a request is being answered, so a stream of rows stays open.
    return BoundedServer(app, idle_connection_timeout=patience, body_timeout=patience,
                         max_header_size=_HEADER, max_body_size=_BODY)


def application(node: Any, token: str) -> Any:
    """Return the page and its stream of rows; a token, if given, is required."""
    from tornado.iostream import StreamClosedError
    from tornado.web import Application, HTTPError, RequestHandler

    html, policy = _html()

    class GuardedHandler(RequestHandler):
        """Refuses requests without the token, or with a foreign host name (DNS rebinding)."""

        def prepare(self) -> None:
            if token:
                given = self.get_query_argument('token', '')
                if not hmac.compare_digest(given.encode(), token.encode()):
                    raise HTTPError(403)
            elif not _local(self.request.host_name):
                raise HTTPError(403)

        def set_default_headers(self) -> None:
            """Allow the browser to load nothing but the page itself."""
            self.set_header('Content-Security-Policy', policy)
            self.set_header('X-Content-Type-Options', 'nosniff')
            self.set_header('Referrer-Policy', 'no-referrer')
            self.set_header('Cache-Control', 'no-store')

    class Page(GuardedHandler):

        def get(self) -> None:
            self.finish(html)

    class Rows(GuardedHandler):

        async def get(self) -> None:
            """Send the rows that the browser does not have yet, then new rows as they come."""
            self.set_header('Content-Type', 'text/event-stream')
            # A browser that reconnects sends the number of its last row.
            last = self.request.headers.get('Last-Event-ID', '')
            known = last.isascii() and last.isdigit() and len(last) <= _DIGITS
            sent = int(last) if known else 0
            newest = node.rows(0)
            if newest and sent > newest[-1]['k']:
                # The browser's number is from an earlier process: start from the beginning.
                sent = 0
            quiet = 0.0
            try:
                while node.context.ok():
                    rows = node.rows(sent)
                    if rows:
                        sent, quiet = rows[-1]['k'], 0.0
                        text = json.dumps(rows, allow_nan=False)
                        self.write(f'id: {sent}\nretry: 1000\ndata: {text}\n\n')
                        await self.flush()
                    elif quiet > _ALIVE:
                        quiet = 0.0
                        self.write(': alive\n\n')
                        await self.flush()
                    quiet += _STEP
                    await asyncio.sleep(_STEP)
            except StreamClosedError:
                return

    return Application([('/', Page), ('/rows', Rows)])


def _html() -> tuple[str, str]:
    """Return the page, and the policy that names its script and style by their hashes."""
    html, drawing = (resources.files(package).joinpath(name).read_text(encoding='utf-8')
                     for package, name in ((__package__, 'live.html'),
                                           ('ou_monitor.report', 'plots_draw.js')))
    html = html.replace('/* plots_draw.js */', drawing)

    def source(tag: str) -> str:
        text = html.split(f'<{tag}>')[1].split(f'</{tag}>')[0]
        digest = hashlib.sha256(text.encode()).digest()
        return f"'sha256-{base64.b64encode(digest).decode()}'"

    return html, (f"default-src 'none'; connect-src 'self'; script-src {source('script')}; "
                  f"style-src {source('style')}; base-uri 'none'; form-action 'none'; "
                  "frame-ancestors 'none'")
